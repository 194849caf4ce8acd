//! Hard cases of scattering: every lobe's energy, reciprocity and sampler, Fresnel's law, and what the reference shares with the GPU (the albedo
//! table, compensation).

use super::interval::Interval;
use super::CpuCase;
use crate::reference::bsdf::Bsdf;
use crate::reference::microfacet::fresnel_dielectric;
use crate::reference::{Reference, Sampler, SurfacePoint};
use crate::statistics::{test_directions, DirectionTest, Mean};
use crate::twins::compensation::Compensation;
use dpm_scene::albedo_table::AlbedoTable;
use dpm_scene::shapes::*;
use dpm_scene::Material;
use glam::{DVec3, Vec3};
use std::f64::consts::PI;

/// The cases.
pub(super) const CASES: &[CpuCase] = &[
        CpuCase("tracer-energy-of-every-lobe", "roughness 0, 1e-4, 1e-3, 0.5, 1; ior 1 to 2.4; metal, coat, thin, solid; from both sides, down to grazing 89.99 deg", "albedo at most 1", "excess", 1e-2, energy),
        CpuCase("tracer-single-scatter-loss", "white rough metal, alpha 0.25, 0.5, 1", "directional albedo 0.882, 0.700, 0.409 on average", "albedo", 3e-3, single_scatter),
        CpuCase("tracer-coated-diffuse-conserves", "white base under coats of ior 1 to 2.4", "closed form: albedo 1", "albedo", 5e-3, coated),
        CpuCase("tracer-reciprocity", "random pairs of directions, reflection and refraction", "f(a, b) = f(b, a), with the square of the index where refracted", "relative", 1e-7, reciprocity),
        CpuCase("tracer-samplers-chi-square", "all lobes, 150,000 samples each", "probability p that chance fits one of n lobes worse: 1e-4 / (n p)", "ratio", 1.0, chi_square),
        CpuCase("tracer-samples-carry-their-density", "all lobes, 20,000 samples each", "density and value of a sample are those of its direction", "relative", 1e-7, own_density),
        CpuCase("tracer-density-integrates-to-one", "all lobes", "integral of the density = share not absorbed", "share", 6e-3, density_integral),
        CpuCase("tracer-fresnel", "ior 0.2 to 2.4, 1, 1 + 1e-7, 1 + 1e-12, edge of total reflection", "Fresnel's equations", "reflectance", 1e-12, fresnel),
        CpuCase("tracer-grazing-and-zero-vectors", "directions at 90 deg, denormal cosines, u = 0 and 1 - 2^-53", "finite, not negative", "faults", 0.0, grazing),
        CpuCase("albedo-table-f32", "0..1 in both, ior 1.0001 to 3", "f64 look-up", "albedo", 2e-6, albedo_f32),
        CpuCase("compensation-extremes", "cos 0 and 1e-38, distance 0 and 1e18, radiance NaN, infinite, negative, denormal", "0..1, never NaN; NaN becomes black", "faults", 0.0, compensation_extremes),
        CpuCase("compensation-f32", "distance 1 mm to 50 m, cos 1 to 1e-3", "an interval that holds the exact result; six roundings of half a unit, each of which may count double where the last place of the result is finer", "ulp", 6.0, compensation_f32),
];

/// The point in the middle of a patch of the material.
fn patch(material: &Material) -> SurfacePoint {
    let s = scene_of(floor(1.0, 0.0), material.clone());
    let point = Reference::new(&s, &[]).trace(DVec3::new(0.1, 1.0, 0.2), -DVec3::Y, 9.0, false);
    point.expect("the patch lies below")
}

/// A white material of every kind.
fn look(roughness: f32, metallic: f32, transmission: f32, thin_walled: bool) -> Material {
    Material { roughness, metallic, transmission, thin_walled, ..Material::default() }
}

fn viewing(mu: f64) -> DVec3 {
    DVec3::new((1.0 - mu * mu).max(0.0).sqrt(), mu, 0.0)
}

/// Directional albedo of a patch seen at cosine `mu`, from behind where that is negative.
fn albedo_of(material: &Material, table: &AlbedoTable, mu: f64, n: u32, seed: u64) -> Mean {
    let point = patch(material);
    let mut mean = Mean::default();
    let Some(bsdf) = Bsdf::new(&point, table, viewing(mu)) else { return mean };
    let mut s = Sampler::new(seed, 0);
    for _ in 0..n {
        let sample = bsdf.sample(s.uniform(), s.uniform2(), s.uniform());
        mean.push(sample.map_or(0.0, |s| s.weight.max_element()));
    }
    mean
}

const LOOKS: [(f32, f32, bool); 6] = [
    (0.0, 0.0, true),
    (1.0, 0.0, true),
    (0.0, 1.0, true),
    (0.0, 1.0, false),
    (0.5, 0.5, false),
    (0.3, 0.5, true),
];

fn energy(seed: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for ior in [1.0, 1.0 + 1e-7, 1.0011, 1.5, 2.4] {
        let table = AlbedoTable::new(ior);
        for roughness in [0.0, 1e-4, 1e-3, 0.0317, 0.5, 1.0] {
            for (metallic, transmission, thin_walled) in LOOKS {
                let m = Material { ior, ..look(roughness, metallic, transmission, thin_walled) };
                for mu in [1.0, 0.3, 1.745e-4, -1.0, -0.3, -1.745e-4] {
                    // So many that a lobe which loses a hundredth of them does lose one: else its deviation would count as 0.
                    let a = albedo_of(&m, &table, mu, 2000, seed);
                    if a.mean() < 0.0 {
                        return f64::INFINITY;
                    }
                    // Radiance grows by the square of the index on the way into a solid from its outside; the power does not.
                    let into = !thin_walled && transmission > 0.0 && mu < 0.0;
                    let growth = if into { f64::from(ior * ior) } else { 1.0 };
                    worst = worst.max((a.mean() - 5.0 * a.standard_error()) / growth - 1.0);
                }
            }
        }
    }
    worst
}

fn single_scatter(seed: u64) -> f64 {
    let table = AlbedoTable::new(1.5);
    let mut worst: f64 = 0.0;
    for (alpha, expected) in [(0.25f32, 0.882), (0.5, 0.700), (1.0, 0.409)] {
        let m = Material { roughness: alpha.sqrt(), ..Material::default() };
        let n = 40;
        let sum: f64 = (0..n)
            .map(|i| {
                let mu = (f64::from(i) + 0.5) / f64::from(n);
                2.0 * mu * albedo_of(&m, &table, mu, 12_000, seed + i as u64).mean() / f64::from(n)
            })
            .sum();
        worst = worst.max((sum - expected).abs());
    }
    worst
}

fn coated(seed: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for ior in [1.0, 1.1, 1.5, 2.4] {
        let table = AlbedoTable::new(ior);
        for roughness in [0.0, 0.1, 0.5, 1.0] {
            let m = Material { ior, roughness, ..diffuse(Vec3::ONE) };
            for mu in [1.0, 0.6, 0.2, 0.05] {
                let a = albedo_of(&m, &table, mu, 6000, seed);
                worst = worst.max((a.mean() - 1.0).abs() - 5.0 * a.standard_error());
            }
        }
    }
    worst.max(0.0)
}

/// A direction not quite in the plane, on the side of `up`.
fn direction(u: [f64; 2], up: f64) -> DVec3 {
    let (y, phi) = (0.02 + 0.98 * u[0], 2.0 * PI * u[1]);
    let r = (1.0 - y * y).sqrt();
    DVec3::new(r * phi.cos(), y * up, r * phi.sin())
}

fn reciprocity(seed: u64) -> f64 {
    let mut s = Sampler::new(seed, 0);
    let mut worst: f64 = 0.0;
    for roughness in [0.1, 0.4, 1.0] {
        for (metallic, transmission, thin_walled) in LOOKS {
            let base_color = Vec3::new(0.9, 0.5, 0.1);
            let m = Material { base_color, ..look(roughness, metallic, transmission, thin_walled) };
            let (p, table) = (patch(&m), AlbedoTable::new(m.ior));
            let f = |v: DVec3, l: DVec3| {
                Bsdf::new(&p, &table, v).map_or(DVec3::ZERO, |b| b.evaluate(l).f_cos / l.y.abs())
            };
            let mut compare = |a: DVec3, b: DVec3| {
                let size = a.max_element().max(b.max_element());
                if size > 0.0 {
                    worst = worst.max((a - b).abs().max_element() / size);
                }
            };
            for _ in 0..100 {
                let (a, b) = (direction(s.uniform2(), 1.0), direction(s.uniform2(), 1.0));
                compare(f(a, b), f(b, a));
                let below = direction(s.uniform2(), -1.0);
                if transmission > 0.0 {
                    compare(f(a, below) * f64::from(m.ior).powi(2), f(below, a));
                }
            }
        }
    }
    worst
}

/// Of every lobe's sampler: how well its density fits it, and the largest relative difference of a sample's own density and value from
/// those of its direction.
fn direction_tests(seed: u64, samples: u32) -> Vec<(DirectionTest, f64)> {
    let looks = [
        (0.5f32, 1.0f32, 0.0f32, true, 0.9f64),
        (0.7, 1.0, 0.0, true, 0.15),
        (1.0, 1.0, 0.0, true, 0.5),
        (0.6, 0.0, 0.0, true, 0.6),
        (0.7, 0.0, 1.0, false, 0.7),
        (0.8, 0.3, 0.6, false, -0.6),
        (0.0, 0.0, 0.0, true, 0.5),
    ];
    looks
        .into_iter()
        .map(|(roughness, metallic, transmission, thin_walled, mu)| {
            let base_color = Vec3::splat(0.8);
            let m = Material { base_color, ..look(roughness, metallic, transmission, thin_walled) };
            let (p, table) = (patch(&m), AlbedoTable::new(m.ior));
            let bsdf = Bsdf::new(&p, &table, viewing(mu)).expect("front, or both sides");
            let mut s = Sampler::new(seed, 1);
            let mut apart: f64 = 0.0;
            // A mirror has no density: its samples count as absorbed.
            let mut draw = || {
                let sample = bsdf.sample(s.uniform(), s.uniform2(), s.uniform())?;
                let (pdf, value) = (sample.pdf?, bsdf.evaluate(sample.l));
                let of_value = (value.f_cos - sample.weight * pdf).abs().max_element();
                apart = apart.max((value.pdf / pdf - 1.0).abs()).max(of_value / value.f_cos.max_element());
                Some(sample.l)
            };
            let test = test_directions(samples, &mut draw, &|l| bsdf.evaluate(l).pdf);
            (test, apart)
        })
        .collect()
}

fn chi_square(seed: u64) -> f64 {
    let tests = direction_tests(seed, 150_000);
    // The least of n values of p is below p / n with probability p at most.
    let any = |t: &DirectionTest| 1e-4 / (tests.len() as f64 * t.p_value.max(1e-300));
    tests.iter().map(|(t, _)| any(t)).fold(0.0, f64::max)
}

fn own_density(seed: u64) -> f64 {
    direction_tests(seed, 20_000).iter().map(|(_, apart)| *apart).fold(0.0, f64::max)
}

fn density_integral(seed: u64) -> f64 {
    direction_tests(seed, 60_000).iter().map(|(t, _)| t.integral_error.abs()).fold(0.0, f64::max)
}

fn fresnel(_: u64) -> f64 {
    let textbook = |eta: f64, c: f64| {
        let sin2 = (1.0 - c * c) / (eta * eta);
        if sin2 >= 1.0 {
            return 1.0;
        }
        let t = (1.0 - sin2).sqrt();
        let (s, p) = ((c - eta * t) / (c + eta * t), (eta * c - t) / (eta * c + t));
        0.5 * (s * s + p * p)
    };
    let mut worst: f64 = 0.0;
    for eta in [1.1, 1.5, 2.4, 1.0 / 1.5, 0.2] {
        for i in 0..=2000 {
            let c = f64::from(i) / 2000.0;
            worst = worst.max((fresnel_dielectric(eta, c) - textbook(eta, c)).abs());
        }
    }
    for c in [0.0, 1e-9, 0.3, 1.0] {
        worst = worst.max(fresnel_dielectric(1.0, c));
    }
    // At normal incidence d^2 / (2 + d)^2, to full precision although the textbook's form has lost half of its digits.
    let next = 1.0 + 1e-7f64;
    let exact = (next - 1.0).powi(2) / (next + 1.0).powi(2);
    worst = worst.max(1e-3 * (fresnel_dielectric(next, 1.0) / exact - 1.0).abs());
    // Beyond normal incidence there is nothing; the edge of total reflection is approached like a square root, without a step.
    worst = worst.max((fresnel_dielectric(1.5, 1.0 + 1e-9) - fresnel_dielectric(1.5, 1.0)).abs());
    let edge = (1.0 - 1.0 / (1.5f64 * 1.5)).sqrt();
    for d in [1e-4, 1e-8, 1e-12] {
        let below = fresnel_dielectric(1.0 / 1.5, edge + d);
        let smooth = below < 1.0 && 1.0 - below < 20.0 * d.sqrt();
        worst = worst.max(if smooth { 1.0 - fresnel_dielectric(1.0 / 1.5, edge - d) } else { 1.0 });
    }
    // Just above 1 the reflectance goes with (n - 1)^2 at every angle; 1e-7 of the relative error counts.
    for c in [0.3, 0.6, 0.9, 1.0] {
        let scaled = |d: f64| {
            let n = 1.0 + d;
            fresnel_dielectric(n, c) / (n - 1.0).powi(2)
        };
        worst = worst.max(1e-7 * (scaled(1e-12) / scaled(1e-7) - 1.0).abs());
    }
    worst
}

fn grazing(seed: u64) -> f64 {
    let mut faults = 0u32;
    let mut s = Sampler::new(seed, 1);
    let table = AlbedoTable::new(1.5);
    for roughness in [0.0, 0.032, 0.5, 1.0] {
        for transmission in [0.0, 1.0] {
            let p = patch(&look(roughness, 0.2, transmission, false));
            for v in
                [DVec3::Y, DVec3::X, DVec3::new(1.0, 1e-12, 0.0), DVec3::new(1.0, -1e-300, 0.0), -DVec3::Y]
            {
                let Some(bsdf) = Bsdf::new(&p, &table, v.normalize()) else { continue };
                for u in [0.0, 1e-300, 0.5, 1.0 - f64::EPSILON / 2.0] {
                    for choose in [0.0, 0.3, 0.999999, 1.0 - f64::EPSILON / 2.0] {
                        let Some(x) = bsdf.sample(choose, [u, s.uniform()], u) else { continue };
                        let sound =
                            x.weight.is_finite() && x.weight.min_element() >= 0.0 && x.l.is_normalized();
                        faults += u32::from(!sound || x.pdf.is_some_and(|p| !(p.is_finite() && p > 0.0)));
                    }
                }
                for l in [DVec3::X, -DVec3::X, v, -v, DVec3::Y, -DVec3::Y, DVec3::new(0.0, 1e-200, 1.0)] {
                    let value = bsdf.evaluate(l);
                    faults +=
                        u32::from(!(value.f_cos.is_finite() && value.pdf.is_finite() && value.pdf >= 0.0));
                }
            }
        }
    }
    f64::from(faults)
}

fn albedo_f32(_: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for ior in [1.0001, 1.1, 1.5, 3.0] {
        let t = AlbedoTable::new(ior);
        for i in 0..=60 {
            for j in 0..=60 {
                let (mu, alpha) = ((f64::from(i) / 60.0).powi(4), (f64::from(j) / 60.0).powi(4));
                let e = t.directional(mu, alpha) - f64::from(t.directional_f32(mu as f32, alpha as f32));
                let a = t.average(alpha) - f64::from(t.average_f32(alpha as f32));
                worst = worst.max(e.abs()).max(a.abs());
            }
        }
    }
    worst
}

fn compensation_extremes(_: u64) -> f64 {
    let Some(k) = Compensation::new([0.8, 0.5, 1e-3], [1.0, 1e4, 1e-3], [0.0, 0.1, 0.0]) else {
        return f64::NAN;
    };
    let values = [
        f32::NAN,
        f32::INFINITY,
        f32::NEG_INFINITY,
        0.0,
        -0.0,
        -1.0,
        1e-45,
        1e-38,
        1e-3,
        1.0,
        1e18,
        f32::MAX,
    ];
    let mut faults = 0u32;
    for l in values {
        for distance in values {
            for cos in values {
                let d = k.drive([l; 3], distance, cos);
                faults += u32::from(d.iter().any(|d| !(0.0..=1.0).contains(d)));
                faults += u32::from(l.is_nan() && d != [0.0; 3]);
            }
        }
    }
    f64::from(faults)
}

fn compensation_f32(seed: u64) -> f64 {
    compensation_over(2.5e12, seed)
}

/// Surfaces of which the farthest and most slanted has `contrast` times the distance^2 / cos of the nearest, which is a millimetre
/// away: the error of their drive in units of the last place.
pub(super) fn compensation_over(contrast: f64, _: u64) -> f64 {
    let (albedo, intensity) = ([0.8, 0.5, 1.0], [10.0, 200.0, 1e4]);
    let Some(k) = Compensation::new(albedo, intensity, [0.0; 3]) else { return f64::NAN };
    let mut worst: f64 = 0.0;
    for i in 0..4000 {
        let t = f64::from(i) / 4000.0;
        let cos = (1.0 - 0.999 * (f64::from(i) * 0.618_034).fract()) as f32;
        let distance = (1e-6 * contrast.powf(t) * f64::from(cos)).sqrt() as f32;
        let radiance = [0.3 * t, 1e-4 + t, 3.0 * t].map(|x| x as f32);
        let own = k.unlimited_drive(radiance, distance, cos);
        let [cos, distance] = [cos, distance].map(Interval::from);
        let geometry = distance.times(distance).over(cos);
        for c in (0..3).filter(|c| radiance[*c] > 0.0) {
            let gain = Interval::PI.over(Interval::exactly(albedo[c]).times(Interval::exactly(intensity[c])));
            let exact = Interval::from(radiance[c]).times(gain.times(geometry));
            worst = worst.max(exact.ulps_from(own[c])[1]);
        }
    }
    worst
}
