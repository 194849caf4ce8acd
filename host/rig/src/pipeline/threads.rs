//! What the stages of a run do in their threads, and what they share: tracking and packing. (`planning.rs` has planning's, `link.rs` the link's.)

use super::crew::{CrewState, PACK, TRACKING};
use super::outcome::{PipelineError, RunOptions, StallIn};
use super::pulse::Pulse;
use super::rights::Rights;
use crate::config::{Pace, Wait};
use crate::frame::job::{Fate, FrameJob, FrameNote};
use crate::pack::prepared::PreparedFrames;
use crate::plan::budget::BudgetController;
use crate::plan::link_time::LinkTime;
use crate::realtime::wait_policy;
use crate::rig::Rig;
use crate::telemetry::monitor::RunMonitor;
use crate::tracks::{TrackSnapshot, TrackingStage};
use dpm_common::clock::{Clock, RunClock, Stopwatch};
use dpm_device::time::HostTime;
use dpm_handoff::channel::{Receiver, Sender};
use dpm_handoff::latest::Publisher;
use dpm_handoff::wake::{WaitPolicy, Waker};
use dpm_render::pack::Kernel;
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
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
pub(super) const MARGIN_NS: i64 = 50_000;
/// Frames that may be between planning and the collector's books: a quarter of a second at 947 Hz.
pub(super) const NOTES: usize = 256;
/// Tracking, plan, pack, link, and the mock projector.
pub(super) const STAGE_THREADS: usize = 5;
/// Real pace: what a projector needs to take a frame in and check it once the medium has all of it. The host cannot measure it.
pub(super) const RECEIPT_NS: i64 = 500_000;
/// Longest wait for another stage before it is looked whether the run goes on.
pub(super) const WAIT_NS: i64 = 20_000_000;
/// What a step of a stage may take beside its waits before anybody wonders.
pub(super) const STEP_NS: i64 = 20_000_000;
/// What a poll of a tracker may take: some have to be opened or connected to anew.
const POLL_NS: i64 = 200_000_000;
/// Virtual pace: a frame that the GPU has not finished by then is given up, and the run with it.
const GPU_TIMEOUT_NS: u64 = 20_000_000_000;
/// The same for the first one, for which drivers translate shaders: minutes on a slow machine that does other things too.
pub(super) const FIRST_FRAME_TIMEOUT_NS: u64 = 180_000_000_000;
/// Time for which trackers are listened to before the first frame, so that the filters know the motion.
pub(super) const LISTEN_NS: i64 = 150_000_000;

/// Everything that the threads of a run share, whichever crew works.
pub(super) struct Shared {
    pub(super) rig: Arc<Rig>,
    pub(super) clock: Arc<RunClock>,
    /// The projector's clock as the handshake found it.
    pub(super) time: LinkTime,
    /// Real pace: how long before its slot a frame is latched, nanoseconds.
    pub(super) lead_ns: AtomicI64,
    /// Real pace: what most frames need from latch to sent, nanoseconds.
    pub(super) typical_ns: AtomicI64,
    /// Learned time from sent to light, nanoseconds (projectors outside).
    pub(super) travel_ns: AtomicI64,
    /// When the supervisor last found every stage alive.
    pub(super) alive_at_ns: AtomicI64,
    /// Number of the next frame.
    pub(super) next_frame: AtomicU64,
    /// Slot after the last one that the run was asked to plan for; 0 while it is not known.
    pub(super) end_slot: AtomicU64,
    /// Slots from one planned frame to the next, in thousandths, as an average of the last frames.
    pub(super) stride_milli: AtomicU64,
    /// Longest time for which a body is carried on by prediction, nanoseconds.
    pub(super) predict_ns: AtomicI64,
    /// Every frame that the run was asked for is planned.
    pub(super) is_complete: AtomicBool,
    /// The link's thread has ended, and the projector is dark.
    pub(super) is_link_over: AtomicBool,
    /// A thread that nobody can replace hangs: whoever can still end the run does not wait for the others.
    pub(super) is_broken: AtomicBool,
    pub(super) link_pulse: Pulse,
    pub(super) collector_pulse: Pulse,
    pub(super) error: Mutex<Option<PipelineError>>,
    pub(super) monitor: Arc<RunMonitor>,
    pub(super) options: RunOptions,
    pub(super) rights: Arc<Rights>,
}

impl Shared {
    /// The run ends, in the dark, with this error; the first one counts.
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

    pub(super) fn costs(&self) -> [i64; 4] {
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

/// Reads the tracker until planning is over. Returns what is wrong with the tracker at the end.
pub(super) fn tracking_thread(
    shared: &Shared,
    crew: &CrewState,
    mut stage: TrackingStage,
    mut latest: Publisher<TrackSnapshot>,
) -> Option<String> {
    shared.rights.enter(0);
    let pulse = &crew.pulses[TRACKING];
    pulse.begin();
    let _ = crew.tracking.set(std::thread::current());
    let mut heard_to = i64::MIN;
    let mut steps = 0u32;
    let mut planned = 0;
    while !crew.tracking_over.load(Ordering::Acquire) {
        // Each frame once, also those that were planned while this thread slept.
        let planning = crew.planning.load(Ordering::Relaxed);
        while planned < planning {
            planned += 1;
            shared.may_stall(StallIn::Tracking, planned);
        }
        let now = if shared.is_virtual() {
            let wanted = crew.listen_to.load(Ordering::Acquire);
            if wanted == heard_to {
                // Not spinning: software Vulkan needs every core.
                std::thread::park_timeout(Duration::from_millis(1));
                continue;
            }
            heard_to = wanted;
            HostTime(wanted)
        } else {
            let now = shared.clock.now();
            pulse.beat(now, POLL_NS);
            now
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
    pulse.end();
    stage.never_seen(&shared.rig)
}

/// Where packing finds its work.
pub(super) struct PackInbox {
    pub(super) jobs: Receiver<FrameJob>,
    /// Wakes planning where it waits for the GPU.
    pub(super) gpu_waker: Waker,
}

/// What the GPU took for the last frames, and so how long the next is waited for.
struct GpuTimes {
    recent: [i64; 64],
    count: usize,
    last_done_at: HostTime,
}

impl GpuTimes {
    /// Frames after which the GPU is warm.
    const WARM: usize = 16;
    /// Shortest and longest wait, nanoseconds.
    const SHORTEST_NS: i64 = 100_000_000;
    const LONGEST_NS: i64 = 2_000_000_000;

    fn new() -> Self {
        Self { recent: [0; 64], count: 0, last_done_at: HostTime(i64::MIN) }
    }

    /// The GPU finished a frame; returns what it took for this one alone.
    fn finished(&mut self, submitted_at: HostTime, done_at: HostTime) -> i64 {
        let took = done_at.ns_since(submitted_at);
        self.recent[self.count % self.recent.len()] = took;
        self.count += 1;
        let alone = done_at.ns_since(submitted_at.max(self.last_done_at));
        self.last_done_at = done_at;
        alone
    }

    /// How long a frame is waited for: four times the recent 99th percentile (of 64 frames the longest), at most two seconds.
    fn limit_ns(&self) -> u64 {
        let longest = self.recent.iter().copied().max().unwrap_or(0);
        let limit = if self.count < Self::WARM { Self::LONGEST_NS } else { longest.saturating_mul(4) };
        limit.clamp(Self::SHORTEST_NS, Self::LONGEST_NS) as u64
    }
}

/// Waits for rendered frames and cuts them into planes until no more come.
pub(super) fn pack_thread(
    shared: &Shared,
    crew: &CrewState,
    kernel: Kernel,
    mut prepared: Option<PreparedFrames>,
    mut budget: Option<BudgetController>,
    inbox: PackInbox,
    mut to_link: Sender<FrameJob>,
) {
    let PackInbox { mut jobs, gpu_waker } = inbox;
    shared.rights.enter(2);
    let pulse = &crew.pulses[PACK];
    pulse.begin();
    let mut times = GpuTimes::new();
    let mut late_in_a_row = 0;
    while let Some(mut job) = next(&mut jobs, || pulse.beat(shared.clock.now(), WAIT_NS + STEP_NS)) {
        let id = job.note.id.0;
        enter_frame_path(id >= WARM_UP_FRAMES);
        shared.may_stall(StallIn::Pack, id);
        let limit = match (shared.is_virtual(), id) {
            (false, _) => times.limit_ns(),
            (true, 0) => FIRST_FRAME_TIMEOUT_NS,
            (true, _) => GPU_TIMEOUT_NS,
        };
        let alive = || pulse.beat(shared.clock.now(), WAIT_NS + STEP_NS);
        let failure = match crate::render::finish(&mut job, limit, alive) {
            Ok(true) => None,
            Ok(false) => Some(PipelineError::GpuHangs { frame: id, ms: limit / 1_000_000 }),
            Err(source) => Some(PipelineError::Gpu { frame: id, source }),
        };
        if let Some(failure) = failure {
            crew.fail(failure);
            break;
        }
        if job.memory.gpu.is_some() {
            crew.gpu.finish(times.finished(job.note.timeline.submitted_at, shared.clock.now()));
            gpu_waker.wake();
        }
        if let (Some(controller), Some(gpu_ns)) = (&mut budget, job.note.gpu_ns()) {
            controller.measured(job.note.budget_milli, gpu_ns);
            crew.budget_milli.store(controller.rays(), Ordering::Relaxed);
        }
        if !shared.is_virtual() {
            let now = shared.clock.now();
            let rendered = job.memory.gpu.is_some();
            let t = &mut job.note.timeline;
            // A prepared frame is there when it is planned: what follows is waiting for the packer.
            (t.rendered_at, t.packing_at) = (if rendered { now } else { t.submitted_at }, now);
        }
        // What waits behind is still being rendered. More late frames than were under way are no stall: a GPU this slow has no
        // newer frame that would be in time, and late frames are better than none while their poses are young enough.
        let is_late = !shared.is_virtual() && shared.clock.now() >= job.note.timeline.due_at;
        late_in_a_row = if is_late { late_in_a_row + 1 } else { 0 };
        let is_slow = prepared.is_none() && late_in_a_row > shared.options.in_flight;
        if is_slow || !is_overtaken(shared, &mut job.note, jobs.is_empty()) {
            crate::pack::pack(&mut job, kernel, shared.options.verify, &mut prepared);
        }
        if !shared.is_virtual() {
            job.note.timeline.packed_at = shared.clock.now();
        }
        if to_link.push(job).is_err() || crew.is_abandoned.load(Ordering::Relaxed) {
            break;
        }
    }
    enter_frame_path(false);
    pulse.end();
}

/// Leaves a frame out whose slot has begun while a newer one waits behind it: after a stall nothing queues up. At virtual pace
/// nothing is ever late.
pub(super) fn is_overtaken(shared: &Shared, note: &mut FrameNote, is_newest: bool) -> bool {
    let overtaken = note.fate == Fate::UnderWay
        && !shared.is_virtual()
        && !is_newest
        && shared.clock.now() >= note.timeline.due_at;
    if overtaken {
        note.fate = Fate::Overtaken;
    }
    note.fate == Fate::Overtaken
}

/// The next job, or `None` when no more will come; `alive` is called before each wait.
fn next(from: &mut Receiver<FrameJob>, alive: impl Fn()) -> Option<FrameJob> {
    loop {
        alive();
        if let Some(job) = pop_within(from, WAIT_NS) {
            return Some(job);
        }
        if from.is_finished() {
            return None;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gpu_is_waited_for_four_times_as_long_as_it_lately_took() {
        let mut times = GpuTimes::new();
        assert_eq!(times.limit_ns(), 2_000_000_000, "not warm yet");
        let at = |ms: i64| HostTime(ms * 1_000_000);
        for i in 0..40 {
            // Two in flight: each is under way for 80 ms, of which 40 are its own.
            let alone = times.finished(at(40 * i), at(40 * i + 80));
            assert!(i == 0 || alone == 40_000_000, "{alone}");
        }
        assert_eq!(times.limit_ns(), 320_000_000);
        times.finished(at(5000), at(9000));
        assert_eq!(times.limit_ns(), 2_000_000_000, "never longer than two seconds");
        for i in 0..64 {
            times.finished(at(10_000 + 10 * i), at(10_001 + 10 * i));
        }
        assert_eq!(times.limit_ns(), 100_000_000);
    }
}
