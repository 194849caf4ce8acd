//! Estimates position, velocity and acceleration at an instant from the noisy points around it, without blurring the
//! instants at which the acceleration jumps.
//!
//! A least-squares parabola is the more precise the more samples it has, as long as they lie on one parabola. So
//! several windows are tried, from the most precise to the one with the fewest assumptions: around the instant, and on
//! one side of it only, for instants just before or after a jump. Along each axis the first window is used whose
//! residuals are no larger than the noise.

use super::imm::Chart;
use glam::{DMat3, DVec3};
use std::ops::Range;

/// Reach of a point's windows on either side, ns.
pub(crate) const MARGIN_NS: i64 = 80_000_000;

/// Time before and after the instant, ms.
const WINDOWS_MS: [[f64; 2]; 9] = [
    [40.0, 40.0],
    [24.0, 24.0],
    [80.0, 0.0],
    [0.0, 80.0],
    [60.0, 4.0],
    [4.0, 60.0],
    [40.0, 0.0],
    [0.0, 40.0],
    [10.0, 10.0],
];

/// Most samples within the margins on both sides; more make no point.
const MOST_SAMPLES: usize = 192;
/// Least number of samples in a window.
const LEAST_SAMPLES: usize = 6;
/// Least number of samples within the margins on both sides. With fewer, turns fall between them: trackers under 150
/// Hz.
const LEAST_AROUND: usize = 24;

/// Residuals that exceed those of the noise by this many standard deviations are not noise.
const EXCESS: f64 = 2.0;

/// A motion at one instant.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SmoothMotion<P> {
    /// Position or rotation.
    pub point: P,
    /// Per second, world frame.
    pub velocity: DVec3,
    /// Per second squared, world frame.
    pub acceleration: DVec3,
    /// Standard deviation of the acceleration along each axis.
    pub acceleration_sigma: DVec3,
    /// Whether the residuals of any window were noise; if not, the motion is bent too sharply for the tracker's rate.
    pub fits: [bool; 3],
}

/// The motion at sample `middle` of `samples` (in order of time, capture in ns and point) of `sigma` standard deviation
/// per axis, and its capture. `None` if there are too few samples, or if a rotation is so fast that its tangents do not
/// behave like vectors.
pub(crate) fn smoothed<C: Chart>(
    samples: &[Option<(i64, C::Point)>],
    middle: usize,
    sigma: f64,
) -> Option<(i64, SmoothMotion<C::Point>)> {
    let (at_ns, origin) = (*samples.get(middle)?)?;
    let is_around =
        |sample: &Option<(i64, C::Point)>| sample.is_some_and(|(t, _)| t.abs_diff(at_ns) <= MARGIN_NS as u64);
    let first = samples.iter().position(is_around)?;
    let after =
        samples[first..].iter().position(|sample| !is_around(sample)).unwrap_or(samples.len() - first);
    let mut tangents = Tangents::<C>::at(at_ns, origin, &samples[first..first + after])?;
    let mut chosen: [Option<Parabola>; 3] = [None; 3];
    let mut least: [Option<(f64, Parabola)>; 3] = [None; 3];
    for [before, after] in WINDOWS_MS {
        let Some((parabola, n)) = Parabola::through(tangents.between(-before, after)) else { continue };
        let freedom = n as f64 - 3.0;
        for axis in 0..3 {
            let ratio = parabola.residual[axis] / (freedom * sigma * sigma);
            let excess = (ratio - 1.0) * (0.5 * freedom).sqrt();
            if excess < EXCESS && chosen[axis].is_none() {
                chosen[axis] = Some(parabola);
            }
            if least[axis].is_none_or(|(smallest, _)| excess < smallest) {
                least[axis] = Some((excess, parabola));
            }
        }
        if chosen.iter().all(Option::is_some) {
            break;
        }
    }
    let [x, y, z] = [0, 1, 2].map(|axis| chosen[axis].or(least[axis].map(|(_, p)| p)));
    let axes = [x?, y?, z?];
    let pick = |k: usize| DVec3::new(axes[0].terms[k].x, axes[1].terms[k].y, axes[2].terms[k].z);
    let variance = DVec3::from_array(axes.map(|p| p.curvature_variance));
    let motion = SmoothMotion {
        point: C::moved(origin, pick(0)),
        velocity: pick(1) * 1e3,
        acceleration: pick(2) * 2e6,
        acceleration_sigma: variance.map(f64::sqrt) * (2e6 * sigma),
        fits: chosen.map(|p| p.is_some()),
    };
    Some((at_ns, motion))
}

/// The samples around an instant as tangents at the point of that instant. Each is taken once for all windows, and only if a
/// window needs it.
struct Tangents<'a, C: Chart> {
    samples: &'a [Option<(i64, C::Point)>],
    origin: C::Point,
    /// Milliseconds from the instant, so that fourth powers stay small, and tangents.
    all: [(f64, DVec3); MOST_SAMPLES],
    /// The tangents that have been taken.
    taken: Range<usize>,
}

impl<'a, C: Chart> Tangents<'a, C> {
    /// `None` if there are too few samples or too many, or if they are so far apart that their tangents are no vectors.
    fn at(at_ns: i64, origin: C::Point, samples: &'a [Option<(i64, C::Point)>]) -> Option<Self> {
        if samples.len() < LEAST_AROUND {
            return None;
        }
        let mut all = [(0.0, DVec3::ZERO); MOST_SAMPLES];
        for (k, (t, z)) in samples.iter().flatten().enumerate() {
            if !C::is_flat(origin, *z) {
                return None;
            }
            all.get_mut(k)?.0 = t.saturating_sub(at_ns) as f64 * 1e-6;
        }
        let middle = all[..samples.len()].partition_point(|(t, _)| *t < 0.0);
        Some(Self { samples, origin, all, taken: middle..middle })
    }

    /// Those of a window around the instant, ms.
    fn between(&mut self, from: f64, to: f64) -> &[(f64, DVec3)] {
        let times = &self.all[..self.samples.len()];
        let begin = times.partition_point(|(t, _)| *t < from);
        let end = times.partition_point(|(t, _)| *t <= to);
        let Range { start: before, end: after } = self.taken.clone();
        for k in (begin..before).chain(after..end) {
            if let Some((_, z)) = self.samples[k] {
                self.all[k].1 = C::between(self.origin, z);
            }
        }
        self.taken = begin.min(before)..end.max(after);
        &self.all[begin..end]
    }
}

/// A least-squares parabola along each axis.
#[derive(Clone, Copy, Debug)]
struct Parabola {
    /// Factors of 1, t and t^2.
    terms: [DVec3; 3],
    /// Sum of the squared residuals.
    residual: DVec3,
    /// Variance of the last factor for samples of variance 1.
    curvature_variance: f64,
}

impl Parabola {
    /// The parabola through the points (t, y), and their number.
    fn through(points: &[(f64, DVec3)]) -> Option<(Self, usize)> {
        let n = points.len();
        let (mut s, mut d, mut total) = ([0.0; 5], [DVec3::ZERO; 3], DVec3::ZERO);
        for &(t, y) in points {
            total += y * y;
            let mut power = 1.0;
            for (k, s) in s.iter_mut().enumerate() {
                *s += power;
                if let Some(d) = d.get_mut(k) {
                    *d += y * power;
                }
                power *= t;
            }
        }
        let inverse =
            DMat3::from_cols_array(&[s[0], s[1], s[2], s[1], s[2], s[3], s[2], s[3], s[4]]).inverse();
        if n < LEAST_SAMPLES || !inverse.is_finite() {
            return None;
        }
        let terms = [0, 1, 2].map(|k| {
            let r = inverse.row(k);
            d[0] * r.x + d[1] * r.y + d[2] * r.z
        });
        // For samples without noise, rounding can make this slightly negative.
        let residual = (total - terms[0] * d[0] - terms[1] * d[1] - terms[2] * d[2]).max(DVec3::ZERO);
        Some((Self { terms, residual, curvature_variance: inverse.z_axis.z.max(0.0) }, n))
    }
}

#[cfg(test)]
mod tests {
    use super::super::imm::{Rotations, Translations};
    use super::super::testing::Gauss;
    use super::*;
    use dpm_common::so3::{so3_between, so3_exp};

    const MIDDLE: usize = 48;

    /// 97 samples around 0 whose stamps are up to 0.8 ms off the 500 Hz grid.
    fn sampled<P>(path: impl Fn(f64) -> P) -> Vec<Option<(i64, P)>> {
        (0..97i64)
            .map(|i| {
                let at_ns =
                    (i - MIDDLE as i64) * 2_000_000 + if i == MIDDLE as i64 { 0 } else { i * 7919 % 800_000 };
                Some((at_ns, path(at_ns as f64 * 1e-9)))
            })
            .collect()
    }

    #[test]
    fn a_parabola_is_exact_and_a_steady_rotation_too() {
        let (v, a) = (DVec3::new(1.0, -2.0, 0.5), DVec3::new(-5.0, 20.0, 0.0));
        let samples = sampled(|t| DVec3::ONE + v * t + a * (0.5 * t * t));
        let (at, s) = smoothed::<Translations>(&samples, MIDDLE, 1e-6).unwrap();
        assert_eq!(at, 0);
        assert!((s.point - DVec3::ONE).length() < 1e-12);
        assert!((s.velocity - v).length() < 1e-10 && (s.acceleration - a).length() < 1e-8, "{s:?}");
        let w = DVec3::new(0.0, 3.0, -1.0);
        let start = so3_exp(DVec3::new(0.3, 0.0, 2.0));
        let samples = sampled(|t| so3_exp(w * t) * start);
        let (_, s) = smoothed::<Rotations>(&samples, MIDDLE, 1e-6).unwrap();
        assert!(so3_between(start, s.point).length() < 1e-12);
        assert!((s.velocity - w).length() < 1e-10 && s.acceleration.length() < 1e-8, "{s:?}");
    }

    /// Over many draws the errors are as large as stated: that of the acceleration is compared with
    /// `acceleration_sigma`, which for the widest window is that of a parabola through n equidistant samples, sqrt(720
    /// / n^5) / dt^2.
    #[test]
    fn the_error_of_an_acceleration_is_known() {
        let (sigma, mut gauss, mut sum) = (1e-4, Gauss::new(4), 0.0);
        for _ in 0..400 {
            let noise: Vec<DVec3> = (0..97).map(|_| gauss.vector(sigma)).collect();
            let samples: Vec<_> = (0..97).map(|i| Some(((i as i64 - 48) * 2_000_000, noise[i]))).collect();
            let (_, s) = smoothed::<Translations>(&samples, MIDDLE, sigma).unwrap();
            sum += (s.acceleration / s.acceleration_sigma).length_squared() / 1200.0;
            let widest = (720.0 / 41f64.powi(5)).sqrt() / 4e-6 * sigma;
            assert!(s.acceleration_sigma.min_element() >= 0.99 * widest);
        }
        assert!((0.8..1.3).contains(&sum), "{sum}");
    }

    /// Up to a millisecond beside a jump of 5 m/s^2 the acceleration is closer to that of its own side than to that of
    /// the other: one wide window would need 20 ms for that.
    #[test]
    fn a_jump_stays_where_it_is() {
        for offset_ms in [-30.0, -12.0, 12.0, 30.0] {
            let jump = -1e-3 * offset_ms;
            let path = |t: f64| DVec3::X * (0.5 * t - 2.5 * (t - jump).max(0.0).powi(2));
            let mut gauss = Gauss::new(8);
            let mut mean = 0.0;
            for _ in 0..50 {
                let samples = sampled(path);
                let noisy: Vec<_> = samples
                    .iter()
                    .map(|s| s.map(|(t, p): (i64, DVec3)| (t, p + gauss.vector(1e-4))))
                    .collect();
                let (_, s) = smoothed::<Translations>(&noisy, MIDDLE, 1e-4).unwrap();
                mean += s.acceleration.x / 50.0;
            }
            let truth = if offset_ms > 0.0 { -5.0 } else { 0.0 };
            assert!((mean - truth).abs() < 1.5, "{mean} instead of {truth}, {offset_ms} ms beside the jump");
        }
    }

    #[test]
    fn too_few_samples_make_no_point() {
        let mut samples = sampled(|t| DVec3::X * t);
        for (i, s) in samples.iter_mut().enumerate() {
            if i.abs_diff(MIDDLE) > 2 {
                *s = None;
            }
        }
        assert!(smoothed::<Translations>(&samples, MIDDLE, 1e-4).is_none());
        assert!(smoothed::<Translations>(&samples, 0, 1e-4).is_none());
        assert!(smoothed::<Translations>(&samples, 97, 1e-4).is_none());
        let fast = sampled(|t| so3_exp(DVec3::Y * (100.0 * t)));
        assert!(smoothed::<Rotations>(&fast, MIDDLE, 1e-4).is_none());
    }
}
