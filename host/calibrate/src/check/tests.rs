//! A rig whose errors are known, and an operator who makes none.

use super::*;
use dpm_calibration::file::{BodySection, Pose, Provenance};
use dpm_device::planes::Raster;
use glam::DQuat;
use std::cell::{Cell, RefCell};

const TIP: DVec3 = DVec3::new(0.01, -0.02, 0.2);

/// The true world. The operator holds the tip exactly where he is told to.
struct World {
    camera: ProjectorCamera,
    body: Cell<DAffine3>,
    mesh_to_body: DAffine3,
    pixel: Cell<[u32; 2]>,
    point: Cell<DVec3>,
    tip: Cell<DVec3>,
    told: RefCell<Vec<String>>,
    touches: bool,
    /// Moves the body by 3 mm before the answer to question number 0, 1, ...; negative: never.
    moves_at: Cell<i32>,
}

impl World {
    fn new(mesh_to_body: DAffine3, touches: bool) -> Self {
        let raster = Raster::new(1024, 768).unwrap();
        let camera =
            ProjectorCamera::look_at(raster, DVec3::new(0.3, 0.4, 1.2), DVec3::ZERO, DVec3::Y, 0.6).unwrap();
        let body =
            DAffine3::from_rotation_translation(DQuat::from_rotation_y(0.2), DVec3::new(0.02, 0.0, 0.01));
        Self {
            camera,
            body: Cell::new(body),
            mesh_to_body,
            pixel: Cell::default(),
            point: Cell::default(),
            tip: Cell::default(),
            told: RefCell::default(),
            touches,
            moves_at: Cell::new(-1),
        }
    }

    fn true_point(&self) -> DVec3 {
        (self.body.get() * self.mesh_to_body).transform_point3(self.point.get())
    }
}

impl Bench for World {
    fn ask(&self, text: &str) -> Result<String, Failure> {
        self.moves_at.set(self.moves_at.get() - 1);
        if self.moves_at.get() == -1 {
            self.body.set(DAffine3::from_translation(DVec3::Y * 3e-3) * self.body.get());
        }
        if let Some((_, rest)) = text.split_once("at (") {
            let numbers = rest.split(')').next().unwrap();
            let v: Vec<f64> = numbers.split(',').map(|n| n.trim().parse().unwrap()).collect();
            self.point.set(DVec3::new(v[0], v[1], v[2]));
            let [x, y] = self.pixel.get().map(|v| f64::from(v) + 0.5);
            let ray = self.camera.ray(DVec2::new(x, y));
            self.tip.set(ray.origin + ray.direction * self.true_point().distance(ray.origin));
            return Ok(String::new());
        }
        assert!(text.contains("touch"), "{text}");
        self.tip.set(self.true_point());
        Ok(if self.touches { String::new() } else { "s".into() })
    }

    fn tell(&self, text: &str) {
        self.told.borrow_mut().push(text.to_owned());
    }

    fn hold(&self) -> Vec<Vec<TimedPose>> {
        let rotation = DQuat::from_rotation_x(-0.6);
        let wand = |stamp_ns| TimedPose { stamp_ns, position: self.tip.get() - rotation * TIP, rotation };
        let body = self.body.get();
        let rotation = DQuat::from_mat3(&body.matrix3);
        let lies = |stamp_ns| TimedPose { stamp_ns, position: body.translation, rotation };
        vec![(0..60).map(wand).collect(), (0..60).map(lies).collect()]
    }

    fn light(&self, pixel: [u32; 2]) {
        self.pixel.set(pixel);
    }
}

/// A box of 10 cm, of the same numbers on paper and in space.
fn target(camera: ProjectorCamera, mesh_to_body: DAffine3) -> Target {
    let corner =
        |i: usize| 0.05 * DVec3::from_array([0, 1, 2].map(|bit| if i >> bit & 1 == 1 { 1.0 } else { -1.0 }));
    let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let triangles =
        faces.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).map(|t| t.map(corner)).collect();
    Target::new("box".into(), camera, mesh_to_body, triangles)
}

fn check(world: &World, target: &Target, limit: f64) -> (Vec<Offset>, String, bool) {
    let offsets = measure(world, target, TIP, 6).unwrap();
    let mut file = CalibrationFile::new();
    let section = BodySection {
        mesh_to_body: Pose::new(&target.mesh_to_body),
        residual_m: Some(3e-4),
        provenance: Provenance::default(),
    };
    file.bodies.insert("box".into(), section);
    let (told, within) = judge(&offsets, &file, "box", limit).unwrap();
    (offsets, told, within)
}

#[test]
fn a_right_rig_passes() {
    let world = World::new(DAffine3::from_rotation_x(0.1), true);
    let (offsets, told, within) = check(&world, &target(world.camera, world.mesh_to_body), 2.0);
    assert!(within && offsets.len() >= 4, "{told}");
    // The coordinates that the operator reads have four decimals.
    assert!(offsets.iter().all(|o| o.light_m < 1e-4 && o.projector.length() < 1e-6), "{told}");
    assert!(told.contains("residual of 0.30 mm") && told.contains("projector was not calibrated"), "{told}");
}

#[test]
fn a_shifted_body_is_found_with_its_shift_and_named() {
    let world = World::new(DAffine3::IDENTITY, true);
    let shift = DVec3::new(4e-3, 0.0, 0.0);
    let (offsets, told, within) =
        check(&world, &target(world.camera, DAffine3::from_translation(shift)), 2.0);
    assert!(!within);
    assert!(told.contains("calibrate body --body \"box\"") && told.contains("is shifted"), "{told}");
    let in_world = -world.body.get().transform_vector3(shift);
    for o in &offsets {
        assert!((o.body_m.unwrap() - in_world).length() < 1e-4, "{o:?}");
    }
    // With a limit above the error the same rig passes.
    assert!(check(&world, &target(world.camera, DAffine3::from_translation(shift)), 20.0).2);
}

#[test]
fn a_shifted_projector_is_found_without_a_touch() {
    let world = World::new(DAffine3::IDENTITY, false);
    let mut camera = world.camera;
    camera.world_from_projector.translation += DVec3::X * 5e-3;
    let (offsets, told, within) = check(&world, &target(camera, DAffine3::IDENTITY), 2.0);
    assert!(!within && offsets.iter().all(|o| o.body.is_none()), "{told}");
    assert!(told.contains("calibrate projector") && told.contains("no point of it was touched"), "{told}");
}

#[test]
fn a_body_that_moves_gets_its_light_anew() {
    let world = World::new(DAffine3::IDENTITY, true);
    // Before the touch of the first point: the light must be measured again, where the body is now.
    world.moves_at.set(2);
    let (offsets, told, within) = check(&world, &target(world.camera, DAffine3::IDENTITY), 2.0);
    assert!(within && offsets.len() >= 4, "{told}");
    assert!(world.told.borrow().iter().any(|t| t.contains("moved by 3.0 mm")), "{:?}", world.told.borrow());
}

#[test]
fn nothing_measured_and_nothing_to_light_are_errors() {
    assert!(judge(&[], &CalibrationFile::new(), "box", 2.0).unwrap_err().message.contains("no point"));
    let world = World::new(DAffine3::IDENTITY, true);
    world.body.set(DAffine3::from_translation(DVec3::Z * 9.0));
    let target = target(world.camera, DAffine3::IDENTITY);
    assert!(measure(&world, &target, TIP, 6).unwrap_err().message.contains("faces the projector"));
}
