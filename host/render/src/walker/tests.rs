use super::*;
use bytemuck::Zeroable;
use dpm_device::rng::Sampler;
use dpm_scene::bvh::BodyBvh;
use dpm_scene::shapes::{join, sphere, triangle};
use dpm_scene::TriangleMesh;
use dpm_shaders::structs::INSTANCE_PROJECTED;
use glam::{DAffine3, DQuat, DVec3, Vec3};

/// A body where it stands, with its tree and its mesh in BVH order.
struct WalkedBody {
    instance: Instance,
    tree: WideTree,
    corners: Vec<[Vec3; 3]>,
}

fn body(number: usize, mesh: &TriangleMesh, pose: DAffine3, flags: u32) -> WalkedBody {
    let bvh = BodyBvh::build(mesh);
    let corners: Vec<[Vec3; 3]> =
        (bvh.order.iter()).map(|&t| mesh.triangles[t as usize].map(|v| mesh.positions[v as usize])).collect();
    let tree = WideTree::new(&bvh.nodes, |at| corners[at].map(|p| p.to_array()));
    let world = corners.iter().flatten().map(|p| pose.transform_point3(p.as_dvec3()).as_vec3());
    let [lower, upper] = world.fold([Vec3::INFINITY, Vec3::NEG_INFINITY], |[l, u], p| [l.min(p), u.max(p)]);
    let instance = Instance {
        object_from_world: crate::scene_data::rows(&pose.inverse()),
        bounds_min: (lower - 1e-5).into(),
        bounds_max: (upper + 1e-5).into(),
        body: number as u32,
        flags,
        ..Instance::zeroed()
    };
    WalkedBody { instance, tree, corners }
}

fn point(random: &mut Sampler) -> Vec3 {
    Vec3::from_array(std::array::from_fn(|_| random.uniform() as f32 * 2.0 - 1.0))
}

fn ray(origin: Vec3, direction: Vec3, kind: u32) -> Ray {
    Ray { origin: origin.into(), t_max: 3e38, direction: direction.into(), kind }
}

fn hits_of(kernel: WalkKernel, bodies: &[WalkedBody], body_nodes: &[BodyNode], rays: &[Ray]) -> Vec<u32> {
    let instances: Vec<_> = bodies.iter().map(|b| b.instance).collect();
    let trees: Vec<_> = bodies.iter().map(|b| b.tree.clone()).collect();
    let mut hits = vec![0; rays.len()];
    kernel.walk(&WalkScene { bodies: &instances, trees: &trees, body_nodes }, rays, &mut hits);
    hits
}

/// Distances along a ray at which it meets each triangle of all bodies, by f64 and without a tree.
fn distances(bodies: &[WalkedBody], ray: &Ray, mask: u32) -> Vec<(f64, u32)> {
    let mut met = Vec::new();
    for (i, body) in bodies.iter().enumerate().filter(|(_, b)| mask == 0 || b.instance.flags & mask != 0) {
        let row = |r: usize| body.instance.object_from_world[r].map(f64::from);
        let apply = |v: DVec3, w: f64| {
            DVec3::from_array(std::array::from_fn(|r| {
                row(r)[0] * v.x + row(r)[1] * v.y + row(r)[2] * v.z + row(r)[3] * w
            }))
        };
        let o = apply(Vec3::from(ray.origin).as_dvec3(), 1.0);
        let d = apply(Vec3::from(ray.direction).as_dvec3(), 0.0);
        for (k, corners) in body.corners.iter().enumerate() {
            let [a, b, c] = corners.map(|p| p.as_dvec3());
            let (e1, e2) = (b - a, c - a);
            let p = d.cross(e2);
            let det = e1.dot(p);
            let (u, v) = ((o - a).dot(p) / det, d.dot((o - a).cross(e1)) / det);
            let t = e2.dot((o - a).cross(e1)) / det;
            if u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 0.0 {
                met.push((t, (i as u32) << 24 | k as u32));
            }
        }
    }
    met
}

fn some_bodies(random: &mut Sampler) -> Vec<WalkedBody> {
    let soup = join((0..300).map(|_| {
        let at = point(random);
        triangle([at, at + point(random) * 0.2, at + point(random) * 0.2])
    }));
    let meshes = [soup, sphere(Vec3::ZERO, 0.6, 3, true), sphere(Vec3::new(0.1, 0.0, 0.0), 0.4, 2, true)];
    let place = |i: usize, mesh: &TriangleMesh, random: &mut Sampler| {
        let turn = DQuat::from_axis_angle(point(random).as_dvec3().normalize(), 1.0 + i as f64);
        let pose = DAffine3::from_rotation_translation(turn, point(random).as_dvec3());
        body(i, mesh, pose, if i == 1 { 0 } else { INSTANCE_PROJECTED })
    };
    meshes.iter().enumerate().map(|(i, mesh)| place(i, mesh, random)).collect()
}

/// Every kernel finds the nearest triangle of every ray, or one that is nearer than another by no more than rounding; a ray that asks for any surface
/// finds one exactly if there is one.
#[test]
fn the_nearest_triangle_is_found_by_every_kernel() {
    let mut random = Sampler::new(11, 0);
    let bodies = some_bodies(&mut random);
    let mut rays = Vec::new();
    for i in 0..3000 {
        let origin = point(&mut random) * 2.0;
        let direction = point(&mut random) - origin;
        let mask = if i % 5 == 0 { INSTANCE_PROJECTED << 8 } else { 0 };
        rays.push(ray(origin, direction, Ray::CLOSEST | mask));
        rays.push(Ray { t_max: 0.7, ..ray(origin, direction, Ray::ANY | mask) });
    }
    let all: Vec<Vec<u32>> =
        WalkKernel::available().iter().map(|k| hits_of(*k, &bodies, &[], &rays)).collect();
    for other in &all[1..] {
        assert_eq!(&all[0], other, "kernels differ");
    }
    let (mut near, mut found) = (0, 0);
    for (ray, &hit) in rays.iter().zip(&all[0]) {
        let met = distances(&bodies, ray, ray.kind >> 8);
        let within: Vec<_> = met.iter().filter(|m| m.0 < f64::from(ray.t_max)).collect();
        let nearest = within.iter().map(|m| m.0).fold(f64::INFINITY, f64::min);
        found += u32::from(hit != NO_HIT);
        let is_right = match ray.kind & 0xff {
            Ray::ANY => {
                within.is_empty() == (hit == NO_HIT) && (hit == NO_HIT || within.iter().any(|m| m.1 == hit))
            }
            _ => {
                let of_hit = within.iter().find(|m| m.1 == hit).map_or(f64::INFINITY, |m| m.0);
                of_hit == nearest || (of_hit - nearest).abs() < 1e-5
            }
        };
        near += u32::from(!is_right);
    }
    // Rays that pass within rounding of an edge or of their end: the two need not agree.
    assert!(near <= 2, "{near} of {} rays differ", rays.len());
    assert!(found > 800, "{found} hits test little");
}

/// From within a closed surface no ray gets out, however exactly it aims at an edge or a corner.
#[test]
fn no_ray_leaks_through_an_edge() {
    let mut random = Sampler::new(5, 0);
    let turn = DQuat::from_axis_angle(DVec3::new(0.3, 0.5, 0.2).normalize(), 0.7);
    for (scale, at) in [(1.0, DVec3::ZERO), (0.1, DVec3::new(0.3, -2.0, 1.5))] {
        let mesh = sphere(Vec3::ZERO, scale, 4, true);
        let one = body(0, &mesh, DAffine3::from_rotation_translation(turn, at), 0);
        let world = |p: Vec3| {
            (DAffine3::from_rotation_translation(turn, at).transform_point3(p.as_dvec3())).as_vec3()
        };
        let mut rays = Vec::new();
        for corners in &one.corners {
            let origin = world(point(&mut random) * 0.3 * scale);
            let [a, b, c] = *corners;
            let part = random.uniform() as f32;
            for target in [a, a.lerp(b, 0.5), b.lerp(c, part), (a + b + c) / 3.0] {
                rays.push(ray(origin, world(target) - origin, Ray::CLOSEST));
            }
        }
        for kernel in WalkKernel::available() {
            let hits = hits_of(*kernel, std::slice::from_ref(&one), &[], &rays);
            let leaks = hits.iter().filter(|hit| **hit == NO_HIT).count();
            assert_eq!(leaks, 0, "{} of {} rays by {}", leaks, rays.len(), kernel.name());
        }
    }
}

/// Bodies are found in the tree over them as in the list, and what cannot be walked meets nothing.
#[test]
fn a_tree_over_the_bodies_changes_nothing_and_rays_without_a_way_meet_nothing() {
    let mut random = Sampler::new(3, 0);
    let ball = sphere(Vec3::ZERO, 0.2, 2, true);
    let bodies: Vec<WalkedBody> = (0..40)
        .map(|i| body(i, &ball, DAffine3::from_translation(point(&mut random).as_dvec3() * 2.0), 0))
        .collect();
    let mut over = crate::body_tree::BodyTree::new(bodies.len());
    bodies.iter().for_each(|b| over.add(&b.instance));
    let mut nodes = vec![BodyNode::zeroed(); over.most_nodes()];
    let count = over.write(&mut nodes) as usize;
    let toward = |origin: Vec3, at: Vec3| ray(origin, at - origin, Ray::CLOSEST);
    let rays: Vec<Ray> = (0..2000).map(|_| toward(point(&mut random) * 3.0, point(&mut random))).collect();
    let best = WalkKernel::best();
    let found = hits_of(best, &bodies, &[], &rays);
    assert_eq!(found, hits_of(best, &bodies, &nodes[..8 * count], &rays));
    assert!(found.iter().filter(|hit| **hit != NO_HIT).count() > 200);
    let nowhere = [
        ray(Vec3::splat(f32::NAN), Vec3::X, Ray::CLOSEST),
        ray(Vec3::ZERO, Vec3::new(f32::INFINITY, 0.0, 0.0), Ray::ANY),
        ray(Vec3::ZERO, Vec3::ZERO, Ray::CLOSEST),
        ray(Vec3::ZERO, Vec3::X, Ray::NONE),
    ];
    for kernel in WalkKernel::available() {
        assert_eq!(hits_of(*kernel, &bodies, &[], &nowhere), [NO_HIT; 4], "{}", kernel.name());
    }
}
