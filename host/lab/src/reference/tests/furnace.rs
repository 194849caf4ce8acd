//! Everything in even light: no surface may create energy, and those that lose none must vanish.

use super::*;
use crate::reference::bsdf::Bsdf;
use crate::reference::{Reference, RenderSettings, Sampler};
use dpm_scene::albedo_table::AlbedoTable;

/// Mean and standard error of the weight of scattered rays that leave a flat patch seen at cosine `mu`: its directional albedo.
fn directional_albedo(
    material: &Material,
    table: &AlbedoTable,
    mu: f64,
    n: u32,
    from_behind: bool,
) -> (f64, f64) {
    let s = scene_of(floor(1.0, 0.0), material.clone());
    let r = Reference::new(&s, &[]);
    let v = DVec3::new((1.0 - mu * mu).sqrt(), if from_behind { -mu } else { mu }, 0.0);
    let point = r.trace(v * 2.0, -v, 10.0, false).expect("the patch lies at the origin");
    let Some(bsdf) = Bsdf::new(&point, table, v) else { return (0.0, 0.0) };
    let mut sampler = Sampler::new(7, 0);
    let (mut mean, mut m2) = (0.0, 0.0);
    for i in 0..n {
        let w = (bsdf.sample(sampler.uniform(), sampler.uniform2(), sampler.uniform()))
            .map_or(0.0, |s| s.weight.max_element());
        let d = w - mean;
        mean += d / f64::from(i + 1);
        m2 += d * (w - mean);
    }
    (mean, (m2 / f64::from(n)).sqrt() / f64::from(n).sqrt())
}

#[test]
fn a_white_lambertian_sphere_vanishes_exactly() {
    let mut s = scene_of(sphere(Vec3::ZERO, 1.0, 2, false), diffuse(Vec3::ONE));
    s.environment = sky(1.0);
    let c = camera(24, 24, DVec3::new(0.0, 0.0, 5.0), DVec3::ZERO);
    let settings = RenderSettings { spp: 4, depth: 64, ..Default::default() };
    let image = Reference::new(&s, &[]).render_camera(&c, &settings);
    for p in &image.mean {
        assert!((p[0] - 1.0).abs() < 1e-12, "{p:?}");
    }
    // And as the rig sees it: where lit, the same.
    let image = Reference::new(&s, &[]).render(&c, DVec3::new(2.0, 1.0, 5.0), &settings);
    let lit = image.lit.iter().filter(|l| **l).count();
    assert!(lit > 50 && lit < 24 * 24);
    for (p, lit) in image.mean.iter().zip(&image.lit) {
        assert!((p[0] - f64::from(u8::from(*lit))).abs() < 1e-12, "{p:?}");
    }
    assert_eq!(image.dropped_samples, 0);
}

#[test]
fn a_concave_white_room_in_even_light_is_one() {
    // A corner of three white walls: paths bounce many times before they leave.
    let mut s = scene_of(floor(1.0, 0.0), diffuse(Vec3::ONE));
    add(&mut s, quad(Vec3::new(-1.0, 0.0, -1.0), Vec3::X * 2.0, Vec3::Y * 2.0), diffuse(Vec3::ONE));
    add(&mut s, quad(Vec3::new(-1.0, 0.0, 1.0), Vec3::NEG_Z * 2.0, Vec3::Y * 2.0), diffuse(Vec3::ONE));
    s.environment = sky(1.0);
    let c = camera(12, 12, DVec3::new(4.0, 5.0, 6.0), DVec3::new(-0.5, 0.5, -0.5));
    let settings = RenderSettings { spp: 200, depth: 64, ..Default::default() };
    let image = Reference::new(&s, &[]).render_camera(&c, &settings);
    let n = image.mean.len() as f64;
    let mean = image.mean.iter().map(|p| p[0]).sum::<f64>() / n;
    let sigma = (image.variance.iter().map(|v| v[0]).sum::<f64>()).sqrt() / n;
    assert!((mean - 1.0).abs() < 4.0 * sigma + 1e-9 && sigma < 2e-3, "{mean} +- {sigma}");
}

#[test]
fn closed_sphere_of_albedo_and_emission_one_half_is_one() {
    let material = Material { emissive: Vec3::splat(0.5), double_sided: true, ..diffuse(Vec3::splat(0.5)) };
    let s = scene_of(sphere(Vec3::new(0.3, -0.2, 0.1), 2.0, 1, false), material);
    let r = Reference::new(&s, &[]);
    let c = camera(16, 16, DVec3::ZERO, DVec3::NEG_Z);
    let image =
        r.render_camera(&c, &RenderSettings { spp: 200, depth: 64, jitter: true, ..Default::default() });
    let n = image.mean.len() as f64;
    let mean = image.mean.iter().map(|p| p[1]).sum::<f64>() / n;
    let sigma = image.variance.iter().map(|v| v[1]).sum::<f64>().sqrt() / n;
    assert!((mean - 1.0).abs() < 4.0 * sigma && sigma < 3e-3, "{mean} +- {sigma}");
    // The stated variances explain the errors of the pixels.
    let squares = image.mean.iter().zip(&image.variance).map(|(m, v)| (m[1] - 1.0).powi(2) / v[1]);
    let chi2 = squares.sum::<f64>() / n;
    assert!((0.6..1.6).contains(&chi2), "{chi2}");
    // Depth d keeps the first d terms of sum 0.5^k.
    for depth in 1..4u32 {
        let image = r.render_camera(&c, &RenderSettings { spp: 64, depth, ..Default::default() });
        let mean = image.mean_lit()[1];
        assert!((mean - (1.0 - 0.5f64.powi(depth as i32))).abs() < 4.0 * sigma, "depth {depth}: {mean}");
    }
}

#[test]
fn coated_white_diffuse_keeps_all_light() {
    for ior in [1.0, 1.1, 1.5, 2.4] {
        let table = AlbedoTable::new(ior);
        for roughness in [0.0, 0.1, 0.5, 1.0] {
            let m = Material { ior, roughness, ..diffuse(Vec3::ONE) };
            for mu in [1.0, 0.6, 0.2, 0.05] {
                let (albedo, sigma) = directional_albedo(&m, &table, mu, 4000, false);
                let tolerance = if ior == 1.0 { 1e-12 } else { 3e-3 };
                assert!(
                    (albedo - 1.0).abs() < 4.5 * sigma + tolerance,
                    "ior {ior} r {roughness} mu {mu}: {albedo} +- {sigma}"
                );
            }
        }
    }
}

#[test]
fn single_scattering_metal_keeps_what_theory_says() {
    // E_avg = 2 integral E(mu) mu dmu of a perfect GGX mirror without multiple scattering, alpha .25 / .5 / 1.
    for (alpha, expected) in [(0.25f32, 0.882), (0.5, 0.700), (1.0, 0.409)] {
        let m = Material { roughness: alpha.sqrt(), ..Material::default() };
        let table = AlbedoTable::new(1.5);
        let n = 40;
        let mut sum = 0.0;
        for i in 0..n {
            let mu = (f64::from(i) + 0.5) / f64::from(n);
            let e = directional_albedo(&m, &table, mu, 4000, false).0;
            sum += 2.0 * e * mu / f64::from(n);
        }
        assert!((sum - expected).abs() < 3e-3, "alpha {alpha}: {sum}");
    }
}

#[test]
fn no_material_creates_energy() {
    for ior in [1.0, 1.0 + 1e-7, 1.0011, 1.5, 2.4] {
        let table = AlbedoTable::new(ior);
        for roughness in [0.0, 1e-4, 1e-3, 0.0317, 0.1, 0.5, 1.0] {
            for (metallic, transmission, thin_walled) in [
                (0.0, 0.0, true),
                (1.0, 0.0, true),
                (0.0, 1.0, true),
                (0.0, 1.0, false),
                (0.5, 0.5, false),
                (0.3, 0.5, true),
            ] {
                let m =
                    Material { roughness, ior, metallic, transmission, thin_walled, ..Material::default() };
                for mu in [1.0, 0.3, 1.745e-4] {
                    for behind in [false, true] {
                        let (mut albedo, sigma) = directional_albedo(&m, &table, mu, 600, behind);
                        // Radiance grows by eta^2 when the path enters the solid's inside from its outside; the power does not.
                        if !thin_walled && transmission > 0.0 && behind {
                            albedo /= f64::from(ior * ior);
                        }
                        assert!(albedo.is_finite() && albedo >= 0.0);
                        // Nearly even indices reflect only at grazing, between two nodes of the table.
                        let bound = 1.0 + if ior < 1.1 { 2.5e-2 } else { 5e-3 } + 5.0 * sigma;
                        assert!(albedo <= bound, "r {roughness} ior {ior} m {metallic} t {transmission} thin {thin_walled} mu {mu} {behind}: {albedo} +- {sigma}");
                    }
                }
            }
        }
    }
}

#[test]
fn clear_glass_in_even_light_vanishes() {
    let glass = Material {
        metallic: 0.0,
        roughness: 0.0,
        transmission: 1.0,
        thin_walled: false,
        ..Material::default()
    };
    for (thin_walled, ior) in [(false, 1.5), (false, 2.4), (true, 1.5), (false, 1.0005)] {
        let mut s =
            scene_of(sphere(Vec3::ZERO, 1.0, 1, false), Material { thin_walled, ior, ..glass.clone() });
        s.environment = sky(1.0);
        let c = camera(12, 12, DVec3::new(0.0, 0.0, 4.0), DVec3::ZERO);
        let image = Reference::new(&s, &[])
            .render_camera(&c, &RenderSettings { spp: 200, depth: 64, ..Default::default() });
        let n = image.mean.len() as f64;
        let mean = image.mean.iter().map(|p| p[0]).sum::<f64>() / n;
        let sigma = image.variance.iter().map(|v| v[0]).sum::<f64>().sqrt() / n;
        // Thin walls take their reflection from the table.
        assert!(
            (mean - 1.0).abs() < 4.0 * sigma + if thin_walled { 2e-3 } else { 1e-4 },
            "{mean} +- {sigma}"
        );
        assert!(sigma < 1e-2);
    }
}
