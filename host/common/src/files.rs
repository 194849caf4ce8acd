//! Writes files atomically: after a power failure a file has either its old or its new content.

use crate::folder::{open_own_file, Folder, FolderError};
use dpm_device::regular_file;
use std::fs::{self, File};
use std::io::{self, BufWriter, Read, Seek, Write};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::path::{Path, PathBuf};

/// Most old files of one name that are kept.
const MOST_KEPT: u32 = 10_000;

/// Replaces `path` by the output of `write`. It writes a temporary file beside it, flushes it to the disk, renames it
/// over `path`, and flushes the folder too. A reader sees the old or the new content, never a part. Missing folders are
/// made.
///
/// # Errors
/// Those of the file system or of `write`, with the path in the message; the old file is then unchanged.
pub fn write_atomically(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&File>) -> io::Result<()>,
) -> io::Result<()> {
    let named = |e: io::Error| io::Error::new(e.kind(), format!("cannot write {}: {e}", path.display()));
    let folder = folder_of(path);
    let Some(name) = path.file_name() else {
        return Err(named(io::Error::new(io::ErrorKind::InvalidInput, "not the name of a file")));
    };
    fs::create_dir_all(folder).map_err(named)?;
    let temporary = folder.join(format!(".{}.{}", name.to_string_lossy(), std::process::id()));
    let result = write_and_rename(&temporary, path, folder, write);
    if result.is_err() {
        // Nothing more can be done about a temporary file that cannot be removed.
        let _ = fs::remove_file(&temporary);
    }
    result.map_err(named)
}

/// The folder in which the file `path` lies: the current one for a name alone.
pub fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// Makes `folder` and checks that files can be written there. Call it before the work whose result will be written
/// there.
///
/// # Errors
/// Those of the file system, with the folder in the message.
pub fn check_folder(folder: &Path) -> io::Result<()> {
    let named = |e: io::Error| io::Error::new(e.kind(), format!("cannot write to {}: {e}", folder.display()));
    fs::create_dir_all(folder).map_err(named)?;
    let trial = folder.join(format!(".trial.{}", std::process::id()));
    create_new(&trial).and_then(|_| fs::remove_file(&trial)).map_err(named)
}

/// Makes a new file. A link of that name, which somebody may have planted in a shared folder, is not followed; the
/// remains of a killed process of the same number are removed.
fn create_new(path: &Path) -> io::Result<File> {
    match File::create_new(path) {
        Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {
            fs::remove_file(path)?;
            File::create_new(path)
        }
        result => result,
    }
}

/// Gives a file of at most `max_bytes` a second name `NAME.1.old`, `NAME.2.old` and so on, under which it stays when the
/// first one is replaced. Returns the second name; `None` if there is no such file.
///
/// # Errors
/// Those of the file system; the file is not a regular one, or too many old ones lie beside it.
pub fn keep_old(path: &Path, max_bytes: u64) -> io::Result<Option<PathBuf>> {
    match fs::symlink_metadata(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(e),
        Ok(m) if !m.is_file() => {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "is not a regular file; remove it"));
        }
        Ok(_) => {}
    }
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    for number in 1..=MOST_KEPT {
        let old = path.with_file_name(format!("{name}.{number}.old"));
        match fs::hard_link(path, &old) {
            Ok(()) => return Ok(Some(old)),
            Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {}
            // File systems without second names, such as FAT.
            Err(_) if !old.exists() => {
                let bytes = regular_file::read(path, max_bytes)?;
                write_atomically(&old, |w| w.write_all(&bytes))?;
                return Ok(Some(old));
            }
            Err(e) => return Err(e),
        }
    }
    Err(io::Error::other(format!("{MOST_KEPT} old files lie beside it; remove some")))
}

fn write_and_rename(
    temporary: &Path,
    path: &Path,
    folder: &Path,
    write: impl FnOnce(&mut BufWriter<&File>) -> io::Result<()>,
) -> io::Result<()> {
    let file = create_new(temporary)?;
    let mut buffered = BufWriter::new(&file);
    write(&mut buffered)?;
    buffered.flush()?;
    drop(buffered);
    file.sync_all()?;
    fs::rename(temporary, path)?;
    File::open(folder)?.sync_all()
}

/// Why a lock could not be taken.
#[derive(Debug, thiserror::Error)]
pub enum LockError {
    /// Another process, or another lock in this one, holds it.
    #[error("{what} is in use by another dpm{}; stop that one first (lock {})", .holder.map_or(String::new(), |p| format!(" (process {p})")), .path.display())]
    Held {
        /// What the lock protects.
        what: String,
        /// The lock file.
        path: PathBuf,
        /// Process that holds it, if the file names it.
        holder: Option<u32>,
    },
    /// The lock file cannot be made.
    #[error("cannot lock {what}: {source}")]
    Io {
        /// What the lock protects.
        what: String,
        /// The cause.
        source: FolderError,
    },
}

/// An exclusive lock. It is released when it is dropped, or when the process ends in any way.
#[derive(Debug)]
pub enum InstanceLock {
    /// Of those who use the same folder.
    File(File),
    /// Of all users of this machine.
    Name(UnixDatagram),
}

impl InstanceLock {
    /// Takes the lock file `path` for `what` (its name in messages); never blocks. A missing folder is made. The file
    /// must be a regular one of this user; a link is not followed.
    ///
    /// # Errors
    /// [`LockError::Held`] when another process, or another lock in this one, has it.
    pub fn take(path: &Path, what: &str) -> Result<Self, LockError> {
        let failed = |source| LockError::Io { what: what.into(), source };
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder)
                .map_err(|source| failed(FolderError::Io { path: folder.into(), source }))?;
        }
        Self::lock(open_own_file(path).map_err(failed)?, path, what)
    }

    /// As [`InstanceLock::take`], for the file `name` in a checked folder.
    ///
    /// # Errors
    /// As [`InstanceLock::take`].
    pub fn take_in(folder: &Folder, name: &str, what: &str) -> Result<Self, LockError> {
        let failed = |source| LockError::Io { what: what.into(), source };
        Self::lock(folder.open_file(name, true).map_err(failed)?, &folder.path().join(name), what)
    }

    /// As [`InstanceLock::take`], but for all users of this machine, in whatever folders they keep their locks: an
    /// abstract address of a socket, which exists as long as its owner does, and through which nobody can write
    /// anywhere. Containers with a network of their own have addresses of their own.
    ///
    /// # Errors
    /// [`LockError::Held`] when another process has it.
    pub fn take_on_machine(name: &str, what: &str) -> Result<Self, LockError> {
        let path = PathBuf::from(format!("@dpm/{name}"));
        let bound = SocketAddr::from_abstract_name(format!("dpm/{name}"))
            .and_then(|address| UnixDatagram::bind_addr(&address));
        bound.map(Self::Name).map_err(|source| match source.kind() {
            io::ErrorKind::AddrInUse => LockError::Held { what: what.into(), path, holder: None },
            _ => LockError::Io { what: what.into(), source: FolderError::Io { path, source } },
        })
    }

    fn lock(mut file: File, path: &Path, what: &str) -> Result<Self, LockError> {
        let io = |source| LockError::Io {
            what: what.into(),
            source: FolderError::Io { path: path.into(), source },
        };
        match file.try_lock() {
            Ok(()) => {}
            Err(fs::TryLockError::WouldBlock) => {
                let mut text = String::new();
                let told = file.take(32).read_to_string(&mut text);
                let holder = told.ok().and_then(|_| text.trim().parse().ok());
                return Err(LockError::Held { what: what.into(), path: path.into(), holder });
            }
            Err(fs::TryLockError::Error(e)) => return Err(io(e)),
        }
        let mut say = || {
            file.set_len(0)?;
            file.rewind()?;
            writeln!(file, "{}", std::process::id())
        };
        say().map_err(io)?;
        Ok(Self::File(file))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(name: &str) -> PathBuf {
        let path = std::env::temp_dir().join(format!("dpm-files-{}-{name}", std::process::id()));
        let _ = fs::remove_dir_all(&path);
        path
    }

    #[test]
    fn a_failed_write_leaves_the_old_file_and_nothing_else() {
        let dir = folder("failed");
        let path = dir.join("deep/report.json");
        write_atomically(&path, |w| w.write_all(b"old")).unwrap();
        let error = write_atomically(&path, |w| {
            w.write_all(&[b'x'; 100_000])?;
            Err(io::Error::other("disk full"))
        })
        .unwrap_err();
        assert!(error.to_string().contains("report.json: disk full"), "{error}");
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
        write_atomically(&path, |w| w.write_all(b"new")).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        fs::remove_dir_all(dir).unwrap();
    }

    #[test]
    fn a_folder_that_is_a_file_is_named() {
        let dir = folder("file");
        fs::create_dir_all(&dir).unwrap();
        fs::write(dir.join("out"), b"").unwrap();
        let error = write_atomically(&dir.join("out/light.png"), |_| Ok(())).unwrap_err();
        assert!(error.to_string().contains("out/light.png"), "{error}");
        assert!(write_atomically(Path::new(".."), |_| Ok(())).is_err());
        fs::remove_dir_all(dir).unwrap();
    }

    #[test]
    fn a_lock_of_the_machine_needs_no_folder() {
        let name = format!("test-{}.lock", std::process::id());
        let first = InstanceLock::take_on_machine(&name, "projector X").unwrap();
        let told = InstanceLock::take_on_machine(&name, "projector X").unwrap_err().to_string();
        assert!(told.contains("projector X is in use by another dpm") && told.contains(&name), "{told}");
        drop(first);
        InstanceLock::take_on_machine(&name, "projector X").unwrap();
    }

    #[test]
    fn a_lock_is_exclusive_until_dropped() {
        let dir = folder("lock");
        let path = dir.join("a.lock");
        let first = InstanceLock::take(&path, "projector X").unwrap();
        let error = InstanceLock::take(&path, "projector X").unwrap_err();
        let told = error.to_string();
        assert!(told.contains("projector X is in use by another dpm"), "{told}");
        assert!(told.contains(&format!("process {}", std::process::id())), "{told}");
        drop(first);
        InstanceLock::take(&path, "projector X").unwrap();
        fs::remove_dir_all(dir).unwrap();
    }

    /// Found in use, R7: a run of root followed a link that somebody had planted in place of the lock file, and wrote
    /// its number into the link's target. The same applies to the temporary files beside a report and to the test file
    /// of a folder.
    #[test]
    fn r7_planted_links_are_never_written_through() {
        let dir = folder("links");
        fs::create_dir_all(&dir).unwrap();
        let victim = dir.join("victim");
        fs::write(&victim, b"precious").unwrap();
        let id = std::process::id();
        for name in ["a.lock".to_owned(), format!(".report.json.{id}"), format!(".trial.{id}")] {
            std::os::unix::fs::symlink(&victim, dir.join(name)).unwrap();
        }
        let told = InstanceLock::take(&dir.join("a.lock"), "projector X").unwrap_err().to_string();
        assert!(told.contains("a.lock: is a link") && told.contains("remove it"), "{told}");
        write_atomically(&dir.join("report.json"), |w| w.write_all(b"new")).unwrap();
        check_folder(&dir).unwrap();
        assert_eq!(fs::read(&victim).unwrap(), b"precious");
        assert_eq!(fs::read(dir.join("report.json")).unwrap(), b"new");
        assert!(!fs::symlink_metadata(dir.join("report.json")).unwrap().is_symlink());
        fs::remove_dir_all(dir).unwrap();
    }
}
