//! The tracker's server and the network between it and the host.

use crate::cable::lock;
use crate::calls::Calls;
use crate::dice::Dice;
use crate::eyes::{head_motion, GLASSES, GLASSES_NUMBER};
use crate::plan::TrackerSetup;
use crate::tracker_line::{LineFaults, TrackerLine};
use crate::tracker_stream::{StreamFaults, TrackerStream};
use dpm_device::pose::Pose;
use dpm_device::time::{FrameRate, HostClock, HostTime};
use dpm_device::tracker::natnet::wire::Version;
use dpm_device::tracker::udp::{Arrival, Datagrams};
use hil_mock::faults::FaultPlan;
use hil_mock::motion::{Motion, MotionSpec};
use hil_mock::natnet_server::{NatNetServer, NatNetServerConfig, Streaming, UnicastTo};
use hil_mock::tracker::{MockTrackerConfig, SampleSource};
use std::collections::VecDeque;
use std::io;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::{Arc, Mutex};

/// The server's address.
pub const SERVER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 2), 1510);
/// The host's command socket.
const CLIENT: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 40_000);
/// Datagrams that the host's socket holds.
const QUEUED: usize = 2_000;

/// What the server sends.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServerKind {
    /// Samples per second.
    pub rate_hz: u32,
    /// Name of the first body.
    pub name: String,
    /// Its streaming number.
    pub number: i32,
    /// 4.1, or 3.0.
    pub is_old: bool,
    /// Positions in millimetres.
    pub millimetres: bool,
    /// How the body moves.
    pub motion: BodyMotion,
    /// Somebody with glasses is seen, too.
    pub has_glasses: bool,
}

/// How the network behaves at present.
#[derive(Clone, Copy, Debug, Default)]
pub struct NetFaults {
    /// Nothing gets through in either direction.
    pub cut: bool,
    /// The server's machine is off.
    pub away: bool,
    /// Everything from the server waits until this is false again.
    pub held: bool,
    /// Share of datagrams that old ones follow.
    pub replay: f64,
    /// Extra delay of datagrams from the server, at most.
    pub late_ns: i64,
    /// Datagrams of strangers per millisecond.
    pub flood: i64,
    /// They carry the server's address.
    pub forged: bool,
    /// They have the greatest size.
    pub huge: bool,
    /// The host opens no sockets.
    pub no_sockets: bool,
    /// Those of a serial line.
    pub line: LineFaults,
    /// Those of a VRPN server and the way to it.
    pub stream: StreamFaults,
}

/// What speaks to the host.
enum Server {
    /// By datagrams.
    NatNet(NatNetServer),
    /// On a serial line.
    Serial(TrackerLine),
    /// By a connection.
    Vrpn(TrackerStream),
}

/// The server, the network and the host's socket.
pub struct Net {
    /// True time.
    pub now: i64,
    /// True time minus the host's clock.
    pub host_lag: i64,
    /// The host's wall clock minus true time.
    pub wall_ahead: i64,
    server: Server,
    kind: ServerKind,
    seed: u64,
    /// Faults of samples, and when each is over.
    windows: Vec<(i64, String)>,
    /// The last restart of the server, as a fault.
    restart: Option<String>,
    /// The faults.
    pub faults: NetFaults,
    /// The program's calls to its socket, connection or port.
    pub calls: Calls,
    /// Arrival, and the stamp that the host's kernel gives it; sender; bytes.
    to_host: VecDeque<(i64, i64, SocketAddrV4, Vec<u8>)>,
    held: Vec<Vec<u8>>,
    old: Vec<u8>,
    travel_ns: i64,
    flooded_at: i64,
    /// Datagrams that strangers sent, and old ones that came again.
    pub met: [u64; 2],
    dice: Dice,
    spare: Vec<Vec<u8>>,
    /// Datagrams that were thrown away because the socket was full.
    pub overrun: u64,
}

/// How the body moves: to and fro by 0.3 m/s at most.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BodyMotion {
    /// As a pendulum.
    Swings,
    /// On a straight line with turns of so many m/s2 at its ends.
    Turns(u32),
}

impl BodyMotion {
    /// Its greatest acceleration, m/s2.
    pub fn acceleration(self) -> f64 {
        match self {
            Self::Swings => 1.0,
            Self::Turns(acceleration) => f64::from(acceleration),
        }
    }

    /// The true motion of the body from time 0 of the world on, `scale` times as large.
    ///
    /// # Errors
    /// The motion is none, which is a mistake in this program.
    pub fn of(self, scale: f64) -> Result<Motion, String> {
        let spec = match self {
            Self::Swings => MotionSpec::Sinusoid {
                direction: [1.0, 0.0, 0.0],
                peak_speed_m_s: 0.3 * scale,
                peak_acceleration_m_s2: 1.0 * scale,
            },
            Self::Turns(acceleration) => MotionSpec::Translate {
                direction: [1.0, 0.4, 0.0],
                speed_m_s: 0.3 * scale,
                amplitude_m: 0.06 * scale,
                acceleration_m_s2: f64::from(acceleration) * scale,
                rest_s: 0.0,
            },
        };
        let rest = Pose { position_m: [0.0, 0.1 * scale, 0.0], ..Pose::IDENTITY };
        Motion::new(&spec, rest).map_err(|e| e.to_string())
    }
}

fn source(kind: &ServerKind, seed: u64) -> Result<SampleSource, String> {
    let config = MockTrackerConfig {
        seed,
        rate: FrameRate::new(kind.rate_hz, 1).ok_or("a rate of 0")?,
        position_noise_m: 0.000_1,
        rotation_noise_rad: 0.000_3,
        latency_ns: 3_000_000,
        latency_jitter_ns: 300_000,
        ..Default::default()
    };
    let scale = if kind.millimetres { 1000.0 } else { 1.0 };
    let mut bodies = vec![kind.motion.of(scale)?];
    if kind.has_glasses {
        bodies.push(head_motion(scale)?);
    }
    SampleSource::new(config, bodies).map_err(|e| e.to_string())
}

fn natnet(kind: &ServerKind, seed: u64) -> Result<NatNetServer, String> {
    let glasses = kind.has_glasses.then(|| (GLASSES.to_owned(), GLASSES_NUMBER));
    let config = NatNetServerConfig {
        bodies: [(kind.name.clone(), kind.number)].into_iter().chain(glasses).collect(),
        version: if kind.is_old { Version::V3_0 } else { Version::V4_1 },
        streaming: Streaming::Unicast(UnicastTo::CommandSocket),
        ..NatNetServerConfig::new(&["a"])
    };
    NatNetServer::new(config, source(kind, seed)?).map_err(|e| e.to_string())
}

fn server(kind: &ServerKind, seed: u64, tracker: TrackerSetup) -> Result<Server, String> {
    Ok(match tracker {
        TrackerSetup::NatNet => Server::NatNet(natnet(kind, seed)?),
        TrackerSetup::Serial(setup) => {
            Server::Serial(TrackerLine::new(seed, kind, source(kind, seed)?, setup)?)
        }
        TrackerSetup::Vrpn(setup) => {
            Server::Vrpn(TrackerStream::new(seed, kind, source(kind, seed)?, setup)?)
        }
    })
}

impl Net {
    /// A server of this kind.
    ///
    /// # Errors
    /// The server's settings are wrong, which is a mistake in this program.
    pub fn new(seed: u64, kind: ServerKind, tracker: TrackerSetup) -> Result<Self, String> {
        Ok(Self {
            now: 0,
            host_lag: 0,
            wall_ahead: 1_800_000_000_000_000_000,
            server: server(&kind, seed, tracker)?,
            kind,
            seed,
            windows: Vec::new(),
            restart: None,
            faults: NetFaults::default(),
            calls: Calls::default(),
            to_host: VecDeque::new(),
            held: Vec::new(),
            old: Vec::new(),
            travel_ns: 150_000,
            flooded_at: 0,
            met: [0; 2],
            dice: Dice::new(seed, 0x6e65),
            spare: Vec::new(),
            overrun: 0,
        })
    }

    /// What the server is at present.
    pub fn kind(&self) -> &ServerKind {
        &self.kind
    }

    /// Adds a fault of the mock tracker, in its notation, that is over at `until`; its window begins now.
    ///
    /// # Errors
    /// It is none, which is a mistake in this program.
    pub fn strike(&mut self, fault: &str, until: i64) -> Result<(), String> {
        let now = self.now;
        self.windows.retain(|(end, _)| *end + 2_000_000_000 > now);
        self.windows.push((until, fault.to_owned()));
        self.plan()
    }

    fn plan(&mut self) -> Result<(), String> {
        let texts: Vec<&str> =
            self.windows.iter().map(|(_, text)| text.as_str()).chain(self.restart.as_deref()).collect();
        let plan = texts.join(",");
        let parsed: FaultPlan = plan.parse().map_err(|e| format!("{plan}: {e}"))?;
        match &mut self.server {
            Server::NatNet(server) => server.set_faults(parsed).map_err(|e| e.to_string()),
            Server::Serial(line) => line.set_faults(parsed),
            Server::Vrpn(stream) => {
                stream.set_faults(parsed);
                Ok(())
            }
        }
    }

    /// The program makes a call.
    ///
    /// # Errors
    /// It is the one that fails.
    pub(crate) fn called(&mut self) -> io::Result<()> {
        if self.calls.fails() {
            return Err(io::Error::other("input/output error"));
        }
        Ok(())
    }

    /// Works on the serial line, if the tracker hangs on one; `now` and its faults are handed in.
    pub(crate) fn on_line<R>(
        &mut self,
        work: impl FnOnce(&mut TrackerLine, i64, &LineFaults) -> R,
    ) -> Option<R> {
        let Self { server: Server::Serial(line), now, faults, .. } = self else { return None };
        Some(work(line, *now, &LineFaults { held: faults.held, ..faults.line }))
    }

    /// The same for a VRPN server.
    pub(crate) fn on_stream<R>(
        &mut self,
        work: impl FnOnce(&mut TrackerStream, i64, &StreamFaults) -> R,
    ) -> Option<R> {
        let Self { server: Server::Vrpn(stream), now, faults, .. } = self else { return None };
        let is_cut = faults.held || faults.stream.cut;
        Some(work(stream, *now, &StreamFaults { cut: is_cut, ..faults.stream }))
    }

    /// Another server takes the place of this one: restarted, renamed, of another version, with another rate. Its
    /// clock and its frame numbers begin anew.
    ///
    /// # Errors
    /// As [`Net::new`].
    pub fn replace(&mut self, kind: ServerKind) -> Result<(), String> {
        let now = self.now;
        match &mut self.server {
            Server::NatNet(server) => {
                *server = natnet(&kind, self.seed)?;
                self.restart = Some(format!("reset@{now}ns"));
                server.begin_at(HostTime(now));
            }
            Server::Serial(line) => line.replace(&kind, source(&kind, self.seed)?, now)?,
            Server::Vrpn(stream) => stream.replace(&kind, source(&kind, self.seed)?, now)?,
        }
        self.kind = kind;
        self.plan()
    }

    /// When something happens here next.
    pub fn due(&self) -> i64 {
        let server = match &self.server {
            Server::NatNet(_) if self.faults.away => i64::MAX,
            Server::NatNet(server) => server.next_due().0,
            Server::Serial(line) => line.due(&LineFaults { held: self.faults.held, ..self.faults.line }),
            Server::Vrpn(stream) => stream.due(&self.faults.stream),
        };
        let flood = if self.faults.flood > 0 { self.flooded_at + 1_000_000 } else { i64::MAX };
        server.max(self.now).min(flood.max(self.now))
    }

    /// When the next datagram reaches the host.
    pub fn next_arrival(&self) -> i64 {
        let front = self.to_host.front().map_or(i64::MAX, |d| d.0);
        match &self.server {
            Server::NatNet(_) if self.faults.away => front,
            Server::NatNet(server) => front.min(server.next_due().0.max(self.now) + self.travel_ns),
            Server::Serial(line) => line.next_arrival(self.now),
            Server::Vrpn(stream) => stream.next_arrival(),
        }
    }

    /// Advances to `now`.
    pub fn advance(&mut self, now: i64) {
        self.now = now;
        let _ = self.on_line(|line, now, faults| line.advance(now, faults));
        let _ = self.on_stream(|stream, now, faults| stream.advance(now, faults));
        if !self.held.is_empty() && !self.faults.held {
            for bytes in std::mem::take(&mut self.held) {
                self.deliver(bytes);
            }
        }
        let Self { server, spare, .. } = self;
        let mut sent = Vec::new();
        match server {
            Server::NatNet(server) if !self.faults.away && server.next_due().0 <= now => {
                server.stream(HostTime(now), &mut |bytes, _| {
                    let mut copy: Vec<u8> = spare.pop().unwrap_or_default();
                    copy.extend_from_slice(bytes);
                    sent.push(copy);
                });
            }
            _ => {}
        }
        sent.into_iter().for_each(|bytes| self.server_sends(bytes));
        if self.faults.flood > 0 && self.flooded_at + 1_000_000 <= now {
            self.flooded_at = now;
            for _ in 0..self.faults.flood {
                self.stranger();
            }
        }
    }

    fn stranger(&mut self) {
        self.met[0] += 1;
        let len = if self.faults.huge { 65_000 } else { self.dice.between(0, 300) as usize };
        let mut bytes: Vec<u8> = self.spare.pop().unwrap_or_default();
        if self.faults.forged && !self.old.is_empty() && self.dice.happens(0.7) {
            bytes.extend_from_slice(&self.old);
            let at = self.dice.bits() as usize % bytes.len();
            bytes[at] ^= self.dice.bits() as u8;
        } else {
            bytes.resize(len, 0x5a);
        }
        let ip = if self.faults.forged { *SERVER.ip() } else { Ipv4Addr::new(10, 0, 0, 77) };
        let from = SocketAddrV4::new(ip, 5_000 + (self.dice.bits() % 3) as u16);
        self.push(self.now + self.travel_ns, from, bytes);
    }

    fn server_sends(&mut self, bytes: Vec<u8>) {
        if self.faults.cut {
            return;
        }
        if self.faults.held {
            if self.held.len() < 200 {
                self.held.push(bytes);
            }
            return;
        }
        self.deliver(bytes);
    }

    fn deliver(&mut self, bytes: Vec<u8>) {
        let late = if self.faults.late_ns > 0 { self.dice.between(0, self.faults.late_ns) } else { 0 };
        let at = self.now + self.travel_ns + late;
        if self.faults.replay > 0.0 && self.dice.happens(self.faults.replay) && !self.old.is_empty() {
            self.met[1] += 1;
            let again = self.old.clone();
            self.push(at, SERVER, again);
        }
        // The first datagram that is seen, and seldom a newer one.
        if self.old.is_empty() || self.dice.happens(0.01) {
            self.old.clear();
            self.old.extend_from_slice(&bytes);
        }
        self.push(at, SERVER, bytes);
    }

    fn push(&mut self, at: i64, from: SocketAddrV4, bytes: Vec<u8>) {
        if self.to_host.len() >= QUEUED {
            self.overrun += 1;
            return;
        }
        let place = self.to_host.partition_point(|d| d.0 <= at);
        self.to_host.insert(place, (at, at + self.wall_ahead, from, bytes));
    }

    fn receive(&mut self, buffer: &mut [u8]) -> Option<Arrival> {
        let (at, ..) = self.to_host.front()?;
        if *at > self.now {
            return None;
        }
        let (_, stamp, from, mut bytes) = self.to_host.pop_front()?;
        let len = bytes.len().min(buffer.len());
        buffer[..len].copy_from_slice(&bytes[..len]);
        let arrival = Arrival { len, from, kernel_ns: Some(stamp), cut: bytes.len() > buffer.len() };
        bytes.clear();
        if self.spare.len() < 64 {
            self.spare.push(bytes);
        }
        Some(arrival)
    }

    fn host_sends(&mut self, bytes: &[u8]) {
        if self.faults.cut || self.faults.away {
            return;
        }
        // The request arrives at once and its answers travel both ways' time.
        let mut answers = Vec::new();
        let now = HostTime(self.now + self.travel_ns);
        if let Server::NatNet(server) = &mut self.server {
            server.on_datagram(bytes, CLIENT, now, &mut |answer, _| answers.push(answer.to_vec()));
        }
        for answer in answers {
            let at = self.now + 2 * self.travel_ns;
            self.push(at, SERVER, answer);
        }
    }

    /// The server is to be moved at every event, not only when something is due there.
    pub fn is_wired(&self) -> bool {
        !matches!(self.server, Server::NatNet(_))
    }

    /// The socket is new: nothing waits in it.
    pub fn new_socket(&mut self) {
        self.to_host.clear();
    }
}

/// The host's socket.
pub struct SimSocket(pub Arc<Mutex<Net>>);

impl Datagrams for SimSocket {
    fn receive(&self, buffer: &mut [u8]) -> io::Result<Option<Arrival>> {
        let mut net = lock(&self.0);
        net.called()?;
        Ok(net.receive(buffer))
    }

    fn send(&self, bytes: &[u8], _: SocketAddrV4) -> io::Result<()> {
        let mut net = lock(&self.0);
        net.called()?;
        net.host_sends(bytes);
        Ok(())
    }

    fn keep_only(&self, _: Ipv4Addr, _: &[u16]) -> io::Result<()> {
        Err(io::Error::other("no filter"))
    }

    fn keep_all(&self) -> io::Result<()> {
        Ok(())
    }

    fn realtime_offset_ns(&self, _: &dyn HostClock) -> i64 {
        let net = lock(&self.0);
        -net.host_lag - net.wall_ahead
    }

    fn local(&self) -> io::Result<SocketAddrV4> {
        Ok(CLIENT)
    }
}
