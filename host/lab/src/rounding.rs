//! Whether two pictures of one scene differ by rounding alone: compilers of GPUs fuse multiplication and addition in one
//! program and not in the next, so that the same computation keeps no bits.
//!
//! Rounding changes a value by little, and here and there it changes a decision (which of two triangles at an edge, which
//! lobe, whether a history is kept): such a pixel shows other samples of the same light. What is wrong changes many
//! pixels, or changes them in one direction.

use serde::Serialize;

/// Of the lit pixels, so many may show other samples: an H100 changed up to 9 % (`docs/lab/H100.md`).
pub const MOST_MOVED: f64 = 0.10;
/// A pixel whose radiance changes by more than this share of itself shows other samples.
const MOVED: f64 = 1e-3;
/// Pictures whose mean light agrees to this share are equal, whatever the statistics say.
const SAME_MEAN: f64 = 1e-5;
/// So many standard errors of the difference may the means lie apart.
const STANDARD_ERRORS: f64 = 4.0;

/// Neighbours and successive frames share samples through filters and histories, so what is drawn independently is taken
/// to be a run of so many pixels over all frames.
const RUN: usize = 64;

/// The differences of two sequences of pictures.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Rounding {
    /// Pixels that either picture lights.
    pub lit: u64,
    /// Of them, those with another bit of radiance or another code value.
    pub differing: u64,
    /// Of them, those that show other samples: more than a thousandth apart, or more than one level of the code.
    pub moved: u64,
    /// For each run of pixels the sum of the differences of the means of red, green and blue.
    #[serde(skip)]
    runs: Vec<f64>,
    /// Sum of the light of both, halved.
    #[serde(skip)]
    light: f64,
}

impl Rounding {
    /// Adds a pair of pictures of the same pixels: radiance, and code values as the projector gets them.
    pub fn add(&mut self, radiance: [&[[f32; 4]]; 2], codes: [&[u32]; 2]) {
        let pairs = radiance[0].iter().zip(radiance[1]);
        self.runs.resize(self.runs.len().max(radiance[0].len().div_ceil(RUN)), 0.0);
        for (i, (a, b)) in pairs.enumerate() {
            let is_lit = a[..3].iter().chain(&b[..3]).any(|v| *v > 0.0);
            let code = |of: usize| codes[of].get(i).copied().unwrap_or(0);
            let is_same = a.map(f32::to_bits) == b.map(f32::to_bits) && code(0) == code(1);
            if !is_lit && is_same {
                continue;
            }
            let mean = |v: &[f32; 4]| v[..3].iter().map(|v| f64::from(*v)).sum::<f64>() / 3.0;
            let (own, other) = (mean(a), mean(b));
            let difference = other - own;
            self.lit += 1;
            self.differing += u64::from(!is_same);
            let is_moved = difference.abs() > MOVED * own.abs().max(other.abs()) || !difference.is_finite();
            self.moved += u64::from(is_moved || are_levels_apart(code(0), code(1)));
            self.runs[i / RUN] += difference;
            self.light += 0.5 * (own + other);
        }
    }

    /// Every bit is the same.
    pub fn keeps_bits(&self) -> bool {
        self.differing == 0
    }

    /// The share of the lit pixels that show other samples, 0 to 1.
    pub fn moved_share(&self) -> f64 {
        self.moved as f64 / (self.lit as f64).max(1.0)
    }

    /// The difference of the means, by the mean.
    pub fn mean_difference(&self) -> f64 {
        if self.light > 0.0 {
            self.runs.iter().sum::<f64>() / self.light
        } else {
            0.0
        }
    }

    /// No more than rounding explains.
    pub fn is_rounding(&self) -> bool {
        let squares: f64 = self.runs.iter().map(|d| d * d).sum();
        let most = (STANDARD_ERRORS * squares.sqrt()).max(SAME_MEAN * self.light);
        let is_same_mean = self.runs.iter().sum::<f64>().abs() <= most;
        self.moved_share() <= MOST_MOVED && is_same_mean
    }
}

/// More than one level apart in any of the three colours.
fn are_levels_apart(a: u32, b: u32) -> bool {
    a.to_le_bytes().iter().zip(b.to_le_bytes()).any(|(a, b)| a.abs_diff(b) > 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    const PIXELS: usize = 64 * 48;

    /// Numbers from 0 to 1, by SplitMix64.
    struct Random(u64);

    impl Random {
        fn next_f32(&mut self) -> f32 {
            self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let z = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            let z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
            ((z ^ z >> 31) >> 40) as f32 / (1u32 << 24) as f32
        }
    }

    /// Pictures of noise, and the same with another value for each pixel, of which `change` decides.
    fn compared(mut change: impl FnMut(&mut Random, f32) -> f32) -> Rounding {
        let (mut random, mut rounding) = (Random(7), Rounding::default());
        for _ in 0..10 {
            let light: Vec<f32> = (0..PIXELS).map(|_| 0.5 + random.next_f32()).collect();
            let other: Vec<f32> = light.iter().map(|v| change(&mut random, *v)).collect();
            let picture = |of: &[f32]| of.iter().map(|v| [*v, *v, *v, 1.0]).collect::<Vec<_>>();
            rounding.add([&picture(&light), &picture(&other)], [&[], &[]]);
        }
        rounding
    }

    #[test]
    fn rounding_passes_and_what_it_cannot_make_does_not() {
        let same = compared(|_, v| v);
        assert!(same.keeps_bits() && same.is_rounding());
        // The last bits of most pixels, in one direction.
        let last = compared(|_, v| v * (1.0 + 3e-7));
        assert!(!last.keeps_bits() && last.moved == 0 && last.is_rounding());
        // Other samples of the same light in every 20th pixel; in every fifth.
        let drawn = |one_in: f32| {
            compared(move |r, v| if r.next_f32() * one_in < 1.0 { 0.5 + r.next_f32() } else { v })
        };
        assert!(drawn(20.0).is_rounding(), "{:?}", drawn(20.0));
        assert!(!drawn(5.0).is_rounding(), "a fifth of the pixels");
        // A part that was left out and had given a two-thousandth of the light, or a tenth in every 50th pixel.
        assert!(!compared(|_, v| v * 0.9995).is_rounding());
        assert!(!compared(|r, v| if r.next_f32() < 0.02 { v * 0.9 } else { v }).is_rounding());
        // A number that is none.
        assert!(!compared(|_, _| f32::NAN).is_rounding());
    }

    #[test]
    fn codes_may_be_a_level_apart() {
        let light = vec![[1.0f32; 4]; 100];
        let mut rounding = Rounding::default();
        let codes = |of: u32| vec![of; 100];
        rounding.add([&light, &light], [&codes(0x80_7f_10), &codes(0x7f_80_11)]);
        assert!(!rounding.keeps_bits() && rounding.is_rounding());
        rounding.add([&light, &light], [&codes(0x80_7f_10), &codes(0x80_7f_12)]);
        assert!(!rounding.is_rounding());
    }
}
