//! What a projector that follows tracks must make of them, worked out once more from docs/PROTOCOL.md, section 14.
//!
//! [`Memory`] reads the packets that reach the projector, and keeps and forgets TRACKS as that section says. [`expected`]
//! is the shift of one plane in wide numbers, and [`moved`] moves mirrors in whole rows: neither shares code with the
//! firmware, so a mistake on either side shows.

use dpm_device::link::{
    Area, Assembly, Config, Decoder, Header, HostMessage, MessageType, PacketSink, Region, SlotClock, Tracks,
};
use dpm_device::planes::Raster;
use dpm_device::time::DeviceTicks;
use std::collections::VecDeque;

/// States of the memory that are remembered: the planes of a slot are judged when it is over. A slot of 24 frames/s is
/// told of 200 times.
const REMEMBERED: usize = 2_048;
/// The greatest shift of any device, mirrors.
const MOST_OF_ALL: i128 = 64;

/// A shift of one region.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shift {
    /// Where.
    pub area: Area,
    /// To the right and downwards, mirrors.
    pub by: [i8; 2],
}

/// What TRACKS make of one plane.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Expected {
    /// Per region.
    pub shifts: Vec<Shift>,
    /// Ticks from their begin to the middle of the plane; `None` if none hold.
    pub age: Option<u64>,
    /// There are TRACKS of the frame, but they do not hold.
    pub is_stale: bool,
    /// A shift would have been greater than allowed.
    pub was_clamped: bool,
}

impl Expected {
    /// True if light moves.
    pub fn is_moved(&self) -> bool {
        self.shifts.iter().any(|shift| shift.by != [0; 2])
    }
}

/// The shift of `region` along `axis`, `u` microseconds after its TRACKS begin, in a slot that begins `w` microseconds
/// after the frame's own; and whether it was clamped.
fn shift(region: &Region, axis: usize, u: i128, w: i128, most: u8) -> (i8, bool) {
    let of = |pair: [i16; 2]| i128::from(pair[axis]);
    let millionths =
        1000 * (of(region.velocity) * u + of(region.drawn) * w) + of(region.half_acceleration) * u * u;
    let distance = of(region.offset) + millionths.div_euclid(1_000_000);
    if distance.abs() < i128::from(region.gate).max(128) {
        return (0, false);
    }
    let mirrors = (distance.abs() + 128) / 256;
    let most = i128::from(region.clamp.min(most)).min(MOST_OF_ALL);
    ((mirrors.min(most) * distance.signum()) as i8, mirrors > most)
}

/// What `tracks` make of a plane with its middle at `middle`, in a slot that begins `w` microseconds after the frame's
/// own, on a device that shifts by `most` mirrors.
pub fn expected(tracks: Option<&Tracks>, middle: u64, w: i128, tick_hz: u32, most: u8) -> Expected {
    let Some(tracks) = tracks else { return Expected::default() };
    let age = i128::from(middle) - i128::from(tracks.begin.0);
    let u = age * 1_000_000 / i128::from(tick_hz);
    if age < 0 || u > i128::from(tracks.lasts_us) {
        return Expected { is_stale: true, ..Expected::default() };
    }
    let mut was_clamped = false;
    let mut by = |region: &Region| {
        [0, 1].map(|axis| {
            let (by, clamped) = shift(region, axis, u, w, most);
            was_clamped |= clamped;
            by
        })
    };
    let shifts = tracks.regions().iter().map(|region| Shift { area: region.area, by: by(region) }).collect();
    Expected { shifts, age: Some(age as u64), is_stale: false, was_clamped }
}

/// One row of a plane of at most 64 columns, the leftmost mirror in the highest bit.
fn row(raster: Raster, plane: &[u8], y: i64) -> u64 {
    let bytes = raster.row_bytes();
    let Some(row) = usize::try_from(y).ok().and_then(|y| plane.chunks_exact(bytes).nth(y)) else { return 0 };
    row.iter().take(8).enumerate().fold(0, |word, (i, byte)| word | u64::from(*byte) << (56 - 8 * i))
}

/// The columns of row `y` that belong to region `k`: those of its rectangle, less those of earlier ones.
fn own(shifts: &[Shift], k: usize, y: i64) -> u64 {
    let columns = |area: Area| {
        let (top, bottom) = (i64::from(area.top), i64::from(area.top) + i64::from(area.height));
        if y < top || y >= bottom {
            return 0;
        }
        let from = |column: u32| u64::MAX.checked_shr(column).unwrap_or(0);
        from(u32::from(area.left)) & !from(u32::from(area.left) + u32::from(area.width))
    };
    shifts[..k].iter().fold(columns(shifts[k].area), |own, earlier| own & !columns(earlier.area))
}

/// True if `light` is what `shifts` make of `plane`, mirror by mirror. Rasters of more than 64 columns are not judged.
pub fn moved(raster: Raster, plane: &[u8], light: &[u8], shifts: &[Shift]) -> bool {
    if raster.width() > 64 {
        return true;
    }
    (0..i64::from(raster.height())).all(|y| {
        let mut wanted = row(raster, plane, y);
        let sent = wanted;
        for (k, shift) in shifts.iter().enumerate() {
            let [right, down] = shift.by.map(i64::from);
            let own_here = own(shifts, k, y);
            let light = if [right, down] == [0, 0] {
                sent
            } else {
                let from = row(raster, plane, y - down) & own(shifts, k, y - down);
                let by = right.unsigned_abs() as u32;
                let moved = if right < 0 { from.checked_shl(by) } else { from.checked_shr(by) };
                moved.unwrap_or(0)
            };
            wanted = wanted & !own_here | light & own_here;
        }
        wanted == row(raster, light, y)
    })
}

/// Packets of the control lane.
#[derive(Debug, Default)]
struct Packets {
    open: Option<Assembly>,
    whole: Vec<(u32, HostMessage)>,
}

impl PacketSink for Packets {
    fn begin(&mut self, header: &Header) -> bool {
        let is_frame =
            matches!(header.kind, MessageType::Plane | MessageType::FrameCommit | MessageType::Sync);
        self.open = if is_frame { None } else { Assembly::new(header) };
        self.open.is_some()
    }

    fn payload(&mut self, bytes: &[u8]) {
        if let Some(open) = &mut self.open {
            open.push(bytes);
        }
    }

    fn end(&mut self, intact: bool) {
        let Some(open) = self.open.take().filter(|_| intact) else { return };
        if let Ok(message) = HostMessage::parse(open.header().kind, open.payload()) {
            self.whole.push((open.header().session, message));
        }
    }
}

/// What the projector is at the moment at which packets arrive.
#[derive(Clone, Copy, Debug)]
pub struct Present {
    /// Its clock.
    pub ticks: DeviceTicks,
    /// Ticks a second.
    pub tick_hz: u32,
    /// Its mirrors.
    pub raster: Raster,
    /// The frame on the mirrors.
    pub lit: Option<u32>,
    /// By how many mirrors it shifts.
    pub most: u8,
}

/// A CONFIG, and the tick from which it holds.
#[derive(Clone, Copy, Debug)]
pub struct Epoch {
    from: u64,
    /// The configuration.
    pub config: Config,
    /// Its slots.
    pub slots: SlotClock,
}

/// What was kept from a tick on.
#[derive(Clone, Debug)]
struct Kept {
    from: u64,
    tracks: [Option<Tracks>; 2],
}

/// What the projector should know. See the module's documentation.
#[derive(Default)]
pub struct Memory {
    decoder: Decoder,
    packets: Packets,
    session: u32,
    config: Option<Config>,
    newest: Option<u32>,
    kept: [Option<Tracks>; 2],
    history: VecDeque<Kept>,
    epochs: VecDeque<Epoch>,
    /// TRACKS taken in this session.
    pub taken: u32,
    /// TRACKS refused in this session.
    pub refused: u32,
}

impl Memory {
    /// The projector has lost its memory, or another one is in its place.
    pub fn new_device(&mut self) {
        *self = Self::default();
    }

    /// The session is over: the cable was pulled.
    pub fn no_session(&mut self, ticks: DeviceTicks) {
        self.open(0, ticks);
        self.decoder = Decoder::new();
        self.packets = Packets::default();
    }

    fn open(&mut self, session: u32, ticks: DeviceTicks) {
        (self.session, self.config, self.newest) = (session, None, None);
        (self.taken, self.refused) = (0, 0);
        self.forget(ticks);
    }

    /// All tracks are forgotten.
    pub fn forget(&mut self, ticks: DeviceTicks) {
        self.kept = [None; 2];
        self.note(ticks);
    }

    fn note(&mut self, ticks: DeviceTicks) {
        if self.history.len() >= REMEMBERED {
            self.history.pop_front();
        }
        self.history.push_back(Kept { from: ticks.0, tracks: self.kept });
    }

    /// True while CONFIG asks for tracks.
    pub fn follows(&self) -> bool {
        self.config.is_some_and(|config| config.tracks)
    }

    /// The number of the newest TRACKS taken in this session.
    pub fn newest(&self) -> Option<u32> {
        self.newest
    }

    /// A transfer reaches the projector; `cut`: it ended too early. `sink` gets what it takes, with the number of the TRACKS
    /// before it. Returns true if a new session began with it.
    pub fn hear(
        &mut self,
        bytes: &[u8],
        cut: bool,
        present: &Present,
        sink: &mut dyn FnMut(&Tracks, Option<u32>),
    ) -> bool {
        self.decoder.push(bytes, &mut self.packets);
        if cut {
            self.decoder.reset(&mut self.packets);
        }
        let mut is_new = false;
        let mut lit = present.lit;
        let mut whole = std::mem::take(&mut self.packets.whole);
        for (session, message) in whole.drain(..) {
            let is_ours = session != 0 && session == self.session;
            match message {
                HostMessage::Hello(_) if session != 0 && session != self.session => {
                    self.open(session, present.ticks);
                    (is_new, lit) = (true, None);
                }
                HostMessage::Stop | HostMessage::Safe => {
                    self.forget(present.ticks);
                    lit = None;
                }
                HostMessage::Config(config) if is_ours && config.raster == present.raster => {
                    self.forget(present.ticks);
                    lit = None;
                    self.configure(config, present);
                }
                HostMessage::Tracks(tracks) if is_ours && self.follows() => {
                    self.take(tracks, lit, present, sink);
                }
                _ => {}
            }
        }
        self.packets.whole = whole;
        is_new
    }

    fn configure(&mut self, config: Config, present: &Present) {
        let Some(slots) = SlotClock::new(config.epoch, present.tick_hz, config.rate) else { return };
        self.config = Some(config);
        if self.epochs.len() >= 16 {
            self.epochs.pop_front();
        }
        self.epochs.push_back(Epoch { from: present.ticks.0, config, slots });
    }

    fn take(
        &mut self,
        tracks: Tracks,
        lit: Option<u32>,
        present: &Present,
        sink: &mut dyn FnMut(&Tracks, Option<u32>),
    ) {
        let is_newer = self.newest.is_none_or(|newest| (tracks.number.wrapping_sub(newest) as i32) > 0);
        let lies_on = |area: Area| {
            let (right, bottom) = (area.left.into(), area.top.into());
            let (right, bottom): (u32, u32) = (right, bottom);
            area.width > 0
                && area.height > 0
                && right + u32::from(area.width) <= present.raster.width()
                && bottom + u32::from(area.height) <= present.raster.height()
        };
        if !is_newer || !tracks.regions().iter().all(|region| lies_on(region.area)) {
            self.refused = self.refused.wrapping_add(1);
            return;
        }
        sink(&tracks, self.newest);
        self.newest = Some(tracks.number);
        self.taken = self.taken.wrapping_add(1);
        let [a, b] = &mut self.kept;
        let is_of = |kept: &Option<Tracks>, frame: u32| kept.is_some_and(|kept| kept.frame == frame);
        let is_lit = |kept: &Option<Tracks>| kept.is_some_and(|kept| Some(kept.frame) == lit);
        let age = |kept: &Option<Tracks>| kept.map_or(0, |kept| tracks.number.wrapping_sub(kept.number));
        let is_first = if is_of(a, tracks.frame) || a.is_none() {
            true
        } else if is_of(b, tracks.frame) || b.is_none() {
            false
        } else {
            // The place of the frame that is lit stays; of two others that of the older tracks is taken.
            !is_lit(a) && (is_lit(b) || age(b) <= age(a))
        };
        *(if is_first { a } else { b }) = Some(tracks);
        self.note(present.ticks);
    }

    /// The CONFIG that held at `ticks`.
    pub fn epoch_at(&self, ticks: DeviceTicks) -> Option<&Epoch> {
        self.epochs.iter().rev().find(|epoch| epoch.from <= ticks.0)
    }

    /// The newest TRACKS of `frame` that arrived before `begin` and were kept then. `None` outside if that is not known
    /// any more.
    pub fn tracks_of(&self, frame: u32, begin: u64) -> Option<Option<&Tracks>> {
        let last = self.history.iter().rev().find(|kept| kept.from < begin);
        match last {
            Some(kept) => Some(kept.tracks.iter().flatten().find(|tracks| tracks.frame == frame)),
            None if self.history.len() >= REMEMBERED => None,
            None => Some(None),
        }
    }
}
