//! The spatial filter of method dpm against its oracle in f64.

use super::gpu::GpuCase;
use super::gpu_history::dpm;
use super::gpu_paper::gaze_aside;
use super::gpu_shot::Shot;
use crate::metrics::luminance;
use crate::snapshot::views::{albedo_of, angle_of};
use crate::twins::spatial_regression::{FilterPicture, FilterPixel};
use dpm_render::gpu::Gpu;
use dpm_render::scene_data::Keep;
use dpm_render::{FrameSlot, Guide, History, Renderer, Surface};
use dpm_scene::shapes::{add, camera, diffuse, image_sky, quad, scene_of, sphere};
use glam::{DVec3, Vec3};
use std::sync::Arc;

/// The cases.
pub(crate) const CASES: &[GpuCase] = &[GpuCase(
    "gpu-filter-against-f64",
    "the first frame of a noisy ball before a plate under an uneven sky, 5 to 27 degrees from the gaze, method dpm",
    "the same regression in f64, solved with pivots",
    "relative to the light",
    // The filter reads weights and divisors as halves.
    2e-3,
    against_f64,
)];

/// A unit vector from 2 x 16 bits on the octahedron.
fn decode_normal(bits: u32) -> DVec3 {
    let of = |bits: u32| f64::from(bits as u16 as i16) / 32767.0;
    let (x, y) = (of(bits), of(bits >> 16));
    let z = 1.0 - x.abs() - y.abs();
    let fold = |a: f64, b: f64| if z < 0.0 { (1.0 - b.abs()).copysign(a) } else { a };
    DVec3::new(fold(x, y), fold(y, x), z).normalize()
}

/// `periphery`: the angles from the gaze between which the picture becomes coarse, degrees.
fn pixel_of(surface: Surface, guide: &Guide, history: &History, periphery: [f64; 2]) -> FilterPixel {
    let [from, to] = periphery;
    let known = surface.is_lit();
    FilterPixel {
        surface,
        light: Vec3::from(history.light.mean).as_dvec3(),
        weight: if known { f64::from(history.light.weight) } else { 0.0 },
        variance: f64::from(history.noise.variance),
        albedo: f64::from(luminance(albedo_of(guide).into())),
        position: Vec3::from(history.place.position).as_dvec3(),
        normal: decode_normal(history.place.normal),
        body_and_used: history.noise.body_and_used,
        periphery: ((f64::from(angle_of(guide)) - from) / (to - from)).clamp(0.0, 1.0),
    }
}

/// Largest difference between what a frame shows and what the oracle makes of its histories, relative to the light; how many pixels were compared,
/// and how many of them the filter changed by more than a tenth.
fn difference(shot: &Shot<'_>, slot: &FrameSlot) -> (f64, usize, usize) {
    let (surfaces, shown) = (slot.surfaces().unwrap_or_default(), slot.radiance().unwrap_or(&[]));
    let (guides, history) = (slot.guides().unwrap_or_default(), slot.history().unwrap_or_default());
    let paper = shot.settings().method.paper;
    let periphery = [paper.filter_from_deg, paper.filter_to_deg];
    let all = surfaces.iter().zip(&guides).zip(&history);
    let pixels = all.map(|((s, g), h)| pixel_of(*s, g, h, periphery)).collect();
    let picture = FilterPicture {
        width: shot.camera.raster.width() as usize,
        pixels,
        pixel_size: 1.0 / shot.camera.fx,
        samples_a_frame: f64::from(shot.spp),
    };
    let (mut worst, mut compared, mut changed) = (0f64, 0, 0);
    for at in (0..surfaces.len()).filter(|&i| surfaces[i].is_lit()) {
        let albedo = Vec3::from(albedo_of(&guides[at])).as_dvec3();
        let own = picture.pixels[at].light;
        let wanted = picture.filtered(at);
        let got = Vec3::from_slice(&shown[at]).as_dvec3() / albedo;
        let scale = own.max_element().max(wanted.max_element()).max(0.02);
        let apart = (got - wanted).abs().max_element() / scale;
        worst = if apart.is_nan() { f64::NAN } else { worst.max(apart) };
        compared += 1;
        changed += usize::from((wanted - own).abs().max_element() > 0.1 * scale);
    }
    (worst, compared, changed)
}

/// In the first frame no history lags, so the filter is the regression alone.
fn against_f64(gpu: &Arc<Gpu>, seed: u64) -> f64 {
    let mut scene = scene_of(sphere(Vec3::ZERO, 1.0, 2, true), diffuse(Vec3::new(0.9, 0.6, 0.3)));
    add(
        &mut scene,
        quad(Vec3::new(-3.0, -3.0, -1.5), Vec3::X * 6.0, Vec3::Y * 6.0),
        diffuse(Vec3::splat(0.5)),
    );
    scene.environment = image_sky(1.0);
    let eye = DVec3::new(0.5, 0.4, 5.0);
    let mut worst: f64 = 0.0;
    // The tables of GPUs as well, for which the filter is written with loops that skip.
    for (spp, storage_tables) in [(2, false), (8, false), (8, true)] {
        let shot = Shot {
            eye: Some(eye),
            gaze: Some(gaze_aside(eye, 16.0)),
            spp,
            depth: 2,
            seed: seed as u32,
            method: Some(dpm()),
            ..Shot::new(&scene, camera(48, 40, DVec3::Z * 5.0, DVec3::ZERO))
        };
        let keep = Keep { storage_tables, ..Keep::default() };
        let mut renderer =
            Renderer::keeping(gpu, &scene, shot.settings(), keep).expect("the scene fits the GPU");
        shot.play(
            &mut renderer,
            0..1,
            |_| shot.world_from_body(),
            |_, slot, _| {
                let (apart, compared, changed) = difference(&shot, slot);
                // Enough pixels whose light is another one after the filter than before.
                let tells = compared > 500 && changed > 100;
                worst = if tells && !apart.is_nan() && !worst.is_nan() { worst.max(apart) } else { f64::NAN };
            },
        );
    }
    worst
}
