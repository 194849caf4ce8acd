//! A camera as a tracker: a thread of its own looks for the bodies in each picture and hands their poses on.
//!
//! The tracker's space is that of the camera: it looks along -Z with +Y up. A sample is stamped with the middle of the
//! exposure of the picture's middle row. Nothing of this runs on the way of a frame: `poll` takes what the thread has found.

use crate::body::Markings;
use crate::finder::{sample_of, BodyFinder, FinderSetup};
use crate::source::{Picture, PictureLosses, PictureSource};
use dpm_device::time::{HostClock, HostTime};
use dpm_device::tracker::{SampleGate, Tracker, TrackerError, TrackerSample};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{sync_channel, Receiver, SyncSender, TrySendError};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Samples that wait for the rig; older ones are of no use to it.
const MOST_WAITING: usize = 256;
/// How long the thread waits for a picture before it looks whether it is to end.
const PATIENCE: Duration = Duration::from_millis(100);
/// Rest after a camera that cannot be opened.
const REST: Duration = Duration::from_millis(250);

/// What the thread hands on.
enum Message {
    Sample(TrackerSample),
    /// Why there are no pictures, or that they come.
    Word(String),
    Work(Work),
}

/// What the thread has done so far.
#[derive(Clone, Copy, Default, PartialEq)]
struct Work {
    /// Pictures that were looked at.
    pictures: u64,
    /// Mean time to look at one, ms.
    ms: f64,
    /// Samples that found no room.
    unread: u64,
    /// Pictures that never came to be looked at.
    losses: PictureLosses,
}

/// A camera as a tracker.
pub struct CameraTracker {
    messages: Receiver<Message>,
    gate: SampleGate,
    name: String,
    word: String,
    work: Work,
    over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl CameraTracker {
    /// Starts the thread, which opens the camera and opens it again after every loss.
    ///
    /// # Errors
    /// The system refuses a thread.
    pub fn start(
        setup: FinderSetup,
        source: Box<dyn PictureSource>,
        clock: Arc<dyn HostClock>,
    ) -> Result<Self, TrackerError> {
        let (sender, messages) = sync_channel(MOST_WAITING);
        let over = Arc::new(AtomicBool::new(false));
        let (name, gate) = (format!("camera {}", source.name()), SampleGate::new(setup.bodies.len()));
        let stop = over.clone();
        let work = move || Watch::new(setup, clock, sender).run(source, &stop);
        let thread = std::thread::Builder::new().name("dpm-camera".into()).spawn(work);
        let thread = thread
            .map_err(|source| TrackerError::Io { context: "a thread for the camera".into(), source })?;
        let word = "no picture yet".to_owned();
        Ok(Self { messages, gate, name, word, work: Work::default(), over, thread: Some(thread) })
    }
}

impl Drop for CameraTracker {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // Its panic has been printed; the tracker is gone either way.
            let _ = thread.join();
        }
    }
}

impl Tracker for CameraTracker {
    fn poll(&mut self, _now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        let mut count = 0;
        for _ in 0..MOST_WAITING {
            match self.messages.try_recv() {
                Ok(Message::Sample(sample)) => {
                    if let Some(sample) = self.gate.admit(&sample) {
                        sink(&sample);
                        count += 1;
                    }
                }
                Ok(Message::Word(word)) => self.word = word,
                Ok(Message::Work(work)) => {
                    let packets = self.gate.packets_mut();
                    let (used, damaged) =
                        (work.pictures - self.work.pictures, work.losses.damaged - self.work.losses.damaged);
                    packets.received += used + damaged;
                    packets.used += used;
                    packets.malformed += damaged;
                    self.work = work;
                }
                Err(_) => break,
            }
        }
        Ok(count)
    }

    fn name(&self) -> &str {
        &self.name
    }

    fn status(&self) -> String {
        let Work { pictures, ms, unread, losses } = self.work;
        let counts = [
            (losses.lost, "pictures lost on the way"),
            (losses.damaged, "damaged"),
            (losses.passed_over, "passed over for a newer one"),
            (unread, "samples found no room"),
        ];
        let counts = counts.iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!(", {n} {what}"));
        let counts: String = counts.collect();
        format!(
            "{}; {pictures} pictures, {ms:.1} ms to look at one{counts}; {}",
            self.word,
            self.gate.counters()
        )
    }

    fn gate(&self) -> Option<&SampleGate> {
        Some(&self.gate)
    }
}

/// The thread's state.
struct Watch {
    finder: BodyFinder,
    clock: Arc<dyn HostClock>,
    sender: SyncSender<Message>,
    sequence: u32,
    pictures: u64,
    busy: Duration,
    /// Samples that found no room, and pictures all of whose samples did.
    lost: u64,
    unread: u32,
}

impl Watch {
    fn new(setup: FinderSetup, clock: Arc<dyn HostClock>, sender: SyncSender<Message>) -> Self {
        let finder = BodyFinder::new(setup);
        Self { finder, clock, sender, sequence: 0, pictures: 0, busy: Duration::ZERO, lost: 0, unread: 0 }
    }

    fn run(&mut self, mut source: Box<dyn PictureSource>, over: &AtomicBool) {
        let (mut picture, mut word, mut told_work) = (Picture::default(), String::new(), Work::default());
        while !over.load(Ordering::Relaxed) {
            let told = match source.next(PATIENCE, &mut picture) {
                Ok(true) => Some(match self.look(&picture) {
                    Ok(()) => "pictures come".to_owned(),
                    Err(why) => why,
                }),
                Ok(false) => None,
                Err(why) => {
                    std::thread::sleep(REST);
                    Some(why)
                }
            };
            let work = self.work(source.losses());
            if work != told_work {
                told_work = work;
                self.hand_on(Message::Work(work));
            }
            if let Some(told) = told.filter(|told| *told != word) {
                word.clone_from(&told);
                self.hand_on(Message::Word(told));
            }
        }
    }

    /// Finds all bodies in a picture.
    fn look(&mut self, picture: &Picture) -> Result<(), String> {
        let begin = Instant::now();
        let (at, found) = self.finder.look(picture)?;
        self.pictures += 1;
        self.busy += begin.elapsed();
        // While nobody reads, as before the rig's first frame, what finds no room is not lost on the camera's way.
        self.sequence = picture.number.wrapping_sub(self.unread);
        let before = self.lost;
        let is_marked = |b: &Markings| !b.tags.is_empty() || !b.markers.is_empty();
        let mut marked = 0;
        for (body, found) in found.into_iter().enumerate() {
            if is_marked(&self.finder.bodies()[body]) {
                marked += 1;
                let (sequence, received_at) = (self.sequence, self.clock.now());
                let sample = TrackerSample { sequence, received_at, ..sample_of(body, at, found.as_ref()) };
                self.hand_on(Message::Sample(sample));
            }
        }
        self.unread = self.unread.wrapping_add(u32::from(marked > 0 && self.lost == before + marked));
        Ok(())
    }

    fn work(&self, losses: PictureLosses) -> Work {
        let ms = 1e3 * self.busy.as_secs_f64() / self.pictures.max(1) as f64;
        Work { pictures: self.pictures, ms, unread: self.lost, losses }
    }

    fn hand_on(&mut self, message: Message) {
        if let Err(TrySendError::Full(Message::Sample(_))) = self.sender.try_send(message) {
            self.lost += 1;
        }
    }
}
