//! Sweeps that would give a wrong projector: refused by name, from ten seconds of samples.

use super::photodiode::record;
use super::tracker::Tracker;
use super::truth::{Bias, Hand, Truth};
use crate::projector::{moved_px, PlaceHint, PointsRefusal, Priors};
use crate::sensor::{
    decode, solve, Code, Coverage, Decoding, Role, SampleBlock, SensorError, Settings, Solution, Timing,
    PLANES,
};
use crate::trajectory::{TimedPose, Trajectory};
use glam::{DQuat, DVec2, DVec3};

const TIMING: Timing = Timing { frame_zero_ns: 1_000_000_123, frame_ns: 1_055_966.2 };

struct DrawnSweep {
    truth: Truth,
    code: Code,
    blocks: Vec<SampleBlock>,
    decoded: Decoding,
    poses: Vec<TimedPose>,
}

fn settings(truth: &Truth) -> Settings {
    Settings {
        timing: TIMING,
        tip: truth.tip,
        tip_sigma_m: 1e-4,
        aperture_m: 3e-3,
        priors: Priors::many_points(truth.raster),
        known: PlaceHint { distance_m: None, up: Some(DVec3::Y) },
        volume: truth.volume,
        seed: 1,
    }
}

fn sweep(seed: u64, seconds: f64) -> DrawnSweep {
    let truth = Truth::draw(seed);
    let code = Code::new(truth.raster).unwrap();
    let hand = Hand::sweeping(&truth.volume, seed);
    let tracker = Tracker { seed, latency_ns: truth.latency_ns, bias: Bias::None };
    let poses = tracker.wand(&hand, truth.tip, DVec3::ZERO, 38.0, 42.0 + seconds);
    let blocks = record(&truth, &code, &TIMING, &hand, [40.0, 40.0 + seconds], seed);
    let decoded = decode(&code, &TIMING, &blocks, truth.sensor_offset_ns, &|slot| slot).unwrap();
    DrawnSweep { truth, code, blocks, decoded, poses }
}

impl DrawnSweep {
    /// Solves from poses that were changed.
    fn with(&self, change: impl Fn(usize, &mut TimedPose)) -> Result<Solution, SensorError> {
        self.with_tip(self.truth.tip, change)
    }

    /// The same, for a wand whose tip came out elsewhere.
    fn with_tip(&self, tip: DVec3, change: impl Fn(usize, &mut TimedPose)) -> Result<Solution, SensorError> {
        let mut poses = self.poses.clone();
        poses.iter_mut().enumerate().for_each(|(i, pose)| change(i, pose));
        let settings = Settings { tip, ..settings(&self.truth) };
        solve(&self.code, &self.decoded, &Trajectory::new(&poses), &settings)
    }
}

#[test]
fn a_sweep_says_what_it_has_not_seen() {
    let short = sweep(6, 3.0);
    let mut coverage = Coverage::new(short.code.clone());
    // Second by second, as a recorder hands them over.
    let seen: usize =
        short.blocks.chunks(100).map(|part| coverage.add(TIMING.frame_ns, part).unwrap_or(0)).sum();
    assert!(seen > 1000 && seen <= short.decoded.frames.len() + 6, "{seen}");
    assert!(coverage.share() < 0.85, "{coverage:?}");
    assert!(coverage.advice().contains("near and far"), "{}", coverage.advice());
    // The emptiest cell is indeed one that hardly any frame has seen.
    let near = |f: &crate::sensor::SensorFrame| {
        let seconds = 1e-9 * (TIMING.instant(f.number, 12.0).0 as f64);
        let tip = Hand::sweeping(&short.truth.volume, 6).at(seconds).0;
        short
            .truth
            .projector
            .project(tip)
            .is_some_and(|p| (p - coverage.emptiest()).abs().cmplt(DVec2::new(60.0, 60.0)).all())
    };
    assert!(short.decoded.frames.iter().filter(|f| near(f)).count() < 20);
    assert!(coverage.add(TIMING.frame_ns, &[]).is_err());
}

/// The decoder's frames are numbered by the identity, and their levels are those of the code at the tip's true place.
#[test]
fn decoded_frames_are_those_that_were_shown() {
    let sweep = sweep(7, 4.0);
    assert!((sweep.decoded.lock.drift_ppm - 1e6 * sweep.truth.sensor_drift).abs() < 0.05);
    assert!(sweep.decoded.identity_percent > 99.9);
    let hand = Hand::sweeping(&sweep.truth.volume, 7);
    let (mut right, mut all) = (0, 0);
    for frame in &sweep.decoded.frames {
        for plane in 2..PLANES - 2 {
            let (Role::Column { width } | Role::Row { width }) = sweep.code.role(plane) else { continue };
            let (ns, _) = TIMING.instant(frame.number, plane as f64 + 0.5);
            let pixel = sweep.truth.projector.project(hand.at(1e-9 * ns as f64).0).unwrap();
            let (off, on) = frame.references(plane);
            let level = (f64::from(frame.levels[plane]) - off) / (on - off);
            let lit = sweep.code.lit(frame.number, plane, pixel.x as u32, pixel.y as u32);
            // Stripes that the aperture resolves.
            if width >= 16 {
                all += 1;
                right += u32::from((level > 0.5) == lit);
            }
        }
    }
    assert!(all > 10_000 && f64::from(right) > 0.99 * f64::from(all), "{right} of {all}");
}

/// Whole sweeps, from simulated seconds.
mod breadth {
    use super::*;

    #[test]
    fn sweeps_with_a_fault_are_refused_by_name() {
        let sweep = sweep(5, 10.0);
        sweep.with(|_, _| {}).unwrap();
        // A left-handed tracker: places, turns and the wand's own frame are mirrored.
        let tip = sweep.truth.tip * DVec3::new(-1.0, 1.0, 1.0);
        let mirrored = sweep.with_tip(tip, |_, p| {
            p.position.x = -p.position.x;
            p.rotation = DQuat::from_xyzw(p.rotation.x, -p.rotation.y, -p.rotation.z, p.rotation.w);
        });
        assert_eq!(mirrored.unwrap_err(), SensorError::Projector(PointsRefusal::Mirrored));
        let z_up = sweep.with(|_, p| {
            let turn = DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2);
            (p.position, p.rotation) = (turn * p.position, turn * p.rotation);
        });
        assert_eq!(
            z_up.unwrap_err(),
            SensorError::Projector(PointsRefusal::AxesExchanged { found: "Z", expected: "Y" })
        );
        let late = sweep.with(|_, p| p.stamp_ns += 300_000_000).unwrap_err();
        assert!(matches!(late, SensorError::LatencyAtBound { ms } if (250.0..350.0).contains(&ms)), "{late}");
        let half = sweep.poses.len() / 2;
        let moved = sweep.with(|i, p| p.position.x += if i > half { 0.02 } else { 0.0 }).unwrap_err();
        assert!(matches!(moved, SensorError::Projector(PointsRefusal::Moved { .. })), "{moved}");
        let flat = sweep.with(|_, p| p.position.z = 0.0).unwrap_err();
        assert!(matches!(flat, SensorError::Projector(_) | SensorError::DoesNotFit { .. }), "{flat}");
        let unit = sweep.with_tip(1000.0 * sweep.truth.tip, |_, p| p.position *= 1000.0).unwrap_err();
        assert!(
            matches!(unit, SensorError::Projector(PointsRefusal::WrongUnit { factor: 1000.0, .. })),
            "{unit}"
        );
        let gone = sweep.with(|_, p| p.stamp_ns += 1_000_000_000_000).unwrap_err();
        assert!(matches!(gone, SensorError::TooFew { frames: 0, .. }), "{gone}");
    }

    /// Steps that the pixels of the bits do not show: the levels must tell of them, or the prediction must cover them.
    #[test]
    fn small_steps_of_the_tracker_are_told_or_predicted() {
        for seed in [6, 7] {
            let sweep = sweep(seed, 15.0);
            let Truth { raster, projector, volume, .. } = &sweep.truth;
            let half = sweep.poses.len() / 2;
            for moved_mm in [0.0, 1.0, 2.0, 8.0] {
                let solved = sweep.with(|i, p| p.position.x += if i > half { 1e-3 * moved_mm } else { 0.0 });
                match solved {
                    Ok(s) => {
                        let (off, predicted) =
                            (moved_px(*raster, &s.model, projector, volume), s.predicted.p99_px);
                        println!("{seed}, {moved_mm} mm: {off:.3} px, predicted {predicted:.3} px");
                        // Twice, because after a step no projector is near the light of both parts.
                        assert!(off < 2.0 * predicted && moved_mm < 3.0, "{seed}: {moved_mm} mm, {off} px");
                    }
                    Err(
                        SensorError::Changed { .. } | SensorError::Projector(PointsRefusal::Moved { .. }),
                    ) => {
                        assert!(moved_mm > 0.0);
                    }
                    Err(other) => panic!("{seed}, {moved_mm} mm: {other}"),
                }
            }
        }
    }
}
