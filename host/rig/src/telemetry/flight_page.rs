//! A flight as a page of text: what happened, and the frames around the first missed slot stage by stage.

use super::flight::{Flight, FlightFrame, Remark};
use dpm_device::time::HostTime;
use std::fmt::Write as _;

/// Frames on the page before the first missed slot, and from it on.
const FRAMES_BEFORE: usize = 12;
/// See [`FRAMES_BEFORE`].
const FRAMES_AFTER: usize = 24;
/// Most remarks on the page; the trace has all of them.
const REMARKS: usize = 60;

/// The page.
pub(super) fn page(flight: &Flight) -> String {
    let zero = flight.first_at;
    let mut text = format!(
        "Flight {}: {} missed slots, the first at {:.6} s of the run's clock. Times are milliseconds from there.\n",
        flight.number,
        flight.misses,
        zero.0 as f64 * 1e-9
    );
    let _ = writeln!(text, "The trace beside this page has {} frames.\n\nWhat happened", flight.frames.len());
    let mut lines = remarks(&flight.remarks);
    lines.extend(flight.standstills.iter().map(|gap| {
        (gap.from, format!("the machine stood still for {:.3} ms", gap.to.ns_since(gap.from) as f64 * 1e-6))
    }));
    lines.sort_by_key(|(at, _)| *at);
    for (at, line) in lines.iter().take(REMARKS) {
        let _ = writeln!(text, "  {:>10.3}  {line}", ms(*at, zero));
    }
    if lines.len() > REMARKS {
        let _ = writeln!(text, "  and {} more: see the trace", lines.len() - REMARKS);
    }
    text += "\nFrames around the first missed slot (*: its slot was missed). due: when its slot begins. latched: so late.\n\
             render, pack, link: how long each stage had it. spare: from sent until its slot, negative if too late.\n";
    text += "      frame       slot        due    latched     render       pack       link      spare  what became of it\n";
    let first = flight.frames.partition_point(|f| f.timeline.due_at < zero);
    let from = first.saturating_sub(FRAMES_BEFORE);
    let missed = |slot: u64| {
        flight
            .remarks
            .iter()
            .any(|(_, remark)| matches!(remark, Remark::Missed(missed, _) if *missed == slot))
    };
    for frame in flight.frames.iter().skip(from).take(first - from + FRAMES_AFTER) {
        row(&mut text, frame, zero, missed(frame.slot));
    }
    text
}

/// A line for each remark; consecutive slots that were missed for one cause share a line.
fn remarks(all: &[(HostTime, Remark)]) -> Vec<(HostTime, String)> {
    let mut lines = Vec::new();
    let mut rest = all.iter().peekable();
    while let Some((at, remark)) = rest.next() {
        let Remark::Missed(first, cause) = *remark else {
            lines.push((*at, remark.to_string()));
            continue;
        };
        let mut last = first;
        while rest.next_if(|(_, next)| *next == Remark::Missed(last + 1, cause)).is_some() {
            last += 1;
        }
        let slots = format!("slots {first} to {last} missed: {}", cause.name());
        lines.push((*at, if first == last { remark.to_string() } else { slots }));
    }
    lines
}

fn ms(at: HostTime, zero: HostTime) -> f64 {
    at.ns_since(zero) as f64 * 1e-6
}

fn row(text: &mut String, frame: &FlightFrame, zero: HostTime, is_missed: bool) {
    let t = &frame.timeline;
    // A stamp of zero: the frame never got there.
    let between = |from: HostTime, to: HostTime| match to {
        HostTime(0) => "-".to_owned(),
        to => format!("{:.3}", ms(to, from)),
    };
    let _ = writeln!(
        text,
        "{} {:>9} {:>10} {:>10.3} {:>10} {:>10} {:>10} {:>10} {:>10}  {}{}",
        if is_missed { '*' } else { ' ' },
        frame.id.0,
        frame.slot,
        ms(t.due_at, zero),
        between(frame.latch_due_at, t.latched_at),
        between(t.submitted_at, t.rendered_at),
        between(t.packing_at, t.packed_at),
        between(t.packed_at, t.sent_at),
        between(t.sent_at, if t.sent_at == HostTime(0) { t.sent_at } else { t.due_at }),
        frame.fate_word(),
        frame.held_up_by.map_or(String::new(), |cause| format!(", begun late: {}", cause.name())),
    );
}
