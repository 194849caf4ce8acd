//! Where pictures come from: one trait for a camera of the machine and for a mock.

use dpm_device::time::{HostClock, HostTime};
use std::sync::Arc;
use std::time::Duration;

/// A grey picture and when it was exposed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Picture {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` bytes, rows from above.
    pub pixels: Vec<u8>,
    /// The source's number of the picture; wraps.
    pub number: u32,
    /// Begin of the exposure of the first row, on the host's clock.
    pub begin: HostTime,
    /// Exposure of a row, ns.
    pub exposure_ns: i64,
    /// By how much later each row is exposed than the one above it, ns; 0 for a global shutter.
    pub row_ns: i64,
}

/// Pictures that a source has not handed on, since it was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PictureLosses {
    /// Missing by the device's own numbers.
    pub lost: u64,
    /// Marked as damaged, or too short.
    pub damaged: u64,
    /// Overtaken by a newer one before anybody looked.
    pub passed_over: u64,
}

impl PictureLosses {
    /// All of them.
    pub const fn all(&self) -> u64 {
        self.lost + self.damaged + self.passed_over
    }
}

/// What a rig file asks of a camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PictureRequest {
    /// Columns and rows.
    pub size: [u32; 2],
    /// Pictures per second.
    pub rate_hz: u32,
    /// Exposure of a row, microseconds; `None` leaves the camera as it is.
    pub exposure_us: Option<u32>,
    /// Gain, in the camera's own units; `None` leaves the camera as it is.
    pub gain: Option<u32>,
    /// From the exposure of the first row to that of the last, microseconds; 0 for a global shutter.
    pub readout_us: u32,
}

/// What speaks against a camera, and what to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CameraDoubt {
    /// What was found.
    pub found: String,
    /// What to do.
    pub remedy: String,
}

impl CameraDoubt {
    pub(crate) fn new(found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { found: found.into(), remedy: remedy.into() }
    }
}

impl std::fmt::Display for CameraDoubt {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}; {}", self.found, self.remedy)
    }
}

/// What a look at a camera found.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CameraLook {
    /// What it is and what it gives.
    pub found: String,
    /// What speaks against it, though it can be used.
    pub doubts: Vec<CameraDoubt>,
}

/// A source of pictures.
pub trait PictureSource: Send {
    /// Waits for the next picture, at most for `timeout`, and puts it into `picture`. False if none came. If several wait, the
    /// newest counts: an old picture is of no use.
    ///
    /// # Errors
    /// The camera cannot be opened or was lost; the text says which one and what to try. The next call tries again.
    fn next(&mut self, timeout: Duration, picture: &mut Picture) -> Result<bool, String>;

    /// What and where it is, for messages.
    fn name(&self) -> &str;

    /// What it did not hand on.
    fn losses(&self) -> PictureLosses {
        PictureLosses::default()
    }
}

/// Opens a source by what follows its prefix. The stamps of its pictures go onto the clock.
pub type SourceOpener =
    fn(&str, &PictureRequest, &Arc<dyn HostClock>) -> Result<Box<dyn PictureSource>, String>;

/// Looks at the camera of a source for a second or two.
pub type SourceExaminer = fn(&str, &PictureRequest) -> Result<CameraLook, CameraDoubt>;

/// A kind of sources: a row of the table in `sources.rs`.
pub struct SourceKind {
    /// The place in a device that is one of this kind.
    pub place: fn(&str) -> Option<&str>,
    /// What a device looks like, for messages.
    pub form: &'static str,
    /// Opens one.
    pub open: SourceOpener,
    /// Looks at one; `None` if there is nothing to see beyond its pictures.
    pub examine: Option<SourceExaminer>,
}

/// A clock less CLOCK_MONOTONIC, nanoseconds, within the time between two readings of the latter that are next to each other.
pub(crate) fn offset_ns(clock: &dyn HostClock) -> i64 {
    let once = || {
        let before = dpm_common::unix::monotonic_ns() as i64;
        let now = clock.now().0;
        let after = dpm_common::unix::monotonic_ns() as i64;
        (after - before, now - (before + (after - before) / 2))
    };
    // A thread that lost its core between two readings makes one of them wide; the narrowest is within a microsecond.
    (0..16).map(|_| once()).min().map_or(0, |(_, offset)| offset)
}
