//! `hil-mock serve serial`: a serial pose stream on a port or a new pseudo-terminal.

use super::bodies::{clock_from_now, TrackerArguments};
use super::{cannot_open, say};
use clap::Args;
use hil_mock::serial_server::{pseudo_terminal, SerialPoseDevice, SerialPoseHost};
use std::error::Error;
use std::time::{Duration, Instant};

/// Arguments of `hil-mock serve serial`.
#[derive(Args)]
pub(crate) struct SerialArguments {
    /// Serial port to serve on; without it a pseudo-terminal is made and its path printed
    #[arg(long)]
    port: Option<String>,
    /// Bits per second
    #[arg(long, default_value_t = 921_600)]
    baud: u32,
    #[command(flatten)]
    tracker: TrackerArguments,
}

/// Serves until the time is over or the port fails.
pub(super) fn run(arguments: &SerialArguments) -> Result<(), Box<dyn Error>> {
    let (names, source) = arguments.tracker.source()?;
    let (port, path, _other_end) = match &arguments.port {
        Some(path) => {
            let port = dpm_device::tty::open(path, arguments.baud);
            (port.map_err(|e| cannot_open(path, &e))?, path.clone(), None)
        }
        None => {
            let (port, path, other_end) = pseudo_terminal()?;
            (port, path, Some(other_end))
        }
    };
    let host = SerialPoseHost::start(SerialPoseDevice::new(source)?, port, clock_from_now())?;
    say(format_args!("serial pose stream on {path}"));
    for (number, name) in names.iter().enumerate() {
        say(format_args!("  body {number}: {name}"));
    }
    let started = Instant::now();
    while host.is_running() {
        if arguments.tracker.seconds.is_some_and(|s| started.elapsed().as_secs_f64() >= s) {
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    Err(format!("{path} failed: unplugged? Check cable and adapter").into())
}
