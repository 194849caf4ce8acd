//! Planes and what frames refer to: when a frame is whole, and when it is not.

use super::driver::{ConformanceDriver, R};
use super::shot::Shot;
use super::{check, fates, grew, tell, Rule, Stop};
use dpm_device::transport::Lane;

pub(super) const RULES: &[Rule] = &[
    Rule {
        id: "plane-missing",
        section: "7",
        statement: "FRAME_COMMIT without one of its planes: the frame is incomplete",
        check: plane_missing,
    },
    Rule {
        id: "frame-abandoned",
        section: "7",
        statement: "a newer frame begins: what was incomplete before is dropped and counted",
        check: frame_abandoned,
    },
    Rule {
        id: "frame-old",
        section: "7",
        statement: "packets of older frames are ignored",
        check: frame_old,
    },
    Rule {
        id: "frame-wrap",
        section: "7",
        statement: "frame numbers go on from 2^32 - 1 to 0",
        check: frame_wrap,
    },
    Rule {
        id: "plane-again",
        section: "7",
        statement: "a plane that is there is not written again, and a damaged copy does not spoil it",
        check: plane_again,
    },
    Rule {
        id: "plane-damaged",
        section: "7",
        statement: "a plane whose payload CRC is wrong does not count, and is counted as damaged",
        check: plane_damaged,
    },
    Rule {
        id: "plane-led",
        section: "7",
        statement: "a plane of another LED code than configured does not count",
        check: plane_led,
    },
    Rule {
        id: "plane-target",
        section: "7",
        statement: "a plane of another target than its frame's does not count",
        check: plane_target,
    },
    Rule {
        id: "masks",
        section: "4",
        statement: "the masks of FRAME_COMMIT share no bit and name every plane",
        check: masks,
    },
    Rule {
        id: "kept",
        section: "8",
        statement: "kept planes come from the base frame: a frame of nothing else is lit",
        check: kept,
    },
    Rule {
        id: "kept-base",
        section: "8",
        statement: "a frame whose base is not the newest whole frame is incomplete",
        check: kept_base,
    },
    Rule {
        id: "base-dropped",
        section: "7",
        statement: "a complete frame is the newest whole frame and the base of the next, though it is dropped as late",
        check: base_dropped,
    },
    Rule {
        id: "lanes",
        section: "1",
        statement: "PLANE and FRAME_COMMIT on the control lane are ignored",
        check: lanes,
    },
];

/// Sends a frame that must not be whole: incomplete, and dark.
pub(super) fn incomplete(
    b: &mut ConformanceDriver<'_>,
    what: &str,
    spoil: impl FnOnce(&mut ConformanceDriver<'_>, &mut Shot) -> R,
) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    let slot = b.slot_ahead()?;
    let before = b.report()?;
    let mut shot = b.shot(slot)?;
    spoil(b, &mut shot)?;
    b.send(&shot)?;
    let s = b.until_slot(slot)?;
    check(
        fates(&before, &s) == [0, 1, 0, 0, 0] && !s.lit,
        &format!("{what}: one frame incomplete, none lit"),
        || tell(&s),
    )?;
    check(s.last_whole_frame != shot.id, &format!("{what}: not the newest whole frame"), || tell(&s))
}

/// Sends a frame that must be lit.
pub(super) fn lit(
    b: &mut ConformanceDriver<'_>,
    what: &str,
    make: impl FnOnce(&mut ConformanceDriver<'_>, &mut Shot) -> R,
) -> R<Shot> {
    let slot = b.slot_ahead()?;
    let before = b.report()?;
    let mut shot = b.shot(slot)?;
    make(b, &mut shot)?;
    b.send(&shot)?;
    let s = b.until_slot(slot)?;
    check(
        fates(&before, &s) == [1, 0, 0, 0, 0] && s.last_lit_frame == shot.id,
        &format!("{what}: frame {} lit", shot.id),
        || tell(&s),
    )?;
    Ok(shot)
}

fn plane_missing(b: &mut ConformanceDriver<'_>) -> R {
    incomplete(b, "a plane too few", |_, shot| {
        shot.pieces.pop();
        Ok(())
    })
}

fn frame_abandoned(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    let slot = b.slot_ahead_quietly()? + 1;
    let before = b.report()?;
    let mut half = b.shot(slot)?;
    half.commits = false;
    let whole = b.shot(slot)?;
    b.send(&half)?;
    b.send(&whole)?;
    let s = b.until_slot(slot)?;
    check(fates(&before, &s) == [1, 1, 0, 0, 0], "one frame incomplete, the next lit", || tell(&s))?;
    check(
        s.last_lit_frame == whole.id && grew(&before, &s, |s| s.frames_seen) == 2,
        "two frames seen",
        || tell(&s),
    )
}

fn frame_old(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    let slot = b.slot_ahead()? + 2;
    let older = b.shot(slot)?;
    let newer = b.shot(slot)?;
    b.send(&newer)?;
    let before = b.report()?;
    b.send(&older)?;
    // And the same frame again.
    b.send(&newer)?;
    let s = b.report()?;
    check(grew(&before, &s, |s| s.frames_seen) == 0, "no frame more seen", || tell(&s))?;
    let packets = (older.pieces.len() + newer.pieces.len() + 2) as u32;
    let ignored = grew(&before, &s, |s| s.packets_ignored);
    check(ignored == packets, &format!("{packets} packets ignored"), || ignored.to_string())?;
    let s = b.until_slot(slot)?;
    check(s.frames_lit == 1 && s.last_lit_frame == newer.id, "the newer frame lit", || tell(&s))
}

fn frame_wrap(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    b.next_frame = u32::MAX;
    lit(b, "number 2^32 - 1", |_, _| Ok(()))?;
    let shot = lit(b, "number 0", |_, _| Ok(()))?;
    check(shot.id == 0, "0", || shot.id.to_string())?;
    lit(b, "number 1", |_, _| Ok(()))?;
    Ok(())
}

fn plane_again(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    let before = b.report()?;
    lit(b, "a plane twice, and a damaged copy", |_, shot| {
        let mut again = shot.pieces[0].clone();
        shot.pieces.insert(1, again.clone());
        again.damaged = true;
        shot.pieces.insert(2, again);
        Ok(())
    })?;
    let s = b.report()?;
    check(grew(&before, &s, |s| s.packets_ignored) >= 1, "the copy counted as ignored", || tell(&s))
}

fn plane_damaged(b: &mut ConformanceDriver<'_>) -> R {
    incomplete(b, "a damaged plane", |_, shot| {
        shot.pieces[0].damaged = true;
        Ok(())
    })?;
    let s = b.report()?;
    check(s.payload_errors >= 1, "a damaged payload counted", || tell(&s))
}

fn plane_led(b: &mut ConformanceDriver<'_>) -> R {
    incomplete(b, "another LED code", |_, shot| {
        shot.pieces[0].led = 0x27;
        Ok(())
    })
}

fn plane_target(b: &mut ConformanceDriver<'_>) -> R {
    incomplete(b, "another target", |b, shot| {
        if shot.pieces.len() < 2 {
            return Err(Stop::NotJudged("its frames have one plane".into()));
        }
        let other = b.slots()?.start(shot.slot + 1).0;
        shot.pieces[1].target = other;
        Ok(())
    })
}

fn masks(b: &mut ConformanceDriver<'_>) -> R {
    incomplete(b, "a plane in neither mask", |_, shot| {
        let last = shot.pieces.len() as u32 - 1;
        if last == 0 {
            return Err(Stop::NotJudged("its frames have one plane".into()));
        }
        shot.pieces.pop();
        shot.commit.sent &= !(1 << last);
        Ok(())
    })?;
    // A plane in both: the message has a wrong field.
    let slot = b.slot_ahead()?;
    let before = b.report()?;
    let mut shot = b.shot(slot)?;
    shot.commit.kept = 1;
    b.send(&shot)?;
    let s = b.until_slot(slot)?;
    check(grew(&before, &s, |s| s.frames_lit) == 0 && !s.lit, "a plane in both masks: no light", || {
        tell(&s)
    })?;
    check(grew(&before, &s, |s| s.packets_ignored) >= 1, "FRAME_COMMIT counted as ignored", || tell(&s))
}

fn kept(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    let base = lit(b, "a frame", |_, _| Ok(()))?;
    let all = base.commit.sent;
    let mixed = lit(b, "one plane sent, the others kept", |_, shot| {
        shot.pieces.truncate(1);
        (shot.commit.sent, shot.commit.kept, shot.commit.base_frame) = (1, all & !1, base.id);
        Ok(())
    })?;
    lit(b, "all planes kept", |_, shot| {
        shot.pieces.clear();
        (shot.commit.sent, shot.commit.kept, shot.commit.base_frame) = (0, all, mixed.id);
        Ok(())
    })?;
    Ok(())
}

fn kept_base(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    let base = lit(b, "a frame", |_, _| Ok(()))?;
    lit(b, "another", |_, _| Ok(()))?;
    let all = base.commit.sent;
    let slot = b.slot_ahead()?;
    let before = b.report()?;
    let mut shot = b.shot(slot)?;
    shot.pieces.clear();
    (shot.commit.sent, shot.commit.kept, shot.commit.base_frame) = (0, all, base.id);
    b.send(&shot)?;
    let s = b.until_slot(slot)?;
    check(fates(&before, &s) == [0, 1, 0, 0, 0], "one frame incomplete", || tell(&s))?;
    // Without any frame before it.
    incomplete(b, "kept planes without a base", |_, shot| {
        shot.pieces.clear();
        (shot.commit.sent, shot.commit.kept) = (0, all);
        Ok(())
    })
}

fn base_dropped(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    let slot = b.slot_ahead()?;
    b.until_slot(slot)?;
    let before = b.report()?;
    let late = b.shot(slot)?;
    b.send(&late)?;
    let s = b.report()?;
    check(
        fates(&before, &s) == [0, 0, 1, 0, 0] && s.last_whole_frame == late.id,
        "a late frame that is the newest whole one",
        || tell(&s),
    )?;
    let all = late.commit.sent;
    lit(b, "a frame of nothing but planes kept from it", |_, shot| {
        shot.pieces.clear();
        (shot.commit.sent, shot.commit.kept, shot.commit.base_frame) = (0, all, late.id);
        Ok(())
    })?;
    Ok(())
}

fn lanes(b: &mut ConformanceDriver<'_>) -> R {
    if b.medium.kind == super::MediumKind::Serial {
        return Err(Stop::NotJudged("a serial line is one stream for both lanes".into()));
    }
    b.armed(|_| {})?;
    b.needs_frames()?;
    let slot = b.slot_ahead()?;
    let before = b.report()?;
    let mut shot = b.shot(slot)?;
    let pieces = std::mem::take(&mut shot.pieces);
    let session = b.session;
    // One by one: a control message has no room for more.
    for piece in pieces {
        if piece.bytes.len() > 96 {
            return Err(Stop::NotJudged("its planes are too long for the control lane".into()));
        }
        let one = Shot { pieces: vec![piece], commits: false, ..shot.clone() };
        b.send_as(session, Lane::Control, &one)?;
    }
    b.send_as(session, Lane::Control, &shot)?;
    let s = b.until_slot(slot)?;
    check(grew(&before, &s, |s| s.frames_seen) == 0 && !s.lit, "no frame seen", || tell(&s))?;
    check(grew(&before, &s, |s| s.packets_ignored) >= 2, "the packets counted as ignored", || tell(&s))
}
