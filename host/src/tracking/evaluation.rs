//! Closed-form motions through a simulated tracker and the filter into errors at the instant of light.

use super::pose_filter::{PoseFilter, PoseFilterConfig};
use super::testing::Gauss;
use crate::geometry::se3::{so3_between, so3_exp};
use dpm_device::pose::Pose;
use dpm_device::time::{FrameRate, HostTime};
use dpm_device::tracker::{BodyIndex, TrackerSample};
use glam::{DQuat, DVec3};

/// A motion with a closed form: world-from-body at every instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TestMotion {
    /// Does not move.
    Still,
    /// To and fro along `axis` over `stroke_m` at `speed_m_s`, turning round at constant `acceleration_m_s2`.
    Shuttle {
        /// Direction, unit.
        axis: DVec3,
        /// Speed between the turns, m/s.
        speed_m_s: f64,
        /// During the turns, m/s^2.
        acceleration_m_s2: f64,
        /// Seconds at constant speed between two turns.
        cruise_s: f64,
    },
    /// Constant velocity.
    Coast(DVec3),
    /// Rotation in place at a constant world-space angular velocity, rad/s.
    Spin(DVec3),
    /// Rotation to and fro about an axis: amplitude (rad), frequency (Hz).
    Swing(DVec3, f64),
    /// A harmonic translation: amplitude vector (m), frequency (Hz).
    Harmonic(DVec3, f64),
    /// A circle in the plane of x and y: radius (m), angular velocity (rad/s); the body turns along.
    Circle(f64, f64),
}

impl TestMotion {
    /// Truth at `t` seconds.
    pub fn at(&self, t: f64) -> (DVec3, DQuat) {
        match *self {
            Self::Still => (DVec3::new(0.1, 0.2, 0.3), so3_exp(DVec3::new(0.3, 0.2, 0.1))),
            Self::Shuttle { axis, speed_m_s: v, acceleration_m_s2: a, cruise_s } => {
                let turn = 2.0 * v / a;
                let half = cruise_s + turn;
                let phase = t.rem_euclid(2.0 * half);
                let (sign, u) = if phase < half { (1.0, phase) } else { (-1.0, phase - half) };
                // Starts at the middle of a stroke's beginning: cruise first, then the turn.
                let reach = v * cruise_s;
                let along = if u < cruise_s {
                    v * u
                } else {
                    let w = u - cruise_s;
                    reach + v * w - 0.5 * a * w * w
                };
                let x = if sign > 0.0 { along } else { reach - along };
                (axis * x, DQuat::IDENTITY)
            }
            Self::Coast(v) => (v * t, DQuat::IDENTITY),
            Self::Spin(w) => (DVec3::ZERO, so3_exp(w * t)),
            Self::Swing(amplitude, hz) => {
                (DVec3::ZERO, so3_exp(amplitude * (std::f64::consts::TAU * hz * t).sin()))
            }
            Self::Harmonic(amplitude, hz) => {
                (amplitude * (std::f64::consts::TAU * hz * t).sin(), DQuat::IDENTITY)
            }
            Self::Circle(r, w) => {
                (DVec3::new(r * (w * t).cos(), r * (w * t).sin(), 0.0), so3_exp(DVec3::Z * (w * t)))
            }
        }
    }
}

/// A simulated rig around the filter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EvaluationConfig {
    /// Samples per second.
    pub tracker_hz: u32,
    /// Standard deviation per axis, m.
    pub position_noise_m: f64,
    /// Standard deviation per axis, rad.
    pub rotation_noise_rad: f64,
    /// From mid-exposure to arrival, ns.
    pub tracker_latency_ns: i64,
    /// From the latch of the pose to the light, ns.
    pub latch_to_light_ns: i64,
    /// Frames per second.
    pub frame_rate: FrameRate,
    /// Simulated time, s; the first `settle_s` count for nothing.
    pub seconds: f64,
    /// Time for acquisition, s.
    pub settle_s: f64,
    /// Of the noise.
    pub seed: u64,
}

impl Default for EvaluationConfig {
    fn default() -> Self {
        Self {
            tracker_hz: 500,
            position_noise_m: 1e-4,
            rotation_noise_rad: 1e-3,
            tracker_latency_ns: 1_500_000,
            latch_to_light_ns: 2_100_000,
            frame_rate: FrameRate::new(947, 1).expect("not zero"),
            seconds: 20.0,
            settle_s: 0.5,
            seed: 1,
        }
    }
}

/// Quantiles of an error.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[allow(missing_docs)] // named after what they are
pub struct Quantiles {
    pub p50: f64,
    pub p99: f64,
    pub max: f64,
    pub rms: f64,
}

impl Quantiles {
    fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let n = values.len();
        if n == 0 {
            return Self::default();
        }
        let at = |q: f64| values[((n as f64 * q).ceil() as usize).clamp(1, n) - 1];
        let rms = (values.iter().map(|v| v * v).sum::<f64>() / n as f64).sqrt();
        Self { p50: at(0.5), p99: at(0.99), max: values[n - 1], rms }
    }
}

/// Errors at the instant of light.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PredictionErrors {
    /// Distance between predicted and true position, m.
    pub position_m: Quantiles,
    /// Angle between predicted and true rotation, rad.
    pub rotation_rad: Quantiles,
    /// Horizon from capture to light, ns: least and greatest.
    pub horizon_ns: (i64, i64),
    /// Frames that had a pose.
    pub frames: usize,
    /// Frames that had none.
    pub frames_without_pose: usize,
}

/// Runs one motion through tracker and filter and compares with the truth at every frame's light.
pub fn evaluate(motion: &TestMotion, filter: PoseFilterConfig, rig: &EvaluationConfig) -> PredictionErrors {
    let mut filter = PoseFilter::new(filter);
    let mut gauss = Gauss::new(rig.seed);
    let (mut position, mut rotation) = (Vec::new(), Vec::new());
    let mut errors = PredictionErrors { horizon_ns: (i64::MAX, i64::MIN), ..Default::default() };
    let tracker = FrameRate::new(rig.tracker_hz, 1).unwrap_or(rig.frame_rate);
    let mut next_sample = 0u64;
    let slots = (rig.seconds * rig.frame_rate.hz()) as u64;
    for slot in 0..slots {
        let light_at = HostTime(rig.frame_rate.slot_start_ns(slot));
        let latched_at = light_at.plus_ns(-rig.latch_to_light_ns);
        loop {
            let captured_at = HostTime(tracker.slot_start_ns(next_sample));
            let received_at = captured_at.plus_ns(rig.tracker_latency_ns);
            if received_at > latched_at {
                break;
            }
            let (p, q) = motion.at(captured_at.0 as f64 * 1e-9);
            let p = p + gauss.vector(rig.position_noise_m);
            let q = (so3_exp(gauss.vector(rig.rotation_noise_rad)) * q).normalize();
            filter.update(&TrackerSample {
                body: BodyIndex(0),
                pose: Pose { position_m: p.to_array(), rotation_xyzw: q.to_array() },
                tracked: true,
                mean_error_m: 0.0,
                sequence: next_sample as u32,
                captured_at,
                received_at,
            });
            next_sample += 1;
        }
        let t = light_at.0 as f64 * 1e-9;
        if t < rig.settle_s {
            continue;
        }
        let Some(predicted) = filter.predict(light_at) else {
            errors.frames_without_pose += 1;
            continue;
        };
        let (p, q) = motion.at(t);
        position.push((DVec3::from_array(predicted.pose.position_m) - p).length());
        rotation.push(so3_between(q, DQuat::from_array(predicted.pose.rotation_xyzw)).length());
        errors.horizon_ns.0 = errors.horizon_ns.0.min(predicted.horizon_ns);
        errors.horizon_ns.1 = errors.horizon_ns.1.max(predicted.horizon_ns);
        errors.frames += 1;
    }
    errors.position_m = Quantiles::of(position);
    errors.rotation_rad = Quantiles::of(rotation);
    errors
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_by_motion() {
        let rows = motions();
        for noise in [1e-4, 0.0] {
            let rig = EvaluationConfig {
                position_noise_m: noise,
                rotation_noise_rad: 10.0 * noise,
                ..Default::default()
            };
            for (name, motion) in &rows {
                let e = evaluate(motion, PoseFilterConfig::default(), &rig);
                println!("{noise:7.0e} {name:28} pos mm p50 {:.4} p99 {:.4} max {:.4} rms {:.4} | rot mrad p50 {:.4} p99 {:.4} max {:.4}  h {:?}",
                    e.position_m.p50 * 1e3, e.position_m.p99 * 1e3, e.position_m.max * 1e3, e.position_m.rms * 1e3,
                    e.rotation_rad.p50 * 1e3, e.rotation_rad.p99 * 1e3, e.rotation_rad.max * 1e3, e.horizon_ns);
                assert_eq!(e.frames_without_pose, 0);
                if *name == "coast 1 m/s" && noise == 0.0 {
                    assert!(e.position_m.p99 < 1e-8);
                }
            }
        }
    }

    fn motions() -> Vec<(&'static str, TestMotion)> {
        let axis = DVec3::X;
        let s = |v, a, c| TestMotion::Shuttle { axis, speed_m_s: v, acceleration_m_s2: a, cruise_s: c };
        vec![
            ("still", TestMotion::Still),
            ("coast 1 m/s", TestMotion::Coast(DVec3::X)),
            ("0.5 m/s, 5 m/s2, 0.4 s", s(0.5, 5.0, 0.4)),
            ("0.5 m/s, 5 m/s2, 0.8 s", s(0.5, 5.0, 0.8)),
            ("1 m/s, 50 m/s2, 0.3 s", s(1.0, 50.0, 0.3)),
            ("1 m/s, 50 m/s2, 0.5 s", s(1.0, 50.0, 0.5)),
            ("sine 0.5 m/s 5 m/s2", TestMotion::Harmonic(DVec3::X * 0.05, 10.0 / std::f64::consts::TAU)),
            (
                "sine 0.5 m/s 5 m/s2 diag",
                TestMotion::Harmonic(DVec3::ONE.normalize() * 0.05, 10.0 / std::f64::consts::TAU),
            ),
            ("harmonic 0.1 m 1 Hz", TestMotion::Harmonic(DVec3::X * 0.1, 1.0)),
            ("harmonic 0.1 m 3 Hz", TestMotion::Harmonic(DVec3::X * 0.1, 3.0)),
            ("circle 0.1 m 6 rad/s", TestMotion::Circle(0.1, 6.0)),
            ("spin 6 rad/s", TestMotion::Spin(DVec3::Y * 6.0)),
            ("swing 0.5 rad 1 Hz", TestMotion::Swing(DVec3::Y * 0.5, 1.0)),
        ]
    }
}
