//! Light transport on the GPU: closed forms, conservation, and lights and sizes at the edge of f32.

use super::estimate::{pooled, Estimate};
use super::gpu::GpuCase;
use super::gpu_compare::{compare, Rounding};
use super::gpu_shot::{Shot, ShotPicture};
use crate::reference::microfacet::fresnel_dielectric;
use dpm_render::gpu::Gpu;
use dpm_scene::shapes::*;
use dpm_scene::{Environment, Material, PunctualKind, PunctualLight, Scene};
use glam::{DAffine3, DQuat, DVec2, DVec3, Vec3};
use std::sync::Arc;

/// The cases.
pub(crate) const CASES: &[GpuCase] = &[
    GpuCase(
        "gpu-furnace-convex",
        "white Lambertian sphere in even light, 64 bounces, before a camera and in the rig",
        "closed form: 1 in every pixel, in the rig where the eye sees the sphere and 0 elsewhere",
        "radiance",
        2e-6,
        furnace_convex,
    ),
    GpuCase(
        "gpu-furnace-corner",
        "corner of three white walls in even light, 64 bounces",
        "closed form: mean 1",
        "sigma",
        4.0,
        furnace_corner,
    ),
    GpuCase(
        "gpu-closed-sphere",
        "albedo and emission 1/2 inside spheres of 1 mm to 10 km, up to 10 km off the origin, whole or cut into four bodies, depths of 1 to 12",
        "closed form: 1 - 2^-depth, every ray hits",
        "sigma",
        4.0,
        closed_sphere,
    ),
    GpuCase(
        "gpu-energy-of-every-lobe",
        "roughness 0 to 1; metal, coat, thin, solid; at all angles and at 89.99 deg",
        "albedo at most 1",
        "excess",
        2e-3,
        energy,
    ),
    GpuCase(
        "gpu-coated-diffuse-conserves",
        "white base under coats of ior 1.1, 1.5 and 2.4, roughness 0, 0.1 and 0.6",
        "closed form: albedo 1",
        "albedo",
        2e-3,
        coated,
    ),
    GpuCase(
        "gpu-single-scatter-loss",
        "white rough metal, alpha 0.25, 0.5, 1",
        "albedo 0.882, 0.700, 0.409 on average",
        "albedo",
        4e-3,
        single_scatter,
    ),
    GpuCase(
        "gpu-fresnel",
        "mirror-like dielectric of index 1, 1 + 1e-7, 1.1, 1.5, 2.4 at 5 to 88 deg",
        "Fresnel's equations",
        "reflectance",
        1e-3,
        fresnel,
    ),
    GpuCase(
        "gpu-index-near-one",
        "clear slab of index 1, 1 + 1e-7, 1.0005, 1.002 in even light",
        "closed form: 1, continuous",
        "radiance",
        2e-3,
        near_one,
    ),
    GpuCase(
        "gpu-clear-glass",
        "clear slabs of index 1.0005, 1.5 and 2.4 in even light: solid or thin-walled, smooth or of roughness 0.6",
        "closed form: 1, to 1e-4 where solid and smooth, else to the 4e-3 of the albedo table",
        "ratio",
        1.0,
        clear_glass,
    ),
    GpuCase(
        "gpu-sphere-light-form-factor",
        "sphere light over a floor",
        "closed form: E = pi L (r / h)^2",
        "relative",
        1.5e-2,
        form_factor,
    ),
    GpuCase(
        "gpu-scale-and-place",
        "a scene at 2^-13 to 2^13 of its size, and 2.3 km off the origin, also at 1/1000 of its size",
        "same image",
        "relative",
        1e-2,
        scale_and_place,
    ),
    GpuCase(
        "gpu-far-from-origin",
        "bodies, projector and eye moved 1e5 m by their poses",
        "same image",
        "relative",
        1e-2,
        far_from_origin,
    ),
    GpuCase(
        "gpu-lights-that-touch",
        "lamp 1 mm over the surface, in the surface, point lights 0 and 10 um over it",
        "f64 reference: pixels beyond 4 sigma by those allowed",
        "ratio",
        1.0,
        touching_lights,
    ),
    GpuCase(
        "gpu-sun-and-lamp",
        "sun of 1e5, lamp of 1e-3 on one floor",
        "closed form, sun alone and lamp alone",
        "relative",
        2e-2,
        sun_and_lamp,
    ),
    GpuCase(
        "gpu-no-light",
        "no light, black lights, a black texture, a black sky",
        "all 0",
        "radiance",
        0.0,
        no_light,
    ),
    GpuCase(
        "gpu-many-lights",
        "100,000 point lights, a fifth of them black",
        "closed form: sum",
        "sigma",
        4.0,
        many_lights,
    ),
    GpuCase(
        "gpu-extreme-radiance",
        "emission 0, 1e-40, 3e38 under every method",
        "finite or at full code; black is black",
        "faults",
        0.0,
        extreme_radiance,
    ),
    GpuCase(
        "gpu-firefly-limit",
        "limits of 0.002, 0.02 and 1e30",
        "the rest is below the limit; the limit removes and counts light, and never adds any; a limit out of reach changes nothing",
        "faults",
        0.0,
        firefly_limit,
    ),
];

fn furnace(material: Material, level: u32) -> Scene {
    let mut scene = scene_of(sphere(Vec3::ZERO, 1.0, level, false), material);
    scene.environment = sky(1.0);
    scene
}

fn furnace_convex(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let scene = furnace(diffuse(Vec3::ONE), 2);
    let camera = camera(48, 36, DVec3::new(0.0, 0.0, 5.0), DVec3::ZERO);
    let shot = Shot { depth: 64, seed: seed as u32, ..Shot::new(&scene, camera) };
    let seen = shot.draw(gpu);
    let rig = Shot { eye: Some(DVec3::new(2.0, 1.0, 5.0)), ..shot }.draw(gpu);
    let count = |p: &ShotPicture, of: fn(&ShotPicture, usize) -> bool| {
        (0..p.surfaces.len()).filter(|&i| of(p, i)).count()
    };
    let (hits, lit) = (count(&seen, ShotPicture::hit), count(&rig, ShotPicture::lit));
    let counted = rig.counters[0].lit_pixels as usize == lit;
    if hits < 200
        || !(100..hits).contains(&lit)
        || !counted
        || seen.invalid_samples() + rig.invalid_samples() > 0
    {
        return f64::NAN;
    }
    let off = |e: &Estimate, expected: f64| e.mean.iter().map(|m| (m - expected).abs()).fold(0.0, f64::max);
    let before_camera = seen.estimates.iter().map(|e| off(e, 1.0));
    let in_rig = rig.estimates.iter().enumerate().map(|(i, e)| off(e, if rig.lit(i) { 1.0 } else { 0.0 }));
    before_camera.chain(in_rig).fold(0.0, f64::max)
}

fn furnace_corner(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut scene = scene_of(floor(1.0, 0.0), diffuse(Vec3::ONE));
    let walls = [Vec3::X * 2.0, Vec3::NEG_Z * 2.0];
    for (corner, along) in [Vec3::new(-1.0, 0.0, -1.0), Vec3::new(-1.0, 0.0, 1.0)].into_iter().zip(walls) {
        add(&mut scene, quad(corner, along, Vec3::Y * 2.0), diffuse(Vec3::ONE));
    }
    scene.environment = sky(1.0);
    let camera = camera(32, 24, DVec3::new(4.0, 5.0, 6.0), DVec3::new(-0.5, 0.5, -0.5));
    let shot = Shot { spp: 32, frames: 8, depth: 64, seed: seed as u32, ..Shot::new(&scene, camera) };
    let (mean, sigma) = pooled(&shot.draw(gpu).estimates, 0);
    ((mean - 1.0).abs() - 1e-6).max(0.0) / sigma
}

/// What shines as brightly as half of what it reflects: inside a closed space of it the radiance is `1 - 2^-depth`.
fn half_lamp() -> Material {
    Material { emissive: Vec3::splat(0.5), double_sided: true, ..diffuse(Vec3::splat(0.5)) }
}

/// Sigmas between what is seen inside a closed space of [`half_lamp`] and its closed form; infinite where a ray gets out.
fn off_closed(gpu: &Arc<Gpu>, shot: &Shot) -> f64 {
    let picture = shot.draw(gpu);
    if picture.invalid_samples() > 0 || (0..picture.surfaces.len()).any(|i| !picture.hit(i)) {
        return f64::INFINITY;
    }
    let (mean, sigma) = pooled(&picture.estimates, 1);
    // Emission alone has no noise.
    ((mean - (1.0 - 0.5f64.powi(shot.depth as i32))).abs() - 1e-6).max(0.0) / sigma.max(1e-9)
}

fn closed_sphere(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let seed = seed as u32;
    let mut worst: f64 = 0.0;
    for (radius, distance) in [(1e-3f32, 0.0), (1e-3, 1e4), (1.0, 0.0), (1.0, 1e4), (1e4, 0.0), (1e4, 1e4)] {
        // Baked at the origin; moved and turned by its pose, as the tracker does.
        let scene = scene_of(sphere(Vec3::ZERO, radius, 2, true), half_lamp());
        let centre = DVec3::new(0.6, -0.48, 0.64) * distance;
        let turn = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, 1.1, -0.7);
        let inside = |v: DVec3| centre + v * f64::from(radius);
        let camera = camera(24, 24, inside(DVec3::new(0.31, -0.2, 0.11)), inside(DVec3::new(-0.1, 0.9, 0.3)));
        let poses = vec![DAffine3::from_rotation_translation(turn, centre)];
        let shot = Shot { frames: 8, depth: 10, poses, seed, ..Shot::new(&scene, camera) };
        worst = worst.max(off_closed(gpu, &shot));
    }
    let scene = scene_of(sphere(Vec3::ZERO, 2.0, 1, false), half_lamp());
    let camera = camera(32, 24, DVec3::new(0.3, -0.2, 0.1), DVec3::NEG_Z);
    for depth in [1, 2, 3, 12] {
        worst = worst.max(off_closed(gpu, &Shot { frames: 8, depth, seed, ..Shot::new(&scene, camera) }));
    }
    worst.max(cut_sphere(gpu, seed))
}

/// A closed sphere that is cut into four bodies, whose seams meet in world space only.
fn cut_sphere(gpu: &Arc<Gpu>, seed: u32) -> f64 {
    let whole = sphere(Vec3::ZERO, 1.0, 2, true);
    let mut scene = Scene::default();
    for part in whole.triangles.chunks(whole.triangles.len() / 4) {
        let mut mesh = whole.clone();
        mesh.triangles = part.to_vec();
        add(&mut scene, mesh, half_lamp());
    }
    let pose = DAffine3::from_rotation_translation(DQuat::from_rotation_x(0.4), DVec3::new(0.2, 0.1, -0.3));
    let poses = vec![pose; scene.bodies.len()];
    let camera = camera(32, 24, DVec3::new(0.1, 0.2, 0.1), DVec3::NEG_Z);
    off_closed(gpu, &Shot { frames: 8, depth: 8, poses, seed, ..Shot::new(&scene, camera) })
}

fn energy(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let looks = [
        (0.0, 0.0, true),
        (1.0, 0.0, true),
        (0.0, 1.0, true),
        (0.0, 1.0, false),
        (0.5, 0.5, false),
        (0.3, 0.5, true),
    ];
    let mut worst: f64 = 0.0;
    for roughness in [0.0, 1e-4, 1e-3, 0.0317, 0.5, 1.0] {
        for (metallic, transmission, thin_walled) in looks {
            let m = Material { roughness, metallic, transmission, thin_walled, ..Material::default() };
            let round = furnace(m.clone(), 2);
            let mut flat = scene_of(floor(1.0, 0.0), m);
            flat.environment = sky(1.0);
            let grazing = camera(8, 8, DVec3::new(0.0, 2.0 * 1.745e-4, 2.0), DVec3::ZERO);
            for (scene, camera) in
                [(&round, camera(16, 16, DVec3::new(0.0, 0.0, 5.0), DVec3::ZERO)), (&flat, grazing)]
            {
                let shot = Shot { frames: 6, depth: 16, seed: seed as u32, ..Shot::new(scene, camera) };
                let picture = shot.draw(gpu);
                let bad = |m: f64| !(m.is_finite() && m >= 0.0);
                if picture.invalid_samples() > 0
                    || picture.estimates.iter().any(|e| e.mean.into_iter().any(bad))
                {
                    return f64::INFINITY;
                }
                let hit =
                    (0..picture.surfaces.len()).filter(|&i| picture.hit(i)).map(|i| &picture.estimates[i]);
                let (mean, sigma) = pooled(hit, 0);
                if mean < 0.1 {
                    // Black creates no energy either.
                    return f64::INFINITY;
                }
                worst = worst.max(mean - 1.0 - 4.0 * sigma);
            }
        }
    }
    worst
}

fn coated(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for ior in [1.1, 1.5, 2.4] {
        for roughness in [0.0, 0.1, 0.6] {
            let scene = furnace(Material { ior, roughness, ..diffuse(Vec3::ONE) }, 2);
            let camera = camera(32, 32, DVec3::new(0.0, 0.0, 5.0), DVec3::ZERO);
            let shot = Shot { spp: 64, frames: 8, depth: 2, seed: seed as u32, ..Shot::new(&scene, camera) };
            let (mean, sigma) = pooled(shot.draw(gpu).lit_estimates().collect::<Vec<_>>(), 1);
            if sigma > 2e-3 {
                return f64::NAN;
            }
            worst = worst.max((mean - 1.0).abs() - 4.0 * sigma);
        }
    }
    worst.max(0.0)
}

fn single_scatter(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    // A distant sphere in parallel projection shows every cosine mu with weight 2 mu: its mean is the average albedo.
    let mut worst: f64 = 0.0;
    for (alpha, expected) in [(0.25f32, 0.882), (0.5, 0.700), (1.0, 0.409)] {
        let scene = furnace(Material { roughness: alpha.sqrt(), ..Material::default() }, 4);
        let mut camera = camera(40, 40, DVec3::new(0.0, 0.0, 2000.0), DVec3::ZERO);
        (camera.fx, camera.fy) = (2000.0 * 19.0, 2000.0 * 19.0);
        let shot = Shot { spp: 48, frames: 8, depth: 2, seed: seed as u32, ..Shot::new(&scene, camera) };
        let (mean, sigma) = pooled(shot.draw(gpu).lit_estimates().collect::<Vec<_>>(), 2);
        worst = worst.max((mean - expected).abs() - 4.0 * sigma);
    }
    worst.max(0.0)
}

fn fresnel(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for ior in [1.0f32, 1.0 + 1e-7, 1.1, 1.5, 2.4] {
        let black = Material { roughness: 0.0, ior, ..diffuse(Vec3::ZERO) };
        let mut scene = scene_of(floor(500.0, 0.0), black);
        scene.environment = sky(1.0);
        for height in [8.0, 1.0, 0.1] {
            let camera = camera(16, 16, DVec3::new(0.0, height, 2.0), DVec3::ZERO);
            let shot = Shot { spp: 64, frames: 8, depth: 3, seed: seed as u32, ..Shot::new(&scene, camera) };
            let picture = shot.draw(gpu);
            let (mut truth, mut n) = (0.0, 0.0);
            for i in (0..picture.surfaces.len()).filter(|&i| picture.hit(i)) {
                let at = DVec2::new((i % 16) as f64 + 0.5, (i / 16) as f64 + 0.5);
                truth += fresnel_dielectric(f64::from(ior), camera.ray(at).direction.y.abs());
                n += 1.0;
            }
            let hit = (0..picture.surfaces.len()).filter(|&i| picture.hit(i)).map(|i| &picture.estimates[i]);
            let (mean, sigma) = pooled(hit, 1);
            worst = worst.max((mean - truth / n).abs() - 4.0 * sigma);
        }
    }
    worst.max(0.0)
}

fn near_one(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for ior in [1.0f32, 1.0 + 1e-7, 1.0005, 1.002] {
        let scene = clear_slab(ior, 0.0, false);
        let camera = camera(16, 16, DVec3::new(0.0, 3.0, 5.0), DVec3::ZERO);
        let shot = Shot { spp: 32, frames: 8, depth: 16, seed: seed as u32, ..Shot::new(&scene, camera) };
        let (mean, sigma) = pooled(shot.draw(gpu).lit_estimates().collect::<Vec<_>>(), 0);
        worst = worst.max((mean - 1.0).abs() - 4.0 * sigma);
    }
    worst.max(0.0)
}

fn clear_glass(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for (thin_walled, ior, roughness) in [
        (false, 1.5, 0.0),
        (false, 2.4, 0.0),
        (true, 1.5, 0.0),
        (false, 1.0005, 0.0),
        (true, 1.5, 0.6),
        (false, 1.0005, 0.6),
    ] {
        let scene = clear_slab(ior, roughness, thin_walled);
        let camera = camera(24, 24, DVec3::new(0.0, 3.0, 5.0), DVec3::ZERO);
        let shot = Shot { spp: 64, frames: 8, depth: 32, seed: seed as u32, ..Shot::new(&scene, camera) };
        let (mean, sigma) = pooled(shot.draw(gpu).lit_estimates().collect::<Vec<_>>(), 0);
        if sigma > 5e-3 {
            return f64::NAN;
        }
        // A thin wall takes its reflection from the table, and there are two of them.
        let tolerance = if thin_walled || roughness > 0.0 { 4e-3 } else { 1e-4 };
        worst = worst.max(((mean - 1.0).abs() - 4.0 * sigma) / tolerance);
    }
    worst.max(0.0)
}

fn form_factor(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let (radius, height, albedo) = (0.5f32, 1.5f32, 0.5f32);
    let mut scene = scene_of(floor(4.0, 0.0), diffuse(Vec3::splat(albedo)));
    let ball = sphere(Vec3::new(0.0, height, 0.0), radius, 3, true);
    add(&mut scene, ball, emitter(Vec3::splat(2.0)));
    let mut c = camera(6, 6, DVec3::new(3.0, 0.6, 0.0), DVec3::ZERO);
    (c.fx, c.fy) = (1e6, 1e6);
    // Half of the light samples choose a triangle that faces away: a quarter of a percent is left of the noise.
    let shot = Shot { spp: 512, frames: 48, depth: 2, seed: seed as u32, ..Shot::new(&scene, c) };
    let (mean, _) = pooled(&shot.draw(gpu).estimates, 0);
    (mean / (f64::from(albedo) * 2.0 * f64::from(radius / height).powi(2)) - 1.0).abs()
}

/// A table with a ball, a lamp and a light, all lengths times `scale`.
pub(crate) fn still_life(scale: f32) -> Scene {
    let mut scene = scene_of(floor(scale, 0.0), diffuse(Vec3::new(0.7, 0.5, 0.4)));
    let ball = sphere(Vec3::Y * 0.45 * scale, 0.4 * scale, 2, true);
    add(&mut scene, ball, Material { roughness: 0.4, ..diffuse(Vec3::new(0.3, 0.5, 0.8)) });
    let lamp = quad(Vec3::new(-0.2, 1.5, -0.2) * scale, Vec3::X * 0.4 * scale, Vec3::Z * 0.4 * scale);
    add(&mut scene, lamp, emitter(Vec3::splat(4.0)));
    scene.lights.push(PunctualLight {
        body: Some(0),
        range: 10.0 * scale,
        ..point_light(Vec3::new(0.8, 1.0, 0.4) * scale, 0.6 * scale * scale)
    });
    scene
}

/// Means of the still life's channels at a size and a place, and how many pixels are lit.
fn still_life_means(gpu: &Arc<Gpu>, seed: u64, scale: f64, offset: DVec3) -> Option<([f64; 3], Vec<bool>)> {
    let scene = still_life(scale as f32);
    let mut camera = camera(40, 30, DVec3::new(0.3, 1.6, 2.4) * scale, DVec3::ZERO);
    camera.world_from_projector.translation += offset;
    let eye = Some(DVec3::new(-0.7, 1.4, 2.1) * scale + offset);
    let poses = vec![DAffine3::from_translation(offset); 3];
    let shot = Shot { eye, poses, frames: 8, seed: seed as u32, ..Shot::new(&scene, camera) };
    let picture = shot.draw(gpu);
    let lit = (0..picture.surfaces.len()).map(|i| picture.lit(i)).collect();
    let mean = |c| pooled(picture.lit_estimates().collect::<Vec<_>>(), c).0;
    (picture.invalid_samples() == 0).then(|| ([0, 1, 2].map(mean), lit))
}

/// Largest relative change of a mean or of the set of lit pixels (as a tenth of its share) against the plain still life.
fn changes(gpu: &Arc<Gpu>, seed: u64, others: &[(f64, DVec3)]) -> f64 {
    let Some((plain, plain_lit)) = still_life_means(gpu, seed, 1.0, DVec3::ZERO) else { return f64::NAN };
    let all = plain_lit.iter().filter(|l| **l).count();
    if all < 400 {
        return f64::NAN;
    }
    let mut worst: f64 = 0.0;
    for &(scale, offset) in others {
        let Some((means, lit)) = still_life_means(gpu, seed, scale, offset) else { return f64::INFINITY };
        let changed = lit.iter().zip(&plain_lit).filter(|(a, b)| a != b).count();
        worst = worst.max(changed as f64 / all as f64);
        worst = (0..3).map(|c| (means[c] / plain[c] - 1.0).abs()).fold(worst, f64::max);
    }
    worst
}

fn scale_and_place(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    // Powers of two scale without rounding; millimetre detail (2^-10) kilometres away.
    let far = DVec3::new(1024.0, -512.0, 2048.0);
    changes(
        gpu,
        seed,
        &[(2f64.powi(-13), DVec3::ZERO), (2f64.powi(13), DVec3::ZERO), (1.0, far), (2f64.powi(-10), far)],
    )
}

fn far_from_origin(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    changes(gpu, seed, &[(1.0, DVec3::new(1e5, -3e4, 7e4)), (1e-2, DVec3::new(-1e5, 1e5, 1e5))])
}

fn touching_lights(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut scene = scene_of(floor(1.0, 0.0), diffuse(Vec3::splat(0.6)));
    let lamp = quad(Vec3::new(-0.3, 1e-3, -0.3), Vec3::X * 0.6, Vec3::Z * 0.6);
    add(&mut scene, lamp, Material { double_sided: true, ..emitter(Vec3::splat(1.0)) });
    add(&mut scene, floor(0.15, 0.0), emitter(Vec3::splat(1.0)));
    scene.lights.extend([0.0, 1e-5].map(|height| point_light(Vec3::new(0.7, height, 0.5), 0.05)));
    scene.environment = sky(0.3);
    let camera = camera(32, 24, DVec3::new(0.9, 1.2, 1.9), DVec3::ZERO);
    let shot = Shot { spp: 32, frames: 128, seed: seed as u32, ..Shot::new(&scene, camera) };
    let c = compare(gpu, &shot, 2048);
    let e = c.explained();
    if c.picture.estimates.iter().any(|e| e.mean.iter().any(|m| !m.is_finite()))
        || c.reference.dropped_samples > 0
    {
        return f64::INFINITY;
    }
    let allowed = f64::max(2e-3 * e.values, 3.0);
    (e.beyond.len() as f64 / allowed).max(c.different_share() / 1e-2).max(e.exact)
}

fn sun_and_lamp(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let albedo = 0.5;
    let mean = |sun: f32, lamp: f32| {
        let mut scene = scene_of(floor(200.0, 0.0), diffuse(Vec3::splat(albedo)));
        // A lamp so wide and near that it fills the sky, and lets the sun pass: it shines down and is seen from below only, 1 m up.
        add(
            &mut scene,
            quad(Vec3::new(-90.0, 1.0, -90.0), Vec3::X * 180.0, Vec3::Z * 180.0),
            emitter(Vec3::splat(lamp)),
        );
        let kind = PunctualKind::Directional;
        // The sun comes from below the lamp's edge: 0.2 up from the horizon it would be blocked, so it stands beside the lamp.
        scene.lights.push(PunctualLight {
            kind,
            direction: Vec3::new(0.0, -0.005, -1.0).normalize(),
            ..point_light(Vec3::ZERO, sun)
        });
        let mut c = camera(8, 8, DVec3::new(0.0, 0.5, 0.0), DVec3::ZERO);
        (c.fx, c.fy) = (1e6, 1e6);
        let shot = Shot { spp: 64, frames: 8, depth: 2, seed: seed as u32, ..Shot::new(&scene, c) };
        pooled(&shot.draw(gpu).estimates, 0).0
    };
    // The lamp's edge is 90 m away and 1 m up: from below it covers the sky but for its last (1 / 90)^2. The sun's ray leaves under it.
    let cos = 0.005 / (1.0f64 + 0.005 * 0.005).sqrt();
    let sun = f64::from(albedo) / std::f64::consts::PI * 1e5 * cos;
    let lamp = f64::from(albedo) * 1e-3;
    let (both, lamp_alone) = (mean(1e5, 1e-3), mean(0.0, 1e-3));
    (both / (sun + lamp) - 1.0).abs().max((lamp_alone / lamp - 1.0).abs())
}

fn no_light(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let camera = camera(32, 24, DVec3::new(0.3, 1.6, 2.4), DVec3::ZERO);
    let mut dark = still_life(1.0);
    dark.lights.clear();
    dark.materials[2].emissive = Vec3::ZERO;
    let mut black = dark.clone();
    black.environment =
        Environment::Equirect { width: 4, height: 2, texels: vec![Vec3::ZERO; 8], rotation_rad: 0.0 };
    black.lights.extend([0.0, 0.0].map(|intensity| point_light(Vec3::Y, intensity)));
    // A lamp whose texture is black everywhere.
    black.materials[2].emissive = Vec3::ONE;
    black.materials[2].emissive_texture = use_texture(&mut black, noise_texture(4, 1, 0, 0, true));
    let mut sum = 0.0;
    for scene in [&dark, &black] {
        let picture = Shot { seed: seed as u32, ..Shot::new(scene, camera) }.draw(gpu);
        sum += picture.estimates.iter().flat_map(|e| e.mean).map(f64::abs).sum::<f64>();
        sum += f64::from(picture.invalid_samples());
    }
    sum
}

fn many_lights(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let (scene, want) = floor_under_many_lights(seed);
    let mut c = camera(8, 8, DVec3::new(0.0, 4.0, 0.0), DVec3::ZERO);
    (c.fx, c.fy) = (1e6, 1e6);
    let shot = Shot { spp: 64, frames: 16, depth: 2, seed: seed as u32, ..Shot::new(&scene, c) };
    let (mean, sigma) = pooled(&shot.draw(gpu).estimates, 0);
    (mean - want).abs() / sigma
}

fn extreme_radiance(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut faults = 0u32;
    for method in super::gpu_history::methods() {
        for radiance in [0.0f32, 1e-40, 3e38] {
            let mut scene = scene_of(floor(1.0, 0.0), diffuse(Vec3::splat(0.5)));
            let lamp = quad(Vec3::new(-0.3, 0.6, -0.3), Vec3::X * 0.6, Vec3::Z * 0.6);
            add(&mut scene, lamp, Material { double_sided: true, ..emitter(Vec3::splat(radiance)) });
            let camera = camera(20, 18, DVec3::new(0.3, 1.6, 2.4), DVec3::ZERO);
            let eye = Some(DVec3::new(-0.4, 1.5, 2.2));
            let shot = Shot {
                eye,
                spp: 4,
                frames: 6,
                seed: seed as u32,
                method: Some(method.clone()),
                ..Shot::new(&scene, camera)
            };
            let picture = shot.draw(gpu);
            let lamp_pixels =
                (0..picture.surfaces.len()).filter(|&i| picture.lit(i) && picture.surfaces[i].id >> 24 == 1);
            for i in lamp_pixels {
                // What is far too bright is shown at the full code, what is far too dark as black.
                let wanted = if radiance > 1.0 { 0x00ff_ffff } else { 0 };
                faults += u32::from(picture.codes[i] != wanted);
            }
            faults += picture.radiance.iter().flatten().filter(|v| v.is_nan() || **v < 0.0).count() as u32;
            let dark = (0..picture.surfaces.len()).filter(|&i| !picture.lit(i));
            faults += dark.filter(|&i| picture.codes[i] != 0).count() as u32;
        }
    }
    f64::from(faults)
}

fn firefly_limit(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let scene = still_life(1.0);
    let camera = camera(32, 24, DVec3::new(0.3, 1.6, 2.4), DVec3::ZERO);
    let shot = Shot { spp: 32, depth: 5, seed: seed as u32, ..Shot::new(&scene, camera) };
    let draw = |depth, limit| Shot { depth, clamp_indirect: limit, ..shot.clone() }.draw(gpu);
    let (free, tight, loose) = (draw(5, None), draw(5, Some(0.02)), draw(5, Some(1e30)));
    // A limit is another program.
    let rounding = Rounding::of(gpu);
    let few = rounding.few_of(free.radiance.len()) as u32;
    let others = |a: &ShotPicture, b: &ShotPicture| {
        (rounding.different(&a.radiance, &b.radiance) as u32).saturating_sub(few)
    };
    let mut faults = others(&free, &loose);
    faults += free.counters[0].clamped_samples + loose.counters[0].clamped_samples;
    faults += u32::from(tight.counters[0].clamped_samples <= 100);
    let added = |(a, b): &(&Estimate, &Estimate)| a.mean[1] > b.mean[1] + 1e-6 + rounding.of_value(b.mean[1]);
    faults += (tight.estimates.iter().zip(&free.estimates).filter(added).count() as u32).saturating_sub(few);
    // Of paths that end at their third vertex a sample of a light and a hit are indirect, neither beyond the limit; without one some are.
    let (two, three, beyond) = (draw(2, None), draw(3, Some(0.002)), draw(3, None));
    let luminance = |m: &[f64; 3]| 0.2126 * m[0] + 0.7152 * m[1] + 0.0722 * m[2];
    let over = |p: &ShotPicture| {
        let pairs = p.estimates.iter().zip(&two.estimates);
        let most = |b: &Estimate| 2.0 * 0.002 + 1e-5 + rounding.of_value(luminance(&b.mean));
        pairs.filter(|(a, b)| luminance(&a.mean) - luminance(&b.mean) > most(b)).count() as u32
    };
    faults += over(&three).saturating_sub(few) + u32::from(over(&beyond) < 10 + few);
    // Direct light is never limited.
    let (direct, limited) = (draw(2, None), draw(2, Some(1e-6)));
    faults += others(&direct, &limited);
    f64::from(faults)
}
