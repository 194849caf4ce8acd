//! Flattens the node tree into rigid bodies: nodes that a body of the rig file claims move with it, all others are
//! static.

use std::collections::{BTreeMap, HashMap, HashSet};

use glam::{DAffine3, DMat3, DMat4, DVec3, Vec3};

use super::super::limits::Cancel;
use super::super::mesh::Dropped;
use super::super::{
    Body, BodySelector, Limits, LoadOptions, PunctualKind, PunctualLight, SceneError, TriangleMesh,
};
use super::accessor::Data;
use super::instancing::Instances;
use super::look::Look;
use super::primitive::read_primitive;
use super::vertex_paint::Paint;

/// Bodies that [`choose_bodies`] makes movable when the rig file names none.
const AUTO_BODIES: usize = 2;

/// The body that a node belongs to: (index of the selector or none, exists only in the virtual world).
type Group = (Option<usize>, bool);

/// Part of the tree still to be walked.
struct Step {
    node: usize,
    world: DAffine3,
    claim: Option<usize>,
    is_virtual: bool,
}

/// The result of [`flatten`].
pub(crate) struct Flat {
    /// In the order of the selectors, fixed things last.
    pub bodies: Vec<Body>,
    /// All lights of the file that a scene uses.
    pub lights: Vec<PunctualLight>,
}

/// Nodes claimed by rigid bodies and nodes that are virtual.
pub(crate) struct Claims {
    /// In the order of the rig file.
    bodies: Vec<Claim>,
    virtual_nodes: Vec<usize>,
}

struct Claim {
    name: String,
    node: usize,
    projected: bool,
}

/// Roots of the scene to show: the default scene, else the first, else every node without a parent.
pub(super) fn roots(document: &gltf::Document) -> Vec<usize> {
    match document.default_scene().or_else(|| document.scenes().next()) {
        Some(scene) => scene.nodes().map(|n| n.index()).collect(),
        None => {
            let mut is_child = vec![false; document.nodes().len()];
            for child in document.nodes().flat_map(|n| n.children()) {
                is_child[child.index()] = true;
            }
            (0..is_child.len()).filter(|&i| !is_child[i]).collect()
        }
    }
}

/// Nodes of the scene from the roots down, parents before children.
fn descendants(document: &gltf::Document, roots: &[usize]) -> Vec<usize> {
    let mut order = roots.to_vec();
    let mut next = 0;
    while next < order.len() {
        if let Some(node) = document.nodes().nth(order[next]) {
            order.extend(node.children().map(|c| c.index()));
        }
        next += 1;
    }
    order
}

/// Resolves the names of the rig file; without selectors the first two objects of the scene become movable.
pub(crate) fn choose_bodies(
    document: &gltf::Document,
    options: &LoadOptions,
    warnings: &mut Vec<String>,
) -> Result<Claims, SceneError> {
    let roots = roots(document);
    let present = descendants(document, &roots);
    let names: Vec<Option<&str>> =
        present.iter().map(|&i| document.nodes().nth(i).and_then(|n| n.name())).collect();
    let find = |name: &str| find_node(&names, &present, name);
    let mut virtual_nodes = options.virtual_nodes.iter().map(|n| find(n)).collect::<Result<Vec<_>, _>>()?;
    let known: HashSet<&str> = names.iter().copied().flatten().collect();
    let named = |name: &str| known.contains(name);
    if options.bodies.iter().all(|b| b.node.is_none() && !named(&b.name)) {
        return Ok(choose_automatically(document, roots, virtual_nodes, &options.bodies, warnings));
    }
    let mut bodies: Vec<Claim> = vec![];
    for BodySelector { name, node, projected } in &options.bodies {
        let node = node.as_ref().unwrap_or(name);
        let index = find(node)?;
        if let Some(other) = bodies.iter().find(|b| b.node == index) {
            return Err(SceneError::broken(
                format!("body '{name}'"),
                format!("claims node '{node}', which body '{}' claims already", other.name),
            ));
        }
        bodies.push(Claim { name: name.clone(), node: index, projected: *projected });
    }
    virtual_nodes.sort_unstable();
    Ok(Claims { bodies, virtual_nodes })
}

/// The only node named `name` in `present`; `names` holds the nodes' names.
fn find_node(names: &[Option<&str>], present: &[usize], name: &str) -> Result<usize, SceneError> {
    let matching: Vec<usize> =
        present.iter().zip(names).filter(|(_, n)| **n == Some(name)).map(|(i, _)| *i).collect();
    if let [one] = matching[..] {
        return Ok(one);
    }
    let known: Vec<String> = names.iter().flatten().take(30).map(|n| super::json::shorten(n)).collect();
    let problem = match matching.len() {
        0 => format!("the scene has no node '{name}'"),
        n => format!(
            "the scene has {n} nodes named '{name}', so which one is meant cannot be told: rename them"
        ),
    };
    Err(SceneError::Node { problem, known: if known.is_empty() { "none".into() } else { known.join(", ") } })
}

/// The first objects of the scene with a mesh become the given movable bodies, or, if none are given, two bodies with
/// the names of their nodes; lamps (all materials emit) become virtual.
fn choose_automatically(
    document: &gltf::Document,
    mut roots: Vec<usize>,
    mut virtual_nodes: Vec<usize>,
    given: &[BodySelector],
    warnings: &mut Vec<String>,
) -> Claims {
    // Exporters often wrap everything in one node: look inside it.
    while let [only] = roots[..] {
        let Some(node) = document.nodes().nth(only) else { break };
        let below: Vec<usize> = node.children().map(|c| c.index()).collect();
        if node.mesh().is_some() || below.is_empty() {
            break;
        }
        roots = below;
    }
    let known_virtual: HashSet<usize> = virtual_nodes.iter().copied().collect();
    let wanted = if given.is_empty() { AUTO_BODIES } else { given.len() };
    let mut bodies = vec![];
    for root in roots {
        let materials: Vec<bool> = descendants(document, &[root])
            .into_iter()
            .filter_map(|i| document.nodes().nth(i)?.mesh())
            .flat_map(|mesh| mesh.primitives())
            .map(|p| {
                Vec3::from(p.material().emissive_factor()).max_element() > 0.0
                    && p.material().emissive_texture().is_none()
                    && !p.material().unlit()
            })
            .collect();
        let name = document
            .nodes()
            .nth(root)
            .and_then(|n| n.name())
            .map_or_else(|| format!("node {root}"), str::to_owned);
        if materials.is_empty() || known_virtual.contains(&root) {
            continue;
        }
        if materials.iter().all(|&emits| emits) {
            warnings.push(format!("'{name}' emits light everywhere: taken for a lamp of the virtual world, nothing is projected on it"));
            virtual_nodes.push(root);
        } else if bodies.len() < wanted {
            let body = given.get(bodies.len());
            if let Some(body) = body {
                warnings.push(format!(
                    "body '{}' stands for '{name}': the scene has no node of its name",
                    body.name
                ));
            }
            bodies.push(Claim {
                name: body.map_or(name, |b| b.name.clone()),
                node: root,
                projected: body.is_none_or(|b| b.projected),
            });
        }
    }
    for body in given.iter().skip(bodies.len()) {
        warnings.push(format!(
            "body '{}' has nothing to show: the scene has only {} objects",
            body.name,
            bodies.len()
        ));
    }
    virtual_nodes.sort_unstable();
    Claims { bodies, virtual_nodes }
}

/// A checked document and its decoded parts.
pub(super) struct Source<'a> {
    /// Nodes and meshes.
    pub document: &'a gltf::Document,
    /// Buffers.
    pub data: &'a Data,
    /// Materials and textures.
    pub look: &'a Look,
    /// The places of the meshes of instanced nodes.
    pub instances: &'a Instances,
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
    let mut gatherer = Gatherer {
        source,
        claims,
        limits,
        cancel,
        rest: vec![DAffine3::IDENTITY; claims.bodies.len()],
        meshes: BTreeMap::new(),
        lights: vec![],
        dropped: Dropped::default(),
        paint: Paint::new(source.look, limits),
    };
    gatherer.walk(warnings)?;
    let paint = std::mem::take(&mut gatherer.paint);
    paint.warn(warnings);
    Ok((gatherer.into_flat(warnings)?, paint))
}

/// What is gathered on the walk through the tree.
struct Gatherer<'a> {
    source: &'a Source<'a>,
    claims: &'a Claims,
    limits: &'a Limits,
    cancel: &'a Cancel,
    /// By claim: world-from-body at rest.
    rest: Vec<DAffine3>,
    meshes: BTreeMap<Group, TriangleMesh>,
    lights: Vec<(Option<usize>, PunctualLight)>,
    dropped: Dropped,
    paint: Paint,
}

impl Gatherer<'_> {
    fn walk(&mut self, warnings: &mut Vec<String>) -> Result<(), SceneError> {
        let claims = self.claims;
        let claim_of: HashMap<usize, usize> =
            claims.bodies.iter().enumerate().map(|(c, b)| (b.node, c)).collect();
        let document = self.source.document;
        let mut walk: Vec<Step> = roots(document)
            .into_iter()
            .rev()
            .map(|node| Step { node, world: self.source.world, claim: None, is_virtual: false })
            .collect();
        while let Some(step) = walk.pop() {
            self.cancel.check(self.limits)?;
            let Some(node) = document.nodes().nth(step.node) else { continue };
            let world = step.world * local_transform(&node);
            let claimed_here = claim_of.get(&step.node).copied();
            let claim = claimed_here.or(step.claim);
            let is_virtual = match claimed_here {
                Some(c) => !claims.bodies[c].projected,
                None => step.is_virtual,
            } || claims.virtual_nodes.binary_search(&step.node).is_ok();
            if let Some(c) = claimed_here {
                // The body's own axes are turned with the file's: without its node's transform the body lies as the world does.
                let turned = world * self.source.world.inverse();
                self.rest[c] = rigid_part(&turned).ok_or_else(|| {
                    SceneError::broken(
                        format!("body '{}'", claims.bodies[c].name),
                        "its node has a scale of zero or a position beyond any room",
                    )
                })?;
            }
            let body_from_node = claim.map_or(world, |c| self.rest[c].inverse() * world);
            if let Some(mesh) = node.mesh() {
                if is_invertible(&body_from_node) {
                    self.add_mesh(mesh.index(), step.node, (claim, is_virtual), &body_from_node)?;
                } else {
                    let name = node.name().unwrap_or("");
                    warnings
                        .push(format!("node {} '{name}' is scaled to nothing and is left out", step.node));
                }
            }
            if let Some(light) = node.light() {
                self.lights.extend(place_light(&light, &body_from_node).map(|l| (claim, l)));
            }
            walk.extend(node.children().map(|c| Step { node: c.index(), world, claim, is_virtual }));
        }
        Ok(())
    }

    /// All primitives of a mesh, at each place of the node's instances.
    fn add_mesh(
        &mut self,
        mesh: usize,
        node: usize,
        group: Group,
        body_from_node: &DAffine3,
    ) -> Result<(), SceneError> {
        let Source { document, data, look, instances, .. } = *self.source;
        let into = self.meshes.entry(group).or_default();
        let here = [DAffine3::IDENTITY];
        let places = instances.get(&node).map_or(&here[..], Vec::as_slice);
        for primitive in &document.as_json().meshes[mesh].primitives {
            self.cancel.check(self.limits)?;
            let material = primitive.material.map_or(look.materials.len() - 1, |m| m.value());
            let uv_set = look.uv_sets[material];
            let read = read_primitive(primitive, data, material as u32, uv_set, &mut self.paint)?;
            let Some((part, lost)) = read else { continue };
            for place in places {
                self.cancel.check(self.limits)?;
                self.dropped.add(lost);
                // An instance may be scaled to zero, to hide it.
                let body_from_instance = *body_from_node * *place;
                if is_invertible(&body_from_instance) {
                    into.append_transformed(&part, &body_from_instance);
                }
            }
        }
        Ok(())
    }

    /// Bodies of what was gathered.
    fn into_flat(mut self, warnings: &mut Vec<String>) -> Result<Flat, SceneError> {
        let claims = self.claims;
        let mut bodies = vec![];
        let mut body_of_claim = vec![None; claims.bodies.len()];
        // The map sorts None first; static things must come last, after the bodies in the order of the rig file.
        let (fixed, moving): (Vec<_>, Vec<_>) =
            self.meshes.into_iter().partition(|((claim, _), _)| claim.is_none());
        for ((claim, is_virtual), mut mesh) in moving.into_iter().chain(fixed) {
            self.dropped.add(mesh.drop_unusable());
            if mesh.triangles.is_empty() {
                continue;
            }
            let name = match (claim, is_virtual) {
                (Some(c), _) => claims.bodies[c].name.clone(),
                (None, false) => "static".into(),
                (None, true) => "virtual".into(),
            };
            if let Some(c) = claim {
                body_of_claim[c].get_or_insert(bodies.len() as u32);
            }
            bodies.push(Body {
                name,
                tracked: claim.map(|c| c as u16),
                projected: !is_virtual,
                world_from_body_rest: claim.map_or(DAffine3::IDENTITY, |c| self.rest[c]),
                mesh,
            });
        }
        self.dropped.warn(warnings);
        if bodies.is_empty() {
            return Err(SceneError::broken("scene", "holds no usable triangle"));
        }
        if let Some((claim, _)) = claims.bodies.iter().zip(&body_of_claim).find(|(_, b)| b.is_none()) {
            let name = format!("body '{}'", claim.name);
            return Err(SceneError::broken(name, "its node holds no usable triangle"));
        }
        let of_body = |claim: Option<usize>| claim.and_then(|c| body_of_claim[c]);
        let lights = self.lights.into_iter().map(|(claim, l)| PunctualLight { body: of_body(claim), ..l });
        Ok(Flat { bodies, lights: lights.collect() })
    }
}

fn local_transform(node: &gltf::Node) -> DAffine3 {
    match node.transform() {
        gltf::scene::Transform::Matrix { matrix } => {
            DAffine3::from_mat4(DMat4::from_cols_array_2d(&matrix.map(|c| c.map(f64::from))))
        }
        gltf::scene::Transform::Decomposed { translation, rotation, scale } => {
            let vector = |v: [f32; 3]| DVec3::from_array(v.map(f64::from));
            let rotation = glam::DQuat::from_array(rotation.map(f64::from)).normalize();
            DAffine3::from_scale_rotation_translation(vector(scale), rotation, vector(translation))
        }
    }
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
    (rigid.is_finite()
        && map.translation.abs().max_element() < f64::from(super::super::mesh::MAX_COORDINATE_M))
    .then_some(rigid)
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
