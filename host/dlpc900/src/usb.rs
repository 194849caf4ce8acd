//! The cable of a DLPC900: HID reports as interrupt transfers of libusb.

use std::sync::Arc;
use std::time::{Duration, Instant};

use rusb::{Context, Device, DeviceHandle, Direction, TransferType, UsbContext};

use super::command::REPORT_BYTES;
use super::driver::{Dlpc900, Dlpc900Error, HidPort, PortError, SecondLine};
use dpm_device::usb_help::{node, node_of, remedy};

/// USB vendor, Texas Instruments.
pub const VENDOR: u16 = 0x0451;
/// USB product, DLPC900.
pub const PRODUCT: u16 = 0xc900;
/// The udev rule that lets the user at the seat open the device.
pub const UDEV_RULE: &str =
    r#"SUBSYSTEM=="usb", ATTR{idVendor}=="0451", ATTR{idProduct}=="c900", TAG+="uaccess""#;
/// Right after plugging in, the kernel may still use the interface.
const CLAIM_PATIENCE: Duration = Duration::from_millis(500);

/// Selects one of several controllers: bus and address as `lsusb` prints them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UsbPlace {
    /// Bus number.
    pub bus: u8,
    /// Device address.
    pub address: u8,
}

impl std::fmt::Display for UsbPlace {
    /// The device file.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&node(self.bus, self.address))
    }
}

/// Describes the controller at `place`: vendor, product, and the device file if it is known.
pub fn describe(place: Option<UsbPlace>) -> String {
    let at = place.map_or(String::new(), |p| format!(" at {p}"));
    format!("DLPC900 ({VENDOR:04x}:{PRODUCT:04x}){at}")
}

/// Opens the controller at `place`, the only one if `None`, and greets it.
///
/// # Errors
/// Those of the cable and of the controller.
pub fn open(place: Option<UsbPlace>) -> Result<Dlpc900<UsbHid>, Dlpc900Error> {
    let port = UsbHid::open(place);
    Dlpc900::new(port.map_err(|source| Dlpc900Error::Port { doing: describe(place), source })?)
}

impl std::str::FromStr for UsbPlace {
    type Err = &'static str;

    /// Reads `BUS:ADDRESS`.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let parts = text.split_once(':').and_then(|(b, a)| Some((b.parse().ok()?, a.parse().ok()?)));
        let (bus, address) = parts.ok_or("write it as BUS:ADDRESS, such as 3:12")?;
        Ok(Self { bus, address })
    }
}

/// An open DLPC900. Dropping it gives the interface back to the kernel's driver.
pub struct UsbHid {
    name: String,
    handle: Arc<DeviceHandle<Context>>,
    interface: u8,
    endpoint_out: u8,
    endpoint_in: u8,
}

impl std::fmt::Debug for UsbHid {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("UsbHid").field("interface", &self.interface).finish_non_exhaustive()
    }
}

fn error(e: rusb::Error) -> PortError {
    match e {
        rusb::Error::Timeout => PortError::Timeout,
        rusb::Error::NoDevice => PortError::Gone,
        rusb::Error::NotFound => PortError::NotFound,
        rusb::Error::Busy => PortError::Busy,
        rusb::Error::Access => PortError::Denied(format!(
            "put the line {UDEV_RULE} into /etc/udev/rules.d/70-dlpc900.rules, run `udevadm control --reload` and plug the device in again"
        )),
        other => PortError::Other(format!("{other}; {}", remedy(other))),
    }
}

/// The places of all DLPC900.
pub fn list() -> Result<Vec<UsbPlace>, PortError> {
    // Without USB there is no context, and certainly no device.
    let Ok(context) = Context::new() else { return Ok(Vec::new()) };
    let devices = context.devices().map_err(error)?;
    Ok(devices
        .iter()
        .filter(is_dlpc900)
        .map(|d| UsbPlace { bus: d.bus_number(), address: d.address() })
        .collect())
}

/// Looks whether a DLPC900 is there, at `place` if that is given, and opens none.
///
/// # Errors
/// [`PortError::NotFound`], or libusb's.
pub fn look(place: Option<UsbPlace>) -> Result<(), PortError> {
    let is_there = list()?.into_iter().any(|there| place.is_none_or(|place| place == there));
    is_there.then_some(()).ok_or(PortError::NotFound)
}

fn is_dlpc900(d: &Device<Context>) -> bool {
    d.device_descriptor().is_ok_and(|d| (d.vendor_id(), d.product_id()) == (VENDOR, PRODUCT))
}

/// The interface to use and its endpoints: of the HID interfaces with both endpoints, the one with the lowest number.
fn pick(device: &Device<Context>) -> Result<(u8, u8, u8), PortError> {
    let configuration =
        device.active_config_descriptor().or_else(|_| device.config_descriptor(0)).map_err(error)?;
    let mut found: Option<(u8, u8, u8)> = None;
    for interface in configuration.interfaces() {
        for setting in interface.descriptors().filter(|s| s.class_code() == 3 && s.setting_number() == 0) {
            let endpoint = |direction| {
                let mut all = setting.endpoint_descriptors();
                all.find(|e| e.transfer_type() == TransferType::Interrupt && e.direction() == direction)
                    .map(|e| e.address())
            };
            if let (Some(o), Some(i)) = (endpoint(Direction::Out), endpoint(Direction::In)) {
                if found.is_none_or(|f| interface.number() < f.0) {
                    found = Some((interface.number(), o, i));
                }
            }
        }
    }
    found.ok_or_else(|| {
        PortError::Other("the device has no HID interface with two interrupt endpoints".into())
    })
}

impl UsbHid {
    /// Opens the DLPC900 at `place`, or the first one found. The kernel's HID driver is detached while it is open.
    pub fn open(place: Option<UsbPlace>) -> Result<Self, PortError> {
        let Ok(context) = Context::new() else { return Err(PortError::NotFound) };
        let devices = context.devices().map_err(error)?;
        let here =
            |d: &Device<Context>| place.is_none_or(|p| (d.bus_number(), d.address()) == (p.bus, p.address));
        let device = devices.iter().find(|d| is_dlpc900(d) && here(d)).ok_or(PortError::NotFound)?;
        let (interface, endpoint_out, endpoint_in) = pick(&device)?;
        let handle = device.open().map_err(error)?;
        match handle.set_auto_detach_kernel_driver(true) {
            // Some systems have no kernel driver to detach.
            Ok(()) | Err(rusb::Error::NotSupported) => {}
            Err(e) => return Err(error(e)),
        }
        let start = Instant::now();
        loop {
            match handle.claim_interface(interface) {
                Ok(()) => break,
                Err(rusb::Error::NotFound) if start.elapsed() < CLAIM_PATIENCE => {
                    std::thread::sleep(Duration::from_millis(10));
                }
                Err(e) => return Err(error(e)),
            }
        }
        let name = format!("DLPC900 ({VENDOR:04x}:{PRODUCT:04x}) at {}", node_of(&device));
        Ok(Self { name, handle: Arc::new(handle), interface, endpoint_out, endpoint_in })
    }
}

/// The same open device for another thread. libusb's calls may come from any thread, and libusb submits a transfer to
/// the kernel before it waits for it.
struct UsbSecondLine {
    handle: Arc<DeviceHandle<Context>>,
    endpoint_out: u8,
}

impl SecondLine for UsbSecondLine {
    fn write_report(&mut self, report: &[u8; REPORT_BYTES], timeout: Duration) -> Result<(), PortError> {
        self.handle.write_interrupt(self.endpoint_out, report, timeout).map(|_| ()).map_err(error)
    }
}

impl HidPort for UsbHid {
    fn name(&self) -> &str {
        &self.name
    }

    fn second_line(&self) -> Option<Box<dyn SecondLine>> {
        Some(Box::new(UsbSecondLine { handle: Arc::clone(&self.handle), endpoint_out: self.endpoint_out }))
    }

    fn write_report(&mut self, report: &[u8; REPORT_BYTES], timeout: Duration) -> Result<(), PortError> {
        let write = |h: &DeviceHandle<Context>, e: u8| h.write_interrupt(e, report, timeout);
        let sent = match write(&self.handle, self.endpoint_out) {
            // A halted endpoint accepted nothing: clear it once and send again.
            Err(rusb::Error::Pipe) => {
                self.handle.clear_halt(self.endpoint_out).map_err(error)?;
                write(&self.handle, self.endpoint_out)
            }
            other => other,
        };
        match sent.map_err(error)? {
            REPORT_BYTES => Ok(()),
            n => Err(PortError::Other(format!("only {n} of {REPORT_BYTES} bytes were taken"))),
        }
    }

    fn read_report(&mut self, report: &mut [u8; REPORT_BYTES], timeout: Duration) -> Result<(), PortError> {
        report.fill(0);
        let n = match self.handle.read_interrupt(self.endpoint_in, report, timeout) {
            Err(rusb::Error::Pipe) => {
                self.handle.clear_halt(self.endpoint_in).map_err(error)?;
                self.handle.read_interrupt(self.endpoint_in, report, timeout)
            }
            other => other,
        };
        match n.map_err(error)? {
            0 => Err(PortError::Other("an empty report came in".into())),
            _ => Ok(()),
        }
    }
}

impl Drop for UsbHid {
    fn drop(&mut self) {
        // Returns the interface; if the device is gone, there is nothing to return.
        let _ = self.handle.release_interface(self.interface);
    }
}
