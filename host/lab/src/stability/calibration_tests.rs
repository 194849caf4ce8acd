//! What a calibration says beside its numbers: remarks, the pairs that it leaves out, a summary. That the numbers are right is a matter
//! of the stability cases.

use crate::reference::Sampler;
use crate::stability::calibration::{cloud, off, pairs, truth};
use dpm_calibration::pinhole::*;
use dpm_device::planes::Raster;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DVec2, DVec3};

#[test]
fn the_fewest_pairs_are_enough_and_a_lens_shift_is_remarked() {
    for n in [6, 40] {
        let c = truth();
        let got = calibrate(c.raster, &pairs(&c, &cloud(n, 3), 0.0, 0), &Default::default()).unwrap();
        assert!(off(&got.camera, &c) < 1e-9, "{n}: {:e}", off(&got.camera, &c));
        assert!(got.rms_px < 1e-9 && got.condition.is_finite() && got.focal_uncertainty < 1e-9);
        assert!(got.warnings.iter().any(|w| w.contains("lens shift")), "{:?}", got.warnings);
    }
}

#[test]
fn exact_numbers_of_nearly_planar_points_determine_the_projector() {
    let c = truth();
    let flat: Vec<DVec3> = cloud(40, 5).iter().map(|p| DVec3::new(p.x, 1e-4 * p.y, p.z)).collect();
    let got = calibrate(c.raster, &pairs(&c, &flat, 0.0, 3), &Default::default()).unwrap();
    assert!(off(&got.camera, &c) < 1e-5 && got.condition > 1e3, "{:e}", off(&got.camera, &c));
}

#[test]
fn a_third_of_wrong_pairs_is_left_out() {
    let c = truth();
    for noise in [0.0, 1.0] {
        let mut data = pairs(&c, &cloud(80, 7), noise, 8);
        let mut s = Sampler::new(1, 1);
        for i in 0..24 {
            data[3 * i].pixel = DVec2::new(1024.0 * s.uniform(), 768.0 * s.uniform());
        }
        let options = CalibrationOptions { inlier_px: Some(4.0), seed: 2 };
        let got = calibrate(c.raster, &data, &options).unwrap();
        let wrong = (0..24).filter(|i| got.inliers[3 * i]).count();
        assert!(wrong <= 1 && got.inliers.iter().filter(|i| **i).count() >= 53, "{:?}", got.inliers);
        assert!(
            (got.camera.fx / c.fx - 1.0).abs() < if noise == 0.0 { 1e-6 } else { 0.05 },
            "{}",
            got.camera.fx / c.fx
        );
        assert!(got.rms_px < 3.0);
    }
    // Nothing but noise agrees on nothing.
    let mut s = Sampler::new(1, 1);
    let chaos: Vec<Pair> = cloud(60, 9)
        .iter()
        .map(|p| Pair { world: *p, pixel: DVec2::new(1024.0 * s.uniform(), 768.0 * s.uniform()) })
        .collect();
    let options = CalibrationOptions { inlier_px: Some(4.0), seed: 2 };
    assert!(matches!(calibrate(c.raster, &chaos, &options), Err(CalibrationError::NoConsensus { .. })));
}

#[test]
fn wide_lenses_work_and_are_remarked() {
    let raster = Raster::new(800, 600).unwrap();
    let c = ProjectorCamera::look_at(raster, DVec3::new(0.0, 0.0, 0.6), DVec3::ZERO, DVec3::Y, 2.3).unwrap();
    let got = calibrate(raster, &pairs(&c, &cloud(30, 13), 0.0, 1), &Default::default()).unwrap();
    assert!(off(&got.camera, &c) < 1e-8);
    assert!(got.warnings.iter().any(|w| w.contains("132 deg")), "{:?}", got.warnings);
    assert!(got.summary().iter().any(|l| l.starts_with("field of view 131.8 x")), "{:#?}", got.summary());
}
