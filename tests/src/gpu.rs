//! Frames drawn by the GPU under validation, as plain numbers.

use crate::statistics::Estimate;
use dpm_host::geometry::projector::ProjectorCamera;
use dpm_host::gpu::{validation_messages, Gpu, GpuOptions};
use dpm_host::render::method::Method;
use dpm_host::render::{FrameInputs, Renderer, RendererSettings};
use dpm_host::scene::Scene;
use dpm_shaders::structs::{Counters, Surface, NO_HIT};
use glam::{DAffine3, DVec3};
use std::sync::Arc;

/// Longest that one small frame may take on the slowest machine.
const TIMEOUT_NS: u64 = 120_000_000_000;

/// Opens the GPU with validation and synchronisation validation, runs the test, closes the GPU, and demands that validation said nothing.
///
/// # Panics
/// Without a Vulkan driver (with the advice that `dpm doctor` gives), and when validation reported anything.
pub fn with_gpu(test: impl FnOnce(&Arc<Gpu>)) {
    let gpu = Gpu::open(&GpuOptions { validation: true, device: None })
        .unwrap_or_else(|e| panic!("this test needs Vulkan: {e}"));
    test(&gpu);
    drop(gpu);
    let (count, texts) = validation_messages();
    assert_eq!(count, 0, "Vulkan validation reported:\n{}", texts.join("\n"));
}

/// What to draw.
#[derive(Clone)]
pub struct Shot<'a> {
    /// Scene.
    pub scene: &'a Scene,
    /// Projector, or camera when there is no eye.
    pub camera: ProjectorCamera,
    /// Where the light is wanted; `None`: back along the rays, everything is lit.
    pub eye: Option<DVec3>,
    /// Poses of the bodies; empty: at rest.
    pub poses: Vec<DAffine3>,
    /// Lost tracked bodies.
    pub lost: Vec<bool>,
    /// Samples per pixel and frame.
    pub spp: u32,
    /// Frames, each with its own random numbers; the estimates' variances come from them.
    pub frames: u32,
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
}

impl<'a> Shot<'a> {
    /// One frame of 16 samples at depth 4 with an ordinary camera.
    pub fn new(scene: &'a Scene, camera: ProjectorCamera) -> Self {
        Self {
            scene,
            camera,
            eye: None,
            poses: Vec::new(),
            lost: Vec::new(),
            spp: 16,
            frames: 1,
            depth: 4,
            seed: 1,
            clamp_indirect: None,
            drive_gain: 1.0,
            ambient: [0.0; 3],
            leave_nothing_out: false,
        }
    }

    /// Poses in use.
    pub fn world_from_body(&self) -> Vec<DAffine3> {
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
            depth: self.depth,
            seed: self.seed,
            clamp_indirect: self.clamp_indirect,
            drive_gain: self.drive_gain,
            ambient: self.ambient,
            camera_is_eye: self.eye.is_none(),
            leave_nothing_out: self.leave_nothing_out,
            method: Method::full(self.spp),
        }
    }

    /// Draws it.
    pub fn draw(&self, gpu: &Arc<Gpu>) -> Picture {
        let mut renderer = Renderer::new(gpu, self.scene, self.settings()).expect("the scene fits the GPU");
        let mut slot = renderer.create_slot(true).expect("memory for a small frame");
        let poses = self.world_from_body();
        let eye = self.eye.unwrap_or(self.camera.position());
        let mut picture = Picture::default();
        for frame in 0..self.frames {
            let inputs = FrameInputs {
                frame,
                spp: self.spp,
                budget_spp: self.spp as f32,
                camera: &self.camera,
                eye,
                gaze: eye,
                poses: &poses,
                lost: &self.lost,
            };
            renderer.submit(&mut slot, &inputs).expect("submit");
            let cost = slot.wait(TIMEOUT_NS).expect("the frame ends");
            let radiance = slot.radiance().expect("a debug slot");
            picture.estimates.resize(radiance.len(), Estimate::default());
            for (estimate, r) in picture.estimates.iter_mut().zip(radiance) {
                estimate.add([f64::from(r[0]), f64::from(r[1]), f64::from(r[2])]);
            }
            picture.counters.push(cost.counters());
            if frame + 1 == self.frames {
                picture.surfaces = slot.surfaces().expect("a debug slot").to_vec();
                picture.radiance = radiance.to_vec();
                picture.codes = slot.codes().to_vec();
            }
        }
        picture
    }
}

/// What came back.
#[derive(Clone, Debug, Default)]
pub struct Picture {
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

impl Picture {
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
