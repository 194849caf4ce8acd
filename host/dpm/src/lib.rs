//! The program `dpm`: the rig controller and its tools on the command line.

pub mod calibrate;
pub mod cli;
mod dlpc900;
mod keep_parameters;
mod notify;
mod pattern_dlpc900;
mod rest_dlpc900;
mod run_dlpc900;
pub mod signals;
