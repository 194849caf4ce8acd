//! Points into a projector: start, least squares, wrong points, and everything that makes the result worthless.

use super::fit::{Task, OFFSET};
use super::refusal::{check_distance, check_up};
use super::uncertainty::{percentile, predict, Volume};
use super::{
    fit, middle, misses, spread_of, Fit, LensTerms, Options, PlaceHint, PointsRefusal, Priors, Sight,
};
use crate::model::{ProjectorModel, INTRINSICS};
use crate::pinhole::{calibrate, CalibrationError, CalibrationOptions, Pair};
use dpm_calibration_file::LightError;
use dpm_common::so3::so3_log;
use dpm_device::planes::Raster;
use glam::{DQuat, DVec2, DVec3};

/// A projector, and how far to trust it.
#[derive(Clone, Debug)]
pub struct ProjectorFit {
    /// Lens and pose.
    pub model: ProjectorModel,
    /// Covariance of its numbers.
    pub covariance: Vec<Vec<f64>>,
    /// The error that the light may have over the volume.
    pub predicted: LightError,
    /// Root mean square residual of the points used, along one axis, pixels.
    pub rms_px: f64,
    /// Which points were used.
    pub inliers: Vec<bool>,
    /// What had to be added to the times of the points, seconds, and its deviation; where points moved.
    pub offset_s: Option<[f64; 2]>,
    /// Remarks for the operator, one sentence each.
    pub notes: Vec<String>,
}

/// Points of a moving wand must be faster than this to show an offset in time, metres a second.
const MOVING_M_S: f64 = 0.05;
/// An offset in time beyond this is no latency, seconds.
const MOST_OFFSET_S: f64 = 0.03;
/// A light that is more uncertain than this is refused, pixels.
const MOST_UNCERTAIN_PX: f64 = 10.0;
/// Thinnest cloud of points, as a share of its second extent.
const THINNEST: f64 = 0.05;
/// Least range of depths over their mean.
const LEAST_DEPTH: f64 = 0.10;

/// Finds the projector that lights the given points by the given pixels.
///
/// # Errors
/// Each reason of [`PointsRefusal`].
pub fn solve(
    raster: Raster,
    sights: &[Sight],
    options: &Options,
    volume: &Volume,
) -> Result<ProjectorFit, PointsRefusal> {
    check_numbers(raster, sights, 6)?;
    let [_, second, third] = spread_of(sights);
    if third < THINNEST * second {
        return Err(PointsRefusal::Planar { off_plane_mm: 1e3 * third });
    }
    let moving = sights.iter().filter(|s| s.velocity.length() > MOVING_M_S).count() >= 6;
    let task = Task { priors: &options.priors, focal: true, offset: moving, sigma_px: options.aim_px };
    let (start, consensus) = match start(raster, sights, options) {
        Ok(start) => start,
        Err(CalibrationError::NoConsensus { inliers, pairs, .. }) => {
            // What agrees in a mirror and not outside it is a mirror image.
            let mirror = |s: &Sight| Sight { world: s.world * DVec3::new(-1.0, 1.0, 1.0), ..*s };
            if start(raster, &sights.iter().map(mirror).collect::<Vec<_>>(), options).is_ok() {
                return Err(PointsRefusal::Mirrored);
            }
            return Err(look_for_motion(raster, sights, options)
                .unwrap_or(PointsRefusal::NoConsensus { inliers, points: pairs }));
        }
        Err(e) => return Err(e.into()),
    };
    let (start, consensus) = match options.priors.is_beyond_brown() {
        true => near_brown(raster, &start, sights, consensus, &task)?,
        false => (start, consensus),
    };
    let (fitted, inliers) = fit_inliers(&start, sights, consensus, &task)?;
    let outliers = inliers.iter().filter(|i| !**i).count();
    if outliers >= 4 || fitted.rms_px > 3.0 * options.aim_px {
        if let Some(moved) = look_for_motion(raster, sights, options) {
            return Err(moved);
        }
    }
    let solved = judge(raster, sights, &fitted, inliers.clone(), options, volume, moving)?;
    if options.priors.is_beyond_brown() {
        let priors = options.priors.with_lens(LensTerms::Brown);
        let simple = fit(&start, &chosen(sights, &inliers), &Task { priors: &priors, ..task });
        check_terms(raster, &solved.model, simple.map(|f| f.model), &solved.predicted, volume)?;
    }
    Ok(solved)
}

/// Refuses more terms of a lens than the data tell: if they move the light by less than it is uncertain, they are noise.
pub(crate) fn check_terms(
    raster: Raster,
    model: &ProjectorModel,
    simple: Option<ProjectorModel>,
    predicted: &LightError,
    volume: &Volume,
) -> Result<(), PointsRefusal> {
    let Some(simple) = simple else { return Ok(()) };
    let moved_px = moved_px(raster, model, &simple, volume);
    if moved_px > predicted.p99_px {
        return Ok(());
    }
    Err(PointsRefusal::LensUndetermined { moved_px, p99_px: predicted.p99_px })
}

/// How far apart two models light the points of a volume: the 99th percentile, pixels.
pub(crate) fn moved_px(
    raster: Raster,
    model: &ProjectorModel,
    other: &ProjectorModel,
    volume: &Volume,
) -> f64 {
    let points = volume.points(model, raster);
    let moves = points.iter().filter_map(|p| Some((model.project(*p)? - other.project(*p)?).length()));
    percentile(moves.collect(), 0.99)
}

/// Finds the place of a projector whose lens is known, after a bump: from five points or more.
///
/// # Errors
/// Each reason of [`PointsRefusal`].
pub fn relocate(
    raster: Raster,
    before: &ProjectorModel,
    sights: &[Sight],
    options: &Options,
    volume: &Volume,
) -> Result<ProjectorFit, PointsRefusal> {
    check_numbers(raster, sights, 5)?;
    let priors = Priors::held(before);
    let task = Task { priors: &priors, focal: false, offset: false, sigma_px: options.aim_px };
    let all = vec![true; sights.len()];
    let (fitted, inliers) = fit_inliers(before, sights, all, &task)?;
    if fitted.rms_px > 5.0 * options.aim_px.max(0.3) {
        return Err(PointsRefusal::NoConsensus {
            inliers: inliers.iter().filter(|i| **i).count(),
            points: sights.len(),
        });
    }
    let mut solved = judge_uncertainty(raster, sights, &fitted, inliers, options, volume)?;
    let moved = fitted.model.position() - before.position();
    let turn = turn_between(before, &fitted.model);
    solved.notes.push(format!(
        "the projector has moved by {:.1} mm and turned by {turn:.2} deg; its lens is taken as it was",
        1e3 * moved.length()
    ));
    Ok(solved)
}

fn check_numbers(raster: Raster, sights: &[Sight], need: usize) -> Result<(), PointsRefusal> {
    let finite = |s: &Sight| s.world.is_finite() && s.pixel.is_finite() && s.velocity.is_finite();
    if let Some(bad) = sights.iter().position(|s| !finite(s)) {
        return Err(PointsRefusal::NotFinite(bad));
    }
    let size = DVec2::new(f64::from(raster.width()), f64::from(raster.height()));
    // The tip may be aimed at by a line that leaves the raster, but not by much.
    let near = |p: DVec2| p.cmpge(-0.1 * size).all() && p.cmple(1.1 * size).all();
    if let Some(bad) = sights.iter().position(|s| !near(s.pixel)) {
        return Err(PointsRefusal::OutsideRaster(bad));
    }
    if sights.len() < need {
        return Err(PointsRefusal::TooFew { have: sights.len(), need });
    }
    Ok(())
}

/// A pinhole for the beginning: the lens bends the pixels by several, so the threshold is wide.
fn start(
    raster: Raster,
    sights: &[Sight],
    options: &Options,
) -> Result<(ProjectorModel, Vec<bool>), CalibrationError> {
    let pairs: Vec<Pair> = sights.iter().map(|s| Pair { world: s.world, pixel: s.pixel }).collect();
    let threshold = (0.015 * f64::from(raster.width())).max(8.0 * options.aim_px);
    let options = CalibrationOptions { inlier_px: Some(threshold), seed: options.seed };
    // Seven pairs are the sample itself: nothing is left to vote.
    let free = CalibrationOptions { inlier_px: None, ..options };
    let found = calibrate(raster, &pairs, if pairs.len() > 7 { &options } else { &free })?;
    Ok((ProjectorModel::from_camera(&found.camera, [0.0; 5], middle(sights)), found.inliers))
}

/// Brown's lens through the points, and which of them are near it: from the middle alone, which is all that agrees with a
/// pinhole, more terms would lead astray.
fn near_brown(
    raster: Raster,
    start: &ProjectorModel,
    sights: &[Sight],
    consensus: Vec<bool>,
    task: &Task,
) -> Result<(ProjectorModel, Vec<bool>), PointsRefusal> {
    let priors = task.priors.with_lens(LensTerms::Brown);
    let mut model = *start;
    let mut inliers = consensus;
    for share in [0.015, 0.01] {
        let wide = Task { priors: &priors, sigma_px: share / 3.0 * f64::from(raster.width()), ..*task };
        model = fit_inliers(&model, sights, inliers, &wide)?.0.model;
        let off = misses(&model, 0.0, sights);
        inliers = off.iter().map(|m| *m <= share * f64::from(raster.width())).collect();
    }
    Ok((model, inliers))
}

/// The points that are used.
fn chosen(sights: &[Sight], inliers: &[bool]) -> Vec<Sight> {
    sights.iter().zip(inliers).filter(|(_, is_used)| **is_used).map(|(s, _)| *s).collect()
}

/// Fits, leaves out what is far off, and fits again.
fn fit_inliers(
    start: &ProjectorModel,
    sights: &[Sight],
    mut inliers: Vec<bool>,
    task: &Task,
) -> Result<(Fit, Vec<bool>), PointsRefusal> {
    let failed = PointsRefusal::NotConverged { rms_px: f64::INFINITY };
    let mut best = fit(start, &chosen(sights, &inliers), task).ok_or(failed.clone())?;
    for _ in 0..3 {
        let off = misses(&best.model, best.offset_s, sights);
        let usual = percentile(off.iter().copied().filter(|m| m.is_finite()).collect(), 0.5);
        // 1.18 sigma is the median of the length of two normal deviations.
        let threshold = 4.5 * (usual / 1.18).max(task.sigma_px);
        let next: Vec<bool> = off.iter().map(|m| *m <= threshold).collect();
        if next == inliers {
            break;
        }
        inliers = next;
        best = fit(&best.model, &chosen(sights, &inliers), task).ok_or(failed.clone())?;
    }
    if !best.converged {
        return Err(PointsRefusal::NotConverged { rms_px: best.rms_px });
    }
    Ok((best, inliers))
}

/// Whether the points before some instant agree with each other, those after it too, but not both together.
pub(crate) fn look_for_motion(raster: Raster, sights: &[Sight], options: &Options) -> Option<PointsRefusal> {
    let n = sights.len();
    let accept = 3.0 * options.aim_px.max(0.3);
    let splits = (6..n.saturating_sub(3)).step_by((n / 40).max(1));
    let tried = splits.filter_map(|at| {
        let (first, second) = sights.split_at(at);
        // The longer part tells the lens, the shorter one only its own place.
        let (long, short) = if first.len() >= second.len() { (first, second) } else { (second, first) };
        if long.len() < 8 || short.len() < 4 {
            return None;
        }
        let (start, _) = start(raster, long, &Options { seed: 2, ..*options }).ok()?;
        let task = Task { priors: &options.priors, focal: true, offset: false, sigma_px: options.aim_px };
        let a = fit(&start, long, &task)?;
        let priors = Priors::held(&a.model);
        let held = Task { priors: &priors, focal: false, ..task };
        let b = fit(&a.model, short, &held)?;
        let worst = a.rms_px.max(b.rms_px);
        Some((worst, at, a.model, b.model))
    });
    let (worst, at, a, b) = tried.min_by(|a, b| a.0.total_cmp(&b.0))?;
    (worst < accept).then(|| PointsRefusal::Moved {
        last_before: at - 1,
        moved_mm: 1e3 * (a.position() - b.position()).length(),
        turned_deg: turn_between(&a, &b),
    })
}

fn turn_between(a: &ProjectorModel, b: &ProjectorModel) -> f64 {
    so3_log(DQuat::from_mat3(&(a.rotation.transpose() * b.rotation))).length().to_degrees()
}

fn judge(
    raster: Raster,
    sights: &[Sight],
    fitted: &Fit,
    inliers: Vec<bool>,
    options: &Options,
    volume: &Volume,
    moving: bool,
) -> Result<ProjectorFit, PointsRefusal> {
    let model = &fitted.model;
    let depths: Vec<f64> = chosen(sights, &inliers).iter().map(|s| model.local(s.world).z).collect();
    let (mean, range) = check_result(model, &depths, &options.known)?;
    if fitted.offset_s.abs() > MOST_OFFSET_S {
        return Err(PointsRefusal::TimeShifted { offset_ms: 1e3 * fitted.offset_s });
    }
    let mut solved = judge_uncertainty(raster, sights, fitted, inliers, options, volume)?;
    if moving {
        let deviation = fitted.covariance[OFFSET][OFFSET].sqrt();
        solved.offset_s = Some([fitted.offset_s, deviation]);
        if fitted.offset_s.abs() > 5.0 * deviation.max(1e-4) {
            let ms = 1e3 * fitted.offset_s;
            solved.notes.push(format!("time-shifted: the points are late by {ms:.2} ms; corrected"));
        }
    }
    if range < 0.25 * mean {
        let share = 100.0 * range / mean;
        solved.notes.push(format!("the depths differ by {share:.0} % of the distance only; 25 % are good"));
    }
    Ok(solved)
}

/// Judges a projector by the depths of its points, and by what is known of its place. Gives the mean of the depths and
/// their range.
pub(crate) fn check_result(
    model: &ProjectorModel,
    depths: &[f64],
    known: &PlaceHint,
) -> Result<(f64, f64), PointsRefusal> {
    let mean = depths.iter().sum::<f64>() / depths.len().max(1) as f64;
    let range = percentile(depths.to_vec(), 1.0) - percentile(depths.to_vec(), 0.0);
    check_distance(mean, known.distance_m)?;
    if range < LEAST_DEPTH * mean {
        return Err(PointsRefusal::OneDepth { share: 100.0 * range / mean });
    }
    check_up(model.world_from_projector().matrix3.y_axis, known.up)?;
    Ok((mean, range))
}

fn judge_uncertainty(
    raster: Raster,
    sights: &[Sight],
    fitted: &Fit,
    inliers: Vec<bool>,
    options: &Options,
    volume: &Volume,
) -> Result<ProjectorFit, PointsRefusal> {
    if fitted.model.camera(raster).is_err() {
        return Err(PointsRefusal::LensFolds);
    }
    // The residuals of few points say little of the noise: what is expected counts as ten more of them.
    let used = inliers.iter().filter(|i| **i).count() as f64;
    let free = fitted.covariance.iter().enumerate().filter(|(i, row)| row[*i] > 0.0).count() as f64;
    let degrees = (2.0 * used - free).max(0.0);
    let squares = 2.0 * used * fitted.rms_px.powi(2) + 10.0 * options.aim_px.powi(2);
    let inflate = squares / (degrees + 10.0) / options.aim_px.powi(2);
    let covariance: Vec<Vec<f64>> =
        fitted.covariance.iter().map(|row| row.iter().map(|v| v * inflate).collect()).collect();
    let predicted = predict(&fitted.model, &covariance, &volume.points(&fitted.model, raster));
    if predicted.p99_px > MOST_UNCERTAIN_PX {
        let DVec3 { x, y, z } = predicted.worst;
        return Err(PointsRefusal::Uncertain {
            p99_px: predicted.p99_px,
            most_px: MOST_UNCERTAIN_PX,
            x,
            y,
            z,
        });
    }
    let mut notes = Vec::new();
    let wrong: Vec<String> =
        (0..sights.len()).filter(|i| !inliers[*i]).take(10).map(|i| i.to_string()).collect();
    if !wrong.is_empty() {
        notes.push(format!("left out as wrong: point {}", wrong.join(", ")));
    }
    let free_focal = fitted.covariance[..INTRINSICS].iter().any(|row| row.iter().any(|v| *v > 0.0));
    if free_focal && covariance[0][0].sqrt() > 0.05 {
        let share = 100.0 * covariance[0][0].sqrt();
        notes.push(format!("the focal length is uncertain by {share:.0} %: add points nearer and farther"));
    }
    Ok(ProjectorFit {
        model: fitted.model,
        covariance,
        predicted,
        rms_px: fitted.rms_px,
        inliers,
        offset_s: None,
        notes,
    })
}
