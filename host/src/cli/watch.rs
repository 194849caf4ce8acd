//! A running pipeline into a progress bar on a terminal, or one JSON line a second on anything else.

use super::keys::Keys;
use super::signals;
use crate::config::{OutputConfig, ProjectorBackend, RigConfig};
use crate::control::{runtime_folder, ControlSocket};
use crate::experiments::run_rig::{cannot_write, check_output_folder};
use crate::failure::{Ended, Failure, FailureKind};
use crate::files::{write_atomically, InstanceLock, LockError};
use crate::telemetry::monitor::{ProjectorHealth, RunCounts, RunMonitor};
use crate::telemetry::report::{to_json, Report};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::{IsTerminal, Write};
use std::path::Path;
use std::sync::mpsc::{channel, RecvTimeoutError};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// How often signals are looked at and the bar is drawn.
const TICK: Duration = Duration::from_millis(50);

/// Watches `run` (see [`watch`]), then prints the report to the standard output, as JSON or as a table.
///
/// # Errors
/// As [`watch`].
pub fn run_and_report(
    rig: RigConfig,
    json: bool,
    run: impl FnOnce(&RigConfig, &Arc<RunMonitor>) -> Result<Ended<Report>, Failure> + Send + 'static,
) -> Result<(), Failure> {
    let Ended { report, failure } = watch(rig, |_| {}, run)?;
    print(&if json { report.to_json() + "\n" } else { report.to_table() });
    failure.map_or(Ok(()), Err)
}

/// Writes the report of a command that makes no others as `name` into the folder that `--out` names, where it does.
///
/// # Errors
/// The folder or the file cannot be written.
pub(super) fn write_out<T: serde::Serialize>(
    out: Option<&Path>,
    name: &str,
    report: &T,
) -> Result<(), Failure> {
    let Some(folder) = out else { return Ok(()) };
    let path = folder.join(name);
    let text = to_json(report) + "\n";
    write_atomically(&path, |file| file.write_all(text.as_bytes())).map_err(|e| cannot_write(&path, &e))
}

/// Sees that files can be written into the folder that `--out` names, before the work.
///
/// # Errors
/// They cannot.
pub(super) fn check_out(out: Option<&Path>) -> Result<(), Failure> {
    out.map_or(Ok(()), check_output_folder)
}

/// Runs `run` while its progress is shown on the standard error stream, given to `show`, and signals become an ordered stop. The
/// run itself has a thread of its own, so that this one stays free to watch.
///
/// # Errors
/// What `run` returns; a device or output folder that another instance uses; a panic in the run.
pub fn watch<T: Send + 'static>(
    rig: RigConfig,
    show: impl Fn(&RunCounts),
    run: impl FnOnce(&RigConfig, &Arc<RunMonitor>) -> Result<T, Failure> + Send + 'static,
) -> Result<T, Failure> {
    let _locks = take_locks(&rig)?;
    signals::install()
        .map_err(|e| Failure::new(FailureKind::Device, format!("cannot handle signals: {e}")))?;
    let monitor = Arc::new(RunMonitor::default());
    let (done, finished) = channel();
    let (frames, seconds) = (rig.run.frames, rig.run.seconds);
    let worker = {
        let monitor = Arc::clone(&monitor);
        std::thread::Builder::new()
            .name("dpm-run".into())
            .spawn(move || {
                let result = run(&rig, &monitor);
                // The watcher is gone only when it panicked; then nobody wants the result.
                let _ = done.send(result);
            })
            .map_err(|e| Failure::new(FailureKind::Device, format!("cannot start a thread: {e}")))?
    };
    let mut progress = Progress::new(frames, seconds);
    let mut health = ProjectorHealth::Connecting;
    let mut tracker_told = false;
    let mut keys = Keys::new();
    let keys_told = if keys.is_some() { "; keys b, f, s, a" } else { "" };
    let control = ControlSocket::serve(&runtime_folder(), Arc::clone(&monitor));
    match &control {
        Ok(socket) => progress.note(&format!(
            "control: dpm black | freeze | safe | arm --pid {}{keys_told}; socket {}",
            std::process::id(),
            socket.path().display()
        )),
        Err(e) => {
            progress.note(&format!("no control socket in {}: {e}{keys_told}", runtime_folder().display()))
        }
    }
    let result = loop {
        match finished.recv_timeout(TICK) {
            Ok(result) => break result,
            Err(RecvTimeoutError::Timeout) => {
                if let Some(signal) = signals::received() {
                    if !monitor.stop_requested() {
                        progress.note(&format!("{signal}: stopping"));
                        monitor.request_stop();
                    }
                }
                for order in keys.iter_mut().flat_map(Keys::pressed) {
                    progress.note(&format!("key: {}", order.word()));
                    monitor.give_order(order);
                }
                let now = monitor.projector();
                if std::mem::replace(&mut health, now) != now {
                    progress.note(&format!("projector: {now}"));
                }
                monitor.take_notes().iter().for_each(|note| progress.note(note));
                if let (false, Some(word)) = (tracker_told, monitor.tracker()) {
                    tracker_told = true;
                    progress.note(word);
                }
                progress.tick(monitor.counts());
                show(&monitor.counts());
            }
            Err(RecvTimeoutError::Disconnected) => {
                break Err(Failure::new(FailureKind::Device, "the run ended by a panic (see above)"))
            }
        }
    };
    monitor.take_notes().iter().for_each(|note| progress.note(note));
    // A panic was already turned into the error above.
    let _ = worker.join();
    progress.finish(monitor.counts());
    result
}

/// Writes to the standard output; a reader that has gone away (`dpm ... | head`) is no error.
pub fn print(text: &str) {
    let mut out = std::io::stdout().lock();
    let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
}

/// One lock for the projector and one for the folder that is written to.
///
/// # Errors
/// Another instance has one of them.
pub(super) fn take_locks(rig: &RigConfig) -> Result<Vec<InstanceLock>, Failure> {
    let or = |advice: &'static str| {
        move |e: LockError| match e {
            LockError::Held { .. } => Failure::new(FailureKind::Device, e),
            LockError::Io { .. } => Failure::new(FailureKind::BadInput, format!("{e}; {advice}")),
        }
    };
    let mut locks = Vec::new();
    let serial = |s: &Option<String>| s.clone().unwrap_or_else(|| "any".into());
    let device = match &rig.projector.backend {
        ProjectorBackend::Mock(_) => None,
        ProjectorBackend::Usb(usb) => Some(format!(
            "USB projector {:04x}:{:04x} {}",
            usb.vendor_id,
            usb.product_id,
            serial(&usb.serial_number)
        )),
        ProjectorBackend::Serial(port) => Some(format!("projector on {}", port.port)),
        ProjectorBackend::Dlpc900(dlpc) => Some(format!("DLPC900 {}", serial(&dlpc.device))),
    };
    if let Some(what) = device {
        let name: String = what.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
        let path = runtime_folder().join(format!("{name}.lock"));
        locks.push(InstanceLock::take(&path, &what).map_err(or("name another folder by DPM_RUNTIME_DIR"))?);
    }
    let OutputConfig { dir, images, trace, .. } = &rig.output;
    if *images || *trace {
        let what = format!("output folder {}", dir.display());
        locks.push(
            InstanceLock::take(&dir.join(".dpm.lock"), &what)
                .map_err(or("choose another folder with --out"))?,
        );
    }
    Ok(locks)
}

enum Progress {
    Bar(ProgressBar),
    /// Towards an end in time: the bar's unit is a millisecond since the first frame was planned.
    Timed {
        bar: ProgressBar,
        began: Option<Instant>,
    },
    Lines {
        started: Instant,
        next: Duration,
        total: u64,
        seconds: f64,
    },
}

impl Progress {
    /// Towards `total` frames, or else `seconds` of time; 0 is no end.
    fn new(total: u64, seconds: f64) -> Self {
        if !std::io::stderr().is_terminal() {
            return Self::Lines { started: Instant::now(), next: Duration::from_secs(1), total, seconds };
        }
        let timed = total == 0 && seconds > 0.0;
        let bar = match total {
            0 if timed => ProgressBar::new((seconds * 1e3) as u64),
            0 => ProgressBar::no_length(),
            _ => ProgressBar::new(total),
        };
        bar.set_draw_target(ProgressDrawTarget::stderr());
        let template = match total {
            0 if timed => "{bar:40} {elapsed}, {msg}",
            0 => "{spinner} {pos} frames lit, {per_sec}, {msg}",
            _ => "{bar:40} {pos}/{len} frames lit, {per_sec}, {eta} left, {msg}",
        };
        bar.set_style(ProgressStyle::with_template(template).expect("the template is a constant"));
        if timed {
            Self::Timed { bar, began: None }
        } else {
            Self::Bar(bar)
        }
    }

    fn note(&self, text: &str) {
        match self {
            Self::Bar(bar) | Self::Timed { bar, .. } => bar.println(text),
            Self::Lines { .. } => {
                let _ = writeln!(std::io::stderr(), "{}", serde_json::json!({ "note": text }));
            }
        }
    }

    fn tick(&mut self, counts: RunCounts) {
        match self {
            Self::Bar(bar) => {
                bar.set_position(counts.frames_lit);
                bar.set_message(format!("{} dropped, {} late", counts.frames_dropped, counts.frames_late));
                bar.tick();
            }
            Self::Timed { bar, began } => {
                if counts.frames_planned > 0 {
                    let began = began.get_or_insert_with(Instant::now);
                    bar.set_position(began.elapsed().as_millis() as u64);
                }
                let RunCounts { frames_lit, frames_dropped, frames_late, .. } = counts;
                bar.set_message(format!(
                    "{frames_lit} frames lit, {frames_dropped} dropped, {frames_late} late"
                ));
                bar.tick();
            }
            Self::Lines { started, next, total, seconds } => {
                let elapsed = started.elapsed();
                if elapsed >= *next {
                    // After a pause of this thread the next line comes a second later, not a burst of lines at once.
                    *next = elapsed + Duration::from_secs(1);
                    let line = serde_json::json!({
                        "elapsed_s": (elapsed.as_secs_f64() * 1e3).round() / 1e3,
                        "frames_total": total,
                        "seconds_total": seconds,
                        "frames_lit": counts.frames_lit,
                        "frames_dropped": counts.frames_dropped,
                        "frames_late": counts.frames_late,
                    });
                    let _ = writeln!(std::io::stderr(), "{line}");
                }
            }
        }
    }

    fn finish(mut self, counts: RunCounts) {
        self.tick(counts);
        if let Self::Bar(bar) | Self::Timed { bar, .. } = self {
            bar.finish_and_clear();
        }
    }
}
