//! What is odd in a glTF file costs what is odd, and not the scene: pictures that no decoder reads or that are too large for
//! their file, values of extensions that are none, and nodes that stand on the globe.

use crate::common::{png, tetrahedra, with_image};
use dpm_scene::{load_bytes, LoadOptions, Scene};
use glam::Vec3;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::ImageEncoder;
use serde_json::json;

fn load(bytes: &[u8]) -> Scene {
    load_bytes(bytes, &LoadOptions::default()).unwrap()
}

/// A TIFF of 16 x 16 texels in one tile for each of red, green and blue.
fn tiff_in_planes() -> Vec<u8> {
    let entries: [(u16, u16, u32, u32); 11] = [
        (256, 4, 1, 16),
        (257, 4, 1, 16),
        (258, 3, 1, 8),
        (259, 3, 1, 1),
        (262, 3, 1, 2),
        (277, 3, 1, 3),
        (284, 3, 1, 2),
        (322, 4, 1, 16),
        (323, 4, 1, 16),
        (324, 4, 3, 146),
        (325, 4, 3, 158),
    ];
    let mut out = b"II*\0\x08\0\0\0\x0b\0".to_vec();
    for (tag, kind, count, value) in entries {
        out.extend([tag.to_le_bytes(), kind.to_le_bytes()].concat());
        out.extend([count.to_le_bytes(), value.to_le_bytes()].concat());
    }
    out.extend([0; 4]);
    assert_eq!(out.len(), 146);
    out.extend([170, 426, 682, 256, 256, 256].map(u32::to_le_bytes).concat());
    out.resize(out.len() + 768, 90);
    out
}

#[test]
fn tiles_in_planes_of_colours_are_read() {
    let scene = load(&with_image(&tiff_in_planes()).bytes());
    assert!(scene.textures[0].texels.iter().all(|t| *t == [90, 90, 90, 255]), "{:?}", scene.warnings);
    assert!(scene.bodies.iter().all(|b| b.mesh.triangles.len() == 4));
}

#[test]
fn a_picture_too_large_for_its_file_is_read_as_means() {
    // Columns of red and black take turns: the mean of any four texels is half red.
    let row: Vec<u8> = (0..4096).flat_map(|x| [if x % 2 == 0 { 200 } else { 0 }, 7, 0]).collect();
    let mut file = vec![];
    let packed = (CompressionType::Best, FilterType::NoFilter);
    let writer = PngEncoder::new_with_quality(&mut file, packed.0, packed.1);
    writer.write_image(&row.repeat(4096), 4096, 4096, image::ExtendedColorType::Rgb8).unwrap();
    assert!(file.len() < 150_000, "{} bytes", file.len());
    let scene = load(&with_image(&file).bytes());
    let texture = &scene.textures[0];
    assert_eq!((texture.width, texture.height), (2048, 2048));
    assert!(texture.texels.iter().all(|t| *t == [100, 7, 0, 255]));
    let told = scene.warnings.join("\n");
    assert!(told.contains("2048 x 2048 of its 4096 x 4096 texels"), "{told}");
}

#[test]
fn bodies_on_the_globe_are_moved_together() {
    // Earth-centred coordinates, as surveyors' exporters write them into the nodes: 6,378 km along x.
    let file = tetrahedra()
        .set("/nodes/0/translation", json!([6_378_000.0, 3.0, -2.0]))
        .set("/nodes/1/translation", json!([6_378_004.0, 3.0, -2.0]));
    let scene = load(&file.bytes());
    let at: Vec<_> = scene.bodies.iter().map(|b| b.world_from_body_rest.translation).collect();
    assert_eq!(at.iter().map(|p| p.to_array()).collect::<Vec<_>>(), [[0.0; 3], [4.0, 0.0, 0.0]]);
    let told = scene.warnings.join("\n");
    assert!(told.contains("6378 km from the origin") && told.contains("left"), "{told}");
    // What a room may have stays where it is.
    let near = tetrahedra().set("/nodes/0/translation", json!([900_000.0, 0.0, 0.0]));
    let scene = load(&near.bytes());
    assert_eq!(scene.bodies[0].world_from_body_rest.translation.x, 900_000.0);
}

/// A value of an extension that is no such value costs itself: what is left is the file without it.
#[test]
fn bad_values_of_extensions_leave_the_scene_as_if_they_were_not_there() {
    let good = with_image(&png(2, 2, &[[9, 8, 7, 255]; 4]))
        .set("/nodes/0/extensions", json!({"KHR_lights_punctual": {"light": 0}}))
        .set("/extensions", json!({"KHR_lights_punctual": {"lights": [{"type": "spot", "spot": {}}]}}));
    let look = |scene: &Scene| format!("{:?} {:?} {:?}", scene.materials, scene.lights, scene.bodies);
    let material =
        |name: &str, value: serde_json::Value| (format!("/materials/0/extensions/KHR_{name}"), value);
    let cases = [
        material("materials_ior", json!({"ior": 0.3})),
        material("materials_ior", json!(7)),
        material("materials_emissive_strength", json!({"emissiveStrength": "bright"})),
        material("materials_transmission", json!({"transmissionFactor": -2})),
        material("materials_transmission", json!({"transmissionTexture": {"index": 9}})),
        material("materials_volume", json!({"attenuationColor": [1, 1]})),
        material("materials_clearcoat", json!({"clearcoatFactor": 1.5})),
        material("materials_specular", json!({"specularColorFactor": [1, -1, 0]})),
        material("materials_sheen", json!({"sheenColorFactor": null})),
        material("materials_anisotropy", json!({"anisotropyRotation": "left"})),
        material("materials_iridescence", json!({"iridescenceIor": 0.5})),
        material("materials_diffuse_transmission", json!({"diffuseTransmissionFactor": 2})),
        material("materials_dispersion", json!({"dispersion": -1})),
        ("/materials/0/extensions".into(), json!("none")),
        ("/extensions/KHR_lights_punctual/lights/0/spot/innerConeAngle".into(), json!(7)),
        ("/extensions/KHR_lights_punctual/lights/0/color".into(), json!([1, 1])),
        ("/nodes/0/extensions/KHR_node_visibility".into(), json!({"visible": "no"})),
        (
            "/materials/0/pbrMetallicRoughness/baseColorTexture/extensions".into(),
            json!({"KHR_texture_transform": {"scale": [2], "offset": 1, "rotation": null, "texCoord": -1}}),
        ),
    ];
    for (pointer, value) in cases {
        let file = good.clone().set("/materials/0/extensions", json!({})).set(&pointer, value.clone());
        let scene = load(&file.bytes());
        // An extension without its values is there yet.
        let is_there = pointer.contains("/materials/0/extensions/") && value.is_object();
        let without = if is_there {
            good.clone().set("/materials/0/extensions", json!({})).set(&pointer, json!({}))
        } else {
            good.clone()
        };
        assert_eq!(look(&scene), look(&load(&without.bytes())), "{pointer}");
        let told = scene.warnings.join("\n");
        let name = pointer.split('/').find(|step| step.starts_with("KHR_")).unwrap_or("material 0 'paint'");
        assert!(told.contains(name) && told.contains("left out"), "{pointer}: {told}");
    }
}

/// What geometry hangs on is no matter of taste: without it there is another body, and not a plainer one.
#[test]
fn bad_values_that_place_geometry_refuse_the_file() {
    let name = "EXT_mesh_gpu_instancing";
    for value in
        [json!({}), json!({"attributes": {"TRANSLATION": 99}}), json!({"attributes": {"TRANSLATION": 2}})]
    {
        let file = tetrahedra().set("/nodes/0/extensions", json!({name: value}));
        let told = load_bytes(&file.bytes(), &LoadOptions::default()).unwrap_err().to_string();
        assert!(told.contains("node 0 'left'") && told.contains(name), "{told}");
    }
}

/// Materials of older exporters: specular and diffuse colours, glossiness, and their textures.
#[test]
fn specular_and_glossiness_are_shown_as_what_reflects_the_same() {
    let name = "KHR_materials_pbrSpecularGlossiness";
    let old = json!({"diffuseFactor": [0.2, 0.4, 0.6, 1], "specularFactor": [0.04, 0.02, 1], "glossinessFactor": 0.7,
        "diffuseTexture": {"index": 0}});
    let file = |old: serde_json::Value| {
        with_image(&png(2, 2, &[[9, 8, 7, 255]; 4]))
            .set("/materials/0", json!({"extensions": {name: old}}))
            .set("/extensionsRequired", json!([name]))
    };
    let scene = load(&file(old.clone()).bytes());
    let m = &scene.materials[0];
    assert!((m.roughness - 0.3).abs() < 1e-6 && m.metallic == 0.0 && m.base_color_texture.is_some(), "{m:?}");
    assert!(m.base_color.distance(Vec3::new(0.2, 0.4, 0.6)) < 1e-6);
    // 4 % of this colour are reflected along the normal.
    assert!(m.lobes.specular.color.distance(Vec3::new(1.0, 0.5, 25.0)) < 1e-4, "{m:?}");
    assert!(scene.warnings.join("\n").contains("is shown as metallic-roughness"), "{:?}", scene.warnings);

    let mut textured = old.clone();
    textured["specularGlossinessTexture"] = json!({"index": 0});
    textured["specularFactor"] = json!([2, 0, 0]);
    let scene = load(&file(textured).bytes());
    let m = &scene.materials[0];
    assert!(m.lobes.specular.color_texture.is_some() && (m.roughness - 0.65).abs() < 1e-6, "{m:?}");
    assert_eq!(m.lobes.specular.color, Vec3::splat(25.0));
    let told = scene.warnings.join("\n");
    assert!(told.contains("taken for one half") && told.contains("'specularFactor' is [2,0,0]"), "{told}");

    // A file with metallic-roughness of its own means that for programs without the extension.
    let both = file(old).set("/materials/0/pbrMetallicRoughness", json!({"baseColorFactor": [1, 0, 0, 1]}));
    let scene = load(&both.bytes());
    assert_eq!(scene.materials[0].base_color, Vec3::X);
    assert!(scene.warnings.join("\n").contains("own metallic-roughness is shown"), "{:?}", scene.warnings);
}
