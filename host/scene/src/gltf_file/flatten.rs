//! Flattens the node tree into rigid bodies: nodes that a body of the rig file claims move with it, all others are
//! static. What an animation moves is a part, a body of its own with the same carrier.

mod claims;
mod deforming;
mod skinned;

use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::Arc;

use glam::{DAffine3, DMat3, DMat4, DVec3, Vec3};

use super::super::limits::Cancel;
use super::super::mesh::{DropCounts, MAX_COORDINATE_M};
use super::super::part_motion::{NodeMotion, PartLink, PartMotion, ValueTrack};
use super::super::{
    Body, DeformingMesh, Limits, LoadOptions, PunctualKind, PunctualLight, SceneError, TriangleMesh,
};
use super::accessor::Data;
use super::animation::{Animation, Channels};
use super::deform::{Deformations, Pose};
use super::instancing::Instances;
use super::look::SceneLook;
use super::primitive::read_primitive;
use super::vertex_paint::Paint;
use claims::roots;
pub(crate) use claims::{choose_bodies, hidden, Claims, VISIBILITY};
use skinned::AtRest;

/// Most parts that an animation may move.
const MAX_PARTS: usize = 128;
/// Why a node is no rigid part.
const UNEVEN: &str = "a node above it is scaled unevenly";
/// Most places of which that of a part may be the product: it is worked out three times for every frame.
const MAX_LINKS: usize = 48;

/// The body that a node belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Group {
    /// Index of the selector, if one claims it.
    claim: Option<usize>,
    /// It exists only in the virtual world.
    is_virtual: bool,
    /// Index of the part, if an animation moves it.
    part: Option<usize>,
    /// Index of the mesh that an animation deforms, if it is one.
    deforming: Option<usize>,
}

impl Group {
    /// What stays of a body, or of what does not move, when parts and meshes that deform are taken away.
    fn is_whole(self) -> bool {
        self.part.is_none() && self.deforming.is_none()
    }
}

/// A subtree still to be walked.
#[derive(Clone, Copy)]
struct Subtree {
    node: usize,
    /// World-from-parent at rest.
    world: DAffine3,
    /// Part-from-parent, if the parent belongs to a part.
    place: DAffine3,
    group: Group,
    /// The size of a node above it changes.
    resizes: bool,
}

/// Nodes that an animation moves with all below them, up to the next such node.
struct MovingSubtree {
    name: String,
    /// From the carrier to the part.
    links: Vec<Arc<PartLink>>,
}

/// The result of [`flatten`].
pub(crate) struct Flat {
    /// In the order of the selectors, fixed things last.
    pub bodies: Vec<Body>,
    /// All lights of the file that a scene uses.
    pub lights: Vec<PunctualLight>,
}

/// A checked document and its decoded parts.
pub(super) struct Source<'a> {
    /// Nodes and meshes.
    pub document: &'a gltf::Document,
    /// Buffers.
    pub data: &'a Data,
    /// Materials and textures.
    pub look: &'a SceneLook,
    /// The places of the meshes of instanced nodes.
    pub instances: &'a Instances,
    /// How nodes move.
    pub animation: &'a Animation,
    /// Morph targets and skins.
    pub deformations: &'a Deformations,
    /// Nodes that are not shown.
    pub hidden: &'a HashSet<usize>,
    /// The world's unit and axes from those of the file.
    pub world: DAffine3,
}

/// What the options say about unit and upward axis.
pub(super) fn world_from_file(options: &LoadOptions) -> DAffine3 {
    let scale = options.scale.unwrap_or(1.0);
    DAffine3::from_mat3(options.up.unwrap_or_default().to_world() * DMat3::from_diagonal(DVec3::splat(scale)))
}

/// Walks the tree and gathers geometry and lights by body.
pub(super) fn flatten(
    source: &Source<'_>,
    claims: &Claims,
    limits: &Limits,
    cancel: &Cancel,
    warnings: &mut Vec<String>,
) -> Result<(Flat, Paint), SceneError> {
    let told = warnings.len();
    let still = Animation::default();
    let unmoved = Source { animation: &still, ..*source };
    let mut gatherer = Gatherer::new(source, claims, limits, cancel);
    gatherer.walk(warnings)?;
    let parts = gatherer.moving_parts();
    if parts > MAX_PARTS {
        warnings.truncate(told);
        warnings.push(format!(
            "{} moves {parts} parts, and at most {MAX_PARTS} can move: all are shown at rest",
            source.animation.name
        ));
        gatherer = Gatherer::new(&unmoved, claims, limits, cancel);
        gatherer.walk(warnings)?;
    } else if parts > 0 {
        warnings.push(format!(
            "{} plays over and over, {:.2} s a round: {parts} parts of the scene move",
            source.animation.name,
            source.animation.period_ns as f64 * 1e-9
        ));
    }
    gatherer.tell_of_deforming(warnings);
    let paint = std::mem::take(&mut gatherer.paint);
    paint.warn(source.look, warnings);
    Ok((gatherer.into_flat(warnings)?, paint))
}

/// What is gathered on the walk through the tree.
struct Gatherer<'a> {
    source: &'a Source<'a>,
    claims: &'a Claims,
    limits: &'a Limits,
    cancel: &'a Cancel,
    at_rest: AtRest,
    /// Of each node: the body that it belongs to, and its place there.
    places: HashMap<usize, (Group, DAffine3)>,
    /// Nodes that show a skin, whose joints may be anywhere.
    skinned: Vec<(usize, Group)>,
    /// By claim: world-from-body at rest.
    rest: Vec<DAffine3>,
    parts: Vec<MovingSubtree>,
    /// Meshes that an animation deforms, with the names of their nodes.
    deforming: Vec<(String, DeformingMesh)>,
    /// Nodes that show such a mesh without a skin.
    unskinned: Vec<(usize, Group)>,
    meshes: BTreeMap<Group, TriangleMesh>,
    lights: Vec<(Group, PunctualLight)>,
    dropped: DropCounts,
    paint: Paint,
}

impl<'a> Gatherer<'a> {
    fn new(source: &'a Source<'a>, claims: &'a Claims, limits: &'a Limits, cancel: &'a Cancel) -> Self {
        Self {
            source,
            claims,
            limits,
            cancel,
            at_rest: AtRest::default(),
            places: HashMap::new(),
            skinned: vec![],
            rest: vec![DAffine3::IDENTITY; claims.bodies.len()],
            parts: vec![],
            deforming: vec![],
            unskinned: vec![],
            meshes: BTreeMap::new(),
            lights: vec![],
            dropped: DropCounts::default(),
            paint: Paint::new(source.look, limits),
        }
    }

    /// Parts that hold triangles.
    fn moving_parts(&self) -> usize {
        self.meshes.iter().filter(|(group, mesh)| group.part.is_some() && !mesh.triangles.is_empty()).count()
    }

    fn walk(&mut self, warnings: &mut Vec<String>) -> Result<(), SceneError> {
        let claims = self.claims;
        let claim_of: HashMap<usize, usize> =
            claims.bodies.iter().enumerate().map(|(c, b)| (b.node, c)).collect();
        let document = self.source.document;
        self.at_rest = AtRest::of(self.source, &claim_of);
        let world = self.source.world;
        let away = self.far_offset(&claim_of);
        if away != DVec3::ZERO {
            warnings.push(format!(
                "its bodies lie {:.0} km from the origin: all are moved by as much, which puts body '{}' there",
                1e-3 * away.length(),
                claims.bodies[0].name
            ));
        }
        let world = DAffine3::from_translation(-away) * world;
        let group = Group { claim: None, is_virtual: false, part: None, deforming: None };
        let mut walk: Vec<Subtree> = roots(document)
            .into_iter()
            .rev()
            .map(|node| Subtree { node, world, place: world, group, resizes: false })
            .collect();
        while let Some(step) = walk.pop() {
            self.cancel.check(self.limits)?;
            let Some(node) = document.nodes().nth(step.node) else { continue };
            if self.source.hidden.contains(&step.node) {
                continue;
            }
            let step = self.enter(step, &node, claim_of.get(&step.node).copied(), warnings)?;
            self.add_node(&step, &node, warnings)?;
            walk.extend(node.children().map(|c| Subtree { node: c.index(), ..step }));
        }
        self.add_skinned_meshes(warnings)?;
        self.add_unskinned_meshes(warnings)
    }

    /// From the step that leads to `node`, which is `claim`'s body if any, the one that stands at it: its places, and the group
    /// of what it holds.
    fn enter(
        &mut self,
        step: Subtree,
        node: &gltf::Node,
        claim: Option<usize>,
        warnings: &mut Vec<String>,
    ) -> Result<Subtree, SceneError> {
        let Subtree { node: index, world, place, mut group, mut resizes } = step;
        let claims = self.claims;
        let channels = self.source.animation.nodes.get(&index);
        let local = local_transform(node, channels);
        let above = self.place_at(group, &world, &place);
        let world = world * local;
        let mut place = place * local;
        let name = node.name().unwrap_or("");
        if let Some(c) = claim {
            group = Group {
                claim: Some(c),
                is_virtual: !claims.bodies[c].projected,
                part: None,
                deforming: None,
            };
            resizes = false;
            self.rest[c] = self.rest_of(c, &world)?;
            if channels.is_some_and(Channels::moves) {
                warnings.push(format!(
                    "node {index} '{name}': its own motion is not played: the tracker moves body '{}'",
                    claims.bodies[c].name
                ));
            }
        } else if let Some(channels) = channels.filter(|channels| channels.moves() || channels.resizes()) {
            resizes |= channels.resizes();
            match self.part(node, channels, &above, group) {
                Ok((part, scale)) => (group.part, place) = (Some(part), scale),
                // Nothing rigid moves so, but a mesh that deforms does.
                Err(UNEVEN) => resizes = true,
                Err(why) => {
                    warnings.push(format!("node {index} '{name}': its motion is not played, because {why}"))
                }
            }
        }
        let place = self.place_at(group, &world, &place);
        group.is_virtual |= claims.virtual_nodes.binary_search(&index).is_ok();
        Ok(Subtree { node: index, world, place, group, resizes })
    }

    /// Adds the mesh and the lamp of the node at which a step stands.
    fn add_node(
        &mut self,
        step: &Subtree,
        node: &gltf::Node,
        warnings: &mut Vec<String>,
    ) -> Result<(), SceneError> {
        let Subtree { node: index, ref place, group, resizes, .. } = *step;
        if let Some(mesh) = node.mesh() {
            let deformations = &self.source.deformations;
            let channels = self.source.animation.nodes.get(&index);
            let morphs = channels.is_some_and(Channels::morphs) && deformations.has_targets(mesh.index());
            if deformations.skin(index, mesh.index()).is_some() {
                self.skinned.push((index, group));
            } else if resizes || morphs {
                self.unskinned.push((index, group));
            } else if is_invertible(place) {
                self.add_mesh((mesh.index(), index), group, place, None)?;
            } else {
                let name = node.name().unwrap_or("");
                warnings.push(format!("node {index} '{name}' is scaled to nothing and is left out"));
            }
        }
        self.places.insert(index, (group, *place));
        if let Some(light) = node.light() {
            self.lights.extend(place_light(&light, place).map(|l| (group, l)));
        }
        Ok(())
    }

    /// The place of a node in the space of its body or part. `world` is its place at rest, `in_part` that in its part.
    fn place_at(&self, group: Group, world: &DAffine3, in_part: &DAffine3) -> DAffine3 {
        match group {
            Group { part: Some(_), .. } => *in_part,
            Group { claim: Some(c), .. } => self.rest[c].inverse() * *world,
            Group { claim: None, .. } => *world,
        }
    }

    /// Where the first body's node lies, if no room reaches as far: a place on the globe. Zero for a scene with skins, whose joints
    /// may stand anywhere.
    fn far_offset(&self, claim_of: &HashMap<usize, usize>) -> DVec3 {
        let document = self.source.document;
        let has_skin = |node: gltf::Node| {
            node.mesh()
                .is_some_and(|mesh| self.source.deformations.skin(node.index(), mesh.index()).is_some())
        };
        if document.nodes().any(has_skin) {
            return DVec3::ZERO;
        }
        let mut walk: Vec<(usize, DAffine3)> =
            roots(document).into_iter().map(|node| (node, self.source.world)).collect();
        while let Some((index, world)) = walk.pop() {
            let Some(node) = document.nodes().nth(index) else { continue };
            let world = world * local_transform(&node, self.source.animation.nodes.get(&index));
            if claim_of.get(&index) == Some(&0) {
                let at = world.translation;
                let is_far = at.is_finite() && at.abs().max_element() >= f64::from(MAX_COORDINATE_M);
                return if is_far { at } else { DVec3::ZERO };
            }
            walk.extend(node.children().map(|child| (child.index(), world)));
        }
        DVec3::ZERO
    }

    /// World-from-body at rest of claim `c`, whose node is at `world`.
    fn rest_of(&self, c: usize, world: &DAffine3) -> Result<DAffine3, SceneError> {
        // The body's own axes are turned with the file's: without its node's transform the body lies as the world does.
        let turned = *world * self.source.world.inverse();
        rigid_part(&turned).ok_or_else(|| {
            SceneError::broken(
                format!("body '{}'", self.claims.bodies[c].name),
                "its node has a scale of zero or a position beyond any room",
            )
        })
    }

    /// A part for a node that moves, and the place of the node in it, which is its scale. `parent`: the place of its parent
    /// in the body or part above.
    ///
    /// # Errors
    /// Why it does not move: what is above it does not keep angles, so that it would not be rigid, or too much is above it.
    fn part(
        &mut self,
        node: &gltf::Node,
        channels: &Channels,
        parent: &DAffine3,
        above: Group,
    ) -> Result<(usize, DAffine3), &'static str> {
        let (rigid, scale) = even_part(parent).ok_or(UNEVEN)?;
        let (translation, rotation, own_scale) = decomposed(node).ok_or("it has a matrix")?;
        let mut links = above.part.map_or_else(Vec::new, |p| self.parts[p].links.clone());
        if links.len() + 2 > MAX_LINKS {
            return Err("too many nodes above it move");
        }
        if rigid != DAffine3::IDENTITY {
            links.push(Arc::new(PartLink::Fixed(rigid)));
        }
        let mut motion = NodeMotion {
            translation: channels.translation.clone().unwrap_or(ValueTrack::Constant(translation)),
            rotation: channels.rotation.clone().unwrap_or(ValueTrack::Constant(rotation)),
        };
        match &mut motion.translation {
            ValueTrack::Constant(at) => *at *= scale,
            ValueTrack::Keys(keys) => keys.values.iter_mut().for_each(|at| *at *= scale),
        }
        links.push(Arc::new(PartLink::Node(motion)));
        let name = node.name().map_or_else(|| format!("node {}", node.index()), str::to_owned);
        self.parts.push(MovingSubtree { name, links });
        Ok((self.parts.len() - 1, DAffine3::from_scale(own_scale * scale)))
    }

    /// All primitives of a mesh of a node. `pose` is that of its skin.
    fn add_mesh(
        &mut self,
        (mesh, node): (usize, usize),
        group: Group,
        body_from_node: &DAffine3,
        pose: Option<Pose<'_>>,
    ) -> Result<(), SceneError> {
        let count = self.source.document.as_json().meshes[mesh].primitives.len();
        (0..count)
            .try_for_each(|number| self.add_primitive((mesh, node, number), group, body_from_node, pose))
    }

    /// A primitive of a mesh of a node, at each place of the node's instances.
    fn add_primitive(
        &mut self,
        (mesh, node, number): (usize, usize, usize),
        group: Group,
        body_from_node: &DAffine3,
        pose: Option<Pose<'_>>,
    ) -> Result<(), SceneError> {
        let Some((part, lost)) = self.read((mesh, node, number), pose)? else { return Ok(()) };
        let into = self.meshes.entry(group).or_default();
        let here = [DAffine3::IDENTITY];
        for place in self.source.instances.get(&node).map_or(&here[..], Vec::as_slice) {
            self.cancel.check(self.limits)?;
            self.dropped.add(lost);
            // An instance may be scaled to zero, to hide it.
            let body_from_instance = *body_from_node * *place;
            if is_invertible(&body_from_instance) {
                into.append_transformed(&part, &body_from_instance);
            }
        }
        Ok(())
    }

    /// A primitive of a mesh of a node, in the mesh's space or as its skin has it; `None` if there is nothing to see.
    fn read(
        &mut self,
        (mesh, node, number): (usize, usize, usize),
        pose: Option<Pose<'_>>,
    ) -> Result<Option<(TriangleMesh, DropCounts)>, SceneError> {
        self.cancel.check(self.limits)?;
        let Source { document, data, look, deformations, .. } = *self.source;
        let primitive = &document.as_json().meshes[mesh].primitives[number];
        let material = primitive.material.map_or(look.materials.len() - 1, |m| m.value());
        let look = (look, material as u32);
        let deformation = deformations.of((node, mesh, number), pose);
        let stop = (self.cancel, self.limits);
        read_primitive(primitive, data, look, &deformation, &mut self.paint, stop)
    }

    /// Bodies of what was gathered.
    fn into_flat(mut self, warnings: &mut Vec<String>) -> Result<Flat, SceneError> {
        let claims = self.claims;
        let mut bodies: Vec<Body> = vec![];
        let mut body_of = BTreeMap::new();
        let mut has_surface = vec![false; claims.bodies.len()];
        self.add_carriers();
        // None comes first; static things must come last, after the bodies in the order of the rig file.
        let (fixed, moving): (Vec<_>, Vec<_>) =
            std::mem::take(&mut self.meshes).into_iter().partition(|(group, _)| group.claim.is_none());
        for (group, mut mesh) in moving.into_iter().chain(fixed) {
            // What a mesh that deforms is made of was sorted out before it was bound.
            if group.deforming.is_none() {
                self.dropped.add(mesh.drop_unusable());
            }
            let is_carrier = group.claim.is_some() && group.is_whole();
            if mesh.triangles.is_empty() && !is_carrier {
                continue;
            }
            if let Some(c) = group.claim {
                has_surface[c] |= !mesh.triangles.is_empty();
            }
            body_of.insert(group, bodies.len() as u32);
            bodies.push(self.body(group, mesh));
        }
        self.dropped.warn(warnings);
        if bodies.iter().all(|b| b.mesh.triangles.is_empty()) {
            return Err(SceneError::broken("scene", "holds no usable triangle"));
        }
        if let Some((claim, _)) = claims.bodies.iter().zip(&has_surface).find(|(_, has)| !**has) {
            let name = format!("body '{}'", claim.name);
            return Err(SceneError::broken(name, "its node holds no usable triangle"));
        }
        let lights = std::mem::take(&mut self.lights);
        let lights =
            lights.into_iter().map(|(group, l)| self.carried(group, l, &body_of, warnings)).collect();
        Ok(Flat { bodies, lights })
    }

    /// A body for every claim that has parts or meshes that deform: its pose at rest is that of the claim, even if all its
    /// surfaces move.
    fn add_carriers(&mut self) {
        let with_parts = self.meshes.keys().filter(|group| group.claim.is_some() && !group.is_whole());
        let carriers: Vec<Group> = with_parts
            .map(|group| Group {
                is_virtual: group.claim.is_some_and(|c| !self.claims.bodies[c].projected),
                part: None,
                deforming: None,
                ..*group
            })
            .collect();
        for carrier in carriers {
            self.meshes.entry(carrier).or_default();
        }
    }

    fn body(&self, group: Group, mesh: TriangleMesh) -> Body {
        let carrier = match (group.claim, group.is_virtual) {
            (Some(c), _) => self.claims.bodies[c].name.as_str(),
            (None, false) => "static",
            (None, true) => "virtual",
        };
        let rest = group.claim.map_or(DAffine3::IDENTITY, |c| self.rest[c]);
        let motion = self.motion(group);
        let deforming = group.deforming.map(|i| &self.deforming[i]);
        Body {
            name: match (group.part, deforming) {
                (Some(part), _) => format!("{carrier}/{}", self.parts[part].name),
                (None, Some((name, _))) => format!("{carrier}/{name}"),
                (None, None) => carrier.to_owned(),
            },
            tracked: group.claim.map(|c| c as u16),
            projected: !group.is_virtual,
            world_from_body_rest: motion.as_ref().map_or(rest, |motion| rest * motion.at(0)),
            motion,
            mesh,
            deforms: deforming.map(|(_, deforms)| Arc::new(deforms.clone())),
        }
    }

    fn motion(&self, group: Group) -> Option<PartMotion> {
        let Animation { length_s, period_ns, .. } = *self.source.animation;
        group.part.map(|part| PartMotion::new(self.parts[part].links.clone(), length_s, period_ns))
    }

    /// A light with the body that carries it: that of its group, or of its claim if the part that carries it has no surface.
    fn carried(
        &self,
        group: Group,
        light: PunctualLight,
        body_of: &BTreeMap<Group, u32>,
        warnings: &mut Vec<String>,
    ) -> PunctualLight {
        let find = |part| {
            let same = |g: &&Group| g.claim == group.claim && g.part == part && g.deforming.is_none();
            body_of.keys().find(same).map(|g| body_of[g])
        };
        let Some(motion) = self.motion(group) else {
            return PunctualLight { body: group.claim.and_then(|_| find(None)), ..light };
        };
        if let Some(body) = find(group.part) {
            return PunctualLight { body: Some(body), ..light };
        }
        warnings.push("a light that an animation moves stands still: nothing else moves with it".into());
        let place = motion.at(0);
        PunctualLight {
            body: group.claim.and_then(|_| find(None)),
            position: place.transform_point3(light.position.as_dvec3()).as_vec3(),
            direction: place.transform_vector3(light.direction.as_dvec3()).as_vec3(),
            ..light
        }
    }
}

/// Translation, rotation and scale of a node; `None` if it has a matrix that is more than these.
fn decomposed(node: &gltf::Node) -> Option<(DVec3, glam::DQuat, DVec3)> {
    let vector = |v: [f32; 3]| DVec3::from_array(v.map(f64::from));
    match node.transform() {
        gltf::scene::Transform::Matrix { .. } => None,
        gltf::scene::Transform::Decomposed { translation, rotation, scale } => {
            let rotation = glam::DQuat::from_array(rotation.map(f64::from)).normalize();
            Some((vector(translation), rotation, vector(scale)))
        }
    }
}

/// Parent-from-node: as `channels` say where these never change, elsewhere at rest.
fn local_transform(node: &gltf::Node, channels: Option<&Channels>) -> DAffine3 {
    let Some((mut translation, mut rotation, mut scale)) = decomposed(node) else {
        let matrix = node.transform().matrix().map(|c| c.map(f64::from));
        return DAffine3::from_mat4(DMat4::from_cols_array_2d(&matrix));
    };
    if let Some(ValueTrack::Constant(at)) = channels.and_then(|c| c.translation.as_ref()) {
        translation = *at;
    }
    if let Some(ValueTrack::Constant(turn)) = channels.and_then(|c| c.rotation.as_ref()) {
        rotation = *turn;
    }
    if let Some(ValueTrack::Constant(size)) = channels.and_then(|c| c.scale.as_ref()) {
        scale = *size;
    }
    DAffine3::from_scale_rotation_translation(scale, rotation, translation)
}

/// The rigid map and the factor of which a map is the product; `None` if it does not keep angles, or mirrors.
fn even_part(map: &DAffine3) -> Option<(DAffine3, f64)> {
    let rigid = rigid_part(map)?;
    let scale = map.matrix3.x_axis.length();
    let even = DAffine3 { matrix3: rigid.matrix3 * DMat3::from_diagonal(DVec3::splat(scale)), ..rigid };
    even.abs_diff_eq(*map, 1e-4 * scale).then_some((rigid, scale))
}

fn is_invertible(map: &DAffine3) -> bool {
    let m = map.matrix3;
    let size = m.x_axis.length() * m.y_axis.length() * m.z_axis.length();
    map.is_finite() && m.determinant().abs() > 1e-12 * size && size > 1e-30
}

/// The rotation and translation of an affine map (columns orthonormalised, beginning with x; a mirroring stays in the
/// geometry).
fn rigid_part(map: &DAffine3) -> Option<DAffine3> {
    if !is_invertible(map) {
        return None;
    }
    let x = map.matrix3.x_axis.normalize();
    let y = (map.matrix3.y_axis - x * x.dot(map.matrix3.y_axis)).normalize();
    let rotation = DMat3::from_cols(x, y, x.cross(y));
    let rigid = DAffine3 { matrix3: rotation, translation: map.translation };
    (rigid.is_finite() && map.translation.abs().max_element() < f64::from(MAX_COORDINATE_M)).then_some(rigid)
}

/// A light in the space of its body; `None` if its position is not finite.
fn place_light(light: &gltf::khr_lights_punctual::Light, body_from_node: &DAffine3) -> Option<PunctualLight> {
    use gltf::khr_lights_punctual::Kind;
    let kind = match light.kind() {
        Kind::Directional => PunctualKind::Directional,
        Kind::Point => PunctualKind::Point,
        Kind::Spot { inner_cone_angle, outer_cone_angle } => PunctualKind::Spot {
            inner: inner_cone_angle,
            outer: outer_cone_angle.min(std::f32::consts::FRAC_PI_2),
        },
    };
    let direction = (body_from_node.matrix3 * DVec3::NEG_Z).try_normalize()?.as_vec3();
    let position = body_from_node.translation.as_vec3();
    position.is_finite().then(|| PunctualLight {
        kind,
        intensity: Vec3::from(light.color()) * light.intensity(),
        body: None,
        position,
        direction,
        range: light.range().unwrap_or(f32::INFINITY),
    })
}
