//! Any bytes at the mock servers and any text at the fault parser: no panic, no answer without bound.

use dpm_device::pose::Pose;
use dpm_device::time::HostTime;
use dpm_device::tracker::vrpn::wire::COOKIE;
use hil_mock::faults::FaultPlan;
use hil_mock::motion::{Motion, MotionSpec};
use hil_mock::natnet_server::{NatNetServer, NatNetServerConfig};
use hil_mock::serial_server::SerialPoseDevice;
use hil_mock::tracker::{MockTrackerConfig, SampleSource};
use hil_mock::vrpn_server::{VrpnConnection, VrpnNames};
use proptest::prelude::*;
use std::net::{Ipv4Addr, SocketAddrV4};

fn source() -> SampleSource {
    let motion = Motion::new(&MotionSpec::Still {}, Pose::IDENTITY).unwrap();
    SampleSource::new(MockTrackerConfig::default(), vec![motion]).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn the_natnet_server_survives_any_datagrams(
        datagrams in proptest::collection::vec((0u16..16, any::<bool>(), proptest::collection::vec(any::<u8>(), 0..300)), 1..20),
    ) {
        let mut server = NatNetServer::new(NatNetServerConfig::new(&["a"]), source()).unwrap();
        for (i, (id, is_framed, mut bytes)) in datagrams.into_iter().enumerate() {
            if is_framed {
                let length = bytes.len() as u16;
                bytes.splice(0..0, id.to_le_bytes().into_iter().chain(length.to_le_bytes()));
            }
            let now = HostTime(i as i64 * 1_000_000);
            let mut answers = 0;
            let from = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 2000 + i as u16);
            server.on_datagram(&bytes, from, now, &mut |answer, to| {
                answers += 1;
                assert!(to == from && answer.len() < 2000, "answers go back where the question came from");
            });
            prop_assert!(answers <= 1);
            server.stream(now, &mut |_, _| {});
        }
        prop_assert!(server.client_count() <= NatNetServer::MAX_CLIENTS);
    }

    #[test]
    fn the_vrpn_server_survives_any_stream(bytes in proptest::collection::vec(any::<u8>(), 0..2000), chunk in 1usize..200) {
        let names = VrpnNames { tracker: "T".into(), bodies: vec!["a".into()], each_body: true };
        let mut out = Vec::new();
        let mut connection = VrpnConnection::new(&names, &mut out);
        connection.on_bytes(&names, &COOKIE, 0, &mut out).unwrap();
        for piece in bytes.chunks(chunk) {
            if connection.on_bytes(&names, piece, 0, &mut out).is_err() {
                break;
            }
        }
        prop_assert!(out.len() < 10_000);
    }

    #[test]
    fn the_serial_device_survives_any_stream(bytes in proptest::collection::vec(any::<u8>(), 0..2000)) {
        let mut device = SerialPoseDevice::new(source()).unwrap();
        let mut out = Vec::new();
        device.on_bytes(&bytes, HostTime(5), &mut out);
        prop_assert!(out.is_empty(), "no random bytes carry a valid checksum");
    }

    #[test]
    fn any_text_is_a_plan_or_an_error(text in "[a-z=@+/,.0-9 ]{0,60}") {
        if let Ok(plan) = text.parse::<FaultPlan>() {
            prop_assert_eq!(plan.to_string().parse::<FaultPlan>(), Ok(plan));
        }
    }
}
