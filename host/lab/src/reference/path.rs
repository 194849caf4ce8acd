//! A surface point and a viewing direction into radiance: the path tracer itself.
//!
//! Vertices x1..xD. Light is sampled at x1..x(D-1); emission met by scattering at x2..xD, and the sky on a miss, is weighed against it
//! by the balance heuristic.

use super::bsdf::Bsdf;
use super::bvh::Hit;
use super::light::Sky;
use super::lobes::left_by;
use super::{offset, Reference, Sampler, SurfacePoint};
use glam::DVec3;

/// Light is taken as coming from no farther than this share of the way: the light's own surface is not in its way.
const JUST_BEFORE: f64 = 1.0 - 1e-12;

fn balance(own: f64, other: f64) -> f64 {
    if own.is_infinite() {
        1.0
    } else if own > 0.0 {
        own / (own + other)
    } else {
        0.0
    }
}

/// What a ray from a point goes through: the solid that begins there, or nothing.
fn along(point: &SurfacePoint, direction: DVec3) -> DVec3 {
    if point.geometric.dot(direction) < 0.0 {
        point.look.lobes.absorption
    } else {
        DVec3::ZERO
    }
}

/// What a ray absorbed of each channel, per metre, that came through `medium` along `l` and met a surface: the back of a solid is met
/// from within it, wherever the ray comes from.
fn crossed(met: &SurfacePoint, l: DVec3, medium: DVec3) -> DVec3 {
    let of_solid = met.look.lobes.absorption;
    let behind = met.geometric.dot(l) > 0.0;
    let pick = |c: usize| if behind && of_solid[c] > 0.0 { of_solid[c] } else { medium[c] };
    DVec3::new(pick(0), pick(1), pick(2))
}

/// Leaves a path one channel, chosen by the light that it carries, with all of that light on average. `u`: even over 0 to 1. The channel, 0 to 2.
fn take_channel(throughput: &mut DVec3, u: f64) -> usize {
    let total = throughput.element_sum();
    let mut u = u * total;
    let chosen = (0..3).find(|&c| {
        let here = u < throughput[c];
        u -= throughput[c];
        here
    });
    let channel = chosen.unwrap_or(0);
    *throughput = DVec3::AXES[channel] * total;
    channel
}

impl Reference<'_> {
    /// What a ray meets that looks through the surface at `x1`, and the share of light that is left on the way; `None`: the sky.
    fn behind(&self, x1: &SurfacePoint, on: DVec3, sampler: &mut Sampler) -> Option<(SurfacePoint, DVec3)> {
        let key = self.ray_key(sampler);
        let origin = offset(x1.position, x1.geometric, on, x1.scale);
        let hit = self.bvh.closest(origin, on, f64::INFINITY, |hit| self.is_met(hit, key))?;
        let met = self.resolve(&hit);
        let left = if met.geometric.dot(on) > 0.0 {
            left_by(met.look.lobes.absorption, met.position.distance(x1.position))
        } else {
            DVec3::ONE
        };
        Some((met, left))
    }

    /// What the surface at `point` emits toward `v`, weighted against the sampling of lights. `pdf`: of the direction that led here.
    fn emitted(&self, point: &SurfacePoint, v: DVec3, pdf: Option<f64>) -> DVec3 {
        let facing = point.geometric.dot(v);
        if point.look.emission == DVec3::ZERO || (facing <= 0.0 && !point.look.emits_behind) {
            return DVec3::ZERO;
        }
        let weight = pdf.map_or(1.0, |pdf| {
            let by_light = self.lights.triangle_pdf(point.bvh_triangle) * point.distance * point.distance;
            balance(pdf, by_light / facing.abs())
        });
        point.look.emission * point.look.lobes.over_emission(facing) * weight
    }

    /// One sample of the radiance that leaves `x1` toward `toward_viewer` (unit), with at most `depth` closest hits counting `x1`.
    pub(crate) fn radiance(
        &self,
        x1: &SurfacePoint,
        toward_viewer: DVec3,
        depth: u32,
        sampler: &mut Sampler,
    ) -> DVec3 {
        let mut point = *x1;
        let mut v = toward_viewer;
        let mut throughput = DVec3::ONE;
        let mut sum = DVec3::ZERO;
        // Density of the direction that led here; None at x1 and behind a delta lobe, where light sampling has no part.
        let mut pdf: Option<f64> = None;
        if point.look.lobes.coverage < 1.0 && sampler.uniform() >= point.look.lobes.coverage {
            match self.behind(x1, -toward_viewer, sampler) {
                Some((met, left)) => (point, throughput) = (met, left),
                None => return self.lights.sky_radiance(-toward_viewer),
            }
        }
        for vertex in 1..=depth {
            sum += throughput * self.emitted(&point, v, pdf);
            if vertex == depth {
                break;
            }
            if point.look.lobes.dispersion > 0.0 && !point.look.thin {
                let channel = take_channel(&mut throughput, sampler.uniform());
                point.look.ior = point.look.lobes.index_of_channel(point.look.ior, channel);
            }
            let table = self.table(point.look.material);
            let Some(bsdf) = Bsdf::new(&point, table, v) else { break };
            sum += throughput * self.light_at(&point, &bsdf, sampler);

            let Some(next) = bsdf.sample(sampler.uniform(), sampler.uniform2(), sampler.uniform()) else {
                break;
            };
            throughput *= next.weight;
            if vertex >= 3 {
                let survive = throughput.max_element().min(0.95);
                if sampler.uniform() >= survive {
                    break;
                }
                throughput /= survive;
            }
            if throughput == DVec3::ZERO {
                break;
            }
            pdf = next.pdf;
            let origin = offset(point.position, point.geometric, next.l, point.scale);
            let medium = along(&point, next.l);
            let key = self.ray_key(sampler);
            match self.bvh.closest(origin, next.l, f64::INFINITY, |hit| self.is_met(hit, key)) {
                Some(hit) => {
                    let met = self.resolve(&hit);
                    throughput *=
                        left_by(crossed(&met, next.l, medium), met.position.distance(point.position));
                    point = met;
                }
                None => {
                    throughput *= left_by(medium, f64::INFINITY);
                    let weight = pdf.map_or(1.0, |pdf| balance(pdf, self.lights.sky_pdf(next.l)));
                    sum += throughput * self.lights.sky_radiance(next.l) * weight;
                    break;
                }
            }
            v = -next.l;
        }
        sum
    }

    fn is_blocked(&self, origin: DVec3, direction: DVec3, t_max: f64, key: u64) -> bool {
        self.bvh.any(origin, direction, t_max, |hit| self.is_met(hit, key))
    }

    /// Light sampled at a vertex, scattered toward the viewer.
    fn light_at(&self, point: &SurfacePoint, bsdf: &Bsdf, sampler: &mut Sampler) -> DVec3 {
        let mut sum = DVec3::ZERO;
        let start = |l: DVec3| offset(point.position, point.geometric, l, point.scale);

        let (choose, u) = (sampler.uniform(), sampler.uniform2());
        if let Some(s) = self.lights.sample_triangle(choose, u) {
            let hit = Hit { t: 0.0, weights: s.weights, triangle: s.triangle };
            let light = self.resolve(&hit);
            let way = light.position - point.position;
            let (distance, l) = (way.length(), way.normalize_or_zero());
            let facing = -light.geometric.dot(l);
            let key = self.ray_key(sampler);
            let emits = (facing > 0.0 || light.look.emits_behind) && facing != 0.0 && self.is_met(&hit, key);
            let value = if emits { bsdf.evaluate(l) } else { Default::default() };
            if value.f_cos != DVec3::ZERO && light.look.emission != DVec3::ZERO {
                let by_light = s.pdf_area * distance * distance / facing.abs();
                let (from, to) = (start(l), offset(light.position, light.geometric, -l, light.scale));
                let between = to - from;
                let length = between.length();
                if length == 0.0 || !self.is_blocked(from, between / length, length * JUST_BEFORE, key) {
                    let emission = light.look.emission * light.look.lobes.over_emission(facing);
                    // balance / by_light, without dividing by a density that may underflow
                    sum +=
                        value.f_cos * emission * left_by(along(point, l), distance) / (by_light + value.pdf);
                }
            }
        }

        let key = self.ray_key(sampler);
        self.lights.punctual(point.position, sampler.uniform(), |a| {
            let value = bsdf.evaluate(a.l);
            if value.f_cos != DVec3::ZERO
                && a.irradiance != DVec3::ZERO
                && !self.is_blocked(start(a.l), a.l, a.distance * JUST_BEFORE, key)
            {
                sum += value.f_cos * a.irradiance * left_by(along(point, a.l), a.distance);
            }
        });

        if let Sky::Image(image) = &self.lights.sky {
            if let Some((l, by_light)) = image.sample(sampler.uniform2()) {
                let value = bsdf.evaluate(l);
                if value.f_cos != DVec3::ZERO
                    && by_light > 0.0
                    && !self.is_blocked(start(l), l, f64::INFINITY, key)
                {
                    let left = left_by(along(point, l), f64::INFINITY);
                    sum += value.f_cos * image.radiance(l) * left / (by_light + value.pdf);
                }
            }
        }
        sum
    }
}
