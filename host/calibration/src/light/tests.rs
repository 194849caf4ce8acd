//! Laws, against a drawn truth.

use super::*;
use crate::sensor::{Brightness, SampleBlock};
use dpm_device::planes::Raster;
use dpm_device::rng::Draws;
use glam::{DVec2, DVec3};

fn block(n: usize, level: impl Fn(usize) -> f64) -> [SampleBlock; 1] {
    [SampleBlock { start_ns: 77, interval_ns: 1e4, levels: (0..n).map(|i| level(i) as f32).collect() }]
}

#[test]
fn the_flicker_of_lamps_is_taken_out() {
    let d = Draws::new(1);
    let tau = std::f64::consts::TAU;
    // 37 ms: no whole number of waves.
    let samples = block(3700, |i| {
        let s = i as f64 * 1e-5;
        0.4 + 0.1 * (tau * 100.0 * s + 0.3).sin() + 0.02 * (tau * 200.0 * s).cos() + 0.01 * d.normal(i as u64)
    });
    let got = steady(&samples, 100.0).unwrap();
    assert!((got.level - 0.4).abs() < 4.0 * got.sigma && got.sigma < 3e-4, "{got:?}");
    assert!((got.flicker - 0.1).abs() < 2e-3);
    assert!(matches!(steady(&block(900, |_| 0.4), 100.0), Err(SteadyError::TooShort { .. })));
    assert!(matches!(
        steady(&block(5000, |i| 0.4 + i as f64 * 1e-5), 100.0),
        Err(SteadyError::NotSteady { .. })
    ));
    assert_eq!(steady(&block(5000, |_| f64::NAN), 100.0), Err(SteadyError::NotFinite));
    assert!(matches!(steady(&[], 100.0), Err(SteadyError::TooShort { .. })));
}

const FULL: [f64; 3] = [0.25, 0.6, 0.15];

fn truth(channel: usize, code: f64) -> f64 {
    code.powf([2.2, 1.0, 1.6][channel])
}

/// Reads all that the session asks for.
fn read(noise: f64, seed: u64, level: impl Fn(Next) -> f64) -> ResponseSession {
    let mut session = ResponseSession::new(3);
    let mut i = 0;
    while let Some(next) = session.next_reading() {
        i += 1;
        assert!(i < 200);
        let level = level(next) + noise * Draws::new(seed).normal(i);
        session.add(next, Steady { level, sigma: noise, flicker: 0.0 }).unwrap();
    }
    session
}

fn light(next: Next) -> f64 {
    0.05 + match next {
        Next::Ambient => 0.0,
        Next::Black => 0.002,
        Next::White => 1.002,
        Next::Code { channel, code } => 0.002 + FULL[channel] * truth(channel, code),
    }
}

#[test]
fn curves_are_those_of_the_channels_and_never_fall() {
    for seed in 0..10 {
        let got = read(2e-4, seed, light).solve().unwrap();
        for (channel, full) in FULL.into_iter().enumerate() {
            assert!((got.intensity[channel] - full).abs() < 2e-3);
            assert_eq!((got.curves[channel][0], got.curves[channel][CURVE_POINTS - 1]), (0.0, 1.0));
            assert!(got.curves[channel].windows(2).all(|w| w[0] <= w[1]));
            for i in 0..=100 {
                let code = f64::from(i) / 100.0;
                let off = got.level(channel, code) * 1.002 - full * truth(channel, code);
                assert!(off.abs() < 2e-3, "{channel} {code}: {off}");
            }
        }
        assert!((got.black - 0.002).abs() < 1e-3 && (got.ambient - 0.05).abs() < 2e-3);
        assert_eq!(got.level(7, 0.5), 0.0);
    }
}

#[test]
fn bad_readings_are_refused_by_name() {
    let solve = |f: &dyn Fn(Next) -> f64, noise: f64| read(noise, 1, f).solve().unwrap_err();
    let saturated = |n: Next| match n {
        Next::Code { channel: 1, code } if code > 0.8 => light(n) - 0.2,
        _ => light(n),
    };
    assert!(matches!(
        solve(&saturated, 1e-5),
        LightError::Falls { channel: 1, .. } | LightError::DoesNotAdd { .. }
    ));
    let dip = |n: Next| match n {
        Next::Code { channel: 2, code } if (0.6..0.65).contains(&code) => light(n) - 0.05,
        _ => light(n),
    };
    assert!(matches!(solve(&dip, 1e-5), LightError::Falls { channel: 2, .. }));
    let white = |n: Next| if n == Next::White { 1.4 } else { light(n) };
    assert!(matches!(solve(&white, 1e-5), LightError::DoesNotAdd { .. }));
    let dead = |n: Next| if matches!(n, Next::Code { channel: 0, .. }) { 0.052 } else { light(n) };
    assert!(matches!(solve(&dead, 1e-5), LightError::NoLight { channel: 0, .. }));
    assert!(matches!(solve(&light, 5e-3), LightError::Uncertain { .. }));
    assert!(matches!(ResponseSession::new(3).solve(), Err(LightError::Missing(_))));
    let mut session = ResponseSession::new(3);
    let reading = Steady { level: 1.0, sigma: 0.0, flicker: 0.0 };
    for (channel, code) in [(3, 0.5), (0, 1.5), (0, f64::NAN)] {
        assert!(matches!(session.add(Next::Code { channel, code }, reading), Err(LightError::NoCode { .. })));
    }
}

fn sweep(n: u64, reach: f64, flat_sensor: bool) -> Vec<Brightness> {
    let d = Draws::new(6);
    (0..n)
        .map(|i| {
            let p = DVec2::new(2.0 * d.unit(5 * i) - 1.0, 2.0 * d.unit(5 * i + 1) - 1.0) * reach;
            let distance_m = 1.0 + 0.4 * d.unit(5 * i + 2);
            let towards = (DVec3::Z + 0.4 * DVec3::from_array(d.normal3(5 * i))).normalize();
            let cosine = if flat_sensor { towards.z.max(0.0) } else { 1.0 };
            let covered = if i % 30 == 0 { 0.5 } else { 1.0 };
            let level = 3.0 * field(p) * cosine * covered / distance_m.powi(2)
                * (1.0 + 0.01 * d.normal(9_000_000 + i));
            Brightness { pixel: (p + 1.0) * DVec2::new(512.0, 384.0), distance_m, towards, level }
        })
        .collect()
}

fn field(p: DVec2) -> f64 {
    1.0 + 0.05 * p.x - 0.03 * p.y - 0.2 * p.x * p.x + 0.02 * p.x * p.y - 0.1 * p.y * p.y
}

#[test]
fn the_flat_field_is_that_of_the_projector() {
    let raster = Raster::new(1024, 768).unwrap();
    for axis in [None, Some(DVec3::Z)] {
        let got = flat_field(raster, &sweep(5000, 1.0, axis.is_some()), axis).unwrap();
        assert!((got.unit - 3.0).abs() < 0.02, "{}", got.unit);
        for i in 0..100u32 {
            let p = DVec2::new(f64::from(i % 10), f64::from(i / 10)) / 4.5 - 1.0;
            let off = got.at((p + 1.0) * DVec2::new(512.0, 384.0)) - field(p);
            assert!(off.abs() < 5e-3, "{p}: {off}");
        }
    }
    let mean = FlatField::even(raster);
    assert_eq!(mean.at(DVec2::new(3.0, 700.0)), 1.0);
}

#[test]
fn a_sweep_that_leaves_the_border_out_is_refused() {
    let raster = Raster::new(1024, 768).unwrap();
    assert!(matches!(flat_field(raster, &sweep(1000, 0.2, false), None), Err(FlatError::Uncovered { .. })));
    assert_eq!(flat_field(raster, &sweep(100, 1.0, false), None), Err(FlatError::TooFew(100)));
    let mut shaded = sweep(5000, 1.0, false);
    shaded.iter_mut().for_each(|b| b.level *= (1.0 - b.pixel.x / 1000.0).max(0.0));
    assert!(matches!(flat_field(raster, &shaded, None), Err(FlatError::Dark { .. })));
}
