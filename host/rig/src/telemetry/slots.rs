//! Classifies every slot of a run from what the projector showed in it and what happened to its frame.
//!
//! Every slot from the first planned frame to the last belongs to exactly one class: it showed a frame of its own; it
//! was missed, for one cause; or no new picture was wanted in it, for one reason. Slots that the projector did not
//! report are missed.
//!
//! A slot is decided as soon as its light, its frame and the machine's standstills are known, and is then only
//! counted. The window of undecided slots has a fixed length, so a run may last for months.

use super::ordered::{DarkLog, DarkSpans};
use crate::frame::slots::{MissCause, OrderedDark};
use crate::frame::FrameTimeline;
use dpm_common::realtime::standstill::SeenStandstills;
use dpm_device::time::{FrameRate, HostTime};
use std::collections::VecDeque;
use std::sync::Arc;

/// Maximum number of undecided slots. When another one comes, the oldest is decided with what is known.
const WINDOW: usize = 8192;
/// If a stall skipped at most this many slots, they are judged one by one; more are judged together.
const ONE_BY_ONE: u64 = 1 << 20;
/// Maximum number of batches; when there are more, twice as many slots go into each.
const MAX_BATCHES: usize = 64;
/// Initial number of slots per batch.
const BATCH_SLOTS: u64 = 128;

/// What is known about a slot.
#[derive(Clone, Copy, Debug, Default)]
struct SlotEntry {
    light: SlotOutcome,
    /// Why its frame may have missed the slot, and when that frame was latched.
    trouble: Option<(MissCause, HostTime)>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum SlotOutcome {
    /// Nothing was reported yet.
    #[default]
    Untold,
    /// The frame that was planned for it.
    Own,
    /// Dark, the previous frame, or a frame that was planned for an earlier slot.
    NothingNew,
}

/// Number of slots by class.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SlotCounts {
    /// Slots that showed a frame of their own.
    pub own: u64,
    /// Slots that should have shown a frame of their own but did not, by cause.
    pub missed: [u64; MissCause::ALL.len()],
    /// Slots in which no new picture was wanted, by reason. They are in neither of the other classes.
    pub ordered: [u64; OrderedDark::ALL.len()],
}

impl SlotCounts {
    /// Slots in which a frame of their own was wanted.
    pub(crate) fn wanted(&self) -> u64 {
        self.own + self.missed_total()
    }

    /// Missed slots of all causes.
    pub(crate) fn missed_total(&self) -> u64 {
        self.missed.iter().sum()
    }

    /// Missed slots as a share of those in which a frame was wanted, 0 to 1; 0 if there were none.
    pub(crate) fn missed_share(&self) -> f64 {
        self.missed_total() as f64 / self.wanted().max(1) as f64
    }

    /// Missed slots whose frame was in flight while the machine itself stood still.
    pub(crate) fn excused(&self) -> u64 {
        self.missed[MissCause::Standstill as usize]
    }

    /// Slots of all reasons in which no new picture was wanted.
    #[cfg(test)]
    pub(crate) fn ordered_total(&self) -> u64 {
        self.ordered.iter().sum()
    }
}

/// How a slot is counted.
#[derive(Clone, Copy)]
enum Judgement {
    Own,
    Missed(MissCause),
    Ordered(OrderedDark),
}

impl Judgement {
    /// Of a slot in which no new picture could be shown for this reason.
    fn of(reason: OrderedDark) -> Self {
        match reason {
            OrderedDark::Exceeded => Self::Missed(MissCause::Fault),
            reason => Self::Ordered(reason),
        }
    }
}

impl SlotCounts {
    fn add(&mut self, judgement: Judgement, slots: u64) {
        *match judgement {
            Judgement::Own => &mut self.own,
            Judgement::Missed(cause) => &mut self.missed[cause as usize],
            Judgement::Ordered(reason) => &mut self.ordered[reason as usize],
        } += slots;
    }
}

/// Consecutive slots in which a frame was wanted, and how many of them were missed, to show the spread of the share.
#[derive(Clone, Debug)]
struct Batches {
    all: Vec<(u64, u64)>,
    length: u64,
    now: (u64, u64),
}

impl Batches {
    fn count(&mut self, slots: u64, missed: bool) {
        self.now.0 += slots;
        self.now.1 += if missed { slots } else { 0 };
        if self.now.0 < self.length {
            return;
        }
        self.all.push(std::mem::take(&mut self.now));
        if self.all.len() == MAX_BATCHES {
            for i in 0..MAX_BATCHES / 2 {
                let ((a, b), (c, d)) = (self.all[2 * i], self.all[2 * i + 1]);
                self.all[i] = (a + c, b + d);
            }
            self.all.truncate(MAX_BATCHES / 2);
            self.length *= 2;
        }
    }
}

/// Slots of a run.
#[derive(Clone, Debug)]
pub(crate) struct SlotLedger {
    rate: FrameRate,
    /// How long before its slot a frame begins, for slots that had none.
    lead_ns: i64,
    /// The machine's standstills; `None` if they are not monitored.
    seen: Option<Arc<SeenStandstills>>,
    spans: DarkSpans,
    first_planned: Option<u64>,
    last_planned: Option<u64>,
    newest_light: Option<u64>,
    /// A slot and its beginning, from which the beginnings of other slots follow.
    reference: (u64, HostTime),
    /// The first undecided slot.
    base: u64,
    window: VecDeque<SlotEntry>,
    counts: SlotCounts,
    batches: Batches,
    /// The misses that were found since they were last read; `None` if nobody reads them.
    found: Option<VecDeque<Miss>>,
}

/// A missed slot, its beginning and the cause.
pub(crate) type Miss = (u64, HostTime, MissCause);

/// Misses that may wait to be read; the collector reads them every few milliseconds.
const FOUND: usize = 1024;

impl SlotLedger {
    /// For slots of `rate`. A frame begins about `lead_ns` before its slot.
    pub(crate) fn new(rate: FrameRate, lead_ns: i64) -> Self {
        Self {
            rate,
            lead_ns,
            seen: None,
            spans: DarkSpans::new(rate.slot_len_ns(0)),
            first_planned: None,
            last_planned: None,
            newest_light: None,
            reference: (0, HostTime(0)),
            base: 0,
            window: VecDeque::with_capacity(WINDOW),
            counts: SlotCounts::default(),
            batches: Batches { all: Vec::with_capacity(MAX_BATCHES), length: BATCH_SLOTS, now: (0, 0) },
            found: None,
        }
    }

    /// Compares missed slots with these standstills. Call it before the first slot.
    pub(crate) fn excuse_by(&mut self, seen: Arc<SeenStandstills>) {
        self.seen = Some(seen);
    }

    /// Keeps every missed slot until [`SlotLedger::next_miss`] takes it.
    pub(crate) fn keep_misses(&mut self) {
        self.found = Some(VecDeque::with_capacity(FOUND));
    }

    /// The oldest miss that was found and not taken yet.
    pub(crate) fn next_miss(&mut self) -> Option<Miss> {
        self.found.as_mut()?.pop_front()
    }

    fn find(&mut self, slot: u64, judgement: Judgement) {
        let begin = self.begin_of(slot);
        if let (Some(found), Judgement::Missed(cause)) = (&mut self.found, judgement) {
            if found.len() < FOUND {
                found.push_back((slot, begin, cause));
            }
        }
    }

    /// Reads the orders.
    pub(crate) fn read_orders(&mut self, log: &DarkLog) {
        self.spans.read(log);
    }

    /// Why no new picture was wanted in the slot that begins at `begin`; `None` if one was wanted.
    pub(crate) fn ordered_dark(&self, begin: HostTime) -> Option<OrderedDark> {
        self.spans.reason_at(begin)
    }

    /// A frame for `slot` reached the end of the host's part of its path. `refused`: the link did not accept it.
    /// `held_up_by`: what kept planning from beginning earlier.
    pub(crate) fn planned(
        &mut self,
        slot: u64,
        timeline: &FrameTimeline,
        refused: bool,
        held_up_by: Option<MissCause>,
    ) {
        self.reference = (slot, timeline.due_at);
        if self.first_planned.is_none() {
            self.first_planned = Some(slot);
            self.begin_at(slot);
        }
        let skipped = self.last_planned.map_or(slot, |last| last.saturating_add(1));
        let cause = held_up_by.unwrap_or(MissCause::Plan);
        self.last_planned = Some(self.last_planned.map_or(slot, |last| last.max(slot)));
        let between = Some((cause, timeline.latched_at));
        for known in skipped.max(self.base)..slot.min(self.end()) {
            self.window[(known - self.base) as usize].trouble = between;
        }
        self.extend(slot, between);
        let own = if refused {
            Some((MissCause::Link, timeline.latched_at))
        } else {
            (timeline.sent_at > timeline.due_at).then(|| (slowest(timeline), timeline.latched_at))
        };
        if let Some(entry) = self.entry(slot) {
            entry.trouble = own;
        }
    }

    /// The frame that was planned for `slot`, which begins at `begin`, was lit in it. The last `unseen` unreported
    /// slots before it showed frames of which only the number is known; each counts as having shown its own frame.
    pub(crate) fn own(&mut self, slot: u64, begin: HostTime, unseen: u32) {
        self.told(slot, begin, SlotOutcome::Own, unseen);
        self.spans.lit(begin);
    }

    /// The projector showed nothing new in `slot`, which began at `begin`, or a frame that was meant for an earlier
    /// slot. `unseen` as in [`SlotLedger::own`].
    pub(crate) fn nothing_new(&mut self, slot: u64, begin: HostTime, unseen: u32) {
        self.told(slot, begin, SlotOutcome::NothingNew, unseen);
    }

    /// Decides what can be decided. Call it regularly.
    pub(crate) fn settle(&mut self) {
        let through = self.seen.as_ref().map_or(HostTime(i64::MAX), |seen| seen.through());
        while let (Some(front), Some(last)) = (self.window.front(), self.last_planned) {
            let slot = self.base;
            let known = match front.light {
                SlotOutcome::Own => true,
                SlotOutcome::NothingNew => self.begin_of(slot) <= through,
                // Light is reported in order, so a slot that was passed over will not be reported any more.
                SlotOutcome::Untold => {
                    self.newest_light.is_some_and(|newest| newest > slot) && self.begin_of(slot) <= through
                }
            };
            if slot > last || !known {
                break;
            }
            self.decide_front();
        }
    }

    /// Counts of all slots that are decided so far.
    pub(crate) fn counts(&self) -> SlotCounts {
        self.counts
    }

    /// The run is over: decides every slot up to the last planned one.
    pub(crate) fn finish(&mut self) -> SlotCounts {
        while self.last_planned.is_some_and(|last| self.base <= last) && !self.window.is_empty() {
            self.decide_front();
        }
        self.counts
    }

    /// For equal batches of consecutive slots: slots in which a frame was wanted, and those of them that were missed.
    pub(crate) fn batches(&self) -> &[(u64, u64)] {
        &self.batches.all
    }

    /// One past the newest slot of the window.
    fn end(&self) -> u64 {
        self.base.saturating_add(self.window.len() as u64)
    }

    /// Starts the window at `slot`, where the run begins.
    fn begin_at(&mut self, slot: u64) {
        if self.window.is_empty() || self.end() <= slot || self.base > slot.saturating_add(WINDOW as u64) {
            self.window.clear();
        } else {
            for _ in slot..self.base {
                self.window.push_front(SlotEntry::default());
            }
            for _ in self.base..slot {
                self.window.pop_front();
            }
        }
        self.base = slot;
    }

    /// When a slot begins, computed from the newest slot whose beginning is known.
    fn begin_of(&self, slot: u64) -> HostTime {
        let (known, begin) = self.reference;
        let ns = self.rate.slot_start_ns(slot).saturating_sub(self.rate.slot_start_ns(known));
        begin.plus_ns(ns)
    }

    fn entry(&mut self, slot: u64) -> Option<&mut SlotEntry> {
        let at = usize::try_from(slot.checked_sub(self.base)?).ok()?;
        self.window.get_mut(at)
    }

    /// Makes room for slots up to `slot`; new ones get `trouble`.
    fn extend(&mut self, slot: u64, trouble: Option<(MissCause, HostTime)>) {
        while slot.saturating_sub(self.base) >= WINDOW as u64 && !self.window.is_empty() {
            self.decide_front();
        }
        let keep_from = slot.saturating_sub(WINDOW as u64 - 1);
        if self.base < keep_from {
            let skipped = keep_from - self.base;
            if skipped > ONE_BY_ONE {
                let judgement = self.judged_together(keep_from, trouble);
                self.find(self.base, judgement);
                self.count(judgement, skipped);
                self.base = keep_from;
            }
            while self.base < keep_from {
                self.window.push_back(SlotEntry { light: SlotOutcome::Untold, trouble });
                self.decide_front();
            }
        }
        while self.end() <= slot {
            self.window.push_back(SlotEntry { light: SlotOutcome::Untold, trouble });
        }
    }

    fn told(&mut self, slot: u64, begin: HostTime, light: SlotOutcome, unseen: u32) {
        // Light far beyond the last planned slot does not belong to the run, unless planning continues, which then
        // covers it. A projector also must not decide how much memory or time is spent here.
        let newest = self.last_planned.unwrap_or(slot).saturating_add(WINDOW as u64);
        if slot > newest || slot < self.base {
            return;
        }
        if self.first_planned.is_none() {
            // Before the first frame nothing counts yet, but its note may come after its light.
            if self.window.is_empty() || slot >= self.end().saturating_add(WINDOW as u64) {
                self.window.clear();
                self.base = slot;
            }
        }
        self.reference = (slot, begin);
        self.newest_light = Some(self.newest_light.map_or(slot, |newest| newest.max(slot)));
        self.extend(slot, None);
        let at = slot.saturating_sub(self.base) as usize;
        if let Some(entry) = self.window.get_mut(at) {
            entry.light = light;
        }
        let before = self.window.iter_mut().take(at).rev();
        for entry in before.filter(|e| e.light == SlotOutcome::Untold).take(unseen as usize) {
            entry.light = SlotOutcome::Own;
        }
    }

    fn decide_front(&mut self) {
        let Some(entry) = self.window.pop_front() else { return };
        let slot = self.base;
        self.base += 1;
        if self.first_planned.is_none() {
            return;
        }
        let judgement = self.judged(slot, entry);
        self.find(slot, judgement);
        self.count(judgement, 1);
    }

    fn judged(&self, slot: u64, entry: SlotEntry) -> Judgement {
        if entry.light == SlotOutcome::Own {
            return Judgement::Own;
        }
        let begin = self.begin_of(slot);
        if let Some(reason) = self.spans.reason_at(begin) {
            return Judgement::of(reason);
        }
        // If a frame was sent in time and not lit, the link is the cause; the same holds for a slot about which
        // nothing is known.
        let (cause, since) = entry.trouble.unwrap_or((MissCause::Link, begin));
        let under_way = since.min(begin.plus_ns(-self.lead_ns));
        let stood_still = self.seen.as_ref().is_some_and(|seen| seen.with(|s| s.touches(under_way, begin)));
        Judgement::Missed(if stood_still { MissCause::Standstill } else { cause })
    }

    /// Judges the slots from the window's beginning to `end`, of which only is known that they were skipped.
    fn judged_together(&self, end: u64, trouble: Option<(MissCause, HostTime)>) -> Judgement {
        let (from, to) = (self.begin_of(self.base), self.begin_of(end));
        if let Some(reason) = self.spans.reason_throughout(from, to) {
            return Judgement::of(reason);
        }
        let stood_still = self.seen.as_ref().is_some_and(|seen| seen.with(|s| s.covers(from, to)));
        Judgement::Missed(if stood_still {
            MissCause::Standstill
        } else {
            trouble.map_or(MissCause::Link, |(cause, _)| cause)
        })
    }

    fn count(&mut self, judgement: Judgement, slots: u64) {
        self.counts.add(judgement, slots);
        if slots > 0 && !matches!(judgement, Judgement::Ordered(_)) {
            self.batches.count(slots, matches!(judgement, Judgement::Missed(_)));
        }
    }
}

/// The part of a late frame's path that took longest.
fn slowest(t: &FrameTimeline) -> MissCause {
    let parts = [
        (MissCause::Plan, t.submitted_at.ns_since(t.latched_at)),
        (MissCause::Render, t.rendered_at.ns_since(t.submitted_at)),
        (MissCause::Pack, t.packed_at.ns_since(t.rendered_at)),
        (MissCause::Link, t.sent_at.ns_since(t.packed_at)),
    ];
    parts.into_iter().max_by_key(|(_, ns)| *ns).map_or(MissCause::Link, |(cause, _)| cause)
}

#[cfg(test)]
#[path = "slots_tests.rs"]
mod tests;
