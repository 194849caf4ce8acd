//! The filter's state as plain data: small enough for a latest-wins slot, and sufficient to predict without the filter.

use super::course::Continuation;
use super::imm::{Kinematics, Rotations, Translations};
use dpm_device::pose::Pose;
use dpm_device::time::HostTime;
use glam::{DQuat, DVec3};

/// Reliability of a predicted pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Freshness {
    /// Samples arrive regularly.
    Tracked,
    /// Samples are missing; the last motion is extrapolated.
    Predicted,
    /// Nothing recent is known: no light should fall on this body.
    Lost,
}

/// A body at the instant its light will fall.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PosePrediction {
    /// world-from-body.
    pub pose: Pose,
    /// World frame, m/s.
    pub linear_velocity_m_s: [f64; 3],
    /// World frame, rad/s.
    pub angular_velocity_rad_s: [f64; 3],
    /// From the capture of the newest accepted sample to the requested instant, before clamping; may be negative.
    pub horizon_ns: i64,
    /// Standard deviation of the position along the worst axis, according to the filter, metres.
    pub position_sigma_m: f64,
    /// Whether to show the body.
    pub freshness: Freshness,
}

/// The state of one track at the capture of its newest accepted sample. `Copy`: passed by value from the tracker's
/// thread.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackState {
    /// Capture of the newest accepted sample.
    pub captured_at: HostTime,
    /// Position, m.
    pub position: Kinematics<DVec3>,
    /// How it goes on where light lies far ahead.
    pub continuation: Continuation,
    /// Rotation, rad.
    pub rotation: Kinematics<DQuat>,
    /// Horizons up to this are normal operation.
    pub tracked_for_ns: i64,
    /// Beyond this horizon the track is lost, and motion is not extrapolated further.
    pub lost_after_ns: i64,
}

impl TrackState {
    /// The body at `at`. Assumes constant acceleration; exact for constant velocity and constant angular velocity. The
    /// horizon is clamped to plus or minus `lost_after_ns`, so that no old velocity carries a body out of the room.
    pub fn predict(&self, at: HostTime) -> PosePrediction {
        let horizon_ns = at.ns_since(self.captured_at);
        let h = horizon_ns.clamp(-self.lost_after_ns, self.lost_after_ns) as f64 * 1e-9;
        let position = self.position.mean.point_after::<Translations>(h) + self.continuation.after(h);
        let rotation = self.rotation.mean.point_after::<Rotations>(h);
        let freshness = if horizon_ns > self.lost_after_ns {
            Freshness::Lost
        } else if horizon_ns > self.tracked_for_ns {
            Freshness::Predicted
        } else {
            Freshness::Tracked
        };
        PosePrediction {
            pose: Pose { position_m: position.to_array(), rotation_xyzw: rotation.to_array() },
            linear_velocity_m_s: (self.position.mean.velocity + self.position.mean.acceleration * h)
                .to_array(),
            angular_velocity_rad_s: (self.rotation.mean.velocity + self.rotation.mean.acceleration * h)
                .to_array(),
            horizon_ns,
            position_sigma_m: self
                .position
                .covariance
                .iter()
                .map(|c| c.position_variance_at(h))
                .fold(0.0, f64::max)
                .sqrt(),
            freshness,
        }
    }
}
