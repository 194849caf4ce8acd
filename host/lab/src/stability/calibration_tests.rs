//! Calibration against known truth: exact data, noise, outliers, degenerate points, units, wrong starts.

use crate::reference::Sampler;
use crate::stability::calibration::{cloud, off, pairs, truth};
use dpm_device::planes::Raster;
use dpm_scene::geometry::calibration::*;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DVec2, DVec3};

#[test]
fn exact_data_give_the_projector_back() {
    for n in [6, 8, 40] {
        let c = truth();
        let got = calibrate(c.raster, &pairs(&c, &cloud(n, 3), 0.0, 0), &Default::default()).unwrap();
        assert!(off(&got.camera, &c) < 1e-9, "{n}: {:e}", off(&got.camera, &c));
        assert!(got.rms_px < 1e-9 && got.condition.is_finite() && got.focal_uncertainty < 1e-9);
        assert!(got.warnings.iter().any(|w| w.contains("lens shift")), "{:?}", got.warnings);
    }
}

#[test]
fn degenerate_points_are_named_and_give_no_number() {
    let c = truth();
    let base = cloud(30, 4);
    let refuse = |points: Vec<DVec3>| {
        calibrate(c.raster, &pairs(&c, &points, 0.0, 0), &Default::default()).unwrap_err()
    };
    let rank = |e: &CalibrationError| match e {
        CalibrationError::Degenerate { rank, condition, .. } => {
            assert!(*condition > 1e6);
            *rank
        }
        other => panic!("{other}"),
    };
    assert_eq!(refuse(base[..5].to_vec()), CalibrationError::TooFew(5));
    assert_eq!(refuse(vec![]), CalibrationError::TooFew(0));
    let plane: Vec<DVec3> = base.iter().map(|p| DVec3::new(p.x, 0.3 * p.x - 0.2 * p.z + 0.1, p.z)).collect();
    assert_eq!(rank(&refuse(plane)), 2);
    let line = base.iter().map(|p| DVec3::new(0.1, 0.2, 0.3) + DVec3::new(1.0, 0.5, -0.3) * p.x).collect();
    assert_eq!(rank(&refuse(line)), 1);
    assert_eq!(rank(&refuse(vec![base[0]; 30])), 0);
    // Six pairs of which two are equal: five.
    let mut twice = base[..6].to_vec();
    twice[5] = twice[0];
    assert!(matches!(refuse(twice), CalibrationError::Degenerate { rank, .. } if rank < 11));
    // A twisted cubic through the projector: no plane, and yet no solution [Hartley04, 22.1].
    let cubic = (0..20)
        .map(|i| {
            let t = 0.1 + 0.04 * f64::from(i);
            c.position() + c.world_from_projector.transform_vector3(DVec3::new(t * t, t * t * t, -t) * 3.0)
        })
        .collect();
    assert!(matches!(refuse(cubic), CalibrationError::Degenerate { .. }));
    let mut nan = pairs(&c, &base, 0.0, 0);
    nan[7].pixel.y = f64::NAN;
    assert_eq!(calibrate(c.raster, &nan, &Default::default()), Err(CalibrationError::NotFinite(7)));
    let one: Vec<Pair> = base.iter().map(|p| Pair { world: *p, pixel: DVec2::ONE }).collect();
    assert_eq!(rank(&calibrate(c.raster, &one, &Default::default()).unwrap_err()), 0);
}

#[test]
fn nearly_planar_points_with_noise_are_refused_or_marked() {
    let c = truth();
    let flat: Vec<DVec3> = cloud(40, 5).iter().map(|p| DVec3::new(p.x, 1e-4 * p.y, p.z)).collect();
    match calibrate(c.raster, &pairs(&c, &flat, 1.0, 3), &Default::default()) {
        Err(_) => {}
        Ok(got) => {
            assert!(got.focal_uncertainty > 0.05 && !got.warnings.is_empty(), "{got:?}");
        }
    }
    // Exact numbers of the same points do determine it.
    let got = calibrate(c.raster, &pairs(&c, &flat, 0.0, 3), &Default::default()).unwrap();
    assert!(off(&got.camera, &c) < 1e-5 && got.condition > 1e3, "{:e}", off(&got.camera, &c));
}

#[test]
fn noise_spreads_the_focal_length_as_the_covariance_says() {
    let c = truth();
    let points = cloud(60, 6);
    let (mut z2, n) = (0.0, 60);
    for seed in 0..n {
        let got = calibrate(c.raster, &pairs(&c, &points, 0.5, 100 + seed), &Default::default()).unwrap();
        let z = (got.camera.fx / c.fx - 1.0) / got.focal_uncertainty;
        z2 += z * z / n as f64;
        assert!((got.rms_px / (0.5 * 2f64.sqrt()) - 1.0).abs() < 0.3, "{}", got.rms_px);
    }
    // The mean of 60 squares of standard normal numbers is within 1 +- 0.75 at four sigma.
    assert!((0.25..1.75).contains(&z2), "{z2}");
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
fn metres_and_millimetres_give_the_same_pixels() {
    let c = truth();
    let metres = pairs(&c, &cloud(30, 10), 0.3, 1);
    let a = calibrate(c.raster, &metres, &Default::default()).unwrap();
    for (scale, shift) in [(1e3, 0.0), (1e-3, 0.0), (1.0, 1e4), (1e6, 1e6)] {
        let other: Vec<Pair> = metres
            .iter()
            .map(|p| Pair { world: p.world * scale + DVec3::splat(shift), pixel: p.pixel })
            .collect();
        let b = calibrate(c.raster, &other, &Default::default()).unwrap();
        assert!((a.camera.fx / b.camera.fx - 1.0).abs() < 1e-6, "{scale} {shift}");
        assert!((a.rms_px - b.rms_px).abs() < 1e-6);
        let position = (b.camera.position() - DVec3::splat(shift)) / scale;
        assert!((position - a.camera.position()).length() < 1e-5);
    }
}

#[test]
fn mirrored_pixels_are_recognised() {
    let c = truth();
    let mut data = pairs(&c, &cloud(30, 11), 0.0, 1);
    data.iter_mut().for_each(|p| p.pixel.x = 1024.0 - p.pixel.x);
    assert_eq!(calibrate(c.raster, &data, &Default::default()), Err(CalibrationError::Mirrored));
}

#[test]
fn a_wrong_start_converges_or_says_so() {
    let c = truth();
    let data = pairs(&c, &cloud(40, 12), 0.2, 1);
    let best = calibrate(c.raster, &data, &Default::default()).unwrap();
    for factor in [0.01, 0.3, 1.0, 3.0, 100.0] {
        let mut start = c;
        start.fx *= factor;
        start.fy *= factor;
        match recalibrate(&start, &data) {
            Ok(got) => {
                assert!((got.rms_px - best.rms_px).abs() < 1e-6, "{factor}: {} {}", got.rms_px, best.rms_px)
            }
            Err(e) => {
                assert!(
                    matches!(
                        e,
                        CalibrationError::NotConverged { .. }
                            | CalibrationError::Mirrored
                            | CalibrationError::Uncertain(_)
                    ),
                    "{e}"
                );
                assert!(!(0.3..=3.0).contains(&factor), "{factor}: {e}");
            }
        }
    }
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
