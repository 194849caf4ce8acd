//! Which nodes of a file are the bodies of the rig file, and which are virtual.

use std::collections::HashSet;

use dpm_common::keys::read::nearest;
use glam::Vec3;

use super::super::super::{BodySelector, LoadOptions, SceneError};
use super::super::json::shorten;

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
    let find = |key: String, name: &str| find_node(&names, &present, key, name);
    let of_virtual = |(i, name): (usize, &String)| find(format!("scene.virtual_nodes.{i}"), name);
    let mut virtual_nodes =
        options.virtual_nodes.iter().enumerate().map(of_virtual).collect::<Result<Vec<_>, _>>()?;
    let known: HashSet<&str> = names.iter().copied().flatten().collect();
    let named = |name: &str| known.contains(name);
    if options.bodies.iter().all(|b| b.node.is_none() && !named(&b.name)) {
        return Ok(choose_automatically(document, roots, virtual_nodes, &options.bodies, warnings));
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
    let matching: Vec<usize> =
        present.iter().zip(names).filter(|(_, n)| **n == Some(name)).map(|(i, _)| *i).collect();
    if let [one] = matching[..] {
        return Ok(one);
    }
    let known: Vec<String> = names.iter().flatten().take(30).map(|n| shorten(n)).collect();
    let all: Vec<&str> = names.iter().flatten().copied().collect();
    let problem = match matching.len() {
        0 => match nearest(name, &all) {
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
