//! Decides how long to wait for a rendered frame and which frame is no longer worth packing, and learns from the
//! GPU's times.

use super::facts::{CrewFacts, Facts};
use crate::frame::job::{Fate, FrameNote};
use crate::plan::budget::BudgetController;
use dpm_device::time::HostTime;
use std::sync::atomic::Ordering;
use std::sync::Arc;

/// The GPU's times for the last frames, from which the next wait is derived.
struct GpuTimes {
    recent: [i64; 64],
    count: usize,
    last_done_at: HostTime,
}

impl GpuTimes {
    /// Frames after which the GPU is warm.
    const WARM: usize = 16;
    /// Shortest and longest wait, nanoseconds.
    const SHORTEST_NS: i64 = 100_000_000;
    const LONGEST_NS: i64 = 2_000_000_000;

    fn new() -> Self {
        Self { recent: [0; 64], count: 0, last_done_at: HostTime(i64::MIN) }
    }

    /// The next frames may take as long as those of a GPU that is not warm.
    fn forget(&mut self) {
        self.count = 0;
    }

    /// Records that the GPU finished a frame. Returns the time that it spent on this frame alone.
    fn finished(&mut self, submitted_at: HostTime, done_at: HostTime) -> i64 {
        let took = done_at.ns_since(submitted_at);
        self.recent[self.count % self.recent.len()] = took;
        self.count += 1;
        let alone = done_at.ns_since(submitted_at.max(self.last_done_at));
        self.last_done_at = done_at;
        alone
    }

    /// How long to wait for a frame: four times the longest of the last 64 (their 99th percentile), at most two
    /// seconds.
    fn limit_ns(&self) -> u64 {
        let longest = self.recent.iter().copied().max().unwrap_or(0);
        let limit = if self.count < Self::WARM { Self::LONGEST_NS } else { longest.saturating_mul(4) };
        limit.clamp(Self::SHORTEST_NS, Self::LONGEST_NS) as u64
    }
}

/// The decisions of packing.
pub(crate) struct PackStage {
    facts: Arc<Facts>,
    crew: Arc<CrewFacts>,
    times: GpuTimes,
    budget: Option<BudgetController>,
    late_in_a_row: usize,
    /// Samples that the last frame might take, by each of the two bounds.
    allowed: [u64; 2],
}

impl PackStage {
    /// For a crew. `budget`: `None` if every frame gets the rays that the rig file asks for.
    pub(crate) fn new(facts: Arc<Facts>, crew: Arc<CrewFacts>, budget: Option<BudgetController>) -> Self {
        let this = Self { facts, crew, times: GpuTimes::new(), budget, late_in_a_row: 0, allowed: [0; 2] };
        this.wait_is_over();
        this
    }

    /// From `now` on packing waits for the GPU to finish the frame of `note`. Returns how long it may take, nanoseconds.
    pub(crate) fn wait_from(&mut self, note: &FrameNote, now: HostTime) -> u64 {
        let allowed = [u64::from(note.plan.samples), note.plan.most_milli];
        if (0..2).any(|i| allowed[i] > self.allowed[i]) {
            // The operator asks for more: the times so far say nothing about such frames.
            self.times.forget();
        }
        self.allowed = allowed;
        self.facts.gpu_since_ns.store(now.0, Ordering::Relaxed);
        self.times.limit_ns()
    }

    /// Packing waits for no frame of the GPU.
    pub(crate) fn wait_is_over(&self) {
        self.facts.gpu_since_ns.store(i64::MAX, Ordering::Relaxed);
    }

    /// The GPU finished a frame at `now`.
    pub(crate) fn rendered(&mut self, note: &FrameNote, now: HostTime) {
        self.crew.gpu.finish(self.times.finished(note.timeline.submitted_at, now));
        if let (Some(controller), Some(gpu_ns)) = (&mut self.budget, note.gpu_ns()) {
            controller.within(note.plan.most_milli);
            controller.measured(note.plan.budget_milli, gpu_ns);
            self.crew.budget_milli.store(controller.rays(), Ordering::Relaxed);
        }
    }

    /// Whether to pack the frame at `now`. `is_newest`: no other frame waits behind it. Frames behind a rendered one
    /// are still being rendered, so more consecutive late frames than were in flight mean a slow GPU and not a stall.
    /// Such a GPU has no newer frame that would be in time, and late frames are better than none while their poses
    /// are recent enough.
    pub(crate) fn is_wanted(&mut self, note: &mut FrameNote, now: HostTime, is_newest: bool) -> bool {
        let is_rendered = note.cost.is_some();
        self.late_in_a_row = if is_late(note, now) { self.late_in_a_row + 1 } else { 0 };
        let is_slow = is_rendered && self.late_in_a_row > self.facts.options.in_flight;
        is_slow || !is_overtaken(note, now, is_newest)
    }
}

/// True when the frame's slot has begun.
fn is_late(note: &FrameNote, now: HostTime) -> bool {
    now >= note.timeline.due_at
}

/// Leaves a frame out if its slot has begun while a newer one waits behind it. This keeps frames from queueing after
/// a stall.
pub(crate) fn is_overtaken(note: &mut FrameNote, now: HostTime, is_newest: bool) -> bool {
    if note.fate == Fate::UnderWay && !is_newest && is_late(note, now) {
        note.fate = Fate::Overtaken;
    }
    note.fate == Fate::Overtaken
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gpu_is_waited_for_four_times_as_long_as_it_lately_took() {
        let mut times = GpuTimes::new();
        assert_eq!(times.limit_ns(), 2_000_000_000, "not warm yet");
        let at = |ms: i64| HostTime(ms * 1_000_000);
        for i in 0..40 {
            // Two in flight: each takes 80 ms, of which 40 are its own.
            let alone = times.finished(at(40 * i), at(40 * i + 80));
            assert!(i == 0 || alone == 40_000_000, "{alone}");
        }
        assert_eq!(times.limit_ns(), 320_000_000);
        times.forget();
        assert_eq!(times.limit_ns(), 2_000_000_000, "more samples are asked for");
        for i in 0..16 {
            times.finished(at(1700 + 10 * i), at(1701 + 10 * i));
        }
        assert_eq!(times.limit_ns(), 320_000_000, "warm again");
        times.finished(at(5000), at(9000));
        assert_eq!(times.limit_ns(), 2_000_000_000, "never longer than two seconds");
        for i in 0..64 {
            times.finished(at(10_000 + 10 * i), at(10_001 + 10 * i));
        }
        assert_eq!(times.limit_ns(), 100_000_000);
    }
}
