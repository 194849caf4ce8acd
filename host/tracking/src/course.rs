//! How a body goes on where light lies far ahead of its newest sample, learned from forecasts that failed.
//!
//! An estimated acceleration is noise beyond some 12 ms, so [`Motion::point_after`] lets it last no longer. That is right for a
//! body that jerks, and wrong for one that swings, behind a display of 60 frames a second: its acceleration lasts, and it is
//! pulled back the more the faster it goes away. So forecasts of [`AHEAD_NS`] are compared with what came. Kept is the least
//! squares of two shares, the old forecasts fading: how much of the acceleration lasts, and by how much of its velocity a body
//! is pulled back. What is learned is used as far as it would have made later forecasts better. It grows with the square and
//! the cube of the time: a few milliseconds ahead it does nothing.

use super::imm::{Motion, Translations, ACCELERATES_S};
use glam::DVec3;

/// Forecasts that are judged lie this far ahead, nanoseconds.
pub(crate) const AHEAD_NS: i64 = 40_000_000;
/// Beyond this time a motion is not extrapolated by its jerk any further, seconds.
const LONGEST_S: f64 = 0.06;
/// A forecast counts 1/e of a new one after this time, seconds.
const MEMORY_S: f64 = 0.6;
/// Samples between two that are kept: forecasts of a fast tracker need not be kept all.
const KEPT: usize = 12;
const STEP_NS: i64 = AHEAD_NS / (KEPT as i64 - 2);
/// Forecasts before anything is used.
const SETTLES: f64 = 16.0;
/// Errors this many times the tracker's noise are worth learning from.
const NOISE: f64 = 1.5;

/// What was expected at a sample.
#[derive(Clone, Copy, Debug)]
struct Forecast {
    at_ns: i64,
    motion: Motion<DVec3>,
    /// What was known then.
    shares: [f64; 2],
}

/// See the module's documentation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Course {
    kept: [Option<Forecast>; KEPT],
    next: usize,
    /// Normal equations: velocity by velocity, velocity by acceleration, acceleration by acceleration, and both by the error.
    sums: [f64; 5],
    /// Sums of squared errors, without and with what was known, and of the noise in them.
    errors: [f64; 3],
    weight: f64,
    judged_ns: i64,
}

impl Default for Course {
    fn default() -> Self {
        Self { kept: [None; KEPT], next: 0, sums: [0.0; 5], errors: [0.0; 3], weight: 0.0, judged_ns: 0 }
    }
}

/// How a motion goes on beyond [`Motion::point_after`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Continuation {
    /// The part of the acceleration that lasts, m/s^2.
    pub acceleration: DVec3,
    /// What the acceleration changes by, m/s^3.
    pub jerk: DVec3,
}

impl Continuation {
    /// Where it leads in `h` seconds.
    pub(crate) fn after(&self, h: f64) -> DVec3 {
        let [lasting, jerking] = reach(h);
        self.acceleration * lasting + self.jerk * jerking
    }
}

/// What an acceleration that lasts, and a jerk, of 1 do in `h` seconds beyond what is reckoned with.
fn reach(h: f64) -> [f64; 2] {
    let h = h.clamp(0.0, LONGEST_S);
    [0.5 * (h - ACCELERATES_S).max(0.0).powi(2), h * h * h / 6.0]
}

impl Course {
    /// Takes a sample at `at_ns` that was measured at `z` with variances `r` along the axes, and the filters' motion after it.
    pub(crate) fn take(&mut self, at_ns: i64, z: DVec3, r: DVec3, motion: Motion<DVec3>) {
        let due = self.kept.iter().flatten().filter(|e| at_ns - e.at_ns >= AHEAD_NS).max_by_key(|e| e.at_ns);
        if let Some(e) = due.copied().filter(|e| at_ns - e.at_ns < 2 * AHEAD_NS) {
            self.judge(&e, at_ns, z, r);
        }
        let newest = self.kept[(self.next + KEPT - 1) % KEPT];
        if newest.is_none_or(|e| at_ns - e.at_ns >= STEP_NS || at_ns < e.at_ns) {
            self.kept[self.next] = Some(Forecast { at_ns, motion, shares: self.shares() });
            self.next = (self.next + 1) % KEPT;
        }
    }

    fn judge(&mut self, e: &Forecast, at_ns: i64, z: DVec3, r: DVec3) {
        let h = (at_ns - e.at_ns) as f64 * 1e-9;
        // A camera sees depth badly: each axis counts by what is known of it.
        let least = r.min_element();
        let weight = r.map(|r| if r > 0.0 { (least / r).sqrt() } else { 1.0 });
        let off = z - e.motion.point_after::<Translations>(h);
        let off = off * weight;
        let [lasting, jerking] = reach(h);
        let by = [e.motion.velocity * weight * -jerking, e.motion.acceleration * weight * lasting];
        let fade = 1.0 / (1.0 + (at_ns - self.judged_ns).max(0) as f64 * 1e-9 / MEMORY_S);
        self.judged_ns = at_ns;
        let new = [by[0].dot(by[0]), by[0].dot(by[1]), by[1].dot(by[1]), by[0].dot(off), by[1].dot(off)];
        self.sums.iter_mut().zip(new).for_each(|(sum, new)| *sum = *sum * fade + new);
        let left = off - by[0] * e.shares[0] - by[1] * e.shares[1];
        let new = [off.length_squared(), left.length_squared(), 3.0 * least];
        self.errors.iter_mut().zip(new).for_each(|(sum, new)| *sum = *sum * fade + new);
        self.weight = self.weight * fade + 1.0;
    }

    /// The least squares: of the velocity, 1/s^2, and of the acceleration.
    fn shares(&self) -> [f64; 2] {
        let [vv, va, aa, ve, ae] = self.sums;
        // A ridge where one of both is not there.
        let (vv, aa) = (vv * 1.02 + 1e-18, aa * 1.02 + 1e-14);
        let determinant = vv * aa - va * va;
        if !(self.weight >= SETTLES && determinant > 0.0) {
            return [0.0; 2];
        }
        [(ve * aa - ae * va) / determinant, (ae * vv - ve * va) / determinant]
    }

    /// How a motion goes on.
    pub(crate) fn of(&self, motion: &Motion<DVec3>) -> Continuation {
        let [plain, with, noise] = self.errors;
        if !(self.weight >= 2.0 * SETTLES && plain > NOISE * noise) {
            return Continuation::default();
        }
        // As far as it made forecasts better that it had not seen.
        let used = (2.0 * (1.0 - with / plain)).clamp(0.0, 1.0);
        let [pull, lasts] = self.shares();
        let (acceleration, jerk) = (motion.acceleration * (lasts * used), motion.velocity * (-pull * used));
        if acceleration.is_finite() && jerk.is_finite() {
            Continuation { acceleration, jerk }
        } else {
            Continuation::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::Gauss;
    use super::super::{PoseFilter, PoseFilterConfig};
    use super::*;
    use dpm_device::pose::Pose;
    use dpm_device::time::HostTime;
    use dpm_device::tracker::{BodyIndex, TrackerSample};

    const STEP_NS: i64 = 8_333_333;

    /// Root mean square errors `ahead_ms` ahead of samples at 120 Hz with 0.1 mm of noise: by the filter, and without what this
    /// module learns, mm.
    fn errors(at: impl Fn(f64) -> DVec3, ahead_ms: i64) -> [f64; 2] {
        let config = PoseFilterConfig { lost_after_ns: 1_000_000_000, ..PoseFilterConfig::default() };
        let mut filter = PoseFilter::new(config.without_recall());
        let mut gauss = Gauss::new(5);
        let (mut sums, mut n) = ([0.0; 2], 0.0);
        for i in 0..2400i64 {
            let captured_at = HostTime(i * STEP_NS);
            let place = at(captured_at.0 as f64 * 1e-9) + gauss.vector(1e-4);
            filter.update(&TrackerSample {
                body: BodyIndex(0),
                pose: Pose { position_m: place.to_array(), ..Pose::IDENTITY },
                tracked: true,
                mean_error_m: 0.0,
                covariance: None,
                sequence: i as u32,
                captured_at,
                received_at: captured_at,
            });
            let light_at = captured_at.plus_ns(ahead_ms * 1_000_000);
            let (Some(state), truth) = (filter.state().filter(|_| i > 360), at(light_at.0 as f64 * 1e-9))
            else {
                continue;
            };
            let plain = super::super::TrackState { continuation: Continuation::default(), ..state };
            for (sum, state) in sums.iter_mut().zip([state, plain]) {
                let off = DVec3::from_array(state.predict(light_at).pose.position_m) - truth;
                *sum += off.length_squared();
            }
            n += 1.0;
        }
        sums.map(|sum| 1e3 * (sum / n).sqrt())
    }

    fn swing(w: f64) -> impl Fn(f64) -> DVec3 {
        move |t| DVec3::X * (0.5 / w * (w * t).sin())
    }

    /// A body that swings is met far ahead, where an acceleration that ends after some milliseconds misses it.
    #[test]
    fn what_swings_is_met_far_ahead() {
        for (ahead_ms, w, most) in [(30, 10.0, 0.4), (40, 10.0, 0.4), (50, 10.0, 0.4), (40, 5.0, 0.75)] {
            let [learned, plain] = errors(swing(w), ahead_ms);
            assert!(learned < most * plain, "{ahead_ms} ms, {w} rad/s: {learned} of {plain} mm");
        }
    }

    /// Light of a fast projector lies a few milliseconds ahead, and nothing changes there.
    #[test]
    fn a_few_milliseconds_ahead_nothing_changes() {
        let [learned, plain] = errors(swing(10.0), 5);
        assert!((learned / plain - 1.0).abs() < 0.02, "{learned} {plain}");
    }

    /// Waves that repeat nothing, rest, steady motion and sudden turns are not made worse.
    #[test]
    fn no_motion_is_made_worse() {
        let waves = |t: f64| {
            let wave = |f: f64, phase: f64| 0.03 / f * (f * 7.0 * t + phase).sin();
            DVec3::new(wave(0.7, 0.0) + wave(1.3, 1.0), wave(1.0, 2.0) + wave(1.9, 0.5), 0.0)
        };
        let turns = |t: f64| {
            // Straight stretches of 0.5 m/s for 0.4 s, and turns of 5 m/s2 between them.
            let (period, turn) = (1.2, 0.2);
            let u = t.rem_euclid(period);
            let run = |u: f64| {
                if u < 0.4 {
                    0.5 * u
                } else {
                    let s = (u - 0.4).min(turn);
                    0.2 + 0.5 * s - 2.5 * s * s
                }
            };
            DVec3::X * if u < 0.6 { run(u) } else { 0.2 - run(u - 0.6) }
        };
        let motions: [(&str, &dyn Fn(f64) -> DVec3); 4] = [
            ("waves", &waves),
            ("turns", &turns),
            ("rest", &|_| DVec3::ZERO),
            ("steady", &|t| DVec3::new(0.5, 0.2, 0.0) * t),
        ];
        for (name, motion) in motions {
            for ahead_ms in [20, 40, 60, 200] {
                let [learned, plain] = errors(motion, ahead_ms);
                assert!(learned <= 1.05 * plain, "{name}, {ahead_ms} ms: {learned} of {plain} mm");
            }
        }
    }
}
