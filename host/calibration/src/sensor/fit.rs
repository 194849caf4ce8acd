//! Levels of the planes and poses of the wand into lens, pose, tip and latency.
//!
//! The bits of the planes give each frame a pixel, good to a few: enough to start. The levels are then fitted plane by
//! plane to stripes seen through a round aperture, each plane at its own time: a tip at half a metre a second moves by a
//! pixel during a frame, and tagging all planes with one instant would shift the latency by hundreds of microseconds.
//!
//! The covariance comes from the data: scores are summed over blocks of a tenth of a second, far longer than the
//! tracker's noise is correlated by interpolation. Noise is white by sample of the tracker, not by plane, so the usual
//! inverse of J^T J would promise far too much.

use super::change::largest_change;
use super::code::{Code, PLANES};
use super::decode::Decoding;
use super::lens::finish_told;
use super::problem::{
    Fix, FrameFix, LatencyLimits, Measured, Planes, SensorProblem, SensorUnknowns, Tally, LATENCY, TIP,
    UNKNOWNS,
};
use super::start::{prepare, start, thin, why_no_fit};
use super::Timing;
use crate::dense::inverse_spd;
use crate::least_squares::{descend, Equations};
use crate::model::ProjectorModel;
use crate::projector::{check_result, predict, LightError, PlaceHint, PointsRefusal, Priors, Volume};
use crate::trajectory::Trajectory;
use dpm_device::planes::Raster;
use glam::{DMat3, DVec2, DVec3};
use thiserror::Error;

/// What is known before the sensor speaks.
#[derive(Clone, Copy, Debug)]
pub struct Settings {
    /// When the projector shows which frame.
    pub timing: Timing,
    /// The tip in the wand's body frame, from [`crate::pivot`], metres.
    pub tip: DVec3,
    /// Its standard deviation along one axis, metres. A tenth of a millimetre at least is used: the solve knows better.
    pub tip_sigma_m: f64,
    /// Diameter of the sensor's aperture, metres; right within a factor of two.
    pub aperture_m: f64,
    /// What is expected of the lens.
    pub priors: Priors,
    /// What is known of the projector's place.
    pub known: PlaceHint,
    /// Where light will be needed.
    pub volume: Volume,
    /// Seed of the random samples.
    pub seed: u64,
}

/// Brightness of full light where the tip was: for [`crate::light`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Brightness {
    /// Pixel that lit the tip.
    pub pixel: DVec2,
    /// Distance from the projector's lens, metres.
    pub distance_m: f64,
    /// Direction from the tip to the lens in the wand's body frame, unit.
    pub towards: DVec3,
    /// Full light less darkness, in the sensor's unit.
    pub level: f64,
}

/// What the sensor tells.
#[derive(Clone, Debug)]
pub struct Solution {
    /// Lens and pose.
    pub model: ProjectorModel,
    /// Covariance of the model's numbers.
    pub covariance: Vec<Vec<f64>>,
    /// The error that the light may have over the volume, if the tracker has no bias.
    pub predicted: LightError,
    /// The data leave the lens open near the raster's border, where a usual lens was expected.
    pub is_lens_open: bool,
    /// The tip in the wand's body frame, metres.
    pub tip: DVec3,
    /// Covariance of the tip, square metres.
    pub tip_covariance: DMat3,
    /// A pose with stamp s shows where the wand was when light fell at s less this.
    pub latency_ns: i64,
    /// Standard deviation of the latency.
    pub latency_sigma_ns: f64,
    /// How much faster the tracker's clock is than the projector's, parts per million.
    pub drift_ppm: f64,
    /// Diameter of the aperture, metres.
    pub aperture_m: f64,
    /// Frames used.
    pub frames: usize,
    /// Root mean square of the levels' residuals over the contrast.
    pub rms_level: f64,
    /// The same as a place, along one axis: what the residuals mean in pixels.
    pub rms_px: f64,
    /// Brightness by frame.
    pub brightness: Vec<Brightness>,
}

/// Why the levels are refused.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum SensorError {
    /// Too few frames with a pose.
    #[error("sensor: {frames} frames have light and a pose of the wand, {need} are needed; move the wand through the picture for {seconds:.0} s more")]
    TooFew {
        /// Frames there are.
        frames: usize,
        /// Frames that are needed.
        need: usize,
        /// Seconds that are missing.
        seconds: f64,
    },
    /// The points do not make a projector.
    #[error(transparent)]
    Projector(#[from] PointsRefusal),
    /// The wand was not held still often enough.
    #[error("sensor: at {places} places the wand was held still until every stripe had been seen, {need} are needed: rest for two seconds at each of twenty places, near and far, and go slowly from one to the next")]
    TooFewPlaces {
        /// Places there are.
        places: usize,
        /// Places that are needed.
        need: usize,
    },
    /// The latency is at its bound.
    #[error("sensor: the latency comes out as {ms:.1} ms, at its bound; look at the clocks of tracker and projector")]
    LatencyAtBound {
        /// Milliseconds.
        ms: f64,
    },
    /// The motion does not show the latency.
    #[error("sensor: the latency is uncertain by {us:.0} us: move the wand to and fro, in all directions, at half a metre a second")]
    LatencyUncertain {
        /// Standard deviation, microseconds.
        us: f64,
    },
    /// The levels do not fit.
    #[error("sensor: the levels do not fit any projector: {px:.1} px remain; was the projector or the tracker moved, is the wand's body rigid?")]
    DoesNotFit {
        /// Residual, pixels.
        px: f64,
    },
    /// The parts of the sweep belong to different projectors.
    #[error("sensor: the first {after_s:.0} s of the sweep and the rest belong to different projectors, which light the same place {px:.1} px apart: projector or tracker were moved, the wand's body is not rigid, or the lens has more terms than were asked for (--lens); fasten what is loose, and begin again")]
    Changed {
        /// When the change was, seconds after the first frame.
        after_s: f64,
        /// How far apart the light of the two is, pixels.
        px: f64,
    },
    /// The light is not where a known projector puts it.
    #[error("sensor: the light is {px:.1} px away from where the calibrated projector puts it: projector or tracker were moved, or the tip is another one; run `dpm calibrate projector` again")]
    OtherProjector {
        /// Residual, pixels.
        px: f64,
    },
}

/// Fewest frames.
pub(super) const FEWEST: usize = 500;
/// Beyond this residual, root mean square, the levels fit no projector, pixels.
const MOST_RMS_PX: f64 = 2.5;
/// Levels of a projector that stayed where it was miss by less than this, root mean square: by a few hundredths. In pixels
/// they may look well nevertheless: a stripe that is lit where it should be dark has no slope that would say by how far.
pub(super) const MOST_MISFIT: f64 = 0.1;
/// Beyond this an offset is no latency, seconds.
pub(super) const MOST_LATENCY_S: f64 = 0.05;
const MOST_LATENCY_SIGMA_US: f64 = 100.0;
/// Blocks over which scores are summed, seconds.
pub(super) const BLOCK_S: f64 = 0.1;

/// Finds the projector, the tip and the latency.
///
/// # Errors
/// Each reason of [`SensorError`].
pub fn solve(
    code: &Code,
    decoded: &Decoding,
    path: &Trajectory,
    settings: &Settings,
) -> Result<Solution, SensorError> {
    let planes = planes_of(code, decoded, settings);
    let problem = SensorProblem::new(code.raster(), (path, settings), false);
    let seen = enough(prepare(&planes, decoded, path, settings), settings)?;
    let fixes: Vec<Fix> = seen.iter().map(|s| s.fix).collect();
    let start = start(&problem, &fixes)?;
    let fitted = refine(&problem, start, &seen, &FINEST)?;
    finish_told(&problem, &fitted, (&seen, &fixes), &FINEST)
}

/// The planes of frames, and when their levels were.
pub(super) fn planes_of<'a>(code: &'a Code, decoded: &Decoding, settings: &Settings) -> Planes<'a> {
    let plane_s = 1e-9 * settings.timing.frame_ns / PLANES as f64;
    let times = std::array::from_fn(|p| (p as f64 + decoded.centre - (PLANES / 2) as f64) * plane_s);
    Planes { code, times }
}

/// The frames, if they are enough.
pub(super) fn enough<'a>(
    seen: Vec<FrameFix<'a>>,
    settings: &Settings,
) -> Result<Vec<FrameFix<'a>>, SensorError> {
    if seen.len() < FEWEST {
        let seconds = (2 * FEWEST - seen.len()) as f64 * 1e-9 * settings.timing.frame_ns;
        return Err(SensorError::TooFew { frames: seen.len(), need: FEWEST, seconds: seconds.max(1.0) });
    }
    Ok(seen)
}

impl<'a> SensorProblem<'a> {
    /// `is_held`: lens and pose stay what they are.
    pub(super) fn new(
        raster: Raster,
        (path, settings): (&'a Trajectory, &'a Settings),
        is_held: bool,
    ) -> Self {
        let limits = LatencyLimits { latency_s: MOST_LATENCY_S, latency_sigma_us: MOST_LATENCY_SIGMA_US };
        let inside = settings.priors.free();
        let free = std::array::from_fn(|i| !is_held && inside.get(i).copied().unwrap_or(true));
        Self { raster, limits, path, settings, tip_sigma: settings.tip_sigma_m.max(1e-4), free }
    }
}

/// Scores summed by block of time, and how far each frame alone would move its pixel.
#[derive(Default)]
pub(super) struct Scores {
    pub by_block: Vec<(i64, [f64; UNKNOWNS])>,
    squares_px: f64,
    count: f64,
}

impl Scores {
    /// Adds a measurement.
    pub(super) fn add(&mut self, from_middle_s: f64, tally: &Tally) {
        let block = (from_middle_s / BLOCK_S).floor() as i64;
        match self.by_block.last_mut().filter(|(b, _)| *b == block) {
            Some((_, sum)) => sum.iter_mut().zip(&tally.score).for_each(|(a, b)| *a += b),
            None => self.by_block.push((block, tally.score)),
        }
        for k in (0..2).filter(|k| tally.gg[*k] > 1.0) {
            self.squares_px += (tally.gr[k] / tally.gg[k]).powi(2);
            self.count += 1.0;
        }
    }

    /// Root mean square of the frames' own steps along one axis, pixels.
    pub(super) fn rms_px(&self) -> f64 {
        (self.squares_px / self.count.max(1.0)).sqrt()
    }
}

/// A state with its equations, and the root mean square of the levels' residuals.
pub(super) struct FitState {
    pub state: SensorUnknowns,
    pub equations: Equations,
    pub rms_level: f64,
}

impl FitState {
    /// The deviation of a level that the weights are made of.
    pub(super) fn sigma(&self) -> f64 {
        self.rms_level.clamp(0.005, 0.15)
    }
}

/// The narrowest stripes of each stage of a fit, and whether all measurements take part in it.
pub(super) const FINEST: [(f64, bool); 4] = [(8.0, false), (3.0, false), (0.0, false), (0.0, true)];

/// Fits the levels: wide stripes first, since a start that is wrong by a stripe would lock to the wrong one.
pub(super) fn refine<M: Measured>(
    problem: &SensorProblem,
    start: SensorUnknowns,
    seen: &[M],
    stages: &[(f64, bool)],
) -> Result<FitState, SensorError> {
    let few: Vec<&M> = thin(seen, 3000).collect();
    let every: Vec<&M> = seen.iter().collect();
    let mut state = start;
    let mut sigma = 0.15;
    let failed = PointsRefusal::NotConverged { rms_px: f64::INFINITY };
    let mut last = None;
    for (finest, all) in stages {
        let (frames, how) = (if *all { &every } else { &few }, (sigma, *finest));
        let found = descend(
            state,
            30,
            |s: &SensorUnknowns| problem.of_levels(s, frames, how),
            |s: &SensorUnknowns| problem.cost_of_levels(s, frames, how),
            |s: &SensorUnknowns, d: &[f64]| s.step(d),
        )
        .ok_or(failed.clone())?;
        state = found.state;
        // The deviation of the levels on the slopes of stripes is what the next weights are made of.
        let each = frames.iter().filter_map(|f| f.tally(problem, &state, 1.0, 0.0, None));
        let (squares, count) = each.fold((0.0, 0.0), |a, t| (a.0 + t.squares, a.1 + t.count));
        let rms = (squares / f64::max(count, 1.0)).sqrt();
        sigma = rms.clamp(0.005, 0.15);
        last = Some((found.equations, rms));
    }
    let (equations, rms_level) = last.ok_or(failed)?;
    Ok(FitState { state, equations, rms_level })
}

/// What the measurements say of a fit.
#[derive(Default)]
struct Evidence {
    scores: Scores,
    brightness: Vec<Brightness>,
    /// Distances of the tip along the projector's axis, metres.
    depths: Vec<f64>,
}

impl Evidence {
    fn of<M: Measured>(problem: &SensorProblem, fitted: &FitState, seen: &[M]) -> Self {
        let (state, mut told) = (&fitted.state, Self::default());
        let position = state.model.position();
        for one in seen {
            let Some(tally) = one.tally(problem, state, fitted.sigma(), 0.0, None) else { continue };
            let moment = one.moment();
            let Some(at) = problem.sight(state, moment) else { continue };
            told.scores.add(moment.from_middle_s, &tally);
            let shift = (1e9 * (state.latency_s + state.drift * moment.from_middle_s)) as i64;
            let Some(pose) = problem.path.at(moment.instant.0 + shift, 0.0) else { continue };
            let tip = pose.position + pose.rotation * state.tip;
            told.depths.push(state.model.local(tip).z);
            let away = position - tip;
            told.brightness.push(Brightness {
                pixel: at.pixel,
                distance_m: away.length(),
                towards: pose.rotation.conjugate() * away.normalize_or_zero(),
                level: one.contrast(),
            });
        }
        told
    }
}

/// A fit into what is told of it; `fixes` tell why, where the levels do not fit. Whether its lens can be inverted over the
/// raster is not asked here.
pub(super) fn finish<M: Measured>(
    problem: &SensorProblem,
    fitted: &FitState,
    (seen, fixes): (&[M], &[Fix]),
) -> Result<Solution, SensorError> {
    let (settings, state) = (problem.settings, &fitted.state);
    let Evidence { scores, brightness, depths } = Evidence::of(problem, fitted, seen);
    let rms_px = scores.rms_px();
    if rms_px > MOST_RMS_PX || fitted.rms_level > MOST_MISFIT {
        return Err(why_no_fit(problem, fixes, state, rms_px));
    }
    check_result(&state.model, &depths, &settings.known)?;
    let unsettled = PointsRefusal::NotConverged { rms_px };
    let inverse = inverse_spd(&fitted.equations.matrix()).ok_or(unsettled.clone())?;
    let covariance = sandwich(&inverse, &problem.expected(state), &scores.by_block).ok_or(unsettled)?;
    if state.latency_s.abs() > 0.9 * problem.limits.latency_s {
        return Err(SensorError::LatencyAtBound { ms: 1e3 * state.latency_s });
    }
    let latency_sigma_ns = 1e9 * covariance[LATENCY][LATENCY].sqrt();
    if latency_sigma_ns > 1e3 * problem.limits.latency_sigma_us {
        return Err(SensorError::LatencyUncertain { us: 1e-3 * latency_sigma_ns });
    }
    let of_tip = |i: usize| DVec3::from_array(std::array::from_fn(|j| covariance[TIP + i][TIP + j]));
    let points = settings.volume.points(&state.model, problem.raster);
    let mut of_model = problem.of_model(&covariance);
    if let Some(change) = largest_change(&state.model, (&inverse, &of_model), &scores.by_block, &points) {
        if change.is_refused() {
            return Err(SensorError::Changed { after_s: change.after_s, px: change.px });
        }
        change.add_to(&mut of_model);
    }
    Ok(Solution {
        model: state.model,
        predicted: predict(&state.model, &of_model, &points),
        covariance: of_model,
        is_lens_open: false,
        tip: state.tip,
        tip_covariance: DMat3::from_cols(of_tip(0), of_tip(1), of_tip(2)),
        latency_ns: (1e9 * state.latency_s).round() as i64,
        latency_sigma_ns,
        drift_ppm: 1e6 * state.drift,
        aperture_m: 2.0 * state.radius_m,
        frames: brightness.len(),
        rms_level: fitted.rms_level,
        rms_px,
        brightness,
    })
}

/// The inverse of the second derivatives, times the covariance of the scores by block and of the expectations, times the
/// inverse again. `None` if the blocks are too few.
pub(super) fn sandwich(
    inverse: &[Vec<f64>],
    expected: &Equations,
    scores: &[(i64, [f64; UNKNOWNS])],
) -> Option<Vec<Vec<f64>>> {
    let blocks = scores.len() as f64;
    if blocks <= 2.0 * UNKNOWNS as f64 {
        return None;
    }
    let inflate = blocks / (blocks - UNKNOWNS as f64);
    let mut covariance = vec![vec![0.0; UNKNOWNS]; UNKNOWNS];
    // An expectation is one more measurement; its weight is the inverse of its variance.
    for (i, row) in expected.matrix().iter().enumerate() {
        let deviation = row[i].sqrt();
        for (a, of_a) in inverse.iter().enumerate() {
            (0..UNKNOWNS).for_each(|b| covariance[a][b] += of_a[i] * deviation * inverse[b][i] * deviation);
        }
    }
    for (_, score) in scores {
        let step: Vec<f64> =
            inverse.iter().map(|row| row.iter().zip(score).map(|(a, b)| a * b).sum()).collect();
        for (row, a) in covariance.iter_mut().zip(&step) {
            row.iter_mut().zip(&step).for_each(|(v, b)| *v += inflate * a * b);
        }
    }
    Some(covariance)
}
