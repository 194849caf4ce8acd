//! Lets a thread wait for a hand-off: bounded spinning first if the machine has cores to spare, then parking, never
//! longer than a deadline.
//!
//! The waker pays one fence and one load if no thread is parked. The condition is a closure that checks the hand-off
//! itself, so a wake-up is only a hint, and a spurious one is harmless.

use crate::sync::{fence, thread, Arc, AtomicBool, Ordering, WaitingThread};
use crossbeam::utils::Backoff;
#[cfg(not(loom))]
use std::time::Duration;

/// Checks between two readings of the clock. The pauses between them double from one to eight: with longer ones the
/// waiting thread would notice late, and no other thread contends with it.
const LOOKS: u32 = 4;

/// How a stage waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WaitPolicy {
    /// Park at once: for machines with fewer cores than runnable threads.
    Park,
    /// Spin for this many nanoseconds, then park.
    SpinThenPark {
        /// Nanoseconds of spinning.
        spin_ns: i64,
    },
}

impl WaitPolicy {
    /// The policy for `stages` waiting threads on `cores` usable cores. Spinning only pays if every spinning stage has
    /// its own core and one is left for everything else. Otherwise it delays the very thread that it waits for, and the
    /// kernel throttles a spinning real-time thread on a shared core.
    pub const fn for_machine(cores: usize, stages: usize) -> Self {
        if cores > stages && cores > 2 {
            Self::SpinThenPark { spin_ns: 200_000 }
        } else {
            Self::Park
        }
    }
}

#[derive(Debug)]
struct WakeState {
    /// The waiting thread is about to park or has parked.
    parked: AtomicBool,
    /// The waiting thread: the first one that waited.
    thread: WaitingThread,
}

/// Wakes one waiting thread. Any number of clones.
#[derive(Clone, Debug)]
pub struct Waker {
    shared: Arc<WakeState>,
}

/// The waiting side. It may be made anywhere and moved to the waiting thread; from its first wait on it belongs to that
/// thread.
#[derive(Debug)]
pub struct Waiter {
    shared: Arc<WakeState>,
    policy: WaitPolicy,
    /// Only one thread waits: this is not shared between several.
    _not_sync: std::marker::PhantomData<std::cell::Cell<()>>,
}

impl Waiter {
    /// A new waiter; pass [`Waiter::waker`] to the producer.
    pub fn new(policy: WaitPolicy) -> Self {
        Self {
            shared: Arc::new(WakeState { parked: AtomicBool::new(false), thread: WaitingThread::new() }),
            policy,
            _not_sync: std::marker::PhantomData,
        }
    }

    /// A waker for the waiting thread.
    pub fn waker(&self) -> Waker {
        Waker { shared: self.shared.clone() }
    }

    /// Waits until `ready` returns true or the clock `now_ns` reaches `deadline_ns`; returns the last result of
    /// `ready`. `ready` is called at least once, even if the deadline has passed. A thread other than the first one
    /// that waited is woken only by its deadline.
    pub fn wait(
        &self,
        deadline_ns: i64,
        mut now_ns: impl FnMut() -> i64,
        mut ready: impl FnMut() -> bool,
    ) -> bool {
        if ready() {
            return true;
        }
        if let WaitPolicy::SpinThenPark { spin_ns } = self.policy {
            let until = now_ns().saturating_add(spin_ns).min(deadline_ns);
            loop {
                // Reading the clock costs as much as many checks, so it is read once in [`LOOKS`].
                let backoff = Backoff::new();
                for _ in 0..LOOKS {
                    if ready() {
                        return true;
                    }
                    backoff.spin();
                }
                if now_ns() >= until {
                    break;
                }
            }
        }
        self.shared.thread.set_to_this();
        loop {
            let left_ns = deadline_ns.saturating_sub(now_ns());
            if left_ns <= 0 {
                return ready();
            }
            // Relaxed: the fence orders it. Announce before the check; the waker publishes before it checks for the
            // announcement. The two fences are in one total order, so at least one of the two sees what the other did
            // before its fence, and no wake-up is lost (Dekker). That holds for the waiting thread as for the flag.
            self.shared.parked.store(true, Ordering::Relaxed);
            fence(Ordering::SeqCst);
            if ready() {
                self.shared.parked.store(false, Ordering::Relaxed);
                return true;
            }
            #[cfg(not(loom))]
            thread::park_timeout(Duration::from_nanos(left_ns.unsigned_abs()));
            // The model checker has no time: there a lost wake-up is a deadlock, which it reports.
            #[cfg(loom)]
            thread::park();
            self.shared.parked.store(false, Ordering::Relaxed);
            if ready() {
                return true;
            }
        }
    }
}

impl Waker {
    /// Call after publishing. Makes a system call only when the thread is parked.
    pub fn wake(&self) {
        // Pairs with the fence in `wait`.
        fence(Ordering::SeqCst);
        // Only the waiter writes the flag: a stale true costs a needless unpark, which makes no system call unless the
        // thread sleeps. Relaxed: the fence orders it, see `wait`; `unpark` and `park` synchronise the rest themselves.
        if self.shared.parked.load(Ordering::Relaxed) {
            if let Some(thread) = self.shared.thread.get() {
                thread.unpark();
            }
        }
    }
}

#[cfg(all(test, not(loom)))]
mod tests {
    use super::*;
    use crate::ring::ring;
    use std::time::Instant;

    fn clock() -> impl Fn() -> i64 {
        let start = Instant::now();
        move || start.elapsed().as_nanos() as i64
    }

    #[test]
    fn a_deadline_is_kept_and_ready_is_asked_once_more() {
        for policy in [WaitPolicy::Park, WaitPolicy::SpinThenPark { spin_ns: 100_000 }] {
            let waiter = Waiter::new(policy);
            let now = clock();
            assert!(!waiter.wait(2_000_000, &now, || false));
            assert!(now() >= 2_000_000);
            assert!(waiter.wait(-5, &now, || true));
            let mut asked = 0;
            assert!(!waiter.wait(-5, &now, || {
                asked += 1;
                false
            }));
            assert!(asked >= 1);
        }
    }

    #[test]
    fn every_value_arrives_without_a_timeout() {
        for policy in [WaitPolicy::Park, WaitPolicy::SpinThenPark { spin_ns: 2_000 }] {
            let (mut producer, mut consumer) = ring::<u32>(1);
            let n = if cfg!(miri) { 50 } else { 2_000 };
            let waiter = Waiter::new(policy);
            let waker = waiter.waker();
            let writer = std::thread::spawn(move || {
                for i in 0..n {
                    while producer.push(i).is_err() {
                        std::thread::yield_now();
                    }
                    waker.wake();
                }
            });
            let now = clock();
            for i in 0..n {
                // A lost wake-up would hang here for a minute.
                let start = now();
                assert!(waiter.wait(start + 60_000_000_000, &now, || !consumer.is_empty()));
                assert!(now() - start < 30_000_000_000, "woken by the deadline only");
                assert_eq!(consumer.pop(), Some(i));
            }
            writer.join().unwrap();
        }
    }

    #[test]
    fn spinning_needs_a_core_for_each_stage() {
        assert_eq!(WaitPolicy::for_machine(1, 1), WaitPolicy::Park);
        assert_eq!(WaitPolicy::for_machine(2, 1), WaitPolicy::Park);
        assert_eq!(WaitPolicy::for_machine(5, 5), WaitPolicy::Park);
        assert_ne!(WaitPolicy::for_machine(6, 5), WaitPolicy::Park);
    }
}

#[cfg(all(test, loom))]
mod loom_tests {
    use super::*;
    use crate::latest::latest;

    /// Without either fence, loom finds the schedule in which both sides miss each other and the waiter sleeps for
    /// ever.
    #[test]
    fn loom_no_wakeup_is_lost() {
        loom::model(|| {
            let (mut publisher, mut reader) = latest(0u32);
            let waiter = Waiter::new(WaitPolicy::Park);
            let waker = waiter.waker();
            // Not joined: loom mistakes a late `unpark` for the end of the join.
            loom::thread::spawn(move || {
                publisher.publish(1);
                waker.wake();
            });
            assert!(waiter.wait(i64::MAX, || 0, || reader.latest().1));
            assert_eq!(reader.latest().0, &1);
        });
    }
}
