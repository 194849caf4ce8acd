//! A picture on a body: which materials show it, and where it has no place.

use crate::common::{png, tetrahedra, Glb};
use dpm_scene::{load_bytes, BodySelector, Limits, LoadOptions, Scene, Wrap};
use glam::{Vec2, Vec3};
use serde_json::json;

/// The scene with the tracked body "left"; both bodies have the same mesh and material.
fn load(glb: &Glb) -> Scene {
    let bodies = vec![BodySelector { name: "left".into(), node: None, projected: true }];
    load_bytes(&glb.bytes(), &LoadOptions { bodies, ..LoadOptions::default() }).unwrap()
}

fn picture() -> Vec<u8> {
    png(2, 1, &[[255, 0, 0, 255], [0, 128, 255, 255]])
}

#[test]
fn a_picture_takes_the_place_of_the_colours_of_one_body() {
    let mut scene = load(&tetrahedra());
    let before = scene.clone();
    scene.show_picture(0, picture(), &Limits::default()).unwrap();
    let of = |scene: &Scene, name: &str| {
        let body = scene.bodies.iter().find(|b| b.name == name).unwrap();
        let materials: Vec<u32> = body.mesh.materials.clone();
        assert!(materials.iter().all(|m| *m == materials[0]));
        scene.materials[materials[0] as usize].clone()
    };
    let (shown, plain) = (of(&scene, "left"), of(&scene, "static"));
    assert_eq!(format!("{plain:?}"), format!("{:?}", of(&before, "static")), "nothing else changes");
    let used = shown.base_color_texture.unwrap();
    assert_eq!((shown.base_color, shown.alpha), (Vec3::ONE, 1.0));
    assert_eq!((shown.roughness, shown.metallic, shown.ior), (plain.roughness, plain.metallic, plain.ior));
    assert_eq!((used.apply(Vec2::new(0.25, 0.75))), Vec2::new(0.25, 0.75));
    let texture = &scene.textures[used.texture as usize];
    assert_eq!(texture.texels, [[255, 0, 0, 255], [0, 128, 255, 255]]);
    assert_eq!((texture.width, texture.height, texture.srgb), (2, 1, true));
    assert_eq!((texture.wrap_u, texture.wrap_v), (Wrap::Repeat, Wrap::Repeat));
}

/// An unlit material sends out its base colour, so it sends out the picture.
#[test]
fn an_unlit_material_shows_the_picture_as_it_is() {
    let unlit = tetrahedra().set("/materials/0/extensions", json!({"KHR_materials_unlit": {}}));
    let mut scene = load(&unlit);
    scene.show_picture(0, picture(), &Limits::default()).unwrap();
    let left = scene.bodies.iter().find(|b| b.name == "left").unwrap();
    let shown = &scene.materials[left.mesh.materials[0] as usize];
    assert_eq!((shown.emissive, shown.base_color), (Vec3::ONE, Vec3::ZERO));
    assert!(shown.emissive_texture.is_some() && shown.base_color_texture.is_none());
}

#[test]
fn a_picture_without_a_place_or_that_is_none_is_refused() {
    let limits = Limits::default();
    let refused = |glb: Glb, bytes: Vec<u8>, limits: &Limits| {
        let mut scene = load(&glb);
        let before = (scene.materials.len(), scene.textures.len());
        let told = scene.show_picture(0, bytes, limits).unwrap_err().to_string();
        assert_eq!((scene.materials.len(), scene.textures.len()), before, "nothing has changed: {told}");
        told
    };
    let mut bare = tetrahedra();
    bare.json["meshes"][0]["primitives"][0]["attributes"].as_object_mut().unwrap().remove("TEXCOORD_0");
    let told = refused(bare, picture(), &limits);
    assert!(told.contains("100 % of its surface has no texture coordinates"), "{told}");
    let mut painted = tetrahedra();
    let colours = painted.push_numbers("VEC3", &[0.2, 0.4, 0.6].repeat(4));
    let painted = painted.set("/meshes/0/primitives/0/attributes/COLOR_0", json!(colours));
    let told = refused(painted, picture(), &limits);
    assert!(told.contains("its vertices have colours"), "{told}");
    let told = refused(tetrahedra(), b"GIF89a".to_vec(), &limits);
    assert!(told.contains("picture"), "{told}");
    let told = refused(tetrahedra(), picture()[..20].to_vec(), &limits);
    assert!(told.contains("picture"), "{told}");
    let few = Limits { texels: 1, ..Limits::default() };
    let told = refused(tetrahedra(), picture(), &few);
    assert!(told.contains("texels"), "{told}");
}
