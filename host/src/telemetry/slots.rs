//! What a projector showed slot by slot, and what became of each frame, into slots without a frame of their own and their causes.
//!
//! A slot is missed when the projector, between the first and the last frame that was planned, repeats a frame or stays dark in it.
//! Nothing is decided while the run goes on: at the end every missed slot is held against the frame that was planned for it.

use crate::frame::{FrameTimeline, Stage};
use crate::plan::slots::MissCause;
use crate::realtime::standstill::Standstills;
use dpm_device::time::HostTime;
use std::collections::BTreeMap;

/// Missed slots, and frames in trouble, that are kept; beyond this the run is broken and the rest only counted.
const KEPT: usize = 1 << 16;

/// Slots of a run.
#[derive(Clone, Debug, Default)]
pub struct SlotLedger {
    /// Missed slots with their beginning.
    missed: Vec<(u64, HostTime)>,
    not_kept: u64,
    /// Why frames did not make it into their slot, by slot.
    troubled: BTreeMap<u64, (MissCause, HostTime)>,
    first_lit: Option<u64>,
    last_planned: Option<u64>,
}

/// What the ledger says at the end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SlotCounts {
    /// Slots from the first frame that was lit to the last that was planned.
    pub slots: u64,
    /// Of these, slots without a frame of their own, by cause.
    pub missed: [u64; MissCause::ALL.len()],
}

impl SlotLedger {
    /// A frame for `slot` came to the end of the host's part of its way. `refused`: the link did not take
    /// it. `waited_for_memory`: planning could not begin earlier because a later stage held all buffers.
    pub fn planned(&mut self, slot: u64, timeline: &FrameTimeline, refused: bool, waited_for_memory: bool) {
        let skipped = self.last_planned.map_or(slot, |last| last + 1)..slot;
        let cause = if waited_for_memory { MissCause::Buffers } else { MissCause::Plan };
        for between in skipped.take(KEPT) {
            self.note(between, cause, timeline.latched_at);
        }
        self.last_planned = Some(self.last_planned.map_or(slot, |last| last.max(slot)));
        if refused {
            self.note(slot, MissCause::Link, timeline.latched_at);
        } else if timeline.sent_at > timeline.due_at {
            self.note(slot, slowest(timeline), timeline.latched_at);
        }
    }

    fn note(&mut self, slot: u64, cause: MissCause, since: HostTime) {
        if self.troubled.len() < KEPT {
            self.troubled.insert(slot, (cause, since));
        }
    }

    /// A frame was lit in `slot` for the first time.
    pub fn lit(&mut self, slot: u64) {
        self.first_lit.get_or_insert(slot);
    }

    /// The projector had nothing new in `slot`, which began at `begin`, or a frame that was meant for an earlier slot.
    pub fn nothing_new(&mut self, slot: u64, begin: HostTime) {
        if self.first_lit.is_none() {
            return;
        }
        if self.missed.len() < KEPT {
            self.missed.push((slot, begin));
        } else {
            self.not_kept += 1;
        }
    }

    /// Counts by cause. Slots whose frame was under way (or `lead_ns` before them, where there was none) while the machine stood
    /// still are the machine's. A frame that was sent in time and not lit is the link's.
    pub fn counts(&self, standstills: &Standstills, lead_ns: i64) -> SlotCounts {
        let (Some(first), Some(last)) = (self.first_lit, self.last_planned) else {
            return SlotCounts::default();
        };
        let mut counts = SlotCounts { slots: (last + 1).saturating_sub(first), ..SlotCounts::default() };
        for &(slot, begin) in self.missed.iter().filter(|(slot, _)| *slot <= last) {
            let (cause, since) = self.troubled.get(&slot).copied().unwrap_or((MissCause::Link, begin));
            let stood_still = standstills.touches(since.min(begin.plus_ns(-lead_ns)), begin);
            counts.missed[if stood_still { MissCause::Standstill } else { cause } as usize] += 1;
        }
        counts.missed[MissCause::Link as usize] += self.not_kept;
        counts
    }
}

impl SlotCounts {
    /// Missed slots of every cause.
    pub fn missed_total(&self) -> u64 {
        self.missed.iter().sum()
    }
}

/// The part of a late frame's way that took longest.
fn slowest(t: &FrameTimeline) -> MissCause {
    let rendered = t.wall_ns[Stage::Render as usize] > 0;
    let parts = [
        (MissCause::Plan, t.submitted_at.ns_since(t.latched_at)),
        (if rendered { MissCause::Render } else { MissCause::Pack }, t.rendered_at.ns_since(t.submitted_at)),
        (MissCause::Pack, t.packed_at.ns_since(t.rendered_at)),
        (MissCause::Link, t.sent_at.ns_since(t.packed_at)),
    ];
    parts.into_iter().max_by_key(|(_, ns)| *ns).map_or(MissCause::Link, |(cause, _)| cause)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SLOT: i64 = 1_000_000;

    /// A frame for `slot`, due at its beginning, whose link part ends `after_due` later.
    fn frame(slot: u64, after_due: i64) -> FrameTimeline {
        let due = HostTime(slot as i64 * SLOT);
        FrameTimeline {
            latched_at: due.plus_ns(-2 * SLOT),
            submitted_at: due.plus_ns(-2 * SLOT + 1),
            rendered_at: due.plus_ns(-SLOT),
            packed_at: due.plus_ns(-SLOT / 2),
            sent_at: due.plus_ns(after_due),
            due_at: due,
            ..FrameTimeline::default()
        }
    }

    /// Slots 10 to 19: 12 never planned, 13 not taken, 15 sent 2 slots late, 17 lost by the device; then 20 and 21, which nobody planned.
    fn ledger() -> SlotLedger {
        let mut ledger = SlotLedger::default();
        ledger.nothing_new(9, HostTime(9 * SLOT));
        for slot in [10, 11, 13, 14, 15, 16, 17, 18, 19] {
            let after = if slot == 15 { 2 * SLOT } else { -100 };
            ledger.planned(slot, &frame(slot, after), slot == 13, slot == 13);
        }
        for slot in 10..22 {
            match slot {
                12 | 13 | 15 | 17 | 20 | 21 => ledger.nothing_new(slot, HostTime(slot as i64 * SLOT)),
                _ => ledger.lit(slot),
            }
        }
        ledger
    }

    #[test]
    fn every_missed_slot_of_the_run_has_one_cause() {
        let counts = ledger().counts(&Standstills::default(), 0);
        assert_eq!((counts.slots, counts.missed_total()), (10, 4));
        let of = |cause: MissCause| counts.missed[cause as usize];
        assert_eq!((of(MissCause::Buffers), of(MissCause::Link), of(MissCause::Standstill)), (1, 3, 0));
        // The machine stood still while the frame of slot 15 was under way, and nothing else.
        let mut standstills = Standstills::default();
        standstills.note(HostTime(14 * SLOT + 10), HostTime(15 * SLOT - 10), 1);
        let counts = ledger().counts(&standstills, 0);
        let of = |cause: MissCause| counts.missed[cause as usize];
        assert_eq!((of(MissCause::Buffers), of(MissCause::Link), of(MissCause::Standstill)), (1, 2, 1));
        assert_eq!(SlotLedger::default().counts(&standstills, 0), SlotCounts::default());
    }

    #[test]
    fn a_late_frame_is_blamed_on_its_longest_part() {
        let mut t = frame(5, -100);
        assert_eq!(slowest(&t), MissCause::Pack);
        t.wall_ns[Stage::Render as usize] = 1;
        assert_eq!(slowest(&t), MissCause::Render);
        t.submitted_at = t.latched_at.plus_ns(10 * SLOT);
        assert_eq!(slowest(&t), MissCause::Plan);
    }
}
