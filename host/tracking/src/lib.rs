//! Turns tracker samples into the pose of each body at the instant at which its light will fall.
//!
//! [`pose_filter`] judges and filters the samples of one body, [`state`] is its result as plain data and predicts,
//! [`bank`] keeps one filter per body. [`imm`], [`learner`], [`noise`] and [`recall`] (from smoothed samples) are the
//! estimators inside. The tests measure all of it against closed-form motion. No sample is used before it arrived; everything is
//! f64; time is integer nanoseconds.
//!
//! # Example: a body at 1 m/s, 3 ms after its newest sample
//!
//! ```
//! use dpm_device::pose::Pose;
//! use dpm_device::time::HostTime;
//! use dpm_device::tracker::{BodyIndex, TrackerSample};
//! use dpm_tracking::{PoseFilter, PoseFilterConfig};
//!
//! let mut filter = PoseFilter::new(PoseFilterConfig::default());
//! for i in 0..200 {
//!     let captured_at = HostTime(i * 2_000_000); // 500 Hz
//!     let x = captured_at.0 as f64 * 1e-9;
//!     filter.update(&TrackerSample {
//!         body: BodyIndex(0),
//!         pose: Pose { position_m: [x, 0.0, 0.0], ..Pose::IDENTITY },
//!         tracked: true,
//!         mean_error_m: 0.0,
//!         covariance: None,
//!         sequence: i as u32,
//!         captured_at,
//!         received_at: captured_at,
//!     });
//! }
//! let light_at = HostTime(199 * 2_000_000 + 3_000_000);
//! let predicted = filter.predict(light_at).expect("a track");
//! assert!((predicted.pose.position_m[0] - light_at.0 as f64 * 1e-9).abs() < 1e-6, "within a micrometre");
//! ```

mod bank;
mod course;
#[cfg(test)]
mod evaluation;
pub mod imm;
mod learner;
mod noise;
pub mod pose_filter;
mod recall;
mod smooth;
mod state;

pub use bank::PoseFilterBank;
pub use course::Continuation;
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
