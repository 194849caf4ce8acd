//! The serial tracker: opens the port, reads samples, maps the clock by echoes, and reopens after an unplug, all inside
//! [`Tracker::poll`], which never blocks.

use super::wire::{SerialMessage, MAX_PACKET, VERSION};
use crate::clock_map::{ClockMap, ExchangeOutcome};
use crate::cobs::Deframer;
use crate::pose::Pose;
use crate::time::{DeviceTicks, HostClock, HostTime};
use crate::tracker::{
    BodyIndex, BodyKey, SampleGate, Stream, Tracker, TrackerCounters, TrackerError, TrackerSample,
};
use crossbeam::channel::{Receiver, TryRecvError};
use serialport::SerialPort;
use std::io::ErrorKind;
use std::sync::Arc;

const MS: i64 = 1_000_000;
/// Interval between attempts to open the port.
const RETRY_EVERY_NS: i64 = 200 * MS;
/// Bytes read in one poll: 90 ms of 921,600 baud, so a backlog is gone in a few polls.
const MAX_BYTES_PER_POLL: usize = 8192;
const QUICK_ECHOES: u32 = 20;
const QUICK_ECHO_EVERY_NS: i64 = 10 * MS;
const ECHO_EVERY_NS: i64 = 200 * MS;
/// Samples are passed on once an echo came back within this time. Bytes that had waited in the port when it was opened
/// (the kernel keeps more than can be flushed) precede the answer to the first echo, and delay it.
const SETTLED_ROUND_TRIP_NS: i64 = 50 * MS;
/// If a device answers no echo, its samples are accepted this long after the port was opened, as soon as the port is
/// empty.
const SETTLED_AFTER_NS: i64 = 300 * MS;

/// Configuration of a serial tracker.
#[derive(Clone, Debug)]
pub struct SerialTrackerConfig {
    /// Device file.
    pub port: String,
    /// Bits per second; irrelevant for USB serial ports and pseudo-terminals.
    pub baud: u32,
    /// The rig's bodies: a body's `id` is its number on the wire; without one its index in the list is.
    pub bodies: Vec<BodyKey>,
}

enum State {
    Idle { retry_at: HostTime },
    Opening(Receiver<serialport::Result<Box<dyn SerialPort>>>),
    Open(Box<dyn Stream>),
}

/// A tracker on a serial port.
pub struct SerialTracker {
    config: SerialTrackerConfig,
    clock: Arc<dyn HostClock>,
    state: State,
    deframer: Deframer<[u8; MAX_PACKET]>,
    gate: SampleGate,
    buffer: Vec<u8>,
    out: Vec<u8>,
    map: Option<ClockMap>,
    ticks_per_second: u32,
    echo_sent: Option<HostTime>,
    echo_due: HostTime,
    echoes: u32,
    opened: u64,
    opened_at: HostTime,
    /// No sample that waited in the port can arrive any more.
    is_settled: bool,
    problem: Option<String>,
}

impl SerialTracker {
    /// A tracker that opens its port when polled. `clock` is the host's clock, the one `poll` is called with.
    pub fn open(config: SerialTrackerConfig, clock: Arc<dyn HostClock>) -> Result<Self, TrackerError> {
        if config.port.is_empty() {
            return Err(TrackerError::Protocol("serial tracker: the port is empty".into()));
        }
        Ok(Self {
            gate: SampleGate::new(config.bodies.len()),
            config,
            clock,
            state: State::Idle { retry_at: HostTime(i64::MIN) },
            deframer: Deframer::new([0; MAX_PACKET]),
            buffer: vec![0; MAX_BYTES_PER_POLL],
            out: Vec::with_capacity(64),
            map: None,
            ticks_per_second: 0,
            echo_sent: None,
            echo_due: HostTime(i64::MIN),
            echoes: 0,
            opened: 0,
            opened_at: HostTime(i64::MIN),
            is_settled: false,
            problem: None,
        })
    }

    /// A tracker whose port is open already: a conversation in memory, where a test writes the device's part. If it is
    /// lost, the tracker opens `config.port` like any other.
    pub fn over(
        config: SerialTrackerConfig,
        clock: Arc<dyn HostClock>,
        port: Box<dyn Stream>,
    ) -> Result<Self, TrackerError> {
        let now = clock.now();
        let mut this = Self::open(config, clock)?;
        this.begin(port, now);
        Ok(this)
    }

    /// Counters of all input, by outcome.
    pub fn counters(&self) -> &TrackerCounters {
        self.gate.counters()
    }

    /// True while the port is open.
    pub fn is_open(&self) -> bool {
        matches!(self.state, State::Open(_))
    }

    /// The map of the device's clock, once an echo was answered.
    pub fn clock_map(&self) -> Option<&ClockMap> {
        self.map.as_ref().filter(|m| m.is_ready())
    }

    fn start_opening(&self, now: HostTime) -> State {
        let (send, receive) = crossbeam::channel::bounded(1);
        let (port, baud) = (self.config.port.clone(), self.config.baud);
        // Opening a port can block in its driver, so a helper thread does it, one attempt at a time. Zero timeout:
        // reads and writes never block.
        let spawned = std::thread::Builder::new().name("serial-open".into()).spawn(move || {
            let opened = crate::tty::open(&port, baud);
            // If the tracker was dropped, nobody receives this, and the port closes again.
            let _ = send.send(opened);
        });
        match spawned {
            Ok(_) => State::Opening(receive),
            Err(_) => State::Idle { retry_at: now.plus_ns(RETRY_EVERY_NS) },
        }
    }

    fn begin(&mut self, port: Box<dyn Stream>, now: HostTime) {
        self.deframer.reset();
        (self.map, self.ticks_per_second) = (None, 0);
        (self.echo_sent, self.echo_due, self.echoes) = (None, now, 0);
        self.opened += 1;
        (self.opened_at, self.is_settled) = (now, false);
        self.problem = None;
        self.state = State::Open(port);
    }

    fn lose(&mut self, now: HostTime, why: String) {
        self.problem = Some(why);
        self.state = State::Idle { retry_at: now.plus_ns(RETRY_EVERY_NS) };
    }

    fn listen(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> usize {
        let State::Open(port) = &mut self.state else { return 0 };
        let n = match port.read(&mut self.buffer) {
            Ok(0) => return self.hung_up(now),
            Ok(n) => n,
            Err(e)
                if matches!(
                    e.kind(),
                    ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted
                ) =>
            {
                0
            }
            Err(e) => {
                self.lose(now, format!("{}: {e}", self.config.port));
                return 0;
            }
        };
        let at = self.clock.now();
        let buffer = std::mem::take(&mut self.buffer);
        let mut deframer = self.deframer.clone();
        let before = deframer.counters();
        let mut delivered = 0;
        deframer.push(&buffer[..n], &mut |packet| {
            delivered += self.take_in(SerialMessage::decode(packet), at, sink);
        });
        let after = deframer.counters();
        let broken = after.broken.wrapping_sub(before.broken) + after.too_long.wrapping_sub(before.too_long);
        let packets = self.gate.packets_mut();
        packets.received += u64::from(broken);
        packets.malformed += u64::from(broken);
        self.deframer = deframer;
        let is_empty = n < buffer.len();
        self.buffer = buffer;
        self.is_settled |= is_empty && at.ns_since(self.opened_at) >= SETTLED_AFTER_NS;
        self.echo(at);
        delivered
    }

    fn hung_up(&mut self, now: HostTime) -> usize {
        self.lose(now, format!("{} was unplugged: check cable and supply", self.config.port));
        0
    }

    fn take_in(
        &mut self,
        message: Result<SerialMessage, super::wire::SerialError>,
        at: HostTime,
        sink: &mut dyn FnMut(&TrackerSample),
    ) -> usize {
        use super::wire::SerialError as E;
        self.gate.packets_mut().received += 1;
        let (used, delivered) = match message {
            Ok(SerialMessage::Pose {
                body,
                tracked,
                sequence,
                captured,
                position,
                rotation_xyzw,
                mean_error,
            }) => {
                let captured_at = self.captured_at(captured, at);
                let place = |(i, b): (usize, &BodyKey)| b.id.unwrap_or(i as i64) == i64::from(body);
                let delivered = match self.config.bodies.iter().enumerate().position(place) {
                    None => {
                        self.gate.count_unknown();
                        0
                    }
                    Some(_) if !self.is_settled => {
                        self.gate.count_unknown_age();
                        0
                    }
                    Some(i) => {
                        let sample = TrackerSample {
                            body: BodyIndex(i as u16),
                            pose: Pose {
                                position_m: position.map(f64::from),
                                rotation_xyzw: rotation_xyzw.map(f64::from),
                            },
                            tracked,
                            mean_error_m: mean_error,
                            sequence,
                            captured_at,
                            received_at: at,
                        };
                        self.gate.admit(&sample).map_or(0, |sample| {
                            sink(&sample);
                            1
                        })
                    }
                };
                (Ok(()), delivered)
            }
            Ok(SerialMessage::Hello { version: VERSION, ticks_per_second, .. }) => {
                if ticks_per_second != self.ticks_per_second || self.map.is_none() {
                    self.ticks_per_second = ticks_per_second;
                    self.map = ClockMap::new(u64::from(ticks_per_second)).ok();
                    (self.echoes, self.echo_due) = (0, at);
                }
                (Ok(()), 0)
            }
            Ok(SerialMessage::EchoResponse { token, ticks }) => (self.on_echo(token, ticks, at), 0),
            Ok(
                SerialMessage::Hello { .. } | SerialMessage::HelloRequest | SerialMessage::EchoRequest { .. },
            ) => (Err(false), 0),
            Err(E::Unknown { .. }) => (Err(false), 0),
            Err(E::Short(_) | E::Crc) => (Err(true), 0),
        };
        let packets = self.gate.packets_mut();
        match used {
            Ok(()) => packets.used += 1,
            Err(true) => packets.malformed += 1,
            Err(false) => packets.unsupported += 1,
        }
        delivered
    }

    fn on_echo(&mut self, token: u64, ticks: u64, at: HostTime) -> Result<(), bool> {
        // Accept only the answer to the pending request; anything else proves nothing.
        let Some(t1) = self.echo_sent.filter(|t| t.0 as u64 == token) else { return Err(false) };
        self.echo_sent = None;
        self.is_settled |= at.ns_since(t1) <= SETTLED_ROUND_TRIP_NS;
        if let Some(map) = &mut self.map {
            let ticks = DeviceTicks(ticks);
            let outcome = map.add_exchange(t1, ticks, ticks, at);
            if matches!(outcome, ExchangeOutcome::Contradicting | ExchangeOutcome::Stepped) {
                (self.echoes, self.echo_due) = (0, at);
            }
        }
        Ok(())
    }

    fn captured_at(&self, ticks: u64, at: HostTime) -> HostTime {
        let mapped = self.clock_map().and_then(|m| m.to_host(DeviceTicks(ticks)));
        // A transmission time of a second means that the clock stepped.
        mapped.filter(|m| at.ns_since(m.at) < 1_000 * MS).map_or(at, |m| m.at.min(at))
    }

    fn echo(&mut self, now: HostTime) {
        let waiting = self.echo_sent.is_some_and(|t| now.ns_since(t) < 500 * MS);
        if waiting || now < self.echo_due {
            return;
        }
        let State::Open(port) = &mut self.state else { return };
        if self.map.is_none() {
            // The rate of the device's clock must be known first.
            self.echo_due = now.plus_ns(ECHO_EVERY_NS);
            self.out.clear();
            SerialMessage::HelloRequest.encode(&mut self.out);
            // If it is lost, the next one follows soon.
            let _ = port.write(&self.out);
            return;
        }
        let quick = self.echoes < QUICK_ECHOES;
        self.echo_due = now.plus_ns(if quick { QUICK_ECHO_EVERY_NS } else { ECHO_EVERY_NS });
        self.echoes = self.echoes.saturating_add(1);
        self.out.clear();
        let t1 = self.clock.now();
        SerialMessage::EchoRequest { token: t1.0 as u64 }.encode(&mut self.out);
        // If the line cannot take 16 bytes now, send none; half a request is noise that the device skips.
        if port.write(&self.out).is_ok_and(|n| n == self.out.len()) {
            self.echo_sent = Some(t1);
        }
    }
}

impl Tracker for SerialTracker {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        match &self.state {
            State::Idle { retry_at } if now >= *retry_at => self.state = self.start_opening(now),
            State::Idle { .. } => {}
            State::Opening(result) => match result.try_recv() {
                Ok(Ok(port)) => self.begin(Box::new(port), now),
                Ok(Err(error)) => {
                    let remedy = crate::tty::refusal(&error).remedy();
                    self.lose(now, format!("cannot open {}: {error}; {remedy}", self.config.port));
                }
                Err(TryRecvError::Empty) => {}
                Err(TryRecvError::Disconnected) => self.lose(now, "the opening thread ended".into()),
            },
            State::Open(_) => return Ok(self.listen(now, sink)),
        }
        Ok(0)
    }

    fn name(&self) -> &str {
        "serial"
    }

    fn status(&self) -> String {
        let c = self.gate.counters();
        let mut text = format!("{} {}", self.config.port, if self.is_open() { "open" } else { "not open" });
        if let Some(problem) = &self.problem {
            text.push_str(&format!("; {problem}"));
        }
        if self.is_open() && c.packets.used == 0 {
            text.push_str(match c.packets.malformed {
                0 => "; nothing has been heard: is the device running and the right way round?",
                _ => "; only noise is heard: is the baud rate right?",
            });
        } else if self.is_open() && self.clock_map().is_none() {
            text.push_str("; no echo answered: capture times are arrival times");
        }
        text.push_str(&format!("; opened {} times; {c}", self.opened));
        text
    }
}
