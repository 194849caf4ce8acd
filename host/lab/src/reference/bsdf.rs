//! A material at a point into scattering: value, density and sampling, as defined in `docs/RENDERING.md`, "Materials".

use super::microfacet::*;
use super::surface::{Look, SurfacePoint};
use dpm_scene::albedo_table::AlbedoTable;
use glam::{DMat3, DVec3};
use std::f64::consts::PI;

/// GGX widths below this are mirrors: delta lobes.
pub(crate) const DELTA_BELOW_ALPHA: f64 = 1e-3;

/// Smallest cosine between the shading normal and the viewing direction; below, the normal is bent.
pub(crate) const LEAST_COS: f64 = 1e-3;

/// Scattering at a point seen from one direction.
pub(crate) struct Bsdf<'t> {
    look: Look,
    table: &'t AlbedoTable,
    /// Columns tangent, bitangent, shading normal; the normal is on the side of the viewer.
    world_from_local: DMat3,
    geometric: DVec3,
    v: DVec3,
    /// Index behind the surface over the index on the viewer's side.
    eta: f64,
    /// The viewer is inside a solid.
    inside: bool,
    coat: f64,
    choose_mirror: f64,
    choose_diffuse: f64,
    choose_straight: f64,
}

/// A sampled direction.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BsdfSample {
    /// Unit, world, away from the surface.
    pub l: DVec3,
    /// `f |cos| / pdf`.
    pub weight: DVec3,
    /// Per steradian; `None` for a delta lobe.
    pub pdf: Option<f64>,
}

/// Value and density of the lobes that are not deltas.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct BsdfValue {
    /// `f |n.l|`, 1/sr.
    pub f_cos: DVec3,
    /// Density of [`Bsdf::sample`] per steradian.
    pub pdf: f64,
}

impl<'t> Bsdf<'t> {
    /// Scattering toward `v` (unit, away from the surface). `None` where the surface is black: the back of a single-sided one.
    pub(crate) fn new(point: &SurfacePoint, table: &'t AlbedoTable, v: DVec3) -> Option<Self> {
        let look = point.look;
        let front = point.geometric.dot(v) > 0.0;
        if !front && !look.two_sided {
            return None;
        }
        let side = if front { 1.0 } else { -1.0 };
        let geometric = point.geometric * side;
        let n = bend(point.shading * side, geometric, v);
        let tangent = n.any_orthonormal_vector();
        let world_from_local = DMat3::from_cols(tangent, n.cross(tangent), n);
        let mut v = world_from_local.transpose() * v;
        v.z = v.z.max(LEAST_COS);
        let v = v.normalize();

        let inside = !front && !look.thin && look.transmission > 0.0;
        let eta = if inside { 1.0 / look.ior } else { look.ior };
        let coat = table.directional(v.z, coat_alpha(&look));
        // Lobes are chosen by about the light each returns under even lighting.
        let (m, t, b) = (look.metallic, look.transmission, look.base.max_element());
        let reflected = if inside { fresnel_dielectric(eta, v.z) } else { coat };
        let passed = (1.0 - m) * t * (1.0 - reflected) * b;
        let mut mirror = m * fresnel_schlick(look.base, v.z).max_element() + (1.0 - m) * reflected;
        if !look.thin {
            mirror += passed;
        }
        if look.ior > 1.0 || m > 0.0 {
            mirror = mirror.max(1e-3);
        }
        let diffuse = if inside { 0.0 } else { (1.0 - m) * (1.0 - t) * (1.0 - coat) * b };
        let straight = if look.thin { passed } else { 0.0 };
        let sum = mirror + diffuse + straight;
        let share = |x: f64| if sum > 0.0 { x / sum } else { 0.0 };
        Some(Self {
            look,
            table,
            world_from_local,
            geometric,
            v,
            eta,
            inside,
            coat,
            choose_mirror: share(mirror),
            choose_diffuse: share(diffuse),
            choose_straight: share(straight),
        })
    }

    fn mirror_is_delta(&self) -> bool {
        self.look.alpha < DELTA_BELOW_ALPHA
    }

    /// Reflectance of a microfacet (metal and dielectric) and what passes it into the solid, for |v.h|.
    fn facet(&self, vh: f64) -> (DVec3, DVec3) {
        let f = fresnel_dielectric(self.eta, vh);
        let m = self.look.metallic;
        let reflected = fresnel_schlick(self.look.base, vh) * m + DVec3::splat((1.0 - m) * f);
        let passed = if self.look.thin {
            DVec3::ZERO
        } else {
            self.look.base * ((1.0 - m) * self.look.transmission * (1.0 - f))
        };
        (reflected, passed)
    }

    /// Probability that a facet reflects rather than passes.
    fn choose_reflection(reflected: DVec3, passed: DVec3) -> f64 {
        let (r, p) = (reflected.max_element(), passed.max_element());
        if r + p > 0.0 {
            r / (r + p)
        } else {
            1.0
        }
    }

    /// `f |n.l|` and the density of all lobes but the deltas. `l`: unit, world, away from the surface.
    pub(crate) fn evaluate(&self, l: DVec3) -> BsdfValue {
        let above = self.geometric.dot(l);
        self.evaluate_local(self.world_from_local.transpose() * l, above)
    }

    fn evaluate_local(&self, l: DVec3, above: f64) -> BsdfValue {
        let mut value = BsdfValue::default();
        let (v, alpha) = (self.v, self.look.alpha);
        if l.z > 0.0 && above > 0.0 {
            let (m, t) = (self.look.metallic, self.look.transmission);
            if !self.inside && m < 1.0 && t < 1.0 {
                let average = self.table.average(coat_alpha(&self.look));
                let kept = (1.0 - self.coat) * (1.0 - self.table.directional(l.z, coat_alpha(&self.look)))
                    / (1.0 - average).max(1e-12);
                value.f_cos += self.look.base * ((1.0 - m) * (1.0 - t) * kept * l.z / PI);
                value.pdf += self.choose_diffuse * l.z / PI;
            }
            if !self.mirror_is_delta() {
                if let Some(h) = (v + l).try_normalize() {
                    let vh = v.dot(h).clamp(0.0, 1.0);
                    let (reflected, passed) = self.facet(vh);
                    let density = ggx_d(h, alpha) / (4.0 * v.z);
                    value.f_cos += reflected * (density * smith_g2(v.z, l.z, alpha));
                    value.pdf += self.choose_mirror
                        * Self::choose_reflection(reflected, passed)
                        * density
                        * smith_g1(v.z, alpha);
                }
            }
        } else if l.z < 0.0 && above < 0.0 && !self.mirror_is_delta() && !self.look.thin {
            let h = v + l * self.eta;
            let Some(h) = (if h.z < 0.0 { -h } else { h }).try_normalize() else { return value };
            let (vh, lh) = (v.dot(h), l.dot(h));
            if vh > 0.0 && lh < 0.0 {
                let (reflected, passed) = self.facet(vh.min(1.0));
                let spread = vh + self.eta * lh;
                let density = ggx_d(h, alpha) * vh * -lh / (v.z * spread * spread);
                value.f_cos += passed * (density * smith_g2(v.z, l.z, alpha));
                value.pdf += self.choose_mirror
                    * (1.0 - Self::choose_reflection(reflected, passed))
                    * density
                    * self.eta
                    * self.eta
                    * smith_g1(v.z, alpha);
            }
        }
        if value.pdf.is_finite() && value.f_cos.is_finite() {
            value
        } else {
            BsdfValue::default()
        }
    }

    /// Draws a direction. `None`: the light is absorbed.
    pub(crate) fn sample(&self, choose: f64, u: [f64; 2], facet: f64) -> Option<BsdfSample> {
        if choose < self.choose_straight {
            let (m, t) = (self.look.metallic, self.look.transmission);
            let weight = self.look.base * ((1.0 - m) * t * (1.0 - self.coat) / self.choose_straight);
            return Some(BsdfSample { l: -(self.world_from_local * self.v), weight, pdf: None });
        }
        let l = if choose < self.choose_straight + self.choose_diffuse {
            let (r, phi) = (u[0].sqrt(), 2.0 * PI * u[1]);
            DVec3::new(r * phi.cos(), r * phi.sin(), (1.0 - u[0]).sqrt())
        } else if self.choose_mirror > 0.0 {
            let delta = self.mirror_is_delta();
            let h = if delta { DVec3::Z } else { sample_visible_normal(self.v, self.look.alpha, u)? };
            let vh = self.v.dot(h).clamp(0.0, 1.0);
            let (reflected, passed) = self.facet(vh);
            let q = Self::choose_reflection(reflected, passed);
            let reflects = facet < q;
            let l = if reflects { h * (2.0 * vh) - self.v } else { refract(self.v, h, self.eta)? };
            if delta {
                let world = self.world_from_local * l;
                if (self.geometric.dot(world) > 0.0) != reflects {
                    return None;
                }
                let weight = if reflects {
                    reflected / (q * self.choose_mirror)
                } else {
                    passed / ((1.0 - q) * self.choose_mirror * self.eta * self.eta)
                };
                return Some(BsdfSample { l: world, weight, pdf: None });
            }
            if (l.z > 0.0) != reflects {
                return None;
            }
            l
        } else {
            return None;
        };
        let world = self.world_from_local * l;
        let value = self.evaluate_local(l, self.geometric.dot(world));
        (value.pdf > 0.0).then(|| BsdfSample {
            l: world,
            weight: value.f_cos / value.pdf,
            pdf: Some(value.pdf),
        })
    }
}

/// Width at which the coat's albedo is looked up: a delta lobe reflects by Fresnel's law, which is row 0 of the table.
fn coat_alpha(look: &Look) -> f64 {
    if look.alpha < DELTA_BELOW_ALPHA {
        0.0
    } else {
        look.alpha
    }
}

/// The direction nearest to `n` with a cosine of at least [`LEAST_COS`] to `v`.
fn bend(n: DVec3, geometric: DVec3, v: DVec3) -> DVec3 {
    let cos = n.dot(v);
    if cos >= LEAST_COS {
        return n;
    }
    match (n - v * cos).try_normalize() {
        Some(across) => (across * (1.0 - LEAST_COS * LEAST_COS).sqrt() + v * LEAST_COS).normalize(),
        None => geometric,
    }
}
