//! Found in use, R1 and R12: the GPU of a running rig at real pace fails. The projector is dark when the frame that it shows says so, and the
//! picture is back once a device is there again and its pipelines are made; where none comes back the run ends in the dark and says why.

use crate::common::layer;
use dpm_device::planes::Raster;
use dpm_render::gpu::{Gpu, GpuOptions};
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::pipeline::{self, PipelineError, RunOptions, RunOutcome};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use std::sync::Arc;
use std::time::{Duration, Instant};

fn rig(more: &[&str]) -> Arc<Rig> {
    let flags = ["real_time.pace=\"real\"", "projector.frame_rate=60", "render.spp=1", "render.method=full"];
    let flags = flags.iter().chain(more).map(|flag| (*flag).to_owned()).collect();
    let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
    Arc::new(Rig::build(&config, Raster::new(48, 32)).unwrap_or_else(|e| panic!("{e}")))
}

/// A run that goes on until it is stopped; what it says.
struct Running {
    monitor: Arc<RunMonitor>,
    thread: Option<std::thread::JoinHandle<Result<RunOutcome, PipelineError>>>,
}

impl Running {
    fn start() -> Self {
        Self::with(&[])
    }

    fn with(more: &[&str]) -> Self {
        let rig = rig(more);
        let gpu = Gpu::open(&GpuOptions::default()).unwrap_or_else(|e| panic!("{e}"));
        let monitor = Arc::new(RunMonitor::default());
        let watched = monitor.clone();
        let thread = std::thread::spawn(move || pipeline::run(rig, &gpu, RunOptions::default(), &watched));
        Self { monitor, thread: Some(thread) }
    }

    /// Waits until this many more frames are lit.
    fn lit(&self, more: u64, within: Duration) -> Duration {
        let (begin, before) = (Instant::now(), self.monitor.counts().frames_lit);
        while self.monitor.counts().frames_lit < before + more {
            assert!(begin.elapsed() < within, "{} frames lit: {:?}", before, self.monitor.take_notes());
            std::thread::sleep(Duration::from_millis(1));
        }
        begin.elapsed()
    }

    fn end(mut self) -> Result<RunOutcome, PipelineError> {
        self.monitor.request_stop();
        self.thread.take().expect("once").join().expect("no panic")
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.monitor.request_stop();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The making of pipelines by a busy software driver, beside the two seconds that opening a device may take.
const BACK_WITHIN: Duration = Duration::from_secs(30);

#[test]
fn the_picture_comes_back_after_a_loss_and_after_a_submission_that_never_ends() {
    for (plan, word) in
        [("lost@frame=1", "lost"), ("submit-hang@frame=1", "did not finish"), ("lost@wait=1", "lost")]
    {
        let session = layer("");
        let run = Running::start();
        run.lit(20, BACK_WITHIN);
        run.monitor.take_notes();
        session.set(plan);
        let struck = Instant::now();
        // Nothing new is lit any more once what was on its way is.
        std::thread::sleep(Duration::from_millis(50));
        run.lit(20, BACK_WITHIN);
        println!("{plan}: 20 frames again after {:?}", struck.elapsed());
        let told = run.monitor.take_notes().join("\n");
        assert!(told.contains("are restarted") && told.contains(word), "{plan}: {told}");
        let report = run.end().unwrap_or_else(|e| panic!("{plan}: {e}")).report;
        assert!(report.frames_lit >= 40, "{plan}: {}", report.frames_lit);
    }
}

#[test]
fn a_gpu_that_is_lost_again_and_again_ends_the_run_in_the_dark_with_a_clear_word() {
    let session = layer("");
    let mut run = Running::start();
    run.lit(20, BACK_WITHIN);
    // The warm-up's frames of each new device count, too.
    session.set("lost@frame=1; lost@frame=6; lost@frame=11; lost@frame=16; lost@frame=21");
    let begin = Instant::now();
    let thread = run.thread.take().expect("once");
    while !thread.is_finished() {
        assert!(begin.elapsed() < 4 * BACK_WITHIN, "still running: {:?}", run.monitor.take_notes());
        std::thread::sleep(Duration::from_millis(5));
    }
    let error = match thread.join().expect("no panic") {
        Ok(outcome) => panic!("ended well: {} lit", outcome.report.frames_lit),
        Err(error) => error.to_string(),
    };
    assert!(error.contains("in the dark") || error.contains("lost"), "{error}");
}

/// The stages are restarted while the tracker says nothing: bodies that were lit are silent now, and not never seen.
#[test]
fn what_was_lit_before_a_restart_is_not_told_as_never_seen() {
    let session = layer("");
    let run = Running::with(&["tracker.faults=\"dropout@8s+600s\""]);
    run.lit(20, BACK_WITHIN);
    let mut notes = Vec::new();
    let mut wait = |part: &str| {
        let begin = Instant::now();
        while !notes.iter().any(|note: &String| note.contains(part)) {
            assert!(begin.elapsed() < BACK_WITHIN, "{part}: {notes:?}");
            notes.extend(run.monitor.take_notes());
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    wait("is dark: ");
    session.set("lost@frame=1");
    wait("are running again");
    // Long enough for frames of the new crew, and for its look at what it has not seen.
    std::thread::sleep(Duration::from_millis(1500));
    assert_eq!(run.monitor.tracker(), None);
    let report = run.end().unwrap_or_else(|e| panic!("{e}")).report;
    assert!(
        report.dark_by_body.iter().all(|body| body.silent > 20 && body.never_seen < 20),
        "{:?}",
        report.dark_by_body
    );
    assert!(!report.warnings.iter().any(|told| told.contains("never saw")), "{:?}", report.warnings);
}
