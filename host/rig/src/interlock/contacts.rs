//! The contacts of `[safety.interlock]`: processes, control lines, files, held keys. A contact that cannot be read
//! counts as open.

use super::{Contact, InterlockState};
use crate::config::InterlockConfig;
use dpm_device::tty::{ControlLine, ControlSignal};
use std::fs::OpenOptions;
use std::io::Read;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

/// How often to look for a missing process, and for a port that cannot be opened.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// The longest process name that the kernel keeps.
const COMM_BYTES: usize = 15;
/// The maximum number of bytes read from a file.
const MOST_BYTES: u64 = 4096;

/// The contact that a configuration names.
pub(super) fn of(config: &InterlockConfig, shared: &Arc<InterlockState>) -> Box<dyn Contact> {
    match config {
        InterlockConfig::None(_) => Box::new(Nothing),
        InterlockConfig::Process(p) => match (&p.name, &p.pid_file) {
            (Some(name), _) => Box::new(ByName::new(name)),
            (None, Some(file)) => Box::new(ByPidFile { file: file.clone(), seen: None }),
            (None, None) => Box::new(Nothing),
        },
        InterlockConfig::Line(l) => match (&l.port, &l.file) {
            (Some(port), _) => Box::new(ModemLine {
                path: port.clone(),
                signal: l.signal.line(),
                open: None,
                look_at: Instant::now(),
            }),
            (None, Some(file)) => Box::new(One(file.clone())),
            (None, None) => Box::new(Nothing),
        },
        InterlockConfig::Key(_) => Box::new(Key(shared.clone())),
    }
}

/// Never closed.
struct Nothing;

impl Contact for Nothing {
    fn is_closed(&mut self) -> bool {
        false
    }
}

/// Reads a small file. Never waits for the writer of a named pipe.
fn read_small(path: &Path) -> Option<(Vec<u8>, std::fs::Metadata)> {
    let file =
        OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK | libc::O_CLOEXEC).open(path).ok()?;
    let meta = file.metadata().ok()?;
    let mut bytes = Vec::new();
    file.take(MOST_BYTES).read_to_end(&mut bytes).ok()?;
    Some((bytes, meta))
}

/// A process: its id, and its start time, which distinguishes it from a later process with the same id.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Process {
    id: u32,
    started: u64,
}

impl Process {
    /// The process `id`, if it is running and belongs to this user or to root.
    pub(super) fn find(id: u32) -> Option<Self> {
        let (stat, meta) = read_small(Path::new(&format!("/proc/{id}/stat")))?;
        // The owner of these files is the effective user of the process.
        if meta.uid() != 0 && meta.uid() != own_user() {
            return None;
        }
        let stat = String::from_utf8_lossy(&stat);
        // The name in parentheses may itself contain parentheses and spaces.
        let mut fields = stat.rsplit_once(')')?.1.split_whitespace();
        // A stopped, traced or dead process does not count as alive.
        if matches!(fields.next()?, "T" | "t" | "Z" | "X" | "x") {
            return None;
        }
        // The state is field 3 of the line, the start time is field 22.
        Some(Self { id, started: fields.nth(18)?.parse().ok()? })
    }

    fn is_alive(self) -> bool {
        Self::find(self.id) == Some(self)
    }
}

/// This process's user, as reported by the kernel.
fn own_user() -> u32 {
    std::fs::metadata("/proc/self").map_or(u32::MAX, |m| m.uid())
}

/// Any process of this name.
struct ByName {
    comm: Vec<u8>,
    alive: Option<Process>,
    look_at: Instant,
}

impl ByName {
    fn new(name: &str) -> Self {
        let comm = name.as_bytes()[..name.len().min(COMM_BYTES)].to_vec();
        Self { comm, alive: None, look_at: Instant::now() }
    }

    fn look(&self) -> Option<Process> {
        std::fs::read_dir("/proc").ok()?.filter_map(Result::ok).find_map(|entry| {
            let id: u32 = entry.file_name().to_str()?.parse().ok()?;
            let (comm, _) = read_small(&entry.path().join("comm"))?;
            if comm.strip_suffix(b"\n").unwrap_or(&comm) != self.comm {
                return None;
            }
            Process::find(id)
        })
    }
}

impl Contact for ByName {
    fn is_closed(&mut self) -> bool {
        if self.alive.is_some_and(Process::is_alive) {
            return true;
        }
        let now = Instant::now();
        if self.alive.take().is_some() || now >= self.look_at {
            self.look_at = now + LOOK_EVERY;
            self.alive = self.look();
        }
        self.alive.is_some()
    }
}

/// The process whose id a file contains.
struct ByPidFile {
    file: PathBuf,
    /// The id in the file, when the file was written, and which process that was then.
    seen: Option<(u32, Option<SystemTime>, Process)>,
}

impl Contact for ByPidFile {
    fn is_closed(&mut self) -> bool {
        let Some((text, meta)) = read_small(&self.file) else {
            self.seen = None;
            return false;
        };
        let Some(id) = std::str::from_utf8(&text).ok().and_then(|t| t.trim().parse::<u32>().ok()) else {
            return false;
        };
        let Some(process) = Process::find(id) else { return false };
        let written = meta.modified().ok();
        match self.seen {
            // The file is unchanged, so the process must be the same; otherwise another process has got the id.
            Some((same, at, first)) if same == id && at == written => process == first,
            _ => {
                self.seen = Some((id, written, process));
                true
            }
        }
    }
}

/// An input of a serial port.
struct ModemLine {
    path: String,
    signal: ControlSignal,
    open: Option<ControlLine>,
    look_at: Instant,
}

impl Contact for ModemLine {
    fn is_closed(&mut self) -> bool {
        let now = Instant::now();
        if self.open.is_none() && now >= self.look_at {
            self.look_at = now + LOOK_EVERY;
            self.open = ControlLine::open(&self.path, self.signal).ok();
        }
        match self.open.as_mut().map(ControlLine::is_raised) {
            Some(Ok(raised)) => raised,
            // Unplugged; reopened when it is back.
            Some(Err(_)) => {
                self.open = None;
                false
            }
            None => false,
        }
    }
}

/// A file that contains "1".
struct One(PathBuf);

impl Contact for One {
    fn is_closed(&mut self) -> bool {
        read_small(&self.0).is_some_and(|(bytes, _)| bytes.trim_ascii() == b"1")
    }
}

/// The key that is passed to [`super::Interlock::key_pressed`].
struct Key(Arc<InterlockState>);

impl Contact for Key {
    fn is_closed(&mut self) -> bool {
        self.0.keys.is_held(self.0.clock.now().0)
    }
}
