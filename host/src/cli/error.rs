//! `dpm error`: error against cost of every method, as tables and curves.

use super::rig_args::RigArgs;
use super::watch::print;
use crate::experiments::error_plan::{groups, Group};
use crate::experiments::error_plot::{curves, Cost};
use crate::experiments::error_report::{csv, markdown};
use crate::experiments::error_runs::{ErrorOptions, ErrorRunError, ErrorRuns, GroupResult};
use crate::experiments::error_sheet::{stack, strip};
use crate::experiments::run_rig::open_gpu;
use crate::experiments::snapshot::paint::Canvas;
use crate::failure::{Failure, FailureKind};
use crate::files::write_atomically;
use crate::pipeline::PipelineError;
use crate::rig::Rig;
use crate::telemetry::report::to_json;
use dpm_device::planes::Raster;
use indicatif::{ProgressBar, ProgressStyle};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Flags of `dpm error`.
#[derive(clap::Args, Clone, Debug)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub struct ErrorArgs {
    #[command(subcommand)]
    merge: Option<ErrorCommand>,
    /// The rig file
    #[arg(value_name = "RIG.toml", required = true)]
    rig: Option<PathBuf>,
    #[command(flatten)]
    flags: RigArgs,
    /// A small raster, few frames, three budgets: minutes on two cores without a GPU
    #[arg(long)]
    quick: bool,
    /// Also measure dpm with each of its parts off in turn
    #[arg(long)]
    ablation: bool,
    /// Samples a pixel of the paper's method where the eye looks, 1/64 to 4096, one a group: all methods get its rays; below 1, that
    /// share of the rays of 1
    #[arg(long, value_name = "SPP,...", value_delimiter = ',', value_parser = budget)]
    budgets: Vec<f64>,
    /// Samples a pixel of the reference
    #[arg(long, value_name = "SPP", value_parser = clap::value_parser!(u32).range(2..=65536))]
    reference_spp: Option<u32>,
    /// List the groups with their numbers and measure nothing
    #[arg(long)]
    list: bool,
    /// Measure this group only; `dpm error merge` joins them
    #[arg(long, value_name = "N")]
    index: Option<usize>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

fn budget(text: &str) -> Result<f64, String> {
    let value = match text.split_once('/') {
        Some((a, b)) => a.parse::<f64>().ok().zip(b.parse::<f64>().ok()).map(|(a, b)| a / b),
        None => text.parse().ok(),
    };
    value
        .filter(|v| (1.0 / 64.0..=4096.0).contains(v))
        .ok_or_else(|| "write samples a pixel from 1/64 to 4096, for example 18 or 1/4".to_owned())
}

/// What else `dpm error` does.
#[derive(clap::Subcommand, Clone, Debug)]
enum ErrorCommand {
    /// Join the groups that are measured in a folder into its tables and curves
    Merge {
        /// The folder
        #[arg(long, value_name = "DIR", default_value = "out/error")]
        out: PathBuf,
        /// Print one JSON object
        #[arg(long)]
        json: bool,
    },
}

/// Measures what is not measured yet and writes tables and curves.
///
/// # Errors
/// Bad rig or flags, no GPU, a folder that cannot be written.
pub fn execute(args: &ErrorArgs) -> Result<(), Failure> {
    if let Some(ErrorCommand::Merge { out, json }) = &args.merge {
        let found = read_groups(out)?;
        return report(out, &found, *json);
    }
    let budgets = match (&args.budgets[..], args.quick) {
        ([], true) => vec![2.0, 6.0, 18.0],
        ([], false) => vec![0.25, 0.5, 1.0, 2.0, 4.0, 9.0, 18.0, 36.0, 64.0],
        (given, _) => given.to_vec(),
    };
    let all = groups(&budgets);
    if args.list {
        let lines: String = all.iter().enumerate().map(|(i, g)| format!("{i} {}\n", g.name())).collect();
        print(&lines);
        return Ok(());
    }
    if let Some(i) = args.index.filter(|&i| i >= all.len()) {
        let told = format!("--index {i}: there are groups 0 to {}; --list names them", all.len() - 1);
        return Err(Failure::new(FailureKind::BadInput, told));
    }
    let out = args.flags.out.clone().unwrap_or_else(|| "out/error".into());
    let runs = prepare(args, &out)?;
    let chosen: Vec<Group> = match args.index {
        Some(i) => vec![all[i]],
        None => all,
    };
    let results = measure(&runs, &chosen, args, &out)?;
    if args.index.is_some() && !args.json {
        print(&markdown(&results));
        return Ok(());
    }
    report(&out, &results, args.json)
}

fn prepare(args: &ErrorArgs, out: &Path) -> Result<ErrorRuns, Failure> {
    let config = args.flags.rig(args.rig.as_deref())?;
    let gpu = open_gpu(&config)?;
    let small = args.flags.raster.is_none() && (args.quick || gpu.summary().software);
    let raster = if small { Raster::new(80, 60) } else { None };
    let rig = Arc::new(Rig::build(&config, raster)?);
    let options = ErrorOptions {
        warm_up: if args.quick { 48 } else { 96 },
        // 250 ms at 947 fps: 33 ms for the eye at the end, flicker down to 4 Hz.
        kept: 237,
        reference_spp: args.reference_spp.unwrap_or(if args.quick { 128 } else { 1000 }),
        ablation: args.ablation,
        cache: out.join("cache"),
    };
    Ok(ErrorRuns::new(rig, gpu, options))
}

fn measure(
    runs: &ErrorRuns,
    chosen: &[Group],
    args: &ErrorArgs,
    out: &Path,
) -> Result<Vec<GroupResult>, Failure> {
    let per_group = if args.ablation { 8 } else { 4 } * 2;
    let bar = ProgressBar::new((per_group * chosen.len()) as u64);
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} {elapsed} (left {eta}) {msg}");
    bar.set_style(style.expect("the template is right"));
    let mut results = Vec::new();
    for (k, &group) in chosen.iter().enumerate() {
        bar.set_position((per_group * k) as u64);
        let path = out.join(format!("group-{}-{}.json", group.name(), runs.key(group)));
        let known = std::fs::read(&path).ok().and_then(|b| serde_json::from_slice::<GroupResult>(&b).ok());
        let result = match known.filter(|r| r.key == runs.key(group)) {
            Some(known) => known,
            None => {
                let measured = runs.measure(group, &mut |what| {
                    bar.set_message(format!("{} {what}", group.name()));
                    bar.inc(1);
                });
                let measured = measured.map_err(failure)?;
                save(&path.with_extension("png"), &strip(&measured, &group.name()))?;
                write(&path, &to_json(&measured.result))?;
                measured.result
            }
        };
        results.push(result);
    }
    bar.finish_and_clear();
    Ok(results)
}

fn failure(error: ErrorRunError) -> Failure {
    match error {
        ErrorRunError::Render(e) => PipelineError::from(e).into(),
        other => Failure::new(FailureKind::BadInput, other),
    }
}

fn read_groups(out: &Path) -> Result<Vec<GroupResult>, Failure> {
    let nothing = || {
        let told = format!(
            "{}: no measured groups; run dpm error RIG.toml --index N --out {} first",
            out.display(),
            out.display()
        );
        Failure::new(FailureKind::BadInput, told)
    };
    let mut paths: Vec<PathBuf> = std::fs::read_dir(out)
        .map_err(|_| nothing())?
        .filter_map(|e| Some(e.ok()?.path()))
        .filter(|p| {
            let name = p.file_name().unwrap_or_default().to_string_lossy();
            name.starts_with("group-") && name.ends_with(".json")
        })
        .collect();
    paths.sort();
    let mut found = Vec::new();
    for path in paths {
        let bad = |e: &dyn std::fmt::Display| {
            let told = format!("{}: {e}; delete it and measure the group again", path.display());
            Failure::new(FailureKind::BadInput, told)
        };
        let bytes = std::fs::read(&path).map_err(|e| bad(&e))?;
        found.push(serde_json::from_slice::<GroupResult>(&bytes).map_err(|e| bad(&e))?);
    }
    if found.is_empty() {
        return Err(nothing());
    }
    let place = |g: &GroupResult| g.rows.first().map_or((false, 0.0), |r| (r.moving, r.budget));
    found.sort_by(|a, b| {
        let ((am, ab), (bm, bb)) = (place(a), place(b));
        am.cmp(&bm).then(ab.total_cmp(&bb))
    });
    Ok(found)
}

fn report(out: &Path, groups: &[GroupResult], json: bool) -> Result<(), Failure> {
    let object = to_json(&serde_json::json!({ "groups": groups }));
    write(&out.join("error.json"), &object)?;
    write(&out.join("error.csv"), &csv(groups))?;
    let table = markdown(groups);
    write(&out.join("error.md"), &table)?;
    for (moving, motion) in [(false, "still"), (true, "moving")] {
        for (cost, name) in [(Cost::Rays, "rays"), (Cost::GpuMs, "ms")] {
            let svg = curves(groups, moving, cost).map_err(|e| Failure::new(FailureKind::BadInput, e))?;
            write(&out.join(format!("error-{motion}-{name}.svg")), &svg)?;
        }
    }
    let sheets: Vec<Canvas> = groups.iter().filter_map(|g| Canvas::load(&sheet_path(out, g))).collect();
    if !sheets.is_empty() {
        save(&out.join("error.png"), &stack(&sheets))?;
    }
    print(&if json { object + "\n" } else { table });
    Ok(())
}

/// Where the contact sheet of a measured group lies: beside its numbers.
fn sheet_path(out: &Path, g: &GroupResult) -> PathBuf {
    let name = g.rows.first().map_or(String::new(), |r| Group { moving: r.moving, budget: r.budget }.name());
    out.join(format!("group-{name}-{}.png", g.key))
}

fn save(path: &Path, canvas: &Canvas) -> Result<(), Failure> {
    canvas
        .save(path)
        .map_err(|e| Failure::new(FailureKind::BadInput, format!("{e}; choose another folder with --out")))
}

fn write(path: &Path, text: &str) -> Result<(), Failure> {
    write_atomically(path, |w| w.write_all(text.as_bytes()))
        .map_err(|e| Failure::new(FailureKind::BadInput, format!("{e}; choose another folder with --out")))
}
