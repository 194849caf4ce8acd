//! A display that a Wayland compositor lends, by wp_drm_lease_device_v1.
//!
//! A compositor takes back what it has lent when the program's connection closes: a run that is killed leaves a display
//! without a signal, which no guardian can keep black.

use std::ffi::OsString;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::time::Instant;

use rustix::event::{poll, PollFd, PollFlags};
use rustix::net::SocketAddrUnix;
use wayland_client::backend::WaylandError;
use wayland_client::protocol::wl_callback::{self, WlCallback};
use wayland_client::protocol::wl_registry::{self, WlRegistry};
use wayland_client::{event_created_child, Connection, Dispatch, EventQueue, Proxy, QueueHandle};
use wayland_protocols::wp::drm_lease::v1::client::wp_drm_lease_connector_v1::{self, WpDrmLeaseConnectorV1};
use wayland_protocols::wp::drm_lease::v1::client::wp_drm_lease_device_v1::{
    self, WpDrmLeaseDeviceV1, EVT_CONNECTOR_OPCODE,
};
use wayland_protocols::wp::drm_lease::v1::client::wp_drm_lease_request_v1::WpDrmLeaseRequestV1;
use wayland_protocols::wp::drm_lease::v1::client::wp_drm_lease_v1::{self, WpDrmLeaseV1};

use super::socket::{connect_to, left};
use super::{Lease, LeaseRefusal};
use crate::card::connector_names_of;

#[cfg(test)]
mod tests;

/// The socket of the compositor that the environment names.
fn socket() -> Result<PathBuf, LeaseRefusal> {
    socket_of(std::env::var_os("WAYLAND_DISPLAY"), std::env::var_os("XDG_RUNTIME_DIR"))
}

fn socket_of(display: Option<OsString>, folder: Option<OsString>) -> Result<PathBuf, LeaseRefusal> {
    let path = PathBuf::from(display.unwrap_or_else(|| "wayland-0".into()));
    if path.is_absolute() {
        return Ok(path);
    }
    let unset = || {
        LeaseRefusal::new(
            "XDG_RUNTIME_DIR and WAYLAND_DISPLAY name none; set them as in a terminal of the desktop",
        )
    };
    Ok(PathBuf::from(folder.ok_or_else(unset)?).join(path))
}

/// The compositor's name in messages.
pub(super) fn name() -> String {
    socket().map_or_else(
        |_| "the Wayland compositor".into(),
        |at| format!("the Wayland compositor at {}", at.display()),
    )
}

/// Asks the compositor of the variable `WAYLAND_DISPLAY` for `connector`, or for the only one that it offers.
///
/// # Errors
/// Why it lends none, and what to do.
pub(super) fn lease(connector: Option<&str>, lender: String, until: Instant) -> Result<Lease, LeaseRefusal> {
    let does_not = |e: rustix::io::Errno| {
        LeaseRefusal::new(format!(
            "it does not answer ({e}); is the desktop running, and is WAYLAND_DISPLAY its own?"
        ))
    };
    let address = SocketAddrUnix::new(socket()?).map_err(does_not)?;
    lease_over(connect_to(&address, until).map_err(does_not)?, connector, lender, until)
}

/// What a compositor offers on one card.
#[derive(Default)]
struct Offers {
    device: Option<WpDrmLeaseDeviceV1>,
    /// A descriptor to look at the card with.
    card: Option<OwnedFd>,
    connectors: Vec<Offer>,
    is_complete: bool,
}

/// A connector that is offered.
struct Offer {
    proxy: WpDrmLeaseConnectorV1,
    name: String,
    id: Option<u32>,
}

impl Offer {
    /// The kernel's name, if the card may be looked at; else what the compositor calls it.
    fn kernel_name(&self, kernel: &[(u32, String)]) -> String {
        let known = kernel.iter().find(|(id, _)| self.id == Some(*id));
        known.map_or_else(|| self.name.clone(), |(_, name)| name.clone())
    }
}

/// What became of the request.
enum LeaseAnswer {
    Lent(OwnedFd),
    Refused,
}

/// What the compositor has said so far.
#[derive(Default)]
struct Answers {
    cards: Vec<Offers>,
    has_listed: bool,
    answer: Option<LeaseAnswer>,
}

/// Asks the compositor at the other end of `stream`.
pub(super) fn lease_over(
    stream: UnixStream,
    connector: Option<&str>,
    lender: String,
    until: Instant,
) -> Result<Lease, LeaseRefusal> {
    let connection = Connection::from_socket(stream)
        .map_err(|e| LeaseRefusal::new(format!("its socket cannot be used: {e}")))?;
    let mut queue = connection.new_event_queue();
    let handle = queue.handle();
    let mut heard = Answers::default();
    let registry = connection.display().get_registry(&handle, ());
    connection.display().sync(&handle, ());
    until_true(&connection, &mut queue, &mut heard, until, |heard| heard.has_listed)?;
    if heard.cards.is_empty() {
        return Err(LeaseRefusal::new(
            "it does not have the protocol wp_drm_lease_device_v1 (those of wlroots and of KDE do); use a bare console, or a \
             desktop under X11",
        ));
    }
    until_true(&connection, &mut queue, &mut heard, until, |heard| {
        heard.cards.iter().all(|c| c.is_complete)
    })?;
    let (device, wanted, name) = choose(&mut heard.cards, connector)?;
    let request = device.create_lease_request(&handle, ());
    request.request_connector(&wanted);
    let lease = request.submit(&handle, ());
    until_true(&connection, &mut queue, &mut heard, until, |heard| heard.answer.is_some())?;
    let Some(LeaseAnswer::Lent(descriptor)) = heard.answer.take() else {
        return Err(LeaseRefusal {
            what: format!(
                "it has refused {name}: another program may have it on lease, or the compositor does not drive the card now \
                 (another console); end that program, or use a bare console"
            ),
            is_lent: true,
        });
    };
    // Nobody reads its socket from here on: it shall have little to say.
    for card in heard.cards {
        card.connectors.iter().for_each(|offer| offer.proxy.destroy());
        card.device.iter().for_each(WpDrmLeaseDeviceV1::release);
    }
    let _ = connection.flush();
    Ok(Lease { descriptor, back: Box::new(WaylandReturn { connection, lease, _registry: registry }), lender })
}

/// The offer to ask for, with its card and the kernel's name.
fn choose(
    cards: &mut [Offers],
    connector: Option<&str>,
) -> Result<(WpDrmLeaseDeviceV1, WpDrmLeaseConnectorV1, String), LeaseRefusal> {
    let mut all = Vec::new();
    for card in cards {
        let kernel = card.card.take().map(connector_names_of).unwrap_or_default();
        let Some(device) = &card.device else { continue };
        all.extend(
            card.connectors
                .iter()
                .map(|offer| (device.clone(), offer.proxy.clone(), offer.kernel_name(&kernel))),
        );
    }
    let names = all.iter().map(|(.., name)| name.as_str()).collect::<Vec<_>>().join(", ");
    if all.is_empty() {
        // What another program has on lease is not offered.
        let what = "it offers no connector: a compositor keeps those that its desktop may use, and offers those that the kernel \
                    calls non-desktop, as a rule (docs/DISPLAY.md, \"On lease from a desktop\"); or another program has it \
                    on lease. Use a bare console, or a desktop under X11";
        return Err(LeaseRefusal { what: what.into(), is_lent: true });
    }
    let fits = |(.., name): &(_, _, String)| connector.is_none_or(|wanted| wanted == name);
    let mut fitting = all.into_iter().filter(fits);
    match (fitting.next(), fitting.next(), connector) {
        (Some(one), None, _) => Ok(one),
        (None, _, Some(wanted)) => Err(LeaseRefusal {
            what: format!(
                "it does not offer {wanted}, but {names}: its desktop uses it, or another program has it on lease; correct \
                 projector.backend.connector, or use a bare console, or a desktop under X11"
            ),
            is_lent: true,
        }),
        _ => Err(LeaseRefusal::new(format!("it offers {names}; write the projector's as projector.backend.connector"))),
    }
}

/// Reads what the compositor says until `is_enough`.
fn until_true(
    connection: &Connection,
    queue: &mut EventQueue<Answers>,
    heard: &mut Answers,
    until: Instant,
    is_enough: impl Fn(&Answers) -> bool,
) -> Result<(), LeaseRefusal> {
    let gone = |e: &dyn std::fmt::Display| {
        LeaseRefusal::new(format!("it went away, or does not keep to the protocol: {e}"))
    };
    loop {
        queue.dispatch_pending(heard).map_err(|e| gone(&e))?;
        if is_enough(heard) {
            return Ok(());
        }
        let mut flags = PollFlags::IN;
        match connection.flush() {
            Err(WaylandError::Io(e)) if e.kind() == std::io::ErrorKind::WouldBlock => flags |= PollFlags::OUT,
            other => other.map_err(|e| gone(&e))?,
        }
        let Some(reading) = queue.prepare_read() else { continue };
        let silent = || LeaseRefusal::new("it does not answer in time; is it busy, or stopped?");
        let left = left(until).ok_or_else(silent)?;
        match poll(&mut [PollFd::from_borrowed_fd(reading.connection_fd(), flags)], Some(&left)) {
            Ok(0) => return Err(silent()),
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            Err(e) => return Err(gone(&e)),
        }
        match reading.read() {
            Err(WaylandError::Io(e)) if e.kind() == std::io::ErrorKind::WouldBlock => {}
            other => drop(other.map_err(|e| gone(&e))?),
        }
    }
}

/// Gives the lease back, and keeps the connection until then.
struct WaylandReturn {
    connection: Connection,
    lease: WpDrmLeaseV1,
    _registry: WlRegistry,
}

impl Drop for WaylandReturn {
    fn drop(&mut self) {
        self.lease.destroy();
        let _ = self.connection.flush();
    }
}

impl Dispatch<WlRegistry, ()> for Answers {
    fn event(
        heard: &mut Self,
        registry: &WlRegistry,
        event: wl_registry::Event,
        (): &(),
        _: &Connection,
        handle: &QueueHandle<Self>,
    ) {
        if let wl_registry::Event::Global { name, interface, .. } = event {
            if interface == WpDrmLeaseDeviceV1::interface().name {
                let device = registry.bind(name, 1, handle, ());
                heard.cards.push(Offers { device: Some(device), ..Offers::default() });
            }
        }
    }
}

impl Dispatch<WlCallback, ()> for Answers {
    fn event(
        heard: &mut Self,
        _: &WlCallback,
        _: wl_callback::Event,
        (): &(),
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        heard.has_listed = true;
    }
}

impl Dispatch<WpDrmLeaseDeviceV1, ()> for Answers {
    fn event(
        heard: &mut Self,
        device: &WpDrmLeaseDeviceV1,
        event: wp_drm_lease_device_v1::Event,
        (): &(),
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        let Some(card) = heard.cards.iter_mut().find(|card| card.device.as_ref() == Some(device)) else {
            return;
        };
        match event {
            wp_drm_lease_device_v1::Event::DrmFd { fd } => card.card = Some(fd),
            wp_drm_lease_device_v1::Event::Connector { id } => {
                card.connectors.push(Offer { proxy: id, name: String::new(), id: None });
            }
            wp_drm_lease_device_v1::Event::Done => card.is_complete = true,
            // The card itself is withdrawn.
            wp_drm_lease_device_v1::Event::Released => (card.device, card.is_complete) = (None, true),
            _ => {}
        }
    }

    event_created_child!(Answers, WpDrmLeaseDeviceV1, [EVT_CONNECTOR_OPCODE => (WpDrmLeaseConnectorV1, ())]);
}

impl Dispatch<WpDrmLeaseConnectorV1, ()> for Answers {
    fn event(
        heard: &mut Self,
        connector: &WpDrmLeaseConnectorV1,
        event: wp_drm_lease_connector_v1::Event,
        (): &(),
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        let mut all = heard.cards.iter_mut().flat_map(|card| &mut card.connectors);
        let Some(offer) = all.find(|offer| offer.proxy == *connector) else { return };
        match event {
            wp_drm_lease_connector_v1::Event::Name { name } => offer.name = name,
            wp_drm_lease_connector_v1::Event::ConnectorId { connector_id } => offer.id = Some(connector_id),
            wp_drm_lease_connector_v1::Event::Withdrawn => {
                heard.cards.iter_mut().for_each(|card| card.connectors.retain(|o| o.proxy != *connector));
            }
            _ => {}
        }
    }
}

impl Dispatch<WpDrmLeaseRequestV1, ()> for Answers {
    fn event(
        _: &mut Self,
        _: &WpDrmLeaseRequestV1,
        _: <WpDrmLeaseRequestV1 as Proxy>::Event,
        (): &(),
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
    }
}

impl Dispatch<WpDrmLeaseV1, ()> for Answers {
    fn event(
        heard: &mut Self,
        _: &WpDrmLeaseV1,
        event: wp_drm_lease_v1::Event,
        (): &(),
        _: &Connection,
        _: &QueueHandle<Self>,
    ) {
        match event {
            wp_drm_lease_v1::Event::LeaseFd { leased_fd } => {
                heard.answer = Some(LeaseAnswer::Lent(leased_fd))
            }
            wp_drm_lease_v1::Event::Finished => heard.answer = Some(LeaseAnswer::Refused),
            _ => {}
        }
    }
}
