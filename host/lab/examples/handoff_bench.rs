//! One-way cost of every hand-off on this machine, spinning and parked, in turns, as text.
//!
//! `cargo run --release -p dpm-lab --example handoff_bench`

use dpm_device::time::FrameRate;
use dpm_handoff::wake::WaitPolicy;
use dpm_lab::handoff_cost::{measure_handoff, Handoff};

/// Rounds in which all take turns: a machine that is slow for a while is slow for all.
const ROUNDS: u64 = 5;

fn main() -> std::io::Result<()> {
    let rate = FrameRate::new(947, 1).expect("a frame rate");
    for (name, policy) in
        [("spinning", WaitPolicy::SpinThenPark { spin_ns: 2_000_000 }), ("parked", WaitPolicy::Park)]
    {
        let mut sums = Vec::new();
        for round in 0..ROUNDS {
            for (i, handoff) in Handoff::ALL.into_iter().enumerate() {
                let delays = measure_handoff(handoff, policy, rate, 2 * 947)?;
                if round == 0 {
                    sums.push(delays);
                } else {
                    sums[i].add(&delays).expect("histograms of one kind");
                }
            }
        }
        for (handoff, delays) in Handoff::ALL.iter().zip(&sums) {
            let us = |q| delays.value_at_quantile(q) as f64 * 1e-3;
            println!(
                "{name:9} {:10} p50 {:6.2} us  p99 {:7.2} us  p99.9 {:7.2} us  max {:8.2} us",
                format!("{handoff:?}"),
                us(0.5),
                us(0.99),
                us(0.999),
                us(1.0)
            );
        }
    }
    Ok(())
}
