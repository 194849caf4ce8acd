//! Pictures of other programs on a body: a frame shows one of them as a whole, bit for bit as a scene that keeps it.

use dpm_lab::sequence::{draw, poses_at, submit, FRAME_WAIT_NS};
use dpm_render::gpu::Gpu;
use dpm_render::{Overlapping, Renderer, RendererSettings};
use dpm_rig::pipeline::renderer_settings;
use dpm_rig::rig::Rig;
use dpm_scene::Scene;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::{demo_rig, run};
use std::fs::File;
use std::io::Write;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;

/// Sides of a picture, in texels.
const SIDE: usize = 8;

/// The demo's rig, on whose bunny `source` shows pictures. Nothing listens at the other end unless the rig runs.
fn rig_with(source: &str, more: &[&str]) -> Arc<Rig> {
    let bodies = format!(
        "scene.bodies=[{{ name = \"bunny\", texture = \"{source}\", texture_size = [{SIDE}, {SIDE}] }}, {{ name = \"venus\" }}]"
    );
    let still = ["render.method=\"full\"", "projector.plane_poses=\"frame\""];
    demo_rig(96, 72, &[&[&bodies[..]][..], &still, more].concat())
}

/// The `k`-th picture: one of three colours, with texels that tell where they are.
fn picture(k: usize) -> Vec<[u8; 4]> {
    (0..SIDE * SIDE)
        .map(|i| {
            let mut texel = [(3 * i) as u8, (200 - 2 * i) as u8, 40, 255];
            texel[k % 3] = 250;
            texel
        })
        .collect()
}

/// A frame of a scene whose pictures stay.
fn alone(gpu: &Arc<Gpu>, rig: &Rig, scene: &Scene, frame: u32) -> Vec<u32> {
    let mut renderer = Renderer::new(gpu, scene, renderer_settings(rig)).unwrap();
    let mut slot = renderer.create_slot(false).unwrap();
    draw(rig, &mut renderer, &mut slot, &poses_at(rig, u64::from(frame)), frame, 1.0).unwrap();
    slot.codes().to_vec()
}

/// Many pictures.
mod breadth {
    use super::*;

    /// Three frames in flight, two queues, and a new picture before every frame: each frame shows one picture as a whole, and no older one
    /// than the frame before.
    #[test]
    fn frames_in_flight_show_whole_pictures() {
        with_gpu(|gpu| {
            for (overlap, most) in
                [(Overlapping::Always, 64), (Overlapping::Never, 64), (Overlapping::Always, 40)]
            {
                let rig = rig_with("pipe:/nowhere", &[]);
                let settings =
                    RendererSettings { most_live_texels: most, overlap, ..renderer_settings(&rig) };
                let mut renderer = Renderer::new(gpu, &rig.scene, settings).unwrap();
                let mut slots: Vec<_> = (0..3).map(|_| renderer.create_slot(false).unwrap()).collect();
                let (mut scenes, mut newest) = (vec![rig.scene.still_at(0)], 0);
                let frames = 12u32;
                for frame in 0..frames + 3 {
                    let slot = &mut slots[frame as usize % 3];
                    if let Some(before) = frame.checked_sub(3) {
                        slot.wait(FRAME_WAIT_NS).unwrap();
                        let known = newest..scenes.len();
                        let is_shown = |k: &usize| slot.codes() == alone(gpu, &rig, &scenes[*k], before);
                        newest = known
                            .into_iter()
                            .find(is_shown)
                            .expect("a whole picture, no older than the last");
                    }
                    if frame < frames {
                        rig.scene.live[0].pictures.show(&picture(frame as usize));
                        scenes.push(rig.scene.still_at(0));
                        submit(&rig, &mut renderer, slot, &poses_at(&rig, u64::from(frame)), frame, 1.0)
                            .unwrap();
                    }
                }
                assert!(
                    newest >= 6,
                    "{overlap:?}, {most} texels a frame: the last picture seen is {newest} of {frames}"
                );
            }
        });
    }

    /// A picture goes to the GPU in pieces of ten texels, seven for the picture. The frames before the last piece show the picture before,
    /// and those from it on the new one. Newer pictures that come meanwhile wait, and the newest of them is next.
    #[test]
    fn a_frame_shows_one_whole_picture() {
        with_gpu(|gpu| {
            let rig = rig_with("pipe:/nowhere", &[]);
            let settings = RendererSettings { most_live_texels: 10, ..renderer_settings(&rig) };
            let mut renderer = Renderer::new(gpu, &rig.scene, settings).unwrap();
            let mut slot = renderer.create_slot(false).unwrap();
            let pictures = &rig.scene.live[0].pictures;
            let black = rig.scene.still_at(0);
            let shown = |k: usize| {
                pictures.show(&picture(k));
                rig.scene.still_at(0)
            };
            let mut scenes = vec![];
            for frame in 0..24u32 {
                match frame {
                    2 => scenes.push(shown(0)),
                    // Of these two the first is never shown: the second has come before it could begin.
                    4 | 5 => scenes.push(shown(frame as usize - 3)),
                    _ => {}
                }
                draw(&rig, &mut renderer, &mut slot, &poses_at(&rig, u64::from(frame)), frame, 1.0).unwrap();
                let expected = match frame {
                    0..8 => &black,
                    8..15 => &scenes[0],
                    _ => &scenes[2],
                };
                assert!(slot.codes() == alone(gpu, &rig, expected, frame), "frame {frame}");
            }
            let [first, last] = [&scenes[0], &scenes[2]].map(|scene| alone(gpu, &rig, scene, 9));
            assert!(
                first.iter().zip(&last).filter(|(a, b)| a != b).count() > 100,
                "the pictures differ in the light"
            );
            // A renderer that is made now, as after a lost GPU, begins with the newest picture.
            let mut late = Renderer::new(gpu, &rig.scene, renderer_settings(&rig)).unwrap();
            let mut slot = late.create_slot(false).unwrap();
            draw(&rig, &mut late, &mut slot, &poses_at(&rig, 9), 9, 1.0).unwrap();
            assert!(slot.codes() == alone(gpu, &rig, &scenes[2], 9));
        });
    }
}

/// A program that writes as fast as a clock says.
mod real_pace {
    use super::*;

    /// A whole rig, and another program that writes into a named pipe: the light is black on the bunny at first, and shows the picture in
    /// the end.
    #[test]
    fn a_rig_shows_what_another_program_writes_into_a_pipe() {
        let path = std::env::temp_dir().join(format!("dpm-live-{}", std::process::id()));
        let _ = std::fs::remove_file(&path);
        assert!(Command::new("mkfifo").arg(&path).status().unwrap().success());
        let rgb: Vec<u8> = picture(1).iter().flat_map(|texel| [texel[0], texel[1], texel[2]]).collect();
        let image = [format!("P6 {SIDE} {SIDE} 255\n").into_bytes(), rgb].concat();
        with_gpu(|gpu| {
            let pace = ["real_time.pace=\"real\"", "projector.frame_rate=\"120\"", "output.images=true"];
            let rig = rig_with(&format!("pipe:{}", path.display()), &pace);
            let is_over = Arc::new(AtomicBool::new(false));
            let writer = {
                let (path, image, is_over) = (path.clone(), image.clone(), is_over.clone());
                std::thread::spawn(move || {
                    // Opens when the rig does.
                    let mut pipe = File::options().write(true).open(path).unwrap();
                    while !is_over.load(Ordering::Relaxed) {
                        // The rig has closed its end.
                        if pipe.write_all(&image).is_err() {
                            return;
                        }
                        std::thread::sleep(std::time::Duration::from_millis(10));
                    }
                })
            };
            let (outcome, monitor) = run(gpu, &rig, 240, 8);
            is_over.store(true, Ordering::Relaxed);
            writer.join().unwrap();
            let notes = monitor.take_notes();
            assert!(notes.iter().any(|note| note.contains("pictures of 8 x 8 have begun")), "{notes:?}");
            let pictures = &rig.scene.live[0].pictures;
            assert!(pictures.count() > 2, "{} pictures", pictures.count());
            assert_eq!(pictures.newest(), picture(1));
            // The newest light of which the poses are known: on a busy machine not every frame is lit.
            let drawn = |frame: u32| outcome.recent.iter().find(|record| record.id.0 as u32 == frame);
            let mut newest = outcome.light.iter().rev();
            let (light, record) = newest
                .find_map(|light| Some((light, drawn(light.frame)?)))
                .expect("a lit frame with its record");
            let mut bodies = dpm_lab::sequence::BodyPlaces::default();
            rig.scene_poses(&record.tracked_poses, record.drawn_for.0, &mut bodies.poses);
            let fell: Vec<u32> =
                light.codes.iter().map(|c| u32::from_le_bytes([c[0], c[1], c[2], 0])).collect();
            let mut renderer = Renderer::new(gpu, &rig.scene.still_at(0), renderer_settings(&rig)).unwrap();
            let mut slot = renderer.create_slot(false).unwrap();
            let spp = rig.config.render.spp as f32;
            draw(&rig, &mut renderer, &mut slot, &bodies, light.frame, spp).unwrap();
            assert!(fell == slot.codes(), "the light of the last frame shows the picture");
        });
        let _ = std::fs::remove_file(&path);
    }
}
