//! Computes what frames and their slots add to the light of the field and to its flashes, for the host's limiters.

use super::LinkSettings;
use crate::link::flash::{mean_luminance, FlashLimiter};
use crate::link::limits::{light_level, LightLimiter, LimitReached};
use crate::link::slots::SlotClock;
use crate::planes::{PlaneSchedule, Raster};
use crate::time::DeviceTicks;

/// How long the device may continue to show its frames after the host has sent the order to go dark.
const OBEYED_WITHIN_MS: u32 = 50;

/// What a slot shows.
#[derive(Clone, Copy, Debug)]
pub(super) enum SlotLight<'a> {
    /// A frame of these planes.
    New(&'a [u8]),
    /// The frame on the mirrors.
    Same,
    /// Nothing, although the device is armed: BLACK.
    Dark,
    /// Nothing, and the device counts no slots: it is not armed.
    Nothing,
}

/// Which limit the field would exceed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LimitHit {
    /// That of flashes.
    Flashes,
    /// One of those on light.
    Light(LimitReached),
}

/// How bright the frame on the mirrors is; zeros for none.
#[derive(Clone, Copy, Debug, Default)]
struct Brightness {
    /// By [`light_level`].
    level: u32,
    /// By [`mean_luminance`].
    luminance: u32,
}

/// Counts light and flashes of frames in the slots that they are sent for, as the device does that shows them.
#[derive(Debug)]
pub(super) struct FieldCount {
    raster: Raster,
    schedule: PlaneSchedule,
    light: Option<LightLimiter>,
    flash: Option<FlashLimiter>,
    /// Last slot counted in this session.
    slot: Option<u64>,
    /// The frame in it, and the first slot in which that frame no longer repeats by itself.
    held: Brightness,
    over: u64,
}

impl FieldCount {
    pub(super) fn new(settings: &LinkSettings) -> Self {
        let LinkSettings { raster, schedule, rate, .. } = *settings;
        Self {
            raster,
            schedule,
            light: LightLimiter::ahead(rate, &settings.limits, OBEYED_WITHIN_MS),
            flash: settings.flash_limit.map(|limit| FlashLimiter::new(rate, limit).of_planes(&schedule)),
            slot: None,
            held: Brightness::default(),
            over: 0,
        }
    }

    /// Slots are counted anew, from the dark. Earlier light and flashes still count, as if no time had passed.
    pub(super) fn new_session(&mut self) {
        (self.slot, self.held) = (None, Brightness::default());
    }

    /// Mean luminance of the frame that was counted last; 0 if it is kept dark or no limit of flashes is on.
    pub(super) fn luminance(&self) -> u32 {
        self.held.luminance
    }

    /// Counts a frame for the slot that `times`, its target and the end of its light, lie in; returns the limit that it would
    /// exceed. The device is dark then, until a frame is sent.
    ///
    /// A frame that an order keeps from being shown counts as no light. BLACK is a darkness like any other: with the light
    /// before and after it, it is a flash.
    pub(super) fn slot(
        &mut self,
        clock: &SlotClock,
        times: [DeviceTicks; 2],
        shown: SlotLight<'_>,
    ) -> Option<LimitHit> {
        let (slot, before) = self.on_to(clock, times);
        match shown {
            SlotLight::New(planes) => self.held = self.brightness(planes),
            SlotLight::Same => self.over = u64::MAX,
            SlotLight::Dark | SlotLight::Nothing => self.held = Brightness::default(),
        }
        let flashes = self.flash.as_mut().is_some_and(|limiter| {
            if matches!(shown, SlotLight::Nothing) {
                return false;
            }
            let mut first = slot - before.iter().map(|(_, slots)| slots).sum::<u64>();
            let mut is_struck = false;
            for (light, slots) in before.into_iter().chain([(self.held, 1)]) {
                is_struck |= limiter.repeated(first, light.luminance, slots);
                first += slots;
            }
            if is_struck {
                limiter.reset();
            }
            is_struck
        });
        let light = self.light.as_mut().and_then(|limiter| {
            let [repeats, dark] = before;
            limiter.repeated(repeats.0.level, repeats.1);
            limiter.repeated(dark.0.level, dark.1);
            limiter.observe(self.held.level)
        });
        let reached = light.map(LimitHit::Light).or(flashes.then_some(LimitHit::Flashes));
        if reached.is_some() {
            self.held = Brightness::default();
        }
        reached
    }

    /// Counts on to the slot of a frame. Returns its number, and the slots before it and how bright they are: a slot without a
    /// frame of its own repeats the previous one, until the light of that frame is over.
    fn on_to(
        &mut self,
        clock: &SlotClock,
        [target_at, dark_from]: [DeviceTicks; 2],
    ) -> (u64, [(Brightness, u64); 2]) {
        let slot = clock.slot_at(target_at).unwrap_or(0);
        let [repeats, dark] = self.slot.map_or([0, 0], |last| {
            let between = slot.saturating_sub(last + 1);
            let repeats = between.min(self.over.saturating_sub(last + 1));
            [repeats, between - repeats]
        });
        self.slot = Some(self.slot.map_or(slot, |last| last.max(slot)));
        self.over = clock.slot_at(dark_from).map_or(slot, |k| k + 1);
        (slot, [(self.held, repeats), (Brightness::default(), dark)])
    }

    /// Of a frame of `planes`, for the limits that are on.
    fn brightness(&self, planes: &[u8]) -> Brightness {
        let of = |is_on: bool, measure: fn(Raster, &PlaneSchedule, &[u8]) -> u32| {
            if is_on {
                measure(self.raster, &self.schedule, planes)
            } else {
                0
            }
        };
        Brightness {
            level: of(self.light.is_some(), light_level),
            luminance: of(self.flash.is_some(), mean_luminance),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::flash::FULL_LUMINANCE;
    use crate::link::{Epoch, LightLimits, Underrun};
    use crate::rng::Draws;
    use crate::time::FrameRate;

    fn settings(rate: FrameRate, flash_limit: u8) -> LinkSettings {
        LinkSettings {
            raster: Raster::new(8, 1).unwrap(),
            schedule: PlaneSchedule::mono8(),
            rate,
            watchdog_us: 1,
            underrun: Underrun::Repeat,
            late_slots: 0,
            epoch: Epoch::At(DeviceTicks(0)),
            codecs: 0,
            flash_limit: Some(flash_limit),
            limits: LightLimits::OFF,
        }
    }

    /// When a slot has no new frame, the device repeats the last one, and its flash limiter counts the slot. The host's
    /// limiter counts the same slots and must trigger first, for any hold time, arming time, brightness and cause of the
    /// dark. Dim light is the hard case: an eighth of full falls by less than a tenth where a dark slot is shared by two
    /// averages.
    #[test]
    fn the_host_counts_flashes_as_often_as_the_device_and_strikes_first() {
        for (rate, limit) in [(60, 3), (240, 3), (947, 3), (2000, 1)] {
            let rate = FrameRate::new(rate, 1).unwrap();
            let clock = SlotClock::new(DeviceTicks(0), 1_000_000_000, rate).unwrap();
            let mut strikes = 0;
            for seed in 0..40 {
                let draws = Draws::new(seed);
                let mut host = FieldCount::new(&settings(rate, limit));
                let mut device = FlashLimiter::backstop(rate, limit);
                let (armed, first) = (draws.bits(1 << 20) % 40, draws.bits(1 << 21) % 40);
                device.repeated(armed, 0, first);
                let pixels: u8 = if seed % 2 == 0 { 0xff } else { 0x10 };
                // An operator, or a program of his, orders BLACK and ARM in turn.
                let is_ordered = seed % 5 < 2;
                let lit = FULL_LUMINANCE / 8 * pixels.count_ones();
                let (mut slot, mut on, mut left) = (armed + first, false, 0);
                for i in 0..4000 {
                    // Light that flashes up to 27 times a second, in frames that are held for one to four slots: counted by
                    // frames, the fastest flashes would be averaged out.
                    if left <= 0 {
                        on = !on;
                        let slots = u64::from(rate.num());
                        left = (slots / 54 + draws.bits(2 * i) % (slots / 20 + 1)) as i64;
                        if seed % 4 == 1 {
                            left = left.min(1 + (slots / 60) as i64 * 5 / 4);
                        }
                    }
                    let held = 1 + draws.bits(2 * i + 1) % 4;
                    left -= held as i64;
                    let luminance = if on { lit } else { 0 };
                    let times = [slot, slot + 100].map(|slot| clock.start(slot));
                    let planes = [if on || is_ordered { pixels } else { 0 }; 8];
                    let shown = if on || !is_ordered { SlotLight::New(&planes) } else { SlotLight::Dark };
                    if host.slot(&clock, times, shown) == Some(LimitHit::Flashes) {
                        strikes += 1;
                        break;
                    }
                    assert!(
                        !device.repeated(slot, luminance, held),
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
            let mut slot = 0;
            for i in 0..400 {
                let luminance = (draws.bits(2 * i) % 2) as u32 * FULL_LUMINANCE;
                let slots = draws.bits(2 * i + 1) % (3 * u64::from(rate.num()));
                let slots = if i % 3 == 0 { slots } else { slots % 40 };
                let one_more = |struck, k| one_by_one.observe(slot + k, luminance) || struck;
                let single = (0..slots).fold(false, one_more);
                assert_eq!(at_once.repeated(slot, luminance, slots), single, "{rate:?}, {i}: {slots} slots");
                slot += slots;
            }
        }
    }
}
