//! What holds for every kind of trackers: one suite over all rows of the table, and over a toy kind that is a folder
//! ([`toy`]) and a row.

mod toy;

use dpm_device::pose::Pose;
use dpm_device::time::{HostClock, HostTime};
use dpm_device::tracker::{BodyIndex, BodyKey, TrackerSample};
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::trackers::{
    add, kinds, simulated, MockScene, PoseOrigin, TrackerConfig, TrackerKind, TrackerPlace,
};
use glam::DAffine3;
use hil_mock::motion::{Motion, MotionSpec};
use hil_mock::tracker::{MockTrackerConfig, SampleSource};
use proptest::test_runner::{Config, TestRunner};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

const NAMES: [&str; 2] = ["hare", "the fox"];
/// Samples of each body that a kind must give.
const SAMPLES: usize = 150;
/// A tracker that gives them later than this gives none.
const PATIENCE: Duration = Duration::from_secs(40);
/// At most 1 m/s: so far is a body from where it was 25 ms earlier or later, which a busy machine may take to stamp a packet.
const FAR_M: f64 = 0.025;

fn clock() -> Arc<dyn HostClock> {
    let epoch = Instant::now();
    Arc::new(move || HostTime(epoch.elapsed().as_nanos() as i64))
}

fn motions() -> Vec<Motion> {
    let rest = |x| Pose { position_m: [x, 0.2, 0.5], ..Pose::IDENTITY };
    let moving = Motion::new(&MotionSpec::paper_translation(), rest(0.0)).unwrap();
    vec![moving, Motion::new(&MotionSpec::Still {}, rest(0.4)).unwrap()]
}

/// `[tracker]` with these keys and nothing else.
fn config(kind: &TrackerKind, keys: &[(&str, String)]) -> Result<TrackerConfig, String> {
    let mut text = format!("[real_time]\npace = \"real\"\n[tracker]\nkind = {:?}\n", kind.word.word);
    keys.iter().for_each(|(key, value)| text += &format!("{key} = {value}\n"));
    let rig = RigConfig::parse("rig.toml", &text, Path::new(""), &Overrides::default());
    rig.map(|rig| rig.tracker).map_err(|e| e.to_string())
}

fn place(clock: &Arc<dyn HostClock>) -> TrackerPlace {
    let bodies = NAMES.map(|name| BodyKey { name: name.into(), id: None }).to_vec();
    TrackerPlace { bodies, motions: motions(), clock: clock.clone(), start: HostTime(0) }
}

/// What the program tells of it: a word of its own, keys with a text each, a page, a place and a remedy.
fn is_documented(kind: &TrackerKind) {
    let word = kind.word.word;
    assert_eq!(kinds().iter().filter(|other| other.word.word == word).count(), 1, "{word} stands twice");
    assert!(!kind.word.about.is_empty() && word.chars().all(|c| c.is_ascii_lowercase()), "{word}");
    let docs = RigConfig::key_docs();
    for key in kind.word.keys {
        let within = format!("tracker({word}).{key}");
        let own: Vec<_> = docs.iter().filter(|doc| doc.key.starts_with(&within)).collect();
        assert!(!own.is_empty() && own.iter().all(|doc| doc.doc.len() > 10), "{within} is not in the manual");
    }
    let (page, heading) = kind.page.split_once('#').expect("a page and a heading");
    let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(page));
    let anchor = |line: &str| line.trim_start_matches('#').trim().to_lowercase().replace([',', '.'], "");
    let has = |line: &str| line.starts_with('#') && anchor(line).replace(' ', "-") == heading;
    assert!(text.unwrap_or_else(|e| panic!("{page}: {e}")).lines().any(has), "{} is not there", kind.page);
}

/// A key of another kind, and one of none, is refused by its name.
fn refuses_foreign_keys(kind: &TrackerKind) {
    for wrong in ["no_such_key", "clock_of_the_tower"] {
        let told = config(kind, &[(wrong, "1".into())]).expect_err("refused");
        assert!(told.contains(wrong) && told.contains("rig.toml:5"), "{told}");
    }
}

/// Before anybody answers it opens and gives nothing, or it names the key that is missing.
fn waits_for_its_device(kind: &TrackerKind) {
    let Ok(config) = config(kind, &[]) else { return };
    assert!(!config.place().is_empty() && !config.remedy().is_empty());
    assert_eq!(config.is_mock(), config.frame().is_none(), "who measures has coordinates of its own");
    if kind.origin == PoseOrigin::Measured {
        match config.open(place(&clock())) {
            Ok(mut tracker) => {
                let count = tracker.poll(HostTime(1), &mut |s| panic!("{s:?} from nowhere")).unwrap();
                assert!(count == 0 && !tracker.name().is_empty());
            }
            Err(e) => assert!(e.to_string().contains("tracker"), "{e}"),
        }
    }
}

/// Poses and instants of its own mock come through: each body's in order, at its true place, through a gate that counts all.
fn brings_the_truth(kind: &TrackerKind) {
    let clock = clock();
    let mock = MockTrackerConfig { start: HostTime(0), ..Default::default() };
    let source = SampleSource::new(mock, motions()).unwrap();
    let names = NAMES.map(String::from).to_vec();
    let scene = MockScene { source: source.clone(), motions: motions(), names, clock: clock.clone() };
    let server = (kind.mock)(&scene).unwrap_or_else(|e| panic!("{}: {e}", kind.word.word));
    let config = config(kind, &server.keys).unwrap_or_else(|e| panic!("{e}"));
    let mut tracker = config.open(place(&clock)).unwrap_or_else(|e| panic!("{e}"));
    let mut samples: [Vec<TrackerSample>; 2] = Default::default();
    let begin = Instant::now();
    while samples.iter().any(|of_body| of_body.len() < SAMPLES) {
        let told = || format!("{}: {} s, {}", config.word(), begin.elapsed().as_secs(), tracker.status());
        assert!(begin.elapsed() < PATIENCE, "{}, {:?}", told(), samples.each_ref().map(Vec::len));
        let now = clock.now();
        let mut count = 0;
        let polled = tracker.poll(now, &mut |sample| {
            count += 1;
            samples[usize::from(sample.body.0)].push(*sample);
        });
        assert_eq!(polled.unwrap(), count, "poll returns the number of samples");
        std::thread::sleep(Duration::from_micros(300));
    }
    let gate = tracker.gate().expect("every tracker ends in a gate");
    assert!(gate.counters().is_conserved(), "{}", gate.counters());
    // What measures from a place of its own says where that is.
    let world_from_tracker =
        config.frame().and_then(|(transform, _)| transform.pose()).unwrap_or(DAffine3::IDENTITY);
    for (body, of_body) in samples.iter().enumerate() {
        assert!(of_body.windows(2).all(|w| w[0].captured_at < w[1].captured_at), "in order of capture");
        let mut errors: Vec<f64> = of_body
            .iter()
            .map(|s| {
                let truth = source.true_pose(BodyIndex(body as u16), s.captured_at.0).unwrap();
                let seen = world_from_tracker.transform_point3(s.pose.position_m.into());
                seen.distance(truth.position_m.into())
            })
            .collect();
        errors.sort_by(f64::total_cmp);
        let median = errors[errors.len() / 2];
        assert!(median < FAR_M, "{}: body {body} is {median} m away", config.word());
    }
    // What is switched off falls silent, and breaks nothing.
    drop(server);
    for _ in 0..50 {
        tracker.poll(clock.now(), &mut |_| ()).unwrap();
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// A kind that reads bytes of others has a decoder that bears any bytes.
fn bears_any_bytes(kind: &TrackerKind) {
    let reads_bytes = kind.origin != PoseOrigin::Simulated;
    assert_eq!(reads_bytes, !kind.decoders.is_empty(), "{}", kind.word.word);
    for (_, decode) in kind.decoders {
        let mut runner =
            TestRunner::new(Config { cases: 400, failure_persistence: None, ..Config::default() });
        let bytes = proptest::collection::vec(proptest::num::u8::ANY, 0..300);
        runner
            .run(&bytes, |bytes| {
                let _: () = decode(&bytes);
                Ok(())
            })
            .unwrap();
    }
}

fn judge(kind: &TrackerKind) {
    is_documented(kind);
    refuses_foreign_keys(kind);
    waits_for_its_device(kind);
    bears_any_bytes(kind);
    brings_the_truth(kind);
}

#[test]
fn every_kind_of_trackers_keeps_the_laws_of_all() {
    assert!(kinds().len() >= 5);
    kinds().into_iter().for_each(judge);
}

/// A stranger's kind: one folder and this row.
#[test]
fn a_kind_is_a_folder_and_a_row() {
    let before = kinds().len();
    add(&toy::KIND);
    add(&toy::KIND);
    assert_eq!(kinds().len(), before + 1, "a row stands once");
    judge(&toy::KIND);
    // What asks for a kind by name has it now.
    let (told, manual) =
        (config(&toy::KIND, &[("nonsense", "1".into())]).expect_err("refused"), RigConfig::manual());
    assert!(told.contains("known keys here: port, rate_hz"), "{told}");
    assert!(manual.contains("## `[tracker]` with `kind = \"toy\"`") && manual.contains("a toy for tests."));
    let stand_in = simulated(config(&toy::KIND, &[]).unwrap().rate_hz());
    assert_eq!((stand_in.is_mock(), stand_in.rate_hz()), (true, Some(60)));
    let virtual_pace = "[tracker]\nkind = \"toy\"\n[run]\nframes = 9\n[real_time]\npace = \"virtual\"\n";
    let told = RigConfig::parse("rig.toml", virtual_pace, Path::new(""), &Overrides::default()).unwrap_err();
    assert!(told.to_string().contains("\"toy\" runs on its own clock"), "{told}");
}
