//! Light that ends by itself: `dark from`.

use super::driver::{ConformanceDriver, R};
use super::light::begun;
use super::orders::lit_frame;
use super::{check, fates, grew, tell, Rule, Stop};
use dpm_device::link::{Config, DeviceState, HostMessage, Status};
use dpm_device::time::{DeviceTicks, FrameRate};

pub(super) const RULES: &[Rule] = &[
    Rule {
        id: "dark-from",
        section: "7",
        statement: "from `dark from` on there is no light: blank slots, still armed, no fault, and the next frame lights",
        check: dark_from,
    },
    Rule {
        id: "dark-from-mid-slot",
        section: "7",
        statement: "`dark from` ends light in the middle of a slot, too",
        check: dark_from_mid_slot,
    },
    Rule {
        id: "dark-from-replaced",
        section: "7",
        statement: "a newer frame that is lit replaces the `dark from` of the one before",
        check: dark_from_replaced,
    },
    Rule {
        id: "dark-from-wrong",
        section: "7",
        statement: "a `dark from` that is not after the target is ignored and counted",
        check: dark_from_wrong,
    },
    Rule {
        id: "dark-from-late",
        section: "7",
        statement: "a late frame whose own `dark from` has passed is dropped as late",
        check: dark_from_late,
    },
    Rule {
        id: "dark-from-frozen",
        section: "7",
        statement: "FREEZE suspends `dark from`; the ARM that ends it applies it at once",
        check: dark_from_frozen,
    },
];

/// Every report of `all` from `from` to `to` ticks has light or has none; `None` where there is no report.
fn all_lit(all: &[Status], from: u64, to: u64, lit: bool) -> Option<bool> {
    let mut of = all.iter().filter(|s| (from..to).contains(&s.now.0)).peekable();
    of.peek()?;
    Some(of.all(|s| s.lit == lit))
}

/// A frame whose light ends `halves` half slots after its start: the reports meanwhile and after, and that instant.
fn ends(b: &mut ConformanceDriver<'_>, halves: u64) -> R<(Status, Vec<Status>, u64, u64)> {
    b.needs_frames()?;
    let before = b.report()?;
    let slot = b.slot_ahead()?;
    let mut shot = b.shot(slot)?;
    let slots = b.slots()?;
    let half = (slots.start(slot + 1).0 - slots.start(slot).0) / 2;
    let dark = shot.target + half * halves;
    shot.commit.dark_from = DeviceTicks(dark);
    b.send(&shot)?;
    let all = b.watch_until(dark + 3 * half)?;
    Ok((before, all, shot.target, dark))
}

fn dark_from(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    let (before, all, lit_at, dark) = ends(b, 7)?;
    let slack = b.ticks_of_ms(2);
    let s = all.last().copied().ok_or_else(|| b.silent("a STATUS"))?;
    check(fates(&before, &s) == [1, 0, 0, 0, 0], "the frame lit", || tell(&s))?;
    check(
        all_lit(&all, lit_at + slack, dark, true) != Some(false),
        &format!("light until tick {dark}"),
        || "a dark report before it".into(),
    )?;
    check(
        all_lit(&all, dark + slack, u64::MAX, false) == Some(true),
        &format!("no light from tick {dark} on"),
        || tell(&s),
    )?;
    check(s.state == DeviceState::Armed && s.faults == 0, "armed, no fault", || tell(&s))?;
    let later = b.until(s.now.0 + 4 * b.ticks_of_ms(u64::from(b.slot_ms())))?;
    check(
        grew(&s, &later, |s| s.slots_blank) >= 2 && grew(&s, &later, |s| s.slots_repeated) == 0,
        "blank slots after it",
        || tell(&later),
    )?;
    lit_frame(b)?;
    Ok(())
}

fn dark_from_mid_slot(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|c| c.rate = FrameRate::new(2, 1).unwrap_or(c.rate))?;
    // A slot of half a second, dark from its middle on.
    let (before, all, lit_at, dark) = ends(b, 1)?;
    let slack = b.ticks_of_ms(5);
    let s = all.last().copied().ok_or_else(|| b.silent("a STATUS"))?;
    check(grew(&before, &s, |s| s.frames_lit) == 1, "the frame lit", || tell(&s))?;
    check(
        all_lit(&all, lit_at + slack, dark, true) != Some(false),
        "light in the first half of the slot",
        || tell(&s),
    )?;
    let end = b.slots()?.start(b.slots()?.slot_at(DeviceTicks(lit_at)).unwrap_or(0) + 1).0;
    match all_lit(&all, dark + slack, end, false) {
        Some(dark) => check(dark, "no light in the second half of the slot", || "light".into()),
        None => Err(Stop::Failed("no report from the second half of the slot".into())),
    }
}

fn dark_from_replaced(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    let slot = b.slot_ahead()? + 1;
    let slots = b.slots()?;
    let mut first = b.shot(slot)?;
    let second = b.shot(slot + 1)?;
    // At one and the same tick the new frame comes first.
    first.commit.dark_from = DeviceTicks(slots.start(slot + 1).0);
    let before = b.report()?;
    b.send(&first)?;
    b.send(&second)?;
    let s = b.until_slot(slot + 4)?;
    check(fates(&before, &s) == [2, 0, 0, 0, 0] && s.lit, "the second frame lit, and still so", || tell(&s))?;
    check(s.last_lit_frame == second.id, "the second frame lit last", || tell(&s))
}

fn dark_from_wrong(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    let slot = b.slot_ahead()?;
    let before = b.report()?;
    let mut shot = b.shot(slot)?;
    shot.commit.dark_from = DeviceTicks(shot.target);
    b.send(&shot)?;
    let s = b.until_slot(slot)?;
    check(grew(&before, &s, |s| s.frames_lit) == 0 && !s.lit, "no light", || tell(&s))?;
    check(grew(&before, &s, |s| s.packets_ignored) >= 1, "FRAME_COMMIT counted as ignored", || tell(&s))
}

fn dark_from_late(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|c: &mut Config| c.late_slots = 20)?;
    b.needs_frames()?;
    let slot = begun(b)?;
    let before = b.report()?;
    let mut shot = b.shot(slot)?;
    shot.commit.dark_from = DeviceTicks(shot.target + 1);
    b.send(&shot)?;
    let s = b.until_slot(slot + 3)?;
    check(fates(&before, &s) == [0, 0, 1, 0, 0] && !s.lit, "the frame dropped as late", || tell(&s))
}

fn dark_from_frozen(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    let slot = b.slot_ahead()?;
    let mut shot = b.shot(slot)?;
    let ahead = b.ticks_of_ms(200 + 4 * u64::from(b.slot_ms()));
    shot.commit.dark_from = DeviceTicks(shot.target + ahead);
    b.send(&shot)?;
    b.until_slot(slot)?;
    b.say(&HostMessage::Freeze)?;
    let s = b.report()?;
    if s.now.0 >= shot.target + ahead {
        return Err(Stop::Failed("FREEZE arrived after the frame's light had ended".into()));
    }
    check(s.state == DeviceState::Frozen && s.lit, "frozen, with light", || tell(&s))?;
    let s = b.until(shot.target + ahead + b.ticks_of_ms(60))?;
    check(s.state == DeviceState::Frozen && s.lit, "light after `dark from`, while frozen", || tell(&s))?;
    b.say(&HostMessage::Arm(0))?;
    let s = b.report()?;
    check(s.state == DeviceState::Armed && !s.lit, "dark as soon as it is armed again", || tell(&s))
}
