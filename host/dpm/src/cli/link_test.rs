//! `dpm link-test RIG.toml`: measures the throughput of the link to the projector.

use super::rig_args::RigArgs;
use super::watch::{print, take_locks};
use dpm_common::signals;
use dpm_common::stopping;
use dpm_lab::conformance::{rules, Extent, Rule};
use dpm_lab::link_test::{judge_projector, link_test, TestFrames};
use dpm_rig::calibration_steps::is_simulated;
use dpm_rig::config::{PlaneWeights, RigConfig};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::interlock::Interlock;
use dpm_rig::presence;
use dpm_rig::rig::Rig;
use dpm_rig::run_rig::open_gpu;
use dpm_rig::standing::{refuse_where_dark_stands, Identity};
use dpm_rig::telemetry::report::to_json;
use std::path::PathBuf;

/// Flags of `dpm link-test`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct LinkTestArgs {
    /// The rig file
    #[arg(value_name = "RIG.toml", required_unless_present = "list_rules")]
    rig: Option<PathBuf>,
    #[command(flatten)]
    flags: RigArgs,
    /// Send a moving pattern instead of pictures of the rig's scene; needs no GPU
    #[arg(long)]
    prepared: bool,
    /// Number of different frames to send
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=64))]
    count: u32,
    /// Seconds per way of sending
    #[arg(long = "for", value_name = "S", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=600))]
    way_seconds: u32,
    /// Instead, check the projector against every rule of docs/PROTOCOL.md: one line per rule, exit code 1 if one is
    /// broken. This shows almost no light, except for up to half a second in the rules on limits
    #[arg(long, conflicts_with_all = ["prepared", "count", "way_seconds"])]
    conformance: bool,
    /// Print the rules that --conformance checks, with the section of docs/PROTOCOL.md and what each demands
    #[arg(long, exclusive = true)]
    list_rules: bool,
    /// Check only this rule; may be given several times
    #[arg(long = "rule", value_name = "RULE", requires = "conformance")]
    rules: Vec<String>,
    /// For the rule on flashes, let the projector's whole field flash for a second. Nobody who is sensitive to
    /// flashes may watch
    #[arg(long, requires = "conformance")]
    flashes: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Measures and prints. The projector shows the frames meanwhile. A signal ends the measurement in an orderly way:
/// dark, and with a report of the results so far.
///
/// # Errors
/// Bad rig or flags, no GPU, no projector.
pub(super) fn execute(args: &LinkTestArgs) -> Result<(), Failure> {
    args.flags.refuse("dpm link-test", &["--frames", "--seconds", "--no-prediction", "--out"])?;
    if args.list_rules {
        let line = |r: &Rule| format!("{:<22} {:<4} {}\n", r.id, r.section, r.statement);
        print(&rules().map(line).collect::<String>());
        return Ok(());
    }
    let mut config = args.flags.rig_at_rest(args.rig.as_deref())?;
    // Throughput is measured whatever the projector offers, and both kinds of planes are as long.
    if config.projector.weights == PlaneWeights::Auto {
        config.projector.weights = PlaneWeights::Binary;
    }
    if let (Some(head), false) = (config.heads().first(), is_simulated(&config)) {
        return Err(Failure::new(
            FailureKind::BadInput,
            format!(
                "dpm link-test follows no head, and this rig spares that of {head:?}: see that nobody is in the beam, and add \
                 --set safety.eyes.guard=false"
            ),
        ));
    }
    let _locks = take_locks(&config)?;
    refuse_where_dark_stands(&Identity::of(&config.projector.backend))?;
    signals::install()
        .map_err(|e| Failure::new(FailureKind::Device, format!("cannot handle signals: {e}")))?;
    let interlock = Interlock::of_config(&config.safety.interlock, false)?;
    let is_open = || interlock.as_ref().is_some_and(|i| !i.is_closed());
    if let Some(interlock) = interlock.as_ref().filter(|i| !i.is_closed()) {
        let told = format!("safety.interlock is open: this test makes light only while {}", interlock.what());
        return Err(Failure::new(FailureKind::Device, told));
    }
    let stop = || stopping::is_stopping() || is_open();
    if args.conformance {
        return judge(args, &config, &stop);
    }
    presence::PROJECTOR.look(&config)?;
    let rig = Rig::build(&config, None)?;
    let content = if args.prepared {
        TestFrames::prepared(&rig, args.count)
    } else {
        TestFrames::rendered(&rig, &open_gpu(&config)?, args.count, &stop)?
    };
    let report = link_test(&rig, &content, f64::from(args.way_seconds), &stop)?;
    print(&if args.json { to_json(&report) + "\n" } else { report.to_table() });
    Ok(())
}

fn judge(args: &LinkTestArgs, config: &RigConfig, stop: &dyn Fn() -> bool) -> Result<(), Failure> {
    if let Some(unknown) = args.rules.iter().find(|id| !rules().any(|rule| rule.id == **id)) {
        let known: Vec<&str> = rules().map(|rule| rule.id).collect();
        let told = format!("--rule {unknown}: there is no such rule; known: {}", known.join(", "));
        return Err(Failure::new(FailureKind::BadInput, told));
    }
    let extent = Extent { only: &args.rules, flashes: args.flashes };
    let judgement = judge_projector(config, extent, stop)?;
    print(&if args.json { to_json(&judgement) + "\n" } else { judgement.to_table() });
    let [_, failed, _] = judgement.counts;
    match (&judgement.ended, failed) {
        (None, 0) => Ok(()),
        (Some(why), 0) => Err(Failure::new(FailureKind::Device, format!("not judged to the end: {why}"))),
        (_, failed) => {
            Err(Failure::new(FailureKind::CheckFailed, format!("the projector breaks {failed} rules")))
        }
    }
}
