//! The lit frames of a run into what their registration would have been without threads, a link and a renderer between tracker and light: the
//! rig's own tracker and filters once more, offline, latched at the frames' own instants and asked for the instants of their own light.

use dpm_common::quantiles::Quantiles;
use dpm_device::time::HostTime;
use dpm_device::tracker::TrackerError;
use dpm_handoff::latest::{latest, Publisher, Reader};
use dpm_rig::light::registration::RegistrationMeter;
use dpm_rig::light::FrameRecord;
use dpm_rig::rig::{affine, Rig};
use dpm_rig::trackers::SourceError;
use dpm_rig::tracks::{open_for, TrackSnapshot, TrackingStage};
use glam::DAffine3;

/// Between two predictions of [`AgainstOffline::evenly`].
const EVENLY_NS: i64 = 5_000_000;

/// Why there is nothing to compare with.
#[derive(Debug, thiserror::Error)]
pub enum OfflineError {
    /// The tracker does not exist.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// The tracker failed.
    #[error(transparent)]
    Tracker(#[from] TrackerError),
    /// Only the mock tracker tells where bodies truly are.
    #[error("tracker.kind is not \"mock\": nobody knows where the bodies truly were")]
    NoTruth,
}

/// The tracker and the filters of a rig, one step at a time.
pub(crate) struct OfflinePredictor {
    stage: TrackingStage,
    publisher: Publisher<TrackSnapshot>,
    reader: Reader<TrackSnapshot>,
}

impl OfflinePredictor {
    /// As the rig's own at the beginning of a run.
    ///
    /// # Errors
    /// As [`open_for`].
    pub(crate) fn new(rig: &Rig) -> Result<Self, SourceError> {
        let tracker = open_for(rig, std::sync::Arc::new(|| HostTime(0)), HostTime(0))?;
        let stage = TrackingStage::new(rig, tracker);
        let (publisher, reader) = latest(TrackSnapshot::empty(rig.tracked_count()));
        Ok(Self { stage, publisher, reader })
    }

    /// Takes in every sample that had arrived by `at`, which lies not before that of the call before.
    ///
    /// # Errors
    /// The tracker is gone.
    pub(crate) fn latch(&mut self, at: HostTime) -> Result<(), TrackerError> {
        self.stage.step(at, &mut self.publisher)
    }

    /// Capture of the newest sample of tracked body `body` that was latched last; `None` before its first samples.
    pub(crate) fn captured_at(&mut self, body: usize) -> Option<HostTime> {
        Some(self.reader.latest().0.tracks.get(body).copied().flatten()?.0.captured_at)
    }

    /// World-from-body of tracked body `body` at `at` by what was latched last; `None` before its first samples.
    pub(crate) fn predict(&mut self, body: usize, at: HostTime) -> Option<DAffine3> {
        let (state, _) = self.reader.latest().0.tracks.get(body).copied().flatten()?;
        Some(affine(&state.predict(at).pose))
    }
}

/// Registration of a run beside that of the same predictor offline, of the same points of the same frames, at the same instants: pixels of the
/// projector.
#[derive(Clone, Copy, Debug, Default)]
pub struct AgainstOffline {
    /// Lit frames that were compared.
    pub frames: usize,
    /// From latch to the instant at which registration is measured, milliseconds.
    pub horizon_ms: Quantiles,
    /// How much older the samples of lit bodies were than the newest that had arrived when the frame was latched, milliseconds.
    pub behind_ms: Quantiles,
    /// As the run lit them.
    pub run: Quantiles,
    /// As the predictor has them by all samples that had arrived when the frame was latched.
    pub offline: Quantiles,
    /// How far the light lay from where the predictor has it, whatever the truth is: steady errors of the run alone.
    pub apart: Quantiles,
    /// The same predictor every 5 ms while the run lasted, at those horizons in turn: turns whether or not a frame met them.
    pub evenly: Quantiles,
    /// Offline, in every slot in which a frame stood, its first and those in which it was repeated: predicted to the first, as the rig does.
    pub held_by_first: Quantiles,
    /// The same predicted to the middle of the time for which the frame stood, which the rig cannot know when it plans it.
    pub held_by_middle: Quantiles,
    /// Offline, in the first slot alone, of frames predicted to the middle of the time for which they stood.
    pub first_by_middle: Quantiles,
}

impl AgainstOffline {
    /// How much worse the run is than its predictor at the 99th percentile, 1 where it is as good: of the same frames, and of any instant at their
    /// horizons.
    pub fn ratios(&self) -> [f64; 2] {
        [self.offline, self.evenly].map(|offline| self.run.p99 / offline.p99)
    }

    /// Compares the lit frames `records`, in the order in which they were lit.
    ///
    /// # Errors
    /// The rig's tracker is not the mock, or fails.
    pub fn of(rig: &Rig, records: &[FrameRecord]) -> Result<Self, OfflineError> {
        let meter = RegistrationMeter::new(rig);
        let mut predictor = OfflinePredictor::new(rig)?;
        let slot_ns = rig.rate().slot_len_ns(0);
        let (mut run, mut offline, mut horizon_ms, mut behind_ms) = (vec![], vec![], vec![], vec![]);
        let (mut by_first, mut by_middle, mut first_by_middle, mut apart) = (vec![], vec![], vec![], vec![]);
        let lit = |record: &FrameRecord| record.timeline.centre_at;
        let mut frames = 0;
        for (i, record) in records.iter().enumerate() {
            let Some(at) = lit(record) else { continue };
            predictor.latch(record.timeline.latched_at)?;
            frames += 1;
            horizon_ms.push(at.ns_since(record.timeline.latched_at) as f64 * 1e-6);
            // The last frame stands for as long as nobody tells.
            let stood_ns = records.get(i + 1).and_then(lit).map_or(slot_ns, |next| next.ns_since(at));
            let slots = ((stood_ns + slot_ns / 2) / slot_ns).max(1);
            let middle = at.plus_ns((slots - 1) * slot_ns / 2);
            let lit_bodies = || (0..rig.bodies.len()).filter(|&body| record.dark[body].is_none());
            if let Some(newest) = lit_bodies().filter_map(|body| predictor.captured_at(body)).min() {
                behind_ms.push(newest.ns_since(record.timeline.captured_at) as f64 * 1e-6);
            }
            for body in lit_bodies() {
                let (Some(to_first), Some(to_middle)) =
                    (predictor.predict(body, at), predictor.predict(body, middle))
                else {
                    continue;
                };
                for k in 0..slots {
                    let instant = at.plus_ns(k * slot_ns);
                    let truth = rig.true_poses(instant.0).ok_or(OfflineError::NoTruth)?[body];
                    by_first.extend(meter.errors(body, &to_first, &truth));
                    by_middle.extend(meter.errors(body, &to_middle, &truth));
                    if k == 0 {
                        run.extend(meter.errors(body, &record.tracked_poses[body], &truth));
                        offline.extend(meter.errors(body, &to_first, &truth));
                        apart.extend(meter.errors(body, &record.tracked_poses[body], &to_first));
                        first_by_middle.extend(meter.errors(body, &to_middle, &truth));
                    }
                }
            }
        }
        let latched = |record: Option<&FrameRecord>| record.map_or(HostTime(0), |r| r.timeline.latched_at);
        let span = (latched(records.first()), latched(records.last()));
        Ok(Self {
            frames,
            evenly: evenly(rig, &meter, span, &horizon_ms)?,
            horizon_ms: Quantiles::of(horizon_ms),
            behind_ms: Quantiles::of(behind_ms),
            run: Quantiles::of(run),
            offline: Quantiles::of(offline),
            apart: Quantiles::of(apart),
            held_by_first: Quantiles::of(by_first),
            held_by_middle: Quantiles::of(by_middle),
            first_by_middle: Quantiles::of(first_by_middle),
        })
    }
}

/// Registration of the predictor at each of `horizons_ms` in turn, latched every [`EVENLY_NS`] from `from` on up to `to`, pixels.
fn evenly(
    rig: &Rig,
    meter: &RegistrationMeter,
    (from, to): (HostTime, HostTime),
    horizons_ms: &[f64],
) -> Result<Quantiles, OfflineError> {
    let mut predictor = OfflinePredictor::new(rig)?;
    let mut errors = Vec::new();
    let mut latched_at = from;
    for horizon_ms in horizons_ms.iter().cycle() {
        if latched_at > to {
            break;
        }
        predictor.latch(latched_at)?;
        let at = latched_at.plus_ns((horizon_ms * 1e6) as i64);
        let truth = rig.true_poses(at.0).ok_or(OfflineError::NoTruth)?;
        for (body, truth) in truth.iter().enumerate() {
            if let Some(pose) = predictor.predict(body, at) {
                errors.extend(meter.errors(body, &pose, truth));
            }
        }
        latched_at = latched_at.plus_ns(EVENLY_NS);
    }
    Ok(Quantiles::of(errors))
}
