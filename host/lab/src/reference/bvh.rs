//! Triangles and rays into hits: a binary bounding volume hierarchy in f64 over world space.
//!
//! The triangle test is the watertight one of \[Woop13\]: an edge that two triangles share is judged with the same numbers for both, so no
//! ray passes between them. Boxes are tested with the margin of \[Ize13\]. Both run without a tolerance that depends on the scene.

use glam::DVec3;

/// A triangle in world space and where it comes from.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Triangle {
    /// Corners, counter-clockwise from outside.
    pub p: [DVec3; 3],
    /// Body it belongs to.
    pub body: u32,
    /// Its index in the body's mesh.
    pub index: u32,
}

/// Where a ray meets a triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Hit {
    /// Ray parameter, in lengths of the direction.
    pub t: f64,
    /// Barycentric weights of the three corners, sum 1.
    pub weights: [f64; 3],
    /// Position in [`Bvh::triangles`].
    pub triangle: usize,
}

#[derive(Clone, Copy, Debug)]
struct ReferenceNode {
    min: DVec3,
    max: DVec3,
    /// Leaf: first triangle. Inner: left child; the right one follows it.
    first: u32,
    /// Triangles of a leaf, 0 for an inner node.
    count: u32,
}

/// The hierarchy.
#[derive(Clone, Debug)]
pub(crate) struct Bvh {
    nodes: Vec<ReferenceNode>,
    triangles: Vec<Triangle>,
}

const LEAF: usize = 4;
const BINS: usize = 16;
/// From here on nodes are halved by count, so that no input makes the tree deeper than this plus log2 of the triangles.
const DEPTH_OF_MEDIAN: u32 = 48;
/// Room for one sibling per level of the deepest tree (u32 triangles).
const STACK: usize = 96;

/// A ray prepared for the triangle test: the largest direction component becomes z, the others are sheared away.
struct RayFrame {
    origin: DVec3,
    direction: DVec3,
    inverse: DVec3,
    k: [usize; 3],
    shear: DVec3,
}

impl RayFrame {
    fn new(origin: DVec3, direction: DVec3) -> Self {
        let a = direction.abs();
        let kz = if a.x > a.y && a.x > a.z {
            0
        } else if a.y > a.z {
            1
        } else {
            2
        };
        let (mut kx, mut ky) = ((kz + 1) % 3, (kz + 2) % 3);
        if direction[kz] < 0.0 {
            std::mem::swap(&mut kx, &mut ky);
        }
        let z = direction[kz];
        Self {
            origin,
            direction,
            inverse: direction.recip(),
            k: [kx, ky, kz],
            shear: DVec3::new(direction[kx] / z, direction[ky] / z, 1.0 / z),
        }
    }

    fn triangle(&self, p: &[DVec3; 3]) -> Option<(f64, [f64; 3])> {
        let [kx, ky, kz] = self.k;
        let local = p.map(|p| p - self.origin);
        let x = local.map(|q| q[kx] - self.shear.x * q[kz]);
        let y = local.map(|q| q[ky] - self.shear.y * q[kz]);
        let u = x[2] * y[1] - y[2] * x[1];
        let v = x[0] * y[2] - y[0] * x[2];
        let w = x[1] * y[0] - y[1] * x[0];
        if (u < 0.0 || v < 0.0 || w < 0.0) && (u > 0.0 || v > 0.0 || w > 0.0) {
            return None;
        }
        let det = u + v + w;
        if det == 0.0 || !det.is_finite() {
            return None;
        }
        let weights = [u / det, v / det, w / det];
        let t = self.shear.z
            * (weights[0] * local[0][kz] + weights[1] * local[1][kz] + weights[2] * local[2][kz]);
        (t > 0.0).then_some((t, weights))
    }

    /// Entry distance into a box, `None` when it is missed or farther than `t_max`.
    fn enter(&self, node: &ReferenceNode, t_max: f64) -> Option<f64> {
        let (mut near, mut far) = (0.0, t_max);
        for axis in 0..3 {
            let (lo, hi, o) = (node.min[axis], node.max[axis], self.origin[axis]);
            if self.direction[axis] == 0.0 {
                // Parallel: 0 * infinity would be NaN for an origin on the slab.
                if o < lo || o > hi {
                    return None;
                }
                continue;
            }
            let a = (lo - o) * self.inverse[axis];
            let b = (hi - o) * self.inverse[axis];
            near = a.min(b).max(near);
            far = (a.max(b) * (1.0 + 4.0 * f64::EPSILON)).min(far);
        }
        (near <= far).then_some(near)
    }
}

impl Bvh {
    /// Builds the hierarchy with the surface area heuristic; any number of triangles, any arrangement.
    pub(crate) fn new(mut triangles: Vec<Triangle>) -> Self {
        let mut nodes = Vec::with_capacity(2 * triangles.len() / LEAF + 1);
        if triangles.is_empty() {
            return Self { nodes, triangles };
        }
        nodes.push(ReferenceNode { min: DVec3::ZERO, max: DVec3::ZERO, first: 0, count: 0 });
        let mut work = vec![(0usize, 0usize, triangles.len(), 0u32)];
        while let Some((node, from, to, depth)) = work.pop() {
            let part = &mut triangles[from..to];
            let (min, max) = bounds(part);
            let split = if part.len() <= LEAF { None } else { Some(split(part, depth)) };
            nodes[node] = match split {
                None => ReferenceNode { min, max, first: from as u32, count: part.len() as u32 },
                Some(middle) => {
                    let left = nodes.len();
                    nodes.extend([nodes[node]; 2]);
                    work.push((left, from, from + middle, depth + 1));
                    work.push((left + 1, from + middle, to, depth + 1));
                    ReferenceNode { min, max, first: left as u32, count: 0 }
                }
            };
        }
        Self { nodes, triangles }
    }

    /// The triangles in the order of the leaves.
    pub(crate) fn triangles(&self) -> &[Triangle] {
        &self.triangles
    }

    /// One of them.
    pub(crate) fn triangle(&self, i: usize) -> &Triangle {
        &self.triangles[i]
    }

    /// The nearest accepted hit at 0 < t < `t_max`.
    pub(crate) fn closest(
        &self,
        origin: DVec3,
        direction: DVec3,
        t_max: f64,
        mut accept: impl FnMut(&Hit) -> bool,
    ) -> Option<Hit> {
        let mut best: Option<Hit> = None;
        self.walk(origin, direction, t_max, |hit| {
            if accept(&hit) {
                best = Some(hit);
                return Some(hit.t);
            }
            None
        });
        best
    }

    /// True when there is an accepted hit at 0 < t < `t_max`.
    pub(crate) fn any(
        &self,
        origin: DVec3,
        direction: DVec3,
        t_max: f64,
        mut accept: impl FnMut(&Hit) -> bool,
    ) -> bool {
        let mut found = false;
        self.walk(origin, direction, t_max, |hit| {
            found |= accept(&hit);
            found.then_some(0.0)
        });
        found
    }

    /// Every triangle tested in turn: the oracle of [`Self::closest`].
    pub(crate) fn closest_brute_force(&self, origin: DVec3, direction: DVec3, t_max: f64) -> Option<Hit> {
        if !(origin.is_finite() && direction.is_finite()) || direction == DVec3::ZERO {
            return None;
        }
        let ray = RayFrame::new(origin, direction);
        let mut best: Option<Hit> = None;
        for (i, triangle) in self.triangles.iter().enumerate() {
            if let Some((t, weights)) = ray.triangle(&triangle.p) {
                if t < best.map_or(t_max, |b| b.t) {
                    best = Some(Hit { t, weights, triangle: i });
                }
            }
        }
        best
    }

    /// Visits hits nearer than the limit; the visitor answers with a new limit or `None` to go on with the old one.
    fn walk(
        &self,
        origin: DVec3,
        direction: DVec3,
        mut limit: f64,
        mut visit: impl FnMut(Hit) -> Option<f64>,
    ) {
        if self.nodes.is_empty() || !(origin.is_finite() && direction.is_finite()) || direction == DVec3::ZERO
        {
            return;
        }
        let ray = RayFrame::new(origin, direction);
        let mut stack = [(0usize, 0.0f64); STACK];
        let mut top = 0;
        if let Some(t) = ray.enter(&self.nodes[0], limit) {
            stack[0] = (0, t);
            top = 1;
        }
        while top > 0 {
            top -= 1;
            let (index, entry) = stack[top];
            if entry > limit {
                continue;
            }
            let node = &self.nodes[index];
            let first = node.first as usize;
            if node.count > 0 {
                for i in first..first + node.count as usize {
                    if let Some((t, weights)) = ray.triangle(&self.triangles[i].p) {
                        if t < limit {
                            if let Some(new) = visit(Hit { t, weights, triangle: i }) {
                                limit = new;
                            }
                        }
                    }
                }
                continue;
            }
            let children = [first, first + 1].map(|c| ray.enter(&self.nodes[c], limit).map(|t| (c, t)));
            let mut push = |child| {
                stack[top] = child;
                top += 1;
            };
            match children {
                [Some(a), Some(b)] => {
                    let (near, far) = if a.1 <= b.1 { (a, b) } else { (b, a) };
                    push(far);
                    push(near);
                }
                [Some(only), None] | [None, Some(only)] => push(only),
                [None, None] => {}
            }
        }
    }
}

fn bounds(triangles: &[Triangle]) -> (DVec3, DVec3) {
    triangles
        .iter()
        .flat_map(|t| t.p)
        .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), p| (lo.min(p), hi.max(p)))
}

fn centre(t: &Triangle) -> DVec3 {
    (t.p[0] + t.p[1] + t.p[2]) / 3.0
}

fn half_area(min: DVec3, max: DVec3) -> f64 {
    let d = (max - min).max(DVec3::ZERO);
    d.x * d.y + d.y * d.z + d.z * d.x
}

/// Orders the triangles so that a cheap split lies at the returned position (neither 0 nor the length).
fn split(triangles: &mut [Triangle], depth: u32) -> usize {
    let n = triangles.len();
    let (lo, hi) = (triangles.iter().map(centre))
        .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), c| (lo.min(c), hi.max(c)));
    let extent = hi - lo;
    let mut best: Option<(f64, usize, usize)> = None;
    if depth < DEPTH_OF_MEDIAN {
        for axis in 0..3 {
            if extent[axis].is_nan() || extent[axis] <= 0.0 {
                continue;
            }
            let mut bins = [(0usize, DVec3::INFINITY, DVec3::NEG_INFINITY); BINS];
            for t in triangles.iter() {
                let bin = &mut bins[bin_of(centre(t)[axis], lo[axis], extent[axis])];
                let (min, max) = bounds(std::slice::from_ref(t));
                *bin = (bin.0 + 1, bin.1.min(min), bin.2.max(max));
            }
            for cut in 1..BINS {
                let side = |part: &[(usize, DVec3, DVec3)]| {
                    let (count, min, max) =
                        part.iter().fold((0, DVec3::INFINITY, DVec3::NEG_INFINITY), |(n, lo, hi), b| {
                            (n + b.0, lo.min(b.1), hi.max(b.2))
                        });
                    (count, half_area(min, max) * count as f64)
                };
                let ((left, a), (right, b)) = (side(&bins[..cut]), side(&bins[cut..]));
                if left > 0 && right > 0 && best.is_none_or(|(cost, ..)| a + b < cost) {
                    best = Some((a + b, axis, cut));
                }
            }
        }
    }
    if let Some((_, axis, cut)) = best {
        let mut middle = 0;
        for i in 0..n {
            if bin_of(centre(&triangles[i])[axis], lo[axis], extent[axis]) < cut {
                triangles.swap(i, middle);
                middle += 1;
            }
        }
        if middle > 0 && middle < n {
            return middle;
        }
    }
    let axis =
        if extent.x >= extent.y && extent.x >= extent.z { 0 } else { 1 + usize::from(extent.z > extent.y) };
    triangles.select_nth_unstable_by(n / 2, |a, b| centre(a)[axis].total_cmp(&centre(b)[axis]));
    n / 2
}

fn bin_of(c: f64, lo: f64, extent: f64) -> usize {
    (((c - lo) / extent * BINS as f64) as usize).min(BINS - 1)
}
