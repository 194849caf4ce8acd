//! The calibration file into parts of a rig: what `dpm calibrate` measured into camera, bodies, latency and light.

use crate::camera_file::CameraFileError;
use crate::config::RigConfig;
use dpm_calibration_file::{self as file, CalibrationFile, LightSection, ProjectorSection};
use dpm_device::planes::Raster;
use dpm_scene::geometry::projector::ProjectorCamera;

/// What `dpm calibrate` measured, if the rig file names it.
///
/// # Errors
/// The file was changed since the configuration was checked, and cannot be read any more.
pub(crate) fn measured(config: &RigConfig) -> Result<CalibrationFile, CameraFileError> {
    let Some(path) = &config.calibration.file else { return Ok(CalibrationFile::new()) };
    file::load(path).map_err(|e| CameraFileError {
        key: "calibration.file",
        path: path.display().to_string(),
        message: e.to_string(),
    })
}

/// What a run uses of the calibration file, one sentence; `None` if the rig file names none. `placed` are the names of the
/// bodies whose measured places are used.
pub(crate) fn told_of_measured(
    measured: &CalibrationFile,
    config: &RigConfig,
    placed: &[&str],
) -> Option<String> {
    let path = config.calibration.file.as_ref()?;
    let mut parts = Vec::new();
    if let Some(projector) = &measured.projector {
        let (px, date) = (projector.predicted_p99_px, &projector.provenance.date);
        parts.push(format!("the projector of {date}, light within {px:.2} px"));
    }
    parts.extend(placed.iter().map(|name| format!("the place of the mesh in \"{name}\"")));
    if let Some(latency) = &measured.latency {
        parts.push(format!("a latency of {:.3} ms", 1e-3 * latency.latency_us));
    }
    if measured.light.is_some() {
        parts.push("the light of each code value".into());
    }
    let used = if parts.is_empty() { "nothing, since nothing was measured".into() } else { parts.join("; ") };
    Some(format!("{}: {used}", path.display()))
}

/// The measured projector at the rig's raster, and then at the one that is traced.
///
/// # Errors
/// It was measured at a raster of another shape.
pub(crate) fn measured_camera(
    section: &ProjectorSection,
    config: &RigConfig,
    raster: Raster,
) -> Result<ProjectorCamera, CameraFileError> {
    let wrong = |message: String| CameraFileError {
        key: "calibration.file",
        path: config.calibration.file.as_ref().map_or_else(String::new, |f| f.display().to_string()),
        message,
    };
    let own = config.projector.raster();
    let [width, height] = section.size;
    if u64::from(width) * u64::from(own.height()) != u64::from(height) * u64::from(own.width()) {
        return Err(wrong(format!(
            "the projector was measured with {width} x {height} pixels, and the rig has {} x {}, which is another shape; \
             measure again, or correct projector.width and projector.height",
            own.width(),
            own.height()
        )));
    }
    Ok(section.camera().map_err(|e| wrong(e.to_string()))?.at_raster(raster))
}

/// Light of each code value of each channel by the measured curves, black level included.
pub(crate) fn measured_response(light: &LightSection) -> [[f64; 256]; 3] {
    std::array::from_fn(|channel| {
        // A projector without colour has one curve.
        let curve = light.curves.get(channel).or(light.curves.first()).map_or(&[][..], Vec::as_slice);
        std::array::from_fn(|code| {
            let at = code as f64 / 255.0 * curve.len().saturating_sub(1) as f64;
            let value = |i: usize| curve.get(i).or(curve.last()).copied().unwrap_or(0.0);
            let (low, share) = (at as usize, at.fract());
            light.black + (1.0 - light.black) * ((1.0 - share) * value(low) + share * value(low + 1))
        })
    })
}

#[cfg(test)]
mod tests {
    use super::CalibrationFile;
    use crate::calibration_steps::tests::measured_file;
    use crate::config::{Overrides, RigConfig};
    use crate::rig::Rig;
    use dpm_device::planes::Raster;
    use glam::DAffine3;
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

    /// A rig with a NatNet tracker and the demo's bodies, and the file that `dpm calibrate` would have written.
    fn measured_rig(file: &CalibrationFile, name: &str, keys: &[&str]) -> Result<Rig, String> {
        let path = std::env::temp_dir().join(format!("dpm-measured-{}-{name}.toml", std::process::id()));
        dpm_calibration_file::save(file, &path).unwrap();
        let text = format!(
            "[tracker]\nkind = \"natnet\"\n[real_time]\npace = \"real\"\n[run]\nseconds = 1\n[calibration]\nfile = {:?}\n\
             [[scene.bodies]]\nname = \"bunny\"\n[[scene.bodies]]\nname = \"venus\"\n",
            path.display().to_string()
        );
        let flags = keys.iter().map(|k| (*k).to_owned()).collect();
        let overrides = Overrides { variables: vec![], flags };
        let config =
            RigConfig::parse("rig.toml", &text, Path::new(""), &overrides).map_err(|e| e.to_string())?;
        Rig::build(&config, None).map_err(|e| e.to_string())
    }

    #[test]
    fn what_was_measured_is_in_the_rig() {
        let file = measured_file();
        let rig = measured_rig(&file, "all", &[]).unwrap();
        let camera = file.projector.as_ref().unwrap().camera().unwrap();
        let point = DVec3::new(0.2, 0.1, 0.1);
        assert!((rig.camera.project(point).unwrap() - camera.project(point).unwrap()).length() < 1e-9);
        assert!(!rig.camera.lens.is_pinhole());
        assert_eq!(rig.bodies[0].mesh_to_body, DAffine3::IDENTITY);
        assert!((rig.bodies[1].mesh_to_body.translation - DVec3::new(0.01, 0.0, 0.02)).length() < 1e-12);
        assert_eq!(rig.latency_ns, Some(2_500_000));
        let used = rig.calibration.as_deref().unwrap();
        let parts =
            ["all.toml: ", "light within 0.20 px", "mesh in \"venus\"", "2.500 ms", "each code value"];
        assert!(parts.iter().all(|part| used.contains(part)) && !used.contains("bunny"), "{used}");
        let nothing = measured_rig(&CalibrationFile::new(), "nothing", &[]).unwrap();
        assert!(nothing.calibration.unwrap().ends_with("nothing was measured"));
        // Half of full code gives a quarter of the light and the black level; green is twice as bright as the others.
        let drive = &rig.drive;
        let at = |x: usize, codes| drive.light_of(codes, 384 * 1024 + x);
        assert!((at(512, [128; 3])[0] - (0.01 + 0.99 * 0.253)).abs() < 2e-3, "{:?}", at(512, [128; 3]));
        assert!((at(0, [255; 3])[1] - 0.8).abs() < 2e-3);
        assert!((drive.gain[0] / drive.gain[1] - 2.0).abs() < 1e-5);
    }

    #[test]
    fn what_is_given_twice_or_has_another_shape_is_refused() {
        let file = measured_file();
        let told = |keys: &[&str]| measured_rig(&file, "twice", keys).err().unwrap();
        for key in [
            "projector.position=[0, 1, 2]",
            "tracker.latency_us=20",
            "scene.bodies.1.mesh_to_body.position=[0, 0, 0]",
            "projector.response.kind=\"gamma\"",
        ] {
            let name = key.split('=').next().unwrap();
            let told = told(&[key]);
            assert!(told.contains("calibration.file") && told.contains("twice"), "{name}: {told}");
        }
        assert!(told(&["projector.height=640"]).contains("1024 x 768"));
        let mut broken = file.clone();
        broken.latency.as_mut().unwrap().latency_us = 1.0;
        assert_eq!(measured_rig(&broken, "once", &[]).unwrap().latency_ns, Some(1000));
    }
}
