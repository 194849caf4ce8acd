//! Planes, codecs and what frames refer to: when a frame is whole, and when it is not.

use super::driver::{Bench, R};
use super::shot::{lz4_block, Shot};
use super::{check, fates, grew, tell, Rule, Stop};
use dpm_device::link::{rle_encode, Codec};
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
    Rule { id: "frame-wrap", section: "7", statement: "frame numbers go on from 2^32 - 1 to 0", check: frame_wrap },
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
        id: "lanes",
        section: "1",
        statement: "PLANE and FRAME_COMMIT on the control lane are ignored",
        check: lanes,
    },
    Rule { id: "codec-raw", section: "8", statement: "raw planes are read", check: codec_raw },
    Rule { id: "codec-rle", section: "8", statement: "RLE: every kind of token", check: codec_rle },
    Rule {
        id: "codec-rle-wrong",
        section: "8",
        statement: "RLE that gives less or more than a plane, or has bytes left over, is a damaged plane",
        check: codec_rle_wrong,
    },
    Rule { id: "codec-xor", section: "8", statement: "XOR + RLE of the base frame's plane", check: codec_xor },
    Rule {
        id: "codec-xor-base",
        section: "8",
        statement: "XOR of another base than the newest whole frame is incomplete",
        check: codec_xor_base,
    },
    Rule { id: "codec-lz4", section: "8", statement: "LZ4: one block", check: codec_lz4 },
    Rule {
        id: "codec-lz4-wrong",
        section: "8",
        statement: "an LZ4 block that gives less than a plane is a damaged plane",
        check: codec_lz4_wrong,
    },
    Rule {
        id: "codec-unnamed",
        section: "8",
        statement: "a codec that HELLO does not name is not read",
        check: codec_unnamed,
    },
];

/// Sends a frame that must not be whole: incomplete, and dark.
fn incomplete(b: &mut Bench<'_>, what: &str, spoil: impl FnOnce(&mut Bench<'_>, &mut Shot) -> R) -> R {
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
fn lit(b: &mut Bench<'_>, what: &str, make: impl FnOnce(&mut Bench<'_>, &mut Shot) -> R) -> R<Shot> {
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

fn plane_missing(b: &mut Bench<'_>) -> R {
    incomplete(b, "a plane too few", |_, shot| {
        shot.pieces.pop();
        Ok(())
    })
}

fn frame_abandoned(b: &mut Bench<'_>) -> R {
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
    check(s.last_lit_frame == whole.id && grew(&before, &s, |s| s.frames_seen) == 2, "two frames seen", || tell(&s))
}

fn frame_old(b: &mut Bench<'_>) -> R {
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

fn frame_wrap(b: &mut Bench<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    b.next_frame = u32::MAX;
    lit(b, "number 2^32 - 1", |_, _| Ok(()))?;
    let shot = lit(b, "number 0", |_, _| Ok(()))?;
    check(shot.id == 0, "0", || shot.id.to_string())?;
    lit(b, "number 1", |_, _| Ok(()))?;
    Ok(())
}

fn plane_again(b: &mut Bench<'_>) -> R {
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

fn plane_damaged(b: &mut Bench<'_>) -> R {
    incomplete(b, "a damaged plane", |_, shot| {
        shot.pieces[0].damaged = true;
        Ok(())
    })?;
    let s = b.report()?;
    check(s.payload_errors >= 1, "a damaged payload counted", || tell(&s))
}

fn plane_led(b: &mut Bench<'_>) -> R {
    incomplete(b, "another LED code", |_, shot| {
        shot.pieces[0].led = 0x27;
        Ok(())
    })
}

fn plane_target(b: &mut Bench<'_>) -> R {
    incomplete(b, "another target", |b, shot| {
        if shot.pieces.len() < 2 {
            return Err(Stop::NotJudged("its frames have one plane".into()));
        }
        let other = b.slots()?.start(shot.slot + 1).0;
        shot.pieces[1].target = other;
        Ok(())
    })
}

fn masks(b: &mut Bench<'_>) -> R {
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
    check(grew(&before, &s, |s| s.frames_lit) == 0 && !s.lit, "a plane in both masks: no light", || tell(&s))?;
    check(grew(&before, &s, |s| s.packets_ignored) >= 1, "FRAME_COMMIT counted as ignored", || tell(&s))
}

fn kept(b: &mut Bench<'_>) -> R {
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

fn kept_base(b: &mut Bench<'_>) -> R {
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

fn lanes(b: &mut Bench<'_>) -> R {
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

/// Sends a frame whose first plane is written by `codec`.
fn by_codec(b: &mut Bench<'_>, codec: Codec, what: &str, bytes: Vec<u8>) -> R {
    lit(b, what, |_, shot| {
        (shot.pieces[0].codec, shot.pieces[0].bytes) = (codec, bytes);
        Ok(())
    })
    .map(|_| ())
}

fn codec_raw(b: &mut Bench<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_raw()?;
    let plane = b.faint(0xa0);
    by_codec(b, Codec::Raw, "a raw plane", plane)
}

/// Not judged where the device does not name `codec`, or its planes are too short for it.
fn needs(b: &mut Bench<'_>, codec: Codec, least: usize) -> R {
    b.armed(|_| {})?;
    if !b.reads(codec) {
        return Err(Stop::NotJudged(format!("it does not name codec {}", codec as u8)));
    }
    if b.plane_bytes() < least {
        return Err(Stop::NotJudged(format!("its planes of {} bytes are too short", b.plane_bytes())));
    }
    b.needs_frames()
}

fn codec_rle(b: &mut Bench<'_>) -> R {
    needs(b, Codec::Rle, 8)?;
    let n = b.plane_bytes();
    // A short literal and a short run, then runs for the rest.
    let run = |out: &mut Vec<u8>, mut left: usize| {
        while left > 0 {
            let m = left.min(65_535 + 128);
            if m >= 128 {
                out.push(255);
                out.extend(((m - 128) as u16).to_le_bytes());
            } else {
                out.push((127 + m) as u8);
            }
            out.push(0);
            left -= m;
        }
    };
    let first = b.faint(0xc0)[0];
    let mut short = vec![1, first, 0];
    run(&mut short, n - 2);
    by_codec(b, Codec::Rle, "literals and runs", short)?;
    if n > 128 + 1 + 64 && b.carry_ns(400) < 200_000_000 {
        // The long literal of 130 bytes: 127, then 2.
        let mut long = vec![127, 2, 0, first];
        long.extend([0; 129]);
        run(&mut long, n - 130);
        if long.len() < n {
            by_codec(b, Codec::Rle, "a long literal", long)?;
        }
    }
    Ok(())
}

fn codec_rle_wrong(b: &mut Bench<'_>) -> R {
    needs(b, Codec::Rle, 8)?;
    let n = b.plane_bytes();
    let run = |m: usize| -> Vec<u8> {
        if m >= 128 {
            let m = (m - 128).min(65_535) as u16;
            vec![255, m.to_le_bytes()[0], m.to_le_bytes()[1], 0]
        } else {
            vec![(127 + m) as u8, 0]
        }
    };
    let full = |n: usize| -> Vec<u8> {
        let mut out = vec![0; n];
        let used = rle_encode(&vec![0; n], &mut out).unwrap_or(0);
        out.truncate(used);
        out
    };
    let over = [full(n), vec![0, 0]].concat();
    let more = [full(n - 2), run(8)].concat();
    let cut = [full(n - 4), vec![3, 0]].concat();
    for (what, bytes) in
        [("a byte less than a plane", full(n - 1)), ("bytes left over", over), ("a run beyond the plane", more), ("a token cut short", cut)]
    {
        if bytes.len() >= n {
            continue;
        }
        incomplete(b, what, |_, shot| {
            (shot.pieces[0].codec, shot.pieces[0].bytes) = (Codec::Rle, bytes);
            Ok(())
        })?;
    }
    Ok(())
}

fn codec_xor(b: &mut Bench<'_>) -> R {
    needs(b, Codec::XorRle, 8)?;
    let base = lit(b, "a frame", |_, _| Ok(()))?;
    let (_, bytes) = b.coded(&b.faint(0x80));
    if !b.reads(Codec::Rle) || bytes.len() >= b.plane_bytes() {
        return Err(Stop::NotJudged("no RLE shorter than its planes".into()));
    }
    lit(b, "XOR of the frame before", |_, shot| {
        (shot.pieces[0].codec, shot.pieces[0].bytes) = (Codec::XorRle, bytes);
        shot.commit.base_frame = base.id;
        Ok(())
    })?;
    Ok(())
}

fn codec_xor_base(b: &mut Bench<'_>) -> R {
    needs(b, Codec::XorRle, 8)?;
    let (codec, bytes) = b.coded(&b.faint(0x80));
    if codec != Codec::Rle {
        return Err(Stop::NotJudged("no RLE shorter than its planes".into()));
    }
    let base = lit(b, "a frame", |_, _| Ok(()))?;
    lit(b, "another", |_, _| Ok(()))?;
    let slot = b.slot_ahead()?;
    let before = b.report()?;
    let mut shot = b.shot(slot)?;
    (shot.pieces[0].codec, shot.pieces[0].bytes) = (Codec::XorRle, bytes);
    shot.commit.base_frame = base.id;
    b.send(&shot)?;
    let s = b.until_slot(slot)?;
    check(fates(&before, &s) == [0, 1, 0, 0, 0], "one frame incomplete", || tell(&s))
}

fn codec_lz4(b: &mut Bench<'_>) -> R {
    needs(b, Codec::Lz4, 32)?;
    let block = lz4_block(&b.faint(0xe0));
    if block.len() >= b.plane_bytes() {
        return Err(Stop::NotJudged("no block shorter than its planes".into()));
    }
    by_codec(b, Codec::Lz4, "a block with a match", block)
}

fn codec_lz4_wrong(b: &mut Bench<'_>) -> R {
    needs(b, Codec::Lz4, 40)?;
    let mut short = b.faint(0xe0);
    short.pop();
    let block = lz4_block(&short);
    if block.len() >= b.plane_bytes() {
        return Err(Stop::NotJudged("no block shorter than its planes".into()));
    }
    incomplete(b, "a byte less than a plane", |_, shot| {
        (shot.pieces[0].codec, shot.pieces[0].bytes) = (Codec::Lz4, block);
        Ok(())
    })
}

fn codec_unnamed(b: &mut Bench<'_>) -> R {
    b.armed(|_| {})?;
    let Some(codec) = [Codec::Rle, Codec::Lz4].into_iter().find(|c| !b.reads(*c)) else {
        return Err(Stop::NotJudged("it names all codecs".into()));
    };
    let plane = b.faint(0xe0);
    let mut bytes = vec![0; plane.len()];
    let n = if codec == Codec::Rle { rle_encode(&plane, &mut bytes) } else { None };
    let bytes = match n {
        Some(n) => bytes[..n].to_vec(),
        None => lz4_block(&plane),
    };
    if bytes.len() >= plane.len() {
        return Err(Stop::NotJudged("no coded plane shorter than its planes".into()));
    }
    incomplete(b, "a codec that was not named", |_, shot| {
        (shot.pieces[0].codec, shot.pieces[0].bytes) = (codec, bytes);
        Ok(())
    })
}
