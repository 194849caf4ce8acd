//! Decides which slot the next frame is for, when its poses are read, and when all frames of the run are planned.

use super::facts::{CrewFacts, Facts};
use super::genlock::{self, SampleWait};
use super::pace::{modelled_ns, Pace};
use crate::frame::job::{Fate, FrameNote};
use crate::frame::FrameTimeline;
use crate::gaze::GazeSample;
use crate::parameters::applied::ParameterVersion;
use crate::plan::eyes::HeadWatch;
use crate::plan::frame::PlanInputs;
use crate::plan::horizon::Horizon;
use crate::plan::link_time::LinkTime;
use crate::tracks::TrackSnapshot;
use dpm_device::time::HostTime;
use dpm_handoff::latest::Reader;
use std::marker::PhantomData;
use std::sync::atomic::Ordering;
use std::sync::Arc;

/// How long trackers are read before the first frame, so that the filters know the motion, nanoseconds.
pub(crate) const LISTEN_NS: i64 = 150_000_000;

/// How often planning looks whether the medium is free, where a frame waits for that, nanoseconds.
pub(crate) const ON_THE_WAY_STEP_NS: i64 = 200_000;

/// No frame is planned for a slot that is further ahead than the lead and this time, nanoseconds.
const FAR_NS: i64 = 1_000_000_000;

/// The next frame: its slot, and when to read its poses.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Latch {
    /// Number of the frame.
    pub id: u64,
    /// The projector's slot for this frame.
    pub slot: u64,
    /// When its poses are due to be read, by the lead alone.
    pub at: HostTime,
    /// The same, but not before the slot was chosen. Reading the poses later than this is lateness of this thread.
    pub due_at: HostTime,
    /// The sample that it waits for a little, if it is late.
    pub awaited: Option<SampleWait>,
    /// The lead: how long before the slot `at` is, nanoseconds.
    lead_ns: i64,
}

/// Plans frames one after the other.
pub(crate) struct PlanStage<P> {
    facts: Arc<Facts>,
    crew: Arc<CrewFacts>,
    horizon: Horizon,
    heads: HeadWatch,
    /// What the operator may change while the run goes on.
    parameters: Reader<ParameterVersion>,
    /// The newest gaze of a device.
    gaze: Reader<Option<GazeSample>>,
    /// The newest version of them that was used; `None` before the first frame.
    used: Option<u64>,
    slot_ns: i64,
    next_slot: u64,
    last_slot: Option<u64>,
    pace: PhantomData<P>,
}

impl<P: Pace> PlanStage<P> {
    /// For a crew that begins at `now`.
    pub(crate) fn new(facts: Arc<Facts>, crew: Arc<CrewFacts>, time: &LinkTime, now: HostTime) -> Self {
        // The stage costs in the rig file, because nothing has been learned about this crew yet.
        let first_ns = modelled_ns(&facts) + P::LISTEN_NS;
        let next_slot = time.slot_after(now.plus_ns(first_ns));
        if facts.options.slots > 0 {
            let end = next_slot.saturating_add(facts.options.slots);
            // The first crew decides; a crew that takes over keeps this end.
            let _ = facts.end_slot.compare_exchange(0, end, Ordering::Relaxed, Ordering::Relaxed);
        }
        let horizon = Horizon::of_rig(&facts.rig.config);
        let slot_ns = facts.rig.rate().slot_len_ns(0);
        let parameters = facts.monitor.parameters().follow(&facts.rig);
        let gaze = facts.monitor.gaze().follow();
        let (used, last_slot) = (None, None);
        let heads = HeadWatch::new(&facts.rig);
        Self {
            facts,
            crew,
            horizon,
            heads,
            parameters,
            gaze,
            used,
            slot_ns,
            next_slot,
            last_slot,
            pace: PhantomData,
        }
    }

    /// True when everything that the run was asked for is planned.
    pub(crate) fn is_complete(&self) -> bool {
        let frames = self.facts.options.frames;
        let end = self.facts.end_slot.load(Ordering::Relaxed);
        (frames > 0 && self.next_frame() >= frames) || (end > 0 && self.next_slot >= end)
    }

    /// Number of the next frame.
    pub(crate) fn next_frame(&self) -> u64 {
        self.facts.next_frame.load(Ordering::Relaxed)
    }

    /// A GPU that needs about a slot or more for a frame gets frames one at a time. False while it is busy.
    pub(crate) fn may_begin(&self) -> bool {
        !self.crew.gpu.is_slow() || self.crew.gpu.in_flight() == 0
    }

    /// True while no frame may be begun before all earlier ones are sent and whole: a queue stands between the stages or on
    /// the medium, and leaving frames out ends it at once.
    pub(crate) fn sheds(&self) -> bool {
        self.facts.queue_stands.load(Ordering::Relaxed)
    }

    /// True while a frame that was sent is on the medium.
    pub(crate) fn is_on_the_way(&self) -> bool {
        self.facts.is_on_the_way.load(Ordering::Relaxed)
    }

    /// Chooses the slot of the next frame at `now`. `None` if that slot lies beyond the end of the run.
    pub(crate) fn choose_slot(&mut self, time: &LinkTime, now: HostTime) -> Option<Latch> {
        let leads = P::leads(&self.facts, self.crew.gpu.is_slow());
        let first = time.slot_after(now.plus_ns(leads.needed_ns));
        // A slot far ahead was chosen by a map of the projector's clock that has since been corrected.
        let ahead = self.next_slot.saturating_sub(first) as i64;
        let is_ahead = ahead.saturating_mul(self.slot_ns) > leads.lead_ns.saturating_add(FAR_NS);
        self.next_slot = if is_ahead { first } else { self.next_slot.max(first) };
        if self.is_complete() {
            return None;
        }
        let mut at = time.host_of_slot(self.next_slot).plus_ns(-leads.lead_ns);
        let mut awaited = None;
        if let Some(rhythm) = self.facts.rhythm().filter(|_| self.facts.in_step.load(Ordering::Relaxed)) {
            // Most frames would still meet the slot.
            let late_ns = (leads.lead_ns - leads.needed_ns) * 3 / 4;
            (at, awaited) = genlock::latch_at(&rhythm, at, late_ns.max(0));
        }
        Some(Latch {
            id: self.next_frame(),
            slot: self.next_slot,
            at,
            due_at: at.max(now),
            awaited,
            lead_ns: leads.lead_ns,
        })
    }

    /// Plans the frame of `latch` from the newest tracks, which were read at `now`.
    pub(crate) fn plan(
        &mut self,
        latch: &Latch,
        note: &mut FrameNote,
        time: &LinkTime,
        snapshot: &TrackSnapshot,
        now: HostTime,
    ) {
        let light_slots = self.facts.light_slots.load(Ordering::Relaxed);
        let predict_ns = self.horizon.predict_ns(latch.lead_ns, snapshot.latency_ns, light_slots);
        self.facts.predict_ns.store(predict_ns, Ordering::Relaxed);
        // The light of a frame lasts until the next one is due.
        let stride = self.stride(latch.slot).max(light_slots);
        let applied = self.parameters.latest().0;
        if self.used != Some(applied.version) {
            self.used = Some(applied.version);
            self.facts.monitor.parameters().uses(applied.version, latch.id);
        }
        let inputs = PlanInputs {
            slots: time,
            id: latch.id,
            slot: latch.slot,
            stride,
            predict_ns,
            fresh_ns: self.horizon.fresh_ns(snapshot.latency_ns),
            budget_milli: self.crew.budget_milli.load(Ordering::Relaxed).min(applied.most_milli),
            rung: self.crew.rung.load(Ordering::Relaxed),
            applied,
            gaze: *self.gaze.latest().0,
            now,
        };
        note.plan.fill(&self.facts.rig, snapshot, &inputs);
        if let Some(is_measured) = note.plan.is_gaze_measured {
            self.facts.monitor.gaze().count_frame(is_measured);
        }
        note.plan.spare(&mut self.heads, &self.facts.rig, snapshot, &inputs);
        note.fate = Fate::UnderWay;
        note.latch_due_at = latch.due_at;
        note.timeline = FrameTimeline {
            captured_at: note.plan.captured_at,
            received_at: note.plan.received_at,
            due_at: note.plan.due_at,
            latched_at: now,
            ..FrameTimeline::default()
        };
    }

    /// The planned frame was passed to the next stage.
    pub(crate) fn submitted(&mut self, note: &mut FrameNote, now: HostTime) {
        let slot = note.plan.slot;
        note.timeline.submitted_at = now;
        self.facts.monitor.count_planned();
        self.facts.next_frame.store(note.plan.id.0 + 1, Ordering::Relaxed);
        let before = self.facts.stride_milli.load(Ordering::Relaxed);
        let mean = before.saturating_mul(15).saturating_add(self.stride(slot) * 1000) / 16;
        self.facts.stride_milli.store(mean, Ordering::Relaxed);
        self.last_slot = Some(slot);
        self.next_slot = slot + self.slots_a_frame();
    }

    fn slots_a_frame(&self) -> u64 {
        self.facts.slots_a_frame.load(Ordering::Relaxed)
    }

    /// Slots from the previous frame to one for `slot`.
    fn stride(&self, slot: u64) -> u64 {
        slot.saturating_sub(self.last_slot.unwrap_or(slot.saturating_sub(1))).clamp(1, 1000)
    }
}
