//! A surface point and a viewing direction into radiance: the path tracer itself.
//!
//! Vertices x1..xD. Light is sampled at x1..x(D-1); emission met by scattering at x2..xD, and the sky on a miss, is weighed against it
//! by the balance heuristic.

use super::bsdf::Bsdf;
use super::bvh::Hit;
use super::light::Sky;
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

impl Reference<'_> {
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
        for vertex in 1..=depth {
            let facing = point.geometric.dot(v);
            if point.look.emission != DVec3::ZERO && (facing > 0.0 || point.look.emits_behind) {
                let weight = pdf.map_or(1.0, |pdf| {
                    let by_light =
                        self.lights.triangle_pdf(point.bvh_triangle) * point.distance * point.distance;
                    balance(pdf, by_light / facing.abs())
                });
                sum += throughput * point.look.emission * weight;
            }
            if vertex == depth {
                break;
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
            match self.trace(origin, next.l, f64::INFINITY, false) {
                Some(hit) => point = hit,
                None => {
                    let weight = pdf.map_or(1.0, |pdf| balance(pdf, self.lights.sky_pdf(next.l)));
                    sum += throughput * self.lights.sky_radiance(next.l) * weight;
                    break;
                }
            }
            v = -next.l;
        }
        sum
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
            let emits =
                (facing > 0.0 || light.look.emits_behind) && facing != 0.0 && self.exists(&hit, false);
            let value = if emits { bsdf.evaluate(l) } else { Default::default() };
            if value.f_cos != DVec3::ZERO && light.look.emission != DVec3::ZERO {
                let by_light = s.pdf_area * distance * distance / facing.abs();
                let (from, to) = (start(l), offset(light.position, light.geometric, -l, light.scale));
                let between = to - from;
                let length = between.length();
                if length == 0.0 || !self.occluded(from, between / length, length * JUST_BEFORE, false) {
                    // balance / by_light, without dividing by a density that may underflow
                    sum += value.f_cos * light.look.emission / (by_light + value.pdf);
                }
            }
        }

        self.lights.punctual(point.position, sampler.uniform(), |a| {
            let value = bsdf.evaluate(a.l);
            if value.f_cos != DVec3::ZERO
                && a.irradiance != DVec3::ZERO
                && !self.occluded(start(a.l), a.l, a.distance * JUST_BEFORE, false)
            {
                sum += value.f_cos * a.irradiance;
            }
        });

        if let Sky::Image(image) = &self.lights.sky {
            if let Some((l, by_light)) = image.sample(sampler.uniform2()) {
                let value = bsdf.evaluate(l);
                if value.f_cos != DVec3::ZERO
                    && by_light > 0.0
                    && !self.occluded(start(l), l, f64::INFINITY, false)
                {
                    sum += value.f_cos * image.radiance(l) / (by_light + value.pdf);
                }
            }
        }
        sum
    }
}
