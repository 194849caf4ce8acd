//! Least squares over lens and pose of the projector and the places of the bodies in view.

use super::start::place;
use super::{CodedRay, CodedView};
use crate::dense::{inverse_spd, solve_spd};
use crate::least_squares::{descend, huber, Descent, Equations};
use crate::model::{PixelDerivative, ProjectorModel, INTRINSICS, PARAMETERS};
use crate::projector::Priors;
use dpm_common::so3::so3_exp;
use glam::{DVec2, DVec3};

/// Numbers of a body's place: shift, metres, and turn, rad.
const POSE: usize = 6;
/// Residuals beyond this many sigmas count by their size only.
const KNEE: f64 = 2.5;
/// Rays beyond this many are left out of the last fit.
const OUTSIDE: f64 = 5.0;
/// Rays from which starts are told apart.
const COARSE: usize = 400;
/// Steps along a ray towards the projector's pixel.
const STEPS: usize = 6;

/// What is solved for.
#[derive(Clone, Debug)]
pub(super) struct ViewUnknowns {
    pub model: ProjectorModel,
    /// By how far each body lies from where it was seen: shift and turn.
    pub bodies: Vec<[f64; POSE]>,
}

/// Where least squares ended.
pub(super) struct SolvedView {
    pub state: ViewUnknowns,
    /// By the residuals, in the order of the unknowns.
    pub covariance: Vec<Vec<f64>>,
    pub rms_px: f64,
    pub converged: bool,
}

/// The end of a ray: the point, the pixel that lights it, and for a plane how the point moves with its body.
struct End {
    at: PixelDerivative,
    point: DVec3,
    by_body: Option<(usize, [DVec3; POSE])>,
}

impl ViewUnknowns {
    /// Where a ray ends: on its plane, or nearest to what its pixel lights.
    pub(super) fn end(&self, view: &CodedView, ray: &CodedRay) -> Option<DVec3> {
        self.ended(view, ray, false).map(|e| e.point)
    }

    fn ended(&self, view: &CodedView, ray: &CodedRay, with_slopes: bool) -> Option<End> {
        match ray.plane {
            Some(plane) => self.on_plane(view, ray, plane, with_slopes),
            None => self.nearest(view, ray),
        }
    }

    fn on_plane(&self, view: &CodedView, ray: &CodedRay, plane: usize, with_slopes: bool) -> Option<End> {
        let body = view.planes[plane].body;
        let own = &self.bodies[body];
        let (shift, turn) = (DVec3::from_slice(&own[..3]), DVec3::from_slice(&own[3..]));
        let turn = so3_exp(turn);
        let seen = place(view, plane);
        let middle = view.bodies[body].world_from_body.translation;
        let normal = turn * seen.matrix3.z_axis;
        let arm = turn * (seen.translation - middle);
        let o = middle + shift + arm - view.eye;
        let facing = normal.dot(ray.ray);
        let along = normal.dot(o) / facing;
        if along.is_nan() || along <= 0.0 {
            return None;
        }
        let point = view.eye + along * ray.ray;
        let at = self.model.derive(point)?;
        let by = |d_normal: DVec3, d_o: DVec3| {
            (d_normal.dot(o - along * ray.ray) + normal.dot(d_o)) / facing * ray.ray
        };
        let by_body = with_slopes.then(|| {
            let mut slopes = [DVec3::ZERO; POSE];
            for (k, axis) in DVec3::AXES.into_iter().enumerate() {
                slopes[k] = by(DVec3::ZERO, axis);
                slopes[3 + k] = by(axis.cross(normal), axis.cross(arm));
            }
            (body, slopes)
        });
        Some(End { at, point, by_body })
    }

    /// The point of a ray whose pixel is nearest to the ray's own, by Newton's steps along the logarithm of its distance.
    fn nearest(&self, view: &CodedView, ray: &CodedRay) -> Option<End> {
        let direction = ray.ray.normalize();
        // A first guess at about the distance of what is known.
        let usual = view.bodies.iter().map(|b| (b.world_from_body.translation - view.eye).length());
        let mut along = usual.sum::<f64>() / view.bodies.len().max(1) as f64;
        let mut end = None;
        for _ in 0..STEPS {
            let point = view.eye + along * direction;
            let at = self.model.derive(point)?;
            let slope = DVec2::new(at.by_point[0].dot(direction), at.by_point[1].dot(direction)) * along;
            let off = ray.pixel - at.pixel;
            let step = off.dot(slope) / slope.length_squared().max(1e-12);
            end = Some(End { at, point, by_body: None });
            if step.abs() < 1e-9 {
                break;
            }
            along *= step.clamp(-0.7, 0.7).exp();
        }
        end.filter(|_| (0.05..100.0).contains(&along))
    }

    /// The direction in the projector's picture across that of a ray, along which alone a ray of unknown length says
    /// something.
    fn across(&self, view: &CodedView, end: &End) -> Option<DVec2> {
        let direction = (end.point - view.eye).normalize();
        let slope = DVec2::new(end.at.by_point[0].dot(direction), end.at.by_point[1].dot(direction));
        slope.try_normalize().map(DVec2::perp)
    }

    /// The residuals of a ray in sigmas: two on a plane, the second one 0 elsewhere.
    fn residual(&self, view: &CodedView, ray: &CodedRay, end: &End) -> Option<DVec2> {
        let off = (end.at.pixel - ray.pixel) / ray.sigma_px;
        match ray.plane {
            Some(_) => Some(off),
            None => Some(DVec2::new(self.across(view, end)?.dot(off), 0.0)),
        }
    }

    fn unknowns(&self) -> usize {
        PARAMETERS + POSE * self.bodies.len()
    }

    fn step(&self, d: &[f64]) -> Self {
        let moved = |(b, own): (usize, &[f64; POSE])| {
            let d = &d[PARAMETERS + POSE * b..][..POSE];
            let turn = so3_exp(DVec3::from_slice(&d[3..])) * so3_exp(DVec3::from_slice(&own[3..]));
            let turn = dpm_common::so3::so3_log(turn);
            [own[0] + d[0], own[1] + d[1], own[2] + d[2], turn.x, turn.y, turn.z]
        };
        Self { model: self.model.step(d), bodies: self.bodies.iter().enumerate().map(moved).collect() }
    }
}

/// What does not change while it is solved.
struct ViewProblem<'a> {
    view: &'a CodedView,
    priors: &'a Priors,
    /// The inverse of each body's covariance.
    weights: &'a [Vec<Vec<f64>>],
    /// The size of a residual that no ray may miss; its loss for rays that the state cannot light.
    lost: f64,
}

impl ViewProblem<'_> {
    fn equations(&self, state: &ViewUnknowns, with_slopes: bool) -> Option<Equations> {
        let n = state.unknowns();
        let free = self.priors.free();
        let mut all = Equations::new(n);
        let mut row = vec![0.0; n];
        for ray in &self.view.rays {
            let seen = state.ended(self.view, ray, with_slopes);
            let Some((end, off)) = seen.and_then(|e| state.residual(self.view, ray, &e).map(|r| (e, r)))
            else {
                all.cost += self.lost;
                continue;
            };
            let (weight, loss) = huber(off.length(), KNEE);
            all.cost += loss;
            if !with_slopes {
                continue;
            }
            let across = if ray.plane.is_some() { None } else { state.across(self.view, &end) };
            let directions = match across {
                Some(n) => [Some(n), None],
                None => [Some(DVec2::X), Some(DVec2::Y)],
            };
            for (k, n) in directions.into_iter().flatten().enumerate() {
                row.fill(0.0);
                for i in (0..PARAMETERS).filter(|i| *i >= INTRINSICS || free[*i]) {
                    let by = DVec2::new(end.at.by_parameters[0][i], end.at.by_parameters[1][i]);
                    row[i] = n.dot(by) / ray.sigma_px;
                }
                if let Some((body, slopes)) = &end.by_body {
                    for (i, slope) in slopes.iter().enumerate() {
                        let by = DVec2::new(end.at.by_point[0].dot(*slope), end.at.by_point[1].dot(*slope));
                        row[PARAMETERS + POSE * body + i] = n.dot(by) / ray.sigma_px;
                    }
                }
                all.add(&row, off[k], weight);
            }
        }
        self.expect(state, &mut all);
        all.cost.is_finite().then_some(all)
    }

    /// What is expected of lens and bodies.
    fn expect(&self, state: &ViewUnknowns, all: &mut Equations) {
        self.priors.apply(&state.model, all);
        let held = self.priors.free().into_iter().enumerate().filter(|(_, free)| !*free);
        held.for_each(|(i, _)| all.expect(i, 0.0, 1.0));
        for (b, (own, weight)) in state.bodies.iter().zip(self.weights).enumerate() {
            // The root of the weight, row by row: as residuals, so that the equations stay symmetric.
            for root in weight {
                let off: f64 = root.iter().zip(own).map(|(w, v)| w * v).sum();
                let mut row = vec![0.0; state.unknowns()];
                row[PARAMETERS + POSE * b..][..POSE].copy_from_slice(root);
                all.add(&row, off, 1.0);
                all.cost += 0.5 * off * off;
            }
        }
    }
}

/// Rows whose squares add up to the inverse of a covariance: the transposed Cholesky factor of the inverse.
fn root_of_inverse(covariance: &[[f64; POSE]; POSE]) -> Option<Vec<Vec<f64>>> {
    let rows: Vec<Vec<f64>> = covariance.iter().map(|r| r.to_vec()).collect();
    let lower = crate::dense::cholesky(&inverse_spd(&rows)?)?;
    Some((0..POSE).map(|i| (0..POSE).map(|j| lower[j][i]).collect()).collect())
}

/// What is solved from, ready for any start.
pub(super) struct Solver<'a> {
    view: &'a CodedView,
    /// A part of the rays, from which starts are told apart.
    some: CodedView,
    priors: &'a Priors,
    weights: Vec<Vec<Vec<f64>>>,
    lost: f64,
}

impl<'a> Solver<'a> {
    /// `None` if a covariance is none.
    pub(super) fn new(view: &'a CodedView, priors: &'a Priors) -> Option<Self> {
        let weights: Option<Vec<_>> = view.bodies.iter().map(|b| root_of_inverse(&b.covariance)).collect();
        let step = (view.rays.len() / COARSE).max(1);
        let rays: Vec<CodedRay> = view.rays.iter().step_by(step).copied().collect();
        let some = CodedView { rays, ..view.clone() };
        Some(Self { view, some, priors, weights: weights?, lost: huber(40.0, KNEE).1 })
    }

    fn problem<'b>(&'b self, view: &'b CodedView) -> ViewProblem<'b> {
        ViewProblem { view, priors: self.priors, weights: &self.weights, lost: self.lost }
    }

    /// Where a start leads by a part of the rays, and the cost there; `None` if it leads nowhere.
    pub(super) fn near(&self, start: ViewUnknowns) -> Option<(f64, ViewUnknowns)> {
        let found = descended(&self.problem(&self.some), start, 60)?;
        let cost = found.equations.cost;
        (cost < 0.3 * self.lost * self.some.rays.len() as f64).then_some((cost, found.state))
    }

    /// Fits, leaves out what is far off, and fits again.
    pub(super) fn fit(&self, near: ViewUnknowns) -> Option<SolvedView> {
        let view = self.view;
        let first = descended(&self.problem(view), near, 40)?;
        let off = |state: &ViewUnknowns, ray: &CodedRay| {
            let end = state.ended(view, ray, false)?;
            state.residual(view, ray, &end).map(DVec2::length)
        };
        let all: Vec<f64> = view.rays.iter().filter_map(|r| off(&first.state, r)).collect();
        let usual = crate::projector::percentile(all, 0.5).max(0.2);
        let kept = |r: &&CodedRay| off(&first.state, r).is_some_and(|o| o < OUTSIDE * usual / 0.67);
        let inside = CodedView { rays: view.rays.iter().filter(kept).copied().collect(), ..view.clone() };
        let problem = self.problem(&inside);
        let found = descended(&problem, first.state, 40)?;
        finish(found.state, found.converged, &problem)
    }
}

fn descended(problem: &ViewProblem<'_>, start: ViewUnknowns, steps: usize) -> Option<Descent<ViewUnknowns>> {
    let cost = |s: &ViewUnknowns| problem.equations(s, false).map_or(f64::INFINITY, |e| e.cost);
    descend(start, steps, |s| problem.equations(s, true), cost, |s, d| s.step(d))
}

fn finish(state: ViewUnknowns, converged: bool, problem: &ViewProblem<'_>) -> Option<SolvedView> {
    let view = problem.view;
    let equations = problem.equations(&state, true)?;
    let matrix = equations.matrix();
    // Regular at all?
    solve_spd(&matrix, &equations.slope)?;
    let (mut squares, mut px, mut count) = (0.0, 0.0, 0.0);
    for ray in &view.rays {
        let Some(end) = state.ended(view, ray, false) else { continue };
        let Some(r) = state.residual(view, ray, &end) else { continue };
        squares += r.length_squared();
        px += (r * ray.sigma_px).length_squared();
        count += if ray.plane.is_some() { 2.0 } else { 1.0 };
    }
    let free = problem.priors.free();
    let is_free = |i: usize| i >= INTRINSICS || free[i];
    let inflate = (squares / f64::max(count - state.unknowns() as f64, 1.0)).max(1e-6);
    let covariance = covariance(problem, &state, &matrix, inflate)?;
    let held = |i: usize, j: usize, v: f64| if is_free(i) && is_free(j) { v } else { 0.0 };
    let covariance = covariance
        .iter()
        .enumerate()
        .map(|(i, row)| row.iter().enumerate().map(|(j, v)| held(i, j, *v)).collect())
        .collect();
    Some(SolvedView { state, covariance, rms_px: (px / f64::max(count, 1.0)).sqrt(), converged })
}

/// The inverse of the equations with the rays' part divided by how much larger residuals are than expected. What is
/// expected of lens and bodies does not depend on them.
fn covariance(
    problem: &ViewProblem<'_>,
    state: &ViewUnknowns,
    matrix: &[Vec<f64>],
    inflate: f64,
) -> Option<Vec<Vec<f64>>> {
    let mut expected = Equations::new(state.unknowns());
    problem.expect(state, &mut expected);
    let expected = expected.matrix();
    let scaled = |i: usize, j: usize| (matrix[i][j] - expected[i][j]) / inflate + expected[i][j];
    let n = state.unknowns();
    inverse_spd(&(0..n).map(|i| (0..n).map(|j| scaled(i, j)).collect()).collect::<Vec<Vec<f64>>>())
}
