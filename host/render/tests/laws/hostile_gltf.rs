//! Broken and malicious glTF files: each must be refused with words that help, quickly, without a panic or a large allocation.

use crate::common;
use crate::common::{glb, png, tetrahedra, with_image};
use dpm_scene::{BodySelector, Limits, LoadOptions, SceneError};
use serde_json::{json, Value};
use test_meter::core_seconds;

/// Loads bytes that must be refused; returns the message.
fn refusal(name: &str, bytes: &[u8]) -> String {
    refusal_with(name, bytes, &LoadOptions::default())
}

fn refusal_with(name: &str, bytes: &[u8], options: &LoadOptions) -> String {
    let start = core_seconds();
    let result = dpm_scene::load_bytes(bytes, options);
    assert!(core_seconds() - start < 5.0, "{name} took {:.1} core-seconds", core_seconds() - start);
    match result {
        Ok(_) => panic!("{name} was accepted"),
        Err(e @ SceneError::Internal(_)) => panic!("{name} made the loader panic: {e}"),
        Err(e) => e.to_string(),
    }
}

/// Every listed file is refused with a message that holds all the words.
fn assert_refused(cases: Vec<(&str, Vec<u8>, &[&str])>) {
    for (name, bytes, words) in cases {
        let message = refusal(name, &bytes);
        for word in words {
            assert!(message.contains(word), "{name}: '{message}' does not say '{word}'");
        }
    }
}

/// Every listed file is refused, or read without what is damaged, with words that hold all those that are listed.
fn assert_told(cases: Vec<(&str, Vec<u8>, &[&str])>) {
    for (name, bytes, words) in cases {
        let start = core_seconds();
        let message = match dpm_scene::load_bytes(&bytes, &LoadOptions::default()) {
            Ok(scene) => scene.warnings.join("\n"),
            Err(e @ SceneError::Internal(_)) => panic!("{name} made the loader panic: {e}"),
            Err(e) => e.to_string(),
        };
        assert!(core_seconds() - start < 5.0, "{name} took {:.1} core-seconds", core_seconds() - start);
        for word in words {
            assert!(message.contains(word), "{name}: '{message}' does not say '{word}'");
        }
    }
}

/// Every listed file is read with all of its triangles, and a note that holds all the words that are listed.
fn assert_left_out(cases: Vec<(&str, Vec<u8>, &[&str])>) {
    for (name, bytes, _) in &cases {
        let scene = dpm_scene::load_bytes(bytes, &LoadOptions::default());
        let scene = scene.unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(scene.bodies.iter().map(|b| b.mesh.triangles.len()).sum::<usize>(), 8, "{name}");
        assert!(scene.warnings.iter().any(|told| told.contains("left out")), "{name}: {:?}", scene.warnings);
    }
    assert_told(cases);
}

fn set(pointer: &str, value: Value) -> Vec<u8> {
    tetrahedra().set(pointer, value).bytes()
}

fn text(json: &str) -> Vec<u8> {
    json.as_bytes().to_vec()
}

#[test]
fn containers_that_lie() {
    let good = tetrahedra().bytes();
    let patched = |at: usize, value: u32| {
        let mut bytes = good.clone();
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
        bytes
    };
    let json_size = u32::from_le_bytes(good[12..16].try_into().unwrap()) as usize;
    let mut two_documents = glb(b"{}  ", Some(&[]));
    two_documents.truncate(20 + 4);
    two_documents.extend([4, 0, 0, 0]);
    two_documents.extend(b"JSON{}  ");
    let length = two_documents.len() as u32;
    two_documents[8..12].copy_from_slice(&length.to_le_bytes());
    assert_told(vec![
        ("empty file", vec![], &["empty"]),
        ("only the magic", b"glTF".to_vec(), &["GLB header", "cut off"]),
        ("version 1 container", patched(4, 1), &["GLB header", "version 1", "re-export"]),
        ("length beyond the file", patched(8, u32::MAX), &["promises 4294967295"]),
        ("length below the file", patched(8, 12), &["no JSON chunk"]),
        ("truncated in the middle", good[..good.len() / 2].to_vec(), &["cut off"]),
        ("chunk beyond the file", patched(12, u32::MAX - 3), &["GLB chunk 0", "left"]),
        (
            "binary chunk beyond the file",
            patched(20 + json_size, 1 << 30),
            &["GLB chunk 1", "promises 1073741824"],
        ),
        ("first chunk not JSON", patched(16, 0x1234), &["GLB chunk 0", "JSON"]),
        ("a second document", two_documents, &["GLB chunk 1", "second"]),
        ("no chunk at all", [b"glTF\x02\0\0\0\x0c\0\0\0".to_vec()].concat(), &["no JSON chunk"]),
        ("a zip archive", b"PK\x03\x04rest".to_vec(), &["archive", "unpack"]),
        ("a picture", png(1, 1, &[[0; 4]]), &["JSON"]),
    ]);
}

#[test]
fn documents_that_are_not_gltf() {
    assert_refused(vec![
        ("not JSON", text("{\"asset\":"), &["JSON", "EOF"]),
        (
            "invalid UTF-8",
            b"{\"asset\":{\"version\":\"2.0\",\"generator\":\"\xff\xfe\"}}".to_vec(),
            &["JSON", "unicode"],
        ),
        ("nested 100,000 deep", [text("{\"asset\":"), b"[".repeat(100_000)].concat(), &["nested deeper"]),
        (
            "a key twice",
            text(r#"{"asset":{"version":"2.0"},"nodes":[],"nodes":[]}"#),
            &["'nodes' appears twice"],
        ),
        ("a list at the top", text("[1,2,3]"), &["document", "object"]),
        ("no asset", text("{}"), &["asset", "not glTF"]),
        ("glTF 1.0", set("/asset/version", json!("1.0")), &["version 1.0", "2.0"]),
        ("glTF 3 needed", set("/asset/minVersion", json!("3.0")), &["version 3.0"]),
        ("version is a number", set("/asset/version", json!(2.0)), &["asset", "'version' must be a string"]),
        (
            "number beyond f64",
            text(r#"{"asset":{"version":"2.0"},"nodes":[{"translation":[1e999,0,0]}]}"#),
            &["JSON", "range"],
        ),
        (
            "five million numbers",
            [text("{\"a\":[0"), b",0".repeat(5_000_000), text("]}")].concat(),
            &["JSON values", "limit"],
        ),
        ("40 MB of JSON text", [b" ".repeat(40 << 20), text("{}")].concat(), &["JSON text", "limit"]),
        ("no geometry at all", text(r#"{"asset":{"version":"2.0"}}"#), &["no usable triangle"]),
    ]);
}

#[test]
fn extensions_that_cannot_be_done() {
    let required = |name: &str| set("/extensionsRequired", json!([name]));
    assert_refused(vec![
        ("a texture format", required("MSFT_texture_dds"), &["MSFT_texture_dds", "re-export with PNG"]),
        ("unknown", required("ACME_dragons"), &["ACME_dragons", "without it", "extensionsUsed"]),
        (
            "not a list",
            set("/extensionsRequired", json!("KHR_materials_ior")),
            &["extensionsRequired", "list of strings"],
        ),
    ]);
}

#[test]
fn buffers_and_accessors_out_of_bounds() {
    let mut cut = tetrahedra();
    cut.bin.truncate(60);
    let sparse = |count: Value, index: Value| {
        let mut file = tetrahedra();
        let view = file.push_view(&[9, 9, 9, 9]);
        let value = file.push_view(&[0; 12]);
        let mut indices = json!({"componentType": 5121});
        indices["bufferView"] = if index.is_null() { json!(view) } else { index };
        file.set(
            "/accessors/0/sparse",
            json!({"count": count, "indices": indices, "values": {"bufferView": value}}),
        )
        .bytes()
    };
    assert_refused(vec![
        ("buffer cut off", cut.bytes(), &["buffer 0", "104 bytes", "60", "cut off"]),
        ("buffer of 2^62 bytes", set("/buffers/0/byteLength", json!(1u64 << 62)), &["all buffers", "limit"]),
        ("buffer without data", set("/buffers/1", json!({"byteLength": 4})), &["buffer 1", "uri"]),
        ("negative length", set("/buffers/0/byteLength", json!(-1)), &["buffer 0", "byteLength", "-1"]),
        (
            "fractional length",
            set("/bufferViews/0/byteLength", json!(47.5)),
            &["bufferView 0", "whole number"],
        ),
        (
            "view past its buffer",
            set("/bufferViews/0/byteLength", json!(105)),
            &["bufferView 0", "105 bytes", "104"],
        ),
        ("view offset wraps", set("/bufferViews/0/byteOffset", json!(u64::MAX - 10)), &["bufferView 0"]),
        ("view of buffer 7", set("/bufferViews/0/buffer", json!(7)), &["bufferView 0", "buffer 7", "has 1"]),
        (
            "stride 3",
            set("/bufferViews/0/byteStride", json!(3)),
            &["bufferView 0", "byteStride", "multiple of 4"],
        ),
        (
            "stride below the element",
            set("/bufferViews/0/byteStride", json!(8)),
            &["accessor 0", "8 bytes apart"],
        ),
        (
            "accessor past its view",
            set("/accessors/0/count", json!(5)),
            &["accessor 0", "needs 60 bytes", "has 48"],
        ),
        ("count 0", set("/accessors/0/count", json!(0)), &["accessor 0", "'count' is 0"]),
        (
            "count 2^62: count * stride wraps to 0",
            set("/accessors/0/count", json!(1u64 << 62)),
            &["accessor 0", "beyond any buffer"],
        ),
        ("count 2^32", set("/accessors/2/count", json!(1u64 << 32)), &["accessor 2", "needs"]),
        ("offset 2^64 - 1", set("/accessors/0/byteOffset", json!(u64::MAX)), &["accessor 0"]),
        (
            "component type 5124",
            set("/accessors/0/componentType", json!(5124)),
            &["accessor 0", "componentType", "5124"],
        ),
        ("type VEC9", set("/accessors/0/type", json!("VEC9")), &["accessor 0", "VEC9"]),
        (
            "no data behind an accessor",
            set("/accessors/0", json!({"componentType": 5126, "type": "VEC3", "count": 60_000_000})),
            &["accessor 0", "'sparse'", "re-export"],
        ),
        (
            "sparse count beyond the accessor",
            sparse(json!(5), Value::Null),
            &["accessor 0, sparse", "1 to the accessor's 4"],
        ),
        ("sparse index beyond the accessor", sparse(json!(1), Value::Null), &["element 9", "has 4"]),
        ("sparse view missing", sparse(json!(1), json!(99)), &["bufferView 99"]),
    ]);

    let mut falling = tetrahedra();
    let indices = falling.push_view(&[2, 1]);
    let values = falling.push_view(&[0; 24]);
    let falling = falling.set(
        "/accessors/0/sparse",
        json!({"count": 2, "indices": {"bufferView": indices, "componentType": 5121}, "values": {"bufferView": values}}),
    );
    assert_refused(vec![("sparse indices that fall", falling.bytes(), &["must rise", "1 follows 2"])]);
}

#[test]
fn meshes_that_do_not_fit_together() {
    let mut wild_index = tetrahedra();
    wild_index.bin[80..82].copy_from_slice(&4u16.to_le_bytes());
    let mut all_nan = tetrahedra();
    all_nan.bin[..48].fill(0xff);
    let mut flat = tetrahedra();
    flat.bin[..48].fill(0);
    let mut huge = tetrahedra();
    (0..12).for_each(|k| huge.bin[4 * k..4 * k + 4].copy_from_slice(&1e38f32.to_le_bytes()));
    assert_refused(vec![
        ("index beyond the vertices", wild_index.bytes(), &["accessor 2", "vertex 4", "there are 4"]),
        ("only NaN corners", all_nan.bytes(), &["no usable triangle"]),
        ("only flat triangles", flat.bytes(), &["no usable triangle"]),
        ("corners at 1e38", huge.bytes(), &["no usable triangle"]),
        (
            "u16 positions",
            set("/accessors/0/componentType", json!(5123)),
            &["accessor 0", "POSITION", "KHR_mesh_quantization"],
        ),
        (
            "float indices",
            set("/meshes/0/primitives/0/indices", json!(0)),
            &["accessor 0", "indices", "SCALAR"],
        ),
        (
            "positions of two components",
            set("/meshes/0/primitives/0/attributes/POSITION", json!(1)),
            &["accessor 1", "POSITION", "3"],
        ),
        (
            "accessor 77",
            set("/meshes/0/primitives/0/attributes/POSITION", json!(77)),
            &["accessor 77", "file has 3"],
        ),
        ("unequal counts", set("/accessors/1/count", json!(3)), &["accessor 1", "TEXCOORD_0", "3"]),
        ("11 corners", set("/accessors/2/count", json!(11)), &["primitive 0", "11 corners"]),
        ("mode 9", set("/meshes/0/primitives/0/mode", json!(9)), &["primitive 0", "'mode' is 9"]),
        ("material 5", set("/meshes/0/primitives/0/material", json!(5)), &["primitive 0", "material 5"]),
        ("no primitives", set("/meshes/0/primitives", json!([])), &["mesh 0 'tetrahedron'", "primitives"]),
        ("attributes missing", set("/meshes/0/primitives", json!([{}])), &["primitive 0", "attributes"]),
        ("meshes is a string", set("/meshes", json!("none")), &["'meshes' must be a list"]),
        ("points only", set("/meshes/0/primitives/0/mode", json!(0)), &["no usable triangle"]),
    ]);
}

#[test]
fn trees_that_are_none() {
    let chain = |n: usize| {
        let mut nodes: Vec<Value> = (0..n).map(|i| json!({"children": [i + 1]})).collect();
        nodes.push(json!({"mesh": 0}));
        tetrahedra().set("/nodes", json!(nodes)).set("/scenes/0/nodes", json!([0])).bytes()
    };
    let bomb = tetrahedra()
        .set("/nodes", json!(vec![json!({"mesh": 0}); 300_000]))
        .set("/scenes/0/nodes", json!([0]));
    let small = LoadOptions {
        limits: Limits { triangles: 1_000_000, ..Limits::default() },
        ..LoadOptions::default()
    };
    let message = refusal_with("instancing bomb", &bomb.bytes(), &small);
    assert!(
        message.contains("triangles") && message.contains("1200000") && message.contains("1000000"),
        "{message}"
    );
    assert!(dpm_scene::load_bytes(&chain(255), &LoadOptions::default()).is_ok());
    assert_told(vec![
        ("depth 100,000", chain(100_000), &["deeper than 256"]),
        ("node is its own child", set("/nodes/0/children", json!([0])), &["cycle"]),
        (
            "two nodes in a circle",
            tetrahedra().set("/nodes/0/children", json!([1])).set("/nodes/1/children", json!([0])).bytes(),
            &["cycle"],
        ),
        (
            "two parents",
            tetrahedra()
                .set("/nodes/2", json!({"children": [0]}))
                .set("/nodes/3", json!({"children": [0]}))
                .bytes(),
            &["node 0 'left'", "node 2", "node 3", "one parent"],
        ),
        ("child 9", set("/nodes/0/children", json!([9])), &["node 0", "node 9", "has 2"]),
        ("scene 4", set("/scene", json!(4)), &["scene 4", "has 1"]),
        ("scene lists a node twice", set("/scenes/0/nodes", json!([0, 0])), &["scene 0", "twice"]),
        (
            "matrix of 17 values",
            set("/nodes/0", json!({"mesh": 0, "matrix": vec![1.0; 17]})),
            &["node 0", "matrix", "16"],
        ),
        (
            "projective matrix",
            set("/nodes/0", json!({"mesh": 0, "matrix": vec![1.0; 16]})),
            &["node 0", "projection"],
        ),
        (
            "rotation of length 0",
            set("/nodes/0/rotation", json!([0, 0, 0, 0])),
            &["node 0 'left'", "quaternion"],
        ),
        (
            "translation 1e300",
            set("/nodes/0/translation", json!([1e300, 0, 0])),
            &["node 0 'left'", "translation", "finite"],
        ),
        (
            "translation is text",
            set("/nodes/0/translation", json!(["a", 0, 0])),
            &["node 0 'left'", "translation"],
        ),
        (
            "movable body scaled to nothing",
            set("/nodes/0/scale", json!([0, 0, 0])),
            &["node 0 'left'", "scaled to nothing"],
        ),
        ("mesh 3", set("/nodes/0/mesh", json!(3)), &["node 0 'left'", "mesh 3"]),
    ]);
}

#[test]
fn looks_and_lights_that_make_no_sense_cost_themselves_alone() {
    let material = |value: Value| set("/materials/0", value);
    let light = |value: Value| {
        tetrahedra()
            .set("/extensions", json!({"KHR_lights_punctual": {"lights": [value]}}))
            .set("/nodes/0/extensions", json!({"KHR_lights_punctual": {"light": 0}}))
            .bytes()
    };
    assert_left_out(vec![
        (
            "roughness 7",
            material(json!({"pbrMetallicRoughness": {"roughnessFactor": 7}})),
            &["material 0", "roughnessFactor", "7"],
        ),
        (
            "colour of two numbers",
            material(json!({"pbrMetallicRoughness": {"baseColorFactor": [1, 1]}})),
            &["material 0", "baseColorFactor", "4"],
        ),
        (
            "colour is null",
            material(json!({"pbrMetallicRoughness": {"baseColorFactor": [null, 1, 1, 1]}})),
            &["baseColorFactor", "null"],
        ),
        (
            "negative emission",
            material(json!({"name": "sun", "emissiveFactor": [-1, 0, 0]})),
            &["material 0 'sun'", "emissiveFactor"],
        ),
        (
            "emission 1e38",
            material(json!({"extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 1e38}}})),
            &["material 0", "emissiveStrength"],
        ),
        (
            "ior 0.5",
            material(json!({"extensions": {"KHR_materials_ior": {"ior": 0.5}}})),
            &["material 0", "ior"],
        ),
        ("alpha mode", material(json!({"alphaMode": "GLOW"})), &["material 0", "GLOW", "BLEND"]),
        (
            "texture 0 of none",
            material(json!({"normalTexture": {"index": 0}})),
            &["material 0", "normalTexture", "texture 0", "0"],
        ),
        ("intensity 1e38", light(json!({"type": "point", "intensity": 1e38})), &["light 0", "intensity"]),
        ("range 0", light(json!({"type": "point", "range": 0})), &["light 0", "range"]),
        ("light type", light(json!({"type": "laser"})), &["light 0", "laser"]),
        (
            "inside-out cone",
            light(json!({"type": "spot", "spot": {"innerConeAngle": 1.0, "outerConeAngle": 0.5}})),
            &["light 0", "innerConeAngle"],
        ),
        (
            "light 3 of 1",
            tetrahedra()
                .set("/extensions", json!({"KHR_lights_punctual": {"lights": [{"type": "point"}]}}))
                .set("/nodes/0/extensions", json!({"KHR_lights_punctual": {"light": 3}}))
                .bytes(),
            &["node 0 'left'", "'light' is 3"],
        ),
    ]);
}

/// A PNG whose header claims a size that its data does not have; the check sum is right.
fn png_claiming(width: u32, height: u32) -> Vec<u8> {
    let mut bytes = png(1, 1, &[[1, 2, 3, 255]]);
    bytes[16..20].copy_from_slice(&width.to_be_bytes());
    bytes[20..24].copy_from_slice(&height.to_be_bytes());
    let mut crc = u32::MAX;
    for &b in &bytes[12..29] {
        crc ^= u32::from(b);
        (0..8).for_each(|_| crc = (crc >> 1) ^ (0xEDB8_8320 & (crc & 1).wrapping_neg()));
    }
    bytes[29..33].copy_from_slice(&(!crc).to_be_bytes());
    bytes
}

#[test]
fn images_that_lie() {
    let good = png(4, 4, &[[9, 9, 9, 255]; 16]);
    assert!(dpm_scene::load_bytes(&with_image(&good).bytes(), &LoadOptions::default()).is_ok());
    let uri = |uri: &str| with_image(&good).set("/images/0", json!({"uri": uri})).bytes();
    assert_told(vec![
        (
            "65,535 x 65,535 texels",
            with_image(&png_claiming(65_535, 65_535)).bytes(),
            &["image 0", "left out", "limit"],
        ),
        (
            "16,000 x 16,000 texels",
            with_image(&png_claiming(16_000, 16_000)).bytes(),
            &["image 0", "left out", "limit"],
        ),
        ("size beyond the data", with_image(&png_claiming(4000, 4000)).bytes(), &["image 0", "decoded"]),
        ("image cut off", with_image(&good[..good.len() / 2]).bytes(), &["image 0", "decoded"]),
        ("noise", with_image(&[7; 64]).bytes(), &["image 0", "PNG, JPEG, KTX2"]),
        ("WebP", with_image(b"RIFF\x10\0\0\0WEBPVP8 ....").bytes(), &["image 0", "decoded"]),
        (
            "view of another world",
            with_image(&good).set("/images/0", json!({"bufferView": 99})).bytes(),
            &["image 0", "99"],
        ),
        (
            "two sources",
            with_image(&good).set("/images/0/uri", json!("a.png")).bytes(),
            &["image 0", "either"],
        ),
        (
            "texture without source",
            with_image(&good).set("/textures/0", json!({})).bytes(),
            &["texture 0", "source", "PNG, JPEG or KTX2"],
        ),
        (
            "wrap mode",
            with_image(&good).set("/samplers", json!([{"wrapS": 1}])).bytes(),
            &["sampler 0", "wrapS"],
        ),
        ("data URI of another alphabet", uri("data:image/png;base64,????"), &["image 0", "base64"]),
        ("data URI without comma", uri("data:image/png;base64"), &["image 0", "comma"]),
        ("path upwards", uri("../../etc/passwd"), &["image 0", "plain relative"]),
        ("network", uri("http://example.org/a.png"), &["image 0", "plain relative"]),
    ]);
}

#[test]
fn paths_from_hostile_files_stay_in_the_folder() {
    let folder = std::env::temp_dir().join(format!("dpm-hostile-{}", std::process::id()));
    let inside = folder.join("inside");
    std::fs::create_dir_all(&inside).unwrap();
    std::fs::write(folder.join("secret.bin"), tetrahedra().bin).unwrap();
    std::os::unix::fs::symlink(folder.join("secret.bin"), inside.join("link.bin")).unwrap();
    let file = inside.join("scene.gltf");
    for uri in [
        "../secret.bin",
        "link.bin",
        "%2e%2e/secret.bin",
        "/dev/zero",
        "file:///etc/passwd",
        "missing.bin",
        ".",
    ] {
        std::fs::write(&file, tetrahedra().set("/buffers/0/uri", json!(uri)).json.to_string()).unwrap();
        let message = dpm_scene::load(&file, &LoadOptions::default()).unwrap_err().to_string();
        assert!(message.contains("scene.gltf") && message.contains("buffer 0"), "{uri}: {message}");
    }
    let missing = dpm_scene::load(&folder.join("none.glb"), &LoadOptions::default()).unwrap_err().to_string();
    let directory = dpm_scene::load(&folder, &LoadOptions::default()).unwrap_err().to_string();
    let device =
        dpm_scene::load(std::path::Path::new("/dev/zero"), &LoadOptions::default()).unwrap_err().to_string();
    std::fs::remove_dir_all(&folder).unwrap();
    assert!(missing.contains("none.glb") && missing.contains("No such file"), "{missing}");
    assert!(directory.contains("a folder") && device.contains("a device file"), "{directory}, {device}");
}

#[test]
fn names_of_the_rig_file_that_the_scene_does_not_have() {
    let select = |node: &str| LoadOptions {
        bodies: vec![BodySelector { name: "a".into(), node: Some(node.into()), projected: true }],
        ..LoadOptions::default()
    };
    let message = refusal_with("missing node", &tetrahedra().bytes(), &select("centre"));
    assert!(message.contains("no node 'centre'") && message.contains("left, right"), "{message}");
    let message = refusal_with("two of a name", &set("/nodes/1/name", json!("left")), &select("left"));
    assert!(message.contains("2 nodes named 'left'") && message.contains("rename"), "{message}");
    let mut twice = select("left");
    twice.bodies.push(BodySelector { name: "b".into(), node: Some("left".into()), projected: true });
    let message = refusal_with("one node for two bodies", &tetrahedra().bytes(), &twice);
    assert!(message.contains("body 'b'") && message.contains("body 'a'"), "{message}");
    let message =
        refusal_with("a body without triangles", &set("/nodes/0", json!({"name": "left"})), &select("left"));
    assert!(message.contains("body 'a'") && message.contains("no usable triangle"), "{message}");
}

/// Bytes of `count` numbers.
fn words(count: usize, of: impl Fn(usize) -> u16) -> Vec<u8> {
    (0..count).flat_map(|k| of(k).to_le_bytes()).collect()
}

/// A tetrahedra file whose left node shows `triangles` triangles of `corners`.
fn mesh_of(corners: &[[f32; 3]], triangles: &[u8]) -> common::Glb {
    let mut file = tetrahedra();
    let bytes: Vec<u8> = corners.iter().flatten().flat_map(|x| x.to_le_bytes()).collect();
    let (positions, indices) = (file.push_view(&bytes), file.push_view(triangles));
    file.set(
        "/accessors/3",
        json!({"bufferView": positions, "componentType": 5126, "type": "VEC3", "count": corners.len()}),
    )
    .set(
        "/accessors/4",
        json!({"bufferView": indices, "componentType": 5123, "type": "SCALAR", "count": triangles.len() / 2}),
    )
    .set("/meshes/1", json!({"primitives": [{"attributes": {"POSITION": 3}, "indices": 4, "material": 0}]}))
    .set("/nodes/0/mesh", json!(1))
}

fn tetrahedra_corners() -> Vec<[f32; 3]> {
    common::TETRAHEDRON.0.to_vec()
}

/// Large files.
mod breadth {
    use super::*;

    /// Found in use, R10: the time to build the tree over coincident triangles grew with the square of their number. Every file of a megabyte that its kind allows is loaded, and
    /// made ready for the renderer, in seconds, or refused. The bound here is wide, for machines that do other things too; the square would take many minutes.
    #[test]
    fn no_file_of_a_megabyte_takes_long() {
        let corners = tetrahedra_corners();
        let coincident = mesh_of(&corners, &words(480_000, |k| (k % 3) as u16));
        // Triangles one inside the other, all at one corner.
        let nested: Vec<[f32; 3]> = (0..30_000u32)
            .flat_map(|k| {
                let s = 0.1 + k as f32 * 1e-5;
                [[s, 0.0, 0.0], [0.0, s, 0.0]]
            })
            .chain([[0.0; 3]])
            .collect();
        let nested = mesh_of(
            &nested,
            &words(90_000, |k| if k % 3 == 2 { 60_000 } else { (k / 3 * 2 + k % 3) as u16 }),
        );
        let many_nodes = |n: usize, place: &dyn Fn(usize) -> f32| {
            let nodes: Vec<Value> =
                (0..n).map(|k| json!({"mesh": 0, "translation": [place(k), 0, 0]})).collect();
            let roots: Vec<usize> = (0..n).collect();
            tetrahedra().set("/nodes", json!(nodes)).set("/scenes/0/nodes", json!(roots))
        };
        let same_place = many_nodes(20_000, &|_| 0.0);
        // Every material with an index of refraction of its own, and every one in use.
        let n = 9_000;
        let materials: Vec<Value> = (0..n)
            .map(|k| json!({"extensions": {"KHR_materials_ior": {"ior": 1.0 + k as f64 * 1e-4}}}))
            .collect();
        let primitives: Vec<Value> =
            (0..n).map(|k| json!({"attributes": {"POSITION": 0}, "indices": 2, "material": k})).collect();
        let glasses =
            tetrahedra().set("/materials", json!(materials)).set("/meshes/0/primitives", json!(primitives));
        // Short files that ask for very many triangles: of a sparse accessor one element is in the file, and the rest is zero.
        let endless = |n: u64| {
            let mut file = tetrahedra();
            let (indices, values) = (file.push_view(&[0; 2]), file.push_view(&[0; 12]));
            let sparse = json!({
                "count": 1,
                "indices": {"bufferView": indices, "componentType": 5123},
                "values": {"bufferView": values}});
            file.set(
                "/accessors/3",
                json!({"componentType": 5126, "type": "VEC3", "count": n, "sparse": sparse}),
            )
        };
        let nothing = endless(16_000_000)
            .set("/meshes/1", json!({"primitives": [{"attributes": {"POSITION": 3}, "mode": 5}]}))
            .set("/nodes/0/mesh", json!(1));
        let instances = |n: u64| {
            let of = json!({"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 3}}});
            endless(n).set("/nodes/0/extensions", of)
        };
        for (name, file, accepted) in [
            ("coincident", coincident, true),
            ("nested", nested, true),
            ("same place", same_place, true),
            ("glasses", glasses, true),
            ("16 million triangles of nothing", nothing, false),
            ("120,000 instances", instances(120_000), true),
            ("800,000 instances", instances(800_000), false),
            ("instances without end", instances(1 << 60), false),
        ] {
            let bytes = file.bytes();
            assert!(bytes.len() < 3 << 19, "{name}: {} bytes", bytes.len());
            let start = core_seconds();
            let ready = dpm_scene::load_bytes(&bytes, &LoadOptions::default())
                .map(|scene| dpm_render::scene_data::SceneData::build(&scene).map(|d| d.triangles.len()));
            let took = core_seconds() - start;
            println!("{name}: {} bytes, {took:.2} core-seconds", bytes.len());
            assert!(took < 120.0, "{name} took {took:.1} core-seconds");
            match ready {
                Ok(built) => assert!(accepted && built.is_ok(), "{name} was accepted"),
                Err(e) => assert!(!accepted && e.to_string().contains("limit"), "{name}: {e}"),
            }
        }
    }
}
