//! Compares the GPU's pictures with the f64 reference, in the rig's geometry: rays from the projector, radiance
//! toward the eye.

use dpm_lab::reference::Sampler;
use dpm_lab::stability::gpu_shot::Shot;
use dpm_render::gpu::Gpu;
use dpm_scene::shapes::*;
use dpm_scene::{Material, PunctualKind, PunctualLight, Scene};
use dpm_tests::compare::{compare, Demands};
use dpm_tests::gpu::with_gpu;
use glam::{DAffine3, DQuat, DVec3, Vec3};
use proptest::prelude::*;
use std::sync::Arc;

/// A projector above a table top and an eye beside it; 32 frames of 32 samples.
fn shot(scene: &Scene) -> Shot<'_> {
    let camera = camera(48, 36, DVec3::new(0.4, 1.8, 2.6), DVec3::new(0.0, 0.25, 0.0));
    Shot { eye: Some(DVec3::new(-0.9, 1.6, 2.2)), spp: 32, frames: 32, ..Shot::new(scene, camera) }
}

/// A pose that is rotated about all axes.
fn tilted(x: f64, y: f64, z: f64) -> DAffine3 {
    DAffine3::from_rotation_translation(
        DQuat::from_euler(glam::EulerRot::XYZ, 0.3, 0.8, -0.2),
        DVec3::new(x, y, z),
    )
}

fn judge(gpu: &Arc<Gpu>, what: &str, shot: &Shot<'_>, spp: u32, relative: f64) {
    let c = compare(gpu, shot, spp);
    assert!(c.common.len() > 300, "{what}: {} common pixels", c.common.len());
    c.assert_same_surfaces(what, 5e-3);
    c.assert_same_mean(what, relative);
    c.assert_pixels_explained(what);
}

#[test]
fn diffuse_with_an_area_light_and_textures() {
    with_gpu(|gpu| {
        let mut scene = Scene::default();
        let texture = use_texture(&mut scene, noise_texture(8, 3, 30, 250, true));
        let textured = Material { base_color_texture: texture, ..diffuse(Vec3::new(0.9, 0.8, 0.7)) };
        add(&mut scene, floor(1.2, 0.0), textured.clone());
        add(&mut scene, sphere(Vec3::ZERO, 0.35, 3, true), Material { base_color_texture: None, ..textured });
        let glow = use_texture(&mut scene, noise_texture(4, 5, 60, 255, true));
        let lamp = quad(Vec3::new(0.1, 1.5, -0.6), Vec3::new(0.5, 0.0, 0.0), Vec3::new(0.0, 0.1, 0.5));
        add(&mut scene, lamp, Material { emissive_texture: glow, ..emitter(Vec3::new(6.0, 5.0, 4.0)) });
        scene.environment = sky(0.2);
        let poses = vec![DAffine3::IDENTITY, tilted(-0.1, 0.4, 0.2), DAffine3::IDENTITY];
        judge(gpu, "diffuse", &Shot { poses, ..shot(&scene) }, 512, 1e-2);
    });
}

#[test]
fn glossy_with_a_normal_map_and_punctual_lights() {
    with_gpu(|gpu| {
        let mut scene = Scene::default();
        let bumps = use_texture(&mut scene, noise_texture(8, 11, 90, 165, false));
        let worn = use_texture(&mut scene, noise_texture(8, 12, 100, 255, false));
        let metal = Material {
            base_color: Vec3::new(0.9, 0.7, 0.4),
            roughness: 0.6,
            normal_texture: bumps,
            normal_scale: 0.6,
            metallic_roughness_texture: worn,
            ..Material::default()
        };
        add(&mut scene, floor(1.2, 0.0), metal);
        let coated = Material { roughness: 0.35, ior: 1.5, ..diffuse(Vec3::new(0.2, 0.4, 0.8)) };
        add(&mut scene, sphere(Vec3::ZERO, 0.35, 3, true), coated);
        let light = |kind, intensity, position: Vec3, direction: Vec3| PunctualLight {
            kind,
            intensity,
            body: None,
            position,
            direction: direction.normalize(),
            range: f32::INFINITY,
        };
        let spot = PunctualKind::Spot { inner: 0.3, outer: 0.6 };
        scene.lights = vec![
            PunctualLight {
                range: 4.0,
                ..light(PunctualKind::Point, Vec3::splat(2.0), Vec3::new(1.0, 1.2, 0.5), Vec3::Y)
            },
            light(spot, Vec3::new(4.0, 2.0, 1.0), Vec3::new(-1.0, 2.0, 0.0), Vec3::new(0.5, -1.0, 0.1)),
            light(PunctualKind::Directional, Vec3::splat(0.5), Vec3::ZERO, Vec3::new(-0.3, -1.0, -0.4)),
            // Carried by the sphere's body.
            PunctualLight {
                body: Some(1),
                ..light(spot, Vec3::splat(1.0), Vec3::new(0.5, 0.3, 0.1), Vec3::new(0.2, -1.0, 0.0))
            },
        ];
        scene.environment = sky(0.1);
        let poses = vec![DAffine3::IDENTITY, tilted(-0.1, 0.45, 0.1)];
        judge(gpu, "glossy", &Shot { poses, ..shot(&scene) }, 768, 1e-2);
    });
}

/// Spheres and quads of any material in any pose under any light, from a seed.
fn random_scene(seed: u64) -> (Scene, Vec<DAffine3>) {
    let mut random = Sampler::new(seed, 1);
    let mut scene = Scene::default();
    let mut poses = vec![DAffine3::IDENTITY];
    add(&mut scene, floor(1.5, 0.0), diffuse(Vec3::splat(0.6)));
    for k in 0..4 {
        let mut u = || random.uniform() as f32;
        let kind = (u() * 4.0) as u32;
        let material = Material {
            base_color: Vec3::new(0.2 + 0.7 * u(), 0.2 + 0.7 * u(), 0.2 + 0.7 * u()),
            roughness: 0.3 + 0.7 * u(),
            metallic: if kind == 1 { u() } else { 0.0 },
            ior: 1.0 + 0.8 * u(),
            transmission: if kind == 2 { 0.5 + 0.5 * u() } else { 0.0 },
            thin_walled: u() < 0.5,
            double_sided: u() < 0.5,
            emissive: if kind == 3 { Vec3::splat(1.0 + 2.0 * u()) } else { Vec3::ZERO },
            ..Material::default()
        };
        let size = 0.15 + 0.25 * u();
        let place = DVec3::new(f64::from(u()) - 0.5, 0.1 + 0.6 * f64::from(u()), f64::from(u()) - 0.5) * 1.6;
        let turn = DQuat::from_euler(glam::EulerRot::XYZ, f64::from(6.0 * u()), f64::from(6.0 * u()), 0.4);
        let mesh = if k % 2 == 0 {
            sphere(Vec3::ZERO, size, 2, u() < 0.5)
        } else {
            quad(Vec3::new(-size, 0.0, size), Vec3::X * 2.0 * size, Vec3::NEG_Z * 2.0 * size)
        };
        add(&mut scene, mesh, material);
        poses.push(DAffine3::from_rotation_translation(turn, place));
    }
    let u = random.uniform() as f32;
    scene.environment = if u < 0.5 { sky(0.3 + u) } else { image_sky(u) };
    (scene, poses)
}

/// Scenes of every other kind.
mod breadth {
    use super::*;

    #[test]
    fn transmissive_solid_and_thin_under_an_environment_map() {
        with_gpu(|gpu| {
            let mut scene = Scene::default();
            add(&mut scene, floor(1.2, 0.0), diffuse(Vec3::new(0.7, 0.6, 0.5)));
            let glass =
                Material { metallic: 0.0, transmission: 1.0, thin_walled: false, ..Material::default() };
            add(
                &mut scene,
                sphere(Vec3::ZERO, 0.3, 3, true),
                Material { roughness: 0.0, base_color: Vec3::new(0.9, 1.0, 0.9), ..glass.clone() },
            );
            add(
                &mut scene,
                sphere(Vec3::ZERO, 0.3, 3, true),
                Material { roughness: 0.55, transmission: 0.8, ..glass.clone() },
            );
            let stained = use_texture(&mut scene, noise_texture(4, 9, 60, 220, false));
            let sheet = Material {
                thin_walled: true,
                roughness: 0.4,
                transmission_texture: stained,
                base_color: Vec3::new(1.0, 0.6, 0.5),
                ..glass
            };
            add(&mut scene, quad(Vec3::new(0.2, 0.0, 0.6), Vec3::new(0.6, 0.0, 0.1), Vec3::Y * 0.6), sheet);
            scene.environment = image_sky(0.5);
            let poses = vec![
                DAffine3::IDENTITY,
                tilted(-0.45, 0.31, 0.1),
                tilted(0.3, 0.31, -0.2),
                DAffine3::IDENTITY,
            ];
            judge(gpu, "transmissive", &Shot { poses, depth: 6, ..shot(&scene) }, 768, 1e-2);
        });
    }

    #[test]
    fn holes_sides_and_a_thousand_lamps() {
        with_gpu(|gpu| {
            let mut scene = Scene::default();
            add(&mut scene, floor(1.2, 0.0), diffuse(Vec3::splat(0.7)));
            // A sheet with holes, seen from both sides; its shadow has holes too.
            let mut lace = noise_texture(8, 21, 100, 255, true);
            lace.texels
                .iter_mut()
                .enumerate()
                .for_each(|(i, t)| t[3] = if (i * 7 + i / 8) % 3 == 0 { 0 } else { 255 });
            lace.nearest = true;
            let lace = use_texture(&mut scene, lace);
            let sheet = Material {
                base_color_texture: lace,
                alpha_cutoff: Some(0.5),
                double_sided: true,
                ..diffuse(Vec3::ONE)
            };
            add(
                &mut scene,
                quad(Vec3::new(-0.8, 0.1, 0.5), Vec3::X * 0.8, Vec3::new(0.0, 0.7, -0.2)),
                sheet.clone(),
            );
            // The same, facing away from the projector: its back is visible.
            add(&mut scene, quad(Vec3::new(0.8, 0.1, 0.5), Vec3::X * -0.7, Vec3::new(0.0, 0.6, -0.2)), sheet);
            // Single-sided and facing away: black, and it blocks light.
            add(
                &mut scene,
                quad(Vec3::new(0.35, 0.05, -0.4), Vec3::X * -0.7, Vec3::Y * 0.5),
                diffuse(Vec3::ONE),
            );
            // 20,480 emissive triangles; the alias table must contain them all.
            add(
                &mut scene,
                sphere(Vec3::ZERO, 0.25, 5, true),
                Material { double_sided: true, ..emitter(Vec3::new(3.0, 3.5, 4.0)) },
            );
            let mut poses = vec![DAffine3::IDENTITY; 5];
            poses[4] = tilted(0.2, 1.3, 0.6);
            judge(gpu, "holes", &Shot { poses, ..shot(&scene) }, 512, 1e-2);
        });
    }

    #[test]
    fn random_scenes() {
        with_gpu(|gpu| {
            let mut runner = proptest::test_runner::TestRunner::new_with_rng(
                ProptestConfig {
                    cases: 4,
                    max_shrink_iters: 0,
                    failure_persistence: None,
                    ..ProptestConfig::default()
                },
                proptest::test_runner::TestRng::deterministic_rng(
                    proptest::test_runner::RngAlgorithm::ChaCha,
                ),
            );
            runner
                .run(&any::<u64>(), |seed| {
                    let (scene, poses) = random_scene(seed);
                    judge(gpu, &format!("seed {seed}"), &Shot { poses, spp: 12, ..shot(&scene) }, 256, 2e-2);
                    Ok(())
                })
                .unwrap();
        });
    }
}
