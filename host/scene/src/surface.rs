//! A body's surface into points spread evenly over it, for registering it against what a camera or a projector sees.

use dpm_device::rng::Draws;
use glam::Vec3;

use super::Body;

/// `n` points on the surface in body space, metres: equal area has an equal share of points. One point falls into each of `n` equal
/// parts of the area taken in the order of the triangles, which spreads them better than independent draws; the same seed gives the same
/// points. Empty when the body has no area.
pub fn sample_points(body: &Body, n: usize, seed: u64) -> Vec<Vec3> {
    let mesh = &body.mesh;
    let mut area_before = Vec::with_capacity(mesh.triangles.len());
    let mut total = 0.0;
    for t in 0..mesh.triangles.len() {
        area_before.push(total);
        total += mesh.triangle_area(t);
    }
    if total <= 0.0 {
        return vec![];
    }
    let draws = Draws::new(seed);
    let point = |k: usize| {
        let index = 3 * k as u64;
        let at = total * ((k as f64 + draws.unit(index)) / n as f64);
        let t = area_before.partition_point(|&before| before <= at).max(1) - 1;
        let [a, b, c] = mesh.triangles[t].map(|i| mesh.positions[i as usize].as_dvec3());
        // The square root makes the density even over the triangle.
        let (s, v) = (draws.unit(index + 1).sqrt(), draws.unit(index + 2));
        (a * (1.0 - s) + b * (s * (1.0 - v)) + c * (s * v)).as_vec3()
    };
    (0..n).map(point).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TriangleMesh;

    fn body(mesh: TriangleMesh) -> Body {
        Body {
            name: "test".into(),
            tracked: None,
            projected: true,
            world_from_body_rest: glam::DAffine3::IDENTITY,
            mesh,
        }
    }

    /// Two right triangles in the planes z = 0 and z = 1 with areas 1/2 and 3/2.
    fn two_triangles() -> Body {
        let p = |x: f32, y: f32, z: f32| Vec3::new(x, y, z);
        let positions = vec![
            p(0.0, 0.0, 0.0),
            p(1.0, 0.0, 0.0),
            p(0.0, 1.0, 0.0),
            p(0.0, 0.0, 1.0),
            p(3.0, 0.0, 1.0),
            p(0.0, 1.0, 1.0),
        ];
        body(TriangleMesh {
            positions,
            triangles: vec![[0, 1, 2], [3, 4, 5]],
            materials: vec![0, 0],
            ..TriangleMesh::default()
        })
    }

    #[test]
    fn shares_follow_areas_and_moments_follow_the_closed_form() {
        let n = 40_000;
        let points = sample_points(&two_triangles(), n, 3);
        let upper: Vec<_> = points.iter().filter(|p| p.z == 1.0).collect();
        assert!(
            upper.len().abs_diff(3 * n / 4) <= 1,
            "the shares of a stratified draw are exact: {}",
            upper.len()
        );
        // Uniform on (0,0) (3,0) (0,1): mean (1, 1/3), variance of x = 9/18 = 1/2.
        let m = upper.len() as f64;
        let mean_x = upper.iter().map(|p| f64::from(p.x)).sum::<f64>() / m;
        let mean_y = upper.iter().map(|p| f64::from(p.y)).sum::<f64>() / m;
        let variance = upper.iter().map(|p| (f64::from(p.x) - mean_x).powi(2)).sum::<f64>() / m;
        assert!(
            (mean_x - 1.0).abs() < 5.0 * (0.5 / m).sqrt()
                && (mean_y - 1.0 / 3.0).abs() < 5.0 * (1.0 / 18.0 / m).sqrt()
        );
        assert!((variance - 0.5).abs() < 0.02, "{variance}");
        assert!(points.iter().all(|p| p.x >= 0.0
            && p.y >= 0.0
            && p.x / if p.z == 1.0 { 3.0 } else { 1.0 } + p.y <= 1.0 + 1e-6));
    }

    #[test]
    fn seeds_repeat_and_nothing_gives_nothing() {
        let b = two_triangles();
        assert_eq!(sample_points(&b, 100, 1), sample_points(&b, 100, 1));
        assert_ne!(sample_points(&b, 100, 1), sample_points(&b, 100, 2));
        assert!(
            sample_points(&b, 0, 1).is_empty()
                && sample_points(&body(TriangleMesh::default()), 5, 1).is_empty()
        );
    }
}
