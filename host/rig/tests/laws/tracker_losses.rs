//! What a tracker loses, swaps and doubles is in the JSON of the run, body by body and to within chance.

use dpm_device::planes::Raster;
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::pipeline::{run_prepared, RunOptions};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use std::sync::Arc;

/// The tracker's part of the report of 4 s with these faults.
fn told(faults: &str) -> serde_json::Value {
    let flags = vec![
        "real_time.pace=\"virtual\"".to_owned(),
        "projector.frame_rate=\"100\"".to_owned(),
        format!("tracker.faults={faults:?}"),
    ];
    let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
    let rig = Arc::new(Rig::build(&config, Raster::new(16, 16)).unwrap_or_else(|e| panic!("{e}")));
    let options = RunOptions { frames: 400, ..RunOptions::default() };
    let outcome =
        run_prepared(rig, options, &Arc::new(RunMonitor::default())).unwrap_or_else(|e| panic!("{e}"));
    serde_json::to_value(&outcome.report).expect("a report is JSON")["tracker"].take()
}

/// 5 % lost, 3 % reordered, 3 % doubled.
#[test]
fn losses_of_the_tracker_are_in_the_json() {
    let told = told("loss=0.05,reorder=0.03,duplicate=0.03");
    let of = |all: &serde_json::Value, what: &str| all[what].as_u64().unwrap_or(u64::MAX) as f64;
    for all in [&told, &told["bodies"][0], &told["bodies"][1]] {
        // Of 4 s at 500 Hz of two bodies, or of one.
        let sent = if all["body"].is_null() { 4_000.0 } else { 2_000.0 };
        for (what, share) in [("lost", 0.05), ("reordered", 0.03), ("doubled", 0.03)] {
            let (n, expected) = (of(all, what), share * sent);
            let chance = 5.0 * f64::sqrt(expected);
            assert!((n - expected).abs() < chance, "{what}: {n}, not {expected} +- {chance}: {told:#}");
        }
        let used = of(all, "used") / sent;
        assert!((0.86..1.02).contains(&used), "{used} used: {told:#}");
    }
    let parts = ["used", "reordered", "doubled"].map(|what| of(&told, what));
    assert_eq!(of(&told, "samples"), parts.iter().sum::<f64>(), "{told:#}");
}

#[test]
fn a_tracker_that_loses_nothing_says_so() {
    let told = told("");
    for what in ["lost", "reordered", "doubled", "unlabelled", "impossible", "contradictory"] {
        assert_eq!(told[what], 0, "{told:#}");
    }
}
