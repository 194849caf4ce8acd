//! A scene's flat arrays into GPU buffers.

use super::scene_data::SceneData;
use crate::gpu::{Buffer, Gpu, GpuError, MemoryKind};
use bytemuck::cast_slice;
use std::sync::Arc;

/// The buffers of one scene; immutable after creation.
pub(crate) struct SceneGpu {
    pub(super) nodes: Buffer,
    pub(super) triangles: Buffer,
    pub(super) refs: Buffer,
    pub(super) vertices: Buffer,
    pub(super) materials: Buffer,
    pub(super) textures: Buffer,
    pub(super) texels: Buffer,
    pub(super) lights: Buffer,
    pub(super) environment: Buffer,
    pub(super) albedo: Buffer,
}

impl SceneGpu {
    /// Uploads `data`. `texel`: geometry and materials through texel buffers.
    ///
    /// # Errors
    /// Out of memory or beyond the device's limits.
    pub(crate) fn new(gpu: &Arc<Gpu>, data: &SceneData, texel: bool) -> Result<Self, GpuError> {
        // Buffers cannot be empty; one element of padding is never read.
        let empty = [[0u32; 4]; 5];
        let nodes = if data.nodes.is_empty() { &empty[..] } else { &data.nodes };
        let triangles = if data.triangles.is_empty() { &empty[..] } else { &data.triangles };
        let rows = |what, words: &[[u32; 4]], float| {
            if texel {
                Buffer::texels(gpu, what, words, float)
            } else {
                Buffer::from_slice(gpu, what, words)
            }
        };
        Ok(Self {
            nodes: rows("BVH nodes", nodes, false)?,
            triangles: rows("triangles", triangles, true)?,
            refs: rows("triangle indices", cast_slice(&data.refs), false)?,
            vertices: rows("vertices", cast_slice(&data.vertices), false)?,
            materials: rows("materials", cast_slice(&data.materials), false)?,
            textures: Buffer::from_slice(gpu, "texture table", &data.textures)?,
            texels: Buffer::from_slice(gpu, "textures", &data.texels)?,
            lights: Buffer::from_slice(gpu, "lights", &data.lights)?,
            environment: Buffer::from_slice(gpu, "environment map", &data.environment)?,
            albedo: rows("albedo tables", cast_slice(&data.albedo), false)?,
        })
    }
}

/// A buffer of whole rows of four words, for either way of reading it.
pub(super) fn table_buffer(
    gpu: &Arc<Gpu>,
    what: &str,
    bytes: usize,
    kind: MemoryKind,
) -> Result<Buffer, GpuError> {
    if gpu.summary().software {
        Buffer::new_texels(gpu, what, bytes.div_ceil(16), false, kind)
    } else {
        Buffer::new(gpu, what, bytes, kind)
    }
}
