//! The passes between tracing and light: energy is conserved, and this program's method is better than independent
//! samples at equal rays. Stability cases (run by `tracer_extremes.rs`) check that rates equal the CPU's, that no
//! pixel waits forever, and that broken histories are forgotten.

use dpm_device::planes::Raster;
use dpm_lab::sequence::{eye_mean, poses_at, rmse, submit, Span, Theatre, FRAME_WAIT_NS};
use dpm_lab::stability::gpu_shot::Shot;
use dpm_render::gpu::{validation_messages, Gpu};
use dpm_render::method::{Method, SamplerKind, HISTORY_CAP};
use dpm_render::scene_data::Keep;
use dpm_render::{FrameInputs, Output, Overlapping, Renderer, RendererSettings};
use dpm_rig::config::{Overrides, RenderMethod, RigConfig};
use dpm_rig::pipeline::renderer_settings;
use dpm_rig::rig::{affine, Rig};
use dpm_rig::run_rig::{open_gpu, traced_raster};
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::shapes::{add, camera, diffuse, image_sky, quad, scene_of};
use dpm_scene::Scene;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::demo_rig;
use glam::{DAffine3, DVec3, Vec3};
use std::sync::Arc;

const RASTER: &str = "render.software_raster=[64,48]";

fn stage(span: Span, moving: bool) -> (Arc<Rig>, Arc<Gpu>, Theatre) {
    let motions = if moving {
        ["{kind=\"translate\",amplitude_m=0.2}", "{kind=\"rotate\"}"]
    } else {
        ["{kind=\"still\"}"; 2]
    };
    let flags = vec![
        RASTER.to_owned(),
        "observer.gaze={kind=\"point\",point=[-0.1,0.0,0.0]}".to_owned(),
        format!(
            "scene.bodies=[{{name=\"bunny\",motion={}}},{{name=\"venus\",motion={}}}]",
            motions[0], motions[1]
        ),
    ];
    let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
    std::env::set_var("DPM_VALIDATION", "1");
    let gpu = open_gpu(&config).unwrap_or_else(|e| panic!("{e}"));
    let raster = traced_raster(&config, &gpu, &mut vec![]);
    let rig = Arc::new(Rig::build(&config, raster).unwrap_or_else(|e| panic!("{e}")));
    let theatre = Theatre::new(rig.clone(), gpu.clone(), span).unwrap();
    (rig, gpu, theatre)
}

fn method(rig: &Rig, which: RenderMethod) -> Method {
    let mut render = rig.config.render.clone();
    render.method = which;
    let mut method = render.to_method();
    method.paper.zone_spp = [4, 4, 2];
    // The picture is small, so these angles divide it.
    method.paper.phi_h_deg = 5.0;
    method.paper.phi_q_deg = 10.0;
    method.paper.filter_from_deg = 6.0;
    method.paper.filter_to_deg = 8.0;
    method
}

fn no_validation_messages() {
    let (count, texts) = validation_messages();
    assert_eq!(count, 0, "{texts:#?}");
}

/// The codes of ten frames of bodies that move, of which three are on their way at any time.
fn codes_in_line(gpu: &Arc<Gpu>, which: RenderMethod, overlap: Overlapping) -> Vec<Vec<u32>> {
    let rig = demo_rig(96, 72, &[]);
    let mut render = rig.config.render.clone();
    render.method = which;
    let output = Output::Both(rig.schedule);
    let settings =
        RendererSettings { method: render.to_method(), output, overlap, ..renderer_settings(&rig) };
    let mut renderer = Renderer::new(gpu, &rig.scene, settings).expect("the demo fits the GPU");
    let mut slots: Vec<_> = (0..3).map(|_| renderer.create_slot(false).expect("memory")).collect();
    let mut codes = Vec::new();
    for k in 0..13 {
        let slot = &mut slots[k % 3];
        if k >= 3 {
            let cost = slot.wait(FRAME_WAIT_NS).expect("the frame ends");
            codes.push(slot.codes().to_vec());
            assert_eq!(cost.overlaps, overlap == Overlapping::Always);
            assert!(cost.occupied_ns() > 0 || gpu.summary().timestamp_period_ns == 0.0);
        }
        if k < 10 {
            let poses = poses_at(&rig, 8 * k as u64);
            submit(&rig, &mut renderer, slot, &poses, k as u32, 2.0).expect("the frame begins");
        }
    }
    codes
}

/// Two squares in one plane, each a body of its own. Neither sees the other, so the light of one is the same whether the other is there; its
/// noisy neighbours beyond the border are alike in all but their body, and the filter must not take them in.
#[test]
fn the_filter_keeps_to_the_body() {
    let square = |left: f32| quad(Vec3::new(left, -1.0, 0.0), Vec3::X, Vec3::Y * 2.0);
    let mut alone = scene_of(square(-1.0), diffuse(Vec3::splat(0.6)));
    alone.environment = image_sky(1.0);
    let mut both = alone.clone();
    add(&mut both, square(0.0), diffuse(Vec3::splat(0.6)));
    // Every pixel has as many samples as the others, whatever they are worth.
    let method = Method {
        dpm: true,
        spatial: true,
        sampler: SamplerKind::Continued,
        history_cap: HISTORY_CAP,
        ..Method::full(1)
    };
    with_gpu(|gpu| {
        for storage_tables in [false, true] {
            let draw = |scene: &Scene| {
                let camera = camera(32, 24, DVec3::Z * 3.0, DVec3::ZERO);
                let eye = Some(DVec3::new(0.1, 0.2, 3.0));
                let shot =
                    Shot { eye, spp: 1, frames: 4, method: Some(method.clone()), ..Shot::new(scene, camera) };
                shot.draw_keeping(gpu, Keep { storage_tables, ..Keep::default() })
            };
            let [wanted, got] = [&alone, &both].map(draw);
            let of_first = |i: &usize| got.lit(*i) && got.surfaces[*i].id >> 24 == 0;
            let pixels: Vec<usize> = (0..got.radiance.len()).filter(of_first).collect();
            let beside =
                pixels.iter().filter(|i| got.lit(**i + 1) && got.surfaces[**i + 1].id >> 24 == 1).count();
            assert!(pixels.len() > 50 && beside > 8, "{} pixels, {beside} at the border", pixels.len());
            for i in pixels {
                assert_eq!(
                    got.radiance[i].map(f32::to_bits),
                    wanted.radiance[i].map(f32::to_bits),
                    "pixel {i}"
                );
            }
        }
    });
}

/// Every method, and frames in every order.
mod breadth {
    use super::*;

    #[test]
    fn dpm_lowers_the_perceived_error_of_independent_samples() {
        let (rig, _gpu, theatre) = stage(Span { last_slot: 120, warm_up: 40, kept: 31 }, false);
        let blue = Method { sampler: SamplerKind::BlueNoise, ..Method::full(32) };
        let reference = theatre.play(&blue, 32.0, 9, &mut |_, _| ()).unwrap();
        let reference = eye_mean(&reference.frames, 31);
        let error = |m: &Method| {
            let seen = theatre.play(m, 2.0, 1, &mut |_, _| ()).unwrap();
            (rmse(&eye_mean(&seen.frames, 31), &reference, |_| true), seen.rays)
        };
        let (full, full_rays) = error(&Method::full(2));
        let (ours, our_rays) = error(&method(&rig, RenderMethod::Dpm));
        println!("full {full:.5} ({full_rays} rays), dpm {ours:.5} ({our_rays} rays)");
        assert!(our_rays as f64 <= full_rays as f64 * 1.1);
        assert!(ours < 0.75 * full, "{ours} against {full}");
        no_validation_messages();
    }

    #[test]
    fn filters_and_rates_keep_the_energy() {
        let (rig, _gpu, theatre) = stage(Span { last_slot: 80, warm_up: 32, kept: 48 }, false);
        let reference = theatre
            .play(&Method { sampler: SamplerKind::BlueNoise, ..Method::full(16) }, 16.0, 9, &mut |_, _| ())
            .unwrap();
        let total = |seen: &dpm_lab::sequence::Seen| -> f64 {
            let mean = eye_mean(&seen.frames, 48);
            mean.iter().map(|v| v.as_dvec3().element_sum()).filter(|v| v.is_finite()).sum()
        };
        let wanted = total(&reference);
        for which in [RenderMethod::Paper, RenderMethod::Miyamoto, RenderMethod::Dpm] {
            let mut method = method(&rig, which);
            method.paper.zone_spp = [16, 16, 16];
            let seen = theatre.play(&method, 16.0, 2, &mut |_, _| ()).unwrap();
            let error = total(&seen) / wanted - 1.0;
            println!("{which:?}: {:+.4} %", error * 100.0);
            assert!(error.abs() < 0.005, "{which:?} changes the mean by {:+.3} %", error * 100.0);
        }
        no_validation_messages();
    }

    #[test]
    fn dpm_shows_a_body_at_one_metre_a_second_where_it_is() {
        let (rig, _gpu, theatre) = stage(Span { last_slot: 150, warm_up: 64, kept: 31 }, true);
        let centre = |slot| dpm_lab::sequence::poses_at(&rig, slot)[0].translation;
        let speed = (centre(150) - centre(119)).length() / 31.0 * rig.rate().hz();
        assert!((0.9..1.1).contains(&speed), "the body moves at {speed} m/s while it is looked at");
        let seen =
            |m: &Method, spp: f32| eye_mean(&theatre.play(m, spp, 1, &mut |_, _| ()).unwrap().frames, 31);
        let blue = Method { sampler: SamplerKind::BlueNoise, ..Method::full(32) };
        let truth = seen(&blue, 32.0);
        let shown = seen(&method(&rig, RenderMethod::Dpm), 4.0);
        let width = theatre.raster().width();
        let probes = theatre.probes();
        let at = |pixel: u32, body: usize| probes.iter().position(|p| p.pixel == pixel && p.body == body);
        // [Lucas81]: the displacement along the motion that explains most of the difference, using the reference's own
        // slopes.
        let displacement = |picture: &[glam::Vec3]| {
            let (mut product, mut square) = (0.0f64, 0.0f64);
            for (i, p) in probes.iter().enumerate().filter(|(_, p)| p.body == 0 && p.pixel % width > 0) {
                let (Some(left), Some(right)) = (at(p.pixel - 1, 0), at(p.pixel + 1, 0)) else { continue };
                let slope = (0.5 * (truth[right] - truth[left])).as_dvec3();
                let apart = (truth[i] - picture[i]).as_dvec3();
                if slope.is_finite() && apart.is_finite() {
                    product += slope.dot(apart);
                    square += slope.length_squared();
                }
            }
            assert!(square > 0.0, "the body has edges or highlights");
            product / square
        };
        // Check of the measure itself: the reference moved by one pixel is found one pixel away.
        let moved: Vec<glam::Vec3> = probes
            .iter()
            .map(|p| at(p.pixel.wrapping_sub(1), p.body).map_or(glam::Vec3::NAN, |i| truth[i]))
            .collect();
        let (one, ours) = (displacement(&moved), displacement(&shown));
        println!("moved by a pixel: {one:.3}, dpm {ours:+.3} px");
        assert!((0.5..1.5).contains(&one), "the measure sees {one} px in place of 1");
        assert!(ours.abs() < 0.25, "dpm is {ours:+.3} px from where the body is");
        no_validation_messages();
    }

    /// Found in use: a run was not repeatable. Which of the slots in flight draws a frame is arbitrary, but its picture
    /// must not be, also where a body leaves tiles and returns to them.
    #[test]
    fn what_a_frame_shows_does_not_depend_on_the_slot_that_draws_it() {
        let (rig, gpu, _) = stage(Span { last_slot: 2, warm_up: 1, kept: 1 }, false);
        let raster = Raster::new(160, 96).unwrap();
        let scale = 160.0 / f64::from(rig.camera.raster.width());
        let c = &rig.camera;
        let camera =
            ProjectorCamera::new(raster, c.world_from_projector, c.fx * scale, c.fy * scale, 80.0, 48.0)
                .unwrap();
        let rest: Vec<DAffine3> = rig.bodies.iter().map(|b| affine(&b.rest)).collect();
        let codes = |which: RenderMethod, order: &dyn Fn(usize) -> usize| -> Vec<Vec<u32>> {
            let settings =
                RendererSettings { raster, method: method(&rig, which), ..renderer_settings(&rig) };
            let mut renderer = Renderer::new(&gpu, &rig.scene, settings).unwrap();
            let mut slots: Vec<_> = (0..4).map(|_| renderer.create_slot(false).unwrap()).collect();
            let mut poses = Vec::new();
            let frame = |k: usize| {
                // Back and forth by about four tiles, at rest for three frames at a time.
                let x = 0.16 * ((k / 3) as f64 * 1.9).sin();
                let moved: Vec<_> =
                    rest.iter().map(|m| DAffine3::from_translation(DVec3::X * x) * *m).collect();
                rig.scene_poses(&moved, 0, &mut poses);
                let still = FrameInputs::new(&camera, rig.observer.eye_and_gaze(&moved), &poses);
                let inputs = FrameInputs { frame: k as u32, spp: 2, budget_spp: 2.0, ..still };
                let slot = &mut slots[order(k)];
                renderer.submit(slot, &inputs).unwrap();
                slot.wait(60_000_000_000).unwrap();
                slot.codes().to_vec()
            };
            (0..30).map(frame).collect()
        };
        for which in [RenderMethod::Paper, RenderMethod::Miyamoto, RenderMethod::Dpm] {
            let one = codes(which, &|_| 0);
            assert!(
                one.iter().all(|frame| frame.iter().any(|&c| c != 0)),
                "{which:?}: a frame without light"
            );
            assert!(one.windows(2).any(|pair| pair[0] != pair[1]));
            for (name, other) in [
                ("in turns", codes(which, &|k| k % 4)),
                ("as they come", codes(which, &|k| [0, 1, 0, 2, 1, 3, 3, 0, 2][k % 9])),
            ] {
                for (k, (a, b)) in one.iter().zip(&other).enumerate() {
                    let apart = a.iter().zip(b).filter(|(a, b)| a != b).count();
                    assert_eq!(apart, 0, "{which:?}, slots {name}: pixels of frame {k} that differ");
                }
            }
        }
        no_validation_messages();
    }

    /// Also where the device has one queue, to which the parts of frames then go in the order that semaphores give them.
    #[test]
    fn frames_that_overlap_show_what_frames_one_after_the_other_show() {
        with_gpu(|gpu| {
            for which in [RenderMethod::Dpm, RenderMethod::Paper, RenderMethod::Full] {
                let [alone, together] = [Overlapping::Never, Overlapping::Always]
                    .map(|overlap| codes_in_line(gpu, which, overlap));
                assert!(alone.len() == 10 && alone[9].iter().any(|&code| code != 0), "{which:?}");
                assert!(alone == together, "{which:?}: the pictures differ");
            }
        });
    }
}
