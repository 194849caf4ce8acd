//! Counters that a running pipeline keeps and a watching thread reads, and the flag that asks it to stop.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// Shared between a run and whoever watches it. All accesses are relaxed: the numbers are for display, and the stop flag
/// guards no data.
#[derive(Debug, Default)]
pub struct RunMonitor {
    stop: AtomicBool,
    frames_planned: AtomicU64,
    frames_lit: AtomicU64,
    frames_dropped: AtomicU64,
    frames_late: AtomicU64,
}

/// What the counters said at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct RunCounts {
    /// Frames planned so far.
    pub frames_planned: u64,
    /// Frames lit so far.
    pub frames_lit: u64,
    /// Frames dropped so far.
    pub frames_dropped: u64,
    /// Frames lit late so far.
    pub frames_late: u64,
}

impl RunMonitor {
    /// Asks the run for an ordered stop: dark, flush, report.
    pub fn request_stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// True when an ordered stop was asked for. The frame path polls this once a frame.
    pub fn stop_requested(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Counts a planned frame.
    pub fn count_planned(&self) {
        self.frames_planned.fetch_add(1, Ordering::Relaxed);
    }

    /// Counts a frame whose light left the projector, and whether that was after its slot.
    pub fn count_lit(&self, late: bool) {
        self.frames_lit.fetch_add(1, Ordering::Relaxed);
        if late {
            self.frames_late.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Counts a frame that will never be lit.
    pub fn count_dropped(&self) {
        self.frames_dropped.fetch_add(1, Ordering::Relaxed);
    }

    /// The counters now; each is exact, together they are a moment apart.
    pub fn counts(&self) -> RunCounts {
        RunCounts {
            frames_planned: self.frames_planned.load(Ordering::Relaxed),
            frames_lit: self.frames_lit.load(Ordering::Relaxed),
            frames_dropped: self.frames_dropped.load(Ordering::Relaxed),
            frames_late: self.frames_late.load(Ordering::Relaxed),
        }
    }
}
