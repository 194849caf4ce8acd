//! Which nodes of a file are the bodies of the rig file, and which are virtual.

use std::collections::HashSet;

use dpm_common::keys::read::nearest;
use glam::Vec3;

use super::super::super::names::{composed, nearly};
use super::super::super::{BodySelector, LoadOptions, SceneError};
use super::super::json::{shorten, Item};

/// Bodies that [`choose_bodies`] makes movable when the rig file names none.
const AUTO_BODIES: usize = 2;

/// Nodes claimed by rigid bodies and nodes that are virtual.
pub(crate) struct Claims {
    /// In the order of the rig file.
    pub(super) bodies: Vec<Claim>,
    pub(super) virtual_nodes: Vec<usize>,
}

pub(super) struct Claim {
    pub(super) name: String,
    pub(super) node: usize,
    pub(super) projected: bool,
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

fn is_scaled_to_nothing(node: &gltf::Node) -> bool {
    let m = node.transform().matrix();
    let columns = [m[0], m[1], m[2]].map(|c| Vec3::new(c[0], c[1], c[2]));
    let size: f32 = columns.iter().map(|c| c.length()).product();
    let volume = columns[0].cross(columns[1]).dot(columns[2]);
    !(size > 1e-30 && volume.abs() > 1e-12 * size)
}

/// Nodes that KHR_node_visibility hides, with all below them.
pub(crate) fn hidden(document: &gltf::Document, nodes: &[Item]) -> Result<HashSet<usize>, SceneError> {
    let mut hidden = HashSet::new();
    for (i, node) in nodes.iter().enumerate() {
        let Some(extension) = node.extension(VISIBILITY)? else { continue };
        if extension.get("visible").and_then(serde_json::Value::as_bool) == Some(false) {
            hidden.extend(descendants(document, &[i]));
        }
    }
    Ok(hidden)
}

/// The extension that hides nodes.
pub(crate) const VISIBILITY: &str = "KHR_node_visibility";

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
    hidden: &HashSet<usize>,
    options: &LoadOptions,
    warnings: &mut Vec<String>,
) -> Result<Claims, SceneError> {
    let roots = roots(document);
    let present = descendants(document, &roots);
    let names: Vec<Option<&str>> =
        present.iter().map(|&i| document.nodes().nth(i).and_then(|n| n.name())).collect();
    let find = |key: String, name: &str| find_node(&names, &present, key, name);
    let of_virtual = |(i, name): (usize, &String)| find(format!("scene.virtual_nodes.{i}"), name);
    let mut virtual_nodes =
        options.virtual_nodes.iter().enumerate().map(of_virtual).collect::<Result<Vec<_>, _>>()?;
    let known: HashSet<String> = names.iter().flatten().map(|name| composed(name)).collect();
    let named = |name: &str| known.contains(&composed(name));
    if options.bodies.iter().all(|b| b.node.is_none() && !named(&b.name)) {
        return Ok(choose_automatically(document, hidden, roots, virtual_nodes, &options.bodies, warnings));
    }
    let mut bodies: Vec<Claim> = vec![];
    for (i, BodySelector { name, node, projected }) in options.bodies.iter().enumerate() {
        let key = if node.is_some() { "node" } else { "name" };
        let node = node.as_ref().unwrap_or(name);
        let index = find(format!("scene.bodies.{i}.{key}"), node)?;
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

/// The only node named `name` in `present`; `names` holds the nodes' names. `key` of the rig file names it.
fn find_node(
    names: &[Option<&str>],
    present: &[usize],
    key: String,
    name: &str,
) -> Result<usize, SceneError> {
    let of = |is_it: &dyn Fn(&str) -> bool| -> Vec<usize> {
        present.iter().zip(names).filter(|(_, n)| n.is_some_and(is_it)).map(|(i, _)| *i).collect()
    };
    let mut matching = of(&|n| n == name);
    if matching.is_empty() {
        // Systems compose letters differently, and show both alike.
        matching = of(&|n| composed(n) == composed(name));
    }
    if let [one] = matching[..] {
        return Ok(one);
    }
    let known: Vec<String> = names.iter().flatten().take(30).map(|n| shorten(n)).collect();
    let all: Vec<&str> = names.iter().flatten().copied().collect();
    let problem = match matching.len() {
        0 => match nearly(name, all.iter().copied()).or_else(|| nearest(name, &all)) {
            Some(near) => format!("the scene has no node '{name}', did you mean '{near}'?"),
            None => format!("the scene has no node '{name}'"),
        },
        n => format!(
            "the scene has {n} nodes named '{name}', so which one is meant cannot be told: rename them"
        ),
    };
    Err(SceneError::Node {
        key,
        problem,
        known: if known.is_empty() { "none".into() } else { known.join(", ") },
    })
}

/// The first objects of the scene with a mesh become the given movable bodies, or, if none are given, two bodies with
/// the names of their nodes; lamps (all materials emit) become virtual.
fn choose_automatically(
    document: &gltf::Document,
    hidden: &HashSet<usize>,
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
        let is_nothing = document.nodes().nth(root).is_some_and(|n| is_scaled_to_nothing(&n));
        if materials.is_empty() || known_virtual.contains(&root) || hidden.contains(&root) || is_nothing {
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
