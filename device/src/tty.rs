//! Serial ports whose reads and writes never block.
//!
//! The write of the serialport crate waits for room and then writes to a blocking descriptor. The kernel then blocks
//! the caller until the last byte has found room: for the whole time of a frame on a slow line, and for ever on a line
//! that nobody reads.
#![allow(unsafe_code)]

use std::io;
use std::os::fd::AsRawFd;
use std::time::Duration;

use serialport::{SerialPort, TTYPort};

/// Opens the port at `path` exclusively, with 8 data bits, no parity and one stop bit. Discards the bytes that had
/// waited in it: their age is unknown, and they answer no request.
///
/// # Errors
/// The library's: not found, no permission, in use.
pub fn open(path: &str, baud: u32) -> serialport::Result<Box<dyn SerialPort>> {
    // Exclusive by lock and by TIOCEXCL. This is the library's default, but stated because callers rely on it.
    let port = serialport::new(path, baud).exclusive(true).open_native()?;
    port.clear(serialport::ClearBuffer::Input)?;
    Ok(never_wait(port)?)
}

/// Why a port cannot be opened, as far as the library reports it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// There is no such device file.
    Absent,
    /// Another program uses it.
    InUse,
    /// The operating system does not let this user open it.
    Denied,
    /// A file, a folder or a device of another kind.
    NotAPort,
    /// A device file with no hardware behind it.
    NoHardware,
    /// It does not support this rate.
    Rate,
    /// The library gives no reason.
    Unknown,
}

impl Refusal {
    /// The remedy, for an operator.
    pub const fn remedy(self) -> &'static str {
        match self {
            Self::Absent => "is it plugged in? `dpm doctor` lists the ports that are there",
            Self::InUse => "end the program that has it; `fuser -v` on the device file names it",
            Self::Denied => {
                "add this user to the group that owns it (`sudo usermod -aG dialout $USER`, then log in again)"
            }
            Self::NotAPort => "this is no serial port; `dpm doctor` lists those that are there",
            Self::NoHardware => "no hardware is behind this port; `dpm doctor` lists the ports that are there",
            Self::Rate => "the adapter does not do this rate; common ones are 115200, 921600 and 3000000 baud",
            Self::Unknown => "check cable and adapter, plug it in again, and see `dmesg`",
        }
    }
}

/// The library maps several system errors to one kind; only its text distinguishes them.
pub fn refusal(e: &serialport::Error) -> Refusal {
    let text = e.description.to_lowercase();
    let says = |words: &[&str]| words.iter().any(|w| text.contains(w));
    if says(&["busy", "lock", "temporarily unavailable"]) {
        return Refusal::InUse;
    }
    if says(&["permission denied", "not permitted"]) {
        return Refusal::Denied;
    }
    if says(&["typewriter", "ioctl", "is a directory", "not a directory", "not a tty"]) {
        return Refusal::NotAPort;
    }
    if says(&["no such device or address", "input/output error", "i/o error"]) {
        return Refusal::NoHardware;
    }
    match e.kind() {
        serialport::ErrorKind::NoDevice | serialport::ErrorKind::Io(io::ErrorKind::NotFound) => {
            Refusal::Absent
        }
        serialport::ErrorKind::InvalidInput => Refusal::Rate,
        _ if says(&["invalid argument"]) => Refusal::Rate,
        _ => Refusal::Unknown,
    }
}

/// Makes an open port (for example of a pseudo-terminal) non-blocking: reads and writes transfer as much as is possible
/// now, or fail with [`io::ErrorKind::WouldBlock`] or [`io::ErrorKind::TimedOut`]. Programs that this one starts do not
/// inherit the port: one that did would keep the line open after it was closed here.
///
/// # Errors
/// The operating system's.
pub fn never_wait(mut port: TTYPort) -> io::Result<Box<dyn SerialPort>> {
    port.set_timeout(Duration::ZERO)?;
    let descriptor = port.as_raw_fd();
    // SAFETY: calls on a descriptor that `port` owns and keeps open; their arguments and results are plain numbers.
    let set = unsafe {
        let flags = libc::fcntl(descriptor, libc::F_GETFL);
        flags >= 0
            && libc::fcntl(descriptor, libc::F_SETFL, flags | libc::O_NONBLOCK) >= 0
            && libc::fcntl(descriptor, libc::F_SETFD, libc::FD_CLOEXEC) >= 0
    };
    if set {
        Ok(Box::new(port))
    } else {
        Err(io::Error::last_os_error())
    }
}

/// True if a port that never waits has nothing to give or no room now.
pub fn would_wait(e: &io::Error) -> bool {
    matches!(e.kind(), io::ErrorKind::TimedOut | io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted)
}

/// An input of a serial port that is read as a switch, not as data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ControlSignal {
    /// Clear to send.
    Cts,
    /// Data set ready.
    Dsr,
    /// Data carrier detect.
    Dcd,
}

/// A serial port of which only a control line is read: a contact between one of its outputs and an input, or a relay.
/// Opening it raises RTS and DTR, which can supply the contact.
pub struct ControlLine {
    port: Box<dyn SerialPort>,
    signal: ControlSignal,
}

impl ControlLine {
    /// Opens the port at `path` exclusively.
    ///
    /// # Errors
    /// The library's: not found, no permission, in use.
    pub fn open(path: &str, signal: ControlSignal) -> serialport::Result<Self> {
        let mut port = open(path, 9600)?;
        // Some drivers raise them when the port is opened; all do on request.
        port.write_request_to_send(true)?;
        port.write_data_terminal_ready(true)?;
        Ok(Self { port, signal })
    }

    /// True while the line is raised.
    ///
    /// # Errors
    /// The port is gone, or has no such line (a pseudo-terminal).
    pub fn is_raised(&mut self) -> serialport::Result<bool> {
        match self.signal {
            ControlSignal::Cts => self.port.read_clear_to_send(),
            ControlSignal::Dsr => self.port.read_data_set_ready(),
            ControlSignal::Dcd => self.port.read_carrier_detect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Found in use: a program that was started while a pseudo-terminal was open kept it open, so that its other end
    /// never hung up.
    #[test]
    fn a_port_is_not_inherited_by_programs_that_are_started() {
        let (ours, theirs) = TTYPort::pair().expect("a pseudo-terminal");
        let port = never_wait(ours).expect("set");
        let mut child = std::process::Command::new("sleep").arg("30").spawn().expect("a program");
        drop(port);
        let mut theirs = never_wait(theirs).expect("set");
        // Another test may start a program between the opening of the pair and `never_wait`. That program holds the port
        // for as long as it runs, which is much shorter than the child of this test runs.
        let until = std::time::Instant::now() + std::time::Duration::from_secs(10);
        let mut hung_up = false;
        while !hung_up && std::time::Instant::now() < until {
            hung_up = match io::Read::read(&mut theirs, &mut [0; 1]) {
                Ok(read) => read == 0,
                Err(e) => !matches!(e.kind(), io::ErrorKind::TimedOut | io::ErrorKind::WouldBlock),
            };
            std::thread::yield_now();
        }
        let _ = child.kill();
        let _ = child.wait();
        assert!(hung_up);
    }

    #[test]
    fn what_is_no_port_is_told_from_what_is_not_there() {
        let of = |path: &str, baud| refusal(&open(path, baud).map(|_| ()).expect_err("no port opens here"));
        assert_eq!(of("/dev/no-such-port", 9600), Refusal::Absent);
        for no_port in ["/dev/null", "/tmp", "/proc/version", "/proc/version/tty"] {
            assert_eq!(of(no_port, 9600), Refusal::NotAPort, "{no_port}");
        }
    }

    #[test]
    fn the_systems_words_find_their_remedy() {
        use serialport::{Error, ErrorKind as K};
        for (kind, text, refusal_) in [
            (K::NoDevice, "Device or resource busy", Refusal::InUse),
            (K::NoDevice, "Unable to acquire exclusive lock on serial port", Refusal::InUse),
            (K::Io(io::ErrorKind::PermissionDenied), "Permission denied", Refusal::Denied),
            (K::Unknown, "Not a typewriter", Refusal::NotAPort),
            (K::Unknown, "I/O error", Refusal::NoHardware),
            (K::Unknown, "No such device or address", Refusal::NoHardware),
            (K::Unknown, "Invalid argument", Refusal::Rate),
            (K::Unknown, "Out of memory", Refusal::Unknown),
        ] {
            assert_eq!(refusal(&Error::new(kind, text)), refusal_, "{text}");
        }
    }
}
