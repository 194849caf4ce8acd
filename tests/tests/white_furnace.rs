//! Objects in uniform light, on the GPU: no surface may create energy, and surfaces that lose none must be invisible.

use dpm_lab::stability::estimate::pooled;
use dpm_lab::stability::gpu_shot::Shot;
use dpm_scene::shapes::*;
use dpm_scene::{Material, Scene};
use dpm_tests::gpu::with_gpu;
use glam::{DVec3, Vec3};

/// A faceted sphere of radius 1 under a sky of radiance 1.
fn furnace(material: Material) -> Scene {
    let mut scene = scene_of(sphere(Vec3::ZERO, 1.0, 2, false), material);
    scene.environment = sky(1.0);
    scene
}

#[test]
fn a_white_lambertian_sphere_vanishes_exactly() {
    with_gpu(|gpu| {
        let scene = furnace(diffuse(Vec3::ONE));
        let camera = camera(64, 48, DVec3::new(0.0, 0.0, 5.0), DVec3::ZERO);
        let shot = Shot { depth: 8, ..Shot::new(&scene, camera) };
        // An ordinary camera: the sphere is indistinguishable from the sky.
        let picture = shot.draw(gpu);
        let hits = (0..picture.surfaces.len()).filter(|&i| picture.hit(i)).count();
        assert!(hits > 500 && hits < 64 * 48, "{hits}");
        for (i, e) in picture.estimates.iter().enumerate() {
            assert!(e.mean.iter().all(|m| (m - 1.0).abs() < 2e-6), "pixel {i}: {:?}", e.mean);
        }
        // The rig: 1 where lit, 0 elsewhere.
        let picture = Shot { eye: Some(DVec3::new(2.0, 1.0, 5.0)), ..shot }.draw(gpu);
        let lit = (0..picture.surfaces.len()).filter(|&i| picture.lit(i)).count();
        assert!(lit > 300 && lit < hits, "{lit} of {hits}");
        for (i, e) in picture.estimates.iter().enumerate() {
            let expected = f64::from(u8::from(picture.lit(i)));
            assert!(e.mean.iter().all(|m| (m - expected).abs() < 2e-6), "pixel {i}: {:?}", e.mean);
        }
        assert_eq!(picture.counters[0].invalid_samples, 0);
        assert_eq!(picture.counters[0].lit_pixels as usize, lit);
    });
}

#[test]
fn a_corner_of_white_walls_is_one() {
    // Paths bounce many times before they leave, and Russian roulette ends none of them for a long time.
    with_gpu(|gpu| {
        let mut scene = scene_of(floor(1.0, 0.0), diffuse(Vec3::ONE));
        add(&mut scene, quad(Vec3::new(-1.0, 0.0, -1.0), Vec3::X * 2.0, Vec3::Y * 2.0), diffuse(Vec3::ONE));
        add(
            &mut scene,
            quad(Vec3::new(-1.0, 0.0, 1.0), Vec3::NEG_Z * 2.0, Vec3::Y * 2.0),
            diffuse(Vec3::ONE),
        );
        scene.environment = sky(1.0);
        let camera = camera(32, 24, DVec3::new(4.0, 5.0, 6.0), DVec3::new(-0.5, 0.5, -0.5));
        let picture = Shot { spp: 32, frames: 8, depth: 64, ..Shot::new(&scene, camera) }.draw(gpu);
        let (mean, sigma) = pooled(&picture.estimates, 0);
        assert!(sigma < 2e-3, "{sigma}");
        assert!((mean - 1.0).abs() < 4.0 * sigma + 1e-6, "{mean} +- {sigma}");
    });
}

#[test]
fn a_coated_white_sphere_keeps_all_light() {
    with_gpu(|gpu| {
        for ior in [1.1, 1.5, 2.4] {
            for roughness in [0.0, 0.1, 0.6] {
                let scene = furnace(Material { ior, roughness, ..diffuse(Vec3::ONE) });
                let camera = camera(32, 32, DVec3::new(0.0, 0.0, 5.0), DVec3::ZERO);
                let picture = Shot { spp: 64, frames: 8, depth: 2, ..Shot::new(&scene, camera) }.draw(gpu);
                let lit: Vec<_> = picture.lit_estimates().collect();
                let (mean, sigma) = pooled(lit, 1);
                // The table of directional albedo is exact to 2e-3 (docs/RENDERING.md).
                assert!(sigma < 2e-3, "{sigma}");
                assert!(
                    (mean - 1.0).abs() < 4.0 * sigma + 2e-3,
                    "ior {ior} roughness {roughness}: {mean} +- {sigma}"
                );
            }
        }
    });
}

#[test]
fn single_scattering_metal_keeps_what_theory_says() {
    // A distant sphere in parallel projection shows every cosine mu with weight 2 mu. Its mean is therefore the
    // average albedo E_avg = 2 int E(mu) mu dmu of a perfect GGX mirror without multiple scattering.
    with_gpu(|gpu| {
        for (alpha, expected) in [(0.25f32, 0.882), (0.5, 0.700), (1.0, 0.409)] {
            let metal = Material { roughness: alpha.sqrt(), ..Material::default() };
            let mut scene = scene_of(sphere(Vec3::ZERO, 1.0, 4, false), metal);
            scene.environment = sky(1.0);
            let mut camera = camera(48, 48, DVec3::new(0.0, 0.0, 2000.0), DVec3::ZERO);
            (camera.fx, camera.fy) = (2000.0 * 22.0, 2000.0 * 22.0);
            let picture = Shot { spp: 64, frames: 8, depth: 2, ..Shot::new(&scene, camera) }.draw(gpu);
            let lit: Vec<_> = picture.lit_estimates().collect();
            assert!((lit.len() as f64 / (std::f64::consts::PI * 22.0 * 22.0) - 1.0).abs() < 0.02);
            let (mean, sigma) = pooled(lit, 2);
            assert!((mean - expected).abs() < 4.0 * sigma + 4e-3, "alpha {alpha}: {mean} +- {sigma}");
        }
    });
}

#[test]
fn clear_glass_in_even_light_vanishes() {
    with_gpu(|gpu| {
        for (thin_walled, ior, roughness) in [
            (false, 1.5, 0.0),
            (false, 2.4, 0.0),
            (true, 1.5, 0.0),
            (false, 1.0005, 0.0),
            (true, 1.5, 0.6),
            (false, 1.0005, 0.6),
        ] {
            let scene = clear_slab(ior, roughness, thin_walled);
            let camera = camera(24, 24, DVec3::new(0.0, 3.0, 5.0), DVec3::ZERO);
            let picture = Shot { spp: 64, frames: 8, depth: 32, ..Shot::new(&scene, camera) }.draw(gpu);
            let (mean, sigma) = pooled(picture.lit_estimates().collect::<Vec<_>>(), 0);
            // A thin wall takes its reflection from the table, and it has two surfaces.
            let tolerance = if thin_walled || roughness > 0.0 { 4e-3 } else { 1e-4 };
            assert!(sigma < 5e-3, "{sigma}");
            assert!(
                (mean - 1.0).abs() < 4.0 * sigma + tolerance,
                "thin {thin_walled} ior {ior} r {roughness}: {mean} +- {sigma}"
            );
        }
    });
}

#[test]
fn no_material_creates_energy() {
    with_gpu(|gpu| {
        for roughness in [0.0, 0.0317, 0.7] {
            for (metallic, transmission, thin_walled) in
                [(1.0, 0.0, true), (0.0, 1.0, true), (0.0, 1.0, false), (0.5, 0.5, false), (0.3, 0.5, true)]
            {
                let m = Material { roughness, metallic, transmission, thin_walled, ..Material::default() };
                let scene = furnace(m);
                let camera = camera(24, 24, DVec3::new(0.0, 0.0, 5.0), DVec3::ZERO);
                let picture = Shot { spp: 64, frames: 8, depth: 32, ..Shot::new(&scene, camera) }.draw(gpu);
                let lit: Vec<_> = picture.lit_estimates().collect();
                let (mean, sigma) = pooled(lit.iter().copied(), 0);
                let what = format!(
                    "r {roughness} metal {metallic} t {transmission} thin {thin_walled}: {mean} +- {sigma}"
                );
                assert!(mean > 0.1 && mean < 1.0 + 2e-3 + 4.0 * sigma, "{what}");
                assert!(lit.iter().all(|e| e.mean.iter().all(|m| m.is_finite() && *m >= 0.0)), "{what}");
                assert_eq!(picture.counters.iter().map(|c| c.invalid_samples).sum::<u32>(), 0, "{what}");
            }
        }
    });
}
