//! The sensor's side of the protocol, for firmware: blocks of samples out, orders of the host in. It needs no operating
//! system and allocates nothing; converter, line and clock are traits that a board implements.

use super::wire::{
    BlockHead, LevelBits, Levels, Refusal, SensorHello, SensorMessage, MAX_FRAME, MAX_GAINS, MAX_HOST_PACKET,
    MAX_SAMPLES, NAME_BYTES, PERIOD_ONE, VERSION,
};
use crate::cobs::Deframer;

/// An analog-to-digital converter that is started by a timer, so that its samples are evenly spaced.
pub trait Adc {
    /// Samples from now on with gain setting `gain`, `samples_per_second` times a second or as near as its timer gets.
    /// Returns the time from sample to sample in units of 1 / [`PERIOD_ONE`] tick; `None` if it cannot.
    fn start(&mut self, gain: u8, samples_per_second: u32) -> Option<u32>;

    /// Stops sampling.
    fn stop(&mut self);

    /// Writes samples that were taken since the last call, oldest first, to the front of `into`. Returns their number
    /// and the clock in the middle of the first one; samples of one call are consecutive.
    fn take(&mut self, into: &mut [u16]) -> (usize, u64);
}

/// A serial line that never waits.
pub trait Uart {
    /// Bytes that have arrived; returns their number.
    fn read(&mut self, into: &mut [u8]) -> usize;

    /// Takes as many of `bytes` as there is room for; returns their number.
    fn write(&mut self, bytes: &[u8]) -> usize;
}

/// A clock that runs evenly since power-on: the one by which samples are stamped.
pub trait Clock {
    /// Its count now.
    fn ticks(&mut self) -> u64;
}

/// What a sensor is; it does not change while it runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SensorIdentity {
    /// Tells sensors apart.
    pub serial: u64,
    /// Name in ASCII, filled up with zeros.
    pub name: [u8; NAME_BYTES],
    /// Bits of its levels.
    pub bits: LevelBits,
    /// Rate of its clock, at least 1.
    pub ticks_per_second: u32,
    /// Rate of its samples until the host sets another one.
    pub samples_per_second: u32,
    /// A level of this or less is cut off below.
    pub floor: u16,
    /// A level of this or more is cut off above.
    pub ceiling: u16,
    /// Gain of each setting in thousandths of the first one's; 0 for settings that it does not have.
    pub gains_milli: [u32; MAX_GAINS],
}

/// A sensor that has heard nothing for this long stops streaming, seconds.
pub const SILENCE_S: u64 = 5;
/// Samples of a block until the host sets another number.
pub const DEFAULT_BLOCK: u16 = 128;
/// Room that blocks leave for answers.
const RESERVE: usize = 256;

/// A sensor. `OUT` is the size of its output buffer in bytes, at least two of [`MAX_FRAME`]: with 4096 it bridges 20 ms of
/// 100,000 samples a second.
pub struct Sensor<const OUT: usize> {
    identity: SensorIdentity,
    samples_per_second: u32,
    gain: u8,
    block: u16,
    running: bool,
    period: u32,
    sequence: u32,
    lost: u32,
    /// Samples of the block that is being filled, and the clock in the middle of the first.
    levels: [u16; MAX_SAMPLES],
    filled: usize,
    first: u64,
    deframer: Deframer<[u8; MAX_HOST_PACKET]>,
    heard_at: u64,
    hello_at: Option<u64>,
    out: [u8; OUT],
    from: usize,
    to: usize,
}

impl<const OUT: usize> Sensor<OUT> {
    /// A sensor that was just powered on: it is silent except for its HELLO.
    pub const fn new(identity: SensorIdentity) -> Self {
        const { assert!(OUT >= 2 * MAX_FRAME, "the output buffer holds two blocks at least") };
        Self {
            samples_per_second: identity.samples_per_second,
            identity,
            gain: 0,
            block: DEFAULT_BLOCK,
            running: false,
            period: PERIOD_ONE,
            sequence: 0,
            lost: 0,
            levels: [0; MAX_SAMPLES],
            filled: 0,
            first: 0,
            deframer: Deframer::new([0; MAX_HOST_PACKET]),
            heard_at: 0,
            hello_at: None,
            out: [0; OUT],
            from: 0,
            to: 0,
        }
    }

    /// True while it streams.
    pub const fn is_running(&self) -> bool {
        self.running
    }

    /// Blocks that were made and not sent, since START.
    pub const fn lost(&self) -> u32 {
        self.lost
    }

    /// One pass of the main loop: reads orders, moves samples, sends. Returns at once.
    pub fn step(&mut self, adc: &mut impl Adc, uart: &mut impl Uart, clock: &mut impl Clock) {
        let mut bytes = [0; 64];
        let n = uart.read(&mut bytes);
        let now = clock.ticks();
        self.on_bytes(&bytes[..n.min(bytes.len())], now, adc);
        self.move_samples(adc);
        self.keep_time(now, adc);
        let n = uart.write(self.unsent());
        self.sent(n);
    }

    /// Bytes for the line.
    pub fn unsent(&self) -> &[u8] {
        &self.out[self.from..self.to]
    }

    /// The first `n` of the bytes for the line were sent.
    pub fn sent(&mut self, n: usize) {
        self.from = (self.from + n).min(self.to);
        if self.from == self.to {
            (self.from, self.to) = (0, 0);
        }
    }

    /// Bytes of the host, which had arrived at `now`.
    pub fn on_bytes(&mut self, bytes: &[u8], now: u64, adc: &mut impl Adc) {
        let mut packet = [0; MAX_HOST_PACKET];
        // Read byte by byte: the sink cannot borrow the whole sensor.
        for &byte in bytes {
            let mut length = 0;
            self.deframer.push(&[byte], &mut |p| {
                length = p.len();
                packet[..length].copy_from_slice(p);
            });
            if length == 0 {
                continue;
            }
            if let Ok(message) = SensorMessage::decode(&packet[..length]) {
                self.on_message(&message, now, adc);
            }
        }
    }

    fn on_message(&mut self, message: &SensorMessage<'_>, now: u64, adc: &mut impl Adc) {
        self.heard_at = now;
        match *message {
            SensorMessage::EchoRequest { token } => {
                self.answer(&SensorMessage::EchoResponse { token, ticks: now });
            }
            SensorMessage::HelloRequest => self.hello(now),
            SensorMessage::Start if self.running => self.hello(now),
            SensorMessage::Start => self.start(now, adc),
            SensorMessage::Stop => {
                self.stop(adc);
                self.hello(now);
            }
            SensorMessage::Configure { gain, block, samples_per_second } => {
                match self.configure(gain, block, samples_per_second, adc) {
                    Ok(()) => self.hello(now),
                    Err(why) => self.answer(&SensorMessage::Refused(why)),
                }
            }
            // A sensor's own messages.
            SensorMessage::Samples(..)
            | SensorMessage::Hello(_)
            | SensorMessage::Refused(_)
            | SensorMessage::EchoResponse { .. } => {}
        }
    }

    fn start(&mut self, now: u64, adc: &mut impl Adc) {
        match adc.start(self.gain, self.samples_per_second).filter(|&period| period > 0) {
            None => self.answer(&SensorMessage::Refused(Refusal::Rate)),
            Some(period) => {
                (self.running, self.period) = (true, period);
                (self.sequence, self.lost, self.filled) = (0, 0, 0);
                self.hello(now);
            }
        }
    }

    fn stop(&mut self, adc: &mut impl Adc) {
        if self.running {
            adc.stop();
            (self.running, self.filled) = (false, 0);
        }
    }

    fn configure(
        &mut self,
        gain: u8,
        block: u16,
        samples_per_second: u32,
        adc: &mut impl Adc,
    ) -> Result<(), Refusal> {
        if self.running {
            return Err(Refusal::Running);
        }
        if self.identity.gains_milli.get(usize::from(gain)).is_none_or(|&gain| gain == 0) {
            return Err(Refusal::Gain);
        }
        if block == 0 || usize::from(block) > MAX_SAMPLES {
            return Err(Refusal::Block);
        }
        if samples_per_second != 0 {
            // Tried at once, so that the answer tells.
            let works = adc.start(gain, samples_per_second).is_some();
            adc.stop();
            if !works {
                return Err(Refusal::Rate);
            }
            self.samples_per_second = samples_per_second;
        }
        (self.gain, self.block) = (gain, block);
        Ok(())
    }

    /// Takes what the converter has, in at most one pass over its buffer.
    fn move_samples(&mut self, adc: &mut impl Adc) {
        if !self.running {
            return;
        }
        for _ in 0..8 {
            let mut taken = [0u16; 64];
            let (n, first) = adc.take(&mut taken);
            self.on_samples(&taken[..n.min(taken.len())], first);
            if n < taken.len() {
                return;
            }
        }
    }

    /// Consecutive samples, whose first one was taken at `first`. Does nothing while it does not stream.
    pub fn on_samples(&mut self, levels: &[u16], first: u64) {
        if !self.running || levels.is_empty() {
            return;
        }
        if self.filled > 0 {
            // After a gap a new block begins, because a block's samples are evenly spaced.
            let due = self.after_first(self.filled);
            let apart = due.wrapping_sub(first).min(first.wrapping_sub(due));
            if apart * 2 * u64::from(PERIOD_ONE) > u64::from(self.period) + 4 * u64::from(PERIOD_ONE) {
                self.finish_block();
            }
        }
        for (i, level) in levels.iter().enumerate() {
            if self.filled == 0 {
                let after = i as u64 * u64::from(self.period) / u64::from(PERIOD_ONE);
                self.first = first.wrapping_add(after);
            }
            self.levels[self.filled] = *level;
            self.filled += 1;
            if self.filled >= usize::from(self.block) {
                self.finish_block();
            }
        }
    }

    fn after_first(&self, samples: usize) -> u64 {
        self.first.wrapping_add(samples as u64 * u64::from(self.period) / u64::from(PERIOD_ONE))
    }

    fn finish_block(&mut self) {
        let SensorIdentity { floor, ceiling, bits, .. } = self.identity;
        let filled = core::mem::take(&mut self.filled);
        let levels = self.levels;
        let levels = &levels[..filled];
        let head = BlockHead {
            sequence: self.sequence,
            first: self.first,
            period: self.period,
            lost: self.lost,
            gain: self.gain,
            cut_below: levels.iter().any(|level| *level <= floor),
            cut_above: levels.iter().any(|level| *level >= ceiling),
        };
        self.sequence = self.sequence.wrapping_add(1);
        if !self.say(&SensorMessage::Samples(head, Levels::Values(bits, levels)), RESERVE) {
            self.lost = self.lost.wrapping_add(1);
        }
    }

    /// What is due by the clock: a HELLO each second, and the end of the stream when the host is gone.
    fn keep_time(&mut self, now: u64, adc: &mut impl Adc) {
        let second = u64::from(self.identity.ticks_per_second.max(1));
        if self.hello_at.is_none_or(|at| now.wrapping_sub(at) >= second) {
            self.hello(now);
        }
        if self.running && now.wrapping_sub(self.heard_at) > SILENCE_S * second {
            self.stop(adc);
        }
    }

    fn hello(&mut self, now: u64) {
        self.hello_at = Some(now);
        let i = &self.identity;
        let hello = SensorHello {
            version: VERSION,
            bits: i.bits,
            running: self.running,
            ticks_per_second: i.ticks_per_second,
            samples_per_second: self.samples_per_second,
            floor: i.floor,
            ceiling: i.ceiling,
            serial: i.serial,
            name: i.name,
            gains_milli: i.gains_milli,
            gain: self.gain,
        };
        self.answer(&SensorMessage::Hello(hello));
    }

    /// Queues an answer. If there is no room, the host asks again.
    fn answer(&mut self, message: &SensorMessage<'_>) {
        self.say(message, 0);
    }

    /// Queues a message, and leaves `reserve` bytes for others. False if there is no room.
    fn say(&mut self, message: &SensorMessage<'_>, reserve: usize) -> bool {
        let mut frame = [0; MAX_FRAME];
        let Some(n) = message.encode(&mut frame) else { return false };
        if self.to + n + reserve > OUT {
            self.out.copy_within(self.from..self.to, 0);
            (self.from, self.to) = (0, self.to - self.from);
        }
        if self.to + n + reserve > OUT {
            return false;
        }
        self.out[self.to..self.to + n].copy_from_slice(&frame[..n]);
        self.to += n;
        true
    }
}

#[cfg(test)]
#[path = "device_tests.rs"]
mod tests;
