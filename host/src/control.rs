//! Words from another process into orders for the rig that runs in this one, over a Unix socket; and the other end of it.
//!
//! A connection carries one word and a line feed, and one line of answer: how the projector is when it has obeyed, or half a second
//! later. The thread that listens only sets an atomic, which the link thread takes with its next poll: the frame path never waits.

use crate::telemetry::monitor::{Order, ProjectorHealth, RunMonitor};
use dpm_device::link::faults;
use std::io::{self, Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// A client that has not said its word by then is cut off.
const PATIENCE: Duration = Duration::from_millis(200);
/// How long an answer waits for the projector to obey.
const OBEYED_WITHIN: Duration = Duration::from_millis(500);
/// Longest word with its line feed.
const MAX_WORD: usize = 16;
/// Longest answer that a client reads.
const MAX_ANSWER: u64 = 512;

/// Where locks and control sockets of running rigs live: `$DPM_RUNTIME_DIR`, `$XDG_RUNTIME_DIR/dpm`, or a folder in the temporary one.
pub fn runtime_folder() -> PathBuf {
    let variable = |name| std::env::var_os(name).filter(|dir| !dir.is_empty()).map(PathBuf::from);
    variable("DPM_RUNTIME_DIR")
        .or_else(|| variable("XDG_RUNTIME_DIR").map(|dir| dir.join("dpm")))
        .unwrap_or_else(|| std::env::temp_dir().join("dpm-locks"))
}

/// The socket of the rig that runs in process `id`.
fn socket_of(folder: &Path, id: u32) -> PathBuf {
    folder.join(format!("run-{id}.sock"))
}

/// Listens for orders until it is dropped.
#[derive(Debug)]
pub struct ControlSocket {
    path: PathBuf,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl ControlSocket {
    /// Listens in `folder` under this process's number; only its user may connect.
    ///
    /// # Errors
    /// The folder cannot be made or written to.
    pub fn serve(folder: &Path, monitor: Arc<RunMonitor>) -> io::Result<Self> {
        std::fs::create_dir_all(folder)?;
        let path = socket_of(folder, std::process::id());
        // Left by a process of the same number that was killed.
        let _ = std::fs::remove_file(&path);
        let listener = UnixListener::bind(&path)?;
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600))?;
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let thread = std::thread::Builder::new().name("dpm-control".into()).spawn(move || {
            for stream in listener.incoming() {
                if stopped.load(Ordering::Relaxed) {
                    break;
                }
                match stream {
                    // What a client does wrong is its own matter.
                    Ok(stream) => drop(answer(stream, &monitor)),
                    // Out of descriptors, for example: not in a tight loop.
                    Err(_) => std::thread::sleep(PATIENCE),
                }
            }
        })?;
        Ok(Self { path, stop, thread: Some(thread) })
    }

    /// Path of the socket.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for ControlSocket {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        // Wakes the thread. Where that fails it ends with the process.
        let woken = UnixStream::connect(&self.path).is_ok();
        let _ = std::fs::remove_file(&self.path);
        if let Some(thread) = self.thread.take().filter(|_| woken) {
            let _ = thread.join();
        }
    }
}

/// True when the projector is as `order` wants it.
fn is_obeyed(order: Order, health: ProjectorHealth) -> bool {
    match order {
        Order::Black => health == ProjectorHealth::Black,
        Order::Freeze => health == ProjectorHealth::Frozen,
        Order::Safe => matches!(health, ProjectorHealth::Faulted(mask) if mask & faults::HOST_SAFE != 0),
        Order::Arm => health == ProjectorHealth::Up,
    }
}

fn answer(mut stream: UnixStream, monitor: &RunMonitor) -> io::Result<()> {
    let asked = Instant::now();
    let mut word = [0u8; MAX_WORD];
    let mut n = 0;
    while n < MAX_WORD && !word[..n].contains(&b'\n') {
        let left = PATIENCE.checked_sub(asked.elapsed()).filter(|left| !left.is_zero());
        stream.set_read_timeout(Some(left.ok_or(io::ErrorKind::TimedOut)?))?;
        match stream.read(&mut word[n..])? {
            0 => break,
            got => n += got,
        }
    }
    stream.set_write_timeout(Some(PATIENCE))?;
    let order = std::str::from_utf8(&word[..n]).ok().and_then(|w| Order::from_word(w.trim_end()));
    let Some(order) = order else {
        let known: Vec<_> = Order::ALL.iter().map(|(_, word)| *word).collect();
        return writeln!(stream, "unknown word; known: {}", known.join(", "));
    };
    monitor.give_order(order);
    while !is_obeyed(order, monitor.projector()) && asked.elapsed() < OBEYED_WITHIN {
        std::thread::sleep(Duration::from_millis(1));
    }
    let health = monitor.projector();
    let obeyed = if is_obeyed(order, health) { "ok" } else { "not yet" };
    writeln!(stream, "{obeyed}: projector {health}")
}

/// Why an order did not reach a rig.
#[derive(Debug, thiserror::Error)]
pub enum ControlError {
    /// Nobody listens.
    #[error("no running rig listens in {}; `dpm run` prints where its control socket is, DPM_RUNTIME_DIR names another folder", folder.display())]
    NoRig {
        /// Where was looked.
        folder: PathBuf,
    },
    /// Several rigs run, and only the dark is for all of them.
    #[error("{} rigs are running (processes {}); name one with --pid", ids.len(), ids.iter().map(u32::to_string).collect::<Vec<_>>().join(", "))]
    Several {
        /// Their processes.
        ids: Vec<u32>,
    },
}

/// A rig's answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Answer {
    /// Its process.
    pub id: u32,
    /// What it said.
    pub text: String,
    /// The projector has obeyed.
    pub obeyed: bool,
}

/// Gives `order` to the rig in process `id`; without `id` to the one that runs. BLACK and SAFE go to all that run: going dark needs no
/// choice.
///
/// # Errors
/// No rig runs there; several do and `order` lets light through.
pub fn tell(folder: &Path, id: Option<u32>, order: Order) -> Result<Vec<Answer>, ControlError> {
    let ids: Vec<u32> = match id {
        Some(id) => vec![id],
        None => running(folder),
    };
    if ids.len() > 1 && matches!(order, Order::Arm | Order::Freeze) {
        return Err(ControlError::Several { ids });
    }
    let answers: Vec<Answer> = ids.into_iter().filter_map(|id| ask(folder, id, order).ok()).collect();
    if answers.is_empty() {
        return Err(ControlError::NoRig { folder: folder.into() });
    }
    Ok(answers)
}

/// Processes whose sockets are answered, in order; sockets of processes that were killed are removed.
fn running(folder: &Path) -> Vec<u32> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut ids: Vec<u32> = entries
        .filter_map(|e| {
            let path = e.ok()?.path();
            let id = path.file_name()?.to_str()?.strip_prefix("run-")?.strip_suffix(".sock")?.parse().ok()?;
            match UnixStream::connect(&path) {
                Ok(_) => Some(id),
                Err(e) => {
                    if e.kind() == io::ErrorKind::ConnectionRefused {
                        let _ = std::fs::remove_file(&path);
                    }
                    None
                }
            }
        })
        .collect();
    ids.sort_unstable();
    ids
}

fn ask(folder: &Path, id: u32, order: Order) -> io::Result<Answer> {
    let mut stream = UnixStream::connect(socket_of(folder, id))?;
    let limit = Some(OBEYED_WITHIN + 2 * PATIENCE);
    stream.set_read_timeout(limit)?;
    stream.set_write_timeout(limit)?;
    // In one piece: whoever hears the word may hang up at once.
    stream.write_all(format!("{}\n", order.word()).as_bytes())?;
    let mut text = String::new();
    // The word was taken: a rig that is too busy to answer in time has still heard it.
    if let Err(e) = stream.take(MAX_ANSWER).read_to_string(&mut text) {
        text = format!("no answer yet ({e}); the order was delivered");
    }
    let text = text.trim_end().to_owned();
    Ok(Answer { id, obeyed: text.starts_with("ok"), text })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(name: &str) -> PathBuf {
        let path = std::env::temp_dir().join(format!("dpm-control-{}-{name}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        path
    }

    /// Obeys like a link thread.
    fn link(monitor: &Arc<RunMonitor>, stop: &Arc<AtomicBool>) -> JoinHandle<()> {
        let (monitor, stop) = (monitor.clone(), stop.clone());
        std::thread::spawn(move || {
            while !stop.load(Ordering::Relaxed) {
                let health = match monitor.take_order() {
                    Some(Order::Black) => ProjectorHealth::Black,
                    Some(Order::Freeze) => ProjectorHealth::Frozen,
                    Some(Order::Safe) => ProjectorHealth::Faulted(faults::HOST_SAFE),
                    Some(Order::Arm) => ProjectorHealth::Up,
                    None => {
                        std::thread::sleep(Duration::from_micros(200));
                        continue;
                    }
                };
                monitor.set_projector(health);
            }
        })
    }

    #[test]
    fn every_order_is_obeyed_and_bad_clients_cost_nothing() {
        let dir = folder("orders");
        let (monitor, stop) = (Arc::new(RunMonitor::default()), Arc::new(AtomicBool::new(false)));
        assert!(matches!(tell(&dir, None, Order::Black), Err(ControlError::NoRig { .. })));
        let socket = ControlSocket::serve(&dir, monitor.clone()).unwrap();
        assert_eq!(std::fs::metadata(socket.path()).unwrap().permissions().mode() & 0o777, 0o600);
        let thread = link(&monitor, &stop);
        // One that says nothing, one that never ends, one that talks nonsense.
        let mut silent = UnixStream::connect(socket.path()).unwrap();
        let mut endless = UnixStream::connect(socket.path()).unwrap();
        let _ = endless.write_all(&[b'x'; 4096]);
        let mut nonsense = UnixStream::connect(socket.path()).unwrap();
        nonsense.write_all(b"light!\n").unwrap();
        for (order, word) in Order::ALL {
            let answers = tell(&dir, None, order).unwrap();
            assert!(answers.len() == 1 && answers[0].obeyed, "{word}: {answers:?}");
            assert_eq!(answers[0].id, std::process::id());
            assert!(is_obeyed(order, monitor.projector()));
        }
        let mut told = String::new();
        nonsense.read_to_string(&mut told).unwrap();
        assert!(told.contains("known: black, freeze, safe, arm"), "{told}");
        silent.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
        assert_eq!(silent.read(&mut [0; 8]).unwrap(), 0, "cut off");
        assert!(matches!(tell(&dir, Some(1), Order::Arm), Err(ControlError::NoRig { .. })));
        stop.store(true, Ordering::Relaxed);
        thread.join().unwrap();
        // A projector that does not obey: the answer says so.
        monitor.set_projector(ProjectorHealth::Lost);
        let answers = tell(&dir, None, Order::Arm).unwrap();
        assert!(!answers[0].obeyed && answers[0].text.contains("not yet: projector lost"), "{answers:?}");
        drop(socket);
        assert!(matches!(tell(&dir, None, Order::Black), Err(ControlError::NoRig { .. })));
        std::fs::remove_dir_all(dir).unwrap();
    }

    #[test]
    fn with_several_rigs_only_the_dark_is_for_all_and_dead_sockets_go() {
        let dir = folder("several");
        std::fs::create_dir_all(&dir).unwrap();
        // A process that was killed leaves its socket.
        drop(UnixListener::bind(socket_of(&dir, 7)).unwrap());
        let listeners: Vec<_> = [8, 9].map(|id| UnixListener::bind(socket_of(&dir, id)).unwrap()).into();
        let servers: Vec<_> = listeners
            .into_iter()
            .map(|l| {
                std::thread::spawn(move || {
                    let mut heard = Vec::new();
                    // The look for who is there, then the order.
                    for _ in 0..3 {
                        let (mut s, _) = l.accept().unwrap();
                        let mut word = [0; 6];
                        let n = s.read(&mut word).unwrap();
                        heard.extend_from_slice(&word[..n]);
                        let _ = s.write_all(b"ok: projector black\n");
                    }
                    heard
                })
            })
            .collect();
        let error = tell(&dir, None, Order::Arm).unwrap_err().to_string();
        assert!(error.contains("2 rigs are running (processes 8, 9)"), "{error}");
        assert_eq!(tell(&dir, None, Order::Black).unwrap().iter().map(|a| a.id).collect::<Vec<_>>(), [8, 9]);
        assert!(servers.into_iter().all(|s| s.join().unwrap().starts_with(b"black")));
        assert!(!socket_of(&dir, 7).exists());
        std::fs::remove_dir_all(dir).unwrap();
    }
}
