//! Shows a running pipeline as a progress bar on a terminal, or as one JSON line per second elsewhere; and connects
//! everything that can stop or darken it from outside: signals, keys, the control socket, orders that stand from
//! before.
//!
//! The watching thread itself writes nothing. A pipe without a reader or a stopped terminal blocks only the thread
//! that writes.

use super::guard::Guard;
use super::keys::Keys;
use super::live_page;
use super::osc;
use super::tell::{Teller, SHOWN_EVERY};
use crate::notify::Notifier;
use crossbeam::channel::{unbounded, Receiver, RecvTimeoutError};
use dpm_common::files::{check_folder, folder_of, write_atomically, InstanceLock, LockError};
use dpm_common::folder::{Folder, FolderError};
use dpm_common::signals;
use dpm_common::stopping;
use dpm_rig::config::{OutputConfig, RigConfig};
use dpm_rig::control::orders::Orders;
use dpm_rig::control::server::ControlSocket;
use dpm_rig::control::status_file::StatusFile;
use dpm_rig::control::{rig_name, runtime_folder};
use dpm_rig::failure::{Ended, Failure, FailureKind};
use dpm_rig::interlock::Interlock;
use dpm_rig::order::Order;
use dpm_rig::pipeline::leave_behind;
use dpm_rig::run_rig::{cannot_write, check_output_folder, stopped_before_light};
use dpm_rig::standing::{By, Identity, OrderFile, Stands};
use dpm_rig::telemetry::monitor::{ProjectorHealth, RunMonitor};
use dpm_rig::telemetry::report::{to_json, Report};
use std::io::Write;
use std::path::Path;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// How often to check keys, signals and the projector's state.
const TICK: Duration = Duration::from_millis(5);
/// Progress is shown once per this many ticks.
const TICKS_SHOWN: u32 = (SHOWN_EVERY.as_millis() / TICK.as_millis()) as u32;

/// If the run itself will not return, how long the link has to make the projector dark.
const DARK_WITHIN: Duration = Duration::from_millis(500);

/// Watches `run` (see [`watch`]), then prints the report to the standard output, as JSON or as a table.
///
/// # Errors
/// As for [`watch`]; or, after its report, a run that lit nothing.
pub(crate) fn run_and_report(
    rig: RigConfig,
    json: bool,
    run: impl FnOnce(&RigConfig, &Arc<RunMonitor>) -> Result<Ended<Report>, Failure> + Send + 'static,
) -> Result<(), Failure> {
    let stopped = |rig: &RigConfig| Ok(stopped_before_light(rig));
    let Ended { report, failure } = watch_with(rig, Keys::new(), false, stopped, run)?;
    print(&if json { report.to_json() + "\n" } else { report.to_table() });
    failure.map_or(Ok(()), Err)?;
    report.check_lit()
}

/// If `--out` names a folder, writes the report of a command without other files there, as `name`.
///
/// # Errors
/// The folder or the file cannot be written.
pub(super) fn write_out<T: serde::Serialize>(
    out: Option<&Path>,
    name: &str,
    report: &T,
) -> Result<(), Failure> {
    out.map_or(Ok(()), |folder| write_json(&folder.join(name), report))
}

/// Writes a report as JSON to `path`.
///
/// # Errors
/// The file cannot be written.
pub(super) fn write_json<T: serde::Serialize>(path: &Path, report: &T) -> Result<(), Failure> {
    write_text(path, &(to_json(report) + "\n"))
}

/// Writes `text` to `path`.
///
/// # Errors
/// The file cannot be written.
pub(super) fn write_text(path: &Path, text: &str) -> Result<(), Failure> {
    write_atomically(path, |file| file.write_all(text.as_bytes())).map_err(|e| cannot_write(path, &e))
}

/// Checks, before any work is done, that the file that `flag` names can be written.
///
/// # Errors
/// It cannot.
pub(super) fn check_file(path: &Path, flag: &str) -> Result<(), Failure> {
    let bad = |told: String| Err(Failure::new(FailureKind::BadInput, told));
    if path.is_dir() || path.file_name().is_none() {
        return bad(format!("{}: is a folder; name a file in it with {flag}", path.display()));
    }
    check_folder(folder_of(path)).or_else(|e| bad(format!("{e}; choose another file with {flag}")))
}

/// Checks, before any work is done, that files can be written into the folder that `--out` names.
///
/// # Errors
/// They cannot.
pub(super) fn check_out(out: Option<&Path>) -> Result<(), Failure> {
    out.map_or(Ok(()), check_output_folder)
}

/// Runs `run` on a thread of its own. Meanwhile this thread shows its progress on the standard error stream, and
/// turns signals into an orderly stop.
///
/// # Errors
/// The error of `run`; a device or output folder that another instance uses; a panic in the run.
pub(super) fn watch<T: Send + 'static>(
    rig: RigConfig,
    run: impl FnOnce(&RigConfig, &Arc<RunMonitor>) -> Result<T, Failure> + Send + 'static,
) -> Result<T, Failure> {
    watch_with(rig, Keys::new(), false, not_begun, run)
}

/// The same for a run that talks to the operator itself: keys are not read, and no progress is shown.
///
/// # Errors
/// As [`watch`].
pub(super) fn watch_quietly<T: Send + 'static>(
    rig: RigConfig,
    run: impl FnOnce(&RigConfig, &Arc<RunMonitor>) -> Result<T, Failure> + Send + 'static,
) -> Result<T, Failure> {
    watch_with(rig, None, true, not_begun, run)
}

/// The end of a run without a report of its own that was stopped while it set up.
fn not_begun<T>(_: &RigConfig) -> Result<T, Failure> {
    Err(Failure::new(FailureKind::Device, "stopped before anything was lit"))
}

/// How a run ends that had results.
const PANICKED: &str = "the run was stopped by a panic in one of its threads (see above)";

/// The thread of a run, and what it sends when it ends.
type Worker<T> = (JoinHandle<()>, Receiver<Result<T, Failure>>);

/// Starts the run on a thread of its own, which sends its result when it ends.
fn start_worker<T: Send + 'static>(
    rig: RigConfig,
    monitor: Arc<RunMonitor>,
    run: impl FnOnce(&RigConfig, &Arc<RunMonitor>) -> Result<T, Failure> + Send + 'static,
) -> Result<Worker<T>, Failure> {
    let (done, finished) = unbounded();
    let work = move || {
        // Only the instance that has the projector's lock starts it. A panic ends without a message to the guard, like
        // a SIGKILL.
        let guard = rig.projector.backend.guardian().map(|words| Guard::start(&words));
        let result = run(&rig, &monitor);
        if let Some(guard) = guard {
            guard.dismiss();
        }
        // The watcher is gone only if it panicked; then the result is not needed.
        let _ = done.send(result);
    };
    let worker = std::thread::Builder::new().name("dpm-run".into()).spawn(work);
    let worker =
        worker.map_err(|e| Failure::new(FailureKind::Device, format!("cannot start a thread: {e}")))?;
    Ok((worker, finished))
}

/// `stopped`: the result of a run that is abandoned because a signal came while it set up.
fn watch_with<T: Send + 'static>(
    rig: RigConfig,
    keys: Option<Keys>,
    is_quiet: bool,
    stopped: impl FnOnce(&RigConfig) -> Result<T, Failure>,
    run: impl FnOnce(&RigConfig, &Arc<RunMonitor>) -> Result<T, Failure> + Send + 'static,
) -> Result<T, Failure> {
    let locks = take_locks(&rig)?;
    signals::install()
        .map_err(|e| Failure::new(FailureKind::Device, format!("cannot handle signals: {e}")))?;
    let monitor = Arc::new(RunMonitor::default());
    // Before anything can make light.
    if let Some(interlock) = Interlock::of_config(&rig.safety.interlock, keys.is_some())? {
        monitor.set_interlock(interlock);
    }
    let mut teller = Teller::start(rig.run.frames, rig.run.seconds, rig.output.log_every(), is_quiet)?;
    // Before the run begins, so that it comes up dark if an order stands.
    let orders = Arc::new(stand_by(&rig, &monitor, &teller)?);
    let shown = rig.clone();
    let (worker, finished) = start_worker(rig, Arc::clone(&monitor), run)?;
    if let Some(interlock) = monitor.interlock() {
        let now = if interlock.is_closed() { "closed" } else { "open" };
        teller.note(&format!("safety.interlock: light only while {}; it is {now}", interlock.what()));
    }
    let (control, status) = open_control(&locks.runtime, &monitor, &orders, &mut teller, keys.is_some());
    let page = live_page::open(&shown, &monitor, &orders, &teller);
    let osc = osc::open(&shown, &monitor, &orders, &teller);
    let mut watcher = Watcher {
        monitor: &monitor,
        orders: &orders,
        teller,
        keys,
        status,
        health: ProjectorHealth::Connecting,
        tracker_told: false,
        signal_told: false,
        notifier: Notifier::from_environment(),
    };
    let result = match watcher.until_finished(&finished)? {
        Some(result) => {
            // A panic was already turned into the error above.
            let _ = worker.join();
            result
        }
        None => {
            // A driver that compiles shaders hears nothing, and holds nothing that must be given back.
            leave_behind();
            stopped(&shown)
        }
    };
    let result = match stopping::has_panicked() {
        true => result.and(Err(Failure::new(FailureKind::Device, PANICKED))),
        false => result,
    };
    let Watcher { mut teller, mut status, .. } = watcher;
    if let Some(status) = &mut status {
        // A client that waits for a dark that came with the end sees it.
        status.say(monitor.projector(), orders.kept());
    }
    drop((control, page, osc));
    if let Some(orders) = Arc::into_inner(orders) {
        orders.end(result.is_ok());
    }
    monitor.take_notes().iter().for_each(|note| teller.note(note));
    teller.finish(monitor.light(), monitor.counts());
    result
}

/// Opens the control socket and the status file, and says how the rig can be ordered. Without them the run goes on.
fn open_control(
    runtime: &Result<Arc<Folder>, FolderError>,
    monitor: &Arc<RunMonitor>,
    orders: &Arc<Orders>,
    teller: &mut Teller,
    has_keys: bool,
) -> (Option<ControlSocket>, Option<StatusFile>) {
    let keys = if has_keys { "; keys b, f, s, a" } else { "" };
    match listen(runtime, monitor, orders) {
        Ok((socket, status)) => {
            teller.note(&format!(
                "control: dpm black | freeze | safe | arm --pid {}{keys}; socket {}",
                std::process::id(),
                socket.path().display()
            ));
            (Some(socket), Some(status))
        }
        Err(e) => {
            teller.note(&format!("no control socket: {e}{keys}; signals USR1 (black) and USR2 (safe)"));
            (None, None)
        }
    }
}

/// The thread that watches a run.
struct Watcher<'a> {
    monitor: &'a RunMonitor,
    orders: &'a Orders,
    teller: Teller,
    keys: Option<Keys>,
    status: Option<StatusFile>,
    /// What the operator was last told of the projector.
    health: ProjectorHealth,
    tracker_told: bool,
    signal_told: bool,
    notifier: Notifier,
}

impl Watcher<'_> {
    /// Watches until the run returns its result. `None` if it was stopped while it set up: it is left behind.
    ///
    /// # Errors
    /// The run will never return: a thread of it hangs.
    fn until_finished<T>(
        &mut self,
        finished: &Receiver<Result<T, Failure>>,
    ) -> Result<Option<Result<T, Failure>>, Failure> {
        let mut ticks = 0u32;
        loop {
            match finished.recv_timeout(TICK) {
                Ok(result) => return Ok(Some(result)),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => {
                    let told = "the run ended by a panic (see above)";
                    return Ok(Some(Err(Failure::new(FailureKind::Device, told))));
                }
            }
            self.follow_orders();
            if self.signal_told && self.monitor.sets_up() {
                return Ok(None);
            }
            self.monitor.take_notes().iter().for_each(|note| self.teller.note(note));
            if let Some(why) = self.monitor.gave_up() {
                // The projector has been told to go dark by a thread that does not hang.
                std::thread::sleep(DARK_WITHIN);
                self.teller.finish(self.monitor.light(), self.monitor.counts());
                return Err(Failure::new(FailureKind::Device, why));
            }
            self.tell_changes();
            self.notify();
            ticks = ticks.wrapping_add(1);
            if ticks.is_multiple_of(TICKS_SHOWN) {
                self.teller.tick(self.monitor.light(), self.monitor.counts());
            }
        }
    }

    /// Keys and signals. They come before everything that is only told.
    fn follow_orders(&mut self) {
        for key in self.keys.iter_mut().flat_map(Keys::pressed) {
            if self.monitor.interlock().is_some_and(|i| i.key_pressed(key)) {
                continue;
            }
            if let Some(order) = Order::from_key(key) {
                self.orders.give(order, By::Key);
                self.teller.note(&format!("key: {}", order.word()));
            }
        }
        if let Some(signal) = signals::received().filter(|_| !self.signal_told) {
            self.signal_told = true;
            self.monitor.request_stop();
            self.notifier.stopping();
            self.teller.note(&format!("{signal}: stopping"));
        }
    }

    /// What systemd wants to know.
    fn notify(&mut self) {
        let now = Instant::now();
        // From then on the rig answers to orders and makes frames, whether or not light is permitted.
        if !matches!(self.health, ProjectorHealth::Connecting) {
            self.notifier.ready();
        }
        self.notifier.alive(now);
        let monitor = self.monitor;
        self.notifier.status(now, || status_line(monitor));
    }

    /// What is new of the projector and the tracker.
    fn tell_changes(&mut self) {
        let now = self.monitor.projector();
        if let Some(status) = &mut self.status {
            status.say(now, self.orders.kept());
        }
        if std::mem::replace(&mut self.health, now) != now {
            self.teller.note(&format!("projector: {now}"));
        }
        if let (false, Some(word)) = (self.tracker_told, self.monitor.tracker()) {
            self.tracker_told = true;
            self.teller.note(word);
        }
    }
}

/// What systemd shows: the word for the light, the reason, and counts.
fn status_line(monitor: &RunMonitor) -> String {
    let (c, why) = (monitor.counts(), monitor.light_told());
    let why = if why.is_empty() { why } else { format!(" ({why})") };
    let word = monitor.light().word();
    format!("{word}{why}; {} frames lit, {} of {} slots missed", c.frames_lit, c.slots_missed, c.slots)
}

/// Reads what stands for the rig's projector, gives it to the run that is about to begin, and starts the thread that keeps orders.
///
/// # Errors
/// The projector is real and the state folder cannot be used, so an order could not be kept (exit code 2).
fn stand_by(rig: &RigConfig, monitor: &Arc<RunMonitor>, teller: &Teller) -> Result<Orders, Failure> {
    let identity = Identity::of(&rig.projector.backend);
    let (file, error, kept) = OrderFile::on_this_machine(identity.clone());
    if let Some(e) = &error {
        let told = format!(
            "SAFE could not be kept over a restart: {e}; make room there, or name another state folder by DPM_STATE_DIR"
        );
        if !identity.is_mock() {
            return Err(Failure::new(FailureKind::BadInput, told));
        }
        teller.note(&format!("warning: {told}"));
    }
    let stands = Stands::begin(kept, rig.safety.start, monitor);
    if let Some(stands) = &stands {
        teller.note(&told_of(stands));
    }
    Orders::start(Arc::clone(monitor), file, error.is_none(), stands.as_ref())
        .map_err(|e| Failure::new(FailureKind::Device, format!("cannot start a thread: {e}")))
}

/// The message to the operator about an order that stands.
fn told_of(stands: &Stands) -> String {
    let word = if stands.order == Order::Safe { "SAFE" } else { "BLACK" };
    let pid = std::process::id();
    format!("projector: {word} stands {}; it stays dark until `dpm arm --pid {pid}` (or key a)", stands.told)
}

/// Creates the control socket and the state file in the runtime folder.
fn listen(
    runtime: &Result<Arc<Folder>, FolderError>,
    monitor: &Arc<RunMonitor>,
    orders: &Arc<Orders>,
) -> Result<(ControlSocket, StatusFile), String> {
    let folder = runtime.as_ref().map_err(ToString::to_string)?;
    let status = StatusFile::create(folder.clone(), rig_name()).map_err(|e| e.to_string())?;
    let socket = ControlSocket::serve(folder.clone(), Arc::clone(monitor), Arc::clone(orders));
    Ok((socket.map_err(|e| e.to_string())?, status))
}

/// Writes to the standard output. It is no error if the reader has gone away (`dpm ... | head`).
pub(super) fn print(text: &str) {
    let mut out = std::io::stdout().lock();
    let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
}

/// The locks that a run holds.
pub(super) struct Locks {
    _held: Vec<InstanceLock>,
    /// The runtime folder, or why it is not used.
    runtime: Result<Arc<Folder>, FolderError>,
}

/// Takes one lock for the projector and one for the output folder.
///
/// # Errors
/// Another instance holds one of them; or the projector is real and the runtime folder cannot be trusted.
pub(super) fn take_locks(rig: &RigConfig) -> Result<Locks, Failure> {
    let or = |advice: &'static str| {
        move |e: LockError| match e {
            LockError::Held { .. } => Failure::new(FailureKind::Device, e),
            LockError::Io { .. } => Failure::new(FailureKind::BadInput, format!("{e}; {advice}")),
        }
    };
    let advice = "name another folder by DPM_RUNTIME_DIR";
    let mut held = Vec::new();
    let runtime = runtime_folder().map(Arc::new);
    let identity = Identity::of(&rig.projector.backend);
    if !identity.is_mock() {
        let folder = runtime.as_ref().map_err(|e| {
            Failure::new(
                FailureKind::BadInput,
                format!("cannot lock {identity}: the runtime folder {e}; {advice}"),
            )
        })?;
        let name = identity.lock_name();
        held.push(InstanceLock::take_in(folder, &name, identity.what()).map_err(or(advice))?);
        if identity.is_one_device() {
            held.push(InstanceLock::take_on_machine(&name, identity.what()).map_err(or(advice))?);
        }
    }
    let OutputConfig { dir, images, trace, .. } = &rig.output;
    if *images || *trace {
        let what = format!("output folder {}", dir.display());
        held.push(
            InstanceLock::take(&dir.join(".dpm.lock"), &what)
                .map_err(or("choose another folder with --out"))?,
        );
    }
    Ok(Locks { _held: held, runtime })
}
