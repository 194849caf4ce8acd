//! Threads, paces and shutdown.

use super::collect::Collector;
use super::connect::connect;
use super::handoff::Ring;
use super::job::FrameJob;
use super::light::{LightNote, LightRecorder};
use super::outcome::{PipelineError, RunOptions, RunOutcome};
use super::rights::Rights;
use super::stages::{self, LinkTime, TrackSnapshot, TrackingStage};
use crate::clock::{Clock, ManualClock, MonotonicClock, RunClock, Stopwatch};
use crate::config::{Pace, ProjectorBackend};
use crate::frame::Stage;
use crate::gpu::Gpu;
use crate::pack::{BitPlaneFrame, Kernel};
use crate::realtime::standstill::StandstillMonitor;
use crate::render::method::Method;
use crate::render::{FrameCost, RenderError, Renderer, RendererSettings};
use crate::rig::{Rig, RigError};
use crate::telemetry::monitor::RunMonitor;
use crate::telemetry::report::Report;
use dpm_device::link::{packet_bytes, Codec, Epoch, HostLink, LinkSettings, SendOutcome, Underrun, Verb};
use dpm_device::time::{DeviceTicks, HostClock, HostTime};
use dpm_device::transport::inproc::{threaded, DeviceEnd, Direct, HostEnd};
use dpm_device::transport::Transport;
use dpm_handoff::latest::{latest, Publisher, Reader};
use glam::DVec3;
use hil_mock::projector::{DeviceClock, MockConfig, MockProjector};
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::{Arc, Mutex};
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
/// Time for which trackers are listened to before the first frame, so that the filters know the motion.
const LISTEN_NS: i64 = 150_000_000;
/// From the handshake to slot 0.
const EPOCH_NS: u64 = 5_000_000;
/// Time between the last byte of a frame and its slot, for jitter of the hand-offs.
const MARGIN_NS: i64 = 50_000;
/// A step of the control thread that ends this late is a standstill of the machine.
const STANDSTILL_NS: i64 = 1_000_000;
/// A frame that the GPU has not finished by then is given up, and the run with it.
const GPU_TIMEOUT_NS: u64 = 20_000_000_000;

/// Everything that the threads share.
struct Shared<'a> {
    rig: Arc<Rig>,
    clock: &'a RunClock,
    time: LinkTime,
    /// Virtual pace: samples up to here are wanted.
    listen_to: AtomicI64,
    /// Measured time from latch to sent, nanoseconds (real pace).
    lead_ns: AtomicI64,
    free: Ring<Box<FrameJob>>,
    to_pack: Ring<Box<FrameJob>>,
    to_link: Ring<Box<FrameJob>>,
    done: Ring<Box<FrameJob>>,
    lights: Arc<Ring<LightNote>>,
    tracking_over: AtomicBool,
    error: Mutex<Option<PipelineError>>,
    monitor: &'a RunMonitor,
    options: RunOptions,
    verify: bool,
    rights: &'a Rights,
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
enum Cable {
    Direct(Box<Direct<MockProjector>>, LightRecorder),
    Threaded(HostEnd),
}

impl Cable {
    fn transport(&mut self) -> &mut dyn Transport {
        match self {
            Self::Direct(direct, _) => direct.as_mut(),
            Self::Threaded(end) => end,
        }
    }

    /// Lets the projector live up to `now` where it has no thread of its own.
    fn live(&mut self, now: HostTime) {
        if let Self::Direct(direct, recorder) = self {
            recorder.advance(direct.device_mut(), now);
        }
    }
}

/// Runs the rig until `options.frames` are planned or `monitor` asks to stop. The projector ends dark.
///
/// # Errors
/// See [`PipelineError`]; whatever happens, the projector was told to go dark or its watchdog does it.
pub fn run(
    rig: Arc<Rig>,
    gpu: &Arc<Gpu>,
    options: RunOptions,
    monitor: &RunMonitor,
) -> Result<RunOutcome, PipelineError> {
    let config = &rig.config;
    let mut renderer = Renderer::new(gpu, &rig.scene, renderer_settings(&rig))?;
    let is_virtual = config.real_time.pace == Pace::Virtual;
    let clock = if is_virtual {
        // The link comes up just before the first frame, so that nobody waits for the filters.
        RunClock::Virtual(ManualClock::new(HostTime(LISTEN_NS)))
    } else {
        RunClock::Real(MonotonicClock::new(50_000))
    };
    let tracker_clock: Arc<dyn HostClock> = match &clock {
        RunClock::Real(clock) => Arc::new({
            let clock = *clock;
            move || clock.now()
        }),
        // The configuration allows only trackers without a clock of their own at virtual pace.
        RunClock::Virtual(_) => Arc::new(|| HostTime(0)),
    };
    let tracker = rig.tracker(tracker_clock, HostTime(0))?;
    let raster = rig.camera.raster;
    let schedule = config.projector.schedule();
    // Hashing every frame costs a millisecond at full size: affordable unless the wall clock rules.
    let verify = options.verify && is_virtual;

    let free = Ring::new(options.in_flight.max(2));
    for _ in 0..options.in_flight.max(2) {
        let job = FrameJob {
            id: Default::default(),
            slot: 0,
            target_at: DeviceTicks(0),
            timeline: Default::default(),
            tracked_poses: Vec::with_capacity(rig.bodies.len()),
            sampled_poses: Vec::with_capacity(rig.bodies.len()),
            lost: Vec::with_capacity(rig.bodies.len()),
            scene_poses: Vec::with_capacity(rig.scene.bodies.len()),
            eye: DVec3::ZERO,
            gaze: DVec3::ZERO,
            gpu: Some(renderer.create_slot(false).map_err(RenderError::from)?),
            cost: FrameCost::default(),
            code_hash: 0,
            planes: BitPlaneFrame::new(raster, schedule),
            outcome: None,
        };
        let _ = free.push(Box::new(job));
    }

    let ProjectorBackend::Mock(mock_config) = &config.projector.backend else {
        return Err(RigError::Unsupported(format!(
            "projector.backend: {:?} is not driven by `dpm run` yet",
            config.projector.backend
        ))
        .into());
    };
    let mut setup = MockConfig::new(raster);
    setup.frame_buffers = mock_config.buffer_frames.min(64) as u8;
    setup.clock = DeviceClock { skew_ppb: (mock_config.clock_ppm * 1000.0) as i32, ..DeviceClock::IDEAL };
    let flash_limit = match config.safety.flashes_per_second {
        0 => None,
        n => Some(n.min(255) as u8),
    };
    setup.flash_limit = flash_limit;
    let mock = MockProjector::new(setup);
    let lights = Arc::new(Ring::new(8192));
    let recorder = LightRecorder::new(lights.clone(), options.keep_frames, verify);
    let mut link = HostLink::new(LinkSettings {
        raster,
        schedule,
        rate: rig.rate(),
        watchdog_us: config.safety.watchdog_ms * 1000,
        underrun: Underrun::Repeat,
        late_slots: if is_virtual { 0 } else { 255 },
        epoch: Epoch::AfterHello(EPOCH_NS),
        session_seed: config.render.seed as u32 | 1,
        codecs: Codec::Raw.mask(),
        flash_limit,
    });

    let rights = Rights::new(&config.real_time);
    let standstill = match &clock {
        // Without the control thread late frames are all counted as the rig's.
        RunClock::Real(c) => {
            StandstillMonitor::start(Arc::new(c.sleeping()), STANDSTILL_NS, config.real_time.priority).ok()
        }
        RunClock::Virtual(_) => None,
    };
    let device_over = AtomicBool::new(false);
    let kernel = Kernel::best();
    let watch = Stopwatch::start();
    let (mut collector, recorder) = std::thread::scope(|scope| -> Result<_, PipelineError> {
        let (mut cable, device) = if is_virtual {
            (Cable::Direct(Box::new(Direct::new(mock)), recorder), None)
        } else {
            let frame_bytes = packet_bytes(raster.plane_bytes()) * schedule.len() + 256;
            let (host_end, device_end) = threaded(frame_bytes, setup.frame_buffers as usize + 1);
            let (clock, over) = (&clock, &device_over);
            let thread = std::thread::Builder::new()
                .name("dpm-mock".into())
                .spawn_scoped(scope, move || device_thread(device_end, mock, recorder, clock, over))
                .map_err(|source| PipelineError::Thread { stage: "mock projector", source })?;
            (Cable::Threaded(host_end), Some(thread))
        };
        let connected = connect(&mut link, cable.transport(), &mut || {
            clock.wait_until(clock.now().plus_ns(if is_virtual { 50_000 } else { 200_000 }))
        });
        let time = match connected {
            Ok(time) => time,
            Err(e) => {
                device_over.store(true, Ordering::Release);
                return Err(e.into());
            }
        };
        let shared = Shared {
            rig: rig.clone(),
            clock: &clock,
            time,
            listen_to: AtomicI64::new(0),
            lead_ns: AtomicI64::new(0),
            free,
            to_pack: Ring::new(options.in_flight + 2),
            to_link: Ring::new(options.in_flight + 2),
            done: Ring::new(options.in_flight + 2),
            lights: lights.clone(),
            tracking_over: AtomicBool::new(false),
            error: Mutex::new(None),
            monitor,
            options,
            verify,
            rights: &rights,
        };
        let tracking = TrackingStage::new(&rig, tracker);
        let mut collector = Collector::new(rig.clone(), options.keep_frames, verify);
        let cable = run_threads(&shared, tracking, &mut renderer, kernel, link, cable, &mut collector)?;
        device_over.store(true, Ordering::Release);
        let recorder = match (cable, device) {
            (Cable::Direct(_, recorder), _) => recorder,
            (Cable::Threaded(_), Some(thread)) => {
                thread.join().map_err(|_| PipelineError::Panicked("mock projector"))?
            }
            (Cable::Threaded(_), None) => unreachable!("a threaded cable has a device thread"),
        };
        match shared.error.into_inner().ok().flatten() {
            Some(e) => Err(e),
            None => Ok((collector, recorder)),
        }
    })?;
    let wall_s = watch.elapsed_ns() as f64 * 1e-9;
    let standstills = standstill.map(StandstillMonitor::finish).unwrap_or_default();

    let mut report = Report {
        raster: [raster.width(), raster.height()],
        planes: schedule.len() as u32,
        frame_rate_hz: rig.rate().hz(),
        pace: if is_virtual { "virtual" } else { "real" },
        gpu: gpu.summary().name.clone(),
        software_gpu: gpu.summary().software,
        method: method_name(&rig),
        prediction: config.prediction.on,
        light_hash: format!("{:016x}", recorder.light_hash),
        wall_s,
        ..Report::default()
    };
    collector.fill(&mut report);
    report.frames_per_wall_second = report.frames_lit as f64 / wall_s.max(1e-9);
    report.warnings.extend(rights.warnings());
    report.warnings.extend(rig.scene.warnings.iter().cloned());
    Ok(RunOutcome {
        report,
        recent: std::mem::take(&mut collector.recent).into(),
        light: recorder.into_frames(),
        light_mismatches: collector.light_mismatches,
        traced: std::mem::take(&mut collector.traced),
        profiler: collector.profiler,
        standstills,
    })
}

fn method_name(rig: &Rig) -> &'static str {
    use crate::config::RenderMethod as M;
    match rig.config.render.method {
        M::Dpm => "dpm",
        M::Paper => "paper",
        M::Miyamoto => "miyamoto",
        M::Full => "full",
    }
}

/// The renderer's settings from the rig file.
pub fn renderer_settings(rig: &Rig) -> RendererSettings {
    let r = &rig.config.render;
    RendererSettings {
        raster: rig.camera.raster,
        depth: r.depth,
        seed: r.seed as u32,
        clamp_indirect: (r.clamp_indirect > 0.0).then_some(r.clamp_indirect as f32),
        drive_gain: rig.drive_gain(),
        ambient: rig.config.scene.ambient.map(|v| v as f32),
        camera_is_eye: false,
        leave_nothing_out: false,
        method: Method::from_config(r),
    }
}

/// Starts the stages, waits for all of them, and returns the cable.
fn run_threads(
    shared: &Shared<'_>,
    tracking: TrackingStage,
    renderer: &mut Renderer,
    kernel: Kernel,
    link: HostLink,
    cable: Cable,
    collector: &mut Collector,
) -> Result<Cable, PipelineError> {
    std::thread::scope(|scope| {
        let (publisher, reader) = latest(TrackSnapshot::EMPTY);
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
                plan_thread(shared, renderer, reader);
            })
            .map_err(refused("plan"))?;
        let pack = named("pack")
            .spawn_scoped(scope, move || {
                let _close = OnExit(|| {
                    shared.monitor.request_stop();
                    shared.to_link.close();
                });
                pack_thread(shared, kernel);
            })
            .map_err(refused("pack"))?;
        let link = named("link")
            .spawn_scoped(scope, move || {
                let _close = OnExit(|| {
                    shared.monitor.request_stop();
                    shared.done.close();
                    shared.lights.close();
                });
                link_thread(shared, link, cable)
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
    let mut heard_to = i64::MIN;
    while !shared.tracking_over.load(Ordering::Acquire) {
        let now = if shared.is_virtual() {
            let wanted = shared.listen_to.load(Ordering::Acquire);
            if wanted == heard_to {
                std::thread::yield_now();
                continue;
            }
            heard_to = wanted;
            HostTime(wanted)
        } else {
            shared.clock.now()
        };
        // A tracker that fails is told by the freshness of its tracks: light goes off by itself.
        let _ = stage.step(now, &mut latest);
        if !shared.is_virtual() {
            std::thread::sleep(Duration::from_micros(200));
        }
    }
}

fn plan_thread(shared: &Shared<'_>, renderer: &mut Renderer, mut latest: Reader<TrackSnapshot>) {
    shared.rights.enter(1);
    let costs = shared.costs();
    let modelled = costs.iter().sum::<i64>() + MARGIN_NS;
    let begin = shared.clock.now();
    let mut next_slot =
        shared.time.slot_after(begin.plus_ns(modelled + if shared.is_virtual() { 0 } else { LISTEN_NS }));
    let mut id = 0u64;
    while !shared.monitor.stop_requested() && (shared.options.frames == 0 || id < shared.options.frames) {
        enter_frame_path(id >= WARM_UP_FRAMES);
        let Some(mut job) = shared.free.pop(Duration::from_millis(100)) else { continue };
        let lead = modelled.max(shared.lead_ns.load(Ordering::Relaxed));
        if !shared.is_virtual() {
            next_slot = next_slot.max(shared.time.slot_after(shared.clock.now().plus_ns(lead)));
        }
        let latch_at = shared.time.host_of_slot(next_slot).plus_ns(-lead);
        shared.clock.wait_until(latch_at);
        if shared.is_virtual() {
            shared.listen_to.store(latch_at.0, Ordering::Release);
            while latest.latest().0.through < latch_at && !shared.monitor.stop_requested() {
                std::thread::yield_now();
            }
        }
        stages::plan(&mut job, &shared.rig, latest.latest().0, &shared.time, id, next_slot);
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
        if let Err(source) = stages::submit(&mut job, &shared.rig, renderer) {
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

fn pack_thread(shared: &Shared<'_>, kernel: Kernel) {
    shared.rights.enter(2);
    while let Some(mut job) = next(&shared.to_pack) {
        enter_frame_path(job.id.0 >= WARM_UP_FRAMES);
        if let Err(source) = stages::finish_and_pack(&mut job, kernel, shared.verify, GPU_TIMEOUT_NS) {
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

fn link_thread(shared: &Shared<'_>, mut link: HostLink, mut cable: Cable) -> Cable {
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
                let _ = link.poll(shared.clock.now(), cable.transport());
            }
            continue;
        };
        enter_frame_path(job.id.0 >= WARM_UP_FRAMES);
        let now = if shared.is_virtual() { job.timeline.sent_at } else { shared.clock.now() };
        cable.live(now);
        let watch = Stopwatch::start();
        let _ = link.poll(now, cable.transport());
        let outcome = link.send_frame(now, job.id.0, job.target_at, job.planes.bytes(), cable.transport());
        job.outcome = Some(outcome);
        job.timeline.wall_ns[Stage::Link as usize] = watch.elapsed_ns();
        last = now;
        if !shared.is_virtual() {
            job.timeline.sent_at = shared.clock.now();
            if outcome == SendOutcome::Sent {
                follow_lead(&shared.lead_ns, job.timeline.sent_at.ns_since(job.timeline.latched_at));
            }
        }
        if shared.done.push(job).is_err() {
            break;
        }
    }
    enter_frame_path(false);
    // The last frames' light, then dark.
    let end = if shared.is_virtual() {
        last.plus_ns(2 * shared.rig.rate().slot_len_ns(0))
    } else {
        shared.clock.wait_until(shared.clock.now().plus_ns(10_000_000))
    };
    cable.live(end);
    let _ = link.command(end, Verb::Stop, cable.transport());
    for i in 1..=4 {
        let now = if shared.is_virtual() {
            end.plus_ns(i * 1_000_000)
        } else {
            shared.clock.wait_until(shared.clock.now().plus_ns(1_000_000))
        };
        let _ = link.poll(now, cable.transport());
        cable.live(now);
    }
    cable
}

/// A running estimate of the time from latch to sent: follows rises at once, falls slowly.
fn follow_lead(lead: &AtomicI64, measured: i64) {
    let wanted = measured + measured / 8 + MARGIN_NS;
    let old = lead.load(Ordering::Relaxed);
    let new = if wanted > old { wanted } else { old - (old - wanted) / 32 };
    lead.store(new, Ordering::Relaxed);
}

/// The mock projector at real pace: serves the cable until told to stop, then a little longer so that the last words arrive.
fn device_thread(
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
