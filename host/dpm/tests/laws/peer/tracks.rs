//! Tracks: which planes the device moves, by how much, and what it counts. Written from section 14 of docs/PROTOCOL.md.

use super::wire::{u16_at, u32_at, u64_at};
use super::{Config, Peer, HEIGHT, HZ, WIDTH};

/// The greatest shift that HELLO offers, mirrors.
const GREATEST_SHIFT: u8 = 6;

struct Region {
    clamp: u8,
    gate: i64,
    /// Offset, velocity, half acceleration and motion drawn, along both axes.
    motion: [[i64; 2]; 4],
}

struct Tracks {
    frame: u32,
    number: u32,
    begin: u64,
    lasts_us: u64,
    regions: Vec<Region>,
}

/// A slot in which a frame is lit.
struct LitSlot {
    frame: u32,
    start: u64,
    ticks: u64,
    late_us: u64,
    next: u64,
    greatest_age: u32,
}

#[derive(Default)]
pub(super) struct Following {
    /// Of two frames at most, the newest last.
    kept: Vec<Tracks>,
    newest: Option<u32>,
    /// Taken, refused, moved, clamped, stale, greatest age.
    counts: [u32; 6],
    slot: Option<LitSlot>,
}

impl Following {
    /// Forgets the tracks that are kept, not what was counted.
    pub(super) fn forget(&mut self) {
        self.kept.clear();
        self.slot = None;
    }
}

impl Region {
    fn shift(&self, axis: usize, us: i64, late_us: i64, gated: bool) -> i64 {
        let [offset, velocity, half, drawn] = self.motion.map(|of| of[axis]);
        let distance =
            offset + (1000 * (velocity * us + drawn * late_us) + half * us * us).div_euclid(1_000_000);
        let least = if gated { self.gate.max(128) } else { 128 };
        if distance.abs() < least {
            0
        } else {
            distance.signum() * ((distance.abs() + 128) / 256)
        }
    }
}

/// The regions of a TRACKS payload; `None` if a rectangle is empty or leaves the raster.
fn regions(p: &[u8], any: bool) -> Option<Vec<Region>> {
    let pair = |r: &[u8], at| [u16_at(r, at), u16_at(r, at + 2)].map(|v| i64::from(v as i16));
    p.chunks(28)
        .map(|r| {
            let [left, top, width, height] = [0, 2, 4, 6].map(|at| u32::from(u16_at(r, at)));
            let fits = left + width <= u32::from(WIDTH) && top + height <= u32::from(HEIGHT);
            (any || fits && width > 0 && height > 0).then(|| Region {
                clamp: r[8],
                gate: i64::from(u16_at(r, 10)),
                motion: [12, 16, 20, 24].map(|at| pair(r, at)),
            })
        })
        .collect()
}

impl Peer {
    fn follows(&self) -> bool {
        self.config.as_ref().is_some_and(|c| c.tracks || self.breaks("tracks-unasked"))
    }

    /// Bytes 14 and 15 of HELLO.
    pub(super) fn offer(&self) -> [u8; 2] {
        [1, if self.breaks("tracks-offered") { 0 } else { GREATEST_SHIFT }]
    }

    /// The end of STATUS.
    pub(super) fn track_counts(&self) -> Vec<u8> {
        let counts = self.follows().then_some(self.following.counts);
        counts.into_iter().flatten().flat_map(u32::to_le_bytes).collect()
    }

    pub(super) fn tracks(&mut self, p: &[u8]) {
        let length = p.len() >= 24 && p[20] <= 8 && p.len() == 24 + 28 * usize::from(p[20]);
        if !length || !(1..=20_000).contains(&u32_at(p, 16)) || !self.follows() {
            self.n.ignored += 1;
            return;
        }
        self.say_status |= self.breaks("tracks-silent");
        let number = u32_at(p, 4);
        let is_newer = self.following.newest.is_none_or(|n| (number.wrapping_sub(n) as i32) > 0);
        let regions = regions(&p[24..], self.breaks("tracks-outside"));
        let Some(regions) = regions.filter(|_| is_newer || self.breaks("tracks-old")) else {
            self.following.counts[1] += 1;
            self.n.ignored += 1;
            return;
        };
        let frame = u32_at(p, 0);
        let tracks = Tracks { frame, number, begin: u64_at(p, 8), lasts_us: u32_at(p, 16).into(), regions };
        self.following.counts[0] += 1;
        self.following.newest = Some(tracks.number);
        let kept = &mut self.following.kept;
        if kept.iter().any(|t| t.frame == frame) && self.fault == "tracks-newest" {
            return;
        }
        kept.retain(|t| t.frame != frame);
        kept.push(tracks);
        let most = if self.breaks("tracks-two-frames") { 1 } else { 2 };
        if self.following.kept.len() > most {
            // Those of the frame on the mirrors stay.
            let lit = self.shown.as_ref().map(|w| w.frame);
            let goes = usize::from(most == 2 && self.following.kept.first().map(|t| t.frame) == lit);
            self.following.kept.remove(goes);
        }
    }

    /// A slot begins. Its planes are lit one after the other if there is light.
    pub(super) fn begin_planes(&mut self, config: &Config, slot: u64) {
        let start = config.start(slot);
        let shown = self.shown.as_ref().filter(|_| self.light && self.follows());
        self.following.slot = shown.map(|w| LitSlot {
            frame: w.frame,
            start,
            ticks: config.start(slot + 1) - start,
            late_us: (start - config.start(w.slot)) * 1_000_000 / HZ,
            next: 0,
            greatest_age: 0,
        });
    }

    /// Lights the planes that begin up to `now`.
    pub(super) fn light_planes(&mut self, now: u64) {
        let planes = self.config.as_ref().map_or(0, |c| c.leds.len() as u64);
        while let Some(mut slot) = self.following.slot.take().filter(|s| self.light && s.next < planes) {
            let at = |halves: u64| slot.start + slot.ticks * halves / (2 * planes);
            let (begin, middle) = (at(2 * slot.next), at(2 * slot.next + 1));
            if begin > now {
                self.following.slot = Some(slot);
                return;
            }
            slot.next += 1;
            if let Some(age) = self.light_plane(&slot, middle) {
                let from = if self.breaks("tracks-age") { middle - begin } else { 0 };
                slot.greatest_age = slot.greatest_age.max(age.saturating_sub(from) as u32);
            }
            if slot.next == planes {
                self.following.counts[5] = slot.greatest_age;
            }
            self.following.slot = Some(slot);
        }
    }

    /// The age of the tracks that the plane follows; `None` if it follows none.
    fn light_plane(&mut self, slot: &LitSlot, middle: u64) -> Option<u64> {
        let any = self.breaks("tracks-frame");
        let tracks = self.following.kept.iter().rev().find(|t| t.frame == slot.frame || any)?;
        let age = middle.checked_sub(tracks.begin);
        let us = age.map(|age| age * 1_000_000 / HZ).filter(|us| *us <= tracks.lasts_us);
        let us = if self.breaks("tracks-window") { us.or(Some(0)) } else { us };
        let Some(us) = us else {
            self.following.counts[4] += 1;
            return None;
        };
        let us = if self.breaks("tracks-motion") { 0 } else { us as i64 };
        let late_us = if self.breaks("tracks-drawn") { 0 } else { slot.late_us as i64 };
        let (mut moved, mut clamped) = (false, false);
        for region in &tracks.regions {
            let most =
                i64::from(if self.breaks("tracks-clamp") { 99 } else { region.clamp.min(GREATEST_SHIFT) });
            for axis in [0, 1] {
                let shift = region.shift(axis, us, late_us, !self.breaks("tracks-gate"));
                moved |= shift.abs().min(most) > 0;
                clamped |= shift.abs() > most;
            }
        }
        self.following.counts[2] += u32::from(moved);
        self.following.counts[3] += u32::from(clamped);
        Some(age.unwrap_or(0))
    }
}
