//! Frames over a serial line, poses over the network: on the frame path our own code allocates nothing, takes no lock,
//! and makes only the system calls that docs/FRAME.md names for the link and for tracking.
#![cfg(all(target_os = "linux", target_arch = "x86_64"))]

use crate::frame_law;
use crate::link_common::{raster, start, Projector, PtyProjector};
use dpm_device::time::{FrameRate, HostClock, HostTime};
use dpm_handoff::path::Place;
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::rig::Rig;
use hil_mock::motion::{Motion, MotionSpec};
use hil_mock::natnet_host::NatNetHost;
use hil_mock::natnet_server::{NatNetServer, NatNetServerConfig, Streaming, UnicastTo};
use hil_mock::projector::MockConfig;
use hil_mock::tracker::{MockTrackerConfig, SampleSource};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// What the link may do on a serial line: ask how much of the backlog has left, and write. It does not ask with poll(2)
/// whether there is room: that may wait for a worker of the kernel.
const LINK: [&str; 2] = ["ioctl", "write"];
/// What tracking may do with sockets: read a datagram, and answer the server.
const TRACKING: [&str; 3] = ["ppoll", "recvmsg", "sendto"];

/// A server of the demo's bodies at 500 Hz.
fn natnet() -> NatNetHost {
    let config = NatNetServerConfig { data_port: 0, ..NatNetServerConfig::new(&["bunny", "venus"]) };
    let still = || Motion::new(&MotionSpec::Still {}, dpm_device::pose::Pose::IDENTITY).expect("no motion");
    let tracker = MockTrackerConfig { rate: FrameRate::new(500, 1).expect("a rate"), ..Default::default() };
    let source = SampleSource::new(tracker, vec![still(), still()]).expect("a source");
    let server = NatNetServer::new(config, source).expect("a server");
    let epoch = Instant::now();
    let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(epoch.elapsed().as_nanos() as i64));
    let streaming = Streaming::Unicast(UnicastTo::CommandSocket);
    NatNetHost::start(server, streaming, SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0), clock).expect("a socket")
}

/// A rig of 100 frames per second with the projector `backend` and the server's poses.
fn rig(backend: &str, command_port: u16) -> Arc<Rig> {
    let text = format!(
        "[projector]\nframe_rate = 100\nplanes = 8\nbackend = {backend}\n[tracker]\nkind = \"natnet\"\n\
         server = \"127.0.0.1\"\nlocal = \"127.0.0.1\"\ncommand_port = {command_port}\n[safety]\nwatchdog_ms = 1000\n\
         [[scene.bodies]]\nname = \"bunny\"\n[[scene.bodies]]\nname = \"venus\"\n"
    );
    let config = RigConfig::parse("rig.toml", &text, Path::new(""), &Overrides::default());
    let config = config.unwrap_or_else(|e| panic!("{e}"));
    Arc::new(Rig::build(&config, Some(raster())).unwrap_or_else(|e| panic!("{e}")))
}

#[test]
fn frames_on_a_serial_line_and_poses_from_a_socket_make_named_calls_only() {
    frame_law::watch();
    let server = natnet();
    let far = PtyProjector::new("frame-law", MockConfig::new(raster()));
    let run = start(&rig(&far.backend(""), server.address().port()), 0);
    far.until(Duration::from_secs(30), "light", &mut |s| s.frames_lit >= 300);
    let report = run.stop().unwrap_or_else(|e| panic!("{e}")).report;
    assert!(server.frames_sent() > 300);
    let seen = frame_law::seen();
    println!("{}", seen.table(report.frames_lit));
    seen.check(&[("link", &LINK), ("tracking", &TRACKING)], &[]);
    assert!(seen.number(Place::Own, "write") > 300, "the frames went over the line");
    assert!(seen.number(Place::Own, "recvmsg") > 300, "the poses came from the socket");
}
