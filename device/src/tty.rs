//! Serial ports whose reads and writes never wait.
//!
//! serialport's write looks for room and then writes to a descriptor that blocks: the kernel then holds the caller until the last
//! byte has found room, for the whole time of a frame on a slow line, and for ever on a line that nobody reads.
#![allow(unsafe_code)]

use std::io;
use std::os::fd::AsRawFd;
use std::time::Duration;

use serialport::{SerialPort, TTYPort};

/// Opens the port at `path` for this program alone, 8 data bits, no parity, one stop bit.
///
/// # Errors
/// The library's: not found, no permission, in use.
pub fn open(path: &str, baud: u32) -> serialport::Result<Box<dyn SerialPort>> {
    // Exclusive by lock and by TIOCEXCL; the library's default, said here because it is a promise.
    let port = serialport::new(path, baud).exclusive(true).open_native()?;
    Ok(never_wait(port)?)
}

/// Makes an open port (of a pseudo-terminal, for example) one whose reads and writes take what there is room for now, or fail with
/// [`io::ErrorKind::WouldBlock`] or [`io::ErrorKind::TimedOut`].
///
/// # Errors
/// The operating system's.
pub fn never_wait(mut port: TTYPort) -> io::Result<Box<dyn SerialPort>> {
    port.set_timeout(Duration::ZERO)?;
    let descriptor = port.as_raw_fd();
    // SAFETY: two calls on a descriptor that `port` owns and keeps open; they take and give plain numbers.
    let set = unsafe {
        let flags = libc::fcntl(descriptor, libc::F_GETFL);
        flags >= 0 && libc::fcntl(descriptor, libc::F_SETFL, flags | libc::O_NONBLOCK) >= 0
    };
    if set {
        Ok(Box::new(port))
    } else {
        Err(io::Error::last_os_error())
    }
}
