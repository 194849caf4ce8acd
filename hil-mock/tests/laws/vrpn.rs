//! The VRPN client against the VRPN server over loopback, in real time, and against bytes that lie.

use dpm_device::pose::Pose;
use dpm_device::time::{HostClock, HostTime};
use dpm_device::tracker::vrpn::client::{VrpnClient, VrpnConfig};
use dpm_device::tracker::vrpn::wire::{self, system, Message, COOKIE};
use dpm_device::tracker::{BodyIndex, BodyKey, Tracker, TrackerSample};
use hil_mock::motion::{Motion, MotionSpec};
use hil_mock::tracker::{MockTrackerConfig, SampleSource};
use hil_mock::vrpn_host::VrpnHost;
use hil_mock::vrpn_server::{VrpnConnection, VrpnNames, VrpnReports};
use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddrV4, TcpListener, TcpStream, UdpSocket};
use std::sync::Arc;
use std::time::{Duration, Instant};

const MS: i64 = 1_000_000;
const ANY: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0);

fn clock() -> Arc<dyn HostClock> {
    let epoch = Instant::now();
    Arc::new(move || HostTime(epoch.elapsed().as_nanos() as i64))
}

fn source(faults: &str) -> SampleSource {
    let rest = Pose { position_m: [0.1, 0.2, 1.5], ..Pose::IDENTITY };
    let motions = vec![
        Motion::new(&MotionSpec::paper_translation(), rest).unwrap(),
        Motion::new(&MotionSpec::Still {}, rest).unwrap(),
    ];
    let config = MockTrackerConfig { faults: faults.parse().unwrap(), latency_ns: MS, ..Default::default() };
    SampleSource::new(config, motions).unwrap()
}

fn names() -> VrpnNames {
    VrpnNames { tracker: "Tracker0".into(), bodies: vec!["Hare".into(), "Bust".into()], each_body: true }
}

fn client(server: String, tracker: &str, bodies: &[&str], clock: Arc<dyn HostClock>) -> VrpnClient {
    let bodies = bodies.iter().map(|n| BodyKey { name: (*n).to_owned(), id: None }).collect();
    VrpnClient::open(VrpnConfig { server, tracker: tracker.into(), bodies }, clock).unwrap()
}

fn run(client: &mut VrpnClient, clock: &dyn HostClock, ms: u64) -> Vec<TrackerSample> {
    let mut samples = Vec::new();
    let end = Instant::now() + Duration::from_millis(ms);
    while Instant::now() < end {
        client.poll(clock.now(), &mut |s| samples.push(*s)).unwrap();
        assert!(client.counters().is_conserved());
        std::thread::sleep(Duration::from_micros(200));
    }
    samples
}

#[test]
fn poses_and_times_come_through_under_both_namings() {
    let clock = clock();
    let host = VrpnHost::start(names(), VrpnReports::new(source("")).unwrap(), ANY, clock.clone()).unwrap();
    let truth = source("");
    // Once as sensors of one tracker, once as trackers named like the bodies (in another order).
    for (tracker, bodies) in [("Tracker0", ["Left", "Right"]), ("Elsewhere", ["Bust", "Hare"])] {
        let mut client = client(host.address().to_string(), tracker, &bodies, clock.clone());
        let samples = run(&mut client, &*clock, 900);
        assert!(client.is_connected(), "{}", client.status());
        assert!(client.status().contains("clock by pings"), "{}", client.status());
        let moving = BodyIndex(u16::from(tracker == "Elsewhere"));
        let of_body: Vec<_> = samples.iter().filter(|s| s.body == moving).collect();
        assert!(of_body.len() > 250, "{tracker}: {} samples, {}", of_body.len(), client.status());
        assert!(of_body.windows(2).all(|w| w[0].captured_at < w[1].captured_at));
        // The first samples came before the clock was known.
        let mut errors: Vec<f64> = of_body[100..]
            .iter()
            .map(|s| {
                let p = truth.true_pose(BodyIndex(0), s.captured_at.0).unwrap().position_m;
                (p[0] - s.pose.position_m[0]).abs()
            })
            .collect();
        errors.sort_by(f64::total_cmp);
        // At 1 m/s a metre of error is a second: half of the samples within 0.3 ms, on a machine shared with other tests.
        assert!(errors[errors.len() / 2] < 3e-4, "{tracker}: {}", errors[errors.len() / 2]);
    }
    drop(host);
}

#[test]
fn an_unplugged_server_is_found_again() {
    let clock = clock();
    let reports = VrpnReports::new(source("unplug@300ms+300ms,corrupt=0.01")).unwrap();
    let host = VrpnHost::start(names(), reports, ANY, clock.clone()).unwrap();
    let mut client = client(host.address().to_string(), "Tracker0", &["a", "b"], clock.clone());
    let samples = run(&mut client, &*clock, 1900);
    assert!(samples.iter().any(|s| s.received_at.0 < 300 * MS));
    assert!(!samples.iter().any(|s| (320 * MS..600 * MS).contains(&s.received_at.0)));
    let back = samples.iter().find(|s| s.received_at.0 > 600 * MS).expect("picture back");
    assert!(back.received_at.0 < 1800 * MS, "{}", back.received_at.0);
    assert!(host.is_running());
}

#[test]
fn the_server_calls_back_and_survives_rude_clients() {
    let clock = clock();
    let host = VrpnHost::start(names(), VrpnReports::new(source("")).unwrap(), ANY, clock.clone()).unwrap();
    // The older way of connecting: by UDP, asking to be called.
    let listener = TcpListener::bind(ANY).unwrap();
    let call = UdpSocket::bind(ANY).unwrap();
    let text = format!("127.0.0.1 {}\0", listener.local_addr().unwrap().port());
    call.send_to(text.as_bytes(), host.address()).unwrap();
    let (mut stream, _) = listener.accept().unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
    let mut greeting = [0; 24];
    stream.read_exact(&mut greeting).unwrap();
    assert_eq!(greeting, COOKIE);
    // N3 to N5: half greetings, nonsense, a length of 4 GiB, and many of them; the honest client still gets its poses.
    stream.write_all(&COOKIE).unwrap();
    for i in 0..100 {
        let mut rude = TcpStream::connect(host.address()).unwrap();
        let bytes: &[u8] = match i % 4 {
            0 => b"vrpn",
            1 => b"GET / HTTP/1.0\r\n\r\n       ",
            2 => &[COOKIE.as_slice(), &[0xff; 8]].concat(),
            _ => b"",
        };
        let _ = rude.write_all(bytes);
    }
    let mut seen = vec![0; 24 * 1024];
    stream.read_exact(&mut seen).unwrap();
    let mut at = 0;
    let mut poses = 0;
    while let Ok(Some((message, used))) = wire::split(&seen[at..]) {
        poses += usize::from(message.kind == 0);
        at += used;
    }
    assert!(poses > 200, "{poses}");
    assert!(host.is_running());
}

#[test]
fn a_lying_server_is_left_and_reported() {
    let clock = clock();
    for bytes in [&b"SSH-2.0-OpenSSH_9.2p1 Debian"[..], b"vrpn: ver. 06.99  0\0\0\0\0\0"] {
        let listener = TcpListener::bind(ANY).unwrap();
        let mut client =
            client(listener.local_addr().unwrap().to_string(), "Tracker0", &["a"], clock.clone());
        client.poll(clock.now(), &mut |_| {}).unwrap();
        let (mut stream, _) = listener.accept().unwrap();
        stream.write_all(bytes).unwrap();
        run(&mut client, &*clock, 100);
        assert!(!client.is_connected());
        assert!(client.status().contains("VRPN"), "{}", client.status());
    }
    // Greeted, then a length that no message has.
    let listener = TcpListener::bind(ANY).unwrap();
    let mut client = client(listener.local_addr().unwrap().to_string(), "Tracker0", &["a"], clock.clone());
    client.poll(clock.now(), &mut |_| {}).unwrap();
    let (mut stream, _) = listener.accept().unwrap();
    stream.write_all(&COOKIE).unwrap();
    stream.write_all(&[0xff; 16]).unwrap();
    run(&mut client, &*clock, 100);
    assert_eq!(client.counters().packets.malformed, 1, "{}", client.status());
}

#[test]
fn pings_are_answered_under_the_server_s_own_numbers() {
    let names = names();
    let mut out = Vec::new();
    let mut connection = VrpnConnection::new(&names, &mut out);
    let greeting = out.len();
    let mut bytes = COOKIE.to_vec();
    // The client numbers the bust's tracker 5 and the ping 7.
    wire::put_description(&mut bytes, system::SENDER, 5, "Bust");
    wire::put_description(&mut bytes, system::TYPE, 7, wire::type_name::PING);
    let ping = Message { seconds: 0, microseconds: 0, sender: 5, kind: 7, sequence: 0, payload: &[] };
    wire::put(&mut bytes, &ping);
    wire::put(&mut bytes, &Message { sender: 4, ..ping });
    // Byte by byte: boundaries must not matter.
    for b in &bytes {
        connection.on_bytes(&names, &[*b], 3_000_004, &mut out).unwrap();
    }
    assert_eq!(connection.pongs(), 1);
    let (pong, used) = wire::split(&out[greeting..]).unwrap().unwrap();
    assert_eq!((pong.seconds, pong.microseconds, pong.sender, pong.kind), (3, 4, 2, 2));
    assert_eq!(out.len(), greeting + used);
}
