//! The integration tests of this crate, in one program: one link, one row of costs.

mod alp;
mod browser;
mod calibrate_browser;
mod cli;
mod cli_common;
mod cli_profile;
mod cli_run;
mod conformance;
mod dlpc900;
mod gpu_faults;
mod hangs;
mod link_common;
mod manual;
mod opencv_light;
mod page_browser;
mod pattern;
mod peer;
mod record;
mod report;
mod rig_file;
mod rigs_browser;
mod run_limits;
mod run_orders;
mod run_serial;
mod run_usb;
mod set;
mod snapshot;
mod standing;
mod stop;
#[path = "cli_common/trace_check.rs"]
mod trace_check;
