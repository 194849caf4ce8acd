//! The tracker of the rehearsal: true poses into noisy, late reports.

use super::truth::{Bias, Hand};
use crate::trajectory::{TimedPose, POSITION_NOISE_M, ROTATION_NOISE_RAD};
use dpm_common::so3::so3_exp;
use dpm_device::rng::Draws;
use glam::{DQuat, DVec3};

/// Reports a second.
const RATE_HZ: f64 = 240.0;

/// A tracker.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tracker {
    pub seed: u64,
    /// A pose is stamped this much after it was taken.
    pub latency_ns: f64,
    pub bias: Bias,
}

impl Tracker {
    /// The wand's poses while a hand moves it from one time to another, seconds.
    pub(super) fn wand(
        &self,
        hand: &Hand,
        tip: DVec3,
        middle: DVec3,
        from_s: f64,
        to_s: f64,
    ) -> Vec<TimedPose> {
        let count = ((to_s - from_s) * RATE_HZ) as u64;
        (0..count)
            .map(|i| {
                let s = from_s + i as f64 / RATE_HZ;
                let (place, rotation) = hand.at(s);
                self.report(i, s, middle + place - rotation * tip, rotation)
            })
            .collect()
    }

    /// The report number `i` of a pose taken at `s` seconds.
    pub(super) fn report(&self, i: u64, s: f64, position: DVec3, rotation: DQuat) -> TimedPose {
        let d = Draws::new(self.seed).stream(0x7ac4);
        let normal = |k: u64| DVec3::from_array(d.normal3(2 * i + k));
        let off = self.bias.at(position, s, self.seed);
        TimedPose {
            stamp_ns: (1e9 * s + self.latency_ns).round() as i64,
            position: position + off + normal(0) * POSITION_NOISE_M,
            rotation: so3_exp(normal(1) * ROTATION_NOISE_RAD) * rotation,
        }
    }
}
