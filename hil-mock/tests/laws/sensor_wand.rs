//! The sensor's client against the mock's sensor on a pseudo-terminal, and `hil-mock serve sensor-wand` as a program.

use dpm_device::link::{
    packet_bytes, Codec, Epoch, HostLink, LightLimits, LinkSettings, LinkState, SendOutcome, Underrun,
    COMMIT_BYTES,
};
use dpm_device::planes::PlaneSchedule;
use dpm_device::planes::Raster;
use dpm_device::pose::Pose;
use dpm_device::sensor::client::{SensorClient, SensorConfig};
use dpm_device::sensor::wire::Refusal;
use dpm_device::time::FrameRate;
use dpm_device::time::{HostClock, HostTime};
use dpm_device::transport::serial::{SerialSettings, SerialTransport};
use dpm_device::transport::Transport;
use hil_mock::motion::Motion;
use hil_mock::sensor_wand::line::{SampleQueue, SensorLine};
use hil_mock::sensor_wand::{ProjectorOptics, SensorWand, SensorWandConfig};
use hil_mock::serial_server::pseudo_terminal;
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

fn clock() -> Arc<dyn HostClock> {
    let epoch = Instant::now();
    Arc::new(move || HostTime(epoch.elapsed().as_nanos() as i64))
}

fn config(port: &str) -> SensorConfig {
    SensorConfig { port: port.into(), baud: 3_000_000, gain: 1, block: 128, samples_per_second: 0 }
}

fn wand() -> SensorWand {
    let optics = ProjectorOptics::along_z([0.0, 0.0, 1.4], 1800.0, 64, 48);
    let motion = Motion::still(Pose::IDENTITY).unwrap();
    let config = SensorWandConfig { noise: 0.0, flicker: 0.0, ambient: 0.1, ..SensorWandConfig::new(optics) };
    SensorWand::new(config, motion, Raster::new(64, 48).unwrap()).unwrap()
}

#[test]
fn every_sample_comes_in_order_or_is_counted_and_its_time_is_known() {
    let clock = clock();
    let (port, path, _other_end) = pseudo_terminal().unwrap();
    let (mut light, queue) = (wand(), Arc::new(SampleQueue::default()));
    let truth = light.clone();
    let line = SensorLine::start(&light, queue.clone(), port, clock.clone()).unwrap();
    let mut client = SensorClient::open(config(&path), clock.clone()).unwrap();
    let (mut next, mut blocks, mut worst_ns) = (None::<u64>, 0u64, 0);
    let end = Instant::now() + Duration::from_secs(20);
    while blocks < 2000 && Instant::now() < end {
        let now = clock.now();
        queue.fill(&mut light, |wand, sink| wand.dark(now, sink));
        let mut heads = Vec::new();
        client.poll(clock.now(), &mut |block| {
            assert!(block.head.period == 10 << 16 && block.head.gain == 1 && !block.head.cut_above);
            // Ambient light of a tenth, amplified twice.
            assert!(block.levels.iter().all(|l| l == 819), "{:?}", block.levels.iter().next());
            heads.push((block.head, block.levels.len() as u64, block.missing));
        });
        for (head, samples, missing) in heads {
            if let Some(next) = next.filter(|_| missing == 0) {
                assert_eq!(head.first, next, "block {}", head.sequence);
            }
            next = Some(head.first + 10 * samples);
            blocks += 1;
            if let Some(mapped) = client.sampled_at(&head, 0) {
                let number = (head.first - 1000) / 10;
                let error = mapped.at.0 as f64 - truth.sampled_at_ns(number);
                assert!(error.abs() <= mapped.uncertainty_ns as f64 + 2000.0, "{error} of {mapped:?}");
                worst_ns = worst_ns.max(error.abs() as i64);
            }
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    let c = client.counters();
    assert!(blocks >= 2000 && worst_ns > 0, "{}", client.status());
    assert_eq!((c.lost_on_line, c.malformed, c.stale), (0, 0, 0), "{c:?}");
    assert_eq!(client.hello().unwrap().name_text(), "hil-mock wand");
    // What the sensor does not have.
    client.set_gain(7);
    while client.refusal().is_none() && Instant::now() < end {
        client.poll(clock.now(), &mut |_| ());
        std::thread::sleep(Duration::from_millis(1));
    }
    assert_eq!(client.refusal(), Some(Refusal::Gain));
    assert!(client.status().contains("refuses its settings: Gain") && !client.is_running());
    drop(line);
}

#[test]
fn a_port_that_does_not_exist_and_settings_that_no_sensor_takes_are_named() {
    let clock = clock();
    assert!(SensorClient::open(config(""), clock.clone()).is_err());
    let block = SensorConfig { block: 257, ..config("/dev/null") };
    assert!(SensorClient::open(block, clock.clone()).err().unwrap().contains("a block of 257 samples"));
    let mut client = SensorClient::open(config("/nonexistent/tty"), clock.clone()).unwrap();
    let end = Instant::now() + Duration::from_secs(10);
    while !client.status().contains("cannot open") && Instant::now() < end {
        client.poll(clock.now(), &mut |_| ());
        std::thread::sleep(Duration::from_millis(2));
    }
    assert!(client.status().contains("/nonexistent/tty: "), "{}", client.status());
}

/// The program itself: it names its ports, and its sensor speaks.
#[test]
fn the_program_serves_projector_tracker_and_sensor() {
    let mut child = Command::new(env!("CARGO_BIN_EXE_hil-mock"))
        .args([
            "serve",
            "sensor-wand",
            "--port",
            "pty",
            "--raster",
            "64x48",
            "--command-port",
            "0",
            "--body",
            "hare:-0.1,0,0.25",
            "--seconds",
            "20",
        ])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines().map_while(Result::ok);
    let tracker = lines.find(|l| l.starts_with("NatNet on ")).expect("named");
    assert!(tracker.ends_with("body 1: wand, body 2: hare"), "{tracker}");
    let sensor = lines.find_map(|l| l.strip_prefix("light sensor on ").map(str::to_owned)).expect("named");
    let clock = clock();
    let mut client = SensorClient::open(config(&sensor), clock.clone()).unwrap();
    let end = Instant::now() + Duration::from_secs(15);
    let mut levels = Vec::new();
    while levels.len() < 50_000 && Instant::now() < end {
        client.poll(clock.now(), &mut |block| levels.extend(block.levels.iter()));
        std::thread::sleep(Duration::from_millis(1));
    }
    let status = client.status();
    // The room's light of 0.05, amplified twice, with its flicker and noise.
    let mean = levels.iter().map(|l| f64::from(*l)).sum::<f64>() / levels.len().max(1) as f64;
    let _ = child.kill();
    let _ = child.wait();
    assert!(levels.len() >= 50_000 && (mean / 4095.0 - 0.1).abs() < 0.01, "{mean}: {status}");
    for (arguments, says) in [
        (["--lens", "1,2"], "5 or 8 numbers"),
        (["--aperture-mm", "0"], "`aperture_m`"),
        (["--motion", "{}"], "--motion"),
        (["--focal", "0"], "--focal 0"),
        (["--droop", "2"], "`droop`"),
        (["--body", "hare"], "NAME:X,Y,Z"),
        (["--body", "hare:1,2"], "3 numbers"),
        (["--body", "wand:1,2,3"], "the wand's own name"),
    ] {
        let output = Command::new(env!("CARGO_BIN_EXE_hil-mock"))
            .args(["serve", "sensor-wand", "--seconds", "0", "--command-port", "0"])
            .args(arguments)
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success() && text.contains(says), "{arguments:?}: {text}");
    }
}

/// A host that lights every mirror all the time, over a serial line.
struct Lamp {
    link: HostLink,
    line: SerialTransport,
    id: u64,
    /// The slot of the newest frame.
    last: u64,
}

impl Lamp {
    fn new(port: &str, clock: Arc<dyn HostClock>) -> Self {
        let (raster, schedule) = (Raster::new(64, 48).unwrap(), PlaneSchedule::equal24());
        let frame_bytes = packet_bytes(raster.plane_bytes()) * schedule.len() + packet_bytes(COMMIT_BYTES);
        let settings = SerialSettings { path: port.into(), baud: 3_000_000, frame_bytes };
        let mut line = SerialTransport::open(settings).expect("the pseudo-terminal opens");
        line.set_clock(clock);
        let mut link = HostLink::new(LinkSettings {
            raster,
            schedule,
            rate: FrameRate::new(30, 1).unwrap(),
            watchdog_us: 5_000_000,
            underrun: Underrun::Repeat,
            late_slots: 255,
            epoch: Epoch::AfterHello(1_000_000),
            codecs: Codec::ALL,
            flash_limit: None,
            limits: LightLimits::OFF,
        });
        link.connect();
        Self { link, line, id: 1, last: 0 }
    }

    /// One poll; true while light is asked for.
    fn shine(&mut self, now: HostTime) -> bool {
        match self.link.poll(now, &mut self.line).expect("the line is there") {
            LinkState::Ready => self.link.arm(0),
            LinkState::Faulted => self.link.arm(u32::MAX),
            LinkState::Streaming if self.link.credit() > 0 => {
                let planes = vec![0xff; Raster::new(64, 48).unwrap().plane_bytes() * 24];
                let slots = self.link.slots().unwrap();
                let device = self.link.status().unwrap().now;
                let slot = slots.slot_at(device).map_or(1, |k| k + 1).max(self.last + 1);
                let dark_from = slots.dark_from(slot, 500_000_000);
                let sent =
                    self.link.send_frame(now, self.id, slots.start(slot), dark_from, &planes, &mut self.line);
                if sent == SendOutcome::Sent {
                    (self.id, self.last) = (self.id + 1, slot);
                }
            }
            _ => {}
        }
        self.id > 1
    }
}

/// Found nowhere else: light that a host sends over one serial line comes back as levels over another one, as bright as
/// distance and lens say.
#[test]
fn the_sensor_sees_what_the_projector_of_the_same_process_shows() {
    let arguments = "serve sensor-wand --port pty --raster 64x48 --command-port 0 --seconds 60 --motion {\"kind\":\"still\"}";
    let mut child = Command::new(env!("CARGO_BIN_EXE_hil-mock"))
        .args(arguments.split(' '))
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines().map_while(Result::ok);
    let sensor = lines.find_map(|l| l.strip_prefix("light sensor on ").map(str::to_owned)).expect("named");
    let projector =
        lines.find_map(|l| l.strip_prefix("bit-plane projector on ").map(str::to_owned)).expect("named");
    // What the mock says later must not fill its pipe.
    std::thread::spawn(move || lines.count());
    let clock = clock();
    let mut client = SensorClient::open(config(&sensor), clock.clone()).unwrap();
    let mut lamp = Lamp::new(&projector, clock.clone());
    let end = Instant::now() + Duration::from_secs(40);
    let (mut bright, mut dim) = (Vec::new(), Vec::new());
    while bright.len() < 30_000 && Instant::now() < end {
        let asked = lamp.shine(clock.now());
        client.poll(clock.now(), &mut |block| {
            for level in block.levels.iter() {
                // Between the room's light, which is a tenth of the range at most thirteen hundredths, and the beam's.
                if level > 1000 {
                    bright.push(f64::from(level));
                } else if !asked {
                    dim.push(f64::from(level));
                }
            }
        });
        std::thread::sleep(Duration::from_millis(1));
    }
    let _ = child.kill();
    let _ = child.wait();
    assert!(bright.len() >= 30_000, "{} bright, {}", bright.len(), client.status());
    // The tip is 1.28 m before the projector, and 14.1 and 7.0 pixels from the centre of its raster.
    let (x, y) = (0.01 / 1.28 * 1800.0 / 64.0, 0.005 / 1.28 * 1800.0 / 48.0);
    let flat = 1.0 - 0.15 * 2.0 * (x * x + y * y);
    let wanted = 2.0 * (0.05 + 0.33 * flat / (1.28f64 * 1.28)) * 4095.0;
    let found = bright.iter().sum::<f64>() / bright.len() as f64;
    assert!((found / wanted - 1.0).abs() < 0.02, "{found} {wanted}, dim {}", dim.len());
}
