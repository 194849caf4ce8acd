//! Carries packets as COBS frames on a serial line: for control, slow panels and trigger boards.
//!
//! One stream carries both lanes, one packet per frame. Control messages overtake planes that still wait, so they are
//! late by at most one packet and the driver's buffer, which is kept short. Nothing blocks: bytes that the line does
//! not take now are kept, and while a frame is kept no other is accepted. An order to go dark cuts off the packet in
//! transmission and goes first.

mod reader;

pub use reader::SharedClock;

use std::io::{ErrorKind, Read, Write};
use std::sync::{Arc, OnceLock};

use serialport::{ClearBuffer, SerialPort};

use super::{Lane, SendError, Transport, TransportError};
use crate::cobs::{encode, encoded_bytes, Deframer};
use crate::packet::{packet_bytes, Packet, MAGIC, MAX_CONTROL_BYTES};
use crate::planes::MAX_PLANES;
use crate::time::{HostClock, HostTime};
use crate::tty::{self, Refusal};
use reader::Reader;

/// Bytes of control messages that may wait.
const CONTROL_WAITING: usize = 4096;
/// Maximum number of bytes read in one call: bounds the time of `receive`.
const READ_AT_ONCE: usize = 16 * 1024;
/// The kernel may hold planes for at most this fraction of a second. Not every driver can discard what it was given,
/// and those bytes go out before an order to go dark.
const AHEAD_PER_S: u32 = 50;
/// Bits of a byte on the line: start, eight, stop.
const BITS_PER_BYTE: u32 = 10;

/// The port and its settings.
#[derive(Clone, Debug)]
pub struct SerialSettings {
    /// Device file: `/dev/ttyUSB0`, `/dev/serial/by-id/...`.
    pub path: String,
    /// Bits per second; 8 data bits, no parity, one stop bit.
    pub baud: u32,
    /// Bytes of the largest frame on the wire, see [`packet_bytes`].
    pub frame_bytes: usize,
}

impl SerialSettings {
    /// Looks whether the port is there and this user may open it, and opens nothing: to open a port raises its control
    /// lines, which restarts some boards.
    ///
    /// # Errors
    /// Not found, or no permission (with the group to join).
    pub fn look(&self) -> Result<(), TransportError> {
        let device = format!("serial port {}", self.path);
        match tty::refused(&self.path) {
            None => Ok(()),
            Some(Refusal::Denied) => {
                Err(TransportError::PermissionDenied { device, remedy: Refusal::Denied.remedy().into() })
            }
            Some(_) => Err(TransportError::NotFound { device }),
        }
    }
}

/// Counters of the line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SerialCounters {
    /// Bytes that the line took.
    pub bytes_out: u64,
    /// Bytes received.
    pub bytes_in: u64,
    /// Times that the port was opened.
    pub opened: u64,
}

/// Where a line finds its port, again after every loss: the operating system's, or those of a simulator.
pub trait Ports: Send {
    /// Opens the port of `settings`. Its reads and writes MUST never wait, see [`tty::never_wait`].
    ///
    /// # Errors
    /// The library's: not found, no permission, in use.
    fn open(&mut self, settings: &SerialSettings) -> serialport::Result<Box<dyn SerialPort>>;

    /// Whoever reads `port` from now on and stamps by `clock` what arrives. `None` if nobody can: then the line reads
    /// the port itself, and arrivals are stamped late.
    fn arrivals(&mut self, port: &dyn SerialPort, clock: &SharedClock) -> Option<Box<dyn Arrivals>>;
}

/// What arrives on an open port, stamped. Dropping it ends the reading.
pub trait Arrivals: Send {
    /// Passes on the input with the instant of its arrival, or `now` without a clock. Returns the number of bytes, or
    /// `None` once the line has ended and everything was passed on.
    fn take(&mut self, now: HostTime, sink: &mut dyn FnMut(HostTime, &[u8])) -> Option<usize>;
}

/// The operating system's ports, each read by a thread of its own. A path behind which the function finds another device
/// counts as absent.
struct SystemPorts(Box<dyn Fn() -> bool + Send>);

impl Ports for SystemPorts {
    fn open(&mut self, settings: &SerialSettings) -> serialport::Result<Box<dyn SerialPort>> {
        if (self.0)() {
            return Err(serialport::Error::new(
                serialport::ErrorKind::NoDevice,
                "another device has its name",
            ));
        }
        tty::open(&settings.path, settings.baud)
    }

    fn arrivals(&mut self, port: &dyn SerialPort, clock: &SharedClock) -> Option<Box<dyn Arrivals>> {
        Some(Box::new(Reader::start(port, clock.clone())?))
    }
}

/// The link over a serial port.
pub struct SerialTransport {
    settings: SerialSettings,
    ports: Box<dyn Ports>,
    port: Option<Box<dyn SerialPort>>,
    /// Reads the port; without it `receive` does, and arrivals are stamped late.
    reader: Option<Box<dyn Arrivals>>,
    clock: SharedClock,
    deframer: Deframer<[u8; DEFRAMED]>,
    /// No frame has ended since the port was opened.
    is_fresh: bool,
    /// Encoded packets of the frame that is going out, and where each ends.
    data: Vec<u8>,
    ends: [usize; MAX_PLANES + 1],
    packets: usize,
    next_packet: usize,
    control: Vec<u8>,
    /// Encoded bytes of the packet in transmission, from `control` or `data`, and how many of them are out.
    going: Option<(Lane, usize, usize)>,
    counters: SerialCounters,
}

const DEFRAMED: usize = packet_bytes(MAX_CONTROL_BYTES);

impl SerialTransport {
    /// Opens the port exclusively.
    ///
    /// # Errors
    /// Not found; no permission (with the group to join); in use by another program.
    pub fn open(settings: SerialSettings) -> Result<Self, TransportError> {
        Self::open_unless(settings, || false)
    }

    /// The same, but as long as there `is_another` device at the path, now and after every loss, the port counts as
    /// absent.
    ///
    /// # Errors
    /// As [`SerialTransport::open`].
    pub fn open_unless(
        settings: SerialSettings,
        is_another: impl Fn() -> bool + Send + 'static,
    ) -> Result<Self, TransportError> {
        Self::open_from(settings, Box::new(SystemPorts(Box::new(is_another))))
    }

    /// Opens a port of `ports`, now and after every loss.
    ///
    /// # Errors
    /// As [`SerialTransport::open`].
    pub fn open_from(settings: SerialSettings, ports: Box<dyn Ports>) -> Result<Self, TransportError> {
        let mut serial = Self::closed(settings, ports);
        serial.reopen()?;
        Ok(serial)
    }

    /// Uses a port that is already open (a pseudo-terminal) and never blocks, see [`tty::never_wait`].
    pub fn with_port(settings: SerialSettings, port: Box<dyn SerialPort>) -> Self {
        let mut serial = Self::closed(settings, Box::new(SystemPorts(Box::new(|| false))));
        serial.reader = serial.ports.arrivals(&*port, &serial.clock);
        serial.port = Some(port);
        serial
    }

    fn closed(settings: SerialSettings, ports: Box<dyn Ports>) -> Self {
        let room = encoded_bytes(settings.frame_bytes) + 2 * (MAX_PLANES + 1);
        Self {
            settings,
            ports,
            port: None,
            reader: None,
            clock: Arc::new(OnceLock::new()),
            deframer: Deframer::new([0; DEFRAMED]),
            is_fresh: true,
            data: vec![0; room],
            ends: [0; MAX_PLANES + 1],
            packets: 0,
            next_packet: 0,
            control: Vec::with_capacity(CONTROL_WAITING),
            going: None,
            counters: SerialCounters::default(),
        }
    }

    /// The counters so far.
    pub fn counters(&self) -> SerialCounters {
        self.counters
    }

    /// Encoded bytes that the line has not taken yet.
    pub fn waiting(&self) -> usize {
        let data = if self.packets == 0 { 0 } else { self.ends[self.packets - 1] - self.data_at() };
        data + self.control.len()
    }

    fn data_at(&self) -> usize {
        match self.going {
            Some((Lane::Data, at, _)) => at,
            _ if self.next_packet == 0 => 0,
            _ => self.ends[self.next_packet - 1],
        }
    }

    fn gone(&mut self) -> TransportError {
        (self.port, self.reader) = (None, None);
        TransportError::Unplugged { device: self.settings.path.clone() }
    }

    /// Writes as much as the line takes now.
    fn flush(&mut self) -> Result<(), TransportError> {
        loop {
            let (lane, at, end) = match self.going {
                Some(going) => going,
                None if !self.control.is_empty() => (Lane::Control, 0, self.control.len()),
                None if self.next_packet < self.packets => {
                    let at = self.data_at();
                    self.next_packet += 1;
                    (Lane::Data, at, self.ends[self.next_packet - 1])
                }
                None => return Ok(()),
            };
            self.going = Some((lane, at, end));
            let Some(port) = &mut self.port else { return Err(self.gone()) };
            let bytes = match lane {
                Lane::Control => &self.control[at..end],
                Lane::Data => {
                    let ahead = (self.settings.baud / BITS_PER_BYTE / AHEAD_PER_S).max(1) as usize;
                    // A driver that does not report the size of its backlog counts as empty.
                    let room = ahead.saturating_sub(port.bytes_to_write().unwrap_or(0) as usize);
                    if room == 0 {
                        return Ok(());
                    }
                    &self.data[at..end.min(at + room)]
                }
            };
            match port.write(bytes) {
                Ok(0) => return Ok(()),
                Ok(n) => {
                    self.counters.bytes_out += n as u64;
                    self.going = Some((lane, at + n, end));
                    if at + n < end {
                        continue;
                    }
                    self.going = None;
                    match lane {
                        // Messages that arrived during this transmission wait behind it.
                        Lane::Control => drop(self.control.drain(..end)),
                        Lane::Data if self.next_packet == self.packets => {
                            (self.packets, self.next_packet) = (0, 0);
                        }
                        Lane::Data => {}
                    }
                }
                Err(e) => match e.kind() {
                    ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted => return Ok(()),
                    _ => return Err(self.gone()),
                },
            }
        }
    }
}

impl std::fmt::Debug for SerialTransport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SerialTransport")
            .field("settings", &self.settings)
            .field("counters", &self.counters)
            .finish()
    }
}

impl Transport for SerialTransport {
    fn send(&mut self, _now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        self.flush()?;
        match lane {
            Lane::Control => {
                for packet in packets {
                    let from = self.control.len();
                    let room = encoded_bytes(packet.wire_bytes());
                    if from + room > CONTROL_WAITING {
                        return Err(SendError::Busy);
                    }
                    self.control.resize(from + room, 0);
                    let n = encode(
                        &[packet.header(), packet.payload(), &packet.trailer()],
                        &mut self.control[from..],
                    )
                    .unwrap_or(0);
                    self.control.truncate(from + n);
                }
            }
            Lane::Data => {
                if self.packets > 0 {
                    return Err(SendError::Busy);
                }
                let mut at = 0;
                for (packet, end) in packets.iter().zip(&mut self.ends) {
                    let n =
                        encode(&[packet.header(), packet.payload(), &packet.trailer()], &mut self.data[at..]);
                    at += n.unwrap_or_else(|| {
                        panic!("frame longer than the {} bytes agreed", self.settings.frame_bytes)
                    });
                    *end = at;
                }
                (self.packets, self.next_packet) = (packets.len(), 0);
            }
        }
        Ok(self.flush()?)
    }

    fn has_room(&mut self, lane: Lane) -> bool {
        match lane {
            Lane::Control => self.control.len() + encoded_bytes(DEFRAMED) <= CONTROL_WAITING,
            Lane::Data => self.packets == 0,
        }
    }

    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        self.flush()?;
        let (deframer, is_fresh) = (&mut self.deframer, &mut self.is_fresh);
        let mut pass = |at: HostTime, frame: &[u8]| {
            // A port that is opened amid a packet gives the rest of it: those bytes are no fault of the device's.
            if !std::mem::take(is_fresh) || frame.starts_with(&MAGIC) {
                sink(Lane::Control, at, frame);
            }
        };
        if let Some(reader) = &mut self.reader {
            let taken = reader.take(now, &mut |at, bytes| {
                deframer.push(bytes, &mut |frame| pass(at, frame));
            });
            let Some(bytes) = taken else { return Err(self.gone()) };
            self.counters.bytes_in += bytes as u64;
            return Ok(());
        }
        let mut bytes = [0u8; 2048];
        let mut left = READ_AT_ONCE;
        while left > 0 {
            let Some(port) = &mut self.port else { return Err(self.gone()) };
            match port.read(&mut bytes) {
                // End of file: the other end of a pseudo-terminal is closed, or the adapter is gone.
                Ok(0) => return Err(self.gone()),
                Ok(n) => {
                    self.counters.bytes_in += n as u64;
                    left = left.saturating_sub(n);
                    deframer.push(&bytes[..n], &mut |frame| pass(now, frame));
                }
                Err(e) => match e.kind() {
                    ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted => break,
                    _ => return Err(self.gone()),
                },
            }
        }
        Ok(())
    }

    fn set_clock(&mut self, clock: Arc<dyn HostClock>) {
        // A second clock would make earlier stamps worthless.
        let _ = self.clock.set(clock);
    }

    fn flush_output(&mut self) {
        (self.packets, self.next_packet, self.going) = (0, 0, None);
        self.control.clear();
        if let Some(port) = &self.port {
            // If the driver cannot, its backlog is short.
            let _ = port.clear(ClearBuffer::Output);
        }
        // Ends the partial packet in the device, wherever it was cut.
        self.control.push(0);
    }

    fn reopen(&mut self) -> Result<(), TransportError> {
        // The reader's handle would also prevent the port from being reopened.
        (self.port, self.reader) = (None, None);
        let port = self.ports.open(&self.settings).map_err(|e| open_error(&self.settings.path, e))?;
        self.reader = self.ports.arrivals(&*port, &self.clock);
        self.port = Some(port);
        self.deframer.reset();
        self.is_fresh = true;
        self.control.clear();
        (self.packets, self.next_packet, self.going) = (0, 0, None);
        self.counters.opened += 1;
        Ok(())
    }

    fn name(&self) -> &str {
        &self.settings.path
    }
}

fn open_error(path: &str, e: serialport::Error) -> TransportError {
    let device = format!("serial port {path}");
    match tty::refusal(&e) {
        Refusal::InUse => TransportError::InUse { device },
        Refusal::Absent => TransportError::NotFound { device },
        refusal @ Refusal::Denied => {
            TransportError::PermissionDenied { device, remedy: refusal.remedy().into() }
        }
        refusal => TransportError::Serial { device, source: e, remedy: refusal.remedy() },
    }
}
