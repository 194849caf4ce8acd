//! The integration tests of this crate, in one program: one link, one row of costs.

mod breadth;
mod dlpc900;
mod libusb;
mod link_usb;
mod link_usb_common;
mod link_usb_memory;
mod names;
