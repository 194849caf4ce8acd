//! Texels that a KTX2 image stores one after the other, 8 bits a channel.

use ktx2::Format;

use super::super::super::SceneError;
use super::Content;

/// Where the channels of a texel lie.
pub(super) struct Layout {
    /// Bytes of a texel.
    bytes: usize,
    /// The byte of red, green and blue.
    rgb: [usize; 3],
    /// The byte of alpha; without one, texels are opaque.
    alpha: Option<usize>,
}

impl Layout {
    /// The layout of a format with three or four channels of 8 bits, 0 to 255.
    pub(super) fn of(format: Format) -> Option<Self> {
        let (rgb, alpha) = match format {
            Format::R8G8B8_UNORM | Format::R8G8B8_SRGB => ([0, 1, 2], None),
            Format::B8G8R8_UNORM | Format::B8G8R8_SRGB => ([2, 1, 0], None),
            Format::R8G8B8A8_UNORM | Format::R8G8B8A8_SRGB => ([0, 1, 2], Some(3)),
            Format::B8G8R8A8_UNORM | Format::B8G8R8A8_SRGB => ([2, 1, 0], Some(3)),
            _ => return None,
        };
        Some(Self { bytes: 3 + usize::from(alpha.is_some()), rgb, alpha })
    }

    /// Every texel, row by row from the top.
    pub(super) fn texels(&self, content: &Content) -> Result<Vec<[u8; 4]>, SceneError> {
        let stored = content.bytes(content.size.texels() * self.bytes)?;
        let texel = |t: &[u8]| {
            let [r, g, b] = self.rgb.map(|k| t[k]);
            [r, g, b, self.alpha.map_or(255, |k| t[k])]
        };
        Ok(stored.chunks_exact(self.bytes).map(texel).collect())
    }
}
