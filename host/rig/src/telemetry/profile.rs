//! Collects finished frames into distributions: one signed histogram per interval, and batches that show the noise of
//! every figure.
//!
//! Recording allocates nothing. A profiler belongs to one thread, beside the frame path.

use super::interval::{Interval, IntervalKind};
use super::signed::SignedHistogram;
use super::slots::SlotCounts;
use crate::frame::slots::{MissCause, OrderedDark};
use crate::frame::FrameTimeline;
use dpm_common::realtime::standstill::Standstills;
use dpm_device::time::{FrameRate, HostTime};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The longest time that is resolved, ns; longer ones are counted as saturated.
const LONGEST_NS: u64 = 10_000_000_000;
/// Number of batches kept. A longer run keeps every second batch, then every fourth and so on, so that they are
/// spread evenly over the run.
const MAX_BATCHES: usize = 1024;

/// The distribution of one interval, with signs.
#[derive(Clone, Debug)]
struct IntervalDistribution {
    whole: SignedHistogram,
    batch: SignedHistogram,
    /// Median and 99 % of each batch kept, ms.
    batches: Vec<(f64, f64)>,
    /// One of this many batches is kept.
    stride: u64,
    /// Number of batches that have ended.
    ended: u64,
}

impl IntervalDistribution {
    fn new() -> Self {
        Self {
            whole: SignedHistogram::new(LONGEST_NS),
            batch: SignedHistogram::new(LONGEST_NS),
            batches: Vec::with_capacity(MAX_BATCHES),
            stride: 1,
            ended: 0,
        }
    }

    fn record(&mut self, ns: i64) {
        self.whole.record(ns);
        self.batch.record(ns);
    }

    fn end_batch(&mut self) {
        if !self.batch.is_empty() {
            if self.ended.is_multiple_of(self.stride) {
                if self.batches.len() == MAX_BATCHES {
                    let mut n = 0;
                    self.batches.retain(|_| {
                        n += 1;
                        n % 2 == 1
                    });
                    self.stride *= 2;
                }
                let ms = |q: f64| self.batch.value_at_quantile(q) as f64 * 1e-6;
                self.batches.push((ms(0.5), ms(0.99)));
            }
            self.ended += 1;
        }
        self.batch.reset();
    }

    fn distribution(&self, kind: IntervalKind, modelled: bool) -> Distribution {
        let h = &self.whole;
        let ms = |q: f64| h.value_at_quantile(q) as f64 * 1e-6;
        Distribution {
            kind: match kind {
                IntervalKind::Work => "work",
                IntervalKind::Wait => "wait",
                IntervalKind::Total => "total",
            }
            .into(),
            modelled,
            count: h.len(),
            mean: h.mean() * 1e-6,
            min: h.min() as f64 * 1e-6,
            p01: ms(0.01),
            p50: ms(0.5),
            p90: ms(0.9),
            p99: ms(0.99),
            p999: ms(0.999),
            p9999: ms(0.9999),
            max: h.max() as f64 * 1e-6,
            negative: h.negative(),
            saturated: h.saturated(),
            batch_p50: self.batches.iter().map(|b| b.0).collect(),
            batch_p99: self.batches.iter().map(|b| b.1).collect(),
        }
    }
}

/// Figures of a distribution, milliseconds. Every figure has its sign.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Distribution {
    /// "work", "wait" or "total".
    pub kind: String,
    /// True if the interval was not measured on this machine but follows from numbers in the rig file: every interval
    /// at virtual pace (`real_time.stage_costs_us`), and the interval of a mock tracker.
    #[serde(default)]
    pub modelled: bool,
    /// Number of frames.
    pub count: u64,
    /// Arithmetic mean.
    pub mean: f64,
    /// Smallest.
    #[serde(default)]
    pub min: f64,
    /// 1 %.
    #[serde(default)]
    pub p01: f64,
    /// Median.
    pub p50: f64,
    /// 90 %.
    pub p90: f64,
    /// 99 %.
    pub p99: f64,
    /// 99.9 %.
    pub p999: f64,
    /// 99.99 %.
    pub p9999: f64,
    /// Largest.
    pub max: f64,
    /// Frames in which the interval was negative, that is, ended before it began; for example a frame that was lit
    /// before it was due.
    pub negative: u64,
    /// Frames beyond 10 s in either direction, counted as 10 s.
    pub saturated: u64,
    /// Median of each batch of consecutive frames, for the noise of the figures above.
    pub batch_p50: Vec<f64>,
    /// 99 % of each batch.
    pub batch_p99: Vec<f64>,
}

/// Results of a profiling run, as stored in `profile.json`. A file may omit what older programs did not write.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ProfileReport {
    /// What ran, for comparing two runs: machine, GPU, raster, pace and so on.
    pub setup: BTreeMap<String, String>,
    /// Nominal frames per second.
    pub frame_rate_hz: f64,
    /// Slots in which a frame of their own was wanted.
    #[serde(default)]
    pub slots: u64,
    /// Of these, slots without one.
    #[serde(default)]
    pub missed_slots: u64,
    /// `missed_slots` as a share of `slots`, 0 to 1.
    #[serde(default)]
    pub missed_share: f64,
    /// Missed slots whose frame was in flight while the machine itself stood still.
    #[serde(default)]
    pub excused_by_standstill: u64,
    /// Missed slots by cause.
    pub missed: BTreeMap<String, u64>,
    /// Slots in which no new picture was wanted, by reason; they are not among `slots`.
    #[serde(default)]
    pub ordered_dark: BTreeMap<String, u64>,
    /// `slots` and `missed_slots` of equal batches of consecutive slots, to show the noise of the share.
    #[serde(default)]
    pub missed_batches: Vec<(u64, u64)>,
    /// Frames that the projector lit, including dark ones.
    pub frames_lit: u64,
    /// Frames lit after the slot that they were planned for.
    pub frames_late: u64,
    /// First photon relative to the exact slot times of consecutive frames, early (negative) or late. Absent if a
    /// mock lights on an ideal clock, so that there is nothing to measure.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub jitter_ms: Option<Distribution>,
    /// Every interval by name.
    pub intervals_ms: BTreeMap<String, Distribution>,
    /// Error bound of the clock mapping, ns: half the shortest round trip plus drift, as its estimator computes it.
    pub clock_error_bound_ns: Option<i64>,
    /// Time in which the machine stood still, ns, and the longest such interval.
    pub standstill_ns: (i64, i64),
}

/// Collects the frames of a run.
#[derive(Clone, Debug)]
pub struct Profiler {
    rate: FrameRate,
    measured: bool,
    /// The tracker's interval is a constant of the rig file.
    tracker_modelled: bool,
    /// The projector lights on an ideal clock.
    ideal_light: bool,
    batch_frames: u64,
    in_batch: u64,
    tracks: Vec<IntervalDistribution>,
    jitter: IntervalDistribution,
    last_lit: Option<(u64, HostTime)>,
    frames_lit: u64,
    frames_late: u64,
}

impl Profiler {
    /// `measured`: stamps are readings of a clock (real pace). A batch is `batch_frames` consecutive frames. It
    /// should be about a tenth of the run, and at least 100 frames for a 99th percentile.
    pub fn new(rate: FrameRate, measured: bool, batch_frames: u64) -> Self {
        Self {
            rate,
            measured,
            tracker_modelled: false,
            ideal_light: false,
            batch_frames: batch_frames.max(1),
            in_batch: 0,
            tracks: Interval::ALL.iter().map(|_| IntervalDistribution::new()).collect(),
            jitter: IntervalDistribution::new(),
            last_lit: None,
            frames_lit: 0,
            frames_late: 0,
        }
    }

    /// Sets which devices are mocks. Their own intervals are constants of the rig file.
    pub(crate) fn with_mocks(mut self, tracker: bool, projector: bool) -> Self {
        (self.tracker_modelled, self.ideal_light) = (tracker, projector);
        self
    }

    /// Records a frame that was lit in `slot`. `late`: it was planned for an earlier one.
    pub fn lit(&mut self, timeline: &FrameTimeline, slot: u64, late: bool) {
        self.frames_lit += 1;
        self.frames_late += u64::from(late);
        for (interval, track) in Interval::ALL.into_iter().zip(&mut self.tracks) {
            if let Some(ns) = interval.of(timeline, self.measured) {
                track.record(ns);
            }
        }
        if let Some(lit_at) = timeline.lit_at {
            if let Some((last_slot, last_at)) = self.last_lit {
                let exact = self.rate.slot_start_ns(slot).saturating_sub(self.rate.slot_start_ns(last_slot));
                self.jitter.record(lit_at.ns_since(last_at).saturating_sub(exact));
            }
            self.last_lit = Some((slot, lit_at));
        }
        self.in_batch += 1;
        if self.in_batch == self.batch_frames {
            self.in_batch = 0;
            self.tracks.iter_mut().chain([&mut self.jitter]).for_each(IntervalDistribution::end_batch);
        }
    }

    /// The histogram of an interval, for V2 logs and plots.
    pub fn histogram(&self, interval: Interval) -> &SignedHistogram {
        &self.tracks[interval as usize].whole
    }

    /// True if the figures of `interval` are not measured, see [`Distribution::modelled`].
    pub fn is_modelled(&self, interval: Interval) -> bool {
        !self.measured || interval == Interval::Tracker && self.tracker_modelled
    }

    /// True when stamps are readings of a clock.
    pub(crate) fn is_measured(&self) -> bool {
        self.measured
    }

    /// Nominal frames per second.
    pub fn rate(&self) -> FrameRate {
        self.rate
    }

    /// Number of frames lit so far.
    pub fn frames_lit(&self) -> u64 {
        self.frames_lit
    }

    /// The report so far, with the results of the slots. The caller fills in setup and clock.
    pub fn report(
        &self,
        slots: &SlotCounts,
        batches: &[(u64, u64)],
        standstills: &Standstills,
    ) -> ProfileReport {
        let tracks = Interval::ALL.into_iter().zip(&self.tracks);
        ProfileReport {
            frame_rate_hz: self.rate.hz(),
            slots: slots.wanted(),
            missed_slots: slots.missed_total(),
            missed_share: slots.missed_share(),
            excused_by_standstill: slots.excused(),
            missed: missed_by_cause(slots),
            ordered_dark: ordered_dark(slots),
            missed_batches: batches.to_vec(),
            frames_lit: self.frames_lit,
            frames_late: self.frames_late,
            standstill_ns: (standstills.total_ns(), standstills.longest_ns()),
            jitter_ms: (!self.ideal_light)
                .then(|| self.jitter.distribution(IntervalKind::Total, !self.measured)),
            intervals_ms: tracks
                .map(|(i, t)| (i.name().to_owned(), t.distribution(i.kind(), self.is_modelled(i))))
                .collect(),
            ..ProfileReport::default()
        }
    }
}

/// Missed slots by the name of the cause, for all causes.
pub(crate) fn missed_by_cause(slots: &SlotCounts) -> BTreeMap<String, u64> {
    MissCause::ALL.iter().map(|c| (c.name().to_owned(), slots.missed[*c as usize])).collect()
}

/// Slots in which no new picture was wanted, by the name of the reason, for all reasons.
pub(crate) fn ordered_dark(slots: &SlotCounts) -> BTreeMap<String, u64> {
    let ordered = OrderedDark::ALL.iter().filter(|reason| **reason != OrderedDark::Exceeded);
    ordered.map(|r| (r.name().to_owned(), slots.ordered[*r as usize])).collect()
}

#[cfg(test)]
mod tests {
    use super::super::interval::tests::frame;
    use super::*;

    fn profiler() -> Profiler {
        Profiler::new(FrameRate::new(1000, 1).unwrap(), true, 100)
    }

    fn report(profiler: &Profiler) -> ProfileReport {
        profiler.report(&SlotCounts::default(), &[], &Standstills::default())
    }

    #[test]
    fn quantiles_and_batches_are_those_of_the_frames() {
        let mut profiler = profiler();
        for k in 0..1000i64 {
            // Steps of 1 us to 1 ms, in a scrambled order.
            let step = 1_000 * (1 + k * 387 % 1000);
            profiler.lit(&frame(k * 1_000_000, step), k as u64, k % 100 == 0);
        }
        let mut standstills = Standstills::default();
        standstills.note(HostTime(0), HostTime(2_000_000), 1_000_000);
        standstills.note(HostTime(500_000_000), HostTime(502_000_000), 1_000_000);
        let mut slots = SlotCounts { own: 990, ..Default::default() };
        slots.missed[MissCause::Standstill as usize] = 6;
        slots.missed[MissCause::Link as usize] = 4;
        slots.ordered[OrderedDark::Black as usize] = 77;
        let report = profiler.report(&slots, &[(500, 7), (500, 3)], &standstills);
        let tracker = &report.intervals_ms["tracker"];
        assert_eq!((tracker.count, tracker.kind.as_str()), (1000, "work"));
        for (found, exact) in [
            (tracker.min, 0.001),
            (tracker.p01, 0.01),
            (tracker.p50, 0.5),
            (tracker.p90, 0.9),
            (tracker.p99, 0.99),
            (tracker.p999, 0.999),
            (tracker.max, 1.0),
        ] {
            assert!((found / exact - 1.0).abs() < 2e-3, "{found} for {exact}");
        }
        assert!((tracker.mean - 0.5005).abs() < 1e-3);
        assert_eq!(tracker.batch_p50.len(), 10);
        assert!((report.intervals_ms["motion_to_first_photon"].p50 - 4.0).abs() < 0.01);
        assert!((report.intervals_ms["motion_to_centre"].p50 - 4.125).abs() < 0.01);
        assert!((report.intervals_ms["motion_to_last_photon"].p50 - 4.5).abs() < 0.01);
        assert_eq!((report.frames_lit, report.frames_late), (1000, 10));
        // The raw number comes first: every slot without a frame of its own, then the part due to the machine.
        assert_eq!((report.slots, report.missed_slots, report.excused_by_standstill), (1000, 10, 6));
        assert_eq!((report.missed_share, report.ordered_dark["black"]), (0.01, 77));
        assert_eq!(report.standstill_ns, (4_000_000, 2_000_000));
        // Light came 8 steps after the slot's start, so jitter is the change of 8 steps, upwards as often as
        // downwards.
        let jitter = report.jitter_ms.unwrap();
        assert!(jitter.max > 1.0 && jitter.min < -1.0 && jitter.count == 999);
        assert!((300..700).contains(&jitter.negative), "{}", jitter.negative);
    }

    /// Found in use (second look at latency, section 2b): frames lit 0.3 ms before they were due were counted as 0.
    #[test]
    fn a_frame_lit_before_it_was_due_is_early_in_every_figure() {
        let mut profiler = profiler();
        for k in 0..100 {
            let mut t = frame(k * 1_000_000, 1_000);
            t.due_at = t.lit_at.unwrap().plus_ns(300_000 + k);
            profiler.lit(&t, k as u64, false);
        }
        let lateness = &report(&profiler).intervals_ms["lateness"];
        assert_eq!((lateness.count, lateness.negative), (100, 100));
        for figure in [lateness.mean, lateness.min, lateness.p50, lateness.p99, lateness.max] {
            assert!((figure + 0.3).abs() < 1e-3, "{lateness:?}");
        }
    }

    #[test]
    fn what_does_not_fit_is_counted() {
        let mut profiler = profiler();
        profiler.lit(&frame(0, -5), 0, false);
        profiler.lit(&frame(0, 3_000_000_000), 1, false);
        let report = report(&profiler);
        let m2l = &report.intervals_ms["motion_to_first_photon"];
        assert_eq!((m2l.count, m2l.negative, m2l.saturated), (2, 1, 1));
        assert!((m2l.max / 10_000.0 - 1.0).abs() < 2e-3);
        assert!((m2l.min + 40e-6).abs() < 1e-9);
        let text = serde_json::to_string(&report).unwrap();
        let back: ProfileReport = serde_json::from_str(&text).unwrap();
        assert_eq!((&back.missed, back.frames_lit), (&report.missed, report.frames_lit));
        assert!((back.intervals_ms["pack"].p99 - report.intervals_ms["pack"].p99).abs() < 1e-9);
    }

    #[test]
    fn what_is_modelled_says_so() {
        let rate = FrameRate::new(1000, 1).unwrap();
        let modelled = |p: Profiler| {
            let report = report(&p);
            (
                report.intervals_ms["tracker"].modelled,
                report.intervals_ms["pack"].modelled,
                report.jitter_ms.is_some(),
            )
        };
        assert_eq!(modelled(Profiler::new(rate, true, 100)), (false, false, true));
        assert_eq!(modelled(Profiler::new(rate, true, 100).with_mocks(true, true)), (true, false, false));
        assert_eq!(modelled(Profiler::new(rate, false, 100).with_mocks(true, true)), (true, true, false));
    }

    /// Ten thousand batches: memory stays constant, and the batches kept are spread over the whole run.
    #[test]
    fn batches_of_a_long_run_are_thinned_out_evenly() {
        let mut track = IntervalDistribution::new();
        for k in 1..=10_000i64 {
            track.record(k * 1_000_000);
            track.end_batch();
        }
        let kept: Vec<f64> = track.batches.iter().map(|b| b.0.round()).collect();
        assert!(kept.len() > MAX_BATCHES / 2 && kept.len() <= MAX_BATCHES);
        assert_eq!(track.batches.capacity(), MAX_BATCHES);
        assert!(kept[0] < 2.0 && kept[kept.len() - 1] > 9_900.0);
        let steps: Vec<f64> = kept.windows(2).map(|w| w[1] - w[0]).collect();
        assert!(steps.iter().all(|s| (s - track.stride as f64).abs() < 0.003 * 10_000.0), "{steps:?}");
    }
}
