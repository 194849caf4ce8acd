//! Validation before the `gltf` crate: checks raw JSON and yields refusals and warnings. Afterwards the crate's typed
//! view can neither panic nor return wrong data.
//!
//! This file checks version, extensions, the node tree and meshes. Materials, textures and lights are in
//! [`super::amend_look`], buffers in [`super::accessor`].

use super::super::{Limits, SceneError};
use super::accessor::{Component, Data};
use super::compressed;
use super::instancing::{self, read_instances, Instances};
use super::json::{shorten, Item};
use super::texture_image;

/// Extensions that this program understands, or may ignore without a wrong picture.
const UNDERSTOOD: [&str; 25] = [
    compressed::DRACO,
    compressed::MESHOPT[0],
    compressed::MESHOPT[1],
    instancing::NAME,
    "KHR_lights_punctual",
    "KHR_materials_anisotropy",
    "KHR_materials_clearcoat",
    "KHR_materials_diffuse_transmission",
    "KHR_materials_dispersion",
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_iridescence",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_materials_transmission",
    "KHR_materials_unlit",
    "KHR_materials_variants",
    "KHR_materials_volume",
    "KHR_mesh_quantization",
    super::flatten::VISIBILITY,
    super::spec_gloss::NAME,
    texture_image::BASISU,
    texture_image::WEBP,
    "KHR_texture_transform",
    "KHR_xmp_json_ld",
];

/// Counts that references are checked against.
pub(super) struct ObjectCounts {
    /// Entries of "nodes".
    pub nodes: usize,
    /// Entries of "meshes".
    pub meshes: usize,
    /// Entries of "materials".
    pub materials: usize,
}

/// Results for a document that passed.
pub(crate) struct CheckResults {
    /// Content that is accepted but not reproduced.
    pub warnings: Vec<String>,
    /// The places of the meshes of instanced nodes.
    pub instances: Instances,
}

/// Checks the whole document except its buffers.
pub(super) fn check(root: &Item, data: &Data, limits: &Limits) -> Result<CheckResults, SceneError> {
    let mut warnings = vec![];
    let list = |key, kind| root.list(key, kind, limits.objects);
    let (nodes, meshes) = (list("nodes", "node")?, list("meshes", "mesh")?);
    let counts = ObjectCounts {
        nodes: nodes.len(),
        meshes: meshes.len(),
        materials: list("materials", "material")?.len(),
    };
    let quantized = list_of_strings(root, "extensionsUsed")?.contains(&"KHR_mesh_quantization");
    let mut triangles = Vec::with_capacity(meshes.len());
    for mesh in &meshes {
        triangles.push(check_mesh(mesh, data, &counts, quantized, limits, &mut warnings)?);
    }
    let instances = read_instances(&nodes, data, limits)?;
    check_nodes(root, &nodes, &counts, &triangles, &instances, limits)?;
    let lost: Vec<String> = list_of_strings(root, "extensionsUsed")?
        .into_iter()
        // Materials report theirs individually.
        .filter(|name| !UNDERSTOOD.contains(name) && !name.contains("_materials_"))
        .map(shorten)
        .collect();
    if !lost.is_empty() {
        warnings.push(format!("the file uses what is not reproduced: {}", lost.join(", ")));
    }
    Ok(CheckResults { warnings, instances })
}

/// Checks the version and the required extensions. This comes first: a file that needs something
/// unknown may have no plain vertices, and the operator should read that.
pub(crate) fn check_asset(root: &Item) -> Result<(), SceneError> {
    let asset = root.object("asset")?.ok_or_else(|| root.error("has no 'asset': this is not glTF"))?;
    let version = asset.text("version")?.ok_or_else(|| asset.error("has no 'version'"))?;
    let needed = asset.text("minVersion")?.unwrap_or(version);
    let is_two = |v: &str| {
        v.split_once('.').is_some_and(|(major, minor)| major == "2" && minor.parse::<u16>().is_ok())
    };
    if !is_two(version) || (needed != "2.0" && needed != version) {
        return Err(SceneError::unsupported(
            format!("glTF version {}", shorten(needed)),
            "re-export as glTF 2.0",
        ));
    }
    for name in list_of_strings(root, "extensionsRequired")? {
        if UNDERSTOOD.contains(&name) {
            continue;
        }
        let remedy = match name {
            "EXT_texture_avif" | "MSFT_texture_dds" => "re-export with PNG, JPEG, WebP or KTX2 textures",
            _ => "re-export without it, or list it only in extensionsUsed if the scene can do without",
        };
        return Err(SceneError::unsupported(format!("the required extension {}", shorten(name)), remedy));
    }
    Ok(())
}

fn list_of_strings<'a>(root: &Item<'a>, key: &str) -> Result<Vec<&'a str>, SceneError> {
    let Some(value) = root.get(key) else { return Ok(vec![]) };
    let strings =
        value.as_array().and_then(|list| list.iter().map(|v| v.as_str()).collect::<Option<Vec<_>>>());
    strings.ok_or_else(|| root.error(format!("'{key}' must be a list of strings")))
}

/// Checks the primitives of a mesh; returns its number of triangles.
fn check_mesh(
    mesh: &Item,
    data: &Data,
    counts: &ObjectCounts,
    quantized: bool,
    limits: &Limits,
    warnings: &mut Vec<String>,
) -> Result<u64, SceneError> {
    let mut triangles = 0u64;
    let primitives = mesh.list("primitives", "primitive", limits.objects)?;
    if primitives.is_empty() {
        return Err(mesh.error("has no 'primitives'"));
    }
    for mut primitive in primitives {
        primitive.name = format!("{}, {}", mesh.name, primitive.name);
        primitive.index("material", counts.materials, "material")?;
        let mode = primitive.whole("mode")?.unwrap_or(4);
        if mode > 6 {
            return Err(primitive.error(format!("'mode' is {mode}; it must be 0 to 6")));
        }
        let attributes =
            primitive.object("attributes")?.ok_or_else(|| primitive.error("has no 'attributes'"))?;
        let vertices = check_attributes(&primitive, &attributes, data, quantized)?;
        let corners = match primitive.index("indices", data.accessors.len(), "accessor")? {
            Some(i) => {
                let a = &data.accessors[i];
                if a.dimensions != 1 || !a.component.is_unsigned() || a.normalized {
                    return Err(SceneError::broken(
                        &a.name,
                        format!(
                            "serves as indices of {}: it must be SCALAR of an unsigned integer type",
                            primitive.name
                        ),
                    ));
                }
                a.count
            }
            None => vertices.unwrap_or(0),
        };
        if mode < 4 || vertices.is_none() {
            let reason = if mode < 4 { "points and lines reflect no light" } else { "it has no POSITION" };
            warnings.push(format!("{} is skipped: {reason}", primitive.name));
            continue;
        }
        if corners < 3 || (mode == 4 && corners % 3 != 0) {
            return Err(
                primitive.error(format!("has {corners} corners, which make no whole number of triangles"))
            );
        }
        triangles = triangles.saturating_add(if mode == 4 { corners / 3 } else { corners - 2 });
    }
    Ok(triangles)
}

/// Checks types and counts of the attributes that are read; returns the number of vertices, or `None` without
/// positions.
fn check_attributes(
    primitive: &Item,
    attributes: &Item,
    data: &Data,
    quantized: bool,
) -> Result<Option<u64>, SceneError> {
    let mut vertices: Option<(u64, &str)> = None;
    for key in attributes.keys() {
        let Some(i) = attributes.index(key, data.accessors.len(), "accessor")? else { continue };
        let a = &data.accessors[i];
        let texture_set = key.strip_prefix("TEXCOORD_").is_some();
        let dimensions = match key.as_str() {
            "POSITION" | "NORMAL" => 3,
            "TANGENT" => 4,
            // With alpha or without.
            "COLOR_0" if a.dimensions == 4 => 4,
            "COLOR_0" => 3,
            _ if texture_set => 2,
            // Joints and weights are checked with the skins.
            _ => continue,
        };
        let plain = a.component == Component::F32;
        let normalized_uv = (texture_set || key == "COLOR_0")
            && a.normalized
            && matches!(a.component, Component::U8 | Component::U16);
        let small = a.component != Component::U32 && (a.normalized || key == "POSITION" || texture_set);
        if a.dimensions != dimensions || !(plain || normalized_uv || quantized && small) {
            return Err(SceneError::broken(
                &a.name,
                format!(
                    "serves as {key} of {} with {} components of type {:?}; it must have {dimensions} of 32-bit float (small integers need KHR_mesh_quantization{})",
                    primitive.name,
                    a.dimensions,
                    a.component,
                    if texture_set || key == "COLOR_0" { ", or be normalized and unsigned" } else { "" }
                ),
            ));
        }
        if let Some((count, other)) = vertices.filter(|v| v.0 != a.count) {
            return Err(SceneError::broken(
                &a.name,
                format!("has {} elements for {key} of {}, but {other} has {count}", a.count, primitive.name),
            ));
        }
        vertices = Some((a.count, key));
    }
    Ok(vertices.filter(|_| attributes.get("POSITION").is_some()).map(|v| v.0))
}

/// Checks that the nodes form trees of bounded depth, that transforms are finite, and that all instances together are
/// within the limits.
fn check_nodes(
    root: &Item,
    nodes: &[Item],
    counts: &ObjectCounts,
    triangles: &[u64],
    instances: &Instances,
    limits: &Limits,
) -> Result<(), SceneError> {
    let mut children = Vec::with_capacity(nodes.len());
    let mut parent = vec![None; nodes.len()];
    let mut total_triangles = 0u64;
    let mut total_lights = 0u64;
    for (i, node) in nodes.iter().enumerate() {
        let below = node.indices("children", counts.nodes, "node")?;
        for &child in &below {
            if let Some(other) = parent[child].replace(i) {
                return Err(nodes[child]
                    .error(format!("is a child of both node {other} and node {i}; a node has one parent")));
            }
        }
        children.push(below);
        if let Some(mesh) = node.index("mesh", counts.meshes, "mesh")? {
            let times = instances.get(&i).map_or(1, |all| all.len() as u64);
            total_triangles = total_triangles.saturating_add(triangles[mesh].saturating_mul(times));
        }
        total_lights += u64::from(node.extension("KHR_lights_punctual")?.is_some());
        check_transform(node)?;
    }
    SceneError::check_limit(
        "the number of triangles with all instances",
        total_triangles,
        limits.triangles,
        "decimate the meshes or remove instances",
    )?;
    SceneError::check_limit(
        "the number of lights",
        total_lights,
        limits.lights,
        "use emissive surfaces or an environment image",
    )?;
    check_tree(root, nodes, &children, &parent, limits)?;
    check_scenes(root, counts, &parent, limits)
}

/// Checks that the nodes form trees of bounded depth. `children` and `parent` are those of each node.
fn check_tree(
    root: &Item,
    nodes: &[Item],
    children: &[Vec<usize>],
    parent: &[Option<usize>],
    limits: &Limits,
) -> Result<(), SceneError> {
    // The walk reaches every node once from the nodes without parent; an unreached node is part of a cycle.
    let mut reached = 0;
    let mut walk: Vec<(usize, u32)> =
        (0..nodes.len()).filter(|&i| parent[i].is_none()).map(|i| (i, 1)).collect();
    while let Some((i, depth)) = walk.pop() {
        if depth > limits.node_depth {
            return Err(
                nodes[i].error(format!("lies deeper than {} levels in the tree of nodes", limits.node_depth))
            );
        }
        reached += 1;
        walk.extend(children[i].iter().map(|&c| (c, depth + 1)));
    }
    if reached < nodes.len() {
        return Err(root
            .error(format!("{} of the nodes form a cycle of parents and children", nodes.len() - reached)));
    }
    Ok(())
}

/// Checks that scenes list nodes without a parent, each once.
fn check_scenes(
    root: &Item,
    counts: &ObjectCounts,
    parent: &[Option<usize>],
    limits: &Limits,
) -> Result<(), SceneError> {
    let scenes = root.list("scenes", "scene", limits.objects)?;
    root.index("scene", scenes.len(), "scene")?;
    for scene in &scenes {
        let mut seen = std::collections::HashSet::new();
        for i in scene.indices("nodes", counts.nodes, "node")? {
            if let Some(above) = parent[i] {
                return Err(scene.error(format!("lists node {i}, which is a child of node {above}")));
            }
            if !seen.insert(i) {
                return Err(scene.error(format!("lists node {i} twice")));
            }
        }
    }
    Ok(())
}

fn check_transform(node: &Item) -> Result<(), SceneError> {
    if let Some(m) = node.numbers::<16>("matrix")? {
        if [m[3], m[7], m[11], m[15]] != [0.0, 0.0, 0.0, 1.0] {
            return Err(node.error("'matrix' is a projection: its last row must be 0 0 0 1"));
        }
        if ["translation", "rotation", "scale"].iter().any(|k| node.get(k).is_some()) {
            return Err(node.error("has both a 'matrix' and a 'translation', 'rotation' or 'scale'"));
        }
    }
    node.numbers::<3>("translation")?;
    node.numbers::<3>("scale")?;
    if let Some(q) = node.numbers::<4>("rotation")? {
        let length = q.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt();
        if (length - 1.0).abs() > 0.05 {
            return Err(node.error(format!("'rotation' is a quaternion of length {length:.3}; it must be 1")));
        }
    }
    Ok(())
}
