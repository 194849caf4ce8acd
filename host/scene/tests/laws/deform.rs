//! Morph targets and skins of glTF files: every vertex against the formulas of the specification, worked out by hand.

use crate::common;
use crate::common::{binds, skinned, tetrahedra, Glb, TETRAHEDRON};
use dpm_scene::{load_bytes, AnimationChoice, BodySelector, LoadOptions, Scene};
use glam::{DAffine3, DQuat, DVec3};
use serde_json::json;

fn load(glb: &Glb) -> Scene {
    load_with(glb, LoadOptions::default())
}

/// The scene with the tracked body "left".
fn load_with(glb: &Glb, options: LoadOptions) -> Scene {
    let bodies = vec![BodySelector { name: "left".into(), node: None, projected: true }];
    load_bytes(&glb.bytes(), &LoadOptions { bodies, ..options }).unwrap_or_else(|e| panic!("{e}"))
}

fn corners() -> [DVec3; 4] {
    TETRAHEDRON.0.map(|c| DVec3::from_array(c.map(f64::from)))
}

/// The greatest distance of a vertex of a body from the nearest of these points of the world.
fn off(scene: &Scene, name: &str, truth: &[DVec3]) -> f64 {
    let body = scene.bodies.iter().find(|b| b.name == name).unwrap();
    let seen = body.mesh.positions.iter().map(|p| body.world_from_body_rest.transform_point3(p.as_dvec3()));
    let nearest = |p: DVec3| truth.iter().map(|c| c.distance(p)).fold(f64::INFINITY, f64::min);
    seen.map(nearest).fold(0.0, f64::max)
}

/// Six times the volume: above 0 if the faces are counter-clockwise from outside, and the normals must say the same.
fn volume(scene: &Scene, name: &str) -> f64 {
    let mesh = &scene.bodies.iter().find(|b| b.name == name).unwrap().mesh;
    let at = |i: u32| mesh.positions[i as usize].as_dvec3();
    for t in &mesh.triangles {
        let [a, b, c] = t.map(at);
        let face = (b - a).cross(c - a).normalize();
        assert!(t.iter().all(|i| mesh.normals[*i as usize].as_dvec3().dot(face) > 0.999));
    }
    mesh.triangles.iter().map(|t| at(t[0]).dot(at(t[1]).cross(at(t[2])))).sum()
}

fn told(scene: &Scene) -> String {
    scene.warnings.join("\n")
}

const PRIMITIVE: &str = "/meshes/0/primitives/0";

/// Two targets: one moves each corner its own way, the other one corner only.
fn with_targets() -> (Glb, [[DVec3; 4]; 2]) {
    let first = [0.3f32, 0.0, 0.1, 0.0, 0.2, 0.0, -0.1, 0.0, 0.0, 0.05, 0.05, 0.4];
    let second = [0.0f32, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3];
    let mut glb = tetrahedra();
    let accessors = [first, second].map(|values| glb.push_numbers("VEC3", &values));
    let glb = glb.set(
        &format!("{PRIMITIVE}/targets"),
        json!([{"POSITION": accessors[0]}, {"POSITION": accessors[1]}]),
    );
    let moves = [first, second].map(|values| {
        let at =
            |i: usize| DVec3::new(values[3 * i].into(), values[3 * i + 1].into(), values[3 * i + 2].into());
        std::array::from_fn(at)
    });
    (glb, moves)
}

/// Each node has the weights of its mesh, or its own; without any the mesh is as it is.
#[test]
fn morph_targets_are_added_by_their_weights() {
    let (glb, [first, second]) = with_targets();
    let truth = |x: f64, a: f64, b: f64| -> Vec<DVec3> {
        (0..4).map(|i| DVec3::new(x, 0.0, 0.0) + corners()[i] + a * first[i] + b * second[i]).collect()
    };
    let plain = load(&glb);
    assert!(off(&plain, "left", &truth(-0.2, 0.0, 0.0)) < 1e-7, "{}", told(&plain));
    assert!(!told(&plain).contains("morph"), "nothing is lost: {}", told(&plain));
    let glb = glb.set("/meshes/0/weights", json!([0.5, -0.25])).set("/nodes/1/weights", json!([0.0, 1.0]));
    let scene = load(&glb);
    assert!(off(&scene, "left", &truth(-0.2, 0.5, -0.25)) < 1e-7);
    assert!(off(&scene, "static", &truth(0.2, 0.0, 1.0)) < 1e-7);
    assert!(volume(&scene, "left") > 0.0);
}

/// A place as JSON of a node, and the same multiplied by hand.
fn place(at: [f64; 3], turn: DQuat, scale: [f64; 3]) -> (serde_json::Value, DAffine3) {
    let json = json!({"translation": at, "rotation": turn.to_array(), "scale": scale});
    (json, DAffine3::from_scale_rotation_translation(scale.into(), turn, at.into()))
}

/// The right tetrahedron hangs on two joints, of which one hangs on the other. `scale` is that of the first.
fn with_skin(scale: [f64; 3]) -> (Glb, [DVec3; 4]) {
    let (shoulder, shoulder_at) = place([0.1, 0.4, 0.0], DQuat::from_rotation_z(0.7), scale);
    let (elbow, elbow_at) = place([0.0, 0.3, 0.2], DQuat::from_rotation_x(-0.4), [1.0; 3]);
    let truth = skinned(corners(), [shoulder_at, shoulder_at * elbow_at]);
    (common::with_skin(shoulder, elbow), truth)
}

/// The joints say where a skin is, and not the node that shows it.
#[test]
fn a_skin_follows_its_joints_and_not_its_node() {
    let (glb, truth) = with_skin([1.0; 3]);
    let scene = load(&glb);
    assert!(off(&scene, "static", &truth) < 1e-6, "{}", told(&scene));
    assert!(volume(&scene, "static") > 0.0);
    assert!(off(&scene, "left", &corners().map(|c| c - DVec3::new(0.2, 0.0, 0.0))) < 1e-7);
    assert!(!told(&scene).contains("skin"), "nothing is lost: {}", told(&scene));
    // A node without size shows its skin all the same.
    let nowhere = load(&glb.set("/nodes/1/scale", json!([0.0, 0.0, 0.0])));
    assert!(off(&nowhere, "static", &truth) < 1e-6, "{}", told(&nowhere));
}

/// Mirrored joints turn a mesh inside out, and its faces must stay outside.
#[test]
fn a_skin_on_mirrored_joints_keeps_its_faces_outside() {
    let (glb, truth) = with_skin([-1.0, 1.0, 1.0]);
    let scene = load(&glb);
    assert!(off(&scene, "static", &truth) < 1e-6, "{}", told(&scene));
    assert!(volume(&scene, "static") > 0.0);
}

/// Normals of the file turn with the joints, also where these mirror and stretch.
#[test]
fn normals_turn_with_the_skin() {
    let (points, indices) = TETRAHEDRON;
    let corners: Vec<[f32; 3]> = indices.iter().map(|i| points[*i as usize]).collect();
    let normal = |face: &[[f32; 3]]| {
        let [a, b, c] = [face[0], face[1], face[2]].map(glam::Vec3::from_array);
        (b - a).cross(c - a).normalize().to_array()
    };
    let normals: Vec<[f32; 3]> = corners.chunks_exact(3).flat_map(|face| [normal(face); 3]).collect();
    for scale in [[1.0; 3], [1.0, 3.0, 1.0], [-1.0, 3.0, 1.0]] {
        let (mut glb, _) = with_skin(scale);
        let positions = glb.push_numbers("VEC3", corners.as_flattened());
        let normals = glb.push_numbers("VEC3", normals.as_flattened());
        let joints = glb.push_bytes("VEC4", &[0; 48]);
        let shares = glb.push_numbers("VEC4", &[1.0, 0.0, 0.0, 0.0].repeat(12));
        let attributes =
            json!({"POSITION": positions, "NORMAL": normals, "JOINTS_0": joints, "WEIGHTS_0": shares});
        let scene = load(&glb.set("/meshes/1/primitives/0", json!({"attributes": attributes})));
        assert!(volume(&scene, "static") > 0.0, "{scale:?}");
    }
}

/// A skin on a tracked body lies in its space, wherever the joints are in the tree.
#[test]
fn a_skin_of_a_tracked_body_lies_at_its_pose() {
    let (glb, truth) = with_skin([1.0; 3]);
    let glb = glb
        .set("/nodes/0/rotation", json!(DQuat::from_rotation_y(0.5).to_array()))
        .set("/nodes/0/children", json!([1]))
        .set("/scenes/0/nodes", json!([0, 2]));
    let all: Vec<DVec3> = corners()
        .iter()
        .map(|c| DQuat::from_rotation_y(0.5) * *c - DVec3::new(0.2, 0.0, 0.0))
        .chain(truth)
        .collect();
    let scene = load(&glb);
    assert_eq!(scene.bodies.len(), 1);
    assert!(off(&scene, "left", &all) < 1e-6, "{}", told(&scene));
}

/// Targets move a vertex before the skin does.
#[test]
fn a_morphed_mesh_is_skinned() {
    let (mut glb, truth) = with_skin([1.0; 3]);
    let target = glb.push_numbers("VEC3", &[[0.1f32, 0.0, 0.0]; 4].concat());
    let glb = glb
        .set("/meshes/1/primitives/0/targets", json!([{"POSITION": target}]))
        .set("/meshes/1/weights", json!([2.0]));
    let still = off(&load(&glb), "static", &truth);
    assert!(still > 0.15, "{still}");
    // The first corner hangs on the first joint alone, which turns its way.
    let scene = load(&glb);
    let turned = DQuat::from_rotation_z(0.7) * DQuat::from_rotation_y(0.3) * DVec3::new(0.2, 0.0, 0.0);
    let body = scene.bodies.iter().find(|b| b.name == "static").unwrap();
    let nearest = body.mesh.positions.iter().map(|p| p.as_dvec3().distance(truth[0] + turned));
    assert!(nearest.fold(f64::INFINITY, f64::min) < 1e-6);
}

#[test]
fn joints_that_turn_deform_the_skin() {
    let (mut glb, truth) = with_skin([1.0; 3]);
    let times = glb.push_numbers("SCALAR", &[0.0, 1.0]);
    let turn = |angle| DQuat::from_rotation_x(angle).to_array().map(|x| x as f32);
    let turns = glb.push_numbers("VEC4", &[turn(-0.4), turn(1.0)].concat());
    let glb = glb.set(
        "/animations",
        json!([{
            "channels": [{"sampler": 0, "target": {"node": 3, "path": "rotation"}}],
            "samplers": [{"input": times, "output": turns}]
        }]),
    );
    let scene = load(&glb);
    assert!(told(&scene).contains("deforms 1 meshes"), "{}", told(&scene));
    assert!(off(&scene, "static/right", &truth) < 1e-6, "at the beginning it is as at rest");
    let off = load_with(&glb, LoadOptions { animation: AnimationChoice::Off, ..LoadOptions::default() });
    assert!(!told(&off).contains("skin") && off.bodies.iter().all(|b| b.deforms.is_none()), "{}", told(&off));
}

/// What is broken is left out and named, and the mesh is where its node is.
#[test]
fn broken_skins_and_targets_are_left_out() {
    let right = || corners().map(|c| c + DVec3::new(0.2, 0.0, 0.0));
    let is_plain = |glb: Glb, words: &str| {
        let scene = load(&glb);
        assert!(off(&scene, "static", &right()) < 1e-7, "{words}");
        assert!(told(&scene).contains(words), "{words} is missing in\n{}", told(&scene));
    };
    let skin = || with_skin([1.0; 3]).0;
    is_plain(skin().set("/skins/0/joints", json!([])), "has no 'joints'; the skin is not used");
    is_plain(skin().set("/skins/0/joints", json!([2, 900])), "node 900");
    is_plain(skin().set("/skins/0/inverseBindMatrices", json!(0)), "no matrix of floats for each joint");
    let attribute = |key: &str| format!("/meshes/1/primitives/0/attributes/{key}");
    is_plain(skin().set(&attribute("WEIGHTS_0"), json!(0)), "serves as WEIGHTS_0");
    let of_floats = skin();
    let shares = of_floats.json.pointer(&attribute("WEIGHTS_0")).cloned().unwrap();
    is_plain(of_floats.set(&attribute("JOINTS_0"), shares), "unsigned 8 or 16 bits");
    let (glb, _) = with_targets();
    let targets = format!("{PRIMITIVE}/targets");
    let weights = json!([1.0, 1.0]);
    is_plain(
        glb.set(&targets, json!([{"POSITION": 1}])).set("/meshes/0/weights", weights),
        "its morph targets are not used",
    );
    let refused =
        load_bytes(&tetrahedra().set("/meshes/0/weights", json!(["a"])).bytes(), &LoadOptions::default());
    assert!(refused.unwrap_err().to_string().contains("'weights' must be a list of numbers"));
}

/// Numbers of joints that the skin does not have count for nothing.
#[test]
fn a_vertex_of_unknown_joints_follows_the_first_one() {
    let (mut glb, truth) = with_skin([1.0; 3]);
    let joints = glb.push_bytes("VEC4", &[[0, 1, 0, 0], [0, 1, 0, 0], [9, 9, 9, 9], [0, 1, 0, 0]].concat());
    let glb = glb.set("/meshes/1/primitives/0/attributes/JOINTS_0", json!(joints));
    let (_, shoulder) = place([0.1, 0.4, 0.0], DQuat::from_rotation_z(0.7), [1.0; 3]);
    let mut truth = truth;
    truth[2] = (shoulder * binds()[0]).transform_point3(corners()[2]);
    let scene = load(&glb);
    assert!(off(&scene, "static", &truth) < 1e-6, "{}", told(&scene));
}

/// Two tetrahedra in one mesh, each on a joint of its own: the second joint hangs on the first one, and both turn.
fn of_pieces() -> Glb {
    let (points, indices) = TETRAHEDRON;
    let mut glb = with_skin([1.0; 3]).0;
    let both = [points, points].concat();
    let positions = glb.push_numbers("VEC3", both.as_flattened());
    let corners: Vec<u8> =
        indices.iter().map(|i| *i as u8).chain(indices.iter().map(|i| *i as u8 + 4)).collect();
    let corners = glb.push_bytes("SCALAR", &corners);
    let joints = glb.push_bytes("VEC4", &[[0u8; 4].repeat(4), [1, 0, 0, 0].repeat(4)].concat());
    let shares = glb.push_numbers("VEC4", &[1.0, 0.0, 0.0, 0.0].repeat(8));
    let times = glb.push_numbers("SCALAR", &[0.0, 2.0]);
    let turns = |axis: DVec3| {
        let keys = [0.0, 1.2].map(|angle| DQuat::from_axis_angle(axis, angle).to_array().map(|x| x as f32));
        keys.concat()
    };
    let (first, second) = (turns(DVec3::Z), turns(DVec3::X));
    let (first, second) = (glb.push_numbers("VEC4", &first), glb.push_numbers("VEC4", &second));
    let channel = |sampler: usize, node: usize| json!({"sampler": sampler, "target": {"node": node, "path": "rotation"}});
    glb.set(
        "/meshes/1/primitives/0",
        json!({"attributes": {"POSITION": positions, "JOINTS_0": joints, "WEIGHTS_0": shares}, "indices": corners}),
    )
    .set(
        "/animations",
        json!([{
            "channels": [channel(0, 2), channel(1, 3)],
            "samplers": [{"input": times, "output": first}, {"input": times, "output": second}]
        }]),
    )
}

/// World-from-mesh of both pieces of [`of_pieces`] after half of the animation.
fn pieces_half_way() -> [DAffine3; 2] {
    let shoulder =
        DAffine3::from_rotation_translation(DQuat::from_rotation_z(0.6), DVec3::new(0.1, 0.4, 0.0));
    let elbow = DAffine3::from_rotation_translation(DQuat::from_rotation_x(0.6), DVec3::new(0.0, 0.3, 0.2));
    [shoulder * binds()[0], shoulder * elbow * binds()[1]]
}

/// The greatest distance of the vertices of the body from the tetrahedron under `truth`, a second after the start.
fn off_after_a_second(scene: &Scene, name: &str, carrier: DAffine3, truth: DAffine3) -> f64 {
    let body = scene.bodies.iter().find(|b| b.name == name).unwrap_or_else(|| {
        panic!("no {name} among {:?}", scene.bodies.iter().map(|b| &b.name).collect::<Vec<_>>())
    });
    let place = carrier * body.motion.as_ref().unwrap().at(1_000_000_000);
    let corners = corners().map(|c| truth.transform_point3(c));
    let seen = body.mesh.positions.iter().map(|p| place.transform_point3(p.as_dvec3()));
    let nearest = |p: DVec3| corners.iter().map(|c| c.distance(p)).fold(f64::INFINITY, f64::min);
    seen.map(nearest).fold(0.0, f64::max)
}

/// A skin of rigid pieces, as machines have, plays: each piece is a part that moves with its joint.
#[test]
fn a_skin_of_rigid_pieces_moves_with_its_joints() {
    let named = |glb: Glb| {
        let glb = glb.set("/nodes/2/name", json!("shoulder")).set("/nodes/3/name", json!("elbow"));
        load(&glb)
    };
    let scene = named(of_pieces());
    assert!(!told(&scene).contains("its skin"), "{}", told(&scene));
    let truth = pieces_half_way();
    let here = DAffine3::IDENTITY;
    for (name, truth) in [("static/shoulder", truth[0]), ("static/elbow", truth[1])] {
        let off = off_after_a_second(&scene, name, here, truth);
        assert!(off < 1e-6, "{name}: {off}");
        assert_eq!(scene.bodies.iter().find(|b| b.name == name).unwrap().mesh.triangles.len(), 4);
        assert!(volume(&scene, name) > 0.0);
    }
    // On a tracked body: with the body's pose, wherever the tracker says it is.
    let on_body = of_pieces().set("/nodes/0/children", json!([1, 2])).set("/scenes/0/nodes", json!([0]));
    let scene = named(on_body);
    let carrier = DAffine3::from_rotation_translation(DQuat::from_rotation_y(1.0), DVec3::new(1.0, 2.0, 3.0));
    for (name, truth) in [("left/shoulder", truth[0]), ("left/elbow", truth[1])] {
        assert_eq!(scene.bodies.iter().find(|b| b.name == name).unwrap().tracked, Some(0));
        let off = off_after_a_second(&scene, name, carrier, carrier * truth);
        assert!(off < 1e-6, "{name}: {off}");
    }
}

/// One face between two joints, and the whole skin bends; with a joint of another body it is at rest.
#[test]
fn a_skin_is_rigid_or_bends_or_is_at_rest() {
    let mut bent = of_pieces();
    let joints = bent.push_bytes("VEC4", &[[0u8; 4].repeat(3), [1, 0, 0, 0].repeat(5)].concat());
    let bent = bent.set("/meshes/1/primitives/0/attributes/JOINTS_0", json!(joints));
    // All corners hang on the same joint most of all, and a quarter on the other.
    let mut shared = of_pieces();
    let shares = shared.push_numbers("VEC4", &[0.75, 0.25, 0.0, 0.0].repeat(8));
    let joints = shared.push_bytes("VEC4", &[0, 1, 0, 0].repeat(8));
    let attributes = "/meshes/1/primitives/0/attributes";
    let shared = shared
        .set(&format!("{attributes}/WEIGHTS_0"), json!(shares))
        .set(&format!("{attributes}/JOINTS_0"), json!(joints));
    let astray = of_pieces().set("/nodes/0/children", json!([2])).set("/scenes/0/nodes", json!([0, 1]));
    for (glb, what, bends) in
        [(bent, "bends", true), (shared, "shares", true), (astray, "joints of a tracked body", false)]
    {
        let scene = load(&glb);
        let is_told = told(&scene).contains("node 1 'right': its skin is shown as its joints lie");
        assert_eq!(is_told, !bends, "{what}: {}", told(&scene));
        assert!(scene.bodies.iter().all(|b| b.motion.is_none()), "{what}");
        assert_eq!(scene.bodies.iter().any(|b| b.deforms.is_some()), bends, "{what}");
    }
}
