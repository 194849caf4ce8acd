//! What submissions read.

use super::memory::SharedBuffers;
use super::scene_gpu::SceneGpu;
use crate::gpu::{BindingTable, ComputePipeline};
use std::sync::Arc;

/// What submissions read, held by the renderer and by every slot: it goes when the last submission is over, in whatever order they are
/// dropped.
pub(super) struct Resources {
    // Dropped before the buffers they use.
    /// One a row of [`super::passes::TABLE`]; `None`: the method does not need it and it is not recorded.
    pub(super) pipelines: Vec<Option<ComputePipeline>>,
    pub(super) table: Arc<BindingTable>,
    pub(super) shared: SharedBuffers,
    pub(super) scene: SceneGpu,
}
