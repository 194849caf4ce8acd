//! Fresnel reflectance and the GGX microfacet distribution in f64, in the local frame where the shading normal is +Z.
//!
//! `alpha` is the GGX width (perceptual roughness squared). Sources: \[Walter07\] (distribution, refraction), \[Heitz14\]
//! (height-correlated shadowing), \[Heitz18\] and \[Dupuy23\] (sampling of visible normals by a spherical cap).

use glam::{DVec2, DVec3};
use std::f64::consts::PI;

/// Unpolarised reflectance of a dielectric interface. `eta`: index behind the surface over the index in front, above 0.
/// `cos`: between the incident direction and the normal, 0..1. 1 under total reflection, exactly 0 for `eta` 1.
///
/// \[Walter07\] eq. 22, with `g - c` written as `(eta^2 - 1) / (g + c)`: the difference cancels when `eta` is near 1.
pub(crate) fn fresnel_dielectric(eta: f64, cos: f64) -> f64 {
    let c = cos.clamp(0.0, 1.0);
    let contrast = (eta - 1.0) * (eta + 1.0);
    if contrast == 0.0 {
        return 0.0;
    }
    let g2 = contrast + c * c;
    if g2 <= 0.0 {
        return 1.0;
    }
    let g = g2.sqrt();
    let a = contrast / ((g + c) * (g + c));
    let b = (c * (g + c) - 1.0) / (c * contrast / (g + c) + 1.0);
    (0.5 * a * a * (1.0 + b * b)).min(1.0)
}

/// Schlick's approximation per channel: `f0 + (1 - f0)(1 - cos)^5`.
pub(crate) fn fresnel_schlick(f0: DVec3, cos: f64) -> DVec3 {
    let m = (1.0 - cos).clamp(0.0, 1.0);
    f0 + (DVec3::ONE - f0) * (m * m * m * m * m)
}

/// Direction behind the interface for a direction `v` in front of it (both pointing away from it), `h` the normal on the side of
/// `v`, `eta` as in [`fresnel_dielectric`]. `None` under total reflection.
pub(crate) fn refract(v: DVec3, h: DVec3, eta: f64) -> Option<DVec3> {
    let c = v.dot(h);
    let cos2 = 1.0 - (1.0 - c * c).max(0.0) / (eta * eta);
    (cos2 > 0.0).then(|| ((c / eta - cos2.sqrt()) * h - v / eta).normalize())
}

/// Density of microfacet normals, per steradian: `alpha^2 / (pi ((h.z^2)(alpha^2 - 1) + 1)^2)`, 0 below the surface.
pub(crate) fn ggx_d(h: DVec3, alpha: f64) -> f64 {
    if h.z <= 0.0 {
        return 0.0;
    }
    // (1 - h.z^2) from x and y: exact where the peak is narrow.
    let sin2 = h.x * h.x + h.y * h.y;
    let t = sin2 / (alpha * alpha) + h.z * h.z;
    1.0 / (PI * alpha * alpha * t * t)
}

/// Smith's auxiliary function for a direction of the given |cosine| to the normal; infinite at grazing.
pub(crate) fn smith_lambda(cos: f64, alpha: f64) -> f64 {
    let c2 = cos * cos;
    let tan2 = (1.0 - c2).max(0.0) / c2;
    // sqrt(1 + x) - 1 without cancellation for small x.
    let x = alpha * alpha * tan2;
    if x.is_infinite() {
        f64::INFINITY
    } else {
        0.5 * x / ((1.0 + x).sqrt() + 1.0)
    }
}

/// Share of microfacets visible from a direction.
pub(crate) fn smith_g1(cos: f64, alpha: f64) -> f64 {
    1.0 / (1.0 + smith_lambda(cos.abs(), alpha))
}

/// Height-correlated shadowing and masking `1 / (1 + L(v) + L(l))`; for refraction with the |cosine| of both, as for reflection.
pub(crate) fn smith_g2(cos_v: f64, cos_l: f64, alpha: f64) -> f64 {
    1.0 / (1.0 + smith_lambda(cos_v.abs(), alpha) + smith_lambda(cos_l.abs(), alpha))
}

/// `G2 / G1(v)`: the weight of a direction drawn through a visible normal. Finite at grazing `v`.
#[cfg(test)]
pub(crate) fn smith_g2_over_g1(cos_v: f64, cos_l: f64, alpha: f64) -> f64 {
    let lambda_v = smith_lambda(cos_v.abs(), alpha);
    let lambda_l = smith_lambda(cos_l.abs(), alpha);
    if lambda_v.is_infinite() {
        return if lambda_l.is_infinite() { 0.0 } else { 1.0 };
    }
    (1.0 + lambda_v) / (1.0 + lambda_v + lambda_l)
}

/// Density of normals visible from `v` (`v.z > 0`), per steradian.
#[cfg(test)]
pub(crate) fn visible_normal_pdf(v: DVec3, h: DVec3, alpha: f64) -> f64 {
    if h.z <= 0.0 || v.z <= 0.0 {
        return 0.0;
    }
    smith_g1(v.z, alpha) * ggx_d(h, alpha) * v.dot(h).max(0.0) / v.z
}

/// Draws a normal visible from `v`. `None` for the one cap point at which the half vector vanishes.
pub(crate) fn sample_visible_normal(v: DVec3, alpha: f64, u: [f64; 2]) -> Option<DVec3> {
    let v_std = DVec3::new(v.x * alpha, v.y * alpha, v.z).normalize();
    let phi = 2.0 * PI * u[0];
    let z = (1.0 - u[1]) * (1.0 + v_std.z) - v_std.z;
    let sin = (1.0 - z * z).max(0.0).sqrt();
    let h = DVec3::new(sin * phi.cos(), sin * phi.sin(), z) + v_std;
    DVec3::new(h.x * alpha, h.y * alpha, h.z.max(0.0)).try_normalize()
}

/// The same density where the surface is `alpha.x` rough along x and `alpha.y` along y.
pub(crate) fn brushed_d(h: DVec3, alpha: DVec2) -> f64 {
    if h.z <= 0.0 {
        return 0.0;
    }
    let t = (h.x / alpha.x).powi(2) + (h.y / alpha.y).powi(2) + h.z * h.z;
    1.0 / (PI * alpha.x * alpha.y * t * t)
}

/// The width of a brushed surface along the azimuth of a direction.
pub(crate) fn width_along(w: DVec3, alpha: DVec2) -> f64 {
    let across = w.truncate();
    match across.try_normalize() {
        Some(d) => (d * alpha).length(),
        None => (0.5 * alpha.length_squared()).sqrt(),
    }
}

/// As [`sample_visible_normal`], for a brushed surface.
pub(crate) fn sample_brushed_normal(v: DVec3, alpha: DVec2, u: [f64; 2]) -> Option<DVec3> {
    let stretched = DVec3::new(v.x * alpha.x, v.y * alpha.y, v.z);
    let h = sample_visible_normal(stretched.normalize(), 1.0, u)?;
    DVec3::new(h.x * alpha.x, h.y * alpha.y, h.z).try_normalize()
}
