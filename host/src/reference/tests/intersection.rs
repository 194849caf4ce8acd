//! Rays against triangles: brute force, watertightness, degenerate and extreme geometry.

use super::*;
use crate::reference::bvh::{Bvh, Triangle};
use crate::reference::{Reference, Sampler};

fn triangles(mesh: &TriangleMesh) -> Vec<Triangle> {
    (mesh.triangles.iter().enumerate())
        .map(|(i, t)| Triangle {
            p: t.map(|v| mesh.positions[v as usize].as_dvec3()),
            body: 0,
            index: i as u32,
        })
        .collect()
}

fn on_sphere(s: &mut Sampler) -> DVec3 {
    let z = 2.0 * s.uniform() - 1.0;
    let phi = std::f64::consts::TAU * s.uniform();
    let r = (1.0 - z * z).sqrt();
    DVec3::new(r * phi.cos(), r * phi.sin(), z)
}

fn same(bvh: &Bvh, origin: DVec3, direction: DVec3) {
    let (a, b) = (
        bvh.closest(origin, direction, f64::INFINITY, |_| true),
        bvh.closest_brute_force(origin, direction, f64::INFINITY),
    );
    // On a shared edge two triangles are hit at one distance; which of them is reported is of no matter.
    assert_eq!(a.map(|h| h.t), b.map(|h| h.t), "{origin} {direction}");
    assert_eq!(bvh.any(origin, direction, f64::INFINITY, |_| true), a.is_some());
}

fn random_triangles(n: usize, size: f64, seed: u64) -> Vec<Triangle> {
    let mut s = Sampler::new(seed, 0);
    (0..n)
        .map(|i| {
            let c = on_sphere(&mut s) * s.uniform();
            let p = std::array::from_fn(|_| c + on_sphere(&mut s) * size);
            Triangle { p, body: 0, index: i as u32 }
        })
        .collect()
}

#[test]
fn hierarchy_equals_brute_force() {
    for (n, size) in [(1, 0.5), (2, 0.5), (3, 0.5), (5, 0.3), (700, 0.2), (700, 0.01)] {
        let bvh = Bvh::new(random_triangles(n, size, n as u64));
        assert_eq!(bvh.triangles().len(), n);
        let mut s = Sampler::new(9, n as u64);
        for _ in 0..700 {
            same(&bvh, on_sphere(&mut s) * 1.5 * s.uniform(), on_sphere(&mut s));
        }
    }
    let empty = Bvh::new(vec![]);
    assert!(empty.closest(DVec3::ZERO, DVec3::X, f64::INFINITY, |_| true).is_none());
}

#[test]
fn axis_parallel_rays_and_signed_zeros_equal_brute_force() {
    // A grid of unit quads whose planes, edges and corners the rays run along.
    let mut soup = Vec::new();
    for i in 0..4 {
        for j in 0..4 {
            for k in 0..2 {
                soup.extend(triangles(&quad(Vec3::new(i as f32, k as f32, j as f32), Vec3::Z, Vec3::X)));
            }
        }
    }
    let bvh = Bvh::new(soup);
    let values = [-1.0, -0.0, 0.0, 0.25, 1.0, 2.0, 4.0];
    let mut hits = 0;
    for axis in 0..3 {
        for sign in [1.0, -1.0] {
            for zero in [0.0, -0.0] {
                let mut d = DVec3::splat(zero);
                d[axis] = sign;
                for x in values {
                    for y in values {
                        for z in values {
                            let o = DVec3::new(x, y, z);
                            same(&bvh, o, d);
                            hits += i32::from(bvh.any(o, d, 9.0, |_| true));
                        }
                    }
                }
            }
        }
    }
    // Straight down from above onto points inside, on edges and on corners of the grid: 5 x 5 positions of x, z in 0..4.
    assert!(hits > 200, "{hits}");
    for x in [0.25, 1.0, 2.0, 3.999] {
        assert!(bvh.any(DVec3::new(x, 3.0, 1.0), -DVec3::Y, 9.0, |_| true), "{x}");
    }
}

#[test]
fn invalid_rays_hit_nothing() {
    let bvh = Bvh::new(random_triangles(50, 0.5, 1));
    for (o, d) in [
        (DVec3::NAN, DVec3::X),
        (DVec3::ZERO, DVec3::NAN),
        (DVec3::ZERO, DVec3::ZERO),
        (DVec3::new(f64::INFINITY, 0.0, 0.0), -DVec3::X),
        (DVec3::ZERO, DVec3::new(f64::INFINITY, 0.0, 0.0)),
    ] {
        assert!(bvh.closest(o, d, f64::INFINITY, |_| true).is_none());
        assert!(bvh.closest_brute_force(o, d, f64::INFINITY).is_none());
    }
}

#[test]
fn no_ray_leaves_a_closed_mesh() {
    for (radius, distance) in [(1.0f32, 0.0f32), (1e-3, 0.0), (1e4, 0.0), (1.0, 1e4), (1e-2, 1e3)] {
        let centre = Vec3::new(0.6, -0.7, 0.4) * distance;
        let ball = sphere(centre, radius, 3, true);
        let corners: Vec<DVec3> = ball.positions.iter().map(|p| p.as_dvec3()).collect();
        let bvh = Bvh::new(triangles(&ball));
        let mut s = Sampler::new(4, 0);
        let mut leaks = 0;
        for i in 0..20_000usize {
            let from = centre.as_dvec3() + on_sphere(&mut s) * f64::from(radius) * 0.7 * s.uniform();
            // Every other ray aims at a corner or the middle of an edge, where a leak would be.
            let to = match i % 4 {
                0 => corners[i % corners.len()],
                1 => {
                    let t = ball.triangles[i % ball.triangles.len()];
                    (corners[t[0] as usize] + corners[t[1] as usize]) * 0.5
                }
                _ => from + on_sphere(&mut s),
            };
            leaks += usize::from(!bvh.any(from, (to - from).normalize(), f64::INFINITY, |_| true));
        }
        assert_eq!(leaks, 0, "radius {radius} at {distance}");
    }
}

#[test]
fn new_rays_do_not_hit_the_surface_they_leave() {
    for (radius, distance) in [(1e-6f32, 0.0), (1e-3, 0.0), (1e-3, 1e4), (1.0, 1e5), (1e4, 1e4), (1e6, 0.0)] {
        let c = DVec3::new(0.36, 0.48, 0.8) * distance;
        let s = scene_of(sphere(Vec3::ZERO, radius, 3, false), diffuse(Vec3::ONE));
        let r = Reference::new(&s, &[DAffine3::from_translation(c)]);
        let mut sampler = Sampler::new(6, 0);
        for _ in 0..3000 {
            let d = on_sphere(&mut sampler);
            let far = 3.0 * f64::from(radius);
            let hit = r.trace(c + d * far, -d, f64::INFINITY, false).expect("aimed at the centre");
            let w = on_sphere(&mut sampler);
            let out = w * w.dot(hit.geometric).signum();
            let outside = crate::reference::offset(hit.position, hit.geometric, out, hit.scale);
            assert!(
                !r.occluded(outside, out, f64::INFINITY, false),
                "self hit: radius {radius} at {distance}"
            );
            let inside = crate::reference::offset(hit.position, hit.geometric, -out, hit.scale);
            assert!(r.occluded(inside, -out, f64::INFINITY, false), "leak: radius {radius} at {distance}");
        }
    }
}

#[test]
fn degenerate_triangles_are_dropped_and_needles_do_no_harm() {
    let mut m = sphere(Vec3::ZERO, 1.0, 1, true);
    let n = m.positions.len() as u32;
    m.positions.extend([
        Vec3::splat(f32::NAN),
        Vec3::X * 1e-3,
        Vec3::X * 1e-3,
        Vec3::new(0.0, 1e-30, 0.0),
        Vec3::X,
    ]);
    m.normals.extend([Vec3::Y; 5]);
    m.tangents.extend([Vec4::X; 5]);
    m.uvs.extend([Vec2::ZERO; 5]);
    let good = m.triangles.len();
    // NaN corner, two equal corners, all equal, collinear, and one needle of aspect 1e30.
    m.triangles.extend([
        [n, 0, 1],
        [n + 1, n + 2, 0],
        [n + 1, n + 1, n + 1],
        [n + 1, n + 2, n + 4],
        [n + 1, n + 3, n + 4],
    ]);
    let s = scene_of(m, diffuse(Vec3::splat(0.5)));
    let r = Reference::new(&s, &[]);
    assert_eq!(r.dropped_triangles, 4);
    assert_eq!(r.bvh().triangles().len(), good + 1);
    let mut sampler = Sampler::new(8, 0);
    for _ in 0..2000 {
        let d = on_sphere(&mut sampler);
        let hit = r.trace(d * 3.0, -d, f64::INFINITY, false).expect("closed");
        assert!(hit.position.is_finite() && hit.geometric.is_normalized() && hit.shading.is_normalized());
    }
}

#[test]
fn equal_centroids_and_duplicates_build_and_hit() {
    let one = Triangle { p: [DVec3::X, DVec3::Y, DVec3::Z], body: 0, index: 0 };
    let bvh = Bvh::new((0..20_000).map(|index| Triangle { index, ..one }).collect());
    assert_eq!(bvh.triangles().len(), 20_000);
    let hit = bvh.closest(DVec3::ZERO, DVec3::ONE, 9.0, |_| true).unwrap();
    assert!((hit.t - 1.0 / 3.0).abs() < 1e-15);
    // Coordinates that double from one triangle to the next would give a tree as deep as their number.
    let deep: Vec<Triangle> = (0..900)
        .map(|i| {
            let s = 2f64.powi(i - 450);
            Triangle {
                p: [DVec3::X * s, DVec3::new(s, 1.0, 0.0), DVec3::new(s, 0.0, 1.0)],
                body: 0,
                index: i as u32,
            }
        })
        .collect();
    let bvh = Bvh::new(deep);
    for i in [0, 1, 450, 700] {
        let s = 2f64.powi(i - 450);
        let hit = bvh.closest(DVec3::new(s * 0.75, 0.25, 0.25), DVec3::X, f64::INFINITY, |_| true).unwrap();
        assert_eq!(bvh.triangle(hit.triangle).index, i as u32);
    }
}
