//! Opens a device by vendor, product and serial number. Errors name the remedy.

use std::time::{Duration, Instant};

use rusb::{Context, Device, DeviceHandle, UsbContext};

use super::{CONTROL_BYTES, CONTROL_DEPTH, PRODUCT_ID, REPLY_BYTES, REPLY_DEPTH, VENDOR_ID};
use crate::transport::TransportError;
use crate::usb_help::node_of;

/// The rule that lets the user at the machine open the reference device; `packaging/60-dpm.rules` contains it among
/// others.
pub const UDEV_RULE: &str = r#"SUBSYSTEM=="usb", ATTR{idVendor}=="1209", ATTR{idProduct}=="000d", GROUP="dpm", MODE="0660", TAG+="uaccess""#;

/// Right after hot-plug a device may not be ready to be claimed; claiming is retried for this long.
const CLAIM_PATIENCE: Duration = Duration::from_millis(200);

/// The device and its settings.
#[derive(Clone, Debug)]
pub struct UsbSettings {
    /// Vendor number.
    pub vendor_id: u16,
    /// Product number.
    pub product_id: u16,
    /// Serial number text; `None` takes the first device found.
    pub serial: Option<String>,
    /// Bytes of the largest frame on the wire, see [`crate::packet::packet_bytes`].
    pub frame_bytes: usize,
    /// Frames in flight, at least 1. One is on the cable while the others wait, so each additional one adds a frame of
    /// latency on a full link.
    pub depth: usize,
    /// An endpoint that moves nothing for this long, though it has something to carry, is cleared, nanoseconds.
    pub stuck_after_ns: i64,
}

impl UsbSettings {
    /// The reference device, two frames of `frame_bytes` in flight, one second of patience.
    pub fn new(frame_bytes: usize) -> Self {
        Self {
            vendor_id: VENDOR_ID,
            product_id: PRODUCT_ID,
            serial: None,
            frame_bytes,
            depth: 2,
            stuck_after_ns: 1_000_000_000,
        }
    }

    pub(super) fn describe(&self) -> String {
        let serial = self.serial.as_ref().map(|s| format!(" serial {s}")).unwrap_or_default();
        format!("USB projector {:04x}:{:04x}{serial}", self.vendor_id, self.product_id)
    }

    /// Frames in flight that usbfs has memory for, at least 1.
    pub(super) fn depth_within_limit(&self) -> usize {
        let others = CONTROL_DEPTH * CONTROL_BYTES + REPLY_DEPTH * REPLY_BYTES;
        match memory_limit_mb() {
            None | Some(0) => self.depth.max(1),
            // The limit applies to all devices of the machine together, so use only half of it.
            Some(mb) => {
                let bytes = ((mb as usize) << 20) / 2;
                self.depth.clamp(1, (bytes.saturating_sub(others) / self.frame_bytes.max(1)).max(1))
            }
        }
    }

    /// The setting to change if usbfs cannot hold the requested frames; `None` if it can.
    pub fn memory_advice(&self) -> Option<String> {
        let limit = memory_limit_mb().filter(|mb| *mb > 0)?;
        if self.depth_within_limit() >= self.depth {
            return None;
        }
        let needed = (2 * self.depth * self.frame_bytes).div_ceil(1 << 20) + 1;
        Some(format!(
            "{} frames of {} bytes need more than usbfs may hold ({limit} MB): \
             echo {needed} | sudo tee /sys/module/usbcore/parameters/usbfs_memory_mb, \
             or usbcore.usbfs_memory_mb={needed} on the kernel's command line",
            self.depth, self.frame_bytes
        ))
    }

    /// Looks whether the device is there and may be opened, and claims nothing.
    ///
    /// # Errors
    /// No USB, no such device, or no permission.
    pub fn look(&self) -> Result<(), TransportError> {
        self.find(&context(&self.describe())?).map(drop)
    }

    /// The open device with its interface claimed, and its name with the device file in it.
    pub(super) fn open_handle(
        &self,
        context: &Context,
    ) -> Result<(DeviceHandle<Context>, String), TransportError> {
        let (handle, name) = self.find(context)?;
        match claim(&handle) {
            Ok(()) => Ok((handle, name)),
            Err(e) => Err(TransportError::of_usb("claim the interface of", name, e)),
        }
    }

    /// The open device, and its name with the device file in it.
    fn find(&self, context: &Context) -> Result<(DeviceHandle<Context>, String), TransportError> {
        let name = self.describe();
        let devices = context.devices().map_err(|e| TransportError::of_usb("look for", name.clone(), e))?;
        let mut refused = None;
        for device in devices.iter() {
            let Ok(d) = device.device_descriptor() else { continue };
            if (d.vendor_id(), d.product_id()) != (self.vendor_id, self.product_id) {
                continue;
            }
            let name = format!("{name} at {}", node_of(&device));
            match self.try_open(&device) {
                Ok(Some(handle)) => return Ok((handle, name)),
                Ok(None) => {}
                Err(e) => refused = Some(TransportError::of_usb("open", name, e)),
            }
        }
        Err(refused.unwrap_or(TransportError::NotFound { device: name }))
    }

    /// `None` if it is another device of the same kind.
    fn try_open(&self, device: &Device<Context>) -> Result<Option<DeviceHandle<Context>>, rusb::Error> {
        let handle = device.open()?;
        if let Some(serial) = &self.serial {
            let d = device.device_descriptor()?;
            if handle.read_serial_number_string_ascii(&d)? != *serial {
                return Ok(None);
            }
        }
        Ok(Some(handle))
    }
}

fn claim(handle: &DeviceHandle<Context>) -> Result<(), rusb::Error> {
    match handle.set_auto_detach_kernel_driver(true) {
        Ok(()) | Err(rusb::Error::NotSupported) => {}
        Err(e) => return Err(e),
    }
    let start = Instant::now();
    loop {
        match handle.claim_interface(0) {
            Err(rusb::Error::NotFound) if start.elapsed() < CLAIM_PATIENCE => {
                std::thread::sleep(Duration::from_millis(10));
            }
            other => return other,
        }
    }
}

/// libusb, about to look for `name`.
pub(super) fn context(name: &str) -> Result<Context, TransportError> {
    Context::new().map_err(|e| TransportError::of_usb("start libusb to look for", name.to_owned(), e))
}

/// Megabytes of transfers that the kernel allows in flight on all devices together; 0 means no limit. `None` if the
/// kernel does not report it.
pub fn memory_limit_mb() -> Option<u32> {
    std::fs::read_to_string("/sys/module/usbcore/parameters/usbfs_memory_mb").ok()?.trim().parse().ok()
}
