//! Frames into a state from which the levels can be fitted: pixels from the bits, a pinhole, then tip and latency.

use super::code::{Code, Role, PLANES};
use super::decode::{Decoding, SensorFrame};
use super::fit::{SensorError, Settings, MOST_LATENCY_S};
use super::problem::{Fix, FrameFix, Moment, Planes, SensorProblem, SensorUnknowns};
use crate::least_squares::descend;
use crate::model::ProjectorModel;
use crate::pinhole::{calibrate, CalibrationError, CalibrationOptions, Pair};
use crate::projector::{look_for_motion, percentile, spread_of, Options, PointsRefusal, Sight};
use crate::trajectory::Trajectory;
use dpm_device::planes::Raster;
use glam::{DVec2, DVec3};

/// Frames nearer than this to the raster's border, pixels, see only a part of the stripes.
const BORDER_PX: f64 = 10.0;

/// Frames with a pose, away from the raster's border, with their levels over the contrast and the pixel of the bits.
pub(super) fn prepare<'a>(
    planes: &'a Planes<'a>,
    decoded: &Decoding,
    path: &Trajectory,
    settings: &Settings,
) -> Vec<FrameFix<'a>> {
    let Some((first, last)) = path.span_ns() else { return Vec::new() };
    let middle_ns = first / 2 + last / 2;
    let seen = |frame: &SensorFrame| {
        let instant = settings.timing.instant(frame.number, (PLANES / 2) as f64);
        let levels = over_contrast(frame);
        let pixel = pixel_of_bits(planes.code, &levels);
        let from_middle_s = 1e-9 * instant.0.saturating_sub(middle_ns) as f64;
        let fix = Fix { moment: Moment { instant, from_middle_s }, pixel };
        is_inside(planes.code.raster(), pixel).then(|| FrameFix {
            planes,
            fix,
            levels,
            contrast: frame.contrast(),
        })
    };
    // Whatever the latency is, there must be a pose.
    let reach = (1e9 * MOST_LATENCY_S) as i64;
    let known = |s: &FrameFix| {
        let at = s.fix.moment.instant.0;
        at - reach > first && at + reach < last && path.at(at, 0.0).is_some()
    };
    decoded.frames.iter().filter_map(seen).filter(known).collect()
}

/// Whether all stripes around a pixel lie on the raster.
pub(super) fn is_inside(raster: Raster, pixel: DVec2) -> bool {
    let size = DVec2::new(f64::from(raster.width()), f64::from(raster.height()));
    pixel.cmpge(DVec2::splat(BORDER_PX)).all() && pixel.cmple(size - BORDER_PX).all()
}

/// Levels of the planes, 0 for darkness and 1 for full light.
fn over_contrast(frame: &SensorFrame) -> [f64; PLANES] {
    std::array::from_fn(|plane| {
        let (off, on) = frame.references(plane);
        (f64::from(frame.levels[plane]) - off) / (on - off)
    })
}

/// The pixel that the bits of a frame name, good to a few.
pub(super) fn pixel_of(code: &Code, frame: &SensorFrame) -> DVec2 {
    pixel_of_bits(code, &over_contrast(frame))
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
pub(super) fn thin<T>(seen: &[T], most: usize) -> impl Iterator<Item = &T> {
    seen.iter().step_by(seen.len().div_ceil(most).max(1))
}

/// Points of the wand and the pixels of their bits, for poses that are stamped `offset_ns` later than the light.
fn sights(problem: &SensorProblem, seen: &[Fix], most: usize, offset_ns: i64) -> Vec<Sight> {
    let place = |s: &Fix| {
        let pose = problem.path.at(s.moment.instant.0.saturating_add(offset_ns), 0.0)?;
        Some(pose.position + pose.rotation * problem.settings.tip)
    };
    thin(seen, most).filter_map(|s| Some(Sight::at_rest(place(s)?, s.pixel))).collect()
}

fn pairs(sights: &[Sight]) -> Vec<Pair> {
    sights.iter().map(|s| Pair { world: s.world, pixel: s.pixel }).collect()
}

/// A pinhole from the pixels of the bits, with the tip of the pivot and no latency.
fn pinhole(problem: &SensorProblem, seen: &[Fix]) -> Result<ProjectorModel, SensorError> {
    let raster = problem.raster;
    let sights = sights(problem, seen, 120, 0);
    let [_, second, third] = spread_of(&sights);
    if third < 0.05 * second {
        return Err(PointsRefusal::Planar { off_plane_mm: 1e3 * third }.into());
    }
    let pairs = pairs(&sights);
    // A latency of 8 ms is a dozen pixels at a metre a second.
    let threshold = 0.03 * f64::from(raster.width());
    let options = CalibrationOptions { inlier_px: Some(threshold), seed: problem.settings.seed };
    let found = match calibrate(raster, &pairs, &options) {
        Ok(found) => found,
        Err(e) => return Err(why_no_pinhole(problem, seen, &pairs, e)),
    };
    let origin = sights.iter().map(|s| s.world).sum::<DVec3>() / sights.len() as f64;
    Ok(ProjectorModel::from_camera(&found.camera, [0.0; 5], origin))
}

/// Why pairs have no consensus: a mirror, a motion between them, or clocks that are far apart.
fn why_no_pinhole(problem: &SensorProblem, seen: &[Fix], pairs: &[Pair], e: CalibrationError) -> SensorError {
    let raster = problem.raster;
    let options = CalibrationOptions { inlier_px: Some(0.03 * f64::from(raster.width())), seed: 1 };
    let mirrored: Vec<Pair> =
        pairs.iter().map(|p| Pair { world: p.world * DVec3::new(-1.0, 1.0, 1.0), ..*p }).collect();
    if e == CalibrationError::Mirrored || calibrate(raster, &mirrored, &options).is_ok() {
        return PointsRefusal::Mirrored.into();
    }
    late(problem, seen).unwrap_or_else(|| PointsRefusal::from(e).into())
}

/// Whether poses that are some tens of milliseconds off, up to a second, explain the data.
fn late(problem: &SensorProblem, seen: &[Fix]) -> Option<SensorError> {
    let raster = problem.raster;
    let all = CalibrationOptions { inlier_px: None, seed: 1 };
    let rms = |ms: i64| {
        let sights = sights(problem, seen, 60, ms * 1_000_000);
        calibrate(raster, &pairs(&sights), &all).map_or(f64::INFINITY, |c| c.rms_px)
    };
    let tried = (-50..=50).map(|i| (rms(20 * i), 20 * i));
    let (best, ms) = tried.min_by(|a, b| a.0.total_cmp(&b.0))?;
    // Of a wand that rests, any offset within the rest explains as much as none.
    let is_better = best < 0.5 * rms(0) && ms.unsigned_abs() >= 40;
    let explains = best < 0.015 * f64::from(raster.width()) && is_better;
    explains.then_some(SensorError::LatencyAtBound { ms: ms as f64 })
}

/// Why levels do not fit: something moved during the sweep, or a reason that is not known.
pub(super) fn why_no_fit(
    problem: &SensorProblem,
    seen: &[Fix],
    state: &SensorUnknowns,
    px: f64,
) -> SensorError {
    let sights = sights(problem, seen, 80, (1e9 * state.latency_s) as i64);
    let raster = problem.raster;
    let options = Options { aim_px: 1.0, ..Options::by_hand(raster) };
    match look_for_motion(raster, &sights, &options) {
        Some(moved) => moved.into(),
        None => late(problem, seen).unwrap_or(SensorError::DoesNotFit { px }),
    }
}

/// A state that is good to a pixel: from the pixels of the bits, with tip and latency free.
pub(super) fn start(problem: &SensorProblem, seen: &[Fix]) -> Result<SensorUnknowns, SensorError> {
    let (state, px) = from_bits(problem, seen, pinhole(problem, seen)?)?;
    if px > MOST_START_PX {
        return Err(why_no_fit(problem, seen, &state, px));
    }
    Ok(state)
}

/// Frames that suffice for a start.
const FEW: usize = 1500;
/// Beyond this median, pixels, a start is none.
pub(super) const MOST_START_PX: f64 = 6.0;

/// Fits the pixels of the bits from a model, the tip of the pivot and no latency. Gives the state and the median distance
/// that is left, pixels.
pub(super) fn from_bits(
    problem: &SensorProblem,
    seen: &[Fix],
    model: ProjectorModel,
) -> Result<(SensorUnknowns, f64), SensorError> {
    let settings = problem.settings;
    let radius_m = 0.5 * settings.aperture_m;
    let mut state = SensorUnknowns { model, tip: settings.tip, latency_s: 0.0, drift: 0.0, radius_m };
    let few: Vec<Fix> = thin(seen, FEW).copied().collect();
    for sigma_px in [6.0, 1.5] {
        let equations = |s: &SensorUnknowns| problem.of_bits(s, &few, sigma_px);
        let cost = |s: &SensorUnknowns| equations(s).map_or(f64::INFINITY, |e| e.cost);
        let found = descend(state, 40, equations, cost, |s: &SensorUnknowns, d: &[f64]| s.step(d));
        state = found.ok_or(PointsRefusal::NotConverged { rms_px: f64::INFINITY })?.state;
    }
    let px = miss(problem, &state, &few);
    Ok((state, px))
}

/// The median distance between the pixels of the bits and where a state sees them.
pub(super) fn miss(problem: &SensorProblem, state: &SensorUnknowns, seen: &[Fix]) -> f64 {
    let one = |s: &Fix| problem.sight(state, &s.moment).map(|at| (at.pixel - s.pixel).length());
    percentile(seen.iter().filter_map(one).collect(), 0.5)
}
