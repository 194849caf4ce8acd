//! Converts `[prediction]` of the rig file to the settings of the pose filter.

use super::PredictionConfig;
use dpm_tracking::{PoseFilterConfig, Prediction};

impl PredictionConfig {
    /// The filter of every body. A body is lost when no sample has arrived for `lost_after_ms`.
    pub(crate) fn to_filter(&self, lost_after_ms: u32) -> PoseFilterConfig {
        PoseFilterConfig {
            prediction: if self.on { Prediction::On } else { Prediction::Off },
            position_noise_m: self.noise_m,
            rotation_noise_rad: self.noise_rad,
            gate_sigmas: self.gate_sigma,
            ..PoseFilterConfig::for_bodies(self.acceleration, self.angular_acceleration, lost_after_ms)
        }
    }
}
