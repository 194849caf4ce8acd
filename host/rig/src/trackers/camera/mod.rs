//! `tracker.kind = "camera"`: a camera that sees printed tags or bright markers on the bodies.

mod keys;
mod lens;
mod mock;

pub use keys::{CameraTrackerConfig, MarkerConfig, OtherCameraConfig, TagConfig};

use super::keys::{DeviceTracker, SourceError, TrackerKeys, TrackerPlace};
use super::kind::{PoseOrigin, TrackerKind};
use super::transform::{PoseConfig, TrackerTransformConfig};
use dpm_camera::{
    examine_source, motion_jpeg_grey, open_source, CameraDoubt, CameraLook, CameraTracker, FinderSetup,
    Markings, PictureRequest, PictureSource, PlacedCamera, TagPlace, TAGS,
};
use dpm_common::keys::read::{refuse, KeyReader};
use dpm_device::picture_stream::{PictureHeader, HEADER_BYTES};
use dpm_device::planes::Raster;
use dpm_device::time::HostClock;
use dpm_device::tracker::{BodyKey, Tracker};
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec3};
use std::path::PathBuf;
use std::sync::Arc;

pub(super) static KIND: TrackerKind = TrackerKind::of::<CameraTrackerConfig>(
    "camera",
    "a camera that sees printed tags or bright markers on the bodies.",
    PoseOrigin::Measured,
    "docs/TRACKERS.md#camera",
    &[("picture_header", any_header), ("motion_jpeg", any_motion_jpeg)],
    mock::mock,
);

/// The camera of a tracker, for whoever calibrates by it.
pub struct CameraView {
    /// Its pictures.
    pub source: Box<dyn PictureSource>,
    /// Their columns and rows.
    pub raster: Raster,
    /// The file of its lens, if the rig file names one.
    pub calibration: Option<PathBuf>,
    /// What it can see of each body that carries tags.
    pub markings: Vec<Markings>,
}

impl TrackerKeys for CameraTrackerConfig {
    fn rate_hz(&self) -> Option<u32> {
        Some(self.rate_hz)
    }

    fn source_period_ns(&self) -> i64 {
        if self.others.is_empty() {
            0
        } else {
            1_000_000_000 / i64::from(self.rate_hz.max(1))
        }
    }

    fn frame(&self) -> Option<(&TrackerTransformConfig, i64)> {
        Some((&self.transform, self.latency_us))
    }

    fn place(&self) -> String {
        let all: Vec<&str> =
            std::iter::once(&*self.device).chain(self.others.iter().map(|o| &*o.device)).collect();
        format!("the camera {}", all.join(" and "))
    }

    fn remedy(&self) -> &'static str {
        "does the camera see the tags or markers sharp and whole, have they the numbers of tracker.tags, and is tracker.device right?"
    }

    fn check(&self, reader: &mut KeyReader) {
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
        for (i, other) in self.others.iter().enumerate() {
            let key = format!("tracker.others.{i}");
            if other.position.is_none() {
                refuse(
                    reader,
                    &[&format!("{key}.position")],
                    "is missing: several cameras need their places relative to each other".into(),
                    "write where it stands in the space of the first camera, which looks along -Z with +Y up; \
                     with [0, 0, 0] for now, dpm calibrate camera --places finds it"
                        .into(),
                );
            }
            if other.place().is_none() {
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
        if let Some(file) = &mut keys.calibration {
            place(file, "tracker.calibration");
        }
        for file in keys.others.iter_mut().filter_map(|other| other.calibration.as_mut()) {
            place(file, "tracker.others.calibration");
        }
        Some(Arc::new(keys))
    }

    fn view(&self, clock: &Arc<dyn HostClock>) -> Option<Result<CameraView, SourceError>> {
        let view = || {
            let [w, h] = self.size;
            let no_raster = || SourceError::of_key("tracker.size", format!("{w} x {h} is no raster"));
            Ok(CameraView {
                source: self.source(clock)?,
                raster: Raster::new(w, h).ok_or_else(no_raster)?,
                calibration: self.calibration.clone(),
                markings: self.bodies().into_iter().map(|name| self.markings(name)).collect(),
            })
        };
        Some(view())
    }

    fn examine(&self) -> Vec<Result<CameraLook, CameraDoubt>> {
        self.cameras().iter().filter_map(|one| examine_source(&one.device, &one.request())).collect()
    }

    fn cameras_alone(&self, clock: &Arc<dyn HostClock>) -> Result<Vec<DeviceTracker>, SourceError> {
        let bodies: Vec<BodyKey> =
            self.bodies().into_iter().map(|name| BodyKey { name: name.to_owned(), id: None }).collect();
        let opened = |one: Self| {
            let place = TrackerPlace {
                bodies: bodies.clone(),
                motions: Vec::new(),
                clock: clock.clone(),
                start: clock.now(),
            };
            Ok((one.device.clone(), one.open(place)?))
        };
        self.cameras().into_iter().map(opened).collect()
    }

    fn seen_of(&self, body: &str) -> Option<Markings> {
        Some(self.markings(body))
    }

    fn exposure_us(&self) -> Option<u32> {
        self.exposure_us
    }

    fn eye(&self) -> Option<Result<ProjectorCamera, SourceError>> {
        let placed = |camera: ProjectorCamera| {
            let wrong = || SourceError::of_key("tracker.transform", "its rotation is zero");
            Ok(ProjectorCamera { world_from_projector: self.transform.pose().ok_or_else(wrong)?, ..camera })
        };
        Some(lens::camera(self).and_then(placed))
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
        let places = self.others.iter().map(|other| other.place().unwrap_or_default());
        let places = std::iter::once(DAffine3::IDENTITY).chain(places);
        let opened = |(one, pose): (CameraTrackerConfig, DAffine3)| {
            let setup = FinderSetup {
                camera: lens::camera(&one)?,
                bodies: place.bodies.iter().map(|b| self.markings(&b.name)).collect(),
                marker_level: self.marker_level,
            };
            Ok(PlacedCamera { setup, pose, source: one.source(&place.clock)? })
        };
        let cameras = self.cameras().into_iter().zip(places).map(opened);
        let cameras = cameras.collect::<Result<_, SourceError>>()?;
        Ok(Box::new(CameraTracker::start(cameras, &place.clock)?))
    }
}

impl OtherCameraConfig {
    /// Its pose in the space of the first camera; `None` if its quaternion is zero.
    fn place(&self) -> Option<DAffine3> {
        let position = self.position.unwrap_or_default();
        PoseConfig { position, rotation_deg: self.rotation_deg, rotation: self.rotation }.to_affine()
    }
}

impl CameraTrackerConfig {
    /// The keys of each camera, the first one's first.
    fn cameras(&self) -> Vec<Self> {
        let first = Self { others: vec![], ..self.clone() };
        let others = self.others.iter().map(|other| Self {
            device: other.device.clone(),
            size: other.size.unwrap_or(self.size),
            exposure_us: other.exposure_us.or(self.exposure_us),
            gain: other.gain.or(self.gain),
            readout_us: other.readout_us.unwrap_or(self.readout_us),
            calibration: other.calibration.clone(),
            view_deg: other.view_deg,
            ..first.clone()
        });
        std::iter::once(first.clone()).chain(others).collect()
    }

    fn source(&self, clock: &Arc<dyn HostClock>) -> Result<Box<dyn PictureSource>, SourceError> {
        open_source(&self.device, &self.request(), clock)
            .map_err(|e| SourceError::of_key("tracker.device", e))
    }

    fn request(&self) -> PictureRequest {
        PictureRequest {
            size: self.size,
            rate_hz: self.rate_hz,
            exposure_us: self.exposure_us,
            gain: self.gain,
            readout_us: self.readout_us,
        }
    }

    /// The names of the bodies that have tags or markers.
    fn bodies(&self) -> std::collections::BTreeSet<&str> {
        self.tags.iter().map(|t| &*t.body).chain(self.markers.iter().map(|m| &*m.body)).collect()
    }

    /// What the camera can see of a body.
    fn markings(&self, body: &str) -> Markings {
        let tags = self.tags.iter().filter(|t| t.body == body).map(|t| TagPlace {
            id: t.id,
            side: t.side_m,
            body_from_tag: pose(t).to_affine().unwrap_or_default(),
        });
        let markers = self.markers.iter().filter(|m| m.body == body);
        Markings { tags: tags.collect(), markers: markers.map(|m| DVec3::from_array(m.position)).collect() }
    }
}

fn pose(tag: &TagConfig) -> PoseConfig {
    PoseConfig { position: tag.position, rotation_deg: tag.rotation_deg, rotation: tag.rotation }
}

/// A header: what is read is written as the same bytes.
fn any_header(bytes: &[u8]) {
    let Some(first) = bytes.first_chunk::<HEADER_BYTES>() else { return };
    if let Some(header) = PictureHeader::decode(first) {
        assert_eq!(PictureHeader::decode(&header.encode()), Some(header));
        assert!(header.pixel_bytes() <= 8192 * 8192);
    }
}

/// A picture of a USB camera: it is read whole or not at all. The first byte chooses one of a few sizes.
fn any_motion_jpeg(bytes: &[u8]) {
    let Some((first, bytes)) = bytes.split_first() else { return };
    let size = [[40, 24], [16, 16], [64, 8]][usize::from(first % 3)];
    let mut out = vec![1];
    if motion_jpeg_grey(bytes, size, &mut out) {
        assert_eq!(out.len(), size[0] * size[1]);
    }
}

#[cfg(test)]
mod tests {
    use crate::config::{Overrides, RigConfig};
    use crate::mock::{Motion, MotionSpec, SampleSource};
    use crate::trackers::{MockScene, TrackerPlace};
    use dpm_device::pose::Pose;
    use dpm_device::time::{HostClock, HostTime};
    use dpm_device::tracker::{BodyKey, Tracker};
    use std::path::Path;
    use std::sync::Arc;
    use std::time::{Duration, Instant};

    fn clock() -> Arc<dyn HostClock> {
        let epoch = Instant::now();
        Arc::new(move || HostTime(epoch.elapsed().as_nanos() as i64))
    }

    /// From the mock's picture over a socket to samples with a covariance that are where the body was.
    #[test]
    fn the_mocks_pictures_become_poses_with_their_covariance() {
        let rest = Pose { position_m: [0.1, 0.2, 0.3], ..Pose::IDENTITY };
        let motion = Motion::new(&MotionSpec::paper_translation(), rest).unwrap();
        let source = SampleSource::new(Default::default(), vec![motion.clone()]).unwrap();
        let clock = clock();
        let names = vec!["hare".to_owned()];
        let scene = MockScene { source, motions: vec![motion.clone()], names, clock: clock.clone() };
        let server = super::mock::mock(&scene).unwrap();
        let mut text = "[real_time]\npace = \"real\"\n[tracker]\nkind = \"camera\"\n".to_owned();
        server.keys.iter().for_each(|(key, value)| text += &format!("{key} = {value}\n"));
        let config = RigConfig::parse("rig.toml", &text, Path::new(""), &Overrides::default());
        let config = config.unwrap_or_else(|e| panic!("{e}\n{text}")).tracker;
        let bodies = vec![BodyKey { name: "hare".into(), id: None }];
        let place = TrackerPlace { bodies, motions: vec![], clock: clock.clone(), start: HostTime(0) };
        let mut tracker = config.open(place).unwrap();
        let (transform, _) = config.frame().unwrap();
        let world = transform.pose().unwrap();
        let mut errors = Vec::new();
        let begin = Instant::now();
        while errors.len() < 20 {
            assert!(
                begin.elapsed() < Duration::from_secs(30),
                "{} samples, {}",
                errors.len(),
                tracker.status()
            );
            let mut sink = |s: &dpm_device::tracker::TrackerSample| {
                let at = world.transform_point3(glam::DVec3::from_array(s.pose.position_m));
                let truth = motion.pose_at(s.captured_at.0).position_m;
                if s.tracked {
                    assert!(s.covariance.is_some_and(|c| c.variances().is_some()));
                    errors.push((at - glam::DVec3::from_array(truth)).length());
                }
            };
            tracker.poll(clock.now(), &mut sink).unwrap();
            std::thread::sleep(Duration::from_millis(2));
        }
        errors.sort_by(f64::total_cmp);
        assert!(errors[10] < 0.01, "{errors:?}");
        assert!(tracker.gate().unwrap().counters().is_conserved());
    }
}
