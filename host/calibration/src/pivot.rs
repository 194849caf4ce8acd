//! The tip of the wand in its body's frame, from poses while the tip stays on one fixed point.
//!
//! Every pose says `position + rotation * tip = place`: linear in tip and place. What is not turned is not seen, so the
//! turns must be large enough about two axes.

use crate::dense::svd;
use crate::trajectory::{TimedPose, POSITION_NOISE_M, ROTATION_NOISE_RAD};
use glam::{DMat3, DVec3};
use thiserror::Error;

/// Poses that are collected while the wand is turned about its tip.
#[derive(Clone, Debug, Default)]
pub struct Pivot {
    poses: Vec<TimedPose>,
}

/// A wand's tip.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tip {
    /// In the wand's body frame, metres.
    pub tip: DVec3,
    /// The point of the world on which it stood, metres.
    pub place: DVec3,
    /// Covariance of `tip`, square metres.
    pub covariance: DMat3,
    /// Root mean square distance of the tips by pose from `place`, metres.
    pub residual_m: f64,
    /// Poses used.
    pub poses: usize,
    /// Root mean square turn about the axis about which the wand turned least, radians.
    pub least_turn_rad: f64,
}

/// Why poses do not determine a tip.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum PivotError {
    /// Fewer than [`FEWEST`].
    #[error("wand: {0} poses are too few, {FEWEST} are needed; turn the wand for some seconds longer")]
    TooFew(usize),
    /// A pose is NaN or infinite.
    #[error("wand: pose {0} is not finite; look at the tracker")]
    NotFinite(usize),
    /// The turns do not show all directions of the tip.
    #[error("wand: it turned by only {have_deg:.1} deg (rms) in its weakest direction, {LEAST_TURN_DEG} deg are needed; tilt it to the left and right, and forward and back, while the tip stays in place")]
    TooLittleRotation {
        /// What there is, degrees.
        have_deg: f64,
    },
    /// The tip did not stay on its point.
    #[error(
        "wand: the tip moved by about {moved_mm:.1} mm; hold it in a small dent, and turn the wand again"
    )]
    TipMoved {
        /// How far, millimetres.
        moved_mm: f64,
    },
}

/// Fewest poses.
pub const FEWEST: usize = 40;
/// Least turn (root mean square) about any axis that the tip's place needs, degrees.
pub const LEAST_TURN_DEG: f64 = 5.0;

impl Pivot {
    /// Adds a pose of the wand.
    pub fn add(&mut self, pose: TimedPose) {
        self.poses.push(pose);
    }

    /// What the operator should do next, one sentence.
    pub fn advice(&self) -> String {
        match self.solve() {
            Ok(tip) => format!(
                "the tip is known to {:.3} mm, and better the longer you tilt the wand",
                1e3 * trace(&tip.covariance).sqrt()
            ),
            Err(why) => why.to_string(),
        }
    }

    /// Finds the tip.
    ///
    /// # Errors
    /// Each reason of [`PivotError`].
    pub fn solve(&self) -> Result<Tip, PivotError> {
        let n = self.poses.len();
        if let Some(bad) = self.poses.iter().position(|p| !(p.position.is_finite() && p.rotation.is_finite()))
        {
            return Err(PivotError::NotFinite(bad));
        }
        if n < FEWEST {
            return Err(PivotError::TooFew(n));
        }
        let count = n as f64;
        let turns: Vec<DMat3> = self.poses.iter().map(|p| DMat3::from_quat(p.rotation)).collect();
        let mean_turn = turns.iter().fold(DMat3::ZERO, |sum, r| sum + *r) * (1.0 / count);
        let mean_position = self.poses.iter().map(|p| p.position).sum::<DVec3>() / count;
        // With the place eliminated: (R - mean R) tip = mean p - p.
        let (mut square, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for (p, r) in self.poses.iter().zip(&turns) {
            let centred = *r - mean_turn;
            square += centred.transpose() * centred;
            right += centred.transpose() * (mean_position - p.position);
        }
        let weakest = svd((0..3).map(|i| square.col(i).to_array().to_vec()).collect()).values[2];
        let least_turn_rad = (weakest / count).sqrt();
        if least_turn_rad.to_degrees() < LEAST_TURN_DEG {
            return Err(PivotError::TooLittleRotation { have_deg: least_turn_rad.to_degrees() });
        }
        let inverse = square.inverse();
        let tip = inverse * right;
        let place = mean_position + mean_turn * tip;
        let off: Vec<DVec3> =
            self.poses.iter().zip(&turns).map(|(p, r)| p.position + *r * tip - place).collect();
        let squares: f64 = off.iter().map(|e| e.length_squared()).sum();
        let residual_m = (squares / count).sqrt();
        refuse_a_moved_tip(&off, tip)?;
        let covariance = inverse * (squares / (3.0 * count - 6.0));
        Ok(Tip { tip, place, covariance, residual_m, poses: n, least_turn_rad })
    }
}

/// Residuals of a tip that stood still are white. One that slid shows in means over parts of the time, one that was
/// lifted in single residuals.
fn refuse_a_moved_tip(off: &[DVec3], tip: DVec3) -> Result<(), PivotError> {
    // What a tracker's usual noise does to the tip, along one axis.
    let sigma = (POSITION_NOISE_M.powi(2) + (ROTATION_NOISE_RAD * tip.length()).powi(2)).sqrt();
    const PARTS: usize = 8;
    let length = off.len().div_ceil(PARTS);
    let slid = off
        .chunks(length)
        .filter(|part| 2 * part.len() > length)
        .map(|part| part.iter().sum::<DVec3>().length() / part.len() as f64)
        .fold(0.0, f64::max);
    let jumped = off.iter().map(|e| e.length()).fold(0.0, f64::max);
    if slid > 3.0 * sigma || jumped > 12.0 * sigma {
        return Err(PivotError::TipMoved { moved_mm: 1e3 * slid.max(0.5 * jumped) });
    }
    Ok(())
}

/// Sum of the diagonal of a covariance: the square of the length of a standard deviation.
pub fn trace(m: &DMat3) -> f64 {
    m.x_axis.x + m.y_axis.y + m.z_axis.z
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_common::so3::so3_exp;
    use dpm_device::rng::Draws;
    use glam::DQuat;

    const TIP: DVec3 = DVec3::new(0.03, -0.15, 0.06);
    const PLACE: DVec3 = DVec3::new(0.4, 0.8, -0.3);

    fn wand(n: u32, tilt: DVec3, noise: f64, seed: u64) -> Pivot {
        let draws = Draws::new(seed);
        let mut pivot = Pivot::default();
        for i in 0..n {
            let s = f64::from(i) * 0.01;
            let turn = DQuat::from_rotation_y(0.7)
                * so3_exp(DVec3::new((3.1 * s).sin(), (1.3 * s).sin(), (2.2 * s).cos()) * tilt);
            let normal = |k: u64| DVec3::from_array(draws.normal3(u64::from(i) * 2 + k));
            let rotation = so3_exp(normal(0) * ROTATION_NOISE_RAD * noise) * turn;
            let position = PLACE - turn * TIP + normal(1) * POSITION_NOISE_M * noise;
            pivot.add(TimedPose { stamp_ns: i64::from(i) * 4_000_000, position, rotation });
        }
        pivot
    }

    #[test]
    fn exact_poses_give_the_exact_tip() {
        let got = wand(100, DVec3::splat(0.4), 0.0, 1).solve().unwrap();
        assert!((got.tip - TIP).length() < 1e-12 && (got.place - PLACE).length() < 1e-12);
    }

    #[test]
    fn the_error_is_as_large_as_the_covariance_says() {
        let (mut ratio, runs) = (0.0, 60);
        for seed in 0..runs {
            let got = wand(2000, DVec3::splat(0.4), 1.0, seed).solve().unwrap();
            let e = got.tip - TIP;
            assert!(e.length() < 5e-5, "{e}");
            ratio += e.dot(got.covariance.inverse() * e) / 3.0;
        }
        // Chi squared with 180 degrees of freedom, over 180.
        let mean = ratio / runs as f64;
        assert!((0.6..1.5).contains(&mean), "{mean}");
    }

    #[test]
    fn few_poses_few_turns_and_one_axis_are_refused_by_name() {
        assert_eq!(wand(39, DVec3::splat(0.4), 1.0, 1).solve(), Err(PivotError::TooFew(39)));
        for tilt in [DVec3::ZERO, DVec3::splat(0.03), DVec3::X * 0.6, DVec3::Y * 0.6] {
            let got = wand(2000, tilt, 1.0, 1).solve();
            assert!(matches!(got, Err(PivotError::TooLittleRotation { .. })), "{tilt}: {got:?}");
        }
        let mut bad = wand(100, DVec3::splat(0.4), 1.0, 1);
        bad.poses[7].position.y = f64::NAN;
        assert_eq!(bad.solve(), Err(PivotError::NotFinite(7)));
    }

    #[test]
    fn a_tip_that_slid_or_was_lifted_is_refused() {
        let mut slid = wand(2000, DVec3::splat(0.4), 1.0, 3);
        slid.poses.iter_mut().enumerate().for_each(|(i, p)| p.position.x += 2e-3 * i as f64 / 2000.0);
        assert!(matches!(slid.solve(), Err(PivotError::TipMoved { moved_mm }) if moved_mm > 0.4));
        let mut lifted = wand(2000, DVec3::splat(0.4), 1.0, 4);
        lifted.poses[1200..1215].iter_mut().for_each(|p| p.position.z += 0.01);
        assert!(matches!(lifted.solve(), Err(PivotError::TipMoved { .. })));
        assert!(slid.advice().contains("the tip moved"));
    }
}
