//! Parses moving bodies from the command line: the common part of all mock trackers.

use clap::Args;
use dpm_device::pose::Pose;
use dpm_device::time::{FrameRate, HostClock, HostTime};
use hil_mock::faults::FaultPlan;
use hil_mock::motion::{Motion, MotionSpec};
use hil_mock::tracker::{MockTrackerConfig, SampleSource};
use std::error::Error;
use std::sync::Arc;
use std::time::Instant;

/// Bodies, noise and faults.
#[derive(Args)]
pub(super) struct TrackerArguments {
    /// Body as NAME[@X,Y,Z][=MOTION], metres; MOTION is `still`, `translate`, `rotate` or a JSON object as in a rig file.
    /// May be repeated
    #[arg(long = "body", value_name = "BODY", default_values = ["Hare@0,0,1.5=translate", "Bust@0.3,0,1.5=rotate"])]
    bodies: Vec<String>,
    /// Samples per second, as a number or fraction (`947/2`)
    #[arg(long, default_value = "500")]
    rate: String,
    /// Standard deviation of the position noise on each axis, metres
    #[arg(long, default_value_t = 0.0)]
    noise_m: f64,
    /// Standard deviation of the rotation noise about each axis, radians
    #[arg(long, default_value_t = 0.0)]
    noise_rad: f64,
    /// From capture to sending, milliseconds
    #[arg(long, default_value_t = 2.0)]
    latency_ms: f64,
    /// Added to the latency, evenly distributed, milliseconds
    #[arg(long, default_value_t = 0.0)]
    jitter_ms: f64,
    /// What goes wrong, for example `loss=0.01,dropout@5s+20ms/10s`
    #[arg(long, default_value = "")]
    faults: FaultPlan,
    /// Seed of noise and faults
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Stop after this many seconds
    #[arg(long, value_parser = super::seconds)]
    pub seconds: Option<f64>,
}

impl TrackerArguments {
    /// Names of the bodies and the source of their samples.
    pub(super) fn source(&self) -> Result<(Vec<String>, SampleSource), Box<dyn Error>> {
        let mut names = Vec::new();
        let mut motions = Vec::new();
        for text in &self.bodies {
            let (name, motion) = parse_body(text)?;
            names.push(name);
            motions.push(motion);
        }
        let config = MockTrackerConfig {
            seed: self.seed,
            rate: parse_rate(&self.rate)?,
            position_noise_m: self.noise_m,
            rotation_noise_rad: self.noise_rad,
            latency_ns: (self.latency_ms * 1e6) as i64,
            latency_jitter_ns: (self.jitter_ms * 1e6) as i64,
            faults: self.faults.clone(),
            ..Default::default()
        };
        Ok((names, SampleSource::new(config, motions)?))
    }
}

/// A clock that starts at 0 now.
pub(super) fn clock_from_now() -> Arc<dyn HostClock> {
    let epoch = Instant::now();
    Arc::new(move || HostTime(i64::try_from(epoch.elapsed().as_nanos()).unwrap_or(i64::MAX)))
}

pub(super) fn parse_body(text: &str) -> Result<(String, Motion), String> {
    let wrong = |why: String| format!("--body `{text}`: {why}");
    let (place, motion) = text.split_once('=').unwrap_or((text, "still"));
    let (name, position) = match place.split_once('@') {
        Some((name, position)) => (name, position),
        None => (place, "0,0,0"),
    };
    let numbers: Vec<f64> = position.split(',').filter_map(|n| n.trim().parse().ok()).collect();
    let [x, y, z] = numbers[..] else {
        return Err(wrong(format!("`{position}` is not three numbers X,Y,Z in metres")));
    };
    let json =
        if motion.trim_start().starts_with('{') { motion.into() } else { format!("{{\"kind\":{motion:?}}}") };
    let spec: MotionSpec = serde_json::from_str(&json).map_err(|e| wrong(e.to_string()))?;
    let rest = Pose { position_m: [x, y, z], ..Pose::IDENTITY };
    Ok((name.to_owned(), Motion::new(&spec, rest).map_err(|e| wrong(e.to_string()))?))
}

pub(super) fn parse_rate(text: &str) -> Result<FrameRate, String> {
    let (num, den) = text.split_once('/').unwrap_or((text, "1"));
    let rate = num.trim().parse().ok().zip(den.trim().parse().ok());
    rate.and_then(|(num, den)| FrameRate::new(num, den))
        .ok_or_else(|| format!("--rate `{text}`: a whole number or a fraction such as 947/2, above 0"))
}
