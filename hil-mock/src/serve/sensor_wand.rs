//! `hil-mock serve sensor-wand`: a projector, a tracked wand with a light sensor in its beam, and the wand's tracker.

use super::orders::Orders;
use super::projector::{run_beside, Beside, ProjectorArguments};
use super::{cannot_open, cannot_serve, say};
use clap::Args;
use dpm_device::pose::Pose;
use dpm_device::time::{FrameRate, HostClock, HostTime};
use dpm_device::tracker::BodyIndex;
use hil_mock::hand::Hand;
use hil_mock::motion::{Motion, MotionSpec};
use hil_mock::natnet_host::NatNetHost;
use hil_mock::natnet_server::{NatNetServer, NatNetServerConfig};
use hil_mock::projector::Shown;
use hil_mock::sensor_wand::line::{SampleQueue, SensorLine};
use hil_mock::sensor_wand::{ProjectorOptics, SensorWand, SensorWandConfig};
use hil_mock::serial_server::pseudo_terminal;
use hil_mock::tracker::{MockTrackerConfig, SampleSource};
use hil_mock::usb_plug::{monotonic_clock, Clock};
use std::collections::VecDeque;
use std::error::Error;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;

/// Lit slots that may wait for the wand: a frame of 1024 x 768 has 2.4 MB.
const SHOWN_KEPT: usize = 64;
/// The wand's name in the tracker.
const WAND: &str = "wand";
/// The motion of a hand that wanders through the beam.
const WANDER: &str = r#"{"kind":"together","parts":[
    {"kind":"sinusoid","direction":[1,0,0],"peak_speed_m_s":0.5,"peak_acceleration_m_s2":0.86},
    {"kind":"sinusoid","direction":[0,1,0],"peak_speed_m_s":0.37,"peak_acceleration_m_s2":0.67},
    {"kind":"sinusoid","direction":[0,0,1],"peak_speed_m_s":0.24,"peak_acceleration_m_s2":0.43},
    {"kind":"sway","axis":[1,0.2,0],"peak_rate_rad_s":0.8,"peak_acceleration_rad_s2":2.1},
    {"kind":"sway","axis":[0,1,0.3],"peak_rate_rad_s":0.7,"peak_acceleration_rad_s2":1.7}]}"#;

/// Arguments of `hil-mock serve sensor-wand`. --port and what follows belongs to the projector.
#[derive(Args)]
pub(crate) struct SensorWandArguments {
    /// Serial port of the sensor; without it a pseudo-terminal is made and its path printed
    #[arg(long, value_name = "PORT")]
    sensor_port: Option<String>,
    /// Bits per second of the sensor's port
    #[arg(long, default_value_t = 3_000_000)]
    sensor_baud: u32,
    /// Motion of the wand: a JSON object as in a rig file; default: a hand that wanders through the beam
    #[arg(long, value_name = "MOTION")]
    motion: Option<String>,
    /// Move the wand by orders from the standard input, one a line; it moves by --motion until the first one
    #[arg(long)]
    orders: bool,
    /// Place about which the wand moves, metres
    #[arg(long, value_name = "X,Y,Z", default_value = "0,0,0", value_parser = three, allow_hyphen_values = true)]
    wand_at: [f64; 3],
    /// The sensor in the space of the wand's body, metres; it looks along +z
    #[arg(long, value_name = "X,Y,Z", default_value = "0.01,-0.005,0.12", value_parser = three, allow_hyphen_values = true)]
    tip: [f64; 3],
    /// A body that the tracker reports beside the wand, at rest, as NAME:X,Y,Z in metres; may be repeated
    #[arg(long = "body", value_name = "NAME:X,Y,Z", value_parser = body, allow_hyphen_values = true)]
    bodies: Vec<(String, [f64; 3])>,
    /// Place of the projector, which looks along -z, metres
    #[arg(long, value_name = "X,Y,Z", default_value = "0,0,1.4", value_parser = three, allow_hyphen_values = true)]
    projector_at: [f64; 3],
    /// Focal length of the projector, pixels
    #[arg(long, value_name = "PX", default_value_t = 1800.0)]
    focal: f64,
    /// Coefficients of its lens as OpenCV has them: k1,k2,p1,p2,k3, and k4,k5,k6 of the rational model if it has them
    #[arg(long, value_name = "K", default_value = "-0.06,0.02,0.0005,-0.0003,0", value_parser = lens, allow_hyphen_values = true)]
    lens: [f64; 8],
    /// Diameter of the sensor's aperture, millimetres
    #[arg(long, default_value_t = 3.0)]
    aperture_mm: f64,
    /// Bandwidth of its amplifier, hertz
    #[arg(long, default_value_t = 150e3)]
    bandwidth_hz: f64,
    /// Its samples a second
    #[arg(long, default_value_t = 100_000)]
    samples: u32,
    /// How much faster its clock runs than it says, parts per million
    #[arg(long, default_value_t = 20.0, allow_hyphen_values = true)]
    clock_ppm: f64,
    /// Noise of a sample as a share of the converter's range
    #[arg(long, default_value_t = 0.0033)]
    noise: f64,
    /// Share of the converter's range that full white fills at 1 m, at the first gain
    #[arg(long, default_value_t = 10.52)]
    responsivity: f64,
    /// Share of its light that the projector's LED loses in planes of bit 7; half as much for each lower bit
    #[arg(long, default_value_t = 0.0)]
    droop: f64,
    /// Show each pixel's code value for the whole frame, as a display does, in place of planes one after the other
    #[arg(long)]
    held: bool,
    /// How much later its light falls than the projector reports, as a display's does, milliseconds
    #[arg(long, default_value_t = 0.0)]
    light_lag_ms: f64,
    /// Light of the room as a share of the converter's range
    #[arg(long, default_value_t = 0.05)]
    ambient: f64,
    /// Its flicker at 100 Hz as a share of it
    #[arg(long, default_value_t = 0.3)]
    flicker: f64,
    /// Share of the time in which something stands in the beam
    #[arg(long, default_value_t = 0.0)]
    obstructed: f64,
    /// Noise of the tracker's positions on each axis, metres
    #[arg(long, default_value_t = 1e-4)]
    tracker_noise_m: f64,
    /// Noise of its rotations about each axis, radians
    #[arg(long, default_value_t = 8.7e-4)]
    tracker_noise_rad: f64,
    /// Its samples a second
    #[arg(long, default_value_t = 240)]
    tracker_rate: u32,
    /// From capture to sending, milliseconds
    #[arg(long, default_value_t = 4.0)]
    tracker_latency_ms: f64,
    /// UDP port for NatNet's commands on 127.0.0.1; its data port is the next one
    #[arg(long, default_value_t = 1510)]
    command_port: u16,
    /// Seed of all noise
    #[arg(long, default_value_t = 1)]
    seed: u64,
    #[command(flatten)]
    projector: ProjectorArguments,
}

fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let all: Result<Vec<f64>, _> = text.split(',').map(|n| n.trim().parse::<f64>()).collect();
    let all = all.ok().and_then(|n| <[f64; N]>::try_from(n).ok()).filter(|n| n.iter().all(|v| v.is_finite()));
    all.ok_or_else(|| format!("write {N} numbers with commas between them"))
}

fn three(text: &str) -> Result<[f64; 3], String> {
    numbers(text)
}

fn lens(text: &str) -> Result<[f64; 8], String> {
    let brown = numbers::<5>(text).map(|[k1, k2, p1, p2, k3]| [k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]);
    brown.or_else(|_| numbers(text)).map_err(|_| "write 5 or 8 numbers with commas between them".into())
}

fn body(text: &str) -> Result<(String, [f64; 3]), String> {
    let (name, place) = text.rsplit_once(':').ok_or("write NAME:X,Y,Z")?;
    match name {
        "" => Err("the body needs a name".into()),
        WAND => Err(format!("\"{WAND}\" is the wand's own name")),
        _ => Ok((name.to_owned(), three(place)?)),
    }
}

impl SensorWandArguments {
    fn motion(&self) -> Result<Motion, Box<dyn Error>> {
        let spec: MotionSpec = serde_json::from_str(self.motion.as_deref().unwrap_or(WANDER))
            .map_err(|e| format!("--motion: {e}"))?;
        Ok(Motion::new(&spec, Pose { position_m: self.wand_at, ..Pose::IDENTITY })?)
    }

    fn optics(&self) -> Result<ProjectorOptics, Box<dyn Error>> {
        let raster = self.projector.raster();
        if !(self.focal > 1.0 && self.focal < 1e6) {
            return Err(format!("--focal {}: must be above 1 and below 1e6 px", self.focal).into());
        }
        let straight =
            ProjectorOptics::along_z(self.projector_at, self.focal, raster.width(), raster.height());
        let [k1, k2, p1, p2, k3, k4, k5, k6] = self.lens;
        Ok(ProjectorOptics { brown: [k1, k2, p1, p2, k3], quotient: [k4, k5, k6], ..straight })
    }

    fn wand(&self, motion: Motion) -> Result<SensorWand, Box<dyn Error>> {
        let config = SensorWandConfig {
            seed: self.seed,
            tip_m: self.tip,
            aperture_m: self.aperture_mm * 1e-3,
            bandwidth_hz: self.bandwidth_hz,
            samples_per_second: self.samples,
            clock_ppm: self.clock_ppm,
            noise: self.noise,
            responsivity: self.responsivity,
            droop: self.droop,
            is_held: self.held,
            ambient: self.ambient,
            flicker: self.flicker,
            obstructed: self.obstructed,
            ..SensorWandConfig::new(self.optics()?)
        };
        Ok(SensorWand::new(config, motion, self.projector.raster())?)
    }

    fn tracker(
        &self,
        motion: Motion,
        hand: Option<Arc<Hand>>,
        clock: Arc<dyn HostClock>,
    ) -> Result<NatNetHost, Box<dyn Error>> {
        let rate = FrameRate::new(self.tracker_rate, 1).ok_or("--tracker-rate: must be above 0")?;
        let config = MockTrackerConfig {
            seed: self.seed,
            rate,
            position_noise_m: self.tracker_noise_m,
            rotation_noise_rad: self.tracker_noise_rad,
            latency_ns: (self.tracker_latency_ms * 1e6) as i64,
            ..Default::default()
        };
        let (mut names, mut motions) = (vec![WAND], vec![motion]);
        for (name, position_m) in &self.bodies {
            names.push(name);
            motions.push(Motion::still(Pose { position_m: *position_m, ..Pose::IDENTITY })?);
        }
        let mut source = SampleSource::new(config, motions)?;
        if let Some(hand) = hand {
            source = source.held_by(BodyIndex(0), hand);
        }
        let data_port = self.command_port.checked_add(1).ok_or("--command-port: at most 65534")?;
        let config = NatNetServerConfig { data_port, ..NatNetServerConfig::new(&names) };
        let streaming = config.streaming;
        let address = SocketAddrV4::new(Ipv4Addr::LOCALHOST, self.command_port);
        let host = NatNetHost::start(NatNetServer::new(config, source)?, streaming, address, clock)
            .map_err(|e| cannot_serve("NatNet", address, &e, "--command-port"))?;
        let bodies: Vec<String> =
            names.iter().enumerate().map(|(i, name)| format!("body {}: {name}", i + 1)).collect();
        let bodies = bodies.join(", ");
        say(format_args!("NatNet on {}, data port {data_port}, {bodies}", host.address()));
        Ok(host)
    }
}

/// The wand beside the projector.
struct Wand {
    wand: SensorWand,
    queue: Arc<SampleQueue>,
    line: SensorLine,
    tracker: NatNetHost,
    path: String,
    clock: Clock,
    orders: Option<Orders>,
    lag_ns: i64,
    /// Light that has not fallen yet.
    coming: VecDeque<Shown>,
}

impl Wand {
    /// Of the light that is reported up to an instant: what has fallen by then, and up to when.
    fn fallen(&mut self, shown: &[Shown], until: HostTime) -> (Vec<Shown>, HostTime) {
        if self.lag_ns == 0 {
            return (shown.to_vec(), until);
        }
        let later = |at: HostTime| at.plus_ns(self.lag_ns);
        self.coming.extend(shown.iter().map(|shown| {
            let mut shown = shown.clone();
            shown.event.first_photon_at = later(shown.event.first_photon_at);
            shown.event.last_photon_at = later(shown.event.last_photon_at);
            shown.planes_end_at = later(shown.planes_end_at);
            shown
        }));
        let whole = self.coming.partition_point(|shown| shown.planes_end_at <= until);
        let fallen = self.coming.drain(..whole).collect();
        // The next one may have begun.
        let dark_until = self.coming.front().map_or(until, |next| until.min(next.event.first_photon_at));
        (fallen, dark_until)
    }
}

impl Beside for Wand {
    fn see(&mut self, shown: Vec<Shown>, until: HostTime) -> Result<(), Box<dyn Error>> {
        if !self.line.is_running() {
            return Err(format!("{} failed: unplugged? Check cable and adapter", self.path).into());
        }
        if !self.tracker.is_running() {
            return Err("the NatNet server's socket failed".into());
        }
        let (fallen, until) = self.fallen(&shown, until);
        self.queue.fill(&mut self.wand, |wand, sink| {
            fallen.iter().for_each(|shown| wand.shine(shown, sink));
            wand.dark(until, sink);
        });
        if let Some(orders) = &mut self.orders {
            orders.follow(&shown, (self.clock)());
        }
        Ok(())
    }
}

/// Serves until the time is over or a port fails.
pub(super) fn run(arguments: &SensorWandArguments) -> Result<(), Box<dyn Error>> {
    let clock: Clock = monotonic_clock();
    let host_clock: Arc<dyn HostClock> = {
        let clock = clock.clone();
        Arc::new(move || clock())
    };
    let motion = arguments.motion()?;
    let mut wand = arguments.wand(motion.clone())?;
    let hand = arguments.orders.then(|| Arc::new(Hand::new(motion.clone(), arguments.tip)));
    if let Some(hand) = &hand {
        wand = wand.held_by(hand.clone());
    }
    let tracker = arguments.tracker(motion, hand.clone(), host_clock.clone())?;
    let (port, path, _other_end) = match &arguments.sensor_port {
        Some(path) => {
            let port = dpm_device::tty::open(path, arguments.sensor_baud);
            (port.map_err(|e| cannot_open(path, &e))?, path.clone(), None)
        }
        None => {
            let (port, path, other_end) = pseudo_terminal()?;
            (port, path, Some(other_end))
        }
    };
    let queue = Arc::new(SampleQueue::default());
    let line = SensorLine::start(&wand, queue.clone(), port, host_clock)?;
    say(format_args!("light sensor on {path}"));
    say(format_args!("its --gain 0 to 5 amplify 1, 2, 4, 8, 16, 32 times, 6 by 0.3 for full white"));
    let start = |hand| {
        let (optics, width) = (arguments.optics()?, arguments.projector.raster().width());
        Orders::start(hand, optics, width, arguments.bodies.clone()).map_err(Box::<dyn Error>::from)
    };
    let orders = hand.map(start).transpose()?;
    if !(0.0..=1000.0).contains(&arguments.light_lag_ms) {
        return Err(format!("--light-lag-ms {}: must be 0 to 1000", arguments.light_lag_ms).into());
    }
    let lag_ns = (1e6 * arguments.light_lag_ms) as i64;
    let mut beside = Wand {
        wand,
        queue,
        line,
        tracker,
        path,
        clock: clock.clone(),
        orders,
        lag_ns,
        coming: VecDeque::new(),
    };
    run_beside(&arguments.projector, SHOWN_KEPT, clock, &mut beside)
}
