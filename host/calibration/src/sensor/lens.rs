//! How much of a lens the levels tell: terms that were asked for must be more than noise, and where no light was seen near
//! the raster's border, the lens there is expected to be a usual one.

use super::fit::{finish, refine, FitState, SensorError, Settings, Solution};
use super::problem::{Fix, Measured, SensorProblem, SensorUnknowns};
use crate::model::ProjectorModel;
use crate::projector::{check_terms, moved_px, predict, LensTerms, PointsRefusal};
use glam::DVec2;

/// A lens is open if the light in the raster's corners is uncertain by more than this share of the raster's width.
const MOST_OPEN: f64 = 0.01;

/// A fit into what is told of it, with the lens that the data tell.
///
/// # Errors
/// Each reason of [`SensorError`].
pub(super) fn finish_told<M: Measured>(
    problem: &SensorProblem,
    fitted: &FitState,
    (seen, fixes): (&[M], &[Fix]),
    stages: &[(f64, bool)],
) -> Result<Solution, SensorError> {
    let solution = finish(problem, fitted, (seen, fixes))?;
    let priors = problem.settings.priors;
    if priors.is_beyond_brown() {
        check_folds(problem, &solution)?;
        let settings = Settings { priors: priors.with_lens(LensTerms::Brown), ..*problem.settings };
        let brown = with(problem, &settings);
        let simple = refit(&brown, fitted.state, seen, stages).ok().map(|f| f.state.model);
        check_terms(problem.raster, &solution.model, simple, &solution.predicted, &settings.volume)?;
        return Ok(solution);
    }
    let usual =
        is_open(problem, &solution).then(|| usual(problem, &solution, fitted.state, (seen, fixes), stages));
    let solution = usual.flatten().unwrap_or(solution);
    check_folds(problem, &solution)?;
    Ok(solution)
}

/// The same with a usual lens, if this puts the light where the solution does, within what that is uncertain by.
fn usual<M: Measured>(
    problem: &SensorProblem,
    solution: &Solution,
    begun: SensorUnknowns,
    (seen, fixes): (&[M], &[Fix]),
    stages: &[(f64, bool)],
) -> Option<Solution> {
    let settings = Settings { priors: problem.settings.priors.with_usual_lens(), ..*problem.settings };
    let expecting = with(problem, &settings);
    let fitted = refit(&expecting, begun, seen, stages).ok()?;
    let moved = moved_px(problem.raster, &solution.model, &fitted.state.model, &problem.settings.volume);
    if moved > solution.predicted.p99_px {
        return None;
    }
    let usual = finish(&expecting, &fitted, (seen, fixes)).ok()?;
    Some(Solution { is_lens_open: true, ..usual })
}

fn check_folds(problem: &SensorProblem, solution: &Solution) -> Result<(), SensorError> {
    solution.model.camera(problem.raster).map(|_| ()).map_err(|_| PointsRefusal::LensFolds.into())
}

/// Whether the data leave the lens near the raster's border open: it folds there, or its light may be anywhere.
fn is_open(problem: &SensorProblem, solution: &Solution) -> bool {
    let Ok(camera) = solution.model.camera(problem.raster) else { return true };
    let size = DVec2::new(f64::from(problem.raster.width()), f64::from(problem.raster.height()));
    let volume = problem.settings.volume;
    let away = camera.position().distance(0.5 * (volume.low + volume.high));
    let corners = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]].map(|share| {
        let ray = camera.ray(DVec2::from_array(share) * size);
        ray.origin + away * ray.direction
    });
    // NaN is open, too.
    let uncertain = predict(&solution.model, &solution.covariance, &corners).worst_px;
    uncertain.is_nan() || uncertain > MOST_OPEN * size.x
}

/// The problem with other settings.
fn with<'a>(problem: &SensorProblem<'a>, settings: &'a Settings) -> SensorProblem<'a> {
    SensorProblem {
        limits: problem.limits,
        ..SensorProblem::new(problem.raster, (problem.path, settings), false)
    }
}

/// A fit that begins again without distortion.
fn refit<M: Measured>(
    problem: &SensorProblem,
    mut begun: SensorUnknowns,
    seen: &[M],
    stages: &[(f64, bool)],
) -> Result<FitState, SensorError> {
    let pinhole = begun.model.pinhole(problem.raster).map_err(|_| PointsRefusal::LensFolds)?;
    begun.model = ProjectorModel::from_camera(&pinhole, [0.0; 5], begun.model.origin);
    refine(problem, begun, seen, stages)
}
