//! Time as integers: instants on the host's clock, instants on a device's clock, and frame slots.
//!
//! Floating-point seconds lose 7.8 ms a day in f32 and 256 ns today in f64 Unix nanoseconds, so no instant is ever a float.

/// An instant on the host's monotonic clock (the rig's clock at virtual pace), in nanoseconds since an arbitrary epoch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct HostTime(pub i64);

impl HostTime {
    /// This instant moved by `duration_ns` (may be negative); saturates instead of wrapping.
    pub const fn plus_ns(self, duration_ns: i64) -> Self {
        Self(self.0.saturating_add(duration_ns))
    }

    /// Nanoseconds from `earlier` to `self`; negative when `self` is the earlier one; saturates.
    pub const fn ns_since(self, earlier: Self) -> i64 {
        self.0.saturating_sub(earlier.0)
    }
}

/// The source of "now": the monotonic clock in a deployed rig, a counter in a test. Any `Fn() -> HostTime` implements
/// it.
pub trait HostClock: Send + Sync {
    /// The present instant; never earlier than the previous answer.
    fn now(&self) -> HostTime;
}

impl<F: Fn() -> HostTime + Send + Sync> HostClock for F {
    fn now(&self) -> HostTime {
        self()
    }
}

/// An instant on a device's own clock, in that device's ticks. Mapped to [`HostTime`] by echo exchanges, never compared directly.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct DeviceTicks(pub u64);

/// A frame rate as a fraction, frames per second = `num / den`: 947 fps does not divide a second.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameRate {
    num: u32,
    den: u32,
}

impl FrameRate {
    /// `num / den` frames per second; `None` when either is zero.
    pub const fn new(num: u32, den: u32) -> Option<Self> {
        if num == 0 || den == 0 {
            None
        } else {
            Some(Self { num, den })
        }
    }

    /// Numerator of the rate.
    pub const fn num(self) -> u32 {
        self.num
    }

    /// Denominator of the rate.
    pub const fn den(self) -> u32 {
        self.den
    }

    /// Frames per second, for display only.
    pub fn hz(self) -> f64 {
        f64::from(self.num) / f64::from(self.den)
    }

    /// Nanoseconds from the epoch of slot 0 to the start of slot `slot`, rounded down: always within 1 ns of the exact
    /// rational value, with no accumulated drift. Saturates beyond 292 years.
    pub const fn slot_start_ns(self, slot: u64) -> i64 {
        let exact = slot as u128 * 1_000_000_000 * self.den as u128 / self.num as u128;
        if exact > i64::MAX as u128 {
            i64::MAX
        } else {
            exact as i64
        }
    }

    /// The slot that contains the instant `ns` after the epoch of slot 0; negative instants are before slot 0 and give 0.
    pub const fn slot_at_ns(self, ns: i64) -> u64 {
        if ns <= 0 {
            return 0;
        }
        // The largest k with floor(k * 1e9 * den / num) <= ns, that is k * 1e9 * den < (ns + 1) * num.
        let k = ((ns as u128 + 1) * self.num as u128 - 1) / (1_000_000_000 * self.den as u128);
        k as u64
    }

    /// Length of slot `slot` in nanoseconds (differs by at most 1 ns between slots).
    pub const fn slot_len_ns(self, slot: u64) -> i64 {
        self.slot_start_ns(slot + 1) - self.slot_start_ns(slot)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slots_do_not_drift_in_400_days() {
        let rate = FrameRate::new(947, 1).unwrap();
        let slots_per_day = 947 * 86_400;
        for day in [1u64, 400] {
            assert_eq!(rate.slot_start_ns(slots_per_day * day), 86_400_000_000_000 * day as i64);
        }
        for slot in (0..10_000_000_000u64).step_by(7_654_321) {
            let start = rate.slot_start_ns(slot);
            assert_eq!(rate.slot_at_ns(start), slot);
            if slot > 0 {
                assert_eq!(rate.slot_at_ns(start - 1), slot - 1);
            }
            assert!((1_055_966..=1_055_967).contains(&rate.slot_len_ns(slot)));
        }
    }
}
