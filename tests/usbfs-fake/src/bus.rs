//! The bus: which devices are plugged in, the sysfs files that describe them, and the hot-plug events.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use hil_mock::usb_model::interfaces;
use hil_mock::usb_plug::UsbCable;

use crate::file::OpenFile;
use crate::hooks;

/// How a device sits on the bus.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Kernel driver bound to every interface ("usbhid"); libusb must detach it before it can claim.
    pub kernel_driver: Option<String>,
    /// Opening the device for writing fails with "permission denied", as without a udev rule.
    pub denied: bool,
}

/// A device on the fake bus. Dropping it pulls the plug.
pub struct Socket {
    device: Arc<Device>,
}

impl Socket {
    /// Bus number, 1 to 255.
    pub fn bus_number(&self) -> u8 {
        self.device.bus
    }

    /// Device address on the bus, 1 to 127.
    pub fn address(&self) -> u8 {
        self.device.address
    }

    /// Pulls the plug: transfers in flight end with "no such device", then hot-plug listeners hear of it.
    pub fn unplug(&self) {
        self.device.unplug();
    }
}

impl Drop for Socket {
    fn drop(&mut self) {
        self.device.unplug();
    }
}

/// Who holds an interface.
#[derive(Clone, PartialEq, Eq)]
pub(crate) enum Holder {
    Kernel(String),
    File(u64),
}

/// One device of the bus.
pub(crate) struct Device {
    pub cable: Arc<dyn UsbCable>,
    pub descriptors: Vec<u8>,
    pub bus: u8,
    pub address: u8,
    options: Options,
    pub state: Mutex<DeviceState>,
}

#[derive(Default)]
pub(crate) struct DeviceState {
    pub holders: BTreeMap<u32, Holder>,
    pub configuration: u8,
    pub files: Vec<Arc<OpenFile>>,
    pub gone: bool,
}

/// Everything plugged in, by (bus, address).
static DEVICES: Mutex<BTreeMap<(u8, u8), Arc<Device>>> = Mutex::new(BTreeMap::new());
static ROOT: OnceLock<PathBuf> = OnceLock::new();
static NEXT: AtomicU64 = AtomicU64::new(0);
/// Bytes of all transfers in flight, and the most that usbfs allows (`usbfs_memory_mb`; 0 = no limit).
static IN_FLIGHT: AtomicU64 = AtomicU64::new(0);
static LIMIT: AtomicU64 = AtomicU64::new(16 << 20);

pub(crate) fn lock<T>(m: &Mutex<T>) -> MutexGuard<'_, T> {
    m.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The folder that stands for `/`; made on first use with the root hub in it, so that the bus is never empty.
pub(crate) fn root() -> &'static Path {
    ROOT.get_or_init(|| {
        hooks::keep_linked();
        let nanos =
            std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |d| d.as_nanos());
        let root = std::env::temp_dir().join(format!("usbfs-fake-{}-{nanos}", std::process::id()));
        let hub = [
            &[18u8, 1, 0, 2, 9, 0, 1, 64, 0x6b, 0x1d, 2, 0, 1, 6, 0, 0, 0, 1][..],
            &[9, 2, 25, 0, 1, 1, 0, 0xe0, 0, 9, 4, 0, 0, 1, 9, 0, 0, 0, 7, 5, 0x81, 3, 4, 0, 12],
        ]
        .concat();
        write_device(&root, "usb1", 1, 1, 480, &hub);
        let parameters = root.join("sys/module/usbcore/parameters");
        fs::create_dir_all(&parameters).expect("folder for the fake sysfs");
        fs::write(parameters.join("usbfs_memory_mb"), "16\n").expect("file in the fake sysfs");
        hooks::at_exit(|| {
            if let Some(root) = ROOT.get() {
                let _ = fs::remove_dir_all(root);
            }
        });
        root
    })
}

fn write_device(root: &Path, name: &str, bus: u8, address: u8, megabits: u32, descriptors: &[u8]) {
    // Complete before it can be seen: written aside, then renamed into place.
    let (devices, aside) = (root.join("sys/bus/usb/devices"), root.join("aside"));
    let folder = aside.join(name);
    let nodes = root.join(format!("dev/bus/usb/{bus:03}"));
    for d in [&devices, &folder, &nodes] {
        fs::create_dir_all(d).expect("folder for the fake sysfs");
    }
    let write =
        |file: &str, bytes: &[u8]| fs::write(folder.join(file), bytes).expect("file in the fake sysfs");
    write("busnum", format!("{bus}\n").as_bytes());
    write("devnum", format!("{address}\n").as_bytes());
    write("speed", format!("{megabits}\n").as_bytes());
    write("bConfigurationValue", b"1\n");
    write("descriptors", descriptors);
    fs::write(nodes.join(format!("{address:03}")), b"").expect("device file in the fake bus");
    fs::rename(&folder, devices.join(name)).expect("device folder in the fake sysfs");
}

/// Plugs a device in: its files appear, then the hot-plug event.
pub fn plug_in(cable: Arc<dyn UsbCable>, options: Options) -> Socket {
    let root = root();
    let descriptors = cable.descriptors();
    let mut devices = lock(&DEVICES);
    let (bus, address) = loop {
        let n = NEXT.fetch_add(1, Ordering::Relaxed);
        let place = ((2 + n / 127 % 254) as u8, (1 + n % 127) as u8);
        if !devices.contains_key(&place) {
            break place;
        }
    };
    let mut state = DeviceState { configuration: 1, ..DeviceState::default() };
    if let Some(driver) = &options.kernel_driver {
        let count = interfaces(&descriptors[18.min(descriptors.len())..]).len() as u32;
        state.holders = (0..count).map(|i| (i, Holder::Kernel(driver.clone()))).collect();
    }
    cable.set_configuration(1);
    let device = Arc::new(Device { cable, descriptors, bus, address, options, state: Mutex::new(state) });
    devices.insert((bus, address), device.clone());
    drop(devices);
    let megabits = device.cable.speed().megabits();
    write_device(root, &device.name(), bus, address, megabits, &device.descriptors);
    hooks::send_event(&device.event("add"));
    let for_unplug = Arc::downgrade(&device);
    device.cable.on_unplug(Box::new(move || {
        if let Some(d) = for_unplug.upgrade() {
            d.has_gone();
        }
    }));
    Socket { device }
}

/// Names of the devices on the bus, the root hub's among them, as sysfs has them.
pub(crate) fn device_names() -> Vec<String> {
    let folder = fs::read_dir(root().join("sys/bus/usb/devices"));
    folder.into_iter().flatten().flatten().filter_map(|e| e.file_name().into_string().ok()).collect()
}

/// Bus and address of the device with this name.
pub(crate) fn place_of(name: &str) -> Option<(u8, u8)> {
    let folder = root().join("sys/bus/usb/devices").join(name);
    let number = |file: &str| fs::read_to_string(folder.join(file)).ok()?.trim().parse().ok();
    Some((number("busnum")?, number("devnum")?))
}

/// Sets the limit that usbfs puts on the memory of all transfers in flight, in MiB (0 = none), and what `usbfs_memory_mb` reads.
pub fn set_memory_limit_mb(mb: u32) {
    LIMIT.store(u64::from(mb) << 20, Ordering::Relaxed);
    let file = root().join("sys/module/usbcore/parameters/usbfs_memory_mb");
    fs::write(file, format!("{mb}\n")).expect("file in the fake sysfs");
}

/// Reserves transfer memory; false when the limit forbids it.
pub(crate) fn reserve(bytes: usize) -> bool {
    let limit = LIMIT.load(Ordering::Relaxed);
    let before = IN_FLIGHT.fetch_add(bytes as u64, Ordering::Relaxed);
    let fits = limit == 0 || before + bytes as u64 <= limit;
    if !fits {
        release(bytes);
    }
    fits
}

/// Gives transfer memory back.
pub(crate) fn release(bytes: usize) {
    IN_FLIGHT.fetch_sub(bytes as u64, Ordering::Relaxed);
}

/// Opens the device file of (bus, address): the new descriptor, or the error number.
pub(crate) fn open_device(bus: u8, address: u8, writing: bool) -> Result<i32, i32> {
    let device = lock(&DEVICES).get(&(bus, address)).cloned().ok_or(libc::ENOENT)?;
    if device.options.denied && writing {
        return Err(libc::EACCES);
    }
    let file = OpenFile::open(device.clone())?;
    let mut state = lock(&device.state);
    if state.gone {
        return Err(libc::ENODEV);
    }
    state.files.push(file.clone());
    drop(state);
    let fd = file.fd();
    hooks::register(fd, file);
    Ok(fd)
}

impl Device {
    fn name(&self) -> String {
        format!("{}-{}", self.bus, self.address)
    }

    fn event(&self, action: &str) -> Vec<u8> {
        let (name, bus, address) = (self.name(), self.bus, self.address);
        let path = format!("/devices/fake/usb{bus}/{name}");
        format!(
            "{action}@{path}\0ACTION={action}\0DEVPATH={path}\0SUBSYSTEM=usb\0DEVTYPE=usb_device\0\
             BUSNUM={bus:03}\0DEVNUM={address:03}\0"
        )
        .into_bytes()
    }

    /// Writes the selected configuration where libusb reads it.
    pub(crate) fn note_configuration(&self, value: u8) {
        lock(&self.state).configuration = value;
        let file = root().join(format!("sys/bus/usb/devices/{}/bConfigurationValue", self.name()));
        let text = if value == 0 { String::new() } else { format!("{value}\n") };
        let _ = fs::write(file, text);
    }

    fn unplug(&self) {
        self.cable.unplug();
    }

    /// The cable is pulled and every transfer has ended.
    fn has_gone(&self) {
        let mut state = lock(&self.state);
        if std::mem::replace(&mut state.gone, true) {
            return;
        }
        let files = std::mem::take(&mut state.files);
        drop(state);
        let root = root();
        let _ = fs::remove_dir_all(root.join("sys/bus/usb/devices").join(self.name()));
        let _ = fs::remove_file(root.join(format!("dev/bus/usb/{:03}/{:03}", self.bus, self.address)));
        lock(&DEVICES).remove(&(self.bus, self.address));
        files.iter().for_each(|f| f.disconnect());
        hooks::send_event(&self.event("remove"));
    }

    /// Forgets a closed file and the interfaces it held.
    pub(crate) fn forget(&self, file: u64) {
        let mut state = lock(&self.state);
        state.holders.retain(|_, h| *h != Holder::File(file));
        state.files.retain(|f| f.id() != file);
    }
}
