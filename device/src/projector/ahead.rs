//! What a panel asks that takes planes before they are lit: which whole frames wait, and for which slots.

use super::{Mode, ProjectorFirmware};
use crate::planes::PlaneSchedule;
use crate::time::FrameRate;

/// A whole frame that waits for its slot.
#[derive(Clone, Copy, Debug)]
pub struct WaitingFrame<'a> {
    /// Its number (low 32 bits).
    pub frame: u32,
    /// The slot that it is meant for.
    pub slot: u64,
    /// Its planes, one after the other.
    pub planes: &'a [u8],
}

impl ProjectorFirmware {
    /// The whole frames that wait, in the order of their numbers; none while no light may be.
    pub fn waiting_frames(&self) -> impl Iterator<Item = WaitingFrame<'_>> {
        let core = &self.core;
        let armed = core.config.as_ref().filter(|_| core.mode != Mode::Disarmed);
        let bytes = armed.map_or(0, |(config, _)| config.raster.plane_bytes() * config.schedule.len());
        core.store.pending().iter().filter(move |_| bytes > 0).map(move |pending| WaitingFrame {
            frame: pending.frame,
            slot: pending.slot,
            planes: &core.store.bytes(pending.buffer)[..bytes],
        })
    }

    /// The frame that the next slot lights if nothing newer arrives: the newest one that is due in it.
    pub fn next_frame(&self) -> Option<u32> {
        let next = self.core.next_slot;
        self.waiting_frames().filter(|waiting| waiting.slot <= next).last().map(|waiting| waiting.frame)
    }

    /// The session, and the order and rate of its frames; `None` until the host has configured it.
    pub fn configured(&self) -> Option<(u32, PlaneSchedule, FrameRate)> {
        self.core.config.as_ref().map(|(config, _)| (self.core.session, config.schedule, config.rate))
    }
}
