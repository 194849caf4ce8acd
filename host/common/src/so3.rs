//! Converts rotation vectors to rotations and back, to rounding error everywhere.
//!
//! Conventions: world-from-body, and tangents on the left (in the world frame): `exp(w) * q` turns `q` by the
//! world-space rotation vector `w`. The closed form divides by the angle, so a series replaces it below 1e-4 rad. The
//! logarithm uses `2 atan2(|v|, |w|)`, which keeps full precision at angle 0 and at pi, where acos loses half the
//! digits; below 0.1 rad the series of the arc tangent, which costs a third. Formulas: Solà, Deray, Atchuthan, "A micro
//! Lie theory for state estimation in robotics", section IV and appendix.

use glam::{DMat3, DQuat, DVec3};

/// The squared tangent of half an angle below which the logarithm takes the series: 0.1 rad.
const NEAR_TAN2: f64 = 0.0025;
/// Factors of the powers of t^2 in atan(t) / t.
const ARC_TANGENT: [f64; 6] = [1.0, -1.0 / 3.0, 0.2, -1.0 / 7.0, 1.0 / 9.0, -1.0 / 11.0];

/// The rotation by the angle |w| (rad) about the axis w.
pub fn so3_exp(w: DVec3) -> DQuat {
    let angle = w.length();
    let half = 0.5 * angle;
    // sin(angle / 2) / angle, which is 1/2 at 0.
    let scale = if angle < 1e-4 { 0.5 - angle * angle / 48.0 } else { libm::sin(half) / angle };
    DQuat::from_xyzw(w.x * scale, w.y * scale, w.z * scale, libm::cos(half))
}

/// The rotation vector of a unit quaternion, rad, length at most pi. `q` and `-q` give the same vector, except at exactly
/// pi, where both axes are right and the sign of the quaternion decides.
pub fn so3_log(q: DQuat) -> DVec3 {
    let v = DVec3::new(q.x, q.y, q.z);
    let (v, w) = if q.w < 0.0 { (-v, -q.w) } else { (v, q.w) };
    let per_w = 1.0 / w;
    // The square of the tangent of half the angle.
    let t2 = v.length_squared() * (per_w * per_w);
    if t2 < NEAR_TAN2 {
        // atan(t) / t; the next term is below 2e-17.
        let series = ARC_TANGENT.iter().rev().fold(0.0, |sum, term| sum * t2 + term);
        return v * (2.0 * per_w * series);
    }
    let s = v.length();
    v * (2.0 * libm::atan2(s, w) / s)
}

/// The world-space rotation vector that leads from `from` to `to` along the shorter way.
pub fn so3_between(from: DQuat, to: DQuat) -> DVec3 {
    so3_log(to * from.conjugate())
}

/// `[w]x`, the matrix with `hat(w) * v == w.cross(v)`.
pub fn hat(w: DVec3) -> DMat3 {
    DMat3::from_cols(DVec3::new(0.0, w.z, -w.y), DVec3::new(-w.z, 0.0, w.x), DVec3::new(w.y, -w.x, 0.0))
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
                0.0999,
                0.1001,
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

    proptest! {
        #[test]
        fn exp_and_log_are_inverse(w in prop::array::uniform3(-1.8f64..1.8)) {
            let w = DVec3::from_array(w);
            prop_assume!(w.length() < PI - 1e-6);
            prop_assert!((so3_log(so3_exp(w)) - w).length() < 1e-12);
        }
    }
}
