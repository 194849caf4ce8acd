//! Hard cases of light transport and geometry, on the f64 reference.

use super::CpuCase;
use crate::reference::bvh::{Bvh, Triangle};
use crate::reference::{offset, Reference, ReferenceImage, RenderSettings, Sampler};
use crate::statistics::Mean;
use dpm_scene::shapes::*;
use dpm_scene::{Environment, Material, PunctualKind, Scene};
use glam::{DAffine3, DVec3, Vec3};

/// The cases.
pub(super) const CASES: &[CpuCase] = &[
    CpuCase(
        "tracer-furnace-convex",
        "white Lambertian sphere in even light, 64 bounces, before a camera and in the rig",
        "closed form: 1 in every sample, in the rig where the eye sees the sphere and 0 elsewhere",
        "radiance",
        1e-12,
        furnace_convex,
    ),
    CpuCase(
        "tracer-furnace-concave",
        "corner of three white walls in even light, 64 bounces",
        "closed form: mean 1",
        "sigma",
        4.0,
        furnace_concave,
    ),
    CpuCase(
        "tracer-furnace-closed-sphere",
        "closed sphere, albedo and emission 1/2, depths of 1 to 3 and 64",
        "closed form: 1 - 2^-depth; the stated variances explain what the pixels are off by",
        "sigma",
        4.0,
        furnace_closed,
    ),
    CpuCase(
        "tracer-clear-glass",
        "clear glass balls of index 1.0005, 1.5 and 2.4 in even light, solid or thin-walled",
        "closed form: 1, to 1e-4 where solid, to the 2e-3 of the albedo table where thin-walled",
        "ratio",
        1.0,
        clear_glass,
    ),
    CpuCase(
        "tracer-sphere-light-form-factor",
        "sphere light over a floor",
        "closed form: E = pi L (r / h)^2",
        "relative",
        1.5e-2,
        form_factor,
    ),
    CpuCase(
        "tracer-scale-invariance",
        "a scene at 1e-6 to 1e6 of its size",
        "same image",
        "relative",
        1e-6,
        scale,
    ),
    CpuCase(
        "tracer-far-from-origin",
        "bodies moved 1e5 m by their pose",
        "same image",
        "relative",
        1e-6,
        far_from_origin,
    ),
    CpuCase(
        "tracer-self-hits-and-leaks",
        "spheres of radius 1e-6 to 1e6 m at up to 1e5 m, new rays on both sides",
        "no ray hits the surface that it leaves, none escapes",
        "share",
        0.0,
        self_hits,
    ),
    CpuCase(
        "tracer-watertight",
        "closed meshes of 1 mm to 10 km, up to 10 km off the origin, rays at corners and edges from inside",
        "no ray escapes",
        "share",
        0.0,
        watertight,
    ),
    CpuCase(
        "tracer-needles-and-zero-areas",
        "NaN corner, equal corners, collinear corners, needle of 1e30, duplicates in a closed mesh",
        "dropped or harmless: no leak, all finite",
        "faults",
        0.0,
        degenerate,
    ),
    CpuCase(
        "tracer-axis-parallel-rays",
        "rays along axes through corners, edges and planes, with +0 and -0",
        "brute force",
        "mismatches",
        0.0,
        axis_parallel,
    ),
    CpuCase(
        "tracer-hierarchy-sizes",
        "0, 1, 2, 3, 1,000, 100,000 triangles; all centroids equal; coordinates doubling 900 times",
        "brute force",
        "mismatches",
        0.0,
        hierarchy,
    ),
    CpuCase(
        "tracer-invalid-rays",
        "origin or direction NaN, infinite or zero",
        "no hit, no hang",
        "hits",
        0.0,
        invalid_rays,
    ),
    CpuCase(
        "tracer-lamp-at-a-micrometre",
        "even lamp 1e-6 m over a floor, a sun 1e8 times as bright behind it",
        "closed form: albedo * L",
        "relative",
        1e-4,
        lamp_at_a_micrometre,
    ),
    CpuCase(
        "tracer-no-light",
        "no light, black lights, black sky, empty scene",
        "all 0",
        "radiance",
        0.0,
        no_light,
    ),
    CpuCase(
        "tracer-many-lights",
        "100,000 point lights, a fifth of them black",
        "closed form: sum",
        "sigma",
        4.0,
        many_lights,
    ),
    CpuCase(
        "tracer-random-streams",
        "seed 0, neighbouring pixels, 2^32nd frame",
        "correlation of neighbours and lags",
        "sigma",
        5.0,
        streams,
    ),
    CpuCase(
        "tracer-same-seed-same-image",
        "1 and 3 threads, and another seed",
        "bit for bit; another seed gives another image",
        "pixels",
        0.0,
        same_seed,
    ),
];

/// Mean over all pixels of the first channel, and its standard error.
fn overall(image: &ReferenceImage) -> (f64, f64) {
    let n = image.mean.len() as f64;
    let mean = image.mean.iter().map(|p| p[0]).sum::<f64>() / n;
    (mean, image.variance.iter().map(|v| v[0]).sum::<f64>().sqrt() / n)
}

fn settings(spp: u32, depth: u32, seed: u64) -> RenderSettings {
    RenderSettings { spp, depth, seed, ..Default::default() }
}

fn on_sphere(s: &mut Sampler) -> DVec3 {
    let z = 2.0 * s.uniform() - 1.0;
    let phi = std::f64::consts::TAU * s.uniform();
    let r = (1.0 - z * z).sqrt();
    DVec3::new(r * phi.cos(), r * phi.sin(), z)
}

fn furnace_convex(seed: u64) -> f64 {
    let mut s = scene_of(sphere(Vec3::ZERO, 1.0, 2, false), diffuse(Vec3::ONE));
    s.environment = sky(1.0);
    let c = camera(24, 24, DVec3::new(0.0, 0.0, 5.0), DVec3::ZERO);
    let r = Reference::new(&s, &[]);
    let seen = r.render_camera(&c, &settings(4, 64, seed));
    let rig = r.render(&c, DVec3::new(2.0, 1.0, 5.0), &settings(4, 64, seed));
    let lit = rig.lit.iter().filter(|l| **l).count();
    if !(51..24 * 24).contains(&lit) || seen.dropped_samples + rig.dropped_samples > 0 {
        return f64::NAN;
    }
    let off = |p: &[f64; 3], expected: f64| p.iter().map(|p| (p - expected).abs()).fold(0.0, f64::max);
    let before_camera = seen.mean.iter().map(|p| off(p, 1.0));
    let in_rig = rig.mean.iter().zip(&rig.lit).map(|(p, lit)| off(p, if *lit { 1.0 } else { 0.0 }));
    before_camera.chain(in_rig).fold(0.0, f64::max)
}

fn furnace_concave(seed: u64) -> f64 {
    let mut s = scene_of(floor(1.0, 0.0), diffuse(Vec3::ONE));
    add(&mut s, quad(Vec3::new(-1.0, 0.0, -1.0), Vec3::X * 2.0, Vec3::Y * 2.0), diffuse(Vec3::ONE));
    add(&mut s, quad(Vec3::new(-1.0, 0.0, 1.0), Vec3::NEG_Z * 2.0, Vec3::Y * 2.0), diffuse(Vec3::ONE));
    s.environment = sky(1.0);
    let c = camera(12, 12, DVec3::new(4.0, 5.0, 6.0), DVec3::new(-0.5, 0.5, -0.5));
    let (mean, sigma) = overall(&Reference::new(&s, &[]).render_camera(&c, &settings(200, 64, seed)));
    (mean - 1.0).abs() / sigma.max(1e-9)
}

fn furnace_closed(seed: u64) -> f64 {
    let material = Material { emissive: Vec3::splat(0.5), double_sided: true, ..diffuse(Vec3::splat(0.5)) };
    let s = scene_of(sphere(Vec3::new(0.3, -0.2, 0.1), 2.0, 1, false), material);
    let r = Reference::new(&s, &[]);
    let c = camera(16, 16, DVec3::ZERO, DVec3::NEG_Z);
    let render =
        |spp, depth| r.render_camera(&c, &RenderSettings { jitter: true, ..settings(spp, depth, seed) });
    let whole = render(200, 64);
    let squares = whole.mean.iter().zip(&whole.variance).map(|(m, v)| (m[0] - 1.0).powi(2) / v[0]);
    if !(0.6..1.6).contains(&(squares.sum::<f64>() / whole.mean.len() as f64)) {
        return f64::INFINITY;
    }
    let off = |image: &ReferenceImage, depth: i32| {
        let (mean, sigma) = overall(image);
        // Emission alone has no noise.
        ((mean - (1.0 - 0.5f64.powi(depth))).abs() - 1e-12).max(0.0) / sigma.max(1e-12)
    };
    (1..4).map(|depth| off(&render(64, depth), depth as i32)).fold(off(&whole, 64), f64::max)
}

fn clear_glass(seed: u64) -> f64 {
    let mut worst: f64 = 0.0;
    for (thin_walled, ior) in [(false, 1.5), (false, 2.4), (true, 1.5), (false, 1.0005)] {
        let glass = Material {
            metallic: 0.0,
            roughness: 0.0,
            transmission: 1.0,
            thin_walled,
            ior,
            ..Material::default()
        };
        let mut s = scene_of(sphere(Vec3::ZERO, 1.0, 1, false), glass);
        s.environment = sky(1.0);
        let c = camera(12, 12, DVec3::new(0.0, 0.0, 4.0), DVec3::ZERO);
        let (mean, sigma) = overall(&Reference::new(&s, &[]).render_camera(&c, &settings(200, 64, seed)));
        if sigma > 1e-2 {
            return f64::NAN;
        }
        // Thin walls take their reflection from the table.
        let tolerance = if thin_walled { 2e-3 } else { 1e-4 };
        worst = worst.max(((mean - 1.0).abs() - 4.0 * sigma) / tolerance);
    }
    worst.max(0.0)
}

fn form_factor(seed: u64) -> f64 {
    let (radius, height, albedo) = (0.5f32, 1.5f32, 0.5f32);
    let mut s = scene_of(floor(4.0, 0.0), diffuse(Vec3::splat(albedo)));
    add(&mut s, sphere(Vec3::new(0.0, height, 0.0), radius, 3, true), emitter(Vec3::splat(2.0)));
    let mut c = camera(6, 6, DVec3::new(3.0, 0.6, 0.0), DVec3::ZERO);
    (c.fx, c.fy) = (1e6, 1e6);
    let (mean, _) = overall(&Reference::new(&s, &[]).render_camera(&c, &settings(12_000, 2, seed)));
    (mean / (f64::from(albedo) * 2.0 * f64::from(radius / height).powi(2)) - 1.0).abs()
}

fn small_scene(scale: f32) -> Scene {
    let at = |mut m: dpm_scene::TriangleMesh| {
        m.positions.iter_mut().for_each(|p| *p *= scale);
        m
    };
    let mut s = scene_of(at(floor(2.0, 0.0)), diffuse(Vec3::new(0.8, 0.5, 0.3)));
    let glossy = Material { roughness: 0.4, base_color: Vec3::new(0.9, 0.8, 0.4), ..Material::default() };
    add(&mut s, at(sphere(Vec3::new(0.0, 0.5, 0.0), 0.5, 2, true)), glossy);
    add(&mut s, at(quad(Vec3::new(-0.5, 2.0, -0.5), Vec3::X, Vec3::Z)), emitter(Vec3::splat(4.0)));
    s
}

fn view_of(scale: f64, shift: DVec3, seed: u64) -> ReferenceImage {
    let s = small_scene(scale as f32);
    let c =
        camera(16, 16, DVec3::new(0.5, 3.0, 1.5) * scale + shift, DVec3::new(0.0, 0.3, 0.0) * scale + shift);
    let eye = DVec3::new(2.0, 2.3, 1.0) * scale + shift;
    Reference::new(&s, &[DAffine3::from_translation(shift); 3]).render(&c, eye, &settings(24, 3, seed))
}

fn difference(a: &ReferenceImage, b: &ReferenceImage) -> f64 {
    let (a, b) = (a.mean_lit()[0], b.mean_lit()[0]);
    (a / b - 1.0).abs()
}

fn scale(seed: u64) -> f64 {
    [1e4, 1e5, 1e6].into_iter().map(|ratio| scaled_by(ratio, seed)).fold(0.0, f64::max)
}

/// A scene that is so many times as large, or as small.
pub(super) fn scaled_by(ratio: f64, seed: u64) -> f64 {
    let base = view_of(1.0, DVec3::ZERO, seed);
    let off = |scale: f64| difference(&view_of(scale, DVec3::ZERO, seed), &base);
    [off(ratio), off(1.0 / ratio)]
        .into_iter()
        .fold(0.0, |worst: f64, e| if e.is_nan() { e } else { worst.max(e) })
}

fn far_from_origin(seed: u64) -> f64 {
    as_far_as(AWAY.length(), seed)
}

/// Where a scene of a metre lies that is far from the origin, metres.
const AWAY: DVec3 = DVec3::new(1e5, -3e4, 7e4);

/// A scene that is so many metres from the origin.
pub(super) fn as_far_as(distance: f64, seed: u64) -> f64 {
    let base = view_of(1.0, DVec3::ZERO, seed);
    difference(&view_of(1.0, AWAY.normalize() * distance, seed), &base)
}

fn self_hits(seed: u64) -> f64 {
    let (mut faults, mut all) = (0u32, 0u32);
    for (radius, distance) in [(1e-6f32, 0.0), (1e-3, 0.0), (1e-3, 1e4), (1.0, 1e5), (1e4, 1e4), (1e6, 0.0)] {
        let c = DVec3::new(0.36, 0.48, 0.8) * distance;
        let s = scene_of(sphere(Vec3::ZERO, radius, 3, false), diffuse(Vec3::ONE));
        let r = Reference::new(&s, &[DAffine3::from_translation(c)]);
        let mut sampler = Sampler::new(seed, 0);
        for _ in 0..3000 {
            all += 1;
            let d = on_sphere(&mut sampler);
            let far = 3.0 * f64::from(radius);
            let Some(hit) = r.trace(c + d * far, -d, f64::INFINITY, false) else {
                faults += 1;
                continue;
            };
            let w = on_sphere(&mut sampler);
            let out = w * w.dot(hit.geometric).signum();
            let start = |d: DVec3| offset(hit.position, hit.geometric, d, hit.scale);
            faults += u32::from(r.occluded(start(out), out, f64::INFINITY, false));
            faults += u32::from(!r.occluded(start(-out), -out, f64::INFINITY, false));
        }
    }
    f64::from(faults) / f64::from(all)
}

fn triangles_of(mesh: &dpm_scene::TriangleMesh) -> Vec<Triangle> {
    (mesh.triangles.iter().enumerate())
        .map(|(i, t)| Triangle {
            p: t.map(|v| mesh.positions[v as usize].as_dvec3()),
            body: 0,
            index: i as u32,
        })
        .collect()
}

fn watertight(seed: u64) -> f64 {
    let (mut leaks, mut all) = (0, 0);
    let mut s = Sampler::new(seed, 0);
    for (radius, distance) in [(1.0f32, 0.0f32), (1e-3, 0.0), (1e4, 0.0), (1.0, 1e4), (1e-2, 1e3)] {
        let centre = Vec3::new(0.6, -0.7, 0.4) * distance;
        let ball = sphere(centre, radius, 3, true);
        let corners: Vec<DVec3> = ball.positions.iter().map(|p| p.as_dvec3()).collect();
        let bvh = Bvh::new(triangles_of(&ball));
        for i in 0..20_000usize {
            let from = centre.as_dvec3() + on_sphere(&mut s) * f64::from(radius) * 0.7 * s.uniform();
            let to = match i % 3 {
                0 => corners[i % corners.len()],
                1 => {
                    let t = ball.triangles[i % ball.triangles.len()];
                    corners[t[0] as usize].lerp(corners[t[1] as usize], s.uniform())
                }
                _ => from + on_sphere(&mut s),
            };
            leaks += usize::from(!bvh.any(from, (to - from).normalize(), f64::INFINITY, |_| true));
            all += 1;
        }
    }
    leaks as f64 / all as f64
}

fn degenerate(seed: u64) -> f64 {
    let mut m = sphere(Vec3::ZERO, 1.0, 1, true);
    let (n, sound) = (m.positions.len() as u32, m.triangles.len());
    m.positions.extend([
        Vec3::splat(f32::NAN),
        Vec3::X * 1e-3,
        Vec3::X * 1e-3,
        Vec3::new(0.0, 1e-30, 0.0),
        Vec3::X,
    ]);
    m.normals.extend([Vec3::ZERO; 5]);
    m.tangents.extend([glam::Vec4::ZERO; 5]);
    m.uvs.extend([glam::Vec2::ZERO; 5]);
    m.triangles.extend([
        [n, 0, 1],
        [n + 1, n + 2, 0],
        [n + 1, n + 1, n + 1],
        [n + 1, n + 2, n + 4],
        [n + 1, n + 3, n + 4],
    ]);
    let twice = m.triangles[0];
    m.triangles.push(twice);
    let s = scene_of(m, diffuse(Vec3::splat(0.5)));
    let r = Reference::new(&s, &[]);
    // The needle and the twin stay.
    let mut faults = u32::from(r.dropped_triangles != 4 || r.bvh().triangles().len() != sound + 2);
    let mut sampler = Sampler::new(seed, 0);
    for _ in 0..5000 {
        let d = on_sphere(&mut sampler);
        let hit = r.trace(d * 3.0, -d, f64::INFINITY, false).is_some_and(|h| {
            h.position.is_finite() && h.geometric.is_normalized() && h.shading.is_normalized()
        });
        faults += u32::from(!hit);
    }
    f64::from(faults)
}

fn mismatch(bvh: &Bvh, origin: DVec3, direction: DVec3) -> u32 {
    let a = bvh.closest(origin, direction, f64::INFINITY, |_| true).map(|h| h.t);
    let b = bvh.closest_brute_force(origin, direction, f64::INFINITY).map(|h| h.t);
    let any = bvh.any(origin, direction, f64::INFINITY, |_| true);
    u32::from(a != b || any != a.is_some())
}

fn axis_parallel(_: u64) -> f64 {
    let mut soup = Vec::new();
    for i in 0..4u8 {
        for j in 0..4u8 {
            for k in 0..2u8 {
                let corner = Vec3::new(f32::from(i), f32::from(k), f32::from(j));
                soup.extend(triangles_of(&quad(corner, Vec3::Z, Vec3::X)));
            }
        }
    }
    let bvh = Bvh::new(soup);
    let values = [-1.0, -0.0, 0.0, 0.25, 1.0, 2.0, 4.0];
    let mut wrong = 0;
    for axis in 0..3 {
        for (sign, zero) in [(1.0, 0.0), (1.0, -0.0), (-1.0, 0.0), (-1.0, -0.0)] {
            let mut d = DVec3::splat(zero);
            d[axis] = sign;
            for x in values {
                for y in values {
                    wrong += values.iter().map(|z| mismatch(&bvh, DVec3::new(x, y, *z), d)).sum::<u32>();
                }
            }
        }
    }
    // The grid is closed downward: nothing falls through its edges and corners.
    for x in [0.0, 1.0, 2.5, 3.0, 4.0] {
        wrong += u32::from(!bvh.any(DVec3::new(x, 3.0, 2.0), -DVec3::Y, 9.0, |_| true));
    }
    f64::from(wrong)
}

fn hierarchy(seed: u64) -> f64 {
    let mut wrong = 0;
    let mut s = Sampler::new(seed, 0);
    for (n, size, rays) in [
        (0usize, 0.5, 10),
        (1, 0.5, 200),
        (2, 0.5, 200),
        (3, 0.5, 200),
        (1000, 0.1, 300),
        (100_000, 0.01, 20),
    ] {
        let soup = (0..n)
            .map(|i| {
                let c = on_sphere(&mut s) * s.uniform();
                let p = std::array::from_fn(|_| c + on_sphere(&mut s) * size);
                Triangle { p, body: 0, index: i as u32 }
            })
            .collect();
        let bvh = Bvh::new(soup);
        for _ in 0..rays {
            let o = on_sphere(&mut s) * 1.5 * s.uniform();
            wrong += mismatch(&bvh, o, on_sphere(&mut s));
        }
    }
    let one = Triangle { p: [DVec3::X, DVec3::Y, DVec3::Z], body: 0, index: 0 };
    let equal = Bvh::new(vec![one; 20_000]);
    wrong += mismatch(&equal, DVec3::ZERO, DVec3::ONE) + u32::from(equal.triangles().len() != 20_000);
    let doubling = Bvh::new(doubling());
    for i in [0, 1, 450, 700] {
        wrong += mismatch(&doubling, DVec3::new(0.75 * 2f64.powi(i - 450), 0.25, 0.25), DVec3::X);
    }
    f64::from(wrong)
}

/// 900 triangles whose coordinates double from one to the next: cut by area they would give a tree as deep as their number. Triangle `i`
/// stands across the x axis at `2^(i - 450)`.
fn doubling() -> Vec<Triangle> {
    let one = |i: i32| {
        let x = 2f64.powi(i - 450);
        let p = [DVec3::X * x, DVec3::new(x, 1.0, 0.0), DVec3::new(x, 0.0, 1.0)];
        Triangle { p, body: 0, index: i as u32 }
    };
    (0..900).map(one).collect()
}

fn invalid_rays(_: u64) -> f64 {
    let bvh = Bvh::new(triangles_of(&sphere(Vec3::ZERO, 1.0, 2, true)));
    let bad = [
        (DVec3::NAN, DVec3::X),
        (DVec3::ZERO, DVec3::NAN),
        (DVec3::ZERO, DVec3::ZERO),
        (DVec3::ZERO, DVec3::new(0.0, f64::NAN, 1.0)),
        (DVec3::new(f64::INFINITY, 0.0, 0.0), -DVec3::X),
        (DVec3::ZERO, DVec3::new(f64::INFINITY, 0.0, 0.0)),
    ];
    bad.iter().filter(|(o, d)| bvh.any(*o, *d, f64::INFINITY, |_| true)).count() as f64
}

fn lamp_at_a_micrometre(seed: u64) -> f64 {
    lamp_as_near_as(2e6, seed)
}

/// A lamp of two metres whose width is so many times its distance from the floor.
pub(super) fn lamp_as_near_as(ratio: f64, seed: u64) -> f64 {
    let height = 2.0 / ratio;
    let mut s = scene_of(floor(2.0, 0.0), diffuse(Vec3::splat(0.5)));
    add(
        &mut s,
        quad(Vec3::new(-1.0, height as f32, -1.0), Vec3::X * 2.0, Vec3::Z * 2.0),
        emitter(Vec3::splat(1e-3)),
    );
    s.lights.push(light(PunctualKind::Directional, Vec3::ZERO, Vec3::NEG_Y, 1e5));
    let r = Reference::new(&s, &[]);
    let Some(point) = r.trace(DVec3::new(0.1, height / 2.0, 0.1), -DVec3::Y, 1.0, false) else {
        return f64::NAN;
    };
    let mut sampler = Sampler::new(seed, 3);
    let mut mean = Mean::default();
    // A millionth of the samples counts as much as a quarter of the light: enough of them that one does not matter.
    (0..200_000).for_each(|_| mean.push(r.radiance(&point, DVec3::Y, 2, &mut sampler).x));
    (mean.mean() / 0.5e-3 - 1.0).abs()
}

fn down(w: u32) -> dpm_scene::geometry::projector::ProjectorCamera {
    let mut c = camera(w, w, DVec3::new(0.0, 4.0, 0.0), DVec3::ZERO);
    (c.fx, c.fy) = (1e6, 1e6);
    c
}

fn no_light(seed: u64) -> f64 {
    let mut s = scene_of(floor(2.0, 0.0), diffuse(Vec3::ONE));
    let render = |s: &Scene| {
        let image = Reference::new(s, &[]).render_camera(&down(2), &settings(3, 4, seed));
        image.mean.iter().flatten().sum::<f64>() + image.dropped_samples as f64
    };
    let dark = render(&s);
    s.environment =
        Environment::Equirect { width: 4, height: 2, texels: vec![Vec3::ZERO; 8], rotation_rad: 0.0 };
    s.lights.push(light(PunctualKind::Point, Vec3::Y, Vec3::Y, 0.0));
    s.lights.push(light(PunctualKind::Point, Vec3::ZERO, Vec3::Y, 1e30));
    dark + render(&s) + render(&Scene::default())
}

fn many_lights(seed: u64) -> f64 {
    let (scene, want) = floor_under_many_lights(seed);
    let (mean, sigma) =
        overall(&Reference::new(&scene, &[]).render_camera(&down(8), &settings(100, 2, seed)));
    (mean - want).abs() / sigma
}

fn streams(_: u64) -> f64 {
    let n = 100_000u64;
    let correlation = |a: &mut dyn FnMut(u64) -> f64, b: &mut dyn FnMut(u64) -> f64| {
        let sum: f64 = (0..n).map(|i| (a(i) - 0.5) * (b(i) - 0.5)).sum();
        (sum / n as f64 * 12.0 * (n as f64).sqrt()).abs()
    };
    let first = |seed: u64, stream: u64| Sampler::new(seed, stream).uniform();
    let mut worst: f64 = 0.0;
    for seed in [0, 1, 1 << 32, u64::MAX] {
        // Neighbouring pixels, rows of a 1024 raster, and neighbouring seeds.
        worst = worst.max(correlation(&mut |i| first(seed, i), &mut |i| first(seed, i + 1)));
        worst = worst.max(correlation(&mut |i| first(seed, i), &mut |i| first(seed, i + 1024)));
        worst = worst.max(correlation(&mut |i| first(seed, i), &mut |i| first(seed.wrapping_add(1), i)));
        let (mut a, mut b) = (Sampler::new(seed, 0), Sampler::new(seed, 0));
        b.uniform();
        worst = worst.max(correlation(&mut |_| a.uniform(), &mut |_| b.uniform()));
    }
    worst
}

fn same_seed(seed: u64) -> f64 {
    let s = small_scene(1.0);
    let r = Reference::new(&s, &[]);
    let c = camera(16, 12, DVec3::new(0.5, 3.0, 1.5), DVec3::ZERO);
    let render = |threads, seed| {
        r.render(
            &c,
            DVec3::new(2.0, 2.3, 1.0),
            &RenderSettings { threads, jitter: true, ..settings(4, 4, seed) },
        )
    };
    let (a, b) = (render(1, seed), render(3, seed));
    if render(1, seed.wrapping_add(1)).mean == a.mean {
        return f64::INFINITY;
    }
    a.mean.iter().zip(&b.mean).filter(|(a, b)| a != b).count() as f64
}
