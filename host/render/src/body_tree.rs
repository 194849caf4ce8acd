//! Where the bodies are this frame into a tree, in which a ray finds the few that it can meet.
//!
//! Bodies move, so the tree is built anew in every frame: of two boxes a node, split where the surface area heuristic with [`BINS`] bins says. For each
//! of the eight octants of directions its nodes are written in the order in which a ray meets them, nearest first. A node that a ray does not enter
//! says where the ray goes on, so the walk needs no stack. `next_in_tree` of `shaders/glsl/bvh.glsl` walks it.

use dpm_shaders::structs::{BodyNode, Instance, BODY_NODE_INNER, INSTANCE_EMPTY};
use glam::Vec3;

/// Fewest bodies for which a tree is built. A ray asks fewer of them in less time.
pub(crate) const FEWEST_BODIES: usize = 17;
/// Places at which a node may be split.
const BINS: usize = 8;
/// Octants of directions.
const OCTANTS: usize = 8;

/// The tree over the bodies of a scene. After it was made it allocates nothing.
#[derive(Debug, Default)]
pub(crate) struct BodyTree {
    /// Its leaves. Those of a node stand together.
    leaves: Vec<Leaf>,
    /// Each node before the two below it. The first is the root.
    nodes: Vec<BodyTreeNode>,
    /// Nodes whose leaves are still to be split: the node, and its first leaf.
    open: Vec<(u16, u16)>,
    /// Nodes that are still to be written: the node, and its place.
    places: Vec<(u16, u16)>,
    /// Most nodes of an octant.
    most: usize,
}

/// A body.
#[derive(Clone, Copy, Debug)]
struct Leaf {
    bounds: Box3,
    /// As [`BodyNode::body`].
    body: u32,
}

/// A node of the tree.
#[derive(Clone, Copy, Debug)]
struct BodyTreeNode {
    bounds: Box3,
    /// As [`BodyNode::body`].
    body: u32,
    /// Bodies below it.
    count: u16,
    /// The first of the two nodes below it, which lies lower along `axis`. The other one follows.
    below: u16,
    axis: u8,
}

/// An axis-aligned box.
#[derive(Clone, Copy, Debug)]
struct Box3 {
    lower: Vec3,
    upper: Vec3,
}

impl Box3 {
    const NOTHING: Self = Self { lower: Vec3::INFINITY, upper: Vec3::NEG_INFINITY };

    fn union(self, other: Self) -> Self {
        Self { lower: self.lower.min(other.lower), upper: self.upper.max(other.upper) }
    }

    /// Half of its surface; 0 if it is empty.
    fn half_area(self) -> f32 {
        let d = (self.upper - self.lower).max(Vec3::ZERO);
        d.x * d.y + d.y * d.z + d.z * d.x
    }

    /// Twice its centre.
    fn centre(self) -> Vec3 {
        self.lower + self.upper
    }
}

fn union_of(leaves: &[Leaf]) -> Box3 {
    leaves.iter().fold(Box3::NOTHING, |all, leaf| all.union(leaf.bounds))
}

impl BodyTree {
    /// Room for a tree over `bodies` bodies; 0: no tree is built.
    pub(crate) fn new(bodies: usize) -> Self {
        let most = (2 * bodies).saturating_sub(1);
        Self {
            leaves: Vec::with_capacity(bodies),
            nodes: Vec::with_capacity(most),
            open: Vec::with_capacity(bodies),
            places: Vec::with_capacity(bodies),
            most,
        }
    }

    /// Most nodes that it writes, for all octants together.
    pub(crate) fn most_nodes(&self) -> usize {
        self.most * OCTANTS
    }

    /// Forgets all bodies.
    pub(crate) fn clear(&mut self) {
        self.leaves.clear();
    }

    /// Adds a body where it is in this frame. One without surfaces is left out, and so is every body where no tree is built.
    pub(crate) fn add(&mut self, instance: &Instance) {
        if instance.flags & INSTANCE_EMPTY == 0 && 2 * self.leaves.len() < self.most {
            let bounds = Box3 { lower: instance.bounds_min.into(), upper: instance.bounds_max.into() };
            self.leaves.push(Leaf { bounds, body: instance.body | instance.flags << 8 });
        }
    }

    /// Builds the tree over the bodies that were added, and writes its nodes, octant after octant. Bit 0 of an octant's number: the direction goes
    /// down along x; bit 1: along y; bit 2: along z. Returns how many nodes an octant has.
    ///
    /// # Panics
    /// If `out` is shorter than [`BodyTree::most_nodes`].
    pub(crate) fn write(&mut self, out: &mut [BodyNode]) -> u32 {
        self.build();
        let count = self.nodes.len();
        for octant in 0..OCTANTS {
            self.write_octant(octant, &mut out[octant * count..][..count]);
        }
        count as u32
    }

    fn build(&mut self) {
        self.nodes.clear();
        self.open.clear();
        if self.leaves.is_empty() {
            return;
        }
        self.nodes.push(node_of(&self.leaves));
        self.open.push((0, 0));
        while let Some((at, first)) = self.open.pop() {
            let count = self.nodes[usize::from(at)].count;
            if count < 2 {
                continue;
            }
            let leaves = &mut self.leaves[usize::from(first)..][..usize::from(count)];
            let (axis, middle) = split(leaves);
            let (lower, upper) = leaves.split_at(middle);
            let halves = [node_of(lower), node_of(upper)];
            let below = self.nodes.len() as u16;
            (self.nodes[usize::from(at)].below, self.nodes[usize::from(at)].axis) = (below, axis as u8);
            self.nodes.extend(halves);
            self.open.push((below, first));
            self.open.push((below + 1, first + middle as u16));
        }
    }

    fn write_octant(&mut self, octant: usize, out: &mut [BodyNode]) {
        if self.nodes.is_empty() {
            return;
        }
        self.places.push((0, 0));
        while let Some((from, at)) = self.places.pop() {
            let node = self.nodes[usize::from(from)];
            out[usize::from(at)] = BodyNode {
                lower: node.bounds.lower.into(),
                after: u32::from(at + 2 * node.count - 1),
                upper: node.bounds.upper.into(),
                body: node.body,
            };
            if node.count > 1 {
                let goes_down = octant >> node.axis & 1 == 1;
                let [near, far] =
                    if goes_down { [node.below + 1, node.below] } else { [node.below, node.below + 1] };
                let bodies_near = self.nodes[usize::from(near)].count;
                self.places.push((near, at + 1));
                self.places.push((far, at + 2 * bodies_near));
            }
        }
    }
}

/// The node over these leaves. What is below it is not yet known.
fn node_of(leaves: &[Leaf]) -> BodyTreeNode {
    let flags = leaves.iter().fold(0, |all, leaf| all | leaf.body & 0xff00);
    let body = if let [one] = leaves { one.body } else { flags | BODY_NODE_INNER };
    BodyTreeNode { bounds: union_of(leaves), body, count: leaves.len() as u16, below: 0, axis: 0 }
}

/// Sorts the leaves of a node to the two sides of the best place along the widest axis. Returns that axis, and how many lie on the lower side.
fn split(leaves: &mut [Leaf]) -> (usize, usize) {
    let (low, high) = leaves.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), leaf| {
        (low.min(leaf.bounds.centre()), high.max(leaf.bounds.centre()))
    });
    let wide = high - low;
    let axis = (0..3).fold(0, |best, axis| if wide[axis] > wide[best] { axis } else { best });
    let scale = BINS as f32 / wide[axis];
    let bin = |leaf: &Leaf| (((leaf.bounds.centre()[axis] - low[axis]) * scale) as usize).min(BINS - 1);
    let place = if wide[axis] > 0.0 && scale.is_finite() { best_place(leaves, bin) } else { None };
    if let Some(place) = place {
        let mut middle = 0;
        for i in 0..leaves.len() {
            if bin(&leaves[i]) < place {
                leaves.swap(i, middle);
                middle += 1;
            }
        }
        return (axis, middle);
    }
    // All lie at one place, or too far apart to be told: any halves are as good as others.
    (axis, leaves.len() / 2)
}

/// The bin before which the leaves are parted at least cost. `None`: all are in one.
fn best_place(leaves: &[Leaf], bin: impl Fn(&Leaf) -> usize) -> Option<usize> {
    let mut bins = [(Box3::NOTHING, 0u32); BINS];
    for leaf in leaves {
        let (bounds, count) = &mut bins[bin(leaf)];
        *bounds = bounds.union(leaf.bounds);
        *count += 1;
    }
    let cost_of = |part: &[(Box3, u32)]| {
        let (bounds, count) = part.iter().fold((Box3::NOTHING, 0), |(all, n), b| (all.union(b.0), n + b.1));
        (count > 0).then(|| bounds.half_area() * count as f32)
    };
    let mut best = None;
    for place in 1..BINS {
        let (before, after) = bins.split_at(place);
        if let (Some(before), Some(after)) = (cost_of(before), cost_of(after)) {
            if best.is_none_or(|(least, _)| before + after < least) {
                best = Some((before + after, place));
            }
        }
    }
    best.map(|(_, place)| place)
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;
    use dpm_device::rng::Sampler;
    use dpm_shaders::structs::INSTANCE_PROJECTED;
    use std::time::Instant;

    /// A point of the unit cube.
    fn point(random: &mut Sampler) -> Vec3 {
        Vec3::from_array(std::array::from_fn(|_| random.uniform() as f32))
    }

    fn boxes(count: usize, size: f32, random: &mut Sampler) -> Vec<Instance> {
        (0..count)
            .map(|i| {
                let lower = point(random) * 10.0;
                Instance {
                    bounds_min: lower.into(),
                    bounds_max: (lower + point(random) * size).into(),
                    flags: if i % 3 == 0 { INSTANCE_PROJECTED } else { 0 },
                    body: i as u32,
                    ..Instance::zeroed()
                }
            })
            .collect()
    }

    fn written(instances: &[Instance]) -> (Vec<BodyNode>, usize) {
        let mut tree = BodyTree::new(instances.len());
        let mut out = vec![BodyNode::zeroed(); tree.most_nodes()];
        instances.iter().for_each(|instance| tree.add(instance));
        let count = tree.write(&mut out) as usize;
        (out, count)
    }

    /// As `enters_bounds` of the shader: where the ray enters, if it does before `t_max`.
    fn enters(origin: Vec3, inverse: Vec3, lower: [f32; 3], upper: [f32; 3], t_max: f32) -> Option<f32> {
        let (t0, t1) = ((Vec3::from(lower) - origin) * inverse, (Vec3::from(upper) - origin) * inverse);
        let enter = t0.min(t1).max_element().max(0.0);
        let leave = t0.max(t1).min_element().min(t_max) * 1.000_000_4;
        (enter <= leave).then_some(enter)
    }

    /// The bodies that a ray meets in the tree, in the order in which it finds them, and how many nodes it asks.
    fn walk(nodes: &[BodyNode], count: usize, origin: Vec3, inverse: Vec3, mask: u32) -> (Vec<u32>, usize) {
        let octant = (0..3).map(|axis| usize::from(inverse[axis] < 0.0) << axis).sum::<usize>();
        let nodes = &nodes[octant * count..][..count];
        let (mut at, mut found, mut asked) = (0, Vec::new(), 0);
        while at < count {
            let node = &nodes[at];
            asked += 1;
            let is_wanted = mask == 0 || node.body >> 8 & mask != 0;
            if is_wanted && enters(origin, inverse, node.lower, node.upper, f32::MAX).is_some() {
                if node.body & BODY_NODE_INNER == 0 {
                    found.push(node.body & 255);
                }
                at += 1;
            } else {
                at = node.after as usize;
            }
        }
        (found, asked)
    }

    /// Whatever the bodies, a ray finds in the tree exactly those whose boxes it enters, with a mask and without.
    #[test]
    fn a_ray_finds_every_body_that_it_enters_and_no_other() {
        let mut random = Sampler::new(7, 0);
        for (count, size) in [(0, 1.0), (1, 1.0), (2, 9.0), (9, 3.0), (64, 0.5), (256, 0.2), (256, 12.0)] {
            let instances = boxes(count, size, &mut random);
            let (nodes, per_octant) = written(&instances);
            assert_eq!(per_octant, (2 * count).saturating_sub(1));
            for k in 0..500 {
                let origin = point(&mut random) * 12.0 - 1.0;
                let inverse = 1.0 / (point(&mut random) - 0.5);
                let mask = if k % 2 == 0 { 0 } else { INSTANCE_PROJECTED };
                let is_entered = |i: &&Instance| {
                    (mask == 0 || i.flags & mask != 0)
                        && enters(origin, inverse, i.bounds_min, i.bounds_max, f32::MAX).is_some()
                };
                let expected: Vec<u32> = instances.iter().filter(is_entered).map(|i| i.body).collect();
                let (mut found, _) = walk(&nodes, per_octant, origin, inverse, mask);
                found.sort_unstable();
                assert_eq!(found, expected, "{count} bodies of size {size}, ray {k}");
            }
        }
    }

    /// Bodies that stand apart are found from the nearest to the farthest, whichever way the ray goes.
    #[test]
    fn a_ray_finds_bodies_from_near_to_far() {
        let along = |axis: usize| -> Vec<Instance> {
            (0..20u32)
                .map(|i| {
                    let mut lower = Vec3::ZERO;
                    lower[axis] = (i * 7 % 20) as f32;
                    Instance {
                        bounds_min: lower.into(),
                        bounds_max: (lower + 0.5).into(),
                        body: i,
                        ..Instance::zeroed()
                    }
                })
                .collect()
        };
        for axis in 0..3 {
            let instances = along(axis);
            let (nodes, count) = written(&instances);
            for sign in [1.0, -1.0] {
                let mut direction = Vec3::splat(1e-4);
                direction[axis] = sign;
                let mut origin = Vec3::splat(0.25);
                origin[axis] = if sign > 0.0 { -5.0 } else { 25.0 };
                let (found, _) = walk(&nodes, count, origin, 1.0 / direction, 0);
                let place = |body: &u32| sign * instances[*body as usize].bounds_min[axis];
                assert_eq!(found.len(), 20);
                assert!(found.windows(2).all(|pair| place(&pair[0]) < place(&pair[1])), "{axis} {sign}");
            }
        }
    }

    /// Of many small bodies a ray asks few. A ray through a cloud of n bodies passes about as many as the cube root of n, and goes down to each: of
    /// 16 times as many bodies it asks less than six times as many nodes.
    #[test]
    fn few_nodes_are_asked_of_many_bodies() {
        let mut random = Sampler::new(3, 0);
        let mut asked_of = |count: usize| {
            let instances = boxes(count, 0.3, &mut random);
            let (nodes, per_octant) = written(&instances);
            let rays = 2000;
            let asked = (0..rays).map(|_| {
                let (origin, inverse) = (point(&mut random) * 10.0, 1.0 / (point(&mut random) - 0.5));
                walk(&nodes, per_octant, origin, inverse, 0).1
            });
            asked.sum::<usize>() as f64 / f64::from(rays)
        };
        let [few, many] = [asked_of(16), asked_of(256)];
        println!("nodes asked: {few:.1} of 16 bodies, {many:.1} of 256");
        for count in [64, 256] {
            let instances = boxes(count, 0.3, &mut random);
            let started = Instant::now();
            (0..100).for_each(|_| drop(written(&instances)));
            println!("{count} bodies take the host {:?}", started.elapsed() / 100);
        }
        assert!(few < 16.0 && many < 48.0 && many < 6.0 * few, "{few} {many}");
    }

    /// Bodies at one place, boxes that are huge, and bodies without surfaces take no more nodes and are found.
    #[test]
    fn odd_bodies_have_a_tree_too() {
        let mut random = Sampler::new(1, 0);
        let mut same = vec![boxes(1, 1.0, &mut random)[0]; 100];
        (0..100).for_each(|i| same[i].body = i as u32);
        let (nodes, count) = written(&same);
        assert_eq!(count, 199);
        let centre = Vec3::from(same[0].bounds_min).midpoint(same[0].bounds_max.into());
        let origin = centre - Vec3::X * 20.0;
        assert_eq!(walk(&nodes, count, origin, 1.0 / Vec3::new(1.0, 1e-9, 1e-9), 0).0.len(), 100);
        for far in [f32::MAX, f32::INFINITY] {
            let mut huge = boxes(40, 1.0, &mut random);
            huge[7].bounds_min = [-far; 3];
            huge[9].bounds_max = [far; 3];
            assert_eq!(written(&huge).1, 79);
        }
        let mut some = boxes(10, 1.0, &mut random);
        some[4].flags = INSTANCE_EMPTY;
        let (nodes, count) = written(&some);
        assert_eq!(count, 17);
        let has =
            |body: u32| nodes[..count].iter().any(|n| n.body & BODY_NODE_INNER == 0 && n.body & 255 == body);
        assert!(!has(4) && (0..10).filter(|&b| has(b)).count() == 9);
    }
}
