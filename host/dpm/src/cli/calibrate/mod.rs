//! `dpm calibrate ...`: measures what a rig needs to know, and writes it into the calibration file.

mod camera;
mod check;
mod light;
#[cfg(feature = "page")]
mod page;
mod projector;

use super::rig_args::RigArgs;
use super::watch::{print, watch_quietly};
use camera::CameraArgs;
use check::{check, nudge, CheckArgs, NudgeArgs};
use dpm_calibrate::dialogue::Dialogue;
use dpm_calibrate::pace::{slower, PaceResult};
use dpm_calibrate::recorder::Port;
use dpm_calibrate::{body, sensor, wand};
use dpm_calibration::projector::{LensTerms, PlaceHint};
use dpm_calibration::rehearsal::{rehearse_with, Bias};
use dpm_camera_files::{export, StorageForm};
use dpm_rig::config::{PlaneTiming, RigConfig};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::results::Results;
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_rig::telemetry::report::to_json;
use glam::DVec3;
use light::{LatencyArgs, LightArgs};
#[cfg(feature = "page")]
use page::GuideArgs;
use projector::ProjectorArgs;
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
    /// Print a board, and find focal length, centre and lens of the camera that looks at it
    Camera(CameraArgs),
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
    /// Serve a page in a browser that shows the steps for this rig, does them one by one, and asks what to keep
    #[cfg(feature = "page")]
    Page(GuideArgs),
    /// Write lens and pose of the rig's projector as a file of OpenCV (.xml, .yml or .json)
    Export(ExportArgs),
    /// Run the whole calibration in simulation, against truths that it does not know, and print its errors
    Rehearse(RehearseArgs),
}

/// What every measurement needs.
#[derive(clap::Args, Clone, Debug)]
struct Common {
    /// The rig file with tracker and projector
    #[arg(value_name = "RIG.toml")]
    rig: PathBuf,
    /// The calibration file; default: the one that the rig file names, or calibration.toml beside it
    #[arg(long, value_name = "FILE")]
    file: Option<PathBuf>,
    /// Name of the wand in the tracking software
    #[arg(long, value_name = "NAME", default_value = "wand")]
    wand: String,
    /// Set a key of the rig file, for example tracker.server=192.168.1.10; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// How the light sensor is read.
#[derive(clap::Args, Clone, Debug)]
struct SensorArgs {
    /// Bits per second of the sensor's port
    #[arg(long, value_name = "BAUD", default_value_t = 3_000_000)]
    sensor_baud: u32,
    /// Gain setting of the sensor
    #[arg(long, value_name = "N", default_value_t = 0)]
    gain: u8,
    /// What is shown: coded planes, or frames and their inverse, for which the wand is held still at one place after another;
    /// default: frames on a display that is given code values, else planes
    #[arg(long, value_enum)]
    code: Option<CodeWord>,
    /// Diameter of the sensor's aperture, millimetres
    #[arg(long, value_name = "MM", default_value_t = 3.0, value_parser = millimetres)]
    aperture: f64,
}

#[derive(Clone, Copy, Debug, PartialEq, clap::ValueEnum)]
enum CodeWord {
    /// 24 binary planes of equal light a frame
    Planes,
    /// One black and white picture a frame
    Frames,
}

impl SensorArgs {
    /// Whether frames and their inverse are shown.
    fn is_held(&self, config: &RigConfig) -> bool {
        let has_equal_planes = config.projector.plane_timing() == PlaneTiming::Equal;
        self.code.map_or(!has_equal_planes, |code| code == CodeWord::Frames)
    }

    fn port(&self, path: &str) -> Port {
        Port { path: path.to_owned(), baud: self.sensor_baud, gain: self.gain }
    }

    fn setup(
        &self,
        path: &str,
        (common, config): (&Common, &RigConfig),
        seconds: f64,
        known: PlaceHint,
    ) -> sensor::SensorSetup {
        sensor::SensorSetup {
            port: self.port(path),
            wand: common.wand.clone(),
            seconds,
            aperture_m: 1e-3 * self.aperture,
            known,
            lens: LensTerms::Brown,
            rate_hz: config.projector.frame_rate.hz(),
            is_held: self.is_held(config),
            has_begun: Arc::default(),
        }
    }
}

#[derive(clap::Args, Clone, Debug)]
struct WandArgs {
    #[command(flatten)]
    common: Common,
    /// The tip measured with a ruler, millimetres in the wand's body, instead of turning; the light sensor refines it
    #[arg(long, value_name = "X,Y,Z", value_parser = millimetres_each, allow_hyphen_values = true)]
    tip: Option<DVec3>,
    /// Seconds of turning
    #[arg(long, value_name = "S", default_value_t = 15.0, value_parser = seconds)]
    seconds: f64,
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
    #[arg(long, value_name = "MM", default_value_t = 0.0, value_parser = zero_or_millimetres)]
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

/// A picture may stay for this long without another one, milliseconds.
const PICTURE_MS: u32 = 500;

/// Bias of the tracker in rehearsals that have one, metres along an axis.
const BIAS_M: f64 = 5e-5;

/// Numbers with commas between them.
fn numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let all: Option<Vec<f64>> = text.split(',').map(|n| n.trim().parse().ok()).collect();
    all?.try_into().ok()
}

fn millimetres_each(text: &str) -> Result<DVec3, String> {
    let within = numbers(text).filter(|n: &[f64; 3]| n.iter().all(|v| v.abs() <= 1e4));
    within
        .map(DVec3::from_array)
        .ok_or_else(|| "write three numbers of millimetres, such as 10,-5,120".into())
}

/// A number of `what`, from `least` to `most`.
fn number(text: &str, what: &str, least: f64, most: f64) -> Result<f64, String> {
    let value = text.parse().ok().filter(|v: &f64| (least..=most).contains(v));
    value.ok_or_else(|| format!("write {what}, {least} to {most}"))
}

fn seconds(text: &str) -> Result<f64, String> {
    number(text, "seconds", 0.1, 3600.0)
}

fn zero_or_seconds(text: &str) -> Result<f64, String> {
    number(text, "seconds", 0.0, 3600.0)
}

fn millimetres(text: &str) -> Result<f64, String> {
    number(text, "millimetres", 0.001, 1000.0)
}

fn zero_or_millimetres(text: &str) -> Result<f64, String> {
    number(text, "millimetres", 0.0, 1000.0)
}

impl Common {
    /// The rig file, of which tracker and projector are used, and its calibration file.
    fn open(&self) -> Result<(RigConfig, Results), Failure> {
        let args = RigArgs { set: self.set.clone(), ..RigArgs::default() };
        let mut config = args.rig_to_calibrate(&self.rig)?;
        // A pattern runs until it is stopped.
        (config.run.frames, config.run.seconds) = (0, 0.0);
        // Its pictures do not follow a body, so none is too old; one that is late must not leave a gap in the light, since
        // gaps are flashes.
        config.safety.predict_ms.get_or_insert(PICTURE_MS);
        let results = Results::open(self.file.as_deref(), &self.rig, &config)?;
        // One that this command will make has nothing to say yet.
        config.calibration.file = config.calibration.file.filter(|file| file.exists());
        Ok((config, results))
    }
}

/// Runs `measure` beside the watch over signals and orders, at ever lower rates until the link carries its frames;
/// `config` keeps the rate.
///
/// # Errors
/// That of `measure`, or no rate is low enough (exit code 3).
fn at_a_rate_that_is_carried<T: Send + 'static>(
    config: &mut RigConfig,
    measure: impl Fn(&RigConfig, &Arc<RunMonitor>) -> Result<PaceResult<T>, Failure> + Clone + Send + 'static,
) -> Result<T, Failure> {
    loop {
        let once = measure.clone();
        match watch_quietly(config.clone(), move |config, monitor| once(config, monitor))? {
            PaceResult::Done(result) => return Ok(result),
            PaceResult::TooFast { carried_hz } => {
                let before = config.projector.frame_rate.hz();
                *config = slower(config, carried_hz)?;
                print(&format!(
                    "only {carried_hz:.0} of {before:.0} frames/s reach the projector in time; trying {:.0}\n",
                    config.projector.frame_rate.hz()
                ));
            }
        }
    }
}

/// The tip of the wand by a former `dpm calibrate wand`, and its standard deviation.
fn tip_and_sigma(results: &Results) -> Result<(DVec3, f64), Failure> {
    let sigma = results.file.wand.as_ref().map_or(1e-3, |wand| wand.tip_sigma_m);
    Ok((tip_of(results)?, sigma))
}

/// The tip of the wand by a former `dpm calibrate wand`.
fn tip_of(results: &Results) -> Result<DVec3, Failure> {
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
        What::Projector(args) => args.execute(),
        What::Camera(args) => args.execute(),
        What::Body(args) => {
            let (config, mut results) = args.common.open()?;
            let scene = Rig::build(&config, None)?.scene;
            let wand = (args.common.wand.as_str(), tip_of(&results)?);
            let ways = body::Ways { wander_s: args.wander, tip_radius_m: 1e-3 * args.tip_radius };
            let dialogue = Dialogue::start(|| false)?;
            let told = body::calibrate(&config, &scene, wand, &args.body, ways, &mut results, &dialogue)?;
            print(&format!("{told}\n"));
            Ok(())
        }
        What::Check(args) => check(args),
        What::Nudge(args) => nudge(args),
        What::Light(args) => args.execute(),
        What::Latency(args) => args.execute(),
        #[cfg(feature = "page")]
        What::Page(args) => args.execute(),
        What::Export(args) => write_opencv(args),
        What::Rehearse(args) => rehearse(args),
    }
}

fn write_opencv(args: &ExportArgs) -> Result<(), Failure> {
    let rig_args = RigArgs { set: args.set.clone(), ..RigArgs::default() };
    let rig = Rig::build(&rig_args.rig_at_rest(Some(&args.rig))?, None)?;
    let form = form_of(&args.out)?;
    let text = export(&rig.camera, form);
    dpm_common::files::write_atomically(&args.out, |out| std::io::Write::write_all(out, text.as_bytes()))
        .map_err(|e| Failure::new(FailureKind::BadInput, format!("{}: {e}", args.out.display())))?;
    // What was not read of the rig's calibration is not in the new file either.
    let of_calibration = rig.scene.warnings.iter().filter(|told| told.starts_with("projector.calibration"));
    of_calibration.for_each(|told| print(&format!("note: {told}\n")));
    print(&format!("written: {} (lengths in metres)\n", args.out.display()));
    Ok(())
}

fn form_of(path: &Path) -> Result<StorageForm, Failure> {
    StorageForm::of(path).ok_or_else(|| {
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
         on bodies that move at 1 m/s, beyond what their prediction adds: {:.3} px median, {:.3} px 99th percentile\n\
         predicted 99th percentile covers {:.0} % of the draws and is {:.1} times the true one\n\
         latency within {:.1} us, levels within {:.2} %\n",
        r.draws,
        r.error_px.p50,
        r.error_px.p99,
        r.worst_draw_p99_px,
        r.moving_px.p50,
        r.moving_px.p99,
        100.0 * r.covered,
        r.predicted_over_true,
        r.latency_error_us.max,
        100.0 * r.level_error.max
    ));
    Ok(())
}
