//! The host's side of a light sensor: opens the port, sets the sensor up, reads blocks, maps its clock by echoes, counts
//! what is lost, and reopens after an unplug. [`SensorClient::poll`] never blocks.

use super::wire::{
    BlockHead, Levels, Refusal, SensorError, SensorHello, SensorMessage, MAX_FRAME, MAX_PACKET, MAX_SAMPLES,
    VERSION,
};
use crate::clock_map::{ClockMap, Mapped};
use crate::cobs::Deframer;
use crate::line::{EchoPace, Line, PollResult};
use crate::time::{DeviceTicks, HostClock, HostTime};
use crate::tracker::Stream;
use std::sync::Arc;

const MS: i64 = 1_000_000;
/// Bytes read in one poll: 50 ms of 3,000,000 baud.
const MAX_BYTES_PER_POLL: usize = 16 * 1024;
const ECHO_EVERY_NS: i64 = 100 * MS;
/// An order that was not answered is given again after this time.
const ORDER_EVERY_NS: i64 = 200 * MS;

/// What the host wants of a sensor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SensorConfig {
    /// Device file.
    pub port: String,
    /// Bits per second; irrelevant for USB serial ports and pseudo-terminals.
    pub baud: u32,
    /// Gain setting.
    pub gain: u8,
    /// Samples of a block, 1 to [`MAX_SAMPLES`].
    pub block: u16,
    /// Samples a second; 0 keeps the sensor's own rate.
    pub samples_per_second: u32,
}

/// A block as it came.
#[derive(Clone, Copy, Debug)]
pub struct SensorBlock<'a> {
    /// When and how it was sampled.
    pub head: BlockHead,
    /// Its levels.
    pub levels: Levels<'a>,
    /// Blocks before it that never came.
    pub missing: u32,
    /// When its last byte arrived.
    pub received_at: HostTime,
}

/// Counters of a sensor's stream.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SensorCounters {
    /// Blocks passed on.
    pub blocks: u64,
    /// Samples in them.
    pub samples: u64,
    /// Blocks that the sensor had no room for.
    pub lost_in_sensor: u64,
    /// Blocks that were lost on the line.
    pub lost_on_line: u64,
    /// Blocks that came again, or from before START.
    pub stale: u64,
    /// Damaged packets.
    pub malformed: u64,
    /// Packets of another format.
    pub unsupported: u64,
    /// Times that the port was opened.
    pub opened: u64,
}

/// How far the sensor is set up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// STOP was or will be sent.
    Stopping,
    Configuring,
    Starting,
    Running,
    /// It refused; nothing more is asked of it.
    Refused(Refusal),
}

/// A light sensor on a serial port.
pub struct SensorClient {
    config: SensorConfig,
    clock: Arc<dyn HostClock>,
    line: Line,
    phase: Phase,
    order_due: HostTime,
    deframer: Deframer<[u8; MAX_PACKET]>,
    buffer: Vec<u8>,
    hello: Option<SensorHello>,
    map: Option<ClockMap>,
    echo: EchoPace,
    /// Number of the next block, and the sensor's own losses so far.
    expected: Option<(u32, u32)>,
    counters: SensorCounters,
}

impl SensorClient {
    /// A client that opens its port when polled. `clock` is the host's clock, the one `poll` is called with.
    ///
    /// # Errors
    /// A setting that no sensor takes, by name.
    pub fn open(config: SensorConfig, clock: Arc<dyn HostClock>) -> Result<Self, String> {
        if config.port.is_empty() {
            return Err("light sensor: the port is empty".into());
        }
        if config.block == 0 || usize::from(config.block) > MAX_SAMPLES {
            return Err(format!(
                "light sensor: a block of {} samples; 1 to {MAX_SAMPLES} make sense",
                config.block
            ));
        }
        Ok(Self {
            line: Line::new(&config.port, config.baud),
            config,
            clock,
            phase: Phase::Stopping,
            order_due: HostTime(i64::MIN),
            deframer: Deframer::new([0; MAX_PACKET]),
            buffer: vec![0; MAX_BYTES_PER_POLL],
            hello: None,
            map: None,
            echo: EchoPace::new(ECHO_EVERY_NS),
            expected: None,
            counters: SensorCounters::default(),
        })
    }

    /// A client whose port is open already: for a conversation in memory. If it is lost, the client opens `config.port`.
    ///
    /// # Errors
    /// As [`SensorClient::open`].
    pub fn over(
        config: SensorConfig,
        clock: Arc<dyn HostClock>,
        port: Box<dyn Stream>,
    ) -> Result<Self, String> {
        let now = clock.now();
        let mut this = Self::open(config, clock)?;
        this.line.take_over(port);
        this.begin(now);
        Ok(this)
    }

    /// What the sensor last said of itself.
    pub fn hello(&self) -> Option<&SensorHello> {
        self.hello.as_ref()
    }

    /// Counters of all input.
    pub fn counters(&self) -> SensorCounters {
        self.counters
    }

    /// True while it streams.
    pub fn is_running(&self) -> bool {
        self.line.is_open() && self.phase == Phase::Running
    }

    /// Why the sensor does not do what it is asked for; `None` if it does, or has not said yet.
    pub fn refusal(&self) -> Option<Refusal> {
        match self.phase {
            Phase::Refused(why) => Some(why),
            _ => None,
        }
    }

    /// The map of the sensor's clock, once an echo was answered.
    pub fn clock_map(&self) -> Option<&ClockMap> {
        self.map.as_ref().filter(|m| m.is_ready())
    }

    /// When sample `index` of a block was taken, on the host's clock; `None` before the clock is mapped.
    pub fn sampled_at(&self, head: &BlockHead, index: usize) -> Option<Mapped> {
        let (ticks, _) = head.ticks_of(index);
        self.clock_map()?.to_host(DeviceTicks(ticks))
    }

    /// Sets the sensor up anew with another gain.
    pub fn set_gain(&mut self, gain: u8) {
        self.config.gain = gain;
        (self.phase, self.order_due) = (Phase::Stopping, HostTime(i64::MIN));
    }

    /// Reads what has arrived by `now` and passes blocks to `sink`, oldest first; returns their number.
    pub fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(SensorBlock<'_>)) -> usize {
        match self.line.poll(now) {
            PollResult::Closed => {}
            PollResult::Opened => self.begin(now),
            PollResult::Open => return self.listen(now, sink),
        }
        0
    }

    /// Counters and the reason for silence in one line.
    pub fn status(&self) -> String {
        let c = self.counters;
        let mut text = self.line.status();
        if let Some(hello) = &self.hello {
            text.push_str(&format!(" to \"{}\"", hello.name_text()));
        }
        match (self.line.is_open(), self.hello, self.phase) {
            (true, None, _) if c.malformed > 0 => {
                text.push_str("; only noise is heard: is the baud rate right?")
            }
            (true, None, _) => text.push_str("; nothing has been heard: is the sensor running?"),
            (true, _, Phase::Refused(why)) => text.push_str(&format!("; it refuses its settings: {why:?}")),
            _ => {}
        }
        text.push_str(&format!(
            "; {} blocks, lost {} in the sensor and {} on the line, {} damaged packets",
            c.blocks, c.lost_in_sensor, c.lost_on_line, c.malformed
        ));
        text
    }

    fn begin(&mut self, now: HostTime) {
        self.deframer.reset();
        (self.hello, self.map, self.expected) = (None, None, None);
        self.echo.begin(now);
        (self.phase, self.order_due) = (Phase::Stopping, now);
        self.counters.opened += 1;
    }

    fn listen(&mut self, now: HostTime, sink: &mut dyn FnMut(SensorBlock<'_>)) -> usize {
        let Some(n) = self.line.read(now, &mut self.buffer) else { return 0 };
        let at = self.clock.now();
        let before = self.counters.blocks;
        let (buffer, mut deframer) = (
            std::mem::take(&mut self.buffer),
            std::mem::replace(&mut self.deframer, Deframer::new([0; MAX_PACKET])),
        );
        deframer.push(&buffer[..n], &mut |packet| self.take_in(SensorMessage::decode(packet), at, sink));
        (self.buffer, self.deframer) = (buffer, deframer);
        self.give_orders(now);
        self.ask_for_echo(now);
        (self.counters.blocks - before) as usize
    }

    fn take_in(
        &mut self,
        message: Result<SensorMessage<'_>, SensorError>,
        at: HostTime,
        sink: &mut dyn FnMut(SensorBlock<'_>),
    ) {
        match message {
            Ok(SensorMessage::Samples(head, levels)) => self.on_block(head, levels, at, sink),
            Ok(SensorMessage::Hello(hello)) if hello.version == VERSION => self.on_hello(hello, at),
            Ok(SensorMessage::Refused(why)) => match self.phase {
                Phase::Configuring if why == Refusal::Running => self.phase = Phase::Stopping,
                Phase::Configuring | Phase::Starting => self.phase = Phase::Refused(why),
                _ => {}
            },
            Ok(SensorMessage::EchoResponse { token, ticks }) => self.on_echo(token, ticks, at),
            Err(SensorError::Short(_) | SensorError::Crc) => self.counters.malformed += 1,
            Ok(_) | Err(SensorError::Unknown { .. }) => self.counters.unsupported += 1,
        }
    }

    fn on_block(
        &mut self,
        head: BlockHead,
        levels: Levels<'_>,
        at: HostTime,
        sink: &mut dyn FnMut(SensorBlock<'_>),
    ) {
        if self.phase != Phase::Running {
            self.counters.stale += 1;
            return;
        }
        let (expected, lost) = self.expected.unwrap_or((0, 0));
        let missing = head.sequence.wrapping_sub(expected);
        if missing > u32::MAX / 2 {
            self.counters.stale += 1;
            return;
        }
        // The sensor's own losses lie among the missing ones.
        let in_sensor = head.lost.wrapping_sub(lost).min(missing);
        self.counters.lost_in_sensor += u64::from(in_sensor);
        self.counters.lost_on_line += u64::from(missing - in_sensor);
        self.expected = Some((head.sequence.wrapping_add(1), head.lost));
        self.counters.blocks += 1;
        self.counters.samples += levels.len() as u64;
        sink(SensorBlock { head, levels, missing, received_at: at });
    }

    fn on_hello(&mut self, hello: SensorHello, at: HostTime) {
        let is_same = self.hello.is_some_and(|before| before.ticks_per_second == hello.ticks_per_second);
        if !is_same || self.map.is_none() {
            self.map = ClockMap::new(u64::from(hello.ticks_per_second)).ok();
            self.echo.hurry(at);
        }
        self.hello = Some(hello);
        let next = match (self.phase, hello.running) {
            (Phase::Stopping, false) => Phase::Configuring,
            (Phase::Configuring, false) if self.is_as_wanted(&hello) => Phase::Starting,
            (Phase::Starting, true) => {
                self.expected = None;
                Phase::Running
            }
            // It was restarted, or thought that the host was gone.
            (Phase::Running, false) => Phase::Configuring,
            (same, _) => same,
        };
        if next != self.phase {
            (self.phase, self.order_due) = (next, at);
        }
    }

    fn is_as_wanted(&self, hello: &SensorHello) -> bool {
        let rate = self.config.samples_per_second;
        hello.gain == self.config.gain && (rate == 0 || hello.samples_per_second == rate)
    }

    /// Sends the order that the phase needs, again and again until it is answered.
    fn give_orders(&mut self, now: HostTime) {
        if now < self.order_due {
            return;
        }
        let order = match self.phase {
            Phase::Stopping => SensorMessage::Stop,
            Phase::Configuring => SensorMessage::Configure {
                gain: self.config.gain,
                block: self.config.block,
                samples_per_second: self.config.samples_per_second,
            },
            Phase::Starting => SensorMessage::Start,
            Phase::Running | Phase::Refused(_) => return,
        };
        self.order_due = now.plus_ns(ORDER_EVERY_NS);
        self.send(&order);
    }

    /// True if the line took the whole message. Half a message is noise that the sensor skips.
    fn send(&mut self, message: &SensorMessage<'_>) -> bool {
        let mut frame = [0; MAX_FRAME];
        let Some(n) = message.encode(&mut frame) else { return false };
        self.line.write(&frame[..n])
    }

    fn on_echo(&mut self, token: u64, ticks: u64, at: HostTime) {
        let Some(t1) = self.echo.answered(token) else {
            self.counters.unsupported += 1;
            return;
        };
        if let Some(map) = &mut self.map {
            let ticks = DeviceTicks(ticks);
            let _ = map.add_exchange(t1, ticks, ticks, at);
        }
    }

    fn ask_for_echo(&mut self, now: HostTime) {
        if !self.echo.is_due(now) || self.map.is_none() {
            return;
        }
        self.echo.ask(now);
        let t1 = self.clock.now();
        if self.send(&SensorMessage::EchoRequest { token: t1.0 as u64 }) {
            self.echo.asked(t1);
        }
    }
}
