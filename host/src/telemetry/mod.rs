//! What a run tells about itself, read by threads that are not on the frame path.

pub mod monitor;
pub mod report;
