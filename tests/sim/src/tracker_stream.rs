//! A VRPN server at the end of a TCP connection: what arrives is whole and in order, but late, or the connection is
//! gone.

use crate::cable::lock;
use crate::dice::Dice;
use crate::net::{Net, ServerKind};
use dpm_device::time::HostTime;
use dpm_device::tracker::vrpn::client::CONNECT_TIMEOUT;
use dpm_device::tracker::{Opener, Stream};
use hil_mock::faults::FaultPlan;
use hil_mock::tracker::SampleSource;
use hil_mock::vrpn_server::{VrpnConnection, VrpnNames, VrpnReports};
use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read, Write};
use std::sync::{Arc, Mutex};

/// The server's tracker, as the rig file names it.
pub const TRACKER: &str = "Tracker0";
/// What a system sends again for the first time after this time, and then after twice the time each.
const RESEND_NS: i64 = 200 * MS;
/// Bytes that both systems hold of a connection; a server that finds no room gives the connection up.
const WINDOW_BYTES: usize = 200_000;
/// The least time from one machine to the other.
const TRAVEL_NS: i64 = 100_000;
/// Its variation.
const JITTER_NS: i64 = 200_000;
const MS: i64 = 1_000_000;

/// The server of one life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StreamSetup {
    /// Error of the server's clock, parts per billion.
    pub skew_ppb: i32,
    /// Each body is also a tracker of its own.
    pub each_body: bool,
}

/// How network and server behave at present.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StreamFaults {
    /// Nobody listens: connecting is refused.
    pub refuses: bool,
    /// Nothing gets through: the cable is out, or the server's machine is off.
    pub cut: bool,
    /// The server's program hangs: its system accepts, and nobody says anything.
    pub hangs: bool,
    /// Something else listens at its port.
    pub other: bool,
}

/// One direction of a connection.
#[derive(Debug, Default)]
struct Pipe {
    landing: VecDeque<(i64, Vec<u8>)>,
    /// What was sent and not confirmed, since when, and how often it was sent again.
    lost: Vec<u8>,
    lost_since: i64,
    resent: u32,
}

impl Pipe {
    fn send(&mut self, bytes: &[u8], now: i64, is_cut: bool, dice: &mut Dice) {
        if is_cut || !self.lost.is_empty() {
            if self.lost.is_empty() {
                (self.lost_since, self.resent) = (now, 0);
            }
            return self.lost.extend_from_slice(bytes);
        }
        self.land(bytes.to_vec(), now, dice);
    }

    fn land(&mut self, bytes: Vec<u8>, now: i64, dice: &mut Dice) {
        let at = now + TRAVEL_NS + dice.between(0, JITTER_NS);
        let before = self.landing.back().map_or(0, |(at, _)| *at);
        self.landing.push_back((at.max(before), bytes));
    }

    /// When what was lost is sent again.
    fn resend_at(&self) -> i64 {
        if self.lost.is_empty() {
            return i64::MAX;
        }
        self.lost_since + RESEND_NS * ((2 << self.resent.min(20)) - 1)
    }

    /// Sends again what is due. Returns true if something was on its way.
    fn resend(&mut self, now: i64, is_cut: bool, dice: &mut Dice) -> bool {
        if self.resend_at() > now {
            return false;
        }
        self.resent += 1;
        if !is_cut {
            let lost = std::mem::take(&mut self.lost);
            self.land(lost, now, dice);
        }
        !is_cut
    }

    fn arrived(&mut self, now: i64) -> Option<Vec<u8>> {
        self.landing.front().filter(|(at, _)| *at <= now)?;
        self.landing.pop_front().map(|(_, bytes)| bytes)
    }

    fn arrives_at(&self) -> i64 {
        self.landing.front().map_or(i64::MAX, |(at, _)| *at)
    }

    fn held(&self) -> usize {
        self.lost.len() + self.landing.iter().map(|(_, bytes)| bytes.len()).sum::<usize>()
    }
}

/// How a connection ends for the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    /// In order: all that was sent is read first.
    Closed,
    /// At once.
    Reset,
}

/// The connection that the host knows.
struct Connection {
    /// The server's program has it; `None`: the server's machine has forgotten it, or the program has closed it.
    server: Option<VrpnConnection>,
    to_host: Pipe,
    to_server: Pipe,
    end: Option<(i64, End)>,
    number: u64,
    /// What the server says first, until it has said it.
    greeting: Vec<u8>,
}

/// See the module's documentation.
pub struct TrackerStream {
    setup: StreamSetup,
    names: VrpnNames,
    /// It announces another version.
    is_old: bool,
    reports: VrpnReports,
    /// The server's clock at time 0, microseconds.
    clock_us: i64,
    /// Nobody listens before.
    starts_at: i64,
    connection: Option<Connection>,
    /// An attempt of the host: when it is over, and why there is no connection.
    attempt: Option<(i64, Result<(), ErrorKind>)>,
    numbers: u64,
    dice: Dice,
}

fn names_of(kind: &ServerKind, setup: &StreamSetup) -> VrpnNames {
    let tracker = if kind.name == "a" { TRACKER } else { "Tracker7" };
    VrpnNames { tracker: tracker.into(), bodies: vec![kind.name.clone()], each_body: setup.each_body }
}

fn reports_of(source: SampleSource) -> Result<VrpnReports, String> {
    VrpnReports::new(source).map_err(|e| e.to_string())
}

impl TrackerStream {
    /// A server of this kind, which nobody is connected to.
    pub fn new(
        seed: u64,
        kind: &ServerKind,
        source: SampleSource,
        setup: StreamSetup,
    ) -> Result<Self, String> {
        Ok(Self {
            names: names_of(kind, &setup),
            setup,
            is_old: kind.is_old,
            reports: reports_of(source)?,
            clock_us: 1_700_000_000_000_000,
            starts_at: 0,
            connection: None,
            attempt: None,
            numbers: 0,
            dice: Dice::new(seed, 0x56a9),
        })
    }

    /// The server has these faults from now on.
    pub fn set_faults(&mut self, faults: FaultPlan) {
        self.reports.set_faults(faults);
    }

    /// Another server takes the place of this one, after some time in which nobody listens. Its clock is another one.
    pub fn replace(&mut self, kind: &ServerKind, source: SampleSource, now: i64) -> Result<(), String> {
        self.reports = reports_of(source)?;
        self.reports.begin_at(HostTime(now));
        (self.names, self.is_old) = (names_of(kind, &self.setup), kind.is_old);
        self.set_clock();
        self.starts_at = now + self.dice.decades(1, 300) * MS;
        let end = if self.dice.happens(0.5) { End::Closed } else { End::Reset };
        self.close(now, end);
        Ok(())
    }

    /// The server's clock is set by up to an hour.
    pub fn set_clock(&mut self) {
        self.clock_us += self.dice.between(-3_600_000_000, 3_600_000_000);
    }

    /// The server's end of the connection is closed.
    fn close(&mut self, now: i64, how: End) {
        let Some(connection) = &mut self.connection else { return };
        if connection.server.take().is_some() {
            let after = connection.to_host.landing.back().map_or(now, |(at, _)| *at);
            let at = if how == End::Closed { after.max(now + TRAVEL_NS) } else { now + TRAVEL_NS };
            connection.end.get_or_insert((at, how));
        }
    }

    /// The connection is reset.
    pub fn reset(&mut self, now: i64) {
        self.close(now, End::Reset);
    }

    /// The server's machine forgets the connection, and tells nobody.
    pub fn forget(&mut self) {
        if let Some(connection) = &mut self.connection {
            connection.server = None;
            connection.to_host = Pipe::default();
        }
    }

    fn wall_us(clock_us: i64, skew_ppb: i32, t: i64) -> u64 {
        let t = i128::from(t);
        let us = (t + t * i128::from(skew_ppb) / 1_000_000_000) / 1_000;
        (i128::from(clock_us) + us).max(1) as u64
    }

    /// When something happens here next.
    pub fn due(&self, faults: &StreamFaults) -> i64 {
        let report = self.reports.next_due().0;
        let Some(connection) = &self.connection else { return report };
        let resent = connection.to_server.resend_at().min(connection.to_host.resend_at());
        let heard = if faults.hangs { i64::MAX } else { connection.to_server.arrives_at() };
        report.min(heard).min(resent)
    }

    /// When the host finds something in its socket, as far as that is known.
    pub fn next_arrival(&self) -> i64 {
        let Some(connection) = &self.connection else { return i64::MAX };
        let end = connection.end.map_or(i64::MAX, |(at, _)| at);
        connection.to_host.arrives_at().min(end).min(self.reports.next_due().0 + TRAVEL_NS)
    }

    /// Advances to `now`.
    pub fn advance(&mut self, now: i64, faults: &StreamFaults) {
        let due = self.reports.take_due(HostTime(now));
        if faults.hangs {
            // A program that hangs says nothing, and what it would have said is lost.
            return self.resend(now, faults.cut);
        }
        self.hear(now, faults);
        self.report(&due, now, faults.cut);
        self.resend(now, faults.cut);
    }

    fn resend(&mut self, now: i64, is_cut: bool) {
        let Some(connection) = &mut self.connection else { return };
        connection.to_host.resend(now, is_cut, &mut self.dice);
        connection.to_server.resend(now, is_cut, &mut self.dice);
    }

    /// The server reads what has arrived, and answers.
    fn hear(&mut self, now: i64, faults: &StreamFaults) {
        let wall_us = Self::wall_us(self.clock_us, self.setup.skew_ppb, now);
        let Some(connection) = &mut self.connection else { return };
        if !connection.greeting.is_empty() {
            let greeting = std::mem::take(&mut connection.greeting);
            connection.to_host.send(&greeting, now, faults.cut, &mut self.dice);
        }
        let mut is_broken = false;
        while let Some(bytes) = connection.to_server.arrived(now) {
            let Some(server) = &mut connection.server else {
                // Its system knows of no such connection, and says so.
                if !faults.cut {
                    connection.end.get_or_insert((now + TRAVEL_NS, End::Reset));
                }
                continue;
            };
            let mut out = Vec::new();
            is_broken |= server.on_bytes(&self.names, &bytes, wall_us, &mut out).is_err();
            if !out.is_empty() {
                connection.to_host.send(&out, now, faults.cut, &mut self.dice);
            }
        }
        if is_broken {
            self.close(now, End::Closed);
        }
    }

    fn report(&mut self, due: &[u64], now: i64, is_cut: bool) {
        let (clock_us, skew_ppb) = (self.clock_us, self.setup.skew_ppb);
        let wall_us_at = move |t: HostTime| Self::wall_us(clock_us, skew_ppb, t.0);
        for k in due {
            let Some(connection) = &mut self.connection else { return };
            let Some(server) = connection.server.as_mut().filter(|server| server.is_greeted()) else {
                return;
            };
            let mut out = Vec::new();
            let is_whole = self.reports.put_report(*k, &self.names, server, &wall_us_at, &mut out);
            if !out.is_empty() {
                connection.to_host.send(&out, now, is_cut, &mut self.dice);
            }
            if !is_whole {
                self.close(now, End::Closed);
            } else if connection.to_host.held() > WINDOW_BYTES {
                self.close(now, End::Reset);
            }
        }
    }

    /// The host begins to connect.
    fn begin_to_connect(&mut self, now: i64, faults: &StreamFaults) {
        self.connection = None;
        let there_and_back = 2 * TRAVEL_NS + self.dice.between(0, 2 * JITTER_NS);
        self.attempt = Some(if faults.cut {
            // It would be asked again after a second, when nobody waits any longer.
            (now + CONNECT_TIMEOUT.as_nanos() as i64, Err(ErrorKind::TimedOut))
        } else if faults.refuses || now < self.starts_at {
            (now + there_and_back, Err(ErrorKind::ConnectionRefused))
        } else {
            (now + there_and_back, Ok(()))
        });
    }

    fn connected(&mut self, now: i64, faults: &StreamFaults) -> Option<Result<u64, String>> {
        let (_, outcome) = self.attempt.take_if(|(at, _)| *at <= now)?;
        if let Err(kind) = outcome {
            return Some(Err(format!("cannot connect to 10.0.0.2: {kind}")));
        }
        let mut greeting = Vec::new();
        let server = VrpnConnection::new(&self.names, &mut greeting);
        if self.is_old {
            greeting[11..13].copy_from_slice(b"06");
        }
        if faults.other {
            greeting = b"HTTP/1.1 400 Bad Request\r\n\r\n".to_vec();
        }
        self.numbers += 1;
        let number = self.numbers;
        let server = (!faults.other).then_some(server);
        let end = faults.other.then_some((now + MS, End::Closed));
        let (to_host, to_server) = (Pipe::default(), Pipe::default());
        self.connection = Some(Connection { server, to_host, to_server, end, number, greeting });
        Some(Ok(number))
    }

    fn at(&mut self, number: u64) -> Option<&mut Connection> {
        self.connection.as_mut().filter(|connection| connection.number == number)
    }

    fn read(&mut self, number: u64, into: &mut [u8], now: i64) -> io::Result<usize> {
        let Some(connection) = self.at(number) else { return Err(ErrorKind::ConnectionReset.into()) };
        let end = connection.end.filter(|(at, _)| *at <= now).map(|(_, end)| end);
        if end == Some(End::Reset) {
            return Err(ErrorKind::ConnectionReset.into());
        }
        let Some(mut bytes) = connection.to_host.arrived(now) else {
            return if end.is_some() { Ok(0) } else { Err(ErrorKind::WouldBlock.into()) };
        };
        let n = bytes.len().min(into.len());
        into[..n].copy_from_slice(&bytes[..n]);
        if n < bytes.len() {
            bytes.drain(..n);
            connection.to_host.landing.push_front((now, bytes));
        }
        Ok(n)
    }

    fn write(&mut self, number: u64, bytes: &[u8], now: i64, is_cut: bool) -> io::Result<usize> {
        let Self { connection, dice, .. } = self;
        let Some(connection) = connection.as_mut().filter(|connection| connection.number == number) else {
            return Err(ErrorKind::BrokenPipe.into());
        };
        if connection.end.is_some_and(|(at, _)| at <= now) {
            return Err(ErrorKind::BrokenPipe.into());
        }
        connection.to_server.send(bytes, now, is_cut, dice);
        Ok(bytes.len())
    }

    /// The host has closed its end.
    fn hang_up(&mut self, number: u64) {
        if self.at(number).is_some() {
            self.connection = None;
        }
    }
}

/// Connects to the simulated server.
pub struct ServerOpener(pub Arc<Mutex<Net>>);

impl Opener for ServerOpener {
    fn begin(&mut self) -> bool {
        lock(&self.0).on_stream(TrackerStream::begin_to_connect).is_some()
    }

    fn outcome(&mut self) -> Option<Result<Box<dyn Stream>, String>> {
        let mut net = lock(&self.0);
        let connected = net.on_stream(TrackerStream::connected)??;
        if net.called().is_err() {
            return Some(Err("cannot connect to 10.0.0.2: no buffer space available".into()));
        }
        Some(connected.map(|number| Box::new(TrackerSocket(self.0.clone(), number)) as Box<dyn Stream>))
    }
}

/// The host's socket.
struct TrackerSocket(Arc<Mutex<Net>>, u64);

impl Stream for TrackerSocket {}

impl Read for TrackerSocket {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let mut net = lock(&self.0);
        net.called()?;
        net.on_stream(|stream, now, _| stream.read(self.1, into, now)).unwrap_or(Ok(0))
    }
}

impl Write for TrackerSocket {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let write = |stream: &mut TrackerStream, now, faults: &StreamFaults| {
            stream.write(self.1, bytes, now, faults.cut)
        };
        let mut net = lock(&self.0);
        net.called()?;
        net.on_stream(write).unwrap_or(Ok(0))
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Drop for TrackerSocket {
    fn drop(&mut self) {
        let _ = lock(&self.0).on_stream(|stream, _, _| stream.hang_up(self.1));
    }
}
