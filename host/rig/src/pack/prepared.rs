//! Frames that are prepared in advance and replace rendered ones. A pattern moves from frame to frame, and each frame
//! is marked with its number, so that an observer of the planes can check that they all belong to one frame.

use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_render::pack::{self, BitPlaneFrame, Kernel};

/// Number of positions of the pattern.
const POSITIONS: usize = 4;
/// Pixels by which the pattern moves per frame; they fill whole bytes of a plane.
const STEP: usize = 8;
/// The first pixel of every so many rows carries the frame's number.
const MARK_ROWS: usize = 16;
/// Bits of a code value, and of the number in a mark.
const MARK_BITS: u32 = 0x00ff_ffff;

/// Code values `0x00BBGGRR` of one picture, and some more: each frame is the picture shifted by [`STEP`] pixels. A
/// single picture occupies as much of the caches as a renderer's output, and more than a core's own cache.
#[derive(Clone, Debug)]
pub struct PreparedFrames {
    raster: Raster,
    codes: Vec<u32>,
}

impl PreparedFrames {
    /// A pattern of ramps that moves by 8 pixels per frame and always emits about the same light, so that it never
    /// flashes.
    pub fn new(raster: Raster) -> Self {
        let width = raster.width();
        let pixels = raster.pixel_count() + STEP * (POSITIONS - 1);
        let codes = (0..pixels as u32).map(|i| pattern(i % width, i / width));
        Self { raster, codes: codes.collect() }
    }

    /// The code values of frame `id`.
    fn frame(&mut self, id: u64) -> &mut [u32] {
        let from = STEP * (id % POSITIONS as u64) as usize;
        &mut self.codes[from..from + self.raster.pixel_count()]
    }

    /// Marks the next frame with its number and packs it. Returns the bytes of code values that were read for it.
    pub fn pack(&mut self, kernel: Kernel, id: u64, planes: &mut BitPlaneFrame) -> u64 {
        let rows = MARK_ROWS * self.raster.width() as usize;
        let codes = self.frame(id);
        // Marks of other positions remain; they are isolated pixels like any others.
        codes.iter_mut().step_by(rows).for_each(|code| *code = id as u32 & MARK_BITS);
        pack::pack(kernel, codes, planes);
        size_of_val(codes) as u64
    }
}

/// A ramp in each channel, each in a different direction.
fn pattern(x: u32, y: u32) -> u32 {
    let (r, g, b) = (x & 0xff, (x ^ y) & 0xff, (x + 2 * y) & 0xff);
    r | g << 8 | b << 16
}

/// True if every mark in `planes` (one after the other, in the order of `schedule`) is the number of frame `id`: then
/// no plane, and no part of a plane, belongs to another frame.
pub fn is_whole(raster: Raster, schedule: &PlaneSchedule, planes: &[u8], id: u32) -> bool {
    let rows = MARK_ROWS * raster.row_bytes();
    planes.chunks_exact(raster.plane_bytes()).zip(pack::source_bits(schedule)).all(|(plane, bit)| {
        let expected = (id >> bit & 1) as u8;
        plane.iter().step_by(rows).all(|byte| byte >> 7 == expected)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_or_a_part_of_one_from_another_frame_is_found() {
        let raster = Raster::new(72, 40).unwrap();
        for schedule in [PlaneSchedule::rgb24(), PlaneSchedule::mono8()] {
            let mut prepared = PreparedFrames::new(raster);
            let (mut a, mut b) = (BitPlaneFrame::new(raster, schedule), BitPlaneFrame::new(raster, schedule));
            for (id, other) in [(1u32, 2u32), (0x00a5_5a0f, 0x005a_a5f0)] {
                prepared.pack(Kernel::best(), u64::from(id), &mut a);
                prepared.pack(Kernel::best(), u64::from(other), &mut b);
                assert!(is_whole(raster, &schedule, a.bytes(), id));
                let in_mark = if schedule.len() == 24 { MARK_BITS } else { 0xff00 };
                assert_eq!(is_whole(raster, &schedule, a.bytes(), other), (id ^ other) & in_mark == 0);
                // One plane whose bit differs from its 17th row on; its upper part belongs to the right frame.
                for (k, spec) in schedule.planes().iter().enumerate() {
                    let mut torn = a.bytes().to_vec();
                    let half = k * raster.plane_bytes() + 16 * raster.row_bytes();
                    let end = (k + 1) * raster.plane_bytes();
                    torn[half..end].copy_from_slice(&b.bytes()[half..end]);
                    let channel = if schedule.len() == 8 { 8 } else { 8 * spec.channel as u32 };
                    let differs = (id ^ other) >> (channel + u32::from(spec.bit)) & 1 == 1;
                    assert_eq!(is_whole(raster, &schedule, &torn, id), !differs, "plane {k}");
                }
            }
        }
    }

    /// Every frame emits about the same light, so a flash limiter stops none of them.
    #[test]
    fn the_pattern_moves_and_sends_out_the_same_light() {
        let raster = Raster::new(1024, 768).unwrap();
        let mut prepared = PreparedFrames::new(raster);
        let light = |frame: &[u32]| -> u64 {
            frame.iter().map(|c| u64::from((c & 0xff) + (c >> 8 & 0xff) + (c >> 16))).sum()
        };
        let first = prepared.frame(0).to_vec();
        let mut before = first.clone();
        for id in 1..POSITIONS as u64 {
            let frame = prepared.frame(id);
            assert_eq!(frame[..1000], before[STEP..1000 + STEP], "moved");
            assert_ne!(frame, before);
            // The smallest change that counts as half a flash is a tenth of full.
            assert!(light(frame).abs_diff(light(&first)) * 1000 < light(&first));
            before = frame.to_vec();
        }
        assert_eq!(prepared.frame(POSITIONS as u64), first);
    }
}
