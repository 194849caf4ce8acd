//! Threads that do nothing but sleep and look at the clock, into the intervals in which the machine itself stood still.
//!
//! On a shared or virtual machine a core may stop for milliseconds through no fault of the program. Frames that were
//! late in such an interval are reported apart. A control thread sleeps in short steps; a step that took longer than asked
//! by more than a threshold is a gap.
//!
//! There is one on every core, above all stages: nothing but the kernel and what is below it can keep it from running, so that a
//! gap is never the program's own work, and a core that stands still is found while the other ones run. Where that rank is refused
//! there is one thread on whatever core is free: it finds less, and excuses no stage that only waited for another.

use super::os;
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

    /// The union of what several control threads saw.
    fn merged(all: Vec<Self>) -> Self {
        let not_kept = all.iter().map(|s| s.not_kept).sum();
        let mut gaps: Vec<Gap> = all.into_iter().flat_map(|s| s.gaps).collect();
        gaps.sort_unstable_by_key(|g| g.from);
        gaps.dedup_by(|next, kept| {
            let overlap = next.from <= kept.to;
            if overlap {
                kept.to = kept.to.max(next.to);
            }
            overlap
        });
        Self { gaps, not_kept }
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

/// The running control threads.
#[derive(Debug)]
pub struct StandstillMonitor {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<Standstills>>,
}

impl StandstillMonitor {
    /// Starts the control threads. Steps late by more than `threshold_ns` count (1 ms is a frame's length). `above` is the highest
    /// SCHED_FIFO priority of the frame path, 0 for the normal scheduler.
    ///
    /// # Errors
    /// The system's, when it has no more threads.
    pub fn start(clock: Arc<dyn Clock>, threshold_ns: i64, above: u32) -> std::io::Result<Self> {
        let priority = if (1..99).contains(&above) && Self::is_granted(above + 1)? { above + 1 } else { 0 };
        let cores: Vec<Option<u32>> =
            if priority > 0 { os::allowed_core_list().into_iter().map(Some).collect() } else { Vec::new() };
        let mut monitor = Self { stop: Arc::new(AtomicBool::new(false)), threads: Vec::new() };
        for core in if cores.is_empty() { vec![None] } else { cores } {
            let (stop, clock) = (monitor.stop.clone(), clock.clone());
            let thread = std::thread::Builder::new().name("standstill".into()).spawn(move || {
                let _ = super::enter_frame_path(super::ThreadRights { priority, core });
                watch(clock.as_ref(), threshold_ns, &stop)
            })?;
            monitor.threads.push(thread);
        }
        Ok(monitor)
    }

    /// Whether a thread of this process may have that priority. Asked apart from the control threads: without it they are other ones.
    fn is_granted(priority: u32) -> std::io::Result<bool> {
        let asked = std::thread::Builder::new().spawn(move || os::set_fifo_priority(priority).is_ok())?;
        Ok(asked.join().unwrap_or(false))
    }

    /// Control threads that run.
    pub fn threads(&self) -> usize {
        self.threads.len()
    }

    /// Ends the threads (within a step) and returns what they saw.
    pub fn finish(mut self) -> Standstills {
        self.stop.store(true, Ordering::Relaxed);
        Standstills::merged(self.threads.drain(..).filter_map(|t| t.join().ok()).collect())
    }
}

/// A control thread's life.
fn watch(clock: &dyn Clock, threshold_ns: i64, stop: &AtomicBool) -> Standstills {
    let mut standstills = Standstills { gaps: Vec::with_capacity(KEPT), not_kept: 0 };
    // Relaxed: a flag that guards no data.
    while !stop.load(Ordering::Relaxed) {
        let due = clock.now().plus_ns(STEP_NS);
        let woke = clock.wait_until(due);
        standstills.note(due, woke, threshold_ns);
    }
    standstills
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
    fn what_any_core_saw_counts_once() {
        let seen = |gaps: &[(i64, i64)]| {
            let mut s = Standstills::default();
            gaps.iter().for_each(|&(from, to)| s.note(HostTime(from), HostTime(to), 0));
            s
        };
        let all = Standstills::merged(vec![
            seen(&[(10, 20), (50, 60), (90, 95)]),
            seen(&[(15, 30), (52, 55), (70, 80)]),
            seen(&[(30, 31)]),
        ]);
        let gaps: Vec<(i64, i64)> = all.gaps().iter().map(|g| (g.from.0, g.to.0)).collect();
        assert_eq!(gaps, [(10, 31), (50, 60), (70, 80), (90, 95)]);
        assert_eq!((all.total_ns(), all.longest_ns()), (46, 21));
        assert!(all.touches(HostTime(58), HostTime(59)) && !all.touches(HostTime(61), HostTime(69)));
    }

    /// A thread above the stages and below the control threads holds one core for 20 ms: only where there are such ranks.
    #[cfg(target_os = "linux")]
    #[test]
    fn work_of_lower_rank_is_no_standstill() {
        let clock = Arc::new(MonotonicClock::new(0));
        let monitor = StandstillMonitor::start(clock, 5_000_000, 51).unwrap();
        if monitor.threads() != os::usable_cores() {
            // The right is refused here: one thread, of no rank.
            assert_eq!(monitor.threads(), 1);
            return;
        }
        let busy = std::thread::spawn(|| {
            let core = os::allowed_core_list()[0];
            os::pin_to_core(core).unwrap();
            os::set_fifo_priority(51).unwrap();
            let begin = MonotonicClock::new(0);
            while begin.now().0 < 20_000_000 {
                std::hint::spin_loop();
            }
            begin.now().0
        });
        let worked_ns = busy.join().unwrap();
        let seen = monitor.finish();
        // The machine may really have stood still meanwhile, but not for as long as the work took.
        assert!(seen.longest_ns() < worked_ns / 2 || worked_ns > 40_000_000, "{seen:?}");
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
