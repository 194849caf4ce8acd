//! What submissions read.

use super::memory::SharedBuffers;
use super::scene_gpu::SceneGpu;
use crate::gpu::{BindingTable, ComputePipeline, Overlap};
use std::sync::Arc;

/// What submissions read. The renderer and every slot hold it, so it is freed after the last submission has ended, in whatever order they are
/// dropped.
pub(super) struct Resources {
    // Dropped before the buffers that they use.
    /// One for each row of [`super::passes::TABLE`]; `None`: the method does not need the pass, which is not recorded.
    pub(super) pipelines: Vec<Option<ComputePipeline>>,
    pub(super) table: Arc<BindingTable>,
    pub(super) shared: SharedBuffers,
    pub(super) scene: SceneGpu,
    /// The order of frames that share the device; `None`: each begins when the one before has ended.
    pub(super) overlap: Option<Overlap>,
}
