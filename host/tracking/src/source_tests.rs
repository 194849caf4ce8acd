//! Laws of several sources that see the same body: every sample counts, in whatever order it comes.

use super::super::testing::Gauss;
use super::*;
use dpm_common::so3::so3_exp;
use dpm_device::pose::{Pose, PoseCovariance};
use dpm_device::tracker::BodyIndex;

/// Of a camera at 30 Hz.
const PERIOD_NS: i64 = 33_333_333;
/// Errors of a sample along and about each axis, m and rad.
const NOISE: [f64; 2] = [1e-3, 5e-3];

type Place = (DVec3, DQuat);

fn glide(s: f64) -> Place {
    (DVec3::new(0.2, -0.1, 0.05) * s, so3_exp(DVec3::new(0.3, -0.5, 0.2) * s))
}

/// As a hand swings a cup: 1.6 m/s^2 at most.
fn swing(s: f64) -> Place {
    let (x, y) = ((5.1 * s).sin(), (3.3 * s).cos());
    (DVec3::new(0.06 * x, 0.05 * y, 0.02 * x), so3_exp(DVec3::new(0.2 * x, 0.4 * y, 0.1 * x)))
}

fn sample(motion: fn(f64) -> Place, at_ns: i64, noise: &mut Gauss) -> TrackerSample {
    let (position, rotation) = motion(at_ns as f64 * 1e-9);
    let (position, rotation) =
        (position + noise.vector(NOISE[0]), so3_exp(noise.vector(NOISE[1])) * rotation);
    let variance = |i: usize| NOISE[i / 3] * NOISE[i / 3];
    let covariance = std::array::from_fn(|i| std::array::from_fn(|j| if i == j { variance(i) } else { 0.0 }));
    TrackerSample {
        body: BodyIndex(0),
        pose: Pose { position_m: position.to_array(), rotation_xyzw: rotation.normalize().to_array() },
        tracked: true,
        mean_error_m: 1e-3,
        covariance: Some(PoseCovariance::of(&covariance)),
        sequence: 0,
        captured_at: HostTime(at_ns),
        received_at: HostTime(at_ns + 2 * PERIOD_NS),
    }
}

fn config(source_period_ns: i64) -> PoseFilterConfig {
    PoseFilterConfig { source_period_ns, lost_after_ns: 200_000_000, ..PoseFilterConfig::default() }
}

/// What the filter makes of runs.
#[derive(Default)]
struct Outcome {
    /// Sums of squared errors, m^2 and rad^2.
    squares: [f64; 2],
    /// Errors along and about single axes, and of these those within 1.96 standard deviations.
    count: f64,
    within: [f64; 2],
}

impl Outcome {
    fn deviation(&self, k: usize) -> f64 {
        (self.squares[k] / self.count).sqrt()
    }

    fn coverage(&self, k: usize) -> f64 {
        self.within[k] / self.count
    }
}

/// Runs of 45 pictures of each source, of which source i exposes `lags_ns[i]` before the first; at each picture, the first one's
/// sample comes first. Judged at the end of each run.
fn outcome(motion: fn(f64) -> Place, lags_ns: &[i64], runs: u64) -> Outcome {
    let mut outcome = Outcome::default();
    for run in 0..runs {
        let mut noise = Gauss::new(1_000 + run);
        let mut filter = PoseFilter::new(config(if lags_ns.len() > 1 { PERIOD_NS } else { 0 }));
        let begin_ns = 1_000_000_000 + run as i64 * 37_000_000;
        let mut at_ns = begin_ns;
        for k in 0..45 {
            at_ns = begin_ns + k * PERIOD_NS;
            for lag in lags_ns {
                let verdict = filter.update(&sample(motion, at_ns - lag, &mut noise));
                assert!(k < 8 || verdict.is_accepted(), "{k}, {lag}: {verdict:?}");
            }
        }
        assert_eq!(filter.counters().acquired, 1, "one track");
        let state = filter.state().expect("a track");
        let (position, rotation) = motion(state.captured_at.0 as f64 * 1e-9);
        assert_eq!(state.captured_at.0, at_ns);
        let errors = [state.position.mean.point - position, so3_between(rotation, state.rotation.mean.point)];
        let variances = [state.position.covariance, state.rotation.covariance];
        for (k, (error, variances)) in errors.iter().zip(variances).enumerate() {
            outcome.squares[k] += error.length_squared();
            for (error, variance) in error.to_array().iter().zip(variances) {
                outcome.within[k] += f64::from(error.abs() < 1.96 * variance.pp.sqrt());
            }
        }
        outcome.count += 3.0;
    }
    outcome
}

const RUNS: u64 = 800;

/// Four standard deviations of the ratio of two roots of so many squares of normal deviates, for a ratio of 1 / sqrt(2).
fn ratio_bound() -> f64 {
    4.0 * (1.0 / (3 * RUNS) as f64).sqrt() * 0.5f64.sqrt()
}

/// What a share of so many must reach if it is 0.95.
fn least_coverage() -> f64 {
    0.95 - 4.0 * (0.95 * 0.05 / (3 * RUNS) as f64).sqrt()
}

/// Two sources of independent and equal noise halve the variance, at one instant and at nearly one.
#[test]
fn two_sources_at_one_instant_err_by_a_root_of_two_less() {
    let one = outcome(glide, &[0], RUNS);
    for lag_ns in [0, 300, 40_000] {
        let two = outcome(glide, &[0, lag_ns], RUNS);
        for k in 0..2 {
            let ratio = two.deviation(k) / one.deviation(k);
            assert!((ratio - 0.5f64.sqrt()).abs() < ratio_bound(), "{lag_ns}, {k}: {ratio}");
            let coverage = two.coverage(k);
            assert!(coverage > least_coverage() && coverage < 0.995, "{lag_ns}, {k}: {coverage}");
        }
    }
}

/// A swinging body: what comes late from a source is worth something still, the less the older it is, and the filter says so.
#[test]
fn a_late_source_helps_and_its_share_is_stated() {
    let outcomes =
        [&[0][..], &[0, 25_000_000], &[0, 10_000_000], &[0, 0]].map(|lags| outcome(swing, lags, RUNS));
    for k in 0..2 {
        let errors = outcomes.each_ref().map(|outcome| outcome.deviation(k));
        assert!(errors.windows(2).all(|two| two[1] < 0.97 * two[0]), "{k}: {errors:?}");
        let coverages = outcomes.each_ref().map(|outcome| outcome.coverage(k));
        assert!(coverages.iter().all(|c| *c > least_coverage()), "{k}: {coverages:?}");
    }
}

/// For a single source nothing depends on the setting, bit for bit; what is doubled or overtaken changes nothing without it.
#[test]
fn a_single_source_is_judged_as_ever() {
    let mut noise = Gauss::new(3);
    let mut filters = [0, PERIOD_NS].map(|period| PoseFilter::new(config(period)));
    for k in 0..200 {
        let sample = sample(swing, k * PERIOD_NS, &mut noise);
        let verdicts = filters.each_mut().map(|filter| filter.update(&sample));
        assert_eq!(verdicts[0], verdicts[1]);
        let states =
            filters.each_ref().map(|filter| filter.state().map(|s| (s.position, s.rotation, s.continuation)));
        assert_eq!(states[0], states[1], "{k}");
    }
    let mut alone = filters[0].clone();
    let other = sample(swing, 199 * PERIOD_NS, &mut noise);
    assert_eq!(alone.update(&other), Verdict::Duplicate);
    assert_eq!(alone.update(&sample(swing, 199 * PERIOD_NS - 1, &mut noise)), Verdict::OutOfOrder);
    assert_eq!(alone.state(), filters[0].state());
    // Of several sources both count, and what is more than a picture late does not.
    assert_eq!(filters[1].update(&other), Verdict::Accepted);
    assert_eq!(filters[1].update(&sample(swing, 198 * PERIOD_NS + 1, &mut noise)), Verdict::Accepted);
    assert_ne!(alone.state(), filters[1].state());
    let state = filters[1].state();
    assert_eq!(filters[1].update(&sample(swing, 198 * PERIOD_NS, &mut noise)), Verdict::OutOfOrder);
    assert_eq!(state, filters[1].state());
}

/// Two sources that expose shortly after each other, and not again for a picture: what lies between their samples is no rate, and
/// the track is carried over the longer gap.
#[test]
fn sources_one_after_the_other_keep_one_track() {
    let mut noise = Gauss::new(4);
    let mut filter = PoseFilter::new(config(PERIOD_NS));
    for k in 1..200 {
        for at_ns in [k * PERIOD_NS, k * PERIOD_NS + 1_000_000] {
            let verdict = filter.update(&sample(swing, at_ns, &mut noise));
            assert!(k < 8 || verdict == Verdict::Accepted, "{k}: {verdict:?}");
        }
    }
    assert_eq!(filter.counters().acquired, 1);
}

/// A source whose place is wrong changes nothing of a track that others hold.
#[test]
fn a_source_that_contradicts_is_set_aside() {
    let mut noise = Gauss::new(5);
    let mut filter = PoseFilter::new(config(PERIOD_NS));
    for k in 1..60 {
        filter.update(&sample(glide, k * PERIOD_NS, &mut noise));
        let mut wrong = sample(glide, k * PERIOD_NS, &mut noise);
        wrong.pose.position_m[0] += 0.3;
        let before = filter.state();
        assert!(!filter.update(&wrong).is_accepted());
        assert_eq!(before, filter.state());
    }
}
