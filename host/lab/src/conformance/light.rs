//! Credits, frames and slots: what is lit when, what is dropped and counted.

use super::driver::{ConformanceDriver, R};
use super::orders::lit_frame;
use super::shot::Shot;
use super::{check, fates, grew, tell, Rule, Stop};
use dpm_device::link::{Status, Underrun};
use dpm_device::time::{DeviceTicks, FrameRate};

pub(super) const RULES: &[Rule] = &[
    Rule {
        id: "credit-beyond",
        section: "5",
        statement: "frames fill the buffers; one beyond the limit is refused and accounted",
        check: credit_beyond,
    },
    Rule {
        id: "credit-lost",
        section: "5",
        statement: "FRAME_COMMIT accounts frames that were lost before it",
        check: credit_lost,
    },
    Rule {
        id: "credit-sync",
        section: "5",
        statement: "SYNC accounts lost frames, and never takes accounts back",
        check: credit_sync,
    },
    Rule {
        id: "frame-lit",
        section: "7",
        statement: "a whole frame is lit in its slot, and STATUS says which and when",
        check: frame_lit,
    },
    Rule {
        id: "slot-start",
        section: "7",
        statement: "slot k begins at epoch + floor(k * ticks * denominator / numerator)",
        check: slot_start,
    },
    Rule {
        id: "slots-counted",
        section: "4",
        statement: "every slot while armed is counted",
        check: slots_counted,
    },
    Rule {
        id: "underrun-repeat",
        section: "7",
        statement: "without a new frame the frame before repeats where CONFIG says so",
        check: underrun_repeat,
    },
    Rule {
        id: "underrun-blank",
        section: "7",
        statement: "without a new frame the slot is blank where CONFIG says so",
        check: underrun_blank,
    },
    Rule {
        id: "frame-late",
        section: "7",
        statement: "a frame whose slot has begun is dropped as late",
        check: frame_late,
    },
    Rule {
        id: "frame-late-allowed",
        section: "7",
        statement: "within the allowed lateness a late frame is lit in the next slot",
        check: frame_late_allowed,
    },
    Rule {
        id: "frame-early",
        section: "7",
        statement: "a target more than 2 s ahead is refused",
        check: frame_early,
    },
    Rule {
        id: "frame-superseded",
        section: "7",
        statement: "of two frames that are due the newer is lit, the older is superseded",
        check: frame_superseded,
    },
];

fn credit_beyond(b: &mut ConformanceDriver<'_>) -> R {
    // So slow that the frames wait while they are sent, and are within two seconds.
    b.armed(|c| c.rate = FrameRate::new(1, 1).unwrap_or(c.rate))?;
    b.needs_frames()?;
    let before = b.report()?;
    let buffers = b.hello.map_or(1, |h| u32::from(h.frame_buffers));
    if i64::from(buffers) * b.carry_ns(b.frame_bytes()) > 700_000_000 {
        return Err(Stop::NotJudged(format!("{buffers} frames take this medium too long")));
    }
    let now = b.report()?.now;
    let slot = b.slots()?.slot_at(now).map_or(1, |k| k + 1);
    // All of the slot after the next: none is taken out while they arrive.
    b.until_slot(slot)?;
    for _ in 0..buffers {
        b.send_for(slot + 1)?;
    }
    let full = b.report()?;
    check(
        full.buffers_free == 0
            && full.frame_limit == full.frames_accounted
            && full.frames_accounted == buffers,
        &format!("no buffer free and no credit after {buffers} frames"),
        || tell(&full),
    )?;
    b.send_for(slot + 1)?;
    let s = b.report()?;
    check(grew(&full, &s, |s| s.frames_refused) == 1, "the frame beyond the limit refused", || tell(&s))?;
    check(s.frames_accounted == buffers + 1, "it accounted all the same", || tell(&s))?;
    let s = b.until_slot(slot + 1)?;
    check(
        fates(&before, &s) == [1, 0, 0, buffers - 1, 1]
            && s.buffers_free == full.buffers_free + buffers as u8,
        "the newest lit, the others superseded, all buffers free",
        || tell(&s),
    )
}

fn credit_lost(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    b.frames_sent = 5;
    b.next_frame = b.next_frame.wrapping_add(5);
    let slot = b.slot_ahead_quietly()?;
    b.send_for(slot)?;
    // Not SYNC, which accounts by itself: the STATUS that follows FRAME_COMMIT.
    let limit = b.answer_ns() + 1_000_000_000;
    let s = b.wait_status(limit, |s| s.frames_accounted >= 6)?;
    let s = s.ok_or_else(|| b.silent("a STATUS with 6 frames accounted"))?;
    check(
        s.frames_accounted == 6 && s.frame_limit >= 6,
        "6 frames accounted: 5 that were lost, and one",
        || tell(&s),
    )
}

fn credit_sync(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    for (sent, expected) in [(7u32, 7u32), (3, 7), (9, 9)] {
        b.frames_sent = sent;
        let s = b.report()?;
        check(
            s.frames_accounted == expected,
            &format!("{expected} frames accounted after SYNC {sent}"),
            || tell(&s),
        )?;
        check(s.frame_limit == expected + u32::from(s.buffers_free), "credit for the free buffers", || {
            tell(&s)
        })?;
    }
    Ok(())
}

fn frame_lit(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    let before = b.report()?;
    let shot = b.send_ahead()?;
    let sent = b.report()?;
    check(
        sent.last_whole_frame == shot.id && (sent.buffers_free < before.buffers_free || sent.frames_lit > 0),
        "the frame whole and in a buffer",
        || tell(&sent),
    )?;
    let s = b.until_slot(shot.slot)?;
    check(fates(&before, &s) == [1, 0, 0, 0, 0] && s.lit, "one frame lit", || tell(&s))?;
    check(s.last_lit_frame == shot.id, &format!("frame {} lit", shot.id), || tell(&s))?;
    check(
        s.last_lit_at.0.abs_diff(shot.target) <= 1,
        &format!("lit at its target, tick {}", shot.target),
        || format!("tick {}", s.last_lit_at.0),
    )
}

fn slot_start(b: &mut ConformanceDriver<'_>) -> R {
    // A rate that no clock divides.
    b.armed(|c| c.rate = FrameRate::new(c.rate.num() - 3, c.rate.den()).unwrap_or(c.rate))?;
    b.needs_frames()?;
    for _ in 0..3 {
        let slot = b.slot_ahead()?;
        // In the middle of the slot: it lies in it all the same.
        let slots = b.slots()?;
        let middle = slots.start(slot).0.midpoint(slots.start(slot + 1).0);
        let shot = b.shot_at(slot, middle)?;
        b.send(&shot)?;
        let s = b.until_slot(slot)?;
        let start = slots.start(slot).0;
        check(
            s.last_lit_frame == shot.id && s.last_lit_at.0.abs_diff(start) <= 1,
            &format!("slot {slot} at tick {start}"),
            || format!("frame {} lit at tick {}", s.last_lit_frame, s.last_lit_at.0),
        )?;
    }
    Ok(())
}

fn slots_counted(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    let a = b.report()?;
    let slots = b.slots()?;
    let ms = u64::from(b.slot_ms());
    let s = b.until(a.now.0 + b.ticks_of_ms(12 * ms))?;
    let expected = slots.slot_at(s.now).unwrap_or(0) - slots.slot_at(a.now).unwrap_or(0);
    let counted = u64::from(grew(&a, &s, |s| s.slots));
    check(counted.abs_diff(expected) <= 1, &format!("{expected} slots between two reports"), || {
        counted.to_string()
    })?;
    check(u64::from(grew(&a, &s, |s| s.slots_blank)) == counted, "blank ones: nothing was sent", || tell(&s))
}

fn underrun_repeat(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    let lit = lit_frame(b)?;
    let slots = b.slots()?;
    let slot = slots.slot_at(lit.now).unwrap_or(0) + 3;
    let s = b.until_slot(slot)?;
    check(s.lit && grew(&lit, &s, |s| s.slots_repeated) >= 3, "light in three repeated slots", || tell(&s))?;
    check(grew(&lit, &s, |s| s.slots_blank) == 0, "no blank slot", || tell(&s))
}

fn underrun_blank(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|c| c.underrun = Underrun::Blank)?;
    b.needs_frames()?;
    let before = b.report()?;
    let shot = b.send_ahead()?;
    let s = b.until_slot(shot.slot + 2)?;
    check(
        grew(&before, &s, |s| s.frames_lit) == 1 && !s.lit,
        "lit in its slot, and dark afterwards",
        || tell(&s),
    )?;
    check(grew(&before, &s, |s| s.slots_repeated) == 0, "no repeated slot", || tell(&s))
}

/// The slot that runs, a little after its start.
pub(super) fn begun(b: &mut ConformanceDriver<'_>) -> R<u64> {
    let now = b.report()?;
    let slot = b.slots()?.slot_at(now.now).map_or(0, |k| k + 1);
    b.until_slot(slot)?;
    Ok(slot)
}

/// A frame for the slot that runs, with the reports before it and three slots later.
fn late(b: &mut ConformanceDriver<'_>) -> R<(Shot, Status, Status)> {
    b.needs_frames()?;
    let slot = begun(b)?;
    let before = b.report()?;
    let shot = b.send_for(slot)?;
    let after = b.until_slot(slot + 3)?;
    Ok((shot, before, after))
}

fn frame_late(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    let (_, before, s) = late(b)?;
    check(fates(&before, &s) == [0, 0, 1, 0, 0] && !s.lit, "one frame late, none lit", || tell(&s))
}

fn frame_late_allowed(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|c| c.late_slots = 20)?;
    let (shot, before, s) = late(b)?;
    check(fates(&before, &s) == [1, 0, 0, 0, 0], "the late frame lit", || tell(&s))?;
    check(s.last_lit_at.0 > shot.target, "lit in a later slot", || tell(&s))?;
    // Later than that it is dropped.
    let before = b.until_slot(shot.slot + 35)?;
    b.send_for(shot.slot)?;
    let s = b.report()?;
    check(fates(&before, &s) == [0, 0, 1, 0, 0], "a frame 35 slots late dropped as late", || tell(&s))
}

fn frame_early(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    let before = b.report()?;
    let slots = b.slots()?;
    let far = b.ticks_now() + b.tick_hz() * 2 + b.ticks_of_ms(1500);
    b.send_for(slots.slot_at(DeviceTicks(far)).unwrap_or(0))?;
    let s = b.report()?;
    check(fates(&before, &s) == [0, 0, 0, 0, 1], "a frame 3.5 s ahead refused", || tell(&s))?;
    check(s.buffers_free == before.buffers_free, "no buffer taken by it", || tell(&s))?;
    let near = b.ticks_now() + b.tick_hz() + b.ticks_of_ms(500);
    b.send_for(slots.slot_at(DeviceTicks(near)).unwrap_or(0))?;
    let s = b.report()?;
    check(fates(&before, &s) == [0, 0, 0, 0, 1], "a frame 1.5 s ahead taken", || tell(&s))
}

fn frame_superseded(b: &mut ConformanceDriver<'_>) -> R {
    if b.hello.is_some_and(|h| h.frame_buffers < 2) {
        return Err(Stop::NotJudged("it has one frame buffer".into()));
    }
    b.armed(|_| {})?;
    b.needs_frames()?;
    let before = b.report()?;
    let slot = b.slot_ahead()? + 1;
    let older = b.shot(slot)?;
    let newer = b.shot(slot)?;
    b.send(&older)?;
    b.send(&newer)?;
    let s = b.until_slot(slot)?;
    check(
        fates(&before, &s) == [1, 0, 0, 1, 0] && s.last_lit_frame == newer.id,
        &format!("frame {} lit, {} superseded", newer.id, older.id),
        || tell(&s),
    )
}
