//! What each stage does to one frame. No threads here: `run.rs` decides who calls what.

use super::job::{hash_codes, Fate, FrameJob, FrameMemory};
use super::prepared::PreparedFrames;
use crate::config::TrackerConfig;
use crate::frame::{FrameId, Stage};
use crate::plan::dark::DarkCause;
use crate::rig::{affine, Rig};
use dpm_common::clock::Stopwatch;
use dpm_device::link::SlotClock;
use dpm_device::time::{DeviceTicks, HostTime};
use dpm_device::tracker::{BodyIndex, Tracker, TrackerError};
use dpm_handoff::latest::Publisher;
use dpm_render::gpu::GpuError;
use dpm_render::pack::{self, Kernel, Shown};
use dpm_render::{FrameInputs, Renderer};
use dpm_tracking::{Freshness, PoseFilterBank, TrackState};

/// Most bodies that a rig tracks. The configuration refuses more.
pub(crate) const MAX_TRACKED: usize = 256;

/// What the tracking stage knows, for the latest-wins slot.
#[derive(Clone, Debug)]
pub(crate) struct TrackSnapshot {
    /// Everything that arrived up to here is in.
    pub through: HostTime,
    /// By body: its track and when the newest sample arrived.
    pub tracks: Vec<Option<(TrackState, HostTime)>>,
    /// From mid-exposure of the tracker to the arrival of a sample, the longest of the last samples, nanoseconds.
    pub latency_ns: i64,
}

impl TrackSnapshot {
    /// Nothing is known of `bodies` bodies.
    pub(super) fn empty(bodies: usize) -> Self {
        Self { through: HostTime(i64::MIN), tracks: vec![None; bodies.min(MAX_TRACKED)], latency_ns: 0 }
    }
}

/// Samples into tracks.
pub(crate) struct TrackingStage {
    tracker: Box<dyn Tracker>,
    bank: PoseFilterBank,
    received_at: Vec<HostTime>,
    bodies: usize,
    /// Longest latency of the last samples; it fades by 1/1024 a sample.
    latency_ns: i64,
    /// First step, `None` before it.
    began_at: Option<HostTime>,
    /// It was looked at whether all bodies are seen.
    looked: bool,
}

/// Longest time for which any rig carries a body on by prediction, milliseconds.
pub(super) const MAX_PREDICT_MS: u32 = 1_000;

/// Time within which every body should have been seen once: a tracker that is there speaks within milliseconds, and one that has to be
/// connected to anew within half a second.
const SEEN_WITHIN_NS: i64 = 1_000_000_000;

/// What to look at first where a tracker does not tell of a body.
const fn remedy(tracker: &TrackerConfig) -> &'static str {
    match tracker {
        TrackerConfig::Mock(_) => "`tracker.faults` and `tracker.drop_out` may silence the mock",
        TrackerConfig::Natnet(_) => {
            "is streaming on in the tracking software, are tracker.server and tracker.local right, and do bodies have the same names there?"
        }
        TrackerConfig::Vrpn(_) => {
            "is the server running, are tracker.server and tracker.tracker right, and do bodies have the same names or ids there?"
        }
        TrackerConfig::Serial(_) => {
            "is the device on and plugged in, are tracker.port and tracker.baud right, and do bodies have its numbers as ids?"
        }
        TrackerConfig::Replay(_) => "does tracker.file hold these bodies, by name or id, from its beginning on?",
    }
}

impl TrackingStage {
    /// A stage for the rig's bodies.
    pub(super) fn new(rig: &Rig, tracker: Box<dyn Tracker>) -> Self {
        // How long a body is shown without samples is decided for every frame, see [`plan`]; the filter only needs to know for how long
        // a track is worth going on with.
        let longest_ms = rig.config.safety.predict_ms.unwrap_or(MAX_PREDICT_MS);
        let config = rig.config.prediction.to_filter(longest_ms);
        let bodies = rig.bodies.len().min(MAX_TRACKED);
        Self {
            tracker,
            bank: PoseFilterBank::new(&vec![config; bodies]),
            received_at: vec![HostTime(0); bodies],
            bodies,
            latency_ns: 0,
            began_at: None,
            looked: false,
        }
    }

    /// Takes what has arrived by `now` and publishes the tracks.
    ///
    /// # Errors
    /// The tracker is gone; what is known stays published.
    pub(super) fn step(
        &mut self,
        now: HostTime,
        latest: &mut Publisher<TrackSnapshot>,
    ) -> Result<(), TrackerError> {
        self.began_at.get_or_insert(now);
        let Self { tracker, bank, received_at, latency_ns, .. } = self;
        let result = tracker.poll(now, &mut |sample| {
            if let Some(verdict) = bank.update(sample) {
                if verdict.is_accepted() {
                    if let Some(at) = received_at.get_mut(usize::from(sample.body.0)) {
                        *at = sample.received_at;
                    }
                    let latency = sample.received_at.ns_since(sample.captured_at);
                    *latency_ns = latency.max(*latency_ns - *latency_ns / 1024);
                }
            }
        });
        let (bank, received_at, latency_ns) = (&self.bank, &self.received_at, self.latency_ns);
        latest.publish_with(|snapshot| {
            snapshot.through = now;
            snapshot.latency_ns = latency_ns;
            for (i, (track, at)) in snapshot.tracks.iter_mut().zip(received_at).enumerate() {
                *track = bank.state(BodyIndex(i as u16)).map(|s| (s, *at));
            }
        });
        result.map(|_| ())
    }

    fn is_unseen(&self, body: usize) -> bool {
        self.bank.state(BodyIndex(body as u16)).is_none()
    }

    /// True once in a run: a second after the first step, when some body was not seen by then. Allocates nothing.
    pub(crate) fn is_silence_due(&mut self, now: HostTime) -> bool {
        let due = self.began_at.is_some_and(|began| now.ns_since(began) >= SEEN_WITHIN_NS);
        if self.looked || !due {
            return false;
        }
        self.looked = true;
        (0..self.bodies).any(|body| self.is_unseen(body))
    }

    /// The bodies that were not seen so far, which are dark, the tracker's word on why, and what to do; `None` when all of them were.
    pub(crate) fn not_seen_yet(&self, rig: &Rig) -> Option<String> {
        self.unseen(rig, "has not seen", "and no light falls there until it does")
    }

    /// The same at the end of a run, and what else the tracker has to say.
    pub(crate) fn never_seen(&self, rig: &Rig) -> Option<String> {
        let unseen = self.unseen(rig, "never saw", "so no light fell there");
        unseen.into_iter().chain(self.tracker.warning()).reduce(|a, b| format!("{a}; {b}"))
    }

    fn unseen(&self, rig: &Rig, verb: &str, consequence: &str) -> Option<String> {
        let all = rig.bodies.iter().enumerate().take(self.bodies);
        let names: Vec<_> =
            all.filter(|(i, _)| self.is_unseen(*i)).map(|(_, body)| format!("{:?}", body.name)).collect();
        (!names.is_empty()).then(|| {
            let (names, status) = (names.join(", "), self.tracker.status());
            let (tracker, remedy) = (self.tracker.name(), remedy(&rig.config.tracker));
            format!("the {tracker} tracker {verb} {names}, {consequence}: {status}; {remedy}")
        })
    }
}

/// What planning knows besides the newest tracks.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlanInputs<'a> {
    /// The projector's slots.
    pub slots: &'a LinkTime,
    /// Number of the frame.
    pub id: u64,
    /// The slot that the frame is planned for.
    pub slot: u64,
    /// Slots until the next frame is expected: a renderer slower than its slots plans for every n-th.
    pub stride: u64,
    /// Longest time for which a body is carried on by prediction, nanoseconds (`safety.predict_ms`).
    pub predict_ns: i64,
    /// Age up to which the newest sample of a tracker that works may be when it is read, nanoseconds.
    pub fresh_ns: i64,
    /// Now.
    pub now: HostTime,
}

/// Fills a job: poses at the middle of the slot's exposure, eye, gaze, and the instant from which its light must be off. `snapshot` is the
/// newest there is.
pub(super) fn plan(job: &mut FrameJob, rig: &Rig, snapshot: &TrackSnapshot, inputs: &PlanInputs<'_>) {
    let watch = Stopwatch::start();
    let FrameJob { note, memory } = job;
    let &PlanInputs { slots, id, slot, stride, predict_ns, .. } = inputs;
    note.id = FrameId(id);
    note.slot = slot;
    note.fate = Fate::UnderWay;
    note.target_at = slots.start(slot);
    note.dark_from = slots.dark_from(slot, stride, predict_ns);
    note.predict_ns = predict_ns;
    let due = slots.host_of_slot(slot);
    let middle = due.plus_ns(slots.host_of_slot(slot + 1).ns_since(due) / 2);
    let timeline = &mut note.timeline;
    *timeline = Default::default();
    timeline.due_at = due;
    let predict = rig.config.prediction.on;
    note.tracked_poses.clear();
    note.sampled_poses.clear();
    note.dark.clear();
    memory.lost.clear();
    note.seen.clear();
    // Of the bodies that are lit; of those that are dark only where none is lit.
    let mut oldest: [Option<(HostTime, HostTime)>; 2] = [None; 2];
    for (i, body) in rig.bodies.iter().enumerate() {
        let track = snapshot.tracks.get(i).copied().flatten();
        let (pose, sampled, dark) = match track {
            Some((state, received_at)) => {
                let state = TrackState { lost_after_ns: predict_ns, ..state };
                let sampled = state.predict(state.captured_at);
                let used = state.predict(middle);
                let dark = (used.freshness == Freshness::Lost).then(|| {
                    // The tracker does its part, but the light is further away than prediction may reach.
                    let speaks = inputs.now.ns_since(state.captured_at) <= inputs.fresh_ns;
                    if speaks {
                        DarkCause::BeyondHorizon
                    } else {
                        DarkCause::Silent
                    }
                });
                let oldest = &mut oldest[usize::from(dark.is_some())];
                if oldest.is_none_or(|(captured, _)| state.captured_at < captured) {
                    *oldest = Some((state.captured_at, received_at));
                }
                let pose = if predict { used.pose } else { sampled.pose };
                (affine(&pose), affine(&sampled.pose), dark)
            }
            // Never seen: nothing may be lit.
            None => (affine(&body.rest), affine(&body.rest), Some(DarkCause::NeverSeen)),
        };
        note.tracked_poses.push(pose);
        note.sampled_poses.push(sampled);
        note.dark.push(dark);
        memory.lost.push(dark.is_some());
        // Where the tracker saw it last is where the tracker says that it is, whether or not that is new enough for light.
        note.seen.push(track.is_some());
    }
    // What is dark has no age.
    note.oldest_captured_at = oldest[0].map(|(captured, _)| captured);
    let (captured_at, received_at) = oldest[0].or(oldest[1]).unwrap_or((due, due));
    timeline.captured_at = captured_at;
    timeline.received_at = received_at;
    rig.scene_poses(&note.tracked_poses, &mut memory.scene_poses);
    (note.eye, memory.gaze) = rig.observer.eye_and_gaze(&note.tracked_poses);
    memory.widen_deg = rig.observer.gaze_body().map_or(0.0, |body| {
        let track = snapshot.tracks.get(body).copied().flatten();
        let unseen_ns = track.map_or(i64::MAX, |(state, _)| middle.ns_since(state.captured_at));
        rig.observer.widening_deg(unseen_ns) as f32
    });
    timeline.wall_ns[Stage::Plan as usize] = watch.elapsed_ns();
}

/// Starts the GPU on a planned job.
///
/// # Errors
/// Device lost.
pub(super) fn submit(job: &mut FrameJob, rig: &Rig, renderer: &mut Renderer) -> Result<(), GpuError> {
    let FrameJob { note, memory } = job;
    let Some(slot) = memory.gpu.as_mut() else { return Ok(()) };
    renderer.submit(
        slot,
        &FrameInputs {
            frame: note.id.0 as u32,
            spp: rig.config.render.spp,
            budget_spp: note.budget_milli as f32 * 1e-3,
            camera: &rig.camera,
            eye: note.eye,
            gaze: memory.gaze,
            widen_deg: memory.widen_deg,
            poses: &memory.scene_poses,
            lost: &memory.lost,
        },
    )
}

/// Renders one frame that nobody sees: what drivers put off to the first one (translating shaders) is over before a slot waits for it.
/// Returns the wall time that it took, nanoseconds.
///
/// # Errors
/// The GPU did not finish within `timeout_ns`, or was lost.
pub(super) fn warm_up(
    memory: &mut FrameMemory,
    rig: &Rig,
    renderer: &mut Renderer,
    timeout_ns: u64,
) -> Result<i64, GpuError> {
    let Some(slot) = memory.gpu.as_mut() else { return Ok(0) };
    let watch = Stopwatch::start();
    let rest: Vec<_> = rig.bodies.iter().map(|b| affine(&b.rest)).collect();
    rig.scene_poses(&rest, &mut memory.scene_poses);
    let (eye, gaze) = rig.observer.eye_and_gaze(&rest);
    let spp = rig.config.render.spp;
    let inputs = FrameInputs {
        frame: 0,
        spp,
        budget_spp: spp as f32,
        camera: &rig.camera,
        eye,
        gaze,
        widen_deg: 0.0,
        poses: &memory.scene_poses,
        lost: &memory.lost,
    };
    renderer.submit(slot, &inputs)?;
    slot.wait(timeout_ns).map(|_| watch.elapsed_ns() as i64)
}

/// Longest wait for the GPU in one piece.
const GPU_STEP_NS: u64 = 5_000_000;

/// Waits for the GPU, if the job has one, in steps of 5 ms; `alive` is called before each.
///
/// False when it did not finish within `timeout_ns`.
///
/// # Errors
/// The GPU was lost.
pub(super) fn finish(job: &mut FrameJob, timeout_ns: u64, mut alive: impl FnMut()) -> Result<bool, GpuError> {
    let Some(slot) = job.memory.gpu.as_mut() else { return Ok(true) };
    let watch = Stopwatch::start();
    let cost = loop {
        alive();
        let left = timeout_ns.saturating_sub(watch.elapsed_ns());
        if let Some(cost) = slot.poll_done(left.min(GPU_STEP_NS))? {
            break cost;
        }
        if left <= GPU_STEP_NS {
            return Ok(false);
        }
    };
    let gpu: u64 = cost.pass_ns.iter().sum();
    job.note.cost = Some(cost);
    // The fence's wait overlaps other frames; the GPU's own time is the stage's cost where it is known.
    job.note.timeline.wall_ns[Stage::Render as usize] = if gpu > 0 { gpu } else { watch.elapsed_ns() };
    Ok(true)
}

/// Packs the finished GPU's code values into planes; a job without GPU takes its code values from `prepared`.
pub(super) fn pack(job: &mut FrameJob, kernel: Kernel, verify: bool, prepared: &mut Option<PreparedFrames>) {
    let FrameJob { note, memory } = job;
    let watch = Stopwatch::start();
    if let Some(slot) = &memory.gpu {
        let codes = slot.codes();
        match slot.planes() {
            Some(planes) => pack::gpu::take(planes, &mut memory.planes),
            None => pack::pack(kernel, codes, &mut memory.planes),
        }
        note.timeline.wall_ns[Stage::Pack as usize] = watch.elapsed_ns();
        if verify {
            let shown = Shown::by(memory.planes.schedule());
            note.code_hash = hash_codes(codes.iter().map(|&c| shown.light(c)));
        }
    } else if let Some(prepared) = prepared {
        prepared.pack(kernel, note.id.0, &mut memory.planes);
        note.timeline.wall_ns[Stage::Pack as usize] = watch.elapsed_ns();
    }
}

/// The projector's slots on the host's clock.
#[derive(Clone, Copy, Debug)]
pub struct LinkTime {
    /// Slots on the device's clock.
    pub clock: SlotClock,
    /// Number in the run of the clock's slot 0: a device that comes back begins a new clock, the run goes on counting.
    pub first: u64,
    /// An instant of the device's clock, and the host's reading then.
    pub anchor: (DeviceTicks, HostTime),
}

impl LinkTime {
    /// Start of a slot on the device's clock; of the clock's first slot for those before it.
    pub(crate) fn start(&self, slot: u64) -> DeviceTicks {
        self.clock.start(slot.saturating_sub(self.first))
    }

    /// The slot that contains an instant of the device's clock; `None` before the clock's first slot.
    pub(crate) fn slot_at(&self, ticks: DeviceTicks) -> Option<u64> {
        self.clock.slot_at(ticks).map(|k| self.first.saturating_add(k))
    }

    /// From when the light of a frame must be off that is planned for `stride` slots from `slot` on and whose poses may be carried on for
    /// `predict_ns`: the end of those slots plus the longer of `predict_ns` and three slots.
    pub(crate) fn dark_from(&self, slot: u64, stride: u64, predict_ns: i64) -> DeviceTicks {
        let last = slot.saturating_sub(self.first).saturating_add(stride.max(1) - 1);
        self.clock.dark_from(last, predict_ns.max(0) as u64)
    }

    /// Start of a slot on the host's clock.
    pub(crate) fn host_of_slot(&self, slot: u64) -> HostTime {
        self.host_of(self.start(slot))
    }

    /// A reading of the device's clock on the host's, at the nominal rate.
    pub(crate) fn host_of(&self, ticks: DeviceTicks) -> HostTime {
        let delta = i128::from(ticks.0) - i128::from(self.anchor.0 .0);
        let ns = delta * 1_000_000_000 / i128::from(self.clock.tick_hz());
        self.anchor.1.plus_ns(i64::try_from(ns).unwrap_or(if ns > 0 { i64::MAX } else { i64::MIN }))
    }

    /// The first slot that starts at or after `at`.
    pub(crate) fn slot_after(&self, at: HostTime) -> u64 {
        let since = at.ns_since(self.host_of_slot(self.first));
        if since <= 0 {
            return self.first;
        }
        let mut slot = self.first.saturating_add(self.clock.rate().slot_at_ns(since));
        while self.host_of_slot(slot) < at {
            slot += 1;
        }
        slot
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Overrides, RigConfig};
    use dpm_device::planes::Raster;
    use dpm_device::pose::Pose;
    use dpm_device::tracker::TrackerSample;
    use dpm_handoff::latest::latest;

    /// Tells of the bodies below a number, at every poll.
    struct Speaks {
        of: u16,
    }

    impl Tracker for Speaks {
        fn poll(
            &mut self,
            now: HostTime,
            sink: &mut dyn FnMut(&TrackerSample),
        ) -> Result<usize, TrackerError> {
            for body in 0..self.of {
                sink(&TrackerSample {
                    body: BodyIndex(body),
                    pose: Pose::IDENTITY,
                    tracked: true,
                    mean_error_m: 0.0,
                    sequence: now.0 as u32,
                    captured_at: now,
                    received_at: now,
                });
            }
            Ok(usize::from(self.of))
        }

        fn name(&self) -> &str {
            "speaking"
        }

        fn status(&self) -> String {
            format!("speaks of {}", self.of)
        }
    }

    #[test]
    fn silence_is_due_once_after_a_second_and_only_where_a_body_is_missing() {
        let config = RigConfig::demo(&Overrides::default()).unwrap_or_else(|e| panic!("{e}"));
        let rig = Rig::build(&config, Raster::new(16, 16)).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(rig.bodies.len(), 2);
        let names = [0, 1].map(|i| format!("{:?}", rig.bodies[i].name));
        for of in 0..3u16 {
            let mut stage = TrackingStage::new(&rig, Box::new(Speaks { of }));
            let (mut publisher, _reader) = latest(TrackSnapshot::empty(2));
            // From any instant on, in steps of 10 ms.
            let due: Vec<i64> = (0..300i64)
                .map(|step| HostTime(7_000_000_000 + step * 10_000_000))
                .filter(|&now| {
                    stage.step(now, &mut publisher).expect("it speaks");
                    stage.is_silence_due(now)
                })
                .map(|now| now.0 - 7_000_000_000)
                .collect();
            assert_eq!(due, if of < 2 { vec![1_000_000_000] } else { vec![] }, "{of} of 2 are told");
            let (early, late) = (stage.not_seen_yet(&rig), stage.never_seen(&rig));
            assert_eq!(early.is_some(), of < 2);
            for text in [early, late].into_iter().flatten() {
                assert!(
                    text.contains(&format!("speaks of {of}")) && text.contains("tracker.faults"),
                    "{text}"
                );
                assert_eq!(text.contains(&names[0]), of == 0, "{text}");
                assert!(text.contains(&names[1]), "{text}");
            }
        }
    }
}
