//! Bodies that an animation deforms: in every frame the host moves their vertices, fits their trees to them, and hands both to
//! the frame's own tables.

use super::deforming_body::DeformingBody;
use super::scene_data::{BodyData, SceneData};
use super::scene_gpu::Geometry;
use crate::gpu::{Buffer, Gpu, GpuError, MemoryKind, Recorder};
use bytemuck::{bytes_of, cast_slice};
use dpm_scene::horizon::CLOSED;
use dpm_scene::Deformed;
use dpm_shaders::structs::{TriangleRef, Vertex};
use dpm_shaders::Reading;
use glam::Vec3;
use std::sync::Arc;

/// The tables of a frame in flight whose scene has bodies that deform.
pub(super) struct DeformedTables {
    /// Those of the scene, of which the frame changes the rows of bodies that deform.
    pub geometry: Geometry,
    bodies: Vec<OfBody>,
}

/// What the host writes of a body.
struct OfBody {
    of: DeformingBody,
    now: Deformed,
    /// Its tree, which is fitted in the host's own memory: that of the buffers is slow to read.
    tree: Vec<[u32; 4]>,
    nodes: Buffer,
    triangles: Buffer,
    vertices: Buffer,
}

impl DeformedTables {
    /// The tables of `data`, for shaders that read them in this way; `None` if nothing deforms.
    ///
    /// # Errors
    /// Out of memory.
    pub(super) fn new(gpu: &Arc<Gpu>, data: &SceneData, reading: Reading) -> Result<Option<Self>, GpuError> {
        if data.deforming.is_empty() {
            return Ok(None);
        }
        let upload = |what, bytes: usize| Buffer::new(gpu, what, bytes.max(16), MemoryKind::Upload);
        let of_body = |of: &DeformingBody| {
            let ([first, nodes], [_, triangles], [_, vertices]) = (of.nodes, of.triangles, of.vertices);
            // Its first use makes the room that it needs.
            let mut now = Deformed::default();
            of.mesh.at(0, &mut now);
            Ok(OfBody {
                of: of.clone(),
                now,
                tree: data.nodes[first..first + nodes].to_vec(),
                nodes: upload("BVH nodes of a body that deforms", 16 * nodes)?,
                triangles: upload("triangles of a body that deforms", 48 * triangles)?,
                vertices: upload("vertices of a body that deforms", size_of::<Vertex>() * vertices)?,
            })
        };
        let bodies = data.deforming.iter().map(of_body).collect::<Result<_, GpuError>>()?;
        Ok(Some(Self { geometry: Geometry::new(gpu, data, reading, false)?, bodies }))
    }

    /// Deforms the bodies as at `t_ns`, and changes their bounds in `bounds`, one entry for each body of the scene. It
    /// allocates nothing.
    pub(super) fn write(&mut self, data: &SceneData, t_ns: i64, bounds: &mut [BodyData]) {
        for OfBody { of, now, tree, nodes, triangles, vertices } in &mut self.bodies {
            of.mesh.at(t_ns, now);
            let (first_vertex, first) = (of.vertices[0], of.triangles[0]);
            let refs = &data.refs[first..first + of.triangles[1]];
            let corners = |r: &TriangleRef| r.vertices.map(|v| now.positions[v as usize - first_vertex]);
            for (row, r) in triangles.bytes_mut().chunks_exact_mut(48).zip(refs) {
                let rows = corners(r).map(|p| [p.x.to_bits(), p.y.to_bits(), p.z.to_bits()]);
                let [a, b, c]: [[u32; 4]; 3] =
                    std::array::from_fn(|i| [rows[i][0], rows[i][1], rows[i][2], CLOSED[i]]);
                row.copy_from_slice(cast_slice(&[a, b, c]));
            }
            let rest = &data.vertices[first_vertex..first_vertex + of.vertices[1]];
            let rows = vertices.bytes_mut().chunks_exact_mut(size_of::<Vertex>());
            for ((row, rest), (normal, tangent)) in rows.zip(rest).zip(now.normals.iter().zip(&now.tangents))
            {
                let vertex = Vertex { normal: (*normal).into(), tangent: (*tangent).into(), ..*rest };
                row.copy_from_slice(bytes_of(&vertex));
            }
            let [lower, upper] = of.refit.run(tree, |place| corners(&refs[place]));
            nodes.bytes_mut()[..16 * tree.len()].copy_from_slice(cast_slice(tree));
            let body = &mut bounds[of.body];
            if lower.cmple(upper).all() {
                (body.bounds_min, body.bounds_max) = (lower, upper);
                body.extent = Vec3::max(lower.abs(), upper.abs()).max_element();
            }
        }
    }

    /// Records the copies of what the host has written to the frame's tables.
    pub(super) fn record(&self, r: &mut Recorder<'_>) {
        let Geometry { nodes, triangles, vertices, .. } = &self.geometry;
        for body in &self.bodies {
            let of = &body.of;
            r.copy_to(&body.nodes, nodes, 16 * of.nodes[1], 16 * of.nodes[0]);
            r.copy_to(&body.triangles, triangles, 48 * of.triangles[1], 48 * of.triangles[0]);
            let size = size_of::<Vertex>();
            r.copy_to(&body.vertices, vertices, size * of.vertices[1], size * of.vertices[0]);
        }
    }
}
