//! Sends true poses as the serial pose stream: the device's side as a state machine, and the same on a port or
//! pseudo-terminal.

use crate::faults::{FaultError, FaultKind, FaultPlan};
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
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// The faults that the device implements: all but `unplug` and `reset`, which concern its port.
pub const SERIAL_FAULTS: [FaultKind; 16] = [
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
    FaultKind::Unseen,
    FaultKind::Exchange,
];

/// Rate of the device's clock: a microsecond timer, as microcontrollers have.
pub const TICKS_PER_SECOND: u32 = 1_000_000;
const HELLO_EVERY_NS: i64 = 1_000_000_000;

/// How a device differs from others of its kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SerialDeviceKind {
    /// Version that it announces.
    pub version: u8,
    /// Number of its first body.
    pub first_body: u8,
    /// Error of its clock, parts per billion.
    pub skew_ppb: i32,
}

impl Default for SerialDeviceKind {
    fn default() -> Self {
        Self { version: VERSION, first_body: 0, skew_ppb: 0 }
    }
}

/// The device without its port.
pub struct SerialPoseDevice {
    kind: SerialDeviceKind,
    source: SampleSource,
    /// When its clock began, and the first sample that it has seen since.
    began_at: HostTime,
    first: u64,
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
            kind: SerialDeviceKind::default(),
            began_at: source.config().start,
            first: 0,
            source,
            queue: ReportQueue::new(),
            deframer: Deframer::new([0; MAX_PACKET]),
            hello_due,
            echoes: 0,
        })
    }

    /// The same device as one of this kind.
    pub fn of_kind(self, kind: SerialDeviceKind) -> Self {
        Self { kind, ..self }
    }

    /// From now on the device has these faults, with times relative to the source's start.
    ///
    /// # Errors
    /// A fault that the device does not implement; the former faults remain.
    pub fn set_faults(&mut self, faults: FaultPlan) -> Result<(), FaultError> {
        faults.check_supported(&SERIAL_FAULTS, "the serial tracker")?;
        self.source.set_faults(faults);
        Ok(())
    }

    /// The device starts at `now`: its clock and its numbers begin anew, and what was captured before is never sent.
    pub fn begin_at(&mut self, now: HostTime) {
        self.queue = ReportQueue::new();
        let _ = self.queue.take_due(&self.source, now);
        self.first = self.queue.newest().map_or(0, |newest| newest + 1);
        (self.began_at, self.hello_due) = (now, now);
        self.deframer.reset();
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
        let t = i128::from(now.ns_since(self.began_at).max(0));
        ((t + t * i128::from(self.kind.skew_ppb) / 1_000_000_000) / 1000) as u64
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
                version: self.kind.version,
                bodies: bodies as u8,
                ticks_per_second: TICKS_PER_SECOND,
            };
            hello.encode(out);
        }
        let due = self.queue.take_due(&self.source, now).to_vec();
        for k in due.into_iter().filter(|k| *k >= self.first) {
            let start = out.len();
            for body in 0..bodies {
                let Some(sample) = self.source.sample(BodyIndex(body as u16), k) else { continue };
                let message = SerialMessage::Pose {
                    body: self.kind.first_body.wrapping_add(body as u8),
                    tracked: sample.tracked,
                    sequence: sample.sequence.wrapping_sub(self.first as u32),
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

/// A name for a port that stays the same when the port is plugged in again, as udev gives names: a link to the terminal.
///
/// Drop it before the terminal. The kernel gives the number of a closed pseudo-terminal to the next one, which is
/// somebody else's, and a name left behind would lead there.
#[derive(Debug)]
pub struct PortName(PathBuf);

impl PortName {
    /// Makes `name` lead to `terminal`, wherever it led before.
    ///
    /// # Errors
    /// The link cannot be made.
    pub fn give(name: &Path, terminal: &str) -> io::Result<Self> {
        let _ = std::fs::remove_file(name);
        std::os::unix::fs::symlink(terminal, name)?;
        Ok(Self(name.to_owned()))
    }
}

impl Drop for PortName {
    fn drop(&mut self) {
        // Somebody else may have removed its folder; then it leads nowhere either.
        let _ = std::fs::remove_file(&self.0);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::{Motion, MotionSpec};
    use crate::tracker::MockTrackerConfig;
    use dpm_device::pose::Pose;

    #[test]
    fn a_device_that_starts_again_counts_and_keeps_time_anew() {
        let still = Motion::new(&MotionSpec::Still {}, Pose::IDENTITY).unwrap();
        let source = SampleSource::new(MockTrackerConfig::default(), vec![still]).unwrap();
        let kind = SerialDeviceKind { version: 7, first_body: 3, skew_ppb: 1_000_000 };
        let mut device = SerialPoseDevice::new(source).unwrap().of_kind(kind);
        device.report(HostTime(1_000_000_000), &mut Vec::new());
        device.begin_at(HostTime(2_000_000_000));
        let (mut out, mut messages) = (Vec::new(), Vec::new());
        device.report(HostTime(2_010_000_000), &mut out);
        Deframer::new([0; MAX_PACKET]).push(&out, &mut |packet| {
            messages.push(SerialMessage::decode(packet).unwrap());
        });
        assert!(matches!(messages[0], SerialMessage::Hello { version: 7, .. }), "{messages:?}");
        let SerialMessage::Pose { body: 3, sequence: 0, captured, .. } = messages[1] else {
            panic!("{messages:?}");
        };
        // Samples come every 2 ms, and this clock is fast by a thousandth.
        assert!((1_900..=2_002).contains(&captured), "{captured}");
        assert!(messages.len() >= 4, "{messages:?}");
        assert!(device.set_faults("unplug@1s+1s".parse().unwrap()).is_err());
        assert!(device.set_faults("nan=1".parse().unwrap()).is_ok());
    }
}
