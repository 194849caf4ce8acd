//! The latency alone, with lens and pose of the projector known: some seconds of motion suffice.

use super::code::Code;
use super::decode::Decoding;
use super::fit::{enough, planes_of, refine, sandwich, FitState, Scores, SensorError, Settings, FINEST};
use super::problem::{Fix, Measured, Moment, SensorProblem, SensorUnknowns, LATENCY};
use super::start::{from_bits, prepare, MOST_START_PX};
use crate::dense::inverse_spd;
use crate::model::ProjectorModel;
use crate::projector::percentile;
use crate::trajectory::Trajectory;

/// What the sensor tells of the latency.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Latency {
    /// A pose with stamp s shows where the wand was when light fell at s less this.
    pub latency_ns: i64,
    /// Standard deviation of the latency.
    pub sigma_ns: f64,
    /// Frames used.
    pub frames: usize,
    /// Root mean square of the residuals as a place, along one axis, pixels.
    pub rms_px: f64,
}

/// A known projector misses by no more than this, pixels: else it, or the tracker, was moved.
const MOST_PX: f64 = 2.5;
/// The tip is no further from where it was said to be than so many of its standard deviations.
const MOST_TIP_SIGMAS: f64 = 5.0;

/// Finds the latency. Lens and pose are those of `model`; the tip may still change, by `settings.tip_sigma_m`. Of the
/// rest of `settings`, priors, known and volume play no part.
///
/// # Errors
/// [`SensorError::TooFew`], [`SensorError::LatencyAtBound`], [`SensorError::LatencyUncertain`], and
/// [`SensorError::OtherProjector`] if the light is not where `model` says.
pub fn solve_latency(
    code: &Code,
    decoded: &Decoding,
    path: &Trajectory,
    settings: &Settings,
    model: &ProjectorModel,
) -> Result<Latency, SensorError> {
    let planes = planes_of(code, decoded, settings);
    let problem = SensorProblem::new(code.raster(), (path, settings), true);
    let seen = enough(prepare(&planes, decoded, path, settings), settings)?;
    let fixes: Vec<Fix> = seen.iter().map(|s| s.fix).collect();
    let start = start(&problem, &fixes, model)?;
    let fitted = refine(&problem, start, &seen, &FINEST)?;
    finish(&problem, &fitted, &seen)
}

/// Tip and latency from the pixels of the bits, good to a pixel.
fn start(
    problem: &SensorProblem,
    seen: &[Fix],
    model: &ProjectorModel,
) -> Result<SensorUnknowns, SensorError> {
    let (state, px) = from_bits(problem, seen, *model)?;
    // Written so that no sighting at all, which is NaN, is refused too.
    if px <= MOST_START_PX {
        return Ok(state);
    }
    Err(bound(problem, &state).unwrap_or(SensorError::OtherProjector { px }))
}

fn bound(problem: &SensorProblem, state: &SensorUnknowns) -> Option<SensorError> {
    let is_at = state.latency_s.abs() > 0.9 * problem.limits.latency_s;
    is_at.then_some(SensorError::LatencyAtBound { ms: 1e3 * state.latency_s })
}

/// The median distance between where two states see the tip, pixels.
fn apart<'a>(
    problem: &SensorProblem,
    a: &SensorUnknowns,
    b: &SensorUnknowns,
    moments: impl Iterator<Item = &'a Moment>,
) -> f64 {
    let one = |at: &Moment| Some((problem.sight(a, at)?.pixel - problem.sight(b, at)?.pixel).length());
    percentile(moments.filter_map(one).collect(), 0.5)
}

pub(super) fn finish<M: Measured>(
    problem: &SensorProblem,
    fitted: &FitState,
    seen: &[M],
) -> Result<Latency, SensorError> {
    let state = &fitted.state;
    let (mut scores, mut frames) = (Scores::default(), 0);
    for one in seen {
        let Some(tally) = one.tally(problem, state, fitted.sigma(), 0.0, None) else { continue };
        frames += 1;
        scores.add(one.moment().from_middle_s, &tally);
    }
    let rms_px = scores.rms_px();
    if let Some(at_bound) = bound(problem, state) {
        return Err(at_bound);
    }
    if rms_px > MOST_PX {
        return Err(SensorError::OtherProjector { px: rms_px });
    }
    // A tip that moves further than it can be wrong makes up for a projector that is elsewhere.
    let before = problem.settings.tip;
    if (state.tip - before).abs().max_element() > MOST_TIP_SIGMAS * problem.tip_sigma {
        let moments = seen.iter().map(M::moment);
        let px = apart(problem, state, &SensorUnknowns { tip: before, ..*state }, moments);
        return Err(SensorError::OtherProjector { px });
    }
    let short = SensorError::TooFew { frames, need: 2 * frames, seconds: 5.0 };
    let covariance = inverse_spd(&fitted.equations.matrix())
        .and_then(|inverse| sandwich(&inverse, &problem.expected(state), &scores.by_block))
        .ok_or(short)?;
    let sigma_ns = 1e9 * covariance[LATENCY][LATENCY].sqrt();
    if sigma_ns > 1e3 * problem.limits.latency_sigma_us {
        return Err(SensorError::LatencyUncertain { us: 1e-3 * sigma_ns });
    }
    Ok(Latency { latency_ns: (1e9 * state.latency_s).round() as i64, sigma_ns, frames, rms_px })
}
