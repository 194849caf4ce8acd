//! Keeps a spinning SCHED_FIFO thread out of the kernel's real-time throttling.
//!
//! Linux lets real-time threads use `sched_rt_runtime_us` of every `sched_rt_period_us` (0.95 s of 1 s) and then stops them all for
//! the rest: a 50 ms gap in the light. A thread that spins must therefore give some of its time back by itself, in
//! pieces too short to be seen. [`SpinBudget`] says when.

/// The kernel's limit on real-time threads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Throttling {
    /// Microseconds that real-time threads may run in a period; `None` is no limit.
    pub runtime_us: Option<u64>,
    /// Length of the period, microseconds.
    pub period_us: u64,
}

impl Throttling {
    /// Reads the limit in force; the kernel's own default when it cannot be read.
    pub fn read() -> Self {
        let read = |name: &str| std::fs::read_to_string(format!("/proc/sys/kernel/{name}")).ok();
        Self::parse(
            read("sched_rt_runtime_us").as_deref().unwrap_or("950000"),
            read("sched_rt_period_us").as_deref().unwrap_or("1000000"),
        )
    }

    fn parse(runtime: &str, period: &str) -> Self {
        let period_us = period.trim().parse().ok().filter(|p| *p > 0).unwrap_or(1_000_000);
        let runtime_us = match runtime.trim().parse::<i64>() {
            Ok(-1) => None,
            Ok(us) => Some(us.max(0).unsigned_abs()),
            Err(_) => Some(950_000),
        };
        Self { runtime_us: runtime_us.filter(|r| *r < period_us), period_us }
    }

    /// Share of the time that a thread may spin without being stopped, 0 to 1, with a tenth of the kernel's own reserve kept
    /// back for the measurement's coarseness.
    pub fn spin_share(&self) -> f64 {
        match self.runtime_us {
            None => 1.0,
            Some(runtime_us) => {
                let share = runtime_us as f64 / self.period_us as f64;
                (share - 0.1 * (1.0 - share)).max(0.0)
            }
        }
    }
}

/// Spreads the pauses that throttling demands. A token bucket: being awake fills it, being asleep empties it, and when it is
/// full the thread must sleep for as long as [`SpinBudget::pause_needed_ns`] says.
#[derive(Clone, Debug)]
pub struct SpinBudget {
    share: f64,
    awake_since_ns: i64,
    debt_ns: f64,
}

/// A pause is due once this much sleep is owed: short against a frame, long against the cost of a system call.
const PAUSE_NS: f64 = 100_000.0;

impl SpinBudget {
    /// For a thread that starts to spin at `now_ns`. `real_time` is whether it runs under SCHED_FIFO: others are not throttled.
    pub fn new(throttling: Throttling, real_time: bool, now_ns: i64) -> Self {
        let share = if real_time { throttling.spin_share() } else { 1.0 };
        Self { share, awake_since_ns: now_ns, debt_ns: 0.0 }
    }

    /// True when spinning is pointless to attempt: the kernel allows less than half of the time.
    pub fn must_park(&self) -> bool {
        self.share < 0.5
    }

    /// Nanoseconds to sleep now; 0 most of the time. Call once a frame, with the clock's time.
    pub fn pause_needed_ns(&mut self, now_ns: i64) -> i64 {
        if self.share >= 1.0 {
            return 0;
        }
        let awake_ns = now_ns.saturating_sub(self.awake_since_ns).max(0) as f64;
        self.awake_since_ns = now_ns;
        // Awake a, asleep s, share = a / (a + s): each awake nanosecond owes (1 - share) / share.
        self.debt_ns += awake_ns * (1.0 - self.share) / self.share.max(1e-3);
        if self.debt_ns >= PAUSE_NS {
            // One pause is never longer than a few frames, however long the thread was not asked.
            self.debt_ns.min(20.0 * PAUSE_NS) as i64
        } else {
            0
        }
    }

    /// Tells that the thread slept (parked or paused) from `from_ns` to `to_ns`: that pays what is owed, and is no credit for later
    /// than one period.
    pub fn slept(&mut self, from_ns: i64, to_ns: i64) {
        let slept_ns = to_ns.saturating_sub(from_ns).max(0);
        self.awake_since_ns = self.awake_since_ns.saturating_add(slept_ns);
        self.debt_ns = (self.debt_ns - slept_ns as f64).max(0.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_the_kernels_words() {
        let usual = Throttling::parse("950000\n", "1000000\n");
        assert_eq!(usual, Throttling { runtime_us: Some(950_000), period_us: 1_000_000 });
        assert!((usual.spin_share() - 0.945).abs() < 1e-12);
        assert_eq!(Throttling::parse("-1", "1000000").spin_share(), 1.0);
        assert_eq!(Throttling::parse("1000000", "1000000").spin_share(), 1.0);
        assert_eq!(Throttling::parse("0", "1000000").spin_share(), 0.0);
        assert_eq!(Throttling::parse("rubbish", "0"), usual);
    }

    /// The kernel's rule, as a model: in no period may the thread be awake longer than the runtime.
    #[test]
    fn a_spinning_thread_never_uses_up_a_period() {
        let limit = Throttling { runtime_us: Some(950_000), period_us: 1_000_000 };
        let mut budget = SpinBudget::new(limit, true, 0);
        assert!(!budget.must_park());
        let (mut now, mut awake_in_period, mut period, mut longest_pause) = (0i64, 0i64, 0i64, 0i64);
        let slot = 1_055_966;
        while now < 20_000_000_000 {
            now += slot;
            awake_in_period += slot;
            let pause = budget.pause_needed_ns(now);
            if pause > 0 {
                longest_pause = longest_pause.max(pause);
                budget.slept(now, now + pause);
                now += pause;
            }
            if now / 1_000_000_000 != period {
                assert!(awake_in_period <= 950_000_000, "{awake_in_period} ns awake in period {period}");
                period = now / 1_000_000_000;
                awake_in_period = 0;
            }
        }
        assert!(longest_pause < 200_000, "a pause of {longest_pause} ns would be seen");
    }

    #[test]
    fn a_thread_that_parks_or_is_not_real_time_owes_nothing() {
        let limit = Throttling { runtime_us: Some(950_000), period_us: 1_000_000 };
        let mut normal = SpinBudget::new(limit, false, 0);
        assert_eq!(normal.pause_needed_ns(10_000_000_000), 0);
        let mut parking = SpinBudget::new(limit, true, 0);
        for i in 0..10_000 {
            let frame = i * 1_000_000;
            parking.slept(frame + 500_000, frame + 1_000_000);
            assert_eq!(parking.pause_needed_ns(frame + 1_000_000), 0);
        }
        assert!(SpinBudget::new(Throttling::parse("0", "1000000"), true, 0).must_park());
    }
}
