//! `[projector.backend]` into what the projector is, as far as that is known before it is opened.

use super::port::{SerialDevice, System, THIS_MACHINE};
use super::ENDING;
use crate::projectors::{kinds, DeviceName, ProjectorBackend};
use std::fmt;

/// The longest file name without its extension. A longer one is cut and made unique by a hash.
const MAX_STEM: usize = 160;
/// How the name of a display begins that has told its serial number.
const EDID: &str = "edid-";
/// What comes between the name of a projector and the serial number that it gave in HELLO; no part of a name has it.
const AND_SERIAL: char = '+';
/// The family of all serial ports.
const SERIAL: &str = "projector on";

/// Identifies a projector: its name in locks, standing orders and messages.
#[derive(Clone, Debug)]
pub struct Identity {
    what: String,
    /// The part of the file names that all projectors of this kind share.
    family: String,
    /// What names it among others of the kind in files; `None` if the rig file accepts any.
    key: Option<String>,
    /// Names of its kind prove that two projectors differ.
    is_proof: bool,
    /// Of all kinds that video reaches, one may be another: a window is on the display at a connector, and a controller with
    /// a video input has a connection of its own.
    is_video: bool,
    /// The port behind a serial projector, if it is there now.
    port: Option<SerialDevice>,
    system: System,
    is_mock: bool,
}

/// To which projector an order was given, seen from another one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Match {
    /// To this one, or to one that cannot be told from it.
    Same,
    /// Perhaps to this one: nothing proves the contrary.
    Doubtful,
    /// To another one.
    Other,
}

impl Identity {
    /// The identity of the projector of a rig file.
    pub fn of(backend: &ProjectorBackend) -> Self {
        Self::on(THIS_MACHINE, backend)
    }

    /// The same on any machine.
    pub(super) fn on(system: System, backend: &ProjectorBackend) -> Self {
        let DeviceName { family, named, connector, is_proof, is_lasting, is_single } = backend.device();
        let port = backend.port().and_then(|path| system.port(path));
        let display = connector.and_then(|connector| system.display(connector.as_deref()));
        let what = match &named {
            Some(name) => format!("{family} {name}"),
            None if is_single => family.clone(),
            None => format!("{family} any"),
        };
        let key = port.as_ref().map(SerialDevice::key).or(display).or(named.filter(|_| is_lasting));
        let is_video = backend.kind().is_video;
        Self { what, family, key, is_proof, is_video, port, system, is_mock: backend.is_mock() }
    }

    /// Its name in messages: as the rig file words it.
    pub fn what(&self) -> &str {
        &self.what
    }

    /// True for the projector inside this process, which emits no light.
    pub fn is_mock(&self) -> bool {
        self.is_mock
    }

    /// Name of its lock file.
    pub fn lock_name(&self) -> String {
        let of_port = self.port.as_ref().map(|port| format!("{SERIAL} {}", port.lock_key()));
        short(&plain(of_port.as_ref().unwrap_or(&self.what))) + ".lock"
    }

    /// True if its lock names the device itself, so that all users of this machine have to agree on who has it.
    pub fn is_one_device(&self) -> bool {
        self.port.is_some()
    }

    /// True if something proves that another device than this one is behind the port `now`.
    pub fn is_certainly_not(&self, now: &Self) -> bool {
        let ports = self.port.as_ref().zip(now.port.as_ref());
        ports.is_some_and(|(then, now)| then.is_certainly_not(now, &self.system))
    }

    /// Name of the file of its standing order. A projector that has told its serial number in HELLO has one of its own,
    /// which no order for another projector at the same port replaces.
    pub(crate) fn order_name(&self, device: Option<u64>) -> String {
        let serial = device.map_or(String::new(), |serial| format!("{AND_SERIAL}{serial:016x}"));
        self.stem() + &serial + ENDING
    }

    pub(super) fn stem(&self) -> String {
        short(&plain(&format!("{}-{}", self.family, self.key.as_deref().unwrap_or("any"))))
    }

    pub(super) fn port(&self) -> Option<&SerialDevice> {
        self.port.as_ref()
    }

    /// What an order of another projector calls this one once a person has armed it.
    pub(super) fn instance(&self) -> String {
        let named = || format!("{} {}", self.family, self.key.as_deref().unwrap_or("any"));
        self.port.as_ref().map_or_else(named, SerialDevice::instance)
    }

    /// Whether an order in the file `name` holds this projector. `projector` and `port`: those that the file names.
    /// Where nothing proves that they are another projector, it does.
    pub(super) fn is_meant_by(&self, name: &str, projector: &str, port: Option<&SerialDevice>) -> Match {
        let stem = name.strip_suffix(ENDING).unwrap_or(name);
        // Which serial number was told is for the content to say.
        let stem = stem.split(AND_SERIAL).next().unwrap_or(stem);
        let key_after = |family: &str| Some(stem.strip_prefix(&plain(family))?.strip_prefix('-')?.to_owned());
        let others = || kinds().into_iter().filter(|kind| kind.is_video && self.is_video);
        let Some(key) = key_after(&self.family).or_else(|| others().find_map(|kind| key_after(kind.name)))
        else {
            return Match::Other;
        };
        // Versions before 2 named a port by its path alone.
        let is_worded_alike = self.family == SERIAL && port.is_none() && projector == self.what;
        if stem == self.stem() || is_worded_alike {
            return Match::Same;
        }
        let is_edid = |key: &str| key.starts_with(EDID);
        let are_both_named = (self.is_proof && self.key.is_some() && key != "any")
            || self.key.as_deref().is_some_and(|own| is_edid(&plain(own)) && is_edid(&key));
        let mut ports = port.zip(self.port.as_ref()).into_iter();
        match are_both_named || ports.any(|(then, now)| then.is_certainly_not(now, &self.system)) {
            true => Match::Other,
            false => Match::Doubtful,
        }
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
