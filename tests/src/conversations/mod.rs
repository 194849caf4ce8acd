//! Conversations: arbitrary bytes to one end of a protocol whose other end is in a state. The bytes become messages
//! with the session, the stamps and the checksums that a fuzzer would not guess, so that the code behind these is
//! reached; what a conversation patches in stands at its head.

pub mod gaze;
pub mod link;
pub mod sensor;
pub mod trackers;
pub mod usb;

use dpm_device::time::{HostClock, HostTime};
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::Arc;

/// The steps of a script: what to do, how, how long after the step before, and bytes. Five bytes and as many more as
/// the last two say, up to 2047.
struct Script<'a>(&'a [u8]);

struct Step<'a> {
    what: u8,
    how: u8,
    /// Up to 6.5 s, most of them short.
    wait_ns: i64,
    bytes: &'a [u8],
}

impl<'a> Iterator for Script<'a> {
    type Item = Step<'a>;

    fn next(&mut self) -> Option<Step<'a>> {
        let (&[what, how, wait, low, high], rest) = self.0.split_first_chunk::<5>()?;
        let n = usize::from(u16::from_le_bytes([low, high & 7]));
        let (bytes, rest) = rest.split_at(n.min(rest.len()));
        self.0 = rest;
        Some(Step { what, how, wait_ns: i64::from(wait) * i64::from(wait) * 100_000, bytes })
    }
}

/// A step as bytes.
fn step(what: u8, how: u8, wait: u8, bytes: &[u8]) -> Vec<u8> {
    let [low, high] = (bytes.len().min(2047) as u16).to_le_bytes();
    [&[what, how, wait, low, high][..], &bytes[..bytes.len().min(2047)]].concat()
}

/// A clock that stands until it is moved.
#[derive(Default)]
struct Moved(AtomicI64);

impl Moved {
    fn at(now: i64) -> Arc<Self> {
        Arc::new(Self(AtomicI64::new(now)))
    }

    fn forward(&self, ns: i64) -> HostTime {
        HostTime(self.0.fetch_add(ns, Ordering::Relaxed) + ns)
    }
}

impl HostClock for Moved {
    fn now(&self) -> HostTime {
        HostTime(self.0.load(Ordering::Relaxed))
    }
}

/// Conversations as scripts of the entries, with the target and a name of each: what real ends say to each other, or
/// what leads through the states of one end. `tests/tests/laws/corpora.rs` writes them down as seeds.
pub fn recorded() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    [trackers::recorded(), usb::recorded(), link::recorded(), sensor::recorded()].concat()
}

/// `N` bytes from the front of `bytes`, zeros where it has no more.
fn taken<const N: usize>(bytes: &mut &[u8]) -> [u8; N] {
    let (head, rest) = bytes.split_at(N.min(bytes.len()));
    *bytes = rest;
    let mut out = [0; N];
    out[..head.len()].copy_from_slice(head);
    out
}
