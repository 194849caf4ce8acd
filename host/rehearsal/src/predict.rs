//! A closed form of registration: noise, rates and delays into millimetres, without a run.
//!
//! A filter of constant acceleration, driven by white jerk, has gains that no longer change after a while. So it is a linear
//! filter: noise passes it with a gain, and a swing of a frequency comes out with another amplitude and phase. Its extrapolation
//! to the light is compared with the swing there: velocity, an acceleration that lasts for some milliseconds, and of the rest
//! of it and of a pull by the velocity the shares that serve best 40 ms ahead. Of the ladder of such filters that one counts
//! whose forecast of the next sample errs least, as in `dpm-tracking`. Turns that begin at once surprise every filter: light
//! is off by what the acceleration does from the turn to the first light that can follow.

use super::stage::{RehearsalCase, RehearsalStage};
use dpm_rig::config::RehearsedMotion;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DMat3, DVec3};

/// Density of the jerk of the middle rung for 1 m/s2, and the rungs on both sides of it, each of four times the noise.
const JERK: f64 = 8.0;
const RUNGS: i32 = 9;
/// Steps after which gains no longer change.
const STEPS: usize = 400;
/// For how long an acceleration lasts by itself, how far ahead shares are learned, and the longest time of either, seconds.
const LASTS_S: f64 = 0.012;
const LEARNED_S: f64 = 0.042;
const LONGEST_S: f64 = 0.06;
/// Instants of a sample's age that are told apart.
const AGES: i32 = 6;
/// A body whose orientation rests: what the filters leave of the noise of rotations.
const REST_OF_TURNS: f64 = 0.35;
/// 99th percentile of a distance in a plane by the standard deviation along an axis; and of what is drawn once for each run, of
/// which there are few.
const P99_BY_SIGMA: f64 = 3.035;
const P99_OF_FEW: f64 = 2.4;
/// Mean of an error over a raster by its 99th percentile, along one axis.
const AXIS_BY_P99: f64 = 0.35;
/// 99th percentile by the root of the mean square: of a swing on a line, and of a hand.
const P99_OF_SWING: f64 = std::f64::consts::SQRT_2;
const P99_OF_HAND: f64 = 2.2;
/// The models of the bank expect an acceleration of the settings, doubled as often as need be. A swing below this share of it is
/// taken for coasting now and then, which costs this share of what such an acceleration does. Both were found in runs.
const CLEAR: f64 = 0.9;
const HESITATES: f64 = 0.28;
/// Frequencies of a hand, as drawn.
const HAND: [f64; 5] = [0.34, 0.63, 0.93, 1.22, 1.46];

/// A steady filter: gains of position, velocity and acceleration at every sample.
#[derive(Clone, Copy, Debug)]
struct SteadyFilter {
    gains: DVec3,
    step_s: f64,
}

impl SteadyFilter {
    /// For samples every `step_s` seconds, noise of variance `r`, and white jerk of density `q`.
    fn new(step_s: f64, r: f64, q: f64) -> Self {
        let f = transition(step_s);
        let h = step_s;
        let noise = DMat3::from_cols(
            DVec3::new(h.powi(5) / 20.0, h.powi(4) / 8.0, h.powi(3) / 6.0),
            DVec3::new(h.powi(4) / 8.0, h.powi(3) / 3.0, h * h / 2.0),
            DVec3::new(h.powi(3) / 6.0, h * h / 2.0, h),
        ) * q;
        let mut p = DMat3::from_diagonal(DVec3::new(r, 1.0, 100.0));
        let mut gains = DVec3::ZERO;
        for _ in 0..STEPS {
            p = f * p * f.transpose() + noise;
            gains = p.x_axis / (p.x_axis.x + r);
            let keep = DMat3::IDENTITY - DMat3::from_cols(gains, DVec3::ZERO, DVec3::ZERO);
            // Joseph's form keeps it a covariance.
            let by_noise = DMat3::from_cols(gains * gains.x, gains * gains.y, gains * gains.z) * r;
            p = keep * p * keep.transpose() + by_noise;
        }
        Self { gains, step_s }
    }

    /// From one state to the next, without the measurement.
    fn kept(&self) -> DMat3 {
        let keep = DMat3::IDENTITY - DMat3::from_cols(self.gains, DVec3::ZERO, DVec3::ZERO);
        keep * transition(self.step_s)
    }

    /// Covariance of the state that noise of variance 1 makes.
    fn noise(&self) -> DMat3 {
        let (kept, g) = (self.kept(), self.gains);
        let driven = DMat3::from_cols(g * g.x, g * g.y, g * g.z);
        let mut p = driven;
        for _ in 0..STEPS {
            p = kept * p * kept.transpose() + driven;
        }
        p
    }

    /// The state that follows a swing of amplitude 1 and `w` rad/s: its parts in phase with cosine and sine.
    fn answer(&self, w: f64) -> [DVec3; 2] {
        // x = kept e^{-jw step} x + gains: with x = a + j b, two equations of reals.
        let (cos, sin) = ((w * self.step_s).cos(), (w * self.step_s).sin());
        let kept = self.kept();
        let (re, im) = (DMat3::IDENTITY - kept * cos, kept * sin);
        // (re + j im)(a + j b) = gains: a = (re + im re^-1 im)^-1 gains, b = -re^-1 im a.
        let inverse = re.inverse();
        let a = (re + im * inverse * im).inverse() * self.gains;
        [a, -(inverse * (im * a))]
    }
}

/// What a forecast `h` seconds ahead makes of position, velocity and acceleration, with `shares` of the pull by the velocity and
/// of the acceleration that lasts.
fn forecast(h: f64, shares: [f64; 2]) -> DVec3 {
    let [pull, lasts] = reach(h);
    let accelerated = h.min(LASTS_S);
    let by_acceleration = accelerated * (h - 0.5 * accelerated);
    DVec3::new(1.0, h - shares[0] * pull, by_acceleration + shares[1] * lasts)
}

/// What pull and acceleration of share 1 do `h` seconds ahead.
fn reach(h: f64) -> [f64; 2] {
    let h = h.min(LONGEST_S);
    [h.powi(3) / 6.0, 0.5 * (h - LASTS_S).max(0.0).powi(2)]
}

/// A filter and the motion that it follows.
struct MotionFollower {
    noise: DMat3,
    /// Of each swing: mean square amplitude, frequency, and the filter's answer.
    swings: Vec<(f64, f64, [DVec3; 2])>,
}

impl MotionFollower {
    fn new(filter: &SteadyFilter, swings: &[[f64; 2]]) -> Self {
        let answered = |[w, power]: &[f64; 2]| (*power, *w, filter.answer(*w));
        Self { noise: filter.noise(), swings: swings.iter().map(answered).collect() }
    }

    /// Mean square of the motion's part of the error `h` seconds ahead, m2, and the gain of noise.
    fn error(&self, h: f64, shares: [f64; 2]) -> [f64; 2] {
        let by = forecast(h, shares);
        let off = |(power, w, [a, b]): &(f64, f64, [DVec3; 2])| {
            power * ((by.dot(*a) - (w * h).cos()).powi(2) + (by.dot(*b) - (w * h).sin()).powi(2))
        };
        [self.swings.iter().map(off).sum(), by.dot(self.noise * by)]
    }

    /// The shares that err least where they are learned, for noise of variance `r` over all axes.
    fn shares(&self, r: f64) -> [f64; 2] {
        let of = |shares| {
            let [motion, gain] = self.error(LEARNED_S, shares);
            motion + r * gain
        };
        // A quadratic form: six values give it, at steps that move the forecast by as much.
        let step = reach(LEARNED_S).map(|reach| 1e-3 / reach);
        let at = |i: f64, j: f64| of([i * step[0], j * step[1]]);
        let (none, a, b) = (at(0.0, 0.0), [at(1.0, 0.0), at(-1.0, 0.0)], [at(0.0, 1.0), at(0.0, -1.0)]);
        let (ga, gb) = (0.5 * (a[0] - a[1]), 0.5 * (b[0] - b[1]));
        let (aa, bb) = (a[0] + a[1] - 2.0 * none, b[0] + b[1] - 2.0 * none);
        let ab = at(1.0, 1.0) - a[0] - b[0] + none;
        let determinant = aa * bb - ab * ab;
        if determinant.is_nan() || determinant <= 1e-9 * aa * bb {
            return [0.0; 2];
        }
        [(ab * gb - bb * ga) / determinant * step[0], (ab * ga - aa * gb) / determinant * step[1]]
    }
}

fn transition(h: f64) -> DMat3 {
    DMat3::from_cols(DVec3::X, DVec3::new(h, 1.0, 0.0), DVec3::new(0.5 * h * h, h, 1.0))
}

/// Noise of a sample where the light falls, along an axis of the picture, and along an axis in space on average, metres.
struct SampleNoise {
    across: f64,
    turns: f64,
    mean: f64,
}

/// The 99th percentile of registration to be expected of `case`, millimetres.
pub(super) fn p99_mm(stage: &RehearsalStage, case: &RehearsalCase) -> f64 {
    let rehearsal = &case.config.rehearsal;
    let noise = noise_of(stage, case);
    let step_s = 1.0 / f64::from(case.rate_hz.max(1));
    let (speed, acceleration) = (rehearsal.speed_m_s, rehearsal.acceleration_m_s2);
    let first_s = 1e-9 * (stage.delivery_ns(case) + stage.latch_to_light_ns(case)) as f64;
    let w = acceleration / speed;
    // Frequencies and mean square amplitudes.
    let swings: Vec<[f64; 2]> = match rehearsal.motion {
        RehearsedMotion::Hand => {
            let share = speed / (HAND.len() as f64).sqrt();
            HAND.map(|by| [w * by, 0.5 * (share / (w * by)).powi(2)]).to_vec()
        }
        _ => vec![[w, 0.5 * (speed / w).powi(2)]],
    };
    let r = noise.mean.powi(2).max(1e-14);
    let expected = case.config.prediction.acceleration;
    let rung =
        |i: i32| SteadyFilter::new(step_s, r, JERK * (expected * f64::from(i - RUNGS / 2).exp2()).powi(2));
    let followers = (0..RUNGS).map(|i| MotionFollower::new(&rung(i), &swings));
    let judged_s = step_s * (4e-3 / step_s).ceil().max(1.0);
    let judged = |follower: &MotionFollower| {
        let [motion, gain] = follower.error(judged_s, [0.0; 2]);
        motion + 3.0 * r * gain
    };
    let best = followers.min_by(|a, b| judged(a).total_cmp(&judged(b)));
    let Some(best) = best else { return f64::NAN };
    let shares = best.shares(3.0 * noise.across.powi(2));
    let (mut motion, mut gain) = (0.0, 0.0);
    for i in 0..AGES {
        let h = first_s + step_s * (f64::from(i) + 0.5) / f64::from(AGES);
        let [moved, noisy] = best.error(h, shares);
        motion += moved / f64::from(AGES);
        gain += noisy / f64::from(AGES);
    }
    let of_motion = match rehearsal.motion {
        RehearsedMotion::Swing => {
            let steps = (acceleration / expected).log2().ceil().max(0.0);
            let scale = expected * steps.exp2();
            let hesitates =
                if acceleration < CLEAR * scale { (HESITATES * scale).min(acceleration) } else { 0.0 };
            let h = first_s + 0.5 * step_s;
            (P99_OF_SWING * motion.sqrt()).hypot(0.5 * hesitates * h * h)
        }
        RehearsedMotion::Hand => P99_OF_HAND * motion.sqrt(),
        RehearsedMotion::Turns => 0.5 * acceleration * (first_s + 1.5 * step_s).powi(2),
    };
    let across = noise.across.powi(2) * gain + (REST_OF_TURNS * noise.turns).powi(2);
    let drawn = P99_OF_FEW.powi(2) * fixed(stage, case);
    1e3 * (of_motion.powi(2) + P99_BY_SIGMA.powi(2) * across + drawn).sqrt()
}

/// Variance along an axis of what does not change in a run: calibrations, places of meshes, and time that is not known; m2.
fn fixed(stage: &RehearsalStage, case: &RehearsalCase) -> f64 {
    let rehearsal = &case.config.rehearsal;
    let at = |px: f64, distance: f64, f: f64| (AXIS_BY_P99 * px * distance / f).powi(2);
    let projector = at(rehearsal.projector_px, stage.distance, stage.projector.fx);
    let camera =
        stage.camera.as_ref().map_or(0.0, |(eye, _)| at(rehearsal.camera_px, stage.camera_distance, eye.fx));
    // Half of a motion's power is along each axis.
    let late = (1e-6 * rehearsal.late_us * rehearsal.speed_m_s).powi(2) / 4.0;
    projector + camera + late + rehearsal.body_m.powi(2)
}

fn noise_of(stage: &RehearsalStage, case: &RehearsalCase) -> SampleNoise {
    let arm = stage.points.iter().flatten().map(|p| p.length_squared()).sum::<f64>();
    let arm = (arm / stage.points.iter().map(Vec::len).sum::<usize>().max(1) as f64).sqrt();
    let Some((eye, markings)) = &stage.camera else {
        let errors = RehearsalStage::errors(case);
        let turns = errors.rotation_rad * arm * (2.0f64 / 3.0).sqrt();
        return SampleNoise { across: errors.position_m, turns, mean: errors.position_m };
    };
    // The points of a body lie about their middle; n of them are seen.
    let rehearsal = &case.config.rehearsal;
    let metres = rehearsal.corner_px * stage.camera_distance / eye.fx;
    let seen = markings.iter().zip(&stage.seen).filter(|(_, seen)| **seen);
    let (mut count, mut spread, mut bodies) = (0.0, 0.0, 0.0);
    for (marks, _) in seen {
        let corners = marks.tags.iter().flat_map(|t| t.corners());
        let all: Vec<DVec3> = corners.chain(marks.markers.iter().copied()).collect();
        let middle = all.iter().sum::<DVec3>() / all.len().max(1) as f64;
        spread += all.iter().map(|p| (*p - middle).length_squared()).sum::<f64>() / all.len().max(1) as f64;
        count += all.len() as f64;
        bodies += 1.0;
    }
    let (count, spread) = (count / f64::max(bodies, 1.0), (spread / f64::max(bodies, 1.0)).sqrt());
    let across = metres / count.max(1.0).sqrt();
    // Depth is known by the size of what is seen.
    let depth = across * stage.camera_distance / spread.max(1e-3);
    let turn = across / spread.max(1e-3) * 2.0;
    let mean = ((2.0 * across * across + depth * depth) / 3.0).sqrt();
    // The projector sees of the depth what its place beside the camera shows, on one axis of two.
    let towards = |eye: &ProjectorCamera| (stage.middle - eye.position()).normalize_or_zero();
    let beside = towards(eye).cross(towards(&stage.projector)).length();
    let across = (across * across + 0.5 * (depth * beside).powi(2)).sqrt();
    SampleNoise { across, turns: turn * arm, mean }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The gains of a run of the filter on samples are those of the closed form.
    #[test]
    fn a_steady_filter_answers_as_a_run_of_it_does() {
        let (step, w, h) = (1.0 / 120.0, 10.0, 0.04);
        let filter = SteadyFilter::new(step, 1e-8, 8.0 * 25.0);
        let (mut x, mut worst, mut squares, mut n) = (DVec3::ZERO, 0.0f64, 0.0, 0.0);
        for i in 0..4000 {
            let t = f64::from(i) * step;
            x = transition(step) * x;
            x += filter.gains * ((w * t).sin() - x.x);
            let off = forecast(h, [30.0, 0.7]).dot(x) - (w * (t + h)).sin();
            if i > 1000 {
                worst = worst.max(off.abs());
                squares += off * off;
                n += 1.0;
            }
        }
        let swings = [[w, 0.5]];
        let [mean, _] = MotionFollower::new(&filter, &swings).error(h, [30.0, 0.7]);
        let amplitude = (2.0 * mean).sqrt();
        assert!((worst / amplitude - 1.0).abs() < 0.02, "{worst} {amplitude}");
        assert!(((squares / n) / (0.5 * amplitude * amplitude) - 1.0).abs() < 0.02);
    }

    /// The gain of noise is that of a run on noise alone.
    #[test]
    fn noise_passes_as_in_a_run() {
        use dpm_device::rng::Draws;
        let (step, h) = (1.0 / 120.0, 0.03);
        let filter = SteadyFilter::new(step, 1e-8, 8.0 * 25.0);
        let draws = Draws::new(7);
        let (mut x, mut squares) = (DVec3::ZERO, 0.0);
        let n = 40_000;
        for i in 0..n {
            x = transition(step) * x;
            x += filter.gains * (draws.normal(i) - x.x);
            squares += forecast(h, [0.0; 2]).dot(x).powi(2);
        }
        let [_, gain] = MotionFollower::new(&filter, &[]).error(h, [0.0; 2]);
        let ratio = squares / n as f64 / gain;
        assert!((ratio - 1.0).abs() < 0.05, "{ratio}");
    }

    /// The shares that are computed are better than any near them.
    #[test]
    fn shares_err_least() {
        let filter = SteadyFilter::new(1.0 / 120.0, 1e-8, 8.0 * 25.0);
        let follower = MotionFollower::new(&filter, &[[10.0, 1e-3], [6.0, 4e-4]]);
        let of = |shares| {
            let [motion, gain] = follower.error(LEARNED_S, shares);
            motion + 3e-8 * gain
        };
        let [pull, lasts] = follower.shares(3e-8);
        for (i, j) in [(1.01, 1.0), (0.99, 1.0), (1.0, 1.01), (1.0, 0.99), (0.0, 0.0)] {
            assert!(of([pull, lasts]) < of([pull * i, lasts * j]), "{pull} {lasts}, {i} {j}");
        }
    }
}
