//! A projector with its lens, as the solvers vary it: its numbers into pixels, and their derivatives.
//!
//! The equations look along +Z with y down, as OpenCV's; [`ProjectorModel::camera`] turns the result into projector
//! space of this project (along -Z, y up). Pixels count from the raster's upper left corner: the centre of the first
//! pixel is (0.5, 0.5). OpenCV counts from that centre, so its `cx` is smaller by 0.5.

use dpm_common::so3::so3_exp;
use dpm_device::planes::Raster;
use dpm_scene::geometry::lens::Lens;
use dpm_scene::geometry::projector::{ProjectorCamera, ProjectorError};
use glam::{DAffine3, DMat2, DMat3, DQuat, DVec2, DVec3};

/// How many numbers describe a lens: k1, k2, p1, p2, k3 of Brown, k4, k5, k6 of the rational and s1 to s4 of the thin prism
/// model, by OpenCV's definition.
pub const LENS: usize = 12;
/// How many numbers, from the first, describe the inside of a projector: ln f, ln(fy / fx), cx, cy and those of the lens.
pub const INTRINSICS: usize = 4 + LENS;
/// How many numbers describe a projector: three of its turn and three of its shift follow those of the inside.
pub const PARAMETERS: usize = INTRINSICS + 6;

/// Projector space of this project from that of the equations.
const FLIP: DMat3 = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));

/// A projector: `pixel = centre + focal * distort((R (X - origin) + t).xy / z)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ProjectorModel {
    /// Focal lengths, pixels.
    pub focal: DVec2,
    /// Where the optical axis leaves, pixels from the upper left corner.
    pub centre: DVec2,
    /// k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 by OpenCV's definition.
    pub lens: [f64; LENS],
    /// Equations from world.
    pub rotation: DMat3,
    /// Of `origin`, in the space of the equations, metres.
    pub translation: DVec3,
    /// The point of the world about which a step turns: the middle of the data keeps turn and shift apart.
    pub origin: DVec3,
}

/// A pixel and how it changes.
#[derive(Clone, Copy, Debug)]
pub struct PixelDerivative {
    /// The pixel.
    pub pixel: DVec2,
    /// Distance along the axis, metres.
    pub depth: f64,
    /// Derivatives of x and y of the pixel by its numbers.
    pub by_parameters: [[f64; PARAMETERS]; 2],
    /// Derivatives of x and y of the pixel by the world point, pixels a metre.
    pub by_point: [DVec3; 2],
}

impl ProjectorModel {
    /// From a pinhole and the first numbers of its lens, the others 0; steps will turn about `origin`.
    pub fn from_camera<const N: usize>(camera: &ProjectorCamera, lens: [f64; N], origin: DVec3) -> Self {
        let lens = std::array::from_fn(|i| lens.get(i).copied().unwrap_or(0.0));
        let rotation = FLIP * camera.world_from_projector.matrix3.transpose();
        Self {
            focal: DVec2::new(camera.fx, camera.fy),
            centre: DVec2::new(camera.cx, camera.cy),
            lens,
            rotation,
            translation: rotation * (origin - camera.position()),
            origin,
        }
    }

    /// Rigid pose in the world, in projector space of this project.
    pub fn world_from_projector(&self) -> DAffine3 {
        DAffine3::from_mat3_translation(self.rotation.transpose() * FLIP, self.position())
    }

    /// The projector of a raster, without its lens.
    ///
    /// # Errors
    /// Those of [`ProjectorCamera::new`].
    pub fn pinhole(&self, raster: Raster) -> Result<ProjectorCamera, ProjectorError> {
        let (f, c) = (self.focal, self.centre);
        ProjectorCamera::new(raster, self.world_from_projector(), f.x, f.y, c.x, c.y)
    }

    /// The projector of a raster.
    ///
    /// # Errors
    /// [`ProjectorError::Lens`] if the lens cannot be inverted over the raster, and those of [`ProjectorCamera::new`].
    pub fn camera(&self, raster: Raster) -> Result<ProjectorCamera, ProjectorError> {
        self.pinhole(raster)?.with_lens(Lens::opencv(self.lens_numbers())?)
    }

    /// The numbers of the simplest of OpenCV's models that has this lens: 5, 8 or 12.
    pub fn lens_numbers(&self) -> &[f64] {
        let rest = |from: usize| self.lens[from..].iter().all(|k| *k == 0.0);
        match () {
            () if rest(5) => &self.lens[..5],
            () if rest(8) => &self.lens[..8],
            () => &self.lens,
        }
    }

    /// Where the light comes from, world space.
    pub fn position(&self) -> DVec3 {
        self.origin - self.rotation.transpose() * self.translation
    }

    /// A point in the space of the equations.
    pub fn local(&self, world: DVec3) -> DVec3 {
        self.rotation * (world - self.origin) + self.translation
    }

    /// The pixel that lights a point; `None` beside and behind the projector.
    pub fn project(&self, world: DVec3) -> Option<DVec2> {
        let q = self.local(world);
        if q.z <= 1e-9 || !q.is_finite() {
            return None;
        }
        Some(self.centre + self.focal * distort(&self.lens, q.truncate() / q.z))
    }

    /// As [`Self::project`], with derivatives.
    pub fn derive(&self, world: DVec3) -> Option<PixelDerivative> {
        let turned = self.rotation * (world - self.origin);
        let q = turned + self.translation;
        if q.z <= 1e-9 || !q.is_finite() {
            return None;
        }
        let n = q.truncate() / q.z;
        let bent = distort(&self.lens, n);
        let slope = distort_slope(&self.lens, n);
        let by_lens = distort_by_lens(&self.lens, n);
        let pixel = self.centre + self.focal * bent;
        let mut by_parameters = [[0.0; PARAMETERS]; 2];
        let mut by_point = [DVec3::ZERO; 2];
        for k in 0..2 {
            let row = &mut by_parameters[k];
            row[0] = self.focal[k] * bent[k];
            row[1] = if k == 1 { row[0] } else { 0.0 };
            row[2 + k] = 1.0;
            (0..LENS).for_each(|i| row[4 + i] = self.focal[k] * by_lens[i][k]);
            let by_n = slope.row(k) * self.focal[k] / q.z;
            let by_local = DVec3::new(by_n.x, by_n.y, -by_n.dot(n));
            let by_turn = turned.cross(by_local);
            row[INTRINSICS..INTRINSICS + 3].copy_from_slice(&by_turn.to_array());
            row[INTRINSICS + 3..].copy_from_slice(&by_local.to_array());
            by_point[k] = self.rotation.transpose() * by_local;
        }
        Some(PixelDerivative { pixel, depth: q.z, by_parameters, by_point })
    }

    /// The model after a step of its numbers.
    pub fn step(&self, d: &[f64]) -> Self {
        let [turn, shift] = [INTRINSICS, INTRINSICS + 3].map(|i| DVec3::from_slice(&d[i..i + 3]));
        let turn = DMat3::from_quat(so3_exp(turn));
        // Through a quaternion, so that rounding does not let the matrix drift from a rotation.
        let rotation = DMat3::from_quat(DQuat::from_mat3(&(turn * self.rotation)).normalize());
        let scale = DVec2::new(d[0].exp(), (d[0] + d[1]).exp());
        Self {
            focal: self.focal * scale,
            centre: self.centre + DVec2::new(d[2], d[3]),
            lens: std::array::from_fn(|i| self.lens[i] + d[4 + i]),
            rotation,
            translation: self.translation + shift,
            origin: self.origin,
        }
    }

    /// The same projector, with steps that turn about another point.
    pub fn about(&self, origin: DVec3) -> Self {
        Self { translation: self.local(origin), origin, ..*self }
    }
}

/// The part of the lens that stretches a direction along itself, as a function of its squared length.
struct Radial {
    stretch: f64,
    /// By the squared length.
    rise: f64,
    /// Of the rational lens.
    divisor: f64,
}

fn radial(&[k1, k2, _, _, k3, k4, k5, k6, ..]: &[f64; LENS], r2: f64) -> Radial {
    let upper = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    let divisor = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
    let upper_rise = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3);
    let divisor_rise = k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6);
    let stretch = upper / divisor;
    Radial { stretch, rise: (upper_rise - stretch * divisor_rise) / divisor, divisor }
}

/// The direction (x / z, y / z) after the lens.
fn distort(lens: &[f64; LENS], n: DVec2) -> DVec2 {
    let &[_, _, p1, p2, _, _, _, _, s1, s2, s3, s4] = lens;
    let (r2, xy) = (n.length_squared(), n.x * n.y);
    n * radial(lens, r2).stretch
        + DVec2::new(2.0 * p1 * xy + p2 * (r2 + 2.0 * n.x * n.x), p1 * (r2 + 2.0 * n.y * n.y) + 2.0 * p2 * xy)
        + DVec2::new(r2 * (s1 + r2 * s2), r2 * (s3 + r2 * s4))
}

fn distort_slope(lens: &[f64; LENS], n: DVec2) -> DMat2 {
    let &[_, _, p1, p2, _, _, _, _, s1, s2, s3, s4] = lens;
    let r2 = n.length_squared();
    let Radial { stretch, rise, .. } = radial(lens, r2);
    let rise = 2.0 * rise;
    let xx = stretch + rise * n.x * n.x + 2.0 * p1 * n.y + 6.0 * p2 * n.x;
    let mixed = rise * n.x * n.y + 2.0 * p1 * n.x + 2.0 * p2 * n.y;
    let yy = stretch + rise * n.y * n.y + 6.0 * p1 * n.y + 2.0 * p2 * n.x;
    let prism = 2.0 * DVec2::new(s1 + 2.0 * r2 * s2, s3 + 2.0 * r2 * s4);
    DMat2::from_cols(DVec2::new(xx, mixed) + prism * n.x, DVec2::new(mixed, yy) + prism * n.y)
}

/// Derivatives of the bent direction by the lens's numbers.
fn distort_by_lens(lens: &[f64; LENS], n: DVec2) -> [DVec2; LENS] {
    let r2 = n.length_squared();
    let xy = 2.0 * n.x * n.y;
    let Radial { stretch, divisor, .. } = radial(lens, r2);
    let (upper, lower) = (n / divisor, -stretch / divisor * n);
    [
        upper * r2,
        upper * r2 * r2,
        DVec2::new(xy, r2 + 2.0 * n.y * n.y),
        DVec2::new(r2 + 2.0 * n.x * n.x, xy),
        upper * r2 * r2 * r2,
        lower * r2,
        lower * r2 * r2,
        lower * r2 * r2 * r2,
        DVec2::new(r2, 0.0),
        DVec2::new(r2 * r2, 0.0),
        DVec2::new(0.0, r2),
        DVec2::new(0.0, r2 * r2),
    ]
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn example() -> ProjectorModel {
        let raster = Raster::new(1024, 768).unwrap();
        let mut camera = ProjectorCamera::look_at(
            raster,
            DVec3::new(0.4, 0.9, 1.1),
            DVec3::new(0.05, 0.1, -0.1),
            DVec3::Y,
            0.62,
        )
        .unwrap();
        camera.fy *= 1.01;
        camera.cy += 100.0;
        let lens = [-0.12, 0.07, 0.001, -0.0015, 0.01, 0.05, -0.03, 0.02, 0.002, -0.001, 0.0015, 0.003];
        ProjectorModel::from_camera(&camera, lens, DVec3::new(0.1, 0.0, 0.2))
    }

    #[test]
    fn derivatives_are_those_of_the_projection() {
        let model = example();
        let point = DVec3::new(0.2, 0.05, -0.15);
        let at = model.derive(point).unwrap();
        assert!((at.pixel - model.project(point).unwrap()).length() < 1e-12);
        for i in 0..PARAMETERS {
            let h = 1e-6;
            let moved = |s: f64| {
                let mut d = [0.0; PARAMETERS];
                d[i] = s * h;
                model.step(&d).project(point).unwrap()
            };
            let slope = (moved(1.0) - moved(-1.0)) / (2.0 * h);
            let got = DVec2::new(at.by_parameters[0][i], at.by_parameters[1][i]);
            assert!((slope - got).length() < 1e-4 * slope.length().max(1.0), "{i}: {slope} {got}");
        }
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            let h = 1e-6;
            let slope = (model.project(point + axis * h).unwrap() - model.project(point - axis * h).unwrap())
                / (2.0 * h);
            let got = DVec2::new(at.by_point[0].dot(axis), at.by_point[1].dot(axis));
            assert!((slope - got).length() < 1e-4 * slope.length());
        }
    }

    #[test]
    fn it_is_the_projector_of_the_scene() {
        let model = example();
        let camera = model.camera(Raster::new(1024, 768).unwrap()).unwrap();
        for i in 0..20 {
            let s = f64::from(i);
            let p = DVec3::new((0.7 * s).sin() * 0.3, (1.1 * s).cos() * 0.2, (1.9 * s).sin() * 0.3);
            assert!((camera.project(p).unwrap() - model.project(p).unwrap()).length() < 1e-9);
        }
        let back = ProjectorModel::from_camera(&camera, model.lens, DVec3::ZERO);
        assert!((back.position() - model.position()).length() < 1e-12);
        assert!((model.about(DVec3::ONE).position() - model.position()).length() < 1e-12);
    }

    #[test]
    fn a_lens_that_folds_inside_the_raster_is_seen() {
        let raster = Raster::new(1024, 768).unwrap();
        example().camera(raster).unwrap();
        // The radius r (1 + k1 r^2) turns back at r = 1 / sqrt(-3 k1); the far corner lies at about 0.53.
        let folded =
            ProjectorModel { lens: std::array::from_fn(|i| if i == 0 { -2.0 } else { 0.0 }), ..example() };
        assert!(matches!(folded.camera(raster), Err(ProjectorError::Lens(_))));
    }
}
