//! The place of a camera in the space of another one, from bodies that both see.
//!
//! Each pair of poses says `first = place * other`, as exactly as both covariances have it: a camera sees turns and depth badly, so
//! one pair alone is off by millimetres at a metre, and bodies at many places are needed. What both cameras see of a body that
//! rests has errors in common (its tags cover the same pixels), so all pairs of a place count as one. Pairs that contradict
//! the others count by Huber's loss.

use crate::dense::solve_spd;
use crate::least_squares::huber;
use dpm_common::so3::{so3_between, so3_exp};
use dpm_device::pose::{Pose, PoseCovariance};
use glam::{DAffine3, DMat3, DQuat, DVec3};
use thiserror::Error;

/// Fewest places at which both cameras must have seen a body.
pub const LEAST_PLACES: usize = 6;
/// A body that moved or turned by more is at another place, m and rad.
const ELSEWHERE: [f64; 2] = [0.02, 0.05];
/// Misfits of a pair above this many standard deviations, of all its six numbers together, count by their size. The mean is
/// the root of six.
const KNEE: f64 = 3.5;
/// Pairs from which a beginning is chosen.
const CANDIDATES: usize = 60;
const STEPS: usize = 30;
/// A root mean square misfit above this many standard deviations means that poses are worse than they say.
const WORST_MISFIT: f64 = 5.0;

/// A body at one instant, as two cameras saw it, each in its own space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SharedView {
    /// Which body it is.
    pub body: u16,
    /// By the first camera and by the other one.
    pub poses: [Pose; 2],
    /// Of both, m^2 and rad^2.
    pub covariances: [PoseCovariance; 2],
}

/// The place of a camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraPlace {
    /// From the other camera's space to the first one's.
    pub first_from_other: DAffine3,
    /// Expected error in the middle of what was seen, along the worst axis, one standard deviation, m.
    pub sigma_m: f64,
    /// The same of its rotation, about the worst axis, rad.
    pub sigma_rad: f64,
    /// Places at which a body was seen.
    pub places: usize,
    /// Root mean square misfit of the pairs in standard deviations of what they say, along one axis.
    pub misfit: f64,
}

/// Why pairs make no place.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum PlaceRefusal {
    /// Fewer than [`LEAST_PLACES`].
    #[error("both cameras saw a body at {0} places only, {LEAST_PLACES} are needed; carry it slowly through what both see, and turn it")]
    TooFew(usize),
    /// The poses contradict each other.
    #[error("what both cameras saw differs by {0:.0} times what they say: check lens (dpm calibrate camera), tags and sizes of both, and whether one of them moved")]
    Contradictory(f64),
}

type Vector6 = [f64; 6];
type Matrix6 = [Vector6; 6];

/// By what a pair contradicts a place.
struct Misfit {
    /// Position and rotation in the first camera's axes, m and rad.
    residual: Vector6,
    /// The inverse of the residual's covariance.
    information: Matrix6,
    /// The body in the first camera's space, by the other one.
    seen: DVec3,
}

fn rotation(pose: &Pose) -> DQuat {
    DQuat::from_array(pose.rotation_xyzw)
}

fn solve(matrix: &Matrix6, right: &Vector6) -> Option<Vector6> {
    let rows: Vec<Vec<f64>> = matrix.iter().map(|row| row.to_vec()).collect();
    solve_spd(&rows, right)?.try_into().ok()
}

fn inverse(matrix: &Matrix6) -> Option<Matrix6> {
    let mut columns = [[0.0; 6]; 6];
    for (i, column) in columns.iter_mut().enumerate() {
        *column = solve(matrix, &std::array::from_fn(|j| f64::from(u8::from(i == j))))?;
    }
    Some(columns)
}

/// The pose of the other camera as one pair alone has it.
fn by_pair(view: &SharedView) -> DAffine3 {
    let [first, other] = view
        .poses
        .map(|pose| DAffine3::from_rotation_translation(rotation(&pose), DVec3::from_array(pose.position_m)));
    first * other.inverse()
}

impl Misfit {
    /// `None` of a covariance that is none, or of numbers that are not finite.
    fn of(place: &DAffine3, view: &SharedView) -> Option<Self> {
        let [first, other] = &view.poses;
        let turn = DQuat::from_mat3(&place.matrix3).normalize();
        let seen = place.transform_point3(DVec3::from_array(other.position_m));
        let off = seen - DVec3::from_array(first.position_m);
        let turned = so3_between(rotation(first), turn * rotation(other));
        let [a, b] = view.covariances.map(|c| c.matrix());
        let turn = DMat3::from_quat(turn);
        let along = |i: usize, k: usize| if i / 3 == k / 3 { turn.col(k % 3)[i % 3] } else { 0.0 };
        let other = |i: usize, j: usize| -> f64 {
            (0..36).map(|n| along(i, n / 6) * b[n / 6][n % 6] * along(j, n % 6)).sum()
        };
        let covariance = std::array::from_fn(|i| std::array::from_fn(|j| a[i][j] + other(i, j)));
        let residual = [off.x, off.y, off.z, turned.x, turned.y, turned.z];
        let information = inverse(&covariance)?;
        residual.iter().all(|r| r.is_finite()).then_some(Self { residual, information, seen })
    }

    /// What it weighs along each axis.
    fn weighed(&self) -> Vector6 {
        std::array::from_fn(|i| (0..6).map(|j| self.information[i][j] * self.residual[j]).sum())
    }

    /// Its size in standard deviations: the root of the sum over six axes.
    fn size(&self) -> f64 {
        self.residual.iter().zip(self.weighed()).map(|(r, w)| r * w).sum::<f64>().max(0.0).sqrt()
    }

    /// Its derivatives by a shift of the place, and by a turn about `about`.
    fn derivatives(&self, about: DVec3) -> Matrix6 {
        let arm = self.seen - about;
        std::array::from_fn(|i| {
            // The turn t moves the body by t x arm, of which axis i is t . (arm x axis).
            let turning = if i < 3 { arm.cross(DVec3::AXES[i]) } else { DVec3::AXES[i - 3] }.to_array();
            std::array::from_fn(|k| if k < 3 { f64::from(u8::from(i == k)) } else { turning[k - 3] })
        })
    }
}

/// Half the weighted squares about a place, to second order.
struct NormalEquations {
    hessian: Matrix6,
    slope: Vector6,
    cost: f64,
    /// Sum of shares, and of squared sizes by their shares.
    weight: f64,
    squares: f64,
}

impl NormalEquations {
    fn at(place: &DAffine3, about: DVec3, views: &[SharedView], shares: &[f64]) -> Self {
        let zero = [[0.0; 6]; 6];
        let mut normal = Self { hessian: zero, slope: zero[0], cost: 0.0, weight: 0.0, squares: 0.0 };
        for (view, share) in views.iter().zip(shares) {
            let Some(misfit) = Misfit::of(place, view) else { continue };
            let size = misfit.size();
            let (weight, loss) = huber(size, KNEE);
            let (rows, weighed) = (misfit.derivatives(about), misfit.weighed());
            let weight = weight * share;
            for k in 0..6 {
                normal.slope[k] -= weight * (0..6).map(|i| rows[i][k] * weighed[i]).sum::<f64>();
                for l in 0..6 {
                    let sum = |n: usize| rows[n / 6][k] * misfit.information[n / 6][n % 6] * rows[n % 6][l];
                    normal.hessian[k][l] += weight * (0..36).map(sum).sum::<f64>();
                }
            }
            normal.cost += share * loss;
            normal.weight += share;
            normal.squares += share * size.min(4.0 * KNEE).powi(2);
        }
        normal
    }
}

/// The share of each pair in its place, and how many places there are. A body that comes back is at another place.
fn shares(views: &[SharedView]) -> (Vec<f64>, usize) {
    // Of each place its first pair, and how many there are; of each pair its place.
    let mut places: Vec<(SharedView, usize)> = Vec::new();
    let mut of_pair = Vec::with_capacity(views.len());
    for view in views {
        let last = places.iter().rposition(|(at, _)| at.body == view.body).filter(|at| {
            let [from, to] = [&places[*at].0.poses[0], &view.poses[0]];
            let step = DVec3::from_array(to.position_m) - DVec3::from_array(from.position_m);
            step.length() < ELSEWHERE[0] && so3_between(rotation(from), rotation(to)).length() < ELSEWHERE[1]
        });
        let at = last.unwrap_or_else(|| {
            places.push((*view, 0));
            places.len() - 1
        });
        places[at].1 += 1;
        of_pair.push(at);
    }
    (of_pair.iter().map(|at| 1.0 / places[*at].1 as f64).collect(), places.len())
}

/// How many places `views` have.
pub fn places_of(views: &[SharedView]) -> usize {
    shares(views).1
}

/// The place of the other camera.
///
/// # Errors
/// There are too few places, or the pairs contradict each other.
pub fn place_beside(views: &[SharedView]) -> Result<CameraPlace, PlaceRefusal> {
    let (shares, places) = shares(views);
    if places < LEAST_PLACES {
        return Err(PlaceRefusal::TooFew(places));
    }
    let middle: DVec3 = views.iter().map(|view| DVec3::from_array(view.poses[0].position_m)).sum();
    let about = middle / views.len() as f64;
    let cost = |place: &DAffine3| NormalEquations::at(place, about, views, &shares).cost;
    let candidates = views.iter().step_by(views.len().div_ceil(CANDIDATES)).map(by_pair);
    let (mut place, mut least) = candidates
        .map(|place| (place, cost(&place)))
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .ok_or(PlaceRefusal::TooFew(0))?;
    for _ in 0..STEPS {
        let normal = NormalEquations::at(&place, about, views, &shares);
        let Some([x, y, z, a, b, c]) = solve(&normal.hessian, &normal.slope) else { break };
        let turn = DAffine3::from_quat(so3_exp(DVec3::new(a, b, c)));
        let back = DAffine3::from_translation(about + DVec3::new(x, y, z));
        let next = back * turn * DAffine3::from_translation(-about) * place;
        let cost = cost(&next);
        let is_better = cost < least * (1.0 - 1e-9);
        if !is_better {
            break;
        }
        (place, least) = (next, cost);
    }
    let normal = NormalEquations::at(&place, about, views, &shares);
    let misfit = (normal.squares / (6.0 * normal.weight)).sqrt();
    let Some(covariance) = inverse(&normal.hessian).filter(|_| misfit < WORST_MISFIT) else {
        return Err(PlaceRefusal::Contradictory(misfit));
    };
    // Poses that err more than they say make a place that does.
    let worst = |at: usize| (0..3).map(|i| covariance[at + i][at + i]).fold(0.0, f64::max).sqrt();
    let by = misfit.max(1.0);
    Ok(CameraPlace {
        first_from_other: place,
        sigma_m: by * worst(0),
        sigma_rad: by * worst(3),
        places,
        misfit,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::rng::Draws;

    /// Standard deviations across, in depth, and of turns: m, m, rad.
    const SIGMAS: [f64; 3] = [2e-4, 2e-3, 5e-3];

    fn covariance() -> PoseCovariance {
        let [across, deep, turn] = SIGMAS;
        let sigma = [across, across, deep, turn, turn, turn];
        let square = |i: usize, j: usize| if i == j { sigma[i] * sigma[i] } else { 0.0 };
        PoseCovariance::of(&std::array::from_fn(|i| std::array::from_fn(|j| square(i, j))))
    }

    /// The pose of a body in a camera's space, with errors by the 6 draws from `at` on.
    fn seen(body: &DAffine3, draws: &Draws, at: u64) -> Pose {
        let n = |i: u64| draws.normal(at + i);
        let [across, deep, turn] = SIGMAS;
        let off = DVec3::new(across * n(0), across * n(1), deep * n(2));
        let turned = so3_exp(DVec3::new(n(3), n(4), n(5)) * turn) * DQuat::from_mat3(&body.matrix3);
        Pose { position_m: (body.translation + off).to_array(), rotation_xyzw: turned.normalize().to_array() }
    }

    fn drawn(seed: u64, count: u64, wild: f64) -> (DAffine3, Vec<SharedView>) {
        let draws = Draws::new(seed);
        let unit = |k: u64| draws.unit(k) - 0.5;
        let turn = so3_exp(DVec3::new(unit(1), 3.0 * unit(2), unit(3)));
        let truth = DAffine3::from_rotation_translation(turn, DVec3::new(2.0 * unit(4), unit(5), unit(6)));
        let views = (0..count).map(|k| {
            let at = 100 + 40 * k;
            let place = DVec3::new(0.5 * unit(at), 0.3 * unit(at + 1), -1.2 + 0.5 * unit(at + 2));
            let turn = so3_exp(DVec3::new(unit(at + 3), unit(at + 4), unit(at + 5)));
            let body = DAffine3::from_rotation_translation(turn, place);
            let mut poses =
                [(body, at + 6), (truth.inverse() * body, at + 20)].map(|(b, at)| seen(&b, &draws, at));
            if draws.unit(at + 39) < wild {
                poses[1].position_m[0] += 0.2;
            }
            SharedView { body: 0, poses, covariances: [covariance(); 2] }
        });
        let views = views.collect();
        (truth, views)
    }

    /// Shift in the middle of what is seen, and turn, by which a place is off.
    fn off(truth: &DAffine3, found: &DAffine3) -> [DVec3; 2] {
        let wrong = *found * truth.inverse();
        let middle = DVec3::new(0.0, 0.0, -1.2);
        let turn = so3_between(DQuat::IDENTITY, DQuat::from_mat3(&wrong.matrix3));
        [wrong.transform_point3(middle) - middle, turn]
    }

    const RUNS: u64 = 60;

    /// Errors are those that are stated, over drawn places; an eighth of wild pairs moves nothing.
    #[test]
    fn the_place_is_found_and_its_error_is_stated() {
        for wild in [0.0, 0.125] {
            let (mut squares, mut within) = ([0.0; 2], 0);
            for seed in 0..RUNS {
                let (truth, views) = drawn(seed, 24, wild);
                let found = place_beside(&views).unwrap();
                let sigmas = [found.sigma_m, found.sigma_rad];
                for (k, error) in off(&truth, &found.first_from_other).iter().enumerate() {
                    // Along the worst axis only one in twenty may be beyond; along the others fewer.
                    let beyond = error.abs().max_element() / sigmas[k];
                    squares[k] += beyond * beyond;
                    within += u64::from(beyond < 2.4);
                }
            }
            // The largest of three is at most that of three of the worst: its mean square is below 2.2.
            let squares = squares.map(|s| s / RUNS as f64);
            assert!(squares.iter().all(|s| *s > 0.3 && *s < 2.2), "{wild}: {squares:?}");
            assert!(within >= 2 * RUNS * 95 / 100, "{wild}: {within} of {}", 2 * RUNS);
        }
    }

    /// Errors in common are not averaged away: a hundred pairs of each place are worth one.
    #[test]
    fn a_body_that_rests_is_one_place() {
        let (_, views) = drawn(3, 8, 0.0);
        let alone = place_beside(&views).unwrap();
        let many: Vec<SharedView> = views.iter().flat_map(|view| [*view; 100]).collect();
        let same = place_beside(&many).unwrap();
        assert_eq!((alone.places, same.places), (8, 8));
        assert!((same.sigma_m / alone.sigma_m - 1.0).abs() < 1e-6);
        assert_eq!(place_beside(&many[..500]), Err(PlaceRefusal::TooFew(5)));
    }

    /// Poses that have nothing to do with each other make no place.
    #[test]
    fn what_contradicts_itself_is_refused() {
        let ((_, mut views), (_, others)) = (drawn(1, 24, 0.0), drawn(2, 24, 0.0));
        views.iter_mut().zip(&others).for_each(|(view, other)| view.poses[1] = other.poses[1]);
        assert!(
            matches!(place_beside(&views), Err(PlaceRefusal::Contradictory(misfit)) if misfit > WORST_MISFIT)
        );
    }
}
