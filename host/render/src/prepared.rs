//! A scene and its passes on a device: the part of a renderer that takes long to make, and that its frames only read.

use super::plan::{Pipelines, RendererPlan};
use super::scene_gpu::SceneGpu;
use crate::gpu::{Gpu, GpuError};
use dpm_shaders::Reading;
use std::sync::Arc;

/// A scene that was uploaded and passes that were compiled, for renderers that take over from each other on one device
/// ([`crate::Renderer::from_prepared`]). Cheap to clone.
#[derive(Clone)]
pub struct PreparedScene {
    pub(super) gpu: Arc<Gpu>,
    pub(super) plan: RendererPlan,
    pub(super) reading: Reading,
    pub(super) pipelines: Arc<Pipelines>,
    scene: Arc<SceneGpu>,
}

impl PreparedScene {
    /// Uploads the scene of `plan` and compiles the passes that it needs.
    ///
    /// # Errors
    /// The scene is too large for this device, or the GPU's own.
    pub(super) fn new(gpu: &Arc<Gpu>, plan: &RendererPlan) -> Result<Self, GpuError> {
        let reading = plan.reading(gpu.summary())?;
        let scene =
            Arc::new(SceneGpu::new(gpu, &plan.data, reading, plan.layout_apart(gpu, reading).is_ok())?);
        let pipelines = Arc::new(plan.pipelines(gpu, reading)?);
        Ok(Self { gpu: gpu.clone(), plan: plan.clone(), reading, pipelines, scene })
    }

    /// The scene for another renderer. The pictures of other programs are copied into it while frames are drawn, and each renderer has its own
    /// account of them, so such a scene is uploaded for each.
    ///
    /// # Errors
    /// The GPU's own.
    pub(super) fn for_another(&self) -> Result<Self, GpuError> {
        if self.plan.data.live.is_empty() {
            return Ok(self.clone());
        }
        let scene = Arc::new(SceneGpu::new(
            &self.gpu,
            &self.plan.data,
            self.reading,
            self.pipelines.apart.is_some(),
        )?);
        Ok(Self { scene, ..self.clone() })
    }

    /// The scene's buffers.
    pub(super) fn scene(&self) -> &Arc<SceneGpu> {
        &self.scene
    }

    /// The device on which it lies.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// What it was made from, to make it again on another device.
    pub fn plan(&self) -> &RendererPlan {
        &self.plan
    }
}
