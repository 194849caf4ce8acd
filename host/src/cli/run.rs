//! `dpm run RIG.toml` and `dpm demo`: the rig from its file to light.

use super::rig_args::RigArgs;
use super::watch::run_and_report;
use crate::experiments::run_rig::run_rig;
use crate::failure::Failure;
use std::path::{Path, PathBuf};

/// Flags of `dpm run`.
#[derive(clap::Args, Clone, Debug)]
pub struct RunArgs {
    /// The rig file
    #[arg(value_name = "RIG.toml")]
    rig: PathBuf,
    #[command(flatten)]
    flags: RigArgs,
    /// Print the report as one JSON object
    #[arg(long)]
    json: bool,
}

/// Flags of `dpm demo`.
#[derive(clap::Args, Clone, Debug)]
pub struct DemoArgs {
    #[command(flatten)]
    flags: RigArgs,
    /// Print the report as one JSON object
    #[arg(long)]
    json: bool,
}

/// Runs a rig file.
///
/// # Errors
/// Bad rig file, scene or device.
pub fn execute(args: &RunArgs) -> Result<(), Failure> {
    start(Some(&args.rig), &args.flags, args.json)
}

/// Runs the built-in demo.
///
/// # Errors
/// Bad flags, scene or device.
pub fn execute_demo(args: &DemoArgs) -> Result<(), Failure> {
    start(None, &args.flags, args.json)
}

fn start(path: Option<&Path>, flags: &RigArgs, json: bool) -> Result<(), Failure> {
    run_and_report(flags.rig(path)?, json, run_rig)
}
