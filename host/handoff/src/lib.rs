//! Values from one thread to another without locks, allocation or unbounded waiting.
//!
//! - [`latest`]: the newest value wins (poses). Wait-free on both sides.
//! - [`ring`]: every value in order, bounded (frames, events); [`ring::exchange`] recycles buffers.
//! - [`wake`]: waiting for either, spinning and then parking, always with a deadline.
//! - [`channel`]: a ring whose consumer can wait for the next value, and that ends when its producer does.
//!
//! A crate of its own so that the model checker builds in seconds:
//! `RUSTFLAGS="--cfg loom" cargo test -p dpm-handoff --lib --target-dir target/loom loom_`
//! runs every interleaving (and every reordering that the memory model allows) of the tests named `loom_*`. The cells report
//! unsynchronised access there, so weakening any ordering of the slot or the ring fails a test.

pub mod channel;
pub mod latest;
pub mod ring;
mod sync;
pub mod wake;
