//! The nearest point of a surface of triangles, by a tree of boxes.

use glam::DVec3;

/// Triangles in a tree.
#[derive(Clone, Debug)]
pub struct TriangleTree {
    triangles: Vec<[DVec3; 3]>,
    nodes: Vec<Node>,
}

#[derive(Clone, Copy, Debug)]
struct Node {
    low: DVec3,
    high: DVec3,
    /// First triangle and their number in a leaf; in an inner node the number is 0 and the first is the right child.
    first: usize,
    count: usize,
}

/// A point of the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Nearest {
    pub point: DVec3,
    /// Unit, of the triangle.
    pub normal: DVec3,
    pub distance: f64,
}

const LEAF: usize = 4;

impl TriangleTree {
    /// From triangles in the mesh's frame, metres. Those without an area, or with coordinates that are no numbers, are
    /// left out.
    pub fn new(triangles: impl IntoIterator<Item = [DVec3; 3]>) -> Self {
        let sound = |t: &[DVec3; 3]| {
            let area = (t[1] - t[0]).cross(t[2] - t[0]).length();
            area.is_finite() && area > 0.0
        };
        let mut surface =
            Self { triangles: triangles.into_iter().filter(sound).collect(), nodes: Vec::new() };
        let mut triangles = std::mem::take(&mut surface.triangles);
        if !triangles.is_empty() {
            surface.build(&mut triangles, 0);
        }
        surface.triangles = triangles;
        surface
    }

    /// Whether there is no triangle.
    pub fn is_empty(&self) -> bool {
        self.triangles.is_empty()
    }

    fn build(&mut self, part: &mut [[DVec3; 3]], first: usize) {
        let low = part.iter().flatten().fold(DVec3::INFINITY, |a, p| a.min(*p));
        let high = part.iter().flatten().fold(DVec3::NEG_INFINITY, |a, p| a.max(*p));
        let here = self.nodes.len();
        self.nodes.push(Node { low, high, first, count: part.len() });
        if part.len() <= LEAF {
            return;
        }
        let axis = (high - low).max_position();
        let half = part.len() / 2;
        // The middle by count: the depth is the logarithm of the number, whatever the shape.
        part.select_nth_unstable_by(half, |a, b| {
            (a[0] + a[1] + a[2])[axis].total_cmp(&(b[0] + b[1] + b[2])[axis])
        });
        let (left, right) = part.split_at_mut(half);
        self.build(left, first);
        let child = self.nodes.len();
        self.build(right, first + half);
        (self.nodes[here].count, self.nodes[here].first) = (0, child);
    }

    /// Whether a triangle cuts the straight way between two points, further than `clear_m` metres from its end `to`. So
    /// a point of the surface is not hidden by the triangles that it belongs to.
    pub fn hides(&self, from: DVec3, to: DVec3, clear_m: f64) -> bool {
        let way = to - from;
        let length = way.length();
        if length.is_nan() || length <= clear_m {
            return false;
        }
        let last = 1.0 - clear_m / length;
        let inverse = way.recip();
        let mut stack = vec![0];
        while let Some(index) = stack.pop() {
            let Some(node) = self.nodes.get(index) else { continue };
            let (a, b) = ((node.low - from) * inverse, (node.high - from) * inverse);
            // Rust's min and max pass over the NaN of a box whose plane the way lies in.
            let enter = (0..3).fold(0.0, |t: f64, k| t.max(a[k].min(b[k])));
            let leave = (0..3).fold(last, |t: f64, k| t.min(a[k].max(b[k])));
            if enter > leave {
                continue;
            }
            if node.count == 0 {
                stack.extend([index + 1, node.first]);
                continue;
            }
            let part = &self.triangles[node.first..node.first + node.count];
            if part.iter().any(|t| cuts(t, from, way).is_some_and(|s| (0.0..last).contains(&s))) {
                return true;
            }
        }
        false
    }

    /// Length of the diagonal of the box around it, metres; 0 when it is empty.
    pub fn extent_m(&self) -> f64 {
        self.nodes.first().map_or(0.0, |n| n.low.distance(n.high))
    }

    pub(super) fn nearest(&self, to: DVec3) -> Option<Nearest> {
        let mut best: Option<Nearest> = None;
        let mut stack = vec![0];
        while let Some(index) = stack.pop() {
            let Some(node) = self.nodes.get(index) else { continue };
            let gap = to.clamp(node.low, node.high).distance(to);
            if best.is_some_and(|b| gap >= b.distance) {
                continue;
            }
            if node.count > 0 {
                for t in &self.triangles[node.first..node.first + node.count] {
                    let point = on_triangle(t, to);
                    let distance = point.distance(to);
                    if best.is_none_or(|b| distance < b.distance) {
                        let normal = (t[1] - t[0]).cross(t[2] - t[0]).normalize_or(DVec3::X);
                        best = Some(Nearest { point, normal, distance });
                    }
                }
            } else {
                let near = |i: usize| to.clamp(self.nodes[i].low, self.nodes[i].high).distance_squared(to);
                let (a, b) = (index + 1, node.first);
                // The nearer child last, so that it is looked at first.
                stack.extend(if near(a) < near(b) { [b, a] } else { [a, b] });
            }
        }
        best
    }
}

/// Where the line `from + s way` cuts a triangle (Möller and Trumbore, 1997); `None` where it does not.
fn cuts([a, b, c]: &[DVec3; 3], from: DVec3, way: DVec3) -> Option<f64> {
    let (ab, ac) = (*b - *a, *c - *a);
    let across = way.cross(ac);
    let inverse = ab.dot(across).recip();
    let at = from - *a;
    let (u, turned) = (at.dot(across) * inverse, at.cross(ab));
    let v = way.dot(turned) * inverse;
    // A way along the triangle has an infinite inverse, and numbers that fail these tests.
    (u >= 0.0 && v >= 0.0 && u + v <= 1.0).then(|| ac.dot(turned) * inverse)
}

/// The nearest point of a triangle (Ericson, Real-Time Collision Detection, 5.1.5).
fn on_triangle([a, b, c]: &[DVec3; 3], p: DVec3) -> DVec3 {
    let (ab, ac, ap) = (*b - *a, *c - *a, p - *a);
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return *a;
    }
    let bp = p - *b;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return *b;
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return *a + ab * (d1 / (d1 - d3));
    }
    let cp = p - *c;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return *c;
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return *a + ac * (d2 / (d2 - d6));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        return *b + (*c - *b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)));
    }
    let inverse = 1.0 / (va + vb + vc);
    *a + ab * (vb * inverse) + ac * (vc * inverse)
}
