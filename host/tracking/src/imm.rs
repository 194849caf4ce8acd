//! Estimates position, velocity and acceleration from noisy points on a manifold: a bank of Kalman filters with mode
//! mixing.
//!
//! A constant-velocity filter with a long memory is best for a body that is still or coasts; a body that turns needs a
//! filter that models acceleration and forgets fast. No single process noise serves both. So several filters run in
//! parallel, weighted by how well each predicted the last samples (interacting multiple models, Blom and Bar-Shalom
//! 1988).
//!
//! Every axis of the tangent space has its own bank: a body that shuttles along x stays calm in y and z. The same code
//! handles translations and, through [`Chart`], rotations.

use dpm_common::so3::{so3_between, so3_exp};
use glam::{DQuat, DVec3};

/// A manifold of dimension three with tangents in the world frame.
pub trait Chart: Copy {
    /// A point on it.
    type Point: Copy + std::fmt::Debug + PartialEq;
    /// The tangent that leads from `from` to `to`.
    fn between(from: Self::Point, to: Self::Point) -> DVec3;
    /// The point reached from `from` along a tangent.
    fn moved(from: Self::Point, by: DVec3) -> Self::Point;
    /// True if the tangents of points as near as `from` and `to` add up like vectors, with enough precision to fit curves to
    /// them.
    fn is_flat(from: Self::Point, to: Self::Point) -> bool;
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
    fn is_flat(_from: DVec3, _to: DVec3) -> bool {
        true
    }
}

/// Rotations as unit quaternions; tangents are world-space rotation vectors, rad.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rotations;

impl Chart for Rotations {
    type Point = DQuat;
    fn between(from: DQuat, to: DQuat) -> DVec3 {
        so3_between(from, to)
    }
    fn moved(from: DQuat, by: DVec3) -> DQuat {
        (so3_exp(by) * from).normalize()
    }
    fn is_flat(from: DQuat, to: DQuat) -> bool {
        // The product of two unit quaternions is the cosine of half the angle between them: up to 1 rad.
        const COS_HALF: f64 = 0.877_582_561_890_372_8;
        from.dot(to).abs() >= COS_HALF
    }
}

/// Symmetric covariance of position p, velocity v and acceleration a along one axis. SI units.
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
    pub(crate) fn position_variance_at(&self, h: f64) -> f64 {
        let half = 0.5 * h * h;
        self.pp
            + h * (2.0 * self.pv + h * self.vv)
            + half * (2.0 * self.pa + 2.0 * h * self.va + half * self.aa)
    }

    /// F P F^T for the transition matrix F.
    fn propagated(&self, f: &Transition) -> Self {
        // M = F P, row by row; then M F^T.
        let row = |r: [f64; 3]| {
            [
                r[0] * self.pp + r[1] * self.pv + r[2] * self.pa,
                r[0] * self.pv + r[1] * self.vv + r[2] * self.va,
                r[0] * self.pa + r[1] * self.va + r[2] * self.aa,
            ]
        };
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let (m0, m1, m2) = (row(f.p), row(f.v), row(f.a));
        Self {
            pp: dot(m0, f.p),
            pv: dot(m0, f.v),
            pa: dot(m0, f.a),
            vv: dot(m1, f.v),
            va: dot(m1, f.a),
            aa: dot(m2, f.a),
        }
    }

    /// That of a motion of constant acceleration after `h` seconds, which nothing drives.
    pub(crate) fn accelerated(&self, h: f64) -> Self {
        let half = 0.5 * h * h;
        // M = F P, without its zeros; then M F^T.
        let m0 = [
            self.pp + h * self.pv + half * self.pa,
            self.pv + h * self.vv + half * self.va,
            self.pa + h * self.va + half * self.aa,
        ];
        let m1 = [self.vv + h * self.va, self.va + h * self.aa];
        Self {
            pp: m0[0] + m0[1] * h + m0[2] * half,
            pv: m0[1] + m0[2] * h,
            pa: m0[2],
            vv: m1[0] + m1[1] * h,
            va: m1[1],
            aa: self.aa,
        }
    }

    /// Joseph form for one position measurement of variance `r`; returns the gains too. 1 - K is computed as R / S, because
    /// the subtraction would lose every digit when P exceeds R by sixteen orders of magnitude.
    pub(crate) fn updated(&self, r: f64) -> (Self, [f64; 3]) {
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
        (new.repaired(), [k0, k1, k2])
    }

    /// The smallest increase that makes a covariance valid again after rounding: an LDL^T factorisation from the
    /// acceleration down, in which a negative conditional variance becomes zero by raising the variance it belongs to.
    /// Acts only if the prior exceeds what the measurements leave by twelve orders of magnitude or more, where no
    /// significant digits are left.
    fn repaired(mut self) -> Self {
        if self.aa <= 0.0 {
            (self.aa, self.va, self.pa) = (0.0, 0.0, 0.0);
        }
        let over_a = if self.aa > 0.0 { 1.0 / self.aa } else { 0.0 };
        let conditional_v = self.vv - self.va * self.va * over_a;
        let link = self.pv - self.va * self.pa * over_a;
        if conditional_v <= 0.0 {
            // Recomputed, not corrected by the difference: the difference has the rounding error of its operands, which
            // may be far larger.
            self.vv = self.va * self.va * over_a;
            self.pv = self.va * self.pa * over_a;
        }
        let explained = if conditional_v > 0.0 { link * link / conditional_v } else { 0.0 };
        self.pp = self.pp.max(self.pa * self.pa * over_a + explained);
        self
    }

    /// This one and `other`, of which the mixture has the share `w`.
    pub(crate) fn mixed(&self, other: &Self, w: f64) -> Self {
        let mut mixed = Self::default();
        mixed.add_scaled(self, 1.0 - w);
        mixed.add_scaled(other, w);
        mixed
    }

    pub(crate) fn add_scaled(&mut self, o: &Self, w: f64) {
        self.pp += w * o.pp;
        self.pv += w * o.pv;
        self.pa += w * o.pa;
        self.vv += w * o.vv;
        self.va += w * o.va;
        self.aa += w * o.aa;
    }

    /// Spread of the means in a mixture.
    fn add_spread(&mut self, dp: f64, dv: f64, da: f64, w: f64) {
        self.pp += w * dp * dp;
        self.pv += w * dp * dv;
        self.pa += w * dp * da;
        self.vv += w * dv * dv;
        self.va += w * dv * da;
        self.aa += w * da * da;
    }

    /// Sum of the variances.
    #[cfg(test)]
    pub(crate) fn trace(&self) -> f64 {
        self.pp + self.vv + self.aa
    }
}

/// Rows of the transition matrix of (p, v, a).
struct Transition {
    p: [f64; 3],
    v: [f64; 3],
    a: [f64; 3],
}

/// How a body is assumed to move along one axis between two samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionModel {
    /// False: acceleration is zero. True: it is a state.
    pub accelerates: bool,
    /// Jerk is `-w^2` times velocity: a swing about any centre at this angular frequency, rad/s; 0 is constant acceleration.
    /// Only where `accelerates`.
    pub swing_rad_s: f64,
    /// Power spectral density of the driving noise: white acceleration (m^2/s^3) where the model does not accelerate, else
    /// white jerk (m^2/s^5).
    pub noise: f64,
}

impl MotionModel {
    fn transition(&self, h: f64) -> Transition {
        if !self.accelerates {
            return Transition { p: [1.0, h, 0.0], v: [0.0, 1.0, 0.0], a: [0.0; 3] };
        }
        let w = self.swing_rad_s;
        if w == 0.0 {
            return Transition { p: [1.0, h, 0.5 * h * h], v: [0.0, 1.0, h], a: [0.0, 0.0, 1.0] };
        }
        let x = w * h;
        let (sin, cos) = libm::sincos(x);
        // (1 - cos x) / w^2 by the half angle: no cancellation; both quotients have their limits at w = 0.
        let (first, second) = if x.abs() < 1e-8 {
            (h, 0.5 * h * h)
        } else {
            let half = libm::sin(0.5 * x);
            (sin / w, 2.0 * half * half / (w * w))
        };
        Transition { p: [1.0, first, second], v: [0.0, cos, first], a: [0.0, -w * sin, cos] }
    }

    /// The noise collected in `h` seconds; the swing's feedback changes it by O((w h)^2) and is left out.
    pub(crate) fn process_noise(&self, h: f64) -> Covariance {
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

/// A motion at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion<P> {
    /// Position or rotation.
    pub point: P,
    /// Per second, world frame.
    pub velocity: DVec3,
    /// Per second squared, world frame.
    pub acceleration: DVec3,
}

impl<P: Copy> Motion<P> {
    /// Where the point will be after `h` seconds (may be negative), if its acceleration lasts for [`ACCELERATES_S`] and
    /// its velocity from then on. An estimated acceleration is mostly noise beyond that: at 50 ms, an error of
    /// 30 m/s^2 would move a body by 38 mm.
    pub(crate) fn point_after<C: Chart<Point = P>>(&self, h: f64) -> P {
        let accelerated = h.clamp(-ACCELERATES_S, ACCELERATES_S);
        if accelerated == h {
            return self.point_at::<C>(h);
        }
        let moved = self.velocity * h + self.acceleration * (accelerated * (h - 0.5 * accelerated));
        C::moved(self.point, moved)
    }

    /// Where the point will be after `h` seconds (may be negative) at constant acceleration.
    pub(crate) fn point_at<C: Chart<Point = P>>(&self, h: f64) -> P {
        C::moved(self.point, (self.velocity + self.acceleration * (0.5 * h)) * h)
    }
}

/// Mean and covariance of a motion at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Kinematics<P> {
    /// The mean.
    pub mean: Motion<P>,
    /// Of position, velocity and acceleration, along x, y and z.
    pub covariance: [Covariance; 3],
}

impl<P: Copy> Kinematics<P> {
    /// A point at rest, known to `variance` per axis.
    pub(crate) fn held(point: P, variance: f64) -> Self {
        let covariance = [Covariance { pp: variance, ..Covariance::default() }; 3];
        Self { mean: Motion { point, velocity: DVec3::ZERO, acceleration: DVec3::ZERO }, covariance }
    }
}

/// A prediction carries an acceleration on for this long, seconds.
pub(crate) const ACCELERATES_S: f64 = 0.012;

/// The motion of a body the last time that it passed this place, over one step ([`super::recall`]).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PastMotion {
    /// Its displacement beyond that of its velocity at the step's begin, m or rad.
    pub moved: DVec3,
    /// Its change of velocity, per second.
    pub faster: DVec3,
    /// Its mean acceleration over the horizon after the step, per second squared.
    pub acceleration: DVec3,
    /// Axes along which there is an acceleration nearby. Along the others the models are better, without the noise of
    /// the past.
    pub matters: [bool; 3],
}

/// One axis of [`PastMotion`].
#[derive(Clone, Copy, Debug)]
struct RecalledAxis {
    moved: f64,
    faster: f64,
    acceleration: f64,
}

/// Number of filters in a bank.
pub(crate) const MODES: usize = 5;
/// The filter that repeats the former motion; its model says how exactly the body repeats itself. It takes part only
/// while a motion is recalled.
pub(crate) const RECALLED: usize = 4;

/// A bank's assumptions about motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImmConfig {
    /// The models.
    pub models: [MotionModel; MODES],
    /// Mean duration of a mode, seconds: the chance to leave it within `h` is 1 - exp(-h / dwell).
    pub dwell_s: [f64; MODES],
    /// Of all transitions from mode i, the share to mode j; rows sum to 1, the diagonal is 0.
    pub leave_to: [[f64; MODES]; MODES],
    /// While a motion is recalled: mean time after which any mode changes to [`RECALLED`], seconds.
    pub recall_after_s: f64,
    /// Standard deviation of the acceleration that a coasting body may start with, m/s^2 or rad/s^2.
    pub onset_acceleration: f64,
    /// Standard deviation of the velocity before anything is known, m/s or rad/s.
    pub initial_velocity: f64,
}

impl ImmConfig {
    fn step(&self, h: f64) -> BankStep {
        let among = std::array::from_fn(|i| {
            let stays = libm::exp(-h / self.dwell_s[i]);
            std::array::from_fn(|j| if i == j { stays } else { (1.0 - stays) * self.leave_to[i][j] })
        });
        BankStep {
            among,
            forgotten: self.leave_to[RECALLED],
            unrecalled: libm::exp(-h / self.recall_after_s),
            transitions: self.models.map(|model| model.transition(h)),
            noises: self.models.map(|model| model.process_noise(h)),
        }
    }

    /// The greatest acceleration that a body is believed to repeat, m/s^2 or rad/s^2: twenty times the expected one.
    pub(crate) fn greatest_recalled(&self) -> f64 {
        24.0 * self.onset_acceleration
    }
}

/// Models for bodies whose turns take about `acceleration` (m/s^2 or rad/s^2) and whose velocity changes in a good part
/// of a second: coasting; steady acceleration; swinging at the pace of a hand or a rocker; a sharp manoeuvre, which
/// bridges the onset of a turn; and the body's motion the last time. The numbers were found by a random search over
/// shuttles and swings of 1 to 3 Hz with 0.1 mm of noise at 500 Hz (the table in `docs/lab/PREDICTION.md`); densities
/// scale with the square of the acceleration.
pub fn models_for(acceleration: f64) -> ImmConfig {
    let a2 = acceleration * acceleration;
    let model = |accelerates, swing_rad_s, noise| MotionModel { accelerates, swing_rad_s, noise };
    ImmConfig {
        models: [
            model(false, 0.0, 1e-7 * a2),
            model(true, 0.0, 0.012 * a2),
            model(true, 10.0, 0.0017 * a2),
            model(true, 0.0, 28.0 * a2),
            model(false, 0.0, 1e-5 * a2),
        ],
        dwell_s: [1.0, 0.07, 1.0, 0.03, 1.5],
        leave_to: [
            [0.0, 0.02, 0.94, 0.04, 0.0],
            [0.54, 0.0, 0.01, 0.45, 0.0],
            [0.24, 0.01, 0.0, 0.75, 0.0],
            [0.05, 0.8, 0.15, 0.0, 0.0],
            [0.85, 0.05, 0.05, 0.05, 0.0],
        ],
        recall_after_s: 0.03,
        onset_acceleration: 0.83 * acceleration,
        initial_velocity: 4.0 * acceleration,
    }
}

/// What all axes of a bank have in common when it advances by one step.
struct BankStep {
    /// Share of mode `i` that is in mode `j` afterwards, if nothing but the models decides.
    among: [[f64; MODES]; MODES],
    /// Where [`RECALLED`] goes when nothing is recalled any more.
    forgotten: [f64; MODES],
    /// Share of any other mode that does not change to [`RECALLED`] while a motion is recalled.
    unrecalled: f64,
    transitions: [Transition; MODES],
    noises: [Covariance; MODES],
}

impl BankStep {
    /// Share of mode `i` that is in mode `j` afterwards.
    fn share(&self, i: usize, j: usize, recalls: bool) -> f64 {
        match (i == RECALLED, recalls) {
            (true, false) => self.forgotten[j],
            (false, true) if j == RECALLED => 1.0 - self.unrecalled,
            (false, true) => self.among[i][j] * self.unrecalled,
            _ => self.among[i][j],
        }
    }
}

/// One filter on one axis. Its position is an offset from the bank's common base point.
#[derive(Clone, Copy, Debug, Default)]
struct AxisMode {
    offset: f64,
    velocity: f64,
    acceleration: f64,
    covariance: Covariance,
}

/// The filters of one axis.
#[derive(Clone, Copy, Debug)]
struct AxisBank {
    modes: [AxisMode; MODES],
    probability: [f64; MODES],
}

impl AxisBank {
    fn new(config: &ImmConfig, r: f64) -> Self {
        let modes = config.models.map(|model| AxisMode {
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
            ..AxisMode::default()
        });
        Self { modes, probability: Self::UNKNOWN }
    }

    /// The same for all but [`RECALLED`].
    const UNKNOWN: [f64; MODES] = {
        let mut all = [1.0 / (MODES - 1) as f64; MODES];
        all[RECALLED] = 0.0;
        all
    };

    /// Modes that count for anything: most bodies recall nothing most of the time.
    fn possible(&self, recalls: bool) -> usize {
        if recalls || self.probability[RECALLED] > 0.0 {
            MODES
        } else {
            RECALLED
        }
    }

    /// Moment-matched mean and covariance of weighted modes.
    fn mixture(modes: &[AxisMode], weight: &[f64]) -> AxisMode {
        let mut mean = AxisMode::default();
        for (m, &w) in modes.iter().zip(weight) {
            mean.offset += m.offset * w;
            mean.velocity += m.velocity * w;
            mean.acceleration += m.acceleration * w;
        }
        for (m, &w) in modes.iter().zip(weight) {
            mean.covariance.add_scaled(&m.covariance, w);
            let (dp, dv, da) =
                (m.offset - mean.offset, m.velocity - mean.velocity, m.acceleration - mean.acceleration);
            mean.covariance.add_spread(dp, dv, da, w);
        }
        mean
    }

    /// Mixes the modes and propagates all of them by `step`.
    fn advance(&mut self, config: &ImmConfig, step: &BankStep, recalled: Option<RecalledAxis>) {
        let possible = self.possible(recalled.is_some());
        let mut moved = self.modes;
        let mut foretold = [0.0; MODES];
        // A coasting mode has no information on the acceleration at the start of a turn; its zero is not an estimate.
        let mut open = self.modes;
        for (source, model) in open.iter_mut().zip(&config.models) {
            if !model.accelerates {
                source.covariance.aa = config.onset_acceleration * config.onset_acceleration;
            }
        }
        for (j, model) in config.models.iter().enumerate().take(possible) {
            let mut weight: [f64; MODES] =
                std::array::from_fn(|i| step.share(i, j, recalled.is_some()) * self.probability[i]);
            foretold[j] = weight.iter().sum();
            let mode = &mut moved[j];
            if foretold[j] > 0.0 {
                weight.iter_mut().for_each(|w| *w /= foretold[j]);
                let sources = if model.accelerates { &open } else { &self.modes };
                *mode = Self::mixture(&sources[..possible], &weight);
            }
            let f = &step.transitions[j];
            let (v, a) = (mode.velocity, mode.acceleration);
            mode.offset += f.p[1] * v + f.p[2] * a;
            mode.velocity = f.v[1] * v + f.v[2] * a;
            mode.acceleration = f.a[1] * v + f.a[2] * a;
            if let (RECALLED, Some(recalled)) = (j, recalled) {
                mode.offset += recalled.moved;
                mode.velocity += recalled.faster;
                mode.acceleration = recalled.acceleration;
            }
            mode.covariance = mode.covariance.propagated(f);
            mode.covariance.add_scaled(&step.noises[j], 1.0);
        }
        self.modes = moved;
        self.probability = foretold;
    }

    /// Updates with a measured offset of variance `r`.
    fn update(&mut self, z: f64, r: f64) {
        let possible = self.possible(false);
        let mut log_likelihood = [0.0; MODES];
        for (mode, log_l) in self.modes.iter_mut().zip(&mut log_likelihood).take(possible) {
            let innovation = z - mode.offset;
            let s = (mode.covariance.pp + r).max(f64::MIN_POSITIVE);
            *log_l = -0.5 * (innovation * innovation / s + libm::log(s));
            let (covariance, [kp, kv, ka]) = mode.covariance.updated(r);
            mode.covariance = covariance;
            mode.offset += innovation * kp;
            mode.velocity += innovation * kv;
            mode.acceleration += innovation * ka;
        }
        let possible = log_likelihood.iter().zip(&self.probability).filter(|(_, p)| **p > 0.0);
        let best = possible.map(|(l, _)| *l).fold(f64::NEG_INFINITY, f64::max);
        let mut total = 0.0;
        for (p, log_l) in self.probability.iter_mut().zip(log_likelihood) {
            *p = if *p > 0.0 { *p * libm::exp(log_l - best) } else { 0.0 };
            total += *p;
        }
        if total > 0.0 && total.is_finite() {
            self.probability.iter_mut().for_each(|p| *p /= total);
        } else {
            self.probability = Self::UNKNOWN;
        }
    }
}

/// The banks of all three axes at the instant of the last sample.
#[derive(Clone, Copy, Debug)]
pub struct Imm<C: Chart> {
    base: C::Point,
    axes: [AxisBank; 3],
}

impl<C: Chart> Imm<C> {
    /// Starts at a measured point of variance `r` along each axis with unknown velocity.
    pub fn new(config: &ImmConfig, z: C::Point, r: DVec3) -> Self {
        Self { base: z, axes: r.to_array().map(|r| AxisBank::new(config, r)) }
    }

    /// Weight of each model on each axis; each row sums to 1.
    #[cfg(test)]
    pub(crate) fn probability(&self) -> [[f64; MODES]; 3] {
        self.axes.map(|axis| axis.probability)
    }

    /// The covariance of each mode on each axis, for invariants in tests.
    pub fn covariances(&self) -> [[Covariance; MODES]; 3] {
        self.axes.map(|axis| axis.modes.map(|m| m.covariance))
    }

    /// Moment-matched mean and covariance of the banks.
    pub(crate) fn combined(&self) -> Kinematics<C::Point> {
        let mean = self.axes.map(|axis| AxisBank::mixture(&axis.modes, &axis.probability));
        Kinematics {
            mean: Motion {
                point: C::moved(self.base, DVec3::from_array(mean.map(|m| m.offset))),
                velocity: DVec3::from_array(mean.map(|m| m.velocity)),
                acceleration: DVec3::from_array(mean.map(|m| m.acceleration)),
            },
            covariance: mean.map(|m| m.covariance),
        }
    }

    /// Mean of the banks.
    pub(crate) fn mean(&self) -> Motion<C::Point> {
        let [mut offset, mut velocity, mut acceleration] = [[0.0; 3]; 3];
        for (i, axis) in self.axes.iter().enumerate() {
            for (mode, p) in axis.modes.iter().zip(axis.probability) {
                offset[i] += mode.offset * p;
                velocity[i] += mode.velocity * p;
                acceleration[i] += mode.acceleration * p;
            }
        }
        Motion {
            point: C::moved(self.base, DVec3::from_array(offset)),
            velocity: DVec3::from_array(velocity),
            acceleration: DVec3::from_array(acceleration),
        }
    }

    /// Moves the base point into the middle of the modes, so that offsets stay small against the chart's curvature.
    fn rebase(&mut self) {
        let mut mean = [0.0; 3];
        for (axis, mean) in self.axes.iter_mut().zip(&mut mean) {
            *mean = axis.modes.iter().zip(axis.probability).map(|(m, p)| m.offset * p).sum();
            axis.modes.iter_mut().for_each(|m| m.offset -= *mean);
        }
        self.base = C::moved(self.base, DVec3::from_array(mean));
    }

    /// Mixes the modes and propagates all of them by `h` >= 0 seconds, [`RECALLED`] according to `recalled`.
    pub fn advance(&mut self, config: &ImmConfig, h: f64, recalled: Option<PastMotion>) {
        let step = config.step(h);
        for (i, axis) in self.axes.iter_mut().enumerate() {
            let along = recalled.filter(|r| r.matters[i]).map(|r| RecalledAxis {
                moved: r.moved[i],
                faster: r.faster[i],
                acceleration: r.acceleration[i],
            });
            axis.advance(config, &step, along);
        }
        self.rebase();
    }

    /// Squared Mahalanobis distance of a measurement of variance `r` along each axis (after [`Imm::advance`]): each axis by its most
    /// tolerant mode, with `slack` metres or rad of standard deviation added for motion that no mode expects.
    pub(crate) fn distance_squared(&self, z: C::Point, r: DVec3, slack: f64) -> f64 {
        let z = C::between(self.base, z).to_array();
        let axis = |((bank, z), r): ((&AxisBank, f64), f64)| {
            let distance = |m: &AxisMode| {
                let d = z - m.offset;
                d * d / (m.covariance.pp + r + slack * slack).max(f64::MIN_POSITIVE)
            };
            let possible = bank.modes.iter().zip(bank.probability).filter(|(_, p)| *p > 0.0);
            possible.map(|(m, _)| distance(m)).fold(f64::INFINITY, f64::min)
        };
        self.axes.iter().zip(z).zip(r.to_array()).map(axis).sum()
    }

    /// Updates with a measurement of variance `r` >= 0 along each axis at the instant that [`Imm::advance`] propagated to.
    /// Returns the normalised innovation squared of the mixture (3 degrees of freedom).
    pub fn update(&mut self, z: C::Point, r: DVec3) -> f64 {
        let z = C::between(self.base, z).to_array();
        let mut nis = 0.0;
        for ((axis, z), r) in self.axes.iter_mut().zip(z).zip(r.to_array()) {
            let before = AxisBank::mixture(&axis.modes, &axis.probability);
            let d = z - before.offset;
            nis += d * d / (before.covariance.pp + r).max(f64::MIN_POSITIVE);
            axis.update(z, r);
        }
        self.rebase();
        nis
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The shares of the transitions from a mode sum to one.
    #[test]
    fn shares_of_a_mode_sum_to_one() {
        let config = models_for(5.0);
        for (h, recalls) in [0.0, 0.002, 0.1, 10.0].into_iter().flat_map(|h| [(h, false), (h, true)]) {
            for i in 0..MODES {
                let sum: f64 = (0..MODES).map(|j| config.step(h).share(i, j, recalls)).sum();
                assert!((sum - 1.0).abs() < 1e-12, "{sum} of mode {i} after {h} s, recalled: {recalls}");
            }
        }
    }

    proptest! {
        /// The gain lies in [0, 1], a measurement never makes the position less certain, and the remaining variance is
        /// no more than the measurement's own: over 24 orders of magnitude in either direction.
        #[test]
        fn gains_are_weights(p in -12f64..12.0, r in -12f64..12.0, v in -12f64..12.0, rho in -0.99f64..0.99) {
            let [p, r, v] = [p, r, v].map(|e| 10f64.powf(e));
            let before = Covariance { pp: p, pv: rho * (p * v).sqrt(), vv: v, ..Covariance::default() };
            let (after, [k, ..]) = before.updated(r);
            prop_assert!((0.0..=1.0).contains(&k));
            prop_assert!(after.pp <= p.min(r) * (1.0 + 1e-9), "{} of {p}, {r}", after.pp);
            prop_assert!(after.vv <= v * (1.0 + 1e-9) && after.vv >= 0.0);
            prop_assert!(after.pv * after.pv <= after.pp * after.vv * (1.0 + 1e-9));
        }

        /// Two steps equal one step of their sum, for the motion and for its noise (the noise exactly only without
        /// swing).
        #[test]
        fn transitions_compose(h1 in 0f64..0.05, h2 in 0f64..0.05, w in 0f64..30.0, x in prop::array::uniform3(-10f64..10.0)) {
            let model = MotionModel { accelerates: true, swing_rad_s: w, noise: 2.0 };
            let apply = |f: &Transition, x: [f64; 3]| [f.p, f.v, f.a].map(|r| r[0] * x[0] + r[1] * x[1] + r[2] * x[2]);
            let twice = apply(&model.transition(h2), apply(&model.transition(h1), x));
            let once = apply(&model.transition(h1 + h2), x);
            for (a, b) in twice.iter().zip(once) {
                prop_assert!((a - b).abs() < 1e-11 * 1e3);
            }
            for model in [MotionModel { swing_rad_s: 0.0, ..model }, MotionModel { accelerates: false, swing_rad_s: 0.0, noise: 2.0 }] {
                let mut twice = model.process_noise(h1).propagated(&model.transition(h2));
                twice.add_scaled(&model.process_noise(h2), 1.0);
                let once = model.process_noise(h1 + h2);
                let close = |a: f64, b: f64| (a - b).abs() <= 1e-12 * b.abs() + 1e-30;
                prop_assert!(close(twice.pp, once.pp) && close(twice.pv, once.pv) && close(twice.vv, once.vv));
                prop_assert!(close(twice.pa, once.pa) && close(twice.va, once.va) && close(twice.aa, once.aa));
            }
        }
    }
}
