//! Questions to the operator and their answers, line by line, without ever hanging a run that must stop.

use crossbeam::channel::{unbounded, Receiver, RecvTimeoutError};
use dpm_rig::failure::{Failure, FailureKind};
use std::io::{BufRead, Write};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// Longest line that is read; the rest of it is left out.
const LONGEST_LINE: u64 = 4096;

/// The lines of the standard input. One thread reads them for all dialogues of the program, since a reader that waits
/// cannot be called back and would take a line from the next one.
static READER: Mutex<Option<Receiver<String>>> = Mutex::new(None);

fn read_lines() -> Result<Receiver<String>, Failure> {
    let (send, lines) = unbounded();
    let read = move || loop {
        let mut line = String::new();
        let mut input = std::io::Read::take(std::io::stdin().lock(), LONGEST_LINE);
        match input.read_line(&mut line) {
            Ok(n) if n > 0 && send.send(line.trim().to_owned()).is_ok() => {}
            _ => return,
        }
    };
    std::thread::Builder::new()
        .name("dpm-dialogue".into())
        .spawn(read)
        .map_err(|e| Failure::new(FailureKind::Device, format!("cannot start a thread: {e}")))?;
    Ok(lines)
}

/// The operator at the standard input and output.
pub struct Dialogue {
    lines: Receiver<String>,
    is_stopped: Box<dyn Fn() -> bool + Send>,
}

impl Dialogue {
    /// Begins to read lines. `is_stopped` says when the answer does not matter any more.
    ///
    /// # Errors
    /// No thread can be started (exit code 3).
    pub fn start(is_stopped: impl Fn() -> bool + Send + 'static) -> Result<Self, Failure> {
        let mut reader = READER.lock().unwrap_or_else(PoisonError::into_inner);
        let lines = match &*reader {
            Some(lines) => lines.clone(),
            None => reader.insert(read_lines()?).clone(),
        };
        Ok(Self { lines, is_stopped: Box::new(is_stopped) })
    }

    /// Tells the operator something.
    pub fn tell(&self, text: &str) {
        let mut out = std::io::stdout().lock();
        // A reader that has gone away is no reason to end a measurement.
        let _ = writeln!(out, "{text}").and_then(|()| out.flush());
    }

    /// Asks, and waits for a line.
    ///
    /// # Errors
    /// The input ended, or the program is being stopped. What was measured so far is kept.
    pub fn ask(&self, text: &str) -> Result<String, Failure> {
        let mut out = std::io::stdout().lock();
        let _ = write!(out, "{text} ").and_then(|()| out.flush());
        drop(out);
        loop {
            match self.lines.recv_timeout(Duration::from_millis(20)) {
                Ok(line) => return Ok(line),
                Err(RecvTimeoutError::Timeout) if !(self.is_stopped)() => {}
                Err(_) => {
                    let told = "the calibration was interrupted; run the same command again to go on";
                    return Err(Failure::new(FailureKind::BadInput, told));
                }
            }
        }
    }
}
