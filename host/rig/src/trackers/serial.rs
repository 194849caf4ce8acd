//! `tracker.kind = "serial"`: a tracker on a serial port.

use super::keys::{SourceError, TrackerKeys, TrackerPlace};
use super::kind::{MockScene, MockServer, PoseOrigin, TrackerKind};
use super::transform::TrackerTransformConfig;
use crate::mock::{pseudo_terminal, SerialPoseDevice, SerialPoseHost};
use dpm_common::keys::read::{Any, NotEmpty, Within};
use dpm_common::section;
use dpm_device::cobs::Deframer;
use dpm_device::tracker::serial::client;
use dpm_device::tracker::serial::wire::SerialMessage;
use dpm_device::tracker::Tracker;
use std::io;

section! {
    /// A tracker on a serial port.
    pub struct SerialTrackerConfig {
        /// Device file of the port.
        port: String = "/dev/ttyACM0".into(), "", NotEmpty;
        /// Bits per second on the wire.
        baud: u32 = 921_600, "bit/s", Within(300, 20_000_000);
        /// Samples per second that the device is set to; used for drop-out detection only.
        rate_hz: u32 = 500, "Hz", Within(1, 10_000);
        /// From the tracker's coordinates to the world's.
        transform: TrackerTransformConfig = TrackerTransformConfig::default(), "", Any;
        /// Time by which a sample is older than its time stamp says. `dpm calibrate latency` measures it. Negative if
        /// stamps are too old.
        latency_us: i64 = 0, "us", Within(-200_000, 200_000);
    }
}

pub(super) static KIND: TrackerKind = TrackerKind::of::<SerialTrackerConfig>(
    "serial",
    "COBS packets with CRC on a serial port.",
    PoseOrigin::Measured,
    "docs/TRACKERS.md#serial-pose-stream-version-1",
    &[("serial_pose", any_packet)],
    mock,
);

impl TrackerKeys for SerialTrackerConfig {
    fn rate_hz(&self) -> Option<u32> {
        Some(self.rate_hz)
    }

    fn frame(&self) -> Option<(&TrackerTransformConfig, i64)> {
        Some((&self.transform, self.latency_us))
    }

    fn place(&self) -> String {
        format!("the tracker on {}", self.port)
    }

    fn remedy(&self) -> &'static str {
        "is the device on and plugged in, are tracker.port and tracker.baud right, and do bodies have its numbers as ids?"
    }

    fn port(&self) -> Option<&str> {
        Some(&self.port)
    }

    fn open(&self, place: TrackerPlace) -> Result<Box<dyn Tracker>, SourceError> {
        let config =
            client::SerialTrackerConfig { port: self.port.clone(), baud: self.baud, bodies: place.bodies };
        Ok(Box::new(client::SerialTracker::open(config, place.clock)?))
    }
}

fn mock(scene: &MockScene) -> io::Result<MockServer> {
    let (ours, path, held) = pseudo_terminal()?;
    let device = SerialPoseDevice::new(scene.source.clone()).map_err(io::Error::other)?;
    let host = SerialPoseHost::start(device, ours, scene.clock.clone())?;
    Ok(MockServer { keys: vec![("port", format!("{path:?}"))], running: Box::new((host, held)) })
}

/// A packet: its own encoding is read as the same message.
fn any_packet(bytes: &[u8]) {
    let encoded = |bytes: &[u8]| {
        let message = SerialMessage::decode(bytes).ok()?;
        let mut out = Vec::new();
        message.encode(&mut out);
        Some(out)
    };
    let Some(first) = encoded(bytes) else { return };
    let mut deframer = Deframer::new([0u8; 256]);
    let mut frame = None;
    deframer.push(&first, &mut |f| frame = Some(f.to_vec()));
    assert_eq!(encoded(&frame.expect("one frame")), Some(first));
}
