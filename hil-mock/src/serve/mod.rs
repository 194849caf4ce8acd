//! The devices that `hil-mock serve` offers: one module each.

mod bodies;
mod camera;
mod dlpc900;
mod lit_camera;
mod natnet;
mod orders;
mod projector;
mod pupil;
mod sensor_wand;
mod serial;
mod usb;
mod vrpn;

use clap::Subcommand;
use std::error::Error;
use std::fmt::Arguments;
use std::io::Write;

/// A mock device.
#[derive(Subcommand)]
pub(crate) enum Device {
    /// Camera before bodies with printed tags: pictures over TCP
    Camera(camera::CameraArguments),
    /// DLPC900 projector controller (LightCrafter 6500 / 9000): a USB HID device over USB/IP
    Dlpc900(dlpc900::Dlpc900Arguments),
    /// Bit-plane projector, what it lights, and a camera that sees that
    LitCamera(Box<lit_camera::LitCameraArguments>),
    /// OptiTrack NatNet server: poses over UDP
    Natnet(natnet::NatNetArguments),
    /// Bit-plane projector: a USB device over USB/IP, or on a serial port or pseudo-terminal
    Projector(projector::ProjectorArguments),
    /// Pupil Capture with eyes that look about: gaze over ZeroMQ
    Pupil(pupil::PupilArguments),
    /// Tracked wand with a light sensor in the beam of a bit-plane projector: projector, NatNet server and sensor in one
    SensorWand(Box<sensor_wand::SensorWandArguments>),
    /// Serial pose stream on a port or a pseudo-terminal
    Serial(serial::SerialArguments),
    /// VRPN server: poses over TCP
    Vrpn(vrpn::VrpnArguments),
}

/// Writes a line to the standard output. It is not an error if the reader is gone (`hil-mock serve ... | head`): the
/// device continues.
fn say(line: Arguments<'_>) {
    let _ = writeln!(std::io::stdout().lock(), "{line}");
}

/// Writes a line to the standard error stream, and ignores errors.
pub(crate) fn complain(line: Arguments<'_>) {
    let _ = writeln!(std::io::stderr().lock(), "{line}");
}

/// A finite time: not NaN, not infinite, not negative.
fn seconds(text: &str) -> Result<f64, String> {
    let s = text.parse().ok().filter(|s: &f64| (0.0..=1e9).contains(s));
    s.ok_or_else(|| "write seconds from 0 to 1e9".to_owned())
}

/// Why `what` cannot be served on `address`, and the remedy; `flag` chooses another port.
fn cannot_serve(what: &str, address: impl std::fmt::Display, e: &std::io::Error, flag: &str) -> String {
    use std::io::ErrorKind;
    let remedy = match e.kind() {
        ErrorKind::AddrInUse => format!(
            "another program, perhaps a second hil-mock, serves there already: end it, or choose another port with {flag}"
        ),
        ErrorKind::AddrNotAvailable => "this address is not one of this machine's: `ip address` lists them".into(),
        ErrorKind::PermissionDenied => format!("ports below 1024 need privilege: choose another with {flag}"),
        _ => "is the network interface up?".into(),
    };
    format!("cannot serve {what} on {address}: {e}; {remedy}")
}

/// Why a serial port cannot be opened, and the remedy.
fn cannot_open(path: &str, e: &serialport::Error) -> String {
    format!("cannot open {path}: {e}; {}", dpm_device::tty::refusal(e).remedy())
}

/// Runs `device` until it is stopped or fails.
pub(crate) fn run(device: Device) -> Result<(), Box<dyn Error>> {
    match device {
        Device::Camera(arguments) => camera::run(&arguments),
        Device::Dlpc900(arguments) => dlpc900::run(&arguments),
        Device::LitCamera(arguments) => lit_camera::run(&arguments),
        Device::Natnet(arguments) => natnet::run(&arguments),
        Device::Projector(arguments) => projector::run(&arguments),
        Device::Pupil(arguments) => pupil::run(&arguments),
        Device::SensorWand(arguments) => sensor_wand::run(&arguments),
        Device::Serial(arguments) => serial::run(&arguments),
        Device::Vrpn(arguments) => vrpn::run(&arguments),
    }
}

#[cfg(test)]
mod tests {
    use super::seconds;

    #[test]
    fn a_time_to_stop_after_comes() {
        assert_eq!((seconds("0"), seconds("2.5")), (Ok(0.0), Ok(2.5)));
        for endless in ["nan", "inf", "-1", "1e300", "x", ""] {
            assert!(seconds(endless).is_err(), "{endless}");
        }
    }
}
