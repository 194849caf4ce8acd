//! `tracker.transform`: a rigid motion, and from the tracker's coordinates to the world's.

use super::axes::Axes;
use dpm_common::keys::read::{Any, Within};
use dpm_common::section;
use glam::{DAffine3, DQuat, DVec3};

section! {
    /// A rigid motion.
    pub struct PoseConfig {
        /// Where its origin goes.
        position: [f64; 3] = [0.0; 3], "m", Within(-1e6, 1e6);
        /// Rotations about x, then y, then z.
        rotation_deg: [f64; 3] = [0.0; 3], "deg", Within(-360.0, 360.0);
        /// The rotation as a quaternion x, y, z, w instead; its length does not matter.
        rotation: Option<[f64; 4]> = None, "", Within(-1e6, 1e6);
    }
}

impl PoseConfig {
    /// The motion; `None` if the quaternion is zero, which the check refuses.
    pub fn to_affine(&self) -> Option<DAffine3> {
        let rotation = match self.rotation {
            Some(q) => {
                let q = DQuat::from_array(q);
                (q.length() > 1e-12).then(|| q.normalize())?
            }
            None => {
                let [x, y, z] = self.rotation_deg.map(f64::to_radians);
                DQuat::from_rotation_z(z) * DQuat::from_rotation_y(y) * DQuat::from_rotation_x(x)
            }
        };
        Some(DAffine3::from_rotation_translation(rotation, DVec3::from_array(self.position)))
    }
}

section! {
    /// From the tracker's coordinates to the world's: `world = rotation * axes(scale * tracker) + position`.
    pub struct TrackerTransformConfig {
        /// Length of the tracker's unit: 0.001 for millimetres.
        scale: f64 = 1.0, "m", Within(1e-6, 1e3);
        /// The tracker's axes along the world's x, y and z. A tracker whose z points up, with x to the right, has
        /// "x z -y". An odd number of exchanges and signs mirrors.
        axes: Axes = Axes::default(), "", Any;
        /// Where the tracker's origin is in the world.
        position: [f64; 3] = [0.0; 3], "m", Within(-1e6, 1e6);
        /// Rotations about the world's x, then y, then z, after the exchange of axes.
        rotation_deg: [f64; 3] = [0.0; 3], "deg", Within(-360.0, 360.0);
        /// The rotation as a quaternion x, y, z, w instead; its length does not matter.
        rotation: Option<[f64; 4]> = None, "", Within(-1e6, 1e6);
    }
}

impl TrackerTransformConfig {
    /// The rigid part; `None` if the quaternion is zero, which the check refuses.
    pub fn pose(&self) -> Option<DAffine3> {
        let pose =
            PoseConfig { position: self.position, rotation_deg: self.rotation_deg, rotation: self.rotation };
        pose.to_affine()
    }
}
