//! The kinds of sources of pictures: one row each.

use crate::source::{PictureSource, SourceKind};
use crate::stream;
use dpm_device::time::HostClock;
use std::sync::Arc;

/// One row a kind.
static SOURCES: &[&SourceKind] = &[&stream::KIND];

/// Opens the source of a device, such as `tcp:127.0.0.1:8951`. A camera that does not answer yet is no error: a source connects
/// when it is asked for a picture.
///
/// # Errors
/// No kind of sources has such devices, or its own kind does not take it.
pub fn open_source(device: &str, clock: &Arc<dyn HostClock>) -> Result<Box<dyn PictureSource>, String> {
    let found = SOURCES.iter().find_map(|kind| Some((kind, device.strip_prefix(kind.prefix)?)));
    let (kind, place) = found.ok_or_else(|| {
        let forms: Vec<&str> = SOURCES.iter().map(|kind| kind.form).collect();
        format!("{device:?} cannot be opened by this build; write {}", forms.join(" or "))
    })?;
    (kind.open)(place, clock)
}
