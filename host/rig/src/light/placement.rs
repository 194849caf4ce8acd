//! Warns about a body that the tracker never reports where the projector's light can fall: the tracker may send
//! millimetres instead of metres, exchange axes, or have another origin than the camera calibration.

use dpm_device::time::HostTime;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec3};

/// Number of frames with a reported body before the body is judged. Frames in which the body was too old to be lit
/// count as well: a rig whose frames take longer than `safety.predict_ms` lights nothing, but must still report wrong
/// units.
const ENOUGH: u64 = 50;
/// Fewer frames are enough after this time since the first, nanoseconds: slow rigs are told as early as fast ones.
const SOON: (u64, i64) = (3, 1_000_000_000);
/// Maximum number of points of a body that are checked.
const POINTS: usize = 8;

#[derive(Clone, Copy, Debug, Default)]
struct BodyReach {
    tracked: u64,
    within_reach: u64,
    last: DVec3,
    /// When it was reported first and last.
    times: Option<[HostTime; 2]>,
    /// It was told while the run goes on.
    is_told: bool,
}

impl BodyReach {
    /// Whether it was tracked for long enough and never came near the light.
    fn is_lost(&self) -> bool {
        let long = self.times.is_some_and(|[first, last]| last.ns_since(first) >= SOON.1);
        self.within_reach == 0 && (self.tracked >= ENOUGH || self.tracked >= SOON.0 && long)
    }

    fn told(&self, name: &str) -> String {
        let p = self.last;
        format!(
            "body \"{name}\": the tracker puts it at ({:.3}, {:.3}, {:.3}) m, and never where the projector's light can fall; check that the \
             tracking software streams metres, its axes and handedness, and the projector's pose",
            p.x, p.y, p.z
        )
    }
}

/// Checks every frame, beside the frame path.
#[derive(Clone, Debug)]
pub(crate) struct Placement {
    bodies: Vec<BodyReach>,
}

impl Placement {
    /// For `bodies` tracked bodies.
    pub(crate) fn new(bodies: usize) -> Self {
        Self { bodies: vec![BodyReach::default(); bodies] }
    }

    /// Checks a frame. `poses` are the world-from-body poses; those of `seen` bodies are where the tracker saw them
    /// last. `points` of each body, in its own space, give its size.
    pub(crate) fn observe(
        &mut self,
        camera: &ProjectorCamera,
        poses: &[DAffine3],
        seen: &[bool],
        points: &[Vec<DVec3>],
        at: HostTime,
    ) {
        let (width, height) = (f64::from(camera.raster.width()), f64::from(camera.raster.height()));
        for (i, (body, pose)) in self.bodies.iter_mut().zip(poses).enumerate() {
            if seen.get(i) != Some(&true) {
                continue;
            }
            body.tracked += 1;
            body.last = pose.translation;
            body.times = Some([body.times.map_or(at, |[first, _]| first), at]);
            let points = points.get(i).map_or(&[][..], Vec::as_slice);
            let step = points.len().div_ceil(POINTS).max(1);
            let lit = |p: DVec3| {
                camera.project(p).is_some_and(|at| {
                    (-0.5 * width..1.5 * width).contains(&at.x)
                        && (-0.5 * height..1.5 * height).contains(&at.y)
                })
            };
            let near =
                lit(pose.translation) || points.iter().step_by(step).any(|p| lit(pose.transform_point3(*p)));
            body.within_reach += u64::from(near);
        }
    }

    /// One warning for each body that was tracked for long enough and never came near the light.
    pub(crate) fn warnings(&self, names: &[String]) -> Vec<String> {
        let lost = self.bodies.iter().zip(names).filter(|(b, _)| b.is_lost());
        lost.map(|(body, name)| body.told(name)).collect()
    }

    /// The same while a run goes on, each body once.
    pub(crate) fn news<'a>(&mut self, names: impl Iterator<Item = &'a str>, mut tell: impl FnMut(String)) {
        for (body, name) in self.bodies.iter_mut().zip(names) {
            if body.is_lost() && !std::mem::replace(&mut body.is_told, true) {
                tell(body.told(name));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Overrides, RigConfig};
    use crate::rig::Rig;

    /// Found in use, O4; T17: positions in millimetres, mirrored axes and exchanged axes are reported. Correct
    /// positions, positions at the edge, and positions that are wrong for a short time are not.
    #[test]
    fn wrong_units_and_axes_are_told() {
        let config = RigConfig::demo(&Overrides::default()).unwrap_or_else(|e| panic!("{e}"));
        let rig = Rig::build(&config, None).unwrap_or_else(|e| panic!("{e}"));
        let names = vec!["hare".to_owned()];
        let true_pose = rig.true_poses(dpm_device::time::HostTime(0).0).expect("the mock tells")[0];
        let told = |wrong: &dyn Fn(DVec3) -> DVec3, seen: bool, frames: u64| {
            let mut placement = Placement::new(1);
            let pose = DAffine3 { translation: wrong(true_pose.translation), ..true_pose };
            for _ in 0..frames {
                let points = [vec![DVec3::ZERO, DVec3::splat(0.05)]];
                placement.observe(&rig.camera, &[pose], &[seen], &points, HostTime(0));
            }
            placement.warnings(&names)
        };
        // The rig's geometry: where the projector is and where it looks.
        let (from, depth) = (rig.camera.position(), rig.camera.to_projector_space(true_pose.translation).z);
        assert_eq!(told(&|p| p, true, 1000), [] as [String; 0]);
        // Behind the projector, as with a flipped axis.
        let behind = |p: DVec3| 2.0 * from - p;
        let warning = told(&behind, true, ENOUGH);
        assert_eq!(warning.len(), 1);
        assert!(warning[0].contains("\"hare\"") && warning[0].contains("streams metres"), "{}", warning[0]);
        // Sideways by three times the depth.
        assert_eq!(told(&|p| p + DVec3::X * 3.0 * depth.abs(), true, ENOUGH).len(), 1);
        // A slow rig is told within two seconds, and once.
        let mut slow = Placement::new(1);
        let mut told_at = Vec::new();
        for frame in 0..8i64 {
            let at = HostTime(frame * 400_000_000);
            let pose = DAffine3::from_translation(behind(true_pose.translation));
            slow.observe(&rig.camera, &[pose], &[true], &[vec![DVec3::ZERO]], at);
            slow.news(["hare"].into_iter(), |_| told_at.push(at.0));
        }
        assert_eq!(told_at, [1_200_000_000]);
        // Too short to be judged; not tracked at all.
        assert_eq!(told(&behind, true, ENOUGH - 1).len(), 0);
        assert_eq!(told(&behind, false, 1000).len(), 0);
        let thousandfold = told(&|p| 1000.0 * (p + DVec3::new(0.1, 0.2, 0.0)), true, ENOUGH);
        assert_eq!(thousandfold.len(), 1, "{:?} from {from:?}", true_pose.translation);
    }
}
