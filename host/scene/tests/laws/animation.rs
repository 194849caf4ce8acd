//! Animations of glTF files: parts that move by themselves, against their nodes' transforms multiplied by hand.

use crate::common::{tetrahedra, Glb, TETRAHEDRON};
use dpm_scene::{load_bytes, AnimationChoice, BodySelector, LoadOptions, Scene, UpAxis};
use glam::{DAffine3, DQuat, DVec3};
use serde_json::{json, Value};

const S: i64 = 1_000_000_000;

/// One channel of an animation.
struct Channel<'a> {
    node: usize,
    path: &'a str,
    times: &'a [f32],
    values: &'a [f32],
    interpolation: &'a str,
}

/// A linear channel.
fn linear<'a>(node: usize, path: &'a str, times: &'a [f32], values: &'a [f32]) -> Channel<'a> {
    Channel { node, path, times, values, interpolation: "LINEAR" }
}

/// Adds an animation.
fn animate(mut glb: Glb, name: &str, channels: &[Channel]) -> Glb {
    let (mut list, mut samplers) = (vec![], vec![]);
    for c in channels {
        let kind = match c.path {
            "rotation" => "VEC4",
            "weights" => "SCALAR",
            _ => "VEC3",
        };
        let input = glb.push_numbers("SCALAR", c.times);
        let output = glb.push_numbers(kind, c.values);
        list.push(json!({"sampler": samplers.len(), "target": {"node": c.node, "path": c.path}}));
        samplers.push(json!({"input": input, "output": output, "interpolation": c.interpolation}));
    }
    let animation = json!({"name": name, "channels": list, "samplers": samplers});
    match glb.json.get_mut("animations").and_then(Value::as_array_mut) {
        Some(all) => all.push(animation),
        None => glb.json["animations"] = json!([animation]),
    }
    glb
}

fn options(bodies: &[&str]) -> LoadOptions {
    let body = |name: &&str| BodySelector { name: (*name).into(), node: None, projected: true };
    LoadOptions { bodies: bodies.iter().map(body).collect(), ..LoadOptions::default() }
}

fn load(glb: &Glb, options: &LoadOptions) -> Scene {
    load_bytes(&glb.bytes(), options).unwrap_or_else(|e| panic!("{e}"))
}

/// World-from-part at `t` nanoseconds, where the tracked body is at `carrier`.
fn place(scene: &Scene, name: &str, carrier: DAffine3, t: i64) -> DAffine3 {
    let body = scene.bodies.iter().find(|b| b.name == name).unwrap_or_else(|| {
        panic!("no {name} among {:?}", scene.bodies.iter().map(|b| &b.name).collect::<Vec<_>>())
    });
    carrier * body.motion.as_ref().map_or(DAffine3::IDENTITY, |motion| motion.at(t))
}

/// The greatest distance of the vertices of a body from those of the tetrahedron under `truth`.
fn distance(scene: &Scene, name: &str, carrier: DAffine3, t: i64, truth: DAffine3) -> f64 {
    let place = place(scene, name, carrier, t);
    let body = scene.bodies.iter().find(|b| b.name == name).unwrap();
    let corners = TETRAHEDRON.0.map(|c| truth.transform_point3(DVec3::from_array(c.map(f64::from))));
    let seen = body.mesh.positions.iter().map(|p| place.transform_point3(p.as_dvec3()));
    let nearest = |p: DVec3| corners.iter().map(|c| c.distance(p)).fold(f64::INFINITY, f64::min);
    seen.map(nearest).fold(0.0, f64::max)
}

fn quaternion(q: DQuat) -> [f32; 4] {
    q.to_array().map(|x| x as f32)
}

/// A body with an arm that turns, on which a wheel turns and slides: `left` holds `arm`, which holds `wheel`, each twice as
/// large as what is above it.
fn arm_and_wheel() -> Glb {
    let quarter = quaternion(DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2));
    let turns = [[0.0, 0.0, 0.0, 1.0], quarter].concat();
    let back = [quarter, [0.0, 0.0, 0.0, 1.0]].concat();
    let glb = tetrahedra()
        .set("/nodes/0/rotation", json!(quaternion(DQuat::from_rotation_x(0.3))))
        .set("/nodes/0/children", json!([2]))
        .set("/nodes/2", json!({"name": "arm", "mesh": 0, "translation": [0.0, 0.5, 0.0], "scale": [2, 2, 2], "children": [3]}))
        .set("/nodes/3", json!({"name": "bracket", "translation": [0.1, 0.0, 0.0], "scale": [2, 2, 2], "children": [4]}))
        .set("/nodes/4", json!({"name": "wheel", "mesh": 0, "scale": [1, 3, 1]}));
    animate(
        glb,
        "work",
        &[
            linear(2, "rotation", &[0.0, 2.0], &turns),
            linear(4, "rotation", &[0.0, 1.0], &back),
            linear(4, "translation", &[0.0, 2.0], &[0.0, 0.0, 0.0, 0.3, 0.0, 0.0]),
        ],
    )
}

/// The same, multiplied by hand: the parent's, the arm's and the wheel's transform at `t` seconds.
fn by_hand(t: f64) -> [DAffine3; 3] {
    use std::f64::consts::FRAC_PI_2;
    let trs = |at: [f64; 3], turn: DQuat, scale: [f64; 3]| {
        DAffine3::from_scale_rotation_translation(DVec3::from_array(scale), turn, DVec3::from_array(at))
    };
    let t = t.rem_euclid(2.0);
    let left = trs([-0.2, 0.0, 0.0], DQuat::from_rotation_x(0.3), [1.0; 3]);
    let arm = left * trs([0.0, 0.5, 0.0], DQuat::from_rotation_y(FRAC_PI_2 * t / 2.0), [2.0; 3]);
    let bracket = arm * trs([0.1, 0.0, 0.0], DQuat::IDENTITY, [2.0; 3]);
    let turn = DQuat::from_rotation_y(FRAC_PI_2 * (1.0 - t.min(1.0)));
    let wheel = bracket * trs([0.3 * t / 2.0, 0.0, 0.0], turn, [1.0, 3.0, 1.0]);
    [left, arm, wheel]
}

#[test]
fn parts_go_where_their_nodes_go_on_a_body_and_in_the_world() {
    let glb = arm_and_wheel();
    for (bodies, carrier) in [(&["left"][..], "left"), (&["right"][..], "static")] {
        let scene = load(&glb, &options(bodies));
        let names: Vec<_> = scene.bodies.iter().map(|b| b.name.as_str()).collect();
        let (arm, wheel) = (format!("{carrier}/arm"), format!("{carrier}/wheel"));
        assert!(names.contains(&arm.as_str()) && names.contains(&wheel.as_str()), "{names:?}");
        let tracked = scene.bodies.iter().find(|b| b.name == arm).unwrap().tracked;
        assert_eq!(tracked, (carrier == "left").then_some(0));
        let rest = scene.bodies.iter().find(|b| b.name == carrier).unwrap().world_from_body_rest;
        for t in [0.0, 0.4, 1.0, 1.7, 2.6, -0.3] {
            let ns = (t * 1e9) as i64;
            let [left, true_arm, true_wheel] = by_hand(t);
            let carrier_at = if carrier == "left" { rest } else { DAffine3::IDENTITY };
            assert!(distance(&scene, &arm, carrier_at, ns, true_arm) < 1e-6, "arm at {t}");
            assert!(distance(&scene, &wheel, carrier_at, ns, true_wheel) < 1e-6, "wheel at {t}");
            // What moves the body moves its parts.
            if carrier == "left" {
                let moved = DAffine3::from_rotation_translation(
                    DQuat::from_rotation_z(1.1),
                    DVec3::new(3.0, 1.0, 2.0),
                );
                let truth = moved * left.inverse() * true_wheel;
                assert!(distance(&scene, &wheel, moved, ns, truth) < 2e-6, "moved wheel at {t}");
            }
        }
        let part = scene.bodies.iter().find(|b| b.name == wheel).unwrap();
        assert!(part.world_from_body_rest.abs_diff_eq(place(&scene, &wheel, rest, 0), 1e-12));
        let told = scene.warnings.join("\n");
        assert!(told.contains("animation 0 'work' plays over and over, 2.00 s a round: 2 parts"), "{told}");
    }
}

#[test]
fn units_and_axes_of_the_file_hold_for_what_moves() {
    let glb = arm_and_wheel();
    let options = LoadOptions { scale: Some(0.01), up: Some(UpAxis::Z), ..options(&["right"]) };
    let scene = load(&glb, &options);
    let to_world =
        DAffine3::from_rotation_x(-std::f64::consts::FRAC_PI_2) * DAffine3::from_scale(DVec3::splat(0.01));
    for t in [0.0, 0.9, 1.5] {
        let truth = to_world * by_hand(t)[2];
        let off = distance(&scene, "static/wheel", DAffine3::IDENTITY, (t * 1e9) as i64, truth);
        assert!(off < 1e-8, "{t}: {off}");
    }
}

#[test]
fn speed_and_choice_are_those_of_the_options() {
    let slide = |x: f32| [[0.0; 3], [x, 0.0, 0.0]].concat();
    let glb = animate(tetrahedra(), "slow", &[linear(1, "translation", &[0.0, 4.0], &slide(1.0))]);
    let glb = animate(glb, "far", &[linear(1, "translation", &[0.0, 1.0], &slide(9.0))]);
    let x = |options: &LoadOptions, t: i64| {
        place(&load(&glb, options), "static/right", DAffine3::IDENTITY, t).translation.x
    };
    let first = options(&["left"]);
    assert!((x(&first, S) - 0.25).abs() < 1e-7);
    assert!((x(&LoadOptions { animation_speed: Some(2.0), ..first.clone() }, S) - 0.5).abs() < 1e-7);
    let far = LoadOptions { animation: AnimationChoice::Named("far".into()), ..first.clone() };
    assert!((x(&far, S / 2) - 4.5).abs() < 1e-6);
    let told = load(&glb, &first).warnings.join("\n");
    assert!(
        told.contains("of 2 animations one is played: the first one; scene.animation names another"),
        "{told}"
    );
    let off = load(&glb, &LoadOptions { animation: AnimationChoice::Off, ..first.clone() });
    assert!(off.bodies.iter().all(|b| b.motion.is_none()) && off.warnings.join("\n").contains("not played"));
    let wrong = LoadOptions { animation: AnimationChoice::Named("fast".into()), ..first };
    let told = load_bytes(&glb.bytes(), &wrong).unwrap_err().to_string();
    assert!(told.contains("'fast'") && told.contains("slow, far"), "{told}");
}

/// Steps, and splines with tangents: half way between two keys without slope a spline is half way, too.
#[test]
fn steps_and_splines_are_played() {
    let spline = [[0.0; 3], [1.0, 0.0, 0.0], [0.0; 3], [0.0; 3], [3.0, 0.0, 0.0], [0.0; 3]].concat();
    let steps = [[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]].concat();
    for (interpolation, values, quarter, half) in
        [("CUBICSPLINE", &spline, 1.0 + 2.0 * 0.15625, 2.0), ("STEP", &steps, 1.0, 1.0)]
    {
        let channel = Channel { node: 1, path: "translation", times: &[0.0, 1.0], values, interpolation };
        let scene = load(&animate(tetrahedra(), "a", &[channel]), &options(&["left"]));
        let x = |t| place(&scene, "static/right", DAffine3::IDENTITY, t).translation.x;
        assert!((x(S / 4) - quarter).abs() < 1e-6 && (x(S / 2) - half).abs() < 1e-6, "{interpolation}");
    }
}

/// Exporters write keys for every node. What never changes makes no part, and its value counts.
#[test]
fn keys_that_never_change_make_no_part() {
    let still = [[0.4, 0.0, 0.0], [0.4, 0.0, 0.0]].concat();
    let sizes = [1.0; 6];
    let glb = animate(
        tetrahedra(),
        "a",
        &[linear(1, "translation", &[0.0, 1.0], &still), linear(1, "scale", &[0.0, 1.0], &sizes)],
    );
    let scene = load(&glb, &options(&["left"]));
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    assert_eq!(scene.bodies.len(), 2);
    let low = scene.bodies[1].mesh.positions.iter().map(|p| p.x).fold(f32::INFINITY, f32::min);
    assert!((low - 0.4).abs() < 1e-6, "{low}");
}

#[test]
fn what_cannot_be_played_is_told_and_shown_at_rest() {
    let slide = [[0.0; 3], [1.0, 0.0, 0.0]].concat();
    let times = [0.0, 1.0];
    let told = |glb: &Glb| {
        let scene = load(glb, &options(&["left"]));
        assert!(scene.bodies.iter().all(|b| b.motion.is_none()));
        scene.warnings.join("\n")
    };
    // The tracker moves the body.
    let own = animate(tetrahedra(), "a", &[linear(0, "translation", &times, &slide)]);
    assert!(told(&own).contains("the tracker moves body 'left'"), "{}", told(&own));
    // A mesh without morph targets has no shape that could change.
    let shape = animate(tetrahedra(), "a", &[linear(1, "weights", &times, &[0.0, 1.0])]);
    assert!(
        load(&shape, &LoadOptions::default()).bodies.iter().all(|b| b.deforms.is_none()),
        "{}",
        told(&shape)
    );
}

/// A broken animation is no reason to refuse a scene.
#[test]
fn broken_animations_are_left_out() {
    let slide = [[0.0; 3], [1.0, 0.0, 0.0]].concat();
    let good = || animate(tetrahedra(), "a", &[linear(1, "translation", &[0.0, 1.0], &slide)]);
    let broken = [
        ("falling times", animate(tetrahedra(), "a", &[linear(1, "translation", &[1.0, 0.0], &slide)])),
        ("equal times", animate(tetrahedra(), "a", &[linear(1, "translation", &[1.0, 1.0], &slide)])),
        (
            "times without number",
            animate(tetrahedra(), "a", &[linear(1, "translation", &[0.0, f32::NAN], &slide)]),
        ),
        ("a time without end", animate(tetrahedra(), "a", &[linear(1, "translation", &[0.0, 1e30], &slide)])),
        ("too few values", animate(tetrahedra(), "a", &[linear(1, "translation", &[0.0, 1.0], &slide[..3])])),
        (
            "a place without number",
            animate(tetrahedra(), "a", &[linear(1, "translation", &[0.0, 1.0], &[f32::NAN; 6])]),
        ),
        ("no rotation", animate(tetrahedra(), "a", &[linear(1, "rotation", &[0.0, 1.0], &[0.0; 8])])),
        ("a node that is not there", good().set("/animations/0/channels/0/target/node", json!(77))),
        ("no sampler", good().set("/animations/0/channels/0/sampler", json!(9))),
        ("no target", good().set("/animations/0/channels/0", json!({"sampler": 0}))),
        ("an unknown path", good().set("/animations/0/channels/0/target/path", json!("colour"))),
        ("an unknown interpolation", good().set("/animations/0/samplers/0/interpolation", json!("BEZIER"))),
        ("no accessor", good().set("/animations/0/samplers/0/output", json!(99))),
        ("the wrong accessor", good().set("/animations/0/samplers/0/output", json!(1))),
        ("no list", good().set("/animations/0/channels", json!("all"))),
    ];
    for (what, glb) in broken {
        let scene = load(&glb, &options(&["left"]));
        assert!(scene.bodies.iter().all(|b| b.motion.is_none()), "{what}");
        assert!(scene.warnings.iter().any(|w| w.contains("animation 0 'a'")), "{what}: {:?}", scene.warnings);
    }
    // Without a target node the channel is for an extension that nobody asked for.
    let pointer = good().set("/animations/0/channels/0/target", json!({"path": "pointer"}));
    assert!(load(&pointer, &options(&["left"])).warnings.is_empty());
}

#[test]
fn more_parts_than_can_move_are_all_shown_at_rest() {
    let slide = [[0.0; 3], [1.0, 0.0, 0.0]].concat();
    for (count, moves) in [(128, true), (129, false)] {
        let mut glb = tetrahedra();
        for k in 0..count {
            glb = glb.set(&format!("/nodes/{}", k + 2), json!({"mesh": 0}));
        }
        let children: Vec<usize> = (2..count + 2).collect();
        let glb = glb.set("/nodes/1/children", json!(children));
        let channels: Vec<Channel> =
            children.iter().map(|&node| linear(node, "translation", &[0.0, 1.0], &slide)).collect();
        let scene = load(&animate(glb, "crowd", &channels), &options(&["left"]));
        assert_eq!(scene.bodies.iter().filter(|b| b.motion.is_some()).count(), if moves { count } else { 0 });
        let told = scene.warnings.join("\n");
        assert!(moves || told.contains("moves 129 parts, and at most 128 can move"), "{told}");
    }
}

/// A lamp rides on the part that carries it; a body all of whose surfaces move still lies where the tracker says.
#[test]
fn lights_ride_on_parts_and_bodies_may_be_all_parts() {
    let slide = [[0.0; 3], [1.0, 0.0, 0.0]].concat();
    let glb = tetrahedra()
        .set("/extensions", json!({"KHR_lights_punctual": {"lights": [{"type": "point"}]}}))
        .set("/nodes/0", json!({"name": "left", "translation": [-0.2, 0.0, 0.0], "children": [2]}))
        .set("/nodes/2", json!({"name": "cart", "mesh": 0, "children": [3]}))
        .set(
            "/nodes/3",
            json!({"translation": [0.0, 0.1, 0.0], "extensions": {"KHR_lights_punctual": {"light": 0}}}),
        );
    let glb = animate(glb, "a", &[linear(2, "translation", &[0.0, 1.0], &slide)]);
    let scene = load(&glb, &options(&["left"]));
    let light = &scene.lights[0];
    let carrier = &scene.bodies[light.body.unwrap() as usize];
    assert_eq!((carrier.name.as_str(), light.position.y), ("left/cart", 0.1));
    let first = scene.bodies.iter().find(|b| b.tracked == Some(0)).unwrap();
    assert!(first.motion.is_none() && first.mesh.triangles.is_empty());
    assert!((first.world_from_body_rest.translation.x + 0.2).abs() < 1e-7);
    // A light alone on a moving node has nothing to ride on.
    let alone =
        glb.set("/nodes/2", json!({"name": "cart", "children": [3, 4]})).set("/nodes/4", json!({"mesh": 0}));
    let alone = alone.set("/nodes/2/children", json!([3])).set("/nodes/0/children", json!([2, 4]));
    let scene = load(&alone, &options(&["left"]));
    assert!(scene.warnings.iter().any(|w| w.contains("stands still")), "{:?}", scene.warnings);
    assert_eq!(scene.lights[0].body, Some(0));
}

/// Many channels that read the same long accessor, and a long row of nodes on nodes: a small file must not become gigabytes.
#[test]
fn shared_key_frames_and_deep_rows_are_bounded() {
    let count = 100_000;
    let times: Vec<f32> = (0..count).map(|k| k as f32 * 1e-3).collect();
    let values: Vec<f32> = (0..count).flat_map(|k| [(k % 7) as f32, 0.0, 0.0]).collect();
    let mut glb = tetrahedra();
    for k in 0..60 {
        glb = glb.set(&format!("/nodes/{}", k + 2), json!({"mesh": 0, "children": [k + 3]}));
    }
    let mut glb = glb.set("/nodes/62", json!({"mesh": 0})).set("/nodes/1/children", json!([2]));
    let (input, output) = (glb.push_numbers("SCALAR", &times), glb.push_numbers("VEC3", &values));
    let channels: Vec<Value> =
        (2..63).map(|node| json!({"sampler": 0, "target": {"node": node, "path": "translation"}})).collect();
    let shared = glb.set(
        "/animations",
        json!([{"name": "a", "channels": channels, "samplers": [{"input": input, "output": output}]}]),
    );
    let scene = load(&shared, &options(&["left"]));
    // 13 channels of 300,000 values.
    assert_eq!(scene.bodies.iter().filter(|b| b.motion.is_some()).count(), 13);
    assert!(scene.warnings.iter().any(|w| w.contains("more than 4000000 values")), "{:?}", scene.warnings);
    let slide = [[0.0; 3], [1.0, 0.0, 0.0]].concat();
    let mut deep = tetrahedra();
    for k in 0..60 {
        let place = json!({"mesh": 0, "children": [k + 3], "rotation": [0.0, 0.6, 0.0, 0.8]});
        deep = deep.set(&format!("/nodes/{}", k + 2), place);
    }
    let deep = deep.set("/nodes/62", json!({"mesh": 0})).set("/nodes/1/children", json!([2]));
    let channels: Vec<Channel> =
        (2..63).map(|node| linear(node, "translation", &[0.0, 1.0], &slide)).collect();
    let scene = load(&animate(deep, "a", &channels), &options(&["left"]));
    let moving = scene.bodies.iter().filter(|b| b.motion.is_some()).count();
    assert!((40..48).contains(&moving), "{moving}");
    assert!(
        scene.warnings.iter().any(|w| w.contains("too many nodes above it move")),
        "{:?}",
        scene.warnings
    );
}
