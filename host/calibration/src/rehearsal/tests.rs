//! The closed loop.

use super::photodiode::record;
use super::tracker::Tracker;
use super::truth::{Hand, Truth};
use super::*;
use crate::pivot::Pivot;
use crate::projector::{Known, Priors};
use crate::sensor::*;
use crate::trajectory::Trajectory;
use glam::DVec3;

#[test]
fn one_sweep() {
    for seed in 0..4 {
        let t0 = std::time::Instant::now();
        let truth = Truth::draw(seed);
        let code = Code::new(truth.raster).unwrap();
        let timing = Timing { frame_zero_ns: 1_000_000_123, frame_ns: 1_055_966.2 };
        let tracker = Tracker { seed, latency_ns: truth.latency_ns, bias: Bias::None };
        let mut pivot = Pivot::default();
        tracker
            .wand(&Hand::pivoting(seed), truth.tip, DVec3::ZERO, 0.0, 20.0)
            .into_iter()
            .for_each(|p| pivot.add(p));
        let tip = pivot.solve().unwrap();
        let hand = Hand::sweeping(&truth.volume, seed);
        let poses = Tracker { seed: seed + 1000, ..tracker }.wand(&hand, truth.tip, DVec3::ZERO, 39.0, 72.0);
        let blocks = record(&truth, &code, &timing, &hand, [40.0, 70.0], seed);
        let t1 = std::time::Instant::now();
        let decoded = decode(&code, &timing, &blocks, truth.sensor_offset_ns + 50_000_000).unwrap();
        let t2 = std::time::Instant::now();
        println!(
            "sim {:?} decode {:?} frames {} dropped {} noise {:.4} drift {} {} id {} q {}",
            t1 - t0,
            t2 - t1,
            decoded.frames.len(),
            decoded.dropped,
            decoded.noise,
            decoded.lock.drift_ppm,
            1e6 * truth.sensor_drift,
            decoded.identity_percent,
            decoded.lock.quality
        );
        println!("first {} {}", decoded.frames[0].number, (40e9 - 1_000_000_123.0) / 1_055_966.2);
        let settings = Settings {
            timing,
            tip: tip.tip,
            tip_sigma_m: 1e-4,
            aperture_m: 2.5e-3,
            priors: Priors::many_points(truth.raster),
            known: Known::default(),
            volume: truth.volume,
            seed: 1,
        };
        let got = solve(&code, &decoded, &Trajectory::new(&poses), &settings).unwrap();
        println!("solve {:?}", t2.elapsed());
        let points = truth.volume.points(&truth.projector, truth.raster);
        let mut e: Vec<f64> = points
            .iter()
            .map(|p| (got.model.project(*p).unwrap() - truth.projector.project(*p).unwrap()).length())
            .collect();
        e.sort_by(f64::total_cmp);
        println!("p50 {:.3} p99 {:.3} predicted {:.3} latency error {:.1} us +- {:.1} tip {:.1} um aperture {:.2} rms_px {:.2} level {:.3} frames {}", e[e.len() / 2], e[e.len() * 99 / 100], got.predicted.p99_px,
            1e-3 * (got.latency_ns as f64 - truth.latency_ns), 1e-3 * got.latency_sigma_ns, 1e6 * (got.tip - truth.tip).length(), 1e3 * got.aperture_m, got.rms_px, got.rms_level, got.frames);
    }
}
