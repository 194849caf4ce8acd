//! A checker of the trace format, and traces of frames in flight together.

use super::super::interval::tests::frame;
use super::*;
use serde_json::Value;
use std::collections::BTreeMap;

/// Start, end, name.
type Slice = (f64, f64, String);

/// What the format and Perfetto's importer demand. Returns the points of each flow: (phase, names of the slices it lies in).
fn check(text: &str) -> BTreeMap<u64, Vec<(String, String)>> {
    let events: Vec<Value> = serde_json::from_str(text).expect("valid JSON");
    let number = |e: &Value, key: &str| e[key].as_f64().unwrap_or_else(|| panic!("{key} missing in {e}"));
    let mut slices: BTreeMap<(u64, u64), Vec<Slice>> = BTreeMap::new();
    let mut named = Vec::new();
    for e in &events {
        let (pid, tid) = (number(e, "pid") as u64, number(e, "tid") as u64);
        match e["ph"].as_str().expect("phase") {
            "M" => named.push((pid, tid)),
            "X" => {
                let (ts, dur) = (number(e, "ts"), number(e, "dur"));
                assert!(dur >= 0.0, "{e}");
                let name = e["name"].as_str().unwrap().to_owned();
                slices.entry((pid, tid)).or_default().push((ts, ts + dur, name));
            }
            "s" | "t" | "f" | "i" => {}
            other => panic!("unknown phase {other}"),
        }
    }
    for (track, list) in &mut slices {
        assert!(named.contains(track), "track {track:?} has no name");
        list.sort_by(|a, b| a.0.total_cmp(&b.0).then(b.1.total_cmp(&a.1)));
        let mut open: Vec<f64> = Vec::new();
        for (from, to, name) in list.iter() {
            while open.last().is_some_and(|end| *end <= from + 1e-9) {
                open.pop();
            }
            assert!(open.last().is_none_or(|end| *to <= end + 1e-9), "{name} at {from} crosses a neighbour");
            open.push(*to);
        }
    }
    let mut flows: BTreeMap<u64, Vec<(String, String)>> = BTreeMap::new();
    for e in events.iter().filter(|e| matches!(e["ph"].as_str(), Some("s" | "t" | "f"))) {
        let ts = number(e, "ts");
        let track = &slices[&(number(e, "pid") as u64, number(e, "tid") as u64)];
        let inside = track.iter().find(|(from, to, _)| *from <= ts + 1e-9 && ts <= *to + 1e-9);
        let (_, _, name) = inside.unwrap_or_else(|| panic!("{e} lies in no slice"));
        assert_eq!((e["cat"].as_str(), e["name"].as_str()), (Some("frame"), Some("frame")));
        let flow = flows.entry(number(e, "id") as u64).or_default();
        flow.push((e["ph"].as_str().unwrap().to_owned(), name.clone()));
    }
    flows
}

fn trace(frames: &[(FrameTimeline, Vec<(&str, u64)>)]) -> String {
    let mut writer = TraceWriter::new(Vec::new()).unwrap();
    for (i, (timeline, passes)) in frames.iter().enumerate() {
        let last_photon_at = timeline.lit_at.map(|t| t.plus_ns(900_000));
        writer
            .frame(&FrameTrace {
                id: FrameId(i as u64),
                slot: i as u64 + 5,
                timeline,
                last_photon_at,
                passes,
            })
            .unwrap();
    }
    writer.mark("missed \"slot\"\n", HostTime(1)).unwrap();
    String::from_utf8(writer.finish().unwrap()).unwrap()
}

#[test]
fn every_lit_frame_can_be_followed_from_sample_to_light() {
    // 947 fps with 3 ms from sample to light: three frames under way on every track.
    let frames: Vec<_> = (0..200)
        .map(|k| {
            (frame(k * 1_055_966, 400_000), vec![("trace", 150_000), ("filter", 100_000), ("pack", 900_000)])
        })
        .collect();
    let flows = check(&trace(&frames));
    assert_eq!(flows.len(), 200);
    for (id, points) in flows {
        let phases: Vec<_> = points.iter().map(|(ph, _)| ph.as_str()).collect();
        assert_eq!(phases, ["s", "t", "t", "t", "t", "f"], "frame {id}");
        let names: Vec<_> = points.iter().map(|(_, name)| name.as_str()).collect();
        assert_eq!(names[..2], ["sample", "latch and submit"]);
        assert!(["render", "trace", "filter"].contains(&names[2]), "{names:?}");
        assert_eq!(names[3..], ["pack", "send", "light"]);
    }
}

#[test]
fn odd_frames_still_make_a_valid_trace() {
    let unlit = FrameTimeline { lit_at: None, ..frame(0, 1_000) };
    let backwards = frame(50_000, -700);
    let crowded: Vec<_> = (0..20).map(|k| (frame(k, 1_000_000), vec![])).collect();
    let mut frames = vec![(unlit, vec![]), (backwards, vec![("x", u64::MAX)]), (frame(1_000_000, 0), vec![])];
    frames.extend(crowded);
    let flows = check(&trace(&frames));
    assert_eq!(flows[&0].last().unwrap(), &("f".to_owned(), "send".to_owned()));
    assert_eq!(flows.len(), 23);
}

#[test]
fn microseconds_are_exact_at_any_age() {
    for (ns, text) in [(0, "0.000"), (1, "0.001"), (-1_500, "-1.500"), (i64::MAX, "9223372036854775.807")] {
        assert_eq!(Micros(ns).to_string(), text);
    }
}
