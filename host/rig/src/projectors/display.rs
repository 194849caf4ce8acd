//! `projector.backend.kind = "display"`: a display on a graphics card, and the controller behind it if there is one.

use super::controller::Behind;
use super::keys::{DeviceName, FrameKeys, Medium, Opening, Panel, ProjectorKeys};
use super::kind::{ProjectorKind, SlotClock};
use super::light::{LitTime, PlaneTiming, PlaneWeights};
use dpm_common::keys::read::{contradict, refuse, shown, Any, KeyReader, NotEmpty, Within};
use dpm_common::{section, words};
use dpm_device::planes::{Parts, PlaneSchedule};
use dpm_device::transport::TransportError;
use dpm_display::encoding::Encoding;
use dpm_display::lease::{self, Access, Lender};
use dpm_display::mode::ModeWish;
use dpm_display::set_up::DisplaySettings;
use dpm_display::transport::{on_card, DisplayTransport, Opener};
use dpm_handoff::wake::WaitPolicy;
use std::path::PathBuf;

section! {
    /// A display on a graphics card of this machine, which shows nothing else meanwhile, or lends this display alone.
    /// docs/DISPLAY.md says how to set it up. Nothing of it has been tried on real hardware yet.
    pub struct DisplayConfig {
        /// The connector, as `dpm display` lists them, for example "HDMI-A-1"; the only one with a display if left out.
        connector: Option<String> = None, "", NotEmpty;
        /// A size and a rate that the display offers, or a timing, as in "138.51 1920 1968 2000 2080 1080 1083 1088
        /// 1111 +hsync -vsync" (MHz, row, frame, pulses). `projector.width`, `height` and `frame_rate` must be exactly
        /// the mode's; `dpm display` prints them.
        mode: String = "1920x1080@60".into(), "", NotEmpty;
        /// What the bits of a pixel mean.
        encoding: DisplayEncoding = DisplayEncoding::Rgb8, "", Any;
        /// The graphics card's device file; the first with such a connector if left out.
        card: Option<PathBuf> = None, "", NotEmpty;
        /// Whether a desktop is asked to lend the connector (docs/DISPLAY.md). "auto" asks where another program
        /// drives the card, "off" never; "x11" and "wayland" ask at once.
        lease: DisplayLease = DisplayLease::Auto, "", Any;
        /// How long before its vertical blank a frame is chosen and written; half a frame and at most 8000 if left out.
        /// Raise it if the report counts repeated frames although frames were there in time. It adds to the latency.
        commit_us: Option<u32> = None, "us", Within(100, 35_000);
        /// Properties of the connector without which bits are shown although they may be lost, for example ["Broadcast
        /// RGB"]. Name one only after you have measured that bits arrive.
        without: Vec<String> = Vec::new(), "", Any;
        /// The DLPC900 at the other end of the cable, if the display is one. The rig sets it up over USB, and watches it.
        dlpc900: Behind = Behind::default(), "", Any;
    }
}

impl DisplayEncoding {
    /// How each channel shows its code value in a frame of a controller.
    pub const fn parts(self) -> Parts {
        let (count, depth, white) = match self {
            Self::Rgb8 => (1, 8, false),
            Self::Rgb4x2 => (2, 4, false),
            Self::Rgb2x4 => (4, 2, false),
            Self::Planes24 | Self::Binary24 => (8, 1, false),
            Self::Mono8x3 => (3, 8, true),
            Self::Mono6x4 => (4, 6, true),
            Self::Mono4x6 => (6, 4, true),
            Self::Mono3x8 => (8, 3, true),
            Self::Mono2x12 => (12, 2, true),
            Self::Mono1x24 => (24, 1, true),
        };
        Parts { count, depth, low: 0, white }
    }

    /// How much light the planes of a channel give behind a controller: the bits of a pattern weigh as those of a number do.
    pub const fn weights(self) -> PlaneWeights {
        match self.parts().depth {
            1 => PlaneWeights::Equal,
            _ => PlaneWeights::Binary,
        }
    }

    /// It says how a controller cuts pixels, and nothing to a display by itself.
    pub const fn needs_controller(self) -> bool {
        !matches!(self, Self::Rgb8 | Self::Planes24)
    }
}

impl DisplayConfig {
    /// From the choice of a frame to its vertical blank, without the half of the blank that is added to it, nanoseconds;
    /// `frame_ns`: time of a frame.
    pub fn commit_ns(&self, frame_ns: i64) -> i64 {
        self.commit_us.map_or((frame_ns / 2).min(8_000_000), |us| i64::from(us) * 1000)
    }
}

words! {
    /// What the bits of a display's pixel mean.
    pub enum DisplayEncoding {
        /// Code values: the display shows grey by itself. `projector.response` says how much light a code value gives.
        /// Behind them, a DLPC900 shows three patterns of eight bits: green, red, blue.
        Rgb8 = "rgb8",
        /// The 24 planes of a frame, in the order in which a DLPC900 shows the bits of a pixel: green 0 to 7, red 0 to 7,
        /// blue 0 to 7. In front of a DLPC900 the same as "binary24".
        Planes24 = "planes24",
        /// For a DLPC900: 24 halftones of one bit, red, green and blue in turn.
        Binary24 = "binary24",
        /// For a DLPC900: three white patterns of eight bits.
        Mono8x3 = "mono8x3",
        /// For a DLPC900: four white patterns of six bits, halftoned.
        Mono6x4 = "mono6x4",
        /// For a DLPC900: six white patterns of four bits, halftoned.
        Mono4x6 = "mono4x6",
        /// For a DLPC900: eight white patterns of three bits, halftoned.
        Mono3x8 = "mono3x8",
        /// For a DLPC900: twelve white patterns of two bits, halftoned.
        Mono2x12 = "mono2x12",
        /// For a DLPC900: 24 white halftones of one bit.
        Mono1x24 = "mono1x24",
        /// For a DLPC900: two patterns of four bits for each colour, halftoned.
        Rgb4x2 = "rgb4x2",
        /// For a DLPC900: four patterns of two bits for each colour, halftoned.
        Rgb2x4 = "rgb2x4",
    }
}

words! {
    /// Whether a desktop is asked for a display.
    pub enum DisplayLease {
        /// If another program drives the card.
        Auto = "auto",
        /// Never.
        Off = "off",
        /// The X server of the variable DISPLAY, by RandR 1.6.
        X11 = "x11",
        /// The compositor of the variable WAYLAND_DISPLAY, by wp_drm_lease_device_v1.
        Wayland = "wayland",
    }
}

pub(super) static KIND: ProjectorKind = ProjectorKind::of::<DisplayConfig>(
    "display",
    "display",
    "a display: any projector or monitor on HDMI or DisplayPort.",
    "docs/DISPLAY.md",
)
.by_video(SlotClock::Blanks);

/// From the start of a slot to the middle row of a picture whose blank is chosen `commit_ns` before it: the blank comes that
/// and half of the time without rows later, the middle row half of the rows after it, together half a frame, whatever
/// the mode.
pub(super) fn middle_row_ns(commit_ns: i64, frame_ns: i64) -> i64 {
    commit_ns + frame_ns / 2
}

impl ProjectorKeys for DisplayConfig {
    fn device(&self) -> DeviceName {
        let connector = self.connector.clone();
        DeviceName { named: connector.clone(), connector: Some(connector), ..DeviceName::of(KIND.name) }
    }

    fn check(&self, frames: &FrameKeys, reader: &mut KeyReader) {
        if let Err(e) = self.mode.parse::<ModeWish>() {
            refuse(
                reader,
                &["projector.backend.mode"],
                e.to_string(),
                "`dpm display` lists the modes".into(),
            );
        }
        let encoding = ("projector.backend.encoding", shown(self.encoding));
        let behind = self.dlpc900.get();
        if frames.planes != 24 && (self.encoding != DisplayEncoding::Rgb8 || behind.is_some()) {
            contradict(
                reader,
                &[
                    ("projector.planes", shown(frames.planes)),
                    encoding.clone(),
                    ("projector.backend.kind", format!("{:?}", KIND.word.word)),
                ],
                "a pixel carries 24 planes",
                "set projector.planes = 24".into(),
            );
        }
        if self.encoding.needs_controller() && behind.is_none() {
            contradict(
                reader,
                &[encoding.clone(), ("projector.backend.dlpc900", "not there".into())],
                "only a DLPC900 cuts pixels into such patterns",
                "add the table [projector.backend.dlpc900], or use encoding = \"rgb8\"".into(),
            );
        }
        if self.encoding == DisplayEncoding::Rgb8 && frames.weights == PlaneWeights::Equal && behind.is_none()
        {
            contradict(
                reader,
                &[
                    frames.weights_key(),
                    encoding,
                    ("projector.backend.kind", format!("{:?}", KIND.word.word)),
                ],
                "the bits of a code value have binary weights",
                "leave `projector.weights` out, or use encoding = \"planes24\"".into(),
            );
        }
        if let Some(behind) = behind {
            self.check_weights(frames, reader);
            behind.check(self.encoding.parts(), frames, reader);
        }
    }

    fn plane_timing(&self) -> PlaneTiming {
        match (self.dlpc900.get(), self.encoding) {
            (Some(_), encoding) => match encoding.parts().depth {
                1 => PlaneTiming::Equal,
                planes => PlaneTiming::Together { planes },
            },
            (None, DisplayEncoding::Rgb8) => PlaneTiming::Held,
            (None, _) => PlaneTiming::Equal,
        }
    }

    fn lit_time(&self, frames: &FrameKeys) -> LitTime {
        let behind = self.dlpc900.get();
        behind.map_or(LitTime::all_of(frames.rate), |it| it.lit_time(self.encoding.parts(), frames))
    }

    fn schedule(&self) -> Option<PlaneSchedule> {
        self.dlpc900.get()?;
        match self.encoding.parts() {
            // Colours in turn: a moving edge of grey is less coloured than with eight planes of green, of red, of blue.
            Parts { depth: 1, white: false, .. } => Some(PlaneSchedule::equal_rgb24().filled()),
            parts => PlaneSchedule::of_parts(parts),
        }
    }

    fn is_lit_fully(&self) -> bool {
        true
    }

    /// A controller behind a display shows a frame from the vertical pulse on that follows it.
    fn light_delay_ns(&self, frame_ns: i64) -> i64 {
        // From the vertical pulse before the first row to the one after the last row is a whole frame.
        let behind_ns = if self.dlpc900.get().is_some() { frame_ns / 2 } else { 0 };
        middle_row_ns(self.commit_ns(frame_ns) + behind_ns, frame_ns)
    }

    fn guardian(&self) -> Option<Vec<String>> {
        self.dlpc900.get().map(|behind| behind.guardian())
    }

    fn look(&self, panel: &Panel) -> Result<(), TransportError> {
        let settings = self.settings(panel)?;
        dpm_display::transport::look(self.card.as_deref(), self.access(), &settings)?;
        self.dlpc900.get().map_or(Ok(()), |behind| behind.look())
    }

    fn open(&self, opening: &Opening<'_>) -> Result<Option<Medium>, TransportError> {
        let panel = opening.panel;
        let card = lease::opener(self.card.clone(), self.connector.clone(), self.access());
        let mut opener = on_card(card, self.settings(panel)?);
        if let Some(behind) = self.dlpc900.get() {
            opener = behind.feed(opener, self.encoding.parts(), panel, opening.around)?;
        }
        let mut medium = open_panel(panel, opener)?;
        medium
            .warnings
            .push("a display as projector has not been tried on real hardware yet (docs/DISPLAY.md)".into());
        if let Some(behind) = self.dlpc900.get() {
            medium.warnings.push(behind.warning().into());
        } else if self.encoding == DisplayEncoding::Rgb8 {
            medium.warnings.extend(linear_code_values(panel));
        }
        Ok(Some(medium))
    }
}

impl DisplayConfig {
    /// The weights of planes behind a controller are those of its patterns.
    fn check_weights(&self, frames: &FrameKeys, reader: &mut KeyReader) {
        let weights = self.encoding.weights();
        if !reader.is_written("projector.weights") || frames.weights == weights {
            return;
        }
        let why = match weights {
            PlaneWeights::Equal => "a DLPC900 lights all planes of a pixel equally long",
            PlaneWeights::Binary | PlaneWeights::Split | PlaneWeights::Auto => {
                "a DLPC900 weights the bits of a pattern itself"
            }
        };
        let keys = [frames.weights_key(), ("projector.backend.encoding", shown(self.encoding))];
        contradict(reader, &keys, why, "leave `projector.weights` out: the encoding decides it".into());
    }

    /// What the display is set up with.
    ///
    /// # Errors
    /// The mode is none; the check of the rig file has refused it.
    pub fn settings(&self, panel: &Panel) -> Result<DisplaySettings, TransportError> {
        let no_mode =
            |why: String| TransportError::Unsuitable { device: "projector.backend.mode".into(), why };
        Ok(DisplaySettings {
            connector: self.connector.clone(),
            mode: self.mode.parse::<ModeWish>().map_err(|e| no_mode(e.to_string()))?,
            encoding: match self.encoding {
                DisplayEncoding::Rgb8 => Encoding::Rgb8,
                _ => Encoding::Planes24,
            },
            without: self.without.clone(),
            commit_ns: self.commit_ns(panel.rate.slot_len_ns(0)),
            shows_at_pulse: self.dlpc900.get().is_some(),
            raster: panel.raster,
            schedule: panel.schedule,
            rate: panel.rate,
        })
    }

    /// How the rig comes by its display.
    fn access(&self) -> Access {
        match self.lease {
            DisplayLease::Auto => Access::Auto,
            DisplayLease::Off => Access::Alone,
            DisplayLease::X11 => Access::Lent(Lender::X11),
            DisplayLease::Wayland => Access::Lent(Lender::Wayland),
        }
    }
}

/// A panel in this process behind what `opener` opens.
pub(super) fn open_panel(panel: &Panel, opener: Opener) -> Result<Medium, TransportError> {
    // Blanks are milliseconds apart: no thread needs to spin for them. The panel stands for another machine, so no stage may
    // delay it.
    let above = if panel.priority > 0 { (panel.priority + 1).min(99) } else { 0 };
    let transport = DisplayTransport::open(opener, WaitPolicy::Park, above)?;
    let warnings = transport.warnings().to_vec();
    Ok(Medium { transport: Box::new(transport), warnings })
}

/// What to tell of code values that are said to be linear.
pub(super) fn linear_code_values(panel: &Panel) -> Option<String> {
    panel.is_linear.then(|| {
        "projector.response is \"linear\", which no display's code values are: grey will be too bright; write \
         response = { kind = \"srgb\" }, or measure it"
            .into()
    })
}
