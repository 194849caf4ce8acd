//! How often a GPU may be lost before it is given up for good.

use dpm_device::time::HostTime;

/// Counts the losses of a GPU. After a few losses within some time a device is opened again. One more loss ends the run.
///
/// The caller gives the time. After a pause of `within_ns` without losses all of them are allowed again.
#[derive(Clone, Debug)]
pub struct LossBudget {
    /// When the last losses happened, oldest first: at most `most` of them.
    recent: Vec<HostTime>,
    most: usize,
    within_ns: i64,
    total: u64,
}

/// What to do about a loss.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AfterLoss {
    /// Open a device again.
    OpenAnew,
    /// The GPU was lost too often: stay dark, and end with a clear message.
    GiveUp,
}

impl LossBudget {
    /// Allows three losses a minute. A GPU that is lost more often is of no use.
    pub const MOST: usize = 3;
    /// A minute, nanoseconds.
    pub const WITHIN_NS: i64 = 60_000_000_000;

    /// Allows `most` losses within any `within_ns` nanoseconds.
    pub fn new(most: usize, within_ns: i64) -> Self {
        Self { recent: Vec::with_capacity(most), most, within_ns, total: 0 }
    }

    /// What to do about a loss at `now`. Allocates nothing.
    pub fn lost(&mut self, now: HostTime) -> AfterLoss {
        self.total = self.total.saturating_add(1);
        // If the clock ran backwards, no time has passed.
        self.recent.retain(|&at| now.ns_since(at) < self.within_ns);
        if self.recent.len() >= self.most {
            return AfterLoss::GiveUp;
        }
        self.recent.push(now);
        AfterLoss::OpenAnew
    }

    /// Losses so far, those of long ago included.
    #[cfg(test)]
    pub(crate) fn total(&self) -> u64 {
        self.total
    }
}

impl Default for LossBudget {
    fn default() -> Self {
        Self::new(Self::MOST, Self::WITHIN_NS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn three_losses_a_minute_are_survived_and_the_fourth_is_not() {
        let s = |s: i64| HostTime(s * 1_000_000_000);
        let mut budget = LossBudget::default();
        for at in [0, 10, 59] {
            assert_eq!(budget.lost(s(at)), AfterLoss::OpenAnew, "{at} s");
        }
        let mut late = budget.clone();
        assert_eq!(budget.lost(HostTime(s(60).0 - 1)), AfterLoss::GiveUp);
        // A minute after the first one there is room for another, but not for two.
        assert_eq!(late.lost(s(60)), AfterLoss::OpenAnew);
        assert_eq!(late.lost(s(61)), AfterLoss::GiveUp);
        assert_eq!((budget.total(), late.total()), (4, 5));
        assert_eq!(LossBudget::new(0, 1).lost(s(0)), AfterLoss::GiveUp);
    }

    proptest! {
        /// Whenever it lets a loss pass, no window of its length holds more than it allows; and it refuses none that would fit.
        #[test]
        fn no_window_ever_holds_more_than_allowed(
            most in 0usize..5,
            within in 1i64..50,
            steps in proptest::collection::vec(0i64..20, 0..60),
        ) {
            let mut budget = LossBudget::new(most, within);
            let (mut now, mut passed) = (0i64, Vec::<i64>::new());
            for step in steps {
                now += step;
                let before = passed.iter().filter(|&&at| now - at < within).count();
                let verdict = budget.lost(HostTime(now));
                prop_assert_eq!(verdict == AfterLoss::OpenAnew, before < most);
                if verdict == AfterLoss::OpenAnew {
                    passed.push(now);
                }
            }
        }
    }
}
