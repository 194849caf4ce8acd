//! Computes what frames and their slots add to the light of the field and to its flashes, for the host's limiters.

use crate::link::flash::FlashLimiter;
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

/// The frame on the mirrors, as far as the host knows, and up to which slot it has been counted.
#[derive(Debug, Default)]
struct Held {
    /// Last slot counted in this session.
    slot: Option<u64>,
    /// The first slot in which the frame no longer repeats by itself.
    over: u64,
    /// Its level or luminance; 0 for none.
    value: u32,
}

impl Held {
    /// Slots are counted anew, from the dark. Earlier light still counts, as if no time had passed.
    fn new_session(&mut self) {
        (self.slot, self.value) = (None, 0);
    }

    /// Counts on to the slot that `target_at` lies in, whose frame is lit until `dark_from`. Returns the light of the slots
    /// before it, and how many they are: a slot without a frame of its own repeats the previous one, until the light of that
    /// frame is over.
    fn on_to(&mut self, clock: &SlotClock, [target_at, dark_from]: [DeviceTicks; 2]) -> [(u32, u64); 2] {
        let slot = clock.slot_at(target_at).unwrap_or(0);
        let [repeats, dark] = self.slot.map_or([0, 0], |last| {
            let between = slot.saturating_sub(last + 1);
            let repeats = between.min(self.over.saturating_sub(last + 1));
            [repeats, between - repeats]
        });
        self.slot = Some(self.slot.map_or(slot, |last| last.max(slot)));
        self.over = clock.slot_at(dark_from).map_or(slot, |k| k + 1);
        [(self.value, repeats), (0, dark)]
    }
}

/// Counts the light of frames in the slots that they are sent for.
#[derive(Debug)]
pub(super) struct LightCount {
    limiter: Option<LightLimiter>,
    held: Held,
}

impl LightCount {
    pub(super) fn new(rate: FrameRate, limits: &LightLimits) -> Self {
        Self { limiter: LightLimiter::ahead(rate, limits, OBEYED_WITHIN_MS), held: Held::default() }
    }

    pub(super) fn is_off(&self) -> bool {
        self.limiter.is_none()
    }

    /// The device is dark until a frame is sent.
    pub(super) fn is_dark(&mut self) {
        self.held.value = 0;
    }

    /// As [`Held::new_session`].
    pub(super) fn new_session(&mut self) {
        self.held.new_session();
    }

    /// Counts a frame for the slot that `times`, its target and the end of its light, lie in; returns the limit that its light
    /// would exceed.
    pub(super) fn slot(
        &mut self,
        clock: &SlotClock,
        times: [DeviceTicks; 2],
        shown: Shown,
    ) -> Option<LimitReached> {
        let limiter = self.limiter.as_mut()?;
        for (level, slots) in self.held.on_to(clock, times) {
            limiter.repeated(level, slots);
        }
        match shown {
            Shown::New(level) => self.held.value = level,
            Shown::Same => self.held.over = u64::MAX,
            Shown::Nothing => self.held.value = 0,
        }
        limiter.observe(self.held.value)
    }
}

/// Counts the flashes of frames in the slots that they are sent for, as the device does that shows them.
#[derive(Debug)]
pub(super) struct FlashCount {
    limiter: FlashLimiter,
    held: Held,
}

impl FlashCount {
    pub(super) fn new(rate: FrameRate, limit: u8) -> Self {
        Self { limiter: FlashLimiter::new(rate, limit), held: Held::default() }
    }

    /// The device is dark until a frame is sent.
    pub(super) fn is_dark(&mut self) {
        self.held.value = 0;
    }

    /// As [`Held::new_session`].
    pub(super) fn new_session(&mut self) {
        self.held.new_session();
    }

    /// Counts a frame of mean `luminance` for the slot that `times`, its target and the end of its light, lie in; `None` for a
    /// frame that an order keeps dark, which counts neither as light nor as a flash. True if the field flashes too often: it
    /// is counted from the dark then.
    pub(super) fn slot(
        &mut self,
        clock: &SlotClock,
        times: [DeviceTicks; 2],
        luminance: Option<u32>,
    ) -> bool {
        let before = self.held.on_to(clock, times);
        self.held.value = luminance.unwrap_or(0);
        let Some(luminance) = luminance else { return false };
        let mut is_struck = false;
        for (luminance, slots) in before.into_iter().chain([(luminance, 1)]) {
            is_struck |= self.limiter.repeated(luminance, slots);
        }
        if is_struck {
            self.limiter.reset();
        }
        is_struck
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::flash::FULL_LUMINANCE;
    use crate::rng::Draws;

    /// A device that has no frame of its own for a slot shows the one before, and its limiter counts the slot: so does the
    /// host's, and strikes first, however many slots its frames are held for.
    #[test]
    fn the_host_counts_flashes_as_often_as_the_device_and_strikes_first() {
        for (rate, limit) in [(60, 3), (240, 3), (947, 3), (2000, 1)] {
            let rate = FrameRate::new(rate, 1).unwrap();
            let clock = SlotClock::new(DeviceTicks(0), 1_000_000_000, rate).unwrap();
            let mut strikes = 0;
            for seed in 0..40 {
                let draws = Draws::new(seed);
                let mut host = FlashCount::new(rate, limit);
                let mut device = FlashLimiter::backstop(rate, limit);
                let (mut slot, mut on, mut left) = (0, false, 0);
                for i in 0..4000 {
                    // Light that flashes up to 27 times a second, in frames that are held for one to four slots: counted by
                    // frames, the fastest flashes would be averaged out.
                    if left <= 0 {
                        on = !on;
                        let slots = u64::from(rate.num());
                        left = (slots / 54 + draws.bits(2 * i) % (slots / 20 + 1)) as i64;
                    }
                    let held = 1 + draws.bits(2 * i + 1) % 4;
                    left -= held as i64;
                    let luminance = if on { FULL_LUMINANCE } else { 0 };
                    let times = [slot, slot + 100].map(|slot| clock.start(slot));
                    if host.slot(&clock, times, Some(luminance)) {
                        strikes += 1;
                        break;
                    }
                    assert!(
                        !device.repeated(luminance, held),
                        "the device strikes first: {rate:?}, seed {seed}, frame {i}"
                    );
                    slot += held;
                }
            }
            assert!(strikes >= 30, "{rate:?}: {strikes} of 40 flashed too often");
        }
    }

    /// Slots of the same light are as many single ones, whatever their number.
    #[test]
    fn repeated_light_is_counted_slot_by_slot() {
        for rate in [24, 60, 947] {
            let rate = FrameRate::new(rate, 1).unwrap();
            let [mut at_once, mut one_by_one] = [FlashLimiter::new(rate, 3), FlashLimiter::new(rate, 3)];
            let draws = Draws::new(rate.num().into());
            for i in 0..400 {
                let luminance = (draws.bits(2 * i) % 2) as u32 * FULL_LUMINANCE;
                let slots = draws.bits(2 * i + 1) % (3 * u64::from(rate.num()));
                let slots = if i % 3 == 0 { slots } else { slots % 40 };
                let single = (0..slots).fold(false, |struck, _| one_by_one.observe(luminance) || struck);
                assert_eq!(at_once.repeated(luminance, slots), single, "{rate:?}, {i}: {slots} slots");
            }
        }
    }
}
