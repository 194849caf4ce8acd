//! Generates the built-in scene by code: a glazed ceramic hare and a bronze bust under a lamp, the demo's two moving
//! objects.
//!
//! The hare (`bunny`, 0.20 m, rigid body 0) and the bust (`venus`, 0.30 m, rigid body 1) are placed like the paper's
//! figures, for a projector at (0, 0.10, 1.0) m that looks at (0, 0.03, -0.05) m with a horizontal field of 30 degrees.
//! Both bodies have their origin in the middle, so a rotation turns them in place. The lamp and the sky exist only in
//! the virtual world.

use glam::{DAffine3, DVec3, Quat, Vec2, Vec3};

use super::polygonise::{surface_nets, PolygonSurface};
use super::procedural::{bronze_textures, glaze_textures};
use super::{Body, Environment, Material, Scene, TextureRef, TriangleMesh};

const GLAZE: u32 = 0;
const BRONZE: u32 = 1;
const PLINTH: u32 = 2;
const LAMP: u32 = 3;

/// Number of repetitions of the glaze around the hare, and of the patina around the bust.
const TILES_AROUND: f32 = 3.0;

/// The built-in scene. Takes a fraction of a second; identical on every call.
pub fn builtin() -> Scene {
    // The figures take most of the time: one is made in its own thread, so that the demo starts sooner.
    let (hare, bust) = std::thread::scope(|scope| {
        let other = std::thread::Builder::new().spawn_scoped(scope, hare_body);
        let bust = bust_body();
        let hare = match other {
            Ok(thread) => thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)),
            // Without another thread this is slower, not impossible.
            Err(_) => hare_body(),
        };
        (hare, bust)
    });
    let [glaze_color, glaze_normal] = glaze_textures();
    let [bronze_color, bronze_surface] = bronze_textures();
    Scene {
        bodies: vec![hare, bust, lamp()],
        materials: vec![
            Material {
                name: "glaze".into(),
                metallic: 0.0,
                roughness: 0.18,
                base_color_texture: Some(whole(0)),
                normal_texture: Some(whole(1)),
                normal_scale: 0.6,
                ..Material::default()
            },
            Material {
                name: "bronze".into(),
                metallic: 1.0,
                roughness: 1.0,
                base_color_texture: Some(whole(2)),
                metallic_roughness_texture: Some(whole(3)),
                ..Material::default()
            },
            Material {
                name: "plinth".into(),
                base_color: Vec3::new(0.12, 0.11, 0.13),
                metallic: 0.0,
                roughness: 0.08,
                ..Material::default()
            },
            Material {
                name: "lamp".into(),
                base_color: Vec3::ZERO,
                metallic: 0.0,
                emissive: Vec3::new(7.0, 6.4, 5.6),
                ior: 1.0,
                ..Material::default()
            },
        ],
        live: Vec::new(),
        textures: vec![glaze_color, glaze_normal, bronze_color, bronze_surface],
        lights: vec![],
        environment: Environment::Constant(Vec3::new(0.30, 0.34, 0.40)),
        warnings: vec![],
    }
}

fn hare_body() -> Body {
    let surface =
        surface_nets(&hare, Vec3::new(-0.085, -0.106, -0.085), Vec3::new(0.085, 0.106, 0.1), 0.0019);
    Body {
        name: "bunny".into(),
        tracked: Some(0),
        projected: true,
        world_from_body_rest: DAffine3::from_translation(DVec3::new(-0.10, 0.0, 0.0)),
        motion: None,
        deforms: None,
        mesh: textured_mesh(surface, 0.17, |_| GLAZE),
    }
}

fn bust_body() -> Body {
    let surface = surface_nets(&bust, Vec3::new(-0.115, -0.156, -0.1), Vec3::new(0.115, 0.156, 0.1), 0.0024);
    Body {
        name: "venus".into(),
        tracked: Some(1),
        projected: true,
        world_from_body_rest: DAffine3::from_translation(DVec3::new(0.13, 0.03, -0.18)),
        motion: None,
        deforms: None,
        mesh: textured_mesh(surface, 0.2, |p| if p.y < PLINTH_TOP_M + 0.0015 { PLINTH } else { BRONZE }),
    }
}

fn whole(texture: u32) -> TextureRef {
    TextureRef { texture, offset: Vec2::ZERO, rotation: 0.0, scale: Vec2::ONE }
}

/// A square lamp of 0.5 m, up on the left in front of the objects, shining at them.
fn lamp() -> Body {
    let centre = Vec3::new(-0.45, 0.75, 0.55);
    let toward = (Vec3::new(0.0, 0.0, -0.08) - centre).normalize();
    let (right, up) = toward.any_orthonormal_pair();
    let half = 0.25;
    let corner = |x: f32, y: f32| half * (x * right + y * up);
    let mut mesh = TriangleMesh {
        positions: vec![corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)],
        normals: vec![toward; 4],
        uvs: vec![Vec2::new(0.0, 1.0), Vec2::new(1.0, 1.0), Vec2::new(1.0, 0.0), Vec2::new(0.0, 0.0)],
        tangents: vec![],
        triangles: if right.cross(up).dot(toward) > 0.0 {
            vec![[0, 1, 2], [0, 2, 3]]
        } else {
            vec![[0, 2, 1], [0, 3, 2]]
        },
        materials: vec![LAMP; 2],
        ..TriangleMesh::default()
    };
    mesh.generate_tangents();
    Body {
        name: "lamp".into(),
        tracked: None,
        projected: false,
        world_from_body_rest: DAffine3::from_translation(centre.as_dvec3()),
        motion: None,
        deforms: None,
        mesh,
    }
}

/// Assigns cylindrical texture coordinates about Y (one tile every `tile_height` metres), and closes the seam by
/// splitting vertices.
fn textured_mesh(surface: PolygonSurface, tile_height: f32, material: impl Fn(Vec3) -> u32) -> TriangleMesh {
    let turn = |p: Vec3| p.x.atan2(p.z) / std::f32::consts::TAU + 0.5;
    let mut mesh = TriangleMesh {
        uvs: surface
            .positions
            .iter()
            .map(|&p| Vec2::new(TILES_AROUND * turn(p), -p.y / tile_height))
            .collect(),
        positions: surface.positions,
        normals: surface.normals,
        triangles: surface.triangles,
        ..TriangleMesh::default()
    };
    let mut twin = std::collections::HashMap::new();
    for k in 0..mesh.triangles.len() {
        let u = mesh.triangles[k].map(|i| mesh.uvs[i as usize].x);
        let greatest = u[0].max(u[1]).max(u[2]);
        for (corner, u) in u.into_iter().enumerate() {
            if greatest - u > 0.5 * TILES_AROUND {
                let i = mesh.triangles[k][corner];
                mesh.triangles[k][corner] = *twin.entry(i).or_insert_with(|| {
                    mesh.positions.push(mesh.positions[i as usize]);
                    mesh.normals.push(mesh.normals[i as usize]);
                    mesh.uvs.push(mesh.uvs[i as usize] + Vec2::new(TILES_AROUND, 0.0));
                    mesh.positions.len() as u32 - 1
                });
            }
        }
    }
    mesh.materials = mesh
        .triangles
        .iter()
        .map(|t| material(t.iter().map(|&i| mesh.positions[i as usize]).sum::<Vec3>() / 3.0))
        .collect();
    mesh.drop_unusable();
    mesh.generate_tangents();
    mesh
}

/// Smooth minimum with blend radius `k` (polynomial): at most k/4 below the lesser.
fn blend(a: f32, b: f32, k: f32) -> f32 {
    let h = (k - (a - b).abs()).max(0.0) / k;
    a.min(b) - 0.25 * h * h * k
}

/// Subtracts `b` from `a` with a rounded edge.
fn carve(a: f32, b: f32, k: f32) -> f32 {
    -blend(-a, b, k)
}

/// First-order distance to an ellipsoid.
fn ellipsoid(p: Vec3, centre: Vec3, radii: Vec3) -> f32 {
    let q = (p - centre) / radii;
    let slope = (q / radii).length();
    let r = q.length();
    if slope < 1e-6 {
        -radii.min_element()
    } else {
        r * (r - 1.0) / slope
    }
}

/// Distance to a cone with round ends.
fn limb(p: Vec3, a: Vec3, b: Vec3, radius_a: f32, radius_b: f32) -> f32 {
    let (pa, ba) = (p - a, b - a);
    let t = (pa.dot(ba) / ba.length_squared()).clamp(0.0, 1.0);
    (pa - t * ba).length() - (radius_a + t * (radius_b - radius_a))
}

/// A seated hare looking along +Z with a slight turn; from y = -0.10 to 0.10 m.
fn hare(p: Vec3) -> f32 {
    let v = Vec3::new;
    let m = v(p.x.abs(), p.y, p.z); // limbs in pairs
    let mut d = ellipsoid(p, v(0.0, -0.048, -0.018), v(0.044, 0.048, 0.054)); // trunk
    d = blend(d, ellipsoid(p, v(0.0, -0.022, 0.012), v(0.033, 0.038, 0.032)), 0.03); // chest
    d = blend(d, ellipsoid(m, v(0.034, -0.066, -0.012), v(0.020, 0.032, 0.038)), 0.014); // haunches
    d = blend(d, limb(m, v(0.034, -0.092, 0.0), v(0.031, -0.092, 0.042), 0.0095, 0.0085), 0.012); // hind feet
    d = blend(d, limb(m, v(0.017, -0.04, 0.03), v(0.016, -0.091, 0.044), 0.0115, 0.009), 0.014); // fore legs
    d = blend(d, ellipsoid(p, v(0.0, -0.058, -0.07), v(0.016, 0.017, 0.015)), 0.008); // tail
    let head = Quat::from_rotation_y(-0.25).inverse() * (p - v(0.0, 0.026, 0.03));
    let h = v(head.x.abs(), head.y, head.z);
    let mut skull = ellipsoid(head, Vec3::ZERO, v(0.027, 0.026, 0.032));
    skull = blend(skull, ellipsoid(head, v(0.0, -0.008, 0.026), v(0.015, 0.013, 0.015)), 0.016); // muzzle
    skull = blend(skull, ellipsoid(h, v(0.011, -0.01, 0.014), v(0.014, 0.012, 0.014)), 0.010); // cheeks
    skull = carve(skull, ellipsoid(h, v(0.0245, 0.006, 0.016), v(0.006, 0.006, 0.006)), 0.006); // sockets
    skull = skull.min(ellipsoid(h, v(0.0215, 0.006, 0.0155), Vec3::splat(0.0048))); // eyes
    let mut ear = limb(h, v(0.012, 0.018, -0.010), v(0.0225, 0.066, -0.024), 0.0085, 0.0070);
    ear = carve(ear, ellipsoid(h, v(0.0195, 0.047, -0.0085), v(0.0045, 0.024, 0.0065)), 0.004); // hollow of the ear
    skull = blend(skull, ear, 0.008);
    blend(d, skull, 0.022)
}

/// Above this height of the bust it is bronze, below a stone plinth.
const PLINTH_TOP_M: f32 = -0.118;

/// A classical bust on a plinth looking along +Z, slightly down and to the side; from y = -0.15 to 0.15 m.
fn bust(p: Vec3) -> f32 {
    let v = Vec3::new;
    let m = v(p.x.abs(), p.y, p.z);
    // Shoulders, cut at the arms and below as busts are.
    let mut d = ellipsoid(m, v(0.034, -0.055, -0.006), v(0.062, 0.036, 0.044));
    d = blend(d, ellipsoid(p, v(0.0, -0.070, 0.006), v(0.060, 0.046, 0.046)), 0.03);
    d = blend(d, ellipsoid(m, v(0.03, -0.085, 0.022), v(0.026, 0.026, 0.026)), 0.02);
    d = -blend(-d, 0.078 - m.x, 0.012);
    d = -blend(-d, p.y + 0.106, 0.008);
    d = blend(d, limb(p, v(0.0, -0.125, -0.004), v(0.0, -0.095, -0.004), 0.024, 0.03), 0.01); // stem
    d = blend(d, limb(p, v(0.0, -0.04, -0.012), v(0.002, 0.03, -0.002), 0.027, 0.022), 0.028); // neck
    let head =
        (Quat::from_rotation_y(-0.3) * Quat::from_rotation_x(0.10)).inverse() * (p - v(0.002, 0.068, 0.004));
    let h = v(head.x.abs(), head.y, head.z);
    let mut face = ellipsoid(head, v(0.0, 0.012, -0.008), v(0.040, 0.048, 0.050)); // skull
    face = blend(face, ellipsoid(head, v(0.0, -0.014, 0.014), v(0.030, 0.042, 0.030)), 0.02); // face
    face = blend(face, ellipsoid(head, v(0.0, -0.046, 0.030), v(0.012, 0.011, 0.011)), 0.014); // chin
    face = carve(face, ellipsoid(h, v(0.0155, 0.004, 0.046), v(0.0115, 0.0075, 0.010)), 0.008); // eye sockets
    face = blend(face, ellipsoid(h, v(0.0150, 0.003, 0.0345), v(0.0085, 0.0055, 0.0075)), 0.003); // lids
    face = blend(face, limb(head, v(0.0, 0.008, 0.041), v(0.0, -0.016, 0.052), 0.0042, 0.0062), 0.007); // nose
    face = blend(face, ellipsoid(h, v(0.0055, -0.0175, 0.0475), v(0.005, 0.0045, 0.006)), 0.003); // nostrils
    face = blend(face, ellipsoid(head, v(0.0, -0.0275, 0.0425), v(0.0115, 0.0032, 0.0055)), 0.003); // upper lip
    face = blend(face, ellipsoid(head, v(0.0, -0.0345, 0.0415), v(0.0095, 0.0035, 0.0055)), 0.0025); // lower lip
    face = blend(face, ellipsoid(h, v(0.020, -0.012, 0.028), v(0.012, 0.012, 0.012)), 0.014); // cheeks
    face = blend(face, ellipsoid(h, v(0.0395, -0.004, -0.006), v(0.0035, 0.012, 0.008)), 0.004); // ears
                                                                                                 // Waved hair, parted in the middle and gathered in a knot at the back.
    let wave = 0.0016 * (260.0 * head.y + 120.0 * h.x + 60.0 * head.z).sin();
    let mut hair = ellipsoid(head, v(0.0, 0.0215, -0.012), v(0.0445, 0.0475, 0.0525)) + wave;
    hair = carve(hair, ellipsoid(head, v(0.0, -0.014, 0.052), v(0.0335, 0.052, 0.040)), 0.008); // hairline
    hair = carve(hair, limb(head, v(0.0, 0.075, -0.05), v(0.0, 0.06, 0.06), 0.0045, 0.0045), 0.006); // parting
    hair = blend(hair, ellipsoid(head, v(0.0, 0.006, -0.066), v(0.022, 0.021, 0.018)) + 0.6 * wave, 0.010); // knot
    face = blend(face, hair, 0.004);
    d = blend(d, face, 0.016);
    // A round plinth with a moulding.
    let radial = v(p.x, 0.0, p.z).length();
    let slab = |radius: f32, low: f32, high: f32| {
        let (dx, dy) = (radial - radius, (p.y - 0.5 * (low + high)).abs() - 0.5 * (high - low));
        let round = 0.003;
        Vec2::new((dx + round).max(0.0), (dy + round).max(0.0)).length()
            + (dx + round).max(dy + round).min(0.0)
            - round
    };
    let plinth = slab(0.056, -0.150, -0.136).min(slab(0.046, -0.139, PLINTH_TOP_M));
    d.min(plinth)
}

/// Made once for all tests that use it.
#[cfg(test)]
pub(crate) static SHARED: std::sync::LazyLock<Scene> = std::sync::LazyLock::new(builtin);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_figures_keep_every_promise_of_a_mesh_and_stand_in_their_box() {
        let scene = &*SHARED;
        let height = |b: &Body| {
            let y = b.mesh.positions.iter().map(|p| p.y);
            y.clone().fold(f32::MIN, f32::max) - y.fold(f32::MAX, f32::min)
        };
        for (index, (name, metres)) in [("bunny", 0.20), ("venus", 0.30)].into_iter().enumerate() {
            let body = &scene.bodies[index];
            assert_eq!((body.name.as_str(), body.tracked, body.projected), (name, Some(index as u16), true));
            let mesh = &body.mesh;
            assert!(
                (20_000..=60_000).contains(&mesh.triangles.len()),
                "{name} has {} triangles",
                mesh.triangles.len()
            );
            assert!((height(body) - metres).abs() < 0.012, "{name} is {} m tall", height(body));
            let n = mesh.positions.len();
            assert_eq!([mesh.normals.len(), mesh.tangents.len(), mesh.uvs.len()], [n; 3]);
            assert_eq!(mesh.materials.len(), mesh.triangles.len());
            let mut volume = 0.0;
            let mut agree = 0;
            for t in &mesh.triangles {
                let [a, b, c] = t.map(|i| mesh.positions[i as usize].as_dvec3());
                volume += a.dot(b.cross(c)) / 6.0;
                let face = (b - a).cross(c - a).normalize().as_vec3();
                agree += usize::from(t.iter().all(|&i| face.dot(mesh.normals[i as usize]) > 0.3));
                let off_axis = (a + b + c).with_y(0.0).length() / 3.0;
                let u = t.map(|i| mesh.uvs[i as usize].x);
                assert!(
                    off_axis < 0.005
                        || u[0].max(u[1]).max(u[2]) - u[0].min(u[1]).min(u[2]) <= 0.5 * TILES_AROUND + 1e-3,
                    "a face spans the seam"
                );
            }
            assert!(volume > 1e-4, "{name} is inside out or empty: {volume} m^3");
            assert!(
                agree as f64 > 0.98 * mesh.triangles.len() as f64,
                "normals disagree with faces: {agree}"
            );
            assert!(mesh
                .tangents
                .iter()
                .zip(&mesh.normals)
                .all(|(t, n)| t.is_finite() && t.truncate().dot(*n).abs() < 1e-4));
        }
        let lamp = &scene.bodies[2];
        assert!(!lamp.projected && lamp.tracked.is_none());
        let to_objects = -lamp.world_from_body_rest.translation.as_vec3();
        let t = lamp.mesh.triangles[0].map(|i| lamp.mesh.positions[i as usize]);
        assert!((t[1] - t[0]).cross(t[2] - t[0]).dot(to_objects) > 0.0, "the lamp shines away");
    }

    #[test]
    fn a_projector_in_front_sees_both_figures_whole() {
        let (eye, target) = (DVec3::new(0.0, 0.10, 1.0), DVec3::new(0.0, 0.03, -0.05));
        let forward = (target - eye).normalize();
        let right = forward.cross(DVec3::Y).normalize();
        let up = right.cross(forward);
        let half_width = 15f64.to_radians().tan();
        for body in &SHARED.bodies[..2] {
            for p in &body.mesh.positions {
                let d = body.world_from_body_rest.transform_point3(p.as_dvec3()) - eye;
                let (x, y) = (d.dot(right) / d.dot(forward), d.dot(up) / d.dot(forward));
                assert!(
                    x.abs() < half_width && y.abs() < 0.75 * half_width,
                    "{} leaves the picture",
                    body.name
                );
            }
        }
    }
}
