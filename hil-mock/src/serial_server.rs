//! Sends true poses as the serial pose stream: the device's side as a state machine, and the same on a port or
//! pseudo-terminal.

use crate::faults::{FaultError, FaultKind};
use crate::report_queue::ReportQueue;
use crate::tracker::SampleSource;
use dpm_device::cobs::Deframer;
use dpm_device::time::{HostClock, HostTime};
use dpm_device::tracker::serial::wire::{SerialMessage, MAX_PACKET, VERSION};
use dpm_device::tracker::BodyIndex;
use dpm_device::tty::{never_wait, would_wait};
use serialport::{SerialPort, TTYPort};
use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// The faults that the device implements: all but `unplug` and `reset`, which concern its port.
pub const SERIAL_FAULTS: [FaultKind; 14] = [
    FaultKind::Loss,
    FaultKind::Corrupt,
    FaultKind::Truncate,
    FaultKind::Duplicate,
    FaultKind::Reorder,
    FaultKind::Nan,
    FaultKind::Norm,
    FaultKind::Flip,
    FaultKind::Invalid,
    FaultKind::Dropout,
    FaultKind::Stuck,
    FaultKind::Jump,
    FaultKind::Stall,
    FaultKind::Slow,
];

/// Rate of the device's clock: a microsecond timer, as microcontrollers have.
pub const TICKS_PER_SECOND: u32 = 1_000_000;
const HELLO_EVERY_NS: i64 = 1_000_000_000;

/// The device without its port.
pub struct SerialPoseDevice {
    source: SampleSource,
    queue: ReportQueue,
    deframer: Deframer<[u8; MAX_PACKET]>,
    hello_due: HostTime,
    echoes: u64,
}

impl SerialPoseDevice {
    /// A device that reports the bodies of `source`, at most 256.
    pub fn new(source: SampleSource) -> Result<Self, FaultError> {
        source.config().faults.check_supported(&SERIAL_FAULTS, "the serial tracker")?;
        let hello_due = HostTime(i64::MIN);
        Ok(Self {
            source,
            queue: ReportQueue::new(),
            deframer: Deframer::new([0; MAX_PACKET]),
            hello_due,
            echoes: 0,
        })
    }

    /// The source of the poses.
    pub fn source(&self) -> &SampleSource {
        &self.source
    }

    /// Echo requests answered.
    pub fn echoes(&self) -> u64 {
        self.echoes
    }

    /// Latest time for the next call of `report`.
    pub fn next_due(&self) -> HostTime {
        self.queue.next_due(&self.source).min(self.hello_due)
    }

    fn ticks_at(&self, now: HostTime) -> u64 {
        (now.ns_since(self.source.config().start).max(0) / 1000) as u64
    }

    /// Handles bytes of the host and appends answers to `out`.
    pub fn on_bytes(&mut self, bytes: &[u8], now: HostTime, out: &mut Vec<u8>) {
        let (ticks, echoes, hello_due) = (self.ticks_at(now), &mut self.echoes, &mut self.hello_due);
        self.deframer.push(bytes, &mut |packet| match SerialMessage::decode(packet) {
            Ok(SerialMessage::EchoRequest { token }) => {
                *echoes += 1;
                SerialMessage::EchoResponse { token, ticks }.encode(out);
            }
            Ok(SerialMessage::HelloRequest) => *hello_due = now,
            _ => {}
        });
    }

    /// Appends all reports due by `now` to `out`.
    pub fn report(&mut self, now: HostTime, out: &mut Vec<u8>) {
        let bodies = self.source.body_count().min(256);
        if now >= self.hello_due {
            self.hello_due = now.plus_ns(HELLO_EVERY_NS);
            let hello = SerialMessage::Hello {
                version: VERSION,
                bodies: bodies as u8,
                ticks_per_second: TICKS_PER_SECOND,
            };
            hello.encode(out);
        }
        let due = self.queue.take_due(&self.source, now).to_vec();
        for k in due {
            let start = out.len();
            for body in 0..bodies {
                let Some(sample) = self.source.sample(BodyIndex(body as u16), k) else { continue };
                let message = SerialMessage::Pose {
                    body: body as u8,
                    tracked: sample.tracked,
                    sequence: sample.sequence,
                    captured: self.ticks_at(sample.captured_at),
                    position: sample.pose.position_m.map(|c| c as f32),
                    rotation_xyzw: sample.pose.rotation_xyzw.map(|c| c as f32),
                    mean_error: sample.mean_error_m,
                };
                message.encode(out);
            }
            let length = out.len() - start;
            if let (Some(bits), true) = (self.source.byte_fault(FaultKind::Corrupt, 0, k), length > 0) {
                out[start + bits as usize % length] ^= ((bits >> 32) as u8).max(1);
            }
            if let (Some(bits), true) = (self.source.byte_fault(FaultKind::Truncate, 0, k), length > 0) {
                out.truncate(start + bits as usize % length);
            }
        }
    }
}

/// The device on a port, until it is dropped.
pub struct SerialPoseHost {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<io::Result<()>>>,
}

impl SerialPoseHost {
    /// Serves on `port`, which must never block (see [`dpm_device::tty`]): a line that nobody reads would block the
    /// thread for ever.
    pub fn start(
        device: SerialPoseDevice,
        port: Box<dyn SerialPort>,
        clock: Arc<dyn HostClock>,
    ) -> io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let thread = {
            let stop = stop.clone();
            let run = move || run(device, port, &*clock, &stop);
            std::thread::Builder::new().name("serial-tracker".into()).spawn(run)?
        };
        Ok(Self { stop, thread: Some(thread) })
    }

    /// True until the thread ends, which happens when the port fails.
    pub fn is_running(&self) -> bool {
        self.thread.as_ref().is_some_and(|t| !t.is_finished())
    }
}

impl Drop for SerialPoseHost {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // `is_running` shows an error or panic of the thread; nobody is left to inform here.
            let _ = thread.join();
        }
    }
}

/// A pseudo-terminal: the end to serve on, which never blocks, and the path that clients open. The last value holds the
/// client's end open, without claiming it, so that the server's end does not hang up between clients.
pub fn pseudo_terminal() -> serialport::Result<(Box<dyn SerialPort>, String, File)> {
    let (ours, theirs) = TTYPort::pair()?;
    let path = theirs.name().unwrap_or_default();
    let held = OpenOptions::new().read(true).write(true).custom_flags(libc::O_NOCTTY).open(&path)?;
    // Closing it releases the lock that would keep clients out; the raw mode that it set stays while `held` is open.
    drop(theirs);
    Ok((never_wait(ours)?, path, held))
}

fn run(
    mut device: SerialPoseDevice,
    mut port: Box<dyn SerialPort>,
    clock: &dyn HostClock,
    stop: &AtomicBool,
) -> io::Result<()> {
    let mut buffer = [0; 1024];
    let mut out = Vec::with_capacity(4096);
    while !stop.load(Ordering::Relaxed) {
        match port.read(&mut buffer) {
            Ok(n) => device.on_bytes(&buffer[..n], clock.now(), &mut out),
            Err(e) if would_wait(&e) => {}
            Err(e) => return Err(e),
        }
        device.report(clock.now(), &mut out);
        while !out.is_empty() {
            match port.write(&out) {
                Ok(n) => drop(out.drain(..n)),
                Err(e) if would_wait(&e) => break,
                Err(e) => return Err(e),
            }
        }
        if out.len() > 16 * 1024 {
            // Nobody reads: a real line drops the bytes.
            out.clear();
        }
        let wait_ns = device.next_due().ns_since(clock.now()).clamp(0, 200_000);
        std::thread::sleep(Duration::from_nanos(wait_ns as u64));
    }
    Ok(())
}
