//! Rays against triangles on the GPU: what rounding, odd shapes and deep trees must not change; and the random numbers that aim them.

use super::gpu::GpuCase;
use super::gpu_compare::compare;
use super::gpu_history::methods;
use super::gpu_shot::{Shot, ShotPicture};
use super::gpu_tracer::still_life;
use crate::reference::Sampler;
use dpm_render::gpu::Gpu;
use dpm_render::{Keep, RenderError, Renderer};
use dpm_scene::shapes::*;
use dpm_scene::{Material, Scene, TriangleMesh};
use glam::{DAffine3, DMat3, DVec3, Vec3};
use std::sync::Arc;

/// The cases.
pub(crate) const CASES: &[GpuCase] = &[
    GpuCase("gpu-axis-parallel-rays", "rays along all axes, in the planes of seams and through vertices, at distances that round differently", "every ray hits at its closed form", "faults", 0.0, axis_parallel),
    GpuCase("gpu-needles-and-zero-areas", "points, lines, needles of 1e-20 and twins in a closed mesh", "the picture without them", "radiance", 1e-5, needles),
    GpuCase("gpu-watertight", "a million rays inside a closed mesh 80 m off its origin under a bright sky", "none gets out", "share", 0.0, watertight),
    GpuCase("gpu-leaves-no-light-through", "a bright lamp inside a closed sphere of 1 mm to 10 km, seen from outside", "black", "radiance", 0.0, opaque),
    GpuCase("gpu-hierarchy-sizes", "0, 1, 2, 3, 1,000, 50,000 triangles; 3,000 of one centroid", "f64 reference: pixels that see another surface", "share", 5e-3, hierarchy_sizes),
    GpuCase("gpu-hierarchy-depth", "129 triangles at distances that double: chains deeper than the traversal stack", "closed form distance of the one in front", "faults", 0.0, hierarchy_depth),
    GpuCase("gpu-hierarchy-heaps", "140 heaps of 12 twins, each 1.3 times the one before: a heap waits on every level of a tree by area", "closed form: the one triangle on the axis is hit, in whichever heap it is", "faults", 0.0, heaps_in_a_chain),
    GpuCase("gpu-unusable-coordinates", "vertices at NaN, infinity and 1e7 m", "refused by name, nothing drawn", "faults", 0.0, unusable),
    GpuCase("gpu-random-streams", "neighbouring pixels, frames, seeds, and frames about 2^32", "correlation", "sigma", 5.0, streams),
    GpuCase("gpu-same-seed-same-bits", "every method twice, eight frames", "bit for bit", "values", 0.0, same_bits),
];

/// A floor of `n` x `n` squares of side `side` whose seams lie on round numbers, about the origin.
fn grid(n: i32, side: f32) -> TriangleMesh {
    let at = |i: i32, k: i32| Vec3::new((i - n / 2) as f32 * side, 0.0, (k - n / 2) as f32 * side);
    let positions: Vec<Vec3> = (0..=n).flat_map(|k| (0..=n).map(move |i| at(i, k))).collect();
    let index = |i: i32, k: i32| (k * (n + 1) + i) as u32;
    let triangles = (0..n)
        .flat_map(|k| (0..n).map(move |i| (i, k)))
        .flat_map(|(i, k)| {
            let [a, b, c, d] = [index(i, k), index(i, k + 1), index(i + 1, k + 1), index(i + 1, k)];
            [[a, b, c], [a, c, d]]
        })
        .collect();
    let normals = vec![Vec3::Y; positions.len()];
    mesh(positions, normals, triangles)
}

fn axis_parallel(gpu: &Arc<Gpu>, _: u64) -> f64 {
    // The middle column and row of an odd raster run exactly in the planes of the seams; the middle ray hits a vertex.
    let axes = [DVec3::X, DVec3::Y, DVec3::Z, DVec3::NEG_X, DVec3::NEG_Y, DVec3::NEG_Z];
    let mut scene = scene_of(grid(16, 0.25), Material { double_sided: true, ..diffuse(Vec3::ONE) });
    scene.environment = sky(1.0);
    let mut faults = 0usize;
    for (k, &axis) in axes.iter().enumerate() {
        for distance in [0.375, 3.0, 5.9] {
            // The floor's normal turned to the axis by a matrix of zeros and ones.
            let side = axes[(k + 1) % 3].abs();
            let poses = vec![DAffine3::from_mat3(DMat3::from_cols(side, axis, side.cross(axis)))];
            let camera = camera(33, 33, axis * distance, DVec3::ZERO);
            let picture = Shot { poses, spp: 4, depth: 2, ..Shot::new(&scene, camera) }.draw(gpu);
            faults += (0..33 * 33).filter(|&i| !picture.hit(i)).count();
            faults += picture.estimates.iter().filter(|e| (e.mean[0] - 1.0).abs() >= 2e-6).count();
            let middle = f64::from(picture.surfaces[16 * 33 + 16].distance);
            faults += usize::from((middle / distance - 1.0).abs() >= 1e-6);
        }
    }
    faults as f64
}

fn needles(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let plain = sphere(Vec3::ZERO, 0.5, 2, true);
    let corners = plain.triangles[7].map(|i| plain.positions[i as usize]);
    let extra = [
        [corners[0]; 3],
        [corners[0], corners[1], corners[0].lerp(corners[1], 0.5)],
        [corners[0], corners[0], corners[2]],
        corners,
        corners,
        [Vec3::ZERO, Vec3::splat(1e-20), Vec3::new(1e-20, 0.0, 0.0)],
    ];
    let mut odd = extra.into_iter().fold(plain.clone(), |all, t| join([all, triangle(t)]));
    // Twins carry the sphere's own normals: whichever is hit, it looks the same.
    let n = odd.triangles.len();
    for twin in [n - 3, n - 2] {
        odd.triangles[twin] = plain.triangles[7];
    }
    let camera = camera(48, 36, DVec3::new(0.3, 0.4, 2.0), DVec3::ZERO);
    let draw = |mesh: TriangleMesh| {
        let mut scene = scene_of(mesh, diffuse(Vec3::splat(0.6)));
        scene.environment = sky(1.0);
        Shot { spp: 8, seed: seed as u32, ..Shot::new(&scene, camera) }.draw(gpu)
    };
    let (a, b) = (draw(plain), draw(odd));
    let surfaces_differ = (0..a.surfaces.len()).any(|i| a.hit(i) != b.hit(i));
    if surfaces_differ || b.invalid_samples() > 0 {
        return f64::INFINITY;
    }
    let worst = a.estimates.iter().zip(&b.estimates).map(|(x, y)| (x.mean[0] - y.mean[0]).abs());
    worst.fold(0.0, |a, d| if d.is_nan() { f64::INFINITY } else { a.max(d) })
}

fn watertight(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    // Emission would hide a leak; a sky of 1e6 shows one path in a million. Every path bounces until the roulette or depth 64 ends it.
    let centre = Vec3::new(40.0, -70.0, 12.0);
    let white = Material { double_sided: true, ..diffuse(Vec3::splat(0.9)) };
    let mut scene = scene_of(sphere(centre, 1.0, 3, true), white);
    scene.environment = sky(1e6);
    let at = |v: DVec3| centre.as_dvec3() + v;
    let camera = camera(48, 48, at(DVec3::new(0.3, -0.2, 0.1)), at(DVec3::new(-0.5, 0.2, 0.9)));
    let shot = Shot { spp: 16, frames: 4, depth: 64, seed: seed as u32, ..Shot::new(&scene, camera) };
    let picture = shot.draw(gpu);
    let rays = picture.rays();
    if rays < 1_000_000 {
        return f64::NAN;
    }
    let leaks = picture.estimates.iter().filter(|e| e.mean.iter().any(|m| *m != 0.0)).count();
    leaks as f64 / rays as f64
}

fn opaque(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for (radius, distance) in [(1e-3f32, 1.0f64), (1.0, 1e3), (1e4, 1e5)] {
        let (scene, camera) = lamp_in_a_sphere(radius, distance);
        let picture = Shot { depth: 6, seed: seed as u32, ..Shot::new(&scene, camera) }.draw(gpu);
        if picture.lit_estimates().count() <= 300 {
            return f64::NAN;
        }
        worst = picture.estimates.iter().flat_map(|e| e.mean).fold(worst, |a, m| a.max(m.abs()));
    }
    worst
}

fn hierarchy_sizes(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut s = Sampler::new(seed, 0);
    let mut point = |size: f32| {
        Vec3::new(s.uniform() as f32 - 0.5, s.uniform() as f32 - 0.5, s.uniform() as f32 - 0.5) * size
    };
    let mut soups: Vec<TriangleMesh> = [(1, 0.8f32), (2, 0.8), (3, 0.8), (1000, 0.2), (50_000, 0.03)]
        .into_iter()
        .map(|(n, size)| {
            join((0..n).map(|_| {
                let c = point(1.0);
                triangle([c + point(size), c + point(size), c + point(size)])
            }))
        })
        .collect();
    let shape = triangle([Vec3::new(0.4, -0.2, 0.0), Vec3::new(-0.2, 0.4, 0.0), Vec3::new(-0.2, -0.2, 0.0)]);
    soups.push(join(vec![shape; 3000]));
    let camera = camera(32, 24, DVec3::new(0.2, 0.4, 2.2), DVec3::ZERO);
    let mut worst: f64 = 0.0;
    for soup in soups {
        let mut scene = scene_of(soup, Material { double_sided: true, ..diffuse(Vec3::splat(0.5)) });
        scene.environment = sky(1.0);
        let c = compare(gpu, &Shot { spp: 1, depth: 2, ..Shot::new(&scene, camera) }, 1);
        // One pixel of a silhouette is rounding.
        worst = worst.max((c.different.len() as f64 - 1.0).max(0.0) / c.met.max(1) as f64);
    }
    let nothing = Shot::new(&Scene::default(), camera).draw(gpu);
    worst + (0..nothing.surfaces.len()).filter(|&i| nothing.hit(i)).count() as f64
}

fn hierarchy_depth(gpu: &Arc<Gpu>, _: u64) -> f64 {
    let size = |k: i32| 2f32.powi(k);
    let chain = join((-110..19).map(|k| {
        let x = size(k);
        triangle([Vec3::new(x, -x, -x), Vec3::new(x, 2.0 * x, -x), Vec3::new(x, -x, 2.0 * x)])
    }));
    let scene = scene_of(chain, Material { double_sided: true, ..diffuse(Vec3::ONE) });
    let mut faults = 0;
    for k in [-20, -19, -15, -10, -6, -3, 0, 1, 5, 9, 13, 18] {
        // Just before the triangle, toward it, behind all that are smaller.
        let x = f64::from(size(k));
        let camera =
            camera(3, 3, DVec3::new(0.75 * x, 0.01 * x, 0.02 * x), DVec3::new(x, 0.01 * x, 0.02 * x));
        let picture = Shot { spp: 1, depth: 2, ..Shot::new(&scene, camera) }.draw(gpu);
        let distance = f64::from(picture.surfaces[4].distance);
        faults += u32::from(!picture.hit(4) || (distance / (0.25 * x) - 1.0).abs() > 1e-4);
    }
    f64::from(faults)
}

fn heaps_in_a_chain(gpu: &Arc<Gpu>, _: u64) -> f64 {
    // Heaps of twins across the X axis, each 1.3 times as large and as far as the one before: a tree by area is a chain with a heap on every
    // level. All boxes hold the axis; a twin lies off it, so a ray along it meets nothing but the one triangle that lies on it.
    let corner = |s: f32, y: f32, z: f32| Vec3::new(s, y * s, z * s);
    let off = |s: f32| triangle([corner(s, 3.0, 3.0), corner(s, -1.0, 3.0), corner(s, 3.0, -1.0)]);
    let on = |s: f32| triangle([corner(s, -1.0, -1.0), corner(s, 3.0, -1.0), corner(s, -1.0, 3.0)]);
    let size = |k: i32| 1e5 / 1.3f32.powi(k);
    let camera = camera(3, 3, DVec3::ZERO, DVec3::X);
    let mut faults = 0;
    // With as many as 140 the tree by area would be deeper than the stack, and halves take its place; fewer fill what the stack has in
    // registers and in memory.
    for (count, place) in
        [20, 40, 60, 140].into_iter().flat_map(|n| (0..n).step_by(n as usize / 10).map(move |p| (n, p)))
    {
        let heaps = join((0..count).flat_map(|k| (0..12).map(move |_| off(size(k)))));
        let scene =
            scene_of(join([heaps, on(size(place))]), Material { double_sided: true, ..diffuse(Vec3::ONE) });
        let shot = Shot { spp: 1, depth: 2, ..Shot::new(&scene, camera) };
        // The walk of GPUs has a stack of its own, as deep as the tree. Its shaders are compiled for each depth, which takes its time.
        let of_gpus = matches!(count, 40 | 140) && place * 10 / count % 3 == 0;
        for storage_tables in [false, true].into_iter().take(1 + usize::from(of_gpus)) {
            let picture = shot.draw_keeping(gpu, Keep { storage_tables, ..Keep::default() });
            let distance = f64::from(picture.surfaces[4].distance);
            let right = (distance / f64::from(size(place)) - 1.0).abs() <= 1e-5;
            faults += u32::from(!picture.hit(4) || !right);
        }
    }
    f64::from(faults)
}

fn unusable(gpu: &Arc<Gpu>, _: u64) -> f64 {
    let camera = camera(8, 8, DVec3::new(0.0, 0.0, 3.0), DVec3::ZERO);
    let refused = |bad: f32| {
        let mut scene = scene_of(sphere(Vec3::ZERO, 1.0, 1, true), diffuse(Vec3::ONE));
        scene.bodies[0].mesh.positions[3].y = bad;
        let settings = Shot::new(&scene, camera).settings();
        let error = Renderer::new(gpu, &scene, settings).err();
        matches!(&error, Some(RenderError::Scene(e)) if e.to_string().contains("body 0"))
    };
    [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e7, f32::MAX].into_iter().filter(|&b| !refused(b)).count()
        as f64
}

/// One channel of a picture of independent samples, about its mean over the pixels that have noise.
fn noise(gpu: &Arc<Gpu>, seed: u32, frame: u32) -> Vec<f64> {
    let mut scene = scene_of(floor(50.0, 0.0), diffuse(Vec3::splat(0.8)));
    scene.environment = image_sky(1.0);
    let camera = camera(64, 64, DVec3::new(0.0, 30.0, 0.0), DVec3::ZERO);
    let shot = Shot { spp: 1, depth: 2, seed, ..Shot::new(&scene, camera) };
    let mut out = Vec::new();
    let Ok(mut renderer) = Renderer::new(gpu, &scene, shot.settings()) else { return out };
    let poses = shot.world_from_body();
    shot.play(
        &mut renderer,
        frame..frame + 1,
        |_| poses.clone(),
        |_, slot, _| {
            out = slot.radiance().unwrap_or(&[]).iter().map(|r| f64::from(r[1])).collect();
        },
    );
    let mean = out.iter().sum::<f64>() / out.len().max(1) as f64;
    out.iter_mut().for_each(|v| *v -= mean);
    out
}

fn streams(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let seed = seed as u32;
    let correlation = |a: &[f64], b: &[f64]| {
        let dot = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(x, y)| x * y).sum::<f64>();
        (dot(a, b) / (dot(a, a) * dot(b, b)).sqrt() * (a.len() as f64).sqrt()).abs()
    };
    let mut worst: f64 = 0.0;
    for (s, frame) in [(0, 0), (seed, 5), (u32::MAX, u32::MAX - 2)] {
        let base = noise(gpu, s, frame);
        if base.iter().all(|v| *v == 0.0) {
            return f64::NAN;
        }
        let n = base.len();
        // Neighbours along rows and columns, the next frame, the next seed.
        worst =
            worst.max(correlation(&base[..n - 1], &base[1..])).max(correlation(&base[..n - 64], &base[64..]));
        worst = worst.max(correlation(&base, &noise(gpu, s, frame + 1)));
        worst = worst.max(correlation(&base, &noise(gpu, s.wrapping_add(1), frame)));
    }
    worst
}

fn same_bits(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let scene = still_life(1.0);
    let camera = camera(40, 30, DVec3::new(0.3, 1.6, 2.4), DVec3::ZERO);
    let eye = Some(DVec3::new(-0.7, 1.4, 2.1));
    let mut different = 0;
    for method in methods() {
        let shot = Shot {
            eye,
            spp: 4,
            frames: 8,
            seed: seed as u32,
            method: Some(method),
            ..Shot::new(&scene, camera)
        };
        let bits = |p: &ShotPicture| p.radiance.iter().map(|r| r.map(f32::to_bits)).collect::<Vec<_>>();
        let (a, b) = (shot.draw(gpu), shot.draw(gpu));
        different += bits(&a).iter().zip(&bits(&b)).filter(|(a, b)| a != b).count();
        different += a.codes.iter().zip(&b.codes).filter(|(a, b)| a != b).count();
    }
    different as f64
}
