//! The threads of tracking, planning and packing at real pace. (`link.rs` has the link's thread.)

use super::crew::{CrewState, PACK, PLAN, TRACKING};
use super::rights::Rights;
use crate::config::Wait;
use crate::engine::error::PipelineError;
use crate::engine::facts::Facts;
use crate::engine::options::StallIn;
use crate::engine::pace::Real;
use crate::engine::pack::PackStage;
use crate::engine::plan::{Latch, PlanStage, ON_THE_WAY_STEP_NS};
use crate::engine::pulse::Pulse;
use crate::frame::job::FrameJob;
use crate::frame::slots::MissCause;
use crate::frame::Stage;
use crate::pack::Packer;
use crate::plan::link_time::LinkTime;
use crate::rig::Rig;
use crate::tracks::{SampleRhythm, TrackSnapshot, TrackingStage};
use dpm_common::clock::{Clock, MonotonicClock, Stopwatch};
use dpm_common::realtime::os::thread_id;
use dpm_common::realtime::wait_policy;
use dpm_device::time::HostTime;
use dpm_handoff::channel::{Receiver, Sender};
use dpm_handoff::latest::{Publisher, Reader};
use dpm_handoff::path::{self, Place};
use dpm_handoff::wake::{WaitPolicy, Waiter, Waker};
use dpm_render::Renderer;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

/// True while the calling thread works on frames in the steady state and is in no call of a library. A counting
/// allocator may then demand that nothing is allocated.
pub fn on_frame_path() -> bool {
    path::place() == Place::Own
}

pub(super) fn enter_frame_path(inside: bool) {
    path::enter(inside);
}

/// Frames until the steady state, in which nothing is allocated.
pub(super) const WARM_UP_FRAMES: u64 = 16;
/// Reads of the tracker until its buffers have grown to their final size.
pub(super) const WARM_UP_STEPS: u32 = 64;
/// Tracking, plan, pack, link, and the mock projector.
pub(super) const STAGE_THREADS: usize = 5;
/// How long a stage waits for another one before it checks whether the run continues, nanoseconds.
pub(super) const WAIT_NS: i64 = 20_000_000;
/// Time that a step of a stage may take besides its waits, nanoseconds.
pub(super) const STEP_NS: i64 = 20_000_000;
/// Time that a poll of a tracker may take, nanoseconds: some trackers must be reopened or reconnected.
pub(super) const POLL_WITHIN_NS: i64 = 200_000_000;
/// A frame whose memory came this long after its latch is planned anew, nanoseconds.
const REPLAN_NS: i64 = 100_000;
/// Time between two looks for a sample that is late, nanoseconds.
const AWAIT_STEP_NS: i64 = 30_000;
/// Longest wait for a tracker, which must also be polled to keep its connection and its clock.
const WAIT_FOR_TRACKER: Duration = Duration::from_millis(2);
/// Shortest time between two polls of a tracker that cannot be waited for ...
const POLL_REST: Duration = Duration::from_micros(200);
/// ... which begin this long before its next sample should be ready, nanoseconds.
const POLL_BEFORE_NS: i64 = 500_000;

/// What all threads of a run share, whichever crew works.
pub(super) struct RunState {
    /// Facts that the parts of the engine share.
    pub(super) facts: Arc<Facts>,
    pub(super) clock: MonotonicClock,
    /// The projector's clock as the handshake found it.
    pub(super) time: LinkTime,
    /// The link's thread has ended, and the projector is dark.
    pub(super) is_link_over: AtomicBool,
    /// A thread that cannot be replaced hangs, so the run ends without waiting for the others.
    pub(super) is_broken: AtomicBool,
    pub(super) link_pulse: Pulse,
    pub(super) collector_pulse: Pulse,
    pub(super) rights: Arc<Rights>,
}

impl RunState {
    /// The state of a run that begins.
    pub(super) fn new(
        facts: &Arc<Facts>,
        clock: MonotonicClock,
        time: LinkTime,
        rights: &Arc<Rights>,
    ) -> Self {
        Self {
            facts: facts.clone(),
            clock,
            time,
            is_link_over: AtomicBool::new(false),
            is_broken: AtomicBool::new(false),
            link_pulse: Pulse::new("link"),
            collector_pulse: Pulse::new("collector"),
            rights: rights.clone(),
        }
    }
}

/// Stalls if the run's options ask for it. A stall strikes once, also where a new crew works on the same frame again.
pub(super) fn may_stall(facts: &Facts, stage: StallIn, frame: u64) {
    let Some(stall) = facts.options.stall else { return };
    let struck = facts.stalls.load(Ordering::Relaxed);
    let next = struck + 1;
    if stall.strikes(stage, frame, struck)
        && facts.stalls.compare_exchange(struck, next, Ordering::Relaxed, Ordering::Relaxed).is_ok()
    {
        std::thread::sleep(stall.length);
    }
}

/// How the stages of a rig wait for each other.
pub(super) fn policy(rig: &Rig) -> WaitPolicy {
    let wish = match rig.config.real_time.wait {
        Wait::Spin => Some(WaitPolicy::SpinThenPark { spin_ns: 200_000 }),
        Wait::Park => Some(WaitPolicy::Park),
        Wait::Auto => None,
    };
    wait_policy(wish, STAGE_THREADS)
}

/// The next value; waits at most `limit_ns`.
pub(super) fn pop_within<T>(from: &mut Receiver<T>, limit_ns: i64) -> Option<T> {
    from.try_pop().or_else(|| {
        let watch = Stopwatch::start();
        from.pop(limit_ns, || watch.elapsed_ns() as i64)
    })
}

/// Reads the tracker until planning is over, for planning and, with `to_link`, for the link. Returns what is wrong with the tracker at the end.
pub(super) fn tracking_thread(
    shared: &RunState,
    crew: &CrewState,
    mut stage: TrackingStage,
    mut latest: Publisher<TrackSnapshot>,
    mut to_link: Option<Publisher<TrackSnapshot>>,
) -> Option<String> {
    let RunState { facts, clock, .. } = shared;
    shared.rights.enter(0);
    let pulse = &crew.pulses[TRACKING];
    pulse.begin(thread_id());
    let mut steps = 0u32;
    let mut planned = 0;
    while !crew.tracking_over.load(Ordering::Acquire) {
        // Every frame once, including those that were planned while this thread slept.
        let planning = crew.planning.load(Ordering::Relaxed);
        while planned < planning {
            planned += 1;
            may_stall(facts, StallIn::Tracking, planned);
        }
        let now = clock.now();
        pulse.beat(now, POLL_WITHIN_NS);
        steps = steps.saturating_add(1);
        enter_frame_path(steps >= WARM_UP_STEPS);
        read_tracker(facts, &mut stage, &mut latest, now);
        let rhythm = stage.is_published(clock.now());
        facts.tell_rhythm(rhythm);
        if let Some(to_link) = &mut to_link {
            stage.publish(now, to_link);
        }
        // A tracker that can be waited for is read as soon as something arrives, and costs nothing while nothing does.
        let due_at = stage.due_at();
        if let Some(due_at) = due_at {
            clock.wait_until(due_at.min(now.plus_ns(WAIT_FOR_TRACKER.as_nanos() as i64)));
        } else if !stage.wait(WAIT_FOR_TRACKER) {
            std::thread::sleep(rest_of(rhythm, now));
        }
    }
    enter_frame_path(false);
    stage.add_counts(clock.now(), facts.monitor.samples(), true);
    pulse.end();
    stage.never_seen(&facts.rig)
}

/// How long a tracker that cannot be waited for may rest at `now`: until shortly before the next sample, if it is known
/// when that comes.
fn rest_of(rhythm: Option<SampleRhythm>, now: HostTime) -> Duration {
    let Some(rhythm) = rhythm else { return POLL_REST };
    let since_ns = now.ns_since(rhythm.ready_at()).rem_euclid(rhythm.period_ns.max(1));
    let until_ns = rhythm.period_ns - since_ns - POLL_BEFORE_NS;
    Duration::from_nanos(until_ns.max(0) as u64).clamp(POLL_REST, WAIT_FOR_TRACKER)
}

/// Reads what the tracker has reported by `now`. The failure of a tracker shows in the age of its tracks: the light
/// goes off by itself, and the report says why.
pub(super) fn read_tracker(
    facts: &Facts,
    stage: &mut TrackingStage,
    latest: &mut Publisher<TrackSnapshot>,
    now: HostTime,
) {
    let _ = stage.step(now, latest);
    stage.add_counts(now, facts.monitor.samples(), false);
    if stage.is_silence_due(now) {
        // Leaves the frame path once: a body is dark for lack of samples, and the operator should not have to wait
        // for the report.
        enter_frame_path(false);
        if let Some(word) = stage.not_seen_yet(&facts.rig) {
            facts.monitor.tell_of_tracker(word);
        }
    }
}

/// The inputs of planning.
pub(super) struct PlanInbox {
    pub(super) latest: Reader<TrackSnapshot>,
    pub(super) time: Reader<LinkTime>,
    pub(super) free: Receiver<FrameJob>,
    /// Woken when the GPU has finished a frame.
    pub(super) gpu_free: Waiter,
}

/// Latches, plans and submits frames until all frames of the run are planned, or the crew is dismissed.
pub(super) fn plan_thread(
    shared: &RunState,
    crew: &CrewState,
    mut renderer: Option<Renderer>,
    inbox: PlanInbox,
    to_pack: Sender<FrameJob>,
) {
    let RunState { facts, clock, .. } = shared;
    shared.rights.enter(1);
    let pulse = &crew.pulses[PLAN];
    pulse.begin(thread_id());
    let mut desk = PlanDesk::new(shared, crew, inbox, to_pack);
    while !crew.is_dismissed(shared) && !desk.stage.is_complete() {
        pulse.beat(clock.now(), WAIT_NS + STEP_NS);
        if desk.frame(renderer.as_mut()).is_none() {
            break;
        }
    }
    enter_frame_path(false);
    if desk.stage.is_complete() {
        facts.is_complete.store(true, Ordering::Release);
    }
    pulse.end();
    // This also ends packing, which waits for the frames that the GPU still has. They keep what the GPU reads, so the renderer may
    // go before them.
    drop(desk);
    drop(renderer);
}

/// The planning thread's state.
struct PlanDesk<'a> {
    shared: &'a RunState,
    crew: &'a CrewState,
    stage: PlanStage<Real>,
    inbox: PlanInbox,
    to_pack: Sender<FrameJob>,
    /// The memory that came back last is taken first, because most of it is still in the caches.
    hottest: Vec<FrameJob>,
    /// All memory of the crew.
    circulating: usize,
    /// What has kept the next frame from being begun.
    held_up_by: Option<MissCause>,
}

impl<'a> PlanDesk<'a> {
    fn new(
        shared: &'a RunState,
        crew: &'a CrewState,
        mut inbox: PlanInbox,
        to_pack: Sender<FrameJob>,
    ) -> Self {
        let time = inbox.time.latest().0;
        let stage = PlanStage::new(shared.facts.clone(), crew.facts.clone(), time, shared.clock.now());
        // All of it is there before the first frame.
        let circulating = inbox.free.len();
        let hottest = Vec::with_capacity(circulating);
        Self { shared, crew, stage, inbox, to_pack, hottest, circulating, held_up_by: None }
    }

    /// Takes back what the link has returned.
    fn take_back(&mut self) {
        while let Some(job) = self.inbox.free.try_pop() {
            self.hottest.push(job);
        }
    }

    /// Waits at most [`WAIT_NS`] for `enough` frames to have come back. False if they have not; `cause` then holds up the
    /// next frame.
    fn are_back(&mut self, enough: usize, cause: MissCause) -> bool {
        self.take_back();
        if self.hottest.len() >= enough {
            return true;
        }
        self.held_up_by = Some(cause);
        self.hottest.extend(pop_within(&mut self.inbox.free, WAIT_NS));
        self.take_back();
        self.hottest.len() >= enough
    }

    /// Waits at most [`WAIT_NS`] for a GPU that gets its frames one at a time. False while it is busy.
    fn gpu_is_free(&mut self) -> bool {
        let (clock, stage) = (self.shared.clock, &self.stage);
        stage.may_begin() || {
            let deadline = clock.now().plus_ns(WAIT_NS).0;
            self.inbox.gpu_free.wait(deadline, || clock.now().0, || stage.may_begin())
        }
    }

    /// Plans and submits one frame, if there is memory for it. `None` if the crew cannot continue.
    fn frame(&mut self, renderer: Option<&mut Renderer>) -> Option<()> {
        if !self.gpu_is_free() {
            return Some(());
        }
        if self.stage.sheds() && !self.are_back(self.circulating, MissCause::Queue) {
            return Some(());
        }
        if self.stage.sheds() && self.stage.is_on_the_way() {
            self.held_up_by = Some(MissCause::Queue);
            let clock = self.shared.clock;
            clock.wait_until(clock.now().plus_ns(ON_THE_WAY_STEP_NS));
            return Some(());
        }
        let (shared, crew) = (self.shared, self.crew);
        let id = self.stage.next_frame();
        enter_frame_path(id >= WARM_UP_FRAMES);
        crew.planning.store(id, Ordering::Relaxed);
        may_stall(&shared.facts, StallIn::Plan, id);
        let time = *self.inbox.time.latest().0;
        let Some(mut latch) = self.stage.choose_slot(&time, shared.clock.now()) else { return Some(()) };
        let now = self.wait_for(&mut latch);
        // Memory is taken now and not before the wait, so that as little of it circulates as the stages need. After a
        // wait for memory another slot may be the first that can be met.
        if self.hottest.is_empty() && !self.are_back(1, MissCause::Buffers) {
            return Some(());
        }
        if shared.clock.now().ns_since(now) > REPLAN_NS {
            return Some(());
        }
        // A thread that hung until now must not keep the GPU from its successor.
        if crew.is_abandoned.load(Ordering::Relaxed) {
            return None;
        }
        let Some(mut job) = self.hottest.pop() else { return Some(()) };
        job.note.held_up_by = self.held_up_by.take();
        let watch = Stopwatch::start();
        let snapshot = self.inbox.latest.latest().0;
        self.stage.plan(&latch, &mut job.note, &time, snapshot, now);
        job.note.timeline.wall_ns[Stage::Plan as usize] = watch.elapsed_ns();
        if let (Some(renderer), Some(slot)) = (renderer, job.memory.gpu.as_mut()) {
            if let Err(source) = crate::render::submit(&job.note.plan, slot, renderer) {
                crew.fail(PipelineError::Gpu { frame: id, source });
                return None;
            }
            crew.facts.gpu.submit();
        }
        self.stage.submitted(&mut job.note, shared.clock.now());
        self.to_pack.push(job).ok()
    }

    /// Waits until the poses should be read; returns the time. What it waits longer for a sample is no lateness.
    fn wait_for(&mut self, latch: &mut Latch) -> HostTime {
        let (clock, pulse) = (self.shared.clock, &self.crew.pulses[PLAN]);
        pulse.beat(latch.at.max(clock.now()), WAIT_NS + STEP_NS);
        let mut now = clock.wait_until(latch.at);
        if let Some(awaited) = latch.awaited {
            let woken_at = now;
            while self.inbox.latest.latest().0.captured_at < awaited.captured_at && now < awaited.until {
                now = clock.wait_until(awaited.until.min(now.plus_ns(AWAIT_STEP_NS)));
            }
            latch.due_at = latch.due_at.plus_ns(now.ns_since(woken_at));
        }
        pulse.beat(now, STEP_NS);
        now
    }
}

/// The inputs of packing.
pub(super) struct PackInbox {
    pub(super) jobs: Receiver<FrameJob>,
    /// Wakes planning where it waits for the GPU.
    pub(super) gpu_waker: Waker,
}

/// Waits for rendered frames and packs them into planes until no more come.
pub(super) fn pack_thread(
    shared: &RunState,
    crew: &CrewState,
    mut stage: PackStage,
    mut packer: Packer,
    inbox: PackInbox,
    mut to_link: Sender<FrameJob>,
) {
    let RunState { facts, clock, .. } = shared;
    let PackInbox { mut jobs, gpu_waker } = inbox;
    shared.rights.enter(2);
    let pulse = &crew.pulses[PACK];
    pulse.begin(thread_id());
    let alive = || pulse.beat(clock.now(), WAIT_NS + STEP_NS);
    let goes_on = || {
        alive();
        !crew.is_abandoned.load(Ordering::Relaxed)
    };
    let mut unfinished = None;
    while let Some(mut job) = next(&mut jobs, goes_on) {
        let frame = job.note.plan.id.0;
        enter_frame_path(frame >= WARM_UP_FRAMES);
        may_stall(facts, StallIn::Pack, frame);
        let begin = clock.now();
        crew.waits_for_gpu(frame, begin, stage.wait_from(&job.note, begin));
        // The supervisor judges whether the GPU hangs: it sees whether the machine serves the driver's workers.
        let is_rendered = crate::render::finish(&mut job, goes_on);
        crew.gpu.end();
        if !matches!(is_rendered, Ok(true)) {
            if let Err(source) = is_rendered {
                crew.fail(PipelineError::Gpu { frame, source });
            }
            unfinished = Some(job);
            break;
        }
        let now = clock.now();
        stage.wait_is_over();
        // A prepared frame is ready when it is planned. The time after that is spent waiting for the packer.
        job.note.timeline.rendered_at = job.note.timeline.submitted_at;
        if job.memory.gpu.is_some() {
            job.note.timeline.rendered_at = now;
            stage.rendered(&job.note, now);
            gpu_waker.wake();
        }
        job.note.timeline.packing_at = now;
        if stage.is_wanted(&mut job.note, now, jobs.is_empty()) {
            packer.pack(&mut job, facts.options.verify);
        }
        job.note.timeline.packed_at = clock.now();
        if to_link.push(job).is_err() || crew.is_abandoned.load(Ordering::Relaxed) {
            break;
        }
    }
    enter_frame_path(false);
    pulse.end();
    dismiss(unfinished, jobs);
}

/// Drops what the GPU still has of a crew that has ended or was abandoned, each frame when the GPU has finished it. Ends when planning has, so that
/// no frame is overlooked.
fn dismiss(mut unfinished: Option<FrameJob>, mut jobs: Receiver<FrameJob>) {
    while unfinished.is_some() || !jobs.is_finished() {
        if let Some(job) = unfinished.take().or_else(|| pop_within(&mut jobs, WAIT_NS)) {
            crate::render::dismiss(job);
        }
    }
}

/// Waits at most `limit_ns` for the GPU to finish a frame.
///
/// # Errors
/// The GPU does not finish in time, or was lost.
pub(super) fn rendered(job: &mut FrameJob, limit_ns: u64) -> Result<(), PipelineError> {
    let frame = job.note.plan.id.0;
    let watch = Stopwatch::start();
    match crate::render::finish(job, || watch.elapsed_ns() < limit_ns) {
        Ok(true) => Ok(()),
        Ok(false) => Err(PipelineError::GpuHangs { frame, ms: limit_ns / 1_000_000 }),
        Err(source) => Err(PipelineError::Gpu { frame, source }),
    }
}

/// The next job, or `None` if no more will come or it does not go on, which is asked before each wait.
fn next(from: &mut Receiver<FrameJob>, goes_on: impl Fn() -> bool) -> Option<FrameJob> {
    while goes_on() {
        if let Some(job) = pop_within(from, WAIT_NS) {
            return Some(job);
        }
        if from.is_finished() {
            return None;
        }
    }
    None
}
