//! Scattering functions against Fresnel's equations, reciprocity, and the statistics of their samplers.

use super::*;
use crate::reference::bsdf::Bsdf;
use crate::reference::microfacet::*;
use crate::reference::Sampler;
use crate::stability::scattering::{direction, look, patch};
use crate::stability::statistics::test_directions;
use dpm_scene::albedo_table::AlbedoTable;
use std::f64::consts::PI;

/// Fresnel's equations with Snell's law, as in any textbook.
fn fresnel_textbook(eta: f64, cos_i: f64) -> f64 {
    let sin_t2 = (1.0 - cos_i * cos_i) / (eta * eta);
    if sin_t2 >= 1.0 {
        return 1.0;
    }
    let cos_t = (1.0 - sin_t2).sqrt();
    let s = (cos_i - eta * cos_t) / (cos_i + eta * cos_t);
    let p = (eta * cos_i - cos_t) / (eta * cos_i + cos_t);
    0.5 * (s * s + p * p)
}

#[test]
fn fresnel_equals_the_closed_form_and_is_continuous() {
    for eta in [1.1, 1.5, 2.4, 1.0 / 1.5, 1.0 / 1.1, 0.2] {
        for i in 0..=1000 {
            let c = f64::from(i) / 1000.0;
            let (f, want) = (fresnel_dielectric(eta, c), fresnel_textbook(eta, c));
            assert!((f - want).abs() < 1e-12, "eta {eta} cos {c}: {f} {want}");
        }
    }
    assert!((fresnel_dielectric(1.5, 1.0) - 0.04).abs() < 1e-15);
    for c in [0.0, 1e-9, 0.3, 1.0] {
        assert_eq!(fresnel_dielectric(1.0, c), 0.0);
    }
    // eta = 1 + d at normal incidence: d^2 / 4, to full precision although the textbook form has lost half its digits.
    let d = 1e-7;
    let f = fresnel_dielectric(1.0 + d, 1.0);
    let exact = ((1.0 + d) - 1.0f64).powi(2) / (2.0 + d).powi(2);
    assert!((f / exact - 1.0).abs() < 1e-9, "{f} {exact}");
    // The edge of total reflection at sin = 1 / 1.5 is approached like a square root, without a step.
    let edge = (1.0 - 1.0 / (1.5f64 * 1.5)).sqrt();
    for d in [1e-4, 1e-8, 1e-12] {
        let f = fresnel_dielectric(1.0 / 1.5, edge + d);
        assert!(f < 1.0 && 1.0 - f < 20.0 * d.sqrt(), "{d}: {f}");
        assert_eq!(fresnel_dielectric(1.0 / 1.5, edge - d), 1.0);
    }
    assert_eq!(fresnel_dielectric(1.5, 1.0 + 1e-9), fresnel_dielectric(1.5, 1.0));
}

#[test]
fn refraction_obeys_snell() {
    for eta in [1.5, 1.0 / 1.5, 1.0] {
        let v = DVec3::new(0.4, -0.3, 0.8).normalize();
        let h = DVec3::new(0.1, 0.2, 0.9).normalize();
        let l = refract(v, h, eta).unwrap();
        assert!((l.length() - 1.0).abs() < 1e-14);
        // Tangential parts: sin_i = eta sin_t, and all three in one plane.
        let (tv, tl) = (v - h * v.dot(h), l - h * l.dot(h));
        assert!((tv + tl * eta).length() < 1e-14 && l.dot(h) < 0.0);
    }
    assert_eq!(refract(DVec3::new(0.9, 0.0, 0.19f64.sqrt()).normalize(), DVec3::Z, 1.0 / 1.5), None);
}

#[test]
fn ggx_is_a_density_of_projected_normals() {
    // integral D(h) (n.h) dh = 1 and integral D_v(h) dh = 1 for every v.
    for alpha in [0.05, 0.3, 1.0] {
        let n = 2000;
        let (mut projected, mut visible) = (0.0, 0.0);
        let v = DVec3::new(0.6, 0.0, 0.8);
        for i in 0..n {
            // tan(theta) = alpha t / (1 - t): even coverage of the peak.
            let t = (f64::from(i) + 0.5) / f64::from(n);
            let tan = alpha * t / (1.0 - t);
            let cos = 1.0 / (1.0 + tan * tan).sqrt();
            let dtheta = alpha / ((1.0 - t) * (1.0 - t)) * cos * cos;
            let sin = tan * cos;
            let m = 200;
            let mut ring = 0.0;
            for j in 0..m {
                let phi = 2.0 * PI * f64::from(j) / f64::from(m);
                let h = DVec3::new(sin * phi.cos(), sin * phi.sin(), cos);
                ring += visible_normal_pdf(v, h, alpha) * 2.0 * PI / f64::from(m);
            }
            projected +=
                ggx_d(DVec3::new(sin, 0.0, cos), alpha) * cos * 2.0 * PI * sin * dtheta / f64::from(n);
            visible += ring * sin * dtheta / f64::from(n);
        }
        assert!((projected - 1.0).abs() < 1e-4, "{alpha}: {projected}");
        assert!((visible - 1.0).abs() < 1e-3, "{alpha}: {visible}");
    }
    assert_eq!(sample_visible_normal(-DVec3::Z, 1.0, [0.0, 0.0]).map(|h| h.is_finite()), None);
}

#[test]
fn scattering_is_reciprocal() {
    let mut sampler = Sampler::new(3, 0);
    for roughness in [0.1, 0.4, 1.0] {
        for (metallic, transmission, thin_walled) in
            [(0.0, 0.0, true), (1.0, 0.0, true), (0.4, 0.5, false), (0.0, 1.0, false)]
        {
            let base_color = Vec3::new(0.9, 0.5, 0.1);
            let m = Material { base_color, ..look(roughness, metallic, transmission, thin_walled) };
            let p = patch(&m);
            let table = AlbedoTable::new(m.ior);
            for _ in 0..200 {
                let (a, b) = (direction(sampler.uniform2(), 1.0), direction(sampler.uniform2(), 1.0));
                let f = |v: DVec3, l: DVec3| Bsdf::new(&p, &table, v).unwrap().evaluate(l).f_cos / l.y.abs();
                let (ab, ba) = (f(a, b), f(b, a));
                assert!((ab - ba).abs().max_element() <= 1e-10 * ab.max_element(), "{ab} {ba}");
                if transmission == 0.0 {
                    continue;
                }
                // Refraction: f(a, b) n_b^2 = f(b, a) n_a^2, radiance over the square of the index being what travels.
                let c = direction(sampler.uniform2(), -1.0);
                let (ac, ca) = (f(a, c) * f64::from(m.ior).powi(2), f(c, a));
                assert!((ac - ca).abs().max_element() <= 1e-9 * ac.max_element(), "{ac} {ca}");
            }
        }
    }
}

fn chi_square(
    name: &str,
    samples: u32,
    sample: &mut dyn FnMut() -> Option<DVec3>,
    pdf: &dyn Fn(DVec3) -> f64,
) {
    let test = test_directions(samples, sample, pdf);
    assert!(test.integral_error.abs() < 6e-3 && test.p_value > 1e-3, "{name}: {test:?}");
}

#[test]
fn every_bsdf_sampler_draws_from_its_density() {
    for (roughness, metallic, transmission, thin_walled, v_y) in [
        (0.5f32, 1.0f32, 0.0f32, true, 0.9f64),
        (0.7, 1.0, 0.0, true, 0.15),
        (1.0, 1.0, 0.0, true, 0.5),
        (0.6, 0.0, 0.0, true, 0.6),
        (0.7, 0.0, 1.0, false, 0.7),
        (0.8, 0.3, 0.6, false, -0.6),
        (0.0, 0.0, 0.0, true, 0.5),
    ] {
        let base_color = Vec3::splat(0.8);
        let m = Material { base_color, ..look(roughness, metallic, transmission, thin_walled) };
        let p = patch(&m);
        let table = AlbedoTable::new(m.ior);
        let v = DVec3::new((1.0 - v_y * v_y).sqrt(), v_y, 0.0);
        let bsdf = Bsdf::new(&p, &table, v).unwrap();
        let mut sampler = Sampler::new(11, 0);
        let mut draw = || {
            let s = bsdf.sample(sampler.uniform(), sampler.uniform2(), sampler.uniform())?;
            let pdf = s.pdf?;
            let value = bsdf.evaluate(s.l);
            assert!((value.pdf - pdf).abs() <= 1e-7 * pdf, "{} {pdf}", value.pdf);
            assert!((value.f_cos - s.weight * pdf).abs().max_element() <= 1e-7 * value.f_cos.max_element());
            Some(s.l)
        };
        chi_square(&format!("{m:?}"), 150_000, &mut draw, &|l| bsdf.evaluate(l).pdf);
    }
}

#[test]
fn the_sky_sampler_draws_from_its_density() {
    let (w, h) = (20usize, 10usize);
    let texels: Vec<Vec3> =
        (0..w * h).map(|i| Vec3::splat(if i % 7 == 0 { 0.0 } else { (i % 11) as f32 })).collect();
    let image = crate::reference::light::SkyImage::new(w, h, texels, 0.0);
    let mut sampler = Sampler::new(2, 0);
    let mut draw = || {
        let (d, pdf) = image.sample(sampler.uniform2())?;
        assert!((image.pdf(d) - pdf).abs() <= 1e-9 * pdf);
        Some(d)
    };
    // Rows of the image are even in angle, cells of the histogram in cosine: the density is a step function within cells.
    chi_square("sky", 40_000, &mut draw, &|d| image.pdf(d));
}
