//! Recalls the former motion of a body that repeats itself.
//!
//! A sudden turn is invisible until its deviation exceeds the noise, but machines, and many hands, turn where they
//! turned before. The last seconds are kept, smoothed. When the body passes a place that it has passed before, at the
//! same velocity and on the same path, its former motion is offered to the bank as one more model ([`super::imm`]). The
//! bank weights it by how much better than the others it predicts the samples. Without such a past nothing is offered,
//! and nothing changes.

use super::imm::{Chart, PastMotion};
use super::smooth::{smoothed, SmoothMotion, MARGIN_NS};
use glam::DVec3;

/// Samples kept to smooth from; at least [`MARGIN_NS`] to either side of a point, at [`SAMPLE_NS`].
const SAMPLES: usize = 192;
/// Samples closer than this to the last one kept are skipped, ns: of a tracker at 1 kHz every other one is kept.
const SAMPLE_NS: i64 = 1_800_000;
/// Points of the past kept: five seconds at [`POINT_NS`].
const POINTS: usize = 1280;
/// Least time between two of them, ns.
const POINT_NS: i64 = 3_500_000;
/// Neighbours further apart than this have a gap between them, ns.
const GAP_NS: i64 = 20_000_000;
/// Points compared with the present in [`SCAN_S`], and for each sample at most: the whole past in 40 ms.
const SCAN: usize = 64;
const SCAN_S: f64 = 2e-3;
/// Shortest period of a repetition, ns.
const LEAST_LAG_NS: i64 = 300_000_000;
/// The offered acceleration is the mean over this time, ns: about the horizon of a rig.
const AHEAD_NS: i64 = 6_000_000;
/// Number of points before and after an acceleration that count as near it: 60 ms.
const NEAR: usize = 15;
/// This many points in a row that fit no parabola are a jump; more are a motion too sharply bent for the tracker's
/// rate.
const UNFIT: usize = 7;
/// An acceleration counts when it is this many times its own standard deviation.
const SIGNIFICANT: f64 = 5.0;
/// Maximum number of passes over which the past is averaged. Each pass is aligned with the last one by a lag that is
/// itself measured, so long averages blur.
const PASSES: f64 = 3.0;
/// Least speed at which a body's place determines the time, in standard deviations of a sample per second.
const TELLING_SPEED: f64 = 1e3;
/// The greatest shift in time between two passes that still count as the same, s.
const SHIFT_S: f64 = 4e-3;
/// Time constant with which the lag follows a change of pace, s.
const FOLLOW_S: f64 = 0.04;
/// Time constant of the misfit's mean, s.
const MISFIT_S: f64 = 0.02;
/// Upper limit of a sample's misfit: from its start at a half, one wild sample every 2 ms does not lift the mean above
/// 1.
const WORST_MISFIT: f64 = 5.0;

/// A point of the past.
#[derive(Clone, Copy, Debug)]
struct Point<P> {
    at_ns: i64,
    motion: SmoothMotion<P>,
    passes: f64,
    /// The first point of a track: between it and the point before it, nothing is known.
    begins: bool,
    /// Axes along which there is an acceleration nearby.
    matters: [bool; 3],
    /// Axes along which it, or an acceleration shortly before it, is as exact as the noise allows.
    exact: [bool; 3],
}

/// A sample, and when it was taken, nanoseconds; `None` before the first ones of a track.
type Taken<C> = Option<(i64, <C as Chart>::Point)>;

/// The motion of one body in the last seconds, and which part of it the body is repeating.
#[derive(Clone, Debug)]
pub(crate) struct Recall<C: Chart> {
    /// The last [`SAMPLES`] up to `end`, oldest first; `None` only before the first samples of a track. They move to the
    /// front when the end is reached, and not with every sample.
    samples: Box<[Taken<C>; 2 * SAMPLES]>,
    end: usize,
    /// A ring: point `i` lies at `i` modulo [`POINTS`].
    points: Box<[Option<Point<C::Point>>]>,
    written: usize,
    /// The next point is the first one of a track.
    begins: bool,
    /// Points since the last acceleration along each axis.
    calm: [usize; 3],
    /// Points since the last one that fitted along each axis.
    unfit: [usize; 3],
    scanned: usize,
    lag_ns: Option<i64>,
    newest_ns: i64,
    /// Running mean of the squared distance from the past, in tolerances.
    misfit: f64,
}

impl<C: Chart> Recall<C> {
    /// An empty recall. Allocates all that it will ever need (about 0.2 MB).
    pub(crate) fn new() -> Self {
        Self {
            samples: Box::new([None; 2 * SAMPLES]),
            end: SAMPLES,
            points: vec![None; POINTS].into_boxed_slice(),
            written: 0,
            begins: true,
            calm: [usize::MAX; 3],
            unfit: [0; 3],
            scanned: 0,
            lag_ns: None,
            newest_ns: 0,
            misfit: 0.0,
        }
    }

    /// Time since the body was last where it is now, ns; `None` if it is not known to repeat itself.
    #[cfg(test)]
    pub(crate) fn lag_ns(&self) -> Option<i64> {
        self.lag_ns
    }

    /// The next samples belong to another track.
    pub(crate) fn break_track(&mut self) {
        self.samples.fill(None);
        self.lag_ns = None;
        self.begins = true;
    }

    /// The body's motion between `from_ns` and `to_ns` the last time; `None` if its acceleration was beyond `most`, per
    /// second squared. A tracker that jumped, or whose clock did, leaves such a past.
    pub(crate) fn between(&self, from_ns: i64, to_ns: i64, most: f64) -> Option<PastMotion> {
        let lag = self.lag_ns?;
        let then_ns = to_ns.saturating_sub(lag);
        let from = self.at(from_ns.saturating_sub(lag))?.motion;
        let Point { motion: to, matters, exact, .. } = self.at(then_ns)?;
        let later = self.at(then_ns.saturating_add(AHEAD_NS))?.motion;
        let (h, ahead) = ((to_ns - from_ns) as f64 * 1e-9, AHEAD_NS as f64 * 1e-9);
        let bent = C::between(to.point, later.point) - to.velocity * ahead;
        let (faster, acceleration) = (to.velocity - from.velocity, bent * (2.0 / (ahead * ahead)));
        if acceleration.length() > most || faster.length() > most * h {
            return None;
        }
        Some(PastMotion {
            moved: C::between(from.point, to.point) - from.velocity * h,
            faster,
            acceleration,
            matters: [0, 1, 2].map(|axis| matters[axis] && exact[axis]),
        })
    }

    /// Adds a sample with `sigma` standard deviation per axis, captured after the previous ones, and the bank's
    /// estimate of the motion.
    pub(crate) fn push(&mut self, at_ns: i64, z: C::Point, point: C::Point, velocity: DVec3, sigma: f64) {
        let newest = self.samples[self.end - 1];
        if newest.is_none_or(|(last_ns, _)| at_ns.saturating_sub(last_ns) >= SAMPLE_NS) {
            if self.end == self.samples.len() {
                self.samples.copy_within(SAMPLES.., 0);
                self.end = SAMPLES;
            }
            self.samples[self.end] = Some((at_ns, z));
            self.end += 1;
            self.remember(at_ns, sigma);
        }
        let since_s = at_ns.saturating_sub(self.newest_ns).max(0) as f64 * 1e-9;
        self.newest_ns = at_ns;
        match self.lag_ns {
            Some(lag) => self.follow(at_ns.saturating_sub(lag), since_s, z, sigma),
            None => {
                let scan = (SCAN as f64 * since_s / SCAN_S).round().clamp(1.0, SCAN as f64) as usize;
                self.search(at_ns, scan, point, velocity, sigma);
            }
        }
    }

    fn get(&self, i: usize) -> Option<&Point<C::Point>> {
        self.points[i % POINTS].as_ref()
    }

    fn oldest(&self) -> usize {
        self.written.saturating_sub(POINTS)
    }

    /// The past at an instant between two points.
    fn at(&self, t_ns: i64) -> Option<Point<C::Point>> {
        let (mut low, mut high) = (self.oldest(), self.written);
        while high.saturating_sub(low) > 1 {
            let middle = low + (high - low) / 2;
            if self.get(middle)?.at_ns <= t_ns {
                low = middle;
            } else {
                high = middle;
            }
        }
        if low + 1 >= self.written {
            return None;
        }
        let (a, b) = (self.get(low)?, self.get(low + 1)?);
        let gap = b.at_ns.saturating_sub(a.at_ns);
        if b.begins || gap > GAP_NS || t_ns < a.at_ns {
            return None;
        }
        let (since, until) = ((t_ns - a.at_ns) as f64 * 1e-9, (b.at_ns - t_ns) as f64 * 1e-9);
        let w = (t_ns - a.at_ns) as f64 / gap as f64;
        let (from, to) = (&a.motion, &b.motion);
        let by_a = (from.velocity + from.acceleration * (0.5 * since)) * since;
        let by_b = C::between(from.point, to.point) - (to.velocity - to.acceleration * (0.5 * until)) * until;
        Some(Point {
            at_ns: t_ns,
            motion: SmoothMotion {
                point: C::moved(from.point, by_a.lerp(by_b, w)),
                velocity: from.velocity.lerp(to.velocity, w),
                acceleration: from.acceleration.lerp(to.acceleration, w),
                ..*from
            },
            ..*a
        })
    }

    /// Adds the newest point that can be smoothed, unless the last one is too near.
    fn remember(&mut self, now_ns: i64, sigma: f64) {
        let last_ns = self.written.checked_sub(1).and_then(|i| self.get(i)).map(|p| p.at_ns);
        if last_ns.is_some_and(|last| now_ns.saturating_sub(last) < MARGIN_NS + POINT_NS) {
            return;
        }
        let due = |t: i64| {
            now_ns.saturating_sub(t) >= MARGIN_NS
                && last_ns.is_none_or(|last| t.saturating_sub(last) >= POINT_NS)
        };
        let samples = &self.samples[self.end - SAMPLES..self.end];
        let Some(middle) = samples.iter().rposition(|s| s.is_some_and(|(t, _)| due(t))) else { return };
        let Some((at_ns, motion)) = smoothed::<C>(samples, middle, sigma) else { return };
        let begins = std::mem::take(&mut self.begins);
        let mut new = Point { at_ns, motion, passes: 1.0, begins, matters: [false; 3], exact: [true; 3] };
        for axis in 0..3 {
            self.calm[axis] = self.calm[axis].saturating_add(1);
            if motion.acceleration[axis].abs() > SIGNIFICANT * motion.acceleration_sigma[axis] {
                self.calm[axis] = 0;
                for i in self.written.saturating_sub(NEAR)..self.written {
                    if let Some(before) = &mut self.points[i % POINTS] {
                        before.matters[axis] = true;
                    }
                }
            }
            new.matters[axis] = self.calm[axis] <= NEAR;
            self.unfit[axis] = if motion.fits[axis] { 0 } else { self.unfit[axis].saturating_add(1) };
            new.exact[axis] = self.unfit[axis] <= UNFIT;
        }
        if let Some(old) = self.lag_ns.and_then(|lag| self.at(at_ns.saturating_sub(lag))) {
            new.passes = (old.passes + 1.0).min(PASSES);
            let w = 1.0 / new.passes;
            let (old, new) = (&old.motion, &mut new.motion);
            new.point = C::moved(old.point, C::between(old.point, new.point) * w);
            new.velocity = old.velocity.lerp(new.velocity, w);
            new.acceleration = old.acceleration.lerp(new.acceleration, w);
        }
        self.points[self.written % POINTS] = Some(new);
        self.written += 1;
    }

    /// Distance of a point from the path through a point of the past, squared and in tolerances, and how much later on
    /// that path it is, s. The tolerance is half a millisecond of clock and four standard deviations.
    fn mismatch(past: &SmoothMotion<C::Point>, point: C::Point, sigma: f64) -> (f64, f64) {
        let e = C::between(past.point, point);
        let speed2 = past.velocity.length_squared();
        let telling = TELLING_SPEED * sigma;
        let later = e.dot(past.velocity) / (speed2 + telling * telling);
        let across = e - past.velocity * later;
        let tolerance = 4.0 * sigma + 1e-4 * speed2.sqrt() + 1e-6 * past.acceleration.length();
        (across.length_squared() / (tolerance * tolerance), later)
    }

    /// Updates the lag, or drops it if the body takes another path.
    fn follow(&mut self, then_ns: i64, since_s: f64, z: C::Point, sigma: f64) {
        let (Some(past), Some(lag)) = (self.at(then_ns), &mut self.lag_ns) else {
            self.lag_ns = None;
            return;
        };
        let (across, later) = Self::mismatch(&past.motion, z, sigma);
        *lag = lag.saturating_sub(((1.0 - libm::exp(-since_s / FOLLOW_S)) * later * 1e9) as i64);
        let shift = later / SHIFT_S;
        let misfit = (across + shift * shift).min(WORST_MISFIT);
        self.misfit += (1.0 - libm::exp(-since_s / MISFIT_S)) * (misfit - self.misfit);
        if self.misfit > 1.0 {
            self.lag_ns = None;
        }
    }

    /// Searches a part of the past for the present; the next sample continues the search.
    fn search(&mut self, at_ns: i64, scan: usize, point: C::Point, velocity: DVec3, sigma: f64) {
        let speed = velocity.length();
        let count = self.written - self.oldest();
        if speed < TELLING_SPEED * sigma || count == 0 {
            return;
        }
        let mut best: Option<(f64, i64)> = None;
        for _ in 0..scan.min(count) {
            self.scanned = (self.scanned + 1) % count;
            let Some(past) = self.get(self.oldest() + self.scanned) else { continue };
            let age_ns = at_ns.saturating_sub(past.at_ns);
            let other = (past.motion.velocity - velocity).length_squared() > 0.01 * speed * speed;
            if age_ns < LEAST_LAG_NS || other {
                continue;
            }
            let (across, later) = Self::mismatch(&past.motion, point, sigma);
            if later.abs() < SHIFT_S && across < best.map_or(1.0, |(least, _)| least) {
                best = Some((across, age_ns.saturating_sub((later * 1e9) as i64)));
            }
        }
        if let Some((_, lag)) = best.filter(|(_, lag)| self.came_the_same_way(at_ns, *lag, sigma)) {
            self.lag_ns = Some(lag);
            self.misfit = 0.5;
        }
    }

    fn came_the_same_way(&self, at_ns: i64, lag_ns: i64, sigma: f64) -> bool {
        (0..8).all(|i| {
            let t = at_ns.saturating_sub(MARGIN_NS + 2 * GAP_NS + i * 15_000_000);
            let (Some(now), Some(then)) = (self.at(t), self.at(t.saturating_sub(lag_ns))) else {
                return false;
            };
            let (across, later) = Self::mismatch(&then.motion, now.motion.point, sigma);
            across < 1.0 && later.abs() < SHIFT_S
        })
    }
}

impl<C: Chart> Default for Recall<C> {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
#[path = "recall_tests.rs"]
mod tests;
