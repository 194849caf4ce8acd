//! A material at a point into scattering: value, density and sampling, as defined in `docs/RENDERING.md`, "Materials".

use super::lobes::*;
use super::microfacet::*;
use super::surface::{PointMaterial, SurfacePoint};
use dpm_scene::albedo_table::AlbedoTable;
use dpm_scene::lobes::Coat;
use glam::{DMat3, DVec2, DVec3};
use std::f64::consts::PI;

/// GGX widths below this are mirrors: delta lobes.
pub(crate) const DELTA_BELOW_ALPHA: f64 = 1e-3;

/// Smallest cosine between the shading normal and the viewing direction; below, the normal is bent.
pub(crate) const LEAST_COS: f64 = 1e-3;

/// Scattering at a point seen from one direction.
pub(crate) struct Bsdf<'t> {
    look: PointMaterial,
    table: &'t AlbedoTable,
    /// Columns tangent, bitangent, shading normal; the normal is on the side of the viewer.
    world_from_local: DMat3,
    geometric: DVec3,
    v: DVec3,
    /// Index behind the surface over the index on the viewer's side.
    eta: f64,
    /// The viewer is inside a solid.
    inside: bool,
    /// What the dielectric reflects of light from `v`.
    coat: f64,
    /// The clear coat: its frame, and `v` in it. `None` where there is none.
    layer: Option<(DMat3, DVec3)>,
    /// Probabilities of the lobes.
    choose: Choices,
}

/// Probabilities with which each lobe is sampled; their sum is 1, or 0 where all light is absorbed.
#[derive(Clone, Copy, Debug, Default)]
struct Choices {
    facet: f64,
    diffuse: f64,
    straight: f64,
    layer: f64,
    sheen: f64,
    shine: f64,
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
        let v_world = v;
        let n = bend(point.shading * side, geometric, v);
        let brushed = look.lobes.brushed.map(|_| point.tangent - n * n.dot(point.tangent));
        let tangent = brushed.and_then(|t| t.try_normalize()).unwrap_or_else(|| n.any_orthonormal_vector());
        let world_from_local = DMat3::from_cols(tangent, n.cross(tangent), n);
        let mut v = world_from_local.transpose() * v;
        v.z = v.z.max(LEAST_COS);
        let v = v.normalize();

        let inside = !front && !look.thin && look.transmission > 0.0;
        let eta = if inside { 1.0 / look.ior } else { look.ior };
        let lobes = &look.lobes;
        let layer = (lobes.coat > 0.0 && !inside).then(|| {
            let n = bend(point.coat * side, geometric, v_world);
            let tangent = n.any_orthonormal_vector();
            let frame = DMat3::from_cols(tangent, n.cross(tangent), n);
            (frame, frame.transpose() * v_world)
        });
        let mut this = Self {
            look,
            table,
            world_from_local,
            geometric,
            v,
            eta,
            inside,
            coat: 0.0,
            layer,
            choose: Choices::default(),
        };
        this.coat = this.dielectric_albedo(v);
        this.choose = this.choices(this.under_layer(v_world));
        Some(this)
    }

    /// The shares by which lobes are chosen: about the light that each returns under even lighting. `under_layer` is left of it
    /// under the coat.
    fn choices(&self, under_layer: f64) -> Choices {
        let (look, lobes, inside, v) = (self.look, &self.look.lobes, self.inside, self.v);
        let (m, t, b) = (look.metallic, look.transmission, look.base.max_element());
        let reflected = if inside { self.facet(v.z).2 } else { self.coat };
        let passed = (1.0 - m) * t * (1.0 - reflected) * b;
        let mut facet = m * fresnel_schlick(look.base, v.z).max_element() + (1.0 - m) * reflected;
        if !look.thin {
            facet += passed;
        }
        if look.ior > 1.0 || m > 0.0 {
            facet = facet.max(1e-3);
        }
        let spread = if inside { 0.0 } else { (1.0 - m) * (1.0 - t) * (1.0 - self.coat) };
        let (layer, sheen) = (1.0 - under_layer, lobes.sheen_albedo(v.z));
        let sheen = if inside { 0.0 } else { sheen };
        let under = (1.0 - layer) * (1.0 - sheen);
        let weights = Choices {
            facet: facet * under,
            diffuse: spread * b * (1.0 - lobes.shine) * under,
            straight: if look.thin { passed * under } else { 0.0 },
            layer,
            sheen: (1.0 - layer) * sheen,
            shine: spread * lobes.shine * lobes.shine_color.max_element() * under,
        };
        let w = &weights;
        let sum = w.facet + w.diffuse + w.straight + w.layer + w.sheen + w.shine;
        let share = |x: f64| if sum > 0.0 { x / sum } else { 0.0 };
        Choices {
            facet: share(w.facet),
            diffuse: share(w.diffuse),
            straight: share(w.straight),
            layer: share(w.layer),
            sheen: share(w.sheen),
            shine: share(w.shine),
        }
    }

    fn mirror_is_delta(&self) -> bool {
        self.look.lobes.brushed.is_none() && self.look.alpha < DELTA_BELOW_ALPHA
    }

    fn layer_is_delta(&self) -> bool {
        self.look.lobes.coat_alpha < DELTA_BELOW_ALPHA
    }

    /// Widths along the local axes.
    fn widths(&self) -> DVec2 {
        self.look.lobes.brushed.unwrap_or(DVec2::splat(self.look.alpha))
    }

    /// Smith's Lambda of a local direction.
    fn lambda(&self, w: DVec3) -> f64 {
        smith_lambda(w.z.abs(), width_along(w, self.widths()))
    }

    /// Width at which the dielectric's albedo is looked up for a local direction.
    fn table_width(&self, w: DVec3) -> f64 {
        match self.look.lobes.brushed {
            Some(widths) => width_along(w, widths),
            None => table_row(self.look.alpha),
        }
    }

    fn is_tinted(&self) -> bool {
        self.look.lobes.specular != 1.0 || self.look.lobes.specular_color != DVec3::ONE
    }

    /// Base reflectance at normal incidence, on which a film lies.
    fn f0(&self) -> DVec3 {
        f0_of(self.look.ior, &self.look.lobes).lerp(self.look.base, self.look.metallic)
    }

    /// Reflectance of a microfacet (metal and dielectric), what passes it into the solid, and what the dielectric reflects in its
    /// strongest channel, for |v.h|.
    fn facet(&self, vh: f64) -> (DVec3, DVec3, f64) {
        let (m, lobes) = (self.look.metallic, &self.look.lobes);
        let f = tinted_fresnel(self.look.ior, self.eta, vh, lobes);
        let total = fresnel_dielectric(self.eta, vh) >= 1.0;
        let change = if lobes.film == 0.0 || total {
            DVec3::ZERO
        } else {
            // From within, as at the refracted direction outside.
            let outside2 = 1.0 - (1.0 - vh * vh) / (self.eta * self.eta);
            film_change(self.f0(), if self.inside { outside2.max(0.0).sqrt() } else { vh }, lobes)
        };
        let kept = (f + change).max_element().clamp(0.0, 1.0);
        let reflected =
            (fresnel_schlick(self.look.base, vh) * m + f * (1.0 - m) + change).clamp(DVec3::ZERO, DVec3::ONE);
        let passed = if self.look.thin {
            DVec3::ZERO
        } else {
            self.look.base * ((1.0 - m) * self.look.transmission * (1.0 - kept))
        };
        (reflected, passed, kept)
    }

    /// The linear combination of two albedos, of a plain dielectric and of facets that reflect everything, that a strength and a
    /// colour of its own make of them.
    fn tinted(&self, plain: f64, all: f64) -> f64 {
        let f0 = ((self.look.ior - 1.0) / (self.look.ior + 1.0)).powi(2);
        let top = (f0 * self.look.lobes.specular_color.max_element()).min(1.0);
        self.look.lobes.specular * (top * all + (1.0 - top) * (plain - f0 * all).max(0.0) / (1.0 - f0))
    }

    /// What the dielectric reflects of light along a local direction.
    fn dielectric_albedo(&self, w: DVec3) -> f64 {
        let (mu, width) = (w.z.abs(), self.table_width(w));
        let (mut e, lobes) = (self.table.directional(mu, width), &self.look.lobes);
        if self.is_tinted() {
            e = self.tinted(e, WHITE.directional(mu, width));
        }
        if lobes.film > 0.0 {
            let change = film_change_of(self.f0(), mu, width, lobes);
            e = (e + WHITE.directional(mu, width) * change).clamp(0.0, 1.0);
        }
        e
    }

    /// The share of light that enters and leaves the base by two directions, of which `l` is the other.
    fn base_entry(&self, l: DVec3) -> f64 {
        let (a, b) = (1.0 - self.coat, 1.0 - self.dielectric_albedo(l));
        let at = |width: f64| {
            let mut e = self.table.average(width);
            if self.is_tinted() {
                e = self.tinted(e, WHITE.average(width));
            }
            if self.look.lobes.film > 0.0 {
                // What the film changes of it, by three nodes.
                let node = |mu: f64, weight: f64| {
                    let change = film_change_of(self.f0(), mu, width, &self.look.lobes);
                    2.0 * mu * weight * WHITE.directional(mu, width) * change
                };
                let (side, middle) = (5.0 / 18.0, 8.0 / 18.0);
                e += node(0.112_701_67, side) + node(0.5, middle) + node(0.887_298_33, side);
            }
            e.clamp(0.0, 1.0)
        };
        let average = match self.look.lobes.brushed {
            Some(w) => 0.25 * (at(w.x) + at(w.y)) + 0.5 * at((0.5 * w.length_squared()).sqrt()),
            None => at(table_row(self.look.alpha)),
        };
        a * b / (1.0 - average).max(1e-12)
    }

    /// What the clear coat lets through along a direction.
    fn under_layer(&self, world: DVec3) -> f64 {
        self.layer.map_or(1.0, |(frame, _)| 1.0 - self.look.lobes.coat_albedo(frame.z_axis.dot(world).abs()))
    }

    /// What the clear coat lets through of light between `v` and a direction that the base sends only there.
    fn through_layer(&self, world: DVec3) -> f64 {
        self.under_layer(self.world_from_local * self.v).min(self.under_layer(world))
    }

    /// What the sheen lets through of light between `v` and a local direction.
    fn through_sheen(&self, l: DVec3) -> f64 {
        if self.inside {
            return 1.0;
        }
        let lobes = &self.look.lobes;
        1.0 - lobes.sheen_albedo(self.v.z).max(lobes.sheen_albedo(l.z.abs()))
    }

    /// What both let through of light that the base spreads over all directions: as much leaves the coat as enters it.
    fn through_spread(&self, l: DVec3, world: DVec3) -> f64 {
        let both = self.under_layer(self.world_from_local * self.v) * self.under_layer(world);
        let coat = if self.layer.is_some() { both / (1.0 - self.look.lobes.coat_average()) } else { 1.0 };
        coat * self.through_sheen(l)
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
    pub(crate) fn evaluate(&self, world: DVec3) -> BsdfValue {
        let l = self.world_from_local.transpose() * world;
        let above = self.geometric.dot(world);
        let mut value = BsdfValue::default();
        let v = self.v;
        if l.z > 0.0 && above > 0.0 {
            self.add_diffuse(&mut value, l, world);
            if !self.mirror_is_delta() {
                if let Some(h) = (v + l).try_normalize() {
                    let vh = v.dot(h).clamp(0.0, 1.0);
                    let (reflected, passed, _) = self.facet(vh);
                    let density = brushed_d(h, self.widths()) / (4.0 * v.z);
                    let through = self.through_layer(world) * self.through_sheen(l);
                    let (lambda_v, lambda_l) = (self.lambda(v), self.lambda(l));
                    value.f_cos += reflected * (through * density / (1.0 + lambda_v + lambda_l));
                    value.pdf += self.choose.facet * Self::choose_reflection(reflected, passed) * density
                        / (1.0 + lambda_v);
                }
            }
        } else if l.z < 0.0 && above < 0.0 && !self.mirror_is_delta() && !self.look.thin {
            self.add_refraction(&mut value, l);
        }
        if l.z < 0.0 && above < 0.0 && !self.inside {
            let (m, t, lobes) = (self.look.metallic, self.look.transmission, &self.look.lobes);
            let kept = self.base_entry(l) * self.through_spread(l, world) * -l.z / PI;
            value.f_cos += lobes.shine_color * ((1.0 - m) * (1.0 - t) * lobes.shine * kept);
            value.pdf += self.choose.shine * -l.z / PI;
        }
        if let Some((frame, v)) = self.layer.filter(|_| above > 0.0 && !self.layer_is_delta()) {
            let (l, alpha) = (frame.transpose() * world, self.look.lobes.coat_alpha);
            if let Some(h) = (v + l).try_normalize().filter(|_| l.z > 0.0) {
                let f = fresnel_dielectric(f64::from(Coat::IOR), v.dot(h).clamp(0.0, 1.0));
                let density = ggx_d(h, alpha) / (4.0 * v.z);
                let g2 = smith_g2(v.z, l.z, alpha);
                value.f_cos += DVec3::splat(self.look.lobes.coat * f * density * g2);
                value.pdf += self.choose.layer * density * smith_g1(v.z, alpha);
            }
        }
        if value.pdf.is_finite() && value.f_cos.is_finite() {
            value
        } else {
            BsdfValue::default()
        }
    }

    fn add_diffuse(&self, value: &mut BsdfValue, l: DVec3, world: DVec3) {
        let (m, t, lobes) = (self.look.metallic, self.look.transmission, &self.look.lobes);
        if !self.inside && m < 1.0 && t < 1.0 {
            let kept = self.base_entry(l) * self.through_spread(l, world) * (1.0 - lobes.shine);
            value.f_cos += self.look.base * ((1.0 - m) * (1.0 - t) * kept * l.z / PI);
            value.pdf += self.choose.diffuse * l.z / PI;
        }
        if !self.inside && lobes.sheen != DVec3::ZERO {
            value.f_cos += lobes.sheen * (sheen(self.v, l, lobes.sheen_alpha) * self.through_layer(world));
            value.pdf += self.choose.sheen / (2.0 * PI);
        }
    }

    fn add_refraction(&self, value: &mut BsdfValue, l: DVec3) {
        let v = self.v;
        let h = v + l * self.eta;
        let Some(h) = (if h.z < 0.0 { -h } else { h }).try_normalize() else { return };
        let (vh, lh) = (v.dot(h), l.dot(h));
        if vh > 0.0 && lh < 0.0 {
            let (reflected, passed, _) = self.facet(vh.min(1.0));
            let spread = vh + self.eta * lh;
            let density = brushed_d(h, self.widths()) * vh * -lh / (v.z * spread * spread);
            let through = self.under_layer(self.world_from_local * v) * self.through_sheen(v);
            let (lambda_v, lambda_l) = (self.lambda(v), self.lambda(l));
            value.f_cos += passed * (through * density / (1.0 + lambda_v + lambda_l));
            value.pdf += self.choose.facet
                * (1.0 - Self::choose_reflection(reflected, passed))
                * density
                * self.eta
                * self.eta
                / (1.0 + lambda_v);
        }
    }

    /// Draws a direction. `None`: the light is absorbed.
    pub(crate) fn sample(&self, choose: f64, u: [f64; 2], facet: f64) -> Option<BsdfSample> {
        let (mut at, c) = (choose, &self.choose);
        let mut falls_into = |share: f64| {
            let here = at < share;
            at -= share;
            here
        };
        let cosine = |sign: f64| {
            let (r, phi) = (u[0].sqrt(), 2.0 * PI * u[1]);
            DVec3::new(r * phi.cos(), r * phi.sin(), sign * (1.0 - u[0]).sqrt())
        };
        let v_world = self.world_from_local * self.v;
        let local = if falls_into(c.straight) {
            let (m, t) = (self.look.metallic, self.look.transmission);
            let through = self.under_layer(v_world) * self.through_sheen(self.v);
            let weight = self.look.base * ((1.0 - m) * t * (1.0 - self.coat) * through / c.straight);
            return Some(BsdfSample { l: -v_world, weight, pdf: None });
        } else if falls_into(c.diffuse) {
            cosine(1.0)
        } else if falls_into(c.shine) {
            cosine(-1.0)
        } else if falls_into(c.sheen) {
            let (r, phi) = ((u[0] * (2.0 - u[0])).sqrt(), 2.0 * PI * u[1]);
            DVec3::new(r * phi.cos(), r * phi.sin(), 1.0 - u[0])
        } else if falls_into(c.layer) {
            return self.sample_layer(u);
        } else if c.facet > 0.0 {
            return self.sample_facet(u, facet);
        } else {
            return None;
        };
        self.weighed(self.world_from_local * local)
    }

    fn weighed(&self, world: DVec3) -> Option<BsdfSample> {
        let value = self.evaluate(world);
        (value.pdf > 0.0).then(|| BsdfSample {
            l: world,
            weight: value.f_cos / value.pdf,
            pdf: Some(value.pdf),
        })
    }

    fn sample_layer(&self, u: [f64; 2]) -> Option<BsdfSample> {
        let (frame, v) = self.layer?;
        let delta = self.layer_is_delta();
        let h = if delta { DVec3::Z } else { sample_visible_normal(v, self.look.lobes.coat_alpha, u)? };
        let l = h * (2.0 * v.dot(h)) - v;
        let world = frame * l;
        if !delta {
            // Below the coat's own normal nothing is reflected.
            return if l.z > 0.0 { self.weighed(world) } else { None };
        }
        let f = fresnel_dielectric(f64::from(Coat::IOR), v.z);
        let weight = DVec3::splat(self.look.lobes.coat * f / self.choose.layer);
        (self.geometric.dot(world) > 0.0).then_some(BsdfSample { l: world, weight, pdf: None })
    }

    fn sample_facet(&self, u: [f64; 2], facet: f64) -> Option<BsdfSample> {
        let delta = self.mirror_is_delta();
        let h = if delta { DVec3::Z } else { sample_brushed_normal(self.v, self.widths(), u)? };
        let vh = self.v.dot(h).clamp(0.0, 1.0);
        let (reflected, passed, _) = self.facet(vh);
        let q = Self::choose_reflection(reflected, passed);
        let reflects = facet < q;
        let l = if reflects { h * (2.0 * vh) - self.v } else { refract(self.v, h, self.eta)? };
        let world = self.world_from_local * l;
        if !delta {
            return if (l.z > 0.0) == reflects { self.weighed(world) } else { None };
        }
        if (self.geometric.dot(world) > 0.0) != reflects {
            return None;
        }
        let through = if reflects {
            self.through_layer(world) * self.through_sheen(l)
        } else {
            self.under_layer(self.world_from_local * self.v) * self.through_sheen(self.v)
        };
        let weight = if reflects {
            reflected / (q * self.choose.facet)
        } else {
            passed / ((1.0 - q) * self.choose.facet * self.eta * self.eta)
        };
        Some(BsdfSample { l: world, weight: weight * through, pdf: None })
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
