//! When the tracker's samples are ready: the period of its exposures, and how long after an exposure its sample can be
//! read by planning.
//!
//! Samples may be lost, doubled or late. The period is that of many exposures, and the phase follows them by an eighth of
//! each error, so a single stamp moves neither. What a sample takes is taken as what one in five exceeds, learned by small
//! steps, so that a stall of a thread does not count. Planning waits a little for the others.

use dpm_device::time::HostTime;

/// Differences between exposures whose median is the first guess of the period.
const FEW: usize = 16;
/// Exposures over which the period is measured.
const SPAN: i64 = 2048;
/// A gap of more periods starts anew.
const LONGEST_GAP: f64 = 500.0;
/// Stamps that err by more than this, on average, tell no phase: nanoseconds, and the share of a period.
const UNSTEADY_NS: f64 = 100_000.0;
const UNSTEADY_SHARE: f64 = 0.1;
/// Samples of several cameras that lie closer together are of one exposure, nanoseconds.
const SAME_EXPOSURE_NS: i64 = 50_000;
/// Step by which the time that samples take is learned, nanoseconds, and the share of samples that exceed it.
const STEP_NS: f64 = 2_000.0;
const BEYOND: f64 = 0.2;

/// When samples are ready.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SampleRhythm {
    /// The newest exposure.
    pub captured_at: HostTime,
    /// From an exposure to the instant at which most of its samples can be read, nanoseconds.
    pub takes_ns: i64,
    /// From one exposure to the next, nanoseconds.
    pub period_ns: i64,
}

impl SampleRhythm {
    /// When the newest sample was ready, or should have been.
    pub(crate) fn ready_at(&self) -> HostTime {
        self.captured_at.plus_ns(self.takes_ns)
    }
}

/// See the module's documentation.
#[derive(Clone, Debug)]
pub(crate) struct SamplePhase {
    differences: [i64; FEW],
    delays: [i64; FEW],
    known: usize,
    /// The newest exposure as it was stamped, and as the others say that it was.
    newest: Option<[HostTime; 2]>,
    period_ns: f64,
    /// Where the period is measured from, and exposures since, twice: the older one is used.
    origins: [(HostTime, i64); 2],
    error_ns: f64,
    takes_ns: f64,
}

impl SamplePhase {
    /// Nothing is known.
    pub(crate) fn new() -> Self {
        Self {
            differences: [0; FEW],
            delays: [0; FEW],
            known: 0,
            newest: None,
            period_ns: 0.0,
            origins: [(HostTime(0), 0); 2],
            error_ns: 0.0,
            takes_ns: 0.0,
        }
    }

    /// The newest sample that can be read at `ready_at` is of `captured_at`.
    pub(crate) fn observe(&mut self, captured_at: HostTime, ready_at: HostTime) {
        let Some([stamped_at, meant_at]) = self.newest else {
            self.newest = Some([captured_at; 2]);
            return;
        };
        let since = captured_at.ns_since(stamped_at);
        if since < SAME_EXPOSURE_NS {
            return;
        }
        let takes_ns = ready_at.ns_since(captured_at) as f64;
        if self.known < FEW {
            self.differences[self.known] = since;
            self.delays[self.known] = takes_ns as i64;
            self.known += 1;
            self.newest = Some([captured_at; 2]);
            if self.known == FEW {
                self.differences.sort_unstable();
                self.period_ns = self.differences[FEW / 2] as f64;
                self.delays.sort_unstable();
                self.takes_ns = self.delays[FEW * 3 / 4] as f64;
                self.origins = [(captured_at, 0); 2];
            }
            return;
        }
        let periods = (captured_at.ns_since(meant_at) as f64 / self.period_ns).round().max(1.0);
        let expected_at = meant_at.plus_ns((periods * self.period_ns) as i64);
        let error_ns = captured_at.ns_since(expected_at) as f64;
        self.error_ns += (error_ns.abs() - self.error_ns) / 64.0;
        if periods > LONGEST_GAP || self.error_ns > self.period_ns / 4.0 {
            *self = Self::new();
            return;
        }
        self.newest = Some([captured_at, expected_at.plus_ns((error_ns / 8.0) as i64)]);
        for (_, steps) in &mut self.origins {
            *steps += periods as i64;
        }
        let (origin, steps) = self.origins[0];
        if steps >= FEW as i64 {
            self.period_ns = captured_at.ns_since(origin) as f64 / steps as f64;
        }
        if self.origins[1].1 >= SPAN {
            self.origins = [self.origins[1], (captured_at, 0)];
        }
        let more = takes_ns > self.takes_ns;
        self.takes_ns += STEP_NS * if more { 1.0 - BEYOND } else { -BEYOND };
    }

    /// When samples are ready; `None` while that is not known, or if the stamps are too unsteady to tell.
    pub(crate) fn rhythm(&self) -> Option<SampleRhythm> {
        let [_, meant_at] = self.newest?;
        let is_steady = self.error_ns < UNSTEADY_NS.min(UNSTEADY_SHARE * self.period_ns);
        (self.known == FEW && is_steady).then_some(SampleRhythm {
            captured_at: meant_at,
            takes_ns: self.takes_ns as i64,
            period_ns: self.period_ns as i64,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::rng::Draws;

    /// Feeds `n` samples of a period, of which each stamp errs by up to `error` and a share `lost` never comes; each
    /// takes 2 ms and up to 0.2 ms more.
    fn fed(n: u64, period_ns: i64, error: f64, lost: f64) -> SamplePhase {
        let (mut phase, draws) = (SamplePhase::new(), Draws::new(7));
        for k in (0..n).filter(|k| draws.unit(3 * k) >= lost) {
            let exposed_at = HostTime(77_000_000 + k as i64 * period_ns);
            let captured_at = exposed_at.plus_ns(((draws.unit(3 * k + 1) - 0.5) * 2.0 * error) as i64);
            let takes = 2_000_000 + (draws.unit(3 * k + 2) * 200_000.0) as i64;
            phase.observe(captured_at, exposed_at.plus_ns(takes));
        }
        phase
    }

    #[test]
    fn period_and_readiness_are_found_through_losses_and_unsteady_stamps() {
        for (period, error, lost) in
            [(2_000_000, 0.0, 0.0), (1_999_963, 20_000.0, 0.2), (4_166_667, 50_000.0, 0.05)]
        {
            let n = 6_000;
            let rhythm = fed(n, period, error, lost).rhythm().expect("steady");
            assert!((rhythm.period_ns - period).abs() < 60, "{} of {period}", rhythm.period_ns);
            let since = rhythm.captured_at.0 - 77_000_000;
            let off = since - ((since as f64 / period as f64).round() as i64) * period;
            assert!((off as f64).abs() < 10_000.0 + error, "{off}");
            let late = rhythm.takes_ns - 2_160_000;
            assert!((late as f64).abs() < 20_000.0 + error, "{}", rhythm.takes_ns);
        }
    }

    #[test]
    fn stamps_that_tell_no_phase_give_none() {
        assert_eq!(fed(10, 2_000_000, 0.0, 0.0).rhythm(), None);
        assert_eq!(fed(4_000, 2_000_000, 600_000.0, 0.0).rhythm(), None);
    }

    /// A stall of a thread moves what samples take by no more than one step.
    #[test]
    fn a_stall_changes_nothing() {
        let mut phase = fed(3_000, 2_000_000, 0.0, 0.0);
        let before = phase.rhythm().expect("steady");
        let captured_at = HostTime(77_000_000 + 3_000 * 2_000_000);
        phase.observe(captured_at, captured_at.plus_ns(100_000_000));
        let after = phase.rhythm().expect("steady");
        let moved = after.ready_at().ns_since(before.ready_at()) - 2_000_000;
        assert!(moved.abs() < 6_000, "{moved} ns");
        assert!((after.period_ns - 2_000_000).abs() < 10);
    }
}
