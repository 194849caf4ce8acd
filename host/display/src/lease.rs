//! A display that a desktop lends: from what a rig file says and what runs on this machine to a card with one connector.
//!
//! The kernel lets the program that drives a graphics card lend a connector, and what drives it, to another program, as a
//! descriptor. An X server lends by RandR 1.6 ([`x11`]), a Wayland compositor by wp_drm_lease_device_v1 ([`wayland`]). With the
//! descriptor everything is as with a card of one's own.
//!
//! What was lent is kept while a display is unplugged, so that the desktop does not take it meanwhile. It is given back when
//! the opener is dropped.

use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use dpm_handoff::path::Lock;
use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType};

use crate::card::{let_go, open_for, Card};
use crate::kms::Kms;
use crate::scan_out::DisplayError;

#[cfg(test)]
#[path = "../tests/laws/common/compositor.rs"]
mod compositor;
pub mod names;
pub mod wayland;
pub mod x11;

/// How long a desktop may need for all of its answers.
pub const PATIENCE: Duration = Duration::from_secs(5);
/// How long a desktop may need to notice that a lease of a dead run has ended.
const RETURN_PATIENCE: Duration = Duration::from_secs(3);
/// Interval of such attempts.
const STEP: Duration = Duration::from_millis(100);

/// How a rig comes by its display.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// As the only program on the card, or, where another one drives it, as the desktop of the environment lends it.
    Auto,
    /// As the only program on the card.
    Alone,
    /// As a desktop lends it.
    Lent(Lender),
}

/// Kinds of desktops that lend displays.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lender {
    /// An X server, by RandR.
    X11,
    /// A Wayland compositor.
    Wayland,
}

impl Lender {
    /// The desktop that the environment names: the compositor first, because an Xwayland beside it drives no display.
    fn of_environment() -> Option<Self> {
        Self::of(&|name| std::env::var_os(name).is_some_and(|value| !value.is_empty()))
    }

    fn of(is_set: &dyn Fn(&str) -> bool) -> Option<Self> {
        let of = [("WAYLAND_DISPLAY", Self::Wayland), ("DISPLAY", Self::X11)];
        of.into_iter().find(|(name, _)| is_set(name)).map(|(_, lender)| lender)
    }
}

/// Why a desktop did not lend a display.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// What is wrong, and what to do.
    pub what: String,
    /// Somebody else may have it on lease, and give it back soon.
    pub is_lent: bool,
}

impl Refusal {
    fn new(what: impl Into<String>) -> Self {
        Self { what: what.into(), is_lent: false }
    }
}

/// A display on lease.
pub struct Lease {
    /// What the kernel knows it by.
    pub descriptor: OwnedFd,
    /// Gives it back when it is dropped.
    pub back: Box<dyn Send>,
    /// The lender's name in messages.
    pub lender: String,
}

/// What an opener has on lease, and from whom.
#[derive(Default)]
struct Held {
    lease: Option<Lease>,
    /// Who has lent it once.
    lender: Option<Lender>,
}

/// Opens the display at `connector` of `card` as `access` says. What is lent is kept between calls, and given back when the
/// function is dropped.
pub fn opener(
    card: Option<PathBuf>,
    connector: Option<String>,
    access: Access,
) -> impl Fn() -> Result<Box<dyn Kms>, DisplayError> + Send + Sync {
    let held = Lock::new(Held::default());
    move || {
        // Nothing is left half-done by a call that panicked.
        let mut held = held.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let (card, connector) = (card.as_deref(), connector.as_deref());
        // A desktop that shows another console drives no card for that time, and must find its own free when it returns.
        let lender = match access {
            Access::Auto => held.lender,
            Access::Alone => None,
            Access::Lent(lender) => Some(lender),
        };
        match lender
            .map_or_else(|| open_for(card, connector), |lender| lent(&mut held, lender, card, connector))
        {
            Err(alone @ (DisplayError::InUse(_) | DisplayError::Denied(_))) if access == Access::Auto => {
                let lender = Lender::of_environment().ok_or(alone)?;
                lent(&mut held, lender, card, connector)
            }
            other => other,
        }
    }
}

/// The card that `held` has on lease, or a new lease.
fn lent(
    held: &mut Held,
    lender: Lender,
    card: Option<&Path>,
    connector: Option<&str>,
) -> Result<Box<dyn Kms>, DisplayError> {
    if let Some(lease) = held.lease.take() {
        match taken(&lease, card) {
            Ok(card) if card.is_still_lent() => {
                held.lease = Some(lease);
                return Ok(Box::new(card));
            }
            _ => drop(lease),
        }
    }
    let lease = ask(lender, connector)?;
    let card = taken(&lease, card)?;
    *held = Held { lease: Some(lease), lender: Some(lender) };
    Ok(Box::new(card))
}

/// The card behind a lease, which must be `wanted` if that is named.
fn taken(lease: &Lease, wanted: Option<&Path>) -> Result<Card, DisplayError> {
    let source = |source| DisplayError::Call { doing: "use the lease", source };
    let card = Card::lent(lease.descriptor.try_clone().map_err(source)?, lease.lender.clone())?;
    match wanted.map(|path| std::fs::canonicalize(path).unwrap_or_else(|_| path.into())) {
        Some(path) if Path::new(&card.name()) != path => Err(DisplayError::Unlent {
            lender: lease.lender.clone(),
            what: format!(
                "it has {} of {}, and projector.backend.card is {}; correct that key, or leave it out",
                card.connector_names().join(", "),
                card.name(),
                path.display()
            ),
        }),
        _ => Ok(card),
    }
}

/// Asks a desktop for `connector`, and the guardian of a dead run before that, which may have it.
fn ask(lender: Lender, connector: Option<&str>) -> Result<Lease, DisplayError> {
    let name = match lender {
        Lender::X11 => x11::name(),
        Lender::Wayland => wayland::name(),
    };
    let limit = Instant::now() + if let_go(connector) { RETURN_PATIENCE } else { Duration::ZERO };
    loop {
        let until = Instant::now() + PATIENCE;
        let lent = match lender {
            Lender::X11 => x11::lease(connector, name.clone(), until),
            Lender::Wayland => wayland::lease(connector, name.clone(), until),
        };
        match lent {
            Ok(lease) => return Ok(lease),
            Err(refusal) if refusal.is_lent && Instant::now() < limit => std::thread::sleep(STEP),
            Err(refusal) => return Err(DisplayError::Unlent { lender: name, what: refusal.what }),
        }
    }
}

/// Connects to the socket `address` of a server that may have stopped to answer.
fn connect_to(address: &SocketAddrUnix, until: Instant) -> Result<UnixStream, Errno> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let socket = rustix::net::socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    loop {
        match rustix::net::connect(&socket, address) {
            Ok(()) => return Ok(UnixStream::from(socket)),
            // Too many wait for the server already.
            Err(Errno::AGAIN) if Instant::now() < until => std::thread::sleep(STEP / 10),
            Err(e) => return Err(e),
        }
    }
}

/// What is left until `until`, in the form of a system call; `None` if it is over.
fn left(until: Instant) -> Option<rustix::event::Timespec> {
    let left = until.checked_duration_since(Instant::now()).filter(|left| !left.is_zero())?;
    rustix::event::Timespec::try_from(left).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;
    use std::io::Read;

    /// A descriptor that a fake server hands out, and what tells whether another one is the same.
    pub(super) struct Handed {
        pub(super) given: OwnedFd,
        heard: std::io::PipeReader,
    }

    impl Handed {
        pub(super) fn new() -> Self {
            let (heard, given) = std::io::pipe().unwrap();
            Self { given: given.into(), heard }
        }

        /// Reads what is written to `descriptor`.
        pub(super) fn is(self, descriptor: OwnedFd) -> bool {
            rustix::io::write(&descriptor, b"same").unwrap();
            drop((descriptor, self.given));
            let mut heard = String::new();
            let mut pipe = self.heard;
            pipe.read_to_string(&mut heard).unwrap();
            heard == "same"
        }
    }

    #[test]
    fn the_environment_names_the_compositor_before_the_x_server() {
        let of = |set: &[&str]| Lender::of(&|name| set.contains(&name));
        assert_eq!(of(&["DISPLAY", "WAYLAND_DISPLAY"]), Some(Lender::Wayland));
        assert_eq!(of(&["DISPLAY"]), Some(Lender::X11));
        assert_eq!(of(&["HOME"]), None);
    }

    #[test]
    fn a_descriptor_that_is_no_card_is_refused_by_name() {
        let lease = Lease {
            descriptor: File::open("/dev/null").unwrap().into(),
            back: Box::new(()),
            lender: "a fake".into(),
        };
        let told = taken(&lease, None).err().expect("refused").to_string();
        assert!(told.contains("null") && told.contains("atomic mode setting"), "{told}");
    }

    #[test]
    fn a_server_that_takes_nobody_is_given_up_in_time() {
        let folder = std::env::temp_dir().join(format!("dpm-lease-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("full");
        let server = rustix::net::socket(AddressFamily::UNIX, SocketType::STREAM, None).unwrap();
        let address = SocketAddrUnix::new(&path).unwrap();
        rustix::net::bind(&server, &address).unwrap();
        rustix::net::listen(&server, 0).unwrap();
        let start = Instant::now();
        let until = start + Duration::from_millis(300);
        let mut kept = Vec::new();
        let refused = loop {
            match connect_to(&address, until) {
                Ok(stream) => kept.push(stream),
                Err(e) => break e,
            }
            assert!(kept.len() < 100, "the queue ends");
        };
        assert_eq!(refused, Errno::AGAIN);
        assert!(start.elapsed() < Duration::from_secs(5), "{:?}", start.elapsed());
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
