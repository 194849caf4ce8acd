//! The rules of \[paper\] on the GPU, each held to the equation or the table that states it: nothing here is learnt from what the shaders do.

use super::gpu::GpuCase;
use super::gpu_history::{carried_light, lit_by, play, play_at_rest};
use super::gpu_shot::Shot;
use crate::error::plan::method_of;
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_render::Surface;
use dpm_rig::config::{RenderConfig, RenderMethod};
use dpm_scene::shapes::*;
use glam::{DAffine3, DQuat, DVec2, DVec3, Vec3};
use std::sync::Arc;

/// The cases.
pub(crate) const CASES: &[GpuCase] = &[
    GpuCase(
        "gpu-size-follows-equation-3",
        "a floor, the projector above and the eye low beside it, method paper",
        "closed form: d = (cos th_E / l_E) (l_P / cos th_P)",
        "relative",
        1e-3,
        apparent_size,
    ),
    GpuCase(
        "gpu-samples-follow-table-1",
        "a floor that fills 60 degrees of the view, method paper with checkerboard and shading rates",
        "18 samples up to 30 degrees from the gaze, 2 beyond, in every pixel that is traced",
        "pixels",
        0.0,
        samples_by_angle,
    ),
    GpuCase(
        "gpu-disk-blends-in",
        "the same floor under an uneven sky, spatial filter of method paper alone",
        "between 15 and 18 degrees linear from the picture without the filter to that with it everywhere",
        "of the change",
        2e-3,
        disk_blends_in,
    ),
    GpuCase(
        "gpu-mean-after-disocclusion",
        "a light that changes in every frame over a floor that jumps by more than the picture, method paper at rest and in the periphery",
        "closed form: weight of frame n after the start or the jump is the larger of 1 / n and the table's alpha",
        "relative",
        1e-4,
        mean_after_disocclusion,
    ),
];

/// Angles and counts of table 1 and of section 2.4, written down once more: a wrong default of the rig file is a fault as well.
const INNER_DEG: f64 = 15.0;
const OUTER_DEG: f64 = 30.0;
const SAMPLES: [f32; 3] = [18.0, 18.0, 2.0];
const BLEND_TO_DEG: f64 = 18.0;
/// Table 1: weight of a new frame by zone, and an angle from the gaze that lies in it.
pub(super) const ALPHAS: [(f64, f64); 3] = [(0.2, 5.0), (0.1, 22.0), (0.05, 40.0)];

fn paper() -> Method {
    method_of(&RenderConfig::default(), RenderMethod::Paper)
}

/// A point for an eye to look at that lies `degrees` aside of the origin.
pub(super) fn gaze_aside(eye: DVec3, degrees: f64) -> DVec3 {
    let axis = (-eye).cross(DVec3::Z).normalize();
    eye + DQuat::from_axis_angle(axis, degrees.to_radians()) * -eye
}

/// Where the ray through the middle of a pixel meets the floor `y = 0`.
fn on_floor(shot: &Shot<'_>, pixel: usize) -> DVec3 {
    let width = shot.camera.raster.width() as usize;
    let ray = shot.camera.ray(DVec2::new((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5));
    ray.origin - ray.direction * (ray.origin.y / ray.direction.y)
}

/// Angle at the eye between the gaze and the floor that a pixel shows, degrees.
fn angle(shot: &Shot<'_>, pixel: usize) -> f64 {
    let (eye, gaze) = (shot.eye.unwrap_or_default(), shot.gaze.unwrap_or_default());
    (on_floor(shot, pixel) - eye).angle_between(gaze - eye).to_degrees()
}

fn lit(surfaces: Option<Vec<Surface>>) -> Vec<usize> {
    let surfaces = surfaces.unwrap_or_default().into_iter().enumerate();
    surfaces.filter(|(_, s)| s.is_lit()).map(|(i, _)| i).collect()
}

fn apparent_size(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let scene = super::gpu_history::even();
    let eye = DVec3::new(1.6, 0.7, 2.0);
    let shot = Shot {
        eye: Some(eye),
        gaze: Some(DVec3::ZERO),
        seed: seed as u32,
        method: Some(paper()),
        ..Shot::new(&scene, camera(32, 24, DVec3::new(-0.8, 3.0, 1.0), DVec3::ZERO))
    };
    let (mut worst, mut telling) = (0f64, 0u32);
    play_at_rest(gpu, &shot, |_, slot| {
        let guides = slot.guides().unwrap_or_default();
        for i in lit(slot.surfaces()) {
            let p = on_floor(&shot, i);
            // The floor's normal is the vertical.
            let (to_eye, to_projector) = (eye - p, shot.camera.position() - p);
            let wanted = (to_eye.normalize().y / to_eye.length())
                * (to_projector.length() / to_projector.normalize().y);
            let off = (f64::from(guides[i].sight.size) / wanted - 1.0).abs();
            worst = if off.is_nan() { f64::INFINITY } else { worst.max(off) };
            telling += u32::from(wanted < 0.7);
        }
    });
    // Sizes about 1 would not tell the equation from its inverse.
    if telling < 100 {
        return f64::NAN;
    }
    worst
}

/// A floor that an eye sees from close by, so that its angles from the gaze go from 0 to beyond 60 degrees.
fn wide_view(scene: &dpm_scene::Scene, method: Method, seed: u64) -> Shot<'_> {
    Shot {
        eye: Some(DVec3::new(0.1, 0.7, 0.3)),
        gaze: Some(DVec3::new(-0.75, 0.0, 0.1)),
        spp: 4,
        depth: 2,
        seed: seed as u32,
        method: Some(method),
        ..Shot::new(scene, camera(64, 48, DVec3::new(0.2, 3.0, 0.5), DVec3::ZERO))
    }
}

fn samples_by_angle(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let scene = super::gpu_history::even();
    let shot = Shot { frames: 6, ..wide_view(&scene, paper(), seed) };
    let (mut faults, mut zones) = (0u32, [0u32; 3]);
    play_at_rest(gpu, &shot, |_, slot| {
        let traced = slot.traced().unwrap_or(&[]);
        for i in lit(slot.surfaces()).into_iter().filter(|&i| traced[i][3] > 0.0) {
            let angle = angle(&shot, i);
            // On a bound either count is right.
            if [INNER_DEG, OUTER_DEG].iter().any(|b| (angle - b).abs() < 1e-3) {
                continue;
            }
            let zone = usize::from(angle > INNER_DEG) + usize::from(angle > OUTER_DEG);
            zones[zone] += 1;
            faults += u32::from(traced[i][3] != SAMPLES[zone]);
        }
    });
    if zones.iter().any(|n| *n < 100) {
        return f64::NAN;
    }
    f64::from(faults)
}

fn disk_blends_in(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut scene = super::gpu_history::even();
    scene.environment = image_sky(1.0);
    // The filter alone: every pixel in every frame, as many samples everywhere, no former frame.
    let filter =
        Method { rate_map: false, checkerboard: false, temporal: false, spp_by_angle: false, ..paper() };
    let mut everywhere = filter.clone();
    (everywhere.paper.filter_from_deg, everywhere.paper.filter_to_deg) = (0.0, 0.0);
    let seen = |method: Method| {
        let mut last = (Vec::new(), Vec::new());
        play_at_rest(gpu, &wide_view(&scene, method, seed), |_, slot| {
            last = (lit(slot.surfaces()), slot.radiance().unwrap_or(&[]).to_vec());
        });
        last
    };
    let (pixels, without) = seen(Method { spatial: false, ..filter.clone() });
    let (_, whole) = seen(everywhere);
    let (_, shown) = seen(filter.clone());
    let shot = wide_view(&scene, filter, seed);
    let (mut worst, mut changed, mut zones) = (0f64, 0f64, [0u32; 3]);
    for &i in &pixels {
        let share = ((angle(&shot, i) - INNER_DEG) / (BLEND_TO_DEG - INNER_DEG)).clamp(0.0, 1.0);
        zones[usize::from(share > 0.1) + usize::from(share > 0.9)] += 1;
        for c in 0..3 {
            let (own, disk) = (f64::from(without[i][c]), f64::from(whole[i][c]));
            let off =
                (f64::from(shown[i][c]) - (own + share * (disk - own))).abs() / (0.05 + (disk - own).abs());
            worst = if off.is_nan() { f64::INFINITY } else { worst.max(off) };
            changed += (disk - own).abs() / (3 * pixels.len()) as f64;
        }
    }
    // A filter that hardly changes anything, or a picture without some zone, tells nothing.
    if changed < 0.02 || zones.iter().any(|n| *n < 50) {
        return f64::NAN;
    }
    worst
}

fn mean_after_disocclusion(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    const JUMP: u32 = 30;
    let scene = carried_light();
    // Nothing is left of the histories that the floor's points had: they come from beyond the picture.
    let floor = |frame: u32| DAffine3::from_translation(DVec3::X * if frame < JUMP { 0.0 } else { 5.0 });
    let height = |frame: u32| 1.0 + 0.5 * f64::from(frame * 7 % 5);
    let eye = DVec3::new(-0.5, 3.2, 0.8);
    let mut worst = 0f64;
    for (alpha, degrees) in ALPHAS {
        let mut method = paper();
        // Every pixel in every frame and no filter, so that the recursion alone is left.
        (method.checkerboard, method.rate_map, method.spatial) = (false, false, false);
        let shot = Shot {
            eye: Some(eye),
            gaze: Some(gaze_aside(eye, degrees)),
            spp: 1,
            depth: 2,
            frames: 2 * JUMP,
            seed: seed as u32,
            method: Some(method),
            ..Shot::new(&scene, camera(17, 17, DVec3::new(0.0, 3.0, 0.01), DVec3::ZERO))
        };
        let (mut mean, mut n) = (0f64, 0u32);
        let poses = |frame| {
            vec![
                floor(frame),
                DAffine3::from_translation(Vec3::new(4.0, height(frame) as f32 - 0.2, 0.0).as_dvec3()),
            ]
        };
        play(gpu, &shot, poses, |frame, slot| {
            if frame == JUMP {
                n = 0;
            }
            n += 1;
            mean += (lit_by(height(frame)) - mean) * alpha.max(1.0 / f64::from(n));
            let shown = slot.radiance().map_or(f64::NAN, |r| f64::from(r[8 * 17 + 8][1]));
            let off = (shown / mean - 1.0).abs();
            worst = if off.is_nan() { f64::INFINITY } else { worst.max(off) };
        });
    }
    worst
}
