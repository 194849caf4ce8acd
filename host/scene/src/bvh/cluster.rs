//! Boxes into a binary tree by locally ordered clustering (\[Meister18b\]) and reinsertion (\[Meister18\]), in bounded time.
//!
//! The algorithms are those of the crate `obvhs`, step for step, so that a mesh gets the tree that `obvhs` builds, bit for bit. What is added is a
//! bound on the work. Clustering merges two neighbours when each is the other's best partner; on boxes that all coincide, or that lie one inside
//! the other, only a few pairs agree in a pass, and the time grows with the square of their number. Reinsertion looks for a better place in the
//! whole tree when nothing can be excluded. Both stop here when they have done many times the work that any ordinary mesh needs: what
//! is not yet clustered is then joined by halves, and a tree that is not yet optimised stays as it is. The count of the work depends on the boxes alone,
//! so the same mesh gets the same tree on every machine.

use glam::{DVec3, Vec3A};
use obvhs::aabb::Aabb;
use obvhs::bvh2::node::Bvh2Node;
use obvhs::bvh2::reinsertion::reinsert_node;
use obvhs::bvh2::Bvh2;
use obvhs::ploc::morton::morton_encode_u128_unorm;
use rdst::{RadixKey, RadixSort};

/// Neighbours on each side among which a cluster looks for its partner.
const SEARCH: usize = 14;

/// Clusters looked at for each box, and in any case, until clustering gives up. Ordinary meshes need 3 to 5 for each box.
const LOOKS: (u64, u64) = (40, 1_000_000);

/// Passes until clustering gives up: each may make the tree one level deeper, and ordinary meshes need fewer than 60.
const PASSES: u32 = 1000;

/// Levels of a binary tree beyond which it is no use: a wide node takes the place of at most seven levels, and a ray's stack has room for 25.
const DEEPEST: usize = 185;

/// From here on the Morton codes are sorted by radix, as `obvhs` does.
const RADIX_FROM: usize = 250_001;

/// What is left of the work that may be done.
#[derive(Clone, Copy, Debug)]
pub(super) struct WorkLeft(u64);

impl WorkLeft {
    /// Nodes that reinsertion may look at in a tree of `boxes` boxes: several times what ordinary meshes need, and never more than a few seconds'.
    pub(super) fn of_reinsertion(boxes: usize) -> Self {
        Self((2_000 * boxes as u64 + 5_000_000).min(400_000_000))
    }

    fn take(&mut self, units: u64) -> bool {
        let enough = self.0 >= units;
        self.0 = self.0.saturating_sub(units);
        enough
    }
}

/// A place on the Morton curve, of the size and layout that `obvhs` sorts.
#[derive(Clone, Copy)]
#[repr(C)]
struct MortonPlace {
    code: u128,
    index: u64,
    padding: u64,
}

impl RadixKey for MortonPlace {
    const LEVELS: usize = 16;

    #[inline]
    fn get_level(&self, level: usize) -> u8 {
        self.code.get_level(level)
    }
}

/// Leaves in the order of the Morton curve through their centres.
fn in_order(boxes: &[Aabb]) -> Vec<Bvh2Node> {
    let all = boxes.iter().fold(Aabb::empty(), |mut all, b| {
        all.extend(b.min);
        all.extend(b.max);
        all
    });
    let scale = 1.0 / all.diagonal().as_dvec3();
    let offset: DVec3 = -all.min.as_dvec3() * scale;
    let place = |(index, b): (usize, &Aabb)| MortonPlace {
        code: morton_encode_u128_unorm(b.center().as_dvec3() * scale + offset),
        index: index as u64,
        padding: 0,
    };
    let mut places: Vec<MortonPlace> = boxes.iter().enumerate().map(place).collect();
    if places.len() < RADIX_FROM {
        places.sort_unstable_by_key(|p| p.code);
    } else {
        places.radix_sort_unstable();
    }
    places.iter().map(|p| Bvh2Node::new(boxes[p.index as usize], 1, p.index as u32)).collect()
}

/// Where inner nodes are put: from the end of the list forwards, so that children stand after their parents.
struct Places {
    nodes: Vec<Bvh2Node>,
    next: usize,
}

impl Places {
    /// The parent of two nodes, which are given their places.
    fn join(&mut self, left: Bvh2Node, right: Bvh2Node) -> Bvh2Node {
        self.next -= 2;
        self.nodes[self.next] = left;
        self.nodes[self.next + 1] = right;
        Bvh2Node::new(left.aabb().union(right.aabb()), 0, self.next as u32)
    }

    /// The root over `clusters`, of which there is at least one: halves by their centres along the widest axis.
    fn halve(&mut self, clusters: &mut [Bvh2Node]) -> Bvh2Node {
        if let [one] = clusters {
            return *one;
        }
        let (low, high) = clusters.iter().fold((Vec3A::INFINITY, Vec3A::NEG_INFINITY), |(low, high), n| {
            (low.min(n.aabb().center()), high.max(n.aabb().center()))
        });
        let wide = high - low;
        let axis = (0..3).max_by(|&a, &b| wide[a].total_cmp(&wide[b])).unwrap_or(0);
        let middle = clusters.len() / 2;
        let centre = |n: &Bvh2Node| n.aabb().center()[axis];
        clusters.select_nth_unstable_by(middle, |a, b| centre(a).total_cmp(&centre(b)));
        let (before, after) = clusters.split_at_mut(middle);
        let left = self.halve(before);
        let right = self.halve(after);
        self.join(left, right)
    }
}

/// Costs of unions that were found from the other side.
struct Costs([[f32; SEARCH]; SEARCH]);

impl Costs {
    /// How far from `index` its best partner is: the one with the smallest common box, the last of equals. Asked for every index in turn.
    fn best_partner(&mut self, index: usize, clusters: &[Bvh2Node]) -> i8 {
        let mut best = (f32::INFINITY, index);
        for other in index.saturating_sub(SEARCH)..index {
            let cost = self.0[other % SEARCH][index % SEARCH];
            if cost <= best.0 {
                best = (cost, other);
            }
        }
        let own = clusters[index].aabb();
        for (other, cluster) in clusters.iter().enumerate().skip(index + 1).take(SEARCH) {
            let cost = own.union(cluster.aabb()).half_area();
            self.0[index % SEARCH][other % SEARCH] = cost;
            if cost <= best.0 {
                best = (cost, other);
            }
        }
        (best.1 as i64 - index as i64) as i8
    }
}

/// The first pass compares direct neighbours only.
fn nearest_partners(clusters: &[Bvh2Node], partners: &mut [i8]) {
    let mut last = f32::INFINITY;
    for (pair, partner) in clusters.windows(2).zip(&mut *partners) {
        let cost = pair[0].aabb().union(pair[1].aabb()).half_area();
        *partner = if last < cost { -1 } else { 1 };
        last = cost;
    }
    if let Some(partner) = partners.last_mut() {
        *partner = -1;
    }
}

/// The tree over `boxes`, whose leaves hold one of them each. Nothing but its depth is left to chance: see [`PASSES`].
pub(super) fn clustered(boxes: &[Aabb]) -> Bvh2 {
    let count = boxes.len();
    if count == 0 {
        return Bvh2::default();
    }
    let mut clusters = in_order(boxes);
    let total = 2 * count - 1;
    let mut places = Places { nodes: vec![Bvh2Node::default(); total], next: total };
    let mut next = Vec::with_capacity(count);
    let mut partners = vec![0i8; count];
    let mut costs = Box::new(Costs([[0.0; SEARCH]; SEARCH]));
    let mut work = WorkLeft(LOOKS.0 * count as u64 + LOOKS.1);
    let mut passes = 0;
    while clusters.len() > 1 {
        if passes >= PASSES || !work.take(clusters.len() as u64) {
            let root = places.halve(&mut clusters);
            clusters = vec![root];
            break;
        }
        let partners = &mut partners[..clusters.len()];
        if passes == 0 {
            nearest_partners(&clusters, partners);
        } else {
            for (index, partner) in partners.iter_mut().enumerate() {
                *partner = costs.best_partner(index, &clusters);
            }
        }
        next.clear();
        for index in 0..clusters.len() {
            let best = (index as i64 + i64::from(partners[index])) as usize;
            if best as i64 + i64::from(partners[best]) != index as i64 {
                next.push(clusters[index]);
            } else if best < index {
                // The two agree; they are joined where the second of them stands.
                let parent = places.join(clusters[index], clusters[best]);
                next.push(parent);
            }
        }
        std::mem::swap(&mut clusters, &mut next);
        passes += 1;
    }
    let Places { mut nodes, .. } = places;
    nodes[0] = clusters[0];
    Bvh2 {
        nodes,
        primitive_indices: (0..count as u32).collect(),
        children_are_ordered_after_parents: true,
        ..Bvh2::default()
    }
}

/// A node that may find a better place, and how much it takes up.
#[derive(Clone, Copy)]
struct MovableNode {
    node: u32,
    cost: f32,
}

impl RadixKey for MovableNode {
    const LEVELS: usize = 4;

    #[inline]
    fn get_level(&self, level: usize) -> u8 {
        // The largest first.
        (-self.cost).get_level(level)
    }
}

/// A node, where it would be better, and by how much.
#[derive(Clone, Copy)]
struct Move {
    from: u32,
    to: u32,
    gain: f32,
}

/// Moves nodes to where the tree's boxes become smaller, `share` of all nodes in the first of sixteen rounds and fewer in each that follows,
/// until `work` is used up. False when the tree has become so deep that no ray could walk it.
pub(super) fn optimise(bvh: &mut Bvh2, share: f32, work: &mut WorkLeft) -> bool {
    if bvh.nodes.first().is_none_or(Bvh2Node::is_leaf) || share <= 0.0 {
        return true;
    }
    bvh.init_parents_if_uninit();
    bvh.children_are_ordered_after_parents = false;
    let mut touched = vec![false; bvh.nodes.len()];
    let mut stack = Vec::new();
    for round in (1..32).step_by(2) {
        if levels(bvh) > DEEPEST {
            return false;
        }
        let ratio = 1.0 / round as f32;
        let batch = (((bvh.nodes.len() as f32 * share) * ratio) as usize).max(1);
        let count = bvh.nodes.len().min(batch + 1);
        let mut candidates: Vec<MovableNode> = bvh
            .nodes
            .iter()
            .enumerate()
            .take(count * 2)
            .skip(1)
            .map(|(node, n)| MovableNode { node: node as u32, cost: n.aabb().half_area() })
            .collect();
        candidates.radix_sort_unstable();
        let mut moves = Vec::new();
        let mut exhausted = false;
        for candidate in &candidates[..count - 1] {
            match better_place(bvh, candidate.node as usize, &mut stack, work) {
                Some(found) if found.gain > 0.0 => moves.push(found),
                Some(_) => {}
                None => {
                    exhausted = true;
                    break;
                }
            }
        }
        moves.sort_unstable_by(|a: &Move, b: &Move| b.gain.total_cmp(&a.gain));
        touched.fill(false);
        for found in moves {
            let (from, to) = (found.from as usize, found.to as usize);
            let parents = [to, from].map(|n| bvh.parents[n] as usize);
            let nodes = [to, from, Bvh2Node::get_sibling_id(from), parents[0], parents[1]];
            if nodes.iter().any(|&n| touched[n]) {
                continue;
            }
            nodes.iter().for_each(|&n| touched[n] = true);
            reinsert_node(bvh, from, to);
        }
        if exhausted {
            break;
        }
    }
    levels(bvh) <= DEEPEST
}

/// Levels of the tree, the root's included, counted up to two more than [`DEEPEST`].
fn levels(bvh: &Bvh2) -> usize {
    let (mut level, mut below, mut levels) = (vec![0u32], Vec::new(), 0);
    while !level.is_empty() && levels <= DEEPEST + 1 {
        let inner = level.iter().map(|&n| &bvh.nodes[n as usize]).filter(|n| !n.is_leaf());
        below.extend(inner.flat_map(|n| [n.first_index, n.first_index + 1]));
        std::mem::swap(&mut level, &mut below);
        below.clear();
        levels += 1;
    }
    levels
}

/// Where `node` would make the tree's boxes smaller by most; a gain of 0 where it is well placed. `None` when the work is used up.
fn better_place(bvh: &Bvh2, node: usize, stack: &mut Vec<(f32, u32)>, work: &mut WorkLeft) -> Option<Move> {
    let area = |n: usize| bvh.nodes[n].aabb().half_area();
    let own = bvh.nodes[node].aabb();
    let own_area = area(node);
    let parent = bvh.parents[node] as usize;
    let mut best = Move { from: node as u32, to: 0, gain: 0.0 };
    let mut gain = area(parent);
    let mut sibling = Bvh2Node::get_sibling_id(node);
    let mut without = *bvh.nodes[sibling].aabb();
    let mut pivot = parent;
    loop {
        stack.clear();
        stack.push((gain, sibling as u32));
        while let Some((gain, place)) = stack.pop() {
            if !work.take(1) {
                return None;
            }
            if gain - own_area <= best.gain {
                continue;
            }
            let there = &bvh.nodes[place as usize];
            let rest = gain - there.aabb().union(own).half_area();
            if rest > best.gain {
                best = Move { to: place, gain: rest, ..best };
            }
            if !there.is_leaf() {
                let below = rest + there.aabb().half_area();
                // What is below may gain no more than this; most of what would be stacked is left out here.
                if below - own_area > best.gain {
                    stack.push((below, there.first_index));
                    stack.push((below, there.first_index + 1));
                }
            }
        }
        if pivot != parent {
            without = without.union(bvh.nodes[sibling].aabb());
            gain += area(pivot) - without.half_area();
        }
        if pivot == 0 {
            break;
        }
        sibling = Bvh2Node::get_sibling_id(pivot);
        pivot = bvh.parents[pivot] as usize;
    }
    if best.to as usize == Bvh2Node::get_sibling_id(node) || best.to as usize == parent {
        best.gain = 0.0;
    }
    Some(best)
}

#[cfg(test)]
mod tests {
    use super::super::{boxes_of, BodyBvh};
    use super::*;
    use crate::shapes::sphere;
    use crate::{builtin, TriangleMesh};
    use obvhs::bvh2::reinsertion::ReinsertionOptimizer;
    use obvhs::ploc::PlocBuilder;
    use obvhs::BvhBuildParams;
    use std::time::{Duration, Instant};

    /// The tree that the crate builds.
    fn by_the_crate(boxes: &[Aabb], share: f32) -> Bvh2 {
        let parameters = BvhBuildParams::very_slow_build();
        let order = (0..boxes.len() as u32).collect();
        let mut bvh = PlocBuilder::with_capacity(boxes.len()).build(
            parameters.ploc_search_distance,
            boxes,
            order,
            parameters.sort_precision,
            parameters.search_depth_threshold,
        );
        ReinsertionOptimizer::default().run(&mut bvh, share, None);
        bvh
    }

    /// Everything that the tree is, as numbers that are equal only when it is the same tree.
    fn bits(bvh: &Bvh2) -> Vec<[u32; 8]> {
        let node = |n: &Bvh2Node| {
            let (low, high) = (n.aabb().min, n.aabb().max);
            let [a, b, c] = [low.x, low.y, low.z].map(f32::to_bits);
            let [d, e, f] = [high.x, high.y, high.z].map(f32::to_bits);
            [a, b, c, d, e, f, n.prim_count, n.first_index]
        };
        bvh.nodes.iter().map(node).collect()
    }

    fn own(boxes: &[Aabb], share: f32) -> Bvh2 {
        let mut tree = clustered(boxes);
        let most = WorkLeft::of_reinsertion(boxes.len());
        let mut left = most;
        optimise(&mut tree, share, &mut left);
        let used = (most.0 - left.0) as f64 / boxes.len() as f64;
        println!("reinsertion looked at {used:.0} nodes for each of {} boxes", boxes.len());
        tree
    }

    /// Boxes that share a corner and grow: each lies in the next, so only the two smallest ever agree to be joined.
    fn nested(count: usize) -> Vec<Aabb> {
        (0..count).map(|k| Aabb::new(Vec3A::ZERO, Vec3A::splat(1.0 + k as f32 / count as f32))).collect()
    }

    fn twins(count: usize) -> Vec<Aabb> {
        vec![Aabb::new(Vec3A::ZERO, Vec3A::new(1.0, 1.0, 0.0)); count]
    }

    /// Small boxes spread through many that overlap: a better place may be anywhere.
    fn overlapping(count: usize) -> Vec<Aabb> {
        let spread = |k: usize, prime: usize| ((k * prime) % 10_007) as f32 / 10_007.0;
        (0..count)
            .map(|k| {
                let low = Vec3A::new(spread(k, 7919), spread(k, 104_729), spread(k, 1_299_709));
                Aabb::new(low, low + Vec3A::splat(if k % 2 == 0 { 1e-3 } else { 0.7 }))
            })
            .collect()
    }

    /// What ordinary meshes get is what the crate builds, to the bit; quads, whose halves have the same box, included.
    #[test]
    fn ordinary_meshes_get_the_tree_of_the_crate() {
        let mut meshes: Vec<(String, TriangleMesh)> =
            builtin().bodies.into_iter().map(|b| (b.name, b.mesh)).collect();
        meshes.push(("sphere".into(), sphere(glam::Vec3::ZERO, 1.0, 5, true)));
        for (name, mesh) in &meshes {
            let boxes = boxes_of(mesh);
            let share = BodyBvh::share(boxes.len());
            assert_eq!(bits(&clustered(&boxes)), bits(&by_the_crate(&boxes, 0.0)), "{name}: clustering");
            assert_eq!(bits(&own(&boxes, share)), bits(&by_the_crate(&boxes, share)), "{name}");
        }
        for count in [1, 2, 3, 4, 9, 100] {
            for boxes in [twins(count), nested(count), overlapping(count)] {
                assert_eq!(bits(&own(&boxes, 1.0)), bits(&by_the_crate(&boxes, 1.0)), "{count}");
            }
        }
    }

    /// Every box stands in exactly one leaf, inside all nodes above it.
    fn check_tree(boxes: &[Aabb], bvh: &Bvh2) -> usize {
        let mut seen = vec![false; boxes.len()];
        let mut open = vec![(0usize, 1usize)];
        let mut depth = 0;
        while let Some((index, level)) = open.pop() {
            depth = depth.max(level);
            let node = &bvh.nodes[index];
            if node.is_leaf() {
                let place = bvh.primitive_indices[node.first_index as usize] as usize;
                assert!(!std::mem::replace(&mut seen[place], true));
                assert_eq!((node.aabb().min, node.aabb().max), (boxes[place].min, boxes[place].max));
                continue;
            }
            for child in [node.first_index, node.first_index + 1] {
                let inner = bvh.nodes[child as usize].aabb();
                assert!(inner.min.cmpge(node.aabb().min).all() && inner.max.cmple(node.aabb().max).all());
                open.push((child as usize, level + 1));
            }
        }
        assert!(seen.iter().all(|s| *s));
        depth
    }

    /// Hundreds of thousands of boxes.
    mod breadth {
        use super::*;

        /// Found in use, R10: coincident triangles made the time grow with the square of their number (100,000 of them: five minutes), and so do boxes
        /// one inside the other, and boxes that overlap without end. The bound is generous: the machine may be busy, and the square would take
        /// minutes.
        #[test]
        fn no_arrangement_of_boxes_takes_the_square_of_its_number() {
            for (name, boxes) in [
                ("twins", twins(200_000)),
                (
                    "groups",
                    (0..100_000)
                        .flat_map(|k| {
                            twins(2).into_iter().map(move |b| {
                                let shift = Vec3A::X * (k % 10) as f32;
                                Aabb::new(b.min + shift, b.max + shift)
                            })
                        })
                        .collect(),
                ),
                ("nested", nested(100_000)),
                ("overlapping", overlapping(60_000)),
            ] {
                let start = Instant::now();
                let tree = own(&boxes, BodyBvh::share(boxes.len()));
                let depth = check_tree(&boxes, &tree);
                println!("{name}: {} boxes, {depth} levels, {:?}", boxes.len(), start.elapsed());
                assert!(start.elapsed() < Duration::from_secs(120), "{name}: {:?}", start.elapsed());
                let levels = BodyBvh::of_boxes(&boxes).levels();
                assert!(levels <= 25, "{name}: {levels} of the wide tree");
            }
        }
    }
}
