//! What the kinds of this crate do with their keys. The conformance suite has what holds for every kind.

use super::{kinds, TrackerConfig, TrackerPlace};
use crate::config::{Overrides, Purpose, RigConfig};
use crate::mock::{Motion, MotionSpec};
use dpm_device::time::{HostClock, HostTime};
use dpm_device::tracker::{BodyKey, Tracker};
use std::path::Path;
use std::sync::Arc;

fn bodies() -> Vec<BodyKey> {
    vec![BodyKey { name: "hare".into(), id: Some(3) }]
}

fn config(text: &str) -> TrackerConfig {
    RigConfig::parse("rig.toml", text, Path::new(""), &Overrides::default()).expect("valid").tracker
}

fn open(config: &TrackerConfig, motions: Vec<Motion>) -> Result<Box<dyn Tracker>, super::SourceError> {
    let clock: Arc<dyn HostClock> = Arc::new(|| HostTime(0));
    config.open(TrackerPlace { bodies: bodies(), motions, clock, start: HostTime(0) })
}

#[test]
fn the_mock_has_the_rigs_rate_and_latency_and_loses_what_it_was_told_to() {
    let keys = "[tracker]\nrate_hz = 250\nlatency_us = 3000\n";
    let count = |more: &str| {
        let motion = Motion::new(&MotionSpec::Still {}, dpm_device::pose::Pose::IDENTITY).expect("still");
        let mut tracker = open(&config(&format!("{keys}{more}")), vec![motion]).expect("opens");
        let (mut samples, mut delays) = (0, 0);
        for ms in 0..=4000 {
            let mut sink = |s: &dpm_device::tracker::TrackerSample| {
                samples += 1;
                delays += s.received_at.ns_since(s.captured_at);
            };
            tracker.poll(HostTime(ms * 1_000_000), &mut sink).expect("polls");
        }
        (samples, delays / samples.max(1))
    };
    let (all, delay) = count("");
    assert!((998..=1001).contains(&all), "{all} samples in 4 s at 250 Hz");
    assert!((3_000_000..4_000_000).contains(&delay), "{delay} ns");
    let (half, _) = count("drop_out = 0.5\n");
    assert!((430..570).contains(&half), "{half} of 1000 at a loss of one half");
}

#[test]
fn what_cannot_be_opened_is_named() {
    let told = |kind: &str, key: &str, value: &str| {
        let flags = vec![format!("tracker.kind={kind:?}"), format!("tracker.{key}={value:?}")];
        let overrides = Overrides { variables: vec![], flags };
        // What the check of the rig file would refuse.
        let kind = kinds().into_iter().find(|k| k.word.word == kind).expect("a kind");
        let mut reader = dpm_common::keys::read::KeyReader::default();
        let mut root = dpm_common::keys::source::parse("rig.toml", "", &mut reader.errors);
        for flag in &overrides.flags {
            let (path, value) = flag.split_once('=').expect("a key");
            let path: Vec<String> = path.split('.').skip(1).map(str::to_owned).collect();
            let origin = dpm_common::keys::Origin::Flag(flag.clone());
            dpm_common::keys::source::set(&mut root, &path, value, &origin, &mut reader.errors);
        }
        use dpm_common::keys::read::ConfigValue;
        let config = TrackerConfig::read(&root, &mut reader, "tracker").expect("readable");
        assert_eq!(config.word(), kind.word.word);
        open(&config, Vec::new()).err().expect("refused").to_string()
    };
    let refused = told("natnet", "server", "motive.lab");
    assert!(refused.contains("tracker.server: \"motive.lab\" is not an IPv4 address"), "{refused}");
    assert!(told("replay", "file", "/nonexistent/run.dpmt").contains("/nonexistent/run.dpmt"));
}

#[test]
fn a_rig_file_is_the_same_by_its_values_and_not_by_its_kind_alone() {
    let [a, b, c] = ["rate_hz = 500", "rate_hz = 501", ""].map(|key| config(&format!("[tracker]\n{key}\n")));
    assert!(a == c && a != b && a == a.clone());
    let purpose = Purpose { simulate: true, ..Purpose::default() };
    let text = "[tracker]\nkind = \"vrpn\"\nrate_hz = 240\n[real_time]\npace = \"real\"\n";
    let simulated = RigConfig::parse_for("rig.toml", text, Path::new(""), &Overrides::default(), purpose);
    let simulated = simulated.unwrap_or_else(|e| panic!("{e}")).tracker;
    assert!(simulated.is_mock() && simulated.rate_hz() == Some(240) && simulated != a);
}
