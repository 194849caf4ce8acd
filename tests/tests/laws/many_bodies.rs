//! Rays find bodies in a tree where there are many (`host/render/src/body_tree.rs`). That changes the time that they take, and no pixel.

use dpm_lab::stability::gpu_shot::{Shot, ShotPicture};
use dpm_render::gpu::Gpu;
use dpm_render::scene_data::Keep;
use dpm_render::{FrameInputs, Renderer, Surface, PASSES};
use dpm_scene::shapes::*;
use dpm_scene::{Material, Scene};
use dpm_shaders::structs::NO_HIT;
use dpm_tests::compare::{assert_same_picture, bits};
use dpm_tests::gpu::with_gpu;
use glam::{DAffine3, DQuat, DVec3, Vec3};
use std::sync::Arc;

/// `side * side` balls before a wall: each a body of its own, or all of them one.
fn balls(side: u32, level: u32, apart: bool) -> Scene {
    let wall = quad(Vec3::new(-1.0, -1.0, -0.3), Vec3::X * 2.0, Vec3::Y * 2.0);
    let mut scene = scene_of(wall, diffuse(Vec3::splat(0.6)));
    let step = 1.6 / side as f32;
    let at = |k: u32| (k as f32 + 0.5) * step - 0.8;
    let all: Vec<_> = (0..side * side)
        .map(|k| sphere(Vec3::new(at(k % side), at(k / side), 0.1 * (k % 3) as f32), 0.4 * step, level, true))
        .collect();
    let material = Material { roughness: 0.5, ..diffuse(Vec3::new(0.8, 0.5, 0.3)) };
    if apart {
        for ball in all {
            add(&mut scene, ball, material.clone());
        }
    } else {
        add(&mut scene, join(all), material);
    }
    scene.environment = sky(0.9);
    scene
}

fn shot(scene: &Scene, (width, height): (u32, u32), spp: u32) -> Shot<'_> {
    let camera = camera(width, height, DVec3::new(0.0, 0.0, 2.6), DVec3::ZERO);
    Shot { eye: Some(DVec3::new(0.3, 0.2, 2.6)), spp, depth: 3, ..Shot::new(scene, camera) }
}

fn asked_each() -> Keep {
    Keep { body_list: true, ..Keep::default() }
}

/// Surfaces as numbers that are equal only when they are the same to the bit.
fn surface_bits(picture: &ShotPicture) -> Vec<[u32; 4]> {
    let of = |s: &Surface| {
        let [u, v] = s.barycentric.map(f32::to_bits);
        [s.id, u, v, s.distance.to_bits()]
    };
    picture.surfaces.iter().map(of).collect()
}

/// Bodies that moved apart, turned, that the projector does not light, and that have no surface: the tree shows what a list shows, through either
/// way of reading tables, from two to 65 bodies.
#[test]
fn the_tree_over_bodies_changes_no_pixel() {
    with_gpu(|gpu| {
        for side in [1, 3, 8] {
            let mut scene = balls(side, 2, true);
            let count = scene.bodies.len();
            for (i, body) in scene.bodies.iter_mut().enumerate().skip(1) {
                body.projected = i % 4 != 0;
                let turned = DQuat::from_rotation_z(0.02 * i as f64);
                body.world_from_body_rest =
                    DAffine3::from_rotation_translation(turned, DVec3::Z * 0.01 * i as f64);
                if i % 7 == 6 {
                    body.mesh.triangles.clear();
                    body.mesh.materials.clear();
                }
            }
            let shot = shot(&scene, (96, 72), 2);
            for storage_tables in [false, true] {
                let mut tree = Keep { storage_tables, ..Keep::default() };
                tree.needs.body_tree = true;
                let [listed, found] =
                    [Keep { storage_tables, ..asked_each() }, tree].map(|k| shot.draw_keeping(gpu, k));
                let what = format!("{count} bodies, storage {storage_tables}");
                assert_eq!(surface_bits(&listed), surface_bits(&found), "{what}");
                assert_same_picture(gpu, &listed.radiance, &found.radiance, &what);
                let lit = listed.surfaces.iter().filter(|s| s.id != NO_HIT).count();
                assert!(lit > listed.surfaces.len() / 3, "{what}: {lit} pixels lit");
                assert!(
                    bits(&listed.radiance).iter().any(|p| p[0] != bits(&listed.radiance)[0][0]),
                    "{what}: one colour"
                );
            }
        }
    });
}

/// Milliseconds that the passes with rays take in the fastest of several frames, and the pixels that are lit.
fn fastest_ms(gpu: &Arc<Gpu>, scene: &Scene, keep: Keep, frames: u32) -> (f64, u32) {
    let shot = shot(scene, (192, 144), 4);
    let mut renderer = Renderer::keeping(gpu, scene, shot.settings(), keep).expect("the scene fits the GPU");
    let mut slot = renderer.create_slot(false).expect("memory for a small frame");
    let poses: Vec<_> = scene.bodies.iter().map(|b| b.world_from_body_rest).collect();
    let eye = shot.eye.expect("an eye");
    let (mut best, mut lit) = (f64::INFINITY, 0);
    for frame in 0..frames {
        let inputs =
            FrameInputs { frame, spp: shot.spp, ..FrameInputs::new(&shot.camera, (eye, eye), &poses) };
        renderer.submit(&mut slot, &inputs).expect("submit");
        let cost = slot.wait(60_000_000_000).expect("the frame ends");
        let with_rays =
            PASSES.iter().zip(cost.pass_ns).filter(|(pass, _)| ["primary", "trace"].contains(pass));
        best = best.min(with_rays.map(|(_, ns)| ns as f64 * 1e-6).sum());
        lit = cost.counters().lit_pixels;
    }
    (best, lit)
}

/// What many bodies cost.
mod breadth {
    use super::*;

    /// As many balls cost at most twice as much as bodies of their own as they do as one body, and less than if a ray asked each of very many.
    #[test]
    fn many_bodies_cost_at_most_twice_as_much_as_one() {
        let walking = |body_tree: bool| {
            let mut keep = Keep { body_list: !body_tree, ..Keep::default() };
            keep.needs.body_tree = body_tree;
            keep
        };
        with_gpu(|gpu| {
            for side in [4, 8, 15] {
                let (one, many) = (balls(side, 3, false), balls(side, 3, true));
                let mut ms = [f64::INFINITY; 3];
                let mut lit = [0; 3];
                // In turns, so that what else runs on the machine slows all of them alike.
                for round in 0..12 {
                    // A busy machine may slow some of them more. So few rounds are enough if they show what is to be shown.
                    let [as_one, in_list, in_tree] = ms;
                    if round >= 2
                        && (side < 8 || in_tree < 2.0 * as_one)
                        && (side < 15 || in_tree < 0.7 * in_list)
                    {
                        break;
                    }
                    for (k, (scene, tree)) in
                        [(&one, false), (&many, false), (&many, true)].into_iter().enumerate()
                    {
                        let (fastest, pixels) = fastest_ms(gpu, scene, walking(tree), 3);
                        ms[k] = ms[k].min(fastest);
                        lit[k] = pixels;
                    }
                }
                let bodies = side * side + 1;
                println!(
                    "{bodies} bodies, {} pixels lit: as one {:.1} ms, in a list {:.1} ms, in a tree {:.1} ms",
                    lit[0], ms[0], ms[1], ms[2]
                );
                assert_eq!(lit[1], lit[2], "{bodies} bodies");
                assert!(lit[0].abs_diff(lit[2]) < lit[0] / 100, "{bodies} bodies: {lit:?}");
                if bodies == 65 {
                    assert!(ms[2] < 2.0 * ms[0], "{bodies} bodies: {ms:?} ms");
                }
                if bodies > 200 {
                    assert!(ms[2] < 0.7 * ms[1], "{bodies} bodies: {ms:?} ms");
                }
            }
        });
    }
}
