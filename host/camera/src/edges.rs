//! The edges of a tag to hundredths of a pixel, and its corners where they meet.
//!
//! Every row of pixels that an edge crosses, or every column, says where: as much of it is black as its light is short of
//! white. A pixel's value is the light on its area, so this sum is exact for edges however sharp, and blur that is the same
//! to both sides, of the lens or of motion, leaves it alone. What the levels of black and white are off by shifts the edge
//! by as many pixels as were added up; so an edge is looked for from afar first, then again from as near as its blur
//! allows, with the levels of all that lies between the blur and the next cell. The points go through the lens before a
//! line is laid through them, because lenses bend edges.

use crate::image::GreyImage;
use crate::outline::{Line, Quad};
use dpm_device::tag36h11::CELLS;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::DVec2;

/// How far an edge is followed to either side at most, pixels.
const REACH: std::ops::RangeInclusive<f64> = 1.5..=7.0;
/// Beyond a cell begin the code and the surroundings, whose light blur carries so far, pixels.
const BLUR_PX: f64 = 1.3;
/// An edge is followed at least so far where a cell has the room, pixels: a sharp one takes up one pixel and part of
/// another.
const NEAR_PX: f64 = 2.0;
/// The outline of a dark region goes through the middles of its outermost pixels, so far inside of the edge, pixels.
const OUTLINE_PX: f64 = 0.45;
/// Looks at an edge, each from the line that the one before has found.
const LOOKS: usize = 3;
/// Pixels at each end of the way that give black and white, where blur reaches as far as a cell.
const ENDS: usize = 2;
/// Black and white are means over this many places to either side.
const LEVEL_PLACES: usize = 4;
/// Places along an edge.
const MOST_PLACES: usize = 64;
/// An edge with fewer good places is no edge.
const LEAST_PLACES: usize = 3;
/// Pixels across an edge: [`REACH`] to both sides of one that runs along a diagonal.
const MOST_ACROSS: usize = 24;
/// Standard deviation of a corner that noise does not explain: unequal light and blur. Pixels.
const FLOOR_PX: f64 = 0.02;
/// Standard deviation of where a sensor shows an edge that runs along its pixels: their gaps and the differences between them
/// shift it by the same amount all along. An edge that crosses pixels on its way meets them in all places, which average.
const PHASE_PX: f64 = 0.06;

/// Corners of a tag.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Corners {
    /// In the order of the quadrilateral, pixels.
    pub pixels: Quad,
    /// Standard deviation of each along each axis, pixels.
    pub sigma_px: [f64; 4],
}

/// The corners of the tag in a quadrilateral that is good to a pixel.
pub(crate) fn refine(
    image: &GreyImage<'_>,
    quad: &Quad,
    contrast: f64,
    lens: Option<&ProjectorCamera>,
) -> Option<Corners> {
    let lens = Bend(lens);
    let mut lines = [(Line { point: DVec2::ZERO, normal: DVec2::X, spread: 0.0 }, 0.0); 4];
    for (i, line) in lines.iter_mut().enumerate() {
        *line = Edge::of(quad, i).line(image, contrast, lens)?;
    }
    let mut corners = Corners { pixels: [DVec2::ZERO; 4], sigma_px: [0.0; 4] };
    for i in 0..4 {
        let (before, after) = (&lines[(i + 3) % 4], &lines[i]);
        let meeting = lens.pixel(before.0.meets(&after.0)?)?;
        if (meeting - quad[i]).length() > 3.0 {
            return None;
        }
        corners.pixels[i] = meeting;
        // The lines meet at an angle; the flatter, the farther an error carries.
        let sine = before.0.normal.perp_dot(after.0.normal).abs().max(0.1);
        let end = (0.5 * (before.1 * before.1 + after.1 * after.1)).sqrt() / sine;
        corners.sigma_px[i] = end.hypot(FLOOR_PX);
    }
    Some(corners)
}

/// The lens, if there is one, between pixels and a plane in which edges are straight, in pixels too.
#[derive(Clone, Copy)]
struct Bend<'a>(Option<&'a ProjectorCamera>);

impl Bend<'_> {
    fn straight(self, p: DVec2) -> Option<DVec2> {
        match self.0 {
            Some(camera) => camera.straight_of_pixel(p).map(|s| s * camera.fx),
            None => Some(p),
        }
    }

    fn pixel(self, p: DVec2) -> Option<DVec2> {
        match self.0 {
            Some(camera) => camera.lens.distort(p / camera.fx).map(|bent| camera.pixel_of_bent(bent)),
            None => Some(p),
        }
    }
}

/// One side of a quadrilateral.
struct Edge {
    start: DVec2,
    along: DVec2,
    /// Towards the white margin.
    outside: DVec2,
    length: f64,
    /// How far it may be followed to either side, pixels.
    most: f64,
    /// How far an edge that is followed so far leans into the corners at its start and its end, per pixel of the way.
    lean: [f64; 2],
    /// It is crossed by rows; else by columns.
    by_rows: bool,
}

/// How an edge lies off the side of the quadrilateral: pixels outside of it at its begin, middle and end.
type Bow = [f64; 3];

/// Where an edge was found.
struct Course {
    /// In the plane of straight edges.
    points: [DVec2; MOST_PLACES],
    found: usize,
    /// Mean distance from the edge of the light that blur has moved across it, pixels.
    blur: f64,
}

impl Edge {
    /// From corner `i` to the next.
    fn of(quad: &Quad, i: usize) -> Self {
        let [a, b, c, d] = std::array::from_fn(|k| quad[(i + k) % 4]);
        let along = (b - a).normalize_or_zero();
        let outside = DVec2::new(along.y, -along.x);
        // The opposite edge bounds how wide a cell is across this one.
        let cell = (a - d).dot(outside).min((b - c).dot(outside)) / CELLS as f64;
        // At a sharp corner the way inwards soon leaves the border through the other edge.
        let lean = |here: DVec2, there: DVec2, next: DVec2| {
            let (u, v) = (there - here, next - here);
            (u.dot(v) / u.perp_dot(v).abs().max(1e-9)).max(0.0)
        };
        let by_rows = outside.x.abs() > outside.y.abs();
        // Rows and columns cross it at an angle.
        let slant = (along.x / along.y).abs().min((along.y / along.x).abs());
        Self {
            start: a,
            along,
            outside,
            length: (b - a).length(),
            most: (cell - BLUR_PX).clamp(*REACH.start(), *REACH.end()),
            lean: [lean(a, b, d), lean(b, a, c)].map(|lean| lean + slant),
            by_rows,
        }
    }

    /// Its line, and the standard deviation of the line's end.
    fn line(&self, image: &GreyImage<'_>, contrast: f64, lens: Bend<'_>) -> Option<(Line, f64)> {
        let (mut bow, mut reach, mut found) = ([OUTLINE_PX; 3], self.most, None);
        for _ in 0..LOOKS {
            let span = self.span(reach);
            let mut course = self.follow(image, span, &bow, reach, contrast, lens);
            let (line, kept) = course.line()?;
            bow = self.bow(&line, span, lens)?;
            reach = (1.25 + 3.0 * course.blur).clamp(NEAR_PX.min(self.most), self.most);
            // The end of a line through n evenly spread points has four times the variance of a mean; the corner lies beyond.
            let beyond = self.length / (span[1] - span[0]).max(1.0);
            let spread = line.spread.max(0.005) / ((kept - 2) as f64).sqrt();
            let crossed = self.crossed(self.along).x.abs() * (span[1] - span[0]);
            found = Some((line, (2.0 * beyond * spread).hypot(PHASE_PX / (1.0 + crossed))));
        }
        found
    }

    /// Where along it places begin and end, pixels from its start.
    fn span(&self, reach: f64) -> [f64; 2] {
        let margin = self.lean.map(|lean| (1.0 + reach.max(self.most * lean)).min(0.3 * self.length));
        [margin[0], self.length - margin[1]]
    }

    /// How a line lies off the side.
    fn bow(&self, line: &Line, span: [f64; 2], lens: Bend<'_>) -> Option<Bow> {
        let mut bow = [0.0; 3];
        for (i, out) in bow.iter_mut().enumerate() {
            let side = self.start + self.along * (span[0] + 0.5 * i as f64 * (span[1] - span[0]));
            let straight = lens.straight(side)?;
            let off = line.normal.dot(straight - line.point);
            *out = (lens.pixel(straight - line.normal * off)? - side).dot(self.outside);
        }
        Some(bow)
    }

    /// Follows it along the places of `span`, `reach` pixels to either side.
    fn follow(
        &self,
        image: &GreyImage<'_>,
        span: [f64; 2],
        bow: &Bow,
        reach: f64,
        contrast: f64,
        lens: Bend<'_>,
    ) -> Course {
        let [begin, end] = span.map(|t| self.crossed(self.start + self.along * t).y);
        let first = (begin.min(end) - 0.5).ceil() as i64;
        let last = (begin.max(end) - 0.5).floor() as i64;
        let stride = (last - first + 1).max(1).unsigned_abs().div_ceil(MOST_PLACES as u64) as usize;
        let mut ways = [Way::default(); MOST_PLACES];
        let mut count = 0;
        for v in (first..=last).step_by(stride) {
            if let Some(way) = self.way(image, v, span, bow, reach) {
                ways[count] = way;
                count += 1;
            }
        }
        let mut course = Course { points: [DVec2::ZERO; MOST_PLACES], found: 0, blur: 0.0 };
        let mut blur = 0.0;
        for k in 0..count {
            let near = &ways[k.saturating_sub(LEVEL_PLACES)..(k + LEVEL_PLACES + 1).min(count)];
            let sum = near.iter().fold([0.0; 2], |s, w| [s[0] + w.levels[0], s[1] + w.levels[1]]);
            let levels = sum.map(|s| s / near.len() as f64);
            if levels[1] - levels[0] < 0.4 * contrast {
                continue;
            }
            let (u, moved) = ways[k].crossing(levels);
            if let Some(p) = lens.straight(self.crossed(DVec2::new(u, ways[k].v))) {
                course.points[course.found] = p;
                course.found += 1;
                blur += moved;
            }
        }
        let across = self.crossed(self.outside).x.abs();
        course.blur = blur * across / course.found.max(1) as f64;
        course
    }

    /// A place as (along the rows or columns that cross the edge, which of them), and back.
    fn crossed(&self, p: DVec2) -> DVec2 {
        if self.by_rows {
            p
        } else {
            DVec2::new(p.y, p.x)
        }
    }

    /// The row or column number `v` where it crosses the edge; `None` if it leaves the picture there.
    fn way(&self, image: &GreyImage<'_>, v: i64, span: [f64; 2], bow: &Bow, reach: f64) -> Option<Way> {
        let [start, along, outside] = [self.start, self.along, self.outside].map(|p| self.crossed(p));
        let middle = v as f64 + 0.5;
        let at = |off: f64| (middle - start.y - outside.y * off) / along.y;
        let off = |t: f64| {
            let x = (t - span[0]) / (span[1] - span[0]).max(1.0);
            let [a, b, c] = *bow;
            a * (1.0 - x) * (1.0 - 2.0 * x) + 4.0 * b * x * (1.0 - x) + c * x * (2.0 * x - 1.0)
        };
        let off = off(at(off(at(0.0))));
        let there = start.x + along.x * at(off) + outside.x * off;
        let by = 1.0 / outside.x;
        // From the innermost pixel to the outermost, and those in which the edge is looked for.
        let pixel = |across: f64| (there + by * across).floor() as i64;
        let [inmost, inner, outer, outmost] = [-self.most, -reach, reach, self.most].map(pixel);
        let count = (outmost - inmost).unsigned_abs() as usize + 1;
        let [w, h] = [image.width(), image.height()].map(|side| side as i64);
        let [most_u, most_v] = if self.by_rows { [w, h] } else { [h, w] };
        let inside = |u: i64| (0..most_u).contains(&u);
        if count > MOST_ACROSS || !inside(inmost) || !inside(outmost) || !(0..most_v).contains(&v) {
            return None;
        }
        let step = if by > 0.0 { 1 } else { -1 };
        let mut values = [0.0; MOST_ACROSS];
        for (k, value) in values[..count].iter_mut().enumerate() {
            let u = inmost + step * k as i64;
            let [x, y] = if self.by_rows { [u, v] } else { [v, u] };
            *value = f64::from(image.row(y as usize)[x as usize]);
        }
        let [black, white] = [inner - inmost, outmost - outer].map(|n| n.unsigned_abs() as usize);
        let ends = ENDS.min(count / 3);
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
        let levels = [mean(&values[..black.max(ends)]), mean(&values[count - white.max(ends)..count])];
        values.copy_within(black..count - white, 0);
        let begin = if step > 0 { inner as f64 } else { (inner + 1) as f64 };
        Some(Way { v: middle, begin, step: step as f64, values, count: count - black - white, levels })
    }
}

/// A row or column of pixels across an edge, from black to white.
#[derive(Clone, Copy, Default)]
struct Way {
    /// Its middle.
    v: f64,
    /// Where its first pixel begins, and the direction of the next.
    begin: f64,
    step: f64,
    values: [f64; MOST_ACROSS],
    count: usize,
    /// Black and white by what lies before and behind it.
    levels: [f64; 2],
}

impl Way {
    /// Where the edge crosses, and the mean distance of the light that blur has moved across it, pixels along the way.
    fn crossing(&self, [black, white]: [f64; 2]) -> (f64, f64) {
        /// Below this share of the contrast it may be noise.
        const LEAST_MOVED: f64 = 0.1;
        let (mut missing, mut moved) = (0.0, 0.0);
        for value in &self.values[..self.count] {
            let short = (white - value) / (white - black);
            missing += short;
            let by = short.min(1.0 - short);
            moved += if by > LEAST_MOVED { by } else { 0.0 };
        }
        (self.begin + self.step * missing, moved)
    }
}

impl Course {
    /// The line through the points that are near it, of which there are so many.
    fn line(&mut self) -> Option<(Line, usize)> {
        let through = |points: &[DVec2]| {
            (points.len() >= LEAST_PLACES).then(|| Line::through(points.iter().copied()))?
        };
        let first = through(&self.points[..self.found])?;
        // What lies far off, by a reflection or a finger, is left out once.
        let most = (2.5 * first.spread).max(0.02);
        let mut kept = 0;
        for k in 0..self.found {
            if first.normal.dot(self.points[k] - first.point).abs() <= most {
                self.points[kept] = self.points[k];
                kept += 1;
            }
        }
        Some((through(&self.points[..kept])?, kept))
    }
}
