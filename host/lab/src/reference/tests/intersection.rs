//! Triangles that are dropped, and trees of equal centroids. Brute force, watertightness and self-hits are stability cases
//! (`experiments/stability/tracer.rs`), which run with the unit tests too.

use super::*;
use crate::reference::bvh::{Bvh, Triangle};
use crate::reference::{Reference, Sampler};

fn on_sphere(s: &mut Sampler) -> DVec3 {
    let z = 2.0 * s.uniform() - 1.0;
    let phi = std::f64::consts::TAU * s.uniform();
    let r = (1.0 - z * z).sqrt();
    DVec3::new(r * phi.cos(), r * phi.sin(), z)
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
    let bvh = Bvh::new(crate::stability::tracer::doubling());
    for i in [0, 1, 450, 700] {
        let s = 2f64.powi(i - 450);
        let hit = bvh.closest(DVec3::new(s * 0.75, 0.25, 0.25), DVec3::X, f64::INFINITY, |_| true).unwrap();
        assert_eq!(bvh.triangle(hit.triangle).index, i as u32);
    }
}
