//! The whole chain from scene to radiance on the GPU against the f64 tracer, on scenes drawn by chance.

use super::gpu::GpuCase;
use super::gpu_compare::compare;
use super::gpu_shot::Shot;
use crate::reference::Sampler;
use dpm_render::gpu::Gpu;
use dpm_scene::shapes::*;
use dpm_scene::{Material, PunctualKind, PunctualLight, Scene};
use glam::{DAffine3, DQuat, DVec3, Vec3};
use std::sync::Arc;

/// Scenes of one run. The seed draws others: fifty take three seeds.
const SCENES: u64 = 17;

/// The cases.
pub(crate) const CASES: &[GpuCase] = &[
    GpuCase(
        "gpu-random-scenes-pixels",
        "17 random scenes: shapes, poses, all materials, textures, lights, skies",
        "f64 tracer: pixels beyond 4 sigma by those that chance allows",
        "ratio",
        1.0,
        |gpu, seed| worst(gpu, seed).0,
    ),
    GpuCase(
        "gpu-random-scenes-mean",
        "the same",
        "f64 tracer: mean radiance, by 4 sigma and 0.2 %",
        "ratio",
        1.0,
        |gpu, seed| worst(gpu, seed).1,
    ),
    GpuCase(
        "gpu-random-scenes-surfaces",
        "the same",
        "f64 tracer: pixels that see another surface",
        "share",
        1e-2,
        |gpu, seed| worst(gpu, seed).2,
    ),
];

/// A scene of three bodies and lights, and their poses.
fn by_chance(seed: u64) -> (Scene, Vec<DAffine3>) {
    furnish(seed, &mut |_, _, _| ())
}

/// The same, with the materials of two bodies changed by `change`, which draws from a sampler of its own.
pub(super) fn furnish(
    seed: u64,
    change: &mut dyn FnMut(&mut Scene, &mut Sampler, &mut Material),
) -> (Scene, Vec<DAffine3>) {
    let mut s = Sampler::new(seed, 7);
    let mut u = || s.uniform() as f32;
    let mut scene = Scene::default();
    let mut poses = vec![DAffine3::IDENTITY];
    let texture = noise_texture(8, seed, 40, 250, true);
    let base_color_texture = if u() < 0.5 { use_texture(&mut scene, texture) } else { None };
    let ground = Material { base_color_texture, ..diffuse(Vec3::new(0.3 + 0.6 * u(), 0.3 + 0.6 * u(), 0.5)) };
    add(&mut scene, floor(1.2, 0.0), ground);
    for k in 0..2u64 {
        let metallic = if u() < 0.3 { 1.0 } else { 0.0 };
        let transmission = if u() < 0.3 { u() } else { 0.0 };
        let look = Material {
            base_color: Vec3::new(0.2 + 0.7 * u(), 0.2 + 0.7 * u(), 0.2 + 0.7 * u()),
            metallic,
            transmission,
            thin_walled: u() < 0.5,
            // Narrow lobes lit by small lamps are beyond what 1,000 samples tell.
            roughness: 0.25 + 0.75 * u(),
            ior: 1.0 + u(),
            ..Material::default()
        };
        let shape = if u() < 0.5 {
            sphere(Vec3::ZERO, 0.2 + 0.15 * u(), 2, u() < 0.5)
        } else {
            let [a, b, c] = [0.3 + 0.2 * u(), 0.3 + 0.2 * u(), 0.2];
            join([
                quad(Vec3::new(-a, c, b), Vec3::X * 2.0 * a, Vec3::NEG_Z * 2.0 * b),
                quad(Vec3::new(-a, -c, -b), Vec3::X * 2.0 * a, Vec3::Z * 2.0 * b),
                quad(Vec3::new(-a, -c, b), Vec3::X * 2.0 * a, Vec3::Y * 2.0 * c),
                quad(Vec3::new(a, -c, -b), Vec3::NEG_X * 2.0 * a, Vec3::Y * 2.0 * c),
                quad(Vec3::new(a, -c, b), Vec3::NEG_Z * 2.0 * b, Vec3::Y * 2.0 * c),
                quad(Vec3::new(-a, -c, -b), Vec3::Z * 2.0 * b, Vec3::Y * 2.0 * c),
            ])
        };
        let mut look = look;
        change(&mut scene, &mut Sampler::new(seed, 100 + k), &mut look);
        add(&mut scene, shape, look);
        let turn =
            DQuat::from_euler(glam::EulerRot::XYZ, f64::from(u()), 6.0 * f64::from(u()), f64::from(u()));
        let at = DVec3::new(k as f64 * 0.9 - 0.45, 0.45 + 0.2 * f64::from(u()), 0.6 * f64::from(u()) - 0.3);
        poses.push(DAffine3::from_rotation_translation(turn, at));
    }
    let lamp = quad(Vec3::new(-0.4, 1.7, -0.4), Vec3::X * (0.3 + u()), Vec3::Z * (0.3 + u()));
    add(&mut scene, lamp, emitter(Vec3::new(2.0 + 3.0 * u(), 3.0, 2.0)));
    poses.push(DAffine3::IDENTITY);
    if u() < 0.6 {
        scene.lights.push(PunctualLight {
            kind: if u() < 0.5 { PunctualKind::Point } else { PunctualKind::Spot { inner: 0.3, outer: 0.8 } },
            intensity: Vec3::splat(0.5 + u()),
            body: None,
            position: Vec3::new(u() - 0.5, 1.5, u() - 0.5),
            direction: Vec3::NEG_Y,
            range: f32::INFINITY,
        });
    }
    scene.environment = if u() < 0.5 { sky(0.3 * u()) } else { image_sky(0.4) };
    (scene, poses)
}

/// Over all scenes: pixels that noise does not explain by those allowed, mean against its noise, share of other surfaces.
fn worst(gpu: &Arc<Gpu>, seed: u64) -> (f64, f64, f64) {
    let (mut beyond, mut values, mut mean, mut other) = (0.0, 0.0, 0.0f64, 0.0f64);
    for k in 0..SCENES {
        let (scene, poses) = by_chance(seed.wrapping_mul(1000).wrapping_add(k));
        let camera = camera(24, 18, DVec3::new(0.4, 1.5, 2.6), DVec3::new(0.0, 0.3, 0.0));
        let eye = Some(DVec3::new(-0.6, 1.4, 2.3));
        let shot = Shot { eye, poses, spp: 16, frames: 24, seed: seed as u32, ..Shot::new(&scene, camera) };
        let c = compare(gpu, &shot, 256);
        let e = c.explained();
        if c.common.len() < 100 || c.reference.dropped_samples > 0 || c.picture.invalid_samples() > 0 {
            return (f64::NAN, f64::NAN, f64::NAN);
        }
        beyond += e.beyond.len() as f64;
        values += e.values;
        other = other.max(c.different_share());
        for channel in 0..3 {
            let gap = c.mean_gap(channel);
            mean = mean.max((gap.gpu - gap.truth).abs() / (4.0 * gap.sigma + 2e-3 * gap.truth));
        }
    }
    (beyond / f64::max(4e-3 * values, 3.0), mean, other)
}
