//! Samples of several cameras into one course of samples: each in the space of the first camera, with a number of its own, in
//! the order of their instants.
//!
//! Cameras that expose at the same time, or of which one takes longer to look at a picture, report instants that another one
//! has reported already. Such a sample counts as much as any: it is moved to just after the newest instant, with the motion
//! between the last two samples of its own camera.

use dpm_common::so3::{so3_between, so3_exp};
use dpm_device::pose::{Pose, PoseCovariance};
use dpm_device::time::HostTime;
use dpm_device::tracker::TrackerSample;
use glam::{DAffine3, DMat3, DQuat, DVec3};

/// While one camera has seen a body within this time, another one that does not see it says nothing, ns.
const SEEN_FOR_NS: i64 = 100_000_000;
/// How long after the newest instant a moved sample comes, ns.
const STEP_NS: i64 = 1_000;
/// Two samples of a camera that lie farther apart say nothing of the motion now, ns.
const MOTION_FOR_NS: i64 = 250_000_000;

/// What the cameras together have reported of a body.
#[derive(Clone, Copy)]
struct Together {
    /// The newest instant at which one of them saw it.
    seen_at: HostTime,
    /// The newest instant that was reported.
    newest: HostTime,
    /// Number of the next sample.
    next: u32,
}

/// Joins the samples of cameras.
pub(crate) struct SampleJoin {
    /// Of each camera in the space of the first.
    poses: Vec<DAffine3>,
    bodies: Vec<Together>,
    /// The last sample in which each camera saw each body, camera by camera.
    last: Vec<Option<TrackerSample>>,
}

impl SampleJoin {
    /// Of cameras with these poses in the tracker's space, and `bodies` bodies.
    pub(crate) fn new(poses: Vec<DAffine3>, bodies: usize) -> Self {
        let never = HostTime(i64::MIN / 2);
        let last = vec![None; poses.len() * bodies];
        Self { poses, bodies: vec![Together { seen_at: never, newest: never, next: 0 }; bodies], last }
    }

    /// A sample of `camera`, in its own space, as it goes on: of a single camera as it is; `None` if a camera does not see what
    /// another one sees. One that is too old to be moved stays as it is.
    pub(crate) fn join(&mut self, camera: usize, sample: TrackerSample) -> Option<TrackerSample> {
        if self.poses.len() == 1 {
            return Some(sample);
        }
        let index = usize::from(sample.body.0);
        let bodies = self.bodies.len();
        let body = self.bodies.get_mut(index)?;
        let mut sample = placed(&sample, self.poses.get(camera)?);
        if sample.tracked {
            body.seen_at = body.seen_at.max(sample.captured_at);
            let before = self.last[camera * bodies + index].replace(sample);
            let behind_ns = body.newest.ns_since(sample.captured_at).saturating_add(STEP_NS);
            if behind_ns > 0 {
                sample = before.and_then(|before| moved(&before, &sample, behind_ns)).unwrap_or(sample);
            }
        } else if sample.captured_at.ns_since(body.seen_at) < SEEN_FOR_NS {
            return None;
        }
        body.newest = body.newest.max(sample.captured_at);
        sample.sequence = body.next;
        body.next = body.next.wrapping_add(1);
        Some(sample)
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

/// `sample` after another `ns` of the motion since `before`; `None` if that says nothing of it: `ns` is longer than the time
/// between the two. With r as the ratio of both times, (1 + r) of the new sample less r of the old one has the variance
/// (1 + r)^2 + r^2 of one.
fn moved(before: &TrackerSample, sample: &TrackerSample, ns: i64) -> Option<TrackerSample> {
    let interval_ns = sample.captured_at.ns_since(before.captured_at);
    if !(1..MOTION_FOR_NS).contains(&interval_ns) || ns > interval_ns {
        return None;
    }
    let r = ns as f64 / interval_ns as f64;
    let [from, to] = [before, sample].map(|s| DVec3::from_array(s.pose.position_m));
    let [turn_from, turn_to] = [before, sample].map(|s| DQuat::from_array(s.pose.rotation_xyzw));
    let position = to + (to - from) * r;
    let rotation = (so3_exp(so3_between(turn_from, turn_to) * r) * turn_to).normalize();
    let variance = (1.0 + r).powi(2) + r * r;
    Some(TrackerSample {
        pose: Pose { position_m: position.to_array(), rotation_xyzw: rotation.to_array() },
        covariance: sample.covariance.map(|c| PoseCovariance { lower: c.lower.map(|v| v * variance as f32) }),
        mean_error_m: sample.mean_error_m * variance.sqrt() as f32,
        captured_at: sample.captured_at.plus_ns(ns),
        ..*sample
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::rng::Draws;
    use dpm_device::tracker::BodyIndex;
    use dpm_tracking::{PoseFilter, PoseFilterConfig};

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

    /// Whatever the phase of two cameras and whichever is looked at first, no sample of a steady motion is dropped, each lies on
    /// the motion, and instants and numbers only grow.
    #[test]
    fn every_sample_of_two_cameras_counts_and_lies_on_the_motion() {
        for late_ns in [0, 300, 2_000_000, 5_000_000, 9_000_000] {
            let mut join = SampleJoin::new(vec![DAffine3::IDENTITY, second()], 1);
            let (mut newest, mut count) = (HostTime(i64::MIN), 0u32);
            for k in 1..40 {
                let at = HostTime(k * PERIOD_NS);
                let pair = [
                    (0, sample(&DAffine3::IDENTITY, at, DVec3::ZERO)),
                    (1, sample(&second(), at.plus_ns(-late_ns), DVec3::ZERO)),
                ];
                for (camera, sample) in pair {
                    let out = join.join(camera, sample).expect("it is seen");
                    // The first sample of a late camera has no motion yet.
                    if k > 1 {
                        assert!(out.captured_at > newest, "{late_ns}, {k}");
                        assert!(off(&out).iter().all(|e| *e < 1e-9), "{late_ns}, {k}: {:?}", off(&out));
                    }
                    newest = newest.max(out.captured_at);
                    assert_eq!(out.sequence, count);
                    count += 1;
                }
            }
        }
    }

    /// The stated variance of a moved sample is that of its errors, along every axis of the tracker.
    #[test]
    fn a_moved_sample_states_what_it_errs() {
        let (draws, late_ns) = (Draws::new(5), 6_000_000);
        let mut join = SampleJoin::new(vec![DAffine3::IDENTITY, second()], 1);
        let mut sums = [DVec3::ZERO; 2];
        for k in 1..20_000i64 {
            let at = HostTime(k * PERIOD_NS);
            let error = DVec3::from_array([0, 1, 2].map(|i| 1e-3 * draws.normal(4 * k as u64 + i)));
            join.join(0, sample(&DAffine3::IDENTITY, at, DVec3::ZERO));
            let out = join.join(1, sample(&second(), at.plus_ns(-late_ns), error)).unwrap();
            if k > 1 {
                let e = DVec3::from_array(out.pose.position_m) - truth(out.captured_at).translation;
                let [stated, _] = out.covariance.unwrap().variances().unwrap();
                sums[0] += e * e;
                sums[1] += DVec3::from_array(stated);
            }
        }
        // Four standard deviations of a variance from so many samples of which neighbours share an error are 0.06.
        let ratio = sums[0] / sums[1];
        assert!((ratio - DVec3::ONE).abs().max_element() < 0.06, "{ratio}");
    }

    /// Two cameras that expose together halve the variance: the filter's error at rest falls to 1 / sqrt(2) of one camera's.
    #[test]
    fn two_cameras_that_expose_together_err_less_than_one() {
        let draws = Draws::new(11);
        let mut sums = [0.0; 2];
        for run in 0..200u64 {
            for (cameras, sum) in [1usize, 2].into_iter().zip(&mut sums) {
                let poses = [DAffine3::IDENTITY, second()];
                let mut join = SampleJoin::new(poses[..cameras].to_vec(), 1);
                let mut filter = PoseFilter::new(PoseFilterConfig::default());
                for k in 1..30i64 {
                    for (camera, pose) in poses[..cameras].iter().enumerate() {
                        let n = (run * 30 + k as u64) * 8 + camera as u64 * 4;
                        let error = DVec3::from_array([0, 1, 2].map(|i| 1e-3 * draws.normal(n + i)));
                        let out = join.join(camera, sample(pose, HostTime(k * PERIOD_NS), error)).unwrap();
                        filter.update(&out);
                    }
                }
                let at = HostTime(29 * PERIOD_NS + STEP_NS);
                let found = filter.predict(at).expect("a track").pose.position_m;
                *sum += (DVec3::from_array(found) - truth(at).translation).length_squared();
            }
        }
        // 600 squares a sum: four standard deviations of the ratio of the roots are 0.16.
        let ratio = (sums[1] / sums[0]).sqrt();
        assert!((ratio - 0.5f64.sqrt()).abs() < 0.1, "{ratio}");
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
