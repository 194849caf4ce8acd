//! How far a body rises around each of its triangles: which rays from a triangle surely leave the body for good.
//!
//! Most rays that start on a body never meet it again. Which ones, its shape alone decides, so it is worked out once: for each triangle and
//! each of 24 cells of directions in body space the elevation above the triangle's plane beyond which nothing of the body is seen from any of
//! its points (\[Max88\] calls that the horizon). A renderer need not look for what such a ray meets in its own body.
//!
//! The bound is safe and not sharp: rays that are told to leave do leave, and some that leave are not told so.

mod kept;

use crate::bvh::tree_of;
use glam::{Vec3, Vec3A};
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::triangle::Triangle;

pub use kept::{folder, keep_in, kept_horizons};

/// Steps of the sine of an elevation, 0 to 1. A horizon at the last step is that of a cell no ray of which surely leaves.
pub const STEPS: u32 = 15;

/// The horizon of a triangle. Word a is for directions whose component a, of x, y and z, is the largest. Its bits 4 o to 4 o + 3 are the sine of the
/// elevation in octant o, in [`STEPS`]; bits 0, 1 and 2 of o are set where x, y and z are negative.
pub type Horizon = [u32; 3];

/// The horizon of a triangle from which no ray surely leaves.
pub const CLOSED: Horizon = [u32::MAX; 3];

const ALL_CELLS: Cells = (1 << 24) - 1;

/// No horizon is lower. What lies lower costs most of the time to find, and hides one ray of sixty.
const LOWEST: u8 = 2;

/// What is so many times as far away as it is large hides what its box hides.
const FAR: f32 = 8.0;

/// Part of a step by which what is found is rounded up, for the arithmetic of shaders.
const MARGIN: f32 = 0.03;

/// Nodes of the tree that may be looked at for all triangles together: a few seconds of one core.
const LOOKS: usize = 120_000_000;

/// With fewer looks a triangle, nothing useful would be found.
const FEWEST_LOOKS: usize = 64;

/// The horizons of a body's triangles, in their order, seen from outside. Coordinates are finite. The number of threads that work on them changes
/// no horizon.
pub fn horizons(triangles: &[[Vec3; 3]]) -> Vec<Horizon> {
    let count = triangles.len();
    let looks = LOOKS / count.max(1);
    if count == 0 || looks < FEWEST_LOOKS {
        return vec![CLOSED; count];
    }
    let body = HorizonBody::new(triangles, looks);
    let mut out = vec![CLOSED; count];
    let threads = std::thread::available_parallelism().map_or(1, usize::from).min(count.div_ceil(1000));
    std::thread::scope(|scope| {
        for (i, part) in out.chunks_mut(count.div_ceil(threads)).enumerate() {
            let body = &body;
            scope.spawn(move || {
                let mut open = Vec::with_capacity(128);
                let first = i * count.div_ceil(threads);
                for (j, horizon) in part.iter_mut().enumerate() {
                    *horizon = body.horizon((first + j) as u32, &mut open);
                }
            });
        }
    });
    out
}

/// Cells of directions, a bit for each: cell 8 a + o has the directions of octant o whose component a is the largest.
type Cells = u32;

/// Elevations of all cells, in steps, that only rise.
struct Rising {
    /// For each elevation the cells whose own is lower.
    lower: [Cells; STEPS as usize + 1],
}

impl Rising {
    fn from(height: u8) -> Self {
        let mut lower = [ALL_CELLS; STEPS as usize + 1];
        lower[..=usize::from(height)].fill(0);
        Self { lower }
    }

    fn raise(&mut self, cells: Cells, to: u8) {
        self.lower[..=usize::from(to)].iter_mut().for_each(|lower| *lower &= !cells);
    }

    /// Whether all of these cells are at least so high.
    fn has(&self, cells: Cells, height: u8) -> bool {
        self.lower[usize::from(height)] & cells == 0
    }

    /// The lowest of all.
    fn lowest(&self) -> u8 {
        self.lower.iter().rposition(|&lower| lower == 0).unwrap_or(0) as u8
    }

    fn packed(&self) -> Horizon {
        let mut packed = [0; 3];
        for (cell, nibble) in (0..24).map(|cell| (cell, 4 * (cell % 8))) {
            let step = self.lower.iter().rposition(|&lower| lower >> cell & 1 == 0).unwrap_or(0) as u32;
            packed[cell / 8] |= step << nibble;
        }
        packed
    }
}

/// The steps of a sine, rounded up.
fn steps_of(sine: f32) -> u8 {
    (sine * STEPS as f32 + MARGIN).ceil().clamp(0.0, STEPS as f32) as u8
}

/// The cells in which vectors between two corners lie.
fn cells_between(low: Vec3A, high: Vec3A) -> Cells {
    let of_axis = |low: f32, high: f32, positive: u8| {
        (if high >= 0.0 { positive } else { 0 }) | (if low <= 0.0 { !positive } else { 0 })
    };
    let octants = of_axis(low.x, high.x, 0x55) & of_axis(low.y, high.y, 0x33) & of_axis(low.z, high.z, 0x0f);
    // A component can be the largest if its largest value is not below the smallest of any other.
    let largest = low.abs().max(high.abs());
    let smallest = low.max(-high).max(Vec3A::ZERO).max_element();
    let of_component = |a: usize| if largest[a] >= smallest { u32::from(octants) << (8 * a) } else { 0 };
    of_component(0) | of_component(1) | of_component(2)
}

/// A triangle at its first corner.
struct Seat {
    corners: [Vec3A; 3],
    /// Two axes in its plane, and its normal.
    axes: [Vec3A; 3],
    centre: Vec3A,
    radius: f32,
    low: Vec3A,
    high: Vec3A,
}

struct HorizonBody {
    tree: Bvh2,
    triangles: Vec<[Vec3A; 3]>,
    /// Lengths that are lost in the rounding of positions.
    slack: f32,
    looks: usize,
}

impl HorizonBody {
    fn new(triangles: &[[Vec3; 3]], looks: usize) -> Self {
        let triangles: Vec<[Vec3A; 3]> = triangles.iter().map(|t| t.map(Vec3A::from)).collect();
        let extent = triangles.iter().flatten().fold(Vec3A::ZERO, |all, p| all.max(p.abs())).max_element();
        let boxes: Vec<Aabb> = triangles.iter().map(|&[v0, v1, v2]| Triangle { v0, v1, v2 }.aabb()).collect();
        Self { tree: tree_of(&boxes), triangles, slack: 2e-6 * extent, looks }
    }

    fn seat(&self, corners: &[Vec3A; 3]) -> Option<Seat> {
        let origin = corners[0];
        let corners = corners.map(|p| p - origin);
        let normal = corners[1].cross(corners[2]).try_normalize()?;
        let across = normal.any_orthonormal_vector();
        let centre = (corners[1] + corners[2]) / 3.0;
        let radius = corners.iter().map(|p| p.distance(centre)).fold(0.0, f32::max) + self.slack;
        let (low, high) =
            (corners[1].min(corners[2]).min(Vec3A::ZERO), corners[1].max(corners[2]).max(Vec3A::ZERO));
        Some(Seat { corners, axes: [across, normal.cross(across), normal], centre, radius, low, high })
    }

    fn horizon(&self, triangle: u32, open: &mut Vec<u32>) -> Horizon {
        let own = &self.triangles[triangle as usize];
        let Some(seat) = self.seat(own) else { return CLOSED };
        let [.., normal] = seat.axes;
        let above = normal.cmpge(Vec3A::ZERO);
        let mut horizon = Rising::from(LOWEST);
        let mut looks = self.looks;
        let mut lowest = LOWEST;
        open.clear();
        open.push(0);
        while let Some(index) = open.pop() {
            let node = &self.tree.nodes[index as usize];
            let (low, high) = (node.aabb.min - own[0], node.aabb.max - own[0]);
            let height = normal.dot(Vec3A::select(above, high, low));
            let distance = seat.centre.clamp(low, high).distance(seat.centre) - seat.radius;
            if height <= self.slack || height * STEPS as f32 <= (f32::from(lowest) - MARGIN) * distance {
                continue;
            }
            let size = high - low;
            // A ray near the border of two cells may count as one of either.
            let blur = Vec3A::splat(1e-3 * (size + seat.high - seat.low).max_element() + self.slack);
            let cells = cells_between(low - seat.high - blur, high - seat.low + blur);
            let needs = steps_of(if distance > height { height / distance } else { 1.0 });
            if horizon.has(cells, needs) {
                continue;
            }
            looks = looks.saturating_sub(1);
            let is_far = distance > 0.0 && distance * distance > FAR * FAR * size.length_squared();
            if node.is_leaf() && !is_far {
                for i in node.first_index..node.first_index + node.prim_count {
                    let other = self.tree.primitive_indices[i as usize];
                    if other != triangle {
                        let sine = highest_seen(&seat, &self.triangles[other as usize].map(|p| p - own[0]));
                        if sine > 0.0 {
                            horizon.raise(cells, steps_of(sine));
                            lowest = horizon.lowest();
                        }
                    }
                }
            } else if is_far || looks == 0 {
                horizon.raise(cells, needs);
                lowest = horizon.lowest();
            } else {
                let (left, right) = (node.first_index, node.first_index + 1);
                let away =
                    |i: u32| self.tree.nodes[i as usize].aabb.center().distance_squared(own[0] + seat.centre);
                // The nearer one first: it hides more.
                open.extend(if away(left) < away(right) { [right, left] } else { [left, right] });
            }
        }
        horizon.packed()
    }
}

/// Sine of the highest elevation at which any point of a triangle is seen from any point of the seat.
///
/// The directions from one to the other are the cone of the differences of their corners. Its highest direction is the normal, or lies on an arc
/// between two of these differences.
fn highest_seen(seat: &Seat, other: &[Vec3A; 3]) -> f32 {
    let [x, y, normal] = seat.axes;
    let flat = seat.corners.map(|p| Vec3A::new(p.dot(x), p.dot(y), 0.0));
    let corners = other.map(|p| {
        // A shared corner lies in the plane, whatever rounding says.
        let height = if seat.corners.contains(&p) { 0.0 } else { p.dot(normal) };
        Vec3A::new(p.dot(x), p.dot(y), height)
    });
    // What is left of the triangle above the plane: at most four corners.
    let (mut part, mut parts) = ([Vec3A::ZERO; 4], 0);
    for (a, b) in [(corners[0], corners[1]), (corners[1], corners[2]), (corners[2], corners[0])] {
        if a.z >= 0.0 {
            part[parts] = a;
            parts += 1;
        }
        if a.z > 0.0 && b.z < 0.0 || a.z < 0.0 && b.z > 0.0 {
            let cut = a + (b - a) * (a.z / (a.z - b.z));
            part[parts] = Vec3A::new(cut.x, cut.y, 0.0);
            parts += 1;
        }
    }
    let (mut cone, mut size) = ([Vec3A::ZERO; 12], 0);
    let mut highest = 0.0f32;
    for p in &part[..parts] {
        for a in &flat {
            if let Some(direction) = (*p - *a).try_normalize() {
                highest = highest.max(direction.z);
                cone[size] = direction;
                size += 1;
            }
        }
    }
    let cone = &cone[..size];
    if highest <= 0.0 {
        return 0.0;
    }
    // The normal is outside if all lie on one side of a plane through it.
    let on_one_side = |a: &Vec3A| cone.iter().all(|b| a.x * b.y - a.y * b.x >= -1e-6);
    if !cone.iter().any(|a| a.x * a.x + a.y * a.y > 1e-12 && on_one_side(a)) {
        return 1.0;
    }
    for (i, a) in cone.iter().enumerate() {
        for b in &cone[..i] {
            let cosine = a.dot(*b);
            if cosine < -0.9999 && (a.z > 0.0 || b.z > 0.0) {
                return 1.0;
            }
            // The direction of the arc's plane that is nearest to the normal lies between the two.
            if cosine.abs() < 0.9999 && a.z >= cosine * b.z && b.z >= cosine * a.z {
                let square = (a.z * a.z + b.z * b.z - 2.0 * cosine * a.z * b.z) / (1.0 - cosine * cosine);
                highest = highest.max(square.sqrt());
            }
        }
    }
    highest.min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes::{join, sphere};
    use crate::TriangleMesh;
    use glam::DVec3;

    fn corners(mesh: &TriangleMesh) -> Vec<[Vec3; 3]> {
        mesh.triangles.iter().map(|t| t.map(|i| mesh.positions[i as usize])).collect()
    }

    /// Whether a ray is above a triangle's horizon: as `leaves_body` of `shading.glsl`.
    fn leaves(horizon: Horizon, normal: DVec3, direction: DVec3) -> bool {
        let a = direction.abs();
        let largest = if a.x >= a.y && a.x >= a.z {
            0
        } else if a.y >= a.z {
            1
        } else {
            2
        };
        let octant = u32::from(direction.x < 0.0)
            | u32::from(direction.y < 0.0) << 1
            | u32::from(direction.z < 0.0) << 2;
        let steps = horizon[largest] >> (4 * octant) & 15;
        steps < STEPS && direction.dot(normal) * f64::from(STEPS) > f64::from(steps) * direction.length()
    }

    /// Whether a ray meets any triangle, by all of them in turn (\[Moeller97\], in f64).
    fn meets(triangles: &[[Vec3; 3]], origin: DVec3, direction: DVec3, but: usize) -> bool {
        triangles.iter().enumerate().any(|(i, t)| {
            let [a, b, c] = t.map(|p| p.as_dvec3());
            let (ab, ac) = (b - a, c - a);
            let p = direction.cross(ac);
            let from = (origin - a) / ab.dot(p);
            let q = from.cross(ab);
            let (u, v) = (from.dot(p), q.dot(direction));
            i != but && u >= 0.0 && v >= 0.0 && u + v <= 1.0 && q.dot(ac) > 0.0
        })
    }

    /// Numbers from 0 to 1 that are always the same.
    fn random() -> impl FnMut() -> f64 {
        let mut state = 1u64;
        move || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        }
    }

    /// The share of rays, drawn by the cosine, that are told to leave, and of those that do. No ray is told so that does not.
    fn shares(triangles: &[[Vec3; 3]], rays: usize) -> [f64; 2] {
        let horizons = horizons(triangles);
        let mut u = random();
        let (mut told, mut left) = (0, 0);
        for _ in 0..rays {
            let i = (u() * triangles.len() as f64) as usize;
            let [a, b, c] = triangles[i].map(|p| p.as_dvec3());
            let normal = (b - a).cross(c - a).normalize();
            let (s, t) = (u().sqrt(), u());
            let origin = a * (1.0 - s) + b * (s * (1.0 - t)) + c * (s * t);
            let (r, phi) = (u().sqrt(), std::f64::consts::TAU * u());
            let x = normal.any_orthonormal_vector();
            let direction =
                x * (r * phi.cos()) + normal.cross(x) * (r * phi.sin()) + normal * (1.0 - r * r).sqrt();
            let does = !meets(triangles, origin + normal * 1e-7, direction, i);
            let is_told = leaves(horizons[i], normal, direction);
            assert!(does || !is_told, "triangle {i}: a ray from {origin} along {direction} meets the body");
            told += usize::from(is_told);
            left += usize::from(does);
        }
        [told, left].map(|n| n as f64 / rays as f64)
    }

    /// A sphere with waves, of which `deep` times the radius is their depth: bumps, dents and overhangs.
    fn waves(deep: f32) -> Vec<[Vec3; 3]> {
        let mut mesh = sphere(Vec3::ZERO, 1.0, 4, true);
        for p in &mut mesh.positions {
            *p *= 1.0 + deep * (6.0 * p.x).sin() * (5.0 * p.y + 1.0).sin() * (7.0 * p.z).cos();
        }
        corners(&mesh)
    }

    #[test]
    fn every_ray_that_is_told_to_leave_does_leave() {
        for (name, triangles, least) in [
            ("ball", corners(&sphere(Vec3::ZERO, 1.0, 3, true)), 0.97),
            ("shallow waves", waves(0.1), 0.75),
            ("deep waves", waves(0.35), 0.35),
            ("two balls", corners(&join([-0.9f32, 0.9].map(|x| sphere(Vec3::X * x, 1.0, 3, true)))), 0.5),
        ] {
            let [told, left] = shares(&triangles, 4000);
            println!("{name}: {told:.3} of the rays are told to leave, {left:.3} leave");
            assert!(told >= least, "{name}: {told}");
        }
    }

    #[test]
    #[ignore = "it prints figures of docs/lab/H100.md"]
    fn shares_of_the_demo() {
        for body in crate::builtin().bodies.iter().filter(|body| body.tracked.is_some()) {
            let triangles = corners(&body.mesh);
            let begin = std::time::Instant::now();
            let count = horizons(&triangles).len();
            let ms = begin.elapsed().as_secs_f64() * 1e3;
            let [told, left] = shares(&triangles, 2000);
            println!(
                "{}: {count} triangles, {:.3} ms each; {told:.3} of the rays are told to leave, {left:.3} leave",
                body.name,
                ms / count as f64
            );
        }
    }

    #[test]
    fn a_wall_hides_what_is_below_its_edge() {
        // A triangle on the ground, and a wall 1 m high that stands 1 m from its tip. Seen from there its edge is 45 degrees high.
        let ground = [Vec3::ZERO, Vec3::Z, Vec3::X];
        let wall = [[-9.0f32, 9.0], [9.0, 9.0]]
            .map(|[z, top]| [Vec3::new(2.0, 0.0, z), Vec3::new(2.0, 1.0, top), Vec3::new(2.0, 1.0, -9.0)]);
        let all = [ground, wall[0], wall[1]];
        let [horizon, ..] = horizons(&all)[..] else { panic!("three triangles") };
        for (degrees, toward, is_open) in [
            (30f64, 1.0, false),
            (44.0, 1.0, false),
            (60.0, 1.0, true),
            (10.0, -1.0, true),
            (3.0, -1.0, false),
        ] {
            let (sine, cosine) = degrees.to_radians().sin_cos();
            let direction = DVec3::new(toward * cosine, sine, 0.01);
            assert_eq!(leaves(horizon, DVec3::Y, direction), is_open, "{degrees} degrees toward {toward}");
        }
    }

    #[test]
    fn size_and_place_change_no_horizon_by_much() {
        let [told, _] = shares(&waves(0.2), 2000);
        for (scale, shift) in [(1e-3f32, 0.0f32), (1e3, 0.0), (1.0, 100.0), (1e-2, 1.0)] {
            let moved: Vec<_> =
                waves(0.2).iter().map(|t| t.map(|p| p * scale + Vec3::splat(shift))).collect();
            let [still, _] = shares(&moved, 2000);
            assert!((still - told).abs() < 0.03, "{scale} {shift}: {still}, {told}");
        }
    }

    #[test]
    fn what_has_no_plane_or_is_too_much_is_closed() {
        assert!(horizons(&[]).is_empty());
        assert_eq!(horizons(&[[Vec3::ONE; 3], [Vec3::ZERO, Vec3::X, Vec3::X * 2.0]]), [CLOSED; 2]);
        let many = vec![[Vec3::ZERO, Vec3::X, Vec3::Y]; LOOKS / FEWEST_LOOKS + 1];
        assert!(horizons(&many).iter().all(|h| *h == CLOSED));
    }

    #[test]
    fn shaders_count_in_the_same_steps() {
        let glsl = include_str!("../../../shaders/glsl/generated.glsl");
        assert!(glsl.contains(&format!("#define HORIZON_STEPS {STEPS}u")));
    }
}
