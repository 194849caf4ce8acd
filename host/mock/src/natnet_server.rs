//! Sends true poses as NatNet datagrams: the server's protocol as a state machine without sockets or threads.
//!
//! It answers every form of connect message seen in the field, and streams to a multicast group or to each client (at
//! the address that connected, at the conventional data port of its host, or both). It sends its names before it
//! streams to an endpoint, because some clients mistake whatever arrives next for the answer to their request.

use crate::faults::{FaultError, FaultKind, FaultPlan};
use crate::report_queue::ReportQueue;
use crate::tracker::SampleSource;
use dpm_device::time::HostTime;
use dpm_device::tracker::natnet::frame::{encode_frame, FrameContent, FrameInfo, LabeledMarker, RigidBody};
use dpm_device::tracker::natnet::messages as msg;
use dpm_device::tracker::natnet::models::{encode_models, BodyDefinition};
use dpm_device::tracker::natnet::wire::{begin, finish, id, split, Version, WireError};
use dpm_device::tracker::BodyIndex;
use std::net::{Ipv4Addr, SocketAddrV4};

/// Where unicast frames go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UnicastTo {
    /// To the address that connected (OptiTrack's own library).
    CommandSocket,
    /// To the data port of the client's host (older clients).
    DataPort,
    /// To both.
    Both,
}

/// The destination of frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Streaming {
    /// To a group, for everyone.
    Multicast(Ipv4Addr),
    /// To each client that connected.
    Unicast(UnicastTo),
}

/// Configuration of the server.
#[derive(Clone, Debug)]
pub struct NatNetServerConfig {
    /// Newest and default version of the bit stream, 3.0 to 4.2.
    pub version: Version,
    /// Version whose layout frames have, if it differs from the one announced to the client.
    pub frame_layout: Option<Version>,
    /// Version whose layout model definitions have, if it differs from the one announced to the client.
    pub model_layout: Option<Version>,
    /// The destination of frames.
    pub streaming: Streaming,
    /// Port announced for frames.
    pub data_port: u16,
    /// Names and streaming numbers of the bodies, in the order of the source's.
    pub bodies: Vec<(String, i32)>,
    /// Rate of the server's clock, ticks per second, 1 to 1e12.
    pub clock_hz: u64,
    /// What the clock shows at time 0, ticks.
    pub clock_start: u64,
    /// Rate of the server's clock relative to the host's, parts per billion above 1, within 1e6.
    pub clock_skew_ppb: i64,
}

impl NatNetServerConfig {
    /// A 4.1 unicast server like Motive's: 10 MHz clock, bodies numbered from 1.
    pub fn new(names: &[&str]) -> Self {
        Self {
            version: Version::V4_1,
            frame_layout: None,
            model_layout: None,
            streaming: Streaming::Unicast(UnicastTo::Both),
            data_port: 1511,
            bodies: names.iter().zip(1..).map(|(n, id)| ((*n).to_owned(), id)).collect(),
            clock_hz: 10_000_000,
            clock_start: 1_000_000_000_000,
            clock_skew_ppb: 0,
        }
    }
}

/// Why a server cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum NatNetServerError {
    /// An unsupported version.
    #[error("NatNet server: version {0} is not among 3.0, 3.1, 4.0, 4.1, 4.2")]
    Version(Version),
    /// Clock rate or skew out of range.
    #[error("NatNet server: a clock of {hz} Hz, {skew_ppb} ppb fast; 1 to 1e12 Hz and within 1e6 ppb are possible")]
    Clock {
        /// Ticks per second.
        hz: u64,
        /// Parts per billion.
        skew_ppb: i64,
    },
    /// Names do not match bodies.
    #[error("NatNet server: {names} names for {bodies} bodies; names must be 1 to 200 bytes without zero, numbers distinct")]
    Names {
        /// Names given.
        names: usize,
        /// Bodies given.
        bodies: usize,
    },
    /// More bodies than a datagram holds.
    #[error("NatNet server: {0} bodies do not fit one datagram")]
    TooMany(usize),
    /// A fault that this server does not implement.
    #[error(transparent)]
    Fault(#[from] FaultError),
}

/// The faults that a NatNet server implements.
pub const NATNET_FAULTS: [FaultKind; 18] = FaultKind::ALL;

#[derive(Clone, Copy)]
struct NatNetPeer {
    address: SocketAddrV4,
    version: Version,
    connected_at: HostTime,
    heard_at: HostTime,
    /// The names were sent, so frames may follow.
    is_told: bool,
}

/// The server. Time is the argument of each call: the host time of the sample source.
pub struct NatNetServer {
    config: NatNetServerConfig,
    source: SampleSource,
    markers: [[f32; 3]; 4],
    clients: Vec<NatNetPeer>,
    queue: ReportQueue,
    due: Vec<u64>,
    bodies: Vec<RigidBody>,
    labeled: Vec<LabeledMarker>,
    body_markers: Vec<[f32; 3]>,
    datagram: Vec<u8>,
    frames_sent: u64,
}

impl NatNetServer {
    /// Maximum number of clients at a time; further ones are answered but get no frames.
    pub const MAX_CLIENTS: usize = 64;
    /// A unicast client that sent nothing for this long is dropped.
    pub const CLIENT_TIMEOUT_NS: i64 = 5_000_000_000;
    /// A client that never requested names gets frames after this long.
    pub const GRACE_NS: i64 = 300_000_000;

    /// A server for the bodies of `source`.
    pub fn new(config: NatNetServerConfig, source: SampleSource) -> Result<Self, NatNetServerError> {
        for version in [Some(config.version), config.frame_layout, config.model_layout].into_iter().flatten()
        {
            if !version.is_spoken() || version > Version::V4_2 {
                return Err(NatNetServerError::Version(version));
            }
        }
        let (hz, skew_ppb) = (config.clock_hz, config.clock_skew_ppb);
        if hz == 0 || hz > 1_000_000_000_000 || skew_ppb.abs() > 1_000_000 {
            return Err(NatNetServerError::Clock { hz, skew_ppb });
        }
        let bad_name = |n: &str| n.is_empty() || n.len() > 200 || n.contains('\0');
        let repeated =
            config.bodies.iter().enumerate().any(|(i, b)| config.bodies[..i].iter().any(|c| c.1 == b.1));
        if config.bodies.len() != source.body_count()
            || config.bodies.iter().any(|b| bad_name(&b.0))
            || repeated
        {
            return Err(NatNetServerError::Names { names: config.bodies.len(), bodies: source.body_count() });
        }
        source.config().faults.check_supported(&NATNET_FAULTS, "the NatNet server")?;
        let mut server = Self {
            config,
            source,
            markers: [[0.05, 0.0, 0.0], [-0.05, 0.0, 0.0], [0.0, 0.06, 0.0], [0.0, 0.0, 0.07]],
            clients: Vec::with_capacity(Self::MAX_CLIENTS),
            queue: ReportQueue::new(),
            due: Vec::with_capacity(64),
            bodies: Vec::new(),
            labeled: Vec::new(),
            body_markers: Vec::new(),
            datagram: Vec::with_capacity(4096),
            frames_sent: 0,
        };
        let count = server.config.bodies.len();
        server.fill(0);
        let frame = server.encode(Version::V4_2, 0, HostTime(0));
        if frame.and_then(|()| server.encode_model_definitions(Version::V4_2)).is_err() {
            return Err(NatNetServerError::TooMany(count));
        }
        Ok(server)
    }

    /// From now on the server has these faults, with times relative to the source's start.
    ///
    /// # Errors
    /// A fault that this server does not implement; the former faults remain.
    pub fn set_faults(&mut self, faults: FaultPlan) -> Result<(), FaultError> {
        faults.check_supported(&NATNET_FAULTS, "the NatNet server")?;
        self.source.set_faults(faults);
        Ok(())
    }

    /// The server begins at `now`: what was captured before is never sent.
    pub fn begin_at(&mut self, now: HostTime) {
        let _ = self.queue.take_due(&self.source, now);
    }

    /// Number of clients that get frames.
    pub fn client_count(&self) -> usize {
        self.clients.len()
    }

    /// Reports sent (each counted once, however many clients got it).
    pub fn frames_sent(&self) -> u64 {
        self.frames_sent
    }

    /// The source of the poses.
    pub fn source(&self) -> &SampleSource {
        &self.source
    }

    /// Reading of the server's clock at `now`.
    pub fn ticks_at(&self, now: HostTime) -> u64 {
        let t = i128::from(now.ns_since(self.source.config().start));
        // The clock of a restarted server restarts.
        let faults = &self.source.config().faults;
        let t = match faults.last_start(FaultKind::Reset, t as i64) {
            Some(reset) => t - i128::from(reset),
            None => t,
        };
        let skewed = t + t * i128::from(self.config.clock_skew_ppb) / 1_000_000_000;
        let ticks = skewed * i128::from(self.config.clock_hz) / 1_000_000_000;
        (i128::from(self.config.clock_start) + ticks) as u64
    }

    fn is_away(&self, now: HostTime) -> bool {
        let t = now.ns_since(self.source.config().start);
        self.source.config().faults.is_on(FaultKind::Unplug, t)
    }

    /// Answers one datagram on the command port through `send`. Invalid ones are ignored, or answered as unrecognized.
    pub fn on_datagram(
        &mut self,
        datagram: &[u8],
        from: SocketAddrV4,
        now: HostTime,
        send: &mut dyn FnMut(&[u8], SocketAddrV4),
    ) {
        if self.is_away(now) {
            return;
        }
        // Some clients announce a wrong length (the text without its zero): the message number alone decides.
        let (message, payload) = match split(datagram) {
            Ok(parts) => parts,
            Err(WireError::Length { .. }) => (u16::from_le_bytes([datagram[0], datagram[1]]), &datagram[4..]),
            Err(_) => return,
        };
        let known = self.clients.iter().position(|c| c.address == from);
        if let Some(i) = known {
            self.clients[i].heard_at = now;
        }
        let version = known.map_or(self.config.version, |i| self.clients[i].version);
        match message {
            id::CONNECT | id::DISCOVERY => {
                let wanted = msg::Connect::decode(payload).bitstream.filter(|v| *v <= self.config.version);
                let version = if message == id::CONNECT { self.connect(from, wanted, now) } else { version };
                self.encode_server_info(version);
            }
            id::REQUEST_MODEL_DEF => {
                if self.encode_model_definitions(version).is_err() {
                    return;
                }
                if let Some(i) = known {
                    self.clients[i].is_told = true;
                }
            }
            id::REQUEST_FRAME => {
                let Some(k) = self.queue.newest() else { return };
                self.fill(k);
                if self.encode(version, k, now).is_err() {
                    return;
                }
            }
            id::REQUEST => self.answer_request(msg::request_text(payload).unwrap_or(""), known),
            id::ECHO_REQUEST => match msg::decode_echo_request(payload) {
                Ok(stamp) => {
                    let ticks = self.ticks_at(now);
                    msg::encode_echo_response(&mut self.datagram, stamp, ticks);
                }
                Err(_) => return,
            },
            id::KEEP_ALIVE => return,
            id::DISCONNECT => {
                self.clients.retain(|c| c.address != from);
                return;
            }
            _ => msg::encode_empty(&mut self.datagram, id::UNRECOGNIZED),
        }
        send(&self.datagram, from);
    }

    fn connect(&mut self, address: SocketAddrV4, wanted: Option<Version>, now: HostTime) -> Version {
        let unicast = matches!(self.config.streaming, Streaming::Unicast(_));
        // A multicast group has one bit stream for all.
        let version = if unicast { wanted.unwrap_or(self.config.version) } else { self.config.version };
        if let Some(client) = self.clients.iter_mut().find(|c| c.address == address) {
            client.version = version;
        } else if self.clients.len() < Self::MAX_CLIENTS {
            self.clients.push(NatNetPeer {
                address,
                version,
                connected_at: now,
                heard_at: now,
                is_told: false,
            });
        }
        version
    }

    fn answer_request(&mut self, text: &str, known: Option<usize>) {
        let (word, argument) = text.split_once(',').unwrap_or((text, ""));
        let answer = match word {
            "FrameRate" => (self.source.config().rate.hz() as f32).to_le_bytes(),
            "UnitsToMillimeters" => 1000f32.to_le_bytes(),
            "Bitstream" => {
                let unicast = matches!(self.config.streaming, Streaming::Unicast(_));
                let wanted = parse_version(argument).filter(|v| *v <= self.config.version && unicast);
                match (wanted, known) {
                    (Some(version), Some(i)) => {
                        self.clients[i].version = version;
                        0i32.to_le_bytes()
                    }
                    _ => 1i32.to_le_bytes(),
                }
            }
            "SubscribeToData"
            | "SubscribeByID"
            | "SubscribedDataOnly"
            | "TimelinePlay"
            | "TimelineStop"
            | "LiveMode"
            | "EditMode"
            | "SetPlaybackCurrentFrame"
            | "StartRecording"
            | "StopRecording" => 0i32.to_le_bytes(),
            _ => return msg::encode_empty(&mut self.datagram, id::UNRECOGNIZED),
        };
        begin(&mut self.datagram, id::RESPONSE);
        self.datagram.extend_from_slice(&answer);
        finish(&mut self.datagram).expect("four bytes");
    }

    fn encode_server_info(&mut self, version: Version) {
        let group = match self.config.streaming {
            Streaming::Multicast(group) => Some(group.octets()),
            Streaming::Unicast(_) => None,
        };
        let info = msg::ServerInfo {
            name: "hil-mock".into(),
            app_version: [3, 1, 0, 0],
            natnet_version: [version.major, version.minor, 0, 0],
            clock_hz: self.config.clock_hz,
            data_port: self.config.data_port,
            multicast: group,
        };
        info.encode(&mut self.datagram);
    }

    fn encode_model_definitions(&mut self, version: Version) -> Result<(), WireError> {
        let markers = &self.markers;
        let definitions: Vec<BodyDefinition<'_>> =
            self.config.bodies.iter().map(|(name, id)| BodyDefinition { name, id: *id, markers }).collect();
        encode_models(&mut self.datagram, self.config.model_layout.unwrap_or(version), &definitions)
    }

    /// Instant at which the next report is due: when to call [`NatNetServer::stream`] again, at the latest.
    pub fn next_due(&self) -> HostTime {
        self.queue.next_due(&self.source)
    }

    /// Sends all reports due by `now` through `send`.
    pub fn stream(&mut self, now: HostTime, send: &mut dyn FnMut(&[u8], SocketAddrV4)) {
        let unicast = matches!(self.config.streaming, Streaming::Unicast(_));
        self.clients.retain(|c| !unicast || now.ns_since(c.heard_at) < Self::CLIENT_TIMEOUT_NS);
        self.due.clear();
        self.due.extend_from_slice(self.queue.take_due(&self.source, now));
        for i in 0..self.due.len() {
            if !self.is_away(now) {
                self.send_report(self.due[i], now, send);
            }
        }
    }

    fn send_report(&mut self, k: u64, now: HostTime, send: &mut dyn FnMut(&[u8], SocketAddrV4)) {
        self.frames_sent += 1;
        let waits = |c: &NatNetPeer| !c.is_told && now.ns_since(c.connected_at) < Self::GRACE_NS;
        if matches!(self.config.streaming, Streaming::Unicast(_)) && self.clients.iter().all(waits) {
            return;
        }
        self.fill(k);
        match self.config.streaming {
            Streaming::Multicast(group) => {
                if self.encode(self.config.version, k, now).is_ok() {
                    self.spoil(k);
                    send(&self.datagram, SocketAddrV4::new(group, self.config.data_port));
                }
            }
            Streaming::Unicast(to) => {
                // The datagram is a function of the report and the version: one for all clients in a row of the same version.
                let mut written = None;
                for i in 0..self.clients.len() {
                    let client = self.clients[i];
                    if waits(&client) {
                        continue;
                    }
                    if written != Some(client.version) {
                        written = None;
                        if self.encode(client.version, k, now).is_err() {
                            continue;
                        }
                        self.spoil(k);
                        written = Some(client.version);
                    }
                    if to != UnicastTo::DataPort {
                        send(&self.datagram, client.address);
                    }
                    let data = SocketAddrV4::new(*client.address.ip(), self.config.data_port);
                    // Once for each host, however many of its programs connected.
                    let is_first = !self.clients[..i].iter().any(|c| c.address.ip() == client.address.ip());
                    if to != UnicastTo::CommandSocket && is_first && data != client.address {
                        send(&self.datagram, data);
                    }
                }
            }
        }
    }

    /// Poses and markers of capture `k`.
    fn fill(&mut self, k: u64) {
        self.bodies.clear();
        self.labeled.clear();
        self.body_markers.clear();
        for (i, (_, id)) in self.config.bodies.iter().enumerate() {
            let Some(sample) = self.source.sample(BodyIndex(i as u16), k) else { continue };
            let position = sample.pose.position_m.map(|c| c as f32);
            self.bodies.push(RigidBody {
                id: *id,
                position,
                rotation_xyzw: sample.pose.rotation_xyzw.map(|c| c as f32),
                mean_error: sample.mean_error_m,
                params: u16::from(sample.tracked),
            });
            for (j, marker) in self.markers.iter().enumerate() {
                let r = crate::motion::rotate(sample.pose.rotation_xyzw, marker.map(f64::from));
                let at = [0, 1, 2].map(|c| (sample.pose.position_m[c] + r[c]) as f32);
                self.body_markers.push(at);
                self.labeled.push(LabeledMarker {
                    id: (id << 16) | (j as i32 + 1),
                    position: at,
                    size: 0.014,
                    params: 0b1010,
                    residual: 0.0,
                });
            }
        }
    }

    fn encode(&mut self, version: Version, k: u64, now: HostTime) -> Result<(), WireError> {
        let captured_ns = self.source.captured_ns(k);
        let captured = self.source.config().start.plus_ns(captured_ns);
        let number = self.source.sample(BodyIndex(0), k).map_or(0, |s| s.sequence);
        let info = FrameInfo {
            number: number as i32,
            timecode: [0; 2],
            timestamp_s: captured_ns as f64 * 1e-9,
            mid_exposure: self.ticks_at(captured),
            data_received: self.ticks_at(captured.plus_ns(500_000).min(now)),
            transmit: self.ticks_at(now),
            precision: [0; 2],
            params: FrameInfo::LIVE,
        };
        let per_body = self.markers.len();
        let sets: Vec<(&str, &[[f32; 3]])> = self
            .config
            .bodies
            .iter()
            .zip(self.body_markers.chunks(per_body))
            .map(|((name, _), markers)| (name.as_str(), markers))
            .collect();
        let content = FrameContent {
            marker_sets: &sets,
            other_markers: &[],
            bodies: &self.bodies,
            labeled: &self.labeled,
        };
        encode_frame(&mut self.datagram, self.config.frame_layout.unwrap_or(version), &info, &content)
    }

    /// Damages the datagram if the plan says so.
    fn spoil(&mut self, k: u64) {
        if let Some(bits) = self.source.byte_fault(FaultKind::Corrupt, 0, k) {
            let at = bits as usize % self.datagram.len();
            self.datagram[at] ^= ((bits >> 32) as u8).max(1);
        }
        if let Some(bits) = self.source.byte_fault(FaultKind::Truncate, 0, k) {
            self.datagram.truncate(bits as usize % self.datagram.len());
        }
    }
}

fn parse_version(text: &str) -> Option<Version> {
    let (major, minor) = text.trim().split_once('.')?;
    let version = Version::new(major.parse().ok()?, minor.split('.').next()?.parse().ok()?);
    version.is_spoken().then_some(version)
}
