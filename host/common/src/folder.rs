//! A folder that belongs to us: opened once, checked through the open descriptor, and used only through that
//! descriptor.
//!
//! Where others may write (the temporary folder), others can create a folder with a known name before we do. So a link
//! is not followed, the owner and the mode are read from the open folder, and every file in it is opened relative to
//! that descriptor. Nobody can exchange the folder between the check and the use.

use crate::unix::{open_at, remove_at, rename_at, user, user_name};
use std::fs::{self, DirBuilder, File, Metadata, Permissions};
use std::io::{self, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

/// How the names of files begin that [`Folder::replace`] has not finished. One remains where a process was killed.
pub const UNFINISHED: &str = ".new-";

/// Why a folder or a file in it is not used.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// An error of the operating system.
    #[error("{}: {source}", path.display())]
    Io {
        /// The folder or file.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// It exists, but others could have put it there or can write to it.
    #[error("{}: {reason}", path.display())]
    NotOurs {
        /// The folder or file.
        path: PathBuf,
        /// The problem and the remedy.
        reason: String,
    },
}

impl FolderError {
    /// True when nothing of that name exists.
    pub fn is_missing(&self) -> bool {
        matches!(self, Self::Io { source, .. } if source.kind() == io::ErrorKind::NotFound)
    }
}

/// The accepted owners of a folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Owner {
    /// This process's user only.
    Own,
    /// For root any user's, for others their own.
    OwnOrAnyForRoot,
}

/// See the module's documentation.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    handle: File,
    owner: u32,
}

impl Folder {
    /// Opens `path`, which must exist, belong to `whose` and be writable by its owner only.
    ///
    /// # Errors
    /// [`FolderError`]; `NotOurs` for a link, a file, another owner, or a mode that lets others write.
    pub fn open(path: &Path, whose: Owner) -> Result<Self, FolderError> {
        let not_ours = |reason: String| FolderError::NotOurs { path: path.into(), reason };
        let opened = File::options()
            .read(true)
            .custom_flags(libc::O_DIRECTORY | libc::O_NOFOLLOW | libc::O_CLOEXEC)
            .open(path);
        let handle = opened.map_err(|source| match source.raw_os_error() {
            Some(libc::ELOOP | libc::ENOTDIR) if fs::symlink_metadata(path).is_ok_and(|m| !m.is_dir()) => {
                not_ours("is a link or a file, not a folder, so it may have been put there by somebody else; remove it".into())
            }
            _ => FolderError::Io { path: path.into(), source },
        })?;
        Self::checked(path, handle, whose)
    }

    /// Opens `path`, a folder of root's in which everybody may write and nobody may touch what is another's, as the
    /// temporary folders are.
    ///
    /// # Errors
    /// [`FolderError`]; `NotOurs` for any other folder.
    pub fn open_of_all(path: &Path) -> Result<Self, FolderError> {
        let io = |source| FolderError::Io { path: path.into(), source };
        let flags = libc::O_DIRECTORY | libc::O_NOFOLLOW | libc::O_CLOEXEC;
        let handle = File::options().read(true).custom_flags(flags).open(path).map_err(io)?;
        let about = handle.metadata().map_err(io)?;
        if about.uid() != 0 || about.mode() & 0o1777 != 0o1777 {
            let reason = "is no folder of root's in which everybody may write their own files only".into();
            return Err(FolderError::NotOurs { path: path.into(), reason });
        }
        Ok(Self { path: path.into(), handle, owner: user() })
    }

    fn checked(path: &Path, handle: File, whose: Owner) -> Result<Self, FolderError> {
        let not_ours = |reason: String| FolderError::NotOurs { path: path.into(), reason };
        let about = handle.metadata().map_err(|source| FolderError::Io { path: path.into(), source })?;
        let me = user();
        let owner = about.uid();
        if owner != me && !(whose == Owner::OwnOrAnyForRoot && me == 0) {
            return Err(not_ours(format!(
                "belongs to {}, not to {}, so it may have been put there by somebody else; use a folder of your own",
                user_name(owner),
                user_name(me)
            )));
        }
        if about.mode() & 0o022 != 0 {
            return Err(not_ours(format!(
                "can be written by others (mode {:o}); `chmod go-w` it after a look at what is in it",
                about.mode() & 0o7777
            )));
        }
        Ok(Self { path: path.into(), handle, owner })
    }

    /// As [`Folder::open`]; a missing folder is made, for its owner only, with the folders above it.
    ///
    /// # Errors
    /// As [`Folder::open`], and when it cannot be made.
    pub fn make(path: &Path, whose: Owner) -> Result<Self, FolderError> {
        let io = |source| FolderError::Io { path: path.into(), source };
        if let Some(above) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
            fs::create_dir_all(above).map_err(io)?;
        }
        match DirBuilder::new().mode(0o700).create(path) {
            Err(e) if e.kind() != io::ErrorKind::AlreadyExists => return Err(io(e)),
            _ => {}
        }
        Self::open(path, whose)
    }

    /// Its path, for messages.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The user that it belongs to.
    pub fn owner(&self) -> u32 {
        self.owner
    }

    /// A path to `name` in this folder, even if it was renamed, for calls that accept only paths (sockets); it is short
    /// enough for them.
    pub fn path_to(&self, name: &str) -> PathBuf {
        let by_descriptor = PathBuf::from(format!("/proc/self/fd/{}", self.handle.as_raw_fd()));
        if by_descriptor.exists() {
            by_descriptor.join(name)
        } else {
            self.path.join(name)
        }
    }

    fn named(&self, name: &str) -> impl Fn(io::Error) -> FolderError {
        let path = self.path.join(name);
        move |source| FolderError::Io { path: path.clone(), source }
    }

    /// Opens the file `name` for reading and writing; with `create` a missing one is made. The content is unchanged.
    ///
    /// # Errors
    /// As [`check_file`]; those of the operating system.
    pub fn open_file(&self, name: &str, create: bool) -> Result<File, FolderError> {
        let flags = libc::O_RDWR | if create { libc::O_CREAT } else { 0 };
        let file = open_at(&self.handle, name, flags, 0o600).map_err(|e| self.refused(name, e))?;
        check_file(&file, &self.path.join(name), self.owner)?;
        Ok(file)
    }

    /// The content of `name`, which must be a regular file of at most `most` bytes and belong to the folder's owner,
    /// root or this user.
    ///
    /// # Errors
    /// As [`check_file`]; longer than `most`; those of the operating system.
    pub fn read(&self, name: &str, most: u64) -> Result<Vec<u8>, FolderError> {
        let file = open_at(&self.handle, name, libc::O_RDONLY, 0).map_err(|e| self.refused(name, e))?;
        check_file(&file, &self.path.join(name), self.owner)?;
        self.read_open(file, name, most)
    }

    /// The content of the regular file `name`, at most `most` bytes, whoever wrote it, and the user that it belongs to.
    ///
    /// # Errors
    /// A link; no regular file; longer than `most`; those of the operating system.
    pub fn read_of_any(&self, name: &str, most: u64) -> Result<(u32, Vec<u8>), FolderError> {
        let file = open_at(&self.handle, name, libc::O_RDONLY, 0).map_err(|e| self.refused(name, e))?;
        let about = file.metadata().map_err(self.named(name))?;
        let owner = about.uid();
        check_file(&file, &self.path.join(name), owner)?;
        Ok((owner, self.read_open(file, name, most)?))
    }

    fn read_open(&self, file: File, name: &str, most: u64) -> Result<Vec<u8>, FolderError> {
        let mut bytes = Vec::new();
        file.take(most + 1).read_to_end(&mut bytes).map_err(self.named(name))?;
        if bytes.len() as u64 > most {
            return Err(self.named(name)(io::Error::new(io::ErrorKind::InvalidData, "too long")));
        }
        Ok(bytes)
    }

    /// Replaces the content of `name` by `bytes`, atomically; the content is on the disk when this returns.
    ///
    /// # Errors
    /// Those of the operating system; the old content is then unchanged.
    pub fn replace(&self, name: &str, bytes: &[u8]) -> Result<(), FolderError> {
        self.replace_with(name, bytes, |_| Ok(()))
    }

    /// As [`Folder::replace`], and everybody may read it, whatever this process's mask of modes.
    ///
    /// # Errors
    /// As [`Folder::replace`].
    pub fn replace_for_all(&self, name: &str, bytes: &[u8]) -> Result<(), FolderError> {
        self.replace_with(name, bytes, |file| file.set_permissions(Permissions::from_mode(0o644)))
    }

    fn replace_with(
        &self,
        name: &str,
        bytes: &[u8],
        prepare: impl Fn(&File) -> io::Result<()>,
    ) -> Result<(), FolderError> {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let temporary = format!("{UNFINISHED}{}-{number}", std::process::id());
        // The file may remain from a killed process of the same number.
        let _ = remove_at(&self.handle, &temporary);
        let write = || -> io::Result<()> {
            let flags = libc::O_WRONLY | libc::O_CREAT | libc::O_EXCL;
            let mut file = open_at(&self.handle, &temporary, flags, 0o644)?;
            prepare(&file)?;
            file.write_all(bytes)?;
            file.sync_all()?;
            rename_at(&self.handle, &temporary, name)?;
            self.handle.sync_all()
        };
        write().map_err(|e| {
            let _ = remove_at(&self.handle, &temporary);
            self.named(name)(e)
        })
    }

    /// Writes `bytes` over the content of `name`, which exists; they are on the disk when this returns. Needs no room on
    /// the disk where the content was as long, on file systems that write in place.
    ///
    /// # Errors
    /// As [`check_file`]; those of the operating system. The content may then be a mixture.
    pub fn overwrite(&self, name: &str, bytes: &[u8]) -> Result<(), FolderError> {
        let mut file = self.open_file(name, false)?;
        let mut write = || {
            file.write_all(bytes)?;
            file.set_len(bytes.len() as u64)?;
            file.sync_all()
        };
        write().map_err(self.named(name))
    }

    /// Renames `from` to `to`, which is replaced; that is on the disk when this returns.
    ///
    /// # Errors
    /// Those of the operating system.
    pub fn rename(&self, from: &str, to: &str) -> Result<(), FolderError> {
        rename_at(&self.handle, from, to).and_then(|()| self.handle.sync_all()).map_err(self.named(to))
    }

    /// Removes `name`, which may be missing; it is gone from the disk when this returns.
    ///
    /// # Errors
    /// Those of the operating system.
    pub fn remove(&self, name: &str) -> Result<(), FolderError> {
        match remove_at(&self.handle, name) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
            Err(e) => Err(self.named(name)(e)),
            Ok(()) => self.handle.sync_all().map_err(self.named(name)),
        }
    }

    /// Names of its entries, those that are UTF-8.
    ///
    /// # Errors
    /// Those of the operating system.
    pub fn names(&self) -> Result<Vec<String>, FolderError> {
        let list = || -> io::Result<Vec<String>> {
            let mut names = Vec::new();
            for entry in fs::read_dir(self.path_to("."))? {
                names.extend(entry?.file_name().into_string());
            }
            Ok(names)
        };
        list().map_err(|source| FolderError::Io { path: self.path.clone(), source })
    }

    fn refused(&self, name: &str, e: io::Error) -> FolderError {
        match e.raw_os_error() {
            Some(libc::ELOOP) => link(&self.path.join(name)),
            _ => self.named(name)(e),
        }
    }
}

fn link(path: &Path) -> FolderError {
    let reason = "is a link, which is not followed: somebody may want another file overwritten; remove it";
    FolderError::NotOurs { path: path.into(), reason: reason.into() }
}

/// Checks that an open file is a regular one, has only one name, and belongs to this user, to root or to `owner`.
///
/// # Errors
/// [`FolderError::NotOurs`].
pub(crate) fn check_file(file: &File, path: &Path, owner: u32) -> Result<(), FolderError> {
    let about: Metadata = file.metadata().map_err(|source| FolderError::Io { path: path.into(), source })?;
    let reason = if !about.is_file() {
        "is no plain file; remove it".into()
    } else if about.nlink() != 1 {
        format!("has {} names: somebody may want another file overwritten; remove it", about.nlink())
    } else if ![0, user(), owner].contains(&about.uid()) {
        format!("belongs to {}, not to {}; remove it", user_name(about.uid()), user_name(user()))
    } else {
        return Ok(());
    };
    Err(FolderError::NotOurs { path: path.into(), reason })
}

/// Opens the regular file `path` of this user for a lock, and makes it if it is missing; a link is not followed, and
/// the content is unchanged.
///
/// # Errors
/// As [`check_file`]; those of the operating system.
pub(crate) fn open_own_file(path: &Path) -> Result<File, FolderError> {
    let opened = File::options()
        .read(true)
        .write(true)
        .create(true)
        .truncate(false)
        .mode(0o600)
        .custom_flags(libc::O_NOFOLLOW | libc::O_CLOEXEC | libc::O_NONBLOCK)
        .open(path);
    let file = opened.map_err(|source| match source.raw_os_error() {
        Some(libc::ELOOP) => link(path),
        _ => FolderError::Io { path: path.into(), source },
    })?;
    check_file(&file, path, user())?;
    Ok(file)
}

#[cfg(test)]
#[path = "folder_tests.rs"]
mod tests;
