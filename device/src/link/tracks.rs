//! Tracks: by how many mirrors a device moves parts of a frame's planes, because the host knows more of the motion by now
//! than when it drew the frame.
//!
//! [`Tracks`] is the content of a TRACKS message, [`Tracks::moves_at`] its value for one plane, [`move_plane`] what the plane
//! becomes. docs/PROTOCOL.md, section 14, is the specification. Nothing here allocates, and no field of a message can
//! make an access leave the plane.

use super::message::PayloadError;
use crate::packet::{u16_at, u32_at, u64_at, MessageType};
use crate::planes::Raster;
use crate::time::DeviceTicks;

/// Most regions of a TRACKS message.
pub const MAX_REGIONS: usize = 8;
/// Longest time for which a track may hold, microseconds.
pub const MAX_TRACK_US: u32 = 20_000;
/// The greatest shift that any device may offer, mirrors.
pub const MAX_SHIFT: u8 = 64;
/// Length of a TRACKS payload without its regions.
pub(super) const TRACKS_BYTES: usize = 24;
/// Length of a region.
pub(super) const REGION_BYTES: usize = 28;
/// Half a mirror, in the unit of distances: below it no shift brings light nearer to its place.
const HALF_MIRROR: u64 = 128;

/// A rectangle of mirrors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Area {
    /// First column.
    pub left: u16,
    /// First row.
    pub top: u16,
    /// Columns, at least 1.
    pub width: u16,
    /// Rows, at least 1.
    pub height: u16,
}

impl Area {
    /// True if every mirror of the rectangle exists, and there is at least one.
    pub const fn fits(self, raster: Raster) -> bool {
        self.width > 0
            && self.height > 0
            && self.left as u32 + self.width as u32 <= raster.width()
            && self.top as u32 + self.height as u32 <= raster.height()
    }

    /// True if the mirror in column `x` and row `y` belongs to the rectangle.
    pub const fn contains(self, x: i64, y: i64) -> bool {
        let (left, top) = (self.left as i64, self.top as i64);
        x >= left && x < left + self.width as i64 && y >= top && y < top + self.height as i64
    }

    /// The mirrors of the rectangle among the eight of byte `byte` of row `y`, as bits.
    fn bits(self, y: i64, byte: i64) -> u8 {
        let first = byte * 8;
        let from = (i64::from(self.left) - first).clamp(0, 8);
        let to = (i64::from(self.left) + i64::from(self.width) - first).clamp(0, 8);
        if from >= to || !self.contains(i64::from(self.left), y) {
            return 0;
        }
        ((0xff_u16 >> from) & !(0xff_u16 >> to)) as u8
    }
}

/// How the light of one region should move. Distances are in 1/256 mirror, to the right and downwards; time is in
/// milliseconds from [`Tracks::begin`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Region {
    /// The mirrors that may move.
    pub area: Area,
    /// Greatest shift, mirrors. A device may stop at a smaller one, which it says in HELLO.
    pub clamp: u8,
    /// The least distance that moves anything, 1/256 mirror; less than half a mirror counts as half.
    pub gate: u16,
    /// How far the light is from its place at `begin`.
    pub offset: [i16; 2],
    /// The change of that distance, for each millisecond.
    pub velocity: [i16; 2],
    /// Half of the change of `velocity`, for each millisecond.
    pub half_acceleration: [i16; 2],
    /// The motion for which the planes were drawn, for each millisecond by which the frame is lit after its target slot.
    pub drawn: [i16; 2],
}

impl Region {
    /// The distance along an axis, `us` after `begin`, in a slot that begins `late_us` after the frame's target slot.
    fn distance(&self, axis: usize, us: i64, late_us: i64) -> i64 {
        let [velocity, half, drawn] =
            [self.velocity, self.half_acceleration, self.drawn].map(|of: [i16; 2]| i64::from(of[axis]));
        let changed = 1000 * (velocity * us + drawn * late_us) + half * us * us;
        i64::from(self.offset[axis]) + changed.div_euclid(1_000_000)
    }

    /// The shift for a distance, and whether it was clamped.
    fn shift(&self, distance: i64, most: u8) -> (i8, bool) {
        let size = distance.unsigned_abs();
        if size < u64::from(self.gate).max(HALF_MIRROR) {
            return (0, false);
        }
        let mirrors = (size + HALF_MIRROR) / 256;
        let most = u64::from(self.clamp.min(most).min(MAX_SHIFT));
        let shift = mirrors.min(most) as i8;
        (if distance < 0 { -shift } else { shift }, mirrors > most)
    }

    fn parse(p: &[u8]) -> Self {
        let pair = |at| [u16_at(p, at) as i16, u16_at(p, at + 2) as i16];
        Self {
            area: Area { left: u16_at(p, 0), top: u16_at(p, 2), width: u16_at(p, 4), height: u16_at(p, 6) },
            clamp: p[8],
            gate: u16_at(p, 10),
            offset: pair(12),
            velocity: pair(16),
            half_acceleration: pair(20),
            drawn: pair(24),
        }
    }

    fn write(&self, out: &mut [u8]) {
        let Area { left, top, width, height } = self.area;
        let words = [left, top, width, height, u16::from(self.clamp), self.gate];
        let pairs = [self.offset, self.velocity, self.half_acceleration, self.drawn];
        let all = words.into_iter().chain(pairs.into_iter().flatten().map(|v| v as u16));
        for (to, word) in out.chunks_exact_mut(2).zip(all) {
            to.copy_from_slice(&word.to_le_bytes());
        }
    }
}

/// TRACKS: where the light of one frame should be by what the host knows now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tracks {
    /// The frame for which they hold, modulo 2^32: its planes alone are moved.
    pub frame: u32,
    /// Counts the TRACKS of the session: the newest wins.
    pub number: u32,
    /// The instant from which they hold, and at which the host made them.
    pub begin: DeviceTicks,
    /// For how long they hold, microseconds, 1 to [`MAX_TRACK_US`].
    pub lasts_us: u32,
    regions: [Region; MAX_REGIONS],
    len: u8,
}

impl Tracks {
    /// Tracks without a region.
    pub const fn new(frame: u32, number: u32, begin: DeviceTicks, lasts_us: u32) -> Self {
        let none = Area { left: 0, top: 0, width: 0, height: 0 };
        let still = [0; 2];
        let region = Region {
            area: none,
            clamp: 0,
            gate: 0,
            offset: still,
            velocity: still,
            half_acceleration: still,
            drawn: still,
        };
        Self { frame, number, begin, lasts_us, regions: [region; MAX_REGIONS], len: 0 }
    }

    /// The same under another number.
    pub const fn numbered(self, number: u32) -> Self {
        Self { number, ..self }
    }

    /// Adds a region behind those that are there. False if there is no room.
    pub fn push(&mut self, region: Region) -> bool {
        let Some(place) = self.regions.get_mut(usize::from(self.len)) else { return false };
        *place = region;
        self.len += 1;
        true
    }

    /// The regions. A mirror in several of them belongs to the first.
    pub fn regions(&self) -> &[Region] {
        &self.regions[..usize::from(self.len)]
    }

    /// True if all regions lie on the raster.
    pub fn fits(&self, raster: Raster) -> bool {
        self.regions().iter().all(|region| region.area.fits(raster))
    }

    /// True if they hold at `instant` of a clock of `tick_hz` ticks a second.
    pub fn holds_at(&self, instant: DeviceTicks, tick_hz: u32) -> bool {
        self.age_us(instant, tick_hz).is_some()
    }

    /// Microseconds from `begin` to `instant`; `None` if they do not hold then.
    fn age_us(&self, instant: DeviceTicks, tick_hz: u32) -> Option<i64> {
        let ticks = instant.0.checked_sub(self.begin.0)?;
        let us = u128::from(ticks) * 1_000_000 / u128::from(tick_hz.max(1));
        (us <= u128::from(self.lasts_us)).then_some(us as i64)
    }

    /// The shifts of a plane whose middle is at `instant`, in a slot that begins `late_us` after the frame's target slot, on
    /// a device that shifts by `most` mirrors at most. `None` if the tracks do not hold then: nothing is moved.
    pub fn moves_at(&self, instant: DeviceTicks, tick_hz: u32, late_us: u32, most: u8) -> Option<Moves> {
        let us = self.age_us(instant, tick_hz)?;
        let mut moves = Moves::NONE;
        for region in self.regions() {
            let mut shift = [0; 2];
            for (axis, shift) in shift.iter_mut().enumerate() {
                let distance = region.distance(axis, us, i64::from(late_us));
                let (mirrors, was_clamped) = region.shift(distance, most);
                *shift = mirrors;
                moves.was_clamped |= was_clamped;
            }
            moves.all[usize::from(moves.len)] = Move { area: region.area, shift };
            moves.len += 1;
        }
        Some(moves)
    }

    pub(super) fn parse(p: &[u8]) -> Result<Self, PayloadError> {
        let kind = MessageType::Tracks;
        let length = |expected| Err(PayloadError::Length { kind, expected, got: p.len() });
        if p.len() < TRACKS_BYTES {
            return length(TRACKS_BYTES);
        }
        let count = usize::from(p[20]);
        let field = |field| Err(PayloadError::Field { kind, field });
        if count > MAX_REGIONS {
            return field("regions");
        }
        if p.len() != TRACKS_BYTES + REGION_BYTES * count {
            return length(TRACKS_BYTES + REGION_BYTES * count);
        }
        let mut tracks = Self::new(u32_at(p, 0), u32_at(p, 4), DeviceTicks(u64_at(p, 8)), u32_at(p, 16));
        if tracks.lasts_us == 0 || tracks.lasts_us > MAX_TRACK_US {
            return field("lasts");
        }
        for region in p[TRACKS_BYTES..].chunks_exact(REGION_BYTES) {
            tracks.push(Region::parse(region));
        }
        Ok(tracks)
    }

    /// Writes the payload into `out`, which is long enough for every message; returns its length.
    pub(super) fn write(&self, out: &mut [u8]) -> usize {
        out[..4].copy_from_slice(&self.frame.to_le_bytes());
        out[4..8].copy_from_slice(&self.number.to_le_bytes());
        out[8..16].copy_from_slice(&self.begin.0.to_le_bytes());
        out[16..20].copy_from_slice(&self.lasts_us.to_le_bytes());
        out[20..TRACKS_BYTES].copy_from_slice(&[self.len, 0, 0, 0]);
        let n = TRACKS_BYTES + REGION_BYTES * usize::from(self.len);
        for (to, region) in out[TRACKS_BYTES..n].chunks_exact_mut(REGION_BYTES).zip(self.regions()) {
            region.write(to);
        }
        n
    }
}

/// The shift of one rectangle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Move {
    /// Which mirrors.
    pub area: Area,
    /// By how many mirrors to the right and downwards.
    pub shift: [i8; 2],
}

/// The shifts of one plane.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Moves {
    all: [Move; MAX_REGIONS],
    len: u8,
    /// A shift would have been greater than its clamp.
    pub was_clamped: bool,
}

impl Moves {
    /// Nothing moves.
    pub const NONE: Self = Self {
        all: [Move { area: Area { left: 0, top: 0, width: 0, height: 0 }, shift: [0; 2] }; MAX_REGIONS],
        len: 0,
        was_clamped: false,
    };

    /// The shifts in the order of the regions. A mirror in several rectangles belongs to the first.
    pub fn all(&self) -> &[Move] {
        &self.all[..usize::from(self.len)]
    }

    /// True if a mirror may change.
    pub fn is_any(&self) -> bool {
        self.all().iter().any(|one| one.shift != [0; 2])
    }

    /// The shift of the mirror in column `x` and row `y`; 0 outside all regions.
    pub fn of_mirror(&self, x: i64, y: i64) -> [i8; 2] {
        self.all().iter().find(|one| one.area.contains(x, y)).map_or([0; 2], |one| one.shift)
    }

    /// The mirrors that belong to region `region` among the eight of byte `byte` of row `y`, as bits.
    fn bits_of(&self, region: usize, y: i64, byte: i64) -> u8 {
        let own = self.all[region].area.bits(y, byte);
        self.all[..region].iter().fold(own, |own, earlier| own & !earlier.area.bits(y, byte))
    }
}

/// Writes `plane` into `out` as `moves` change it. A mirror of a region shows the mirror of the plane that lies the region's
/// shift before it, if that belongs to the same region, and is dark otherwise. So no region becomes brighter, and nothing
/// changes outside of them.
///
/// # Panics
/// When a slice is not a plane of `raster`.
pub fn move_plane(raster: Raster, plane: &[u8], moves: &Moves, out: &mut [u8]) {
    assert_eq!((plane.len(), out.len()), (raster.plane_bytes(), raster.plane_bytes()), "bytes of a plane");
    out.copy_from_slice(plane);
    if !moves.is_any() {
        return;
    }
    let row_bytes = raster.row_bytes();
    for (y, row) in out.chunks_exact_mut(row_bytes).enumerate() {
        let y = y as i64;
        for (region, Move { area, shift }) in moves.all().iter().enumerate() {
            if *shift == [0; 2] || !area.contains(i64::from(area.left), y) {
                continue;
            }
            let from_y = y - i64::from(shift[1]);
            let source = |byte: i64| {
                let mask = if byte < 0 { 0 } else { moves.bits_of(region, from_y, byte) };
                // The mask is empty outside the rectangle, which lies on the raster if the message was checked.
                let at = from_y * row_bytes as i64 + byte;
                if mask == 0 || byte >= row_bytes as i64 {
                    return 0;
                }
                usize::try_from(at).ok().and_then(|at| plane.get(at)).map_or(0, |bits| bits & mask)
            };
            let last = usize::from(area.left) + usize::from(area.width);
            let bytes = row.iter_mut().enumerate().take(last.div_ceil(8)).skip(usize::from(area.left) / 8);
            for (byte, mirrors) in bytes {
                let own = moves.bits_of(region, y, byte as i64);
                let first = byte as i64 * 8 - i64::from(shift[0]);
                let (at, off) = (first.div_euclid(8), first.rem_euclid(8));
                let both = u16::from(source(at)) << 8 | u16::from(source(at + 1));
                *mirrors = *mirrors & !own | (both >> (8 - off)) as u8 & own;
            }
        }
    }
}

#[cfg(test)]
mod tests;
