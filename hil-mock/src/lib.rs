//! A projector and a tracker made of software: the same mock in-process, over USB/IP, pseudo-terminals and UDP.
//!
//! Reading order: [`motion`] is what truly happens, [`faults`] the one vocabulary of what goes wrong, [`tracker`] what a tracker
//! would report, [`projector`] what a projector makes of the packets it gets. All randomness comes from [`dpm_device::rng`], keyed by a seed; time is always an argument.

pub mod dlpc900;
pub mod faults;
pub mod monotonic;
pub mod motion;
mod motion_spec;
pub mod natnet_host;
pub mod natnet_server;
pub mod projector;
pub mod report_queue;
pub mod serial_server;
pub mod tracker;
pub mod usb_model;
pub mod usb_plug;
pub mod usbip;
pub mod vrpn_host;
pub mod vrpn_server;
