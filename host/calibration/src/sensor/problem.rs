//! What the levels of a frame say of lens, pose, tip, latency, drift and aperture: residuals and their derivatives.

use super::code::{Code, Role, PLANES};
use super::fit::Settings;
use super::stripes::stripes;
use crate::least_squares::{huber, Equations};
use crate::model::{ProjectorModel, PARAMETERS};
use crate::trajectory::Trajectory;
use glam::{DVec2, DVec3};

// The unknowns after the fifteen of the projector.
pub(super) const TIP: usize = PARAMETERS;
pub(super) const LATENCY: usize = TIP + 3;
pub(super) const DRIFT: usize = LATENCY + 1;
pub(super) const RADIUS: usize = DRIFT + 1;
pub(super) const UNKNOWNS: usize = RADIUS + 1;

/// A frame prepared for the fit.
pub(super) struct Seen {
    /// Instant of the frame's middle plane by the host's clock, and its distance from the middle of all, seconds.
    pub instant: (i64, f64),
    pub from_middle_s: f64,
    /// Levels of the coded planes over the contrast, 0 to 1.
    pub levels: [f64; PLANES],
    pub contrast: f64,
    /// The pixel of the bits.
    pub pixel: DVec2,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct State {
    pub model: ProjectorModel,
    pub tip: DVec3,
    pub latency_s: f64,
    /// Seconds a second.
    pub drift: f64,
    pub radius_m: f64,
}

impl State {
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

pub(super) struct Problem<'a> {
    pub code: &'a Code,
    pub path: &'a Trajectory,
    pub settings: &'a Settings,
    /// Time of a level within its plane, less that of the frame's middle, seconds, by plane.
    pub times: [f64; PLANES],
    pub tip_sigma: f64,
    /// Lens and pose stay what they are.
    pub is_held: bool,
}

impl Problem<'_> {
    pub(super) fn sight(&self, s: &State, seen: &Seen) -> Option<Sighting> {
        let shift = 1e9 * (s.latency_s + s.drift * seen.from_middle_s) + seen.instant.1;
        let pose =
            self.path.at(seen.instant.0.saturating_add(shift.floor() as i64), shift - shift.floor())?;
        let lever = pose.rotation * s.tip;
        let at = s.model.derive(pose.position + lever)?;
        let velocity = pose.velocity + pose.turning.cross(lever);
        let to_body = pose.rotation.conjugate();
        let mut rows = [[0.0; UNKNOWNS]; 2];
        let mut moving = DVec2::ZERO;
        for k in 0..2 {
            if !self.is_held {
                rows[k][..PARAMETERS].copy_from_slice(&at.by_parameters[k]);
            }
            rows[k][TIP..LATENCY].copy_from_slice(&(to_body * at.by_point[k]).to_array());
            moving[k] = at.by_point[k].dot(velocity);
            rows[k][LATENCY] = moving[k];
            rows[k][DRIFT] = moving[k] * seen.from_middle_s;
        }
        let scale = 0.5 * (at.by_point[0].length() + at.by_point[1].length());
        Some(Sighting { pixel: at.pixel, velocity: moving, radius: s.radius_m * scale, rows })
    }

    pub(super) fn expect(&self, s: &State, all: &mut Equations) {
        match self.is_held {
            // What is held has no equation: one that says nothing keeps the matrix regular.
            true => (0..PARAMETERS).for_each(|i| all.expect(i, 0.0, 1.0)),
            false => self.settings.priors.apply(&s.model, all),
        }
        (0..3).for_each(|i| all.expect(TIP + i, s.tip[i] - self.settings.tip[i], self.tip_sigma));
        all.expect(LATENCY, s.latency_s, 0.1);
        all.expect(DRIFT, s.drift, 1e-4);
        all.expect(RADIUS, (2.0 * s.radius_m / self.settings.aperture_m).ln(), 0.7);
    }

    /// Equations from the pixels of the bits.
    pub(super) fn of_bits(&self, s: &State, frames: &[Seen], sigma_px: f64) -> Option<Equations> {
        let mut all = Equations::new(UNKNOWNS);
        for seen in frames {
            let Some(at) = self.sight(s, seen) else { continue };
            let r = (at.pixel - seen.pixel) / sigma_px;
            let (weight, loss) = huber(r.length(), 2.0);
            all.cost += loss;
            (0..2).for_each(|k| all.add(&at.rows[k].map(|v| v / sigma_px), r[k], weight));
        }
        self.expect(s, &mut all);
        all.cost.is_finite().then_some(all)
    }

    /// Residuals of a frame's levels: summed products of slopes and residuals.
    pub(super) fn frame(&self, at: &Sighting, seen: &Seen, sigma: f64, finest: f64) -> Sums {
        let mut sums = Sums::default();
        for plane in 2..PLANES - 2 {
            let (axis, width) = match self.code.role(plane) {
                Role::Column { width } => (0, f64::from(width)),
                Role::Row { width } => (1, f64::from(width)),
                _ => continue,
            };
            if width < finest {
                continue;
            }
            let place = at.pixel[axis] + at.velocity[axis] * self.times[plane];
            let share = stripes(width, place, at.radius);
            let r = (share.share - seen.levels[plane]) / sigma;
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

    pub(super) fn of_levels(&self, s: &State, frames: &[Seen], sigma: f64, finest: f64) -> Option<Equations> {
        let mut all = Equations::new(UNKNOWNS);
        for seen in frames {
            let Some(at) = self.sight(s, seen) else { continue };
            let sums = self.frame(&at, seen, sigma, finest);
            all.cost += sums.loss;
            sums.add_to(&at, &mut all);
        }
        self.expect(s, &mut all);
        all.cost.is_finite().then_some(all)
    }

    pub(super) fn cost_of_levels(&self, s: &State, frames: &[Seen], sigma: f64, finest: f64) -> f64 {
        let losses =
            frames.iter().filter_map(|f| Some(self.frame(&self.sight(s, f)?, f, sigma, finest).loss));
        let mut priors = Equations::new(UNKNOWNS);
        self.expect(s, &mut priors);
        losses.sum::<f64>() + priors.cost
    }
}

/// Sums over the planes of a frame: `g` by place along each axis, `h` by the logarithm of the radius, `r` residuals.
#[derive(Default)]
pub(super) struct Sums {
    pub loss: f64,
    pub gg: [f64; 2],
    pub gh: [f64; 2],
    pub hh: f64,
    pub gr: [f64; 2],
    pub hr: f64,
    pub rr: f64,
    pub count: f64,
}

impl Sums {
    /// All planes of one axis share their derivatives, so a frame costs two rows instead of twenty.
    pub(super) fn add_to(&self, at: &Sighting, all: &mut Equations) {
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
    pub(super) fn score(&self, at: &Sighting) -> [f64; UNKNOWNS] {
        let mut score: [f64; UNKNOWNS] =
            std::array::from_fn(|i| -(at.rows[0][i] * self.gr[0] + at.rows[1][i] * self.gr[1]));
        score[RADIUS] -= self.hr;
        score
    }
}

impl Seen {
    pub(super) fn copy(&self) -> Self {
        Self { ..*self }
    }
}
