//! The serial tracker: opens the port, reads samples, maps the clock by echoes, and reopens after an unplug, all inside
//! [`Tracker::poll`], which never blocks.

use super::wire::{SerialMessage, MAX_PACKET, VERSION};
use crate::clock_map::{ClockMap, ExchangeOutcome};
use crate::cobs::Deframer;
use crate::line::{EchoPace, Line, PollResult};
use crate::pose::Pose;
use crate::stream::Opener;
use crate::time::{DeviceTicks, HostClock, HostTime};
use crate::tracker::{
    BodyIndex, BodyKey, SampleGate, Stream, Tracker, TrackerCounters, TrackerError, TrackerSample,
};
use std::sync::Arc;

const MS: i64 = 1_000_000;
/// Bytes read in one poll: 90 ms of 921,600 baud, so a backlog is gone in a few polls.
const MAX_BYTES_PER_POLL: usize = 8192;
const ECHO_EVERY_NS: i64 = 200 * MS;
/// Samples are passed on once an echo came back within this time. Bytes that had waited in the port when it was opened
/// (the kernel keeps more than can be flushed) precede the answer to the first echo, and delay it.
const SETTLED_ROUND_TRIP_NS: i64 = 50 * MS;
/// If a device answers no echo, its samples are accepted when it has been heard for this long and the port is empty ...
const SETTLED_AFTER_NS: i64 = 300 * MS;
/// ... without a pause of this length, after which what had been held back may arrive.
const PAUSE_NS: i64 = 100 * MS;
/// A pose that is older than this, or as far in the future, waited somewhere on its way, or the device's clock stepped.
/// An echo tells which.
const DOUBTED_NS: u64 = 1_000_000_000;

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

/// A tracker on a serial port.
pub struct SerialTracker {
    config: SerialTrackerConfig,
    clock: Arc<dyn HostClock>,
    line: Line,
    deframer: Deframer<[u8; MAX_PACKET]>,
    gate: SampleGate,
    buffer: Vec<u8>,
    out: Vec<u8>,
    map: Option<ClockMap>,
    ticks_per_second: u32,
    echo: EchoPace,
    opened: u64,
    /// When something was read last.
    heard_at: Option<HostTime>,
    /// When an echo was answered last.
    answered_at: Option<HostTime>,
    /// Since then the device has been heard without a pause, or the age of a pose has been in doubt.
    unsettled_at: HostTime,
    /// No sample that waited in the port can arrive any more.
    is_settled: bool,
}

impl SerialTracker {
    /// A tracker that opens its port when polled. `clock` is the host's clock, the one `poll` is called with.
    pub fn open(config: SerialTrackerConfig, clock: Arc<dyn HostClock>) -> Result<Self, TrackerError> {
        if config.port.is_empty() {
            return Err(TrackerError::Protocol("serial tracker: the port is empty".into()));
        }
        Ok(Self {
            gate: SampleGate::new(config.bodies.len()),
            line: Line::new(&config.port, config.baud),
            config,
            clock,
            deframer: Deframer::new([0; MAX_PACKET]),
            buffer: vec![0; MAX_BYTES_PER_POLL],
            out: Vec::with_capacity(64),
            map: None,
            ticks_per_second: 0,
            echo: EchoPace::new(ECHO_EVERY_NS),
            opened: 0,
            heard_at: None,
            answered_at: None,
            unsettled_at: HostTime(i64::MIN),
            is_settled: false,
        })
    }

    /// A tracker whose port `opener` opens when it is polled, instead of the operating system.
    ///
    /// # Errors
    /// As [`SerialTracker::open`].
    pub fn open_through(
        config: SerialTrackerConfig,
        clock: Arc<dyn HostClock>,
        opener: Box<dyn Opener>,
    ) -> Result<Self, TrackerError> {
        let line = Line::through(&config.port, opener);
        Ok(Self { line, ..Self::open(config, clock)? })
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
        this.line.take_over(port);
        this.begin(now);
        Ok(this)
    }

    /// Counters of all input, by outcome.
    pub fn counters(&self) -> &TrackerCounters {
        self.gate.counters()
    }

    /// True while the port is open.
    pub fn is_open(&self) -> bool {
        self.line.is_open()
    }

    /// The map of the device's clock, once an echo was answered.
    pub fn clock_map(&self) -> Option<&ClockMap> {
        self.map.as_ref().filter(|m| m.is_ready())
    }

    fn begin(&mut self, now: HostTime) {
        self.deframer.reset();
        (self.map, self.ticks_per_second) = (None, 0);
        self.echo.begin(now);
        self.opened += 1;
        (self.heard_at, self.answered_at) = (None, None);
        (self.unsettled_at, self.is_settled) = (now, false);
    }

    fn listen(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> usize {
        let Some(n) = self.line.read(now, &mut self.buffer) else { return 0 };
        let at = self.clock.now();
        if n > 0 {
            self.hear(at);
        }
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
        if n > 0 && is_empty {
            self.settle(at);
        }
        self.ask_for_echo(at);
        delivered
    }

    /// Something was read. After a pause it may have been held back, and only a map of the device's clock tells.
    fn hear(&mut self, at: HostTime) {
        let paused = self.heard_at.replace(at).is_none_or(|before| at.ns_since(before) > PAUSE_NS);
        if paused && self.clock_map().is_none() {
            (self.unsettled_at, self.is_settled) = (at, false);
        }
    }

    /// The port is empty: if no echo is answered, samples are accepted once the device has been heard for a while.
    fn settle(&mut self, at: HostTime) {
        if !self.is_settled && at.ns_since(self.unsettled_at) >= SETTLED_AFTER_NS {
            self.is_settled = true;
            if self.answered_at.is_none_or(|answered| answered < self.unsettled_at) {
                // Whatever was known of the device's clock, it does not answer for it now.
                self.map = None;
            }
        }
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
                let pose =
                    Pose { position_m: position.map(f64::from), rotation_xyzw: rotation_xyzw.map(f64::from) };
                let sample = |body| TrackerSample {
                    body,
                    pose,
                    tracked,
                    mean_error_m: mean_error,
                    covariance: None,
                    sequence,
                    captured_at,
                    received_at: at,
                };
                (Ok(()), self.admit(i64::from(body), sample, sink))
            }
            Ok(SerialMessage::Hello { version: VERSION, ticks_per_second, .. }) => {
                if ticks_per_second != self.ticks_per_second || self.map.is_none() {
                    self.ticks_per_second = ticks_per_second;
                    self.map = ClockMap::new(u64::from(ticks_per_second)).ok();
                    self.echo.hurry(at);
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

    /// Passes the sample of the body with number `id` on. Returns how many were delivered.
    fn admit(
        &mut self,
        id: i64,
        sample: impl FnOnce(BodyIndex) -> TrackerSample,
        sink: &mut dyn FnMut(&TrackerSample),
    ) -> usize {
        let place = |(i, b): (usize, &BodyKey)| b.id.unwrap_or(i as i64) == id;
        match self.config.bodies.iter().enumerate().position(place) {
            None => self.gate.count_unknown(),
            Some(_) if !self.is_settled => self.gate.count_unknown_age(),
            Some(i) => {
                if let Some(sample) = self.gate.admit(&sample(BodyIndex(i as u16))) {
                    sink(&sample);
                    return 1;
                }
            }
        }
        0
    }

    fn on_echo(&mut self, token: u64, ticks: u64, at: HostTime) -> Result<(), bool> {
        let Some(t1) = self.echo.answered(token) else { return Err(false) };
        self.answered_at = Some(at);
        self.is_settled |= at.ns_since(t1) <= SETTLED_ROUND_TRIP_NS;
        if let Some(map) = &mut self.map {
            let ticks = DeviceTicks(ticks);
            let outcome = map.add_exchange(t1, ticks, ticks, at);
            if matches!(outcome, ExchangeOutcome::Contradicting | ExchangeOutcome::Stepped) {
                self.echo.hurry(at);
            }
        }
        Ok(())
    }

    fn captured_at(&mut self, ticks: u64, at: HostTime) -> HostTime {
        let Some(mapped) = self.clock_map().and_then(|m| m.to_host(DeviceTicks(ticks))) else { return at };
        if self.is_settled && at.ns_since(mapped.at).unsigned_abs() >= DOUBTED_NS {
            // Poses are as old as those that had waited in a port that was just opened: of unknown age.
            (self.unsettled_at, self.is_settled) = (at, false);
            self.echo.begin(at);
        }
        mapped.at.min(at)
    }

    fn ask_for_echo(&mut self, now: HostTime) {
        if !self.echo.is_due(now) {
            return;
        }
        self.out.clear();
        if self.map.is_none() {
            // The rate of the device's clock must be known first. If the request or its answer is lost, the next one follows
            // soon: after 0.3 s samples would be dated by their arrival.
            self.echo.ask(now);
            SerialMessage::HelloRequest.encode(&mut self.out);
            self.line.write(&self.out);
            return;
        }
        self.echo.ask(now);
        let t1 = self.clock.now();
        SerialMessage::EchoRequest { token: t1.0 as u64 }.encode(&mut self.out);
        if self.line.write(&self.out) {
            self.echo.asked(t1);
        }
    }
}

impl Tracker for SerialTracker {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        match self.line.poll(now) {
            PollResult::Closed => {}
            PollResult::Opened => self.begin(now),
            PollResult::Open => return Ok(self.listen(now, sink)),
        }
        Ok(0)
    }

    fn name(&self) -> &str {
        "serial"
    }

    fn status(&self) -> String {
        let c = self.gate.counters();
        let mut text = self.line.status();
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

    fn gate(&self) -> Option<&SampleGate> {
        Some(&self.gate)
    }
}

#[cfg(test)]
#[path = "client_tests.rs"]
mod tests;
