//! `dpm calibrate ...`: measures what a rig needs to know, and writes it into the calibration file.

use super::calibrate_check::{check, nudge, CheckArgs, NudgeArgs};
use super::calibrate_light::{LatencyArgs, LightArgs};
use super::rig_args::RigArgs;
use super::watch::{print, watch_quietly};
use crate::calibrate::aim::Aim;
use crate::calibrate::dialogue::Dialogue;
use crate::calibrate::poses::Poses;
use crate::calibrate::projector::{aim_by_hand, keep, solve_file, told_of, Points};
use crate::calibrate::recorder::Port;
use crate::calibrate::results::Results;
use crate::calibrate::{body, light, sensor, wand};
use dpm_calibration::projector::{Known, Options};
use dpm_calibration::rehearsal::{rehearse_with, Bias};
use dpm_common::clock::MonotonicClock;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::pack::source::PatternSource;
use dpm_rig::pattern::run_pattern;
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_rig::telemetry::report::to_json;
use dpm_scene::camera_files::{export, Form};
use glam::DVec3;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Flags of `dpm calibrate`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct CalibrateArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand, Clone, Debug)]
enum What {
    /// Find the tip of a wand by turning it about a fixed point
    Wand(WandArgs),
    /// Find lens and pose of the projector: hold the tip of the wand into one cross after another
    Projector(ProjectorArgs),
    /// Find where a mesh is in its tracked body: touch known points of it, then wander over its surface
    Body(BodyArgs),
    /// Measure how far light is from where it belongs on a tracked body, and say what to measure again
    Check(CheckArgs),
    /// Move a body's mesh or the projector by hand while outlines are shown
    Nudge(NudgeArgs),
    /// Find how bright code values are, by the light sensor at rest in the beam, and the flat field from a sweep of it
    Light(LightArgs),
    /// Find the latency alone, with a light sensor and the projector of the calibration file
    Latency(LatencyArgs),
    /// Write lens and pose of the rig's projector as a file of OpenCV (.xml, .yml or .json)
    Export(ExportArgs),
    /// Run the whole calibration in simulation, against truths that it does not know, and print its errors
    Rehearse(RehearseArgs),
}

/// What every measurement needs.
#[derive(clap::Args, Clone, Debug)]
pub(super) struct Common {
    /// The rig file with tracker and projector
    #[arg(value_name = "RIG.toml")]
    rig: PathBuf,
    /// The calibration file; default: the one that the rig file names, or calibration.toml beside it
    #[arg(long, value_name = "FILE")]
    file: Option<PathBuf>,
    /// Name of the wand in the tracking software
    #[arg(long, value_name = "NAME", default_value = "wand")]
    pub(super) wand: String,
    /// Set a key of the rig file, for example tracker.server=192.168.1.10; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
}

#[derive(clap::Args, Clone, Debug)]
struct WandArgs {
    #[command(flatten)]
    common: Common,
    /// The tip measured with a ruler, millimetres in the wand's body, instead of turning; the light sensor refines it
    #[arg(long, value_name = "X,Y,Z", value_parser = three, allow_hyphen_values = true)]
    tip: Option<DVec3>,
    /// Seconds of turning
    #[arg(long, value_name = "S", default_value_t = 15.0, value_parser = seconds)]
    seconds: f64,
}

#[derive(clap::Args, Clone, Debug)]
struct ProjectorArgs {
    #[command(flatten)]
    common: Common,
    /// Distance from the lens to the middle of the points by a tape measure, metres; catches wrong units
    #[arg(long, value_name = "M", value_parser = metres)]
    distance: Option<f64>,
    /// Direction of the world that points up (x, y or z); catches exchanged axes of a projector that stands upright
    #[arg(long, value_name = "AXIS", value_parser = axis)]
    up: Option<DVec3>,
    /// Serial port of the wand's light sensor: move the wand through coded light in place of aiming by hand
    #[arg(long, value_name = "PORT", conflicts_with = "points")]
    sensor: Option<String>,
    /// Bits per second of the sensor's port
    #[arg(long, value_name = "BAUD", default_value_t = 3_000_000, requires = "sensor")]
    sensor_baud: u32,
    /// Gain setting of the sensor
    #[arg(long, value_name = "N", default_value_t = 0, requires = "sensor")]
    gain: u8,
    /// Seconds of motion with the sensor
    #[arg(long, value_name = "S", default_value_t = 30.0, value_parser = seconds, requires = "sensor")]
    seconds: f64,
    /// Diameter of the sensor's aperture, millimetres
    #[arg(long, value_name = "MM", default_value_t = 3.0, value_parser = seconds, requires = "sensor")]
    aperture: f64,
    /// Show nothing and ask for nothing: solve the points of a file, "x y z column row" a line, metres and pixels
    #[arg(long, value_name = "FILE")]
    points: Option<PathBuf>,
}

#[derive(clap::Args, Clone, Debug)]
struct BodyArgs {
    #[command(flatten)]
    common: Common,
    /// The body, by its name in the rig file
    #[arg(long, value_name = "NAME")]
    body: String,
    /// Seconds for which the tip wanders over the surface; 0: touched points only
    #[arg(long, value_name = "S", default_value_t = 20.0, value_parser = zero_or_seconds)]
    wander: f64,
    /// Radius of the wand's round tip, millimetres
    #[arg(long, value_name = "MM", default_value_t = 0.0, value_parser = zero_or_seconds)]
    tip_radius: f64,
}

#[derive(clap::Args, Clone, Debug)]
struct ExportArgs {
    /// The rig file
    #[arg(value_name = "RIG.toml")]
    rig: PathBuf,
    /// The new file; its ending says its form
    #[arg(value_name = "OUT")]
    out: PathBuf,
    /// Set a key of the rig file; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
}

#[derive(clap::Args, Clone, Debug)]
struct RehearseArgs {
    /// Truths to draw
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    draws: u32,
    /// Seed of the draws
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Bias of the tracker: none, one of 0.05 mm that wanders in time, or one that stands in space
    #[arg(long, value_enum, default_value = "none")]
    bias: BiasWord,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum BiasWord {
    /// White noise only
    None,
    /// Wanders in time
    Wandering,
    /// Stands in space
    Standing,
}

/// Bias of the tracker in rehearsals that have one, metres along an axis.
const BIAS_M: f64 = 5e-5;

fn three(text: &str) -> Result<DVec3, String> {
    let parts: Result<Vec<f64>, _> = text.split(',').map(|n| n.trim().parse()).collect();
    let numbers = parts.ok().and_then(|n| <[f64; 3]>::try_from(n).ok());
    let within = numbers.filter(|n| n.iter().all(|v| v.abs() <= 1e4));
    within
        .map(DVec3::from_array)
        .ok_or_else(|| "write three numbers of millimetres, such as 10,-5,120".into())
}

pub(super) fn seconds(text: &str) -> Result<f64, String> {
    let s = text.parse().ok().filter(|s: &f64| *s > 0.0 && *s <= 3600.0);
    s.ok_or_else(|| "write seconds, above 0 and at most 3600".into())
}

fn zero_or_seconds(text: &str) -> Result<f64, String> {
    let s = text.parse().ok().filter(|s: &f64| (0.0..=3600.0).contains(s));
    s.ok_or_else(|| "write a number from 0 to 3600".into())
}

fn metres(text: &str) -> Result<f64, String> {
    let m = text.parse().ok().filter(|m: &f64| (0.01..=1000.0).contains(m));
    m.ok_or_else(|| "write metres, 0.01 to 1000".into())
}

fn axis(text: &str) -> Result<DVec3, String> {
    match text {
        "x" => Ok(DVec3::X),
        "y" => Ok(DVec3::Y),
        "z" => Ok(DVec3::Z),
        _ => Err("write x, y or z".into()),
    }
}

impl Common {
    /// The rig file, of which tracker and projector are used, and its calibration file.
    pub(super) fn open(&self) -> Result<(RigConfig, Results), Failure> {
        let args = RigArgs { set: self.set.clone(), ..RigArgs::default() };
        let mut config = args.rig_at_rest(Some(&self.rig))?;
        // A pattern runs until it is stopped.
        (config.run.frames, config.run.seconds) = (0, 0.0);
        let results = Results::open(self.file.as_deref(), &self.rig, &config)?;
        Ok((config, results))
    }
}

/// The tip of the wand by a former `dpm calibrate wand`.
pub(super) fn tip_of(results: &Results) -> Result<DVec3, Failure> {
    let told = "the tip of the wand is not known yet: run `dpm calibrate wand` first";
    let wand = results.file.wand.as_ref().ok_or_else(|| Failure::new(FailureKind::BadInput, told))?;
    Ok(DVec3::from_array(wand.tip))
}

/// Measures.
///
/// # Errors
/// A bad rig file, data that do not determine what was asked for (exit code 2, with what to do), or a device that fails
/// (3).
pub(super) fn execute(args: &CalibrateArgs) -> Result<(), Failure> {
    match &args.what {
        What::Wand(args) => {
            let (config, mut results) = args.common.open()?;
            let name = &args.common.wand;
            let told = match args.tip {
                Some(tip) => wand::by_ruler(&config, name, 1e-3 * tip, &mut results),
                None => {
                    let dialogue = Dialogue::start(|| false)?;
                    wand::calibrate(&config, name, args.seconds, &mut results, &dialogue)?
                }
            };
            print(&format!("{told}\n{}\n", results.save(&config)?));
            Ok(())
        }
        What::Projector(args) => projector(args),
        What::Body(args) => {
            let (config, mut results) = args.common.open()?;
            let scene = Rig::build(&config, None)?.scene;
            let wand = (args.common.wand.as_str(), tip_of(&results)?);
            let ways = body::Ways { wander_s: args.wander, tip_radius_m: 1e-3 * args.tip_radius };
            let dialogue = Dialogue::start(|| false)?;
            let told = body::calibrate(&config, &scene, wand, &args.body, ways, &mut results, &dialogue)?;
            print(&format!("{told}\n{}\n", results.save(&config)?));
            Ok(())
        }
        What::Check(args) => check(args),
        What::Nudge(args) => nudge(args),
        What::Light(args) => args.execute(),
        What::Latency(args) => args.execute(),
        What::Export(args) => write_opencv(args),
        What::Rehearse(args) => rehearse(args),
    }
}

fn projector(args: &ProjectorArgs) -> Result<(), Failure> {
    let (config, mut results) = args.common.open()?;
    let raster = config.projector.raster();
    let known = Known { distance_m: args.distance, up: args.up };
    if let Some(port) = &args.sensor {
        return projector_by_sensor(args, port, known, &config, results);
    }
    let options = Options { known, ..Options::by_hand(raster) };
    let solved = match &args.points {
        Some(path) => solve_file(path, raster, options)?,
        None => {
            let tip = tip_of(&results)?;
            let mut points = Points::resume(results.progress("projector"))?;
            let poses =
                Poses::start(&config, std::slice::from_ref(&args.common.wand), MonotonicClock::new(0))?;
            poses.wait_until_seen()?;
            watch_quietly(config.clone(), move |config, monitor| {
                while_aiming(config, monitor, |aim, dialogue| {
                    let solved = aim_by_hand((raster, options), tip, &mut points, (&poses, aim), dialogue)?;
                    points.forget();
                    Ok(solved)
                })
            })?
        }
    };
    keep(&mut results, &config, &solved);
    print(&format!("{}\n{}\n", told_of(&solved), results.save(&config)?));
    Ok(())
}

fn projector_by_sensor(
    args: &ProjectorArgs,
    port: &str,
    known: Known,
    config: &RigConfig,
    mut results: Results,
) -> Result<(), Failure> {
    let tip = tip_of(&results)?;
    let sigma = results.file.wand.as_ref().map_or(1e-3, |wand| wand.tip_sigma_m);
    let setup = sensor::Setup {
        port: Port { path: port.to_owned(), baud: args.sensor_baud, gain: args.gain },
        wand: args.common.wand.clone(),
        seconds: args.seconds,
        aperture_m: 1e-3 * args.aperture,
        known,
    };
    let solution = watch_quietly(config.clone(), move |config, monitor| {
        sensor::calibrate(config, &setup, (tip, sigma), monitor)
    })?;
    sensor::keep(&mut results, config, &args.common.wand, &solution);
    // `dpm calibrate light` makes the flat field of it.
    light::save_sweep(&results.sweep(), &solution.brightness)?;
    print(&format!("{}\n{}\n", sensor::told_of(&solution), results.save(config)?));
    Ok(())
}

/// Runs the projector with a movable cross while `work` talks to the operator; the projector is dark afterwards.
fn while_aiming<T>(
    config: &RigConfig,
    monitor: &Arc<RunMonitor>,
    work: impl FnOnce(&Aim, &Dialogue) -> Result<T, Failure>,
) -> Result<T, Failure> {
    while_showing(config, monitor, Arc::new(Aim::default()), work)
}

/// Runs the projector with the pictures of `source` while `work` talks to the operator; the projector is dark
/// afterwards.
pub(super) fn while_showing<S: PatternSource + 'static, T>(
    config: &RigConfig,
    monitor: &Arc<RunMonitor>,
    source: Arc<S>,
    work: impl FnOnce(&S, &Dialogue) -> Result<T, Failure>,
) -> Result<T, Failure> {
    let stopped = Arc::clone(monitor);
    let dialogue = Dialogue::start(move || stopped.stop_requested())?;
    std::thread::scope(|scope| {
        let shown = Arc::clone(&source);
        let runs = scope.spawn(move || run_pattern(config, shown, monitor));
        let result = work(&source, &dialogue);
        monitor.request_stop();
        let ended = runs.join().unwrap_or_else(|_| {
            Err(Failure::new(FailureKind::Device, "the projector's thread ended by a panic (see above)"))
        });
        match (result, ended) {
            (Ok(value), Ok(_)) => Ok(value),
            // A projector that failed is the reason why the dialogue ended.
            (_, Err(failure)) => Err(failure),
            (Err(failure), _) => Err(failure),
        }
    })
}

fn write_opencv(args: &ExportArgs) -> Result<(), Failure> {
    let rig_args = RigArgs { set: args.set.clone(), ..RigArgs::default() };
    let rig = Rig::build(&rig_args.rig_at_rest(Some(&args.rig))?, None)?;
    let form = form_of(&args.out)?;
    let text = export(&rig.camera, form);
    dpm_common::files::write_atomically(&args.out, |out| std::io::Write::write_all(out, text.as_bytes()))
        .map_err(|e| Failure::new(FailureKind::BadInput, format!("{}: {e}", args.out.display())))?;
    print(&format!("written: {} (lengths in metres)\n", args.out.display()));
    Ok(())
}

fn form_of(path: &Path) -> Result<Form, Failure> {
    Form::of(path).ok_or_else(|| {
        let told = format!("{}: name the file .xml, .yml, .yaml or .json", path.display());
        Failure::new(FailureKind::BadInput, told)
    })
}

fn rehearse(args: &RehearseArgs) -> Result<(), Failure> {
    let bias = match args.bias {
        BiasWord::None => Bias::None,
        BiasWord::Wandering => Bias::Wandering(BIAS_M),
        BiasWord::Standing => Bias::Fixed(BIAS_M),
    };
    let rehearsal =
        rehearse_with(args.draws, args.seed, bias).map_err(|e| Failure::new(FailureKind::CheckFailed, e))?;
    if args.json {
        print(&(to_json(&rehearsal) + "\n"));
        return Ok(());
    }
    let r = &rehearsal;
    print(&format!(
        "{} truths drawn, lens, pose, tip, bodies, latency, light\n\
         error of the light {:.3} px median, {:.3} px 99th percentile; worst draw {:.3} px 99th percentile\n\
         predicted 99th percentile covers {:.0} % of the draws and is {:.1} times the true one\n\
         latency within {:.1} us, levels within {:.2} %\n",
        r.draws,
        r.error_px.p50,
        r.error_px.p99,
        r.worst_draw_p99_px,
        100.0 * r.covered,
        r.predicted_over_true,
        r.latency_error_us.max,
        100.0 * r.level_error.max
    ));
    Ok(())
}
