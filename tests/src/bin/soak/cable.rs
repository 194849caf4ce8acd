//! A cable between two pseudo-terminals that can be pulled: bytes from one end to the other, in both directions.

use dpm_device::tty::{self, never_wait};
use serialport::{SerialPort, TTYPort};
use std::fs::{File, OpenOptions};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// The cable. Its end at the host has a path that stays the same when it is plugged in again.
pub(crate) struct Cable {
    /// What the rig file names.
    pub(crate) path: PathBuf,
    projector: String,
    plugged: Option<(Arc<AtomicBool>, JoinHandle<()>)>,
}

impl Cable {
    /// A cable to the projector's pseudo-terminal, plugged in.
    pub(crate) fn new(path: PathBuf, projector: &str) -> Result<Self, String> {
        let mut cable = Self { path, projector: projector.to_owned(), plugged: None };
        cable.plug_in()?;
        Ok(cable)
    }

    /// Pulls the plug: the host's port is gone. The projector keeps its power.
    pub(crate) fn unplug(&mut self) {
        // The name goes before the terminal, whose number may be that of another program's at once.
        let _ = std::fs::remove_file(&self.path);
        if let Some((stop, thread)) = self.plugged.take() {
            stop.store(true, Ordering::Relaxed);
            let _ = thread.join();
        }
    }

    /// Plugs it in again.
    pub(crate) fn plug_in(&mut self) -> Result<(), String> {
        let (ours, theirs) = TTYPort::pair().map_err(|e| format!("no pseudo-terminal: {e}"))?;
        let name = theirs.name().ok_or("a pseudo-terminal without a name")?;
        let host = never_wait(ours).map_err(|e| e.to_string())?;
        // Keeps the line open and raw between hosts, without the lock of the library's own handle.
        let held = OpenOptions::new().read(true).write(true).open(&name).map_err(|e| e.to_string())?;
        drop(theirs);
        let projector =
            tty::open(&self.projector, 3_000_000).map_err(|e| format!("{}: {e}", self.projector))?;
        link(Path::new(&name), &self.path)?;
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let thread = std::thread::spawn(move || carry(host, projector, held, &stopped));
        self.plugged = Some((stop, thread));
        Ok(())
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        self.unplug();
    }
}

fn link(to: &Path, path: &Path) -> Result<(), String> {
    let _ = std::fs::remove_file(path);
    std::os::unix::fs::symlink(to, path).map_err(|e| format!("{}: {e}", path.display()))
}

/// Bytes on their way in one direction.
#[derive(Default)]
struct Way {
    waiting: Vec<u8>,
    sent: usize,
}

impl Way {
    /// Moves what can be moved now; returns the number of bytes.
    fn step(&mut self, from: &mut dyn SerialPort, to: &mut dyn SerialPort) -> usize {
        if self.sent == self.waiting.len() {
            self.waiting.resize(4096, 0);
            // A line that nobody has opened yet, or any more, carries nothing.
            let n = from.read(&mut self.waiting).unwrap_or_default();
            self.waiting.truncate(n);
            self.sent = 0;
        }
        // A line without room takes nothing.
        let n = to.write(&self.waiting[self.sent..]).unwrap_or_default();
        self.sent += n;
        n
    }
}

fn carry(mut host: Box<dyn SerialPort>, mut projector: Box<dyn SerialPort>, held: File, stop: &AtomicBool) {
    let (mut to_projector, mut to_host) = (Way::default(), Way::default());
    while !stop.load(Ordering::Relaxed) {
        let moved =
            to_projector.step(&mut *host, &mut *projector) + to_host.step(&mut *projector, &mut *host);
        if moved == 0 {
            std::thread::sleep(Duration::from_micros(300));
        }
    }
    drop(held);
}
