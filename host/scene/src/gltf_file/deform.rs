//! Morph targets and skins: where the vertices of a mesh lie while nothing plays [glTF 2.0, sections 3.7.2.2 and 3.7.3],
//! and which skins are made of rigid pieces, which play.
//!
//! A target or a skin that is broken is no reason to refuse a scene: its mesh is shown without it, and that is told.

use std::collections::{BTreeMap, HashMap};

use glam::{DAffine3, DMat3, DMat4, DVec3, Vec3};

use super::super::limits::Cancel;
use super::super::mesh::cofactor;
use super::super::{Limits, SceneError, TriangleMesh};
use super::accessor::{Accessor, Component, Data};
use super::json::Item;
use super::primitive::faces;

/// Most joints that may hold a vertex, in fours.
const MOST_SETS: usize = 4;
/// A vertex hangs on one joint alone if this share of its weight does.
const ALONE: f64 = 0.999;
/// Vertices between two looks at the time.
const STRETCH: usize = 4096;

/// What deforms the meshes of a file.
#[derive(Debug, Default)]
pub(crate) struct Deformations {
    meshes: Vec<Mesh>,
    skins: Vec<Option<Skin>>,
    nodes: HashMap<usize, OfNode>,
}

/// What a mesh says.
#[derive(Debug, Default)]
struct Mesh {
    primitives: Vec<Primitive>,
    /// Weights of its targets where a node has none of its own.
    weights: Vec<f64>,
}

#[derive(Debug, Default)]
struct Primitive {
    targets: Vec<Target>,
    /// Accessors of the numbers of joints and of their weights, four of each a vertex.
    influences: Vec<[usize; 2]>,
}

/// A morph target: accessors of what is added to each vertex.
#[derive(Debug)]
struct Target {
    positions: Option<usize>,
    normals: Option<usize>,
    tangents: Option<usize>,
}

/// A skin: its joints, and where what they hold lay when it was bound to them.
#[derive(Debug)]
pub(crate) struct Skin {
    /// Nodes.
    pub joints: Vec<usize>,
    /// Joint-from-mesh of each joint.
    pub bind: Vec<DAffine3>,
}

impl Skin {
    /// Body-from-mesh of each joint, from the places of all nodes.
    pub(crate) fn pose(&self, body_from_world: &DAffine3, world_from_node: &[DAffine3]) -> Vec<DAffine3> {
        let place = |(joint, bind): (&usize, &DAffine3)| *body_from_world * world_from_node[*joint] * *bind;
        self.joints.iter().zip(&self.bind).map(place).collect()
    }
}

#[derive(Debug, Default)]
struct OfNode {
    weights: Option<Vec<f64>>,
    skin: Option<usize>,
}

impl Deformations {
    /// Reads what deforms meshes; what cannot be used is left out and told.
    ///
    /// # Errors
    /// The document is no glTF.
    pub(super) fn read(
        root: &Item,
        data: &Data,
        nodes: &[Item],
        limits: &Limits,
        warnings: &mut Vec<String>,
    ) -> Result<Self, SceneError> {
        let mut all = Self::default();
        for mesh in root.list("meshes", "mesh", limits.objects)? {
            let mut read = Mesh { weights: weights(&mesh)?.unwrap_or_default(), primitives: vec![] };
            for mut primitive in mesh.list("primitives", "primitive", limits.objects)? {
                primitive.name = format!("{}, {}", mesh.name, primitive.name);
                read.primitives.push(Primitive {
                    targets: usable("its morph targets are", &primitive, targets(&primitive, data), warnings),
                    influences: usable("its skin is", &primitive, influences(&primitive, data), warnings),
                });
            }
            all.meshes.push(read);
        }
        for skin in root.list("skins", "skin", limits.objects)? {
            let read = read_skin(&skin, data, nodes.len());
            all.skins.push(read.map_err(|e| warnings.push(format!("{e}; the skin is not used"))).ok());
        }
        for (index, node) in nodes.iter().enumerate() {
            let own = OfNode {
                weights: weights(node)?,
                skin: node.index("skin", all.skins.len(), "skin")?.filter(|_| node.get("mesh").is_some()),
            };
            if own.weights.is_some() || own.skin.is_some() {
                all.nodes.insert(index, own);
            }
        }
        Ok(all)
    }

    /// The skin of a node that shows `mesh`, if there is one that can be used. It, and not the node, says where the mesh is.
    pub(crate) fn skin(&self, node: usize, mesh: usize) -> Option<&Skin> {
        let skin = self.skins[self.nodes.get(&node)?.skin?].as_ref()?;
        self.meshes[mesh].primitives.iter().all(|p| !p.influences.is_empty()).then_some(skin)
    }

    /// The faces of a mesh by the joint of its skin on which each hangs, if each hangs on one alone, and these are at most
    /// `most`. The mesh then is made of rigid pieces.
    ///
    /// # Errors
    /// A face is broken.
    pub(crate) fn rigid_pieces(
        &self,
        mesh: usize,
        of_file: &[gltf::json::mesh::Primitive],
        data: &Data,
        most: usize,
    ) -> Result<Option<BTreeMap<usize, Piece>>, SceneError> {
        let mut pieces: BTreeMap<usize, Piece> = BTreeMap::new();
        for (number, primitive) in of_file.iter().enumerate() {
            let influences = &self.meshes[mesh].primitives[number].influences;
            for face in faces(primitive, data)?.into_iter().flatten() {
                let Some(joint) = only_joint_of(influences, data, &face) else { return Ok(None) };
                let piece = pieces.entry(joint).or_default();
                match piece.last_mut() {
                    Some((last, faces)) if *last == number => faces.push(face),
                    _ => piece.push((number, vec![face])),
                }
                if pieces.len() > most {
                    return Ok(None);
                }
            }
        }
        Ok(Some(pieces))
    }

    /// What deforms a primitive of `mesh` at a node. `pose` is that of its skin.
    pub(crate) fn of<'a>(
        &'a self,
        (node, mesh, primitive): (usize, usize, usize),
        pose: Option<Pose<'a>>,
    ) -> Deformation<'a> {
        let of_mesh = &self.meshes[mesh];
        let Primitive { targets, influences } = &of_mesh.primitives[primitive];
        let weights = if matches!(pose, Some(Pose::Bind)) { &[] } else { self.weights(node, mesh) };
        let targets = weights.iter().copied().zip(targets).filter(|(weight, _)| *weight != 0.0).collect();
        Deformation { targets, pose, influences }
    }

    /// The weights of a mesh's morph targets at a node while nothing plays.
    pub(super) fn weights(&self, node: usize, mesh: usize) -> &[f64] {
        let own = self.nodes.get(&node).and_then(|own| own.weights.as_ref());
        own.unwrap_or(&self.meshes[mesh].weights)
    }

    /// True if a mesh has morph targets.
    pub(super) fn has_targets(&self, mesh: usize) -> bool {
        self.meshes[mesh].primitives.iter().any(|primitive| !primitive.targets.is_empty())
    }

    /// The joints that hold a vertex of a primitive of `mesh`, with their weights.
    pub(super) fn joints_of<'a>(
        &'a self,
        (mesh, primitive): (usize, usize),
        data: &'a Data,
        vertex: u32,
    ) -> impl Iterator<Item = (usize, f64)> + 'a {
        held_by(&self.meshes[mesh].primitives[primitive].influences, data, vertex.into())
    }

    /// What a morph target adds to positions, normals and tangents of a primitive's vertices `sources`, by their places in it.
    pub(super) fn moves_of(
        &self,
        (mesh, primitive): (usize, usize),
        target: usize,
        data: &Data,
        sources: &[u32],
    ) -> Vec<(usize, [Vec3; 3])> {
        let Some(target) = self.meshes[mesh].primitives[primitive].targets.get(target) else { return vec![] };
        let of = |accessor: Option<usize>, vertex: u32| {
            accessor.map_or(Vec3::ZERO, |i| data.floats::<3>(&data.accessors[i], vertex.into()).into())
        };
        let moves =
            sources.iter().map(|&v| [target.positions, target.normals, target.tangents].map(|a| of(a, v)));
        let is_some = |(_, moved): &(usize, [Vec3; 3])| {
            moved.iter().any(|v| *v != Vec3::ZERO) && moved.iter().all(|v| v.is_finite())
        };
        moves.enumerate().filter(is_some).collect()
    }
}

/// What was read, or nothing of it, which is told.
fn usable<T>(
    what: &str,
    primitive: &Item,
    read: Result<Vec<T>, String>,
    warnings: &mut Vec<String>,
) -> Vec<T> {
    read.unwrap_or_else(|why| {
        warnings.push(format!("{}: {what} not used: {why}", primitive.name));
        vec![]
    })
}

/// The weights of morph targets of a mesh or node.
fn weights(item: &Item) -> Result<Option<Vec<f64>>, SceneError> {
    let Some(value) = item.get("weights") else { return Ok(None) };
    let number = |v: &serde_json::Value| v.as_f64().filter(|w| w.is_finite());
    let numbers = value.as_array().and_then(|list| list.iter().map(number).collect::<Option<Vec<f64>>>());
    numbers.map(Some).ok_or_else(|| item.error("'weights' must be a list of numbers"))
}

/// The accessor that `attributes` name by `key`, if it has an element for each vertex.
fn attribute<'a>(
    (attributes, key): (&Item, &str),
    data: &'a Data,
    dimensions: u64,
    vertices: u64,
) -> Result<Option<(usize, &'a Accessor)>, String> {
    let index = attributes.index(key, data.accessors.len(), "accessor").map_err(|e| e.to_string())?;
    let Some(index) = index else { return Ok(None) };
    let accessor = &data.accessors[index];
    if accessor.dimensions != dimensions || accessor.count != vertices {
        return Err(format!(
            "{} serves as {key}: it must have {dimensions} components and an element for each of {vertices} vertices",
            accessor.name
        ));
    }
    Ok(Some((index, accessor)))
}

/// The vertices of a primitive.
fn vertices(primitive: &Item, data: &Data) -> Result<u64, String> {
    let attributes = primitive.object("attributes").map_err(|e| e.to_string())?;
    let positions = attributes.and_then(|a| a.index("POSITION", data.accessors.len(), "accessor").ok()?);
    Ok(positions.map_or(0, |i| data.accessors[i].count))
}

fn targets(primitive: &Item, data: &Data) -> Result<Vec<Target>, String> {
    let vertices = vertices(primitive, data)?;
    let targets = primitive.list("targets", "target", u64::MAX).map_err(|e| e.to_string())?;
    let read = |target: &Item| {
        let find = |key: &str| {
            let found = attribute((target, key), data, 3, vertices)?;
            match found {
                Some((_, a)) if a.component == Component::U32 => {
                    Err(format!("{} serves as {key} of 32-bit integers", a.name))
                }
                found => Ok(found.map(|(index, _)| index)),
            }
        };
        Ok(Target { positions: find("POSITION")?, normals: find("NORMAL")?, tangents: find("TANGENT")? })
    };
    targets.iter().map(read).collect()
}

fn influences(primitive: &Item, data: &Data) -> Result<Vec<[usize; 2]>, String> {
    let vertices = vertices(primitive, data)?;
    let mut sets = vec![];
    let Some(attributes) = primitive.object("attributes").map_err(|e| e.to_string())? else {
        return Ok(sets);
    };
    for set in 0..MOST_SETS {
        let find = |kind: &str| {
            let key = format!("{kind}_{set}");
            attribute((&attributes, &key), data, 4, vertices)
        };
        let (Some((joints, j)), Some((weights, w))) = (find("JOINTS")?, find("WEIGHTS")?) else { break };
        if !matches!(j.component, Component::U8 | Component::U16) || j.normalized {
            return Err(format!("{} serves as joints: it must be of unsigned 8 or 16 bits", j.name));
        }
        let is_share = w.normalized && matches!(w.component, Component::U8 | Component::U16);
        if w.component != Component::F32 && !is_share {
            return Err(format!("{} serves as weights: it must be of floats or shares", w.name));
        }
        sets.push([joints, weights]);
    }
    Ok(sets)
}

fn read_skin(skin: &Item, data: &Data, nodes: usize) -> Result<Skin, SceneError> {
    let joints = skin.indices("joints", nodes, "node")?;
    if joints.is_empty() {
        return Err(skin.error("has no 'joints'"));
    }
    let bind = match skin.index("inverseBindMatrices", data.accessors.len(), "accessor")? {
        None => vec![DAffine3::IDENTITY; joints.len()],
        Some(i) => {
            let a = &data.accessors[i];
            if a.dimensions != 16 || a.component != Component::F32 || a.count < joints.len() as u64 {
                return Err(skin.error(format!("{} is no matrix of floats for each joint", a.name)));
            }
            let matrix = |k: u64| {
                let m = DMat4::from_cols_array(&data.floats::<16>(a, k).map(f64::from));
                m.is_finite().then(|| DAffine3::from_mat4(m))
            };
            let all: Option<Vec<_>> = (0..joints.len() as u64).map(matrix).collect();
            all.ok_or_else(|| skin.error(format!("{} holds what is no number", a.name)))?
        }
    };
    Ok(Skin { joints, bind })
}

/// A rigid piece of a skin: its faces by primitive, in order.
pub(crate) type Piece = Vec<(usize, Vec<[u64; 3]>)>;

/// Where the joints of a skin are.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Pose<'a> {
    /// Body-from-mesh of each joint.
    All(&'a [DAffine3]),
    /// These faces alone, which hang on one joint: body-from-mesh.
    One(&'a [[u64; 3]], DAffine3),
    /// As the file has it: what deforms it comes later, and needs the vertices' numbers in the file.
    Bind,
}

/// What deforms a primitive at a node.
#[derive(Debug, Default)]
pub(crate) struct Deformation<'a> {
    /// With the weights that they have.
    targets: Vec<(f64, &'a Target)>,
    pose: Option<Pose<'a>>,
    /// Accessors of a vertex's joints and weights.
    influences: &'a [[usize; 2]],
}

impl Deformation<'_> {
    /// The faces that are shown, if they are not all of the primitive's.
    pub(super) fn faces(&self) -> Option<&[[u64; 3]]> {
        match self.pose {
            Some(Pose::One(faces, _)) => Some(faces),
            _ => None,
        }
    }

    /// See [`Pose::Bind`].
    pub(super) fn is_bind_pose(&self) -> bool {
        matches!(self.pose, Some(Pose::Bind))
    }

    /// Moves the vertices `used` of the primitive's accessors, which are those of `mesh` in order.
    ///
    /// # Errors
    /// The load was stopped.
    pub(super) fn apply(
        &self,
        data: &Data,
        used: &[u64],
        mesh: &mut TriangleMesh,
        stop: (&Cancel, &Limits),
    ) -> Result<(), SceneError> {
        if !self.targets.is_empty() {
            self.morph(data, used, mesh, stop)?;
        }
        match self.pose {
            None | Some(Pose::Bind) => Ok(()),
            Some(Pose::One(_, map)) => skin(&|_| map, used, mesh, stop),
            Some(Pose::All(joints)) => {
                let map = |vertex| mean(joints, self.influences, data, vertex);
                skin(&map, used, mesh, stop)
            }
        }
    }

    fn morph(
        &self,
        data: &Data,
        used: &[u64],
        mesh: &mut TriangleMesh,
        (cancel, limits): (&Cancel, &Limits),
    ) -> Result<(), SceneError> {
        let sum = |of: fn(&Target) -> Option<usize>| {
            let mut sums = vec![DVec3::ZERO; used.len()];
            for (weight, target) in &self.targets {
                cancel.check(limits)?;
                let Some(accessor) = of(target).map(|i| &data.accessors[i]) else { continue };
                for (sum, &i) in sums.iter_mut().zip(used) {
                    *sum += *weight * DVec3::from_array(data.floats::<3>(accessor, i).map(f64::from));
                }
            }
            Ok::<_, SceneError>(sums)
        };
        let moved = |v: Vec3, by: &DVec3| (v.as_dvec3() + *by).as_vec3();
        for (p, by) in mesh.positions.iter_mut().zip(&sum(|t| t.positions)?) {
            *p = moved(*p, by);
        }
        for (n, by) in mesh.normals.iter_mut().zip(&sum(|t| t.normals)?) {
            *n = moved(*n, by);
        }
        for (t, by) in mesh.tangents.iter_mut().zip(&sum(|t| t.tangents)?) {
            *t = moved(t.truncate(), by).extend(t.w);
        }
        Ok(())
    }
}

/// Moves each vertex by its map. A mesh of which most vertices are mirrored by theirs is turned inside
/// out, so that its faces stay outside.
fn skin(
    map_of: &dyn Fn(u64) -> DAffine3,
    used: &[u64],
    mesh: &mut TriangleMesh,
    (cancel, limits): (&Cancel, &Limits),
) -> Result<(), SceneError> {
    let mut mirrored = 0;
    for (v, &i) in used.iter().enumerate() {
        if v % STRETCH == 0 {
            cancel.check(limits)?;
        }
        let map = map_of(i);
        let is_mirrored = map.matrix3.determinant() < 0.0;
        mirrored += usize::from(is_mirrored);
        let side = if is_mirrored { -1.0 } else { 1.0 };
        mesh.positions[v] = map.transform_point3(mesh.positions[v].as_dvec3()).as_vec3();
        let normal = side * (cofactor(map.matrix3) * mesh.normals[v].as_dvec3());
        mesh.normals[v] = normal.normalize_or_zero().as_vec3();
        if let Some(tangent) = mesh.tangents.get_mut(v) {
            let along = map.matrix3 * tangent.truncate().as_dvec3();
            *tangent = along.normalize_or_zero().as_vec3().extend(side as f32 * tangent.w);
        }
    }
    if 2 * mirrored > used.len() {
        mesh.triangles.iter_mut().for_each(|[_, b, c]| std::mem::swap(b, c));
    }
    Ok(())
}

/// The joint on which all corners of a face hang with nearly all of their weight.
fn only_joint_of(influences: &[[usize; 2]], data: &Data, face: &[u64; 3]) -> Option<usize> {
    let [a, b, c] = face.map(|vertex| only_joint(influences, data, vertex));
    a.filter(|_| a == b && b == c)
}

fn only_joint(influences: &[[usize; 2]], data: &Data, vertex: u64) -> Option<usize> {
    let (mut heaviest, mut most, mut sum) = (0, 0.0, 0.0);
    for (joint, weight) in held_by(influences, data, vertex) {
        sum += weight;
        if weight > most {
            (heaviest, most) = (joint, weight);
        }
    }
    (most > 0.0 && most >= ALONE * sum).then_some(heaviest)
}

/// The joints that hold a vertex, with their weights.
fn held_by<'a>(
    influences: &'a [[usize; 2]],
    data: &'a Data,
    vertex: u64,
) -> impl Iterator<Item = (usize, f64)> + 'a {
    influences.iter().flat_map(move |[joint, weight]| {
        let joints = data.floats::<4>(&data.accessors[*joint], vertex).map(|number| number as usize);
        let weights = data.floats::<4>(&data.accessors[*weight], vertex).map(f64::from);
        joints.into_iter().zip(weights).filter(|(_, weight)| *weight > 0.0 && weight.is_finite())
    })
}

/// The mean of the maps of a vertex's joints by their weights. Joints that the skin does not have count for nothing; a vertex
/// that no joint holds follows the first one.
fn mean(joints: &[DAffine3], influences: &[[usize; 2]], data: &Data, vertex: u64) -> DAffine3 {
    let (mut matrix, mut at, mut sum) = (DMat3::ZERO, DVec3::ZERO, 0.0);
    for (joint, weight) in held_by(influences, data, vertex) {
        if let Some(map) = joints.get(joint) {
            matrix += map.matrix3 * weight;
            at += map.translation * weight;
            sum += weight;
        }
    }
    if sum > 0.0 {
        DAffine3 { matrix3: matrix * (1.0 / sum), translation: at / sum }
    } else {
        joints.first().copied().unwrap_or(DAffine3::IDENTITY)
    }
}
