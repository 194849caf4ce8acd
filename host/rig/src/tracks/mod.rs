//! What the tracker says, into the tracks of all bodies.

mod source;
mod stage;

pub(crate) use source::open;
pub use source::SourceError;
pub use stage::{TrackSnapshot, TrackingStage};
