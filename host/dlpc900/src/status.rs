//! What a poll of the controller yields.

use super::lut::{DisplayMode, Dmd};
use super::sequence::Version;
use std::fmt;

/// Everything that one poll of the controller yields.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Status {
    /// Firmware.
    pub firmware: Version,
    /// DMD.
    pub dmd: Dmd,
    /// The firmware's tag, such as `DLPR900PROM-6500`.
    pub tag: String,
    /// Display mode; `None` for a byte without a meaning.
    pub mode: Option<DisplayMode>,
    /// Hardware status byte (0x1A0A).
    pub hardware: u8,
    /// System status byte (0x1A0B).
    pub system: u8,
    /// Main status byte (0x1A0C).
    pub main: u8,
}

impl Status {
    /// Mirrors parked.
    pub const fn is_parked(&self) -> bool {
        self.main & 1 != 0
    }
    /// A sequence runs.
    pub const fn is_running(&self) -> bool {
        self.main & 2 != 0
    }
    /// The video source is locked.
    pub const fn is_locked(&self) -> bool {
        self.main & 8 != 0
    }

    /// A sequence was aborted: the patterns of a video frame had not ended when the next frame began.
    pub const fn is_aborted(&self) -> bool {
        self.hardware & 0x40 != 0
    }

    /// The errors in the hardware bits, if any.
    pub fn complaint(&self) -> Option<String> {
        let bits = [
            (self.hardware & 0x01 == 0, "initialisation failed"),
            (self.hardware & 0x02 != 0, "an incompatible DMD"),
            (self.hardware & 0x04 != 0, "a DMD reset controller error"),
            (self.hardware & 0x08 != 0, "a forced buffer swap"),
            (self.hardware & 0x40 != 0, "a sequencer abort"),
            (self.hardware & 0x80 != 0, "a sequencer error"),
            (self.system & 0x01 == 0, "a failed memory test"),
        ];
        let found: Vec<_> = bits.iter().filter(|b| b.0).map(|b| b.1).collect();
        (!found.is_empty()).then(|| found.join(", "))
    }
}

/// One fact per line, for the operator.
impl fmt::Display for Status {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let raster = self.dmd.raster();
        let word = |yes: bool| if yes { "yes" } else { "no" };
        let mode = self.mode.map_or("unknown".to_owned(), |m| format!("{m:?}"));
        writeln!(f, "dmd          {} ({} x {})", self.dmd.name(), raster.width(), raster.height())?;
        writeln!(f, "firmware     {} ({})", self.firmware, self.tag)?;
        if self.firmware.locks_blocks() {
            writeln!(f, "             this firmware locks mirror blocks after a mode switch; dpm parks and unparks to free them")?;
        }
        writeln!(f, "mode         {mode}")?;
        writeln!(f, "running      {}", word(self.is_running()))?;
        writeln!(f, "parked       {}", word(self.is_parked()))?;
        writeln!(f, "video locked {}", word(self.is_locked()))?;
        writeln!(f, "hardware     {}", self.complaint().unwrap_or_else(|| "ok".into()))
    }
}
