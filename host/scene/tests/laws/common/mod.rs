//! Builds small glTF files in memory, good and bad.
#![allow(dead_code)]

use glam::{DAffine3, DMat4, DQuat, DVec3};
use serde_json::{json, Value};

/// A document and its binary chunk.
#[derive(Clone)]
pub(crate) struct Glb {
    /// The JSON part.
    pub json: Value,
    /// The binary part.
    pub bin: Vec<u8>,
}

/// The corners of a tetrahedron with its faces counter-clockwise from outside.
pub(crate) const TETRAHEDRON: ([[f32; 3]; 4], [u16; 12]) = (
    [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]],
    [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3],
);

/// Two nodes, "left" and "right", with one tetrahedron mesh: positions (accessor 0), texture coordinates (1), indices (2).
pub(crate) fn tetrahedra() -> Glb {
    let mut bin = vec![];
    let (corners, indices) = TETRAHEDRON;
    corners.iter().flatten().for_each(|x| bin.extend(x.to_le_bytes()));
    corners.iter().for_each(|c| bin.extend([c[0] * 10.0, c[1] * 10.0].map(f32::to_le_bytes).concat()));
    indices.iter().for_each(|i| bin.extend(i.to_le_bytes()));
    let json = json!({
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [
            {"name": "left", "mesh": 0, "translation": [-0.2, 0.0, 0.0]},
            {"name": "right", "mesh": 0, "translation": [0.2, 0.0, 0.0]}],
        "meshes": [{"name": "tetrahedron", "primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [{"name": "paint", "pbrMetallicRoughness": {"baseColorFactor": [0.8, 0.4, 0.2, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.5}}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4, "min": [0, 0, 0], "max": [0.1, 0.1, 0.1]},
            {"bufferView": 1, "componentType": 5126, "type": "VEC2", "count": 4},
            {"bufferView": 2, "componentType": 5123, "type": "SCALAR", "count": 12}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 32},
            {"buffer": 0, "byteOffset": 80, "byteLength": 24}],
        "buffers": [{"byteLength": 104}]
    });
    Glb { json, bin }
}

impl Glb {
    /// A document without anything.
    pub(crate) fn empty() -> Self {
        let json = json!({"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "accessors": [], "bufferViews": [],
            "buffers": [{"byteLength": 0}]});
        Self { json, bin: vec![] }
    }

    /// Appends the accessors of a cube about the origin; returns a primitive of it without a material.
    pub(crate) fn push_cube(&mut self, half: f32) -> Value {
        let side = |high: usize| if high == 1 { half } else { -half };
        let corners: Vec<f32> = (0..8).flat_map(|i| [i & 1, i >> 1 & 1, i >> 2 & 1].map(side)).collect();
        let faces = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        let (corners, faces) = (self.push_numbers("VEC3", &corners), self.push_quads(&faces));
        json!({"attributes": {"POSITION": corners}, "indices": faces})
    }

    /// Appends the triangles of quads as indices.
    pub(crate) fn push_quads(&mut self, quads: &[[u8; 4]]) -> usize {
        let halves: Vec<u8> = quads.iter().flat_map(|[a, b, c, d]| [*a, *b, *c, *a, *c, *d]).collect();
        self.push_bytes("SCALAR", &halves)
    }

    /// The file's bytes.
    pub(crate) fn bytes(&self) -> Vec<u8> {
        let mut text = serde_json::to_vec(&self.json).unwrap();
        text.resize(text.len().next_multiple_of(4), b' ');
        glb(&text, Some(&self.bin))
    }

    /// Sets the value at a JSON pointer; the last step may be new.
    pub(crate) fn set(mut self, pointer: &str, value: Value) -> Self {
        let (parent, key) = pointer.rsplit_once('/').unwrap();
        let parent = self.json.pointer_mut(parent).unwrap_or_else(|| panic!("{pointer}: no such place"));
        match parent {
            Value::Array(list) => {
                let i: usize = key.parse().unwrap();
                if i == list.len() {
                    list.push(value);
                } else {
                    list[i] = value;
                }
            }
            other => other[key] = value,
        }
        self
    }

    /// Appends bytes to the binary part as a new buffer view and returns its index.
    pub(crate) fn push_view(&mut self, bytes: &[u8]) -> usize {
        let start = self.bin.len().next_multiple_of(4);
        self.bin.resize(start, 0);
        self.bin.extend(bytes);
        self.json["buffers"][0]["byteLength"] = json!(self.bin.len());
        let views = self.json["bufferViews"].as_array_mut().unwrap();
        views.push(json!({"buffer": 0, "byteOffset": start, "byteLength": bytes.len()}));
        views.len() - 1
    }

    /// Appends floats as an accessor and returns its index.
    pub(crate) fn push_numbers(&mut self, kind: &str, values: &[f32]) -> usize {
        let bytes: Vec<u8> = values.iter().flat_map(|x| x.to_le_bytes()).collect();
        self.push_elements(kind, 5126, &bytes, values.len())
    }

    /// Appends small integers as an accessor and returns its index.
    pub(crate) fn push_bytes(&mut self, kind: &str, values: &[u8]) -> usize {
        self.push_elements(kind, 5121, values, values.len())
    }

    fn push_elements(&mut self, kind: &str, component: u32, bytes: &[u8], values: usize) -> usize {
        let view = self.push_view(bytes);
        let components = match kind {
            "SCALAR" => 1,
            "VEC2" => 2,
            "VEC3" => 3,
            "VEC4" => 4,
            "MAT4" => 16,
            other => panic!("{other}"),
        };
        let accessors = self.json["accessors"].as_array_mut().unwrap();
        accessors.push(
            json!({"bufferView": view, "componentType": component, "type": kind, "count": values / components}),
        );
        accessors.len() - 1
    }
}

/// Wraps JSON text and a binary part without looking at them.
pub(crate) fn glb(text: &[u8], bin: Option<&[u8]>) -> Vec<u8> {
    let mut chunks = vec![];
    for (kind, content) in [(b"JSON", Some(text)), (b"BIN\0", bin)] {
        if let Some(content) = content {
            chunks.extend((content.len() as u32).to_le_bytes());
            chunks.extend(kind);
            chunks.extend(content);
        }
    }
    let mut out = b"glTF".to_vec();
    out.extend(2u32.to_le_bytes());
    out.extend((12 + chunks.len() as u32).to_le_bytes());
    out.extend(chunks);
    out
}

/// A PNG of the given texels.
pub(crate) fn png(width: u32, height: u32, texels: &[[u8; 4]]) -> Vec<u8> {
    let mut out = std::io::Cursor::new(vec![]);
    image::RgbaImage::from_raw(width, height, texels.concat())
        .unwrap()
        .write_to(&mut out, image::ImageFormat::Png)
        .unwrap();
    out.into_inner()
}

/// The shares by which the corners of [`with_skin`] hang on its two joints. Those of the second corner do not add up to 1, and
/// mean shares.
pub(crate) const SHARES: [[f32; 4]; 4] =
    [[1.0, 0.0, 0.0, 0.0], [0.5, 1.5, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.75, 0.25, 0.0, 0.0]];

/// Where the mesh of [`with_skin`] lay when it was bound to its two joints: joint-from-mesh of each.
pub(crate) fn binds() -> [DAffine3; 2] {
    [
        DAffine3::from_rotation_translation(DQuat::from_rotation_y(0.3), DVec3::new(0.0, -0.1, 0.0)),
        DAffine3::from_translation(DVec3::new(0.0, 0.05, -0.2)),
    ]
}

/// The right one of [`tetrahedra`] hangs on two joints, the nodes 2 and 3, of which the second hangs on the first; their
/// places are those of the JSON given. Its mesh is 1, so that the left one stays as it is.
pub(crate) fn with_skin(shoulder: Value, elbow: Value) -> Glb {
    let mut glb = tetrahedra();
    let matrices: Vec<f32> =
        binds().iter().flat_map(|m| DMat4::from(*m).to_cols_array().map(|x| x as f32)).collect();
    let bind = glb.push_numbers("MAT4", &matrices);
    let joints = glb.push_bytes("VEC4", &[0, 1, 0, 0].repeat(4));
    let shares = glb.push_numbers("VEC4", SHARES.as_flattened());
    let mut mesh = glb.json["meshes"][0].clone();
    mesh["primitives"][0]["attributes"]["JOINTS_0"] = json!(joints);
    mesh["primitives"][0]["attributes"]["WEIGHTS_0"] = json!(shares);
    glb.set("/nodes/1/skin", json!(0))
        .set("/nodes/1/mesh", json!(1))
        .set("/nodes/2", shoulder)
        .set("/nodes/2/children", json!([3]))
        .set("/nodes/3", elbow)
        .set("/scenes/0/nodes", json!([0, 1, 2]))
        .set("/skins", json!([{"joints": [2, 3], "inverseBindMatrices": bind}]))
        .set("/meshes/1", mesh)
}

/// Where the corners of the tetrahedron lie if `corners` of them hang by [`SHARES`] on joints at these places.
pub(crate) fn skinned(corners: [DVec3; 4], joints: [DAffine3; 2]) -> [DVec3; 4] {
    let maps = [joints[0] * binds()[0], joints[1] * binds()[1]];
    std::array::from_fn(|i| {
        let share = SHARES[i].map(|w| f64::from(w / SHARES[i].iter().sum::<f32>()));
        share[0] * maps[0].transform_point3(corners[i]) + share[1] * maps[1].transform_point3(corners[i])
    })
}

/// A file whose only material shows the image with these bytes.
pub(crate) fn with_image(bytes: &[u8]) -> Glb {
    let mut file = tetrahedra();
    let view = file.push_view(bytes);
    file.set("/images", json!([{"bufferView": view}]))
        .set("/textures", json!([{"source": 0}]))
        .set("/materials/0/pbrMetallicRoughness/baseColorTexture", json!({"index": 0}))
}

/// A file whose only texture has the extension, without an image for programs that do not know it.
pub(crate) fn with_ktx2(bytes: &[u8]) -> Glb {
    let name = "KHR_texture_basisu";
    with_image(bytes)
        .set("/images/0/mimeType", json!("image/ktx2"))
        .set("/textures", json!([{"extensions": {name: {"source": 0}}}]))
        .set("/extensionsUsed", json!([name]))
        .set("/extensionsRequired", json!([name]))
}

/// A KTX2 file of one level with texels in sRGB of a format that Vulkan has a name for. `scheme` is its supercompression.
pub(crate) fn ktx2(format: u32, width: u32, height: u32, scheme: u32, data: &[u8]) -> Vec<u8> {
    let words = |w: &[u32]| w.iter().flat_map(|w| w.to_le_bytes()).collect::<Vec<u8>>();
    let sample = [7 << 16, 0, 0, 255];
    let descriptor = words(&[&[44, 0, 2 | 40 << 16, 1 | 1 << 8 | 2 << 16, 0, 4, 0][..], &sample].concat());
    let head = words(&[
        format,
        1,
        width,
        height,
        0,
        0,
        1,
        1,
        scheme,
        104,
        descriptor.len() as u32,
        0,
        0,
        0,
        0,
        0,
        0,
    ]);
    let at = 104 + descriptor.len() as u64;
    let level = [at, data.len() as u64, data.len() as u64].map(u64::to_le_bytes).concat();
    [&b"\xabKTX 20\xbb\r\n\x1a\n"[..], &head, &level, &descriptor, data].concat()
}

/// `bytes` with the word at `at` set to `value`.
pub(crate) fn changed(bytes: &[u8], at: usize, value: u32) -> Vec<u8> {
    let mut out = bytes.to_vec();
    out[at..at + 4].copy_from_slice(&value.to_le_bytes());
    out
}

/// Base64 with padding.
pub(crate) fn base64(bytes: &[u8]) -> String {
    const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::new();
    for group in bytes.chunks(3) {
        let bits = group.iter().enumerate().fold(0u32, |b, (k, &x)| b | u32::from(x) << (16 - 8 * k));
        for k in 0..4 {
            out.push(if k <= group.len() {
                ALPHABET[(bits >> (18 - 6 * k) & 63) as usize] as char
            } else {
                '='
            });
        }
    }
    out
}

/// Numbers that look random (xorshift), by which tests damage files. The seed is not 0.
pub(crate) fn chance(mut state: u64) -> impl FnMut() -> usize {
    move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state as usize
    }
}
