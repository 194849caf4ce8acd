//! A projector's lens: converts straight rays to bent ones and back, by OpenCV's definitions.
//!
//! Coordinates are `x / z`, `y / z` before the focal length, x right and y down. A real polynomial lens can be inverted only
//! around its axis: farther out several rays would share one pixel, and the answer is `None`.

use glam::{DMat2, DMat3, DVec2, DVec3};
use thiserror::Error;

/// The definition that a lens follows.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum LensModel {
    /// No distortion.
    #[default]
    Pinhole,
    /// Radial (rational), tangential, thin prism and tilted panel, in OpenCV's order:
    /// k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y. \[Brown66\] has the first five.
    Brown([f64; 14]),
    /// Equidistant with an odd polynomial of the angle, k1 k2 k3 k4 of OpenCV's module `fisheye` (\[Kannala06\]).
    Fisheye([f64; 4]),
}

/// Why coefficients are not a lens.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum LensError {
    /// A number of coefficients that no model has.
    #[error("lens: {0} distortion coefficients; 0, 4, 5, 8, 12 or 14 are known")]
    Count(usize),
    /// A coefficient is NaN or infinite.
    #[error("lens: distortion coefficient {0} is not finite")]
    NotFinite(usize),
    /// The panel is tilted until it is seen edge on.
    #[error("lens: the panel is tilted by {0:.0} degrees; below 80 are possible")]
    Tilt(f64),
    /// The lens folds: two rays share a pixel.
    #[error(
        "lens: the distortion cannot be inverted over the raster: at pixel ({:.0}, {:.0}) no single ray leads there. \
         The coefficients are wrong, belong to another raster, or were fitted to pixels near its middle only",
        pixel.x,
        pixel.y
    )]
    Folds {
        /// Where.
        pixel: DVec2,
    },
}

/// A lens and the part of it that can be inverted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    model: LensModel,
    /// Largest distance of a straight ray from the axis (`r / z`) at which the lens is used.
    limit: f64,
    /// Turns and projects the bent ray onto a tilted panel; the identity for most lenses.
    tilt: DMat3,
    /// Its inverse.
    untilt: DMat3,
}

impl Default for Lens {
    fn default() -> Self {
        Self {
            model: LensModel::Pinhole,
            limit: f64::INFINITY,
            tilt: DMat3::IDENTITY,
            untilt: DMat3::IDENTITY,
        }
    }
}

/// Rays farther than this from the axis (`r / z`) are not considered: 84 degrees.
const WIDEST: f64 = 10.0;
/// The image of a straight ray must move by at least this share of the ray's own motion, in every direction. Then a lens
/// has one inverse, and an error of the bent ray grows at most twentyfold on the way back.
const LEAST_STRETCH: f64 = 0.05;
/// Steps of the search for the edge of the usable part.
const RINGS: u32 = 400;
/// Directions in which each ring is examined.
const SPOKES: u32 = 48;
/// Newton's method must end within so many steps. It needs six for strong lenses.
const MOST_STEPS: usize = 60;

impl Lens {
    /// A lens with OpenCV's coefficients `k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]`. None, or only zeros,
    /// is a lens without distortion.
    ///
    /// # Errors
    /// Another number of coefficients, a coefficient that is not finite, or a panel that is tilted by 80 degrees.
    pub fn opencv(coefficients: &[f64]) -> Result<Self, LensError> {
        if !matches!(coefficients.len(), 0 | 4 | 5 | 8 | 12 | 14) {
            return Err(LensError::Count(coefficients.len()));
        }
        if let Some(bad) = coefficients.iter().position(|c| !c.is_finite()) {
            return Err(LensError::NotFinite(bad));
        }
        if coefficients.iter().all(|c| *c == 0.0) {
            return Ok(Self::default());
        }
        let mut c = [0.0; 14];
        c[..coefficients.len()].copy_from_slice(coefficients);
        let tilt = tilt(c[12], c[13])?;
        let model = LensModel::Brown(c);
        Ok(Self { model, limit: growing(&model), tilt, untilt: tilt.inverse() })
    }

    /// A fisheye lens with OpenCV's coefficients k1 to k4.
    ///
    /// # Errors
    /// A coefficient is not finite.
    pub fn fisheye(k: [f64; 4]) -> Result<Self, LensError> {
        if let Some(bad) = k.iter().position(|c| !c.is_finite()) {
            return Err(LensError::NotFinite(bad));
        }
        let model = LensModel::Fisheye(k);
        Ok(Self { model, limit: growing(&model), ..Self::default() })
    }

    /// Its definition and coefficients.
    pub fn model(&self) -> LensModel {
        self.model
    }

    /// Whether rays stay straight.
    pub fn is_pinhole(&self) -> bool {
        self.model == LensModel::Pinhole
    }

    /// Largest `r / z` of a straight ray that this lens bends; rays beyond it have no pixel.
    pub fn limit(&self) -> f64 {
        self.limit
    }

    /// The matrix by which a bent ray `(x, y, 1)` meets a tilted panel.
    pub fn tilt_matrix(&self) -> DMat3 {
        self.tilt
    }

    /// The same lens, used only where it certainly can be inverted, which must include the bent rays `border` of the
    /// raster's edge. `pixel_of` converts one of them to a pixel for the operator.
    ///
    /// # Errors
    /// [`LensError::Folds`].
    pub(super) fn usable_over(
        mut self,
        border: impl Iterator<Item = DVec2>,
        pixel_of: impl Fn(DVec2) -> DVec2,
    ) -> Result<Self, LensError> {
        if self.is_pinhole() {
            return Ok(self);
        }
        self.limit = self.stretching();
        for bent in border {
            if self.undistort(bent).is_none() {
                return Err(LensError::Folds { pixel: pixel_of(bent) });
            }
        }
        Ok(self)
    }

    /// The bent ray of a straight one; `None` outside the part of the lens that can be inverted.
    pub fn distort(&self, straight: DVec2) -> Option<DVec2> {
        let within = straight.length() <= self.limit; // false for NaN
        let bent = within.then(|| self.bend(straight)).filter(|b| b.is_finite())?;
        self.is_pinhole().then_some(straight).or_else(|| project_by(&self.tilt, bent))
    }

    /// The straight ray of a bent one, to 1e-13 of the bent ray; `None` if no ray of the usable part of the lens leads
    /// there. The straight ray's own error is at most twenty times as large, by the least stretch of a usable lens.
    pub fn undistort(&self, bent: DVec2) -> Option<DVec2> {
        if self.is_pinhole() {
            return bent.is_finite().then_some(bent);
        }
        // The square of a longer one would overflow, and no lens bends rays so far. False for NaN.
        let in_reach = |v: &DVec2| v.abs().max_element() < 1e9 && v.is_finite();
        let target =
            Some(bent).filter(in_reach).and_then(|b| project_by(&self.untilt, b)).filter(in_reach)?;
        let mut p = self.radial_start(target);
        let mut error = self.bend(p) - target;
        for _ in 0..MOST_STEPS {
            if error.length() <= 1e-13 * (1.0 + target.length()) {
                return (p.length() <= self.limit * (1.0 + 1e-12)).then_some(p);
            }
            let step = invert(self.bend_jacobian(p))? * error;
            // A full step, or the longest half, quarter, ... that comes nearer: a monotone map has no other minimum.
            let mut scale = 1.0;
            let (next, next_error) = loop {
                let next = p - step * scale;
                let next_error = self.bend(next) - target;
                if next_error.length() < error.length() || scale < 1e-6 {
                    break (next, next_error);
                }
                scale *= 0.5;
            };
            if !next.is_finite() || next_error.length() >= error.length() {
                break;
            }
            (p, error) = (next, next_error);
        }
        // Rounding can stop the descent just above the goal.
        (error.length() <= 1e-11 * (1.0 + target.length()) && p.length() <= self.limit).then_some(p)
    }

    /// Derivatives of the bent ray by the straight one: columns d/dx, d/dy. Meaningless where [`Self::distort`] gives `None`.
    pub fn jacobian(&self, straight: DVec2) -> DMat2 {
        let inner = self.bend_jacobian(straight);
        if self.tilt == DMat3::IDENTITY {
            return inner;
        }
        let q = self.tilt * self.bend(straight).extend(1.0);
        let by_bent = |axis: DVec3| {
            let d = self.tilt * axis;
            DVec2::new(d.x * q.z - q.x * d.z, d.y * q.z - q.y * d.z) / (q.z * q.z)
        };
        DMat2::from_cols(by_bent(DVec3::X), by_bent(DVec3::Y)) * inner
    }

    /// The bent ray before the tilt.
    fn bend(&self, p: DVec2) -> DVec2 {
        match self.model {
            LensModel::Pinhole => p,
            LensModel::Brown(c) => {
                let [_, _, p1, p2, _, _, _, _, s1, s2, s3, s4, _, _] = c;
                let r2 = p.length_squared();
                let tangential = DVec2::new(
                    2.0 * p1 * p.x * p.y + p2 * (r2 + 2.0 * p.x * p.x),
                    p1 * (r2 + 2.0 * p.y * p.y) + 2.0 * p2 * p.x * p.y,
                );
                let prism = DVec2::new(r2 * (s1 + r2 * s2), r2 * (s3 + r2 * s4));
                p * rational(&c, r2).0 + tangential + prism
            }
            LensModel::Fisheye(k) => p * fisheye_scale(&k, p.length()).0,
        }
    }

    /// Derivatives of [`Self::bend`].
    fn bend_jacobian(&self, p: DVec2) -> DMat2 {
        match self.model {
            LensModel::Pinhole => DMat2::IDENTITY,
            LensModel::Brown(c) => {
                let [_, _, p1, p2, _, _, _, _, s1, s2, s3, s4, _, _] = c;
                let r2 = p.length_squared();
                let (scale, by_r2) = rational(&c, r2);
                let DVec2 { x, y } = p;
                let (prism_x, prism_y) = (2.0 * (s1 + 2.0 * r2 * s2), 2.0 * (s3 + 2.0 * r2 * s4));
                let cross = 2.0 * by_r2 * x * y + 2.0 * p1 * x + 2.0 * p2 * y;
                DMat2::from_cols(
                    DVec2::new(
                        scale + 2.0 * by_r2 * x * x + 2.0 * p1 * y + 6.0 * p2 * x + prism_x * x,
                        cross + prism_y * x,
                    ),
                    DVec2::new(
                        cross + prism_x * y,
                        scale + 2.0 * by_r2 * y * y + 6.0 * p1 * y + 2.0 * p2 * x + prism_y * y,
                    ),
                )
            }
            LensModel::Fisheye(k) => {
                let (scale, by_r_over_r) = fisheye_scale(&k, p.length());
                DMat2::from_diagonal(DVec2::splat(scale))
                    + DMat2::from_cols(p * (p.x * by_r_over_r), p * (p.y * by_r_over_r))
            }
        }
    }

    /// Where Newton's method starts: the radial part alone grows up to the limit, so halving finds its inverse.
    fn radial_start(&self, target: DVec2) -> DVec2 {
        let goal = target.length();
        let (mut low, mut high) = (0.0, self.limit);
        for _ in 0..40 {
            let r = 0.5 * (low + high);
            if radial(&self.model, r) < goal {
                low = r;
            } else {
                high = r;
            }
        }
        target.normalize_or_zero() * low
    }

    /// The largest radius, 10 at most, up to which the lens stretches every direction by [`LEAST_STRETCH`] at every
    /// examined point. Two rays inside that disk cannot share a bent ray: the symmetric part of the derivative is
    /// positive definite on a convex set.
    fn stretching(&self) -> f64 {
        let ring = |i: u32| self.limit * f64::from(i) / f64::from(RINGS);
        for i in 1..=RINGS {
            for k in 0..SPOKES {
                let angle = std::f64::consts::TAU * f64::from(k) / f64::from(SPOKES);
                let j = self.bend_jacobian(DVec2::from_angle(angle) * ring(i));
                let (a, b, d) = (j.x_axis.x, 0.5 * (j.x_axis.y + j.y_axis.x), j.y_axis.y);
                let least = 0.5 * (a + d) - (0.25 * (a - d) * (a - d) + b * b).sqrt();
                // `is_nan` is part of the question: a NaN is no stretch.
                if least.is_nan() || least < LEAST_STRETCH * self.bend_jacobian(DVec2::ZERO).x_axis.x {
                    return ring(i - 1);
                }
            }
        }
        self.limit
    }
}

/// `(1 + k1 r2 + ...) / (1 + k4 r2 + ...)` and its derivative by r2.
fn rational(c: &[f64; 14], r2: f64) -> (f64, f64) {
    let [k1, k2, _, _, k3, k4, k5, k6, ..] = *c;
    let up = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    let down = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
    let (up_by, down_by) = (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3), k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6));
    (up / down, (up_by * down - up * down_by) / (down * down))
}

/// `theta_d / r` of a fisheye lens, and the derivative of that by r, over r.
fn fisheye_scale(k: &[f64; 4], r: f64) -> (f64, f64) {
    // Below this radius the series is exact: its next term is 1e-12 of the first.
    if r < 1e-6 {
        let second = k[0] - 1.0 / 3.0;
        return (1.0 + second * r * r, 2.0 * second);
    }
    let theta = r.atan();
    let t2 = theta * theta;
    let bent = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
    let by_theta = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])));
    let scale = bent / r;
    (scale, (by_theta / (1.0 + r * r) - scale) / (r * r))
}

/// Distance of the bent ray from the axis by that of the straight one, without what is not radial.
fn radial(model: &LensModel, r: f64) -> f64 {
    match model {
        LensModel::Pinhole => r,
        LensModel::Brown(c) => r * rational(c, r * r).0,
        LensModel::Fisheye(k) => r * fisheye_scale(k, r).0,
    }
}

/// The largest r, [`WIDEST`] at most, up to which [`radial`] grows, by steps of a four hundredth.
fn growing(model: &LensModel) -> f64 {
    let mut last = 0.0;
    for i in 1..=RINGS {
        let r = WIDEST * f64::from(i) / f64::from(RINGS);
        let bent = radial(model, r);
        if bent.is_nan() || bent <= last {
            return WIDEST * f64::from(i - 1) / f64::from(RINGS);
        }
        last = bent;
    }
    WIDEST
}

/// OpenCV's matrix of a panel that is tilted by `tau_x` and `tau_y`, radians.
fn tilt(tau_x: f64, tau_y: f64) -> Result<DMat3, LensError> {
    if tau_x == 0.0 && tau_y == 0.0 {
        return Ok(DMat3::IDENTITY);
    }
    let ((sx, cx), (sy, cy)) = (tau_x.sin_cos(), tau_y.sin_cos());
    let about_x = DMat3::from_cols(DVec3::X, DVec3::new(0.0, cx, -sx), DVec3::new(0.0, sx, cx));
    let about_y = DMat3::from_cols(DVec3::new(cy, 0.0, sy), DVec3::Y, DVec3::new(-sy, 0.0, cy));
    let turn = about_y * about_x;
    let facing = turn.z_axis.z;
    if facing < 80f64.to_radians().cos() {
        return Err(LensError::Tilt(facing.clamp(-1.0, 1.0).acos().to_degrees()));
    }
    let onto = DMat3::from_cols(
        DVec3::new(facing, 0.0, 0.0),
        DVec3::new(0.0, facing, 0.0),
        DVec3::new(-turn.z_axis.x, -turn.z_axis.y, 1.0),
    );
    Ok(onto * turn)
}

/// The point that a homography takes `p` to, if it stays in front.
fn project_by(homography: &DMat3, p: DVec2) -> Option<DVec2> {
    let q = *homography * p.extend(1.0);
    (q.z > 1e-6).then(|| q.truncate() / q.z).filter(|v| v.is_finite())
}

fn invert(m: DMat2) -> Option<DMat2> {
    let det = m.determinant();
    (det > 0.0 && det.is_finite()).then(|| m.inverse())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lenses() -> Vec<Lens> {
        let brown = |c: &[f64]| Lens::opencv(c).unwrap();
        vec![
            brown(&[-0.2, 0.05, 1e-3, -5e-4, 0.01]),
            brown(&[0.3, 0.1, 0.01, 0.01]),
            brown(&[0.6, 0.1, 1e-3, 1e-3, 0.02, 0.8, 0.2, 0.01]),
            brown(&[-0.1, 0.02, 1e-3, 2e-3, 0.0, 0.0, 0.0, 0.0, 4e-3, -1e-3, 3e-3, 1e-3]),
            brown(&[-0.1, 0.02, 1e-3, 2e-3, 0.0, 0.0, 0.0, 0.0, 4e-3, -1e-3, 3e-3, 1e-3, 0.05, -0.08]),
            Lens::fisheye([-0.02, 0.01, -0.003, 0.0004]).unwrap(),
            Lens::fisheye([0.0; 4]).unwrap(),
        ]
    }

    fn points() -> impl Iterator<Item = DVec2> {
        (0..400).map(|i| DVec2::from_angle(f64::from(i) * 2.399) * (0.7 * (f64::from(i) / 400.0).sqrt()))
    }

    #[test]
    fn undistort_inverts_distort_and_stays_inside() {
        for lens in lenses() {
            for p in points().filter(|p| p.length() < lens.limit()) {
                let bent = lens.distort(p).unwrap();
                let back = lens.undistort(bent).unwrap_or_else(|| panic!("{lens:?} {p}"));
                assert!((back - p).length() < 1e-11, "{lens:?}: {p} came back as {back}");
            }
        }
    }

    #[test]
    fn jacobian_is_the_derivative() {
        for lens in lenses() {
            for p in points().chain([DVec2::new(1e-9, 0.0), DVec2::ZERO]).filter(|p| p.length() < 0.69) {
                let h = 1e-6;
                let by = |axis: DVec2| {
                    (lens.distort(p + axis * h).unwrap() - lens.distort(p - axis * h).unwrap()) / (2.0 * h)
                };
                let want = DMat2::from_cols(by(DVec2::X), by(DVec2::Y));
                let off = (lens.jacobian(p) - want).to_cols_array();
                assert!(off.iter().all(|v| v.abs() < 1e-8), "{lens:?} at {p}: {off:?}");
            }
        }
    }

    #[test]
    fn a_lens_that_folds_ends_before_its_fold() {
        // r (1 - 0.5 r^2) grows up to r = sqrt(2 / 3), where the bent ray is 0.544 off the axis.
        let lens = Lens::opencv(&[-0.5, 0.0, 0.0, 0.0]).unwrap();
        assert!((lens.limit() - (2.0f64 / 3.0).sqrt()).abs() < 0.03, "{}", lens.limit());
        assert_eq!(lens.distort(DVec2::new(0.9, 0.0)), None);
        assert_eq!(lens.undistort(DVec2::new(0.6, 0.0)), None);
        let x = |b: DVec2| DVec2::new(0.0, 100.0) + b * 1000.0;
        let fits = |edge: f64| lens.usable_over([DVec2::new(edge, 0.0)].into_iter(), x);
        assert!(fits(0.5).is_ok());
        assert_eq!(fits(0.6), Err(LensError::Folds { pixel: DVec2::new(600.0, 100.0) }));
    }

    #[test]
    fn bad_coefficients_are_named() {
        assert_eq!(Lens::opencv(&[0.1; 7]), Err(LensError::Count(7)));
        assert_eq!(Lens::opencv(&[0.0, f64::NAN, 0.0, 0.0]), Err(LensError::NotFinite(1)));
        assert_eq!(Lens::fisheye([0.0, 0.0, 0.0, f64::INFINITY]), Err(LensError::NotFinite(3)));
        let mut tilted = [0.0; 14];
        tilted[12] = 1.5;
        assert!(matches!(Lens::opencv(&tilted), Err(LensError::Tilt(_))));
        assert!(Lens::opencv(&[0.0; 5]).unwrap().is_pinhole() && Lens::opencv(&[]).unwrap().is_pinhole());
    }

    #[test]
    fn nothing_comes_of_what_is_not_finite_or_far_out() {
        for lens in lenses() {
            for p in [DVec2::NAN, DVec2::INFINITY, DVec2::splat(1e300), DVec2::new(f64::NAN, 0.0)] {
                assert_eq!((lens.distort(p), lens.undistort(p)), (None, None), "{lens:?} {p}");
            }
        }
        assert_eq!(Lens::default().distort(DVec2::splat(7.0)), Some(DVec2::splat(7.0)));
    }
}
