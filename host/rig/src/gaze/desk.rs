//! The newest gaze, from the thread that hears it to the planning of frames, and what observers read of it.

use super::kind::{GazeCounts, GazeSample};
use dpm_device::time::HostTime;
use dpm_handoff::latest::{latest, Publisher, Reader};
use dpm_handoff::path::Lock;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};
use std::sync::PoisonError;

/// Gaze as a device saw it in a run.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct GazeReport {
    /// The kind by its word in the rig file.
    pub kind: &'static str,
    /// Samples that came.
    pub samples: u64,
    /// Of these: used.
    pub used: u64,
    /// Of these: of too little confidence, such as in blinks.
    pub unsure: u64,
    /// Of these: not understood, or without a direction in space.
    pub refused: u64,
    /// Of these: of an instant that is not known or cannot be.
    pub ill_timed: u64,
    /// Share of samples of too little confidence, 0 to 1; null before the first.
    pub unsure_share: Option<f64>,
    /// Used samples a second, in the last second; 0 after a second without.
    pub rate_hz: f64,
    /// Age of the newest used sample, milliseconds; null before the first.
    pub age_ms: Option<f64>,
    /// From the picture of the eyes to the arrival of a used sample, on average, milliseconds; null before the first.
    pub latency_ms: Option<f64>,
    /// Bound on the error of its instants, milliseconds.
    pub clock_bound_ms: f64,
    /// Connections after the first.
    pub reconnects: u64,
    /// How often the device's clock was set anew.
    pub clock_steps: u64,
    /// Frames that were planned by a measured gaze.
    pub frames_measured: u64,
    /// Frames that were planned by the axis of the glasses, because none was known.
    pub frames_without: u64,
    /// What speaks against it now, and what to do.
    pub doubt: Option<String>,
}

/// Where gaze passes. Writers add to numbers; each is right, but they are not all of one instant.
#[derive(Debug, Default)]
pub struct GazeDesk {
    state: Lock<GazeState>,
    frames: [AtomicU64; 2],
    age_ns: AtomicI64,
}

#[derive(Debug, Default)]
struct GazeState {
    /// To the planning of each crew; those of crews that are gone are dropped.
    to_planning: Vec<Publisher<Option<GazeSample>>>,
    newest: Option<GazeSample>,
    report: Option<GazeReport>,
    latency_ns: i128,
    /// When the second in which samples are counted began, and how many were used until then.
    second: (HostTime, u64),
}

impl GazeDesk {
    fn state(&self) -> std::sync::MutexGuard<'_, GazeState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The newest sample, for a crew that begins. Its thread reads it without a lock.
    pub(crate) fn follow(&self) -> Reader<Option<GazeSample>> {
        let mut state = self.state();
        let (publisher, reader) = latest(state.newest);
        state.to_planning.retain(Publisher::has_reader);
        state.to_planning.push(publisher);
        reader
    }

    /// Gaze is measured from now on, by a kind of this word.
    pub(crate) fn begin(&self, kind: &'static str) {
        self.age_ns.store(-1, Ordering::Relaxed);
        self.state().report = Some(GazeReport { kind, ..GazeReport::default() });
    }

    /// Passes a sample to planning.
    pub(crate) fn publish(&self, sample: &GazeSample) {
        let mut state = self.state();
        state.newest = Some(*sample);
        state.latency_ns += i128::from(sample.received_at.ns_since(sample.at));
        state.to_planning.iter_mut().for_each(|to| to.publish(Some(*sample)));
    }

    /// What the device has counted by `now`, and what speaks against it.
    pub(crate) fn tell(&self, counts: &GazeCounts, doubt: Option<String>, now: HostTime) {
        let state = &mut *self.state();
        let newest = state.newest.map(|sample| now.ns_since(sample.at));
        self.age_ns.store(newest.unwrap_or(-1), Ordering::Relaxed);
        let Some(report) = &mut state.report else { return };
        let since_ns = now.ns_since(state.second.0);
        if since_ns >= 1_000_000_000 {
            report.rate_hz = (counts.used - state.second.1) as f64 * 1e9 / since_ns as f64;
            state.second = (now, counts.used);
        }
        report.samples = counts.samples;
        (report.used, report.unsure) = (counts.used, counts.unsure);
        (report.refused, report.ill_timed) = (counts.refused, counts.ill_timed);
        report.unsure_share = (counts.samples > 0).then(|| counts.unsure as f64 / counts.samples as f64);
        report.latency_ms = (counts.used > 0).then(|| state.latency_ns as f64 / counts.used as f64 * 1e-6);
        report.clock_bound_ms = counts.clock_bound_ns as f64 * 1e-6;
        (report.reconnects, report.clock_steps) = (counts.sessions.saturating_sub(1), counts.clock_steps);
        report.doubt = doubt;
    }

    /// Counts a frame whose gaze is measured, or whose gaze should be. Called on the frame path.
    pub(crate) fn count_frame(&self, is_measured: bool) {
        self.frames[usize::from(!is_measured)].fetch_add(1, Ordering::Relaxed);
    }

    /// What is known now; `None` if gaze is not measured.
    pub fn report(&self) -> Option<GazeReport> {
        let report = self.state().report.clone()?;
        let [frames_measured, frames_without] = self.frames.each_ref().map(|n| n.load(Ordering::Relaxed));
        let age_ns = self.age_ns.load(Ordering::Relaxed);
        let age_ms = (age_ns >= 0).then_some(age_ns as f64 * 1e-6);
        Some(GazeReport { age_ms, frames_measured, frames_without, ..report })
    }
}

impl GazeReport {
    /// What an operator should know after a run; `None` if nearly all frames had a measured gaze.
    pub fn warning(&self) -> Option<String> {
        let all = self.frames_measured + self.frames_without;
        let share = self.frames_without as f64 / all.max(1) as f64;
        (share >= 0.05).then(|| {
            let why = self.doubt.as_ref().map_or(String::new(), |why| format!(": {why}"));
            format!(
                "in {:.0} % of the frames the gaze was not known and followed the axis of the glasses{why}",
                100.0 * share
            )
        })
    }
}
