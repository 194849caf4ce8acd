//! Limits on what a file may request, checked before anything of that size is allocated, and the flag that stops a
//! load.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

use super::SceneError;

/// Limits on one scene file. The defaults fit the largest scenes that a projector raster can make use of.
#[derive(Clone, Debug, PartialEq)]
pub struct Limits {
    /// Bytes of any one file, and of all buffers together.
    pub bytes: u64,
    /// Bytes of JSON text.
    pub json_bytes: u64,
    /// JSON values (numbers, strings, lists, objects): each costs some tens of bytes of memory.
    pub json_values: u64,
    /// Nodes, meshes, materials, accessors and so on: entries in any one list at the top of the file.
    pub objects: u64,
    /// Triangles after every instance of a mesh is expanded; for a short file fewer: a million, plus one for every three
    /// bytes.
    pub triangles: u64,
    /// Texels of all decoded textures together.
    pub texels: u64,
    /// Texels along one side of a texture.
    pub texture_side: u32,
    /// Levels of the node tree.
    pub node_depth: u32,
    /// Punctual lights after instancing.
    pub lights: u64,
    /// Time that loading may take.
    pub time: Duration,
    /// Bytes that the file has with its buffers; set where it is read, and 0 before. Pictures of more texels need longer files.
    pub file_bytes: u64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            bytes: 1 << 30,
            json_bytes: 32 << 20,
            json_values: 4_000_000,
            objects: 1_000_000,
            triangles: 20_000_000,
            texels: 64_000_000,
            texture_side: 16_384,
            node_depth: 256,
            lights: 1024,
            time: Duration::from_secs(30),
            file_bytes: 0,
        }
    }
}

/// Bytes that one piece of memory may have for a file of `bytes`: short files of great pictures are refused before anything is
/// taken for them, and the longest that are honest have fewer than sixteen for each of theirs.
pub(crate) const fn largest_piece(bytes: u64) -> u64 {
    64_000_000 + 16 * bytes
}

/// What a decoder of pictures may take before the size of its picture is known: a profile of colours or a text of a PNG may
/// claim any length.
pub(crate) fn of_header() -> image::Limits {
    let mut memory = image::Limits::default();
    memory.max_alloc = Some(16 << 20);
    memory
}

/// What a decoder may take for a picture of these sides, of which a texel takes at most `texel_bytes`, and `allowed` bytes are
/// the largest piece. The rest is room for tables.
pub(crate) fn of_picture(
    format: image::ImageFormat,
    [width, height]: [u32; 2],
    texel_bytes: u64,
    allowed: u64,
) -> image::Limits {
    // A TIFF is unpacked by strips, of which one may be the whole; what a PNG takes beside its texels is for profiles.
    let pieces = if format == image::ImageFormat::Png { 1 } else { 2 };
    let mut memory = image::Limits::default();
    memory.max_image_width = Some(width);
    memory.max_image_height = Some(height);
    let texels = u64::from(width) * u64::from(height);
    memory.max_alloc = Some((texels * texel_bytes).min(pieces * allowed) + (16 << 20));
    memory
}

impl Limits {
    /// The limits for a file of `bytes` bytes in all. Triangles cost time, and a short file may request any number of
    /// them by instances of a mesh: a million are free, and more need bytes in the file. Three corners of 16 bytes each leave
    /// 16 MB of [`largest_piece`].
    pub(crate) fn of_file(&self, bytes: u64) -> Self {
        Self { triangles: self.triangles.min(1_000_000 + bytes / 3), file_bytes: bytes, ..self.clone() }
    }
}

/// Stops a running load. The load checks it between pieces of work, so it ends soon after its time is up.
#[derive(Clone, Debug, Default)]
pub(crate) struct Cancel(Arc<AtomicBool>);

impl Cancel {
    /// Asks the load to stop.
    pub(crate) fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// An error once a stop was requested.
    pub(crate) fn check(&self, limits: &Limits) -> Result<(), SceneError> {
        if self.0.load(Ordering::Relaxed) {
            return Err(SceneError::TimedOut(limits.time));
        }
        Ok(())
    }
}
