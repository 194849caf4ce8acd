//! A display that an X server lends, by RandR 1.6.
//!
//! The server forgets the name of a lease when the program's connection closes, and the lease itself when its last descriptor
//! does: the guardian of a killed run keeps it.

use std::os::fd::{AsFd, OwnedFd};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use rustix::event::{poll, PollFd, PollFlags};
use rustix::net::SocketAddrUnix;
use x11rb::connection::{Connection as _, RequestConnection as _};
use x11rb::cookie::Cookie;
use x11rb::errors::{ConnectionError, ReplyError, ReplyOrIdError};
use x11rb::protocol::randr::{self, ConnectionExt as _};
use x11rb::protocol::xproto::{AtomEnum, ConnectionExt as _};
use x11rb::protocol::ErrorKind;
use x11rb::reexports::x11rb_protocol::parse_display::{parse_display, ConnectAddress};
use x11rb::reexports::x11rb_protocol::xauth::get_auth;
use x11rb::rust_connection::{DefaultStream, PollMode, RustConnection, Stream};
use x11rb::utils::RawFdContainer;
use x11rb::x11_utils::TryParse;

use super::names::{find, X11Output};
use super::socket::{connect_to, left};
use super::{Lease, LeaseRefusal};
use crate::card::connector_names;

#[cfg(test)]
mod tests;

/// How long the server may need to take a lease back. Later it does when the descriptor is closed.
const BACK_PATIENCE: Duration = Duration::from_millis(500);

/// The server's name in messages.
pub(super) fn name() -> String {
    std::env::var("DISPLAY").map_or_else(|_| "the X server".into(), |name| format!("the X server {name:?}"))
}

/// Asks the X server of the variable `DISPLAY` for `connector`, or for the only one that has a display and shows no desktop.
///
/// # Errors
/// Why it lends none, and what to do.
pub(super) fn lease(connector: Option<&str>, lender: String, until: Instant) -> Result<Lease, LeaseRefusal> {
    let display = parse_display(None).map_err(|e| {
        LeaseRefusal::new(format!("DISPLAY names none ({e}); set it as in a terminal of the desktop"))
    })?;
    let mut answer = Err(LeaseRefusal::new(
        "it runs on another machine, and no display of that one can be lent to this one; log in at this machine",
    ));
    for address in display.connect_instruction() {
        let ConnectAddress::Socket(path) = address else { continue };
        answer = connect(&path, display.display, until);
        if answer.is_ok() {
            break;
        }
    }
    lease_of(answer?, usize::from(display.screen), connector, &connector_names(), lender)
}

fn connect(path: &str, display: u16, until: Instant) -> Result<Server, LeaseRefusal> {
    // Servers listen at both of these, if the folder can be written at all.
    let abstract_name = SocketAddrUnix::new_abstract_name(path.as_bytes());
    let addresses = [abstract_name, SocketAddrUnix::new(path)];
    let mut answer = Err(rustix::io::Errno::NOENT);
    for address in addresses.into_iter().flatten() {
        answer = connect_to(&address, until);
        if answer.is_ok() {
            break;
        }
    }
    let does_not = |e: &dyn std::fmt::Display| {
        LeaseRefusal::new(format!(
            "it does not answer ({e}); is the desktop running, and is DISPLAY its own?"
        ))
    };
    let stream = answer.map_err(|e| does_not(&e))?;
    let (stream, (family, peer)) = DefaultStream::from_unix_stream(stream).map_err(|e| does_not(&e))?;
    // Without a key the server itself says whether it wants one.
    let (key, value) = get_auth(family, &peer, display).ok().flatten().unwrap_or_default();
    let stream = BoundedStream::new(stream, until);
    RustConnection::connect_to_stream_with_auth_info(stream, 0, key, value).map_err(|e| does_not(&e))
}

/// A connection whose waits end.
type Server = RustConnection<BoundedStream>;

/// A stream that is never waited for after a limit.
pub(super) struct BoundedStream {
    stream: DefaultStream,
    start: Instant,
    /// The limit, in nanoseconds from the start.
    limit_ns: AtomicU64,
}

impl BoundedStream {
    pub(super) fn new(stream: DefaultStream, until: Instant) -> Self {
        let bounded = Self { stream, start: Instant::now(), limit_ns: AtomicU64::new(0) };
        bounded.wait_until(until);
        bounded
    }

    fn wait_until(&self, until: Instant) {
        let ns = until.saturating_duration_since(self.start).as_nanos();
        self.limit_ns.store(u64::try_from(ns).unwrap_or(u64::MAX), Ordering::Relaxed);
    }
}

impl Stream for BoundedStream {
    fn poll(&self, mode: PollMode) -> std::io::Result<()> {
        let mut flags = PollFlags::empty();
        flags.set(PollFlags::IN, mode.readable());
        flags.set(PollFlags::OUT, mode.writable());
        let until = self.start + Duration::from_nanos(self.limit_ns.load(Ordering::Relaxed));
        loop {
            let over = || std::io::Error::new(std::io::ErrorKind::TimedOut, "no answer in time");
            let left = left(until).ok_or_else(over)?;
            match poll(&mut [PollFd::from_borrowed_fd(self.stream.as_fd(), flags)], Some(&left)) {
                Ok(0) => return Err(over()),
                Ok(_) => return Ok(()),
                Err(rustix::io::Errno::INTR) => {}
                Err(e) => return Err(e.into()),
            }
        }
    }

    fn read(&self, buf: &mut [u8], fd_storage: &mut Vec<RawFdContainer>) -> std::io::Result<usize> {
        self.stream.read(buf, fd_storage)
    }

    fn write(&self, buf: &[u8], fds: &mut Vec<RawFdContainer>) -> std::io::Result<usize> {
        self.stream.write(buf, fds)
    }
}

/// Why the server has not answered as it must.
fn broken(error: impl Into<ReplyOrIdError>) -> LeaseRefusal {
    LeaseRefusal::new(match error.into() {
        ReplyOrIdError::X11Error(e) => {
            format!("it refuses {} of RandR: {:?}", e.request_name.unwrap_or("a request"), e.error_kind)
        }
        other => format!("it went away or does not answer: {other}"),
    })
}

/// What the server answers to a request.
fn answer<R: TryParse>(asked: Result<Cookie<'_, Server, R>, ConnectionError>) -> Result<R, LeaseRefusal> {
    asked.map_err(broken)?.reply().map_err(broken)
}

/// Asks the server that `server` is connected to. `kernel`: numbers and names of the kernel's connectors.
pub(super) fn lease_of(
    server: Server,
    screen: usize,
    connector: Option<&str>,
    kernel: &[(u32, String)],
    lender: String,
) -> Result<Lease, LeaseRefusal> {
    let Some(root) = server.setup().roots.get(screen).map(|screen| screen.root) else {
        return Err(LeaseRefusal::new(format!("it has no screen {screen}; correct DISPLAY")));
    };
    if server.extension_information(randr::X11_EXTENSION_NAME).map_err(broken)?.is_none() {
        return Err(LeaseRefusal::new("it has no extension RandR; use a bare console, or another server"));
    }
    let version = answer(server.randr_query_version(1, 6))?;
    let (major, minor) = (version.major_version, version.minor_version);
    if (major, minor) < (1, 6) {
        return Err(LeaseRefusal::new(format!(
            "it speaks RandR {major}.{minor}, and leases came with 1.6; use a newer server, or a bare console"
        )));
    }
    let resources = answer(server.randr_get_screen_resources_current(root))?;
    let outputs = outputs(&server, &resources)?;
    let output =
        choose(&outputs, connector, kernel).map_err(|(what, is_lent)| LeaseRefusal { what, is_lent })?;
    let mut crtcs = Vec::new();
    for crtc in &output.crtcs {
        let info = answer(server.randr_get_crtc_info(*crtc, resources.config_timestamp))?;
        if info.mode == 0 && info.outputs.is_empty() {
            crtcs.push(*crtc);
        }
    }
    let output = (output.id, output.name.clone());
    let (lid, descriptor) = create(&server, root, &output, &crtcs)?;
    Ok(Lease { descriptor, back: Box::new(X11Return { server, lid }), lender })
}

/// What the server's outputs are.
fn outputs(
    server: &Server,
    resources: &randr::GetScreenResourcesCurrentReply,
) -> Result<Vec<X11Output>, LeaseRefusal> {
    let property = answer(server.intern_atom(true, b"CONNECTOR_ID"))?.atom;
    let mut all = Vec::new();
    for id in &resources.outputs {
        let info = answer(server.randr_get_output_info(*id, resources.config_timestamp))?;
        // An atom that no driver has named is 0.
        let connector_id = if property == 0 {
            None
        } else {
            let asked = server.randr_get_output_property(*id, property, AtomEnum::ANY, 0, 1, false, false);
            let told = answer(asked)?;
            if told.format == 32 {
                told.data.first_chunk().map(|bytes| u32::from_ne_bytes(*bytes))
            } else {
                None
            }
        };
        all.push(X11Output {
            id: *id,
            name: String::from_utf8_lossy(&info.name).into_owned(),
            connector_id,
            is_connected: info.connection == randr::Connection::CONNECTED,
            crtc: info.crtc,
            crtcs: info.crtcs,
        });
    }
    Ok(all)
}

/// The output to ask for, or why there is none, and whether somebody may give it back soon.
fn choose<'a>(
    outputs: &'a [X11Output],
    connector: Option<&str>,
    kernel: &[(u32, String)],
) -> Result<&'a X11Output, (String, bool)> {
    let listed = || {
        let names: Vec<&str> = outputs.iter().map(|output| output.name.as_str()).collect();
        if names.is_empty() {
            "none".into()
        } else {
            names.join(", ")
        }
    };
    let output = match connector {
        Some(name) => find(outputs, name, kernel).ok_or_else(|| {
            let what = format!(
                "none of its outputs ({}) is the kernel's connector {name}; `dpm display` lists connectors, `xrandr --prop` the \
                 outputs and their CONNECTOR_ID",
                listed()
            );
            (what, false)
        })?,
        None => {
            let mut free =
                outputs.iter().filter(|o| o.is_connected && o.crtc == 0 && !o.crtcs.is_empty());
            match (free.next(), free.next()) {
                (Some(one), None) => one,
                (None, _) => {
                    let what = format!(
                        "its desktop uses every output that has a display (outputs: {}); free the projector's: \
                         `xrandr --output NAME --off`",
                        listed()
                    );
                    // It may be on lease, which looks like no display.
                    return Err((what, true));
                }
                _ => {
                    let what = "several displays are free; write the projector's as projector.backend.connector";
                    return Err((what.into(), false));
                }
            }
        }
    };
    if output.crtc != 0 {
        let what = format!(
            "its desktop uses {0}; free it with `xrandr --output {0} --off`, or in the desktop's settings",
            output.name
        );
        return Err((what, false));
    }
    if output.crtcs.is_empty() {
        return Err((on_lease(&output.name), true));
    }
    Ok(output)
}

fn on_lease(output: &str) -> String {
    format!(
        "{output} is on lease to another program: end it. If a run was killed, its guardian keeps the lease for ten minutes at \
         most: end the process `dpm display guard`"
    )
}

/// Has a lease of `output` created with the first of `crtcs` that is not on lease itself.
fn create(
    server: &Server,
    root: u32,
    (output, name): &(u32, String),
    crtcs: &[u32],
) -> Result<(u32, OwnedFd), LeaseRefusal> {
    let mut refused = None;
    for crtc in crtcs {
        let lid = server.generate_id().map_err(broken)?;
        let asked = server.randr_create_lease(root, lid, &[*crtc], &[*output]).map_err(broken)?;
        match asked.reply() {
            Ok(reply) => return Ok((lid, reply.master_fd)),
            // A CRTC on lease looks like a free one.
            Err(ReplyError::X11Error(e)) if e.error_kind == ErrorKind::Access => {
                refused = Some(LeaseRefusal { what: on_lease(name), is_lent: true });
            }
            Err(ReplyError::X11Error(e)) => {
                return Err(LeaseRefusal::new(format!(
                    "it cannot lend {name} ({:?}): its driver or the kernel has no leases, or it does not drive the card now \
                     (another console); use a bare console",
                    e.error_kind
                )));
            }
            Err(e) => return Err(broken(e)),
        }
    }
    Err(refused.unwrap_or_else(|| {
        LeaseRefusal::new(format!(
            "no CRTC is free that can drive {name}: the desktop uses them all; switch another of its displays off"
        ))
    }))
}

/// Gives the lease back.
struct X11Return {
    server: Server,
    lid: u32,
}

impl Drop for X11Return {
    fn drop(&mut self) {
        self.server.stream().wait_until(Instant::now() + BACK_PATIENCE);
        let freed = self.server.randr_free_lease(self.lid, 1).map_err(ReplyError::from);
        // The answer is awaited: what was sent and not read is lost when the connection closes.
        let _: Result<(), ReplyError> = freed.and_then(|cookie| cookie.check());
    }
}
