//! Simple shapes and materials for small scenes, which the stability cases, the tests of the reference and the tests on
//! the GPU use.

use crate::geometry::projector::ProjectorCamera;
use crate::{
    Body, Environment, Material, PunctualKind, PunctualLight, Scene, Texture, TextureRef, TriangleMesh, Wrap,
};
use dpm_device::planes::Raster;
use dpm_device::rng::Sampler;
use glam::{DAffine3, DVec3, Vec2, Vec3, Vec4};
use std::collections::HashMap;

/// A scene of one body with one material.
pub fn scene_of(mesh: TriangleMesh, material: Material) -> Scene {
    let mut s = Scene::default();
    add(&mut s, mesh, material);
    s
}

/// Adds a static body at the identity pose with its own material; returns its index.
pub fn add(scene: &mut Scene, mut mesh: TriangleMesh, material: Material) -> usize {
    mesh.materials = vec![scene.materials.len() as u32; mesh.triangles.len()];
    scene.materials.push(material);
    scene.bodies.push(Body {
        name: format!("body {}", scene.bodies.len()),
        tracked: None,
        projected: true,
        world_from_body_rest: DAffine3::IDENTITY,
        motion: None,
        deforms: None,
        mesh,
    });
    scene.bodies.len() - 1
}

/// Indexed triangles with plain tangents and no texture coordinates.
pub fn mesh(positions: Vec<Vec3>, normals: Vec<Vec3>, triangles: Vec<[u32; 3]>) -> TriangleMesh {
    let n = positions.len();
    TriangleMesh {
        tangents: normals.iter().map(|n| n.any_orthonormal_vector().extend(1.0)).collect::<Vec<Vec4>>(),
        uvs: vec![Vec2::ZERO; n],
        materials: vec![0; triangles.len()],
        positions,
        normals,
        triangles,
        ..TriangleMesh::default()
    }
}

/// Joins meshes that share one material.
pub fn join(parts: impl IntoIterator<Item = TriangleMesh>) -> TriangleMesh {
    let mut all = TriangleMesh::default();
    for part in parts {
        let base = all.positions.len() as u32;
        all.triangles.extend(part.triangles.iter().map(|t| t.map(|i| i + base)));
        all.positions.extend(part.positions);
        all.normals.extend(part.normals);
        all.tangents.extend(part.tangents);
        all.uvs.extend(part.uvs);
        all.materials.extend(part.materials);
    }
    all
}

/// A closed sphere of 20 * 4^level triangles with the normals of its faces (so that shading and geometry agree) or of
/// the sphere.
pub fn sphere(centre: Vec3, radius: f32, level: u32, smooth: bool) -> TriangleMesh {
    let g = (1.0 + 5f32.sqrt()) / 2.0;
    let mut p: Vec<Vec3> = Vec::new();
    for (a, b) in [(1.0, g), (-1.0, g), (1.0, -g), (-1.0, -g)] {
        p.extend([Vec3::new(0.0, a, b), Vec3::new(a, b, 0.0), Vec3::new(b, 0.0, a)]);
    }
    p.iter_mut().for_each(|v| *v = v.normalize());
    let edge = p.iter().skip(1).map(|v| v.distance(p[0])).fold(f32::MAX, f32::min) * 1.01;
    let mut t = Vec::new();
    for i in 0..12u32 {
        for j in i + 1..12 {
            for k in j + 1..12 {
                let (a, b, c) = (p[i as usize], p[j as usize], p[k as usize]);
                if a.distance(b) < edge && b.distance(c) < edge && c.distance(a) < edge {
                    let outward = (b - a).cross(c - a).dot(a) > 0.0;
                    t.push(if outward { [i, j, k] } else { [i, k, j] });
                }
            }
        }
    }
    for _ in 0..level {
        let mut middle: HashMap<(u32, u32), u32> = HashMap::new();
        let mut half = |a: u32, b: u32| {
            *middle.entry((a.min(b), a.max(b))).or_insert_with(|| {
                p.push(((p[a as usize] + p[b as usize]) * 0.5).normalize());
                p.len() as u32 - 1
            })
        };
        let mut finer = Vec::new();
        for [a, b, c] in t {
            let (ab, bc, ca) = (half(a, b), half(b, c), half(c, a));
            finer.extend([[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]);
        }
        t = finer;
    }
    let at = |v: Vec3| centre + v * radius;
    if smooth {
        return mesh(p.iter().map(|v| at(*v)).collect(), p, t);
    }
    let (mut positions, mut normals, mut triangles) = (vec![], vec![], vec![]);
    for [a, b, c] in t.into_iter().map(|t| t.map(|i| p[i as usize])) {
        let n = positions.len() as u32;
        triangles.push([n, n + 1, n + 2]);
        positions.extend([a, b, c].map(at));
        normals.extend([(b - a).cross(c - a).normalize(); 3]);
    }
    mesh(positions, normals, triangles)
}

/// One triangle with its face normal (any normal if it has no area).
pub fn triangle([a, b, c]: [Vec3; 3]) -> TriangleMesh {
    let n = (b - a).as_dvec3().cross((c - a).as_dvec3()).normalize_or(DVec3::Y).as_vec3();
    mesh(vec![a, b, c], vec![n; 3], vec![[0, 1, 2]])
}

/// A parallelogram facing `u x v`.
pub fn quad(corner: Vec3, u: Vec3, v: Vec3) -> TriangleMesh {
    let n = u.cross(v).normalize();
    let mut m =
        mesh(vec![corner, corner + u, corner + u + v, corner + v], vec![n; 4], vec![[0, 1, 2], [0, 2, 3]]);
    m.uvs = vec![Vec2::new(0.0, 1.0), Vec2::ONE, Vec2::new(1.0, 0.0), Vec2::ZERO];
    m.tangents = vec![u.normalize().extend(1.0); 4];
    m
}

/// A floor in the plane `y = height` that faces up, `2 * half` on a side.
pub fn floor(half: f32, height: f32) -> TriangleMesh {
    quad(Vec3::new(-half, height, half), Vec3::X * 2.0 * half, Vec3::NEG_Z * 2.0 * half)
}

/// Lambertian.
pub fn diffuse(albedo: Vec3) -> Material {
    Material { base_color: albedo, metallic: 0.0, ior: 1.0, ..Material::default() }
}

/// Black, and emitting on its front.
pub fn emitter(radiance: Vec3) -> Material {
    Material { emissive: radiance, ..diffuse(Vec3::ZERO) }
}

/// A light without a body and with infinite range.
pub fn light(kind: PunctualKind, position: Vec3, direction: Vec3, intensity: f32) -> PunctualLight {
    PunctualLight {
        kind,
        intensity: Vec3::splat(intensity),
        body: None,
        position,
        direction,
        range: f32::INFINITY,
    }
}

/// A light without extent.
pub fn point_light(position: Vec3, intensity: f32) -> PunctualLight {
    light(PunctualKind::Point, position, Vec3::NEG_Y, intensity)
}

/// A white floor under 100,000 random point lights, a fifth of them black; and its radiance at the origin: the sum of
/// `I h / (pi r^3)` over all lights.
pub fn floor_under_many_lights(seed: u64) -> (Scene, f64) {
    let mut scene = scene_of(floor(3.0, 0.0), diffuse(Vec3::ONE));
    let mut sampler = Sampler::new(seed, 4);
    let mut radiance = 0.0;
    for i in 0..100_000u32 {
        let mut u = || sampler.uniform() as f32;
        let p = Vec3::new(u(), 1.0 + u(), u());
        let intensity = if i % 5 == 0 { 0.0 } else { 1e-5 * (1 + i % 3) as f32 };
        scene.lights.push(point_light(p, intensity));
        let r2 = f64::from(p.length_squared());
        radiance += f64::from(intensity) * f64::from(p.y) / r2.powf(1.5) / std::f64::consts::PI;
    }
    (scene, radiance)
}

/// A bright lamp inside a closed sphere about the origin, and a camera at `distance` that sees 14 pixels of its radius.
pub fn lamp_in_a_sphere(radius: f32, distance: f64) -> (Scene, ProjectorCamera) {
    let mut scene = scene_of(sphere(Vec3::ZERO, radius, 2, false), diffuse(Vec3::splat(0.5)));
    add(&mut scene, sphere(Vec3::ZERO, radius * 0.9, 2, false), emitter(Vec3::splat(1e3)));
    let mut camera = camera(32, 32, DVec3::new(0.0, 0.6, 0.8) * distance, DVec3::ZERO);
    let pixels = 14.0 * distance / f64::from(radius);
    (camera.fx, camera.fy) = (pixels, pixels);
    (scene, camera)
}

/// A wide slab of two faces, fully transparent, in even light. Light reflected inside leaves at the next face, so few
/// paths exceed their depth.
pub fn clear_slab(ior: f32, roughness: f32, thin_walled: bool) -> Scene {
    let glass =
        Material { transmission: 1.0, thin_walled, roughness, ior, metallic: 0.0, ..Material::default() };
    let below = quad(Vec3::new(-50.0, -0.1, -50.0), Vec3::X * 100.0, Vec3::Z * 100.0);
    let mut scene = scene_of(join([floor(50.0, 0.1), below]), glass);
    scene.environment = sky(1.0);
    scene
}

/// Even light from everywhere.
pub fn sky(l: f32) -> Environment {
    Environment::Constant(Vec3::splat(l))
}

/// A projector of 0.6 rad horizontal field of view.
///
/// # Panics
/// When the raster is empty or the two points coincide.
pub fn camera(w: u32, h: u32, position: DVec3, look_at: DVec3) -> ProjectorCamera {
    let up = if (look_at - position).cross(DVec3::Y).length() < 1e-6 { DVec3::NEG_Z } else { DVec3::Y };
    ProjectorCamera::look_at(Raster::new(w, h).unwrap(), position, look_at, up, 0.6).unwrap()
}

/// A small picture of smooth random colours between `low` and `high`, identical for the same seed.
pub fn noise_texture(size: u32, seed: u64, low: u8, high: u8, srgb: bool) -> Texture {
    let mut random = Sampler::new(seed, 0);
    let mut value = || low + (random.uniform() * f64::from(high - low)) as u8;
    let texels = (0..size * size).map(|_| [value(), value(), value(), 255]).collect();
    Texture { wrap_v: Wrap::Mirror, ..Texture::repeated([size; 2], texels, srgb) }
}

/// Adds a texture and a reference to it, stretched and rotated so that every part of the transform matters.
pub fn use_texture(scene: &mut Scene, texture: Texture) -> Option<TextureRef> {
    scene.textures.push(texture);
    Some(TextureRef {
        texture: scene.textures.len() as u32 - 1,
        offset: Vec2::new(0.13, -0.31),
        rotation: 0.4,
        scale: Vec2::new(1.7, 2.3),
    })
}

/// A sky with a bright patch, turned about the vertical.
pub fn image_sky(radiance: f32) -> Environment {
    let (width, height) = (16, 8);
    let texels = (0..width * height)
        .map(|i| {
            let (x, y) = ((i % width) as f32, (i / width) as f32);
            let patch =
                if (9..12).contains(&(i % width)) && (1..3).contains(&(i / width)) { 12.0 } else { 0.0 };
            Vec3::new(0.2 + 0.03 * x, 0.4 + 0.05 * y, 0.7 - 0.02 * x) * radiance
                + Vec3::splat(patch * radiance)
        })
        .collect();
    Environment::Equirect { width, height, texels, rotation_rad: 0.7 }
}
