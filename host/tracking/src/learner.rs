//! Learns how sharply a body moves, from its own samples.
//!
//! No filter serves a foot, a hand, a drone and a machine. Two kinds run side by side: a bank of models ([`super::imm`]),
//! which is best where a body rests, coasts, turns and repeats itself, and a ladder of filters of constant acceleration,
//! each driven by four times the noise of the one below, of which one fits a motion that never coasts. At every sample
//! each is asked where it expected the body, 4 ms before. The rung whose forecasts of the last quarter of a second erred
//! least says what acceleration the bank's models are scaled for, and the prediction is the mean of that rung and the
//! bank, each weighted by how little it erred beyond the tracker's noise.
//!
//! A rung is cheap: its gains depend on the stamps and the noise alone, so the three axes share them, and all rungs
//! share the tangent space of one base point.

use super::imm::{
    models_for, Chart, Covariance, Imm, ImmConfig, Kinematics, Motion, MotionModel, PastMotion,
};
use glam::DVec3;

/// Rungs of the ladder, and the one that fits the acceleration of the settings.
const RUNGS: usize = 9;
const MIDDLE: usize = 4;
/// Density of the white jerk that drives the middle rung for an acceleration of 1 m/s^2 or rad/s^2. This and the three
/// below were found on the recordings of `docs/lab/PREDICTION.md`.
const JERK: f64 = 8.0;
/// An error counts 1/e of a new one after this time, seconds.
const MEMORY_S: f64 = 0.25;
/// A rung replaces the one in use when its squared errors are less than this share of that one's.
const BETTER: f64 = 0.9;
/// Share of the tracker's noise that is taken out of the errors before bank and rung are weighted. Its estimate may be
/// too large by a tenth.
const NOISE_SHARE: f64 = 0.9;
/// Forecasts are judged as far ahead as light usually lies, nanoseconds.
const AHEAD_NS: i64 = 4_000_000;
/// Samples from which forecasts are kept. A tracker above 2 kHz is judged by shorter ones.
const KEPT: usize = 9;
/// Forecasts before the first choice.
const SETTLES: u32 = 32;

/// A filter of constant acceleration. Its position is an offset from the ladder's base.
#[derive(Clone, Copy, Debug, Default)]
struct Rung {
    mean: Acceleration,
    /// Of each axis.
    covariance: Covariance,
}

/// A motion of constant acceleration, from the ladder's base.
#[derive(Clone, Copy, Debug, Default)]
struct Acceleration {
    offset: DVec3,
    velocity: DVec3,
    acceleration: DVec3,
}

impl Acceleration {
    fn offset_after(&self, h: f64) -> DVec3 {
        self.offset + (self.velocity + self.acceleration * (0.5 * h)) * h
    }
}

/// What was known at a sample.
#[derive(Clone, Copy, Debug)]
struct Past<P> {
    at_ns: i64,
    bank: Motion<P>,
    base: P,
    rungs: [Acceleration; RUNGS],
}

/// What a step of time changes, which a sample that cannot be true takes back.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Present<C: Chart> {
    bank: Imm<C>,
    rungs: [Rung; RUNGS],
}

/// Sums of squared errors of forecasts, m^2 or rad^2, the older ones fading.
#[derive(Clone, Copy, Debug, Default)]
struct Errors {
    bank: f64,
    rungs: [f64; RUNGS],
    /// What the tracker's noise makes of any forecast.
    noise: f64,
    /// Forecasts in the sums, the older ones fading.
    weight: f64,
    /// Forecasts that were judged.
    count: u32,
}

/// See the module's documentation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Learner<C: Chart> {
    /// Of the settings, m/s^2 or rad/s^2.
    acceleration: f64,
    recall_after_s: f64,
    now: Present<C>,
    base: C::Point,
    best: usize,
    errors: Errors,
    past: [Option<Past<C::Point>>; KEPT],
    next: usize,
}

/// The variance of an axis that is like all three: the rungs do not tell axes apart.
fn mean(r: DVec3) -> f64 {
    r.element_sum() / 3.0
}

impl<C: Chart> Learner<C> {
    /// Starts at a measured point of variance `r` along each axis with unknown velocity. The body is expected to accelerate by
    /// `acceleration` doubled `level` times, and to repeat itself after `recall_after_s` ([`ImmConfig`]).
    pub(crate) fn new(acceleration: f64, recall_after_s: f64, level: i32, z: C::Point, r: DVec3) -> Self {
        let config = models_for(acceleration * f64::from(level).exp2());
        let covariance = Covariance {
            pp: mean(r),
            vv: config.initial_velocity.powi(2),
            aa: config.onset_acceleration.powi(2),
            ..Covariance::default()
        };
        Self {
            acceleration,
            recall_after_s,
            now: Present {
                bank: Imm::new(&config, z, r),
                rungs: [Rung { covariance, ..Rung::default() }; RUNGS],
            },
            base: z,
            best: (MIDDLE as i32 + level).clamp(0, RUNGS as i32 - 1) as usize,
            errors: Errors::default(),
            past: [None; KEPT],
            next: 0,
        }
    }

    /// Steps by which the learned acceleration lies above that of the settings; each doubles it.
    pub(crate) fn level(&self) -> i32 {
        self.best as i32 - MIDDLE as i32
    }

    /// By how much the forecasts of the rung that fits the settings err more than those of the one in use, as a root of mean
    /// squares, m or rad; 0 before the first choice.
    pub(crate) fn excess(&self) -> f64 {
        let Errors { rungs, weight, .. } = &self.errors;
        ((rungs[MIDDLE] - rungs[self.best]).max(0.0) / weight.max(1.0)).sqrt()
    }

    /// The bank's models.
    fn config(&self) -> ImmConfig {
        let acceleration = self.acceleration * f64::from(self.level()).exp2();
        ImmConfig { recall_after_s: self.recall_after_s, ..models_for(acceleration) }
    }

    /// As [`ImmConfig::greatest_recalled`].
    pub(crate) fn greatest_recalled(&self) -> f64 {
        self.config().greatest_recalled()
    }

    /// The bank, which judges whether a sample can be true.
    pub(crate) fn bank(&self) -> &Imm<C> {
        &self.now.bank
    }

    /// What [`Learner::advance`] will change.
    pub(crate) fn present(&self) -> Present<C> {
        self.now
    }

    /// Undoes [`Learner::advance`].
    pub(crate) fn back_to(&mut self, present: Present<C>) {
        self.now = present;
    }

    /// Mean and covariance of the motion.
    pub(crate) fn combined(&self) -> Kinematics<C::Point> {
        let (bank, rung) = (self.now.bank.combined(), &self.now.rungs[self.best]);
        let w = self.errors.share_of_rung(self.best);
        let apart = C::between(bank.mean.point, C::moved(self.base, rung.mean.offset));
        Kinematics {
            mean: Motion {
                point: C::moved(bank.mean.point, apart * w),
                velocity: bank.mean.velocity.lerp(rung.mean.velocity, w),
                acceleration: bank.mean.acceleration.lerp(rung.mean.acceleration, w),
            },
            covariance: bank.covariance.map(|covariance| covariance.mixed(&rung.covariance, w)),
        }
    }

    /// Advances all filters by `h` >= 0 seconds, the bank according to `recalled`.
    pub(crate) fn advance(&mut self, h: f64, recalled: Option<PastMotion>) {
        let config = self.config();
        self.now.bank.advance(&config, h, recalled);
        // What a noise of 1 makes of a step, of which each rung has its share.
        let unit = MotionModel { accelerates: true, swing_rad_s: 0.0, noise: 1.0 }.process_noise(h);
        let mut noise = JERK * (self.acceleration * f64::from(-(MIDDLE as i32)).exp2()).powi(2);
        for rung in &mut self.now.rungs {
            rung.mean.offset = rung.mean.offset_after(h);
            rung.mean.velocity += rung.mean.acceleration * h;
            rung.covariance = rung.covariance.accelerated(h);
            rung.covariance.add_scaled(&unit, noise);
            noise *= 4.0;
        }
    }

    /// Updates all filters with a measurement of variance `r` along each axis at `at_ns`, to which they were advanced. Returns the
    /// normalised innovation squared of the bank.
    pub(crate) fn update(&mut self, at_ns: i64, z: C::Point, r: DVec3) -> f64 {
        let nis = self.now.bank.update(z, r);
        let r = mean(r);
        let measured = C::between(self.base, z);
        for rung in &mut self.now.rungs {
            let (covariance, [kp, kv, ka]) = rung.covariance.updated(r);
            let innovation = measured - rung.mean.offset;
            rung.covariance = covariance;
            rung.mean.offset += innovation * kp;
            rung.mean.velocity += innovation * kv;
            rung.mean.acceleration += innovation * ka;
        }
        self.judge(at_ns, z, r);
        // The base follows, so that offsets stay small against the chart's curvature.
        let moved = self.now.rungs[self.best].mean.offset;
        self.base = C::moved(self.base, moved);
        self.now.rungs.iter_mut().for_each(|rung| rung.mean.offset -= moved);
        let (bank, rungs) = (self.now.bank.mean(), self.now.rungs.map(|rung| rung.mean));
        // Of several samples of one instant the last one is kept, which has all of them in it.
        let newest = (self.next + KEPT - 1) % KEPT;
        let is_same = self.past[newest].is_some_and(|past| past.at_ns == at_ns);
        let slot = if is_same { newest } else { self.next };
        self.past[slot] = Some(Past { at_ns, bank, base: self.base, rungs });
        self.next = (slot + 1) % KEPT;
        nis
    }

    /// Compares what the filters expected with `z`, and chooses a rung.
    fn judge(&mut self, at_ns: i64, z: C::Point, r: f64) {
        let Some(newest) = &self.past[(self.next + KEPT - 1) % KEPT] else { return };
        let kept = || self.past.iter().flatten();
        let nearest = kept().filter(|past| at_ns - past.at_ns >= AHEAD_NS).max_by_key(|past| past.at_ns);
        let Some(from) = nearest.or_else(|| kept().min_by_key(|past| past.at_ns)) else { return };
        let h = (at_ns - from.at_ns) as f64 * 1e-9;
        let errors = &mut self.errors;
        let fade = 1.0 / (1.0 + (at_ns - newest.at_ns) as f64 * 1e-9 / MEMORY_S);
        errors.bank = errors.bank * fade + C::between(from.bank.point_after::<C>(h), z).length_squared();
        let measured = C::between(from.base, z);
        for (error, rung) in errors.rungs.iter_mut().zip(&from.rungs) {
            *error = *error * fade + (measured - rung.offset_after(h)).length_squared();
        }
        errors.noise = errors.noise * fade + 3.0 * r;
        errors.weight = errors.weight * fade + 1.0;
        errors.count = errors.count.saturating_add(1);
        if errors.count < SETTLES {
            return;
        }
        let least =
            (0..RUNGS).min_by(|&a, &b| errors.rungs[a].total_cmp(&errors.rungs[b])).unwrap_or(self.best);
        if errors.rungs[least] < BETTER * errors.rungs[self.best] {
            self.best = least;
        }
    }
}

impl Errors {
    /// Weight of the rung beside the bank: the fourth powers of their errors, beyond what the noise makes of both.
    fn share_of_rung(&self, rung: usize) -> f64 {
        let excess = |error: f64| (error - NOISE_SHARE * self.noise).max(0.01 * self.noise).powi(4);
        let (bank, rung) = (excess(self.bank), excess(self.rungs[rung]));
        let share = bank / (bank + rung);
        if self.count >= SETTLES && share.is_finite() {
            share
        } else {
            0.0
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::imm::{Rotations, Translations};
    use super::super::testing::Gauss;
    use super::*;
    use dpm_common::so3::so3_exp;
    use glam::DQuat;

    const NOISE: f64 = 1e-4;

    /// A learner for 5 m/s^2 after 4 s of a swing of this amplitude (m) and angular frequency (rad/s), at 500 Hz.
    fn after_swing(amplitude: f64, w: f64) -> Learner<Translations> {
        let mut gauss = Gauss::new(3);
        let at = |i: i64| DVec3::X * amplitude * (w * i as f64 * 2e-3).sin();
        let mut learner = Learner::new(5.0, f64::INFINITY, 0, at(0), DVec3::splat(NOISE * NOISE));
        for i in 1..2000 {
            learner.advance(2e-3, None);
            learner.update(i * 2_000_000, at(i) + gauss.vector(NOISE), DVec3::splat(NOISE * NOISE));
        }
        learner
    }

    /// The jerk of a swing grows with the cube of its frequency, and the level with it.
    #[test]
    fn the_level_follows_the_motion() {
        let levels = [0.5, 3.0, 10.0, 30.0].map(|w| after_swing(0.1, w).level());
        assert!(levels.is_sorted() && levels[0] < 0 && levels[3] > 0, "{levels:?}");
    }

    /// A body at rest is where the samples' mean is: the bank's calm is not lost to a rung.
    #[test]
    fn a_body_at_rest_stays_calm() {
        let learner = after_swing(0.0, 1.0);
        let mean = learner.combined().mean;
        assert!(mean.point.length() < 0.5 * NOISE, "{mean:?}");
        assert!(learner.errors.share_of_rung(learner.best) < 0.5);
    }

    /// What is learned does not depend on where a rotation begins.
    #[test]
    fn rotations_are_learned_in_any_attitude() {
        let learned = |begin: DQuat| {
            let mut gauss = Gauss::new(3);
            let turn = |i: i64| so3_exp(DVec3::Y * (0.5 * (8.0 * i as f64 * 2e-3).sin()));
            let mut learner =
                Learner::<Rotations>::new(20.0, f64::INFINITY, 0, turn(0) * begin, DVec3::splat(1e-6));
            for i in 1..2000 {
                learner.advance(2e-3, None);
                learner.update(
                    i * 2_000_000,
                    so3_exp(gauss.vector(1e-3)) * turn(i) * begin,
                    DVec3::splat(1e-6),
                );
            }
            (learner.level(), learner.combined().mean.velocity)
        };
        let (level, velocity) = learned(DQuat::IDENTITY);
        let (other_level, other) = learned(DQuat::from_rotation_x(2.0));
        assert_eq!(level, other_level);
        assert!((velocity - other).length() < 1e-6, "{velocity} and {other}");
    }

    /// Before enough forecasts were judged, and where nothing can be compared, the bank alone predicts.
    #[test]
    fn the_bank_predicts_until_there_is_a_choice() {
        let mut learner = Learner::<Translations>::new(5.0, f64::INFINITY, 0, DVec3::ONE, DVec3::ZERO);
        for i in 1..i64::from(SETTLES) {
            assert_eq!(learner.combined(), learner.bank().combined());
            learner.advance(2e-3, None);
            learner.update(i * 2_000_000, DVec3::ONE, DVec3::ZERO);
        }
        assert_eq!(Errors { count: 1000, ..Errors::default() }.share_of_rung(0), 0.0, "0 / 0");
    }
}
