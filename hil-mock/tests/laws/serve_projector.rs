//! `hil-mock serve projector` as a process of its own: it lives between packets, and says when its light changes.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use dpm_device::link::{
    packet_bytes, Codec, DeviceState, Epoch, HostLink, LightLimits, LinkSettings, LinkState, SendOutcome,
    Underrun, Verb, COMMIT_BYTES,
};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::{DeviceTicks, FrameRate, HostTime};
use dpm_device::transport::serial::{SerialSettings, SerialTransport};
use dpm_device::transport::Transport;
use hil_mock::monotonic;

const WATCHDOG_MS: i64 = 1500;

/// The process, which ends with the test.
struct ServingProcess {
    child: Child,
    folder: PathBuf,
    port: String,
}

impl ServingProcess {
    fn start(name: &str) -> Self {
        let folder = std::env::temp_dir().join(format!("dpm-serve-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let mut child = Command::new(env!("CARGO_BIN_EXE_hil-mock"))
            .args(["serve", "projector", "--port", "pty", "--raster", "32x16", "--seconds", "120"])
            .arg("--light-log")
            .arg(folder.join("log"))
            .arg("--light")
            .arg(folder.join("light.ppm"))
            .stdout(Stdio::piped())
            .spawn()
            .expect("the mock starts");
        let mut line = String::new();
        BufReader::new(child.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
        let port = line.trim().rsplit(' ').next().unwrap().to_owned();
        Self { child, folder, port }
    }

    fn log(&self) -> Vec<(i64, String)> {
        let text = std::fs::read_to_string(self.folder.join("log")).unwrap_or_default();
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        whole
            .lines()
            .map(|line| line.split_once(' ').expect("an instant and what it is"))
            .map(|(at, what)| (at.parse().expect("nanoseconds"), what.to_owned()))
            .collect()
    }

    /// Waits until the log ends with `what`; returns when that was.
    fn until(&self, what: &str) -> i64 {
        let start = Instant::now();
        loop {
            if let Some((at, _)) = self.log().last().filter(|(_, last)| last.starts_with(what)) {
                return *at;
            }
            assert!(start.elapsed() < Duration::from_secs(30), "no {what:?} in {:?}", self.log());
            std::thread::sleep(Duration::from_millis(2));
        }
    }
}

impl Drop for ServingProcess {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

fn now() -> HostTime {
    HostTime(monotonic::now_ns())
}

struct Host {
    link: HostLink,
    line: SerialTransport,
    id: u64,
    /// The newest frame's end on the device's clock.
    dark_from: DeviceTicks,
}

impl Host {
    fn new(port: &str) -> Self {
        let raster = Raster::new(32, 16).unwrap();
        let frame_bytes = packet_bytes(raster.plane_bytes()) * 8 + packet_bytes(COMMIT_BYTES);
        let settings = SerialSettings { path: port.into(), baud: 3_000_000, frame_bytes };
        let mut line = SerialTransport::open(settings).expect("the pseudo-terminal opens");
        line.set_clock(Arc::new(now));
        let mut link = HostLink::new(LinkSettings {
            raster,
            schedule: PlaneSchedule::mono8(),
            rate: FrameRate::new(60, 1).unwrap(),
            watchdog_us: WATCHDOG_MS as u32 * 1000,
            underrun: Underrun::Repeat,
            late_slots: 255,
            epoch: Epoch::AfterHello(1_000_000),
            codecs: Codec::Raw.mask(),
            flash_limit: None,
            limits: LightLimits::OFF,
        });
        link.connect();
        Self { link, line, id: 1, dark_from: DeviceTicks(0) }
    }

    /// Streams until `frames` are lit, arming whenever that is needed.
    fn stream(&mut self, frames: u32) {
        let start = Instant::now();
        while self.link.status().is_none_or(|s| s.frames_lit < frames || s.state != DeviceState::Armed) {
            match self.link.poll(now(), &mut self.line).expect("the line holds") {
                LinkState::Ready => self.link.arm(0),
                LinkState::Faulted => self.link.arm(u32::MAX),
                LinkState::Streaming => {
                    let slots = self.link.slots().unwrap();
                    let device = self.link.status().unwrap().now;
                    let slot = slots.slot_at(device).map_or(1, |k| k + 1);
                    let planes = vec![0xf0; 8 * 32 / 8 * 16];
                    // Half a second: a busy machine may hold this thread up.
                    let dark_from = slots.dark_from(slot, 500_000_000);
                    let (id, target) = (self.id, slots.start(slot));
                    let line = &mut self.line;
                    let sent = self.link.send_frame(now(), id, target, dark_from, &planes, line);
                    if sent == SendOutcome::Sent {
                        self.dark_from = dark_from;
                        self.id += 1;
                    }
                }
                _ => {}
            }
            assert!(start.elapsed() < Duration::from_secs(30), "{:?}", self.link.status());
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

/// The mean of a PPM file's bytes.
fn brightness(path: &Path) -> f64 {
    let bytes = std::fs::read(path).unwrap_or_default();
    let pixels = &bytes[bytes.len().min(13)..];
    pixels.iter().map(|&b| f64::from(b)).sum::<f64>() / pixels.len().max(1) as f64
}

/// Found in use, R16: after the host was killed its status and picture went on saying that it was lit, until the next packet came.
/// R1: the last frame ends by itself; R3: the next connection lights at once.
#[test]
fn a_projector_that_hears_nothing_lives_on_and_the_next_host_lights() {
    let served = ServingProcess::start("alone");
    for round in 0..3 {
        let mut host = Host::new(&served.port);
        let begun = Instant::now();
        host.stream(30);
        assert!(begun.elapsed() < Duration::from_secs(10), "round {round}: {:?}", begun.elapsed());
        let lit_at = served.log().iter().rev().find(|(_, what)| what.starts_with("lit")).expect("lit").0;
        // Killed: not a byte more.
        let killed_at = monotonic::now_ns();
        let dark_from = host.dark_from;
        // What the device's clock says of the host's, from the shortest exchange.
        let mut best = None;
        host.link.take_echoes(|e| {
            let round_trip = e.host_received_at.ns_since(e.host_sent_at);
            let offset = e.host_sent_at.0 + round_trip / 2 - e.device_received_at.0 as i64;
            best = Some(best.map_or((round_trip, offset), |b: (i64, i64)| b.min((round_trip, offset))));
        });
        let (round_trip, offset) = best.expect("echoes");
        drop(host);
        let dark_at = served.until("dark faulted: watchdog");
        assert!(lit_at < killed_at && killed_at < dark_at);
        let late = dark_at - killed_at - WATCHDOG_MS * 1_000_000;
        assert!((-100_000_000..100_000_000).contains(&late), "the watchdog bit {late} ns late");
        // Before it, the frame's own end: at its tick, to what the exchange of clocks is good for.
        let log = served.log();
        let (ended_at, what) = &log[log.len() - 2];
        assert_eq!(what, "dark armed", "{log:?}");
        let error = ended_at - (dark_from.0 as i64 + offset);
        assert!(error.abs() <= round_trip + 1_000_000, "{error} ns off, round trip {round_trip} ns");
        let start = Instant::now();
        while brightness(&served.folder.join("light.ppm")) > 0.0 {
            assert!(start.elapsed() < Duration::from_secs(10), "the picture still shows light");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

/// Found in use, R2: the log is good for measuring, from outside, how long after an order it is dark.
#[test]
fn the_log_says_when_an_order_has_made_it_dark() {
    let served = ServingProcess::start("order");
    let mut host = Host::new(&served.port);
    for (verb, state) in [
        (Verb::Black, "dark black"),
        (Verb::Stop, "dark configured"),
        (Verb::Safe, "dark faulted: host safe"),
    ] {
        let before = host.link.status().map_or(0, |s| s.frames_lit);
        host.link.arm(u32::MAX);
        host.stream(before + 20);
        let ordered_at = monotonic::now_ns();
        host.link.command(now(), verb, &mut host.line).unwrap();
        let start = Instant::now();
        while served.log().last().is_none_or(|(_, last)| last != state) {
            let _ = host.link.poll(now(), &mut host.line);
            assert!(start.elapsed() < Duration::from_secs(30), "{:?}", served.log());
            std::thread::sleep(Duration::from_millis(1));
        }
        let dark_ms = (served.log().last().unwrap().0 - ordered_at) as f64 * 1e-6;
        println!("{verb:?}: dark after {dark_ms:.2} ms");
        assert!((0.0..50.0).contains(&dark_ms), "{verb:?}: dark after {dark_ms} ms");
    }
}
