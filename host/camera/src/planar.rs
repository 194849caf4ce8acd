//! The two poses of a flat square that a camera may see as the same four corners.
//!
//! The homography of the corners gives one pose. Seen from so far that lines which are parallel stay so, its mirror image
//! about the plane across the line of sight gives the same picture (\[Schweighofer06\], \[Collins14\]); near the true
//! corners the solver separates the two by perspective.

use crate::decode::from_unit_square;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DMat3, DVec2, DVec3};

/// Camera space of this project, along -Z with y up, from that of the equations, along +Z with y down.
const FLIP: DMat3 = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));

/// Poses of a square of `side` metres in the camera's world: that of the homography and its mirror image. The square lies in
/// the plane z = 0 about the origin, with x to the right and y up as printed; `corners` are those of
/// [`crate::TagSighting::corners`]. None if the corners are no picture of a square.
pub(crate) fn poses_of_square(
    camera: &ProjectorCamera,
    corners: &[DVec2; 4],
    side: f64,
) -> Option<[DAffine3; 2]> {
    let mut straight = [DVec2::ZERO; 4];
    for (s, c) in straight.iter_mut().zip(corners) {
        *s = camera.straight_of_pixel(*c)?;
    }
    let h = from_unit_square(&straight)?;
    let scale = 0.5 * (h.x_axis.length() + h.y_axis.length()) / side;
    // Columns along the tag's x and along -y.
    let (x, y) = (h.x_axis.try_normalize()?, -h.y_axis.try_normalize()?);
    let (sum, difference) = ((x + y).try_normalize()?, (x - y).try_normalize()?);
    let (x, y) = ((sum + difference).normalize(), (sum - difference).normalize());
    let rotation = FLIP * DMat3::from_cols(x, y, x.cross(y));
    let centre = FLIP * (h * DVec3::new(0.5, 0.5, 1.0)) / scale;
    let sight = centre.try_normalize()?;
    let about = DMat3::IDENTITY - 2.0 * DMat3::from_cols(sight * sight.x, sight * sight.y, sight * sight.z);
    let mirrored = about * rotation * DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0));
    let world = |r: DMat3| camera.world_from_projector * DAffine3::from_mat3_translation(r, centre);
    Some([world(rotation), world(mirrored)])
}
