//! Passes values from one thread to another without locks, allocation or unbounded waiting.
//!
//! - [`latest`]: the newest value wins (poses). Wait-free on both sides.
//! - [`ring`]: every value in order, bounded (frames, events); [`ring::exchange`] recycles buffers.
//! - [`wake`]: waiting for either, spinning and then parking, always with a deadline.
//! - [`channel`]: a ring whose consumer can wait for the next value, and that ends when its producer does.
//! - [`path`]: which thread works on frames, and whose code it runs.
//!
//! # Example
//!
//! ```
//! use dpm_handoff::{channel::channel, latest::latest, wake::WaitPolicy};
//!
//! // Poses: only the newest counts.
//! let (mut publisher, mut reader) = latest(0);
//! publisher.publish(1);
//! publisher.publish(2);
//! assert_eq!(reader.latest(), (&2, true));
//! assert_eq!(reader.latest(), (&2, false), "the same again, and nothing new");
//!
//! // Frames: every one counts, in order, up to the end of the thread that makes them.
//! let (mut to_link, mut frames) = channel(4, WaitPolicy::Park);
//! let renderer = std::thread::spawn(move || (0..3).for_each(|frame| to_link.push(frame).expect("room for four")));
//! let begin = std::time::Instant::now();
//! let now_ns = || begin.elapsed().as_nanos() as i64;
//! let mut lit = Vec::new();
//! while !frames.is_finished() {
//!     // Waits for 10 ms at most, and not at all once the sender is gone.
//!     lit.extend(frames.pop(now_ns() + 10_000_000, now_ns));
//! }
//! renderer.join().expect("it ended in order");
//! assert_eq!(lit, [0, 1, 2]);
//! ```
//!
//! This is a separate crate, so that the model checker builds in seconds:
//! `RUSTFLAGS="--cfg loom" cargo test -p dpm-handoff --lib --target-dir target/loom loom_` runs every interleaving (and
//! every reordering that the memory model allows) of the tests named `loom_*`. The cells report unsynchronised access
//! there. `tests/mutations/orderings` weakens every ordering, one by one, and sees that a test fails.

pub mod channel;
pub mod latest;
pub mod path;
pub mod ring;
mod sync;
pub mod wake;
