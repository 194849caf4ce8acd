//! `dpm error` as a library: errors fall as theory says, a wrong sampler is caught, equal rays are equal.

use dpm_device::planes::Raster;
use dpm_host::config::{Overrides, RigConfig};
use dpm_host::experiments::error_export::FrameIndex;
use dpm_host::experiments::error_plan::Group;
use dpm_host::experiments::error_runs::{ErrorOptions, ErrorRuns, Extent, EYE_FRAMES};
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
    let extent = Extent { warm_up: 8, kept: 48, reference_spp: 16 };
    let options = ErrorOptions { extent, ablation: false, cache: cache.clone() };
    let runs = ErrorRuns::new(rig, gpu, options);
    let group = Group { moving: false, budget: 4.0 };
    let mut drawn = Vec::new();
    let measured = runs.measure(group, &mut |what| drawn.push(what.to_owned())).unwrap();
    let result = measured.result.clone();
    assert_eq!(drawn.iter().filter(|d| *d == "reference").count(), 2);
    for r in &result.rows {
        assert!((r.rays_to_paper - 1.0).abs() < 0.05, "{}: {} of paper's rays", r.method, r.rays_to_paper);
        // Squares of bias and noise add up to that of the error, as far as three standard deviations of the bias tell (a negative one is cut off).
        let parts = r.bias.powi(2) + r.noise.powi(2);
        let slack = (0.4 * r.perceived_rmse.powi(2)).max(3.0 * r.bias_floor.powi(2));
        assert!(
            (parts - r.perceived_rmse.powi(2)).abs() < slack,
            "{}: {} against {}, chance {}",
            r.method,
            parts.sqrt(),
            r.perceived_rmse,
            r.bias_floor
        );
        assert!(r.perceived_rmse < r.single_rmse, "{}: the eye sees less noise than a frame has", r.method);
        assert!(r.gpu_ms > 0.0 || r.wall_ms > 0.0);
    }
    let full = result.rows.iter().find(|r| r.method == "full").unwrap();
    assert!(full.bias < 0.5 * full.noise, "full is unbiased: {} beside {}", full.bias, full.noise);
    // Stopped before the group was kept: reference and methods come from the cache, only times are taken again.
    drawn.clear();
    let again = runs.measure(group, &mut |what| drawn.push(what.to_owned())).unwrap();
    assert_eq!(drawn, ["times"]);
    assert_eq!(again.result.rows[1].perceived_rmse, full.perceived_rmse);
    // Once the group is kept as a whole, its parts are not.
    let parts = || {
        let entries = std::fs::read_dir(&cache).unwrap();
        entries.filter(|e| e.as_ref().unwrap().file_name().to_string_lossy().starts_with("part-")).count()
    };
    assert_eq!(parts(), result.rows.len());
    measured.is_kept();
    assert_eq!(parts(), 0);
    // The frames on disk are those that were measured: the mean of the last 31 of them is what the eye saw.
    let dir = cache.join("frames");
    runs.export(group, &result, &dir, &mut |_| ()).unwrap();
    let index: FrameIndex =
        serde_json::from_slice(&std::fs::read(dir.join("sequence.json")).unwrap()).unwrap();
    assert!((index.frame_rate_hz - 947.0).abs() < 1.0 && index.frames == 48 && index.pixels_per_degree > 0.1);
    let frame = |folder: &str, k: usize| -> Vec<f32> {
        let bytes = std::fs::read(dir.join(folder).join(format!("{k:04}.pfm"))).unwrap();
        let body = bytes.strip_prefix(b"PF\n40 30\n-1.0\n").unwrap();
        body.chunks_exact(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect()
    };
    for (method, (name, eye)) in index.methods.iter().zip(&again.eyes) {
        assert_eq!(method.method, *name);
        let mut mean = vec![0.0f64; 40 * 30 * 3];
        for k in 48 - EYE_FRAMES..48 {
            mean.iter_mut()
                .zip(frame(&method.folder, k))
                .for_each(|(m, v)| *m += f64::from(v) / EYE_FRAMES as f64);
        }
        for (&pixel, v) in again.pixels.iter().zip(eye) {
            // Rows of the file run from the bottom.
            let (x, y) = (pixel as usize % 40, 29 - pixel as usize / 40);
            let at = &mean[(y * 40 + x) * 3..][..3];
            assert!(
                v.to_array().iter().zip(at).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-5),
                "{name} {pixel}"
            );
        }
    }
    assert_eq!(frame("reference", 0), frame("reference", 47), "nothing moves");
    std::fs::remove_dir_all(cache).unwrap();
}
