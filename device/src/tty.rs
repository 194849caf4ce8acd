//! Serial ports whose reads and writes never block.
//!
//! The write of the serialport crate waits for room and then writes to a blocking descriptor. The kernel then blocks
//! the caller until the last byte has found room: for the whole time of a frame on a slow line, and for ever on a line
//! that nobody reads. And where it asks for room with poll(2), Linux first waits until a worker of the kernel has handed
//! on what had arrived (`n_tty_poll`). That worker has the priority of any program: on a busy machine it took more than
//! 100 ms, and the link's thread counted as hung.
#![allow(unsafe_code)]

use std::ffi::CString;
use std::io;
use std::os::fd::AsRawFd;
use std::time::Duration;

use serialport::{
    ClearBuffer, DataBits, FlowControl, Parity, Result as PortResult, SerialPort, StopBits, TTYPort,
};

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

/// Why the device file at `path` certainly cannot be opened: absent, or closed to this user. It is not opened.
pub fn refused(path: &str) -> Option<Refusal> {
    let path = CString::new(path).ok()?;
    // SAFETY: a NUL-terminated string that outlives the call.
    if unsafe { libc::access(path.as_ptr(), libc::R_OK | libc::W_OK) } == 0 {
        return None;
    }
    match io::Error::last_os_error().kind() {
        io::ErrorKind::NotFound => Some(Refusal::Absent),
        io::ErrorKind::PermissionDenied => Some(Refusal::Denied),
        _ => None,
    }
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
                "run as the user that owns it or in its group, which `ls -l` shows; for most ports `sudo usermod -aG dialout USER`, \
                 then log in again or restart the service"
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
        Ok(Box::new(NeverWaiting(port)))
    } else {
        Err(io::Error::last_os_error())
    }
}

/// A port whose descriptor does not block, and which is never asked with poll(2) whether it is ready. Another handle on it
/// waits as the library's do.
struct NeverWaiting(TTYPort);

/// The number of bytes that a call of the system transferred.
fn transferred(result: isize) -> io::Result<usize> {
    usize::try_from(result).map_err(|_| io::Error::last_os_error())
}

impl io::Read for NeverWaiting {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        // SAFETY: the descriptor is open as long as the port, and the system writes at most `len` bytes to `into`.
        transferred(unsafe { libc::read(self.0.as_raw_fd(), into.as_mut_ptr().cast(), into.len()) })
    }
}

impl io::Write for NeverWaiting {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        // SAFETY: the descriptor is open as long as the port, and the system reads at most `len` bytes of `bytes`.
        transferred(unsafe { libc::write(self.0.as_raw_fd(), bytes.as_ptr().cast(), bytes.len()) })
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

/// Methods that are those of the port within.
macro_rules! passed_on {
    ($(fn $name:ident(&self $(, $argument:ident: $kind:ty)*) -> $result:ty;)*
     ; $(fn $set:ident(&mut self, $value:ident: $value_kind:ty) -> $set_result:ty;)*) => {
        $(fn $name(&self $(, $argument: $kind)*) -> $result { self.0.$name($($argument),*) })*
        $(fn $set(&mut self, $value: $value_kind) -> $set_result { self.0.$set($value) })*
    };
}

impl SerialPort for NeverWaiting {
    passed_on! {
        fn name(&self) -> Option<String>;
        fn baud_rate(&self) -> PortResult<u32>;
        fn data_bits(&self) -> PortResult<DataBits>;
        fn flow_control(&self) -> PortResult<FlowControl>;
        fn parity(&self) -> PortResult<Parity>;
        fn stop_bits(&self) -> PortResult<StopBits>;
        fn timeout(&self) -> Duration;
        fn bytes_to_read(&self) -> PortResult<u32>;
        fn bytes_to_write(&self) -> PortResult<u32>;
        fn clear(&self, buffer: ClearBuffer) -> PortResult<()>;
        fn try_clone(&self) -> PortResult<Box<dyn SerialPort>>;
        fn set_break(&self) -> PortResult<()>;
        fn clear_break(&self) -> PortResult<()>;
        ;
        fn set_baud_rate(&mut self, rate: u32) -> PortResult<()>;
        fn set_data_bits(&mut self, bits: DataBits) -> PortResult<()>;
        fn set_flow_control(&mut self, control: FlowControl) -> PortResult<()>;
        fn set_parity(&mut self, parity: Parity) -> PortResult<()>;
        fn set_stop_bits(&mut self, bits: StopBits) -> PortResult<()>;
        fn set_timeout(&mut self, timeout: Duration) -> PortResult<()>;
        fn write_request_to_send(&mut self, level: bool) -> PortResult<()>;
        fn write_data_terminal_ready(&mut self, level: bool) -> PortResult<()>;
    }

    fn read_clear_to_send(&mut self) -> PortResult<bool> {
        self.0.read_clear_to_send()
    }

    fn read_data_set_ready(&mut self) -> PortResult<bool> {
        self.0.read_data_set_ready()
    }

    fn read_ring_indicator(&mut self) -> PortResult<bool> {
        self.0.read_ring_indicator()
    }

    fn read_carrier_detect(&mut self) -> PortResult<bool> {
        self.0.read_carrier_detect()
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
