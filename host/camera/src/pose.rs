//! Points of a body and their pixels in one or several cameras into the body's pose and its covariance.
//!
//! Levenberg-Marquardt on the pixels, by the solver of [`dpm_calibration`], from one or several starts. Where two poses
//! explain the pixels, as they do for a flat thing that is small or far ([`crate::planar`]), the better one is taken and the
//! covariance reaches to the other by the odds that it is the true one.

use dpm_calibration::dense::inverse_spd;
use dpm_calibration::least_squares::{descend, huber, Equations};
use dpm_common::so3::{so3_between, so3_exp};
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DQuat, DVec2, DVec3};

/// Residuals up to this many standard deviations count by their square, larger ones by their size.
const KNEE: f64 = 3.5;
/// Steps of the solver.
const MOST_STEPS: usize = 30;

/// A point of a body and the pixel at which a camera sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// In the body, metres.
    pub body: DVec3,
    /// Where it is seen, pixels.
    pub pixel: DVec2,
    /// Standard deviation of the pixel along each axis.
    pub sigma_px: f64,
    /// Index of the camera.
    pub camera: usize,
    /// By how much later than the pose's instant it was seen, seconds: rows of a rolling shutter differ.
    pub late_s: f64,
}

/// Velocity of a body, for points that were not seen at one instant.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Velocity {
    /// Of the body's origin, m/s.
    pub linear: DVec3,
    /// Right-handed about the axes of the cameras' space, rad/s.
    pub angular: DVec3,
}

/// Covariance of a pose: of the body's position, m, and of a rotation vector on the left, rad, in the axes of the cameras'
/// space.
pub type Covariance = [[f64; 6]; 6];

/// A pose that explains observations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseFit {
    /// From the body to the cameras' space.
    pub rotation: DQuat,
    /// Of the body's origin, metres.
    pub position: DVec3,
    /// By the noise of the observations.
    pub covariance: Covariance,
    /// Half the sum of the squared residuals, in standard deviations, with outliers bounded.
    pub cost: f64,
    /// Observations with a residual of more than [`KNEE`] standard deviations.
    pub outliers: usize,
}

impl PoseFit {
    /// As a motion.
    pub fn to_affine(&self) -> DAffine3 {
        DAffine3::from_rotation_translation(self.rotation, self.position)
    }

    /// Where `other` lies from here: position, and rotation vector.
    pub fn to(&self, other: &Self) -> [f64; 6] {
        let (d, w) = (other.position - self.position, so3_between(self.rotation, other.rotation));
        [d.x, d.y, d.z, w.x, w.y, w.z]
    }

    /// Adds `share` of the square of a deviation to the covariance.
    pub(crate) fn widen(&mut self, by: &[f64; 6], share: f64) {
        for (row, a) in self.covariance.iter_mut().zip(by) {
            row.iter_mut().zip(by).for_each(|(c, b)| *c += share * a * b);
        }
    }

    /// Multiplies the covariance.
    fn scale(&mut self, by: f64) {
        self.covariance.iter_mut().flatten().for_each(|c| *c *= by);
    }
}

/// Where the solver is: a rotation, and the place of the observations' middle.
#[derive(Clone, Copy)]
struct State {
    rotation: DQuat,
    middle: DVec3,
}

/// The problem: what was seen by whom.
pub(crate) struct Problem<'a> {
    pub cameras: &'a [ProjectorCamera],
    pub observations: &'a [Observation],
    pub velocity: Velocity,
    /// The middle of the observed points, in the body.
    middle: DVec3,
}

impl<'a> Problem<'a> {
    pub(crate) fn new(
        cameras: &'a [ProjectorCamera],
        observations: &'a [Observation],
        velocity: Velocity,
    ) -> Self {
        let sum: DVec3 = observations.iter().map(|o| o.body).sum();
        Self { cameras, observations, velocity, middle: sum / observations.len().max(1) as f64 }
    }

    /// A point's place by its turned arm, and the arm.
    fn place(&self, state: &State, o: &Observation) -> (DVec3, DVec3) {
        let arm = state.rotation * (o.body - self.middle);
        let from_origin = state.rotation * o.body;
        let moved = (self.velocity.linear + self.velocity.angular.cross(from_origin)) * o.late_s;
        (state.middle + arm + moved, arm)
    }

    /// The residual of an observation in standard deviations; `None` if the camera cannot see the point.
    fn residual(&self, state: &State, o: &Observation) -> Option<DVec2> {
        let camera = self.cameras.get(o.camera)?;
        Some((camera.project(self.place(state, o).0)? - o.pixel) / o.sigma_px)
    }

    /// Root mean square distance of the observations from where a pose shows them, pixels; infinite if it shows one nowhere.
    pub(crate) fn deviation_px(&self, fit: &PoseFit) -> f64 {
        let state = State { rotation: fit.rotation, middle: fit.position + fit.rotation * self.middle };
        let square = |o: &Observation| {
            self.residual(&state, o).map_or(f64::INFINITY, |r| (r * o.sigma_px).length_squared())
        };
        (self.observations.iter().map(square).sum::<f64>() / self.observations.len().max(1) as f64).sqrt()
    }

    fn cost(&self, state: &State) -> f64 {
        let loss = |o| self.residual(state, o).map_or(f64::INFINITY, |r| huber(r.length(), KNEE).1);
        self.observations.iter().map(loss).sum()
    }

    fn equations(&self, state: &State, robust: bool) -> Option<Equations> {
        let mut equations = Equations::new(6);
        for o in self.observations {
            let residual = self.residual(state, o)?;
            let (place, arm) = self.place(state, o);
            let (weight, loss) = huber(residual.length(), KNEE);
            equations.cost += loss;
            let weight = if robust { weight } else { 1.0 };
            for (by_point, residual) in
                self.cameras[o.camera].jacobian(place)?.into_iter().zip(residual.to_array())
            {
                let by_point = by_point / o.sigma_px;
                let by_turn = arm.cross(by_point);
                let row = [by_turn.x, by_turn.y, by_turn.z, by_point.x, by_point.y, by_point.z];
                equations.add(&row, residual, weight);
            }
        }
        Some(equations)
    }

    /// The nearest pose that explains the observations best; `None` if the start is impossible or they determine no pose.
    pub(crate) fn refine(&self, start: &DAffine3) -> Option<PoseFit> {
        let rotation = DQuat::from_mat3(&start.matrix3).normalize();
        let start = State { rotation, middle: start.transform_point3(self.middle) };
        let step = |s: &State, d: &[f64]| State {
            rotation: (so3_exp(DVec3::from_slice(&d[..3])) * s.rotation).normalize(),
            middle: s.middle + DVec3::from_slice(&d[3..]),
        };
        let found = descend(start, MOST_STEPS, |s| self.equations(s, true), |s| self.cost(s), step)?;
        let (state, cost) = (found.state, found.equations.cost);
        if !cost.is_finite() {
            return None;
        }
        let inverse = inverse_spd(&self.equations(&state, true)?.matrix())?;
        let lever = state.rotation * self.middle;
        let outliers =
            self.observations.iter().filter(|o| self.residual(&state, o).is_none_or(|r| r.length() > KNEE));
        let mut fit = PoseFit {
            rotation: state.rotation,
            position: state.middle - lever,
            covariance: about_origin(&inverse, lever),
            cost,
            outliers: outliers.count(),
        };
        // Residuals that no such noise explains say that the noise is greater.
        let freedom = (2 * self.observations.len()).saturating_sub(6) as f64;
        let excess = 2.0 * cost / freedom.max(1.0);
        if freedom > 0.0 && excess > 1.0 + 4.0 * (2.0 / freedom).sqrt() {
            fit.scale(excess);
        }
        Some(fit)
    }
}

/// From turn and shift of the observations' middle to shift of the body's origin and turn: the origin lies `-lever` from the
/// middle, and moves by `shift - turn x lever`.
fn about_origin(inverse: &[Vec<f64>], lever: DVec3) -> Covariance {
    let mut map = [[0.0; 6]; 6];
    let cross = dpm_common::so3::hat(lever);
    for i in 0..3 {
        map[i][3 + i] = 1.0;
        map[3 + i][i] = 1.0;
        // hat(lever) * turn = lever x turn = -(turn x lever).
        map[i][..3].copy_from_slice(&cross.row(i).to_array());
    }
    let mut out = [[0.0; 6]; 6];
    for i in 0..6 {
        for j in 0..6 {
            for k in 0..6 {
                for l in 0..6 {
                    out[i][j] += map[i][k] * inverse[k][l] * map[j][l];
                }
            }
        }
    }
    out
}
