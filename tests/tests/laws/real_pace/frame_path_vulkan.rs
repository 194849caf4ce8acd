//! Rendered frames at real pace: on the frame path our own code allocates nothing, takes no lock, and makes no system
//! call but those that wait, wake and read the time. What the software driver does in our calls is listed, and the
//! list does not grow.
#![cfg(all(target_os = "linux", target_arch = "x86_64"))]

use crate::frame_law;
use dpm_handoff::path::Place;
use dpm_render::gpu::{Gpu, GpuOptions};
use dpm_tests::rigs::{demo_rig, run};

/// What the loader and the software driver may do on the frame path; docs/lab/LATENCY.md has the numbers. Drivers of
/// GPUs are not judged by it.
const SOFTWARE_DRIVER: [&str; 2] = ["memory", "pthread_mutex_lock"];

#[test]
fn rendered_frames_only_wait_and_wake_and_the_driver_does_what_is_listed() {
    frame_law::watch();
    // Without validation, which is no part of a rig.
    let gpu = Gpu::open(&GpuOptions::default()).unwrap_or_else(|e| panic!("this test needs Vulkan: {e}"));
    let mut frames = 0;
    for method in ["dpm", "sequence"] {
        let method = format!("render.method=\"{method}\"");
        let rig =
            demo_rig(32, 16, &["real_time.pace=\"real\"", "projector.frame_rate=\"200\"", method.as_str()]);
        let (outcome, monitor) = run(&gpu, &rig, 600, 0);
        frames += monitor.counts().frames_planned;
        assert!(outcome.report.frames_lit > 20, "{} lit", outcome.report.frames_lit);
    }
    let seen = frame_law::seen();
    println!("{}\n{}", gpu.summary().driver, seen.table(frames));
    let driver: &[&str] = if gpu.summary().software {
        &SOFTWARE_DRIVER
    } else {
        &["memory", "pthread_mutex_lock", "ioctl", "poll"]
    };
    seen.check(&[], &[(Place::Vulkan, driver)]);
}
