//! Two threads and a hand-off into its cost on this machine: from publishing to having it in hand, one way.

use crate::clock::{Clock, MonotonicClock};
use dpm_device::time::{FrameRate, HostTime};
use dpm_handoff::latest::latest;
use dpm_handoff::wake::{WaitPolicy, Waiter};
use hdrhistogram::Histogram;
use std::sync::mpsc::sync_channel;

/// Publishes `frames` instants at `rate` from one thread and takes them on another that waits by `policy`; returns the delays in
/// nanoseconds. Values that a newer one overtook are not in it. Takes `frames / rate` seconds.
pub fn measure_handoff(policy: WaitPolicy, rate: FrameRate, frames: u64) -> std::io::Result<Histogram<u64>> {
    let clock = MonotonicClock::new(0);
    let (mut publisher, mut reader) = latest((HostTime(0), 0u64));
    let (give_waker, take_waker) = sync_channel(1);
    std::thread::scope(|scope| {
        let consumer = std::thread::Builder::new().name("handoff".into()).spawn_scoped(scope, move || {
            let waiter = Waiter::new(policy);
            // The other end lives until it has the waker: cannot fail.
            let _ = give_waker.send(waiter.waker());
            let mut delays =
                Histogram::new_with_bounds(1, 10_000_000_000, 3).expect("constant bounds are in range");
            let mut last = 0;
            while last < frames {
                let patience = clock.now().plus_ns(1_000_000_000);
                if !waiter.wait(patience.0, || clock.now().0, || reader.has_news()) {
                    break;
                }
                let (sent_at, number) = *reader.latest().0;
                delays.saturating_record(clock.now().ns_since(sent_at).max(1).unsigned_abs());
                last = number;
            }
            delays
        })?;
        if let Ok(waker) = take_waker.recv() {
            let start = clock.now();
            for number in 1..=frames {
                clock.wait_until(start.plus_ns(rate.slot_start_ns(number)));
                publisher.publish((clock.now(), number));
                waker.wake();
            }
        }
        consumer.join().map_err(|_| std::io::Error::other("the measuring thread panicked"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `cargo test -p dpm-host --lib handoff_cost -- --nocapture` prints the figures of docs/lab/LATENCY.md.
    #[test]
    fn every_value_or_a_newer_one_arrives() {
        let rate = FrameRate::new(947, 1).unwrap();
        for policy in [WaitPolicy::SpinThenPark { spin_ns: 2_000_000 }, WaitPolicy::Park] {
            let frames = 947;
            let delays = measure_handoff(policy, rate, frames).unwrap();
            let us = |q| delays.value_at_quantile(q) as f64 * 1e-3;
            println!(
                "{policy:?}: p50 {:.2} us, p99 {:.2} us, p99.9 {:.2} us, max {:.2} us",
                us(0.5),
                us(0.99),
                us(0.999),
                us(1.0)
            );
            assert!(delays.len() <= frames && delays.len() > frames / 10, "{} arrived", delays.len());
            // Far above either policy's cost and far below the deadline of a wait: wake-ups arrive, not time-outs.
            assert!(us(0.5) < 100_000.0);
        }
    }
}
