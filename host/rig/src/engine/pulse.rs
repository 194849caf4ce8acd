//! Heartbeats: every thread of a run announces by when it will report again, and the supervisor checks that it does.

use dpm_common::realtime::os::Standing;
use dpm_device::time::HostTime;
use std::sync::atomic::{AtomicI32, AtomicI64, Ordering};

/// A thread counts as hung when it has been silent for this long beyond its announcement, nanoseconds.
pub(crate) const HUNG_AFTER_NS: i64 = 100_000_000;
/// The longest step of the supervisor that counts as observed silence. When the machine itself stood still, all
/// threads did.
const LONGEST_STEP_NS: i64 = 10_000_000;

/// The heartbeat of one thread. A beat is one relaxed store.
#[derive(Debug)]
pub(crate) struct Pulse {
    /// Name of the thread.
    name: &'static str,
    /// By when it will beat again; `i64::MAX` before it began and after it ended.
    until_ns: AtomicI64,
    /// Its thread id in the operating system; 0 before it began.
    thread: AtomicI32,
}

impl Pulse {
    /// For a thread that has not begun yet.
    pub(crate) const fn new(name: &'static str) -> Self {
        Self { name, until_ns: AtomicI64::new(i64::MAX), thread: AtomicI32::new(0) }
    }

    /// Name of the thread.
    pub(crate) fn name(&self) -> &'static str {
        self.name
    }

    /// The thread with this id of the operating system has begun.
    pub(crate) fn begin(&self, thread: i32) {
        self.thread.store(thread, Ordering::Relaxed);
    }

    /// The thread's id in the operating system; 0 before it began.
    pub(crate) fn thread(&self) -> i32 {
        self.thread.load(Ordering::Relaxed)
    }

    /// The thread is alive and will beat again within `expected_ns`.
    pub(crate) fn beat(&self, now: HostTime, expected_ns: i64) {
        self.until_ns.store(now.0.saturating_add(expected_ns), Ordering::Relaxed);
    }

    /// The thread has ended normally; no further beat is expected.
    pub(crate) fn end(&self) {
        self.until_ns.store(i64::MAX, Ordering::Relaxed);
    }

    /// True when a beat is overdue.
    pub(crate) fn is_overdue(&self, now: HostTime) -> bool {
        self.until_ns.load(Ordering::Relaxed) < now.0
    }
}

/// Looks up what a thread is doing by its id; `None` if that is not known.
pub(crate) type StandingOf = fn(i32) -> Option<Standing>;

/// The supervisor's view of one thread: how long it has been silent beyond its announcement. Time in which the thread
/// was ready to run but got no core does not count, nor that of a worker which it may wait for: what starves is late, not
/// hung. A thread in an endless loop counts as silent.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Silence {
    silent_ns: i64,
    before: Option<Standing>,
}

impl Silence {
    /// Checks `pulse` at `now`, `step_ns` after the last check; for `starved_ns` of it a worker that the thread may wait for
    /// got no core. True when the thread is hung.
    pub(crate) fn observe(
        &mut self,
        pulse: &Pulse,
        now: HostTime,
        step_ns: i64,
        ask: StandingOf,
        starved_ns: i64,
    ) -> bool {
        let overdue = pulse.is_overdue(now);
        // Only overdue threads are looked up.
        let standing = if overdue { ask(pulse.thread()) } else { None };
        self.step(overdue, step_ns, standing, starved_ns)
    }

    /// For how long it has been silent, nanoseconds.
    pub(crate) fn silent_ns(&self) -> i64 {
        self.silent_ns
    }

    fn step(&mut self, overdue: bool, step_ns: i64, standing: Option<Standing>, starved_ns: i64) -> bool {
        if !overdue {
            *self = Self::default();
            return false;
        }
        let step_ns = step_ns.clamp(0, LONGEST_STEP_NS);
        let own_ns = match (standing, self.before) {
            (Some(now), before) => now.starved_ns(before, step_ns),
            _ => 0,
        };
        self.silent_ns += step_ns - own_ns.max(starved_ns).clamp(0, step_ns);
        self.before = standing;
        self.silent_ns > HUNG_AFTER_NS
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn standing(ready: bool, ran_ns: i64, waited_ns: i64) -> Standing {
        Standing { ready, ran_ns, waited_ns }
    }

    /// Steps until the thread counts as hung, at most 1000.
    fn steps(mut each: impl FnMut(&mut Silence) -> bool) -> Option<usize> {
        let mut silence = Silence::default();
        (1..=1000).find(|_| each(&mut silence))
    }

    #[test]
    fn a_thread_is_hung_after_a_tenth_of_a_second_beyond_what_it_announced() {
        assert_eq!(steps(|s| s.step(true, 2 * MS, None, 0)), Some(51));
        let asleep = standing(false, 7, 0);
        assert_eq!(steps(|s| s.step(true, 2 * MS, Some(asleep), 0)), Some(51));
        assert_eq!(steps(|s| s.step(false, 2 * MS, None, 0)), None);
    }

    #[test]
    fn a_machine_that_stood_still_and_a_thread_without_a_core_are_not_hung_threads() {
        let mut silence = Silence::default();
        assert!(!silence.step(true, 60_000 * MS, None, 0), "the supervisor itself was away for a minute");
        assert_eq!(silence.silent_ns, LONGEST_STEP_NS);
        let starving = steps(|s| s.step(true, 2 * MS, Some(standing(true, 5, 0)), 0));
        assert_eq!(starving, None);
        // A thread in an endless loop is silent, too.
        let mut ran_ns = 0;
        let circling = steps(|s| {
            ran_ns += 2 * MS;
            s.step(true, 2 * MS, Some(standing(true, ran_ns, 0)), 0)
        });
        assert_eq!(circling, Some(52));
    }

    /// Found in use, R9: a stage slept while the workers of software Vulkan, for which it waited, got no core.
    #[test]
    fn a_thread_that_waits_for_starved_workers_is_not_hung_and_one_beside_them_is_later() {
        let asleep = || Some(standing(false, 7, 0));
        assert_eq!(steps(|s| s.step(true, 2 * MS, asleep(), 2 * MS)), None);
        assert_eq!(steps(|s| s.step(true, 2 * MS, asleep(), MS)), Some(101));
        // A thread that got a core between two looks tells by the kernel's count that it had waited.
        let mut waited_ns = 0;
        let late = steps(|s| {
            waited_ns += 3 * MS / 2;
            s.step(true, 2 * MS, Some(standing(false, 0, waited_ns)), 0)
        });
        assert!(late.is_some_and(|late| (198..=202).contains(&late)), "{late:?}");
    }

    #[test]
    fn a_beat_in_between_begins_anew() {
        let mut n = 0;
        let now_and_then = steps(|s| {
            n += 1;
            s.step(n % 40 != 0, 2 * MS, None, 0)
        });
        assert_eq!(now_and_then, None);
    }

    #[test]
    fn a_pulse_is_overdue_only_after_what_it_announced() {
        let pulse = Pulse::new("plan");
        assert!(!pulse.is_overdue(HostTime(i64::MAX - 1)), "not begun");
        pulse.begin(1);
        pulse.beat(HostTime(100), 50);
        assert!(!pulse.is_overdue(HostTime(150)) && pulse.is_overdue(HostTime(151)));
        pulse.end();
        assert!(!pulse.is_overdue(HostTime(i64::MAX - 1)));
        assert_eq!(pulse.name(), "plan");
    }
}
