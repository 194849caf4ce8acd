//! The sensor's client against the mock's sensor on a pseudo-terminal, and `hil-mock serve sensor-wand` as a program.

use dpm_device::planes::Raster;
use dpm_device::pose::Pose;
use dpm_device::sensor::client::{SensorClient, SensorConfig};
use dpm_device::sensor::wire::Refusal;
use dpm_device::time::{HostClock, HostTime};
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
            "--seconds",
            "20",
        ])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines().map_while(Result::ok);
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
        (["--lens", "1,2"], "5 numbers"),
        (["--aperture-mm", "0"], "`aperture_m`"),
        (["--motion", "{}"], "--motion"),
        (["--focal", "0"], "--focal 0"),
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
