//! The graphics cards of this machine, and which of them has a connector.

use std::fs::{File, OpenOptions};
use std::os::fd::OwnedFd;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use drm::Device as _;

use super::{Card, CardDescriptor};
use crate::kms::{Connector, Kms};
use crate::scan_out::DisplayError;

/// The cards of this machine, in the order of their numbers.
pub fn cards() -> Vec<PathBuf> {
    let listed = std::fs::read_dir("/dev/dri").into_iter().flatten().flatten().map(|entry| entry.path());
    let is_card = |path: &PathBuf| {
        path.file_name()
            .and_then(|n| n.to_str())
            .and_then(|n| n.strip_prefix("card"))
            .is_some_and(|n| n.parse::<u32>().is_ok())
    };
    let mut all: Vec<PathBuf> = listed.filter(is_card).collect();
    all.sort_by_key(|path| {
        path.to_string_lossy().trim_start_matches("/dev/dri/card").parse::<u32>().unwrap_or(u32::MAX)
    });
    all
}

/// The numbers and names of all connectors of the cards that this user may open.
pub fn connector_names() -> Vec<(u32, String)> {
    let open = |path: PathBuf| {
        let options = OpenOptions::new().read(true).write(true).custom_flags(libc::O_CLOEXEC).open(path);
        let node = CardDescriptor(options.ok()?.into());
        // Whoever opens a card that nobody drives drives it, and its owner may be about to return.
        let _ = node.release_master_lock();
        Some(node)
    };
    cards().into_iter().filter_map(open).flat_map(|node| node.connector_names()).collect()
}

/// The same of the card behind `descriptor` alone; empty if it is none.
pub fn connector_names_of(descriptor: OwnedFd) -> Vec<(u32, String)> {
    CardDescriptor(descriptor).connector_names()
}

/// The device file of a card's descriptor.
pub(super) fn path_of(descriptor: &OwnedFd) -> PathBuf {
    let device =
        descriptor.try_clone().and_then(|fd| File::from(fd).metadata()).map_or(0, |about| about.rdev());
    let (major, minor) = (rustix::fs::major(device), rustix::fs::minor(device));
    let link = std::fs::read_link(format!("/sys/dev/char/{major}:{minor}")).ok();
    Path::new("/dev/dri").join(link.as_deref().and_then(Path::file_name).unwrap_or("card".as_ref()))
}

/// Opens the card at `card`, or, without one, the first that has the connector `connector`, or a display at any.
///
/// # Errors
/// No such card; or as [`Card::open`].
pub fn open_for(card: Option<&Path>, connector: Option<&str>) -> Result<Box<dyn Kms>, DisplayError> {
    match card {
        Some(path) => Ok(Box::new(Card::open(path)?)),
        None => Ok(Box::new(Card::open(&find(connector)?)?)),
    }
}

/// The connectors of the card that [`open_for`] would open, whoever drives its displays.
///
/// # Errors
/// No such card, or no right to open it.
pub fn look_for(card: Option<&Path>, connector: Option<&str>) -> Result<Vec<Connector>, DisplayError> {
    let path = card.map_or_else(|| find(connector), |path| Ok(path.to_owned()))?;
    Card::look(&path)?.connectors()
}

/// The first card that has the connector `connector`, or a display at any.
fn find(connector: Option<&str>) -> Result<PathBuf, DisplayError> {
    let all = cards();
    let mut first_error = None;
    for path in &all {
        let fits = |c: &Connector| match connector {
            Some(name) => c.name == name,
            None => c.is_connected,
        };
        match Card::look(path).and_then(|mut card| card.connectors()) {
            Ok(connectors) if all.len() == 1 || connectors.iter().any(fits) => {
                return Ok(path.clone());
            }
            Ok(_) => {}
            Err(e) => first_error = first_error.or(Some(e)),
        }
    }
    Err(first_error.unwrap_or_else(|| DisplayError::NoCard("/dev/dri/card*".into())))
}
