//! The latency alone, with lens and pose of the projector known: some seconds of motion suffice.

use super::code::Code;
use super::decode::Decoded;
use super::fit::{
    refine, sandwich, times, SensorError, Settings, BLOCK_S, FEWEST, MOST_LATENCY_S, MOST_LATENCY_SIGMA_US,
};
use super::problem::{Problem, Seen, State, LATENCY, UNKNOWNS};
use super::start::{prepare, thin};
use crate::least_squares::{descend, Equations};
use crate::model::ProjectorModel;
use crate::projector::{percentile, Refusal};
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
/// The same before the levels are fitted, when a pixel is good to a few.
const MOST_START_PX: f64 = 6.0;
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
    let seen = prepare(code, decoded, path, settings);
    if seen.len() < FEWEST {
        let seconds = (2 * FEWEST - seen.len()) as f64 * 1e-9 * settings.timing.frame_ns;
        return Err(SensorError::TooFew { frames: seen.len(), seconds: seconds.max(1.0) });
    }
    let tip_sigma = settings.tip_sigma_m.max(1e-4);
    let times = times(decoded, settings);
    let problem = Problem { code, path, settings, times, tip_sigma, is_held: true };
    let start = start(&problem, &seen, model)?;
    let (state, equations, rms_level) = refine(&problem, start, &seen)?;
    finish(&problem, &state, &equations, &seen, rms_level)
}

/// Tip and latency from the pixels of the bits, good to a pixel.
fn start(problem: &Problem, seen: &[Seen], model: &ProjectorModel) -> Result<State, SensorError> {
    let settings = problem.settings;
    let mut state = State {
        model: *model,
        tip: settings.tip,
        latency_s: 0.0,
        drift: 0.0,
        radius_m: 0.5 * settings.aperture_m,
    };
    let few: Vec<Seen> = thin(seen, 1500).map(Seen::copy).collect();
    for sigma_px in [6.0, 1.5] {
        let equations = |s: &State| problem.of_bits(s, &few, sigma_px);
        let cost = |s: &State| equations(s).map_or(f64::INFINITY, |e| e.cost);
        let found = descend(state, 40, equations, cost, |s: &State, d: &[f64]| s.step(d));
        state = found.ok_or(Refusal::NotConverged { rms_px: f64::INFINITY })?.state;
    }
    let px = miss(problem, &state, &few);
    // Written so that no sighting at all, which is NaN, is refused too.
    if px <= MOST_START_PX {
        return Ok(state);
    }
    Err(bound(&state).unwrap_or(SensorError::OtherProjector { px }))
}

/// The median distance between the pixels of the bits and where a state sees them.
fn miss(problem: &Problem, state: &State, seen: &[Seen]) -> f64 {
    let one = |s: &Seen| problem.sight(state, s).map(|at| (at.pixel - s.pixel).length());
    percentile(seen.iter().filter_map(one).collect(), 0.5)
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
    let mut scores: Vec<(i64, [f64; UNKNOWNS])> = Vec::new();
    let (mut misses, mut frames) = (Vec::new(), 0);
    for frame in seen {
        let Some(at) = problem.sight(state, frame) else { continue };
        frames += 1;
        let sums = problem.frame(&at, frame, sigma, 0.0);
        let block = (frame.from_middle_s / BLOCK_S).floor() as i64;
        let score = sums.score(&at);
        match scores.last_mut().filter(|(b, _)| *b == block) {
            Some((_, sum)) => sum.iter_mut().zip(&score).for_each(|(a, b)| *a += b),
            None => scores.push((block, score)),
        }
        (0..2).filter(|k| sums.gg[*k] > 1.0).for_each(|k| misses.push((sums.gr[k] / sums.gg[k]).powi(2)));
    }
    let rms_px = (misses.iter().sum::<f64>() / misses.len().max(1) as f64).sqrt();
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
    let covariance = sandwich(equations, &expected, &scores).ok_or(short)?;
    let sigma_ns = 1e9 * covariance[LATENCY][LATENCY].sqrt();
    if sigma_ns > 1e3 * MOST_LATENCY_SIGMA_US {
        return Err(SensorError::LatencyUncertain { us: 1e-3 * sigma_ns });
    }
    Ok(Latency { latency_ns: (1e9 * state.latency_s).round() as i64, sigma_ns, frames, rms_px })
}
