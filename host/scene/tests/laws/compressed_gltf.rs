//! Meshes that Draco or meshopt has compressed are those that were put in, and broken ones are refused by name. meshopt's
//! streams are made here by another library than the one that reads them.

use crate::common::{tetrahedra, Glb};
use dpm_scene::{LoadOptions, Scene, SceneError};
use draco_gltf::{
    ComponentType, CompressionOptions, DracoPrimitiveEncoding, PackedAttribute, PackedGeometry,
    PackedIndices, PrimitiveMode, QuantizationBits,
};
use meshopt_rs::index::buffer::{encode_index_buffer, encode_index_buffer_bound};
use meshopt_rs::index::sequence::{encode_index_sequence, encode_index_sequence_bound};
use meshopt_rs::index::IndexEncodingVersion;
use meshopt_rs::vertex::buffer::{encode_vertex_buffer, encode_vertex_buffer_bound};
use meshopt_rs::vertex::VertexEncodingVersion;
use proptest::prelude::*;
use serde_json::{json, Value};
use test_meter::core_seconds;

/// Vertices along each side of the sheet.
const SIDE: u32 = 24;

/// A wavy sheet: positions in metres, texture coordinates, triangles.
fn sheet() -> (Vec<[f32; 3]>, Vec<[f32; 2]>, Vec<u32>) {
    let at = |i: u32, j: u32| [i, j].map(|k| k as f32 / (SIDE - 1) as f32);
    let grid = || (0..SIDE).flat_map(|j| (0..SIDE).map(move |i| (i, j)));
    let positions = grid().map(|(i, j)| {
        let [x, y] = at(i, j);
        [0.2 * x, 0.2 * y, 0.02 * (9.0 * x).sin() * (7.0 * y).cos()]
    });
    let quads = (0..SIDE - 1).flat_map(|j| (0..SIDE - 1).map(move |i| j * SIDE + i));
    let triangles = quads.flat_map(|k| [k, k + 1, k + SIDE, k + 1, k + SIDE + 1, k + SIDE]);
    (positions.collect(), grid().map(|(i, j)| at(i, j)).collect(), triangles.collect())
}

fn bytes_of(numbers: impl IntoIterator<Item = f32>) -> Vec<u8> {
    numbers.into_iter().flat_map(f32::to_le_bytes).collect()
}

/// A file with the sheet, whose three accessors have no buffer views.
fn bare() -> Glb {
    let (positions, _, triangles) = sheet();
    let mut file = tetrahedra();
    file.bin.clear();
    file.set("/bufferViews", json!([])).set("/buffers", json!([{"byteLength": 0}])).set(
        "/accessors",
        json!([
            {"componentType": 5126, "type": "VEC3", "count": positions.len(), "min": [0, 0, -0.02], "max": [0.2, 0.2, 0.02]},
            {"componentType": 5126, "type": "VEC2", "count": positions.len()},
            {"componentType": 5125, "type": "SCALAR", "count": triangles.len()}]),
    )
}

/// The sheet without compression.
fn plain() -> Glb {
    let (positions, uvs, triangles) = sheet();
    let mut file = bare();
    let views = [
        bytes_of(positions.into_iter().flatten()),
        bytes_of(uvs.into_iter().flatten()),
        triangles.into_iter().flat_map(u32::to_le_bytes).collect(),
    ];
    for (i, bytes) in views.iter().enumerate() {
        file.json["accessors"][i]["bufferView"] = json!(file.push_view(bytes));
    }
    file
}

/// The sheet by meshopt, as gltfpack writes it: the plain bytes would lie in a second buffer, which the file does not
/// have. `sequence`: indices without assumptions, of 2 bytes.
fn by_meshopt(extension: &str, sequence: bool) -> Glb {
    let (positions, uvs, triangles) = sheet();
    fn vertices<T>(values: &[T]) -> Vec<u8> {
        let mut out = vec![0; encode_vertex_buffer_bound(values.len(), size_of::<T>())];
        let length = encode_vertex_buffer(&mut out, values, VertexEncodingVersion::V0).unwrap();
        out.truncate(length);
        out
    }
    let mut indices = vec![0; 8 * encode_index_buffer_bound(triangles.len(), positions.len())];
    let (mode, width) = if sequence {
        assert!(encode_index_sequence_bound(triangles.len(), positions.len()) <= indices.len());
        let length = encode_index_sequence(&mut indices, &triangles, IndexEncodingVersion::V1);
        indices.truncate(length);
        ("INDICES", 2)
    } else {
        let length = encode_index_buffer(&mut indices, &triangles, IndexEncodingVersion::V1).unwrap();
        indices.truncate(length);
        ("TRIANGLES", 4)
    };
    let count = [positions.len(), uvs.len(), triangles.len()];
    let streams =
        [(vertices(&positions), "ATTRIBUTES", 12), (vertices(&uvs), "ATTRIBUTES", 8), (indices, mode, width)];
    let mut file = bare();
    file.json["accessors"][2]["componentType"] = json!(if sequence { 5123 } else { 5125 });
    let mut offset = 0;
    for (i, (bytes, mode, stride)) in streams.iter().enumerate() {
        let view = file.push_view(bytes);
        let stored = file.json["bufferViews"][view].clone();
        let size = count[i] * stride;
        file.json["bufferViews"][view] = json!({
            "buffer": 1, "byteOffset": offset, "byteLength": size,
            "extensions": {extension: {
                "buffer": 0, "byteOffset": stored["byteOffset"], "byteLength": bytes.len(), "byteStride": stride,
                "mode": mode, "count": count[i],
            }},
        });
        if *mode == "ATTRIBUTES" {
            file.json["bufferViews"][view]["byteStride"] = json!(stride);
        }
        file.json["accessors"][i]["bufferView"] = json!(view);
        offset += size;
    }
    file.json["buffers"] = json!([
        file.json["buffers"][0],
        {"byteLength": offset, "extensions": {extension: {"fallback": true}}},
    ]);
    file.set("/extensionsRequired", json!([extension])).set("/extensionsUsed", json!([extension]))
}

/// The sheet by Draco, as Blender and glTF-Pipeline write it.
fn by_draco() -> Glb {
    let (positions, uvs, triangles) = sheet();
    let attribute = |name, components, bytes| {
        PackedAttribute::new(name, positions.len(), components, ComponentType::F32, false, bytes).unwrap()
    };
    let indices = triangles.iter().flat_map(|i| i.to_le_bytes()).collect();
    let geometry = PackedGeometry::new(
        PrimitiveMode::Triangles,
        vec![
            attribute("POSITION", 3, bytes_of(positions.iter().copied().flatten())),
            attribute("TEXCOORD_0", 2, bytes_of(uvs.iter().copied().flatten())),
        ],
        Some(PackedIndices::new(triangles.len(), ComponentType::U32, indices).unwrap()),
    )
    .unwrap();
    // As many bits as Blender takes.
    let quantization =
        QuantizationBits { position: Some(14), tex_coord: Some(12), ..QuantizationBits::default() };
    let options = CompressionOptions { quantization, ..CompressionOptions::default() };
    let encoded = DracoPrimitiveEncoding::encode(&geometry, &options).unwrap();
    let mut file = bare();
    let view = file.push_view(encoded.bytes());
    let stored = encoded.extension(view);
    let ids: serde_json::Map<String, Value> =
        stored.attributes().map(|(name, id)| (name.to_owned(), json!(id))).collect();
    let extension = json!({"bufferView": view, "attributes": ids});
    file.set("/meshes/0/primitives/0/extensions", json!({"KHR_draco_mesh_compression": extension}))
        .set("/extensionsRequired", json!(["KHR_draco_mesh_compression"]))
        .set("/extensionsUsed", json!(["KHR_draco_mesh_compression"]))
}

fn load(file: &Glb) -> Scene {
    dpm_scene::load_bytes(&file.bytes(), &LoadOptions::default()).unwrap()
}

fn refusal(file: &Glb) -> String {
    let start = core_seconds();
    let Err(error) = dpm_scene::load_bytes(&file.bytes(), &LoadOptions::default()) else {
        panic!("a broken file was accepted")
    };
    assert!(core_seconds() - start < 5.0, "took {:.1} core-seconds", core_seconds() - start);
    assert!(!matches!(error, SceneError::Internal(_)), "{error}");
    error.to_string()
}

/// The corners of every triangle with their texture coordinates, in an order that does not depend on the file's: each
/// triangle begins with its least corner, and the triangles are sorted. Lengths are rounded to `step`.
fn corners(scene: &Scene, step: f32) -> Vec<[[i64; 5]; 3]> {
    let mesh = &scene.bodies[0].mesh;
    let round = |x: f32| (x / step).round() as i64;
    let corner = |i: u32| {
        let (p, uv) = (mesh.positions[i as usize], mesh.uvs[i as usize]);
        // One texture's side stands for the sheet's 0.2 m.
        [p.x, p.y, p.z, 0.2 * uv.x, 0.2 * uv.y].map(round)
    };
    let mut all: Vec<_> = (mesh.triangles.iter())
        .map(|t| {
            let mut t = t.map(corner);
            let least = (0..3).min_by_key(|&k| t[k]).unwrap();
            t.rotate_left(least);
            t
        })
        .collect();
    all.sort_unstable();
    all
}

#[test]
fn meshopt_gives_back_every_bit() {
    let plain_bytes = plain().bin.len();
    let plain = load(&plain());
    for (extension, sequence) in [
        ("EXT_meshopt_compression", false),
        ("EXT_meshopt_compression", true),
        ("KHR_meshopt_compression", false),
    ] {
        let file = by_meshopt(extension, sequence);
        let scene = load(&file);
        assert_eq!(corners(&scene, 1e-7), corners(&plain, 1e-7), "{extension}, sequence {sequence}");
        assert_eq!(scene.warnings, plain.warnings);
        // The plain bytes may lie in a file for other programs. Nobody has to deliver it.
        let named = file.clone().set("/buffers/1/uri", json!("not-delivered.bin"));
        assert_eq!(corners(&load(&named), 1e-7), corners(&plain, 1e-7));
        assert!(2 * file.bin.len() < plain_bytes, "{} bytes are not compressed", file.bin.len());
    }
}

#[test]
fn draco_gives_back_the_mesh_as_finely_as_it_was_stored() {
    let (plain_file, file) = (plain(), by_draco());
    let plain = load(&plain_file);
    let scene = load(&file);
    // Draco has rounded positions. Whole steps of half a millimetre are compared, with one step of tolerance.
    let (a, b) = (corners(&scene, 5e-4), corners(&plain, 5e-4));
    assert_eq!(a.len(), b.len());
    let far = |p: &[[i64; 5]; 3], q: &[[i64; 5]; 3]| {
        p.iter().zip(q).any(|(p, q)| p.iter().zip(q).any(|(p, q)| (p - q).abs() > 1))
    };
    let lost = a.iter().filter(|p| b.iter().all(|q| far(p, q))).count();
    assert_eq!(lost, 0, "triangles of {}", a.len());
    assert_eq!(scene.bodies[0].mesh.positions.len(), plain.bodies[0].mesh.positions.len());
    assert!(2 * file.bin.len() < plain_file.bin.len(), "{} bytes are not compressed", file.bin.len());
}

/// Two primitives may share one compressed mesh, and a file may hold the numbers a second time for other programs.
#[test]
fn shared_and_doubled_meshes_are_read() {
    let mut shared = by_draco();
    let primitive = shared.json["meshes"][0]["primitives"][0].clone();
    shared.json["meshes"][0]["primitives"].as_array_mut().unwrap().push(primitive);
    assert_eq!(
        load(&shared).bodies[0].mesh.triangles.len(),
        2 * load(&by_draco()).bodies[0].mesh.triangles.len()
    );

    let (mut doubled, draco) = (plain(), by_draco());
    let junk = doubled.push_view(&[1, 2, 3, 4]);
    let mut extension = draco.json["meshes"][0]["primitives"][0]["extensions"].clone();
    extension["KHR_draco_mesh_compression"]["bufferView"] = json!(junk);
    let doubled = doubled
        .set("/meshes/0/primitives/0/extensions", extension)
        .set("/extensionsUsed", json!(["KHR_draco_mesh_compression"]));
    assert_eq!(corners(&load(&doubled), 1e-7), corners(&load(&plain()), 1e-7));
}

#[test]
fn what_cannot_be_decoded_is_refused_by_name() {
    let meshopt = || by_meshopt("EXT_meshopt_compression", false);
    let at = "/bufferViews/0/extensions/EXT_meshopt_compression";
    let mut cut = meshopt();
    cut.json["bufferViews"][0]["extensions"]["EXT_meshopt_compression"]["byteLength"] = json!(100);
    for (file, words) in [
        (cut, ["bufferView 0", "cannot be decoded"]),
        (meshopt().set(&format!("{at}/mode"), json!("POLYGONS")), ["bufferView 0", "POLYGONS"]),
        (meshopt().set(&format!("{at}/filter"), json!("SEPIA")), ["bufferView 0", "SEPIA"]),
        (meshopt().set(&format!("{at}/byteStride"), json!(0)), ["bufferView 0", "'byteStride' is 0"]),
        (meshopt().set(&format!("{at}/count"), json!(1u64 << 40)), ["bufferView 0", "cannot hold"]),
        (meshopt().set(&format!("{at}/buffer"), json!(1)), ["bufferView 0", "but buffer 1 has 0"]),
        (meshopt().set(&format!("{at}/count"), Value::Null), ["bufferView 0", "'count'"]),
        (
            by_draco().set("/bufferViews/0/byteLength", json!(200)),
            ["mesh 0 'tetrahedron', primitive 0", "cannot be decoded"],
        ),
        (
            by_draco().set("/accessors/0/count", json!(100_000)),
            ["mesh 0 'tetrahedron', primitive 0", "cannot be decoded"],
        ),
        (
            by_draco()
                .set("/meshes/0/primitives/0/extensions/KHR_draco_mesh_compression/bufferView", json!(7)),
            ["mesh 0 'tetrahedron', primitive 0", "bufferView 7"],
        ),
        (
            by_draco().set("/meshes/0/primitives/0/indices", json!(9)),
            ["mesh 0 'tetrahedron', primitive 0", "accessor 9"],
        ),
    ] {
        let told = refusal(&file);
        assert!(words.iter().all(|word| told.contains(word)), "'{told}' does not say {words:?}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn damaged_streams_never_panic(
        which in 0..3usize,
        changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
    ) {
        let mut file = match which {
            0 => by_meshopt("EXT_meshopt_compression", false),
            1 => by_meshopt("EXT_meshopt_compression", true),
            _ => by_draco(),
        };
        for (at, value) in changes {
            let i = at.index(file.bin.len());
            file.bin[i] = value;
        }
        let start = core_seconds();
        if let Err(SceneError::Internal(e)) = dpm_scene::load_bytes(&file.bytes(), &LoadOptions::default()) {
            return Err(TestCaseError::fail(format!("the loader panicked: {e}")));
        }
        prop_assert!(core_seconds() - start < 5.0);
    }
}
