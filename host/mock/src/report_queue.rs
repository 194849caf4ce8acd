//! Orders reports by arrival: the common part of all tracker servers.

use crate::tracker::SampleSource;
use dpm_device::time::HostTime;

/// Reports in flight: captured, but not yet at their consumer.
pub struct ReportQueue {
    next: u64,
    under_way: Vec<(HostTime, u64)>,
    due: Vec<u64>,
}

impl ReportQueue {
    /// Maximum number of captures that one call catches up with; older ones are never sent.
    const MAX_CATCH_UP: u64 = 256;
    /// Maximum number of reports in flight; further ones are lost, as in a real queue.
    const MAX_UNDER_WAY: usize = 4096;

    /// Nothing captured yet.
    pub fn new() -> Self {
        Self { next: 0, under_way: Vec::with_capacity(64), due: Vec::with_capacity(64) }
    }

    /// Latest time for the next call.
    pub fn next_due(&self, source: &SampleSource) -> HostTime {
        let capture = source.config().start.plus_ns(source.captured_ns(self.next));
        self.under_way.iter().map(|(due, _)| *due).min().map_or(capture, |due| due.min(capture))
    }

    /// Number of the newest capture, if there is one.
    pub fn newest(&self) -> Option<u64> {
        self.next.checked_sub(1)
    }

    /// Numbers of the reports that arrive by `now` and were not returned before, in order of arrival. Each report
    /// carries all bodies, so its passage is that of stream 0.
    pub fn take_due(&mut self, source: &SampleSource, now: HostTime) -> &[u64] {
        self.due.clear();
        let since = now.ns_since(source.config().start).saturating_sub(source.config().phase_ns);
        if since < 0 {
            return &self.due;
        }
        let newest = source.config().rate.slot_at_ns(since);
        self.next = self.next.max((newest + 1).saturating_sub(Self::MAX_CATCH_UP));
        while self.next <= newest {
            if let Some(passage) = source.passage(0, self.next) {
                for arrival in std::iter::once(passage.arrives_at).chain(passage.copy_at) {
                    if self.under_way.len() < Self::MAX_UNDER_WAY {
                        self.under_way.push((arrival, self.next));
                    }
                }
            }
            self.next += 1;
        }
        self.under_way.sort_unstable();
        let n = self.under_way.partition_point(|(arrival, _)| *arrival <= now);
        self.due.extend(self.under_way.drain(..n).map(|(_, k)| k));
        &self.due
    }
}

impl Default for ReportQueue {
    fn default() -> Self {
        Self::new()
    }
}
