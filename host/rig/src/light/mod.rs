//! What the projector lit, beside what was planned: notes of light, where it fell, and what a run's report says of it.

pub(crate) mod collector;
mod dark_bodies;
mod placement;
pub mod recorder;
pub mod registration;
pub(crate) mod status;

pub use collector::FrameRecord;
