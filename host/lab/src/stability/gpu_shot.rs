//! A scene and a camera into frames drawn by the GPU, as plain numbers.

use super::estimate::Estimate;
use dpm_render::drive::Drive;
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_render::scene_data::Keep;
use dpm_render::{
    FrameInputs, FrameSlot, Output, Overlapping, Renderer, RendererSettings, Scale, Surface, Tracing,
};
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::Scene;
use dpm_shaders::structs::{Counters, NO_HIT};
use glam::{DAffine3, DVec3};
use std::ops::Range;
use std::sync::Arc;

/// Longest that one small frame may take on the slowest machine.
const TIMEOUT_NS: u64 = 120_000_000_000;

/// What to draw.
#[derive(Clone)]
pub struct Shot<'a> {
    /// Scene.
    pub scene: &'a Scene,
    /// Projector, or camera when there is no eye.
    pub camera: ProjectorCamera,
    /// Where the light is wanted; `None`: back along the rays, everything is lit.
    pub eye: Option<DVec3>,
    /// Where the eye looks; `None`: at itself, which is nowhere.
    pub gaze: Option<DVec3>,
    /// Poses of the bodies; empty: at rest.
    pub poses: Vec<DAffine3>,
    /// Lost tracked bodies.
    pub lost: Vec<bool>,
    /// Samples per pixel and frame.
    pub spp: u32,
    /// Frames, each with its own random numbers; the estimates' variances come from them.
    pub frames: u32,
    /// By how much the numbers of the frames go up: more than 1 where frames are dropped.
    pub step: u32,
    /// Closest hits per path.
    pub depth: u32,
    /// Seed.
    pub seed: u32,
    /// Firefly limit.
    pub clamp_indirect: Option<f32>,
    /// `pi * exposure / (albedo * max_intensity)`.
    pub drive_gain: f32,
    /// Radiance that the real surfaces show by themselves.
    pub ambient: [f32; 3],
    /// Compile in what the scene does not need.
    pub leave_nothing_out: bool,
    /// How rays are spent; `None`: [`Method::full`].
    pub method: Option<Method>,
    /// Who finds what a ray meets.
    pub tracing: Tracing,
    /// The share of the raster that is traced.
    pub scale: Scale,
}

impl<'a> Shot<'a> {
    /// One frame of 16 samples at depth 4 with an ordinary camera.
    pub fn new(scene: &'a Scene, camera: ProjectorCamera) -> Self {
        Self {
            scene,
            camera,
            eye: None,
            gaze: None,
            poses: Vec::new(),
            lost: Vec::new(),
            spp: 16,
            frames: 1,
            step: 1,
            depth: 4,
            seed: 1,
            clamp_indirect: None,
            drive_gain: 1.0,
            ambient: [0.0; 3],
            leave_nothing_out: false,
            method: None,
            tracing: Tracing::Auto,
            scale: Scale::WHOLE,
        }
    }

    /// Poses in use.
    pub(crate) fn world_from_body(&self) -> Vec<DAffine3> {
        if self.poses.is_empty() {
            self.scene.bodies.iter().map(|b| b.world_from_body_rest).collect()
        } else {
            self.poses.clone()
        }
    }

    /// The renderer's settings.
    pub fn settings(&self) -> RendererSettings {
        RendererSettings {
            raster: self.camera.raster,
            scale: self.scale,
            depth: self.depth,
            seed: self.seed,
            clamp_indirect: self.clamp_indirect,
            drive: Drive { ambient: self.ambient, ..Drive::even(self.drive_gain) },
            lens: (!self.camera.lens.is_pinhole()).then_some(self.camera),
            camera_is_eye: self.eye.is_none(),
            leave_nothing_out: self.leave_nothing_out,
            method: self.method.clone().unwrap_or_else(|| Method::full(self.spp)),
            halftone: None,
            plane_groups: Vec::new(),
            output: Output::Codes,
            overlap: Overlapping::Never,
            tracing: self.tracing,
            most_live_texels: usize::MAX,
        }
    }

    /// Draws it.
    ///
    /// # Panics
    /// When the scene does not fit the GPU or a frame does not end: a failure of whoever asked for it.
    pub fn draw(&self, gpu: &Arc<Gpu>) -> ShotPicture {
        self.draw_keeping(gpu, Keep::default())
    }

    /// Draws it with `keep` in.
    ///
    /// # Panics
    /// As [`Shot::draw`].
    pub fn draw_keeping(&self, gpu: &Arc<Gpu>, keep: Keep) -> ShotPicture {
        let mut renderer =
            Renderer::keeping(gpu, self.scene, self.settings(), keep).expect("the scene fits the GPU");
        let poses = self.world_from_body();
        let mut picture = ShotPicture::default();
        self.play(
            &mut renderer,
            0..self.frames,
            |_| poses.clone(),
            |frame, slot, counters| {
                picture.add(slot, counters);
                if frame + 1 == self.frames {
                    picture.keep(slot);
                }
            },
        );
        picture
    }

    /// Draws frames with a renderer of [`Shot::settings`] whose history goes on, each with its own poses; `each` sees every one.
    ///
    /// # Panics
    /// As [`Shot::draw`].
    pub(crate) fn play(
        &self,
        renderer: &mut Renderer,
        frames: Range<u32>,
        poses: impl Fn(u32) -> Vec<DAffine3>,
        mut each: impl FnMut(u32, &FrameSlot, Counters),
    ) {
        let mut slot = renderer.create_slot(true).expect("memory for a small frame");
        let eye = self.eye.unwrap_or(self.camera.position());
        for frame in frames {
            let poses = poses(frame);
            let inputs = FrameInputs {
                frame: frame * self.step,
                spp: self.spp,
                budget_spp: self.spp as f32,
                lost: &self.lost,
                ..FrameInputs::new(&self.camera, (eye, self.gaze.unwrap_or(eye)), &poses)
            };
            renderer.submit(&mut slot, &inputs).expect("submit");
            let cost = slot.wait(TIMEOUT_NS).expect("the frame ends");
            each(frame, &slot, cost.counters());
        }
    }
}

/// What came back.
#[derive(Clone, Debug, Default)]
pub struct ShotPicture {
    /// Mean radiance of every pixel over the frames.
    pub estimates: Vec<Estimate>,
    /// What each pixel's ray met.
    pub surfaces: Vec<Surface>,
    /// Radiance and sample count of the last frame.
    pub radiance: Vec<[f32; 4]>,
    /// Code values of the last frame, 0x00BBGGRR.
    pub codes: Vec<u32>,
    /// Counters of every frame.
    pub counters: Vec<Counters>,
}

impl ShotPicture {
    /// Takes one frame's radiance into the means.
    fn add(&mut self, slot: &FrameSlot, counters: Counters) {
        let radiance = slot.radiance().unwrap_or(&[]);
        self.estimates.resize(radiance.len(), Estimate::default());
        for (estimate, r) in self.estimates.iter_mut().zip(radiance) {
            estimate.add([f64::from(r[0]), f64::from(r[1]), f64::from(r[2])]);
        }
        self.counters.push(counters);
    }

    /// Keeps what only the last frame tells.
    fn keep(&mut self, slot: &FrameSlot) {
        self.surfaces = slot.surfaces().unwrap_or_default();
        self.radiance = slot.radiance().unwrap_or(&[]).to_vec();
        self.codes = slot.codes().to_vec();
    }

    /// Samples of all frames that were dropped because they were not finite.
    pub(crate) fn invalid_samples(&self) -> u32 {
        self.counters.iter().map(|c| c.invalid_samples).sum()
    }

    /// Closest-hit and shadow rays of all frames.
    pub(crate) fn rays(&self) -> u64 {
        self.counters.iter().map(|c| u64::from(c.rays)).sum()
    }

    /// The pixel's ray met a surface.
    pub fn hit(&self, pixel: usize) -> bool {
        self.surfaces[pixel].id != NO_HIT
    }

    /// The pixel's ray met a surface that the eye sees.
    pub fn lit(&self, pixel: usize) -> bool {
        self.hit(pixel) && self.surfaces[pixel].distance > 0.0
    }

    /// Estimates of the pixels that are lit.
    pub fn lit_estimates(&self) -> impl Iterator<Item = &Estimate> {
        self.estimates.iter().enumerate().filter(|(i, _)| self.lit(*i)).map(|(_, e)| e)
    }
}
