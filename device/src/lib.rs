//! The far side of the cable.
//!
//! Wire formats (bit-plane link, DLPC900, NatNet, VRPN, serial poses) as `no_std` code that firmware can reuse, and behind the
//! features `usb`, `serial` and `net` the transports, projectors and trackers that speak them.
//!
//! Reading order: [`time`] and [`pose`] and [`planes`] are the vocabulary; [`tracker`] is where motion comes in.
//! **Only this crate knows bytes on a wire.** Nothing here knows about scenes, rendering or the GPU.
#![cfg_attr(not(feature = "std"), no_std)]

pub mod clock_map;
pub mod cobs;
pub mod dlpc900;
pub mod light;
pub mod link;
pub mod planes;
pub mod pose;
#[cfg(feature = "std")]
pub mod regular_file;
#[cfg(feature = "std")]
pub mod rng;
pub mod time;
#[cfg(feature = "std")]
pub mod tracker;
#[cfg(feature = "std")]
pub mod transport;
#[cfg(feature = "serial")]
pub mod tty;
#[cfg(feature = "usb")]
mod usb_help;
