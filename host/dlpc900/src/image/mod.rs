//! Encodes 24 bit planes as the controller's compressed 24-bit image, and decodes it.
//!
//! An image is a 48-byte header and rows of 3-byte pixels, raw, run-length coded (RLE) or with copies from the line above (ERLE).
//! RLE: `n p` repeats a pixel, `0 n` and n pixels are literal, `0 0` ends a line (then padding to 4 bytes), `0 1` the image.
//! ERLE: lengths below 128 take one byte, others two (`n & 127 | 128`, `n >> 7`); `n p` repeats, `0 1 n` copies n pixels from the
//! line above, `0 n` (n > 1) and n pixels are literal, `0 0` may end a line, `0 1 0` ends the image. \[DLPU018 section 2.4.4.3.6\]
//!
//! The guide's table 2-109 calls `0 0` the end of the image; its own example 2-110 and programs in the field follow the
//! reading above.

mod decode;
mod encode;

pub use decode::{decode, ImageDecoder};
pub use encode::{encode, EncodedImage};

use dpm_device::planes::Raster;

/// Bytes of the header.
pub const HEADER_BYTES: usize = 48;
/// First four bytes of the header.
pub const SIGNATURE: [u8; 4] = *b"Spld";

/// Compression of the pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Compression {
    /// Three bytes a pixel.
    Raw = 0,
    /// Run lengths.
    Rle = 1,
    /// Run lengths and copies from the line above.
    Erle = 2,
}

impl Compression {
    /// From the header's byte.
    pub const fn from_byte(b: u8) -> Option<Self> {
        match b {
            0 => Some(Self::Raw),
            1 => Some(Self::Rle),
            2 => Some(Self::Erle),
            _ => None,
        }
    }
}

/// The order in which a pixel's three bytes hold planes 0-7, 8-15 and 16-23. The sources contradict each other; images
/// of at most 8 planes differ only in the byte that holds them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PlaneOrder {
    /// Bytes hold planes 16-23, 8-15, 0-7, as common open programs write them.
    #[default]
    Descending,
    /// Bytes hold planes 16-23, 0-7, 8-15, as TI's own program writes them (blue, green, red).
    BlueGreenRed,
}

impl PlaneOrder {
    /// The byte of a pixel that holds the planes of group 0, 1 and 2.
    const fn byte_of_group(self) -> [usize; 3] {
        match self {
            Self::Descending => [2, 1, 0],
            Self::BlueGreenRed => [1, 2, 0],
        }
    }
}

/// Three bytes of a pixel in the order they are written, in bits 0..8, 8..16, 16..24.
type Pixel = u32;

/// Errors of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ImageError {
    /// More than 24 planes.
    #[error("{0} planes do not fit one image of 24: split them over several images")]
    TooManyPlanes(usize),
    /// A plane of the wrong size.
    #[error("plane {plane} has {bytes} bytes, the DMD's planes have {wanted}")]
    PlaneSize {
        /// Which plane.
        plane: usize,
        /// Its size.
        bytes: usize,
        /// The right size.
        wanted: usize,
    },
    /// The header does not start with `Spld`.
    #[error("the image header starts with {0:02x?} instead of \"Spld\"")]
    Signature([u8; 4]),
    /// The header's size is not the DMD's.
    #[error("the image is {width} x {height}, the DMD (or its half) {dmd_width} x {dmd_height}")]
    Size {
        /// Header's width.
        width: u16,
        /// Header's height.
        height: u16,
        /// The right width.
        dmd_width: u32,
        /// The right height.
        dmd_height: u32,
    },
    /// A compression that does not exist.
    #[error("compression {0} does not exist (0 raw, 1 RLE, 2 ERLE)")]
    Compression(u8),
    /// More pixels than the image has.
    #[error("byte {at}: the stream has more pixels than the image")]
    TooManyPixels {
        /// Offset in the stream after the header.
        at: usize,
    },
    /// A copy from the line above in the first line.
    #[error("byte {at}: the first line cannot copy from a line above")]
    CopyWithoutLine {
        /// Offset in the stream after the header.
        at: usize,
    },
    /// Pixels missing when the stream ended.
    #[error("the stream ends after {pixels} of {wanted} pixels")]
    TooFewPixels {
        /// Pixels decoded.
        pixels: usize,
        /// Pixels of the image.
        wanted: usize,
    },
}

/// The 48-byte header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageHeader {
    /// Width in pixels (of one half for two controllers).
    pub width: u16,
    /// Height in pixels.
    pub height: u16,
    /// Bytes that follow the header. Some programs count the header too.
    pub encoded_bytes: u32,
    /// Background colour, bytes as written (blue, green, red, 0).
    pub background: [u8; 4],
    /// Compression of the pixels.
    pub compression: Compression,
}

impl ImageHeader {
    /// The bytes.
    pub fn encode(&self) -> [u8; HEADER_BYTES] {
        let mut h = [0; HEADER_BYTES];
        h[0..4].copy_from_slice(&SIGNATURE);
        h[4..6].copy_from_slice(&self.width.to_le_bytes());
        h[6..8].copy_from_slice(&self.height.to_le_bytes());
        h[8..12].copy_from_slice(&self.encoded_bytes.to_le_bytes());
        h[12..20].fill(0xff);
        h[20..24].copy_from_slice(&self.background);
        h[25] = self.compression as u8;
        h[26] = 1;
        h
    }

    /// Reads the bytes. Reserved bytes may have any value, because programs in the field differ in them.
    pub fn decode(h: &[u8; HEADER_BYTES]) -> Result<Self, ImageError> {
        let signature = [h[0], h[1], h[2], h[3]];
        if signature != SIGNATURE {
            return Err(ImageError::Signature(signature));
        }
        Ok(Self {
            width: u16::from_le_bytes([h[4], h[5]]),
            height: u16::from_le_bytes([h[6], h[7]]),
            encoded_bytes: u32::from_le_bytes([h[8], h[9], h[10], h[11]]),
            background: [h[20], h[21], h[22], h[23]],
            compression: Compression::from_byte(h[25]).ok_or(ImageError::Compression(h[25]))?,
        })
    }
}

/// Transposes an 8 x 8 bit matrix: bit c of byte r goes to bit r of byte c.
const fn transpose8(mut x: u64) -> u64 {
    let mut t = (x ^ (x >> 7)) & 0x00aa_00aa_00aa_00aa;
    x ^= t ^ (t << 7);
    t = (x ^ (x >> 14)) & 0x0000_cccc_0000_cccc;
    x ^= t ^ (t << 14);
    t = (x ^ (x >> 28)) & 0x0000_0000_f0f0_f0f0;
    x ^ t ^ (t << 28)
}

/// Turns rows of planes into rows of pixels.
fn pixel_row(
    planes: &[&[u8]],
    row: usize,
    columns: std::ops::Range<usize>,
    raster: Raster,
    order: PlaneOrder,
    out: &mut [Pixel],
) {
    out.fill(0);
    let start = row * raster.row_bytes();
    for (group, set) in planes.chunks(8).enumerate() {
        let shift = 8 * order.byte_of_group()[group];
        let (first, last) = (columns.start / 8, columns.end.div_ceil(8));
        for byte in first..last {
            let mut x = 0u64;
            for (bit, plane) in set.iter().enumerate() {
                x |= u64::from(plane[start + byte]) << (8 * bit);
            }
            if x == 0 {
                continue;
            }
            let pixels = transpose8(x).to_le_bytes();
            // Bit 7 of a plane's byte is its leftmost pixel.
            for (i, p) in pixels.iter().rev().enumerate() {
                let column = byte * 8 + i;
                if columns.contains(&column) {
                    out[column - columns.start] |= Pixel::from(*p) << shift;
                }
            }
        }
    }
}

/// Extracts plane `plane` from decoded pixels as [`ImageDecoder::pixels`] holds them, into `out`, whose rows get it at
/// `columns` of `raster`. Bits of other columns stay.
pub fn extract_plane(
    pixels: &[u8],
    plane: usize,
    order: PlaneOrder,
    raster: Raster,
    columns: std::ops::Range<usize>,
    out: &mut [u8],
) {
    let (byte, bit) = (order.byte_of_group()[plane / 8], plane % 8);
    let width = columns.len();
    for (row, line) in pixels.chunks_exact(width * 3).enumerate() {
        let at = row * raster.row_bytes();
        for (i, p) in line.chunks_exact(3).enumerate() {
            let column = columns.start + i;
            let mask = 0x80 >> (column % 8);
            let cell = &mut out[at + column / 8];
            *cell = if p[byte] >> bit & 1 != 0 { *cell | mask } else { *cell & !mask };
        }
    }
}

#[cfg(test)]
mod tests;
