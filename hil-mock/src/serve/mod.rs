//! The devices that `hil-mock serve` offers: one module each.

mod bodies;
mod natnet;
mod vrpn;

use clap::Subcommand;
use std::error::Error;

/// A mock device.
#[derive(Subcommand)]
pub enum Device {
    /// OptiTrack NatNet server: poses over UDP
    Natnet(natnet::NatNetArguments),
    /// VRPN server: poses over TCP
    Vrpn(vrpn::VrpnArguments),
}

/// Runs `device` until it is stopped or fails.
pub fn run(device: Device) -> Result<(), Box<dyn Error>> {
    match device {
        Device::Natnet(arguments) => natnet::run(&arguments),
        Device::Vrpn(arguments) => vrpn::run(&arguments),
    }
}
