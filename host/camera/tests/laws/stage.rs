//! A camera of 1280 x 800 and 60 degrees before drawn bodies, in numbers and in pictures.

use dpm_camera::{Markings, TagPlace};
use dpm_device::planes::Raster;
use dpm_device::pose::Pose;
use dpm_device::rng::Draws;
use dpm_mock::camera::{BrightMarker, CameraOptics, MarkedBody, MockCamera, MockCameraConfig, PrintedTag};
use dpm_mock::motion::{Motion, MotionSpec};
use dpm_scene::geometry::lens::Lens;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DQuat, DVec3};

/// The camera, at the origin, with the lens of [`optics`].
pub(crate) fn camera(optics: &CameraOptics) -> ProjectorCamera {
    let raster = Raster::new(optics.size[0], optics.size[1]).unwrap();
    let [f, c] = [optics.focal, optics.centre];
    let pinhole = ProjectorCamera::new(raster, DAffine3::IDENTITY, f[0], f[1], c[0], c[1]).unwrap();
    pinhole.with_lens(Lens::opencv(&optics.lens).unwrap()).unwrap()
}

/// The optics that the laws are about, with a lens that bends the corners of the picture by 15 pixels.
pub(crate) fn optics() -> CameraOptics {
    CameraOptics { lens: [-0.08, 0.02, 0.0005, -0.0003, 0.0], ..CameraOptics::pinhole([1280, 800], 60.0) }
}

/// A rotation drawn evenly.
pub(crate) fn any_rotation(draws: Draws) -> DQuat {
    let [x, y, z] = draws.normal3(0);
    DQuat::from_xyzw(x, y, z, draws.normal(9)).normalize()
}

fn direction(draws: Draws) -> DVec3 {
    DVec3::from_array(draws.normal3(0)).normalize()
}

/// A drawn vector within a ball.
pub(crate) fn within(draws: Draws, radius: f64) -> DVec3 {
    direction(draws.stream(1)) * radius * draws.unit(99).cbrt()
}

pub(crate) fn pose_of(motion: &DAffine3) -> Pose {
    let rotation = DQuat::from_mat3(&motion.matrix3).normalize();
    Pose { position_m: motion.translation.to_array(), rotation_xyzw: rotation.to_array() }
}

pub(crate) fn affine_of(pose: &Pose) -> DAffine3 {
    let rotation = DQuat::from_array(pose.rotation_xyzw);
    DAffine3::from_rotation_translation(rotation, DVec3::from_array(pose.position_m))
}

/// Two tags of 80 mm on the faces of a roof whose ridge opens by 60 degrees, as on a corner of a box.
pub(crate) fn two_tags() -> Markings {
    let face = |id: u16, side: f64| {
        let turn = DQuat::from_rotation_y(side * 30f64.to_radians());
        let body_from_tag = DAffine3::from_rotation_translation(
            turn,
            turn * DVec3::new(0.0, 0.0, 0.0) + DVec3::new(side * 0.055, 0.0, 0.0),
        );
        TagPlace { id, side: 0.08, body_from_tag }
    };
    Markings { tags: vec![face(17, 1.0), face(401, -1.0)], markers: vec![] }
}

/// A pose at `distance` metres in which the front of a body is turned towards the camera within `most` radians.
pub(crate) fn facing(draws: Draws, distance: f64, most: f64) -> DAffine3 {
    let aside = |i| 2.0 * draws.unit(i) - 1.0;
    let place = DVec3::new(0.28 * aside(1), 0.17 * aside(2), -1.0) * distance;
    let roll = DQuat::from_rotation_z(std::f64::consts::TAU * draws.unit(3));
    let tilt = DQuat::from_axis_angle(
        DQuat::from_rotation_z(std::f64::consts::TAU * draws.unit(4)) * DVec3::X,
        most * draws.unit(5).sqrt(),
    );
    DAffine3::from_rotation_translation(tilt * roll, place)
}

/// The mock's body with these markings, and a motion about a pose.
pub(crate) fn body(markings: &Markings, pose: &DAffine3, motion: &MotionSpec) -> MarkedBody {
    let tags = markings.tags.iter().map(|t| PrintedTag {
        id: t.id,
        side_m: t.side,
        place: pose_of(&t.body_from_tag),
    });
    let markers = markings.markers.iter().map(|m| BrightMarker { middle_m: m.to_array(), radius_m: 0.006 });
    MarkedBody {
        motion: Motion::new(motion, pose_of(pose)).unwrap(),
        tags: tags.collect(),
        markers: markers.collect(),
    }
}

/// A picture of bodies, and its number's exposure.
pub(crate) fn picture(config: &MockCameraConfig, bodies: Vec<MarkedBody>, number: u64) -> (Vec<u8>, i64) {
    let mut mock = MockCamera::new(config.clone(), bodies).unwrap();
    let exposure = mock.exposure(number).unwrap();
    let mut pixels = Vec::new();
    mock.paint(&exposure, &mut pixels);
    (pixels, exposure.begin_ns + config.exposure_ns / 2)
}

/// The value below which the share `q` of all lies.
pub(crate) fn quantile(values: &mut [f64], q: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[((values.len() - 1) as f64 * q).round() as usize]
}
