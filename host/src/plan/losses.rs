//! How often stages may be made anew before a rig gives up.

use dpm_device::time::HostTime;

/// Time in which losses count, nanoseconds.
const WINDOW_NS: i64 = 60_000_000_000;
/// Losses within that time that are borne.
const BORNE: usize = 3;

/// Counts losses within the last minute.
#[derive(Clone, Debug, Default)]
pub struct LossBudget {
    lost_at: [Option<HostTime>; BORNE + 1],
    next: usize,
}

impl LossBudget {
    /// Notes a loss at `now`. False when it is one too many: more than three within a minute.
    pub fn lose(&mut self, now: HostTime) -> bool {
        self.lost_at[self.next] = Some(now);
        self.next = (self.next + 1) % self.lost_at.len();
        self.count(now) <= BORNE
    }

    /// Losses within the minute before `now`, at most one more than are borne.
    pub fn count(&self, now: HostTime) -> usize {
        self.lost_at.iter().flatten().filter(|at| now.ns_since(**at) < WINDOW_NS).count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: i64 = 1_000_000_000;

    #[test]
    fn three_losses_a_minute_are_borne() {
        let mut budget = LossBudget::default();
        let at = |s: i64| HostTime(s * SECOND);
        assert!([0, 1, 2].into_iter().all(|s| budget.lose(at(s))));
        assert!(!budget.lose(at(59)), "a fourth");
        // The first three are forgotten by now.
        assert!(budget.lose(at(62)) && budget.lose(at(63)));
        let mut rare = LossBudget::default();
        assert!((0..1000).all(|s| rare.lose(at(30 * s))));
    }
}
