//! The tree of a mesh that deforms, fitted to where its triangles are now. Which triangles a node holds stays as it was built.

use glam::{Vec3, Vec3A};
use obvhs::aabb::Aabb;

use super::{BodyBvh, NODE_WORDS};

/// What refitting a tree needs, once for each tree.
#[derive(Clone, Debug, Default)]
pub struct Refit {
    /// Nodes that the walk can reach, each before those below it.
    nodes: Vec<u32>,
    /// Bounds of each node; of use while it runs.
    bounds: Vec<Aabb>,
}

/// The box of nothing.
const NOTHING: Aabb = Aabb { min: Vec3A::INFINITY, max: Vec3A::NEG_INFINITY };

/// What stands in a slot of a node.
enum Slot {
    Nothing,
    /// A node of the body.
    Inner(usize),
    /// Triangles, first and number, in BVH order.
    Triangles(usize, usize),
}

fn byte(words: &[[u32; 4]], word: usize, first: usize, slot: usize) -> u8 {
    (words[word][first + slot / 4] >> (8 * (slot % 4))) as u8
}

fn slot_of(words: &[[u32; 4]], slot: usize) -> Slot {
    let meta = byte(words, 1, 2, slot);
    if meta == 0 {
        Slot::Nothing
    } else if words[0][3] >> (24 + slot) & 1 == 1 {
        Slot::Inner(8 * words[1][0] as usize + slot)
    } else {
        Slot::Triangles((words[1][1] + u32::from(meta & 31)) as usize, (meta >> 5).count_ones() as usize)
    }
}

/// The power of two, as the exponent's bits of an f32, of which 255 steps are at least `length`, which is not negative and
/// below 2^100.
fn step_bits(length: f32) -> u32 {
    let least = f64::from(length) / 255.0;
    let bits = (least as f32).to_bits();
    // Rounded up to a power of two. The smallest that is no subnormal serves a node without extent.
    let exponent =
        (bits >> 23) + u32::from(bits & 0x007f_ffff != 0 || f64::from(f32::from_bits(bits)) < least);
    exponent.max(1)
}

impl Refit {
    /// For the tree `bvh`.
    pub fn new(bvh: &BodyBvh) -> Self {
        let mut nodes: Vec<u32> = if bvh.nodes.is_empty() { vec![] } else { vec![0] };
        let mut next = 0;
        while let Some(&node) = nodes.get(next) {
            let words = &bvh.nodes[node as usize * NODE_WORDS..][..NODE_WORDS];
            nodes.extend((0..8).filter_map(|slot| match slot_of(words, slot) {
                Slot::Inner(below) => Some(below as u32),
                _ => None,
            }));
            next += 1;
        }
        Self { nodes, bounds: vec![NOTHING; bvh.nodes.len() / NODE_WORDS] }
    }

    /// Changes the boxes of `nodes` to hold the triangles, whose corners `corners_of` gives for each place in BVH order, and
    /// returns the corners of the box of all. Coordinates are finite and at most [`crate::mesh::MAX_COORDINATE_M`]. Allocates
    /// nothing.
    pub fn run(&mut self, nodes: &mut [[u32; 4]], corners_of: impl Fn(usize) -> [Vec3; 3]) -> [Vec3; 2] {
        let box_of = |triangle: usize| {
            let [a, b, c] = corners_of(triangle).map(Vec3A::from);
            Aabb { min: a.min(b).min(c), max: a.max(b).max(c) }
        };
        for &node in self.nodes.iter().rev() {
            let words = &mut nodes[node as usize * NODE_WORDS..][..NODE_WORDS];
            let mut slots = [NOTHING; 8];
            for (slot, bounds) in slots.iter_mut().enumerate() {
                *bounds = match slot_of(words, slot) {
                    Slot::Nothing => continue,
                    Slot::Inner(below) => self.bounds[below],
                    Slot::Triangles(first, count) => {
                        (first..first + count).map(box_of).fold(NOTHING, |all, one| all.union(&one))
                    }
                };
            }
            let all = slots.iter().fold(NOTHING, |all, slot| all.union(slot));
            self.bounds[node as usize] = all;
            write(words, all, &slots);
        }
        let all = self.nodes.first().map_or(NOTHING, |_| self.bounds[0]);
        [all.min.into(), all.max.into()]
    }
}

/// The boxes of a node's slots as steps from the lower corner of all, rounded outwards \[Ylitie17\].
fn write(words: &mut [[u32; 4]], all: Aabb, slots: &[Aabb; 8]) {
    let mut exponents = 0;
    for axis in 0..3 {
        let origin = all.min[axis];
        let exponent = step_bits(all.max[axis] - origin);
        words[0][axis] = origin.to_bits();
        exponents |= exponent << (8 * axis);
        let steps = 1.0 / f64::from(f32::from_bits(exponent << 23));
        // Not negative. Exact to within rounding far below a step: a step is a power of two.
        let of = |x: f32| (f64::from(x) - f64::from(origin)) * steps;
        let mut planes = [[0u8; 8]; 2];
        for (slot, bounds) in slots.iter().enumerate() {
            if bounds.min.x > bounds.max.x {
                continue;
            }
            let (lower, upper) = (of(bounds.min[axis]), of(bounds.max[axis]));
            let whole = upper as u32;
            planes[0][slot] = (lower as u32).min(255) as u8;
            planes[1][slot] = (whole + u32::from(f64::from(whole) < upper)).min(255) as u8;
        }
        words[2 + axis] = bytemuck::cast(planes);
    }
    words[0][3] = words[0][3] & 0xff00_0000 | exponents;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes::sphere;
    use crate::TriangleMesh;

    /// Corners of the box of a slot, as the shaders read it.
    fn read(words: &[[u32; 4]], slot: usize) -> [Vec3; 2] {
        let step = |axis: usize| f64::from(f32::from_bits((words[0][3] >> (8 * axis) & 0xff) << 23));
        let plane = |axis: usize, first: usize| {
            let origin = f64::from(f32::from_bits(words[0][axis]));
            (origin + step(axis) * f64::from(byte(words, 2 + axis, first, slot))) as f32
        };
        [0, 2].map(|first| Vec3::from_array([0, 1, 2].map(|axis| plane(axis, first))))
    }

    /// The triangles below a node, each checked to lie in all boxes above it.
    fn check(
        nodes: &[[u32; 4]],
        node: usize,
        above: &[[Vec3; 2]],
        corners: &dyn Fn(usize) -> [Vec3; 3],
    ) -> usize {
        let words = &nodes[node * NODE_WORDS..][..NODE_WORDS];
        (0..8)
            .map(|slot| {
                let boxes = [above, &[read(words, slot)]].concat();
                match slot_of(words, slot) {
                    Slot::Nothing => 0,
                    Slot::Inner(below) => check(nodes, below, &boxes, corners),
                    Slot::Triangles(first, count) => {
                        let slack = 1e-6;
                        for p in (first..first + count).flat_map(corners) {
                            let holds = |b: &[Vec3; 2]| {
                                let slack = Vec3::splat(slack * p.abs().max_element());
                                p.cmpge(b[0] - slack).all() && p.cmple(b[1] + slack).all()
                            };
                            assert!(boxes.iter().all(holds), "{p} is outside of {boxes:?}");
                        }
                        count
                    }
                }
            })
            .sum()
    }

    /// However a mesh is deformed, every box holds its triangles, and the box of all is exact. Where nothing has moved, boxes
    /// are no larger than those of the builder.
    #[test]
    fn boxes_hold_their_triangles_and_are_small() {
        let still = sphere(Vec3::new(0.2, 0.0, -0.1), 0.1, 3, true);
        let bvh = BodyBvh::build(&still);
        let mut refit = Refit::new(&bvh);
        let twist = |p: Vec3, t: f32| {
            let (s, c) = (t * p.y * 20.0).sin_cos();
            Vec3::new(c * p.x - s * p.z, p.y * (1.0 + t), s * p.x + c * p.z)
        };
        let area = |nodes: &[[u32; 4]]| -> f64 {
            let of = |words: &[[u32; 4]]| {
                let used = (0..8).filter(|slot| byte(words, 1, 2, *slot) != 0);
                used.map(|slot| read(words, slot))
                    .map(|[a, b]| {
                        let d = (b - a).as_dvec3();
                        d.x * d.y + d.y * d.z + d.z * d.x
                    })
                    .sum::<f64>()
            };
            nodes.chunks(NODE_WORDS).map(of).sum()
        };
        type Deform<'a> = Box<dyn Fn(Vec3) -> Vec3 + 'a>;
        let deformations: [(&str, Deform); 6] = [
            ("nothing", Box::new(|p| p)),
            ("a twist", Box::new(|p| twist(p, 0.7))),
            ("flat", Box::new(|p| p * Vec3::new(1.0, 0.0, 1.0))),
            ("a point", Box::new(|_| Vec3::splat(0.3))),
            ("huge", Box::new(|p| p * 9.9e5)),
            ("tiny", Box::new(|p| p * 1e-30)),
        ];
        for (what, deform) in deformations {
            let mesh = TriangleMesh {
                positions: still.positions.iter().map(|p| deform(*p)).collect(),
                ..still.clone()
            };
            let corners =
                |place: usize| mesh.triangles[bvh.order[place] as usize].map(|i| mesh.positions[i as usize]);
            let mut nodes = bvh.nodes.clone();
            let all = refit.run(&mut nodes, corners);
            assert_eq!(check(&nodes, 0, &[all], &corners), bvh.order.len(), "{what}");
            let lower = mesh.positions.iter().fold(Vec3::INFINITY, |all, p| all.min(*p));
            let upper = mesh.positions.iter().fold(Vec3::NEG_INFINITY, |all, p| all.max(*p));
            assert_eq!(all, [lower, upper], "{what}");
            if what == "nothing" {
                assert!(area(&nodes) <= 1.001 * area(&bvh.nodes), "{} {}", area(&nodes), area(&bvh.nodes));
            }
            // It can be fitted back.
            let back = |place: usize| {
                still.triangles[bvh.order[place] as usize].map(|i| still.positions[i as usize])
            };
            refit.run(&mut nodes, back);
            check(&nodes, 0, &[], &back);
        }
        assert_eq!(Refit::new(&BodyBvh::default()).run(&mut [], |_| [Vec3::ZERO; 3])[0], Vec3::INFINITY);
    }
}
