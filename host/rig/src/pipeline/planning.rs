//! Planning in its thread: which slot a frame is for, when its poses are read, and the GPU's share of the work begun.

use super::crew::{CrewState, PLAN};
use super::outcome::{PipelineError, StallIn};
use super::threads::{
    enter_frame_path, pop_within, Shared, LISTEN_NS, MARGIN_NS, RECEIPT_NS, STEP_NS, WAIT_NS, WARM_UP_FRAMES,
};
use crate::frame::job::{FrameJob, FrameMemory, FrameNote};
use crate::plan::frame::{plan, PlanInputs};
use crate::plan::horizon::Horizon;
use crate::plan::link_time::LinkTime;
use crate::tracks::TrackSnapshot;
use dpm_common::clock::{Clock, Stopwatch};
use dpm_device::time::HostTime;
use dpm_handoff::channel::{Receiver, Sender};
use dpm_handoff::latest::Reader;
use dpm_handoff::wake::Waiter;
use dpm_render::Renderer;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// How long frames that the GPU still works on are waited for at the end.
const RELEASED_WITHIN_NS: u64 = 30_000_000_000;

/// Where planning finds what it works with.
pub(super) struct PlanInbox {
    pub(super) latest: Reader<TrackSnapshot>,
    pub(super) time: Reader<LinkTime>,
    pub(super) free: Receiver<Box<FrameMemory>>,
    pub(super) notes: Receiver<Box<FrameNote>>,
    /// Woken when the GPU has finished a frame.
    pub(super) gpu_free: Waiter,
}

/// Latches, plans and submits frames until the run has all that it was asked for, or the crew is dismissed.
pub(super) fn plan_thread(
    shared: &Shared,
    crew: &CrewState,
    renderer: Option<Renderer>,
    inbox: PlanInbox,
    to_pack: Sender<FrameJob>,
) {
    shared.rights.enter(1);
    let pulse = &crew.pulses[PLAN];
    pulse.begin();
    let mut planner = Planner::new(shared, crew, renderer, inbox, to_pack);
    while !crew.is_dismissed(shared) && !planner.is_complete() {
        pulse.beat(shared.clock.now(), WAIT_NS + STEP_NS);
        if planner.step().is_none() {
            break;
        }
    }
    enter_frame_path(false);
    if planner.is_complete() {
        shared.is_complete.store(true, Ordering::Release);
    }
    pulse.end();
    let Planner { renderer, to_pack, .. } = planner;
    // Packing comes to its end, too.
    drop(to_pack);
    let Some(renderer) = renderer else { return };
    let watch = Stopwatch::start();
    while crew.gpu.in_flight() > 0 {
        if watch.elapsed_ns() > RELEASED_WITHIN_NS {
            // The GPU may read what the renderer owns for as long as it likes: it is never freed.
            std::mem::forget(renderer);
            return;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// The planning thread's own.
struct Planner<'a> {
    shared: &'a Shared,
    crew: &'a CrewState,
    renderer: Option<Renderer>,
    inbox: PlanInbox,
    to_pack: Sender<FrameJob>,
    horizon: Horizon,
    /// What came back last is taken first: it is the warmest in the caches.
    #[allow(clippy::vec_box)] // The box is what travels between the threads.
    hottest: Vec<Box<FrameMemory>>,
    /// The last look at the memory that came back found none.
    waited: bool,
    slot_ns: i64,
    modelled_ns: i64,
    next_slot: u64,
    last_slot: Option<u64>,
}

impl<'a> Planner<'a> {
    fn new(
        shared: &'a Shared,
        crew: &'a CrewState,
        renderer: Option<Renderer>,
        mut inbox: PlanInbox,
        to_pack: Sender<FrameJob>,
    ) -> Self {
        let modelled_ns = shared.costs().iter().sum::<i64>() + MARGIN_NS;
        let listen_ns = if shared.is_virtual() { 0 } else { LISTEN_NS };
        let time = *inbox.time.latest().0;
        let next_slot = time.slot_after(shared.clock.now().plus_ns(modelled_ns + listen_ns));
        if shared.options.slots > 0 {
            let end = next_slot.saturating_add(shared.options.slots);
            // The first crew decides; one that takes over keeps to it.
            let _ = shared.end_slot.compare_exchange(0, end, Ordering::Relaxed, Ordering::Relaxed);
        }
        Self {
            shared,
            crew,
            renderer,
            inbox,
            to_pack,
            horizon: Horizon::of_rig(&shared.rig.config),
            hottest: Vec::with_capacity(shared.options.in_flight.max(2)),
            waited: false,
            slot_ns: shared.rig.rate().slot_len_ns(0),
            modelled_ns,
            next_slot,
            last_slot: None,
        }
    }

    /// Everything that the run was asked for is planned.
    fn is_complete(&self) -> bool {
        let frames = self.shared.options.frames;
        let end = self.shared.end_slot.load(Ordering::Relaxed);
        (frames > 0 && self.shared.next_frame.load(Ordering::Relaxed) >= frames)
            || (end > 0 && self.next_slot >= end)
    }

    /// Memory and a note for the next frame, waited for at most [`WAIT_NS`].
    fn memory(&mut self) -> Option<FrameJob> {
        while let Some(memory) = self.inbox.free.try_pop() {
            self.hottest.push(memory);
        }
        self.waited |= self.hottest.is_empty();
        if self.hottest.is_empty() {
            self.hottest.extend(pop_within(&mut self.inbox.free, WAIT_NS));
        }
        if self.hottest.is_empty() {
            return None;
        }
        let note = pop_within(&mut self.inbox.notes, WAIT_NS)?;
        let memory = self.hottest.pop()?;
        let mut job = FrameJob { note, memory };
        // At virtual pace waiting takes no time, and is the cause of nothing.
        job.note.waited_for_memory = std::mem::take(&mut self.waited) && !self.shared.is_virtual();
        Some(job)
    }

    /// A GPU that needs a slot or more for a frame gets them one at a time. False while it is busy.
    fn is_gpu_free(&mut self) -> bool {
        let gpu = &self.crew.gpu;
        if self.shared.is_virtual() || self.renderer.is_none() || !gpu.is_slow(self.slot_ns) {
            return true;
        }
        let clock = &self.shared.clock;
        let deadline = clock.now().plus_ns(WAIT_NS).0;
        self.inbox.gpu_free.wait(deadline, || clock.now().0, || gpu.in_flight() == 0)
    }

    /// One frame, if there is memory for it. `None` when the crew cannot go on.
    fn step(&mut self) -> Option<()> {
        let Self { shared, crew, .. } = *self;
        if !self.is_gpu_free() {
            return Some(());
        }
        let Some(mut job) = self.memory() else { return Some(()) };
        let id = shared.next_frame.load(Ordering::Relaxed);
        enter_frame_path(id >= WARM_UP_FRAMES);
        crew.planning.store(id, Ordering::Relaxed);
        shared.may_stall(StallIn::Plan, id);
        let time = *self.inbox.time.latest().0;
        let (latch_at, lead_ns) = self.choose_slot(&mut job, &time);
        if self.is_complete() {
            // What this frame would be for lies beyond the end of the run.
            self.hottest.push(job.memory);
            return Some(());
        }
        self.wait_for(latch_at);
        let (snapshot, now) = (self.inbox.latest.latest().0, shared.clock.now());
        let latched_at = if shared.is_virtual() { latch_at } else { now };
        let predict_ns = self.horizon.predict_ns(lead_ns, snapshot.latency_ns);
        shared.predict_ns.store(predict_ns, Ordering::Relaxed);
        let slot = self.next_slot;
        let stride = slot.saturating_sub(self.last_slot.unwrap_or(slot.saturating_sub(1))).clamp(1, 1000);
        job.note.budget_milli = crew.budget_milli.load(Ordering::Relaxed);
        let inputs = PlanInputs {
            slots: &time,
            id,
            slot,
            stride,
            predict_ns,
            fresh_ns: self.horizon.fresh_ns(snapshot.latency_ns),
            now: latched_at,
        };
        plan(&mut job, &shared.rig, snapshot, &inputs);
        let t = &mut job.note.timeline;
        t.latched_at = latched_at;
        if shared.is_virtual() {
            let costs = shared.costs();
            t.submitted_at = t.latched_at.plus_ns(costs[0]);
            t.rendered_at = t.submitted_at.plus_ns(costs[1]);
            t.packing_at = t.rendered_at;
            t.packed_at = t.rendered_at.plus_ns(costs[2]);
            t.sent_at = t.packed_at.plus_ns(costs[3]);
        }
        if let Some(renderer) = &mut self.renderer {
            if let Err(source) = crate::render::submit(&mut job, &shared.rig, renderer) {
                crew.fail(PipelineError::Gpu { frame: id, source });
                return None;
            }
            crew.gpu.submit();
        }
        if !shared.is_virtual() {
            job.note.timeline.submitted_at = shared.clock.now();
        }
        shared.monitor.count_planned();
        self.keep_count(id, slot, stride);
        self.to_pack.push(job).ok()
    }

    fn keep_count(&mut self, id: u64, slot: u64, stride: u64) {
        self.shared.next_frame.store(id + 1, Ordering::Relaxed);
        let before = self.shared.stride_milli.load(Ordering::Relaxed);
        let mean = before.saturating_mul(15).saturating_add(stride * 1000) / 16;
        self.shared.stride_milli.store(mean, Ordering::Relaxed);
        self.last_slot = Some(slot);
        self.next_slot = slot + 1;
    }

    /// Chooses the frame's slot. Returns when its poses are to be read, and how long before its slot that is.
    fn choose_slot(&mut self, job: &mut FrameJob, time: &LinkTime) -> (HostTime, i64) {
        let Self { shared, crew, .. } = *self;
        if shared.is_virtual() {
            let latch_at = time.host_of_slot(self.next_slot).plus_ns(-self.modelled_ns);
            job.note.latch_due_at = latch_at;
            return (latch_at, self.modelled_ns);
        }
        let travel = shared.travel_ns.load(Ordering::Relaxed) + RECEIPT_NS;
        let lead = shared.lead_ns.load(Ordering::Relaxed) + travel;
        let now = shared.clock.now();
        // Frames are begun early enough for a bad moment, so after one there is time to catch up: a slot is given up only when a frame that
        // takes as long as most do would miss it. A renderer that is slower than its slots has nothing to catch up with: its frames are
        // planned for slots that they can make.
        let slow = self.renderer.is_some() && crew.gpu.is_slow(self.slot_ns);
        let needed = if slow { lead } else { shared.typical_ns.load(Ordering::Relaxed) + travel };
        self.next_slot = self.next_slot.max(time.slot_after(now.plus_ns(needed)));
        let latch_at = time.host_of_slot(self.next_slot).plus_ns(-lead);
        // Waking up too late counts; what kept the frame from being begun earlier does not.
        job.note.latch_due_at = latch_at.max(now);
        (latch_at, lead)
    }

    /// Waits until it is time to read the poses.
    fn wait_for(&mut self, latch_at: HostTime) {
        let Self { shared, crew, .. } = *self;
        if !shared.is_virtual() {
            crew.pulses[PLAN].beat(latch_at.max(shared.clock.now()), WAIT_NS + STEP_NS);
            let now = shared.clock.wait_until(latch_at);
            crew.pulses[PLAN].beat(now, STEP_NS);
            return;
        }
        shared.clock.wait_until(latch_at);
        // What arrives later than this is no pose yet when the frame is latched.
        let track_ns = i64::from(shared.rig.config.real_time.stage_costs_us.track) * 1000;
        let heard = latch_at.plus_ns(-track_ns);
        crew.listen_to.store(heard.0, Ordering::Release);
        if let Some(tracking) = crew.tracking.get() {
            tracking.unpark();
        }
        while self.inbox.latest.latest().0.through < heard && !crew.is_dismissed(shared) {
            std::thread::yield_now();
        }
    }
}
