//! Light without noise on the GPU: where no random choice is made on the way to the light, one sample has all of it.

use super::gpu_history::{dpm, play};
use super::gpu_shot::Shot;
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_render::{Keep, Renderer, Surface};
use dpm_scene::shapes::*;
use dpm_scene::{Material, Scene};
use glam::{DAffine3, DVec3, Vec3};
use std::sync::Arc;

/// Under an uneven sky.
fn mirror_ball() -> Scene {
    let mirror = Material { metallic: 1.0, roughness: 0.0, ..diffuse(Vec3::new(0.9, 0.8, 0.7)) };
    let mut scene = scene_of(sphere(Vec3::ZERO, 0.5, 3, true), mirror);
    scene.environment = image_sky(1.0);
    scene
}

pub(super) fn noise_free(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let (scene, eye) = (mirror_ball(), Some(DVec3::new(0.4, 0.5, 3.0)));
    // A pixel and a half a frame, over tiles and in from beyond the picture's edge.
    let poses = |frame: u32| vec![DAffine3::from_translation(DVec3::X * (f64::from(frame) * 0.06 - 1.0))];
    let mut worst: f64 = 0.0;
    for spp in [1, 4] {
        let shot = |method: Method| Shot {
            eye,
            spp,
            frames: 30,
            seed: seed as u32,
            method: Some(method),
            ..Shot::new(&scene, camera(64, 48, DVec3::new(0.0, 0.3, 3.0), DVec3::ZERO))
        };
        let (mut wanted, mut lit, mut traced) = (Vec::new(), 0u32, 0u32);
        play(gpu, &shot(Method::full(1)), poses, |_, slot| {
            wanted.push(slot.radiance().unwrap_or(&[]).to_vec());
            let surfaces = slot.surfaces().unwrap_or_default().into_iter();
            lit += surfaces.filter(|s| s.is_lit()).count() as u32;
        });
        play(gpu, &shot(dpm()), poses, |frame, slot| {
            let shown = slot.radiance().unwrap_or(&[]).iter().zip(&wanted[frame as usize]);
            let off = shown.flat_map(|(a, b)| (0..3).map(|c| f64::from((a[c] - b[c]).abs())));
            worst = off.fold(worst, |w: f64, d| if d.is_nan() { f64::INFINITY } else { w.max(d) });
            traced += slot.traced().unwrap_or(&[]).iter().map(|t| t[3] as u32).sum::<u32>();
        });
        if lit < 1000 || traced != lit {
            return f64::INFINITY;
        }
    }
    worst
}

/// As software Vulkan draws, and as GPUs do, which trace the samples of a pixel by several lanes.
pub(super) fn chance_comes_in(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let faults = |storage_tables| faults_where_chance_comes_in(gpu, seed, storage_tables);
    faults(false) + faults(true)
}

/// NaN where too few pixels began or ceased to be exact for the case to mean anything.
fn faults_where_chance_comes_in(gpu: &Arc<Gpu>, seed: u64, storage_tables: bool) -> f64 {
    let mut scene = mirror_ball();
    add(&mut scene, sphere(Vec3::ZERO, 0.3, 2, true), diffuse(Vec3::splat(0.5)));
    let poses = |frame: u32| {
        [DVec3::ZERO, DVec3::new(1.0, 0.4, 1.2 - 0.05 * f64::from(frame))]
            .map(DAffine3::from_translation)
            .to_vec()
    };
    let shot = Shot {
        eye: Some(DVec3::new(0.4, 0.5, 3.0)),
        spp: 2,
        frames: 48,
        seed: seed as u32,
        method: Some(dpm()),
        ..Shot::new(&scene, camera(64, 48, DVec3::new(0.0, 0.3, 3.0), DVec3::ZERO))
    };
    // Of the mirror's pixels, which stand: the flags of the frame before.
    let (mut before, mut begun, mut ended, mut faults) = (Vec::new(), 0u32, 0u32, 0u32);
    let keep = Keep { storage_tables, ..Keep::default() };
    let mut renderer = Renderer::keeping(gpu, &scene, shot.settings(), keep).expect("the scene fits the GPU");
    shot.play(&mut renderer, 0..shot.frames, poses, |_, slot, _| {
        let (history, traced) = (slot.history().unwrap_or_default(), slot.traced().unwrap_or(&[]));
        let mirrors = |s: &Surface| s.is_lit() && s.id >> 24 == 0;
        let lit: Vec<bool> = slot.surfaces().unwrap_or_default().iter().map(mirrors).collect();
        let exact: Vec<bool> = history.iter().map(|h| h.is_exact()).collect();
        for (i, was) in before.iter().enumerate().filter(|(i, _)| lit[*i]) {
            match (*was, exact[i]) {
                (true, false) => {
                    begun += 1;
                    faults += u32::from(traced[i][3] < 4.0 || history[i].light.weight != traced[i][3]);
                }
                (false, true) => {
                    ended += 1;
                    faults += u32::from(history[i].light.weight != 1.0 || history[i].noise.variance != 0.0);
                }
                _ => {}
            }
        }
        before = exact;
    });
    if begun < 30 || ended < 30 {
        return f64::NAN;
    }
    f64::from(faults)
}
