//! Firmware of a light sensor, as far as it does not depend on the microcontroller.
//!
//! A board implements three small traits: [`SampleRing`] (a timer starts the converter, and DMA writes its samples round a
//! buffer), [`Uart`] (a serial line or USB CDC), and [`Timer`] (a counter that wraps at 32 bits). [`Firmware::step`] is
//! then all that the main loop does:
//!
//! ```ignore
//! #[entry]
//! fn main() -> ! {
//!     let board = Board::take();
//!     let identity = SensorIdentity { serial: board.unique_id(), ..light_sensor_firmware::EXAMPLE };
//!     let mut firmware: Firmware<_, _, _, 4096> = Firmware::new(identity, board.ring, board.uart, board.timer);
//!     loop {
//!         firmware.step();
//!     }
//! }
//! ```
//!
//! docs/SENSOR.md says how to build the sensor; docs/PROTOCOL.md section 13 is what it says on the line.
#![cfg_attr(not(test), no_std)]

use dpm_device::sensor::device::{Adc, Clock, Sensor, SensorIdentity};
use dpm_device::sensor::wire::{LevelBits, PERIOD_ONE};

pub use dpm_device::sensor::device::Uart;

/// A sensor of 12 bits and 100,000 samples a second, whose amplifier has two gains. Change what differs.
pub const EXAMPLE: SensorIdentity = SensorIdentity {
    serial: 0,
    name: *b"light sensor\0\0\0\0",
    bits: LevelBits::Twelve,
    ticks_per_second: 1_000_000,
    samples_per_second: 100_000,
    // The amplifier's output reaches neither rail.
    floor: 20,
    ceiling: 4075,
    gains_milli: [1000, 10_000, 0, 0, 0, 0, 0, 0],
};

/// A counter of the clock that also times the converter.
pub trait Timer {
    /// Its count, which wraps at 2^32: every 71 minutes at 1 MHz.
    fn count(&mut self) -> u32;
}

/// Samples that DMA writes round a buffer.
pub trait SampleRing {
    /// Number of samples that it holds.
    const LEN: usize;

    /// Starts sampling at `samples_per_second` with gain setting `gain`: switches the amplifier, sets the timer and clears
    /// the number of samples written. Returns ticks of the clock from sample to sample; `None` if it cannot.
    fn start(&mut self, gain: u8, samples_per_second: u32) -> Option<u32>;

    /// Stops sampling.
    fn stop(&mut self);

    /// Samples written since the start, wraps at 2^32.
    fn written(&mut self) -> u32;

    /// The sample at a place of the buffer, 0 to `LEN` - 1.
    fn sample(&self, place: usize) -> u16;
}

/// Makes a timer of 32 bits into a clock that never wraps. It must be read at least once in each wrap.
struct LongClock<T> {
    timer: T,
    last: u32,
    high: u32,
}

impl<T: Timer> Clock for LongClock<T> {
    fn ticks(&mut self) -> u64 {
        let now = self.timer.count();
        if now < self.last {
            self.high = self.high.wrapping_add(1);
        }
        self.last = now;
        u64::from(self.high) << 32 | u64::from(now)
    }
}

/// A ring as a converter.
struct RingAdc<R> {
    ring: R,
    /// Samples read or skipped since the start, wraps.
    read: u32,
    /// The same without wrapping.
    total: u64,
    started_at: u64,
    period: u32,
}

impl<R: SampleRing> RingAdc<R> {
    /// Reads from here on have `now` as the time of a start.
    fn at(&mut self, now: u64) -> StartingAt<'_, R> {
        StartingAt { adc: self, now }
    }
}

/// A converter together with the instant of this step.
struct StartingAt<'a, R> {
    adc: &'a mut RingAdc<R>,
    now: u64,
}

impl<R: SampleRing> Adc for StartingAt<'_, R> {
    fn start(&mut self, gain: u8, samples_per_second: u32) -> Option<u32> {
        let period = self.adc.ring.start(gain, samples_per_second).filter(|&ticks| ticks > 0)?;
        (self.adc.read, self.adc.total) = (0, 0);
        (self.adc.started_at, self.adc.period) = (self.now, period);
        period.checked_mul(PERIOD_ONE)
    }

    fn stop(&mut self) {
        self.adc.ring.stop();
    }

    fn take(&mut self, into: &mut [u16]) -> (usize, u64) {
        let adc = &mut *self.adc;
        let waiting = adc.ring.written().wrapping_sub(adc.read) as usize;
        // DMA goes on while this reads: an eighth of the ring is left to it. What it has overwritten is skipped, and the
        // gap shows in the time of the next block.
        let kept = R::LEN - R::LEN / 8;
        let skipped = waiting.saturating_sub(kept);
        adc.read = adc.read.wrapping_add(skipped as u32);
        adc.total += skipped as u64;
        let n = (waiting - skipped).min(into.len());
        let first = adc.started_at + (adc.total + 1) * u64::from(adc.period);
        for (i, to) in into[..n].iter_mut().enumerate() {
            *to = adc.ring.sample((adc.total as usize).wrapping_add(i) % R::LEN);
        }
        adc.read = adc.read.wrapping_add(n as u32);
        adc.total += n as u64;
        (n, first)
    }
}

/// The sensor on a board. `OUT` is the size of the output buffer in bytes; 4096 bridges 20 ms.
pub struct Firmware<R, U, T, const OUT: usize> {
    sensor: Sensor<OUT>,
    adc: RingAdc<R>,
    uart: U,
    clock: LongClock<T>,
}

impl<R: SampleRing, U: Uart, T: Timer, const OUT: usize> Firmware<R, U, T, OUT> {
    /// A sensor that was just powered on.
    pub const fn new(identity: SensorIdentity, ring: R, uart: U, timer: T) -> Self {
        Self {
            sensor: Sensor::new(identity),
            adc: RingAdc { ring, read: 0, total: 0, started_at: 0, period: 1 },
            uart,
            clock: LongClock { timer, last: 0, high: 0 },
        }
    }

    /// One pass of the main loop; returns at once. Call it at least every few milliseconds.
    pub fn step(&mut self) {
        let now = self.clock.ticks();
        self.sensor.step(&mut self.adc.at(now), &mut self.uart, &mut self.clock);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::cobs::Deframer;
    use dpm_device::sensor::wire::{SensorMessage, MAX_FRAME, MAX_PACKET};
    use std::cell::RefCell;
    use std::rc::Rc;

    /// What happens on the board.
    #[derive(Default)]
    struct World {
        now: u32,
        started: Option<u32>,
        to_sensor: Vec<u8>,
        line: Vec<u8>,
    }

    #[derive(Clone, Default)]
    struct Board(Rc<RefCell<World>>);

    impl Timer for Board {
        fn count(&mut self) -> u32 {
            self.0.borrow().now
        }
    }

    impl SampleRing for Board {
        const LEN: usize = 1024;
        fn start(&mut self, _: u8, samples_per_second: u32) -> Option<u32> {
            let mut world = self.0.borrow_mut();
            world.started = Some(world.now);
            (samples_per_second == 100_000).then_some(10)
        }
        fn stop(&mut self) {
            self.0.borrow_mut().started = None;
        }
        fn written(&mut self) -> u32 {
            let world = self.0.borrow();
            world.started.map_or(0, |at| world.now.wrapping_sub(at) / 10)
        }
        fn sample(&self, place: usize) -> u16 {
            // The newest number that was written to this place.
            let newest = Board::written(&mut self.clone()) - 1;
            ((newest - (newest - place as u32) % 1024) % 4000) as u16
        }
    }

    impl Uart for Board {
        fn read(&mut self, into: &mut [u8]) -> usize {
            let mut world = self.0.borrow_mut();
            let n = world.to_sensor.len().min(into.len());
            into[..n].copy_from_slice(&world.to_sensor[..n]);
            world.to_sensor.drain(..n);
            n
        }
        fn write(&mut self, bytes: &[u8]) -> usize {
            self.0.borrow_mut().line.extend(bytes);
            bytes.len()
        }
    }

    #[test]
    fn samples_of_the_ring_keep_their_numbers_and_times_over_a_wrap_of_the_timer_and_an_overrun() {
        let board = Board::default();
        board.0.borrow_mut().now = u32::MAX - 20_000;
        let mut firmware: Firmware<_, _, _, 4096> =
            Firmware::new(EXAMPLE, board.clone(), board.clone(), board.clone());
        let mut frame = [0; MAX_FRAME];
        let n = SensorMessage::Start.encode(&mut frame).unwrap();
        board.0.borrow_mut().to_sensor.extend(&frame[..n]);
        let pass = |us: u32, firmware: &mut Firmware<_, _, _, 4096>| {
            let now = board.0.borrow().now.wrapping_add(us);
            board.0.borrow_mut().now = now;
            firmware.step();
        };
        pass(1, &mut firmware);
        let start = u64::from(u32::MAX - 19_999);
        (0..300).for_each(|_| pass(500, &mut firmware));
        // 3,000 samples pass while nobody looks; the ring holds 1024.
        pass(30_000, &mut firmware);
        (0..50).for_each(|_| pass(500, &mut firmware));
        let (mut blocks, mut skipped, mut last) = (0, 0u64, 0u64);
        Deframer::new([0; MAX_PACKET]).push(&board.0.borrow().line, &mut |packet| {
            let SensorMessage::Samples(head, levels) = SensorMessage::decode(packet).unwrap() else { return };
            let number = (head.first - start) / 10 - 1;
            assert_eq!((head.first - start) % 10, 0);
            for (k, level) in (number..).zip(levels.iter()) {
                assert_eq!(u64::from(level), k % 4000, "block {}", head.sequence);
            }
            skipped += number - last;
            last = number + levels.len() as u64;
            blocks += 1;
        });
        assert!(blocks > 120, "{blocks}");
        // Of 3,000, seven eighths of the ring are left.
        assert!((2000..=2200).contains(&skipped), "{skipped}");
    }
}
