//! Writes frames as a Chrome trace for Perfetto: one track per thread, GPU and device, and an arrow that follows each
//! frame.
//!
//! The format is the JSON array form of the "Trace Event Format" document. Slices are complete events ("X"). The path
//! of frame n is a flow with id n ("s", "t", "f" with `bp: e`), whose points lie inside the slices that they bind to.
//! Slices on one track must nest or follow each other, so frames that are in flight together are spread over lanes.

use crate::frame::{FrameTimeline, Stage};
use crate::plan::frame::FrameId;
use dpm_common::realtime::standstill::Standstills;
use dpm_device::time::HostTime;
use dpm_render::PASSES;
use std::io::{Error, Write};

/// A track group in the viewer.
const HOST: u32 = 1;
const GPU: u32 = 2;
const DEVICE: u32 = 3;

/// Where slices go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
enum TraceTrack {
    Tracker = 0,
    Plan,
    Gpu,
    Pack,
    Link,
    Light,
}

const TRACKS: [(TraceTrack, u32, &str); 6] = [
    (TraceTrack::Tracker, DEVICE, "tracker: exposure to arrival"),
    (TraceTrack::Plan, HOST, "plan"),
    (TraceTrack::Gpu, GPU, "render"),
    (TraceTrack::Pack, HOST, "pack"),
    (TraceTrack::Link, HOST, "link"),
    (TraceTrack::Light, DEVICE, "projector: light"),
];

/// Lanes per track. If more frames are in flight, they share the last lane, and each is clipped to begin there when
/// the one before ends.
const LANES: usize = 8;

/// A frame's path, as shown by the trace.
#[derive(Clone, Debug)]
pub(crate) struct FrameTrace<'a> {
    /// Which frame.
    pub id: FrameId,
    /// Which slot it was lit in.
    pub slot: u64,
    /// Stamps.
    pub timeline: &'a FrameTimeline,
    /// Last photon; `None` if the device does not report it.
    pub last_photon_at: Option<HostTime>,
    /// Name and length of each GPU pass, ns, in order; may be empty.
    pub passes: &'a [(&'a str, u64)],
}

/// A frame kept for a trace.
#[derive(Clone, Debug)]
pub struct TracedFrame {
    /// Which frame.
    pub id: FrameId,
    /// Which slot it was lit in.
    pub slot: u64,
    /// Stamps.
    pub timeline: FrameTimeline,
    /// Last photon.
    pub last_photon_at: HostTime,
    /// GPU time of each of [`PASSES`], ns; 0 if the device does not report it.
    pub pass_ns: [u64; PASSES.len()],
}

/// Writes a trace of frames, and marks each standstill of the machine.
pub fn write_trace(out: impl Write, frames: &[TracedFrame], standstills: &Standstills) -> Result<(), Error> {
    let mut trace = TraceWriter::new(out)?;
    for frame in frames {
        let mut passes = [("", 0); PASSES.len()];
        for (pass, (name, ns)) in passes.iter_mut().zip(PASSES.iter().zip(frame.pass_ns)) {
            *pass = (*name, ns);
        }
        trace.frame(&FrameTrace {
            id: frame.id,
            slot: frame.slot,
            timeline: &frame.timeline,
            last_photon_at: Some(frame.last_photon_at),
            passes: &passes,
        })?;
    }
    for gap in standstills.gaps() {
        trace.mark("the machine stood still from here", gap.from)?;
    }
    trace.finish().map(|_| ())
}

/// Writes a trace event by event. Call [`TraceWriter::finish`] at the end; a trace that was cut off still opens, as
/// the format permits.
#[derive(Debug)]
pub(crate) struct TraceWriter<W: Write> {
    out: W,
    lanes: [[i64; LANES]; TRACKS.len()],
    first: bool,
}

/// A placed slice.
struct TraceSlice {
    pid: u32,
    tid: u32,
    from: i64,
    to: i64,
}

impl<W: Write> TraceWriter<W> {
    /// Starts a trace and names its tracks.
    pub(crate) fn new(out: W) -> Result<Self, Error> {
        let mut trace = Self { out, lanes: [[i64::MIN; LANES]; TRACKS.len()], first: true };
        trace.out.write_all(b"[\n")?;
        for (pid, name) in [(HOST, "host"), (GPU, "GPU"), (DEVICE, "devices")] {
            trace.event(format_args!(
                r#"{{"ph":"M","name":"process_name","pid":{pid},"tid":0,"args":{{"name":"{name}"}}}}"#
            ))?;
        }
        for (track, pid, name) in TRACKS {
            for lane in 0..LANES {
                let tid = tid(track, lane);
                let lane_name = if lane == 0 { String::new() } else { format!(" ({})", lane + 1) };
                trace.event(format_args!(
                    r#"{{"ph":"M","name":"thread_name","pid":{pid},"tid":{tid},"args":{{"name":"{name}{lane_name}"}}}}"#
                ))?;
            }
        }
        Ok(trace)
    }

    /// Writes a frame's slices and its flow.
    pub(crate) fn frame(&mut self, frame: &FrameTrace<'_>) -> Result<(), Error> {
        let t = frame.timeline;
        let mut journey = vec![
            self.slice(TraceTrack::Tracker, "sample", t.captured_at, t.received_at, frame)?,
            self.slice(TraceTrack::Plan, "latch and submit", t.latched_at, t.submitted_at, frame)?,
        ];
        // A stamp of zero: the frame never got there.
        if t.rendered_at != HostTime(0) {
            let gpu = self.slice(TraceTrack::Gpu, "render", t.submitted_at, t.rendered_at, frame)?;
            self.passes(&gpu, frame.passes)?;
            journey.push(gpu);
        }
        if t.packed_at != HostTime(0) {
            journey.push(self.slice(TraceTrack::Pack, "pack", t.packing_at, t.packed_at, frame)?);
        }
        if t.sent_at != HostTime(0) {
            let sending = i64::try_from(t.wall_ns[Stage::Link as usize]).unwrap_or(i64::MAX);
            let link_began = t.sent_at.plus_ns(-sending).max(t.packed_at);
            journey.push(self.slice(TraceTrack::Link, "send", link_began, t.sent_at, frame)?);
        }
        if let Some(lit_at) = t.lit_at {
            let end = frame.last_photon_at.unwrap_or(lit_at.plus_ns(1_000));
            journey.push(self.slice(TraceTrack::Light, "light", lit_at, end, frame)?);
        }
        let last = journey.len() - 1;
        for (i, place) in journey.iter().enumerate() {
            let ph = match i {
                0 => "s",
                _ if i == last => "f",
                _ => "t",
            };
            let binding = if i == last { r#","bp":"e""# } else { "" };
            // The middle of the slice, so that it lies inside whatever the rounding.
            let at = Micros(place.from + (place.to - place.from) / 2);
            self.event(format_args!(
                r#"{{"ph":"{ph}","name":"frame","cat":"frame","id":{},"pid":{},"tid":{},"ts":{at}{binding}}}"#,
                frame.id.0, place.pid, place.tid
            ))?;
        }
        Ok(())
    }

    /// Marks an instant that concerns all tracks: a missed slot, a standstill, a lost body. `name` must not require
    /// escaping.
    pub(crate) fn mark(&mut self, name: &str, at: HostTime) -> Result<(), Error> {
        let plain: String = name.chars().filter(|c| !c.is_control() && !matches!(c, '"' | '\\')).collect();
        self.event(format_args!(
            r#"{{"ph":"i","name":"{plain}","s":"g","pid":{HOST},"tid":{},"ts":{}}}"#,
            tid(TraceTrack::Plan, 0),
            Micros(at.0)
        ))
    }

    /// Closes the array and returns the writer.
    pub(crate) fn finish(mut self) -> Result<W, Error> {
        self.out.write_all(b"\n]\n")?;
        self.out.flush()?;
        Ok(self.out)
    }

    fn passes(&mut self, gpu: &TraceSlice, passes: &[(&str, u64)]) -> Result<(), Error> {
        let mut from = gpu.from;
        for (name, ns) in passes {
            // Children must lie inside their parent; time stamps of another clock may exceed it a little.
            let to = from.saturating_add(i64::try_from(*ns).unwrap_or(i64::MAX)).min(gpu.to);
            if to > from {
                self.event(format_args!(
                    r#"{{"ph":"X","name":"{name}","cat":"gpu","pid":{},"tid":{},"ts":{},"dur":{}}}"#,
                    gpu.pid,
                    gpu.tid,
                    Micros(from),
                    Micros(to - from)
                ))?;
            }
            from = to;
        }
        Ok(())
    }

    /// Places a slice on the first free lane and writes it.
    fn slice(
        &mut self,
        track: TraceTrack,
        name: &str,
        from: HostTime,
        to: HostTime,
        frame: &FrameTrace<'_>,
    ) -> Result<TraceSlice, Error> {
        let lanes = &mut self.lanes[track as usize];
        let lane = lanes.iter().position(|end| *end <= from.0).unwrap_or(LANES - 1);
        let from = from.0.max(lanes[lane]);
        let to = to.0.max(from);
        lanes[lane] = to;
        let place = TraceSlice { pid: TRACKS[track as usize].1, tid: tid(track, lane), from, to };
        self.event(format_args!(
            r#"{{"ph":"X","name":"{name}","cat":"frame","pid":{},"tid":{},"ts":{},"dur":{},"args":{{"frame":{},"slot":{}}}}}"#,
            place.pid,
            place.tid,
            Micros(from),
            Micros(to - from),
            frame.id.0,
            frame.slot
        ))?;
        Ok(place)
    }

    fn event(&mut self, event: std::fmt::Arguments<'_>) -> Result<(), Error> {
        if !std::mem::take(&mut self.first) {
            self.out.write_all(b",\n")?;
        }
        self.out.write_fmt(event)
    }
}

fn tid(track: TraceTrack, lane: usize) -> u32 {
    (10 * (track as usize + 1) + lane) as u32
}

/// Nanoseconds as microseconds with three decimals, without floating point.
struct Micros(i64);

impl std::fmt::Display for Micros {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let sign = if self.0 < 0 { "-" } else { "" };
        let ns = self.0.unsigned_abs();
        write!(f, "{sign}{}.{:03}", ns / 1000, ns % 1000)
    }
}

#[cfg(test)]
#[path = "trace_tests.rs"]
mod tests;
