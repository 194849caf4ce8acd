//! TI DLPC900 (LightCrafter 6500 / 9000 and relatives): shows patterns through the controller's HID commands.
//!
//! Reading order: [`command`] is the byte codec (`no_std`), [`lut`] the pattern table and its timing rules (`no_std`),
//! `image` the 24-plane image format, `sequence` the order in which the controller expects things, `video` the
//! patterns of a video signal, `driver` the interface for programs, `usb` the cable. Facts: TI DLPU018 (programmer's guide), DLPS037 (data sheet), DLPT028
//! (errata).

pub mod command;
#[cfg(feature = "std")]
pub mod driver;
#[cfg(feature = "std")]
mod error;
#[cfg(feature = "std")]
pub mod image;
pub mod lut;
#[cfg(feature = "std")]
mod port;
#[cfg(feature = "std")]
pub mod sequence;
#[cfg(feature = "std")]
mod status;
#[cfg(feature = "usb")]
pub mod usb;
#[cfg(feature = "std")]
pub mod video;
