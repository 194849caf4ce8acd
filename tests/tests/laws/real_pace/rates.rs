//! Found in use, C2, R5, R6 and R21: every frame rate with every tracker, with the defaults only, at real pace. The
//! light is compared with the true positions of the bodies. Frames are rendered at up to 120 per second and prepared
//! from 240 per second on.

use dpm_render::gpu::Gpu;
use dpm_rig::pipeline::{self, RunOptions, RunOutcome};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::demo_rig;
use std::sync::Arc;

/// Frames per second, and the number of planes of each.
const RATES: [(u32, u32); 8] =
    [(24, 24), (30, 24), (60, 24), (100, 24), (120, 24), (240, 24), (947, 24), (2000, 8)];
/// Samples of the tracker per second.
const TRACKERS: [u32; 4] = [30, 120, 500, 1000];
/// From this rate on, frames are prepared.
const PREPARED_FROM: u32 = 240;
/// Duration of each run, seconds.
const SECONDS: f64 = 0.8;

fn rig(rate: u32, planes: u32, tracker: u32) -> Arc<Rig> {
    let settings = [
        "real_time.pace=\"real\"".to_owned(),
        format!("projector.frame_rate=\"{rate}\""),
        format!("projector.planes={planes}"),
        format!("tracker.rate_hz={tracker}"),
        "render.method=\"full\"".into(),
        "render.spp=1".into(),
    ];
    let settings: Vec<&str> = settings.iter().map(String::as_str).collect();
    demo_rig(64, 48, &settings)
}

fn run(gpu: Option<&Arc<Gpu>>, rig: &Arc<Rig>, rate: u32) -> RunOutcome {
    let slots = (f64::from(rate) * SECONDS) as u64;
    let options = RunOptions { slots, keep_frames: 4, ..RunOptions::default() };
    let monitor = Arc::new(RunMonitor::default());
    let outcome = match gpu {
        Some(gpu) => pipeline::run(rig.clone(), gpu, options, &monitor),
        None => pipeline::run_prepared(rig.clone(), options, &monitor),
    };
    outcome.unwrap_or_else(|e| panic!("{rate} frames/s: {e}"))
}

/// What is wrong with a run; `Ok` if nothing is.
fn judged(outcome: &RunOutcome, rig: &Rig, rendered: bool) -> Result<(), String> {
    let report = &outcome.report;
    let shown = report.frames_lit + report.frames_dark;
    // The first samples of a slow tracker come after the first frames. A body is dark until there are enough samples
    // to follow it.
    if report.frames_lit == 0 || 5 * report.frames_dark > 2 * shown {
        return Err(format!(
            "{} lit, {} dark: {:?}",
            report.frames_lit, report.frames_dark, report.dark_by_body
        ));
    }
    let Some(error) = report.registration_error_px else { return Err("no light to measure".into()) };
    // The bodies move at 1 m/s and turn. Half of the time they move steadily, where prediction must be accurate.
    let px_per_m = rig.camera.fx / 1.5;
    if error.p50 > 0.004 * px_per_m {
        return Err(format!("registration p50 {} px, {px_per_m} px are about a metre", error.p50));
    }
    // No light comes from poses that are older than the prediction time plus one slot.
    let oldest = report.motion_to_light_ms.map_or(0.0, |m| m.spread.max);
    let slot_ms = 1e3 / rig.rate().hz();
    if oldest > report.predict_ms + 2.0 * slot_ms {
        return Err(format!("light of poses {oldest} ms old, prediction reaches {} ms", report.predict_ms));
    }
    let bright = |f: &dpm_rig::light::recorder::LightFrame| f.codes.iter().any(|c| c.iter().any(|&v| v > 0));
    if rendered && !outcome.light.iter().any(bright) {
        return Err("every plane is black".into());
    }
    Ok(())
}

/// A shared machine may stand still in one run, but not in each of three.
fn holds(what: &str, mut run: impl FnMut() -> Result<(), String>) {
    let mut told = String::new();
    for _ in 0..3 {
        match run() {
            Ok(()) => return,
            Err(e) => told = e,
        }
    }
    panic!("{what}: {told}");
}

#[test]
fn every_frame_rate_lights_its_bodies_with_every_tracker_and_the_defaults() {
    with_gpu(|gpu| {
        for (rate, planes) in RATES {
            for tracker in TRACKERS {
                let rig = rig(rate, planes, tracker);
                let gpu = (rate < PREPARED_FROM).then_some(gpu);
                holds(&format!("{rate} frames/s, tracker at {tracker} Hz"), || {
                    judged(&run(gpu, &rig, rate), &rig, gpu.is_some())
                });
            }
        }
    });
}

/// Found in use, R21: the light of a renderer slower than its slots is where prediction at that horizon puts it.
#[test]
fn a_renderer_slower_than_its_slots_lights_every_nth_slot_in_time() {
    with_gpu(|gpu| {
        if !gpu.summary().software {
            println!("ignored: {} keeps up with these slots", gpu.summary().name);
            return;
        }
        holds("slow renderer", || {
            // At 947 slots per second software Vulkan needs many slots for a frame.
            let rig = demo_rig(
                96,
                72,
                &[
                    "real_time.pace=\"real\"",
                    "projector.frame_rate=\"947\"",
                    "render.spp=4",
                    "scene.bodies.0.motion={ kind = \"translate\", speed_m_s = 0.2, amplitude_m = 2.0 }",
                    "scene.bodies.1.motion={ kind = \"still\" }",
                ],
            );
            let monitor = Arc::new(RunMonitor::default());
            let options = RunOptions { slots: 1500, ..RunOptions::default() };
            let outcome = pipeline::run(rig.clone(), gpu, options, &monitor).map_err(|e| e.to_string())?;
            let report = &outcome.report;
            if report.slots_per_frame < 2.0 {
                return Err(format!("{} slots a frame: this machine is too quick", report.slots_per_frame));
            }
            let late = report.frames_late as f64 / report.frames_lit.max(1) as f64;
            if report.frames_lit < 20 || late > 0.05 {
                return Err(format!("{} lit, {} late", report.frames_lit, report.frames_late));
            }
            // Steady motion: prediction is as good at this horizon as at any.
            let error = report.registration_error_px.ok_or("no light")?;
            if error.p99 > 1.0 {
                return Err(format!("registration p99 {} px", error.p99));
            }
            let told: Vec<String> = monitor.take_notes();
            // Software Vulkan fills all cores: where other programs do too, that is what holds frames up.
            let says_why =
                |n: &String| n.contains("slower than its slots") || n.contains("short of processor");
            told.iter()
                .any(|n| says_why(n) && n.contains("one frame per"))
                .then_some(())
                .ok_or_else(|| format!("the rate is not said: {told:?}"))
        });
    });
}
