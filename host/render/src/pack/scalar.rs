//! The packer in plain Rust: the definition that all others are compared with.

use super::BitPlaneFrame;

pub(super) fn pack(codes: &[u32], frame: &mut BitPlaneFrame) {
    let raster = frame.raster();
    for (i, bit) in frame.source_bits().into_iter().enumerate().take(frame.schedule().len()) {
        let rows = frame.plane_mut(i).chunks_exact_mut(raster.row_bytes());
        for (row, pixels) in rows.zip(codes.chunks_exact(raster.width() as usize)) {
            for (byte, eight) in row.iter_mut().zip(pixels.chunks(8)) {
                *byte = 0;
                for (x, code) in eight.iter().enumerate() {
                    *byte |= ((code >> bit & 1) as u8) << (7 - x);
                }
            }
        }
    }
}
