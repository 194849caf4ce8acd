//! From the tracker's coordinates and time stamps to the world's: `tracker.transform` and `tracker.latency_us`.

use crate::rig::pose_of;
use crate::trackers::TrackerConfig;
use dpm_device::pose::{Pose, PoseCovariance};
use dpm_device::tracker::TrackerSample;
use glam::{DAffine3, DMat3, DQuat, DVec3};

/// How a tracker's samples become poses of the world.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TrackerFrame {
    /// Rigid motion after the exchange of axes.
    world_from_axes: DAffine3,
    /// Exchange of axes, possibly with a mirror.
    axes: DMat3,
    /// Metres in the tracker's unit.
    scale: f64,
    /// By how much samples are older than they say, nanoseconds.
    latency_ns: i64,
}

impl TrackerFrame {
    /// What the rig file says; `None` if samples are used as they are. `latency_ns` was measured and takes the place of
    /// `tracker.latency_us`.
    pub(crate) fn of(config: &TrackerConfig, latency_ns: Option<i64>) -> Option<Self> {
        let (transform, latency_us) = config.frame()?;
        let frame = Self {
            world_from_axes: transform.pose().unwrap_or(DAffine3::IDENTITY),
            axes: transform.axes.matrix(),
            scale: transform.scale,
            latency_ns: latency_ns.unwrap_or(latency_us * 1000),
        };
        let plain = frame.world_from_axes == DAffine3::IDENTITY
            && frame.axes == DMat3::IDENTITY
            && frame.scale == 1.0
            && frame.latency_ns == 0;
        (!plain).then_some(frame)
    }

    /// A sample in the world. The axes of bodies are exchanged like those of the world, so a body that the tracker
    /// reports without rotation has none after an exchange of axes either.
    pub(crate) fn apply(&self, sample: &TrackerSample) -> TrackerSample {
        let mut sample = *sample;
        sample.captured_at = sample.captured_at.plus_ns(-self.latency_ns);
        let position = self.axes * DVec3::from_array(sample.pose.position_m) * self.scale;
        let rotation = self.turned(DQuat::from_array(sample.pose.rotation_xyzw));
        let in_axes = DAffine3::from_rotation_translation(rotation, position);
        let length = DQuat::from_array(sample.pose.rotation_xyzw).length();
        let world = pose_of(&(self.world_from_axes * in_axes));
        // The filter's gate judges the length of the quaternion, which therefore stays.
        sample.pose = Pose { rotation_xyzw: world.rotation_xyzw.map(|c| c * length), ..world };
        sample.covariance = sample.covariance.map(|c| self.covariance(&c));
        sample
    }

    /// A covariance in the world's axes. A rotation vector turns as a place does, and the other way in a mirror.
    fn covariance(&self, covariance: &PoseCovariance) -> PoseCovariance {
        let turn = self.world_from_axes.matrix3 * self.axes;
        let (shifts, turns) = (turn * self.scale, turn * self.axes.determinant());
        let map = |i: usize, k: usize| match (i / 3, k / 3) {
            (0, 0) => shifts.col(k)[i],
            (1, 1) => turns.col(k - 3)[i - 3],
            _ => 0.0,
        };
        let from = covariance.matrix();
        let entry = |i: usize, j: usize| -> f64 {
            (0..6)
                .flat_map(|k| (0..6).map(move |l| (k, l)))
                .map(|(k, l)| map(i, k) * from[k][l] * map(j, l))
                .sum()
        };
        PoseCovariance::of(&std::array::from_fn(|i| std::array::from_fn(|j| entry(i, j))))
    }

    /// `A R A^T` for the exchange of axes A. A mirror turns the other way.
    fn turned(&self, rotation: DQuat) -> DQuat {
        let vector = self.axes * DVec3::new(rotation.x, rotation.y, rotation.z) * self.axes.determinant();
        DQuat::from_xyzw(vector.x, vector.y, vector.z, rotation.w).normalize()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Overrides, RigConfig};
    use dpm_device::time::HostTime;
    use dpm_device::tracker::BodyIndex;
    use std::path::Path;

    fn frame(settings: &[&str]) -> Option<TrackerFrame> {
        let flags = settings.iter().map(|s| (*s).to_owned()).collect();
        let overrides = Overrides { variables: vec![], flags };
        let text = "[tracker]\nkind = \"natnet\"\n[real_time]\npace = \"real\"\n[run]\nseconds = 1\n";
        let config =
            RigConfig::parse("rig.toml", text, Path::new(""), &overrides).unwrap_or_else(|e| panic!("{e}"));
        TrackerFrame::of(&config.tracker, None)
    }

    fn sample(position_m: [f64; 3], rotation: DQuat) -> TrackerSample {
        TrackerSample {
            body: BodyIndex(0),
            pose: Pose { position_m, rotation_xyzw: rotation.to_array() },
            tracked: true,
            mean_error_m: 0.0,
            covariance: None,
            sequence: 0,
            captured_at: HostTime(5_000_000),
            received_at: HostTime(7_000_000),
        }
    }

    /// A body's point in the world is where the same point of the mirrored, scaled and turned tracker space is.
    #[test]
    fn a_point_of_a_body_goes_where_the_whole_space_goes() {
        let f = frame(&[
            "tracker.transform.scale=0.001",
            "tracker.transform.axes=\"x z y\"",
            "tracker.transform.position=[1, 2, 3]",
            "tracker.transform.rotation_deg=[0, 90, 0]",
            "tracker.latency_us=1500",
        ])
        .unwrap();
        let rotation = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.8, 1.9);
        let out = f.apply(&sample([100.0, 200.0, 300.0], rotation));
        assert_eq!(out.captured_at, HostTime(3_500_000));
        assert_eq!(out.received_at, HostTime(7_000_000));
        let space = |p: DVec3| {
            // Millimetres, y and z exchanged (a mirror), turned about y by 90 degrees, moved.
            let q = DVec3::new(p.x, p.z, p.y) * 0.001;
            DVec3::new(q.z, q.y, -q.x) + DVec3::new(1.0, 2.0, 3.0)
        };
        // A point 50 mm along the tracker's own axes of the body; the body's axes are exchanged as well.
        for point in [DVec3::new(50.0, 0.0, 0.0), DVec3::new(0.0, 50.0, 20.0)] {
            let there = space(rotation * point + DVec3::new(100.0, 200.0, 300.0));
            let exchanged = DVec3::new(point.x, point.z, point.y) * 0.001;
            let here = crate::rig::affine(&out.pose).transform_point3(exchanged);
            assert!((here - there).length() < 1e-12, "{here} {there}");
        }
    }

    /// Depth of the tracker becomes height of the world, and noise of depth noise of height.
    #[test]
    fn a_covariance_turns_with_the_space() {
        let f = frame(&["tracker.transform.axes=\"x z -y\"", "tracker.transform.scale=0.001"]).unwrap();
        let mut matrix = [[0.0; 6]; 6];
        (0..6).for_each(|i| matrix[i][i] = 1.0 + i as f64);
        (matrix[2][3], matrix[3][2]) = (0.5, 0.5);
        let mut given = sample([0.0; 3], DQuat::IDENTITY);
        given.covariance = Some(PoseCovariance::of(&matrix));
        let got = f.apply(&given).covariance.unwrap().matrix();
        let near = |a: f64, b: f64| (a - b).abs() < 1e-6 * b.abs();
        // World y is the tracker's z; world z is minus its y.
        assert!(near(got[0][0], 1e-6) && near(got[1][1], 3e-6) && near(got[2][2], 2e-6), "{got:?}");
        assert!(
            near(got[3][3], 4.0) && near(got[4][4], 6.0) && near(got[5][5], 5.0) && near(got[1][3], 5e-4),
            "{got:?}"
        );
    }

    #[test]
    fn what_the_gate_must_see_survives() {
        let f = frame(&["tracker.transform.position=[1, 0, 0]"]).unwrap();
        let long = f.apply(&sample([0.0; 3], DQuat::IDENTITY * 3.0));
        assert!((DQuat::from_array(long.pose.rotation_xyzw).length() - 3.0).abs() < 1e-12);
        let nan = f.apply(&sample([f64::NAN, 0.0, 0.0], DQuat::IDENTITY));
        assert!(!nan.pose.is_valid(0.1));
        let zero = f.apply(&sample([0.0; 3], DQuat::IDENTITY * 0.0));
        assert!(!zero.pose.is_valid(0.1));
    }

    #[test]
    fn a_plain_tracker_costs_nothing() {
        assert!(frame(&[]).is_none() && frame(&["tracker.latency_us=0"]).is_none());
        assert!(frame(&["tracker.latency_us=-20"]).is_some());
    }
}
