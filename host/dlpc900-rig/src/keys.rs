//! `projector.backend.kind = "dlpc900"`: a TI DLPC900 whose frames are loaded before they are shown.

use dpm_common::keys::read::{contradict, shown, Any, KeyReader, NotEmpty, Within};
use dpm_common::{section, words};
use dpm_dlpc900::driver::Dlpc900;
use dpm_dlpc900::lut::Dmd;
use dpm_dlpc900::usb::{describe, UsbHid, UsbPlace, PRODUCT, VENDOR};
use dpm_dlpc900::video::Receiver;
use dpm_rig::projectors::{
    DeviceLook, DeviceName, FrameKeys, LitTime, PlaneTiming, PlaneWeights, ProjectorKeys, ProjectorKind,
    SlotClock,
};

/// What an operator of a DLPC900 must know.
pub const NO_WATCHDOG: &str =
    "a DLPC900 has no watchdog: if this machine fails, or this program and its guard process are both killed, it continues \
     to show its patterns; `dpm dlpc900 idle` ends that";

section! {
    /// A TI DLPC900 evaluation module (LightCrafter 6500 and 9000). docs/DLPC900.md says what a rig does with it.
    pub struct Dlpc900Config {
        /// The panel at the controller; it must have the projector's width and height.
        panel: Dlpc900Panel = Dlpc900Panel::Dlp6500, "", Any;
        /// Source of its patterns.
        mode: Dlpc900Mode = Dlpc900Mode::Preloaded, "", Any;
        /// Its video input in mode "video".
        input: VideoInput = VideoInput::Hdmi, "", Any;
        /// The controller, as BUS:ADDRESS in `lsusb`; needed if several are plugged in.
        device: Option<String> = None, "", NotEmpty;
        /// Exposure of each pattern; its whole share of the frame if left out.
        exposure_us: Option<u32> = None, "us", Within(24, 2_000_000);
    }
}

words! {
    /// Panels of a DLPC900.
    pub enum Dlpc900Panel {
        /// 1920 x 1080.
        Dlp6500 = "dlp6500",
        /// 2560 x 1600.
        Dlp9000 = "dlp9000",
        /// 2716 x 1600.
        Dlp670s = "dlp670s",
        /// 2048 x 1200.
        Dlp500yx = "dlp500yx",
        /// 1024 x 768.
        Dlp5500 = "dlp5500",
    }
}

impl Dlpc900Panel {
    /// The panel in the driver's type.
    pub const fn dmd(self) -> Dmd {
        match self {
            Self::Dlp6500 => Dmd::Dlp6500,
            Self::Dlp9000 => Dmd::Dlp9000,
            Self::Dlp670s => Dmd::Dlp670s,
            Self::Dlp500yx => Dmd::Dlp500yx,
            Self::Dlp5500 => Dmd::Dlp5500,
        }
    }
}

words! {
    /// Source of a DLPC900's patterns.
    pub enum Dlpc900Mode {
        /// The first frames of the known motion, which are rendered and loaded in advance and then shown repeatedly.
        Preloaded = "preloaded",
        /// The 24 planes of a video signal that another program drives.
        Video = "video",
    }
}

words! {
    /// Video inputs of a DLPC900.
    pub enum VideoInput {
        /// HDMI.
        Hdmi = "hdmi",
        /// DisplayPort.
        DisplayPort = "displayport",
        /// The parallel port.
        Parallel = "parallel",
    }
}

impl VideoInput {
    /// The receiver in the driver's type.
    pub const fn receiver(self) -> Receiver {
        match self {
            Self::Hdmi => Receiver::Hdmi,
            Self::DisplayPort => Receiver::DisplayPort,
            Self::Parallel => Receiver::None,
        }
    }
}

/// Its word in a rig file, and the name of its command and of its table behind a display.
pub(crate) const WORD: &str = "dlpc900";

/// Its row in the table of projectors.
pub static KIND: ProjectorKind = ProjectorKind::of::<Dlpc900Config>(
    WORD,
    "DLPC900",
    "a TI DLPC900 evaluation module, driven by its USB HID commands.",
    "docs/DLPC900.md",
)
.loaded(&crate::OWN_RUN)
.by_video(SlotClock::Firmware)
.by_usb(VENDOR, PRODUCT, "TI DLPC900");

impl ProjectorKeys for Dlpc900Config {
    fn device(&self) -> DeviceName {
        DeviceName { named: self.device.clone(), is_lasting: false, ..DeviceName::of(KIND.name) }
    }

    fn check(&self, frames: &FrameKeys, reader: &mut KeyReader) {
        check_panel(frames, WORD, "projector.backend.panel", self.panel, reader);
        let backend = || ("projector.backend.kind", format!("{WORD:?}"));
        if frames.weights == PlaneWeights::Equal {
            let why = "a DLPC900 weights the bits of loaded frames itself";
            let remedy = "leave `projector.weights` out";
            contradict(reader, &[frames.weights_key(), backend()], why, remedy.into());
        }
        if u64::from(frames.rate.num()) > 120 * u64::from(frames.rate.den()) {
            contradict(
                reader,
                &[("projector.frame_rate", shown(frames.rate)), backend()],
                "a DLPC900 shows at most 120 frames/s of 24 planes",
                "lower `projector.frame_rate` to 120 or choose another backend".into(),
            );
        }
    }

    fn plane_timing(&self) -> PlaneTiming {
        match self.mode {
            Dlpc900Mode::Preloaded => PlaneTiming::ByChannel,
            Dlpc900Mode::Video => PlaneTiming::Equal,
        }
    }

    /// One loaded pattern for each colour.
    fn lit_time(&self, frames: &FrameKeys) -> LitTime {
        let whole = LitTime::all_of(frames.rate);
        let share_ns = whole.frame_ns / i64::from((frames.planes / 8).max(1));
        let lit_ns = self.exposure_us.map_or(share_ns, |us| (i64::from(us) * 1000).min(share_ns));
        LitTime { dark_ns: share_ns - lit_ns, ..whole }
    }

    fn is_lit_by_video_input(&self) -> bool {
        self.mode == Dlpc900Mode::Video
    }

    fn guardian(&self) -> Option<Vec<String>> {
        Some(guardian_of(self.device.as_deref()))
    }

    fn examine(&self, _: bool) -> Option<Result<DeviceLook, String>> {
        Some(examined(self.device.as_deref()))
    }
}

/// The words of the command that puts the controller at `device` to rest.
pub(crate) fn guardian_of(device: Option<&str>) -> Vec<String> {
    let place = device.into_iter().flat_map(|place| ["--device", place]);
    [WORD, "guard"].into_iter().chain(place).map(str::to_owned).collect()
}

fn examined(device: Option<&str>) -> Result<DeviceLook, String> {
    let place =
        device.map(|text| text.parse::<UsbPlace>().map_err(|e| format!("{text}: {e}"))).transpose()?;
    let named = |e: String| format!("{}: {e}", describe(place));
    let port = UsbHid::open(place).map_err(|e| named(e.to_string()))?;
    let mut controller = Dlpc900::new(port).map_err(|e| named(e.to_string()))?;
    let status = controller.status().map_err(|e| named(e.to_string()))?;
    let lines: Vec<String> = status.to_string().lines().map(|l| l.trim().to_owned()).collect();
    Ok(DeviceLook { found: lines.join("; "), is_doubtful: false, remedy: String::new() })
}

/// A controller's panel has as many mirrors as the projector, of kind `kind`.
pub(crate) fn check_panel(
    frames: &FrameKeys,
    kind: &str,
    key: &str,
    panel: Dlpc900Panel,
    reader: &mut KeyReader,
) {
    let raster = panel.dmd().raster();
    if frames.size != [raster.width(), raster.height()] {
        contradict(
            reader,
            &[
                ("projector.width", shown(frames.size[0])),
                ("projector.height", shown(frames.size[1])),
                (key, shown(panel)),
                ("projector.backend.kind", format!("{kind:?}")),
            ],
            &format!("a {} has {} x {} mirrors", panel.dmd().name(), raster.width(), raster.height()),
            format!("set projector.width = {} and projector.height = {}", raster.width(), raster.height()),
        );
    }
}
