//! A path of a serial port into the device behind it, and two devices into whether they are certainly different.

use dpm_common::unix::device_number;
use serde::{Deserialize, Serialize};
use std::fs;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};

/// A longer path of a device is none that this module can keep.
const MAX_PATH: usize = 300;

/// A device file as it is now.
#[derive(Clone, Copy, Debug)]
pub(super) struct DeviceFile {
    /// Major and minor number of the device.
    pub(super) number: [u32; 2],
    /// When the file was made, or when its owner or mode changed last: seconds and nanoseconds.
    pub(super) since: [i64; 2],
}

/// Where devices are looked for.
#[derive(Clone, Copy, Debug)]
pub(super) struct System {
    /// The folder that contains `dev` and `sys`. Tests make one of their own.
    pub(super) root: &'static str,
    /// Reads a device file. Tests have no right to make one.
    pub(super) node: fn(&Path) -> Option<DeviceFile>,
}

/// The machine that this program runs on.
pub(super) const THIS_MACHINE: System = System { root: "/", node: character_device };

fn character_device(file: &Path) -> Option<DeviceFile> {
    let about = fs::metadata(file).ok().filter(|about| about.file_type().is_char_device())?;
    Some(DeviceFile { number: device_number(&about), since: [about.ctime(), about.ctime_nsec()] })
}

/// The device behind the path of a serial port.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct SerialDevice {
    /// Its device file, without links on the way.
    file: String,
    number: [u32; 2],
    since: [i64; 2],
    /// Its folder in sysfs; a pseudo-terminal has none.
    place: Option<String>,
    usb: Option<Usb>,
}

/// A serial adapter on USB, or a device that is one.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Usb {
    vendor: String,
    product: String,
    serial: Option<String>,
    /// The socket, by the kernel's name for it.
    socket: String,
    /// Which of the adapter's ports it is: its interface, and its number in that interface where there are several.
    port: String,
}

impl System {
    /// The port at `path`; `None` if there is no device now.
    pub(super) fn port(&self, path: &str) -> Option<SerialDevice> {
        let root = Path::new(self.root);
        let at = path.strip_prefix('/').map_or_else(|| PathBuf::from(path), |below| root.join(below));
        let file = fs::canonicalize(at).ok()?;
        let DeviceFile { number, since } = (self.node)(&file)?;
        let [major, minor] = number;
        let folder = fs::canonicalize(root.join(format!("sys/dev/char/{major}:{minor}"))).ok();
        let usb = folder.as_deref().and_then(usb_above);
        let below_root = |path: &Path| {
            let below = path.strip_prefix(root).unwrap_or(path).to_str()?;
            (below.len() <= MAX_PATH).then(|| format!("/{below}"))
        };
        let place = folder.as_deref().and_then(below_root);
        Some(SerialDevice { file: below_root(&file)?, number, since, place, usb })
    }
}

/// What sysfs tells of the USB device to which the port with this folder belongs.
fn usb_above(folder: &Path) -> Option<Usb> {
    let text = |path: PathBuf| {
        let text = fs::read_to_string(path).ok()?.trim().chars().take(128).collect::<String>();
        (!text.is_empty()).then_some(text)
    };
    let device = folder.ancestors().find(|above| above.join("idVendor").is_file())?;
    let interface = folder.strip_prefix(device).ok()?.components().next()?;
    let interface = interface.as_os_str().to_string_lossy().rsplit(':').next()?.to_owned();
    let number = text(folder.join("device/port_number")).map(|number| format!(".{number}"));
    Some(Usb {
        vendor: text(device.join("idVendor"))?,
        product: text(device.join("idProduct"))?,
        serial: text(device.join("serial")),
        socket: device.file_name()?.to_string_lossy().into_owned(),
        port: interface + &number.unwrap_or_default(),
    })
}

impl Usb {
    /// Vendor, product, serial number and port; `None` without a serial number.
    fn numbers(&self) -> Option<String> {
        let Self { vendor, product, serial, port, .. } = self;
        serial.as_ref().map(|serial| format!("usb {vendor}:{product} {serial} {port}"))
    }
}

impl SerialDevice {
    /// What names it in files: of an adapter its numbers, or without a serial number its socket; of every other port
    /// its device file. Two devices may share a key one after the other, and cheap adapters may share it at once.
    pub(super) fn key(&self) -> String {
        let of_usb = |usb: &Usb| {
            let Usb { vendor, product, socket, port, .. } = usb;
            usb.numbers().unwrap_or_else(|| format!("usb {vendor}:{product} at {socket} {port}"))
        };
        self.usb.as_ref().map_or_else(|| self.file.clone(), of_usb)
    }

    /// What no other port has at the same time, whatever the path by which it is opened.
    pub(super) fn lock_key(&self) -> String {
        let [major, minor] = self.number;
        let of_usb = |usb: &Usb| format!("usb at {} {}", usb.socket, usb.port);
        self.usb.as_ref().map_or_else(|| format!("device {major}:{minor}"), of_usb)
    }

    /// What no other port will ever have: the numbers of an adapter, or this device file from when it was made.
    pub(super) fn instance(&self) -> String {
        let ([major, minor], [s, ns]) = (self.number, self.since);
        let numbers = self.usb.as_ref().and_then(Usb::numbers);
        numbers.unwrap_or_else(|| format!("{} {major}:{minor} {s}.{ns:09}", self.file))
    }

    /// True if this port, of an earlier order, is certainly another one than `now`. Only two facts prove that: both
    /// have serial numbers of USB that differ, or this port is still there and is not `now`. Neither a number nor a
    /// name proves it, because the kernel gives both anew; and a port that is gone may have come back as `now`.
    pub(super) fn is_certainly_not(&self, now: &Self, system: &System) -> bool {
        let numbers = |port: &Self| port.usb.as_ref().and_then(Usb::numbers);
        match (self.key() == now.key(), numbers(self), numbers(now)) {
            (true, ..) => false,
            (_, Some(_), Some(_)) => true,
            _ => self.number != now.number && self.is_still_there(system),
        }
    }

    /// True if the device file is the one of then, or belongs to the same port of this machine's board.
    fn is_still_there(&self, system: &System) -> bool {
        let is_fixed = self.usb.is_none() && self.place.as_ref().is_some_and(|p| !p.contains("/virtual/"));
        let is_same = |now: &Self| now.since == self.since || is_fixed && now.place == self.place;
        system.port(&self.file).is_some_and(|now| now.number == self.number && is_same(&now))
    }
}
