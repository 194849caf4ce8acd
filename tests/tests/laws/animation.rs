//! Parts that move by themselves, through the whole rig: each frame shows them where they are at the centre of its light, and
//! each group of planes where they are at its own instant.

use crate::scene_files::common::Glb;
use crate::scene_files::{animate, rig_of, with_material, TempFile};
use dpm_lab::sequence::{draw, BodyPlaces};
use dpm_render::Renderer;
use dpm_rig::pipeline::renderer_settings;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::run;
use glam::DVec3;
use serde_json::json;

/// Metres per second at which the part slides to the right and back.
const SPEED: f64 = 1.2;
/// Seconds from one end of its way to the other.
const WAY_S: f32 = 0.25;

/// Two cubes: `base`, and above it `slide`, which moves along x.
fn boxes(name: &str) -> TempFile {
    let mut glb = Glb::empty();
    let cube = with_material(glb.push_cube(0.06), 0);
    let glb = glb
        .set("/nodes", json!([{"name": "base", "mesh": 0, "children": [1]}, {"name": "slide", "mesh": 0}]))
        .set("/meshes", json!([{"primitives": [cube]}]))
        .set("/materials", json!([{"pbrMetallicRoughness": {"metallicFactor": 0.0}}]));
    let end = SPEED as f32 * WAY_S - 0.15;
    let places = [-0.15, 0.12, 0.0, end, 0.12, 0.0, -0.15, 0.12, 0.0];
    let glb = animate(glb, (1, "translation"), &[0.0, WAY_S, 2.0 * WAY_S], "VEC3", &places);
    TempFile::new(&format!("{name}.glb"), &glb.bytes())
}

/// The size of the rig's raster.
const SIZE: (u32, u32) = (96, 72);

/// Where the slide is in the space of the base, from the keys.
fn truth(t_ns: i64) -> DVec3 {
    let round = (t_ns as f64 * 1e-9).rem_euclid(2.0 * f64::from(WAY_S));
    let way = f64::from(WAY_S) - (round - f64::from(WAY_S)).abs();
    DVec3::new(-0.15 + SPEED * way, 0.12, 0.0)
}

/// Every frame alone, all planes for one instant: a frame can be drawn again.
const ALONE: [&str; 2] = ["render.method=\"full\"", "projector.plane_poses=\"frame\""];

#[test]
fn the_light_is_that_of_the_part_at_the_centre_of_each_frames_light() {
    let boxes = boxes("light");
    with_gpu(|gpu| {
        let rig = rig_of(&boxes, SIZE, "still", &ALONE);
        let slide = rig.scene.bodies.iter().position(|b| b.name == "base/slide").expect("a part");
        let (outcome, _) = run(gpu, &rig, 30, 20);
        assert_eq!((outcome.light_mismatches, outcome.light.len()), (0, 20));
        let mut renderer = Renderer::new(gpu, &rig.scene, renderer_settings(&rig)).unwrap();
        let mut slot = renderer.create_slot(false).unwrap();
        let (mut bodies, mut lit) = (BodyPlaces::default(), 0);
        for (light, record) in outcome.light.iter().zip(&outcome.recent) {
            rig.scene_poses(&record.tracked_poses, record.drawn_for.0, &mut bodies.poses);
            let at = (record.tracked_poses[0].inverse() * bodies[slide]).translation;
            assert!(at.distance(truth(record.drawn_for.0)) < 1e-6, "{at} {}", truth(record.drawn_for.0));
            // What was planned is what came.
            let centre = record.timeline.centre_at.expect("it was lit");
            assert!(centre.ns_since(record.drawn_for).abs() < 1_000, "{centre:?} {:?}", record.drawn_for);
            let mut drawn = |bodies: &BodyPlaces| {
                draw(&rig, &mut renderer, &mut slot, bodies, light.frame, rig.config.render.spp as f32)
                    .unwrap();
                let fell = slot.codes().iter().zip(&light.codes);
                fell.filter(|(code, fell)| {
                    [**code as u8, (**code >> 8) as u8, (**code >> 16) as u8] != **fell
                })
                .count()
            };
            assert_eq!(drawn(&bodies), 0, "frame {}", light.frame);
            lit += light.codes.iter().filter(|code| **code != [0; 3]).count();
            // A frame later the part is elsewhere, and so would be its light.
            bodies.poses[slide].translation += DVec3::new(SPEED / 947.0 * 20.0, 0.0, 0.0);
            assert!(drawn(&bodies) > 20);
        }
        assert!(lit > 20 * 200, "{lit}");
    });
}

/// With planes that follow, a part that moves at 1.2 m/s on a still base is not lit as one that stands still; and on a base that
/// moves, planes are those of the base's motion and its own.
#[test]
fn planes_follow_parts_too() {
    let boxes = boxes("planes");
    with_gpu(|gpu| {
        let light = |motion: &str, plane_poses: &str| {
            let poses = format!("projector.plane_poses=\"{plane_poses}\"");
            let rig =
                rig_of(&boxes, SIZE, motion, &["render.method=\"full\"", "projector.frame_rate=120", &poses]);
            let (outcome, _) = run(gpu, &rig, 24, 8);
            assert_eq!(outcome.light_mismatches, 0);
            outcome.light.iter().map(|frame| frame.codes.clone()).collect::<Vec<_>>()
        };
        let differ = |a: &[Vec<[u8; 3]>], b: &[Vec<[u8; 3]>]| {
            a.iter().flatten().zip(b.iter().flatten()).filter(|(a, b)| a != b).count()
        };
        assert!(differ(&light("still", "own"), &light("still", "frame")) > 100, "only the part moves");
        assert!(differ(&light("translate", "own"), &light("translate", "frame")) > 100);
    });
}
