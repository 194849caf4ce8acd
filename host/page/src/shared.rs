//! The run that a page shows, and how many may follow it.

use crate::connections::VIEWERS;
use crate::pictures::PictureThread;
use dpm_rig::control::orders::Orders;
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_rig::telemetry::notes::Notes;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Instant;

/// A run as every request about it may use it.
pub(crate) struct RunView {
    pub(crate) monitor: Arc<RunMonitor>,
    pub(crate) orders: Arc<Orders>,
    pub(crate) notes: Arc<Notes>,
    pub(crate) pictures: PictureThread,
    pub(crate) began: Instant,
    /// The shapes of [`crate::room`], once somebody has asked for them.
    pub(crate) room: OnceLock<serde_json::Value>,
    viewers: AtomicUsize,
}

impl RunView {
    pub(crate) fn new(
        monitor: Arc<RunMonitor>,
        orders: Arc<Orders>,
        notes: Arc<Notes>,
        pictures: PictureThread,
    ) -> Self {
        Self {
            monitor,
            orders,
            notes,
            pictures,
            began: Instant::now(),
            room: OnceLock::new(),
            viewers: AtomicUsize::new(0),
        }
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
pub(crate) struct Viewer(pub(crate) Arc<RunView>);

impl Drop for Viewer {
    fn drop(&mut self) {
        self.0.viewers.fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_rig::projectors::backend;
    use dpm_rig::standing::{Identity, OrderFile};

    #[test]
    fn there_are_so_many_viewers_and_no_more() {
        let monitor = Arc::new(RunMonitor::default());
        let identity = Identity::of(&backend("mock").unwrap());
        let (file, _, _) = OrderFile::open(None, identity);
        let orders = Arc::new(Orders::start(monitor.clone(), file, false, None).unwrap());
        let pictures = PictureThread::start(monitor.clone()).unwrap();
        let shared = Arc::new(RunView::new(monitor, orders, Arc::default(), pictures));
        let all: Vec<_> = (0..VIEWERS).map(|_| shared.viewer().unwrap()).collect();
        assert!(shared.viewer().is_none() && shared.viewers() == VIEWERS);
        drop(all);
        assert_eq!(shared.viewers(), 0);
        assert!(shared.viewer().is_some());
    }
}
