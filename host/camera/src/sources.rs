//! The kinds of sources of pictures: one row each.

use crate::source::{CameraDoubt, CameraLook, PictureRequest, PictureSource, SourceKind};
use crate::{stream, v4l2};
use dpm_device::time::HostClock;
use std::sync::Arc;

/// One row a kind.
static SOURCES: &[&SourceKind] = &[&v4l2::KIND, &stream::KIND];

fn found(device: &str) -> Result<(&'static SourceKind, &str), String> {
    let found = SOURCES.iter().find_map(|kind| Some((*kind, (kind.place)(device)?)));
    found.ok_or_else(|| {
        let forms: Vec<&str> = SOURCES.iter().map(|kind| kind.form).collect();
        format!("{device:?} cannot be opened by this build; write {}", forms.join(" or "))
    })
}

/// Opens the source of a device, such as `/dev/video0` or `tcp:127.0.0.1:8951`. A camera that does not answer yet is no error:
/// a source connects when it is asked for a picture.
///
/// # Errors
/// No kind of sources has such devices, or its own kind does not take it.
pub fn open_source(
    device: &str,
    request: &PictureRequest,
    clock: &Arc<dyn HostClock>,
) -> Result<Box<dyn PictureSource>, String> {
    let (kind, place) = found(device)?;
    (kind.open)(place, request, clock)
}

/// Looks at the camera of a device; `None` if its kind has nothing to see beyond the pictures.
///
/// # Errors
/// It cannot be used.
pub fn examine_source(device: &str, request: &PictureRequest) -> Option<Result<CameraLook, CameraDoubt>> {
    let (kind, place) = found(device).ok()?;
    Some((kind.examine?)(place, request))
}
