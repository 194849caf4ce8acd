//! Poses of a tracked body at the tracker's instants into its pose at any instant between them.
//!
//! Around every sample a parabola is fitted to the nearest five, for position and turn; between two samples their
//! parabolas are blended. A straight line between samples would cut the corners of a hand's motion by more than the
//! tracker's noise.

use dpm_common::so3::{so3_between, so3_exp};
use dpm_device::pose::Pose;
use glam::{DQuat, DVec3};

/// Noise of a good optical tracker along one axis, metres: what is assumed where nothing better is known.
pub const POSITION_NOISE_M: f64 = 1e-4;
/// The same of its rotation, about one axis: 0.05 degrees.
pub const ROTATION_NOISE_RAD: f64 = 0.05 * std::f64::consts::PI / 180.0;

/// A pose at an instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimedPose {
    /// The instant by the host's clock, nanoseconds.
    pub stamp_ns: i64,
    /// Of the body's origin, metres.
    pub position: DVec3,
    /// World from body.
    pub rotation: DQuat,
}

impl TimedPose {
    /// From the vocabulary of trackers; `None` where the pose is not a pose.
    pub fn new(stamp_ns: i64, pose: &Pose) -> Option<Self> {
        let rotation = DQuat::from_array(pose.rotation_xyzw);
        pose.is_valid(1e-2).then(|| Self {
            stamp_ns,
            position: DVec3::from_array(pose.position_m),
            rotation: rotation.normalize(),
        })
    }

    /// Where a point of the body is in the world.
    pub fn place(&self, point: DVec3) -> DVec3 {
        self.position + self.rotation * point
    }
}

/// A pose with its rate of change.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Moving {
    /// Of the body's origin, metres.
    pub position: DVec3,
    /// World from body.
    pub rotation: DQuat,
    /// Metres a second.
    pub velocity: DVec3,
    /// Radians a second, in the world.
    pub turning: DVec3,
}

/// A parabola through six numbers around a sample: seconds into position and rotation vector, both relative to it.
#[derive(Clone, Copy, Debug)]
struct Parabola {
    stamp_ns: i64,
    position: [DVec3; 3],
    turn: [DVec3; 3],
    rotation: DQuat,
}

/// The path of a body.
#[derive(Clone, Debug)]
pub struct Trajectory {
    parabolas: Vec<Parabola>,
    longest_gap_ns: i64,
}

/// Samples to either side of a parabola's middle.
const SIDE: usize = 2;

impl Trajectory {
    /// From samples in any order; those at the same instant count once. Where the samples lie further apart than three
    /// times their usual distance, the path is unknown.
    pub fn new(samples: &[TimedPose]) -> Self {
        let mut sorted = samples.to_vec();
        sorted.sort_by_key(|s| s.stamp_ns);
        sorted.dedup_by_key(|s| s.stamp_ns);
        let mut gaps: Vec<i64> =
            sorted.windows(2).map(|w| w[1].stamp_ns.saturating_sub(w[0].stamp_ns)).collect();
        gaps.sort_unstable();
        let longest_gap_ns = gaps.get(gaps.len() / 2).map_or(0, |g| g.saturating_mul(3));
        let parabolas = (0..sorted.len()).map(|i| parabola(&sorted, i, longest_gap_ns)).collect();
        Self { parabolas, longest_gap_ns }
    }

    /// First and last instant; `None` when there is no sample.
    pub fn span_ns(&self) -> Option<(i64, i64)> {
        Some((self.parabolas.first()?.stamp_ns, self.parabolas.last()?.stamp_ns))
    }

    /// The usual distance of two samples, nanoseconds.
    pub fn period_ns(&self) -> i64 {
        self.longest_gap_ns / 3
    }

    /// The pose at an instant (nanoseconds and a fraction of them); `None` before the first sample, after the last and
    /// in gaps.
    pub fn at(&self, stamp_ns: i64, fraction_ns: f64) -> Option<Moving> {
        let after = self.parabolas.partition_point(|p| p.stamp_ns <= stamp_ns);
        let (a, b) = (self.parabolas.get(after.checked_sub(1)?)?, self.parabolas.get(after)?);
        let gap = b.stamp_ns - a.stamp_ns;
        if gap > self.longest_gap_ns {
            return None;
        }
        let (s, step) = (1e-9 * ((stamp_ns - a.stamp_ns) as f64 + fraction_ns), 1e-9 * gap as f64);
        let share = s / step;
        let (from_a, from_b) = (a.at(s), b.at(s - step));
        let apart = from_b.position - from_a.position;
        let turned = so3_between(from_a.rotation, from_b.rotation);
        Some(Moving {
            position: from_a.position + apart * share,
            rotation: so3_exp(turned * share) * from_a.rotation,
            velocity: from_a.velocity.lerp(from_b.velocity, share) + apart / step,
            turning: from_a.turning.lerp(from_b.turning, share) + turned / step,
        })
    }
}

impl Parabola {
    fn at(&self, s: f64) -> Moving {
        let value = |c: &[DVec3; 3]| c[0] + s * (c[1] + s * c[2]);
        let slope = |c: &[DVec3; 3]| c[1] + 2.0 * s * c[2];
        Moving {
            position: value(&self.position),
            rotation: so3_exp(value(&self.turn)) * self.rotation,
            velocity: slope(&self.position),
            // Turns between neighbouring samples are small, so the rate of the rotation vector is the rate of turn.
            turning: slope(&self.turn),
        }
    }
}

fn parabola(samples: &[TimedPose], middle: usize, longest_gap_ns: i64) -> Parabola {
    let here = samples[middle];
    let near = |i: &usize| {
        let apart = samples[*i].stamp_ns.abs_diff(here.stamp_ns);
        apart <= (longest_gap_ns.unsigned_abs()).saturating_mul(SIDE as u64)
    };
    let range = middle.saturating_sub(SIDE)..(middle + SIDE + 1).min(samples.len());
    let used: Vec<usize> = range.filter(near).collect();
    let unit = 1e-9 * (longest_gap_ns.max(1) as f64);
    // Moments of time, in units that keep the matrix near 1.
    let mut m = [0.0; 5];
    let (mut p, mut w) = ([DVec3::ZERO; 3], [DVec3::ZERO; 3]);
    for &i in &used {
        let s = 1e-9 * (samples[i].stamp_ns - here.stamp_ns) as f64 / unit;
        let turn = so3_between(here.rotation, samples[i].rotation);
        let powers = [1.0, s, s * s];
        (0..5).for_each(|k| m[k] += s.powi(k as i32));
        (0..3).for_each(|k| {
            p[k] += samples[i].position * powers[k];
            w[k] += turn * powers[k];
        });
    }
    let square = glam::DMat3::from_cols_array(&[m[0], m[1], m[2], m[1], m[2], m[3], m[2], m[3], m[4]]);
    let known = used.len() >= 4 && square.determinant().abs() > 1e-9;
    let solve = |right: [DVec3; 3], own: DVec3| {
        if !known {
            return [own, DVec3::ZERO, DVec3::ZERO];
        }
        let inverse = square.inverse();
        let row = |k: usize| {
            right[0] * inverse.col(0)[k] + right[1] * inverse.col(1)[k] + right[2] * inverse.col(2)[k]
        };
        [row(0), row(1) / unit, row(2) / (unit * unit)]
    };
    Parabola {
        stamp_ns: here.stamp_ns,
        position: solve(p, here.position),
        turn: solve(w, DVec3::ZERO),
        rotation: here.rotation,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::rng::Draws;

    fn truth(s: f64) -> (DVec3, DQuat) {
        let position =
            DVec3::new((6.0 * s).sin() * 0.1, (4.0 * s).cos() * 0.12, (5.0 * s + 1.0).sin() * 0.08);
        (position, so3_exp(DVec3::new((3.0 * s).sin(), (4.0 * s).cos(), (2.0 * s).sin()) * 0.4))
    }

    fn path(noise: f64) -> Trajectory {
        let draws = Draws::new(5);
        let samples: Vec<TimedPose> = (0..480)
            .map(|i| {
                let (position, rotation) = truth(i as f64 / 240.0);
                let stamp_ns = i * 1_000_000_000 / 240;
                let e = DVec3::from_array(draws.normal3(i as u64)) * noise;
                TimedPose { stamp_ns, position: position + e, rotation }
            })
            .collect();
        Trajectory::new(&samples)
    }

    #[test]
    fn between_the_samples_of_a_hand_the_error_is_below_ten_micrometres() {
        let path = path(0.0);
        for i in 3..900 {
            let ns = i * 2_111_111;
            if ns > 1_980_000_000 {
                break;
            }
            let s = 1e-9 * ns as f64;
            let (got, (p, q)) = (path.at(ns, 0.0).unwrap(), truth(s));
            assert!((got.position - p).length() < 1e-5, "{i}");
            assert!(so3_between(got.rotation, q).length() < 1e-4);
            let h = 1e-6;
            let v = (truth(s + h).0 - truth(s - h).0) / (2.0 * h);
            assert!((got.velocity - v).length() < 5e-3, "{} {v}", got.velocity);
            let w = so3_between(truth(s - h).1, truth(s + h).1) / (2.0 * h);
            assert!((got.turning - w).length() < 3e-2, "{} {w}", got.turning);
        }
    }

    #[test]
    fn the_noise_is_not_amplified() {
        let (exact, noisy) = (path(0.0), path(1e-3));
        let instants = (3..600).map(|i| i * 3_000_001).filter(|ns| *ns < 1_900_000_000);
        let e: Vec<f64> = instants
            .map(|ns| (noisy.at(ns, 0.0).unwrap().position - exact.at(ns, 0.0).unwrap().position).x)
            .collect();
        let rms = (e.iter().map(|x| x * x).sum::<f64>() / e.len() as f64).sqrt();
        assert!(rms < 0.9e-3, "{rms}");
    }

    #[test]
    fn outside_and_in_gaps_the_path_is_unknown() {
        let samples: Vec<TimedPose> = (0..100)
            .filter(|i| !(40..60).contains(i))
            .map(|i| TimedPose { stamp_ns: i * 4_000_000, position: DVec3::ZERO, rotation: DQuat::IDENTITY })
            .collect();
        let path = Trajectory::new(&samples);
        assert!(path.at(-1, 0.0).is_none() && path.at(400_000_000, 0.0).is_none());
        assert!(path.at(200_000_000, 0.0).is_none() && path.at(100_000_000, 0.0).is_some());
        assert!(Trajectory::new(&[]).at(0, 0.0).is_none());
    }
}
