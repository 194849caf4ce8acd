//! `tracker.kind = "camera"`: a camera that sees printed tags or bright markers on the bodies.

mod keys;
mod lens;
mod mock;

pub use keys::{CameraTrackerConfig, MarkerConfig, TagConfig};

use super::keys::{SourceError, TrackerKeys, TrackerPlace};
use super::kind::{PoseOrigin, TrackerKind};
use super::transform::{PoseConfig, TrackerTransformConfig};
use dpm_camera::{CameraTracker, CameraTrackerSetup, Markings, PictureSource, StreamSource, TagPlace, TAGS};
use dpm_common::keys::read::{refuse, Reader};
use dpm_device::picture_stream::{PictureHeader, HEADER_BYTES};
use dpm_device::tracker::{BodyKey, Tracker};
use glam::DVec3;
use std::net::ToSocketAddrs;
use std::path::PathBuf;
use std::sync::Arc;

pub(super) static KIND: TrackerKind = TrackerKind::of::<CameraTrackerConfig>(
    "camera",
    "a camera that sees printed tags or bright markers on the bodies.",
    PoseOrigin::Measured,
    "docs/TRACKERS.md#camera",
    &[("picture_header", any_header)],
    mock::mock,
);

/// What begins the address of a camera on a socket.
const SOCKET: &str = "tcp:";

impl TrackerKeys for CameraTrackerConfig {
    fn rate_hz(&self) -> Option<u32> {
        Some(self.rate_hz)
    }

    fn frame(&self) -> Option<(&TrackerTransformConfig, i64)> {
        Some((&self.transform, self.latency_us))
    }

    fn place(&self) -> String {
        format!("the camera {}", self.device)
    }

    fn remedy(&self) -> &'static str {
        "does the camera see the tags or markers sharp and whole, have they the numbers of tracker.tags, and is tracker.device right?"
    }

    fn check(&self, reader: &mut Reader) {
        let mut seen = std::collections::BTreeSet::new();
        for (i, tag) in self.tags.iter().enumerate() {
            let key = format!("tracker.tags.{i}");
            if usize::from(tag.id) >= TAGS {
                let problem = format!("AprilTag 36h11 has no tag {}", tag.id);
                refuse(
                    reader,
                    &[&format!("{key}.id")],
                    problem,
                    format!("write a number from 0 to {}", TAGS - 1),
                );
            }
            if !seen.insert(tag.id) {
                let problem = format!("tag {} stands twice", tag.id);
                refuse(
                    reader,
                    &[&format!("{key}.id")],
                    problem,
                    "print each tag once: a number seen twice is not used".into(),
                );
            }
            if pose(tag).to_affine().is_none() {
                refuse(
                    reader,
                    &[&format!("{key}.rotation")],
                    "is zero".into(),
                    "write a quaternion x, y, z, w".into(),
                );
            }
        }
        for body in self.bodies() {
            let count = self.markers.iter().filter(|m| m.body == body).count();
            if (1..4).contains(&count) {
                let problem = format!("body {body:?} has {count} markers");
                refuse(
                    reader,
                    &["tracker.markers"],
                    problem,
                    "give it at least 4, better 5, that lie in no plane".into(),
                );
            }
        }
    }

    fn placed(&self, place: &mut dyn FnMut(&mut PathBuf, &str)) -> Option<Arc<dyn TrackerKeys>> {
        let mut keys = self.clone();
        place(keys.calibration.as_mut()?, "tracker.calibration");
        Some(Arc::new(keys))
    }

    fn open(&self, place: TrackerPlace) -> Result<Box<dyn Tracker>, SourceError> {
        for body in self.bodies() {
            if !place.bodies.iter().any(|b| b.name == body) {
                let names =
                    place.bodies.iter().map(|b| format!("{:?}", b.name)).collect::<Vec<_>>().join(", ");
                return Err(SourceError::of_key(
                    "tracker.tags",
                    format!("no body is called {body:?}; there are {names}"),
                ));
            }
        }
        let setup = CameraTrackerSetup {
            camera: lens::camera(self)?,
            bodies: place.bodies.iter().map(|b| self.markings(b)).collect(),
            marker_level: self.marker_level,
        };
        let Some(address) = self.device.strip_prefix(SOCKET) else {
            return Err(SourceError::of_key("tracker.device", no_device(&self.device)));
        };
        let found = address.to_socket_addrs().ok().and_then(|mut all| all.next());
        let address = found
            .ok_or_else(|| SourceError::of_key("tracker.device", format!("{address:?} is no HOST:PORT")))?;
        let source: Box<dyn PictureSource> = Box::new(StreamSource::new(address, &place.clock));
        Ok(Box::new(CameraTracker::start(setup, source, place.clock)?))
    }
}

impl CameraTrackerConfig {
    /// The names of the bodies that have tags or markers.
    fn bodies(&self) -> std::collections::BTreeSet<&str> {
        self.tags.iter().map(|t| &*t.body).chain(self.markers.iter().map(|m| &*m.body)).collect()
    }

    /// What the camera can see of a body.
    fn markings(&self, body: &BodyKey) -> Markings {
        let tags = self.tags.iter().filter(|t| t.body == body.name).map(|t| TagPlace {
            id: t.id,
            side: t.side_m,
            body_from_tag: pose(t).to_affine().unwrap_or_default(),
        });
        let markers = self.markers.iter().filter(|m| m.body == body.name);
        Markings { tags: tags.collect(), markers: markers.map(|m| DVec3::from_array(m.position)).collect() }
    }
}

fn pose(tag: &TagConfig) -> PoseConfig {
    PoseConfig { position: tag.position, rotation_deg: tag.rotation_deg, rotation: tag.rotation }
}

/// What is wrong with a device that this build cannot open.
fn no_device(device: &str) -> String {
    format!("{device:?} cannot be opened by this build; write \"tcp:HOST:PORT\" of `hil-mock serve camera`")
}

/// A header: what is read is written as the same bytes.
fn any_header(bytes: &[u8]) {
    let Some(first) = bytes.first_chunk::<HEADER_BYTES>() else { return };
    if let Some(header) = PictureHeader::decode(first) {
        assert_eq!(PictureHeader::decode(&header.encode()), Some(header));
        assert!(header.pixel_bytes() <= 8192 * 8192);
    }
}
