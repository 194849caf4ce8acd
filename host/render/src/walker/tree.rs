//! The tree of a body, unpacked: boxes as floats, and the corners of the triangles of a leaf side by side.

use std::array::from_fn;

/// Triangles of a leaf that are tested at once: a leaf of [`dpm_scene::bvh::BodyBvh`] has at most three.
pub(super) const LEAF_LANES: usize = 4;

/// Words of four u32 in a node of the shaders.
const NODE_WORDS: usize = 5;

/// A node with its eight children: 256 bytes, four cache lines.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug)]
pub(super) struct WideNode {
    /// Lower planes along x, y and z, then upper planes. Of a child that is not there the lower are above the upper.
    pub planes: [[f32; 8]; 6],
    /// Of an inner child its node, of a leaf its entry in [`WideTree::triangles`].
    pub children: [u32; 8],
    /// A bit for each slot with a leaf.
    pub leaves: u32,
}

/// The triangles of a leaf. Lanes without one hold a single point, which no ray meets.
#[repr(C, align(32))]
#[derive(Clone, Copy, Debug)]
pub(super) struct Triangles {
    /// For each corner and axis the coordinate of each triangle.
    pub corners: [[[f32; LEAF_LANES]; 3]; 3],
    /// The first of them, in BVH order.
    pub first: u32,
}

/// A body's tree for rays that the processor walks.
#[derive(Clone, Debug, Default)]
pub struct WideTree {
    /// The root is the first; empty: the body has no surface.
    pub(super) nodes: Vec<WideNode>,
    pub(super) triangles: Vec<Triangles>,
}

impl WideTree {
    /// Unpacks the nodes of a [`dpm_scene::bvh::BodyBvh`]. `corners_of` gives the corners of the triangle at each place in BVH order, body space.
    ///
    /// # Panics
    /// If the words are those of no tree.
    pub fn new(words: &[[u32; 4]], corners_of: impl Fn(usize) -> [[f32; 3]; 3]) -> Self {
        let mut tree = Self::default();
        // Where a node stands in the words, and where it goes. Last in, first out: what a ray opens next lies near.
        let mut open = Vec::new();
        if !words.is_empty() {
            tree.nodes.push(NO_CHILDREN);
            open.push((0usize, 0usize));
        }
        while let Some((from, to)) = open.pop() {
            let words = &words[from * NODE_WORDS..][..NODE_WORDS];
            let byte = |word: usize, first: usize, slot: usize| {
                words[word][first + slot / 4] >> (8 * (slot % 4)) & 255
            };
            for slot in 0..8 {
                let meta = byte(1, 2, slot);
                if meta == 0 {
                    continue;
                }
                for axis in 0..3 {
                    let [lower, upper] =
                        planes_of(words, axis, [0, 2].map(|first| byte(2 + axis, first, slot)));
                    tree.nodes[to].planes[axis][slot] = lower;
                    tree.nodes[to].planes[3 + axis][slot] = upper;
                }
                if words[0][3] >> (24 + slot) & 1 == 1 {
                    tree.nodes[to].children[slot] = tree.nodes.len() as u32;
                    open.push((8 * words[1][0] as usize + slot, tree.nodes.len()));
                    tree.nodes.push(NO_CHILDREN);
                } else {
                    tree.nodes[to].leaves |= 1 << slot;
                    tree.nodes[to].children[slot] = tree.triangles.len() as u32;
                    let first = words[1][1] + (meta & 31);
                    tree.triangles.push(leaf(first, (meta >> 5).count_ones() as usize, &corners_of));
                }
            }
        }
        tree
    }

    /// Bytes that it takes.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.nodes[..]) + size_of_val(&self.triangles[..])
    }
}

const NO_CHILDREN: WideNode = WideNode {
    planes: [
        [f32::INFINITY; 8],
        [f32::INFINITY; 8],
        [f32::INFINITY; 8],
        [f32::NEG_INFINITY; 8],
        [f32::NEG_INFINITY; 8],
        [f32::NEG_INFINITY; 8],
    ],
    children: [0; 8],
    leaves: 0,
};

/// The planes of a child along an axis from their steps. They are moved apart by what the shaders move them (`slack` of `node_hits`) and what rounding
/// takes here, so every box that a shader enters is entered here: the shader's slack is relative to the distance of the node's corner, which is at most
/// the plane's own distance, for which the box test has a factor, and the node's extent.
fn planes_of(words: &[[u32; 4]], axis: usize, steps: [u32; 2]) -> [f32; 2] {
    let corner = f64::from(f32::from_bits(words[0][axis]));
    let step = f64::from(f32::from_bits((words[0][3] >> (8 * axis) & 255) << 23));
    let slack = 255.0 * step * 1e-6;
    let [lower, upper] = steps.map(|s| corner + step * f64::from(s));
    [((lower - slack) as f32).next_down(), ((upper + slack) as f32).next_up()]
}

fn leaf(first: u32, count: usize, corners_of: &impl Fn(usize) -> [[f32; 3]; 3]) -> Triangles {
    assert!(count <= LEAF_LANES, "a leaf of {count} triangles");
    let each: [_; LEAF_LANES] = from_fn(|lane| {
        let corners = corners_of(first as usize + lane.min(count.saturating_sub(1)));
        if lane < count {
            corners
        } else {
            [corners[0]; 3]
        }
    });
    Triangles { corners: from_fn(|corner| from_fn(|axis| from_fn(|lane| each[lane][corner][axis]))), first }
}
