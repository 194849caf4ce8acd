//! Packed frames over the cable into light: the link's thread, and the mock projector's where it has one of its own.

use super::crew::Port;
use super::keeper::{is_dark, LinkKeeper};
use super::outcome::{PipelineError, StallIn};
use super::rights::Rights;
use super::threads::{enter_frame_path, is_overtaken, pop_within, Shared, STEP_NS, WARM_UP_FRAMES};
use crate::frame::job::{Fate, FrameJob, FrameMemory, FrameNote};
use crate::frame::Stage;
use crate::light::recorder::LightRecorder;
use crate::mock::{serve_cable, EmulatedProjector};
use crate::plan::lead::LeadEstimator;
use crate::realtime::os::set_timer_slack_ns;
use crate::telemetry::projector::ProjectorReport;
use dpm_common::clock::{Clock, RunClock, Stopwatch};
use dpm_device::link::{HostLink, LinkState, SendOutcome};
use dpm_device::time::HostTime;
use dpm_device::transport::inproc::{DeviceEnd, Direct, HostEnd};
use dpm_device::transport::Transport;
use dpm_handoff::channel::{Receiver, Sender};
use std::panic::{catch_unwind, AssertUnwindSafe};
use std::sync::atomic::Ordering;
use std::time::Duration;

/// How often a link without credit looks for some.
const CREDIT_STEP_NS: i64 = 50_000;
/// A link with nothing to send looks after its device this often.
const IDLE_NS: i64 = 1_000_000;
/// The same while an answer to a clock exchange is under way: how late it is looked at is how wrong the clock may be.
const ECHO_STEP_NS: i64 = 50_000;
/// What getting a lost medium back may take.
const REOPEN_NS: i64 = 2_000_000_000;
/// The supervisor says at least this often that every stage is alive, or it is not believed.
const ALIVE_WITHIN_NS: i64 = 150_000_000;
/// How long frames that are still under way after the dark are waited for, to be counted.
const CLEARED_WITHIN_NS: u64 = 300_000_000;
/// A projector outside is told to stop for at most this long; its watchdog does the rest.
const DARK_WITHIN_MS: u32 = 300;

/// The link's medium.
pub(super) enum Cable {
    Direct(Box<Direct<EmulatedProjector>>, LightRecorder),
    Threaded(HostEnd),
    /// A projector outside this process.
    Outside(Box<dyn Transport>),
}

impl Cable {
    pub(super) fn transport(&mut self) -> &mut dyn Transport {
        match self {
            Self::Direct(direct, _) => direct.as_mut(),
            Self::Threaded(end) => end,
            Self::Outside(medium) => medium.as_mut(),
        }
    }

    /// Lets the projector live up to `now` where it has no thread of its own.
    fn live(&mut self, now: HostTime) {
        if let Self::Direct(direct, recorder) = self {
            recorder.advance(direct.device_mut(), now);
        }
    }

    /// Unplugs: a projector's thread ends, and with it the notes of its light. Where it had none, its recorder is returned.
    fn end(self) -> Option<LightRecorder> {
        match self {
            Self::Direct(_, mut recorder) => {
                recorder.close();
                Some(recorder)
            }
            Self::Threaded(_) | Self::Outside(_) => None,
        }
    }
}

/// The link thread's own: the link, its medium, and what is done beside frames.
pub(super) struct Line {
    pub(super) link: HostLink,
    pub(super) cable: Cable,
    pub(super) keeper: LinkKeeper,
    pub(super) lead: LeadEstimator,
    /// Until when this thread last waited for room in the device.
    pub(super) credit_until: HostTime,
}

/// What the link leaves behind: the recorder of a projector without a thread of its own, and what was carried.
pub(super) type LineEnd = (Option<LightRecorder>, ProjectorReport);

/// Sends the frames of whichever crew works, then tells the projector to go dark: at once when a stop was asked for, after the last frames'
/// light when the run has all that it was asked for. A panic in here ends in the dark, too.
pub(super) fn link_thread(
    shared: &Shared,
    mut line: Line,
    ports: Receiver<Port>,
    done: Sender<Box<FrameNote>>,
) -> LineEnd {
    shared.rights.enter(3);
    shared.link_pulse.begin();
    let mut desk = Desk { ports, crew: None, done };
    let served = catch_unwind(AssertUnwindSafe(|| line.serve(shared, &mut desk)));
    enter_frame_path(false);
    if served.is_err() {
        shared.fail(PipelineError::Panicked("link"));
    }
    let last = served.unwrap_or_else(|_| shared.clock.now());
    line.go_dark(shared, last);
    desk.clear(shared);
    shared.link_pulse.end();
    let report = line.keeper.report(&line.link, line.cable.transport().name());
    let end = (line.cable.end(), report);
    shared.is_link_over.store(true, Ordering::Release);
    end
}

/// Where the link's thread gets its frames and where it puts what is left of them.
struct Desk {
    ports: Receiver<Port>,
    /// Frames of the crew that works, and the way back for their memory.
    crew: Option<(Receiver<FrameJob>, Sender<Box<FrameMemory>>)>,
    done: Sender<Box<FrameNote>>,
}

impl Desk {
    /// True when no frame will come any more, unless from another crew.
    fn is_finished(&self) -> bool {
        self.crew.as_ref().is_none_or(|(jobs, _)| jobs.is_finished())
    }

    /// The next frame, waited for at most `limit_ns`.
    fn next(&mut self, limit_ns: i64) -> Option<FrameJob> {
        match &mut self.crew {
            Some((jobs, _)) => pop_within(jobs, limit_ns),
            None => {
                std::thread::sleep(Duration::from_nanos(limit_ns as u64));
                None
            }
        }
    }

    /// The frame's memory goes back to the crew, its note on to the collector. False when nobody collects.
    fn finish(&mut self, job: FrameJob) -> bool {
        let FrameJob { note, memory } = job;
        if let Some((_, free)) = &mut self.crew {
            // A crew that is gone needs no memory back.
            let _ = free.push(memory);
        }
        self.done.push(note).is_ok()
    }

    /// The projector is dark: what is still under way is counted as not sent. Waits for the crew's end, but not for long.
    fn clear(&mut self, shared: &Shared) {
        let watch = Stopwatch::start();
        while !self.is_finished() && (shared.is_virtual() || watch.elapsed_ns() < CLEARED_WITHIN_NS) {
            shared.link_pulse.beat(shared.clock.now(), STEP_NS);
            if let Some(mut job) = self.next(IDLE_NS) {
                job.note.fate = Fate::Stopped;
                self.finish(job);
            }
        }
    }
}

impl Line {
    /// Sends frames until no more will come or a stop is asked for. Returns when the last one came.
    fn serve(&mut self, shared: &Shared, desk: &mut Desk) -> HostTime {
        let mut last = shared.clock.now();
        while !shared.monitor.stop_requested() {
            if let Some(port) = desk.ports.try_pop() {
                // The frames of the crew before are dropped where they are.
                desk.crew = Some((port.jobs, port.free));
                self.keeper.tell_times_to(port.times);
            }
            let is_close = !shared.is_virtual() && self.link.awaits_echo(shared.clock.now());
            let job = desk.next(if is_close { ECHO_STEP_NS } else { IDLE_NS });
            if !shared.is_virtual() {
                shared.link_pulse.beat(shared.clock.now(), self.expected_ns());
            }
            let Some(mut job) = job else {
                if desk.is_finished() && shared.is_complete.load(Ordering::Acquire) {
                    break;
                }
                if !shared.is_virtual() {
                    // Feeds the device's watchdog while nothing is to be sent.
                    self.poll(shared, shared.clock.now());
                }
                continue;
            };
            last = if shared.is_virtual() { job.note.timeline.sent_at } else { shared.clock.now() };
            let is_last = desk.crew.as_ref().is_none_or(|(jobs, _)| jobs.is_empty());
            self.take(shared, &mut job, last, is_last);
            if !desk.finish(job) {
                break;
            }
        }
        last
    }

    /// Brings one frame to the medium, or decides that it is not sent.
    /// `is_newest`: no other waits behind it.
    fn take(&mut self, shared: &Shared, job: &mut FrameJob, now: HostTime, is_newest: bool) {
        // Getting a lost medium back allocates; the rig is dark then.
        enter_frame_path(job.note.id.0 >= WARM_UP_FRAMES && self.link.state() == LinkState::Streaming);
        shared.may_stall(StallIn::Link, job.note.id.0);
        self.cable.live(now);
        let watch = Stopwatch::start();
        self.poll(shared, now);
        if !is_overtaken(shared, &mut job.note, is_newest) {
            self.send(shared, job, now);
        }
        job.note.timeline.wall_ns[Stage::Link as usize] = watch.elapsed_ns();
        if !shared.is_virtual() {
            job.note.timeline.sent_at = shared.clock.now();
        }
    }

    /// How long this thread may be silent: a medium that is gone is opened anew, which takes its time.
    fn expected_ns(&self) -> i64 {
        match self.link.state() {
            LinkState::Lost => REOPEN_NS,
            _ => STEP_NS,
        }
    }

    /// Moves the link along and does what is due beside frames.
    fn poll(&mut self, shared: &Shared, now: HostTime) {
        let Self { link, cable, keeper, .. } = self;
        let steady = shared.is_virtual();
        let alive = steady || now.0 - shared.alive_at_ns.load(Ordering::Relaxed) <= ALIVE_WITHIN_NS;
        let result = keeper.poll(now, link, cable.transport(), steady, alive, &shared.monitor);
        shared.travel_ns.store(keeper.travel_ns(), Ordering::Relaxed);
        if let Err(e) = result {
            shared.fail(e.into());
        }
    }

    /// Offers a frame to the device and learns how long it took.
    fn send(&mut self, shared: &Shared, job: &mut FrameJob, ready_at: HostTime) {
        let FrameJob { note, memory } = job;
        let now = if shared.is_virtual() { ready_at } else { self.await_credit(shared, note) };
        // What waited for room in the device, or behind a frame that did, was ready earlier.
        let queued_ns = self.credit_until.min(ready_at).ns_since(note.timeline.packed_at).max(0);
        if now > ready_at {
            self.credit_until = now;
        }
        let waited_ns = now.ns_since(ready_at) + queued_ns;
        if is_too_old(note, now, shared.rig.rate().slot_len_ns(0)) {
            note.fate = Fate::TooOld;
            // It needed what it needed, and the next one should be begun earlier.
            self.learn(shared, note, waited_ns);
            return;
        }
        let Self { link, cable, keeper, .. } = self;
        let planes = memory.planes.bytes();
        let outcome =
            link.send_frame(now, note.id.0, note.target_at, note.dark_from, planes, cable.transport());
        note.fate = Fate::Offered(outcome);
        if outcome == SendOutcome::Sent {
            keeper.sent(note);
            self.learn(shared, note, waited_ns);
        }
    }

    /// Takes in what a frame needed. Waiting for room in a device that is ahead does not ask for an earlier start: that would only fill it more.
    fn learn(&mut self, shared: &Shared, note: &FrameNote, waited_ns: i64) {
        if shared.is_virtual() {
            return;
        }
        let lead = &mut self.lead;
        lead.measured(shared.clock.now().ns_since(note.latch_due_at) - waited_ns);
        shared.lead_ns.store(lead.lead_ns(), Ordering::Relaxed);
        shared.typical_ns.store(lead.typical_ns(), Ordering::Relaxed);
    }

    /// Waits until the device has room for the frame, at most until the frame's slot begins; returns the time.
    fn await_credit(&mut self, shared: &Shared, note: &FrameNote) -> HostTime {
        let mut now = shared.clock.now();
        while self.link.state() == LinkState::Streaming
            && self.link.credit() == 0
            && now < note.timeline.due_at
            && !shared.monitor.stop_requested()
        {
            now = shared.clock.wait_until(now.plus_ns(CREDIT_STEP_NS));
            shared.link_pulse.beat(now, STEP_NS);
            self.poll(shared, now);
        }
        now
    }

    /// The last frames' light where the run came to its end, then dark. `last` is when the last frame came.
    fn go_dark(&mut self, shared: &Shared, last: HostTime) {
        let step = |from: HostTime| {
            if shared.is_virtual() {
                from.plus_ns(1_000_000)
            } else {
                shared.clock.wait_until(shared.clock.now().plus_ns(1_000_000))
            }
        };
        let mut now = if shared.is_virtual() {
            last.plus_ns(2 * shared.rig.rate().slot_len_ns(0))
        } else {
            let end = shared.clock.now().plus_ns(10_000_000 + self.keeper.travel_ns());
            while shared.clock.now() < end && !shared.monitor.stop_requested() {
                self.poll(shared, shared.clock.now());
                step(end);
            }
            shared.clock.now()
        };
        self.cable.live(now);
        self.keeper.stop(now, &mut self.link, self.cable.transport());
        // A line may still be busy with a frame: STOP is repeated until the projector says that it is dark.
        let steps = if matches!(self.cable, Cable::Outside(_)) { DARK_WITHIN_MS } else { 4 };
        for i in 1..=steps {
            now = step(now);
            shared.link_pulse.beat(now, STEP_NS);
            self.poll(shared, now);
            self.cable.live(now);
            if i >= 4 && is_dark(&self.link) {
                break;
            }
        }
    }
}

/// True when the poses of a frame that is sent at `now` will be older, once it is lit, than prediction may carry them and a slot more.
fn is_too_old(note: &FrameNote, now: HostTime, slot_ns: i64) -> bool {
    let lit_at = note.timeline.due_at.max(now);
    note.oldest_captured_at.is_some_and(|captured| lit_at.ns_since(captured) > note.predict_ns + slot_ns)
}

/// The mock projector at real pace, until the cable is unplugged. Its light, and its recorder for what is kept of it.
pub(super) fn device_thread(
    end: DeviceEnd,
    mut mock: EmulatedProjector,
    mut recorder: LightRecorder,
    clock: &RunClock,
    rights: &Rights,
) -> LightRecorder {
    // A projector of glass and metal is not late; a refusal was told by the stages, which ask for the same.
    rights.enter_projector();
    let _ = set_timer_slack_ns(1);
    serve_cable(&mut mock, end, || clock.now(), |mock, now| recorder.advance(mock, now));
    recorder.close();
    recorder
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// Found in use, R5: what counts is how old the poses are when the light falls, in the frame's slot or, where that has begun, now.
    #[test]
    fn a_frame_is_too_old_by_what_its_poses_will_be_when_it_is_lit() {
        let (slot_ns, predict_ns) = (10 * MS, 20 * MS);
        let mut note = FrameNote::new(1);
        note.predict_ns = predict_ns;
        note.timeline.due_at = HostTime(100 * MS);
        assert!(!is_too_old(&note, HostTime(500 * MS), slot_ns), "all bodies are dark: nothing is old");
        let mut at = |captured_ms: i64, now_ms: i64| {
            note.oldest_captured_at = Some(HostTime(captured_ms * MS));
            is_too_old(&note, HostTime(now_ms * MS), slot_ns)
        };
        assert!(!at(70, 90), "30 ms old in its slot: predict_ms and a slot");
        assert!(at(69, 90), "31 ms old in its slot");
        assert!(!at(80, 110) && at(80, 111), "late: judged by now");
    }
}
