//! A pinhole projector: converts pixels to rays and world points to pixels.
//!
//! Projector space looks along -Z with +X right and +Y up. Pixel coordinates run right and **down** from the raster's upper left
//! corner; pixel `(i, j)` covers `i..i+1` by `j..j+1`, its centre is `(i + 0.5, j + 0.5)`.

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
}

/// A calibrated pinhole projector without lens distortion.
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
        Ok(Self { raster, world_from_projector, fx, fy, cx, cy })
    }

    /// The origin of the light, world space.
    pub fn position(&self) -> DVec3 {
        self.world_from_projector.translation
    }

    /// The ray that leaves through a pixel position.
    pub fn ray(&self, pixel: DVec2) -> DRay {
        let d = DVec3::new((pixel.x - self.cx) / self.fx, (self.cy - pixel.y) / self.fy, -1.0);
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
        let p = self.to_projector_space(world);
        let depth = -p.z;
        // If the depth is below 1e-12 of the lateral distance, the quotient is meaningless (and would overflow at 0).
        if depth.is_nan() || depth <= 1e-12 * p.x.abs().max(p.y.abs()).max(1e-290) {
            return None;
        }
        let pixel = DVec2::new(self.cx + self.fx * p.x / depth, self.cy - self.fy * p.y / depth);
        pixel.is_finite().then_some(pixel)
    }

    /// Rows d(x)/dX and d(y)/dX of the projection at a world point, pixels per metre; `None` if [`Self::project`]
    /// returns `None`.
    pub fn jacobian(&self, world: DVec3) -> Option<[DVec3; 2]> {
        self.project(world)?;
        let p = self.to_projector_space(world);
        let depth = -p.z;
        let in_projector = [
            DVec3::new(self.fx / depth, 0.0, self.fx * p.x / (depth * depth)),
            DVec3::new(0.0, -self.fy / depth, -self.fy * p.y / (depth * depth)),
        ];
        Some(in_projector.map(|row| self.world_from_projector.matrix3 * row))
    }

    /// Full horizontal angle of the raster, radians.
    pub fn horizontal_fov(&self) -> f64 {
        let w = f64::from(self.raster.width());
        (self.cx / self.fx).atan() + ((w - self.cx) / self.fx).atan()
    }

    /// Full vertical angle of the raster, radians.
    pub fn vertical_fov(&self) -> f64 {
        let h = f64::from(self.raster.height());
        (self.cy / self.fy).atan() + ((h - self.cy) / self.fy).atan()
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
