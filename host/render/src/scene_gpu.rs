//! A scene's flat arrays into GPU buffers.

use super::scene_data::SceneData;
use crate::gpu::{triangle_buffer, BodyTrees, Buffer, Gpu, GpuError, MemoryKind};
use bytemuck::cast_slice;
use dpm_scene::LinearTexel;
use dpm_shaders::Reading;
use std::borrow::Cow;
use std::sync::Arc;

/// The buffers of one scene; immutable after creation.
pub(crate) struct SceneGpu {
    /// Where nothing deforms; elsewhere each frame in flight has its own.
    pub(super) geometry: Geometry,
    pub(super) refs: Buffer,
    pub(super) materials: Buffer,
    pub(super) textures: Buffer,
    pub(super) texels: Buffer,
    pub(super) lights: Buffer,
    pub(super) environment: Buffer,
    pub(super) albedo: Buffer,
}

/// The tables that change when a body deforms.
pub(super) struct Geometry {
    pub(super) nodes: Buffer,
    pub(super) triangles: Buffer,
    pub(super) vertices: Buffer,
    /// The trees in which the device finds what a ray meets; `None`: the shaders walk through the nodes.
    pub(super) trees: Option<BodyTrees>,
}

/// A table of whole rows of four words, for either way of reading it.
fn rows(
    gpu: &Arc<Gpu>,
    reading: Reading,
    what: &str,
    words: &[[u32; 4]],
    float: bool,
) -> Result<Buffer, GpuError> {
    // Buffers cannot be empty; what pads them is never read.
    let words = if words.is_empty() { &PADDING[..] } else { words };
    if reading == Reading::Texels {
        Buffer::texels(gpu, what, words, float)
    } else {
        Buffer::from_slice(gpu, what, words)
    }
}

/// An element of the longest row: five texels.
const PADDING: [[u32; 4]; 5] = [[0; 4]; 5];

/// The texture table of a scene, for either way of reading it.
///
/// # Errors
/// As [`Buffer::texels`].
pub(super) fn texture_table(gpu: &Arc<Gpu>, reading: Reading, data: &SceneData) -> Result<Buffer, GpuError> {
    rows(gpu, reading, "texture table", cast_slice(&data.textures), false)
}

/// The texels as rows of two.
fn pairs(texels: &[LinearTexel]) -> Cow<'_, [[u32; 4]]> {
    match bytemuck::try_cast_slice(texels) {
        Ok(rows) => Cow::from(rows),
        Err(_) => {
            texels.chunks(2).map(|c| [c[0][0], c[0][1], c[c.len() - 1][0], c[c.len() - 1][1]]).collect()
        }
    }
}

impl Geometry {
    /// Uploads the geometry of `data`, and has the device build its trees if shaders ask it for hits.
    ///
    /// # Errors
    /// Out of memory or beyond the device's limits.
    pub(super) fn new(
        gpu: &Arc<Gpu>,
        data: &SceneData,
        reading: Reading,
        host_walks: bool,
    ) -> Result<Self, GpuError> {
        let (texel, query) = (reading == Reading::Texels, reading == Reading::Query);
        let nodes = if query { &[][..] } else { &data.nodes };
        // Where the shaders of software Vulkan walk, a run is too short, and its rays too few, to be worth the time that horizons take.
        let triangles = if texel && !host_walks {
            Cow::from(&data.triangles)
        } else {
            Cow::from(data.triangles_with_horizons())
        };
        let triangles = if triangles.is_empty() { &PADDING[..] } else { &triangles };
        let rows = |what, words: &[[u32; 4]], float| rows(gpu, reading, what, words, float);
        let (triangles, trees) = if query {
            let triangles = triangle_buffer(gpu, triangles)?;
            let trees = BodyTrees::new(gpu, &triangles, &data.triangles_of_bodies())?;
            (triangles, Some(trees))
        } else {
            (rows("triangles", triangles, true)?, None)
        };
        Ok(Self {
            nodes: rows("BVH nodes", nodes, false)?,
            triangles,
            vertices: rows("vertices", cast_slice(&data.vertices), false)?,
            trees,
        })
    }
}

impl SceneGpu {
    /// Uploads `data` for shaders that read it in this way, and has the device build its trees if they ask it for hits. `host_walks`: the host of
    /// software Vulkan walks the rays, and horizons save it some.
    ///
    /// # Errors
    /// Out of memory or beyond the device's limits.
    pub(crate) fn new(
        gpu: &Arc<Gpu>,
        data: &SceneData,
        reading: Reading,
        host_walks: bool,
    ) -> Result<Self, GpuError> {
        let rows = |what, words: &[[u32; 4]], float| rows(gpu, reading, what, words, float);
        Ok(Self {
            geometry: Geometry::new(gpu, data, reading, host_walks)?,
            refs: rows("triangle indices", cast_slice(&data.refs), false)?,
            materials: rows("materials", cast_slice(&data.materials), false)?,
            textures: texture_table(gpu, reading, data)?,
            texels: rows("textures", &pairs(&data.texels), false)?,
            lights: rows("lights", cast_slice(&[&data.lights[..], &data.lamps].concat()), false)?,
            environment: rows(
                "environment map",
                cast_slice(&[&data.environment[..], &data.filtered_sky].concat()),
                false,
            )?,
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
