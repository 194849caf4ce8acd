//! What the projector shows to a camera, and a camera's pixel back into the projector's pixel.
//!
//! All pictures are black and white and stand still while they are seen, so it does not matter when the camera exposes, nor how
//! the projector makes grey. For columns and for rows: the Gray code of the half period, each bit with its inverse, then
//! stripes that move by a pixel from picture to picture over a whole period. The phase of their first harmonic gives the
//! place in the period to a fraction of a pixel, and the Gray code which period it is; because it counts half periods, a bit
//! that is read wrong on its own border does no harm.

use dpm_device::planes::Raster;
use glam::DVec2;
use std::f64::consts::{PI, TAU};

/// Pixels of a period, and pictures in which the stripes move over it.
const PERIOD: u32 = 16;
/// Grey levels between dark and lit that a pixel of the camera needs.
const LEAST_SWING: f64 = 12.0;
/// Grey level from which a pixel may be saturated.
const SATURATED: u8 = 250;
/// Share of what stripes with sharp edges give that the first harmonic needs.
const LEAST_HARMONIC: f64 = 0.5;
/// Change of the lit picture over two pixels, as a share of it, beyond which a pixel lies on an edge: then the light of its two
/// sides counts unequally.
const MOST_SLOPE: f64 = 0.3;
/// Noise of a picture that is expected, grey levels; the residuals say what it is.
const NOISE: f64 = 2.0;
/// Deviation of a pixel that no noise explains, pixels of the projector.
const FLOOR_PX: f64 = 0.03;

/// The pictures for a raster.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewCode {
    raster: Raster,
}

/// What a picture shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum CodePicture {
    /// All lit, or all dark.
    Full(bool),
    /// A bit of the half period along an axis, or its inverse.
    Bit { axis: usize, bit: u32, is_inverse: bool },
    /// Stripes that have moved by so many pixels.
    Stripes { axis: usize, by: u32 },
}

/// A pixel of the camera that saw the code.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CodedPixel {
    /// Column and row of the camera.
    pub at: [usize; 2],
    /// The projector's pixel that lights it.
    pub pixel: DVec2,
    /// Its deviation along each axis, pixels of the projector.
    pub sigma_px: f64,
}

impl ViewCode {
    /// The code of a raster.
    pub fn new(raster: Raster) -> Self {
        Self { raster }
    }

    /// How many pictures there are. The first and the last but one are fully lit, those after them dark: between them nothing may
    /// move.
    pub fn pictures(&self) -> usize {
        4 + (0..2).map(|axis| (2 * self.bits(axis) + PERIOD) as usize).sum::<usize>()
    }

    fn side(&self, axis: usize) -> u32 {
        [self.raster.width(), self.raster.height()][axis]
    }

    fn bits(&self, axis: usize) -> u32 {
        let halves = self.side(axis).div_ceil(PERIOD / 2);
        (u32::BITS - (halves - 1).leading_zeros()).max(1)
    }

    /// The number of the first picture of an axis.
    fn first(&self, axis: usize) -> usize {
        2 + axis * (2 * self.bits(0) + PERIOD) as usize
    }

    fn shown(&self, picture: usize) -> CodePicture {
        if picture < 2 || picture + 2 >= self.pictures() {
            return CodePicture::Full(picture == 0 || picture + 2 == self.pictures());
        }
        let axis = usize::from(picture >= self.first(1));
        let (n, bits) = ((picture - self.first(axis)) as u32, self.bits(axis));
        match n.checked_sub(2 * bits) {
            None => CodePicture::Bit { axis, bit: n / 2, is_inverse: n % 2 == 1 },
            Some(by) => CodePicture::Stripes { axis, by },
        }
    }

    /// Whether a picture lights a pixel.
    pub fn lit(&self, picture: usize, x: u32, y: u32) -> bool {
        match self.shown(picture) {
            CodePicture::Full(is_lit) => is_lit,
            CodePicture::Bit { axis, bit, is_inverse } => {
                let half = [x, y][axis] / (PERIOD / 2);
                ((half ^ half >> 1) >> bit & 1 == 1) != is_inverse
            }
            CodePicture::Stripes { axis, by } => ([x, y][axis] + PERIOD - by) % PERIOD < PERIOD / 2,
        }
    }

    /// The pixels of the camera that saw the code. `seen`: a picture of the camera for each picture, rows of `width` pixels from
    /// above.
    pub fn decode(&self, seen: &[Vec<u8>], width: usize) -> Vec<CodedPixel> {
        let mut out = Vec::new();
        let pixels = seen.iter().map(Vec::len).min().unwrap_or(0);
        if seen.len() != self.pictures() || width < 3 || pixels < 3 * width {
            return out;
        }
        for y in 1..pixels / width - 1 {
            for x in 1..width - 1 {
                let at = y * width + x;
                let Some(swing) = swing(seen, at, width) else { continue };
                let place = (self.along(0, seen, at, swing), self.along(1, seen, at, swing));
                if let (Some(column), Some(row)) = place {
                    let sigma_px = (PERIOD as f64 / TAU * (2.0 / PERIOD as f64).sqrt() * PI / 2.0 * NOISE
                        / swing)
                        .hypot(FLOOR_PX);
                    out.push(CodedPixel { at: [x, y], pixel: DVec2::new(column, row), sigma_px });
                }
            }
        }
        out
    }

    /// The place along an axis.
    fn along(&self, axis: usize, seen: &[Vec<u8>], at: usize, swing: f64) -> Option<f64> {
        let (first, bits) = (self.first(axis), self.bits(axis));
        let level = |n: usize| f64::from(seen[first + n][at]);
        let mut code = 0u32;
        for bit in 0..bits as usize {
            code |= u32::from(level(2 * bit) > level(2 * bit + 1)) << bit;
        }
        let mut half = code;
        (1..bits).for_each(|by| half ^= code >> by);
        let about = (f64::from(half) + 0.5) * f64::from(PERIOD / 2);
        let (mut re, mut im) = (0.0, 0.0);
        for n in 0..PERIOD as usize {
            let (sin, cos) = (TAU * n as f64 / f64::from(PERIOD)).sin_cos();
            let value = level(2 * bits as usize + n);
            (re, im) = (re + value * cos, im + value * sin);
        }
        if re.hypot(im) < LEAST_HARMONIC * swing * f64::from(PERIOD) / PI {
            return None;
        }
        // A stripe that begins at the place is a sine, a quarter behind the cosine.
        let phase = (im.atan2(re) / TAU + 0.25) * f64::from(PERIOD);
        let whole = ((about - phase) / f64::from(PERIOD)).round() * f64::from(PERIOD);
        let place = whole + phase;
        let inside = place > 0.0 && place < f64::from(self.side(axis));
        (inside && (place - about).abs() <= f64::from(PERIOD / 2)).then_some(place)
    }
}

/// Grey levels between dark and lit, if they are enough, nothing is saturated, and the pixel lies on no edge.
fn swing(seen: &[Vec<u8>], at: usize, width: usize) -> Option<f64> {
    let lit = |i: usize| f64::from(seen[0][i]);
    let swing = lit(at) - f64::from(seen[1][at]);
    let slopes = [lit(at + 1) - lit(at - 1), lit(at + width) - lit(at - width)];
    let is_even = slopes.iter().all(|s| s.abs() < MOST_SLOPE * lit(at));
    (swing >= LEAST_SWING && seen[0][at] < SATURATED && is_even).then_some(swing)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A camera whose pixels see a piece of the projector's picture each: what is decoded is the middle of the piece.
    #[test]
    fn a_pixel_is_decoded_to_a_fraction_of_a_pixel() {
        let raster = Raster::new(200, 120).unwrap();
        let code = ViewCode::new(raster);
        let (w, h) = (80usize, 60usize);
        // Each pixel of the camera sees 1.7 x 1.3 pixels, averaged over 8 x 8 points.
        let (scale, from) = (DVec2::new(1.7, 1.3), DVec2::new(31.2, 20.7));
        let seen: Vec<Vec<u8>> = (0..code.pictures())
            .map(|n| {
                let share = |x: usize, y: usize| {
                    let at = |i: usize| {
                        DVec2::new(
                            x as f64 + (i % 8) as f64 / 8.0 + 0.0625,
                            y as f64 + (i / 8) as f64 / 8.0 + 0.0625,
                        )
                    };
                    let lit = |i: usize| {
                        let p = from + scale * at(i);
                        f64::from(u8::from(code.lit(n, p.x as u32, p.y as u32)))
                    };
                    (0..64).map(lit).sum::<f64>() / 64.0
                };
                (0..w * h).map(|i| (20.0 + 150.0 * share(i % w, i / w)).round() as u8).collect()
            })
            .collect();
        let found = code.decode(&seen, w);
        assert_eq!(found.len(), (w - 2) * (h - 2));
        for d in found {
            let truth = from + scale * DVec2::new(d.at[0] as f64 + 0.5, d.at[1] as f64 + 0.5);
            assert!((d.pixel - truth).abs().max_element() < 0.16, "{d:?} {truth}");
        }
    }

    #[test]
    fn what_saw_no_light_is_not_decoded() {
        let code = ViewCode::new(Raster::new(64, 48).unwrap());
        let dark = vec![vec![30u8; 400]; code.pictures()];
        assert!(code.decode(&dark, 20).is_empty());
        assert!(code.decode(&dark[1..], 20).is_empty());
    }
}
