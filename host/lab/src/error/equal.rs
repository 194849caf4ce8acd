//! With how many samples a method takes as many rays, or as much time, as another: what trials tell of it.

use super::plan::paper_at;
use dpm_render::method::Method;

/// A method whose samples go by the visual angle has them in its table; the others are told them frame by frame.
pub(super) fn with_samples(method: &Method, spp: f32) -> Method {
    if method.spp_by_angle {
        paper_at(method, f64::from(spp))
    } else {
        method.clone()
    }
}

/// Samples that were tried, and the time of a frame with them by the time that is wanted.
pub(super) type Trial = (f64, f64);

/// How far a trial is from equal time, as a logarithm.
pub(super) fn off_equal(trial: Trial) -> f64 {
    trial.1.ln().abs()
}

/// The trial nearest to equal time.
pub(super) fn nearest(trials: &[Trial]) -> Trial {
    trials.iter().copied().min_by(|a, b| off_equal(*a).total_cmp(&off_equal(*b))).unwrap_or((1.0, 1.0))
}

/// Samples with which the time is the one wanted: where a line through the trials is 1. A frame without samples takes time, and samples
/// take more; where the trials say otherwise they are mostly chance, and time is taken to grow with the samples alone.
pub(super) fn where_equal(trials: &[Trial]) -> f64 {
    let n = trials.len() as f64;
    let sum = |of: &dyn Fn(f64, f64) -> f64| trials.iter().map(|&(x, y)| of(x, y)).sum::<f64>();
    let (x, y) = (sum(&|x, _| x) / n, sum(&|_, y| y) / n);
    let (xx, xy) = (sum(&|a, _| (a - x) * (a - x)), sum(&|a, b| (a - x) * (b - y)));
    let slope = xy / xx;
    let base = y - slope * x;
    if slope > 0.0 && (0.0..1.0).contains(&base) {
        return (1.0 - base) / slope;
    }
    x / y
}

/// A method that keeps nothing shows a pixel without samples black: it takes at least one. With a history a frame may pass.
pub(super) fn least_spp(method: &Method) -> f32 {
    if method.needs_history() {
        0.02
    } else {
        1.0
    }
}

/// Samples for `wanted` rays when `base` are fixed and `spp` samples gave `rays`.
pub(super) fn corrected(spp: f32, base: f64, rays: f64, wanted: f64) -> f32 {
    let slope = (rays - base) / f64::from(spp);
    if slope > 0.0 {
        ((wanted - base) / slope).max(0.02) as f32
    } else {
        spp
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_samples_that_fill_a_time_are_where_the_line_of_the_trials_meets_it() {
        // 0.2 of the time without a sample, 0.1 a sample.
        let of =
            |all: &[f64]| where_equal(&all.iter().map(|spp| (*spp, 0.2 + 0.1 * spp)).collect::<Vec<_>>());
        assert!((of(&[2.0, 5.0]) - 8.0).abs() < 1e-12);
        assert!((of(&[10.0, 9.0, 1.0]) - 8.0).abs() < 1e-12);
        // One trial, or trials that are chance: never the samples that were there before, which would flatter the slower method.
        assert!((where_equal(&[(2.0, 0.5)]) - 4.0).abs() < 1e-12);
        assert!((where_equal(&[(2.0, 0.5), (4.0, 0.4)]) - 3.0 / 0.45).abs() < 1e-12);
        assert!((where_equal(&[(2.0, 0.1), (4.0, 0.5)]) - 3.0 / 0.3).abs() < 1e-12);
        assert_eq!(nearest(&[(2.0, 0.5), (3.0, 1.1), (9.0, 4.0)]), (3.0, 1.1));
    }
}
