//! Converts true time to the ticks of a device's own clock, which runs at its own rate, and back.

use crate::time::{DeviceTicks, HostTime};

/// A free-running counter: `start_ticks` at `power_on_at`, then `tick_hz * (1 + skew_ppb / 1e9)` ticks a second.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceClock {
    /// Nominal rate, ticks a second, at least 1.
    pub tick_hz: u32,
    /// Error of the rate in parts per 10^9; positive runs fast. Crystals stay within 100,000 (100 ppm).
    pub skew_ppb: i32,
    /// Reading at power-on.
    pub start_ticks: u64,
    /// True time of power-on; before it the counter stands still.
    pub power_on_at: HostTime,
}

impl DeviceClock {
    /// One tick a nanosecond, no error, 0 at time 0: device ticks equal true nanoseconds.
    pub const IDEAL: Self =
        Self { tick_hz: 1_000_000_000, skew_ppb: 0, start_ticks: 0, power_on_at: HostTime(0) };

    /// The exact rate is this many ticks in 10^18 nanoseconds.
    const fn rate(&self) -> u128 {
        self.tick_hz as u128 * (1_000_000_000 + self.skew_ppb as i64) as u128
    }

    /// Reading at the true time `at`, rounded down; saturates.
    pub fn ticks_at(&self, at: HostTime) -> DeviceTicks {
        let ns = at.ns_since(self.power_on_at).max(0) as u128;
        let ticks = ns * self.rate() / 1_000_000_000_000_000_000;
        DeviceTicks(u64::try_from(ticks).unwrap_or(u64::MAX).saturating_add(self.start_ticks))
    }

    /// The first nanosecond of true time at which the counter reads `ticks` or more; saturates.
    pub fn instant_of(&self, ticks: DeviceTicks) -> HostTime {
        let d = u128::from(ticks.0.saturating_sub(self.start_ticks));
        let ns = (d * 1_000_000_000_000_000_000).div_ceil(self.rate());
        self.power_on_at.plus_ns(i64::try_from(ns).unwrap_or(i64::MAX))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn instant_of_is_the_first_nanosecond_of_a_tick() {
        for clock in [
            DeviceClock::IDEAL,
            DeviceClock {
                tick_hz: 27_000_000,
                skew_ppb: 37_000,
                start_ticks: u64::from(u32::MAX) - 5,
                power_on_at: HostTime(-77),
            },
            DeviceClock {
                tick_hz: 1_000_000,
                skew_ppb: -100_000,
                start_ticks: 9,
                power_on_at: HostTime(1_000),
            },
        ] {
            for d in (0..100_000_000_000_000u64).step_by(7_777_777_777_777).chain(0..40) {
                let t = DeviceTicks(clock.start_ticks + d);
                let at = clock.instant_of(t);
                assert!(clock.ticks_at(at) >= t);
                assert!(d == 0 || clock.ticks_at(at.plus_ns(-1)) < t, "{clock:?} {d}");
            }
            // A second later, one second's worth of ticks.
            let a = clock.ticks_at(clock.power_on_at.plus_ns(1_000_000_000)).0 - clock.start_ticks;
            let exact = f64::from(clock.tick_hz) * (1.0 + f64::from(clock.skew_ppb) * 1e-9);
            assert!((a as f64 - exact).abs() <= 1.0);
        }
    }
}
