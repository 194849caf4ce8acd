//! `hil-mock serve pupil`: Pupil Capture with eyes that look about.

use super::bodies::{clock_from_now, parse_rate};
use super::say;
use clap::Args;
use hil_mock::faults::FaultPlan;
use hil_mock::pupil::eyes::EyeMotion;
use hil_mock::pupil::host::PupilHost;
use hil_mock::pupil::messages::{Mapping, PupilConfig};
use std::error::Error;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::time::{Duration, Instant};

/// Arguments of `hil-mock serve pupil`.
#[derive(Args)]
pub(crate) struct PupilArguments {
    /// Address to serve on
    #[arg(long, default_value = "127.0.0.1")]
    bind: Ipv4Addr,
    /// TCP port of Pupil Remote; the data have any port, which it tells
    #[arg(long, default_value_t = 50020)]
    port: u16,
    /// Samples per second, as a number or fraction
    #[arg(long, default_value = "200")]
    rate: String,
    /// From the picture of the eyes to the message, milliseconds
    #[arg(long, default_value_t = 8.0)]
    latency_ms: f64,
    /// Standard deviation of a line of sight about each axis, degrees
    #[arg(long, default_value_t = 0.5)]
    noise_deg: f64,
    /// Confidence while the eyes are open
    #[arg(long, default_value_t = 0.95)]
    confidence: f64,
    /// Mean time between two blinks, seconds; 0 for none
    #[arg(long, default_value_t = 4.0)]
    blink_every_s: f64,
    /// Duration of a blink, milliseconds
    #[arg(long, default_value_t = 150.0)]
    blink_ms: f64,
    /// Mean time between two saccades, milliseconds
    #[arg(long, default_value_t = 400.0)]
    fixation_ms: f64,
    /// What Pupil's clock shows at the start, seconds
    #[arg(long, default_value_t = 5000.0)]
    clock_offset_s: f64,
    /// How much faster than this machine's it runs, parts per million
    #[arg(long, default_value_t = 0.0)]
    clock_ppm: f64,
    /// Has no calibration: pupils and no gaze
    #[arg(long)]
    no_calibration: bool,
    /// Maps gaze in 2D
    #[arg(long, conflicts_with = "no_calibration")]
    flat: bool,
    /// What goes wrong: loss, corrupt, dropout, unplug, reset, as in `loss=0.01,unplug@5s+2s`
    #[arg(long, default_value = "")]
    faults: FaultPlan,
    /// Seed of eyes, noise and faults
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Stop after this many seconds
    #[arg(long, value_parser = super::seconds)]
    seconds: Option<f64>,
}

/// Serves until the time is over or a socket fails.
pub(super) fn run(arguments: &PupilArguments) -> Result<(), Box<dyn Error>> {
    let ns = |ms: f64| (ms * 1e6) as i64;
    let eyes = EyeMotion {
        seed: arguments.seed,
        fixation_ns: ns(arguments.fixation_ms).max(1_000_000),
        blink_every_ns: ns(1e3 * arguments.blink_every_s),
        blink_ns: ns(arguments.blink_ms),
        ..EyeMotion::default()
    };
    let mapping = match (arguments.no_calibration, arguments.flat) {
        (true, _) => Mapping::Missing,
        (_, true) => Mapping::Flat,
        _ => Mapping::Solid,
    };
    let config = PupilConfig {
        eyes,
        rate: parse_rate(&arguments.rate)?,
        latency_ns: ns(arguments.latency_ms),
        noise_rad: arguments.noise_deg.to_radians(),
        confidence: arguments.confidence,
        clock_offset_s: arguments.clock_offset_s,
        clock_ppm: arguments.clock_ppm,
        mapping,
        faults: arguments.faults.clone(),
    };
    let address = SocketAddrV4::new(arguments.bind, arguments.port);
    let host = PupilHost::start(config, address, clock_from_now())
        .map_err(|e| super::cannot_serve("Pupil", address, &e, "--port"))?;
    say(format_args!("Pupil Remote on {}; in the rig file:", host.address()));
    say(format_args!(
        "[observer]\ngaze = {{ kind = \"pupil\", address = \"{}\", port = {} }}",
        arguments.bind,
        host.address().port()
    ));
    let started = Instant::now();
    while host.is_running() {
        if arguments.seconds.is_some_and(|s| started.elapsed().as_secs_f64() >= s) {
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    Err("the network socket failed".into())
}
