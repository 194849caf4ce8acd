//! Chooses which share of the raster is traced (`render.scale = "auto"`): from the times of frames to a rung of the ladder.
//!
//! Samples come first: the budget takes them away down to its least, and only then does the share fall, before slots would go. It falls to the largest
//! rung at which frames are expected to fit; their time is taken to go by the number of pixels, which is too little for a rung further down, as part of
//! a frame does not shrink, so a second step may follow. It rises by one rung when frames with all their samples would fit there for some time. A rise
//! that does not hold makes the next one wait twice as long. Each change begins all histories anew, so there is at most one a second.

use crate::config::{Pace, RenderConfig, RenderScale};
use crate::rig::Rig;
use dpm_device::time::HostTime;
use dpm_render::Scale;

/// Of a slot, what frames may take at the least samples before the share falls, and what they are expected to take after a change at the most.
const LIMIT: f64 = 0.92;
const AIM: f64 = 0.8;
/// Time between two changes, nanoseconds.
const REST_NS: i64 = 1_000_000_000;
/// For how long frames would have to fit before the share rises: at first, and at the most.
const PATIENCE_NS: i64 = 5_000_000_000;
const MOST_PATIENCE_NS: i64 = 80_000_000_000;
/// Frames after a change that are not counted: their histories are new, and their drivers may not have been asked for this before.
const UNCOUNTED: u32 = 2;
/// Frames that are counted before anything changes.
const FEWEST: u32 = 4;
/// Weight of the newest frame in the mean.
const WEIGHT: f64 = 0.125;

/// The share of the raster that is traced where nothing measures frames: "auto" is all of it there.
pub fn scale_of(render: &RenderConfig) -> Scale {
    match render.scale {
        RenderScale::Share(share) => Scale::Share(share),
        RenderScale::Auto => Scale::WHOLE,
    }
}

/// The same in a run, whose frames are measured at real pace. At virtual pace the pictures may not depend on the machine's
/// speed.
pub(crate) fn scale_of_run(rig: &Rig) -> Scale {
    match rig.config.render.scale {
        RenderScale::Auto if rig.config.real_time.pace == Pace::Real => Scale::Ladder,
        _ => scale_of(&rig.config.render),
    }
}

/// How many samples a frame had, of those that the budget may give.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Samples {
    /// The fewest.
    Fewest,
    /// Neither.
    Between,
    /// All.
    All,
    /// There is no budget: they are the fewest and all.
    Fixed,
}

/// Keeps frames inside their slot by tracing fewer pixels.
#[derive(Clone, Debug)]
pub struct ScaleController {
    slot_ns: f64,
    shares: &'static [f64],
    rung: usize,
    /// Mean time of the frames of this rung, nanoseconds, and how many there were.
    mean_ns: f64,
    frames: u32,
    changed_at: Option<HostTime>,
    /// The last change was a rise.
    rose: bool,
    /// Since when frames would have fitted one rung above.
    roomy_since: Option<HostTime>,
    patience_ns: i64,
}

impl ScaleController {
    /// For slots of this length and these shares, of which the first is the largest. It begins there.
    pub fn new(slot_ns: i64, shares: &'static [f64]) -> Self {
        Self {
            slot_ns: slot_ns.max(1) as f64,
            shares,
            rung: 0,
            mean_ns: 0.0,
            frames: 0,
            changed_at: None,
            rose: false,
            roomy_since: None,
            patience_ns: PATIENCE_NS,
        }
    }

    /// The rung of the next frame.
    pub fn rung(&self) -> usize {
        self.rung
    }

    /// Before a run: takes the time of a frame with the fewest samples on this rung. Returns whether another rung has to be tried.
    pub fn tried(&mut self, took_ns: i64) -> bool {
        let fits = (took_ns as f64) <= LIMIT * self.slot_ns || self.rung + 1 == self.shares.len();
        if !fits {
            self.rung = self.fitting(took_ns as f64);
        }
        !fits
    }

    /// The largest rung below this one at which frames are expected to fit; the last if none is.
    fn fitting(&self, took_ns: f64) -> usize {
        let last = self.shares.len() - 1;
        let fits = |&rung: &usize| self.expected(took_ns, rung) <= AIM * self.slot_ns;
        (self.rung + 1..=last).find(fits).unwrap_or(last)
    }

    /// What a frame of another rung takes, by its pixels.
    fn expected(&self, took_ns: f64, rung: usize) -> f64 {
        let ratio = self.shares[rung] / self.shares[self.rung];
        took_ns * ratio * ratio
    }

    /// Takes the time of a frame that had this rung and so many samples, and ended at `now`. Frames of other rungs, which were under way when it
    /// changed, do not count.
    pub(crate) fn measured(&mut self, rung: usize, samples: Samples, took_ns: i64, now: HostTime) {
        if rung != self.rung || took_ns <= 0 {
            return;
        }
        self.frames += 1;
        if self.frames <= UNCOUNTED {
            return;
        }
        let took = took_ns as f64;
        let is_first = self.frames == UNCOUNTED + 1;
        self.mean_ns = if is_first { took } else { self.mean_ns + WEIGHT * (took - self.mean_ns) };
        let rested = self.changed_at.is_none_or(|at| now.ns_since(at) >= REST_NS);
        if self.frames < UNCOUNTED + FEWEST || !rested {
            return;
        }
        let is_late =
            matches!(samples, Samples::Fewest | Samples::Fixed) && self.mean_ns > LIMIT * self.slot_ns;
        if is_late && self.rung + 1 < self.shares.len() {
            let soon = self.changed_at.is_some_and(|at| now.ns_since(at) < 4 * self.patience_ns);
            self.patience_ns = match self.rose && soon {
                true => (2 * self.patience_ns).min(MOST_PATIENCE_NS),
                false => PATIENCE_NS,
            };
            return self.change(self.fitting(self.mean_ns), false, now);
        }
        let has_room = matches!(samples, Samples::All | Samples::Fixed)
            && self.rung > 0
            && self.expected(self.mean_ns, self.rung - 1) <= AIM * self.slot_ns;
        match (has_room, self.roomy_since) {
            (false, _) => self.roomy_since = None,
            (true, None) => self.roomy_since = Some(now),
            (true, Some(since)) if now.ns_since(since) >= self.patience_ns => {
                self.change(self.rung - 1, true, now)
            }
            (true, Some(_)) => {}
        }
    }

    fn change(&mut self, rung: usize, rises: bool, now: HostTime) {
        (self.rung, self.rose, self.changed_at) = (rung, rises, Some(now));
        (self.frames, self.mean_ns, self.roomy_since) = (0, 0.0, None);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHARES: &[f64] = &[1.0, 0.75, 0.5, 0.35, 0.25];
    const SLOT_NS: i64 = 16_000_000;

    /// Frames that take `fixed + whole * share^2` slots; returns the rungs, one a frame.
    fn run(
        c: &mut ScaleController,
        from_s: f64,
        seconds: f64,
        samples: Samples,
        (fixed, whole): (f64, f64),
    ) -> Vec<usize> {
        let mut now = (from_s * 1e9) as i64;
        let end = now + (seconds * 1e9) as i64;
        let mut rungs = Vec::new();
        while now < end {
            let share = SHARES[c.rung()];
            let took = ((fixed + whole * share * share) * SLOT_NS as f64) as i64;
            now += took.max(SLOT_NS);
            c.measured(c.rung(), samples, took, HostTime(now));
            rungs.push(c.rung());
        }
        rungs
    }

    fn changes(rungs: &[usize]) -> usize {
        rungs.windows(2).filter(|two| two[0] != two[1]).count()
    }

    #[test]
    fn it_falls_to_the_largest_share_that_fits_and_stays_there() {
        // Of these loads the largest that fit are 1, 0.75, 0.5, 0.35, 0.25, and none.
        for (whole, rung) in [(0.85, 0), (1.3, 1), (3.0, 2), (6.0, 3), (11.0, 4), (100.0, 4)] {
            let mut c = ScaleController::new(SLOT_NS, SHARES);
            let rungs = run(&mut c, 0.0, 30.0, Samples::Fewest, (0.05, whole));
            assert_eq!(rungs.last(), Some(&rung), "{whole}");
            assert!(changes(&rungs) <= 2, "{whole}: {} changes", changes(&rungs));
        }
    }

    #[test]
    fn samples_go_before_pixels_do() {
        let mut c = ScaleController::new(SLOT_NS, SHARES);
        for samples in [Samples::All, Samples::Between] {
            assert_eq!(run(&mut c, 0.0, 30.0, samples, (0.1, 5.0)).last(), Some(&0));
        }
        assert!(run(&mut c, 30.0, 2.0, Samples::Fewest, (0.1, 5.0)).last() > Some(&0));
    }

    #[test]
    fn it_rises_step_by_step_when_there_is_room_for_long_and_never_oscillates_fast() {
        let mut c = ScaleController::new(SLOT_NS, SHARES);
        run(&mut c, 0.0, 5.0, Samples::Fixed, (0.0, 50.0));
        assert_eq!(c.rung(), 4);
        // Less than the patience: nothing. Then a step at a time.
        assert_eq!(run(&mut c, 5.0, 4.0, Samples::Fixed, (0.0, 0.5)).last(), Some(&4));
        let rungs = run(&mut c, 9.0, 60.0, Samples::Fixed, (0.0, 0.5));
        assert_eq!(rungs.last(), Some(&0));
        assert!(rungs.windows(2).all(|two| two[0] - two[1] <= 1));
        // A load whose time does not go by pixels, so that a rise never holds: the waits grow to the longest.
        let mut c = ScaleController::new(SLOT_NS, SHARES);
        let mut rungs = Vec::new();
        let mut now = 0i64;
        for _ in 0..60_000 {
            let took = if c.rung() >= 2 { SLOT_NS / 4 } else { 2 * SLOT_NS };
            now += took.max(SLOT_NS);
            c.measured(c.rung(), Samples::Fixed, took, HostTime(now));
            rungs.push(c.rung());
        }
        let per_minute = changes(&rungs) as f64 / (now as f64 * 1e-9 / 60.0);
        assert!(per_minute < 4.0, "{per_minute} changes a minute");
    }

    #[test]
    fn there_is_at_most_one_change_a_second_whatever_is_measured() {
        let mut random = 1u64;
        let mut c = ScaleController::new(SLOT_NS, SHARES);
        let (mut last, mut at) = (c.rung(), i64::MIN / 2);
        for i in 0..50_000i64 {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            let now = i * 3_000_000;
            let samples = [Samples::Fewest, Samples::Between, Samples::All, Samples::Fixed]
                [(random >> 60) as usize % 4];
            c.measured(c.rung(), samples, ((random >> 33) % 40_000_000) as i64 - 5, HostTime(now));
            if c.rung() != last {
                assert!(now - at >= REST_NS, "{}", now - at);
                (last, at) = (c.rung(), now);
            }
        }
    }

    #[test]
    fn a_run_begins_with_the_largest_share_whose_first_frames_fit() {
        let mut c = ScaleController::new(SLOT_NS, SHARES);
        let took = |c: &ScaleController| ((0.3 + 3.0 * SHARES[c.rung()].powi(2)) * SLOT_NS as f64) as i64;
        let mut tries = 1;
        while c.tried(took(&c)) {
            tries += 1;
        }
        assert!((c.rung(), tries) == (3, 3) || (c.rung(), tries) == (3, 2), "{} after {tries}", c.rung());
        let mut c = ScaleController::new(SLOT_NS, SHARES);
        assert!(!c.tried(SLOT_NS / 2) && c.rung() == 0);
    }
}
