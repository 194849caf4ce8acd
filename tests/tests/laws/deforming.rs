//! Meshes that an animation deforms, through the whole rig: each frame shows the shape of the centre of its light, with the
//! light that a scene of that shape gives, whatever other frames are in flight.

use crate::scene_files::{flag, rig_of};
use dpm_lab::sequence::{draw, submit, BodyPlaces, FRAME_WAIT_NS};
use dpm_render::gpu::Gpu;
use dpm_render::{Keep, Overlapping, Renderer, RendererSettings};
use dpm_rig::pipeline::renderer_settings;
use dpm_rig::rig::Rig;
use dpm_scene::Scene;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::run;
use glam::DAffine3;
use std::sync::Arc;

/// The code values of frame `frame`, drawn alone from a scene.
fn alone(gpu: &Arc<Gpu>, rig: &Rig, scene: &Scene, bodies: &BodyPlaces, frame: u32) -> Vec<u32> {
    let mut renderer = Renderer::new(gpu, scene, renderer_settings(rig)).unwrap();
    let mut slot = renderer.create_slot(false).unwrap();
    draw(rig, &mut renderer, &mut slot, bodies, frame, rig.config.render.spp as f32).unwrap();
    slot.codes().to_vec()
}

fn differ(a: &[u32], b: &[u32]) -> usize {
    a.iter().zip(b).filter(|(a, b)| a != b).count()
}

const SIZE: (u32, u32) = (96, 72);
/// Every frame alone, all planes for one instant: a frame can be drawn again.
const ALONE: [&str; 2] = ["render.method=\"full\"", "projector.plane_poses=\"frame\""];

/// The rig's light is that of a scene which has the shape of the centre of the frame's light, and keeps it. A frame's time later
/// the light would be another.
#[test]
fn the_light_is_that_of_the_shape_at_the_centre_of_each_frames_light() {
    let flag = flag("light");
    with_gpu(|gpu| {
        let rig = rig_of(&flag, SIZE, "translate", &ALONE);
        let body = rig.scene.bodies.iter().find(|b| b.name == "base/flag").expect("a flag");
        assert!(body.deforms.is_some() && !body.is_whole(), "{:?}", rig.scene.warnings);
        let (outcome, _) = run(gpu, &rig, 60, 12);
        assert_eq!((outcome.light_mismatches, outcome.light.len()), (0, 12));
        for (light, record) in outcome.light.iter().zip(&outcome.recent).step_by(3) {
            let at = record.drawn_for.0;
            let mut bodies = BodyPlaces { animated_at_ns: at, ..BodyPlaces::default() };
            rig.scene_poses(&record.tracked_poses, at, &mut bodies.poses);
            let fell: Vec<u32> =
                light.codes.iter().map(|c| u32::from_le_bytes([c[0], c[1], c[2], 0])).collect();
            let of = |t_ns| alone(gpu, &rig, &rig.scene.still_at(t_ns), &bodies, light.frame);
            assert_eq!(differ(&fell, &of(at)), 0, "frame {}", light.frame);
            assert!(differ(&fell, &of(at + 10_000_000)) > 20, "frame {}", light.frame);
            assert!(fell.iter().filter(|code| **code != 0).count() > 400);
        }
    });
}

/// Frames in flight do not disturb each other: each has tables of its own.
#[test]
fn frames_in_flight_show_their_own_shapes() {
    let flag = flag("flight");
    with_gpu(|gpu| {
        let rig = rig_of(&flag, SIZE, "translate", &ALONE);
        let poses = vec![DAffine3::IDENTITY; rig.scene.bodies.len()];
        let placed = |k: i64| BodyPlaces { poses: poses.clone(), animated_at_ns: 13_000_000 * k };
        let shape =
            |at: &BodyPlaces, t_ns: i64, frame: u32| alone(gpu, &rig, &rig.scene.still_at(t_ns), at, frame);
        let wanted: Vec<Vec<u32>> =
            (0..6).map(|k| shape(&placed(k), placed(k).animated_at_ns, k as u32)).collect();
        for (k, wanted) in wanted.iter().enumerate() {
            let other = shape(&placed(k as i64), placed(k as i64 + 1).animated_at_ns, k as u32);
            assert!(differ(wanted, &other) > 20, "the flag waves");
        }
        for (overlap, storage_tables) in [(Overlapping::Never, true), (Overlapping::Always, false)] {
            let settings = RendererSettings { overlap, ..renderer_settings(&rig) };
            let keep = Keep { storage_tables, ..Keep::default() };
            let mut renderer = Renderer::keeping(gpu, &rig.scene, settings, keep).unwrap();
            let mut slots: Vec<_> = (0..3).map(|_| renderer.create_slot(false).unwrap()).collect();
            for k in 0..9 {
                if k >= 3 {
                    slots[k % 3].wait(FRAME_WAIT_NS).unwrap();
                    let off = differ(slots[k % 3].codes(), &wanted[k - 3]);
                    assert!(off <= usize::from(storage_tables) * 2, "{overlap:?}, frame {}: {off}", k - 3);
                }
                if k < 6 {
                    let spp = rig.config.render.spp as f32;
                    let slot = &mut slots[k % 3];
                    submit(&rig, &mut renderer, slot, &placed(k as i64), k as u32, spp).unwrap();
                }
            }
        }
    });
}

/// A device that traces rays itself is not asked, because its trees do not deform.
#[test]
fn devices_with_ray_queries_walk_through_what_deforms() {
    let flag = flag("query");
    with_gpu(|gpu| {
        let rig = rig_of(&flag, SIZE, "translate", &["render.tracing=\"query\""]);
        let renderer = Renderer::new(gpu, &rig.scene, renderer_settings(&rig)).unwrap();
        assert!(!renderer.asks_device());
        let told = rig.scene.warnings.join("\n");
        assert!(told.contains("the shaders walk all the same"), "{told}");
    });
}

/// With a history, light that has settled on the flag is the light of its shape, and not a trail of older ones.
#[test]
fn histories_follow_what_deforms() {
    let flag = flag("history");
    with_gpu(|gpu| {
        let rig =
            rig_of(&flag, SIZE, "translate", &["render.method=\"dpm\"", "projector.plane_poses=\"frame\""]);
        let full = rig_of(&flag, SIZE, "translate", &["render.method=\"full\"", "render.spp=64"]);
        let mut renderer = Renderer::new(gpu, &rig.scene, renderer_settings(&rig)).unwrap();
        let mut slot = renderer.create_slot(false).unwrap();
        let poses = vec![DAffine3::IDENTITY; rig.scene.bodies.len()];
        let placed = |k: i64| BodyPlaces { poses: poses.clone(), animated_at_ns: k * 1_055_966 };
        let off = |a: &[u32], b: &[u32]| -> f64 {
            let bytes = |codes: &[u32]| codes.iter().flat_map(|c| c.to_le_bytes()).collect::<Vec<u8>>();
            let squares =
                bytes(a).iter().zip(bytes(b)).map(|(a, b)| f64::from(a.abs_diff(b)).powi(2)).sum::<f64>();
            (squares / (4 * a.len()) as f64).sqrt() / 255.0
        };
        let frames = 48;
        for k in 0..frames {
            draw(&rig, &mut renderer, &mut slot, &placed(k), k as u32, rig.config.render.spp as f32).unwrap();
        }
        let last = frames - 1;
        let now = off(slot.codes(), &alone(gpu, &full, &full.scene, &placed(last), 7));
        let before = off(slot.codes(), &alone(gpu, &full, &full.scene, &placed(last - 20), 7));
        println!("rms off by {now:.4} of full drive, and from the shape 20 frames before by {before:.4}");
        assert!(now < 0.03 && now < 0.5 * before, "{now} {before}");
        // Pixels of `wanted` that `shown` leaves dark.
        let dark = |shown: &[u32], wanted: &[u32]| -> Vec<usize> {
            (0..wanted.len()).filter(|i| wanted[*i] != 0 && shown[*i] == 0).collect()
        };
        // Surface that the flag uncovers, or comes to, is lit at once ...
        let missed = dark(slot.codes(), &alone(gpu, &full, &full.scene, &placed(last), 7)).len();
        assert!(missed <= 2, "{missed} pixels of the flag are dark");
        // ... however far it went: a frame may be late.
        let was = slot.codes().to_vec();
        let late = placed(last + 150);
        draw(&rig, &mut renderer, &mut slot, &late, frames as u32, rig.config.render.spp as f32).unwrap();
        let new = dark(&was, &alone(gpu, &full, &full.scene, &late, 7));
        let missed = new.iter().filter(|i| slot.codes()[**i] == 0).count();
        println!("{missed} of {} pixels that the flag came to are dark", new.len());
        assert!(new.len() > 50 && 20 * missed <= new.len(), "{missed} of {}", new.len());
    });
}
