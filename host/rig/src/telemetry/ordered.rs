//! Intervals in which no new picture was wanted. The link's thread, which knows the orders, writes them; the
//! collector, which judges slots, reads them.

use crate::frame::slots::OrderedDark;
use dpm_device::time::HostTime;
use std::collections::VecDeque;
use std::sync::atomic::{AtomicI64, AtomicU64, AtomicU8, Ordering};

/// Number of changes by which the reader may lag behind. It reads every few milliseconds, and the link's thread
/// writes at most one change per poll.
const CHANGES: usize = 256;
/// Number of intervals that are remembered. Slots are judged when their light is reported, so only the last ones are
/// ever needed.
const SPANS: usize = 256;
/// After an order is taken back, slots without light still belong to the order for this time, or for [`RETURN_SLOTS`]
/// slots if that is longer, unless a frame is lit earlier: the projector has to be armed, and frames that were in
/// flight were refused.
const RETURN_NS: i64 = 250_000_000;
/// See [`RETURN_NS`].
const RETURN_SLOTS: i64 = 4;

/// The log of changes. One thread writes it without waiting or allocating, and one other thread reads it.
#[derive(Debug)]
pub(crate) struct DarkLog {
    /// The instant of a change and its code; change `n` is at index `n % CHANGES`.
    changes: [(AtomicI64, AtomicU8); CHANGES],
    /// Changes written so far.
    written: AtomicU64,
}

impl Default for DarkLog {
    fn default() -> Self {
        Self { changes: std::array::from_fn(|_| Default::default()), written: AtomicU64::new(0) }
    }
}

/// 0: light is wanted.
fn code(wanted: Option<OrderedDark>) -> u8 {
    wanted.map_or(0, |reason| reason as u8 + 1)
}

impl DarkLog {
    /// States at `now` why no new picture is wanted, or `None` when one is wanted. Only a change is recorded. Call it
    /// from one thread at a time.
    pub(crate) fn tell(&self, now: HostTime, reason: Option<OrderedDark>) {
        // Relaxed: this thread is the only writer.
        let written = self.written.load(Ordering::Relaxed);
        let place = |n: u64| &self.changes[(n % CHANGES as u64) as usize];
        let before = if written == 0 { 0 } else { place(written - 1).1.load(Ordering::Relaxed) };
        if before == code(reason) {
            return;
        }
        let (at, told) = place(written);
        at.store(now.0, Ordering::Relaxed);
        told.store(code(reason), Ordering::Relaxed);
        // Release: a reader that sees the new count also sees the change.
        self.written.store(written + 1, Ordering::Release);
    }

    /// Passes the changes since `seen` to `take`, oldest first, and advances `seen`. Changes that were overwritten
    /// meanwhile are skipped.
    pub(crate) fn news(&self, seen: &mut u64, mut take: impl FnMut(HostTime, Option<OrderedDark>)) {
        // Acquire: see `tell`.
        let written = self.written.load(Ordering::Acquire);
        // One place is left to the writer, which may be writing the next change.
        for n in (*seen).max(written.saturating_sub(CHANGES as u64 - 1))..written {
            let (at, told) = &self.changes[(n % CHANGES as u64) as usize];
            let code = told.load(Ordering::Relaxed);
            let reason = usize::from(code).checked_sub(1).and_then(|i| OrderedDark::ALL.get(i)).copied();
            take(HostTime(at.load(Ordering::Relaxed)), reason);
        }
        *seen = written;
    }
}

#[derive(Clone, Copy, Debug)]
struct Span {
    from: HostTime,
    to: HostTime,
    reason: OrderedDark,
}

/// The intervals in which no new picture was wanted.
#[derive(Clone, Debug)]
pub(crate) struct DarkSpans {
    spans: VecDeque<Span>,
    /// Number of changes of the log that have been read.
    seen: u64,
    /// The last interval is still open.
    open: bool,
    /// When the last order was taken back, until light is back.
    returning_from: Option<HostTime>,
    slot_ns: i64,
}

impl DarkSpans {
    /// For slots of `slot_ns` > 0.
    pub(super) fn new(slot_ns: i64) -> Self {
        Self {
            spans: VecDeque::with_capacity(SPANS),
            seen: 0,
            open: false,
            returning_from: None,
            slot_ns: slot_ns.max(1),
        }
    }

    /// Reads the news of the log.
    pub(super) fn read(&mut self, log: &DarkLog) {
        let mut seen = self.seen;
        log.news(&mut seen, |at, reason| self.change(at, reason));
        self.seen = seen;
    }

    /// From `at` on no new picture is wanted for `reason`; `None`: from `at` on one is wanted again.
    pub(super) fn change(&mut self, at: HostTime, reason: Option<OrderedDark>) {
        if !self.open && reason.is_none() {
            return;
        }
        let back_by = at.plus_ns(RETURN_NS.max(self.slot_ns.saturating_mul(RETURN_SLOTS)));
        if let Some(last) = self.spans.back_mut().filter(|_| self.open) {
            if Some(last.reason) == reason {
                return;
            }
            last.to = if reason.is_some() { at } else { back_by };
        } else if let Some(last) = self.spans.back_mut() {
            // A new order came while light was still returning.
            last.to = last.to.min(at);
        }
        self.open = reason.is_some();
        self.returning_from = if reason.is_none() { Some(at) } else { None };
        if let Some(reason) = reason {
            if self.spans.len() >= SPANS {
                self.spans.pop_front();
            }
            self.spans.push_back(Span { from: at, to: HostTime(i64::MAX), reason });
        }
    }

    /// A frame was lit in the slot that begins at `begin`, so light is back.
    pub(super) fn lit(&mut self, begin: HostTime) {
        if let (Some(_), Some(last)) = (self.returning_from.filter(|s| begin >= *s), self.spans.back_mut()) {
            last.to = last.to.min(begin);
            self.returning_from = None;
        }
    }

    /// Why no new picture was wanted in the slot that begins at `begin`; `None` if one was wanted. Ask for slots in
    /// the order in which their light is reported.
    pub(crate) fn reason_at(&self, begin: HostTime) -> Option<OrderedDark> {
        let end = begin.plus_ns(self.slot_ns);
        self.spans.iter().rev().find(|s| s.from < end && begin < s.to).map(|s| s.reason)
    }

    /// The reason that applies to all of `from` to `to`, if there is a single one.
    pub(crate) fn reason_throughout(&self, from: HostTime, to: HostTime) -> Option<OrderedDark> {
        self.spans.iter().rev().find(|s| s.from <= from && to <= s.to).map(|s| s.reason)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use OrderedDark::{Black, Frozen, Safe};

    const SLOT: i64 = 1_000_000;

    fn ms(at: i64) -> HostTime {
        HostTime(at * 1_000_000)
    }

    #[test]
    fn the_log_keeps_changes_only_and_a_slow_reader_sees_the_newest() {
        let log = DarkLog::default();
        let mut seen = 0;
        let mut told = Vec::new();
        for (at, wanted) in
            [(1, None), (2, Some(Black)), (3, Some(Black)), (4, Some(Safe)), (5, None), (6, None)]
        {
            log.tell(ms(at), wanted);
        }
        log.news(&mut seen, |at, wanted| told.push((at, wanted)));
        assert_eq!(told, [(ms(2), Some(Black)), (ms(4), Some(Safe)), (ms(5), None)]);
        log.news(&mut seen, |_, _| panic!("nothing new"));
        for k in 0..10 * CHANGES as i64 {
            log.tell(ms(100 + k), if k % 2 == 0 { Some(Frozen) } else { None });
        }
        told.clear();
        log.news(&mut seen, |at, wanted| told.push((at, wanted)));
        assert_eq!(told.len(), CHANGES - 1);
        assert_eq!(told.last(), Some(&(ms(99 + 10 * CHANGES as i64), None)));
    }

    #[test]
    fn a_slot_belongs_to_the_order_that_it_touches_until_light_is_back() {
        let mut spans = DarkSpans::new(SLOT);
        assert_eq!(spans.reason_at(ms(0)), None);
        spans.change(ms(10).plus_ns(500_000), Some(Black));
        spans.lit(ms(8));
        assert_eq!((spans.reason_at(ms(9)), spans.reason_at(ms(10))), (None, Some(Black)));
        assert_eq!(spans.reason_at(ms(5_000)), Some(Black), "until it is taken back");
        spans.change(ms(20), Some(Safe));
        assert_eq!(spans.reason_at(ms(18)), Some(Black));
        assert_eq!(spans.reason_at(ms(20)), Some(Safe));
        // Taken back: darkness until the first frame belongs to the order, and later darkness does not.
        spans.change(ms(30), None);
        assert_eq!(spans.reason_at(ms(33)), Some(Safe));
        spans.lit(ms(29));
        spans.lit(ms(35));
        assert_eq!((spans.reason_at(ms(34)), spans.reason_at(ms(36))), (Some(Safe), None));
        assert_eq!(spans.reason_throughout(ms(21), ms(25)), Some(Safe));
        assert_eq!(spans.reason_throughout(ms(15), ms(25)), None);
    }

    #[test]
    fn light_that_does_not_come_back_is_soon_the_rigs_own_affair() {
        let mut spans = DarkSpans::new(SLOT);
        spans.change(ms(10), Some(Frozen));
        spans.change(ms(20), None);
        assert_eq!(spans.reason_at(ms(20 + RETURN_NS / 1_000_000 - 1)), Some(Frozen));
        assert_eq!(spans.reason_at(ms(20 + RETURN_NS / 1_000_000)), None);
        // At 10 frames per second, a quarter of a second is too short for four frames.
        let mut slow = DarkSpans::new(100 * SLOT);
        slow.change(ms(10), Some(Frozen));
        slow.change(ms(20), None);
        assert_eq!((slow.reason_at(ms(419)), slow.reason_at(ms(420))), (Some(Frozen), None));
    }

    #[test]
    fn memory_is_bounded_whatever_is_ordered() {
        let mut spans = DarkSpans::new(SLOT);
        for k in 0..100_000 {
            spans.change(ms(2 * k), Some(OrderedDark::ALL[k as usize % 6]));
        }
        assert_eq!((spans.spans.len(), spans.spans.capacity()), (SPANS, SPANS));
    }
}
