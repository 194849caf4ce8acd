//! The latency alone, against a truth that the solver does not know.

use super::bench::TIMING;
use super::photodiode::record;
use super::tracker::Tracker;
use super::truth::{Bias, Hand, Truth};
use crate::model::ProjectorModel;
use crate::projector::{PlaceHint, Priors};
use crate::sensor::{decode, solve_latency, Code, Latency, SensorError, Settings};
use crate::trajectory::{TimedPose, Trajectory};
use glam::DVec3;

/// Ten seconds of motion.
const SWEEP_S: [f64; 2] = [40.0, 50.0];

fn latency(truth: &Truth, known: &ProjectorModel, seed: u64, late_ns: i64) -> Result<Latency, SensorError> {
    let middle = 0.5 * (truth.volume.low + truth.volume.high);
    let code = Code::new(truth.raster).expect("a usual raster");
    let hand = Hand::sweeping(&truth.volume, seed);
    let tracker = Tracker { seed: seed + 7000, latency_ns: truth.latency_ns, bias: Bias::None };
    let mut poses: Vec<TimedPose> =
        tracker.wand(&hand, truth.tip, middle, SWEEP_S[0] - 1.0, SWEEP_S[1] + 1.0);
    poses.iter_mut().for_each(|p| p.stamp_ns += late_ns);
    let blocks = record(truth, &code, &TIMING, &hand, SWEEP_S, seed);
    let decoded = decode(&code, &TIMING, &blocks, truth.sensor_offset_ns, &|slot| slot).expect("lit");
    let settings = Settings {
        timing: TIMING,
        // Half a millimetre off, as a pivot may be.
        tip: truth.tip + DVec3::new(3e-4, -3e-4, 2e-4),
        tip_sigma_m: 5e-4,
        aperture_m: 2.5e-3,
        priors: Priors::held(known),
        known: PlaceHint::default(),
        volume: truth.volume,
        seed,
    };
    solve_latency(&code, &decoded, &Trajectory::new(&poses), &settings, known)
}

#[test]
fn a_moved_projector_and_far_clocks_are_refused_by_name() {
    let truth = Truth::draw(5);
    let mut moved = truth.projector;
    moved.centre.x += 12.0;
    moved.focal *= 1.02;
    let told = latency(&truth, &moved, 5, 0).unwrap_err();
    assert!(matches!(told, SensorError::OtherProjector { .. }), "{told}");
    let told = latency(&truth, &truth.projector, 5, 70_000_000).unwrap_err();
    assert!(matches!(told, SensorError::LatencyAtBound { .. }), "{told}");
}

/// Simulated seconds.
mod breadth {
    use super::*;

    #[test]
    fn ten_seconds_tell_the_latency_of_a_known_projector() {
        for seed in 0..4 {
            let truth = Truth::draw(seed);
            let got = latency(&truth, &truth.projector, seed, 0).unwrap();
            let off = got.latency_ns as f64 - truth.latency_ns;
            assert!(off.abs() < 50e3 && off.abs() < 4.5 * got.sigma_ns, "{seed}: off by {off} ns, {got:?}");
            assert!(got.sigma_ns < 50e3, "{got:?}");
        }
    }
}
