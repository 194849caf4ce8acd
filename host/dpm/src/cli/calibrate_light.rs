//! `dpm calibrate light` and `dpm calibrate latency`: what a light sensor tells once the projector is known.

use super::calibrate::{seconds, tip_of, Common};
use super::watch::{print, watch_quietly};
use crate::calibrate::light::{self, FlatSource};
use crate::calibrate::recorder::Port;
use crate::calibrate::results::Results;
use crate::calibrate::sensor;
use dpm_calibration::projector::Known;
use dpm_calibration::sensor::Brightness;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use glam::DVec3;

/// The sensor.
#[derive(clap::Args, Clone, Debug)]
struct SensorArgs {
    /// Serial port of the wand's light sensor
    #[arg(long, value_name = "PORT")]
    sensor: String,
    /// Bits per second of the sensor's port
    #[arg(long, value_name = "BAUD", default_value_t = 3_000_000)]
    sensor_baud: u32,
    /// Gain setting of the sensor
    #[arg(long, value_name = "N", default_value_t = 0)]
    gain: u8,
    /// Diameter of the sensor's aperture, millimetres
    #[arg(long, value_name = "MM", default_value_t = 3.0, value_parser = seconds)]
    aperture: f64,
}

#[derive(clap::Args, Clone, Debug)]
pub(super) struct LightArgs {
    #[command(flatten)]
    common: Common,
    #[command(flatten)]
    sensor: SensorArgs,
    /// Measure the flat field anew by moving the sensor through the beam for so many seconds, before it is put down; without
    /// this the last sweep of `dpm calibrate projector --sensor` serves
    #[arg(long, value_name = "S", value_parser = seconds)]
    sweep: Option<f64>,
    /// Direction into which a flat sensor looks, in the wand's body frame; default: a round diffuser, which has none
    #[arg(long, value_name = "X,Y,Z", value_parser = direction, allow_hyphen_values = true)]
    looks: Option<DVec3>,
    /// Frequency of the mains, hertz
    #[arg(long, value_name = "HZ", default_value_t = 50, value_parser = clap::value_parser!(u8).range(50..=60))]
    mains: u8,
}

#[derive(clap::Args, Clone, Debug)]
pub(super) struct LatencyArgs {
    #[command(flatten)]
    common: Common,
    #[command(flatten)]
    sensor: SensorArgs,
    /// Seconds of motion
    #[arg(long, value_name = "S", default_value_t = 10.0, value_parser = seconds)]
    seconds: f64,
}

fn direction(text: &str) -> Result<DVec3, String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|n| n.trim().parse().ok()).collect();
    let three: Option<[f64; 3]> = numbers.and_then(|n| n.try_into().ok());
    let direction = three.and_then(|n| DVec3::from_array(n).try_normalize());
    direction.ok_or_else(|| "write three numbers with commas between them, not all 0".into())
}

impl SensorArgs {
    fn port(&self) -> Port {
        Port { path: self.sensor.clone(), baud: self.sensor_baud, gain: self.gain }
    }

    fn setup(&self, common: &Common, seconds: f64) -> sensor::Setup {
        sensor::Setup {
            port: self.port(),
            wand: common.wand.clone(),
            seconds,
            aperture_m: 1e-3 * self.aperture,
            known: Known::default(),
        }
    }
}

/// The tip of the wand and its standard deviation.
fn tip_and_sigma(results: &Results) -> Result<(DVec3, f64), Failure> {
    let sigma = results.file.wand.as_ref().map_or(1e-3, |wand| wand.tip_sigma_m);
    Ok((tip_of(results)?, sigma))
}

impl LightArgs {
    pub(super) fn execute(&self) -> Result<(), Failure> {
        let (config, mut results) = self.common.open()?;
        let sweep = match self.sweep {
            Some(seconds) => Some(self.sweep(&config, &results, seconds)?),
            None => light::load_sweep(&results.sweep())?,
        };
        let (port, flicker_hz) = (self.sensor.port(), 2.0 * f64::from(self.mains));
        let channels = watch_quietly(config.clone(), move |config, monitor| {
            light::measure(config, &port, flicker_hz, monitor)
        })?;
        let source = sweep.map_or(FlatSource::Former, |sweep| FlatSource::Sweep(sweep, self.looks));
        let told = light::keep(&mut results, &config, channels, source)?;
        print(&format!("{told}\n{}\n", results.save(&config)?));
        Ok(())
    }

    fn sweep(&self, config: &RigConfig, results: &Results, seconds: f64) -> Result<Vec<Brightness>, Failure> {
        let tip = tip_and_sigma(results)?;
        let setup = self.sensor.setup(&self.common, seconds);
        let solution = watch_quietly(config.clone(), move |config, monitor| {
            sensor::calibrate(config, &setup, tip, monitor)
        })?;
        light::save_sweep(&results.sweep(), &solution.brightness)?;
        Ok(solution.brightness)
    }
}

impl LatencyArgs {
    pub(super) fn execute(&self) -> Result<(), Failure> {
        let (config, mut results) = self.common.open()?;
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
            bad("the projector's lens has more than five coefficients; run `dpm calibrate projector`")
        })?;
        let tip = tip_and_sigma(&results)?;
        let setup = self.sensor.setup(&self.common, self.seconds);
        let latency = watch_quietly(config.clone(), move |config, monitor| {
            sensor::latency(config, &setup, tip, &model, monitor)
        })?;
        sensor::keep_latency(&mut results, &config, &self.common.wand, &latency);
        print(&format!("{}\n{}\n", sensor::told_of_latency(&latency), results.save(&config)?));
        Ok(())
    }
}
