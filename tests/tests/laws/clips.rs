//! Clips, which are animated PNG files: each frame shows the picture of the centre of its light.

use crate::scene_files::TempFile;
use dpm_lab::sequence::{draw, BodyPlaces};
use dpm_render::Renderer;
use dpm_rig::pipeline::renderer_settings;
use dpm_rig::rig::Rig;
use dpm_scene::Scene;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::{demo_rig, run};
use image::{ImageFormat, RgbaImage};
use std::io::Cursor;
use std::sync::Arc;

/// Sides of a picture.
const SIDE: u32 = 8;
/// How long the three pictures last, milliseconds. The second has the time 0, which lasts one.
const LAST_MS: [u16; 3] = [7, 0, 12];

/// The three pictures: red, green and blue, with a texel that tells them from plain ones.
fn picture(k: usize) -> RgbaImage {
    let mut colour = [20, 20, 20, 255];
    colour[k] = 250;
    RgbaImage::from_fn(SIDE, SIDE, |x, y| image::Rgba(if x + y == 0 { [255; 4] } else { colour }))
}

/// The checksum of PNG, bit by bit.
fn crc(bytes: &[u8]) -> u32 {
    let step = |c: u32| if c & 1 == 1 { 0xedb8_8320 ^ (c >> 1) } else { c >> 1 };
    !bytes.iter().fold(u32::MAX, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), |c, _| step(c)))
}

fn chunk(kind: &[u8; 4], content: &[u8]) -> Vec<u8> {
    let named = [&kind[..], content].concat();
    [&(content.len() as u32).to_be_bytes()[..], &named, &crc(&named).to_be_bytes()].concat()
}

/// The contents of the chunks of a kind.
fn contents(png: &[u8], kind: &[u8; 4]) -> Vec<u8> {
    let (mut at, mut found) = (8, vec![]);
    while at + 12 <= png.len() {
        let len = u32::from_be_bytes(png[at..at + 4].try_into().unwrap()) as usize;
        if png[at + 4..at + 8] == *kind {
            found.extend(&png[at + 8..at + 8 + len]);
        }
        at += 12 + len;
    }
    found
}

/// An animated PNG of [`picture`], each as long as `last_ms` says.
fn clip(last_ms: &[u16]) -> Vec<u8> {
    let mut out = b"\x89PNG\r\n\x1a\n".to_vec();
    let mut sequence = 0u32;
    for (k, last) in last_ms.iter().enumerate() {
        let mut png = Cursor::new(vec![]);
        picture(k % 3).write_to(&mut png, ImageFormat::Png).unwrap();
        let png = png.into_inner();
        if k == 0 {
            out.extend(chunk(b"IHDR", &contents(&png, b"IHDR")));
            let counts = [(last_ms.len() as u32).to_be_bytes(), 0u32.to_be_bytes()].concat();
            out.extend(chunk(b"acTL", &counts));
        }
        let mut control = [sequence, SIDE, SIDE, 0, 0].map(u32::to_be_bytes).concat();
        control.extend([last.to_be_bytes(), 1000u16.to_be_bytes()].concat());
        control.extend([0, 0]);
        out.extend(chunk(b"fcTL", &control));
        sequence += 1;
        let data = contents(&png, b"IDAT");
        if k == 0 {
            out.extend(chunk(b"IDAT", &data));
        } else {
            out.extend(chunk(b"fdAT", &[&sequence.to_be_bytes()[..], &data].concat()));
            sequence += 1;
        }
    }
    out.extend(chunk(b"IEND", &[]));
    out
}

/// The clip in a file.
fn played(name: &str) -> TempFile {
    TempFile::new(&format!("{name}.png"), &clip(&LAST_MS))
}

/// The demo's rig, on whose bunny the clip plays.
fn rig_with(clip: &TempFile, more: &[&str]) -> Arc<Rig> {
    let file = clip.path().display();
    let bodies =
        format!("scene.bodies=[{{ name = \"bunny\", texture = \"{file}\" }}, {{ name = \"venus\" }}]");
    demo_rig(96, 72, &[&[&bodies[..]][..], more].concat())
}

/// Pictures, their times, and the scene that keeps one of them.
#[test]
fn a_clip_is_read_with_its_times_and_repeats() {
    let clip = played("times");
    let rig = rig_with(&clip, &[]);
    let clips: Vec<_> = rig.scene.textures.iter().filter(|t| !t.ends_ns.is_empty()).collect();
    assert_eq!(clips.len(), 1);
    let texture = clips[0];
    assert_eq!(texture.ends_ns, [7_000_000, 8_000_000, 20_000_000]);
    assert_eq!((texture.width, texture.height, texture.texels.len()), (SIDE, SIDE, 3 * 64));
    let all: Vec<u8> = (0..3).flat_map(|k| picture(k).into_raw()).collect();
    assert!(texture.texels.as_flattened() == all);
    for (t_ns, k) in
        [(0, 0), (6_999_999, 0), (7_000_000, 1), (8_000_000, 2), (19_999_999, 2), (20_000_000, 0)]
    {
        for round in [0, 5, -3] {
            assert_eq!(texture.picture_at(t_ns + round * 20_000_000), k, "{t_ns}");
        }
        let still = rig.scene.still_at(t_ns);
        let same = still.textures.iter().find(|t| t.texels.as_flattened() == &all[256 * k..][..256]);
        assert!(same.is_some_and(|t| t.ends_ns.is_empty()));
    }
}

/// Damage is refused by name or shown as a picture; nothing is taken beyond the limits.
#[test]
fn damaged_clips_never_panic() {
    let (good, plain) = (clip(&[5, 5, 5, 5]), dpm_scene::builtin());
    let (mut shown, mut refused) = (0, 0);
    for i in (8..good.len()).step_by(11) {
        let mut bad = good.clone();
        bad[i] ^= 0x55;
        let mut scene = plain.clone();
        match scene.show_picture(0, bad, &dpm_scene::Limits::default()) {
            Ok(()) => shown += 1,
            Err(e) => {
                assert!(e.to_string().contains("picture"), "{e}");
                refused += 1;
            }
        }
    }
    assert!(refused > 10, "{shown} {refused}");
}

/// Whole runs.
mod breadth {
    use super::*;

    #[test]
    fn the_light_shows_the_picture_of_its_centre() {
        let clip = played("light");
        with_gpu(|gpu| {
            let rig = rig_with(&clip, &["render.method=\"full\"", "projector.plane_poses=\"frame\""]);
            let (outcome, _) = run(gpu, &rig, 60, 40);
            assert_eq!((outcome.light_mismatches, outcome.light.len()), (0, 40));
            let alone = |scene: &Scene, bodies: &BodyPlaces, frame: u32| {
                let mut renderer = Renderer::new(gpu, scene, renderer_settings(&rig)).unwrap();
                let mut slot = renderer.create_slot(false).unwrap();
                draw(&rig, &mut renderer, &mut slot, bodies, frame, rig.config.render.spp as f32).unwrap();
                slot.codes().to_vec()
            };
            let mut seen = [0; 3];
            for (light, record) in outcome.light.iter().zip(&outcome.recent).step_by(4) {
                let at = record.drawn_for.0;
                let k = rig.scene.textures.iter().map(|t| t.picture_at(at)).max().unwrap();
                seen[k] += 1;
                let mut bodies = BodyPlaces { animated_at_ns: at, ..BodyPlaces::default() };
                rig.scene_poses(&record.tracked_poses, at, &mut bodies.poses);
                let fell: Vec<u32> =
                    light.codes.iter().map(|c| u32::from_le_bytes([c[0], c[1], c[2], 0])).collect();
                assert!(
                    fell == alone(&rig.scene.still_at(at), &bodies, light.frame),
                    "frame {}",
                    light.frame
                );
                let other = alone(&rig.scene.still_at(at + 8_000_000), &bodies, light.frame);
                let differ = fell.iter().zip(&other).filter(|(a, b)| a != b).count();
                assert!(
                    differ > 100 || k == rig.scene.textures.last().unwrap().picture_at(at + 8_000_000),
                    "{differ}"
                );
            }
            assert!(seen[0] > 0 && seen[2] > 0, "{seen:?}");
        });
    }
}
