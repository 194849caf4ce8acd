//! Least squares over lens, pose and an offset in time.

use super::{middle, Sight};
use crate::dense::{inverse_spd, svd};
use crate::least_squares::{descend, huber, Equations};
use crate::model::{ProjectorModel, INTRINSICS, LENS, PARAMETERS};
use dpm_device::planes::Raster;
use glam::DVec2;

/// The offset in time, seconds, follows the numbers of the projector.
pub(crate) const OFFSET: usize = PARAMETERS;
/// How many numbers are solved for.
pub(crate) const UNKNOWNS: usize = PARAMETERS + 1;

/// What is expected of the inside of a projector before any measurement: a value, and the standard deviation around it.
/// An infinite deviation leaves the number to the data; 0 holds it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Priors {
    /// ln(fy / fx): pixels are square.
    pub aspect: [f64; 2],
    /// Where the axis leaves, across, pixels.
    pub cx: [f64; 2],
    /// The same, down.
    pub cy: [f64; 2],
    /// k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4.
    pub lens: [[f64; 2]; LENS],
}

const FREE: f64 = f64::INFINITY;
/// Numbers of Brown's lens, and of the rational one.
const BROWN: usize = 5;
const RATIONAL: usize = 8;

/// Which numbers of a lens are left to the data.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LensTerms {
    /// k1, k2, p1, p2, k3.
    #[default]
    Brown,
    /// k4, k5, k6, too: for wide angles.
    Rational,
    /// s1 to s4, too: for lenses that are tilted.
    ThinPrism,
}

/// Brown's five by their deviations, the others held at 0.
fn brown(sigmas: [f64; BROWN]) -> [[f64; 2]; LENS] {
    std::array::from_fn(|i| [0.0, sigmas.get(i).copied().unwrap_or(0.0)])
}

impl Priors {
    /// For a dozen points: focal lengths, centre, k1 and k2 are free, the rest is expected to be small.
    pub fn few_points(raster: Raster) -> Self {
        Self { aspect: [0.0, 0.02], ..Self::many_points(raster).with_usual_lens() }
    }

    /// For thousands of points: everything is free, within what lenses can be at all.
    pub fn many_points(raster: Raster) -> Self {
        let (w, h) = (f64::from(raster.width()), f64::from(raster.height()));
        Self {
            aspect: [0.0, FREE],
            // A lens shift moves the axis by half a picture and more, mostly up or down.
            cx: [0.5 * w, w],
            cy: [0.5 * h, 2.0 * h],
            lens: brown([1.0, 2.0, 0.02, 0.02, 5.0]),
        }
    }

    /// With a lens as most projectors have: k1 and k2 moderate, the rest small. What is known better stays.
    pub(crate) fn with_usual_lens(mut self) -> Self {
        let usual = brown([0.5, 0.5, 1e-3, 1e-3, 0.02]);
        let expected = self.lens.iter_mut().zip(usual);
        expected.filter(|(own, usual)| own[1] > usual[1]).for_each(|(own, usual)| *own = usual);
        self
    }

    /// With more of the lens's numbers left to the data than Brown's five.
    pub fn with_lens(mut self, terms: LensTerms) -> Self {
        self.lens[BROWN..].fill([0.0; 2]);
        if terms != LensTerms::Brown {
            self.lens[BROWN..RATIONAL].fill([0.0, 1.0]);
        }
        if terms == LensTerms::ThinPrism {
            self.lens[RATIONAL..].fill([0.0, 0.02]);
        }
        self
    }

    /// Whether more than Brown's five are left to the data.
    pub(crate) fn is_beyond_brown(&self) -> bool {
        self.lens[BROWN..].iter().any(|k| k[1] > 0.0)
    }

    /// A lens of which everything is known: only the pose is left.
    pub fn held(model: &ProjectorModel) -> Self {
        Self {
            aspect: [(model.focal.y / model.focal.x).ln(), 0.0],
            cx: [model.centre.x, 0.0],
            cy: [model.centre.y, 0.0],
            lens: model.lens.map(|k| [k, 0.0]),
        }
    }

    /// Adds what is expected to the equations.
    pub(crate) fn apply(&self, model: &ProjectorModel, equations: &mut Equations) {
        let mut expect = |parameter: usize, value: f64, [mean, sigma]: [f64; 2]| {
            if sigma.is_finite() && sigma > 0.0 {
                equations.expect(parameter, value - mean, sigma);
            }
        };
        expect(1, (model.focal.y / model.focal.x).ln(), self.aspect);
        expect(2, model.centre.x, self.cx);
        expect(3, model.centre.y, self.cy);
        (0..LENS).for_each(|i| expect(4 + i, model.lens[i], self.lens[i]));
    }

    /// Which of the numbers of the inside are not held.
    pub(crate) fn free(&self) -> [bool; INTRINSICS] {
        let mut free = [true; INTRINSICS];
        let held = |p: [f64; 2]| p[1] == 0.0;
        (free[1], free[2], free[3]) = (!held(self.aspect), !held(self.cx), !held(self.cy));
        (0..LENS).for_each(|i| free[4 + i] = !held(self.lens[i]));
        free
    }
}

/// A fitted projector.
#[derive(Clone, Debug)]
pub(crate) struct Fit {
    pub model: ProjectorModel,
    /// What must be added to the time of the points, seconds.
    pub offset_s: f64,
    /// Root mean square residual along one axis, pixels.
    pub rms_px: f64,
    /// Covariance of the unknowns for residuals of `sigma_px`; 0 for those that are held.
    pub covariance: Vec<Vec<f64>>,
    pub converged: bool,
}

/// Which unknowns may change, and what is expected of them.
pub(crate) struct Task<'a> {
    pub priors: &'a Priors,
    /// Whether the focal length may change; the rest of the inside is governed by the priors.
    pub focal: bool,
    pub offset: bool,
    /// Expected deviation along one axis, pixels.
    pub sigma_px: f64,
}

impl Task<'_> {
    fn free(&self) -> [bool; UNKNOWNS] {
        let mut free = [true; UNKNOWNS];
        free[..INTRINSICS].copy_from_slice(&self.priors.free());
        (free[0], free[OFFSET]) = (self.focal, self.offset);
        free
    }
}

/// Residuals beyond this many sigmas count by their size only.
const KNEE: f64 = 2.0;

/// Fits a projector to the points, from a start. `None` if the start or the result puts points behind the projector.
pub(crate) fn fit(start: &ProjectorModel, sights: &[Sight], task: &Task) -> Option<Fit> {
    let start = (start.about(middle(sights)), 0.0);
    let free = task.free();
    let equations = |s: &(ProjectorModel, f64)| equations(s, sights, task, &free, true);
    let cost = |s: &(ProjectorModel, f64)| equations_cost(s, sights, task, &free);
    let step = |s: &(ProjectorModel, f64), d: &[f64]| (s.0.step(d), s.1 + d[OFFSET]);
    let descent = descend(start, 200, equations, cost, step)?;
    let mut covariance = inverse_spd(&descent.equations.matrix())?;
    for (i, row) in covariance.iter_mut().enumerate() {
        row.iter_mut().enumerate().filter(|(j, _)| !(free[i] && free[*j])).for_each(|(_, v)| *v = 0.0);
    }
    let (model, offset_s) = descent.state;
    let squares: f64 = super::misses(&model, offset_s, sights).iter().map(|m| m * m).sum();
    let rms_px = (squares / (2.0 * sights.len() as f64)).sqrt();
    Some(Fit { model, offset_s, rms_px, covariance, converged: descent.converged })
}

fn equations_cost(s: &(ProjectorModel, f64), sights: &[Sight], task: &Task, free: &[bool; UNKNOWNS]) -> f64 {
    equations(s, sights, task, free, false).map_or(f64::INFINITY, |e| e.cost)
}

fn equations(
    (model, offset_s): &(ProjectorModel, f64),
    sights: &[Sight],
    task: &Task,
    free: &[bool; UNKNOWNS],
    slopes: bool,
) -> Option<Equations> {
    let mut all = Equations::new(UNKNOWNS);
    for s in sights {
        let point = s.world + s.velocity * *offset_s;
        if !slopes {
            let r = (model.project(point)? - s.pixel) / task.sigma_px;
            all.cost += huber(r.length(), KNEE * std::f64::consts::SQRT_2).1;
            continue;
        }
        let at = model.derive(point)?;
        let r: DVec2 = (at.pixel - s.pixel) / task.sigma_px;
        let (weight, loss) = huber(r.length(), KNEE * std::f64::consts::SQRT_2);
        all.cost += loss;
        for k in 0..2 {
            let mut row = [0.0; UNKNOWNS];
            row[..PARAMETERS].copy_from_slice(&at.by_parameters[k]);
            row[OFFSET] = at.by_point[k].dot(s.velocity);
            row.iter_mut().zip(free).for_each(|(v, free)| *v *= f64::from(u8::from(*free)) / task.sigma_px);
            all.add(&row, r[k], weight);
        }
    }
    task.priors.apply(model, &mut all);
    // What is held has no equation: one that says nothing keeps the matrix regular.
    free.iter().enumerate().filter(|(_, free)| !**free).for_each(|(i, _)| all.expect(i, 0.0, 1.0));
    // A clock may be off by some milliseconds, not by seconds.
    if free[OFFSET] {
        all.expect(OFFSET, *offset_s, 0.05);
    }
    all.cost.is_finite().then_some(all)
}

/// Root mean square extents of the points along their three main directions, metres, descending.
pub(crate) fn spread_of(sights: &[Sight]) -> [f64; 3] {
    let (centre, n) = (middle(sights), sights.len().max(1) as f64);
    let columns = (0..3).map(|a| sights.iter().map(|s| s.world[a] - centre[a]).collect()).collect();
    let values = svd(columns).values;
    std::array::from_fn(|i| values[i] / n.sqrt())
}
