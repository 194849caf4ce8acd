//! What a renderer is made with, what a frame is drawn from, and why neither may work.

use super::drive::Drive;
use super::method::Method;
use super::scale::Scale;
use super::scene_data::SceneDataError;
use crate::gpu::{DeviceSummary, GpuError};
use crate::pack::Halftone;
use crate::warp::Sweep;
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_shaders::structs::PlaneGroup;
use glam::{DAffine3, DVec3};
use serde::Serialize;

/// What does not change while a renderer lives.
#[derive(Clone, Debug)]
pub struct RendererSettings {
    /// Raster of the panel.
    pub raster: Raster,
    /// Which share of it is traced.
    pub scale: Scale,
    /// Most closest-hit rays of a path, the primary ray included.
    pub depth: u32,
    /// Seed of the run.
    pub seed: u32,
    /// Limit on the luminance of indirect contributions; `None`: there is no limit.
    pub clamp_indirect: Option<f32>,
    /// From radiance to code values.
    pub drive: Drive,
    /// The projector, if its lens bends rays. Frames are then drawn with the same intrinsics and the same lens.
    pub lens: Option<ProjectorCamera>,
    /// The camera is an ordinary one (tests): radiance returns along the primary ray, and everything is lit.
    pub camera_is_eye: bool,
    /// Code that the scene does not need is compiled in, too (tests).
    pub leave_nothing_out: bool,
    /// How a frame spends its rays.
    pub method: Method,
    /// Code values are shown in parts of a few bits: they are made into halftones. `None`: the planes weigh as the bits do.
    pub halftone: Option<Halftone>,
    /// Groups of bit planes that are shown where the bodies are at their own instants; empty: all planes show what was drawn for the frame's instant.
    pub plane_groups: Vec<PlaneGroup>,
    /// What the host reads back.
    pub output: Output,
    /// Whether the end of a frame and the beginning of the next one share the device.
    pub overlap: Overlapping,
    /// Who finds what a ray meets.
    pub tracing: Tracing,
    /// Most texels of live pictures that a frame brings to the GPU. It shows a picture when the last of its texels are there.
    pub most_live_texels: usize,
}

/// Who finds what a ray meets. The same triangles are found, but for those that are equally near.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Tracing {
    /// The device, if it can and is not software; else the shaders.
    #[default]
    Auto,
    /// The shaders, which walk through trees that the host has built.
    Walk,
    /// The device, software or not (ray query). One that cannot is refused.
    RayQuery,
    /// On software Vulkan threads of the host, where they can ([`crate::RendererPlan::ray_walk`] says why not); elsewhere as `Auto`.
    Host,
}

impl Tracing {
    /// Whether this device finds itself what a ray meets (ray query). It cannot if it is refused. Software Vulkan walks faster than it answers
    /// queries, so it does so only if it is asked to.
    pub fn asks_device(self, device: &DeviceSummary) -> bool {
        match self {
            Self::Auto | Self::Host => device.ray_query && !device.software,
            Self::Walk => false,
            Self::RayQuery => device.ray_query,
        }
    }
}

/// Who finds what rays meet.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum RayWalker {
    /// The device itself (ray query).
    Device,
    /// The shaders.
    Shaders,
    /// Threads of the host.
    Host,
}

/// The same with its reason.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct RayWalk {
    /// Who does.
    pub by: RayWalker,
    /// What follows "because".
    pub why: &'static str,
}

impl RayWalk {
    /// One line about it.
    pub fn told(&self) -> String {
        let who = match self.by {
            RayWalker::Device => "the device finds what rays meet",
            RayWalker::Shaders => "the shaders walk the rays, and not the host",
            RayWalker::Host => "threads of the host walk the rays",
        };
        format!("{who}, because {}", self.why)
    }
}

/// Whether a frame begins before the one before it has ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Overlapping {
    /// Never.
    Never,
    /// On devices with two queues for it.
    #[default]
    WhereItCan,
    /// In the same order, whatever queues there are (tests).
    Always,
}

/// What a frame brings to the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Output {
    /// Code values or halftones, which the host packs.
    Codes,
    /// Bit planes, packed by the GPU.
    Planes(PlaneSchedule),
    /// Both: planes to send, and code values to check the light against.
    Both(PlaneSchedule),
}

impl Output {
    /// The planes that the GPU packs.
    pub(crate) fn schedule(&self) -> Option<&PlaneSchedule> {
        match self {
            Self::Codes => None,
            Self::Planes(schedule) | Self::Both(schedule) => Some(schedule),
        }
    }
}

impl RendererSettings {
    /// Frames may trace fewer pixels than the panel has: the pass `enlarge` is recorded.
    pub fn is_reduced(&self) -> bool {
        self.scale.rasters(self.raster).any(|raster| raster != self.raster)
    }

    /// The settings of the passes that work on a traced raster. What only the panel's own pixels have is not among them.
    pub(super) fn on(&self, raster: Raster) -> Self {
        if !self.is_reduced() {
            return self.clone();
        }
        let Drive { gain, gain_of_body, ambient, .. } = self.drive.clone();
        Self {
            raster,
            scale: Scale::WHOLE,
            lens: self.lens.map(|camera| camera.at_raster(raster)),
            drive: Drive { gain, gain_of_body, ambient, ..Drive::default() },
            halftone: None,
            plane_groups: Vec::new(),
            output: Output::Codes,
            ..self.clone()
        }
    }

    /// The same for the largest raster that frames may trace.
    pub(super) fn on_traced(&self) -> Self {
        let largest = self.scale.rasters(self.raster).next().unwrap_or(self.raster);
        self.on(largest)
    }

    /// The words that planes follow by are halftones, of which nothing lies between two pixels, and not code values.
    pub(crate) fn shows_halftones(&self) -> bool {
        self.halftone.is_some_and(|halftone| !halftone.is_exact() && !halftone.is_cut())
    }
}

/// What changes from frame to frame. It is small, because it is written just before the GPU starts.
#[derive(Clone, Copy, Debug)]
pub struct FrameInputs<'a> {
    /// Number of the frame.
    pub frame: u32,
    /// Samples of a traced pixel, where neither the angle nor a budget decides them; at most [`Method::most_spp`] are taken.
    pub spp: u32,
    /// Average number of samples of a lit pixel (method dpm), with the same bound.
    pub budget_spp: f32,
    /// The projector.
    pub camera: &'a ProjectorCamera,
    /// Factor of the gain of [`RendererSettings::drive`]; 1 leaves it as it is.
    pub brighter: f32,
    /// Position of the eye, world space.
    pub eye: DVec3,
    /// Gaze point, world space.
    pub gaze: DVec3,
    /// Degrees by which all zones around the gaze grow. 0 while the gaze is known.
    pub widen_deg: f32,
    /// world-from-body of every body of the scene, at the time at which the frame is shown.
    pub poses: &'a [DAffine3],
    /// The time of what an animation changes besides poses, nanoseconds: the shapes of bodies that deform, and the pictures of
    /// clips.
    pub animated_at_ns: i64,
    /// How the bodies move while the planes last; `None`: they stand still.
    pub sweep: Option<Sweep<'a>>,
    /// For each tracked body whether it is lost, so that no light falls on it. Bodies beyond the end are not lost.
    pub lost: &'a [bool],
    /// Which of the shares of [`RendererSettings::scale`] is traced, from 0 for the largest; beyond the end the smallest. Another one than in the
    /// frame before begins all histories anew.
    pub rung: usize,
}

impl<'a> FrameInputs<'a> {
    /// Frame 0 with one sample a pixel: bodies that stand still at `poses` and that no tracker has lost, lit by `camera` and
    /// seen by an eye at the first of `eye_and_gaze` that looks at the second. Callers change what differs.
    pub const fn new(
        camera: &'a ProjectorCamera,
        eye_and_gaze: (DVec3, DVec3),
        poses: &'a [DAffine3],
    ) -> Self {
        let (eye, gaze) = eye_and_gaze;
        Self {
            frame: 0,
            spp: 1,
            budget_spp: 1.0,
            camera,
            brighter: 1.0,
            eye,
            gaze,
            widen_deg: 0.0,
            poses,
            animated_at_ns: 0,
            sweep: None,
            lost: &[],
            rung: 0,
        }
    }
}

/// A raster that has a buffer larger than the device can bind.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "a raster of {} x {} is too large for {device}: its {what} buffer takes {} MiB, and the device binds at most {} MiB at once \
     ({most_pixels} pixels). {}",
    raster.width(),
    raster.height(),
    mib(*needed),
    mib(*limit),
    remedy(*frugal_fits)
)]
pub struct RasterTooLarge {
    /// The raster.
    pub raster: Raster,
    /// Name of the device.
    pub device: String,
    /// Name of the largest buffer.
    pub what: &'static str,
    /// Its size, bytes.
    pub needed: u64,
    /// Largest buffer that the device can bind, bytes.
    pub limit: u64,
    /// Most pixels that this method can trace on the device.
    pub most_pixels: u64,
    /// Method `full` could trace this raster on the device.
    pub frugal_fits: bool,
}

/// Why a renderer cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The GPU failed.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// The scene cannot be drawn.
    #[error(transparent)]
    Scene(#[from] SceneDataError),
    /// The raster is too large.
    #[error(transparent)]
    Raster(#[from] RasterTooLarge),
}

/// Mebibytes with one decimal, rounded up.
fn mib(bytes: u64) -> String {
    format!("{:.1}", (bytes as f64 / f64::from(1 << 20) * 10.0).ceil() / 10.0)
}

fn remedy(frugal_fits: bool) -> &'static str {
    if frugal_fits {
        "Trace a smaller raster (--raster WxH), or trace this one by a method without a history: --set render.method=full"
    } else {
        "Trace a smaller raster (--raster WxH)"
    }
}
