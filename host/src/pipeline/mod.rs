//! The threads and their hand-offs: tracking, plan and render, pack, link, and beside the frame path the collector.
//!
//! ```text
//!  tracking --[latest]--> plan+render --[ring]--> pack --[ring]--> link --[ring]--> collector
//!                              ^                                                        |
//!                              +------------------[free ring: recycled jobs]------------+
//! ```
//!
//! One frame is one [`job::FrameJob`], boxed once and recycled. In the steady state no stage allocates, locks or logs, and every
//! wait is bounded.

mod collect;
mod connect;
pub mod handoff;
pub mod job;
pub mod light;
mod outcome;
pub mod prepared;
mod rights;
mod run;
pub mod stages;
mod threads;

pub use collect::FrameRecord;
pub use connect::ConnectError;
pub use outcome::{PipelineError, RunOptions, RunOutcome};
pub use run::{renderer_settings, run, run_prepared};
pub use threads::on_frame_path;
