//! The projector's state as a small file that other processes of this user read. It is the second way to check
//! whether an order was obeyed, in case the thread of the control socket hangs.

use super::{state_name, HEARD};
use crate::order::Order;
use crate::telemetry::monitor::ProjectorHealth;
use dpm_common::folder::{Folder, FolderError};
use dpm_common::unix::monotonic_ns;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::sync::Arc;

/// Longest file.
const MAX_BYTES: u64 = 1024;
/// An unchanged state is rewritten after this time, so that a reader can see that it is current.
const AGAIN_NS: u64 = 40_000_000;

/// A process writes it about itself; it is removed when this is dropped.
#[derive(Debug)]
pub struct StatusFile {
    folder: Arc<Folder>,
    name: String,
    file: File,
    last: Option<(u64, ProjectorHealth, Option<Order>)>,
}

/// Content of the file.
#[doc(hidden)]
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Said {
    /// When it was written, nanoseconds of [`monotonic_ns`].
    pub at_ns: u64,
    /// The projector's state at that time.
    pub health: ProjectorHealth,
    /// The order that stood at that time and is kept over restarts.
    pub standing: Option<Order>,
    /// The rig's file.
    pub rig: String,
}

/// Everything except the rig, as text of a constant length.
fn record(at_ns: u64, health: ProjectorHealth, standing: Option<Order>) -> String {
    let standing = standing.map_or("none", Order::word);
    format!("{at_ns:020} {:016x} {standing:6}\n", health.encode())
}

impl StatusFile {
    /// Creates the file of this process in `folder`.
    ///
    /// # Errors
    /// An error of the operating system.
    pub fn create(folder: Arc<Folder>, rig: &str) -> Result<Self, FolderError> {
        let name = state_name(std::process::id());
        // Left by a killed process with the same id.
        folder.remove(&name)?;
        let file = folder.open_file(&name, true)?;
        let this = Self { name, file, last: None, folder };
        let first = record(0, ProjectorHealth::Connecting, None);
        let text = format!("{first}{first}{HEARD} {rig}\n");
        this.file
            .write_all_at(text.as_bytes(), 0)
            .map_err(|source| FolderError::Io { path: this.folder.path().join(&this.name), source })?;
        Ok(this)
    }

    /// Writes the projector's state. Not for the frame path: a file system may take its time.
    pub fn say(&mut self, health: ProjectorHealth, standing: Option<Order>) {
        let now = monotonic_ns();
        let is_known =
            |(at, h, s): (u64, _, _)| (h, s) == (health, standing) && now.saturating_sub(at) < AGAIN_NS;
        if self.last.is_some_and(is_known) {
            return;
        }
        let record = record(now, health, standing);
        // Written twice: a reader during a half-done write sees two different lines.
        if self.file.write_all_at((record.clone() + &record).as_bytes(), 0).is_ok() {
            self.last = Some((now, health, standing));
        }
    }

    /// Reads the file of process `pid`.
    ///
    /// # Errors
    /// It does not exist, cannot be read, or is half written (try again).
    pub(crate) fn read(folder: &Folder, pid: u32) -> Result<Said, FolderError> {
        let name = state_name(pid);
        let bytes = folder.read(&name, MAX_BYTES)?;
        parse(&String::from_utf8_lossy(&bytes)).ok_or_else(|| FolderError::Io {
            path: folder.path().join(&name),
            source: io::Error::new(io::ErrorKind::InvalidData, "half written"),
        })
    }
}

/// What a file says; `None` if it is half written.
#[doc(hidden)]
pub fn parse(text: &str) -> Option<Said> {
    let mut lines = text.lines();
    let (first, second) = (lines.next()?, lines.next()?);
    let rig = lines.next()?.strip_prefix(HEARD)?.trim_start().to_owned();
    let mut fields = first.split_whitespace();
    let at_ns = fields.next()?.parse().ok()?;
    let health = ProjectorHealth::decode(u64::from_str_radix(fields.next()?, 16).ok()?);
    let standing = fields.next().and_then(Order::from_word);
    (first == second).then_some(Said { at_ns, health, standing, rig })
}

impl Drop for StatusFile {
    fn drop(&mut self) {
        let _ = self.folder.remove(&self.name);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_common::folder::Owner;

    #[test]
    fn what_is_said_is_read_by_others_with_its_time_and_never_half() {
        let path = std::env::temp_dir().join(format!("dpm-status-file-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        let folder = Arc::new(Folder::make(&path, Owner::Own).unwrap());
        let pid = std::process::id();
        let mut file = StatusFile::create(folder.clone(), "/etc/dpm/rig.toml").unwrap();
        let before = monotonic_ns();
        for (health, standing) in [
            (ProjectorHealth::Up, None),
            (ProjectorHealth::Faulted(u32::MAX), Some(Order::Safe)),
            (ProjectorHealth::Black, Some(Order::Black)),
            (ProjectorHealth::Frozen, Some(Order::Freeze)),
        ] {
            file.say(health, standing);
            let said = StatusFile::read(&folder, pid).unwrap();
            assert_eq!(
                (said.health, said.standing, said.rig.as_str()),
                (health, standing, "/etc/dpm/rig.toml")
            );
            assert!((before..=monotonic_ns()).contains(&said.at_ns));
        }
        let text = std::fs::read_to_string(path.join(state_name(pid))).unwrap();
        assert!(parse(&text).is_some());
        let half = record(u64::MAX, ProjectorHealth::Up, None);
        for n in 1..half.len() {
            assert_eq!(parse(&(half[..n].to_owned() + &text[n..])), None, "{n}");
        }
        drop(file);
        assert!(StatusFile::read(&folder, pid).unwrap_err().is_missing());
        std::fs::remove_dir_all(path).unwrap();
    }
}
