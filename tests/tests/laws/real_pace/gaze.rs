//! A measured gaze through the whole chain: from the eyes of a Pupil that is made of software, over ZeroMQ, to the point that
//! frames are drawn for.

use dpm_device::time::{HostClock, HostTime};
use dpm_rig::pipeline::{self, RunOptions, RunOutcome};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_tests::rigs::demo_rig;
use glam::{DAffine3, DQuat, DVec3};
use hil_mock::pupil::eyes::EyeMotion;
use hil_mock::pupil::host::PupilHost;
use hil_mock::pupil::messages::PupilConfig;
use std::sync::Arc;
use std::time::Instant;

/// Where the scene camera is on the glasses, and how it is turned.
const CAMERA: &str = "camera_position=[0.01,0.03,-0.04],camera_rotation_deg=[172.0,4.0,0.0]";
const LATENCY_MS: i64 = 30;

fn glasses_from_camera() -> DAffine3 {
    let turn = DQuat::from_rotation_y(4f64.to_radians()) * DQuat::from_rotation_x(172f64.to_radians());
    DAffine3::from_rotation_translation(turn, DVec3::new(0.01, 0.03, -0.04))
}

/// A run of 240 frames whose observer wears the glasses and moves by `motion`, before eyes that do as `eyes` says.
fn run(eyes: EyeMotion, motion: &str) -> (RunOutcome, Arc<Rig>) {
    let begin = Instant::now();
    let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(begin.elapsed().as_nanos() as i64));
    let config =
        PupilConfig { eyes, latency_ns: LATENCY_MS * 1_000_000, clock_ppm: -80.0, ..PupilConfig::default() };
    let host = PupilHost::here(config, clock).expect("sockets");
    let gaze = format!("observer.gaze={{kind=\"pupil\",port={},{CAMERA}}}", host.address().port());
    let glasses = format!("observer.tracked={{name=\"glasses\",motion={motion}}}");
    let settings = [
        "real_time.pace=\"real\"",
        "projector.frame_rate=\"60\"",
        "safety.eyes.guard=false",
        &gaze,
        &glasses,
    ];
    let rig = demo_rig(64, 48, &settings);
    let options = RunOptions { frames: 240, keep_records: 240, ..RunOptions::default() };
    let outcome = pipeline::run_prepared(rig.clone(), options, &Arc::new(RunMonitor::default()));
    (outcome.unwrap_or_else(|e| panic!("{e}")), rig)
}

fn off_deg(eye: DVec3, a: DVec3, b: DVec3) -> f64 {
    (a - eye).angle_between(b - eye).to_degrees()
}

/// The head turns by up to 2 rad/s while the eyes rest in it. The point is where the glasses were when the eyes were seen: with
/// their pose at the light it would be off by four degrees.
#[test]
fn frames_are_drawn_for_where_the_eyes_looked_when_they_were_seen() {
    let eyes = EyeMotion { fixation_ns: 1 << 50, blink_every_ns: 0, ..EyeMotion::default() };
    let target = glasses_from_camera().transform_point3(DVec3::from_array(eyes.at(0).target_m));
    let (outcome, rig) = run(eyes, "{kind=\"rotate\",axis=[0,1,0],rate_rad_s=2.0}");
    let report = outcome.report.gaze.as_ref().expect("it is measured");
    assert!(report.used > 200 && report.frames_measured > 120, "{report:?}");
    let (mut checked, mut worst, mut at_light) = (0, 0f64, 0f64);
    for record in &outcome.recent {
        let place = |t: i64| rig.true_poses(t).expect("the mock")[rig.bodies.len()].transform_point3(target);
        let light = record.drawn_for.0;
        // Samples come every 5 ms, 30 ms after they were seen; a frame takes a few slots more.
        let past =
            (LATENCY_MS..200).map(|ms| off_deg(record.eye, record.gaze, place(light - ms * 1_000_000)));
        let off = past.fold(f64::MAX, f64::min);
        // Before the first sample the gaze follows the axis, 8 degrees and more away.
        if off < 3.0 {
            checked += 1;
            (worst, at_light) =
                (worst.max(off), at_light.max(off_deg(record.eye, record.gaze, place(light))));
        }
    }
    assert!(
        checked > 120 && worst < 0.6 && at_light > 3.0,
        "{checked} frames, {worst} degrees, {at_light} at the light"
    );
}

#[test]
fn frames_follow_eyes_that_jump_and_blink() {
    let eyes = EyeMotion { blink_every_ns: 900_000_000, blink_ns: 120_000_000, ..EyeMotion::default() };
    let (outcome, rig) = run(eyes, "{kind=\"still\"}");
    let report = outcome.report.gaze.as_ref().expect("it is measured");
    assert!(report.unsure > 10 && report.refused == 0 && report.reconnects == 0, "{report:?}");
    let glasses = rig.true_poses(0).expect("the mock")[rig.bodies.len()] * glasses_from_camera();
    let targets: Vec<DVec3> = (0..30_000)
        .map(|ms| eyes.at(ms * 1_000_000))
        .filter(|state| state.is_fixed)
        .map(|state| glasses.transform_point3(DVec3::from_array(state.target_m)))
        .collect();
    let near = |point: DVec3| {
        targets.iter().map(|target| off_deg(glasses.translation, point, *target)).fold(f64::MAX, f64::min)
    };
    let measured: Vec<_> = outcome.recent.iter().skip(60).map(|record| near(record.gaze)).collect();
    let good = measured.iter().filter(|off| **off < 0.1).count();
    assert!(10 * good > 7 * measured.len() && measured.len() > 100, "{good} of {}", measured.len());
    // Each of several fixations was followed.
    let mut points: Vec<DVec3> = Vec::new();
    for record in outcome.recent.iter().skip(60).filter(|record| near(record.gaze) < 0.1) {
        if points.iter().all(|p| off_deg(glasses.translation, *p, record.gaze) > 1.0) {
            points.push(record.gaze);
        }
    }
    assert!(points.len() >= 4, "{points:?}");
}
