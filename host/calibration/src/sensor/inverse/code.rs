//! What each frame shows, as a pure function of frame and pixel.
//!
//! Two frames make a pair: stripes, and the same stripes with light and dark exchanged. The stripes of a pair are a bit of
//! the column or of the row in Gray code, over and over: wide ones and narrow ones in turn, since wide ones tell the
//! contrast, which changes while the wand moves. Two pairs show the right half and the lower half of the raster. The other
//! bits are exchanged in one half of the raster, so that exactly half of the pixels are lit in every frame, and the light
//! of the whole picture never changes. Which of the two frames of a pair
//! comes first is a bit of the pair's identity, the maximal sequence of [`super::super::Code`].

use super::super::code::{identity, IDENTITY_PERIOD};
use super::super::stripes::stripes;
use dpm_device::planes::Raster;
use glam::DVec2;
use std::sync::Arc;

/// A side of so many pixels has stripes of one pixel at least; twice as many, of two: finer ones vanish in the aperture.
const FINE: u32 = 512;

/// Stripes of a twelfth of the side and more are wide.
const WIDE: u32 = 12;

/// The widest and the narrowest half in turn.
fn in_turn(stripes: &[Stripe]) -> Vec<Stripe> {
    let (wide, narrow) = stripes.split_at(stripes.len().div_ceil(2));
    let pairs = wide.iter().enumerate().flat_map(|(i, w)| [Some(w), narrow.get(i)]);
    pairs.flatten().copied().collect()
}

/// The stripes of a pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stripe {
    /// 0 for columns, 1 for rows.
    pub axis: usize,
    /// Lit from `width` to three times `width` pixels, repeated every four.
    pub width: u32,
    /// Light and dark are exchanged from this pixel on along the other axis.
    pub exchanged_from: Option<u32>,
}

/// The share of an aperture that is lit, and its derivatives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lit {
    pub share: f64,
    pub by_place: f64,
    pub by_radius: f64,
}

impl Stripe {
    /// Whether a pixel is lit.
    pub fn lit(&self, x: u32, y: u32) -> bool {
        let [along, across] = if self.axis == 0 { [x, y] } else { [y, x] };
        let is_exchanged = self.exchanged_from.is_some_and(|from| across >= from);
        ((along / self.width + 1) & 2 != 0) != is_exchanged
    }

    /// The same for a disc of `radius` pixels; `None` where it lies on the border of the half that is exchanged.
    pub(super) fn on(&self, place: DVec2, radius: f64) -> Option<Lit> {
        let at = stripes(f64::from(self.width), place[self.axis], radius);
        let lit = Lit { share: at.share, by_place: at.by_place, by_radius: at.by_radius };
        let Some(from) = self.exchanged_from.map(f64::from) else { return Some(lit) };
        let across = place[1 - self.axis] - from;
        if across.abs() < radius + 2.0 {
            return None;
        }
        let exchanged = Lit { share: 1.0 - at.share, by_place: -at.by_place, by_radius: -at.by_radius };
        Some(if across > 0.0 { exchanged } else { lit })
    }
}

/// A code for a raster. Copies share its table.
#[derive(Clone, Debug)]
pub struct InverseCode {
    raster: Raster,
    stripes: Arc<[Stripe]>,
    identity: Arc<[u64]>,
}

impl InverseCode {
    /// The code of a raster.
    pub fn new(raster: Raster) -> Self {
        let sides = [raster.width(), raster.height()];
        let middle = sides.map(|side| (side / 2).max(1));
        let halves = [0, 1].map(|axis| Stripe { axis, width: middle[axis], exchanged_from: None });
        let finest = sides.map(|side| (side / FINE).max(1).next_power_of_two().trailing_zeros());
        let bits = |axis: usize| u32::BITS - (sides[axis] - 1).leading_zeros();
        let mut stripes = halves.to_vec();
        for bit in (0..bits(0).max(bits(1))).rev() {
            let with = |axis: &usize| (finest[*axis]..bits(*axis)).contains(&bit);
            stripes.extend((0..2).filter(with).map(|axis| Stripe {
                axis,
                width: 1 << bit,
                exchanged_from: Some(middle[1 - axis]),
            }));
        }
        Self { raster, stripes: in_turn(&stripes).into(), identity: identity() }
    }

    /// Whether the sensor hardly ever lies on a border of the stripes.
    pub(super) fn is_wide(&self, stripe: &Stripe) -> bool {
        WIDE * stripe.width >= [self.raster.width(), self.raster.height()][stripe.axis]
    }

    /// The raster.
    pub fn raster(&self) -> Raster {
        self.raster
    }

    /// Pairs after which the stripes repeat.
    pub fn pairs(&self) -> usize {
        self.stripes.len()
    }

    /// The number of a pair's stripes.
    pub fn index(&self, pair: u64) -> usize {
        (pair % self.stripes.len() as u64) as usize
    }

    /// Time for which the wand must be held still to be seen at a place, seconds: a round, and what the latency may be.
    pub fn hold_s(&self, frame_ns: f64) -> f64 {
        2e-9 * self.pairs() as f64 * frame_ns + 0.35
    }

    /// The stripes of a number below [`InverseCode::pairs`].
    pub fn stripe(&self, index: usize) -> Stripe {
        self.stripes[index]
    }

    /// Whether a frame shows its stripes with light and dark exchanged.
    pub fn is_inverse(&self, frame: u64) -> bool {
        let i = (frame / 2) % IDENTITY_PERIOD;
        (frame % 2 == 1) != (self.identity[(i / 64) as usize] >> (i % 64) & 1 == 1)
    }

    /// Whether a pixel is lit.
    pub fn lit(&self, frame: u64, x: u32, y: u32) -> bool {
        self.stripe(self.index(frame / 2)).lit(x, y) != self.is_inverse(frame)
    }

    /// The middle of the pixels whose bits are `is_lit`, one for each number of stripes.
    pub(super) fn pixel(&self, is_lit: &[bool]) -> DVec2 {
        let (mut stripe, mut last, mut finest) = ([0u32; 2], [0u32; 2], [1u32; 2]);
        let mut bits: Vec<(Stripe, bool)> =
            self.stripes.iter().copied().zip(is_lit.iter().copied()).collect();
        bits.sort_by_key(|(s, _)| (s.exchanged_from.is_some(), std::cmp::Reverse(s.width)));
        let mut half = [false; 2];
        for (Stripe { axis, width, exchanged_from }, is_lit) in bits {
            if exchanged_from.is_none() {
                half[axis] = is_lit;
                continue;
            }
            last[axis] ^= u32::from(is_lit != half[1 - axis]);
            stripe[axis] = stripe[axis] << 1 | last[axis];
            finest[axis] = width;
        }
        DVec2::from_array([0, 1].map(|a| (f64::from(stripe[a]) + 0.5) * f64::from(finest[a])))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_of_the_pixels_are_lit_in_every_frame_and_each_pixel_in_one_of_two() {
        for (w, h) in [(1024, 768), (1920, 1080), (1280, 720), (128, 96), (100, 62)] {
            let code = InverseCode::new(Raster::new(w, h).unwrap());
            for frame in 0..2 * code.pairs() as u64 {
                let lit = (0..h).map(|y| (0..w).filter(|x| code.lit(frame, *x, y)).count()).sum::<usize>();
                assert_eq!(2 * lit, (w * h) as usize, "{w} x {h}, frame {frame}");
            }
            for (x, y) in [(0, 0), (w - 1, h - 1), (w / 3, h / 2), (w / 2, h / 3)] {
                assert!((0..200).all(|p| code.lit(2 * p, x, y) != code.lit(2 * p + 1, x, y)));
            }
        }
    }

    #[test]
    fn every_pixel_is_named_by_its_bits() {
        for (w, h) in [(1024, 768), (1920, 1080), (128, 96), (2560, 1600), (96, 128)] {
            let code = InverseCode::new(Raster::new(w, h).unwrap());
            for i in 0..5000u64 {
                let (x, y) = ((i * 7919 % u64::from(w)) as u32, (i * 104_729 % u64::from(h)) as u32);
                let bits: Vec<bool> = (0..code.pairs()).map(|s| code.stripe(s).lit(x, y)).collect();
                let off = code.pixel(&bits) - DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let finest = f64::from((w.max(h) / FINE).max(1).next_power_of_two());
                assert!(off.abs().max_element() <= 0.5 * finest, "{w} x {h}: {x}, {y}: {off}");
            }
        }
    }

    #[test]
    fn a_disc_sees_what_its_pixels_show() {
        let code = InverseCode::new(Raster::new(256, 192).unwrap());
        let stripe = code.stripe(4);
        let lit = stripe.on(DVec2::new(40.5, 20.5), 0.4).unwrap();
        assert_eq!(lit.share > 0.5, stripe.lit(40, 20));
        let below = stripe.on(DVec2::new(40.5, 150.5), 0.4).unwrap();
        assert_eq!(below.share > 0.5, stripe.lit(40, 150));
        assert!(lit.share + below.share == 1.0 || stripe.axis == 1);
        assert_eq!(code.stripe(5).on(DVec2::new(128.0, 30.0), 3.0), None);
    }
}
