//! Good glTF files, small ones built here and real scans where they are, into scenes that keep every promise of the types.

use crate::common;
use crate::common::{base64, png, tetrahedra, with_image, Glb};
use dpm_scene::{BodySelector, LoadOptions, PunctualKind, Scene, TextureRef, Wrap};
use glam::{DVec3, Vec2, Vec3};
use serde_json::json;

fn load(glb: &Glb) -> Scene {
    load_with(glb, &LoadOptions::default())
}

fn load_with(glb: &Glb, options: &LoadOptions) -> Scene {
    let scene = dpm_scene::load_bytes(&glb.bytes(), options).unwrap();
    assert_promises(&scene);
    scene
}

fn select(list: &[(&str, &str)]) -> LoadOptions {
    let bodies = list.iter().map(|(name, node)| BodySelector {
        name: (*name).into(),
        node: Some((*node).into()),
        projected: true,
    });
    LoadOptions { bodies: bodies.collect(), ..LoadOptions::default() }
}

/// Everything that the documentation of the types promises.
fn assert_promises(scene: &Scene) {
    for body in &scene.bodies {
        let m = &body.mesh;
        let n = m.positions.len();
        assert_eq!([m.normals.len(), m.tangents.len(), m.uvs.len()], [n; 3]);
        assert_eq!(m.materials.len(), m.triangles.len());
        assert!(m.triangles.iter().flatten().all(|&i| (i as usize) < n));
        assert!(m.materials.iter().all(|&i| (i as usize) < scene.materials.len()));
        assert!(m.positions.iter().all(|p| p.is_finite()) && m.uvs.iter().all(|p| p.is_finite()));
        assert!(m.normals.iter().all(|v| (v.length() - 1.0).abs() < 1e-4));
        assert!(m.tangents.iter().zip(&m.normals).all(|(t, v)| {
            (t.truncate().length() - 1.0).abs() < 1e-4
                && t.w.abs() == 1.0
                && t.truncate().dot(*v).abs() < 1e-3
        }));
        assert!((0..m.triangles.len()).all(|t| m.triangle_area(t) > 0.0));
        let r = body.world_from_body_rest.matrix3;
        assert!(
            (r.determinant() - 1.0).abs() < 1e-9
                && (r.transpose() * r - glam::DMat3::IDENTITY).abs_diff_eq(glam::DMat3::ZERO, 1e-9)
        );
    }
    for m in &scene.materials {
        assert!(m.textures().flatten().all(|t| (t.texture as usize) < scene.textures.len()));
    }
    assert!(scene.textures.iter().all(|t| t.texels.len() == (t.width * t.height) as usize && t.width > 0));
    assert!(scene.lights.iter().all(|l| l.body.is_none_or(|b| (b as usize) < scene.bodies.len())));
}

/// Volume enclosed in world space: positive when the faces look outward.
fn volume(scene: &Scene, body: usize) -> f64 {
    let b = &scene.bodies[body];
    let world = |i: u32| b.world_from_body_rest.transform_point3(b.mesh.positions[i as usize].as_dvec3());
    b.mesh.triangles.iter().map(|t| t.map(world)).map(|[a, b, c]| a.dot(b.cross(c)) / 6.0).sum()
}

const TETRAHEDRON_VOLUME: f64 = 1e-3 / 6.0;

#[test]
fn without_selectors_the_first_objects_move() {
    let scene = load(&tetrahedra());
    let seen: Vec<_> = scene
        .bodies
        .iter()
        .map(|b| (b.name.as_str(), b.tracked, b.world_from_body_rest.translation.x as f32))
        .collect();
    assert_eq!(seen, [("left", Some(0), -0.2), ("right", Some(1), 0.2)]);
    assert!((volume(&scene, 0) / TETRAHEDRON_VOLUME - 1.0).abs() < 1e-5);
    assert_eq!(scene.materials[0].name, "paint");
    assert!(scene.warnings.is_empty());
    // No normals in the file: flat faces.
    assert_eq!(scene.bodies[0].mesh.positions.len(), 12);
}

#[test]
fn selectors_order_bodies_and_leave_the_rest_static() {
    let scene = load_with(&tetrahedra(), &select(&[("thing", "right")]));
    let seen: Vec<_> = scene.bodies.iter().map(|b| (b.name.as_str(), b.tracked, b.projected)).collect();
    assert_eq!(seen, [("thing", Some(0), true), ("static", None, true)]);
    let centre = scene.bodies[1].mesh.positions.iter().sum::<Vec3>() / 12.0;
    assert!(
        centre.distance(Vec3::new(-0.2 + 0.025, 0.025, 0.025)) < 1e-6,
        "static geometry is in world space: {centre}"
    );
}

#[test]
fn bodies_of_another_rig_stand_for_the_first_objects() {
    let body = |name: &str| BodySelector { name: name.into(), node: None, projected: true };
    let options = |names: &[&str]| LoadOptions {
        bodies: names.iter().map(|n| body(n)).collect(),
        ..LoadOptions::default()
    };
    let names = |scene: &Scene| scene.bodies.iter().map(|b| (b.name.clone(), b.tracked)).collect::<Vec<_>>();
    let both = load_with(&tetrahedra(), &options(&["bunny", "venus", "third"]));
    assert_eq!(names(&both), [("bunny".into(), Some(0)), ("venus".into(), Some(1))]);
    let told = both.warnings.join("\n");
    assert!(told.contains("'bunny' stands for 'left'") && told.contains("'third' has nothing"), "{told}");
    // A name that fits is taken by name, and then one that does not is a mistake.
    let by_name = load_with(&tetrahedra(), &options(&["right", "left"]));
    assert_eq!(names(&by_name), [("right".into(), Some(0)), ("left".into(), Some(1))]);
    assert!(by_name.warnings.is_empty());
    let message =
        dpm_scene::load_bytes(&tetrahedra().bytes(), &options(&["right", "lefft"])).unwrap_err().to_string();
    assert!(message.contains("no node 'lefft'"), "{message}");
}

#[test]
fn virtual_nodes_and_nested_claims_are_kept_apart() {
    let glb = tetrahedra()
        .set("/nodes/2", json!({"name": "lamp", "mesh": 0, "translation": [0.0, 1.0, 0.0]}))
        .set("/nodes/3", json!({"name": "child", "mesh": 0, "translation": [0.0, 0.5, 0.0]}))
        .set("/nodes/0/children", json!([3]))
        .set("/scenes/0/nodes/2", json!(2));
    let mut options = select(&[("outer", "left"), ("inner", "child")]);
    options.virtual_nodes = vec!["lamp".into()];
    let scene = load_with(&glb, &options);
    let seen: Vec<_> = scene
        .bodies
        .iter()
        .map(|b| (b.name.as_str(), b.tracked, b.projected, b.mesh.triangles.len()))
        .collect();
    assert_eq!(
        seen,
        [
            ("outer", Some(0), true, 4),
            ("inner", Some(1), true, 4),
            ("static", None, true, 4),
            ("virtual", None, false, 4)
        ]
    );
    assert!(scene.bodies[1].world_from_body_rest.translation.distance(DVec3::new(-0.2, 0.5, 0.0)) < 1e-6);
}

#[test]
fn mirrored_uneven_and_sheared_nodes_keep_their_outside() {
    for scale in [[1.0, 2.0, 3.0], [-1.0, 1.0, 1.0], [-1.0, -2.0, -0.5]] {
        let glb = tetrahedra()
            .set("/nodes/0/scale", json!(scale))
            .set("/nodes/0/rotation", json!([0.0, 0.6, 0.0, 0.8]))
            .set("/nodes/2", json!({"name": "parent", "children": [0], "scale": [1.0, 0.5, 2.0]}))
            .set("/scenes/0/nodes/0", json!(2));
        let scene = load_with(&glb, &select(&[("a", "left")]));
        let expected = TETRAHEDRON_VOLUME * scale.iter().product::<f64>().abs();
        assert!(
            (volume(&scene, 0) / expected - 1.0).abs() < 1e-4,
            "scale {scale:?}: volume {}",
            volume(&scene, 0)
        );
        let m = &scene.bodies[0].mesh;
        for t in &m.triangles {
            let [a, b, c] = t.map(|i| m.positions[i as usize]);
            assert!((b - a).cross(c - a).normalize().dot(m.normals[t[0] as usize]) > 0.999);
        }
    }
}

#[test]
fn every_index_width_strips_fans_and_missing_indices_give_the_same_faces() {
    let reference = volume(&load(&tetrahedra()), 0);
    for (code, bytes) in [
        (5121, common::TETRAHEDRON.1.iter().map(|&i| i as u8).collect::<Vec<_>>()),
        (5125, common::TETRAHEDRON.1.iter().flat_map(|&i| u32::from(i).to_le_bytes()).collect()),
    ] {
        let mut glb = tetrahedra();
        let view = glb.push_view(&bytes);
        let glb =
            glb.set("/accessors/2/bufferView", json!(view)).set("/accessors/2/componentType", json!(code));
        assert_eq!(volume(&load(&glb), 0), reference);
    }
    // A strip over the four corners covers all four faces of a tetrahedron when it runs on to the first two.
    let mut glb = tetrahedra();
    let view = glb.push_view(&[0, 2, 1, 3, 0, 2]);
    let strip = glb
        .set("/accessors/2", json!({"bufferView": view, "componentType": 5121, "type": "SCALAR", "count": 6}))
        .set("/meshes/0/primitives/0/mode", json!(5));
    assert!((volume(&load(&strip), 0) / reference - 1.0).abs() < 1e-5);
    let mut glb = tetrahedra();
    let view = glb.push_view(&[0, 1, 2, 3]);
    let fan = glb
        .set("/accessors/2", json!({"bufferView": view, "componentType": 5121, "type": "SCALAR", "count": 4}))
        .set("/meshes/0/primitives/0/mode", json!(6));
    assert_eq!(load(&fan).bodies[0].mesh.triangles.len(), 2);
}

#[test]
fn integer_coordinates_sparse_positions_and_given_tangents() {
    let mut glb = tetrahedra();
    let uvs = glb.push_view(&[0, 0, 255, 0, 0, 255, 255, 255]);
    let sparse_index = glb.push_view(&[3]);
    let sparse_value = glb.push_view(&[0.0f32, 0.0, 0.2].map(f32::to_le_bytes).concat());
    let glb = glb
        .set("/accessors/1", json!({"bufferView": uvs, "componentType": 5121, "normalized": true, "type": "VEC2", "count": 4}))
        .set("/accessors/0/sparse", json!({"count": 1, "indices": {"bufferView": sparse_index, "componentType": 5121}, "values": {"bufferView": sparse_value}}));
    let scene = load(&glb);
    assert!(
        (volume(&scene, 0) / TETRAHEDRON_VOLUME - 2.0).abs() < 1e-5,
        "the sparse corner makes it twice as tall"
    );
    let uvs = &scene.bodies[0].mesh.uvs;
    assert!(uvs.contains(&Vec2::new(1.0, 1.0)) && uvs.contains(&Vec2::new(1.0, 0.0)));
}

#[test]
fn quantized_positions_need_the_extension_and_then_work() {
    let mut glb = tetrahedra();
    let corners: Vec<u8> = [[0u16, 0, 0, 0], [32767, 0, 0, 0], [0, 32767, 0, 0], [0, 0, 32767, 0]]
        .concat()
        .iter()
        .flat_map(|x| x.to_le_bytes())
        .collect();
    let view = glb.push_view(&corners);
    let glb = glb.set(&format!("/bufferViews/{view}/byteStride"), json!(8)).set(
        "/accessors/0",
        json!({"bufferView": view, "componentType": 5122, "normalized": true, "type": "VEC3", "count": 4}),
    );
    assert!(dpm_scene::load_bytes(&glb.bytes(), &LoadOptions::default())
        .unwrap_err()
        .to_string()
        .contains("KHR_mesh_quantization"));
    let glb = glb
        .set("/extensionsUsed", json!(["KHR_mesh_quantization"]))
        .set("/extensionsRequired", json!(["KHR_mesh_quantization"]));
    assert!((volume(&load(&glb), 0) - 1.0 / 6.0).abs() < 1e-6);
}

#[test]
fn materials_textures_and_transforms_arrive() {
    let mut glb = tetrahedra();
    let image = glb.push_view(&png(2, 1, &[[255, 0, 0, 255], [0, 0, 255, 128]]));
    let uri =
        format!("data:image/png;base64,{}", base64(&png(1, 2, &[[128, 128, 255, 255], [0, 128, 255, 255]])));
    let transform =
        json!({"KHR_texture_transform": {"offset": [0.25, 0.5], "rotation": 0.5, "scale": [2.0, 3.0]}});
    let glb = glb
        .set("/images", json!([{"bufferView": image, "mimeType": "image/png"}, {"uri": uri}]))
        .set("/samplers", json!([{"wrapS": 33071, "wrapT": 33648, "magFilter": 9728}]))
        .set("/textures", json!([{"source": 0, "sampler": 0}, {"source": 1}]))
        .set("/extensionsRequired", json!(["KHR_materials_volume", "KHR_materials_specular", "KHR_materials_variants"]))
        .set(
            "/materials/0",
            json!({
                "name": "all", "doubleSided": true, "alphaMode": "MASK", "alphaCutoff": 0.25,
                "emissiveFactor": [0.5, 0.25, 0.0], "emissiveTexture": {"index": 0},
                "normalTexture": {"index": 1, "scale": 0.7, "extensions": transform},
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": transform}, "metallicRoughnessTexture": {"index": 0}, "roughnessFactor": 0.3},
                "extensions": {
                    "KHR_materials_emissive_strength": {"emissiveStrength": 4.0}, "KHR_materials_ior": {"ior": 1.33},
                    "KHR_materials_transmission": {"transmissionFactor": 0.9}, "KHR_materials_volume": {"thicknessFactor": 0.1},
                    "EXT_lumps": {}}}),
        );
    let scene = load_with(&glb, &select(&[("a", "left")]));
    let m = &scene.materials[0];
    assert_eq!(
        (m.alpha_cutoff, m.double_sided, m.ior, m.transmission, m.thin_walled),
        (Some(0.25), true, 1.33, 0.9, false)
    );
    assert_eq!(
        (m.emissive, m.normal_scale, m.metallic, m.roughness),
        (Vec3::new(2.0, 1.0, 0.0), 0.7, 1.0, 0.3)
    );
    let expected = |texture| TextureRef {
        texture,
        offset: Vec2::new(0.25, 0.5),
        rotation: 0.5,
        scale: Vec2::new(2.0, 3.0),
    };
    let (base, surface, normal, emissive) = (
        m.base_color_texture.unwrap(),
        m.metallic_roughness_texture.unwrap(),
        m.normal_texture.unwrap(),
        m.emissive_texture.unwrap(),
    );
    assert_eq!((base, normal), (expected(base.texture), expected(normal.texture)));
    assert_eq!(emissive.texture, base.texture, "one image in one colour space is decoded once");
    assert_ne!(surface.texture, base.texture, "the linear use is another texture");
    let [t, linear] = [base.texture, surface.texture].map(|i| &scene.textures[i as usize]);
    assert_eq!(
        (t.srgb, linear.srgb, t.wrap_u, t.wrap_v, t.nearest),
        (true, false, Wrap::Clamp, Wrap::Mirror, true)
    );
    assert_eq!(t.texels, [[255, 0, 0, 255], [0, 0, 255, 128]]);
    assert_eq!(scene.textures[normal.texture as usize].height, 2);
    assert!(
        scene.warnings.iter().any(|w| w.contains("material 0 'all'") && w.contains("EXT_lumps is ignored")),
        "{:?}",
        scene.warnings
    );
}

/// The extensions that bring lobes: values, textures with their transforms, and what is absent without strength.
#[test]
fn lobes_of_materials_arrive() {
    let mut glb = tetrahedra();
    let image = glb.push_view(&png(1, 1, &[[10, 20, 30, 255]]));
    let use_of =
        |shift: f32| json!({"index": 0, "extensions": {"KHR_texture_transform": {"offset": [shift, 0.0]}}});
    let extensions = json!({
        "KHR_materials_clearcoat": {"clearcoatFactor": 0.9, "clearcoatRoughnessFactor": 0.2, "clearcoatTexture": use_of(0.1),
            "clearcoatRoughnessTexture": use_of(0.2), "clearcoatNormalTexture": {"index": 0, "scale": 0.4}},
        "KHR_materials_specular": {"specularFactor": 0.3, "specularColorFactor": [2.0, 0.5, 0.0], "specularTexture": use_of(0.3),
            "specularColorTexture": use_of(0.4)},
        "KHR_materials_anisotropy": {"anisotropyStrength": 0.6, "anisotropyRotation": 1.2, "anisotropyTexture": use_of(0.5)},
        "KHR_materials_sheen": {"sheenColorFactor": [0.1, 0.2, 0.3], "sheenRoughnessFactor": 0.7, "sheenColorTexture": use_of(0.6),
            "sheenRoughnessTexture": use_of(0.7)},
        "KHR_materials_iridescence": {"iridescenceFactor": 0.8, "iridescenceIor": 1.7, "iridescenceThicknessMinimum": 150.0,
            "iridescenceThicknessMaximum": 650.0, "iridescenceTexture": use_of(0.8), "iridescenceThicknessTexture": use_of(0.9)},
        "KHR_materials_diffuse_transmission": {"diffuseTransmissionFactor": 0.25, "diffuseTransmissionColorFactor": [0.9, 0.8, 0.7],
            "diffuseTransmissionTexture": use_of(1.0), "diffuseTransmissionColorTexture": use_of(1.1)},
        "KHR_materials_transmission": {"transmissionFactor": 1.0},
        "KHR_materials_volume": {"thicknessFactor": 0.01, "attenuationDistance": 0.5, "attenuationColor": [0.25, 0.5, 1.0]},
        "KHR_materials_dispersion": {"dispersion": 0.36},
    });
    let glb = glb
        .set("/images", json!([{"bufferView": image, "mimeType": "image/png"}]))
        .set("/textures", json!([{"source": 0}]))
        .set("/materials/0/extensions", extensions);
    let scene = load(&glb);
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    let l = &scene.materials[0].lobes;
    assert_eq!((l.coat.factor, l.coat.roughness, l.coat.normal_scale), (0.9, 0.2, 0.4));
    assert_eq!((l.specular.factor, l.specular.color), (0.3, Vec3::new(2.0, 0.5, 0.0)));
    assert_eq!((l.anisotropy.strength, l.anisotropy.rotation), (0.6, 1.2));
    assert_eq!((l.sheen.color, l.sheen.roughness), (Vec3::new(0.1, 0.2, 0.3), 0.7));
    assert_eq!((l.film.factor, l.film.ior, l.film.thickness_nm), (0.8, 1.7, [150.0, 650.0]));
    assert_eq!(
        (l.diffuse_transmission.factor, l.diffuse_transmission.color, l.dispersion),
        (0.25, Vec3::new(0.9, 0.8, 0.7), 0.36)
    );
    let [a, b] = [0.25f32, 0.5].map(|c| -c.ln() / 0.5);
    assert!((l.absorption - Vec3::new(a, b, 0.0)).abs().max_element() < 1e-6, "{}", l.absorption);
    // Each texture comes from its own place, in the order of the fields, colours in sRGB and numbers as they are.
    let shifts = [0.1, 0.2, 0.0, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1];
    let colors = [4, 6, 11];
    for (k, (used, shift)) in l.textures().into_iter().zip(shifts).enumerate() {
        let used = used.unwrap_or_else(|| panic!("texture {k}"));
        assert_eq!(used.offset.x, shift, "texture {k}");
        assert_eq!(scene.textures[used.texture as usize].srgb, colors.contains(&k), "texture {k}");
    }

    // Thin walls have no volume that could absorb; a lobe without strength brings no textures.
    let thin = glb
        .clone()
        .set("/materials/0/extensions/KHR_materials_volume/thicknessFactor", json!(0.0))
        .set("/materials/0/extensions/KHR_materials_clearcoat/clearcoatFactor", json!(0.0));
    let l = load(&thin).materials[0].lobes;
    assert!(l.absorption == Vec3::ZERO && l.textures()[..3].iter().all(|t| t.is_none()), "{l:?}");
}

/// BLEND is coverage where something is not fully there, and nothing where everything is.
#[test]
fn blended_materials_are_partly_there_unless_they_are_opaque() {
    let blend = tetrahedra().set("/materials/0/alphaMode", json!("BLEND"));
    let m = |glb: &Glb| load(glb).materials[0].clone();
    assert!(!m(&blend).alpha_blend, "alpha is 1 everywhere");
    let thin = blend.set("/materials/0/pbrMetallicRoughness/baseColorFactor", json!([1.0, 1.0, 1.0, 0.4]));
    let thin = m(&thin);
    assert!(thin.alpha_blend && thin.alpha == 0.4 && thin.alpha_cutoff.is_none(), "{thin:?}");
}

/// Exporters write a texture for every use of an image. In memory there is one for each image, sampler and colour space.
#[test]
fn textures_that_show_the_same_image_alike_are_one() {
    let mut glb = tetrahedra();
    let image = glb.push_view(&png(1, 1, &[[1, 2, 3, 255]]));
    let look = |index: usize| json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": index}}});
    let glb = glb
        .set("/images", json!([{"bufferView": image, "mimeType": "image/png"}]))
        .set("/samplers", json!([{"wrapS": 33071}, {"wrapS": 33648}]))
        .set("/textures", json!([{"source": 0, "sampler": 0}, {"source": 0, "sampler": 0}, {"source": 0, "sampler": 1}, {"source": 0}]))
        .set("/materials", json!([look(0), look(1), look(2), look(3)]));
    let scene = load(&glb);
    let of: Vec<u32> =
        scene.materials.iter().filter_map(|m| m.base_color_texture.map(|t| t.texture)).collect();
    assert_eq!((of, scene.textures.len()), (vec![0, 0, 1, 2], 3));
}

#[test]
fn texture_transform_turns_counter_clockwise_on_the_image() {
    let quarter = TextureRef {
        texture: 0,
        offset: Vec2::ZERO,
        rotation: std::f32::consts::FRAC_PI_2,
        scale: Vec2::ONE,
    };
    // Along +u becomes up in the image, which is -v.
    assert!(quarter.apply(Vec2::X).distance(Vec2::new(0.0, -1.0)) < 1e-6);
}

#[test]
fn lights_ride_on_their_bodies() {
    let glb = tetrahedra()
        .set("/extensions", json!({"KHR_lights_punctual": {"lights": [
            {"type": "spot", "color": [1.0, 0.5, 0.25], "intensity": 8.0, "range": 3.0, "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.2}},
            {"type": "directional"}]}}))
        .set("/nodes/2", json!({"name": "torch", "translation": [0.0, 0.0, 0.3], "extensions": {"KHR_lights_punctual": {"light": 0}}}))
        .set("/nodes/3", json!({"rotation": [1.0, 0.0, 0.0, 0.0], "extensions": {"KHR_lights_punctual": {"light": 1}}}))
        .set("/nodes/0/children", json!([2]))
        .set("/scenes/0/nodes/2", json!(3));
    let scene = load_with(&glb, &select(&[("a", "left")]));
    let spot = scene.lights.iter().find(|l| l.body.is_some()).unwrap();
    assert_eq!(
        (spot.body, spot.kind, spot.range),
        (Some(0), PunctualKind::Spot { inner: 0.1, outer: 0.2 }, 3.0)
    );
    assert_eq!(spot.intensity, Vec3::new(8.0, 4.0, 2.0));
    assert!(
        spot.position.distance(Vec3::new(0.0, 0.0, 0.3)) < 1e-6
            && spot.direction.distance(Vec3::NEG_Z) < 1e-6
    );
    let sun = scene.lights.iter().find(|l| l.body.is_none()).unwrap();
    assert!(sun.direction.distance(Vec3::Z) < 1e-6 && sun.kind == PunctualKind::Directional);
}

#[test]
fn damaged_vertices_are_dropped_and_counted() {
    let mut glb = tetrahedra();
    glb.bin[36..40].copy_from_slice(&f32::NAN.to_le_bytes());
    let scene = load(&glb);
    assert_eq!(scene.bodies[0].mesh.triangles.len(), 1, "three faces share the damaged corner");
    assert!(
        scene.warnings.iter().any(|w| w.contains("6 triangles") && w.contains("not finite")),
        "{:?}",
        scene.warnings
    );
}

#[test]
fn what_is_not_reproduced_is_said() {
    let glb =
        tetrahedra().set("/materials/0/extensions", json!({"KHR_materials_subsurface": {}, "EXT_lumps": {}}));
    let warnings = load(&glb).warnings.join("\n");
    for words in ["KHR_materials_subsurface", "EXT_lumps"] {
        assert!(warnings.contains(words), "{words} is missing in\n{warnings}");
    }
}

/// KHR_materials_unlit: the base colour is shown as it is, and nothing else of the material counts.
#[test]
fn unlit_materials_send_out_their_base_colour() {
    let unlit = |glb: Glb| glb.set("/materials/0/extensions", json!({"KHR_materials_unlit": {}}));
    let plain = unlit(tetrahedra())
        .set("/materials/0/emissiveFactor", json!([1.0, 1.0, 1.0]))
        .set("/materials/0/doubleSided", json!(true));
    let scene = load(&plain);
    let m = &scene.materials[0];
    assert!(m.emissive.distance(Vec3::new(0.8, 0.4, 0.2)) < 1e-6, "{m:?}");
    // Nothing is reflected: no colour, no metal, no coat.
    assert_eq!((m.base_color, m.metallic, m.ior, m.transmission), (Vec3::ZERO, 0.0, 1.0, 0.0));
    assert!(m.double_sided && scene.warnings.is_empty(), "{:?}", scene.warnings);
    assert!(scene.bodies.iter().all(|b| b.projected), "a surface that is shown as it is is no lamp");
    let features = dpm_scene::SceneFeatures::of(&scene);
    assert_eq!((features.emissive_triangles, features.lamp_triangles), (8, 0));

    let textured = load(&unlit(with_image(&png(4, 4, &[[200, 100, 50, 255]; 16]))));
    let m = &textured.materials[0];
    let sent = m.emissive_texture.map(|t| &textured.textures[t.texture as usize]);
    assert!(sent.is_some_and(|t| t.srgb && t.texels[0] == [200, 100, 50, 255]), "{m:?}");
    assert_eq!((m.base_color_texture, m.alpha_cutoff), (None, None));

    let cut =
        unlit(with_image(&png(4, 4, &[[200, 100, 50, 9]; 16]))).set("/materials/0/alphaMode", json!("MASK"));
    let cut = load(&cut).materials[0].clone();
    assert!(cut.base_color_texture.is_some() && cut.alpha_cutoff == Some(0.5), "{cut:?}");

    let painted = load(&unlit(tetrahedra()).set("/meshes/0/primitives/0/attributes/COLOR_0", json!(0)));
    let used = painted.bodies[0].mesh.materials[0] as usize;
    let m = &painted.materials[used];
    assert!(m.emissive_texture.is_some() && m.base_color_texture.is_none(), "{m:?}");
}

/// The texture of a material's slot at a place of a triangle, between its texels, as linear light.
fn seen(scene: &Scene, slot: usize, triangle: usize, [a, b, c]: [f32; 3]) -> Vec3 {
    let mesh = &scene.bodies[0].mesh;
    let material = &scene.materials[mesh.materials[triangle] as usize];
    let used = material.textures().nth(slot).flatten().unwrap();
    let texture = &scene.textures[used.texture as usize];
    let [p, q, r] = mesh.triangles[triangle].map(|i| mesh.uvs[i as usize]);
    let size = Vec2::new(texture.width as f32, texture.height as f32);
    let at = used.apply(p * a + q * b + r * c) * size - 0.5;
    let texel = |x: f32, y: f32| {
        let place = |t: f32, n: u32| t.rem_euclid(n as f32) as usize;
        let [r, g, b, _] =
            texture.texels[place(y, texture.height) * texture.width as usize + place(x, texture.width)];
        Vec3::from([r, g, b].map(|code| dpm_scene::srgb::to_linear(f32::from(code) / 255.0)))
    };
    let (x, y) = (at.x.floor(), at.y.floor());
    let row = |y: f32| texel(x, y).lerp(texel(x + 1.0, y), at.x - x);
    row(y).lerp(row(y + 1.0), at.y - y)
}

/// The first triangle at (0, 0), (1, 0), (0, 1) of its coordinates, with a picture of smooth colours.
fn smooth_picture() -> Glb {
    let texel = |i: usize| [(8 * (i % 32)) as u8, (8 * (i / 32)) as u8, 90, 255];
    with_image(&png(32, 32, &(0..1024).map(texel).collect::<Vec<_>>()))
}

#[test]
fn colours_of_vertices_are_painted_and_multiply_a_texture() {
    let coloured = |mut glb: Glb, colours: &[f32]| {
        let colours = glb.push_numbers("VEC3", colours);
        glb.set("/meshes/0/primitives/0/attributes/COLOR_0", json!(colours))
    };
    let plain = load(&smooth_picture());
    // The first and the last have the same coordinates on the picture.
    let colours = [[0.9, 0.1, 0.5], [0.2, 0.8, 0.5], [0.6, 0.7, 0.1], [0.9, 0.1, 0.5]];
    let painted = load(&coloured(tetrahedra(), colours.as_flattened()));
    let both = load(&coloured(smooth_picture(), colours.as_flattened()));
    assert!(painted.warnings.is_empty(), "{:?}", painted.warnings);
    assert!(both.warnings.iter().any(|w| w.contains("sampled anew")), "{:?}", both.warnings);
    let triangles = both.bodies[0].mesh.triangles.len();
    assert_eq!(triangles, plain.bodies[0].mesh.triangles.len());
    for triangle in 0..triangles {
        for weights in [[0.8, 0.1, 0.1], [0.3, 0.3, 0.4], [0.1, 0.6, 0.3], [0.2, 0.1, 0.7]] {
            let mesh = &plain.bodies[0].mesh;
            let colour = mesh.triangles[triangle].map(|i| match mesh.uvs[i as usize] {
                Vec2 { x: 1.0, .. } => colours[1],
                Vec2 { y: 1.0, .. } => colours[2],
                _ => colours[0],
            });
            let colour: Vec3 = colour.iter().zip(weights).map(|(c, w)| w * Vec3::from_array(*c)).sum();
            let at = |scene: &Scene| seen(scene, 0, triangle, weights);
            let (want, got) = (colour * at(&plain), at(&both));
            assert!((want - got).abs().max_element() < 0.02, "{triangle} {weights:?}: {got} for {want}");
        }
    }
    // White changes nothing, and the same mesh twice takes no more room.
    let white = load(&coloured(smooth_picture(), &[1.0; 12]));
    assert_eq!((white.textures.len(), white.materials.len()), (plain.textures.len(), plain.materials.len()));
}

#[test]
fn textures_on_a_second_set_of_coordinates_lie_where_the_file_says() {
    let emission = |set: u32| {
        json!([{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}, "emissiveFactor": [1, 1, 1],
                "emissiveTexture": {"index": 0, "texCoord": set}}])
    };
    // Coordinates of the second set: the first mirrored.
    let mirrored = [1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0];
    let file = |set: u32| {
        let mut glb = smooth_picture();
        let second = glb.push_numbers("VEC2", &mirrored);
        glb.set("/meshes/0/primitives/0/attributes/TEXCOORD_1", json!(second))
            .set("/materials", emission(set))
    };
    let (same, other) = (load(&file(0)), load(&file(1)));
    let anew = |scene: &Scene| scene.warnings.iter().any(|w| w.contains("sampled anew"));
    assert!(anew(&other) && !anew(&same), "{:?} {:?}", same.warnings, other.warnings);
    let wholly_second = {
        let mut glb = smooth_picture();
        let second = glb.push_numbers("VEC2", &mirrored);
        load(
            &glb.set("/meshes/0/primitives/0/attributes/TEXCOORD_0", json!(second))
                .set("/materials", emission(0)),
        )
    };
    for triangle in 0..other.bodies[0].mesh.triangles.len() {
        for weights in [[0.8, 0.1, 0.1], [0.3, 0.3, 0.4], [0.1, 0.6, 0.3]] {
            let pairs = [(0, &same), (3, &wholly_second)];
            for (slot, reference) in pairs {
                let (want, got) =
                    (seen(reference, slot, triangle, weights), seen(&other, slot, triangle, weights));
                assert!((want - got).abs().max_element() < 0.02, "{slot} {triangle}: {got} for {want}");
            }
        }
    }
}

#[test]
fn a_body_may_be_tracked_without_being_projected_on() {
    let mut options = select(&[("a", "left"), ("b", "right")]);
    options.bodies[0].projected = false;
    let scene = load_with(&tetrahedra(), &options);
    let seen: Vec<_> = scene.bodies.iter().map(|b| (b.name.as_str(), b.tracked, b.projected)).collect();
    assert_eq!(seen, [("a", Some(0), false), ("b", Some(1), true)]);
}

#[test]
fn a_lamp_is_not_projected_on_when_nobody_says_what_is() {
    let glb = tetrahedra()
        .set("/materials/1", json!({"emissiveFactor": [1.0, 1.0, 1.0]}))
        .set(
            "/meshes/1",
            json!({"primitives": [{"attributes": {"POSITION": 0}, "indices": 2, "material": 1}]}),
        )
        .set("/nodes/0/mesh", json!(1));
    let scene = load(&glb);
    let seen: Vec<_> = scene.bodies.iter().map(|b| (b.name.as_str(), b.tracked, b.projected)).collect();
    assert_eq!(seen, [("right", Some(0), true), ("virtual", None, false)]);
    assert!(scene.warnings[0].contains("'left'"));
}

#[test]
fn a_gltf_with_side_files_and_a_data_uri_equals_its_glb() {
    let glb = tetrahedra();
    let folder = std::env::temp_dir().join(format!("dpm-gltf-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("data 1.bin"), &glb.bin).unwrap();
    let beside = glb.clone().set("/buffers/0/uri", json!("data%201.bin"));
    std::fs::write(folder.join("scene.gltf"), beside.json.to_string()).unwrap();
    let inline = glb
        .clone()
        .set("/buffers/0/uri", json!(format!("data:application/octet-stream;base64,{}", base64(&glb.bin))));
    let from_file = dpm_scene::load(&folder.join("scene.gltf"), &LoadOptions::default()).unwrap();
    let from_text =
        dpm_scene::load_bytes(inline.json.to_string().as_bytes(), &LoadOptions::default()).unwrap();
    std::fs::remove_dir_all(&folder).unwrap();
    let expected = load(&glb);
    for scene in [from_file, from_text] {
        assert_eq!(scene.bodies[0].mesh.positions, expected.bodies[0].mesh.positions);
        assert_eq!(scene.bodies[0].mesh.triangles, expected.bodies[0].mesh.triangles);
    }
}

#[test]
fn real_scans_load() {
    let Some(folder) = scenes_folder() else {
        eprintln!("skipped: real_scans_load: no folder of scenes (set DPM_SCENES)");
        return;
    };
    for (file, metallic) in [("diffuse", 0.0), ("glossy", 0.0), ("rough-metal", 1.0), ("mirror", 1.0)] {
        let scene = dpm_scene::load(&folder.join(format!("bunny-venus-{file}.glb")), &LoadOptions::default())
            .unwrap();
        assert_promises(&scene);
        let seen: Vec<_> = scene.bodies.iter().map(|b| (b.name.as_str(), b.tracked)).collect();
        assert_eq!(seen, [("Bunny", Some(0)), ("Venus", Some(1))]);
        // The scans' README gives 69,451 and 70,000; faces without area may go.
        let counts: Vec<usize> = scene.bodies.iter().map(|b| b.mesh.triangles.len()).collect();
        assert!(
            (69_300..=69_451).contains(&counts[0]) && (69_800..=70_000).contains(&counts[1]),
            "{counts:?}"
        );
        let material = &scene.materials[scene.bodies[0].mesh.materials[0] as usize];
        assert_eq!(material.metallic, metallic, "{file}");
    }
}

/// `DPM_SCENES`, or `shared/scenes` beside the workspace.
fn scenes_folder() -> Option<std::path::PathBuf> {
    let given = std::env::var_os("DPM_SCENES").map(std::path::PathBuf::from);
    let beside = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/scenes");
    given.or(Some(beside)).filter(|p| p.join("bunny-venus-diffuse.glb").is_file())
}

/// Found in use, O12: the instances of EXT_mesh_gpu_instancing vanished without a word. Each stands where its node, its translation, rotation and scale put it.
#[test]
fn instances_stand_where_their_node_puts_them() {
    let mut file = tetrahedra();
    let floats = |values: &[f32]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let at = file.push_view(&floats(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 2.0, 0.0]));
    let turned = file.push_view(&floats(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, half, half, 0.0, 0.0, 0.0, 1.0]));
    let scaled = file.push_view(&floats(&[1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 0.0, 0.0, 0.0]));
    let accessor = |view: usize, kind: &str| json!({"bufferView": view, "componentType": 5126, "type": kind, "count": 3});
    let file = file
        .set("/accessors/3", accessor(at, "VEC3"))
        .set("/accessors/4", accessor(turned, "VEC4"))
        .set("/accessors/5", accessor(scaled, "VEC3"))
        .set("/extensionsUsed", json!(["EXT_mesh_gpu_instancing", "EXT_of_somebody"]))
        .set("/extensionsRequired", json!(["EXT_mesh_gpu_instancing"]))
        .set(
            "/nodes/0/extensions",
            json!({"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 3, "ROTATION": 4, "SCALE": 5}}}),
        );
    let scene = load_with(&file, &select(&[("left", "left")]));
    let body = &scene.bodies[0];
    // Two tetrahedra; the third is scaled to nothing, which is how exporters hide one.
    assert_eq!(body.mesh.triangles.len(), 8);
    let corners: Vec<Vec3> = body.mesh.positions.clone();
    let stands = |p: Vec3| corners.iter().any(|c| c.distance(p) < 1e-6);
    for p in [Vec3::ZERO, Vec3::new(0.1, 0.0, 0.0), Vec3::new(0.0, 0.1, 0.0), Vec3::new(0.0, 0.0, 0.1)] {
        assert!(stands(p), "{p}: {corners:?}");
        // A quarter turn about Z and twice the size, one metre to the right.
        assert!(stands(Vec3::new(1.0 - 2.0 * p.y, 2.0 * p.x, 2.0 * p.z)), "{p}: {corners:?}");
    }
    // What is not reproduced is told by name; what is, is not.
    let told = scene.warnings.join("; ");
    assert!(told.contains("EXT_of_somebody") && !told.contains("instancing"), "{told}");
}
