//! What the levels of a frame say of lens, pose, tip, latency, drift and aperture: residuals and their derivatives.

use super::code::{Code, Role, PLANES};
use super::fit::Settings;
use super::stripes::stripes;
use crate::least_squares::{huber, Equations};
use crate::model::{ProjectorModel, PARAMETERS};
use crate::trajectory::Trajectory;
use dpm_device::planes::Raster;
use glam::{DVec2, DVec3};

// The unknowns after those of the projector.
pub(super) const TIP: usize = PARAMETERS;
pub(super) const LATENCY: usize = TIP + 3;
pub(super) const DRIFT: usize = LATENCY + 1;
pub(super) const RADIUS: usize = DRIFT + 1;
pub(super) const UNKNOWNS: usize = RADIUS + 1;

/// A moment in which the tip was in the light.
#[derive(Clone, Copy, Debug)]
pub(super) struct Moment {
    /// The instant by the host's clock, nanoseconds, and its part below one.
    pub instant: (i64, f64),
    /// Its distance from the middle of all, seconds.
    pub from_middle_s: f64,
}

/// A moment for which the bits named a pixel.
#[derive(Clone, Copy, Debug)]
pub(super) struct Fix {
    pub moment: Moment,
    /// The pixel of the bits, good to a few.
    pub pixel: DVec2,
}

/// What the planes of a frame show, and when.
pub(super) struct Planes<'a> {
    pub code: &'a Code,
    /// Time of a level within its plane, less that of the frame's middle, seconds, by plane.
    pub times: [f64; PLANES],
}

/// A frame prepared for the fit.
pub(super) struct FrameFix<'a> {
    pub planes: &'a Planes<'a>,
    /// The instant is that of the frame's middle plane.
    pub fix: Fix,
    /// Levels of the coded planes over the contrast, 0 to 1.
    pub levels: [f64; PLANES],
    pub contrast: f64,
}

/// A measurement that is fitted.
pub(super) trait Measured {
    /// The moment that stands for it.
    fn moment(&self) -> &Moment;

    /// Full light less darkness, in the sensor's unit.
    fn contrast(&self) -> f64;

    /// How well it agrees with a state; `None` if the state does not see the tip. Stripes narrower than `finest` pixels are
    /// left out. Its equations are added to `all`.
    fn tally(
        &self,
        problem: &SensorProblem,
        state: &SensorUnknowns,
        sigma: f64,
        finest: f64,
        all: Option<&mut Equations>,
    ) -> Option<Tally>;
}

/// What a measurement says of a state.
pub(super) struct Tally {
    /// Half the sum of Huber's losses.
    pub loss: f64,
    /// Squares of the residuals, and their number.
    pub squares: f64,
    pub count: f64,
    /// Squares of the slopes by place along each axis, and their products with the residuals.
    pub gg: [f64; 2],
    pub gr: [f64; 2],
    /// Minus the derivative of the cost.
    pub score: [f64; UNKNOWNS],
}

#[derive(Clone, Copy, Debug)]
pub(super) struct SensorUnknowns {
    pub model: ProjectorModel,
    pub tip: DVec3,
    pub latency_s: f64,
    /// Seconds a second.
    pub drift: f64,
    pub radius_m: f64,
}

impl SensorUnknowns {
    pub(super) fn step(&self, d: &[f64]) -> Self {
        Self {
            model: self.model.step(d),
            tip: self.tip + DVec3::new(d[TIP], d[TIP + 1], d[TIP + 2]),
            latency_s: self.latency_s + d[LATENCY],
            drift: self.drift + d[DRIFT],
            radius_m: self.radius_m * d[RADIUS].exp(),
        }
    }
}

/// Where the tip is seen in a frame, and how that changes.
pub(super) struct Sighting {
    pub pixel: DVec2,
    /// Pixels a second.
    pub velocity: DVec2,
    /// Of the aperture, pixels.
    pub radius: f64,
    /// Derivatives of x and y of the pixel by the unknowns.
    pub rows: [[f64; UNKNOWNS]; 2],
}

/// What a latency may be.
#[derive(Clone, Copy)]
pub(super) struct LatencyLimits {
    /// Beyond this an offset is no latency, seconds.
    pub latency_s: f64,
    /// Beyond this standard deviation the motion does not show it, microseconds.
    pub latency_sigma_us: f64,
}

pub(super) struct SensorProblem<'a> {
    pub raster: Raster,
    pub limits: LatencyLimits,
    pub path: &'a Trajectory,
    pub settings: &'a Settings,
    pub tip_sigma: f64,
    /// Which of the projector's numbers are solved for: none if lens and pose are known.
    pub free: [bool; PARAMETERS],
}

impl SensorProblem<'_> {
    pub(super) fn sight(&self, s: &SensorUnknowns, at: &Moment) -> Option<Sighting> {
        let shift = 1e9 * (s.latency_s + s.drift * at.from_middle_s) + at.instant.1;
        let pose = self.path.at(at.instant.0.saturating_add(shift.floor() as i64), shift - shift.floor())?;
        let lever = pose.rotation * s.tip;
        let seen = s.model.derive(pose.position + lever)?;
        let velocity = pose.velocity + pose.turning.cross(lever);
        let to_body = pose.rotation.conjugate();
        let mut rows = [[0.0; UNKNOWNS]; 2];
        let mut moving = DVec2::ZERO;
        for k in 0..2 {
            for (i, row) in rows[k][..PARAMETERS].iter_mut().enumerate().filter(|(i, _)| self.free[*i]) {
                *row = seen.by_parameters[k][i];
            }
            rows[k][TIP..LATENCY].copy_from_slice(&(to_body * seen.by_point[k]).to_array());
            moving[k] = seen.by_point[k].dot(velocity);
            rows[k][LATENCY] = moving[k];
            rows[k][DRIFT] = moving[k] * at.from_middle_s;
        }
        let scale = 0.5 * (seen.by_point[0].length() + seen.by_point[1].length());
        Some(Sighting { pixel: seen.pixel, velocity: moving, radius: s.radius_m * scale, rows })
    }

    pub(super) fn expect(&self, s: &SensorUnknowns, all: &mut Equations) {
        if self.free[0] {
            self.settings.priors.apply(&s.model, all);
        }
        // What is held has no equation: one that says nothing keeps the matrix regular.
        (0..PARAMETERS).filter(|i| !self.free[*i]).for_each(|i| all.expect(i, 0.0, 1.0));
        (0..3).for_each(|i| all.expect(TIP + i, s.tip[i] - self.settings.tip[i], self.tip_sigma));
        all.expect(LATENCY, s.latency_s, 0.1);
        all.expect(DRIFT, s.drift, 1e-4);
        all.expect(RADIUS, (2.0 * s.radius_m / self.settings.aperture_m).ln(), 0.7);
    }

    /// The equations of what is expected alone.
    pub(super) fn expected(&self, s: &SensorUnknowns) -> Equations {
        let mut all = Equations::new(UNKNOWNS);
        self.expect(s, &mut all);
        all
    }

    /// The part of a covariance that is the projector's; what is held has none.
    pub(super) fn of_model(&self, covariance: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let both = |i: usize, j: usize| if self.free[i] && self.free[j] { covariance[i][j] } else { 0.0 };
        (0..PARAMETERS).map(|i| (0..PARAMETERS).map(|j| both(i, j)).collect()).collect()
    }

    /// Equations from the pixels of the bits.
    pub(super) fn of_bits(&self, s: &SensorUnknowns, fixes: &[Fix], sigma_px: f64) -> Option<Equations> {
        let mut all = Equations::new(UNKNOWNS);
        for seen in fixes {
            let Some(at) = self.sight(s, &seen.moment) else { continue };
            let r = (at.pixel - seen.pixel) / sigma_px;
            let (weight, loss) = huber(r.length(), 2.0);
            all.cost += loss;
            (0..2).for_each(|k| all.add(&at.rows[k].map(|v| v / sigma_px), r[k], weight));
        }
        self.expect(s, &mut all);
        all.cost.is_finite().then_some(all)
    }

    /// Equations from levels.
    pub(super) fn of_levels<M: Measured>(
        &self,
        s: &SensorUnknowns,
        all: &[M],
        how: (f64, f64),
    ) -> Option<Equations> {
        let mut equations = Equations::new(UNKNOWNS);
        for one in all {
            if let Some(tally) = one.tally(self, s, how.0, how.1, Some(&mut equations)) {
                equations.cost += tally.loss;
            }
        }
        self.expect(s, &mut equations);
        equations.cost.is_finite().then_some(equations)
    }

    /// Their cost alone.
    pub(super) fn cost_of_levels<M: Measured>(&self, s: &SensorUnknowns, all: &[M], how: (f64, f64)) -> f64 {
        let losses = all.iter().filter_map(|m| Some(m.tally(self, s, how.0, how.1, None)?.loss));
        losses.sum::<f64>() + self.expected(s).cost
    }
}

impl<M: Measured> Measured for &M {
    fn moment(&self) -> &Moment {
        M::moment(self)
    }

    fn contrast(&self) -> f64 {
        M::contrast(self)
    }

    fn tally(
        &self,
        problem: &SensorProblem,
        state: &SensorUnknowns,
        sigma: f64,
        finest: f64,
        all: Option<&mut Equations>,
    ) -> Option<Tally> {
        M::tally(self, problem, state, sigma, finest, all)
    }
}

impl Measured for FrameFix<'_> {
    fn moment(&self) -> &Moment {
        &self.fix.moment
    }

    fn contrast(&self) -> f64 {
        self.contrast
    }

    fn tally(
        &self,
        problem: &SensorProblem,
        state: &SensorUnknowns,
        sigma: f64,
        finest: f64,
        all: Option<&mut Equations>,
    ) -> Option<Tally> {
        let at = problem.sight(state, &self.fix.moment)?;
        let sums = self.sums(&at, sigma, finest);
        if let Some(all) = all {
            sums.add_to(&at, all);
        }
        let Sums { loss, rr, count, gg, gr, .. } = sums;
        Some(Tally { loss, squares: rr, count, gg, gr, score: sums.score(&at) })
    }
}

impl FrameFix<'_> {
    /// Residuals of the levels: summed products of slopes and residuals.
    fn sums(&self, at: &Sighting, sigma: f64, finest: f64) -> Sums {
        let mut sums = Sums::default();
        for plane in 2..PLANES - 2 {
            let (axis, width) = match self.planes.code.role(plane) {
                Role::Column { width } => (0, f64::from(width)),
                Role::Row { width } => (1, f64::from(width)),
                _ => continue,
            };
            if width < finest {
                continue;
            }
            let place = at.pixel[axis] + at.velocity[axis] * self.planes.times[plane];
            let share = stripes(width, place, at.radius);
            let r = (share.share - self.levels[plane]) / sigma;
            let (weight, loss) = huber(r.abs(), 2.0);
            let (g, h) = (share.by_place / sigma, share.by_radius * at.radius / sigma);
            sums.loss += loss;
            sums.gg[axis] += weight * g * g;
            sums.gh[axis] += weight * g * h;
            sums.hh += weight * h * h;
            sums.gr[axis] += weight * g * r;
            sums.hr += weight * h * r;
            sums.rr += (r * sigma).powi(2);
            sums.count += 1.0;
        }
        sums
    }
}

/// Sums over the planes of a frame: `g` by place along each axis, `h` by the logarithm of the radius, `r` residuals.
#[derive(Default)]
struct Sums {
    loss: f64,
    gg: [f64; 2],
    gh: [f64; 2],
    hh: f64,
    gr: [f64; 2],
    hr: f64,
    rr: f64,
    count: f64,
}

impl Sums {
    /// All planes of one axis share their derivatives, so a frame costs two rows instead of twenty.
    fn add_to(&self, at: &Sighting, all: &mut Equations) {
        let mut left = self.hh;
        let mut of_radius = self.hr;
        for k in 0..2 {
            if self.gg[k] <= 0.0 {
                continue;
            }
            // (g J + h e)^2 over planes: complete the square, and leave the rest to the radius alone.
            let share = self.gh[k] / self.gg[k];
            let mut row = at.rows[k];
            row[RADIUS] += share;
            all.add(&row, self.gr[k] / self.gg[k], self.gg[k]);
            left -= self.gg[k] * share * share;
            of_radius -= self.gr[k] * share;
        }
        if left > 1e-12 * self.hh {
            let mut row = [0.0; UNKNOWNS];
            row[RADIUS] = 1.0;
            all.add(&row, of_radius / left, left);
        }
    }

    /// Minus the derivative of the cost.
    fn score(&self, at: &Sighting) -> [f64; UNKNOWNS] {
        let mut score: [f64; UNKNOWNS] =
            std::array::from_fn(|i| -(at.rows[0][i] * self.gr[0] + at.rows[1][i] * self.gr[1]));
        score[RADIUS] -= self.hr;
        score
    }
}
