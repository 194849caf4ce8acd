//! Whether something changed during a sweep: a projector that was bumped, a tracker that was moved, a wand that slipped.
//!
//! A lens has enough numbers to bend itself around a step of some millimetres, so that residuals hardly tell of it. But the
//! frames before the step go on pulling at the numbers in one direction, and those after it in the other one. The sum of the
//! scores up to an instant says how far: with the inverse of the second derivatives it is the step of the numbers that the
//! two parts would take away from each other (a test for a structural break by cumulative sums of scores; \[Nyblom89\]).

use super::fit::BLOCK_S;
use super::problem::UNKNOWNS;
use crate::model::{ProjectorModel, PARAMETERS};
use crate::projector::{percentile, variance};
use glam::DVec3;

/// Parts shorter than this share of a sweep are not compared: they have seen too few places.
const LEAST_SHARE: f64 = 0.15;

/// Where nothing changes, the largest change is below this in nearly every sweep: of 80 simulated sweeps, each fitted twice, the
/// largest of all was 2.2.
const USUAL: f64 = 2.0;
/// No sweep in which nothing changed reaches this.
const CERTAIN: f64 = 3.0;
/// A change that moves the light by less is predicted and not refused, pixels: a tracker whose reports wander by a tenth of a
/// millimetre changes by half a pixel, which nobody can fasten. It is also the usual limit of `dpm calibrate check`.
const LEAST_REFUSED_PX: f64 = 2.0;

/// The largest difference between the projectors of two parts of a sweep.
#[derive(Clone, Copy, Debug)]
pub(super) struct Change {
    /// How many times as large it is as chance makes it.
    pub ratio: f64,
    /// How far apart they light the points: the 99th percentile, pixels.
    pub px: f64,
    /// When the second part begins, seconds after the first frame.
    pub after_s: f64,
    /// By how much the numbers of one part are off those of the whole, if the change was in the middle.
    step: [f64; PARAMETERS],
}

impl Change {
    /// Whether something changed beyond doubt, and by so much that the sweep is worth nothing.
    pub(super) fn is_refused(&self) -> bool {
        self.ratio > CERTAIN && self.px > LEAST_REFUSED_PX
    }

    /// Adds what a change that is larger than usual makes the numbers uncertain by.
    pub(super) fn add_to(&self, covariance: &mut [Vec<f64>]) {
        let weight = (1.0 - (USUAL / self.ratio).powi(2)).max(0.0);
        for (row, a) in covariance.iter_mut().zip(&self.step) {
            row.iter_mut().zip(&self.step).for_each(|(v, b)| *v += weight * a * b);
        }
    }
}

/// Compares the parts before and after each block. `inverse` is that of the second derivatives, `covariance` that of the
/// model's numbers, and the light is needed at `points`.
pub(super) fn largest_change(
    model: &ProjectorModel,
    (inverse, covariance): (&[Vec<f64>], &[Vec<f64>]),
    by_block: &[(i64, [f64; UNKNOWNS])],
    points: &[DVec3],
) -> Option<Change> {
    let slopes: Vec<[[f64; PARAMETERS]; 2]> =
        points.iter().filter_map(|p| model.derive(*p).map(|at| at.by_parameters)).collect();
    let by_chance: f64 = slopes.iter().flatten().map(|row| variance(covariance, row)).sum();
    let first = by_block.first()?.0;
    let mut sum = [0.0; UNKNOWNS];
    let parts = by_block.iter().enumerate().filter_map(|(i, (block, score))| {
        sum.iter_mut().zip(score).for_each(|(s, v)| *s += v);
        let share = (i + 1) as f64 / by_block.len() as f64;
        if !(LEAST_SHARE..=1.0 - LEAST_SHARE).contains(&share) {
            return None;
        }
        let part = |k: usize| inverse[k].iter().zip(&sum).map(|(a, b)| a * b).sum::<f64>();
        // A number that is held has no variance, and is not moved.
        let step: [f64; PARAMETERS] =
            std::array::from_fn(|k| if covariance[k][k] > 0.0 { 2.0 * part(k) } else { 0.0 });
        let along = |row: &[f64; PARAMETERS]| -> f64 { row.iter().zip(&step).map(|(a, b)| a * b).sum() };
        let moves: Vec<f64> = slopes.iter().map(|[x, y]| along(x).hypot(along(y))).collect();
        let squares: f64 = moves.iter().map(|m| m * m).sum();
        // The sum of the scores is as far from 0 as that of a walk that returns, and the two parts differ by as much over
        // the share of each.
        let of_both = 4.0 * share * (1.0 - share);
        let ratio = (squares / of_both / by_chance).sqrt();
        let after_s = (block + 1 - first) as f64 * BLOCK_S;
        Some(Change { ratio, px: 2.0 * percentile(moves, 0.99) / of_both, after_s, step })
    });
    parts.max_by(|a, b| a.ratio.total_cmp(&b.ratio))
}
