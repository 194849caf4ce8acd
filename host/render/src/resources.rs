//! What submissions read.

use super::apart::WalkCrew;
use super::memory::SharedBuffers;
use super::plan::Pipelines;
use super::scene_gpu::SceneGpu;
use crate::gpu::Overlap;
use std::sync::Arc;

/// What submissions read. The renderer and every slot hold it, so it is freed after the last submission has ended, in whatever order they are
/// dropped.
pub(super) struct Resources {
    /// Walks the rays of frames, if the host does that.
    pub(super) crew: Option<WalkCrew>,
    // Dropped before the buffers that they use.
    pub(super) pipelines: Arc<Pipelines>,
    pub(super) shared: SharedBuffers,
    pub(super) scene: Arc<SceneGpu>,
    /// The order of frames that share the device; `None`: each begins when the one before has ended.
    pub(super) overlap: Option<Overlap>,
}
