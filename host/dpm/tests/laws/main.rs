//! The integration tests of this crate, in one program: one link, one row of costs.

mod browser;
mod cli;
mod cli_common;
mod cli_run;
mod link_common;
mod manual;
mod opencv_light;
mod pattern;
mod peer;
mod presence;
mod real_pace;
mod report;
mod rig_file;
mod snapshot;
#[path = "cli_common/trace_check.rs"]
mod trace_check;
