//! A tracker on a serial line: the device, two ways of bytes at the line's rate, the adapter at the host, and its port.

use crate::cable::lock;
use crate::dice::Dice;
use crate::line::{Spoils, Way, DRIVER_BYTES, INPUT_BYTES};
use crate::net::{Net, ServerKind};
use dpm_device::cobs::encoded_bytes;
use dpm_device::time::HostTime;
use dpm_device::tracker::serial::wire::VERSION;
use dpm_device::tracker::{Opener, Stream};
use hil_mock::faults::FaultPlan;
use hil_mock::serial_server::{SerialDeviceKind, SerialPoseDevice};
use hil_mock::tracker::SampleSource;
use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read, Write};
use std::sync::{Arc, Mutex};

/// Bytes of a pose on the wire: 52, the checksum, the framing's two.
pub const POSE_BYTES: i64 = encoded_bytes(56) as i64;
/// Bytes that wait in the device for its line; a report for which there is no room is left out.
const DEVICE_BYTES: usize = 512;
/// Bits of a byte: start, eight, stop.
const BITS: i64 = 10;
const MS: i64 = 1_000_000;

/// The line of one life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LineSetup {
    /// Bits per second.
    pub baud: u32,
    /// The adapter hands bytes on only at multiples of this time, nanoseconds; 0: at once.
    pub timer_ns: i64,
    /// Error of the device's clock, parts per billion.
    pub skew_ppb: i32,
    /// The device has no supply but the plug.
    pub is_bus_powered: bool,
}

impl LineSetup {
    /// How long a pose is under way, nanoseconds.
    pub fn pose_ns(&self) -> i64 {
        POSE_BYTES * self.byte_ns() + self.timer_ns
    }

    fn byte_ns(&self) -> i64 {
        BITS * 1_000_000_000 / i64::from(self.baud)
    }
}

/// How the line behaves at present.
#[derive(Clone, Copy, Debug, Default)]
pub struct LineFaults {
    /// What happens to bytes, in both directions.
    pub(crate) spoils: Spoils,
    /// The host hears what it says.
    pub echoes: bool,
    /// The port may not be opened.
    pub denied: bool,
    /// The adapter hands nothing on until this is false again.
    pub held: bool,
}

/// See the module's documentation.
pub struct TrackerLine {
    setup: LineSetup,
    device: SerialPoseDevice,
    /// The device sends nothing and hears nothing before.
    starts_at: i64,
    to_host: Way,
    to_device: Way,
    /// What the host's driver holds.
    input: VecDeque<Vec<u8>>,
    is_plugged: bool,
    /// How often it was plugged in, and how often the port was opened: what is open is known by both.
    plugs: u64,
    ports: u64,
    is_open: bool,
    /// When the attempt to open the port is over.
    opening: Option<i64>,
    dice: Dice,
    said: Vec<u8>,
}

fn device_of(kind: &ServerKind, source: SampleSource, setup: &LineSetup) -> Result<SerialPoseDevice, String> {
    let own = SerialDeviceKind {
        version: if kind.is_old { VERSION + 1 } else { VERSION },
        first_body: if kind.number == 1 { 0 } else { kind.number as u8 },
        skew_ppb: setup.skew_ppb,
    };
    Ok(SerialPoseDevice::new(source).map_err(|e| e.to_string())?.of_kind(own))
}

impl TrackerLine {
    /// A line with a device of this kind at its end.
    pub fn new(seed: u64, kind: &ServerKind, source: SampleSource, setup: LineSetup) -> Result<Self, String> {
        Ok(Self {
            device: device_of(kind, source, &setup)?,
            setup,
            starts_at: 0,
            to_host: Way::default(),
            to_device: Way::default(),
            input: VecDeque::new(),
            is_plugged: true,
            plugs: 0,
            ports: 0,
            is_open: false,
            opening: None,
            dice: Dice::new(seed, 0x7e11),
            said: Vec::new(),
        })
    }

    /// The device has these faults from now on.
    pub fn set_faults(&mut self, faults: FaultPlan) -> Result<(), String> {
        self.device.set_faults(faults).map_err(|e| e.to_string())
    }

    /// Another device is at the end of the line, or the same one starts anew.
    pub fn replace(&mut self, kind: &ServerKind, source: SampleSource, now: i64) -> Result<(), String> {
        self.device = device_of(kind, source, &self.setup)?;
        self.start_device(now);
        Ok(())
    }

    /// The device starts, with some noise on its line.
    fn start_device(&mut self, now: i64) {
        self.to_host.queue.clear();
        let noise: Vec<u8> = (0..self.dice.bits() % 60).map(|_| self.dice.bits() as u8).collect();
        self.to_host.put(&noise, now, self.setup.byte_ns());
        self.starts_at = now + self.dice.decades(1, 300) * MS;
        self.device.begin_at(HostTime(self.starts_at));
    }

    /// The adapter is pulled out of the host.
    pub fn pull(&mut self) {
        (self.is_plugged, self.is_open) = (false, false);
        for way in [&mut self.to_host, &mut self.to_device] {
            way.begun.clear();
            way.landing.clear();
        }
        self.to_device.queue.clear();
        self.input.clear();
    }

    /// It is plugged in again.
    pub fn push_in(&mut self, now: i64) {
        if self.is_plugged {
            return;
        }
        self.is_plugged = true;
        self.plugs += 1;
        if self.setup.is_bus_powered {
            self.start_device(now);
        }
    }

    /// When something happens here next.
    pub fn due(&self, faults: &LineFaults) -> i64 {
        let byte_ns = self.setup.byte_ns();
        let report = if self.has_supply() { self.reports_at() } else { i64::MAX };
        let held = if faults.held { i64::MAX } else { self.lands_at() };
        report.min(self.to_host.whole_at(byte_ns)).min(self.to_device.due(byte_ns)).min(held)
    }

    fn reports_at(&self) -> i64 {
        self.device.next_due().0.max(self.starts_at)
    }

    /// When the adapter hands the next piece on.
    fn lands_at(&self) -> i64 {
        self.to_host.landing.front().map_or(i64::MAX, |(at, _)| self.handed_on(*at))
    }

    fn handed_on(&self, at: i64) -> i64 {
        let timer_ns = self.setup.timer_ns.max(1);
        (at + timer_ns - 1) / timer_ns * timer_ns
    }

    /// When the host finds something in its port, as far as that is known.
    pub fn next_arrival(&self, now: i64) -> i64 {
        if !self.is_open {
            return i64::MAX;
        }
        if !self.input.is_empty() {
            return now;
        }
        let reported = self.reports_at();
        let whole = self.to_host.whole_at(self.setup.byte_ns());
        let next = whole.min(reported.saturating_add(POSE_BYTES * self.setup.byte_ns()));
        self.lands_at().min(self.handed_on(next.min(i64::MAX / 2)))
    }

    /// Advances to `now`.
    pub fn advance(&mut self, now: i64, faults: &LineFaults) {
        let byte_ns = self.setup.byte_ns();
        let mut spoils = faults.spoils;
        spoils.silent |= !self.is_plugged;
        let (mut told, mut heard) = (Vec::new(), Vec::new());
        self.to_device.carry(now, byte_ns, 0, &spoils, &mut self.dice, &mut told);
        self.to_host.carry(now, byte_ns, 0, &spoils, &mut self.dice, &mut heard);
        if faults.echoes {
            self.to_host.put(&told, now, byte_ns);
        }
        while self.to_device.landing.front().is_some_and(|(at, _)| *at <= now) {
            let Some((at, bytes)) = self.to_device.landing.pop_front() else { break };
            if at >= self.starts_at {
                self.device.on_bytes(&bytes, HostTime(at), &mut self.said);
            }
        }
        if now >= self.starts_at && self.has_supply() {
            self.device.report(HostTime(now), &mut self.said);
        }
        if self.to_host.queue.len() + self.said.len() <= DEVICE_BYTES {
            self.to_host.put(&self.said, now, byte_ns);
        }
        self.said.clear();
        while !faults.held && self.lands_at() <= now {
            let Some((_, bytes)) = self.to_host.landing.pop_front() else { break };
            self.take_in(bytes);
        }
    }

    fn has_supply(&self) -> bool {
        self.is_plugged || !self.setup.is_bus_powered
    }

    /// The driver takes bytes in. While no program has the port, it keeps little.
    fn take_in(&mut self, bytes: Vec<u8>) {
        let room = if self.is_open { INPUT_BYTES } else { INPUT_BYTES / 8 };
        let held: usize = self.input.iter().map(Vec::len).sum();
        if held + bytes.len() <= room {
            self.input.push_back(bytes);
        }
    }

    /// The program begins to open the port.
    fn begin_to_open(&mut self, now: i64) {
        self.opening = Some(now + self.dice.decades(1, 80) * MS);
        // A program that has ended has closed the port.
        self.is_open = false;
    }

    fn opened(&mut self, now: i64, faults: &LineFaults) -> Option<Result<(u64, u64), String>> {
        self.opening.take_if(|at| *at <= now)?;
        if !self.is_plugged {
            return Some(Err("cannot open /dev/tracker: No such file or directory".into()));
        }
        if faults.denied {
            return Some(Err("cannot open /dev/tracker: Device or resource busy".into()));
        }
        // It is flushed when it is opened, but the adapter may hold more than can be flushed.
        if self.dice.happens(0.7) {
            self.input.clear();
        }
        self.ports += 1;
        self.is_open = true;
        Some(Ok((self.plugs, self.ports)))
    }

    fn is_same(&self, (plug, port): (u64, u64)) -> bool {
        self.is_plugged && self.is_open && self.plugs == plug && self.ports == port
    }

    fn close(&mut self, port: (u64, u64)) {
        if self.is_same(port) {
            self.is_open = false;
        }
    }

    fn read(&mut self, port: (u64, u64), into: &mut [u8]) -> io::Result<usize> {
        if !self.is_same(port) {
            // Drivers tell a hang-up in two ways.
            return if self.plugs.is_multiple_of(2) { Ok(0) } else { Err(ErrorKind::BrokenPipe.into()) };
        }
        let mut n = 0;
        while let Some(bytes) = self.input.front_mut() {
            let part = bytes.len().min(into.len() - n);
            into[n..n + part].copy_from_slice(&bytes[..part]);
            n += part;
            if part < bytes.len() {
                bytes.drain(..part);
                break;
            }
            self.input.pop_front();
        }
        if n == 0 {
            return Err(ErrorKind::WouldBlock.into());
        }
        Ok(n)
    }

    fn write(&mut self, port: (u64, u64), bytes: &[u8], now: i64) -> io::Result<usize> {
        if !self.is_same(port) {
            return Err(ErrorKind::BrokenPipe.into());
        }
        let n = bytes.len().min(DRIVER_BYTES.saturating_sub(self.to_device.queue.len()));
        self.to_device.put(&bytes[..n], now, self.setup.byte_ns());
        Ok(n)
    }
}

/// Opens the simulated port.
pub struct PortOpener(pub Arc<Mutex<Net>>);

impl Opener for PortOpener {
    fn begin(&mut self) -> bool {
        lock(&self.0).on_line(|line, now, _| line.begin_to_open(now)).is_some()
    }

    fn outcome(&mut self) -> Option<Result<Box<dyn Stream>, String>> {
        let mut net = lock(&self.0);
        let opened = net.on_line(TrackerLine::opened)??;
        if net.called().is_err() {
            return Some(Err("cannot open /dev/tracker: Input/output error".into()));
        }
        Some(opened.map(|port| Box::new(TrackerPort(self.0.clone(), port)) as Box<dyn Stream>))
    }
}

/// The open port.
struct TrackerPort(Arc<Mutex<Net>>, (u64, u64));

impl Stream for TrackerPort {}

impl Read for TrackerPort {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let mut net = lock(&self.0);
        net.called()?;
        net.on_line(|line, _, _| line.read(self.1, into)).unwrap_or(Ok(0))
    }
}

impl Write for TrackerPort {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut net = lock(&self.0);
        net.called()?;
        net.on_line(|line, now, _| line.write(self.1, bytes, now)).unwrap_or(Ok(0))
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Drop for TrackerPort {
    fn drop(&mut self) {
        let _ = lock(&self.0).on_line(|line, _, _| line.close(self.1));
    }
}
