//! One-way cost of a hand-off on this machine, spinning and parked, as text.
//!
//! `cargo run --release -p dpm-lab --example handoff_bench`

use dpm_device::time::FrameRate;
use dpm_handoff::wake::WaitPolicy;
use dpm_lab::handoff_cost::measure_handoff;

fn main() -> std::io::Result<()> {
    let rate = FrameRate::new(947, 1).expect("a frame rate");
    for (name, policy) in
        [("spinning", WaitPolicy::SpinThenPark { spin_ns: 2_000_000 }), ("parked", WaitPolicy::Park)]
    {
        let delays = measure_handoff(policy, rate, 5 * 947)?;
        let us = |q| delays.value_at_quantile(q) as f64 * 1e-3;
        println!(
            "{name:9} p50 {:6.2} us  p99 {:7.2} us  p99.9 {:7.2} us  max {:8.2} us",
            us(0.5),
            us(0.99),
            us(0.999),
            us(1.0)
        );
    }
    Ok(())
}
