//! What method dpm divides its histories by, against the light that sky and lamps send with nothing in the way.

use super::gpu::GpuCase;
use super::gpu_history::dpm;
use super::gpu_shot::Shot;
use super::lobes::looks;
use crate::reference::bsdf::Bsdf;
use crate::reference::{Reference, RenderSettings};
use crate::snapshot::views::albedo_of;
use dpm_render::gpu::Gpu;
use dpm_render::scene_data::Keep;
use dpm_render::Renderer;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::shapes::*;
use dpm_scene::{Material, PunctualKind, Scene};
use glam::{DVec2, DVec3, Vec3};
use std::sync::Arc;

/// The cases.
pub(crate) const CASES: &[GpuCase] = &[
    GpuCase(
        "gpu-relit-by-lamps",
        "balls of every lobe alone and with others under a sun, a spot and a point light, method dpm",
        "f64 model: what histories are divided by is the light of the lamps and 5 % of the mean light",
        "relative",
        0.01,
        under_lamps,
    ),
    GpuCase(
        "gpu-relit-by-a-sky",
        "matte, rough metal, coated and glossy balls under an uneven sky, method dpm",
        "f64 tracer: the light by what histories are divided by is even, root mean square over a ball",
        "relative",
        0.3,
        under_a_sky,
    ),
];

/// Smaller divisors are not compared: 0.02 is the least.
const LEAST: f64 = 0.03;
/// The share of the mean light that arrives at every point at the least.
const LEAST_LIGHT: f64 = 0.05;
/// Balls in a row, and the distance between them.
const COLUMNS: usize = 10;
const APART: f32 = 4.0;

/// Balls of these looks in rows, and who looks at them from afar.
fn balls(looks: &[Material]) -> (Scene, ProjectorCamera, DVec3) {
    let mut scene = Scene::default();
    for (k, look) in looks.iter().enumerate() {
        let at = Vec3::new((k % COLUMNS) as f32, (k / COLUMNS) as f32, 0.0) * APART;
        add(&mut scene, sphere(at, 1.0, 3, true), look.clone());
    }
    let rows = looks.len().div_ceil(COLUMNS);
    let size = f64::from(APART) * COLUMNS.max(rows) as f64;
    let middle = DVec3::new(COLUMNS as f64 - 1.0, rows as f64 - 1.0, 0.0) * (0.5 * f64::from(APART));
    let mut camera = camera(160, 160, middle + DVec3::Z * 100.0, middle);
    (camera.fx, camera.fy) = (160.0 * 100.0 / size, 160.0 * 100.0 / size);
    (scene, camera, middle + DVec3::new(8.0, 5.0, 90.0))
}

/// What the histories of a frame are divided by, pixel by pixel; `None` where nothing is lit.
fn divisors(gpu: &Arc<Gpu>, scene: &Scene, camera: ProjectorCamera, eye: DVec3) -> Vec<Option<DVec3>> {
    let shot = Shot { eye: Some(eye), spp: 1, depth: 2, method: Some(dpm()), ..Shot::new(scene, camera) };
    let mut renderer =
        Renderer::keeping(gpu, scene, shot.settings(), Keep::default()).expect("the scene fits the GPU");
    let mut all = Vec::new();
    shot.play(
        &mut renderer,
        0..1,
        |_| shot.world_from_body(),
        |_, slot, _| {
            let (surfaces, guides) = (slot.surfaces().unwrap_or_default(), slot.guides().unwrap_or_default());
            let of = |i: usize| Vec3::from(albedo_of(&guides[i])).as_dvec3();
            all = (0..surfaces.len()).map(|i| surfaces[i].is_lit().then(|| of(i))).collect();
        },
    );
    all
}

/// The mean light by which what is divided by is made relative: that which fits `light` best.
fn mean_light(pairs: &[(DVec3, DVec3)]) -> f64 {
    let (mut ab, mut bb) = (0.0, 0.0);
    for &(divisor, light) in pairs {
        // Each pixel counts alike.
        let weight = 1.0 / light.length_squared();
        ab += weight * light.dot(divisor);
        bb += weight * divisor.dot(divisor);
    }
    ab / bb
}

/// A point of a scene as it scatters light toward the eye: the pixel's centre, if the normal there needs no bending.
fn scattering<'a>(
    tracer: &'a Reference<'_>,
    camera: &ProjectorCamera,
    eye: DVec3,
    i: usize,
) -> Option<(DVec3, Bsdf<'a>)> {
    let width = camera.raster.width() as usize;
    let ray = camera.ray(DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5));
    let point = tracer.trace(ray.origin, ray.direction, f64::INFINITY, true)?;
    let v = (eye - point.position).normalize();
    if point.shading.dot(v) < 0.1 || point.geometric.dot(v) < 0.1 {
        return None;
    }
    let bsdf = Bsdf::new(&point, tracer.table(point.look.material), v)?;
    Some((point.position, bsdf))
}

fn under_lamps(gpu: &Arc<Gpu>, _: u64) -> f64 {
    let opaque: Vec<Material> = looks().into_iter().filter(|m| m.transmission == 0.0).collect();
    let (mut scene, camera, eye) = balls(&opaque);
    // Where no lamp shines a share of the mean light is reflected. Under an even sky the divisor is the reflectance.
    scene.environment = sky(1.0);
    let reflectances = divisors(gpu, &scene, camera, eye);
    scene.environment = sky(0.0);
    let directed = |v: [f64; 3]| DVec3::from_array(v).normalize();
    let (sun, spot_at, point_at) =
        (directed([0.3, 0.8, 0.7]), DVec3::new(-5.0, 40.0, 60.0), DVec3::new(40.0, -6.0, 30.0));
    let (inner, outer) = (0.3f32, 0.6f32);
    let aim = (DVec3::new(18.0, 16.0, 0.0) - spot_at).normalize();
    let lamp = |kind, at: DVec3, to: DVec3, power| light(kind, at.as_vec3(), to.as_vec3(), power);
    scene.lights = vec![
        lamp(PunctualKind::Directional, DVec3::ZERO, -sun, 2.0),
        lamp(PunctualKind::Spot { inner, outer }, spot_at, aim, 6000.0),
        lamp(PunctualKind::Point, point_at, DVec3::Z, 3000.0),
    ];
    let divisors = divisors(gpu, &scene, camera, eye);
    let tracer = Reference::new(&scene, &[]);
    let falloff = |to: DVec3, power: f64| power / to.length_squared();
    let mut pairs = Vec::new();
    for (i, (divisor, reflectance)) in divisors.iter().zip(&reflectances).enumerate() {
        let (Some(divisor), Some(reflectance)) = (divisor, reflectance) else { continue };
        let Some((p, bsdf)) = scattering(&tracer, &camera, eye, i) else { continue };
        let (to_spot, to_point) = (spot_at - p, point_at - p);
        let cos = |angle: f32| f64::from(angle.cos());
        let beam = ((-to_spot.normalize().dot(aim) - cos(outer)) / (cos(inner) - cos(outer)).max(1e-3))
            .clamp(0.0, 1.0)
            .powi(2);
        let sent = bsdf.evaluate(sun).f_cos * 2.0
            + bsdf.evaluate(to_spot.normalize()).f_cos * (falloff(to_spot, 6000.0) * beam)
            + bsdf.evaluate(to_point.normalize()).f_cos * falloff(to_point, 3000.0);
        pairs.push((*divisor, *reflectance, sent));
    }
    if pairs.len() < 2000 {
        return f64::NAN;
    }
    // The mean light is not read back. Each round takes the share of it that is reflected from the last.
    let mut mean = 1.0;
    for _ in 0..8 {
        let of = |&(d, r, l): &(DVec3, DVec3, DVec3)| (d, l + r * (LEAST_LIGHT * mean));
        mean = mean_light(&pairs.iter().filter(|p| p.0.min_element() > LEAST).map(of).collect::<Vec<_>>());
    }
    let (mut worst, mut compared) = (0f64, 0);
    for &(divisor, reflectance, sent) in &pairs {
        for c in 0..3 {
            let wanted = sent[c] / mean + LEAST_LIGHT * reflectance[c];
            if wanted > LEAST {
                let apart = (divisor[c] / wanted - 1.0).abs();
                worst = if apart.is_nan() { f64::NAN } else { worst.max(apart) };
                compared += 1;
            }
        }
    }
    if compared < 4000 {
        return f64::NAN;
    }
    worst
}

fn under_a_sky(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let metal =
        |roughness| Material { roughness, base_color: Vec3::new(0.9, 0.6, 0.4), ..Material::default() };
    let glossy = Material { roughness: 0.4, ior: 1.5, ..diffuse(Vec3::new(0.6, 0.4, 0.2)) };
    let mut coated = metal(0.7);
    coated.lobes.coat = dpm_scene::lobes::Coat { factor: 1.0, roughness: 0.35, ..Default::default() };
    let looks = [diffuse(Vec3::new(0.9, 0.6, 0.3)), metal(0.45), metal(0.9), glossy, coated];
    let mut worst: f64 = 0.0;
    for look in looks {
        let mut scene = scene_of(sphere(Vec3::ZERO, 1.0, 4, true), look);
        scene.environment = image_sky(1.0);
        let (eye, camera) = (DVec3::new(0.5, 0.4, 5.0), camera(24, 20, DVec3::Z * 5.0, DVec3::ZERO));
        let divisors = divisors(gpu, &scene, camera, eye);
        let tracer = Reference::new(&scene, &[]);
        let settings = RenderSettings { spp: 512, depth: 2, seed, ..RenderSettings::default() };
        let light = tracer.render(&camera, eye, &settings);
        let known = |i: usize| {
            let divisor = divisors[i].filter(|_| light.lit[i])?;
            scattering(&tracer, &camera, eye, i).map(|_| (divisor, DVec3::from_array(light.mean[i])))
        };
        let pairs: Vec<(DVec3, DVec3)> = (0..divisors.len()).filter_map(known).collect();
        if pairs.len() < 100 {
            return f64::NAN;
        }
        let mean = mean_light(&pairs);
        let sum: f64 = pairs.iter().map(|(d, l)| (*d * mean / *l - 1.0).length_squared() / 3.0).sum();
        worst = worst.max((sum / pairs.len() as f64).sqrt());
    }
    worst
}
