//! Found in use, real pace at full raster: the projector's clock was wrong by a quarter to half a millisecond while
//! frames flowed, and registration was twenty times worse than at virtual pace, at which every test ran. Frames are
//! prepared, so that a slow GPU has no influence.

use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::pipeline::{run_prepared, RunOptions, RunOutcome};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use std::sync::Arc;

/// Two seconds at 240 frames/s. A reply that is read one slot late causes an error of half a slot, which is 2 ms
/// here, or 3 px.
const SLOTS: u64 = 480;

fn run(pace: &str) -> RunOutcome {
    let flags = [
        format!("real_time.pace=\"{pace}\""),
        // Noise of a tracker would hide the effect of the clock.
        "tracker.noise_m=0".into(),
        "tracker.noise_rad=0".into(),
        "projector.frame_rate=240".into(),
        // Steady motion, which prediction knows at any horizon, so that only the clock's error remains.
        "scene.bodies.0.motion={ kind = \"translate\", speed_m_s = 1.0, amplitude_m = 4.0 }".into(),
    ];
    let config = RigConfig::demo(&Overrides { variables: vec![], flags: flags.into() });
    let rig = Arc::new(
        Rig::build(&config.unwrap_or_else(|e| panic!("{e}")), None).unwrap_or_else(|e| panic!("{e}")),
    );
    assert_eq!((rig.camera.raster.width(), rig.camera.raster.height()), (1024, 768));
    let slots = if pace == "virtual" { SLOTS / 4 } else { SLOTS };
    let options = RunOptions { slots, ..RunOptions::default() };
    run_prepared(rig, options, &Arc::new(RunMonitor::default())).unwrap_or_else(|e| panic!("{e}"))
}

#[test]
fn at_real_pace_and_full_raster_the_clock_is_right_and_light_lands_where_it_does_at_virtual_pace() {
    let ideal = run("virtual").report.registration_error_px.expect("light at virtual pace");
    let mut told = String::new();
    // The machine itself may stand still in one run, but not in each of three.
    for _ in 0..3 {
        let report = run("real").report;
        let clock = report.clock_error_ms.expect("light at real pace");
        let raw = report.registration_error_px.expect("light at real pace");
        let in_time = report.registration_error_in_time_px.expect("light at real pace");
        let bound_ns = report.projector.as_ref().and_then(|p| p.clock_bound_ns);
        // Without SCHED_FIFO the projector's thread waits for a core like any other, and so do the clock exchanges.
        let fifo = !report.warnings.iter().any(|w| w.contains("SCHED_FIFO"));
        let limit_ms = if fifo { 0.020 } else { 0.200 };
        told = format!(
            "registration p99 {:.4} px raw, {:.4} px of the frames lit in their slot (virtual pace {:.4}); due against the true instant p50 \
             {:.4} p99 {:.4} max {:.4} min {:.4} ms (limit {limit_ms}); the clock's bound {bound_ns:?} ns; {} lit, {} late",
            raw.p99,
            in_time.p99,
            ideal.p99,
            clock.spread.p50,
            clock.spread.p99,
            clock.spread.max,
            clock.min,
            report.frames_lit,
            report.frames_late
        );
        println!("{told}");
        let is_right = clock.spread.p99.abs() <= limit_ms && clock.spread.p50.abs() <= limit_ms;
        // Frames that a busy machine made late are lit a slot or more behind the body, whatever the clock, so the law
        // concerns the others. A fiftieth of a pixel is 13 us at 1 m/s.
        let is_registered = in_time.p99 <= (2.0 * ideal.p99).max(0.02);
        if is_right && is_registered && bound_ns.is_some_and(|ns| ns > 0) {
            return;
        }
    }
    panic!("{told}");
}
