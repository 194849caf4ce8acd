//! `dpm snapshot`: a rig into pictures of everything that one frame was made from.
//!
//! True poses, no tracker and no link: frame N is drawn after the N frames before it, so histories are what they are in a run.

mod fit;
pub mod views;

pub use fit::{FittedView, SnapshotView};

use super::sequence::{draw, poses_at, BodyPlaces};
use crate::paint::Canvas;
use crate::room::furniture::Bounds;
use crate::room::{raster, RoomPicture};
use dpm_common::files::{check_folder, write_atomically};
use dpm_device::time::HostTime;
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_render::{FrameSlot, Keep, RenderError, Renderer, RendererSettings, Scale};
use dpm_rig::config::{BodyConfig, MotionValue, RenderConfig, RigConfig};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::light::recorder::LightFrame;
use dpm_rig::method_choice;
use dpm_rig::picture_stream::PictureStreams;
use dpm_rig::pictures::{pictures, FallenLight};
use dpm_rig::pipeline::{renderer_settings, PipelineError};
use dpm_rig::rig::Rig;
use dpm_rig::run_rig::{open_gpu, traced_raster};
use dpm_rig::telemetry::monitor::RunMonitor;
use glam::Vec3;
use serde::Serialize;
use std::collections::VecDeque;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use views::{missing, scale_to_white, srgb_canvas, tile_errors, Views};

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
    /// What radiance is divided by before it is kept and filtered: under an even sky the reflectance.
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

/// What to make pictures of.
#[derive(Clone, Debug, Default)]
pub struct SnapshotRequest {
    /// Number of the frame; those before it are drawn, too.
    pub frame: u32,
    /// Pictures; empty: all that the method has.
    pub what: Vec<SnapshotImage>,
    /// From where.
    pub view: SnapshotView,
    /// Bodies stand still unless the rig file lists them: where nobody has said how an asset moves, it does not.
    pub still: bool,
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
    /// The view, where it was fitted to the bodies instead of taken from the rig.
    pub view: Option<FittedView>,
    /// What differs from a run on the rig.
    pub warnings: Vec<String>,
}

fn gpu_failure(error: impl Into<RenderError>) -> Failure {
    PipelineError::Render(error.into()).into()
}

/// Plays the frames up to that of `request` and writes the pictures of the last into `dir`.
///
/// # Errors
/// Bad scene or numbers, a picture asked for that the rig's method does not compute, no body to fit the view to (exit code 2), no
/// GPU (4).
pub fn snapshot(
    config: &RigConfig,
    request: &SnapshotRequest,
    dir: &Path,
) -> Result<SnapshotReport, Failure> {
    check(config, request, dir)?;
    let gpu = open_gpu(config)?;
    let mut warnings = Vec::new();
    let raster = traced_raster(config, &gpu, &mut warnings);
    let mut rig = Rig::build(config, raster)?;
    method_choice::decide(&mut rig, &gpu);
    warnings.extend(keep_live(&mut rig));
    let (rig, view) = stage(rig, request, &gpu)?;
    warnings.extend(rig.scene.warnings.iter().cloned());
    if request.view == SnapshotView::Room {
        return room(rig, request, &gpu, dir, warnings);
    }
    let mut player = Player::new(&rig, &gpu)?;
    let what = &request.what;
    // Without names all that the method has; of a name that it has not, the request was refused.
    let is_wanted = |i: &SnapshotImage| match what.is_empty() {
        true => missing(*i, &player.method).is_none(),
        false => what.contains(i),
    };
    let wanted: Vec<_> = SnapshotImage::ALL.into_iter().filter(is_wanted).collect();
    player.play(request.frame, wanted.contains(&SnapshotImage::Viewer))?;
    let raster = rig.camera.raster;
    let mut report = SnapshotReport {
        method: rig.config.render.method.word().to_owned(),
        frame: request.frame,
        raster: [raster.width(), raster.height()],
        files: Vec::new(),
        not_made: Vec::new(),
        view,
        warnings,
    };
    for image in wanted {
        player.save(image, dir, &mut report)?;
    }
    Ok(report)
}

/// Columns and rows of a picture of the room.
const ROOM: [u32; 2] = [960, 640];
/// Light of the room in it, 1 where it is bright: the projector's light is seen, and what it does not meet, too.
const ROOM_IS: f32 = 0.2;

/// Writes the picture of the room with the bodies of frame `request.frame` in the light of the frames before it.
fn room(
    rig: Rig,
    request: &SnapshotRequest,
    gpu: &Arc<Gpu>,
    dir: &Path,
    warnings: Vec<String>,
) -> Result<SnapshotReport, Failure> {
    let rig = Arc::new(rig);
    let mut player = Player::new(&rig, gpu)?;
    player.play(request.frame, true)?;
    let fallen = |light: LightFrame| {
        let placed = poses_at(&rig, u64::from(light.frame));
        FallenLight { light, poses: placed.poses, centre_ns: placed.animated_at_ns }
    };
    let window: Vec<FallenLight> = player.light.drain(..).map(fallen).collect();
    let bounds = Bounds::of_run(&rig, rig.rate().slot_start_ns(u64::from(request.frame) + 1));
    let mut picture = RoomPicture::new(&rig, gpu, bounds, raster(ROOM)).map_err(gpu_failure)?;
    let canvas = picture.draw_by_itself(&window, ROOM_IS).map_err(gpu_failure)?;
    check_folder(dir).map_err(|e| Failure::new(FailureKind::BadInput, e.to_string()))?;
    Ok(SnapshotReport {
        method: rig.config.render.method.word().to_owned(),
        frame: request.frame,
        raster: ROOM,
        files: vec![save_png(&dir.join("room.png"), &canvas)?],
        not_made: Vec::new(),
        view: None,
        warnings,
    })
}

/// How long to wait for the first picture of another program.
const LIVE_WAIT: Duration = Duration::from_secs(3);

/// Every body that shows another program's pictures keeps the first that comes. Returns what there is to say about them.
fn keep_live(rig: &mut Rig) -> Vec<String> {
    if rig.scene.live.is_empty() {
        return Vec::new();
    }
    let monitor = Arc::new(RunMonitor::default());
    let streams = PictureStreams::start(rig, &monitor);
    let have_come = streams.wait_for_first(LIVE_WAIT);
    drop(streams);
    let mut told = monitor.take_notes();
    if !have_come {
        told.push(format!(
            "not every picture of another program has come within {} s; those bodies are black",
            LIVE_WAIT.as_secs()
        ));
    }
    rig.scene.keep_live();
    told
}

/// Refuses what can be refused before the GPU is opened.
fn check(config: &RigConfig, request: &SnapshotRequest, dir: &Path) -> Result<(), Failure> {
    let bad = |text: String| Failure::new(FailureKind::BadInput, text);
    if request.frame > MAX_FRAME {
        return Err(bad(format!("--frame {}: at most {MAX_FRAME}", request.frame)));
    }
    let method = config.render.to_method();
    for &image in &request.what {
        if let Some(why) = missing(image, &method) {
            let name = config.render.method.word();
            return Err(bad(format!("--what {}: method {name}: {why}", image.name())));
        }
    }
    check_folder(dir).map_err(|e| bad(format!("{e}; choose another folder with --out")))
}

/// The rig with its bodies standing still and its view fitted, where `request` asks for that.
fn stage(
    mut rig: Rig,
    request: &SnapshotRequest,
    gpu: &Arc<Gpu>,
) -> Result<(Rig, Option<FittedView>), Failure> {
    if request.still && rig.config.scene.bodies.is_empty() {
        let body = |name: &str| BodyConfig {
            name: name.to_owned(),
            motion: MotionValue::still(),
            ..BodyConfig::default()
        };
        let mut config = rig.config.clone();
        config.scene.bodies = rig.bodies.iter().map(|b| body(&b.name)).collect();
        rig = rig.with_config(&config)?;
    }
    if !request.view.is_fitted(&rig.config) {
        return Ok((rig, None));
    }
    let poses = poses_at(&rig, u64::from(request.frame));
    let Some(mut view) = FittedView::new(&rig.config, &rig.scene, &poses, rig.camera.raster) else {
        let text = "the scene has no surface that light is projected on, so no view shows it (objects that emit light \
                    everywhere are taken for lamps); name the object in scene.bodies of a rig file, or give --view rig";
        return Err(Failure::new(FailureKind::BadInput, text));
    };
    let config = view.applied_to(&rig.config, request.view);
    rig = rig.with_config(&config)?;
    if config.render.exposure == RenderConfig::default().exposure {
        view.exposure = fit::exposure(&rig, gpu, &poses).map_err(gpu_failure)?;
        let config = view.applied_to(&config, request.view);
        rig = rig.with_config(&config)?;
    }
    Ok((rig, Some(view)))
}

/// Draws the frames, and keeps what the pictures of the last are made from.
struct Player<'a> {
    rig: &'a Rig,
    gpu: &'a Arc<Gpu>,
    method: Method,
    renderer: Renderer,
    slot: FrameSlot,
    /// The bodies in the last frame.
    poses: BodyPlaces,
    /// See [`tile_errors`].
    errors: Vec<Option<f32>>,
    /// Of the last frames, as many as an eye integrates.
    light: VecDeque<LightFrame>,
}

impl<'a> Player<'a> {
    fn new(rig: &'a Rig, gpu: &'a Arc<Gpu>) -> Result<Self, Failure> {
        // What surfaces are like is of interest out of the light too.
        let keep = Keep { every_pixel: true, ..Keep::default() };
        // The views show code values, whatever the planes make of them, and every pixel as it is traced itself.
        let settings = RendererSettings {
            halftone: None,
            plane_groups: Vec::new(),
            scale: Scale::WHOLE,
            ..renderer_settings(rig)
        };
        let renderer = Renderer::keeping(gpu, &rig.scene, settings, keep).map_err(gpu_failure)?;
        let slot = renderer.create_slot(true).map_err(gpu_failure)?;
        let method = rig.config.render.to_method();
        let (poses, errors, light) = (BodyPlaces::default(), Vec::new(), VecDeque::new());
        Ok(Self { rig, gpu, method, renderer, slot, poses, errors, light })
    }

    /// Draws frames 0 to `frame`. `keeps_light`: the light of the last ones will be asked for.
    fn play(&mut self, frame: u32, keeps_light: bool) -> Result<(), Failure> {
        let (rig, config) = (self.rig, &self.rig.config);
        let window = (config.light_window_ms() * 1e-3 * rig.rate().hz()).round().max(1.0) as usize;
        let spp = config.render.spp;
        for k in 0..=frame {
            self.poses = poses_at(rig, u64::from(k));
            draw(rig, &mut self.renderer, &mut self.slot, &self.poses, k, spp as f32).map_err(gpu_failure)?;
            // Rates are decided in every second frame.
            if self.method.needs_rates() && k % 2 == 0 && k + 2 > frame {
                self.errors = tile_errors(rig.camera.raster, &self.method, &self.slot);
            }
            if keeps_light && ((frame - k) as usize) < window {
                self.light.push_back(light_frame(rig, k, &self.slot));
            }
        }
        Ok(())
    }

    /// Writes a picture, with what belongs to it, into `dir`.
    fn save(&mut self, image: SnapshotImage, dir: &Path, report: &mut SnapshotReport) -> Result<(), Failure> {
        let is_fitted = report.view.is_some();
        let canvas = match image {
            SnapshotImage::Viewer => viewer(self.rig, self.gpu, self.light.make_contiguous(), is_fitted)?,
            _ => Ok(self.views(is_fitted).paint(image)),
        };
        match canvas {
            Ok(canvas) => report.files.push(save_png(&dir.join(image.name() + ".png"), &canvas)?),
            Err(why) => report.not_made.push(NotMade { image: image.name(), why }),
        }
        if image == SnapshotImage::Radiance {
            let path = dir.join("radiance.pfm");
            let bytes = pfm(&self.views(is_fitted).radiance(), self.rig.camera.raster.width() as usize);
            write_atomically(&path, |out| out.write_all(&bytes))
                .map_err(|e| Failure::new(FailureKind::BadInput, e.to_string()))?;
            report.files.push(path);
        }
        Ok(())
    }

    fn views(&self, is_fitted: bool) -> Views<'_> {
        Views {
            raster: self.rig.camera.raster,
            method: &self.method,
            slot: &self.slot,
            renderer: &self.renderer,
            poses: &self.poses,
            tile_errors: &self.errors,
            exposure: is_fitted.then_some(self.rig.config.render.exposure as f32),
        }
    }
}

fn light_frame(rig: &Rig, frame: u32, slot: &FrameSlot) -> LightFrame {
    let codes = slot.codes().iter().map(|c| {
        let [r, g, b, _] = c.to_le_bytes();
        [r, g, b]
    });
    let first_photon_at = HostTime(rig.rate().slot_start_ns(u64::from(frame)));
    LightFrame { frame, first_photon_at, codes: codes.collect(), is_moved: false }
}

/// What the eye saw, or why nothing can be said about it. `is_exposed`: white is radiance 1, else the greatest where that is more.
fn viewer(
    rig: &Rig,
    gpu: &Arc<Gpu>,
    light: &[LightFrame],
    is_exposed: bool,
) -> Result<Result<Canvas, String>, Failure> {
    let made = pictures(rig, gpu, light, &[]).map_err(gpu_failure)?;
    Ok(match made.viewer {
        Ok(viewer) => {
            let scale = if is_exposed { 1.0 } else { scale_to_white(&viewer) };
            Ok(srgb_canvas(rig.camera.raster, &viewer, scale))
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
