//! Orders of other users of this machine, in a folder in which everybody may write and nobody may touch what is
//! another's: a projector that one user has made dark stays dark for every other, root too.
//!
//! Each user keeps a copy of their orders there. Whoever writes there can hold light back and cannot bring any: an order
//! is all that a file of it can say, and a user's own orders never come from there.

use super::{BYTES, ENDING};
use dpm_common::folder::Folder;
use dpm_common::unix::user;
use std::path::Path;

/// How the name of a file begins.
const BEGIN: &str = "dpm-order-";
/// Files that are looked at, at most.
const MOST: usize = 256;

/// See the module's documentation.
#[derive(Debug)]
pub(super) struct Others {
    folder: Folder,
    user: u32,
}

impl Others {
    /// Those of this machine. `None` where nobody may share: without such a folder, and where `DPM_STATE_DIR` names the
    /// only folder that counts.
    pub(super) fn of_this_machine() -> Option<Self> {
        if std::env::var_os("DPM_STATE_DIR").is_some() {
            return None;
        }
        Self::in_folder(Path::new("/var/tmp"), user())
    }

    /// Those in `path`, as `user` sees them.
    pub(super) fn in_folder(path: &Path, user: u32) -> Option<Self> {
        Folder::open_of_all(path).ok().map(|folder| Self { folder, user })
    }

    /// Name and content of the orders of all other users.
    pub(super) fn orders(&self) -> Vec<(String, Vec<u8>)> {
        let names = self.folder.names().unwrap_or_default().into_iter();
        let theirs = names.filter(|name| name.starts_with(BEGIN) && name.ends_with(ENDING));
        let read = |name: String| {
            let (owner, bytes) = self.folder.read_of_any(&name, BYTES as u64).ok()?;
            let is_theirs = owner != self.user && name.starts_with(&begin(owner));
            is_theirs.then_some((name, bytes))
        };
        theirs.filter_map(read).take(MOST).collect()
    }

    /// The name that an order has in its user's own folder.
    pub(super) fn name_of(name: &str) -> &str {
        let own = || name.strip_prefix(BEGIN)?.split_once('-').map(|(_, own)| own);
        own().unwrap_or(name)
    }

    /// Lets all others see an order of this user, as far as that is possible: it is kept already.
    pub(super) fn show(&self, name: &str, bytes: &[u8]) {
        let _ = self.folder.replace_for_all(&(begin(self.user) + name), bytes);
    }

    /// This user has lifted an order.
    pub(super) fn hide(&self, name: &str) {
        let _ = self.folder.remove(&(begin(self.user) + name));
    }
}

fn begin(user: u32) -> String {
    format!("{BEGIN}{user}-")
}
