//! `dpm error` as a library: errors fall as theory says, a wrong sampler is caught, equal rays are equal.

use dpm_device::planes::Raster;
use dpm_host::config::{Overrides, RigConfig};
use dpm_host::experiments::error_plan::Group;
use dpm_host::experiments::error_runs::{ErrorOptions, ErrorRuns};
use dpm_host::experiments::run_rig::open_gpu;
use dpm_host::experiments::sequence::{rmse, Span, Theatre};
use dpm_host::gpu::Gpu;
use dpm_host::render::method::Method;
use dpm_host::rig::Rig;
use std::sync::Arc;

fn stage() -> (Arc<Rig>, Arc<Gpu>) {
    let flags = vec!["observer.gaze={kind=\"point\",point=[-0.1,0.0,0.0]}".to_owned()];
    let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
    let gpu = open_gpu(&config).unwrap_or_else(|e| panic!("{e}"));
    (Arc::new(Rig::build(&config, Raster::new(40, 30)).unwrap_or_else(|e| panic!("{e}"))), gpu)
}

/// RMS difference of two runs' single frames by the square root of two: the noise, without any reference.
fn noise(theatre: &Theatre, spp: u32, seeds: [u32; 2]) -> f64 {
    let [a, b] = seeds
        .map(|s| theatre.play(&Method::full(spp), spp as f32, s, &mut |_, _| ()).unwrap().frames.concat());
    rmse(&a, &b, |_| true) / 2f64.sqrt()
}

#[test]
fn independent_samples_fall_by_half_an_order_an_order() {
    let (rig, gpu) = stage();
    let theatre = Theatre::frozen(rig, gpu, Span { last_slot: 60, warm_up: 0, kept: 12 }).unwrap();
    let (few, many) = (noise(&theatre, 2, [1, 2]), noise(&theatre, 32, [3, 4]));
    let slope = (many / few).ln() / 16f64.ln();
    println!("noise {few:.5} at 2, {many:.5} at 32 samples: slope {slope:.3}");
    assert!((slope + 0.5).abs() < 0.06, "slope {slope}");
    // A sampler that repeats itself has no noise between its runs; whoever takes that for convergence must see it here.
    assert_eq!(noise(&theatre, 2, [5, 5]), 0.0);
    assert!(noise(&theatre, 2, [5, 6]) > 0.5 * few);
}

#[test]
fn a_group_is_measured_at_equal_rays_and_tells_bias_from_noise() {
    let (rig, gpu) = stage();
    let cache = std::env::temp_dir().join(format!("dpm-error-{}", std::process::id()));
    let options =
        ErrorOptions { warm_up: 8, kept: 48, reference_spp: 16, ablation: false, cache: cache.clone() };
    let runs = ErrorRuns::new(rig, gpu, options);
    let group = Group { moving: false, budget: 4.0 };
    let mut drawn = Vec::new();
    let result = runs.measure(group, &mut |what| drawn.push(what.to_owned())).unwrap().result;
    assert_eq!(drawn.iter().filter(|d| *d == "reference").count(), 2);
    for r in &result.rows {
        assert!((r.rays_to_paper - 1.0).abs() < 0.05, "{}: {} of paper's rays", r.method, r.rays_to_paper);
        let parts = (r.bias * r.bias + r.noise * r.noise).sqrt();
        assert!(
            (parts / r.perceived_rmse - 1.0).abs() < 0.2,
            "{}: {parts} against {}",
            r.method,
            r.perceived_rmse
        );
        assert!(r.perceived_rmse < r.single_rmse, "{}: the eye sees less noise than a frame has", r.method);
    }
    let full = result.rows.iter().find(|r| r.method == "full").unwrap();
    assert!(full.bias < 0.5 * full.noise, "full is unbiased: {} beside {}", full.bias, full.noise);
    // The second time the reference comes from the cache and the numbers are the same.
    drawn.clear();
    let again = runs.measure(group, &mut |what| drawn.push(what.to_owned())).unwrap().result;
    assert!(!drawn.iter().any(|d| d == "reference"));
    assert_eq!(again.rows[1].perceived_rmse, full.perceived_rmse);
    std::fs::remove_dir_all(cache).unwrap();
}
