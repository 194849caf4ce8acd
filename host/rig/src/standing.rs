//! Orders that outlive the program: one small file per projector, in a state folder. A file that cannot be read
//! counts as SAFE.
//!
//! SAFE and BLACK stand until a person gives `dpm arm` to a running rig; they survive restarts of the program, the
//! service and the machine. FREEZE stands as BLACK after its run, because there is no frame left to hold. Only for the
//! mock in this process, which emits no light, BLACK and FREEZE end with an orderly end of their run.
//! `docs/ORDERS.md` describes this for operators.
//!
//! Nothing but ARM lets light through, so an order is kept even where the disk has filled up since the start: its bytes
//! were allocated before the first light, in the reserve.

mod edid;
mod identity;
mod others;
mod port;

pub use identity::Identity;

use crate::config::Restart;
use crate::failure::{Failure, FailureKind};
use crate::order::Order;
use crate::telemetry::monitor::RunMonitor;
use dpm_common::folder::{Folder, FolderError, Owner};
use dpm_common::unix::{user, user_name};
use identity::Match;
use others::Others;
use port::SerialDevice;
use std::fmt;
use std::io;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

/// Version of the files' content. Version 1 had neither `port` nor `lifted`.
const VERSION: u32 = 2;
/// Size of a file. A longer one is damaged, and a shorter one is of version 1.
const BYTES: usize = 4096;
/// File name extension of an order.
const ENDING: &str = ".order";
/// File name extension of the file that becomes the next order.
const RESERVE: &str = ".reserve";
/// File name extension of what this user has lifted of another's order.
const LIFTED: &str = ".lifted";
/// Other projectors for which an order is lifted, at most; for the oldest it then holds again.
const MOST_LIFTED: usize = 6;
/// Characters of a name in a file, at most.
const MAX_NAME: usize = 100;

/// Who gave an order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum By {
    /// A user, over the control socket.
    Socket {
        /// As reported by the kernel.
        uid: u32,
    },
    /// The live page; whoever holds its token.
    Page,
    /// A datagram of Open Sound Control.
    Osc {
        /// Its sender, as it says.
        from: IpAddr,
    },
    /// A key on the terminal of the run.
    Key,
    /// A signal.
    Signal,
    /// The projector itself, which had it latched when the link came up.
    Projector,
    /// The interlock, which has opened and is reset by hand.
    Interlock,
    /// An order that stands for the same projector under another name.
    SerialNumber,
}

impl fmt::Display for By {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Socket { uid } => write!(f, "user {} over the control socket", user_name(*uid)),
            Self::Page => write!(f, "the live page"),
            Self::Osc { from } => write!(f, "OSC from {from}"),
            Self::Key => write!(f, "a key"),
            Self::Signal => write!(f, "a signal"),
            Self::Projector => write!(f, "the projector, which had it latched"),
            Self::Interlock => write!(f, "safety.interlock, which opened"),
            Self::SerialNumber => {
                write!(f, "an order that stands for the projector with this serial number")
            }
        }
    }
}

/// Content of the file.
#[derive(Debug, serde::Serialize, serde::Deserialize)]
struct OrderFileContent {
    version: u32,
    order: String,
    at: String,
    by: String,
    process: u32,
    projector: String,
    /// The port behind the projector.
    #[serde(default)]
    port: Option<SerialDevice>,
    /// The serial number that the projector gave in HELLO, in hexadecimal digits.
    #[serde(default)]
    serial: Option<String>,
    /// Other projectors that a person has armed although this order might have been for them.
    #[serde(default)]
    lifted: Vec<String>,
}

impl OrderFileContent {
    fn new(order: Order, by: &str, projector: &str, port: Option<SerialDevice>) -> Self {
        let cut = |text: &str| text.chars().take(MAX_NAME).collect();
        Self {
            version: VERSION,
            order: order.word().into(),
            at: utc(SystemTime::now()),
            by: cut(by),
            process: std::process::id(),
            projector: cut(projector),
            port,
            serial: None,
            lifted: Vec::new(),
        }
    }

    fn serial(&self) -> Option<u64> {
        u64::from_str_radix(self.serial.as_deref()?, 16).ok()
    }

    /// Both are about one order.
    fn is_about(&self, other: &Self) -> bool {
        let told = |c: &Self| (c.order.clone(), c.at.clone(), c.by.clone(), c.process, c.serial.clone());
        told(self) == told(other)
    }

    /// Exactly [`BYTES`] bytes.
    fn to_bytes(&self) -> io::Result<Vec<u8>> {
        let mut bytes = serde_json::to_vec(self)?;
        if bytes.len() >= BYTES {
            return Err(io::Error::other("the names of the projector's port are too long"));
        }
        bytes.resize(BYTES - 1, b' ');
        bytes.push(b'\n');
        Ok(bytes)
    }
}

/// An order that stands when a run starts: the rig comes up and does not arm.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Stands {
    /// BLACK or SAFE.
    pub order: Order,
    /// Since when, and by whom; or why it counts as SAFE.
    pub told: String,
    /// The file of this projector holds it.
    pub is_on_disk: bool,
}

impl Stands {
    /// What stands when a run starts: what the disk has kept, or else what `start` demands.
    pub fn at_start(kept: Option<Self>, start: Restart) -> Option<Self> {
        let by_hand = || Self {
            order: Order::Black,
            told: "from the start, which is \"by hand\" (safety.start)".into(),
            is_on_disk: false,
        };
        kept.or_else(|| (start == Restart::ByHand).then(by_hand))
    }

    /// The same for the run of `monitor`, which is then called never armed where nothing else is the reason.
    pub fn begin(kept: Option<Self>, start: Restart, monitor: &RunMonitor) -> Option<Self> {
        let is_kept = kept.is_some();
        let stands = Self::at_start(kept, start);
        if stands.is_some() && !is_kept {
            monitor.await_first_arm();
        }
        stands
    }
}

/// The folder of the files: `$DPM_STATE_DIR`, else systemd's `$STATE_DIRECTORY`, else `/var/lib/dpm` for root, else
/// `$XDG_STATE_HOME/dpm` or `~/.local/state/dpm`. `None` for a user without a home directory.
pub fn state_folder() -> Option<PathBuf> {
    choose(&|name| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from), user() == 0)
}

fn choose(variable: &dyn Fn(&str) -> Option<PathBuf>, is_root: bool) -> Option<PathBuf> {
    // Several folders are separated by colons; the first one is the unit's own.
    let systemd = || {
        let list = variable("STATE_DIRECTORY")?.into_os_string().into_string().ok()?;
        list.split(':').next().filter(|first| !first.is_empty()).map(PathBuf::from)
    };
    let absolute = |name| variable(name).filter(|path| path.is_absolute());
    variable("DPM_STATE_DIR")
        .or_else(systemd)
        .or_else(|| is_root.then(|| "/var/lib/dpm".into()))
        .or_else(|| absolute("XDG_STATE_HOME").map(|dir| dir.join("dpm")))
        .or_else(|| absolute("HOME").map(|dir| dir.join(".local/state/dpm")))
}

/// The folder of the files, as far as this module needs it: the file system's, or that of a simulator.
pub trait StateFolder: fmt::Debug + Send + Sync {
    /// Its path, for messages.
    fn path(&self) -> &Path;

    /// Names of its entries.
    ///
    /// # Errors
    /// Those of the operating system.
    fn names(&self) -> Result<Vec<String>, FolderError>;

    /// The content of `name`, at most `most` bytes.
    ///
    /// # Errors
    /// It is longer, or not a file of this user; those of the operating system.
    fn read(&self, name: &str, most: u64) -> Result<Vec<u8>, FolderError>;

    /// Replaces the content of `name`, atomically; it is on the disk when this returns.
    ///
    /// # Errors
    /// Those of the operating system; the old content is then unchanged.
    fn replace(&self, name: &str, bytes: &[u8]) -> Result<(), FolderError>;

    /// Writes `bytes` over the content of `name`, which exists; they are on the disk when this returns. Needs no room on
    /// the disk where the content was as long.
    ///
    /// # Errors
    /// Those of the operating system; the content may then be a mixture.
    fn overwrite(&self, name: &str, bytes: &[u8]) -> Result<(), FolderError>;

    /// Renames `from` to `to`, which is replaced; that is on the disk when this returns.
    ///
    /// # Errors
    /// Those of the operating system.
    fn rename(&self, from: &str, to: &str) -> Result<(), FolderError>;

    /// Removes `name`, which may be missing; it is gone from the disk when this returns.
    ///
    /// # Errors
    /// Those of the operating system.
    fn remove(&self, name: &str) -> Result<(), FolderError>;
}

impl StateFolder for Folder {
    fn path(&self) -> &Path {
        Self::path(self)
    }

    fn names(&self) -> Result<Vec<String>, FolderError> {
        Self::names(self)
    }

    fn read(&self, name: &str, most: u64) -> Result<Vec<u8>, FolderError> {
        Self::read(self, name, most)
    }

    fn replace(&self, name: &str, bytes: &[u8]) -> Result<(), FolderError> {
        Self::replace(self, name, bytes)
    }

    fn overwrite(&self, name: &str, bytes: &[u8]) -> Result<(), FolderError> {
        Self::overwrite(self, name, bytes)
    }

    fn rename(&self, from: &str, to: &str) -> Result<(), FolderError> {
        Self::rename(self, from, to)
    }

    fn remove(&self, name: &str) -> Result<(), FolderError> {
        Self::remove(self, name)
    }
}

/// The file of one projector.
#[derive(Debug)]
pub struct OrderFile {
    identity: Identity,
    /// The serial number that the projector gave in HELLO; 0 before.
    device: AtomicU64,
    folder: Option<Box<dyn StateFolder>>,
    path: PathBuf,
    /// Orders of other users of this machine.
    others: Option<Others>,
}

impl OrderFile {
    /// Opens the state folder `path`, creates it if it is missing, and reads what stands for `identity`. The second
    /// part of the result says why a folder cannot be used; the file then keeps nothing.
    pub fn open(path: Option<PathBuf>, identity: Identity) -> (Self, Option<FolderError>, Option<Stands>) {
        Self::open_beside(path, None, identity)
    }

    /// The same on this machine: in the state folder of this user, and with the orders of others.
    pub fn on_this_machine(identity: Identity) -> (Self, Option<FolderError>, Option<Stands>) {
        Self::open_beside(state_folder(), Others::of_this_machine(), identity)
    }

    fn open_beside(
        path: Option<PathBuf>,
        others: Option<Others>,
        identity: Identity,
    ) -> (Self, Option<FolderError>, Option<Stands>) {
        let others = others.filter(|_| !identity.is_mock());
        let Some(path) = path else {
            let source =
                io::Error::new(io::ErrorKind::NotFound, "this user has no home directory; set DPM_STATE_DIR");
            let error = FolderError::Io { path: "(no state folder)".into(), source };
            return (Self::without_folder(identity, PathBuf::new()), Some(error), None);
        };
        let stands = standing_beside(&path, others.as_ref(), &identity);
        match Folder::make(&path, Owner::OwnOrAnyForRoot) {
            Ok(folder) => {
                let (file, error) = Self::in_folder(Box::new(folder), identity);
                (Self { others, ..file }.shown(), error, stands)
            }
            Err(e) => (Self::without_folder(identity, path), Some(e), stands),
        }
    }

    /// The file in `folder`, if an order can be kept there whatever else fills the disk.
    pub(crate) fn in_folder(folder: Box<dyn StateFolder>, identity: Identity) -> (Self, Option<FolderError>) {
        let path = folder.path().to_owned();
        match reserve(&*folder, &identity) {
            Ok(()) => (Self { folder: Some(folder), ..Self::without_folder(identity, path) }, None),
            Err(e) => (Self::without_folder(identity, path), Some(e)),
        }
    }

    fn without_folder(identity: Identity, path: PathBuf) -> Self {
        Self { identity, device: AtomicU64::new(0), folder: None, path, others: None }
    }

    /// Shows the others what stands by this user's orders, should their copy be gone.
    fn shown(self) -> Self {
        if let (Some(others), Some(folder)) = (&self.others, &self.folder) {
            let names = folder.names().unwrap_or_default().into_iter().filter(|name| name.ends_with(ENDING));
            for name in names {
                if let Ok(bytes) = folder.read(&name, BYTES as u64) {
                    others.show(&name, &bytes);
                }
            }
        }
        self
    }

    /// The projector said HELLO with this serial number: orders are kept for it and lifted for it from now on.
    pub(crate) fn hear(&self, device: Option<u64>) {
        self.device.store(device.unwrap_or(0), Ordering::Relaxed);
    }

    fn device(&self) -> Option<u64> {
        Some(self.device.load(Ordering::Relaxed)).filter(|serial| *serial != 0)
    }

    /// The orders on the disk that name a projector by its serial number, whatever else they name.
    pub(crate) fn by_serial_number(&self) -> Vec<(u64, Order)> {
        let Some(folder) = &self.folder else { return Vec::new() };
        let named = |order: StandingOrder| Some((order.device()?, order.stands.order));
        all_told(Some(&**folder), self.others.as_ref()).into_iter().flatten().filter_map(named).collect()
    }

    /// The file in which orders for this projector are kept.
    pub(crate) fn path(&self) -> PathBuf {
        self.path.join(self.identity.order_name(self.device()))
    }

    /// BLACK and FREEZE end with an orderly end of the run.
    pub(crate) fn ends_with_the_run(&self) -> bool {
        self.identity.is_mock()
    }

    /// Keeps `order`; it is on the disk when this returns. The caller must not replace a stronger order by a weaker
    /// one. Returns the path of the file.
    ///
    /// # Errors
    /// The state folder could not be used at the start, or cannot be written to now.
    pub(crate) fn keep(&self, order: Order, by: By) -> Result<PathBuf, FolderError> {
        let Some(folder) = &self.folder else {
            let source = io::Error::other("could not be used when the run began");
            return Err(FolderError::Io { path: self.path.clone(), source });
        };
        let (identity, device) = (&self.identity, self.device());
        let (name, unnamed) = (identity.order_name(device), identity.order_name(None));
        let mut content =
            OrderFileContent::new(order, &by.to_string(), identity.what(), identity.port().cloned());
        content.serial = device.map(|serial| format!("{serial:016x}"));
        if by == By::SerialNumber {
            self.remember_who(&mut content);
        }
        let bytes = content.to_bytes().map_err(|source| FolderError::Io { path: self.path(), source })?;
        let reserve_name = identity.stem() + RESERVE;
        folder
            .overwrite(&reserve_name, &bytes)
            .and_then(|()| folder.rename(&reserve_name, &name))
            // The reserve has become this file with an earlier order. A power failure that leaves a mixture leaves a
            // damaged file, which counts as SAFE.
            .or_else(|_| folder.overwrite(&name, &bytes))
            .or_else(|_| folder.replace(&name, &bytes))
            // An order that was given before the projector said HELLO has the reserve, and the disk is full.
            .or_else(|_| folder.overwrite(&unnamed, &bytes))?;
        // The next order may be for a projector with another serial number at this port, in a file of its own.
        let _ = reserve(&**folder, identity);
        if let Some(others) = &self.others {
            others.show(&name, &bytes);
        }
        Ok(self.path())
    }

    /// An order that is given again, because its projector is here, keeps its time and who gave it.
    fn remember_who(&self, again: &mut OrderFileContent) {
        let Some(folder) = &self.folder else { return };
        let all = all_told(Some(&**folder), self.others.as_ref()).unwrap_or_default();
        let mut same = all.into_iter().filter_map(|order| order.content);
        if let Some(OrderFileContent { at, by, .. }) =
            same.find(|content| content.serial == again.serial && content.order == again.order)
        {
            (again.at, again.by) = (at, by);
        }
    }

    /// Lifts every order that holds this projector; that is on the disk when this returns. An order that may be for
    /// another projector stays in force for that one. If nothing can be kept, there is nothing to lift.
    ///
    /// # Errors
    /// An error of the operating system; an order then still stands.
    pub(crate) fn forget(&self) -> Result<(), FolderError> {
        let Some(folder) = &self.folder else { return Ok(()) };
        let device = self.device();
        let held = holding(Some(&**folder), self.others.as_ref(), &self.identity, device)?;
        for Held { told: StandingOrder { name, is_own, stands, content }, is_same } in held {
            // Before HELLO nobody has said whether the projector is the one whose serial number the order names: it is lifted
            // for this port, and given again where that one says HELLO.
            let is_named = device.is_none() && content.as_ref().is_some_and(|c| c.serial.is_some());
            if !is_same || !is_own || is_named {
                let mut content = content.unwrap_or_else(|| {
                    OrderFileContent::new(Order::Safe, &stands.told, "an unknown projector", None)
                });
                let serial = content.serial().filter(|serial| Some(*serial) == device);
                content.version = VERSION;
                content.lifted.extend(serial.map(by_serial));
                content.lifted.push(self.identity.instance());
                content.lifted.drain(..content.lifted.len().saturating_sub(MOST_LIFTED));
                let name = if is_own { name } else { name + LIFTED };
                let failed = |source| FolderError::Io { path: folder.path().join(&name), source };
                folder.replace(&name, &content.to_bytes().map_err(failed)?)?;
                continue;
            }
            if let Some(others) = &self.others {
                others.hide(&name);
            }
            if name == self.identity.order_name(device)
                && folder.read(&name, BYTES as u64).is_ok_and(is_whole)
            {
                folder.rename(&name, &(self.identity.stem() + RESERVE))?;
            } else {
                folder.remove(&name)?;
            }
        }
        Ok(())
    }
}

fn is_whole(bytes: Vec<u8>) -> bool {
    bytes.len() == BYTES
}

/// Allocates the bytes of the next order, and tries all that keeping it takes: a file that is written over, and a new
/// name in the folder, as long as that of an order.
fn reserve(folder: &dyn StateFolder, identity: &Identity) -> Result<(), FolderError> {
    let longest = "x".repeat(MAX_NAME);
    let content = OrderFileContent::new(Order::Safe, &longest, &longest, identity.port().cloned());
    let (reserve, trial) = (identity.stem() + RESERVE, identity.stem() + ".trial");
    let bytes = content
        .to_bytes()
        .map_err(|source| FolderError::Io { path: folder.path().join(&reserve), source })?;
    if !folder.read(&reserve, BYTES as u64).is_ok_and(is_whole) {
        folder.replace(&reserve, &bytes)?;
    }
    folder.overwrite(&reserve, &bytes)?;
    folder.rename(&reserve, &trial)?;
    folder.rename(&trial, &reserve)
}

/// An order on the disk.
struct StandingOrder {
    name: String,
    /// It lies in this user's folder, and not among the orders of others.
    is_own: bool,
    stands: Stands,
    /// `None` for a damaged file.
    content: Option<OrderFileContent>,
}

impl StandingOrder {
    /// The serial number for which it stands.
    fn device(&self) -> Option<u64> {
        let content = self.content.as_ref()?;
        content.serial().filter(|serial| !content.lifted.contains(&by_serial(*serial)))
    }
}

/// An order that holds a projector.
struct Held {
    told: StandingOrder,
    /// It was given to this projector, as far as can be told.
    is_same: bool,
}

/// What lifts an order for the projector with this serial number, whatever its port.
fn by_serial(serial: u64) -> String {
    format!("serial {serial:016x}")
}

/// All orders on the disk: those in `folder`, and those of other users with what this user has lifted of them.
fn all_told(
    folder: Option<&dyn StateFolder>,
    others: Option<&Others>,
) -> Result<Vec<StandingOrder>, FolderError> {
    let mut all = Vec::new();
    let own = folder.map_or(Ok(Vec::new()), |folder| folder.names())?;
    let read = |name: &str| {
        let folder = folder.ok_or_else(String::new)?;
        folder.read(name, BYTES as u64).map_err(|e| e.to_string())
    };
    for name in own.into_iter().filter(|name| name.ends_with(ENDING)) {
        let path = folder.map_or(name.clone(), |folder| folder.path().join(&name).display().to_string());
        let (stands, content) = stands_in(read(&name), &path);
        all.push(StandingOrder { name, is_own: true, stands, content });
    }
    for (name, bytes) in others.map(Others::orders).unwrap_or_default() {
        let (stands, content) = stands_in(Ok(bytes), &name);
        // Anybody may write there: what is damaged was not written by a rig.
        let Some(mut content) = content else { continue };
        let note = read(&(name.clone() + LIFTED));
        if let Some(note) = stands_in(note, &name).1.filter(|note| note.is_about(&content)) {
            content.lifted = note.lifted;
        }
        all.push(StandingOrder { name, is_own: false, stands, content: Some(content) });
    }
    Ok(all)
}

/// The orders that hold the projector of `identity`. `device`: its serial number, if it has given one by now.
fn holding(
    folder: Option<&dyn StateFolder>,
    others: Option<&Others>,
    identity: &Identity,
    device: Option<u64>,
) -> Result<Vec<Held>, FolderError> {
    let mut all = Vec::new();
    for mut told in all_told(folder, others)? {
        let content = told.content.as_ref();
        let (projector, port) = content.map_or(("", None), |c| (c.projector.as_str(), c.port.as_ref()));
        let by_name = identity.is_meant_by(Others::name_of(&told.name), projector, port);
        // A serial number proves that it is the same one. That it is another one, with a name that this one may have, is
        // for a person to say by ARM, which then lifts the order for this one alone.
        let meant = match content.and_then(OrderFileContent::serial).zip(device) {
            Some((then, now)) if then == now => Match::Same,
            Some(_) if by_name == Match::Same => Match::Doubtful,
            _ => by_name,
        };
        let is_same = meant == Match::Same;
        let armed = match content.and_then(OrderFileContent::serial).zip(device) {
            Some((then, now)) if then == now => by_serial(now),
            _ => identity.instance(),
        };
        let is_lifted = content.is_some_and(|c| c.lifted.contains(&armed));
        // Lifted for this port, and given again where its own projector says HELLO.
        let waits_for_hello = device.is_none() && content.is_some_and(|c| c.serial.is_some());
        if meant == Match::Other || is_lifted && (!is_same || waits_for_hello || !told.is_own) {
            continue;
        }
        // An order of another user stays in force for that user, whoever lifts it for themselves.
        told.stands.is_on_disk = is_same && told.is_own;
        if content.is_some() && projector != identity.what() {
            let maybe = if is_same { "" } else { ", which may be this one" };
            told.stands.told += &format!(", for {}{maybe}", clean(projector));
        }
        all.push(Held { told, is_same });
    }
    Ok(all)
}

/// What stands for `identity` on this machine: in the state folder of this user, and by orders of others.
pub fn standing(identity: &Identity) -> Option<Stands> {
    standing_beside(&state_folder()?, Others::of_this_machine().as_ref(), identity)
}

/// Fails if SAFE or BLACK stands for the projector of `identity`. For commands that emit light without a rig that could
/// be armed.
///
/// # Errors
/// The standing order, since when and by whom (exit code 3).
pub fn refuse_where_dark_stands(identity: &Identity) -> Result<(), Failure> {
    match standing(identity) {
        None => Ok(()),
        Some(stands) => {
            let word = if stands.order == Order::Safe { "SAFE" } else { "BLACK" };
            let told = format!("{identity}: {word} stands {}; run its rig and say `dpm arm`", stands.told);
            Err(Failure::new(FailureKind::Device, told))
        }
    }
}

/// What stands on this machine for the projector that says HELLO with this serial number, whatever port its order names:
/// for who lights a projector without a run. 0 and 1 name no projector.
pub fn standing_for_device(serial: u64) -> Option<Stands> {
    let folder = Folder::open(&state_folder()?, Owner::OwnOrAnyForRoot).ok();
    let folder = folder.as_ref().map(|folder| folder as &dyn StateFolder);
    of_device(folder, Others::of_this_machine().as_ref(), serial)
}

fn of_device(folder: Option<&dyn StateFolder>, others: Option<&Others>, serial: u64) -> Option<Stands> {
    let all = all_told(folder, others).into_iter().flatten();
    let its = all.filter(|told| serial > 1 && told.device() == Some(serial)).map(|told| told.stands);
    its.max_by_key(|stands| stands.order.strength())
}

/// What stands for `identity` in the state folder `path`. A missing folder contains nothing. A folder that cannot be
/// read or trusted counts as SAFE, and so does a file that is damaged or has an unknown version.
pub fn standing_in(path: &Path, identity: &Identity) -> Option<Stands> {
    standing_beside(path, None, identity)
}

fn standing_beside(path: &Path, others: Option<&Others>, identity: &Identity) -> Option<Stands> {
    match Folder::open(path, Owner::OwnOrAnyForRoot) {
        Ok(folder) => strongest(Some(&folder), others, identity),
        Err(e) if e.is_missing() => strongest(None, others, identity),
        Err(e) => Some(unreadable(&e)),
    }
}

/// The same for a folder that is open.
pub(crate) fn standing_in_folder(folder: &dyn StateFolder, identity: &Identity) -> Option<Stands> {
    strongest(Some(folder), None, identity)
}

fn strongest(
    folder: Option<&dyn StateFolder>,
    others: Option<&Others>,
    identity: &Identity,
) -> Option<Stands> {
    match holding(folder, others.filter(|_| !identity.is_mock()), identity, None) {
        Ok(all) => {
            let stands = all.into_iter().map(|held| held.told.stands);
            stands.max_by_key(|stands| (stands.order.strength(), stands.is_on_disk))
        }
        Err(e) => Some(unreadable(&e)),
    }
}

fn unreadable(e: &FolderError) -> Stands {
    let told = format!("counts as SAFE, because the state folder cannot be read: {e}");
    Stands { order: Order::Safe, told, is_on_disk: true }
}

fn clean(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).take(200).collect()
}

/// Reads the content of a file. `path` is its name in messages.
fn stands_in(bytes: Result<Vec<u8>, String>, path: &str) -> (Stands, Option<OrderFileContent>) {
    let parsed = bytes.and_then(|bytes| {
        let content: OrderFileContent =
            serde_json::from_slice(&bytes).map_err(|e| format!("damaged: {e}"))?;
        if !(1..=VERSION).contains(&content.version) {
            return Err(format!("version {} is not known", content.version));
        }
        if content.version > 1 && bytes.len() != BYTES {
            return Err(format!("damaged: {} bytes", bytes.len()));
        }
        match Order::from_word(&content.order) {
            Some(Order::Arm) | None => Err(format!("damaged: {:?} is not a standing order", content.order)),
            Some(order) => Ok((order, content)),
        }
    });
    match parsed {
        Ok((order, content)) => {
            let held = if order == Order::Freeze {
                " (FREEZE of a run that is over: no frame is left to hold)"
            } else {
                ""
            };
            let stands = Stands {
                order: if order == Order::Safe { Order::Safe } else { Order::Black },
                told: format!("since {}, ordered by {}{held}", clean(&content.at), clean(&content.by)),
                is_on_disk: true,
            };
            (stands, Some(content))
        }
        Err(reason) => {
            let told = format!("counts as SAFE, because {path} cannot be read: {reason}");
            (Stands { order: Order::Safe, told, is_on_disk: true }, None)
        }
    }
}

/// What the bytes of a file say, for a test with any bytes.
#[doc(hidden)]
pub fn stands_in_bytes(bytes: &[u8]) -> Stands {
    stands_in(Ok(bytes.to_vec()), "a file").0
}

/// `at` in the form 2026-03-01T12:00:00Z (proleptic Gregorian calendar, without leap seconds). Times before 1970 are
/// shown as 1970.
pub fn utc(at: SystemTime) -> String {
    let seconds = at.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
    let (days, second) = (seconds / 86_400, seconds % 86_400);
    // Days are counted from 1 March of the year 0, so that the leap day is the last day of its year.
    let days = days + 719_468;
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let (day, month) = (day - (153 * month + 2) / 5 + 1, if month < 10 { month + 3 } else { month - 9 });
    let year = era * 400 + year + u64::from(month <= 2);
    format!("{year:04}-{month:02}-{day:02}T{:02}:{:02}:{:02}Z", second / 3600, second / 60 % 60, second % 60)
}

/// Seconds from 1970 to a time in the form that [`utc`] writes; `None` for another text and for times before 1970.
pub fn seconds_of_utc(text: &str) -> Option<u64> {
    let (date, time) = text.strip_suffix('Z')?.split_once('T')?;
    let numbers = |part: &str, sign| {
        let mut each = part.split(sign).map(|n| n.parse::<u64>().ok());
        let three = [each.next()??, each.next()??, each.next()??];
        each.next().is_none().then_some(three)
    };
    let ([year, month, day], [hour, minute, second]) = (numbers(date, '-')?, numbers(time, ':')?);
    let is_date = (1970..=9999).contains(&year) && (1..=12).contains(&month) && (1..=31).contains(&day);
    if !is_date || hour > 23 || minute > 59 || second > 60 {
        return None;
    }
    // As above, a year begins with March.
    let (year, month) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
    let days = 365 * year + year / 4 - year / 100 + year / 400 + (153 * month + 2) / 5 + day - 1;
    Some((days - 719_468) * 86_400 + 3600 * hour + 60 * minute + second)
}

#[cfg(test)]
mod identity_tests;
#[cfg(test)]
mod room_tests;
#[cfg(test)]
mod tests;
