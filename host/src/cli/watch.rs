//! A running pipeline into a progress bar on a terminal, or one JSON line a second on anything else.

use super::keys::Keys;
use super::signals;
use crate::config::{OutputConfig, ProjectorBackend, RigConfig};
use crate::control::{runtime_folder, ControlSocket};
use crate::experiments::run_rig::{cannot_write, check_output_folder};
use crate::failure::{Ended, Failure, FailureKind};
use crate::files::{write_atomically, InstanceLock, LockError};
use crate::interlock::Interlock;
use crate::telemetry::monitor::{Order, ProjectorHealth, RunCounts, RunMonitor};
use crate::telemetry::report::{to_json, Report};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::collections::VecDeque;
use std::io::{IsTerminal, Write};
use std::path::Path;
use std::sync::mpsc::{channel, RecvTimeoutError};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// How often signals are looked at and the bar is drawn.
const TICK: Duration = Duration::from_millis(5);

/// How long the link is given to make the projector dark when the run itself will not return.
const DARK_WITHIN: Duration = Duration::from_millis(500);

/// Watches `run` (see [`watch`]), then prints the report to the standard output, as JSON or as a table.
///
/// # Errors
/// As [`watch`]; a run that lit nothing, after its report.
pub fn run_and_report(
    rig: RigConfig,
    json: bool,
    run: impl FnOnce(&RigConfig, &Arc<RunMonitor>) -> Result<Ended<Report>, Failure> + Send + 'static,
) -> Result<(), Failure> {
    let Ended { report, failure } = watch(rig, |_| {}, run)?;
    print(&if json { report.to_json() + "\n" } else { report.to_table() });
    failure.map_or(Ok(()), Err)?;
    report.check_lit()
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
    let mut keys = Keys::new();
    // Before anything can make light.
    if let Some(interlock) = Interlock::of_config(&rig.safety.interlock, keys.is_some())? {
        monitor.set_interlock(interlock);
    }
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
    if let Some(interlock) = monitor.interlock() {
        let now = if interlock.is_closed() { "closed" } else { "open" };
        progress.note(&format!("safety.interlock: light only while {}; it is {now}", interlock.what()));
    }
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
                for key in keys.iter_mut().flat_map(Keys::pressed) {
                    if monitor.interlock().is_some_and(|i| i.key_pressed(key)) {
                        continue;
                    }
                    if let Some(order) = Order::from_key(key) {
                        progress.note(&format!("key: {}", order.word()));
                        monitor.give_order(order);
                    }
                }
                for note in monitor.take_notes() {
                    progress.note(&note);
                }
                if let Some(why) = monitor.gave_up() {
                    // The projector has been told to go dark by a thread that does not hang.
                    std::thread::sleep(DARK_WITHIN);
                    progress.finish(monitor.projector(), monitor.counts());
                    return Err(Failure::new(FailureKind::Device, why));
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
                progress.tick(now, monitor.counts());
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
    monitor.take_notes().iter().for_each(|note| progress.note(note));
    progress.finish(monitor.projector(), monitor.counts());
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

/// Frames a second over the last seconds.
struct Rate {
    /// The oldest is the one from which is counted.
    seen: VecDeque<(Duration, u64)>,
}

/// Time over which the rate is taken.
const RATE_OVER: Duration = Duration::from_secs(2);
/// Most readings of it: one a [`TICK`], and one more.
const RATE_READINGS: usize = (RATE_OVER.as_millis() / TICK.as_millis()) as usize + 1;

impl Rate {
    /// Takes in how many there were at `elapsed`; returns how many a second.
    fn at(&mut self, elapsed: Duration, count: u64) -> f64 {
        while self.seen.len() >= RATE_READINGS || self.seen.len() > 1 && self.seen[1].0 + RATE_OVER <= elapsed
        {
            self.seen.pop_front();
        }
        self.seen.push_back((elapsed, count));
        let (since, before) = self.seen[0];
        let seconds = elapsed.saturating_sub(since).as_secs_f64();
        if seconds > 0.0 {
            count.saturating_sub(before) as f64 / seconds
        } else {
            0.0
        }
    }
}

/// The text of the bar: the projector's state first, then what the run does, at places that do not move.
fn told(health: ProjectorHealth, counts: &RunCounts, total: u64, rate: f64) -> String {
    let of = if total > 0 { format!("/{total}") } else { String::new() };
    let lit = format!("{}{of}", counts.frames_lit);
    let mut text = format!("{:<10} {lit:>9} lit {rate:>7.1}/s", health.word());
    // A picture that does not move has no rate that would mean anything, and no time that is left.
    if let ProjectorHealth::Up | ProjectorHealth::Connecting = health {
        let left = total.saturating_sub(counts.frames_done());
        if rate > 0.0 && left > 0 {
            text += &format!(" {:>6.0} s left", left as f64 / rate);
        }
    } else {
        text = format!("{:<10} {lit:>9} lit, no new picture", health.word());
    }
    text += &format!(", {} slots missed, {} frames dropped", counts.slots_missed, counts.frames_dropped);
    if counts.frames_dark > 0 {
        text += &format!(", {} DARK on every body", counts.frames_dark);
    }
    text
}

enum Shown {
    Bar(ProgressBar),
    Lines { next: Duration },
}

struct Progress {
    started: Instant,
    /// Frames that the run was asked for; 0 for no end, or one in time.
    total: u64,
    /// Seconds that the run was asked for; 0 for no end, or one in frames.
    seconds: f64,
    /// When the first frame was planned: an end in time counts from there.
    began: Option<Instant>,
    rate: Rate,
    shown: Shown,
}

impl Progress {
    /// Towards `total` frames, or else `seconds` of time; 0 is no end.
    fn new(total: u64, seconds: f64) -> Self {
        let timed = total == 0 && seconds > 0.0;
        let shown = if std::io::stderr().is_terminal() {
            let bar = match total {
                0 if timed => ProgressBar::new((seconds * 1e3) as u64),
                0 => ProgressBar::no_length(),
                _ => ProgressBar::new(total),
            };
            bar.set_draw_target(ProgressDrawTarget::stderr());
            let template = if total == 0 && !timed { "{wide_msg}" } else { "{bar:20} {wide_msg}" };
            bar.set_style(ProgressStyle::with_template(template).expect("the template is a constant"));
            Shown::Bar(bar)
        } else {
            Shown::Lines { next: Duration::from_secs(1) }
        };
        let rate = Rate { seen: VecDeque::new() };
        Self { started: Instant::now(), total, seconds, began: None, rate, shown }
    }

    /// How far the run is: frames, or milliseconds where its end is one in time.
    fn position(&mut self, counts: &RunCounts) -> u64 {
        if self.total == 0 && self.seconds > 0.0 {
            if counts.frames_planned > 0 {
                self.began.get_or_insert_with(Instant::now);
            }
            return self.began.map_or(0, |began| began.elapsed().as_millis() as u64);
        }
        counts.frames_done()
    }

    fn note(&self, text: &str) {
        match &self.shown {
            Shown::Bar(bar) => bar.println(text),
            Shown::Lines { .. } => {
                let _ = writeln!(std::io::stderr(), "{}", serde_json::json!({ "note": text }));
            }
        }
    }

    fn tick(&mut self, health: ProjectorHealth, counts: RunCounts) {
        let elapsed = self.started.elapsed();
        let rate = self.rate.at(elapsed, counts.frames_lit);
        let done = self.position(&counts);
        match &mut self.shown {
            Shown::Bar(bar) => {
                bar.set_position(done);
                bar.set_message(told(health, &counts, self.total, rate));
                bar.tick();
            }
            Shown::Lines { next } => {
                if elapsed >= *next {
                    // After a pause of this thread the next line comes a second later, not a burst of lines at once.
                    *next = elapsed + Duration::from_secs(1);
                    let line = serde_json::json!({
                        "elapsed_s": (elapsed.as_secs_f64() * 1e3).round() / 1e3,
                        "projector": health.word().to_lowercase(),
                        "frames_total": self.total,
                        "seconds_total": self.seconds,
                        "frames_lit": counts.frames_lit,
                        "frames_lit_per_s": (rate * 10.0).round() / 10.0,
                        "frames_dark": counts.frames_dark,
                        "frames_dropped": counts.frames_dropped,
                        "frames_withheld": counts.frames_withheld,
                        "frames_late": counts.frames_late,
                        "slots": counts.slots,
                        "slots_missed": counts.slots_missed,
                    });
                    let _ = writeln!(std::io::stderr(), "{line}");
                }
            }
        }
    }

    fn finish(mut self, health: ProjectorHealth, counts: RunCounts) {
        self.tick(health, counts);
        if let Shown::Bar(bar) = self.shown {
            bar.finish_and_clear();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Found in use, O13: "17.5505/s" and "17.476/s" one after the other, and while BLACK a line as if all were well.
    #[test]
    fn the_line_says_how_the_projector_is_and_its_figures_stay_in_place() {
        use ProjectorHealth::{Black, Connecting, Faulted, Frozen, Lost, Stopped, Up};
        let counts = |lit| RunCounts { frames_lit: lit, slots_missed: 3, ..RunCounts::default() };
        let at = |lit, rate| told(Up, &counts(lit), 0, rate).find("lit").unwrap();
        assert_eq!(at(7, 947.0), at(1_234_567, 17.476));
        let rate_ends = |rate| told(Up, &counts(7), 0, rate).find("/s").unwrap();
        assert_eq!(rate_ends(17.5505), rate_ends(947.0));
        assert!(told(Up, &counts(146), 0, 17.5505).contains("17.6/s"));
        assert!(told(Up, &counts(100), 1000, 10.0).contains("90 s left"));
        for health in [Black, Frozen, Lost, Faulted(1), Stopped] {
            let text = told(health, &counts(146), 1000, 16.3);
            assert!(text.starts_with(health.word()) && text.contains("no new picture"), "{text}");
            assert!(!text.contains("/s") && !text.contains("left"), "{text}");
        }
        assert!(told(Connecting, &counts(0), 0, 0.0).starts_with("connecting"));
        let dark = RunCounts { frames_dark: 9, ..counts(0) };
        assert!(told(Up, &dark, 0, 0.0).contains("9 DARK on every body"));
    }

    #[test]
    fn the_rate_is_that_of_the_last_seconds() {
        let mut rate = Rate { seen: VecDeque::new() };
        assert_eq!(rate.at(Duration::ZERO, 0), 0.0);
        let mut frames = 0;
        let mut last = 0.0;
        for tick in 1..=200 {
            frames += if tick <= 100 { 50 } else { 1 };
            last = rate.at(Duration::from_millis(50) * tick, frames);
            if tick == 100 {
                assert!((last - 1000.0).abs() < 1e-6, "{last}");
            }
        }
        assert!((last - 20.0).abs() < 1e-6, "{last}");
        assert!(rate.seen.len() <= RATE_READINGS);
    }
}
