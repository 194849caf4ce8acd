//! With how many samples a method takes as many rays, or as much time, as another: what trials tell of it.

use super::plan::paper_at;
use crate::sequence::{FrameTime, Theatre};
use dpm_render::method::Method;
use dpm_render::RenderError;

/// A method whose samples go by the visual angle has them in its table; the others are told them frame by frame.
pub(crate) fn with_samples(method: &Method, spp: f32) -> Method {
    if method.spp_by_angle {
        paper_at(method, f64::from(spp))
    } else {
        method.clone()
    }
}

/// Samples that were tried, and the time of a frame with them by the time that is wanted.
pub(crate) type Trial = (f64, f64);

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
pub(crate) fn least_spp(method: &Method) -> f32 {
    if method.needs_history() {
        0.02
    } else {
        1.0
    }
}

/// At equal time no method is asked for more than so many times its samples at equal rays, nor for more than [`MOST_SPP`].
const MOST_SAMPLES_MORE: f32 = 16.0;
/// As many as a rig file may ask for.
const MOST_SPP: f32 = 4096.0;
/// Times count as equal within this share ...
const EQUAL_TIME: f64 = 0.05;
/// ... for which so many races are run at most, beside the first.
pub const RACES: usize = 4;

/// Most samples that a method is asked for which has `spp` at equal rays.
pub(super) fn most_spp(spp: f32, least: f32) -> f32 {
    (MOST_SAMPLES_MORE * spp).clamp(least, MOST_SPP)
}

/// With how many samples each of `others` fills the time of a frame of `dpm`, and how well, after a first race told the time of each by
/// that of `dpm`: `first`. `each` is called before every race.
///
/// Times are compared within a race only, where all meet the same disturbances. Races with more and fewer samples tell what a sample
/// takes beside what a frame takes without any, until the times are equal or [`RACES`] have been run; of all trials the nearest counts.
///
/// # Errors
/// The renderer's.
pub(crate) fn samples_at_equal_time(
    theatre: &Theatre,
    others: &[&Method],
    first: &[Trial],
    dpm: &(Method, f32),
    seed: u32,
    each: &mut dyn FnMut(),
) -> Result<Vec<Trial>, RenderError> {
    let mut trials: Vec<Vec<Trial>> = first.iter().map(|trial| vec![*trial]).collect();
    for _ in 0..RACES {
        if trials.iter().all(|t| off_equal(nearest(t)) <= EQUAL_TIME) {
            break;
        }
        let next = |method: &Method, tried: &[Trial]| {
            let least = least_spp(method);
            (where_equal(tried) as f32).clamp(least, most_spp(tried[0].0 as f32, least))
        };
        let next: Vec<f32> = others.iter().zip(&trials).map(|(method, tried)| next(method, tried)).collect();
        each();
        let runners: Vec<(Method, f32)> = others
            .iter()
            .zip(&next)
            .map(|(method, &spp)| (with_samples(method, spp), spp))
            .chain([dpm.clone()])
            .collect();
        let raced = theatre.race(&runners, seed)?;
        let of_dpm = raced.last().map_or(f64::NAN, FrameTime::ms);
        for ((tried, &spp), time) in trials.iter_mut().zip(&next).zip(&raced) {
            tried.push((f64::from(spp), time.ms() / of_dpm));
        }
    }
    Ok(trials.iter().map(|tried| nearest(tried)).collect())
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
