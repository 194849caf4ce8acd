//! The mocks of [`dpm_mock`] for other programs, over USB/IP, pseudo-terminals, UDP and TCP, and mocks of devices that the
//! controller itself needs not: a TI DLPC900, Pupil Capture and a wand with a light sensor.
//!
//! Reading order: [`usb_model`] is a USB device, [`usb_plug`] its cable, [`usbip`] the cable to another kernel.

pub use dpm_mock::{
    camera, faults, hand, line_port, monotonic, motion, natnet_host, natnet_server, report_queue,
    serial_server, tracker, vrpn_host, vrpn_server,
};

pub mod dlpc900;
pub mod projector;
pub mod pupil;
pub mod sensor_wand;
pub mod usb_model;
pub mod usb_plug;
pub mod usbip;
