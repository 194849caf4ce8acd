//! Pictures of coded light into what [`dpm_calibration::view`] solves from: rays, and printed tags in view.

use crate::body::{Markings, TagPlace};
use crate::detect::TagDetector;
use crate::image::GreyImage;
use crate::sightings::Sightings;
use dpm_calibration::view::{
    check_rest, CodedPixel, CodedRay, CodedView, KnownBody, KnownPlane, ViewCode, ViewRefusal,
};
use dpm_device::tag36h11::TagBoard;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec2, DVec3};

/// Rays on tags, and elsewhere, that are used: more of them add time and nothing else.
const MOST_KNOWN: usize = 2000;
const MOST_OTHERS: usize = 4000;
/// How far beyond its border a tag is flat and white, as a share of half its side: the margin is a quarter.
const FLAT: f64 = 1.15;

/// The tags of a printed board as those of a body of its own.
pub fn board_markings(board: &TagBoard) -> Markings {
    let tags = board.tags().map(|(id, [x, y])| TagPlace {
        id,
        side: board.side_m,
        body_from_tag: DAffine3::from_translation(DVec3::new(x, y, 0.0)),
    });
    Markings { tags: tags.collect(), markers: vec![] }
}

/// What a camera, whose place is `camera.world_from_projector`, saw of a code. `seen`: a picture for each picture of the code, rows from
/// above, of the camera's raster. `bodies`: what may be in view at rest, with its tags.
///
/// # Errors
/// Something moved during the code, or it was not seen.
pub fn coded_view(
    camera: &ProjectorCamera,
    bodies: &[Markings],
    code: &ViewCode,
    seen: &[Vec<u8>],
) -> Result<CodedView, ViewRefusal> {
    let (w, h) = (camera.raster.width() as usize, camera.raster.height() as usize);
    let nothing = ViewRefusal::TooFew { have: 0, need: 1 };
    let image = seen.first().and_then(|p| GreyImage::new(w, h, p)).ok_or(nothing.clone())?;
    if seen.len() != code.pictures() {
        return Err(nothing);
    }
    check_rest(&seen[0], &seen[seen.len() - 2], w)?;
    check_rest(&seen[1], &seen[seen.len() - 1], w)?;
    let mut view = CodedView { eye: camera.position(), rays: vec![], bodies: vec![], planes: vec![] };
    let mut tags = Vec::new();
    TagDetector::new().detect(&image, Some(camera), &mut tags);
    // The planes and how large they are.
    let mut flats: Vec<(DAffine3, f64)> = Vec::new();
    let sightings = [Sightings { tags: &tags, spots: &[], row_s: 0.0, row: 0.0 }];
    for markings in bodies {
        let found = markings.locate(std::slice::from_ref(camera), &sightings, None);
        let Some(found) = found.filter(|f| f.is_certain()) else { continue };
        let world_from_body = found.fit.to_affine();
        for tag in markings.tags.iter().filter(|t| tags.iter().any(|s| s.id == t.id)) {
            view.planes.push(KnownPlane { body: view.bodies.len(), body_from_plane: tag.body_from_tag });
            flats.push((world_from_body * tag.body_from_tag, 0.5 * tag.side * FLAT));
        }
        view.bodies.push(KnownBody { world_from_body, covariance: found.fit.covariance });
    }
    let (mut known, mut others) = (Vec::new(), Vec::new());
    for decoded in code.decode(seen, w) {
        let Some(mut ray) = ray_of(camera, &decoded) else { continue };
        ray.plane = flats.iter().position(|(place, reach)| is_on(view.eye, ray.ray, place, *reach));
        if ray.plane.is_some() { &mut known } else { &mut others }.push(ray);
    }
    for (all, most) in [(known, MOST_KNOWN), (others, MOST_OTHERS)] {
        let step = all.len().div_ceil(most).max(1);
        view.rays.extend(all.into_iter().step_by(step));
    }
    Ok(view)
}

fn ray_of(camera: &ProjectorCamera, decoded: &CodedPixel) -> Option<CodedRay> {
    let pixel = DVec2::new(decoded.at[0] as f64 + 0.5, decoded.at[1] as f64 + 0.5);
    let straight = camera.straight_of_pixel(pixel)?;
    let own = DVec3::new(straight.x, -straight.y, -1.0);
    let ray = camera.world_from_projector.transform_vector3(own);
    Some(CodedRay { ray, pixel: decoded.pixel, sigma_px: decoded.sigma_px, plane: None })
}

/// Whether a ray meets the square about a plane's middle.
fn is_on(eye: DVec3, ray: DVec3, world_from_plane: &DAffine3, reach: f64) -> bool {
    let normal = world_from_plane.matrix3.z_axis;
    let along = normal.dot(world_from_plane.translation - eye) / normal.dot(ray);
    let at = world_from_plane.matrix3.transpose() * (eye + along * ray - world_from_plane.translation);
    along > 0.0 && at.x.abs().max(at.y.abs()) < reach
}
