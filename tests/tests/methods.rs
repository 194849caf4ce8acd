//! The passes between tracing and light: rates as the CPU decides them, nobody waits too long for a ray, energy is kept, and the method
//! of this program beats the others at equal rays.

use dpm_host::config::{Overrides, RenderMethod, RigConfig};
use dpm_host::experiments::run_rig::{open_gpu, traced_raster};
use dpm_host::experiments::sequence::{eye_mean, rmse, Span, Theatre};
use dpm_host::gpu::{validation_messages, Gpu};
use dpm_host::render::method::{Method, SamplerKind};
use dpm_host::render::rate_map::{decide, rate_table, PixelGuide, RateConstants};
use dpm_host::rig::Rig;
use dpm_shaders::structs::NO_HIT;
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
    let mut method = Method::from_config(&render);
    method.paper.zone_spp = [4, 4, 2];
    // The picture is small: angles that cut through it.
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

#[test]
fn rate_maps_are_the_cpus_bit_for_bit() {
    let (rig, _gpu, theatre) = stage(Span { last_slot: 20, warm_up: 4, kept: 6 }, true);
    let paper = method(&rig, RenderMethod::Paper);
    let constants = RateConstants {
        t: paper.paper.t as f32,
        l: paper.paper.l as f32,
        degrees: [paper.paper.phi_h_deg as f32, paper.paper.phi_q_deg as f32],
    };
    let table = rate_table();
    let width = rig.camera.raster.width() as usize;
    let tiles_x = width.div_ceil(16);
    let (mut previous, mut compared, mut coarse) = (Vec::new(), 0, 0);
    theatre
        .play(&paper, 4.0, 3, &mut |frame, slot| {
            let (surfaces, guides) = (slot.surfaces().unwrap(), slot.guides().unwrap());
            let rates = slot.rates().unwrap();
            if frame % 2 == 1 {
                assert_eq!(rates, previous, "rates change in every second frame only");
                return;
            }
            previous = rates.to_vec();
            // What the pass read: the prior that `reproject` left. After the frame it is gone where a sample was blended in, so only
            // tiles without fresh samples could be compared; the debug copy keeps the prior's luminance for that.
            let prior = slot.prior_luminance().unwrap();
            for (tile, &rate) in rates.iter().enumerate() {
                let (tx, ty) = (tile % tiles_x * 16, tile / tiles_x * 16);
                let pixels: [Option<PixelGuide>; 256] = std::array::from_fn(|i| {
                    let (x, y) = (tx + i % 16, ty + i / 16);
                    let at = y * width + x;
                    if x >= width || at >= surfaces.len() {
                        return None;
                    }
                    let s = &surfaces[at];
                    (s.id != NO_HIT && s.distance > 0.0).then(|| PixelGuide {
                        luminance: (prior[at] >= 0.0).then_some(prior[at]),
                        motion: guides[at].motion,
                        size: guides[at].size,
                        angle: guides[at].angle,
                    })
                });
                if pixels.iter().all(Option::is_none) {
                    continue;
                }
                assert_eq!(rate, decide(&pixels, &table, &constants).code(), "frame {frame} tile {tile}");
                compared += 1;
                coarse += u32::from(rate != 0);
            }
        })
        .unwrap();
    assert!(compared > 30 && coarse > 5, "{compared} tiles, {coarse} coarse");
    no_validation_messages();
}

#[test]
fn no_pixel_waits_more_than_two_frames_for_a_ray() {
    let (rig, _gpu, theatre) = stage(Span { last_slot: 24, warm_up: 0, kept: 24 }, false);
    let paper = method(&rig, RenderMethod::Paper);
    let width = rig.camera.raster.width();
    let mut waited = vec![0u32; rig.camera.raster.pixel_count()];
    theatre
        .play(&paper, 4.0, 5, &mut |frame, slot| {
            let (surfaces, traced, rates) =
                (slot.surfaces().unwrap(), slot.traced().unwrap(), slot.rates().unwrap());
            for (i, s) in surfaces.iter().enumerate() {
                if s.id == NO_HIT || s.distance <= 0.0 {
                    continue;
                }
                let (x, y) = (i as u32 % width, i as u32 / width);
                let rate = rates[(y / 16 * width.div_ceil(16) + x / 16) as usize];
                let (w, h) = (1 << (rate & 3), 1 << (rate >> 2 & 3));
                let block = (x / w * w, y / h * h);
                let any = (0..w * h).any(|k| {
                    let (bx, by) = (block.0 + k % w, block.1 + k / w);
                    traced.get((by * width + bx) as usize).is_some_and(|t| bx < width && t[3] > 0.0)
                });
                waited[i] = if any { 0 } else { waited[i] + 1 };
                assert!(waited[i] <= 2, "pixel {x},{y} waits since {} frames at frame {frame}", waited[i]);
            }
        })
        .unwrap();
    no_validation_messages();
}

#[test]
fn filters_and_rates_keep_the_energy() {
    let (rig, _gpu, theatre) = stage(Span { last_slot: 80, warm_up: 32, kept: 48 }, false);
    let reference = theatre
        .play(&Method { sampler: SamplerKind::BlueNoise, ..Method::full(16) }, 16.0, 9, &mut |_, _| ())
        .unwrap();
    let total = |seen: &dpm_host::experiments::sequence::Seen| -> f64 {
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
fn one_poisoned_history_is_forgotten() {
    let (rig, _gpu, theatre) = stage(Span { last_slot: 12, warm_up: 0, kept: 12 }, true);
    for which in [RenderMethod::Paper, RenderMethod::Miyamoto, RenderMethod::Dpm, RenderMethod::Full] {
        theatre
            .play(&method(&rig, which), 2.0, 4, &mut |frame, slot| {
                let shown = slot.radiance().unwrap();
                assert!(
                    shown.iter().flatten().all(|v| v.is_finite() && *v >= 0.0),
                    "{which:?} shows something that is not light at frame {frame}"
                );
            })
            .unwrap();
    }
    no_validation_messages();
}

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
