//! Blocks of 4 x 4 texels as graphics cards take them: BC1 to BC7, here, and ETC2 and EAC by [`super::etc`]. ASTC is
//! decoded in [`super::basis`].

use ktx2::Format;

use super::numbers::raised;
use super::{etc, Ktx2Error, LevelContent};
use dpm_common::rounding::Rounder;

/// Texels along each side of a block.
const SIDE: usize = 4;

/// The texels of a block, row by row from the top.
pub(crate) type Square = [[u8; 4]; SIDE * SIDE];

/// The texels of a block. A channel that is not stored is 0, and alpha is 1.
type Decode = fn(&[u8], &mut Rounder) -> Square;

/// A format of blocks.
pub(crate) struct BlockFormat {
    /// Bytes of a block.
    bytes: usize,
    decode: Decode,
    /// Channels, 1 to 4, beginning with red.
    pub channels: usize,
}

/// True for ASTC of low dynamic range in flat blocks: the formats 157 to 184 of Vulkan.
pub(crate) fn is_astc(format: Format) -> bool {
    (Format::ASTC_4x4_UNORM_BLOCK..=Format::ASTC_12x12_SRGB_BLOCK).contains(&format)
}

impl BlockFormat {
    /// The format of blocks with this name.
    pub(crate) fn of(format: Format) -> Option<Self> {
        let (bytes, channels, decode): (_, _, Decode) = match format {
            Format::BC1_RGB_UNORM_BLOCK | Format::BC1_RGB_SRGB_BLOCK => {
                (8, 3, |b, _| opaque(bcdec_rs::bc1, b))
            }
            Format::BC1_RGBA_UNORM_BLOCK | Format::BC1_RGBA_SRGB_BLOCK => {
                (8, 4, |b, _| rgba(bcdec_rs::bc1, b))
            }
            Format::BC2_UNORM_BLOCK | Format::BC2_SRGB_BLOCK => (16, 4, |b, _| rgba(bcdec_rs::bc2, b)),
            Format::BC3_UNORM_BLOCK | Format::BC3_SRGB_BLOCK => (16, 4, |b, _| rgba(bcdec_rs::bc3, b)),
            Format::BC4_UNORM_BLOCK => (8, 1, |b, rounder| bc4(b, false, rounder)),
            Format::BC4_SNORM_BLOCK => (8, 1, |b, rounder| bc4(b, true, rounder)),
            Format::BC5_UNORM_BLOCK => (16, 2, |b, rounder| bc5(b, false, rounder)),
            Format::BC5_SNORM_BLOCK => (16, 2, |b, rounder| bc5(b, true, rounder)),
            Format::BC6H_UFLOAT_BLOCK => (16, 3, |b, rounder| bc6h(b, false, rounder)),
            Format::BC6H_SFLOAT_BLOCK => (16, 3, |b, rounder| bc6h(b, true, rounder)),
            Format::BC7_UNORM_BLOCK | Format::BC7_SRGB_BLOCK => (16, 4, |b, _| rgba(bcdec_rs::bc7, b)),
            _ => return Self::of_etc(format),
        };
        Some(Self { bytes, decode, channels })
    }

    /// The format of blocks with this name, of ETC2 and EAC.
    fn of_etc(format: Format) -> Option<Self> {
        let (bytes, channels, decode): (_, _, Decode) = match format {
            Format::ETC2_R8G8B8_UNORM_BLOCK | Format::ETC2_R8G8B8_SRGB_BLOCK => (8, 3, |b, _| etc::rgb8(b)),
            Format::ETC2_R8G8B8A1_UNORM_BLOCK | Format::ETC2_R8G8B8A1_SRGB_BLOCK => {
                (8, 4, |b, _| etc::rgb8a1(b))
            }
            Format::ETC2_R8G8B8A8_UNORM_BLOCK | Format::ETC2_R8G8B8A8_SRGB_BLOCK => {
                (16, 4, |b, _| etc::rgba8(b))
            }
            Format::EAC_R11_UNORM_BLOCK => (8, 1, |b, rounder| etc::r11(b, false, rounder)),
            Format::EAC_R11_SNORM_BLOCK => (8, 1, |b, rounder| etc::r11(b, true, rounder)),
            Format::EAC_R11G11_UNORM_BLOCK => (16, 2, |b, rounder| etc::rg11(b, false, rounder)),
            Format::EAC_R11G11_SNORM_BLOCK => (16, 2, |b, rounder| etc::rg11(b, true, rounder)),
            _ => return None,
        };
        Some(Self { bytes, decode, channels })
    }

    /// Every texel, row by row from the top. Blocks at the right and at the bottom may reach beyond the picture.
    pub(crate) fn texels(
        &self,
        content: &LevelContent,
        rounder: &mut Rounder,
    ) -> Result<Vec<[u8; 4]>, Ktx2Error> {
        let (width, height) = (content.size.width as usize, content.size.height as usize);
        let across = width.div_ceil(SIDE);
        let stored = content.bytes(across * height.div_ceil(SIDE) * self.bytes)?;
        let mut texels = vec![[0; 4]; content.size.texels()];
        for (i, block) in stored.chunks_exact(self.bytes).enumerate() {
            let square = (self.decode)(block, rounder);
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

/// Writes the 16 texels of a block as RGBA; the last argument is the distance of their rows in bytes.
type Write = fn(&[u8], &mut [u8], usize);

fn rgba(write: Write, block: &[u8]) -> Square {
    let mut square = [[0; 4]; SIDE * SIDE];
    write(block, bytemuck::cast_slice_mut(&mut square), SIDE * 4);
    square
}

fn opaque(write: Write, block: &[u8]) -> Square {
    rgba(write, block).map(|[r, g, b, _]| [r, g, b, 255])
}

fn bc4(block: &[u8], signed: bool, rounder: &mut Rounder) -> Square {
    let mut numbers = [0.0; SIDE * SIDE];
    bcdec_rs::bc4_float(block, &mut numbers, SIDE, signed);
    numbers.map(|red| [rounder.byte(fraction(red, signed)), 0, 0, 255])
}

fn bc5(block: &[u8], signed: bool, rounder: &mut Rounder) -> Square {
    let mut numbers = [[0.0; 2]; SIDE * SIDE];
    bcdec_rs::bc5_float(block, bytemuck::cast_slice_mut(&mut numbers), SIDE * 2, signed);
    numbers.map(|texel| {
        let [red, green] = texel.map(|number| rounder.byte(fraction(number, signed)));
        [red, green, 0, 255]
    })
}

/// A number of BC4 or BC5 as 0 to 1, also with a sign.
fn fraction(number: f32, signed: bool) -> f32 {
    if signed {
        raised(number)
    } else {
        number
    }
}

/// These are light, with or without a sign, not directions: what is below 0 is cut off.
fn bc6h(block: &[u8], signed: bool, rounder: &mut Rounder) -> Square {
    let mut numbers = [[0.0; 3]; SIDE * SIDE];
    bcdec_rs::bc6h_float(block, bytemuck::cast_slice_mut(&mut numbers), SIDE * 3, signed);
    numbers.map(|texel| {
        let [r, g, b] = texel.map(|number| rounder.byte(number));
        [r, g, b, 255]
    })
}
