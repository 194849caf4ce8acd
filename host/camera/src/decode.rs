//! The inside of a quadrilateral into the number of a tag, or into nothing.
//!
//! A tag is never guessed: the border must be dark and the margin around it bright everywhere, by light that changes
//! evenly over the tag, and the cells must be those of one of the family's codes but for at most two that are neither
//! black nor white. Two codes differ in eleven cells, so what is corrected cannot be another tag's; and a square with cells
//! that are as clear as a print's is no tag, even where a code differs from it in one cell only.

use crate::image::GreyImage;
use crate::outline::Quad;
use dpm_device::tag36h11::{CELLS, CODE, CODES};
use glam::{DMat3, DVec2, DVec3};

/// Cells that may be read wrong and are corrected.
const MOST_WRONG: u32 = 2;
/// They lie away from the middle between black and white by less than this share of half their difference.
const MOST_WRONG_CLEARNESS: f64 = 0.4;
/// Of the 36 cells of the margin, how many need not be bright: a finger, a shadow, a neighbour.
const MARGIN_MISSED: usize = 3;
/// Grey levels between white and black that a tag needs.
const LEAST_CONTRAST: f64 = 20.0;
/// Cells of the code must lie away from the middle between black and white by this share of half their difference, in the
/// mean.
const LEAST_CLEARNESS: f64 = 0.45;

/// A number read from a quadrilateral.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Reading {
    /// The tag's number in its family.
    pub id: u16,
    /// By how many corners the quadrilateral is turned: its corner `turn` is the upper left one of the tag.
    pub turn: usize,
    /// Cells that were read wrong.
    pub wrong: u32,
    /// Grey levels between white and black, in the mean.
    pub contrast: f64,
}

/// All codes in all four turns: the bits, and number and turn.
#[derive(Debug)]
pub(crate) struct Family {
    turned: Vec<(u64, u16, u8)>,
}

impl Family {
    pub(crate) fn new() -> Self {
        let mut turned = Vec::with_capacity(4 * CODES.len());
        for (id, code) in CODES.iter().enumerate() {
            let mut bits = *code;
            for turn in 0..4u8 {
                turned.push((bits, id as u16, turn));
                bits = clockwise(bits);
            }
        }
        Self { turned }
    }

    /// How many tags it has.
    pub(crate) const LEN: usize = CODES.len();

    /// The tag whose cells these are, up to [`MOST_WRONG`] of them: its number and turn, and those that are wrong.
    fn find(&self, bits: u64) -> Option<(u16, usize, u64)> {
        let (known, id, turn) = self.turned.iter().min_by_key(|(known, ..)| (known ^ bits).count_ones())?;
        let wrong = known ^ bits;
        (wrong.count_ones() <= MOST_WRONG).then_some((*id, usize::from(*turn), wrong))
    }
}

/// The cells after a quarter turn clockwise.
fn clockwise(bits: u64) -> u64 {
    let mut out = 0;
    for y in 0..CODE {
        for x in 0..CODE {
            if bits >> (CODE * CODE - 1 - ((CODE - 1 - x) * CODE + y)) & 1 == 1 {
                out |= 1 << (CODE * CODE - 1 - (y * CODE + x));
            }
        }
    }
    out
}

/// The homography that takes the unit square's corners (0,0), (1,0), (1,1), (0,1) to those of a quadrilateral
/// (\[Heckbert89\]); `None` if it is degenerate.
pub(crate) fn from_unit_square(q: &Quad) -> Option<DMat3> {
    let [a, b, c, d] = *q;
    let sum = a - b + c - d;
    let (d1, d2) = (b - c, d - c);
    let det = d1.perp_dot(d2);
    if det.abs() < 1e-12 {
        return None;
    }
    let (g, h) = (sum.perp_dot(d2) / det, d1.perp_dot(sum) / det);
    let x = b - a + b * g;
    let y = d - a + d * h;
    Some(DMat3::from_cols(x.extend(g), y.extend(h), a.extend(1.0)))
}

/// Where a homography takes a point.
pub(crate) fn apply(h: &DMat3, p: DVec2) -> DVec2 {
    let q = *h * p.extend(1.0);
    q.truncate() / q.z
}

/// A grey level that changes evenly over the tag: `(a, b, c) . (x, y, 1)`.
struct Level(DVec3);

impl Level {
    /// The plane of least squares through the values.
    fn fit(values: &[(DVec2, f64)]) -> Option<Self> {
        let (mut m, mut v) = (DMat3::ZERO, DVec3::ZERO);
        for (p, value) in values {
            let p = p.extend(1.0);
            m += DMat3::from_cols(p * p.x, p * p.y, p);
            v += p * *value;
        }
        (m.determinant().abs() > 1e-12).then(|| Self(m.inverse() * v))
    }

    fn at(&self, p: DVec2) -> f64 {
        self.0.dot(p.extend(1.0))
    }
}

/// Reads the quadrilateral `quad` of the picture.
pub(crate) fn read(image: &GreyImage<'_>, quad: &Quad, family: &Family) -> Option<Reading> {
    let h = from_unit_square(quad)?;
    // The middle of a cell, in cells from the upper left corner of the border, as a share of the side.
    let place = |x: i32, y: i32| DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) / CELLS as f64;
    let value = |p: DVec2| -> Option<f64> {
        let apart = 0.22 / CELLS as f64;
        let mut sum = image.at(apply(&h, p))?;
        for (dx, dy) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
            sum += image.at(apply(&h, p + DVec2::new(dx, dy) * apart))?;
        }
        Some(0.2 * sum)
    };
    let ring = |low: i32, high: i32| {
        let side = low..=high;
        side.clone()
            .flat_map(move |y| side.clone().map(move |x| (x, y)))
            .filter(move |(x, y)| *x == low || *x == high || *y == low || *y == high)
    };
    let n = CELLS as i32;
    let values = |low: i32, high: i32| -> Vec<(DVec2, f64)> {
        ring(low, high).filter_map(|(x, y)| Some((place(x, y), value(place(x, y))?))).collect()
    };
    let (border, margin) = (values(0, n - 1), values(-1, n));
    let (border_cells, margin_cells) = (4 * (CELLS - 1), 4 * (CELLS + 1));
    if border.len() < border_cells || margin.len() + MARGIN_MISSED < margin_cells {
        return None;
    }
    let (black, white) = (Level::fit(&border)?, Level::fit(&margin)?);
    let middle = |p: DVec2| 0.5 * (black.at(p) + white.at(p));
    let bright = margin.iter().filter(|(p, v)| *v > middle(*p)).count();
    if border.iter().any(|(p, v)| *v >= middle(*p)) || bright + MARGIN_MISSED < margin_cells {
        return None;
    }
    let corners = [(-1, -1), (n, -1), (-1, n), (n, n)].map(|(x, y)| place(x, y));
    let contrasts = corners.map(|p| white.at(p) - black.at(p));
    if contrasts.iter().any(|c| *c < LEAST_CONTRAST) {
        return None;
    }
    let (mut bits, mut unclear, mut clear) = (0u64, 0u64, 0.0);
    for y in 1..n - 1 {
        for x in 1..n - 1 {
            let p = place(x, y);
            let level = (value(p)? - middle(p)) / (0.5 * (white.at(p) - black.at(p)));
            bits = bits << 1 | u64::from(level > 0.0);
            unclear = unclear << 1 | u64::from(level.abs() < MOST_WRONG_CLEARNESS);
            clear += level.abs().min(1.0);
        }
    }
    if clear < LEAST_CLEARNESS * (CODE * CODE) as f64 {
        return None;
    }
    let (id, turn, wrong) = family.find(bits)?;
    if wrong & !unclear != 0 {
        return None;
    }
    Some(Reading { id, turn, wrong: wrong.count_ones(), contrast: 0.25 * contrasts.iter().sum::<f64>() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turned_tag_is_itself_and_no_two_are_alike() {
        let family = Family::new();
        for (id, code) in CODES.iter().enumerate() {
            let quarter = clockwise(*code);
            assert_eq!(family.find(quarter), Some((id as u16, 1, 0)));
            assert_eq!(clockwise(clockwise(clockwise(quarter))), *code);
            // Two wrong cells are corrected, three are refused.
            assert_eq!(family.find(code ^ 0x8_0000_0001), Some((id as u16, 0, 0x8_0000_0001)));
            assert_eq!(family.find(code ^ 0x8_0010_0001), None);
        }
    }

    #[test]
    fn the_square_goes_to_the_quadrilateral() {
        let quad = [DVec2::new(3.0, 1.0), DVec2::new(10.0, 2.0), DVec2::new(12.0, 9.0), DVec2::new(1.0, 7.0)];
        let h = from_unit_square(&quad).unwrap();
        let unit = [DVec2::ZERO, DVec2::X, DVec2::ONE, DVec2::Y];
        for (p, q) in unit.iter().zip(quad) {
            assert!((apply(&h, *p) - q).length() < 1e-12);
        }
    }
}
