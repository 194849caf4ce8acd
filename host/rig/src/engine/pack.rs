//! Decides how long to wait for a rendered frame and which frame is no longer worth packing, and learns from the
//! GPU's times.

use super::facts::{CrewFacts, Facts};
use crate::frame::job::{Fate, FrameNote};
use crate::plan::budget::BudgetController;
use crate::plan::scale::{Samples, ScaleController};
use dpm_device::time::HostTime;
use std::sync::atomic::Ordering;
use std::sync::Arc;

/// Most that a frame counts, as a multiple of the GPU's own time for it.
const MOST_OF_OWN: i64 = 4;

/// The GPU's times for the last frames, from which the next wait is derived.
struct GpuTimes {
    recent: [i64; 64],
    count: usize,
    last_done_at: HostTime,
    /// Shortest and longest wait, nanoseconds.
    bounds_ns: [i64; 2],
}

impl GpuTimes {
    /// Frames after which the GPU is warm.
    const WARM: usize = 16;
    /// Of a GPU.
    const BOUNDS_NS: [i64; 2] = [100_000_000, 2_000_000_000];
    /// Of software Vulkan, which has no hardware that could hang, and whose frames wait for the same cores as everything else.
    const SOFTWARE_BOUNDS_NS: [i64; 2] = [1_000_000_000, 10_000_000_000];

    fn new(is_software: bool) -> Self {
        let bounds_ns = if is_software { Self::SOFTWARE_BOUNDS_NS } else { Self::BOUNDS_NS };
        Self { recent: [0; 64], count: 0, last_done_at: HostTime(i64::MIN), bounds_ns }
    }

    /// The next frames may take as long as those of a GPU that is not warm.
    fn forget(&mut self) {
        self.count = 0;
    }

    /// Records that the GPU finished a frame; `own_ns` is its own time for it, if it has time stamps. Returns for how
    /// long the frame kept it from the next one.
    ///
    /// To start the GPU and to wake the thread that waits for it takes time too, and delays the frame. But it keeps
    /// the GPU from nothing: while a frame is drawn, the next one is started. So of a frame that found the GPU idle its
    /// own time counts, and the distance from the frame before only where frames stand in line. That distance is the
    /// host's to measure, which may have been held up, so it counts within bounds. Where frames overlap (`overlaps`) each
    /// ends about a slot after the one before, whatever it took, and its own time counts.
    fn finished(
        &mut self,
        (submitted_at, done_at): (HostTime, HostTime),
        own_ns: Option<i64>,
        overlaps: bool,
    ) -> i64 {
        let took = done_at.ns_since(submitted_at);
        self.recent[self.count % self.recent.len()] = took;
        self.count += 1;
        let waited = submitted_at < self.last_done_at;
        let alone = done_at.ns_since(submitted_at.max(self.last_done_at));
        self.last_done_at = done_at;
        match own_ns {
            Some(own) if waited && !overlaps => alone.clamp(own, own.saturating_mul(MOST_OF_OWN)),
            Some(own) => own,
            None => alone,
        }
    }

    /// How long to wait for a frame: four times the longest of the last 64 (their 99th percentile), within bounds.
    fn limit_ns(&self) -> u64 {
        let longest = self.recent.iter().copied().max().unwrap_or(0);
        let [least, most] = self.bounds_ns;
        let limit = if self.count < Self::WARM { most } else { longest.saturating_mul(4) };
        limit.clamp(least, most) as u64
    }
}

/// The decisions of packing.
pub(crate) struct PackStage {
    facts: Arc<Facts>,
    crew: Arc<CrewFacts>,
    times: GpuTimes,
    budget: Option<BudgetController>,
    /// `None` if every frame traces the same share of the raster.
    scale: Option<ScaleController>,
    late_in_a_row: usize,
    /// Samples that the last frame might take, by each of the two bounds.
    allowed: [u64; 2],
}

impl PackStage {
    /// For a crew. `budget`: `None` if every frame gets the rays that the rig file asks for.
    pub(crate) fn new(facts: Arc<Facts>, crew: Arc<CrewFacts>, budget: Option<BudgetController>) -> Self {
        let this = Self {
            facts,
            crew,
            times: GpuTimes::new(false),
            budget,
            scale: None,
            late_in_a_row: 0,
            allowed: [0; 2],
        };
        this.wait_is_over();
        this
    }

    /// The same with software Vulkan in the place of a GPU, if `is_software`.
    pub(crate) fn on_software(self, is_software: bool) -> Self {
        Self { times: GpuTimes::new(is_software), ..self }
    }

    /// The same with a share of the raster that follows the frames' times.
    pub(crate) fn scaling(self, scale: Option<ScaleController>) -> Self {
        Self { scale, ..self }
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
        let (gpu_ns, occupied_ns) = (note.gpu_ns(), note.occupied_ns());
        let span = (note.timeline.submitted_at, now);
        let took_ns = self.times.finished(span, gpu_ns, occupied_ns.is_some());
        self.crew.gpu.finish(occupied_ns.unwrap_or(took_ns));
        self.facts.gpu_is_slow.store(self.crew.gpu.is_slow(), Ordering::Relaxed);
        if let (Some(controller), Some(_)) = (&mut self.budget, gpu_ns) {
            controller.within(note.plan.most_milli);
            // The whole frame counts, although the next one may begin before its end. If only its longer part had to fit, a third more
            // rays would fit, and light would come a slot later (measured on an H100).
            controller.measured(note.plan.budget_milli, took_ns);
            self.crew.budget_milli.store(controller.rays(), Ordering::Relaxed);
        }
        if let Some(scale) = &mut self.scale {
            let samples = match &self.budget {
                None => Samples::Fixed,
                Some(budget) if budget.is_at_minimum() => Samples::Fewest,
                Some(budget) if budget.is_at_maximum() => Samples::All,
                Some(_) => Samples::Between,
            };
            scale.measured(note.plan.rung, samples, took_ns, now);
            self.crew.rung.store(scale.rung(), Ordering::Relaxed);
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
        let mut times = GpuTimes::new(false);
        assert_eq!(times.limit_ns(), 2_000_000_000, "not warm yet");
        let at = |ms: i64| HostTime(ms * 1_000_000);
        for i in 0..40 {
            // Two in flight: each takes 80 ms, of which 40 are its own.
            let alone = times.finished((at(40 * i), at(40 * i + 80)), None, false);
            assert!(i == 0 || alone == 40_000_000, "{alone}");
        }
        assert_eq!(times.limit_ns(), 320_000_000);
        times.forget();
        assert_eq!(times.limit_ns(), 2_000_000_000, "more samples are asked for");
        for i in 0..16 {
            times.finished((at(1700 + 10 * i), at(1701 + 10 * i)), None, false);
        }
        assert_eq!(times.limit_ns(), 320_000_000, "warm again");
        times.finished((at(5000), at(9000)), None, false);
        assert_eq!(times.limit_ns(), 2_000_000_000, "never longer than two seconds");
        for i in 0..64 {
            times.finished((at(10_000 + 10 * i), at(10_001 + 10 * i)), None, false);
        }
        assert_eq!(times.limit_ns(), 100_000_000);
        // A processor that draws has other work too.
        let mut times = GpuTimes::new(true);
        assert_eq!(times.limit_ns(), 10_000_000_000);
        for i in 0..16 {
            times.finished((at(10 * i), at(10 * i + 1)), None, false);
        }
        assert_eq!(times.limit_ns(), 1_000_000_000);
    }

    /// Found on an H100: the budget held the GPU's own time at 0.80 of a slot, and with what it takes to start it and to
    /// wake a thread a frame was seen to take 0.90 of one, so that every few frames the GPU counted as slow.
    #[test]
    fn what_a_frame_waits_for_on_an_idle_gpu_does_not_count_as_the_gpus_time() {
        const SLOT_NS: i64 = 1_055_966;
        let own = SLOT_NS * 8 / 10;
        let (mut times, crew) = (GpuTimes::new(false), CrewFacts::new(2 * SLOT_NS, SLOT_NS));
        assert!(crew.gpu.is_slow(), "the first frame, with a cold GPU");
        for i in 0..1000 {
            let submitted_at = HostTime(i * SLOT_NS);
            let noise = if i % 7 == 0 { SLOT_NS / 8 } else { 0 };
            let seen_at = submitted_at.plus_ns(SLOT_NS * 9 / 10 + noise);
            let took = times.finished((submitted_at, seen_at), Some(own), false);
            assert!((own..SLOT_NS * 9 / 10).contains(&took), "{took}");
            crew.gpu.finish(took);
            assert!(i < 20 || !crew.gpu.is_slow(), "at frame {i}");
        }
        // Frames that stand in line come at the distance that the GPU needs, whatever it says of each.
        let mut at = HostTime(2000 * SLOT_NS);
        for i in 0..100 {
            let done_at = at.plus_ns(SLOT_NS * 11 / 10);
            let took = times.finished((at.plus_ns(-SLOT_NS), done_at), Some(own), false);
            assert!(i == 0 || took == SLOT_NS * 11 / 10, "{took}");
            crew.gpu.finish(took);
            at = done_at;
        }
        assert!(crew.gpu.is_slow());
        // Where frames overlap, each comes a slot after the one before, however quick the GPU is.
        let overlapping = times.finished((at.plus_ns(-SLOT_NS), at.plus_ns(SLOT_NS)), Some(own), true);
        assert_eq!(overlapping, own);
        at = at.plus_ns(SLOT_NS);
        // A thread that was held up for a second says nothing about the GPU.
        let took = times.finished((at.plus_ns(-SLOT_NS), at.plus_ns(1_000_000_000)), Some(own), false);
        assert_eq!(took, MOST_OF_OWN * own);
    }
}
