//! Opens files that users name, and never blocks: a pipe, a socket, a folder or a device is refused, and the error
//! names its kind.
//!
//! Opening a named pipe blocks until somebody writes to it, and reading `/dev/zero` never ends. Checking the path
//! before opening it is a race: the path may name another file by then. So the file is opened in a way that never
//! blocks, and the check is made on the open file.

use std::fs::{File, FileType};
use std::io::{self, Read};
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};
use std::path::Path;

/// The kind of a file that is not a regular file, with its article.
fn kind(of: FileType) -> &'static str {
    if of.is_dir() {
        "a folder"
    } else if of.is_fifo() {
        "a named pipe"
    } else if of.is_socket() {
        "a socket"
    } else if of.is_char_device() || of.is_block_device() {
        "a device file"
    } else {
        "not a regular file"
    }
}

/// The error for a file that is not a regular file.
fn refused(of: FileType) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidInput, format!("it is {}; give a regular file", kind(of)))
}

/// Opens a regular file for reading and returns it with its size in bytes. Never blocks, whatever is at `path`; links
/// are followed.
///
/// # Errors
/// Those of the operating system; [`io::ErrorKind::InvalidInput`], naming the kind, if it is not a regular file.
pub fn open(path: &Path) -> io::Result<(File, u64)> {
    let flags = libc::O_NONBLOCK | libc::O_NOCTTY;
    let file = match File::options().read(true).custom_flags(flags).open(path) {
        Ok(file) => file,
        // A socket cannot be opened at all, and the system's error does not say that it is a socket.
        Err(e) => match std::fs::metadata(path) {
            Ok(m) if !m.is_file() => return Err(refused(m.file_type())),
            _ => return Err(e),
        },
    };
    let metadata = file.metadata()?;
    if metadata.is_file() {
        Ok((file, metadata.len()))
    } else {
        Err(refused(metadata.file_type()))
    }
}

/// Reads a whole regular file of at most `limit` bytes.
///
/// # Errors
/// As [`open`]; [`io::ErrorKind::FileTooLarge`] with both numbers.
pub fn read(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let (file, size) = open(path)?;
    let mut bytes = Vec::with_capacity(size.min(limit) as usize);
    // A file may grow while it is read.
    if size <= limit {
        file.take(limit + 1).read_to_end(&mut bytes)?;
    }
    let found = size.max(bytes.len() as u64);
    if found > limit {
        let told = format!("it has {found} bytes, and at most {limit} are read");
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, told));
    }
    Ok(bytes)
}

/// Reads a whole text file of at most `limit` bytes.
///
/// # Errors
/// As [`read`]; [`io::ErrorKind::InvalidData`] if the content is not UTF-8.
pub fn read_text(path: &Path, limit: u64) -> io::Result<String> {
    let not_text = |_| io::Error::new(io::ErrorKind::InvalidData, "it is not a text file (UTF-8)");
    String::from_utf8(read(path, limit)?).map_err(not_text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::net::UnixListener;
    use std::time::{Duration, Instant};

    /// Found in use, R18: reading a named pipe blocked for ever. Every other kind of file is refused at once and by
    /// name, and a file beyond the limit is not read.
    #[test]
    fn what_is_no_regular_file_is_refused_by_its_kind_at_once() {
        let folder = std::env::temp_dir().join(format!("dpm-regular-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(&folder).unwrap();
        let pipe = folder.join("pipe");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status().unwrap();
        assert!(made.success());
        let link = folder.join("link");
        std::os::unix::fs::symlink(&pipe, &link).unwrap();
        let socket = folder.join("socket");
        let _listener = UnixListener::bind(&socket).unwrap();
        let start = Instant::now();
        for (path, word) in [
            (pipe.as_path(), "a named pipe"),
            (link.as_path(), "a named pipe"),
            (socket.as_path(), "a socket"),
            (folder.as_path(), "a folder"),
            (Path::new("/dev/zero"), "a device file"),
            (Path::new("/dev/null"), "a device file"),
        ] {
            let error = read(path, 1 << 20).unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::InvalidInput, "{}", path.display());
            assert!(error.to_string().contains(word), "{}: {error}", path.display());
        }
        assert!(start.elapsed() < Duration::from_secs(5), "{:?}", start.elapsed());
        assert_eq!(read(&folder.join("none"), 1).unwrap_err().kind(), io::ErrorKind::NotFound);
        let file = folder.join("file");
        std::fs::write(&file, b"12345").unwrap();
        assert_eq!(read(&file, 5).unwrap(), b"12345");
        assert_eq!(read_text(&file, 5).unwrap(), "12345");
        let error = read(&file, 4).unwrap_err();
        assert!(error.to_string().contains("5 bytes") && error.to_string().contains("at most 4"), "{error}");
        std::fs::write(&file, [0xff]).unwrap();
        assert!(read_text(&file, 5).unwrap_err().to_string().contains("text file"));
        std::fs::remove_dir_all(folder).unwrap();
    }
}
