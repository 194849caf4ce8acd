//! Inside a closed sphere of albedo 1/2 and emission 1/2 the radiance is 1 everywhere, so a leak or a
//! self-intersection is visible at once.
//!
//! A path of depth d adds the first d terms of `sum 0.5^k`, so its mean is `1 - 0.5^d`, from every position and at
//! every size.

use dpm_lab::stability::estimate::pooled;
use dpm_lab::stability::gpu_shot::{Picture, Shot};
use dpm_scene::shapes::*;
use dpm_scene::{Material, Scene};
use dpm_tests::gpu::with_gpu;
use glam::{DAffine3, DQuat, DVec3, Vec3};

fn lamp(double_sided: bool) -> Material {
    Material { emissive: Vec3::splat(0.5), double_sided, ..diffuse(Vec3::splat(0.5)) }
}

/// Checks that every pixel met a surface, and that the mean is that of a closed space at this depth.
fn assert_closed(what: &str, picture: &Picture, depth: u32) {
    let missed = (0..picture.surfaces.len()).filter(|&i| !picture.hit(i)).count();
    assert_eq!(missed, 0, "{what}: rays that left the closed sphere");
    let (mean, sigma) = pooled(&picture.estimates, 1);
    let expected = 1.0 - 0.5f64.powi(depth as i32);
    assert!(sigma < 4e-3, "{what}: sigma {sigma}");
    assert!(
        (mean - expected).abs() < 4.0 * sigma + 1e-6,
        "{what}, depth {depth}: {mean} +- {sigma}, expected {expected}"
    );
    assert_eq!(picture.counters.iter().map(|c| c.invalid_samples).sum::<u32>(), 0, "{what}");
}

#[test]
fn depth_d_keeps_the_first_d_terms() {
    with_gpu(|gpu| {
        let scene = scene_of(sphere(Vec3::ZERO, 2.0, 1, false), lamp(true));
        let camera = camera(32, 24, DVec3::new(0.3, -0.2, 0.1), DVec3::NEG_Z);
        for depth in [1, 2, 3, 12] {
            let picture = Shot { spp: 16, frames: 8, depth, ..Shot::new(&scene, camera) }.draw(gpu);
            assert_closed("radius 2", &picture, depth);
            if depth == 1 {
                assert!(picture.estimates.iter().all(|e| e.mean == [0.5; 3]), "emission alone has no noise");
            }
        }
    });
}

#[test]
fn no_size_and_no_place_leaks() {
    with_gpu(|gpu| {
        for radius in [1e-3f32, 1.0, 1e4] {
            // Built at the origin, then moved and rotated by its pose, as the tracker does.
            let scene = scene_of(sphere(Vec3::ZERO, radius, 2, true), lamp(true));
            for distance in [0.0, 1.0, 1e4] {
                let centre = DVec3::new(0.6, -0.48, 0.64) * distance;
                let turn = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, 1.1, -0.7);
                let inside = centre + DVec3::new(0.31, -0.2, 0.11) * f64::from(radius);
                let camera = camera(24, 24, inside, centre + DVec3::new(-0.1, 0.9, 0.3) * f64::from(radius));
                let shot = Shot {
                    spp: 16,
                    frames: 8,
                    depth: 10,
                    poses: vec![DAffine3::from_rotation_translation(turn, centre)],
                    ..Shot::new(&scene, camera)
                };
                assert_closed(&format!("radius {radius} at {distance}"), &shot.draw(gpu), 10);
            }
        }
    });
}

#[test]
fn seen_from_outside_a_sphere_does_not_shine_through_itself() {
    // Single-sided and lit from inside only: from outside it is black at any distance. The lamp inside must not leak
    // out.
    with_gpu(|gpu| {
        for (radius, distance) in [(1e-3f32, 1.0f64), (1.0, 1e3), (1e4, 1e5)] {
            let (scene, camera) = lamp_in_a_sphere(radius, distance);
            let picture = Shot { depth: 6, ..Shot::new(&scene, camera) }.draw(gpu);
            let lit = picture.lit_estimates().count();
            assert!(lit > 300, "{lit}");
            for (i, e) in picture.estimates.iter().enumerate() {
                assert_eq!(e.mean, [0.0; 3], "radius {radius} at {distance}, pixel {i}");
            }
        }
    });
}

#[test]
fn a_room_of_many_bodies_is_closed_too() {
    // The same sphere, divided into four bodies whose seams meet only in world space.
    with_gpu(|gpu| {
        let whole = sphere(Vec3::ZERO, 1.0, 2, true);
        let mut scene = Scene::default();
        for part in 0..4 {
            let mut mesh = whole.clone();
            let n = whole.triangles.len() / 4;
            mesh.triangles = whole.triangles[part * n..(part + 1) * n].to_vec();
            add(&mut scene, mesh, lamp(true));
        }
        // All parts have the same pose, so no gap may appear between them.
        let pose =
            DAffine3::from_rotation_translation(DQuat::from_rotation_x(0.4), DVec3::new(0.2, 0.1, -0.3));
        let camera = camera(32, 24, DVec3::new(0.1, 0.2, 0.1), DVec3::NEG_Z);
        let shot = Shot { spp: 16, frames: 8, depth: 8, poses: vec![pose; 4], ..Shot::new(&scene, camera) };
        assert_closed("four bodies", &shot.draw(gpu), 8);
    });
}
