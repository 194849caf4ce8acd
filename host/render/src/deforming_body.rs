//! A body that an animation deforms, as a scene's tables know it.

use dpm_scene::bvh::{BodyBvh, Refit};
use dpm_scene::DeformingMesh;
use std::sync::Arc;

/// A body that deforms, and where its rows lie in the tables of the scene.
#[derive(Clone, Debug)]
pub struct DeformingBody {
    /// Number of the body.
    pub(super) body: usize,
    pub(super) mesh: Arc<DeformingMesh>,
    pub(super) refit: Refit,
    /// First row of four words in the nodes, and how many.
    pub(super) nodes: [usize; 2],
    /// First triangle, and how many.
    pub(super) triangles: [usize; 2],
    /// First vertex, and how many.
    pub(super) vertices: [usize; 2],
}

impl DeformingBody {
    /// Body number `body` with the tree `bvh`, whose rows begin at these nodes, triangles and vertices.
    pub(super) fn new(
        (body, mesh, bvh): (usize, &Arc<DeformingMesh>, &BodyBvh),
        [node, triangle, vertex]: [usize; 3],
        vertices: usize,
    ) -> Self {
        Self {
            body,
            mesh: mesh.clone(),
            refit: Refit::new(bvh),
            nodes: [5 * node, bvh.nodes.len()],
            triangles: [triangle, bvh.order.len()],
            vertices: [vertex, vertices],
        }
    }
}
