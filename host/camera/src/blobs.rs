//! A picture into bright spots with their centres: markers of retro-reflective tape, lit from beside the lens.
//!
//! The centre is the mean of the pixels of a box about the spot, each weighted by what it exceeds its surroundings, so that no
//! pixel comes or goes as a whole at the rim.

use crate::image::GreyImage;
use crate::threshold::Binary;
use glam::DVec2;

/// Pixels around a spot that belong to it: the slope at its rim.
const RIM: usize = 3;
/// Spots of a picture that are kept, the brightest first.
const MOST_SPOTS: usize = 64;
/// Pixels of a spot at most: what is larger is a lamp or a window.
const LARGEST: usize = 6400;
/// Standard deviation of a grey level that is assumed, and of a centre without noise.
const NOISE: f64 = 2.0;
const FLOOR_PX: f64 = 0.03;

/// A bright spot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SpotSighting {
    /// Its centre, pixels.
    pub centre: DVec2,
    /// Standard deviation of the centre along each axis, pixels.
    pub sigma_px: f64,
    /// Sum of what its pixels exceed the surroundings, grey levels.
    pub weight: f64,
}

/// Finds bright spots. It keeps its memory from picture to picture.
#[derive(Debug, Default)]
pub struct SpotDetector {
    seen: Vec<u8>,
    stack: Vec<usize>,
    dirty: Vec<usize>,
    binary: Binary,
}

impl SpotDetector {
    /// The spots of a picture that reach the grey level `level` (1 to 255), brightest first.
    pub fn detect(&mut self, image: &GreyImage<'_>, level: u8, spots: &mut Vec<SpotSighting>) {
        spots.clear();
        let width = image.width();
        if self.seen.len() != image.pixels().len() {
            self.seen = vec![0; image.pixels().len()];
        }
        self.binary.extremes(image);
        let (columns, bright) = self.binary.brightest(image);
        let tiles: Vec<usize> = (0..bright.len()).filter(|t| bright[*t] >= level).collect();
        for tile in tiles {
            let (left, top) = (tile % columns * Binary::TILE, tile / columns * Binary::TILE);
            for at in
                (0..Binary::TILE).flat_map(|y| (0..Binary::TILE).map(move |x| (top + y) * width + left + x))
            {
                if image.pixels()[at] >= level && self.seen[at] == 0 {
                    spots.extend(self.spot(image, at, level));
                }
            }
        }
        for at in self.dirty.drain(..) {
            self.seen[at] = 0;
        }
        spots.sort_by(|a, b| b.weight.total_cmp(&a.weight));
        spots.truncate(MOST_SPOTS);
    }

    /// The spot around a bright pixel; `None` at the border, and for what is too large or too long.
    fn spot(&mut self, image: &GreyImage<'_>, start: usize, level: u8) -> Option<SpotSighting> {
        let (w, h) = (image.width(), image.height());
        let (mut low, mut high) = ((w, h), (0, 0));
        let mut count = 0;
        self.stack.push(start);
        self.seen[start] = 1;
        self.dirty.push(start);
        while let Some(at) = self.stack.pop() {
            let (x, y) = (at % w, at / w);
            count += 1;
            (low, high) = ((low.0.min(x), low.1.min(y)), (high.0.max(x), high.1.max(y)));
            let near = [
                (x > 0, at.wrapping_sub(1)),
                (x + 1 < w, at + 1),
                (y > 0, at.wrapping_sub(w)),
                (y + 1 < h, at + w),
            ];
            for next in near.into_iter().filter(|n| n.0).map(|n| n.1) {
                if self.seen[next] == 0 && image.pixels()[next] >= level {
                    self.seen[next] = 1;
                    self.dirty.push(next);
                    self.stack.push(next);
                }
            }
        }
        let (long, short) =
            ((high.0 - low.0).max(high.1 - low.1) + 1, (high.0 - low.0).min(high.1 - low.1) + 1);
        let inside = low.0 >= RIM && low.1 >= RIM && high.0 + RIM < w && high.1 + RIM < h;
        if !inside || !(2..=LARGEST).contains(&count) || long > 4 * short + 4 || 4 * count < long * short {
            return None;
        }
        weigh(image, (low.0 - RIM, low.1 - RIM), (high.0 + RIM, high.1 + RIM))
    }
}

/// The centre of what a box exceeds the brightest pixel of its own edge: then no edge of something behind the spot shifts it. What
/// a spot has below that is left out all around.
fn weigh(image: &GreyImage<'_>, low: (usize, usize), high: (usize, usize)) -> Option<SpotSighting> {
    let value = |x: usize, y: usize| f64::from(image.row(y)[x]);
    let across = (low.0..=high.0).flat_map(|x| [value(x, low.1), value(x, high.1)]);
    let down = (low.1..=high.1).flat_map(|y| [value(low.0, y), value(high.0, y)]);
    let ground = across.chain(down).fold(0.0, f64::max);
    let middle = DVec2::new((low.0 + high.0 + 1) as f64, (low.1 + high.1 + 1) as f64) * 0.5;
    let (mut weight, mut moment, mut square) = (0.0, DVec2::ZERO, 0.0);
    for y in low.1..=high.1 {
        for x in low.0..=high.0 {
            let v = value(x, y) - ground;
            if v > 0.0 {
                let d = DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - middle;
                (weight, moment, square) = (weight + v, moment + d * v, square + 0.5 * d.length_squared());
            }
        }
    }
    if weight < 100.0 {
        return None;
    }
    let sigma_px = (NOISE * square.sqrt() / weight).hypot(FLOOR_PX);
    Some(SpotSighting { centre: middle + moment / weight, sigma_px, weight })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A disc, integrated over each pixel by 20 x 20 points.
    fn picture(discs: &[(DVec2, f64)]) -> Vec<u8> {
        let covered = |i: usize, j: usize| {
            let points = (0..400).map(|k| {
                DVec2::new(
                    i as f64 + ((k % 20) as f64 + 0.5) / 20.0,
                    j as f64 + ((k / 20) as f64 + 0.5) / 20.0,
                )
            });
            let inside = |p: &DVec2| discs.iter().any(|(c, r)| (*p - *c).length() < *r);
            points.filter(inside).count() as f64 / 400.0
        };
        (0..128 * 96).map(|k| (20.0 + 200.0 * covered(k % 128, k / 128)).round() as u8).collect()
    }

    #[test]
    fn centres_are_those_of_the_discs() {
        let discs =
            [(DVec2::new(30.27, 41.81), 4.3), (DVec2::new(80.5, 20.0), 2.1), (DVec2::new(100.1, 70.4), 7.7)];
        let pixels = picture(&discs);
        let mut spots = Vec::new();
        let mut detector = SpotDetector::default();
        for _ in 0..2 {
            detector.detect(&GreyImage::new(128, 96, &pixels).unwrap(), 100, &mut spots);
            assert_eq!(spots.len(), 3);
            for (centre, _) in discs {
                let nearest =
                    spots.iter().map(|s| (s.centre - centre).length()).fold(f64::INFINITY, f64::min);
                assert!(nearest < 0.02, "{nearest}");
            }
        }
    }

    #[test]
    fn a_stroke_a_cut_disc_and_a_single_pixel_are_no_markers() {
        let mut pixels = picture(&[(DVec2::new(1.0, 40.0), 5.0)]);
        (20..100).for_each(|x| pixels[70 * 128 + x] = 220);
        pixels[20 * 128 + 60] = 255;
        let mut spots = Vec::new();
        SpotDetector::default().detect(&GreyImage::new(128, 96, &pixels).unwrap(), 100, &mut spots);
        assert!(spots.is_empty(), "{spots:?}");
    }
}
