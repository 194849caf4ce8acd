//! `dpm bench`: what each method costs on this machine's Vulkan device.

use super::rig_args::RigArgs;
use super::watch::{check_file, check_out, print, write_json, write_out};
use dpm_lab::bench::{bench, BenchOptions, MethodCost};
use dpm_lab::bench_walk::{bench_walk, WalkReport};
use dpm_lab::gpu_model;
use dpm_lab::seed_frames::{seed_frames, SeedScene};
use dpm_render::gpu::Gpu;
use dpm_rig::config::RenderMethod;
use dpm_rig::failure::Failure;
use dpm_rig::pipeline::{renderer_settings, PipelineError};
use dpm_rig::rig::Rig;
use dpm_rig::run_rig::open_gpu;
use dpm_rig::telemetry::report::to_json;
use std::path::PathBuf;
use std::sync::Arc;

/// The rig of the experiment of \[paper\] with scans of a hare and a bust, which are not part of the program.
const BUNNY_VENUS: &str = include_str!("../../../../rigs/bunny-venus.toml");

/// What `--preset` measures.
#[derive(clap::ValueEnum, Clone, Copy, Debug)]
enum BenchPreset {
    /// The frames of the paper's headline.
    Seed,
}

/// Flags of `dpm bench`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct BenchArgs {
    /// The rig file; default: the built-in demo
    #[arg(value_name = "RIG.toml")]
    rig: Option<PathBuf>,
    #[command(flatten)]
    flags: RigArgs,
    /// Frames to measure per method; fewer if they take longer than 20 s
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(3..=100_000))]
    count: u32,
    /// Measure only this method; may be given several times
    #[arg(long, value_name = "NAME", value_parser = RenderMethod::DRAWN.map(RenderMethod::word))]
    method: Vec<String>,
    /// Also print what frames with these counts might take on GPUs that are not there, computed from published and
    /// estimated rates, term by term
    #[arg(long)]
    model: bool,
    /// Measure the two frames of the paper's headline instead: its method with 18/18/2 samples and its predecessor with 14, on the demo,
    /// which has textures, and on the bodies of rigs/bunny-venus.toml, whose file --scene names; beside them what the paper says,
    /// what was measured on other cards, and what the model computes
    #[arg(long, value_enum, conflicts_with_all = ["rig", "method", "model"])]
    preset: Option<BenchPreset>,
    /// File for all figures as one JSON object, which the owner of a GPU can send in. `dpm report` makes a page of a folder
    /// with such files bench-*.json, and sets them beside the model
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// Record the rays of a frame once and walk them by this processor's kernels and by the device's, and measure nothing else. Software Vulkan
    /// records them
    #[arg(long, conflicts_with_all = ["method", "model", "report"])]
    walk: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Rays that were proven to meet nothing cost no walk, so rates are of those that were walked.
const HEAD: &str = "          walked                walked/     proven/     samples/ samples/\n\
                    method      Mrays/s Msamples/s      frame       frame       frame lit pixel     GPU ms    wall ms    in line\n";

/// The lines of `dpm bench --walk`.
fn walk_lines(report: &WalkReport) -> String {
    let share = 100.0 * f64::from(report.proven_misses) / f64::from(report.path_rays.max(1));
    let mut text = format!(
        "{} rays of paths in the frame: {} proven to miss ({share:.1} %), {} walked; below are those of the last round\n",
        report.path_rays, report.proven_misses, report.walked
    );
    text += "kernel                   kind          rays   Mrays/s    hit %    differ\n";
    for r in &report.rates {
        let (rate, hit) = (r.rays_per_s * 1e-6, 100.0 * r.hit);
        text +=
            &format!("{:<24} {:<8} {:>9} {rate:>9.2} {hit:>8.2} {:>9}\n", r.kernel, r.kind, r.rays, r.differ);
    }
    text + "Kernels of the processor by the time of one thread, the device's by its own clock. \"differ\": rays of which the first kernel says \
            something else.\n"
}

fn measure_walk(args: &BenchArgs, rig: &Rig, gpu: &Arc<Gpu>) -> Result<(), Failure> {
    let Some(report) = bench_walk(rig, gpu).map_err(PipelineError::from)? else {
        print("The host cannot walk the rays of this scene; the warning above says why.\n");
        return Ok(());
    };
    print(&if args.json { to_json(&report) + "\n" } else { walk_lines(&report) });
    write_out(args.flags.out.as_deref(), "bench-walk.json", &report)
}

fn lines(c: &MethodCost) -> String {
    let gpu = c.gpu_ms.map_or("-".into(), |ms| format!("{ms:.3}"));
    let mut text = format!(
        "{:<9} {:>10.2} {:>10.2} {:>11.0} {:>11.0} {:>11.0} {:>8.2} {gpu:>10} {:>10.3} {:>10.3}\n",
        c.method,
        c.walked_rays_per_s * 1e-6,
        c.samples_per_s * 1e-6,
        c.walked_rays_per_frame,
        c.rays_per_frame - c.walked_rays_per_frame,
        c.samples_per_frame,
        c.samples_per_lit_pixel,
        c.wall_ms,
        c.in_line_ms
    );
    let told: Vec<String> =
        c.passes.iter().filter(|p| p.ms > 0.0).map(|p| format!("{} {:.3}", p.pass, p.ms)).collect();
    let lanes: Vec<String> = c
        .work
        .lanes
        .iter()
        .map(|l| format!("{:.0} % of {} lanes have a sample", 100.0 * l.busy, l.width))
        .collect();
    if let Some(longest) = c.work.lanes.iter().map(|l| l.longest).max() {
        text += &format!("          {}, at most {longest} samples a thread\n", lanes.join(", "));
    }
    if !told.is_empty() {
        text += &format!("          ms by pass: {}\n", told.join(", "));
    }
    text
}

fn check_files(args: &BenchArgs) -> Result<(), Failure> {
    check_out(args.flags.out.as_deref())?;
    args.report.as_ref().map_or(Ok(()), |file| check_file(file, "--report"))
}

/// The two frames of \[paper\]'s headline.
fn seed(args: &BenchArgs) -> Result<(), Failure> {
    check_files(args)?;
    let demo = RigArgs { scene: None, ..args.flags.clone() }.rig_at_rest(None)?;
    let gpu = open_gpu(&demo)?;
    let mut scenes = Vec::new();
    if args.flags.scene.is_some() {
        let config = args.flags.rig_of_text("rigs/bunny-venus.toml", BUNNY_VENUS)?;
        scenes.push(SeedScene { name: "bunny-venus", rig: Rig::build(&config, None)? });
    } else if !args.json {
        print("bunny-venus is left out: name a scene with the nodes Bunny and Venus by --scene FILE\n");
    }
    scenes.push(SeedScene { name: "demo", rig: Rig::build(&demo, None)? });
    let frames = seed_frames(scenes, &gpu, args.count, &mut |frame| {
        if !args.json {
            print(&frame.told());
        }
    })
    .map_err(PipelineError::from)?;
    if args.json {
        print(&(to_json(&frames) + "\n"));
    }
    if let Some(file) = &args.report {
        write_json(file, &frames)?;
    }
    write_out(args.flags.out.as_deref(), "seed.json", &frames)
}

/// Measures every method at the projector's raster, whatever the device is.
///
/// # Errors
/// Bad rig or flags, no GPU.
pub(super) fn execute(args: &BenchArgs) -> Result<(), Failure> {
    args.flags.refuse("dpm bench", &["--frames", "--seconds", "--no-prediction"])?;
    if let Some(BenchPreset::Seed) = args.preset {
        return seed(args);
    }
    let config = args.flags.rig_at_rest(args.rig.as_deref())?;
    check_files(args)?;
    let gpu = open_gpu(&config)?;
    let rig = Rig::build(&config, None)?;
    if args.walk {
        return measure_walk(args, &rig, &gpu);
    }
    if !args.json {
        let (device, raster) = (gpu.summary(), rig.camera.raster);
        print(&format!(
            "{} ({}), {} x {}, spp {}, depth {}, {}\n",
            device.name,
            device.driver,
            raster.width(),
            raster.height(),
            config.render.spp,
            config.render.depth,
            if renderer_settings(&rig).tracing.asks_device(device) { "ray query" } else { "own walk" }
        ));
        print(HEAD);
    }
    let modelled = args.json || args.model || args.report.is_some() || args.flags.out.is_some();
    let options = BenchOptions { frames: args.count, only: &args.method, modelled };
    let report = bench(&rig, &gpu, options, &mut |cost| {
        if !args.json {
            print(&lines(cost));
        }
    })
    .map_err(PipelineError::from)?;
    if args.json {
        print(&(to_json(&report) + "\n"));
    } else if args.model {
        print(&gpu_model::table(&report.modelled_not_measured));
    }
    if let Some(file) = &args.report {
        write_json(file, &report)?;
    }
    write_out(args.flags.out.as_deref(), "bench.json", &report)
}
