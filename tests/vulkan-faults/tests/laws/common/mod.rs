//! A small picture of the demo's scene, frame by frame, on a device with the layer before it.
#![allow(dead_code)]

use dpm_device::planes::Raster;
use dpm_render::gpu::{validation_messages, Gpu, GpuError, GpuOptions};
use dpm_render::{FrameInputs, FrameSlot, RenderError, Renderer};
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::pipeline::renderer_settings;
use dpm_rig::rig::{affine, Rig};
use glam::{DAffine3, DVec3};
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use vulkan_faults::{in_this_process, Layer, Session};

pub(crate) const WIDTH: u32 = 48;
pub(crate) const HEIGHT: u32 = 32;
/// Long enough for software Vulkan that translates shaders on a busy machine.
pub(crate) const PATIENCE_NS: u64 = 120_000_000_000;
/// What a bound of this program may be exceeded by on a machine that does other things too.
pub(crate) const SLACK: Duration = Duration::from_secs(3);

/// The layer, for one test at a time.
pub(crate) fn layer(plan: &str) -> Session {
    let layer: &'static Layer = in_this_process();
    layer.plan(plan)
}

pub(crate) fn options() -> GpuOptions {
    GpuOptions { validation: true, ..GpuOptions::default() }
}

/// Validation looks at everything that goes through the layer.
pub(crate) fn assert_no_validation_messages() {
    let (count, texts) = validation_messages();
    assert_eq!(count, 0, "Vulkan validation reported:\n{}", texts.join("\n"));
}

pub(crate) fn rig() -> &'static Rig {
    static RIG: OnceLock<Rig> = OnceLock::new();
    RIG.get_or_init(|| {
        let config = RigConfig::demo(&Overrides::default()).unwrap_or_else(|e| panic!("{e}"));
        Rig::build(&config, Raster::new(WIDTH, HEIGHT)).unwrap_or_else(|e| panic!("{e}"))
    })
}

/// A device, a renderer and a slot.
pub(crate) struct Bench {
    // In an order in which none could be dropped before those that use it: they must not mind.
    pub renderer: Renderer,
    pub slot: FrameSlot,
    pub gpu: Arc<Gpu>,
}

impl Bench {
    pub(crate) fn open() -> Self {
        let gpu = Gpu::open(&options()).unwrap_or_else(|e| panic!("this test needs Vulkan: {e}"));
        Self::on(gpu).unwrap_or_else(|e| panic!("{e}"))
    }

    pub(crate) fn on(gpu: Arc<Gpu>) -> Result<Self, RenderError> {
        let renderer = Renderer::new(&gpu, &rig().scene, renderer_settings(rig()))?;
        let slot = renderer.create_slot(true)?;
        Ok(Self { renderer, slot, gpu })
    }

    /// Starts a frame: bodies move with its number.
    pub(crate) fn submit(&mut self, frame: u32) -> Result<(), GpuError> {
        submit(&mut self.renderer, &mut self.slot, frame)
    }

    /// A whole frame.
    pub(crate) fn frame(&mut self, frame: u32) -> Result<Vec<u32>, GpuError> {
        self.submit(frame)?;
        self.slot.wait(PATIENCE_NS)?;
        Ok(self.slot.codes().to_vec())
    }
}

pub(crate) fn submit(renderer: &mut Renderer, slot: &mut FrameSlot, frame: u32) -> Result<(), GpuError> {
    let rig = rig();
    let along = DAffine3::from_translation(DVec3::X * 5e-4 * f64::from(frame));
    let tracked: Vec<_> = rig.bodies.iter().map(|b| along * affine(&b.rest)).collect();
    let mut poses = Vec::new();
    rig.scene_poses(&tracked, 0, &mut poses);
    let still = FrameInputs::new(&rig.camera, rig.observer.eye_and_gaze(&tracked), &poses);
    renderer.submit(slot, &FrameInputs { frame, spp: 2, budget_spp: 2.0, ..still })
}

/// The first frames as a device without faults makes them.
pub(crate) fn clean() -> &'static [Vec<u32>] {
    static CLEAN: OnceLock<Vec<Vec<u32>>> = OnceLock::new();
    CLEAN.get_or_init(|| {
        let mut bench = Bench::open();
        let frames: Vec<_> = (0..8).map(|i| bench.frame(i).unwrap_or_else(|e| panic!("{e}"))).collect();
        assert!(frames.iter().all(|f| f.iter().any(|&code| code != 0)), "there is something to be seen");
        frames
    })
}

/// Names of the threads of this process, without those of the tests themselves, which come and go.
pub(crate) fn threads() -> Vec<String> {
    let tasks = std::fs::read_dir("/proc/self/task").into_iter().flatten().filter_map(Result::ok);
    let name = |task: std::fs::DirEntry| std::fs::read_to_string(task.path().join("comm")).ok();
    // Tests are named with underscores, and so is their program.
    let mut names: Vec<_> = tasks.filter_map(name).filter(|name| !name.contains('_')).collect();
    names.sort();
    names
}
