//! A camera as a tracker: a thread of its own looks for the bodies in each picture and hands their poses on.
//!
//! The tracker's space is that of the camera: it looks along -Z with +Y up. A sample is stamped with the middle of the
//! exposure of the picture's middle row. Nothing of this runs on the way of a frame: `poll` takes what the thread has found.

use crate::blobs::SpotDetector;
use crate::body::{BodyPose, Markings};
use crate::detect::TagDetector;
use crate::image::GreyImage;
use crate::pose::Velocity;
use crate::sightings::{Expectation, Sightings};
use crate::source::{Picture, PictureLosses, PictureSource};
use dpm_common::so3::{so3_between, so3_exp};
use dpm_device::pose::{Pose, PoseCovariance};
use dpm_device::time::{HostClock, HostTime};
use dpm_device::tracker::{BodyIndex, SampleGate, Tracker, TrackerError, TrackerSample};
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DQuat, DVec3};
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
/// A pose that is older says nothing of where the body is now, ns.
const EXPECTED_FOR_NS: i64 = 250_000_000;

/// What a camera tracker is opened with.
pub struct CameraTrackerSetup {
    /// Pinhole and lens at the size of the pictures. Its pose is not used: the tracker's space is the camera's.
    pub camera: ProjectorCamera,
    /// The markings of each of the rig's bodies, in their order.
    pub bodies: Vec<Markings>,
    /// Grey level that markers reach, 1 to 255.
    pub marker_level: u8,
}

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
        setup: CameraTrackerSetup,
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

/// Where a body was in the last two pictures in which it was seen.
#[derive(Clone, Copy)]
struct Last {
    at: HostTime,
    rotation: DQuat,
    position: DVec3,
    velocity: Option<Velocity>,
}

/// The thread's state.
struct Watch {
    setup: CameraTrackerSetup,
    clock: Arc<dyn HostClock>,
    sender: SyncSender<Message>,
    tags: TagDetector,
    spots: SpotDetector,
    last: Vec<Option<Last>>,
    sequence: u32,
    pictures: u64,
    busy: Duration,
    /// Samples that found no room, and pictures all of whose samples did.
    lost: u64,
    unread: u32,
}

impl Watch {
    fn new(setup: CameraTrackerSetup, clock: Arc<dyn HostClock>, sender: SyncSender<Message>) -> Self {
        let last = vec![None; setup.bodies.len()];
        let (tags, spots) = (TagDetector::new(), SpotDetector::default());
        Self {
            setup,
            clock,
            sender,
            tags,
            spots,
            last,
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
        let camera = &self.setup.camera;
        let (w, h) = (camera.raster.width() as usize, camera.raster.height() as usize);
        if (picture.width, picture.height) != (w, h) {
            let given = format!("{} x {}", picture.width, picture.height);
            return Err(format!(
                "pictures have {given} pixels, and the calibration is for {w} x {h}: set tracker.size"
            ));
        }
        let begin = Instant::now();
        let Some(image) = GreyImage::new(w, h, &picture.pixels) else {
            return Err("a picture is damaged".into());
        };
        let (mut tags, mut spots) = (Vec::new(), Vec::new());
        if self.setup.bodies.iter().any(|b| !b.tags.is_empty()) {
            self.tags.detect(&image, Some(camera), &mut tags);
        }
        if self.setup.bodies.iter().any(|b| !b.markers.is_empty()) {
            self.spots.detect(&image, self.setup.marker_level, &mut spots);
        }
        let row = 0.5 * h as f64;
        let at = picture.begin.plus_ns(picture.exposure_ns / 2 + (row * picture.row_ns as f64) as i64);
        let row_s = picture.row_ns as f64 * 1e-9;
        let cameras = [ProjectorCamera { world_from_projector: DAffine3::IDENTITY, ..*camera }];
        let sightings = [Sightings { tags: &tags, spots: &spots, row_s, row }];
        let found: Vec<Option<BodyPose>> = (self.setup.bodies.iter().zip(&self.last))
            .map(|(body, last)| body.locate(&cameras, &sightings, last.and_then(|l| l.expect(at)).as_ref()))
            .collect();
        self.pictures += 1;
        self.busy += begin.elapsed();
        // While nobody reads, as before the rig's first frame, what finds no room is not lost on the camera's way.
        self.sequence = picture.number.wrapping_sub(self.unread);
        let before = self.lost;
        for (body, found) in found.into_iter().enumerate() {
            self.report(body, at, found);
        }
        let is_marked = |b: &&Markings| !b.tags.is_empty() || !b.markers.is_empty();
        let marked = self.setup.bodies.iter().filter(is_marked).count() as u64;
        self.unread = self.unread.wrapping_add(u32::from(marked > 0 && self.lost == before + marked));
        Ok(())
    }

    fn work(&self, losses: PictureLosses) -> Work {
        let ms = 1e3 * self.busy.as_secs_f64() / self.pictures.max(1) as f64;
        Work { pictures: self.pictures, ms, unread: self.lost, losses }
    }

    fn report(&mut self, body: usize, at: HostTime, found: Option<BodyPose>) {
        if self.setup.bodies[body].tags.is_empty() && self.setup.bodies[body].markers.is_empty() {
            return;
        }
        let certain = found.filter(BodyPose::is_certain);
        let mut sample = TrackerSample {
            body: BodyIndex(body as u16),
            pose: Pose::IDENTITY,
            tracked: false,
            mean_error_m: 0.0,
            covariance: None,
            sequence: self.sequence,
            captured_at: at,
            received_at: self.clock.now(),
        };
        if let Some(found) = certain {
            let fit = &found.fit;
            sample.pose =
                Pose { position_m: fit.position.to_array(), rotation_xyzw: fit.rotation.to_array() };
            sample.tracked = true;
            sample.mean_error_m = (0..3).map(|i| fit.covariance[i][i]).sum::<f64>().sqrt() as f32;
            sample.covariance = Some(PoseCovariance::of(&fit.covariance));
            self.last[body] = Some(Last::after(self.last[body], at, fit.rotation, fit.position));
        }
        self.hand_on(Message::Sample(sample));
    }

    fn hand_on(&mut self, message: Message) {
        if let Err(TrySendError::Full(Message::Sample(_))) = self.sender.try_send(message) {
            self.lost += 1;
        }
    }
}

impl Last {
    fn after(before: Option<Self>, at: HostTime, rotation: DQuat, position: DVec3) -> Self {
        let velocity = before.and_then(|b| {
            let ns = at.ns_since(b.at);
            let s = ns as f64 * 1e-9;
            (ns > 0 && ns < EXPECTED_FOR_NS).then(|| Velocity {
                linear: (position - b.position) / s,
                angular: so3_between(b.rotation, rotation) / s,
            })
        });
        Self { at, rotation, position, velocity }
    }

    /// Where the body should be at `at`; `None` after too long a time.
    fn expect(&self, at: HostTime) -> Option<Expectation> {
        let ns = at.ns_since(self.at);
        if !(0..EXPECTED_FOR_NS).contains(&ns) {
            return None;
        }
        let s = ns as f64 * 1e-9;
        let velocity = self.velocity.unwrap_or_default();
        let rotation = so3_exp(velocity.angular * s) * self.rotation;
        let pose = DAffine3::from_rotation_translation(rotation, self.position + velocity.linear * s);
        // What hands do that the velocity does not say.
        Some(Expectation { pose, velocity, turn: 0.05 + 4.0 * s, shift: 0.01 + 1.0 * s })
    }
}
