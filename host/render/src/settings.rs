//! What a renderer is made with, what a frame is drawn from, and why neither may work.

use super::method::Method;
use super::scene_data::SceneDataError;
use crate::gpu::GpuError;
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec3};

/// What does not change while a renderer lives.
#[derive(Clone, Debug)]
pub struct RendererSettings {
    /// Raster traced.
    pub raster: Raster,
    /// Closest-hit rays of a path, primary included.
    pub depth: u32,
    /// Seed of the run.
    pub seed: u32,
    /// Limit on indirect contributions; `None`: off.
    pub clamp_indirect: Option<f32>,
    /// `pi * exposure / (albedo * max_intensity)`.
    pub drive_gain: f32,
    /// Radiance that the real surfaces show by themselves.
    pub ambient: [f32; 3],
    /// Ordinary camera (tests): radiance goes back along the primary ray and everything is lit.
    pub camera_is_eye: bool,
    /// Compile in what the scene does not need (tests).
    pub leave_nothing_out: bool,
    /// How rays are spent.
    pub method: Method,
    /// What comes back.
    pub output: Output,
}

/// What a frame brings to the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Output {
    /// Code values, to be packed there.
    Codes,
    /// Bit planes, packed by the GPU.
    Planes(PlaneSchedule),
    /// Both: planes to be sent, code values to check the light against.
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

/// What changes from frame to frame. Small: it is written just before the GPU starts.
#[derive(Clone, Copy, Debug)]
pub struct FrameInputs<'a> {
    /// Number of the frame.
    pub frame: u32,
    /// Samples per traced pixel where neither angle nor budget decides.
    pub spp: u32,
    /// Samples per lit pixel on average (method dpm).
    pub budget_spp: f32,
    /// Projector.
    pub camera: &'a ProjectorCamera,
    /// Eye, world.
    pub eye: DVec3,
    /// Gaze point, world.
    pub gaze: DVec3,
    /// Degrees by which all zones about the gaze grow: 0 while it is known.
    pub widen_deg: f32,
    /// world-from-body of every body of the scene, at the time of light.
    pub poses: &'a [DAffine3],
    /// Per tracked body: lost, no light falls on it. Bodies beyond the end are not lost.
    pub lost: &'a [bool],
}

/// A raster whose buffers are larger than a device binds at once.
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
    /// The largest of the buffers.
    pub what: &'static str,
    /// Its size, bytes.
    pub needed: u64,
    /// Largest buffer that the device binds, bytes.
    pub limit: u64,
    /// Largest number of pixels that this method can trace there.
    pub most_pixels: u64,
    /// Method `full` could trace this raster there.
    pub frugal_fits: bool,
}

/// Why a renderer cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The GPU's word.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// The scene's.
    #[error(transparent)]
    Scene(#[from] SceneDataError),
    /// The raster's.
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
