//! The threads of a run: each stage's loop, and what they share.

use super::collect::Collector;
use super::handoff::Ring;
use super::job::FrameJob;
use super::keeper::{is_dark, LinkKeeper, ProjectorReport};
use super::light::{LightNote, LightRecorder};
use super::outcome::{PipelineError, RunOptions};
use super::prepared::PreparedFrames;
use super::rights::Rights;
use super::stages::{self, LinkTime, TrackSnapshot, TrackingStage};
use crate::clock::{Clock, RunClock, Stopwatch};
use crate::config::Pace;
use crate::frame::Stage;
use crate::pack::Kernel;
use crate::render::Renderer;
use crate::rig::Rig;
use crate::telemetry::monitor::RunMonitor;
use dpm_device::link::{HostLink, LinkState, SendOutcome};
use dpm_device::time::HostTime;
use dpm_device::transport::inproc::{DeviceEnd, Direct, HostEnd};
use dpm_device::transport::Transport;
use dpm_handoff::latest::{latest, Publisher, Reader};
use hil_mock::projector::MockProjector;
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

thread_local! {
    static ON_FRAME_PATH: Cell<bool> = const { Cell::new(false) };
}

/// True while the calling thread works on frames in the steady state: a counting allocator may demand that nothing is allocated.
pub fn on_frame_path() -> bool {
    ON_FRAME_PATH.with(Cell::get)
}

fn enter_frame_path(inside: bool) {
    ON_FRAME_PATH.with(|c| c.set(inside));
}

/// Frames until the steady state, in which nothing is allocated any more.
const WARM_UP_FRAMES: u64 = 16;
/// Reads of the tracker until its buffers have grown.
const WARM_UP_STEPS: u32 = 64;
/// Time between the last byte of a frame and its slot, for jitter of the hand-offs.
const MARGIN_NS: i64 = 50_000;
/// How often a link without credit looks for some.
const CREDIT_STEP_NS: i64 = 50_000;
/// A frame that the GPU has not finished by then is given up, and the run with it.
const GPU_TIMEOUT_NS: u64 = 20_000_000_000;
/// A projector outside is told to stop for at most this long; its watchdog does the rest.
const DARK_WITHIN_MS: u32 = 300;
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
    /// Measured time from latch to sent, nanoseconds (real pace).
    pub(super) lead_ns: AtomicI64,
    /// Learned time from sent to light, nanoseconds (projectors outside).
    pub(super) travel_ns: AtomicI64,
    pub(super) free: Ring<Box<FrameJob>>,
    pub(super) to_pack: Ring<Box<FrameJob>>,
    pub(super) to_link: Ring<Box<FrameJob>>,
    pub(super) done: Ring<Box<FrameJob>>,
    pub(super) lights: Arc<Ring<LightNote>>,
    pub(super) tracking_over: AtomicBool,
    pub(super) error: Mutex<Option<PipelineError>>,
    pub(super) monitor: &'a RunMonitor,
    pub(super) options: RunOptions,
    pub(super) verify: bool,
    pub(super) rights: &'a Rights,
}

impl Shared<'_> {
    fn fail(&self, error: PipelineError) {
        if let Ok(mut first) = self.error.lock() {
            first.get_or_insert(error);
        }
        self.monitor.request_stop();
    }

    fn is_virtual(&self) -> bool {
        self.rig.config.real_time.pace == Pace::Virtual
    }

    fn costs(&self) -> [i64; 4] {
        let c = &self.rig.config.real_time.stage_costs_us;
        [c.plan, c.render, c.pack, c.send].map(|us| i64::from(us) * 1000)
    }
}

/// The link's medium.
pub(super) enum Cable {
    Direct(Box<Direct<MockProjector>>, LightRecorder),
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
}

/// Starts the stages, waits for all of them, and returns the cable with what it carried.
pub(super) fn run_threads(
    shared: &Shared<'_>,
    tracking: TrackingStage,
    renderer: Option<&mut Renderer>,
    prepared: Option<PreparedFrames>,
    kernel: Kernel,
    link: HostLink,
    cable: Cable,
    collector: &mut Collector,
) -> Result<(Cable, ProjectorReport), PipelineError> {
    std::thread::scope(|scope| {
        let (publisher, reader) = latest(TrackSnapshot::EMPTY);
        let (times, time) = latest(shared.time);
        let named = |name: &'static str| std::thread::Builder::new().name(format!("dpm-{name}"));
        let refused = |stage| move |source| PipelineError::Thread { stage, source };
        // Each guard closes what the next stage reads, whether the stage returns or panics: nobody waits for ever.
        let tracking = named("tracking")
            .spawn_scoped(scope, move || tracking_thread(shared, tracking, publisher))
            .map_err(refused("tracking"))?;
        let plan = named("plan")
            .spawn_scoped(scope, move || {
                let _close = OnExit(|| {
                    shared.to_pack.close();
                    shared.tracking_over.store(true, Ordering::Release);
                });
                plan_thread(shared, renderer, reader, time);
            })
            .map_err(refused("plan"))?;
        let pack = named("pack")
            .spawn_scoped(scope, move || {
                let _close = OnExit(|| {
                    shared.monitor.request_stop();
                    shared.to_link.close();
                });
                pack_thread(shared, kernel, prepared);
            })
            .map_err(refused("pack"))?;
        let link = named("link")
            .spawn_scoped(scope, move || {
                let _close = OnExit(|| {
                    shared.monitor.request_stop();
                    shared.done.close();
                    shared.lights.close();
                });
                let outside = matches!(cable, Cable::Outside(_));
                let keeper = LinkKeeper::new(shared.time, times, &link, outside);
                link_thread(shared, link, cable, keeper)
            })
            .map_err(refused("link"))?;
        collector.run(&shared.done, &shared.free, &shared.lights, shared.monitor);
        let cable = link.join();
        for (name, thread) in [("pack", pack), ("plan", plan), ("tracking", tracking)] {
            if thread.join().is_err() {
                shared.fail(PipelineError::Panicked(name));
            }
        }
        cable.map_err(|_| PipelineError::Panicked("link"))
    })
}

/// Calls its function when dropped, during a panic too.
struct OnExit<F: FnMut()>(F);

impl<F: FnMut()> Drop for OnExit<F> {
    fn drop(&mut self) {
        (self.0)();
    }
}

fn tracking_thread(shared: &Shared<'_>, mut stage: TrackingStage, mut latest: Publisher<TrackSnapshot>) {
    shared.rights.enter(0);
    let _ = shared.tracking.set(std::thread::current());
    let mut heard_to = i64::MIN;
    let mut steps = 0u32;
    while !shared.tracking_over.load(Ordering::Acquire) {
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
        // A tracker that fails is told by the freshness of its tracks: light goes off by itself.
        let _ = stage.step(now, &mut latest);
        if !shared.is_virtual() {
            std::thread::sleep(Duration::from_micros(200));
        }
    }
    enter_frame_path(false);
}

fn plan_thread(
    shared: &Shared<'_>,
    mut renderer: Option<&mut Renderer>,
    mut latest: Reader<TrackSnapshot>,
    mut time: Reader<LinkTime>,
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
    while !shared.monitor.stop_requested() && (frames == 0 || id < frames) && next_slot < end {
        enter_frame_path(id >= WARM_UP_FRAMES);
        let at_hand = shared.free.try_pop();
        let waited = at_hand.is_none();
        let Some(mut job) = at_hand.or_else(|| shared.free.pop(Duration::from_millis(100))) else { continue };
        job.waited_for_memory = waited;
        let lead =
            modelled.max(shared.lead_ns.load(Ordering::Relaxed)) + shared.travel_ns.load(Ordering::Relaxed);
        let time = *time.latest().0;
        if !shared.is_virtual() {
            next_slot = next_slot.max(time.slot_after(shared.clock.now().plus_ns(lead)));
        }
        let latch_at = time.host_of_slot(next_slot).plus_ns(-lead);
        shared.clock.wait_until(latch_at);
        if shared.is_virtual() {
            shared.listen_to.store(latch_at.0, Ordering::Release);
            if let Some(tracking) = shared.tracking.get() {
                tracking.unpark();
            }
            while latest.latest().0.through < latch_at && !shared.monitor.stop_requested() {
                std::thread::yield_now();
            }
        }
        stages::plan(&mut job, &shared.rig, latest.latest().0, &time, id, next_slot);
        let t = &mut job.timeline;
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
            job.timeline.submitted_at = shared.clock.now();
        }
        shared.monitor.count_planned();
        id += 1;
        next_slot += 1;
        // There is room for every job there is.
        if shared.to_pack.push(job).is_err() {
            break;
        }
    }
    enter_frame_path(false);
}

fn pack_thread(shared: &Shared<'_>, kernel: Kernel, mut prepared: Option<PreparedFrames>) {
    shared.rights.enter(2);
    while let Some(mut job) = next(&shared.to_pack) {
        enter_frame_path(job.id.0 >= WARM_UP_FRAMES);
        if let Err(source) =
            stages::finish_and_pack(&mut job, kernel, shared.verify, GPU_TIMEOUT_NS, &mut prepared)
        {
            shared.fail(PipelineError::Gpu { frame: job.id.0, source });
            break;
        }
        if !shared.is_virtual() {
            let now = shared.clock.now();
            job.timeline.rendered_at = now.plus_ns(-(job.timeline.wall_ns[Stage::Pack as usize] as i64));
            job.timeline.packed_at = now;
        }
        if shared.to_link.push(job).is_err() {
            break;
        }
    }
    enter_frame_path(false);
}

/// The next job, or `None` when the ring is closed and empty.
fn next(ring: &Ring<Box<FrameJob>>) -> Option<Box<FrameJob>> {
    loop {
        if let Some(job) = ring.pop(Duration::from_millis(5)) {
            return Some(job);
        }
        if ring.is_closed() && ring.is_empty() {
            return None;
        }
    }
}

fn link_thread(
    shared: &Shared<'_>,
    mut link: HostLink,
    mut cable: Cable,
    mut keeper: LinkKeeper,
) -> (Cable, ProjectorReport) {
    shared.rights.enter(3);
    let mut last = shared.clock.now();
    loop {
        let job = shared.to_link.pop(Duration::from_millis(1));
        let Some(mut job) = job else {
            if shared.to_link.is_closed() && shared.to_link.is_empty() {
                break;
            }
            if !shared.is_virtual() {
                // Feeds the device's watchdog while nothing is to be sent.
                poll(shared, &mut link, &mut cable, &mut keeper, shared.clock.now());
            }
            continue;
        };
        // Getting a lost medium back allocates; the rig is dark then.
        enter_frame_path(job.id.0 >= WARM_UP_FRAMES && link.state() == LinkState::Streaming);
        let now = if shared.is_virtual() { job.timeline.sent_at } else { shared.clock.now() };
        cable.live(now);
        let ready_at = now;
        let watch = Stopwatch::start();
        poll(shared, &mut link, &mut cable, &mut keeper, now);
        let now = if shared.is_virtual() {
            now
        } else {
            await_credit(shared, &mut link, &mut cable, &mut keeper, &job)
        };
        let waited_ns = now.ns_since(ready_at);
        let outcome = link.send_frame(now, job.id.0, job.target_at, job.planes.bytes(), cable.transport());
        job.outcome = Some(outcome);
        if outcome == SendOutcome::Sent {
            keeper.sent(&job);
        }
        job.timeline.wall_ns[Stage::Link as usize] = watch.elapsed_ns();
        last = now;
        if !shared.is_virtual() {
            job.timeline.sent_at = shared.clock.now();
            if outcome == SendOutcome::Sent {
                // Waiting for room in a device that is ahead does not ask for an earlier start: that would only fill it more.
                let taken = job.timeline.sent_at.ns_since(job.timeline.latched_at);
                follow_lead(&shared.lead_ns, taken - waited_ns);
            }
        }
        if shared.done.push(job).is_err() {
            break;
        }
    }
    enter_frame_path(false);
    // The last frames' light, then dark.
    let mut now = if shared.is_virtual() {
        last.plus_ns(2 * shared.rig.rate().slot_len_ns(0))
    } else {
        let end = shared.clock.now().plus_ns(10_000_000 + keeper.travel_ns());
        while shared.clock.now() < end {
            poll(shared, &mut link, &mut cable, &mut keeper, shared.clock.now());
            shared.clock.wait_until(shared.clock.now().plus_ns(1_000_000));
        }
        end
    };
    cable.live(now);
    keeper.stop(now, &mut link, cable.transport());
    // A line may still be busy with a frame: STOP is repeated until the projector says that it is dark.
    let steps = if matches!(cable, Cable::Outside(_)) { DARK_WITHIN_MS } else { 4 };
    for i in 1..=steps {
        now = if shared.is_virtual() {
            now.plus_ns(1_000_000)
        } else {
            shared.clock.wait_until(shared.clock.now().plus_ns(1_000_000))
        };
        poll(shared, &mut link, &mut cable, &mut keeper, now);
        cable.live(now);
        if i >= 4 && is_dark(&link) {
            break;
        }
    }
    let report = keeper.report(&link, cable.transport().name());
    (cable, report)
}

/// Moves the link along and does what is due beside frames.
fn poll(shared: &Shared<'_>, link: &mut HostLink, cable: &mut Cable, keeper: &mut LinkKeeper, now: HostTime) {
    let steady = shared.is_virtual();
    let result = keeper.poll(now, link, cable.transport(), steady, &shared.lights, shared.monitor);
    shared.travel_ns.store(keeper.travel_ns(), Ordering::Relaxed);
    if let Err(e) = result {
        shared.fail(e.into());
    }
}

/// Waits until the device has room for the frame, at most until the frame's slot begins; returns the time.
fn await_credit(
    shared: &Shared<'_>,
    link: &mut HostLink,
    cable: &mut Cable,
    keeper: &mut LinkKeeper,
    job: &FrameJob,
) -> HostTime {
    let mut now = shared.clock.now();
    while link.state() == LinkState::Streaming && link.credit() == 0 && now < job.timeline.due_at {
        now = shared.clock.wait_until(now.plus_ns(CREDIT_STEP_NS));
        poll(shared, link, cable, keeper, now);
    }
    now
}

/// A running estimate of the time from latch to sent: follows rises at once, falls slowly.
fn follow_lead(lead: &AtomicI64, measured: i64) {
    let wanted = measured + measured / 8 + MARGIN_NS;
    let old = lead.load(Ordering::Relaxed);
    let new = if wanted > old { wanted } else { old - (old - wanted) / 32 };
    lead.store(new, Ordering::Relaxed);
}

/// The mock projector at real pace: serves the cable until told to stop, then a little longer so that the last words arrive.
pub(super) fn device_thread(
    mut end: DeviceEnd,
    mut mock: MockProjector,
    mut recorder: LightRecorder,
    clock: &RunClock,
    over: &AtomicBool,
) -> LightRecorder {
    while !over.load(Ordering::Acquire) {
        let now = clock.now();
        recorder.advance(&mut mock, now);
        if !end.serve(now, &mut mock) {
            std::thread::sleep(Duration::from_micros(50));
        }
    }
    recorder.advance(&mut mock, clock.now());
    recorder
}
