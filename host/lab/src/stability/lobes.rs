//! The lobes that few materials have: energy, reciprocity, density, limits, and scenes with closed forms that both tracers draw.

use super::estimate::{pooled, Estimate};
use super::gpu::GpuCase;
use super::gpu_chain::furnish;
use super::gpu_compare::compare;
use super::gpu_shot::Shot;
use super::CpuCase;
use crate::reference::bsdf::Bsdf;
use crate::reference::lobes::{film_reflectance, sheen};
use crate::reference::microfacet::{fresnel_dielectric, fresnel_schlick};
use crate::reference::{Reference, RenderSettings, Sampler, SurfacePoint};
use crate::statistics::test_directions;
use dpm_render::gpu::Gpu;
use dpm_scene::albedo_table::AlbedoTable;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::lobes::*;
use dpm_scene::shapes::*;
use dpm_scene::{Environment, Material, Scene};
use glam::{DVec3, Vec3};
use std::f64::consts::PI;
use std::sync::Arc;

/// The cases of the reference.
pub(super) const CASES: &[CpuCase] = &[
    CpuCase(
        "lobes-energy",
        "every lobe alone and with others over white and black, roughness 0 to 1, films of 0 to 1,200 nm, anisotropy 0 to 1; down to 89.99 deg",
        "albedo at most 1",
        "excess",
        2e-2,
        energy,
    ),
    CpuCase(
        "lobes-reciprocity",
        "random pairs of directions on both sides",
        "f(a, b) = f(b, a), with the square of the index where refracted",
        "relative",
        1e-7,
        reciprocity,
    ),
    CpuCase(
        "lobes-samplers-chi-square",
        "every lobe, 150,000 samples each",
        "probability p that chance fits one of n lobes worse: 1e-4 / (n p)",
        "ratio",
        1.0,
        chi_square,
    ),
    CpuCase(
        "lobes-samples-carry-their-density",
        "every lobe, 20,000 samples each",
        "density and value of a sample are those of its direction",
        "relative",
        1e-7,
        own_density,
    ),
    CpuCase(
        "lobes-density-integrates-to-one",
        "every lobe",
        "integral of the density = share not absorbed",
        "share",
        8e-3,
        density_integral,
    ),
    CpuCase(
        "lobes-limits",
        "anisotropy 1e-9, coat 1e-12, sheen 1e-12, film of 0 nm and of index 1, neutral specular, no dispersion, no light shining through",
        "the value without the lobe",
        "relative",
        1e-6,
        limits,
    ),
    CpuCase(
        "lobes-thick-film",
        "films of 20 um on metals and dielectrics",
        "closed form: the light of all reflections, added without phase",
        "reflectance",
        2e-3,
        thick_film,
    ),
    CpuCase(
        "lobes-closed-forms",
        "coats over black, white and mirror; specular; sheen; film; attenuation over 1e-6 to 1e6 m; 100 veils; dispersion; light shining through",
        "closed forms: radiance beyond 4 sigma by the tolerance of each",
        "ratio",
        1.0,
        |seed| worst_closed_form(&|form| of_reference(form, seed)),
    ),
];

/// The cases of the shaders.
pub(super) const GPU_CASES: &[GpuCase] = &[
    GpuCase(
        "gpu-lobes-closed-forms",
        "coats over black, white and mirror; specular; sheen; film; attenuation over 1e-6 to 1e6 m; 100 veils; dispersion; light shining through",
        "closed forms: radiance beyond 4 sigma by the tolerance of each",
        "ratio",
        1.0,
        |gpu, seed| worst_closed_form(&|form| of_gpu(gpu, form, seed)),
    ),
    GpuCase(
        "gpu-lobes-energy",
        "white spheres of every lobe alone and with others in even light",
        "albedo at most 1",
        "excess",
        2e-2,
        gpu_energy,
    ),
    GpuCase(
        "gpu-lobes-against-reference",
        "10 random scenes in which every lobe occurs, with textures, lamps, lights and skies",
        "f64 tracer: mean radiance by 4 sigma and 0.3 %, or pixels beyond 4 sigma by those that chance allows",
        "ratio",
        1.0,
        against_reference,
    ),
];

/// A material that reflects nothing without its lobes.
fn black() -> Material {
    Material { base_color: Vec3::ZERO, ..white() }
}

/// A white Lambertian surface without a coat.
fn white() -> Material {
    Material { ior: 1.0, ..diffuse(Vec3::ONE) }
}

/// White under a dielectric surface.
fn plastic(roughness: f32) -> Material {
    Material { ior: 1.5, roughness, ..diffuse(Vec3::ONE) }
}

fn metal(roughness: f32) -> Material {
    Material { roughness, ..Material::default() }
}

fn glass(roughness: f32, thin_walled: bool) -> Material {
    Material { roughness, thin_walled, transmission: 1.0, metallic: 0.0, ..Material::default() }
}

fn with(mut material: Material, change: impl FnOnce(&mut Lobes)) -> Material {
    change(&mut material.lobes);
    material
}

fn coat(factor: f32, roughness: f32) -> Coat {
    Coat { factor, roughness, normal_scale: 1.0, ..Coat::default() }
}

fn film(nm: f32, ior: f32) -> Film {
    Film { factor: 1.0, ior, thickness_nm: [0.0, nm], ..Film::default() }
}

/// Materials in which every lobe occurs, at the ends of its range and between.
pub(crate) fn looks() -> Vec<Material> {
    let mut all = Vec::new();
    for roughness in [0.0, 0.1, 0.5, 1.0] {
        for base in [white(), metal(0.3), metal(0.0), plastic(0.3), glass(0.4, false), glass(0.4, true)] {
            all.push(with(base.clone(), |l| l.coat = coat(1.0, roughness)));
            all.push(with(base, |l| l.sheen = Sheen { color: Vec3::ONE, roughness, ..Sheen::default() }));
        }
        for strength in [0.01, 0.5, 1.0] {
            let brushed = |l: &mut Lobes| {
                l.anisotropy = Anisotropy { strength, rotation: 0.6, ..Anisotropy::default() };
            };
            all.push(with(metal(roughness), brushed));
            all.push(with(plastic(roughness), brushed));
            all.push(with(glass(roughness, false), brushed));
        }
        for nm in [0.0, 80.0, 250.0, 400.0, 620.0, 1200.0] {
            for base in [metal(roughness), glass(roughness, false), glass(roughness, true)] {
                all.push(with(base, |l| l.film = film(nm, 1.33)));
            }
            all.push(with(plastic(roughness), |l| l.film = film(nm, 1.8)));
        }
        all.push(with(plastic(roughness), |l| l.film = film(80.0, 2.5)));
        let specular = Specular { factor: 0.7, color: Vec3::new(4.0, 1.0, 0.0), ..Specular::default() };
        all.push(with(plastic(roughness), |l| l.specular = specular));
        all.push(with(glass(roughness, false), |l| l.specular = specular));
        let shine = DiffuseTransmission { factor: 0.6, ..DiffuseTransmission::default() };
        all.push(with(plastic(roughness), |l| l.diffuse_transmission = shine));
        all.push(with(plastic(roughness), |l| {
            l.diffuse_transmission = shine;
            l.coat = coat(0.8, 0.2);
            l.sheen = Sheen { color: Vec3::new(0.9, 0.5, 0.1), roughness: 0.5, ..Sheen::default() };
            l.specular = specular;
            l.anisotropy.strength = 0.5;
        }));
    }
    all
}

/// The point in the middle of a patch of the material.
fn patch(material: &Material) -> SurfacePoint {
    let mesh = floor(1.0, 0.0);
    let scene = scene_of(mesh, material.clone());
    let point = Reference::new(&scene, &[]).trace(DVec3::new(0.1, 1.0, 0.2), -DVec3::Y, 9.0, false);
    point.expect("the patch lies below")
}

fn viewing(mu: f64) -> DVec3 {
    let (sin, azimuth) = ((1.0 - mu * mu).max(0.0).sqrt(), 0.4f64);
    DVec3::new(sin * azimuth.cos(), mu, sin * azimuth.sin())
}

fn energy(seed: u64) -> f64 {
    let table = AlbedoTable::new(1.5);
    let none = AlbedoTable::new(1.0);
    let mut worst: f64 = 0.0;
    for m in looks() {
        let (point, table) = (patch(&m), if m.ior == 1.0 { &none } else { &table });
        for mu in [1.0, 0.5, 0.1, 1.745e-4, -0.6] {
            let Some(bsdf) = Bsdf::new(&point, table, viewing(mu)) else { continue };
            let mut s = Sampler::new(seed, 0);
            let mut sum = Estimate::default();
            for _ in 0..3000 {
                let sample = bsdf.sample(s.uniform(), s.uniform2(), s.uniform());
                sum.add(sample.map_or([0.0; 3], |s| s.weight.to_array()));
            }
            let into = !m.thin_walled && m.transmission > 0.0 && mu < 0.0;
            let growth = if into { f64::from(m.ior * m.ior) } else { 1.0 };
            for c in 0..3 {
                if !sum.mean[c].is_finite() || sum.mean[c] < 0.0 {
                    return f64::INFINITY;
                }
                let excess = (sum.mean[c] - 5.0 * sum.variance(c).sqrt()) / growth - 1.0;
                worst = worst.max(excess);
            }
        }
    }
    worst
}

fn direction(u: [f64; 2], up: f64) -> DVec3 {
    let (y, phi) = (0.02 + 0.98 * u[0], 2.0 * PI * u[1]);
    let r = (1.0 - y * y).sqrt();
    DVec3::new(r * phi.cos(), y * up, r * phi.sin())
}

fn reciprocity(seed: u64) -> f64 {
    let mut s = Sampler::new(seed, 0);
    let mut worst: f64 = 0.0;
    for mut m in looks() {
        m.base_color *= Vec3::new(0.9, 0.5, 0.1);
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
        // A layer is only there outside: light that refracts is let through on the way in.
        let layers = m.lobes.coat.factor > 0.0 || m.lobes.sheen.color != Vec3::ZERO;
        for _ in 0..30 {
            let (a, b) = (direction(s.uniform2(), 1.0), direction(s.uniform2(), 1.0));
            compare(f(a, b), f(b, a));
            let below = direction(s.uniform2(), -1.0);
            if m.transmission > 0.0 && !m.thin_walled && !layers {
                compare(f(a, below) * f64::from(m.ior).powi(2), f(below, a));
            } else if m.lobes.diffuse_transmission.factor > 0.0 {
                compare(f(a, below), f(below, a));
            }
        }
    }
    worst
}

fn direction_tests(seed: u64, samples: u32) -> Vec<(crate::statistics::DirectionTest, f64)> {
    let sheen = Sheen { color: Vec3::ONE, roughness: 0.6, ..Sheen::default() };
    let brushed = Anisotropy { strength: 0.6, rotation: 0.5, ..Anisotropy::default() };
    let shine = DiffuseTransmission { factor: 0.5, ..DiffuseTransmission::default() };
    let looks = [
        (with(black(), |l| l.coat = coat(1.0, 0.6)), 0.7),
        (with(metal(0.6), |l| l.coat = coat(0.7, 0.8)), 0.4),
        (with(metal(0.5), |l| l.anisotropy = brushed), 0.8),
        (with(metal(0.7), |l| l.anisotropy = brushed), 0.3),
        (with(glass(0.7, false), |l| l.anisotropy = brushed), 0.7),
        (with(glass(0.7, false), |l| l.anisotropy = brushed), -0.6),
        (with(white(), |l| l.sheen = sheen), 0.5),
        (with(plastic(0.7), |l| l.diffuse_transmission = shine), 0.6),
        (with(plastic(0.6), |l| l.film = film(300.0, 1.4)), 0.6),
        (with(metal(0.6), |l| l.film = film(400.0, 1.4)), 0.5),
        (with(glass(0.7, false), |l| l.film = film(400.0, 1.4)), 0.5),
    ];
    let mut out = Vec::new();
    for (m, mu) in looks {
        let (p, table) = (patch(&m), AlbedoTable::new(m.ior));
        let bsdf = Bsdf::new(&p, &table, viewing(mu)).expect("front, or both sides");
        let mut s = Sampler::new(seed, 1);
        let mut apart: f64 = 0.0;
        let mut draw = || {
            let sample = bsdf.sample(s.uniform(), s.uniform2(), s.uniform())?;
            let (pdf, value) = (sample.pdf?, bsdf.evaluate(sample.l));
            let of_value = (value.f_cos - sample.weight * pdf).abs().max_element();
            apart = apart.max((value.pdf / pdf - 1.0).abs()).max(of_value / value.f_cos.max_element());
            Some(sample.l)
        };
        let test = test_directions(samples, &mut draw, &|l| bsdf.evaluate(l).pdf);
        out.push((test, apart));
    }
    out
}

fn chi_square(seed: u64) -> f64 {
    let tests = direction_tests(seed, 150_000);
    let any = |t: &crate::statistics::DirectionTest| 1e-4 / (tests.len() as f64 * t.p_value.max(1e-300));
    tests.iter().map(|(t, _)| any(t)).fold(0.0, f64::max)
}

fn own_density(seed: u64) -> f64 {
    direction_tests(seed, 20_000).iter().map(|(_, apart)| *apart).fold(0.0, f64::max)
}

fn density_integral(seed: u64) -> f64 {
    direction_tests(seed, 60_000).iter().map(|(t, _)| t.integral_error.abs()).fold(0.0, f64::max)
}

fn limits(seed: u64) -> f64 {
    let none: [fn(&mut Lobes); 8] = [
        |l| l.anisotropy.strength = 1e-9,
        |l| l.coat = coat(1e-12, 0.3),
        |l| l.sheen = Sheen { color: Vec3::splat(1e-12), roughness: 0.4, ..Sheen::default() },
        |l| l.film = film(0.0, 1.5),
        |l| l.film = film(400.0, 1.0),
        |l| l.specular = Specular { factor: 1.0 - 1e-7, ..Specular::default() },
        |l| l.dispersion = 0.0,
        |l| l.diffuse_transmission.factor = 0.0,
    ];
    let bases = [metal(0.4), plastic(0.4), glass(0.5, false)];
    let mut s = Sampler::new(seed, 0);
    let mut worst: f64 = 0.0;
    for mut base in bases {
        // A film takes F0 to be below 1.
        base.base_color *= Vec3::new(0.9, 0.6, 0.4);
        for change in none {
            let changed = with(base.clone(), change);
            let [a, b] = [&base, &changed].map(patch);
            let table = AlbedoTable::new(base.ior);
            for _ in 0..40 {
                let v = direction(s.uniform2(), 1.0);
                let l = direction(s.uniform2(), if s.uniform() < 0.3 { -1.0 } else { 1.0 });
                let [a, b] = [&a, &b].map(|p| Bsdf::new(p, &table, v).map(|b| b.evaluate(l).f_cos));
                let (Some(a), Some(b)) = (a, b) else { return f64::NAN };
                let size = a.max_element().max(b.max_element());
                if size > 0.0 {
                    worst = worst.max((a - b).abs().max_element() / size);
                }
            }
        }
    }
    worst
}

fn thick_film(_: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for f0 in [0.04, 0.3, 0.9] {
        for ior in [1.2, 1.5, 2.0] {
            for cos in [1.0, 0.7, 0.3] {
                let inside = f64::sqrt(1.0 - (1.0 - cos * cos) / (ior * ior));
                let square = |a: f64, b: f64| ((a - b) / (a + b)).powi(2);
                let root = f64::sqrt(f0);
                let base = (1.0 + root) / (1.0 - root);
                let top = fresnel_dielectric(ior, cos);
                let bottom = fresnel_schlick(DVec3::splat(square(base, ior)), inside).x;
                let all = top + (1.0 - top).powi(2) * bottom / (1.0 - top * bottom);
                let film = film_reflectance(DVec3::splat(f0), ior, 20_000.0, cos);
                worst = worst.max((film - DVec3::splat(all)).abs().max_element());
            }
        }
    }
    worst
}

/// A scene whose radiance toward a camera is known.
pub(crate) struct ClosedForm {
    /// What it is, for the note of a case that fails.
    name: String,
    scene: Scene,
    /// Cosine at which it looks at the origin.
    mu: f64,
    depth: u32,
    expected: DVec3,
    /// Beyond four sigma.
    tolerance: f64,
}

impl ClosedForm {
    /// A floor of a material in light from everywhere.
    fn new(name: impl Into<String>, material: Material, mu: f64, expected: DVec3, tolerance: f64) -> Self {
        let mut scene = scene_of(floor(3.0, 0.0), material);
        scene.environment = sky(1.0);
        Self { name: name.into(), scene, mu, depth: 3, expected, tolerance }
    }

    fn camera(&self) -> ProjectorCamera {
        // Not through the edge between two triangles.
        let at = DVec3::new(0.013, 0.0, 0.029);
        let mut camera = camera(4, 4, at + viewing(self.mu) * 2.0, at);
        (camera.fx, camera.fy) = (1e6, 1e6);
        camera
    }
}

fn closed_forms() -> Vec<ClosedForm> {
    let even = DVec3::splat;
    let mut all = Vec::new();
    for mu in [1.0, 0.4, 0.08] {
        let f = fresnel_dielectric(1.5, mu);
        for factor in [1.0, 0.4] {
            let c = f64::from(factor);
            let of = |m: Material| with(m, |l| l.coat = coat(factor, 0.0));
            let name = |over: &str| format!("coat of {factor} over {over} at {mu}");
            all.push(ClosedForm::new(name("black"), of(black()), mu, even(c * f), 1e-4));
            all.push(ClosedForm::new(name("a mirror"), of(metal(0.0)), mu, even(1.0), 4e-3));
            all.push(ClosedForm::new(name("white"), of(white()), mu, even(1.0), 6e-3));
            let lamp = Material { emissive: Vec3::splat(3.0), ..of(black()) };
            let lit = even(3.0 * (1.0 - c * f) + c * f);
            all.push(ClosedForm::new(name("a lamp"), lamp, mu, lit, 2e-2));
        }
        for factor in [1.0, 0.4] {
            all.push(ClosedForm::new(
                format!("rough coat of {factor} over white at {mu}"),
                with(white(), |l| l.coat = coat(factor, 0.6)),
                mu,
                even(1.0),
                6e-3,
            ));
        }
        let color = Vec3::new(4.0, 0.5, 0.0);
        let tinted = Specular { factor: 0.6, color, ..Specular::default() };
        let rise = (f - 0.04) / 0.96;
        let top = color.as_dvec3() * 0.04;
        let mirror = with(Material { ior: 1.5, roughness: 0.0, ..black() }, |l| l.specular = tinted);
        let expected = (top + (DVec3::ONE - top) * rise) * 0.6;
        all.push(ClosedForm::new(format!("specular of a colour at {mu}"), mirror, mu, expected, 1e-4));
        for nm in [0.0, 100.0, 350.0, 700.0, 1200.0] {
            let base_color = Vec3::new(0.95, 0.6, 0.3);
            let m = with(Material { base_color, ..metal(0.0) }, |l| l.film = film(nm, 1.4));
            let expected = film_reflectance(base_color.as_dvec3(), f64::from(1.4f32), f64::from(nm), mu);
            all.push(ClosedForm::new(format!("film of {nm} nm at {mu}"), m, mu, expected, 1e-3));
        }
        all.extend([0.3, 0.7, 1.0].into_iter().flat_map(|roughness| sheens(roughness, mu)));
    }
    for (roughness, strength, mu) in [(0.5f32, 0.7f32, 0.4), (0.4, 1.0, 0.9), (0.7, 0.5, 0.2)] {
        let brushed = Anisotropy { strength, rotation: 0.6, ..Anisotropy::default() };
        let m = with(metal(roughness), |l| l.anisotropy = brushed);
        let name = format!("metal of {roughness} brushed by {strength} at {mu}");
        all.push(ClosedForm::new(name, m, mu, even(albedo_of_brushed(roughness, strength, mu)), 4e-3));
    }
    all.extend(volumes());
    all.extend(sheets());
    all
}

/// Sheen over black and over white, seen under `mu`.
fn sheens(roughness: f32, mu: f64) -> [ClosedForm; 2] {
    let color = Vec3::new(0.9, 0.5, 0.2);
    let cloth = Sheen { color, roughness, ..Sheen::default() };
    let e = albedo_of_sheen(mu, f64::from(roughness * roughness));
    let over_black = with(black(), |l| l.sheen = cloth);
    let expected = color.as_dvec3() * e;
    let m = f64::from(color.max_element());
    let under = |x: f64| 1.0 - m * albedo_of_sheen(x, f64::from(roughness * roughness));
    let n = 40;
    let left: f64 = (0..n)
        .map(|i| (f64::from(i) + 0.5) / f64::from(n))
        .map(|x| 2.0 * x / f64::from(n) * under(mu).min(under(x)))
        .sum();
    [
        ClosedForm::new(format!("sheen of {roughness} over black at {mu}"), over_black, mu, expected, 4e-3),
        ClosedForm::new(
            format!("sheen of {roughness} over white at {mu}"),
            with(white(), |l| l.sheen = cloth),
            mu,
            expected + left,
            6e-3,
        ),
    ]
}

/// The albedo of a white metal that is brushed at 0.6 rad from the tangent, by the integral over outgoing directions.
fn albedo_of_brushed(roughness: f32, strength: f32, mu: f64) -> f64 {
    let (alpha, strength) = (f64::from(roughness * roughness), f64::from(strength));
    let (along, across) = (alpha + (1.0 - alpha) * strength * strength, alpha);
    // The floor's normal is Y, its tangent X and its bitangent -Z.
    let (sin, cos) = 0.6f64.sin_cos();
    let (t, b) = (DVec3::new(cos, 0.0, -sin), DVec3::new(-sin, 0.0, -cos));
    let lambda = |w: DVec3| {
        let slope = ((along * w.dot(t)).powi(2) + (across * w.dot(b)).powi(2)) / (w.y * w.y);
        0.5 * ((1.0 + slope).sqrt() - 1.0)
    };
    let (n, m) = (300, 400);
    let v = viewing(mu);
    let mut sum = 0.0;
    for i in 0..n {
        let y = (f64::from(i) + 0.5) / f64::from(n);
        for j in 0..m {
            let (sin, cos) = (2.0 * PI * (f64::from(j) + 0.5) / f64::from(m)).sin_cos();
            let l = DVec3::new((1.0 - y * y).sqrt() * cos, y, (1.0 - y * y).sqrt() * sin);
            let h = (v + l).normalize();
            let stretched = (h.dot(t) / along).powi(2) + (h.dot(b) / across).powi(2) + h.y * h.y;
            let density = 1.0 / (PI * along * across * stretched * stretched);
            sum += density / (4.0 * mu * (1.0 + lambda(v) + lambda(l))) * 2.0 * PI / f64::from(n * m);
        }
    }
    sum
}

/// The albedo of a white sheen by its own integral.
fn albedo_of_sheen(mu: f64, alpha: f64) -> f64 {
    let (n, m) = (160, 120);
    let v = DVec3::new((1.0 - mu * mu).sqrt(), 0.0, mu);
    let mut sum = 0.0;
    for i in 0..n {
        let root = (f64::from(i) + 0.5) / f64::from(n);
        let z = root * root;
        for j in 0..m {
            let phi = PI * (f64::from(j) + 0.5) / f64::from(m);
            let r = (1.0 - z * z).sqrt();
            let l = DVec3::new(r * phi.cos(), r * phi.sin(), z);
            sum += sheen(v, l, alpha) * 2.0 * root * 2.0 * PI / f64::from(n * m);
        }
    }
    sum
}

/// Solids that absorb and disperse.
fn volumes() -> Vec<ClosedForm> {
    let mut all = Vec::new();
    // Slabs of nothing but colour. Thinner ones are as thin as the distance from a surface at which a new ray starts.
    for distance in [1e-3f32, 1e-2, 1.0, 1e3, 1e6] {
        for (mu, depths) in [(1.0, 1.0f32), (0.5, 2.0)] {
            // Coordinates end at 1e6 m.
            let thickness = (0.5 * distance * depths).min(2e4);
            let color = Vec3::new(0.8, 0.3, 1.0);
            let solid = Material { ior: 1.0, ..glass(0.0, false) };
            let m = with(solid, |l| l.absorption = absorption(color, distance));
            let side = (20.0 * thickness).max(0.1);
            let below = quad(Vec3::new(-side, -thickness, -side), Vec3::X * 2.0 * side, Vec3::Z * 2.0 * side);
            let mut form = ClosedForm::new(
                format!("{thickness} m of a colour that is left after {distance} m, at {mu}"),
                m.clone(),
                mu,
                color.as_dvec3().powf(f64::from(thickness / distance) / mu),
                2e-3,
            );
            form.scene = scene_of(join([floor(side, 0.0), below]), m);
            form.scene.environment = sky(1.0);
            form.depth = 8;
            all.push(form);
        }
    }
    for distance in [1e-6, 1e-30] {
        let m = with(glass(0.0, false), |l| l.absorption = absorption(Vec3::splat(0.5), distance));
        let f = DVec3::splat(fresnel_dielectric(1.5, 0.7));
        all.push(ClosedForm::new(format!("black glass of {distance} m"), m, 0.7, f, 1e-4));
    }
    // That of diamond and of flint glass differs by less than the noise of a channel that is drawn for all three; the last does not.
    for dispersion in [0.0f32, 0.36, 1.0, 8.0] {
        let m = with(glass(0.0, false), |l| l.dispersion = dispersion);
        let spread = 0.5 * 0.025 * f64::from(dispersion);
        for mu in [1.0, 0.3] {
            // What is reflected, and what comes from within an endless solid.
            let of = |n: f64| {
                let f = fresnel_dielectric(n, mu);
                f + (1.0 - f) / (n * n)
            };
            let expected = DVec3::new(of(1.5 - spread), of(1.5), of(1.5 + spread));
            let name = format!("dispersion of {dispersion} at {mu}");
            all.push(ClosedForm::new(name, m.clone(), mu, expected, 2e-3));
        }
    }
    all
}

/// Sheets that light shines through, and veils.
fn sheets() -> Vec<ClosedForm> {
    let mut all = Vec::new();
    let shine = DiffuseTransmission { factor: 0.3, color: Vec3::new(0.2, 0.9, 0.5), ..Default::default() };
    let leaf = Material { base_color: Vec3::new(0.6, 0.5, 0.1), ..white() };
    let expected = DVec3::new(0.6, 0.5, 0.1) * 0.7 + DVec3::new(0.2, 0.9, 0.5) * 0.3;
    let leaf = with(leaf, |l| l.diffuse_transmission = shine);
    all.push(ClosedForm::new("a leaf in even light", leaf.clone(), 0.6, expected, 1e-3));
    let mut lit =
        ClosedForm::new("a leaf before a lamp", leaf, 0.6, DVec3::new(0.2, 0.9, 0.5) * (0.3 * 2.0), 1e-3);
    // All that the other side sees glows.
    let glow = quad(Vec3::new(-900.0, -1.0, 900.0), Vec3::X * 1800.0, Vec3::NEG_Z * 1800.0);
    add(&mut lit.scene, glow, emitter(Vec3::splat(2.0)));
    lit.scene.environment = Environment::default();
    all.push(lit);
    let paper = DiffuseTransmission { factor: 0.5, ..Default::default() };
    let coated = with(plastic(0.5), |l| {
        l.diffuse_transmission = paper;
        l.coat = coat(1.0, 0.3);
    });
    all.push(ClosedForm::new("coated white paper", coated, 0.5, DVec3::ONE, 8e-3));

    for (alpha, count) in [(0.02f32, 100u32), (0.3, 100), (0.5, 1), (1.0, 1), (0.0, 1)] {
        for glowing in [false, true] {
            let emissive = if glowing { Vec3::splat(3.0) } else { Vec3::ZERO };
            let veil = Material { alpha, alpha_blend: true, emissive, ..black() };
            let left = (1.0 - f64::from(alpha)).powi(count as i32);
            let expected = left + if glowing { 3.0 * (1.0 - left) } else { 0.0 };
            let name = format!("{count} veils of {alpha}, glowing {glowing}");
            let mut form = ClosedForm::new(name, veil.clone(), 1.0, DVec3::splat(expected), 4e-3);
            form.scene = scene_of(join((0..count).map(|k| floor(3.0, -0.01 * k as f32))), veil);
            form.scene.environment = sky(1.0);
            // A veil that is not there at all is no surface: nothing is lit, and there is nothing to compare.
            if alpha > 0.0 {
                all.push(form);
            }
        }
    }
    // The shadow of a veil: a sun over a floor.
    let mut shadow = ClosedForm::new("the shadow of a veil", white(), 0.5, DVec3::splat(0.6 / PI), 3e-3);
    shadow.scene.environment = Environment::default();
    let veil = Material { alpha: 0.4, alpha_blend: true, double_sided: true, ..black() };
    add(&mut shadow.scene, quad(Vec3::new(-0.3, 0.3, 0.3), Vec3::X * 0.6, Vec3::NEG_Z * 0.6), veil);
    shadow.scene.lights.push(light_from_above());
    all.push(shadow);
    // Eye and sun look through one triangle of a veil, and each of their rays decides for itself.
    let mut under =
        ClosedForm::new("a floor seen and lit through a veil", white(), 0.5, DVec3::splat(0.36 / PI), 3e-3);
    under.scene.environment = Environment::default();
    let veil = Material { alpha: 0.4, alpha_blend: true, double_sided: true, ..black() };
    add(&mut under.scene, quad(Vec3::new(-1.0, 0.3, 2.0), Vec3::X * 6.0, Vec3::NEG_Z * 6.0), veil);
    under.scene.lights.push(light_from_above());
    all.push(under);
    all
}

fn light_from_above() -> dpm_scene::PunctualLight {
    let kind = dpm_scene::PunctualKind::Directional;
    dpm_scene::PunctualLight { kind, ..point_light(Vec3::ZERO, 1.0) }
}

/// Radiance beyond four sigma by the tolerance, of the worst form.
///
/// # Panics
/// A form is beyond its tolerance, or too noisy to tell: the note of the case names it.
fn worst_closed_form(draw: &dyn Fn(&ClosedForm) -> Option<(DVec3, DVec3)>) -> f64 {
    let mut worst: f64 = 0.0;
    for form in closed_forms() {
        let what = &form.name;
        let Some((mean, sigma)) = draw(&form) else { panic!("{what}: samples that are not finite") };
        let told = sigma.max_element() <= 4.0 * form.tolerance.max(3e-3);
        let ratio = ((mean - form.expected).abs() - 4.0 * sigma).max_element() / form.tolerance;
        let fits = told && ratio <= 1.0;
        assert!(fits, "{what}: {mean} for {}, sigma {sigma}", form.expected);
        worst = worst.max(ratio);
    }
    worst
}

fn of_reference(form: &ClosedForm, seed: u64) -> Option<(DVec3, DVec3)> {
    let settings = RenderSettings { spp: 1500, depth: form.depth, seed, ..RenderSettings::default() };
    let image = Reference::new(&form.scene, &[]).render_camera(&form.camera(), &settings);
    let n = image.mean.len() as f64;
    let (mut mean, mut variance) = (DVec3::ZERO, DVec3::ZERO);
    for (m, v) in image.mean.iter().zip(&image.variance) {
        mean += DVec3::from(*m) / n;
        variance += DVec3::from(*v) / (n * n);
    }
    (image.dropped_samples == 0).then(|| (mean, variance.map_sqrt()))
}

trait Roots {
    fn map_sqrt(self) -> Self;
}

impl Roots for DVec3 {
    fn map_sqrt(self) -> Self {
        DVec3::from(self.to_array().map(f64::sqrt))
    }
}

fn of_gpu(gpu: &Arc<Gpu>, form: &ClosedForm, seed: u64) -> Option<(DVec3, DVec3)> {
    let shot = Shot {
        spp: 128,
        frames: 12,
        depth: form.depth,
        seed: seed as u32,
        ..Shot::new(&form.scene, form.camera())
    };
    let picture = shot.draw(gpu);
    let channel = |c: usize| pooled(&picture.estimates, c);
    let (mean, sigma): (Vec<f64>, Vec<f64>) = (0..3).map(channel).unzip();
    (picture.invalid_samples() == 0).then(|| (DVec3::from_slice(&mean), DVec3::from_slice(&sigma)))
}

fn gpu_energy(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut worst: f64 = 0.0;
    // As many bodies as a scene may have, in one picture: each a sphere in a row.
    let looks = looks();
    let mut scene = Scene::default();
    let columns = 16;
    for (k, look) in looks.iter().enumerate() {
        let at = Vec3::new((k % columns) as f32, (k / columns) as f32, 0.0) * 4.0;
        add(&mut scene, sphere(at, 1.0, 3, true), look.clone());
    }
    scene.environment = sky(1.0);
    let rows = looks.len().div_ceil(columns);
    let middle = DVec3::new(columns as f64 - 1.0, rows as f64 - 1.0, 0.0) * 2.0;
    let mut camera = camera(160, 120, middle + DVec3::Z * 4000.0, middle);
    let pixels = 150.0 * 4000.0 / (columns as f64 * 4.0);
    (camera.fx, camera.fy) = (pixels, pixels);
    // Two bounces at most: what one sphere sends to another is what the sky would.
    let shot = Shot { spp: 24, frames: 8, depth: 12, seed: seed as u32, ..Shot::new(&scene, camera) };
    let picture = shot.draw(gpu);
    if picture.invalid_samples() > 0 {
        return f64::INFINITY;
    }
    let mut by_body: Vec<Vec<Estimate>> = vec![vec![]; looks.len()];
    for i in (0..picture.surfaces.len()).filter(|&i| picture.hit(i)) {
        by_body[(picture.surfaces[i].id >> 24) as usize].push(picture.estimates[i]);
    }
    for pixels in by_body.iter().filter(|p| p.len() > 8) {
        for c in 0..3 {
            let (mean, sigma) = pooled(pixels, c);
            let excess = mean - 5.0 * sigma - 1.0;
            worst = worst.max(excess);
        }
    }
    let seen = by_body.iter().filter(|p| p.len() > 8).count();
    if seen < looks.len() * 9 / 10 {
        return f64::NAN;
    }
    worst.max(0.0)
}

fn against_reference(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let (mut beyond, mut values, mut worst) = (0.0, 0.0, 0.0f64);
    for k in 0..10 {
        let (scene, poses) = furnish(seed.wrapping_mul(1000).wrapping_add(500 + k), &mut lobes_by_chance);
        let camera = camera(20, 15, DVec3::new(0.4, 1.5, 2.6), DVec3::new(0.0, 0.3, 0.0));
        let eye = Some(DVec3::new(-0.6, 1.4, 2.3));
        let shot = Shot {
            eye,
            poses,
            spp: 16,
            frames: 24,
            depth: 5,
            seed: seed as u32,
            ..Shot::new(&scene, camera)
        };
        let c = compare(gpu, &shot, 256);
        let e = c.explained();
        if c.common.len() < 60 || c.reference.dropped_samples > 0 || c.picture.invalid_samples() > 0 {
            return f64::NAN;
        }
        beyond += e.beyond.len() as f64;
        values += e.values;
        for channel in 0..3 {
            let gap = c.mean_gap(channel);
            let ratio = (gap.gpu - gap.truth).abs() / (4.0 * gap.sigma + 3e-3 * gap.truth);
            worst = worst.max(ratio);
        }
    }
    worst.max(beyond / f64::max(3e-3 * values, 3.0))
}

/// Some lobes, drawn by chance, with textures.
fn lobes_by_chance(scene: &mut Scene, s: &mut Sampler, material: &mut Material) {
    let mut texture = |s: &mut Sampler, srgb: bool| {
        let picture = noise_texture(8, s.next_u64(), 120, 255, srgb);
        (s.uniform() < 0.4).then(|| use_texture(scene, picture)).flatten()
    };
    let u = |s: &mut Sampler| s.uniform() as f32;
    let lobes = &mut material.lobes;
    for _ in 0..2 {
        match (s.uniform() * 9.0) as u32 {
            0 => {
                lobes.coat = Coat {
                    roughness: 0.3 + 0.6 * u(s),
                    texture: texture(s, false),
                    roughness_texture: texture(s, false),
                    normal_texture: texture(s, false),
                    normal_scale: 0.4,
                    ..coat(0.4 + 0.6 * u(s), 0.0)
                }
            }
            1 => {
                lobes.specular = Specular {
                    factor: u(s),
                    color: Vec3::new(2.0 * u(s), 3.0 * u(s), u(s)),
                    texture: texture(s, false),
                    color_texture: texture(s, true),
                }
            }
            2 => {
                material.roughness = 0.5 + 0.4 * u(s);
                lobes.anisotropy =
                    Anisotropy { strength: u(s), rotation: 6.0 * u(s), texture: texture(s, false) };
            }
            3 => {
                lobes.sheen = Sheen {
                    color: Vec3::new(u(s), u(s), u(s)),
                    roughness: 0.4 + 0.6 * u(s),
                    color_texture: texture(s, true),
                    roughness_texture: texture(s, false),
                }
            }
            4 => {
                (material.transmission, material.metallic, material.thin_walled) = (1.0, 0.0, false);
                lobes.absorption = absorption(Vec3::new(0.2 + 0.8 * u(s), 0.5, 0.9), 0.05 + u(s));
            }
            5 => {
                lobes.film = Film {
                    factor: u(s),
                    ior: 1.1 + u(s),
                    thickness_nm: [100.0, 100.0 + 900.0 * u(s)],
                    texture: texture(s, false),
                    thickness_texture: texture(s, false),
                }
            }
            6 => {
                material.metallic = 0.0;
                lobes.diffuse_transmission = DiffuseTransmission {
                    factor: u(s),
                    color: Vec3::new(u(s), u(s), u(s)),
                    texture: texture(s, false),
                    color_texture: texture(s, true),
                }
            }
            7 => {
                (material.transmission, material.metallic, material.thin_walled) = (1.0, 0.0, false);
                lobes.dispersion = 2.0 * u(s);
            }
            _ => (material.alpha, material.alpha_blend) = (0.2 + 0.7 * u(s), true),
        }
    }
}
