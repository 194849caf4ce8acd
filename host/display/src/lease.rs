//! A display that a desktop lends: from what a rig file says and what runs on this machine to a card with one connector.
//!
//! The kernel lets the program that drives a graphics card lend a connector, and what drives it, to another program, as a
//! descriptor. An X server lends by RandR 1.6 (`x11`), a Wayland compositor by wp_drm_lease_device_v1 (`wayland`). With the
//! descriptor everything is as with a card of one's own. A program that was built without the feature of that name says so
//! when it should ask.
//!
//! What was lent is kept while a display is unplugged, so that the desktop does not take it meanwhile. It is given back when
//! the opener is dropped.

use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use dpm_handoff::path::Lock;

use crate::card::{let_go, look_for, open_for, Card};
use crate::kms::{Connector, Kms};
use crate::scan_out::DisplayError;

// The X server of the tests borrows how it sends a descriptor.
#[cfg(all(test, any(feature = "wayland", feature = "x11")))]
#[cfg_attr(not(feature = "wayland"), allow(dead_code))]
#[path = "../tests/laws/common/compositor.rs"]
mod compositor;
#[cfg(feature = "x11")]
pub mod names;
#[cfg(any(feature = "wayland", feature = "x11"))]
mod socket;
#[cfg(feature = "wayland")]
pub mod wayland;
#[cfg(feature = "x11")]
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
pub struct LeaseRefusal {
    /// What is wrong, and what to do.
    pub what: String,
    /// Somebody else may have it on lease, and give it back soon.
    pub is_lent: bool,
}

#[cfg(any(feature = "wayland", feature = "x11"))]
impl LeaseRefusal {
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
struct HeldLease {
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
    let held = Lock::new(HeldLease::default());
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

/// The connectors among which [`opener`] would choose, whoever drives them; nothing is taken and nobody is asked. `None`
/// where only a desktop can tell.
///
/// # Errors
/// No such card, no right to open it, or a desktop that this program cannot ask.
pub fn look(
    card: Option<&Path>,
    connector: Option<&str>,
    access: Access,
) -> Result<Option<Vec<Connector>>, DisplayError> {
    match access {
        Access::Lent(lender) => desktop(lender).map(|_| None),
        Access::Alone => look_for(card, connector).map(Some),
        Access::Auto => match look_for(card, connector) {
            Err(denied @ DisplayError::Denied(_)) => {
                desktop(Lender::of_environment().ok_or(denied)?).map(|_| None)
            }
            other => other.map(Some),
        },
    }
}

/// The card that `held` has on lease, or a new lease.
fn lent(
    held: &mut HeldLease,
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
    *held = HeldLease { lease: Some(lease), lender: Some(lender) };
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

/// How a desktop is called in messages, and how it is asked.
struct Desktop {
    name: fn() -> String,
    lease: fn(Option<&str>, String, Instant) -> Result<Lease, LeaseRefusal>,
}

/// The desktops that this program can ask.
fn desktop(lender: Lender) -> Result<Desktop, DisplayError> {
    match lender {
        #[cfg(feature = "x11")]
        Lender::X11 => Ok(Desktop { name: x11::name, lease: x11::lease }),
        #[cfg(not(feature = "x11"))]
        Lender::X11 => Err(left_out("the X server", "x11")),
        #[cfg(feature = "wayland")]
        Lender::Wayland => Ok(Desktop { name: wayland::name, lease: wayland::lease }),
        #[cfg(not(feature = "wayland"))]
        Lender::Wayland => Err(left_out("the Wayland compositor", "wayland")),
    }
}

/// Why a desktop is not asked by a program without the `feature` for it.
#[cfg(not(all(feature = "wayland", feature = "x11")))]
fn left_out(lender: &str, feature: &str) -> DisplayError {
    let what = format!(
        "this program was built without its feature \"{feature}\", which asks for one; build it with that feature, or switch \
         to a bare console (Ctrl+Alt+F3) and write projector.backend.lease = \"off\""
    );
    DisplayError::Unlent { lender: lender.into(), what }
}

/// Asks a desktop for `connector`, and the guardian of a dead run before that, which may have it.
fn ask(lender: Lender, connector: Option<&str>) -> Result<Lease, DisplayError> {
    let desktop = desktop(lender)?;
    let name = (desktop.name)();
    let limit = Instant::now() + if let_go(connector) { RETURN_PATIENCE } else { Duration::ZERO };
    loop {
        let until = Instant::now() + PATIENCE;
        match (desktop.lease)(connector, name.clone(), until) {
            Ok(lease) => return Ok(lease),
            Err(refusal) if refusal.is_lent && Instant::now() < limit => std::thread::sleep(STEP),
            Err(refusal) => return Err(DisplayError::Unlent { lender: name, what: refusal.what }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;

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

    #[cfg(not(all(feature = "wayland", feature = "x11")))]
    #[test]
    fn a_desktop_that_the_program_was_built_without_is_refused_by_name() {
        for (lender, feature, is_there) in [
            (Lender::Wayland, "wayland", cfg!(feature = "wayland")),
            (Lender::X11, "x11", cfg!(feature = "x11")),
        ] {
            if is_there {
                continue;
            }
            let told = opener(None, None, Access::Lent(lender))().err().expect("refused").to_string();
            assert!(told.contains(&format!("built without its feature \"{feature}\"")), "{told}");
        }
    }
}
