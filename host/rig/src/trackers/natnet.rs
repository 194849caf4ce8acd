//! `tracker.kind = "natnet"`: OptiTrack Motive, and what speaks as it does.

use super::keys::{SourceError, TrackerKeys, TrackerPlace};
use super::kind::{MockScene, MockServer, PoseOrigin, TrackerKind};
use super::transform::TrackerTransformConfig;
use crate::mock::{free_port, NatNetHost, NatNetServer, NatNetServerConfig, ANY_PORT};
use dpm_common::keys::read::{refuse, Any, KeyReader, NotEmpty, Within};
use dpm_common::section;
use dpm_device::tracker::natnet::client::{NatNetClient, NatNetConfig};
use dpm_device::tracker::natnet::frame::{decode_frame, RigidBody};
use dpm_device::tracker::natnet::messages::{
    decode_echo_request, decode_echo_response, request_text, ServerInfo,
};
use dpm_device::tracker::natnet::models::decode_models;
use dpm_device::tracker::natnet::wire::split;
use dpm_device::tracker::natnet::Version;
use dpm_device::tracker::Tracker;
use std::io;
use std::net::Ipv4Addr;

section! {
    /// A NatNet server.
    pub struct NatnetConfig {
        /// Address of the server.
        server: String = "127.0.0.1".into(), "", NotEmpty;
        /// Address of the interface that receives the data. Set it if the machine has several networks and no data
        /// arrive.
        local: String = "0.0.0.0".into(), "", NotEmpty;
        /// Multicast group; leave it out for unicast.
        multicast: Option<String> = None, "", NotEmpty;
        /// UDP port for commands.
        command_port: u16 = 1510, "", Within(1, u16::MAX);
        /// UDP port for frames.
        data_port: u16 = 1511, "", Within(1, u16::MAX);
        /// Frames per second that the server is set to; used for drop-out detection only.
        rate_hz: u32 = 500, "Hz", Within(1, 10_000);
        /// From the tracker's coordinates to the world's.
        transform: TrackerTransformConfig = TrackerTransformConfig::default(), "", Any;
        /// Time by which a sample is older than its time stamp says. `dpm calibrate latency` measures it. Negative if
        /// stamps are too old.
        latency_us: i64 = 0, "us", Within(-200_000, 200_000);
    }
}

pub(super) static KIND: TrackerKind = TrackerKind::of::<NatnetConfig>(
    "natnet",
    "OptiTrack Motive or any other NatNet 3.0 to 4.2 server.",
    PoseOrigin::Measured,
    "docs/TRACKERS.md#natnet",
    &[("natnet_datagram", any_datagram)],
    mock,
);

impl NatnetConfig {
    fn addresses(&self) -> [(&'static str, Option<&str>); 3] {
        [
            ("tracker.server", Some(&*self.server)),
            ("tracker.local", Some(&*self.local)),
            ("tracker.multicast", self.multicast.as_deref()),
        ]
    }
}

impl TrackerKeys for NatnetConfig {
    fn rate_hz(&self) -> Option<u32> {
        Some(self.rate_hz)
    }

    fn frame(&self) -> Option<(&TrackerTransformConfig, i64)> {
        Some((&self.transform, self.latency_us))
    }

    fn place(&self) -> String {
        format!("NatNet at {}", self.server)
    }

    fn remedy(&self) -> &'static str {
        "is streaming on in the tracking software, are tracker.server and tracker.local right, and do bodies have the same names there?"
    }

    fn check(&self, reader: &mut KeyReader) {
        for (key, text) in self.addresses() {
            match text.map(|text| (text, text.trim().parse::<Ipv4Addr>())) {
                Some((text, Err(_))) => {
                    let problem = format!("{text:?} is not an IPv4 address");
                    refuse(reader, &[key], problem, "write for example \"192.168.1.10\"".into());
                }
                Some((text, Ok(group))) if key == "tracker.multicast" && !group.is_multicast() => {
                    let problem = format!("{text} is not a multicast group");
                    let remedy = "groups are 224.0.0.0 to 239.255.255.255; Motive's is 239.255.42.99";
                    refuse(reader, &[key], problem, remedy.into());
                }
                _ => {}
            }
        }
    }

    fn open(&self, place: TrackerPlace) -> Result<Box<dyn Tracker>, SourceError> {
        let config = NatNetConfig {
            server: address("tracker.server", &self.server)?,
            local: address("tracker.local", &self.local)?,
            multicast: self.multicast.as_deref().map(|m| address("tracker.multicast", m)).transpose()?,
            command_port: self.command_port,
            data_port: self.data_port,
            bitstream: None,
            kernel_stamps: true,
            bodies: place.bodies,
        };
        Ok(Box::new(NatNetClient::open(config, place.clock)?))
    }
}

fn address(key: &'static str, text: &str) -> Result<Ipv4Addr, SourceError> {
    let why = || SourceError::of_key(key, format!("{text:?} is not an IPv4 address such as 192.168.1.10"));
    text.trim().parse().map_err(|_| why())
}

fn mock(scene: &MockScene) -> io::Result<MockServer> {
    let names: Vec<&str> = scene.names.iter().map(String::as_str).collect();
    // A port that is free now: the one that everybody uses may be taken by a rig.
    let data_port = free_port()?;
    let config = NatNetServerConfig { data_port, ..NatNetServerConfig::new(&names) };
    let streaming = config.streaming;
    let server = NatNetServer::new(config, scene.source.clone()).map_err(io::Error::other)?;
    let host = NatNetHost::start(server, streaming, ANY_PORT, scene.clock.clone())?;
    let port = host.address().port().to_string();
    let local = || "\"127.0.0.1\"".to_owned();
    let keys = vec![
        ("server", local()),
        ("local", local()),
        ("command_port", port),
        ("data_port", data_port.to_string()),
    ];
    Ok(MockServer { keys, running: Box::new(host) })
}

/// A datagram in every version.
fn any_datagram(bytes: &[u8]) {
    let Ok((_, payload)) = split(bytes) else { return };
    let mut bodies: Vec<RigidBody> = Vec::new();
    for version in [Version::V3_0, Version::new(3, 1), Version::V4_0, Version::V4_1, Version::V4_2] {
        let ok = decode_frame(payload, version, &mut bodies).is_ok();
        assert!(bodies.len() <= payload.len() / 38 && (ok || bodies.is_empty()));
        if let Ok(models) = decode_models(payload, version) {
            assert!(models.len() <= payload.len());
        }
    }
    let _ = (ServerInfo::decode(payload), request_text(payload));
    let _ = (decode_echo_request(payload), decode_echo_response(payload));
}
