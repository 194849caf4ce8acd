//! What a server serves: a run, the steps of a calibration, or what several rigs say; and who may ask how often.

use crate::calibration::Guide;
use crate::guard::Guard;
use crate::rigs::Rigs;
use crate::shared::RunView;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Requests in a second beyond which answers are delayed, and how many may come at once. Orders are not counted.
const REQUESTS_PER_S: f64 = 200.0;
const BURST: f64 = 100.0;

/// Who may ask, and how often.
pub(crate) struct Door {
    pub(crate) guard: Guard,
    /// Requests that may come without delay, and when that was counted.
    bucket: Mutex<(f64, Instant)>,
}

impl Door {
    pub(crate) fn new(guard: Guard) -> Self {
        Self { guard, bucket: Mutex::new((BURST, Instant::now())) }
    }

    /// How long an answer waits, so that no number of requests takes more than a small part of a core.
    pub(crate) fn pace(&self) -> Duration {
        let mut bucket = self.bucket.lock().unwrap_or_else(PoisonError::into_inner);
        let (left, at) = &mut *bucket;
        let now = Instant::now();
        // The debt is bounded, so a flood delays those who come after it by half a second at most.
        *left = (*left + now.duration_since(*at).as_secs_f64() * REQUESTS_PER_S - 1.0).clamp(-BURST, BURST);
        *at = now;
        Duration::from_secs_f64((-*left).max(0.0) / REQUESTS_PER_S)
    }
}

/// A server: who may ask it, and what it serves.
pub(crate) struct Site {
    pub(crate) door: Door,
    pub(crate) serves: Serves,
}

/// What a server serves.
pub(crate) enum Serves {
    /// A run, and the steps of its rig's calibration.
    Run(Arc<RunView>, Arc<dyn Guide>),
    /// The steps of the calibration of a rig that does not run.
    Calibration(Arc<dyn Guide>),
    /// What several rigs say of themselves.
    Rigs(Rigs),
}

impl Serves {
    /// The run, where one is served.
    pub(crate) fn run(&self) -> Option<&Arc<RunView>> {
        match self {
            Self::Run(run, _) => Some(run),
            Self::Calibration(_) | Self::Rigs(_) => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_slow_down_beyond_the_rate_and_their_debt_is_bounded() {
        let door = Door::new(Guard::new("127.0.0.1:1".parse().unwrap(), &[], None));
        assert_eq!(door.pace(), Duration::ZERO, "one request waits for nothing");
        let longest = (0..10_000).map(|_| door.pace()).max().unwrap();
        let bound = Duration::from_secs_f64(BURST / REQUESTS_PER_S);
        assert!(longest <= bound && longest > bound / 2, "{longest:?}");
    }
}
