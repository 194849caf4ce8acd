//! Counts the flashes of the field by what the device reports that it showed.
//!
//! The count of frames as they are sent acts before a flash is seen, but it assumes that the device shows them. Where a cable
//! carries some of them only, or late, the light flickers and the device would latch a fault. Its STATUS says which slots were
//! lit, so the host rests first.

use crate::link::flash::FlashLimiter;
use crate::link::message::Status;
use crate::planes::PlaneSchedule;
use crate::time::FrameRate;

/// Sent frames whose light may still be reported: more than a device holds.
const REMEMBERED: usize = 64;

/// See the module's documentation.
#[derive(Debug)]
pub(super) struct ReportedField {
    /// One for each order of light and darkness within a STATUS.
    limiters: [FlashLimiter; 2],
    /// Sent frames and their mean luminance.
    sent: [(u32, u32); REMEMBERED],
    next: usize,
    /// The STATUS before, and the luminance of the frame that it named.
    before: Option<(Status, u32)>,
}

impl ReportedField {
    /// For slots of `rate` with planes of `schedule`, and a limit of flashes a second.
    pub(super) fn new(rate: FrameRate, limit: u8, schedule: &PlaneSchedule) -> Self {
        let limiter = FlashLimiter::new(rate, limit).of_planes(schedule);
        Self { limiters: [limiter.clone(), limiter], sent: [(0, 0); REMEMBERED], next: 0, before: None }
    }

    /// Counters begin at zero again.
    pub(super) fn new_session(&mut self) {
        (self.sent, self.before) = ([(0, 0); REMEMBERED], None);
    }

    /// A frame of this mean luminance was sent.
    pub(super) fn sent(&mut self, frame: u32, luminance: u32) {
        self.sent[self.next] = (frame, luminance);
        self.next = (self.next + 1) % REMEMBERED;
    }

    /// Counts the slots since the last STATUS, the last of which is `slot`. True if they make one flash too many.
    pub(super) fn observe(&mut self, status: &Status, slot: u64) -> bool {
        if self.before.is_some_and(|(before, _)| before.slots == status.slots) {
            return false;
        }
        let of_frame = self.sent.iter().find(|(frame, _)| *frame == status.last_lit_frame);
        let Some((before, light)) = self.before else {
            self.before = Some((*status, of_frame.map_or(0, |(_, luminance)| *luminance)));
            return false;
        };
        // A frame that is not remembered any more is as bright as the one before.
        let new_light = of_frame.map_or(light, |(_, luminance)| *luminance);
        self.before = Some((*status, new_light));
        let since = |now: u32, then: u32| u64::from(now.wrapping_sub(then));
        let lit =
            since(status.frames_lit, before.frames_lit) + since(status.slots_repeated, before.slots_repeated);
        let blank = since(status.slots_blank, before.slots_blank);
        // The order in which they came is not reported: neither of the two extremes may flash too often.
        let from = (slot + 1).saturating_sub(lit + blank);
        let [light_first, dark_first] = &mut self.limiters;
        let mut is_struck = light_first.repeated(from, new_light, lit);
        is_struck |= light_first.repeated(from + lit, 0, blank);
        is_struck |= dark_first.repeated(from, 0, blank);
        is_struck |= dark_first.repeated(from + blank, new_light, lit);
        if is_struck {
            self.limiters.iter_mut().for_each(FlashLimiter::reset);
        }
        is_struck
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::flash::FULL_LUMINANCE;
    use crate::rng::Draws;

    /// A device whose cable carries frames as it likes: they come late or not at all, light flickers, and several slots share a
    /// STATUS, at most a quarter of those over which light is averaged. The host strikes before the device does, and not while light is steady.
    #[test]
    fn the_host_strikes_before_a_device_that_flickers() {
        for (rate, limit) in [(60, 3), (240, 3), (947, 3), (2000, 1)] {
            let rate = FrameRate::new(rate, 1).unwrap();
            let mut strikes = 0;
            for seed in 0..40 {
                let draws = Draws::new(seed);
                let mut host = ReportedField::new(rate, limit, &PlaneSchedule::rgb24());
                let mut device = FlashLimiter::backstop(rate, limit);
                let mut status = Status::default();
                let is_steady = seed % 4 == 0;
                let merged = 1 + draws.bits(1 << 20) % (u64::from(rate.num()) / 240).clamp(1, 4);
                let (mut on, mut left, mut struck) = (true, 40, false);
                host.sent(0, FULL_LUMINANCE);
                host.observe(&status, 0);
                let slots = u64::from(rate.num());
                for slot in 1..4 * slots {
                    left -= 1;
                    if left == 0 {
                        (on, left) = (!on || is_steady, 1 + (draws.bits(slot) % (slots / 20 + 2)));
                    }
                    status.slots += 1;
                    status.lit = on;
                    *(if on { &mut status.slots_repeated } else { &mut status.slots_blank }) += 1;
                    let device_strikes = device.observe(slot, if on { FULL_LUMINANCE } else { 0 });
                    if slot % merged == 0 && host.observe(&status, slot) {
                        struck = true;
                        break;
                    }
                    assert!(!device_strikes, "{rate:?}, seed {seed}: the device is first, in slot {slot}");
                }
                assert!(!(struck && is_steady), "steady light is no flash");
                strikes += u32::from(struck);
            }
            assert!(strikes >= 25, "{rate:?}: {strikes} of 30");
        }
    }

    /// Light that is dim, or that no limit was asked for, strikes nothing.
    #[test]
    fn what_is_dim_does_not_flash() {
        let rate = FrameRate::new(947, 1).unwrap();
        let mut host = ReportedField::new(rate, 3, &PlaneSchedule::rgb24());
        host.sent(7, FULL_LUMINANCE / 20);
        let mut status = Status { last_lit_frame: 7, ..Status::default() };
        for slot in 0..4000u64 {
            status.lit = slot / 60 % 2 == 0;
            *(if status.lit { &mut status.slots_repeated } else { &mut status.slots_blank }) += 1;
            assert!(!host.observe(&status, slot));
        }
    }
}
