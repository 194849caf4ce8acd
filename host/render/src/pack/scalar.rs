//! The packer in plain Rust, for every processor.

use super::{pack_blocks, BitPlaneFrame, Planes, BLOCK_PIXELS};

pub(super) fn pack(codes: &[u32], frame: &mut BitPlaneFrame) {
    pack_blocks(codes, frame, super::copy, |blocks, planes, at| {
        for (i, pixels) in blocks.as_flattened().as_chunks::<8>().0.iter().enumerate() {
            pack_eight(pixels, planes, at + i);
        }
    });
    const { assert!(BLOCK_PIXELS.is_multiple_of(8)) };
}

/// Eight pixels are a byte of each plane: the bytes of a channel in one word, of which bits and bytes change places
/// \[HackersDelight\] 7-3.
#[inline(always)]
fn pack_eight(pixels: &[u32; 8], planes: &mut Planes, at: usize) {
    const TWO_BYTES: u64 = 0xff_0000_00ff;
    // Two pixels in a word, four apart. Bit 7 of a plane's byte is the leftmost pixel.
    let pairs: [u64; 4] = std::array::from_fn(|i| u64::from(pixels[7 - i]) | u64::from(pixels[3 - i]) << 32);
    for (channel, planes) in planes.as_chunks_mut::<8>().0.iter_mut().enumerate() {
        let [a, b, c, d] = pairs.map(|pair| pair >> (8 * channel) & TWO_BYTES);
        let turned = transpose_bits(a | b << 8 | c << 16 | d << 24).to_le_bytes();
        for (plane, byte) in planes.iter_mut().zip(turned) {
            plane[at] = byte;
        }
    }
}

/// Bit `i` of byte `j` becomes bit `j` of byte `i`.
const fn transpose_bits(mut x: u64) -> u64 {
    let t = (x ^ (x >> 7)) & 0x00aa_00aa_00aa_00aa;
    x ^= t ^ (t << 7);
    let t = (x ^ (x >> 14)) & 0x0000_cccc_0000_cccc;
    x ^= t ^ (t << 14);
    let t = (x ^ (x >> 28)) & 0x0000_0000_f0f0_f0f0;
    x ^ t ^ (t << 28)
}
