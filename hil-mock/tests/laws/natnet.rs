//! The NatNet client against the NatNet server over real loopback sockets, in virtual time, step by step.

use dpm_device::pose::Pose;
use dpm_device::time::{HostClock, HostTime};
use dpm_device::tracker::natnet::client::{NatNetClient, NatNetConfig, Silence};
use dpm_device::tracker::natnet::frame::{encode_frame, FrameContent, FrameInfo, RigidBody};
use dpm_device::tracker::natnet::messages::ServerInfo;
use dpm_device::tracker::natnet::models::{encode_models, BodyDefinition};
use dpm_device::tracker::natnet::Version;
use dpm_device::tracker::udp::UdpPort;
use dpm_device::tracker::{BodyIndex, BodyKey, Tracker, TrackerSample};
use hil_mock::motion::{Motion, MotionSpec};
use hil_mock::natnet_server::{NatNetServer, NatNetServerConfig, Streaming, UnicastTo};
use hil_mock::tracker::{MockTrackerConfig, SampleSource};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::Arc;

use crate::natnet_common::{keys, source, LOCALHOST, MS, S};

/// Client and server on loopback with one virtual clock: a datagram sent is there at once, so nothing depends on the machine.
struct Bench {
    clock: Arc<AtomicI64>,
    server: NatNetServer,
    socket: UdpPort,
    client: NatNetClient,
    samples: Vec<TrackerSample>,
    buffer: Vec<u8>,
}

fn clock_of(cell: &Arc<AtomicI64>) -> Arc<dyn HostClock> {
    let cell = cell.clone();
    Arc::new(move || HostTime(cell.load(Ordering::Relaxed)))
}

impl Bench {
    fn new(
        faults: &str,
        server: impl FnOnce(&mut NatNetServerConfig),
        client: impl FnOnce(&mut NatNetConfig),
    ) -> Self {
        let clock = Arc::new(AtomicI64::new(0));
        let socket = UdpPort::bind(SocketAddrV4::new(LOCALHOST, 0), false).unwrap();
        let spare = UdpPort::bind(SocketAddrV4::new(LOCALHOST, 0), false).unwrap();
        let data_port = spare.local().unwrap().port();
        drop(spare);
        let mut config = NatNetServerConfig::new(&["Hare", "Bust"]);
        config.data_port = data_port;
        server(&mut config);
        if let Streaming::Multicast(_) = config.streaming {
            socket.multicast_from(LOCALHOST, 0).unwrap();
        }
        let mut wanted = NatNetConfig::unicast(LOCALHOST, keys(&["Hare", "Bust"]));
        wanted.local = LOCALHOST;
        wanted.kernel_stamps = false;
        wanted.command_port = socket.local().unwrap().port();
        wanted.data_port = data_port;
        client(&mut wanted);
        Self {
            server: NatNetServer::new(config, source(faults, 2 * MS)).unwrap(),
            client: NatNetClient::open(wanted, clock_of(&clock)).unwrap(),
            clock,
            socket,
            samples: Vec::new(),
            buffer: vec![0; 65_536],
        }
    }

    fn now(&self) -> HostTime {
        HostTime(self.clock.load(Ordering::Relaxed))
    }

    /// The server's turn.
    fn serve(&mut self) {
        let now = self.now();
        let socket = &self.socket;
        let mut send = |bytes: &[u8], to: SocketAddrV4| drop(socket.send(bytes, to));
        while let Some(a) = self.socket.receive(&mut self.buffer).unwrap() {
            self.server.on_datagram(&self.buffer[..a.len], a.from, now, &mut send);
        }
        self.server.stream(now, &mut send);
    }

    /// The client's turn.
    fn poll(&mut self) -> usize {
        let samples = &mut self.samples;
        let n = self
            .client
            .poll(HostTime(self.clock.load(Ordering::Relaxed)), &mut |s| samples.push(*s))
            .unwrap();
        assert!(self.client.counters().is_conserved(), "{}", self.client.counters());
        n
    }

    /// Both in turns of `step` until `until`.
    fn run(&mut self, step: i64, until: i64) {
        while self.now().0 < until {
            self.clock.fetch_add(step, Ordering::Relaxed);
            self.serve();
            self.poll();
        }
    }

    /// Largest difference between reported and true positions of all samples, metres.
    fn worst_error(&self) -> f64 {
        let error = |s: &TrackerSample| {
            let truth = self.server.source().true_pose(s.body, s.captured_at.0).unwrap();
            let d = |i: usize| s.pose.position_m[i] - truth.position_m[i];
            (d(0).powi(2) + d(1).powi(2) + d(2).powi(2)).sqrt()
        };
        self.samples.iter().map(error).fold(0.0, f64::max)
    }
}

#[test]
fn poses_names_and_times_come_through_in_every_version() {
    for version in [Version::V3_0, Version::new(3, 1), Version::V4_0, Version::V4_1, Version::V4_2] {
        let mut bench = Bench::new("", |s| s.version = version, |c| c.bodies.swap(0, 1));
        bench.run(MS / 2, 2 * S);
        assert_eq!(bench.client.version(), version);
        assert_eq!(bench.client.server().unwrap().name, "hil-mock");
        assert_eq!(bench.client.models().len(), 2);
        assert_eq!(bench.client.silence(), None, "{}", bench.client.status());
        // The rig names the bodies in the other order: index 1 is the hare, which moves in x.
        let hare: Vec<_> = bench.samples.iter().filter(|s| s.body == BodyIndex(1)).collect();
        assert!(hare.len() > 800, "{version}: {}", hare.len());
        assert!(hare.iter().any(|s| (s.pose.position_m[0] - 0.1).abs() > 0.1));
        // Captured when the tracker says: to half a microsecond through the echo map.
        let settled = hare.iter().filter(|s| s.captured_at.0 > S);
        let worst = settled.map(|s| (s.captured_at.0 + MS) % (2 * MS) - MS).map(i64::abs).max().unwrap();
        assert!(worst < 500_000, "{version}: {worst}");
        assert!(bench.client.clock_map().unwrap().min_round_trip_ns().unwrap() >= 0);
    }
}

#[test]
fn capture_times_follow_a_skewed_clock() {
    let mut bench = Bench::new(
        "",
        |s| {
            s.clock_skew_ppb = 200_000;
            s.clock_hz = 3_000_001;
        },
        |_| {},
    );
    // Fine steps so that the virtual round trip, one step, says something.
    bench.run(50_000, 3 * S);
    let hare: Vec<_> =
        bench.samples.iter().filter(|s| s.body == BodyIndex(0) && s.captured_at.0 > S).collect();
    let worst = hare.iter().map(|s| ((s.captured_at.0 + MS).rem_euclid(2 * MS) - MS).abs()).max().unwrap();
    let bound = bench
        .client
        .clock_map()
        .unwrap()
        .to_host(dpm_device::time::DeviceTicks(bench.server.ticks_at(bench.now())));
    assert!(worst <= 50_000, "{worst} ns");
    assert!(worst <= bound.unwrap().uncertainty_ns + 2 * 50_000);
    // Half a step of time at 1 m/s is 25 um, and f32 metres add 1e-7.
    assert!(bench.worst_error() < 1e-4, "{}", bench.worst_error());
}

#[test]
fn both_unicast_conventions_and_multicast_are_understood() {
    let group = Ipv4Addr::new(239, 255, 42, 99);
    for streaming in [
        Streaming::Unicast(UnicastTo::CommandSocket),
        Streaming::Unicast(UnicastTo::DataPort),
        Streaming::Unicast(UnicastTo::Both),
        Streaming::Multicast(group),
    ] {
        let mut bench = Bench::new(
            "",
            |s| s.streaming = streaming,
            |c| {
                if let Streaming::Multicast(group) = streaming {
                    c.multicast = Some(group);
                }
            },
        );
        bench.run(MS, S);
        let frames = bench.samples.iter().filter(|s| s.body == BodyIndex(0)).count();
        assert!(frames > 300, "{streaming:?}: {frames}, {}", bench.client.status());
        assert!(bench.client.counters().samples.duplicate <= 4, "{streaming:?}: {}", bench.client.status());
    }
}

#[test]
fn silence_has_a_reason() {
    // Nobody there.
    let mut bench = Bench::new("", |_| {}, |c| c.command_port = 9);
    bench.run(10 * MS, S);
    assert_eq!(bench.client.silence(), Some(Silence::NoAnswer));
    assert!(bench.client.status().contains("127.0.0.1:9"), "{}", bench.client.status());
    // The server streams to a group, the client asked for unicast.
    let group = Ipv4Addr::new(239, 255, 42, 98);
    let mut bench = Bench::new("", |s| s.streaming = Streaming::Multicast(group), |_| {});
    bench.run(10 * MS, S);
    assert_eq!(bench.client.silence(), Some(Silence::NoFrames));
    assert!(bench.client.status().contains("multicast = \"239.255.42.98\""), "{}", bench.client.status());
    // The bodies are called otherwise (T12): names and numbers of what is there are told.
    let mut bench = Bench::new("", |_| {}, |c| c.bodies = keys(&["Hare "]));
    bench.run(MS, S);
    assert_eq!(bench.client.silence(), Some(Silence::NoKnownBody));
    let status = bench.client.status();
    assert!(
        status.contains("\"Hare\" = 1") && status.contains("\"Hare \"") && status.contains("[1, 2]"),
        "{status}"
    );
    assert_eq!(bench.client.counters().samples.unknown_body, bench.client.counters().samples.received);
    // Seen by nobody.
    let mut bench = Bench::new("invalid", |_| {}, |_| {});
    bench.run(MS, S);
    assert_eq!(bench.client.silence(), Some(Silence::NotTracked));
    // The server goes away, and comes back: found again within a second of its return.
    let mut bench = Bench::new("unplug@1s+4s", |_| {}, |_| {});
    bench.run(MS, 4 * S);
    assert_eq!(bench.client.silence(), Some(Silence::WentSilent));
    bench.samples.clear();
    bench.run(MS, 6 * S);
    assert_eq!(bench.client.silence(), None, "{}", bench.client.status());
    assert!(bench.samples[0].received_at.0 < 5 * S + 500 * MS, "{:?}", bench.samples[0]);
}

#[test]
fn numbers_work_where_names_are_unknown() {
    let bodies = vec![BodyKey { name: "anything".into(), id: Some(2) }];
    let mut bench = Bench::new("", |_| {}, |c| c.bodies = bodies);
    bench.run(MS, S);
    // Number 2 rotates in place.
    assert!(bench.samples.len() > 300);
    assert!(bench.samples.iter().all(|s| (s.pose.position_m[0] - 0.1).abs() < 1e-6));
}

#[test]
fn faults_on_the_wire_are_counted_and_change_nothing_else() {
    let faults = "loss=0.05,duplicate=0.1,reorder=0.1,corrupt=0.1,truncate=0.05,nan=0.02,norm=0.02,flip=0.3";
    for version in [Version::V3_0, Version::V4_1] {
        let mut bench = Bench::new(faults, |s| s.version = version, |_| {});
        bench.run(MS / 2, 20 * S);
        let c = *bench.client.counters();
        // 10,000 frames: each fault shows, the bounds are wide because faults hide each other.
        assert!((200..2000).contains(&c.packets.malformed), "{c}");
        assert!(c.samples.late > 500 && c.samples.duplicate > 500 && c.lost > 500, "{c}");
        assert!(c.samples.not_finite + c.samples.out_of_reach > 100 && c.samples.bad_rotation > 100, "{c}");
        assert!(c.samples.used > 14_000, "{c}");
        // Capture order and rigidity are kept. A corrupted float may be a plausible pose: NatNet has no checksum.
        for body in [BodyIndex(0), BodyIndex(1)] {
            let of_body: Vec<_> = bench.samples.iter().filter(|s| s.body == body).collect();
            assert!(of_body.windows(2).all(|w| w[0].captured_at < w[1].captured_at));
        }
        assert!(bench.samples.iter().all(|s| s.pose.is_valid(1e-9)));
    }
}

#[test]
fn a_restarted_server_is_followed_within_50_ms() {
    // T11: frame numbers and ticks start anew.
    let mut bench = Bench::new("reset@3s", |_| {}, |_| {});
    bench.run(MS / 2, 5 * S);
    let after: Vec<_> =
        bench.samples.iter().filter(|s| s.received_at.0 > 3 * S + 2 * MS && s.body == BodyIndex(0)).collect();
    assert!(after[0].received_at.0 < 3 * S + 50 * MS, "{:?}", after[0]);
    assert!(after[0].sequence < 30);
    assert_eq!(bench.client.counters().restarts, 2, "one for each body: {}", bench.client.status());
    // No sample is more than a few milliseconds off, not even while the map is being renewed.
    for s in &bench.samples {
        let age = s.received_at.0 - s.captured_at.0;
        assert!((0..=6 * MS).contains(&age), "{age} ns old at {}", s.received_at.0);
    }
    assert!(bench.worst_error() < 3e-3, "{}", bench.worst_error());
}

#[test]
fn the_bit_stream_may_change_under_way() {
    // T14: another server with another version takes over the same address.
    let mut bench = Bench::new("", |s| s.version = Version::V3_0, |_| {});
    bench.run(MS, S);
    assert_eq!(bench.client.version(), Version::V3_0);
    let mut config = NatNetServerConfig::new(&["Hare", "Bust"]);
    config.version = Version::V4_2;
    config.streaming = Streaming::Unicast(UnicastTo::CommandSocket);
    bench.server = NatNetServer::new(config, source("", 2 * MS)).unwrap();
    // It answers echoes but knows no client: the client connects anew when frames stay away.
    bench.samples.clear();
    bench.run(MS, 5 * S);
    assert_eq!(bench.client.version(), Version::V4_2, "{}", bench.client.status());
    assert!(bench.samples.len() > 1000);
    // And asked for: a 4.0 stream from a 4.2 server.
    let mut bench = Bench::new("", |s| s.version = Version::V4_2, |c| c.bitstream = Some(Version::V4_0));
    bench.run(MS, S);
    assert_eq!(bench.client.version(), Version::V4_0);
    assert!(bench.samples.len() > 600);
}

/// A socket that plays a server by hand.
struct ByHand {
    clock: Arc<AtomicI64>,
    socket: UdpPort,
    client: NatNetClient,
    client_address: SocketAddrV4,
    out: Vec<u8>,
}

impl ByHand {
    /// A client that has connected to a 4.1 server without a clock.
    fn new(local: Ipv4Addr) -> Self {
        let clock = Arc::new(AtomicI64::new(0));
        let socket = UdpPort::bind(SocketAddrV4::new(local, 0), false).unwrap();
        let mut config = NatNetConfig::unicast(local, vec![BodyKey { name: "a".into(), id: Some(1) }]);
        config.kernel_stamps = false;
        config.command_port = socket.local().unwrap().port();
        config.data_port = config.command_port;
        let mut client = NatNetClient::open(config, clock_of(&clock)).unwrap();
        client.poll(HostTime(0), &mut |_| {}).unwrap();
        let client_address = socket.receive(&mut [0; 2048]).unwrap().unwrap().from;
        let info = ServerInfo {
            name: "by hand".into(),
            app_version: [0; 4],
            natnet_version: [4, 1, 0, 0],
            clock_hz: 0,
            data_port: 0,
            multicast: None,
        };
        let mut out = Vec::new();
        info.encode(&mut out);
        socket.send(&out, client_address).unwrap();
        client.poll(HostTime(0), &mut |_| {}).unwrap();
        assert_eq!(client.version(), Version::V4_1);
        Self { clock, socket, client, client_address, out }
    }

    fn frame(&mut self, number: i32) -> Vec<u8> {
        let body = RigidBody {
            id: 1,
            position: [number as f32 * 1e-3, 0.0, 0.0],
            rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
            mean_error: 0.0,
            params: 1,
        };
        let content = FrameContent { bodies: &[body], ..Default::default() };
        let info = FrameInfo { number, ..Default::default() };
        encode_frame(&mut self.out, Version::V4_1, &info, &content).unwrap();
        self.out.clone()
    }

    fn poll(&mut self) -> Vec<u32> {
        let mut sequence = Vec::new();
        let now = HostTime(self.clock.fetch_add(MS, Ordering::Relaxed));
        self.client.poll(now, &mut |s| sequence.push(s.sequence)).unwrap();
        assert!(self.client.counters().is_conserved());
        sequence
    }
}

#[test]
fn a_bit_stream_asked_for_by_request_is_read_once_it_is_granted() {
    // A server that heeds the request text only, as Motive does: 4.2 definitions have a rotation that 4.0 ones lack.
    let clock = Arc::new(AtomicI64::new(0));
    let socket = UdpPort::bind(SocketAddrV4::new(LOCALHOST, 0), false).unwrap();
    let mut config = NatNetConfig::unicast(LOCALHOST, keys(&["a"]));
    config.kernel_stamps = false;
    config.bitstream = Some(Version::V4_0);
    config.command_port = socket.local().unwrap().port();
    config.data_port = config.command_port;
    let mut client = NatNetClient::open(config, clock_of(&clock)).unwrap();
    let (mut buffer, mut out, mut granted) = (vec![0; 2048], Vec::new(), false);
    for ms in 0..50 {
        clock.store(ms * MS, Ordering::Relaxed);
        client.poll(HostTime(ms * MS), &mut |_| {}).unwrap();
        while let Some(a) = socket.receive(&mut buffer).unwrap() {
            let version = if granted { Version::V4_0 } else { Version::V4_2 };
            match buffer[0] {
                0 => ServerInfo {
                    name: "by hand".into(),
                    app_version: [0; 4],
                    natnet_version: [4, 2, 0, 0],
                    clock_hz: 0,
                    data_port: 0,
                    multicast: None,
                }
                .encode(&mut out),
                2 => {
                    assert_eq!(&buffer[4..a.len], b"Bitstream,4.0\0");
                    granted = true;
                    out = vec![3, 0, 4, 0, 0, 0, 0, 0];
                }
                4 => {
                    let definition = BodyDefinition { name: "a", id: 9, markers: &[[0.0; 3]] };
                    encode_models(&mut out, version, &[definition]).unwrap();
                }
                _ => continue,
            }
            socket.send(&out, a.from).unwrap();
        }
    }
    assert!(granted);
    assert_eq!(client.version(), Version::V4_0);
    assert_eq!(client.models().iter().map(|m| m.id).collect::<Vec<_>>(), [9]);
    assert_eq!(client.counters().packets.malformed, 0, "{}", client.status());
}

#[test]
fn only_the_configured_source_is_heard_and_work_is_bounded() {
    // T16, N1, N7: another address of the same machine floods the client's port.
    let mut hand = ByHand::new(LOCALHOST);
    let stranger = UdpPort::bind(SocketAddrV4::new(Ipv4Addr::new(127, 0, 0, 2), 0), false).unwrap();
    let forged = hand.frame(7);
    for _ in 0..150 {
        stranger.send(&forged, hand.client_address).unwrap();
    }
    let before = hand.client.counters().packets.received;
    assert_eq!(hand.poll(), [] as [u32; 0]);
    let read = hand.client.counters().packets.received - before;
    assert!(read as usize <= NatNetClient::MAX_DATAGRAMS_PER_POLL);
    assert_eq!(hand.client.counters().packets.foreign_source, read);
    let begin = std::time::Instant::now();
    while hand.client.counters().packets.foreign_source < 150 {
        assert!(begin.elapsed().as_secs() < 20, "{:?}", hand.client.counters());
        hand.poll();
    }
    // From now on the kernel sorts strangers out; the server is still heard.
    for _ in 0..100 {
        stranger.send(&forged, hand.client_address).unwrap();
    }
    let honest = hand.frame(8);
    hand.socket.send(&honest, hand.client_address).unwrap();
    hand.clock.fetch_add(MS, Ordering::Relaxed);
    assert_eq!(hand.poll(), [8], "{}", hand.client.status());
    assert_eq!(hand.client.counters().packets.foreign_source, 150);
    assert!(hand.client.status().contains("flooded"), "{}", hand.client.status());
}

#[test]
fn bursts_are_drained_to_the_newest_within_a_few_polls() {
    // T15: fifty frames at once, and a backlog of seconds.
    let mut hand = ByHand::new(LOCALHOST);
    for n in 1..=50 {
        let bytes = hand.frame(n);
        hand.socket.send(&bytes, hand.client_address).unwrap();
    }
    let got = hand.poll();
    // Without a clock each frame of a burst carries its own arrival; all arrive in this one virtual instant, so one is used and
    // the rest count as late. The backlog is gone either way.
    assert!(!got.is_empty());
    let c = hand.client.counters().packets;
    assert!(c.used >= 20);
    let mut polls = 1;
    while hand.client.counters().packets.used < 51 {
        hand.poll();
        polls += 1;
        assert!(polls < 10);
    }
}

#[test]
fn rates_may_change_under_way() {
    // T15: 500, 100, 2,000 Hz; the client is told nothing.
    let mut bench = Bench::new("", |s| s.streaming = Streaming::Unicast(UnicastTo::CommandSocket), |_| {});
    bench.run(MS, S);
    for (hz, sequence) in [(100, 1u64), (2000, 2)] {
        bench.samples.clear();
        let from = bench.now();
        let config = MockTrackerConfig {
            rate: dpm_device::time::FrameRate::new(hz, 1).unwrap(),
            start: from,
            seed: sequence,
            ..Default::default()
        };
        let motions = vec![
            Motion::new(&MotionSpec::paper_translation(), Pose::IDENTITY).unwrap(),
            Motion::new(&MotionSpec::Still {}, Pose::IDENTITY).unwrap(),
        ];
        let mut server = NatNetServerConfig::new(&["Hare", "Bust"]);
        server.streaming = Streaming::Unicast(UnicastTo::CommandSocket);
        bench.server = NatNetServer::new(server, SampleSource::new(config, motions).unwrap()).unwrap();
        bench.run(MS / 4, from.0 + 4 * S);
        // Connected anew within a second or so, then every sample, each once, in order, none older than its latency.
        let last_second: Vec<_> = bench
            .samples
            .iter()
            .filter(|s| s.body == BodyIndex(0) && s.received_at.0 > from.0 + 3 * S)
            .collect();
        let n = last_second.len() as i64;
        assert!((n - i64::from(hz)).abs() <= 2, "{n} at {hz} Hz: {}", bench.client.status());
        assert!(last_second.iter().all(|s| s.received_at.0 - s.captured_at.0 < 4 * MS));
    }
}

#[test]
fn garbage_of_every_length_is_survived() {
    // T13, N2: random bytes behind a frame header, and datagrams as long as they come.
    let mut hand = ByHand::new(LOCALHOST);
    let mut state = 1u64;
    for n in 0..400usize {
        let len = if n % 100 == 99 { 65_507 } else { n * 7 % 1500 };
        let mut bytes: Vec<u8> = (0..len)
            .map(|_| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                (state >> 56) as u8
            })
            .collect();
        if len >= 4 {
            bytes[..2].copy_from_slice(&[[7, 5, 1, 13][n % 4], 0]);
            bytes[2..4].copy_from_slice(&((len - 4) as u16).to_le_bytes());
        }
        hand.socket.send(&bytes, hand.client_address).unwrap();
        hand.poll();
    }
    let c = *hand.client.counters();
    assert!(c.packets.malformed + c.packets.unsupported > 350, "{c}");
    let honest = hand.frame(3);
    hand.socket.send(&honest, hand.client_address).unwrap();
    hand.poll();
    hand.poll();
    assert_eq!(hand.client.counters().samples.used, 1, "{}", hand.client.status());
}

/// Found in use, C7: a server that announces 4.1 and sends the layout of 4.0 cost 70 % of the samples, because each answer to a
/// connection turned the layout back. All pairs of versions, with the names in either of the two layouts.
#[test]
fn a_server_that_sends_another_layout_than_it_announces_costs_no_samples() {
    let versions = [Version::V3_0, Version::new(3, 1), Version::V4_0, Version::V4_1, Version::V4_2];
    for announced in versions {
        for sent in versions {
            for names in [announced, sent] {
                let what = format!("{announced} announced, frames of {sent}, names of {names}");
                let mut bench = Bench::new(
                    "",
                    |s| {
                        s.streaming = Streaming::Unicast(UnicastTo::CommandSocket);
                        (s.version, s.frame_layout, s.model_layout) = (announced, Some(sent), Some(names));
                    },
                    |_| {},
                );
                bench.run(MS / 2, 100 * MS);
                let before = bench.server.frames_sent();
                bench.samples.clear();
                bench.run(MS / 2, 2 * S);
                let sent_samples = 2 * (bench.server.frames_sent() - before);
                assert!(sent_samples > 1800, "{what}: {sent_samples}");
                let status = bench.client.status();
                assert!(bench.samples.len() as u64 * 100 >= sent_samples * 99, "{what}: {status}");
                let c = *bench.client.counters();
                assert_eq!((c.samples.unknown_body, c.packets.malformed), (0, 0), "{what}: {status}");
                assert_eq!(bench.client.models().len(), 2, "{what}: {status}");
                let differs = announced.has_section_sizes() != sent.has_section_sizes();
                assert_eq!(bench.client.contradicted(), differs.then_some(announced), "{what}: {status}");
                assert_eq!(status.contains("which is followed"), differs, "{what}: {status}");
                assert!(bench.worst_error() < 3e-3, "{what}: {}", bench.worst_error());
            }
        }
    }
}

/// Found in use, C7, its sibling: frames of NatNet 2, whatever was announced, are named as unreadable, and the server is not asked anew
/// for each of them.
#[test]
fn frames_of_a_layout_that_is_not_spoken_are_named() {
    let mut hand = ByHand::new(LOCALHOST);
    let mut buffer = [0; 2048];
    while hand.socket.receive(&mut buffer).unwrap().is_some() {}
    let mut connects = 0;
    for n in 0..500i32 {
        // NatNet 2.9: a rigid body of 32 bytes, no markers, error and parameters; a latency as f32 before the time code.
        let mut payload = n.to_le_bytes().to_vec();
        payload.extend([0i32, 0, 1, 1].iter().flat_map(|v| v.to_le_bytes()));
        payload.extend([0.1f32, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0].iter().flat_map(|v| v.to_le_bytes()));
        payload.extend([0u8; 4 + 4 + 2]);
        payload.extend([0u8; 4 + 4 + 4 + 4 + 8 + 8 + 2 + 4]);
        let mut datagram = 7u16.to_le_bytes().to_vec();
        datagram.extend((payload.len() as u16).to_le_bytes());
        datagram.extend(payload);
        hand.socket.send(&datagram, hand.client_address).unwrap();
        assert_eq!(hand.poll(), [] as [u32; 0]);
        while let Some(a) = hand.socket.receive(&mut buffer).unwrap() {
            connects += u32::from(a.len > 4 && buffer[0] == 0);
        }
    }
    assert_eq!(hand.client.silence(), Some(Silence::Unreadable));
    assert!(hand.client.status().contains("choose a bit stream from 3.0 to 4.2"), "{}", hand.client.status());
    assert!(connects <= 4, "{connects} connections in half a second");
}

/// Found in use, R14: frames, answers and farewells of another program at the server's own address were believed.
#[test]
fn only_the_servers_ports_are_heard() {
    let mut hand = ByHand::new(LOCALHOST);
    let stranger = UdpPort::bind(SocketAddrV4::new(LOCALHOST, 0), false).unwrap();
    let strange_port = stranger.local().unwrap().port();
    let mut honest = 0;
    let mut refused = 0;
    for n in 0..200 {
        let frame = hand.frame(n);
        hand.socket.send(&frame, hand.client_address).unwrap();
        // Each of these, were it believed, would put the body elsewhere, forget the server, rename the bodies, or move the clock.
        let forged: Vec<u8> = match n % 5 {
            0 => hand.frame(n + 1_000_000),
            1 => vec![9, 0, 0, 0],
            2 => {
                let info = ServerInfo {
                    name: "forged".into(),
                    app_version: [0; 4],
                    natnet_version: [3, 0, 0, 0],
                    clock_hz: 1,
                    data_port: strange_port,
                    multicast: None,
                };
                info.encode(&mut hand.out);
                hand.out.clone()
            }
            3 => {
                let definition = BodyDefinition { name: "a", id: 77, markers: &[] };
                encode_models(&mut hand.out, Version::V4_1, &[definition]).unwrap();
                hand.out.clone()
            }
            _ => vec![10, 0, 0, 0],
        };
        stranger.send(&forged, hand.client_address).unwrap();
        refused += 1;
        honest += hand.poll().iter().filter(|s| **s == n as u32).count();
        assert_eq!(hand.client.server().map(|s| s.name.as_str()), Some("by hand"));
    }
    let c = *hand.client.counters();
    assert_eq!((honest, c.samples.used, c.packets.foreign_port), (200, 200, refused), "{c}");
    let status = hand.client.status();
    assert!(status.contains("WARNING") && status.contains(&strange_port.to_string()), "{status}");
}

/// Found in use, R14: where frames come from a port that nobody named, it is learned, held while it speaks, and given up for the
/// command port at once and for another one after a second of silence.
#[test]
fn a_data_port_that_nobody_named_is_learned_and_held() {
    let mut hand = ByHand::new(LOCALHOST);
    let [a, b] = [0, 0].map(|port| UdpPort::bind(SocketAddrV4::new(LOCALHOST, port), false).unwrap());
    let mut number = 0;
    let mut turn = |hand: &mut ByHand, port: Option<&UdpPort>| {
        number += 1;
        let frame = hand.frame(number);
        port.unwrap_or(&hand.socket).send(&frame, hand.client_address).unwrap();
        hand.poll().len()
    };
    // For 300 ms the named ports have the first word.
    assert_eq!((0..290).map(|_| turn(&mut hand, Some(&a))).sum::<usize>(), 0);
    let used = (0..100).map(|_| turn(&mut hand, Some(&a))).sum::<usize>();
    assert!(used >= 80, "{used}: {}", hand.client.status());
    // Held against another port, however often it tries.
    let used = (0..500).map(|_| (turn(&mut hand, Some(&b)), turn(&mut hand, Some(&a))));
    let (from_b, from_a) = used.fold((0, 0), |s, u| (s.0 + u.0, s.1 + u.1));
    assert_eq!((from_b, from_a), (0, 500));
    // Silent for a second: the other one takes its place.
    let used = (0..1500).map(|_| turn(&mut hand, Some(&b))).collect::<Vec<_>>();
    assert!(used[..990].iter().sum::<usize>() == 0 && used[1010..].iter().all(|n| *n == 1));
    // The command port needs no learning, and while it sends frames no other port does.
    let used = (0..100).map(|_| (turn(&mut hand, None), turn(&mut hand, Some(&b))));
    let (named, learned) = used.fold((0, 0), |s, u| (s.0 + u.0, s.1 + u.1));
    assert_eq!((named, learned), (100, 0), "{}", hand.client.status());
}

/// Found in use, R14: a flood from another port of the server's address is dropped by the kernel, and the server is still heard.
#[test]
fn a_flood_from_another_port_of_the_server_does_not_drown_it() {
    let mut hand = ByHand::new(LOCALHOST);
    let stranger = UdpPort::bind(SocketAddrV4::new(LOCALHOST, 0), false).unwrap();
    let forged = hand.frame(7);
    for _ in 0..150 {
        stranger.send(&forged, hand.client_address).unwrap();
    }
    let begin = std::time::Instant::now();
    while hand.client.counters().packets.foreign_port < 150 {
        assert!(begin.elapsed().as_secs() < 20, "{:?}", hand.client.counters());
        assert_eq!(hand.poll(), [] as [u32; 0]);
    }
    for _ in 0..1000 {
        stranger.send(&forged, hand.client_address).unwrap();
    }
    let honest = hand.frame(8);
    hand.socket.send(&honest, hand.client_address).unwrap();
    assert_eq!(hand.poll(), [8], "{}", hand.client.status());
    assert_eq!(hand.client.counters().packets.foreign_port, 150);
    // After the server fell silent it is looked for without the filter, for when it comes back it may send from other ports.
    hand.clock.fetch_add(3 * S, Ordering::Relaxed);
    // A client that did not listen for so long reads what waits first, and knows at the next poll that nothing did.
    hand.poll();
    hand.poll();
    let before = hand.client.counters().packets.received;
    stranger.send(&forged, hand.client_address).unwrap();
    hand.poll();
    assert_eq!(hand.client.counters().packets.received, before + 1, "{}", hand.client.status());
}
