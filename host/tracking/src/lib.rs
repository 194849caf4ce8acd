//! Tracker samples into the pose of each body at the instant its light will fall.
//!
//! [`pose_filter`] judges and filters the samples of one body, [`state`] is its result as plain data and predicts,
//! [`bank`] keeps one filter a body. [`imm`], [`noise`] and [`recall`] (from smoothed samples) are the estimators inside.
//! The tests measure it all against closed-form motion. No sample is used before it arrived; everything is f64; time is integer nanoseconds.

mod bank;
#[cfg(test)]
mod evaluation;
pub mod imm;
mod noise;
pub mod pose_filter;
mod recall;
mod smooth;
mod state;

pub use bank::PoseFilterBank;
pub use pose_filter::{PoseFilter, PoseFilterConfig, Prediction, Verdict};
pub use state::{Freshness, PosePrediction, TrackState};

/// Seeded normal deviates for tests.
#[cfg(test)]
mod testing {
    use glam::DVec3;

    /// Normal deviates by Box and Muller over splitmix64.
    #[derive(Clone, Debug)]
    pub(crate) struct Gauss {
        state: u64,
        spare: Option<f64>,
    }

    impl Gauss {
        /// The same seed gives the same deviates on every machine.
        pub(crate) fn new(seed: u64) -> Self {
            Self { state: seed, spare: None }
        }

        /// Uniform in (0, 1).
        pub(crate) fn uniform(&mut self) -> f64 {
            self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let mut z = self.state;
            z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            ((z ^ (z >> 31)) >> 11) as f64 * (1.0 / (1u64 << 53) as f64) + f64::EPSILON / 4.0
        }

        /// Standard normal.
        pub(crate) fn normal(&mut self) -> f64 {
            if let Some(spare) = self.spare.take() {
                return spare;
            }
            let radius = (-2.0 * self.uniform().ln()).sqrt();
            let (sin, cos) = (std::f64::consts::TAU * self.uniform()).sin_cos();
            self.spare = Some(radius * sin);
            radius * cos
        }

        /// Three independent deviates of standard deviation `sigma`.
        pub(crate) fn vector(&mut self, sigma: f64) -> DVec3 {
            DVec3::new(self.normal(), self.normal(), self.normal()) * sigma
        }
    }
}
