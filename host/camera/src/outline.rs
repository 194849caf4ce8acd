//! Dark regions into their outlines, and outlines into quadrilaterals.

use crate::image::GreyImage;
use glam::DVec2;

/// Steps around a pixel, clockwise on the screen, from the right: E, SE, S, SW, W, NW, N, NE.
const STEPS: [(i32, i32); 8] = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)];
const WEST: usize = 4;

/// Marks a pixel whose left edge was followed.
const SEEN: u8 = 2;

/// Outlines with fewer pixels are too small for any tag.
const LEAST_LENGTH: usize = 40;

/// Pixels along the side of a quadrilateral that a tag of eight cells needs at least.
const LEAST_SIDE: f64 = 12.0;

/// A quadrilateral: its corners clockwise on the screen, pixels.
pub(crate) type Quad = [DVec2; 4];

/// The memory of the search, kept from picture to picture.
#[derive(Debug, Default)]
pub(crate) struct Outlines {
    points: Vec<(i32, i32)>,
}

impl Outlines {
    /// Follows the outline of every dark region and appends those that are quadrilaterals to `quads`, `most` at most. `dark`
    /// has one byte a pixel, 1 where it is dark and 0 along the border; marks are left in it.
    pub(crate) fn quads(
        &mut self,
        image: &GreyImage<'_>,
        dark: &mut [u8],
        quads: &mut Vec<Quad>,
        most: usize,
    ) {
        let (width, height) = (image.width(), image.height());
        let longest = 2 * (width + height);
        for y in 1..height - 1 {
            let row = y * width;
            let mut x = 1;
            while x < width - 1 {
                let Some(found) = next_start(&dark[row..row + width], x) else { break };
                x = found + 1;
                self.follow(dark, width, (found, y), longest);
                if quads.len() < most {
                    quads.extend(self.quad(longest));
                }
            }
        }
    }

    /// Follows an outline clockwise from a pixel whose left neighbour is not dark. An outline longer than `longest` is left.
    fn follow(&mut self, dark: &mut [u8], width: usize, start: (usize, usize), longest: usize) {
        self.points.clear();
        let offsets = STEPS.map(|(x, y)| x as isize + y as isize * width as isize);
        let first = start.1 * width + start.0;
        let (mut at, mut x, mut y) = (first, start.0 as i32, start.1 as i32);
        let mut outside = WEST;
        let mut first_turn = None;
        loop {
            if dark[at - 1] == 0 {
                dark[at] |= SEEN;
            }
            let next =
                (1..=8).map(|i| (outside + i) % 8).find(|d| dark[at.wrapping_add_signed(offsets[*d])] != 0);
            let Some(turn) = next else { return };
            if at == first && first_turn.is_some_and(|t| t == turn) {
                return;
            }
            first_turn.get_or_insert(turn);
            if self.points.len() <= longest {
                self.points.push((x, y));
            }
            at = at.wrapping_add_signed(offsets[turn]);
            (x, y) = (x + STEPS[turn].0, y + STEPS[turn].1);
            outside = if turn % 2 == 0 { (turn + 6) % 8 } else { (turn + 5) % 8 };
        }
    }

    /// The quadrilateral that the outline is, if it is one: convex, followed from outside, with straight sides.
    fn quad(&self, longest: usize) -> Option<Quad> {
        let points = &self.points;
        let n = points.len();
        if !(LEAST_LENGTH..=longest).contains(&n) {
            return None;
        }
        let (low, high) = points.iter().fold(((i32::MAX, i32::MAX), (i32::MIN, i32::MIN)), |(l, h), p| {
            ((l.0.min(p.0), l.1.min(p.1)), (h.0.max(p.0), h.1.max(p.1)))
        });
        if ((high.0 - low.0).min(high.1 - low.1) as f64) < 0.7 * LEAST_SIDE {
            return None;
        }
        // Twice the area; positive if the outline runs clockwise on the screen, around a region and not around a hole.
        let next = points.iter().cycle().skip(1);
        let area: i64 = points
            .iter()
            .zip(next)
            .map(|(a, b)| i64::from(a.0) * i64::from(b.1) - i64::from(b.0) * i64::from(a.1))
            .sum();
        let perimeter = n as f64;
        // A square has a sixteenth of its perimeter's square, a thin tag far less, a line none.
        if (area as f64) < 0.01 * perimeter * perimeter {
            return None;
        }
        let corners = self.corners(area as f64 * 0.5)?;
        let sides: Option<Vec<Line>> = (0..4).map(|i| self.side(corners[i], corners[(i + 1) % 4])).collect();
        let sides = sides?;
        let mut quad = [DVec2::ZERO; 4];
        for i in 0..4 {
            quad[i] = sides[(i + 3) % 4].meets(&sides[i])?;
            // The lines through the middle of the sides meet where the outline turns.
            let (x, y) = points[corners[i]];
            let apart = quad[i] - DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            if apart.length() > 4.0 + 0.05 * perimeter / 4.0 {
                return None;
            }
        }
        is_convex(&quad).then_some(quad)
    }

    /// The indices of four points between which the outline is straight, in its order.
    fn corners(&self, area: f64) -> Option<[usize; 4]> {
        let points = &self.points;
        let n = points.len();
        let (sx, sy) = points.iter().fold((0i64, 0i64), |s, p| (s.0 + i64::from(p.0), s.1 + i64::from(p.1)));
        let centre = ((sx / n as i64) as i32, (sy / n as i64) as i32);
        let far = |from: (i32, i32)| {
            let d = |p: &(i32, i32)| i64::from(p.0 - from.0).pow(2) + i64::from(p.1 - from.1).pow(2);
            (0..n).max_by_key(|i| d(&points[*i]))
        };
        // What is farthest from anything is a corner.
        let a = far(centre)?;
        let b = far(points[a])?;
        let mut corners = vec![a.min(b), a.max(b)];
        for _ in 0..2 {
            let (index, far) = (0..corners.len())
                .map(|i| self.farthest(corners[i], corners[(i + 1) % corners.len()]))
                .max_by(|a, b| a.1.total_cmp(&b.1))?;
            if far < 3.0 {
                return None;
            }
            corners.push(index);
            corners.sort_unstable();
        }
        let of = |i: usize| DVec2::new(f64::from(points[corners[i]].0), f64::from(points[corners[i]].1));
        let quad_area = 0.5 * (of(2) - of(0)).perp_dot(of(3) - of(1));
        if !(0.85..1.2).contains(&(area / quad_area)) {
            return None;
        }
        for i in 0..4 {
            let (from, to) = (corners[i], corners[(i + 1) % 4]);
            let side = (of((i + 1) % 4) - of(i)).length();
            if side < LEAST_SIDE || self.farthest(from, to).1 > 1.5 + 0.03 * side {
                return None;
            }
        }
        corners.try_into().ok()
    }

    /// The indices of the points from `from` to `to`, both excluded, across the end of the list.
    fn between(&self, from: usize, to: usize) -> impl Iterator<Item = usize> + Clone {
        let n = self.points.len();
        let count = (to + n - from) % n;
        (1..count).map(move |i| (from + i) % n)
    }

    /// The point between two of the outline that is farthest from their line, and how far that is.
    fn farthest(&self, from: usize, to: usize) -> (usize, f64) {
        let (a, b) = (self.points[from], self.points[to]);
        let (dx, dy) = (i64::from(b.0 - a.0), i64::from(b.1 - a.1));
        let off = |i: usize| {
            let p = self.points[i];
            (dx * i64::from(p.1 - a.1) - dy * i64::from(p.0 - a.0)).abs()
        };
        let found = self.between(from, to).map(|i| (i, off(i))).max_by_key(|f| f.1).unwrap_or((from, 0));
        (found.0, found.1 as f64 / ((dx * dx + dy * dy) as f64).sqrt().max(1e-9))
    }

    /// The line through the middle eight tenths of a side.
    fn side(&self, from: usize, to: usize) -> Option<Line> {
        let count = self.between(from, to).count();
        let skip = count / 10;
        let middle = self.between(from, to).skip(skip).take(count - 2 * skip);
        Line::through(middle.map(|i| {
            let (x, y) = self.points[i];
            DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)
        }))
    }
}

/// The first pixel from `x` on that is dark and unmarked and whose left neighbour is not dark.
fn next_start(row: &[u8], mut x: usize) -> Option<usize> {
    const ONES: u64 = 0x0101_0101_0101_0101;
    while x + 8 <= row.len() {
        let word = |at: usize| u64::from_le_bytes(row[at..at + 8].try_into().expect("eight bytes"));
        let (here, left) = (word(x), word(x - 1));
        let starts = here & !(here >> 1) & !left & ONES;
        if starts != 0 {
            return Some(x + starts.trailing_zeros() as usize / 8);
        }
        x += 8;
    }
    (x..row.len()).find(|x| row[*x] == 1 && row[x - 1] == 0)
}

/// Whether the corners go round clockwise on the screen, and turn to the same side at each.
pub(crate) fn is_convex(quad: &Quad) -> bool {
    (0..4).all(|i| {
        let [a, b, c] = [quad[i], quad[(i + 1) % 4], quad[(i + 2) % 4]];
        let (u, v) = ((b - a).normalize_or_zero(), (c - b).normalize_or_zero());
        // More than six degrees at each corner.
        u.perp_dot(v) > 0.1
    })
}

/// A line: a point and a unit normal.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Line {
    pub point: DVec2,
    pub normal: DVec2,
    /// Root mean square distance of the points from it.
    pub spread: f64,
}

impl Line {
    /// The line of least squared distance; `None` for fewer than two points, or points in one place.
    pub(crate) fn through(points: impl Iterator<Item = DVec2> + Clone) -> Option<Self> {
        let (n, sum) = points.clone().fold((0.0, DVec2::ZERO), |(n, s), p| (n + 1.0, s + p));
        if n < 2.0 {
            return None;
        }
        let point = sum / n;
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for p in points {
            let d = p - point;
            (xx, xy, yy) = (xx + d.x * d.x, xy + d.x * d.y, yy + d.y * d.y);
        }
        let (half, mean) = (0.5 * (xx - yy), 0.5 * (xx + yy));
        let root = half.hypot(xy);
        if root <= 1e-30 {
            return None;
        }
        // The direction of greatest spread is (cos, sin) of half the angle of (half, xy).
        let angle = 0.5 * xy.atan2(half);
        let normal = DVec2::new(-angle.sin(), angle.cos());
        Some(Self { point, normal, spread: ((mean - root).max(0.0) / n).sqrt() })
    }

    /// Where two lines meet; `None` if they are parallel to within two degrees.
    pub(crate) fn meets(&self, other: &Self) -> Option<DVec2> {
        let turn = self.normal.perp_dot(other.normal);
        if turn.abs() < 0.035 {
            return None;
        }
        let (a, b) = (self.normal.dot(self.point), other.normal.dot(other.point));
        Some(
            DVec2::new(a * other.normal.y - b * self.normal.y, b * self.normal.x - a * other.normal.x) / turn,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::threshold::Binary;

    fn quads_of(w: usize, h: usize, dark: impl Fn(f64, f64) -> bool) -> Vec<Quad> {
        let pixels: Vec<u8> = (0..w * h)
            .map(|i| if dark((i % w) as f64 + 0.5, (i / w) as f64 + 0.5) { 20 } else { 200 })
            .collect();
        let image = GreyImage::new(w, h, &pixels).unwrap();
        let mut binary = Binary::default();
        binary.fill(&image);
        let mut quads = Vec::new();
        Outlines::default().quads(&image, &mut binary.dark, &mut quads, 100);
        quads
    }

    #[test]
    fn turned_squares_are_found_and_discs_rings_and_strokes_are_not() {
        for turn in 0..18 {
            let (sin, cos) = (f64::from(turn) * 0.0873f64).sin_cos();
            let found = quads_of(160, 120, |x, y| {
                let (x, y) = (x - 80.3, y - 60.7);
                (x * cos + y * sin).abs() < 30.0 && (y * cos - x * sin).abs() < 30.0
            });
            assert_eq!(found.len(), 1, "turn {turn}");
            for corner in found[0] {
                let d = (corner - DVec2::new(80.3, 60.7)).length();
                assert!((d - 30.0 * 2f64.sqrt()).abs() < 1.2, "turn {turn}: {d}");
            }
            assert!(is_convex(&found[0]));
        }
        let none = [
            quads_of(160, 120, |x, y| (x - 80.0).hypot(y - 60.0) < 35.0),
            quads_of(160, 120, |x, y| (y - 60.0).abs() < 2.0 && (x - 80.0).abs() < 50.0),
            quads_of(160, 120, |x, y| {
                (x - 80.0).abs() < 30.0 && (y - 60.0).abs() < 30.0 && x - 70.0 > (y - 60.0).abs()
            }),
            // A bright square in the dark is a hole.
            quads_of(160, 120, |x, y| {
                (x - 80.0).hypot(y - 60.0) < 55.0 && !((x - 80.0).abs() < 25.0 && (y - 60.0).abs() < 25.0)
            }),
        ];
        assert!(none.iter().all(Vec::is_empty), "{none:?}");
    }

    #[test]
    fn lines_meet_where_they_should() {
        let at = |s: f64, d: DVec2| DVec2::new(3.0, 4.0) + d * s;
        let line = |d: DVec2| {
            Line::through((-9..9).map(|s| at(f64::from(s), d)).collect::<Vec<_>>().into_iter()).unwrap()
        };
        let (a, b) = (line(DVec2::new(0.8, 0.6)), line(DVec2::new(0.1, -0.9)));
        assert!((a.meets(&b).unwrap() - DVec2::new(3.0, 4.0)).length() < 1e-12 && a.spread < 1e-6);
        assert!(a.meets(&a).is_none());
    }
}
