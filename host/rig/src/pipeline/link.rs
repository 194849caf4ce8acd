//! From packed frames to light at real pace: the link's thread, and the mock projector's thread if it is in this
//! process.

use super::crew::CrewPort;
use super::rights::Rights;
use super::threads::{enter_frame_path, may_stall, pop_within, RunState, STEP_NS, WARM_UP_FRAMES};
use crate::engine::error::PipelineError;
use crate::engine::link::{LinkStage, Offer};
use crate::engine::options::StallIn;
use crate::engine::pace::Real;
use crate::frame::job::{Fate, FrameJob};
use crate::frame::Stage;
use crate::light::notes::NoteSender;
use crate::light::recorder::LightRecorder;
use crate::mock::{serve_cable, EmulatedProjector};
use crate::telemetry::projector::ProjectorReport;
use dpm_common::clock::{Clock, MonotonicClock, Stopwatch};
use dpm_common::realtime::os::{set_timer_slack_ns, thread_id};
use dpm_device::transport::inproc::DeviceEnd;
use dpm_device::transport::Transport;
use dpm_handoff::channel::{Receiver, Sender};
use std::panic::{catch_unwind, AssertUnwindSafe};
use std::sync::atomic::Ordering;
use std::time::Duration;

/// After the dark, how long frames that are still in flight are awaited in order to count them, nanoseconds.
const CLEARED_WITHIN_NS: u64 = 300_000_000;
/// Time between two checks for such frames, nanoseconds.
const CLEAR_STEP_NS: i64 = 1_000_000;

/// The link thread's state: the deciding part and the medium.
pub(super) struct LinkThread {
    pub(super) stage: LinkStage<Real>,
    pub(super) medium: Box<dyn Transport>,
}

/// Sends the frames of the current crew, then orders the projector to go dark: at once if a stop was requested, after
/// the last frames' light if the run is complete. A panic in this thread also ends in the dark.
pub(super) fn link_thread(
    shared: &RunState,
    mut line: LinkThread,
    ports: Receiver<CrewPort>,
    notes: NoteSender,
) -> ProjectorReport {
    shared.rights.enter(3);
    shared.link_pulse.begin(thread_id());
    let mut desk = FramePort { ports, crew: None, notes };
    let served = catch_unwind(AssertUnwindSafe(|| line.serve(shared, &mut desk)));
    enter_frame_path(false);
    if served.is_err() {
        shared.facts.fail(PipelineError::Panicked("link"));
    }
    line.go_dark(shared);
    desk.clear(shared);
    shared.link_pulse.end();
    let report = line.stage.report(line.medium.name());
    // This unplugs the cable: a mock projector's thread ends, and with it the notes of its light.
    drop(line);
    shared.is_link_over.store(true, Ordering::Release);
    report
}

/// Where the link's thread receives its frames and returns them.
struct FramePort {
    ports: Receiver<CrewPort>,
    /// Frames of the current crew, and the way back for them.
    crew: Option<(Receiver<FrameJob>, Sender<FrameJob>)>,
    notes: NoteSender,
}

impl FramePort {
    /// True when no frame will come any more, except from another crew.
    fn is_finished(&self) -> bool {
        self.crew.as_ref().is_none_or(|(jobs, _)| jobs.is_finished())
    }

    /// True when no frame waits.
    fn is_empty(&self) -> bool {
        self.crew.as_ref().is_none_or(|(jobs, _)| jobs.is_empty())
    }

    /// The next frame; waits at most `limit_ns`.
    fn next(&mut self, limit_ns: i64) -> Option<FrameJob> {
        match &mut self.crew {
            Some((jobs, _)) => pop_within(jobs, limit_ns),
            None => {
                std::thread::sleep(Duration::from_nanos(limit_ns as u64));
                None
            }
        }
    }

    /// Passes what the frame's note says to the collector, and returns its memory with a note to the crew.
    fn finish(&mut self, mut job: FrameJob) {
        job.note = self.notes.exchange(job.note);
        if let Some((_, free)) = &mut self.crew {
            // A crew that is gone needs no memory.
            let _ = free.push(job);
        }
    }

    /// The projector is dark. Counts frames that are still in flight as not sent. Waits briefly for the crew's end.
    fn clear(&mut self, shared: &RunState) {
        let watch = Stopwatch::start();
        while !self.is_finished() && watch.elapsed_ns() < CLEARED_WITHIN_NS {
            shared.link_pulse.beat(shared.clock.now(), STEP_NS);
            if let Some(mut job) = self.next(CLEAR_STEP_NS) {
                job.note.fate = Fate::Stopped;
                self.finish(job);
            }
        }
    }
}

impl LinkThread {
    /// Sends frames until no more will come or a stop is requested.
    fn serve(&mut self, shared: &RunState, desk: &mut FramePort) {
        while !shared.facts.monitor.stop_requested() {
            if let Some(port) = desk.ports.try_pop() {
                // Frames of the former crew are dropped.
                desk.crew = Some((port.jobs, port.free));
                self.stage.tell_times_to(port.times);
                if let Some(tracks) = port.tracks {
                    self.stage.follow_by(tracks);
                }
            }
            let job = desk.next(self.stage.rest_ns(shared.clock.now()));
            let now = shared.clock.now();
            shared.link_pulse.beat(now, self.stage.expected_ns(STEP_NS));
            match job {
                Some(mut job) => {
                    let is_newest = desk.is_empty();
                    self.take(shared, &mut job, is_newest);
                    desk.finish(job);
                }
                None if desk.is_finished() && shared.facts.is_complete.load(Ordering::Acquire) => return,
                // Polling feeds the device's watchdog while there is nothing to send.
                None => self.stage.poll(now, self.medium.as_mut()),
            }
        }
    }

    /// Sends one frame, or leaves it out.
    fn take(&mut self, shared: &RunState, job: &mut FrameJob, is_newest: bool) {
        let FrameJob { note, memory } = job;
        let clock = &shared.clock;
        // Reopening a lost medium allocates, but the rig is dark then.
        enter_frame_path(note.plan.id.0 >= WARM_UP_FRAMES && self.stage.is_streaming());
        may_stall(&shared.facts, StallIn::Link, note.plan.id.0);
        let watch = Stopwatch::start();
        let mut now = clock.now();
        let (planes, medium) = (memory.outgoing(), self.medium.as_mut());
        while let Offer::Again(at) = self.stage.offer(now, note, planes, is_newest, medium) {
            now = clock.wait_until(at);
            shared.link_pulse.beat(now, self.stage.expected_ns(STEP_NS));
        }
        note.timeline.wall_ns[Stage::Link as usize] = watch.elapsed_ns();
        self.stage.taken(note, clock.now());
    }

    /// Waits for the last frames' light if the run is complete, then goes dark.
    fn go_dark(&mut self, shared: &RunState) {
        let last = shared.clock.now();
        let mut now = last;
        while let Some(at) = self.stage.end(now, last, self.medium.as_mut()) {
            now = shared.clock.wait_until(at);
            shared.link_pulse.beat(now, STEP_NS);
        }
    }
}

/// The mock projector at real pace, until the cable is unplugged. Returns its recorder, which has the light that was
/// kept.
pub(super) fn device_thread(
    end: DeviceEnd,
    mut mock: EmulatedProjector,
    mut recorder: LightRecorder,
    clock: MonotonicClock,
    rights: &Rights,
) -> LightRecorder {
    // Real hardware has no scheduling jitter, so the mock asks for the highest priority. If that is refused, the
    // stages report it.
    rights.enter_projector();
    let _ = set_timer_slack_ns(1);
    serve_cable(&mut mock, end, || clock.now(), |mock, now| recorder.advance(mock, now));
    recorder.close();
    recorder
}
