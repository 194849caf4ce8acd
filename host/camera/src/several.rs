//! Samples of several cameras into one course of samples, each in the space of the first camera and with a number of its own.
//!
//! They are not put in order: cameras that expose together give samples of one instant, and one that takes longer to be looked
//! at comes after newer ones. The filter uses them all (`PoseFilterConfig::source_period_ns` of dpm-tracking).

use dpm_device::pose::{Pose, PoseCovariance};
use dpm_device::time::HostTime;
use dpm_device::tracker::TrackerSample;
use glam::{DAffine3, DMat3, DQuat, DVec3};

/// While one camera has seen a body within this time, another one that does not see it says nothing, ns.
const SEEN_FOR_NS: i64 = 100_000_000;

/// What the cameras together have reported of a body.
#[derive(Clone, Copy)]
struct BodyRecord {
    /// The newest instant at which one of them saw it.
    seen_at: HostTime,
    /// Number of the next sample.
    next: u32,
}

/// Joins the samples of cameras.
pub(crate) struct SampleJoin {
    /// Of each camera in the space of the first.
    poses: Vec<DAffine3>,
    bodies: Vec<BodyRecord>,
}

impl SampleJoin {
    /// Of cameras with these poses in the tracker's space, and `bodies` bodies.
    pub(crate) fn new(poses: Vec<DAffine3>, bodies: usize) -> Self {
        let never = HostTime(i64::MIN / 2);
        Self { poses, bodies: vec![BodyRecord { seen_at: never, next: 0 }; bodies] }
    }

    /// A sample of `camera`, in its own space, as it goes on: of a single camera as it is; `None` if a camera does not see what
    /// another one sees.
    pub(crate) fn join(&mut self, camera: usize, sample: TrackerSample) -> Option<TrackerSample> {
        if self.poses.len() == 1 {
            return Some(sample);
        }
        let body = self.bodies.get_mut(usize::from(sample.body.0))?;
        if sample.tracked {
            body.seen_at = body.seen_at.max(sample.captured_at);
        } else if sample.captured_at.ns_since(body.seen_at) < SEEN_FOR_NS {
            return None;
        }
        let sequence = body.next;
        body.next = body.next.wrapping_add(1);
        Some(TrackerSample { sequence, ..placed(&sample, self.poses.get(camera)?) })
    }
}

/// A sample of a camera at `pose`, in the tracker's space.
fn placed(sample: &TrackerSample, pose: &DAffine3) -> TrackerSample {
    let turn = DQuat::from_mat3(&pose.matrix3).normalize();
    let position = pose.transform_point3(DVec3::from_array(sample.pose.position_m));
    let rotation = turn * DQuat::from_array(sample.pose.rotation_xyzw);
    TrackerSample {
        pose: Pose { position_m: position.to_array(), rotation_xyzw: rotation.to_array() },
        covariance: sample.covariance.map(|c| turned(&c, &DMat3::from_quat(turn))),
        ..*sample
    }
}

/// A covariance in axes that are turned by `turn`. A rotation vector turns as a place does.
fn turned(covariance: &PoseCovariance, turn: &DMat3) -> PoseCovariance {
    let from = covariance.matrix();
    let block = |i: usize, j: usize| {
        DMat3::from_cols_array_2d(&std::array::from_fn(|k| {
            std::array::from_fn(|l| from[3 * i + l][3 * j + k])
        }))
    };
    let blocks = [0, 1].map(|i| [0, 1].map(|j| *turn * block(i, j) * turn.transpose()));
    PoseCovariance::of(&std::array::from_fn(|r| {
        std::array::from_fn(|c| blocks[r / 3][c / 3].col(c % 3)[r % 3])
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_common::so3::{so3_between, so3_exp};
    use dpm_device::tracker::BodyIndex;

    const PERIOD_NS: i64 = 10_000_000;

    /// A body that glides and turns steadily, in the tracker's space.
    fn truth(at: HostTime) -> DAffine3 {
        let s = at.0 as f64 * 1e-9;
        DAffine3::from_rotation_translation(
            so3_exp(DVec3::new(0.3, -0.5, 0.2) * s),
            DVec3::new(0.2 * s, -0.1 * s, -1.0),
        )
    }

    /// Where the second of the cameras stands.
    fn second() -> DAffine3 {
        DAffine3::from_rotation_translation(DQuat::from_rotation_y(0.9), DVec3::new(0.8, 0.1, -0.3))
    }

    /// What a camera at `pose` says at `at`, with an error of the position in the tracker's space.
    fn sample(pose: &DAffine3, at: HostTime, error: DVec3) -> TrackerSample {
        let mut body = truth(at);
        body.translation += error;
        let (_, rotation, position) = (pose.inverse() * body).to_scale_rotation_translation();
        let mut covariance = [[0.0; 6]; 6];
        (0..3).for_each(|i| covariance[i][i] = 1e-6);
        (3..6).for_each(|i| covariance[i][i] = 1e-6);
        TrackerSample {
            body: BodyIndex(0),
            pose: Pose { position_m: position.to_array(), rotation_xyzw: rotation.to_array() },
            tracked: true,
            mean_error_m: 1e-3,
            covariance: Some(PoseCovariance::of(&covariance)),
            sequence: 7,
            captured_at: at,
            received_at: at.plus_ns(5_000_000),
        }
    }

    fn off(sample: &TrackerSample) -> [f64; 2] {
        let body = truth(sample.captured_at);
        let turn = DQuat::from_mat3(&body.matrix3);
        [
            (DVec3::from_array(sample.pose.position_m) - body.translation).length(),
            so3_between(turn, DQuat::from_array(sample.pose.rotation_xyzw)).length(),
        ]
    }

    /// Whatever the phase of two cameras and whichever is looked at first, every sample goes on, on the motion, with a number of
    /// its own.
    #[test]
    fn every_sample_of_two_cameras_lies_on_the_motion() {
        for late_ns in [0, 300, 5_000_000, 40_000_000] {
            let mut join = SampleJoin::new(vec![DAffine3::IDENTITY, second()], 1);
            let mut count = 0u32;
            for k in 1..40 {
                let at = HostTime(k * PERIOD_NS);
                let pair = [
                    (0, sample(&DAffine3::IDENTITY, at, DVec3::ZERO)),
                    (1, sample(&second(), at.plus_ns(-late_ns), DVec3::ZERO)),
                ];
                for (camera, sample) in pair {
                    let out = join.join(camera, sample).expect("it is seen");
                    assert!(off(&out).iter().all(|e| *e < 1e-9), "{late_ns}, {k}: {:?}", off(&out));
                    assert_eq!(out.captured_at, sample.captured_at);
                    assert_eq!(out.sequence, count);
                    count += 1;
                }
            }
        }
    }

    /// A camera sees depth worse than what lies across: in the tracker's space, its worst axis is the one along which it looks.
    #[test]
    fn a_covariance_turns_with_its_camera() {
        let mut join = SampleJoin::new(vec![DAffine3::IDENTITY, second()], 1);
        let deep = std::array::from_fn(|i| {
            std::array::from_fn(|j| if i != j { 0.0 } else { [1e-6, 1e-6, 9e-6][i % 3] })
        });
        let seen = TrackerSample {
            covariance: Some(PoseCovariance::of(&deep)),
            ..sample(&second(), HostTime(PERIOD_NS), DVec3::ZERO)
        };
        let matrix = join.join(1, seen).unwrap().covariance.unwrap().matrix();
        let along = second().matrix3 * DVec3::Z;
        for (from, axis, variance) in
            [(0, along, 9e-6), (3, along, 9e-6), (0, DVec3::Y, 1e-6), (3, second().matrix3 * DVec3::X, 1e-6)]
        {
            let axis = axis.to_array();
            let sum: f64 =
                (0..9).map(|n| axis[n / 3] * matrix[from + n / 3][from + n % 3] * axis[n % 3]).sum();
            assert!((sum / variance - 1.0).abs() < 1e-5, "{sum} and {variance}");
        }
    }

    /// While one camera sees a body, another one says nothing of it; when none sees it, it is lost.
    #[test]
    fn a_camera_that_sees_nothing_is_outvoted() {
        let mut join = SampleJoin::new(vec![DAffine3::IDENTITY, second()], 1);
        let at = HostTime(PERIOD_NS);
        join.join(0, sample(&DAffine3::IDENTITY, at, DVec3::ZERO)).expect("seen");
        let blind = |at: HostTime| TrackerSample { tracked: false, ..sample(&second(), at, DVec3::ZERO) };
        assert!(join.join(1, blind(at.plus_ns(1_000_000))).is_none());
        assert!(!join.join(1, blind(at.plus_ns(SEEN_FOR_NS))).expect("nobody sees it").tracked);
    }
}
