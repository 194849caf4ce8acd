//! Rays through the bodies on the processor: which body and triangle each of them meets, and nothing else.
//!
//! Software Vulkan walks rays eight at a time under masks, and three of the eight are busy. Here a ray is walked alone, and the eight boxes of a node
//! are tested at once, as Embree does. The trees are those of the shaders ([`dpm_scene::bvh::BodyBvh`]), unpacked once. A ray visits their boxes and
//! triangles in the order of `walk_software.glsl`, and the triangle test has the same arithmetic, product by product and sum by sum without fused
//! operations. So both find the same triangle, of two equally near ones too; and the test is as watertight as the shader's. Where the ray meets the
//! triangle is computed anew by the shader that asked.
//!
//! # Example
//!
//! ```
//! use bytemuck::Zeroable;
//! use dpm_render::walker::{WalkKernel, Ray, WalkScene, WideTree};
//! use dpm_scene::{bvh::BodyBvh, shapes::sphere};
//! use dpm_shaders::structs::{Instance, NO_HIT};
//! use glam::Vec3;
//!
//! let mesh = sphere(Vec3::ZERO, 1.0, 3, true);
//! let bvh = BodyBvh::build(&mesh);
//! let corners = |at: usize| mesh.triangles[bvh.order[at] as usize].map(|v| mesh.positions[v as usize].to_array());
//! let tree = WideTree::new(&bvh.nodes, corners);
//! let here = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
//! let body = Instance { object_from_world: here, bounds_min: [-1.0; 3], bounds_max: [1.0; 3], ..Instance::zeroed() };
//! let scene = WalkScene { bodies: &[body], trees: &[tree], body_nodes: &[] };
//!
//! let toward = |direction| Ray { origin: [0.0, 0.0, 3.0], t_max: f32::MAX, direction, kind: Ray::CLOSEST };
//! let mut hits = [0; 2];
//! WalkKernel::best().walk(&scene, &[toward([0.0, 0.1, -1.0]), toward([0.0, 0.0, 1.0])], &mut hits);
//! assert!(hits[0] != NO_HIT && hits[1] == NO_HIT);
//! ```

#[cfg(target_arch = "x86_64")]
mod avx2;
mod plain;
#[cfg(test)]
mod tests;
mod tree;

use dpm_shaders::structs::{BodyNode, Instance, BODY_NODE_INNER, INSTANCE_EMPTY, NO_HIT};
pub use tree::WideTree;
use tree::{Triangles, WideNode, LEAF_LANES};

/// A ray as the shaders write it into the queue of a frame: 32 bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Ray {
    /// Where it begins, in the coordinates of the frame (the projector is the origin), metres.
    pub origin: [f32; 3],
    /// Its length in lengths of `direction`.
    pub t_max: f32,
    /// Its direction, of any length.
    pub direction: [f32; 3],
    /// [`Ray::NONE`], [`Ray::CLOSEST`] or [`Ray::ANY`] in the low 8 bits; above them the flags of bodies that it may meet (0: all).
    pub kind: u32,
}

impl Ray {
    /// No ray: it meets nothing.
    pub const NONE: u32 = 0;
    /// The nearest surface is wanted.
    pub const CLOSEST: u32 = 1;
    /// Any surface is.
    pub const ANY: u32 = 2;
}

/// The bodies of a frame.
#[derive(Clone, Copy, Debug)]
pub struct WalkScene<'a> {
    /// Where they are.
    pub bodies: &'a [Instance],
    /// The tree of each.
    pub trees: &'a [WideTree],
    /// The tree over them, octant after octant; empty: each body is asked.
    pub body_nodes: &'a [BodyNode],
}

/// A way to walk, chosen by what the processor can do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum WalkKernel {
    /// Plain Rust for every processor, in the registers that its instruction set has at least (SSE2, NEON).
    Plain,
    /// x86-64 with AVX2.
    Avx2,
}

impl WalkKernel {
    /// The kernels that this processor can run, slowest first.
    pub fn available() -> &'static [Self] {
        #[cfg(target_arch = "x86_64")]
        if avx2::is_there() {
            return &[Self::Plain, Self::Avx2];
        }
        &[Self::Plain]
    }

    /// The fastest kernel that this processor can run.
    pub fn best() -> Self {
        Self::available().last().copied().unwrap_or(Self::Plain)
    }

    /// Name for reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Plain => "plain",
            Self::Avx2 => "AVX2",
        }
    }

    /// Walks each ray. What it meets is written at its place in `hits`: the body in the upper 8 bits and the triangle in BVH order below, or
    /// `NO_HIT`. Of a ray that asks for any surface it is some surface. Allocates nothing.
    ///
    /// # Panics
    /// If `hits` is shorter than `rays`, or a body of the scene has no tree.
    pub fn walk(self, scene: &WalkScene<'_>, rays: &[Ray], hits: &mut [u32]) {
        let hits = &mut hits[..rays.len()];
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => avx2::walk(scene, rays, hits),
            _ => walk_all::<plain::PlainLanes>(scene, rays, hits),
        }
    }
}

/// What a kernel computes many at once.
trait Lanes {
    /// The children of a node whose boxes the ray enters before `t_max`, a bit each.
    fn enters(node: &WideNode, ray: &LocalRay, t_max: f32) -> u32;
    /// The triangles that the ray meets before `t_max`, a bit each, and where.
    fn meets(triangles: &Triangles, ray: &LocalRay, t_max: f32) -> (u32, [f32; LEAF_LANES]);
}

/// A ray in the space of one body, as `LocalRay` of `bvh.glsl`.
#[derive(Clone, Copy, Debug)]
struct LocalRay {
    origin: [f32; 3],
    direction: [f32; 3],
    inverse: [f32; 3],
    /// A basis across the direction, in which triangles are tested.
    u: [f32; 3],
    v: [f32; 3],
    length2: f32,
    /// For each axis the direction goes down along it.
    down: [bool; 3],
    /// A child in slot s comes in the place s ^ octant, the highest first.
    octant: usize,
}

/// A component of zero would give 0 * inf.
fn safe(direction: [f32; 3]) -> [f32; 3] {
    direction.map(|d| match d.abs() < 1e-18 {
        true if d < 0.0 => -1e-18,
        true => 1e-18,
        false => d,
    })
}

/// A sum of products in the order in which Mesa adds up what need not be precise: from the last on.
#[inline(always)]
fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[2] * b[2] + a[1] * b[1] + a[0] * b[0]
}

impl LocalRay {
    #[inline(always)]
    fn new(ray: &Ray, body: &Instance) -> Self {
        let rows = &body.object_from_world;
        let vector = |p: [f32; 3]| std::array::from_fn(|i| dot([rows[i][0], rows[i][1], rows[i][2]], p));
        let (p, direction): (_, [f32; 3]) = (ray.origin, vector(ray.direction));
        let origin = std::array::from_fn(|i| {
            let r = rows[i];
            r[3] + r[2] * p[2] + r[1] * p[1] + r[0] * p[0]
        });
        let length2 = dot(direction, direction);
        let inverse = safe(direction).map(|d| 1.0 / d);
        // The basis of [Duff17].
        let scale = 1.0 / length2.sqrt();
        let d = direction.map(|x| x * scale);
        let s = if d[2] < 0.0 { -1.0 } else { 1.0 };
        let a = -1.0 / (s + d[2]);
        let b = d[0] * d[1] * a;
        let down = inverse.map(|i| i < 0.0);
        Self {
            origin,
            direction,
            inverse,
            u: [1.0 + s * d[0] * d[0] * a, s * b, -s * d[0]],
            v: [b, s + d[1] * d[1] * a, -d[1]],
            length2,
            down,
            octant: usize::from(!down[0]) << 2 | usize::from(!down[1]) << 1 | usize::from(!down[2]),
        }
    }
}

/// For each octant and each set of slots the places of these slots.
static PLACES: [[u8; 256]; 8] = {
    let mut table = [[0; 256]; 8];
    let mut octant = 0;
    while octant < 8 {
        let mut slots = 0;
        while slots < 256 {
            let mut slot = 0;
            while slot < 8 {
                if slots >> slot & 1 == 1 {
                    table[octant][slots] |= 1 << (slot ^ octant);
                }
                slot += 1;
            }
            slots += 1;
        }
        octant += 1;
    }
    table
};

/// Groups of children that may wait: at most one a level, and no tree has more levels ([`dpm_scene::bvh`]).
const STACK: usize = 32;

/// The nearest surface so far.
#[derive(Clone, Copy, Debug)]
struct Nearest {
    t: f32,
    id: u32,
}

#[inline(always)]
fn walk_all<L: Lanes>(scene: &WalkScene<'_>, rays: &[Ray], hits: &mut [u32]) {
    for (ray, hit) in rays.iter().zip(hits) {
        *hit = walk_one::<L>(scene, ray);
    }
}

#[inline(always)]
fn walk_one<L: Lanes>(scene: &WalkScene<'_>, ray: &Ray) -> u32 {
    let [kind, mask] = [ray.kind & 0xff, ray.kind >> 8];
    let mut nearest = Nearest { t: ray.t_max, id: NO_HIT };
    let is_finite = ray.origin.iter().chain(&ray.direction).all(|x| x.is_finite());
    if kind == Ray::NONE || !is_finite {
        return NO_HIT;
    }
    let any = kind == Ray::ANY;
    let inverse = safe(ray.direction).map(|d| 1.0 / d);
    let mut at = 0;
    while let Some(body) = next_body(scene, ray, inverse, mask, nearest.t, &mut at) {
        let local = LocalRay::new(ray, &scene.bodies[body]);
        walk_body::<L>(&scene.trees[body], &local, (body as u32) << 24, any, &mut nearest);
        if any && nearest.id != NO_HIT {
            break;
        }
    }
    nearest.id
}

/// The next body whose bounds the ray enters, as `next_body` and `next_in_tree` of `bvh.glsl`; `at` moves behind it.
#[inline(always)]
fn next_body(
    scene: &WalkScene<'_>,
    ray: &Ray,
    inverse: [f32; 3],
    mask: u32,
    t_max: f32,
    at: &mut usize,
) -> Option<usize> {
    if scene.body_nodes.is_empty() {
        while let Some(body) = scene.bodies.get(*at) {
            *at += 1;
            let is_wanted = body.flags & INSTANCE_EMPTY == 0 && (mask == 0 || body.flags & mask != 0);
            if is_wanted && enters(ray, inverse, body.bounds_min, body.bounds_max, t_max) {
                return Some(*at - 1);
            }
        }
        return None;
    }
    let count = scene.body_nodes.len() / 8;
    let octant = (0..3).map(|axis| usize::from(inverse[axis] < 0.0) << axis).sum::<usize>();
    while *at < count {
        let node = &scene.body_nodes[octant * count + *at];
        let is_wanted = mask == 0 || node.body >> 8 & mask != 0;
        if is_wanted && enters(ray, inverse, node.lower, node.upper, t_max) {
            *at += 1;
            if node.body & BODY_NODE_INNER == 0 {
                return Some((node.body & 255) as usize);
            }
        } else {
            *at = node.after as usize;
        }
    }
    None
}

/// `enters_bounds` of `bvh.glsl`.
#[inline(always)]
fn enters(ray: &Ray, inverse: [f32; 3], lower: [f32; 3], upper: [f32; 3], t_max: f32) -> bool {
    // Comparisons and not `f32::min`, which looks for NaN.
    let least = |a: f32, b: f32| if a < b { a } else { b };
    let most = |a: f32, b: f32| if a > b { a } else { b };
    let (mut enter, mut leave) = (0.0, t_max);
    for axis in 0..3 {
        let (o, i) = (ray.origin[axis], inverse[axis]);
        let (a, b) = ((lower[axis] - o) * i, (upper[axis] - o) * i);
        (enter, leave) = (most(enter, least(a, b)), least(leave, most(a, b)));
    }
    enter <= leave * 1.000_000_4
}

/// Walks through one body. `first` is the hit of its first triangle.
#[inline(always)]
fn walk_body<L: Lanes>(tree: &WideTree, ray: &LocalRay, first: u32, any: bool, nearest: &mut Nearest) {
    let places = &PLACES[ray.octant];
    // The nodes whose children wait, and the places of those children.
    let mut waiting = [(0u32, 0u32); STACK];
    let mut depth = 0;
    let mut at = 0;
    while let Some(node) = tree.nodes.get(at as usize) {
        let entered = L::enters(node, ray, nearest.t);
        let mut leaves = entered & node.leaves;
        // From the last triangle of the node to its first.
        while leaves != 0 {
            let slot = leaves.ilog2();
            leaves ^= 1 << slot;
            let triangles = &tree.triangles[node.children[slot as usize] as usize];
            let (mut met, t) = L::meets(triangles, ray, nearest.t);
            while met != 0 {
                let lane = met.ilog2();
                met ^= 1 << lane;
                let t = t[lane as usize % LEAF_LANES];
                if t < nearest.t {
                    *nearest = Nearest { t, id: first | (triangles.first + lane) };
                    if any {
                        return;
                    }
                }
            }
        }
        let (mut from, mut inner) = (at, u32::from(places[(entered & !node.leaves) as usize & 255]));
        if inner == 0 {
            if depth == 0 {
                return;
            }
            depth -= 1;
            (from, inner) = waiting[depth % STACK];
        }
        let place = inner.ilog2();
        inner ^= 1 << place;
        if inner != 0 {
            waiting[depth % STACK] = (from, inner);
            depth += 1;
        }
        at = tree.nodes[from as usize].children[(place as usize ^ ray.octant) & 7];
    }
}
