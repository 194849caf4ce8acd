//! The operator's end of a change: tells a running rig to change its parameters, and reports what it answers.

use super::client::{connect, folders, list, search, RigSocket};
use crate::parameters::ParameterCommand;
use std::io::{self, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// How long an answer is waited for.
const ANSWERED_WITHIN: Duration = Duration::from_secs(3);
/// Longest single wait.
const STEP: Duration = Duration::from_millis(200);
/// Longest answer, bytes.
const MAX_ANSWER: usize = 1 << 20;

/// Why a change was not made.
#[derive(Debug, thiserror::Error)]
pub enum ChangeError {
    /// No rig of this user listens.
    #[error("no running rig listens in {}; `dpm run` prints the path of its control socket, and DPM_RUNTIME_DIR selects another folder", list(looked))]
    NoRig {
        /// Folders that were searched.
        looked: Vec<PathBuf>,
    },
    /// Several rigs run.
    #[error("{} rigs are running (processes {}); name one with --pid", ids.len(), ids.iter().map(u32::to_string).collect::<Vec<_>>().join(", "))]
    Several {
        /// Their processes.
        ids: Vec<u32>,
    },
    /// The rig cannot be reached, or does not answer.
    #[error("process {pid}: {source}")]
    Io {
        /// Its process.
        pid: u32,
        /// Why.
        source: io::Error,
    },
    /// The rig has refused it; nothing was changed.
    #[error("{0}")]
    Refused(String),
    /// It was not done, or not yet.
    #[error("{0}")]
    NotDone(String),
}

/// Sends `command` to the rig in process `pid`, or to the only one that this user may command. Returns its answer.
///
/// # Errors
/// See [`ChangeError`].
pub fn change(pid: Option<u32>, command: &ParameterCommand) -> Result<String, ChangeError> {
    change_in(&folders(), pid, command)
}

pub(super) fn change_in(
    folders: &[PathBuf],
    pid: Option<u32>,
    command: &ParameterCommand,
) -> Result<String, ChangeError> {
    let found = search(folders);
    let rigs: Vec<RigSocket> =
        found.rigs.into_iter().filter(|place| pid.is_none_or(|pid| pid == place.pid)).collect();
    // What a killed process has left is no rig.
    let mut open: Vec<_> = rigs.iter().filter_map(|place| Some((place, connect(place).ok()?.0))).collect();
    if open.len() > 1 {
        return Err(ChangeError::Several { ids: open.iter().map(|(place, _)| place.pid).collect() });
    }
    let Some((place, stream)) = open.pop() else {
        return Err(ChangeError::NoRig { looked: found.looked });
    };
    let pid = place.pid;
    let text = ask(stream, command).map_err(|source| ChangeError::Io { pid, source })?;
    let text = text.trim_end().to_owned();
    if text.starts_with("ok: ") || *command == ParameterCommand::List && !text.starts_with("refused") {
        Ok(text)
    } else if text.starts_with("refused: ") {
        Err(ChangeError::Refused(text))
    } else if text.is_empty() {
        let source = io::Error::new(io::ErrorKind::UnexpectedEof, "it gave no answer");
        Err(ChangeError::Io { pid, source })
    } else {
        Err(ChangeError::NotDone(text))
    }
}

fn ask(mut stream: UnixStream, command: &ParameterCommand) -> io::Result<String> {
    stream.set_read_timeout(Some(STEP))?;
    stream.set_write_timeout(Some(STEP))?;
    stream.write_all(format!("{}\n", command.line()).as_bytes())?;
    let begin = Instant::now();
    let (mut all, mut bytes) = (Vec::new(), [0u8; 4096]);
    while begin.elapsed() < ANSWERED_WITHIN && all.len() < MAX_ANSWER {
        match stream.read(&mut bytes) {
            // The rig ends the connection after its answer.
            Ok(0) => return Ok(String::from_utf8_lossy(&all).into_owned()),
            Ok(n) => all.extend_from_slice(&bytes[..n]),
            Err(e)
                if matches!(
                    e.kind(),
                    io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut | io::ErrorKind::Interrupted
                ) => {}
            Err(e) => return Err(e),
        }
    }
    Err(io::Error::new(io::ErrorKind::TimedOut, "it does not answer"))
}
