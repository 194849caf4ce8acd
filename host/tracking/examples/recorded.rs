//! Errors of prediction on recorded motion, beside those of a Kalman filter of constant acceleration that is tuned to
//! each recording, as text.
//!
//! `cargo run --release -p dpm-tracking --example recorded -- FILE...`
//!
//! A file has a line for each sample: seconds, x y z in metres, and a quaternion x y z w, divided by spaces. The truth is
//! the recording, smoothed and interpolated; the tracker samples it 500 times a second with 0.1 mm and 1 mrad of noise.

use dpm_device::pose::Pose;
use dpm_device::rng::Sampler;
use dpm_device::time::HostTime;
use dpm_device::tracker::{BodyIndex, TrackerSample};
use dpm_tracking::{PoseFilter, PoseFilterConfig};
use glam::{DQuat, DVec3};
use std::time::{Duration, Instant};

/// Time between two samples of the tracker, nanoseconds.
const PERIOD_NS: i64 = 2_000_000;
/// Standard deviations of its noise, m and rad.
const NOISE: [f64; 2] = [1e-4, 1e-3];
/// How far ahead of its newest sample a pose is predicted, nanoseconds.
const HORIZONS_NS: [i64; 3] = [2_000_000, 5_000_000, 10_000_000];
/// Standard deviation of the smoothing of the recording, in its samples.
const SMOOTHING: f64 = 2.0;
/// Samples before the first that is judged.
const SETTLE: usize = 500;

/// A recorded motion.
struct Recording {
    at_s: Vec<f64>,
    positions: Vec<DVec3>,
    rotations: Vec<DQuat>,
}

impl Recording {
    fn read(path: &str) -> Result<Self, Box<dyn std::error::Error>> {
        let (mut at_s, mut positions, mut rotations) = (Vec::new(), Vec::new(), Vec::<DQuat>::new());
        for line in std::fs::read_to_string(path)?.lines().filter(|line| !line.starts_with('#')) {
            let numbers: Result<Vec<f64>, _> = line.split_whitespace().map(str::parse).collect();
            let [t, x, y, z, a, b, c, d] = numbers?[..] else {
                return Err(format!("not 8 numbers: {line}").into());
            };
            let rotation = DQuat::from_xyzw(a, b, c, d).normalize();
            // The same hemisphere as the one before, so that quaternions can be averaged.
            let rotation = if rotations.last().is_some_and(|last| last.dot(rotation) < 0.0) {
                -rotation
            } else {
                rotation
            };
            at_s.push(t);
            positions.push(DVec3::new(x, y, z));
            rotations.push(rotation);
        }
        let begin = at_s.first().copied().unwrap_or(0.0);
        at_s.iter_mut().for_each(|t| *t -= begin);
        Ok(Self { at_s, positions, rotations }.smoothed())
    }

    fn smoothed(self) -> Self {
        let reach = (3.0 * SMOOTHING) as usize;
        let n = self.at_s.len();
        let around = |i: usize| {
            // As many on both sides, or the ends would be shifted.
            let reach = reach.min(i).min(n - 1 - i);
            (i - reach..=i + reach)
                .map(move |k| (k, (-0.5 * ((k as f64 - i as f64) / SMOOTHING).powi(2)).exp()))
        };
        let positions = (0..n).map(|i| {
            let (sum, weight) =
                around(i).fold((DVec3::ZERO, 0.0), |(s, w), (k, g)| (s + self.positions[k] * g, w + g));
            sum / weight
        });
        let rotations = (0..n).map(|i| {
            around(i)
                .fold(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), |s, (k, g)| s + self.rotations[k] * g)
                .normalize()
        });
        Self { positions: positions.collect(), rotations: rotations.collect(), at_s: self.at_s }
    }

    /// The pose at `t`, by cubic polynomials through four samples.
    fn at(&self, t: f64) -> (DVec3, DQuat) {
        let n = self.at_s.len();
        let i = self.at_s.partition_point(|&at| at <= t).clamp(2, n - 2) - 1;
        let x: [f64; 4] = std::array::from_fn(|k| self.at_s[i + k - 1]);
        let w: [f64; 4] =
            std::array::from_fn(|k| (0..4).filter(|&j| j != k).map(|j| (t - x[j]) / (x[k] - x[j])).product());
        let position = (0..4).map(|k| self.positions[i + k - 1] * w[k]).sum();
        let rotation =
            (0..4).fold(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), |s, k| s + self.rotations[i + k - 1] * w[k]);
        (position, rotation.normalize())
    }

    fn len_s(&self) -> f64 {
        self.at_s.last().copied().unwrap_or(0.0)
    }
}

/// A Kalman filter of constant acceleration, driven by white jerk of density `q`, on three axes.
struct Constant {
    q: f64,
    state: [DVec3; 3],
    p: [[f64; 3]; 3],
}

impl Constant {
    fn new(q: f64, z: DVec3) -> Self {
        Self {
            q,
            state: [z, DVec3::ZERO, DVec3::ZERO],
            p: [[1e-6, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 100.0]],
        }
    }

    fn update(&mut self, h: f64, z: DVec3, r: f64) {
        let [p, v, a] = self.state;
        self.state = [p + v * h + a * (0.5 * h * h), v + a * h, a];
        let f = [[1.0, h, 0.5 * h * h], [0.0, 1.0, h], [0.0, 0.0, 1.0]];
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let fp: [[f64; 3]; 3] = std::array::from_fn(|i| {
            std::array::from_fn(|j| dot(f[i], [self.p[0][j], self.p[1][j], self.p[2][j]]))
        });
        let noise = [
            [h.powi(5) / 20.0, h.powi(4) / 8.0, h.powi(3) / 6.0],
            [h.powi(4) / 8.0, h.powi(3) / 3.0, h * h / 2.0],
            [h.powi(3) / 6.0, h * h / 2.0, h],
        ];
        let m: [[f64; 3]; 3] =
            std::array::from_fn(|i| std::array::from_fn(|j| dot(fp[i], f[j]) + self.q * noise[i][j]));
        let s = m[0][0] + r;
        let k = [m[0][0] / s, m[1][0] / s, m[2][0] / s];
        let innovation = z - self.state[0];
        for (state, k) in self.state.iter_mut().zip(k) {
            *state += innovation * k;
        }
        self.p = std::array::from_fn(|i| std::array::from_fn(|j| m[i][j] - k[i] * m[0][j]));
    }

    fn ahead(&self, h: f64) -> DVec3 {
        self.state[0] + self.state[1] * h + self.state[2] * (0.5 * h * h)
    }
}

fn p99(mut errors: Vec<f64>) -> f64 {
    errors.sort_unstable_by(f64::total_cmp);
    errors[errors.len() * 99 / 100]
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("p99 of the error, mm, and its ratio to the tuned filter's; mrad of rotation; levels learned; time a sample");
    let mut logs = [0.0; 3];
    let files: Vec<String> = std::env::args().skip(1).collect();
    for path in &files {
        let ratios = of_recording(path)?;
        for (log, ratio) in logs.iter_mut().zip(ratios) {
            *log += ratio.ln() / files.len() as f64;
        }
    }
    println!("geometric mean            {:?}", logs.map(|log| (1e3 * log.exp()).round() / 1e3));
    Ok(())
}

/// Noisy samples of a recording: instant, position and rotation.
fn samples_of(recording: &Recording) -> Vec<(i64, DVec3, DQuat)> {
    let mut noise = Sampler::new(7, 0);
    let mut normal = || {
        let (a, b) = (
            (noise.next_u64() >> 11) as f64 / (1u64 << 53) as f64,
            (noise.next_u64() >> 11) as f64 / (1u64 << 53) as f64,
        );
        (-2.0 * (1.0 - a).ln()).sqrt() * (std::f64::consts::TAU * b).cos()
    };
    let n = ((recording.len_s() - 0.1) * 1e9) as i64 / PERIOD_NS;
    (25..n)
        .map(|i| {
            let at = i * PERIOD_NS;
            let (p, q) = recording.at(at as f64 * 1e-9);
            let shaken = DQuat::from_scaled_axis(DVec3::new(normal(), normal(), normal()) * NOISE[1]) * q;
            (at, p + DVec3::new(normal(), normal(), normal()) * NOISE[0], shaken)
        })
        .collect()
}

/// Prints the row of a recording. Returns the ratios of the 99th percentiles to those of the tuned filter, by horizon.
fn of_recording(path: &str) -> Result<[f64; 3], Box<dyn std::error::Error>> {
    let recording = Recording::read(path)?;
    let samples = samples_of(&recording);
    let truth: Vec<[(DVec3, DQuat); 3]> = samples
        .iter()
        .map(|(at, ..)| HORIZONS_NS.map(|ahead| recording.at((at + ahead) as f64 * 1e-9)))
        .collect();
    let (mut errors, mut turns): ([Vec<f64>; 3], [Vec<f64>; 3]) = Default::default();
    let mut filter = PoseFilter::new(PoseFilterConfig::default());
    let forgetful = PoseFilterConfig { recall_after_s: f64::INFINITY, ..PoseFilterConfig::default() };
    let (mut forgetful, mut unrecalled) = (PoseFilter::new(forgetful), Vec::new());
    let mut spent = Duration::ZERO;
    let mut levels = [[i32::MAX, i32::MIN]; 2];
    for (i, (at, p, q)) in samples.iter().enumerate() {
        let sample = TrackerSample {
            body: BodyIndex(0),
            pose: Pose { position_m: p.to_array(), rotation_xyzw: q.to_array() },
            tracked: true,
            mean_error_m: 0.0,
            covariance: None,
            sequence: i as u32,
            captured_at: HostTime(*at),
            received_at: HostTime(*at),
        };
        let begin = Instant::now();
        filter.update(&sample);
        spent += begin.elapsed();
        forgetful.update(&sample);
        if i < SETTLE {
            continue;
        }
        for (range, level) in levels.iter_mut().zip(filter.levels()) {
            *range = [range[0].min(level), range[1].max(level)];
        }
        if let Some(predicted) = forgetful.predict(HostTime(at + HORIZONS_NS[1])) {
            unrecalled.push((DVec3::from_array(predicted.pose.position_m) - truth[i][1].0).length());
        }
        for k in 0..3 {
            let Some(predicted) = filter.predict(HostTime(at + HORIZONS_NS[k])) else { continue };
            errors[k].push((DVec3::from_array(predicted.pose.position_m) - truth[i][k].0).length());
            turns[k].push(DQuat::from_array(predicted.pose.rotation_xyzw).angle_between(truth[i][k].1));
        }
    }
    let tuned = tuned(&samples, &truth);
    print!("{:24}", path.rsplit('/').next().unwrap_or(path));
    let mut ratios = [0.0; 3];
    for k in 0..3 {
        let (own, turn) = (p99(std::mem::take(&mut errors[k])), p99(std::mem::take(&mut turns[k])));
        ratios[k] = own / tuned[k];
        print!("  {:6.3} {:5.3} {:6.2}", 1e3 * own, ratios[k], 1e3 * turn);
    }
    print!("  without recall {:.3}", p99(unrecalled) / tuned[1]);
    println!("  {levels:?}  {:.2} us", spent.as_secs_f64() * 1e6 / samples.len() as f64);
    Ok(ratios)
}

/// The 99th percentiles of the constant-acceleration filter whose noise is tuned to the recording, by horizon.
fn tuned(samples: &[(i64, DVec3, DQuat)], truth: &[[(DVec3, DQuat); 3]]) -> [f64; 3] {
    let mut tuned = [f64::INFINITY; 3];
    for exponent in 0..40 {
        let q = 10f64.powf(-2.0 + 0.25 * f64::from(exponent));
        let mut constant = Constant::new(q, samples[0].1);
        let mut of: [Vec<f64>; 3] = Default::default();
        for (i, (_, p, _)) in samples.iter().enumerate().skip(1) {
            constant.update(PERIOD_NS as f64 * 1e-9, *p, NOISE[0] * NOISE[0]);
            if i >= SETTLE {
                for k in 0..3 {
                    of[k].push((constant.ahead(HORIZONS_NS[k] as f64 * 1e-9) - truth[i][k].0).length());
                }
            }
        }
        for (best, of) in tuned.iter_mut().zip(of) {
            *best = best.min(p99(of));
        }
    }
    tuned
}
