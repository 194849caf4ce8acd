//! Kinds of gaze: where the observer's eye looks. Each is a row of one table ([`kinds`]), as of trackers and projectors.
//! Nothing outside this folder names a kind.
//!
//! A kind that measures opens a [`GazeSource`]; a thread beside the frame path polls it ([`crate::gaze_stream`]) and
//! publishes samples by [`GazeDesk`], from which planning takes the newest.

mod desk;
mod kind;
mod plain;
#[cfg(feature = "pupil")]
mod pupil;

pub use desk::{GazeDesk, GazeReport};
pub use kind::{GazeAim, GazeConfig, GazeCounts, GazeDoubt, GazeKeys, GazeKind, GazeSample, GazeSource};

use dpm_common::keys::rows::Registry;
use std::sync::Arc;

/// One row a kind, in the order of the manual. The first is that of a rig file that names none.
static KINDS: Registry<GazeKind> = Registry::new(&[
    &plain::POINT,
    &plain::TRACKED,
    &plain::STRAIGHT,
    #[cfg(feature = "pupil")]
    &pupil::KIND,
]);

/// All kinds.
pub fn kinds() -> Vec<&'static GazeKind> {
    KINDS.all()
}

/// Gaze at a fixed point of the world, metres.
pub fn at_point(point: [f64; 3]) -> GazeConfig {
    GazeConfig::new(&plain::POINT, Arc::new(plain::GazePointConfig { point }))
}

/// Gaze along the axis of the glasses: what a measured gaze is without its device.
pub(crate) fn straight() -> GazeConfig {
    GazeConfig::plain(&plain::STRAIGHT)
}

#[cfg(test)]
mod tests;
