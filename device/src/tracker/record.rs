//! Records samples in an append-only file and replays them: a recorder around any tracker, and a tracker that plays a
//! recording.
//!
//! File: the header (16-byte magic `dpm-track-0001\r\n`, then one frame with the start instant and the names of the bodies), then
//! frames. A frame is `u32 length, payload, u32 CRC-32C of length and payload`, little-endian; a payload holds samples of
//! [`SAMPLE_BYTES`] bytes, exact to the bit. A writer that dies leaves at most a torn last frame, at which the reader stops.

use super::{BodyIndex, BodyKey, SampleGate, Tracker, TrackerCounters, TrackerError, TrackerSample};
use crate::link::{crc32c, crc32c_append};
use crate::pose::Pose;
use crate::time::HostTime;
use crossbeam::channel::{bounded, Receiver, Sender, TryRecvError};
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

const MAGIC: &[u8; 16] = b"dpm-track-0001\r\n";
/// Bytes of one sample.
pub const SAMPLE_BYTES: usize = 92;
/// Largest payload of a frame: the writer never makes a larger one, and the reader refuses one.
const MAX_PAYLOAD: usize = 64 * 1024;
/// Samples that may wait for the writer: seconds of a busy rig.
const QUEUE: usize = 16_384;
/// Interval of the writer; together with the write itself this stays well below the promised 100 ms.
const WRITE_EVERY: Duration = Duration::from_millis(20);
/// Interval at which the file is synchronised to the disk, for crashes of the whole machine.
const SYNC_EVERY: Duration = Duration::from_millis(80);
/// Most samples of a recording that is replayed: 2.4 GB, 12 hours of two bodies at 500 Hz.
const MAX_REPLAYED: usize = 25_000_000;

/// Why a recording cannot be made or read.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The operating system refused.
    #[error("recording {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// The file is something else, or its header is damaged.
    #[error("{path} is not a tracker recording: {why}")]
    NotARecording {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        why: &'static str,
    },
    /// The rig wants bodies that the recording does not have.
    #[error("{path} has no body {wanted:?}; it has {known:?}")]
    UnknownBody {
        /// The file.
        path: PathBuf,
        /// The missing name.
        wanted: String,
        /// Names in the recording.
        known: Vec<String>,
    },
    /// More samples than fit into memory for replay.
    #[error("{path} has more than {MAX_REPLAYED} samples; replay a part of it")]
    TooLong {
        /// The file.
        path: PathBuf,
    },
}

/// A tracker that passes on the samples of another one and records them. A separate thread writes. If it cannot keep
/// up, samples go unrecorded and are counted, never delayed.
pub struct Recorder<T> {
    inner: T,
    queue: Option<Sender<TrackerSample>>,
    unrecorded: u64,
    shared: Arc<RecorderState>,
    thread: Option<JoinHandle<std::io::Result<()>>>,
    path: PathBuf,
}

#[derive(Default)]
struct RecorderState {
    written: AtomicU64,
    failed: AtomicBool,
}

impl<T: Tracker> Recorder<T> {
    /// Records `inner` into the new file `path` (an existing file is an error: recordings are not overwritten). `start` is the
    /// instant that a replay starts from.
    pub fn create(inner: T, path: &Path, bodies: &[BodyKey], start: HostTime) -> Result<Self, RecordError> {
        let failed = |source| RecordError::Io { path: path.to_owned(), source };
        let mut file = OpenOptions::new().write(true).create_new(true).open(path).map_err(failed)?;
        file.write_all(&header(bodies, start)).map_err(failed)?;
        let (queue, samples) = bounded(QUEUE);
        let shared = Arc::new(RecorderState::default());
        let thread = {
            let shared = shared.clone();
            let builder = std::thread::Builder::new().name("tracker-record".into());
            let spawned = builder.spawn(move || {
                let result = write_all(file, &samples, &shared);
                shared.failed.store(result.is_err(), Ordering::Relaxed);
                result
            });
            spawned.map_err(failed)?
        };
        let (queue, thread) = (Some(queue), Some(thread));
        Ok(Self { inner, queue, unrecorded: 0, shared, thread, path: path.to_owned() })
    }

    /// Samples that the file holds so far.
    pub fn written(&self) -> u64 {
        self.shared.written.load(Ordering::Relaxed)
    }

    /// Samples that were passed on but not recorded, because the writer was behind or had failed.
    pub fn unrecorded(&self) -> u64 {
        self.unrecorded
    }

    /// True if writing failed, for example for lack of space; [`Recorder::finish`] has the reason. The part written
    /// before can be played.
    pub fn has_failed(&self) -> bool {
        self.shared.failed.load(Ordering::Relaxed)
    }

    /// The tracker recorded.
    pub fn inner(&self) -> &T {
        &self.inner
    }

    /// Writes the rest and closes the file.
    pub fn finish(mut self) -> Result<u64, RecordError> {
        self.close().map_err(|source| RecordError::Io { path: self.path.clone(), source })?;
        Ok(self.written())
    }
}

impl<T> Recorder<T> {
    fn close(&mut self) -> std::io::Result<()> {
        self.queue = None;
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(result)) => result,
            Some(Err(_)) => Err(std::io::Error::other("the writing thread panicked")),
            None => Ok(()),
        }
    }
}

impl<T> Drop for Recorder<T> {
    fn drop(&mut self) {
        // `finish` reports errors; a recorder that is merely dropped cannot report any.
        let _ = self.close();
    }
}

impl<T: Tracker> Tracker for Recorder<T> {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        let (queue, unrecorded) = (&self.queue, &mut self.unrecorded);
        self.inner.poll(now, &mut |sample| {
            // The writer never blocks in receive, so this call neither blocks nor wakes a thread.
            if queue.as_ref().is_none_or(|q| q.try_send(*sample).is_err()) {
                *unrecorded += 1;
            }
            sink(sample);
        })
    }

    fn name(&self) -> &str {
        self.inner.name()
    }

    fn warning(&self) -> Option<String> {
        self.inner.warning()
    }

    fn status(&self) -> String {
        let problem = if self.shared.failed.load(Ordering::Relaxed) { ", WRITING FAILED" } else { "" };
        format!(
            "{}; recorded {}, unrecorded {}{problem}",
            self.inner.status(),
            self.written(),
            self.unrecorded
        )
    }

    fn wait(&self, timeout: Duration) -> bool {
        self.inner.wait(timeout)
    }

    fn gate(&self) -> Option<&SampleGate> {
        self.inner.gate()
    }
}

fn write_all(
    mut file: File,
    samples: &Receiver<TrackerSample>,
    shared: &RecorderState,
) -> std::io::Result<()> {
    let disk = file.try_clone()?;
    let done = AtomicBool::new(false);
    // Synchronising to the disk can take longer than the promised 100 ms; it must not delay handing bytes to the
    // kernel.
    std::thread::scope(|scope| {
        std::thread::Builder::new().name("tracker-sync".into()).spawn_scoped(scope, || {
            while !done.load(Ordering::Relaxed) {
                std::thread::sleep(SYNC_EVERY);
                // The last sync reports a disk that cannot be synchronised.
                let _ = disk.sync_data();
            }
        })?;
        let result = write_frames(&mut file, samples, shared);
        done.store(true, Ordering::Relaxed);
        result
    })?;
    file.sync_all()
}

fn write_frames(
    file: &mut File,
    samples: &Receiver<TrackerSample>,
    shared: &RecorderState,
) -> std::io::Result<()> {
    let mut payload = Vec::with_capacity(MAX_PAYLOAD);
    let mut frame = Vec::with_capacity(MAX_PAYLOAD + 8);
    loop {
        let mut count = 0;
        let mut pause = true;
        let mut open = true;
        payload.clear();
        while pause {
            match samples.try_recv() {
                Ok(sample) => {
                    put_sample(&mut payload, &sample);
                    count += 1;
                    pause = payload.len() + SAMPLE_BYTES <= MAX_PAYLOAD;
                }
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => {
                    open = false;
                    break;
                }
            }
        }
        if count > 0 {
            frame.clear();
            put_frame(&mut frame, &payload);
            // One write for a whole frame: afterwards the kernel has the bytes, and this process may die.
            file.write_all(&frame)?;
            shared.written.fetch_add(count, Ordering::Relaxed);
        }
        if !open {
            return Ok(());
        }
        if pause {
            std::thread::sleep(WRITE_EVERY);
        }
    }
}

fn header(bodies: &[BodyKey], start: HostTime) -> Vec<u8> {
    let mut payload = start.0.to_le_bytes().to_vec();
    payload.extend_from_slice(&(bodies.len() as u16).to_le_bytes());
    for body in bodies {
        let name = &body.name.as_bytes()[..body.name.len().min(255)];
        payload.push(name.len() as u8);
        payload.extend_from_slice(name);
    }
    let mut out = MAGIC.to_vec();
    put_frame(&mut out, &payload);
    out
}

fn put_frame(out: &mut Vec<u8>, payload: &[u8]) {
    let length = (payload.len() as u32).to_le_bytes();
    out.extend_from_slice(&length);
    out.extend_from_slice(payload);
    out.extend_from_slice(&crc32c_append(crc32c(&length), payload).to_le_bytes());
}

fn put_sample(out: &mut Vec<u8>, s: &TrackerSample) {
    out.extend_from_slice(&s.body.0.to_le_bytes());
    out.extend_from_slice(&u16::from(s.tracked).to_le_bytes());
    out.extend_from_slice(&s.sequence.to_le_bytes());
    out.extend_from_slice(&s.captured_at.0.to_le_bytes());
    out.extend_from_slice(&s.received_at.0.to_le_bytes());
    out.extend_from_slice(&s.mean_error_m.to_le_bytes());
    // Reserved, zero.
    out.extend_from_slice(&[0; 8]);
    for value in s.pose.position_m.iter().chain(&s.pose.rotation_xyzw) {
        out.extend_from_slice(&value.to_le_bytes());
    }
}

fn get_sample(bytes: &[u8; SAMPLE_BYTES]) -> TrackerSample {
    fn at<const N: usize>(bytes: &[u8], at: usize) -> [u8; N] {
        let mut out = [0; N];
        out.copy_from_slice(&bytes[at..at + N]);
        out
    }
    let number = |i: usize| f64::from_le_bytes(at(bytes, 36 + 8 * i));
    TrackerSample {
        body: BodyIndex(u16::from_le_bytes(at(bytes, 0))),
        tracked: bytes[2] & 1 != 0,
        sequence: u32::from_le_bytes(at(bytes, 4)),
        captured_at: HostTime(i64::from_le_bytes(at(bytes, 8))),
        received_at: HostTime(i64::from_le_bytes(at(bytes, 16))),
        mean_error_m: f32::from_le_bytes(at(bytes, 24)),
        covariance: None,
        pose: Pose {
            position_m: [number(0), number(1), number(2)],
            rotation_xyzw: [number(3), number(4), number(5), number(6)],
        },
    }
}

/// A recording in memory.
#[derive(Clone, Debug, PartialEq)]
pub struct Recording {
    /// Instant given when it was made.
    pub start: HostTime,
    /// Names of the bodies.
    pub bodies: Vec<String>,
    /// The samples in the order in which they arrived.
    pub samples: Vec<TrackerSample>,
    /// Bytes after the last whole frame: above 0 if the writer died while writing, or the file was damaged there.
    pub torn_bytes: u64,
}

impl Recording {
    /// Reads `path` up to its end or to the first incomplete frame.
    pub fn read(path: &Path) -> Result<Self, RecordError> {
        let failed = |source| RecordError::Io { path: path.to_owned(), source };
        let (file, size) = crate::regular_file::open(path).map_err(failed)?;
        Self::read_from(&mut std::io::BufReader::with_capacity(1 << 16, file), size, path)
    }

    /// Reads a recording of `size` bytes with the name `path`. Its allocation is bounded by the bytes read.
    ///
    /// # Errors
    /// As [`Recording::read`].
    pub fn read_from(reader: &mut impl Read, size: u64, path: &Path) -> Result<Self, RecordError> {
        let failed = |source| RecordError::Io { path: path.to_owned(), source };
        let not = |why| RecordError::NotARecording { path: path.to_owned(), why };
        let mut magic = [0; 16];
        if read_up_to(reader, &mut magic).map_err(failed)? < 16 || &magic != MAGIC {
            return Err(not("it does not begin as one"));
        }
        let mut payload = Vec::new();
        let mut good = 16;
        good += read_frame(reader, &mut payload).map_err(failed)?.ok_or(not("its header is damaged"))?;
        let (start, bodies) = parse_header(&payload).ok_or(not("its header contradicts itself"))?;
        let mut samples = Vec::new();
        while let Some(bytes) = read_frame(reader, &mut payload).map_err(failed)? {
            let (whole, rest) = payload.as_chunks::<SAMPLE_BYTES>();
            if !rest.is_empty() {
                break;
            }
            good += bytes;
            if samples.len() + whole.len() > MAX_REPLAYED {
                return Err(RecordError::TooLong { path: path.to_owned() });
            }
            samples.extend(whole.iter().map(get_sample));
        }
        Ok(Self { start, bodies, samples, torn_bytes: size.saturating_sub(good) })
    }
}

/// Reads until `buffer` is full or the file ends; returns the bytes read.
fn read_up_to(reader: &mut impl Read, buffer: &mut [u8]) -> std::io::Result<usize> {
    let mut n = 0;
    while n < buffer.len() {
        match reader.read(&mut buffer[n..]) {
            Ok(0) => break,
            Ok(k) => n += k,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(n)
}

/// The next frame's payload, and the bytes it takes in the file; `None` at the end or at the first damage.
fn read_frame(reader: &mut impl Read, payload: &mut Vec<u8>) -> std::io::Result<Option<u64>> {
    let mut word = [0; 4];
    if read_up_to(reader, &mut word)? < 4 {
        return Ok(None);
    }
    let length = u32::from_le_bytes(word) as usize;
    if length > MAX_PAYLOAD {
        return Ok(None);
    }
    payload.resize(length, 0);
    let crc = crc32c(&word);
    if read_up_to(reader, payload)? < length || read_up_to(reader, &mut word)? < 4 {
        return Ok(None);
    }
    let is_whole = crc32c_append(crc, payload) == u32::from_le_bytes(word);
    Ok(is_whole.then_some(length as u64 + 8))
}

fn parse_header(payload: &[u8]) -> Option<(HostTime, Vec<String>)> {
    let (start, rest) = payload.split_first_chunk::<8>()?;
    let (count, mut rest) = rest.split_first_chunk::<2>()?;
    let mut bodies = Vec::new();
    for _ in 0..u16::from_le_bytes(*count) {
        let (length, after) = rest.split_first()?;
        let (name, after) = after.split_at_checked(usize::from(*length))?;
        bodies.push(String::from_utf8_lossy(name).into_owned());
        rest = after;
    }
    rest.is_empty().then(|| (HostTime(i64::from_le_bytes(*start)), bodies))
}

/// A tracker that plays a recording at its original pace.
pub struct Replay {
    samples: Vec<TrackerSample>,
    next: usize,
    gate: SampleGate,
    status: String,
}

impl Replay {
    /// Replays `path` so that its start instant falls on `start`; all stamps are shifted by the same amount, to the
    /// nanosecond. The rig's `bodies` are found by name; recorded bodies that the rig does not know are counted as
    /// unknown.
    pub fn open(path: &Path, bodies: &[BodyKey], start: HostTime) -> Result<Self, RecordError> {
        let Recording { start: recorded, bodies: names, mut samples, torn_bytes } = Recording::read(path)?;
        if let Some(missing) = bodies.iter().find(|b| !names.contains(&b.name)) {
            let (path, wanted) = (path.to_owned(), missing.name.clone());
            return Err(RecordError::UnknownBody { path, wanted, known: names });
        }
        let place = |name: &String| bodies.iter().position(|b| b.name == *name);
        let places: Vec<u16> = names.iter().map(|n| place(n).map_or(u16::MAX, |i| i as u16)).collect();
        let shift = start.ns_since(recorded);
        for sample in &mut samples {
            let place = places.get(usize::from(sample.body.0)).copied().unwrap_or(u16::MAX);
            sample.body = BodyIndex(place);
            sample.captured_at = sample.captured_at.plus_ns(shift);
            sample.received_at = sample.received_at.plus_ns(shift);
        }
        let mut status = format!("replay of {} ({} samples)", path.display(), samples.len());
        if torn_bytes > 0 {
            status.push_str(&format!(", {torn_bytes} damaged bytes at the end left out"));
        }
        Ok(Self { samples, next: 0, gate: SampleGate::new(bodies.len()), status })
    }

    /// Counters of the samples so far, by outcome.
    pub fn counters(&self) -> &TrackerCounters {
        self.gate.counters()
    }

    /// True when all samples have been passed on.
    pub fn is_over(&self) -> bool {
        self.next == self.samples.len()
    }
}

impl Tracker for Replay {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        let mut delivered = 0;
        while let Some(sample) = self.samples.get(self.next).filter(|s| s.received_at <= now) {
            self.next += 1;
            if let Some(sample) = self.gate.admit(sample) {
                sink(&sample);
                delivered += 1;
            }
        }
        Ok(delivered)
    }

    fn name(&self) -> &str {
        "replay"
    }

    fn status(&self) -> String {
        format!("{}; {}", self.status, self.gate.counters())
    }

    fn due_at(&self) -> Option<HostTime> {
        self.samples.get(self.next).map(|sample| sample.received_at)
    }

    fn gate(&self) -> Option<&SampleGate> {
        Some(&self.gate)
    }
}

#[cfg(test)]
#[path = "record_tests.rs"]
mod tests;
