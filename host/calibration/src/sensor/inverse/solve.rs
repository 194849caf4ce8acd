//! Pairs into projector, tip and latency.
//!
//! Where the wand was held still for a round of the code, its bits name a pixel: enough to start. Then the levels of all
//! pairs are fitted, those in motion too, each frame at its own instant: the latency comes from them.

use super::super::fit::{refine, Scores, SensorError, Settings, Solution, MOST_MISFIT};
use super::super::latency::{self, Latency};
use super::super::lens::finish_told;
use super::super::problem::{
    Fix, LatencyLimits, Measured, Moment, SensorProblem, SensorUnknowns, Tally, RADIUS, UNKNOWNS,
};
use super::super::start::{is_inside, start, thin};
use super::code::{InverseCode, Stripe};
use super::decode::{DecodedPairs, Pair};
use crate::least_squares::{huber, Equations};
use crate::model::ProjectorModel;
use crate::trajectory::{TimedPose, Trajectory};
use glam::DVec3;

/// Fewest pairs: ten seconds at 60 frames a second.
const FEWEST: usize = 300;
/// Fewest places at which the wand was held still.
pub const FEWEST_PLACES: usize = 8;
/// The tip is held still if it moves by no more than this, metres.
const STILL_M: f64 = 2e-3;
/// Rounds of the code within which all stripes must be seen at a place. On a busy machine every other frame may be late;
/// that the wand is still for as long is looked at apart.
const MOST_ROUNDS: u64 = 8;
/// Places that are nearer than this to each other are one, metres.
const APART_M: f64 = 0.03;
/// Latencies of a display and a tracker together, seconds.
const LATENCIES_S: [f64; 2] = [-0.05, 0.3];
/// A display's frame is long: its latency is never known as well as that of planes, microseconds.
const MOST_LATENCY_SIGMA_US: f64 = 1000.0;

/// A pair prepared for the fit.
struct PairFix {
    stripe: Stripe,
    moment: Moment,
    /// Moments of the frame with the stripes and of that with the inverse, and the level of both.
    ticks: Vec<([Moment; 2], f64)>,
    contrast: f64,
}

impl Measured for PairFix {
    fn moment(&self) -> &Moment {
        &self.moment
    }

    fn contrast(&self) -> f64 {
        self.contrast
    }

    fn tally(
        &self,
        problem: &SensorProblem,
        state: &SensorUnknowns,
        sigma: f64,
        finest: f64,
        mut all: Option<&mut Equations>,
    ) -> Option<Tally> {
        let (mut gg, mut gr) = ([0.0; 2], [0.0; 2]);
        let (mut loss, mut squares, mut count, mut score) = (0.0, 0.0, 0.0, [0.0; UNKNOWNS]);
        let axis = self.stripe.axis;
        let is_fine = f64::from(self.stripe.width) < finest;
        for (moments, level) in self.ticks.iter().filter(|_| !is_fine) {
            let (mut row, mut slope, mut share) = ([0.0; UNKNOWNS], 0.0, 0.0);
            let mut is_clear = true;
            for moment in moments {
                let at = problem.sight(state, moment)?;
                let Some(lit) = self.stripe.on(at.pixel, at.radius) else {
                    is_clear = false;
                    continue;
                };
                let by_place = 0.5 * lit.by_place / sigma;
                share += 0.5 * lit.share;
                slope += by_place;
                row.iter_mut().zip(&at.rows[axis]).for_each(|(r, v)| *r += by_place * v);
                row[RADIUS] += 0.5 * lit.by_radius * at.radius / sigma;
            }
            if !is_clear {
                continue;
            }
            let r = (share - level) / sigma;
            let (weight, of_tick) = huber(r.abs(), 2.0);
            loss += of_tick;
            squares += (r * sigma).powi(2);
            count += 1.0;
            gg[axis] += weight * slope * slope;
            gr[axis] += weight * slope * r;
            score.iter_mut().zip(&row).for_each(|(s, v)| *s -= weight * v * r);
            if let Some(all) = all.as_deref_mut() {
                all.add(&row, r, weight);
            }
        }
        Some(Tally { loss, squares, count, gg, gr, score })
    }
}

/// Finds the projector, the tip and the latency.
///
/// # Errors
/// Each reason of [`SensorError`].
pub fn solve_pairs(
    code: &InverseCode,
    decoded: &DecodedPairs,
    path: &Trajectory,
    settings: &Settings,
) -> Result<Solution, SensorError> {
    let problem = problem(code, path, settings, false);
    let seen = prepare(code, decoded, path)?;
    let fixes = still(code, decoded, path, settings.tip);
    let places = places(&fixes, path, settings.tip);
    if places < FEWEST_PLACES {
        return Err(SensorError::TooFewPlaces { places, need: FEWEST_PLACES });
    }
    let begun = with_latency(&problem, start(&problem, &fixes)?, &seen);
    let fitted = refine(&problem, begun, &seen, &stages(code))?;
    finish_told(&problem, &fitted, (&seen, &fixes), &stages(code))
}

/// Finds the latency of a projector that is known.
///
/// # Errors
/// As [`super::super::solve_latency`].
pub fn solve_latency_of_pairs(
    code: &InverseCode,
    decoded: &DecodedPairs,
    path: &Trajectory,
    settings: &Settings,
    model: &ProjectorModel,
) -> Result<Latency, SensorError> {
    let problem = problem(code, path, settings, true);
    let seen = prepare(code, decoded, path)?;
    let radius_m = 0.5 * settings.aperture_m;
    let held = SensorUnknowns { model: *model, tip: settings.tip, latency_s: 0.0, drift: 0.0, radius_m };
    let fitted = refine(&problem, with_latency(&problem, held, &seen), &seen, &stages(code))?;
    if fitted.rms_level > MOST_MISFIT {
        let mut scores = Scores::default();
        let tallies = seen.iter().filter_map(|s| s.tally(&problem, &fitted.state, fitted.sigma(), 0.0, None));
        tallies.for_each(|tally| scores.add(0.0, &tally));
        return Err(SensorError::OtherProjector { px: scores.rms_px() });
    }
    latency::finish(&problem, &fitted, &seen)
}

/// How many places the wand was held still at for `hold_s` seconds: what a sweep lacks can be said while it goes on.
pub fn places_rested(poses: &[TimedPose], tip: DVec3, hold_s: f64) -> usize {
    let mut found: Vec<DVec3> = Vec::new();
    let mut from = 0;
    for (i, pose) in poses.iter().enumerate() {
        let at = pose.place(tip);
        if poses[from].place(tip).distance(at) > STILL_M {
            from = i;
        }
        let held = pose.stamp_ns.saturating_sub(poses[from].stamp_ns);
        if held as f64 >= 1e9 * hold_s {
            add_place(&mut found, at);
        }
    }
    found.len()
}

fn problem<'a>(
    code: &InverseCode,
    path: &'a Trajectory,
    settings: &'a Settings,
    is_held: bool,
) -> SensorProblem<'a> {
    let limits = LatencyLimits { latency_s: LATENCIES_S[1], latency_sigma_us: MOST_LATENCY_SIGMA_US };
    SensorProblem { limits, ..SensorProblem::new(code.raster(), (path, settings), is_held) }
}

/// The narrowest stripes of each stage: in motion a start may be a dozen pixels off.
fn stages(code: &InverseCode) -> [(f64, bool); 5] {
    let side = f64::from(code.raster().width());
    [(side / 32.0, false), (side / 80.0, false), (4.0, false), (0.0, false), (0.0, true)]
}

fn moment(path: &Trajectory, middle_ns: i64, ns: f64) -> Option<Moment> {
    let at = ns.floor();
    path.at(at as i64, 0.0)?;
    let from_middle_s = 1e-9 * (at - middle_ns as f64);
    Some(Moment { instant: (at as i64, ns - at), from_middle_s })
}

/// Pairs with a pose.
fn prepare(
    code: &InverseCode,
    decoded: &DecodedPairs,
    path: &Trajectory,
) -> Result<Vec<PairFix>, SensorError> {
    let few = |frames: usize| {
        let seconds = 2.0 * (2 * FEWEST - frames.min(FEWEST)) as f64 * 1e-9 * decoded.frame_ns;
        SensorError::TooFew { frames, need: FEWEST, seconds: seconds.max(1.0) }
    };
    let (first, last) = path.span_ns().ok_or_else(|| few(0))?;
    let middle_ns = first / 2 + last / 2;
    let [early, late] = LATENCIES_S.map(|s| (1e9 * s) as i64);
    let seen = |pair: &Pair| {
        let tick = |(i, level): (usize, &Option<f64>)| {
            let at = |begin: i64| moment(path, middle_ns, begin as f64 + decoded.instants_ns[i]);
            let [a, b] = pair.begins_ns.map(at);
            Some(([a?, b?], (*level)?))
        };
        let [a, b] = pair.begins_ns;
        let (from, until) = (a.min(b), a.max(b) + decoded.frame_ns as i64);
        // Whatever the latency is, there must be a pose.
        if from + early <= first || until + late >= last {
            return None;
        }
        let ticks: Vec<([Moment; 2], f64)> = pair.levels.iter().enumerate().filter_map(tick).collect();
        let moment = moment(path, middle_ns, 0.5 * (from as f64 + until as f64))?;
        let stripe = code.stripe(code.index(pair.number));
        (!ticks.is_empty()).then_some(PairFix { stripe, moment, ticks, contrast: pair.contrast })
    };
    let seen: Vec<PairFix> = decoded.pairs.iter().filter_map(seen).collect();
    match seen.len() {
        n if n < FEWEST => Err(few(n)),
        _ => Ok(seen),
    }
}

/// Moments at which the wand was held still until all stripes had been seen, with the pixel of their bits.
fn still(code: &InverseCode, decoded: &DecodedPairs, path: &Trajectory, tip: DVec3) -> Vec<Fix> {
    let Some((first, last)) = path.span_ns() else { return Vec::new() };
    let middle_ns = first / 2 + last / 2;
    let (mut fixes, mut from) = (Vec::new(), 0);
    while from < decoded.pairs.len() {
        let pairs = &decoded.pairs[from..];
        from += 1;
        let Some((count, is_lit)) = whole_round(code, pairs) else { continue };
        let (a, b) = (pairs[0].begins_ns, pairs[count - 1].begins_ns);
        let (begin, end) = (a[0].min(a[1]), b[0].max(b[1]) + decoded.frame_ns as i64);
        if !is_still(path, tip, [begin, end]) {
            continue;
        }
        let pixel = code.pixel(&is_lit);
        if is_inside(code.raster(), pixel) {
            let at = begin / 2 + end / 2;
            let from_middle_s = 1e-9 * at.saturating_sub(middle_ns) as f64;
            fixes.push(Fix { moment: Moment { instant: (at, 0.0), from_middle_s }, pixel });
        }
        // Half a round further on, half of the bits are new.
        from += count / 2;
    }
    fixes
}

/// The first pairs among which are all stripes: how many they are, and which stripes were lit. A pair that was lost is
/// waited for in the next rounds, but not for ever.
fn whole_round(code: &InverseCode, pairs: &[Pair]) -> Option<(usize, Vec<bool>)> {
    let round = code.pairs();
    let first = pairs.first()?.number;
    // Sums of how far each stripe's levels are from the middle.
    let mut seen: Vec<Option<f64>> = vec![None; round];
    let mut missing = round;
    for (i, pair) in pairs.iter().enumerate() {
        if pair.number - first >= MOST_ROUNDS * round as u64 {
            return None;
        }
        let sum = &mut seen[code.index(pair.number)];
        missing -= usize::from(sum.is_none());
        *sum = Some(sum.unwrap_or(0.0) + pair.level() - 0.5);
        if missing == 0 {
            return Some((i + 1, seen.into_iter().map(|sum| sum.is_some_and(|s| s > 0.0)).collect()));
        }
    }
    None
}

/// Whether the tip stayed in its place from the first instant to the last one, whatever the latency is.
fn is_still(path: &Trajectory, tip: DVec3, [begin, end]: [i64; 2]) -> bool {
    let [early, late] = LATENCIES_S.map(|s| (1e9 * s) as i64);
    let (from, until) = (begin + early, end + late);
    let place = |ns: i64| path.at(ns, 0.0).map(|p| p.position + p.rotation * tip);
    let places: Option<Vec<DVec3>> = (0..=8).map(|i| place(from + (until - from) / 8 * i)).collect();
    places.is_some_and(|places| places.iter().all(|p| p.distance(places[4]) <= STILL_M))
}

fn places(fixes: &[Fix], path: &Trajectory, tip: DVec3) -> usize {
    let mut found: Vec<DVec3> = Vec::new();
    for fix in fixes {
        let Some(pose) = path.at(fix.moment.instant.0, 0.0) else { continue };
        add_place(&mut found, pose.position + pose.rotation * tip);
    }
    found.len()
}

fn add_place(found: &mut Vec<DVec3>, at: DVec3) {
    if found.iter().all(|p| p.distance(at) > APART_M) {
        found.push(at);
    }
}

/// The latency at which wide stripes fit best: in motion it is worth a hundred pixels.
fn with_latency(problem: &SensorProblem, begun: SensorUnknowns, seen: &[PairFix]) -> SensorUnknowns {
    let few: Vec<&PairFix> = thin(seen, 500).collect();
    let finest = f64::from(problem.raster.width()) / 16.0;
    let step = 0.004;
    let count = ((LATENCIES_S[1] - LATENCIES_S[0]) / step) as u32;
    let tried =
        (0..=count).map(|i| SensorUnknowns { latency_s: LATENCIES_S[0] + step * f64::from(i), ..begun });
    let scored = tried.map(|s| (problem.cost_of_levels(&s, &few, (0.15, finest)), s));
    scored.min_by(|a, b| a.0.total_cmp(&b.0)).map_or(begun, |(_, state)| state)
}
