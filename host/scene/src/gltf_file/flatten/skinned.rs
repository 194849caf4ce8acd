//! Meshes with skins: where their joints are at rest, or as rigid pieces in the parts that move with the joints.

use std::collections::{BTreeMap, HashMap};

use glam::DAffine3;

use super::super::super::SceneError;
use super::super::animation::Channels;
use super::super::deform::{Piece, Pose, Skin};
use super::{local_transform, Gatherer, Group, Source, MAX_PARTS};

/// All nodes while nothing plays.
#[derive(Default)]
pub(super) struct AtRest {
    pub(super) world_from_node: Vec<DAffine3>,
    /// The node above each.
    pub(super) above: Vec<Option<usize>>,
    /// The body that a node begins.
    pub(super) claim_of: HashMap<usize, usize>,
    /// Whether an animation moves it in the space of its body, or changes its size.
    moves: Vec<bool>,
}

impl AtRest {
    pub(super) fn of(source: &Source<'_>, claim_of: &HashMap<usize, usize>) -> Self {
        let nodes: Vec<gltf::Node> = source.document.nodes().collect();
        let mut above = vec![None; nodes.len()];
        for (i, node) in nodes.iter().enumerate() {
            node.children().for_each(|child| above[child.index()] = Some(i));
        }
        let mut walk: Vec<(usize, DAffine3, bool)> =
            (0..nodes.len()).filter(|i| above[*i].is_none()).map(|i| (i, source.world, false)).collect();
        let mut all = Self {
            world_from_node: vec![source.world; nodes.len()],
            above,
            claim_of: claim_of.clone(),
            moves: vec![false; nodes.len()],
        };
        while let Some((i, above, above_moves)) = walk.pop() {
            let channels = source.animation.nodes.get(&i);
            let world = above * local_transform(&nodes[i], channels);
            // The tracker moves a body, and what is above it does not.
            let changes = |channels: &Channels| channels.moves() || channels.resizes();
            let moves = !claim_of.contains_key(&i) && (above_moves || channels.is_some_and(changes));
            (all.world_from_node[i], all.moves[i]) = (world, moves);
            walk.extend(nodes[i].children().map(|child| (child.index(), world, moves)));
        }
        all
    }
}

impl Gatherer<'_> {
    /// The meshes with skins, where the joints are. These and not the nodes say where a mesh is.
    pub(super) fn add_skinned_meshes(&mut self, warnings: &mut Vec<String>) -> Result<(), SceneError> {
        let Source { document, data, deformations, .. } = *self.source;
        for (index, group) in std::mem::take(&mut self.skinned) {
            let Some(node) = document.nodes().nth(index) else { continue };
            let Some(mesh) = node.mesh().map(|mesh| mesh.index()) else { continue };
            let Some(skin) = deformations.skin(index, mesh) else { continue };
            let morphs = self.source.animation.nodes.get(&index).is_some_and(Channels::morphs)
                && deformations.has_targets(mesh);
            if morphs || skin.joints.iter().any(|joint| self.at_rest.moves[*joint]) {
                let of_file = &document.as_json().meshes[mesh].primitives;
                self.cancel.check(self.limits)?;
                let pieces = if morphs || self.resizes(skin) {
                    None
                } else {
                    deformations.rigid_pieces(mesh, of_file, data, MAX_PARTS)?
                };
                if self.add_pieces((mesh, index), group, skin, pieces.as_ref())? {
                    continue;
                }
                match self.add_deforming((mesh, index), group, Some(skin))? {
                    Ok(()) => continue,
                    Err(why) => warnings.push(format!(
                        "node {index} '{}': its skin is shown as its joints lie at rest, because {why}",
                        node.name().unwrap_or("")
                    )),
                }
            }
            let group = Group { part: None, ..group };
            let body_from_world = group.claim.map_or(DAffine3::IDENTITY, |c| self.rest[c].inverse());
            let pose = skin.pose(&body_from_world, &self.at_rest.world_from_node);
            self.add_mesh((mesh, index), group, &DAffine3::IDENTITY, Some(Pose::All(&pose)))?;
        }
        Ok(())
    }

    /// True if the size of a joint, or of what is above it, changes.
    fn resizes(&self, skin: &Skin) -> bool {
        let channels = |node: usize| self.source.animation.nodes.get(&node);
        let mut chains = skin
            .joints
            .iter()
            .flat_map(|joint| std::iter::successors(Some(*joint), |node| self.at_rest.above[*node]));
        self.source.animation.deforms() && chains.any(|node| channels(node).is_some_and(Channels::resizes))
    }

    /// The rigid pieces of a skin, each in the part that its joint moves with. False if there are none, or if a piece belongs to
    /// another body than the node that shows the skin.
    fn add_pieces(
        &mut self,
        (mesh, node): (usize, usize),
        group: Group,
        skin: &Skin,
        pieces: Option<&BTreeMap<usize, Piece>>,
    ) -> Result<bool, SceneError> {
        let place = |(joint, piece): (&usize, _)| {
            let (of_joint, place) = self.places.get(skin.joints.get(*joint)?)?;
            let of_piece = Group { part: of_joint.part, ..group };
            (of_joint.claim == group.claim).then(|| (of_piece, piece, *place * skin.bind[*joint]))
        };
        let placed: Option<Vec<(Group, &Piece, DAffine3)>> =
            pieces.and_then(|pieces| pieces.iter().map(place).collect());
        let Some(placed) = placed else { return Ok(false) };
        for (of_piece, piece, map) in placed {
            for (number, faces) in piece {
                let pose = Some(Pose::One(faces, map));
                self.add_primitive((mesh, node, *number), of_piece, &DAffine3::IDENTITY, pose)?;
            }
        }
        Ok(true)
    }
}
