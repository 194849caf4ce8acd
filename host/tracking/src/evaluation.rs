//! Measures errors at the instant of light: closed-form motions through the mock tracker and the pose filter, as a
//! table.

use super::pose_filter::{PoseFilter, PoseFilterConfig, Prediction};
use dpm_common::quantiles::Quantiles;
use dpm_common::so3::so3_between;
use dpm_device::pose::Pose;
use dpm_device::time::{FrameRate, HostTime};
use dpm_device::tracker::{BodyIndex, Tracker};
use dpm_mock::motion::{Motion, MotionError, MotionSpec};
use dpm_mock::tracker::{MockTracker, MockTrackerConfig, MockTrackerError};
use glam::{DQuat, DVec3};
use std::fmt::Write;

/// The rig around the filter.
#[derive(Clone, Debug)]
pub(crate) struct EvaluationConfig {
    /// Rate, latency, noise and seed of the tracker.
    pub tracker: MockTrackerConfig,
    /// Frames per second.
    pub frame_rate: FrameRate,
    /// From the latch of the pose to the middle of the exposure, ns: 2.8 ms by default, which is the sum of the rig
    /// file's stage costs and half a slot.
    pub latch_to_light_ns: i64,
    /// Frames that are compared.
    pub frames: u64,
    /// Frames before them, for acquisition.
    pub settle_frames: u64,
}

impl EvaluationConfig {
    /// 500 Hz, 2 ms of tracker latency, 947 fps, 20 s; noise as standard deviation per axis, m and rad.
    pub(crate) fn with_noise(position_noise_m: f64, rotation_noise_rad: f64) -> Self {
        Self {
            tracker: MockTrackerConfig { position_noise_m, rotation_noise_rad, ..Default::default() },
            frame_rate: FrameRate::new(947, 1).expect("not zero"),
            latch_to_light_ns: 2_800_000,
            frames: 20 * 947,
            settle_frames: 474,
        }
    }
}

/// Errors at the instant of light.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct PredictionErrors {
    /// Distance between predicted and true position, m.
    pub position_m: Quantiles,
    /// Angle between predicted and true rotation, rad.
    pub rotation_rad: Quantiles,
    /// Least and greatest horizon from capture to light, ns.
    pub horizon_ns: (i64, i64),
    /// Frames without any pose.
    pub frames_without_pose: u64,
}

/// Why there is nothing to evaluate.
#[derive(Debug, thiserror::Error)]
pub(crate) enum EvaluationError {
    /// The motion does not exist.
    #[error(transparent)]
    Motion(#[from] MotionError),
    /// The tracker does not exist.
    #[error(transparent)]
    Tracker(#[from] MockTrackerError),
    /// The tracker failed.
    #[error(transparent)]
    Poll(#[from] dpm_device::tracker::TrackerError),
}

/// Runs one motion through tracker and filter and compares with the truth at every frame's light.
pub(crate) fn evaluate(
    motion: &MotionSpec,
    filter: PoseFilterConfig,
    rig: &EvaluationConfig,
) -> Result<PredictionErrors, EvaluationError> {
    let mut filter = PoseFilter::new(filter);
    let mut tracker = MockTracker::new(rig.tracker.clone(), vec![Motion::new(motion, Pose::IDENTITY)?])?;
    let body = BodyIndex(0);
    let (mut position, mut rotation) = (Vec::new(), Vec::new());
    let mut errors = PredictionErrors { horizon_ns: (i64::MAX, i64::MIN), ..Default::default() };
    for slot in 0..rig.settle_frames + rig.frames {
        let light_at = HostTime(rig.frame_rate.slot_start_ns(slot));
        tracker.poll(light_at.plus_ns(-rig.latch_to_light_ns), &mut |sample| {
            filter.update(sample);
        })?;
        if slot < rig.settle_frames {
            continue;
        }
        let truth = tracker.true_pose(body, light_at.ns_since(rig.tracker.start));
        let (Some(predicted), Some(truth)) = (filter.predict(light_at), truth) else {
            errors.frames_without_pose += 1;
            continue;
        };
        let offset = DVec3::from_array(predicted.pose.position_m) - DVec3::from_array(truth.position_m);
        position.push(offset.length());
        let turn = so3_between(
            DQuat::from_array(truth.rotation_xyzw),
            DQuat::from_array(predicted.pose.rotation_xyzw),
        );
        rotation.push(turn.length());
        errors.horizon_ns.0 = errors.horizon_ns.0.min(predicted.horizon_ns);
        errors.horizon_ns.1 = errors.horizon_ns.1.max(predicted.horizon_ns);
    }
    errors.position_m = Quantiles::of(position);
    errors.rotation_rad = Quantiles::of(rotation);
    Ok(errors)
}

/// A row of the table: a motion, and the maximum error with 0.1 mm and 1 mrad of noise and without.
#[derive(Clone, Debug)]
pub(crate) struct PredictionCase {
    /// As printed.
    pub name: &'static str,
    /// What moves.
    pub motion: MotionSpec,
    /// 99th percentile allowed with noise and without: mm for translations, mrad for rotations.
    pub p99_allowed: [f64; 2],
    /// Whether the row is about rotation.
    pub rotates: bool,
}

/// The motions of the table.
pub(crate) fn prediction_cases() -> Vec<PredictionCase> {
    let shuttle = MotionSpec::shuttle;
    let resting = MotionSpec::Translate {
        direction: [1.0, 0.0, 0.0],
        speed_m_s: 0.5,
        amplitude_m: 0.15,
        acceleration_m_s2: 5.0,
        rest_s: 0.2,
    };
    let circle = |rate_rad_s, radius_m| MotionSpec::Rotate {
        axis: [0.0, 1.0, 0.0],
        rate_rad_s,
        pivot_offset_m: [radius_m, 0.0, 0.0],
    };
    let sine = |direction, peak_speed_m_s, peak_acceleration_m_s2| MotionSpec::Sinusoid {
        direction,
        peak_speed_m_s,
        peak_acceleration_m_s2,
    };
    let case = |name, motion, with_noise, without| PredictionCase {
        name,
        motion,
        p99_allowed: [with_noise, without],
        rotates: false,
    };
    let turn = |name, motion, with_noise, without| PredictionCase {
        name,
        motion,
        p99_allowed: [with_noise, without],
        rotates: true,
    };
    let up = [0.0, 1.0, 0.0];
    vec![
        case("at rest", MotionSpec::Still {}, 0.15, 1e-6),
        case("1 m/s, steady", shuttle(1.0, 25.0, 20.0), 0.15, 1e-4),
        case("0.5 m/s there and back, 5 m/s2, 0.1 m", shuttle(0.5, 0.05, 5.0), 0.20, 0.04),
        case("0.5 m/s there and back, 5 m/s2, 0.3 m", shuttle(0.5, 0.15, 5.0), 0.20, 0.025),
        case("0.5 m/s there and back, 5 m/s2, 1 m", shuttle(0.5, 0.5, 5.0), 0.20, 0.01),
        case("the same, 0.3 m, at rest for 0.2 s at each end", resting, 0.25, 0.03),
        case("circle, 0.5 m/s and 5 m/s2", circle(10.0, 0.05), 0.20, 0.005),
        case("sine, 0.5 m/s and 5 m/s2 at its peaks", sine([1.0, 0.0, 0.0], 0.5, 5.0), 0.20, 0.005),
        case("the same along a diagonal", sine([1.0, 1.0, 1.0], 0.5, 5.0), 0.20, 0.005),
        case("sine, 0.35 m/s and 5 m/s2", sine([1.0, 0.0, 0.0], 0.35, 5.0), 0.20, 0.03),
        case("sine, 0.8 m/s and 5 m/s2", sine([1.0, 0.0, 0.0], 0.8, 5.0), 0.20, 0.01),
        case("1 m/s there and back, 8 m/s2, 0.26 m (demo)", shuttle(1.0, 0.13, 8.0), 0.25, 0.07),
        case("1 m/s there and back, 20 m/s2, 0.3 m", shuttle(1.0, 0.15, 20.0), 0.40, 0.20),
        case("1 m/s there and back, 50 m/s2, 0.3 m", shuttle(1.0, 0.15, 50.0), 0.45, 0.8),
        turn(
            "half a turn a second",
            MotionSpec::Rotate { axis: up, rate_rad_s: std::f64::consts::PI, pivot_offset_m: [0.0; 3] },
            1.2,
            1e-4,
        ),
        turn(
            "100 rad/s",
            MotionSpec::Rotate { axis: up, rate_rad_s: 100.0, pivot_offset_m: [0.0; 3] },
            1.6,
            1e-3,
        ),
        turn(
            "sway, 3 rad/s and 20 rad/s2 at its peaks",
            MotionSpec::Sway { axis: up, peak_rate_rad_s: 3.0, peak_acceleration_rad_s2: 20.0 },
            1.7,
            0.03,
        ),
    ]
}

impl PredictionCase {
    /// The 99th percentile that the case judges: mm or mrad.
    pub(crate) fn p99(&self, errors: &PredictionErrors) -> f64 {
        1e3 * if self.rotates { errors.rotation_rad.p99 } else { errors.position_m.p99 }
    }
}

/// The results of a case.
#[derive(Clone, Debug)]
pub(crate) struct PredictionRow {
    /// The case.
    pub case: PredictionCase,
    /// With 0.1 mm and 1 mrad of noise.
    pub noisy: PredictionErrors,
    /// The same by a filter without recall.
    pub noisy_unrecalled: PredictionErrors,
    /// With a tenth of that noise.
    pub fine: PredictionErrors,
    /// The same by a filter without recall.
    pub fine_unrecalled: PredictionErrors,
    /// Without noise.
    pub quiet: PredictionErrors,
    /// Without noise, the newest sample held.
    pub held: PredictionErrors,
}

/// All cases, measured.
///
/// # Errors
/// As [`evaluate`].
pub(crate) fn prediction_rows() -> Result<Vec<PredictionRow>, EvaluationError> {
    let on = PoseFilterConfig::default();
    let off = PoseFilterConfig { prediction: Prediction::Off, ..on };
    let [noisy, fine, quiet] =
        [(1e-4, 1e-3), (1e-5, 1e-4), (0.0, 0.0)].map(|(m, rad)| EvaluationConfig::with_noise(m, rad));
    let row = |case: PredictionCase| {
        let run = |filter, rig| evaluate(&case.motion, filter, rig);
        Ok(PredictionRow {
            noisy: run(on, &noisy)?,
            noisy_unrecalled: run(on.without_recall(), &noisy)?,
            fine: run(on, &fine)?,
            fine_unrecalled: run(on.without_recall(), &fine)?,
            quiet: run(on, &quiet)?,
            held: run(off, &quiet)?,
            case,
        })
    };
    prediction_cases().into_iter().map(row).collect()
}

/// The table of `docs/lab/PREDICTION.md` in Markdown: 99th percentile of the error at the instant of light.
pub(crate) fn prediction_table(rows: &[PredictionRow]) -> String {
    let mut table = String::from(
        "| motion | 0.1 mm | without the fifth filter | 0.01 mm | without the fifth filter | no noise | held, no noise | unit |\n\
         |---|---:|---:|---:|---:|---:|---:|---|\n",
    );
    for row in rows {
        let all = [&row.noisy, &row.noisy_unrecalled, &row.fine, &row.fine_unrecalled, &row.quiet, &row.held];
        let [a, b, c, d, e, f] = all.map(|errors| row.case.p99(errors));
        let (name, unit) = (row.case.name, if row.case.rotates { "mrad" } else { "mm" });
        // Writing to a String cannot fail.
        let _ = writeln!(table, "| {name} | {a:.3} | {b:.3} | {c:.3} | {d:.3} | {e:.4} | {f:.2} | {unit} |");
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Five waves at once, which together have the power of a swing of 0.5 m/s and 5 m/s2.
    fn hand() -> MotionSpec {
        let peak_speed_m_s = 0.5 / 5f64.sqrt();
        let wave = |(i, by): (usize, f64)| {
            let (sin, cos) = (1.3 * i as f64).sin_cos();
            let peak_acceleration_m_s2 = 10.0 * by * peak_speed_m_s;
            MotionSpec::Sinusoid { direction: [cos, sin, 0.0], peak_speed_m_s, peak_acceleration_m_s2 }
        };
        let waves = [0.34, 0.64, 0.96, 1.22, 1.47];
        MotionSpec::Together { parts: waves.into_iter().enumerate().map(wave).collect() }
    }

    /// Every motion and every predictor.
    mod breadth {
        use super::*;

        /// `cargo test -p dpm-tracking --lib far_ahead_table -- --nocapture` prints the table: a tracker at 120 Hz with 0.2 mm
        /// of noise, frames at 60 a second, 32, 42 and 50 ms ahead.
        #[test]
        fn far_ahead_table_keeps_its_bounds() {
            let swing = MotionSpec::Sinusoid {
                direction: [1.0, 0.0, 0.0],
                peak_speed_m_s: 0.5,
                peak_acceleration_m_s2: 5.0,
            };
            let circle = MotionSpec::Rotate {
                axis: [0.0, 0.0, 1.0],
                rate_rad_s: 10.0,
                pivot_offset_m: [0.05, 0.0, 0.0],
            };
            let turns = MotionSpec::shuttle(0.5, 0.15, 5.0);
            let rows = [
                ("swing", swing, [1.4, 1.7, 2.2]),
                ("circle", circle, [1.4, 1.8, 2.2]),
                ("a hand", hand(), [3.3, 4.6, 6.2]),
                ("to and fro with sudden turns", turns, [5.6, 6.8, 10.0]),
            ];
            for (name, motion, most) in rows {
                let p99 = [16, 26, 36].map(|latch_ms| {
                    let rate = FrameRate::new(120, 1).unwrap();
                    let mut rig = EvaluationConfig::with_noise(2e-4, 1e-3);
                    rig.tracker = MockTrackerConfig { rate, latency_ns: 10_000_000, ..rig.tracker };
                    let frame_rate = FrameRate::new(60, 1).unwrap();
                    let latch_to_light_ns = latch_ms * 1_000_000;
                    let rig = EvaluationConfig {
                        frame_rate,
                        latch_to_light_ns,
                        frames: 1800,
                        settle_frames: 120,
                        ..rig
                    };
                    let far =
                        PoseFilterConfig { lost_after_ns: 1_000_000_000, ..PoseFilterConfig::default() };
                    let errors = evaluate(&motion, far, &rig).unwrap();
                    (1e-6 * errors.horizon_ns.1 as f64, 1e3 * errors.position_m.p99)
                });
                println!("{name}: {p99:.2?}");
                assert!(p99.iter().zip(most).all(|((_, mm), most)| *mm <= most), "{name}: {p99:?}");
            }
        }

        /// `cargo test -p dpm-tracking --lib prediction_table -- --nocapture` prints the table.
        #[test]
        fn prediction_table_keeps_its_bounds() {
            let rows = prediction_rows().unwrap();
            println!("{}", prediction_table(&rows));
            for row in &rows {
                let PredictionRow { case, noisy, fine, quiet, .. } = row;
                for (e, allowed) in [noisy, quiet].into_iter().zip(case.p99_allowed) {
                    let p99 = case.p99(e);
                    assert!(p99 <= allowed, "{}: {p99} > {allowed}", case.name);
                }
                for e in [noisy, fine, quiet] {
                    assert_eq!(e.frames_without_pose, 0);
                    // Between two samples lie 2 ms, and everything is predicted to the frame's own light.
                    assert!(e.horizon_ns.0 >= 4_800_000 && e.horizon_ns.1 <= 6_800_000, "{:?}", e.horizon_ns);
                }
                // At the noise for which the models were optimised, recall does no harm; below it, the past's own error
                // becomes visible.
                let (with, without) = (case.p99(noisy), case.p99(&row.noisy_unrecalled));
                // Five in a hundred are chance.
                assert!(
                    with <= 1.05 * without,
                    "{}: {with} with, {without} without what is recalled",
                    case.name
                );
                let (with, without) = (case.p99(fine), case.p99(&row.fine_unrecalled));
                assert!(
                    with <= 1.7 * without,
                    "{}: {with} with, {without} without what is recalled",
                    case.name
                );
            }
        }
    }
}
