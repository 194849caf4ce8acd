//! Instants into frame slots: which slot a frame is for, and which slots were missed and why.
//!
//! Slot k starts at epoch + k * den / num seconds, computed anew from k each time, so nothing drifts (947 fps does not divide a
//! second). A stall never shifts the phase: what was missed is counted, and the next frame is for the next slot that can
//! still be met. Frames are never queued up to make good for lost ones.

use dpm_device::time::{FrameRate, HostTime};

/// Why a slot got no frame of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum MissCause {
    /// Planning was not ready.
    Plan,
    /// Rendering took too long.
    Render,
    /// Packing took too long.
    Pack,
    /// The link or the device took no frame.
    Link,
    /// No memory for another frame in flight: a later stage holds all buffers.
    Buffers,
    /// The machine itself stood still.
    Standstill,
}

impl MissCause {
    /// All causes, in the order of their counters.
    pub const ALL: [Self; 6] =
        [Self::Plan, Self::Render, Self::Pack, Self::Link, Self::Buffers, Self::Standstill];

    /// As printed.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Plan => "plan",
            Self::Render => "render",
            Self::Pack => "pack",
            Self::Link => "link",
            Self::Buffers => "buffers",
            Self::Standstill => "standstill",
        }
    }
}

/// A slot and its bounds on the host's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Slot {
    /// Number since the epoch.
    pub index: u64,
    /// When its light is due.
    pub due: HostTime,
    /// When the next slot's light is due.
    pub ends: HostTime,
}

/// Hands out slots in order, each once.
#[derive(Clone, Debug)]
pub struct SlotScheduler {
    rate: FrameRate,
    epoch: HostTime,
    next: u64,
    missed: [u64; MissCause::ALL.len()],
}

impl SlotScheduler {
    /// Slot 0 is due at `epoch`.
    pub fn new(rate: FrameRate, epoch: HostTime) -> Self {
        Self { rate, epoch, next: 0, missed: [0; MissCause::ALL.len()] }
    }

    /// Slot number `index`, wherever the scheduler stands.
    pub fn slot(&self, index: u64) -> Slot {
        Slot {
            index,
            due: self.epoch.plus_ns(self.rate.slot_start_ns(index)),
            ends: self.epoch.plus_ns(self.rate.slot_start_ns(index.saturating_add(1))),
        }
    }

    /// The slot that contains `at`; slot 0 for instants before the epoch.
    pub fn slot_at(&self, at: HostTime) -> Slot {
        self.slot(self.rate.slot_at_ns(at.ns_since(self.epoch)))
    }

    /// The next slot not yet handed out.
    pub fn upcoming(&self) -> Slot {
        self.slot(self.next)
    }

    /// Hands out the first slot, among those not yet handed out, that is due at `earliest` or later. Slots skipped on the way are
    /// counted under `cause`.
    pub fn take(&mut self, earliest: HostTime, cause: MissCause) -> Slot {
        let first = self.first_due_from(earliest);
        if first > self.next {
            self.missed[cause as usize] = self.missed[cause as usize].saturating_add(first - self.next);
            self.next = first;
        }
        let slot = self.slot(self.next);
        self.next = self.next.saturating_add(1);
        slot
    }

    fn first_due_from(&self, earliest: HostTime) -> u64 {
        let since = earliest.ns_since(self.epoch);
        if since <= 0 {
            return 0;
        }
        let containing = self.rate.slot_at_ns(since);
        if self.rate.slot_start_ns(containing) >= since {
            containing
        } else {
            containing.saturating_add(1)
        }
    }

    /// Slots missed for a reason.
    pub fn missed(&self, cause: MissCause) -> u64 {
        self.missed[cause as usize]
    }

    /// Slots missed for any reason.
    pub fn missed_total(&self) -> u64 {
        self.missed.iter().fold(0, |sum, n| sum.saturating_add(*n))
    }

    /// Slots handed out or missed so far; the number of the next one.
    pub fn passed(&self) -> u64 {
        self.next
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// ceil(a / b) in 128 bits: the model.
    fn first_due_model(since_ns: i64, num: u32, den: u32) -> u64 {
        if since_ns <= 0 {
            return 0;
        }
        // floor(k * 1e9 * den / num) >= s  <=>  k >= s * num / (1e9 * den).
        let (s, unit) = (since_ns as i128 * i128::from(num), 1_000_000_000i128 * i128::from(den));
        ((s + unit - 1) / unit) as u64
    }

    proptest! {
        #[test]
        fn every_slot_is_handed_out_or_counted_once(
            num in 1u32..100_000, den in 1u32..2000, epoch in -1_000_000_000_000i64..1_000_000_000_000,
            steps in prop::collection::vec((0i64..20_000_000_000, 0usize..6), 1..40),
        ) {
            let rate = FrameRate::new(num, den).unwrap();
            let mut scheduler = SlotScheduler::new(rate, HostTime(epoch));
            let (mut now, mut handed, mut last) = (epoch - 5_000_000, 0u64, None);
            for (step, cause) in steps {
                now += step;
                let slot = scheduler.take(HostTime(now), MissCause::ALL[cause]);
                handed += 1;
                prop_assert!(slot.due.0 >= now);
                prop_assert!(last.is_none_or(|l| slot.index > l), "in order");
                let model = first_due_model(now - epoch, num, den).max(last.map_or(0, |l| l + 1));
                prop_assert_eq!(slot.index, model);
                prop_assert!(slot.due < slot.ends || rate.hz() > 1e9);
                prop_assert_eq!(scheduler.missed_total() + handed, scheduler.passed());
                last = Some(slot.index);
            }
        }
    }

    #[test]
    fn a_stall_is_counted_and_the_phase_kept() {
        let rate = FrameRate::new(947, 1).unwrap();
        for missed in [1u64, 10, 1_000_000] {
            let mut scheduler = SlotScheduler::new(rate, HostTime(77));
            let first = scheduler.take(HostTime(0), MissCause::Plan);
            assert_eq!((first.index, first.due), (0, HostTime(77)));
            let resume = scheduler.slot(missed + 1).due;
            let slot = scheduler.take(resume, MissCause::Render);
            assert_eq!((slot.index, scheduler.missed(MissCause::Render)), (missed + 1, missed));
            assert_eq!(scheduler.missed_total(), missed);
            // One nanosecond too late is the next slot.
            let later = scheduler.take(scheduler.slot(missed + 2).due.plus_ns(1), MissCause::Link);
            assert_eq!((later.index, scheduler.missed(MissCause::Link)), (missed + 3, 1));
            // Whoever asks too early gets the next slot, not the last one again.
            assert_eq!(scheduler.take(HostTime(0), MissCause::Plan).index, missed + 4);
        }
    }

    #[test]
    fn frame_numbers_beyond_32_and_53_bits_are_exact() {
        let rate = FrameRate::new(947, 1).unwrap();
        let mut scheduler = SlotScheduler::new(rate, HostTime(0));
        for index in [(1u64 << 32) - 1, 1 << 32, (1 << 32) + 1, 1 << 40] {
            let due = (u128::from(index) * 1_000_000_000 / 947) as i64;
            assert_eq!(
                scheduler.take(HostTime(due), MissCause::Plan),
                Slot {
                    index,
                    due: HostTime(due),
                    ends: HostTime((u128::from(index + 1) * 1_000_000_000 / 947) as i64),
                }
            );
        }
        // At 1e9 fps a slot is a nanosecond and 2^53 of them are 104 days.
        let mut fast = SlotScheduler::new(FrameRate::new(1_000_000_000, 1).unwrap(), HostTime(0));
        for index in [1u64 << 53, (1 << 53) + 1] {
            assert_eq!(fast.take(HostTime(index as i64), MissCause::Plan).index, index);
        }
        assert_eq!(fast.missed_total(), 1 << 53);
        // The end of time saturates instead of wrapping.
        let last = fast.take(HostTime(i64::MAX), MissCause::Plan);
        assert_eq!(last.due, HostTime(i64::MAX));
    }

    #[test]
    fn causes_have_their_own_counters() {
        for (i, cause) in MissCause::ALL.into_iter().enumerate() {
            assert_eq!(cause as usize, i);
        }
    }
}
