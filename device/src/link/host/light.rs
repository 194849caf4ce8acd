//! Computes what frames and their slots add to the light of the field, for the host's limiter.

use crate::link::limits::{LightLimiter, LightLimits, LimitReached};
use crate::link::slots::SlotClock;
use crate::time::{DeviceTicks, FrameRate};

/// How long the device may continue to show its frames after the host has sent the order to go dark.
const OBEYED_WITHIN_MS: u32 = 50;

/// What a slot shows.
#[derive(Clone, Copy, Debug)]
pub(super) enum Shown {
    /// A frame of this level.
    New(u32),
    /// The frame on the mirrors.
    Same,
    /// Nothing.
    Nothing,
}

/// Counts the light of frames in the slots that they are sent for.
#[derive(Debug)]
pub(super) struct LightCount {
    limiter: Option<LightLimiter>,
    /// Last slot counted in this session.
    slot: Option<u64>,
    /// Level of the frame in it, and the first slot in which that frame no longer repeats by itself.
    level: u32,
    over: u64,
}

impl LightCount {
    pub(super) fn new(rate: FrameRate, limits: &LightLimits) -> Self {
        Self { limiter: LightLimiter::ahead(rate, limits, OBEYED_WITHIN_MS), slot: None, level: 0, over: 0 }
    }

    pub(super) fn is_off(&self) -> bool {
        self.limiter.is_none()
    }

    /// The device is dark until a frame is sent.
    pub(super) fn is_dark(&mut self) {
        self.level = 0;
    }

    /// Slots are counted anew, from the dark. Earlier light still counts, as if no time had passed.
    pub(super) fn new_session(&mut self) {
        (self.slot, self.level) = (None, 0);
    }

    /// Counts a frame for the slot that `target_at` lies in; returns the limit that its light would exceed.
    pub(super) fn slot(
        &mut self,
        clock: &SlotClock,
        [target_at, dark_from]: [DeviceTicks; 2],
        shown: Shown,
    ) -> Option<LimitReached> {
        let limiter = self.limiter.as_mut()?;
        let slot = clock.slot_at(target_at).unwrap_or(0);
        if let Some(last) = self.slot {
            // A slot without a frame of its own repeats the previous one, until the light of that frame is over.
            let between = slot.saturating_sub(last + 1);
            let repeats = between.min(self.over.saturating_sub(last + 1));
            limiter.repeated(self.level, repeats);
            limiter.repeated(0, between - repeats);
        }
        self.slot = Some(self.slot.map_or(slot, |last| last.max(slot)));
        self.over = clock.slot_at(dark_from).map_or(slot, |k| k + 1);
        match shown {
            Shown::New(level) => self.level = level,
            Shown::Same => self.over = u64::MAX,
            Shown::Nothing => self.level = 0,
        }
        limiter.observe(self.level)
    }
}
