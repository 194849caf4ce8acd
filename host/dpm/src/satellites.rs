//! What stands beside the controller and brings a kind of device with it: a feature of Cargo, a line in [`register`], and its
//! command.

use clap::Subcommand;
use dpm_rig::failure::Failure;

/// Commands of satellites.
#[derive(Debug, Subcommand)]
pub(crate) enum SatelliteCommand {
    /// Control a DLPC900 projector (LightCrafter 6500 / 9000): status, patterns, rest
    #[cfg(feature = "dlpc900")]
    Dlpc900(dpm_dlpc900_rig::command::Dlpc900Args),
}

/// Adds the kinds of all satellites to the tables of the rig. To be called before a rig file is read.
pub fn register() {
    #[cfg(feature = "dlpc900")]
    dpm_dlpc900_rig::register();
}

/// Runs a command, and returns what it prints.
///
/// # Errors
/// Those of the command.
pub(crate) fn execute(command: &SatelliteCommand) -> Result<String, Failure> {
    match *command {
        #[cfg(feature = "dlpc900")]
        SatelliteCommand::Dlpc900(ref args) => dpm_dlpc900_rig::command::execute(args),
    }
}

/// What this program was built with: what it always has, and the features of Cargo that were asked for.
pub(crate) fn features() -> String {
    let chosen = [
        ("alp", cfg!(feature = "alp")),
        ("calibrate", cfg!(feature = "calibrate")),
        ("camera-files", cfg!(feature = "camera-files")),
        ("compressed", cfg!(feature = "compressed")),
        ("display", cfg!(feature = "display")),
        ("dlpc900", cfg!(feature = "dlpc900")),
        ("lab", cfg!(feature = "lab")),
        ("manual", cfg!(feature = "manual")),
        ("page", cfg!(feature = "page")),
        ("plots", cfg!(feature = "plots")),
        ("terminal", cfg!(feature = "terminal")),
        ("exr", cfg!(feature = "exr")),
        ("wayland", cfg!(feature = "wayland")),
        ("x11", cfg!(feature = "x11")),
        ("vendored-libusb", cfg!(feature = "vendored-libusb")),
    ];
    let always = ["usb", "serial", "net"];
    let chosen = chosen.into_iter().filter(|(_, is_there)| *is_there).map(|(name, _)| name);
    always.into_iter().chain(chosen).collect::<Vec<_>>().join(", ")
}
