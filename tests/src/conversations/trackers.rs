//! Trackers: each client against any server, and each mock server against any client.

use super::{step, taken, Moved, Script, Step};
use dpm_device::pose::Pose;
use dpm_device::time::HostTime;
use dpm_device::tracker::natnet::client::{NatNetClient, NatNetConfig};
use dpm_device::tracker::natnet::frame::{encode_frame, FrameContent, FrameInfo, RigidBody};
use dpm_device::tracker::natnet::messages as natnet;
use dpm_device::tracker::natnet::models::{encode_models, BodyDefinition};
use dpm_device::tracker::natnet::wire::{begin, finish, id, split};
use dpm_device::tracker::natnet::Version;
use dpm_device::tracker::serial::client::{SerialTracker, SerialTrackerConfig};
use dpm_device::tracker::serial::wire::{SerialMessage, VERSION};
use dpm_device::tracker::udp::{Arrival, Datagrams};
use dpm_device::tracker::vrpn::client::{VrpnClient, VrpnConfig};
use dpm_device::tracker::vrpn::wire as vrpn;
use dpm_device::tracker::{BodyKey, Stream, Tracker, TrackerCounters, TrackerSample};
use hil_mock::motion::{Motion, MotionSpec};
use hil_mock::natnet_server::{NatNetServer, NatNetServerConfig, Streaming, UnicastTo};
use hil_mock::serial_server::SerialPoseDevice;
use hil_mock::tracker::{MockTrackerConfig, SampleSource};
use hil_mock::vrpn_server::{VrpnConnection, VrpnNames, VrpnReports};
use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::sync::{Arc, Mutex};

/// When every conversation begins: not at zero, so that an instant before it exists.
pub(super) const BEGIN_NS: i64 = 10_000_000_000;

fn bodies() -> Vec<BodyKey> {
    vec![BodyKey { name: "hare".into(), id: None }, BodyKey { name: "bust".into(), id: Some(2) }]
}

fn source() -> SampleSource {
    let still = || Motion::new(&MotionSpec::Still {}, Pose::IDENTITY).expect("a motion");
    let config = MockTrackerConfig { start: HostTime(BEGIN_NS), ..MockTrackerConfig::default() };
    SampleSource::new(config, vec![still(), still()]).expect("a source")
}

/// What holds for the samples of every tracker, whatever it hears.
#[derive(Default)]
struct Laws {
    delivered: u64,
    last: [Option<TrackerSample>; 2],
}

impl Laws {
    fn hold(&mut self, s: &TrackerSample, now: HostTime) {
        self.delivered += 1;
        let last = &mut self.last[usize::from(s.body.0)];
        assert!(s.captured_at <= now && s.received_at <= now, "from the future: {s:?} at {now:?}");
        let number = |p: &Pose| p.position_m.iter().chain(&p.rotation_xyzw).all(|v| v.is_finite());
        assert!(number(&s.pose), "{s:?}");
        *last = Some(*s);
    }

    fn end(&self, counters: &TrackerCounters, status: &str) {
        assert!(counters.is_conserved(), "{counters:?}");
        assert_eq!(counters.samples.used, self.delivered);
        assert!(status.len() < 20_000, "{} bytes of status", status.len());
    }
}

#[derive(Default)]
struct Line {
    to_client: VecDeque<u8>,
    from_client: Vec<u8>,
    is_closed: bool,
}

/// A connection in memory, whose far end is the test.
#[derive(Clone, Default)]
pub(super) struct Memory(Arc<Mutex<Line>>);

impl Memory {
    pub(super) fn say(&self, bytes: &[u8]) {
        self.0.lock().expect("no panic").to_client.extend(bytes);
    }

    pub(super) fn heard(&self) -> Vec<u8> {
        std::mem::take(&mut self.0.lock().expect("no panic").from_client)
    }

    fn close(&self) {
        self.0.lock().expect("no panic").is_closed = true;
    }
}

impl Stream for Memory {}

impl Read for Memory {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let mut inside = self.0.lock().expect("no panic");
        match inside.to_client.read(into)? {
            0 if inside.is_closed => Ok(0),
            0 => Err(io::ErrorKind::WouldBlock.into()),
            n => Ok(n),
        }
    }
}

impl Write for Memory {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().expect("no panic").from_client.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

const VERSIONS: [Version; 5] =
    [Version::V3_0, Version::new(3, 1), Version::V4_0, Version::V4_1, Version::V4_2];

/// A socket in memory, whose far end is the test. One of the system takes a hundred times as long to open as a
/// conversation takes, and its port is another one in every run.
#[derive(Clone, Default)]
struct MemoryPort(Arc<Mutex<Waiting>>);

#[derive(Default)]
struct Waiting {
    arrived: VecDeque<(Vec<u8>, SocketAddrV4)>,
    sent: Vec<(Vec<u8>, SocketAddrV4)>,
    only: Option<(Ipv4Addr, Vec<u16>)>,
}

impl MemoryPort {
    /// The port of every client.
    const LOCAL: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 4000);

    fn say(&self, datagram: &[u8], from: SocketAddrV4) {
        let mut inside = self.0.lock().expect("no panic");
        let is_kept = inside.only.as_ref().is_none_or(|(source, ports)| {
            from.ip() == source && (ports.is_empty() || ports.contains(&from.port()))
        });
        if is_kept {
            inside.arrived.push_back((datagram.to_vec(), from));
        }
    }

    fn heard(&self) -> Vec<(Vec<u8>, SocketAddrV4)> {
        std::mem::take(&mut self.0.lock().expect("no panic").sent)
    }
}

impl Datagrams for MemoryPort {
    fn receive(&self, buffer: &mut [u8]) -> io::Result<Option<Arrival>> {
        let Some((datagram, from)) = self.0.lock().expect("no panic").arrived.pop_front() else {
            return Ok(None);
        };
        let len = datagram.len().min(buffer.len());
        buffer[..len].copy_from_slice(&datagram[..len]);
        Ok(Some(Arrival { len, from, kernel_ns: None, cut: len < datagram.len() }))
    }

    fn send(&self, bytes: &[u8], to: SocketAddrV4) -> io::Result<()> {
        self.0.lock().expect("no panic").sent.push((bytes.to_vec(), to));
        Ok(())
    }

    fn keep_only(&self, source: Ipv4Addr, ports: &[u16]) -> io::Result<()> {
        self.0.lock().expect("no panic").only = Some((source, ports.to_vec()));
        Ok(())
    }

    fn keep_all(&self) -> io::Result<()> {
        self.0.lock().expect("no panic").only = None;
        Ok(())
    }

    fn local(&self) -> io::Result<SocketAddrV4> {
        Ok(Self::LOCAL)
    }
}

/// The datagram of a step, for a client whose newest echo request has `stamp`.
fn natnet_answer(step: &Step<'_>, stamp: u64, out: &mut Vec<u8>) {
    let mut rest = step.bytes;
    let version = VERSIONS[usize::from(step.how) % 5];
    match step.what % 8 {
        // Any message: its number and its length are right.
        0 => {
            begin(out, u16::from(step.how % 16));
            out.extend_from_slice(rest);
            finish(out).expect("2047 bytes");
        }
        1 => {
            natnet::encode_echo_response(out, stamp, u64::from_le_bytes(taken(&mut rest)));
        }
        2 => {
            let [major, minor, flags] = taken(&mut rest);
            let info = natnet::ServerInfo {
                name: "any".into(),
                app_version: [1, 0, 0, 0],
                natnet_version: [3 + major % 3, minor % 4, 0, 0],
                clock_hz: u64::from_le_bytes(taken(&mut rest)),
                data_port: u16::from_le_bytes(taken(&mut rest)),
                multicast: (flags & 1 != 0).then_some([239, 255, 42, 99]),
            };
            info.encode(out);
        }
        3 => {
            let [a, b] = taken::<2>(&mut rest).map(|n| i32::from(n) % 4);
            let named = [
                BodyDefinition { name: "hare", id: a, markers: &[[0.0; 3]; 2] },
                BodyDefinition { name: "bust", id: b, markers: &[] },
            ];
            encode_models(out, version, &named).expect("a short message");
        }
        // A frame whose numbers are the step's.
        4 | 5 => {
            let info = FrameInfo {
                number: i32::from_le_bytes(taken(&mut rest)),
                mid_exposure: u64::from_le_bytes(taken(&mut rest)),
                transmit: u64::from_le_bytes(taken(&mut rest)),
                params: u16::from_le_bytes(taken(&mut rest)),
                ..FrameInfo::default()
            };
            let mut list = Vec::new();
            while !rest.is_empty() {
                let [body, x, turn] = taken(&mut rest);
                let a = f32::from(turn) / 40.0;
                list.push(RigidBody {
                    id: i32::from(body % 4),
                    position: [f32::from_bits(u32::from(x) << 23), 0.2, 0.3],
                    rotation_xyzw: [a.sin(), 0.0, 0.0, a.cos()],
                    mean_error: 0.001,
                    params: u16::from(body >> 4),
                });
            }
            encode_frame(out, version, &info, &FrameContent { bodies: &list, ..FrameContent::default() })
                .expect("a short message");
        }
        // A text, and the answer to the request for a bit stream.
        6 => {
            begin(out, if step.how & 1 == 0 { id::MESSAGE_STRING } else { id::RESPONSE });
            out.extend_from_slice(if step.how & 2 == 0 { &[0; 4] } else { rest });
            finish(out).expect("2047 bytes");
        }
        _ => {
            out.clear();
            out.extend_from_slice(rest);
        }
    }
}

/// A NatNet client and any server, in memory. The stamps of the client's echo requests are patched into the answers.
pub fn natnet_client(bytes: &[u8]) {
    // The command port of the server, and a port of a stranger on the same machine.
    let server = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 1510);
    let stranger = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 2000);
    let clock = Moved::at(BEGIN_NS);
    let config = NatNetConfig {
        local: Ipv4Addr::LOCALHOST,
        command_port: server.port(),
        data_port: 0,
        bitstream: bytes.first().filter(|b| **b & 1 != 0).map(|_| Version::V4_1),
        kernel_stamps: false,
        ..NatNetConfig::unicast(Ipv4Addr::LOCALHOST, bodies())
    };
    let port = MemoryPort::default();
    let data: Box<dyn Datagrams> = Box::new(MemoryPort::default());
    let mut client = NatNetClient::with_ports(config, clock.clone(), Box::new(port.clone()), Some(data));
    let (mut laws, mut stamp, mut datagram) = (Laws::default(), 0, Vec::new());
    for step in Script(bytes) {
        natnet_answer(&step, stamp, &mut datagram);
        // One of 32 comes from another port.
        port.say(&datagram, if step.how >> 3 == 31 { stranger } else { server });
        let now = clock.forward(step.wait_ns);
        let delivered = client.poll(now, &mut |s| laws.hold(s, now)).expect("ports in memory");
        assert!(delivered <= 2047 / 38);
        for (said, to) in port.heard() {
            assert_eq!(to, server);
            if let Ok((id::ECHO_REQUEST, payload)) = split(&said) {
                stamp = natnet::decode_echo_request(payload).expect("the client's own");
            }
        }
    }
    if let Some(map) = client.clock_map() {
        assert!(map.exchanges() > 0);
    }
    let _ = (client.silence(), client.warning(), client.contradicted());
    assert!(client.counters().packets.received <= Script(bytes).count() as u64);
    laws.end(client.counters(), &client.status());
}

/// A NatNet server and any clients: it answers where the question came from, once, and streams to a bounded number.
pub fn natnet_server(bytes: &[u8]) {
    let mut config = NatNetServerConfig::new(&["hare", "bust"]);
    let [how] = taken(&mut &*bytes);
    config.version = VERSIONS[usize::from(how) % 5];
    config.streaming = match how >> 6 {
        0 => Streaming::Multicast(Ipv4Addr::new(239, 255, 42, 99)),
        1 => Streaming::Unicast(UnicastTo::CommandSocket),
        2 => Streaming::Unicast(UnicastTo::DataPort),
        _ => Streaming::Unicast(UnicastTo::Both),
    };
    let mut server = NatNetServer::new(config, source()).expect("a server");
    let mut now = HostTime(BEGIN_NS);
    let mut datagram = Vec::new();
    for step in Script(bytes) {
        let mut rest = step.bytes;
        match step.what % 8 {
            0 => {
                begin(&mut datagram, u16::from(step.how % 16));
                datagram.extend_from_slice(rest);
                finish(&mut datagram).expect("2047 bytes");
            }
            1 => {
                let [which] = taken::<1>(&mut rest);
                let bitstream = (which & 1 != 0).then_some(VERSIONS[usize::from(which >> 1) % 5]);
                natnet::Connect { name: "any".into(), bitstream }.encode(&mut datagram);
            }
            2 => natnet::encode_echo_request(&mut datagram, u64::from_le_bytes(taken(&mut rest))),
            3 => match std::str::from_utf8(rest) {
                Ok(text) => natnet::encode_request(&mut datagram, text),
                Err(_) => continue,
            },
            4 => natnet::encode_empty(&mut datagram, u16::from(step.how % 16)),
            5 => {
                let [which] = taken::<1>(&mut rest);
                natnet::encode_request(
                    &mut datagram,
                    &format!("Bitstream,{}", VERSIONS[usize::from(which) % 5]),
                );
            }
            _ => {
                datagram.clear();
                datagram.extend_from_slice(rest);
            }
        }
        let from = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 2000 + u16::from(step.how >> 2));
        let mut answers = 0;
        server.on_datagram(&datagram, from, now, &mut |answer, to| {
            answers += 1;
            assert!(to == from && answer.len() < 2000);
            split(answer).expect("its own message");
        });
        assert!(answers <= 1);
        // Not every wait of seconds is simulated frame by frame.
        now = now.plus_ns(step.wait_ns.min(20_000_000));
        server.stream(now, &mut |frame, _| {
            split(frame).expect("its own frame");
        });
        if step.wait_ns > 5_000_000_000 {
            now = now.plus_ns(NatNetServer::CLIENT_TIMEOUT_NS);
            // Of what is captured in these seconds only what is still under way then is sent.
            server.begin_at(now);
            server.stream(now, &mut |_, _| {});
            assert!(server.client_count() == 0 || how >> 6 == 0);
        }
        assert!(server.client_count() <= NatNetServer::MAX_CLIENTS);
    }
}

/// The server of the conversation with a VRPN client says this.
fn vrpn_answer(step: &Step<'_>, out: &mut Vec<u8>) {
    let mut rest = step.bytes;
    match step.what % 8 {
        0 => out.extend_from_slice(&vrpn::COOKIE),
        1 => {
            let names =
                [vrpn::type_name::POS_QUAT, vrpn::type_name::PONG, vrpn::type_name::PING, "vrpn_Text"];
            let [number] = taken::<1>(&mut rest);
            vrpn::put_description(
                out,
                vrpn::system::TYPE,
                i32::from(number),
                names[usize::from(step.how % 4)],
            );
        }
        2 => {
            let names = ["Tracker0", "hare", "bust", "lamp"];
            let [number] = taken::<1>(&mut rest);
            vrpn::put_description(
                out,
                vrpn::system::SENDER,
                i32::from(number),
                names[usize::from(step.how % 4)],
            );
        }
        kind @ 3..=6 => {
            let [sender, number, sensor] = taken(&mut rest);
            let (seconds, microseconds) =
                (u32::from_le_bytes(taken(&mut rest)), u32::from_le_bytes(taken(&mut rest)));
            let a = f64::from(sensor) / 40.0;
            let pose = Pose { position_m: [a, 0.0, 1.0], rotation_xyzw: [a.sin(), 0.0, 0.0, a.cos()] };
            let pose = vrpn::encode_pos_quat(i32::from(sensor % 3), &pose);
            let payload = if kind == 3 {
                rest
            } else if kind == 4 {
                &[]
            } else {
                &pose[..]
            };
            // System messages have numbers below 0.
            let kind = if step.how & 0x80 != 0 { -i32::from(number % 8) } else { i32::from(number) };
            let sender = i32::from(sender) - i32::from(step.how & 0x40);
            vrpn::put(out, &vrpn::Message { seconds, microseconds, sender, kind, sequence: 1, payload });
        }
        _ => out.extend_from_slice(rest),
    }
}

/// A VRPN client and any server, in memory.
pub fn vrpn_client(bytes: &[u8]) {
    let clock = Moved::at(BEGIN_NS);
    let line = Memory::default();
    // It has no address to try again at.
    let config = VrpnConfig { server: "127.0.0.1:1".into(), tracker: "Tracker0".into(), bodies: bodies() };
    let mut client = VrpnClient::over(config, clock.clone(), Box::new(line.clone())).expect("a client");
    let (mut laws, mut said) = (Laws::default(), Vec::new());
    if bytes.first().is_some_and(|b| b & 8 != 0) {
        said.extend_from_slice(&vrpn::COOKIE);
    }
    for step in Script(bytes) {
        vrpn_answer(&step, &mut said);
        // Some messages arrive in pieces.
        let now = if step.how & 0x20 != 0 { said.len() / 2 } else { said.len() };
        line.say(&said[..now]);
        said.drain(..now);
        let now = clock.forward(step.wait_ns);
        client.poll(now, &mut |s| laws.hold(s, now)).expect("a connection that ends is no error");
        assert!(line.heard().len() < 4096);
        if step.what == 0xff {
            line.close();
        }
        if matches!(client.status(), s if s.starts_with("not connected")) {
            break;
        }
    }
    laws.end(client.counters(), &client.status());
}

/// A VRPN server and any client: names, pings, reports in between.
pub fn vrpn_server(bytes: &[u8]) {
    let names = VrpnNames {
        tracker: "Tracker0".into(),
        bodies: vec!["hare".into(), "bust".into()],
        each_body: bytes.first().is_some_and(|b| b & 8 != 0),
    };
    let mut reports = VrpnReports::new(source()).expect("no faults");
    let (mut out, mut said, mut now) = (Vec::new(), Vec::new(), HostTime(BEGIN_NS));
    let mut connection = VrpnConnection::new(&names, &mut out);
    if bytes.first().is_some_and(|b| b & 16 == 0) {
        said.extend_from_slice(&vrpn::COOKIE);
    }
    let mut heard = 0;
    for step in Script(bytes) {
        vrpn_answer(&step, &mut said);
        let cut = if step.how & 0x20 != 0 { said.len() / 2 } else { said.len() };
        now = now.plus_ns(step.wait_ns.min(20_000_000));
        heard += cut;
        if connection.on_bytes(&names, &said[..cut], (now.0 / 1000) as u64, &mut out).is_err() {
            break;
        }
        said.drain(..cut);
        for k in reports.take_due(now) {
            if connection.is_greeted() {
                reports.put_report(k, &names, &mut connection, &|t| (t.0 / 1000) as u64, &mut out);
            }
        }
    }
    assert!(connection.pongs() <= heard as u64 / 24);
    let mut rest = &out[vrpn::COOKIE_BYTES..];
    while let Some((_, used)) = vrpn::split(rest).expect("its own messages") {
        rest = &rest[used..];
    }
    assert!(rest.is_empty());
}

/// A serial tracker and any device, in memory. Checksums are right, and so are the tokens of the tracker's echo
/// requests.
pub fn serial_client(bytes: &[u8]) {
    let clock = Moved::at(BEGIN_NS);
    let line = Memory::default();
    let config = SerialTrackerConfig { port: "/nonexistent".into(), baud: 115_200, bodies: bodies() };
    let mut tracker = SerialTracker::over(config, clock.clone(), Box::new(line.clone())).expect("a tracker");
    let (mut laws, mut said, mut token) = (Laws::default(), Vec::new(), 0u64);
    let mut deframer = dpm_device::cobs::Deframer::new([0u8; 256]);
    for step in Script(bytes) {
        let mut rest = step.bytes;
        match step.what % 6 {
            0 => SerialMessage::Hello {
                version: if step.how & 0x80 == 0 { VERSION } else { step.how },
                bodies: 2,
                ticks_per_second: u32::from_le_bytes(taken(&mut rest)),
            }
            .encode(&mut said),
            1 => {
                let ticks = u64::from_le_bytes(taken(&mut rest));
                SerialMessage::EchoResponse { token, ticks }.encode(&mut said);
            }
            2 | 3 => {
                let [body, x, turn, error] = taken(&mut rest);
                let a = f32::from(turn) / 40.0;
                let pose = SerialMessage::Pose {
                    body: body % 4,
                    tracked: body & 8 == 0,
                    sequence: u32::from_le_bytes(taken(&mut rest)),
                    captured: u64::from_le_bytes(taken(&mut rest)),
                    position: [f32::from_bits(u32::from(x) << 23), 0.0, 1.0],
                    rotation_xyzw: [a.sin(), 0.0, 0.0, a.cos()],
                    mean_error: f32::from(error),
                };
                pose.encode(&mut said);
            }
            4 => SerialMessage::EchoRequest { token: 1 }.encode(&mut said),
            _ => said.extend_from_slice(rest),
        }
        if let (true, Some(byte)) = (step.how & 0x40 != 0, said.last_mut()) {
            *byte ^= step.how;
        }
        let cut = if step.how & 0x20 != 0 { said.len() / 2 } else { said.len() };
        line.say(&said[..cut]);
        said.drain(..cut);
        let now = clock.forward(step.wait_ns);
        tracker.poll(now, &mut |s| laws.hold(s, now)).expect("a port that fails is no error");
        deframer.push(&line.heard(), &mut |packet| match SerialMessage::decode(packet).expect("its own") {
            SerialMessage::EchoRequest { token: new } => token = new,
            SerialMessage::HelloRequest => {}
            other => panic!("a tracker says {other:?}"),
        });
    }
    laws.end(tracker.counters(), &tracker.status());
}

/// The serial device and any host.
pub fn serial_device(bytes: &[u8]) {
    let mut device = SerialPoseDevice::new(source()).expect("a device");
    let (mut now, mut asked, mut out) = (HostTime(BEGIN_NS), 0, Vec::new());
    let mut deframer = dpm_device::cobs::Deframer::new([0u8; 256]);
    let mut said = Vec::new();
    for step in Script(bytes) {
        let mut rest = step.bytes;
        match step.what % 4 {
            0 => SerialMessage::EchoRequest { token: u64::from_le_bytes(taken(&mut rest)) }.encode(&mut said),
            1 => SerialMessage::HelloRequest.encode(&mut said),
            2 => SerialMessage::EchoResponse { token: 1, ticks: u64::from_le_bytes(taken(&mut rest)) }
                .encode(&mut said),
            _ => said.extend_from_slice(rest),
        }
        asked += said.len();
        let cut = if step.how & 0x20 != 0 { said.len() / 2 } else { said.len() };
        device.on_bytes(&said[..cut], now, &mut out);
        said.drain(..cut);
        now = now.plus_ns(step.wait_ns.min(20_000_000));
        device.report(now, &mut out);
        deframer.push(&out, &mut |packet| {
            SerialMessage::decode(packet).expect("its own messages");
        });
        out.clear();
    }
    // A request has 14 bytes at least.
    assert!(device.echoes() <= asked as u64 / 10);
}

pub(super) fn recorded() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let mut seeds = Vec::new();
    // A NatNet server's frames to a client that connected, as they are on the wire.
    let mut server =
        NatNetServer::new(NatNetServerConfig::new(&["hare", "bust"]), source()).expect("a server");
    let from = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 2000);
    let (mut to_client, mut to_server) = (Vec::new(), Vec::new());
    let mut say = |kind: u8, server: &mut NatNetServer, datagram: &[u8], now: HostTime| {
        to_server.extend(step(kind, 0, 10, datagram));
        server.on_datagram(datagram, from, now, &mut |answer, _| to_client.extend(step(7, 3, 10, answer)));
        server.stream(now, &mut |frame, to| {
            if SocketAddr::V4(to) == SocketAddr::V4(from) {
                to_client.extend(step(7, 3, 10, frame));
            }
        });
    };
    let mut out = Vec::new();
    let mut now = HostTime(BEGIN_NS);
    natnet::Connect { name: String::new(), bitstream: Some(Version::V4_1) }.encode(&mut out);
    say(7, &mut server, &out, now);
    for message in [id::CONNECT, id::REQUEST_MODEL_DEF, id::KEEP_ALIVE, id::REQUEST_FRAME, id::DISCONNECT] {
        natnet::encode_empty(&mut out, message);
        now = now.plus_ns(3_000_000);
        say(7, &mut server, &out, now);
    }
    let info =
        step(2, 0, 10, &[&[1, 1, 0][..], &10_000_000u64.to_le_bytes(), &1511u16.to_le_bytes()].concat());
    let names = step(3, 3, 10, &[1, 2]);
    let frame = |number: u8, ticks: u64, how: u8| {
        let stamps = [ticks.to_le_bytes(), (ticks + 20_000).to_le_bytes()].concat();
        step(
            4,
            how,
            12,
            &[&[number, 0, 0, 0][..], &stamps, &[0, 0], &[0x11, 126, number], &[0x12, 125, 3]].concat(),
        )
    };
    let echo = |ticks: u64| step(1, 0, 8, &ticks.to_le_bytes());
    let talk = [
        info,
        names,
        echo(100_000),
        frame(1, 200_000, 3),
        echo(300_000),
        frame(2, 350_000, 3),
        frame(3, 500_000, 0),
    ];
    seeds.push(("natnet_client", "frames", talk.concat()));
    seeds.push(("natnet_client", "recorded", to_client));
    seeds.push(("natnet_server", "recorded", to_server));
    let orders =
        [step(1, 4, 0, &[7]), step(2, 4, 30, &[1; 8]), step(5, 4, 30, &[1]), step(3, 4, 30, b"FrameRate\0")];
    seeds.push((
        "natnet_server",
        "orders",
        [orders.concat(), step(4, 4, 250, &[]), step(4, 9, 9, &[])].concat(),
    ));
    // VRPN: both sides of a connection that is greeted and pinged.
    let talk = |extra: &[Vec<u8>]| {
        let names = [
            step(8, 0, 10, &[]),
            step(1, 0, 10, &[0]),
            step(1, 1, 10, &[2]),
            step(1, 2, 10, &[1]),
            step(2, 0, 10, &[0]),
            step(2, 1, 10, &[1]),
        ];
        [names.concat(), extra.concat()].concat()
    };
    let pose = |stamp: u8| step(5, 0, 20, &[0, 0, stamp, 11, 0, 0, 0, stamp, 0, 0, 0]);
    let pong = |stamp: u8| step(4, 0, 20, &[0, 2, 0, 10, 0, 0, 0, stamp, 200, 0, 0]);
    seeds.push(("vrpn_client", "poses", talk(&[pose(1), pong(1), pose(2), pong(2), pose(3)])));
    let ping = step(4, 0, 20, &[0, 1, 0, 10, 0, 0, 0, 0, 0, 0, 0]);
    seeds.push(("vrpn_server", "pings", talk(&[ping.clone(), ping])));
    // Serial: hello, echoes, poses.
    let hello = step(0, 0, 10, &1_000_000u32.to_le_bytes());
    let echo = |ms: u64| step(1, 0, 10, &(ms * 1000).to_le_bytes());
    let pose = |n: u8, ms: u64| {
        step(2, 0, 20, &[&[0, 127, n, 0, n, 0, 0, 0][..], &(ms * 1000).to_le_bytes()].concat())
    };
    let talk = [hello, echo(10), pose(1, 12), echo(60), pose(2, 70), pose(3, 110), echo(150)];
    seeds.push(("serial_client", "poses", talk.concat()));
    let talk = [
        step(1, 0, 10, &[]),
        step(0, 0, 10, &[1; 8]),
        step(0, 0x20, 20, &[2; 8]),
        step(3, 0, 20, b"\x02\x12\0"),
    ];
    seeds.push(("serial_device", "echoes", talk.concat()));
    seeds
}
