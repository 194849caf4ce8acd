//! The edges of a tag to hundredths of a pixel, and its corners where they meet.
//!
//! Across each edge the grey level is followed from the black border to the white margin. Where the edge is follows from
//! how much of the way was black: the area above the curve. Blur that is the same to both sides, of the lens or of
//! motion, leaves that area alone. The points go through the lens before a line is laid through them, because lenses
//! bend edges.

use crate::image::GreyImage;
use crate::outline::{Line, Quad};
use dpm_device::tag36h11::CELLS;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::DVec2;

/// Steps across an edge, pixels.
const STEP: f64 = 0.5;
/// How far an edge is followed to either side, pixels.
const REACH: std::ops::RangeInclusive<f64> = 1.5..=7.0;
/// Beyond a cell begin the code and the surroundings, whose light blur carries so far, pixels.
const BLUR_PX: f64 = 1.3;
/// Samples at each end of the way that give black and white.
const ENDS: usize = 2;
/// Places along an edge.
const MOST_PLACES: usize = 64;
/// An edge with fewer good places is no edge.
const LEAST_PLACES: usize = 6;
/// Standard deviation of a corner that noise does not explain: interpolation, unequal light and blur. Pixels.
const FLOOR_PX: f64 = 0.025;

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
    let straight = |p: DVec2| match lens {
        Some(camera) => camera.straight_of_pixel(p).map(|s| s * camera.fx),
        None => Some(p),
    };
    let pixel = |p: DVec2| match lens {
        Some(camera) => camera.lens.distort(p / camera.fx).map(|bent| camera.pixel_of_bent(bent)),
        None => Some(p),
    };
    let mut lines = [(Line { point: DVec2::ZERO, normal: DVec2::X, spread: 0.0 }, 0.0); 4];
    for (i, line) in lines.iter_mut().enumerate() {
        *line = edge(image, quad, i, contrast, &straight)?;
    }
    let mut corners = Corners { pixels: [DVec2::ZERO; 4], sigma_px: [0.0; 4] };
    for i in 0..4 {
        let (before, after) = (&lines[(i + 3) % 4], &lines[i]);
        let meeting = pixel(before.0.meets(&after.0)?)?;
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

/// The line of the edge from corner `i` to the next, and the standard deviation of its end.
fn edge(
    image: &GreyImage<'_>,
    quad: &Quad,
    i: usize,
    contrast: f64,
    straight: &impl Fn(DVec2) -> Option<DVec2>,
) -> Option<(Line, f64)> {
    let [a, b, c, d] = std::array::from_fn(|k| quad[(i + k) % 4]);
    let along = (b - a).normalize_or_zero();
    let outside = DVec2::new(along.y, -along.x);
    let length = (b - a).length();
    // The opposite edge bounds how wide a cell is across this one.
    let across = (a - d).dot(outside).min((b - c).dot(outside)) / CELLS as f64;
    let reach = (across - BLUR_PX).clamp(*REACH.start(), *REACH.end());
    let steps = (reach / STEP).floor() as i32;
    // At a sharp corner the way inwards soon leaves the border through the other edge.
    let margin = |here: DVec2, there: DVec2, next: DVec2| {
        let (u, v) = (there - here, next - here);
        let cotangent = u.dot(v) / u.perp_dot(v).abs().max(1e-9);
        (1.0 + reach * cotangent.max(0.5)).min(0.35 * length)
    };
    let (begin, end) = (margin(a, b, d), length - margin(b, a, c));
    let places = (((end - begin) as usize) + 1).clamp(LEAST_PLACES, MOST_PLACES);
    let mut points = [DVec2::ZERO; MOST_PLACES];
    let mut found = 0;
    for k in 0..places {
        let base = a + along * (begin + (end - begin) * (k as f64 + 0.5) / places as f64);
        let Some(offset) = crossing(image, base, outside, steps, contrast) else { continue };
        if let Some(p) = straight(base + outside * offset) {
            points[found] = p;
            found += 1;
        }
    }
    let line =
        |points: &[DVec2]| (points.len() >= LEAST_PLACES).then(|| Line::through(points.iter().copied()))?;
    let first = line(&points[..found])?;
    // What lies far off, by a reflection or a finger, is left out once.
    let most = (2.5 * first.spread).max(0.02);
    let mut kept = 0;
    for k in 0..found {
        if first.normal.dot(points[k] - first.point).abs() <= most {
            points[kept] = points[k];
            kept += 1;
        }
    }
    let second = line(&points[..kept])?;
    // The end of a line through n evenly spread points has four times the variance of a mean; the corner lies beyond it.
    let beyond = length / (end - begin).max(1.0);
    Some((second, 2.0 * beyond * second.spread.max(0.005) / (kept as f64).sqrt()))
}

/// How far outside `base` the level crosses from black to white.
fn crossing(image: &GreyImage<'_>, base: DVec2, outside: DVec2, steps: i32, contrast: f64) -> Option<f64> {
    const MOST: usize = 2 * (7.0 / STEP) as usize + 1;
    let mut values = [0.0; MOST];
    let count = 2 * steps as usize + 1;
    for (k, v) in values[..count].iter_mut().enumerate() {
        *v = image.at(base + outside * (f64::from(k as i32 - steps) * STEP))?;
    }
    let ends = ENDS.min(count / 3);
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (black, white) = (mean(&values[..ends]), mean(&values[count - ends..count]));
    if white - black < 0.4 * contrast {
        return None;
    }
    // The trapezoidal sum of what is missing to white.
    let missing: f64 = values[..count].iter().map(|v| white - v).sum::<f64>()
        - 0.5 * (2.0 * white - values[0] - values[count - 1]);
    Some(missing * STEP / (white - black) - f64::from(steps) * STEP)
}
