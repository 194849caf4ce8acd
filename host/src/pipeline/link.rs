//! Packed frames over the cable into light: the link's thread, and the mock projector's where it has one of its own.

use super::job::{Fate, FrameJob, FrameMemory, FrameNote};
use super::keeper::{is_dark, LinkKeeper, ProjectorReport};
use super::light::LightRecorder;
use super::outcome::StallIn;
use super::rights::Rights;
use super::threads::{enter_frame_path, is_overtaken, pop_within, Shared, WARM_UP_FRAMES};
use crate::clock::{Clock, RunClock, Stopwatch};
use crate::frame::Stage;
use crate::plan::lead::LeadEstimator;
use crate::realtime::os::set_timer_slack_ns;
use dpm_device::link::{HostLink, LinkState, SendOutcome};
use dpm_device::time::HostTime;
use dpm_device::transport::inproc::{DeviceEnd, Direct, HostEnd};
use dpm_device::transport::Transport;
use dpm_handoff::channel::{Receiver, Sender};
use hil_mock::projector::{serve_cable, EmulatedProjector};
use std::sync::atomic::Ordering;

/// How often a link without credit looks for some.
const CREDIT_STEP_NS: i64 = 50_000;
/// A link with nothing to send looks after its device this often.
const IDLE_NS: i64 = 1_000_000;
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
}

/// Sends frames until no more come, then tells the projector to go dark. Returns the recorder of a projector without a thread of its
/// own, and what was carried.
pub(super) fn link_thread(
    shared: &Shared<'_>,
    mut line: Line,
    mut jobs: Receiver<FrameJob>,
    mut free: Sender<Box<FrameMemory>>,
    mut done: Sender<Box<FrameNote>>,
) -> (Option<LightRecorder>, ProjectorReport) {
    shared.rights.enter(3);
    let mut last = shared.clock.now();
    while !jobs.is_finished() {
        let Some(mut job) = pop_within(&mut jobs, IDLE_NS) else {
            if !shared.is_virtual() {
                // Feeds the device's watchdog while nothing is to be sent.
                line.poll(shared, shared.clock.now());
            }
            continue;
        };
        // Getting a lost medium back allocates; the rig is dark then.
        enter_frame_path(job.note.id.0 >= WARM_UP_FRAMES && line.link.state() == LinkState::Streaming);
        shared.may_stall(StallIn::Link, job.note.id.0);
        let now = if shared.is_virtual() { job.note.timeline.sent_at } else { shared.clock.now() };
        last = now;
        line.cable.live(now);
        let watch = Stopwatch::start();
        line.poll(shared, now);
        if !is_overtaken(shared, &mut job.note, &jobs) {
            line.send(shared, &mut job, now);
        }
        job.note.timeline.wall_ns[Stage::Link as usize] = watch.elapsed_ns();
        if !shared.is_virtual() {
            job.note.timeline.sent_at = shared.clock.now();
        }
        let FrameJob { note, memory } = job;
        if free.push(memory).is_err() || done.push(note).is_err() {
            break;
        }
    }
    enter_frame_path(false);
    line.go_dark(shared, last);
    let report = line.keeper.report(&line.link, line.cable.transport().name());
    (line.cable.end(), report)
}

impl Line {
    /// Moves the link along and does what is due beside frames.
    fn poll(&mut self, shared: &Shared<'_>, now: HostTime) {
        let Self { link, cable, keeper, .. } = self;
        let result = keeper.poll(now, link, cable.transport(), shared.is_virtual(), shared.monitor);
        shared.travel_ns.store(keeper.travel_ns(), Ordering::Relaxed);
        if let Err(e) = result {
            shared.fail(e.into());
        }
    }

    /// Offers a frame to the device and learns how long it took.
    fn send(&mut self, shared: &Shared<'_>, job: &mut FrameJob, ready_at: HostTime) {
        let FrameJob { note, memory } = job;
        let now = if shared.is_virtual() { ready_at } else { self.await_credit(shared, note) };
        let waited_ns = now.ns_since(ready_at);
        let Self { link, cable, keeper, lead } = self;
        let outcome =
            link.send_frame(now, note.id.0, note.target_at, memory.planes.bytes(), cable.transport());
        note.fate = Fate::Offered(outcome);
        if outcome != SendOutcome::Sent {
            return;
        }
        keeper.sent(note);
        if shared.is_virtual() {
            return;
        }
        // Waiting for room in a device that is ahead does not ask for an earlier start: that would only fill it more.
        lead.measured(shared.clock.now().ns_since(note.latch_due_at) - waited_ns);
        shared.lead_ns.store(lead.lead_ns(), Ordering::Relaxed);
        shared.typical_ns.store(lead.typical_ns(), Ordering::Relaxed);
    }

    /// Waits until the device has room for the frame, at most until the frame's slot begins; returns the time.
    fn await_credit(&mut self, shared: &Shared<'_>, note: &FrameNote) -> HostTime {
        let mut now = shared.clock.now();
        while self.link.state() == LinkState::Streaming
            && self.link.credit() == 0
            && now < note.timeline.due_at
        {
            now = shared.clock.wait_until(now.plus_ns(CREDIT_STEP_NS));
            self.poll(shared, now);
        }
        now
    }

    /// The last frames' light, then dark. `last` is when the last frame came.
    fn go_dark(&mut self, shared: &Shared<'_>, last: HostTime) {
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
            while shared.clock.now() < end {
                self.poll(shared, shared.clock.now());
                step(end);
            }
            end
        };
        self.cable.live(now);
        self.keeper.stop(now, &mut self.link, self.cable.transport());
        // A line may still be busy with a frame: STOP is repeated until the projector says that it is dark.
        let steps = if matches!(self.cable, Cable::Outside(_)) { DARK_WITHIN_MS } else { 4 };
        for i in 1..=steps {
            now = step(now);
            self.poll(shared, now);
            self.cable.live(now);
            if i >= 4 && is_dark(&self.link) {
                break;
            }
        }
    }
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
