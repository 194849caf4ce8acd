//! The threads and hand-offs of a run: tracking, plan and render, pack, link, and beside the frame path the collector
//! and the supervisor.
//!
//! ```text
//!  tracking --[latest]--> plan+render --[channel]--> pack --[channel]--> link --[notes]--> collector
//!                            ^  ^                                         |                  |  ^
//!                            |  +----------------[memory]-----------------+                  |  +--[light]-- projector
//!                            +---------------------------------[notes]-----------------------+
//! ```
//!
//! [`crate::engine`] makes the decisions, and this folder drives it. At real pace each stage has a thread
//! (`real.rs`); at virtual pace one thread moves a clock of its own (`virtual_pace.rs`).
//!
//! One frame is one [`crate::frame::job::FrameJob`]: memory and a note, boxed once and recycled. In the steady state
//! no stage allocates, locks or logs, and every wait is bounded. All hand-offs are those of `dpm_handoff`.

mod crew;
mod link;
mod outcome;
mod parts;
pub mod projector;
mod real;
mod rights;
mod run;
mod settings;
pub mod stepped;
mod supervisor;
mod threads;
mod virtual_pace;

pub use crate::engine::connect::{connect, ENDED_WITH_THE_LAST_RUN};
pub use crate::engine::error::PipelineError;
pub use crate::engine::options::{RunOptions, Stall, StallIn};
pub use outcome::RunOutcome;
pub use run::{run, run_over, run_pattern, run_prepared};
pub use settings::{output, renderer_settings};
pub use supervisor::{has_left_threads_behind, leave_behind};
pub use threads::on_frame_path;
