//! A bounded ring between threads that can be closed and waited for. (Poses go through `dpm_handoff::latest` instead.)
//!
//! It stands on crossbeam's `ArrayQueue`: lock-free and without allocation, but not wait-free (a thread paused inside a push can make
//! the other back off for that long). What is handed over is recycled, never freed, on the frame path.

use crate::clock::Stopwatch;
use crossbeam::queue::ArrayQueue;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::OnceLock;
use std::thread::Thread;
use std::time::Duration;

/// A bounded first-in first-out hand-off between threads.
pub struct Ring<T> {
    queue: ArrayQueue<T>,
    consumer: OnceLock<Thread>,
    closed: AtomicBool,
}

impl<T> Ring<T> {
    /// Room for `capacity` items, at least 1.
    pub fn new(capacity: usize) -> Self {
        Self {
            queue: ArrayQueue::new(capacity.max(1)),
            consumer: OnceLock::new(),
            closed: AtomicBool::new(false),
        }
    }

    /// Hands `item` over and wakes the consumer; gives it back when the ring is full.
    ///
    /// # Errors
    /// The item, when there is no room.
    pub fn push(&self, item: T) -> Result<(), T> {
        let result = self.queue.push(item);
        self.wake();
        result
    }

    /// The oldest item, if there is one.
    pub fn try_pop(&self) -> Option<T> {
        self.queue.pop()
    }

    /// The oldest item; waits at most `limit`. `None` when it ran out or when the ring is closed and empty. The first thread that
    /// waits is the one that is woken.
    pub fn pop(&self, limit: Duration) -> Option<T> {
        self.consumer.get_or_init(std::thread::current);
        for _ in 0..64 {
            if let Some(item) = self.queue.pop() {
                return Some(item);
            }
            std::hint::spin_loop();
        }
        let watch = Stopwatch::start();
        loop {
            if let Some(item) = self.queue.pop() {
                return Some(item);
            }
            if self.is_closed() {
                // An item pushed just before the close must not be lost.
                return self.queue.pop();
            }
            let left = limit.saturating_sub(Duration::from_nanos(watch.elapsed_ns()));
            if left.is_zero() {
                return None;
            }
            // A wake-up between the look above and here is not lost: the token makes the park return at once.
            std::thread::park_timeout(left);
        }
    }

    /// No more items will come. What is inside can still be taken.
    pub fn close(&self) {
        self.closed.store(true, Ordering::Release);
        self.wake();
    }

    /// True after [`Ring::close`].
    pub fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }

    /// Items inside.
    pub fn len(&self) -> usize {
        self.queue.len()
    }

    /// Nothing inside.
    pub fn is_empty(&self) -> bool {
        self.queue.is_empty()
    }

    fn wake(&self) {
        if let Some(thread) = self.consumer.get() {
            thread.unpark();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    #[test]
    fn a_ring_keeps_order_and_loses_nothing_at_the_close() {
        let ring = Arc::new(Ring::new(4));
        let other = ring.clone();
        let consumer = std::thread::spawn(move || {
            let mut got = Vec::new();
            while let Some(v) = other.pop(Duration::from_secs(5)) {
                got.push(v);
            }
            got
        });
        for mut v in 0..10_000u32 {
            while let Err(back) = ring.push(v) {
                v = back;
                std::thread::yield_now();
            }
        }
        ring.close();
        assert_eq!(consumer.join().unwrap(), (0..10_000).collect::<Vec<_>>());
    }
}
