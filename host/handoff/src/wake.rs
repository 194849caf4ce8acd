//! A thread that waits for a hand-off: bounded spinning first if the machine has cores to spare, then parking, never longer than a deadline.
//!
//! The waker pays one fence and one load when nobody is parked. What is waited for is a closure that looks at the hand-off
//! itself, so a wake-up is only ever a hint and a spurious one is harmless.

use crate::sync::{fence, thread, Arc, AtomicBool, Ordering};
use crossbeam::utils::Backoff;
// Of the standard library under the model checker, too: it only hands over who waits, and what it promises is not in question.
use std::sync::OnceLock;
#[cfg(not(loom))]
use std::time::Duration;

/// Looks between two readings of the clock. The pauses between them double from one to eight: with longer ones the waiting thread would
/// notice late, and nobody contends with it.
const LOOKS: u32 = 4;

/// How a stage waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WaitPolicy {
    /// Park at once: for machines with fewer cores than threads that must run.
    Park,
    /// Look in a tight loop for this many nanoseconds, then park.
    SpinThenPark {
        /// Nanoseconds of spinning.
        spin_ns: i64,
    },
}

impl WaitPolicy {
    /// The policy for `stages` waiting threads on `cores` usable cores. Spinning only pays where every spinning stage has a core
    /// of its own and one is left for everything else: otherwise it delays the very thread it waits for, and a spinning
    /// real-time thread on a shared core runs into the kernel's throttling.
    pub const fn for_machine(cores: usize, stages: usize) -> Self {
        if cores > stages && cores > 2 {
            Self::SpinThenPark { spin_ns: 200_000 }
        } else {
            Self::Park
        }
    }
}

#[derive(Debug)]
struct Shared {
    /// The waiting thread is about to park or has parked.
    parked: AtomicBool,
    /// Who waits: the first thread that did.
    thread: OnceLock<thread::Thread>,
}

/// Wakes one waiting thread. Any number of clones.
#[derive(Clone, Debug)]
pub struct Waker {
    shared: Arc<Shared>,
}

/// The waiting side. May be made anywhere and moved to the thread that waits; from its first wait on it belongs there.
#[derive(Debug)]
pub struct Waiter {
    shared: Arc<Shared>,
    policy: WaitPolicy,
    /// One thread waits: not shared between several.
    _not_sync: std::marker::PhantomData<std::cell::Cell<()>>,
}

impl Waiter {
    /// A waiter that nobody uses yet; hand [`Waiter::waker`] to whoever feeds it.
    pub fn new(policy: WaitPolicy) -> Self {
        Self {
            shared: Arc::new(Shared { parked: AtomicBool::new(false), thread: OnceLock::new() }),
            policy,
            _not_sync: std::marker::PhantomData,
        }
    }

    /// A waker for the thread that waits.
    pub fn waker(&self) -> Waker {
        Waker { shared: self.shared.clone() }
    }

    /// Waits until `ready` says true or the clock `now_ns` reaches `deadline_ns`; returns what `ready` said last. `ready` is
    /// asked at least once, even when the deadline has passed. A thread other than the first one that waited is woken by its
    /// deadline only.
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
                // The clock costs as much as many looks: it is read once in [`LOOKS`].
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
        self.shared.thread.get_or_init(thread::current);
        loop {
            let left_ns = deadline_ns.saturating_sub(now_ns());
            if left_ns <= 0 {
                return ready();
            }
            // Release: whoever sees the announcement sees who waits.
            self.shared.parked.store(true, Ordering::Release);
            // Announce before looking; the waker publishes before it looks for the announcement. The two fences are in one
            // total order, so at least one of the two sees the other and no wake-up is lost (Dekker).
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
        // Only the waiter writes the flag: a true that is left standing costs a needless unpark, which is no system call unless
        // the thread sleeps. Acquire: see who waits; `unpark` and `park` synchronise the rest by themselves.
        if self.shared.parked.load(Ordering::Acquire) {
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
            let n = 2_000;
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

    /// Without either fence, loom finds the schedule in which both sides miss each other and the waiter sleeps for ever.
    #[test]
    fn loom_no_wakeup_is_lost() {
        loom::model(|| {
            let (mut publisher, mut reader) = latest(0u32);
            let waiter = Waiter::new(WaitPolicy::Park);
            let waker = waiter.waker();
            // Not joined: loom takes an `unpark` that comes late for the end of the join.
            loom::thread::spawn(move || {
                publisher.publish(1);
                waker.wake();
            });
            assert!(waiter.wait(i64::MAX, || 0, || reader.latest().1));
            assert_eq!(reader.latest().0, &1);
        });
    }
}
