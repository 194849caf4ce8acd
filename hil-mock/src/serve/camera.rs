//! `hil-mock serve camera`: a camera before bodies with printed tags.

use super::bodies::{clock_from_now, parse_body, parse_rate};
use super::say;
use clap::Args;
use dpm_device::pose::Pose;
use dpm_device::time::HostClock;
use hil_mock::camera::{
    two_tags, BoardHold, CameraHost, CameraOptics, MarkedBody, MockCamera, MockCameraConfig,
};
use hil_mock::faults::FaultPlan;
use std::error::Error;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// The bodies of the scene that a rig file without one has, moved so that their tags stay in view.
const HELD: [&str; 2] = [
    r#"bunny@0,0,0={"kind":"translate","speed_m_s":0.3,"amplitude_m":0.1,"acceleration_m_s2":3}"#,
    r#"venus@0.3,0,0={"kind":"sway","axis":[0,1,0],"peak_rate_rad_s":1,"peak_acceleration_rad_s2":4}"#,
];

/// Arguments of `hil-mock serve camera`.
#[derive(Args)]
pub(crate) struct CameraArguments {
    /// Address to serve on
    #[arg(long, default_value = "127.0.0.1")]
    bind: Ipv4Addr,
    /// TCP port
    #[arg(long, default_value_t = 8951)]
    port: u16,
    /// Body as NAME[@X,Y,Z][=MOTION], metres, with two tags of 80 mm; as of the other trackers. May be repeated
    #[arg(long = "body", value_name = "BODY", default_values = HELD)]
    bodies: Vec<String>,
    /// Place of the camera, which looks along -Z: X,Y,Z in metres
    #[arg(long, default_value = "0.15,0,1.2")]
    place: String,
    /// Another camera on the next port: X,Y,Z in metres and its turn to the left in degrees. May be repeated
    #[arg(long = "other", value_name = "X,Y,Z,DEG", allow_hyphen_values = true, conflicts_with = "board")]
    others: Vec<String>,
    /// Columns and rows, as 1280x800
    #[arg(long, default_value = "1280x800")]
    size: String,
    /// Horizontal angle of view, degrees
    #[arg(long, default_value_t = 60.0)]
    view_deg: f64,
    /// Pictures per second, as a number or fraction
    #[arg(long, default_value = "60")]
    rate: String,
    /// Exposure of each row, milliseconds
    #[arg(long, default_value_t = 2.0)]
    exposure_ms: f64,
    /// By how much later each row is exposed than the one above it, microseconds; 0 is a global shutter
    #[arg(long, default_value_t = 0.0)]
    row_us: f64,
    /// From the end of the exposure to the arrival, milliseconds
    #[arg(long, default_value_t = 4.0)]
    latency_ms: f64,
    /// How far the lens spreads the light of a point: standard deviation along each axis, pixels
    #[arg(long, default_value_t = 0.5)]
    softness_px: f64,
    /// Noise of reading, grey levels
    #[arg(long, default_value_t = 1.5)]
    noise: f64,
    /// In place of bodies: hold the printed board of `dpm calibrate camera`, at one drawn place after another
    #[arg(long, conflicts_with = "bodies")]
    board: bool,
    /// By how far the ends of the board lie before its middle, millimetres
    #[arg(long, default_value_t = 0.0, allow_hyphen_values = true)]
    bend_mm: f64,
    /// The largest tilt of the board, degrees
    #[arg(long, default_value_t = 40.0)]
    tilt_deg: f64,
    /// Draw focal lengths, centre and lens by this seed, and print them, in place of --view-deg
    #[arg(long, value_name = "SEED")]
    drawn_lens: Option<u64>,
    /// Shapes in the background, some of which look like tags
    #[arg(long, default_value_t = 40)]
    clutter: u32,
    /// What goes wrong: loss, dropout, stuck, slow and stall, for example `loss=0.01,dropout@5s+20ms/10s`
    #[arg(long, default_value = "")]
    faults: FaultPlan,
    /// Seed of noise, clutter and faults
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Stop after this many seconds
    #[arg(long, value_parser = super::seconds)]
    seconds: Option<f64>,
}

/// Numbers with a mark between them.
pub(super) fn numbers<T: std::str::FromStr, const N: usize>(
    text: &str,
    mark: char,
    what: &str,
) -> Result<[T; N], String> {
    let all: Vec<T> = text.split(mark).filter_map(|n| n.trim().parse().ok()).collect();
    all.try_into().map_err(|_| format!("`{text}` is not {what}"))
}

/// Serves until the time is over or the socket fails.
pub(super) fn run(arguments: &CameraArguments) -> Result<(), Box<dyn Error>> {
    let size = numbers(&arguments.size, 'x', "columns and rows such as 1280x800")?;
    let place: [f64; 3] = numbers(&arguments.place, ',', "three numbers X,Y,Z in metres")?;
    let optics = match arguments.drawn_lens {
        Some(seed) => CameraOptics::drawn(size, seed),
        None => CameraOptics::pinhole(size, arguments.view_deg),
    };
    let config = MockCameraConfig {
        optics,
        pose: Pose { position_m: place, ..Pose::IDENTITY },
        rate: parse_rate(&arguments.rate)?,
        exposure_ns: (arguments.exposure_ms * 1e6) as i64,
        row_ns: (arguments.row_us * 1e3) as i64,
        latency_ns: (arguments.latency_ms * 1e6) as i64,
        softness_px: arguments.softness_px,
        read_noise: arguments.noise,
        clutter: arguments.clutter,
        seed: arguments.seed,
        faults: arguments.faults.clone(),
        ..MockCameraConfig::default()
    };
    let (mut bodies, mut tags) = (Vec::new(), Vec::new());
    if arguments.board {
        let hold = BoardHold {
            bend_m: 1e-3 * arguments.bend_mm,
            tilt: arguments.tilt_deg.to_radians(),
            seed: arguments.seed,
            ..BoardHold::default()
        };
        bodies.push(hold.body(&config)?);
    } else {
        for (n, text) in arguments.bodies.iter().enumerate() {
            let (name, motion) = parse_body(text)?;
            let own = two_tags(n);
            tags.extend(own.map(|tag| tag.as_toml(&name)));
            bodies.push(MarkedBody { motion, tags: own.to_vec(), markers: vec![] });
        }
    }
    let clock = clock_from_now();
    let others = serve_others(arguments, &config, &bodies, &clock)?;
    let true_lens = arguments.drawn_lens.map(|_| config.optics.clone());
    let address = SocketAddrV4::new(arguments.bind, arguments.port);
    let host = CameraHost::start(MockCamera::new(config, bodies)?, address, clock)
        .map_err(|e| super::cannot_serve("a camera", address, &e, "--port"))?;
    say(format_args!("camera on {}; in the rig file:", host.address()));
    say(format_args!("[tracker]\nkind = \"camera\"\ndevice = \"tcp:{}\"", host.address()));
    say(format_args!("size = {size:?}\ntransform = {{ position = {place:?} }}"));
    match true_lens {
        // A comment: a calibration is to find it.
        Some(o) => {
            say(format_args!("# truth: focal {:?}, centre {:?}, lens {:?}", o.focal, o.centre, o.lens))
        }
        None => say(format_args!("view_deg = {:?}", arguments.view_deg)),
    }
    say_others(&others);
    if !tags.is_empty() {
        say(format_args!("tags = [\n  {},\n]", tags.join(",\n  ")));
    }
    let started = Instant::now();
    while host.is_running() {
        if arguments.seconds.is_some_and(|s| started.elapsed().as_secs_f64() >= s) {
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    Err("the network socket failed".into())
}

/// Serves the further cameras on the ports after the first one's, of one clock; each with its entry of `tracker.others`.
fn serve_others(
    arguments: &CameraArguments,
    first: &MockCameraConfig,
    bodies: &[MarkedBody],
    clock: &Arc<dyn HostClock>,
) -> Result<Vec<(CameraHost, String)>, Box<dyn Error>> {
    let mut hosts = Vec::new();
    for (n, text) in (1u16..).zip(&arguments.others) {
        let [x, y, z, degrees]: [f64; 4] = numbers(text, ',', "three numbers in metres and one in degrees")?;
        let (sin, cos) = (0.5 * degrees.to_radians()).sin_cos();
        let pose = Pose { position_m: [x, y, z], rotation_xyzw: [0.0, sin, 0.0, cos] };
        let config = MockCameraConfig { pose, seed: first.seed + u64::from(n), ..first.clone() };
        let port = if arguments.port == 0 { 0 } else { arguments.port.wrapping_add(n) };
        let address = SocketAddrV4::new(arguments.bind, port);
        let host = CameraHost::start(MockCamera::new(config, bodies.to_vec())?, address, clock.clone())
            .map_err(|e| super::cannot_serve("a camera", address, &e, "--port"))?;
        let place: [f64; 3] = std::array::from_fn(|i| [x, y, z][i] - first.pose.position_m[i]);
        let entry = format!(
            "{{ device = \"tcp:{}\", position = {place:?}, rotation_deg = [0, {degrees:?}, 0], view_deg = {:?} }}",
            host.address(),
            arguments.view_deg
        );
        hosts.push((host, entry));
    }
    Ok(hosts)
}

fn say_others(others: &[(CameraHost, String)]) {
    if !others.is_empty() {
        let entries: Vec<&str> = others.iter().map(|(_, entry)| &**entry).collect();
        say(format_args!("others = [\n  {},\n]", entries.join(",\n  ")));
    }
}
