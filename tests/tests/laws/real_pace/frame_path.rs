//! The steady state allocates nothing: a counting allocator checks every thread of the frame path.

use crate::scene_files::{flag, rig_of};
use counting_allocator::{Counting, Request};
use dpm_device::time::HostTime;
use dpm_handoff::path;
use dpm_render::gpu::Gpu;
use dpm_rig::pipeline::on_frame_path;
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::{demo_rig, run};
use hil_mock::pupil::host::PupilHost;
use hil_mock::pupil::messages::PupilConfig;
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Allocations and releases on the frame path.
static COUNTED: AtomicU64 = AtomicU64::new(0);
/// Allocations anywhere, as proof that the counter is in use.
static ALL: AtomicU64 = AtomicU64::new(0);
/// How many were printed with their place; only the first few are.
static SHOWN: AtomicU64 = AtomicU64::new(0);
/// Set by the test of this file: the other tests of this program have watches of their own (`frame_law`).
static IS_WATCHING: AtomicBool = AtomicBool::new(false);

thread_local! {
    static SHOWING: Cell<bool> = const { Cell::new(false) };
}

/// Uses only atomics and thread-locals without destructors. The trace is taken while counting is off.
fn watch(request: Request) {
    if !IS_WATCHING.load(Ordering::Relaxed) {
        return;
    }
    ALL.fetch_add(1, Ordering::Relaxed);
    if on_frame_path() && !SHOWING.get() {
        COUNTED.fetch_add(1, Ordering::Relaxed);
        if SHOWN.fetch_add(1, Ordering::Relaxed) < 3 {
            SHOWING.set(true);
            // It allocates by the C library too, which `frame_law` watches.
            path::beside(|| {
                eprintln!("{request:?} on the frame path:\n{}", std::backtrace::Backtrace::force_capture());
            });
            SHOWING.set(false);
        }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting::telling(watch);

#[test]
fn the_steady_state_allocates_nothing() {
    IS_WATCHING.store(true, Ordering::Relaxed);
    with_gpu(|gpu| {
        for settings in [
            &["real_time.pace=\"virtual\"", "render.spp=1"][..],
            &["real_time.pace=\"virtual\"", "render.method=\"paper\""],
            &["real_time.pace=\"real\"", "projector.frame_rate=\"200\""],
            &["real_time.pace=\"virtual\"", "render.spp=1", "projector.tracks=\"auto\""],
            &["real_time.pace=\"real\"", "projector.frame_rate=\"200\"", "projector.tracks=\"auto\""],
        ] {
            rig_allocates_nothing(gpu, &demo_rig(32, 16, settings), &settings.join(" "));
        }
        // A mesh that deforms is moved, and its tree fitted, in the threads of the frame path.
        let flag = flag("frame-path");
        let rig = rig_of(&flag, (32, 16), "translate", &["real_time.pace=\"virtual\""]);
        rig_allocates_nothing(gpu, &rig, "a mesh that deforms");
        // Pictures of another program come while the rig runs, and go to the GPU in pieces.
        let bodies = "scene.bodies=[{ name = \"bunny\", texture = \"pipe:/nowhere\" }, { name = \"venus\" }]";
        let rig = demo_rig(32, 16, &[bodies, "real_time.pace=\"real\"", "projector.frame_rate=\"200\""]);
        let (pictures, is_over) = (rig.scene.live[0].pictures.clone(), Arc::new(AtomicBool::new(false)));
        let over = is_over.clone();
        let program = std::thread::spawn(move || {
            let [width, height] = pictures.size();
            let picture = vec![[200; 4]; (width * height) as usize];
            while !over.load(Ordering::Relaxed) {
                pictures.show(&picture);
                std::thread::sleep(Duration::from_millis(20));
            }
            pictures.count()
        });
        rig_allocates_nothing(gpu, &rig, "live pictures");
        is_over.store(true, Ordering::Relaxed);
        assert!(program.join().unwrap() > 5, "pictures came");
        // An eye tracker says 200 times a second where the observer looks.
        let begin = Instant::now();
        let clock = Arc::new(move || HostTime(begin.elapsed().as_nanos() as i64));
        let pupil = PupilHost::here(PupilConfig::default(), clock).expect("sockets");
        let gaze = format!("observer.gaze={{kind=\"pupil\",port={}}}", pupil.address().port());
        let real = [
            "real_time.pace=\"real\"",
            "projector.frame_rate=\"200\"",
            "observer.tracked=\"glasses\"",
            &gaze,
        ];
        let (rig, locks) = (demo_rig(32, 16, &real), path::locks_taken());
        let monitor = rig_allocates_nothing(gpu, &rig, "a gaze that a device measures");
        let told = monitor.gaze().report().expect("it is measured");
        assert!(told.frames_measured > 20 && path::locks_taken() == locks, "{told:?}");
        // The probe itself: a box that is made here is not on the frame path.
        assert!(!on_frame_path());
    });
}

fn rig_allocates_nothing(gpu: &Arc<Gpu>, rig: &Arc<Rig>, what: &str) -> Arc<RunMonitor> {
    let (before, all) = (COUNTED.load(Ordering::Relaxed), ALL.load(Ordering::Relaxed));
    let (_, monitor) = run(gpu, rig, 220, 0);
    let counts = monitor.counts();
    assert_eq!(counts.frames_planned, 220);
    assert_eq!(counts.frames_done(), 220);
    let during = COUNTED.load(Ordering::Relaxed) - before;
    assert_eq!(during, 0, "{what}: allocations and releases on the frame path");
    assert!(ALL.load(Ordering::Relaxed) > all, "the allocator is not the one in use");
    monitor
}
