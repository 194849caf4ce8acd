//! A rig on an ALP: the whole rig and the whole program, with a fake panel behind the vendor's interface.

use crate::cli_common::{code, dpm, err, out, start_with, TestFolder, NO_DRIVER};
use crate::link_common::{raster, rig, start};
use dpm_device::planes::PlaneSchedule;
use dpm_rig::pack::prepared::is_whole;
use dpm_rig::telemetry::monitor::ProjectorHealth;
use fake_alp::{library, FakeAlp};
use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

const LONG: Duration = Duration::from_secs(60);
const RIG: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../rigs/alp.toml");

/// The keys of an example whose planes are lit by their weights.
const BINARY: [&str; 6] = [
    "--set",
    "projector.weights=\"binary\"",
    "--set",
    "projector.backend.plane_times=\"binary\"",
    "--set",
    "projector.frame_rate=80",
];

/// One program at a time drives the first ALP.
static FIRST: Mutex<()> = Mutex::new(());

fn backend(fake: &FakeAlp, more: &str) -> String {
    format!(
        "{{ kind = \"alp\", library = {:?}, device_number = {} {more} }}",
        library().display().to_string(),
        fake.number()
    )
}

fn until(what: &str, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < LONG, "{what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Every frame that the panel showed is one that the rig prepared, whole; the report agrees with what the panel saw.
#[test]
fn a_run_lights_whole_frames_and_leaves_the_device_free() {
    let fake = FakeAlp::at_real_pace("size=64x32");
    let run = start(
        &rig(&backend(&fake, ""), &["projector.frame_rate=50", "projector.width=64", "projector.height=32"]),
        60,
    );
    let report = run.end().unwrap_or_else(|e| panic!("{e}")).report;
    let witness = fake.witness();
    assert_eq!((witness.leaked, witness.sequences, witness.is_allocated, witness.is_lit), (0, 0, 0, 0));
    let (mut whole, mut planes) = (0, Vec::new());
    while let Some(shown) = fake.next_shown() {
        if shown.kept || shown.picture == 8 {
            // The dark picture that ends a frame.
            assert!(shown.plane.iter().all(|byte| *byte == 0));
            continue;
        }
        if shown.picture == 0 {
            planes.clear();
        }
        planes.extend_from_slice(&shown.plane);
        if planes.len() == raster().plane_bytes() * 8 {
            // The marks of eight planes tell numbers apart that differ by 256 or more.
            assert!(is_whole(raster(), &PlaneSchedule::mono8(), &planes, 0), "planes of several frames");
            whole += u64::from(planes.iter().any(|byte| *byte != 0));
        }
    }
    assert_eq!(report.frames_lit + report.frames_dropped, 60);
    assert!(report.frames_lit >= 20, "{report:?}");
    assert!(whole >= 10, "{whole} whole frames of light");
    let told = report.warnings.join("\n");
    assert!(
        told.contains("MB/s over its cable; light begins") && told.contains("lit equally long"),
        "{told}"
    );
}

#[test]
fn an_unplugged_device_is_taken_up_again() {
    let fake = FakeAlp::at_real_pace("size=64x32");
    let run = start(
        &rig(&backend(&fake, ""), &["projector.frame_rate=50", "projector.width=64", "projector.height=32"]),
        0,
    );
    until("light", || run.monitor.counts().frames_lit > 5);
    fake.plan("removed@any=1");
    until("the loss is told", || run.monitor.projector() == ProjectorHealth::Lost);
    assert_eq!(fake.witness().is_lit, 0);
    let before = run.monitor.counts().frames_lit;
    fake.plan("");
    until("light again", || run.monitor.counts().frames_lit > before + 5);
    run.stop().unwrap_or_else(|e| panic!("{e}"));
    assert_eq!((fake.witness().is_allocated, fake.witness().leaked), (0, 0));
}

/// The lines that the fake has written of a process.
fn log(folder: &TestFolder) -> Vec<String> {
    let text = std::fs::read_to_string(folder.path("alp.log")).unwrap_or_default();
    text.lines().map(str::to_owned).collect()
}

fn field<'a>(line: &'a str, name: &str) -> Option<&'a str> {
    line.split(' ').find_map(|word| word.strip_prefix(name)?.strip_prefix('='))
}

/// The example rig on the fake panel at its full size, as a process of its own.
fn of_example<'a>(words: &[&'a str], library: &'a str) -> Vec<&'a str> {
    [&["pattern", "ramp", RIG, "--set", library], &BINARY[..], words].concat()
}

#[test]
fn a_killed_program_leaves_light_for_one_frame_at_most() {
    let _turn = FIRST.lock().unwrap_or_else(PoisonError::into_inner);
    for signal in ["KILL", "TERM"] {
        let folder = TestFolder::new(&format!("alp-{signal}"));
        let path = folder.path("alp.log").display().to_string();
        let library = format!("projector.backend.library={:?}", library().display().to_string());
        let variables = [("FAKE_ALP_LOG", path.as_str()), NO_DRIVER[0], NO_DRIVER[1]];
        let args = of_example(&["--set", "projector.frame_rate=20"], &library);
        let mut run = start_with(&args, &variables);
        until("light", || {
            assert!(run.try_wait().is_none(), "{:?}", run.rest_of_lines(LONG));
            log(&folder).iter().filter(|line| line.starts_with("start")).count() > 20
        });
        run.signal(signal);
        run.finish();
        let lines = log(&folder);
        let starts: Vec<&String> = lines.iter().filter(|line| line.starts_with("start")).collect();
        for line in &starts {
            let ns = |name| field(line, name).and_then(|text| text.parse::<i64>().ok());
            let (at, until) = (ns("at").unwrap(), ns("until").expect("it ends by itself"));
            // One frame of 50 ms, and at most a quarter of the one before.
            assert!(until - at <= 63_000_000 && field(line, "then").is_some(), "{line}");
        }
        assert_eq!(field(starts.last().unwrap(), "then"), Some("dark"), "the last picture is dark");
        if signal == "TERM" {
            assert!(
                lines.iter().any(|line| line.starts_with("free") && line.ends_with("leaked=0")),
                "{lines:?}"
            );
        }
    }
}

/// The light of the example: the planes that were put are those of the picture that `--png` writes, cut here bit by bit.
#[test]
fn the_planes_that_reach_the_panel_are_those_of_the_picture() {
    let _turn = FIRST.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = TestFolder::new("alp-planes");
    let path = folder.path("alp.log").display().to_string();
    let library = format!("projector.backend.library={:?}", library().display().to_string());
    let png = folder.path("board.png");
    let written = dpm(&of_example(&["--png", png.to_str().unwrap()], &library), &NO_DRIVER);
    assert_eq!(code(&written), 0, "{}", err(&written));
    let picture = image::open(&png).unwrap().to_rgb8();
    let words = ["--frames", "5", "--set", "projector.frame_rate=20"];
    let shown =
        dpm(&of_example(&words, &library), &[("FAKE_ALP_LOG", path.as_str()), NO_DRIVER[0], NO_DRIVER[1]]);
    assert_eq!(code(&shown), 0, "{}", err(&shown));
    let lines = log(&folder);
    // Only one end can be asked for at a time: a second order to go dark may be told so.
    let is_odd = |line: &&String| line.starts_with("refused") && !line.ends_with("code=1002");
    assert_eq!(lines.iter().find(is_odd), None);
    let put: BTreeSet<u64> = lines
        .iter()
        .filter_map(|line| field(line, "hash"))
        .map(|hex| u64::from_str_radix(hex, 16).unwrap())
        .collect();
    let mut expected = BTreeSet::from([fake_alp::hash(&vec![0; 98_304])]);
    for bit in 0..8 {
        let mut plane = vec![0u8; 98_304];
        for (x, y, pixel) in picture.enumerate_pixels() {
            plane[y as usize * 128 + x as usize / 8] |= (pixel.0[1] >> bit & 1) << (7 - x % 8);
        }
        expected.insert(fake_alp::hash(&plane));
    }
    assert_eq!(expected.len(), 9, "every plane is another one");
    assert_eq!(put, expected);
}

#[test]
fn what_cannot_be_is_refused_with_figures_and_doctor_says_so() {
    let _turn = FIRST.lock().unwrap_or_else(PoisonError::into_inner);
    let library = format!("projector.backend.library={:?}", library().display().to_string());
    let refused = |set: &[&str], expected: &[&str], exit: i32| {
        let sets: Vec<&str> = set.iter().flat_map(|key| ["--set", key]).collect();
        let output = dpm(&of_example(&sets, &library), &NO_DRIVER);
        assert_eq!(code(&output), exit, "{set:?}: {}", err(&output));
        for text in expected {
            assert!(err(&output).contains(text), "{set:?}: {}", err(&output));
        }
    };
    refused(&["projector.frame_rate=120"], &["at least 44 us", "at most 88.8 frames/s"], 3);
    let equal = "projector.backend.plane_times=\"equal\"";
    refused(&[equal, "projector.frame_rate=900"], &["MB/s over its cable", "at most"], 3);
    refused(
        &["projector.width=800", "projector.height=600"],
        &["1024 x 768 mirrors", "projector.width = 1024"],
        3,
    );
    refused(&["projector.planes=24"], &["`projector.planes` = 24", "plane_times = \"equal\""], 2);
    refused(&["projector.backend.slots_per_sequence=2"], &["slots_per_sequence = 1"], 2);
    refused(&["projector.backend.device_number=77"], &["ALP_NOT_ONLINE (1001)", "device_number"], 3);
    let output =
        dpm(&of_example(&["--set", "projector.backend.library=\"/no/libalp44.so\""], &library), &NO_DRIVER);
    assert!(code(&output) == 3 && err(&output).contains("/no/libalp44.so"), "{}", err(&output));
    let doctor = |more: &[&str]| {
        let args =
            [&["doctor", RIG, "--load-libraries", "--json", "--set", &library], &BINARY[..], more].concat();
        out(&dpm(&args, &NO_DRIVER))
    };
    let good = doctor(&[]);
    assert!(
        good.contains("light begins") && good.contains("80 frames/s of 8 planes are within its limits"),
        "{good}"
    );
    // Nobody has asked for the code that a rig file names.
    let args = ["doctor", RIG, "--json", "--set", &library];
    let looked_at = out(&dpm(&args, &NO_DRIVER));
    assert!(looked_at.contains("is a library for this machine"), "{looked_at}");
    assert!(!looked_at.contains("light begins"), "{looked_at}");
    let bad = doctor(&["--set", "projector.frame_rate=120"]);
    assert!(bad.contains("at most 88.8 frames/s") && bad.contains("\"missing\""), "{bad}");
}
