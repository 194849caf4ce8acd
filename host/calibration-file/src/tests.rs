//! Laws of the file.

use super::*;
use crate::light::{Channels, FlatField, LightModel};
use dpm_common::so3::so3_exp;
use dpm_device::planes::Raster;
use glam::{DAffine3, DVec2, DVec3};
use std::path::{Path, PathBuf};

fn provenance() -> Provenance {
    Provenance {
        date: "2026-03-04T05:06:07Z".into(),
        device: "mock \"projector\"".into(),
        data: "sweep-3.samples".into(),
        commit: "0123456789ab".into(),
        method: String::new(),
    }
}

fn full() -> CalibrationFile {
    let raster = Raster::new(1024, 768).unwrap();
    let model = crate::model::tests::example();
    let pose = DAffine3::from_rotation_translation(
        so3_exp(DVec3::new(0.3, -2.0, 0.1)),
        DVec3::new(0.01, 0.02, -0.03),
    );
    let channels = Channels {
        curves: vec![vec![0.0, 0.1, 1.0]; 3],
        intensity: vec![0.2, 0.5, 0.3],
        black: 0.001,
        ambient: 0.05,
        sigma: 1e-4,
    };
    let flat = FlatField { terms: [1.0, 0.1, -0.05, -0.1, 0.01, -0.2], ..FlatField::even(raster) };
    let mut file = CalibrationFile::new();
    file.projector = Some(ProjectorSection::new(raster, &model, 0.13, 0.05, provenance()));
    file.wand =
        Some(WandSection { tip: [0.01, -0.15, 1.0 / 3.0], tip_sigma_m: 2e-5, provenance: provenance() });
    let body =
        BodySection { mesh_to_body: Pose::new(&pose), residual_m: Some(1e-4), provenance: provenance() };
    file.bodies.insert("the head".into(), body);
    let check =
        CheckSection { points: 6, p50_px: 0.4, largest_px: 0.9, limit_px: 2.0, provenance: provenance() };
    file.checks.insert("the head".into(), check);
    file.latency = Some(LatencySection { latency_us: 4321.0, sigma_us: 5.0, provenance: provenance() });
    file.light = Some(LightSection::new(&LightModel { channels, flat }, provenance()));
    file
}

fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("dpm-calibration-{}-{name}", std::process::id()));
    let _ = std::fs::remove_dir_all(&path);
    path
}

#[test]
fn what_is_written_is_read_and_old_files_are_kept() {
    let dir = folder("round");
    let path = dir.join("rig.calibration.toml");
    let mut file = full();
    assert_eq!(save(&file, &path).unwrap(), None);
    assert_eq!(load(&path).unwrap(), file);
    let first = std::fs::read(&path).unwrap();
    file.wand = None;
    let kept = save(&file, &path).unwrap().unwrap();
    assert_eq!(std::fs::read(&kept).unwrap(), first);
    assert_eq!(kept.file_name().unwrap(), "rig.calibration.toml.1.old");
    file.latency = None;
    assert!(save(&file, &path).unwrap().unwrap().ends_with("rig.calibration.toml.2.old"));
    assert_eq!(load(&path).unwrap(), file);
    assert_eq!(std::fs::read_dir(&dir).unwrap().count(), 3);
    std::fs::remove_dir_all(dir).unwrap();
}

#[test]
fn sections_become_what_they_were() {
    let file = full();
    let model = crate::model::tests::example();
    let section = file.projector.unwrap();
    let (camera, again) = (section.camera().unwrap(), section.model().unwrap());
    for i in 0..20 {
        let s = f64::from(i);
        let p = DVec3::new((0.7 * s).sin() * 0.2, (1.1 * s).cos() * 0.1, (1.9 * s).sin() * 0.2);
        let want = model.project(p).unwrap();
        assert!((camera.project(p).unwrap() - want).length() < 1e-6);
        assert!((again.project(p).unwrap() - want).length() < 1e-6);
    }
    let light = file.light.unwrap();
    let at = light.model().unwrap().level(1, 0.5, DVec2::new(512.0, 384.0));
    assert!((at - 0.5 * 0.999 * 0.1).abs() < 1e-12, "{at}");
}

#[test]
fn numbers_that_cannot_be_are_refused_with_their_key() {
    let refused = |change: &dyn Fn(&mut CalibrationFile), key: &str| {
        let mut file = full();
        change(&mut file);
        let dir = folder("refused");
        let error = save(&file, &dir.join("a.toml")).unwrap_err().to_string();
        assert!(error.contains(key), "{key}: {error}");
        assert!(!dir.exists());
        if let Ok(text) = toml::to_string(&file) {
            assert!(parse(&text, Path::new("b.toml")).is_err());
        }
    };
    refused(&|f| f.version = 2, "version");
    refused(&|f| f.projector.as_mut().unwrap().size = [0, 768], "projector.size");
    refused(&|f| f.projector.as_mut().unwrap().focal[1] = f64::NAN, "projector.focal");
    refused(&|f| f.projector.as_mut().unwrap().lens = vec![-3.0, 0.0, 0.0, 0.0], "projector is none");
    refused(&|f| f.projector.as_mut().unwrap().lens = vec![0.1; 3], "projector is none");
    refused(&|f| f.wand.as_mut().unwrap().tip[2] = f64::INFINITY, "wand.tip");
    refused(&|f| f.bodies.get_mut("the head").unwrap().mesh_to_body.rotation = [0.0; 4], "bodies.the head");
    refused(&|f| f.checks.get_mut("the head").unwrap().largest_px = f64::NAN, "checks.the head");
    refused(&|f| f.latency.as_mut().unwrap().latency_us = 1e9, "latency.latency_us");
    refused(&|f| f.light.as_mut().unwrap().curves[1] = vec![0.0, 0.6, 0.5, 1.0], "light.curves[1]");
    refused(&|f| f.light.as_mut().unwrap().intensity = vec![0.2; 3], "light.intensity");
}

#[test]
fn text_that_is_no_calibration_is_refused_with_its_line() {
    let error = |text: &str| parse(text, Path::new("cal.toml")).unwrap_err().to_string();
    assert!(error("version = 1\nprojektor = 3").contains("projektor"));
    assert!(error("version = ").contains("cal.toml"));
    assert!(error("").contains("version"));
    let missing = load(Path::new("/nowhere/cal.toml")).unwrap_err().to_string();
    assert!(missing.contains("/nowhere/cal.toml"), "{missing}");
}

#[test]
fn a_link_in_place_of_the_file_is_not_followed() {
    let dir = folder("link");
    std::fs::create_dir_all(&dir).unwrap();
    std::fs::write(dir.join("victim"), b"precious").unwrap();
    std::os::unix::fs::symlink(dir.join("victim"), dir.join("cal.toml")).unwrap();
    let error = save(&full(), &dir.join("cal.toml")).unwrap_err().to_string();
    assert!(error.contains("not a regular file"), "{error}");
    assert_eq!(std::fs::read(dir.join("victim")).unwrap(), b"precious");
    std::fs::remove_dir_all(dir).unwrap();
}
