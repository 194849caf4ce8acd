//! The device's own word on how much light there may be: what CONFIG asks for, and what its owner set, whatever the host says.

use dpm_device::link::{light_level, LightLimiter, LightLimits, LimitReached};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::FrameRate;

/// One set of limits and what counts against it.
#[derive(Debug)]
struct Counted {
    limits: LightLimits,
    rate: FrameRate,
    limiter: LightLimiter,
}

/// Counts the light of every slot.
#[derive(Debug, Default)]
pub(super) struct LightGuard {
    /// Of the host, and of the device's owner.
    counted: [Option<Counted>; 2],
    /// Level of the frame on the mirrors.
    level: u32,
}

impl LightGuard {
    /// Slots of `rate` begin, under the host's limits and the owner's. What was counted under the same limits still counts: a host cannot
    /// make a device forget by asking again.
    pub(super) fn configure(&mut self, rate: FrameRate, host: LightLimits, owner: LightLimits) {
        for (counted, limits) in self.counted.iter_mut().zip([host, owner]) {
            if counted.as_ref().is_none_or(|c| (c.limits, c.rate) != (limits, rate)) {
                *counted = LightLimiter::new(rate, &limits).map(|limiter| Counted { limits, rate, limiter });
            }
        }
    }

    /// `slots` slots have passed in the dark, uncounted until now.
    pub(super) fn was_dark(&mut self, slots: u64) {
        for c in self.counted.iter_mut().flatten() {
            c.limiter.repeated(0, slots);
        }
    }

    /// A slot is about to light `planes`, a frame that was not on the mirrors before. The rest in microseconds when it must not.
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
