//! The light of a projector with a lens: every pixel's ray, every motion vector and every tile, against the lens in f64, which is itself held
//! to pixels that OpenCV computed (`host/scene/tests/laws/opencv_lens.rs`).

use dpm_device::planes::Raster;
use dpm_lab::stability::gpu_shot::Shot;
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_render::{FrameInputs, FrameSlot, Keep, Renderer, Surface};
use dpm_scene::geometry::lens::Lens;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::{shapes, Scene};
use dpm_shaders::structs::NO_HIT;
use dpm_tests::gpu::with_gpu;
use glam::{DAffine3, DQuat, DVec2, DVec3, Vec3};
use std::sync::Arc;

/// Strong lenses of every model.
fn lenses() -> Vec<(&'static str, Lens)> {
    let brown = |c: &[f64]| Lens::opencv(c).unwrap();
    vec![
        ("none", Lens::default()),
        ("barrel", brown(&[-0.25, 0.09, 0.004, -0.003])),
        ("pincushion", brown(&[0.2, 0.05, -0.002, 0.003, 0.01])),
        ("rational", brown(&[0.6, 0.1, 1e-3, 1e-3, 0.02, 0.8, 0.2, 0.01])),
        (
            "tilted",
            brown(&[-0.2, 0.08, 2e-3, -3e-3, 0.0, 0.0, 0.0, 0.0, 4e-3, -1e-3, 3e-3, 1e-3, 0.05, -0.08]),
        ),
        ("fisheye", Lens::fisheye([-0.08, 0.03, -0.015, 0.004]).unwrap()),
    ]
}

/// A projector of 256 x 192 pixels with the view of one of 1024 x 768.
fn projector(lens: Lens) -> ProjectorCamera {
    let raster = Raster::new(256, 192).unwrap();
    let mut camera =
        ProjectorCamera::look_at(raster, DVec3::new(0.2, 0.5, 1.6), DVec3::ZERO, DVec3::Y, 0.9).unwrap();
    camera.cy += 30.0;
    camera.with_lens(lens).unwrap()
}

/// A square that fills the raster, and one that does not.
fn square(half: f32) -> Scene {
    let quad = shapes::quad(Vec3::new(-half, -half, 0.0), Vec3::X * 2.0 * half, Vec3::Y * 2.0 * half);
    let mut scene = shapes::scene_of(quad, shapes::diffuse(Vec3::splat(0.5)));
    scene.environment = shapes::sky(0.5);
    scene
}

/// Draws frames with a pose each; `each` sees every one.
fn draw(
    gpu: &Arc<Gpu>,
    scene: &Scene,
    camera: &ProjectorCamera,
    poses: &[DAffine3],
    keep: Keep,
    mut each: impl FnMut(&FrameSlot),
) -> Renderer {
    let method = Method { temporal: true, ..Method::full(1) };
    let shot = Shot { method: Some(method), eye: Some(camera.position()), ..Shot::new(scene, *camera) };
    let mut renderer = Renderer::keeping(gpu, scene, shot.settings(), keep).unwrap();
    let mut slot = renderer.create_slot(true).unwrap();
    for (frame, pose) in poses.iter().enumerate() {
        let poses = [*pose];
        let still = FrameInputs::new(camera, (camera.position() + DVec3::X * 0.1, DVec3::ZERO), &poses);
        let inputs = FrameInputs { frame: frame as u32, ..still };
        renderer.submit(&mut slot, &inputs).unwrap();
        slot.wait(60_000_000_000).unwrap();
        each(&slot);
    }
    renderer
}

/// The point of the body that a pixel met, by its barycentric weights.
fn point_of(scene: &Scene, renderer: &Renderer, surface: &Surface) -> DVec3 {
    let positions = &scene.bodies[0].mesh.positions;
    let [u, v] = surface.barycentric.map(f64::from);
    let p = renderer.corners(surface).map(|i| positions[i as usize].as_dvec3());
    p[0] * (1.0 - u - v) + p[1] * u + p[2] * v
}

#[test]
fn light_falls_where_the_lens_projects_and_moves_as_it_does() {
    with_gpu(|gpu| {
        let scene = square(3.0);
        let now =
            DAffine3::from_rotation_translation(DQuat::from_rotation_y(0.3), DVec3::new(0.0, 0.1, -0.2));
        let before =
            DAffine3::from_rotation_translation(DQuat::from_rotation_y(0.29), DVec3::new(0.003, 0.1, -0.2));
        for (name, lens) in lenses() {
            let camera = projector(lens);
            let (mut surfaces, mut guides) = (vec![], vec![]);
            let renderer = draw(gpu, &scene, &camera, &[before, now], Keep::default(), |slot| {
                surfaces = slot.surfaces().unwrap();
                guides = slot.guides().unwrap();
            });
            let (mut worst, mut worst_motion, mut lit) = (0.0f64, 0.0f64, 0);
            for (i, surface) in surfaces.iter().enumerate().filter(|(_, s)| s.id != NO_HIT) {
                let centre = DVec2::new(f64::from(i as u32 % 256) + 0.5, f64::from(i as u32 / 256) + 0.5);
                let point = point_of(&scene, &renderer, surface);
                let at = camera.project(now.transform_point3(point)).unwrap();
                worst = worst.max((at - centre).length());
                let was = camera.project(before.transform_point3(point)).unwrap();
                let motion = guides[i].sight.motion.map(f64::from);
                worst_motion = worst_motion.max((centre - was - DVec2::from_array(motion)).length());
                lit += 1;
            }
            println!(
                "{name}: {lit} pixels, light off by {worst:.5} px, motion by {worst_motion:.5} px at most"
            );
            assert_eq!(lit, 256 * 192, "{name}: the square fills the raster");
            // A quarter of the raster's side: 0.01 px of 1024 columns are 0.0025 here.
            assert!(worst < 0.0025, "{name}: light is {worst} px from where the lens projects");
            assert!(worst_motion < 0.005, "{name}: motion is off by {worst_motion} px");
        }
    });
}

/// Every tile, under every lens.
mod breadth {
    use super::*;

    #[test]
    fn no_tile_that_a_body_touches_is_left_out() {
        with_gpu(|gpu| {
            let scene = square(0.25);
            for (name, lens) in lenses() {
                let camera = projector(lens);
                let poses: Vec<DAffine3> = (0..12)
                    .map(|k| {
                        let t = f64::from(k);
                        let at = DVec2::from_angle(2.4 * t) * (0.08 * t);
                        let turn = DQuat::from_euler(glam::EulerRot::XYZ, 0.2 * t, 0.3, 0.1 * t);
                        DAffine3::from_rotation_translation(turn, DVec3::new(at.x, 0.3 * at.y, 0.3))
                    })
                    .collect();
                let ids = |keep| {
                    let mut ids: Vec<Vec<u32>> = vec![];
                    draw(gpu, &scene, &camera, &poses, keep, |slot| {
                        ids.push(slot.surfaces().unwrap().iter().map(|s| s.id).collect());
                    });
                    ids
                };
                let lean = ids(Keep::default());
                let all = ids(Keep { every_tile: true, ..Keep::default() });
                for (k, (lean, all)) in lean.iter().zip(&all).enumerate() {
                    let hit = all.iter().filter(|id| **id != NO_HIT).count();
                    assert!(hit > 500 && hit < 40_000, "{name}, pose {k}: {hit} pixels");
                    let different = lean.iter().zip(all).filter(|(a, b)| a != b).count();
                    assert_eq!(different, 0, "{name}, pose {k}: pixels that only all tiles light");
                }
            }
        });
    }
}
