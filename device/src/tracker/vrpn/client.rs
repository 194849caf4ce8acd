//! The VRPN client: connecting, descriptions, clock by ping, poses to samples, all inside [`Tracker::poll`], which
//! never blocks.

use super::wire::{self, system, type_name, Message, COOKIE, COOKIE_BYTES};
use crate::clock_map::{ClockMap, ExchangeOutcome};
use crate::stream::{OnThread, Opener};
use crate::time::{DeviceTicks, HostClock, HostTime};
use crate::tracker::udp::wait_for_any;
use crate::tracker::{
    BodyIndex, BodyKey, SampleGate, Stream, Tracker, TrackerCounters, TrackerError, TrackerSample,
};
use std::io::ErrorKind;
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::sync::Arc;
use std::time::Duration;

const MS: i64 = 1_000_000;
/// Bytes read in one poll, and room for an incomplete message.
const BUFFER_BYTES: usize = 64 * 1024;
/// Interval between attempts to connect.
const RETRY_EVERY_NS: i64 = 250 * MS;
/// Timeout of an attempt to connect. The operating system would ask again only after a second; a new attempt comes
/// sooner.
pub const CONNECT_TIMEOUT: Duration = Duration::from_millis(400);
/// The client disconnects from a server that sent nothing for this long, and connects anew: the server may have
/// forgotten the connection, and TCP sends lost bytes again at ever longer intervals ...
const SILENCE_NS: i64 = 1_000 * MS;
/// ... but a server that has greeted and answered no ping may just have nothing to tell.
const SILENCE_WITHOUT_PONGS_NS: i64 = 3_000 * MS;
/// A pose that is older than this, or as far in the future, waited somewhere on its way, or the server's clock stepped.
/// A pong tells which.
const DOUBTED_NS: u64 = 1_000_000_000;
/// It does if it came back within this time: a map that is made of it is wrong by half of that at most ...
const SETTLED_ROUND_TRIP_NS: i64 = 10 * MS;
/// ... or so many pongs do that came back within this time, of which the map takes the quickest.
const SETTLED_PONGS: u32 = 5;
const SETTLED_ROUND_TRIPS_NS: i64 = 50 * MS;
/// If no pong tells for this long, while the server is heard, the map of its clock is forgotten, and poses are dated by the
/// shortest delay ...
const UNSETTLED_NS: i64 = 300 * MS;
/// ... without a pause of this length, after which what had been held back may arrive.
const PAUSE_NS: i64 = 100 * MS;
/// A server that has not been heard for this long is sent something. A machine that has forgotten the connection says so
/// then, and not before.
const PROBE_AFTER_NS: i64 = 200 * MS;
/// Pings: this many quickly, the rest slowly.
const QUICK_PINGS: u32 = 20;
const QUICK_PING_EVERY_NS: i64 = 10 * MS;
const PING_EVERY_NS: i64 = 200 * MS;
/// Maximum number of senders and types; higher numbers are ignored.
const MAX_NUMBERS: usize = 256;
/// Without pongs: length of the buckets over which the shortest delay is taken.
const ONE_WAY_BUCKET_NS: i64 = 2_000 * MS;

/// Configuration of a VRPN client.
#[derive(Clone, Debug)]
pub struct VrpnConfig {
    /// `host` or `host:port`; the port is 3883 by convention.
    pub server: String,
    /// Name of a tracker whose sensors are the rig's bodies: a body's `id` is its sensor; without one its index in
    /// `bodies` is. Trackers with the name of a body are understood as well, as Motive and Vicon name them.
    pub tracker: String,
    /// The rig's bodies.
    pub bodies: Vec<BodyKey>,
}

/// Meaning of a sender's number.
#[derive(Clone, Copy, PartialEq)]
enum Sender {
    Unknown,
    /// The configured tracker: sensors are bodies.
    Tracker,
    /// A tracker with the name of this body.
    Body(BodyIndex),
}

/// Meaning of a type's number.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Unknown,
    PosQuat,
    Pong,
}

enum State {
    /// Waiting for the next attempt.
    Idle { retry_at: HostTime },
    /// An attempt to connect lasts.
    Connecting,
    /// Connected; the cookie may still be missing.
    Open { stream: Box<dyn Stream>, greeted: bool, heard_at: HostTime },
}

/// A VRPN client for a fixed set of bodies.
pub struct VrpnClient {
    config: VrpnConfig,
    clock: Arc<dyn HostClock>,
    opener: Box<dyn Opener>,
    state: State,
    gate: SampleGate,
    senders: Vec<Sender>,
    kinds: Vec<Kind>,
    names_seen: Vec<String>,
    buffer: Vec<u8>,
    filled: usize,
    out: Vec<u8>,
    map: ClockMap,
    one_way: OneWay,
    /// Our number for a name that the server has.
    ping_as: Option<i32>,
    ping_sent: Option<HostTime>,
    ping_due: HostTime,
    /// Not before then a silent server is sent something again.
    probe_due: HostTime,
    pings: u32,
    pongs: u64,
    /// Pings of this connection have been answered.
    has_ponged: bool,
    /// Since then the age of poses is unknown: the connection is new, or the server's clock contradicts their arrival. Counted
    /// anew from when the server is heard again after a pause.
    doubted_since: Option<HostTime>,
    /// Pongs since then that bear the server's clock out.
    agreeing: u32,
    problem: Option<String>,
    connections: u64,
}

/// The shortest arrival delay of the last seconds: the fallback if nobody answers pings.
#[derive(Clone, Copy)]
struct OneWay {
    bucket_ends: HostTime,
    this: i64,
    before: i64,
}

impl OneWay {
    const EMPTY: Self = Self { bucket_ends: HostTime(i64::MIN), this: i64::MAX, before: i64::MAX };

    /// Host minus device time, ns; too large by the shortest network delay.
    fn note(&mut self, at: HostTime, device_ns: i64) -> i64 {
        if at >= self.bucket_ends {
            self.before = if self.bucket_ends == HostTime(i64::MIN) { i64::MAX } else { self.this };
            self.this = i64::MAX;
            self.bucket_ends = at.plus_ns(ONE_WAY_BUCKET_NS);
        }
        self.this = self.this.min(at.0.saturating_sub(device_ns));
        self.this.min(self.before)
    }
}

impl VrpnClient {
    /// A client that connects when polled. `clock` is the host's clock, the one `poll` is called with.
    pub fn open(config: VrpnConfig, clock: Arc<dyn HostClock>) -> Result<Self, TrackerError> {
        let server = config.server.clone();
        // Name look-up and connecting can block without bound, so a helper thread does them.
        Self::open_through(config, clock, Box::new(OnThread::new("vrpn-connect", move || connect(&server))))
    }

    /// A client that `opener` connects when it is polled, instead of the operating system.
    ///
    /// # Errors
    /// The configuration names no server.
    pub fn open_through(
        config: VrpnConfig,
        clock: Arc<dyn HostClock>,
        opener: Box<dyn Opener>,
    ) -> Result<Self, TrackerError> {
        if config.server.is_empty() {
            return Err(TrackerError::Protocol("VRPN: the server's address is empty".into()));
        }
        Ok(Self {
            gate: SampleGate::new(config.bodies.len()),
            config,
            clock,
            opener,
            state: State::Idle { retry_at: HostTime(i64::MIN) },
            senders: vec![Sender::Unknown; MAX_NUMBERS],
            kinds: vec![Kind::Unknown; MAX_NUMBERS],
            names_seen: Vec::new(),
            buffer: vec![0; BUFFER_BYTES],
            filled: 0,
            out: Vec::with_capacity(1024),
            map: ClockMap::new(1_000_000).expect("a microsecond clock"),
            one_way: OneWay::EMPTY,
            ping_as: None,
            ping_sent: None,
            ping_due: HostTime(i64::MIN),
            probe_due: HostTime(i64::MIN),
            pings: 0,
            pongs: 0,
            has_ponged: false,
            doubted_since: None,
            agreeing: 0,
            problem: None,
            connections: 0,
        })
    }

    /// A client whose connection stands already: a conversation in memory, where a test writes the server's part. If it
    /// is lost, the client connects to `config.server` like any other.
    pub fn over(
        config: VrpnConfig,
        clock: Arc<dyn HostClock>,
        stream: Box<dyn Stream>,
    ) -> Result<Self, TrackerError> {
        let now = clock.now();
        let mut this = Self::open(config, clock)?;
        this.begin(stream, now)
            .map_err(|source| TrackerError::Io { context: "VRPN: cannot greet the server".into(), source })?;
        Ok(this)
    }

    /// Counters of all input, by outcome.
    pub fn counters(&self) -> &TrackerCounters {
        self.gate.counters()
    }

    /// True while there is a connection with a valid greeting.
    pub fn is_connected(&self) -> bool {
        matches!(self.state, State::Open { greeted: true, .. })
    }

    /// The map of the server's clock, once a ping was answered.
    pub fn clock_map(&self) -> Option<&ClockMap> {
        self.map.is_ready().then_some(&self.map)
    }

    fn begin(&mut self, mut stream: Box<dyn Stream>, now: HostTime) -> std::io::Result<()> {
        self.filled = 0;
        self.senders.fill(Sender::Unknown);
        self.kinds.fill(Kind::Unknown);
        self.names_seen.clear();
        self.map = ClockMap::new(1_000_000).expect("a microsecond clock");
        self.one_way = OneWay::EMPTY;
        self.ping_as = None;
        (self.ping_sent, self.ping_due, self.pings) = (None, now, 0);
        (self.has_ponged, self.doubted_since) = (false, None);
        self.connections += 1;
        self.out.clear();
        self.out.extend_from_slice(&COOKIE);
        // Our numbers: sender 0 is the tracker, 1 and up are the bodies, type 0 is the ping. A server answers pings to
        // a name that it has.
        let bodies = self.config.bodies.iter().map(|b| b.name.as_str()).take(MAX_NUMBERS - 1);
        for (number, name) in (0..).zip(std::iter::once(self.config.tracker.as_str()).chain(bodies)) {
            wire::put_description(&mut self.out, system::SENDER, number, name);
        }
        wire::put_description(&mut self.out, system::TYPE, 0, type_name::PING);
        stream.write_all(&self.out)?;
        self.state = State::Open { stream, greeted: false, heard_at: now };
        Ok(())
    }

    fn lose(&mut self, now: HostTime, why: String) {
        self.problem = Some(why);
        self.state = State::Idle { retry_at: now.plus_ns(RETRY_EVERY_NS) };
    }

    fn ping(&mut self, now: HostTime) -> std::io::Result<()> {
        let (State::Open { stream, greeted: true, .. }, Some(sender)) = (&mut self.state, self.ping_as)
        else {
            return Ok(());
        };
        // One at a time, so that each pong answers one ping; a lost ping times out after a second.
        let waiting = self.ping_sent.is_some_and(|t| now.ns_since(t) < 1_000 * MS);
        if waiting || now < self.ping_due {
            return Ok(());
        }
        let quick = self.pings < QUICK_PINGS;
        self.ping_due = now.plus_ns(if quick { QUICK_PING_EVERY_NS } else { PING_EVERY_NS });
        self.pings = self.pings.saturating_add(1);
        self.out.clear();
        let message =
            Message { seconds: 0, microseconds: 0, sender, kind: 0, sequence: self.pings, payload: &[] };
        wire::put(&mut self.out, &message);
        self.ping_sent = Some(self.clock.now());
        stream.write_all(&self.out)
    }

    /// Sends something that needs no answer to a server that is silent. One ping waits for its pong as long as a second.
    fn probe(&mut self, now: HostTime) -> std::io::Result<()> {
        let State::Open { stream, heard_at, .. } = &mut self.state else { return Ok(()) };
        if now.ns_since(*heard_at) < PROBE_AFTER_NS || now < self.probe_due {
            return Ok(());
        }
        self.probe_due = now.plus_ns(PROBE_AFTER_NS);
        self.out.clear();
        wire::put_description(&mut self.out, system::TYPE, 0, type_name::PING);
        stream.write_all(&self.out)
    }

    /// Reads the available input, at most one buffer full; returns whether the other side is still connected.
    fn fill(&mut self, now: HostTime) -> std::io::Result<bool> {
        let State::Open { stream, heard_at, .. } = &mut self.state else { return Ok(true) };
        while self.filled < self.buffer.len() {
            match stream.read(&mut self.buffer[self.filled..]) {
                Ok(0) => return Ok(false),
                Ok(n) => {
                    self.filled += n;
                    let paused = now.ns_since(*heard_at) > PAUSE_NS;
                    self.doubted_since = self.doubted_since.map(|since| if paused { now } else { since });
                    *heard_at = now;
                }
                Err(e) if e.kind() == ErrorKind::WouldBlock => break,
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) => return Err(e),
            }
        }
        Ok(true)
    }

    /// Handles all whole messages of the buffer.
    fn digest(
        &mut self,
        at: HostTime,
        sink: &mut dyn FnMut(&TrackerSample),
    ) -> Result<usize, wire::VrpnError> {
        let mut start = 0;
        if let State::Open { greeted: greeted @ false, .. } = &mut self.state {
            let Some(cookie) = self.buffer[..self.filled].first_chunk::<COOKIE_BYTES>() else { return Ok(0) };
            wire::check_cookie(cookie)?;
            *greeted = true;
            // The first poses would be dated by their arrival and the next ones by a pong, and a body would seem to leap.
            (self.doubted_since, self.agreeing) = (Some(at), 0);
            self.problem = None;
            start = COOKIE_BYTES;
        }
        let buffer = std::mem::take(&mut self.buffer);
        let mut delivered = 0;
        let result = loop {
            match wire::split(&buffer[start..self.filled]) {
                Ok(Some((message, used))) => {
                    delivered += self.handle(&message, at, sink);
                    start += used;
                }
                Ok(None) => break Ok(()),
                Err(error) => {
                    let packets = self.gate.packets_mut();
                    packets.received += 1;
                    packets.malformed += 1;
                    break Err(error);
                }
            }
        };
        self.buffer = buffer;
        self.buffer.copy_within(start..self.filled, 0);
        self.filled -= start;
        result.map(|()| delivered)
    }

    fn handle(&mut self, message: &Message<'_>, at: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> usize {
        self.gate.packets_mut().received += 1;
        let mut delivered = 0;
        let used = match message.kind {
            system::SENDER | system::TYPE => self.learn(message),
            system::UDP | system::LOG | system::DISCONNECT => Ok(true),
            kind => match usize::try_from(kind).ok().and_then(|k| self.kinds.get(k)).copied() {
                Some(Kind::PosQuat) => match wire::decode_pos_quat(message.payload) {
                    Ok((sensor, pose)) => {
                        let captured_at = self.captured_at(message, at);
                        let sample = TrackerSample {
                            body: BodyIndex(u16::MAX),
                            pose,
                            tracked: true,
                            mean_error_m: 0.0,
                            covariance: None,
                            // VRPN does not number the samples of a sensor.
                            sequence: 0,
                            captured_at,
                            received_at: at,
                        };
                        delivered = self.deliver(message.sender, sensor, sample, sink);
                        Ok(true)
                    }
                    Err(e) => Err(e),
                },
                Some(Kind::Pong) => {
                    self.on_pong(message, at);
                    Ok(true)
                }
                _ => Ok(false),
            },
        };
        let packets = self.gate.packets_mut();
        match used {
            Ok(true) => packets.used += 1,
            Ok(false) => packets.unsupported += 1,
            Err(_) => packets.malformed += 1,
        }
        delivered
    }

    fn deliver(
        &mut self,
        sender: i32,
        sensor: i32,
        sample: TrackerSample,
        sink: &mut dyn FnMut(&TrackerSample),
    ) -> usize {
        let sender = usize::try_from(sender).ok().and_then(|s| self.senders.get(s)).copied();
        let body = match sender {
            Some(Sender::Body(body)) => Some(body),
            Some(Sender::Tracker) => {
                let by_place = |i: usize, b: &BodyKey| b.id.unwrap_or(i as i64) == i64::from(sensor);
                let place = self.config.bodies.iter().enumerate().position(|(i, b)| by_place(i, b));
                place.map(|i| BodyIndex(i as u16))
            }
            _ => None,
        };
        let Some(body) = body else {
            self.gate.count_unknown();
            return 0;
        };
        if self.doubted_since.is_some() {
            self.gate.count_unknown_age();
            return 0;
        }
        match self.gate.admit(&TrackerSample { body, ..sample }) {
            Some(sample) => {
                sink(&sample);
                1
            }
            None => 0,
        }
    }

    /// Handles a description.
    fn learn(&mut self, message: &Message<'_>) -> Result<bool, wire::VrpnError> {
        let name = wire::described_name(message.payload)?;
        let Some(number) = usize::try_from(message.sender).ok().filter(|n| *n < MAX_NUMBERS) else {
            return Ok(false);
        };
        if message.kind == system::TYPE {
            self.kinds[number] = match name {
                n if n == type_name::POS_QUAT.as_bytes() => Kind::PosQuat,
                n if n == type_name::PONG.as_bytes() => Kind::Pong,
                _ => Kind::Unknown,
            };
            return Ok(true);
        }
        let body = self.config.bodies.iter().position(|b| b.name.as_bytes() == name);
        self.senders[number] = match body {
            _ if name == self.config.tracker.as_bytes() => Sender::Tracker,
            Some(i) => Sender::Body(BodyIndex(i as u16)),
            None => Sender::Unknown,
        };
        match self.senders[number] {
            Sender::Tracker => self.ping_as = Some(0),
            Sender::Body(body) if self.ping_as.is_none() => self.ping_as = Some(i32::from(body.0) + 1),
            _ => {}
        }
        if self.names_seen.len() < 32 {
            self.names_seen.push(String::from_utf8_lossy(name).into_owned());
        }
        Ok(true)
    }

    fn on_pong(&mut self, message: &Message<'_>, at: HostTime) {
        let Some(t1) = self.ping_sent.take() else { return };
        self.pongs += 1;
        self.has_ponged = true;
        // The pongs of a server that does not stamp them cannot be used for timing.
        if message.stamp_us() == 0 {
            return;
        }
        let ticks = DeviceTicks(message.stamp_us());
        let outcome = self.map.add_exchange(t1, ticks, ticks, at);
        if matches!(outcome, ExchangeOutcome::Stepped | ExchangeOutcome::Contradicting) {
            (self.pings, self.ping_due) = (0, at);
        }
        let round_trip_ns = at.ns_since(t1);
        if outcome != ExchangeOutcome::Contradicting && round_trip_ns <= SETTLED_ROUND_TRIPS_NS {
            self.agreeing += 1;
            if round_trip_ns <= SETTLED_ROUND_TRIP_NS || self.agreeing >= SETTLED_PONGS {
                self.doubted_since = None;
            }
        }
    }

    /// The server's stamp on the host's clock: by pongs if it answers pings, otherwise by the shortest delay seen.
    fn captured_at(&mut self, message: &Message<'_>, at: HostTime) -> HostTime {
        let stamp = message.stamp_us();
        if stamp == 0 {
            return at;
        }
        if let Some(mapped) = self.map.to_host(DeviceTicks(stamp)) {
            if at.ns_since(mapped.at).unsigned_abs() >= DOUBTED_NS && self.doubted_since.is_none() {
                (self.doubted_since, self.agreeing) = (Some(at), 0);
                (self.pings, self.ping_due) = (0, at);
                self.one_way = OneWay::EMPTY;
            }
            if self.doubted_since.is_none() {
                return mapped.at.min(at);
            }
        }
        // In doubt, the shortest delay is learned, for the case that no pong settles it.
        let device_ns = i64::try_from(stamp.saturating_mul(1000)).unwrap_or(i64::MAX);
        let offset = self.one_way.note(at, device_ns);
        HostTime(device_ns.saturating_add(offset)).min(at)
    }

    fn converse(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> usize {
        let alive = self.fill(now);
        let State::Open { heard_at, greeted, .. } = &self.state else { return 0 };
        // Servers greet at once. One that has not was restarted while it accepted, or what it said was lost.
        let silence_ns = if self.has_ponged || !greeted { SILENCE_NS } else { SILENCE_WITHOUT_PONGS_NS };
        if now.ns_since(*heard_at) > silence_ns {
            self.lose(now, "the server fell silent".into());
            return 0;
        }
        let at = self.clock.now();
        let is_heard = now.ns_since(*heard_at) <= PAUSE_NS;
        let lapses = |since: &mut HostTime| is_heard && at.ns_since(*since) >= UNSETTLED_NS;
        if self.doubted_since.take_if(lapses).is_some() {
            self.map = ClockMap::new(1_000_000).expect("a microsecond clock");
        }
        let delivered = match self.digest(at, sink) {
            Ok(n) => n,
            Err(error) => {
                self.lose(now, error.to_string());
                return 0;
            }
        };
        let pinged = self.ping(at).and_then(|()| self.probe(now));
        match alive.and_then(|alive| pinged.map(|()| alive)) {
            Ok(true) => {}
            Ok(false) => self.lose(now, "the server closed the connection".into()),
            Err(error) => self.lose(now, error.to_string()),
        }
        delivered
    }
}

/// Nothing waits for the server, and pings are not held back to be sent together.
fn without_waiting(stream: &TcpStream) -> std::io::Result<()> {
    stream.set_nonblocking(true)?;
    stream.set_nodelay(true)
}

fn connect(server: &str) -> Result<Box<dyn Stream>, String> {
    match connect_to_any(server).and_then(|stream| without_waiting(&stream).map(|()| stream)) {
        Ok(stream) => Ok(Box::new(stream)),
        Err(error) => Err(format!("cannot connect to {server}: {error}")),
    }
}

fn connect_to_any(server: &str) -> std::io::Result<TcpStream> {
    let text = server.trim_start_matches("tcp://");
    let addresses: Vec<SocketAddr> = match text.to_socket_addrs() {
        Ok(found) => found.collect(),
        Err(_) => (text, wire::PORT).to_socket_addrs()?.collect(),
    };
    let mut last = std::io::Error::new(ErrorKind::NotFound, "no address");
    for address in addresses.iter().take(4) {
        match TcpStream::connect_timeout(address, CONNECT_TIMEOUT) {
            Ok(stream) => return Ok(stream),
            Err(e) => last = e,
        }
    }
    Err(last)
}

impl Tracker for VrpnClient {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        match &self.state {
            State::Idle { retry_at } if now >= *retry_at => {
                self.state = match self.opener.begin() {
                    true => State::Connecting,
                    false => State::Idle { retry_at: now.plus_ns(RETRY_EVERY_NS) },
                }
            }
            State::Idle { .. } => {}
            State::Connecting => match self.opener.outcome() {
                None => {}
                Some(Ok(stream)) => {
                    if let Err(error) = self.begin(stream, now) {
                        self.lose(now, error.to_string());
                    }
                }
                Some(Err(why)) => self.lose(now, why),
            },
            State::Open { .. } => return Ok(self.converse(now, sink)),
        }
        Ok(0)
    }

    fn name(&self) -> &str {
        "vrpn"
    }

    fn wait(&self, timeout: Duration) -> bool {
        let State::Open { stream, .. } = &self.state else { return false };
        let descriptor = stream.descriptor();
        descriptor.is_some() && wait_for_any([descriptor, None], timeout).is_ok()
    }

    fn status(&self) -> String {
        let c = self.gate.counters();
        let mut text = match &self.state {
            State::Open { greeted: true, .. } => format!("connected to {}", self.config.server),
            State::Open { .. } => {
                format!("{} accepted but did not greet: is it a VRPN server?", self.config.server)
            }
            _ => format!("not connected to {}", self.config.server),
        };
        if let Some(problem) = &self.problem {
            text.push_str(&format!("; {problem}"));
        }
        let is_there = |name: &String| self.names_seen.contains(name);
        let is_alone = is_there(&self.config.tracker);
        let missing = !is_alone && self.config.bodies.iter().any(|body| !is_there(&body.name));
        if self.is_connected() && c.samples.used > 0 && missing {
            text.push_str(&format!("; the server's devices are {:?}", self.names_seen));
        }
        if self.is_connected() && c.samples.used == 0 {
            let wanted = &self.config.tracker;
            text.push_str(&format!(
                "; no pose for tracker {wanted:?} or the rig's bodies; the server's devices are {:?}",
                self.names_seen
            ));
        }
        text.push_str(match (self.map.is_ready(), self.is_connected()) {
            (true, _) => "; clock by pings",
            (false, true) => "; pings unanswered: clock by the shortest delay seen",
            _ => "",
        });
        text.push_str(&format!("; connections {}, pongs {}, {c}", self.connections, self.pongs));
        text
    }

    fn gate(&self) -> Option<&SampleGate> {
        Some(&self.gate)
    }
}

#[cfg(test)]
#[path = "client_tests.rs"]
mod tests;
