//! The device's own limits on light: those of CONFIG, and those of its owner, which hold whatever the host requests.

use crate::link::{light_level, LightLimiter, LightLimits, LimitReached};
use crate::planes::{PlaneSchedule, Raster};
use crate::time::FrameRate;

/// One set of limits and its counts.
#[derive(Clone, Debug)]
struct LimitCounts {
    limits: LightLimits,
    rate: FrameRate,
    limiter: LightLimiter,
}

/// Counts the light of every slot.
#[derive(Clone, Debug, Default)]
pub(super) struct LightGuard {
    /// The limits of the host, and those of the device's owner.
    counted: [Option<LimitCounts>; 2],
    /// Level of the frame on the mirrors.
    level: u32,
}

impl LightGuard {
    /// Starts slots of `rate` under the host's limits and the owner's. Counts under unchanged limits are kept: a host
    /// cannot clear them by another CONFIG.
    pub(super) fn configure(&mut self, rate: FrameRate, host: LightLimits, owner: LightLimits) {
        for (counted, limits) in self.counted.iter_mut().zip([host, owner]) {
            if counted.as_ref().is_none_or(|c| (c.limits, c.rate) != (limits, rate)) {
                *counted =
                    LightLimiter::new(rate, &limits).map(|limiter| LimitCounts { limits, rate, limiter });
            }
        }
    }

    /// Counts `slots` slots that have passed in the dark.
    pub(super) fn was_dark(&mut self, slots: u64) {
        for c in self.counted.iter_mut().flatten() {
            c.limiter.repeated(0, slots);
        }
    }

    /// A slot is about to light `planes`, a frame that was not on the mirrors before. Returns the rest in microseconds
    /// if it must not.
    pub(super) fn new_frame(
        &mut self,
        raster: Raster,
        schedule: &PlaneSchedule,
        planes: &[u8],
    ) -> Option<u64> {
        if self.counted.iter().all(Option::is_none) {
            return None;
        }
        self.level = light_level(raster, schedule, planes);
        self.observe(self.level)
    }

    /// A slot is about to light the frame on the mirrors again.
    pub(super) fn same_frame(&mut self) -> Option<u64> {
        self.observe(self.level)
    }

    /// A slot is dark.
    pub(super) fn dark(&mut self) {
        let _ = self.observe(0);
    }

    fn observe(&mut self, level: u32) -> Option<u64> {
        let mut rest = None;
        for c in self.counted.iter_mut().flatten() {
            let struck: Option<LimitReached> = c.limiter.observe(level);
            rest = rest.max(struck.map(|limit| c.limits.rest_us(limit)));
        }
        rest
    }
}
