//! Threads, paces and shutdown.

use super::collect::Collector;
use super::connect::{connect, ENDED_WITH_THE_LAST_RUN};
use super::handoff::Ring;
use super::job::FrameJob;
use super::light::LightRecorder;
use super::outcome::{PipelineError, RunOptions, RunOutcome};
use super::prepared::PreparedFrames;
use super::projector;
use super::rights::Rights;
use super::stages::TrackingStage;
use super::threads::{device_thread, run_threads, Cable, Shared, LISTEN_NS};
use crate::clock::{Clock, ManualClock, MonotonicClock, RunClock, Stopwatch};
use crate::config::{Pace, Packer, ProjectorBackend};
use crate::gpu::Gpu;
use crate::pack::{BitPlaneFrame, Kernel};
use crate::plan::slots::MissCause;
use crate::realtime::os::usable_cores;
use crate::realtime::standstill::StandstillMonitor;
use crate::render::method::Method;
use crate::render::{FrameCost, Output, RenderError, Renderer, RendererSettings};
use crate::rig::{Rig, RigError};
use crate::telemetry::monitor::RunMonitor;
use crate::telemetry::report::Report;
use dpm_device::link::HostLink;
use dpm_device::time::{DeviceTicks, HostClock, HostTime};
use dpm_device::transport::inproc::{threaded, Direct};
use dpm_device::transport::Transport;
use glam::DVec3;
use hil_mock::projector::{DeviceClock, MockConfig, MockProjector};
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

/// Tracking, plan, pack, link, and the mock projector.
const STAGE_THREADS: usize = 5;
/// A step of the control thread that ends this late is a standstill of the machine.
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

/// The other end of the cable.
enum Far {
    /// The mock, who watches its light, and the frames that its cable holds.
    Mock(Box<MockProjector>, LightRecorder, usize),
    /// A projector outside this process.
    Outside(Box<dyn Transport>),
}

fn run_from(
    rig: Arc<Rig>,
    gpu: Option<&Arc<Gpu>>,
    options: RunOptions,
    monitor: &RunMonitor,
) -> Result<RunOutcome, PipelineError> {
    let config = &rig.config;
    let mut renderer = match gpu {
        Some(gpu) => {
            let check = options.verify && config.real_time.pace == Pace::Virtual;
            let settings = RendererSettings { output: output(&rig, gpu, check), ..renderer_settings(&rig) };
            Some(Renderer::new(gpu, &rig.scene, settings)?)
        }
        None => None,
    };
    let is_virtual = config.real_time.pace == Pace::Virtual;
    let clock = if is_virtual {
        // The link comes up just before the first frame, so that nobody waits for the filters.
        RunClock::Virtual(ManualClock::new(HostTime(LISTEN_NS)))
    } else {
        // A spinning thread on a machine with fewer cores than stages delays the very stages it waits for.
        let spin_ns = if usable_cores() > STAGE_THREADS { 50_000 } else { 0 };
        RunClock::Real(MonotonicClock::new(spin_ns))
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
            waited_for_memory: false,
            timeline: Default::default(),
            tracked_poses: Vec::with_capacity(rig.bodies.len()),
            sampled_poses: Vec::with_capacity(rig.bodies.len()),
            lost: Vec::with_capacity(rig.bodies.len()),
            scene_poses: Vec::with_capacity(rig.scene.bodies.len()),
            eye: DVec3::ZERO,
            gaze: DVec3::ZERO,
            gpu: match &mut renderer {
                Some(renderer) => Some(renderer.create_slot(false).map_err(RenderError::from)?),
                None => None,
            },
            cost: FrameCost::default(),
            code_hash: 0,
            planes: BitPlaneFrame::new(raster, schedule),
            outcome: None,
        };
        let _ = free.push(Box::new(job));
    }

    let frame_bytes = projector::frame_bytes(raster, schedule.len());
    let lights = Arc::new(Ring::new(8192));
    let prepared = gpu.is_none().then(|| PreparedFrames::new(raster));
    let mut warnings = Vec::new();
    let far = match &config.projector.backend {
        ProjectorBackend::Mock(mock_config) => {
            let mut setup = MockConfig::new(raster);
            setup.frame_buffers = mock_config.buffer_frames.min(64) as u8;
            setup.clock =
                DeviceClock { skew_ppb: (mock_config.clock_ppm * 1000.0) as i32, ..DeviceClock::IDEAL };
            setup.flash_limit = projector::flash_limit(config);
            let marks = prepared.is_some().then_some(schedule);
            let recorder = LightRecorder::new(lights.clone(), options.keep_frames, verify, marks);
            Far::Mock(Box::new(MockProjector::new(setup)), recorder, usize::from(setup.frame_buffers) + 1)
        }
        backend => {
            let medium = projector::open(config, raster)?.ok_or_else(|| {
                RigError::Unsupported(format!(
                    "projector.backend.kind = {:?} takes no frames over a link",
                    backend.word()
                ))
            })?;
            warnings.extend(medium.warnings);
            Far::Outside(medium.transport)
        }
    };
    let mut link = HostLink::new(projector::link_settings(config, raster));
    let acknowledged = if config.safety.acknowledge_faults { u32::MAX } else { ENDED_WITH_THE_LAST_RUN };

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
    let (mut collector, recorder, carried) = std::thread::scope(|scope| -> Result<_, PipelineError> {
        let (mut cable, device) = match far {
            Far::Outside(medium) => (Cable::Outside(medium), None),
            Far::Mock(mock, recorder, _) if is_virtual => {
                (Cable::Direct(Box::new(Direct::new(*mock)), recorder), None)
            }
            Far::Mock(mock, recorder, buffers) => {
                let (host_end, device_end) = threaded(frame_bytes, buffers);
                let (clock, over) = (&clock, &device_over);
                let thread = std::thread::Builder::new()
                    .name("dpm-mock".into())
                    .spawn_scoped(scope, move || device_thread(device_end, *mock, recorder, clock, over))
                    .map_err(|source| PipelineError::Thread { stage: "mock projector", source })?;
                (Cable::Threaded(host_end), Some(thread))
            }
        };
        let connected = connect(&mut link, cable.transport(), acknowledged, &mut || {
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
            tracking: OnceLock::new(),
            lead_ns: AtomicI64::new(0),
            travel_ns: AtomicI64::new(0),
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
        let (cable, carried) =
            run_threads(&shared, tracking, renderer.as_mut(), prepared, kernel, link, cable, &mut collector)?;
        device_over.store(true, Ordering::Release);
        let recorder = match (cable, device) {
            (Cable::Direct(_, recorder), _) => Some(recorder),
            (Cable::Threaded(_), Some(thread)) => {
                Some(thread.join().map_err(|_| PipelineError::Panicked("mock projector"))?)
            }
            (Cable::Threaded(_) | Cable::Outside(_), _) => None,
        };
        match shared.error.into_inner().ok().flatten() {
            Some(e) => Err(e),
            None => Ok((collector, recorder, carried)),
        }
    })?;
    let wall_s = watch.elapsed_ns() as f64 * 1e-9;
    let standstills = standstill.map(StandstillMonitor::finish).unwrap_or_default();

    let mut report = Report {
        raster: [raster.width(), raster.height()],
        planes: schedule.len() as u32,
        frame_rate_hz: rig.rate().hz(),
        pace: if is_virtual { "virtual" } else { "real" },
        gpu: gpu.map_or_else(|| "none".into(), |gpu| gpu.summary().name.clone()),
        software_gpu: gpu.is_some_and(|gpu| gpu.summary().software),
        method: if gpu.is_some() { method_name(&rig) } else { "prepared" },
        prediction: config.prediction.on,
        light_hash: recorder.as_ref().map_or_else(String::new, |r| format!("{:016x}", r.light_hash)),
        projector: Some(carried),
        wall_s,
        ..Report::default()
    };
    collector.fill(&mut report);
    report.frames_per_wall_second = report.frames_lit as f64 / wall_s.max(1e-9);
    report.warnings.extend(warnings);
    report.warnings.extend(rights.warnings());
    report.warnings.extend(rig.scene.warnings.iter().cloned());
    let lead_ns = i64::from(config.real_time.stage_costs_us.total()) * 1000;
    let slots = collector.slots.counts(&standstills, lead_ns);
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
