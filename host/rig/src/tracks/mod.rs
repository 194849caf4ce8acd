//! From the tracker's samples to the tracks of all bodies.

pub mod gauges;
pub(crate) mod keys;
mod phase;
mod seen;
mod source;
mod stage;
mod tracker_frame;

pub(crate) use phase::SampleRhythm;
pub use seen::{BlindBodies, SeenBodies};
pub(crate) use source::NoTracker;
pub use source::{open_for, open_for_names, open_in_world};
pub use stage::{TrackSnapshot, TrackingStage};
