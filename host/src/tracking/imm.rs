//! Noisy points on a manifold into position, velocity and acceleration: a bank of Kalman filters with mode mixing.
//!
//! A body that is still or coasts is best followed by a constant-velocity filter with a long memory; a body that turns
//! needs one that models acceleration and forgets fast. No single process noise serves both, so several filters run side by
//! side and are weighed by how well each foretold the last samples (interacting multiple models, Blom and Bar-Shalom 1988).
//!
//! Noise is taken as isotropic, so one 3x3 covariance (position, velocity, acceleration) serves all three axes. The same
//! code follows translations and, by way of [`Chart`], rotations.

use crate::geometry::se3::{so3_between, so3_exp};
use glam::{DQuat, DVec3};

/// A manifold of dimension three with tangents in the world frame.
pub trait Chart {
    /// A point on it.
    type Point: Copy + std::fmt::Debug + PartialEq;
    /// The tangent that leads from `from` to `to`.
    fn between(from: Self::Point, to: Self::Point) -> DVec3;
    /// The point reached from `from` along a tangent.
    fn moved(from: Self::Point, by: DVec3) -> Self::Point;
}

/// Translations, metres.
#[derive(Clone, Copy, Debug)]
pub struct Translations;

impl Chart for Translations {
    type Point = DVec3;
    fn between(from: DVec3, to: DVec3) -> DVec3 {
        to - from
    }
    fn moved(from: DVec3, by: DVec3) -> DVec3 {
        from + by
    }
}

/// Rotations as unit quaternions; tangents are world-space rotation vectors, rad.
#[derive(Clone, Copy, Debug)]
pub struct Rotations;

impl Chart for Rotations {
    type Point = DQuat;
    fn between(from: DQuat, to: DQuat) -> DVec3 {
        so3_between(from, to)
    }
    fn moved(from: DQuat, by: DVec3) -> DQuat {
        (so3_exp(by) * from).normalize()
    }
}

/// Symmetric covariance of position p, velocity v and acceleration a, the same on every axis. SI units.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[allow(missing_docs)] // the names are the entries
pub struct Covariance {
    pub pp: f64,
    pub pv: f64,
    pub pa: f64,
    pub vv: f64,
    pub va: f64,
    pub aa: f64,
}

impl Covariance {
    /// Variance of the position after `h` seconds of constant acceleration.
    pub fn position_variance_at(&self, h: f64) -> f64 {
        let half = 0.5 * h * h;
        self.pp
            + h * (2.0 * self.pv + h * self.vv)
            + half * (2.0 * self.pa + 2.0 * h * self.va + half * self.aa)
    }

    /// F P F^T for `h` seconds of constant acceleration.
    fn propagated(&self, h: f64) -> Self {
        let half = 0.5 * h * h;
        let pv = self.pv + h * self.vv + half * self.va;
        let pa = self.pa + h * self.va + half * self.aa;
        let va = self.va + h * self.aa;
        Self {
            pp: self.position_variance_at(h),
            pv: pv + h * pa,
            pa,
            vv: self.vv + h * (self.va + va),
            va,
            aa: self.aa,
        }
    }

    /// Joseph form for one position measurement of variance `r`; returns the gains too. 1 - K is computed as R / S, because
    /// the subtraction would lose every digit when P exceeds R by sixteen orders of magnitude.
    fn updated(&self, r: f64) -> (Self, [f64; 3]) {
        let s = self.pp + r;
        if s <= 0.0 {
            return (*self, [0.0; 3]);
        }
        let [k0, k1, k2] = [self.pp / s, self.pv / s, self.pa / s];
        let rest = r / s;
        let new = Self {
            pp: rest * rest * self.pp + r * k0 * k0,
            pv: rest * (self.pv - k1 * self.pp) + r * k0 * k1,
            pa: rest * (self.pa - k2 * self.pp) + r * k0 * k2,
            vv: self.vv - 2.0 * k1 * self.pv + k1 * k1 * self.pp + r * k1 * k1,
            va: self.va - k2 * self.pv - k1 * self.pa + k1 * k2 * self.pp + r * k1 * k2,
            aa: self.aa - 2.0 * k2 * self.pa + k2 * k2 * self.pp + r * k2 * k2,
        };
        (new, [k0, k1, k2])
    }

    fn add_scaled(&mut self, o: &Self, w: f64) {
        self.pp += w * o.pp;
        self.pv += w * o.pv;
        self.pa += w * o.pa;
        self.vv += w * o.vv;
        self.va += w * o.va;
        self.aa += w * o.aa;
    }

    /// Spread of the means in a mixture. One direction usually carries all of it (a turn-round), so the squared length is
    /// taken instead of the mean over axes: the motion's own axis is not understated.
    fn add_spread(&mut self, dp: DVec3, dv: DVec3, da: DVec3, w: f64) {
        self.pp += w * dp.length_squared();
        self.pv += w * dp.dot(dv);
        self.pa += w * dp.dot(da);
        self.vv += w * dv.length_squared();
        self.va += w * dv.dot(da);
        self.aa += w * da.length_squared();
    }

    /// Smallest eigenvalue of the symmetric matrix (closed form), for tests and reports.
    pub fn min_eigenvalue(&self) -> f64 {
        let q = (self.pp + self.vv + self.aa) / 3.0;
        let (a, b, c) = (self.pp - q, self.vv - q, self.aa - q);
        let off = self.pv * self.pv + self.pa * self.pa + self.va * self.va;
        let p = ((a * a + b * b + c * c + 2.0 * off) / 6.0).sqrt();
        if p == 0.0 {
            return q;
        }
        let det = a * (b * c - self.va * self.va) - self.pv * (self.pv * c - self.va * self.pa)
            + self.pa * (self.pv * self.va - b * self.pa);
        let phi = (det / (2.0 * p * p * p)).clamp(-1.0, 1.0).acos() / 3.0;
        q + 2.0 * p * (phi + 2.0 * std::f64::consts::PI / 3.0).cos()
    }

    /// Sum of the variances.
    pub fn trace(&self) -> f64 {
        self.pp + self.vv + self.aa
    }
}

/// How a body is assumed to move between two samples. `noise` drives it: the density of white acceleration (m^2/s^3) for
/// constant velocity, of white jerk (m^2/s^5) for constant acceleration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionModel {
    /// False: acceleration is zero. True: it is a state.
    pub accelerates: bool,
    /// Power spectral density of the driving noise.
    pub noise: f64,
}

impl MotionModel {
    fn process_noise(&self, h: f64) -> Covariance {
        let q = self.noise;
        let (h2, h3) = (h * h, h * h * h);
        if self.accelerates {
            Covariance {
                pp: q * h2 * h3 / 20.0,
                pv: q * h2 * h2 / 8.0,
                pa: q * h3 / 6.0,
                vv: q * h3 / 3.0,
                va: q * h2 / 2.0,
                aa: q * h,
            }
        } else {
            Covariance { pp: q * h3 / 3.0, pv: q * h2 / 2.0, vv: q * h, ..Covariance::default() }
        }
    }
}

/// Mean and covariance of a motion at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Kinematics<P> {
    /// Position or rotation.
    pub point: P,
    /// Per second, world frame.
    pub velocity: DVec3,
    /// Per second squared, world frame.
    pub acceleration: DVec3,
    /// Of the three.
    pub covariance: Covariance,
}

impl<P: Copy> Kinematics<P> {
    /// A point that stands still, known to `variance` per axis.
    pub fn held(point: P, variance: f64) -> Self {
        let covariance = Covariance { pp: variance, ..Covariance::default() };
        Self { point, velocity: DVec3::ZERO, acceleration: DVec3::ZERO, covariance }
    }

    /// Where the point will be after `h` seconds (may be negative) at constant acceleration.
    pub fn point_at<C: Chart<Point = P>>(&self, h: f64) -> P {
        C::moved(self.point, (self.velocity + self.acceleration * (0.5 * h)) * h)
    }

    fn advance<C: Chart<Point = P>>(&mut self, model: &MotionModel, h: f64) {
        self.point = self.point_at::<C>(h);
        self.velocity += self.acceleration * h;
        self.covariance = self.covariance.propagated(h);
        self.covariance.add_scaled(&model.process_noise(h), 1.0);
    }
}

/// Number of filters in the bank.
pub const MODES: usize = 3;

/// What the bank assumes of motion in general.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImmConfig {
    /// The models, calmest first.
    pub models: [MotionModel; MODES],
    /// Mean time a mode lasts, seconds: the chance to leave it within `h` is 1 - exp(-h / dwell).
    pub dwell_s: [f64; MODES],
    /// Of those who leave mode i, the share that goes to mode j; rows sum to 1, the diagonal is 0.
    pub leave_to: [[f64; MODES]; MODES],
    /// Standard deviation of the acceleration that a coasting body may start with, m/s^2 or rad/s^2.
    pub onset_acceleration: f64,
    /// Standard deviation of the velocity before anything is known, m/s or rad/s.
    pub initial_velocity: f64,
}

/// The bank of filters at the instant of the last sample.
#[derive(Clone, Copy, Debug)]
pub struct Imm<C: Chart> {
    modes: [Kinematics<C::Point>; MODES],
    probability: [f64; MODES],
}

impl<C: Chart> Imm<C> {
    /// Starts at a measured point of variance `r` with unknown velocity.
    pub fn new(config: &ImmConfig, z: C::Point, r: f64) -> Self {
        let modes = config.models.map(|model| Kinematics {
            point: z,
            velocity: DVec3::ZERO,
            acceleration: DVec3::ZERO,
            covariance: Covariance {
                pp: r,
                vv: config.initial_velocity * config.initial_velocity,
                aa: if model.accelerates {
                    config.onset_acceleration * config.onset_acceleration
                } else {
                    0.0
                },
                ..Covariance::default()
            },
        });
        Self { modes, probability: [1.0 / MODES as f64; MODES] }
    }

    /// Weight of each model, calmest first; sums to 1.
    pub fn probability(&self) -> [f64; MODES] {
        self.probability
    }

    /// Moment-matched mean and covariance of the bank.
    pub fn combined(&self) -> Kinematics<C::Point> {
        Self::mixture(&self.modes, &self.probability, self.likeliest())
    }

    /// The covariance of each mode, for invariants in tests.
    pub fn covariances(&self) -> [Covariance; MODES] {
        self.modes.map(|m| m.covariance)
    }

    fn likeliest(&self) -> usize {
        (0..MODES).fold(0, |best, i| if self.probability[i] > self.probability[best] { i } else { best })
    }

    fn mixture(
        modes: &[Kinematics<C::Point>; MODES],
        weight: &[f64; MODES],
        base: usize,
    ) -> Kinematics<C::Point> {
        let origin = modes[base].point;
        let offset = modes.map(|m| C::between(origin, m.point));
        let (mut p, mut v, mut a) = (DVec3::ZERO, DVec3::ZERO, DVec3::ZERO);
        for i in 0..MODES {
            p += offset[i] * weight[i];
            v += modes[i].velocity * weight[i];
            a += modes[i].acceleration * weight[i];
        }
        let mut covariance = Covariance::default();
        for i in 0..MODES {
            covariance.add_scaled(&modes[i].covariance, weight[i]);
            covariance.add_spread(offset[i] - p, modes[i].velocity - v, modes[i].acceleration - a, weight[i]);
        }
        Kinematics { point: C::moved(origin, p), velocity: v, acceleration: a, covariance }
    }

    /// Mixes the modes and moves all of them `h` >= 0 seconds on.
    pub fn advance(&mut self, config: &ImmConfig, h: f64) {
        let mut moved = self.modes;
        let mut foretold = [0.0; MODES];
        for j in 0..MODES {
            let mut weight: [f64; MODES] = std::array::from_fn(|i| {
                let stays = (-h / config.dwell_s[i]).exp();
                let share = if i == j { stays } else { (1.0 - stays) * config.leave_to[i][j] };
                share * self.probability[i]
            });
            foretold[j] = weight.iter().sum();
            let mut sources = self.modes;
            if config.models[j].accelerates {
                // A coasting mode knows nothing of the acceleration that a turn starts with; its zero is not knowledge.
                for (source, model) in sources.iter_mut().zip(&config.models) {
                    if !model.accelerates {
                        source.covariance.aa = config.onset_acceleration * config.onset_acceleration;
                    }
                }
            }
            if foretold[j] > 0.0 {
                weight.iter_mut().for_each(|w| *w /= foretold[j]);
                moved[j] = Self::mixture(&sources, &weight, j);
            }
            if !config.models[j].accelerates {
                moved[j].acceleration = DVec3::ZERO;
                let c = &mut moved[j].covariance;
                (c.pa, c.va, c.aa) = (0.0, 0.0, 0.0);
            }
            moved[j].advance::<C>(&config.models[j], h);
        }
        self.modes = moved;
        self.probability = foretold;
    }

    /// Squared Mahalanobis distance of a measurement of variance `r` (after [`Imm::advance`]), by the most generous mode,
    /// with `slack` metres or rad of standard deviation added for what no mode expects.
    pub fn distance_squared(&self, z: C::Point, r: f64, slack: f64) -> f64 {
        self.modes
            .iter()
            .map(|m| {
                C::between(m.point, z).length_squared()
                    / (m.covariance.pp + r + slack * slack).max(f64::MIN_POSITIVE)
            })
            .fold(f64::INFINITY, f64::min)
    }

    /// Takes in a measurement of variance `r` >= 0 per axis at the instant that [`Imm::advance`] moved to. Returns the
    /// normalised innovation squared of the mixture (3 degrees of freedom).
    pub fn update(&mut self, z: C::Point, r: f64) -> f64 {
        let before = self.combined();
        let nis =
            C::between(before.point, z).length_squared() / (before.covariance.pp + r).max(f64::MIN_POSITIVE);
        let mut log_likelihood = [0.0; MODES];
        for (mode, log_l) in self.modes.iter_mut().zip(&mut log_likelihood) {
            let innovation = C::between(mode.point, z);
            let s = (mode.covariance.pp + r).max(f64::MIN_POSITIVE);
            *log_l = -0.5 * innovation.length_squared() / s - 1.5 * s.ln();
            let (covariance, [kp, kv, ka]) = mode.covariance.updated(r);
            mode.covariance = covariance;
            mode.point = C::moved(mode.point, innovation * kp);
            mode.velocity += innovation * kv;
            mode.acceleration += innovation * ka;
        }
        let best = log_likelihood.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut total = 0.0;
        for (p, log_l) in self.probability.iter_mut().zip(log_likelihood) {
            *p *= (log_l - best).exp();
            total += *p;
        }
        if total > 0.0 && total.is_finite() {
            self.probability.iter_mut().for_each(|p| *p /= total);
        } else {
            self.probability = [1.0 / MODES as f64; MODES];
        }
        nis
    }
}
