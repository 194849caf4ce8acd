//! A calibration file of another program into the projector's camera.

use crate::config::ProjectorConfig;
use dpm_device::planes::Raster;
use dpm_scene::geometry::projector::ProjectorCamera;
use std::path::Path;

/// A calibration file cannot be used.
#[derive(Clone, Debug, thiserror::Error)]
#[error("{key}: {path}: {message}")]
pub struct CameraFileError {
    /// Configuration key.
    pub key: &'static str,
    /// Path of the file.
    pub path: String,
    /// What is wrong.
    pub message: String,
}

/// The projector that the file at `path` describes, at `raster`. Adds to `warnings` what was not read of the file.
///
/// # Errors
/// The file cannot be read, or does not describe a projector of this rig. The error says what to change.
#[cfg(feature = "camera-files")]
pub(crate) fn calibrated_camera(
    p: &ProjectorConfig,
    path: &Path,
    raster: Raster,
    warnings: &mut Vec<String>,
) -> Result<ProjectorCamera, CameraFileError> {
    use crate::config::{CalibrationLens, CalibrationUnit};
    use dpm_camera_files::{self as camera_files, LengthUnit, LensKind, PoseFrame, ReadOptions};
    let wrong = |message: String| CameraFileError {
        key: "projector.calibration",
        path: path.display().to_string(),
        message,
    };
    let unit = match p.calibration_unit {
        Some(CalibrationUnit::Metre) => LengthUnit::Metre,
        Some(CalibrationUnit::Centimetre) => LengthUnit::Centimetre,
        Some(CalibrationUnit::Millimetre) => LengthUnit::Millimetre,
        None => return Err(wrong("projector.calibration_unit is missing".into())),
    };
    let lens = match p.calibration_lens {
        CalibrationLens::Auto => LensKind::Auto,
        CalibrationLens::Fisheye => LensKind::Fisheye,
    };
    let bytes = dpm_device::regular_file::read(path, camera_files::MAX_BYTES as u64)
        .map_err(|e| wrong(e.to_string()))?;
    let region = p.calibration_region.as_deref();
    let device = p.calibration_device.as_deref();
    let options = ReadOptions { raster: p.calibrated_raster(), unit, lens, region, device };
    let stored = camera_files::read(&bytes, &options).map_err(|e| wrong(e.to_string()))?;
    if !stored.unread.is_empty() {
        let names = stored.unread.join(", ");
        warnings.push(format!("projector.calibration: {}: was not read: {names}", path.display()));
    }
    let told = |note: &String| format!("projector.calibration: {}: {note}", path.display());
    warnings.extend(stored.notes.iter().map(told));
    let place = p.calibration_camera.as_ref().map(|pose| pose.to_affine());
    let camera = match (&stored.frame, place) {
        (PoseFrame::World, None) => stored.camera,
        (PoseFrame::WorldOfCamera { name }, None) => {
            warnings.push(told(&format!(
                "the origin of its world is {name:?}; if the tracker's is another, set projector.calibration_camera to the \
                 camera's pose in the tracker's world"
            )));
            stored.camera
        }
        // A quaternion of length zero was refused when the configuration was read.
        (PoseFrame::Camera { .. } | PoseFrame::WorldOfCamera { .. }, Some(place)) => stored.seen_from(place.unwrap_or_default()),
        (PoseFrame::Camera { name }, None) => {
            return Err(wrong(format!(
                "its origin is the camera that calibrated it ({name:?} shows that), so the projector's place in the world is \
                 unknown; set projector.calibration_camera to the camera's pose in the world"
            )))
        }
        (PoseFrame::World, Some(_)) => {
            return Err(wrong(
                "projector.calibration_camera is set, but the file tells the projector's place in its own world and not in a \
                 camera's frame; remove projector.calibration_camera"
                    .into(),
            ))
        }
    };
    Ok(camera.at_raster(raster))
}

/// Refuses the file: this program was built without its readers.
#[cfg(not(feature = "camera-files"))]
pub(crate) fn calibrated_camera(
    _: &ProjectorConfig,
    path: &Path,
    _: Raster,
    _: &mut Vec<String>,
) -> Result<ProjectorCamera, CameraFileError> {
    Err(CameraFileError {
        key: "projector.calibration",
        path: path.display().to_string(),
        message: "this program was built without its feature \"camera-files\", which reads calibration files of other \
                  programs; build it with that feature, or use [projector] and calibration.file"
            .into(),
    })
}
