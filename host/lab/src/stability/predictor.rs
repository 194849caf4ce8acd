//! Hard cases of following and predicting rigid bodies.

use super::CpuCase;
use crate::reference::Sampler;
use crate::statistics::Mean;
use dpm_common::so3::{so3_between, so3_exp, so3_log};
use dpm_device::pose::Pose;
use dpm_device::time::HostTime;
use dpm_device::tracker::{BodyIndex, TrackerSample};
use dpm_tracking::imm::models_for;
use dpm_tracking::imm::{Imm, Translations};
use dpm_tracking::{Freshness, PoseFilter, PoseFilterConfig, PosePrediction, Verdict};
use glam::{DQuat, DVec3};

/// The cases.
pub(super) const CASES: &[CpuCase] = &[
    CpuCase(
        "predictor-at-rest",
        "a still body, 0.1 mm of noise at 500 Hz, predicted 5 ms ahead",
        "jitter of the prediction over that of the input",
        "ratio",
        1.5,
        at_rest,
    ),
    CpuCase(
        "predictor-constant-velocity",
        "1 m/s without noise, 5 ms ahead",
        "closed form, relative to the distance covered",
        "relative",
        1e-6,
        constant_velocity,
    ),
    CpuCase(
        "predictor-constant-spin",
        "100 rad/s about a slanted axis without noise, 5 ms ahead",
        "closed form, relative to the angle covered",
        "relative",
        1e-6,
        constant_spin,
    ),
    CpuCase(
        "predictor-screw",
        "1 m/s along and 6 turns/s about an axis off the origin, 2 ms ahead",
        "closed form",
        "m",
        2e-4,
        screw,
    ),
    CpuCase(
        "predictor-acceleration-step",
        "0 to 100 m/s^2 at once, 5 ms ahead",
        "half a tau^2 with tau from the last sample; the error as a ratio to it",
        "ratio",
        1.5,
        acceleration_step,
    ),
    CpuCase(
        "predictor-half-turns-and-signs",
        "angles of pi, 2 pi - 1e-9, 1e-9; q and -q in turn",
        "exp and log: closed form; prediction continuous",
        "rad",
        1e-6,
        half_turns,
    ),
    CpuCase(
        "predictor-bad-stamps",
        "dt 0, 1 ns, negative, 10 s; stamps of the future; NaN, norm 2",
        "refused or restarted; every prediction finite",
        "faults",
        0.0,
        bad_stamps,
    ),
    CpuCase(
        "predictor-covariance-extremes",
        "R 1e-24 to 1e24 against priors of 1e12; 0; 100,000 updates",
        "least eigenvalue over trace, negative part",
        "share",
        1e-12,
        covariance,
    ),
    CpuCase(
        "predictor-outlier-burst",
        "50 samples 100 m off, then the truth",
        "error after 10 true samples",
        "m",
        1e-3,
        outliers,
    ),
    CpuCase(
        "predictor-innovations",
        "0.1 mm of noise, slow motion",
        "mean normalised innovation 3, within a factor 1.6",
        "ratio",
        1.6,
        innovations,
    ),
    CpuCase(
        "predictor-a-day",
        "100,000 samples stamped after 24 h and 400 days",
        "quaternion norm, prediction against truth",
        "error",
        1e-6,
        a_day,
    ),
    CpuCase(
        "predictor-horizon",
        "0, 5, 50, 1000 ms and negative without samples",
        "the stated error grows; motion stops at the limit; the state becomes Lost",
        "faults",
        0.0,
        horizon,
    ),
    CpuCase("predictor-jitter-of-stamps", "2 ms steps of +-100 %", "closed form", "m", 1e-6, stamp_jitter),
];

const STEP_NS: i64 = 2_000_000;

fn config() -> PoseFilterConfig {
    PoseFilterConfig {
        measure_noise: false,
        position_noise_m: 1e-6,
        rotation_noise_rad: 1e-6,
        ..Default::default()
    }
}

fn sample(at_ns: i64, position: DVec3, q: DQuat) -> TrackerSample {
    TrackerSample {
        body: BodyIndex(0),
        pose: Pose { position_m: position.to_array(), rotation_xyzw: q.to_array() },
        tracked: true,
        mean_error_m: 0.0,
        covariance: None,
        sequence: (at_ns / STEP_NS) as u32,
        captured_at: HostTime(at_ns),
        received_at: HostTime(at_ns.saturating_add(1_000_000)),
    }
}

fn position(p: &PosePrediction) -> DVec3 {
    DVec3::from_array(p.pose.position_m)
}

fn rotation(p: &PosePrediction) -> DQuat {
    DQuat::from_array(p.pose.rotation_xyzw)
}

fn finite(p: &PosePrediction) -> bool {
    let numbers = p.pose.position_m.iter().chain(&p.pose.rotation_xyzw);
    numbers.chain(&p.linear_velocity_m_s).chain(&p.angular_velocity_rad_s).all(|x| x.is_finite())
        && p.position_sigma_m.is_finite()
        && p.pose.is_valid(1e-9)
}

struct Noise(Sampler);

impl Noise {
    fn next(&mut self) -> f64 {
        let (u, v) = (1.0 - self.0.uniform(), self.0.uniform());
        (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
    }

    fn vector(&mut self, sigma: f64) -> DVec3 {
        DVec3::new(self.next(), self.next(), self.next()) * sigma
    }
}

/// Feeds `n` samples of a motion and gives the filter and the last stamp.
fn follow(config: PoseFilterConfig, n: i64, motion: impl Fn(f64) -> (DVec3, DQuat)) -> (PoseFilter, i64) {
    let mut filter = PoseFilter::new(config);
    let mut at = 0;
    for i in 0..n {
        at = i * STEP_NS;
        let (p, q) = motion(at as f64 * 1e-9);
        filter.update(&sample(at, p, q));
    }
    (filter, at)
}

fn at_rest(seed: u64) -> f64 {
    let mut noise = Noise(Sampler::new(seed, 0));
    let mut filter = PoseFilter::new(PoseFilterConfig::default());
    let (mut given, mut got) = (Mean::default(), Mean::default());
    for i in 0..4000 {
        let at = i * STEP_NS;
        let p = noise.vector(1e-4);
        filter.update(&sample(at, p, so3_exp(noise.vector(1e-4))));
        if i >= 500 {
            given.push(p.x);
            got.push(filter.predict(HostTime(at + 5_000_000)).map_or(f64::NAN, |p| position(&p).x));
        }
    }
    got.deviation() / given.deviation()
}

fn constant_velocity(_: u64) -> f64 {
    let v = DVec3::new(0.6, -0.3, 0.74);
    let (filter, at) = follow(config(), 500, |t| (v * t, DQuat::IDENTITY));
    let Some(p) = filter.predict(HostTime(at + 5_000_000)) else { return f64::NAN };
    let truth = v * (at as f64 * 1e-9 + 5e-3);
    (position(&p) - truth).length() / (v.length() * 5e-3)
}

fn constant_spin(_: u64) -> f64 {
    let w = DVec3::new(0.6, -0.48, 0.64) * 100.0;
    let (filter, at) = follow(config(), 500, |t| (DVec3::ZERO, so3_exp(w * t)));
    let Some(p) = filter.predict(HostTime(at + 5_000_000)) else { return f64::NAN };
    let truth = so3_exp(w * (at as f64 * 1e-9 + 5e-3));
    so3_between(rotation(&p), truth).length() / (w.length() * 5e-3)
}

fn screw(seed: u64) -> f64 {
    screw_of(12.0 * std::f64::consts::PI * STEP_NS as f64 * 1e-9, seed)
}

/// A screw that turns by so many radians from sample to sample.
pub(super) fn screw_of(angle: f64, _: u64) -> f64 {
    let w = DVec3::Z * (angle / (STEP_NS as f64 * 1e-9));
    let motion = |t: f64| {
        let q = so3_exp(w * t);
        (q * DVec3::X * 0.05 + DVec3::Z * t, q)
    };
    let (filter, at) = follow(config(), 1000, motion);
    let Some(p) = filter.predict(HostTime(at + 2_000_000)) else { return f64::NAN };
    let (truth, q) = motion(at as f64 * 1e-9 + 2e-3);
    (position(&p) - truth).length().max(0.05 * so3_between(rotation(&p), q).length())
}

fn acceleration_step(_: u64) -> f64 {
    let tau = 5e-3;
    let motion = |t: f64| DVec3::X * 50.0 * (t - 0.5).max(0.0).powi(2);
    let mut filter = PoseFilter::new(config());
    let mut worst: f64 = 0.0;
    for i in 0..350 {
        let at = i * STEP_NS;
        let t = at as f64 * 1e-9;
        filter.update(&sample(at, motion(t), DQuat::IDENTITY));
        if let Some(p) = filter.predict(HostTime(at + 5_000_000)) {
            worst = worst.max((position(&p) - motion(t + tau)).length());
        }
    }
    // The newest sample may have been just before the step: nothing can be known for a step and tau.
    worst / (50.0 * (tau + STEP_NS as f64 * 1e-9).powi(2))
}

fn half_turns(seed: u64) -> f64 {
    use std::f64::consts::PI;
    let mut s = Sampler::new(seed, 0);
    let mut worst: f64 = 0.0;
    for angle in [0.0, 1e-300, 1e-12, 1e-9, 3e-4, 1.0, PI - 1e-9, PI, PI + 1e-9, 4.5, 6.0, 2.0 * PI - 1e-9] {
        for _ in 0..50 {
            let axis = DVec3::new(s.uniform() - 0.5, s.uniform() - 0.5, s.uniform() - 0.5).normalize();
            let q = so3_exp(axis * angle);
            // The log gives the shorter way; composed again it is the same rotation.
            let back = so3_exp(so3_log(q));
            worst = worst.max(so3_between(back, q).length()).max(so3_between(back, -q).length());
            worst = worst.max((so3_log(q).length() - angle.min(2.0 * PI - angle)).abs());
        }
    }
    // A body that spins through pi while the tracker changes the sign of q from sample to sample.
    let w = DVec3::Y * 10.0;
    let mut filter = PoseFilter::new(config());
    for i in 0..400 {
        let at = i * STEP_NS;
        let q = so3_exp(w * (at as f64 * 1e-9));
        filter.update(&sample(at, DVec3::ZERO, if i % 2 == 0 { q } else { -q }));
        if i > 100 {
            let truth = so3_exp(w * ((at + STEP_NS) as f64 * 1e-9));
            let e = filter
                .predict(HostTime(at + STEP_NS))
                .map_or(f64::NAN, |p| so3_between(rotation(&p), truth).length());
            worst = if e.is_nan() { f64::INFINITY } else { worst.max(e) };
        }
    }
    worst
}

fn bad_stamps(_: u64) -> f64 {
    let mut faults = 0u32;
    let v = DVec3::X;
    let (mut filter, last) = follow(config(), 100, |t| (v * t, DQuat::IDENTITY));
    let at = |ns: i64| v * (ns as f64 * 1e-9);
    let mut expect = |filter: &mut PoseFilter, s: TrackerSample, want: &[Verdict]| {
        let verdict = filter.update(&s);
        faults += u32::from(!want.contains(&verdict));
        for horizon in [0, 5_000_000, i64::MAX / 2, -1_000_000_000] {
            faults += u32::from(!filter.predict(s.captured_at.plus_ns(horizon)).is_none_or(|p| finite(&p)));
        }
    };
    let q = DQuat::IDENTITY;
    expect(&mut filter, sample(last, at(last), q), &[Verdict::Duplicate]);
    expect(&mut filter, sample(last - STEP_NS, at(last - STEP_NS), q), &[Verdict::OutOfOrder]);
    expect(&mut filter, sample(i64::MIN, DVec3::ZERO, q), &[Verdict::OutOfOrder]);
    expect(&mut filter, sample(last + 1, at(last + 1), q), &[Verdict::Accepted]);
    let mut future = sample(last + STEP_NS, at(last + STEP_NS), q);
    future.captured_at = HostTime(last + 3_600_000_000_000);
    expect(&mut filter, future, &[Verdict::FromFuture]);
    for (p, q, want) in [
        (DVec3::NAN, q, Verdict::NotFinite),
        (DVec3::new(0.0, f64::INFINITY, 0.0), q, Verdict::NotFinite),
        (DVec3::ZERO, DQuat::from_xyzw(f64::NAN, 0.0, 0.0, 1.0), Verdict::NotFinite),
        (DVec3::ZERO, DQuat::from_xyzw(0.0, 0.0, 0.0, 2.0), Verdict::NotUnit),
        (DVec3::ZERO, DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), Verdict::NotUnit),
    ] {
        expect(&mut filter, sample(last + STEP_NS, p, q), &[want]);
    }
    // Nothing of that was taken in: the next true sample is expected.
    expect(&mut filter, sample(last + STEP_NS, at(last + STEP_NS), q), &[Verdict::Accepted]);
    // Ten seconds of silence, then elsewhere: within the samples of a new start the body is where it is.
    let later = last + 10_000_000_000;
    for i in 0..4 {
        filter.update(&sample(later + i * STEP_NS, DVec3::splat(3.0), q));
    }
    let found = filter
        .predict(HostTime(later + 3 * STEP_NS))
        .is_some_and(|p| (position(&p) - DVec3::splat(3.0)).length() < 1e-3);
    faults += u32::from(!found);
    f64::from(faults)
}

/// Least eigenvalue of the symmetric 3 x 3 [[a, b, c], [b, d, e], [c, e, f]] over its trace, both scaled to unit diagonal first,
/// so that metres and accelerations weigh the same: by Sylvester's criterion the smallest of the leading minors.
fn least_minor(c: &dpm_tracking::imm::Covariance) -> f64 {
    let d = [c.pp, c.vv, c.aa].map(|x| if x > 0.0 { 1.0 / x.sqrt() } else { 0.0 });
    let (b, e, f) = (c.pv * d[0] * d[1], c.pa * d[0] * d[2], c.va * d[1] * d[2]);
    let two = |x: f64| 1.0 - x * x;
    let three = 1.0 + 2.0 * b * e * f - b * b - e * e - f * f;
    let mut least = two(b).min(two(e)).min(two(f)).min(c.pp).min(c.vv).min(c.aa);
    if c.aa > 0.0 && c.vv > 0.0 {
        least = least.min(three);
    }
    least
}

/// The largest negative part of the covariances of a filter, over all that it held so far; infinite if one was no number.
fn negative_part(imm: &Imm<Translations>, worst: f64) -> f64 {
    let covariances = imm.covariances();
    let least = covariances.iter().flatten().map(least_minor);
    least.fold(worst, |worst, least| if least.is_finite() { worst.max(-least) } else { f64::INFINITY })
}

/// A prior of variance `first`, and measurements of variance `r`, at steps of 1 ns to 10 s.
fn covariance_between(first: f64, r: f64, s: &mut Sampler) -> f64 {
    let config = models_for(5.0);
    let mut imm = Imm::<Translations>::new(&config, DVec3::ZERO, DVec3::splat(first));
    (0..300).fold(0.0, |worst, i| {
        imm.advance(&config, [0.002, 0.0, 1e-9, 10.0][i % 4], None);
        imm.update(DVec3::splat(1e-3 * s.uniform()), DVec3::splat(r));
        negative_part(&imm, worst)
    })
}

/// A prior whose variance is so many times that of the measurements.
pub(super) fn covariance_of(ratio: f64, seed: u64) -> f64 {
    covariance_between(ratio.sqrt(), 1.0 / ratio.sqrt(), &mut Sampler::new(seed, 0))
}

fn covariance(seed: u64) -> f64 {
    let config = models_for(5.0);
    let mut s = Sampler::new(seed, 0);
    let mut worst: f64 = 0.0;
    for (first, r) in [(1e12, 1e-12), (1e12, 1e-24), (1e-12, 1e12), (1e24, 1e-24), (1e12, 0.0), (0.0, 0.0)] {
        worst = worst.max(covariance_between(first, r, &mut s));
    }
    let mut imm = Imm::<Translations>::new(&config, DVec3::ZERO, DVec3::splat(1e-8));
    for i in 0..100_000 {
        imm.advance(&config, 0.002, None);
        imm.update(DVec3::splat(1e-4 * s.uniform()), DVec3::splat(1e-8));
        if i % 100 == 0 {
            worst = negative_part(&imm, worst);
        }
    }
    worst
}

fn outliers(_: u64) -> f64 {
    let motion = |t: f64| DVec3::new(t, 0.3, 0.0);
    let (mut filter, last) = follow(config(), 500, |t| (motion(t), DQuat::IDENTITY));
    let mut at = last;
    for i in 0..50 {
        at += STEP_NS;
        // Scattered, so that they do not agree on a new place.
        let far = DVec3::new(100.0 * if i % 2 == 0 { 1.0 } else { -1.0 }, 7.0 * f64::from(i), 100.0);
        filter.update(&sample(at, far, DQuat::IDENTITY));
        if filter.predict(HostTime(at)).is_none_or(|p| position(&p).length() > 10.0) {
            return f64::INFINITY;
        }
    }
    for _ in 0..10 {
        at += STEP_NS;
        filter.update(&sample(at, motion(at as f64 * 1e-9), DQuat::IDENTITY));
    }
    filter.predict(HostTime(at)).map_or(f64::NAN, |p| (position(&p) - motion(at as f64 * 1e-9)).length())
}

fn innovations(seed: u64) -> f64 {
    let mut noise = Noise(Sampler::new(seed, 0));
    let config = PoseFilterConfig {
        measure_noise: false,
        position_noise_m: 1e-4,
        rotation_noise_rad: 1e-3,
        ..Default::default()
    };
    let mut filter = PoseFilter::new(config);
    let mut mean = Mean::default();
    for i in 0..5000 {
        let at = i * STEP_NS;
        let p = DVec3::X * 0.2 * (at as f64 * 1e-9) + noise.vector(1e-4);
        filter.update(&sample(at, p, so3_exp(noise.vector(1e-3))));
        if let (true, Some(nis)) = (i > 500, filter.last_nis()) {
            mean.push(nis[0]);
        }
    }
    (mean.mean() / 3.0).max(3.0 / mean.mean())
}

fn a_day(seed: u64) -> f64 {
    [1.0, 400.0].map(|days| up_for(days * 86_400e9 / STEP_NS as f64, seed)).into_iter().fold(0.0, f64::max)
}

/// A machine that has been up for so many intervals of samples.
pub(super) fn up_for(intervals: f64, _: u64) -> f64 {
    let start = (intervals * STEP_NS as f64) as i64;
    let w = DVec3::new(1.0, 2.0, -0.5);
    let mut filter = PoseFilter::new(config());
    let mut at = start;
    for i in 0..50_000i64 {
        at = start + i * STEP_NS;
        let t = (at - start) as f64 * 1e-9;
        filter.update(&sample(at, DVec3::X * 0.01 * t, so3_exp(w * t)));
    }
    let Some(p) = filter.predict(HostTime(at + STEP_NS)) else { return f64::NAN };
    let t = (at + STEP_NS - start) as f64 * 1e-9;
    let turned = so3_between(rotation(&p), so3_exp(w * t)).length();
    (rotation(&p).length() - 1.0).abs().max((position(&p) - DVec3::X * 0.01 * t).length()).max(turned)
}

fn horizon(_: u64) -> f64 {
    let motion = |t: f64| DVec3::X * (0.1 * (20.0 * t).sin());
    let (filter, last) = follow(config(), 500, |t| (motion(t), DQuat::IDENTITY));
    let at = |ms: i64| filter.predict(HostTime(last + ms * 1_000_000));
    let error = |ms: i64| {
        let truth = motion(last as f64 * 1e-9 + ms as f64 * 1e-3);
        at(ms).map_or(f64::NAN, |p| (position(&p) - truth).length())
    };
    let mut faults = 0u32;
    faults += u32::from(error(0) > error(5) + 1e-6 || error(5) > error(50) || error(0).is_nan());
    let limit = filter.config().lost_after_ns / 1_000_000;
    let same = |a: Option<PosePrediction>, b: Option<PosePrediction>| match (a, b) {
        (Some(a), Some(b)) => a.pose == b.pose,
        _ => false,
    };
    faults += u32::from(!same(at(limit + 1), at(1000)) || !same(at(1000), at(86_400_000)));
    faults += u32::from(at(limit + 1).is_none_or(|p| p.freshness != Freshness::Lost));
    faults += u32::from(at(0).is_none_or(|p| p.freshness != Freshness::Tracked));
    for ms in [-1000, -5, 0, 5, 50, 1000] {
        faults += u32::from(!at(ms).is_some_and(|p| finite(&p)));
    }
    faults += u32::from(filter.predict(HostTime(i64::MAX)).is_none_or(|p| !finite(&p)));
    faults += u32::from(filter.predict(HostTime(i64::MIN)).is_none_or(|p| !finite(&p)));
    f64::from(faults)
}

fn stamp_jitter(seed: u64) -> f64 {
    let mut s = Sampler::new(seed, 0);
    let mut filter = PoseFilter::new(config());
    let v = DVec3::new(0.5, 0.8, -0.2);
    let mut at = 0i64;
    for _ in 0..800 {
        at += 1 + (4e6 * s.uniform()) as i64;
        filter.update(&sample(at, v * (at as f64 * 1e-9), DQuat::IDENTITY));
    }
    let later = at + 5_000_000;
    filter.predict(HostTime(later)).map_or(f64::NAN, |p| (position(&p) - v * (later as f64 * 1e-9)).length())
}
