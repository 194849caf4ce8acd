//! `projector.backend.kind = "window"`: a window on the desktop.

use super::display::{linear_code_values, middle_row_ns, open_panel};
use super::keys::{DeviceName, FrameKeys, Medium, Opening, Panel, ProjectorKeys};
use super::kind::{ProjectorKind, SlotClock};
use super::light::{PlaneTiming, PlaneWeights};
use dpm_common::keys::read::{contradict, KeyReader, NotEmpty, Within};
use dpm_common::section;
use dpm_device::transport::TransportError;
use dpm_display::window::{self, interrupt_program, WindowSettings};

section! {
    /// A window on the desktop of this machine, for previews and for a desk without a projector. docs/DISPLAY.md says what it
    /// is good for. Closing it ends the run.
    pub struct WindowConfig {
        /// The monitor that the window fills, by the name that a start lists, for example "HDMI-1". `projector.width`
        /// and `height` must be the monitor's, and `frame_rate` within one percent of its rate. An ordinary window if
        /// left out.
        monitor: Option<String> = None, "", NotEmpty;
        /// The X server, for example ":0"; the one of the environment variable DISPLAY if left out.
        server: Option<String> = None, "", NotEmpty;
        /// How long before its vertical blank a frame is chosen and sent to the X server; three quarters of a frame if
        /// left out.
        commit_us: Option<u32> = None, "us", Within(100, 35_000);
    }
}

impl WindowConfig {
    /// From the choice of a frame to its vertical blank, nanoseconds; `frame_ns`: time of a frame.
    fn commit_ns(&self, frame_ns: i64) -> i64 {
        self.commit_us.map_or(frame_ns / 4 * 3, |us| i64::from(us) * 1000)
    }
}

pub(super) static KIND: ProjectorKind = ProjectorKind::of::<WindowConfig>(
    "window",
    "window",
    "a window on the desktop, for a desk without a projector.",
    "docs/DISPLAY.md",
)
.by_video(SlotClock::Blanks);

impl WindowConfig {
    fn settings(&self, panel: &Panel) -> WindowSettings {
        WindowSettings {
            server: self.server.clone(),
            monitor: self.monitor.clone(),
            commit_ns: self.commit_ns(panel.rate.slot_len_ns(0)),
            raster: panel.raster,
            schedule: panel.schedule,
            rate: panel.rate,
        }
    }
}

impl ProjectorKeys for WindowConfig {
    fn device(&self) -> DeviceName {
        DeviceName { is_single: true, ..DeviceName::of(KIND.name) }
    }

    fn check(&self, frames: &FrameKeys, reader: &mut KeyReader) {
        if frames.weights == PlaneWeights::Equal {
            let why = "a window shows code values, whose bits have binary weights";
            let backend = ("projector.backend.kind", format!("{:?}", KIND.word.word));
            let remedy = "leave `projector.weights` out";
            contradict(reader, &[frames.weights_key(), backend], why, remedy.into());
        }
    }

    fn plane_timing(&self) -> PlaneTiming {
        PlaneTiming::Held
    }

    fn is_lit_fully(&self) -> bool {
        true
    }

    fn light_delay_ns(&self, frame_ns: i64) -> i64 {
        middle_row_ns(self.commit_ns(frame_ns), frame_ns)
    }

    fn look(&self, panel: &Panel) -> Result<(), TransportError> {
        window::look(&self.settings(panel))
    }

    fn open(&self, opening: &Opening<'_>) -> Result<Option<Medium>, TransportError> {
        let opener = window::opener(self.settings(opening.panel), interrupt_program);
        let mut medium = open_panel(opening.panel, opener)?;
        medium.warnings.extend(linear_code_values(opening.panel));
        Ok(Some(medium))
    }
}
