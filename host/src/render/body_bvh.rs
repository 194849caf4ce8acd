//! A body's triangles into a compressed wide BVH ([Ylitie17]) in the layout that `bvh.glsl` walks.
//!
//! The tree is built once in body space; a moving body changes only its entry in the top level.

use crate::scene::TriangleMesh;
use glam::Vec3A;
use obvhs::cwbvh::builder::build_cwbvh_from_tris;
use obvhs::triangle::Triangle;
use obvhs::BvhBuildParams;
use std::time::Duration;

/// A BVH ready for upload.
#[derive(Clone, Debug, Default)]
pub struct BodyBvh {
    /// Five words of four u32 per node; node indices are relative to this body.
    pub nodes: Vec<[u32; 4]>,
    /// Triangle of the mesh for each place in BVH order. A triangle may stand in several places.
    pub order: Vec<u32>,
}

impl BodyBvh {
    /// Builds the tree; an empty mesh gives an empty tree.
    pub fn build(mesh: &TriangleMesh) -> Self {
        if mesh.triangles.is_empty() {
            return Self::default();
        }
        let corner = |i: u32| Vec3A::from(mesh.positions[i as usize]);
        let triangles: Vec<Triangle> = mesh
            .triangles
            .iter()
            .map(|t| Triangle { v0: corner(t[0]), v1: corner(t[1]), v2: corner(t[2]) })
            .collect();
        let mut parameters = BvhBuildParams::medium_build();
        parameters.max_prims_per_leaf = 3;
        let bvh = build_cwbvh_from_tris(&triangles, parameters, &mut Duration::default());
        let nodes = bytemuck::cast_slice(&bvh.nodes).to_vec();
        Self { nodes, order: bvh.primitive_indices }
    }
}
