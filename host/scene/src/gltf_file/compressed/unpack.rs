//! Puts meshes that were compressed by meshopt or Draco back into plain buffers, before anything else reads them.
//!
//! The document is rewritten as if it had never been compressed: a compressed buffer view points at a buffer of its own,
//! and the accessors of a Draco primitive get buffer views. Nothing of the compression is left for what comes after.

use draco_gltf::meshopt::{self, MeshoptFilter, MeshoptMode};
use draco_gltf::{ComponentType, DecodeLimits, DracoPrimitiveContract, DracoPrimitiveExtension, JsonValue};
use serde_json::{json, Value};

use super::super::super::limits::{largest_piece, Cancel};
use super::super::super::{Limits, SceneError};
use super::super::accessor::range_of;
use super::super::json::{shorten, shorten_to, Item};
use super::{DRACO, MESHOPT};

/// A byte that meshopt has stored stands for at most so many: a channel of 256 elements may take two bits.
const MOST_FROM_A_BYTE: u64 = 1024;

/// Decompresses what is compressed in `tree` and its `buffers`, to which the plain bytes are appended.
///
/// # Errors
/// Data that cannot be decoded, with the name of the buffer view or primitive; more bytes than `limits` allows.
pub(in super::super) fn decompress(
    tree: &mut Value,
    buffers: &mut Vec<Vec<u8>>,
    limits: &Limits,
    cancel: &Cancel,
) -> Result<(), SceneError> {
    let used = buffers.iter().map(|b| b.len() as u64).sum();
    let mut room = BytesLeft { used, limit: limits.bytes.min(largest_piece(used)) };
    for (view, bytes) in meshopt_views(tree, buffers, limits, &mut room, cancel)? {
        let plain = &mut list_mut(tree, "bufferViews")[view];
        plain["buffer"] = json!(buffers.len());
        plain["byteOffset"] = json!(0);
        plain["byteLength"] = json!(bytes.len());
        buffers.push(bytes);
    }
    for primitive in draco_primitives(tree, buffers, limits, &mut room, cancel)? {
        primitive.add_to(tree, buffers);
    }
    Ok(())
}

/// The bytes that may still be made.
struct BytesLeft {
    used: u64,
    limit: u64,
}

impl BytesLeft {
    fn take(&mut self, bytes: u64) -> Result<(), SceneError> {
        self.used = self.used.saturating_add(bytes);
        let what = "the size of all buffers in bytes, decompressed,";
        SceneError::check_limit(what, self.used, self.limit, "simplify the scene")
    }
}

/// Every buffer view that meshopt has compressed, with its plain bytes.
fn meshopt_views(
    tree: &Value,
    buffers: &[Vec<u8>],
    limits: &Limits,
    room: &mut BytesLeft,
    cancel: &Cancel,
) -> Result<Vec<(usize, Vec<u8>)>, SceneError> {
    let root = Item::new(tree, "document".into())?;
    let mut plain = vec![];
    for (i, view) in root.list("bufferViews", "bufferView", limits.objects)?.iter().enumerate() {
        for name in MESHOPT {
            if let Some(extension) = view.extension(name)? {
                cancel.check(limits)?;
                plain.push((i, meshopt_bytes(&extension, buffers, room)?));
                break;
            }
        }
    }
    Ok(plain)
}

/// The plain bytes of a buffer view with the extension `item`.
fn meshopt_bytes(item: &Item, buffers: &[Vec<u8>], room: &mut BytesLeft) -> Result<Vec<u8>, SceneError> {
    let needed = |key: &str| item.whole(key)?.ok_or_else(|| item.error(format!("has no '{key}'")));
    let source = bytes_of(item, buffers)?;
    let (count, stride) = (needed("count")?, needed("byteStride")?);
    let mode = item.text("mode")?.ok_or_else(|| item.error("has no 'mode'"))?;
    let mode = MeshoptMode::from_name(mode).map_err(|e| undecodable(item, e))?;
    let filter = item.text("filter")?.unwrap_or("NONE");
    let filter = MeshoptFilter::from_name(filter).map_err(|e| undecodable(item, e))?;
    let is_possible = match mode {
        MeshoptMode::Attributes => (4..=256).contains(&stride) && stride % 4 == 0,
        MeshoptMode::Triangles | MeshoptMode::Indices => stride == 2 || stride == 4,
    };
    if !is_possible {
        return Err(item.error(format!("'byteStride' is {stride}, which no stream of this mode can have")));
    }
    let size = count.saturating_mul(stride);
    if count == 0 || size > source.len() as u64 * MOST_FROM_A_BYTE {
        return Err(
            item.error(format!("promises {count} elements, which its {} bytes cannot hold", source.len()))
        );
    }
    room.take(size)?;
    let mut plain = vec![0; size as usize];
    meshopt::decode_buffer_view(&mut plain, source, mode, filter, count as usize, stride as usize)
        .map_err(|e| undecodable(item, e))?;
    Ok(plain)
}

/// Numbers of one accessor: their bytes without gaps.
struct Numbers {
    /// The accessor that the file has for them.
    accessor: Option<usize>,
    /// Type and component type as in an accessor.
    kind: &'static str,
    component: u32,
    count: usize,
    normalized: bool,
    bytes: Vec<u8>,
}

impl Numbers {
    /// Appends the bytes to `buffers`, and an accessor of them to the document, in the place of the file's own one where
    /// that is still empty. Returns the accessor's index.
    fn add_to(self, tree: &mut Value, buffers: &mut Vec<Vec<u8>>) -> usize {
        let views = list_mut(tree, "bufferViews");
        views.push(json!({"buffer": buffers.len(), "byteLength": self.bytes.len()}));
        let mut plain = json!({
            "bufferView": views.len() - 1, "componentType": self.component, "type": self.kind, "count": self.count,
        });
        if self.normalized {
            plain["normalized"] = json!(true);
        }
        buffers.push(self.bytes);
        let accessors = list_mut(tree, "accessors");
        match self.accessor {
            Some(own) if accessors[own].get("bufferView").is_none() => {
                accessors[own] = plain;
                own
            }
            _ => {
                accessors.push(plain);
                accessors.len() - 1
            }
        }
    }
}

/// What a primitive that Draco has compressed becomes.
struct Plain {
    mesh: usize,
    primitive: usize,
    /// By semantic. Nothing if the file has the numbers a second time, uncompressed.
    attributes: Vec<(String, Numbers)>,
    indices: Option<Numbers>,
}

impl Plain {
    /// Rewrites the primitive.
    fn add_to(self, tree: &mut Value, buffers: &mut Vec<Vec<u8>>) {
        let attributes: Vec<(String, usize)> =
            self.attributes.into_iter().map(|(name, n)| (name, n.add_to(tree, buffers))).collect();
        let indices = self.indices.map(|n| n.add_to(tree, buffers));
        let primitive = &mut tree["meshes"][self.mesh]["primitives"][self.primitive];
        for (name, accessor) in attributes {
            primitive["attributes"][name] = json!(accessor);
        }
        if let Some(accessor) = indices {
            primitive["indices"] = json!(accessor);
            // The decoder makes a list of triangles of every strip.
            primitive["mode"] = json!(4);
        }
        if let Some(extensions) = primitive["extensions"].as_object_mut() {
            extensions.remove(DRACO);
        }
    }
}

/// Every primitive that Draco has compressed, decoded.
fn draco_primitives(
    tree: &Value,
    buffers: &[Vec<u8>],
    limits: &Limits,
    room: &mut BytesLeft,
    cancel: &Cancel,
) -> Result<Vec<Plain>, SceneError> {
    let root = Item::new(tree, "document".into())?;
    let views = root.list("bufferViews", "bufferView", limits.objects)?;
    let accessors = root.list("accessors", "accessor", limits.objects)?;
    let mut plain = vec![];
    for (m, mesh) in root.list("meshes", "mesh", limits.objects)?.iter().enumerate() {
        for (p, mut item) in mesh.list("primitives", "primitive", limits.objects)?.into_iter().enumerate() {
            item.name = format!("{}, {}", mesh.name, item.name);
            let Some(extension) = item.extension(DRACO)? else { continue };
            cancel.check(limits)?;
            let source = Source { views: &views, accessors: &accessors, buffers, limits };
            let (attributes, indices) = source.decode(&item, &extension, room)?;
            plain.push(Plain { mesh: m, primitive: p, attributes, indices });
        }
    }
    Ok(plain)
}

/// Where Draco's data and what the file promises of it lie.
struct Source<'a> {
    views: &'a [Item<'a>],
    accessors: &'a [Item<'a>],
    buffers: &'a [Vec<u8>],
    limits: &'a Limits,
}

/// The attributes of a primitive by semantic, and its indices.
type Decoded = (Vec<(String, Numbers)>, Option<Numbers>);

impl Source<'_> {
    /// What the accessors of `attributes` promise, and how much the decoder may make.
    fn contract(&self, attributes: &Item, room: &BytesLeft) -> Result<DracoPrimitiveContract, SceneError> {
        let limits = DecodeLimits::default()
            .with_max_points(3 * self.limits.triangles)
            .with_max_faces(self.limits.triangles)
            .with_max_decoded_bytes(room.limit.saturating_sub(room.used));
        let mut contract = DracoPrimitiveContract::new().with_limits(limits);
        for name in attributes.keys() {
            let Some(i) = attributes.index(name, self.accessors.len(), "accessor")? else { continue };
            let count = self.accessors[i].whole("count")?.unwrap_or(0);
            contract = contract.with_attribute(name, count, self.accessors[i].flag("normalized")?);
        }
        Ok(contract)
    }

    /// Decodes the primitive `item`.
    fn decode(&self, item: &Item, extension: &Item, room: &mut BytesLeft) -> Result<Decoded, SceneError> {
        let attributes = item.object("attributes")?.ok_or_else(|| item.error("has no 'attributes'"))?;
        let own = |object: &Item, key: &str| object.index(key, self.accessors.len(), "accessor");
        // A file may hold the same numbers uncompressed, for programs without Draco.
        if own(&attributes, "POSITION")?.is_some_and(|i| self.accessors[i].get("bufferView").is_some()) {
            return Ok((vec![], None));
        }
        let view = extension
            .index("bufferView", self.views.len(), "bufferView")?
            .ok_or_else(|| extension.error("has no 'bufferView'"))?;
        let payload = bytes_of(&self.views[view], self.buffers)?;
        let contract = self.contract(&attributes, room)?;
        let geometry = JsonValue::parse(extension.to_json().as_bytes())
            .map_err(|e| undecodable(extension, e))
            .and_then(|v| DracoPrimitiveExtension::from_json(&v).map_err(|e| undecodable(extension, e)))?
            .decode(payload, &contract)
            .map_err(|e| undecodable(extension, e))?;
        let mut plain = vec![];
        for a in geometry.attributes() {
            let kind = kind_of(usize::from(a.components())).ok_or_else(|| {
                extension.error(format!("{} has {} components", shorten(a.semantic()), a.components()))
            })?;
            room.take(a.bytes().len() as u64)?;
            let numbers = Numbers {
                accessor: own(&attributes, a.semantic())?,
                kind,
                component: a.component_type() as u32,
                count: a.count(),
                normalized: a.normalized() && a.component_type() != ComponentType::F32,
                bytes: a.bytes().to_vec(),
            };
            plain.push((a.semantic().to_owned(), numbers));
        }
        let Some(indices) = geometry.indices() else { return Ok((plain, None)) };
        room.take(indices.bytes().len() as u64)?;
        let indices = Numbers {
            accessor: own(item, "indices")?,
            kind: "SCALAR",
            component: indices.component_type() as u32,
            count: indices.count(),
            normalized: false,
            bytes: indices.bytes().to_vec(),
        };
        Ok((plain, Some(indices)))
    }
}

/// The bytes of a buffer view, or of an object with the same members.
fn bytes_of<'a>(item: &Item, buffers: &'a [Vec<u8>]) -> Result<&'a [u8], SceneError> {
    let (buffer, start, length) = range_of(item, buffers)?;
    Ok(&buffers[buffer][start as usize..(start + length) as usize])
}

/// What a decoder says of `item`.
fn undecodable(item: &Item, why: impl std::fmt::Display) -> SceneError {
    item.error(format!("cannot be decoded: {}", shorten_to(&why.to_string(), 200)))
}

/// The type of an accessor of so many components.
fn kind_of(components: usize) -> Option<&'static str> {
    ["SCALAR", "VEC2", "VEC3", "VEC4"].get(components.checked_sub(1)?).copied()
}

/// A list at the top of the document, made if the file has none.
fn list_mut<'a>(tree: &'a mut Value, key: &str) -> &'a mut Vec<Value> {
    if !tree[key].is_array() {
        tree[key] = Value::Array(vec![]);
    }
    match &mut tree[key] {
        Value::Array(list) => list,
        _ => unreachable!("made above"),
    }
}
