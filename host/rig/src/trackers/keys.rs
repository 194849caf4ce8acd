//! `[tracker]`: a kind with the values of its keys, and what the program asks of it.

use super::kind::TrackerKind;
use super::transform::TrackerTransformConfig;
use crate::mock::Motion;
#[cfg(feature = "camera")]
use dpm_camera::{CameraDoubt, CameraLook};
use dpm_common::keys::read::KeyReader;
use dpm_common::keys::rows::{KeyValues, OfKind};
use dpm_device::time::{HostClock, HostTime};
use dpm_device::tracker::{BodyKey, Tracker, TrackerError};
#[cfg(feature = "camera")]
use dpm_scene::geometry::projector::ProjectorCamera;
use std::error::Error;
use std::path::PathBuf;
use std::sync::Arc;

/// Why a tracker cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// A key whose value cannot be used.
    #[error("{key}: {source}")]
    Key {
        /// The key of the rig file.
        key: &'static str,
        /// What is wrong with its value.
        source: Box<dyn Error + Send + Sync>,
    },
    /// The device or the network cannot be opened.
    #[error("tracker: {0}")]
    Tracker(#[from] TrackerError),
}

impl SourceError {
    /// The value of `key` cannot be used.
    pub fn of_key(key: &'static str, source: impl Into<Box<dyn Error + Send + Sync>>) -> Self {
        Self::Key { key, source: source.into() }
    }
}

/// What is between a pose and its sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SampleErrors {
    /// Standard deviation of the position along each axis, metres.
    pub position_m: f64,
    /// Standard deviation of the rotation about each axis, rad.
    pub rotation_rad: f64,
    /// From the instant of the pose to the sample's arrival, nanoseconds.
    pub delivery_ns: i64,
}

/// What a tracker is opened with.
pub struct TrackerPlace {
    /// The rig's bodies in their order.
    pub bodies: Vec<BodyKey>,
    /// Their true motions, which only a simulated tracker needs.
    pub motions: Vec<Motion>,
    /// The clock that stamps polls.
    pub clock: Arc<dyn HostClock>,
    /// The instant at which a recording starts. Time 0 of motions is instant 0 of the clock.
    pub start: HostTime,
}

/// A tracker, and the device by which it looks.
pub type DeviceTracker = (String, Box<dyn Tracker>);

/// The keys of a kind of trackers. A [`section!`](dpm_common::section) implements the rest of it.
pub trait TrackerKeys: KeyValues {
    /// Expected samples per second; `None` if only the recording knows.
    fn rate_hz(&self) -> Option<u32>;

    /// Time between two samples of one of the tracker's sources that see the same bodies side by side, ns; 0 of a tracker with
    /// one source.
    fn source_period_ns(&self) -> i64 {
        0
    }

    /// From the tracker's coordinates to the world's, and by how many microseconds samples are older than they say. `None`
    /// for a tracker that knows the world.
    fn frame(&self) -> Option<(&TrackerTransformConfig, i64)>;

    /// What and where it is, for example "NatNet at 192.168.1.10".
    fn place(&self) -> String;

    /// What the operator should check first if it does not report a body.
    fn remedy(&self) -> &'static str;

    /// The serial port that it opens.
    fn port(&self) -> Option<&str> {
        None
    }

    /// Refuses values that make no sense.
    fn check(&self, _reader: &mut KeyReader) {}

    /// The same keys with each input file placed by `place`, which gets the file and its key; `None` without files.
    fn placed(&self, _place: &mut dyn FnMut(&mut PathBuf, &str)) -> Option<Arc<dyn TrackerKeys>> {
        None
    }

    /// Opens the pictures of a tracker that looks by a camera; `None` for all others.
    #[cfg(feature = "camera")]
    fn view(&self, _clock: &Arc<dyn HostClock>) -> Option<Result<super::CameraView, SourceError>> {
        None
    }

    /// Looks at each camera of such a tracker for a second or two; nothing of all others.
    #[cfg(feature = "camera")]
    fn examine(&self) -> Vec<Result<CameraLook, CameraDoubt>> {
        Vec::new()
    }

    /// Each camera of such a tracker as a tracker by itself, in its own space, with its device: the first one first. All see
    /// the bodies that carry marks, in one order. Nothing of all others.
    ///
    /// # Errors
    /// As [`Self::open`].
    #[cfg(feature = "camera")]
    fn cameras_alone(&self, _clock: &Arc<dyn HostClock>) -> Result<Vec<DeviceTracker>, SourceError> {
        Ok(Vec::new())
    }

    /// What such a camera looks for on a body; `None` for all others.
    #[cfg(feature = "camera")]
    fn seen_of(&self, _body: &str) -> Option<dpm_camera::Markings> {
        None
    }

    /// The errors of its samples, where the rig file gives them: those of a tracker in this process.
    fn errors(&self) -> Option<SampleErrors> {
        None
    }

    /// Exposure of a picture of such a camera, microseconds, if the rig file gives it.
    fn exposure_us(&self) -> Option<u32> {
        None
    }

    /// Lens and place in the world of such a camera.
    #[cfg(feature = "camera")]
    fn eye(&self) -> Option<Result<ProjectorCamera, SourceError>> {
        None
    }

    /// Opens the tracker. Network and serial trackers connect while they are polled, and reconnect after every loss, so it
    /// is no error if nothing answers yet.
    ///
    /// # Errors
    /// Settings, addresses or files cannot be used, or the system refuses a socket.
    fn open(&self, place: TrackerPlace) -> Result<Box<dyn Tracker>, SourceError>;
}

/// `[tracker]` of a rig file.
pub type TrackerConfig = OfKind<TrackerKind>;
