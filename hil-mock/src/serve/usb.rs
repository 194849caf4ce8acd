//! Serves a USB device model over USB/IP until stopped, with the scheduled faults of the cable.

use super::say;
use clap::Args;
use hil_mock::faults::{FaultKind, FaultPlan};
use hil_mock::usb_model::UsbDeviceModel;
use hil_mock::usb_plug::{monotonic_clock, Clock, UsbPlug};
use hil_mock::usbip::{Export, Server};
use std::error::Error;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Arguments of every USB device that is served.
#[derive(Args)]
pub(super) struct UsbArguments {
    /// Serve over USB/IP on this address
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:3240")]
    usbip: SocketAddr,
    /// Stop after this many seconds
    #[arg(long, value_parser = super::seconds)]
    pub(super) seconds: Option<f64>,
    /// Faults of the cable: unplug and stall with a window, slow with a duration, such as `unplug@5s+1s,slow=2ms`
    #[arg(long, value_name = "PLAN", default_value = "")]
    faults: FaultPlan,
}

/// Interval between checks of the plan.
const TICK: Duration = Duration::from_millis(2);

/// Serves `model` until the time is over. `look` is called every 2 ms with the model's clock.
pub(super) fn offer(
    arguments: &UsbArguments,
    name: &str,
    model: Arc<Mutex<dyn UsbDeviceModel>>,
    look: impl FnMut(&dyn Fn() -> dpm_device::time::HostTime),
) -> Result<(), Box<dyn Error>> {
    offer_by(arguments, name, model, monotonic_clock(), look)
}

/// The same by a given clock.
pub(super) fn offer_by(
    arguments: &UsbArguments,
    name: &str,
    model: Arc<Mutex<dyn UsbDeviceModel>>,
    clock: Clock,
    mut look: impl FnMut(&dyn Fn() -> dpm_device::time::HostTime),
) -> Result<(), Box<dyn Error>> {
    let plan = &arguments.faults;
    plan.check_supported(&[FaultKind::Unplug, FaultKind::Stall, FaultKind::Slow], "a USB cable")?;
    let new_plug = || UsbPlug::new(model.clone(), clock.clone());
    let export = |plug: &UsbPlug| vec![Export::new("1-1", Arc::new(plug.clone()))];
    let mut plug = new_plug();
    let server = Server::start(arguments.usbip, export(&plug))
        .map_err(|e| super::cannot_serve("USB/IP", arguments.usbip, &e, "--usbip"))?;
    say(format_args!("{name} over USB/IP on {}, bus id 1-1", server.address()));
    say(format_args!("  on the machine that is to see it: modprobe vhci-hcd; usbip attach -r HOST -b 1-1"));
    let mut out = false;
    let mut before = clock().0;
    loop {
        let now = clock();
        if arguments.seconds.is_some_and(|s| now.0 as f64 >= s * 1e9) {
            return Ok(());
        }
        match (plan.is_on(FaultKind::Unplug, now.0), out) {
            (true, false) => {
                server.set_exports(Vec::new());
                plug.unplug();
                say(format_args!("unplugged at {:.3} s", now.0 as f64 * 1e-9));
                out = true;
            }
            (false, true) => {
                plug = new_plug();
                server.set_exports(export(&plug));
                say(format_args!("plugged in at {:.3} s", now.0 as f64 * 1e-9));
                out = false;
            }
            _ => {}
        }
        if plan.is_on(FaultKind::Stall, now.0) {
            plug.hold_until(now.plus_ns(2 * TICK.as_nanos() as i64));
        }
        plug.set_delay_ns(plan.amount(FaultKind::Slow, before, now.0) as i64);
        before = now.0;
        look(&*clock);
        std::thread::sleep(TICK);
    }
}
