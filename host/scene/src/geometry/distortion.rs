//! Lens distortion of the Brown-Conrady kind with rational radial terms and thin prism: converts straight rays to bent
//! ones and back.
//!
//! Coordinates are `x / z`, `y / z` before the focal length, x right and y down. Distortion is invertible only around
//! the axis, where it grows with the angle: farther out several rays share one pixel, and the answer is `None`.

use glam::DVec2;

/// Coefficients in the customary order k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4; missing ones are 0.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distortion {
    /// All twelve coefficients.
    pub c: [f64; 12],
}

/// Rays farther than this from the axis (x / z) are not considered: 84 degrees.
const WIDEST: f64 = 10.0;

impl Distortion {
    /// `None` when a coefficient is not finite.
    pub fn new(coefficients: &[f64]) -> Option<Self> {
        if coefficients.len() > 12 || coefficients.iter().any(|c| !c.is_finite()) {
            return None;
        }
        let mut c = [0.0; 12];
        c[..coefficients.len()].copy_from_slice(coefficients);
        Some(Self { c })
    }

    /// True without distortion.
    pub(crate) fn is_none(&self) -> bool {
        self.c.iter().all(|c| *c == 0.0)
    }

    fn radial(&self, r2: f64) -> f64 {
        let [k1, k2, _, _, k3, k4, k5, k6, ..] = self.c;
        let up = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let down = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
        up / down
    }

    fn bend(&self, p: DVec2) -> DVec2 {
        let [_, _, p1, p2, _, _, _, _, s1, s2, s3, s4] = self.c;
        let r2 = p.length_squared();
        let tangential = DVec2::new(
            2.0 * p1 * p.x * p.y + p2 * (r2 + 2.0 * p.x * p.x),
            p1 * (r2 + 2.0 * p.y * p.y) + 2.0 * p2 * p.x * p.y,
        );
        let prism = DVec2::new(r2 * (s1 + r2 * s2), r2 * (s3 + r2 * s4));
        p * self.radial(r2) + tangential + prism
    }

    /// Largest r up to which `r * radial(r^2)` grows, by scanning; the lens is not invertible beyond it.
    pub(crate) fn valid_radius(&self) -> f64 {
        const STEPS: u32 = 4000;
        let mut last = 0.0;
        for i in 1..=STEPS {
            let r = WIDEST * f64::from(i) / f64::from(STEPS);
            let bent = r * self.radial(r * r);
            if bent.is_nan() || bent <= last {
                return WIDEST * f64::from(i - 1) / f64::from(STEPS);
            }
            last = bent;
        }
        WIDEST
    }

    /// The bent ray of a straight one; `None` outside the valid part of the lens.
    pub fn distort(&self, straight: DVec2) -> Option<DVec2> {
        if self.is_none() {
            return straight.is_finite().then_some(straight);
        }
        if straight.is_nan() || straight.length() > self.valid_radius() {
            return None;
        }
        let bent = self.bend(straight);
        bent.is_finite().then_some(bent)
    }

    /// The straight ray of a bent one, to 1e-12; `None` if no ray of the valid part of the lens leads there.
    pub fn undistort(&self, bent: DVec2) -> Option<DVec2> {
        if self.is_none() {
            return bent.is_finite().then_some(bent);
        }
        let limit = self.valid_radius();
        // The radial part alone is monotone up to the limit: bisection finds the start, so that Newton cannot leave the
        // right branch.
        let target = bent.length();
        let (mut low, mut high) = (0.0, limit);
        if target.is_nan() || target > 1.5 * limit * self.radial(limit * limit) {
            return None;
        }
        for _ in 0..50 {
            let r = 0.5 * (low + high);
            if r * self.radial(r * r) < target {
                low = r
            } else {
                high = r
            }
        }
        let mut p = bent.normalize_or_zero() * low;
        for _ in 0..30 {
            let error = self.bend(p) - bent;
            if error.length() <= 1e-13 * (1.0 + target) {
                return (p.length() <= limit).then_some(p);
            }
            let h = 1e-7 * (1.0 + p.length());
            let (dx, dy) = (
                (self.bend(p + DVec2::X * h) - self.bend(p - DVec2::X * h)) / (2.0 * h),
                (self.bend(p + DVec2::Y * h) - self.bend(p - DVec2::Y * h)) / (2.0 * h),
            );
            let det = dx.x * dy.y - dx.y * dy.x;
            if det.is_nan() || det <= 0.0 {
                return None;
            }
            p -= DVec2::new(dy.y * error.x - dy.x * error.y, dx.x * error.y - dx.y * error.x) / det;
            if !p.is_finite() {
                return None;
            }
        }
        let error = (self.bend(p) - bent).length();
        (error <= 1e-11 * (1.0 + target) && p.length() <= limit).then_some(p)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid() -> impl Iterator<Item = DVec2> {
        (-10..=10).flat_map(|i| (-10..=10).map(move |j| DVec2::new(f64::from(i), f64::from(j)) * 0.06))
    }

    #[test]
    fn undistort_inverts_distort() {
        for c in [
            vec![-0.2, 0.05, 0.001, -0.002, -0.004],
            vec![0.3, 0.1, 0.0, 0.0, 0.0, 0.1, 0.02, 0.0, 0.001, 0.0, -0.001, 0.0],
            vec![],
        ] {
            let d = Distortion::new(&c).unwrap();
            for p in grid() {
                let back = d.undistort(d.distort(p).unwrap()).unwrap();
                assert!((back - p).length() < 1e-11, "{c:?} {p} {back}");
            }
        }
    }

    #[test]
    fn a_hand_computed_point() {
        // x = 0.5, y = 0: r2 = 0.25; radial 1 + 0.1 * 0.25 + 0.01 * 0.0625 = 1.025625; p2 * 3 r2 = 0.02 * 0.75.
        let d = Distortion::new(&[0.1, 0.01, 0.03, 0.02]).unwrap();
        let got = d.distort(DVec2::new(0.5, 0.0)).unwrap();
        assert!((got - DVec2::new(0.5 * 1.025625 + 0.015, 0.03 * 0.25)).length() < 1e-15);
    }

    #[test]
    fn beyond_the_turning_point_there_is_no_answer() {
        // r (1 - 0.5 r^2) grows up to r = sqrt(2 / 3), where it is 0.5443.
        let d = Distortion::new(&[-0.5]).unwrap();
        assert!((d.valid_radius() - (2.0f64 / 3.0).sqrt()).abs() < 5e-3);
        assert!(d.distort(DVec2::X * 0.9).is_none() && d.undistort(DVec2::X * 0.56).is_none());
        assert!(d.undistort(DVec2::X * 0.53).unwrap().x < 0.8166);
        assert!(d.undistort(DVec2::NAN).is_none() && d.distort(DVec2::NAN).is_none());
        assert!(d.undistort(DVec2::X * 1e300).is_none());
        assert!(Distortion::new(&[f64::NAN]).is_none() && Distortion::new(&[0.0; 13]).is_none());
    }
}
