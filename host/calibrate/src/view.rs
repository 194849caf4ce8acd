//! `dpm calibrate projector --camera`: coded pictures on anything in view, seen by the rig's camera.

use super::shown::while_shown;
use dpm_calibration::file::ProjectorSection;
use dpm_calibration::view::{solve, ViewCode, ViewFit};
use dpm_camera::{board_markings, coded_view, Picture};
use dpm_common::clock::{Clock, MonotonicClock};
use dpm_device::planes::Raster;
use dpm_device::tag36h11::TagBoard;
use dpm_device::time::HostClock;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::pack::source::{Canvas, PatternSource};
use dpm_rig::pattern::run_pattern;
use dpm_rig::results::Results;
use dpm_rig::telemetry::monitor::{ProjectorHealth, RunMonitor};
use dpm_rig::trackers::CameraView;
use dpm_scene::geometry::projector::ProjectorCamera;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// What is looked for.
#[derive(Clone)]
pub struct ViewTask {
    /// The clock on which pictures are stamped.
    pub clock: Arc<dyn HostClock>,
    /// The printed board, if it may be in view.
    pub board: Option<TagBoard>,
    /// From the instant at which a picture is told to the projector until it counts for the camera.
    pub settle: Duration,
}

/// A camera that is silent, or a projector that is dark, for so long has failed.
const SILENCE: Duration = Duration::from_secs(10);
/// By how much the light of a picture may differ from that of the one before: grey levels, and a share.
const STEADY_LEVELS: f64 = 0.3;
const STEADY_SHARE: f64 = 0.01;
/// How long a picture is waited for.
const PATIENCE: Duration = Duration::from_millis(200);

/// Shows one picture of the code, until it is told another one.
struct ViewSource {
    code: ViewCode,
    raster: Raster,
    picture: AtomicU64,
}

impl PatternSource for ViewSource {
    fn picture(&self, _: u64, _: u64) -> u64 {
        self.picture.load(Ordering::Relaxed)
    }

    fn draw(&self, picture: u64, canvas: &mut Canvas<'_>) {
        let width = self.raster.width();
        canvas.codes(|codes| {
            for (i, code) in (0..).zip(codes) {
                *code = if self.code.lit(picture as usize, i % width, i / width) { 0x00ff_ffff } else { 0 };
            }
        });
    }
}

/// Shows the code, takes a picture of each of its pictures, and solves. `eye`: the camera's lens and place in the world.
///
/// # Errors
/// Camera or projector fail (exit code 3), or what was seen makes no projector (2).
pub fn calibrate(
    config: &RigConfig,
    (view, eye): (&mut CameraView, &ProjectorCamera),
    task: &ViewTask,
    monitor: &Arc<RunMonitor>,
    tell: &mut dyn FnMut(&str),
) -> Result<ViewFit, Failure> {
    let raster = config.projector.raster();
    let code = ViewCode::new(raster);
    let source = Arc::new(ViewSource { code, raster, picture: AtomicU64::new(0) });
    let shown = Arc::clone(&source);
    let run = || run_pattern(config, shown, monitor);
    let seconds = (code.pictures() as f64 * task.settle.as_secs_f64() * 1.2).ceil();
    tell(&format!(
        "{} pictures, about {seconds:.0} s: let camera, projector and all in view rest.",
        code.pictures()
    ));
    let (seen, _) = while_shown(monitor, run, || take(&source, view, task, monitor))?;
    let mut bodies = view.markings.clone();
    bodies.extend(task.board.as_ref().map(board_markings));
    let bad = |e: dpm_calibration::view::ViewRefusal| Failure::new(FailureKind::BadInput, e);
    solve(raster, &coded_view(eye, &bodies, &code, &seen).map_err(bad)?).map_err(bad)
}

fn take(
    source: &ViewSource,
    view: &mut CameraView,
    task: &ViewTask,
    monitor: &RunMonitor,
) -> Result<Vec<Vec<u8>>, Failure> {
    let begin = Instant::now();
    while monitor.projector() != ProjectorHealth::Up {
        if monitor.stop_requested() || begin.elapsed() > SILENCE {
            return Err(Failure::new(FailureKind::Device, "the projector does not light"));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    let mut seen = Vec::new();
    for n in 0..source.code.pictures() {
        source.picture.store(n as u64, Ordering::Relaxed);
        seen.push(picture_after(view, task, monitor)?);
    }
    Ok(seen)
}

/// Whether the same light fell in two pictures: a frame that came late leaves a gap in it.
fn is_steady(a: &[u8], b: &[u8]) -> bool {
    let light = |p: &[u8]| p.iter().map(|v| f64::from(*v)).sum::<f64>() / p.len().max(1) as f64;
    (light(a) - light(b)).abs() < STEADY_LEVELS + STEADY_SHARE * light(a)
}

/// The first picture whose exposure began so long after now, and in which as much light fell as in the one before.
fn picture_after(view: &mut CameraView, task: &ViewTask, monitor: &RunMonitor) -> Result<Vec<u8>, Failure> {
    let told = Instant::now();
    let from = task.clock.now().plus_ns(task.settle.as_nanos() as i64);
    let (w, h) = (view.raster.width() as usize, view.raster.height() as usize);
    let mut picture = Picture::default();
    let mut before: Option<Vec<u8>> = None;
    loop {
        if monitor.stop_requested() {
            return Err(Failure::new(
                FailureKind::Device,
                "the measurement was interrupted; run the same command again",
            ));
        }
        let came = view.source.next(PATIENCE, &mut picture);
        if told.elapsed() > SILENCE {
            let why = came.err().unwrap_or_else(|| format!("{} sends no pictures", view.source.name()));
            return Err(Failure::new(FailureKind::Device, why));
        }
        match came {
            Ok(true) if (picture.width, picture.height) != (w, h) => {
                let told =
                    format!("pictures have {} x {} pixels: set tracker.size", picture.width, picture.height);
                return Err(Failure::new(FailureKind::BadInput, told));
            }
            Ok(true) if picture.begin >= from => {
                let pixels = std::mem::take(&mut picture.pixels);
                if before.is_some_and(|b| is_steady(&b, &pixels)) {
                    return Ok(pixels);
                }
                before = Some(pixels);
            }
            Ok(_) => {}
            Err(_) => std::thread::sleep(PATIENCE),
        }
    }
}

/// The clock on which pictures are stamped.
pub fn clock() -> Arc<dyn HostClock> {
    let ticking = MonotonicClock::new(0).sleeping();
    Arc::new(move || ticking.now())
}

/// What the operator is told of a projector.
pub fn told_of(fit: &ViewFit) -> String {
    let (p, m, [used, all]) = (&fit.predicted, &fit.model, fit.rays);
    let at = m.position();
    format!(
        "predicted error {:.2} px (what is to be expected of the 99th percentile over the raster, and no bound);\n\
         focal lengths {:.1} and {:.1} px, at ({:.3}, {:.3}, {:.3}) m; residual {:.3} px rms of {used} of {all} rays",
        p.p99_px, m.focal.x, m.focal.y, at.x, at.y, at.z, fit.rms_px
    )
}

/// Puts a projector into the results.
pub fn keep(results: &mut Results, config: &RigConfig, fit: &ViewFit) {
    let data = format!("{} rays of a camera", fit.rays[0]);
    let provenance = results.provenance(config, "", data, "coded light before a camera, by least squares");
    let section = ProjectorSection::new(
        config.projector.raster(),
        &fit.model,
        fit.predicted.p99_px,
        fit.rms_px,
        provenance,
    );
    results.file.projector = Some(section.assuming(&fit.predicted, 0.0));
}
