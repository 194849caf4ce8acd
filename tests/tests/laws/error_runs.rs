//! `dpm error` as a library: errors decrease as theory predicts, a wrong sampler is detected, and equal rays are
//! equal.

use dpm_device::planes::Raster;
use dpm_lab::error::export::FrameIndex;
use dpm_lab::error::plan::Setting;
use dpm_lab::error::reference::Reference;
use dpm_lab::error::runs::{
    is_other, ErrorOptions, ErrorRuns, SequenceExtent, AT_EQUAL_TIME, EYE_FRAMES, RACES,
};
use dpm_lab::error::seen::{measure, measure_beside, SeenGroup, SeenRow};
use dpm_lab::sequence::{eye_mean, rmse, Span, Theatre};
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::rig::Rig;
use dpm_rig::run_rig::open_gpu;
use glam::Vec3;
use std::sync::Arc;

fn stage(settings: &[&str]) -> (Rig, Arc<Gpu>) {
    let gaze = "observer.gaze={kind=\"point\",point=[-0.1,0.0,0.0]}";
    let flags = [gaze].iter().chain(settings).map(|s| (*s).to_owned()).collect();
    let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
    let gpu = open_gpu(&config).unwrap_or_else(|e| panic!("{e}"));
    (Rig::build(&config, Raster::new(40, 30)).unwrap_or_else(|e| panic!("{e}")), gpu)
}

/// The noise without a reference: the RMS difference of two runs divided by the square root of two. For single
/// frames, and for the mean of all.
fn noise(theatre: &Theatre, method: &Method, seeds: [u32; 2]) -> (f64, f64) {
    let [a, b] = seeds.map(|s| theatre.play(method, method.budget_spp, s, &mut |_, _| ()).unwrap().frames);
    let apart = |a: &[Vec3], b: &[Vec3]| rmse(a, b, |_| true) / 2f64.sqrt();
    (apart(&a.concat(), &b.concat()), apart(&eye_mean(&a, a.len()), &eye_mean(&b, b.len())))
}

#[test]
fn independent_samples_fall_by_half_an_order_an_order() {
    let (rig, gpu) = stage(&[]);
    let theatre = Theatre::frozen(Arc::new(rig), gpu, Span { last_slot: 60, warm_up: 0, kept: 12 }).unwrap();
    let ((few, few_seen), (many, _)) =
        (noise(&theatre, &Method::full(2), [1, 2]), noise(&theatre, &Method::full(32), [3, 4]));
    let (slope, by_frames) = ((many / few).ln() / 16f64.ln(), (few_seen / few).ln() / 12f64.ln());
    println!("noise {few:.5} at 2, {many:.5} at 32 samples: slope {slope:.3}; {few_seen:.5} in 12 frames: slope {by_frames:.3}");
    // A sampler whose samples repeat within a frame, or from frame to frame, does not have this slope;
    // tests/mutations/run makes both.
    assert!((slope + 0.5).abs() < 0.06, "slope {slope} in samples");
    assert!((by_frames + 0.5).abs() < 0.06, "slope {by_frames} in frames");
    // A sampler that repeats itself has no noise between its runs. This shows that zero noise is not convergence.
    assert_eq!(noise(&theatre, &Method::full(2), [5, 5]).0, 0.0);
    assert!(noise(&theatre, &Method::full(2), [5, 6]).0 > 0.5 * few);
}

/// Whole groups.
mod breadth {
    use super::*;

    #[test]
    fn a_sampler_that_loses_light_is_told_from_one_that_does_not() {
        let seen = |settings: &[&str], seed: u32| {
            let (rig, gpu) = stage(settings);
            let theatre = Theatre::frozen(
                Arc::new(rig),
                gpu,
                Span { last_slot: 60, warm_up: 0, kept: EYE_FRAMES as u32 },
            )
            .unwrap();
            let cache = std::env::temp_dir().join(format!("dpm-bias-{}", std::process::id()));
            let eyes = [seed, seed + 1].map(|s| {
                let seen = theatre.play(&Method::full(32), 32.0, s, &mut |_, _| ()).unwrap();
                eye_mean(&seen.frames, EYE_FRAMES)
            });
            // The reference of the unchanged rig, under one name; the second time it is read from the cache.
            let reference = Reference::new(&theatre, 128, "as it is", &cache, &mut |_| ()).unwrap();
            (reference.bias(&eyes), reference.perceived(&eyes, &|_| true).1, cache)
        };
        let ((bias, chance), _, cache) = seen(&[], 1);
        // Paths that end at the first surface lose indirect light.
        let ((biased, _), error, _) = seen(&["render.depth=2"], 3);
        std::fs::remove_dir_all(cache).unwrap();
        println!("bias {bias:.5} of chance {chance:.5}; with less light {biased:.5}");
        // Squares are measured, and twice the chance level corresponds to four of their standard deviations.
        assert!(bias < 2.0 * chance, "independent samples have no bias: {bias}, chance {chance}");
        assert!(biased > 2.0 * chance, "{biased}, chance {chance}");
        assert!(biased > 0.5 * error, "what is lost is bias, not noise: {biased} of {error}");
    }

    /// Path tracing beside itself has no bias that people or tests notice; where it loses indirect light, the mean falls and the
    /// p-values of the tiles are no longer even.
    #[test]
    fn what_people_notice_moves_with_what_is_wrong() {
        let cache = std::env::temp_dir().join(format!("dpm-seen-{}", std::process::id()));
        let extent = SequenceExtent { warm_up: 8, kept: 48, reference_spp: 256 };
        let runs = |settings: &[&str]| {
            let (rig, gpu) = stage(settings);
            let cache = cache.clone();
            let options = ErrorOptions { extent, ablation: false, seeds: 8, window: None, cache };
            ErrorRuns::new(rig, gpu, Setting::plain(false, 4.0), options)
        };
        let row = |group: &SeenGroup, name: &str| -> SeenRow {
            group.rows.iter().find(|r| r.method == name).unwrap().clone()
        };
        let whole = runs(&[]);
        let fair = measure(&whole, &mut |_| ()).unwrap();
        for r in &fair.rows {
            for e in [r.jod, r.flicker, r.fast, r.mean_percent, r.flip, r.perceived_rmse] {
                assert!(e.interval[0] <= e.mean && e.mean <= e.interval[1] && e.mean.is_finite(), "{r:?}");
            }
            assert!(r.jod.mean > 0.0 && r.jod.mean < 10.0 && r.misaligned.is_none(), "{r:?}");
            assert!(
                r.flicker.mean > 0.0 && r.bias.histogram.iter().sum::<u32>() as usize == r.bias.tiles,
                "{r:?}"
            );
        }
        let full = row(&fair, "full");
        println!("{full:?}");
        let reach = full.mean_percent.interval[1] - full.mean_percent.mean;
        // Four and more standard errors, and as much of the reference.
        assert!(full.mean_percent.mean.abs() < 3.0 * reach, "{full:?}");
        assert!(full.bias.p_even > 1e-4, "{full:?}");
        let lost = row(&measure_beside(&runs(&["render.depth=2"]), &whole, &mut |_| ()).unwrap(), "full");
        println!("{lost:?}");
        assert!(lost.mean_percent.interval[1] < full.mean_percent.interval[0], "{lost:?}");
        assert!(lost.bias.p_even < 1e-4 && lost.bias.histogram[0] > full.bias.histogram[0], "{lost:?}");
    }

    #[test]
    fn a_group_is_measured_at_equal_rays_and_tells_bias_from_noise() {
        let (rig, gpu) = stage(&[]);
        let cache = std::env::temp_dir().join(format!("dpm-error-{}", std::process::id()));
        let extent = SequenceExtent { warm_up: 8, kept: 48, reference_spp: 16 };
        let options = ErrorOptions { extent, ablation: false, seeds: 4, window: None, cache: cache.clone() };
        let runs = ErrorRuns::new(rig, gpu, Setting::plain(false, 4.0), options);
        let mut drawn = Vec::new();
        let measured = runs.measure(&mut |what| drawn.push(what.to_owned())).unwrap();
        let result = measured.result.clone();
        assert_eq!(drawn.iter().filter(|d| *d == "reference").count(), 2);
        for r in &result.rows {
            assert!(
                (r.rays_to_paper - 1.0).abs() < 0.05,
                "{}: {} of paper's rays",
                r.method,
                r.rays_to_paper
            );
            // The squares of bias and noise add up to that of the error, within three standard deviations of the bias (a
            // negative one is cut off).
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
            assert!(
                r.perceived_rmse < r.single_rmse,
                "{}: the eye sees less noise than a frame has",
                r.method
            );
            assert!(r.gpu_ms > 0.0 || r.wall_ms > 0.0);
        }
        let full = result.rows.iter().find(|r| r.method == "full").unwrap();
        // A continuing sequence spreads the samples of a frame, and of the frames that the eye integrates, more evenly
        // than chance.
        let sequence = result.rows.iter().find(|r| r.method == "sequence").unwrap();
        println!("full {:.5}, sequence {:.5}", full.perceived_rmse, sequence.perceived_rmse);
        assert!(sequence.noise < 0.97 * full.noise, "{} beside {}", sequence.noise, full.noise);
        assert!(sequence.bias < 0.5 * sequence.noise, "{} beside {}", sequence.bias, sequence.noise);
        // All the others, and only they, are also drawn at dpm's time; more samples give less noise.
        for r in &result.rows {
            assert_eq!(r.equal_time.is_some(), is_other(&r.method), "{}", r.method);
            let [a, b] = r.runs_raw;
            assert!((0.5 * (a * a + b * b) - r.perceived_rmse_raw.powi(2)).abs() < 1e-12, "{}", r.method);
            assert!(r.middle_half_ms[0] <= r.middle_half_ms[1]);
            // By the costs of a card the time is met as well as rays follow samples, but where it has no more rays to give.
            let known = is_other(&r.method) && r.method != "own";
            assert_eq!(!r.on_cards.is_empty(), known, "{}", r.method);
            for t in &r.on_cards {
                println!("{} on {}: {:.1} samples, {:.2}", r.method, t.card, t.seen.spp, t.seen.time_to_dpm);
                assert!(t.seen.spp >= 1.0 || r.method != "full", "{}: {}", r.method, t.seen.spp);
                assert!((0.3..3.0).contains(&t.seen.time_to_dpm), "{}: {}", r.method, t.seen.time_to_dpm);
            }
            let Some(t) = r.equal_time else { continue };
            println!(
                "{}: {:.1} samples, {:.2} of the time, {:.5}",
                r.method, t.spp, t.time_to_dpm, t.perceived_rmse
            );
            assert!(t.time_to_dpm > 0.2 && t.time_to_dpm < 5.0, "{}: {}", r.method, t.time_to_dpm);
            if r.bias < 0.5 * r.noise && t.spp > 2.0 * r.spp {
                assert!(t.perceived_rmse_raw < r.perceived_rmse_raw, "{}", r.method);
            }
        }
        assert!(full.bias < 0.5 * full.noise, "full is unbiased: {} beside {}", full.bias, full.noise);
        // Stopped before the group was kept: reference and methods come from the cache, and only the times are measured
        // again.
        drawn.clear();
        let again = runs.measure(&mut |what| drawn.push(what.to_owned())).unwrap();
        let is_time = |what: &String| what == "times" || what.ends_with(AT_EQUAL_TIME);
        assert!(drawn.iter().all(is_time), "{drawn:?}");
        assert!((1..=1 + RACES).contains(&drawn.iter().filter(|what| *what == "times").count()), "{drawn:?}");
        assert_eq!(again.result.rows[1].perceived_rmse, full.perceived_rmse);
        // When the group is kept as a whole, its parts are not.
        let parts = || {
            let entries = std::fs::read_dir(&cache).unwrap();
            entries.filter(|e| e.as_ref().unwrap().file_name().to_string_lossy().starts_with("part-")).count()
        };
        assert_eq!(parts(), result.rows.len());
        measured.is_kept();
        assert_eq!(parts(), 0);
        // The frames on disk are those that were measured: the eye sees the mean of the last 31 of them.
        let dir = cache.join("frames");
        runs.export(&result, &dir, &mut |_| ()).unwrap();
        let index: FrameIndex =
            serde_json::from_slice(&std::fs::read(dir.join("sequence.json")).unwrap()).unwrap();
        assert!((index.frame_rate_hz - 947.0).abs() < 1.0 && index.pixels_per_degree > 0.1);
        assert_eq!((index.frames, index.lead_in), (49, 1));
        let frame = |folder: &str, k: usize| -> Vec<f32> {
            let bytes = std::fs::read(dir.join(folder).join(format!("{k:04}.pfm"))).unwrap();
            let body = bytes.strip_prefix(b"PF\n40 30\n-1.0\n").unwrap();
            body.chunks_exact(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect()
        };
        for (method, (name, eye)) in index.methods.iter().zip(&again.eyes) {
            assert_eq!(method.method, *name);
            let mut mean = vec![0.0f64; 40 * 30 * 3];
            for k in 49 - EYE_FRAMES..49 {
                mean.iter_mut()
                    .zip(frame(&method.folder, k))
                    .for_each(|(m, v)| *m += f64::from(v) / EYE_FRAMES as f64);
            }
            for (&pixel, v) in again.pixels.iter().zip(eye) {
                // The rows of the file begin at the bottom.
                let (x, y) = (pixel as usize % 40, 29 - pixel as usize / 40);
                let at = &mean[(y * 40 + x) * 3..][..3];
                assert!(
                    v.to_array().iter().zip(at).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-5),
                    "{name} {pixel}"
                );
            }
        }
        assert_eq!(frame("reference", 0), frame("reference", 48), "nothing moves");
        // For the time before the beginning, metrics use the truth, whatever the method.
        assert!(index.methods.iter().all(|m| frame(&m.folder, 0) == frame("reference", 0)));
        assert!(index.methods.iter().all(|m| frame(&m.folder, 1) != frame("reference", 1)));
        std::fs::remove_dir_all(cache).unwrap();
    }
}
