//! The clock behind all time of the rig, and a manual clock for tests and virtual runs.
//!
//! Contract: `now` never goes back on one thread, and a value that is read on one thread and passed to another is not
//! ahead of what the other reads. (`std::time::Instant` is CLOCK_MONOTONIC on Linux: no leap seconds, no steps, slewed
//! by NTP by at most 500 ppm. It stands still while the machine is suspended, so a resume looks like a tracker that has
//! just returned.) All threads of a rig must share one clock: the epochs of two clocks are unrelated.

use dpm_device::time::HostTime;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::{Duration, Instant};

/// Longest wait, whatever a caller requests: a mistake in a deadline must not hang a stage.
pub(crate) const LONGEST_WAIT_NS: i64 = 1_000_000_000;

/// A source of instants on the host's clock.
pub trait Clock: Send + Sync + std::fmt::Debug {
    /// The time now.
    fn now(&self) -> HostTime;

    /// Returns at `at` or after [`LONGEST_WAIT_NS`], whichever is earlier, with the time at which it returned. Returns at once
    /// when `at` has passed.
    fn wait_until(&self, at: HostTime) -> HostTime;
}

/// The machine's monotonic clock. Copies share the epoch.
#[derive(Clone, Copy, Debug)]
pub struct MonotonicClock {
    epoch: Instant,
    spin_ns: i64,
}

impl MonotonicClock {
    /// A clock that reads 0 now. It spends the last `spin_ns` of a wait in a busy loop, because a sleeping thread is
    /// woken 50 us late or more (the kernel's timer slack). With 0 it sleeps to the end, for machines without a core to
    /// spare.
    pub fn new(spin_ns: i64) -> Self {
        Self { epoch: Instant::now(), spin_ns: spin_ns.max(0) }
    }
}

impl MonotonicClock {
    /// The same clock with another length of the busy loop at the end of a wait; see [`MonotonicClock::new`].
    pub fn spinning(self, spin_ns: i64) -> Self {
        Self { spin_ns: spin_ns.max(0), ..self }
    }

    /// The same clock for a thread that must not spin.
    pub fn sleeping(self) -> Self {
        Self { spin_ns: 0, ..self }
    }
}

impl Clock for MonotonicClock {
    fn now(&self) -> HostTime {
        // This saturates after 292 years.
        HostTime(i64::try_from(self.epoch.elapsed().as_nanos()).unwrap_or(i64::MAX))
    }

    fn wait_until(&self, at: HostTime) -> HostTime {
        let start = self.now();
        let at = at.min(start.plus_ns(LONGEST_WAIT_NS));
        loop {
            let now = self.now();
            let left_ns = at.ns_since(now);
            if left_ns <= 0 {
                return now;
            }
            let sleep_ns = left_ns - self.spin_ns;
            if sleep_ns > 0 {
                std::thread::sleep(Duration::from_nanos(sleep_ns.unsigned_abs()));
            } else {
                std::hint::spin_loop();
            }
        }
    }
}

/// A clock that stands still until it is moved. Waiting moves it. With a single driving thread, a run at virtual pace
/// takes no longer than its computations, and two runs are the same to the nanosecond.
#[derive(Debug, Default)]
pub struct ManualClock {
    now_ns: AtomicI64,
}

impl ManualClock {
    /// A clock that reads `start`.
    pub const fn new(start: HostTime) -> Self {
        Self { now_ns: AtomicI64::new(start.0) }
    }

    /// Moves the clock to `at`; it never goes back. Returns the time now.
    pub fn advance_to(&self, at: HostTime) -> HostTime {
        // Acquire and release: a thread that reads the new time also sees everything that happened before the clock was
        // moved.
        HostTime(self.now_ns.fetch_max(at.0, Ordering::AcqRel).max(at.0))
    }
}

impl Clock for ManualClock {
    fn now(&self) -> HostTime {
        HostTime(self.now_ns.load(Ordering::Acquire))
    }

    fn wait_until(&self, at: HostTime) -> HostTime {
        self.advance_to(at.min(self.now().plus_ns(LONGEST_WAIT_NS)))
    }
}

/// A stopwatch on wall time, for the time that a stage really took, also at virtual pace.
#[derive(Clone, Copy, Debug)]
pub struct Stopwatch(Instant);

impl Stopwatch {
    /// Starts now.
    pub fn start() -> Self {
        Self(Instant::now())
    }

    /// Nanoseconds since the start.
    pub fn elapsed_ns(self) -> u64 {
        u64::try_from(self.0.elapsed().as_nanos()).unwrap_or(u64::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wait_ends_after_its_instant_and_never_hangs() {
        for spin_ns in [0, 100_000] {
            let clock = MonotonicClock::new(spin_ns);
            let at = clock.now().plus_ns(1_000_000);
            let woke = clock.wait_until(at);
            assert!(woke >= at && clock.now() >= woke);
            let before = clock.now();
            let woke = clock.wait_until(HostTime(-5));
            assert!(
                woke >= before && woke.ns_since(before) < 50_000_000,
                "an instant in the past waits for nothing"
            );
        }
    }

    #[test]
    fn copies_share_the_epoch() {
        let clock = MonotonicClock::new(0);
        std::thread::sleep(Duration::from_millis(2));
        let copy = clock;
        let (a, b, c) = (clock.now(), copy.now(), clock.now());
        assert!(a <= b && b <= c && a.0 >= 2_000_000);
    }

    #[test]
    fn a_manual_clock_moves_only_forward_and_only_when_told() {
        let clock = ManualClock::new(HostTime(10));
        assert_eq!(clock.now(), HostTime(10));
        assert_eq!(clock.advance_to(HostTime(30)), HostTime(30));
        assert_eq!(clock.advance_to(HostTime(20)), HostTime(30));
        assert_eq!(clock.wait_until(HostTime(40)), HostTime(40));
        assert_eq!(clock.wait_until(HostTime(i64::MAX)), HostTime(40 + LONGEST_WAIT_NS));
    }
}
