//! Kinds of trackers. Each is a row of one table ([`kinds`]): the object that reads its keys, opens it, and answers what
//! the rest of the program asks about it. Nothing outside this folder names a kind.
//!
//! A kind is a file or folder here, or in another crate that calls [`add`], with a [`TrackerKind`]. A conformance suite
//! (`tests/tests/laws/tracker_kinds.rs`) runs over all rows.

mod axes;
#[cfg(feature = "camera")]
mod camera;
mod keys;
mod kind;
mod mock;
mod natnet;
mod replay;
mod serial;
mod transform;
mod vrpn;

pub use axes::Axes;
#[cfg(feature = "camera")]
pub use camera::{CameraTrackerConfig, CameraView, MarkerConfig, OtherCameraConfig, TagConfig};
pub use keys::{DeviceTracker, SampleErrors, SourceError, TrackerConfig, TrackerKeys, TrackerPlace};
pub use kind::{Decoder, MockScene, MockServer, PoseOrigin, TrackerKind};
pub use mock::simulated;
pub use transform::{PoseConfig, TrackerTransformConfig};

use dpm_common::keys::rows::Registry;

/// One row a kind, in the order of the manual. The first plays a rig file that names none, and `--simulate`.
static KINDS: Registry<TrackerKind> = Registry::new(&[
    &mock::KIND,
    &natnet::KIND,
    &vrpn::KIND,
    &serial::KIND,
    #[cfg(feature = "camera")]
    &camera::KIND,
    &replay::KIND,
]);

/// All kinds.
pub fn kinds() -> Vec<&'static TrackerKind> {
    KINDS.all()
}

/// Adds a kind of another crate. Call it before a rig file is read.
pub fn add(kind: &'static TrackerKind) {
    KINDS.add(kind);
}

#[cfg(test)]
mod tests;
