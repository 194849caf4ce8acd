//! The threads and their hand-offs: tracking, plan and render, pack, link, and beside the frame path the collector.
//!
//! ```text
//!  tracking --[latest]--> plan+render --[channel]--> pack --[channel]--> link --[notes]--> collector
//!                            ^  ^                                         |                  |  ^
//!                            |  +----------------[memory]-----------------+                  |  +--[light]-- projector
//!                            +---------------------------------[notes]-----------------------+
//! ```
//!
//! One frame is one [`crate::frame::job::FrameJob`]: memory and a note, boxed once and recycled. In the steady state no stage allocates, locks or
//! logs, and every wait is bounded. All hand-offs are those of `dpm_handoff`.

mod connect;
mod crew;
mod keeper;
mod link;
mod outcome;
mod planning;
pub mod projector;
mod pulse;
mod rights;
mod run;
mod supervisor;
mod threads;

pub use connect::{connect, ENDED_WITH_THE_LAST_RUN};
pub use outcome::{PipelineError, RunOptions, RunOutcome, Stall, StallIn};
pub use run::{output, renderer_settings, run, run_prepared};
pub use supervisor::has_left_threads_behind;
pub use threads::on_frame_path;
