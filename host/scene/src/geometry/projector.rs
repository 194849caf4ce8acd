//! A projector with its lens: converts pixels to rays and world points to pixels.
//!
//! Projector space looks along -Z with +X right and +Y up. Pixel coordinates run right and **down** from the raster's upper left
//! corner; pixel `(i, j)` covers `i..i+1` by `j..j+1`, its centre is `(i + 0.5, j + 0.5)`.

use super::lens::{Lens, LensError};
use dpm_device::planes::Raster;
use glam::{DAffine3, DMat3, DVec2, DVec3};
use thiserror::Error;

/// A half-line. `direction` is of unit length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DRay {
    /// Its origin, metres.
    pub origin: DVec3,
    /// Its direction, unit.
    pub direction: DVec3,
}

/// Why a projector cannot be built.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum ProjectorError {
    /// Position, target, up or angle is NaN or infinite.
    #[error("projector: {0} is not finite; give finite numbers")]
    NotFinite(&'static str),
    /// The horizontal field of view is out of range.
    #[error("projector: horizontal field of view {0} deg is outside 0..180 (both excluded)")]
    FieldOfView(f64),
    /// Position and look_at coincide.
    #[error("projector: position and look_at are the same point; move one of them")]
    NoDirection,
    /// `up` is zero or parallel to the viewing direction.
    #[error("projector: up is parallel to the viewing direction (or zero); choose another up")]
    NoUp,
    /// A focal length is zero, negative or not finite.
    #[error("projector: focal lengths {0} x {1} px must be finite and above 0")]
    Focal(f64, f64),
    /// The lens cannot be inverted over the raster.
    #[error("projector: {0}")]
    Lens(#[from] LensError),
}

/// Positions on each side of the raster at which a lens must have an inverse.
const BORDER_STEPS: u32 = 64;

/// A calibrated projector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ProjectorCamera {
    /// Size of the mirror array.
    pub raster: Raster,
    /// Rigid pose, metres.
    pub world_from_projector: DAffine3,
    /// Horizontal focal length, pixels.
    pub fx: f64,
    /// Vertical focal length, pixels.
    pub fy: f64,
    /// Column at which the optical axis leaves, pixels from the left edge. May lie outside the raster (lens shift).
    pub cx: f64,
    /// Row at which the optical axis leaves, pixels from the upper edge.
    pub cy: f64,
    /// How its lens bends rays between the pinhole and the focal lengths.
    pub lens: Lens,
}

impl ProjectorCamera {
    /// A projector with square pixels and the axis in the middle of the raster.
    ///
    /// `hfov_rad` is the full horizontal angle of the raster, 0..pi. `up` need not be perpendicular to the viewing direction.
    pub fn look_at(
        raster: Raster,
        position: DVec3,
        look_at: DVec3,
        up: DVec3,
        hfov_rad: f64,
    ) -> Result<Self, ProjectorError> {
        for (name, v) in [("position", position), ("look_at", look_at), ("up", up)] {
            if !v.is_finite() {
                return Err(ProjectorError::NotFinite(name));
            }
        }
        if !hfov_rad.is_finite() {
            return Err(ProjectorError::NotFinite("field of view"));
        }
        if hfov_rad <= 0.0 || hfov_rad >= std::f64::consts::PI {
            return Err(ProjectorError::FieldOfView(hfov_rad.to_degrees()));
        }
        let back = (position - look_at).try_normalize().ok_or(ProjectorError::NoDirection)?;
        // The sine of the angle between up and the axis: below 1e-9 rounding determines the roll.
        let side = up.normalize_or_zero().cross(back);
        if side.length() < 1e-9 {
            return Err(ProjectorError::NoUp);
        }
        let right = side.normalize();
        let rotation = DMat3::from_cols(right, back.cross(right), back);
        let (w, h) = (f64::from(raster.width()), f64::from(raster.height()));
        let f = 0.5 * w / (0.5 * hfov_rad).tan();
        Self::new(raster, DAffine3::from_mat3_translation(rotation, position), f, f, 0.5 * w, 0.5 * h)
    }

    /// A projector from calibrated intrinsics.
    pub fn new(
        raster: Raster,
        world_from_projector: DAffine3,
        fx: f64,
        fy: f64,
        cx: f64,
        cy: f64,
    ) -> Result<Self, ProjectorError> {
        if !world_from_projector.is_finite() {
            return Err(ProjectorError::NotFinite("pose"));
        }
        if !(cx.is_finite() && cy.is_finite()) {
            return Err(ProjectorError::NotFinite("principal point"));
        }
        if !(fx.is_finite() && fy.is_finite() && fx > 0.0 && fy > 0.0) {
            return Err(ProjectorError::Focal(fx, fy));
        }
        Ok(Self { raster, world_from_projector, fx, fy, cx, cy, lens: Lens::default() })
    }

    /// The same projector with another lens.
    ///
    /// # Errors
    /// [`ProjectorError::Lens`] if the lens cannot be inverted over the whole raster and a pixel around it.
    pub fn with_lens(self, lens: Lens) -> Result<Self, ProjectorError> {
        let (w, h) = (f64::from(self.raster.width()), f64::from(self.raster.height()));
        let border = (0..=BORDER_STEPS).flat_map(|i| {
            let t = f64::from(i) / f64::from(BORDER_STEPS);
            let (x, y) = (-1.0 + t * (w + 2.0), -1.0 + t * (h + 2.0));
            [DVec2::new(x, -1.0), DVec2::new(x, h + 1.0), DVec2::new(-1.0, y), DVec2::new(w + 1.0, y)]
        });
        let lens =
            lens.usable_over(border.map(|p| self.bent_of_pixel(p)), |bent| self.pixel_of_bent(bent))?;
        Ok(Self { lens, ..self })
    }

    /// The view of this projector divided into the pixels of another raster.
    pub fn at_raster(&self, raster: Raster) -> Self {
        // Pixel coordinates start at the raster's corner, so everything scales.
        let x = f64::from(raster.width()) / f64::from(self.raster.width());
        let y = f64::from(raster.height()) / f64::from(self.raster.height());
        Self { raster, fx: self.fx * x, fy: self.fy * y, cx: self.cx * x, cy: self.cy * y, ..*self }
    }

    /// The origin of the light, world space.
    pub fn position(&self) -> DVec3 {
        self.world_from_projector.translation
    }

    /// The bent ray (`x / z`, `y / z` behind the lens, y down) of a pixel position.
    pub fn bent_of_pixel(&self, pixel: DVec2) -> DVec2 {
        DVec2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy)
    }

    /// The pixel position of a bent ray.
    pub fn pixel_of_bent(&self, bent: DVec2) -> DVec2 {
        DVec2::new(self.cx + self.fx * bent.x, self.cy + self.fy * bent.y)
    }

    /// The straight ray (`x / z`, `y / z` in front of the lens, y down) of a pixel position; `None` where the lens has none,
    /// which is never on the raster of [`Self::with_lens`].
    pub fn straight_of_pixel(&self, pixel: DVec2) -> Option<DVec2> {
        self.lens.undistort(self.bent_of_pixel(pixel))
    }

    /// The ray that leaves through a pixel position. Its direction is NaN where no ray does, far outside the raster of a
    /// lens that folds.
    pub fn ray(&self, pixel: DVec2) -> DRay {
        let straight = self.straight_of_pixel(pixel).unwrap_or(DVec2::NAN);
        let d = DVec3::new(straight.x, -straight.y, -1.0);
        DRay {
            origin: self.position(),
            direction: self.world_from_projector.transform_vector3(d).normalize(),
        }
    }

    /// World point into projector space. The pose is rigid, so the inverse rotation is the transpose.
    pub fn to_projector_space(&self, world: DVec3) -> DVec3 {
        self.world_from_projector.matrix3.transpose() * (world - self.world_from_projector.translation)
    }

    /// Pixel position of a world point; `None` when the point is beside or behind the projector. May lie outside the raster.
    pub fn project(&self, world: DVec3) -> Option<DVec2> {
        let pixel = self.pixel_of_bent(self.lens.distort(self.straight_of_world(world)?)?);
        pixel.is_finite().then_some(pixel)
    }

    /// The straight ray (`x / z`, `y / z`, y down) to a world point; `None` when the point is beside or behind the projector.
    pub fn straight_of_world(&self, world: DVec3) -> Option<DVec2> {
        let p = self.to_projector_space(world);
        let depth = -p.z;
        // If the depth is below 1e-12 of the lateral distance, the quotient is meaningless (and would overflow at 0).
        if depth.is_nan() || depth <= 1e-12 * p.x.abs().max(p.y.abs()).max(1e-290) {
            return None;
        }
        Some(DVec2::new(p.x / depth, -p.y / depth))
    }

    /// Rows d(x)/dX and d(y)/dX of the projection at a world point, pixels per metre; `None` if [`Self::project`]
    /// returns `None`.
    pub fn jacobian(&self, world: DVec3) -> Option<[DVec3; 2]> {
        self.project(world)?;
        let p = self.to_projector_space(world);
        let depth = -p.z;
        let straight = [
            DVec3::new(1.0 / depth, 0.0, p.x / (depth * depth)),
            DVec3::new(0.0, -1.0 / depth, -p.y / (depth * depth)),
        ];
        let lens = self.lens.jacobian(self.straight_of_world(world)?);
        let row = |f: f64, by_x: f64, by_y: f64| {
            self.world_from_projector.matrix3 * ((straight[0] * by_x + straight[1] * by_y) * f)
        };
        Some([row(self.fx, lens.x_axis.x, lens.y_axis.x), row(self.fy, lens.x_axis.y, lens.y_axis.y)])
    }

    /// Full horizontal angle of the raster along the row of the axis, radians.
    pub fn horizontal_fov(&self) -> f64 {
        let w = f64::from(self.raster.width());
        let at = |x: f64| self.straight_of_pixel(DVec2::new(x, self.cy)).map_or(f64::NAN, |p| p.x.atan());
        at(w) - at(0.0)
    }

    /// Full vertical angle of the raster along the column of the axis, radians.
    pub fn vertical_fov(&self) -> f64 {
        let h = f64::from(self.raster.height());
        let at = |y: f64| self.straight_of_pixel(DVec2::new(self.cx, y)).map_or(f64::NAN, |p| p.y.atan());
        at(h) - at(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> ProjectorCamera {
        let raster = Raster::new(640, 480).unwrap();
        let mut c = ProjectorCamera::look_at(
            raster,
            DVec3::new(0.3, 1.2, 2.0),
            DVec3::new(-0.1, 0.2, 0.0),
            DVec3::Y,
            0.7,
        )
        .unwrap();
        c.fy *= 1.1;
        c.cy += 170.0;
        c
    }

    #[test]
    fn axis_up_and_right_are_where_they_belong() {
        let raster = Raster::new(200, 100).unwrap();
        let c = ProjectorCamera::look_at(raster, DVec3::ZERO, -DVec3::Z, DVec3::Y, 1.0).unwrap();
        assert!((c.ray(DVec2::new(100.0, 50.0)).direction + DVec3::Z).length() < 1e-15);
        let corner = c.ray(DVec2::new(200.0, 0.0)).direction;
        assert!(corner.x > 0.0 && corner.y > 0.0);
        assert!((c.horizontal_fov() - 1.0).abs() < 1e-12);
        let edge = c.ray(DVec2::new(200.0, 50.0)).direction;
        assert!((edge.angle_between(-DVec3::Z) - 0.5).abs() < 1e-12);
    }

    #[test]
    fn project_inverts_ray() {
        let c = camera();
        for (x, y, t) in [(0.0, 0.0, 1e-3), (640.0, 480.0, 3.0), (123.4, 56.7, 1e4), (-50.0, 900.0, 0.5)] {
            let r = c.ray(DVec2::new(x, y));
            let p = c.project(r.origin + r.direction * t).unwrap();
            assert!((p - DVec2::new(x, y)).length() < 1e-7, "{p} at {t}");
        }
    }

    #[test]
    fn behind_beside_and_nan_project_to_nothing() {
        let c = camera();
        let r = c.ray(DVec2::new(320.0, 200.0));
        assert_eq!(c.project(r.origin - r.direction), None);
        assert_eq!(c.project(r.origin), None);
        assert_eq!(c.project(r.origin + c.world_from_projector.matrix3.x_axis), None);
        assert_eq!(c.project(DVec3::NAN), None);
        assert_eq!(c.jacobian(DVec3::NAN), None);
        let nearly = r.origin + c.world_from_projector.matrix3.x_axis * 0.5
            - c.world_from_projector.matrix3.z_axis * 1e-9;
        assert!(c.project(nearly).is_none_or(|p| p.is_finite()));
    }

    #[test]
    fn jacobian_is_the_derivative() {
        let c = camera();
        let r = c.ray(DVec2::new(500.0, 100.0));
        let p = r.origin + r.direction * 1.7;
        let j = c.jacobian(p).unwrap();
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            let h = 1e-6;
            let d = (c.project(p + axis * h).unwrap() - c.project(p - axis * h).unwrap()) / (2.0 * h);
            assert!((d - DVec2::new(j[0].dot(axis), j[1].dot(axis))).length() < 1e-5 * c.fx);
        }
    }

    #[test]
    fn a_lens_bends_between_pinhole_and_pixels() {
        let straight = camera();
        let lens = Lens::opencv(&[-0.1, 0.02, 1e-3, -2e-3, 0.0]).unwrap();
        let c = straight.with_lens(lens).unwrap();
        // By hand, off the axis to the right and down.
        let at = DVec2::new(0.2, 0.1);
        let r2 = 0.05;
        let radial = 1.0 + r2 * (-0.1 + r2 * 0.02);
        let bent =
            at * radial + DVec2::new(2e-3 * 0.02 - 2e-3 * (r2 + 0.08), 1e-3 * (r2 + 0.02) - 4e-3 * 0.02);
        let world = c.world_from_projector.transform_point3(DVec3::new(0.2, -0.1, -1.0) * 3.0);
        let want = DVec2::new(c.cx + c.fx * bent.x, c.cy + c.fy * bent.y);
        assert!((c.project(world).unwrap() - want).length() < 1e-9);
        for (x, y) in [(0.0, 0.0), (640.0, 480.0), (123.4, 56.7), (-1.0, 481.0)] {
            let r = c.ray(DVec2::new(x, y));
            assert!((c.project(r.origin + r.direction * 2.0).unwrap() - DVec2::new(x, y)).length() < 1e-8);
        }
        let h = 1e-6;
        let j = c.jacobian(world).unwrap();
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            let d = (c.project(world + axis * h).unwrap() - c.project(world - axis * h).unwrap()) / (2.0 * h);
            assert!((d - DVec2::new(j[0].dot(axis), j[1].dot(axis))).length() < 1e-5 * c.fx);
        }
        // A raster that reaches beyond the fold of the lens is refused, with the pixel.
        let folding = straight.with_lens(Lens::opencv(&[-9.0, 0.0, 0.0, 0.0]).unwrap());
        assert!(matches!(folding, Err(ProjectorError::Lens(LensError::Folds { .. }))), "{folding:?}");
    }

    #[test]
    fn impossible_projectors_are_named() {
        let raster = Raster::new(4, 4).unwrap();
        let at = |p, l, u, f| ProjectorCamera::look_at(raster, p, l, u, f).unwrap_err();
        assert_eq!(at(DVec3::ONE, DVec3::ONE, DVec3::Y, 1.0), ProjectorError::NoDirection);
        assert_eq!(at(DVec3::ZERO, DVec3::Y, DVec3::Y, 1.0), ProjectorError::NoUp);
        assert_eq!(at(DVec3::ZERO, DVec3::Z, DVec3::ZERO, 1.0), ProjectorError::NoUp);
        assert_eq!(at(DVec3::NAN, DVec3::Z, DVec3::Y, 1.0), ProjectorError::NotFinite("position"));
        assert!(matches!(at(DVec3::ZERO, DVec3::Z, DVec3::Y, 4.0), ProjectorError::FieldOfView(_)));
        assert!(matches!(
            ProjectorCamera::new(raster, DAffine3::IDENTITY, 0.0, 1.0, 0.0, 0.0),
            Err(ProjectorError::Focal(..))
        ));
    }
}
