//! The program `dpm`: the rig controller and its tools on the command line.

pub mod cli;
pub mod dlpc900;
pub mod run_dlpc900;
