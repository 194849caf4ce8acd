//! One camera that looks at coded light on anything, into lens and pose of the projector.
//!
//! Each pixel of the camera that was decoded gives a ray and the projector's pixel that lights the end of it. How far away
//! that end is nobody says, so what counts is the distance of the projector's pixel from the picture of the ray. Rays that
//! end on printed tags, whose size is known, say how long a metre is and, with what lies off their planes, where the axis
//! leaves and how wide the lens is. Data that would give a wrong projector are refused by name ([`ViewRefusal`]).

mod code;
mod fit;
mod refusal;
mod rest;
mod start;

#[cfg(test)]
mod tests;

pub use code::{CodedPixel, ViewCode};
pub use refusal::ViewRefusal;
pub use rest::check_rest;

use crate::board::{off_plane_px, BoardPoint};
use crate::model::{ProjectorModel, PARAMETERS};
use crate::projector::{percentile, predict_share, Priors};
use dpm_calibration_file::LightError;
use dpm_device::planes::Raster;
use dpm_scene::geometry::projector::ProjectorCamera;
use fit::ViewUnknowns;
use glam::{DAffine3, DVec2, DVec3};

/// A pixel of the camera and what lights it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CodedRay {
    /// From the camera's place, in the world; its length does not matter.
    pub ray: DVec3,
    /// The projector's pixel, from the raster's upper left corner.
    pub pixel: DVec2,
    /// Its expected deviation along each axis, pixels.
    pub sigma_px: f64,
    /// The index of the plane on which it ends, if that is known.
    pub plane: Option<usize>,
}

/// A thing in view whose place is known, with how far to trust it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KnownBody {
    /// Where it is.
    pub world_from_body: DAffine3,
    /// Of its place, metres, and of a rotation vector on the left, rad, in the axes of the world.
    pub covariance: [[f64; 6]; 6],
}

/// A printed plane on a body: z = 0 of its own space, with x to the right and y up as printed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KnownPlane {
    /// The index of its body.
    pub body: usize,
    /// From the plane to the body.
    pub body_from_plane: DAffine3,
}

/// All that was seen.
#[derive(Clone, Debug, PartialEq)]
pub struct CodedView {
    /// The camera's place in the world.
    pub eye: DVec3,
    /// Pixels of the camera.
    pub rays: Vec<CodedRay>,
    /// Bodies with printed planes.
    pub bodies: Vec<KnownBody>,
    /// The planes.
    pub planes: Vec<KnownPlane>,
}

/// A projector, and how far to trust it.
#[derive(Clone, Debug)]
pub struct ViewFit {
    /// Lens and pose.
    pub model: ProjectorModel,
    /// Covariance of its numbers.
    pub covariance: Vec<Vec<f64>>,
    /// The error that the light has all over the raster, at the distances of what was seen: a typical draw, not a bound.
    pub predicted: LightError,
    /// Root mean square residual of the rays along one axis, pixels.
    pub rms_px: f64,
    /// Rays that were used, and that were there.
    pub rays: [usize; 2],
    /// Where rays end, metres in the world.
    pub points: Vec<DVec3>,
}

/// By how much pixels of projectors are higher than wide, give or take, as a share.
const ASPECT: f64 = 0.01;
/// Rays on known planes, and all rays, that are needed.
const LEAST_KNOWN: usize = 60;
const LEAST_RAYS: usize = 300;
/// Share of the raster's width and height that the pixels must span.
const LEAST_SPAN: f64 = 0.3;
/// How far pixels must lie from those of a plane, root mean square, as a share of the raster's width. A lens bends less.
const THINNEST: f64 = 0.006;
/// A light that is more uncertain is refused, pixels.
const MOST_UNCERTAIN_PX: f64 = 10.0;
/// Residuals beyond which nothing that stood still explains the rays, pixels.
const MOST_RMS_PX: f64 = 2.0;
/// Columns and rows of the pixels over which the error is predicted.
const GRID: [u32; 2] = [16, 12];
/// The draw of the errors that is reported as the error: the middle one.
const TYPICAL: f64 = 0.5;

/// Finds the projector that lights the ends of the rays.
///
/// # Errors
/// Each reason of [`ViewRefusal`].
pub fn solve(raster: Raster, view: &CodedView) -> Result<ViewFit, ViewRefusal> {
    check(raster, view)?;
    let off_plane_px = off_plane(raster, view);
    if off_plane_px < THINNEST * f64::from(raster.width()) {
        return Err(ViewRefusal::PlaneOnly { off_plane_px });
    }
    let priors = Priors { aspect: [0.0, ASPECT], ..Priors::many_points(raster).with_usual_lens() };
    let nowhere = ViewRefusal::NoSolution { rms_px: f64::INFINITY };
    let solver = fit::Solver::new(view, &priors).ok_or(nowhere.clone())?;
    let near = start::starts(raster, view).into_iter().filter_map(|s| solver.near(s));
    let (_, near) = near.min_by(|a, b| a.0.total_cmp(&b.0)).ok_or(nowhere.clone())?;
    let found = solver.fit(near).ok_or(nowhere)?;
    if !found.converged || found.rms_px > MOST_RMS_PX {
        return Err(ViewRefusal::NoSolution { rms_px: found.rms_px });
    }
    judge(raster, view, found)
}

fn judge(raster: Raster, view: &CodedView, found: fit::SolvedView) -> Result<ViewFit, ViewRefusal> {
    let ViewUnknowns { model, .. } = &found.state;
    let points: Vec<DVec3> = view.rays.iter().filter_map(|r| found.state.end(view, r)).collect();
    let Ok(camera) = model.camera(raster) else { return Err(ViewRefusal::LensFolds) };
    let covariance: Vec<Vec<f64>> =
        found.covariance.iter().take(PARAMETERS).map(|row| row[..PARAMETERS].to_vec()).collect();
    let predicted = predict_share(model, &covariance, &over_raster(raster, &camera, &points), TYPICAL);
    if predicted.p99_px.is_nan() || predicted.p99_px > MOST_UNCERTAIN_PX {
        return Err(ViewRefusal::Uncertain { p99_px: predicted.p99_px, most_px: MOST_UNCERTAIN_PX });
    }
    let rays = [points.len(), view.rays.len()];
    Ok(ViewFit { model: *model, covariance, predicted, rms_px: found.rms_px, rays, points })
}

/// Points that pixels all over the raster light, at the distances at which something was seen.
fn over_raster(raster: Raster, camera: &ProjectorCamera, seen: &[DVec3]) -> Vec<DVec3> {
    let distances: Vec<f64> = seen.iter().map(|p| p.distance(camera.position())).collect();
    let distances = [0.1, 0.5, 0.9].map(|share| percentile(distances.clone(), share));
    let size = DVec2::new(f64::from(raster.width()), f64::from(raster.height()));
    let [across, down] = GRID;
    let pixels = (0..across * down).map(|k| DVec2::new(f64::from(k % across), f64::from(k / across)));
    let places = pixels.map(|at| at / DVec2::new(f64::from(across - 1), f64::from(down - 1)) * size);
    let rays: Vec<_> =
        places.map(|pixel| camera.ray(pixel)).filter(|ray| ray.direction.is_finite()).collect();
    distances.into_iter().flat_map(|far| rays.iter().map(move |r| r.origin + far * r.direction)).collect()
}

fn check(raster: Raster, view: &CodedView) -> Result<(), ViewRefusal> {
    let finite = |r: &CodedRay| r.ray.is_finite() && r.pixel.is_finite() && r.sigma_px > 0.0;
    if let Some(bad) = view.rays.iter().position(|r| !finite(r)) {
        return Err(ViewRefusal::NotFinite(bad));
    }
    if view.rays.len() < LEAST_RAYS {
        return Err(ViewRefusal::TooFew { have: view.rays.len(), need: LEAST_RAYS });
    }
    let known = view.rays.iter().filter(|r| r.plane.is_some()).count();
    if known < LEAST_KNOWN {
        return Err(ViewRefusal::NoScale { have: known, need: LEAST_KNOWN });
    }
    let size = DVec2::new(f64::from(raster.width()), f64::from(raster.height()));
    for axis in 0..2 {
        let all: Vec<f64> = view.rays.iter().map(|r| r.pixel[axis]).collect();
        let share = (percentile(all.clone(), 0.99) - percentile(all, 0.01)) / size[axis];
        if share < LEAST_SPAN {
            return Err(ViewRefusal::Corner { percent: 100.0 * share, need: 100.0 * LEAST_SPAN });
        }
    }
    Ok(())
}

/// How far the pixels lie from those of any plane, root mean square, pixels.
fn off_plane(raster: Raster, view: &CodedView) -> f64 {
    let axis = view.rays.iter().map(|r| r.ray.normalize()).sum::<DVec3>().normalize();
    let (across, down) = axis.any_orthonormal_pair();
    let points = view.rays.iter().map(|r| BoardPoint {
        place: DVec2::new(r.ray.dot(across), r.ray.dot(down)) / r.ray.dot(axis),
        pixel: r.pixel,
        sigma_px: r.sigma_px,
    });
    let (width, height) = (f64::from(raster.width()), f64::from(raster.height()));
    off_plane_px(&points.collect::<Vec<_>>(), 0.5 * DVec2::new(width, height), width).unwrap_or(0.0)
}
