//! The passes between tracing and light: energy is kept, and the method of this program beats independent samples at equal rays. That rates
//! are the CPU's, nobody waits and broken histories are forgotten are stability cases (`tracer_extremes.rs` runs them).

use dpm_host::config::{Overrides, RenderMethod, RigConfig};
use dpm_host::experiments::run_rig::{open_gpu, traced_raster};
use dpm_host::experiments::sequence::{eye_mean, rmse, Span, Theatre};
use dpm_host::gpu::{validation_messages, Gpu};
use dpm_host::render::method::{Method, SamplerKind};
use dpm_host::rig::Rig;
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
