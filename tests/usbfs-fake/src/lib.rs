//! Turns calls of libusb on `/dev/bus/usb` and `/sys/bus/usb/devices` into transfers of USB device models, inside the process.
//!
//! The crate defines `open`, `opendir`, `ioctl`, `close`, `socket`, `bind`, `recvmsg` and `statfs`; linked into a test binary
//! (or preloaded), they stand before those of the C library. Calls that do not concern USB go straight to the kernel. What libusb
//! then sees is a bus of its own: sysfs files in a temporary folder, device files that answer the usbfs ioctls, and a socket that
//! carries hot-plug events. A libusb that was built with libudev, as distributions' are, finds the same bus behind libudev's names. No privilege, kernel module or virtual machine is needed.
//!
//! In a test: `let socket = usbfs_fake::plug_in(Arc::new(UsbPlug::new(model, clock)), Options::default());`. As a preloaded
//! library the variable `USBFS_FAKE_USBIP=host:port` names a USB/IP server whose devices appear on the bus.

mod bus;
mod file;
mod hooks;
mod remote;
mod udev;

pub use bus::{plug_in, set_memory_limit_mb, Options, Socket};
pub use hooks::{ioctls_on_frame_path, root_folder};
