//! A bounded ring between two threads whose consumer can wait for the next value, and that ends when its producer does.
//!
//! [`crate::ring`] carries the values, and [`crate::wake`] implements the waiting. This module adds the end: dropping
//! the sender, also in a panic, closes the channel, so no consumer waits for a stage that is gone.

use crate::ring::{ring, Consumer, Producer};
use crate::sync::{Arc, AtomicBool, Ordering};
use crate::wake::{WaitPolicy, Waiter, Waker};

/// The producer's side. Dropping it closes the channel; the consumer can still take the values inside.
#[derive(Debug)]
pub struct Sender<T> {
    ring: Producer<T>,
    waker: Waker,
    closed: Arc<AtomicBool>,
}

/// The consumer's side.
#[derive(Debug)]
pub struct Receiver<T> {
    ring: Consumer<T>,
    waiter: Waiter,
    closed: Arc<AtomicBool>,
}

/// A channel for up to `capacity` values (at least 1) whose consumer waits according to `policy`. Allocates all its
/// memory here.
pub fn channel<T: Send>(capacity: usize, policy: WaitPolicy) -> (Sender<T>, Receiver<T>) {
    let (producer, consumer) = ring(capacity);
    let waiter = Waiter::new(policy);
    let closed = Arc::new(AtomicBool::new(false));
    (
        Sender { ring: producer, waker: waiter.waker(), closed: closed.clone() },
        Receiver { ring: consumer, waiter, closed },
    )
}

impl<T> Sender<T> {
    /// Sends `value` and wakes the consumer if it sleeps.
    ///
    /// # Errors
    /// The value, if there is no room.
    pub fn push(&mut self, value: T) -> Result<(), T> {
        self.ring.push(value)?;
        self.waker.wake();
        Ok(())
    }

    /// Upper bound of the number of values sent and not yet taken.
    pub fn len(&self) -> usize {
        self.ring.len()
    }

    /// True when every value sent has been taken.
    pub fn is_empty(&self) -> bool {
        self.ring.is_empty()
    }
}

impl<T> Drop for Sender<T> {
    fn drop(&mut self) {
        // Relaxed: a consumer that sees the end sees every value sent before it, because the wake-up of the last push
        // has a fence between the two. A push without a wake-up would need a release here.
        self.closed.store(true, Ordering::Relaxed);
        self.waker.wake();
    }
}

impl<T> Receiver<T> {
    /// Takes the oldest value, if there is one.
    pub fn try_pop(&mut self) -> Option<T> {
        self.ring.pop()
    }

    /// Takes the oldest value; waits for one until the clock `now_ns` reaches `deadline_ns` or the channel is closed.
    pub fn pop(&mut self, deadline_ns: i64, now_ns: impl FnMut() -> i64) -> Option<T> {
        let Self { ring, waiter, closed } = self;
        waiter.wait(deadline_ns, now_ns, || !ring.is_empty() || closed.load(Ordering::Acquire));
        ring.pop()
    }

    /// Lower bound of the number of waiting values.
    pub fn len(&self) -> usize {
        self.ring.len()
    }

    /// True when nothing waits.
    pub fn is_empty(&self) -> bool {
        self.ring.is_empty()
    }

    /// True when the sender is gone and no value is left: none will arrive any more.
    pub fn is_finished(&self) -> bool {
        // The order matters: the last value was sent before the end.
        self.closed.load(Ordering::Acquire) && self.ring.is_empty()
    }
}

#[cfg(all(test, not(loom)))]
mod tests {
    use super::*;
    use std::time::Instant;

    fn clock() -> impl Fn() -> i64 + Copy {
        let start = Instant::now();
        move || start.elapsed().as_nanos() as i64
    }

    const MINUTE_NS: i64 = 60_000_000_000;

    #[test]
    fn order_is_kept_and_nothing_is_lost_at_the_end() {
        let n = if cfg!(miri) { 100 } else { 10_000u32 };
        for policy in [WaitPolicy::Park, WaitPolicy::SpinThenPark { spin_ns: 5_000 }] {
            let (mut sender, mut receiver) = channel(4, policy);
            let now = clock();
            let consumer = std::thread::spawn(move || {
                let mut got = Vec::new();
                while let Some(v) = receiver.pop(now() + MINUTE_NS, now) {
                    got.push(v);
                }
                assert!(receiver.is_finished(), "ended by the sender's end, not by the clock");
                got
            });
            for mut v in 0..n {
                while let Err(back) = sender.push(v) {
                    v = back;
                    std::thread::yield_now();
                }
            }
            drop(sender);
            assert_eq!(consumer.join().unwrap(), (0..n).collect::<Vec<_>>());
            assert!(now() < MINUTE_NS, "woken by the deadline only");
        }
    }

    #[test]
    fn a_panic_of_the_sender_ends_the_wait() {
        let (sender, mut receiver) = channel::<u8>(1, WaitPolicy::Park);
        let now = clock();
        let producer = std::thread::spawn(move || {
            let _held = sender;
            std::panic::resume_unwind(Box::new("a stage's mistake"));
        });
        assert_eq!(receiver.pop(MINUTE_NS, now), None);
        assert!(receiver.is_finished() && now() < MINUTE_NS);
        assert!(producer.join().is_err());
    }

    #[test]
    fn a_full_channel_refuses_and_a_wait_ends_in_time() {
        let (mut sender, mut receiver) = channel(2, WaitPolicy::Park);
        assert_eq!((sender.push(1), sender.push(2), sender.push(3)), (Ok(()), Ok(()), Err(3)));
        assert_eq!((sender.len(), receiver.len()), (2, 2));
        assert_eq!((receiver.try_pop(), receiver.try_pop(), receiver.try_pop()), (Some(1), Some(2), None));
        let now = clock();
        assert_eq!(receiver.pop(2_000_000, now), None);
        assert!(now() >= 2_000_000 && !receiver.is_finished());
    }
}

#[cfg(all(test, loom))]
mod loom_tests {
    use super::*;

    /// The consumer sees the end after the last value, never before it, and the end stops a wait.
    #[test]
    fn loom_the_end_comes_after_the_last_value() {
        loom::model(|| {
            let (mut sender, mut receiver) = channel(2, WaitPolicy::Park);
            // Not joined: loom mistakes a late `unpark` for the end of the join.
            loom::thread::spawn(move || sender.push(1u32).unwrap());
            assert_eq!(receiver.pop(i64::MAX, || 0), Some(1));
            assert_eq!(receiver.pop(i64::MAX, || 0), None);
            assert!(receiver.is_finished());
        });
    }

    /// A consumer that has taken nothing yet does not take the end for the end of the values.
    #[test]
    fn loom_finished_means_that_nothing_is_left() {
        loom::model(|| {
            let (mut sender, receiver) = channel(1, WaitPolicy::Park);
            loom::thread::spawn(move || sender.push(1u32).unwrap());
            assert!(!receiver.is_finished(), "a value is left");
        });
    }
}
