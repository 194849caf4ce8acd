//! Meshes that an animation deforms: every vertex at any time against the formulas of the specification, worked out by hand.

use crate::common::{skinned, tetrahedra, with_skin, Glb, TETRAHEDRON};
use dpm_scene::{load_bytes, BodySelector, Deformed, LoadOptions, Scene};
use glam::{DAffine3, DMat3, DQuat, DVec3};
use serde_json::{json, Value};

const S: i64 = 1_000_000_000;

/// The scene with the tracked body "left".
fn load(glb: &Glb) -> Scene {
    let bodies = vec![BodySelector { name: "left".into(), node: None, projected: true }];
    let options = LoadOptions { bodies, ..LoadOptions::default() };
    load_bytes(&glb.bytes(), &options).unwrap_or_else(|e| panic!("{e}"))
}

fn told(scene: &Scene) -> String {
    scene.warnings.join("\n")
}

fn corners() -> [DVec3; 4] {
    TETRAHEDRON.0.map(|c| DVec3::from_array(c.map(f64::from)))
}

/// A channel of a node by its path, as times and values of each key.
type Channel<'a> = (usize, &'a str, &'a [f32], &'a [f32]);

/// Adds an animation with linear keys.
fn animate(mut glb: Glb, channels: &[Channel]) -> Glb {
    let mut samplers = vec![];
    let mut targets: Vec<Value> = vec![];
    for (node, path, times, values) in channels {
        let kind = match *path {
            "rotation" => "VEC4",
            "weights" => "SCALAR",
            _ => "VEC3",
        };
        let (input, output) = (glb.push_numbers("SCALAR", times), glb.push_numbers(kind, values));
        targets.push(json!({"sampler": samplers.len(), "target": {"node": node, "path": path}}));
        samplers.push(json!({"input": input, "output": output}));
    }
    glb.set("/animations", json!([{"name": "play", "channels": targets, "samplers": samplers}]))
}

/// The positions of the body `name` at `t_ns`, in its own space, after checks of what holds for every mesh.
fn at(scene: &Scene, name: &str, t_ns: i64) -> Vec<DVec3> {
    let names: Vec<_> = scene.bodies.iter().map(|b| &b.name).collect();
    let body =
        scene.bodies.iter().find(|b| b.name == name).unwrap_or_else(|| panic!("no {name} among {names:?}"));
    let mut now = Deformed::default();
    body.deforms.as_ref().unwrap_or_else(|| panic!("{name} is rigid")).at(t_ns, &mut now);
    let (n, mesh) = (body.mesh.positions.len(), &body.mesh);
    assert_eq!([n; 3], [now.positions.len(), now.normals.len(), now.tangents.len()]);
    let place = |i: u32| now.positions[i as usize].as_dvec3();
    for t in &mesh.triangles {
        let [a, b, c] = t.map(place);
        let face = (b - a).cross(c - a).normalize();
        for i in t.map(|i| i as usize) {
            // The file has no normals, so those are the faces' own.
            let (normal, tangent) = (now.normals[i].as_dvec3(), now.tangents[i].truncate().as_dvec3());
            assert!(normal.dot(face) > 0.9999, "{normal} {face}");
            assert!((tangent.length() - 1.0).abs() < 1e-5 && tangent.dot(normal).abs() < 1e-5);
        }
    }
    let volume: f64 = mesh.triangles.iter().map(|t| t.map(place)).map(|[a, b, c]| a.dot(b.cross(c))).sum();
    assert!(volume > 0.0, "inside out at {t_ns}");
    if t_ns == 0 {
        assert!(mesh.positions == now.positions && mesh.normals == now.normals, "the scene shows time 0");
    }
    let [lower, upper] = body.deforms.as_ref().unwrap().bounds().map(|corner| corner.as_dvec3());
    let slack = DVec3::splat(1e-3);
    let holds = |p: DVec3| p.cmpge(lower - slack).all() && p.cmple(upper + slack).all();
    assert!(mesh.triangles.iter().flatten().all(|i| holds(place(*i))), "outside of {lower} to {upper}");
    now.positions.iter().map(|p| p.as_dvec3()).collect()
}

/// The greatest distance of a position from the nearest of `truth`, and of one of `truth` from the nearest position.
fn off(seen: &[DVec3], truth: &[DVec3]) -> f64 {
    let nearest = |p: &DVec3, all: &[DVec3]| all.iter().map(|q| p.distance(*q)).fold(f64::INFINITY, f64::min);
    let there = seen.iter().map(|p| nearest(p, truth)).fold(0.0, f64::max);
    truth.iter().map(|p| nearest(p, seen)).fold(there, f64::max)
}

const TARGET: [f32; 12] = [0.3, 0.0, 0.1, 0.0, 0.2, 0.0, -0.1, 0.0, 0.0, 0.05, 0.05, 0.4];

/// The right tetrahedron hangs on a shoulder and an elbow. For two seconds the shoulder turns, the elbow grows and is pushed
/// away, and a morph target comes in.
fn puppet(shoulder_scale: [f64; 3]) -> Glb {
    let shoulder = json!({"translation": [0.1, 0.4, 0.0], "scale": shoulder_scale});
    let mut glb = with_skin(shoulder, json!({"rotation": DQuat::from_rotation_x(-0.4).to_array()}));
    let target = glb.push_numbers("VEC3", &TARGET);
    let glb = glb.set("/meshes/1/primitives/0/targets", json!([{"POSITION": target}]));
    let turns = [0.0, 1.2].map(|a| DQuat::from_rotation_z(a).to_array().map(|x| x as f32)).concat();
    animate(
        glb,
        &[
            (2, "rotation", &[0.0, 2.0], &turns),
            (3, "translation", &[0.0, 2.0], &[0.0, 0.3, 0.2, 0.0, 0.5, 0.0]),
            (3, "scale", &[0.0, 2.0], &[1.0, 1.0, 1.0, 1.0, 2.0, 0.5]),
            (1, "weights", &[0.0, 2.0], &[0.0, 0.8]),
        ],
    )
}

/// Where the corners of [`puppet`] are a share `s` of the way.
fn puppet_at(s: f64, shoulder_scale: [f64; 3]) -> [DVec3; 4] {
    let shoulder = DAffine3::from_scale_rotation_translation(
        shoulder_scale.into(),
        DQuat::from_rotation_z(1.2 * s),
        DVec3::new(0.1, 0.4, 0.0),
    );
    let elbow = DAffine3::from_scale_rotation_translation(
        DVec3::new(1.0, 1.0 + s, 1.0 - 0.5 * s),
        DQuat::from_rotation_x(-0.4),
        DVec3::new(0.0, 0.3 + 0.2 * s, 0.2 - 0.2 * s),
    );
    let moved = std::array::from_fn(|i| {
        let target = DVec3::new(TARGET[3 * i].into(), TARGET[3 * i + 1].into(), TARGET[3 * i + 2].into());
        corners()[i] + 0.8 * s * target
    });
    skinned(moved, [shoulder, shoulder * elbow])
}

/// Skin, sizes and morph target together, at any time and over and over; and with a mirroring joint.
#[test]
fn a_skin_that_bends_follows_its_joints() {
    for scale in [[1.0; 3], [1.0, 1.5, 1.0], [-1.0, 1.0, 1.0]] {
        let scene = load(&puppet(scale));
        assert!(told(&scene).contains("deforms 1 meshes, 12 vertices"), "{}", told(&scene));
        for share in [0.0, 0.13, 0.5, 0.999] {
            let t = (share * 2e9) as i64;
            for round in [0, 3, -2] {
                let off = off(&at(&scene, "static/right", t + round * 2 * S), &puppet_at(share, scale));
                assert!(off < 1e-6, "{scale:?}, {share}: {off}");
            }
        }
    }
}

/// All of it below the tracked body: in the body's own space, wherever the tracker says that this is. The node that shows the
/// skin does not say where it is.
#[test]
fn what_deforms_on_a_tracked_body_moves_with_it() {
    let glb = puppet([1.0; 3]).set("/nodes/0/children", json!([1, 2])).set("/scenes/0/nodes", json!([0]));
    let scene = load(&glb.set("/nodes/0/rotation", json!(DQuat::from_rotation_y(0.5).to_array())));
    let body = scene.bodies.iter().find(|b| b.name == "left/right").unwrap();
    assert!(body.tracked == Some(0) && body.motion.is_none() && body.projected);
    assert!(off(&at(&scene, "left/right", S), &puppet_at(0.5, [1.0; 3])) < 1e-6);
    let carrier = &scene.bodies[0];
    assert_eq!((carrier.name.as_str(), carrier.mesh.triangles.len()), ("left", 4));
    assert_eq!(body.world_from_body_rest, carrier.world_from_body_rest);
}

/// As files often have it: the node that shows the skin is the body, and the joints lie beside it. They move against the body
/// as they do against its place at rest.
#[test]
fn joints_beside_the_body_move_against_its_place_at_rest() {
    let glb = puppet([1.0; 3]).set("/nodes/0/children", json!([1])).set("/scenes/0/nodes", json!([0, 2]));
    let turn = DQuat::from_rotation_y(0.5);
    let scene = load(&glb.set("/nodes/0/rotation", json!(turn.to_array())));
    let body = scene.bodies.iter().find(|b| b.name == "left/right").unwrap();
    let rest = body.world_from_body_rest;
    assert!(rest.abs_diff_eq(DAffine3::from_rotation_translation(turn, DVec3::new(-0.2, 0.0, 0.0)), 1e-7));
    let truth = puppet_at(0.5, [1.0; 3]).map(|p| rest.inverse().transform_point3(p));
    assert!(off(&at(&scene, "left/right", S), &truth) < 1e-6, "{}", told(&scene));
}

/// A size that changes is that of everything below the node, and what turns below it turns in the changed space.
#[test]
fn sizes_change_with_all_that_hangs_below() {
    let glb = tetrahedra()
        .set("/nodes/1/children", json!([2]))
        .set("/nodes/2", json!({"mesh": 0, "name": "top", "translation": [0.0, 0.2, 0.0]}));
    let turns = [0.0, 1.0].map(|a| DQuat::from_rotation_z(a).to_array().map(|x| x as f32)).concat();
    let glb = animate(
        glb,
        &[(1, "scale", &[0.0, 1.0], &[1.0, 1.0, 1.0, 2.0, 1.0, 3.0]), (2, "rotation", &[0.0, 1.0], &turns)],
    );
    let scene = load(&glb);
    for share in [0.0, 0.25, 0.75] {
        let t = (share * 1e9) as i64;
        let scale = DAffine3::from_scale_rotation_translation(
            DVec3::new(1.0 + share, 1.0, 1.0 + 2.0 * share),
            DQuat::IDENTITY,
            DVec3::new(0.2, 0.0, 0.0),
        );
        let top = scale
            * DAffine3::from_rotation_translation(DQuat::from_rotation_z(share), DVec3::new(0.0, 0.2, 0.0));
        for (name, map) in [("static/right", scale), ("static/top", top)] {
            let off = off(&at(&scene, name, t), &corners().map(|c| map.transform_point3(c)));
            assert!(off < 1e-6, "{name}, {share}: {off}");
        }
    }
    // A node that moves under an uneven size is sheared, so it is no rigid part.
    let uneven = tetrahedra()
        .set("/nodes/1/scale", json!([1, 2, 1]))
        .set("/nodes/1/children", json!([2]))
        .set("/nodes/2", json!({"name": "sheared", "mesh": 0}));
    let scene = load(&animate(uneven, &[(2, "rotation", &[0.0, 1.0], &turns)]));
    let above = DAffine3::from_scale_rotation_translation(
        DVec3::new(1.0, 2.0, 1.0),
        DQuat::IDENTITY,
        DVec3::new(0.2, 0.0, 0.0),
    );
    let map = above * DAffine3::from_rotation_z(0.5);
    let sheared = at(&scene, "static/sheared", S / 2);
    assert!(off(&sheared, &corners().map(|c| map.transform_point3(c))) < 1e-6, "{}", told(&scene));
    // A scale of one body's own node is not that of the body, which a tracker moves.
    let own = load(&animate(tetrahedra(), &[(0, "scale", &[0.0, 1.0], &[1.0, 1.0, 1.0, 2.0, 1.0, 3.0])]));
    assert!(own.bodies.iter().all(|b| b.deforms.is_none()), "{}", told(&own));
}

/// Weights by cubic splines: of each key all in-tangents, all values and all out-tangents, in this order.
#[test]
fn weights_of_several_targets_are_splines_of_their_own() {
    let mut glb = tetrahedra();
    let other: Vec<f32> = TARGET.iter().rev().copied().collect();
    let targets = [glb.push_numbers("VEC3", &TARGET), glb.push_numbers("VEC3", &other)];
    let glb = glb
        .set("/meshes/0/primitives/0/targets", json!([{"POSITION": targets[0]}, {"POSITION": targets[1]}]));
    // Weight 0 goes from 0 to 1 with slopes 0 and 3, weight 1 from 1 to 0.5 with slopes -1 and 0.
    let values = [[9.0, 9.0], [0.0, 1.0], [0.0, -1.0], [3.0, 0.0], [1.0, 0.5], [9.0, 9.0]].concat();
    let glb = animate(glb, &[(1, "weights", &[0.0, 1.0], &values)])
        .set("/animations/0/samplers/0/interpolation", json!("CUBICSPLINE"));
    let scene = load(&glb);
    let spline = |[from, to]: [f64; 2], [out, into]: [f64; 2], s: f64| {
        let (s2, s3) = (s * s, s * s * s);
        from * (2.0 * s3 - 3.0 * s2 + 1.0)
            + out * (s3 - 2.0 * s2 + s)
            + to * (3.0 * s2 - 2.0 * s3)
            + into * (s3 - s2)
    };
    for s in [0.0, 0.3, 0.8] {
        let weights = [spline([0.0, 1.0], [0.0, 3.0], s), spline([1.0, 0.5], [-1.0, 0.0], s)];
        let vector =
            |of: &[f32], i: usize| DVec3::new(of[3 * i].into(), of[3 * i + 1].into(), of[3 * i + 2].into());
        let truth: [DVec3; 4] = std::array::from_fn(|i| {
            let moved = weights[0] * vector(&TARGET, i) + weights[1] * vector(&other, i);
            DVec3::new(0.2, 0.0, 0.0) + corners()[i] + moved
        });
        let off = off(&at_any_side(&scene, "static/right", (s * 1e9) as i64), &truth);
        assert!(off < 1e-6, "{s}: {off}");
    }
}

/// Positions alone: these targets may turn the tetrahedron inside out.
fn at_any_side(scene: &Scene, name: &str, t_ns: i64) -> Vec<DVec3> {
    let body = scene.bodies.iter().find(|b| b.name == name).unwrap();
    let mut now = Deformed::default();
    body.deforms.as_ref().unwrap().at(t_ns, &mut now);
    now.positions.iter().map(|p| p.as_dvec3()).collect()
}

/// Normals of the file follow as those of the surface do: against the stretch.
#[test]
fn normals_of_the_file_are_those_of_the_deformed_surface() {
    let mut glb = tetrahedra();
    let n = DVec3::new(1.0, 2.0, 3.0).normalize();
    let normals = glb.push_numbers("VEC3", &n.to_array().map(|x| x as f32).repeat(4));
    let glb = glb.set("/meshes/0/primitives/0/attributes/NORMAL", json!(normals));
    let glb = animate(glb, &[(1, "scale", &[0.0, 1.0], &[1.0, 1.0, 1.0, 2.0, 1.0, 3.0])]);
    let scene = load(&glb);
    let body = scene.bodies.iter().find(|b| b.name == "static/right").unwrap();
    let mut now = Deformed::default();
    for share in [0.0, 0.5, 0.9] {
        body.deforms.as_ref().unwrap().at((share * 1e9) as i64, &mut now);
        let stretch = DMat3::from_diagonal(DVec3::new(1.0 + share, 1.0, 1.0 + 2.0 * share));
        let truth = (stretch.inverse().transpose() * n).normalize();
        assert!(now.normals.iter().all(|n| n.as_dvec3().distance(truth) < 1e-6), "{share}");
    }
}

/// What cannot deform is told, with the reason, and shown at rest.
#[test]
fn what_cannot_deform_is_told_and_shown_at_rest() {
    let astray = puppet([1.0; 3]).set("/nodes/0/children", json!([2])).set("/scenes/0/nodes", json!([0, 1]));
    let scene = load(&astray);
    assert!(told(&scene).contains("because a joint lies in another body"), "{}", told(&scene));
    let size = |node: usize| (node, "scale", &[0.0f32, 1.0][..], &[1.0f32, 1.0, 1.0, 2.0, 1.0, 3.0][..]);
    let mut many = tetrahedra();
    for node in 2..35 {
        many = many.set(&format!("/nodes/{node}"), json!({"mesh": 0}));
    }
    let many = many.set("/scenes/0/nodes", json!((0..35).collect::<Vec<_>>()));
    let scene = load(&animate(many, &(2..35).map(size).collect::<Vec<_>>()));
    assert!(told(&scene).contains("more than 32 meshes deform"), "{}", told(&scene));
    assert_eq!(scene.bodies.iter().filter(|b| b.deforms.is_some()).count(), 32);
    let share = json!({"POSITION": 0});
    let uneven = tetrahedra().set("/meshes/0/primitives/0/targets", json!([share, share]));
    let uneven = animate(uneven, &[(1, "weights", &[0.0, 1.0], &[0.0, 1.0, 2.0])]);
    assert!(told(&load(&uneven)).contains("which 2 key frames cannot share"), "{}", told(&load(&uneven)));
}
