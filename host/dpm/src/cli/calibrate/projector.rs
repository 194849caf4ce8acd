//! `dpm calibrate projector`: by hand, from a file of points, or by the wand's light sensor.

use super::camera::Paper;
use super::{at_a_rate_that_is_carried, seconds, tip_and_sigma, tip_of, Common, SensorArgs};
use crate::cli::watch::{print, watch_quietly};
use dpm_calibrate::aim::Aim;
use dpm_calibrate::dialogue::Dialogue;
use dpm_calibrate::poses::Poses;
use dpm_calibrate::projector::{aim_by_hand, keep, solve_file, told_of, Points};
use dpm_calibrate::shown::while_shown;
use dpm_calibrate::{light, sensor, view};
use dpm_calibration::projector::{LensTerms, Options, PlaceHint, ProjectorFit};
use dpm_common::clock::MonotonicClock;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::pack::source::PatternSource;
use dpm_rig::pattern::run_pattern;
use dpm_rig::results::Results;
use dpm_rig::telemetry::monitor::RunMonitor;
use glam::DVec3;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

#[derive(clap::Args, Clone, Debug)]
pub(super) struct ProjectorArgs {
    #[command(flatten)]
    common: Common,
    /// Distance from the lens to the middle of the points by a tape measure, metres; catches wrong units
    #[arg(long, value_name = "M", value_parser = metres)]
    distance: Option<f64>,
    /// Direction of the world that points up (x, y or z); catches exchanged axes of a projector that stands upright
    #[arg(long, value_name = "AXIS", value_parser = axis)]
    up: Option<DVec3>,
    /// Numbers of the lens that are solved for; more of them need points all over the picture, and are refused where the
    /// points do not tell them
    #[arg(long, value_enum, default_value = "brown")]
    lens: LensWord,
    /// Bias of the tracker to reckon with, millimetres along an axis: what no mean removes. The predicted error grows by it
    #[arg(long, value_name = "MM", default_value_t = 0.0, value_parser = super::zero_or_millimetres)]
    bias: f64,
    /// Serial port of the wand's light sensor: move the wand through coded light in place of aiming by hand
    #[arg(long, value_name = "PORT", conflicts_with = "points")]
    sensor: Option<String>,
    #[command(flatten)]
    sensor_args: SensorArgs,
    /// Seconds of motion with the sensor; default: 30, or 75 where frames and their inverse are shown
    #[arg(long, value_name = "S", value_parser = seconds, requires = "sensor")]
    seconds: Option<f64>,
    /// Let the rig's camera look at coded pictures on whatever is there, with a body that carries tags or the printed board in view
    #[arg(long, conflicts_with_all = ["sensor", "points"])]
    camera: bool,
    /// The paper of the printed board that may be in view
    #[arg(long, value_enum, default_value = "a4", requires = "camera")]
    paper: Paper,
    /// How long a picture stands before the camera's picture of it counts, seconds
    #[arg(long, value_name = "S", default_value_t = 0.3, value_parser = seconds, requires = "camera")]
    settle: f64,
    /// Show nothing and ask for nothing: solve the points of a file, "x y z column row" a line, metres and pixels
    #[arg(long, value_name = "FILE")]
    points: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum LensWord {
    /// k1, k2, p1, p2, k3
    Brown,
    /// k4, k5, k6, too: for wide angles
    Rational,
    /// s1, s2, s3, s4, too: for lenses that are tilted
    ThinPrism,
}

impl LensWord {
    fn terms(self) -> LensTerms {
        match self {
            Self::Brown => LensTerms::Brown,
            Self::Rational => LensTerms::Rational,
            Self::ThinPrism => LensTerms::ThinPrism,
        }
    }
}

fn metres(text: &str) -> Result<f64, String> {
    super::number(text, "metres", 0.01, 1000.0)
}

fn axis(text: &str) -> Result<DVec3, String> {
    match text {
        "x" => Ok(DVec3::X),
        "y" => Ok(DVec3::Y),
        "z" => Ok(DVec3::Z),
        _ => Err("write x, y or z".into()),
    }
}

impl ProjectorArgs {
    /// Measures lens and pose.
    ///
    /// # Errors
    /// As [`super::execute`].
    pub(super) fn execute(&self) -> Result<(), Failure> {
        let (config, results) = self.common.open()?;
        let raster = config.projector.raster();
        let known = PlaceHint { distance_m: self.distance, up: self.up };
        let by_hand = Options::by_hand(raster);
        let options = Options { known, priors: by_hand.priors.with_lens(self.lens.terms()), ..by_hand };
        if self.camera {
            return self.by_camera(&config, results);
        }
        match (&self.sensor, &self.points) {
            (Some(port), _) => self.by_sensor(port, known, &config, results),
            (None, Some(path)) => self.told(results, &config, &solve_file(path, raster, options)?),
            (None, None) => self.by_hand(options, &config, results),
        }
    }

    fn by_hand(&self, options: Options, config: &RigConfig, results: Results) -> Result<(), Failure> {
        let (raster, tip) = (config.projector.raster(), tip_of(&results)?);
        let mut points = Points::resume(results.progress("projector"))?;
        let poses = Poses::start(config, std::slice::from_ref(&self.common.wand), MonotonicClock::new(0))?;
        poses.wait_until_seen()?;
        let (solved, points) = watch_quietly(config.clone(), move |config, monitor| {
            while_showing(config, monitor, Arc::new(Aim::default()), |aim, dialogue| {
                let solved = aim_by_hand((raster, options), tip, &mut points, (&poses, aim), dialogue)?;
                Ok((solved, points))
            })
        })?;
        self.told(results, config, &solved)?;
        // Not before the result is written: until then the points are all there is.
        points.forget();
        Ok(())
    }

    fn by_camera(&self, config: &RigConfig, mut results: Results) -> Result<(), Failure> {
        let clock = view::clock();
        let bad = |told: String| Failure::new(FailureKind::BadInput, told);
        let none = || bad("the rig's tracker has no pictures; write tracker.kind = \"camera\"".into());
        let mut eyes = config.tracker.view(&clock).ok_or_else(none)?.map_err(|e| bad(e.to_string()))?;
        let eye = config.tracker.eye().ok_or_else(none)?.map_err(|e| bad(e.to_string()))?;
        let settle = Duration::from_secs_f64(self.settle);
        let task = view::ViewTask { clock, board: Some(self.paper.board().0), settle };
        let fit = watch_quietly(config.clone(), move |config, monitor| {
            view::calibrate(config, (&mut eyes, &eye), &task, monitor, &mut |text| {
                print(&format!("{text}\n"))
            })
        })?;
        view::keep(&mut results, config, &fit);
        print(&format!("{}\n{}\n", view::told_of(&fit), results.save(config)?));
        Ok(())
    }

    fn by_sensor(
        &self,
        port: &str,
        known: PlaceHint,
        config: &RigConfig,
        mut results: Results,
    ) -> Result<(), Failure> {
        let tip = tip_and_sigma(&results)?;
        let usual = if self.sensor_args.is_held(config) { 75.0 } else { 30.0 };
        let seconds = self.seconds.unwrap_or(usual);
        let lens = self.lens.terms();
        let setup = self.sensor_args.setup(port, (&self.common, config), seconds, known);
        let setup = sensor::SensorSetup { lens, ..setup };
        let solution = at_a_rate_that_is_carried(&mut config.clone(), move |config, monitor| {
            sensor::calibrate(config, &setup, tip, monitor)
        })?;
        sensor::keep(&mut results, config, (&self.common.wand, 1e-3 * self.bias), &solution);
        // `dpm calibrate light` makes the flat field of it.
        light::save_sweep(&results.sweep(), &solution.brightness)?;
        let told = format!("{}{}", sensor::told_of(&solution), self.told_of_bias(&results));
        print(&format!("{told}\n{}\n", results.save(config)?));
        Ok(())
    }

    /// Writes a projector and says how good it is.
    fn told(&self, mut results: Results, config: &RigConfig, solved: &ProjectorFit) -> Result<(), Failure> {
        keep(&mut results, config, solved, 1e-3 * self.bias);
        let told = format!("{}{}", told_of(solved), self.told_of_bias(&results));
        print(&format!("{told}\n{}\n", results.save(config)?));
        Ok(())
    }

    /// What a bias of the tracker makes of the prediction.
    fn told_of_bias(&self, results: &Results) -> String {
        match &results.file.projector {
            Some(p) if self.bias > 0.0 => {
                format!(
                    "\nwith a tracker bias of {} mm: predicted error {:.3} px",
                    self.bias, p.predicted_p99_px
                )
            }
            _ => String::new(),
        }
    }
}

/// Shows the pictures of `source` while `work` talks to the operator.
///
/// # Errors
/// As [`while_shown`].
pub(super) fn while_showing<S: PatternSource + 'static, T>(
    config: &RigConfig,
    monitor: &Arc<RunMonitor>,
    source: Arc<S>,
    work: impl FnOnce(&S, &Dialogue) -> Result<T, Failure>,
) -> Result<T, Failure> {
    let stopped = Arc::clone(monitor);
    let dialogue = Dialogue::start(move || stopped.stop_requested())?;
    let shown = Arc::clone(&source);
    let run = || run_pattern(config, shown, monitor);
    Ok(while_shown(monitor, run, || work(&source, &dialogue))?.0)
}
