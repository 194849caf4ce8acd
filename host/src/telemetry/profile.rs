//! Finished frames into distributions: one histogram per interval, batches for the noise of every figure, misses by cause.
//!
//! Recording allocates nothing. A profiler belongs to one thread, beside the frame path.

use super::interval::{Interval, IntervalKind};
use crate::frame::FrameTimeline;
use crate::plan::slots::MissCause;
use crate::realtime::standstill::Standstills;
use dpm_device::time::{FrameRate, HostTime};
use hdrhistogram::Histogram;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Longest time told apart, ns; longer ones are counted as saturated.
const LONGEST_NS: u64 = 10_000_000_000;
/// Three digits: 0.1 % of each value.
const DIGITS: u8 = 3;
/// Batches kept; a longer run's later batches only count in the whole.
const MAX_BATCHES: usize = 1024;
/// Late frames that can be excused by a standstill; more than this and the run is beyond excuse.
const MAX_LATE_SPANS: usize = 1 << 14;

/// One interval's distribution. Negative times count as 0 and are counted.
#[derive(Clone, Debug)]
struct Track {
    whole: Histogram<u64>,
    batch: Histogram<u64>,
    p50: Vec<f64>,
    p99: Vec<f64>,
    negative: u64,
    saturated: u64,
}

impl Track {
    fn new() -> Self {
        let histogram =
            || Histogram::new_with_bounds(1, LONGEST_NS, DIGITS).expect("constant bounds are in range");
        Self {
            whole: histogram(),
            batch: histogram(),
            p50: Vec::with_capacity(MAX_BATCHES),
            p99: Vec::with_capacity(MAX_BATCHES),
            negative: 0,
            saturated: 0,
        }
    }

    fn record(&mut self, ns: i64) {
        self.negative += u64::from(ns < 0);
        let ns = ns.max(0).unsigned_abs();
        self.saturated += u64::from(ns > LONGEST_NS);
        self.whole.saturating_record(ns.min(LONGEST_NS));
        self.batch.saturating_record(ns.min(LONGEST_NS));
    }

    fn end_batch(&mut self) {
        if !self.batch.is_empty() && self.p50.len() < MAX_BATCHES {
            self.p50.push(self.batch.value_at_quantile(0.5) as f64 * 1e-6);
            self.p99.push(self.batch.value_at_quantile(0.99) as f64 * 1e-6);
        }
        self.batch.reset();
    }

    fn distribution(&self, kind: IntervalKind) -> Distribution {
        let h = &self.whole;
        let ms = |ns: u64| ns as f64 * 1e-6;
        Distribution {
            kind: match kind {
                IntervalKind::Work => "work",
                IntervalKind::Wait => "wait",
                IntervalKind::Total => "total",
            }
            .into(),
            count: h.len(),
            mean: h.mean() * 1e-6,
            p50: ms(h.value_at_quantile(0.5)),
            p90: ms(h.value_at_quantile(0.9)),
            p99: ms(h.value_at_quantile(0.99)),
            p999: ms(h.value_at_quantile(0.999)),
            p9999: ms(h.value_at_quantile(0.9999)),
            max: if h.is_empty() { 0.0 } else { ms(h.max()) },
            negative: self.negative,
            saturated: self.saturated,
            batch_p50: self.p50.clone(),
            batch_p99: self.p99.clone(),
        }
    }
}

/// What a distribution says, milliseconds.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Distribution {
    /// "work", "wait" or "total".
    pub kind: String,
    /// Frames.
    pub count: u64,
    /// Arithmetic mean.
    pub mean: f64,
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
    /// Frames in which the interval was negative: counted as 0.
    pub negative: u64,
    /// Frames beyond 10 s: counted as 10 s.
    pub saturated: u64,
    /// Median of each batch of consecutive frames, for the noise of the figures above.
    pub batch_p50: Vec<f64>,
    /// 99 % of each batch.
    pub batch_p99: Vec<f64>,
}

/// What a profiling run found, as `profile.json` keeps it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ProfileReport {
    /// What ran, for whoever compares two of them: machine, GPU, raster, pace and so on.
    pub setup: BTreeMap<String, String>,
    /// Nominal frames per second.
    pub frame_rate_hz: f64,
    /// Frames that were lit.
    pub frames_lit: u64,
    /// Frames lit after the slot they were planned for, and not because the machine stood still.
    pub frames_late: u64,
    /// Late frames that were under way while the machine stood still.
    pub frames_late_standstill: u64,
    /// Slots without a frame of their own, by cause.
    pub missed: BTreeMap<String, u64>,
    /// First photon against the exact slot times of consecutive frames: jitter.
    pub jitter_ms: Distribution,
    /// Every interval by name.
    pub intervals_ms: BTreeMap<String, Distribution>,
    /// Error of the clock mapping, ns: half the shortest round trip and drift, as its estimator bounds it.
    pub clock_error_bound_ns: Option<i64>,
    /// Time in which the machine stood still, ns, and the longest such interval.
    pub standstill_ns: (i64, i64),
}

/// Collects the frames of a run.
#[derive(Clone, Debug)]
pub struct Profiler {
    rate: FrameRate,
    measured: bool,
    batch_frames: u64,
    in_batch: u64,
    tracks: Vec<Track>,
    jitter: Track,
    last_lit: Option<(u64, HostTime)>,
    frames_lit: u64,
    frames_late: u64,
    /// From latch to light of the late frames, to be held against the standstills at the end.
    late_spans: Vec<(HostTime, HostTime)>,
    missed: [u64; MissCause::ALL.len()],
}

impl Profiler {
    /// `measured`: stamps are readings of a clock (real pace). A batch is `batch_frames` consecutive frames: about a tenth of the
    /// run, at least 100 for a 99th percentile.
    pub fn new(rate: FrameRate, measured: bool, batch_frames: u64) -> Self {
        Self {
            rate,
            measured,
            batch_frames: batch_frames.max(1),
            in_batch: 0,
            tracks: Interval::ALL.iter().map(|_| Track::new()).collect(),
            jitter: Track::new(),
            last_lit: None,
            frames_lit: 0,
            frames_late: 0,
            late_spans: Vec::with_capacity(MAX_LATE_SPANS),
            missed: [0; MissCause::ALL.len()],
        }
    }

    /// Takes in a frame that was lit in `slot`. `late`: it was planned for an earlier one.
    pub fn lit(&mut self, timeline: &FrameTimeline, slot: u64, late: bool) {
        self.frames_lit += 1;
        if late {
            self.frames_late += 1;
            if let (Some(lit_at), true) = (timeline.lit_at, self.late_spans.len() < MAX_LATE_SPANS) {
                self.late_spans.push((timeline.latched_at, lit_at));
            }
        }
        for (interval, track) in Interval::ALL.into_iter().zip(&mut self.tracks) {
            if let Some(ns) = interval.of(timeline, self.measured) {
                track.record(ns);
            }
        }
        if let Some(lit_at) = timeline.lit_at {
            if let Some((last_slot, last_at)) = self.last_lit {
                let exact = self.rate.slot_start_ns(slot).saturating_sub(self.rate.slot_start_ns(last_slot));
                self.jitter.record(lit_at.ns_since(last_at).saturating_sub(exact).saturating_abs());
            }
            self.last_lit = Some((slot, lit_at));
        }
        self.in_batch += 1;
        if self.in_batch == self.batch_frames {
            self.in_batch = 0;
            self.tracks.iter_mut().chain([&mut self.jitter]).for_each(Track::end_batch);
        }
    }

    /// Counts slots that got no frame of their own.
    pub fn missed(&mut self, cause: MissCause, slots: u64) {
        self.missed[cause as usize] += slots;
    }

    /// The histogram of an interval, for V2 logs and plots.
    pub fn histogram(&self, interval: Interval) -> &Histogram<u64> {
        &self.tracks[interval as usize].whole
    }

    /// The report so far, with late frames that were under way while the machine stood still told apart. Setup and clock are
    /// the caller's to fill.
    pub fn report(&self, standstills: &Standstills) -> ProfileReport {
        let excused =
            self.late_spans.iter().filter(|(from, to)| standstills.touches(*from, *to)).count() as u64;
        let tracks = Interval::ALL.into_iter().zip(&self.tracks);
        ProfileReport {
            frame_rate_hz: self.rate.hz(),
            frames_lit: self.frames_lit,
            frames_late: self.frames_late - excused,
            frames_late_standstill: excused,
            standstill_ns: (standstills.total_ns(), standstills.longest_ns()),
            missed: MissCause::ALL.iter().map(|c| (c.name().to_owned(), self.missed[*c as usize])).collect(),
            jitter_ms: self.jitter.distribution(IntervalKind::Total),
            intervals_ms: tracks.map(|(i, t)| (i.name().to_owned(), t.distribution(i.kind()))).collect(),
            ..ProfileReport::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::interval::tests::frame;
    use super::*;

    fn profiler() -> Profiler {
        Profiler::new(FrameRate::new(1000, 1).unwrap(), true, 100)
    }

    #[test]
    fn quantiles_and_batches_are_those_of_the_frames() {
        let mut profiler = profiler();
        for k in 0..1000i64 {
            // Steps of 1 us to 1 ms, in a scrambled order.
            let step = 1_000 * (1 + k * 387 % 1000);
            profiler.lit(&frame(k * 1_000_000, step), k as u64, k % 100 == 0);
        }
        // The machine stood still around the frames 0 and 500, of the ten late ones.
        let mut standstills = Standstills::default();
        standstills.note(HostTime(0), HostTime(2_000_000), 1_000_000);
        standstills.note(HostTime(500_000_000), HostTime(502_000_000), 1_000_000);
        let report = profiler.report(&standstills);
        let tracker = &report.intervals_ms["tracker"];
        assert_eq!((tracker.count, tracker.kind.as_str()), (1000, "work"));
        for (found, exact) in [
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
        assert!((report.intervals_ms["motion_to_light"].p50 - 4.0).abs() < 0.01);
        assert_eq!((report.frames_lit, report.frames_late, report.frames_late_standstill), (1000, 8, 2));
        assert_eq!(report.standstill_ns, (4_000_000, 2_000_000));
        // Light came 8 steps after the slot's start, so jitter is the change of 8 steps.
        assert!(report.jitter_ms.max > 1.0 && report.jitter_ms.count == 999);
    }

    #[test]
    fn what_does_not_fit_is_counted() {
        let mut profiler = profiler();
        profiler.lit(&frame(0, -5), 0, false);
        profiler.lit(&frame(0, 3_000_000_000), 1, false);
        profiler.missed(MissCause::Link, 3);
        let report = profiler.report(&Standstills::default());
        let m2l = &report.intervals_ms["motion_to_light"];
        assert_eq!((m2l.count, m2l.negative, m2l.saturated), (2, 1, 1));
        assert!((m2l.max / 10_000.0 - 1.0).abs() < 2e-3);
        assert_eq!((report.missed["link"], report.missed["render"]), (3, 0));
        let text = serde_json::to_string(&report).unwrap();
        let back: ProfileReport = serde_json::from_str(&text).unwrap();
        assert_eq!((&back.missed, back.frames_lit), (&report.missed, report.frames_lit));
        assert!((back.intervals_ms["pack"].p99 - report.intervals_ms["pack"].p99).abs() < 1e-9);
    }
}
