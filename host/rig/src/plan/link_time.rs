//! Converts between the projector's slots and instants of the host's clock.

use dpm_device::link::SlotClock;
use dpm_device::time::{DeviceTicks, HostTime};

/// The projector's slots on the host's clock.
#[derive(Clone, Copy, Debug)]
pub struct LinkTime {
    /// Slots on the device's clock.
    pub clock: SlotClock,
    /// The run's number for slot 0 of this clock. A device that comes back starts a new clock, but the run continues
    /// to count.
    pub first: u64,
    /// An instant of the device's clock, and the host's reading at that instant.
    pub anchor: (DeviceTicks, HostTime),
    /// The host's reading may be wrong by plus or minus this, nanoseconds: half of the round trip that found it, because
    /// nobody knows which way took longer.
    pub bound_ns: i64,
}

impl LinkTime {
    /// Start of a slot on the device's clock. For slots before the clock's first slot: the start of the first one.
    pub(crate) fn start(&self, slot: u64) -> DeviceTicks {
        self.clock.start(slot.saturating_sub(self.first))
    }

    /// The slot that contains an instant of the device's clock; `None` before the clock's first slot.
    pub(crate) fn slot_at(&self, ticks: DeviceTicks) -> Option<u64> {
        self.clock.slot_at(ticks).map(|k| self.first.saturating_add(k))
    }

    /// When the light of a frame must be off that is planned for `stride` slots from `slot` on, and whose oldest pose was
    /// captured at `captured_at`: when this pose may be older than `predict_ns` and a slot, but not before three slots
    /// after the frame's own. If no tracked body is lit (`None`), nothing ages: `predict_ns` after its own slots, and not
    /// before three. A frame that arrives late and a frame that is shown once more end alike.
    pub(crate) fn dark_from(
        &self,
        slot: u64,
        stride: u64,
        predict_ns: i64,
        captured_at: Option<HostTime>,
    ) -> DeviceTicks {
        let after = slot.saturating_add(stride.max(1));
        let keep_ns = captured_at.map_or(predict_ns, |captured_at| {
            let end = self.host_of_slot(after);
            let slot_ns = end.ns_since(self.host_of_slot(after - 1));
            let age_ns = end.ns_since(captured_at).saturating_add(self.bound_ns);
            predict_ns.saturating_add(slot_ns).saturating_sub(age_ns).min(predict_ns)
        });
        self.clock.dark_from(after.saturating_sub(self.first).max(1) - 1, keep_ns.max(0) as u64)
    }

    /// Start of a slot on the host's clock.
    pub(crate) fn host_of_slot(&self, slot: u64) -> HostTime {
        self.host_of(self.start(slot))
    }

    /// Converts a reading of the device's clock to the host's, at the nominal rate.
    pub(crate) fn host_of(&self, ticks: DeviceTicks) -> HostTime {
        let delta = i128::from(ticks.0) - i128::from(self.anchor.0 .0);
        let ns = delta * 1_000_000_000 / i128::from(self.clock.tick_hz());
        self.anchor.1.plus_ns(i64::try_from(ns).unwrap_or(if ns > 0 { i64::MAX } else { i64::MIN }))
    }

    /// Converts an instant of the host's clock to the device's, at the nominal rate; 0 before the device's clock began.
    pub(crate) fn ticks_of(&self, at: HostTime) -> DeviceTicks {
        let ns = i128::from(at.0) - i128::from(self.anchor.1 .0);
        let ticks = ns * i128::from(self.clock.tick_hz()) / 1_000_000_000 + i128::from(self.anchor.0 .0);
        DeviceTicks(u64::try_from(ticks.max(0)).unwrap_or(u64::MAX))
    }

    /// The first slot that starts at or after `at`.
    pub(crate) fn slot_after(&self, at: HostTime) -> u64 {
        let since = at.ns_since(self.host_of_slot(self.first));
        if since <= 0 {
            return self.first;
        }
        // A shift may have let slots begin up to one later.
        let about = self.clock.rate().slot_at_ns(since).saturating_sub(1);
        let mut slot = self.first.saturating_add(about);
        while self.host_of_slot(slot) < at {
            slot += 1;
        }
        slot
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::time::FrameRate;

    const MS: i64 = 1_000_000;

    /// Light ends when its oldest pose may be older than the prediction time and a slot, whenever the frame arrived. The
    /// three slots after its own, which bridge a frame that is lost, are always left to it.
    #[test]
    fn light_ends_when_its_oldest_pose_may_be_too_old() {
        for (hz, stride, age_ms, predict_ms, bound_ms, kept_ms) in [
            // 10 ms old when its slot of 1 ms begins: 11 ms at its end, so that 20 ms are left of 30 and 1.
            (1000, 1, 10, 30, 0, 20),
            // An unsure clock takes its share, and so do slots that the frame is shown for.
            (1000, 1, 10, 30, 7, 13),
            (1000, 4, 10, 30, 0, 17),
            // Never less than three slots ...
            (1000, 1, 29, 30, 0, 3),
            (50, 1, 10, 30, 0, 60),
            // ... and never more than the prediction time, though the pose is of the slot itself.
            (1000, 1, 0, 30, 0, 30),
            (1000, 1, -20, 30, 0, 30),
        ] {
            let clock =
                SlotClock::new(DeviceTicks(5_000), 1_000_000, FrameRate::new(hz, 1).unwrap()).unwrap();
            let anchor = (DeviceTicks(7_000), HostTime(90 * MS));
            let slots = LinkTime { clock, first: 100, anchor, bound_ns: bound_ms * MS };
            let begin = slots.host_of_slot(140);
            let dark = |captured_at| {
                let dark = slots.dark_from(140, stride, predict_ms * MS, captured_at);
                slots.host_of(dark).ns_since(slots.host_of_slot(140 + stride))
            };
            let kept = dark(Some(begin.plus_ns(-age_ms * MS)));
            assert_eq!(kept, kept_ms * MS, "{hz} frames/s, {age_ms} ms old");
            let three = 3 * 1_000_000_000 / i64::from(hz);
            assert_eq!(dark(None), three.max(predict_ms * MS), "no pose that could be old");
        }
    }
}
