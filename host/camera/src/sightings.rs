//! What cameras saw, and what was expected of a body.

use crate::blobs::SpotSighting;
use crate::detect::TagSighting;
use crate::pose::{PoseFit, Velocity};
use dpm_common::so3::so3_between;
use glam::{DAffine3, DQuat};

/// What one camera saw in one picture.
#[derive(Clone, Copy, Debug)]
pub struct Sightings<'a> {
    /// Tags.
    pub tags: &'a [TagSighting],
    /// Spots.
    pub spots: &'a [SpotSighting],
    /// By how much later each row is exposed than the one above it, seconds; 0 for a global shutter.
    pub row_s: f64,
    /// The row that was exposed at the pose's instant.
    pub row: f64,
}

/// Where a body is expected to be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Expectation {
    /// From the body to the cameras' space.
    pub pose: DAffine3,
    /// Its motion, for a rolling shutter.
    pub velocity: Velocity,
    /// By how much it may have turned otherwise, rad, one standard deviation.
    pub turn: f64,
    /// By how much it may have moved otherwise, metres, one standard deviation.
    pub shift: f64,
}

impl Expectation {
    /// What speaks against a pose: half its squared distance in standard deviations.
    pub(crate) fn against(&self, fit: &PoseFit) -> f64 {
        let turn = so3_between(DQuat::from_mat3(&self.pose.matrix3), fit.rotation);
        let shift = fit.position - self.pose.translation;
        0.5 * (turn.length() / self.turn).powi(2) + 0.5 * (shift.length() / self.shift).powi(2)
    }
}
