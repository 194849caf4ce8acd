//! Hard cases of projecting, lens distortion and projector calibration.

use super::CpuCase;
use crate::reference::Sampler;
use dpm_calibration::pinhole::{calibrate, recalibrate, CalibrationError, CalibrationOptions, Pair};
use dpm_device::planes::Raster;
use dpm_scene::geometry::lens::Lens;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DVec2, DVec3};

/// The cases.
pub(super) const CASES: &[CpuCase] = &[
    CpuCase(
        "calibration-exact-data",
        "7 to 40 exact pairs, lens shift outside the raster",
        "truth",
        "relative",
        1e-9,
        exact,
    ),
    CpuCase(
        "calibration-degenerate",
        "0 and 5 pairs, one point, one pixel, a line, a plane, two views of five points, a cubic through the projector, NaN",
        "refused with the rank",
        "faults",
        0.0,
        degenerate,
    ),
    CpuCase(
        "calibration-nearly-planar",
        "relief of 1e-4 with 1 px of noise",
        "refused or marked uncertain",
        "faults",
        0.0,
        nearly_planar,
    ),
    CpuCase("calibration-outliers", "30 % wrong pairs, 1 px of noise", "truth", "relative", 5e-2, outliers),
    CpuCase(
        "calibration-covariance",
        "60 times 0.5 px of noise",
        "mean of (error / stated deviation)^2, either way",
        "ratio",
        2.0,
        covariance,
    ),
    CpuCase(
        "calibration-wrong-start",
        "focal length 100 times and a hundredth",
        "the same minimum, or not converged",
        "faults",
        0.0,
        wrong_start,
    ),
    CpuCase(
        "calibration-units",
        "metres, millimetres, 1e6 with an offset of 1e6",
        "same focal length",
        "relative",
        1e-6,
        units,
    ),
    CpuCase("calibration-wide-field", "132 deg of field", "truth, with a warning", "relative", 1e-8, wide),
    CpuCase(
        "distortion-without-inverse",
        "r (1 - r^2 / 2) beyond its turning point, NaN, 1e300",
        "no answer instead of a wrong one",
        "faults",
        0.0,
        no_inverse,
    ),
    CpuCase(
        "distortion-round-trip",
        "radial, tangential, rational and prism terms to 40 deg",
        "undistort inverts distort",
        "tangent",
        1e-10,
        round_trip,
    ),
    CpuCase(
        "projection-near-plane",
        "depth +-0, 1e-300, 1e-9, behind, NaN, 1e300",
        "no answer or finite",
        "faults",
        0.0,
        near_plane,
    ),
];

/// A projector with lens shift: its axis leaves below the raster.
pub(super) fn truth() -> ProjectorCamera {
    let raster = Raster::new(1024, 768).expect("sides within 1..8192");
    let at = DVec3::new(0.4, 1.1, 2.2);
    let mut c = ProjectorCamera::look_at(raster, at, DVec3::new(0.0, 0.2, 0.1), DVec3::Y, 0.6)
        .expect("a sound projector");
    c.fy *= 1.01;
    c.cy = 900.0;
    c
}

/// Points in a unit cube before it.
pub(super) fn cloud(n: usize, seed: u64) -> Vec<DVec3> {
    let mut s = Sampler::new(seed, 9);
    (0..n).map(|_| DVec3::new(s.uniform() - 0.5, s.uniform() - 0.3, s.uniform() - 0.5)).collect()
}

/// The points with their pixels, with normal noise.
pub(super) fn pairs(c: &ProjectorCamera, points: &[DVec3], noise_px: f64, seed: u64) -> Vec<Pair> {
    let mut s = Sampler::new(seed, 1);
    let mut normal = || {
        let (u, v) = (1.0 - s.uniform(), s.uniform());
        (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
    };
    (points.iter())
        .filter_map(|p| {
            Some(Pair { world: *p, pixel: c.project(*p)? + DVec2::new(normal(), normal()) * noise_px })
        })
        .collect()
}

/// How far two projectors are apart: rotation, intrinsics by focal length, position.
pub(super) fn off(a: &ProjectorCamera, b: &ProjectorCamera) -> f64 {
    let rotation = (a.world_from_projector.matrix3 - b.world_from_projector.matrix3).to_cols_array();
    let rotation = rotation.iter().fold(0.0f64, |m, x| m.max(x.abs()));
    let intrinsics = [(a.fx, b.fx), (a.fy, b.fy), (a.cx, b.cx), (a.cy, b.cy)];
    let intrinsics = intrinsics.iter().fold(0.0f64, |m, (x, y)| m.max((x - y).abs() / b.fx));
    rotation.max(intrinsics).max((a.position() - b.position()).length())
}

fn exact(seed: u64) -> f64 {
    let c = truth();
    let error = |n| {
        let got = calibrate(c.raster, &pairs(&c, &cloud(n, seed), 0.0, 0), &Default::default());
        got.map_or(f64::INFINITY, |g| off(&g.camera, &c))
    };
    [7, 8, 12, 40].into_iter().map(error).fold(0.0, f64::max)
}

/// Exact pairs of points whose relief is so many times less than their width. Infinite where they are refused.
pub(super) fn flattened_by(ratio: f64, seed: u64) -> f64 {
    let c = truth();
    let flat: Vec<DVec3> = cloud(40, seed).iter().map(|p| DVec3::new(p.x, p.y, p.z / ratio)).collect();
    let got = calibrate(c.raster, &pairs(&c, &flat, 0.0, 0), &Default::default());
    got.map_or(f64::INFINITY, |g| off(&g.camera, &c))
}

/// A lens at a place where it bends so much that the condition number of its inverse is `condition`, above 1. Infinite where it
/// has no answer.
pub(super) fn bent_to(condition: f64, _: u64) -> f64 {
    let Ok(lens) = Lens::opencv(&[-0.5, 0.0, 0.0, 0.0]) else { return f64::NAN };
    // The slope of r - r^3 / 2 is 1 - 3 r^2 / 2.
    let p = DVec2::X * ((1.0 - 1.0 / condition) / 1.5).sqrt();
    let back = lens.distort(p).and_then(|bent| lens.undistort(bent));
    back.map_or(f64::INFINITY, |back| (back - p).length())
}

fn degenerate(seed: u64) -> f64 {
    let c = truth();
    let base = cloud(30, seed);
    let line: Vec<DVec3> =
        base.iter().map(|p| DVec3::new(0.1, 0.2, 0.3) + DVec3::new(1.0, 0.5, -0.3) * p.x).collect();
    let plane: Vec<DVec3> = base.iter().map(|p| DVec3::new(p.x, 0.3 * p.x - 0.2 * p.z + 0.1, p.z)).collect();
    let twice: Vec<DVec3> = base[..5].iter().chain(&base[..5]).copied().collect();
    let cubic: Vec<DVec3> = (0..20)
        .map(|i| {
            let t = 0.1 + 0.04 * f64::from(i);
            c.position() + c.world_from_projector.transform_vector3(DVec3::new(t * t, t * t * t, -t) * 3.0)
        })
        .collect();
    let refuse =
        |points: &[DVec3]| calibrate(c.raster, &pairs(&c, points, 0.0, 0), &Default::default()).err();
    let mut faults = 0u32;
    for n in [0, 5] {
        faults += u32::from(refuse(&base[..n]) != Some(CalibrationError::TooFew(n)));
    }
    let one_pixel: Vec<Pair> = base.iter().map(|p| Pair { world: *p, pixel: DVec2::ONE }).collect();
    let refused = calibrate(c.raster, &one_pixel, &Default::default()).err();
    faults += u32::from(!matches!(refused, Some(CalibrationError::Degenerate { rank: 0, .. })));
    for (points, want) in [(vec![base[0]; 30], 0), (line, 1), (plane, 2)] {
        let named = matches!(refuse(&points), Some(CalibrationError::Degenerate { rank, condition, .. }) if rank == want && condition > 1e6);
        faults += u32::from(!named);
    }
    for points in [twice, cubic] {
        faults += u32::from(!matches!(refuse(&points), Some(CalibrationError::Degenerate { .. })));
    }
    let mut nan = pairs(&c, &base, 0.0, 0);
    nan[7].world.z = f64::NAN;
    faults +=
        u32::from(calibrate(c.raster, &nan, &Default::default()) != Err(CalibrationError::NotFinite(7)));
    let mut mirrored = pairs(&c, &base, 0.0, 0);
    mirrored.iter_mut().for_each(|p| p.pixel.x = 1024.0 - p.pixel.x);
    faults +=
        u32::from(calibrate(c.raster, &mirrored, &Default::default()) != Err(CalibrationError::Mirrored));
    f64::from(faults)
}

fn nearly_planar(seed: u64) -> f64 {
    let c = truth();
    let flat: Vec<DVec3> = cloud(40, seed).iter().map(|p| DVec3::new(p.x, 1e-4 * p.y, p.z)).collect();
    let mut faults = 0u32;
    for i in 0..10 {
        let got = calibrate(c.raster, &pairs(&c, &flat, 1.0, seed + i), &Default::default());
        faults += u32::from(got.is_ok_and(|g| g.focal_uncertainty < 0.05 || g.warnings.is_empty()));
    }
    f64::from(faults)
}

fn outliers(seed: u64) -> f64 {
    let c = truth();
    let mut data = pairs(&c, &cloud(80, seed), 1.0, seed);
    let mut s = Sampler::new(seed, 1);
    for i in 0..24 {
        data[3 * i].pixel = DVec2::new(1024.0 * s.uniform(), 768.0 * s.uniform());
    }
    let options = CalibrationOptions { inlier_px: Some(4.0), seed };
    calibrate(c.raster, &data, &options).map_or(f64::INFINITY, |g| (g.camera.fx / c.fx - 1.0).abs())
}

fn covariance(seed: u64) -> f64 {
    let c = truth();
    let points = cloud(60, seed);
    let n = 60;
    let mut z2 = 0.0;
    for i in 0..n {
        let Ok(got) = calibrate(c.raster, &pairs(&c, &points, 0.5, 1000 * seed + i), &Default::default())
        else {
            return f64::INFINITY;
        };
        z2 += ((got.camera.fx / c.fx - 1.0) / got.focal_uncertainty).powi(2) / n as f64;
    }
    z2.max(1.0 / z2)
}

fn wrong_start(seed: u64) -> f64 {
    let c = truth();
    let data = pairs(&c, &cloud(40, seed), 0.2, 1);
    let Ok(best) = calibrate(c.raster, &data, &Default::default()) else { return f64::INFINITY };
    let mut faults = 0u32;
    for factor in [0.01, 0.3, 3.0, 100.0] {
        let mut start = c;
        start.fx *= factor;
        start.fy *= factor;
        let sound = match recalibrate(&start, &data) {
            Ok(got) => (got.rms_px - best.rms_px).abs() < 1e-6,
            Err(_) => !(0.3..=3.0).contains(&factor),
        };
        faults += u32::from(!sound);
    }
    f64::from(faults)
}

fn units(seed: u64) -> f64 {
    let c = truth();
    let metres = pairs(&c, &cloud(30, seed), 0.3, 1);
    let Ok(a) = calibrate(c.raster, &metres, &Default::default()) else { return f64::INFINITY };
    let error = |(scale, shift): (f64, f64)| {
        let other: Vec<Pair> =
            metres.iter().map(|p| Pair { world: p.world * scale + DVec3::splat(shift), ..*p }).collect();
        let b = calibrate(c.raster, &other, &Default::default());
        b.map_or(f64::INFINITY, |b| (a.camera.fx / b.camera.fx - 1.0).abs())
    };
    [(1e3, 0.0), (1e-3, 0.0), (1e6, 1e6)].into_iter().map(error).fold(0.0, f64::max)
}

fn wide(seed: u64) -> f64 {
    let raster = Raster::new(800, 600).expect("sides within 1..8192");
    let c = ProjectorCamera::look_at(raster, DVec3::Z * 0.6, DVec3::ZERO, DVec3::Y, 2.3)
        .expect("a sound projector");
    match calibrate(raster, &pairs(&c, &cloud(30, seed), 0.0, 1), &Default::default()) {
        Ok(got) if got.warnings.iter().any(|w| w.contains("132 deg")) => off(&got.camera, &c),
        _ => f64::INFINITY,
    }
}

fn no_inverse(_: u64) -> f64 {
    let Ok(d) = Lens::opencv(&[-0.5, 0.0, 0.0, 0.0]) else { return f64::NAN };
    let mut faults = 0u32;
    for beyond in [0.9, 1.5, 20.0, 1e300, f64::INFINITY, f64::NAN] {
        faults += u32::from(d.distort(DVec2::X * beyond).is_some());
    }
    for beyond in [0.5450, 0.6, 1.0, 1e300, f64::INFINITY, f64::NAN] {
        faults += u32::from(d.undistort(DVec2::X * beyond).is_some());
    }
    faults += u32::from(
        !d.undistort(DVec2::X * 0.54)
            .is_some_and(|p| (p.x * (1.0 - 0.5 * p.x * p.x) - 0.54).abs() < 1e-9 && p.x < 0.8165),
    );
    faults += u32::from(Lens::opencv(&[f64::INFINITY, 0.0, 0.0, 0.0]).is_ok());
    f64::from(faults)
}

fn round_trip(_: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for c in [
        vec![-0.2, 0.05, 0.001, -0.002, -0.004],
        vec![0.3, 0.1, 0.0, 0.0, 0.0, 0.1, 0.02, 0.0, 0.001, 0.0, -0.001, 0.0],
    ] {
        let Ok(d) = Lens::opencv(&c) else { return f64::NAN };
        for i in -10..=10 {
            for j in -10..=10 {
                let p = DVec2::new(f64::from(i), f64::from(j)) * 0.06;
                let back = d.distort(p).and_then(|b| d.undistort(b));
                worst = worst.max(back.map_or(f64::INFINITY, |b| (b - p).length()));
            }
        }
    }
    worst
}

fn near_plane(_: u64) -> f64 {
    let c = truth();
    let world = |p: DVec3| c.world_from_projector.transform_point3(p);
    let mut faults = 0u32;
    for depth in [0.0, -0.0, 1e-300, 1e-15, 1e-9, 1.0, 1e300, f64::INFINITY, f64::NAN] {
        for side in [0.0, 1e-9, 1.0, -1e6, 1e300, f64::NAN] {
            let p = world(DVec3::new(side, side, -depth));
            faults += u32::from(!c.project(p).is_none_or(|p| p.is_finite()));
            faults += u32::from(!c.jacobian(p).is_none_or(|j| j[0].is_finite() && j[1].is_finite()));
            let behind = world(DVec3::new(side, side, depth.abs()));
            faults += u32::from(depth >= 1e-3 && c.project(behind).is_some());
        }
    }
    f64::from(faults)
}
