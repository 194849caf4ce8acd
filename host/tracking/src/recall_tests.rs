//! Laws of the recall: a repetition is found with its own period, other motion is left alone, and recall never makes
//! the prediction worse.

use super::super::evaluation::{evaluate, EvaluationConfig};
use super::super::imm::Translations;
use super::super::pose_filter::{PoseFilter, PoseFilterConfig};
use super::super::testing::Gauss;
use super::*;
use dpm_device::pose::Pose;
use dpm_device::time::HostTime;
use dpm_device::tracker::{BodyIndex, TrackerSample};
use dpm_mock::motion::{Motion, MotionSpec};

const SIGMA: f64 = 1e-4;
const STEP_NS: i64 = 2_000_000;

fn shuttle(amplitude_m: f64, rest_s: f64) -> MotionSpec {
    MotionSpec::Translate {
        direction: [1.0, 2.0, 0.0],
        speed_m_s: 0.5,
        amplitude_m,
        acceleration_m_s2: 5.0,
        rest_s,
    }
}

fn sine() -> MotionSpec {
    MotionSpec::Sinusoid { direction: [0.0, 1.0, 1.0], peak_speed_m_s: 0.5, peak_acceleration_m_s2: 5.0 }
}

/// The recall's input: noisy samples, and position and velocity as a filter estimates them.
struct Follower {
    motion: Motion,
    gauss: Gauss,
    recall: Recall<Translations>,
}

impl Follower {
    fn new(spec: &MotionSpec) -> Self {
        let motion = Motion::new(spec, Pose::IDENTITY).unwrap();
        Self { motion, gauss: Gauss::new(11), recall: Recall::new() }
    }

    fn see(&mut self, t_ns: i64) {
        let (pose, twist) = self.motion.state_at(t_ns);
        let p = DVec3::from_array(pose.position_m);
        let z = p + self.gauss.vector(SIGMA);
        let (about, v) = (p + self.gauss.vector(0.5 * SIGMA), DVec3::from_array(twist.linear_m_s));
        self.recall.push(t_ns, z, about, v + self.gauss.vector(0.01), SIGMA);
    }
}

#[test]
fn what_repeats_itself_is_found_with_its_own_period() {
    for (spec, period_ns) in
        [(sine(), 628_318_531), (shuttle(0.15, 0.0), 1_400_000_000), (shuttle(0.1, 0.3), 1_600_000_000)]
    {
        let mut body = Follower::new(&spec);
        let (mut found, mut late) = (0, 0);
        for i in 0..4500i64 {
            // Stamps off the grid by up to a quarter of the step.
            let t = i * STEP_NS + i * 7919 % (STEP_NS / 4);
            body.see(t);
            let Some(lag) = body.recall.lag_ns() else {
                late += i64::from(t > 2 * period_ns);
                continue;
            };
            found += 1;
            assert!(t > period_ns, "{spec:?}: nothing had been repeated at {t}");
            let off = lag - (lag + period_ns / 2) / period_ns * period_ns;
            assert!(off.abs() < 3_000_000, "{spec:?}: a lag of {lag} ns at {t}");
        }
        // At rest the place does not determine the time, so the recall may be lost.
        assert!(late < found, "{spec:?}: {late} samples without, {found} with");
    }
}

/// The recalled turn is the real one: over the whole motion the error is a fraction of the error without recall.
#[test]
fn what_is_recalled_is_what_happens() {
    for spec in [sine(), shuttle(0.15, 0.0)] {
        let mut body = Follower::new(&spec);
        let (mut error, mut nothing, mut n) = ([0.0; 2], [0.0; 2], 0);
        for i in 0..4500i64 {
            let t = i * STEP_NS;
            body.see(t);
            let Some(recalled) = body.recall.between(t, t + STEP_NS, f64::INFINITY) else { continue };
            n += 1;
            let at = |t: i64| {
                let (pose, twist) = body.motion.state_at(t);
                (DVec3::from_array(pose.position_m), DVec3::from_array(twist.linear_m_s))
            };
            let ((_, v0), (p1, v1), (p2, _)) = (at(t), at(t + STEP_NS), at(t + STEP_NS + AHEAD_NS));
            let faster = v1 - v0;
            let ahead = AHEAD_NS as f64 * 1e-9;
            let acceleration = (p2 - p1 - v1 * ahead) * (2.0 / (ahead * ahead));
            error[0] += (recalled.faster - faster).length_squared();
            nothing[0] += faster.length_squared();
            error[1] += (recalled.acceleration - acceleration).length_squared();
            nothing[1] += acceleration.length_squared();
        }
        assert!(n > 3000, "{n}");
        for (error, nothing) in error.iter().zip(nothing) {
            assert!(*error < 0.3 * nothing, "{spec:?}: {error} of {nothing}");
        }
    }
}

#[test]
fn bodies_at_rest_in_steady_motion_or_with_a_long_period_are_left_alone() {
    let steady = MotionSpec::shuttle(1.0, 100.0, 20.0);
    // 0.5 m/s over 1.5 m: a period of 6.2 s, of which five are kept.
    for spec in [MotionSpec::Still {}, steady, shuttle(0.75, 0.0)] {
        let mut body = Follower::new(&spec);
        for i in 0..7000 {
            body.see(i * STEP_NS);
            // The way back passes the same places in the other direction.
            assert_eq!(body.recall.lag_ns(), None, "{spec:?} at sample {i}");
        }
    }
}

/// A turn of 0.2 s falls between the samples of a slow tracker: below 150 Hz nothing is recalled, above it is.
#[test]
fn slow_trackers_recall_nothing() {
    for (step_ns, recalls) in [(10_000_000, false), (7_000_000, false), (6_000_000, true), (4_000_000, true)]
    {
        let mut body = Follower::new(&sine());
        let mut found = false;
        for i in 0..3_000_000_000 / step_ns {
            body.see(i * step_ns);
            found |= body.recall.lag_ns().is_some();
        }
        assert_eq!(found, recalls, "a sample every {step_ns} ns");
    }
}

/// A body that turns where it always turned, until it goes straight on: the recall is dropped before it has gone 3 cm
/// further.
#[test]
fn another_way_is_noticed() {
    let mut body = Follower::new(&shuttle(0.15, 0.0));
    // Within the stretch of the fifth cycle, 40 ms before its turn.
    let leaves = 4 * 1_400_000_000 + 210_000_000;
    let mut t = 0;
    while t < leaves {
        body.see(t);
        t += STEP_NS;
    }
    assert!(body.recall.lag_ns().is_some());
    let (pose, twist) = body.motion.state_at(leaves);
    let (p, v) = (DVec3::from_array(pose.position_m), DVec3::from_array(twist.linear_m_s));
    while body.recall.lag_ns().is_some() {
        let here = p + v * ((t - leaves) as f64 * 1e-9);
        let z = here + body.gauss.vector(SIGMA);
        body.recall.push(t, z, here, v, SIGMA);
        t += STEP_NS;
        assert!(t - leaves < 100_000_000, "40 ms to the turn, 60 ms beyond it");
    }
}

/// A single sample that is 3 mm off, which the gate of a fast body accepts, does not end a recall; it is off along the
/// motion, across it, or both.
#[test]
fn one_wild_sample_is_not_enough() {
    let mut body = Follower::new(&sine());
    let mut wild = 0;
    for i in 0..4000 {
        let t = i * STEP_NS;
        if i % 100 != 99 || body.recall.lag_ns().is_none() {
            body.see(t);
            continue;
        }
        let (pose, twist) = body.motion.state_at(t);
        let (p, v) = (DVec3::from_array(pose.position_m), DVec3::from_array(twist.linear_m_s));
        let off = [DVec3::X, DVec3::Y, DVec3::ONE.normalize()][wild % 3] * 3e-3;
        body.recall.push(t, p + off, p, v, SIGMA);
        assert!(body.recall.lag_ns().is_some(), "given up at {t}");
        wild += 1;
    }
    assert!(wild > 20, "{wild}");
}

/// Tracks at both ends of time, where the rest of the first one is present during the second.
#[test]
fn no_instant_is_out_of_range() {
    let mut recall = Recall::<Translations>::new();
    let velocity = DVec3::new(0.5, 0.0, 0.0);
    for begin in [i64::MIN, 0, i64::MAX - 600 * STEP_NS] {
        for i in 0..600 {
            let t = begin + i * STEP_NS;
            let p = velocity * ((i % 200) as f64 * 2e-3);
            recall.push(t, p, p, velocity, SIGMA);
            let _ = recall.between(t, t.saturating_add(STEP_NS), f64::INFINITY);
        }
        recall.break_track();
    }
}

#[test]
fn gaps_end_a_recall_and_are_never_recalled() {
    let mut body = Follower::new(&sine());
    let mut t = 0;
    while t < 3_000_000_000 {
        body.see(t);
        t += STEP_NS;
    }
    assert!(body.recall.lag_ns().is_some());
    // 0.2 s without samples: the track continues with the next one.
    t += 200_000_000;
    body.recall.break_track();
    assert!(body.recall.lag_ns().is_none() && body.recall.between(t, t + STEP_NS, f64::INFINITY).is_none());
    let gap = t - 200_000_000..t;
    while t < 6_000_000_000 {
        body.see(t);
        if let (Some(lag), true) =
            (body.recall.lag_ns(), body.recall.between(t, t + STEP_NS, f64::INFINITY).is_some())
        {
            assert!(!gap.contains(&(t - lag)), "{t} recalls the gap");
        }
        t += STEP_NS;
    }
    assert!(body.recall.lag_ns().is_some(), "found again after the gap");
}

/// 99th percentile of the error 6 ms ahead, m, with the recall and without, along a path sampled every 0.1 ms.
fn with_and_without(path: &[f64]) -> [f64; 2] {
    let with = PoseFilterConfig::default();
    [with, with.without_recall()].map(|config| {
        let (mut filter, mut gauss, mut errors) = (PoseFilter::new(config), Gauss::new(3), Vec::new());
        for i in (0..path.len() - 60).step_by(20) {
            let at = HostTime(i as i64 * 100_000);
            let p = DVec3::X * path[i] + gauss.vector(SIGMA);
            filter.update(&TrackerSample {
                body: BodyIndex(0),
                pose: Pose { position_m: p.to_array(), rotation_xyzw: [0.0, 0.0, 0.0, 1.0] },
                tracked: true,
                mean_error_m: 0.0,
                covariance: None,
                sequence: i as u32,
                captured_at: at,
                received_at: at,
            });
            if let (Some(predicted), true) = (filter.predict(at.plus_ns(6_000_000)), i > 5_000) {
                errors
                    .push((DVec3::from_array(predicted.pose.position_m) - DVec3::X * path[i + 60]).length());
            }
        }
        errors.sort_by(f64::total_cmp);
        errors[errors.len() * 99 / 100]
    })
}

/// Position every 0.1 ms under an acceleration that depends on time, place and velocity.
fn path(start_velocity: f64, mut acceleration: impl FnMut(f64, f64) -> f64) -> Vec<f64> {
    let (mut x, mut v, h) = (0.0, start_velocity, 1e-4);
    (0..250_000)
        .map(|_| {
            let (here, a) = (x, acceleration(x, v));
            x += v * h + 0.5 * a * h * h;
            v += a * h;
            here
        })
        .collect()
}

/// The mean over three draws.
fn mean(draw: impl Fn(u64) -> [f64; 2]) -> [f64; 2] {
    let all = [21, 22, 23].map(draw);
    [0, 1].map(|i| all.iter().map(|d| d[i]).sum::<f64>() / 3.0)
}

/// Back and forth at 0.5 m/s with turns of 5 m/s^2, this share of them elsewhere than 0.1 m from the middle.
fn turns(seed: u64, share_elsewhere: f64) -> Vec<f64> {
    let mut random = Gauss::new(seed);
    let (mut end, mut way, mut turning) = (0.1, 1.0, false);
    path(0.5, |x, v| {
        if !turning && x * way > end {
            (turning, way) = (true, -way);
            let elsewhere = random.uniform() < share_elsewhere;
            end = if elsewhere { 0.02 + 0.13 * random.uniform() } else { 0.1 };
        }
        turning &= v * way < 0.5;
        if turning {
            5.0 * way
        } else {
            0.0
        }
    })
}

/// Stops 0.1 m to either side of the middle, and starts again after a random 0.1 to 0.5 s.
fn rests(seed: u64) -> Vec<f64> {
    let mut random = Gauss::new(seed);
    let (mut way, mut braking, mut rest) = (1.0, false, 0u32);
    path(0.0, |x, v| {
        if rest > 0 {
            rest -= 1;
            return 0.0;
        }
        // 0.5 m/s at 5 m/s^2 take 25 mm.
        braking |= x * way > 0.075;
        if braking && v * way < 1e-6 {
            (way, braking, rest) = (-way, false, 1000 + (4000.0 * random.uniform()) as u32);
            return 0.0;
        }
        if braking {
            -5.0 * way
        } else if v * way < 0.5 {
            5.0 * way
        } else {
            0.0
        }
    })
}

/// An acceleration that wanders by `strength` within about `lasts` seconds, on a spring with damping.
fn wandering(seed: u64, [lasts, strength, damping, pull]: [f64; 4]) -> Vec<f64> {
    let kick = strength * (2e-4 / lasts).sqrt();
    let (mut random, mut a) = (Gauss::new(seed), 0.0);
    path(0.0, |x, v| {
        a += kick * random.normal() - a * 1e-4 / lasts;
        a - damping * v - pull * x
    })
}

/// The accuracy target at half a metre a second, for every motion at that pace: 0.25 mm at the 99th percentile, from
/// the first frame on, and so including the passes for which there is no past yet.
#[test]
fn misplacement_at_half_a_metre_a_second() {
    let rig = EvaluationConfig::with_noise(SIGMA, 1e-3);
    let circle =
        MotionSpec::Rotate { axis: [0.0, 0.0, 1.0], rate_rad_s: 10.0, pivot_offset_m: [0.05, 0.0, 0.0] };
    for spec in
        [sine(), shuttle(0.05, 0.0), shuttle(0.15, 0.0), shuttle(0.5, 0.0), shuttle(0.15, 0.2), circle]
    {
        let e = evaluate(&spec, PoseFilterConfig::default(), &rig).unwrap();
        assert!(e.position_m.p99 <= 0.25e-3, "{spec:?}: {:?}", e.position_m);
    }
}

/// Minutes of motion.
mod breadth {
    use super::*;

    /// Turns anywhere, or half of the time where they were before, starts at any time, and accelerations that wander: at
    /// most 3 % worse than without. `cargo test -p dpm-tracking --lib bodies_that_do_not_repeat -- --nocapture` prints the
    /// table of `docs/lab/PREDICTION.md`.
    #[test]
    fn bodies_that_do_not_repeat_themselves_are_no_worse_off() {
        type Draw = dyn Fn(u64) -> Vec<f64>;
        let cases: [(&str, &Draw); 5] = [
            ("to and fro, each turn anywhere within 0.15 m", &|seed| turns(seed, 1.0)),
            ("to and fro, every other turn elsewhere", &|seed| turns(seed, 0.5)),
            ("start and stop at the same places, at rest for 0.1 to 0.5 s", &rests),
            ("acceleration wandering, 5 m/s2 over 0.1 s", &|seed| wandering(seed, [0.1, 5.0, 10.0, 100.0])),
            ("acceleration wandering, 3 m/s2 over 0.3 s", &|seed| wandering(seed, [0.3, 3.0, 4.0, 20.0])),
        ];
        println!(
            "| motion, 0.5 m/s and 5 m/s2 where it turns | without the fifth filter | with |\n|---|---|---|"
        );
        for (name, path) in cases {
            let [with, without] = mean(|seed| with_and_without(&path(seed)));
            println!("| {name} | {:.3} mm | {:.3} mm |", 1e3 * without, 1e3 * with);
            assert!(with < 1.03 * without, "{with} against {without}: {name}");
        }
    }
}
