//! A hundred thousand frames through the whole pipeline at real pace: on the frame path nothing is allocated, and the
//! only system calls are those that wait, wake and read the time. The frames are prepared, and the mock projector is in
//! this process; tests/tests/frame_path_vulkan.rs and its neighbours hold the law with drivers, cables and sockets.
#![cfg(all(target_os = "linux", target_arch = "x86_64"))]

mod frame_law;

use dpm_rig::pipeline::{run_prepared, RunOptions};
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_tests::rigs::demo_rig;
use std::sync::Arc;

/// Several rigs in parallel, so that the test takes seconds: a panel of eight planes can show 2800 frames per second.
const RIGS: u64 = 4;
const FRAMES: u64 = 25_000;

#[test]
fn a_hundred_thousand_frames_only_wait_and_wake() {
    frame_law::watch();
    let planned: u64 = std::thread::scope(|scope| {
        let runs: Vec<_> = (0..RIGS)
            .map(|_| {
                scope.spawn(|| {
                    let settings =
                        ["real_time.pace=\"real\"", "projector.frame_rate=\"2800\"", "projector.planes=8"];
                    let rig = demo_rig(32, 16, &settings);
                    let monitor = Arc::new(RunMonitor::default());
                    let options = RunOptions { frames: FRAMES, ..RunOptions::default() };
                    let outcome = run_prepared(rig, options, &monitor).unwrap_or_else(|e| panic!("{e}"));
                    assert_eq!((outcome.frames_torn, outcome.frames_reordered), (0, 0));
                    assert!(outcome.report.frames_lit > FRAMES / 50, "{} lit", outcome.report.frames_lit);
                    monitor.counts().frames_planned
                })
            })
            .collect();
        runs.into_iter().map(|run| run.join().expect("the run ended")).sum()
    });
    assert_eq!(planned, RIGS * FRAMES);
    frame_law::seen().check(&[], &[]);
}
