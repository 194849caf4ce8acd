//! What a sample of a body costs, filters and learning included: processor time of this thread, by the number of bodies
//! and by the rate, and the share of a core that it makes. `cargo run -p dpm-tracking --example cost`.

use dpm_common::realtime::os::thread_cpu_ns;
use dpm_device::pose::Pose;
use dpm_device::time::HostTime;
use dpm_device::tracker::{BodyIndex, TrackerSample};
use dpm_tracking::{PoseFilterBank, PoseFilterConfig};

/// Samples of each body that are not counted: filters learn and caches fill.
const WARM_UP: i64 = 1_500;

fn main() {
    println!("{:>7} {:>7} {:>12} {:>12} {:>16}", "bodies", "Hz", "motion", "us a sample", "share of a core");
    for (bodies, hz) in [(1u16, 500i64), (1, 1_000), (64, 500), (64, 1_000)] {
        for still in [false, true] {
            let us = cost_us(bodies, hz, still);
            let share = us * 1e-6 * f64::from(bodies) * hz as f64;
            let motion = if still { "still" } else { "moving" };
            println!("{bodies:>7} {hz:>7} {motion:>12} {us:>12.2} {:>14.1} %", 100.0 * share);
        }
    }
}

/// Processor time of a sample, microseconds.
fn cost_us(bodies: u16, hz: i64, still: bool) -> f64 {
    let mut bank = PoseFilterBank::new(&vec![PoseFilterConfig::default(); usize::from(bodies)]);
    let counted = 200_000 / i64::from(bodies).max(10);
    let mut spent = 0;
    for k in 0..WARM_UP + counted {
        let samples: Vec<TrackerSample> = (0..bodies).map(|body| sample(body, k, hz, still)).collect();
        let before = thread_cpu_ns();
        for sample in &samples {
            bank.update(sample);
        }
        if k >= WARM_UP {
            spent += thread_cpu_ns() - before;
        }
    }
    spent as f64 * 1e-3 / (counted * i64::from(bodies)) as f64
}

/// Sample `k` of a body that swings and turns at a pace of its own, with 0.1 mm and 1 mrad of noise; or that rests.
fn sample(body: u16, k: i64, hz: i64, still: bool) -> TrackerSample {
    let t = if still { 0.0 } else { k as f64 / hz as f64 };
    let pace = 6.0 + f64::from(body % 7);
    let noise = |axis: i64| {
        let n = (k * 8 + axis).wrapping_mul(0x9e37_79b9_7f4a_7c15u64 as i64) ^ i64::from(body) << 40;
        let n = n.wrapping_mul(0x2545_f491_4f6c_dd1d);
        (n >> 11) as f64 / (1i64 << 52) as f64
    };
    let (sin, cos) = (pace * t).sin_cos();
    let half = 0.2 * (0.7 * pace * t).sin() + 1e-3 * noise(3);
    let captured_at = HostTime(1_000_000_000 + k * 1_000_000_000 / hz);
    TrackerSample {
        body: BodyIndex(body),
        pose: Pose {
            position_m: [0.1 * sin + 2e-4 * noise(0), 0.05 * cos + 2e-4 * noise(1), 2e-4 * noise(2)],
            rotation_xyzw: [0.0, half.sin(), 0.0, half.cos()],
        },
        tracked: true,
        mean_error_m: 0.0,
        covariance: None,
        sequence: k as u32,
        captured_at,
        received_at: captured_at.plus_ns(2_000_000),
    }
}
