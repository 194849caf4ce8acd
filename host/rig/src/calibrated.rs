//! A calibration file into the projector's camera.

use crate::config::{CalibrationUnit, ProjectorConfig};
use dpm_device::planes::Raster;
use dpm_device::regular_file;
use dpm_scene::camera_files::{self, Frame, LengthUnit, ReadOptions};
use dpm_scene::geometry::projector::ProjectorCamera;
use std::path::Path;

/// The calibration file cannot be used.
#[derive(Clone, Debug, thiserror::Error)]
#[error("projector.calibration: {path}: {message}")]
pub struct CameraFileError {
    /// Path of the file.
    pub path: String,
    /// What is wrong.
    pub message: String,
}

/// The projector that the file at `path` describes, at `raster`. Adds to `warnings` what was not read of the file.
///
/// # Errors
/// The file cannot be read, or does not describe a projector of this rig. The error says what to change.
pub(crate) fn calibrated_camera(
    p: &ProjectorConfig,
    path: &Path,
    raster: Raster,
    warnings: &mut Vec<String>,
) -> Result<ProjectorCamera, CameraFileError> {
    let wrong = |message: String| CameraFileError { path: path.display().to_string(), message };
    let unit = match p.calibration_unit {
        Some(CalibrationUnit::Metre) => LengthUnit::Metre,
        Some(CalibrationUnit::Millimetre) => LengthUnit::Millimetre,
        None => return Err(wrong("projector.calibration_unit is missing".into())),
    };
    let bytes = regular_file::read(path, camera_files::MAX_BYTES as u64).map_err(|e| wrong(e.to_string()))?;
    let (lens, region) = (p.calibration_lens.lens(), p.calibration_region.as_deref());
    let options = ReadOptions { raster: p.calibrated_raster(), unit, lens, region };
    let stored = camera_files::read(&bytes, &options).map_err(|e| wrong(e.to_string()))?;
    if !stored.unread.is_empty() {
        let names = stored.unread.join(", ");
        warnings.push(format!("projector.calibration: {}: was not read: {names}", path.display()));
    }
    let place = p.calibration_camera.as_ref().map(|pose| pose.to_affine());
    let camera = match (&stored.frame, place) {
        (Frame::World, None) => stored.camera,
        // A quaternion of length zero was refused when the configuration was read.
        (Frame::Camera { .. }, Some(place)) => stored.seen_from(place.unwrap_or_default()),
        (Frame::Camera { name }, None) => {
            return Err(wrong(format!(
                "its origin is the camera that calibrated it ({name:?} shows that), so the projector's place in the world is \
                 unknown; set projector.calibration_camera to the camera's pose in the world"
            )))
        }
        (Frame::World, Some(_)) => {
            return Err(wrong(
                "projector.calibration_camera is set, but the file tells the projector's place in its own world and not in a \
                 camera's frame; remove projector.calibration_camera"
                    .into(),
            ))
        }
    };
    Ok(camera.at_raster(raster))
}

#[cfg(test)]
mod tests {
    use crate::config::{Overrides, RigConfig};
    use crate::rig::Rig;
    use dpm_device::planes::Raster;
    use glam::{DVec2, DVec3};
    use std::path::{Path, PathBuf};

    fn asset(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/assets").join(name)
    }

    /// The demo's rig with a calibration file and more keys.
    fn rig(file: &Path, raster: Option<Raster>, keys: &[&str]) -> Result<Rig, String> {
        let mut flags: Vec<String> = keys.iter().map(|k| (*k).to_owned()).collect();
        flags.push(format!("projector.calibration={:?}", file.display().to_string()));
        flags.push("projector.calibration_unit=\"metre\"".into());
        let config = RigConfig::demo(&Overrides { variables: vec![], flags }).map_err(|e| e.to_string())?;
        Rig::build(&config, raster).map_err(|e| e.to_string())
    }

    /// The first and last golden pair of a model: world point and OpenCV's pixel, in this project's convention.
    fn golden(model: &str) -> [(DVec3, DVec2); 2] {
        let text = std::fs::read_to_string(asset(&format!("opencv/{model}.csv"))).unwrap();
        let rows: Vec<&str> = text.lines().skip(1).collect();
        [rows[0], rows[rows.len() - 1]].map(|row| {
            let v: Vec<f64> = row.split(',').map(|n| n.parse().unwrap()).collect();
            (DVec3::new(v[0], v[1], v[2]), DVec2::new(v[3] + 0.5, v[4] + 0.5))
        })
    }

    fn written(name: &str, text: &str) -> PathBuf {
        let path = std::env::temp_dir().join(format!("dpm-calibrated-{}-{name}", std::process::id()));
        std::fs::write(&path, text).unwrap();
        path
    }

    #[test]
    fn a_file_of_another_raster_is_scaled_to_the_rigs_and_then_to_the_traced_one() {
        let model = "brown5";
        let file = asset("opencv/brown5.yml");
        // The file is for 1024 x 768. The projector has twice as many pixels each way, and half of the file's are traced.
        let keys = ["projector.width=2048", "projector.height=1536"];
        let rig = rig(&file, Raster::new(512, 384), &keys).unwrap();
        for (world, pixel) in golden(model) {
            let got = rig.camera.project(world).unwrap();
            assert!((got - pixel / 2.0).length() < 1e-6, "{got} {pixel}");
        }
        assert!(rig.scene.warnings.iter().all(|w| !w.contains("calibration")), "{:?}", rig.scene.warnings);
        let told = self::rig(&file, None, &["projector.width=1280", "projector.height=800"]);
        let told = told.err().unwrap();
        assert!(told.contains("1024 x 768") && told.contains("1280 x 800"), "{told}");
        // The key that names the file's raster is held to what the file says.
        let told = self::rig(&file, None, &["projector.calibration_raster=[1280, 1024]"]).err().unwrap();
        assert!(told.contains("1280 x 1024"), "{told}");
    }

    #[test]
    fn a_matrix_that_is_not_read_is_a_warning() {
        let text = std::fs::read_to_string(asset("opencv/brown4.yml")).unwrap();
        let file = written("unread.yml", &text.replace("distortion_coefficients", "distorsion"));
        let rig = rig(&file, None, &[]).unwrap();
        let told = rig.scene.warnings.iter().find(|w| w.contains("distorsion"));
        assert!(told.is_some_and(|w| w.contains("not read")), "{:?}", rig.scene.warnings);
        std::fs::remove_file(file).unwrap();
    }

    #[test]
    fn a_file_in_a_cameras_frame_needs_the_cameras_pose_and_no_other_takes_it() {
        let text = std::fs::read_to_string(asset("opencv/brown5.yml")).unwrap();
        let file = written("camera.yml", &text.replace("rvec", "R_cp").replace("tvec", "T_cp"));
        let told = rig(&file, None, &[]).err().unwrap();
        assert!(told.contains("R_cp") && told.contains("set projector.calibration_camera"), "{told}");
        // The camera stands at (1, 2, 3), turned about the world's x and then about z.
        let (x, z) = (30f64.to_radians(), 90f64.to_radians());
        let place = |p: DVec3| {
            let p = DVec3::new(p.x, p.y * x.cos() - p.z * x.sin(), p.y * x.sin() + p.z * x.cos());
            DVec3::new(1.0 + p.x * z.cos() - p.y * z.sin(), 2.0 + p.x * z.sin() + p.y * z.cos(), 3.0 + p.z)
        };
        let (c, s) = ((0.5 * x).cos(), (0.5 * x).sin());
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let quaternion = format!("[{}, {}, {}, {}]", half * s, half * s, half * c, half * c);
        for turn in ["rotation_deg=[30, 0, 90]".to_owned(), format!("rotation={quaternion}")] {
            let key = format!("projector.calibration_camera={{position=[1, 2, 3], {turn}}}");
            let rig = rig(&file, None, &[&key]).unwrap();
            for (seen, pixel) in golden("brown5") {
                let got = rig.camera.project(place(seen)).unwrap();
                assert!((got - pixel).length() < 1e-6, "{turn} {got} {pixel}");
            }
        }
        std::fs::remove_file(file).unwrap();
        for (rotation, fault) in [
            ("rotation=[0, 0, 0, 0]", "length zero"),
            ("rotation=[0, 0, 0, 1], rotation_deg=[9, 0, 0]", "given twice"),
        ] {
            let key = format!("projector.calibration_camera={{{rotation}}}");
            let told = rig(&asset("opencv/brown5.yml"), None, &[&key]).err().unwrap();
            assert!(told.contains(fault) && !told.contains("remove projector"), "{told}");
        }
        let key = "projector.calibration_camera={position=[1, 2, 3]}";
        let told = rig(&asset("opencv/brown5.yml"), None, &[key]).err().unwrap();
        assert!(told.contains("remove projector.calibration_camera"), "{told}");
    }

    #[test]
    fn the_lens_and_the_region_are_as_the_rig_file_says() {
        let text = std::fs::read_to_string(asset("opencv/fisheye.yml")).unwrap();
        let file = written("silent.yml", &text.replace("fisheye_model: 1\n", ""));
        let rig_with = |keys: &[&str]| rig(&file, None, keys).unwrap().camera;
        let (world, pixel) = golden("fisheye")[0];
        let apart = |keys: &[&str]| rig_with(keys).project(world).map_or(1e9, |p| (p - pixel).length());
        assert!(apart(&["projector.calibration_lens=\"fisheye\""]) < 1e-6);
        assert!(apart(&[]) > 10.0);
        std::fs::remove_file(file).unwrap();
        let shape = ["projector.width=1400", "projector.height=1050"];
        let mpcdi = asset("mpcdi/shader_lamp.mpcdi.xml");
        let at = |region: &str| {
            rig(&mpcdi, None, &[shape[0], shape[1], &format!("projector.calibration_region={region:?}")])
        };
        assert!((at("left & low").unwrap().camera.position() - DVec3::new(1.0, -1.0, -0.5)).length() < 1e-12);
        assert!(at("right").err().unwrap().contains("left & low"));
    }
}
