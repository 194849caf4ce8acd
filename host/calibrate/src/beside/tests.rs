//! Two mock cameras before a body at drawn places, from pictures to the place of one beside the other.

use super::*;
use dpm_camera::{sample_of, BodyFinder, FinderSetup, Markings, Picture, TagPlace};
use dpm_device::planes::Raster;
use dpm_device::rng::Draws;
use dpm_device::time::HostTime;
use dpm_device::tracker::{Tracker, TrackerError};
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::DAffine3;
use hil_mock::camera::{two_tags, CameraOptics, MarkedBody, MockCamera, MockCameraConfig};
use hil_mock::motion::{Motion, MotionSpec};
use std::sync::atomic::{AtomicI64, Ordering};

const SIZE: [u32; 2] = [640, 400];
/// So long that a camera expects nothing of where the body was.
const PERIOD_NS: i64 = 300_000_000;

/// A camera that takes one picture at each poll, of a body that is elsewhere each time.
struct PaintedTracker {
    pose: Pose,
    seed: u64,
    finder: BodyFinder,
    /// Of the body, in the world.
    places: Vec<Pose>,
    next: usize,
}

fn affine(pose: &Pose) -> DAffine3 {
    DAffine3::from_rotation_translation(
        DQuat::from_array(pose.rotation_xyzw),
        DVec3::from_array(pose.position_m),
    )
}

impl PaintedTracker {
    fn new(pose: Pose, seed: u64, places: Vec<Pose>) -> Self {
        let optics = CameraOptics::pinhole(SIZE, 60.0);
        let raster = Raster::new(SIZE[0], SIZE[1]).unwrap();
        let [f, c] = [optics.focal, optics.centre];
        let camera = ProjectorCamera::new(raster, DAffine3::IDENTITY, f[0], f[1], c[0], c[1]).unwrap();
        let tags = two_tags(0).map(|tag| TagPlace {
            id: tag.id,
            side: tag.side_m,
            body_from_tag: affine(&tag.place),
        });
        let bodies = vec![Markings { tags: tags.to_vec(), markers: vec![] }];
        let finder = BodyFinder::new(FinderSetup { camera, bodies, marker_level: 100 });
        Self { pose, seed, finder, places, next: 0 }
    }
}

impl Tracker for PaintedTracker {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        let Some(place) = self.places.get(self.next) else { return Ok(0) };
        self.next += 1;
        let motion = Motion::new(&MotionSpec::Still {}, *place).unwrap();
        let body = MarkedBody { motion, tags: two_tags(0).to_vec(), markers: vec![] };
        let config = MockCameraConfig {
            optics: CameraOptics::pinhole(SIZE, 60.0),
            pose: self.pose,
            seed: self.seed + 2 * self.next as u64,
            ..MockCameraConfig::default()
        };
        let mut camera = MockCamera::new(config, vec![body]).unwrap();
        let exposure = camera.exposure(3).unwrap();
        let mut picture = Picture {
            width: SIZE[0] as usize,
            height: SIZE[1] as usize,
            begin: now,
            exposure_ns: 2_000_000,
            ..Picture::default()
        };
        camera.paint(&exposure, &mut picture.pixels);
        let (at, found) = self.finder.look(&picture).unwrap();
        sink(&sample_of(0, at, found[0].as_ref()));
        Ok(1)
    }

    fn name(&self) -> &str {
        "painted"
    }
}

/// Where the second camera stands, and what was found of it, from `count` places.
fn found(seed: u64, count: usize) -> (DAffine3, Result<Vec<OtherCamera>, Failure>) {
    let draws = Draws::new(seed);
    let within = |k: u64, size: f64| size * (draws.unit(k) - 0.5);
    let turn = |y: f64, x: f64| (DQuat::from_rotation_y(y) * DQuat::from_rotation_x(x)).to_array();
    let first = Pose { position_m: [0.0, 0.0, 1.1], ..Pose::IDENTITY };
    let second = Pose { position_m: [0.55, within(1, 0.2), 0.95], rotation_xyzw: turn(0.52, within(2, 0.1)) };
    let place = |k: u64| Pose {
        position_m: [within(8 * k, 0.4), within(8 * k + 1, 0.25), within(8 * k + 2, 0.4)],
        rotation_xyzw: turn(0.25 + within(8 * k + 3, 0.6), within(8 * k + 4, 0.6)),
    };
    let places: Vec<Pose> = (1..=count as u64).map(place).collect();
    let painted =
        |pose: Pose, seed| -> Box<dyn Tracker> { Box::new(PaintedTracker::new(pose, seed, places.clone())) };
    let mut cameras =
        vec![("first".to_owned(), painted(first, 100)), ("second".to_owned(), painted(second, 201))];
    let now = AtomicI64::new(1_000_000_000);
    let clock = Arc::new(move || HostTime(now.fetch_add(PERIOD_NS, Ordering::Relaxed)));
    let task = PlaceTask { clock, places: count, time: Duration::from_secs(3) };
    (affine(&first).inverse() * affine(&second), measure(&mut cameras, &task, &mut |_| ()))
}

/// The place is right where the bodies were, to what is stated, to half a millimetre and to a milliradian.
#[test]
fn pictures_of_two_cameras_give_the_place_of_one_beside_the_other() {
    for seed in 1..=4 {
        let (truth, found) = found(seed, 30);
        let CameraPlace { first_from_other, sigma_m, sigma_rad, places, misfit } =
            found.unwrap_or_else(|e| panic!("{e:?}"))[0].place;
        let middle = truth.inverse().transform_point3(DVec3::new(0.0, 0.0, -1.1));
        let off = (first_from_other.transform_point3(middle) - truth.transform_point3(middle)).length();
        let turned =
            so3_between(DQuat::from_mat3(&truth.matrix3), DQuat::from_mat3(&first_from_other.matrix3))
                .length();
        eprintln!(
            "{seed}: {off:.5} of {sigma_m:.5} m, {turned:.5} of {sigma_rad:.5} rad, {places} places, misfit {misfit:.2}"
        );
        // Three axes, of which none is worse than stated: beyond 3.4 standard deviations is one in a hundred.
        assert!(off < 3.4 * sigma_m && off < 5e-4, "{seed}: {off} of {sigma_m}");
        assert!(turned < 3.4 * sigma_rad && turned < 1e-3, "{seed}: {turned} of {sigma_rad}");
        assert!(places >= 20 && misfit < 2.0, "{places}, {misfit}");
    }
}

/// Two or three places make none, and the operator reads what to do.
#[test]
fn too_few_places_are_refused() {
    let (_, found) = found(1, 3);
    let told = found.err().expect("three are too few").message;
    assert!(told.contains("second") && told.contains("carry it slowly"), "{told}");
}
