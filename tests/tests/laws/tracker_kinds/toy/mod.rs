//! A kind of trackers that nobody else knows of: keys, client, mock, decoder and page in this folder.

use dpm_common::keys::read::{Any, Within};
use dpm_common::section;
use dpm_device::pose::Pose;
use dpm_device::time::HostTime;
use dpm_device::tracker::{BodyIndex, BodyKey, SampleGate, Tracker, TrackerError, TrackerSample};
use dpm_rig::trackers::{
    MockScene, MockServer, PoseOrigin, SourceError, TrackerKeys, TrackerKind, TrackerPlace,
    TrackerTransformConfig,
};
use std::io;
use std::net::{Ipv4Addr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

section! {
    /// A toy.
    pub struct ToyConfig {
        /// The UDP port on which it is heard.
        port: u16 = 47_100, "", Within(1, u16::MAX);
        /// Samples per second.
        rate_hz: u32 = 60, "Hz", Within(1, 10_000);
        /// From its coordinates to the world's.
        transform: TrackerTransformConfig = TrackerTransformConfig::default(), "", Any;
    }
}

pub(super) static KIND: TrackerKind = TrackerKind::of::<ToyConfig>(
    "toy",
    "a toy for tests.",
    PoseOrigin::Measured,
    "tests/tests/laws/tracker_kinds/toy/README.md#a-toy-tracker",
    &[("toy_line", any_line)],
    mock,
);

impl TrackerKeys for ToyConfig {
    fn rate_hz(&self) -> Option<u32> {
        Some(self.rate_hz)
    }

    fn frame(&self) -> Option<(&TrackerTransformConfig, i64)> {
        Some((&self.transform, 0))
    }

    fn place(&self) -> String {
        format!("the toy on port {}", self.port)
    }

    fn remedy(&self) -> &'static str {
        "is the toy wound up?"
    }

    fn open(&self, place: TrackerPlace) -> Result<Box<dyn Tracker>, SourceError> {
        let bound = UdpSocket::bind((Ipv4Addr::LOCALHOST, self.port));
        let socket = bound.and_then(|s| s.set_nonblocking(true).map(|()| s));
        let socket = socket.map_err(|e| SourceError::of_key("tracker.port", e))?;
        let gate = SampleGate::new(place.bodies.len());
        Ok(Box::new(Toy { socket, gate, bodies: place.bodies, buffer: [0; 256] }))
    }
}

struct Toy {
    socket: UdpSocket,
    gate: SampleGate,
    bodies: Vec<BodyKey>,
    buffer: [u8; 256],
}

impl Tracker for Toy {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        let mut count = 0;
        for _ in 0..64 {
            let Ok(n) = self.socket.recv(&mut self.buffer) else { break };
            let parsed = sample(&self.buffer[..n], &self.bodies, now);
            if let Some(sample) = parsed.and_then(|sample| self.gate.admit(&sample)) {
                sink(&sample);
                count += 1;
            }
        }
        Ok(count)
    }

    fn name(&self) -> &str {
        "toy"
    }

    fn gate(&self) -> Option<&SampleGate> {
        Some(&self.gate)
    }
}

/// A line into a sample.
fn sample(line: &[u8], bodies: &[BodyKey], received_at: HostTime) -> Option<TrackerSample> {
    let mut parts = std::str::from_utf8(line).ok()?.split('|');
    let name = parts.next()?;
    let [position, rotation] = [parts.next()?, parts.next()?];
    let microseconds: i64 = parts.next()?.parse().ok()?;
    let numbers = |text: &str| text.split(' ').map(|w| w.parse::<f64>().ok()).collect::<Option<Vec<_>>>();
    Some(TrackerSample {
        body: BodyIndex(bodies.iter().position(|body| body.name == name)? as u16),
        pose: Pose {
            position_m: numbers(position)?.try_into().ok()?,
            rotation_xyzw: numbers(rotation)?.try_into().ok()?,
        },
        tracked: true,
        mean_error_m: 0.0,
        covariance: None,
        sequence: 0,
        captured_at: HostTime(microseconds.checked_mul(1000)?),
        received_at,
    })
}

/// A line is read as one of a body that the rig has, or as none.
fn any_line(bytes: &[u8]) {
    let bodies = [BodyKey { name: "hare".into(), id: None }];
    let read = sample(bytes, &bodies, HostTime(0));
    assert!(read.is_none_or(|sample| bytes.starts_with(b"hare|") && sample.body.0 == 0));
}

/// Ends its thread when it is dropped.
struct Running(Arc<AtomicBool>);

impl Drop for Running {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

fn mock(scene: &MockScene) -> io::Result<MockServer> {
    let port = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?.local_addr()?.port();
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
    let (source, names, clock) = (scene.source.clone(), scene.names.clone(), scene.clock.clone());
    let is_over = Arc::new(AtomicBool::new(false));
    let over = is_over.clone();
    std::thread::spawn(move || {
        while !over.load(Ordering::Relaxed) {
            let now = clock.now();
            for (body, name) in (0..).zip(&names) {
                let Some(pose) = source.true_pose(BodyIndex(body), now.0) else { continue };
                let text = |numbers: &[f64]| numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
                let (position, rotation) = (text(&pose.position_m), text(&pose.rotation_xyzw));
                let line = format!("{name}|{position}|{rotation}|{}", now.0 / 1000);
                // Nobody may listen yet.
                let _ = socket.send_to(line.as_bytes(), (Ipv4Addr::LOCALHOST, port));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    });
    Ok(MockServer { keys: vec![("port", port.to_string())], running: Box::new(Running(is_over)) })
}
