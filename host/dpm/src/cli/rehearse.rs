//! `dpm rehearse RIG.toml`: what to expect of a rig, before its parts are there.

use super::rig_args::RigArgs;
use super::watch::print;
use dpm_rehearsal::{rehearse, RehearsalExtent, SECONDS, SEEDS};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::telemetry::report::to_json;
use std::io::{IsTerminal, Write};
use std::path::PathBuf;

/// Flags of `dpm rehearse`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct RehearseArgs {
    /// The rig file; default: the built-in demo
    #[arg(value_name = "RIG.toml")]
    rig: Option<PathBuf>,
    #[command(flatten)]
    flags: RigArgs,
    /// How bodies move: swing, hand or turns (rehearsal.motion)
    #[arg(long, value_name = "MOTION", value_parser = ["swing", "hand", "turns"])]
    motion: Option<String>,
    /// Speed of bodies, m/s (rehearsal.speed_m_s)
    #[arg(long, value_name = "M/S")]
    speed: Option<f64>,
    /// Acceleration of bodies, m/s2 (rehearsal.acceleration_m_s2)
    #[arg(long, value_name = "M/S2")]
    acceleration: Option<f64>,
    /// Drawn truths of each row
    #[arg(long, value_name = "N", default_value_t = SEEDS, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    /// The rig alone, without rows of suspects and better parts
    #[arg(long)]
    only_rig: bool,
    /// Leave out the run in painted pictures
    #[arg(long)]
    no_pictures: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Rehearses and prints.
///
/// # Errors
/// A bad rig file, or one of which nothing can be rehearsed.
pub(super) fn execute(args: &RehearseArgs) -> Result<(), Failure> {
    args.flags.refuse("dpm rehearse", &["--frames", "--pace", "--out"])?;
    let seconds = args.flags.seconds.unwrap_or(SECONDS);
    if !(0.5..=3600.0).contains(&seconds) {
        let told = format!("--seconds {seconds:?}: must be from 0.5 to 3600");
        return Err(Failure::new(FailureKind::BadInput, told));
    }
    let mut flags = RigArgs { seconds: None, ..args.flags.clone() };
    let given = [("speed_m_s", args.speed), ("acceleration_m_s2", args.acceleration)];
    let given = given.iter().filter_map(|(key, value)| Some(format!("rehearsal.{key}={:?}", (*value)?)));
    let motion = args.motion.iter().map(|motion| format!("rehearsal.motion={motion}"));
    flags.set.splice(0..0, given.chain(motion).collect::<Vec<_>>());
    let config = flags.rig_at_rest(args.rig.as_deref())?;
    let extent =
        RehearsalExtent { seeds: args.seeds, seconds, only_rig: args.only_rig, pictures: !args.no_pictures };
    let watches = std::io::stderr().is_terminal();
    let report = rehearse(&config, extent, &mut |what| {
        if watches {
            // Progress that cannot be shown is no failure.
            let _ = writeln!(std::io::stderr(), "rehearsing: {what}");
        }
    })?;
    print(&if args.json { to_json(&report) + "\n" } else { report.to_table() });
    Ok(())
}
