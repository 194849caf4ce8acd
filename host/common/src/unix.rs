//! System calls that the standard library lacks: files relative to an open folder, the peer of a socket, waiting for
//! several descriptors, signals to a process.
#![allow(unsafe_code)]

use std::ffi::CString;
use std::fs::{File, Metadata};
use std::io;
use std::os::fd::{AsRawFd, FromRawFd, RawFd};
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::UnixStream;

/// The user that this process acts for.
pub fn user() -> u32 {
    // SAFETY: the call has no arguments and cannot fail.
    unsafe { libc::geteuid() }
}

/// The name of a user in /etc/passwd, else its number.
pub fn user_name(uid: u32) -> String {
    name_in("/etc/passwd", uid).unwrap_or_else(|| format!("uid {uid}"))
}

/// The name of a group in /etc/group, else its number.
pub fn group_name(gid: u32) -> String {
    name_in("/etc/group", gid).unwrap_or_else(|| format!("gid {gid}"))
}

/// The first field of the line whose third is `number`.
fn name_in(file: &str, number: u32) -> Option<String> {
    let text = std::fs::read_to_string(file).unwrap_or_default();
    text.lines().find_map(|line| {
        let mut fields = line.split(':');
        let name = fields.next()?;
        (fields.nth(1)?.parse() == Ok(number)).then(|| name.to_owned())
    })
}

/// Major and minor number of the device behind a device file.
pub fn device_number(file: &Metadata) -> [u32; 2] {
    let number = file.rdev();
    [libc::major(number), libc::minor(number)]
}

fn text(name: &str) -> io::Result<CString> {
    CString::new(name).map_err(|e| io::Error::new(io::ErrorKind::InvalidInput, e))
}

/// Opens `name` in `folder` with `flags` of open(2), and `mode` if it is created. A link at the end of the path is not
/// followed, and the call never blocks (a FIFO of that name does not hold up the caller).
///
/// # Errors
/// Those of openat(2).
pub(crate) fn open_at(folder: &File, name: &str, flags: libc::c_int, mode: libc::mode_t) -> io::Result<File> {
    let name = text(name)?;
    let flags = flags | libc::O_NOFOLLOW | libc::O_CLOEXEC | libc::O_NONBLOCK;
    // SAFETY: the name ends with a NUL and outlives the call; the descriptor is open as long as `folder` is borrowed.
    let fd = unsafe { libc::openat(folder.as_raw_fd(), name.as_ptr(), flags, libc::c_uint::from(mode)) };
    if fd < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: the call above has just made this descriptor, and nobody else has it.
    Ok(unsafe { File::from_raw_fd(fd) })
}

/// Removes the file `name` from `folder`.
///
/// # Errors
/// Those of unlinkat(2).
pub(crate) fn remove_at(folder: &File, name: &str) -> io::Result<()> {
    let name = text(name)?;
    // SAFETY: the name ends with a NUL and outlives the call.
    checked(unsafe { libc::unlinkat(folder.as_raw_fd(), name.as_ptr(), 0) })
}

/// Renames `from` to `to`, both in `folder`, replacing `to`.
///
/// # Errors
/// Those of renameat(2).
pub(crate) fn rename_at(folder: &File, from: &str, to: &str) -> io::Result<()> {
    let (from, to) = (text(from)?, text(to)?);
    let fd = folder.as_raw_fd();
    // SAFETY: both names end with a NUL and outlive the call.
    checked(unsafe { libc::renameat(fd, from.as_ptr(), fd, to.as_ptr()) })
}

fn checked(result: libc::c_int) -> io::Result<()> {
    if result < 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(())
}

/// The process at the other end of a socket, as the kernel reports it: for a client, the listener; for a server, the
/// one that connected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SocketPeer {
    /// Process; 0 if it is not visible from here (another PID namespace).
    pub pid: i32,
    /// User.
    pub uid: u32,
}

/// The other end of `stream`.
///
/// # Errors
/// Those of getsockopt(2).
pub fn peer(stream: &UnixStream) -> io::Result<SocketPeer> {
    let mut told = libc::ucred { pid: 0, uid: 0, gid: 0 };
    let mut size = size_of::<libc::ucred>() as libc::socklen_t;
    // SAFETY: the place is as large as `size` says, and both outlive the call.
    checked(unsafe {
        libc::getsockopt(
            stream.as_raw_fd(),
            libc::SOL_SOCKET,
            libc::SO_PEERCRED,
            std::ptr::from_mut(&mut told).cast(),
            &raw mut size,
        )
    })?;
    Ok(SocketPeer { pid: told.pid, uid: told.uid })
}

/// Sends `signal` to a process.
///
/// # Errors
/// Those of kill(2); numbers that do not name one process.
pub fn send_signal(pid: i32, signal: libc::c_int) -> io::Result<()> {
    if pid <= 0 {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "no process of this PID namespace"));
    }
    // SAFETY: plain numbers.
    checked(unsafe { libc::kill(pid, signal) })
}

/// Waits until one of `descriptors` can be read from (or was hung up), at most `limit_ms` milliseconds. Sets one flag
/// for each.
///
/// # Errors
/// Those of poll(2) but an interrupting signal, after which nothing can be read.
pub fn wait_readable(descriptors: &[RawFd], limit_ms: i32, ready: &mut Vec<bool>) -> io::Result<()> {
    let mut list: Vec<libc::pollfd> =
        descriptors.iter().map(|&fd| libc::pollfd { fd, events: libc::POLLIN, revents: 0 }).collect();
    // SAFETY: the list is as long as said and outlives the call.
    let result = unsafe { libc::poll(list.as_mut_ptr(), list.len() as libc::nfds_t, limit_ms) };
    ready.clear();
    ready.extend(list.iter().map(|entry| result > 0 && entry.revents != 0));
    match checked(result) {
        Err(e) if e.kind() != io::ErrorKind::Interrupted => Err(e),
        _ => Ok(()),
    }
}

/// Lets a pipe hold `bytes`, as far as this user may (pipe(7): a MiB).
///
/// # Errors
/// Those of fcntl(2): it is no pipe, or the user's pipes hold too much already.
pub fn widen_pipe(pipe: &impl AsRawFd, bytes: usize) -> io::Result<()> {
    // SAFETY: plain numbers; the descriptor is open as long as `pipe` is borrowed.
    checked(unsafe { libc::fcntl(pipe.as_raw_fd(), libc::F_SETPIPE_SZ, bytes as libc::c_int) })
}

/// Nanoseconds of the clock that all processes of this boot share and that nobody sets (CLOCK_MONOTONIC).
pub fn monotonic_ns() -> u64 {
    let mut now = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: the place outlives the call, which cannot fail for this clock.
    unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &raw mut now) };
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_ends_of_a_socket_are_this_process() {
        let (a, b) = UnixStream::pair().unwrap();
        let here = SocketPeer { pid: std::process::id() as i32, uid: user() };
        assert_eq!((peer(&a).unwrap(), peer(&b).unwrap()), (here, here));
        // Groups, all processes and "not visible" do not name one process.
        for pid in [0, -1, i32::MIN] {
            assert_eq!(send_signal(pid, 0).unwrap_err().kind(), io::ErrorKind::InvalidInput);
        }
        send_signal(here.pid, 0).unwrap();
        assert_eq!(user_name(0), "root");
        assert_eq!(user_name(4_000_000_000), "uid 4000000000");
        assert_eq!((group_name(0), group_name(4_000_000_000)), ("root".into(), "gid 4000000000".into()));
    }
}
