//! Checks traces of frames in flight together against the rules of the format.

use super::super::interval::tests::frame;
use super::*;
use trace_check::{check, every_frame_can_be_followed};

#[path = "../../../dpm/tests/laws/cli_common/trace_check.rs"]
mod trace_check;

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
    // 947 fps with 3 ms from sample to light: three frames in flight on every track.
    let frames: Vec<_> = (0..200)
        .map(|k| {
            (frame(k * 1_055_966, 400_000), vec![("trace", 150_000), ("filter", 100_000), ("pack", 900_000)])
        })
        .collect();
    let flows = check(&trace(&frames));
    assert_eq!(flows.len(), 200);
    every_frame_can_be_followed(&flows);
}

#[test]
fn odd_frames_still_make_a_valid_trace() {
    let unlit = FrameTimeline { lit_at: None, ..frame(0, 1_000) };
    let backwards = frame(50_000, -700);
    let crowded: Vec<_> = (0..20).map(|k| (frame(k, 1_000_000), vec![])).collect();
    let mut frames = vec![(unlit, vec![]), (backwards, vec![("x", u64::MAX)]), (frame(1_000_000, 0), vec![])];
    frames.extend(crowded);
    let flows = check(&trace(&frames));
    let last = flows[&0].last().unwrap();
    assert_eq!((last.phase.as_str(), last.slice.as_str()), ("f", "send"));
    assert_eq!(flows.len(), 23);
}

#[test]
fn microseconds_are_exact_at_any_age() {
    for (ns, text) in [(0, "0.000"), (1, "0.001"), (-1_500, "-1.500"), (i64::MAX, "9223372036854775.807")] {
        assert_eq!(Micros(ns).to_string(), text);
    }
}
