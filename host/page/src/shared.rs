//! What every request may use, and how many there may be.

use crate::connections::VIEWERS;
use crate::guard::Guard;
use crate::notes::Notes;
use crate::pictures::Pictures;
use dpm_rig::control::orders::Orders;
use dpm_rig::telemetry::monitor::RunMonitor;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Requests in a second beyond which answers are delayed, and how many may come at once. Orders are not counted.
const REQUESTS_PER_S: f64 = 200.0;
const BURST: f64 = 100.0;

/// What every request may use.
pub(crate) struct Shared {
    pub(crate) monitor: Arc<RunMonitor>,
    pub(crate) orders: Arc<Orders>,
    pub(crate) notes: Arc<Notes>,
    pub(crate) guard: Guard,
    pub(crate) pictures: Pictures,
    pub(crate) began: Instant,
    viewers: AtomicUsize,
    /// Requests that may come without delay, and when that was counted.
    bucket: Mutex<(f64, Instant)>,
}

impl Shared {
    pub(crate) fn new(
        monitor: Arc<RunMonitor>,
        orders: Arc<Orders>,
        notes: Arc<Notes>,
        guard: Guard,
        pictures: Pictures,
    ) -> Self {
        let began = Instant::now();
        let (viewers, bucket) = (AtomicUsize::new(0), Mutex::new((BURST, began)));
        Self { monitor, orders, notes, guard, pictures, began, viewers, bucket }
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

    /// A place among the viewers; `None` if all are taken.
    pub(crate) fn viewer(self: &Arc<Self>) -> Option<Viewer> {
        let more = |n: usize| (n < VIEWERS).then_some(n + 1);
        self.viewers.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more).ok()?;
        Some(Viewer(self.clone()))
    }

    /// Number of viewers.
    pub(crate) fn viewers(&self) -> usize {
        self.viewers.load(Ordering::Relaxed)
    }
}

/// One who follows the rig's events, until this is dropped.
pub(crate) struct Viewer(pub(crate) Arc<Shared>);

impl Drop for Viewer {
    fn drop(&mut self) {
        self.0.viewers.fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_rig::config::{MockProjectorConfig, ProjectorBackend};
    use dpm_rig::standing::{Identity, OrderFile};

    #[test]
    fn answers_slow_down_beyond_the_rate_and_their_debt_is_bounded() {
        let monitor = Arc::new(RunMonitor::default());
        let identity = Identity::of(&ProjectorBackend::Mock(MockProjectorConfig::default()));
        let (file, _, _) = OrderFile::open(None, identity);
        let orders = Arc::new(Orders::start(monitor.clone(), file, false, None).unwrap());
        let guard = Guard::new("127.0.0.1:1".parse().unwrap(), &[], None);
        let pictures = Pictures::start(monitor.clone()).unwrap();
        let shared = Arc::new(Shared::new(monitor, orders, Arc::default(), guard, pictures));
        assert_eq!(shared.pace(), Duration::ZERO, "one request waits for nothing");
        let longest = (0..10_000).map(|_| shared.pace()).max().unwrap();
        let bound = Duration::from_secs_f64(BURST / REQUESTS_PER_S);
        assert!(longest <= bound && longest > bound / 2, "{longest:?}");
        let all: Vec<_> = (0..VIEWERS).map(|_| shared.viewer().unwrap()).collect();
        assert!(shared.viewer().is_none() && shared.viewers() == VIEWERS);
        drop(all);
        assert_eq!(shared.viewers(), 0);
        assert!(shared.viewer().is_some());
    }
}
