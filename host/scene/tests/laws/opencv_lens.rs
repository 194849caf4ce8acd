//! The projector's lens against pixels that OpenCV itself computed (`tests/assets/opencv/make.py`).

use dpm_common::so3::so3_exp;
use dpm_device::planes::Raster;
use dpm_scene::geometry::lens::Lens;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DMat3, DVec2, DVec3};
use std::path::PathBuf;

fn file(name: &str) -> String {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../tests/assets/opencv").join(name);
    std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The projector of a file, built by hand from its numbers.
fn projector(model: &str) -> ProjectorCamera {
    let json: serde_json::Value = serde_json::from_str(&file(&format!("{model}.json"))).unwrap();
    let numbers = |name: &str| -> Vec<f64> {
        json[name]["data"].as_array().map_or(vec![], |a| a.iter().map(|v| v.as_f64().unwrap()).collect())
    };
    let (k, d) = (numbers("camera_matrix"), numbers("distortion_coefficients"));
    let rotation = DMat3::from_quat(so3_exp(DVec3::from_slice(&numbers("rvec"))));
    let translation = DVec3::from_slice(&numbers("tvec"));
    let flip = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let pose =
        DAffine3::from_mat3_translation(rotation.transpose() * flip, -(rotation.transpose() * translation));
    let lens = match model {
        "fisheye" => Lens::fisheye([d[0], d[1], d[2], d[3]]),
        _ => Lens::opencv(&d),
    };
    ProjectorCamera::new(Raster::new(1024, 768).unwrap(), pose, k[0], k[4], k[2] + 0.5, k[5] + 0.5)
        .and_then(|c| c.with_lens(lens.unwrap()))
        .unwrap_or_else(|e| panic!("{model}: {e}"))
}

#[test]
fn every_model_projects_as_opencv_does() {
    for model in ["none", "brown4", "brown5", "rational8", "prism12", "tilted14", "fisheye"] {
        let camera = projector(model);
        let mut points = 0;
        for line in file(&format!("{model}.csv")).lines().skip(1) {
            let v: Vec<f64> = line.split(',').map(|w| w.parse().unwrap()).collect();
            let (world, want) = (DVec3::new(v[0], v[1], v[2]), DVec2::new(v[3], v[4]) + 0.5);
            let got = camera.project(world).unwrap_or_else(|| panic!("{model}: no pixel for {world}"));
            assert!((got - want).length() < 1e-6, "{model}: {world} to {got}, OpenCV to {want}");
            let ray = camera.ray(want);
            let off = (world - ray.origin).cross(ray.direction).length() / (world - ray.origin).length();
            assert!(off < 1e-9, "{model}: the ray of {want} passes {world} at {off} rad");
            points += 1;
        }
        assert!(points > 150, "{model}: {points} points");
    }
}
