//! A cable between two pseudo-terminals that can be pulled: bytes from one end to the other, in both directions.

use dpm_device::tty;
use hil_mock::serial_server::{pseudo_terminal, PortName};
use serialport::SerialPort;
use std::fs::File;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// The cable. Its end at the host has a path that stays the same when it is plugged in again.
pub(crate) struct Cable {
    /// What the rig file names.
    pub(crate) path: PathBuf,
    projector: String,
    plugged: Option<(PortName, Arc<AtomicBool>, JoinHandle<()>)>,
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
        if let Some((name, stop, thread)) = self.plugged.take() {
            drop(name);
            stop.store(true, Ordering::Relaxed);
            let _ = thread.join();
        }
    }

    /// Plugs it in again.
    pub(crate) fn plug_in(&mut self) -> Result<(), String> {
        let (host, terminal, held) = pseudo_terminal().map_err(|e| format!("no pseudo-terminal: {e}"))?;
        let projector =
            tty::open(&self.projector, 3_000_000).map_err(|e| format!("{}: {e}", self.projector))?;
        let name =
            PortName::give(&self.path, &terminal).map_err(|e| format!("{}: {e}", self.path.display()))?;
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let thread = std::thread::spawn(move || carry(host, projector, held, &stopped));
        self.plugged = Some((name, stop, thread));
        Ok(())
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        self.unplug();
    }
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
