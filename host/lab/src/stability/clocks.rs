//! Hard cases of mapping a device's clock onto the host's.

use super::CpuCase;
use crate::reference::Sampler;
use dpm_device::clock_map::{ClockMap, ExchangeOutcome};
use dpm_device::time::{DeviceTicks, HostTime};

/// The cases.
pub(super) const CASES: &[CpuCase] = &[
    CpuCase(
        "clock-skew-and-drift",
        "+-200 ppm, drifting 1 ppm/s, delays of 15 us + exponential 8 us, 10 exchanges a second",
        "truth of the simulation, 99th percentile after 3 s",
        "us",
        10.0,
        skew,
    ),
    CpuCase(
        "clock-bound-is-honest",
        "1 % stalls of 5 ms, delays of 40 us there and 300 us back, half of the exchanges lost",
        "error beyond the stated bound",
        "ns",
        0.0,
        honest_bound,
    ),
    CpuCase(
        "clock-steps",
        "+-3 ms, +-1 h, restart from 0",
        "exchanges until noticed; re-locked within 1 s",
        "exchanges",
        5.0,
        steps,
    ),
    CpuCase(
        "clock-never-goes-back",
        "stamps in order across steps, stalls and refits",
        "a later stamp gives a later time",
        "violations",
        0.0,
        monotone,
    ),
    CpuCase(
        "clock-tick-wrap",
        "32-bit ticks at 48 MHz over 6 wraps; 64-bit ticks across 2^64",
        "truth",
        "us",
        10.0,
        wraps,
    ),
    CpuCase(
        "clock-frequencies",
        "1 Hz to 1e12 Hz accepted; 0 and 1e13 refused; counters of 8 and 65 bits refused",
        "i128; a tick at 1 Hz",
        "faults",
        0.0,
        frequencies,
    ),
    CpuCase(
        "clock-400-days",
        "exchanges for a minute after 400 days of uptime at 10 GHz",
        "truth",
        "us",
        10.0,
        uptime,
    ),
    CpuCase(
        "clock-impossible-exchanges",
        "received before sent, answered before received, ends of the range",
        "refused; the map does not move",
        "faults",
        0.0,
        impossible,
    ),
];

/// A device clock: ticks at a host time, by exact integers but for the drift.
#[derive(Clone, Copy)]
struct Device {
    hz: u64,
    start_ticks: u64,
    ppm: f64,
    drift_ppm_s: f64,
    step_ns: i64,
    bits: u32,
}

impl Device {
    fn new(hz: u64) -> Self {
        Self { hz, start_ticks: 12_345, ppm: 0.0, drift_ppm_s: 0.0, step_ns: 0, bits: 64 }
    }

    fn ticks(&self, host_ns: i64) -> DeviceTicks {
        let t = host_ns as f64 * 1e-9;
        let off = (self.ppm * t + 0.5 * self.drift_ppm_s * t * t) * 1e3;
        let ns = i128::from(host_ns) + i128::from(off as i64) + i128::from(self.step_ns);
        let ticks = ns * i128::from(self.hz) / 1_000_000_000 + i128::from(self.start_ticks);
        DeviceTicks(ticks as u64 & if self.bits == 64 { u64::MAX } else { (1 << self.bits) - 1 })
    }
}

struct DelayLine {
    random: Sampler,
    there_ns: i64,
    back_ns: i64,
    jitter_ns: f64,
    stall_share: f64,
}

impl DelayLine {
    fn new(seed: u64) -> Self {
        Self {
            random: Sampler::new(seed, 0),
            there_ns: 15_000,
            back_ns: 15_000,
            jitter_ns: 8_000.0,
            stall_share: 0.0,
        }
    }

    fn delay(&mut self, base: i64) -> i64 {
        let jitter = -self.jitter_ns * (1.0 - self.random.uniform()).ln();
        let stall = if self.random.uniform() < self.stall_share { 5_000_000 } else { 0 };
        base + jitter as i64 + stall
    }

    /// One exchange that begins at `t1`.
    fn exchange(&mut self, device: &Device, map: &mut ClockMap, t1: i64) -> ExchangeOutcome {
        let rx = t1 + self.delay(self.there_ns);
        let tx = rx + 5_000;
        let t4 = tx + self.delay(self.back_ns);
        map.add_exchange(HostTime(t1), device.ticks(rx), device.ticks(tx), HostTime(t4))
    }
}

const PERIOD_NS: i64 = 100_000_000;

/// The 99th percentile of the error of stamps between exchanges, from exchange `settle` on, in ns; and the most by which any error
/// exceeds its stated bound.
fn track(device: &Device, line: &mut DelayLine, start_ns: i64, n: i64, settle: i64, loss: f64) -> (f64, f64) {
    let Ok(mut map) = ClockMap::with_bits(device.hz, device.bits) else { return (f64::NAN, f64::NAN) };
    let mut beyond: f64 = 0.0;
    let mut errors = Vec::new();
    for i in 0..n {
        let t1 = start_ns + i * PERIOD_NS;
        if loss == 0.0 || line.random.uniform() >= loss {
            line.exchange(device, &mut map, t1);
        }
        for k in 1..=5 {
            let at = t1 + k * PERIOD_NS / 5;
            let Some(m) = map.to_host(device.ticks(at)) else { continue };
            let error = m.at.ns_since(HostTime(at)).abs();
            beyond = beyond.max((error - m.uncertainty_ns) as f64);
            if i >= settle {
                errors.push(error);
            }
        }
    }
    errors.sort_unstable();
    let p99 = errors.get(errors.len() * 99 / 100).map_or(f64::NAN, |e| *e as f64);
    (p99, beyond)
}

fn skew(seed: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for (ppm, drift_ppm_s) in [(200.0, 0.0), (-200.0, 0.0), (200.0, -1.0), (-200.0, 1.0), (0.0, 1.0)] {
        let device = Device { ppm, drift_ppm_s, ..Device::new(1_000_000_000) };
        worst = worst.max(track(&device, &mut DelayLine::new(seed), 0, 3000, 30, 0.0).0);
    }
    worst * 1e-3
}

fn honest_bound(seed: u64) -> f64 {
    let mut beyond: f64 = 0.0;
    for ppm in [0.0, 200.0, -150.0] {
        let device = Device { ppm, drift_ppm_s: 0.5, ..Device::new(10_000_000) };
        let mut line =
            DelayLine { there_ns: 40_000, back_ns: 300_000, stall_share: 0.01, ..DelayLine::new(seed) };
        beyond = beyond.max(track(&device, &mut line, 0, 1000, 0, 0.5).1);
    }
    beyond.max(0.0)
}

fn steps(seed: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for step_ns in [3_000_000, -3_000_000, 3_600_000_000_000, -3_600_000_000_000, i64::MIN] {
        let mut device = Device { ppm: 30.0, start_ticks: 1 << 50, ..Device::new(1_000_000_000) };
        let mut line = DelayLine::new(seed);
        let Ok(mut map) = ClockMap::new(device.hz) else { return f64::NAN };
        for i in 0..100 {
            line.exchange(&device, &mut map, i * PERIOD_NS);
        }
        if step_ns == i64::MIN {
            device.start_ticks = 0;
        } else {
            device.step_ns = step_ns;
        }
        let noticed = (1..=20)
            .find(|i| line.exchange(&device, &mut map, (99 + i) * PERIOD_NS) == ExchangeOutcome::Stepped);
        let Some(noticed) = noticed else { return f64::INFINITY };
        worst = worst.max(noticed as f64);
        // One second later: locked to within the shortest delays.
        let from = 99 + noticed;
        for i in 1..=10 {
            line.exchange(&device, &mut map, (from + i) * PERIOD_NS);
        }
        let at = (from + 10) * PERIOD_NS + 10_000_000;
        let error = map.to_host(device.ticks(at)).map_or(i64::MAX, |m| m.at.ns_since(HostTime(at)).abs());
        if error > 50_000 || map.steps() != 1 {
            return f64::INFINITY;
        }
    }
    worst
}

fn monotone(seed: u64) -> f64 {
    let mut device = Device { ppm: -180.0, start_ticks: 1 << 45, ..Device::new(1_000_000_000) };
    let mut line = DelayLine { stall_share: 0.05, ..DelayLine::new(seed) };
    let Ok(mut map) = ClockMap::new(device.hz) else { return f64::NAN };
    let mut last = HostTime(i64::MIN);
    let mut violations = 0;
    for i in 0..600 {
        if i == 200 {
            device.step_ns = -3_000_000;
        }
        if i == 400 {
            device.step_ns = 40_000_000;
        }
        line.exchange(&device, &mut map, i * PERIOD_NS);
        for k in 1..50 {
            let Some(m) = map.map_forward(device.ticks(i * PERIOD_NS + k * 2_000_000)) else { continue };
            violations += u32::from(m.at < last);
            last = m.at;
        }
    }
    f64::from(violations)
}

fn wraps(seed: u64) -> f64 {
    // 2^32 ticks of 48 MHz are 89.5 s: 540 s are six wraps.
    let short = Device { bits: 32, ppm: 50.0, ..Device::new(48_000_000) };
    let long = Device { start_ticks: u64::MAX - 20_000_000_000, ppm: 50.0, ..Device::new(1_000_000_000) };
    let a = track(&short, &mut DelayLine::new(seed), 0, 5_400, 30, 0.0).0;
    let b = track(&long, &mut DelayLine::new(seed), 0, 400, 30, 0.0).0;
    a.max(b) * 1e-3
}

fn frequencies(seed: u64) -> f64 {
    let mut faults = 0u32;
    for hz in [0, 10_000_000_000_000, u64::MAX] {
        faults += u32::from(ClockMap::new(hz).is_ok());
    }
    for bits in [0, 8, 65, u32::MAX] {
        faults += u32::from(ClockMap::with_bits(1000, bits).is_ok());
    }
    for hz in [1u64, 1000, 1_000_000, 10_000_000_000, 1_000_000_000_000] {
        let device = Device::new(hz);
        let (error, beyond) = track(&device, &mut DelayLine::new(seed), 0, 2000, 50, 0.0);
        faults += u32::from(beyond > 0.0 || error.is_nan() || error > 2e9 / hz as f64 + 10_000.0);
    }
    f64::from(faults)
}

fn uptime(seed: u64) -> f64 {
    up_for(400.0 * 86_400e9 / PERIOD_NS as f64, seed)
}

/// Devices that have been up for so many intervals of exchanges.
pub(super) fn up_for(intervals: f64, seed: u64) -> f64 {
    let device = Device { ppm: 0.0, ..Device::new(10_000_000_000) };
    track(&device, &mut DelayLine::new(seed), (intervals * PERIOD_NS as f64) as i64, 600, 30, 0.0).0 * 1e-3
}

fn impossible(seed: u64) -> f64 {
    let device = Device::new(1_000_000);
    let mut line = DelayLine::new(seed);
    let Ok(mut map) = ClockMap::new(device.hz) else { return f64::NAN };
    for i in 0..50 {
        line.exchange(&device, &mut map, i * PERIOD_NS);
    }
    let probe = device.ticks(50 * PERIOD_NS);
    let before = map.to_host(probe);
    let mut faults = 0u32;
    let now = 50 * PERIOD_NS;
    for (t1, rx, tx, t4) in [
        (now + 100_000, device.ticks(now), device.ticks(now), now),
        (now, device.ticks(now + 90_000), device.ticks(now + 10_000), now + 100_000),
        (i64::MAX, DeviceTicks(0), DeviceTicks(0), i64::MIN),
    ] {
        let outcome = map.add_exchange(HostTime(t1), rx, tx, HostTime(t4));
        faults += u32::from(outcome != ExchangeOutcome::Impossible);
    }
    faults += u32::from(map.to_host(probe) != before);
    f64::from(faults)
}
