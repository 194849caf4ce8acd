//! Refines a roughly known pinhole to the least reprojection error of point pairs: Levenberg-Marquardt
//! (\[Marquardt63\]).

use super::Pair;
use crate::dense::{inverse_diagonal, solve_spd};
use dpm_common::so3::{hat, so3_exp};
use glam::{DMat3, DVec2, DVec3};

/// A pinhole in the usual equations: `x = centre + focal * (R X + t).xy / (R X + t).z`, looking along +Z, y down.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pinhole {
    pub rotation: DMat3,
    pub translation: DVec3,
    pub focal: DVec2,
    pub centre: DVec2,
}

impl Pinhole {
    fn local(&self, world: DVec3) -> DVec3 {
        self.rotation * world + self.translation
    }

    /// Distance along the axis in front of the pinhole.
    pub(super) fn depth(&self, world: DVec3) -> f64 {
        self.local(world).z
    }

    /// Computed minus given pixel; infinite behind the pinhole.
    pub(super) fn residual(&self, p: &Pair) -> DVec2 {
        let q = self.local(p.world);
        if q.z <= 0.0 {
            return DVec2::INFINITY;
        }
        self.centre + self.focal * q.truncate() / q.z - p.pixel
    }

    fn cost(&self, pairs: &[Pair], expected: Option<&LensPrior>) -> f64 {
        let seen: f64 = pairs.iter().map(|p| self.residual(p).length_squared()).sum();
        seen + expected.map_or(0.0, |e| e.rows(self).iter().map(|(r, _)| r * r).sum())
    }

    /// The pinhole after a step of (focal 2, centre 2, rotation 3, translation 3).
    fn step(&self, d: &[f64]) -> Self {
        // Focal lengths are stepped in their logarithm: they cannot become negative, and an error of a factor 100 is a
        // distance of 4.6.
        let turn = so3_exp(DVec3::new(d[4], d[5], d[6]));
        let rotation = DMat3::from_quat(turn) * self.rotation;
        // Over many steps rounding would make the matrix drift from a rotation.
        let x = rotation.x_axis.normalize();
        let y = (rotation.y_axis - x * x.dot(rotation.y_axis)).normalize();
        Self {
            rotation: DMat3::from_cols(x, y, x.cross(y)),
            translation: self.translation + DVec3::new(d[7], d[8], d[9]),
            focal: self.focal * DVec2::new(d[0].exp(), d[1].exp()),
            centre: self.centre + DVec2::new(d[2], d[3]),
        }
    }

    /// Derivatives of the residual's x and y by the ten parameters.
    fn jacobian(&self, p: &Pair) -> [[f64; 10]; 2] {
        let turned = self.rotation * p.world;
        let q = turned + self.translation;
        let by_turn = -hat(turned);
        std::array::from_fn(|k| {
            let (f, z) = (self.focal[k], q.z);
            let mut by_point = DVec3::ZERO;
            by_point[k] = f / z;
            by_point.z = -f * q[k] / (z * z);
            let w = by_turn.transpose() * by_point;
            let mut row = [0.0; 10];
            row[k] = f * q[k] / z;
            row[2 + k] = 1.0;
            row[4..7].copy_from_slice(&w.to_array());
            row[7..].copy_from_slice(&by_point.to_array());
            row
        })
    }
}

/// What is expected of a projector before any pair is seen, in the units of the pairs: soft, so that only what the pairs
/// leave open follows it.
#[derive(Clone, Copy, Debug)]
pub(super) struct LensPrior {
    /// The middle of the picture.
    pub centre: DVec2,
    /// Width and height of the picture.
    pub size: DVec2,
    /// Deviation of a pair along one axis: what makes an expectation comparable with it.
    pub sigma: f64,
}

/// Deviation of the logarithm of a pixel's height over its width: pixels are square.
const ASPECT_SIGMA: f64 = 0.05;
/// Deviation of the axis from the middle of the picture, over its width and its height: a lens shift moves it up or down.
const CENTRE_SIGMA: DVec2 = DVec2::new(0.5, 1.0);
/// Throw ratio of a usual projector, and the deviation of its logarithm: from ultra short throw to a long lens.
const THROW: f64 = 1.5;
const THROW_SIGMA: f64 = 1.0;

impl LensPrior {
    /// What a pinhole misses of the expectations, and the derivatives by its ten parameters, in the pairs' units.
    fn rows(&self, m: &Pinhole) -> [(f64, [f64; 10]); 4] {
        let throw = 0.5 * (m.focal.x.ln() + m.focal.y.ln()) - (THROW * self.size.x).ln();
        let aspect = m.focal.y.ln() - m.focal.x.ln();
        let off = m.centre - self.centre;
        let centre_sigma = CENTRE_SIGMA * self.size;
        let expect = |value: f64, sigma: f64, by: &[(usize, f64)]| {
            let weight = self.sigma / sigma;
            let mut row = [0.0; 10];
            by.iter().for_each(|(i, slope)| row[*i] = weight * slope);
            (weight * value, row)
        };
        [
            expect(aspect, ASPECT_SIGMA, &[(0, -1.0), (1, 1.0)]),
            expect(throw, THROW_SIGMA, &[(0, 0.5), (1, 0.5)]),
            expect(off.x, centre_sigma.x, &[(2, 1.0)]),
            expect(off.y, centre_sigma.y, &[(3, 1.0)]),
        ]
    }
}

/// The result of the refinement.
pub(super) struct LensFit {
    pub model: Pinhole,
    pub rms: f64,
    pub converged: bool,
    pub iterations: usize,
    /// Relative standard deviation of the focal length.
    pub focal_uncertainty: f64,
}

const STEPS: usize = 400;

/// Refines a pinhole, by the pairs alone or with what is expected of it.
pub(super) fn refine(start: Pinhole, pairs: &[Pair], expected: Option<&LensPrior>) -> LensFit {
    let n = pairs.len() as f64;
    let mut model = start;
    let mut cost = model.cost(pairs, expected);
    let mut damping = 1e-3;
    let mut converged = false;
    let mut iterations = 0;
    let mut normal = vec![vec![0.0; 10]; 10];
    while iterations < STEPS && cost.is_finite() {
        iterations += 1;
        let mut gradient = [0.0; 10];
        normal.iter_mut().for_each(|row| row.fill(0.0));
        let mut add = |r: f64, j: &[f64; 10]| {
            for a in 0..10 {
                gradient[a] -= j[a] * r;
                (0..10).for_each(|b| normal[a][b] += j[a] * j[b]);
            }
        };
        for p in pairs {
            let (r, j) = (model.residual(p), model.jacobian(p));
            (0..2).for_each(|k| add(r[k], &j[k]));
        }
        expected.iter().flat_map(|e| e.rows(&model)).for_each(|(r, j)| add(r, &j));
        // Residuals are at the rounding error of the coordinates: no further gain is possible.
        if cost <= n * 1e-30 {
            converged = true;
            break;
        }
        let mut accepted = false;
        while damping < 1e12 {
            let mut damped = normal.clone();
            (0..10).for_each(|i| damped[i][i] += damping * normal[i][i].max(1e-12));
            let trial = solve_spd(&damped, &gradient).map(|d| (model.step(&d), d));
            let better = trial.map(|(m, d)| (m, m.cost(pairs, expected), d)).filter(|(_, c, _)| *c < cost);
            let Some((next, next_cost, d)) = better else {
                damping *= 4.0;
                continue;
            };
            let gain = (cost - next_cost) / cost;
            let length = d.iter().map(|x| x * x).sum::<f64>().sqrt();
            (model, cost) = (next, next_cost);
            damping = (damping * 0.2).max(1e-15);
            accepted = true;
            // A step that is small although hardly damped means convergence; one that is small because of damping does
            // not.
            converged = gain < 1e-12 && length < 1e-7 && damping < 1e-2;
            break;
        }
        if !accepted {
            // No direction lowers the cost: a minimum, if the slope has vanished too.
            let steep =
                (0..10).map(|i| gradient[i].abs() / normal[i][i].sqrt().max(1e-300)).fold(0.0, f64::max);
            converged = steep <= 1e-5 * (cost / n).sqrt().max(1e-12) * n.sqrt();
            break;
        }
        if converged {
            break;
        }
    }
    let squares = model.cost(pairs, None);
    let freedom = (2.0 * n - 10.0).max(1.0);
    let focal_uncertainty = if squares <= n * 1e-24 {
        0.0
    } else {
        inverse_diagonal(&normal).map_or(f64::INFINITY, |d| (d[0].max(d[1]) * squares / freedom).sqrt())
    };
    LensFit { model, rms: (squares / n).sqrt(), converged, iterations, focal_uncertainty }
}
