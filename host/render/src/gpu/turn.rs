//! Whose turn it is to submit: Vulkan wants one thread at a time at a queue.
//!
//! In a rig one thread submits, so the turn is always free, and to take it is one exchange of an atomic. It is no
//! mutex: nobody sleeps in the kernel for it or is woken by its end, and a thread that hangs in the driver with its
//! turn holds up no other one for longer than that one wants to wait.
//!
//! The queue cannot belong to the renderer of a crew for good. A crew that hangs is abandoned with its renderer, and
//! the next crew works with the same device as long as the device is not the cause.

use std::sync::atomic::{AtomicBool, Ordering};

/// One thread's turn after the other.
#[derive(Debug, Default)]
pub(super) struct Turn {
    taken: AtomicBool,
}

impl Turn {
    /// Takes the turn if it is free. It ends when the result is dropped.
    pub(super) fn take(&self) -> Option<HeldTurn<'_>> {
        // What the thread before did to the queue happened before this.
        let was_taken = self.taken.swap(true, Ordering::Acquire);
        // Not `then_some`: a value that is made and not returned would end the turn of the other thread.
        (!was_taken).then(|| HeldTurn(self))
    }
}

/// A turn that was taken.
#[derive(Debug)]
pub(super) struct HeldTurn<'a>(&'a Turn);

impl Drop for HeldTurn<'_> {
    fn drop(&mut self) {
        self.0.taken.store(false, Ordering::Release);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicU64;

    #[test]
    fn a_turn_is_one_threads_until_it_ends_also_in_a_panic() {
        let turn = Turn::default();
        let held = turn.take();
        assert!(held.is_some() && turn.take().is_none() && turn.take().is_none());
        drop(held);
        let panicked = std::panic::catch_unwind(|| {
            let _held = turn.take().expect("free again");
            panic!("with the turn")
        });
        assert!(panicked.is_err() && turn.take().is_some());
    }

    #[test]
    fn threads_exclude_each_other() {
        let (turn, inside, turns) = (Turn::default(), AtomicU64::new(0), AtomicU64::new(0));
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    let mut had = 0;
                    while had < 5_000 {
                        let Some(_held) = turn.take() else {
                            // The thread that has it may wait for this processor.
                            std::thread::yield_now();
                            continue;
                        };
                        had += 1;
                        assert_eq!(inside.fetch_add(1, Ordering::Relaxed), 0);
                        inside.fetch_sub(1, Ordering::Relaxed);
                        turns.fetch_add(1, Ordering::Relaxed);
                    }
                });
            }
        });
        assert_eq!(turns.into_inner(), 20_000);
    }
}
