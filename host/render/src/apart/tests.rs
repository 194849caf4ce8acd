use super::*;
use crate::drive::Drive;
use crate::gpu::GpuOptions;
use crate::method::{Method, SamplerKind, HISTORY_CAP};
use crate::{FrameInputs, Output, RayWalker, Renderer};
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::shapes::{add, camera, diffuse, emitter, floor, image_sky, quad, scene_of, sphere};
use dpm_scene::{Body, Scene};
use glam::{DAffine3, DVec3, Vec3};
use std::sync::Arc;

fn dpm(spp: u32) -> Method {
    Method {
        dpm: true,
        rate_map: true,
        sampler: SamplerKind::Continued,
        temporal: true,
        spatial: true,
        history_cap: HISTORY_CAP,
        ..Method::full(spp)
    }
}

fn settings(method: &Method, camera: &ProjectorCamera, tracing: Tracing) -> RendererSettings {
    RendererSettings {
        raster: camera.raster,
        scale: crate::Scale::WHOLE,
        depth: 4,
        seed: 7,
        clamp_indirect: None,
        drive: Drive::even(0.5),
        lens: None,
        camera_is_eye: false,
        leave_nothing_out: false,
        method: method.clone(),
        halftone: None,
        plane_groups: vec![],
        output: Output::Codes,
        overlap: Overlapping::Never,
        tracing,
        most_live_texels: 0,
    }
}

/// A ball over a floor, with a lamp if it `glows` and a sky from a picture else.
fn scene(glows: bool) -> Scene {
    let mut scene =
        scene_of(sphere(Vec3::new(0.0, 0.2, 0.0), 0.2, 3, true), diffuse(Vec3::new(0.7, 0.5, 0.3)));
    add(&mut scene, floor(2.0, 0.0), diffuse(Vec3::splat(0.6)));
    if glows {
        let lamp = quad(Vec3::new(-0.3, 1.5, -0.3), Vec3::X * 0.6, Vec3::Z * 0.6);
        add(&mut scene, lamp, emitter(Vec3::splat(8.0)));
    } else {
        scene.environment = image_sky(1.0);
    }
    scene
}

/// Draws so many frames of a ball that moves, and returns code values and counters of each. `None`: this device is no software.
fn draw(
    gpu: &Arc<Gpu>,
    scene: &Scene,
    method: &Method,
    spp: u32,
    tracing: Tracing,
    frames: u32,
) -> Option<Vec<(Vec<u32>, [u32; 9])>> {
    let camera = camera(64, 48, DVec3::new(0.0, 0.8, 1.6), DVec3::new(0.0, 0.1, 0.0));
    let mut renderer = Renderer::new(gpu, scene, settings(method, &camera, tracing)).unwrap();
    let mut slot = renderer.create_slot(false).unwrap();
    if tracing == Tracing::Host && !gpu.summary().software {
        return None;
    }
    assert_eq!(slot.apart.is_some(), tracing == Tracing::Host);
    let walker = if tracing == Tracing::Host { RayWalker::Host } else { RayWalker::Shaders };
    assert_eq!(renderer.ray_walk().map(|walk| walk.by), Some(walker));
    let rest: Vec<DAffine3> = scene.bodies.iter().map(|b: &Body| b.world_from_body_rest).collect();
    let frame = |k: u32| {
        let mut poses = rest.clone();
        poses[0] = DAffine3::from_translation(DVec3::X * 0.002 * f64::from(k)) * poses[0];
        let eye = (DVec3::new(0.1, 0.9, 1.6), DVec3::ZERO);
        let inputs =
            FrameInputs { frame: k, spp, budget_spp: spp as f32, ..FrameInputs::new(&camera, eye, &poses) };
        renderer.submit(&mut slot, &inputs).unwrap();
        let cost = slot.wait(60_000_000_000).unwrap();
        assert_eq!(slot.was_apart, tracing == Tracing::Host);
        (slot.codes().to_vec(), cost.counters)
    };
    Some((0..frames).map(frame).collect())
}

/// Whoever walks, the light is the same: by methods with a history and without, under a lamp and a sky from a picture, and with more samples than have
/// room at once.
#[test]
fn the_light_is_the_same_whoever_walks() {
    let gpu = Gpu::open(&GpuOptions::default()).expect("a Vulkan device");
    let cases = [
        (true, Method::full(2), 2, 2),
        (false, dpm(2), 2, 5),
        (true, dpm(3), 3, 5),
        (false, Method::full(128), 128, 1),
    ];
    for (glows, method, spp, frames) in cases {
        let scene = scene(glows);
        let [shaders, host] =
            [Tracing::Walk, Tracing::Host].map(|t| draw(&gpu, &scene, &method, spp, t, frames));
        let (Some(shaders), Some(host)) = (shaders, host) else { return };
        let (mut lit, mut differ) = (0, 0);
        for ((a, of_a), (b, of_b)) in shaders.iter().zip(&host) {
            // Only the host is spared rays by horizons.
            let [mut of_a, mut of_b] = [*of_a, *of_b];
            let [spared_a, spared_b] = [&mut of_a, &mut of_b].map(|of| std::mem::take(&mut of[2]));
            assert!(spared_a == 0 && spared_b <= of_b[0], "{spared_a}, {spared_b}");
            assert_eq!(of_a, of_b, "the same rays and samples");
            lit += a.iter().filter(|code| **code != 0).count();
            differ += a.iter().zip(b).filter(|(a, b)| a != b).count();
        }
        assert!(lit > 500 * frames as usize, "{lit} lit pixels show little");
        // Where two triangles are equally near, or rounding decides.
        assert!(differ * 10_000 <= lit, "{differ} of {lit} pixels differ: {glows} {spp}");
    }
}

#[test]
fn a_frame_has_room_or_is_walked_by_the_shaders() {
    let camera = camera(1024, 768, DVec3::Z, DVec3::ZERO);
    let of = |method: &Method, bytes| {
        QueueLayout::new(&settings(method, &camera, Tracing::Host), false, true, bytes)
    };
    let (full, many) = (Method::full(2), Method::full(128));
    let pixels = u64::from(camera.raster.pixel_count() as u32);
    let layout = of(&full, 128 << 20).expect("room");
    assert!(layout.serves(&full, 2.0, 2, pixels) && !layout.serves(&full, 2.0, 128, pixels));
    assert!(u64::from(layout.rows) * 16 <= 128 << 20);
    // The last item of a batch has room behind it.
    assert!(layout.batch + full.most_spp() <= layout.paths);
    let layout = of(&many, 128 << 20).expect("room for some");
    assert!(layout.batches > 1 && !layout.serves(&many, 128.0, 128, pixels));
    assert_eq!(of(&full, 4096), None);
}
