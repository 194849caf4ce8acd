//! The mock projector ([`dpm_mock::projector`]) with a USB plug.

pub mod usb;

pub use dpm_mock::projector::*;
