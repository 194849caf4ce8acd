//! Codecs: what a device says that it reads, it reads, and nothing else.

use super::driver::{ConformanceDriver, R};
use super::planes::{incomplete, lit};
use super::shot::lz4_block;
use super::{check, fates, tell, Rule, Stop};
use dpm_device::link::{rle_encode, Codec};

pub(super) const RULES: &[Rule] = &[
    Rule { id: "codec-raw", section: "8", statement: "raw planes are read", check: codec_raw },
    Rule { id: "codec-rle", section: "8", statement: "RLE: every kind of token", check: codec_rle },
    Rule {
        id: "codec-rle-wrong",
        section: "8",
        statement: "RLE that gives less or more than a plane, or has bytes left over, is a damaged plane",
        check: codec_rle_wrong,
    },
    Rule {
        id: "codec-xor",
        section: "8",
        statement: "XOR + RLE of the base frame's plane",
        check: codec_xor,
    },
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

/// Sends a frame whose first plane is written by `codec`.
fn by_codec(b: &mut ConformanceDriver<'_>, codec: Codec, what: &str, bytes: Vec<u8>) -> R {
    lit(b, what, |_, shot| {
        (shot.pieces[0].codec, shot.pieces[0].bytes) = (codec, bytes);
        Ok(())
    })
    .map(|_| ())
}

fn codec_raw(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_raw()?;
    let plane = b.faint(0xa0);
    by_codec(b, Codec::Raw, "a raw plane", plane)
}

/// Not judged where the device does not name `codec`, or its planes are too short for it.
fn needs(b: &mut ConformanceDriver<'_>, codec: Codec, least: usize) -> R {
    b.armed(|_| {})?;
    if !b.reads(codec) {
        return Err(Stop::NotJudged(format!("it does not name codec {}", codec as u8)));
    }
    if b.plane_bytes() < least {
        return Err(Stop::NotJudged(format!("its planes of {} bytes are too short", b.plane_bytes())));
    }
    b.needs_frames()
}

fn codec_rle(b: &mut ConformanceDriver<'_>) -> R {
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
    if n > 129 + 16 && b.carry_ns(400) < 200_000_000 {
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

fn codec_rle_wrong(b: &mut ConformanceDriver<'_>) -> R {
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
    for (what, bytes) in [
        ("a byte less than a plane", full(n - 1)),
        ("bytes left over", over),
        ("a run beyond the plane", more),
        ("a token cut short", cut),
    ] {
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

fn codec_xor(b: &mut ConformanceDriver<'_>) -> R {
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

fn codec_xor_base(b: &mut ConformanceDriver<'_>) -> R {
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

fn codec_lz4(b: &mut ConformanceDriver<'_>) -> R {
    needs(b, Codec::Lz4, 32)?;
    let block = lz4_block(&b.faint(0xe0));
    if block.len() >= b.plane_bytes() {
        return Err(Stop::NotJudged("no block shorter than its planes".into()));
    }
    by_codec(b, Codec::Lz4, "a block with a match", block)
}

fn codec_lz4_wrong(b: &mut ConformanceDriver<'_>) -> R {
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

fn codec_unnamed(b: &mut ConformanceDriver<'_>) -> R {
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
