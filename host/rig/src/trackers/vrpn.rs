//! `tracker.kind = "vrpn"`: a VRPN server.

use super::keys::{SourceError, TrackerKeys, TrackerPlace};
use super::kind::{MockScene, MockServer, PoseOrigin, TrackerKind};
use super::transform::TrackerTransformConfig;
use crate::mock::{VrpnHost, VrpnNames, VrpnReports, ANY_PORT};
use dpm_common::keys::read::{Any, NotEmpty, Within};
use dpm_common::section;
use dpm_device::tracker::vrpn::{client, wire};
use dpm_device::tracker::Tracker;
use std::io;

section! {
    /// A VRPN server.
    pub struct VrpnConfig {
        /// `host` or `host:port`, or as VRPN's own programs write it, `NAME@host` with the tracker's name.
        server: String = "127.0.0.1:3883".into(), "", NotEmpty;
        /// Name of the tracker on the server.
        tracker: String = "Tracker0".into(), "", NotEmpty;
        /// Samples per second that the server is set to; used for drop-out detection only.
        rate_hz: u32 = 500, "Hz", Within(1, 10_000);
        /// From the tracker's coordinates to the world's.
        transform: TrackerTransformConfig = TrackerTransformConfig::default(), "", Any;
        /// Time by which a sample is older than its time stamp says. `dpm calibrate latency` measures it. Negative if
        /// stamps are too old.
        latency_us: i64 = 0, "us", Within(-200_000, 200_000);
    }
}

pub(super) static KIND: TrackerKind = TrackerKind::of::<VrpnConfig>(
    "vrpn",
    "a VRPN server.",
    PoseOrigin::Measured,
    "docs/TRACKERS.md#vrpn",
    &[("vrpn_stream", any_stream)],
    mock,
);

impl VrpnConfig {
    /// Server and tracker, also where one of the two keys has both as `NAME@host`.
    fn address(&self) -> (String, String) {
        let plain = |text: &str| {
            let schemes = ["x-vrpn://", "vrpn://", "x-vrsh://", "tcp://"];
            let rest = schemes.iter().find_map(|scheme| text.trim().strip_prefix(scheme));
            rest.unwrap_or(text.trim()).to_owned()
        };
        match (self.server.split_once('@'), self.tracker.split_once('@')) {
            (Some((name, host)), _) => (plain(host), name.trim().to_owned()),
            (None, Some((name, host))) => (plain(host), name.trim().to_owned()),
            (None, None) => (plain(&self.server), self.tracker.clone()),
        }
    }
}

impl TrackerKeys for VrpnConfig {
    fn rate_hz(&self) -> Option<u32> {
        Some(self.rate_hz)
    }

    fn frame(&self) -> Option<(&TrackerTransformConfig, i64)> {
        Some((&self.transform, self.latency_us))
    }

    fn place(&self) -> String {
        format!("VRPN at {}", self.address().0)
    }

    fn remedy(&self) -> &'static str {
        "is the server running, are tracker.server and tracker.tracker right, and do bodies have the same names or ids there?"
    }

    fn open(&self, place: TrackerPlace) -> Result<Box<dyn Tracker>, SourceError> {
        let (server, tracker) = self.address();
        let config = client::VrpnConfig { server, tracker, bodies: place.bodies };
        Ok(Box::new(client::VrpnClient::open(config, place.clock)?))
    }
}

fn mock(scene: &MockScene) -> io::Result<MockServer> {
    let tracker = VrpnConfig::default().tracker;
    let names = VrpnNames { tracker, bodies: scene.names.clone(), each_body: true };
    let reports = VrpnReports::new(scene.source.clone()).map_err(io::Error::other)?;
    let host = VrpnHost::start(names, reports, ANY_PORT, scene.clock.clone())?;
    let keys = vec![("server", format!("\"{}\"", host.address()))];
    Ok(MockServer { keys, running: Box::new(host) })
}

/// A stream: every message lies within it and is recovered from its own encoding.
fn any_stream(mut bytes: &[u8]) {
    while let Ok(Some((message, taken))) = wire::split(bytes) {
        assert!(taken > 0 && taken <= bytes.len() && message.payload.len() <= taken);
        let _ = (wire::described_name(message.payload), wire::decode_pos_quat(message.payload));
        let mut out = Vec::new();
        wire::put(&mut out, &message);
        let (back, all) = wire::split(&out).expect("own encoding").expect("whole");
        assert_eq!((back, all), (message, out.len()));
        bytes = &bytes[taken..];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_as_vrpns_programs_write_it_is_read() {
        let of = |server: &str, tracker: &str| {
            let config =
                VrpnConfig { server: server.into(), tracker: tracker.into(), ..VrpnConfig::default() };
            let (server, tracker) = config.address();
            format!("{tracker} at {server}")
        };
        assert_eq!(of("10.0.0.2:3884", "Head"), "Head at 10.0.0.2:3884");
        assert_eq!(of("Head@10.0.0.2:3884", "Tracker0"), "Head at 10.0.0.2:3884");
        assert_eq!(of("Head@tcp://10.0.0.2", "Tracker0"), "Head at 10.0.0.2");
        assert_eq!(of("127.0.0.1:3883", "Head@lab"), "Head at lab");
    }
}
