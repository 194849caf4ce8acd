//! What a camera saw at one instant after another into the poses of bodies, each expected where its motion leads it.

use crate::blobs::{SpotDetector, SpotSighting};
use crate::body::{BodyPose, Markings};
use crate::detect::{TagDetector, TagSighting};
use crate::image::GreyImage;
use crate::pose::Velocity;
use crate::sightings::{Expectation, Sightings};
use crate::source::Picture;
use dpm_common::so3::{so3_between, so3_exp};
use dpm_device::pose::{Pose, PoseCovariance};
use dpm_device::time::HostTime;
use dpm_device::tracker::{BodyIndex, TrackerSample};
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DQuat, DVec3};

/// A pose that is older says nothing of where the body is now, ns.
const EXPECTED_FOR_NS: i64 = 250_000_000;

/// What a camera is, and what it is to find.
pub struct FinderSetup {
    /// Pinhole and lens at the size of the pictures. Its pose is not used: poses are in the camera's space.
    pub camera: ProjectorCamera,
    /// The markings of each body.
    pub bodies: Vec<Markings>,
    /// Grey level that markers reach, 1 to 255.
    pub marker_level: u8,
}

/// Finds bodies in what one camera sees, and remembers where they were.
pub struct BodyFinder {
    /// Its camera is at the origin.
    setup: FinderSetup,
    last: Vec<Option<Last>>,
    detector: TagDetector,
    blobs: SpotDetector,
    tags: Vec<TagSighting>,
    spots: Vec<SpotSighting>,
}

impl BodyFinder {
    /// A finder that has seen nothing yet.
    pub fn new(setup: FinderSetup) -> Self {
        let camera = ProjectorCamera { world_from_projector: DAffine3::IDENTITY, ..setup.camera };
        let last = vec![None; setup.bodies.len()];
        Self {
            setup: FinderSetup { camera, ..setup },
            last,
            detector: TagDetector::new(),
            blobs: SpotDetector::default(),
            tags: Vec::new(),
            spots: Vec::new(),
        }
    }

    /// The markings of the bodies, in their order.
    pub fn bodies(&self) -> &[Markings] {
        &self.setup.bodies
    }

    /// The tags that the last picture showed.
    pub fn tags(&self) -> &[TagSighting] {
        &self.tags
    }

    /// Looks at a picture: the middle of the exposure of its middle row, and the poses at that instant as of
    /// [`BodyFinder::find`].
    ///
    /// # Errors
    /// The picture has another size than the camera's, or is damaged.
    pub fn look(&mut self, picture: &Picture) -> Result<(HostTime, Vec<Option<BodyPose>>), String> {
        let FinderSetup { camera, bodies, marker_level } = &self.setup;
        let (w, h) = (camera.raster.width() as usize, camera.raster.height() as usize);
        if (picture.width, picture.height) != (w, h) {
            let given = format!("{} x {}", picture.width, picture.height);
            return Err(format!(
                "pictures have {given} pixels, and the calibration is for {w} x {h}: set tracker.size"
            ));
        }
        let Some(image) = GreyImage::new(w, h, &picture.pixels) else {
            return Err("a picture is damaged".into());
        };
        self.tags.clear();
        self.spots.clear();
        if bodies.iter().any(|b| !b.tags.is_empty()) {
            self.detector.detect(&image, Some(camera), &mut self.tags);
        }
        if bodies.iter().any(|b| !b.markers.is_empty()) {
            self.blobs.detect(&image, *marker_level, &mut self.spots);
        }
        let row = 0.5 * h as f64;
        let at = picture.begin.plus_ns(picture.exposure_ns / 2 + (row * picture.row_ns as f64) as i64);
        let seen =
            Sightings { tags: &self.tags, spots: &self.spots, row_s: picture.row_ns as f64 * 1e-9, row };
        Ok((at, find(&self.setup, &mut self.last, &seen, at)))
    }

    /// The pose of each body in what was seen at `at`; `None` for one that was not seen, or of which nothing certain can be
    /// said.
    pub fn find(&mut self, seen: &Sightings<'_>, at: HostTime) -> Vec<Option<BodyPose>> {
        find(&self.setup, &mut self.last, seen, at)
    }
}

fn find(
    setup: &FinderSetup,
    last: &mut [Option<Last>],
    seen: &Sightings<'_>,
    at: HostTime,
) -> Vec<Option<BodyPose>> {
    let (cameras, seen) = (std::slice::from_ref(&setup.camera), std::slice::from_ref(seen));
    let found = setup.bodies.iter().zip(last).map(|(body, last)| {
        let expected = last.and_then(|l| l.expect(at));
        let found = body.locate(cameras, seen, expected.as_ref()).filter(BodyPose::is_certain)?;
        *last = Some(Last::after(*last, at, found.fit.rotation, found.fit.position));
        Some(found)
    });
    found.collect()
}

/// A body's pose at `at` as a tracker's sample, in the camera's space; without one the body is not tracked.
pub fn sample_of(body: usize, at: HostTime, found: Option<&BodyPose>) -> TrackerSample {
    let mut sample = TrackerSample {
        body: BodyIndex(body as u16),
        pose: Pose::IDENTITY,
        tracked: false,
        mean_error_m: 0.0,
        covariance: None,
        sequence: 0,
        captured_at: at,
        received_at: at,
    };
    if let Some(found) = found {
        let fit = &found.fit;
        sample.pose = Pose { position_m: fit.position.to_array(), rotation_xyzw: fit.rotation.to_array() };
        sample.tracked = true;
        sample.mean_error_m = (0..3).map(|i| fit.covariance[i][i]).sum::<f64>().sqrt() as f32;
        sample.covariance = Some(PoseCovariance::of(&fit.covariance));
    }
    sample
}

/// Where a body was in the last two pictures in which it was seen.
#[derive(Clone, Copy)]
struct Last {
    at: HostTime,
    rotation: DQuat,
    position: DVec3,
    velocity: Option<Velocity>,
}

impl Last {
    fn after(before: Option<Self>, at: HostTime, rotation: DQuat, position: DVec3) -> Self {
        let velocity = before.and_then(|b| {
            let ns = at.ns_since(b.at);
            let s = ns as f64 * 1e-9;
            (ns > 0 && ns < EXPECTED_FOR_NS).then(|| Velocity {
                linear: (position - b.position) / s,
                angular: so3_between(b.rotation, rotation) / s,
            })
        });
        Self { at, rotation, position, velocity }
    }

    /// Where the body should be at `at`; `None` after too long a time.
    fn expect(&self, at: HostTime) -> Option<Expectation> {
        let ns = at.ns_since(self.at);
        if !(0..EXPECTED_FOR_NS).contains(&ns) {
            return None;
        }
        let s = ns as f64 * 1e-9;
        let velocity = self.velocity.unwrap_or_default();
        let rotation = so3_exp(velocity.angular * s) * self.rotation;
        let pose = DAffine3::from_rotation_translation(rotation, self.position + velocity.linear * s);
        // What hands do that the velocity does not say.
        Some(Expectation { pose, velocity, turn: 0.05 + 4.0 * s, shift: 0.01 + 1.0 * s })
    }
}
