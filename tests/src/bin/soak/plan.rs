//! What happens when: a function of the seed and the length alone.

use std::time::Duration;

/// What a soak does to the rig.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Deed {
    /// `dpm black`, later `dpm arm`.
    Black,
    /// `dpm freeze`, later `dpm arm`.
    Freeze,
    /// The projector's cable is pulled, later plugged in again.
    Unplug,
    /// The tracker is killed, later started again.
    KillTracker,
    /// `dpm` is asked to end, and started again.
    Restart,
    /// `dpm` is killed, and started again.
    Kill,
}

impl Deed {
    pub(crate) const ALL: [Self; 6] =
        [Self::Black, Self::Freeze, Self::Unplug, Self::KillTracker, Self::Restart, Self::Kill];

    /// As printed.
    pub(crate) fn word(self) -> &'static str {
        match self {
            Self::Black => "black, then arm",
            Self::Freeze => "freeze, then arm",
            Self::Unplug => "the projector is unplugged and plugged in again",
            Self::KillTracker => "the tracker is killed and started again",
            Self::Restart => "dpm is asked to end, and started again",
            Self::Kill => "dpm is killed, and started again",
        }
    }
}

/// A deed and when it is due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Planned {
    pub(crate) after: Duration,
    pub(crate) deed: Deed,
}

/// Time between two deeds of a long soak; half to one and a half times of it, evenly distributed.
const EVERY: Duration = Duration::from_secs(60);
/// Quiet time at the end.
const QUIET: Duration = Duration::from_secs(5);

/// The deeds, one after the other.
pub(crate) struct Plan {
    state: u64,
    length: Duration,
    every: Duration,
    at: Duration,
    round: Vec<Deed>,
}

impl Plan {
    /// A plan for a soak of `length`. A short one has shorter pauses, so that every deed happens if it can.
    pub(crate) fn new(seed: u64, length: Duration) -> Self {
        let every = EVERY.min(length / 10).max(Duration::from_secs(2));
        Self { state: seed, length, every, at: Duration::ZERO, round: Vec::new() }
    }

    /// A number of the seeded sequence (splitmix64).
    fn random(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// The next deed, `now` after the beginning; `None` if the rest of the time is quiet. In each round every deed comes
    /// once, in an order of its own. A deed that took long delays the next one.
    pub(crate) fn next(&mut self, now: Duration) -> Option<Planned> {
        if self.round.is_empty() {
            self.round = Deed::ALL.to_vec();
            for i in (1..self.round.len()).rev() {
                let j = (self.random() % (i as u64 + 1)) as usize;
                self.round.swap(i, j);
            }
        }
        let pause = self.every.mul_f64(0.5 + (self.random() % 1000) as f64 / 1000.0);
        self.at = self.at.max(now) + pause;
        (self.at + QUIET < self.length)
            .then(|| Planned { after: self.at, deed: self.round.pop().expect("filled") })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(seed: u64, seconds: u64) -> Vec<Planned> {
        let mut plan = Plan::new(seed, Duration::from_secs(seconds));
        std::iter::from_fn(|| plan.next(Duration::ZERO)).collect()
    }

    #[test]
    fn a_plan_is_a_function_of_its_seed_and_every_deed_comes() {
        let plan = all(7, 7200);
        assert_eq!(plan, all(7, 7200));
        assert_ne!(plan, all(8, 7200));
        for round in plan.chunks_exact(Deed::ALL.len()) {
            assert!(Deed::ALL.iter().all(|deed| round.iter().any(|p| p.deed == *deed)), "{round:?}");
        }
        assert!((100..140).contains(&plan.len()), "{}", plan.len());
        assert!(plan.windows(2).all(|w| w[0].after + EVERY / 3 < w[1].after));
    }

    #[test]
    fn a_short_soak_is_not_idle_and_ends_quietly() {
        let plan = all(1, 72);
        assert!(plan.len() >= Deed::ALL.len(), "{plan:?}");
        assert!(plan.iter().all(|p| p.after + QUIET < Duration::from_secs(72)));
    }
}
