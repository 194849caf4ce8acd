//! Orders that outlive the program: one small file per projector, in a state folder. A file that cannot be read
//! counts as SAFE.
//!
//! SAFE stands until a person gives `dpm arm` to a running rig; it survives restarts of the program, the service and
//! the machine. BLACK and FREEZE stand as long as the run that they were given to. If that run died without an
//! orderly end, they stand as BLACK, because there is no frame left to hold. `docs/ORDERS.md` describes this for
//! operators.

use crate::config::ProjectorBackend;
use crate::order::Order;
use dpm_common::folder::{Folder, FolderError, Owner};
use dpm_common::unix::{user, user_name};
use std::fmt;
use std::io;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// Version of the files' content.
const VERSION: u32 = 1;
/// A longer file is damaged.
const MAX_BYTES: u64 = 4096;
/// File name extension.
const ENDING: &str = ".order";
/// The longest file name without its extension. A longer one is cut and made unique by a hash.
const MAX_STEM: usize = 160;

/// Identifies a projector: its name in locks, standing orders and messages.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    what: String,
    /// The part of the file names that all projectors of this kind share.
    family: String,
    /// What distinguishes it from others of the kind; `None` if the rig file accepts any.
    serial: Option<String>,
    is_mock: bool,
}

impl Identity {
    /// The identity of the projector of a rig file.
    pub fn of(backend: &ProjectorBackend) -> Self {
        let or_any = |s: &Option<String>| s.clone().unwrap_or_else(|| "any".into());
        let (what, family, serial) = match backend {
            ProjectorBackend::Mock(_) => ("mock projector".into(), "mock projector".into(), None),
            ProjectorBackend::Usb(usb) => {
                let family = format!("USB projector {:04x}:{:04x}", usb.vendor_id, usb.product_id);
                (format!("{family} {}", or_any(&usb.serial_number)), family, usb.serial_number.clone())
            }
            ProjectorBackend::Serial(port) => {
                ("projector on ".to_owned() + &port.port, "projector on".into(), Some(port.port.clone()))
            }
            ProjectorBackend::Display(display) => {
                let name = or_any(&display.connector);
                (format!("display {name}"), "display".into(), display.connector.clone())
            }
            ProjectorBackend::Window(_) => ("window".into(), "window".into(), None),
            ProjectorBackend::Alp(alp) => {
                let number = Some(alp.device_number).filter(|n| *n > 0).map(|n| n.to_string());
                (format!("ALP {}", or_any(&number)), "ALP".into(), number)
            }
            // It is identified by its place on the bus, which changes with every re-plug, so an order for one applies
            // to all.
            ProjectorBackend::Dlpc900(dlpc) => {
                (format!("DLPC900 {}", or_any(&dlpc.device)), "DLPC900".into(), None)
            }
        };
        Self {
            what,
            family: plain(&family),
            serial: serial.as_deref().map(plain),
            is_mock: matches!(backend, ProjectorBackend::Mock(_)),
        }
    }

    /// Its name in messages.
    pub fn what(&self) -> &str {
        &self.what
    }

    /// True for the projector inside this process, which emits no light.
    pub fn is_mock(&self) -> bool {
        self.is_mock
    }

    /// Name of its lock file.
    pub fn lock_name(&self) -> String {
        short(&plain(&self.what)) + ".lock"
    }

    /// Name of the file of its standing order.
    pub(crate) fn order_name(&self) -> String {
        short(&format!("{}-{}", self.family, self.serial.as_deref().unwrap_or("any"))) + ENDING
    }

    /// True if an order in the file `name` applies to this projector: its own file; the file for any projector of the
    /// kind; and, if the rig file accepts any projector of the kind, the file of each of them.
    fn is_meant_by(&self, name: &str) -> bool {
        let any = short(&format!("{}-any", self.family)) + ENDING;
        name == self.order_name()
            || name == any
            || self.serial.is_none()
                && name.ends_with(ENDING)
                && name.starts_with(&(self.family.clone() + "-"))
    }
}

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.what)
    }
}

/// The letters and digits of `text`, with dashes in place of everything else.
fn plain(text: &str) -> String {
    text.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect()
}

/// Returns `stem` if it can be a file name, else its beginning and a hash of the whole (FNV-1a).
fn short(stem: &str) -> String {
    if stem.len() <= MAX_STEM {
        return stem.to_owned();
    }
    let hash =
        stem.bytes().fold(0xcbf2_9ce4_8422_2325u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3));
    format!("{}-{hash:016x}", &stem[..MAX_STEM])
}

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
        }
    }
}

/// Content of the file.
#[derive(serde::Serialize, serde::Deserialize)]
struct Content {
    version: u32,
    order: String,
    at: String,
    by: String,
    process: u32,
    projector: String,
}

/// An order that stands when a run starts: the rig comes up and does not arm.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Stands {
    /// BLACK or SAFE.
    pub order: Order,
    /// Since when, and by whom; or why it counts as SAFE.
    pub told: String,
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

    fn remove(&self, name: &str) -> Result<(), FolderError> {
        Self::remove(self, name)
    }
}

/// The file of one projector.
#[derive(Debug)]
pub struct OrderFile {
    identity: Identity,
    folder: Option<Box<dyn StateFolder>>,
    path: PathBuf,
}

impl OrderFile {
    /// Opens the state folder `path`, creates it if it is missing, and reads what stands for `identity`. The second
    /// part of the result says why a folder cannot be used; the file then keeps nothing.
    pub fn open(path: Option<PathBuf>, identity: Identity) -> (Self, Option<FolderError>, Option<Stands>) {
        let Some(path) = path else {
            let source =
                io::Error::new(io::ErrorKind::NotFound, "this user has no home directory; set DPM_STATE_DIR");
            let error = FolderError::Io { path: "(no state folder)".into(), source };
            return (Self { identity, folder: None, path: PathBuf::new() }, Some(error), None);
        };
        let stands = standing_in(&path, &identity);
        match Folder::make(&path, Owner::OwnOrAnyForRoot) {
            Ok(folder) => {
                let (file, error) = Self::in_folder(Box::new(folder), identity);
                (file, error, stands)
            }
            Err(e) => (Self { identity, folder: None, path }, Some(e), stands),
        }
    }

    /// The file in `folder`, if a trial shows that files can be written there.
    pub(crate) fn in_folder(folder: Box<dyn StateFolder>, identity: Identity) -> (Self, Option<FolderError>) {
        let path = folder.path().to_owned();
        let trial = format!(".trial-{}", std::process::id());
        match folder.replace(&trial, b"").and_then(|()| folder.remove(&trial)) {
            Ok(()) => (Self { identity, folder: Some(folder), path }, None),
            Err(e) => (Self { identity, folder: None, path }, Some(e)),
        }
    }

    /// The file in which orders for this projector are kept.
    pub(crate) fn path(&self) -> PathBuf {
        self.path.join(self.identity.order_name())
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
        let name = self.identity.order_name();
        let content = Content {
            version: VERSION,
            order: order.word().into(),
            at: utc(SystemTime::now()),
            by: by.to_string(),
            process: std::process::id(),
            projector: self.identity.what.clone(),
        };
        let text = serde_json::to_string(&content)
            .map_err(|e| FolderError::Io { path: folder.path().join(&name), source: e.into() })?;
        folder.replace(&name, (text + "\n").as_bytes())?;
        Ok(folder.path().join(name))
    }

    /// Forgets every order for this projector; that is on the disk when this returns. If nothing can be kept, there
    /// is nothing to forget.
    ///
    /// # Errors
    /// An error of the operating system; an order then still stands.
    pub(crate) fn forget(&self) -> Result<(), FolderError> {
        let Some(folder) = &self.folder else { return Ok(()) };
        for name in folder.names()? {
            if self.identity.is_meant_by(&name) {
                folder.remove(&name)?;
            }
        }
        Ok(())
    }
}

/// What stands for `identity` in the state folder `path`. A missing folder contains nothing. A folder that cannot be
/// read or trusted counts as SAFE, and so does a file that is damaged or has an unknown version.
pub fn standing_in(path: &Path, identity: &Identity) -> Option<Stands> {
    match Folder::open(path, Owner::OwnOrAnyForRoot) {
        Ok(folder) => standing_in_folder(&folder, identity),
        Err(e) if e.is_missing() => None,
        Err(e) => Some(unreadable(&e)),
    }
}

/// The same for a folder that is open.
pub(crate) fn standing_in_folder(folder: &dyn StateFolder, identity: &Identity) -> Option<Stands> {
    let names = match folder.names() {
        Ok(names) => names,
        Err(e) => return Some(unreadable(&e)),
    };
    let mine = names.iter().filter(|name| identity.is_meant_by(name));
    mine.map(|name| read(folder, name)).max_by_key(|stands| stands.order.strength())
}

fn unreadable(e: &FolderError) -> Stands {
    let told = format!("counts as SAFE, because the state folder cannot be read: {e}");
    Stands { order: Order::Safe, told }
}

fn read(folder: &dyn StateFolder, name: &str) -> Stands {
    stands_in(
        folder.read(name, MAX_BYTES).map_err(|e| e.to_string()),
        &folder.path().join(name).display().to_string(),
    )
}

/// What the bytes of a file say, or why there are none. `path` is its name in messages.
#[doc(hidden)]
pub fn stands_in(bytes: Result<Vec<u8>, String>, path: &str) -> Stands {
    let parsed = bytes.and_then(|bytes| {
        let content: Content = serde_json::from_slice(&bytes).map_err(|e| format!("damaged: {e}"))?;
        if content.version != VERSION {
            return Err(format!("version {} is not known", content.version));
        }
        match Order::from_word(&content.order) {
            Some(Order::Arm) | None => Err(format!("damaged: {:?} is not a standing order", content.order)),
            Some(order) => Ok((order, content)),
        }
    });
    match parsed {
        Ok((order, content)) => {
            let held = if order == Order::Freeze {
                " (FREEZE of a run that died: no frame is left to hold)"
            } else {
                ""
            };
            let clean = |text: &str| text.chars().filter(|c| !c.is_control()).take(200).collect::<String>();
            Stands {
                order: if order == Order::Safe { Order::Safe } else { Order::Black },
                told: format!("since {}, ordered by {}{held}", clean(&content.at), clean(&content.by)),
            }
        }
        Err(reason) => Stands {
            order: Order::Safe,
            told: format!("counts as SAFE, because {path} cannot be read: {reason}"),
        },
    }
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
#[path = "standing_tests.rs"]
mod tests;
