//! The NatNet client: connecting, names, clock, frames in and samples out, all inside [`Tracker::poll`].
//!
//! Nothing here blocks: a poll reads at most [`NatNetClient::MAX_DATAGRAMS_PER_POLL`] datagrams and sends what is due.

use super::clock::ServerClock;
use super::frame::{decode_frame, FrameInfo, RigidBody};
use super::messages as msg;
use super::models::{decode_models_that_fit, BodyModel};
use super::wire::{id, split, Version, MAX_DATAGRAM};
use crate::clock_map::ClockMap;
use crate::pose::Pose;
use crate::time::{HostClock, HostTime};
use crate::tracker::udp::{wait_for_any, Arrival, Datagrams, UdpPort};
use crate::tracker::{BodyIndex, BodyKey, SampleGate, Tracker, TrackerCounters, TrackerError, TrackerSample};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::time::Duration;

const MS: i64 = 1_000_000;
/// A client that was not polled for this long does not know when unstamped datagrams arrived.
const AWAY_NS: i64 = 20 * MS;
/// Interval between attempts to connect.
const CONNECT_EVERY_NS: i64 = 250 * MS;
/// Interval between keep-alive messages (unicast servers stop after some seconds without).
const KEEP_ALIVE_EVERY_NS: i64 = 250 * MS;
/// Interval between requests for model definitions, while names are missing.
const MODELS_EVERY_NS: i64 = 1_000 * MS;
/// The client reconnects to a server that was silent for this long.
const SILENCE_NS: i64 = 2_000 * MS;
/// The client also reconnects to a server that answers but sent no frame for this long.
const STARVED_NS: i64 = 300 * MS;
/// A learned port is kept until it has been silent for this long; only then may another port replace it.
const HOLD_PORT_NS: i64 = 1_000 * MS;
/// If the command port and the data ports have sent no frame for this long, the client may accept frames from one other
/// port.
const LEARN_PORT_AFTER_NS: i64 = 300 * MS;
/// Distinct refused ports remembered for the report.
const MAX_STRANGE_PORTS: usize = 8;
/// Distinct unknown body numbers remembered for the report.
const MAX_STRANGERS: usize = 16;

/// Configuration of a NatNet client.
#[derive(Clone, Debug)]
pub struct NatNetConfig {
    /// Address of the server. Datagrams from elsewhere are dropped, and so are those from ports of this address that
    /// the server does not send from (`docs/TRACKERS.md` has the rule).
    pub server: Ipv4Addr,
    /// Address of the interface to use; unspecified lets the system choose.
    pub local: Ipv4Addr,
    /// Group for multicast; `None` for unicast.
    pub multicast: Option<Ipv4Addr>,
    /// Port for commands, 1510 by convention.
    pub command_port: u16,
    /// Port for frames, 1511 by convention.
    pub data_port: u16,
    /// Bit stream to request; `None` takes the server's. Unicast only, servers from 4.0.
    pub bitstream: Option<Version>,
    /// Take arrival times from the kernel's stamps. Must be off if the host's clock is a virtual clock, which has no
    /// relation to the stamps; the time of arrival is then the time of the poll.
    pub kernel_stamps: bool,
    /// The rig's bodies.
    pub bodies: Vec<BodyKey>,
}

impl NatNetConfig {
    /// Unicast from `server` on the conventional ports.
    pub fn unicast(server: Ipv4Addr, bodies: Vec<BodyKey>) -> Self {
        Self {
            server,
            local: Ipv4Addr::UNSPECIFIED,
            multicast: None,
            command_port: 1510,
            data_port: 1511,
            bitstream: None,
            kernel_stamps: true,
            bodies,
        }
    }
}

/// Why no pose arrives.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Silence {
    /// The server never answered.
    NoAnswer,
    /// The server speaks a version that this client does not.
    Version(Version),
    /// The server answered once and then fell silent.
    WentSilent,
    /// The server answers but no frame has arrived.
    NoFrames,
    /// Frames arrive but none can be read.
    Unreadable,
    /// Frames arrive without any of the rig's bodies.
    NoKnownBody,
    /// The bodies arrive, marked as not tracked.
    NotTracked,
}

/// A NatNet client for a fixed set of bodies.
pub struct NatNetClient {
    config: NatNetConfig,
    clock: Arc<dyn HostClock>,
    command: Box<dyn Datagrams>,
    /// Group socket, or the conventional unicast data port if it could be bound.
    data: Option<Box<dyn Datagrams>>,
    data_problem: Option<String>,
    gate: SampleGate,
    server: Option<msg::ServerInfo>,
    /// Version that the server announced last.
    announced: Option<Version>,
    /// Version that frames are decoded as. It has the layout of the frames, whatever was announced.
    version: Version,
    /// Whether the frame read last had section sizes.
    sized_frames: Option<bool>,
    /// The server was asked again for its version, because its frames contradict the announced one.
    is_contradiction_asked: bool,
    /// Port other than the command port and the data ports that the server sends frames from, and the last frame from it.
    learned_port: Option<(u16, HostTime)>,
    /// Last frame from the command port or a data port; before the first one, the instant of opening.
    trusted_frame_at: HostTime,
    strange_ports: Vec<u16>,
    models: Vec<BodyModel>,
    /// Streaming number to body, sorted by number.
    lookup: Vec<(i32, BodyIndex)>,
    strangers: Vec<i32>,
    frame: Vec<RigidBody>,
    buffer: Vec<u8>,
    out: Vec<u8>,
    server_clock: ServerClock,
    due: Due,
    heard_at: Option<HostTime>,
    /// Last frame, or last connection if none arrived since.
    frame_at: HostTime,
    frames: u64,
    connects_sent: u64,
    version_changes: u64,
    is_filtered: bool,
    polled_at: Option<HostTime>,
    /// Nobody read for a while, and the sockets have not been empty since.
    has_backlog: bool,
    /// From the wall clock, which the kernel stamps by, to the host's clock, when the sockets were last empty.
    wall_offset_ns: Option<i64>,
    /// The arrival of the datagram that is being read is known.
    is_arrival_known: bool,
    /// Bit stream that was requested and is not confirmed yet.
    asked: Option<Version>,
    refused: Option<Version>,
}

/// When to send each kind of message next.
#[derive(Clone, Copy)]
struct Due {
    connect: HostTime,
    keep_alive: HostTime,
    models: HostTime,
}

impl NatNetClient {
    /// Most datagrams read in one poll; more wait for the next.
    pub const MAX_DATAGRAMS_PER_POLL: usize = 64;

    /// Opens the sockets; polling finds the server. `clock` is the host's clock, the one `poll` is called with.
    pub fn open(config: NatNetConfig, clock: Arc<dyn HostClock>) -> Result<Self, TrackerError> {
        let failed = |context: String| move |source| TrackerError::Io { context, source };
        let local = SocketAddrV4::new(config.local, 0);
        let command = UdpPort::bind(local, false).map_err(failed(format!(
            "NatNet: cannot open a UDP socket on {}; `local` must be the address of an interface of this machine",
            config.local
        )))?;
        let mut data_problem = None;
        let data = match config.multicast {
            Some(group) => {
                if !group.is_multicast() {
                    return Err(TrackerError::Protocol(format!(
                        "NatNet: {group} is not a multicast group (224.0.0.0 to 239.255.255.255)"
                    )));
                }
                let address = SocketAddrV4::new(group, config.data_port);
                let port = UdpPort::bind(address, true)
                    .map_err(failed(format!("NatNet: cannot bind {address} for frames")))?;
                port.join(group, Some(config.server), config.local).map_err(failed(format!(
                    "NatNet: cannot join {group} on interface {}; set `local` to the address of the interface \
                     that the tracker is connected to",
                    config.local
                )))?;
                Some(port)
            }
            // Servers send unicast frames either to the socket that connected or to the data port. The client listens
            // on both.
            None => match UdpPort::bind(SocketAddrV4::new(config.local, config.data_port), false) {
                Ok(port) => Some(port),
                Err(e) => {
                    data_problem = Some(format!("port {} not heard ({e})", config.data_port));
                    None
                }
            },
        };
        let data = data.map(|port| -> Box<dyn Datagrams> { Box::new(port) });
        let client = Self::with_ports(config, clock, Box::new(command), data);
        Ok(Self { data_problem, ..client })
    }

    /// A client on sockets that are already open: `command` for requests and their answers, `data` for frames that the
    /// server does not send there.
    pub fn with_ports(
        config: NatNetConfig,
        clock: Arc<dyn HostClock>,
        command: Box<dyn Datagrams>,
        data: Option<Box<dyn Datagrams>>,
    ) -> Self {
        let now = clock.now();
        let mut lookup: Vec<(i32, BodyIndex)> = Vec::with_capacity(config.bodies.len());
        for (i, body) in config.bodies.iter().enumerate() {
            if let Some(id) = body.id.and_then(|id| i32::try_from(id).ok()) {
                lookup.push((id, BodyIndex(i as u16)));
            }
        }
        lookup.sort_unstable_by_key(|(id, _)| *id);
        Self {
            gate: SampleGate::new(config.bodies.len()),
            config,
            clock,
            command,
            data,
            data_problem: None,
            server: None,
            announced: None,
            version: Version::V3_0,
            sized_frames: None,
            is_contradiction_asked: false,
            learned_port: None,
            trusted_frame_at: now,
            strange_ports: Vec::with_capacity(MAX_STRANGE_PORTS),
            models: Vec::new(),
            lookup,
            strangers: Vec::with_capacity(MAX_STRANGERS),
            frame: Vec::with_capacity(MAX_DATAGRAM / RigidBody::BYTES + 1),
            buffer: vec![0; MAX_DATAGRAM],
            out: Vec::with_capacity(1024),
            server_clock: ServerClock::new(),
            due: Due { connect: now, keep_alive: now, models: now },
            heard_at: None,
            frame_at: now,
            frames: 0,
            connects_sent: 0,
            version_changes: 0,
            asked: None,
            is_filtered: false,
            polled_at: None,
            has_backlog: false,
            wall_offset_ns: None,
            is_arrival_known: true,
            refused: None,
        }
    }

    /// Counters of all input, by outcome.
    pub fn counters(&self) -> &TrackerCounters {
        self.gate.counters()
    }

    /// The server's information, once it has arrived.
    pub fn server(&self) -> Option<&msg::ServerInfo> {
        self.server.as_ref()
    }

    /// Version that frames are decoded as.
    pub fn version(&self) -> Version {
        self.version
    }

    /// The version that the server announces, if its frames have the layout of another one.
    pub fn contradicted(&self) -> Option<Version> {
        let (announced, sized) = (self.announced?, self.sized_frames?);
        (announced.has_section_sizes() != sized).then_some(announced)
    }

    /// Rigid bodies by the server's names.
    pub fn models(&self) -> &[BodyModel] {
        &self.models
    }

    /// The map of the server's clock, once an echo was answered.
    pub fn clock_map(&self) -> Option<&ClockMap> {
        self.server_clock.map()
    }

    /// Local port of the command socket.
    pub fn command_port(&self) -> u16 {
        self.command.local().map_or(0, |a| a.port())
    }

    /// Why no pose arrives; `None` while poses arrive.
    pub fn silence(&self) -> Option<Silence> {
        let c = self.gate.counters();
        let quiet = self.heard_at.is_some_and(|h| self.clock.now().ns_since(h) > SILENCE_NS);
        if let (None, Some(version), 0) = (&self.server, self.refused, c.samples.used) {
            return Some(Silence::Version(version));
        }
        if self.server.is_none() && self.connects_sent > 0 && self.frames == 0 {
            return Some(if self.heard_at.is_some() && quiet {
                Silence::WentSilent
            } else {
                Silence::NoAnswer
            });
        }
        if quiet {
            return Some(Silence::WentSilent);
        }
        if self.frames == 0 {
            let unreadable = c.packets.malformed > 0;
            return Some(if unreadable { Silence::Unreadable } else { Silence::NoFrames });
        }
        if c.samples.used == 0 {
            return Some(Silence::NoKnownBody);
        }
        (c.untracked == c.samples.used).then_some(Silence::NotTracked)
    }

    fn send(&mut self, to_port: u16) {
        let to = SocketAddrV4::new(self.config.server, to_port);
        // A failed send shows as silence, with its reason in `status`; the next one is at most a second away.
        let _ = self.command.send(&self.out, to);
    }

    fn housekeeping(&mut self, now: HostTime, was_away: bool) {
        let port = self.config.command_port;
        let is_silent = self.heard_at.is_some_and(|h| now.ns_since(h) > SILENCE_NS);
        // Who did not listen has heard nothing. What waits in the sockets is read first, by the clock that dates it.
        if is_silent && !was_away && self.server.is_some() {
            self.forget_server(now);
        }
        // A server that answers but sends no frames may have restarted and lost this client.
        let starved = now.ns_since(self.frame_at) > STARVED_NS;
        if now >= self.due.connect && (self.server.is_none() || starved) {
            self.frame_at = now;
            self.connect(now);
        }
        if self.server.is_none() {
            return;
        }
        if now >= self.due.models && self.is_name_missing() {
            self.due.models = now.plus_ns(MODELS_EVERY_NS);
            msg::encode_empty(&mut self.out, id::REQUEST_MODEL_DEF);
            self.send(port);
        }
        if now >= self.due.keep_alive && self.config.multicast.is_none() {
            self.due.keep_alive = now.plus_ns(KEEP_ALIVE_EVERY_NS);
            msg::encode_empty(&mut self.out, id::KEEP_ALIVE);
            self.send(port);
        }
        if self.server_clock.is_due(now) {
            // The stamp is taken as late as possible: the time between it and the wire counts as round trip.
            let t1 = self.clock.now();
            self.server_clock.note_sent(t1);
            msg::encode_echo_request(&mut self.out, t1.0 as u64);
            self.send(port);
        }
    }

    fn connect(&mut self, now: HostTime) {
        self.due.connect = now.plus_ns(CONNECT_EVERY_NS);
        self.connects_sent += 1;
        let bitstream = self.config.bitstream;
        msg::Connect { name: "dpm".into(), bitstream }.encode(&mut self.out);
        self.send(self.config.command_port);
    }

    fn forget_server(&mut self, now: HostTime) {
        self.server = None;
        (self.announced, self.sized_frames, self.is_contradiction_asked) = (None, None, false);
        self.learned_port = None;
        if std::mem::take(&mut self.is_filtered) {
            // The next server may send from other ports.
            for port in [&self.command].into_iter().chain(&self.data) {
                let _ = port.keep_all();
            }
        }
        self.server_clock.forget();
        self.asked = None;
        self.due = Due { connect: now, keep_alive: now, models: now };
    }

    /// True while the server has not sent its names.
    fn is_name_missing(&self) -> bool {
        self.models.is_empty()
    }

    /// Finds bodies by the server's names if it sends them, else by the rig file's numbers.
    fn rebuild_lookup(&mut self) {
        self.lookup.clear();
        for (i, body) in self.config.bodies.iter().enumerate() {
            let named = self.models.iter().find(|m| m.name == body.name).map(|m| m.id);
            let given = body.id.and_then(|id| i32::try_from(id).ok());
            if let Some(id) = named.or(given) {
                self.lookup.push((id, BodyIndex(i as u16)));
            }
        }
        self.lookup.sort_unstable_by_key(|(id, _)| *id);
        self.strangers.clear();
    }

    /// Handles the datagram of `arrival` in the buffer; returns how many samples went to `sink`.
    fn take_in(&mut self, arrival: Arrival, at: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> usize {
        let packets = self.gate.packets_mut();
        packets.received += 1;
        if *arrival.from.ip() != self.config.server {
            packets.foreign_source += 1;
            return 0;
        }
        let port = arrival.from.port();
        let is_frame = self.buffer[..arrival.len].starts_with(&id::FRAME.to_le_bytes());
        if !self.may_send(port, is_frame, at) {
            self.gate.packets_mut().foreign_port += 1;
            if self.strange_ports.len() < MAX_STRANGE_PORTS && !self.strange_ports.contains(&port) {
                self.strange_ports.push(port);
            }
            return 0;
        }
        self.heard_at = Some(at);
        // The buffer is lent out while the datagram in it is read.
        let buffer = std::mem::take(&mut self.buffer);
        let result =
            if arrival.cut { Verdict::Malformed } else { self.handle(&buffer[..arrival.len], at, sink) };
        self.buffer = buffer;
        if let (true, Verdict::Used(_)) = (is_frame, &result) {
            if self.is_trusted(port) {
                (self.trusted_frame_at, self.learned_port) = (at, None);
            } else {
                self.learned_port = Some((port, at));
            }
        }
        let packets = self.gate.packets_mut();
        match result {
            Verdict::Used(samples) => {
                packets.used += 1;
                return samples;
            }
            Verdict::Malformed => packets.malformed += 1,
            Verdict::Unsupported => packets.unsupported += 1,
        }
        0
    }

    /// True for the ports that the configuration and the server name: commands, and frames.
    fn is_trusted(&self, port: u16) -> bool {
        let announced = self.server.as_ref().map_or(0, |s| s.data_port);
        port != 0 && [self.config.command_port, self.config.data_port, announced].contains(&port)
    }

    /// Whether a datagram from `port` of the server's address counts as the server's. Answers come from the command
    /// port alone. Frames come from the command port or a data port. While those send none, frames may come from one
    /// other port, which is learned from its first frame and kept until it falls silent.
    fn may_send(&self, port: u16, is_frame: bool, at: HostTime) -> bool {
        if port == self.config.command_port || is_frame && self.is_trusted(port) {
            return true;
        }
        is_frame
            && at.ns_since(self.trusted_frame_at) > LEARN_PORT_AFTER_NS
            && self
                .learned_port
                .is_none_or(|(learned, last)| learned == port || at.ns_since(last) > HOLD_PORT_NS)
    }

    fn handle(&mut self, datagram: &[u8], at: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Verdict {
        let Ok((message, payload)) = split(datagram) else {
            return Verdict::Malformed;
        };
        match message {
            id::FRAME => self.on_frame(payload, at, sink),
            id::SERVER_INFO => self.on_server_info(payload, at),
            // The layout of the names is a separate question: a server that announces one version and sends frames of
            // another may use either for its names.
            id::MODEL_DEF => match decode_models_that_fit(payload, self.version) {
                Ok((models, _)) => {
                    self.models = models;
                    self.rebuild_lookup();
                    Verdict::Used(0)
                }
                Err(_) => Verdict::Malformed,
            },
            id::ECHO_RESPONSE => self.on_echo(payload, at),
            id::RESPONSE => self.on_response(payload, at),
            id::MESSAGE_STRING | id::UNRECOGNIZED => Verdict::Used(0),
            id::DISCONNECT | id::DISCONNECT_BY_TIMEOUT => {
                self.forget_server(at);
                Verdict::Used(0)
            }
            _ => Verdict::Unsupported,
        }
    }

    fn on_server_info(&mut self, payload: &[u8], at: HostTime) -> Verdict {
        let info = match msg::ServerInfo::decode(payload) {
            Ok(info) => info,
            Err(super::WireError::Version(version)) => {
                self.refused = Some(version);
                return Verdict::Unsupported;
            }
            Err(_) => return Verdict::Malformed,
        };
        let said = info.version();
        let is_news = self.announced != Some(said);
        if self.server.is_some() && is_news {
            self.version_changes += 1;
        }
        self.announced = Some(said);
        // The frames show their layout reliably: if the server again announces a version that its frames contradict,
        // the client ignores it.
        if is_news || self.sized_frames.is_none_or(|sized| sized == said.has_section_sizes()) {
            self.version = said;
        }
        if is_news {
            self.is_contradiction_asked = false;
        }
        self.server_clock.set_rate(info.clock_hz, at);
        if let (Some(wanted), None) = (self.config.bitstream, self.config.multicast) {
            if wanted != info.version() && info.version() >= Version::V4_0 {
                self.asked = Some(wanted);
                msg::encode_request(&mut self.out, &format!("Bitstream,{wanted}"));
                self.send(self.config.command_port);
            }
        }
        self.server = Some(info);
        Verdict::Used(0)
    }

    fn on_echo(&mut self, payload: &[u8], at: HostTime) -> Verdict {
        if !self.is_arrival_known {
            // How long it was on its way is not known, so it says nothing of the server's clock.
            return Verdict::Used(0);
        }
        match msg::decode_echo_response(payload) {
            Ok((stamp, ticks)) if self.server_clock.on_echo(stamp, ticks, at) => Verdict::Used(0),
            Ok(_) => Verdict::Unsupported,
            Err(_) => Verdict::Malformed,
        }
    }

    /// The answer to a request; 0 means that the requested bit stream follows from now on.
    fn on_response(&mut self, payload: &[u8], at: HostTime) -> Verdict {
        if let (Some(version), [0, 0, 0, 0]) = (self.asked.take(), payload) {
            self.version = version;
            self.models.clear();
            self.due.models = at;
        }
        Verdict::Used(0)
    }

    fn on_frame(&mut self, payload: &[u8], at: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Verdict {
        let mut bodies = std::mem::take(&mut self.frame);
        let mut info = decode_frame(payload, self.version, &mut bodies);
        if info.is_err() {
            // Frames have two layouts, with and without section sizes. If the other one fits, the server switched the
            // stream.
            let other = self.other_layout();
            info = decode_frame(payload, other, &mut bodies);
            if info.is_ok() {
                self.version = other;
                self.version_changes += u64::from(self.server.is_some());
                // Ask once for the server's present version. If it again announces a version that the frames
                // contradict, the client follows the frames.
                if !std::mem::replace(&mut self.is_contradiction_asked, true) || at >= self.due.connect {
                    self.connect(at);
                }
            }
        }
        if info.is_ok() {
            self.sized_frames = Some(self.version.has_section_sizes());
        }
        let verdict = match info {
            Ok(info) => {
                self.frames += 1;
                self.frame_at = at;
                self.heed(&info, at);
                Verdict::Used(self.deliver(&info, &bodies, at, sink))
            }
            Err(_) => Verdict::Malformed,
        };
        self.frame = bodies;
        verdict
    }

    /// A version whose frames have the layout that the present one does not have: the announced one, if it does.
    fn other_layout(&self) -> Version {
        let sized = !self.version.has_section_sizes();
        let plain = if sized { Version::V4_1 } else { Version::V4_0 };
        self.announced.filter(|v| v.has_section_sizes() == sized).unwrap_or(plain)
    }

    /// Handles the flags of a frame.
    fn heed(&mut self, info: &FrameInfo, at: HostTime) {
        if info.params & FrameInfo::MODELS_CHANGED != 0 && at >= self.due.models {
            self.due.models = at.plus_ns(MODELS_EVERY_NS);
            msg::encode_empty(&mut self.out, id::REQUEST_MODEL_DEF);
            self.send(self.config.command_port);
        }
        if info.params & FrameInfo::BITSTREAM_CHANGED != 0 && at >= self.due.connect {
            self.connect(at);
        }
    }

    fn deliver(
        &mut self,
        info: &FrameInfo,
        bodies: &[RigidBody],
        at: HostTime,
        sink: &mut dyn FnMut(&TrackerSample),
    ) -> usize {
        let captured_at = self.server_clock.captured_at(info, at, self.is_arrival_known);
        let mut delivered = 0;
        for body in bodies {
            let Ok(found) = self.lookup.binary_search_by_key(&body.id, |(id, _)| *id) else {
                self.gate.count_unknown();
                if self.strangers.len() < MAX_STRANGERS && !self.strangers.contains(&body.id) {
                    self.strangers.push(body.id);
                }
                continue;
            };
            if !self.is_arrival_known && self.config.kernel_stamps {
                // It may have waited for seconds, and meanwhile the server's clock, or this machine's, may have been set
                // or stopped: no map dates it. The next frame is a few milliseconds away.
                self.gate.count_unknown_age();
                continue;
            }
            let sample = TrackerSample {
                body: self.lookup[found].1,
                pose: Pose {
                    position_m: body.position.map(f64::from),
                    rotation_xyzw: body.rotation_xyzw.map(f64::from),
                },
                tracked: body.is_tracked(),
                mean_error_m: body.mean_error,
                covariance: None,
                sequence: info.number as u32,
                captured_at,
                received_at: at,
            };
            if let Some(sample) = self.gate.admit(&sample) {
                sink(&sample);
                delivered += 1;
            }
        }
        delivered
    }
}

enum Verdict {
    Used(usize),
    Malformed,
    Unsupported,
}

impl NatNetClient {
    /// When a datagram came that the kernel stamped with a time of the wall clock, of which `stamp` also has the difference to the
    /// host's clock; `None`: the kernel gave no stamp, and it counts as come now. Sets `is_arrival_known`.
    fn arrived_at(&mut self, stamp: Option<(i64, i64)>) -> HostTime {
        let here = self.clock.now();
        self.is_arrival_known = !self.has_backlog;
        let Some((stamp, now)) = stamp else { return here };
        // Set while nobody read, the wall clock stamped what waits by two measures.
        let is_steady = self.wall_offset_ns.is_none_or(|was| now.abs_diff(was) <= MS as u64);
        let stamped = HostTime(stamp.saturating_add(now));
        let is_plausible = (-MS..=10_000 * MS).contains(&here.ns_since(stamped));
        self.is_arrival_known |= is_plausible && is_steady;
        // A very old stamp, or one of the future, comes from a stepped wall clock, not from the arrival.
        if is_plausible {
            stamped.min(here)
        } else {
            here
        }
    }

    /// Has the kernel drop the datagrams of others. `of_other_addresses`: none of those that crowd the queue came from the
    /// server's address.
    fn filter(&mut self, of_other_addresses: bool) {
        // Other senders fill the queue: let the kernel drop their datagrams from now on, uncounted.
        self.is_filtered = true;
        let announced = self.server.as_ref().map_or(0, |s| s.data_port);
        let learned = self.learned_port.map_or(0, |(port, _)| port);
        let mut ports = [self.config.command_port, self.config.data_port, announced, learned];
        if of_other_addresses {
            // All of them have other addresses; this server's port for frames may still have to be learned.
            ports = [0; 4];
        }
        let count = ports.iter().take_while(|p| **p != 0).count();
        for port in [&self.command].into_iter().chain(&self.data) {
            let _ = port.keep_only(self.config.server, &ports[..count]);
        }
    }
}

impl Tracker for NatNetClient {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        // What arrived while nobody read has an unknown arrival, unless the kernel stamped it. It may be more than one poll reads.
        let was_away = self.polled_at.is_some_and(|at| now.ns_since(at) > AWAY_NS);
        self.polled_at = Some(now);
        self.has_backlog |= was_away;
        self.housekeeping(now, was_away);
        let foreign = |c: &TrackerCounters| (c.packets.foreign_source, c.packets.foreign_port);
        let before = foreign(self.gate.counters());
        let (mut delivered, mut budget, mut offset) = (0, Self::MAX_DATAGRAMS_PER_POLL, None);
        let (mut is_crowded, mut is_all_read) = (false, true);
        // Commands first: names and clock before the frames that need them. They are few; frames get the rest of the budget.
        for is_data in [false, true] {
            let alone = is_data || self.data.is_none();
            let mut share = if alone { budget } else { Self::MAX_DATAGRAMS_PER_POLL / 2 };
            let mut is_empty = false;
            while share > 0 && budget > 0 {
                let port = if is_data { self.data.as_deref() } else { Some(&*self.command) };
                is_empty = true;
                let Some(port) = port else { break };
                let arrival = port.receive(&mut self.buffer).map_err(|source| TrackerError::Io {
                    context: "NatNet: receiving failed; is the network interface still up?".into(),
                    source,
                })?;
                let Some(arrival) = arrival else { break };
                is_empty = false;
                share -= 1;
                is_crowded |= share == 0;
                budget -= 1;
                let offset_of = |offset: &mut Option<i64>| {
                    *offset.get_or_insert_with(|| port.realtime_offset_ns(&*self.clock))
                };
                let stamp = arrival.kernel_ns.filter(|_| self.config.kernel_stamps);
                let stamp = stamp.map(|stamp| (stamp, offset_of(&mut offset)));
                let at = self.arrived_at(stamp);
                let frames = self.frames;
                delivered += self.take_in(arrival, at, sink);
                if !is_data && self.frames > frames {
                    // This server streams to the command socket; frames on the data port would only be copies.
                    self.data = None;
                }
            }
            is_all_read &= is_empty;
        }
        self.has_backlog &= !is_all_read;
        if !self.has_backlog {
            self.wall_offset_ns = offset.or(self.wall_offset_ns);
        }
        if is_crowded && before != foreign(self.gate.counters()) && !self.is_filtered {
            self.filter(before.1 == self.gate.counters().packets.foreign_port);
        }
        Ok(delivered)
    }

    fn name(&self) -> &str {
        "natnet"
    }

    fn status(&self) -> String {
        super::report::status(self)
    }

    fn warning(&self) -> Option<String> {
        super::report::warning(self)
    }

    fn wait(&self, timeout: Duration) -> bool {
        let Some(command) = self.command.descriptor() else { return false };
        let data = self.data.as_ref().and_then(|data| data.descriptor());
        wait_for_any([Some(command), data], timeout).is_ok()
    }

    fn gate(&self) -> Option<&SampleGate> {
        Some(&self.gate)
    }
}

/// The internal state for [`super::report`].
pub(super) struct Inside<'a> {
    pub config: &'a NatNetConfig,
    pub strangers: &'a [i32],
    pub strange_ports: &'a [u16],
    pub connects_sent: u64,
    pub version_changes: u64,
    pub clock_doubts: u64,
    pub echoes: u64,
    pub is_filtered: bool,
    pub data_problem: Option<&'a str>,
}

impl NatNetClient {
    pub(super) fn inside(&self) -> Inside<'_> {
        Inside {
            config: &self.config,
            strangers: &self.strangers,
            strange_ports: &self.strange_ports,
            connects_sent: self.connects_sent,
            version_changes: self.version_changes,
            clock_doubts: self.server_clock.doubts(),
            echoes: self.server_clock.answered(),
            is_filtered: self.is_filtered,
            data_problem: self.data_problem.as_deref(),
        }
    }
}

#[cfg(test)]
#[path = "client_tests.rs"]
mod tests;
