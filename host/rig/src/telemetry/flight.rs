//! The flight recorder: around each missed slot it turns what every stage did into a trace and a readable page.
//!
//! It works beside the frame path. The collector, which sees the note of every finished frame anyway, also copies it
//! into a ring that was allocated at the start. When a slot is found to be missed, the frames of the two seconds before
//! it and of half a second after it are copied once more and handed to a thread that writes them. The number of files
//! and the size of each are bounded. If the disk is slow, flights are left out and counted, and nobody waits.

use super::flight_page::page;
use super::monitor::{ProjectorHealth, RunMonitor};
use super::trace::{FrameTrace, TraceWriter};
use crate::frame::job::{Fate, FrameNote};
use crate::frame::slots::{MissCause, OrderedDark};
use crate::frame::FrameTimeline;
use crate::plan::frame::FrameId;
use dpm_common::files::write_atomically;
use dpm_common::realtime::standstill::{Gap, SeenStandstills};
use dpm_device::link::SendOutcome;
use dpm_device::time::HostTime;
use dpm_handoff::channel::{channel, Receiver, Sender};
use dpm_handoff::wake::WaitPolicy;
use dpm_render::PASSES;
use std::collections::VecDeque;
use std::io::{Error, Write as _};
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// A flight begins this long before its first miss, nanoseconds.
const BEFORE_NS: i64 = 2_000_000_000;
/// It ends this long after its last miss, and at most [`BEFORE_NS`] after its first one, nanoseconds.
const AFTER_NS: i64 = 500_000_000;
/// What the ring holds, nanoseconds: a miss is found some time after its slot.
const RING_NS: i64 = 6_000_000_000;
/// Most frames that the ring and one flight hold.
const MOST_FRAMES: usize = 8192;
/// Most remarks that are held.
const REMARKS: usize = 1024;
/// The first flights of a run are kept.
const KEPT: u64 = 16;
/// So many files hold the newest of all further flights, each in turn.
const NEWEST: u64 = 16;
/// Shortest time between two flights once the first ones are written, nanoseconds.
const REST_NS: i64 = 10_000_000_000;
/// Flights that may wait to be written.
const WAITING: usize = 2;
/// How long the end of a run waits for the last flight to be written.
const WRITTEN_WITHIN: Duration = Duration::from_secs(1);

/// What is kept of a frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct FlightFrame {
    pub(super) id: FrameId,
    /// The slot that it was planned for.
    pub(super) slot: u64,
    /// When it should have been latched.
    pub(super) latch_due_at: HostTime,
    pub(super) timeline: FrameTimeline,
    pub(super) pass_ns: [u64; PASSES.len()],
    pub(super) fate: Fate,
    /// Planning had waited for memory.
    pub(super) held_up_by: Option<MissCause>,
}

impl FlightFrame {
    /// What became of it.
    pub(super) fn fate_word(&self) -> String {
        match self.fate {
            Fate::UnderWay => "under way".into(),
            Fate::Overtaken => "overtaken".into(),
            Fate::TooOld => "too old".into(),
            Fate::Stopped => "stopped".into(),
            Fate::Offered(SendOutcome::Sent) if self.timeline.lit_at.is_some() => "lit".into(),
            Fate::Offered(SendOutcome::Sent) => "sent, no light reported".into(),
            Fate::Offered(SendOutcome::Dropped { reason }) => format!("not taken: {reason:?}"),
        }
    }
}

/// What happened beside the frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Remark {
    /// A slot was missed.
    Missed(u64, MissCause),
    /// From here on no new picture was wanted, or one was wanted again.
    Ordered(Option<OrderedDark>),
    /// The projector's state, as the link knows it.
    Projector(ProjectorHealth),
}

/// All that is written about one stretch of time.
pub(super) struct Flight {
    /// Its number in the run, from 0.
    pub(super) number: u64,
    /// The beginning of the first missed slot.
    pub(super) first_at: HostTime,
    pub(super) misses: u64,
    pub(super) frames: Vec<FlightFrame>,
    pub(super) remarks: Vec<(HostTime, Remark)>,
    pub(super) standstills: Vec<Gap>,
}

/// The misses of a flight that is not complete.
#[derive(Clone, Copy)]
struct Open {
    first_at: HostTime,
    last_at: HostTime,
    misses: u64,
}

/// The recorder. Everything but [`FlightRecorder::look`] copies into memory that is there already.
pub(crate) struct FlightRecorder {
    frames: VecDeque<FlightFrame>,
    capacity: usize,
    remarks: VecDeque<(HostTime, Remark)>,
    open: Option<Open>,
    /// When the newest frame is due.
    newest_at: HostTime,
    /// Changes of the orders that were read.
    orders_seen: u64,
    health: Option<ProjectorHealth>,
    flights: u64,
    left_out: u64,
    last_cut_at: Option<HostTime>,
    to: Option<Sender<Box<Flight>>>,
    writer: Option<JoinHandle<u64>>,
}

impl FlightRecorder {
    /// For frames every `slot_ns`. Files go to `dir`.
    ///
    /// # Errors
    /// The system cannot start a thread.
    pub(crate) fn new(slot_ns: i64, dir: &Path) -> Result<Self, Error> {
        let capacity = ((RING_NS / slot_ns.max(1)) as usize).clamp(64, MOST_FRAMES);
        let (to, from) = channel(WAITING, WaitPolicy::Park);
        let dir = dir.to_owned();
        let writer =
            std::thread::Builder::new().name("dpm-flights".into()).spawn(move || write_all(from, &dir))?;
        Ok(Self {
            frames: VecDeque::with_capacity(capacity),
            capacity,
            remarks: VecDeque::with_capacity(REMARKS),
            open: None,
            newest_at: HostTime(i64::MIN),
            orders_seen: 0,
            health: None,
            flights: 0,
            left_out: 0,
            last_cut_at: None,
            to: Some(to),
            writer: Some(writer),
        })
    }

    /// A frame reached the end of the host's part of its path.
    pub(crate) fn frame(&mut self, note: &FrameNote) {
        if self.frames.len() >= self.capacity {
            self.frames.pop_front();
        }
        self.newest_at = self.newest_at.max(note.timeline.due_at);
        self.frames.push_back(FlightFrame {
            id: note.plan.id,
            slot: note.plan.slot,
            latch_due_at: note.latch_due_at,
            timeline: note.timeline,
            pass_ns: note.cost.map_or([0; PASSES.len()], |cost| cost.pass_ns),
            fate: note.fate,
            held_up_by: note.held_up_by,
        });
    }

    /// A frame was lit from `begin` to `end`.
    pub(crate) fn lit(&mut self, id: FrameId, begin: HostTime, end: HostTime) {
        if let Some(frame) = self.frames.iter_mut().rev().find(|f| f.id == id) {
            frame.timeline.lit_at = Some(begin);
            frame.timeline.last_photon_at = Some(end);
        }
    }

    /// A slot that began at `begin` was missed.
    pub(crate) fn missed(&mut self, slot: u64, begin: HostTime, cause: MissCause) {
        self.remark(begin, Remark::Missed(slot, cause));
        let open = self.open.get_or_insert(Open { first_at: begin, last_at: begin, misses: 0 });
        open.last_at = open.last_at.max(begin);
        open.misses += 1;
    }

    fn remark(&mut self, at: HostTime, remark: Remark) {
        if self.remarks.len() >= REMARKS {
            self.remarks.pop_front();
        }
        self.remarks.push_back((at, remark));
    }

    /// Reads orders and the projector's state, and hands over a flight that is complete. Call it regularly.
    pub(crate) fn look(&mut self, monitor: &RunMonitor, standstills: Option<&SeenStandstills>) {
        let mut seen = self.orders_seen;
        monitor.dark().news(&mut seen, |at, reason| self.remark(at, Remark::Ordered(reason)));
        self.orders_seen = seen;
        let health = monitor.projector();
        if self.health.replace(health) != Some(health) {
            // Read a few milliseconds after it changed.
            self.remark(self.newest_at.max(HostTime(0)), Remark::Projector(health));
        }
        let is_complete = |open: &Open| {
            self.newest_at.ns_since(open.last_at) > AFTER_NS
                || self.newest_at.ns_since(open.first_at) > BEFORE_NS
        };
        if let Some(open) = self.open.filter(is_complete) {
            self.open = None;
            self.cut(open, standstills);
        }
    }

    fn cut(&mut self, open: Open, standstills: Option<&SeenStandstills>) {
        let rested = self.last_cut_at.is_none_or(|at| open.first_at.ns_since(at) > REST_NS);
        let to = self.to.as_mut().filter(|to| to.len() < WAITING);
        let Some(to) = to.filter(|_| rested || self.flights < KEPT) else {
            self.left_out += 1;
            return;
        };
        let (from, until) = (open.first_at.plus_ns(-BEFORE_NS), open.last_at.plus_ns(AFTER_NS));
        let is_in = |at: HostTime| from <= at && at <= until;
        let gaps = |seen: &SeenStandstills| {
            seen.with(|s| s.gaps().filter(|gap| gap.to >= from && gap.from <= until).collect::<Vec<_>>())
        };
        let flight = Flight {
            number: self.flights,
            first_at: open.first_at,
            misses: open.misses,
            frames: self.frames.iter().filter(|f| is_in(f.timeline.due_at)).copied().collect(),
            remarks: self.remarks.iter().filter(|(at, _)| is_in(*at)).copied().collect(),
            standstills: standstills.map(gaps).unwrap_or_default(),
        };
        self.last_cut_at = Some(until);
        self.flights += 1;
        if to.push(Box::new(flight)).is_err() {
            self.left_out += 1;
        }
    }

    /// Flights of this run so far.
    pub(crate) fn flights(&self) -> u64 {
        self.flights
    }

    /// The run is over. Returns what the operator should know.
    pub(crate) fn finish(mut self, standstills: Option<&SeenStandstills>) -> Option<String> {
        if let Some(open) = self.open.take() {
            self.cut(open, standstills);
        }
        self.to = None;
        let begin = Instant::now();
        while self.writer.as_ref().is_some_and(|w| !w.is_finished()) && begin.elapsed() < WRITTEN_WITHIN {
            std::thread::sleep(Duration::from_millis(1));
        }
        let failed = match self.writer.take() {
            Some(writer) if writer.is_finished() => writer.join().unwrap_or(1),
            _ => 1,
        };
        let (flights, left_out) = (self.flights, self.left_out);
        (flights + left_out > 0).then(|| {
            let files = flights.min(KEPT + NEWEST);
            let mut text =
                format!("output.flight_recorder: {flights} flights around missed slots, in {files} files");
            if left_out > 0 {
                text += &format!("; {left_out} more were left out, to bound what is written");
            }
            if failed > 0 {
                text += &format!("; {failed} could not be written");
            }
            text
        })
    }
}

/// The page of flight `number` in `dir`, as text; `None` for a number that no file has.
pub fn page_path(dir: &Path, number: u64) -> Option<PathBuf> {
    (number < KEPT + NEWEST).then(|| path_of(dir, number, "txt"))
}

/// The file of a flight: the first ones are kept, and of all further ones the newest.
fn path_of(dir: &Path, number: u64, ending: &str) -> PathBuf {
    let place = if number < KEPT { number } else { KEPT + (number - KEPT) % NEWEST };
    dir.join(format!("flight-{place:02}.{ending}"))
}

/// Writes flights until no more come. Returns how many could not be written.
fn write_all(mut from: Receiver<Box<Flight>>, dir: &Path) -> u64 {
    let (begin, mut failed) = (Instant::now(), 0);
    let now_ns = || begin.elapsed().as_nanos() as i64;
    while !from.is_finished() {
        if let Some(flight) = from.pop(now_ns() + 100_000_000, now_ns) {
            failed += u64::from(write(&flight, dir).is_err());
        }
    }
    failed
}

fn write(flight: &Flight, dir: &Path) -> Result<(), Error> {
    write_atomically(&path_of(dir, flight.number, "json"), |out| write_trace(flight, out))?;
    write_atomically(&path_of(dir, flight.number, "txt"), |out| out.write_all(page(flight).as_bytes()))
}

/// The flight as a trace, which viewers open.
fn write_trace(flight: &Flight, out: impl std::io::Write) -> Result<(), Error> {
    let mut trace = TraceWriter::new(out)?;
    for frame in &flight.frames {
        let mut passes = [("", 0); PASSES.len()];
        for (pass, (name, ns)) in passes.iter_mut().zip(PASSES.iter().zip(frame.pass_ns)) {
            *pass = (*name, ns);
        }
        trace.frame(&FrameTrace {
            id: frame.id,
            slot: frame.slot,
            timeline: &frame.timeline,
            last_photon_at: frame.timeline.last_photon_at,
            passes: &passes,
        })?;
        if frame.timeline.lit_at.is_none() {
            trace.mark(&format!("frame {}: {}", frame.id.0, frame.fate_word()), frame.timeline.due_at)?;
        }
    }
    for (at, remark) in &flight.remarks {
        trace.mark(&remark.to_string(), *at)?;
    }
    for gap in &flight.standstills {
        trace.mark("the machine stood still from here", gap.from)?;
    }
    trace.finish().map(|_| ())
}

impl std::fmt::Display for Remark {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Missed(slot, cause) => write!(f, "slot {slot} missed: {}", cause.name()),
            Self::Ordered(Some(reason)) => write!(f, "no new picture wanted: {}", reason.name()),
            Self::Ordered(None) => write!(f, "pictures wanted again"),
            Self::Projector(health) => write!(f, "projector: {health}"),
        }
    }
}

#[cfg(test)]
#[path = "flight_tests.rs"]
mod tests;
