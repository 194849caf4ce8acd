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
}

/// Opens a source by what follows its prefix. The stamps of its pictures go onto the clock.
pub type SourceOpener = fn(&str, &Arc<dyn HostClock>) -> Result<Box<dyn PictureSource>, String>;

/// A kind of sources: a row of the table in `sources.rs`.
pub struct SourceKind {
    /// What its devices begin with.
    pub prefix: &'static str,
    /// What a device looks like, for messages.
    pub form: &'static str,
    /// Opens one.
    pub open: SourceOpener,
}
