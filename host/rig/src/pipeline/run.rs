//! One run, from a rig to a report.

use super::outcome::RunOutcome;
use super::parts::PictureOrigin;
use super::projector::{self, OpenMedium};
use super::real::run_at_real_pace;
use super::virtual_pace::run_at_virtual_pace;
use crate::config::Pace;
use crate::engine::error::PipelineError;
use crate::engine::facts::Facts;
use crate::engine::options::RunOptions;
use crate::gaze::GazeReport;
use crate::light::collector::Collector;
use crate::light::recorder::LightRecorder;
use crate::pack::source::PatternSource;
use crate::picture_stream::PictureStreams;
use crate::plan::beat::{BeatReport, RatePair};
use crate::rig::Rig;
use crate::telemetry::monitor::RunMonitor;
use crate::telemetry::projector::ProjectorReport;
use crate::telemetry::report::Report;
use crate::telemetry::slots::SlotCounts;
use crate::tracks::gauges::TrackerReport;
use dpm_common::clock::MonotonicClock;
use dpm_common::realtime::standstill::Standstills;
use dpm_render::gpu::Gpu;
use dpm_render::RayWalk;
use std::sync::atomic::Ordering;
use std::sync::Arc;

/// Runs the rig until `options.frames` are planned or `monitor` requests a stop. The projector ends dark.
///
/// # Errors
/// See [`PipelineError`]. Whatever happens, the projector is ordered to go dark, or its watchdog darkens it.
pub fn run(
    rig: Arc<Rig>,
    gpu: &Arc<Gpu>,
    options: RunOptions,
    monitor: &Arc<RunMonitor>,
) -> Result<RunOutcome, PipelineError> {
    run_from(rig, &PictureOrigin::Gpu(gpu.clone()), &projector::open, options, monitor)
}

/// Like [`run`] at real pace, over the medium that `open` opens instead of the rig's own.
///
/// # Errors
/// As for [`run`].
pub fn run_over(
    rig: Arc<Rig>,
    gpu: &Arc<Gpu>,
    open: &OpenMedium,
    options: RunOptions,
    monitor: &Arc<RunMonitor>,
) -> Result<RunOutcome, PipelineError> {
    run_from(rig, &PictureOrigin::Gpu(gpu.clone()), open, options, monitor)
}

/// Like [`run`] with prepared frames instead of rendered ones, without a GPU. Every lit frame is checked for parts of
/// another frame.
///
/// # Errors
/// As for [`run`], except those of the GPU.
pub fn run_prepared(
    rig: Arc<Rig>,
    options: RunOptions,
    monitor: &Arc<RunMonitor>,
) -> Result<RunOutcome, PipelineError> {
    run_from(
        rig,
        &PictureOrigin::Prepared,
        &projector::open,
        RunOptions { verify: false, ..options },
        monitor,
    )
}

/// Shows the pictures of `source`, without a GPU. The rig's tracker is asked for heads that are guarded, and for nothing
/// else.
///
/// # Errors
/// As for [`run`], except those of the GPU and of the tracker.
pub fn run_pattern(
    rig: Arc<Rig>,
    source: Arc<dyn PatternSource>,
    clock: Option<MonotonicClock>,
    options: RunOptions,
    monitor: &Arc<RunMonitor>,
) -> Result<RunOutcome, PipelineError> {
    let rig = match source.schedule().map(|schedule| rig.config.projector.lit_by(schedule)) {
        Some(schedule) if schedule != rig.schedule => {
            Arc::new(Rig { schedule, ..Rig::of_projector(&rig.config)? })
        }
        _ => rig,
    };
    // Nothing renders: a slow link tells of itself by what it carries.
    let options = RunOptions { tells_slow: false, ..options };
    run_from(rig, &PictureOrigin::Pattern(source, clock), &projector::open, options, monitor)
}

fn run_from(
    rig: Arc<Rig>,
    origin: &PictureOrigin,
    open: &OpenMedium,
    options: RunOptions,
    monitor: &Arc<RunMonitor>,
) -> Result<RunOutcome, PipelineError> {
    monitor.live().set_rig(&rig);
    if let Some(used) = &rig.calibration {
        monitor.note(format!("calibration: {used}"));
    }
    if let Some(choice) = &rig.method_choice {
        monitor.note(format!("render.method = \"auto\": {choice}"));
    }
    let heads: Vec<String> = rig.config.heads().iter().map(|head| format!("{head:?}")).collect();
    if !heads.is_empty() {
        monitor.note(format!(
            "eye guard: no light falls about the head {}, and none at all while one is lost",
            heads.join(", ")
        ));
    }
    if matches!(origin, PictureOrigin::Pattern(..)) {
        monitor.parameters().close();
    }
    let streams = PictureStreams::start(&rig, monitor);
    let mut ran = match rig.config.real_time.pace {
        // Hashing every frame costs a millisecond at full size, which only virtual pace can afford.
        Pace::Real => run_at_real_pace(&rig, origin, open, RunOptions { verify: false, ..options }, monitor),
        Pace::Virtual => run_at_virtual_pace(&rig, origin, options, monitor),
    }?;
    ran.warnings.extend(streams.without_pictures());
    Ok(ran.into_outcome(&rig, origin))
}

/// What remains when the light of a run is over.
pub(super) struct Ran {
    pub(super) facts: Arc<Facts>,
    pub(super) collector: Collector,
    pub(super) slots: SlotCounts,
    /// `None` for a projector outside this process, whose light cannot be observed.
    pub(super) recorder: Option<LightRecorder>,
    pub(super) carried: ProjectorReport,
    pub(super) wall_s: f64,
    pub(super) standstills: Standstills,
    pub(super) warnings: Vec<String>,
    pub(super) ray_walk: Option<RayWalk>,
}

impl Ran {
    fn into_outcome(self, rig: &Rig, origin: &PictureOrigin) -> RunOutcome {
        let Self { facts, mut collector, slots, recorder, carried, wall_s, standstills, warnings, ray_walk } =
            self;
        let config = &rig.config;
        let gpu = origin.gpu();
        let mut report = Report {
            raster: [rig.camera.raster.width(), rig.camera.raster.height()],
            planes: rig.schedule.len() as u32,
            frame_rate_hz: rig.rate().hz(),
            pace: config.real_time.pace.word(),
            gpu: gpu.map_or_else(|| "none".into(), |gpu| gpu.summary().name.clone()),
            software_gpu: gpu.is_some_and(|gpu| gpu.summary().software),
            ray_walk,
            method: match origin {
                PictureOrigin::Gpu(_) => config.render.method.word(),
                PictureOrigin::Prepared => "prepared",
                PictureOrigin::Pattern(..) => "pattern",
            },
            prediction: config.prediction.on,
            method_choice: rig.method_choice.clone(),
            calibration: rig.calibration.clone(),
            light_hash: recorder.as_ref().and_then(LightRecorder::hash).unwrap_or_default(),
            projector: Some(carried),
            slots_per_frame: facts.stride_milli.load(Ordering::Relaxed) as f64 / 1e3,
            predict_ms: facts.predict_ns.load(Ordering::Relaxed) as f64 / 1e6,
            wall_s,
            ..Report::default()
        };
        collector.fill(&mut report);
        report.light_s = facts.monitor.light_times_s();
        report.tracker = facts.monitor.sample_counts();
        report.beat = facts.rhythm().map(|rhythm| {
            let pair = RatePair { tracker_hz: 1e9 / rhythm.period_ns as f64, slots_hz: rig.rate().hz() };
            BeatReport::new(pair, facts.in_step.load(Ordering::Relaxed))
        });
        report.gaze = facts.monitor.gaze().report();
        report.warnings.extend(report.gaze.as_ref().and_then(GazeReport::warning));
        report.warnings.extend(report.tracker.as_ref().and_then(TrackerReport::warning));
        report.stopped = facts.monitor.stop_requested();
        report.recoveries = facts.recoveries();
        report.starved_s = facts.starved_ns.load(Ordering::Relaxed) as f64 * 1e-9;
        report.frames_per_wall_second = report.frames_lit as f64 / wall_s.max(1e-9);
        report.warnings.extend(warnings);
        report.warnings.extend(rig.scene.warnings.iter().cloned());
        let (light, moves) = recorder.map_or_else(Default::default, LightRecorder::into_frames);
        RunOutcome {
            report,
            recent: std::mem::take(&mut collector.recent).into(),
            light,
            moves,
            light_mismatches: collector.light_mismatches,
            traced: std::mem::take(&mut collector.traced).into(),
            slots,
            slot_batches: collector.slots.batches().to_vec(),
            frames_torn: collector.torn,
            frames_reordered: collector.reordered,
            profiler: collector.profiler,
            standstills,
        }
    }
}
