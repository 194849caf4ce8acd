//! What the projector lit, compared with the plan: notes of light, where it fell, and what the report of a run says
//! about it.

pub(crate) mod collector;
mod dark_bodies;
mod eye_counts;
mod live_view;
mod measures;
pub(crate) mod notes;
mod placement;
pub mod planes;
mod record;
pub mod recorder;
pub mod registration;
pub(crate) mod status;

pub use record::FrameRecord;
