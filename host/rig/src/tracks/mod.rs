//! From the tracker's samples to the tracks of all bodies.

mod source;
mod stage;
mod tracker_frame;

pub(crate) use source::NoTracker;
pub use source::{open_for, SourceError};
pub use stage::{TrackSnapshot, TrackingStage};
