//! The threads of a run and what they share: tracking, planning and packing. (`link.rs` has the link's.)

use super::collect::Collector;
use super::job::{Fate, FrameJob, FrameMemory, FrameNote};
use super::keeper::{LinkKeeper, ProjectorReport};
use super::light::{LightNote, LightRecorder};
use super::link::{link_thread, Cable, Line};
use super::outcome::{PipelineError, RunOptions, StallIn};
use super::prepared::PreparedFrames;
use super::rights::Rights;
use super::stages::{self, LinkTime, TrackSnapshot, TrackingStage};
use crate::clock::{Clock, RunClock, Stopwatch};
use crate::config::{Pace, Wait};
use crate::frame::Stage;
use crate::pack::Kernel;
use crate::plan::budget::BudgetController;
use crate::plan::lead::LeadEstimator;
use crate::realtime::wait_policy;
use crate::render::Renderer;
use crate::rig::Rig;
use crate::telemetry::monitor::RunMonitor;
use dpm_device::link::HostLink;
use dpm_device::time::HostTime;
use dpm_handoff::channel::{channel, Receiver, Sender};
use dpm_handoff::latest::{latest, Publisher, Reader};
use dpm_handoff::wake::WaitPolicy;
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

thread_local! {
    static ON_FRAME_PATH: Cell<bool> = const { Cell::new(false) };
}

/// True while the calling thread works on frames in the steady state: a counting allocator may demand that nothing is allocated.
pub fn on_frame_path() -> bool {
    ON_FRAME_PATH.with(Cell::get)
}

pub(super) fn enter_frame_path(inside: bool) {
    ON_FRAME_PATH.with(|c| c.set(inside));
}

/// Frames until the steady state, in which nothing is allocated any more.
pub(super) const WARM_UP_FRAMES: u64 = 16;
/// Reads of the tracker until its buffers have grown.
const WARM_UP_STEPS: u32 = 64;
/// Virtual pace: time between the last byte of a frame and its slot, for jitter of the hand-offs.
const MARGIN_NS: i64 = 50_000;
/// Frames that may be between planning and the collector's books: a quarter of a second at 947 Hz.
const NOTES: usize = 256;
/// Tracking, plan, pack, link, and the mock projector.
pub(super) const STAGE_THREADS: usize = 5;
/// Real pace: what a projector needs to take a frame in and check it once the medium has all of it. The host cannot measure it.
pub(super) const RECEIPT_NS: i64 = 500_000;
/// Longest wait for another stage before it is looked whether the run goes on.
const WAIT_NS: i64 = 100_000_000;
/// A frame that the GPU has not finished by then is given up, and the run with it.
const GPU_TIMEOUT_NS: u64 = 20_000_000_000;
/// The same for the first one, for which drivers translate shaders: minutes on a slow machine that does other things too.
pub(super) const FIRST_FRAME_TIMEOUT_NS: u64 = 180_000_000_000;
/// Time for which trackers are listened to before the first frame, so that the filters know the motion.
pub(super) const LISTEN_NS: i64 = 150_000_000;

/// Everything that the threads share.
pub(super) struct Shared<'a> {
    pub(super) rig: Arc<Rig>,
    pub(super) clock: &'a RunClock,
    pub(super) time: LinkTime,
    /// Virtual pace: samples up to here are wanted.
    pub(super) listen_to: AtomicI64,
    /// Virtual pace: who to wake when more is wanted.
    pub(super) tracking: OnceLock<std::thread::Thread>,
    /// Real pace: how long before its slot a frame is latched, nanoseconds.
    pub(super) lead_ns: AtomicI64,
    /// Real pace: what most frames need from latch to sent, nanoseconds.
    pub(super) typical_ns: AtomicI64,
    /// Learned time from sent to light, nanoseconds (projectors outside).
    pub(super) travel_ns: AtomicI64,
    /// Thousandths of a sample that a pixel gets on average.
    pub(super) budget_milli: AtomicU64,
    /// The frame that is being planned.
    pub(super) planning: AtomicU64,
    pub(super) tracking_over: AtomicBool,
    pub(super) error: Mutex<Option<PipelineError>>,
    pub(super) monitor: &'a RunMonitor,
    pub(super) options: RunOptions,
    pub(super) rights: &'a Rights,
}

impl Shared<'_> {
    pub(super) fn fail(&self, error: PipelineError) {
        if let Ok(mut first) = self.error.lock() {
            first.get_or_insert(error);
        }
        self.monitor.request_stop();
    }

    /// Stands still where the run's options say so.
    pub(super) fn may_stall(&self, stage: StallIn, frame: u64) {
        if let Some(stall) = self.options.stall.filter(|s| (s.stage, s.frame) == (stage, frame)) {
            std::thread::sleep(stall.length);
        }
    }

    pub(super) fn is_virtual(&self) -> bool {
        self.rig.config.real_time.pace == Pace::Virtual
    }

    fn costs(&self) -> [i64; 4] {
        let c = &self.rig.config.real_time.stage_costs_us;
        [c.plan, c.render, c.pack, c.send].map(|us| i64::from(us) * 1000)
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

/// The next value, waited for at most `limit_ns` of the wall clock (whatever the pace).
pub(super) fn pop_within<T>(from: &mut Receiver<T>, limit_ns: i64) -> Option<T> {
    from.try_pop().or_else(|| {
        let watch = Stopwatch::start();
        from.pop(limit_ns, || watch.elapsed_ns() as i64)
    })
}

/// What the stages of a run work with.
pub(super) struct Stages<'a> {
    pub(super) tracking: TrackingStage,
    /// `None` if frames are prepared.
    pub(super) renderer: Option<&'a mut Renderer>,
    pub(super) prepared: Option<PreparedFrames>,
    /// How planes are packed if the GPU has not done it.
    pub(super) kernel: Kernel,
    /// `None` if every frame gets the rays that the rig file asks for.
    pub(super) budget: Option<BudgetController>,
    pub(super) link: HostLink,
    pub(super) cable: Cable,
    pub(super) lead: LeadEstimator,
    /// What frames are made in.
    pub(super) memory: Vec<FrameMemory>,
    /// Where the link's thread tells of light that it has word of; `None` if somebody sees the light itself.
    pub(super) seen: Option<Sender<LightNote>>,
    /// Light, from either of them.
    pub(super) lights: Receiver<LightNote>,
}

/// What the stages leave behind.
pub(super) struct Leavings {
    /// The recorder of a projector without a thread of its own.
    pub(super) recorder: Option<LightRecorder>,
    /// What was carried.
    pub(super) carried: ProjectorReport,
    /// Bodies that were never seen, and why.
    pub(super) unseen: Option<String>,
}

/// Starts the stages and waits for all of them.
pub(super) fn run_threads(
    shared: &Shared<'_>,
    stages: Stages<'_>,
    collector: &mut Collector,
) -> Result<Leavings, PipelineError> {
    let Stages { tracking, renderer, prepared, kernel, budget, link, cable, lead, memory, seen, lights } =
        stages;
    let policy = policy(&shared.rig);
    // Room for everything there is: no stage ever finds the next one's channel full.
    let jobs = memory.len();
    let (mut free_in, free_out) = channel(jobs, policy);
    let (to_pack_in, to_pack_out) = channel(jobs, policy);
    let (to_link_in, to_link_out) = channel(jobs, policy);
    let (done_in, done_out) = channel(NOTES, WaitPolicy::Park);
    let (mut notes_in, notes_out) = channel(NOTES, WaitPolicy::Park);
    for memory in memory {
        let _ = free_in.push(Box::new(memory));
    }
    for _ in 0..NOTES {
        let _ = notes_in.push(Box::new(FrameNote::new(shared.rig.bodies.len())));
    }
    std::thread::scope(|scope| {
        let (publisher, reader) = latest(TrackSnapshot::EMPTY);
        let (times, time) = latest(shared.time);
        let keeper = LinkKeeper::new(shared.time, times, &link, seen);
        let line = Line { link, cable, keeper, lead };
        let named = |name: &'static str| std::thread::Builder::new().name(format!("dpm-{name}"));
        let refused = |stage| move |source| PipelineError::Thread { stage, source };
        // A stage that returns or panics drops its senders, which ends the next one: nobody waits for ever.
        let tracking = named("tracking")
            .spawn_scoped(scope, move || tracking_thread(shared, tracking, publisher))
            .map_err(refused("tracking"))?;
        let plan = named("plan")
            .spawn_scoped(scope, move || {
                let _close = OnExit(|| shared.tracking_over.store(true, Ordering::Release));
                plan_thread(shared, renderer, reader, time, free_out, notes_out, to_pack_in);
            })
            .map_err(refused("plan"))?;
        let pack = named("pack")
            .spawn_scoped(scope, move || {
                let _close = OnExit(|| shared.monitor.request_stop());
                pack_thread(shared, kernel, prepared, budget, to_pack_out, to_link_in);
            })
            .map_err(refused("pack"))?;
        let link = named("link")
            .spawn_scoped(scope, move || {
                let _close = OnExit(|| shared.monitor.request_stop());
                link_thread(shared, line, to_link_out, free_in, done_in)
            })
            .map_err(refused("link"))?;
        collector.run(done_out, notes_in, lights, shared.monitor);
        let link = link.join();
        for (name, thread) in [("pack", pack), ("plan", plan)] {
            if thread.join().is_err() {
                shared.fail(PipelineError::Panicked(name));
            }
        }
        let unseen = tracking.join().unwrap_or_else(|_| {
            shared.fail(PipelineError::Panicked("tracking"));
            None
        });
        let (recorder, carried) = link.map_err(|_| PipelineError::Panicked("link"))?;
        Ok(Leavings { recorder, carried, unseen })
    })
}

/// Calls its function when dropped, during a panic too.
struct OnExit<F: FnMut()>(F);

impl<F: FnMut()> Drop for OnExit<F> {
    fn drop(&mut self) {
        (self.0)();
    }
}

/// Returns what is wrong with the tracker at the end.
fn tracking_thread(
    shared: &Shared<'_>,
    mut stage: TrackingStage,
    mut latest: Publisher<TrackSnapshot>,
) -> Option<String> {
    shared.rights.enter(0);
    let _ = shared.tracking.set(std::thread::current());
    let mut heard_to = i64::MIN;
    let mut steps = 0u32;
    let mut planned = 0;
    while !shared.tracking_over.load(Ordering::Acquire) {
        // Each frame once, also those that were planned while this thread slept.
        let planning = shared.planning.load(Ordering::Relaxed);
        while planned < planning {
            planned += 1;
            shared.may_stall(StallIn::Tracking, planned);
        }
        let now = if shared.is_virtual() {
            let wanted = shared.listen_to.load(Ordering::Acquire);
            if wanted == heard_to {
                // Not spinning: software Vulkan needs every core.
                std::thread::park_timeout(Duration::from_millis(1));
                continue;
            }
            heard_to = wanted;
            HostTime(wanted)
        } else {
            shared.clock.now()
        };
        steps = steps.saturating_add(1);
        enter_frame_path(steps >= WARM_UP_STEPS);
        // A tracker that fails is told by the freshness of its tracks: light goes off by itself, and the report says why.
        let _ = stage.step(now, &mut latest);
        if stage.is_silence_due(now) {
            // Off the frame path for once: a body is dark for want of samples, and the operator should not learn it from the report.
            enter_frame_path(false);
            if let Some(word) = stage.not_seen_yet(&shared.rig) {
                shared.monitor.tell_of_tracker(word);
            }
        }
        if !shared.is_virtual() {
            std::thread::sleep(Duration::from_micros(200));
        }
    }
    enter_frame_path(false);
    stage.never_seen(&shared.rig)
}

fn plan_thread(
    shared: &Shared<'_>,
    mut renderer: Option<&mut Renderer>,
    mut latest: Reader<TrackSnapshot>,
    mut time: Reader<LinkTime>,
    mut free: Receiver<Box<FrameMemory>>,
    mut notes: Receiver<Box<FrameNote>>,
    mut to_pack: Sender<FrameJob>,
) {
    shared.rights.enter(1);
    let costs = shared.costs();
    let modelled = costs.iter().sum::<i64>() + MARGIN_NS;
    let begin = shared.clock.now();
    let mut next_slot =
        shared.time.slot_after(begin.plus_ns(modelled + if shared.is_virtual() { 0 } else { LISTEN_NS }));
    let RunOptions { frames, slots, .. } = shared.options;
    let end = if slots == 0 { u64::MAX } else { next_slot.saturating_add(slots) };
    let mut id = 0u64;
    let mut hottest = Vec::with_capacity(shared.options.in_flight.max(2));
    while !shared.monitor.stop_requested() && (frames == 0 || id < frames) && next_slot < end {
        enter_frame_path(id >= WARM_UP_FRAMES);
        // What came back last is taken first: it is the warmest in the caches.
        while let Some(memory) = free.try_pop() {
            hottest.push(memory);
        }
        let waited = hottest.is_empty();
        if waited {
            hottest.extend(pop_within(&mut free, WAIT_NS));
        }
        if hottest.is_empty() {
            continue;
        }
        let Some(note) = pop_within(&mut notes, WAIT_NS) else { continue };
        let Some(memory) = hottest.pop() else { continue };
        shared.planning.store(id, Ordering::Relaxed);
        shared.may_stall(StallIn::Plan, id);
        let mut job = FrameJob { note, memory };
        job.note.waited_for_memory = waited;
        let travel =
            shared.travel_ns.load(Ordering::Relaxed) + if shared.is_virtual() { 0 } else { RECEIPT_NS };
        let lead =
            travel + if shared.is_virtual() { modelled } else { shared.lead_ns.load(Ordering::Relaxed) };
        let time = *time.latest().0;
        let now = shared.clock.now();
        if !shared.is_virtual() {
            // Frames are begun early enough for a bad moment, so after one there is time to catch up: a slot is given up only
            // when a frame that takes as long as most do would miss it.
            let typical = shared.typical_ns.load(Ordering::Relaxed) + travel;
            next_slot = next_slot.max(time.slot_after(now.plus_ns(typical)));
        }
        let due_at = time.host_of_slot(next_slot);
        let latch_at = due_at.plus_ns(-lead);
        shared.clock.wait_until(latch_at);
        // Waking up too late counts; what kept the frame from being begun earlier does not.
        job.note.latch_due_at = latch_at.max(now);
        if shared.is_virtual() {
            // What arrives later than this is no pose yet when the frame is latched.
            let heard = latch_at.plus_ns(-i64::from(shared.rig.config.real_time.stage_costs_us.track) * 1000);
            shared.listen_to.store(heard.0, Ordering::Release);
            if let Some(tracking) = shared.tracking.get() {
                tracking.unpark();
            }
            while latest.latest().0.through < heard && !shared.monitor.stop_requested() {
                std::thread::yield_now();
            }
        }
        job.note.budget_milli = shared.budget_milli.load(Ordering::Relaxed);
        stages::plan(&mut job, &shared.rig, latest.latest().0, &time, id, next_slot);
        let t = &mut job.note.timeline;
        if shared.is_virtual() {
            t.latched_at = latch_at;
            t.submitted_at = t.latched_at.plus_ns(costs[0]);
            t.rendered_at = t.submitted_at.plus_ns(costs[1]);
            t.packed_at = t.rendered_at.plus_ns(costs[2]);
            t.sent_at = t.packed_at.plus_ns(costs[3]);
        } else {
            t.latched_at = shared.clock.now();
        }
        let submitted = match renderer.as_deref_mut() {
            Some(renderer) => stages::submit(&mut job, &shared.rig, renderer),
            None => Ok(()),
        };
        if let Err(source) = submitted {
            shared.fail(PipelineError::Gpu { frame: id, source });
            break;
        }
        if !shared.is_virtual() {
            job.note.timeline.submitted_at = shared.clock.now();
        }
        shared.monitor.count_planned();
        id += 1;
        next_slot += 1;
        if to_pack.push(job).is_err() {
            break;
        }
    }
    enter_frame_path(false);
}

fn pack_thread(
    shared: &Shared<'_>,
    kernel: Kernel,
    mut prepared: Option<PreparedFrames>,
    mut budget: Option<BudgetController>,
    mut jobs: Receiver<FrameJob>,
    mut to_link: Sender<FrameJob>,
) {
    shared.rights.enter(2);
    let mut late_in_a_row = 0;
    while let Some(mut job) = next(&mut jobs) {
        let id = job.note.id.0;
        enter_frame_path(id >= WARM_UP_FRAMES);
        shared.may_stall(StallIn::Pack, id);
        let limit = if id == 0 { FIRST_FRAME_TIMEOUT_NS } else { GPU_TIMEOUT_NS };
        if let Err(source) = stages::finish(&mut job, limit) {
            shared.fail(PipelineError::Gpu { frame: id, source });
            break;
        }
        if let (Some(controller), Some(gpu_ns)) = (&mut budget, job.note.gpu_ns()) {
            controller.measured(job.note.budget_milli, gpu_ns);
            shared.budget_milli.store(controller.rays(), Ordering::Relaxed);
        }
        // What waits behind is still being rendered. More late frames than were under way are no stall: a GPU this slow has no
        // newer frame that would be in time, and late frames are better than none.
        let is_late = !shared.is_virtual() && shared.clock.now() >= job.note.timeline.due_at;
        late_in_a_row = if is_late { late_in_a_row + 1 } else { 0 };
        let is_slow = prepared.is_none() && late_in_a_row > shared.options.in_flight;
        if is_slow || !is_overtaken(shared, &mut job.note, &jobs) {
            stages::pack(&mut job, kernel, shared.options.verify, &mut prepared);
        }
        if !shared.is_virtual() {
            let now = shared.clock.now();
            let t = &mut job.note.timeline;
            t.rendered_at = now.plus_ns(-(t.wall_ns[Stage::Pack as usize] as i64));
            t.packed_at = now;
        }
        if to_link.push(job).is_err() {
            break;
        }
    }
    enter_frame_path(false);
}

/// Leaves a frame out whose slot has begun while a newer one waits behind it: after a stall nothing queues up. At virtual pace
/// nothing is ever late.
pub(super) fn is_overtaken(shared: &Shared<'_>, note: &mut FrameNote, behind: &Receiver<FrameJob>) -> bool {
    let overtaken = note.fate == Fate::UnderWay
        && !shared.is_virtual()
        && !behind.is_empty()
        && shared.clock.now() >= note.timeline.due_at;
    if overtaken {
        note.fate = Fate::Overtaken;
    }
    note.fate == Fate::Overtaken
}

/// The next job, or `None` when no more will come.
fn next(from: &mut Receiver<FrameJob>) -> Option<FrameJob> {
    loop {
        if let Some(job) = pop_within(from, WAIT_NS) {
            return Some(job);
        }
        if from.is_finished() {
            return None;
        }
    }
}
