//! Least squares over the inside of the camera, the pose of the board in each view, and the board's own shape.

use super::{BoardPoint, BoardView};
use crate::dense::inverse_spd;
use crate::least_squares::{descend, huber, Equations};
use crate::model::{ProjectorModel, INTRINSICS, PARAMETERS};
use crate::projector::Priors;
use glam::DVec3;

/// Numbers of the board: three of its bend and one of its stretch follow those of the inside.
const SHAPE: usize = 4;
/// Numbers of a pose.
const POSE: usize = PARAMETERS - INTRINSICS;
/// What boards are expected to bend, metres, and prints to be stretched.
const BEND_M: f64 = 2e-3;
const STRETCH: f64 = 0.02;
/// Residuals beyond this many sigmas count by their size only.
const KNEE: f64 = 3.0;
/// Residuals of few points say little of the noise: what is expected counts as this many more of them.
const EXPECTED: f64 = 10.0;

/// What is solved for: the camera about the board in each view, all with one inside, and the shape of the board.
#[derive(Clone, Debug)]
pub(super) struct BoardUnknowns {
    pub models: Vec<ProjectorModel>,
    /// How far the board rises by x^2, x y and y^2 where x and y are 1, metres, and by how much it is wider than high.
    pub board: [f64; SHAPE],
    /// Where x and y are 1, metres.
    pub half: f64,
}

/// Where least squares ended.
pub(super) struct BoardFit {
    pub state: BoardUnknowns,
    /// By the residuals, in the order of the unknowns.
    pub covariance: Vec<Vec<f64>>,
    pub converged: bool,
}

impl BoardUnknowns {
    /// A point of the board in its own space, and its derivatives by the board's numbers.
    fn place(&self, p: &BoardPoint) -> (DVec3, [DVec3; SHAPE]) {
        let (u, v) = (p.place.x / self.half, p.place.y / self.half);
        let powers = [u * u, u * v, v * v];
        let rise: f64 = powers.iter().zip(&self.board).map(|(p, b)| p * b).sum();
        let stretch = self.board[3];
        let place = DVec3::new(p.place.x * (1.0 + 0.5 * stretch), p.place.y * (1.0 - 0.5 * stretch), rise);
        let [a, b, c] = powers.map(|p| DVec3::Z * p);
        (place, [a, b, c, DVec3::new(0.5 * p.place.x, -0.5 * p.place.y, 0.0)])
    }

    /// Half the sum of the losses; infinite if a point lies behind the camera.
    pub(super) fn cost(&self, views: &[BoardView]) -> f64 {
        let loss = |model: &ProjectorModel, p: &BoardPoint| {
            let off = model.project(self.place(p).0).map(|q| (q - p.pixel).length() / p.sigma_px);
            off.map_or(f64::INFINITY, |r| huber(r, KNEE).1)
        };
        self.models.iter().zip(views).flat_map(|(m, view)| view.iter().map(|p| loss(m, p))).sum()
    }

    fn unknowns(&self) -> usize {
        INTRINSICS + SHAPE + POSE * self.models.len()
    }

    fn step(&self, d: &[f64]) -> Self {
        let moved = |(v, model): (usize, &ProjectorModel)| {
            let mut own = [0.0; PARAMETERS];
            own[..INTRINSICS].copy_from_slice(&d[..INTRINSICS]);
            own[INTRINSICS..].copy_from_slice(&d[INTRINSICS + SHAPE + POSE * v..][..POSE]);
            model.step(&own)
        };
        Self {
            models: self.models.iter().enumerate().map(moved).collect(),
            board: std::array::from_fn(|i| self.board[i] + d[INTRINSICS + i]),
            half: self.half,
        }
    }

    /// The equations, and the sum of the squared residuals in sigmas.
    fn equations(&self, views: &[BoardView], priors: &Priors) -> Option<Equations> {
        let n = self.unknowns();
        let free = priors.free();
        let mut all = Equations::new(n);
        let mut row = vec![0.0; n];
        for (v, (model, view)) in self.models.iter().zip(views).enumerate() {
            for p in view {
                let (place, by_shape) = self.place(p);
                let at = model.derive(place)?;
                let off = (at.pixel - p.pixel) / p.sigma_px;
                let (weight, loss) = huber(off.length(), KNEE);
                all.cost += loss;
                for k in 0..2 {
                    row.fill(0.0);
                    let own = &at.by_parameters[k];
                    (0..INTRINSICS).filter(|i| free[*i]).for_each(|i| row[i] = own[i] / p.sigma_px);
                    for (i, by) in by_shape.iter().enumerate() {
                        row[INTRINSICS + i] = at.by_point[k].dot(*by) / p.sigma_px;
                    }
                    for (i, by) in own[INTRINSICS..].iter().enumerate() {
                        row[INTRINSICS + SHAPE + POSE * v + i] = by / p.sigma_px;
                    }
                    all.add(&row, off[k], weight);
                }
            }
        }
        Some(all)
    }

    /// The equations with what is expected.
    fn whole(&self, views: &[BoardView], priors: &Priors) -> Option<Equations> {
        let mut all = self.equations(views, priors)?;
        priors.apply(&self.models[0], &mut all);
        let held = priors.free().into_iter().enumerate().filter(|(_, free)| !*free);
        held.for_each(|(i, _)| all.expect(i, 0.0, 1.0));
        for (i, sigma) in [BEND_M, BEND_M, BEND_M, STRETCH].into_iter().enumerate() {
            all.expect(INTRINSICS + i, self.board[i], sigma);
        }
        all.cost.is_finite().then_some(all)
    }

    /// The largest angle between the board's normals in two views, rad.
    pub(super) fn tilt(&self) -> f64 {
        let normals: Vec<DVec3> = self.models.iter().map(|m| m.rotation.z_axis).collect();
        let pairs = normals.iter().enumerate().flat_map(|(i, a)| normals[i + 1..].iter().map(|b| (*a, *b)));
        pairs.map(|(a, b)| a.angle_between(b)).fold(0.0, f64::max)
    }
}

/// Fits, from a start. `None` if the start puts points behind the camera.
pub(super) fn fit(start: BoardUnknowns, views: &[BoardView], priors: &Priors) -> Option<BoardFit> {
    let cost = |s: &BoardUnknowns| s.whole_cost(views, priors);
    let found = descend(start, 100, |s| s.whole(views, priors), cost, |s, d| s.step(d))?;
    let mut covariance = inverse_spd(&found.equations.matrix())?;
    let n = covariance.len();
    let free = priors.free();
    let is_free = |i: usize| i >= INTRINSICS || free[i];
    let points = views.iter().map(Vec::len).sum::<usize>() as f64;
    let freedom = (2.0 * points - n as f64).max(0.0);
    let inflate = (2.0 * found.state.cost(views) + EXPECTED) / (freedom + EXPECTED);
    for (i, row) in covariance.iter_mut().enumerate() {
        for (j, value) in row.iter_mut().enumerate() {
            *value = if is_free(i) && is_free(j) { *value * inflate } else { 0.0 };
        }
    }
    Some(BoardFit { state: found.state, covariance, converged: found.converged })
}

impl BoardUnknowns {
    fn whole_cost(&self, views: &[BoardView], priors: &Priors) -> f64 {
        // What is expected counts little beside thousands of points, but a step must not be judged without it.
        let mut own = Equations::new(self.unknowns());
        priors.apply(&self.models[0], &mut own);
        for (i, sigma) in [BEND_M, BEND_M, BEND_M, STRETCH].into_iter().enumerate() {
            own.expect(INTRINSICS + i, self.board[i], sigma);
        }
        own.cost + self.cost(views)
    }
}

impl BoardFit {
    /// Root mean square residual of each view along one axis, pixels.
    pub(super) fn deviations(&self, views: &[BoardView]) -> Vec<f64> {
        let square = |model: &ProjectorModel, p: &BoardPoint| {
            let off = model.project(self.state.place(p).0).map(|q| (q - p.pixel).length_squared());
            off.unwrap_or(f64::INFINITY)
        };
        let own = |(m, view): (&ProjectorModel, &BoardView)| {
            (view.iter().map(|p| square(m, p)).sum::<f64>() / (2.0 * view.len() as f64)).sqrt()
        };
        self.state.models.iter().zip(views).map(own).collect()
    }

    /// The same of all views.
    pub(super) fn rms_px(&self, views: &[BoardView]) -> f64 {
        let all = self.deviations(views);
        let squares = all.iter().zip(views).map(|(d, v)| d * d * v.len() as f64).sum::<f64>();
        (squares / views.iter().map(Vec::len).sum::<usize>() as f64).sqrt()
    }

    /// How far the board bulges over the reach of its points, and the deviation of that, metres.
    pub(super) fn bend(&self) -> (f64, f64) {
        let [a, b, c, _] = self.state.board;
        // The larger of the two curvatures of the form a x^2 + b x y + c y^2.
        let bend = 0.5 * ((a + c).abs() + ((a - c).powi(2) + b * b).sqrt());
        let sigma = (0..3).map(|i| self.covariance[INTRINSICS + i][INTRINSICS + i]).fold(0.0, f64::max);
        (bend, sigma.sqrt())
    }

    /// By how much the print is wider than high, and the deviation of that, as shares.
    pub(super) fn stretch(&self) -> (f64, f64) {
        (self.state.board[3], self.covariance[INTRINSICS + 3][INTRINSICS + 3].sqrt())
    }
}
