//! The vertical blanks of a display into a clock on which every slot of the link is exactly one blank.
//!
//! The clock's ticks are nanoseconds of the display's own time: blank number `k` is the start of slot `k`, whatever the
//! host's clock says. A loop of second order follows the kernel's stamps. It bends the clock and never sets it, so a reading
//! never jumps or goes back.

use dpm_device::link::SlotClock;
use dpm_device::projector::DeviceClock;
use dpm_device::time::{DeviceTicks, FrameRate, HostTime};

/// Ticks a second.
pub const TICK_HZ: u32 = 1_000_000_000;
/// Pictures from which the phase of the blanks is learned at the start.
pub const LEARNED: usize = 6;
/// Pictures after which a rate that is not the mode's is believed. Stamps that come late, as those of an X server on a busy
/// machine, spoil a rate that is measured over few of them.
pub const MOST_LEARNED: usize = 60;
/// A crystal that is further off than this is none, parts in a billion.
const MOST_SKEW_PPB: i64 = 5_000_000;
/// The phase is corrected within this many blanks.
const PHASE_BLANKS: i64 = 16;
/// The rate is corrected within this many.
const RATE_BLANKS: i64 = 512;

/// Why stamps are none of a display with this mode.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NoPace {
    /// The driver does not count.
    #[error("the driver does not count vertical blanks, so nothing tells when light falls; use another card or driver")]
    NoCount,
    /// Other than the mode's.
    #[error(
        "the display runs at {measured:.3} frames/s although its mode or the rig file says {nominal:.3}: variable refresh, or a driver that does not stamp"
    )]
    OtherRate {
        /// As measured.
        measured: f64,
        /// As computed from the mode.
        nominal: f64,
    },
}

/// Follows the blanks.
#[derive(Debug)]
pub struct Pacer {
    slots: SlotClock,
    /// From the start of a slot to its blank, nanoseconds.
    lead_ns: i64,
    clock: DeviceClock,
    /// The learned error of the rate, parts in a billion.
    rate_ppb: i64,
    /// The newest blank: its number, and the kernel's count.
    newest: (u64, u32),
    /// Of the newest correction: by how much the stamp was late, nanoseconds.
    error_ns: i64,
}

impl Pacer {
    /// Learns from the stamps of successive pictures, the newest last, on the rig's clock. The newest is blank 0.
    ///
    /// # Errors
    /// The stamps are none of a display that runs at `rate`.
    pub fn learn(rate: FrameRate, lead_ns: i64, stamps: &[(u32, HostTime)]) -> Result<Self, NoPace> {
        let slots = SlotClock::new(DeviceTicks(0), TICK_HZ, rate).ok_or(NoPace::NoCount)?;
        let (Some(first), Some(last)) = (stamps.first(), stamps.last()) else { return Err(NoPace::NoCount) };
        let blanks = last.0.wrapping_sub(first.0);
        let counts = stamps.windows(2).all(|w| (1..1000).contains(&w[1].0.wrapping_sub(w[0].0)));
        let ns = last.1.ns_since(first.1);
        if blanks == 0 || !counts || ns <= 0 {
            return Err(NoPace::NoCount);
        }
        let (measured, nominal) = (f64::from(blanks) * 1e9 / ns as f64, rate.hz());
        if !(0.99..1.01).contains(&(measured / nominal)) {
            return Err(NoPace::OtherRate { measured, nominal });
        }
        let power_on_at = last.1.plus_ns(-lead_ns);
        let clock = DeviceClock { tick_hz: TICK_HZ, skew_ppb: 0, start_ticks: 0, power_on_at };
        Ok(Self { slots, lead_ns, clock, rate_ppb: 0, newest: (0, last.0), error_ns: 0 })
    }

    /// The clock.
    pub const fn clock(&self) -> DeviceClock {
        self.clock
    }

    /// When slot `k` begins: what it shows is chosen then.
    pub fn slot_at(&self, k: u64) -> HostTime {
        self.clock.instant_of(self.slots.start(k))
    }

    /// When blank `k` is expected.
    pub fn blank_at(&self, k: u64) -> HostTime {
        self.slot_at(k).plus_ns(self.lead_ns)
    }

    /// The number of the blank that the kernel counts as `sequence`. A count before the newest one is the newest one.
    pub fn number(&self, sequence: u32) -> u64 {
        let (number, at) = self.newest;
        let ahead = sequence.wrapping_sub(at);
        number + if ahead < u32::MAX / 2 { u64::from(ahead) } else { 0 }
    }

    /// The kernel stamped the blank that it counts as `sequence` at `at`; now it is `now`. Every slot that begins at or
    /// before `now` must have been chosen. Returns the blank's number.
    pub fn follow(&mut self, now: HostTime, sequence: u32, at: HostTime) -> u64 {
        let number = self.number(sequence);
        let blanks = (number - self.newest.0).min(1000) as i64;
        self.newest = (number, sequence);
        let reading = self.clock.ticks_at(at.plus_ns(-self.lead_ns)).0;
        let error = i128::from(reading) - i128::from(self.slots.start(number).0);
        let period_ns = self.slots.rate().slot_len_ns(0).max(1);
        // The clock reads too much: it must run slower.
        let error = error.clamp(i128::from(-period_ns), i128::from(period_ns)) as i64;
        self.error_ns = error;
        let ppb = |over_blanks: i64| {
            (-error * 1_000_000_000 / (over_blanks * period_ns)).clamp(-MOST_SKEW_PPB, MOST_SKEW_PPB)
        };
        self.rate_ppb = (self.rate_ppb + blanks * ppb(RATE_BLANKS)).clamp(-MOST_SKEW_PPB, MOST_SKEW_PPB);
        let skew = (self.rate_ppb + ppb(PHASE_BLANKS)).clamp(-MOST_SKEW_PPB, MOST_SKEW_PPB);
        self.clock = DeviceClock {
            tick_hz: TICK_HZ,
            skew_ppb: skew as i32,
            start_ticks: self.clock.ticks_at(now).0,
            power_on_at: now,
        };
        number
    }

    /// By how much the last stamp was later than the clock said, nanoseconds.
    pub const fn error_ns(&self) -> i64 {
        self.error_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::rng::Draws;

    /// A display whose crystal is `ppm` off, stamped with a jitter of up to `jitter_ns`.
    fn follow(ppm: i64, jitter_ns: u64, missing: u64) -> Vec<i64> {
        let rate = FrameRate::new(60, 1).unwrap();
        let draws = Draws::new(7);
        let true_at = |k: u64| {
            HostTime(
                5_000_000_000
                    + (k as i128 * 1_000_000_000 * (1_000_000 - i128::from(ppm)) / 60_000_000) as i64,
            )
        };
        let stamp =
            |k: u64| true_at(k).plus_ns((draws.bits(k) % (2 * jitter_ns + 1)) as i64 - jitter_ns as i64);
        let wrap = |k: u64| (k as u32).wrapping_add(u32::MAX - 100);
        let first: Vec<_> = (0..LEARNED as u64).map(|k| (wrap(k), stamp(k))).collect();
        let mut pacer = Pacer::learn(rate, 3_000_000, &first).unwrap();
        let zero = LEARNED as u64 - 1;
        let mut errors = Vec::new();
        let mut before = DeviceTicks(0);
        for k in LEARNED as u64..4000 {
            if missing > 0 && draws.bits(k + 10_000).is_multiple_of(missing) {
                continue;
            }
            let expected = pacer.blank_at(k - zero);
            errors.push(expected.ns_since(true_at(k)).abs());
            let now = stamp(k).plus_ns(200_000);
            let reading = pacer.clock().ticks_at(now);
            assert!(reading >= before, "the clock went back");
            assert_eq!(pacer.follow(now, wrap(k), stamp(k)), k - zero);
            assert_eq!(pacer.clock().ticks_at(now), reading, "the clock was set");
            before = reading;
        }
        errors
    }

    #[test]
    fn slots_stay_with_the_blanks_whatever_the_crystal_and_the_stamps() {
        for (ppm, jitter, missing) in
            [(0, 0, 0), (100, 0, 0), (-100, 500, 0), (40, 20_000, 0), (-2000, 1000, 5)]
        {
            let errors = follow(ppm, jitter, missing);
            let settled = errors[2000..].iter().max().unwrap();
            assert!(*settled <= 2_000 + jitter as i64 / 2, "{ppm} ppm, {jitter} ns: {settled} ns off");
            let worst = errors.iter().max().unwrap();
            assert!(*worst < 1_000_000 + 2 * jitter as i64, "{ppm} ppm: {worst} ns off at the start");
        }
    }

    #[test]
    fn what_does_not_run_at_its_rate_is_refused() {
        let rate = FrameRate::new(60, 1).unwrap();
        let stamps = |step: i64, count: u32| -> Vec<_> {
            (0..6u32).map(|k| (k * count, HostTime(i64::from(k) * step))).collect()
        };
        assert!(Pacer::learn(rate, 0, &stamps(16_666_667, 1)).is_ok());
        assert_eq!(Pacer::learn(rate, 0, &stamps(16_666_667, 0)).err(), Some(NoPace::NoCount));
        assert_eq!(Pacer::learn(rate, 0, &stamps(0, 1)).err(), Some(NoPace::NoCount));
        assert_eq!(Pacer::learn(rate, 0, &[]).err(), Some(NoPace::NoCount));
        assert!(matches!(
            Pacer::learn(rate, 0, &stamps(20_000_000, 1)),
            Err(NoPace::OtherRate { measured, .. }) if (measured - 50.0).abs() < 0.01
        ));
        assert!(Pacer::learn(rate, 0, &stamps(33_333_333, 2)).is_ok(), "every other blank was seen");
    }
}
