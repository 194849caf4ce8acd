//! `dpm calibrate light` and `dpm calibrate latency`: what a light sensor tells once the projector is known.

use super::{at_a_rate_that_is_carried, numbers, seconds, tip_and_sigma, Common, SensorArgs};
use crate::cli::watch::print;
use dpm_calibrate::light::{self, FlatSource, Ways};
use dpm_calibrate::sensor;
use dpm_calibration::projector::PlaceHint;
use dpm_calibration::sensor::Brightness;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::results::Results;
use glam::DVec3;
use std::sync::{Arc, Mutex, PoisonError};

/// A wand that has a light sensor.
#[derive(clap::Args, Clone, Debug)]
struct SensorWand {
    #[command(flatten)]
    common: Common,
    /// Serial port of the wand's light sensor
    #[arg(long, value_name = "PORT")]
    sensor: String,
    #[command(flatten)]
    args: SensorArgs,
}

impl SensorWand {
    /// How its sensor is recorded in coded light for so many seconds.
    fn setup(&self, config: &RigConfig, seconds: f64) -> sensor::SensorSetup {
        self.args.setup(&self.sensor, (&self.common, config), seconds, PlaceHint::default())
    }
}

#[derive(clap::Args, Clone, Debug)]
pub(super) struct LightArgs {
    #[command(flatten)]
    wand: SensorWand,
    /// Measure the flat field anew by moving the sensor through the beam for so many seconds, before it is put down; without
    /// this the last sweep of `dpm calibrate projector --sensor` serves
    #[arg(long, value_name = "S", value_parser = seconds)]
    sweep: Option<f64>,
    /// Direction into which a flat sensor looks, in the wand's body frame; default: a round diffuser, which has none
    #[arg(long, value_name = "X,Y,Z", value_parser = direction, allow_hyphen_values = true)]
    looks: Option<DVec3>,
    /// Codes of each channel; fewer take less time
    #[arg(long, value_name = "N", default_value_t = 32, value_parser = clap::value_parser!(u32).range(4..=255))]
    codes: u32,
    /// Frequency of the mains, hertz
    #[arg(long, value_name = "HZ", default_value_t = 50, value_parser = clap::value_parser!(u8).range(50..=60))]
    mains: u8,
}

#[derive(clap::Args, Clone, Debug)]
pub(super) struct LatencyArgs {
    #[command(flatten)]
    wand: SensorWand,
    /// Seconds of motion
    #[arg(long, value_name = "S", default_value_t = 10.0, value_parser = seconds)]
    seconds: f64,
}

fn direction(text: &str) -> Result<DVec3, String> {
    let direction = numbers(text).and_then(|n: [f64; 3]| DVec3::from_array(n).try_normalize());
    direction.ok_or_else(|| "write three numbers with commas between them, not all 0".into())
}

impl LightArgs {
    pub(super) fn execute(&self) -> Result<(), Failure> {
        let (config, mut results) = self.wand.common.open()?;
        let sweep = match self.sweep {
            Some(seconds) => Some(self.sweep(&config, &results, seconds)?),
            None => light::load_sweep(&results.sweep())?,
        };
        let ways = Ways {
            port: self.wand.args.port(&self.wand.sensor),
            flicker_hz: 2.0 * f64::from(self.mains),
            codes: self.codes,
            in_tiles: self.wand.args.is_held(&config),
        };
        let progress = Arc::new(Mutex::new(light::ReadingProgress::default()));
        let mut paced = config.clone();
        let channels = loop {
            let (ways, progress) = (ways.clone(), Arc::clone(&progress));
            let pass = at_a_rate_that_is_carried(&mut paced, move |config, monitor| {
                let mut progress = progress.lock().unwrap_or_else(PoisonError::into_inner);
                light::measure(config, &ways, &mut progress, monitor)
            })?;
            if let Some(channels) = pass {
                break channels;
            }
        };
        let source = sweep.map_or(FlatSource::Former, |sweep| FlatSource::Sweep(sweep, self.looks));
        let told = light::keep(&mut results, &config, channels, source);
        print(&format!("{told}\n{}\n", results.save(&config)?));
        Ok(())
    }

    fn sweep(&self, config: &RigConfig, results: &Results, seconds: f64) -> Result<Vec<Brightness>, Failure> {
        let tip = tip_and_sigma(results)?;
        let setup = self.wand.setup(config, seconds);
        let solution = at_a_rate_that_is_carried(&mut config.clone(), move |config, monitor| {
            sensor::calibrate(config, &setup, tip, monitor)
        })?;
        light::save_sweep(&results.sweep(), &solution.brightness)?;
        Ok(solution.brightness)
    }
}

impl LatencyArgs {
    pub(super) fn execute(&self) -> Result<(), Failure> {
        let (config, mut results) = self.wand.common.open()?;
        let bad = |told: &str| Failure::new(FailureKind::BadInput, told);
        let section = results.file.projector.as_ref().ok_or_else(|| {
            bad("the projector is not known yet: run `dpm calibrate projector` first, with --sensor if you can")
        })?;
        let raster = config.projector.raster();
        if section.size != [raster.width(), raster.height()] {
            let [width, height] = section.size;
            return Err(bad(&format!(
                "the projector was calibrated at {width} x {height} pixels, and the rig file has {} x {}; run \
                 `dpm calibrate projector` again",
                raster.width(),
                raster.height()
            )));
        }
        let model = section.model().ok_or_else(|| {
            bad("the projector's lens has more than twelve coefficients; run `dpm calibrate projector`")
        })?;
        let tip = tip_and_sigma(&results)?;
        let setup = self.wand.setup(&config, self.seconds);
        let latency = at_a_rate_that_is_carried(&mut config.clone(), move |config, monitor| {
            sensor::latency(config, &setup, tip, &model, monitor)
        })?;
        sensor::keep_latency(&mut results, &config, &self.wand.common.wand, &latency);
        print(&format!("{}\n{}\n", sensor::told_of_latency(&latency), results.save(&config)?));
        Ok(())
    }
}
