//! Tracking, plan and pack, and the GPU between them.

use super::line::SteppedLink;
use super::{GpuWork, Machine, RunPart, Takes, NEVER};
use crate::engine::error::PipelineError;
use crate::engine::facts::{CrewFacts, Facts};
use crate::engine::pace::Real;
use crate::engine::pack::PackStage;
use crate::engine::plan::{Latch, PlanStage, ON_THE_WAY_STEP_NS};
use crate::engine::pulse::{Pulse, Silence};
use crate::engine::supervision::Trouble;
use crate::frame::job::{FrameJob, FrameMemory, FrameNote};
use crate::frame::slots::MissCause;
use crate::pack::eye_mask::EyeMask;
use crate::pack::prepared::PreparedFrames;
use crate::pack::Packer;
use crate::pipeline::parts::CrewParts;
use crate::pipeline::threads::{POLL_WITHIN_NS, STEP_NS, WAIT_NS};
use crate::plan::link_time::LinkTime;
use crate::render::WarmUp;
use crate::rig::Rig;
use crate::tracks::{TrackSnapshot, TrackingStage};
use dpm_device::time::HostTime;
use dpm_device::tracker::Tracker;
use dpm_handoff::latest::{latest, Publisher, Reader};
use dpm_render::gpu::GpuError;
use dpm_render::pack::{BitPlaneFrame, Kernel};
use std::collections::VecDeque;
use std::sync::atomic::Ordering;
use std::sync::Arc;

/// Time between two polls of a tracker, nanoseconds.
const POLL_REST_NS: i64 = 200_000;
/// A tracker that has nothing to read is still polled this often, nanoseconds: it reconnects and maps clocks.
const POLL_AT_LEAST_NS: i64 = 5_000_000;

impl CrewParts {
    /// For a run without a GPU of this process: the frames are prepared, and the simulated GPU took `frame_ns`.
    pub(super) fn stepped(rig: &Rig, tracker: Box<dyn Tracker>, in_flight: usize, frame_ns: i64) -> Self {
        let memory = || FrameMemory {
            gpu: None,
            planes: BitPlaneFrame::new(rig.camera.raster, rig.schedule),
            sends_from_gpu: false,
            picture: None,
        };
        Self {
            tracking: TrackingStage::new(rig, tracker),
            renderer: None,
            packer: Packer { kernel: Kernel::best(), pictures: None, eyes: EyeMask::of_rig(rig) },
            budget: None,
            scale: None,
            memory: (0..in_flight.max(2)).map(|_| memory()).collect(),
            first: WarmUp { wall_ns: frame_ns, gpu_ns: None },
            budget_milli: u64::MAX,
        }
    }
}

/// What planning is doing.
enum Planning {
    /// It looks for memory, and for a slot.
    Free { at: HostTime },
    /// It waits for the instant at which poses are read.
    Latched { at: HostTime, latch: Latch },
    /// It plans and submits.
    Submits { at: HostTime, job: FrameJob },
    /// It never returns, or has ended.
    Gone,
}

/// What packing is doing.
enum Packing {
    /// It waits for the oldest frame that the GPU has, at most until `until`; `None`: there is none.
    Waits {
        until: Option<HostTime>,
        limit_ns: u64,
    },
    /// It packs.
    Packs {
        at: HostTime,
        job: FrameJob,
    },
    Gone,
}

/// A frame that the GPU has.
struct OnGpu {
    job: FrameJob,
    done_at: HostTime,
    lost: Option<GpuError>,
}

/// The stages that are restarted together.
pub(super) struct SteppedCrew {
    facts: Arc<CrewFacts>,
    tracking: TrackingStage,
    tracking_at: HostTime,
    publisher: Publisher<TrackSnapshot>,
    reader: Reader<TrackSnapshot>,
    /// The newest tracks for the link; `None` if the projector is told of none.
    to_link: Option<Publisher<TrackSnapshot>>,
    times: Reader<LinkTime>,
    plan: PlanStage<Real>,
    planning: Planning,
    held_up_by: Option<MissCause>,
    free: Vec<FrameJob>,
    gpu: VecDeque<OnGpu>,
    gpu_free_at: HostTime,
    pack: PackStage,
    packing: Packing,
    prepared: PreparedFrames,
    /// Code values of a frame in which all bodies are dark.
    black: Vec<u32>,
    eyes: Option<EyeMask>,
    kernel: Kernel,
    pulses: [Pulse; 3],
    silences: [Silence; 3],
    failure: Option<PipelineError>,
    panicked: Option<&'static str>,
    in_flight: usize,
}

impl SteppedCrew {
    /// Starts a crew whose frames go to `line`.
    pub(super) fn new(
        facts: &Arc<Facts>,
        parts: CrewParts,
        time: LinkTime,
        line: &mut SteppedLink,
        now: HostTime,
    ) -> Self {
        let crew = Arc::new(CrewFacts::new(parts.first.wall_ns, facts.rig.rate().slot_len_ns(0)));
        let (publisher, reader) = latest(TrackSnapshot::empty(facts.rig.tracked_count()));
        let to_link = facts.rig.wants_tracks().then(|| {
            let (to_link, newest) = latest(TrackSnapshot::empty(facts.rig.tracked_count()));
            line.stage.follow_by(newest);
            to_link
        });
        let (times_in, mut times) = latest(time);
        line.stage.tell_times_to(times_in);
        let time = *times.latest().0;
        let in_flight = parts.memory.len();
        Self {
            plan: PlanStage::new(facts.clone(), crew.clone(), &time, now),
            pack: PackStage::new(facts.clone(), crew.clone(), parts.budget),
            facts: crew,
            tracking: parts.tracking,
            tracking_at: now,
            publisher,
            reader,
            to_link,
            times,
            planning: Planning::Free { at: now },
            held_up_by: None,
            free: parts
                .memory
                .into_iter()
                .map(|memory| FrameJob {
                    note: Box::new(FrameNote::new(&facts.rig)),
                    memory: Box::new(memory),
                })
                .collect(),
            gpu: VecDeque::new(),
            gpu_free_at: now,
            packing: Packing::Waits { until: None, limit_ns: 0 },
            prepared: PreparedFrames::new(facts.rig.camera.raster),
            black: vec![0; facts.rig.camera.raster.pixel_count()],
            eyes: parts.packer.eyes,
            kernel: parts.packer.kernel,
            pulses: [Pulse::new("tracking"), Pulse::new("plan"), Pulse::new("pack")],
            silences: Default::default(),
            failure: None,
            panicked: None,
            in_flight,
        }
    }

    /// What the tracker's client says of itself.
    pub(super) fn tracker_status(&self) -> String {
        let time = self.tracking.newest();
        let plan = match &self.planning {
            Planning::Free { at } => format!("free at {}", at.0),
            Planning::Latched { at, latch } => format!("latched {latch:?} at {}", at.0),
            Planning::Submits { at, .. } => format!("submits at {}", at.0),
            Planning::Gone => "gone".into(),
        };
        let (free, gpu) = (self.free.len(), self.gpu.len());
        format!("{}; newest {time:?}; plan {plan}, {free} free, {gpu} on the GPU", self.tracking.status())
    }

    /// Frames in progress.
    pub(super) fn in_flight(&self) -> usize {
        self.in_flight - self.free.len()
    }

    pub(super) fn due(&self) -> HostTime {
        let plan = match &self.planning {
            Planning::Free { at } | Planning::Latched { at, .. } | Planning::Submits { at, .. } => *at,
            Planning::Gone => NEVER,
        };
        let pack = match &self.packing {
            Packing::Packs { at, .. } => *at,
            Packing::Waits { until: Some(until), .. } => {
                self.gpu.front().map_or(NEVER, |on| on.done_at).min(*until)
            }
            Packing::Waits { until: None, .. } => NEVER,
            Packing::Gone => NEVER,
        };
        self.tracking_at.min(plan).min(pack)
    }

    /// A frame that the link has finished with.
    pub(super) fn returned(&mut self, job: FrameJob, now: HostTime) {
        self.free.push(job);
        self.wake_plan(now);
    }

    fn wake_plan(&mut self, now: HostTime) {
        if let Planning::Free { at } = &mut self.planning {
            *at = now.min(*at);
        }
    }

    /// True when no frame will come from this crew any more.
    pub(super) fn is_finished(&self) -> bool {
        matches!(self.planning, Planning::Gone)
            && self.gpu.is_empty()
            && !matches!(self.packing, Packing::Packs { .. })
    }

    /// Frames that are still in progress, when nobody wants them any more.
    pub(super) fn take_under_way(&mut self) -> Vec<FrameJob> {
        let mut all: Vec<_> = self.gpu.drain(..).map(|on| on.job).collect();
        if let Packing::Packs { job, .. } = std::mem::replace(&mut self.packing, Packing::Gone) {
            all.push(job);
        }
        if let Planning::Submits { job, .. } = std::mem::replace(&mut self.planning, Planning::Gone) {
            all.push(job);
        }
        self.tracking_at = NEVER;
        self.pulses.iter().for_each(Pulse::end);
        all
    }

    /// The run ends; the crew's threads end by themselves.
    pub(super) fn ends(&mut self) {
        (self.failure, self.panicked) = (None, None);
        self.planning = Planning::Gone;
        self.pulses.iter().for_each(Pulse::end);
    }

    /// Checks the crew, `step_ns` after the last check.
    pub(super) fn trouble(&mut self, now: HostTime, step_ns: i64) -> Option<Trouble> {
        if let Some(error) = self.failure.take() {
            return Some(Trouble::Failed(error));
        }
        if let Some(stage) = self.panicked.take() {
            return Some(Trouble::Panicked(stage));
        }
        for (pulse, silence) in self.pulses.iter().zip(&mut self.silences) {
            if silence.observe(pulse, now, step_ns, |_| None, 0) {
                return Some(Trouble::Hung(pulse.name()));
            }
        }
        None
    }

    pub(super) fn advance<M: Machine>(
        &mut self,
        now: HostTime,
        facts: &Arc<Facts>,
        machine: &mut M,
        line: &mut SteppedLink,
    ) {
        if self.tracking_at <= now {
            self.track(now, facts, machine);
        }
        self.plan(now, facts, machine);
        self.pack(now, facts, machine, line);
    }

    fn track<M: Machine>(&mut self, now: HostTime, facts: &Arc<Facts>, machine: &mut M) {
        self.pulses[0].beat(now, POLL_WITHIN_NS);
        match machine.takes(RunPart::Tracking, facts.next_frame.load(Ordering::Relaxed), now) {
            Takes::Ns(ns) => {
                let read_at = now.plus_ns(ns);
                crate::pipeline::threads::read_tracker(facts, &mut self.tracking, &mut self.publisher, now);
                facts.tell_rhythm(self.tracking.is_published(read_at));
                if let Some(to_link) = &mut self.to_link {
                    self.tracking.publish(now, to_link);
                }
                let next = machine.next_sample_at(now).min(now.plus_ns(POLL_AT_LEAST_NS));
                self.tracking_at = next.max(read_at.plus_ns(POLL_REST_NS));
            }
            Takes::Forever => self.tracking_at = NEVER,
            Takes::Panics => {
                self.tracking_at = NEVER;
                self.panicked = Some("tracking");
            }
        }
    }

    fn plan<M: Machine>(&mut self, now: HostTime, facts: &Arc<Facts>, machine: &mut M) {
        match std::mem::replace(&mut self.planning, Planning::Gone) {
            Planning::Free { at } if at <= now => self.planning = self.choose(now, facts),
            Planning::Latched { at, latch } if at <= now => {
                self.planning = self.latch(now, machine, &latch);
            }
            Planning::Submits { at, mut job } if at <= now => {
                self.facts.gpu.submit();
                self.plan.submitted(&mut job.note, now);
                let begin = self.gpu_free_at.max(now);
                let (done_at, lost) = match machine.renders(job.note.plan.id.0, begin) {
                    GpuWork::After(ns) => (begin.plus_ns(ns), None),
                    GpuWork::Never => (NEVER, None),
                    GpuWork::Lost(ns, error) => (begin.plus_ns(ns), Some(error)),
                };
                self.gpu_free_at = done_at;
                self.gpu.push_back(OnGpu { job, done_at, lost });
                if let Packing::Waits { until: None, .. } = self.packing {
                    self.wait_for_gpu(now);
                }
                self.pulses[1].beat(now, WAIT_NS + STEP_NS);
                self.planning = Planning::Free { at: now };
            }
            other => self.planning = other,
        }
    }

    /// Looks for memory and chooses the next frame's slot.
    fn choose(&mut self, now: HostTime, facts: &Arc<Facts>) -> Planning {
        if facts.monitor.stop_requested() || self.plan.is_complete() {
            if self.plan.is_complete() {
                facts.is_complete.store(true, Ordering::Release);
            }
            self.pulses[1].end();
            return Planning::Gone;
        }
        self.pulses[1].beat(now, WAIT_NS + STEP_NS);
        let later = Planning::Free { at: now.plus_ns(WAIT_NS) };
        if !self.plan.may_begin() {
            return later;
        }
        if self.plan.sheds() && self.free.len() < self.in_flight {
            self.held_up_by = Some(MissCause::Queue);
            return later;
        }
        if self.plan.sheds() && self.plan.is_on_the_way() {
            self.held_up_by = Some(MissCause::Queue);
            return Planning::Free { at: now.plus_ns(ON_THE_WAY_STEP_NS) };
        }
        let time = *self.times.latest().0;
        let Some(latch) = self.plan.choose_slot(&time, now) else { return later };
        let at = latch.at.max(now);
        self.pulses[1].beat(at, WAIT_NS + STEP_NS);
        Planning::Latched { at, latch }
    }

    /// Reads the poses and plans the frame.
    fn latch<M: Machine>(&mut self, now: HostTime, machine: &mut M, latch: &Latch) -> Planning {
        let Some(mut job) = self.free.pop() else {
            // With the memory that comes back another slot may be the first that can be met.
            self.held_up_by = Some(MissCause::Buffers);
            self.pulses[1].beat(now, WAIT_NS + STEP_NS);
            return Planning::Free { at: now.plus_ns(WAIT_NS) };
        };
        job.note.held_up_by = self.held_up_by.take();
        self.pulses[1].beat(now, STEP_NS);
        match machine.takes(RunPart::Plan, latch.id, now) {
            Takes::Ns(ns) => {
                let time = *self.times.latest().0;
                let snapshot = self.reader.latest().0;
                self.plan.plan(latch, &mut job.note, &time, snapshot, now);
                job.note.cost = None;
                Planning::Submits { at: now.plus_ns(ns), job }
            }
            Takes::Forever => Planning::Gone,
            Takes::Panics => {
                self.panicked = Some("plan");
                Planning::Gone
            }
        }
    }

    /// Packing turns to the oldest frame that the GPU has.
    fn wait_for_gpu(&mut self, now: HostTime) {
        // While it waits it reports in time; so nothing is overdue.
        self.pulses[2].end();
        let Some(on) = self.gpu.front() else {
            self.packing = Packing::Waits { until: None, limit_ns: 0 };
            return;
        };
        let limit_ns = self.pack.wait_from(&on.job.note, now);
        self.packing = Packing::Waits { until: Some(now.plus_ns(limit_ns as i64)), limit_ns };
    }

    fn pack<M: Machine>(
        &mut self,
        now: HostTime,
        facts: &Arc<Facts>,
        machine: &mut M,
        line: &mut SteppedLink,
    ) {
        match std::mem::replace(&mut self.packing, Packing::Gone) {
            Packing::Packs { at, mut job } if at <= now => {
                job.note.timeline.packed_at = now;
                line.take_in(job, now);
                self.wait_for_gpu(now);
            }
            Packing::Waits { until: Some(until), limit_ns } => {
                let is_done = self.gpu.front().is_some_and(|on| on.done_at <= now);
                if is_done {
                    self.rendered(now, facts, machine);
                } else if until <= now {
                    self.pulses[2].end();
                    let frame = self.gpu.front().map_or(0, |on| on.job.note.plan.id.0);
                    self.failure = Some(PipelineError::GpuHangs { frame, ms: limit_ns / 1_000_000 });
                } else {
                    self.packing = Packing::Waits { until: Some(until), limit_ns };
                }
            }
            other => self.packing = other,
        }
    }

    /// The GPU has finished its oldest frame, or was lost with it.
    fn rendered<M: Machine>(&mut self, now: HostTime, facts: &Arc<Facts>, machine: &mut M) {
        let Some(OnGpu { mut job, lost, .. }) = self.gpu.pop_front() else { return };
        let frame = job.note.plan.id.0;
        if let Some(source) = lost {
            self.failure = Some(PipelineError::Gpu { frame, source });
            return;
        }
        self.pulses[2].beat(now, WAIT_NS + STEP_NS);
        self.pack.wait_is_over();
        job.note.cost = Some(Default::default());
        job.note.timeline.rendered_at = now;
        self.pack.rendered(&job.note, now);
        self.wake_plan(now);
        job.note.timeline.packing_at = now;
        if self.pack.is_wanted(&mut job.note, now, self.gpu.is_empty()) {
            let FrameJob { note, memory } = &mut job;
            if note.plan.is_lit || facts.rig.bodies.is_empty() {
                self.prepared.pack(self.kernel, note.plan.id.0, &mut memory.planes);
            } else {
                dpm_render::pack::pack(self.kernel, &self.black, &mut memory.planes);
            }
            crate::pack::spare(&mut job, &mut self.eyes);
        }
        match machine.takes(RunPart::Pack, frame, now) {
            Takes::Ns(ns) => self.packing = Packing::Packs { at: now.plus_ns(ns), job },
            Takes::Forever => {}
            Takes::Panics => self.panicked = Some("pack"),
        }
    }
}
