//! `dpm plan RIG.toml`: what a rig needs, what is left out, why and how, and what that saves.

use super::rig_args::RigArgs;
use super::watch::{check_out, print, write_out};
use dpm_lab::plan_savings::Saving;
use dpm_lab::scene_plan::scene_plan;
use dpm_lab::temporal_light::{mend, TemporalLight, NO_MEND};
use dpm_render::Traffic;
use dpm_rig::failure::Failure;
use dpm_rig::telemetry::report::to_json;
use std::path::PathBuf;

/// Flags of `dpm plan`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct PlanArgs {
    /// The rig file; default: the built-in demo
    #[arg(value_name = "RIG.toml")]
    rig: Option<PathBuf>,
    #[command(flatten)]
    flags: RigArgs,
    /// Time frames with and without each part that can be added or removed, and compare their pixels
    #[arg(long)]
    measure: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

fn saved(s: &Saving) -> String {
    let [low, high] = s.saved_middle_half_ms;
    let told = if s.stands_out() { "" } else { ", may be chance" };
    let cost = format!(
        "the part takes {:+.2} ms (middle half of the frames {low:+.2} to {high:+.2}{told})",
        s.saved_ms
    );
    if s.changes_pictures {
        return format!(
            "{:.2} ms and {:.0} rays ({:.0} walked) without, {:.2} ms and {:.0} rays ({:.0} walked) with: {cost}; pixels differ by {:.1} % RMS",
            s.without_ms,
            s.without_rays,
            s.without_walked_rays,
            s.with_ms,
            s.with_rays,
            s.with_walked_rays,
            100.0 * s.difference
        );
    }
    let (r, moved) = (&s.rounding, 100.0 * s.rounding.moved_share());
    let by = format!("{} of {} lit pixels, {moved:.2} % show other samples", r.differing, r.lit);
    let by = format!("{by}, the mean is {:+.1e} of itself off", r.mean_difference());
    let same = match (s.pixels_identical, r.is_rounding()) {
        (true, _) => "same pixels".to_owned(),
        (false, true) => format!("same up to rounding ({by})"),
        (false, false) => format!("PIXELS DIFFER ({by})"),
    };
    format!("{:.2} ms instead of {:.2} ms: {cost}; {same}", s.without_ms, s.with_ms)
}

/// One line about the bandwidth that a frame takes on a GPU.
fn moved(traffic: &[Traffic]) -> String {
    let bytes = |t: &Traffic| t.read + t.written;
    let each: Vec<_> = traffic.iter().map(|t| format!("{} {}", t.pass, bytes(t))).collect();
    let sum: f64 = traffic.iter().map(bytes).sum();
    format!("bytes a listed pixel moves on a GPU: {} in all ({})\n", sum, each.join(", "))
}

/// What a person notices of the course of the light, and what to do about it.
fn seen(light: &TemporalLight, args: &PlanArgs) -> String {
    let mut text = format!("light for eyes: {}\n", light.told());
    if !light.noticed().is_empty() {
        let remedy = mend(light, |keys| args.flags.with_keys(args.rig.as_deref(), keys));
        text += &format!("{:15} {}\n", "", remedy.map_or(NO_MEND.to_owned(), |mend| mend.told()));
    }
    text
}

/// Prints the plan.
///
/// # Errors
/// Bad rig file or scene; with `--measure` no GPU, or pixels that differ.
pub(super) fn execute(args: &PlanArgs) -> Result<(), Failure> {
    args.flags.refuse("dpm plan", &["--frames", "--seconds", "--no-prediction"])?;
    let rig = args.flags.rig_at_rest(args.rig.as_deref())?;
    check_out(args.flags.out.as_deref())?;
    let report = scene_plan(&rig, args.measure)?;
    if args.json {
        print(&(to_json(&report) + "\n"));
        return write_out(args.flags.out.as_deref(), "plan.json", &report);
    }
    let mut text = String::new();
    report.warnings.iter().for_each(|w| text += &format!("note: {w}\n"));
    for e in &report.entries {
        let state = match (e.needed, e.left_out) {
            (true, _) => "needed",
            (false, true) if e.switched_off => "off",
            (false, true) => "left out",
            (false, false) => "kept",
        };
        text += &format!("{state:<9} {:<25} {} [{}]\n", e.feature, e.why, e.how);
        if let Some(s) = &e.saving {
            text += &format!("{:35} {}\n", "", saved(s));
        }
    }
    if let Some(s) = &report.together {
        text += &format!("all that is left out and can be put back, together: {}\n", saved(s));
    }
    text += &report.method_choice.as_ref().map_or(String::new(), |c| format!("method auto: {}\n", c.told()));
    text += &report.ray_walk.map_or(String::new(), |walk| format!("rays: {}\n", walk.told()));
    text += &moved(&report.traffic);
    text += &report.temporal_light.as_ref().map_or(String::new(), |light| seen(light, args));
    print(&text);
    write_out(args.flags.out.as_deref(), "plan.json", &report)
}
