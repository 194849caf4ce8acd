//! The clock map against simulated clocks whose truth is known: skew, drift, stalls, steps, wraps, age.

use super::*;

const S: i64 = 1_000_000_000;

/// A device clock and a network, both with known truth. Randomness from a linear congruential generator, seeded.
struct World {
    state: u64,
    frequency: u64,
    bits: u32,
    /// Device ticks at host 0, and rate relative to the host's.
    start_ticks: i128,
    skew_ppb: f64,
    drift_ppb_s: f64,
    step_ns: i64,
    /// Delay of one direction: fixed part there and back, mean of the exponential part, chance of a stall and its
    /// length.
    there: f64,
    back: f64,
    tail: f64,
    stall: f64,
}

impl World {
    fn new(seed: u64) -> Self {
        Self {
            state: seed,
            frequency: 10_000_000,
            bits: 64,
            start_ticks: 123_456_789_012,
            skew_ppb: 0.0,
            drift_ppb_s: 0.0,
            step_ns: 0,
            there: 15_000.0,
            back: 15_000.0,
            tail: 8_000.0,
            stall: 0.0,
        }
    }

    fn uniform(&mut self) -> f64 {
        self.state =
            self.state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.state >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    fn delay(&mut self, base: f64) -> i64 {
        let stall = if self.uniform() < self.stall { 5e6 * self.uniform() } else { 0.0 };
        (base - self.tail * self.uniform().ln() + stall) as i64
    }

    /// What the device's counter shows at host time `t`.
    fn ticks_at(&self, t: i64) -> DeviceTicks {
        let s = t as f64 * 1e-9;
        let warp = s * self.skew_ppb + 0.5 * s * s * self.drift_ppb_s;
        let device_ns = i128::from(t) + warp as i128 + i128::from(self.step_ns);
        let total = self.start_ticks + (device_ns * i128::from(self.frequency)).div_euclid(1_000_000_000);
        DeviceTicks(total as u64 & mask(self.bits))
    }

    fn exchange(&mut self, map: &mut ClockMap, t1: i64) -> ExchangeOutcome {
        let seen = t1 + self.delay(self.there);
        let sent = seen + 3_000;
        let t4 = sent + self.delay(self.back);
        map.add_exchange(HostTime(t1), self.ticks_at(seen), self.ticks_at(sent), HostTime(t4))
    }
}

/// Errors in ns of stamps taken every 2 ms up to `seconds`, after a second of warm-up; and the share inside the bound.
fn measure(world: &mut World, map: &mut ClockMap, seconds: i64, loss: f64) -> (Vec<i64>, f64) {
    let mut errors = Vec::new();
    let mut inside = 0usize;
    for k in 0..seconds * 500 {
        let t = k * 2_000_000;
        // Twenty probes at first, then ten a second, as the clients do.
        if (k < 100 && k % 5 == 0 || k % 50 == 0) && world.uniform() >= loss {
            world.exchange(map, t);
        }
        if t > S {
            let mapped = map.map_forward(world.ticks_at(t)).unwrap();
            let error = (mapped.at.0 - t).abs();
            inside += usize::from(error <= mapped.uncertainty_ns);
            errors.push(error);
        }
    }
    errors.sort_unstable();
    let share = inside as f64 / errors.len() as f64;
    (errors, share)
}

fn percentile(sorted: &[i64], p: f64) -> i64 {
    sorted[((sorted.len() - 1) as f64 * p) as usize]
}

#[test]
fn error_is_small_and_its_bound_is_honest() {
    // (skew ppm, drift ppm/s, stalls, loss, allowed p99 in us): numerical-stability cases 31 and 33.
    let cases = [
        (0.0, 0.0, 0.0, 0.0, 10),
        (200.0, 1.0, 0.0, 0.0, 10),
        (-200.0, -1.0, 0.0, 0.0, 10),
        (40.0, 0.0, 0.01, 0.0, 25),
        (-40.0, 0.5, 0.05, 0.5, 25),
    ];
    for (i, (skew, drift, stall, loss, allowed_us)) in cases.into_iter().enumerate() {
        for seed in 0..4 {
            let mut world = World::new(seed * 77 + i as u64);
            (world.skew_ppb, world.drift_ppb_s, world.stall) = (skew * 1e3, drift * 1e3, stall);
            let mut map = ClockMap::new(world.frequency).unwrap();
            let (errors, inside) = measure(&mut world, &mut map, 60, loss);
            let p99 = percentile(&errors, 0.99);
            assert!(p99 <= allowed_us * 1000, "case {i} seed {seed}: p99 {p99} ns");
            assert!(inside >= 0.999, "case {i} seed {seed}: {inside} inside the bound");
            assert_eq!(map.steps(), 0, "case {i}: no step where there was none");
        }
    }
}

#[test]
fn asymmetric_ways_stay_inside_the_bound() {
    let mut world = World::new(5);
    (world.there, world.back) = (400_000.0, 20_000.0);
    let mut map = ClockMap::new(world.frequency).unwrap();
    let (errors, inside) = measure(&mut world, &mut map, 20, 0.0);
    // Nobody can know the asymmetry: the error is half of it, and the bound must cover it.
    assert!((percentile(&errors, 0.5) - 190_000).abs() < 20_000);
    assert!(inside >= 0.999);
}

#[test]
fn the_reported_skew_is_the_true_one() {
    let mut world = World::new(9);
    world.skew_ppb = 200_000.0;
    let mut map = ClockMap::new(world.frequency).unwrap();
    measure(&mut world, &mut map, 10, 0.0);
    let (ppb, error) = map.skew_ppb();
    // The host runs slower than the device by 200 ppm.
    assert!((ppb + 200_000).abs() <= error.min(15_000), "{ppb} +- {error}");
}

#[test]
fn steps_are_found_and_time_never_runs_backwards() {
    for step in [3_000_000, -3_000_000, 3_600 * S, -3_600 * S] {
        let mut world = World::new(step as u64);
        let mut map = ClockMap::new(world.frequency).unwrap();
        measure(&mut world, &mut map, 5, 0.0);
        let mut last = map.map_forward(world.ticks_at(5 * S - 2_000_000)).unwrap().at;
        world.step_ns = step;
        let (mut probes, mut relocked) = (0, None);
        for k in 0..2500 {
            let t = 5 * S + k * 2_000_000;
            if k % 50 == 0 {
                probes += 1;
                let outcome = world.exchange(&mut map, t);
                assert!(
                    probes != 3 || outcome == ExchangeOutcome::Stepped,
                    "{step}: {outcome:?} at the third probe"
                );
            }
            let mapped = map.map_forward(world.ticks_at(t)).unwrap();
            assert!(mapped.at >= last, "{step}: ran backwards at {k}");
            last = mapped.at;
            let pure = map.to_host(world.ticks_at(t)).unwrap();
            if (pure.at.0 - t).abs() < 50_000 && relocked.is_none() {
                relocked = Some(t - 5 * S);
            }
        }
        assert!(relocked.unwrap() <= S, "{step}: {relocked:?}");
        assert_eq!(map.steps(), 1);
    }
}

#[test]
fn one_lying_exchange_is_forgotten() {
    let mut world = World::new(3);
    let mut map = ClockMap::new(world.frequency).unwrap();
    measure(&mut world, &mut map, 3, 0.0);
    let t = 3 * S;
    let honest = map.to_host(world.ticks_at(t)).unwrap();
    world.step_ns = 50_000_000;
    assert_eq!(world.exchange(&mut map, t), ExchangeOutcome::Contradicting);
    world.step_ns = 0;
    assert_eq!(map.to_host(world.ticks_at(t)), Some(honest));
    assert_eq!(world.exchange(&mut map, t + 1_000_000), ExchangeOutcome::Used);
    // Received before it was sent, answered before it was received: such an exchange proves nothing.
    let (a, b) = (world.ticks_at(t), world.ticks_at(t + S));
    assert_eq!(map.add_exchange(HostTime(t + 10), a, a, HostTime(t)), ExchangeOutcome::Impossible);
    assert_eq!(map.add_exchange(HostTime(t), b, a, HostTime(t + S)), ExchangeOutcome::Impossible);
    assert_eq!(map.add_exchange(HostTime(t), a, b, HostTime(t + 1000)), ExchangeOutcome::Impossible);
}

#[test]
fn counters_wrap_and_rates_from_1_hz_to_10_ghz_work() {
    for (bits, frequency) in [(32, 48_000_000), (64, 1_000_000_000), (64, 10_000_000_000), (16, 1_000)] {
        let mut world = World::new(1);
        (world.bits, world.frequency) = (bits, frequency);
        // Two seconds before the wrap.
        world.start_ticks = (1i128 << bits) - 2 * i128::from(frequency);
        let mut map = ClockMap::with_bits(frequency, bits).unwrap();
        let (errors, inside) = measure(&mut world, &mut map, 6, 0.0);
        let tick = 1_000_000_000 / frequency as i64;
        assert!(
            percentile(&errors, 0.99) <= 10_000 + tick,
            "{bits} bits, {frequency} Hz: {}",
            percentile(&errors, 0.99)
        );
        assert!(inside >= 0.999);
        let t = 6 * S;
        let there = map.to_device(HostTime(t)).unwrap();
        let back = map.to_host(there).unwrap();
        assert!((back.at.0 - t).abs() <= tick + 2);
    }
    let mut slow = World::new(2);
    slow.frequency = 1;
    let mut map = ClockMap::new(1).unwrap();
    let (_, inside) = measure(&mut slow, &mut map, 20, 0.0);
    assert!(inside >= 0.999, "1 Hz: the bound is a second wide and true");
    assert_eq!(ClockMap::new(0).err(), Some(ClockMapError::Frequency(0)));
    assert_eq!(ClockMap::new(u64::MAX).err(), Some(ClockMapError::Frequency(u64::MAX)));
    assert_eq!(ClockMap::with_bits(1, 8).err(), Some(ClockMapError::Bits(8)));
}

#[test]
fn four_hundred_days_lose_no_nanosecond() {
    // Exchanges without delay leave no uncertainty but the tick: the map must be exact after any time.
    let mut map = ClockMap::new(1_000_000_000).unwrap();
    let day = 86_400 * S;
    for t in (0..400 * day).step_by((day / 4) as usize) {
        let ticks = DeviceTicks(t as u64 + 7);
        assert_eq!(map.add_exchange(HostTime(t), ticks, ticks, HostTime(t)), ExchangeOutcome::Used);
        assert_eq!(map.to_host(DeviceTicks(t as u64 + 7)).unwrap().at, HostTime(t));
    }
    assert_eq!(map.steps(), 0);
    assert!(map.to_host(DeviceTicks(0)).unwrap().uncertainty_ns > 0);
}

/// Delays of milliseconds over half a second would allow any rate: such a slope must not count as better known than the
/// plausible rates are.
#[test]
fn the_bound_is_honest_for_delays_that_are_long_and_lopsided() {
    for seed in 0..20_000 {
        let mut w = World::new(seed);
        w.frequency = 1_000_000_000;
        w.skew_ppb = (w.uniform() - 0.5) * 400_000.0;
        let mut map = ClockMap::new(w.frequency).unwrap();
        let mut t = S;
        for _ in 0..30 {
            t += (w.uniform() * w.uniform() * 0.6 * S as f64) as i64;
            let long = if w.uniform() < 0.5 { 5e6 } else { 1e5 };
            let (there, back) = ((w.uniform() * long) as i64 + 20_000, (w.uniform() * long) as i64 + 20_000);
            let rx = w.ticks_at(t + there);
            let outcome = map.add_exchange(HostTime(t), rx, rx, HostTime(t + there + back));
            assert_eq!(outcome, ExchangeOutcome::Used, "world {seed}");
            for later in [0, 50_000_000, 500_000_000] {
                let at = t + there + later;
                let mapped = map.to_host(w.ticks_at(at)).unwrap();
                let error = (mapped.at.0 - at).abs();
                assert!(error <= mapped.uncertainty_ns, "world {seed}: {error} ns, bound {mapped:?}");
            }
            t += there + back;
        }
    }
}
