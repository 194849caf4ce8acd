//! Guarantees of the mock tracker: timing, statistics, determinism, and each fault with its count.

use super::*;
use crate::motion::MotionSpec;

const MS: i64 = 1_000_000;
const S: i64 = 1_000 * MS;

fn moving() -> Motion {
    Motion::new(&MotionSpec::paper_translation(), Pose::IDENTITY).unwrap()
}

fn tracker(faults: &str, change: impl FnOnce(&mut MockTrackerConfig)) -> MockTracker {
    let mut config = MockTrackerConfig { faults: faults.parse().unwrap(), ..Default::default() };
    change(&mut config);
    MockTracker::new(config, vec![moving()]).unwrap()
}

/// Polls every `step` until `until`; checks the guarantees of the trait if the tracker is gated.
fn run(tracker: &mut MockTracker, step: i64, until: i64) -> Vec<TrackerSample> {
    let mut all: Vec<TrackerSample> = Vec::new();
    for now in (0..=until).step_by(step as usize) {
        let gated = tracker.source.config.gated;
        let from = all.len();
        let n = tracker.poll(HostTime(now), &mut |s| all.push(*s)).unwrap();
        assert_eq!(n, all.len() - from);
        assert!(all[from..]
            .iter()
            .all(|s| s.received_at.0 <= now && s.received_at.0 > now - step || now == 0));
        assert!(!gated || all.windows(2).all(|w| w[0].captured_at < w[1].captured_at));
        assert!(tracker.counters().is_conserved());
    }
    all
}

#[test]
fn samples_arrive_at_capture_plus_latency_at_the_rate_asked_for() {
    let mut t = tracker("", |c| {
        c.rate = FrameRate::new(947, 2).unwrap();
        c.phase_ns = 333_333;
        c.latency_ns = 3_100_000;
    });
    let samples = run(&mut t, 100_000, 2 * S);
    // Captures k with 333,333 + k * 2e9 / 947 + 3.1 ms <= 2 s.
    assert_eq!(samples.len() as u64, FrameRate::new(947, 2).unwrap().slot_at_ns(2 * S - 3_433_333) + 1);
    for (k, s) in samples.iter().enumerate() {
        assert_eq!(s.captured_at.0, 333_333 + (k as i128 * 2_000_000_000 / 947) as i64);
        assert_eq!(s.received_at.0 - s.captured_at.0, 3_100_000);
        assert_eq!(s.sequence as usize, k);
        assert_eq!(s.pose, t.true_pose(BodyIndex(0), s.captured_at.0).unwrap());
    }
}

#[test]
fn how_often_one_polls_changes_nothing() {
    let faults = "loss=0.05,duplicate=0.1,reorder=0.1,nan=0.02,invalid=0.03,stall@300ms+40ms,jump=1@0.5s,slow=1ms@0.7s+50ms";
    let noisy = |c: &mut MockTrackerConfig| {
        c.position_noise_m = 1e-4;
        c.rotation_noise_rad = 1e-3;
        c.latency_jitter_ns = 900_000;
        c.start = HostTime(0);
    };
    let fine = run(&mut tracker(faults, noisy), 50_000, S);
    let coarse = run(&mut tracker(faults, noisy), 10 * MS, S);
    assert_eq!(fine, coarse);
    assert!(fine.len() > 400);
    let other = run(
        &mut tracker(faults, |c| {
            noisy(c);
            c.seed = 2;
        }),
        10 * MS,
        S,
    );
    assert_ne!(fine, other);
}

#[test]
fn noise_has_the_deviation_asked_for() {
    let mut t = tracker("", |c| {
        c.position_noise_m = 1e-3;
        c.rotation_noise_rad = 2e-3;
    });
    let samples = run(&mut t, 100 * MS, 40 * S);
    let (mut position, mut rotation) = (0.0, 0.0);
    for s in &samples {
        let truth = t.true_pose(BodyIndex(0), s.captured_at.0).unwrap();
        position += (0..3).map(|i| (s.pose.position_m[i] - truth.position_m[i]).powi(2)).sum::<f64>();
        // Rest rotation is the identity: the rotation vector is twice the vector part.
        rotation += (0..3).map(|i| (2.0 * s.pose.rotation_xyzw[i]).powi(2)).sum::<f64>();
    }
    let n = 3.0 * samples.len() as f64;
    // Five standard errors of a variance: 5 sqrt(2/n) = 2.9 %.
    assert!((position / n / 1e-6 - 1.0).abs() < 5.0 * (2.0 / n).sqrt());
    assert!((rotation / n / 4e-6 - 1.0).abs() < 5.0 * (2.0 / n).sqrt() + 1e-4);
}

#[test]
fn each_fault_shows_in_its_own_counter() {
    let count = |faults: &str| {
        let mut t = tracker(faults, |_| {});
        let samples = run(&mut t, MS, 10 * S);
        (samples, *t.counters())
    };
    let all = 5000 - 1; // The last capture at 9.998 s + 2 ms is in; the one at 10 s is not.
    let near = |x: u64, p: f64| {
        let sigma = (5000.0 * p * (1.0 - p)).sqrt();
        assert!((x as f64 - 5000.0 * p).abs() < 5.0 * sigma, "{x} of 5000 at {p}");
    };
    let (_, c) = count("loss=0.1");
    near(c.lost, 0.1);
    let (samples, c) = count("duplicate=0.1");
    near(c.samples.duplicate, 0.1);
    assert!(samples.len() >= all);
    let (_, c) = count("reorder=0.1");
    // Late unless its successor was delayed too: p (1 - p).
    near(c.samples.late, 0.09);
    let (_, c) = count("nan=0.1");
    near(c.samples.not_finite + c.samples.out_of_reach + c.samples.bad_rotation, 0.1);
    assert!(c.samples.not_finite > 100 && c.samples.out_of_reach > 10);
    let (_, c) = count("norm=0.1");
    near(c.samples.bad_rotation, 0.1);
    let (samples, c) = count("flip=0.5");
    assert_eq!(c.samples.dropped(), 0);
    near(samples.iter().filter(|s| s.pose.rotation_xyzw[3] < 0.0).count() as u64, 0.5);
    let (samples, c) = count("invalid@1s+6ms/1s");
    assert_eq!(c.untracked, 9 * 3);
    assert!(samples.iter().all(|s| s.pose.is_valid(1e-9)));
}

#[test]
fn windows_strike_exactly_the_samples_inside() {
    // T1: three samples missing at 500 Hz.
    let samples = run(&mut tracker("dropout@1s+6ms", |_| {}), MS, 2 * S);
    let missing: Vec<i64> =
        (0..999).map(|k| k * 2 * MS).filter(|t| !samples.iter().any(|s| s.captured_at.0 == *t)).collect();
    assert_eq!(missing, [1000 * MS, 1002 * MS, 1004 * MS]);
    // T4: stuck repeats pose and noise, but not the sequence numbers.
    let mut t = tracker("stuck@1s+100ms", |c| c.position_noise_m = 1e-3);
    let samples = run(&mut t, MS, 2 * S);
    assert_eq!(samples.len(), 1000);
    assert!(samples[500..550].iter().all(|s| s.pose == samples[499].pose));
    assert_ne!(samples[550].pose, samples[499].pose);
    assert_eq!(t.counters().stuck, 1);
    // T6: one sample 3 m off.
    let t = tracker("jump=3@1.0001s", |_| {});
    let off = |k: u64| {
        let s = t.source.sample(BodyIndex(0), k).unwrap();
        let p = t.true_pose(BodyIndex(0), s.captured_at.0).unwrap().position_m;
        (0..3).map(|i| (s.pose.position_m[i] - p[i]).powi(2)).sum::<f64>().sqrt()
    };
    assert_eq!((0..1000).filter(|k| off(*k) > 1e-9).collect::<Vec<_>>(), [501]);
    assert!((off(501) - 3.0).abs() < 1e-12);
    // Stall: nothing for 50 ms, then all of it at once, in order.
    let samples = run(&mut tracker("stall@1s+50ms", |_| {}), MS, 2 * S);
    let held = samples.iter().filter(|s| s.received_at.0 == 1050 * MS).count();
    assert_eq!(samples.len(), 1000);
    assert_eq!(held, 26);
    assert!(!samples.iter().any(|s| (1000 * MS..1050 * MS).contains(&s.received_at.0)));
    // T11: the counter restarts, the samples continue.
    let mut t = tracker("reset@1s", |_| {});
    let samples = run(&mut t, MS, 2 * S);
    assert_eq!((samples.len(), samples[499].sequence, samples[500].sequence), (1000, 499, 0));
    assert_eq!((t.counters().restarts, t.counters().lost), (1, 0));
}

#[test]
fn ungated_faults_reach_the_consumer() {
    let raw = |c: &mut MockTrackerConfig| c.gated = false;
    let samples = run(&mut tracker("nan=0.05,reorder=0.1,duplicate=0.1", raw), MS, 4 * S);
    assert!(samples.iter().any(|s| !s.pose.is_valid(1e-3)));
    assert!(samples.windows(2).any(|w| w[1].captured_at < w[0].captured_at));
    assert!(samples.len() > 2100);
}

#[test]
fn work_per_poll_is_bounded_and_polling_backwards_is_harmless() {
    let mut t = tracker("", |_| {});
    let mut n = 0;
    t.poll(HostTime(400 * 86_400 * S), &mut |_| n += 1).unwrap();
    assert!(n as u64 <= MockTracker::MAX_CAPTURES_PER_POLL);
    assert!(t.status().contains("skipped"));
    let now = HostTime(400 * 86_400 * S + 2 * MS);
    assert_eq!(t.poll(HostTime(0), &mut |_| {}).unwrap(), 0);
    assert_eq!(t.poll(now, &mut |_| {}).unwrap(), 1);
    assert_eq!(t.poll(HostTime(i64::MIN), &mut |_| {}).unwrap(), 0);
}

#[test]
fn nonsense_is_named() {
    let refused = |change: fn(&mut MockTrackerConfig), word: &str| {
        let mut config = MockTrackerConfig::default();
        change(&mut config);
        let error = MockTracker::new(config, vec![moving()]).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains(word), "{error}");
    };
    refused(|c| c.position_noise_m = f64::NAN, "position_noise_m");
    refused(|c| c.rotation_noise_rad = -1.0, "rotation_noise_rad");
    refused(|c| c.latency_ns = -1, "latency_ns");
    refused(|c| c.latency_jitter_ns = i64::MAX, "latency_jitter_ns");
    refused(|c| c.phase_ns = 3 * MS, "phase_ns");
    refused(|c| c.rate = FrameRate::new(1, 3600).unwrap(), "rate");
    refused(|c| c.faults = "corrupt=0.1".parse().unwrap(), "corrupt");
    assert!(MockTracker::new(MockTrackerConfig::default(), vec![]).is_err());
}
