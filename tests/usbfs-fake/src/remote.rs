//! As a preloaded library: puts the devices of a USB/IP server on the bus.

use std::sync::{Arc, Mutex, Once};

use hil_mock::usbip::{list, RemoteCable};

use crate::bus::{plug_in, Options, Socket};

/// Devices stay plugged in for the life of the process.
static SOCKETS: Mutex<Vec<Socket>> = Mutex::new(Vec::new());

/// On the first call, attaches every device that the server named in `USBFS_FAKE_USBIP` exports. A failure is printed once:
/// a preloaded library has nobody to return it to. `USBFS_FAKE_DRIVER` names a kernel driver that holds every interface.
pub(crate) fn attach_from_environment() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let Ok(server) = std::env::var("USBFS_FAKE_USBIP") else { return };
        let kernel_driver = std::env::var("USBFS_FAKE_DRIVER").ok();
        let options = Options { kernel_driver, ..Options::default() };
        let attached = list(&server).and_then(|devices| {
            devices.iter().try_for_each(|d| {
                let cable = RemoteCable::import(&server, &d.bus_id)?;
                let socket = plug_in(Arc::new(cable), options.clone());
                crate::bus::lock(&SOCKETS).push(socket);
                Ok(())
            })
        });
        if let Err(e) = attached {
            eprintln!("usbfs-fake: USB/IP server {server}: {e}");
        }
    });
}
