//! Pinhole and lens of the camera.

use super::CameraTrackerConfig;
use crate::trackers::SourceError;
use dpm_device::planes::Raster;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::DVec3;
use std::path::Path;

/// The camera of the calibration file, or a pinhole.
pub(super) fn camera(keys: &CameraTrackerConfig) -> Result<ProjectorCamera, SourceError> {
    let [w, h] = keys.size;
    let raster = Raster::new(w, h);
    let raster =
        raster.ok_or_else(|| SourceError::of_key("tracker.size", format!("{w} x {h} is no raster")))?;
    match &keys.calibration {
        Some(path) => stored(path, raster).map_err(|e| SourceError::of_key("tracker.calibration", e)),
        None => {
            let view = keys.view_deg.to_radians();
            let camera = ProjectorCamera::look_at(raster, DVec3::ZERO, DVec3::NEG_Z, DVec3::Y, view);
            camera.map_err(|e| SourceError::of_key("tracker.view_deg", e.to_string()))
        }
    }
}

#[cfg(feature = "camera-files")]
fn stored(path: &Path, raster: Raster) -> Result<ProjectorCamera, String> {
    use dpm_camera_files::{read_lens, LengthUnit, LensKind, ReadOptions, MAX_BYTES};
    let named = |e: String| format!("{}: {e}", path.display());
    let bytes = dpm_device::regular_file::read(path, MAX_BYTES as u64).map_err(|e| named(e.to_string()))?;
    let options =
        ReadOptions { raster, unit: LengthUnit::Metre, lens: LensKind::Auto, region: None, device: None };
    Ok(read_lens(&bytes, &options).map_err(|e| named(e.to_string()))?.camera)
}

#[cfg(not(feature = "camera-files"))]
fn stored(path: &Path, _: Raster) -> Result<ProjectorCamera, String> {
    Err(format!("{}: this program was built without its feature \"camera-files\"", path.display()))
}
