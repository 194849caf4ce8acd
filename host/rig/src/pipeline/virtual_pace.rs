//! A run at virtual pace. One thread drives every part of the engine under a clock that it moves. Each stage takes
//! the modelled cost in the rig file, so a run is a function of its inputs, however fast or busy the machine is.

use super::parts::{bring_up, mock_projector, CrewParts, PictureOrigin, FIRST_FRAME_TIMEOUT_NS};
use super::run::Ran;
use super::settings::lead_estimator;
use super::supervisor::leave_behind;
use super::threads::{enter_frame_path, may_stall, read_tracker, rendered, WARM_UP_FRAMES};
use crate::engine::error::PipelineError;
use crate::engine::facts::{CrewFacts, Facts};
use crate::engine::keeper::LinkKeeper;
use crate::engine::link::{LinkStage, Offer};
use crate::engine::options::{RunOptions, StallIn};
use crate::engine::pace::Virtual;
use crate::engine::pack::PackStage;
use crate::engine::plan::{PlanStage, LISTEN_NS};
use crate::frame::job::{Fate, FrameJob, FrameNote};
use crate::frame::Stage;
use crate::light::collector::{Collector, Inbox};
use crate::light::notes::{note_channel, NoteSender};
use crate::light::recorder::{light_channel, LightRecorder};
use crate::mock::EmulatedProjector;
use crate::plan::link_time::LinkTime;
use crate::rig::{Rig, RigError};
use crate::telemetry::monitor::RunMonitor;
use crate::tracks::{open_for, TrackSnapshot, TrackingStage};
use dpm_common::clock::Stopwatch;
use dpm_common::realtime::standstill::Standstills;
use dpm_device::time::HostTime;
use dpm_device::transport::inproc::Direct;
use dpm_device::transport::Transport;
use dpm_handoff::latest::{latest, Publisher, Reader};
use std::collections::VecDeque;
use std::panic::{catch_unwind, AssertUnwindSafe};
use std::sync::atomic::Ordering;
use std::sync::Arc;

/// A frame that the GPU has not finished after this time is given up, and the run with it, nanoseconds.
const GPU_TIMEOUT_NS: u64 = 20_000_000_000;
/// Time between two polls of a link that is coming up, nanoseconds.
const CONNECT_STEP_NS: i64 = 50_000;

pub(super) fn run_at_virtual_pace(
    rig: &Arc<Rig>,
    origin: &PictureOrigin,
    options: RunOptions,
    monitor: &Arc<RunMonitor>,
) -> Result<Ran, PipelineError> {
    // Only trackers without a clock of their own are permitted here.
    let mut parts = CrewParts::new(rig, origin, options, Arc::new(|| HostTime(0)))?;
    monitor.end_set_up();
    // The link comes up just before the first frame. The filters need the time before that.
    let mut now = HostTime(LISTEN_NS);
    let (lights_in, lights) = light_channel();
    let told = "real_time.pace = \"virtual\" works only with the mock projector";
    let mock = rig.config.projector.backend.as_mock().ok_or_else(|| RigError::Unsupported(told.into()))?;
    let (mock, recorder) = mock_projector(rig, mock, lights_in, options, origin.is_marked(), now)?;
    let mut cable = Direct::new(mock);
    let watch = Stopwatch::start();
    let (link, time) = bring_up(rig, &mut cable, monitor, &mut || {
        now = now.plus_ns(CONNECT_STEP_NS);
        now
    })?;
    let lead = lead_estimator(rig, &link, 0);
    let facts = Arc::new(Facts::new(rig.clone(), monitor.clone(), options, &lead, now));
    let crew = Arc::new(CrewFacts::new(0, rig.rate().slot_len_ns(0)));
    let keeper = LinkKeeper::new(time, &link, rig.bodies.len(), None);
    let (notes_in, notes) = note_channel(rig, monitor);
    let job = |memory| FrameJob { note: Box::new(FrameNote::new(rig)), memory: Box::new(memory) };
    let free: Vec<_> = std::mem::take(&mut parts.memory).into_iter().map(job).collect();
    let kept = options.keep_frames.max(options.keep_records);
    let collector = Collector::new(rig.clone(), kept, options.verify).about(origin.gpu().is_none(), None);
    let mut late = LateTracks::of(rig, origin)?;
    let mut stage = LinkStage::new(facts.clone(), link, keeper, lead);
    if let Some(tracks) = late.as_mut().and_then(|late| late.reader.take()) {
        stage.follow_by(tracks);
    }
    let mut world = World {
        plan: PlanStage::new(facts.clone(), crew.clone(), &time, now),
        pack: PackStage::new(facts.clone(), crew, None),
        link: stage,
        late,
        time,
        now,
        sent_at: now,
        costs: facts.modelled_costs(),
        track_ns: i64::from(rig.config.real_time.stage_costs_us.track) * 1000,
        latest: latest(TrackSnapshot::empty(rig.tracked_count())),
        cable,
        recorder: recorder.seen_by(monitor),
        under_way: VecDeque::with_capacity(free.len()),
        free,
        notes: Some(notes_in),
        collector,
        inbox: Inbox { notes, lights },
        at_work: "plan",
        parts,
        facts,
    };
    world.run();
    world.into_ran(rig, monitor, watch.elapsed_ns())
}

/// The tracker once more, for the tracks that are sent between frames. Frames are planned ahead of the clock of the link
/// here, so both cannot read one tracker in the order of time; the mock says the same to both.
struct LateTracks {
    tracking: TrackingStage,
    frames: Publisher<TrackSnapshot>,
    publisher: Publisher<TrackSnapshot>,
    /// `None` once the link has it.
    reader: Option<Reader<TrackSnapshot>>,
}

impl LateTracks {
    /// `None` if no tracks are sent.
    fn of(rig: &Rig, origin: &PictureOrigin) -> Result<Option<Self>, PipelineError> {
        if !rig.wants_tracks() || matches!(origin, PictureOrigin::Pattern(..)) {
            return Ok(None);
        }
        let tracker = open_for(rig, Arc::new(|| HostTime(0)), HostTime(0))?;
        let empty = || latest(TrackSnapshot::empty(rig.tracked_count()));
        let ((frames, _), (publisher, reader)) = (empty(), empty());
        let tracking = TrackingStage::new(rig, tracker);
        Ok(Some(Self { tracking, frames, publisher, reader: Some(reader) }))
    }

    /// Reads what has arrived by `now`. The failure of a tracker shows in the frames.
    fn read(&mut self, now: HostTime) {
        let _ = self.tracking.step(now, &mut self.frames);
        self.tracking.publish(now, &mut self.publisher);
    }
}

/// All parts of a run, and its clock.
struct World {
    facts: Arc<Facts>,
    plan: PlanStage<Virtual>,
    pack: PackStage,
    link: LinkStage<Virtual>,
    /// `None` if the projector is told of no tracks.
    late: Option<LateTracks>,
    /// The projector's clock as the handshake found it.
    time: LinkTime,
    /// When the last frame was latched.
    now: HostTime,
    /// When the last frame was sent.
    sent_at: HostTime,
    /// Modelled costs of plan, render, pack and link, nanoseconds.
    costs: [i64; 4],
    /// Modelled cost of tracking, nanoseconds: a sample that arrives later than this before the latch is not used
    /// yet.
    track_ns: i64,
    latest: (Publisher<TrackSnapshot>, Reader<TrackSnapshot>),
    parts: CrewParts,
    cable: Direct<EmulatedProjector>,
    recorder: LightRecorder,
    free: Vec<FrameJob>,
    /// Frames in progress on the GPU, oldest first.
    under_way: VecDeque<FrameJob>,
    /// `None` when no frame will be finished any more.
    notes: Option<NoteSender>,
    collector: Collector,
    inbox: Inbox,
    /// The stage that is working, for the message about a panic.
    at_work: &'static str,
}

impl World {
    /// Runs until all frames are lit or a stop is requested, then goes dark. A failure or a panic also ends in the
    /// dark.
    fn run(&mut self) {
        let served = catch_unwind(AssertUnwindSafe(|| self.serve()));
        enter_frame_path(false);
        match served {
            Ok(Ok(())) => {}
            Ok(Err(error)) => self.facts.fail(error),
            Err(_) => self.facts.fail(PipelineError::Panicked(self.at_work)),
        }
        self.go_dark();
        self.clear();
        self.notes = None;
        self.parts.tracking.add_counts(self.now, self.facts.monitor.samples(), true);
        self.recorder.close();
        while !self.collect() {}
    }

    /// What remains of the run, which took `wall_ns` of real time.
    fn into_ran(mut self, rig: &Rig, monitor: &RunMonitor, wall_ns: u64) -> Result<Ran, PipelineError> {
        let slots = self.collector.finish(monitor);
        if let Some(error) = self.facts.take_error() {
            return Err(error);
        }
        Ok(Ran {
            carried: self.link.report(self.cable.name()),
            collector: self.collector,
            slots,
            recorder: Some(self.recorder),
            wall_s: wall_ns as f64 * 1e-9,
            standstills: Standstills::default(),
            warnings: self.parts.tracking.never_seen(rig).into_iter().collect(),
            ray_walk: self.parts.ray_walk(),
            facts: self.facts,
        })
    }

    fn serve(&mut self) -> Result<(), PipelineError> {
        while !self.facts.monitor.stop_requested() {
            let begun = match self.free.pop() {
                Some(job) => self.begin(job)?,
                None => false,
            };
            if begun {
                continue;
            }
            let Some(mut job) = self.under_way.pop_front() else {
                self.facts.is_complete.store(true, Ordering::Release);
                break;
            };
            if let Err(error) = self.finish(&mut job) {
                self.abandon(job);
                return Err(error);
            }
            self.release(job);
        }
        Ok(())
    }

    /// Latches the next frame and starts the GPU on it. False when all frames of the run are planned.
    fn begin(&mut self, mut job: FrameJob) -> Result<bool, PipelineError> {
        self.at_work = "plan";
        let id = self.plan.next_frame();
        may_stall(&self.facts, StallIn::Plan, id);
        let latch = if self.plan.is_complete() { None } else { self.plan.choose_slot(&self.time, self.now) };
        let Some(latch) = latch else {
            self.free.push(job);
            return Ok(false);
        };
        enter_frame_path(id >= WARM_UP_FRAMES);
        self.now = latch.at;
        self.at_work = "tracking";
        may_stall(&self.facts, StallIn::Tracking, id);
        read_tracker(
            &self.facts,
            &mut self.parts.tracking,
            &mut self.latest.0,
            latch.at.plus_ns(-self.track_ns),
        );
        self.at_work = "plan";
        let watch = Stopwatch::start();
        let snapshot = self.latest.1.latest().0;
        self.plan.plan(&latch, &mut job.note, &self.time, snapshot, latch.at);
        job.note.timeline.wall_ns[Stage::Plan as usize] = watch.elapsed_ns();
        if let (Some(renderer), Some(slot)) = (&mut self.parts.renderer, job.memory.gpu.as_mut()) {
            if let Err(source) = crate::render::submit(&job.note.plan, slot, renderer) {
                self.abandon(job);
                return Err(PipelineError::Gpu { frame: id, source });
            }
        }
        self.plan.submitted(&mut job.note, latch.at.plus_ns(self.costs[0]));
        self.under_way.push_back(job);
        Ok(true)
    }

    /// Waits for the GPU, packs the frame and sends it to the projector.
    fn finish(&mut self, job: &mut FrameJob) -> Result<(), PipelineError> {
        let frame = job.note.plan.id.0;
        enter_frame_path(frame >= WARM_UP_FRAMES);
        self.at_work = "pack";
        may_stall(&self.facts, StallIn::Pack, frame);
        rendered(job, if frame == 0 { FIRST_FRAME_TIMEOUT_NS } else { GPU_TIMEOUT_NS })?;
        let rendered_at = job.note.timeline.submitted_at.plus_ns(self.costs[1]);
        (job.note.timeline.rendered_at, job.note.timeline.packing_at) = (rendered_at, rendered_at);
        if self.pack.is_wanted(&mut job.note, rendered_at, true) {
            self.parts.packer.pack(job, self.facts.options.verify);
        }
        job.note.timeline.packed_at = rendered_at.plus_ns(self.costs[2]);
        self.send(job);
        Ok(())
    }

    fn send(&mut self, job: &mut FrameJob) {
        self.at_work = "link";
        let FrameJob { note, memory } = job;
        let frame = note.plan.id.0;
        enter_frame_path(frame >= WARM_UP_FRAMES && self.link.is_streaming());
        may_stall(&self.facts, StallIn::Link, frame);
        let mut now = note.timeline.packed_at.plus_ns(self.costs[3]);
        self.follow(now);
        self.live(now);
        let watch = Stopwatch::start();
        let planes = memory.outgoing();
        while let Offer::Again(at) = self.link.offer(now, note, planes, true, &mut self.cable) {
            now = at;
            self.live(now);
        }
        note.timeline.wall_ns[Stage::Link as usize] = watch.elapsed_ns();
        self.link.taken(note, now);
        self.sent_at = now;
    }

    /// Sends all tracks that are due before `until`, each by the samples that have arrived by then.
    fn follow(&mut self, until: HostTime) {
        while let Some(at) = self.link.tracks_due_at().filter(|at| *at < until) {
            if let Some(late) = &mut self.late {
                late.read(at.plus_ns(-self.track_ns));
            }
            self.live(at);
            self.link.poll(at, &mut self.cable);
        }
    }

    /// The link has finished with a frame: passes what its note says to the collector, and keeps it for another one.
    fn release(&mut self, mut job: FrameJob) {
        enter_frame_path(false);
        if let Some(notes) = &mut self.notes {
            job.note = notes.exchange(job.note);
        }
        self.free.push(job);
        self.collect();
    }

    /// Advances the projector to `now`. No thread can be late here, so all count as alive.
    fn live(&mut self, now: HostTime) {
        self.facts.alive_at_ns.store(now.0, Ordering::Relaxed);
        self.recorder.advance(self.cable.device_mut(), now);
    }

    /// Waits for the last frames' light if the run is complete, then goes dark.
    fn go_dark(&mut self) {
        let (last, mut now) = (self.sent_at, self.sent_at);
        while let Some(at) = self.link.end(now, last, &mut self.cable) {
            now = at;
            self.follow(now);
            self.live(now);
        }
    }

    /// Counts frames that are still in flight as not sent. Their memory is not freed before the GPU has finished with
    /// it.
    fn clear(&mut self) {
        while let Some(mut job) = self.under_way.pop_front() {
            job.note.fate = Fate::Stopped;
            if rendered(&mut job, GPU_TIMEOUT_NS).is_err() {
                return self.abandon(job);
            }
            self.release(job);
        }
    }

    /// The GPU does not finish `job`, or is lost. It may read the memory of frames and renderer for an unknown time,
    /// so that memory is never freed.
    fn abandon(&mut self, job: FrameJob) {
        leave_behind();
        std::mem::forget((job, std::mem::take(&mut self.under_way), self.parts.renderer.take()));
    }

    /// True when everything is collected.
    fn collect(&mut self) -> bool {
        self.collector.look(&mut self.inbox, &self.facts.monitor, &mut || ())
    }
}
