//! Tests of the ledger with runs in which every slot is known.

use super::*;
use dpm_common::realtime::standstill::Standstills;

const SLOT: i64 = 1_000_000;

fn rate() -> FrameRate {
    FrameRate::new(1000, 1).unwrap()
}

fn begin(slot: u64) -> HostTime {
    HostTime(slot as i64 * SLOT)
}

/// A frame for `slot`, due at its beginning, whose link part ends `after_due` later.
fn frame(slot: u64, after_due: i64) -> FrameTimeline {
    let due = begin(slot);
    FrameTimeline {
        latched_at: due.plus_ns(-2 * SLOT),
        submitted_at: due.plus_ns(-2 * SLOT + 1),
        rendered_at: due.plus_ns(-2 * SLOT + 2),
        packing_at: due.plus_ns(-2 * SLOT + 3),
        packed_at: due.plus_ns(-SLOT / 2),
        sent_at: due.plus_ns(after_due),
        due_at: due,
        ..FrameTimeline::default()
    }
}

fn standstills(gaps: &[(i64, i64)]) -> Arc<SeenStandstills> {
    let mut all = Standstills::default();
    gaps.iter().for_each(|&(from, to)| all.note(HostTime(from), HostTime(to), 0));
    Arc::new(SeenStandstills::known(all))
}

fn ledger(gaps: &[(i64, i64)]) -> SlotLedger {
    let mut ledger = SlotLedger::new(rate(), 0);
    ledger.excuse_by(standstills(gaps));
    ledger
}

/// Slots 10 to 19: 12 was never planned, 13 not accepted, 15 sent 2 slots late, 17 lost by the device. Before them
/// comes 9; after them 20 and 21, which were not planned.
fn ten_slots(mut ledger: SlotLedger) -> SlotCounts {
    ledger.nothing_new(9, begin(9), 0);
    for slot in [10, 11, 13, 14, 15, 16, 17, 18, 19] {
        let after = if slot == 15 { 2 * SLOT } else { -100 };
        ledger.planned(slot, &frame(slot, after), slot == 13, (slot == 13).then_some(MissCause::Buffers));
    }
    for slot in 10..22 {
        match slot {
            12 | 13 | 15 | 17 | 20 | 21 => ledger.nothing_new(slot, begin(slot), 0),
            _ => ledger.own(slot, begin(slot), 0),
        }
        ledger.settle();
    }
    assert_eq!(ledger.finish(), ledger.counts());
    ledger.counts()
}

#[test]
fn every_missed_slot_of_the_run_has_one_cause() {
    let of = |counts: &SlotCounts, cause: MissCause| counts.missed[cause as usize];
    let counts = ten_slots(ledger(&[]));
    assert_eq!((counts.wanted(), counts.own, counts.missed_total(), counts.ordered_total()), (10, 6, 4, 0));
    assert_eq!((of(&counts, MissCause::Buffers), of(&counts, MissCause::Link)), (1, 3));
    assert_eq!((counts.excused(), counts.missed_share()), (0, 0.4));
    // The machine stood still only while the frame of slot 15 was in flight. In the raw number the slot is missed all
    // the same.
    let counts = ten_slots(ledger(&[(14 * SLOT + 10, 15 * SLOT - 10)]));
    assert_eq!((of(&counts, MissCause::Buffers), of(&counts, MissCause::Link), counts.excused()), (1, 2, 1));
    assert_eq!(counts.missed_total(), 4);
    assert_eq!(SlotLedger::new(rate(), 0).finish(), SlotCounts::default());
}

/// Found in use: a run whose every frame is late, or whose light nobody reports, has no slot with its own frame; it
/// is not a run without misses.
#[test]
fn slots_of_which_nothing_good_is_known_are_missed() {
    let mut late = ledger(&[]);
    let mut silent = ledger(&[]);
    for slot in 5..105 {
        late.planned(slot, &frame(slot, 3 * SLOT), false, None);
        late.nothing_new(slot, begin(slot), 0);
        silent.planned(slot, &frame(slot, -100), true, None);
    }
    assert_eq!((late.finish().missed_total(), late.counts().own), (100, 0));
    assert_eq!((silent.finish().missed[MissCause::Link as usize], silent.counts().wanted()), (100, 100));
}

/// Slots whose light was reported only as a number count as showing their own frames. Slots before a report that has
/// no number for them do not.
#[test]
fn a_merged_report_covers_the_slots_before_it() {
    let mut ledger = ledger(&[]);
    for slot in 0..8 {
        ledger.planned(slot, &frame(slot, -100), false, None);
    }
    ledger.own(0, begin(0), 0);
    ledger.own(4, begin(4), 2);
    ledger.own(7, begin(7), 2);
    let counts = ledger.finish();
    assert_eq!((counts.own, counts.missed[MissCause::Link as usize]), (7, 1));
}

/// Found in use (second look at latency, section 2): an operator's BLACK was counted as lateness of the link.
#[test]
fn ordered_dark_is_neither_missed_nor_lit() {
    let log = DarkLog::default();
    let mut ledger = ledger(&[]);
    let (mut own, mut ordered) = (0, 0);
    for slot in 0..2_000u64 {
        for (at, told) in [(500, Some(OrderedDark::Black)), (900, Some(OrderedDark::Safe)), (1_200, None)] {
            if slot == at {
                log.tell(begin(slot), told);
            }
        }
        ledger.read_orders(&log);
        let dark = (500..1_203).contains(&slot);
        ledger.planned(slot, &frame(slot, -100), dark, None);
        // While it is latched, the projector reports no slot.
        match slot {
            900..1_200 => ordered += 1,
            _ if dark => {
                ordered += 1;
                ledger.nothing_new(slot, begin(slot), 0);
            }
            1_500 => ledger.nothing_new(slot, begin(slot), 0),
            _ => {
                own += 1;
                ledger.own(slot, begin(slot), 0);
            }
        }
        ledger.settle();
    }
    let counts = ledger.finish();
    assert_eq!((counts.own, counts.ordered_total(), counts.missed_total()), (own, ordered, 1));
    let of = |reason: OrderedDark| counts.ordered[reason as usize];
    // The slot in which SAFE was ordered no longer belongs to BLACK.
    assert_eq!((of(OrderedDark::Black), of(OrderedDark::Safe)), (400, 303));
    assert_eq!((counts.wanted(), counts.missed_share()), (own + 1, 1.0 / (own + 1) as f64));
}

/// A limit that our own frames exceeded was ordered by nobody: its slots are missed, and the cause is the fault.
#[test]
fn a_fault_that_frames_caused_is_missed_and_not_ordered() {
    let log = DarkLog::default();
    let mut ledger = ledger(&[]);
    for slot in 0..300u64 {
        let exceeded = (100..200).contains(&slot);
        log.tell(begin(slot), exceeded.then_some(OrderedDark::Exceeded));
        ledger.read_orders(&log);
        ledger.planned(slot, &frame(slot, -100), exceeded, None);
        if exceeded {
            ledger.nothing_new(slot, begin(slot), 0);
        } else {
            ledger.own(slot, begin(slot), 0);
        }
        ledger.settle();
    }
    let counts = ledger.finish();
    assert_eq!((counts.own, counts.missed[MissCause::Fault as usize], counts.ordered_total()), (200, 100, 0));
}

/// A week at 15 slots per second with ten misses and five standstills per second: memory stays bounded, and every
/// cause is exact to the end.
#[test]
fn a_week_of_misses_is_counted_exactly_in_bounded_memory() {
    let rate = FrameRate::new(15, 1).unwrap();
    let at = |slot: u64| HostTime(rate.slot_start_ns(slot));
    let seen = Arc::new(SeenStandstills::known(Standstills::default()));
    let mut ledger = SlotLedger::new(rate, 0);
    ledger.excuse_by(seen.clone());
    let log = DarkLog::default();
    let mut exact = SlotCounts::default();
    let slots = 7 * 24 * 3600 * 15u64;
    for slot in 0..slots {
        let due = at(slot);
        let mut t = frame(0, 0);
        (t.latched_at, t.due_at) = (due.plus_ns(-2 * SLOT), due);
        (t.submitted_at, t.rendered_at, t.packing_at) = (t.latched_at, t.latched_at, t.latched_at);
        (t.packed_at, t.sent_at) = (due.plus_ns(-SLOT), due.plus_ns(-100));
        // An hour of BLACK per day.
        let hour = slot / (3600 * 15) % 24;
        log.tell(due, (hour == 3).then_some(OrderedDark::Black));
        ledger.read_orders(&log);
        // Of every three slots one is lit, one is refused, and the frame of the third is late; half of the late ones
        // fall into standstills.
        let (kind, still) = (slot % 3, slot % 6 == 2);
        if still || kind == 1 && slot % 2 == 0 {
            let gap = due.plus_ns(if still { -SLOT } else { 3 * SLOT });
            seen.note(gap, gap.plus_ns(SLOT / 2));
        }
        if kind == 2 {
            t.packed_at = due.plus_ns(SLOT);
            t.sent_at = due.plus_ns(SLOT + 1);
        }
        ledger.planned(slot, &t, kind == 1, None);
        let dark = hour == 3;
        if kind == 0 && !dark {
            ledger.own(slot, due, 0);
        } else {
            ledger.nothing_new(slot, due, 0);
        }
        if slot % 64 == 0 {
            ledger.settle();
        }
        exact.add(
            match (dark, kind, still) {
                (true, ..) => Judgement::Ordered(OrderedDark::Black),
                (_, 0, _) => Judgement::Own,
                (_, _, true) => Judgement::Missed(MissCause::Standstill),
                (_, 1, _) => Judgement::Missed(MissCause::Link),
                _ => Judgement::Missed(MissCause::Pack),
            },
            1,
        );
    }
    assert_eq!(ledger.finish(), exact);
    assert_eq!(exact.wanted() + exact.ordered_total(), slots);
    assert!(ledger.window.capacity() <= 2 * WINDOW && ledger.batches.all.capacity() == MAX_BATCHES);
    assert!(seen.with(|s| s.count()) > 5 * 7 * 24 * 3600 / 2);
    let (wanted, missed) = ledger.batches().iter().fold((0, 0), |(a, b), (c, d)| (a + c, b + d));
    assert!(wanted <= exact.wanted() && wanted > exact.wanted() / 2);
    assert!((missed as f64 / wanted as f64 / exact.missed_share() - 1.0).abs() < 1e-3);
}

/// A process that is stopped for a day, and a projector that reports slots a thousand years ahead: time is bounded,
/// nothing is lost.
#[test]
fn jumps_are_counted_without_being_walked() {
    let mut ledger = ledger(&[]);
    ledger.planned(0, &frame(0, -100), false, None);
    ledger.own(0, begin(0), 0);
    ledger.nothing_new(u64::MAX, HostTime(i64::MAX), u32::MAX);
    ledger.nothing_new(3 * WINDOW as u64, begin(3 * WINDOW as u64), 0);
    let day = 24 * 3600 * 1000;
    ledger.planned(day, &frame(day, -100), false, None);
    ledger.own(day, begin(day), 0);
    ledger.planned(1 << 60, &frame(day + 1, -100), false, Some(MissCause::Buffers));
    ledger.settle();
    let counts = ledger.finish();
    assert_eq!(counts.own, 2);
    assert_eq!(counts.missed[MissCause::Plan as usize], day - 1);
    assert_eq!(counts.wanted(), (1 << 60) + 1);
    assert!(ledger.window.capacity() <= 2 * WINDOW);
}

#[test]
fn a_standstill_that_is_told_late_still_excuses_its_slot() {
    let seen = Arc::new(SeenStandstills::asleep());
    let mut ledger = SlotLedger::new(rate(), 0);
    ledger.excuse_by(seen.clone());
    for slot in 0..50 {
        ledger.planned(slot, &frame(slot, -100), false, None);
        if slot == 20 {
            ledger.nothing_new(slot, begin(slot), 0);
        } else {
            ledger.own(slot, begin(slot), 0);
        }
        ledger.settle();
    }
    // Nothing after the missed slot is counted before that slot is decided.
    assert_eq!((ledger.counts().own, ledger.counts().missed_total()), (20, 0));
    seen.note(begin(18), begin(49));
    seen.wake(begin(49));
    ledger.settle();
    assert_eq!((ledger.counts().own, ledger.counts().excused()), (49, 1));
}

#[test]
fn a_late_frame_is_blamed_on_its_longest_part() {
    let mut t = frame(5, -100);
    assert_eq!(slowest(&t), MissCause::Pack);
    t.rendered_at = t.packed_at.plus_ns(-1);
    assert_eq!(slowest(&t), MissCause::Render);
    t.submitted_at = t.latched_at.plus_ns(10 * SLOT);
    assert_eq!(slowest(&t), MissCause::Plan);
}
