//! `dpm error`: error against cost of every method, as tables and curves.

use super::rig_args::RigArgs;
use super::watch::print;
use crate::experiments::error_figure3::{self, Figure3Group, Setting};
use crate::experiments::error_plan::{groups, Group};
use crate::experiments::error_plot::{self, curves, Cost};
use crate::experiments::error_report::{csv, markdown};
use crate::experiments::error_runs::{ErrorOptions, ErrorRunError, ErrorRuns, GroupResult};
use crate::experiments::error_sheet::{stack, strip};
use crate::experiments::run_rig::open_gpu;
use crate::experiments::snapshot::paint::Canvas;
use crate::experiments::stamp::Stamp;
use crate::failure::{Failure, FailureKind};
use crate::files::write_atomically;
use crate::gpu::Gpu;
use crate::pipeline::PipelineError;
use crate::rig::Rig;
use crate::telemetry::report::to_json;
use dpm_device::planes::Raster;
use indicatif::{ProgressBar, ProgressStyle};
use serde::de::DeserializeOwned;
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
    /// Measure another experiment than methods at equal rays
    #[arg(long, value_enum, conflicts_with_all = ["ablation", "budgets"])]
    preset: Option<Preset>,
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

/// Experiments of others.
#[derive(clap::ValueEnum, Clone, Copy, Debug)]
enum Preset {
    /// Section 3 of the paper: one body in four materials, 5 to 30 samples a pixel, standing and moving
    Figure3,
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
        return merge(out, *json);
    }
    if let Some(Preset::Figure3) = args.preset {
        return figure3(args);
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
    let chosen = chosen(args, &all)?;
    let out = folder(args);
    let runs = prepare(args, &out)?;
    let results = measure(&runs, &chosen, args, &out)?;
    if args.index.is_some() && !args.json {
        print(&markdown(&results));
        return Ok(());
    }
    report(&out, &results, args.json)
}

fn folder(args: &ErrorArgs) -> PathBuf {
    let own = if args.preset.is_some() { "out/figure3" } else { "out/error" };
    args.flags.out.clone().unwrap_or_else(|| own.into())
}

/// What `--index` names, or all.
fn chosen<T: Copy>(args: &ErrorArgs, all: &[T]) -> Result<Vec<T>, Failure> {
    match args.index {
        None => Ok(all.to_vec()),
        Some(i) if i < all.len() => Ok(vec![all[i]]),
        Some(i) => {
            let told = format!("--index {i}: there are groups 0 to {}; --list names them", all.len() - 1);
            Err(Failure::new(FailureKind::BadInput, told))
        }
    }
}

fn options(args: &ErrorArgs, out: &Path) -> ErrorOptions {
    ErrorOptions {
        warm_up: if args.quick { 48 } else { 96 },
        // 250 ms at 947 fps: 33 ms for the eye at the end, flicker down to 4 Hz.
        kept: 237,
        reference_spp: args.reference_spp.unwrap_or(if args.quick { 128 } else { 1000 }),
        ablation: args.ablation,
        cache: out.join("cache"),
    }
}

/// The GPU, and the rig at the raster to measure at: small without a GPU or in a hurry.
fn stage(args: &ErrorArgs) -> Result<(Arc<Gpu>, Rig), Failure> {
    let config = args.flags.rig(args.rig.as_deref())?;
    let gpu = open_gpu(&config)?;
    let small = args.flags.raster.is_none() && (args.quick || gpu.summary().software);
    let raster = if small { Raster::new(80, 60) } else { None };
    Ok((gpu, Rig::build(&config, raster)?))
}

fn prepare(args: &ErrorArgs, out: &Path) -> Result<ErrorRuns, Failure> {
    let (gpu, rig) = stage(args)?;
    Ok(ErrorRuns::new(Arc::new(rig), gpu, options(args, out)))
}

fn progress(steps: usize) -> ProgressBar {
    let bar = ProgressBar::new(steps as u64);
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} {elapsed} (left {eta}) {msg}");
    bar.set_style(style.expect("the template is right"));
    bar
}

/// What an earlier run left in `path`, when it was made from the same.
fn known<T: DeserializeOwned>(path: &Path, fits: impl Fn(&T) -> bool) -> Option<T> {
    std::fs::read(path).ok().and_then(|b| serde_json::from_slice(&b).ok()).filter(fits)
}

fn figure3(args: &ErrorArgs) -> Result<(), Failure> {
    let all = Setting::all();
    if args.list {
        let lines: String = all.iter().enumerate().map(|(i, s)| format!("{i} {}\n", s.name())).collect();
        print(&lines);
        return Ok(());
    }
    let (out, chosen) = (folder(args), chosen(args, &all)?);
    let options = options(args, &out);
    let (gpu, rig) = stage(args)?;
    let raster = rig.camera.raster;
    let stamp = Stamp::new(&rig, gpu.summary());
    let steps = 2 * error_figure3::SPP.len() + 2;
    let bar = progress(steps * chosen.len());
    let mut groups = Vec::new();
    for (k, &setting) in chosen.iter().enumerate() {
        bar.set_position((steps * k) as u64);
        let key = error_figure3::key(&stamp, setting, &options, &error_figure3::SPP);
        let path = out.join(format!("figure3-{}-{key}.json", setting.name()));
        let group = match known(&path, |g: &Figure3Group| g.key == key) {
            Some(group) => group,
            None => {
                let rig = Rig::build(&rig.config, Some(raster))?;
                let mut each = |what: &str| {
                    bar.set_message(format!("{} {what}", setting.name()));
                    bar.inc(1);
                };
                let measured =
                    error_figure3::measure(rig, &gpu, setting, &options, &error_figure3::SPP, &mut each)
                        .map_err(failure)?;
                write(&path, &to_json(&measured))?;
                measured
            }
        };
        groups.push(group);
    }
    bar.finish_and_clear();
    if args.index.is_some() && !args.json {
        print(&error_figure3::markdown(&groups));
        return Ok(());
    }
    report_figure3(&out, &groups, args.json)
}

fn report_figure3(out: &Path, groups: &[Figure3Group], json: bool) -> Result<(), Failure> {
    let object = to_json(&serde_json::json!({ "groups": groups }));
    let table = error_figure3::markdown(groups);
    write(&out.join("figure3.json"), &object)?;
    write(&out.join("figure3.csv"), &error_figure3::csv(groups))?;
    write(&out.join("figure3.md"), &table)?;
    let svg = error_plot::figure3(groups).map_err(|e| Failure::new(FailureKind::BadInput, e))?;
    write(&out.join("figure3.svg"), &svg)?;
    print(&if json { object + "\n" } else { table });
    Ok(())
}

fn measure(
    runs: &ErrorRuns,
    chosen: &[Group],
    args: &ErrorArgs,
    out: &Path,
) -> Result<Vec<GroupResult>, Failure> {
    let per_group = if args.ablation { 8 } else { 4 } * 2;
    let bar = progress(per_group * chosen.len());
    let mut results = Vec::new();
    for (k, &group) in chosen.iter().enumerate() {
        bar.set_position((per_group * k) as u64);
        let path = out.join(format!("group-{}-{}.json", group.name(), runs.key(group)));
        let key = runs.key(group);
        let result = match known(&path, |r: &GroupResult| r.key == key) {
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

/// Joins what lies in a folder: groups of methods, settings of figure 3, or both.
fn merge(out: &Path, json: bool) -> Result<(), Failure> {
    let mut groups: Vec<GroupResult> = read_all(out, "group-")?;
    let place = |g: &GroupResult| g.rows.first().map_or((false, 0.0), |r| (r.moving, r.budget));
    groups.sort_by(|a, b| {
        let ((am, ab), (bm, bb)) = (place(a), place(b));
        am.cmp(&bm).then(ab.total_cmp(&bb))
    });
    let settings: Vec<Figure3Group> = read_all(out, "figure3-")?;
    if groups.is_empty() && settings.is_empty() {
        let out = out.display();
        let told = format!("{out}: no measured groups; run dpm error RIG.toml --index N --out {out} first");
        return Err(Failure::new(FailureKind::BadInput, told));
    }
    if !settings.is_empty() {
        report_figure3(out, &settings, json)?;
    }
    if groups.is_empty() {
        return Ok(());
    }
    report(out, &groups, json)
}

/// Every measured file of a folder whose name begins like this, by name.
fn read_all<T: DeserializeOwned>(out: &Path, prefix: &str) -> Result<Vec<T>, Failure> {
    let Ok(entries) = std::fs::read_dir(out) else { return Ok(Vec::new()) };
    let mut paths: Vec<PathBuf> = entries
        .filter_map(|e| Some(e.ok()?.path()))
        .filter(|p| {
            let name = p.file_name().unwrap_or_default().to_string_lossy();
            name.starts_with(prefix) && name.ends_with(".json")
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
        found.push(serde_json::from_slice::<T>(&bytes).map_err(|e| bad(&e))?);
    }
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
