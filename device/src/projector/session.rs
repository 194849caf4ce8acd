//! A session from HELLO over CONFIG to ARM, and what ends its light.

use super::{Core, Mode, CHECKSUM_STORM};
use crate::link::{
    faults, Config, ConfigRefusal, Fault, FaultCode, FlashLimiter, SlotClock, SlotShift, Status, SHIFT_PARTS,
};

impl Core {
    /// Goes dark and drops every frame in flight.
    pub(super) fn disarm(&mut self) {
        if self.mode != Mode::Disarmed {
            self.counted_to = Some(self.now);
        }
        self.mode = Mode::Disarmed;
        self.lit_now = false;
        self.following.clear();
        self.untaken = None;
        let thrown = self.store.clear();
        self.status.frames_refused = self.status.frames_refused.wrapping_add(thrown);
        self.status_due = true;
    }

    /// Notes the number of damaged packets so far; if there are too many since a frame was whole, light ends.
    pub(super) fn damaged(&mut self, total: u32) {
        if core::mem::take(&mut self.whole_since) || self.mode == Mode::Disarmed {
            self.damaged_at_whole = total;
        }
        if total.wrapping_sub(self.damaged_at_whole) >= CHECKSUM_STORM {
            self.damaged_at_whole = total;
            self.latch(faults::CHECKSUM_STORM);
        }
    }

    /// Goes dark until the host has acknowledged `faults`.
    pub(super) fn latch(&mut self, faults: u32) {
        self.disarm();
        self.latched |= faults;
        self.report(FaultCode::Latched, 0);
    }

    /// Has a FAULT told to the host.
    pub(super) fn report(&mut self, code: FaultCode, detail: u16) {
        self.fault_due =
            Some(Fault { latched: self.latched, code, detail, at: self.setup.clock.ticks_at(self.at) });
        self.status_due = true;
    }

    /// HELLO: what the session before has left is forgotten, and it is dark.
    pub(super) fn open_session(&mut self, session: u32) {
        self.disarm();
        self.session = session;
        self.config = None;
        self.last_seen_frame = None;
        self.status = Status::default();
        self.following.new_session();
        self.counters_due = true;
    }

    /// CONFIG: dark, with slots and limits of its own.
    ///
    /// # Errors
    /// What this device cannot show.
    pub(super) fn configure(&mut self, config: Config) -> Result<(), ConfigRefusal> {
        if config.raster != self.setup.raster {
            return Err(ConfigRefusal::Raster);
        }
        if config.schedule.exceeds() && !self.setup.exceeds {
            return Err(ConfigRefusal::Format);
        }
        if config.schedule.len() > self.setup.max_planes as usize {
            return Err(ConfigRefusal::Planes);
        }
        let slots =
            SlotClock::new(config.epoch, self.setup.clock.tick_hz, config.rate).ok_or(ConfigRefusal::Rate)?;
        let plane_ns = 1_000_000_000 * u64::from(config.rate.den())
            / (u64::from(config.rate.num()) * config.schedule.len() as u64);
        let shortest_ns = if config.shifts { plane_ns - plane_ns.div_ceil(SHIFT_PARTS) } else { plane_ns };
        if shortest_ns < u64::from(self.setup.min_plane_ns) || config.shifts && !self.setup.shifts_slots {
            return Err(ConfigRefusal::Rate);
        }
        self.disarm();
        self.config = Some((config, slots));
        self.guard.configure(config.rate, config.limits, self.setup.limits);
        self.flash = self
            .setup
            .flash_limit
            .map(|limit| FlashLimiter::backstop(config.rate, limit).of_planes(&config.schedule));
        Ok(())
    }

    /// SHIFT: slots that have not begun begin earlier or later. Those in light by a small part of a slot alone.
    pub(super) fn take_shift(&mut self, shift: SlotShift) {
        let (next, is_lit) = (self.slot_to_come(), self.lit_now);
        let Some((_, slots)) = self.config.as_mut().filter(|(config, _)| config.shifts) else {
            return self.count_ignored();
        };
        let held = slots.epoch_of(next.saturating_sub(1));
        let by = i128::from(shift.epoch.0) - i128::from(held.0);
        let (slot, part) = (i128::from(slots.slot_ticks()), i128::from(slots.slot_ticks() / SHIFT_PARTS));
        let most = if is_lit { part } else { slot };
        if !(-part..=most).contains(&by) {
            return self.count_ignored();
        }
        // What was to come after another shift that has not begun is forgotten.
        let now = SlotShift { slot: next, epoch: held };
        *slots = slots.with_shift(now).with_shift(SlotShift { slot: shift.slot.max(next), ..shift });
        self.status_due = true;
    }

    /// The first slot that has not begun.
    fn slot_to_come(&self) -> u64 {
        let slots = self.config.as_ref().map(|(_, slots)| slots);
        slots.and_then(|slots| slots.slot_at(self.ticks())).map_or(0, |k| k + 1)
    }

    /// Low 32 bits of the tick at which slot 0 begins as the present slot counts it; 0 without shifts.
    pub(super) fn present_epoch(&self) -> u32 {
        let shifted = self.config.as_ref().filter(|(config, _)| config.shifts);
        shifted.map_or(0, |(_, slots)| slots.epoch_of(self.slot_to_come().saturating_sub(1)).0 as u32)
    }

    /// ARM: light from the next slot on, unless a fault is not acknowledged.
    pub(super) fn arm(&mut self, acknowledged: u32) {
        let Some((_, slots)) = self.config else {
            return self.report(FaultCode::Arm, 1);
        };
        if self.present != 0 || self.latched & !acknowledged != 0 {
            return self.report(FaultCode::Arm, 2);
        }
        if self.ticks() < self.rest_until {
            return self.report(FaultCode::Arm, 3);
        }
        if self.latched & faults::FLASH_LIMIT != 0 {
            if let Some(flash) = &mut self.flash {
                flash.reset();
            }
        }
        self.latched = 0;
        if self.mode == Mode::Disarmed {
            let now = self.ticks();
            self.next_slot = slots.slot_at(now).map_or(0, |k| k + 1);
            let dark_ns = self.counted_to.map_or(0, |to| self.now.ns_since(to).max(0));
            let rate = slots.rate();
            let dark = dark_ns as u128 * u128::from(rate.num()) / (u128::from(rate.den()) * 1_000_000_000);
            self.guard.was_dark(u64::try_from(dark).unwrap_or(u64::MAX).saturating_sub(1));
        }
        self.mode = Mode::Normal;
        self.status_due = true;
        // The light of the frozen frame may be over: then it ends now, not with the next slot.
        let now = self.ticks();
        if self.dark_from().is_some_and(|dark| dark <= now) {
            self.end_light();
        }
    }
}
