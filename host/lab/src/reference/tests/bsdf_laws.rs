//! Parts of scattering that no stability case reaches alone: refraction, the density of microfacets, and the sky's sampler.

use super::*;
use crate::reference::microfacet::*;
use crate::reference::Sampler;
use crate::statistics::test_directions;
use std::f64::consts::PI;

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
    let test = test_directions(40_000, &mut draw, &|d| image.pdf(d));
    assert!(test.integral_error.abs() < 6e-3 && test.p_value > 1e-3, "{test:?}");
}
