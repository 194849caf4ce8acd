//! The least error that a predictor can have which knows everything about a body's motion but when it turns, as text.
//!
//! `cargo run --release -p dpm-lab --example prediction_bound`
//!
//! The motions are those of the table of docs/lab/PREDICTION.md whose acceleration jumps: 0.5 m/s there and back, turns of 5 m/s^2. The
//! predictor is told what no filter of a rig knows: the noise, that acceleration is exactly -5, 0 or 5 m/s^2, and how long each lasts on
//! average. It keeps the likeliest histories of jumps, each with the exact (Kalman) distribution of position and velocity, so that its
//! belief is Bayes' up to the histories it drops. From the belief come two predictions: the mean, which has the least mean square
//! error, and the point that is most likely within the limit of 0.25 mm.

use dpm_device::pose::Pose;
use dpm_device::time::{FrameRate, HostTime};
use dpm_device::tracker::{BodyIndex, Tracker};
use dpm_mock::motion::{Motion, MotionSpec};
use dpm_mock::tracker::{MockTracker, MockTrackerConfig};

const ACCELERATION: f64 = 5.0;
const SPEED: f64 = 0.5;
const NOISE: f64 = 1e-4;
const STEP: f64 = 0.002;
/// Histories kept.
const HISTORIES: usize = 120;
/// What is asked for, m.
const LIMIT: f64 = 0.25e-3;
/// As in the table: from the latch to the middle of the exposure.
const LATCH_TO_LIGHT_NS: i64 = 2_800_000;

/// One history of jumps: what it believes, and how likely it is.
#[derive(Clone, Copy)]
struct History {
    acceleration: f64,
    position: f64,
    velocity: f64,
    pp: f64,
    pv: f64,
    vv: f64,
    weight: f64,
}

impl History {
    /// On by a step in which the acceleration becomes `next` at an unknown instant (or stays), and a measured position.
    fn step(mut self, next: f64, chance: f64, z: f64) -> Self {
        let jump = next - self.acceleration;
        self.position +=
            self.velocity * STEP + self.acceleration * STEP * STEP / 2.0 + jump * STEP * STEP / 6.0;
        self.velocity += self.acceleration * STEP + jump * STEP / 2.0;
        self.acceleration = next;
        // The instant is uniform in the step: variances of 1 - u and (1 - u)^2 / 2, and enough besides to keep histories alive.
        let pp =
            self.pp + STEP * (2.0 * self.pv + STEP * self.vv) + (jump * STEP * STEP).powi(2) / 45.0 + 1e-16;
        let pv = self.pv + STEP * self.vv + jump * jump * STEP.powi(3) / 24.0;
        let vv = self.vv + (jump * STEP).powi(2) / 12.0 + 1e-9;
        let (s, error) = (pp + NOISE * NOISE, z - self.position);
        self.weight *= chance * ((-0.5 * error * error / s).exp() / s.sqrt() + f64::MIN_POSITIVE);
        let (kp, kv) = (pp / s, pv / s);
        self.position += kp * error;
        self.velocity += kv * error;
        (self.pp, self.pv, self.vv) = (pp * (1.0 - kp), pv * (1.0 - kp), vv - kv * pv);
        self
    }

    fn at(&self, h: f64) -> f64 {
        self.position + self.velocity * h + self.acceleration * h * h / 2.0
    }

    fn sigma_at(&self, h: f64) -> f64 {
        (self.pp + 2.0 * h * self.pv + h * h * self.vv).sqrt()
    }

    fn is_like(&self, other: &Self) -> bool {
        self.acceleration == other.acceleration
            && (self.position - other.position).abs() < 0.03 * self.pp.sqrt()
            && (self.velocity - other.velocity).abs() < 0.03 * self.vv.sqrt()
    }
}

/// Chance of going from one acceleration to another within a step, for stretches and turns that last so long on average, s.
fn chance(from: f64, to: f64, [stretch, turn]: [f64; 2]) -> f64 {
    let leaves = |mean: f64| 1.0 - (-STEP / mean).exp();
    match (from == 0.0, from == to) {
        (true, true) => 1.0 - leaves(stretch),
        (true, false) => 0.5 * leaves(stretch),
        (false, true) => 1.0 - leaves(turn),
        (false, false) => leaves(turn) * if to == 0.0 { 0.98 } else { 0.02 },
    }
}

fn take_in(belief: &mut Vec<History>, z: f64, means: [f64; 2]) {
    let mut all: Vec<History> = belief
        .iter()
        .flat_map(|h| {
            [-ACCELERATION, 0.0, ACCELERATION].map(|a| h.step(a, chance(h.acceleration, a, means), z))
        })
        .collect();
    all.sort_unstable_by(|a, b| b.weight.total_cmp(&a.weight));
    belief.clear();
    for h in all.into_iter().take(HISTORIES) {
        match belief.iter_mut().find(|kept| kept.is_like(&h)) {
            Some(kept) => kept.weight += h.weight,
            None => belief.push(h),
        }
    }
    let total: f64 = belief.iter().map(|h| h.weight).sum();
    belief.iter_mut().for_each(|h| h.weight /= total);
}

/// Both predictions for `h` seconds on.
fn predict(belief: &[History], h: f64) -> [f64; 2] {
    let mean: f64 = belief.iter().map(|b| b.weight * b.at(h)).sum();
    // The normal distribution's integral by a logistic curve: to a hundredth, enough to choose by.
    let within = |x: f64| -> f64 {
        let logistic = |z: f64| 1.0 / (1.0 + (-1.702 * z).exp());
        let share = |b: &History| {
            let (d, s) = (x - b.at(h), b.sigma_at(h));
            logistic((d + LIMIT) / s) - logistic((d - LIMIT) / s)
        };
        belief.iter().map(|b| b.weight * share(b)).sum()
    };
    let points = (-40..=40).map(|i| mean + f64::from(i) * 0.02e-3);
    let safest = points.map(|x| (within(x), x)).max_by(|a, b| a.0.total_cmp(&b.0)).map_or(mean, |(_, x)| x);
    [mean, safest]
}

fn quantile_mm(errors: &mut [f64], q: f64) -> f64 {
    errors.sort_unstable_by(f64::total_cmp);
    errors[((errors.len() as f64 * q).ceil() as usize).clamp(1, errors.len()) - 1] * 1e3
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("path    predictor         p50      p99    above 0.25 mm");
    for amplitude in [0.15, 0.5] {
        let motion = Motion::new(&MotionSpec::shuttle(SPEED, amplitude, ACCELERATION), Pose::IDENTITY)?;
        let turn = 2.0 * SPEED / ACCELERATION;
        let stretch = (2.0 * amplitude - SPEED * SPEED / ACCELERATION) / SPEED;
        let config = MockTrackerConfig { position_noise_m: NOISE, ..MockTrackerConfig::default() };
        let mut tracker = MockTracker::new(config, vec![motion])?;
        let start = |acceleration| History {
            acceleration,
            position: 0.0,
            velocity: 0.0,
            pp: 1.0,
            pv: 0.0,
            vv: 1.0,
            weight: 1.0 / 3.0,
        };
        let mut belief: Vec<History> = [-ACCELERATION, 0.0, ACCELERATION].map(start).to_vec();
        let rate = FrameRate::new(947, 1).ok_or("a frame rate")?;
        let (mut errors, mut newest) = ([Vec::new(), Vec::new()], HostTime(0));
        for slot in 0..21 * 947u64 {
            let light = HostTime(rate.slot_start_ns(slot));
            tracker.poll(light.plus_ns(-LATCH_TO_LIGHT_NS), &mut |sample| {
                take_in(&mut belief, sample.pose.position_m[0], [stretch, turn]);
                newest = sample.captured_at;
            })?;
            let Some(truth) = tracker.true_pose(BodyIndex(0), light.0).filter(|_| slot > 947) else {
                continue;
            };
            let predicted = predict(&belief, light.ns_since(newest) as f64 * 1e-9);
            for (errors, x) in errors.iter_mut().zip(predicted) {
                errors.push((x - truth.position_m[0]).abs());
            }
        }
        for (name, errors) in ["mean", "most within"].into_iter().zip(&mut errors) {
            let above = errors.iter().filter(|&&e| e > LIMIT).count() as f64 / errors.len() as f64;
            let (p50, p99) = (quantile_mm(errors, 0.5), quantile_mm(errors, 0.99));
            println!("{:.1} m   {name:12}  {p50:.3} mm {p99:.3} mm  {:.2} %", 2.0 * amplitude, 100.0 * above);
        }
    }
    Ok(())
}
