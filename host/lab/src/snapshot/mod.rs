//! `dpm snapshot`: a rig into pictures of everything that one frame was made from.
//!
//! True poses, no tracker and no link: frame N is drawn after the N frames before it, so histories are what they are in a run.

pub(crate) mod glyphs;
pub mod paint;
pub mod views;

use super::sequence::{draw, poses_at};
use dpm_common::files::{check_folder, write_atomically};
use dpm_device::time::HostTime;
use dpm_render::{FrameSlot, Keep, RenderError, Renderer, RendererSettings};
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::light::recorder::LightFrame;
use dpm_rig::pictures::pictures;
use dpm_rig::pipeline::{renderer_settings, PipelineError};
use dpm_rig::rig::Rig;
use dpm_rig::run_rig::{open_gpu, traced_raster};
use glam::Vec3;
use paint::Canvas;
use serde::Serialize;
use std::collections::VecDeque;
use std::io::Write;
use std::path::{Path, PathBuf};
use views::{missing, srgb_canvas, tile_errors, Views};

/// A frame that comes later takes too long to reach; histories have settled long before.
pub(crate) const MAX_FRAME: u32 = 100_000;

/// What a picture shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum SnapshotImage {
    /// Radiance that is shown, sRGB, and as .pfm in scene units.
    Radiance,
    /// Shading rate of every tile.
    Rate,
    /// Error estimate E of every tile, when rates were last decided.
    Error,
    /// Apparent pixel size d.
    Size,
    /// Angle phi at the eye between gaze and surface.
    Angle,
    /// Samples taken in this frame.
    Spp,
    /// How much the history of each pixel stands on.
    History,
    /// Motion of the surface on the raster since the last frame.
    Motion,
    /// Variance of one sample's luminance.
    Variance,
    /// Reflectance by which radiance is divided before it is filtered.
    Albedo,
    /// Normals, world, x y z from -1..1 to 0..1.
    Normal,
    /// Distance from the projector.
    Depth,
    /// Code values sent to the projector.
    Light,
    /// What the observer sees of the last frames of light.
    Viewer,
}

impl SnapshotImage {
    /// All of them.
    pub(crate) const ALL: [Self; 14] = [
        Self::Radiance,
        Self::Rate,
        Self::Error,
        Self::Size,
        Self::Angle,
        Self::Spp,
        Self::History,
        Self::Motion,
        Self::Variance,
        Self::Albedo,
        Self::Normal,
        Self::Depth,
        Self::Light,
        Self::Viewer,
    ];

    /// Name on the command line and of the file.
    pub(crate) fn name(self) -> String {
        clap::ValueEnum::to_possible_value(&self).map_or(String::new(), |v| v.get_name().to_owned())
    }
}

/// A picture that was not made.
#[derive(Clone, Debug, Serialize)]
pub struct NotMade {
    /// Which.
    pub image: String,
    /// Why not.
    pub why: String,
}

/// What was written.
#[derive(Clone, Debug, Serialize)]
pub struct SnapshotReport {
    /// Method of the rig file.
    pub method: String,
    /// Number of the frame.
    pub frame: u32,
    /// Columns and rows of the raster; maps with a legend are enlarged by a whole factor.
    pub raster: [u32; 2],
    /// The files.
    pub files: Vec<PathBuf>,
    /// What this rig has no picture of.
    pub not_made: Vec<NotMade>,
    /// What differs from a run on the rig.
    pub warnings: Vec<String>,
}

fn gpu_failure(error: impl Into<RenderError>) -> Failure {
    PipelineError::Render(error.into()).into()
}

/// Plays frames 0 to `frame` and writes the pictures `what` of the last (all there are, when empty) into `dir`.
///
/// # Errors
/// Bad scene or numbers or a picture asked for that the rig's method does not compute (exit code 2), no GPU (4).
pub fn snapshot(
    config: &RigConfig,
    frame: u32,
    what: &[SnapshotImage],
    dir: &Path,
) -> Result<SnapshotReport, Failure> {
    let bad = |text: String| Failure::new(FailureKind::BadInput, text);
    if frame > MAX_FRAME {
        return Err(bad(format!("--frame {frame}: at most {MAX_FRAME}")));
    }
    let method = config.render.to_method();
    let name = config.render.method.word().to_owned();
    for &image in what {
        if let Some(why) = missing(image, &method) {
            return Err(bad(format!("--what {}: method {name}: {why}", image.name())));
        }
    }
    check_folder(dir).map_err(|e| bad(format!("{e}; choose another folder with --out")))?;
    let gpu = open_gpu(config)?;
    let mut warnings = Vec::new();
    let raster = traced_raster(config, &gpu, &mut warnings);
    let rig = Rig::build(config, raster)?;
    warnings.extend(rig.scene.warnings.iter().cloned());
    let raster = rig.camera.raster;
    // What surfaces are like is of interest out of the light too.
    let keep = Keep { every_pixel: true, ..Keep::default() };
    // The views show code values, whatever the planes make of them.
    let settings = RendererSettings { halftone: None, plane_groups: Vec::new(), ..renderer_settings(&rig) };
    let mut renderer = Renderer::keeping(&gpu, &rig.scene, settings, keep).map_err(gpu_failure)?;
    let mut slot = renderer.create_slot(true).map_err(gpu_failure)?;
    let wanted: Vec<_> =
        SnapshotImage::ALL.into_iter().filter(|i| what.is_empty() || what.contains(i)).collect();
    let window = (config.light_window_ms() * 1e-3 * rig.rate().hz()).round().max(1.0) as usize;
    let window = if wanted.contains(&SnapshotImage::Viewer) { window } else { 0 };
    let mut light = VecDeque::new();
    let (mut poses, mut errors) = (Vec::new(), Vec::new());
    for k in 0..=frame {
        poses = poses_at(&rig, u64::from(k));
        draw(&rig, &mut renderer, &mut slot, &poses, k, config.render.spp, config.render.spp as f32)
            .map_err(gpu_failure)?;
        // Rates are decided in every second frame.
        if method.needs_rates() && k % 2 == 0 && k + 2 > frame {
            errors = tile_errors(raster, &method, &slot);
        }
        if (frame - k) as usize >= window {
            continue;
        }
        light.push_back(light_frame(&rig, k, &slot));
    }
    let mut report = SnapshotReport {
        method: name,
        frame,
        raster: [raster.width(), raster.height()],
        files: Vec::new(),
        not_made: Vec::new(),
        warnings,
    };
    let views = Views {
        raster,
        method: &method,
        slot: &slot,
        renderer: &renderer,
        poses: &poses,
        tile_errors: &errors,
    };
    for image in wanted {
        let canvas = match missing(image, &method) {
            Some(why) => Err(why.to_owned()),
            None if image == SnapshotImage::Viewer => viewer(&rig, &gpu, light.make_contiguous())?,
            None => Ok(views.paint(image)),
        };
        match canvas {
            Ok(canvas) => report.files.push(save_png(&dir.join(image.name() + ".png"), &canvas)?),
            Err(why) => report.not_made.push(NotMade { image: image.name(), why }),
        }
        if image == SnapshotImage::Radiance {
            let path = dir.join("radiance.pfm");
            let bytes = pfm(&views.radiance(), raster.width() as usize);
            write_atomically(&path, |out| out.write_all(&bytes)).map_err(|e| bad(e.to_string()))?;
            report.files.push(path);
        }
    }
    Ok(report)
}

fn light_frame(rig: &Rig, frame: u32, slot: &FrameSlot) -> LightFrame {
    let codes = slot.codes().iter().map(|c| {
        let [r, g, b, _] = c.to_le_bytes();
        [r, g, b]
    });
    let first_photon_at = HostTime(rig.rate().slot_start_ns(u64::from(frame)));
    LightFrame { frame, first_photon_at, codes: codes.collect() }
}

/// What the eye saw, or why nothing can be said about it.
fn viewer(
    rig: &Rig,
    gpu: &std::sync::Arc<dpm_render::gpu::Gpu>,
    light: &[LightFrame],
) -> Result<Result<Canvas, String>, Failure> {
    let made = pictures(rig, gpu, light, &[]).map_err(gpu_failure)?;
    Ok(match made.viewer {
        Ok(viewer) => {
            let white = viewer.iter().fold(0.0f32, |m, v| m.max(v.max_element())).max(1e-9);
            Ok(srgb_canvas(rig.camera.raster, &viewer, (1.0 / white).min(1.0)))
        }
        Err(_) => {
            Err("only a mock tracker knows the true motion, which an eye follows; --simulate puts one in"
                .into())
        }
    })
}

fn save_png(path: &Path, canvas: &Canvas) -> Result<PathBuf, Failure> {
    let cannot = |e: std::io::Error| {
        Failure::new(FailureKind::BadInput, format!("{e}; choose another folder with --out"))
    };
    canvas.save(path).map_err(cannot)?;
    Ok(path.to_owned())
}

/// A portable float map: little-endian, rows bottom to top.
pub(crate) fn pfm(linear: &[Vec3], width: usize) -> Vec<u8> {
    let height = linear.len() / width.max(1);
    let mut out = format!("PF\n{width} {height}\n-1.0\n").into_bytes();
    for row in linear.chunks_exact(width.max(1)).rev() {
        out.extend(row.iter().flat_map(|v| v.to_array()).flat_map(f32::to_le_bytes));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pfm_is_as_its_description_says() {
        let bytes = pfm(&[Vec3::new(1.0, 0.5, 2.0), Vec3::ZERO], 1);
        let mut expected = b"PF\n1 2\n-1.0\n".to_vec();
        expected.extend([0; 12]);
        expected.extend([0, 0, 0x80, 0x3f, 0, 0, 0, 0x3f, 0, 0, 0, 0x40]);
        assert_eq!(bytes, expected);
    }
}
