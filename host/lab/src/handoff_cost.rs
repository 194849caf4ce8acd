//! Two threads and a hand-off into its cost on this machine: from handing a value over to having it in hand, one way.

use crossbeam::channel::bounded;
use crossbeam::queue::ArrayQueue;
use dpm_common::clock::{Clock, MonotonicClock};
use dpm_device::time::{FrameRate, HostTime};
use dpm_handoff::latest::latest;
use dpm_handoff::ring::ring;
use dpm_handoff::wake::{WaitPolicy, Waiter};
use hdrhistogram::Histogram;
use std::sync::Arc;
use std::time::Duration;

/// How a value gets from one thread to the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Handoff {
    /// The slot in which the newest value wins: poses.
    Latest,
    /// The ring of one producer and one consumer: frames.
    Ring,
    /// crossbeam's bounded queue with the same waiting.
    ArrayQueue,
    /// crossbeam's bounded channel with its own waiting, which no policy changes.
    Channel,
}

impl Handoff {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Latest, Self::Ring, Self::ArrayQueue, Self::Channel];
}

/// Values that may lie between the two threads.
const ROOM: usize = 16;
/// How long the consumer waits before it gives up.
const PATIENCE: Duration = Duration::from_secs(1);

/// An instant and its number, from 1.
type Value = (HostTime, u64);

/// Hands `frames` instants over at `rate` from one thread to another that waits by `policy`; returns the delays in nanoseconds. Values that
/// a newer one overtook, or that found no room, are not in it. Takes `frames / rate` seconds.
///
/// # Errors
/// The system refuses a thread.
pub fn measure_handoff(
    handoff: Handoff,
    policy: WaitPolicy,
    rate: FrameRate,
    frames: u64,
) -> std::io::Result<Histogram<u64>> {
    let waiter = Waiter::new(policy);
    let waker = waiter.waker();
    let clock = MonotonicClock::new(0);
    let wait = move |ready: &mut dyn FnMut() -> bool| {
        let patience = clock.now().plus_ns(PATIENCE.as_nanos() as i64);
        waiter.wait(patience.0, || clock.now().0, ready)
    };
    match handoff {
        Handoff::Latest => {
            let (mut publisher, mut reader) = latest((HostTime(0), 0));
            let give = move |value| {
                publisher.publish(value);
                waker.wake();
            };
            run(rate, frames, give, move || wait(&mut || reader.has_news()).then(|| *reader.latest().0))
        }
        Handoff::Ring => {
            let (mut producer, mut consumer) = ring(ROOM);
            let give = move |value| {
                let _ = producer.push(value);
                waker.wake();
            };
            run(rate, frames, give, move || {
                wait(&mut || !consumer.is_empty());
                consumer.pop()
            })
        }
        Handoff::ArrayQueue => {
            let queue = Arc::new(ArrayQueue::new(ROOM));
            let other = queue.clone();
            let give = move |value| {
                let _ = queue.push(value);
                waker.wake();
            };
            run(rate, frames, give, move || {
                wait(&mut || !other.is_empty());
                other.pop()
            })
        }
        Handoff::Channel => {
            let (sender, receiver) = bounded(ROOM);
            let give = move |value| {
                let _ = sender.try_send(value);
            };
            run(rate, frames, give, move || receiver.recv_timeout(PATIENCE).ok())
        }
    }
}

/// `give` on this thread, `take` on another.
fn run(
    rate: FrameRate,
    frames: u64,
    mut give: impl FnMut(Value),
    mut take: impl FnMut() -> Option<Value> + Send,
) -> std::io::Result<Histogram<u64>> {
    let clock = MonotonicClock::new(0);
    std::thread::scope(|scope| {
        let consumer = std::thread::Builder::new().name("handoff".into()).spawn_scoped(scope, move || {
            let mut delays =
                Histogram::new_with_bounds(1, 10_000_000_000, 3).expect("constant bounds are in range");
            while let Some((sent_at, number)) = take() {
                delays.saturating_record(clock.now().ns_since(sent_at).max(1).unsigned_abs());
                if number >= frames {
                    break;
                }
            }
            delays
        })?;
        let start = clock.now();
        for number in 1..=frames {
            clock.wait_until(start.plus_ns(rate.slot_start_ns(number)));
            give((clock.now(), number));
        }
        consumer.join().map_err(|_| std::io::Error::other("the measuring thread panicked"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_or_a_newer_one_arrives() {
        let rate = FrameRate::new(947, 1).unwrap();
        for handoff in Handoff::ALL {
            for policy in [WaitPolicy::SpinThenPark { spin_ns: 2_000_000 }, WaitPolicy::Park] {
                let frames = 300;
                // On a machine that does other things the receiver may sleep through nearly all of a run: one of three runs shows it.
                let runs = (0..3).map(|_| measure_handoff(handoff, policy, rate, frames).unwrap());
                let mut runs = runs.inspect(|delays| assert!(delays.len() <= frames, "{handoff:?}"));
                let enough = runs.find(|delays| delays.len() > frames / 10);
                let Some(delays) = enough else {
                    panic!("{handoff:?}: hardly any value arrived in three runs")
                };
                // Far above either policy's cost and far below the deadline of a wait: wake-ups arrive, not time-outs.
                assert!(delays.value_at_quantile(0.5) < 100_000_000, "{handoff:?} {policy:?}");
            }
        }
    }
}
