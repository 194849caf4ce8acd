//! The tests of boxes and triangles with AVX2: eight boxes in one register, and the triangles of a leaf in half of one.
#![allow(unsafe_code)]

use super::plain::LEAVE;
use super::tree::{Triangles, WideNode, LEAF_LANES};
use super::{walk_all, LocalRay, Ray, WalkScene};
use std::arch::x86_64::*;

pub(super) fn is_there() -> bool {
    is_x86_feature_detected!("avx2") && is_x86_feature_detected!("lzcnt") && is_x86_feature_detected!("bmi1")
}

/// Walks with AVX2; falls back to plain Rust where there is none.
pub(super) fn walk(scene: &WalkScene<'_>, rays: &[Ray], hits: &mut [u32]) {
    if !is_there() {
        return walk_all::<super::plain::PlainLanes>(scene, rays, hits);
    }
    // SAFETY: the processor has all of the features, as just checked.
    unsafe { walk_with_avx2(scene, rays, hits) }
}

// Without fused products: the shader has none.
#[target_feature(enable = "avx2,lzcnt,bmi1")]
fn walk_with_avx2(scene: &WalkScene<'_>, rays: &[Ray], hits: &mut [u32]) {
    walk_all::<Avx2Lanes>(scene, rays, hits);
}

/// Only [`walk_with_avx2`] names it.
struct Avx2Lanes;

impl super::Lanes for Avx2Lanes {
    #[inline(always)]
    fn enters(node: &WideNode, ray: &LocalRay, t_max: f32) -> u32 {
        // SAFETY: this is inlined into a function that runs only where there is AVX2.
        unsafe { enters(node, ray, t_max) }
    }

    #[inline(always)]
    fn meets(triangles: &Triangles, ray: &LocalRay, t_max: f32) -> (u32, [f32; LEAF_LANES]) {
        // SAFETY: as above.
        unsafe { meets(triangles, ray, t_max) }
    }
}

/// A sum or difference or product of vectors, without a function between: closures are not inlined here.
macro_rules! sum {
    ($a:expr, $b:expr) => {
        _mm_add_ps($a, $b)
    };
    ($a:expr, $b:expr, $c:expr) => {
        _mm_add_ps(_mm_add_ps($a, $b), $c)
    };
}

macro_rules! product {
    ($x:expr, $d:expr) => {
        _mm_mul_ps($x, _mm_set1_ps($d))
    };
}

#[inline]
#[target_feature(enable = "avx2")]
fn enters(node: &WideNode, ray: &LocalRay, t_max: f32) -> u32 {
    macro_rules! distance {
        ($axis:literal, $is_far:expr) => {{
            let row = $axis + 3 * usize::from(ray.down[$axis] != $is_far);
            // SAFETY: eight floats; a load of this kind needs no alignment.
            let planes = unsafe { _mm256_loadu_ps(node.planes[row].as_ptr()) };
            let from = _mm256_sub_ps(planes, _mm256_set1_ps(ray.origin[$axis]));
            _mm256_mul_ps(from, _mm256_set1_ps(ray.inverse[$axis]))
        }};
    }
    let enter = _mm256_max_ps(
        _mm256_max_ps(distance!(0, false), distance!(1, false)),
        _mm256_max_ps(distance!(2, false), _mm256_setzero_ps()),
    );
    let leave = _mm256_min_ps(
        _mm256_min_ps(distance!(0, true), distance!(1, true)),
        _mm256_min_ps(distance!(2, true), _mm256_set1_ps(t_max)),
    );
    let leave = _mm256_mul_ps(leave, _mm256_set1_ps(LEAVE));
    _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(enter, leave)) as u32
}

#[inline]
#[target_feature(enable = "avx2")]
fn meets(triangles: &Triangles, ray: &LocalRay, t_max: f32) -> (u32, [f32; LEAF_LANES]) {
    let [ox, oy, oz] = ray.origin;
    macro_rules! corner {
        ($i:literal) => {{
            let [x, y, z] = &triangles.corners[$i];
            // SAFETY: four floats each; a load of this kind needs no alignment.
            let [x, y, z] =
                unsafe { [_mm_loadu_ps(x.as_ptr()), _mm_loadu_ps(y.as_ptr()), _mm_loadu_ps(z.as_ptr())] };
            [_mm_sub_ps(x, _mm_set1_ps(ox)), _mm_sub_ps(y, _mm_set1_ps(oy)), _mm_sub_ps(z, _mm_set1_ps(oz))]
        }};
    }
    // Precise, from the first product on.
    macro_rules! across {
        ($p:expr, $d:expr) => {
            sum!(product!($p[0], $d[0]), product!($p[1], $d[1]), product!($p[2], $d[2]))
        };
    }
    macro_rules! edge {
        ($p:expr, $q:expr) => {
            _mm_sub_ps(_mm_mul_ps($p[0], $q[1]), _mm_mul_ps($p[1], $q[0]))
        };
    }
    let (p0, p1, p2) = (corner!(0), corner!(1), corner!(2));
    let a = [across!(p0, ray.u), across!(p0, ray.v)];
    let b = [across!(p1, ray.u), across!(p1, ray.v)];
    let c = [across!(p2, ray.u), across!(p2, ray.v)];
    let (w0, w1, w2) = (edge!(b, c), edge!(c, a), edge!(a, b));
    let zero = _mm_setzero_ps();
    let least = _mm_min_ps(_mm_min_ps(w0, w1), w2);
    let most = _mm_max_ps(_mm_max_ps(w0, w1), w2);
    let outside = _mm_and_ps(_mm_cmplt_ps(least, zero), _mm_cmpgt_ps(most, zero));
    if _mm_movemask_ps(outside) == 0b1111 {
        return (0, [0.0; LEAF_LANES]);
    }
    let d = ray.direction;
    macro_rules! along {
        ($p:expr) => {
            sum!(product!($p[2], d[2]), product!($p[1], d[1]), product!($p[0], d[0]))
        };
    }
    let area = sum!(w0, w1, w2);
    let all = sum!(_mm_mul_ps(w0, along!(p0)), _mm_mul_ps(w1, along!(p1)), _mm_mul_ps(w2, along!(p2)));
    let depth = _mm_mul_ps(all, _mm_div_ps(_mm_set1_ps(1.0), area));
    let t = _mm_div_ps(depth, _mm_set1_ps(ray.length2));
    let there = _mm_and_ps(_mm_cmpneq_ps(area, zero), _mm_cmpgt_ps(t, zero));
    let met = _mm_andnot_ps(outside, _mm_and_ps(there, _mm_cmplt_ps(t, _mm_set1_ps(t_max))));
    let mut distances = [0.0; LEAF_LANES];
    // SAFETY: room for four floats; a store of this kind needs no alignment.
    unsafe { _mm_storeu_ps(distances.as_mut_ptr(), t) };
    (_mm_movemask_ps(met) as u32, distances)
}
