//! A thread that reads a serial line and stamps arrivals, because the time of arrival cannot be determined later.

use std::io::ErrorKind;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;
use std::time::Duration;

use dpm_handoff::ring::{ring, Consumer, Producer};
use serialport::SerialPort;

use crate::time::{HostClock, HostTime};
use crate::transport::priority::Follower;
use crate::transport::serial::Arrivals;

/// The clock of a line, once it was set.
pub type SharedClock = Arc<OnceLock<Arc<dyn HostClock>>>;

/// Bytes of one chunk.
const CHUNK_BYTES: usize = 1024;
/// Chunks that may wait; then the kernel keeps the rest.
const CHUNKS: usize = 32;
/// How long the thread blocks before it checks whether to end.
const PATIENCE: Duration = Duration::from_millis(20);
/// Pause of the thread while its queue is full.
const FULL: Duration = Duration::from_micros(500);

/// Bytes that arrived together.
#[derive(Clone, Copy)]
struct Chunk {
    at: Option<HostTime>,
    len: usize,
    bytes: [u8; CHUNK_BYTES],
}

/// The input of a line, stamped. Dropping it ends the thread, within [`PATIENCE`], and closes its handle on the port.
pub(super) struct Reader {
    chunks: Consumer<Chunk>,
    ended: Arc<AtomicBool>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    follower: Follower,
}

impl Reader {
    /// Reads from a second handle on `port`. `None` if the system provides no handle or thread: then the caller reads
    /// by itself.
    pub(super) fn start(port: &dyn SerialPort, clock: SharedClock) -> Option<Self> {
        let mut line = port.try_clone().ok()?;
        line.set_timeout(PATIENCE).ok()?;
        let (into, chunks) = ring(CHUNKS);
        let (ended, stop) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
        let (has_ended, stopped) = (ended.clone(), stop.clone());
        let run = move || {
            read(&mut *line, into, &clock, &stopped);
            has_ended.store(true, Ordering::Release);
        };
        let thread = std::thread::Builder::new().name("dpm-serial-in".into()).spawn(run).ok()?;
        Some(Self { chunks, ended, stop, thread: Some(thread), follower: Follower::new() })
    }
}

impl Arrivals for Reader {
    fn take(&mut self, now: HostTime, sink: &mut dyn FnMut(HostTime, &[u8])) -> Option<usize> {
        if let Some(thread) = &self.thread {
            self.follower.follow(now, thread);
        }
        // Read this before the chunks, so that chunks put in before the end are seen.
        let ended = self.ended.load(Ordering::Acquire);
        let mut bytes = 0;
        for _ in 0..CHUNKS {
            let Some(chunk) = self.chunks.pop() else { break };
            bytes += chunk.len;
            sink(chunk.at.unwrap_or(now), &chunk.bytes[..chunk.len]);
        }
        (!ended || bytes > 0).then_some(bytes)
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // The thread does not panic; if it did, nobody would be left to inform.
            let _ = thread.join();
        }
    }
}

fn read(line: &mut dyn SerialPort, mut into: Producer<Chunk>, clock: &SharedClock, stop: &AtomicBool) {
    let mut chunk = Chunk { at: None, len: 0, bytes: [0; CHUNK_BYTES] };
    while !stop.load(Ordering::Relaxed) {
        match line.read(&mut chunk.bytes) {
            Ok(0) => return,
            Ok(n) => {
                chunk.at = clock.get().map(|clock| clock.now());
                chunk.len = n;
                while into.push(chunk).is_err() {
                    if stop.load(Ordering::Relaxed) {
                        return;
                    }
                    std::thread::sleep(FULL);
                }
            }
            Err(e) => match e.kind() {
                ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted => {}
                _ => return,
            },
        }
    }
}
