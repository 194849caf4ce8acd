//! The devices that `hil-mock serve` offers: one module each.

mod bodies;
mod dlpc900;
mod natnet;
mod projector;
mod serial;
mod usb;
mod vrpn;

use clap::Subcommand;
use std::error::Error;

/// A mock device.
#[derive(Subcommand)]
pub enum Device {
    /// DLPC900 projector controller (LightCrafter 6500 / 9000): a USB HID device over USB/IP
    Dlpc900(dlpc900::Dlpc900Arguments),
    /// OptiTrack NatNet server: poses over UDP
    Natnet(natnet::NatNetArguments),
    /// Bit-plane projector: a USB device over USB/IP, or on a serial port or pseudo-terminal
    Projector(projector::ProjectorArguments),
    /// Serial pose stream on a port or a pseudo-terminal
    Serial(serial::SerialArguments),
    /// VRPN server: poses over TCP
    Vrpn(vrpn::VrpnArguments),
}

/// Why a serial port cannot be opened, and what to do about it.
fn cannot_open(path: &str, e: &serialport::Error) -> String {
    format!("cannot open {path}: {e}; {}", dpm_device::tty::refusal(e).remedy())
}

/// Runs `device` until it is stopped or fails.
pub fn run(device: Device) -> Result<(), Box<dyn Error>> {
    match device {
        Device::Dlpc900(arguments) => dlpc900::run(&arguments),
        Device::Natnet(arguments) => natnet::run(&arguments),
        Device::Projector(arguments) => projector::run(&arguments),
        Device::Serial(arguments) => serial::run(&arguments),
        Device::Vrpn(arguments) => vrpn::run(&arguments),
    }
}
