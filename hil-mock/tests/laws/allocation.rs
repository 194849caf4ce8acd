//! Polling a tracker allocates nothing once it runs: a counting allocator around the mock, the recorder and the NatNet client.

use counting_allocator::{requests_in, Counting};
use dpm_device::pose::Pose;
use dpm_device::time::{HostClock, HostTime};
use dpm_device::tracker::natnet::client::{NatNetClient, NatNetConfig};
use dpm_device::tracker::record::Recorder;
use dpm_device::tracker::udp::UdpPort;
use dpm_device::tracker::{BodyKey, Tracker};
use hil_mock::motion::{Motion, MotionSpec};
use hil_mock::natnet_server::{NatNetServer, NatNetServerConfig, Streaming, UnicastTo};
use hil_mock::tracker::{MockTracker, MockTrackerConfig, SampleSource};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::Arc;

const MS: i64 = 1_000_000;

#[global_allocator]
static ALLOCATOR: Counting = Counting::BY_THREAD;

fn motions() -> Vec<Motion> {
    let motion = Motion::new(&MotionSpec::paper_translation(), Pose::IDENTITY).unwrap();
    vec![motion.clone(), motion]
}

const FAULTS: &str = "loss=0.05,duplicate=0.1,reorder=0.1,nan=0.05,invalid=0.05,stall@3s+100ms/1s,slow=1ms";

#[test]
fn the_counter_counts() {
    assert!(requests_in(|| drop(vec![0u8; 100])) > 0);
}

#[test]
fn mock_and_recorder_allocate_nothing() {
    let config =
        MockTrackerConfig { position_noise_m: 1e-4, faults: FAULTS.parse().unwrap(), ..Default::default() };
    let mock = MockTracker::new(config, motions()).unwrap();
    let path = std::env::temp_dir().join(format!("dpm-{}-allocation.track", std::process::id()));
    let _ = std::fs::remove_file(&path);
    let mut recorder = Recorder::create(mock, &path, &[], HostTime(0)).unwrap();
    let mut samples = 0;
    let mut poll = |until: i64, now: &mut i64| {
        while *now < until {
            *now += MS;
            samples += recorder.poll(HostTime(*now), &mut |_| {}).unwrap();
        }
    };
    let mut now = 0;
    poll(2000 * MS, &mut now);
    assert_eq!(requests_in(|| poll(8000 * MS, &mut now)), 0);
    assert!(samples > 6000, "{samples}");
    drop(recorder);
    let _ = std::fs::remove_file(&path);
}

#[test]
fn the_natnet_client_allocates_nothing_per_frame() {
    let clock = Arc::new(AtomicI64::new(0));
    let host_clock: Arc<dyn HostClock> = {
        let clock = clock.clone();
        Arc::new(move || HostTime(clock.load(Ordering::Relaxed)))
    };
    let socket = UdpPort::bind(SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0), false).unwrap();
    let mut config = NatNetServerConfig::new(&["a", "b"]);
    config.streaming = Streaming::Unicast(UnicastTo::CommandSocket);
    let faults = format!("{FAULTS},corrupt=0.1,truncate=0.1");
    let mock = MockTrackerConfig { faults: faults.parse().unwrap(), ..Default::default() };
    let mut server = NatNetServer::new(config, SampleSource::new(mock, motions()).unwrap()).unwrap();
    let keys = ["a", "b"].map(|n| BodyKey { name: n.into(), id: None }).to_vec();
    let mut wanted = NatNetConfig::unicast(Ipv4Addr::LOCALHOST, keys);
    wanted.local = Ipv4Addr::LOCALHOST;
    wanted.kernel_stamps = false;
    wanted.command_port = socket.local().unwrap().port();
    wanted.data_port = wanted.command_port;
    let mut client = NatNetClient::open(wanted, host_clock).unwrap();
    let mut buffer = vec![0; 2048];
    let (mut counted, mut samples) = (0, 0);
    for k in 0..8000i64 {
        let now = HostTime(k * MS);
        clock.store(now.0, Ordering::Relaxed);
        let mut send = |bytes: &[u8], to: SocketAddrV4| drop(socket.send(bytes, to));
        while let Some(a) = socket.receive(&mut buffer).unwrap() {
            server.on_datagram(&buffer[..a.len], a.from, now, &mut send);
        }
        server.stream(now, &mut send);
        let n = requests_in(|| samples += client.poll(now, &mut |_| {}).unwrap());
        // The first second is for names and the clock.
        counted += if k > 1000 { n } else { 0 };
    }
    assert_eq!(counted, 0, "{}", client.status());
    assert!(samples > 3000, "{}", client.status());
    assert!(client.clock_map().is_some());
}
