//! A body's albedo from a picture over its texture coordinates: what arrives in the eye after the reflection is what an even body would show.

use dpm_lab::twins::compensation::albedo_f64;
use dpm_render::gpu::Gpu;
use dpm_render::{FrameInputs, Keep, Renderer, RendererSettings};
use dpm_rig::pictures::pictures;
use dpm_rig::pipeline::renderer_settings;
use dpm_rig::rig::Rig;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::{demo_rig, run};
use glam::{DVec2, DVec3};
use std::path::PathBuf;
use std::sync::Arc;

/// A picture of 24 x 16 pixels of other albedos, brighter in red than in blue, that is removed afterwards.
struct Picture(PathBuf);

impl Picture {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("dpm-albedo-{name}-{}.png", std::process::id()));
        let mut random = dpm_lab::reference::Sampler::new(5, 0);
        let picture = image::RgbImage::from_fn(24, 16, |_, _| {
            let mut code =
                |least: f64, most: f64| (255.0 * (least + (most - least) * random.uniform())) as u8;
            image::Rgb([code(0.5, 0.9), code(0.2, 0.8), code(0.1, 0.5)])
        });
        picture.save(&path).unwrap();
        Self(path)
    }

    /// The demo's rig with the picture on the bunny, in a room that is not dark.
    fn rig(&self, width: u32, height: u32) -> Arc<Rig> {
        let map = format!("scene.bodies.0.albedo_map=\"{}\"", self.0.display());
        let keys = [&map[..], "scene.bodies.0.albedo_map_encoding=\"linear\""];
        demo_rig(width, height, &[&keys[..], &ROOM].concat())
    }
}

impl Drop for Picture {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

/// A bright projector, so that dark places of the picture can be compensated, and light in the room.
const ROOM: [&str; 2] = ["projector.max_intensity=60", "scene.ambient=[0.01, 0.02, 0.005]"];

/// A pixel that is lit.
struct Lit {
    pixel: usize,
    body: usize,
    uv: [f64; 2],
    codes: [u8; 3],
    /// Irradiance of full light.
    full: [f64; 3],
}

/// A frame of the rig's projector, each lit pixel with what it lights, in f64.
fn frame(gpu: &Arc<Gpu>, rig: &Rig) -> Vec<Lit> {
    let settings = RendererSettings { plane_groups: Vec::new(), ..renderer_settings(rig) };
    let mut renderer = Renderer::keeping(gpu, &rig.scene, settings, Keep::default()).unwrap();
    let mut slot = renderer.create_slot(true).unwrap();
    let mut poses = Vec::new();
    rig.scene_poses(&rig.true_poses(0).unwrap(), 0, &mut poses);
    let still = FrameInputs::new(&rig.camera, rig.observer.eye_and_gaze(&poses), &poses);
    let inputs = FrameInputs { spp: 2, budget_spp: 2.0, ..still };
    renderer.submit(&mut slot, &inputs).unwrap();
    slot.wait(60_000_000_000).unwrap();
    let width = rig.camera.raster.width() as usize;
    let intensity = rig.config.projector.max_intensity.0;
    let seen = slot.surfaces().unwrap().into_iter().enumerate().filter(|(_, s)| s.is_lit());
    let lit = seen.map(|(pixel, surface)| {
        let body = (surface.id >> 24) as usize;
        let mesh_vertex = |v: u32| {
            // Vertices of all bodies lie one after another.
            let before: usize = rig.scene.bodies[..body].iter().map(|b| b.mesh.positions.len()).sum();
            v as usize - before
        };
        let mesh = &rig.scene.bodies[body].mesh;
        let [a, b, c] = renderer.corners(&surface).map(mesh_vertex);
        let [u, v] = surface.barycentric.map(f64::from);
        let blend = |at: &dyn Fn(usize) -> DVec3| at(a) * (1.0 - u - v) + at(b) * u + at(c) * v;
        let uv = blend(&|i| mesh.uvs[i].as_dvec2().extend(0.0));
        let normal = poses[body].transform_vector3(blend(&|i| mesh.normals[i].as_dvec3())).normalize();
        let at = DVec2::new((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
        let cos = normal.dot(rig.camera.ray(at).direction).abs().max(1e-3);
        let d2 = f64::from(surface.distance).powi(2);
        let code = slot.codes()[pixel];
        Lit {
            pixel,
            body,
            uv: [uv.x, uv.y],
            codes: [0, 8, 16].map(|shift| (code >> shift) as u8),
            full: intensity.map(|i| i * cos / d2),
        }
    });
    lit.collect()
}

#[test]
fn a_printed_body_shows_the_eye_what_an_even_one_shows_up_to_the_gamut() {
    let picture = Picture::new("law");
    with_gpu(|gpu| {
        let (printed, even) = (picture.rig(160, 120), demo_rig(160, 120, &ROOM));
        let map = printed.drive.albedo_maps[0].as_ref().expect("the bunny has a map");
        assert!(printed.drive.albedo_maps[1..].iter().all(Option::is_none));
        let (on_printed, on_even) = (frame(gpu, &printed), frame(gpu, &even));
        assert_eq!(on_printed.len(), on_even.len());
        let (mut compared, mut different, mut beyond) = (0, 0, 0);
        for (p, e) in on_printed.iter().zip(&on_even) {
            assert_eq!((p.pixel, p.body), (e.pixel, e.body));
            if p.body != 0 {
                assert_eq!(p.codes, e.codes, "a body without a map is lit as before");
                continue;
            }
            let albedo = albedo_f64(map, p.uv);
            for c in 0..3 {
                // Radiance of a matt surface, and that of half a code.
                let seen = |code: f64, albedo: f64| code / 255.0 * albedo * p.full[c] / std::f64::consts::PI;
                let (on_p, on_e) = (seen(f64::from(p.codes[c]), albedo[c]), seen(f64::from(e.codes[c]), 0.8));
                let half = 0.5 * (seen(1.0, albedo[c]) + seen(1.0, 0.8));
                if p.codes[c] == 255 || e.codes[c] == 255 {
                    beyond += 1;
                    continue;
                }
                assert!(
                    (on_p - on_e).abs() <= half * (1.0 + 1e-3),
                    "pixel {}, channel {c}: {on_p} on albedo {}, {on_e} on an even one",
                    p.pixel,
                    albedo[c]
                );
                compared += 1;
                different += u32::from(p.codes[c].abs_diff(e.codes[c]) > 2);
            }
        }
        assert!(compared > 2000 && beyond < compared / 10, "{compared} compared, {beyond} beyond the gamut");
        assert!(different > compared / 2, "the picture changes the light of {different} of {compared}");
    });
}

/// Whole runs.
mod breadth {
    use super::*;

    #[test]
    fn a_run_with_a_printed_body_looks_as_one_with_an_even_body() {
        let picture = Picture::new("run");
        with_gpu(|gpu| {
            let seen = [picture.rig(128, 96), demo_rig(128, 96, &ROOM)].map(|rig| {
                let (outcome, _) = run(gpu, &rig, 6, 1);
                let made = pictures(&rig, gpu, &outcome.light, &outcome.recent).unwrap();
                (made.light, made.viewer.unwrap())
            });
            let [(printed_light, printed), (even_light, even)] = seen;
            let mean = |of: &[glam::Vec3], with: &[glam::Vec3]| {
                of.iter().zip(with).map(|(a, b)| (*a - *b).abs().element_sum()).sum::<f32>()
                    / with.iter().map(|v| v.abs().element_sum()).sum::<f32>()
            };
            let (light, eye) = (mean(&printed_light, &even_light), mean(&printed, &even));
            println!(
                "the light differs by {:.1} %, what the eye sees by {:.1} %",
                100.0 * light,
                100.0 * eye
            );
            // Half a texel of the picture is smeared by pixels of this raster; the light itself has all of the picture.
            assert!(light > 0.3 && eye < 0.25 * light, "light {light}, eye {eye}");
        });
    }
}
