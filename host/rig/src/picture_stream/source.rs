//! Where pictures come from: a named pipe, or PipeWire by a program of GStreamer in a process of its own, so that what
//! it does to itself cannot reach the rig.

use super::decode::StreamForm;
use crate::config::LiveSource;
use dpm_common::unix::{wait_readable, widen_pipe};
use std::fmt;
use std::fs::{File, Metadata};
use std::io::{self, Read};
use std::os::fd::{AsRawFd, RawFd};
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// Most bytes that are read at once, and what a pipe should hold.
pub(super) const MOST_BYTES: usize = 1 << 20;
/// The program that reads from PipeWire.
const PROGRAM: &str = "gst-launch-1.0";
/// Most that is kept of what it says.
const MOST_SAID: usize = 4096;

/// Why no more pictures come.
#[derive(Debug)]
pub(super) enum StreamEnd {
    /// The run is over.
    Stopped,
    /// The source cannot be opened.
    NotOpened(String),
    /// The program at the other end has closed its end.
    Closed,
    /// The program that was started has ended, with what it said last.
    Program(String),
    /// What comes is no picture.
    Wrong(String),
    /// Reading fails.
    Failed(io::Error),
}

impl fmt::Display for StreamEnd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Stopped => write!(f, "the run is over"),
            Self::NotOpened(why) | Self::Wrong(why) => write!(f, "{why}"),
            Self::Closed => write!(f, "the program that made the pictures has closed the pipe"),
            Self::Program(said) if said.is_empty() => write!(f, "{PROGRAM} has ended"),
            Self::Program(said) => write!(f, "{PROGRAM} has ended: {said}"),
            Self::Failed(e) => write!(f, "it cannot be read: {e}"),
        }
    }
}

/// An open source.
pub(super) enum OpenSource {
    /// A named pipe, and whether anything has come.
    Pipe(File, bool),
    /// A program of its own, and the end of what it has said.
    Program(Child, Vec<u8>),
}

impl OpenSource {
    /// Opens a source for pictures of `size`. Never waits for a program at the other end.
    ///
    /// # Errors
    /// Why it cannot be opened.
    pub(super) fn open(source: &LiveSource, size: [u32; 2]) -> Result<Self, StreamEnd> {
        match source {
            LiveSource::Pipe(path) => open_pipe(path).map_err(StreamEnd::NotOpened),
            LiveSource::PipeWire(target) => {
                start(gstreamer_at(Path::new(PROGRAM), target, size)).map_err(StreamEnd::NotOpened)
            }
        }
    }

    /// What it sends.
    pub(super) fn form(&self) -> StreamForm {
        match self {
            Self::Pipe(..) => StreamForm::Netpbm,
            Self::Program(..) => StreamForm::Rgba,
        }
    }

    /// Waits at most `limit` for bytes and reads them; 0: none have come.
    ///
    /// # Errors
    /// Nothing more comes.
    pub(super) fn read(&mut self, bytes: &mut [u8], limit: Duration) -> Result<usize, StreamEnd> {
        match self {
            Self::Pipe(file, has_come) => {
                // Before a program has opened it, a pipe has nothing to wait for.
                let is_ready = readable(&[file.as_raw_fd()], limit)?[0];
                match if is_ready { file.read(bytes) } else { return Ok(0) } {
                    Ok(0) if *has_come => Err(StreamEnd::Closed),
                    Ok(0) => {
                        std::thread::sleep(limit);
                        Ok(0)
                    }
                    Ok(count) => {
                        *has_come = true;
                        Ok(count)
                    }
                    Err(e) if e.kind() == io::ErrorKind::WouldBlock => Ok(0),
                    Err(e) => Err(StreamEnd::Failed(e)),
                }
            }
            Self::Program(child, said) => {
                let Some(out) = &mut child.stdout else { return Err(StreamEnd::Program(String::new())) };
                let both: Vec<RawFd> = [Some(out.as_raw_fd()), child.stderr.as_ref().map(AsRawFd::as_raw_fd)]
                    .into_iter()
                    .flatten()
                    .collect();
                let ready = readable(&both, limit)?;
                if let (Some(err), Some(true)) = (&mut child.stderr, ready.get(1)) {
                    let mut part = [0; 512];
                    match err.read(&mut part) {
                        Ok(count) if count > 0 => said.extend_from_slice(&part[..count]),
                        _ => child.stderr = None,
                    }
                    said.drain(..said.len().saturating_sub(MOST_SAID));
                }
                match if ready[0] { out.read(bytes) } else { return Ok(0) } {
                    Ok(0) => {
                        let _ = child.kill();
                        if let Some(err) = &mut child.stderr {
                            let _ = err.take(MOST_SAID as u64).read_to_end(said);
                        }
                        Err(StreamEnd::Program(told(said)))
                    }
                    Ok(count) => Ok(count),
                    Err(e) => Err(StreamEnd::Failed(e)),
                }
            }
        }
    }
}

impl Drop for OpenSource {
    fn drop(&mut self) {
        if let Self::Program(child, _) = self {
            // It may have ended already.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

fn readable(descriptors: &[RawFd], limit: Duration) -> Result<Vec<bool>, StreamEnd> {
    let mut ready = Vec::with_capacity(descriptors.len());
    wait_readable(descriptors, limit.as_millis() as i32, &mut ready).map_err(StreamEnd::Failed)?;
    Ok(ready)
}

/// Whether there is what a source needs, without opening it: a program that waits for the rig would take whoever looks for it.
///
/// # Errors
/// What is missing, and what to do.
pub fn look_at(source: &LiveSource) -> Result<(), String> {
    match source {
        LiveSource::Pipe(path) => match std::fs::metadata(path) {
            Ok(found) => check_kind(&found),
            Err(e) => Err(not_opened(&e)),
        },
        LiveSource::PipeWire(_) => {
            let folders = std::env::var_os("PATH").unwrap_or_default();
            let is_there = std::env::split_paths(&folders).any(|folder| folder.join(PROGRAM).is_file());
            is_there.then_some(()).ok_or_else(not_installed)
        }
    }
}

fn not_opened(e: &io::Error) -> String {
    match e.kind() {
        io::ErrorKind::NotFound => "there is no such pipe; `mkfifo` makes one".into(),
        _ => format!("it cannot be opened: {e}"),
    }
}

fn check_kind(found: &Metadata) -> Result<(), String> {
    let is_pipe = found.file_type().is_fifo();
    is_pipe.then_some(()).ok_or_else(|| "it is no named pipe; `mkfifo` makes one".into())
}

fn not_installed() -> String {
    format!(
        "{PROGRAM} is not installed; on Debian: apt install gstreamer1.0-tools gstreamer1.0-plugins-base \
         gstreamer1.0-pipewire"
    )
}

fn open_pipe(path: &Path) -> Result<OpenSource, String> {
    let file = File::options().read(true).custom_flags(libc::O_NONBLOCK | libc::O_CLOEXEC).open(path);
    let file = file.map_err(|e| not_opened(&e))?;
    check_kind(&file.metadata().map_err(|e| e.to_string())?)?;
    // A smaller one only means more calls.
    let _ = widen_pipe(&file, MOST_BYTES);
    Ok(OpenSource::Pipe(file, false))
}

/// The program that writes the pictures of a PipeWire node to its output, as RGBA texels of this size.
pub(super) fn gstreamer_at(program: &Path, target: &str, [width, height]: [u32; 2]) -> Command {
    let mut command = Command::new(program);
    command.args(["-q", "pipewiresrc"]);
    if !target.is_empty() {
        command.arg(format!("target-object={target}"));
    }
    let caps = format!("video/x-raw,format=RGBA,width={width},height={height},pixel-aspect-ratio=1/1");
    // The newest picture waits, and no older one.
    let newest = ["!", "queue", "leaky=downstream", "max-size-buffers=1", "!", "videoconvert", "!"];
    command.args(newest).args(["videoscale", "add-borders=false", "!"]);
    command.arg(caps).args(["!", "fdsink", "fd=1", "sync=false"]);
    command
}

/// Starts it.
///
/// # Errors
/// It is not installed, or cannot be started.
pub(super) fn start(mut command: Command) -> Result<OpenSource, String> {
    let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
    let child = child.map_err(|e| match e.kind() {
        io::ErrorKind::NotFound => not_installed(),
        _ => format!("{PROGRAM} cannot be started: {e}"),
    })?;
    if let Some(out) = &child.stdout {
        let _ = widen_pipe(out, MOST_BYTES);
    }
    Ok(OpenSource::Program(child, Vec::new()))
}

/// The first error in what a program has said, or its last line.
fn told(said: &[u8]) -> String {
    let said = String::from_utf8_lossy(said);
    let lines = || said.lines().map(str::trim).filter(|line| !line.is_empty());
    let line = lines().find(|line| line.starts_with("ERROR")).or_else(|| lines().next_back());
    line.unwrap_or_default().chars().filter(|c| !c.is_control()).take(200).collect()
}
