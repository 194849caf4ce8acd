//! `dpm calibrate check` and `dpm calibrate nudge`: light on a body, measured and moved.

use super::projector::while_showing;
use super::{tip_of, Common};
use crate::cli::watch::{print, watch_quietly};
use dpm_calibrate::aim::Aim;
use dpm_calibrate::check::{self, judge, measure, RealBench, Target};
use dpm_calibrate::nudge::{self, help, OutlineStage};
use dpm_calibrate::outline::Outlines;
use dpm_calibrate::poses::Poses;
use dpm_common::clock::MonotonicClock;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::results::{check_known, keep, NudgeTarget};
use std::sync::Arc;

/// Pixels across the dot: an eye finds its middle to half a pixel.
const DOT_PX: u32 = 9;

#[derive(clap::Args, Clone, Debug)]
pub(super) struct CheckArgs {
    #[command(flatten)]
    common: Common,
    /// The body, by its name in the rig file; may be left out if there is only one
    #[arg(long, value_name = "NAME")]
    body: Option<String>,
    /// Points of its surface
    #[arg(long, value_name = "N", default_value_t = 6, value_parser = clap::value_parser!(u32).range(1..=100))]
    points: u32,
    /// Largest error that is accepted, pixels; exit code 1 if one is larger
    #[arg(long, value_name = "PX", default_value_t = 2.0, value_parser = above_0_to_1000)]
    limit: f64,
}

#[derive(clap::Args, Clone, Debug)]
pub(super) struct NudgeArgs {
    #[command(flatten)]
    common: Common,
    /// The body whose mesh is moved; with --projector, the only one whose outline is shown
    #[arg(long, value_name = "NAME", required_unless_present = "projector")]
    body: Option<String>,
    /// Move the projector and show the outlines of all bodies
    #[arg(long)]
    projector: bool,
    /// Millimetres of one step
    #[arg(long, value_name = "MM", default_value_t = 1.0, value_parser = above_0_to_1000)]
    step: f64,
}

fn above_0_to_1000(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|v: &f64| *v > 0.0 && *v <= 1000.0);
    value.ok_or_else(|| "write a number above 0 and at most 1000".into())
}

/// Measures the light.
///
/// # Errors
/// An error of the light is larger than the limit (exit code 1); nothing could be measured (2); a device failed (3).
pub(super) fn check(args: &CheckArgs) -> Result<(), Failure> {
    let (config, mut results) = args.common.open()?;
    let tip = tip_of(&results)?;
    let target = Target::of(&results.rig(&config)?, args.body.as_deref())?;
    let names = [args.common.wand.clone(), target.name.clone()];
    let (count, limit) = (args.points as usize, args.limit);
    let poses = Poses::start(&config, &names, MonotonicClock::new(0))?;
    poses.wait_until_seen()?;
    let (told, is_within) = watch_quietly(config, move |config, monitor| {
        while_showing(config, monitor, Arc::new(Aim::dot(DOT_PX)), |aim, dialogue| {
            let bench = RealBench { poses: &poses, aim, dialogue };
            let offsets = measure(&bench, &target, tip, count)?;
            aim.hide();
            let (told, is_within) = judge(&offsets, &results.file, &target.name, limit)?;
            check::keep(&mut results, config, &target.name, &offsets, limit);
            Ok((format!("{told}\n{}", results.save(config)?), is_within))
        })
    })?;
    print(&format!("{told}\n"));
    if is_within {
        return Ok(());
    }
    Err(Failure::new(FailureKind::CheckFailed, format!("an error of the light is larger than {limit} px")))
}

/// Moves things by hand.
///
/// # Errors
/// The rig has no such body, or the projector was not calibrated (exit code 2); a device failed (3).
pub(super) fn nudge(args: &NudgeArgs) -> Result<(), Failure> {
    let (config, mut results) = args.common.open()?;
    let moved = match (&args.body, args.projector) {
        (Some(name), false) => NudgeTarget::Body(name.clone()),
        _ => NudgeTarget::Projector,
    };
    check_known(&results, &moved)?;
    let names: Vec<String> = args.body.iter().cloned().collect();
    let stage = OutlineStage::of(&results.rig(&config)?, moved.clone(), &names)?;
    let step_m = 1e-3 * args.step;
    let poses = Poses::start(&config, &stage.names(), MonotonicClock::new(0))?;
    poses.wait_until_seen()?;
    let told = watch_quietly(config, move |config, monitor| {
        while_showing(config, monitor, Arc::new(Outlines::default()), |outlines, dialogue| {
            dialogue.tell(&help(&moved, step_m));
            let ask = |text: &str| dialogue.ask(text);
            let save = |motion: &_| {
                keep(&mut results, config, &moved, motion);
                results.save(config)
            };
            nudge::nudge(&stage, (&poses, outlines), &mut stage.nudges(step_m), ask, save)
        })
    })?;
    print(&format!("{told}\n"));
    Ok(())
}
