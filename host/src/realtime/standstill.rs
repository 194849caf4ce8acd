//! A thread that does nothing but sleep and look at the clock, into the intervals in which the machine itself stood still.
//!
//! On a shared or virtual machine every thread may stop for milliseconds through no fault of the program. Frames that were
//! late in such an interval are reported apart. The control thread sleeps in short steps; a step that took longer than asked
//! by more than a threshold is a gap.

use crate::clock::Clock;
use dpm_device::time::HostTime;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;

/// Sleep of one step.
const STEP_NS: i64 = 500_000;

/// Gaps kept; further ones are only counted.
const KEPT: usize = 1 << 16;

/// An interval in which the control thread did not run although it should have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gap {
    /// When it should have run.
    pub from: HostTime,
    /// When it ran.
    pub to: HostTime,
}

/// All gaps of a run, in order, disjoint.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Standstills {
    gaps: Vec<Gap>,
    not_kept: u64,
}

impl Standstills {
    /// Notes a step that should have ended at `due` and ended at `woke`.
    pub(crate) fn note(&mut self, due: HostTime, woke: HostTime, threshold_ns: i64) {
        if woke.ns_since(due) <= threshold_ns {
            return;
        }
        if self.gaps.len() < KEPT {
            self.gaps.push(Gap { from: due, to: woke });
        } else {
            self.not_kept += 1;
        }
    }

    /// The gaps, in order.
    pub fn gaps(&self) -> &[Gap] {
        &self.gaps
    }

    /// Gaps beyond those kept.
    pub fn not_kept(&self) -> u64 {
        self.not_kept
    }

    /// Total length, ns.
    pub fn total_ns(&self) -> i64 {
        self.gaps.iter().map(|g| g.to.ns_since(g.from)).sum()
    }

    /// Longest gap, ns; 0 without any.
    pub fn longest_ns(&self) -> i64 {
        self.gaps.iter().map(|g| g.to.ns_since(g.from)).max().unwrap_or(0)
    }

    /// True when the machine stood still at some instant of [`from`, `to`]: a frame in flight then is excused.
    pub fn touches(&self, from: HostTime, to: HostTime) -> bool {
        // The first gap that ends after `from` is the only one that can begin early enough.
        let first = self.gaps.partition_point(|g| g.to < from);
        self.gaps.get(first).is_some_and(|g| g.from <= to)
    }
}

/// The running control thread.
#[derive(Debug)]
pub struct StandstillMonitor {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<Standstills>>,
}

impl StandstillMonitor {
    /// Starts the control thread. Steps late by more than `threshold_ns` count (1 ms is a frame's length). It runs at the normal
    /// priority unless `priority` asks for SCHED_FIFO, as the frame path does: a thread of lower rank would take the frame
    /// path's own work for a standstill.
    pub fn start(clock: Arc<dyn Clock>, threshold_ns: i64, priority: u32) -> std::io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let seen = stop.clone();
        let thread = std::thread::Builder::new().name("standstill".into()).spawn(move || {
            // A refusal was already reported by the frame path, which asks for the same.
            let _ = super::enter_frame_path(super::ThreadRights { priority, core: None });
            let mut standstills = Standstills { gaps: Vec::with_capacity(KEPT), not_kept: 0 };
            // Relaxed: a flag that guards no data.
            while !seen.load(Ordering::Relaxed) {
                let due = clock.now().plus_ns(STEP_NS);
                let woke = clock.wait_until(due);
                standstills.note(due, woke, threshold_ns);
            }
            standstills
        })?;
        Ok(Self { stop, thread: Some(thread) })
    }

    /// Ends the thread (within a step) and returns what it saw.
    pub fn finish(mut self) -> Standstills {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().and_then(|t| t.join().ok()).unwrap_or_default()
    }
}

impl Drop for StandstillMonitor {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::MonotonicClock;
    use std::sync::atomic::AtomicI64;

    /// A clock on which every hundredth wait takes 30 ms longer.
    #[derive(Debug, Default)]
    struct StallingClock {
        now: AtomicI64,
        waits: AtomicI64,
    }

    impl Clock for StallingClock {
        fn now(&self) -> HostTime {
            HostTime(self.now.load(Ordering::SeqCst))
        }
        fn wait_until(&self, at: HostTime) -> HostTime {
            let stall =
                if self.waits.fetch_add(1, Ordering::SeqCst) % 100 == 99 { 30_000_000 } else { 60_000 };
            self.now.store(at.0 + stall, Ordering::SeqCst);
            std::thread::yield_now();
            HostTime(at.0 + stall)
        }
    }

    #[test]
    fn stalls_are_found_and_small_delays_are_not() {
        let clock = Arc::new(StallingClock::default());
        let monitor = StandstillMonitor::start(clock.clone(), 1_000_000, 0).unwrap();
        while clock.waits.load(Ordering::SeqCst) < 350 {
            std::thread::yield_now();
        }
        let seen = monitor.finish();
        let expected = clock.waits.load(Ordering::SeqCst) / 100;
        assert_eq!(seen.gaps().len() as i64, expected);
        assert_eq!((seen.total_ns(), seen.longest_ns()), (expected * 30_000_000, 30_000_000));
        let gap = seen.gaps()[1];
        assert!(seen.touches(gap.from, gap.from) && seen.touches(gap.to, gap.to.plus_ns(1)));
        assert!(seen.touches(gap.from.plus_ns(-5), gap.to.plus_ns(5)));
        assert!(!seen.touches(gap.to.plus_ns(1), gap.to.plus_ns(2)));
        assert!(!seen.touches(gap.from.plus_ns(-2), gap.from.plus_ns(-1)));
    }

    #[test]
    fn on_the_real_clock_it_runs_and_ends() {
        let monitor = StandstillMonitor::start(Arc::new(MonotonicClock::new(0)), 1_000_000, 0).unwrap();
        std::thread::sleep(std::time::Duration::from_millis(10));
        let seen = monitor.finish();
        assert!(seen.total_ns() < 10_000_000_000);
        assert!(seen.gaps().windows(2).all(|w| w[0].to <= w[1].from));
    }
}
