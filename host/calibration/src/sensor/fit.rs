//! Levels of the planes and poses of the wand into lens, pose, tip and latency.
//!
//! The bits of the planes give each frame a pixel, good to a few: enough to start. The levels are then fitted plane by
//! plane to stripes seen through a round aperture, each plane at its own time: a tip at half a metre a second moves by a
//! pixel during a frame, and tagging all planes with one instant would shift the latency by hundreds of microseconds.
//!
//! The covariance comes from the data: scores are summed over blocks of a tenth of a second, far longer than the
//! tracker's noise is correlated by interpolation. Noise is white by sample of the tracker, not by plane, so the usual
//! inverse of J^T J would promise far too much.

use super::code::{Code, Role, PLANES};
use super::decode::{Decoded, Frame};
use super::stripes::stripes;
use super::Timing;
use crate::dense::inverse_spd;
use crate::least_squares::{descend, huber, Equations};
use crate::model::{ProjectorModel, PARAMETERS};
use crate::pinhole::{calibrate, CalibrationError, CalibrationOptions, Pair};
use crate::projector::{
    check_result, percentile, predict, spread_of, Known, Predicted, Priors, Refusal, Sight, Volume,
};
use crate::trajectory::Trajectory;
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
    pub known: Known,
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
    /// Covariance of the model's fifteen numbers.
    pub covariance: Vec<Vec<f64>>,
    /// The error that the light may have over the volume, if the tracker has no bias.
    pub predicted: Predicted,
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
    #[error("sensor: {frames} frames have light and a pose of the wand, {FEWEST} are needed; move the wand through the picture for {seconds:.0} s more")]
    TooFew {
        /// Frames there are.
        frames: usize,
        /// Seconds that are missing.
        seconds: f64,
    },
    /// The points do not make a projector.
    #[error(transparent)]
    Projector(#[from] Refusal),
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
}

/// Fewest frames.
const FEWEST: usize = 500;
/// Beyond this an offset is no latency, seconds.
const MOST_LATENCY_S: f64 = 0.05;
const MOST_LATENCY_SIGMA_US: f64 = 100.0;
/// Frames nearer than this to the raster's border, pixels, see only a part of the stripes.
const BORDER_PX: f64 = 10.0;
/// Blocks over which scores are summed, seconds.
const BLOCK_S: f64 = 0.1;

// The unknowns after the fifteen of the projector.
const TIP: usize = PARAMETERS;
const LATENCY: usize = TIP + 3;
const DRIFT: usize = LATENCY + 1;
const RADIUS: usize = DRIFT + 1;
const UNKNOWNS: usize = RADIUS + 1;

/// A frame prepared for the fit.
struct Seen {
    /// Instant of the frame's middle plane by the host's clock, and its distance from the middle of all, seconds.
    instant: (i64, f64),
    from_middle_s: f64,
    /// Levels of the coded planes over the contrast, 0 to 1.
    levels: [f64; PLANES],
    contrast: f64,
    /// The pixel of the bits.
    pixel: DVec2,
}

#[derive(Clone, Copy, Debug)]
struct State {
    model: ProjectorModel,
    tip: DVec3,
    latency_s: f64,
    /// Seconds a second.
    drift: f64,
    radius_m: f64,
}

impl State {
    fn step(&self, d: &[f64]) -> Self {
        Self {
            model: self.model.step(d),
            tip: self.tip + DVec3::new(d[TIP], d[TIP + 1], d[TIP + 2]),
            latency_s: self.latency_s + d[LATENCY],
            drift: self.drift + d[DRIFT],
            radius_m: self.radius_m * d[RADIUS].exp(),
        }
    }
}

/// Where the tip is seen in a frame, and how that changes.
struct Sighting {
    pixel: DVec2,
    /// Pixels a second.
    velocity: DVec2,
    /// Of the aperture, pixels.
    radius: f64,
    /// Derivatives of x and y of the pixel by the unknowns.
    rows: [[f64; UNKNOWNS]; 2],
}

struct Problem<'a> {
    code: &'a Code,
    path: &'a Trajectory,
    settings: &'a Settings,
    /// Time of a level within its plane, less that of the frame's middle, seconds, by plane.
    times: [f64; PLANES],
    tip_sigma: f64,
}

impl Problem<'_> {
    fn sight(&self, s: &State, seen: &Seen) -> Option<Sighting> {
        let shift = 1e9 * (s.latency_s + s.drift * seen.from_middle_s) + seen.instant.1;
        let pose =
            self.path.at(seen.instant.0.saturating_add(shift.floor() as i64), shift - shift.floor())?;
        let lever = pose.rotation * s.tip;
        let at = s.model.derive(pose.position + lever)?;
        let velocity = pose.velocity + pose.turning.cross(lever);
        let to_body = pose.rotation.conjugate();
        let mut rows = [[0.0; UNKNOWNS]; 2];
        let mut moving = DVec2::ZERO;
        for k in 0..2 {
            rows[k][..PARAMETERS].copy_from_slice(&at.by_parameters[k]);
            rows[k][TIP..LATENCY].copy_from_slice(&(to_body * at.by_point[k]).to_array());
            moving[k] = at.by_point[k].dot(velocity);
            rows[k][LATENCY] = moving[k];
            rows[k][DRIFT] = moving[k] * seen.from_middle_s;
        }
        let scale = 0.5 * (at.by_point[0].length() + at.by_point[1].length());
        Some(Sighting { pixel: at.pixel, velocity: moving, radius: s.radius_m * scale, rows })
    }

    fn expect(&self, s: &State, all: &mut Equations) {
        self.settings.priors.apply(&s.model, all);
        (0..3).for_each(|i| all.expect(TIP + i, s.tip[i] - self.settings.tip[i], self.tip_sigma));
        all.expect(LATENCY, s.latency_s, 0.1);
        all.expect(DRIFT, s.drift, 1e-4);
        all.expect(RADIUS, (2.0 * s.radius_m / self.settings.aperture_m).ln(), 0.7);
    }

    /// Equations from the pixels of the bits.
    fn from_bits(&self, s: &State, frames: &[Seen], sigma_px: f64) -> Option<Equations> {
        let mut all = Equations::new(UNKNOWNS);
        for seen in frames {
            let Some(at) = self.sight(s, seen) else { continue };
            let r = (at.pixel - seen.pixel) / sigma_px;
            let (weight, loss) = huber(r.length(), 2.0);
            all.cost += loss;
            (0..2).for_each(|k| all.add(&at.rows[k].map(|v| v / sigma_px), r[k], weight));
        }
        self.expect(s, &mut all);
        all.cost.is_finite().then_some(all)
    }

    /// Residuals of a frame's levels: summed products of slopes and residuals.
    fn frame(&self, at: &Sighting, seen: &Seen, sigma: f64, finest: f64) -> Sums {
        let mut sums = Sums::default();
        for plane in 2..PLANES - 2 {
            let (axis, width) = match self.code.role(plane) {
                Role::Column { width } => (0, f64::from(width)),
                Role::Row { width } => (1, f64::from(width)),
                _ => continue,
            };
            if width < finest {
                continue;
            }
            let place = at.pixel[axis] + at.velocity[axis] * self.times[plane];
            let share = stripes(width, place, at.radius);
            let r = (share.share - seen.levels[plane]) / sigma;
            let (weight, loss) = huber(r.abs(), 2.0);
            let (g, h) = (share.by_place / sigma, share.by_radius * at.radius / sigma);
            sums.loss += loss;
            sums.gg[axis] += weight * g * g;
            sums.gh[axis] += weight * g * h;
            sums.hh += weight * h * h;
            sums.gr[axis] += weight * g * r;
            sums.hr += weight * h * r;
            sums.rr += (r * sigma).powi(2);
            sums.count += 1.0;
        }
        sums
    }

    fn from_levels(&self, s: &State, frames: &[Seen], sigma: f64, finest: f64) -> Option<Equations> {
        let mut all = Equations::new(UNKNOWNS);
        for seen in frames {
            let Some(at) = self.sight(s, seen) else { continue };
            let sums = self.frame(&at, seen, sigma, finest);
            all.cost += sums.loss;
            sums.add_to(&at, &mut all);
        }
        self.expect(s, &mut all);
        all.cost.is_finite().then_some(all)
    }

    fn cost_of_levels(&self, s: &State, frames: &[Seen], sigma: f64, finest: f64) -> f64 {
        let losses =
            frames.iter().filter_map(|f| Some(self.frame(&self.sight(s, f)?, f, sigma, finest).loss));
        let mut priors = Equations::new(UNKNOWNS);
        self.expect(s, &mut priors);
        losses.sum::<f64>() + priors.cost
    }
}

/// Sums over the planes of a frame: `g` by place along each axis, `h` by the logarithm of the radius, `r` residuals.
#[derive(Default)]
struct Sums {
    loss: f64,
    gg: [f64; 2],
    gh: [f64; 2],
    hh: f64,
    gr: [f64; 2],
    hr: f64,
    rr: f64,
    count: f64,
}

impl Sums {
    /// All planes of one axis share their derivatives, so a frame costs two rows instead of twenty.
    fn add_to(&self, at: &Sighting, all: &mut Equations) {
        let mut left = self.hh;
        let mut of_radius = self.hr;
        for k in 0..2 {
            if self.gg[k] <= 0.0 {
                continue;
            }
            // (g J + h e)^2 over planes: complete the square, and leave the rest to the radius alone.
            let share = self.gh[k] / self.gg[k];
            let mut row = at.rows[k];
            row[RADIUS] += share;
            all.add(&row, self.gr[k] / self.gg[k], self.gg[k]);
            left -= self.gg[k] * share * share;
            of_radius -= self.gr[k] * share;
        }
        if left > 1e-12 * self.hh {
            let mut row = [0.0; UNKNOWNS];
            row[RADIUS] = 1.0;
            all.add(&row, of_radius / left, left);
        }
    }

    /// Minus the derivative of the cost.
    fn score(&self, at: &Sighting) -> [f64; UNKNOWNS] {
        let mut score: [f64; UNKNOWNS] =
            std::array::from_fn(|i| -(at.rows[0][i] * self.gr[0] + at.rows[1][i] * self.gr[1]));
        score[RADIUS] -= self.hr;
        score
    }
}

/// Finds the projector, the tip and the latency.
///
/// # Errors
/// Each reason of [`SensorError`].
pub fn solve(
    code: &Code,
    decoded: &Decoded,
    path: &Trajectory,
    settings: &Settings,
) -> Result<Solution, SensorError> {
    let seen = prepare(code, decoded, path, settings);
    if seen.len() < FEWEST {
        let seconds = (2 * FEWEST - seen.len()) as f64 * 1e-9 * settings.timing.frame_ns;
        return Err(SensorError::TooFew { frames: seen.len(), seconds: seconds.max(1.0) });
    }
    let middle = (PLANES / 2) as f64;
    let plane_s = 1e-9 * settings.timing.frame_ns / PLANES as f64;
    let times = std::array::from_fn(|p| (p as f64 + decoded.centre - middle) * plane_s);
    let tip_sigma = settings.tip_sigma_m.max(1e-4);
    let problem = Problem { code, path, settings, times, tip_sigma };
    let start = start(&problem, &seen)?;
    let (state, equations, rms_level) = refine(&problem, start, &seen)?;
    finish(&problem, &state, &equations, &seen, rms_level)
}

/// Frames with a pose, away from the raster's border, with their levels over the contrast and the pixel of the bits.
fn prepare(code: &Code, decoded: &Decoded, path: &Trajectory, settings: &Settings) -> Vec<Seen> {
    let Some((first, last)) = path.span_ns() else { return Vec::new() };
    let middle_ns = first / 2 + last / 2;
    let size = DVec2::new(f64::from(code.raster().width()), f64::from(code.raster().height()));
    let seen = |frame: &Frame| {
        let instant = settings.timing.instant(frame.number, (PLANES / 2) as f64);
        let mut levels = [0.0; PLANES];
        for (plane, level) in levels.iter_mut().enumerate() {
            let (off, on) = frame.references(plane);
            *level = (f64::from(frame.levels[plane]) - off) / (on - off);
        }
        let pixel = pixel_of_bits(code, &levels);
        let inside = pixel.cmpge(DVec2::splat(BORDER_PX)).all() && pixel.cmple(size - BORDER_PX).all();
        let from_middle_s = 1e-9 * instant.0.saturating_sub(middle_ns) as f64;
        inside.then(|| Seen { instant, from_middle_s, levels, contrast: frame.contrast(), pixel })
    };
    // Whatever the latency is, there must be a pose.
    let reach = (1e9 * MOST_LATENCY_S) as i64;
    let known = |s: &Seen| {
        s.instant.0 - reach > first && s.instant.0 + reach < last && path.at(s.instant.0, 0.0).is_some()
    };
    decoded.frames.iter().filter_map(seen).filter(known).collect()
}

/// Gray bits into the middle of a stripe.
fn pixel_of_bits(code: &Code, levels: &[f64; PLANES]) -> DVec2 {
    let (mut stripe, mut last, mut finest) = ([0u32; 2], [0u32; 2], [1u32; 2]);
    for (plane, level) in levels.iter().enumerate() {
        let (axis, width) = match code.role(plane) {
            Role::Column { width } => (0, width),
            Role::Row { width } => (1, width),
            _ => continue,
        };
        last[axis] ^= u32::from(*level > 0.5);
        stripe[axis] = stripe[axis] << 1 | last[axis];
        finest[axis] = width;
    }
    let middle = |axis: usize| (f64::from(stripe[axis]) + 0.5) * f64::from(finest[axis]);
    DVec2::new(middle(0), middle(1))
}

/// Every n-th frame, so that about `most` are left.
fn thin(seen: &[Seen], most: usize) -> impl Iterator<Item = &Seen> {
    seen.iter().step_by(seen.len().div_ceil(most).max(1))
}

/// From the pixels of the bits, with the tip of the pivot and no latency, then with both free.
fn start(problem: &Problem, seen: &[Seen]) -> Result<State, SensorError> {
    let (code, settings) = (problem.code, problem.settings);
    let place = |s: &Seen| problem.path.at(s.instant.0, 0.0).map(|p| p.position + p.rotation * settings.tip);
    let sights: Vec<Sight> =
        thin(seen, 120).filter_map(|s| Some(Sight::at_rest(place(s)?, s.pixel))).collect();
    let [_, second, third] = spread_of(&sights);
    if third < 0.05 * second {
        return Err(Refusal::Planar { off_plane_mm: 1e3 * third }.into());
    }
    let pairs: Vec<Pair> = sights.iter().map(|s| Pair { world: s.world, pixel: s.pixel }).collect();
    // A latency of 8 ms is a dozen pixels at a metre a second.
    let options =
        CalibrationOptions { inlier_px: Some(0.03 * f64::from(code.raster().width())), seed: settings.seed };
    let all = CalibrationOptions { inlier_px: None, ..options };
    let found = calibrate(code.raster(), &pairs, &options).or_else(|e| {
        // A mirror image has no consensus; all points together say that it is one.
        match calibrate(code.raster(), &pairs, &all) {
            Err(CalibrationError::Mirrored) => Err(CalibrationError::Mirrored),
            _ => Err(e),
        }
    });
    let camera = found.map_err(Refusal::from)?.camera;
    let origin = sights.iter().map(|s| s.world).sum::<DVec3>() / sights.len() as f64;
    let mut state = State {
        model: ProjectorModel::from_camera(&camera, [0.0; 5], origin),
        tip: settings.tip,
        latency_s: 0.0,
        drift: 0.0,
        radius_m: 0.5 * settings.aperture_m,
    };
    let few: Vec<Seen> = thin(seen, 1500).map(Seen::copy).collect();
    for sigma_px in [6.0, 1.5] {
        let equations = |s: &State| problem.from_bits(s, &few, sigma_px);
        let cost = |s: &State| equations(s).map_or(f64::INFINITY, |e| e.cost);
        let found = descend(state, 40, equations, cost, |s: &State, d: &[f64]| s.step(d));
        state = found.ok_or(Refusal::NotConverged { rms_px: f64::INFINITY })?.state;
    }
    let miss = |s: &Seen| problem.sight(&state, s).map(|at| (at.pixel - s.pixel).length());
    let px = percentile(few.iter().filter_map(miss).collect(), 0.5);
    if px > 6.0 {
        return Err(SensorError::DoesNotFit { px });
    }
    Ok(state)
}

impl Seen {
    fn copy(&self) -> Self {
        Self { ..*self }
    }
}

/// Fits the levels: wide stripes first, since a start that is wrong by a stripe would lock to the wrong one.
fn refine(problem: &Problem, start: State, seen: &[Seen]) -> Result<(State, Equations, f64), SensorError> {
    let few: Vec<Seen> = thin(seen, 3000).map(Seen::copy).collect();
    let mut state = start;
    let mut sigma = 0.15;
    let failed = Refusal::NotConverged { rms_px: f64::INFINITY };
    let mut last = None;
    for (finest, all) in [(8.0, false), (3.0, false), (0.0, false), (0.0, true)] {
        let frames = if all { seen } else { &few };
        let found = descend(
            state,
            30,
            |s: &State| problem.from_levels(s, frames, sigma, finest),
            |s: &State| problem.cost_of_levels(s, frames, sigma, finest),
            |s: &State, d: &[f64]| s.step(d),
        )
        .ok_or(failed.clone())?;
        state = found.state;
        // The deviation of the levels on the slopes of stripes is what the next weights are made of.
        let each = frames.iter().filter_map(|f| Some(problem.frame(&problem.sight(&state, f)?, f, 1.0, 0.0)));
        let (squares, count) = each.fold((0.0, 0.0), |a, s| (a.0 + s.rr, a.1 + s.count));
        let rms = (squares / f64::max(count, 1.0)).sqrt();
        sigma = rms.clamp(0.005, 0.15);
        last = Some((found.equations, rms));
    }
    let (equations, rms) = last.ok_or(failed)?;
    Ok((state, equations, rms))
}

fn finish(
    problem: &Problem,
    state: &State,
    equations: &Equations,
    seen: &[Seen],
    rms_level: f64,
) -> Result<Solution, SensorError> {
    let settings = problem.settings;
    let sigma = rms_level.clamp(0.005, 0.15);
    let mut scores: Vec<(i64, [f64; UNKNOWNS])> = Vec::new();
    let (mut brightness, mut depths, mut misses) = (Vec::new(), Vec::new(), Vec::new());
    let position = state.model.position();
    for frame in seen {
        let Some(at) = problem.sight(state, frame) else { continue };
        let sums = problem.frame(&at, frame, sigma, 0.0);
        let block = (frame.from_middle_s / BLOCK_S).floor() as i64;
        let score = sums.score(&at);
        match scores.last_mut().filter(|(b, _)| *b == block) {
            Some((_, sum)) => sum.iter_mut().zip(&score).for_each(|(a, b)| *a += b),
            None => scores.push((block, score)),
        }
        // The step of this frame alone, in pixels.
        (0..2).filter(|k| sums.gg[*k] > 1.0).for_each(|k| misses.push((sums.gr[k] / sums.gg[k]).powi(2)));
        let shift = (1e9 * (state.latency_s + state.drift * frame.from_middle_s)) as i64;
        let Some(pose) = problem.path.at(frame.instant.0 + shift, 0.0) else { continue };
        let tip = pose.position + pose.rotation * state.tip;
        depths.push(state.model.local(tip).z);
        let away = position - tip;
        brightness.push(Brightness {
            pixel: at.pixel,
            distance_m: away.length(),
            towards: pose.rotation.conjugate() * away.normalize_or_zero(),
            level: frame.contrast,
        });
    }
    let rms_px = (misses.iter().sum::<f64>() / misses.len().max(1) as f64).sqrt();
    if rms_px > 2.5 {
        return Err(SensorError::DoesNotFit { px: rms_px });
    }
    check_result(problem.code.raster(), &state.model, &depths, &settings.known)?;
    let mut expected = Equations::new(UNKNOWNS);
    problem.expect(state, &mut expected);
    let covariance = sandwich(equations, &expected, &scores).ok_or(Refusal::NotConverged { rms_px })?;
    if state.latency_s.abs() > 0.9 * MOST_LATENCY_S {
        return Err(SensorError::LatencyAtBound { ms: 1e3 * state.latency_s });
    }
    let latency_sigma_ns = 1e9 * covariance[LATENCY][LATENCY].sqrt();
    if latency_sigma_ns > 1e3 * MOST_LATENCY_SIGMA_US {
        return Err(SensorError::LatencyUncertain { us: 1e-3 * latency_sigma_ns });
    }
    let of_tip = |i: usize| DVec3::from_array(std::array::from_fn(|j| covariance[TIP + i][TIP + j]));
    let points = settings.volume.points(&state.model, problem.code.raster());
    let model_covariance: Vec<Vec<f64>> =
        covariance[..PARAMETERS].iter().map(|row| row[..PARAMETERS].to_vec()).collect();
    Ok(Solution {
        model: state.model,
        predicted: predict(&state.model, &model_covariance, &points),
        covariance: model_covariance,
        tip: state.tip,
        tip_covariance: DMat3::from_cols(of_tip(0), of_tip(1), of_tip(2)),
        latency_ns: (1e9 * state.latency_s).round() as i64,
        latency_sigma_ns,
        drift_ppm: 1e6 * state.drift,
        aperture_m: 2.0 * state.radius_m,
        frames: brightness.len(),
        rms_level,
        rms_px,
        brightness,
    })
}

/// Inverse of the second derivatives, times the covariance of the scores by block and of the expectations, times the
/// inverse again.
fn sandwich(
    equations: &Equations,
    expected: &Equations,
    scores: &[(i64, [f64; UNKNOWNS])],
) -> Option<Vec<Vec<f64>>> {
    let inverse = inverse_spd(&equations.matrix())?;
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
