//! The program `dpm`: the rig controller and its tools on the command line.

pub mod calibrate;
pub mod cli;
mod dlpc900;
mod keep_parameters;
mod notify;
mod own_run;
pub mod signals;
