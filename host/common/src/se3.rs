//! Rotation vectors into rotations and twists into rigid motions, and back, to rounding error everywhere.
//!
//! Conventions: world-from-body, and tangents on the left (in the world frame): `exp(w) * q` turns `q` by the world-space
//! rotation vector `w`. Closed forms divide by the angle, so below `SERIES_BELOW` a Taylor series takes over; the
//! logarithm uses `2 atan2(|v|, |w|)`, which keeps full precision at angle 0 and at pi where acos loses half the digits.
//! Formulas: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", section IV and appendix.

use dpm_device::pose::Pose;
use glam::{DMat3, DQuat, DVec3};

/// Angle (rad) under which the series replace the closed forms. At 0.25 rad seven terms leave less than 1e-17, and the
/// closed form of (t - sin t) / t^3 above it loses fewer than 3 digits.
const SERIES_BELOW: f64 = 0.25;

/// The rotation by the angle |w| (rad) about the axis w.
pub fn so3_exp(w: DVec3) -> DQuat {
    let angle = w.length();
    let half = 0.5 * angle;
    // sin(angle / 2) / angle, which is 1/2 at 0.
    let scale = if angle < 1e-4 { 0.5 - angle * angle / 48.0 } else { half.sin() / angle };
    DQuat::from_xyzw(w.x * scale, w.y * scale, w.z * scale, half.cos())
}

/// The rotation vector of a unit quaternion, rad, length at most pi. `q` and `-q` give the same vector, except at exactly
/// pi, where both axes are right and the sign of the quaternion decides.
pub fn so3_log(q: DQuat) -> DVec3 {
    let v = DVec3::new(q.x, q.y, q.z);
    let (v, w) = if q.w < 0.0 { (-v, -q.w) } else { (v, q.w) };
    let s = v.length();
    if s < 1e-9 {
        // angle / s = 2 / w to second order.
        return v * (2.0 / w);
    }
    v * (2.0 * s.atan2(w) / s)
}

/// The world-space rotation vector that leads from `from` to `to` along the shorter way.
pub fn so3_between(from: DQuat, to: DQuat) -> DVec3 {
    so3_log(to * from.conjugate())
}

/// `[w]x`, the matrix with `hat(w) * v == w.cross(v)`.
pub fn hat(w: DVec3) -> DMat3 {
    DMat3::from_cols(DVec3::new(0.0, w.z, -w.y), DVec3::new(-w.z, 0.0, w.x), DVec3::new(w.y, -w.x, 0.0))
}

/// (1 - cos t) / t^2 and (t - sin t) / t^3.
fn jacobian_coefficients(t: f64) -> (f64, f64) {
    if t < SERIES_BELOW {
        let x = t * t;
        let mut b = 0.5;
        let mut c = 1.0 / 6.0;
        let (mut term_b, mut term_c) = (b, c);
        for k in 1..7 {
            let k = 2.0 * f64::from(k);
            term_b *= -x / ((k + 1.0) * (k + 2.0));
            term_c *= -x / ((k + 2.0) * (k + 3.0));
            b += term_b;
            c += term_c;
        }
        (b, c)
    } else {
        let half = (0.5 * t).sin();
        (2.0 * half * half / (t * t), (t - t.sin()) / (t * t * t))
    }
}

/// The left Jacobian of SO(3): `exp(w + J^-1 d) = exp(d) exp(w)` to first order in d.
pub fn so3_left_jacobian(w: DVec3) -> DMat3 {
    let (b, c) = jacobian_coefficients(w.length());
    let k = hat(w);
    DMat3::IDENTITY + k * b + k * k * c
}

/// Inverse of [`so3_left_jacobian`]; exact up to and including |w| = pi, singular only at 2 pi.
pub fn so3_left_jacobian_inverse(w: DVec3) -> DMat3 {
    let t = w.length();
    // (1 - (t/2) cot(t/2)) / t^2 = 1/12 + t^2/720 + ... (Bernoulli numbers).
    let d = if t < SERIES_BELOW {
        let x = t * t;
        1.0 / 12.0
            + x * (1.0 / 720.0
                + x * (1.0 / 30_240.0
                    + x * (1.0 / 1_209_600.0 + x * (1.0 / 47_900_160.0 + x * (691.0 / 1.307_674_368e12)))))
    } else {
        let half = 0.5 * t;
        (1.0 - half * half.cos() / half.sin()) / (t * t)
    };
    let k = hat(w);
    DMat3::IDENTITY - k * 0.5 + k * k * d
}

/// A rigid motion: `x -> rotation * x + translation`, lengths in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rigid {
    /// Unit quaternion.
    pub rotation: DQuat,
    /// Metres.
    pub translation: DVec3,
}

/// The logarithm of a rigid motion (a screw): after unit time at this constant twist the motion is reached.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Twist {
    /// Translational part, metres (per unit time).
    pub linear: DVec3,
    /// Rotation vector, rad (per unit time).
    pub angular: DVec3,
}

impl Rigid {
    /// Nothing moves.
    pub const IDENTITY: Self = Self { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// The motion reached after unit time at a constant twist.
    pub fn exp(twist: Twist) -> Self {
        Self {
            rotation: so3_exp(twist.angular),
            translation: so3_left_jacobian(twist.angular) * twist.linear,
        }
    }

    /// Inverse of [`Rigid::exp`], with the angle at most pi.
    pub fn log(self) -> Twist {
        let angular = so3_log(self.rotation);
        Twist { linear: so3_left_jacobian_inverse(angular) * self.translation, angular }
    }

    /// `self` after `first`.
    pub fn compose(self, first: Self) -> Self {
        Self {
            rotation: (self.rotation * first.rotation).normalize(),
            translation: self.rotation * first.translation + self.translation,
        }
    }

    /// Undoes `self`.
    pub fn inverse(self) -> Self {
        let rotation = self.rotation.conjugate();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Where a point lands.
    pub fn transform_point(self, p: DVec3) -> DVec3 {
        self.rotation * p + self.translation
    }
}

impl From<Pose> for Rigid {
    fn from(pose: Pose) -> Self {
        Self {
            rotation: DQuat::from_array(pose.rotation_xyzw),
            translation: DVec3::from_array(pose.position_m),
        }
    }
}

impl From<Rigid> for Pose {
    fn from(rigid: Rigid) -> Self {
        Self { position_m: rigid.translation.to_array(), rotation_xyzw: rigid.rotation.to_array() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::PI;

    const AXES: [DVec3; 4] = [
        DVec3::X,
        DVec3::Y,
        DVec3::Z,
        DVec3::new(0.267_261_241_912_424_4, -0.534_522_483_824_848_8, 0.801_783_725_737_273_2),
    ];

    #[test]
    fn rotation_vector_survives_from_denormal_to_pi() {
        for axis in AXES {
            for angle in [
                0.0,
                1e-300,
                1e-20,
                1e-9,
                0.9e-4,
                1.1e-4,
                1e-3,
                0.2499,
                0.2501,
                1.0,
                3.0,
                PI - 1e-9,
                PI - 1e-12,
            ] {
                let w = axis * angle;
                let back = so3_log(so3_exp(w));
                assert!(
                    (back - w).length() <= 1e-12 * angle.max(1e-300) + 4e-16 * angle,
                    "{axis} {angle}: {back}"
                );
                let q = so3_exp(w);
                assert_eq!(so3_log(-q), so3_log(q));
            }
        }
    }

    #[test]
    fn beyond_pi_takes_the_short_way() {
        for axis in AXES {
            for e in [1e-9, 1e-3, 1.0] {
                let back = so3_log(so3_exp(axis * (2.0 * PI - e)));
                assert!((back + axis * e).length() < 1e-12);
            }
            let at_pi = so3_log(so3_exp(axis * PI));
            assert!((at_pi.length() - PI).abs() < 1e-12);
            assert!(at_pi.cross(axis).length() < 1e-12);
        }
    }

    /// Oracle: the rotation matrix by Rodrigues' formula.
    #[test]
    fn exp_is_rodrigues() {
        for axis in AXES {
            for angle in [1e-8, 0.1, 1.0, 2.0, PI] {
                let k = hat(axis);
                let rodrigues = DMat3::IDENTITY + k * f64::sin(angle) + k * k * (1.0 - f64::cos(angle));
                assert!(DMat3::from_quat(so3_exp(axis * angle)).abs_diff_eq(rodrigues, 1e-14));
            }
        }
    }

    /// Closed form: a screw of pitch p about an axis through c moves c + r to c + R r + p t axis.
    #[test]
    fn screw_is_exact() {
        let (c, axis, pitch) = (DVec3::new(0.3, -2.0, 1.0), AXES[3], 0.7);
        for angle in [1e-7, 1e-3, 0.24, 0.26, 1.5, 3.1] {
            let twist = Twist { angular: axis * angle, linear: c.cross(axis * angle) + axis * pitch * angle };
            let moved = Rigid::exp(twist);
            let r = DVec3::new(0.1, 0.2, -0.4);
            let expected = c + so3_exp(axis * angle) * r + axis * pitch * angle;
            assert!((moved.transform_point(c + r) - expected).length() < 1e-12);
            let back = moved.log();
            assert!(
                (back.linear - twist.linear).length() < 1e-12
                    && (back.angular - twist.angular).length() < 1e-12
            );
        }
    }

    #[test]
    fn series_meet_the_closed_forms() {
        let (below, above) = (SERIES_BELOW * (1.0 - 1e-12), SERIES_BELOW * (1.0 + 1e-12));
        let (b0, c0) = jacobian_coefficients(below);
        let (b1, c1) = jacobian_coefficients(above);
        assert!((b0 - b1).abs() < 1e-13 && (c0 - c1).abs() < 1e-13);
        for axis in AXES {
            let (j0, j1) = (so3_left_jacobian_inverse(axis * below), so3_left_jacobian_inverse(axis * above));
            assert!(j0.abs_diff_eq(j1, 1e-12));
        }
    }

    proptest! {
        #[test]
        fn exp_and_log_are_inverse(w in prop::array::uniform3(-1.8f64..1.8), v in prop::array::uniform3(-1e3f64..1e3)) {
            let twist = Twist { angular: DVec3::from_array(w), linear: DVec3::from_array(v) };
            prop_assume!(twist.angular.length() < PI - 1e-6);
            let back = Rigid::exp(twist).log();
            prop_assert!((back.angular - twist.angular).length() < 1e-12);
            prop_assert!((back.linear - twist.linear).length() < 1e-12 * (1.0 + 20.0 * twist.linear.length()));
        }

        #[test]
        fn jacobian_times_its_inverse(w in prop::array::uniform3(-1.8f64..1.8)) {
            let w = DVec3::from_array(w);
            prop_assert!((so3_left_jacobian(w) * so3_left_jacobian_inverse(w)).abs_diff_eq(DMat3::IDENTITY, 1e-12));
        }

        #[test]
        fn composition_and_inverse(a in prop::array::uniform6(-3f64..3.0), b in prop::array::uniform6(-3f64..3.0)) {
            let motion = |x: [f64; 6]| Rigid::exp(Twist {
                angular: DVec3::new(x[0], x[1], x[2]), linear: DVec3::new(x[3], x[4], x[5]) });
            let (a, b) = (motion(a), motion(b));
            let p = DVec3::new(0.5, -1.0, 2.0);
            prop_assert!((a.compose(b).transform_point(p) - a.transform_point(b.transform_point(p))).length() < 1e-12);
            prop_assert!((a.inverse().compose(a).transform_point(p) - p).length() < 1e-12);
        }
    }
}
