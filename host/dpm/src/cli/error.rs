//! `dpm error`: error against cost of every method, as tables and curves.

use super::error_experiments::{run, run_folder};
use super::error_files::merge;
use super::rig_args::RigArgs;
use super::watch::print;
use dpm_common::files::check_folder;
use dpm_device::planes::Raster;
use dpm_lab::error::figure3::Figure3Group;
use dpm_lab::error::plan::{Setting, Window};
use dpm_lab::error::planes::{markdown, CardPanel, CardPattern, TestCard, MOTIONS};
use dpm_lab::error::runs::{ErrorOptions, GroupResult, SequenceExtent};
use dpm_lab::error::seen::SeenGroup;
use dpm_lab::error::table::TableGroup;
use dpm_render::gpu::Gpu;
use dpm_render::warp::FOLLOW_SHARE;
use dpm_rig::config::{BitOrder, Overrides, RigConfig};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::pipeline::PipelineError;
use dpm_rig::rig::Rig;
use dpm_rig::run_rig::open_gpu;
use dpm_rig::telemetry::report::to_json;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Flags of `dpm error`.
#[derive(clap::Args, Clone, Debug)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub(crate) struct ErrorArgs {
    #[command(subcommand)]
    command: Option<ErrorCommand>,
    /// The rig file; or a folder of rig files, each of them a group whose bodies move as it says
    #[arg(value_name = "RIG.toml", required = true)]
    pub(super) rig: Option<PathBuf>,
    #[command(flatten)]
    pub(super) flags: RigArgs,
    /// Small raster, few frames, three budgets: takes minutes on two cores without a GPU
    #[arg(long)]
    quick: bool,
    /// Also measure dpm with each of its parts off in turn
    #[arg(long)]
    ablation: bool,
    /// Ray budgets, one group each: samples per pixel of the paper's method where the eye looks, 1/64 to 4096. All
    /// methods get the same number of rays; below 1, that share of the rays of 1
    #[arg(long, value_name = "SPP,...", value_delimiter = ',', value_parser = budget)]
    budgets: Vec<f64>,
    /// Samples per pixel of the reference
    #[arg(long, value_name = "SPP", value_parser = clap::value_parser!(u32).range(2..=65536))]
    reference_spp: Option<u32>,
    /// Run another experiment than methods at equal rays
    #[arg(long, value_enum, conflicts_with_all = ["ablation", "budgets"])]
    preset: Option<Preset>,
    /// Draw only this part of the projector's raster, at its full density: left column, upper row, columns x rows
    #[arg(long, value_name = "X,Y,WxH")]
    window: Option<Window>,
    /// Runs of each method, from which the intervals of `--preset seen` come: an even number
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = seeds)]
    seeds: u32,
    /// List the groups with their numbers, and measure nothing
    #[arg(long)]
    pub(super) list: bool,
    /// Measure only this group; `dpm error merge` joins the groups
    #[arg(long, value_name = "N")]
    pub(super) index: Option<usize>,
    /// Also write what the eye saw, frame by frame, of every method and of the reference, for other metrics:
    /// OUT/sequences
    #[arg(long, conflicts_with = "preset")]
    pub(super) sequences: bool,
    /// Print one JSON object
    #[arg(long)]
    pub(super) json: bool,
}

/// Other experiments.
#[derive(clap::ValueEnum, Clone, Copy, Debug)]
enum Preset {
    /// Section 3 of the paper: one body in four materials, 5 to 30 samples per pixel, at rest and moving
    Figure3,
    /// Every method on one body in four materials, at rest and moving, with the gaze on it and past it
    Table,
    /// Every method in units of what people notice, with 95 % intervals, at rest and moving
    Seen,
}

fn seeds(text: &str) -> Result<u32, String> {
    let value = text.parse::<u32>().ok().filter(|n| (4..=1024).contains(n) && n % 2 == 0);
    value.ok_or_else(|| "write an even number from 4 to 1024".to_owned())
}

fn budget(text: &str) -> Result<f64, String> {
    let value = match text.split_once('/') {
        Some((a, b)) => a.parse::<f64>().ok().zip(b.parse::<f64>().ok()).map(|(a, b)| a / b),
        None => text.parse().ok(),
    };
    value
        .filter(|v| (1.0 / 64.0..=4096.0).contains(v))
        .ok_or_else(|| "write samples per pixel from 1/64 to 4096, for example 18 or 1/4".to_owned())
}

/// Subcommands of `dpm error`.
#[derive(clap::Subcommand, Clone, Debug)]
enum ErrorCommand {
    /// Join the measured groups in a folder into tables and curves
    Merge {
        /// The folder
        #[arg(long, value_name = "DIR", default_value = "out/error")]
        out: PathBuf,
        /// Print one JSON object: the groups of each experiment, under the name of its report
        #[arg(long)]
        json: bool,
    },
    /// What an eye sees of a moving texture, plane by plane: motion times what the planes are drawn for
    Planes {
        /// How far the planes of each bit follow, 0 to 1, like projector.plane_follow; those of split and binary24 always follow wholly
        #[arg(long, value_name = "SHARE", default_value_t = FOLLOW_SHARE, value_parser = share)]
        follow: f64,
        /// Print one JSON object
        #[arg(long)]
        json: bool,
    },
}

/// Measures what is not measured yet and writes tables and curves.
///
/// # Errors
/// Bad rig or flags, no GPU, a folder that cannot be written.
pub(super) fn execute(args: &ErrorArgs) -> Result<(), Failure> {
    match &args.command {
        Some(ErrorCommand::Merge { out, json }) => return merge(out, *json),
        Some(ErrorCommand::Planes { follow, json }) => return planes(*follow, *json),
        None => {}
    }
    args.flags.refuse("dpm error", &["--frames", "--seconds", "--no-prediction"])?;
    let rigs = args.rig.as_deref().filter(|rig| rig.is_dir());
    let budgets = match (&args.budgets[..], args.quick) {
        ([], _) if rigs.is_some() => vec![FOLDER_BUDGET],
        ([], true) => vec![2.0, 6.0, 18.0],
        ([], false) => vec![0.25, 0.5, 1.0, 2.0, 4.0, 9.0, 18.0, 36.0, 64.0],
        (given, _) => given.to_vec(),
    };
    if let Some(rigs) = rigs {
        if args.preset.is_some() || args.sequences {
            let told =
                "a folder of rigs is measured without --preset and --sequences; name one rig file for these";
            return Err(Failure::new(FailureKind::BadInput, told));
        }
        let settings: Vec<Setting> = budgets.iter().map(|&budget| Setting::plain(true, budget)).collect();
        return run_folder(args, rigs, &settings);
    }
    match args.preset {
        Some(Preset::Figure3) => run::<Figure3Group>(args, &Setting::of_figure3()),
        Some(Preset::Table) => run::<TableGroup>(args, &Setting::of_table()),
        Some(Preset::Seen) => run::<SeenGroup>(args, &Setting::at_budgets(&[SEEN_BUDGET])),
        None => run::<GroupResult>(args, &Setting::at_budgets(&budgets)),
    }
}

/// The rig files of a folder, by name.
pub(super) fn rig_files(folder: &Path) -> Result<Vec<PathBuf>, Failure> {
    let told =
        |e: &dyn std::fmt::Display| Failure::new(FailureKind::BadInput, format!("{}: {e}", folder.display()));
    let entries = std::fs::read_dir(folder).map_err(|e| told(&e))?;
    let paths =
        entries.map(|entry| entry.map(|e| e.path())).collect::<Result<Vec<_>, _>>().map_err(|e| told(&e))?;
    let mut files: Vec<PathBuf> = paths
        .into_iter()
        .filter(|path| path.extension().is_some_and(|e| e == "toml") && path.is_file())
        .collect();
    files.sort();
    if files.is_empty() {
        return Err(told(&"no rig file (.toml) lies here; rigs/groups has some"));
    }
    Ok(files)
}

/// Samples of a pixel of `paper` where the eye looks with a folder of rigs.
const FOLDER_BUDGET: f64 = 6.0;

/// Samples of a pixel of `paper` where the eye looks with `--preset seen`: about what a GPU traces at 947 frames/s.
const SEEN_BUDGET: f64 = 2.0;

/// Orders of the bits that `dpm error planes` compares with the default: that whose light is over soonest, and that with most
/// of the light amid the frame.
const OTHER_ORDERS: [[u8; 8]; 2] = [[7, 6, 5, 4, 3, 2, 1, 0], [0, 2, 4, 6, 7, 5, 3, 1]];

/// A number from 0 to 1.
fn share(text: &str) -> Result<f64, String> {
    let share: f64 = text.parse().map_err(|_| "not a number")?;
    if (0.0..=1.0).contains(&share) {
        Ok(share)
    } else {
        Err("not from 0 to 1".to_owned())
    }
}

/// Measures every motion with every order of the planes, which follow by a share of their way.
fn planes(follow: f64, json: bool) -> Result<(), Failure> {
    let config = RigConfig::demo(&Overrides::default())?;
    let failed = |e| Failure::from(PipelineError::from(e));
    let gpu = open_gpu(&config)?;
    let orders = [BitOrder::default().0].into_iter().chain(OTHER_ORDERS);
    let panels = orders.map(|order| CardPanel::of_bits(order).following(follow));
    let panels: Vec<CardPanel> = panels.chain([CardPanel::of_split(), CardPanel::of_binary24()]).collect();
    let mut rows = Vec::new();
    for pattern in [CardPattern::Noise, CardPattern::Patches] {
        let card = TestCard::new(&gpu, pattern).map_err(failed)?;
        for panel in &panels {
            let measured = MOTIONS.iter().map(|motion| card.measure(motion, panel));
            rows.extend(measured.collect::<Result<Vec<_>, _>>().map_err(failed)?);
        }
    }
    print(&if json { to_json(&serde_json::json!({ "planes": rows })) + "\n" } else { markdown(&rows) });
    Ok(())
}

/// Where groups and reports lie.
pub(super) fn folder(args: &ErrorArgs) -> PathBuf {
    let own = match args.preset {
        None if args.rig.as_deref().is_some_and(Path::is_dir) => "out/groups",
        Some(Preset::Figure3) => "out/figure3",
        Some(Preset::Table) => "out/table",
        Some(Preset::Seen) => "out/seen",
        None => "out/error",
    };
    args.flags.out.clone().unwrap_or_else(|| own.into())
}

/// The group names with their numbers. A rig file that cannot be run has no groups.
pub(super) fn list(args: &ErrorArgs, names: impl Iterator<Item = String>) -> Result<(), Failure> {
    args.flags.rig_at_rest(args.rig.as_deref())?;
    list_names(args, names)
}

/// The names with their numbers.
pub(super) fn list_names(args: &ErrorArgs, names: impl Iterator<Item = String>) -> Result<(), Failure> {
    if args.json {
        let names: Vec<String> = names.collect();
        print(&(to_json(&serde_json::json!({ "groups": names })) + "\n"));
        return Ok(());
    }
    let lines: String = names.enumerate().map(|(i, name)| format!("{i} {name}\n")).collect();
    print(&lines);
    Ok(())
}

/// The groups that `--index` selects, or all.
pub(super) fn chosen<T: Clone>(args: &ErrorArgs, all: &[T]) -> Result<Vec<T>, Failure> {
    match args.index {
        None => Ok(all.to_vec()),
        Some(i) if i < all.len() => Ok(vec![all[i].clone()]),
        Some(i) => {
            let told = format!("--index {i}: there are groups 0 to {}; --list names them", all.len() - 1);
            Err(Failure::new(FailureKind::BadInput, told))
        }
    }
}

pub(super) fn options(args: &ErrorArgs, out: &Path) -> ErrorOptions {
    ErrorOptions {
        extent: SequenceExtent {
            warm_up: if args.quick { 48 } else { 96 },
            // 250 ms at 947 fps: 33 ms for the eye at the end, and flicker down to 4 Hz.
            kept: 237,
            reference_spp: args.reference_spp.unwrap_or(if args.quick { 128 } else { 1000 }),
        },
        ablation: args.ablation,
        seeds: args.seeds,
        window: args.window,
        cache: out.join("cache"),
    }
}

/// The GPU, and the rig at the raster of the measurement, which is small without a GPU or with `--quick`.
pub(super) fn stage(args: &ErrorArgs) -> Result<(Arc<Gpu>, Rig), Failure> {
    let config = args.flags.rig_at_rest(args.rig.as_deref())?;
    // Checked before the first reference, which takes minutes.
    check_folder(&folder(args))
        .map_err(|e| Failure::new(FailureKind::BadInput, format!("{e}; choose another folder with --out")))?;
    let gpu = open_gpu(&config)?;
    let is_whole = args.flags.raster.is_none() && args.window.is_none();
    let small = is_whole && (args.quick || gpu.summary().software);
    let raster = if small { Raster::new(80, 60) } else { None };
    let rig = rig_of(args, &config, raster)?;
    Ok((gpu, rig))
}

/// The rig at a raster, or through the window that the flags name.
pub(super) fn rig_of(args: &ErrorArgs, config: &RigConfig, raster: Option<Raster>) -> Result<Rig, Failure> {
    match args.window {
        None => Ok(Rig::build(config, raster)?),
        Some(window) => {
            window.of(Rig::build(config, None)?).map_err(|e| Failure::new(FailureKind::BadInput, e))
        }
    }
}
