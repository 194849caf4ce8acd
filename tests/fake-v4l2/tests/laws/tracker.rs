//! The tracker of a rig file whose camera is a fake one: poses where the bodies were, an unplug, a dropped picture.

use crate::stage::{clock, path, until};
use dpm_device::pose::Pose;
use dpm_device::time::{FrameRate, HostClock, HostTime};
use dpm_device::tracker::{BodyKey, Tracker, TrackerSample};
use dpm_mock::camera::{
    two_tags, CameraHost, CameraOptics, MarkedBody, MockCamera, MockCameraConfig, PrintedTag,
};
use dpm_mock::motion::{Motion, MotionSpec};
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::trackers::TrackerPlace;
use fake_v4l2::FakeCamera;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::Path;
use std::sync::Arc;

const SIZE: [u32; 2] = [640, 400];
const HZ: u32 = 30;
const EXPOSURE_NS: i64 = 2_000_000;
const ROW_NS: i64 = 20_000;
/// Where the camera stands; it looks along -Z.
const PLACE: [f64; 3] = [0.0, 0.0, 1.2];

struct Stage {
    clock: Arc<dyn HostClock>,
    motion: Motion,
    host: CameraHost,
}

/// Two tags on the front of the body and two on its back.
fn tags() -> Vec<PrintedTag> {
    let back = two_tags(1).map(|tag| {
        let ([x, y, z], [_, s, _, c]) = (tag.place.position_m, tag.place.rotation_xyzw);
        // Half a turn about y, after the tag's own turn about y.
        let place = Pose { position_m: [-x, y, -z], rotation_xyzw: [0.0, c, 0.0, -s] };
        PrintedTag { place, ..tag }
    });
    two_tags(0).into_iter().chain(back).collect()
}

fn stage(faults: &str) -> Stage {
    stage_seen_from(Pose { position_m: PLACE, ..Pose::IDENTITY }, HZ, faults, clock())
}

fn stage_seen_from(pose: Pose, hz: u32, faults: &str, clock: Arc<dyn HostClock>) -> Stage {
    let motion = Motion::new(&MotionSpec::paper_translation(), Pose::IDENTITY).unwrap();
    let config = MockCameraConfig {
        optics: CameraOptics::pinhole(SIZE, 60.0),
        pose,
        rate: FrameRate::new(hz, 1).unwrap(),
        exposure_ns: EXPOSURE_NS,
        row_ns: ROW_NS,
        faults: faults.parse().unwrap(),
        ..MockCameraConfig::default()
    };
    let body = MarkedBody { motion: motion.clone(), tags: tags(), markers: vec![] };
    let camera = MockCamera::new(config, vec![body]).unwrap();
    let host = CameraHost::start(camera, SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0), clock.clone()).unwrap();
    Stage { clock, motion, host }
}

impl Stage {
    fn words(&self, name: &str, more: &str) -> String {
        let (place, from) = (path(name), self.host.address());
        format!("path={} from={from} size={}x{} rates={HZ} {more}", place.display(), SIZE[0], SIZE[1])
    }

    /// The tracker that a rig file with this camera opens.
    fn tracker(&self, name: &str) -> Box<dyn Tracker> {
        self.tracker_with(name, "").unwrap()
    }

    /// The same with more keys.
    fn tracker_with(&self, name: &str, more: &str) -> Result<Box<dyn Tracker>, String> {
        let tags: Vec<String> = tags().iter().map(|tag| tag.as_toml("hare")).collect();
        let tags = tags.join(", ");
        let text = format!(
            "[real_time]\npace = \"real\"\n[tracker]\nkind = \"camera\"\ndevice = {:?}\nsize = {SIZE:?}\nrate_hz = {HZ}\n\
             exposure_us = {}\nreadout_us = {}\nview_deg = 60\ntags = [{tags}]\n{more}\n",
            path(name).display().to_string(),
            EXPOSURE_NS / 1_000,
            ROW_NS * i64::from(SIZE[1]) / 1_000,
        );
        let config = RigConfig::parse("rig.toml", &text, Path::new(""), &Overrides::default());
        let config = config.map_err(|e| e.to_string())?.tracker;
        let bodies = vec![BodyKey { name: "hare".into(), id: None }];
        let place = TrackerPlace { bodies, motions: vec![], clock: self.clock.clone(), start: HostTime(0) };
        config.open(place).map_err(|e| e.to_string())
    }

    /// How far the body was from where a sample says, metres.
    fn error_m(&self, sample: &TrackerSample) -> f64 {
        let truth = self.motion.pose_at(sample.captured_at.0).position_m;
        let seen = sample.pose.position_m;
        (0..3).map(|i| (seen[i] + PLACE[i] - truth[i]).powi(2)).sum::<f64>().sqrt()
    }
}

/// Polls until `count` more samples have come in which the body was seen.
fn seen(tracker: &mut dyn Tracker, stage: &Stage, count: usize) -> Vec<TrackerSample> {
    let mut all = Vec::new();
    until("samples", || {
        tracker.poll(stage.clock.now(), &mut |s| all.extend(s.tracked.then_some(*s))).unwrap();
        all.len() >= count
    });
    all
}

/// A body that moves up to metres a second: its stamped place is where it was, for both moments that drivers stamp. A stamp
/// that were off by half an exposure and half a readout (5 ms) would be off by millimetres in the middle of its way.
#[test]
fn a_rigs_camera_gives_poses_where_the_body_was() {
    let stage = stage("");
    for (name, more) in [
        ("poses-begin", "formats=YUYV stamp=begin"),
        ("poses-end", "formats=GREY stamp=end"),
        ("poses-jpeg", "formats=MJPG stamp=begin padding=0"),
    ] {
        let _fake = FakeCamera::plug_in(&stage.words(name, more));
        let mut tracker = stage.tracker(name);
        let samples = seen(&mut *tracker, &stage, 25);
        let mut errors: Vec<f64> = samples.iter().map(|s| stage.error_m(s)).collect();
        errors.sort_by(f64::total_cmp);
        assert!(errors[12] < 0.004, "{name}: {errors:?}");
        // The same samples, judged 5 ms later: the test can see such a fault.
        let shifted =
            |s: &TrackerSample| TrackerSample { captured_at: s.captured_at.plus_ns(5_000_000), ..*s };
        let mut late: Vec<f64> = samples.iter().map(|s| stage.error_m(&shifted(s))).collect();
        late.sort_by(f64::total_cmp);
        assert!(late[12] > 1.5 * errors[12], "{name}: {errors:?} {late:?}");
        assert!(samples.iter().all(|s| s.covariance.is_some_and(|c| c.variances().is_some())));
        assert!(tracker.gate().unwrap().counters().is_conserved());
    }
}

#[test]
fn a_pulled_plug_and_a_lost_picture_are_told_and_survived() {
    let stage = stage("loss=0.1");
    let fake = FakeCamera::plug_in(&stage.words("plugs", ""));
    let mut tracker = stage.tracker("plugs");
    seen(&mut *tracker, &stage, 30);
    let lost = |tracker: &dyn Tracker| {
        let status = tracker.status();
        let count =
            status.split([',', ';']).find_map(|part| part.trim().strip_suffix(" pictures lost on the way"));
        count.map_or(0, |n| n.parse::<u32>().unwrap())
    };
    assert!(lost(&*tracker) >= 1, "{}", tracker.status());
    assert!(tracker.gate().unwrap().counters().lost >= 1, "{}", tracker.status());

    fake.unplug();
    until("the tracker says that it is gone", || {
        tracker.poll(stage.clock.now(), &mut |_| ()).unwrap();
        tracker.status().contains("there is no ")
    });
    let opened = fake.witness().opened;
    fake.return_as(&stage.words("plugs", ""));
    let samples = seen(&mut *tracker, &stage, 10);
    assert!(stage.error_m(&samples[9]) < 0.02);
    assert!(tracker.status().starts_with("pictures come"), "{}", tracker.status());
    assert_eq!(fake.witness().opened, opened + 1);
    assert!(tracker.gate().unwrap().counters().is_conserved());
}

/// Two cameras on either side of a body, which do not expose at the same time and each see their own side: the poses of both
/// are where the body was, in the space of the first, and one goes on where the other is gone.
#[test]
fn two_cameras_give_one_track() {
    let clock = clock();
    let front = stage_seen_from(Pose { position_m: PLACE, ..Pose::IDENTITY }, HZ, "", clock.clone());
    let behind = Pose { position_m: [0.1, 0.0, -1.1], rotation_xyzw: [0.0, 1.0, 0.0, 0.0] };
    // A little slower than it says, so that the two drift against each other.
    let back = stage_seen_from(behind, HZ - 3, "", clock);
    let _first = FakeCamera::plug_in(&front.words("front", "card=Front"));
    let second = FakeCamera::plug_in(&back.words("back", "card=Back stamp=end"));
    let device = path("back").display().to_string();
    let other =
        |place: &str| format!("others = [{{ device = {device:?}, rotation = [0, 1, 0, 0] {place} }}]");
    let missing = front.tracker_with("front", &other("")).err().expect("a place is needed");
    assert!(missing.contains("several cameras need their places relative to each other"), "{missing}");

    let mut tracker = front.tracker_with("front", &other(", position = [0.1, 0, -2.3]")).unwrap();
    let samples = seen(&mut *tracker, &front, 80);
    let mut errors: Vec<f64> = samples.iter().map(|s| front.error_m(s)).collect();
    errors.sort_by(f64::total_cmp);
    assert!(errors[72] < 0.008, "{errors:?}");
    // Both give their share, and each sample has a number of its own.
    let span_s = 1e-9 * samples[79].captured_at.ns_since(samples[0].captured_at) as f64;
    assert!(80.0 / span_s > 1.4 * f64::from(HZ), "80 samples in {span_s} s: {}", tracker.status());
    assert!(samples.windows(2).all(|two| two[1].sequence == two[0].sequence.wrapping_add(1)));
    // That one of them was overtaken by the other is no fault of either.
    let counters = tracker.gate().unwrap().counters();
    assert!(counters.is_conserved() && counters.samples.late + counters.samples.duplicate == 0, "{counters}");

    second.unplug();
    until("the second camera is gone", || {
        tracker.poll(front.clock.now(), &mut |_| ()).unwrap();
        tracker.status().contains("there is no ")
    });
    assert_eq!(seen(&mut *tracker, &front, 10).len(), 10, "the first goes on");
}
