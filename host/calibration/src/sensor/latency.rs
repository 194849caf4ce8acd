//! The latency alone, with lens and pose of the projector known: some seconds of motion suffice.

use super::code::Code;
use super::decode::Decoded;
use super::fit::{
    refine, sandwich, set_up, Scores, SensorError, Settings, MOST_LATENCY_S, MOST_LATENCY_SIGMA_US,
};
use super::problem::{Problem, Seen, State, LATENCY, UNKNOWNS};
use super::start::{from_bits, miss, MOST_START_PX};
use crate::least_squares::Equations;
use crate::model::ProjectorModel;
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
    decoded: &Decoded,
    path: &Trajectory,
    settings: &Settings,
    model: &ProjectorModel,
) -> Result<Latency, SensorError> {
    let (problem, seen) = set_up(code, decoded, (path, settings), true)?;
    let start = start(&problem, &seen, model)?;
    let (state, equations, rms_level) = refine(&problem, start, &seen)?;
    finish(&problem, &state, &equations, &seen, rms_level)
}

/// Tip and latency from the pixels of the bits, good to a pixel.
fn start(problem: &Problem, seen: &[Seen], model: &ProjectorModel) -> Result<State, SensorError> {
    let (state, px) = from_bits(problem, seen, *model)?;
    // Written so that no sighting at all, which is NaN, is refused too.
    if px <= MOST_START_PX {
        return Ok(state);
    }
    Err(bound(&state).unwrap_or(SensorError::OtherProjector { px }))
}

fn bound(state: &State) -> Option<SensorError> {
    let is_at = state.latency_s.abs() > 0.9 * MOST_LATENCY_S;
    is_at.then_some(SensorError::LatencyAtBound { ms: 1e3 * state.latency_s })
}

fn finish(
    problem: &Problem,
    state: &State,
    equations: &Equations,
    seen: &[Seen],
    rms_level: f64,
) -> Result<Latency, SensorError> {
    let sigma = rms_level.clamp(0.005, 0.15);
    let (mut scores, mut frames) = (Scores::default(), 0);
    for frame in seen {
        let Some(at) = problem.sight(state, frame) else { continue };
        frames += 1;
        scores.add(problem, &at, frame, sigma);
    }
    let rms_px = scores.rms_px();
    if let Some(at_bound) = bound(state) {
        return Err(at_bound);
    }
    if rms_px > MOST_PX {
        return Err(SensorError::OtherProjector { px: rms_px });
    }
    // A tip that moves further than it can be wrong makes up for a projector that is elsewhere.
    let before = problem.settings.tip;
    if (state.tip - before).abs().max_element() > MOST_TIP_SIGMAS * problem.tip_sigma {
        let px = miss(problem, &State { tip: before, ..*state }, seen);
        return Err(SensorError::OtherProjector { px });
    }
    let mut expected = Equations::new(UNKNOWNS);
    problem.expect(state, &mut expected);
    let short = SensorError::TooFew { frames, seconds: 5.0 };
    let covariance = sandwich(equations, &expected, &scores.by_block).ok_or(short)?;
    let sigma_ns = 1e9 * covariance[LATENCY][LATENCY].sqrt();
    if sigma_ns > 1e3 * MOST_LATENCY_SIGMA_US {
        return Err(SensorError::LatencyUncertain { us: 1e-3 * sigma_ns });
    }
    Ok(Latency { latency_ns: (1e9 * state.latency_s).round() as i64, sigma_ns, frames, rms_px })
}
