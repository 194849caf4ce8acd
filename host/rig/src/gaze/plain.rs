//! The kinds of gaze that need no device: a point, a tracked body, the axis of the glasses.

use super::kind::{GazeAim, GazeKeys, GazeKind};
use dpm_common::keys::read::{NotEmpty, Within};
use dpm_common::keys::source::{SourceNode, Value};
use dpm_common::keys::Origin;
use dpm_common::section;
use glam::DVec3;

section! {
    /// Gaze at a fixed point.
    pub struct GazePointConfig {
        /// The point.
        point: [f64; 3] = [0.0, 0.1, 0.0], "m", Within(-1e6, 1e6);
    }
}

section! {
    /// Gaze that follows a body.
    pub struct GazeTrackedConfig {
        /// Name of the body: one of `scene.bodies[].name`, or what a person wears.
        target: String = String::new(), "", NotEmpty;
    }
}

section! {
    /// Gaze straight ahead.
    pub struct GazeStraightConfig {}
}

pub(super) static POINT: GazeKind =
    GazeKind::of::<GazePointConfig>("point", "at a fixed point of the world.");
pub(super) static TRACKED: GazeKind =
    GazeKind::of::<GazeTrackedConfig>("tracked", "at the centre of a tracked body.");
pub(super) static STRAIGHT: GazeKind = GazeKind::of::<GazeStraightConfig>(
    "straight",
    "along -Z of the body that carries the eye, or of the world.",
);

/// Three numbers as a value of the rig file.
pub(super) fn vector(numbers: [f64; 3]) -> Value {
    let node = |number| SourceNode { value: Value::Float(number), origin: Origin::Default };
    Value::Array(numbers.map(node).into())
}

impl GazeKeys for GazePointConfig {
    fn aim(&self) -> GazeAim {
        GazeAim::Point(DVec3::from_array(self.point))
    }

    fn written(&self) -> Vec<(&'static str, Value)> {
        vec![("point", vector(self.point))]
    }
}

impl GazeKeys for GazeTrackedConfig {
    fn aim(&self) -> GazeAim {
        GazeAim::Body("observer.gaze.target", self.target.clone())
    }

    fn written(&self) -> Vec<(&'static str, Value)> {
        vec![("target", Value::String(self.target.clone()))]
    }
}

impl GazeKeys for GazeStraightConfig {
    fn aim(&self) -> GazeAim {
        GazeAim::Ahead
    }

    fn written(&self) -> Vec<(&'static str, Value)> {
        Vec::new()
    }
}
