//! Small shapes, materials and cameras: every test's scene is built from these.

use dpm_device::planes::Raster;
use dpm_host::geometry::projector::ProjectorCamera;
use dpm_host::reference::Sampler;
use dpm_host::scene::{Body, Environment, Material, Scene, Texture, TextureRef, TriangleMesh, Wrap};
use glam::{DAffine3, DVec3, Vec2, Vec3};
use std::collections::HashMap;

/// Adds a body at rest at the identity pose with a material of its own; returns its index.
pub fn add(scene: &mut Scene, mut mesh: TriangleMesh, material: Material) -> usize {
    mesh.materials = vec![scene.materials.len() as u32; mesh.triangles.len()];
    scene.materials.push(material);
    scene.bodies.push(Body {
        name: format!("body {}", scene.bodies.len()),
        tracked: None,
        projected: true,
        world_from_body_rest: DAffine3::IDENTITY,
        mesh,
    });
    scene.bodies.len() - 1
}

/// A scene of one body with one material.
pub fn scene_of(mesh: TriangleMesh, material: Material) -> Scene {
    let mut scene = Scene::default();
    add(&mut scene, mesh, material);
    scene
}

/// A mesh without texture coordinates; tangents are any that fit the normals.
pub fn mesh(positions: Vec<Vec3>, normals: Vec<Vec3>, triangles: Vec<[u32; 3]>) -> TriangleMesh {
    let n = positions.len();
    TriangleMesh {
        tangents: normals.iter().map(|n| n.any_orthonormal_vector().extend(1.0)).collect(),
        uvs: vec![Vec2::ZERO; n],
        materials: vec![0; triangles.len()],
        positions,
        normals,
        triangles,
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

/// A closed sphere of `20 * 4^level` triangles about the origin. `smooth`: normals of the sphere instead of the faces'.
pub fn sphere(radius: f32, level: u32, smooth: bool) -> TriangleMesh {
    let g = (1.0 + 5f32.sqrt()) / 2.0;
    let mut points: Vec<Vec3> = [(1.0, g), (-1.0, g), (1.0, -g), (-1.0, -g)]
        .iter()
        .flat_map(|&(a, b)| [Vec3::new(0.0, a, b), Vec3::new(a, b, 0.0), Vec3::new(b, 0.0, a)])
        .map(Vec3::normalize)
        .collect();
    let edge = points[1..].iter().map(|v| v.distance(points[0])).fold(f32::MAX, f32::min) * 1.01;
    let mut faces = Vec::new();
    for i in 0..12u32 {
        for j in i + 1..12 {
            for k in j + 1..12 {
                let [a, b, c] = [i, j, k].map(|n| points[n as usize]);
                if a.distance(b) < edge && b.distance(c) < edge && c.distance(a) < edge {
                    let outward = (b - a).cross(c - a).dot(a) > 0.0;
                    faces.push(if outward { [i, j, k] } else { [i, k, j] });
                }
            }
        }
    }
    for _ in 0..level {
        let mut middles: HashMap<(u32, u32), u32> = HashMap::new();
        let mut middle = |a: u32, b: u32| {
            *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                points.push((points[a as usize] + points[b as usize]).normalize());
                points.len() as u32 - 1
            })
        };
        faces = faces
            .into_iter()
            .flat_map(|[a, b, c]| {
                let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
                [[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]
            })
            .collect();
    }
    if smooth {
        return mesh(points.iter().map(|p| *p * radius).collect(), points, faces);
    }
    join(faces.into_iter().map(|f| {
        let [a, b, c] = f.map(|i| points[i as usize] * radius);
        triangle([a, b, c])
    }))
}

/// One triangle with its face normal (any normal when it has no area).
pub fn triangle([a, b, c]: [Vec3; 3]) -> TriangleMesh {
    let n = (b - a).as_dvec3().cross((c - a).as_dvec3()).normalize_or(DVec3::Y).as_vec3();
    mesh(vec![a, b, c], vec![n; 3], vec![[0, 1, 2]])
}

/// A parallelogram that faces `u x v`, with texture coordinates and tangents.
pub fn quad(corner: Vec3, u: Vec3, v: Vec3) -> TriangleMesh {
    let n = u.cross(v).normalize();
    let corners = vec![corner, corner + u, corner + u + v, corner + v];
    let mut m = mesh(corners, vec![n; 4], vec![[0, 1, 2], [0, 2, 3]]);
    m.uvs = vec![Vec2::new(0.0, 1.0), Vec2::ONE, Vec2::new(1.0, 0.0), Vec2::ZERO];
    m.tangents = vec![u.normalize().extend(1.0); 4];
    m
}

/// A floor in the plane `y = height` that faces up, `2 * half` on a side.
pub fn floor(half: f32, height: f32) -> TriangleMesh {
    quad(Vec3::new(-half, height, half), Vec3::X * 2.0 * half, Vec3::NEG_Z * 2.0 * half)
}

/// Lambertian, without a coat.
pub fn diffuse(albedo: Vec3) -> Material {
    Material { base_color: albedo, metallic: 0.0, ior: 1.0, ..Material::default() }
}

/// A black surface that shines from its front.
pub fn emitter(radiance: Vec3) -> Material {
    Material { emissive: radiance, ..diffuse(Vec3::ZERO) }
}

/// The same radiance from everywhere.
pub fn sky(radiance: f32) -> Environment {
    Environment::Constant(Vec3::splat(radiance))
}

/// A camera of 0.6 rad across. It may look straight down.
pub fn camera(width: u32, height: u32, position: DVec3, look_at: DVec3) -> ProjectorCamera {
    let raster = Raster::new(width, height).expect("a small raster");
    let up = if (look_at - position).normalize().cross(DVec3::Y).length() < 1e-6 {
        DVec3::NEG_Z
    } else {
        DVec3::Y
    };
    ProjectorCamera::look_at(raster, position, look_at, up, 0.6).expect("a camera that looks somewhere")
}

/// A small picture of smooth random colours between `low` and `high`, the same for the same seed.
pub fn noise_texture(size: u32, seed: u64, low: u8, high: u8, srgb: bool) -> Texture {
    let mut random = Sampler::new(seed, 0);
    let mut value = || low + (random.uniform() * f64::from(high - low)) as u8;
    let texels = (0..size * size).map(|_| [value(), value(), value(), 255]).collect();
    Texture {
        width: size,
        height: size,
        texels,
        srgb,
        wrap_u: Wrap::Repeat,
        wrap_v: Wrap::Mirror,
        nearest: false,
    }
}

/// Adds a texture and refers to it, stretched and turned so that every part of the transform matters.
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
