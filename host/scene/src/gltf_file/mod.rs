//! Reads a glTF file as a [`Scene`]: container, damage of the look left out, compressed meshes and textures in KTX2 made
//! plain, check, then the `gltf` crate's typed view of the checked document, look and geometry.

mod accessor;
mod amend_look;
mod animation;
mod bake;
mod bmp;
mod check;
mod clip;
mod compressed;
mod container;
mod deform;
mod flatten;
mod instancing;
mod json;
mod lobes;
mod look;
mod picture;
mod primitive;
mod spec_gloss;
mod texture_image;
mod vertex_paint;

use std::collections::HashMap;
use std::path::Path;

use serde_json::Value;

use super::limits::Cancel;
use super::lobes::MOST_ABSORPTION;
use super::{Environment, Limits, LoadOptions, Scene, SceneError, Texture};
use container::SideFolder;
use json::Item;

pub(super) use container::read_file;

/// The content of a URI: inline, or a file in the folder of `beside`.
pub(super) fn fetch_beside(uri: &str, beside: Option<&Path>, limit: u64) -> Result<Vec<u8>, SceneError> {
    container::fetch(uri, beside.map(SideFolder::of).transpose()?.as_ref(), limit)
}

/// `Ok` if an image, which `name` may tell more of, is of a format that is read and has no more texels than the limits allow.
pub(super) fn check_image(bytes: &[u8], name: &str, limits: &Limits) -> Result<(), SceneError> {
    let nothing = Value::Object(serde_json::Map::new());
    picture::check(&Item::new(&nothing, "picture".into())?, bytes, name, limits)
}

/// A picture of colours that is not part of a file, PNG, JPEG or KTX2, or an animated PNG; it repeats. `texels_so_far` counts
/// those of the scene.
pub(super) fn decode_picture(
    bytes: &[u8],
    texels_so_far: u64,
    limits: &Limits,
) -> Result<Texture, SceneError> {
    let nothing = Value::Object(serde_json::Map::new());
    let item = Item::new(&nothing, "picture".into())?;
    if let Some(clip) = clip::decode(&item, bytes, texels_so_far, limits)? {
        return Ok(clip);
    }
    let picture = picture::decode(&item, bytes, "", texels_so_far, limits)?;
    // Nobody would read a note.
    if let Some(stored) = picture.stored {
        picture::check_size(&item, stored, texels_so_far, limits)?;
    }
    let picture::Size { width, height } = picture.size;
    Ok(Texture::repeated([width, height], picture.texels, picture.srgb.unwrap_or(true)))
}

/// Checks that a picture of `size` fits beside the scene's other textures.
pub(super) fn check_picture(size: [u32; 2], texels_so_far: u64, limits: &Limits) -> Result<(), SceneError> {
    let nothing = Value::Object(serde_json::Map::new());
    let [width, height] = size;
    let size = picture::Size { width, height };
    picture::check_size(&Item::new(&nothing, "picture".into())?, size, texels_so_far, limits)
}

/// Maximum number of warnings of one kind from a hostile file.
const MAX_WARNINGS: usize = 100;

/// Reads `bytes`, the content of a `.glb` or `.gltf` file; side files are searched in the folder of `beside`.
pub(super) fn read(
    bytes: &[u8],
    beside: Option<&Path>,
    options: &LoadOptions,
    cancel: &Cancel,
) -> Result<Scene, SceneError> {
    let limits = &options.limits;
    let folder = beside.map(SideFolder::of).transpose()?;
    let container::Container { root: mut tree, binary, told } = container::split(bytes, limits)?;
    check::check_asset(&Item::new(&tree, "document".into())?)?;
    let left_out = amend_look::amend_look(&mut tree);
    let root = Item::new(&tree, "document".into())?;
    let (mut buffers, of_others) = container::load_buffers(&root, binary, folder.as_ref(), limits)?;
    compressed::decompress(&mut tree, &mut buffers, limits, cancel)?;
    texture_image::make_plain(&mut tree, limits)?;
    let root = Item::new(&tree, "document".into())?;
    let all_bytes = bytes.len() + buffers.iter().map(Vec::len).sum::<usize>();
    // Of a document that was made from another file, that file counts.
    let limits = &match limits.file_bytes {
        // What is unpacked allows triangles, but no picture.
        0 => Limits { file_bytes: bytes.len() as u64 + of_others, ..limits.of_file(all_bytes as u64) },
        of_source => limits.of_file(of_source),
    };
    let data = accessor::Data::new(&root, buffers, limits)?;
    let check::CheckResults { mut warnings, instances } = check::check(&root, &data, limits)?;
    warnings.extend(told.into_iter().chain(left_out));
    let nodes = root.list("nodes", "node", limits.objects)?;
    let animation = animation::read(&root, &data, &nodes, options, &mut warnings)?;
    let deformations = deform::Deformations::read(&root, &data, &nodes, limits, &mut warnings)?;
    cancel.check(limits)?;

    let typed: gltf::json::Root =
        serde_json::from_value(reduced(&tree)).map_err(|e| SceneError::broken("JSON", e.to_string()))?;
    let document = gltf::Document::from_json_without_validation(typed);
    let hidden = flatten::hidden(&document, &nodes)?;
    if !hidden.is_empty() {
        warnings.push(format!(
            "{} nodes that the file hides ({}) are left out",
            hidden.len(),
            flatten::VISIBILITY
        ));
    }
    let claims = flatten::choose_bodies(&document, &hidden, options, &mut warnings)?;
    let mut look = look::read_look(&document, &root, &data, folder.as_ref(), limits, cancel, &mut warnings)?;
    let world = flatten::world_from_file(options);
    absorb_by_metre(&mut look, options.scale.unwrap_or(1.0));
    let source = flatten::Source {
        document: &document,
        data: &data,
        look: &look,
        instances: &instances,
        animation: &animation,
        deformations: &deformations,
        hidden: &hidden,
        world,
    };
    let (flat, paint) = flatten::flatten(&source, &claims, limits, cancel, &mut warnings)?;
    paint.add_to(&mut look);
    Ok(Scene {
        bodies: flat.bodies,
        materials: look.materials,
        textures: look.textures,
        live: Vec::new(),
        lights: flat.lights,
        environment: Environment::default(),
        warnings: at_most(MAX_WARNINGS, grouped(warnings)),
    })
}

/// Light goes the further through a solid the larger the file's unit of `unit_m` metres makes it.
fn absorb_by_metre(look: &mut look::SceneLook, unit_m: f64) {
    for lobes in look.materials.iter_mut().map(|m| &mut m.lobes) {
        let per_metre = lobes.absorption.as_dvec3() / unit_m;
        lobes.absorption = per_metre.min(glam::DVec3::splat(f64::from(MOST_ABSORPTION))).as_vec3();
    }
}

/// The first of many warnings, and the number of the others.
fn at_most(most: usize, mut warnings: Vec<String>) -> Vec<String> {
    if warnings.len() > most {
        let more = warnings.len() - most;
        warnings.truncate(most);
        warnings.push(format!("and {more} more"));
    }
    warnings
}

/// Warnings that say the same of several objects as one that names the first of them.
fn grouped(warnings: Vec<String>) -> Vec<String> {
    let mut told: Vec<(String, String, usize)> = vec![];
    let mut places: HashMap<String, usize> = HashMap::new();
    for warning in warnings {
        // "material 3 'glass': ..." names an object, other lines with a colon do not.
        let named = |object: &str| {
            ["image ", "light ", "material ", "mesh ", "node ", "sampler ", "texture "]
                .iter()
                .any(|kind| object.starts_with(kind))
        };
        let (object, what) =
            warning.split_once(": ").filter(|(object, _)| named(object)).unwrap_or(("", &warning));
        match places.get(what).filter(|_| !object.is_empty()) {
            Some(&place) => told[place].2 += 1,
            None => {
                if !object.is_empty() {
                    places.insert(what.to_owned(), told.len());
                }
                told.push((object.to_owned(), what.to_owned(), 1));
            }
        }
    }
    let line = |(object, what, times): (String, String, usize)| match (object.as_str(), times) {
        ("", _) => what,
        (_, 1) => format!("{object}: {what}"),
        _ => format!("{object} and {} more: {what}", times - 1),
    };
    told.into_iter().map(line).collect()
}

/// The document without the parts that are read elsewhere or not at all, so that the crate never sees them.
fn reduced(tree: &Value) -> Value {
    let kept = [
        "asset",
        "scene",
        "scenes",
        "nodes",
        "meshes",
        "materials",
        "textures",
        "images",
        "samplers",
        "extensions",
    ];
    let mut top: serde_json::Map<String, Value> =
        kept.iter().filter_map(|key| Some(((*key).to_owned(), tree.get(key)?.clone()))).collect();
    // The version is checked by then, and nothing else of it is read.
    top.insert("asset".into(), serde_json::json!({"version": "2.0"}));
    let strip = |object: &mut Value, keys: &[&str]| {
        if let Some(object) = object.as_object_mut() {
            object.retain(|key, _| !keys.contains(&key.as_str()));
        }
    };
    let lists = |top: &mut serde_json::Map<String, Value>, list: &str, each: &mut dyn FnMut(&mut Value)| {
        top.get_mut(list).and_then(Value::as_array_mut).into_iter().flatten().for_each(each);
    };
    lists(&mut top, "nodes", &mut |node| strip(node, &["camera", "skin", "weights", "extras"]));
    lists(&mut top, "meshes", &mut |mesh| {
        strip(mesh, &["weights", "extras", "extensions"]);
        let primitives = mesh.get_mut("primitives").and_then(Value::as_array_mut).into_iter().flatten();
        primitives.for_each(|p| strip(p, &["targets", "extras", "extensions"]));
    });
    // The crate needs only the image's index; the bytes are fetched here.
    lists(&mut top, "images", &mut |image| *image = serde_json::json!({}));
    for list in ["scenes", "materials", "textures", "samplers"] {
        lists(&mut top, list, &mut |object| strip(object, &["extras"]));
    }
    lists(&mut top, "textures", &mut |texture| strip(texture, &["extensions"]));
    // A scene may have no nodes, and the crate wants the list.
    lists(&mut top, "scenes", &mut |scene| {
        if let Some(scene) = scene.as_object_mut() {
            scene.entry("nodes").or_insert_with(|| serde_json::json!([]));
        }
    });
    if let Some(extensions) = top.get_mut("extensions").and_then(Value::as_object_mut) {
        extensions.retain(|key, _| key == "KHR_lights_punctual");
    }
    Value::Object(top)
}

#[cfg(test)]
mod tests {
    use super::grouped;

    #[test]
    fn what_is_said_of_several_objects_is_said_once() {
        let said = [
            "material 0 'a': x is ignored",
            "y",
            "material 1: x is ignored",
            "mesh 2: z",
            "note: x is ignored",
            "y",
        ];
        let told = grouped(said.map(String::from).into());
        assert_eq!(
            told,
            ["material 0 'a' and 1 more: x is ignored", "y", "mesh 2: z", "note: x is ignored", "y"]
        );
    }
}
