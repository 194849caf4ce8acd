//! What holds for every kind of gaze, and what a rig file with a measured one may not say.

use super::{kinds, GazeAim, GazeConfig, GazeCounts, GazeDesk, GazeSample};
use crate::config::{Overrides, Purpose, RigConfig};
use dpm_common::keys::rows::Row;
use dpm_common::keys::source::{SourceNode, Value};
use dpm_device::time::HostTime;
use glam::DVec3;
use std::path::Path;

const GLASSES: &str = "[observer]\ntracked = \"glasses\"\n";

fn parse(text: &str, purpose: Purpose) -> Result<RigConfig, String> {
    RigConfig::parse_for("rig.toml", text, Path::new(""), &Overrides::default(), purpose)
        .map_err(|e| e.to_string())
}

fn toml(value: &Value) -> String {
    match value {
        Value::Float(number) => format!("{number:?}"),
        Value::Integer(number) => number.to_string(),
        Value::String(text) => format!("{text:?}"),
        Value::Array(nodes) => {
            let all: Vec<String> = nodes.iter().map(|node: &SourceNode| toml(&node.value)).collect();
            format!("[{}]", all.join(", "))
        }
        other => panic!("{other:?}"),
    }
}

/// `dpm set gaze=` and a save write a kind back with all its keys.
#[test]
fn every_kind_is_read_as_it_is_written() {
    let changed = [
        ("point", "point = [1.0, 2.0, 3.5]\n"),
        ("tracked", "target = \"glasses\"\n"),
        ("straight", ""),
        (
            "pupil",
            "address = \"10.0.0.7\"\nport = 1234\nmin_confidence = 0.75\ncamera_position = [0.125, 0.25, -0.5]\n\
             camera_rotation_deg = [170.0, 2.0, 3.0]\nlatency_us = -300\n",
        ),
    ];
    let words: Vec<&str> = kinds().iter().map(|kind| kind.word().word).collect();
    assert_eq!(words, changed.map(|(word, _)| word));
    for (word, keys) in changed {
        let read = |keys: &str| {
            let text = format!("{GLASSES}[observer.gaze]\nkind = {word:?}\n{keys}");
            parse(&text, Purpose::default()).unwrap_or_else(|e| panic!("{e}")).observer.gaze
        };
        let gaze = read(keys);
        let written: String =
            gaze.written().iter().map(|(key, value)| format!("{key} = {}\n", toml(value))).collect();
        assert_eq!(read(&written), gaze, "{written}");
        let plain = GazeConfig::plain(gaze.kind());
        assert_eq!(gaze == plain, keys.is_empty(), "every key was changed");
        let names: Vec<&str> = gaze.written().iter().map(|(key, _)| *key).collect();
        assert_eq!(names, gaze.kind().word().keys);
    }
}

#[test]
fn a_measured_gaze_needs_glasses_a_clock_and_an_address() {
    let refused = |text: &str| parse(text, Purpose::default()).expect_err(text);
    let pupil = "[observer.gaze]\nkind = \"pupil\"\n";
    let alone = refused(pupil);
    assert!(alone.contains("observer.gaze.kind") && alone.contains("observer.tracked"), "{alone}");
    let fast = refused(&format!("{GLASSES}{pupil}[real_time]\npace = \"virtual\"\n[run]\nframes = 3\n"));
    assert!(fast.contains("runs on its own clock"), "{fast}");
    let nowhere = refused(&format!("{GLASSES}{pupil}address = \"the lab\"\n"));
    assert!(nowhere.contains("observer.gaze.address") && nowhere.contains("192.168"), "{nowhere}");
    // Without the device it is the axis of the glasses.
    let simulated = parse(&format!("{GLASSES}{pupil}"), Purpose { simulate: true, ..Purpose::default() });
    assert_eq!(simulated.expect("valid").observer.gaze.aim(), GazeAim::Ahead);
}

/// Crews that take over read the newest sample too, and the report adds nothing up twice.
#[test]
fn the_newest_sample_reaches_every_crew_and_is_reported() {
    let desk = GazeDesk::default();
    assert_eq!(desk.report(), None, "nothing is measured");
    desk.begin("pupil");
    let mut first = desk.follow();
    let sample = |ms: i64| GazeSample {
        at: HostTime(ms * 1_000_000),
        received_at: HostTime((ms + 12) * 1_000_000),
        point_m: DVec3::new(0.0, 0.0, ms as f64),
    };
    assert_eq!(*first.latest().0, None);
    (0..100).for_each(|k| desk.publish(&sample(5 * k)));
    let mut second = desk.follow();
    assert_eq!((*first.latest().0, *second.latest().0), (Some(sample(495)), Some(sample(495))));
    drop(first);
    desk.publish(&sample(500));
    assert_eq!(*second.latest().0, Some(sample(500)));
    let counts = GazeCounts { samples: 202, used: 101, unsure: 50, sessions: 3, ..GazeCounts::default() };
    desk.tell(&counts, Some("why".into()), HostTime(520_000_000));
    [true, true, false].iter().for_each(|is| desk.count_frame(*is));
    let report = desk.report().expect("it is measured");
    assert_eq!((report.kind, report.samples, report.reconnects), ("pupil", 202, 2));
    assert_eq!((report.age_ms, report.latency_ms), (Some(20.0), Some(12.0)));
    assert_eq!((report.frames_measured, report.frames_without), (2, 1));
    assert!((report.unsure_share.expect("there are samples") - 50.0 / 202.0).abs() < 1e-12);
    assert!(report.warning().is_some_and(|told| told.contains("33 %") && told.contains("why")));
    desk.tell(&GazeCounts { used: 301, ..counts }, None, HostTime(1_520_000_000));
    desk.tell(&GazeCounts { used: 501, ..counts }, None, HostTime(2_520_000_000));
    assert_eq!(desk.report().expect("it is measured").rate_hz, 200.0);
}
