//! `dpm run` and `dpm demo`: a rig from its configuration to its report and pictures.

use super::pictures::{pictures, to_srgb};
use crate::config::{ProjectorBackend, RigConfig, TrackerConfig};
use crate::failure::{Failure, FailureKind};
use crate::files::write_atomically;
use crate::gpu::{validation_messages, Gpu, GpuError, GpuOptions};
use crate::pipeline::{self, PipelineError, RunOptions};
use crate::render::method::Method;
use crate::render::{RenderError, Renderer, RendererSettings};
use crate::rig::{Rig, RigError};
use crate::telemetry::monitor::RunMonitor;
use crate::telemetry::report::Report;
use crate::telemetry::trace::write_trace;
use crate::tracking::source::SourceError;
use dpm_device::planes::Raster;
use glam::Vec3;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Runs the rig until its frames are lit or `monitor` asks to stop; writes what `[output]` asks for.
///
/// # Errors
/// Bad scene or numbers (exit code 2), a device that fails (3), no GPU (4).
pub fn run_rig(config: &RigConfig, monitor: &Arc<RunMonitor>) -> Result<Report, Failure> {
    let gpu = open_gpu(config)?;
    let mut notes = Vec::new();
    let raster = traced_raster(config, &gpu, &mut notes);
    let rig = Arc::new(Rig::build(config, raster)?);
    let output = &config.output;
    // Pictures are made of the light itself, which only the mock sees.
    let has_truth = matches!(config.tracker, TrackerConfig::Mock(_));
    let has_light = matches!(config.projector.backend, ProjectorBackend::Mock(_));
    if output.images && !has_light {
        notes.push(
            "output.images: the light of a projector outside is not seen, no pictures are written".into(),
        );
    }
    let window = (output.light_window_ms * 1e-3 * rig.rate().hz()).round().max(1.0) as usize;
    let keep_frames = if output.images && has_truth && has_light { window } else { 0 };
    let options = RunOptions { frames: config.run.frames, keep_frames, ..RunOptions::default() };
    let outcome = pipeline::run(rig.clone(), &gpu, options, monitor)?;
    let _writing = crate::stopping::WritingFiles::begin();
    let mut report = outcome.report;
    report.warnings.splice(0..0, notes);
    if outcome.light_mismatches > 0 {
        return Err(Failure::new(
            FailureKind::CheckFailed,
            format!("{} frames of light differ from what was rendered", outcome.light_mismatches),
        ));
    }
    if keep_frames > 0 {
        // Only surfaces are asked of it, so the simplest method will do.
        let settings = RendererSettings { method: Method::full(1), ..pipeline::renderer_settings(&rig) };
        let mut renderer = Renderer::new(&gpu, &rig.scene, settings).map_err(PipelineError::from)?;
        let made = pictures(&rig, &mut renderer, &outcome.light)
            .map_err(|e| Failure::from(PipelineError::Render(e.into())))?;
        if let Some(made) = made {
            let white = made.viewer.iter().fold(0.0f32, |m, v| m.max(v.max_element())).max(1e-9);
            report.files.push(save(&output.dir, "light.png", &rig, &made.light, 1.0)?);
            report.files.push(save(&output.dir, "viewer.png", &rig, &made.viewer, (1.0 / white).min(1.0))?);
        }
    }
    if output.trace {
        std::fs::create_dir_all(&output.dir).map_err(|e| cannot_write(&output.dir, &e))?;
        let path = output.dir.join("trace.json");
        write_atomically(&path, |out| write_trace(out, &outcome.traced, &outcome.standstills))
            .map_err(|e| cannot_write(&path, &e))?;
        report.files.push(path);
    }
    let (count, texts) = validation_messages();
    if let Some(first) = texts.first() {
        report.warnings.push(format!("{count} messages of the Vulkan validation layer, the first: {first}"));
    }
    let path = output.dir.join("report.json");
    report.files.push(path.clone());
    std::fs::create_dir_all(&output.dir).map_err(|e| cannot_write(&output.dir, &e))?;
    write_atomically(&path, |out| std::io::Write::write_all(out, report.to_json().as_bytes()))
        .map_err(|e| cannot_write(&path, &e))?;
    Ok(report)
}

/// Opens the device that the rig file names.
///
/// # Errors
/// Exit code 4 with what to install.
pub fn open_gpu(config: &RigConfig) -> Result<Arc<Gpu>, Failure> {
    let options = GpuOptions {
        validation: std::env::var_os("DPM_VALIDATION").is_some(),
        device: config.render.gpu.clone(),
    };
    Gpu::open(&options).map_err(|e| Failure::new(FailureKind::NoGpu, e))
}

/// Software Vulkan traces a smaller raster, and says so.
pub fn traced_raster(config: &RigConfig, gpu: &Gpu, notes: &mut Vec<String>) -> Option<Raster> {
    let [width, height] = config.render.software_raster;
    let small = Raster::new(width, height)?;
    let full = config.projector.raster();
    if !gpu.summary().software || small.pixel_count() >= full.pixel_count() {
        return None;
    }
    if !matches!(config.projector.backend, ProjectorBackend::Mock(_)) {
        // A real panel has the mirrors that it has.
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

pub(super) fn cannot_write(path: &Path, error: &dyn std::fmt::Display) -> Failure {
    Failure::new(
        FailureKind::BadInput,
        format!("cannot write {}: {error}; choose another folder with --out", path.display()),
    )
}

impl From<RigError> for Failure {
    fn from(error: RigError) -> Self {
        let kind = match error {
            RigError::Tracker(SourceError::Tracker(_)) => FailureKind::Device,
            _ => FailureKind::BadInput,
        };
        Self::new(kind, error)
    }
}

impl From<PipelineError> for Failure {
    fn from(error: PipelineError) -> Self {
        let kind = match &error {
            PipelineError::Rig(RigError::Tracker(SourceError::Tracker(_)))
            | PipelineError::Connect(_)
            | PipelineError::Thread { .. } => FailureKind::Device,
            PipelineError::Rig(_) | PipelineError::Render(RenderError::Scene(_) | RenderError::Raster(_)) => {
                FailureKind::BadInput
            }
            PipelineError::Render(RenderError::Gpu(e)) | PipelineError::Gpu { source: e, .. } => match e {
                GpuError::OutOfMemory { .. } | GpuError::Limit { .. } => FailureKind::BadInput,
                _ => FailureKind::NoGpu,
            },
            PipelineError::Panicked(_) => FailureKind::Device,
        };
        Self::new(kind, error)
    }
}
