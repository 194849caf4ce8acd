//! Threads, paces and shutdown.

use super::collect::Collector;
use super::connect::{connect, ENDED_WITH_THE_LAST_RUN};
use super::job::FrameMemory;
use super::light::{LightNote, LightRecorder};
use super::link::{device_thread, Cable};
use super::outcome::{PipelineError, RunOptions, RunOutcome};
use super::prepared::PreparedFrames;
use super::projector;
use super::rights::Rights;
use super::stages::{self, TrackingStage};
use super::threads::{
    policy, run_threads, Leavings, Shared, Stages, FIRST_FRAME_TIMEOUT_NS, LISTEN_NS, RECEIPT_NS,
    STAGE_THREADS,
};
use crate::clock::{Clock, ManualClock, MonotonicClock, RunClock, Stopwatch};
use crate::config::{Pace, Packer, ProjectorBackend, RenderMethod};
use crate::gpu::Gpu;
use crate::pack::{BitPlaneFrame, Kernel};
use crate::plan::budget::{BudgetConfig, BudgetController};
use crate::plan::lead::LeadEstimator;
use crate::plan::slots::MissCause;
use crate::realtime::os::usable_cores;
use crate::realtime::standstill::StandstillMonitor;
use crate::render::method::Method;
use crate::render::{Output, RenderError, Renderer, RendererSettings};
use crate::rig::{Rig, RigError};
use crate::telemetry::monitor::RunMonitor;
use crate::telemetry::report::Report;
use dpm_device::link::HostLink;
use dpm_device::time::{HostClock, HostTime};
use dpm_device::transport::inproc::{threaded, Direct};
use dpm_device::transport::Transport;
use dpm_handoff::channel::{channel, Sender};
use dpm_handoff::wake::WaitPolicy;
use glam::DVec3;
use hil_mock::projector::{DeviceClock, MockConfig, MockProjector};
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64};
use std::sync::{Arc, Mutex, OnceLock};

/// Light events between the projector and the collector: eight seconds at 947 Hz.
const LIGHTS: usize = 8192;
/// Buffers of the cable to a projector in this process: one is filled while another is read, and one for a projector that is late.
const CABLE_BUFFERS: usize = 3;
/// A step of a control thread that ends this late is a standstill of the machine.
const STANDSTILL_NS: i64 = 1_000_000;

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
    monitor: &RunMonitor,
) -> Result<RunOutcome, PipelineError> {
    run_from(rig, None, RunOptions { verify: false, ..options }, monitor)
}

fn run_from(
    rig: Arc<Rig>,
    gpu: Option<&Arc<Gpu>>,
    options: RunOptions,
    monitor: &RunMonitor,
) -> Result<RunOutcome, PipelineError> {
    let config = &rig.config;
    let is_virtual = config.real_time.pace == Pace::Virtual;
    // Hashing every frame costs a millisecond at full size: affordable unless the wall clock rules.
    let options = RunOptions { verify: options.verify && is_virtual, ..options };
    let mut renderer = match gpu {
        Some(gpu) => {
            let settings =
                RendererSettings { output: output(&rig, gpu, options.verify), ..renderer_settings(&rig) };
            Some(Renderer::new(gpu, &rig.scene, settings)?)
        }
        None => None,
    };
    let clock = run_clock(is_virtual);
    let tracker = rig.tracker(tracker_clock(&clock), HostTime(0))?;
    let mut memory = frame_memory(&rig, renderer.as_mut(), options.in_flight.max(2))?;
    if let (Some(renderer), Some(first), false) = (&mut renderer, memory.first_mut(), is_virtual) {
        stages::warm_up(first, &rig, renderer, FIRST_FRAME_TIMEOUT_NS).map_err(RenderError::from)?;
    }
    let (lights_in, lights) = channel(LIGHTS, WaitPolicy::Park);
    let prepared = gpu.is_none().then(|| PreparedFrames::new(rig.camera.raster));
    let (far, warnings) = far_end(&rig, lights_in, options, prepared.is_some())?;
    let mut link = HostLink::new(projector::link_settings(config, rig.camera.raster));

    let rights = Rights::new(&config.real_time);
    let standstill = match &clock {
        // Without control threads late frames are all counted as the rig's.
        RunClock::Real(c) => {
            StandstillMonitor::start(Arc::new(c.sleeping()), STANDSTILL_NS, rights.highest_priority()).ok()
        }
        RunClock::Virtual(_) => None,
    };
    let watch = Stopwatch::start();
    let (mut collector, recorder, carried, unseen) =
        std::thread::scope(|scope| -> Result<_, PipelineError> {
            let (mut cable, device, seen) = match far {
                Far::Outside(medium, lights) => (Cable::Outside(medium), None, Some(lights)),
                Far::Mock(mock, recorder) if is_virtual => {
                    (Cable::Direct(Box::new(Direct::new(*mock)), recorder), None, None)
                }
                Far::Mock(mock, recorder) => {
                    let frame_bytes =
                        projector::frame_bytes(rig.camera.raster, config.projector.schedule().len());
                    let (host_end, device_end) = threaded(frame_bytes, CABLE_BUFFERS, policy(&rig));
                    let (clock, rights) = (&clock, &rights);
                    let thread = std::thread::Builder::new()
                        .name("dpm-mock".into())
                        .spawn_scoped(scope, move || {
                            device_thread(device_end, *mock, recorder, clock, rights)
                        })
                        .map_err(|source| PipelineError::Thread { stage: "mock projector", source })?;
                    (Cable::Threaded(host_end), Some(thread), None)
                }
            };
            let acknowledged =
                if config.safety.acknowledge_faults { u32::MAX } else { ENDED_WITH_THE_LAST_RUN };
            let time = connect(&mut link, cable.transport(), acknowledged, monitor, &mut || {
                clock.wait_until(clock.now().plus_ns(if is_virtual { 50_000 } else { 200_000 }))
            })?;
            let lead = lead_estimator(&rig, &link);
            let shared = Shared {
                rig: rig.clone(),
                clock: &clock,
                time,
                listen_to: AtomicI64::new(0),
                tracking: OnceLock::new(),
                lead_ns: AtomicI64::new(lead.lead_ns()),
                typical_ns: AtomicI64::new(lead.typical_ns()),
                travel_ns: AtomicI64::new(0),
                budget_milli: AtomicU64::new(u64::from(config.render.spp) * 1000),
                planning: AtomicU64::new(0),
                tracking_over: AtomicBool::new(false),
                error: Mutex::new(None),
                monitor,
                options,
                rights: &rights,
            };
            // At virtual pace pictures must not depend on how fast the machine is.
            let adapts = !is_virtual && renderer.is_some() && config.render.method == RenderMethod::Dpm;
            let stages = Stages {
                tracking: TrackingStage::new(&rig, tracker),
                renderer: renderer.as_mut(),
                prepared,
                kernel: Kernel::best(),
                budget: if adapts { budget_controller(&rig) } else { None },
                link,
                cable,
                lead,
                memory,
                seen,
                lights,
            };
            let mut collector = Collector::new(rig.clone(), options.keep_frames, options.verify);
            let Leavings { recorder, carried, unseen } = run_threads(&shared, stages, &mut collector)?;
            let recorder = match device {
                Some(thread) => Some(thread.join().map_err(|_| PipelineError::Panicked("mock projector"))?),
                None => recorder,
            };
            match shared.error.into_inner().ok().flatten() {
                Some(e) => Err(e),
                None => Ok((collector, recorder, carried, unseen)),
            }
        })?;
    let wall_s = watch.elapsed_ns() as f64 * 1e-9;
    let standstills = standstill.map(StandstillMonitor::finish).unwrap_or_default();

    let mut report = Report {
        raster: [rig.camera.raster.width(), rig.camera.raster.height()],
        planes: config.projector.schedule().len() as u32,
        frame_rate_hz: rig.rate().hz(),
        pace: if is_virtual { "virtual" } else { "real" },
        gpu: gpu.map_or_else(|| "none".into(), |gpu| gpu.summary().name.clone()),
        software_gpu: gpu.is_some_and(|gpu| gpu.summary().software),
        method: if gpu.is_some() { config.render.method.word() } else { "prepared" },
        prediction: config.prediction.on,
        light_hash: recorder.as_ref().map_or_else(String::new, |r| format!("{:016x}", r.light_hash)),
        projector: Some(carried),
        wall_s,
        ..Report::default()
    };
    collector.fill(&mut report);
    report.frames_per_wall_second = report.frames_lit as f64 / wall_s.max(1e-9);
    report.warnings.extend(unseen);
    report.warnings.extend(warnings);
    report.warnings.extend(rights.warnings());
    report.warnings.extend(rig.scene.warnings.iter().cloned());
    let slots = collector.slots.counts(&standstills, modelled_ns(&rig));
    for cause in MissCause::ALL {
        collector.profiler.missed(cause, slots.missed[cause as usize]);
    }
    Ok(RunOutcome {
        report,
        recent: std::mem::take(&mut collector.recent).into(),
        light: recorder.map_or_else(Vec::new, LightRecorder::into_frames),
        light_mismatches: collector.light_mismatches,
        traced: std::mem::take(&mut collector.traced),
        slots,
        frames_torn: collector.torn,
        frames_reordered: collector.reordered,
        profiler: collector.profiler,
        standstills,
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
fn tracker_clock(clock: &RunClock) -> Arc<dyn HostClock> {
    match clock {
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
    Mock(Box<MockProjector>, LightRecorder),
    /// A projector outside this process, and where notes of its light go.
    Outside(Box<dyn Transport>, Sender<LightNote>),
}

/// The projector of the rig file, dark, and what the operator should know about its medium. `lights` is where its light is told;
/// `marked` says that frames carry marks to be looked for.
fn far_end(
    rig: &Rig,
    lights: Sender<LightNote>,
    options: RunOptions,
    marked: bool,
) -> Result<(Far, Vec<String>), PipelineError> {
    let (config, raster) = (&rig.config, rig.camera.raster);
    let backend = &config.projector.backend;
    if let ProjectorBackend::Mock(mock) = backend {
        let mut setup = MockConfig::new(raster);
        setup.frame_buffers = mock.buffer_frames.min(64) as u8;
        setup.clock = DeviceClock { skew_ppb: (mock.clock_ppm * 1000.0) as i32, ..DeviceClock::IDEAL };
        setup.flash_limit = projector::flash_limit(config);
        let marks = marked.then(|| config.projector.schedule());
        let recorder = LightRecorder::new(lights, options.keep_frames, options.verify, marks);
        return Ok((Far::Mock(Box::new(MockProjector::new(setup)), recorder), Vec::new()));
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

/// How early frames are latched, learned from what the rig file states.
fn lead_estimator(rig: &Rig, link: &HostLink) -> LeadEstimator {
    let slot_ns = rig.rate().slot_len_ns(0);
    // Sent earlier, a frame would find no room in the device, whose word of a free buffer takes part of a slot.
    let held = link.device().map_or(1, |hello| i64::from(hello.frame_buffers));
    let longest_ns = (held * slot_ns - slot_ns / 2 - RECEIPT_NS).max(0);
    // Half a slot in reserve: what a core does beside frames, and lends to others, is mostly shorter.
    LeadEstimator::new(slot_ns, modelled_ns(rig), slot_ns / 2, longest_ns)
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
        method: Method::from_config(r),
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
