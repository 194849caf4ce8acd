//! Frames through the whole pipeline at real pace, a hundred thousand in the second tier: on the frame path nothing is allocated, and the
//! only system calls are those that wait, wake and read the time. The frames are prepared, and the mock projector is in
//! this process; tests/tests/laws/real_pace/frame_path_vulkan.rs and its neighbours hold the law with drivers, cables and sockets.
#![cfg(all(target_os = "linux", target_arch = "x86_64"))]
#![allow(unsafe_code)]

use crate::frame_law;
use dpm_handoff::path::{self, Lock, Place};
use dpm_rig::control::parameters;
use dpm_rig::parameters::ParameterCommand;
use dpm_rig::pipeline::{run_prepared, RunOptions};
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_tests::rigs::demo_rig;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

/// Frames whose number counts. A few show what is called on the frame path; how many of them were lit in time, and how many
/// changes reached them, is judged where many run with nothing beside them.
const MANY: u64 = 25_000;

#[test]
fn frames_only_wait_and_wake() {
    frames_of_rigs_only_wait_and_wake(2, 500);
}

mod real_pace {
    use super::*;

    /// Several rigs in parallel, so that the test takes seconds: a panel of eight planes can show 2800 frames per second.
    #[test]
    fn a_hundred_thousand_frames_only_wait_and_wake() {
        frames_of_rigs_only_wait_and_wake(4, MANY);
    }
}

fn frames_of_rigs_only_wait_and_wake(rigs: u64, frames: u64) {
    frame_law::watch();
    let planned: u64 = std::thread::scope(|scope| {
        let runs: Vec<_> = (0..rigs)
            .map(|k| {
                scope.spawn(move || {
                    // Every other rig also tells its projector of the bodies between frames.
                    let tracks =
                        if k % 2 == 0 { "projector.tracks=\"auto\"" } else { "projector.tracks=\"off\"" };
                    let settings = [
                        "real_time.pace=\"real\"",
                        "projector.frame_rate=\"2800\"",
                        "projector.planes=8",
                        tracks,
                    ];
                    let rig = demo_rig(32, 16, &settings);
                    let monitor = Arc::new(RunMonitor::default());
                    let options = RunOptions { frames, ..RunOptions::default() };
                    let is_over = AtomicBool::new(false);
                    let (outcome, changes) = std::thread::scope(|scope| {
                        // Meanwhile an operator draws a slider.
                        let slider = scope.spawn(|| draw_a_slider(&monitor, &is_over));
                        let outcome = run_prepared(rig, options, &monitor).unwrap_or_else(|e| panic!("{e}"));
                        is_over.store(true, Ordering::Relaxed);
                        (outcome, slider.join().expect("it only asks"))
                    });
                    assert_eq!((outcome.frames_torn, outcome.frames_reordered), (0, 0));
                    let sent = outcome.report.projector.map_or(0, |projector| projector.tracks_sent);
                    assert!(sent == 0 || k % 2 == 0, "{sent} TRACKS");
                    if frames >= MANY {
                        assert!(changes > 100, "{changes} changes");
                        assert_eq!(sent > 100, k % 2 == 0, "{sent} TRACKS");
                        assert!(outcome.report.frames_lit > frames / 50, "{} lit", outcome.report.frames_lit);
                    }
                    monitor.counts().frames_planned
                })
            })
            .collect();
        runs.into_iter().map(|run| run.join().expect("the run ended")).sum()
    });
    assert_eq!(planned, rigs * frames);
    frame_law::seen().check(&[], &[]);
    what_breaks_the_law_is_seen();
}

/// Changes the exposure every few milliseconds until `is_over`. Returns how many changes planning has used.
fn draw_a_slider(monitor: &Arc<RunMonitor>, is_over: &AtomicBool) -> u64 {
    for k in 0u32.. {
        if is_over.load(Ordering::Relaxed) {
            break;
        }
        let numbers = vec![1.0 + f64::from(k % 100) * 1e-2];
        // Refused until the first frame is planned.
        let _ =
            parameters::give(monitor, &ParameterCommand::Set { name: "exposure".into(), numbers }, "test");
        std::thread::sleep(Duration::from_millis(3));
    }
    monitor.parameters().shown().map_or(0, |shown| shown.used)
}

/// The watch itself: an allocation, a lock and a system call of our own on the frame path, each planted here, fail the
/// check; those of a library do not count as ours, but only what is listed for it passes.
fn what_breaks_the_law_is_seen() {
    let fails = |named: &[(&str, &[&str])], libraries: &[(Place, &[&str])]| {
        std::panic::catch_unwind(|| frame_law::seen().check(named, libraries)).is_err()
    };
    let on_the_path = |plant: &(dyn Fn() + Sync)| {
        std::thread::scope(|scope| {
            scope.spawn(|| {
                path::enter(true);
                plant();
                path::enter(false);
            });
        });
    };
    let getpid: [&str; 1] = ["getpid"];
    let call = || {
        // SAFETY: takes no arguments.
        let _ = unsafe { libc::getpid() };
    };
    assert!(!fails(&[], &[]));
    on_the_path(&|| path::within(Place::Vulkan, call));
    assert!(fails(&[], &[]) && fails(&[("other", &getpid)], &[]) && !fails(&[], &[(Place::Vulkan, &getpid)]));
    on_the_path(&call);
    assert!(fails(&[], &[(Place::Vulkan, &getpid)]), "a system call of our own");
    let named = || fails(&[("other", &["getpid", "memory"])], &[(Place::Vulkan, &getpid)]);
    on_the_path(&|| drop(std::hint::black_box(Box::new(1u64))));
    assert!(fails(&[("other", &getpid)], &[(Place::Vulkan, &getpid)]), "an allocation");
    assert!(!named());
    let lock = Lock::new(());
    on_the_path(&|| drop(lock.lock()));
    assert!(named(), "a lock");
}
