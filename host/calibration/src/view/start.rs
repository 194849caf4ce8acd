//! Where least squares begin: the printed plane that is lit most gives the pose for each of some focal lengths and axes.

use super::fit::ViewUnknowns;
use super::{CodedRay, CodedView};
use crate::board::{pose_of_plane, BoardPoint};
use dpm_device::planes::Raster;
use glam::{DAffine3, DVec2, DVec3};

/// Focal lengths over the width of the raster, and heights of the axis over the height: lens shift moves it down or up.
const FOCALS: [f64; 6] = [0.5, 0.8, 1.2, 1.7, 2.5, 4.0];
const CENTRES: [f64; 3] = [0.5, 1.0, 0.0];

/// The starts, none if no plane shows four rays.
pub(super) fn starts(raster: Raster, view: &CodedView) -> Vec<ViewUnknowns> {
    let count = |plane: usize| view.rays.iter().filter(|r| r.plane == Some(plane)).count();
    let Some(plane) = (0..view.planes.len()).max_by_key(|p| count(*p)) else { return Vec::new() };
    let world_from_plane = place(view, plane);
    let points: Vec<BoardPoint> = view
        .rays
        .iter()
        .filter(|r| r.plane == Some(plane))
        .filter_map(|r| {
            let at = world_from_plane.inverse().transform_point3(meeting(view, &world_from_plane, r)?);
            Some(BoardPoint { place: at.truncate(), pixel: r.pixel, sigma_px: r.sigma_px })
        })
        .collect();
    let size = DVec2::new(f64::from(raster.width()), f64::from(raster.height()));
    let bodies = vec![[0.0; 6]; view.bodies.len()];
    let tries = FOCALS.iter().flat_map(|f| CENTRES.iter().map(move |c| (*f, *c)));
    tries
        .filter_map(|(focal, centre)| {
            let centre = DVec2::new(0.5, centre) * size;
            let about = pose_of_plane(&points, focal, centre, size.x)?;
            // About the plane so far; from the world, with steps that turn about the plane's middle.
            let world = world_from_plane.matrix3;
            let mut model = about;
            model.rotation = about.rotation * world.transpose();
            model.origin = world_from_plane.translation;
            Some(ViewUnknowns { model, bodies: bodies.clone() })
        })
        .collect()
}

/// A plane's space in the world.
pub(super) fn place(view: &CodedView, plane: usize) -> DAffine3 {
    let plane = &view.planes[plane];
    view.bodies[plane.body].world_from_body * plane.body_from_plane
}

/// Where a ray meets a plane; `None` if it does not.
fn meeting(view: &CodedView, world_from_plane: &DAffine3, ray: &CodedRay) -> Option<DVec3> {
    let (o, n) = (world_from_plane.translation - view.eye, world_from_plane.matrix3.z_axis);
    let along = n.dot(o) / n.dot(ray.ray);
    (along > 0.0 && along.is_finite()).then(|| view.eye + along * ray.ray)
}
