//! The scene's table of directional albedos against the oracle's own microfacets, which share no code with it.

use crate::reference::microfacet::{
    fresnel_dielectric, ggx_d, sample_visible_normal, smith_g2, smith_g2_over_g1,
};
use crate::reference::Sampler;
use dpm_scene::albedo_table::directional_albedo;
use glam::DVec3;
use std::f64::consts::PI;

/// The definition itself, `integral f_spec cos`, on a fine grid of directions: an integral in another variable.
#[test]
fn agrees_with_the_integral_over_outgoing_directions() {
    let (ior, n) = (1.5, 400);
    for (mu, alpha) in [(1.0, 0.5), (0.5, 0.5), (0.1, 0.5), (0.3, 1.0), (0.8, 0.2)] {
        let v = DVec3::new((1.0f64 - mu * mu).sqrt(), 0.0, mu);
        let mut sum = 0.0;
        for a in 0..n {
            for b in 0..n {
                let z = (b as f64 + 0.5) / n as f64;
                let phi = PI * (a as f64 + 0.5) / n as f64;
                let sin = (1.0 - z * z).sqrt();
                let l = DVec3::new(sin * phi.cos(), sin * phi.sin(), z);
                let h = (v + l).normalize();
                sum += ggx_d(h, alpha) * smith_g2(v.z, z, alpha) * fresnel_dielectric(ior, v.dot(h))
                    / (4.0 * mu);
            }
        }
        let direct = sum * 2.0 * PI / (n * n) as f64;
        let e = directional_albedo(ior, mu, alpha);
        assert!((direct - e).abs() < 2e-4, "mu {mu} alpha {alpha}: {direct} {e}");
    }
}

/// By chance, without rings and their ends: facets that are seen, drawn and looked at one by one. Narrow lobes at grazing angles too.
#[test]
fn agrees_with_facets_drawn_by_chance() {
    for (k, (mu, alpha)) in
        [(0.05, 0.01), (0.0375, 0.0094), (0.01, 0.03), (0.2, 0.01), (0.05, 0.25), (0.3, 1.0), (1.0, 0.3)]
            .into_iter()
            .enumerate()
    {
        let mut draws = Sampler::new(11, k as u64);
        let v = DVec3::new((1.0f64 - mu * mu).sqrt(), 0.0, mu);
        let (mut sum, mut squares, n) = (0.0, 0.0, 200_000);
        for _ in 0..n {
            let Some(h) = sample_visible_normal(v, alpha, draws.uniform2()) else { continue };
            let vh = v.dot(h).clamp(0.0, 1.0);
            let l_z = 2.0 * vh * h.z - mu;
            if l_z > 0.0 {
                let x = fresnel_dielectric(1.5, vh) * smith_g2_over_g1(mu, l_z, alpha);
                (sum, squares) = (sum + x, squares + x * x);
            }
        }
        let mean = sum / n as f64;
        let sigma = ((squares / n as f64 - mean * mean) / n as f64).sqrt();
        let e = directional_albedo(1.5, mu, alpha);
        assert!((e - mean).abs() < 4.5 * sigma + 1e-5, "mu {mu} alpha {alpha}: {e}, not {mean} +- {sigma}");
    }
}
