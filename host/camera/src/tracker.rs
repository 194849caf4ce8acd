//! Cameras as a tracker: a thread for each looks for the bodies in each picture and hands their poses on.
//!
//! The tracker's space is that of the first camera: it looks along -Z with +Y up. A sample is stamped with the middle of the
//! exposure of the picture's middle row. Of several cameras each picture is a sample of its own, with its own covariance
//! ([`SampleJoin`]), and the filter joins them. Nothing of this runs on the way of a frame: `poll` takes what the threads have
//! found.

use crate::body::Markings;
use crate::finder::{sample_of, BodyFinder, FinderSetup};
use crate::several::SampleJoin;
use crate::source::{Picture, PictureLosses, PictureSource};
use dpm_device::time::{HostClock, HostTime};
use dpm_device::tracker::{SampleGate, Tracker, TrackerError, TrackerSample};
use glam::DAffine3;
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

/// What is known of one camera.
struct Eye {
    name: String,
    word: String,
    work: Work,
    thread: Option<JoinHandle<()>>,
}

/// A camera of a tracker.
pub struct PlacedCamera {
    /// What it is, and what it is to find.
    pub setup: FinderSetup,
    /// From its own space to that of the tracker; of the first camera the identity.
    pub pose: DAffine3,
    /// Its pictures.
    pub source: Box<dyn PictureSource>,
}

/// One or several cameras as a tracker.
pub struct CameraTracker {
    messages: Receiver<(usize, Message)>,
    gate: SampleGate,
    name: String,
    eyes: Vec<Eye>,
    join: SampleJoin,
    over: Arc<AtomicBool>,
}

impl CameraTracker {
    /// Starts a thread for each camera, which opens it and opens it again after every loss. All setups have the same number of
    /// bodies.
    ///
    /// # Errors
    /// The system refuses a thread.
    pub fn start(cameras: Vec<PlacedCamera>, clock: &Arc<dyn HostClock>) -> Result<Self, TrackerError> {
        let (sender, messages) = sync_channel(MOST_WAITING);
        let bodies = cameras.first().map_or(0, |camera| camera.setup.bodies.len());
        let names: Vec<&str> = cameras.iter().map(|camera| camera.source.name()).collect();
        let name = format!("camera {}", names.join(" and "));
        let mut tracker = Self {
            messages,
            gate: SampleGate::of_sources(bodies, cameras.len()),
            name,
            eyes: Vec::new(),
            join: SampleJoin::new(cameras.iter().map(|camera| camera.pose).collect(), bodies),
            over: Arc::new(AtomicBool::new(false)),
        };
        for (index, PlacedCamera { setup, source, .. }) in cameras.into_iter().enumerate() {
            let (name, stop) = (source.name().to_owned(), tracker.over.clone());
            let mut watch = Watch::new(setup, clock.clone(), index, sender.clone());
            let work = move || watch.run(source, &stop);
            let thread = std::thread::Builder::new().name("dpm-camera".into()).spawn(work);
            let thread = thread
                .map_err(|source| TrackerError::Io { context: "a thread for the camera".into(), source })?;
            let word = "no picture yet".to_owned();
            tracker.eyes.push(Eye { name, word, work: Work::default(), thread: Some(thread) });
        }
        Ok(tracker)
    }

    /// A camera has looked at more pictures.
    fn count(&mut self, camera: usize, work: Work) {
        let Some(eye) = self.eyes.get_mut(camera) else { return };
        let before = std::mem::replace(&mut eye.work, work);
        let (used, damaged) = (work.pictures - before.pictures, work.losses.damaged - before.losses.damaged);
        let packets = self.gate.packets_mut();
        packets.received += used + damaged;
        packets.used += used;
        packets.malformed += damaged;
    }
}

impl Eye {
    /// What it does, for the operator.
    fn told(&self) -> String {
        let Work { pictures, ms, unread, losses } = self.work;
        let counts = [
            (losses.lost, "pictures lost on the way"),
            (losses.damaged, "damaged"),
            (losses.passed_over, "passed over for a newer one"),
            (unread, "samples found no room"),
        ];
        let counts = counts.iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!(", {n} {what}"));
        let counts: String = counts.collect();
        format!("{}; {pictures} pictures, {ms:.1} ms to look at one{counts}", self.word)
    }
}

impl Drop for CameraTracker {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        for thread in self.eyes.iter_mut().filter_map(|eye| eye.thread.take()) {
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
                Ok((camera, Message::Sample(sample))) => {
                    let admitted = self.gate.admit_from(camera, &sample);
                    if let Some(sample) = admitted.and_then(|sample| self.join.join(camera, sample)) {
                        sink(&sample);
                        count += 1;
                    }
                }
                Ok((camera, Message::Word(word))) => self.eyes[camera].word = word,
                Ok((camera, Message::Work(work))) => self.count(camera, work),
                Err(_) => break,
            }
        }
        Ok(count)
    }

    fn name(&self) -> &str {
        &self.name
    }

    fn status(&self) -> String {
        let told: Vec<String> = match &self.eyes[..] {
            [eye] => vec![eye.told()],
            eyes => eyes.iter().map(|eye| format!("{}: {}", eye.name, eye.told())).collect(),
        };
        format!("{}; {}", told.join("; "), self.gate.counters())
    }

    fn gate(&self) -> Option<&SampleGate> {
        Some(&self.gate)
    }
}

/// The thread's state.
struct Watch {
    finder: BodyFinder,
    clock: Arc<dyn HostClock>,
    /// Which of the cameras it is.
    index: usize,
    sender: SyncSender<(usize, Message)>,
    sequence: u32,
    pictures: u64,
    busy: Duration,
    /// Samples that found no room, and pictures all of whose samples did.
    lost: u64,
    unread: u32,
}

impl Watch {
    fn new(
        setup: FinderSetup,
        clock: Arc<dyn HostClock>,
        index: usize,
        sender: SyncSender<(usize, Message)>,
    ) -> Self {
        let finder = BodyFinder::new(setup);
        Self {
            finder,
            clock,
            index,
            sender,
            sequence: 0,
            pictures: 0,
            busy: Duration::ZERO,
            lost: 0,
            unread: 0,
        }
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
        if let Err(TrySendError::Full((_, Message::Sample(_)))) = self.sender.try_send((self.index, message))
        {
            self.lost += 1;
        }
    }
}
