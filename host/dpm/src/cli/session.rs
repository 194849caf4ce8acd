//! Does the steps of a calibration one by one, each as a process of its own, with a file of its own that is kept only if
//! the operator says so.
//!
//! A step is this program with the arguments that a terminal would give it, so it takes the projector's lock, limits
//! and dark ends as always. It lights nothing before it was asked for, and it ends with this process, whatever ends
//! that.

use super::os;
use dpm_calibration_file as file;
use dpm_common::unix::send_signal;
use dpm_page::calibration::StepSession;
use dpm_rig::calibration_steps::SENSOR;
use dpm_rig::results::TRIAL;
use std::fs;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::{channel, Sender};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// What is kept of a step's output, bytes; the oldest lines go first.
const KEPT: usize = 8 << 10;
/// Most bytes of notes that are read of a step.
const MOST_NOTES: u64 = 16 << 20;
/// A step that was asked to end and has not ended by then is killed. The projector goes dark by its watchdog.
const END_WITHIN: Duration = Duration::from_secs(5);
/// How often to look whether a step has ended.
const LOOK: Duration = Duration::from_millis(50);

/// What the threads of a step share.
#[derive(Debug, Default)]
struct StepState {
    session: StepSession,
    /// The input and the number of the step's process, while it runs.
    process: Option<(ChildStdin, i32)>,
    /// When the step was asked to end.
    stopped_at: Option<Instant>,
}

/// Does steps, one at a time.
#[derive(Debug)]
pub(super) struct Runner {
    /// The rig's calibration file.
    file: PathBuf,
    /// Flags of `--set` that every step gets.
    flags: Vec<String>,
    shared: Arc<Mutex<StepState>>,
}

fn held(shared: &Mutex<StepState>) -> MutexGuard<'_, StepState> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

/// `path` with an ending more.
fn beside(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(ending);
    path.with_file_name(name)
}

impl Runner {
    /// For the calibration file `file`.
    pub(super) fn new(file: PathBuf, flags: &[String]) -> Self {
        Self { file, flags: flags.to_vec(), shared: Arc::default() }
    }

    /// The file into which a step writes, until the operator has decided.
    fn trial(&self) -> PathBuf {
        beside(&self.file, TRIAL)
    }

    /// The brightness of the last sweep of the light sensor, beside a calibration file.
    fn sweep(of: &Path) -> PathBuf {
        beside(of, ".sweep")
    }

    /// True if a step has measured something on which nobody has decided.
    fn is_open(&self) -> bool {
        let trial = fs::read(self.trial());
        trial.is_ok_and(|trial| fs::read(&self.file).map_or(true, |now| now != trial))
    }

    /// What is being done, and the file with what was measured, if it waits for a decision.
    pub(super) fn session(&self) -> (StepSession, Option<PathBuf>) {
        let session = held(&self.shared).session.clone();
        let is_open = !session.is_running && self.is_open();
        (session, is_open.then(|| self.trial()))
    }

    /// Starts a step.
    ///
    /// # Errors
    /// Another one runs or waits for a decision; a value is missing; the process cannot be started.
    pub(super) fn start(
        &self,
        (step, way): (&str, usize),
        words: &[String],
        sensor: Option<&str>,
        gain: u8,
    ) -> Result<(), String> {
        let mut shared = held(&self.shared);
        if shared.session.is_running {
            return Err("a step runs already: stop it first".into());
        }
        if self.is_open() {
            return Err("keep or discard what the last step has measured first".into());
        }
        let arguments = self.arguments(words, sensor, gain)?;
        self.prepare().map_err(|e| format!("{}: {e}", self.trial().display()))?;
        *shared = StepState::default();
        shared.session =
            StepSession { step: Some(step.into()), way, is_running: true, ..StepSession::default() };
        drop(shared);
        let (started, heard) = channel();
        let shared = Arc::clone(&self.shared);
        let run = move || follow(&arguments, &shared, &started);
        let spawned = std::thread::Builder::new().name("dpm-step".into()).spawn(run);
        let told = match spawned {
            Ok(_) => heard.recv().unwrap_or_else(|_| Err("the step's thread failed".into())),
            Err(e) => Err(e.to_string()),
        };
        told.map_err(|e| {
            held(&self.shared).session = StepSession::default();
            format!("cannot start the step: {e}")
        })
    }

    /// The arguments of the step's process.
    fn arguments(&self, words: &[String], sensor: Option<&str>, gain: u8) -> Result<Vec<String>, String> {
        let mut all = words.to_vec();
        if let Some(place) = all.iter_mut().find(|word| *word == SENSOR) {
            *place = sensor.ok_or("enter the port of the light sensor first")?.to_owned();
            all.extend(["--gain".to_owned(), gain.to_string()]);
        }
        match (all.first().map(String::as_str), all.get(1).map(String::as_str)) {
            (Some("calibrate"), what) if what != Some("export") => {
                all.extend(["--file".to_owned(), self.trial().display().to_string()]);
            }
            // A pattern needs no line about its progress every second.
            (Some("pattern"), _) => all.extend(["--set", "output.log_every_s=0"].map(str::to_owned)),
            _ => {}
        }
        all.extend(self.flags.iter().flat_map(|flag| ["--set".to_owned(), flag.clone()]));
        Ok(all)
    }

    /// Makes the step's file the same as the rig's.
    fn prepare(&self) -> io::Result<()> {
        let same = |from: &Path, to: &Path| match from.exists() {
            true => fs::copy(from, to).map(drop),
            false if to.exists() => fs::remove_file(to),
            false => Ok(()),
        };
        let trial = self.trial();
        same(&Self::sweep(&self.file), &Self::sweep(&trial))?;
        same(&self.file, &trial)
    }

    /// Writes a line to the step.
    ///
    /// # Errors
    /// No step runs, or it reads nothing any more.
    pub(super) fn answer(&self, line: &str) -> Result<(), String> {
        let mut shared = held(&self.shared);
        let (input, _) = shared.process.as_mut().ok_or("no step runs")?;
        let written = input.write_all(format!("{line}\n").as_bytes()).and_then(|()| input.flush());
        written.map_err(|e| format!("the step reads no answer: {e}"))?;
        // As on a terminal, what was typed stands behind the question.
        add(&mut shared.session.output, &format!("{line}\n"));
        Ok(())
    }

    /// Asks the step to end, in the dark.
    ///
    /// # Errors
    /// No step runs.
    pub(super) fn stop(&self) -> Result<(), String> {
        let mut shared = held(&self.shared);
        let (_, pid) = shared.process.as_ref().ok_or("no step runs")?;
        send_signal(*pid, libc::SIGTERM).map_err(|e| format!("the step cannot be stopped: {e}"))?;
        shared.stopped_at.get_or_insert_with(Instant::now);
        Ok(())
    }

    /// Takes what was measured into the rig's calibration file.
    ///
    /// # Errors
    /// There is nothing to take, or a file cannot be read or written.
    pub(super) fn keep(&self) -> Result<(), String> {
        self.decide()?;
        let trial = self.trial();
        let measured = file::load(&trial).map_err(|e| e.to_string())?;
        file::save(&measured, &self.file).map_err(|e| e.to_string())?;
        let sweep = Self::sweep(&trial);
        if sweep.exists() {
            fs::rename(&sweep, Self::sweep(&self.file)).map_err(|e| format!("{}: {e}", sweep.display()))?;
        }
        fs::remove_file(&trial).map_err(|e| format!("{}: {e}", trial.display()))
    }

    /// Throws away what was measured.
    ///
    /// # Errors
    /// There is nothing, or its file cannot be removed.
    pub(super) fn discard(&self) -> Result<(), String> {
        self.decide()?;
        let trial = self.trial();
        let _ = fs::remove_file(Self::sweep(&trial));
        fs::remove_file(&trial).map_err(|e| format!("{}: {e}", trial.display()))
    }

    /// Whether there is something to decide.
    fn decide(&self) -> Result<(), String> {
        if held(&self.shared).session.is_running {
            return Err("the step has not ended yet".into());
        }
        if !self.is_open() {
            return Err("nothing was measured that is not in the calibration file".into());
        }
        Ok(())
    }
}

impl Drop for Runner {
    fn drop(&mut self) {
        let _ = self.stop();
    }
}

/// Starts a step and follows it to its end. Its process ends with this thread.
fn follow(arguments: &[String], shared: &Arc<Mutex<StepState>>, started: &Sender<Result<(), String>>) {
    let begin = || {
        let mut command = Command::new(std::env::current_exe()?);
        command.args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        os::end_with_this_thread(&mut command);
        command.spawn()
    };
    let mut child = match begin() {
        Ok(child) => child,
        Err(e) => return drop(started.send(Err(e.to_string()))),
    };
    let (input, out, err) = (child.stdin.take(), child.stdout.take(), child.stderr.take());
    held(shared).process = input.map(|input| (input, child.id() as i32));
    let _ = started.send(Ok(()));
    let ended = std::thread::scope(|scope| {
        scope.spawn(|| out.into_iter().for_each(|out| read(out, shared)));
        scope.spawn(|| err.into_iter().for_each(|err| read_notes(err, shared)));
        wait(&mut child, shared)
    });
    let session = &mut held(shared).session;
    session.is_running = false;
    session.ended = Some(ended.map_or_else(|e| format!("The step was lost: {e}."), told_of));
}

/// How a step ended.
fn told_of(status: ExitStatus) -> String {
    match status.code() {
        Some(0) => "The step ended in order.".into(),
        Some(1) => "The step ended, and found something that is not good enough.".into(),
        Some(code) => format!("The step ended with exit code {code}; its last lines say why."),
        None => "The step was stopped.".into(),
    }
}

/// Waits for the end of a step, and kills it if it was asked to end and does not.
fn wait(child: &mut Child, shared: &Mutex<StepState>) -> io::Result<ExitStatus> {
    loop {
        let mut held = held(shared);
        if let Some(status) = child.try_wait()? {
            // Its number may belong to another process from now on.
            held.process = None;
            return Ok(status);
        }
        if held.stopped_at.is_some_and(|at| at.elapsed() > END_WITHIN) {
            child.kill()?;
        }
        drop(held);
        std::thread::sleep(LOOK);
    }
}

/// Reads what a step says, to its end. A question has no end of line, so nothing waits for one.
fn read(mut from: impl Read, shared: &Mutex<StepState>) {
    let mut bytes = [0; 1024];
    while let Ok(n) = from.read(&mut bytes) {
        if n == 0 {
            return;
        }
        add(&mut held(shared).session.output, &String::from_utf8_lossy(&bytes[..n]));
    }
}

/// Reads a step's notes, which are JSON where no terminal reads them, and its errors.
fn read_notes(from: impl Read, shared: &Mutex<StepState>) {
    for line in BufReader::new(from.take(MOST_NOTES)).lines().map_while(Result::ok) {
        let note = serde_json::from_str::<serde_json::Value>(&line).ok();
        let text = note.as_ref().and_then(|note| note["note"].as_str()).unwrap_or(&line);
        add(&mut held(shared).session.output, &format!("{text}\n"));
    }
}

/// Adds to what a step wrote, and forgets its oldest lines.
fn add(output: &mut String, text: &str) {
    output.push_str(text);
    if output.len() > KEPT {
        let from = output.len() - KEPT;
        let cut = output.bytes().skip(from).position(|b| b == b'\n').map_or(output.len(), |n| from + n + 1);
        output.drain(..cut);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn runner(name: &str) -> (PathBuf, Runner) {
        let dir = std::env::temp_dir().join(format!("dpm-session-{}-{name}", std::process::id()));
        let _ = fs::remove_dir_all(&dir);
        fs::create_dir_all(&dir).unwrap();
        let runner = Runner::new(dir.join("calibration.toml"), &["tracker.server=10.0.0.1".to_owned()]);
        (dir, runner)
    }

    #[test]
    fn a_step_gets_the_ports_the_flags_and_a_file_of_its_own() {
        let (dir, runner) = runner("words");
        let words = ["calibrate", "projector", "rig.toml", "--sensor", SENSOR].map(str::to_owned);
        assert!(runner.arguments(&words, None, 0).unwrap_err().contains("port of the light sensor"));
        let all = runner.arguments(&words, Some("/dev/ttyACM0"), 6).unwrap().join(" ");
        let trial = dir.join("calibration.toml.trial");
        let want = format!(
            "calibrate projector rig.toml --sensor /dev/ttyACM0 --gain 6 --file {} --set tracker.server=10.0.0.1",
            trial.display()
        );
        assert_eq!(all, want);
        // What only reads the rig's own file takes no other.
        for words in [["calibrate", "export", "rig.toml"], ["pattern", "grid", "rig.toml"]] {
            let all = runner.arguments(&words.map(str::to_owned), None, 0).unwrap();
            assert!(!all.contains(&"--file".to_owned()), "{all:?}");
        }
        fs::remove_dir_all(dir).unwrap();
    }

    #[test]
    fn what_was_measured_is_kept_or_thrown_away_and_nothing_in_between() {
        let (dir, runner) = runner("keep");
        let (file, trial) = (runner.file.clone(), runner.trial());
        let said = |text: &str| format!("# {text}\nversion = 1\n");
        for act in [Runner::keep, Runner::discard] {
            assert!(act(&runner).unwrap_err().contains("nothing was measured"));
        }
        fs::write(&file, said("old")).unwrap();
        runner.prepare().unwrap();
        assert!(!runner.is_open() && trial.exists());
        fs::write(&trial, said("new")).unwrap();
        fs::write(Runner::sweep(&trial), "bright").unwrap();
        assert_eq!(runner.session().1, Some(trial.clone()));
        let words = ["calibrate", "wand", "rig.toml"].map(str::to_owned);
        let told = runner.start(("wand", 0), &words, None, 0).unwrap_err();
        assert!(told.contains("keep or discard"), "{told}");
        runner.discard().unwrap();
        assert!(!trial.exists() && !Runner::sweep(&trial).exists());
        assert_eq!(fs::read_to_string(&file).unwrap(), said("old"));
        // A trial that is no calibration file is not taken.
        fs::write(&trial, "version = 9").unwrap();
        assert!(runner.keep().unwrap_err().contains("version"));
        assert_eq!(fs::read_to_string(&file).unwrap(), said("old"));
        fs::write(&trial, said("new")).unwrap();
        fs::write(Runner::sweep(&trial), "bright").unwrap();
        runner.keep().unwrap();
        assert_eq!(fs::read_to_string(dir.join("calibration.toml.1.old")).unwrap(), said("old"));
        assert_eq!(fs::read_to_string(Runner::sweep(&file)).unwrap(), "bright");
        assert!(!trial.exists() && runner.session().1.is_none());
        // Without a file of the rig there is nothing to begin from.
        fs::remove_file(&file).unwrap();
        fs::write(&trial, "left over").unwrap();
        runner.prepare().unwrap();
        assert!(!trial.exists());
        fs::remove_dir_all(dir).unwrap();
    }

    #[test]
    fn the_end_of_a_long_output_is_kept_in_whole_lines() {
        let mut output = String::new();
        (0..2000).for_each(|k| add(&mut output, &format!("line {k} ä\n")));
        assert!(output.len() <= KEPT && output.starts_with("line ") && output.ends_with("line 1999 ä\n"));
        add(&mut output, &"x".repeat(2 * KEPT));
        assert!(output.len() <= KEPT);
    }
}
