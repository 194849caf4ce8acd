//! Meshes that an animation deforms. Each is a body of its own, which lies as what carries it does: joints lie in the space of
//! the tracked body, or of the world.

use std::collections::HashMap;

use glam::DAffine3;
use gltf::json::mesh::Semantic;
use gltf::json::validation::Checked;

use super::super::super::deforming::{MorphTarget, NodePlace, Skeleton, SkeletonNode};
use super::super::super::mesh::DropCounts;
use super::super::super::part_motion::ValueTrack;
use super::super::super::{DeformingMesh, SceneError, TriangleMesh};
use super::super::deform::{Pose, Skin};
use super::{decomposed, local_transform, Gatherer, Group, Source};

/// Most meshes that may deform.
const MOST_MESHES: usize = 32;
/// Most vertices of all of them: they are moved on the host in every frame.
const MOST_VERTICES: usize = 100_000;
/// Most nodes of which the joints of a mesh may be made.
const MOST_NODES: usize = 1024;

/// Why a mesh does not deform.
type Reason = &'static str;
/// Primitives by their numbers, with what was left out of them.
type Pieces = Vec<(usize, (TriangleMesh, DropCounts))>;

impl Gatherer<'_> {
    /// The meshes without skins that deform.
    pub(super) fn add_unskinned_meshes(&mut self, warnings: &mut Vec<String>) -> Result<(), SceneError> {
        for (index, group) in std::mem::take(&mut self.unskinned) {
            self.cancel.check(self.limits)?;
            let Some(node) = self.source.document.nodes().nth(index) else { continue };
            let Some(mesh) = node.mesh().map(|mesh| mesh.index()) else { continue };
            let name = node.name().unwrap_or("");
            let Err(why) = self.add_deforming((mesh, index), group, None)? else { continue };
            warnings.push(format!("node {index} '{name}': it is shown in its shape at rest, because {why}"));
            let Some(&(group, place)) = self.places.get(&index) else { continue };
            if super::is_invertible(&place) {
                self.add_mesh((mesh, index), group, &place, None)?;
            } else {
                warnings.push(format!("node {index} '{name}' is scaled to nothing and is left out"));
            }
        }
        Ok(())
    }

    /// A mesh that deforms, as a body of its own; or why it cannot.
    ///
    /// # Errors
    /// The file is broken.
    pub(super) fn add_deforming(
        &mut self,
        (mesh, node): (usize, usize),
        group: Group,
        skin: Option<&Skin>,
    ) -> Result<Result<(), Reason>, SceneError> {
        let Source { document, data, instances, animation, deformations, .. } = *self.source;
        if instances.contains_key(&node) {
            return Ok(Err("its node has instances"));
        }
        if self.deforming.len() >= MOST_MESHES {
            return Ok(Err("more than 32 meshes deform"));
        }
        let skeleton = match self.skeleton(node, group.claim, skin) {
            Ok(skeleton) => skeleton,
            Err(why) => return Ok(Err(why)),
        };
        let Some(pieces) = self.bind_pose((mesh, node))? else {
            return Ok(Err("all that deforms together has more than 100,000 vertices"));
        };
        let mut deforming = DeformingMesh::new(skeleton, animation.length_s, animation.period_ns);
        let mut whole = TriangleMesh::default();
        for (number, (piece, lost)) in &pieces {
            self.dropped.add(*lost);
            let attributes = &document.as_json().meshes[mesh].primitives[*number].attributes;
            let is_flat = !attributes.contains_key(&Checked::Valid(Semantic::Normals));
            deforming.bind(piece, is_flat, |vertex| {
                let joints = skin.map(|_| deformations.joints_of((mesh, *number), data, vertex));
                joints.into_iter().flatten()
            });
            whole.append_transformed(piece, &DAffine3::IDENTITY);
        }
        for (target, weight) in self.weights(node, mesh).into_iter().enumerate() {
            let (mut moves, mut first) = (vec![], 0);
            for (number, (piece, _)) in &pieces {
                let of_piece = deformations.moves_of((mesh, *number), target, data, &piece.sources);
                moves.extend(of_piece.into_iter().map(|(place, moved)| ((first + place) as u32, moved)));
                first += piece.sources.len();
            }
            if !moves.is_empty() {
                deforming.add_target(MorphTarget { weight, moves });
            }
        }
        deforming.finish(&mut whole);
        whole.sources = vec![];
        let name = document.nodes().nth(node).and_then(|n| n.name().map(str::to_owned));
        self.deforming.push((name.unwrap_or_else(|| format!("node {node}")), deforming));
        let own = Group { part: None, deforming: Some(self.deforming.len() - 1), ..group };
        self.meshes.insert(own, whole);
        Ok(Ok(()))
    }

    /// The primitives of a mesh by their numbers, as the file has them; `None` if they are too many vertices.
    fn bind_pose(&mut self, (mesh, node): (usize, usize)) -> Result<Option<Pieces>, SceneError> {
        let mut vertices: usize = self.deforming.iter().map(|(_, deforming)| deforming.len()).sum();
        let mut pieces = vec![];
        for number in 0..self.source.document.as_json().meshes[mesh].primitives.len() {
            let Some(piece) = self.read((mesh, node, number), Some(Pose::Bind))? else { continue };
            vertices += piece.0.positions.len();
            if vertices > MOST_VERTICES {
                return Ok(None);
            }
            pieces.push((number, piece));
        }
        Ok(Some(pieces))
    }

    /// How much each morph target of a mesh counts at a node.
    fn weights(&self, node: usize, mesh: usize) -> Vec<ValueTrack<f64>> {
        let animated = self.source.animation.nodes.get(&node).and_then(|channels| channels.weights.clone());
        let at_rest =
            || self.source.deformations.weights(node, mesh).iter().map(|w| ValueTrack::Constant(*w));
        animated.unwrap_or_else(|| at_rest().collect())
    }

    /// The joints of `skin`, or the one of a mesh without: the node `node` itself.
    fn skeleton(&self, node: usize, claim: Option<usize>, skin: Option<&Skin>) -> Result<Skeleton, Reason> {
        let mut skeleton = Skeleton::default();
        let mut known = HashMap::new();
        let own = [node];
        let (joints, binds) = skin.map_or((&own[..], &[][..]), |skin| (&skin.joints[..], &skin.bind[..]));
        for (i, joint) in joints.iter().enumerate() {
            let at = self.hang(*joint, claim, &mut skeleton.nodes, &mut known)?;
            skeleton.joints.push((at, binds.get(i).copied().unwrap_or(DAffine3::IDENTITY)));
        }
        Ok(skeleton)
    }

    /// Adds a node and those above it, up to the body of `claim`, or to the world. Returns its place among `nodes`.
    fn hang(
        &self,
        node: usize,
        claim: Option<usize>,
        nodes: &mut Vec<SkeletonNode>,
        known: &mut HashMap<usize, usize>,
    ) -> Result<usize, Reason> {
        let mut chain = vec![];
        let mut next = Some(node);
        let mut above = loop {
            let Some(at) = next else {
                // Files often have the joints beside the node that shows the skin. They move against the body at rest.
                let body_from_world = claim.map_or(DAffine3::IDENTITY, |c| self.rest[c].inverse());
                nodes.push(SkeletonNode {
                    above: None,
                    place: NodePlace::Fixed(body_from_world * self.source.world),
                });
                break nodes.len() - 1;
            };
            if let Some(&place) = known.get(&at) {
                break place;
            }
            if let Some(&c) = self.at_rest.claim_of.get(&at) {
                if claim != Some(c) {
                    return Err("a joint lies in another body");
                }
                let body_from_node = self.rest[c].inverse() * self.at_rest.world_from_node[at];
                nodes.push(SkeletonNode { above: None, place: NodePlace::Fixed(body_from_node) });
                known.insert(at, nodes.len() - 1);
                break nodes.len() - 1;
            }
            chain.push(at);
            next = self.at_rest.above[at];
        };
        if nodes.len() + chain.len() > MOST_NODES {
            return Err("its joints are made of more than 1,024 nodes");
        }
        for at in chain.into_iter().rev() {
            nodes.push(SkeletonNode { above: Some(above), place: self.place_of(at) });
            above = nodes.len() - 1;
            known.insert(at, above);
        }
        Ok(above)
    }

    /// Where a node lies in the one above it.
    fn place_of(&self, index: usize) -> NodePlace {
        let Source { document, animation, .. } = *self.source;
        let Some(node) = document.nodes().nth(index) else { return NodePlace::Fixed(DAffine3::IDENTITY) };
        let channels = animation.nodes.get(&index);
        match channels.filter(|c| c.moves() || c.resizes()).zip(decomposed(&node)) {
            Some((channels, (translation, rotation, scale))) => NodePlace::Moving {
                translation: channels.translation.clone().unwrap_or(ValueTrack::Constant(translation)),
                rotation: channels.rotation.clone().unwrap_or(ValueTrack::Constant(rotation)),
                scale: channels.scale.clone().unwrap_or(ValueTrack::Constant(scale)),
            },
            None => NodePlace::Fixed(local_transform(&node, channels)),
        }
    }

    /// Says which meshes deform.
    pub(super) fn tell_of_deforming(&self, warnings: &mut Vec<String>) {
        if self.deforming.is_empty() {
            return;
        }
        let vertices: usize = self.deforming.iter().map(|(_, deforming)| deforming.len()).sum();
        warnings.push(format!(
            "{} deforms {} meshes, {vertices} vertices together, in every frame",
            self.source.animation.name,
            self.deforming.len()
        ));
    }
}
