//! The operator's end: gives an order to running rigs, and reports whether it was obeyed.

use super::status_file::{Said, StatusFile};
use super::{is_obeyed, runtime_path, socket_name, HEARD};
use crate::order::Order;
use crate::standing::state_folder;
use crossbeam::channel::unbounded;
use dpm_common::folder::{Folder, FolderError, Owner};
use dpm_common::unix::{monotonic_ns, peer, send_signal, user, user_name, SocketPeer};
use std::collections::BTreeSet;
use std::fs;
use std::io::{self, Read, Write};
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A rig that has not confirmed the arrival of BLACK or SAFE by then is sent a signal.
const HEARD_WITHIN: Duration = Duration::from_millis(20);
/// After this time an order counts as not confirmed.
const ANSWERED_WITHIN: Duration = Duration::from_millis(2000);
/// How often to read the state file.
const LOOK: Duration = Duration::from_millis(5);
/// Longest answer.
const MAX_ANSWER: usize = 2048;
/// Maximum number of rigs that one order goes to; this user's rigs come first.
const MAX_RIGS: usize = 256;

/// A rig that listens, identified by its socket.
#[derive(Clone, Debug)]
pub(crate) struct RigSocket {
    folder: Arc<Folder>,
    /// Its process.
    pub pid: u32,
    /// Its user.
    pub uid: u32,
    /// It belongs to this user, or is in a folder that only root can have created (`/run/dpm` of a service). Answers
    /// of other rigs are reported as that user's claim.
    is_vouched_for: bool,
}

/// Result of a search for running rigs.
#[derive(Debug, Default)]
pub(crate) struct RigSearch {
    /// Rigs that this user may give orders to.
    pub rigs: Vec<RigSocket>,
    /// Rigs and folders that it may not use, with the reason.
    pub refused: Vec<String>,
    /// Folders of other users, into which this one cannot look.
    pub closed: Vec<PathBuf>,
    /// Folders that were searched.
    pub looked: Vec<PathBuf>,
}

/// Why an order did not reach a rig.
#[derive(Debug, thiserror::Error)]
pub enum ControlError {
    /// No rig listens.
    #[error("no running rig listens in {}{}", list(looked), advice(*order))]
    NoRig {
        /// The order.
        order: Order,
        /// Folders that were searched.
        looked: Vec<PathBuf>,
    },
    /// Several rigs run, and only BLACK and SAFE go to all of them.
    #[error("{} rigs are running (processes {}); name one with --pid", ids.len(), ids.iter().map(u32::to_string).collect::<Vec<_>>().join(", "))]
    Several {
        /// Their processes.
        ids: Vec<u32>,
    },
}

pub(super) fn list(folders: &[PathBuf]) -> String {
    folders.iter().map(|f| f.display().to_string()).collect::<Vec<_>>().join(", ")
}

fn advice(order: Order) -> String {
    let nothing =
        "; `dpm run` prints the path of its control socket, and DPM_RUNTIME_DIR selects another folder";
    match order {
        Order::Arm => {
            let state = state_folder().map_or(String::new(), |f| format!(" in {}", f.display()));
            format!("; nothing was armed, and an order that stands{state} still stands: only a running rig can be armed{nothing}")
        }
        _ => format!(
            "; no light was darkened, and the order does not apply to a rig that starts later{nothing}"
        ),
    }
}

/// A rig's answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RigAnswer {
    /// Its process.
    pub pid: u32,
    /// Its user.
    pub uid: u32,
    /// Its rig file; empty if it did not send it.
    pub rig: String,
    /// What it answered, or what is known without an answer.
    pub text: String,
    /// The projector has obeyed, and the order is kept as required.
    pub done: bool,
    /// It belongs to this user or to a service; the answer of another user's process proves nothing.
    pub is_vouched_for: bool,
}

/// Folders in which rigs may listen. If DPM_RUNTIME_DIR is set: only that one. Otherwise: this user's own folder, the
/// service's, and those of other users, which root may use and which are reported to others.
pub(super) fn folders() -> Vec<PathBuf> {
    let own = runtime_path();
    if std::env::var_os("DPM_RUNTIME_DIR").is_some_and(|dir| !dir.is_empty()) {
        return vec![own];
    }
    let mut all = vec![own, "/run/dpm".into()];
    let below = |folder: &Path, name: &dyn Fn(&str) -> Option<PathBuf>| -> Vec<PathBuf> {
        let entries = fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok).take(4096);
        entries.filter_map(|e| Some(folder.join(name(e.file_name().to_str()?)?))).collect()
    };
    all.extend(below(Path::new("/run/user"), &|uid| Some(Path::new(uid).join("dpm"))));
    let numbered = |name: &str| name.strip_prefix("dpm-")?.parse::<u32>().ok().map(|_| PathBuf::from(name));
    all.extend(below(Path::new("/run"), &numbered));
    all.extend(below(&std::env::temp_dir(), &numbered));
    let mut seen = BTreeSet::new();
    all.retain(|folder| seen.insert(folder.clone()));
    all
}

/// Searches `folders` for rigs.
pub(super) fn search(folders: &[PathBuf]) -> RigSearch {
    let mut found = RigSearch::default();
    for path in folders {
        let folder = match Folder::open(path, Owner::OwnOrAnyForRoot) {
            Ok(folder) => Arc::new(folder),
            Err(e) => {
                // The first folder contains this user's rigs, so its problems are always reported.
                let is_own = path == &folders[0];
                match e {
                    _ if e.is_missing() => {}
                    _ if is_own => found.refused.push(e.to_string()),
                    FolderError::Io { ref source, .. }
                        if source.kind() == io::ErrorKind::PermissionDenied =>
                    {
                        found.closed.push(path.clone());
                    }
                    // Another user's folder, or a planted one: reported only if it contains something like a rig.
                    _ => found.refused.extend(foreign(path, &e)),
                }
                if is_own {
                    found.looked.push(path.clone());
                }
                continue;
            }
        };
        found.looked.push(path.clone());
        let is_vouched_for = folder.owner() == user() || is_made_by_root(path);
        let pids = folder
            .names()
            .unwrap_or_default()
            .into_iter()
            .filter_map(|name| pid_of(&name))
            .collect::<BTreeSet<_>>();
        found.rigs.extend(pids.into_iter().map(|pid| RigSocket {
            folder: folder.clone(),
            pid,
            uid: folder.owner(),
            is_vouched_for,
        }));
    }
    let me = user();
    // This user's rigs first.
    found.rigs.sort_by_key(|place| (place.uid != me, place.uid, place.pid));
    found
}

/// True if only root could create a folder there.
fn is_made_by_root(folder: &Path) -> bool {
    let above = folder.parent().and_then(|above| fs::metadata(above).ok());
    above.is_some_and(|above| above.uid() == 0 && above.mode() & 0o022 == 0)
}

fn pid_of(name: &str) -> Option<u32> {
    name.strip_prefix("run-")?.strip_suffix(".sock")?.parse().ok()
}

/// Sockets of rigs in a folder that does not belong to this user.
fn foreign(path: &Path, why: &FolderError) -> Option<String> {
    let entries = fs::read_dir(path).ok()?.filter_map(Result::ok).take(4096);
    let rigs: Vec<String> = entries
        .filter(|e| e.file_type().is_ok_and(|t| t.is_socket()))
        .filter_map(|e| {
            let pid = pid_of(e.file_name().to_str()?)?;
            let uid = e.metadata().ok()?.uid();
            Some(format!("process {pid} of {}", user_name(uid)))
        })
        .collect();
    (!rigs.is_empty()).then(|| format!("{}: {why}", rigs.join(", ")))
}

/// The result of an order.
#[derive(Debug)]
pub struct OrderResult {
    /// Answers of all rigs that were reached.
    pub answers: Vec<RigAnswer>,
    /// Rigs that were not reached.
    pub refused: Vec<String>,
    /// Folders of other users, into which this one cannot look.
    pub closed: Vec<PathBuf>,
}

impl OrderResult {
    /// True if every rig that was reached has obeyed, and one of them is this user's or a service's.
    pub fn is_done(&self) -> bool {
        self.answers.iter().all(|a| a.done) && self.answers.iter().any(|a| a.is_vouched_for)
    }
}

/// Gives `order` to the rig in process `pid`, or without `pid` to the only running rig of this user. BLACK and SAFE
/// go to all rigs that this user may give orders to, because going dark needs no choice.
///
/// # Errors
/// No rig runs there, or several do and `order` lets light through.
pub fn tell(pid: Option<u32>, order: Order) -> Result<OrderResult, ControlError> {
    tell_in(&folders(), pid, order)
}

pub(super) fn tell_in(
    folders: &[PathBuf],
    pid: Option<u32>,
    order: Order,
) -> Result<OrderResult, ControlError> {
    let RigSearch { rigs, refused, closed, looked } = search(folders);
    let mut rigs: Vec<RigSocket> =
        rigs.into_iter().filter(|place| pid.is_none_or(|pid| pid == place.pid)).collect();
    let none = || ControlError::NoRig { order, looked: looked.clone() };
    if !order.is_dark() && pid.is_none() {
        // An order that permits light requires a choice only between live rigs; sockets of dead processes do not
        // count.
        rigs.retain(|place| connect(place).is_ok());
        if rigs.len() > 1 {
            return Err(ControlError::Several { ids: rigs.iter().map(|place| place.pid).collect() });
        }
    }
    rigs.truncate(MAX_RIGS);
    let (sender, answers) = unbounded();
    let asked = rigs.len();
    for (n, place) in rigs.iter().cloned().enumerate() {
        let sender = sender.clone();
        // A rig that hangs does not delay the others.
        let ask = move || {
            let _ = sender.send((n, ask(&place, order)));
        };
        // If no thread can be started, the result below says that nothing was delivered.
        let _ = std::thread::Builder::new().name(format!("dpm-ask-{n}")).spawn(ask);
    }
    drop(sender);
    let end = Instant::now() + ANSWERED_WITHIN + Duration::from_millis(200);
    let mut told: Vec<Option<Option<RigAnswer>>> = vec![None; asked];
    while let Ok((n, answer)) = answers.recv_timeout(end.saturating_duration_since(Instant::now())) {
        told[n] = Some(answer);
    }
    let answers: Vec<RigAnswer> = rigs
        .iter()
        .zip(told)
        .filter_map(|(place, answer)| {
            answer.unwrap_or_else(|| {
                // Its socket accepts no connection. A signal cannot be sent either, because the kernel confirms no
                // process.
                Some(RigAnswer {
                    pid: place.pid,
                    uid: place.uid,
                    rig: String::new(),
                    text: format!("NOT delivered: it takes no connection; {}", by_hand(order, place.pid)),
                    done: false,
                    is_vouched_for: place.is_vouched_for,
                })
            })
        })
        .collect();
    if answers.is_empty() && (refused.is_empty() || pid.is_some()) {
        return Err(none());
    }
    Ok(OrderResult { answers, refused, closed })
}

fn by_hand(order: Order, pid: u32) -> String {
    match order {
        Order::Black => format!(
            "look at the light, then `kill -USR1 {pid}`, `kill -KILL {pid}` or the projector's own switch"
        ),
        Order::Safe => format!(
            "look at the light, then `kill -USR2 {pid}`, `kill -KILL {pid}` or the projector's own switch"
        ),
        Order::Freeze | Order::Arm => "look at the light and give the order again".into(),
    }
}

/// Connects, and asks the kernel which process listens there.
pub(super) fn connect(place: &RigSocket) -> io::Result<(UnixStream, SocketPeer)> {
    let name = socket_name(place.pid);
    let stream = UnixStream::connect(place.folder.path_to(&name)).inspect_err(|e| {
        if e.kind() == io::ErrorKind::ConnectionRefused {
            // Left by a killed process.
            let _ = place.folder.remove(&name);
            let _ = place.folder.remove(&super::state_name(place.pid));
        }
    })?;
    let listener = peer(&stream)?;
    check_listener(listener, place)?;
    Ok((stream, listener))
}

/// Anyone who can write to a folder could listen in it, so only the folder's owner is trusted.
fn check_listener(listener: SocketPeer, place: &RigSocket) -> io::Result<()> {
    if listener.uid == place.uid {
        return Ok(());
    }
    let told = format!(
        "the socket of process {} in a folder of {} is served by process {} of {}",
        place.pid,
        user_name(place.uid),
        listener.pid,
        user_name(listener.uid)
    );
    Err(io::Error::new(io::ErrorKind::PermissionDenied, told))
}

/// The signal that gives an order to a rig whose control thread does not answer.
fn signal_of(order: Order) -> Option<i32> {
    match order {
        Order::Black => Some(libc::SIGUSR1),
        Order::Safe => Some(libc::SIGUSR2),
        Order::Freeze | Order::Arm => None,
    }
}

/// The answer of one rig; `None` if there is no rig.
fn ask(place: &RigSocket, order: Order) -> Option<RigAnswer> {
    let answer = |rig: String, text: String, done: bool| {
        Some(RigAnswer {
            pid: place.pid,
            uid: place.uid,
            rig,
            text,
            done,
            is_vouched_for: place.is_vouched_for,
        })
    };
    let (begin, begin_ns) = (Instant::now(), monotonic_ns());
    let (mut stream, listener) = match connect(place) {
        Ok(found) => found,
        Err(e) if matches!(e.kind(), io::ErrorKind::ConnectionRefused | io::ErrorKind::NotFound) => {
            return None
        }
        Err(e) => {
            return answer(String::new(), format!("NOT delivered: {e}; {}", by_hand(order, place.pid)), false)
        }
    };
    let mut text = String::new();
    let mut open = say(&mut stream, order).is_ok();
    let signal = signal_of(order);
    let mut signalled: Option<io::Result<()>> = None;
    let mut seen = None;
    let rig = |text: &str| match text.lines().next().and_then(|l| l.strip_prefix(HEARD)) {
        Some(rig) => rig.trim().to_owned(),
        None => StatusFile::read(&place.folder, place.pid).map_or(String::new(), |said| said.rig),
    };
    while begin.elapsed() < ANSWERED_WITHIN {
        if open {
            open = more(&mut stream, &mut text);
        } else {
            std::thread::sleep(LOOK);
        }
        let mut lines = text.lines();
        let first = lines.next().unwrap_or_default();
        let is_heard = first.starts_with(HEARD);
        let last = if is_heard { lines.next() } else { Some(first).filter(|l| !l.is_empty()) };
        if let Some(last) = last.filter(|_| !open || text.ends_with('\n')) {
            return answer(rig(&text), last.to_owned(), last.starts_with("ok:"));
        }
        if !is_heard && signalled.is_none() && (!open || begin.elapsed() >= HEARD_WITHIN) {
            // A process that orders its own rig, as a test does, would end itself by a signal that it does not handle.
            match signal.filter(|_| listener.pid.cast_unsigned() != std::process::id()) {
                // The kernel confirms that this process listens, and it does while the connection stands.
                Some(signal) => signalled = Some(send_signal(listener.pid, signal)),
                None if !open => break,
                None => {}
            }
        }
        // A confirmed order and a signal are obeyed without the thread that answers.
        if signalled.is_some() || is_heard && !open {
            let said = StatusFile::read(&place.folder, place.pid).ok();
            if let Some(said) = said.filter(|s| s.at_ns > begin_ns && is_obeyed(order, s.health)) {
                match obeyed(&said, order, signalled.is_some()) {
                    Ok(text) => return answer(said.rig, text, true),
                    Err(text) => seen = Some(text),
                }
            }
        }
    }
    if let Some(seen) = seen {
        return answer(rig(&text), seen, false);
    }
    let what = unconfirmed(signalled.as_ref(), text.starts_with(HEARD));
    answer(rig(&text), format!("{what}; {}", by_hand(order, place.pid)), false)
}

/// What a state file says of an order that the projector obeys; an error if the order would be gone after a restart.
fn obeyed(said: &Said, order: Order, by_signal: bool) -> Result<String, String> {
    let how = if by_signal {
        "by a signal, because its control thread does not answer"
    } else {
        "according to its state file"
    };
    let kept = said.standing.filter(|standing| standing.strength() >= order.strength());
    match kept {
        Some(kept) if order.is_dark() => {
            Ok(format!("ok: projector {} ({how}); {} is kept", said.health, kept.word()))
        }
        _ if !order.is_dark() => Ok(format!("ok: projector {} ({how})", said.health)),
        _ => Err(format!("projector {} ({how}), but NOT kept over a restart", said.health)),
    }
}

/// How far an order came that nobody confirmed. `is_heard`: the rig said that it has it.
fn unconfirmed(signalled: Option<&io::Result<()>>, is_heard: bool) -> String {
    let what = match signalled {
        Some(Ok(())) => "delivered by a signal, NOT confirmed",
        _ if is_heard => "delivered, NOT confirmed",
        _ => "perhaps not delivered, NOT confirmed",
    };
    match signalled {
        Some(Err(e)) => format!("{what} (no signal could be sent: {e})"),
        _ => what.to_owned(),
    }
}

fn say(stream: &mut UnixStream, order: Order) -> io::Result<()> {
    stream.set_write_timeout(Some(HEARD_WITHIN))?;
    stream.set_read_timeout(Some(LOOK))?;
    // Written in one call, because the rig may disconnect as soon as it has the order.
    stream.write_all(format!("{}\n", order.word()).as_bytes())
}

/// Reads what has arrived, for [`LOOK`] at most. False if no more will come.
fn more(stream: &mut UnixStream, text: &mut String) -> bool {
    let mut bytes = [0u8; 512];
    match stream.read(&mut bytes) {
        Ok(0) => false,
        Ok(n) => {
            text.push_str(&String::from_utf8_lossy(&bytes[..n]));
            text.len() < MAX_ANSWER
        }
        Err(e) => matches!(
            e.kind(),
            io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut | io::ErrorKind::Interrupted
        ),
    }
}

#[cfg(test)]
#[path = "client_tests.rs"]
mod tests;
