//! Shifts the slots of a device, so that they keep step with something else: the exposures of a tracker.
//!
//! Host and device change their slots at the same slot, which has not begun when the host asks. The device reports which
//! epoch its present slot counts by, so nothing has to be answered. Until that slot has begun and the report says so, no
//! further shift is sent. A SHIFT that got lost is repeated; meanwhile both may differ by the small part of a slot for
//! which frames leave room (see [`HostLink::aim`]).

use super::{is_due, HostLink, LinkState, NEVER};
use crate::link::message::HostMessage;
use crate::link::slots::{SlotClock, SlotShift, SHIFT_PARTS};
use crate::time::{DeviceTicks, HostTime};
use crate::transport::{SendError, Transport};

/// A SHIFT that the device has not confirmed is repeated after this long ...
const REPEAT_NS: i64 = 20_000_000;
/// ... and so often; then the host returns to the slots that the device reports.
const REPEATS: u32 = 25;

/// What the host waits for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shifting {
    /// True while a SHIFT has not been confirmed.
    waits: bool,
    sent_at: HostTime,
    sent: u32,
    /// The device did not do what it was asked to: no more shifts in this session.
    is_refused: bool,
}

impl Shifting {
    pub(super) const IDLE: Self = Self { waits: false, sent_at: NEVER, sent: 0, is_refused: false };
}

impl HostLink {
    /// From the next session on, the device is asked to let its slots be shifted, if it can. Without this call none is.
    pub fn want_shifts(&mut self) {
        self.wants_shifts = true;
    }

    /// True if the slots of the device can be shifted in this session.
    pub fn shifts_slots(&self) -> bool {
        let s = &self.settings;
        let plane_ns =
            1_000_000_000 * u64::from(s.rate.den()) / (u64::from(s.rate.num()) * s.schedule.len() as u64);
        let shortest_ns = plane_ns - plane_ns.div_ceil(SHIFT_PARTS);
        self.wants_shifts
            && !self.shifting.is_refused
            && self.inbox.hello.is_some_and(|hello| {
                hello.shifts_slots && hello.measures_timing && u64::from(hello.min_plane_ns) <= shortest_ns
            })
    }

    /// True if a frame was sent in this session.
    pub fn has_sent_frames(&self) -> bool {
        self.frames_sent > 0
    }

    /// True if [`HostLink::shift_slots`] would send something now.
    pub fn may_shift(&self) -> bool {
        self.state == LinkState::Streaming
            && self.verb.is_none()
            && self.shifts_slots()
            && !self.shifting.waits
    }

    /// Has all slots from `slot` on begin `by_ns` nanoseconds (nominal) later, or earlier if negative: at most a 64th of
    /// a slot, or up to a slot later while no frame has been sent in this session. Sends nothing unless
    /// [`HostLink::may_shift`] says so. True if it was sent.
    ///
    /// # Errors
    /// The medium has no room, or has failed; nothing was sent.
    pub fn shift_slots(
        &mut self,
        now: HostTime,
        slot: u64,
        by_ns: i64,
        transport: &mut dyn Transport,
    ) -> Result<bool, SendError> {
        let Some(slots) = self.slots.filter(|_| self.may_shift()) else { return Ok(false) };
        let part = (slots.slot_ticks() / SHIFT_PARTS) as i64;
        let most = if self.frames_sent == 0 { slots.slot_ticks() as i64 } else { part };
        let ticks = i128::from(by_ns) * i128::from(slots.tick_hz()) / 1_000_000_000;
        let by = ticks.clamp(-i128::from(part), i128::from(most)) as i64;
        if by == 0 {
            return Ok(false);
        }
        let epoch = DeviceTicks(slots.epoch_of(slot).0.saturating_add_signed(by));
        let shift = SlotShift { slot, epoch };
        self.control(now, &HostMessage::Shift(shift), transport)?;
        self.slots = Some(slots.with_shift(shift));
        self.shifting = Shifting { waits: true, sent_at: now, sent: 1, ..self.shifting };
        Ok(true)
    }

    /// Sees whether the device has done what it was asked to, and repeats what it has not.
    pub(super) fn follow_shift(
        &mut self,
        now: HostTime,
        transport: &mut dyn Transport,
    ) -> Result<(), SendError> {
        let Some((slots, shift)) = self.slots.and_then(|slots| Some((slots, slots.shift()?))) else {
            return Ok(());
        };
        let Some(status) = self.inbox.status.filter(|_| self.shifting.waits) else { return Ok(()) };
        let Some(timing) = status.timing else { return Ok(()) };
        if status.now < slots.start(shift.slot) {
            return Ok(());
        }
        if timing.epoch == shift.epoch.0 as u32 {
            self.shifting.waits = false;
        } else if is_due(now, self.shifting.sent_at, REPEAT_NS) {
            if self.shifting.sent < REPEATS {
                self.shifting = Shifting { sent_at: now, sent: self.shifting.sent + 1, ..self.shifting };
                return self.control(now, &HostMessage::Shift(shift), transport);
            }
            let off = timing.epoch.wrapping_sub(shift.epoch.0 as u32) as i32;
            let epoch = DeviceTicks(shift.epoch.0.saturating_add_signed(off.into()));
            self.slots = SlotClock::new(epoch, slots.tick_hz(), slots.rate());
            self.shifting = Shifting { is_refused: true, ..Shifting::IDLE };
        }
        Ok(())
    }

    /// The instant that a frame for the slot that begins at `target_at` names: where slots are shifted, a quarter of a slot
    /// into it, because the frame may have been planned by slots of before, and the device may not have shifted yet.
    pub(super) fn aim(&self, target_at: DeviceTicks) -> DeviceTicks {
        let slots = self.slots.filter(|slots| slots.shift().is_some());
        DeviceTicks(target_at.0.saturating_add(slots.map_or(0, |slots| slots.slot_ticks() / 4)))
    }
}
