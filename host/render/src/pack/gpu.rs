//! The packer on the GPU (`shaders/glsl/pack.comp`): its constants, its size, and its bytes into a frame.
//!
//! The planes that it writes start on a word each; everything else is as [`super::pack`] does it, byte for byte.

use super::{source_bits, BitPlaneFrame, CODE_BITS};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_shaders::specialization as ids;

/// The constants that hold the planes of four bits of a code value each, from the lowest bits on.
const PLANES_OF_FOUR_BITS: [u32; CODE_BITS / 4] = [
    ids::PLANE_OF_BITS_0,
    ids::PLANE_OF_BITS_4,
    ids::PLANE_OF_BITS_8,
    ids::PLANE_OF_BITS_12,
    ids::PLANE_OF_BITS_16,
    ids::PLANE_OF_BITS_20,
];
/// No plane shows the bit.
const NO_PLANE: u32 = 0xff;
/// Words of a plane that a workgroup writes.
const WORKGROUP: usize = 64;

/// Words of four bytes that a plane takes on the GPU.
const fn plane_words(raster: Raster) -> usize {
    raster.plane_bytes().div_ceil(4)
}

/// Bytes of all planes on the GPU.
pub fn len_bytes(raster: Raster, schedule: &PlaneSchedule) -> usize {
    plane_words(raster) * 4 * schedule.len()
}

/// Workgroups of the pass.
pub fn workgroups(raster: Raster) -> [u32; 3] {
    [plane_words(raster).div_ceil(WORKGROUP) as u32, 1, 1]
}

/// Specialization constants of the pass.
pub fn constants(raster: Raster, schedule: &PlaneSchedule) -> Vec<(u32, u32)> {
    let mut plane_of_bit = [NO_PLANE; CODE_BITS];
    for (plane, bit) in source_bits(schedule).into_iter().enumerate().take(schedule.len()) {
        plane_of_bit[usize::from(bit)] = plane as u32;
    }
    let mut all = vec![(ids::PLANE_WIDTH, raster.width()), (ids::PLANE_HEIGHT, raster.height())];
    for (id, four) in PLANES_OF_FOUR_BITS.into_iter().zip(plane_of_bit.chunks(4)) {
        all.push((id, four.iter().rev().fold(0, |word, plane| word << 8 | plane)));
    }
    all
}

/// Copies what the pass wrote into `frame`.
///
/// # Panics
/// When `bytes` are not [`len_bytes`] of the frame's raster and schedule.
pub fn take(bytes: &[u8], frame: &mut BitPlaneFrame) {
    let raster = frame.raster();
    assert_eq!(bytes.len(), len_bytes(raster, frame.schedule()), "planes of a raster of {raster:?}");
    let (stride, size) = (plane_words(raster) * 4, raster.plane_bytes());
    if stride == size {
        frame.bytes_mut().copy_from_slice(bytes);
        return;
    }
    for (to, from) in frame.bytes_mut().chunks_exact_mut(size).zip(bytes.chunks_exact(stride)) {
        to.copy_from_slice(&from[..size]);
    }
}
