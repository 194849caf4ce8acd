//! Detects when the machine itself stood still, with control threads that only sleep and read the clock.
//!
//! On a shared or virtual machine a core may stop for milliseconds through no fault of the program. Frames that were
//! late in such an interval are reported separately. A control thread sleeps in short steps. A step that exceeds its
//! length by more than a threshold is a gap.
//!
//! There is one control thread on every core, with a rank above all stages. Only the kernel and what is below it can
//! keep such a thread from running. A gap is therefore never the program's own work, and a core that stands still is
//! detected while the others run. If that rank is refused, there is one thread on whichever core is free. It detects
//! less, and does not excuse a stage that only waited for another one.

use super::os;
use crate::clock::Clock;
use dpm_device::time::HostTime;
use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

/// Sleep time of one step.
const STEP_NS: i64 = 500_000;

/// Number of newest gaps that are kept; older ones are only counted. It is half an hour at five per second.
const KEPT: usize = 1 << 13;

/// Number of gaps that one control thread can hold until it may record them.
const WAITING: usize = 64;

/// An interval in which the control thread should have run but did not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gap {
    /// When it should have run.
    pub from: HostTime,
    /// When it ran.
    pub to: HostTime,
}

impl Gap {
    fn ns(self) -> i64 {
        self.to.ns_since(self.from)
    }
}

/// The gaps of a run: the newest ones individually, disjoint and in order, and the number and length of all. A gap
/// that several control threads saw at once counts once.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Standstills {
    /// At most [`KEPT`].
    gaps: VecDeque<Gap>,
    /// Gaps that are no longer kept.
    past: u64,
    past_ns: i64,
    past_longest_ns: i64,
    /// End of the last gap that is no longer kept. Everything before it is counted already.
    past_to: Option<HostTime>,
}

impl Standstills {
    /// Records a step that should have ended at `due` and ended at `woke`.
    pub fn note(&mut self, due: HostTime, woke: HostTime, threshold_ns: i64) {
        if woke.ns_since(due) <= threshold_ns {
            return;
        }
        let mut gap = Gap { from: self.past_to.map_or(due, |past| past.max(due)), to: woke };
        if gap.from >= gap.to {
            return;
        }
        // It ends about now, so it overlaps only the last gaps. Gaps from `first` to `after` are merged with it.
        let after = self.gaps.partition_point(|g| g.from <= gap.to);
        let first = self.gaps.partition_point(|g| g.to < gap.from).min(after);
        if first < after {
            gap.from = gap.from.min(self.gaps[first].from);
            gap.to = gap.to.max(self.gaps[after - 1].to);
            self.gaps.drain(first..after);
        }
        self.gaps.insert(first, gap);
        if self.gaps.len() > KEPT {
            if let Some(oldest) = self.gaps.pop_front() {
                self.past += 1;
                self.past_ns = self.past_ns.saturating_add(oldest.ns());
                self.past_longest_ns = self.past_longest_ns.max(oldest.ns());
                self.past_to = Some(oldest.to);
            }
        }
    }

    /// The newest gaps, in order.
    pub fn gaps(&self) -> impl Iterator<Item = Gap> + '_ {
        self.gaps.iter().copied()
    }

    /// Number of gaps of the whole run.
    pub fn count(&self) -> u64 {
        self.past + self.gaps.len() as u64
    }

    /// Total length of all gaps of the run, ns.
    pub fn total_ns(&self) -> i64 {
        self.gaps.iter().map(|g| g.ns()).fold(self.past_ns, i64::saturating_add)
    }

    /// Longest gap of the run, ns; 0 if there is none.
    pub fn longest_ns(&self) -> i64 {
        self.gaps.iter().map(|g| g.ns()).fold(self.past_longest_ns, i64::max)
    }

    /// True if the machine stood still at some instant of [`from`, `to`]; a frame in flight at that time is excused.
    /// For instants before the gaps that are kept it returns false.
    pub fn touches(&self, from: HostTime, to: HostTime) -> bool {
        // The first gap that ends at or after `from` is the only candidate that can begin early enough.
        let first = self.gaps.partition_point(|g| g.to < from);
        self.gaps.get(first).is_some_and(|g| g.from <= to)
    }

    /// True when the machine stood still throughout [`from`, `to`].
    pub fn covers(&self, from: HostTime, to: HostTime) -> bool {
        let first = self.gaps.partition_point(|g| g.to < to);
        self.gaps.get(first).is_some_and(|g| g.from <= from)
    }
}

/// What the control threads have seen so far, for threads that are not on the frame path.
#[derive(Debug)]
pub struct SeenStandstills {
    all: Mutex<Standstills>,
    /// Per control thread: when it last ran, with everything before that recorded.
    awake_at: Vec<AtomicI64>,
}

impl SeenStandstills {
    /// For `threads` control threads that have seen nothing yet.
    fn new(threads: usize) -> Self {
        Self { all: Mutex::default(), awake_at: (0..threads).map(|_| AtomicI64::new(i64::MIN)).collect() }
    }

    /// Known standstills, to which nothing is added.
    pub fn known(standstills: Standstills) -> Self {
        Self { all: Mutex::new(standstills), awake_at: Vec::new() }
    }

    /// Every standstill that began before this instant is known.
    pub fn through(&self) -> HostTime {
        HostTime(self.awake_at.iter().map(|at| at.load(Ordering::Acquire)).min().unwrap_or(i64::MAX))
    }

    /// Calls `look` with what is known. It must be short, because control threads cannot record anything meanwhile.
    pub fn with<R>(&self, look: impl FnOnce(&Standstills) -> R) -> R {
        look(&self.lock())
    }

    /// As if a control thread had reported it.
    pub fn note(&self, from: HostTime, to: HostTime) {
        self.lock().note(from, to, 0);
    }

    /// For one control thread, which has not run yet.
    pub fn asleep() -> Self {
        Self::new(1)
    }

    /// It ran at this instant.
    pub fn wake(&self, at: HostTime) {
        self.awake_at[0].store(at.0, Ordering::Release);
    }

    // The data of a thread that panicked is consistent, because it is written in one piece.
    fn lock(&self) -> MutexGuard<'_, Standstills> {
        self.all.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The running control threads.
#[derive(Debug)]
pub struct StandstillMonitor {
    stop: Arc<AtomicBool>,
    seen: Arc<SeenStandstills>,
    threads: Vec<JoinHandle<()>>,
}

impl StandstillMonitor {
    /// Starts the control threads. Steps that are late by more than `threshold_ns` count (1 ms is a frame's length).
    /// `above` is the highest SCHED_FIFO priority of the frame path, or 0 for the normal scheduler.
    ///
    /// # Errors
    /// The system cannot start a thread.
    pub fn start(clock: Arc<dyn Clock>, threshold_ns: i64, above: u32) -> std::io::Result<Self> {
        let priority = if (1..99).contains(&above) && Self::is_granted(above + 1)? { above + 1 } else { 0 };
        let cores: Vec<Option<u32>> =
            if priority > 0 { os::allowed_core_list().into_iter().map(Some).collect() } else { Vec::new() };
        let cores = if cores.is_empty() { vec![None] } else { cores };
        let seen = Arc::new(SeenStandstills::new(cores.len()));
        let mut monitor =
            Self { stop: Arc::new(AtomicBool::new(false)), seen: seen.clone(), threads: Vec::new() };
        for (i, core) in cores.into_iter().enumerate() {
            let (stop, clock, seen) = (monitor.stop.clone(), clock.clone(), seen.clone());
            let thread = std::thread::Builder::new().name("standstill".into()).spawn(move || {
                let _ = super::enter_frame_path(super::ThreadRights { priority, core });
                watch(clock.as_ref(), threshold_ns, &stop, &seen, i);
            })?;
            monitor.threads.push(thread);
        }
        Ok(monitor)
    }

    /// Whether a thread of this process may have that priority. It is tried on a separate thread, because the answer
    /// decides which control threads are started.
    fn is_granted(priority: u32) -> std::io::Result<bool> {
        let asked = std::thread::Builder::new().spawn(move || os::set_fifo_priority(priority).is_ok())?;
        Ok(asked.join().unwrap_or(false))
    }

    /// Number of control threads.
    #[cfg(test)]
    pub(crate) fn threads(&self) -> usize {
        self.threads.len()
    }

    /// What they see, updated as they run.
    pub fn seen(&self) -> Arc<SeenStandstills> {
        self.seen.clone()
    }

    /// Ends the threads (within one step) and returns what they saw.
    pub fn finish(mut self) -> Standstills {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
        self.seen.with(Standstills::clone)
    }
}

/// The loop of control thread `number`.
fn watch(clock: &dyn Clock, threshold_ns: i64, stop: &AtomicBool, seen: &SeenStandstills, number: usize) {
    let awake_at = &seen.awake_at[number];
    let mut waiting: Vec<Gap> = Vec::with_capacity(WAITING);
    // Relaxed: the flag guards no data.
    while !stop.load(Ordering::Relaxed) {
        let due = clock.now().plus_ns(STEP_NS);
        let woke = clock.wait_until(due);
        if woke.ns_since(due) > threshold_ns && waiting.len() < WAITING {
            waiting.push(Gap { from: due, to: woke });
        }
        // Never waits for a reader, which has a lower rank and may not run before this thread sleeps.
        if let (false, Ok(mut all)) = (waiting.is_empty(), seen.all.try_lock()) {
            waiting.drain(..).for_each(|gap| all.note(gap.from, gap.to, threshold_ns));
        }
        if waiting.is_empty() {
            awake_at.store(woke.0, Ordering::Release);
        }
    }
    let mut all = seen.lock();
    waiting.drain(..).for_each(|gap| all.note(gap.from, gap.to, threshold_ns));
    awake_at.store(i64::MAX, Ordering::Release);
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
        assert_eq!(seen.count() as i64, expected);
        assert_eq!((seen.total_ns(), seen.longest_ns()), (expected * 30_000_000, 30_000_000));
        let gap = seen.gaps().nth(1).unwrap();
        assert!(seen.touches(gap.from, gap.from) && seen.touches(gap.to, gap.to.plus_ns(1)));
        assert!(seen.touches(gap.from.plus_ns(-5), gap.to.plus_ns(5)));
        assert!(!seen.touches(gap.to.plus_ns(1), gap.to.plus_ns(2)));
        assert!(!seen.touches(gap.from.plus_ns(-2), gap.from.plus_ns(-1)));
    }

    #[test]
    fn what_any_core_saw_counts_once() {
        // As three control threads report them: each in its own order, interleaved with the others.
        let told = [(10, 20), (15, 30), (30, 31), (52, 55), (50, 60), (90, 95), (70, 80)];
        let mut all = Standstills::default();
        told.iter().for_each(|&(from, to)| all.note(HostTime(from), HostTime(to), 0));
        let gaps: Vec<(i64, i64)> = all.gaps().map(|g| (g.from.0, g.to.0)).collect();
        assert_eq!(gaps, [(10, 31), (50, 60), (70, 80), (90, 95)]);
        assert_eq!((all.count(), all.total_ns(), all.longest_ns()), (4, 46, 21));
        assert!(all.touches(HostTime(58), HostTime(59)) && !all.touches(HostTime(61), HostTime(69)));
        assert!(all.covers(HostTime(52), HostTime(60)) && !all.covers(HostTime(52), HostTime(61)));
        // A gap that spans several others replaces them.
        all.note(HostTime(40), HostTime(85), 0);
        assert_eq!((all.count(), all.total_ns(), all.longest_ns()), (3, 71, 45));
    }

    /// A week of five gaps per second, seen by two threads: memory stays constant, and number and length stay exact.
    #[test]
    fn a_week_of_gaps_is_counted_exactly_in_bounded_memory() {
        let mut all = Standstills::default();
        let seconds = 7 * 24 * 3600i64;
        for k in 0..5 * seconds {
            let from = HostTime(k * 200_000_000);
            // The second thread sees the end of the same gap. Every thousandth gap is longer.
            let length = if k % 1000 == 999 { 40_000_000 } else { 3_000_000 };
            all.note(from, from.plus_ns(length), 1_000_000);
            all.note(from.plus_ns(500_000), from.plus_ns(length + 500_000), 1_000_000);
        }
        let n = 5 * seconds as u64;
        assert_eq!(all.count(), n);
        assert_eq!(all.total_ns(), n as i64 * 3_500_000 + (n / 1000) as i64 * 37_000_000);
        assert_eq!(all.longest_ns(), 40_500_000);
        assert!(all.gaps.len() <= KEPT && all.gaps.capacity() <= 2 * (KEPT + 1));
    }

    #[test]
    fn what_is_known_reaches_as_far_as_the_sleepiest_thread() {
        assert_eq!(SeenStandstills::known(Standstills::default()).through(), HostTime(i64::MAX));
        let seen = SeenStandstills::new(2);
        assert_eq!(seen.through(), HostTime(i64::MIN));
        seen.awake_at[0].store(20, Ordering::Release);
        seen.awake_at[1].store(10, Ordering::Release);
        assert_eq!(seen.through(), HostTime(10));
    }

    /// A thread above the stages and below the control threads occupies one core for 20 ms. Runs only where such
    /// ranks are granted.
    #[cfg(target_os = "linux")]
    #[test]
    fn work_of_lower_rank_is_no_standstill() {
        let clock = Arc::new(MonotonicClock::new(0));
        let monitor = StandstillMonitor::start(clock, 5_000_000, 51).unwrap();
        if monitor.threads() != os::usable_cores() {
            // The right is refused here: there is one thread, without a rank.
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
        let gaps: Vec<Gap> = seen.gaps().collect();
        assert!(gaps.windows(2).all(|w| w[0].to <= w[1].from));
    }
}
