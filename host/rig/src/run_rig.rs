//! `dpm run` and `dpm demo`: from a configuration to a report and pictures.

use super::pictures::{pictures, to_srgb};
use crate::config::{PlaneWeights, RigConfig};
use crate::engine::connect::ConnectError;
use crate::failure::{Ended, Failure, FailureKind};
use crate::method_choice;
use crate::pipeline::{self, renderer_settings, PipelineError, RunOptions, RunOutcome};
use crate::presence;
use crate::rig::{Rig, RigError};
use crate::telemetry::monitor::RunMonitor;
use crate::telemetry::report::Report;
use crate::telemetry::trace::write_trace;
use crate::trackers::SourceError;
use dpm_common::files::{check_folder, write_atomically};
use dpm_device::link::LinkError;
use dpm_device::planes::{Channel, Raster};
use dpm_render::gpu::{validation_messages, Gpu, GpuError};
use dpm_render::{Keep, RayWalk, RenderError, RendererPlan, RendererSettings};
use glam::Vec3;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Runs the rig until all its frames are lit or `monitor` asks it to stop. Writes the files that `[output]` asks for.
///
/// # Errors
/// A bad scene or bad numbers (exit code 2), a device that fails (3), or no GPU (4).
///
/// A failure after the run does not discard the report, so no measurement is lost; see [`Ended`].
pub fn run_rig(config: &RigConfig, monitor: &Arc<RunMonitor>) -> Result<Ended<Report>, Failure> {
    run_with(config, monitor, Vec::new())
}

/// As [`run_rig`], with notes for the operator and the report.
fn run_with(
    config: &RigConfig,
    monitor: &Arc<RunMonitor>,
    mut notes: Vec<String>,
) -> Result<Ended<Report>, Failure> {
    // Checked before the run, because the run's report is written there.
    check_output_folder(&config.output.dir)?;
    // What can be seen missing is, before minutes are spent.
    presence::look(config)?;
    // Nothing is lit yet: whoever stops the run waits for nothing.
    let setting_up = monitor.begin_set_up();
    let gpu = open_gpu(config)?;
    let raster = traced_raster(config, &gpu, &mut notes);
    let mut rig = Rig::build(config, raster)?;
    method_choice::decide(&mut rig, &gpu);
    let rig = Arc::new(rig);
    let output = &config.output;
    // The pictures show the light itself, which only the mock observes.
    let has_light = config.projector.backend.is_mock();
    if output.images && !has_light {
        notes.push(
            "output.images: no pictures are written, because the light of a real projector cannot be observed".into(),
        );
    }
    if rig.schedule.planes().iter().all(|plane| plane.channel == Channel::White) {
        notes.push(
            "the projector has one white channel, which shows the green of the picture; red and blue alone stay dark".into(),
        );
    }
    let window = (config.light_window_ms() * 1e-3 * rig.rate().hz()).round().max(1.0) as usize;
    tell_at_the_start(&rig, &notes, monitor);
    let keep_frames = if output.images && has_light { window } else { 0 };
    let slots = config.slots_to_run();
    let options = RunOptions { frames: config.run.frames, slots, keep_frames, ..RunOptions::default() };
    let outcome = match pipeline::run(rig.clone(), &gpu, options, monitor) {
        Ok(outcome) => outcome,
        Err(PipelineError::Connect(ConnectError::Stopped)) => return Ok(stopped_before_light(config)),
        Err(error) => {
            // Nothing is lit yet. Tables and programs are of other planes than the projector's, so all is made anew.
            let Some((config, note)) = planes_offered(config, &error) else { return Err(error.into()) };
            drop((rig, gpu, setting_up));
            return run_with(&config, monitor, vec![note]);
        }
    };
    drop(setting_up);
    Ok(finished(&rig, &gpu, outcome, notes, keep_frames))
}

/// What a run left, with its files written.
fn finished(
    rig: &Rig,
    gpu: &Arc<Gpu>,
    mut outcome: RunOutcome,
    notes: Vec<String>,
    keep_frames: usize,
) -> Ended<Report> {
    let output = &rig.config.output;
    let _writing = dpm_common::stopping::WritingFiles::begin();
    let mut ended = Ended::from(std::mem::take(&mut outcome.report));
    ended.report.warnings.splice(0..0, notes);
    if outcome.light_mismatches > 0 {
        let told = format!("{} frames of light differ from what was rendered", outcome.light_mismatches);
        ended.fail(Failure::new(FailureKind::CheckFailed, told));
    }
    if keep_frames > 0 {
        let written = write_pictures(rig, gpu, &outcome);
        if let Some((files, why_not)) = ended.keep(written) {
            ended.report.files.extend(files);
            ended.report.warnings.extend(why_not);
        }
    }
    if output.trace {
        let path = output.dir.join("trace.json");
        let written = write_atomically(&path, |out| write_trace(out, &outcome.traced, &outcome.standstills));
        if ended.keep(written.map_err(|e| cannot_write(&path, &e))).is_some() {
            ended.report.files.push(path);
        }
    }
    let (count, texts) = validation_messages();
    if let Some(first) = texts.first() {
        ended
            .report
            .warnings
            .push(format!("{count} messages of the Vulkan validation layer, the first: {first}"));
    }
    write_report(&mut ended, &output.dir);
    ended
}

/// The configuration with the planes that the projector offers, if `error` says that it does not offer those of
/// `projector.weights = "auto"`, and what to say of it.
pub fn planes_offered(config: &RigConfig, error: &PipelineError) -> Option<(RigConfig, String)> {
    let PipelineError::Connect(ConnectError::Link(LinkError::Exceeds { device })) = error else {
        return None;
    };
    let mut binary = config.clone();
    binary.projector.weights = PlaneWeights::Binary;
    let note =
        format!("{device}: projector.weights = \"auto\" is \"binary\", because the projector does not offer split planes");
    (config.projector.weights == PlaneWeights::Auto).then_some((binary, note))
}

/// The end of a run that was stopped before its projector was up, with its report in the output folder.
pub fn stopped_before_light(config: &RigConfig) -> Ended<Report> {
    let p = &config.projector;
    let mut ended = Ended::from(Report {
        raster: [p.width, p.height],
        planes: p.schedule().len() as u32,
        frame_rate_hz: p.frame_rate.hz(),
        pace: config.real_time.pace.word(),
        gpu: "none".into(),
        method: config.render.method.word(),
        prediction: config.prediction.on,
        stopped: true,
        warnings: vec![ConnectError::Stopped.to_string()],
        ..Report::default()
    });
    write_report(&mut ended, &config.output.dir);
    ended
}

/// Writes the report into the folder `dir`, and names the file in it.
fn write_report(ended: &mut Ended<Report>, dir: &Path) {
    let path = dir.join("report.json");
    ended.report.files.push(path.clone());
    let text = ended.report.to_json();
    let written = write_atomically(&path, |out| std::io::Write::write_all(out, text.as_bytes()));
    if ended.keep(written.map_err(|e| cannot_write(&path, &e))).is_none() {
        ended.report.files.pop();
    }
}

/// The largest number of notes printed at the start. The report contains all of them.
const TOLD: usize = 12;

/// Prints what is known before the first frame: adjustments to the rig, parts of the scene that are dropped, and
/// bodies that have nothing to show. The report contains the same notes, but it is written after the run.
fn tell_at_the_start(rig: &Rig, notes: &[String], monitor: &RunMonitor) {
    let shown = |i: usize| rig.scene.bodies.iter().any(|b| b.tracked.map(usize::from) == Some(i));
    let known: Vec<&str> = rig.scene.bodies.iter().map(|b| b.name.as_str()).collect();
    let empty = rig.bodies.iter().enumerate().filter(|(i, _)| !shown(*i)).map(|(_, body)| {
        format!(
            "body {:?} does not exist in the scene, so no light falls on it, wherever the {} tracker says that it is; the scene has {}",
            body.name,
            rig.config.tracker.word(),
            known.join(", ")
        )
    });
    let all: Vec<String> =
        empty.chain(notes.iter().cloned()).chain(rig.scene.warnings.iter().cloned()).collect();
    all.iter().take(TOLD).for_each(|line| monitor.note(line.clone()));
    if all.len() > TOLD {
        monitor.note(format!("and {} more: see the report", all.len() - TOLD));
    }
}

/// Writes `light.png` and `viewer.png` where the kept light allows it. Returns the files, and why one is missing.
fn write_pictures(
    rig: &Rig,
    gpu: &Arc<Gpu>,
    outcome: &RunOutcome,
) -> Result<(Vec<PathBuf>, Option<String>), Failure> {
    let dir = &rig.config.output.dir;
    if outcome.light.is_empty() {
        let why = "output.images: no frame was lit, so there is no light to make pictures of";
        return Ok((Vec::new(), Some(why.into())));
    }
    let made = pictures(rig, gpu, &outcome.light, &outcome.recent).map_err(PipelineError::from)?;
    let mut files = vec![save(dir, "light.png", rig, &made.light, 1.0)?];
    let why_not = match &made.viewer {
        Ok(viewer) => {
            let white = viewer.iter().fold(0.0f32, |m, v| m.max(v.max_element())).max(1e-9);
            files.push(save(dir, "viewer.png", rig, viewer, (1.0 / white).min(1.0))?);
            None
        }
        Err(why) => Some(format!("output.images: no viewer.png: {why}")),
    };
    Ok((files, why_not))
}

/// Checks, before any work is done, that files can be written into the output folder.
///
/// # Errors
/// They cannot; the message names the folder.
pub fn check_output_folder(dir: &Path) -> Result<(), Failure> {
    check_folder(dir)
        .map_err(|e| Failure::new(FailureKind::BadInput, format!("{e}; choose another folder with --out")))
}

/// Opens the GPU that the rig file names.
///
/// # Errors
/// There is no such GPU (exit code 4); the message says what to install.
pub fn open_gpu(config: &RigConfig) -> Result<Arc<Gpu>, Failure> {
    Gpu::open(&presence::gpu_options(config)).map_err(|e| Failure::new(FailureKind::NoGpu, e))
}

/// Who finds what the rays of a run of `rig` meet on `gpu`, and why.
///
/// # Errors
/// The scene is too large, or `gpu` cannot do what the rig file asks for.
pub fn ray_walk(rig: &Rig, gpu: &Gpu) -> Result<RayWalk, RenderError> {
    let raster = traced_raster(&rig.config, gpu, &mut Vec::new()).unwrap_or(rig.camera.raster);
    let settings = RendererSettings { raster, lens: None, ..renderer_settings(rig) };
    Ok(RendererPlan::new(&rig.scene, settings, Keep::default())?.ray_walk(gpu)?)
}

/// The smaller raster that software Vulkan traces, with a note about it.
pub fn traced_raster(config: &RigConfig, gpu: &Gpu, notes: &mut Vec<String>) -> Option<Raster> {
    let [width, height] = config.render.software_raster;
    let small = Raster::new(width, height)?;
    let full = config.projector.raster();
    if !gpu.summary().software || small.pixel_count() >= full.pixel_count() {
        return None;
    }
    if !config.projector.backend.is_mock() {
        // A real panel has a fixed number of mirrors.
        notes.push(format!(
            "no GPU: software Vulkan ({}) traces all {} x {} mirrors of the projector, which is slow",
            gpu.summary().name,
            full.width(),
            full.height()
        ));
        return None;
    }
    notes.push(format!(
        "no GPU: software Vulkan ({}) traces {width} x {height} instead of {} x {}; --raster changes it",
        gpu.summary().name,
        full.width(),
        full.height()
    ));
    Some(small)
}

fn save(dir: &Path, name: &str, rig: &Rig, linear: &[Vec3], scale: f32) -> Result<PathBuf, Failure> {
    let path = dir.join(name);
    let raster = rig.camera.raster;
    std::fs::create_dir_all(dir).map_err(|e| cannot_write(dir, &e))?;
    image::save_buffer(
        &path,
        &to_srgb(linear, scale),
        raster.width(),
        raster.height(),
        image::ColorType::Rgb8,
    )
    .map_err(|e| cannot_write(&path, &e))?;
    Ok(path)
}

/// A failure that names the file that cannot be written, and why.
pub fn cannot_write(path: &Path, error: &dyn std::fmt::Display) -> Failure {
    Failure::new(
        FailureKind::BadInput,
        format!("cannot write {}: {error}; choose another folder with --out", path.display()),
    )
}

impl From<RigError> for Failure {
    fn from(error: RigError) -> Self {
        Self::new(FailureKind::BadInput, error)
    }
}

impl From<SourceError> for Failure {
    fn from(error: SourceError) -> Self {
        let kind = match error {
            SourceError::Tracker(_) => FailureKind::Device,
            SourceError::Key { .. } => FailureKind::BadInput,
        };
        Self::new(kind, error)
    }
}

impl From<PipelineError> for Failure {
    fn from(error: PipelineError) -> Self {
        let kind = match &error {
            PipelineError::Tracker(SourceError::Tracker(_))
            | PipelineError::Connect(_)
            | PipelineError::Thread { .. } => FailureKind::Device,
            PipelineError::Rig(_)
            | PipelineError::Tracker(_)
            | PipelineError::Render(RenderError::Scene(_) | RenderError::Raster(_)) => FailureKind::BadInput,
            PipelineError::Render(RenderError::Gpu(e)) | PipelineError::Gpu { source: e, .. } => match e {
                GpuError::OutOfMemory { .. } | GpuError::Limit { .. } => FailureKind::BadInput,
                _ => FailureKind::NoGpu,
            },
            PipelineError::Panicked(_) | PipelineError::Hung { .. } => FailureKind::Device,
            PipelineError::GpuHangs { .. } | PipelineError::KeepsFailing { .. } => FailureKind::NoGpu,
        };
        Self::new(kind, error)
    }
}
