//! Parts that move by themselves, through the whole rig: each frame shows them where they are at the centre of its light, and
//! each group of planes where they are at its own instant.

use dpm_lab::sequence::{draw, Placed};
use dpm_render::Renderer;
use dpm_rig::pipeline::renderer_settings;
use dpm_rig::rig::Rig;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::{demo_rig, run};
use glam::DVec3;
use serde_json::json;
use std::path::PathBuf;
use std::sync::Arc;

/// Metres per second at which the part slides to the right and back.
const SPEED: f64 = 1.2;
/// Seconds from one end of its way to the other.
const WAY_S: f32 = 0.25;

/// Two boxes: `base`, and above it `slide`, which moves along x. The files are removed afterwards.
struct Boxes(PathBuf);

impl Boxes {
    fn new(name: &str) -> Self {
        let folder = std::env::temp_dir().join(format!("dpm-animation-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let boxes = Self(folder);
        let corners: Vec<f32> = (0..8)
            .flat_map(|i| [i & 1, i >> 1 & 1, i >> 2 & 1].map(|high| if high == 1 { 0.06 } else { -0.06 }))
            .collect();
        let faces: [[u16; 4]; 6] =
            [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        let indices: Vec<u16> = faces.iter().flat_map(|[a, b, c, d]| [*a, *b, *c, *a, *c, *d]).collect();
        let end = SPEED as f32 * WAY_S - 0.15;
        let keys =
            [[0.0, WAY_S, 2.0 * WAY_S].to_vec(), vec![-0.15, 0.12, 0.0, end, 0.12, 0.0, -0.15, 0.12, 0.0]];
        let floats = |values: &[f32]| values.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
        let parts = [
            floats(&corners),
            indices.iter().flat_map(|i| i.to_le_bytes()).collect(),
            floats(&keys[0]),
            floats(&keys[1]),
        ];
        let (mut views, mut bytes) = (vec![], vec![]);
        for part in parts {
            views.push(json!({"buffer": 0, "byteOffset": bytes.len(), "byteLength": part.len()}));
            bytes.extend(part);
        }
        std::fs::write(boxes.0.join("boxes.bin"), &bytes).unwrap();
        let file = json!({
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"name": "base", "mesh": 0, "children": [1]}, {"name": "slide", "mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
            "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0}}],
            "accessors": [
                {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 8},
                {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 36},
                {"bufferView": 2, "componentType": 5126, "type": "SCALAR", "count": 3},
                {"bufferView": 3, "componentType": 5126, "type": "VEC3", "count": 3}],
            "bufferViews": views,
            "buffers": [{"byteLength": bytes.len(), "uri": "boxes.bin"}],
            "animations": [{"name": "slide", "channels": [{"sampler": 0, "target": {"node": 1, "path": "translation"}}],
                "samplers": [{"input": 2, "output": 3}]}]
        });
        std::fs::write(boxes.0.join("boxes.gltf"), file.to_string()).unwrap();
        boxes
    }

    /// The demo's rig with the boxes in place of its bodies. `motion`: how the base moves.
    fn rig(&self, motion: &str, more: &[&str]) -> Arc<Rig> {
        let file = format!("scene.file=\"{}\"", self.0.join("boxes.gltf").display());
        let bodies = format!("scene.bodies=[{{ name = \"base\", motion = {{ kind = \"{motion}\" }} }}]");
        demo_rig(96, 72, &[&[&file[..], &bodies][..], more].concat())
    }
}

impl Drop for Boxes {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

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
    let boxes = Boxes::new("light");
    with_gpu(|gpu| {
        let rig = boxes.rig("still", &ALONE);
        let slide = rig.scene.bodies.iter().position(|b| b.name == "base/slide").expect("a part");
        let (outcome, _) = run(gpu, &rig, 30, 20);
        assert_eq!((outcome.light_mismatches, outcome.light.len()), (0, 20));
        let mut renderer = Renderer::new(gpu, &rig.scene, renderer_settings(&rig)).unwrap();
        let mut slot = renderer.create_slot(false).unwrap();
        let (mut bodies, mut lit) = (Placed::default(), 0);
        for (light, record) in outcome.light.iter().zip(&outcome.recent) {
            rig.scene_poses(&record.tracked_poses, record.drawn_for.0, &mut bodies.poses);
            let at = (record.tracked_poses[0].inverse() * bodies[slide]).translation;
            assert!(at.distance(truth(record.drawn_for.0)) < 1e-6, "{at} {}", truth(record.drawn_for.0));
            // What was planned is what came.
            let centre = record.timeline.centre_at.expect("it was lit");
            assert!(centre.ns_since(record.drawn_for).abs() < 1_000, "{centre:?} {:?}", record.drawn_for);
            let mut drawn = |bodies: &Placed| {
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
    let boxes = Boxes::new("planes");
    with_gpu(|gpu| {
        let light = |motion: &str, plane_poses: &str| {
            let poses = format!("projector.plane_poses=\"{plane_poses}\"");
            let rig = boxes.rig(motion, &["render.method=\"full\"", "projector.frame_rate=120", &poses]);
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
