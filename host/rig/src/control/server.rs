//! The rig's end of the control socket: one thread, which waits for no client.

use super::answer::answer_to;
use super::orders::{Orders, Ticket};
use super::parameters::{self, ChangeResult};
use super::{rig_name, socket_name, ClientRequest, HEARD, MAX_WORD};
use crate::order::Order;
use crate::parameters::ParameterCommand;
use crate::standing::By;
use crate::telemetry::monitor::RunMonitor;
use dpm_common::folder::{Folder, FolderError};
use dpm_common::unix::{peer, user, user_name, wait_readable};
use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// A client that has not sent its order by then is disconnected.
const PATIENCE: Duration = Duration::from_millis(200);
/// Maximum number of clients. For one more, the oldest client that has sent nothing is disconnected.
const CLIENTS: usize = 64;
/// Number of clients accepted before reading what they sent.
const AT_ONCE: usize = 16;
/// How often to check whether the projector has obeyed.
const LOOK_MS: i32 = 1;

/// Listens for orders until it is dropped.
#[derive(Debug)]
pub struct ControlSocket {
    folder: Arc<Folder>,
    name: String,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl ControlSocket {
    /// Listens in `folder` under this process's id. Only this user and root may give orders.
    ///
    /// # Errors
    /// The socket cannot be created there.
    pub fn serve(
        folder: Arc<Folder>,
        monitor: Arc<RunMonitor>,
        orders: Arc<Orders>,
    ) -> Result<Self, FolderError> {
        let name = socket_name(std::process::id());
        let failed = |source| FolderError::Io { path: folder.path().join(&name), source };
        // Left by a killed process with the same id.
        folder.remove(&name)?;
        let path = folder.path_to(&name);
        let listener = UnixListener::bind(&path).map_err(failed)?;
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let stop = Arc::new(AtomicBool::new(false));
        let mut desk =
            ControlDesk { listener, monitor, orders, clients: VecDeque::new(), stop: stop.clone() };
        let thread = std::thread::Builder::new()
            .name("dpm-control".into())
            .spawn(move || desk.run())
            .map_err(failed)?;
        Ok(Self { folder, name, stop, thread: Some(thread) })
    }

    /// Path of the socket, for messages.
    pub fn path(&self) -> PathBuf {
        self.folder.path().join(&self.name)
    }
}

impl Drop for ControlSocket {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        // Wakes the thread. If that fails, the thread ends with the process.
        let woken = UnixStream::connect(self.folder.path_to(&self.name)).is_ok();
        let _ = self.folder.remove(&self.name);
        if let Some(thread) = self.thread.take().filter(|_| woken) {
            let _ = thread.join();
        }
    }
}

/// A client and its progress.
struct Client {
    stream: UnixStream,
    since: Instant,
    uid: u32,
    word: Vec<u8>,
    /// What it has asked for, once received.
    given: Option<PendingAnswer>,
}

/// What waits for its answer.
enum PendingAnswer {
    Order(Order, Ticket),
    Change(ChangeResult),
}

struct ControlDesk {
    listener: UnixListener,
    monitor: Arc<RunMonitor>,
    orders: Arc<Orders>,
    /// Oldest first; never more than [`CLIENTS`].
    clients: VecDeque<Client>,
    stop: Arc<AtomicBool>,
}

impl ControlDesk {
    fn run(&mut self) {
        let mut ready = Vec::new();
        while !self.stop.load(Ordering::Relaxed) {
            let waits = self.clients.iter().any(|c| c.given.is_some());
            let limit = if waits { LOOK_MS } else { PATIENCE.as_millis() as i32 / 4 };
            let mut watched = vec![self.listener.as_raw_fd()];
            watched.extend(self.clients.iter().filter(|c| c.given.is_none()).map(|c| c.stream.as_raw_fd()));
            if wait_readable(&watched, limit, &mut ready).is_err() {
                // Out of memory, for example: avoid a tight loop.
                std::thread::sleep(Duration::from_millis(10));
            }
            self.listen();
            loop {
                // A client is read before the next one is accepted, so that no flood of silent clients displaces one
                // that sends an order.
                let all_taken = self.take_in();
                self.listen();
                if all_taken || self.stop.load(Ordering::Relaxed) {
                    break;
                }
            }
            self.answer();
        }
    }

    /// Accepts a few of the waiting clients; true if none is left.
    fn take_in(&mut self) -> bool {
        for _ in 0..AT_ONCE {
            let stream = match self.listener.accept() {
                Ok((stream, _)) => stream,
                Err(e) if e.kind() == io::ErrorKind::ConnectionAborted => continue,
                // None is left, or none can be accepted for lack of descriptors: the oldest silent client is
                // disconnected.
                Err(e) => {
                    if e.kind() != io::ErrorKind::WouldBlock {
                        self.cut_off_the_oldest();
                    }
                    return true;
                }
            };
            let Some(uid) = peer(&stream).ok().map(|peer| peer.uid) else { continue };
            if stream.set_nonblocking(true).is_err() {
                continue;
            }
            if !may_give_orders(uid, user()) {
                let _ = (&stream).write_all(b"refused: this rig belongs to another user\n");
                continue;
            }
            if self.clients.len() >= CLIENTS {
                self.cut_off_the_oldest();
            }
            self.clients.push_back(Client {
                stream,
                since: Instant::now(),
                uid,
                word: Vec::new(),
                given: None,
            });
        }
        false
    }

    fn cut_off_the_oldest(&mut self) {
        let silent = self.clients.iter().position(|c| c.given.is_none());
        // If all clients wait for an answer, the orders of all have been given. The oldest client will notice that
        // the connection ends.
        self.clients.remove(silent.unwrap_or(0));
    }

    /// Reads what clients have sent, and gives their orders.
    fn listen(&mut self) {
        let Self { clients, orders, monitor, .. } = self;
        clients.retain_mut(|client| {
            if client.given.is_some() {
                return true;
            }
            match client.read_word() {
                Ok(None) => client.since.elapsed() < PATIENCE,
                Ok(Some(ClientRequest::Order(order))) => {
                    let by = By::Socket { uid: client.uid };
                    client.given = Some(PendingAnswer::Order(order, orders.give(order, by)));
                    // A client that has disconnected has given its order all the same.
                    let _ = writeln!(client.stream, "{HEARD} {}", rig_name());
                    true
                }
                Ok(Some(ClientRequest::Parameters(command))) => client.change(&command, monitor),
                Err(_) => false,
            }
        });
    }

    fn answer(&mut self) {
        let Self { clients, orders, monitor, .. } = self;
        clients.retain_mut(|client| {
            let ago = client.since.elapsed();
            let answer = match &client.given {
                Some(PendingAnswer::Order(order, ticket)) => answer_to(*order, *ticket, ago, monitor, orders),
                Some(PendingAnswer::Change(sent)) => sent.answer(ago, monitor.parameters()),
                None => None,
            };
            let Some(answer) = answer else { return true };
            let _ = writeln!(client.stream, "{}", answer.text);
            false
        });
    }
}

/// Whether user `client` may give orders to a rig of user `me`.
fn may_give_orders(client: u32, me: u32) -> bool {
    client == me || client == 0
}

impl Client {
    fn read_word(&mut self) -> io::Result<Option<ClientRequest>> {
        read_word(&mut self.stream, &mut self.word)
    }

    /// Gives a command about the parameters. False if it was refused, of which the client is told.
    fn change(&mut self, command: &ParameterCommand, monitor: &Arc<RunMonitor>) -> bool {
        match parameters::give(monitor, command, &format!("user {}", user_name(self.uid))) {
            Ok(sent) => {
                self.given = Some(PendingAnswer::Change(sent));
                true
            }
            Err(refused) => {
                let _ = writeln!(self.stream, "refused: {refused}");
                false
            }
        }
    }
}

/// What is asked for on `stream`, once it has arrived completely; `word` holds what has arrived before.
///
/// # Errors
/// The client disconnected, or sent something else (and is informed).
#[doc(hidden)]
pub fn read_word(stream: &mut (impl Read + Write), word: &mut Vec<u8>) -> io::Result<Option<ClientRequest>> {
    let mut bytes = [0u8; MAX_WORD];
    while word.len() < MAX_WORD && !word.contains(&b'\n') {
        let room = MAX_WORD - word.len();
        match stream.read(&mut bytes[..room]) {
            Ok(0) if word.is_empty() => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(0) => break,
            Ok(n) => word.extend_from_slice(&bytes[..n]),
            Err(e) if e.kind() == io::ErrorKind::WouldBlock => return Ok(None),
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    let text = std::str::from_utf8(word).map_or("", str::trim_end);
    if let Some(order) = Order::from_word(text) {
        return Ok(Some(ClientRequest::Order(order)));
    }
    let told = match ParameterCommand::parse(text) {
        Ok(Some(command)) => return Ok(Some(ClientRequest::Parameters(command))),
        Ok(None) => {
            let known: Vec<_> = Order::ALL.iter().map(|(_, word)| *word).collect();
            format!("unknown order; known: {}, set NAME=VALUE, undo, save, list", known.join(", "))
        }
        Err(refused) => format!("refused: {refused}"),
    };
    let _ = writeln!(stream, "{told}");
    Err(io::ErrorKind::InvalidData.into())
}

#[cfg(test)]
#[path = "server_tests.rs"]
mod tests;
