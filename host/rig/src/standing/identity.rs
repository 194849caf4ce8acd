//! `[projector.backend]` into what the projector is, as far as that is known before it is opened.

use super::port::{Port, System, THIS_MACHINE};
use super::ENDING;
use crate::config::ProjectorBackend;
use std::fmt;

/// The longest file name without its extension. A longer one is cut and made unique by a hash.
const MAX_STEM: usize = 160;
/// Families of which one may be another: a projector at a connector is shown on by a window too, and a DLPC900 is reached
/// by USB and by its video input.
const VIDEO: [&str; 3] = ["display", "window", "DLPC900"];
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
    /// Names of its kind prove that two projectors differ. A serial number that the projector itself tells would be such
    /// a name.
    is_proof: bool,
    /// The port behind a serial projector, if it is there now.
    port: Option<Port>,
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
        let mut port = None;
        let (family, named, is_proof) = match backend {
            ProjectorBackend::Mock(_) => ("mock projector".into(), None, false),
            ProjectorBackend::Usb(usb) => {
                let family = format!("USB projector {:04x}:{:04x}", usb.vendor_id, usb.product_id);
                (family, usb.serial_number.clone(), true)
            }
            ProjectorBackend::Serial(serial) => {
                port = system.port(&serial.port);
                (SERIAL.into(), Some(serial.port.clone()), false)
            }
            ProjectorBackend::Display(display) => ("display".into(), display.connector.clone(), false),
            ProjectorBackend::Window(_) => ("window".into(), None, false),
            ProjectorBackend::Alp(alp) => {
                let number = Some(alp.device_number).filter(|n| *n > 0).map(|n| n.to_string());
                ("ALP".into(), number, true)
            }
            ProjectorBackend::Dlpc900(dlpc) => ("DLPC900".into(), dlpc.device.clone(), false),
        };
        let what = match (&named, backend) {
            (Some(name), _) => format!("{family} {name}"),
            (None, ProjectorBackend::Mock(_) | ProjectorBackend::Window(_)) => family.clone(),
            (None, _) => format!("{family} any"),
        };
        // The place of a DLPC900 on the bus changes with every re-plug.
        let named = named.filter(|_| family != "DLPC900");
        let key = port.as_ref().map(Port::key).or(named);
        let is_mock = matches!(backend, ProjectorBackend::Mock(_));
        Self { what, family, key, is_proof, port, system, is_mock }
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

    /// Name of the file of its standing order.
    pub(crate) fn order_name(&self) -> String {
        self.stem() + ENDING
    }

    pub(super) fn stem(&self) -> String {
        short(&plain(&format!("{}-{}", self.family, self.key.as_deref().unwrap_or("any"))))
    }

    pub(super) fn port(&self) -> Option<&Port> {
        self.port.as_ref()
    }

    /// What an order of another projector calls this one once a person has armed it.
    pub(super) fn instance(&self) -> String {
        let named = || format!("{} {}", self.family, self.key.as_deref().unwrap_or("any"));
        self.port.as_ref().map_or_else(named, Port::instance)
    }

    /// Whether an order in the file `name` holds this projector. `projector` and `port`: those that the file names.
    /// Where nothing proves that they are another projector, it does.
    pub(super) fn is_meant_by(&self, name: &str, projector: &str, port: Option<&Port>) -> Match {
        let key_after = |family: &str| {
            let stem = name.strip_suffix(ENDING)?;
            Some(stem.strip_prefix(&plain(family))?.strip_prefix('-')?.to_owned())
        };
        let is_video = VIDEO.contains(&&*self.family);
        let Some(key) = key_after(&self.family)
            .or_else(|| VIDEO.iter().filter(|_| is_video).find_map(|family| key_after(family)))
        else {
            return Match::Other;
        };
        // Versions before 2 named a port by its path alone.
        let is_worded_alike = self.family == SERIAL && port.is_none() && projector == self.what;
        if name == self.order_name() || is_worded_alike {
            return Match::Same;
        }
        let are_both_named = self.is_proof && self.key.is_some() && key != "any";
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
