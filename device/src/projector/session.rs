//! A session from HELLO over CONFIG to ARM, and what ends its light.

use super::{Core, Mode, CHECKSUM_STORM};
use crate::link::{faults, Config, ConfigRefusal, Fault, FaultCode, FlashLimiter, SlotClock, Status};

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
        if config.schedule.len() > self.setup.max_planes as usize {
            return Err(ConfigRefusal::Planes);
        }
        let slots =
            SlotClock::new(config.epoch, self.setup.clock.tick_hz, config.rate).ok_or(ConfigRefusal::Rate)?;
        let plane_ns = 1_000_000_000 * u64::from(config.rate.den())
            / (u64::from(config.rate.num()) * config.schedule.len() as u64);
        if plane_ns < u64::from(self.setup.min_plane_ns) {
            return Err(ConfigRefusal::Rate);
        }
        self.disarm();
        self.config = Some((config, slots));
        self.guard.configure(config.rate, config.limits, self.setup.limits);
        self.flash = self.setup.flash_limit.map(|limit| FlashLimiter::backstop(config.rate, limit));
        Ok(())
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
