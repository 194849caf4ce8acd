//! Tracks on the device: which of them are kept, and what each plane becomes when its time comes.
//!
//! Only packets change what is kept, and the projector advances to the arrival of each packet before it reads it. So the
//! planes can be settled whenever the projector advances: each by the tracks that had arrived when it began.

use super::Core;
use crate::link::{frame_newer, move_plane, Config, Moves, SlotClock, TrackCounts, Tracks};
use crate::planes::{Raster, MAX_PLANES};
use crate::time::{DeviceTicks, HostTime};

/// What tracks made of the planes of a lit slot.
#[derive(Clone, Copy, Debug)]
pub struct SlotMoves {
    /// Which slot.
    pub slot: u64,
    /// The frame that was lit (low 32 bits of its number).
    pub frame: u32,
    /// True time of its first photon.
    pub first_photon_at: HostTime,
    /// When the last plane would have ended had nothing cut the light short: the planes share the time from the first
    /// photon to here equally.
    pub planes_end_at: HostTime,
    planes: [Moves; MAX_PLANES],
    /// Ticks from the begin of the tracks to the middle of each plane; `None` if none held.
    ages: [Option<u32>; MAX_PLANES],
    lit: u8,
}

impl SlotMoves {
    /// The shifts of each plane that was lit, in the order shown.
    pub fn planes(&self) -> &[Moves] {
        &self.planes[..usize::from(self.lit)]
    }

    /// True if a mirror of a plane may show something else than what was sent.
    pub fn is_any(&self) -> bool {
        self.planes().iter().any(Moves::is_any)
    }

    /// Writes the light of the slot into `out`: `planes`, which are those of its frame as they were sent, one after the
    /// other, each as tracks moved it. Planes that were cut off are left as they were sent.
    ///
    /// # Panics
    /// When the lengths differ or are not those of whole planes of `raster`.
    pub fn move_planes(&self, raster: Raster, planes: &[u8], out: &mut [u8]) {
        assert_eq!(planes.len(), out.len(), "bytes of the planes");
        let bytes = raster.plane_bytes();
        for (k, (plane, out)) in planes.chunks(bytes).zip(out.chunks_mut(bytes)).enumerate() {
            move_plane(raster, plane, self.planes().get(k).unwrap_or(&Moves::NONE), out);
        }
    }

    /// Age of the tracks of each plane that was lit: ticks from their begin to the middle of the plane. `None` if none held.
    pub fn ages(&self) -> &[Option<u32>] {
        &self.ages[..usize::from(self.lit)]
    }
}

/// A slot whose planes are being lit.
#[derive(Clone, Copy, Debug)]
struct LitSlot {
    frame: u32,
    start: DeviceTicks,
    ticks: u64,
    /// From the start of the frame's target slot to the start of this one, microseconds.
    late_us: u32,
    /// The plane that is lit next.
    next: u64,
    greatest_age: u32,
}

/// The tracks that a device keeps, and the planes that they move.
#[derive(Clone, Debug, Default)]
pub(super) struct Following {
    /// Of the frame that is lit, and of another one.
    kept: [Option<Tracks>; 2],
    newest: Option<u32>,
    counts: TrackCounts,
    slot: Option<LitSlot>,
    /// The target slot of the frame on the mirrors.
    target: u64,
}

impl Following {
    /// Forgets all tracks; the counters go on.
    pub(super) fn clear(&mut self) {
        (self.kept, self.slot) = (Default::default(), None);
    }

    /// A new session begins: counters and numbers begin at 0.
    pub(super) fn new_session(&mut self) {
        *self = Self::default();
    }

    /// A frame that was meant for the slot `target` is on the mirrors from now on.
    pub(super) fn lit(&mut self, target: u64) {
        self.target = target;
    }

    /// The tracks that are kept for `frame`.
    fn of_frame(&self, frame: u32) -> Option<&Tracks> {
        self.kept.iter().flatten().find(|tracks| tracks.frame == frame)
    }

    /// Keeps `tracks` in the place of those of the same frame, or of those that are needed least.
    fn keep(&mut self, tracks: Tracks, lit: Option<u32>) {
        let is_free = |place: &Option<Tracks>| place.is_none_or(|kept| kept.frame == tracks.frame);
        let is_other = |place: &Option<Tracks>| place.is_some_and(|kept| Some(kept.frame) != lit);
        let place = self.kept.iter().position(is_free).or_else(|| {
            // Both places hold other frames: the lit one stays, and of two that are not lit the newer one.
            let others = (0..2).filter(|&i| is_other(&self.kept[i]));
            others.min_by_key(|&i| self.kept[i].map_or(0, |kept| kept.number.wrapping_sub(tracks.number)))
        });
        if let Some(place) = place {
            self.kept[place] = Some(tracks);
        }
    }
}

impl Core {
    /// True if CONFIG asked for tracks and this projector follows them.
    pub(super) fn follows(&self) -> bool {
        self.setup.greatest_shift.is_some() && self.config.as_ref().is_some_and(|(config, _)| config.tracks)
    }

    /// The counters for STATUS.
    pub(super) fn track_counts(&self) -> Option<TrackCounts> {
        self.follows().then_some(self.following.counts)
    }

    /// Takes the tracks of a message, or counts them as ignored.
    pub(super) fn take_tracks(&mut self, tracks: Tracks) {
        if !self.follows() {
            return self.count_ignored();
        }
        let is_old = self.following.newest.is_some_and(|newest| !frame_newer(tracks.number, newest));
        if is_old || !tracks.fits(self.setup.raster) {
            self.following.counts.refused = self.following.counts.refused.wrapping_add(1);
            return self.count_ignored();
        }
        self.following.newest = Some(tracks.number);
        self.following.counts.taken = self.following.counts.taken.wrapping_add(1);
        self.following.keep(tracks, self.store.lit.map(|held| held.frame));
    }

    /// A slot begins in which the frame on the mirrors is lit.
    pub(super) fn begin_planes(&mut self, slots: &SlotClock, slot: u64) {
        let Some(held) = self.store.lit.filter(|_| self.lit_now && self.follows()) else {
            self.following.slot = None;
            return;
        };
        let (start, end) = (slots.start(slot), slots.start(slot + 1));
        let late = start.0.saturating_sub(slots.start(self.following.target).0);
        let late_us = u128::from(late) * 1_000_000 / u128::from(self.setup.clock.tick_hz);
        self.following.slot = Some(LitSlot {
            frame: held.frame,
            start,
            ticks: end.0.saturating_sub(start.0),
            late_us: u32::try_from(late_us).unwrap_or(u32::MAX),
            next: 0,
            greatest_age: 0,
        });
        if self.setup.moves_kept == 0 {
            return;
        }
        if self.moves.len() >= self.setup.moves_kept {
            self.moves.pop_front();
            self.events_lost += 1;
        }
        let clock = &self.setup.clock;
        self.moves.push_back(SlotMoves {
            slot,
            frame: held.frame,
            first_photon_at: clock.instant_of(start).plus_ns(i64::from(self.setup.settle_ns)),
            planes_end_at: clock.instant_of(end),
            planes: [Moves::NONE; MAX_PLANES],
            ages: [None; MAX_PLANES],
            lit: 0,
        });
    }

    /// Settles the planes that begin up to `until`, each by the newest tracks that are kept.
    pub(super) fn light_planes(&mut self, config: &Config, until: DeviceTicks) {
        let Some(most) = self.setup.greatest_shift else { return };
        let tick_hz = self.setup.clock.tick_hz;
        let planes = config.schedule.len() as u64;
        while let Some(slot) = self.following.slot.as_mut().filter(|slot| self.lit_now && slot.next < planes)
        {
            let at = |halves: u64| {
                let ticks = u128::from(slot.ticks) * u128::from(halves) / u128::from(2 * planes);
                DeviceTicks(slot.start.0.saturating_add(ticks as u64))
            };
            let (begin, middle) = (at(2 * slot.next), at(2 * slot.next + 1));
            if begin > until {
                break;
            }
            slot.next += 1;
            let (frame, late_us) = (slot.frame, slot.late_us);
            let Some(tracks) = self.following.of_frame(frame) else {
                self.settled(None, 0);
                continue;
            };
            let age = u32::try_from(middle.0.saturating_sub(tracks.begin.0)).unwrap_or(u32::MAX);
            let moves = tracks.moves_at(middle, tick_hz, late_us, most);
            let counts = &mut self.following.counts;
            let count = |n: &mut u32, is: bool| *n = n.wrapping_add(u32::from(is));
            count(&mut counts.planes_stale, moves.is_none());
            count(&mut counts.planes_moved, moves.is_some_and(|moves| moves.is_any()));
            count(&mut counts.planes_clamped, moves.is_some_and(|moves| moves.was_clamped));
            if let Some(slot) = self.following.slot.as_mut().filter(|_| moves.is_some()) {
                slot.greatest_age = slot.greatest_age.max(age);
            }
            self.settled(moves, age);
        }
        if let Some(slot) = self.following.slot.filter(|slot| slot.next == planes) {
            self.following.counts.greatest_age = slot.greatest_age;
        }
    }

    /// Notes the shifts of the next plane for observers; `None` if no tracks held.
    fn settled(&mut self, moves: Option<Moves>, age: u32) {
        let Some(noted) = self.moves.back_mut() else { return };
        let next = usize::from(noted.lit);
        if let (Some(place), Some(noted_age)) = (noted.planes.get_mut(next), noted.ages.get_mut(next)) {
            *place = moves.unwrap_or(Moves::NONE);
            *noted_age = moves.map(|_| age);
            noted.lit += 1;
        }
    }
}
