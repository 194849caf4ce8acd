//! Laws of the closed-form motions: derivative, bounds, periodicity, and refusal of invalid ones.

use super::*;

const S: i64 = 1_000_000_000;

fn rest() -> Pose {
    let q = normalize4([0.1, -0.2, 0.3, 0.9]);
    Pose { position_m: [0.2, -0.1, 1.5], rotation_xyzw: q }
}

fn all_kinds() -> Vec<MotionSpec> {
    let rotate = |rate| MotionSpec::Rotate {
        axis: [1.0, 2.0, 0.5],
        rate_rad_s: rate,
        pivot_offset_m: [0.1, 0.0, -0.2],
    };
    let screw = MotionSpec::Screw {
        axis: [0.0, 0.0, 2.0],
        rate_rad_s: 4.0,
        speed_m_s: 0.5,
        amplitude_m: 0.2,
        acceleration_m_s2: 5.0,
    };
    let sway =
        MotionSpec::Sway { axis: [1.0, 0.0, 0.0], peak_rate_rad_s: 3.0, peak_acceleration_rad_s2: 20.0 };
    let sinusoid =
        MotionSpec::Sinusoid { direction: [1.0, 1.0, 0.0], peak_speed_m_s: 0.5, peak_acceleration_m_s2: 5.0 };
    let together =
        MotionSpec::Together { parts: vec![rotate(2.0), sinusoid.clone(), sway.clone(), rotate(-7.0)] };
    vec![
        MotionSpec::Still {},
        MotionSpec::paper_translation(),
        sinusoid,
        rotate(3.0),
        rotate(-100.0),
        screw,
        sway,
        together,
    ]
}

/// Angular velocity from two rotations `dt` apart, world axes: the logarithm of `b * a^-1` over dt.
fn angular_between(a: [f64; 4], b: [f64; 4], dt: f64) -> [f64; 3] {
    let mut d = multiply(b, [-a[0], -a[1], -a[2], a[3]]);
    if d[3] < 0.0 {
        d = d.map(|c| -c);
    }
    let n = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
    let k = if n > 0.0 { 2.0 * n.atan2(d[3]) / n } else { 2.0 };
    [d[0] * k / dt, d[1] * k / dt, d[2] * k / dt]
}

#[test]
fn velocity_is_the_derivative_of_the_pose() {
    let h = 10_000; // 10 us: central differences are exact to h^2 times the third derivative.
    for spec in all_kinds() {
        let motion = Motion::new(&spec, rest()).unwrap();
        for t in (-2 * S..3 * S).step_by(7_654_321) {
            let (a, b) = (motion.pose_at(t - h), motion.pose_at(t + h));
            let twist = motion.twist_at(t);
            let dt = 2.0 * h as f64 * 1e-9;
            let angular = angular_between(a.rotation_xyzw, b.rotation_xyzw, dt);
            for i in 0..3 {
                let linear = (b.position_m[i] - a.position_m[i]) / dt;
                // A turn's acceleration is a step, so near it the central difference errs by up to h * acceleration = 2e-4.
                assert!((linear - twist.linear_m_s[i]).abs() < 3e-4, "{spec:?} at {t}: {linear} {twist:?}");
                assert!(
                    (angular[i] - twist.angular_rad_s[i]).abs() < 3e-4,
                    "{spec:?} at {t}: {angular:?} {twist:?}"
                );
            }
        }
    }
}

#[test]
fn translation_keeps_speed_acceleration_and_amplitude() {
    let motion = Motion::new(&MotionSpec::paper_translation(), Pose::IDENTITY).unwrap();
    assert_eq!(motion.twist_at(0).linear_m_s, [-1.0, 0.0, 0.0]);
    assert_eq!(motion.pose_at(0).position_m[0], 0.0);
    let (mut full_speed, mut n, mut largest) = (0, 0, 0.0f64);
    let step = 100_000;
    let mut before = motion.state_at(-step);
    for t in (0..4 * S).step_by(step as usize) {
        let now = motion.state_at(t);
        let (x, v) = (now.0.position_m[0], now.1.linear_m_s[0]);
        assert!(v.abs() <= 1.0 + 1e-12);
        let dv = (v - before.1.linear_m_s[0]).abs();
        assert!(dv <= 20.0 * step as f64 * 1e-9 + 1e-12, "acceleration above its bound at {t}");
        assert!((x - before.0.position_m[0]).abs() <= step as f64 * 1e-9 + 1e-12);
        largest = largest.max(x.abs());
        full_speed += i32::from(v.abs() > 1.0 - 1e-12);
        n += 1;
        before = now;
    }
    // The turning point falls between two steps: the miss is at most a (step/2)^2 / 2.
    assert!((largest - 0.15).abs() < 1e-7, "{largest}");
    // Stretch 2 (0.15 - 0.025) / 1 = 0.25 s, turn 2 * 1 / 20 = 0.1 s: 25 of 35 parts at full speed.
    assert!((f64::from(full_speed) / f64::from(n) - 25.0 / 35.0).abs() < 0.02);
}

#[test]
fn sinusoid_has_the_peaks_asked_for() {
    let spec =
        MotionSpec::Sinusoid { direction: [0.0, 3.0, 0.0], peak_speed_m_s: 0.5, peak_acceleration_m_s2: 5.0 };
    let motion = Motion::new(&spec, Pose::IDENTITY).unwrap();
    assert!((motion.twist_at(0).linear_m_s[1] - 0.5).abs() < 1e-8);
    let quarter = (core::f64::consts::FRAC_PI_2 * 0.1 * 1e9) as i64;
    assert!((motion.pose_at(quarter).position_m[1] - 0.05).abs() < 1e-9);
    assert!(motion.twist_at(quarter).linear_m_s[1].abs() < 1e-7);
    let dv =
        motion.twist_at(quarter + 500_000).linear_m_s[1] - motion.twist_at(quarter - 500_000).linear_m_s[1];
    assert!((dv / 1e-3 + 5.0).abs() < 1e-4);
}

#[test]
fn rotation_turns_in_place_and_is_on_time_after_400_days() {
    let rate = core::f64::consts::PI;
    let spec = MotionSpec::Rotate { axis: [0.0, 1.0, 0.0], rate_rad_s: rate, pivot_offset_m: [0.0; 3] };
    let motion = Motion::new(&spec, rest()).unwrap();
    for day in [0, 1, 400] {
        let t = day * 86_400 * S;
        let pose = motion.pose_at(t + S / 2);
        assert_eq!(pose.position_m, rest().position_m);
        // A quarter turn about +y after half a second, on any day: the period is exactly 2 s.
        let h = core::f64::consts::FRAC_1_SQRT_2;
        let expected = multiply([0.0, h, 0.0, h], rest().rotation_xyzw);
        for (a, b) in pose.rotation_xyzw.iter().zip(expected) {
            assert!((a - b).abs() < 1e-14);
        }
    }
}

#[test]
fn motions_repeat_and_stay_rigid_at_the_ends_of_time() {
    for spec in all_kinds() {
        let motion = Motion::new(&spec, rest()).unwrap();
        for t in [i64::MIN, i64::MIN + 1, -1, 0, 1, i64::MAX - 1, i64::MAX] {
            let pose = motion.pose_at(t);
            assert!(pose.is_valid(1e-12), "{spec:?} at {t}: {pose:?}");
        }
    }
    let motion = Motion::new(&MotionSpec::paper_translation(), rest()).unwrap();
    let period = 700_000_000; // 2 (0.25 + 0.1) s
    for t in (0..period).step_by(1_234_567) {
        assert_eq!(motion.pose_at(t), motion.pose_at(t + period * 49_371_428));
        let mirrored = motion.pose_at(t + period / 2).position_m[0] - 0.2;
        assert!((motion.pose_at(t).position_m[0] - 0.2 + mirrored).abs() < 1e-12);
    }
}

#[test]
fn nonsense_is_named() {
    let bad = |spec: &MotionSpec| Motion::new(spec, Pose::IDENTITY).unwrap_err().to_string();
    let translate = MotionSpec::shuttle;
    assert!(bad(&translate(f64::NAN, 1.0, 1.0)).contains("speed_m_s"));
    assert!(bad(&translate(1.0, -1.0, 1.0)).contains("amplitude_m"));
    assert!(bad(&translate(1.0, 1.0, f64::INFINITY)).contains("acceleration_m_s2"));
    assert!(bad(&translate(1.0, 0.1, 1.0)).contains("0.5 m"), "{}", bad(&translate(1.0, 0.1, 1.0)));
    assert!(Motion::new(&translate(1e6, 1e6, 1e6), Pose::IDENTITY).is_ok());
    let rotate = |axis, rate_rad_s| MotionSpec::Rotate { axis, rate_rad_s, pivot_offset_m: [0.0; 3] };
    assert!(bad(&rotate([0.0; 3], 1.0)).contains("axis"));
    assert!(bad(&rotate([0.0, 1.0, 0.0], 1e9)).contains("rate_rad_s"));
    assert!(bad(&rotate([0.0, 1.0, 0.0], 1e-9)).contains("cycle"));
    assert!(bad(&MotionSpec::Together { parts: vec![] }).contains("parts"));
    let nested =
        MotionSpec::Together { parts: vec![MotionSpec::Together { parts: vec![MotionSpec::Still {}] }] };
    assert!(bad(&nested).contains("parts"));
    let crooked = Pose { rotation_xyzw: [0.0, 0.0, 0.0, 2.0], ..Pose::IDENTITY };
    assert!(Motion::new(&MotionSpec::Still {}, crooked).is_err());
}

/// 0.5 m/s and 5 m/s^2 within 0.15 m of the centre, at rest for 0.3 s at either end: stretches of 0.4 s, braking of 0.1 s.
#[test]
fn a_turn_may_rest_in_its_middle() {
    let spec = |rest_s| MotionSpec::Translate {
        direction: [1.0, 0.0, 0.0],
        speed_m_s: 0.5,
        amplitude_m: 0.125,
        acceleration_m_s2: 5.0,
        rest_s,
    };
    let motion = Motion::new(&spec(0.3), Pose::IDENTITY).unwrap();
    let x = |ms: i64| motion.pose_at(ms * 1_000_000).position_m[0];
    let v = |ms: i64| motion.twist_at(ms * 1_000_000).linear_m_s[0];
    for (at_ms, place, speed) in [
        (0, 0.0, 0.5),
        (200, 0.1, 0.5),
        (300, 0.125, 0.0),
        (450, 0.125, 0.0),
        (600, 0.125, 0.0),
        (700, 0.1, -0.5),
    ] {
        for (t, sign) in [(at_ms, 1.0), (at_ms + 900, -1.0), (at_ms + 1800, 1.0), (at_ms - 900, -1.0)] {
            assert!((x(t) - sign * place).abs() < 1e-12, "{} at {t} ms", x(t));
            assert!((v(t) - sign * speed).abs() < 1e-8, "{} at {t} ms", v(t));
        }
    }
    assert!(x(650) < 0.125 && x(650) > 0.1 && v(650) < -0.2);
    let without = Motion::new(&spec(0.0), Pose::IDENTITY).unwrap();
    assert_eq!(without.pose_at(600_000_000).position_m[0], without.pose_at(0).position_m[0]);
    assert!(matches!(
        Motion::new(&spec(-1.0), Pose::IDENTITY),
        Err(MotionError::OutOfRange { field: "rest_s", .. })
    ));
    assert!(Motion::new(&spec(f64::NAN), Pose::IDENTITY).is_err());
}

#[test]
fn specs_are_read_with_defaults_and_unknown_keys_refused() {
    let spec: MotionSpec = serde_json::from_str(r#"{"kind":"translate"}"#).unwrap();
    assert_eq!(spec, MotionSpec::paper_translation());
    assert!(serde_json::from_str::<MotionSpec>(r#"{"kind":"translate","sped_m_s":2}"#).is_err());
    assert!(serde_json::from_str::<MotionSpec>(r#"{"kind":"fly"}"#).is_err());
    for spec in all_kinds() {
        let text = serde_json::to_string(&spec).unwrap();
        assert_eq!(serde_json::from_str::<MotionSpec>(&text).unwrap(), spec);
    }
}

/// A recording of a motion is that motion, as well as cubic polynomials can be it, and its velocity is that of its poses.
#[test]
fn a_recording_goes_through_its_poses() {
    let sway =
        MotionSpec::Sway { axis: [0.3, 1.0, -0.2], peak_rate_rad_s: 2.0, peak_acceleration_rad_s2: 20.0 };
    let wave = MotionSpec::Sinusoid {
        direction: [1.0, 0.5, -0.3],
        peak_speed_m_s: 0.8,
        peak_acceleration_m_s2: 5.0,
    };
    let parts = vec![sway, wave];
    let truth = Motion::new(&MotionSpec::Together { parts }, Pose::IDENTITY).unwrap();
    let step_ns = 5_000_000;
    let poses: Vec<Pose> = (0..400).map(|k| truth.pose_at(k * step_ns)).collect();
    let recording = Motion::through(Pose::IDENTITY, &poses, step_ns).unwrap();
    let far = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    for t in (10_000_000..1_900_000_000).step_by(7_654_321) {
        let ((pose, twist), (right, speed)) = (recording.state_at(t), truth.state_at(t));
        assert!(far(&pose.position_m, &right.position_m) < 1e-6, "{t}: {pose:?} {right:?}");
        assert!(far(&pose.rotation_xyzw, &right.rotation_xyzw) < 1e-5, "{t}: {pose:?} {right:?}");
        assert!(far(&twist.linear_m_s, &speed.linear_m_s) < 1e-3, "{t}: {twist:?} {speed:?}");
        assert!(far(&twist.angular_rad_s, &speed.angular_rad_s) < 1e-2, "{t}: {twist:?} {speed:?}");
    }
    for (t, k) in [(-5, 0), (0, 0), (399 * step_ns, 399), (i64::MAX, 399)] {
        let (pose, twist) = recording.state_at(t);
        assert!(far(&pose.position_m, &poses[k].position_m) < 1e-12 && twist == Twist::default(), "{t}");
    }
    let broken = Pose { position_m: [f64::NAN; 3], ..Pose::IDENTITY };
    assert!(Motion::through(Pose::IDENTITY, &[broken; 4], step_ns).is_err());
    assert_eq!(Motion::through(Pose::IDENTITY, &poses[..3], step_ns).unwrap().pose_at(7), Pose::IDENTITY);
}
