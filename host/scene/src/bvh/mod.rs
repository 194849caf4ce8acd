//! A body's triangles into a compressed wide BVH (\[Ylitie17\]) in the layout that `bvh.glsl` walks.
//!
//! The tree is built once in body space; a moving body changes only its entry in the top level.

mod cluster;
mod refit;

use crate::TriangleMesh;
use cluster::{clustered, optimise, WorkLeft};
use glam::Vec3A;
use obvhs::aabb::Aabb;
use obvhs::bvh2::node::Bvh2Node;
use obvhs::bvh2::Bvh2;
use obvhs::cwbvh::bvh2_to_cwbvh::bvh2_to_cwbvh;
use obvhs::cwbvh::CwBvh;
use obvhs::triangle::Triangle;
pub use refit::Refit;

/// Entries of the traversal stack in `bvh.glsl`, besides eight in registers. A ray pushes at most one entry a level below the root, so a tree of one more level than
/// this never overflows it.
pub(crate) const TRAVERSAL_STACK: usize = 24;

/// Most triangles of a leaf of the wide tree.
const LEAF: u32 = 3;

/// Nodes of the binary tree that may look for a better place, of a large mesh; a twentieth of them always may. All of a scan with 70,000
/// triangles take 0.09 s, and a ray then opens a tenth fewer nodes than with a twentieth.
const REINSERTED: f32 = 300_000.0;

/// Words of four u32 in a node.
const NODE_WORDS: usize = 5;

/// A BVH ready for upload.
#[derive(Clone, Debug, Default)]
pub struct BodyBvh {
    /// Five words of four u32 per node, as \[Ylitie17\] has them but for where children stand: the fifth u32 is a block, and the inner child in
    /// slot s is node 8 * block + s of this body. So the walk need not count bits to find it, and one u32 is an entry of its stack. Places
    /// whose slot holds triangles or nothing are zero. The root is node 0, in slot 0 of block 0.
    pub nodes: Vec<[u32; 4]>,
    /// Triangle of the mesh for each place in BVH order. A triangle may stand in several places.
    pub order: Vec<u32>,
}

impl BodyBvh {
    /// Builds the tree; an empty mesh gives an empty tree. Coordinates are finite and at most [`crate::mesh::MAX_COORDINATE_M`]:
    /// the loader sees to it, and areas stay far below what f32 holds.
    pub fn build(mesh: &TriangleMesh) -> Self {
        if mesh.triangles.is_empty() {
            return Self::default();
        }
        Self::of_boxes(&boxes_of(mesh))
    }

    /// The tree over boxes, of which there is at least one.
    pub(crate) fn of_boxes(boxes: &[Aabb]) -> Self {
        // Clustering by area makes chains of triangles whose sizes grow geometrically. Halves by count never do.
        let walkable = |built: &Self| built.levels() <= TRAVERSAL_STACK + 1;
        Self::clustered(boxes).filter(walkable).unwrap_or_else(|| Self::halved(boxes))
    }

    /// Nodes of a tree over `boxes` boxes that may look for a better place, as a share of all.
    pub(crate) fn share(boxes: usize) -> f32 {
        (REINSERTED / boxes as f32).clamp(0.05, 1.0)
    }

    /// The faster tree: neighbours of least common area first. It may be deeper than a ray's stack; `None` where it surely is.
    fn clustered(boxes: &[Aabb]) -> Option<Self> {
        let mut tree = clustered(boxes);
        let walkable =
            optimise(&mut tree, Self::share(boxes.len()), &mut WorkLeft::of_reinsertion(boxes.len()));
        walkable.then(|| Self::from(bvh2_to_cwbvh(&tree, LEAF, true, false)))
    }

    /// The tree of [`halves`].
    fn halved(boxes: &[Aabb]) -> Self {
        Self::from(bvh2_to_cwbvh(&halves(boxes), LEAF, true, false))
    }

    /// Levels of nodes, the root's included; 0 of an empty tree.
    pub fn levels(&self) -> usize {
        let mut level: Vec<u32> = if self.nodes.is_empty() { vec![] } else { vec![0] };
        let mut levels = 0;
        while !level.is_empty() {
            levels += 1;
            let children = |&node: &u32| {
                let words = &self.nodes[node as usize * NODE_WORDS..];
                let (inner, block) = (words[0][3] >> 24, words[1][0]);
                (0..8).filter(|slot| inner >> slot & 1 == 1).map(|slot| 8 * block + slot).collect::<Vec<_>>()
            };
            level = level.iter().flat_map(children).collect();
        }
        levels
    }
}

impl From<CwBvh> for BodyBvh {
    fn from(bvh: CwBvh) -> Self {
        let packed: &[[u32; 4]] = bytemuck::cast_slice(&bvh.nodes);
        let mut nodes = vec![[0; 4]; 8 * NODE_WORDS];
        // Where a node stands in `packed`, and where it goes. Last in, first out: a subtree's blocks are neighbours in memory.
        let mut open = vec![(0usize, 0usize)];
        while let Some((from, to)) = open.pop() {
            let mut words = [[0; 4]; NODE_WORDS];
            words.copy_from_slice(&packed[from * NODE_WORDS..][..NODE_WORDS]);
            let (inner, first) = (words[0][3] >> 24, words[1][0] as usize);
            if inner != 0 {
                let block = nodes.len() / (8 * NODE_WORDS);
                nodes.resize(nodes.len() + 8 * NODE_WORDS, [0; 4]);
                words[1][0] = block as u32;
                let slots = (0..8).filter(|slot| inner >> slot & 1 == 1);
                open.extend(slots.enumerate().map(|(rank, slot)| (first + rank, 8 * block + slot)));
            }
            nodes[to * NODE_WORDS..][..NODE_WORDS].copy_from_slice(&words);
        }
        Self { nodes, order: bvh.primitive_indices }
    }
}

/// A binary tree over boxes, for what is worked out once from a body's shape.
pub(crate) fn tree_of(boxes: &[Aabb]) -> Bvh2 {
    clustered(boxes)
}

/// The boxes of a mesh's triangles, in their order.
pub(crate) fn boxes_of(mesh: &TriangleMesh) -> Vec<Aabb> {
    let corner = |i: u32| Vec3A::from(mesh.positions[i as usize]);
    let triangle = |t: &[u32; 3]| Triangle { v0: corner(t[0]), v1: corner(t[1]), v2: corner(t[2]) }.aabb();
    mesh.triangles.iter().map(triangle).collect()
}

/// A binary tree that halves the triangles by their centres along the widest axis: at most `log2(n)`, rounded up, levels of inner nodes, 24
/// for the 2^24 triangles that a body may have. A wide node replaces at least one of them, so the wide tree is no deeper.
fn halves(bounds: &[Aabb]) -> Bvh2 {
    let centre = |i: u32| bounds[i as usize].min * 0.5 + bounds[i as usize].max * 0.5;
    let union = |of: &[u32]| {
        of.iter().fold(Aabb::empty(), |mut all, &i| {
            all.min = all.min.min(bounds[i as usize].min);
            all.max = all.max.max(bounds[i as usize].max);
            all
        })
    };
    let mut order: Vec<u32> = (0..bounds.len() as u32).collect();
    let mut nodes = vec![Bvh2Node::new(union(&order), 0, 0)];
    let mut open = vec![(0usize, 0usize, order.len())];
    while let Some((node, from, to)) = open.pop() {
        let part = &mut order[from..to];
        let bounds = union(part);
        if part.len() <= 1 {
            nodes[node] = Bvh2Node::new(bounds, part.len() as u32, from as u32);
            continue;
        }
        let (low, high) = part.iter().fold((Vec3A::INFINITY, Vec3A::NEG_INFINITY), |(low, high), &i| {
            (low.min(centre(i)), high.max(centre(i)))
        });
        let wide = high - low;
        let axis = (0..3).max_by(|&a, &b| wide[a].total_cmp(&wide[b])).unwrap_or(0);
        let middle = part.len() / 2;
        part.select_nth_unstable_by(middle, |&a, &b| centre(a)[axis].total_cmp(&centre(b)[axis]));
        let first = nodes.len();
        nodes[node] = Bvh2Node::new(bounds, 0, first as u32);
        nodes.extend([Bvh2Node::new(bounds, 0, 0); 2]);
        open.push((first, from, from + middle));
        open.push((first + 1, from + middle, to));
    }
    Bvh2 { nodes, primitive_indices: order, children_are_ordered_after_parents: true, ..Bvh2::default() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes::{join, sphere, triangle};
    use glam::Vec3;

    /// Triangles at distances that grow by a factor: whatever merges neighbours by area makes a chain of them.
    fn growing(factor: f32) -> TriangleMesh {
        let n = (126.0 / factor.log2()) as i32;
        join((0..n).map(|k| {
            let x = 1e6 * factor.powi(-k);
            triangle([Vec3::new(x, 0.0, 0.0), Vec3::new(x, 0.5 * x, 0.0), Vec3::new(x, 0.0, 0.5 * x)])
        }))
    }

    #[test]
    fn the_shader_has_the_stack_that_is_counted_on() {
        let text = include_str!("../../../../shaders/glsl/walk_software.glsl");
        assert!(text.contains(&format!("const uint STACK_SIZE = {TRAVERSAL_STACK}u;")));
    }

    #[test]
    fn no_mesh_is_deeper_than_the_stack() {
        let twins = join((0..3000).map(|_| triangle([Vec3::X, Vec3::Y, Vec3::Z])));
        for (name, mesh) in [
            ("doubling", growing(2.0)),
            ("by 1.3", growing(1.3)),
            ("by 1.1", growing(1.1)),
            ("twins", twins),
            ("sphere", sphere(Vec3::ZERO, 1.0, 4, true)),
        ] {
            let bvh = BodyBvh::build(&mesh);
            let boxes = boxes_of(&mesh);
            let natural = BodyBvh::clustered(&boxes).map_or(usize::MAX, |b| b.levels());
            println!("{name}: {} levels, clustered {natural}, of {}", bvh.levels(), boxes.len());
            // Else nothing would be shown by what follows.
            assert_eq!(natural > TRAVERSAL_STACK + 1, name != "sphere", "{name}: {natural}");
            assert!(bvh.levels() <= TRAVERSAL_STACK + 1, "{name}: {}", bvh.levels());
        }
        assert_eq!(BodyBvh::default().levels(), 0);
    }

    #[test]
    fn halving_keeps_every_triangle_and_few_levels() {
        for n in [1usize, 2, 3, 4, 7, 1000, 20_000] {
            let corners = |i: usize| {
                let x = (i as f32).sqrt();
                Triangle { v0: Vec3A::splat(x), v1: Vec3A::X * x, v2: Vec3A::Y }.aabb()
            };
            let boxes: Vec<Aabb> = (0..n).map(corners).collect();
            let bvh = BodyBvh::halved(&boxes);
            let mut all = bvh.order.clone();
            all.sort_unstable();
            assert!(all.iter().copied().eq(0..n as u32), "{n}");
            let most = (n as f64).log2().ceil().max(1.0) as usize;
            assert!(bvh.levels() <= most, "{n}: {} levels", bvh.levels());
        }
    }
}
