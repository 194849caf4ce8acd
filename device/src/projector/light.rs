//! Computes the light of a frame from its bit planes, in code values.
//!
//! A plane of bit `b` is lit for one plane slot with an LED at `2^b / 255` of full. Summed over a channel's planes, a
//! pixel receives `code / 255` of the light of a full slot, where `code` is the number that its bits form: light **is**
//! the code value. Where planes share the full light among them ([`PlaneSchedule::filling`]), it is their sum as a share of
//! the sum of all, out of 255.

use alloc::{vec, vec::Vec};

use crate::planes::{Channel, PlaneSchedule, Raster, MAX_PLANES};

/// Eight rows of 64 bits, read as eight 8 x 8 bit matrices side by side, one in each byte: transposes all of them, so that bit `i` of
/// byte `c` of row `j` becomes bit `j` of byte `c` of row `i` (block swaps of 4, 2 and 1 bits \[HackersDelight\] 7-3).
fn transpose(rows: &mut [u64; 8]) {
    for (step, mask) in [(4, 0x0f0f_0f0f_0f0f_0f0f), (2, 0x3333_3333_3333_3333), (1, 0x5555_5555_5555_5555)] {
        for i in (0..8).filter(|i| i & step == 0) {
            let t = ((rows[i] >> step) ^ rows[i + step]) & mask;
            rows[i + step] ^= t;
            rows[i] ^= t << step;
        }
    }
}

/// Eight rows of eight bytes: byte `c` of row `j` becomes byte `j` of row `c` (block swaps of 4, 2 and 1 bytes).
fn transpose_bytes(rows: &mut [u64; 8]) {
    for (step, mask) in [(4, 0x0000_0000_ffff_ffff), (2, 0x0000_ffff_0000_ffff), (1, 0x00ff_00ff_00ff_00ff)] {
        for i in (0..8).filter(|i| i & step == 0) {
            let t = ((rows[i] >> (8 * step)) ^ rows[i + step]) & mask;
            rows[i + step] ^= t;
            rows[i] ^= t << (8 * step);
        }
    }
}

/// Light of one frame for every mirror, rows top to bottom, red green blue code values 0..=255. `planes` holds the
/// frame's planes one after the other in the order of `schedule`. Planes of [`Channel::White`] light all three
/// channels; a sum above full light is clamped.
///
/// # Panics
/// When a slice does not have the size that raster and schedule demand.
pub fn light_of_planes(raster: Raster, schedule: &PlaneSchedule, planes: &[u8], out: &mut [[u8; 3]]) {
    assert_eq!(planes.len(), raster.plane_bytes() * schedule.len(), "bytes of planes");
    assert_eq!(out.len(), raster.pixel_count(), "pixels of light");
    if schedule.has_repeats() || schedule.white_weight() != 255 {
        return light_of_repeats(raster, schedule, planes, out);
    }
    let width = raster.width() as usize;
    let has_white = schedule.planes().iter().any(|p| p.channel == Channel::White);
    let mut places = [(Channel::Red, 0); MAX_PLANES];
    for (place, spec) in places.iter_mut().zip(schedule.planes()) {
        *place = (spec.channel, spec.bit);
    }
    gather_bits(raster, &places[..schedule.len()], planes, |y, x, run| {
        let [red, green, blue, white] = run.channels;
        let out = &mut out[y * width + x..][..run.pixels];
        for ((pixel, red), (green, blue)) in out.iter_mut().zip(red).zip(green.iter().zip(blue)) {
            *pixel = [*red, *green, *blue];
        }
        if has_white {
            for (pixel, white) in out.iter_mut().zip(white) {
                *pixel = pixel.map(|p| p.saturating_add(*white));
            }
        }
    });
}

/// Up to 64 mirrors of a row, in the order of reading.
#[derive(Debug)]
pub struct Run<'a> {
    /// How many; what follows them in the channels has no meaning.
    pub pixels: usize,
    /// Their red, green, blue and white.
    pub channels: [&'a [u8; 64]; 4],
}

/// Gathers the bits of planes into one byte for each channel of each mirror. `planes` holds planes one after the other,
/// and the `k`-th of `places` says which bit of which channel the `k`-th plane is; no two are the same, and bits without
/// a plane are 0. `sink` gets the row, the column of the first mirror, and the mirrors from there on. Runs follow each
/// other in the order of reading.
///
/// # Panics
/// When `planes` is shorter than raster and places demand.
pub fn gather_bits(
    raster: Raster,
    places: &[(Channel, u8)],
    planes: &[u8],
    mut sink: impl FnMut(usize, usize, Run<'_>),
) {
    let (plane_bytes, row_bytes, width) = (raster.plane_bytes(), raster.row_bytes(), raster.width() as usize);
    let is_used = [Channel::Red, Channel::Green, Channel::Blue, Channel::White]
        .map(|channel| places.iter().any(|(used, _)| *used == channel));
    let mut gathered = [[0u8; 64]; 4];
    for y in 0..raster.height() as usize {
        for x in (0..width).step_by(64) {
            // Eight bytes of every plane: row `bit` of its channel's matrices.
            let pixels = (width - x).min(64);
            let n = pixels.div_ceil(8);
            let at = y * row_bytes + x / 8;
            let mut codes = [[0u64; 8]; 4];
            for (k, (channel, bit)) in places.iter().enumerate() {
                let bytes = &planes[k * plane_bytes + at..][..n];
                let word = match bytes.first_chunk::<8>() {
                    Some(eight) => u64::from_le_bytes(*eight),
                    None => {
                        let mut tail = [0u8; 8];
                        tail[..n].copy_from_slice(bytes);
                        u64::from_le_bytes(tail)
                    }
                };
                codes[*channel as usize][usize::from(bit & 7)] = word;
            }
            for ((rows, out), _) in codes.iter_mut().zip(&mut gathered).zip(is_used).filter(|(_, used)| *used)
            {
                transpose(rows);
                // Now row `j` holds, in byte `c`, the code of the mirror at bit `j` of byte `c`: bit 7 is the leftmost.
                rows.reverse();
                transpose_bytes(rows);
                for (eight, row) in out.chunks_exact_mut(8).zip(rows) {
                    eight.copy_from_slice(&row.to_le_bytes());
                }
            }
            let [red, green, blue, white] = &gathered;
            sink(y, x, Run { pixels, channels: [red, green, blue, white] });
        }
    }
}

/// The same for a schedule in which a bit of a channel may have several planes, or whose planes share the full light: eight
/// mirrors at a time, plane by plane.
fn light_of_repeats(raster: Raster, schedule: &PlaneSchedule, planes: &[u8], out: &mut [[u8; 3]]) {
    let (plane_bytes, row_bytes) = (raster.plane_bytes(), raster.row_bytes());
    for (y, row) in out.chunks_exact_mut(raster.width() as usize).enumerate() {
        for (i, eight) in row.chunks_mut(8).enumerate() {
            // Sums of `2^bit` of red, green and blue: at most 32 planes of 128.
            let mut sums = [[0u16; 3]; 8];
            for (spec, plane) in schedule.planes().iter().zip(planes.chunks_exact(plane_bytes)) {
                let byte = plane[y * row_bytes + i];
                let lights = match spec.channel {
                    Channel::White => [true; 3],
                    channel => [0, 1, 2].map(|c| c == channel as usize),
                };
                for (_, sum) in sums.iter_mut().enumerate().filter(|(x, _)| byte << x & 0x80 != 0) {
                    sum.iter_mut().zip(lights).for_each(|(s, lit)| *s += u16::from(lit) << spec.bit);
                }
            }
            for (pixel, sum) in eight.iter_mut().zip(sums) {
                *pixel = sum.map(|s| schedule.light_of(s.into()));
            }
        }
    }
}

/// Light summed over slots, as a camera or an eye collects it.
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
    use crate::planes::{Parts, PlaneSpec};
    use proptest::prelude::*;

    /// One bit at a time, as the definition says: the oracle.
    fn bit_by_bit(raster: Raster, schedule: &PlaneSchedule, planes: &[u8]) -> Vec<[u8; 3]> {
        let mut sums = vec![[0u32; 3]; raster.pixel_count()];
        for (k, spec) in schedule.planes().iter().enumerate() {
            for y in 0..raster.height() as usize {
                for x in 0..raster.width() as usize {
                    let byte = planes[k * raster.plane_bytes() + y * raster.row_bytes() + x / 8];
                    let weight = u32::from(byte >> (7 - x % 8) & 1) << spec.bit;
                    let pixel = &mut sums[y * raster.width() as usize + x];
                    match spec.channel {
                        Channel::White => pixel.iter_mut().for_each(|c| *c += weight),
                        c => pixel[c as usize] += weight,
                    }
                }
            }
        }
        let full = f64::from(schedule.white_weight());
        let light = |sum: u32| (f64::from(sum) * 255.0 / full).min(255.0).round() as u8;
        sums.into_iter().map(|sum| sum.map(light)).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]
        #[test]
        fn words_equal_single_bits(w in 1u32..150, h in 1u32..6, seed in any::<u64>(), kind in 0u8..8) {
            let raster = Raster::new(w, h).unwrap();
            let mixed: Vec<PlaneSpec> =
                [0x07, 0x37, 0x36, 0x10, 0x22].iter().map(|&c| PlaneSpec::from_led_code(c).unwrap()).collect();
            let schedule = match kind {
                0 => PlaneSchedule::mono8(),
                1 => PlaneSchedule::rgb24(),
                2 => PlaneSchedule::equal_rgb24(),
                3 => PlaneSchedule::equal_rgb24().filled(),
                4 => PlaneSchedule::of_parts(Parts { count: 3, depth: 8, low: 0, white: true }).unwrap(),
                5 => PlaneSchedule::of_parts(Parts { count: 2, depth: 4, low: 0, white: false }).unwrap(),
                6 => PlaneSchedule::split_rgb24(),
                _ => PlaneSchedule::new(&mixed).unwrap(),
            };
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
