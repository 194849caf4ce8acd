//! One slot after the other: which frame is on the mirrors, and what observers are told of it.

use crate::light::{LightEvent, LightKind};
use crate::link::{faults, mean_luminance, Config, SlotClock, Underrun, REST_US};
use crate::time::{DeviceTicks, HostTime};

use super::config::Shown;
use super::frames::{FrameStore, Held, Pending};
use super::{Core, Mode};

/// The planes of the frame in a buffer.
fn planes_of<'a>(store: &'a FrameStore, config: &Config, buffer: usize) -> &'a [u8] {
    &store.bytes(buffer)[..config.raster.plane_bytes() * config.schedule.len()]
}

impl Core {
    /// Begins one slot.
    pub(super) fn slot(&mut self, config: &Config, slots: &SlotClock, start: DeviceTicks) {
        let slot = self.next_slot;
        self.next_slot += 1;
        self.status.slots = self.status.slots.wrapping_add(1);
        self.status_due = true;
        if self.panel_busy && self.untaken.is_some() && self.lit_now {
            return self.lit_a_slot_later(slots, slot, start);
        }
        let due = self.take_due(slot, start);
        if due.is_none() && self.dark_from().is_some_and(|dark| dark <= start) {
            self.end_light();
        }
        // FREEZE holds the lit frame; if nothing is lit, it makes no light. A frame that BLACK hid may be over by now.
        let again = self.store.lit.is_some_and(|held| match self.mode {
            Mode::Frozen => self.lit_now,
            Mode::Normal => config.underrun == Underrun::Repeat && start < held.dark_from,
            Mode::Black | Mode::Disarmed => false,
        });
        let too_much = match (self.mode, due) {
            (Mode::Normal, Some((frame, _))) => {
                let planes = planes_of(&self.store, config, frame.buffer);
                self.guard.new_frame(config.raster, &config.schedule, planes)
            }
            _ if again => self.guard.same_frame(),
            _ => {
                self.guard.dark();
                None
            }
        };
        if let Some(rest_us) = too_much {
            // The slot stays dark, and so do all later ones.
            let refused = due.map_or(0, |(_, superseded)| superseded + 1);
            self.status.frames_refused = self.status.frames_refused.wrapping_add(refused);
            self.status.slots_blank = self.status.slots_blank.wrapping_add(1);
            self.rest(start, rest_us);
            self.latch(faults::LIGHT_LIMIT);
            return self.note_light(slots, slot, LightKind::Blank);
        }
        let kind = match (self.mode, due) {
            (Mode::Normal, Some((frame, superseded))) => {
                self.status.frames_superseded = self.status.frames_superseded.wrapping_add(superseded);
                self.show(config, &frame, start);
                LightKind::Lit
            }
            (_, due) => {
                // Dark or holding by order: frames are used up so that the stream continues.
                let refused = due.map_or(0, |(_, superseded)| superseded + 1);
                self.status.frames_refused = self.status.frames_refused.wrapping_add(refused);
                if again {
                    self.status.slots_repeated = self.status.slots_repeated.wrapping_add(1);
                    LightKind::Repeated
                } else {
                    self.status.slots_blank = self.status.slots_blank.wrapping_add(1);
                    LightKind::Blank
                }
            }
        };
        let before = if self.lit_now { LightKind::Repeated } else { LightKind::Blank };
        self.untaken = (kind == LightKind::Lit).then_some(before);
        self.lit_now = kind != LightKind::Blank;
        self.begin_planes(slots, slot);
        self.note_light(slots, slot, kind);
        let luminance = if self.lit_now { self.luminance } else { 0 };
        if self.flash.as_mut().is_some_and(|f| f.observe(slot, luminance)) {
            self.rest(start, u64::from(REST_US));
            self.latch(faults::FLASH_LIMIT);
        }
    }

    /// The frame for `slot`, and the number of older ones that it replaces. What a busy panel cannot take waits for the
    /// next slot.
    fn take_due(&mut self, slot: u64, start: DeviceTicks) -> Option<(Pending, u32)> {
        let due = if self.panel_busy { None } else { self.store.take_due(slot) };
        let (frame, superseded) = due?;
        if self.mode == Mode::Normal && frame.dark_from <= start {
            // The frame was allowed to be late, but its own light is over.
            self.status.frames_superseded = self.status.frames_superseded.wrapping_add(superseded);
            self.status.frames_late = self.status.frames_late.wrapping_add(1);
            return None;
        }
        due
    }

    /// Puts a frame onto the mirrors at `start`.
    fn show(&mut self, config: &Config, frame: &Pending, start: DeviceTicks) {
        self.status.frames_lit = self.status.frames_lit.wrapping_add(1);
        self.status.last_lit_frame = frame.frame;
        self.status.last_lit_at = start;
        self.following.lit(frame.slot);
        self.store.lit = Some(Held { frame: frame.frame, dark_from: frame.dark_from, buffer: frame.buffer });
        self.generation += 1;
        if self.flash.is_some() {
            let planes = planes_of(&self.store, config, frame.buffer);
            self.luminance = mean_luminance(config.raster, &config.schedule, planes);
        }
    }

    /// The panel did not take the frame of the slot before: that slot showed what was there before, and this one shows
    /// the frame. Its light ends when it was meant to end.
    fn lit_a_slot_later(&mut self, slots: &SlotClock, slot: u64, start: DeviceTicks) {
        let before = self.untaken.unwrap_or(LightKind::Blank);
        if before == LightKind::Repeated {
            self.status.slots_repeated = self.status.slots_repeated.wrapping_add(1);
        } else {
            self.status.slots_blank = self.status.slots_blank.wrapping_add(1);
        }
        self.status.last_lit_at = start;
        if let Some(event) = self.events.back_mut() {
            (event.kind, event.frame) = (before, None);
        }
        self.begin_planes(slots, slot);
        self.note_light(slots, slot, LightKind::Lit);
        // The light of the late frame counts once more than it falls: a limit is reached too early rather than too late.
        if let Some(rest_us) = self.guard.same_frame() {
            self.rest(start, rest_us);
            self.latch(faults::LIGHT_LIMIT);
        }
        let luminance = self.luminance;
        if self.flash.as_mut().is_some_and(|f| f.observe(slot, luminance)) {
            self.rest(start, u64::from(REST_US));
            self.latch(faults::FLASH_LIMIT);
        }
    }

    /// Refuses ARM for `us` microseconds from `from`.
    fn rest(&mut self, from: DeviceTicks, us: u64) {
        let ticks = u128::from(us) * u128::from(self.setup.clock.tick_hz) / 1_000_000;
        let ticks = u64::try_from(ticks).unwrap_or(u64::MAX);
        self.rest_until = self.rest_until.max(DeviceTicks(from.0.saturating_add(ticks)));
    }

    /// Notes the light of `slot` for observers.
    fn note_light(&mut self, slots: &SlotClock, slot: u64, kind: LightKind) {
        let (start, clock) = (slots.start(slot), &self.setup.clock);
        let end = slots.start(slot + 1);
        let settle = if self.lit_now { i64::from(self.setup.settle_ns) } else { 0 };
        let event = LightEvent {
            slot,
            frame: self.store.lit.filter(|_| self.lit_now).map(|h| h.frame),
            kind,
            lit_at: start,
            first_photon_at: clock.instant_of(start).plus_ns(settle),
            last_photon_at: clock.instant_of(self.dark_from().unwrap_or(end).min(end)),
        };
        if self.events.len() >= self.setup.events_kept {
            self.events.pop_front();
            self.events_lost += 1;
        }
        if self.setup.events_kept > 0 {
            self.events.push_back(event);
        }
        if self.setup.shown_kept > 0 && kind != LightKind::Blank {
            self.keep_shown(event, clock.instant_of(end));
        }
    }

    /// Keeps a lit slot with its planes.
    fn keep_shown(&mut self, event: LightEvent, planes_end_at: HostTime) {
        let (Some(held), Some((config, _))) = (self.store.lit, self.config.as_ref()) else { return };
        let before = self.shown.back().filter(|_| event.kind == LightKind::Repeated);
        let planes = before.map_or_else(
            || self.store.bytes(held.buffer)[..config.raster.plane_bytes() * config.schedule.len()].into(),
            |shown| shown.planes.clone(),
        );
        let shown = Shown { event, planes_end_at, schedule: config.schedule, planes };
        if self.shown.len() >= self.setup.shown_kept {
            self.shown.pop_front();
            self.shown_lost += 1;
        }
        self.shown.push_back(shown);
    }
}
