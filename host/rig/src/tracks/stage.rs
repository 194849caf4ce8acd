//! The first stage of a frame: puts newly arrived samples into the tracks of all bodies.

use super::keys::KeyWatch;
use super::phase::{SamplePhase, SampleRhythm};
use super::seen::{BlindBodies, SeenBodies};
use super::tracker_frame::TrackerFrame;
use crate::config::MAX_TRACKED;
use crate::rig::Rig;
use crate::tracks::gauges::{AddedCounts, TrackerGauges};
use dpm_device::time::HostTime;
use dpm_device::tracker::{BodyIndex, Tracker, TrackerError};
use dpm_handoff::latest::Publisher;
use dpm_tracking::{PoseFilterBank, PoseFilterConfig, TrackState};
use glam::DVec3;
use std::sync::Arc;
use std::time::Duration;

/// The tracking stage's result, for the latest-wins slot.
#[derive(Clone, Debug)]
pub struct TrackSnapshot {
    /// Everything that arrived up to this instant is included.
    pub through: HostTime,
    /// The newest exposure of any body.
    pub captured_at: HostTime,
    /// Per body: its track, and when the newest sample arrived.
    pub tracks: Vec<Option<(TrackState, HostTime)>>,
    /// Per body: it was reported at some time of the run, maybe before the stages were restarted.
    pub ever_seen: Vec<bool>,
    /// Time from the tracker's mid-exposure to the arrival of a sample, the longest among the last samples,
    /// nanoseconds.
    pub latency_ns: i64,
}

impl TrackSnapshot {
    /// A snapshot in which nothing is known of `bodies` bodies.
    pub fn empty(bodies: usize) -> Self {
        let bodies = bodies.min(MAX_TRACKED);
        Self {
            through: HostTime(i64::MIN),
            captured_at: HostTime(i64::MIN),
            tracks: vec![None; bodies],
            ever_seen: vec![false; bodies],
            latency_ns: 0,
        }
    }
}

/// Puts samples into tracks.
pub struct TrackingStage {
    tracker: Box<dyn Tracker>,
    bank: PoseFilterBank,
    received_at: Vec<HostTime>,
    /// Samples by body that the filters did not accept.
    contradictory: Vec<u64>,
    /// Whether the motion contradicts the keys, by body.
    keys: Vec<KeyWatch>,
    /// What was added to the gauges of the run, and when it is due again.
    added: AddedCounts,
    add_at: HostTime,
    bodies: usize,
    seen: Arc<SeenBodies>,
    /// From the tracker's coordinates to the world's; `None` if they are the same.
    frame: Option<TrackerFrame>,
    phase: SamplePhase,
    /// Capture of the newest sample, and whether it came with the last step.
    captured: (HostTime, bool),
    /// The longest latency of the last samples; it decays by 1/1024 per sample.
    latency_ns: i64,
    /// Time of the first step; `None` before it.
    began_at: Option<HostTime>,
    /// The check whether all bodies were seen has been made.
    looked: bool,
}

/// The longest time for which any rig may extend a body's track by prediction, milliseconds.
pub(crate) const MAX_PREDICT_MS: u32 = 1_000;

/// How often the counts of samples are added to those of the run, nanoseconds.
const ADD_EVERY_NS: i64 = 50_000_000;
/// Time within which every body should have been seen once. A working tracker reports within milliseconds, and one
/// that must be reconnected within half a second.
const SEEN_WITHIN_NS: i64 = 1_000_000_000;

/// Filters for the bodies of `rig`.
fn bank(rig: &Rig) -> PoseFilterBank {
    // Each frame decides how long a body is shown without samples, see [`crate::plan::frame::FramePlan::fill`]. The filter
    // only needs to know how long a track is worth keeping.
    let longest_ms = rig.config.safety.predict_ms.unwrap_or(MAX_PREDICT_MS);
    let source_period_ns = rig.config.tracker.source_period_ns();
    let config = PoseFilterConfig { source_period_ns, ..rig.config.prediction.to_filter(longest_ms) };
    PoseFilterBank::new(&vec![config; rig.tracked_count()])
}

impl TrackingStage {
    /// A stage for the rig's bodies.
    pub fn new(rig: &Rig, tracker: Box<dyn Tracker>) -> Self {
        let bodies = rig.tracked_count();
        Self {
            tracker,
            bank: bank(rig),
            received_at: vec![HostTime(0); bodies],
            contradictory: vec![0; bodies],
            keys: vec![KeyWatch::default(); bodies],
            added: AddedCounts::new(bodies),
            add_at: HostTime(i64::MIN),
            bodies,
            seen: Arc::new(SeenBodies::new(bodies)),
            frame: TrackerFrame::of(&rig.config.tracker, rig.latency_ns),
            phase: SamplePhase::new(),
            captured: (HostTime(i64::MIN), false),
            latency_ns: 0,
            began_at: None,
            looked: false,
        }
    }

    /// The same, in a run that has seen the bodies of `seen` before.
    pub(crate) fn remembering(self, seen: Arc<SeenBodies>) -> Self {
        Self { seen, ..self }
    }

    /// Reads what has arrived by `now` and publishes the tracks.
    ///
    /// # Errors
    /// The tracker is gone; the tracks that are known stay published.
    pub fn step(&mut self, now: HostTime, latest: &mut Publisher<TrackSnapshot>) -> Result<(), TrackerError> {
        self.began_at.get_or_insert(now);
        let Self { tracker, bank, received_at, contradictory, latency_ns, frame, captured, .. } = self;
        captured.1 = false;
        let result = tracker.poll(now, &mut |sample| {
            let in_world;
            let sample = match frame {
                None => sample,
                Some(frame) => {
                    in_world = frame.apply(sample);
                    &in_world
                }
            };
            if let Some(verdict) = bank.update(sample) {
                if verdict.is_accepted() {
                    if let Some(at) = received_at.get_mut(usize::from(sample.body.0)) {
                        *at = sample.received_at;
                    }
                    let latency = sample.received_at.ns_since(sample.captured_at);
                    *latency_ns = latency.max(*latency_ns - *latency_ns / 1024);
                    if sample.captured_at > captured.0 {
                        *captured = (sample.captured_at, true);
                    }
                } else if let Some(count) = contradictory.get_mut(usize::from(sample.body.0)) {
                    // The first samples of a body have nothing to contradict.
                    *count += u64::from(bank.state(sample.body).is_some());
                }
            }
        });
        self.publish(now, latest);
        result.map(|_| ())
    }

    /// Publishes the tracks as they were at `now`, after the last step.
    pub(crate) fn publish(&self, now: HostTime, latest: &mut Publisher<TrackSnapshot>) {
        let (received_at, latency_ns, captured_at) = (&self.received_at, self.latency_ns, self.captured.0);
        latest.publish_with(|snapshot| {
            snapshot.through = now;
            snapshot.latency_ns = latency_ns;
            snapshot.captured_at = captured_at;
            for (i, (track, at)) in snapshot.tracks.iter_mut().zip(received_at).enumerate() {
                *track = self.bank.state(BodyIndex(i as u16)).map(|s| (s, *at));
                if track.is_some() {
                    self.seen.mark(i);
                }
            }
            for (i, ever) in snapshot.ever_seen.iter_mut().enumerate() {
                *ever = self.seen.has(i);
            }
        });
    }

    /// What the last step has published can be read at `now`. Returns when samples are ready, if that is known.
    pub(crate) fn is_published(&mut self, now: HostTime) -> Option<SampleRhythm> {
        if let (captured_at, true) = self.captured {
            self.phase.observe(captured_at, now);
        }
        self.phase.rhythm()
    }

    /// See [`Tracker::due_at`].
    pub(crate) fn due_at(&self) -> Option<HostTime> {
        self.tracker.due_at()
    }

    /// See [`Tracker::wait`].
    pub(crate) fn wait(&self, timeout: Duration) -> bool {
        self.tracker.wait(timeout)
    }

    /// Adds to `gauges` what became of the samples, if `now` is late enough for it, or `always`.
    pub(crate) fn add_counts(&mut self, now: HostTime, gauges: &TrackerGauges, always: bool) {
        if now < self.add_at && !always {
            return;
        }
        self.add_at = now.plus_ns(ADD_EVERY_NS);
        if let Some(gate) = self.tracker.gate() {
            gauges.add(gate, &self.contradictory, &mut self.added);
        }
        for (i, (keys, contradicted)) in self.keys.iter_mut().zip(gauges.contradicted()).enumerate() {
            let body = BodyIndex(i as u16);
            if let (Some(state), Some(levels)) = (self.bank.state(body), self.bank.levels(body)) {
                let speeds = [state.position.mean.velocity, state.rotation.mean.velocity];
                keys.look(levels, speeds.map(DVec3::length), contradicted);
            }
        }
    }

    /// What the tracker says of itself.
    pub(crate) fn status(&self) -> String {
        self.tracker.status()
    }

    /// Capture and arrival of the first body's newest sample.
    pub(crate) fn newest(&self) -> Option<(HostTime, HostTime)> {
        Some((self.bank.state(BodyIndex(0))?.captured_at, *self.received_at.first()?))
    }

    fn is_unseen(&self, body: usize) -> bool {
        !self.seen.has(body)
    }

    /// True once per run: one second after the first step, if some body has not been seen by then. Allocates nothing.
    pub(crate) fn is_silence_due(&mut self, now: HostTime) -> bool {
        let due = self.began_at.is_some_and(|began| now.ns_since(began) >= SEEN_WITHIN_NS);
        if self.looked || !due {
            return false;
        }
        self.looked = true;
        (0..self.bodies).any(|body| self.is_unseen(body))
    }

    /// Names the bodies that have not been seen yet and are therefore dark, the tracker's explanation, and what to
    /// do. `None` if all were seen.
    pub(crate) fn not_seen_yet(&self, rig: &Rig) -> Option<BlindBodies> {
        let told = self.unseen(
            rig,
            "has not seen",
            ["and no light falls there until it does", "and no light falls until it does"],
        )?;
        let bodies = (0..self.bodies).filter(|body| self.is_unseen(*body)).collect();
        Some(BlindBodies { told, bodies, seen: self.seen.clone() })
    }

    /// The same at the end of a run, with any other message of the tracker.
    pub(crate) fn never_seen(&self, rig: &Rig) -> Option<String> {
        let unseen = self.unseen(rig, "never saw", ["so no light fell there", "so no light fell"]);
        unseen.into_iter().chain(self.tracker.warning()).reduce(|a, b| format!("{a}; {b}"))
    }

    /// `consequences`: where a body was not seen, and where a head that is guarded was not.
    fn unseen(&self, rig: &Rig, verb: &str, consequences: [&str; 2]) -> Option<String> {
        let all = || rig.tracked().enumerate().take(self.bodies);
        let is_guarded = |i: usize| self.is_unseen(i) && rig.guards(i);
        let consequence = consequences[usize::from(all().any(|(i, _)| is_guarded(i)))];
        let names: Vec<_> =
            all().filter(|(i, _)| self.is_unseen(*i)).map(|(_, body)| format!("{:?}", body.name)).collect();
        (!names.is_empty()).then(|| {
            let (names, status) = (names.join(", "), self.tracker.status());
            let (tracker, remedy) = (self.tracker.name(), rig.config.tracker.remedy());
            format!("the {tracker} tracker {verb} {names}, {consequence}: {status}; {remedy}")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Overrides, RigConfig};
    use dpm_device::planes::Raster;
    use dpm_device::pose::Pose;
    use dpm_device::rng::Draws;
    use dpm_device::tracker::{SampleGate, TrackerSample};
    use dpm_handoff::latest::latest;

    /// Reports the bodies below a number at every poll.
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
                    covariance: None,
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

    /// The stages were restarted while the tracker was silent: what was seen before is not told as never seen.
    #[test]
    fn a_stage_that_takes_over_remembers_what_was_seen() {
        let config = RigConfig::demo(&Overrides::default()).unwrap_or_else(|e| panic!("{e}"));
        let rig = Rig::build(&config, Raster::new(16, 16)).unwrap_or_else(|e| panic!("{e}"));
        let seen = Arc::new(SeenBodies::new(2));
        let (mut publisher, mut reader) = latest(TrackSnapshot::empty(2));
        let mut run = |of: u16| {
            let mut stage = TrackingStage::new(&rig, Box::new(Speaks { of })).remembering(seen.clone());
            for step in 0..3 {
                stage.step(HostTime(7_000_000_000 + step * 10_000_000), &mut publisher).expect("it speaks");
            }
            let snapshot = reader.latest().0.clone();
            let tracked: Vec<bool> = snapshot.tracks.iter().map(Option::is_some).collect();
            (tracked, snapshot.ever_seen, stage.never_seen(&rig))
        };
        let (tracked, ever, told) = run(1);
        assert_eq!((tracked, ever), (vec![true, false], vec![true, false]));
        assert!(told.is_some_and(|told| told.contains("venus") && !told.contains("bunny")));
        let early = TrackingStage::new(&rig, Box::new(Speaks { of: 0 })).remembering(seen.clone());
        let early = early.not_seen_yet(&rig).expect("venus was not seen");
        assert!(early.holds() && early.told.contains("venus"));
        let (tracked, ever, _) = run(0);
        assert_eq!((tracked, ever), (vec![false, false], vec![true, false]));
        assert!(run(2).2.is_none());
        assert!(!early.holds(), "it was seen");
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
            let (early, late) = (stage.not_seen_yet(&rig).map(|unseen| unseen.told), stage.never_seen(&rig));
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

    /// Reports two bodies at rest, half a metre apart, and exchanges them in one sample of fifty.
    struct Exchanges {
        gate: SampleGate,
    }

    impl Tracker for Exchanges {
        fn poll(
            &mut self,
            now: HostTime,
            sink: &mut dyn FnMut(&TrackerSample),
        ) -> Result<usize, TrackerError> {
            let sequence = (now.0 / 2_000_000) as u32;
            let other = u16::from(sequence.is_multiple_of(50));
            for body in 0..2u16 {
                let at = 0.5 * f64::from(body ^ other);
                let sample = TrackerSample {
                    body: BodyIndex(body),
                    pose: Pose { position_m: [at, 0.0, 1.0], ..Pose::IDENTITY },
                    tracked: true,
                    mean_error_m: 0.0,
                    covariance: None,
                    sequence,
                    captured_at: now,
                    received_at: now,
                };
                if let Some(sample) = self.gate.admit(&sample) {
                    sink(&sample);
                }
            }
            Ok(2)
        }

        fn name(&self) -> &str {
            "exchanging"
        }

        fn gate(&self) -> Option<&SampleGate> {
            Some(&self.gate)
        }
    }

    /// Exchanged bodies are counted for both of them, and reported by name.
    #[test]
    fn samples_of_exchanged_bodies_are_counted() {
        let config = RigConfig::demo(&Overrides::default()).unwrap_or_else(|e| panic!("{e}"));
        let rig = Rig::build(&config, Raster::new(16, 16)).unwrap_or_else(|e| panic!("{e}"));
        let mut stage = TrackingStage::new(&rig, Box::new(Exchanges { gate: SampleGate::new(2) }));
        let (mut publisher, _reader) = latest(TrackSnapshot::empty(2));
        let gauges = TrackerGauges::default();
        gauges.begin(2);
        for step in 1..1_000i64 {
            let now = HostTime(2_000_000 * step);
            stage.step(now, &mut publisher).expect("it speaks");
            stage.add_counts(now, &gauges, step == 999);
        }
        let told = gauges.report(["bunny", "venus"].into_iter()).expect("there are samples");
        assert_eq!((told.samples, told.contradictory), (1_998, 38), "{told:?}");
        let by_body: Vec<u64> = told.bodies.iter().map(|body| body.contradictory).collect();
        assert_eq!(by_body, [19, 19]);
    }

    /// Swings to and fro by 0.1 m, twice a second for 16 m/s^2, or once in two seconds for 1 m/s^2.
    struct Swings {
        hz: f64,
    }

    impl Tracker for Swings {
        fn poll(
            &mut self,
            now: HostTime,
            sink: &mut dyn FnMut(&TrackerSample),
        ) -> Result<usize, TrackerError> {
            let phase = std::f64::consts::TAU * self.hz * now.0 as f64 * 1e-9;
            // A tenth of a millimetre of noise.
            let noise = ((Draws::new(1).bits(now.0 as u64) >> 11) as f64 / (1u64 << 53) as f64 - 0.5) * 2e-4;
            sink(&TrackerSample {
                body: BodyIndex(0),
                pose: Pose { position_m: [0.1 * phase.sin() + noise, 0.0, 1.0], ..Pose::IDENTITY },
                tracked: true,
                mean_error_m: 0.0,
                covariance: None,
                sequence: (now.0 / 1_000_000) as u32,
                captured_at: now,
                received_at: now,
            });
            Ok(1)
        }

        fn name(&self) -> &str {
            "swinging"
        }

        fn status(&self) -> String {
            String::new()
        }
    }

    #[test]
    fn a_key_that_the_motion_contradicts_is_found_and_a_right_one_is_not() {
        for (acceleration, hz, wrong) in [(0.1, 2.0, true), (16.0, 2.0, false), (1000.0, 0.5, true)] {
            let flags = vec![format!("prediction.acceleration={acceleration}")];
            let config =
                RigConfig::demo(&Overrides { flags, ..Default::default() }).unwrap_or_else(|e| panic!("{e}"));
            let rig = Rig::build(&config, Raster::new(16, 16)).unwrap_or_else(|e| panic!("{e}"));
            let mut stage = TrackingStage::new(&rig, Box::new(Swings { hz }));
            let (mut publisher, _reader) = latest(TrackSnapshot::empty(2));
            let gauges = TrackerGauges::default();
            gauges.begin(2);
            let mut found = Vec::new();
            for step in 0..4_000i64 {
                let now = HostTime(7_000_000_000 + step * 2_000_000);
                stage.step(now, &mut publisher).expect("it speaks");
                stage.add_counts(now, &gauges, false);
                found.extend(gauges.take_contradicted());
            }
            assert_eq!(found.len(), usize::from(wrong), "{acceleration} m/s^2 at {hz} Hz: {found:?}");
            assert!(found
                .iter()
                .all(|(body, key, level)| (*body, *key) == (0, 0) && (*level > 0) == (hz > 1.0)));
        }
    }
}
