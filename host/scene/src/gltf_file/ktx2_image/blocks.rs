//! Blocks of 4 x 4 texels as graphics cards take them: BC1, BC2, BC3 and BC7. ASTC is decoded in [`super::basis`].

use ktx2::Format;

use super::super::super::SceneError;
use super::Content;

/// Texels along each side of a block.
const SIDE: usize = 4;

/// Writes the 16 texels of a block as RGBA; the last argument is the distance of their rows in bytes.
type Decode = fn(&[u8], &mut [u8], usize);

/// A format of blocks.
pub(super) struct Block {
    /// Bytes of a block.
    bytes: usize,
    decode: Decode,
    /// Alpha counts; otherwise texels are opaque.
    alpha: bool,
}

/// True for ASTC of low dynamic range in flat blocks: the formats 157 to 184 of Vulkan.
pub(super) fn is_astc(format: Format) -> bool {
    (Format::ASTC_4x4_UNORM_BLOCK..=Format::ASTC_12x12_SRGB_BLOCK).contains(&format)
}

impl Block {
    /// The format of blocks with three or four channels of 8 bits.
    pub(super) fn of(format: Format) -> Option<Self> {
        let (bytes, decode, alpha): (_, Decode, _) = match format {
            Format::BC1_RGB_UNORM_BLOCK | Format::BC1_RGB_SRGB_BLOCK => (8, bcdec_rs::bc1, false),
            Format::BC1_RGBA_UNORM_BLOCK | Format::BC1_RGBA_SRGB_BLOCK => (8, bcdec_rs::bc1, true),
            Format::BC2_UNORM_BLOCK | Format::BC2_SRGB_BLOCK => (16, bcdec_rs::bc2, true),
            Format::BC3_UNORM_BLOCK | Format::BC3_SRGB_BLOCK => (16, bcdec_rs::bc3, true),
            Format::BC7_UNORM_BLOCK | Format::BC7_SRGB_BLOCK => (16, bcdec_rs::bc7, true),
            _ => return None,
        };
        Some(Self { bytes, decode, alpha })
    }

    /// Every texel, row by row from the top. Blocks at the right and at the bottom may reach beyond the picture.
    pub(super) fn texels(&self, content: &Content) -> Result<Vec<[u8; 4]>, SceneError> {
        let (width, height) = (content.size.width as usize, content.size.height as usize);
        let across = width.div_ceil(SIDE);
        let stored = content.bytes(across * height.div_ceil(SIDE) * self.bytes)?;
        let mut texels = vec![[0; 4]; content.size.texels()];
        let mut square = [[0; 4]; SIDE * SIDE];
        for (i, block) in stored.chunks_exact(self.bytes).enumerate() {
            (self.decode)(block, bytemuck::cast_slice_mut(&mut square), SIDE * 4);
            if !self.alpha {
                square.iter_mut().for_each(|texel| texel[3] = 255);
            }
            let (left, top) = (i % across * SIDE, i / across * SIDE);
            let visible = SIDE.min(width - left);
            for (y, row) in square.chunks_exact(SIDE).enumerate().take(height - top) {
                let start = (top + y) * width + left;
                texels[start..start + visible].copy_from_slice(&row[..visible]);
            }
        }
        Ok(texels)
    }
}
