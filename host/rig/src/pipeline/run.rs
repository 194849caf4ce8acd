//! Threads, paces and shutdown.

use super::connect::{connect, ENDED_WITH_THE_LAST_RUN};
use super::crew::{Crew, CrewParts, NotesBack, OnExit};
use super::link::{device_thread, link_thread, Cable, Line};
use super::outcome::{PipelineError, RunOptions, RunOutcome};
use super::projector;
use super::pulse::Pulse;
use super::rights::Rights;
use super::supervisor::{join_within, Maker, Remake, Supervisor};
use super::threads::{policy, Shared, FIRST_FRAME_TIMEOUT_NS, LISTEN_NS, NOTES, RECEIPT_NS, STAGE_THREADS};
use crate::config::{Pace, Packer, ProjectorBackend, RenderMethod};
use crate::frame::job::FrameMemory;
use crate::light::collector::Collector;
use crate::light::recorder::{LightNote, LightRecorder};
use crate::mock::{DeviceClock, EmulatedProjector, MockConfig};
use crate::pack::prepared::PreparedFrames;
use crate::plan::budget::{BudgetConfig, BudgetController};
use crate::plan::horizon::Horizon;
use crate::plan::lead::LeadEstimator;
use crate::plan::link_time::LinkTime;
use crate::realtime::os::usable_cores;
use crate::realtime::standstill::StandstillMonitor;
use crate::rig::{Rig, RigError};
use crate::telemetry::monitor::RunMonitor;
use crate::telemetry::report::Report;
use crate::tracks::{open_for, TrackingStage};
use dpm_common::clock::{Clock, ManualClock, MonotonicClock, RunClock, Stopwatch};
use dpm_device::link::HostLink;
use dpm_device::time::{HostClock, HostTime};
use dpm_device::transport::inproc::{threaded, Direct};
use dpm_device::transport::Transport;
use dpm_handoff::channel::{channel, Sender};
use dpm_handoff::wake::WaitPolicy;
use dpm_render::gpu::{Gpu, LossBudget};
use dpm_render::pack::{BitPlaneFrame, Kernel};
use dpm_render::{Output, RenderError, Renderer, RendererSettings};
use glam::DVec3;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Light events between the projector and the collector: eight seconds at 947 Hz.
const LIGHTS: usize = 8192;
/// Buffers of the cable to a projector in this process: one is filled while another is read, and one for a projector that is late.
const CABLE_BUFFERS: usize = 3;
/// A step of a control thread that ends this late is a standstill of the machine.
const STANDSTILL_NS: i64 = 1_000_000;
/// What the collector may take for one look, and for one note. It is the only thread here that runs behind all others, it allocates, and no light depends on
/// it: without it frames run out of notes and the light ends by itself.
const LOOK_NS: i64 = 5_000_000_000;
/// Longest reserve in the lead, nanoseconds.
const RESERVE_NS: i64 = 528_000;
/// Spare time in the first guess of the lead, of what a frame took while nobody was waiting: a quarter.
const GUESS_SPARE: i64 = 4;
/// How long threads are waited for that have nothing left to do.
const END_WITHIN: Duration = Duration::from_secs(1);

/// Runs the rig until `options.frames` are planned or `monitor` asks to stop. The projector ends dark.
///
/// # Errors
/// See [`PipelineError`]; whatever happens, the projector was told to go dark or its watchdog does it.
pub fn run(
    rig: Arc<Rig>,
    gpu: &Arc<Gpu>,
    options: RunOptions,
    monitor: &Arc<RunMonitor>,
) -> Result<RunOutcome, PipelineError> {
    run_from(rig, Some(gpu), options, monitor)
}

/// Like [`run`] with prepared frames in place of rendered ones: no GPU takes part. Every frame that is lit is looked at for parts
/// of another frame.
///
/// # Errors
/// As [`run`], without those of the GPU.
pub fn run_prepared(
    rig: Arc<Rig>,
    options: RunOptions,
    monitor: &Arc<RunMonitor>,
) -> Result<RunOutcome, PipelineError> {
    run_from(rig, None, RunOptions { verify: false, ..options }, monitor)
}

fn run_from(
    rig: Arc<Rig>,
    gpu: Option<&Arc<Gpu>>,
    options: RunOptions,
    monitor: &Arc<RunMonitor>,
) -> Result<RunOutcome, PipelineError> {
    let is_virtual = rig.config.real_time.pace == Pace::Virtual;
    // Hashing every frame costs a millisecond at full size: affordable unless the wall clock rules.
    let options = RunOptions { verify: options.verify && is_virtual, ..options };
    let clock = Arc::new(run_clock(is_virtual));
    let parts = crew_parts(&rig, gpu, options, &clock)?;
    let frame_ns = parts.frame_ns;
    let (lights_in, lights) = channel(LIGHTS, WaitPolicy::Park);
    let (far, warnings) = far_end(&rig, lights_in, options, gpu.is_none(), clock.now())?;
    let mut link = HostLink::new(projector::link_settings(&rig.config, rig.camera.raster));
    let rights = Arc::new(Rights::new(&rig.config.real_time));
    let standstill = match &*clock {
        // Without control threads late frames are all counted as the rig's.
        RunClock::Real(c) => {
            StandstillMonitor::start(Arc::new(c.sleeping()), STANDSTILL_NS, rights.highest_priority()).ok()
        }
        RunClock::Virtual(_) => None,
    };
    let watch = Stopwatch::start();
    let (mut cable, device, seen) = lay_cable(&rig, far, &clock, &rights)?;
    let acknowledged = if rig.config.safety.acknowledge_faults { u32::MAX } else { ENDED_WITH_THE_LAST_RUN };
    let time = connect(
        &mut link,
        cable.transport(),
        acknowledged,
        monitor,
        &mut || clock.wait_until(clock.now().plus_ns(if is_virtual { 50_000 } else { 200_000 })),
        &|| monitor.stop_requested(),
    )?;
    let lead = lead_estimator(&rig, &link, frame_ns);
    let shared = Arc::new(shared(&rig, &clock, &rights, options, monitor, time, &lead));
    tell_horizon(&shared);
    let keeper = super::keeper::LinkKeeper::new(time, &link, seen);
    let line = Line { keeper, link, cable, lead, credit_until: HostTime(i64::MIN / 2) };
    let mut collector = Collector::new(rig.clone(), options.keep_frames, options.verify)
        .about(gpu.is_none(), standstill.as_ref().map(StandstillMonitor::seen));

    // A panic up to the end of this function ends the light.
    let stop_on_panic = OnExit(|| {
        if std::thread::panicking() {
            monitor.request_stop();
        }
    });
    let notes_back = NotesBack::default();
    let (crew, port) = Crew::start(&shared, parts, &notes_back)?;
    let (mut ports_in, ports) = channel(4, WaitPolicy::Park);
    let _ = ports_in.push(port);
    let (done_in, done) = channel(NOTES, WaitPolicy::Park);
    let link_thread = {
        let shared = shared.clone();
        named("link").spawn(move || link_thread(&shared, line, ports, done_in)).map_err(no_thread("link"))?
    };
    let maker: Option<Maker> = (!is_virtual).then(|| maker(&rig, gpu.cloned(), options, &clock));
    let supervisor = Supervisor {
        shared: shared.clone(),
        ports: ports_in,
        notes_back: notes_back.clone(),
        maker,
        losses: LossBudget::default(),
    };
    let supervisor = {
        let rights = rights.clone();
        let thread = named("supervisor").spawn(move || {
            rights.enter_supervisor();
            supervisor.run(crew)
        });
        thread.map_err(|source| {
            // Nobody would watch: the link ends, and with it the light.
            monitor.request_stop();
            PipelineError::Thread { stage: "supervisor", source }
        })?
    };
    shared.collector_pulse.begin();
    collector.run(done, &|note| notes_back.push(note), lights, monitor, || {
        if !is_virtual {
            shared.collector_pulse.beat(shared.clock.now(), LOOK_NS);
        }
        !shared.is_broken.load(Ordering::Acquire)
    });
    shared.collector_pulse.end();
    // At virtual pace nobody is late: what is left to be said does not depend on how busy the machine is.
    let end_within = if is_virtual { Duration::MAX } else { END_WITHIN };
    let unseen = join_within(supervisor, end_within.saturating_mul(2)).and_then(Result::ok).flatten();
    let line = join_within(link_thread, end_within).and_then(Result::ok);
    drop(stop_on_panic);
    if let Some(error) = shared.error.lock().ok().and_then(|mut e| e.take()) {
        return Err(error);
    }
    let Some((recorder, carried)) = line else { return Err(PipelineError::Hung { stage: "link" }) };
    let recorder = match device {
        Some(thread) => match join_within(thread, END_WITHIN) {
            Some(ended) => Some(ended.map_err(|_| PipelineError::Panicked("mock projector"))?),
            None => return Err(PipelineError::Hung { stage: "mock projector" }),
        },
        None => recorder,
    };
    let wall_s = watch.elapsed_ns() as f64 * 1e-9;
    let standstills = standstill.map(StandstillMonitor::finish).unwrap_or_default();
    let slots = collector.finish(monitor);

    let config = &rig.config;
    let mut report = Report {
        raster: [rig.camera.raster.width(), rig.camera.raster.height()],
        planes: config.projector.schedule().len() as u32,
        frame_rate_hz: rig.rate().hz(),
        pace: if is_virtual { "virtual" } else { "real" },
        gpu: gpu.map_or_else(|| "none".into(), |gpu| gpu.summary().name.clone()),
        software_gpu: gpu.is_some_and(|gpu| gpu.summary().software),
        method: if gpu.is_some() { config.render.method.word() } else { "prepared" },
        prediction: config.prediction.on,
        light_hash: recorder.as_ref().and_then(LightRecorder::hash).unwrap_or_default(),
        projector: Some(carried),
        slots_per_frame: shared.stride_milli.load(Ordering::Relaxed) as f64 / 1e3,
        predict_ms: shared.predict_ns.load(Ordering::Relaxed) as f64 / 1e6,
        wall_s,
        ..Report::default()
    };
    collector.fill(&mut report);
    report.stopped = monitor.stop_requested();
    report.frames_per_wall_second = report.frames_lit as f64 / wall_s.max(1e-9);
    report.warnings.extend(unseen);
    report.warnings.extend(warnings);
    report.warnings.extend(rights.warnings());
    report.warnings.extend(rig.scene.warnings.iter().cloned());
    Ok(RunOutcome {
        report,
        recent: std::mem::take(&mut collector.recent).into(),
        light: recorder.map_or_else(Vec::new, LightRecorder::into_frames),
        light_mismatches: collector.light_mismatches,
        traced: std::mem::take(&mut collector.traced).into(),
        slots,
        slot_batches: collector.slots.batches().to_vec(),
        frames_torn: collector.torn,
        frames_reordered: collector.reordered,
        profiler: collector.profiler,
        standstills,
    })
}

fn named(name: &str) -> std::thread::Builder {
    std::thread::Builder::new().name(format!("dpm-{name}"))
}

fn no_thread(stage: &'static str) -> impl FnOnce(std::io::Error) -> PipelineError {
    move |source| PipelineError::Thread { stage, source }
}

/// What the threads of a run share, before any of them runs.
fn shared(
    rig: &Arc<Rig>,
    clock: &Arc<RunClock>,
    rights: &Arc<Rights>,
    options: RunOptions,
    monitor: &Arc<RunMonitor>,
    time: LinkTime,
    lead: &LeadEstimator,
) -> Shared {
    let predict_ns = Horizon::of_rig(&rig.config).predict_ns(lead.lead_ns() + RECEIPT_NS, 0);
    Shared {
        rig: rig.clone(),
        clock: clock.clone(),
        time,
        lead_ns: AtomicI64::new(lead.lead_ns()),
        typical_ns: AtomicI64::new(lead.typical_ns()),
        travel_ns: AtomicI64::new(0),
        alive_at_ns: AtomicI64::new(clock.now().0),
        next_frame: AtomicU64::new(0),
        end_slot: AtomicU64::new(0),
        stride_milli: AtomicU64::new(1000),
        predict_ns: AtomicI64::new(predict_ns),
        is_complete: AtomicBool::new(false),
        is_link_over: AtomicBool::new(false),
        is_broken: AtomicBool::new(false),
        link_pulse: Pulse::new("link"),
        collector_pulse: Pulse::new("collector"),
        error: Mutex::new(None),
        monitor: monitor.clone(),
        options,
        rights: rights.clone(),
    }
}

/// Says how long bodies are carried on by prediction where the rig file leaves it open.
fn tell_horizon(shared: &Shared) {
    if shared.rig.config.safety.predict_ms.is_none() && !shared.is_virtual() {
        let ms = shared.predict_ns.load(Ordering::Relaxed) as f64 / 1e6;
        shared.monitor.note(format!(
            "safety.predict_ms is left out: a body is carried on by prediction for {ms:.0} ms and the tracker's latency, which follows what \
             frames need"
        ));
    }
}

/// A way to the projector, the thread of one in this process, and where to send notes of light that nobody sees.
type Laid = (Cable, Option<std::thread::JoinHandle<LightRecorder>>, Option<Sender<LightNote>>);

fn lay_cable(
    rig: &Rig,
    far: Far,
    clock: &Arc<RunClock>,
    rights: &Arc<Rights>,
) -> Result<Laid, PipelineError> {
    Ok(match far {
        Far::Outside(mut medium, lights) => {
            if let RunClock::Real(clock) = **clock {
                // Replies are stamped when they arrive, not when they are looked for.
                medium.set_clock(Arc::new(move || clock.now()));
            }
            (Cable::Outside(medium), None, Some(lights))
        }
        Far::Mock(mock, recorder) if matches!(**clock, RunClock::Virtual(_)) => {
            (Cable::Direct(Box::new(Direct::new(mock)), recorder), None, None)
        }
        Far::Mock(mock, recorder) => {
            let frame_bytes =
                projector::frame_bytes(rig.camera.raster, rig.config.projector.schedule().len());
            let (host_end, device_end) = threaded(frame_bytes, CABLE_BUFFERS, policy(rig));
            let (clock, rights) = (clock.clone(), rights.clone());
            let thread = named("mock")
                .spawn(move || device_thread(device_end, mock, recorder, &clock, &rights))
                .map_err(no_thread("mock projector"))?;
            (Cable::Threaded(host_end), Some(thread), None)
        }
    })
}

/// What a crew works with. Where a GPU renders at real pace it draws two frames that nobody sees: what drivers put off to the first one is
/// over before a slot waits for it, and the second tells how long a frame takes.
fn crew_parts(
    rig: &Arc<Rig>,
    gpu: Option<&Arc<Gpu>>,
    options: RunOptions,
    clock: &Arc<RunClock>,
) -> Result<CrewParts, PipelineError> {
    let is_virtual = matches!(**clock, RunClock::Virtual(_));
    let mut renderer = match gpu {
        Some(gpu) => {
            let settings =
                RendererSettings { output: output(rig, gpu, options.verify), ..renderer_settings(rig) };
            Some(Renderer::new(gpu, &rig.scene, settings)?)
        }
        None => None,
    };
    let tracker = open_for(rig, tracker_clock(clock), HostTime(0))?;
    let mut memory = frame_memory(rig, renderer.as_mut(), options.in_flight.max(2))?;
    let mut frame_ns = 0;
    if let (Some(renderer), Some(first), false) = (&mut renderer, memory.first_mut(), is_virtual) {
        for _ in 0..2 {
            frame_ns = crate::render::warm_up(first, rig, renderer, FIRST_FRAME_TIMEOUT_NS)
                .map_err(RenderError::from)?;
        }
    }
    // At virtual pace pictures must not depend on how fast the machine is.
    let adapts = !is_virtual && renderer.is_some() && rig.config.render.method == RenderMethod::Dpm;
    Ok(CrewParts {
        tracking: TrackingStage::new(rig, tracker),
        renderer,
        prepared: gpu.is_none().then(|| PreparedFrames::new(rig.camera.raster)),
        kernel: Kernel::best(),
        budget: if adapts { budget_controller(rig) } else { None },
        memory,
        frame_ns,
    })
}

/// Makes crews that take over. A GPU that failed is opened anew, with the options of the one before.
fn maker(rig: &Arc<Rig>, gpu: Option<Arc<Gpu>>, options: RunOptions, clock: &Arc<RunClock>) -> Maker {
    let (rig, clock) = (rig.clone(), clock.clone());
    let gpu = Mutex::new(gpu);
    Arc::new(move |remake| {
        let mut gpu = gpu.lock().map_err(|_| PipelineError::Panicked("remake"))?;
        if let (Some(old), Remake::CrewAndGpu) = (gpu.as_mut(), remake) {
            *old = old.reopen().map_err(RenderError::from)?;
        }
        crew_parts(&rig, gpu.as_ref(), options, &clock)
    })
}

/// The clock of a run's pace.
fn run_clock(is_virtual: bool) -> RunClock {
    if is_virtual {
        // The link comes up just before the first frame, so that nobody waits for the filters.
        return RunClock::Virtual(ManualClock::new(HostTime(LISTEN_NS)));
    }
    // A spinning thread on a machine with fewer cores than stages delays the very stages it waits for.
    let spin_ns = if usable_cores() > STAGE_THREADS { 50_000 } else { 0 };
    RunClock::Real(MonotonicClock::new(spin_ns))
}

/// What trackers from outside stamp their packets with.
fn tracker_clock(clock: &Arc<RunClock>) -> Arc<dyn HostClock> {
    match &**clock {
        RunClock::Real(clock) => Arc::new({
            let clock = *clock;
            move || clock.now()
        }),
        // The configuration allows only trackers without a clock of their own at virtual pace.
        RunClock::Virtual(_) => Arc::new(|| HostTime(0)),
    }
}

/// Memory for `frames` frames in the making, with their slots on the GPU if one renders.
fn frame_memory(
    rig: &Rig,
    mut renderer: Option<&mut Renderer>,
    frames: usize,
) -> Result<Vec<FrameMemory>, PipelineError> {
    let one = |_| {
        Ok(FrameMemory {
            lost: Vec::with_capacity(rig.bodies.len()),
            scene_poses: Vec::with_capacity(rig.scene.bodies.len()),
            gaze: DVec3::ZERO,
            widen_deg: 0.0,
            gpu: match &mut renderer {
                Some(renderer) => Some(renderer.create_slot(false).map_err(RenderError::from)?),
                None => None,
            },
            planes: BitPlaneFrame::new(rig.camera.raster, rig.config.projector.schedule()),
        })
    };
    (0..frames).map(one).collect()
}

/// The other end of the cable.
enum Far {
    /// The mock, and who watches its light.
    Mock(EmulatedProjector, LightRecorder),
    /// A projector outside this process, and where notes of its light go.
    Outside(Box<dyn Transport>, Sender<LightNote>),
}

/// The projector of the rig file, dark, and what the operator should know about its medium. `lights` is where its light is told;
/// `marked` says that frames carry marks to be looked for; times of injected faults count from `start`.
fn far_end(
    rig: &Rig,
    lights: Sender<LightNote>,
    options: RunOptions,
    marked: bool,
    start: HostTime,
) -> Result<(Far, Vec<String>), PipelineError> {
    let (config, raster) = (&rig.config, rig.camera.raster);
    let backend = &config.projector.backend;
    if let ProjectorBackend::Mock(mock) = backend {
        let marks = marked.then(|| config.projector.schedule());
        let recorder = LightRecorder::new(lights, options.keep_frames, options.verify, marks);
        let mut setup = MockConfig::new(raster);
        setup.frame_buffers = mock.buffer_frames.min(64) as u8;
        setup.clock = DeviceClock { skew_ppb: (mock.clock_ppm * 1000.0) as i32, ..DeviceClock::IDEAL };
        setup.flash_limit = projector::flash_limit(config);
        let emulated = EmulatedProjector::new(setup, &mock.faults, config.render.seed, start)
            .map_err(|e| RigError::Unsupported(format!("projector.backend.faults: {e}")))?;
        return Ok((Far::Mock(emulated, recorder), Vec::new()));
    }
    let medium = projector::open(config, raster)?.ok_or_else(|| {
        RigError::Unsupported(format!(
            "projector.backend.kind = {:?} takes no frames over a link",
            backend.word()
        ))
    })?;
    Ok((Far::Outside(medium.transport, lights), medium.warnings))
}

/// The time from latch to sent that the rig file states, nanoseconds.
fn modelled_ns(rig: &Rig) -> i64 {
    i64::from(rig.config.real_time.stage_costs_us.total()) * 1000
}

/// How early frames are latched, learned from what the rig file states and from the `frame_ns` that a frame took while nobody was waiting.
fn lead_estimator(rig: &Rig, link: &HostLink, frame_ns: i64) -> LeadEstimator {
    let slot_ns = rig.rate().slot_len_ns(0);
    // Sent earlier, a frame would find no room in the device, whose word of a free buffer takes part of a slot.
    let held = link.device().map_or(1, |hello| i64::from(hello.frame_buffers));
    let longest_wait_ns = (held * slot_ns - slot_ns / 2 - RECEIPT_NS).max(0);
    // In reserve: what a core does beside frames, and lends to others, is mostly shorter than half a millisecond.
    let reserve_ns = (slot_ns / 2).min(RESERVE_NS);
    let rendered_ns = frame_ns + frame_ns / GUESS_SPARE;
    LeadEstimator::new(slot_ns, modelled_ns(rig).max(rendered_ns), reserve_ns, longest_wait_ns)
}

/// Holds the GPU's time inside the slot by spending fewer samples: thousandths of a sample a pixel, from what the rig file asks for down
/// to an eighth of it.
fn budget_controller(rig: &Rig) -> Option<BudgetController> {
    let full = u64::from(rig.config.render.spp) * 1000;
    let config = BudgetConfig {
        slot_ns: rig.rate().slot_len_ns(0),
        aim: 0.8,
        limit: 0.92,
        min_rays: (full / 8).max(1),
        max_rays: full.max(1),
        initial_rays: full,
    };
    BudgetController::new(config).ok()
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
        method: r.to_method(),
        output: Output::Codes,
    }
}

/// What the rig file wants back from `gpu`; with `check` the code values in any case.
pub fn output(rig: &Rig, gpu: &Gpu, check: bool) -> Output {
    let packs = match rig.config.render.packer {
        Packer::Auto => !gpu.summary().software,
        Packer::Gpu => true,
        Packer::Cpu => false,
    };
    let schedule = rig.config.projector.schedule();
    match (packs, check) {
        (false, _) => Output::Codes,
        (true, false) => Output::Planes(schedule),
        (true, true) => Output::Both(schedule),
    }
}
