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

    /// When the light of a frame must be off that is planned for `stride` slots from `slot` on, and whose poses may
    /// be predicted for `predict_ns`: the end of those slots plus the longer of `predict_ns` and three slots.
    pub(crate) fn dark_from(&self, slot: u64, stride: u64, predict_ns: i64) -> DeviceTicks {
        let last = slot.saturating_sub(self.first).saturating_add(stride.max(1) - 1);
        self.clock.dark_from(last, predict_ns.max(0) as u64)
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
        let mut slot = self.first.saturating_add(self.clock.rate().slot_at_ns(since));
        while self.host_of_slot(slot) < at {
            slot += 1;
        }
        slot
    }
}
