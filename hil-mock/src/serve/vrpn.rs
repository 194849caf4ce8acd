//! `hil-mock serve vrpn`: a running VRPN server.

use super::bodies::{clock_from_now, TrackerArguments};
use super::say;
use clap::Args;
use hil_mock::vrpn_host::VrpnHost;
use hil_mock::vrpn_server::{VrpnNames, VrpnReports};
use std::error::Error;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::time::{Duration, Instant};

/// Arguments of `hil-mock serve vrpn`.
#[derive(Args)]
pub(crate) struct VrpnArguments {
    /// Address to serve on
    #[arg(long, default_value = "127.0.0.1")]
    bind: Ipv4Addr,
    /// TCP and UDP port
    #[arg(long, default_value_t = 3883)]
    port: u16,
    /// Name of the tracker whose sensors are the bodies
    #[arg(long, default_value = "Tracker0")]
    name: String,
    /// Do not offer each body as a tracker of its own as well
    #[arg(long)]
    one_tracker: bool,
    #[command(flatten)]
    tracker: TrackerArguments,
}

/// Serves until the time is over or the socket fails.
pub(super) fn run(arguments: &VrpnArguments) -> Result<(), Box<dyn Error>> {
    let (bodies, source) = arguments.tracker.source()?;
    let names = VrpnNames { tracker: arguments.name.clone(), bodies, each_body: !arguments.one_tracker };
    let shown = names.clone();
    let address = SocketAddrV4::new(arguments.bind, arguments.port);
    let host = VrpnHost::start(names, VrpnReports::new(source)?, address, clock_from_now())
        .map_err(|e| super::cannot_serve("VRPN", address, &e, "--port"))?;
    say(format_args!("VRPN on {}, tracker {}", host.address(), shown.tracker));
    for (sensor, name) in shown.bodies.iter().enumerate() {
        say(format_args!("  sensor {sensor}: {name}"));
    }
    let started = Instant::now();
    while host.is_running() {
        if arguments.tracker.seconds.is_some_and(|s| started.elapsed().as_secs_f64() >= s) {
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    Err("the network socket failed".into())
}
