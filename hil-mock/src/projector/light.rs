//! Bit planes into light: what the eye's side of the mirrors receives from a frame, in code values.
//!
//! A plane of bit `b` is lit for one plane slot with an LED at `2^b / 255` of full. Summed over a channel's planes a pixel
//! receives `code / 255` of the light of a full slot, where `code` is the number its bits spell: light **is** the code value.

use dpm_device::planes::{Channel, PlaneSchedule, Raster};

/// `SPREAD[b]` has bit `7 - i` of `b` as the value (0 or 1) of its byte `i`: eight mirrors, left to right, as eight counters.
const SPREAD: [u64; 256] = {
    let mut table = [0u64; 256];
    let mut b = 0;
    while b < 256 {
        let mut i = 0;
        while i < 8 {
            table[b] |= ((b as u64 >> (7 - i)) & 1) << (8 * i);
            i += 1;
        }
        b += 1;
    }
    table
};

/// Light of one frame for every mirror, rows top to bottom, red green blue code values 0..=255. `planes` are the frame's planes one
/// after the other in the order of `schedule`. Planes of [`Channel::White`] light all three.
///
/// # Panics
/// When a slice has not the size that raster and schedule demand.
pub fn light_of_planes(raster: Raster, schedule: &PlaneSchedule, planes: &[u8], out: &mut [[u8; 3]]) {
    let plane_bytes = raster.plane_bytes();
    assert_eq!(planes.len(), plane_bytes * schedule.len(), "bytes of planes");
    assert_eq!(out.len(), raster.pixel_count(), "pixels of light");
    let (row_bytes, width) = (raster.row_bytes(), raster.width() as usize);
    // Eight mirrors of one plane are one table look-up, shifted to the plane's weight; sums cannot carry into a neighbour
    // because a schedule holds each (channel, bit) once and a byte holds 255.
    let mut sums = vec![[0u64; 3]; row_bytes];
    for (y, row) in out.chunks_exact_mut(width).enumerate() {
        sums.fill([0; 3]);
        for (spec, plane) in schedule.planes().iter().zip(planes.chunks_exact(plane_bytes)) {
            let bytes = &plane[y * row_bytes..(y + 1) * row_bytes];
            let shift = spec.bit;
            match spec.channel {
                Channel::White => {
                    for (s, &b) in sums.iter_mut().zip(bytes) {
                        let light = SPREAD[b as usize] << shift;
                        *s = s.map(|c| c + light);
                    }
                }
                channel => {
                    let c = channel as usize;
                    for (s, &b) in sums.iter_mut().zip(bytes) {
                        s[c] += SPREAD[b as usize] << shift;
                    }
                }
            }
        }
        for (pixels, s) in row.chunks_mut(8).zip(&sums) {
            let [r, g, b] = s.map(u64::to_le_bytes);
            for (i, pixel) in pixels.iter_mut().enumerate() {
                *pixel = [r[i], g[i], b[i]];
            }
        }
    }
}

/// Light summed over slots: what a camera or an eye collects.
#[derive(Clone, Debug)]
pub struct Exposure {
    sum: Vec<[u32; 3]>,
    slots: u32,
}

impl Exposure {
    /// No light on `pixels` mirrors.
    pub fn new(pixels: usize) -> Self {
        Self { sum: vec![[0; 3]; pixels], slots: 0 }
    }

    /// Adds one slot of `light` (code values). Exact for 2^24 slots.
    pub fn add(&mut self, light: &[[u8; 3]]) {
        assert_eq!(light.len(), self.sum.len(), "pixels of light");
        for (s, l) in self.sum.iter_mut().zip(light) {
            for c in 0..3 {
                s[c] += u32::from(l[c]);
            }
        }
        self.slots += 1;
    }

    /// Adds one dark slot.
    pub fn add_dark(&mut self) {
        self.slots += 1;
    }

    /// Slots added, dark ones included.
    pub const fn slots(&self) -> u32 {
        self.slots
    }

    /// Sum of code values over the slots.
    pub fn sum(&self) -> &[[u32; 3]] {
        &self.sum
    }

    /// Mean code value of a pixel's channel over the slots; 0 without slots.
    pub fn mean(&self, pixel: usize, channel: usize) -> f32 {
        self.sum[pixel][channel] as f32 / self.slots.max(1) as f32
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.sum.fill([0; 3]);
        self.slots = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::planes::PlaneSpec;
    use proptest::prelude::*;

    /// One bit at a time, as the words say it: the oracle.
    fn bit_by_bit(raster: Raster, schedule: &PlaneSchedule, planes: &[u8]) -> Vec<[u8; 3]> {
        let mut out = vec![[0u8; 3]; raster.pixel_count()];
        for (k, spec) in schedule.planes().iter().enumerate() {
            for y in 0..raster.height() as usize {
                for x in 0..raster.width() as usize {
                    let byte = planes[k * raster.plane_bytes() + y * raster.row_bytes() + x / 8];
                    let weight = (byte >> (7 - x % 8) & 1) << spec.bit;
                    let pixel = &mut out[y * raster.width() as usize + x];
                    match spec.channel {
                        Channel::White => pixel.iter_mut().for_each(|c| *c += weight),
                        c => pixel[c as usize] += weight,
                    }
                }
            }
        }
        out
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]
        #[test]
        fn tables_equal_single_bits(w in 1u32..70, h in 1u32..6, seed in any::<u64>(), mono in any::<bool>()) {
            let raster = Raster::new(w, h).unwrap();
            let schedule = if mono { PlaneSchedule::mono8() } else { PlaneSchedule::rgb24() };
            let mut state = seed | 1;
            let planes: Vec<u8> = (0..raster.plane_bytes() * schedule.len()).map(|_| {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                (state >> 56) as u8
            }).collect();
            let mut out = vec![[9; 3]; raster.pixel_count()];
            light_of_planes(raster, &schedule, &planes, &mut out);
            prop_assert_eq!(out, bit_by_bit(raster, &schedule, &planes));
        }
    }

    #[test]
    fn a_single_plane_weighs_its_bit() {
        let raster = Raster::new(9, 1).unwrap();
        let schedule = PlaneSchedule::new(&[PlaneSpec { channel: Channel::Green, bit: 6 }]).unwrap();
        let mut out = [[0; 3]; 9];
        // Leftmost mirror is bit 7 of the first byte, the ninth is bit 7 of the second; padding bits light nothing.
        light_of_planes(raster, &schedule, &[0b1000_0001, 0b1111_1111], &mut out);
        let lit: Vec<usize> = (0..9).filter(|&i| out[i] == [0, 64, 0]).collect();
        assert_eq!(lit, [0, 7, 8]);
        assert!(out.iter().enumerate().all(|(i, p)| lit.contains(&i) || *p == [0; 3]));
    }

    #[test]
    fn exposure_is_the_mean_over_slots() {
        let mut exposure = Exposure::new(2);
        exposure.add(&[[255, 1, 0], [10, 20, 30]]);
        exposure.add_dark();
        assert_eq!((exposure.mean(0, 0), exposure.mean(1, 2), exposure.slots()), (127.5, 15.0, 2));
    }
}
