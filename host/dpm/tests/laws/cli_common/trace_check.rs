//! Reads a trace into the paths of its frames, and checks the rules of the format and its viewers.
//!
//! "Trace Event Format" document: complete events ("X") on one track nest or follow each other; the points of a flow
//! ("s", "t", "f") have the same category, name and id, lie inside the slices that they bind to, and begin and end
//! once.

use serde_json::Value;
use std::collections::BTreeMap;

/// Start, end, name, frame.
type Slice = (f64, f64, String, Option<u64>);

/// Where a flow touches a slice.
#[derive(Clone, Debug)]
pub(crate) struct Point {
    /// "s", "t" or "f".
    pub phase: String,
    /// The frame's own slice at that point.
    pub slice: String,
    /// Time, microseconds.
    pub at_us: f64,
}

/// The path of each frame.
///
/// # Panics
/// The trace breaks a rule of the format, or a flow touches the slice of another frame.
pub(crate) fn check(text: &str) -> BTreeMap<u64, Vec<Point>> {
    let events: Vec<Value> = serde_json::from_str(text).expect("valid JSON");
    let number = |e: &Value, key: &str| e[key].as_f64().unwrap_or_else(|| panic!("{key} missing in {e}"));
    let track = |e: &Value| (number(e, "pid") as u64, number(e, "tid") as u64);
    let mut slices: BTreeMap<(u64, u64), Vec<Slice>> = BTreeMap::new();
    let mut named = Vec::new();
    for e in &events {
        match e["ph"].as_str().expect("phase") {
            "M" => named.push(track(e)),
            "X" => {
                let (ts, dur) = (number(e, "ts"), number(e, "dur"));
                assert!(dur >= 0.0, "{e}");
                let name = e["name"].as_str().expect("a name").to_owned();
                slices.entry(track(e)).or_default().push((ts, ts + dur, name, e["args"]["frame"].as_u64()));
            }
            "i" => assert!(
                number(e, "ts").is_finite() && matches!(e["s"].as_str(), Some("g" | "p" | "t")),
                "{e}"
            ),
            "s" | "t" | "f" => {}
            other => panic!("unknown phase {other}"),
        }
    }
    for (track, list) in &mut slices {
        assert!(named.contains(track), "track {track:?} has no name");
        list.sort_by(|a, b| a.0.total_cmp(&b.0).then(b.1.total_cmp(&a.1)));
        let mut open: Vec<f64> = Vec::new();
        for (from, to, name, _) in list.iter() {
            while open.last().is_some_and(|end| *end <= from + 1e-9) {
                open.pop();
            }
            assert!(open.last().is_none_or(|end| *to <= end + 1e-9), "{name} at {from} crosses a neighbour");
            open.push(*to);
        }
    }
    let mut flows: BTreeMap<u64, Vec<Point>> = BTreeMap::new();
    for e in events.iter().filter(|e| matches!(e["ph"].as_str(), Some("s" | "t" | "f"))) {
        let (ts, id) = (number(e, "ts"), number(e, "id") as u64);
        let own = slices[&track(e)]
            .iter()
            .find(|(from, to, _, frame)| *frame == Some(id) && *from <= ts + 1e-9 && ts <= *to + 1e-9);
        let (_, _, name, _) = own.unwrap_or_else(|| panic!("{e} lies in no slice of its frame"));
        assert_eq!((e["cat"].as_str(), e["name"].as_str()), (Some("frame"), Some("frame")));
        let phase = e["ph"].as_str().unwrap_or_default().to_owned();
        flows.entry(id).or_default().push(Point { phase, slice: name.clone(), at_us: ts });
    }
    for (id, points) in &flows {
        let count = |phase: &str| points.iter().filter(|p| p.phase == phase).count();
        assert_eq!((count("s"), count("f")), (1, 1), "frame {id} begins and ends once: {points:?}");
    }
    flows
}

/// Checks that every path leads forwards from the sample to the light.
///
/// # Panics
/// One does not.
pub(crate) fn every_frame_can_be_followed(flows: &BTreeMap<u64, Vec<Point>>) {
    for (id, points) in flows {
        let names: Vec<&str> = points.iter().map(|p| p.slice.as_str()).collect();
        assert_eq!(names, ["sample", "latch and submit", "render", "pack", "send", "light"], "frame {id}");
        let phases: Vec<&str> = points.iter().map(|p| p.phase.as_str()).collect();
        assert_eq!(phases, ["s", "t", "t", "t", "t", "f"], "frame {id}");
        assert!(points.is_sorted_by(|a, b| a.at_us <= b.at_us), "frame {id} goes back in time: {points:?}");
    }
}
