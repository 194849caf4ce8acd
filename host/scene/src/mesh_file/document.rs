//! Objects of a mesh file as a glTF document in memory, so that one reader checks, limits and places the content of every
//! format.

use serde_json::{json, Value};
use std::collections::BTreeMap;

/// Triangles of one material.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct MaterialTriangles {
    /// Index into [`Document::materials`]; `None`: plain white.
    pub material: Option<usize>,
    /// In the file's own unit and axes.
    pub positions: Vec<[f32; 3]>,
    /// One for each position, or none at all: then faces are flat.
    pub normals: Vec<[f32; 3]>,
    /// One for each position, or none at all; v points down.
    pub uvs: Vec<[f32; 2]>,
    /// Linear colours, one for each position, or none at all.
    pub colours: Vec<[f32; 3]>,
    /// Indices of positions; each is below their number.
    pub triangles: Vec<[u32; 3]>,
}

/// Parts that belong together, under one name.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Object {
    /// Name of the node.
    pub name: String,
    /// At least one with a triangle, or the object is left out.
    pub parts: Vec<MaterialTriangles>,
}

/// What a mesh file holds.
#[derive(Debug, Default)]
pub(super) struct Document {
    /// The nodes, in the order of the file.
    pub objects: Vec<Object>,
    /// glTF materials as JSON.
    pub materials: Vec<Value>,
    /// URIs of images, one for each texture.
    pub textures: Vec<String>,
    /// What was taken off all positions, in the file's own unit and axes.
    pub offset: [f64; 3],
    /// What is not reproduced, for the operator.
    pub warnings: Vec<String>,
}

/// The binary chunk of a document, and the views and accessors into it.
#[derive(Default)]
struct Binary {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Binary {
    /// Adds a list of numbers of four bytes; gives its accessor.
    fn add<const N: usize, T: Copy>(
        &mut self,
        list: &[[T; N]],
        bytes: impl Fn(T) -> [u8; 4],
        (component, kind): (u32, &str),
    ) -> usize {
        let start = self.bytes.len();
        self.bytes.extend(list.iter().flatten().flat_map(|x| bytes(*x)));
        self.views.push(json!({"buffer": 0, "byteOffset": start, "byteLength": self.bytes.len() - start}));
        let count = if kind == "SCALAR" { list.len() * N } else { list.len() };
        let view = self.views.len() - 1;
        self.accessors
            .push(json!({"bufferView": view, "componentType": component, "type": kind, "count": count}));
        self.accessors.len() - 1
    }

    fn floats<const N: usize>(&mut self, list: &[[f32; N]], kind: &str) -> usize {
        self.add(list, f32::to_le_bytes, (5126, kind))
    }
}

impl Document {
    /// The greatest and the smallest of all finite coordinates on each axis; `None` if there are none.
    pub(super) fn bounds(&self) -> Option<([f32; 3], [f32; 3])> {
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        let parts = self.objects.iter().flat_map(|object| &object.parts);
        for p in parts.flat_map(|part| &part.positions).filter(|p| p.iter().all(|x| x.is_finite())) {
            for axis in 0..3 {
                low[axis] = low[axis].min(p[axis]);
                high[axis] = high[axis].max(p[axis]);
            }
        }
        (low[0] <= high[0]).then_some((low, high))
    }

    /// Makes one object of all, and one part of all triangles of a material.
    pub(super) fn join(&mut self, name: String) {
        self.warnings.push(format!("the file has {} objects; all are read as one", self.objects.len()));
        let mut joined: BTreeMap<(Option<usize>, [bool; 3]), MaterialTriangles> = BTreeMap::new();
        for part in self.objects.drain(..).flat_map(|object| object.parts) {
            // What a part lacks has no value that would stand for it.
            let has =
                [part.normals.is_empty(), part.uvs.is_empty(), part.colours.is_empty()].map(|empty| !empty);
            let to = joined.entry((part.material, has)).or_default();
            let first = to.positions.len() as u32;
            to.material = part.material;
            to.triangles.extend(part.triangles.iter().map(|corners| corners.map(|corner| first + corner)));
            to.positions.extend(part.positions);
            to.normals.extend(part.normals);
            to.uvs.extend(part.uvs);
            to.colours.extend(part.colours);
        }
        self.objects = vec![Object { name, parts: joined.into_values().collect() }];
    }

    /// Scanners write the same colours twice, as a texture and at vertices, and no format but glTF says that one multiplies the other:
    /// the texture alone counts.
    pub(super) fn drop_colours_beside_textures(&mut self) {
        let is_textured = |material: usize| {
            let texture =
                self.materials.get(material).map(|m| &m["pbrMetallicRoughness"]["baseColorTexture"]);
            texture.is_some_and(|texture| !texture.is_null())
        };
        let mut dropped = 0;
        for part in self.objects.iter_mut().flat_map(|object| &mut object.parts) {
            if !part.colours.is_empty() && part.material.is_some_and(is_textured) {
                part.colours = vec![];
                dropped += 1;
            }
        }
        if dropped > 0 {
            self.warnings.push("colours of vertices or faces are not used beside the texture".into());
        }
    }

    /// The document as the bytes of a `.glb`.
    pub(super) fn to_glb(&self) -> Vec<u8> {
        let mut binary = Binary::default();
        let (mut nodes, mut meshes) = (vec![], vec![]);
        for object in &self.objects {
            let parts = object.parts.iter().filter(|part| !part.triangles.is_empty());
            let primitives: Vec<Value> = parts.map(|part| primitive(part, &mut binary)).collect();
            if !primitives.is_empty() {
                nodes.push(json!({"name": object.name, "mesh": meshes.len()}));
                meshes.push(json!({"primitives": primitives}));
            }
        }
        let images: Vec<Value> = self.textures.iter().map(|uri| json!({"uri": uri})).collect();
        let textures: Vec<Value> = (0..images.len()).map(|i| json!({"source": i})).collect();
        let root = json!({
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": (0..nodes.len()).collect::<Vec<_>>()}],
            "nodes": nodes, "meshes": meshes, "materials": self.materials, "textures": textures, "images": images,
            "buffers": [{"byteLength": binary.bytes.len()}],
            "bufferViews": binary.views, "accessors": binary.accessors,
        });
        glb(&root.to_string(), &binary.bytes)
    }
}

fn primitive(part: &MaterialTriangles, binary: &mut Binary) -> Value {
    let mut attributes = json!({"POSITION": binary.floats(&part.positions, "VEC3")});
    if !part.normals.is_empty() {
        attributes["NORMAL"] = binary.floats(&part.normals, "VEC3").into();
    }
    if !part.uvs.is_empty() {
        attributes["TEXCOORD_0"] = binary.floats(&part.uvs, "VEC2").into();
    }
    if !part.colours.is_empty() {
        attributes["COLOR_0"] = binary.floats(&part.colours, "VEC3").into();
    }
    let indices = binary.add(&part.triangles, u32::to_le_bytes, (5125, "SCALAR"));
    let mut primitive = json!({"attributes": attributes, "indices": indices});
    if let Some(material) = part.material {
        primitive["material"] = material.into();
    }
    primitive
}

/// The two chunks of a `.glb`, padded to four bytes.
fn glb(json: &str, binary: &[u8]) -> Vec<u8> {
    let mut text = json.as_bytes().to_vec();
    text.resize(text.len().next_multiple_of(4), b' ');
    let length = 12 + 8 + text.len() + 8 + binary.len();
    let mut out = Vec::with_capacity(length);
    out.extend(b"glTF");
    for (size, kind, chunk) in [(text.len(), b"JSON", &text[..]), (binary.len(), b"BIN\0", binary)] {
        if out.len() == 4 {
            out.extend(2u32.to_le_bytes());
            out.extend((length as u32).to_le_bytes());
        }
        out.extend((size as u32).to_le_bytes());
        out.extend(kind);
        out.extend(chunk);
    }
    out
}

/// Unit normals of a smooth surface: at each vertex the mean of the faces around it, weighted by area; zero where there is
/// none, which the reader of glTF repairs.
pub(super) fn smooth_normals(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Vec<[f32; 3]> {
    use glam::{DVec3, Vec3};
    let at = |i: u32| Vec3::from(positions[i as usize]).as_dvec3();
    let mut sum = vec![DVec3::ZERO; positions.len()];
    for &[a, b, c] in triangles {
        let area = (at(b) - at(a)).cross(at(c) - at(a));
        for i in [a, b, c] {
            sum[i as usize] += area;
        }
    }
    sum.into_iter().map(|n| n.normalize_or_zero().as_vec3().to_array()).collect()
}
