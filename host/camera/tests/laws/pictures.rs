//! What the detectors find in the mock's pictures: corners, spots and poses against the drawn truth.

use crate::stage::{affine_of, body, camera, facing, optics, picture, quantile, two_tags};
use dpm_camera::{GreyImage, Markings, Sightings, SpotDetector, TagDetector};
use dpm_common::so3::so3_between;
use dpm_device::rng::Draws;
use dpm_mock::camera::MockCameraConfig;
use dpm_mock::motion::MotionSpec;
use glam::{DAffine3, DQuat, DVec3};

/// Errors of many poses.
#[derive(Default)]
struct Errors {
    corners_px: Vec<f64>,
    places_mm: Vec<f64>,
    turns_deg: Vec<f64>,
    missed: usize,
}

impl Errors {
    /// 99 of 100 are below these: pixels of a corner, millimetres and degrees of a pose.
    fn p99(&mut self) -> [f64; 3] {
        [&mut self.corners_px, &mut self.places_mm, &mut self.turns_deg].map(|v| quantile(v, 0.99))
    }
}

/// Looks at a body in `pictures` drawn poses at a metre.
fn look(
    markings: &Markings,
    pictures: u64,
    tilt: f64,
    motion: &MotionSpec,
    config: &MockCameraConfig,
) -> Errors {
    let cam = camera(&config.optics);
    let (mut tag_detector, mut spot_detector) = (TagDetector::new(), SpotDetector::default());
    let (mut tags, mut spots, mut errors) = (Vec::new(), Vec::new(), Errors::default());
    for seed in 0..pictures {
        let rest = facing(Draws::new(seed), 1.0, tilt);
        let shown = body(markings, &rest, motion);
        let config = MockCameraConfig { seed, ..config.clone() };
        let (pixels, middle_ns) = picture(&config, vec![shown.clone()], seed % 50);
        let truth = affine_of(&shown.motion.pose_at(middle_ns));
        let image = GreyImage::new(1280, 800, &pixels).unwrap();
        if markings.markers.is_empty() {
            tag_detector.detect(&image, Some(&cam), &mut tags);
        } else {
            spot_detector.detect(&image, 100, &mut spots);
        }
        for tag in &tags {
            let place = markings.tags.iter().find(|t| t.id == tag.id).expect("a tag that is there");
            for (corner, seen) in place.corners().iter().zip(tag.corners) {
                errors
                    .corners_px
                    .push((seen - cam.project(truth.transform_point3(*corner)).unwrap()).length());
            }
        }
        for spot in &spots {
            let there = markings.markers.iter().map(|m| cam.project(truth.transform_point3(*m)).unwrap());
            errors.corners_px.push(there.map(|p| (p - spot.centre).length()).fold(f64::INFINITY, f64::min));
        }
        let sightings = Sightings { tags: &tags, spots: &spots, row_s: 0.0, row: 400.0 };
        match markings.locate(&[cam], &[sightings], None) {
            Some(found) => {
                errors.places_mm.push(1e3 * (found.fit.position - truth.translation).length());
                let turn = so3_between(found.fit.rotation, DQuat::from_mat3(&truth.matrix3));
                errors.turns_deg.push(turn.length().to_degrees());
            }
            None => errors.missed += 1,
        }
    }
    errors
}

fn config() -> MockCameraConfig {
    MockCameraConfig { optics: optics(), samples: 6, ..MockCameraConfig::default() }
}

#[test]
fn tags_at_rest_are_seen_to_hundredths_of_a_pixel() {
    let mut errors = look(&two_tags(), 12, 0.5, &MotionSpec::Still {}, &config());
    let [corner, place, turn] = errors.p99();
    let median = quantile(&mut errors.corners_px, 0.5);
    println!("{median:.3} px, p99 {corner:.3} px, {place:.3} mm, {turn:.3} deg, {} missed", errors.missed);
    assert!(errors.missed == 0 && median < 0.05 && corner < 0.5, "{median} px, {corner} px");
    assert!(place < 1.0 && turn < 0.2, "{place} mm, {turn} deg");
}

/// Blur by 0.5 m/s and 2 ms of exposure, which is a millimetre and a pixel: the pose is that of the middle of the exposure.
#[test]
fn blur_leans_to_no_side() {
    let moving =
        MotionSpec::Sinusoid { direction: [1.0, 0.4, 0.3], peak_speed_m_s: 0.5, peak_acceleration_m_s2: 5.0 };
    let config = MockCameraConfig { exposure_ns: 4_000_000, instants: 16, ..config() };
    let mut errors = look(&two_tags(), 12, 0.5, &moving, &config);
    let [corner, place, turn] = errors.p99();
    println!("p99 {corner:.3} px, {place:.3} mm, {turn:.3} deg, {} missed", errors.missed);
    assert!(
        errors.missed <= 1 && place < 2.0 && turn < 0.3,
        "{place} mm, {turn} deg, {} missed",
        errors.missed
    );
}

#[test]
fn markers_are_seen_to_half_a_millimetre() {
    let markers =
        [[0.0, 0.0, 0.0], [0.1, 0.0, 0.02], [0.0, 0.08, 0.0], [-0.07, -0.05, 0.03], [0.05, -0.06, -0.03]];
    let markings = Markings { tags: vec![], markers: markers.map(DVec3::from_array).to_vec() };
    let dark = MockCameraConfig { white: 40.0, ..config() };
    let mut errors = look(&markings, 20, 0.8, &MotionSpec::Still {}, &dark);
    let [spot, place, turn] = errors.p99();
    println!("p99 {spot:.3} px, {place:.3} mm, {turn:.3} deg, {} missed", errors.missed);
    assert!(errors.missed <= 3, "{} missed", errors.missed);
    assert!(spot < 0.1 && place < 0.5 && turn < 0.15, "{spot} px, {place} mm, {turn} deg");
}

/// The mock's own geometry is that of the cameras of the scene: the mean of a marker's light lies where it is projected.
#[test]
fn the_picture_is_where_the_scene_says() {
    let markings = Markings { tags: vec![], markers: vec![DVec3::ZERO] };
    let config = MockCameraConfig {
        white: 20.0,
        clutter: 0,
        read_noise: 0.0,
        photon_noise: 0.0,
        samples: 12,
        ..config()
    };
    let cam = camera(&config.optics);
    for (x, y, z) in [(0.0, 0.0, -1.0), (0.4, 0.2, -0.9), (-0.5, -0.3, -1.1), (0.02, -0.2, -0.7)] {
        let there = DAffine3::from_translation(DVec3::new(x, y, z));
        let (pixels, _) = picture(&config, vec![body(&markings, &there, &MotionSpec::Still {})], 0);
        let mut spots = Vec::new();
        SpotDetector::default().detect(&GreyImage::new(1280, 800, &pixels).unwrap(), 100, &mut spots);
        let off = spots[0].centre - cam.project(there.translation).unwrap();
        // A ball aside of the axis is an ellipse whose middle lies a little farther out.
        assert!(spots.len() == 1 && off.length() < 0.05, "{off} at {x} {y} {z}");
    }
}
