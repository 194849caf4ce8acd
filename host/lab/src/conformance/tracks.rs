//! Tracks: what moves the planes of a frame, as far as the counters of STATUS show it.
//!
//! Every rule lets tracks hold around the middle of one plane only, so that the counters say what became of that plane and
//! every other lit plane counts as stale.

use super::driver::{ConformanceDriver, R};
use super::shot::Shot;
use super::{check, grew, tell, Rule, Stop};
use dpm_device::link::{
    Area, Config, DeviceState, HostMessage, Region, Status, TrackCounts, Tracks, Underrun, MAX_SHIFT,
};
use dpm_device::planes::Raster;
use dpm_device::time::{DeviceTicks, FrameRate};

pub(super) const RULES: &[Rule] = &[
    Rule {
        id: "tracks-offered",
        section: "14",
        statement: "a device that offers to follow tracks names a greatest shift of 1 to 64 mirrors",
        check: offered,
    },
    Rule {
        id: "tracks-unasked",
        section: "14",
        statement: "without bit 1 in CONFIG, TRACKS are ignored and counted, and STATUS has no counters of tracks",
        check: unasked,
    },
    Rule {
        id: "tracks-silent",
        section: "14",
        statement: "TRACKS are counted as taken and never answered",
        check: silent,
    },
    Rule {
        id: "tracks-watchdog",
        section: "14",
        statement: "TRACKS feed the watchdog",
        check: watchdog,
    },
    Rule {
        id: "tracks-old",
        section: "14",
        statement: "TRACKS whose number is not newer than that of the last ones taken are refused and counted",
        check: old,
    },
    Rule {
        id: "tracks-outside",
        section: "14",
        statement: "TRACKS with a rectangle that is empty or leaves the raster are refused and counted",
        check: outside,
    },
    Rule {
        id: "tracks-gate",
        section: "14",
        statement: "a distance of half a mirror or more, and not below the gate, moves a plane, in either axis and sense",
        check: gate,
    },
    Rule {
        id: "tracks-motion",
        section: "14",
        statement: "velocity and acceleration add to the distance, for the time from `begin` to the plane's middle",
        check: motion,
    },
    Rule {
        id: "tracks-drawn",
        section: "14",
        statement: "the motion drawn adds to the distance, for the time by which the slot is after the frame's own",
        check: drawn,
    },
    Rule {
        id: "tracks-clamp",
        section: "14",
        statement: "no shift exceeds the clamp or the greatest shift of HELLO, and planes clamped are counted",
        check: clamp,
    },
    Rule {
        id: "tracks-window",
        section: "14",
        statement: "a plane whose middle is before `begin`, or later than TRACKS hold, is not moved and counts as stale",
        check: window,
    },
    Rule {
        id: "tracks-frame",
        section: "14",
        statement: "TRACKS of one frame change nothing about another",
        check: other_frame,
    },
    Rule {
        id: "tracks-newest",
        section: "14",
        statement: "newer TRACKS of a frame replace the older ones as a whole",
        check: newest,
    },
    Rule {
        id: "tracks-two-frames",
        section: "14",
        statement: "TRACKS of the frame on the mirrors and of one other frame are kept",
        check: two_frames,
    },
    Rule {
        id: "tracks-forgotten",
        section: "14",
        statement: "STOP and CONFIG forget the TRACKS that are kept",
        check: forgotten,
    },
    Rule {
        id: "tracks-age",
        section: "14",
        statement: "the greatest age is the time in ticks from `begin` to the middle of the last plane that followed",
        check: age,
    },
];

/// Why a device without tracks is not judged by the rules about them.
const NOT_OFFERED: &str = "its HELLO does not offer to follow tracks";
/// TRACKS that a device is sent in a row, to see whether it answers them.
const SENT: u32 = 16;
/// One mirror, in the unit of distances.
const MIRROR: i16 = 256;

/// The middle of a plane, and TRACKS that hold from 1 ms before it to 1 ms after it.
struct PlaneAim {
    middle: u64,
    tracks: Tracks,
}

impl ConformanceDriver<'_> {
    /// The greatest shift that HELLO offers.
    fn greatest_shift(&self) -> R<u8> {
        let offered = self.hello.and_then(|hello| hello.greatest_shift);
        offered.ok_or_else(|| Stop::NotJudged(NOT_OFFERED.into()))
    }

    /// A new session of a device that follows tracks, armed. Slots without a frame are blank: what a plane counts, it counts once.
    fn armed_to_follow(&mut self, change: impl FnOnce(&mut Config)) -> R {
        self.open()?;
        self.greatest_shift()?;
        self.armed(|config| {
            (config.tracks, config.underrun) = (true, Underrun::Blank);
            change(config);
        })?;
        self.needs_frames()
    }

    fn raster(&self) -> R<Raster> {
        self.hello.map(|hello| hello.raster).ok_or(Stop::Failed("no HELLO".into()))
    }

    /// A region of all mirrors with the greatest clamp, `offset` from its place.
    fn region(&self, offset: [i16; 2]) -> R<Region> {
        let raster = self.raster()?;
        let area = Area { left: 0, top: 0, width: raster.width() as u16, height: raster.height() as u16 };
        Ok(Region { area, clamp: MAX_SHIFT, offset, ..Region::default() })
    }

    /// Around the middle of plane `plane` of the slot `slot`, for `frame`, without a region.
    fn aim(&self, frame: u32, slot: u64, plane: u64) -> R<PlaneAim> {
        let (start, end) = (self.slots()?.start(slot).0, self.slots()?.start(slot + 1).0);
        let halves = u128::from(end - start) * u128::from(2 * plane + 1);
        let middle = start + (halves / u128::from(2 * self.planes())) as u64;
        let begin = middle - self.tick_hz() / 1000;
        Ok(PlaneAim { middle, tracks: Tracks::new(frame, 0, DeviceTicks(begin), 2000) })
    }

    /// Planes of a frame.
    fn planes(&self) -> u64 {
        self.config.map_or(1, |config| config.schedule.len() as u64)
    }

    /// Sends `tracks` under the next number.
    fn say_tracks(&mut self, tracks: Tracks) -> R {
        // Every packet raises the count, and numbers need only rise.
        let number = self.packets_sent.wrapping_add(1);
        self.say(&HostMessage::Tracks(tracks.numbered(number)))
    }
}

/// The counters of tracks.
fn counts(s: &Status) -> R<TrackCounts> {
    s.tracks.ok_or_else(|| {
        Stop::Failed("expected a STATUS of 120 bytes after CONFIG asked for tracks, saw 96".into())
    })
}

/// TRACKS in a few words.
fn told(c: &TrackCounts) -> String {
    format!(
        "TRACKS {} taken, {} refused; planes {} moved, {} clamped, {} stale; greatest age {}",
        c.taken, c.refused, c.planes_moved, c.planes_clamped, c.planes_stale, c.greatest_age
    )
}

/// Planes moved, clamped and stale between two reports.
fn became(before: &Status, after: &Status) -> R<[u32; 3]> {
    let of = |c: TrackCounts| [c.planes_moved, c.planes_clamped, c.planes_stale];
    let (a, b) = (of(counts(before)?), of(counts(after)?));
    Ok(std::array::from_fn(|i| b[i].wrapping_sub(a[i])))
}

/// Lights a frame whose planes follow what `send` sends, and says what became of them by the end of the slot `slots` after its
/// own: planes moved, clamped, and stale.
fn followed(
    b: &mut ConformanceDriver<'_>,
    slots: u64,
    send: impl FnOnce(&mut ConformanceDriver<'_>, &Shot) -> R,
) -> R<[u32; 3]> {
    let slot = b.slot_ahead()? + 1;
    let before = b.report()?;
    let shot = b.send_for(slot)?;
    send(b, &shot)?;
    let after = b.until_slot(slot + 1 + slots)?;
    check(grew(&before, &after, |s| s.frames_lit) == 1, "the frame lit", || tell(&after))?;
    became(&before, &after)
}

/// The same for one region around the middle of plane 0 in the frame's own slot. The others are stale.
fn judge_region(b: &mut ConformanceDriver<'_>, what: &str, region: Region, moved: u32, clamped: u32) -> R {
    let stale = b.planes() as u32 - 1;
    let seen = followed(b, 0, |b, shot| {
        let mut tracks = b.aim(shot.id, shot.slot, 0)?.tracks;
        tracks.push(region);
        b.say_tracks(tracks)
    })?;
    judge(what, seen, [moved, clamped, stale])
}

fn judge(what: &str, seen: [u32; 3], expected: [u32; 3]) -> R {
    let of = |[moved, clamped, stale]: [u32; 3]| format!("{moved} moved, {clamped} clamped, {stale} stale");
    check(seen == expected, &format!("{what}: planes {}", of(expected)), || of(seen))
}

fn offered(b: &mut ConformanceDriver<'_>) -> R {
    b.open()?;
    let most = b.greatest_shift()?;
    check((1..=MAX_SHIFT).contains(&most), "a greatest shift of 1 to 64", || most.to_string())
}

fn unasked(b: &mut ConformanceDriver<'_>) -> R {
    b.open()?;
    b.greatest_shift()?;
    b.configured(|_| {})?;
    let before = b.report()?;
    b.say_tracks(Tracks::new(1, 0, DeviceTicks(0), 1000))?;
    let after = b.report()?;
    check(before.tracks.is_none() && after.tracks.is_none(), "a STATUS of 96 bytes", || "120".into())?;
    check(grew(&before, &after, |s| s.packets_ignored) == 1, "TRACKS counted as ignored", || tell(&after))
}

/// Sends `n` TRACKS one after the other, and counts what the device says meanwhile.
fn messages_after(b: &mut ConformanceDriver<'_>, n: u32) -> R<usize> {
    b.forget()?;
    b.feed = false;
    let (mut heard, step_ns) = (0, b.answer_ns() / 4 / i64::from(SENT));
    for k in 0..SENT {
        if k < n {
            b.say_tracks(Tracks::new(1, 0, DeviceTicks(0), 1000))?;
        }
        b.wait(step_ns, |_| {
            heard += 1;
            None::<()>
        })?;
    }
    b.feed = true;
    Ok(heard)
}

fn silent(b: &mut ConformanceDriver<'_>) -> R {
    b.open()?;
    b.greatest_shift()?;
    b.configured(|config| config.tracks = true)?;
    let before = b.report()?;
    // A device may send STATUS whenever it likes, so what it says by itself is counted first. It is not armed, so that no
    // slot makes it speak.
    let alone = messages_after(b, 0)?;
    let asked = messages_after(b, SENT)?;
    check(asked < alone + SENT as usize / 2, &format!("no answer to {SENT} TRACKS"), || {
        format!("{asked} messages, and {alone} in the same time before")
    })?;
    let after = b.report()?;
    let (a, c) = (counts(&before)?, counts(&after)?);
    check(c.taken == a.taken + SENT && c.refused == a.refused, "all TRACKS taken", || told(&c))?;
    check(after.packets_ignored == before.packets_ignored, "none ignored", || tell(&after))
}

fn watchdog(b: &mut ConformanceDriver<'_>) -> R {
    const BITE_US: u32 = 200_000;
    b.armed_to_follow(|config| config.watchdog_us = BITE_US)?;
    b.feed = false;
    for _ in 0..12 {
        b.say_tracks(Tracks::new(1, 0, DeviceTicks(0), 1000))?;
        b.pass(i64::from(BITE_US) * 1000 / 4)?;
    }
    b.feed = true;
    let s = b.report()?;
    check(s.state == DeviceState::Armed && s.faults == 0, "armed after three watchdogs' time", || tell(&s))
}

/// Sends TRACKS that must be refused.
fn refused(b: &mut ConformanceDriver<'_>, what: &str, tracks: Tracks) -> R {
    let before = b.report()?;
    b.say(&HostMessage::Tracks(tracks))?;
    let after = b.report()?;
    let (a, c) = (counts(&before)?, counts(&after)?);
    check(
        c.refused == a.refused + 1 && c.taken == a.taken,
        &format!("{what}: one TRACKS refused, none taken"),
        || told(&c),
    )?;
    check(grew(&before, &after, |s| s.packets_ignored) == 1, &format!("{what}: one packet ignored"), || {
        tell(&after)
    })
}

fn old(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_follow(|_| {})?;
    let base = Tracks::new(1, 0, DeviceTicks(0), 1000);
    b.say(&HostMessage::Tracks(base.numbered(7)))?;
    refused(b, "the same number again", base.numbered(7))?;
    refused(b, "an older number", base.numbered(6))?;
    let before = counts(&b.report()?)?;
    b.say(&HostMessage::Tracks(base.numbered(8)))?;
    let after = counts(&b.report()?)?;
    check(after.taken == before.taken + 1, "a newer number taken", || told(&after))
}

fn outside(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_follow(|_| {})?;
    let whole = b.region([0; 2])?;
    let Area { width, height, .. } = whole.area;
    let wrong = [
        ("no columns", Area { width: 0, ..whole.area }),
        ("no rows", Area { height: 0, ..whole.area }),
        ("a column too many", Area { left: 1, width, ..whole.area }),
        ("a row too many", Area { top: 1, height, ..whole.area }),
        ("columns that wrap", Area { left: u16::MAX, width: 2, ..whole.area }),
    ];
    for (number, (what, area)) in (1..).zip(wrong) {
        let mut tracks = Tracks::new(1, number, DeviceTicks(0), 1000);
        // Behind one that is right: none of the message may be obeyed.
        tracks.push(whole);
        tracks.push(Region { area, ..whole });
        refused(b, what, tracks)?;
    }
    Ok(())
}

fn gate(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_follow(|_| {})?;
    let of = |b: &ConformanceDriver<'_>, offset, gate| Ok(Region { gate, ..b.region(offset)? });
    for (offset, least, moved) in [
        ([128, 0], 0, 1),
        ([-128, 0], 0, 1),
        ([0, 128], 0, 1),
        ([0, -128], 0, 1),
        ([127, -127], 0, 0),
        ([300, -300], 301, 0),
        ([0, -300], 300, 1),
    ] {
        let region = of(b, offset, least)?;
        judge_region(b, &format!("offset {offset:?}, gate {least}"), region, moved, 0)?;
    }
    Ok(())
}

fn motion(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_follow(|_| {})?;
    // The plane's middle is 1 ms after `begin`.
    for (offset, velocity, half_acceleration, moved) in [
        ([0, 0], [200, 0], [0, 0], 1),
        ([0, 0], [0, 0], [0, -200], 1),
        ([0, 0], [100, 100], [0, 0], 0),
        ([200, 0], [-100, 0], [0, 0], 0),
        ([0, -200], [0, 50], [0, 50], 0),
        ([0, 50], [0, 50], [0, 50], 1),
    ] {
        let region = Region { velocity, half_acceleration, ..b.region(offset)? };
        let what =
            format!("offset {offset:?}, velocity {velocity:?}, half acceleration {half_acceleration:?}");
        judge_region(b, &what, region, moved, 0)?;
    }
    Ok(())
}

fn drawn(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_follow(|config| config.underrun = Underrun::Repeat)?;
    // A slot lasts 20 ms at least, in which this is a mirror and a half.
    let region = Region { drawn: [20, 0], ..b.region([0; 2])? };
    for (slots, moved) in [(0, 0), (1, 1)] {
        let what = format!("{slots} slots after the frame's own");
        // The slot that has just begun counts stale planes, too, so that only those that moved are judged.
        let seen = followed(b, slots, |b, shot| {
            let mut tracks = b.aim(shot.id, shot.slot + slots, 0)?.tracks;
            tracks.push(region);
            b.say_tracks(tracks)
        })?;
        check(seen[0] == moved, &format!("{what}: {moved} planes moved"), || seen[0].to_string())?;
    }
    Ok(())
}

fn clamp(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_follow(|_| {})?;
    let most = i16::from(b.greatest_shift()?);
    let far = b.region([5 * MIRROR, 0])?;
    judge_region(b, "five mirrors, clamp 1", Region { clamp: 1, ..far }, 1, 1)?;
    judge_region(b, "five mirrors, clamp 0", Region { clamp: 0, ..far }, 0, 1)?;
    let greatest = b.region([0, -most * MIRROR])?;
    judge_region(b, "the greatest shift", greatest, 1, 0)?;
    let beyond = b.region([0, (most + 1) * MIRROR])?;
    judge_region(b, "a mirror more than the greatest shift", Region { clamp: u8::MAX, ..beyond }, 1, 1)
}

fn window(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_follow(|_| {})?;
    let region = b.region([MIRROR, 0])?;
    let planes = b.planes() as u32;
    let ms = b.tick_hz() / 1000;
    for (what, begin_ms, lasts_us, moved) in [
        ("from 1 ms before its middle for 2 ms", -1, 2000, 1),
        ("from 1 ms after its middle", 1, 1000, 0),
        ("from 3 ms before its middle for 2 ms", -3, 2000, 0),
    ] {
        let seen = followed(b, 0, |b, shot| {
            let middle = b.aim(shot.id, shot.slot, 0)?.middle;
            let begin = middle.saturating_add_signed(begin_ms * ms as i64);
            let mut tracks = Tracks::new(shot.id, 0, DeviceTicks(begin), lasts_us);
            tracks.push(region);
            b.say_tracks(tracks)
        })?;
        judge(&format!("{what} of plane 0"), seen, [moved, 0, planes - moved])?;
    }
    Ok(())
}

fn other_frame(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_follow(|_| {})?;
    let region = b.region([MIRROR, 0])?;
    let seen = followed(b, 0, |b, shot| {
        let mut tracks = b.aim(shot.id.wrapping_add(1), shot.slot, 0)?.tracks;
        tracks.push(region);
        b.say_tracks(tracks)
    })?;
    judge("TRACKS of the next frame", seen, [0; 3])
}

fn newest(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_follow(|_| {})?;
    let region = b.region([MIRROR, 0])?;
    let stale = b.planes() as u32 - 1;
    for (first, second, moved) in [(true, false, 0), (false, true, 1)] {
        let seen = followed(b, 0, |b, shot| {
            for moves in [first, second] {
                let mut tracks = b.aim(shot.id, shot.slot, 0)?.tracks;
                if moves {
                    tracks.push(region);
                }
                b.say_tracks(tracks)?;
            }
            Ok(())
        })?;
        let what = if second { "a region only in the newer ones" } else { "a region only in the older ones" };
        judge(what, seen, [moved, 0, stale])?;
    }
    Ok(())
}

fn two_frames(b: &mut ConformanceDriver<'_>) -> R {
    // Half a second a slot: TRACKS of the next frame arrive while the last plane of the one on the mirrors is still to come.
    b.armed_to_follow(|config| config.rate = FrameRate::new(2, 1).unwrap_or(config.rate))?;
    let region = b.region([MIRROR, 0])?;
    let slot = b.slot_ahead()?;
    let before = b.report()?;
    let (first, second) = (b.send_for(slot)?, b.send_for(slot + 1)?);
    let mut of_first = b.aim(first.id, slot, b.planes() - 1)?.tracks;
    of_first.push(region);
    b.say_tracks(of_first)?;
    b.until_slot(slot)?;
    let mut of_second = b.aim(second.id, slot + 1, 0)?.tracks;
    of_second.push(region);
    b.say_tracks(of_second)?;
    let after = b.until_slot(slot + 2)?;
    check(grew(&before, &after, |s| s.frames_lit) == 2, "both frames lit", || tell(&after))?;
    let seen = became(&before, &after)?;
    judge("one plane of either frame", seen, [2, 0, 2 * (b.planes() as u32 - 1)])
}

fn forgotten(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_follow(|_| {})?;
    let region = b.region([MIRROR, 0])?;
    for order in ["STOP", "CONFIG"] {
        // For the next frame, whose number is known.
        let slot = b.slot_ahead()? + 2;
        let mut tracks = b.aim(b.next_frame, slot, 0)?.tracks;
        tracks.push(region);
        b.say_tracks(tracks)?;
        if order == "STOP" {
            b.say(&HostMessage::Stop)?;
            b.report()?;
        } else if let Some(config) = b.config {
            b.configure(&config)?;
        }
        b.arm()?;
        // If they were kept, the frame's planes count as moved or as stale, whichever its slot is.
        let seen = followed(b, 0, |_, _| Ok(()))?;
        judge(&format!("after {order}"), seen, [0; 3])?;
    }
    Ok(())
}

fn age(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_follow(|_| {})?;
    let mut expected = 0;
    followed(b, 0, |b, shot| {
        let aim = b.aim(shot.id, shot.slot, b.planes() - 1)?;
        expected = aim.middle - aim.tracks.begin.0;
        b.say_tracks(aim.tracks)
    })?;
    let seen = counts(&b.report()?)?;
    check(
        u64::from(seen.greatest_age).abs_diff(expected) <= 2,
        &format!("a greatest age of {expected} ticks"),
        || told(&seen),
    )
}
