//! Computes from a frame rate when each of the device's slots begins, in device ticks.

use crate::time::{DeviceTicks, FrameRate};

/// The slots of a configured device. Slot `k` begins at `epoch + floor(k * tick_hz * den / num)`: never more than a tick from
/// the exact rational instant, with no accumulated drift. From one slot on, another epoch may hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SlotClock {
    epoch: DeviceTicks,
    /// The first slot for which another epoch holds, and that epoch.
    shifted: Option<SlotShift>,
    tick_hz: u32,
    rate: FrameRate,
}

/// A slot, from which on all slots begin as if slot 0 had begun at `epoch`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SlotShift {
    /// The first of these slots.
    pub slot: u64,
    /// Start of slot 0 as these slots count it.
    pub epoch: DeviceTicks,
}

/// Slots in light begin earlier or later by at most this part of a slot with each shift.
pub const SHIFT_PARTS: u64 = 64;

impl SlotClock {
    /// Slots of `rate` on a clock of `tick_hz` ticks a second, slot 0 at `epoch`. `None` when `tick_hz` is 0 or a slot would
    /// be shorter than one tick.
    pub const fn new(epoch: DeviceTicks, tick_hz: u32, rate: FrameRate) -> Option<Self> {
        if (tick_hz as u64) * (rate.den() as u64) < rate.num() as u64 {
            return None;
        }
        Some(Self { epoch, shifted: None, tick_hz, rate })
    }

    /// The same slots, but from slot `shift.slot` on as if slot 0 had begun at `shift.epoch`. What held for the slot before
    /// it holds for all before it.
    pub const fn with_shift(&self, shift: SlotShift) -> Self {
        Self { epoch: self.epoch_of(shift.slot.saturating_sub(1)), shifted: Some(shift), ..*self }
    }

    /// Start of slot 0 as slot `slot` counts it.
    pub const fn epoch_of(&self, slot: u64) -> DeviceTicks {
        match self.shifted {
            Some(shift) if slot >= shift.slot => shift.epoch,
            _ => self.epoch,
        }
    }

    /// The last shift.
    pub const fn shift(&self) -> Option<SlotShift> {
        self.shifted
    }

    /// Length of a slot, ticks, rounded down.
    pub const fn slot_ticks(&self) -> u64 {
        self.tick_hz as u64 * self.rate.den() as u64 / self.rate.num() as u64
    }

    /// Start of slot `slot`; saturates at the end of the counter.
    pub const fn start(&self, slot: u64) -> DeviceTicks {
        // At most 2^64 * 2^32 * 2^32: fits 128 bits exactly once; the division brings it back.
        let ticks = (slot as u128).saturating_mul(self.tick_hz as u128 * self.rate.den() as u128)
            / self.rate.num() as u128;
        let at = ticks + self.epoch_of(slot).0 as u128;
        DeviceTicks(if at > u64::MAX as u128 { u64::MAX } else { at as u64 })
    }

    /// The slot that contains the instant `at`; `None` before slot 0.
    pub const fn slot_at(&self, at: DeviceTicks) -> Option<u64> {
        match self.shifted {
            Some(shift) if at.0 >= self.start(shift.slot).0 => self.slot_by(shift.epoch, at),
            Some(shift) => match self.slot_by(self.epoch, at) {
                // The slot before the first shifted one may last longer than the others.
                Some(k) if k >= shift.slot => shift.slot.checked_sub(1),
                k => k,
            },
            None => self.slot_by(self.epoch, at),
        }
    }

    const fn slot_by(&self, epoch: DeviceTicks, at: DeviceTicks) -> Option<u64> {
        if at.0 < epoch.0 {
            return None;
        }
        // The largest k with floor(k * hz * den / num) <= d, that is k * hz * den < (d + 1) * num.
        let d = (at.0 - epoch.0) as u128;
        let k = ((d + 1) * self.rate.num() as u128 - 1) / (self.tick_hz as u128 * self.rate.den() as u128);
        Some(k as u64)
    }

    /// The tick from which a frame that is planned for slots up to `last` may no longer be lit: the end of that slot
    /// plus the longer of `keep_ns` nanoseconds (nominal) and three slots. Saturates at the end of the counter.
    pub const fn dark_from(&self, last: u64, keep_ns: u64) -> DeviceTicks {
        let end = self.start(last.saturating_add(1)).0;
        let ticks = keep_ns as u128 * self.tick_hz as u128 / 1_000_000_000;
        let kept = end.saturating_add(if ticks > u64::MAX as u128 { u64::MAX } else { ticks as u64 });
        let slots = self.start(last.saturating_add(4)).0;
        DeviceTicks(if kept > slots { kept } else { slots })
    }

    /// Start of slot 0, as the slots before the last shift count it.
    pub const fn epoch(&self) -> DeviceTicks {
        self.epoch
    }

    /// Nominal ticks a second of the device's clock.
    pub const fn tick_hz(&self) -> u32 {
        self.tick_hz
    }

    /// Frames a second.
    pub const fn rate(&self) -> FrameRate {
        self.rate
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slot_at_inverts_start_for_odd_rates_and_clocks() {
        for (hz, num, den) in
            [(1_000_000_000, 947, 1), (27_000_000, 60_000, 1001), (1_000_003, 947, 1), (947, 947, 1)]
        {
            let clock = SlotClock::new(DeviceTicks(12_345), hz, FrameRate::new(num, den).unwrap()).unwrap();
            assert_eq!(clock.slot_at(DeviceTicks(12_344)), None);
            for slot in (0..20_000_000_000u64).step_by(123_456_789).chain(0..50) {
                let start = clock.start(slot);
                assert_eq!(clock.slot_at(start), Some(slot), "{hz} Hz, {num}/{den}, slot {slot}");
                if slot > 0 {
                    assert_eq!(clock.slot_at(DeviceTicks(start.0 - 1)), Some(slot - 1));
                }
            }
        }
        // A day of 947 fps on a nanosecond clock is a day.
        let clock = SlotClock::new(DeviceTicks(7), 1_000_000_000, FrameRate::new(947, 1).unwrap()).unwrap();
        assert_eq!(clock.start(947 * 86_400).0, 86_400_000_000_007);
    }

    /// Found in use, R1: the end of a frame's light when nobody sends another.
    #[test]
    fn light_ends_after_the_longer_of_three_slots_and_the_given_time() {
        let clock = SlotClock::new(DeviceTicks(77), 27_000_000, FrameRate::new(947, 1).unwrap()).unwrap();
        for last in [0u64, 1, 946, 1 << 40] {
            let end = clock.start(last + 1).0;
            assert_eq!(clock.dark_from(last, 0), clock.start(last + 4));
            assert_eq!(clock.dark_from(last, 3_000_000), clock.start(last + 4), "three slots are 3.17 ms");
            assert_eq!(clock.dark_from(last, 20_000_000).0, end + 540_000);
        }
        assert_eq!(clock.dark_from(u64::MAX, u64::MAX).0, u64::MAX);
        let slow = SlotClock::new(DeviceTicks(0), 1000, FrameRate::new(1, 1).unwrap()).unwrap();
        assert_eq!(slow.dark_from(0, 20_000_000).0, 4000);
    }

    /// Slots are as long as before on both sides of a shift; the one before it is longer or shorter by as much.
    #[test]
    fn a_shift_changes_the_length_of_one_slot() {
        let clock = SlotClock::new(DeviceTicks(5_000), 27_000_000, FrameRate::new(947, 1).unwrap()).unwrap();
        for by in [-400i64, -1, 1, 400, 28_511] {
            let later = |epoch: DeviceTicks| DeviceTicks(epoch.0.saturating_add_signed(by));
            let once = clock.with_shift(SlotShift { slot: 50, epoch: later(clock.epoch_of(50)) });
            let twice = once.with_shift(SlotShift { slot: 90, epoch: later(once.epoch_of(90)) });
            for k in 0..49 {
                assert_eq!(once.start(k), clock.start(k));
            }
            for k in 50..200 {
                assert_eq!(once.start(k).0, clock.start(k).0.saturating_add_signed(by));
                let shifts = if k < 90 { by } else { 2 * by };
                assert_eq!(twice.start(k).0, clock.start(k).0.saturating_add_signed(shifts));
            }
            for (slots, from) in [(once, 0), (twice, 50)] {
                for k in from..200u64 {
                    assert_eq!(slots.slot_at(slots.start(k)), Some(k), "{by}");
                    assert_eq!(slots.slot_at(DeviceTicks(slots.start(k + 1).0 - 1)), Some(k), "{by}");
                }
            }
        }
    }

    #[test]
    fn slots_shorter_than_a_tick_are_refused_and_ends_saturate() {
        assert!(SlotClock::new(DeviceTicks(0), 946, FrameRate::new(947, 1).unwrap()).is_none());
        assert!(SlotClock::new(DeviceTicks(0), 0, FrameRate::new(1, 1).unwrap()).is_none());
        let clock = SlotClock::new(DeviceTicks(5), u32::MAX, FrameRate::new(1, u32::MAX).unwrap()).unwrap();
        assert_eq!(clock.start(u64::MAX).0, u64::MAX);
        assert_eq!(clock.slot_at(DeviceTicks(u64::MAX)), Some(1));
    }
}
