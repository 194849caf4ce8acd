//! The tests of boxes and triangles in plain Rust, for every processor. Compilers turn these loops into whatever registers they may use.

use super::tree::{Triangles, WideNode, LEAF_LANES};
use super::LocalRay;
use std::array::from_fn;

/// See the module.
pub(super) struct PlainLanes;

/// What a ray's box test allows for rounding, as a factor of where it leaves.
pub(super) const LEAVE: f32 = 1.000_001_2;

type Row = [f32; LEAF_LANES];

impl super::Lanes for PlainLanes {
    #[inline(always)]
    fn enters(node: &WideNode, ray: &LocalRay, t_max: f32) -> u32 {
        let (mut enter, mut leave) = ([0.0f32; 8], [t_max; 8]);
        for axis in 0..3 {
            let (o, i) = (ray.origin[axis], ray.inverse[axis]);
            let (lower, upper) = (&node.planes[axis], &node.planes[3 + axis]);
            let (near, far) = if ray.down[axis] { (upper, lower) } else { (lower, upper) };
            for k in 0..8 {
                let (a, b) = ((near[k] - o) * i, (far[k] - o) * i);
                enter[k] = if a > enter[k] { a } else { enter[k] };
                leave[k] = if b < leave[k] { b } else { leave[k] };
            }
        }
        (0..8).fold(0, |bits, k| bits | u32::from(enter[k] <= leave[k] * LEAVE) << k)
    }

    #[inline(always)]
    fn meets(triangles: &Triangles, ray: &LocalRay, t_max: f32) -> (u32, Row) {
        let [p0, p1, p2]: [[Row; 3]; 3] =
            triangles.corners.map(|c| from_fn(|axis| c[axis].map(|x| x - ray.origin[axis])));
        // Precise, from the first product on.
        let across = |p: &[Row; 3], d: [f32; 3]| -> Row {
            from_fn(|k| (p[0][k] * d[0] + p[1][k] * d[1]) + p[2][k] * d[2])
        };
        let along = |p: &[Row; 3]| -> Row {
            let d = ray.direction;
            from_fn(|k| (p[2][k] * d[2] + p[1][k] * d[1]) + p[0][k] * d[0])
        };
        let [a, b, c] = [&p0, &p1, &p2].map(|p| [across(p, ray.u), across(p, ray.v)]);
        let edge = |p: &[Row; 2], q: &[Row; 2]| -> Row { from_fn(|k| p[0][k] * q[1][k] - p[1][k] * q[0][k]) };
        let (w0, w1, w2) = (edge(&b, &c), edge(&c, &a), edge(&a, &b));
        let (d0, d1, d2) = (along(&p0), along(&p1), along(&p2));
        let area: Row = from_fn(|k| w0[k] + w1[k] + w2[k]);
        let t: Row =
            from_fn(|k| (w0[k] * d0[k] + w1[k] * d1[k] + w2[k] * d2[k]) * (1.0 / area[k]) / ray.length2);
        let met = (0..LEAF_LANES).fold(0, |bits, k| {
            let negative = w0[k] < 0.0 || w1[k] < 0.0 || w2[k] < 0.0;
            let positive = w0[k] > 0.0 || w1[k] > 0.0 || w2[k] > 0.0;
            let is_met = !(negative && positive) && area[k] != 0.0 && t[k] > 0.0 && t[k] < t_max;
            bits | u32::from(is_met) << k
        });
        (met, t)
    }
}
