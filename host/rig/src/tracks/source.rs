//! Opens the tracker of `[tracker]` in the rig file, ready to be polled.

use super::tracker_frame::TrackerFrame;
use crate::config::{MockTrackerConfig as MockKeys, RigConfig, TrackerConfig};
use crate::mock::{FaultError, FaultPlan, MockTracker, MockTrackerConfig, MockTrackerError, Motion};
use crate::rig::Rig;
use dpm_device::time::{FrameRate, HostClock, HostTime};
use dpm_device::tracker::natnet::client::{NatNetClient, NatNetConfig};
use dpm_device::tracker::record::{RecordError, Replay};
use dpm_device::tracker::serial::client::{SerialTracker, SerialTrackerConfig};
use dpm_device::tracker::vrpn::client::{VrpnClient, VrpnConfig};
use dpm_device::tracker::{BodyKey, SampleGate, Tracker, TrackerError, TrackerSample};
use std::net::Ipv4Addr;
use std::sync::Arc;
use std::time::Duration;

/// Why the tracker cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// The mock's settings are invalid.
    #[error("tracker: {0}")]
    Mock(#[from] MockTrackerError),
    /// The mock's faults are invalid.
    #[error("tracker.faults: {0}")]
    Faults(#[from] FaultError),
    /// An invalid address. The check of the configuration finds it first.
    #[error("{key}: {text:?} is not an IPv4 address such as 192.168.1.10")]
    Address {
        /// Key of the rig file.
        key: &'static str,
        /// The invalid text.
        text: String,
    },
    /// The recording cannot be used.
    #[error("tracker.file: {0}")]
    Recording(#[from] RecordError),
    /// The device or the network cannot be opened.
    #[error("tracker: {0}")]
    Tracker(#[from] TrackerError),
}

/// The tracker of a run that tracks nothing.
pub(crate) struct NoTracker;

impl Tracker for NoTracker {
    fn poll(&mut self, _: HostTime, _: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        Ok(0)
    }

    fn name(&self) -> &str {
        "none"
    }
}

/// Opens the tracker of `rig`; its polls are stamped with `clock`. Time 0 of the mock's motions is instant 0 of the
/// host's clock; a recording starts at `start`.
///
/// # Errors
/// Its address, file or settings are wrong.
pub fn open_for(
    rig: &Rig,
    clock: Arc<dyn HostClock>,
    start: HostTime,
) -> Result<Box<dyn Tracker>, SourceError> {
    let keys = rig.tracked().map(|b| BodyKey { name: b.name.clone(), id: b.id }).collect();
    let motions = rig.tracked().filter_map(|b| b.motion.clone()).collect();
    open(&rig.config.tracker, keys, motions, clock, start)
}

/// Opens the tracker of a rig file for `bodies` by their names alone, without a scene. The mock in this process, which
/// plays the scene's bodies, has none then. A recording starts at `start`.
///
/// # Errors
/// Its address, file or settings are wrong.
pub fn open_for_names(
    config: &RigConfig,
    bodies: Vec<BodyKey>,
    clock: Arc<dyn HostClock>,
    start: HostTime,
) -> Result<Box<dyn Tracker>, SourceError> {
    open(&config.tracker, bodies, Vec::new(), clock, start)
}

/// Opens the tracker of a rig file for bodies that need not be the rig's, such as a wand. Poses are in the rig's world.
/// Their times are the tracker's own: `tracker.latency_us` is not applied. The mock in this process has no such bodies.
///
/// # Errors
/// Its address, file or settings are wrong.
pub fn open_in_world(
    config: &RigConfig,
    bodies: Vec<BodyKey>,
    clock: Arc<dyn HostClock>,
) -> Result<Box<dyn Tracker>, SourceError> {
    let tracker = open(&config.tracker, bodies, Vec::new(), clock, HostTime(0))?;
    Ok(match TrackerFrame::of(&config.tracker, Some(0)) {
        None => tracker,
        Some(frame) => Box::new(InWorld { tracker, frame }),
    })
}

/// A tracker whose poses are in the world.
struct InWorld {
    tracker: Box<dyn Tracker>,
    frame: TrackerFrame,
}

impl Tracker for InWorld {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        let Self { tracker, frame } = self;
        tracker.poll(now, &mut |sample| sink(&frame.apply(sample)))
    }

    fn name(&self) -> &str {
        self.tracker.name()
    }

    fn status(&self) -> String {
        self.tracker.status()
    }

    fn wait(&self, timeout: Duration) -> bool {
        self.tracker.wait(timeout)
    }

    fn gate(&self) -> Option<&SampleGate> {
        self.tracker.gate()
    }
}

/// Opens the tracker. `bodies` are the rig's bodies in their order. `motions` are their true motions, which only the
/// mock needs. `clock` is the clock that stamps polls. A recording starts at `start`. Network and serial trackers
/// connect while they are polled, and reconnect after every loss, so it is no error if nothing answers yet.
///
/// # Errors
/// Settings, addresses or files cannot be used, or the system refuses a socket.
pub(crate) fn open(
    config: &TrackerConfig,
    bodies: Vec<BodyKey>,
    motions: Vec<Motion>,
    clock: Arc<dyn HostClock>,
    start: HostTime,
) -> Result<Box<dyn Tracker>, SourceError> {
    Ok(match config {
        TrackerConfig::Mock(c) => Box::new(mock(c, motions)?),
        TrackerConfig::Natnet(c) => {
            let config = NatNetConfig {
                server: address("tracker.server", &c.server)?,
                local: address("tracker.local", &c.local)?,
                multicast: c.multicast.as_deref().map(|m| address("tracker.multicast", m)).transpose()?,
                command_port: c.command_port,
                data_port: c.data_port,
                bitstream: None,
                kernel_stamps: true,
                bodies,
            };
            Box::new(NatNetClient::open(config, clock)?)
        }
        TrackerConfig::Vrpn(c) => {
            let config = VrpnConfig { server: c.server.clone(), tracker: c.tracker.clone(), bodies };
            Box::new(VrpnClient::open(config, clock)?)
        }
        TrackerConfig::Serial(c) => {
            let config = SerialTrackerConfig { port: c.port.clone(), baud: c.baud, bodies };
            Box::new(SerialTracker::open(config, clock)?)
        }
        TrackerConfig::Replay(c) => Box::new(Replay::open(&c.file, &bodies, start)?),
    })
}

/// The mock tracker for bodies that move by `motions`.
fn mock(c: &MockKeys, motions: Vec<Motion>) -> Result<MockTracker, SourceError> {
    let mut faults = c.faults.clone();
    // `drop_out` is an additional fault.
    if c.drop_out > 0.0 {
        let separator = if faults.trim().is_empty() { "" } else { "," };
        faults.push_str(&format!("{separator}loss={}", c.drop_out));
    }
    let config = MockTrackerConfig {
        seed: c.seed,
        rate: FrameRate::new(c.rate_hz, 1).expect("the rate was checked when the configuration was read"),
        position_noise_m: c.noise_m,
        rotation_noise_rad: c.noise_rad,
        latency_ns: i64::from(c.latency_us) * 1000,
        latency_jitter_ns: i64::from(c.jitter_us) * 1000,
        faults: faults.parse::<FaultPlan>()?,
        ..Default::default()
    };
    Ok(MockTracker::new(config, motions)?)
}

fn address(key: &'static str, text: &str) -> Result<Ipv4Addr, SourceError> {
    text.trim().parse().map_err(|_| SourceError::Address { key, text: text.into() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{NatnetConfig, Overrides, ReplayConfig, RigConfig};
    use crate::mock::MotionSpec;
    use std::path::Path;

    fn bodies() -> Vec<BodyKey> {
        vec![BodyKey { name: "hare".into(), id: Some(3) }]
    }

    fn config(text: &str) -> TrackerConfig {
        RigConfig::parse("rig.toml", text, Path::new(""), &Overrides::default()).expect("valid").tracker
    }

    fn clock() -> Arc<dyn HostClock> {
        Arc::new(|| HostTime(0))
    }

    #[test]
    fn the_mock_has_the_rigs_rate_and_latency_and_loses_what_it_was_told_to() {
        let keys = "[tracker]\nrate_hz = 250\nlatency_us = 3000\n";
        let count = |more: &str| {
            let motion = Motion::new(&MotionSpec::Still {}, dpm_device::pose::Pose::IDENTITY).expect("still");
            let mut tracker =
                open(&config(&format!("{keys}{more}")), bodies(), vec![motion], clock(), HostTime(0))
                    .expect("opens");
            let (mut samples, mut delays) = (0, 0);
            for ms in 0..=4000 {
                let mut sink = |s: &dpm_device::tracker::TrackerSample| {
                    samples += 1;
                    delays += s.received_at.ns_since(s.captured_at);
                };
                tracker.poll(HostTime(ms * 1_000_000), &mut sink).expect("polls");
            }
            (samples, delays / samples.max(1))
        };
        let (all, delay) = count("");
        assert!((998..=1001).contains(&all), "{all} samples in 4 s at 250 Hz");
        assert!((3_000_000..4_000_000).contains(&delay), "{delay} ns");
        let (half, _) = count("drop_out = 0.5\n");
        assert!((430..570).contains(&half), "{half} of 1000 at a loss of one half");
    }

    #[test]
    fn network_and_serial_trackers_open_before_anybody_answers() {
        for text in [
            "[tracker]\nkind = \"natnet\"\nserver = \"127.0.0.1\"\nlocal = \"127.0.0.1\"",
            "[tracker]\nkind = \"vrpn\"\nserver = \"127.0.0.1:1\"",
            "[tracker]\nkind = \"serial\"\nport = \"/nonexistent/tty\"",
        ] {
            let mut tracker = open(&config(text), bodies(), Vec::new(), clock(), HostTime(0)).expect(text);
            assert_eq!(tracker.poll(HostTime(1), &mut |_| panic!("a sample from nowhere")).expect(text), 0);
        }
    }

    #[test]
    fn what_cannot_be_opened_is_named() {
        let told = |c: TrackerConfig| match open(&c, bodies(), Vec::new(), clock(), HostTime(0)) {
            Ok(_) => panic!("opened"),
            Err(e) => e.to_string(),
        };
        let server = NatnetConfig { server: "motive.lab".into(), ..NatnetConfig::default() };
        assert!(told(TrackerConfig::Natnet(server))
            .contains("tracker.server: \"motive.lab\" is not an IPv4 address"));
        let missing = ReplayConfig { file: "/nonexistent/run.dpmt".into(), ..ReplayConfig::default() };
        assert!(told(TrackerConfig::Replay(missing)).contains("/nonexistent/run.dpmt"));
    }
}
