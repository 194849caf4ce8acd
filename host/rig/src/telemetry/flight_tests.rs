//! Flights of made-up frames: what is in them, and what bounds them.

use super::super::interval::tests::frame;
use super::*;
use crate::config::{Overrides, RigConfig};
use crate::rig::Rig;
use dpm_device::planes::Raster;

/// 100 slots per second.
const SLOT_NS: i64 = 10_000_000;

fn folder(name: &str) -> PathBuf {
    let dir = std::env::temp_dir().join(format!("dpm-flight-{}-{name}", std::process::id()));
    let _ = std::fs::remove_dir_all(&dir);
    dir
}

/// Runs `slots` slots through a recorder; in those of `missed` the frame was not lit. Returns what it tells at the end.
fn fly(dir: &Path, slots: u64, missed: impl Fn(u64) -> bool) -> Option<String> {
    let config = RigConfig::demo(&Overrides::default()).unwrap_or_else(|e| panic!("{e}"));
    let rig = Rig::build(&config, Raster::new(16, 16)).unwrap_or_else(|e| panic!("{e}"));
    let monitor = RunMonitor::default();
    let mut recorder = FlightRecorder::new(SLOT_NS, dir).expect("a thread");
    let mut note = FrameNote::new(&rig);
    for slot in 0..slots {
        let timeline = FrameTimeline { lit_at: None, ..frame(slot as i64 * SLOT_NS, 1_000_000) };
        (note.plan.id, note.plan.slot, note.timeline) = (FrameId(slot), slot, timeline);
        note.fate = if missed(slot) { Fate::TooOld } else { Fate::Offered(SendOutcome::Sent) };
        if missed(slot) {
            note.timeline.sent_at = HostTime(0);
        }
        recorder.frame(&note);
        if missed(slot) {
            recorder.missed(slot, timeline.due_at, MissCause::Render);
        } else {
            recorder.lit(FrameId(slot), timeline.due_at, timeline.due_at.plus_ns(SLOT_NS / 2));
        }
        recorder.look(&monitor, None);
        // As at real pace, the disk is faster than flights come.
        while recorder.to.as_ref().is_some_and(|to| !to.is_empty()) {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    recorder.finish(None)
}

fn count(dir: &Path) -> usize {
    std::fs::read_dir(dir).map_or(0, Iterator::count)
}

#[test]
fn a_miss_is_told_with_the_frames_around_it() {
    let dir = folder("one");
    let told = fly(&dir, 1_000, |slot| (500..503).contains(&slot)).expect("there was a miss");
    assert!(
        told.contains("1 flights") && !told.contains("left out") && !told.contains("could not"),
        "{told}"
    );
    assert_eq!(count(&dir), 2);
    let page = std::fs::read_to_string(dir.join("flight-00.txt")).unwrap();
    assert!(
        page.contains("3 missed slots, the first at 5.0") && page.contains("slots 500 to 502 missed: render"),
        "{page}"
    );
    let marked: Vec<&str> = page.lines().filter(|l| l.starts_with('*')).collect();
    assert_eq!(marked.len(), 3, "{page}");
    assert!(marked[0].contains("500") && marked[0].contains("too old"), "{page}");
    let trace: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(dir.join("flight-00.json")).unwrap()).unwrap();
    let sends = trace.as_array().unwrap().iter().filter(|e| e["name"] == "send").count();
    // Two seconds before and half a second after, without the three that were not sent.
    assert!((245..=253).contains(&sends), "{sends}");
    std::fs::remove_dir_all(&dir).unwrap();
}

#[test]
fn without_a_miss_nothing_is_written_and_misses_without_end_are_bounded() {
    let dir = folder("none");
    assert_eq!((fly(&dir, 500, |_| false), count(&dir)), (None, 0));
    // Thirteen minutes in which every slot is missed.
    let told = fly(&dir, 80_000, |_| true).expect("misses");
    assert!(told.contains("in 32 files") && told.contains("left out"), "{told}");
    assert_eq!(count(&dir), 64);
    let largest = std::fs::read_dir(&dir).unwrap().map(|f| f.unwrap().metadata().unwrap().len()).max();
    assert!(largest < Some(1 << 20), "{largest:?}");
    std::fs::remove_dir_all(&dir).unwrap();
}
