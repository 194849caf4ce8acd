//! TI DLPC900 (LightCrafter 6500 / 9000 and relatives): shows patterns through the controller's HID commands.
//!
//! Reading order: [`command`] is the byte codec, [`lut`] the pattern table and its timing rules,
//! [`image`] the 24-plane image format, [`sequence`] the order in which the controller expects things, [`video`] the
//! patterns of a video signal, [`driver`] the interface for programs, [`usb`] the cable. Facts: TI DLPU018 (programmer's guide), DLPS037 (data sheet), DLPT028
//! (errata).

pub mod command;
pub mod driver;
mod error;
pub mod image;
pub mod lut;
mod port;
pub mod sequence;
mod status;
pub mod usb;
pub mod video;
