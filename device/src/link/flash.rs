//! Decides from the mean light of the whole field, slot by slot, whether it flashes more than is safe for people.
//!
//! A flash is a pair of opposing changes of the field's luminance by a tenth of full or more, with the darker side
//! below 0.8 of full. More than three in a second can cause seizures \[WCAG22\] 2.3.1, \[BT1702\]. Changes that are too
//! fast for the eye do not count: luminance is averaged over a sixtieth of a second first, so alternating frames at 947
//! Hz are steady light and a beat at 10 Hz is not. Both ends of the link run the same limiter.

use crate::planes::{Channel, PlaneSchedule, Raster};
use crate::time::FrameRate;

/// Full light of all three channels.
pub const FULL_LUMINANCE: u32 = 65_535;
/// A change that counts: a tenth of full.
const STEP: u32 = FULL_LUMINANCE / 10;
/// The darker side of a flash is below this.
const DARK_SIDE: u32 = FULL_LUMINANCE * 8 / 10;
/// Most flashes a second that the standards allow.
pub const MAX_FLASHES_PER_S: u8 = 3;
/// Most flashes a second that are possible in averages over a sixtieth of a second.
pub const HIGHEST_LIMIT: u8 = 30;
/// Light stays off for this long after the limiter has acted: the dark itself must not become a flash.
pub const REST_US: u32 = 2_000_000;
/// Rows of a plane that are counted; more rows change the mean only insignificantly.
const ROWS: u32 = 32;

/// Bytes of rows that are counted in one step.
const NEAR_BYTES: usize = 2048;

fn ones(bytes: &[u8]) -> u64 {
    let (words, rest) = bytes.as_chunks::<8>();
    let words: u64 = words.iter().map(|w| u64::from(u64::from_le_bytes(*w).count_ones())).sum();
    words + rest.iter().map(|b| u64::from(b.count_ones())).sum::<u64>()
}

/// Mean luminance of a frame, 0 to [`FULL_LUMINANCE`], from evenly spaced rows of its planes. Channel weights are those of Rec. 709.
///
/// # Panics
/// When `planes` does not have the size that raster and schedule demand.
pub fn mean_luminance(raster: Raster, schedule: &PlaneSchedule, planes: &[u8]) -> u32 {
    let (plane_bytes, row_bytes) = (raster.plane_bytes(), raster.row_bytes());
    assert!(planes.len() == plane_bytes * schedule.len(), "bytes of planes");
    let rows = raster.height().min(ROWS);
    let mut light = 0u64;
    // The rows come from memory that no cache near this core holds. Copies alone keep many of these reads on their way
    // at once; between two of them there is no room for counting.
    let (mut near, mut filled) = ([0u8; NEAR_BYTES], 0);
    for (spec, plane) in schedule.planes().iter().zip(planes.chunks_exact(plane_bytes)) {
        let mut lit = 0u64;
        for i in 0..rows {
            // The middle row of each of `rows` equal bands.
            let y = ((2 * i + 1) * raster.height() / (2 * rows)) as usize;
            for piece in plane[y * row_bytes..][..row_bytes].chunks(NEAR_BYTES) {
                if filled + piece.len() > NEAR_BYTES {
                    lit += ones(&near[..filled]);
                    filled = 0;
                }
                near[filled..filled + piece.len()].copy_from_slice(piece);
                filled += piece.len();
            }
        }
        lit += ones(&near[..filled]);
        filled = 0;
        let weight = match spec.channel {
            Channel::Red => 2126,
            Channel::Green => 7152,
            Channel::Blue => 722,
            Channel::White => 10_000,
        };
        light += lit * (weight << spec.bit);
    }
    let full = u64::from(rows) * u64::from(raster.width()) * u64::from(schedule.white_weight()) * 10_000;
    (light * u64::from(FULL_LUMINANCE) / full).min(u64::from(FULL_LUMINANCE)) as u32
}

/// True if light of planes of `schedule` with these luminances, slot by slot, breaks a limit of `limit` flashes a second in some slot that it may begin in.
pub fn breaks_limit(
    (rate, limit): (FrameRate, u8),
    schedule: &PlaneSchedule,
    light: impl Iterator<Item = u32> + Clone,
) -> bool {
    let limiter = FlashLimiter::new(rate, limit).of_planes(schedule);
    (0..limiter.slots_per_window).any(|first| {
        let mut limiter = limiter.clone();
        light.clone().zip(u64::from(first)..).any(|(luminance, slot)| limiter.observe(slot, luminance))
    })
}

/// Counts flashes from the light of slots, each observed once, in order.
///
/// Averages begin at slots whose number is a multiple of their length, so both ends of the link see the same ones. Otherwise a
/// short darkness is one dark average at one end, and two half-lit ones, too bright for a change, at the other. Where slots were
/// left out, because the device was not armed or a session began, no time has passed, and those of the average that has begun
/// were dark.
#[derive(Clone, Debug)]
pub struct FlashLimiter {
    slots_per_window: u32,
    windows_per_s: u32,
    /// Opposing changes that are allowed within a second: two per flash.
    allowed: usize,
    /// The slot after the last one observed, how many of its window are over, and the sum of their light.
    next_slot: u64,
    in_window: u32,
    sum: u64,
    window: u32,
    /// A change that counts.
    step: u32,
    /// Lowest or highest window mean since the last change, and the direction of that change.
    extreme: u32,
    rising: Option<bool>,
    /// Windows of the last changes, oldest overwritten.
    changes: [u32; 2 * HIGHEST_LIMIT as usize + 1],
    count: usize,
}

impl FlashLimiter {
    /// For slots of `rate`; `limit` flashes a second, 1 to [`HIGHEST_LIMIT`] (clamped), are allowed.
    pub fn new(rate: FrameRate, limit: u8) -> Self {
        // Even, so that light that alternates from slot to slot averages out exactly.
        let slots = rate.num() / rate.den().saturating_mul(60).max(1);
        let slots_per_window = if slots > 1 { slots & !1 } else { 1 };
        let per_s = rate.num().div_ceil(rate.den()).div_ceil(slots_per_window).max(1);
        Self {
            slots_per_window,
            windows_per_s: per_s,
            allowed: 2 * limit.clamp(1, HIGHEST_LIMIT) as usize,
            next_slot: 0,
            in_window: 0,
            sum: 0,
            window: 0,
            step: STEP,
            extreme: 0,
            rising: None,
            changes: [0; 2 * HIGHEST_LIMIT as usize + 1],
            count: 0,
        }
    }

    /// As [`FlashLimiter::new`], with a margin of one flash: for a device behind a host that limits too. The host must
    /// act first, and the darkness that it orders is one more change.
    pub fn backstop(rate: FrameRate, limit: u8) -> Self {
        let limiter = Self::new(rate, limit);
        Self { allowed: (limiter.allowed + 2).min(limiter.changes.len() - 1), ..limiter }
    }

    /// For planes of `schedule`: where they exceed full light, changes count from the same light on as with those that do not.
    pub fn of_planes(self, schedule: &PlaneSchedule) -> Self {
        Self { step: STEP * schedule.limit_weight() / schedule.white_weight(), ..self }
    }

    /// Observes the light of slot number `slot` (0 when dark). Returns `true` if this slot makes more flashes in the last
    /// second than allowed: the light must go off and stay off for [`REST_US`].
    pub fn observe(&mut self, slot: u64, luminance: u32) -> bool {
        self.repeated(slot, luminance, 1)
    }

    /// Observes `slots` slots of the same light, from number `first` on. Returns `true` as [`FlashLimiter::observe`] does, if
    /// any of them is one too many.
    pub fn repeated(&mut self, first: u64, luminance: u32, slots: u64) -> bool {
        let of_window = u64::from(self.slots_per_window);
        if slots == 0 {
            return false;
        }
        if first != self.next_slot {
            (self.sum, self.in_window) = (0, (first % of_window) as u32);
        }
        self.next_slot = first.saturating_add(slots);
        // Light that has not changed for a second changes nothing more: whole windows only pass.
        let idle = (slots / of_window).saturating_sub(2 * u64::from(self.windows_per_s));
        let mut left = slots - idle * of_window;
        let mut is_struck = false;
        while left > 0 {
            let taken = left.min(of_window - u64::from(self.in_window));
            left -= taken;
            self.sum += taken * u64::from(luminance.min(FULL_LUMINANCE));
            self.in_window += taken as u32;
            is_struck |= self.in_window == self.slots_per_window && self.window_ends();
        }
        self.window = self.window.wrapping_add(idle as u32);
        is_struck
    }

    fn window_ends(&mut self) -> bool {
        let mean = (self.sum / u64::from(self.in_window)) as u32;
        (self.sum, self.in_window) = (0, 0);
        self.window = self.window.wrapping_add(1);
        self.changed(mean) && self.too_many()
    }

    /// Restarts after a rest, from the dark.
    pub fn reset(&mut self) {
        (self.sum, self.extreme, self.count) = (0, 0, 0);
        self.rising = None;
    }

    /// True when `mean` completes a change that opposes the one before.
    fn changed(&mut self, mean: u32) -> bool {
        let up = mean >= self.extreme.saturating_add(self.step) && self.extreme < DARK_SIDE;
        let down = self.extreme >= mean.saturating_add(self.step) && mean < DARK_SIDE;
        match self.rising {
            // In the direction of the last change the extreme follows the mean.
            Some(true) if mean > self.extreme => self.extreme = mean,
            Some(false) if mean < self.extreme => self.extreme = mean,
            Some(true) if down => return self.note(mean, false),
            Some(false) if up => return self.note(mean, true),
            None if up => return self.note(mean, true),
            None if down => return self.note(mean, false),
            _ => {}
        }
        false
    }

    fn note(&mut self, mean: u32, rising: bool) -> bool {
        (self.extreme, self.rising) = (mean, Some(rising));
        let n = self.changes.len();
        self.changes[self.count % n] = self.window;
        self.count += 1;
        true
    }

    /// More than the allowed changes lie within the last second.
    fn too_many(&self) -> bool {
        let n = self.changes.len();
        self.count > self.allowed && {
            let oldest = self.changes[(self.count - 1 - self.allowed) % n];
            self.window.wrapping_sub(oldest) < self.windows_per_s
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rate() -> FrameRate {
        FrameRate::new(947, 1).unwrap()
    }

    /// Time until the limiter acts, within `seconds` of a light that follows `f` (time in seconds to luminance 0..1).
    fn strikes(seconds: f64, f: impl Fn(f64) -> f64) -> Option<f64> {
        let mut limiter = FlashLimiter::new(rate(), MAX_FLASHES_PER_S);
        (0..(seconds * 947.0) as u64)
            .map(|slot| (slot, (slot as f64 + 0.25) / 947.0))
            .find(|(slot, t)| limiter.observe(*slot, (f(*t) * f64::from(FULL_LUMINANCE)) as u32))
            .map(|(_, t)| t)
    }

    fn square(hz: f64, low: f64, high: f64) -> impl Fn(f64) -> f64 {
        move |t| if (t * hz).fract() < 0.5 { high } else { low }
    }

    #[test]
    fn four_flashes_a_second_and_more_strike_three_do_not() {
        for hz in [1.0, 2.0, 2.9] {
            assert_eq!(strikes(20.0, square(hz, 0.0, 1.0)), None, "{hz} Hz");
        }
        for hz in [4.0, 8.0, 15.0, 25.0] {
            let at = strikes(20.0, square(hz, 0.0, 1.0)).unwrap_or_else(|| panic!("{hz} Hz"));
            // The seventh change, the first being that from the dark: after three periods and a window.
            assert!(at <= 3.5 / hz + 0.04, "{hz} Hz: {at} s");
            assert!(strikes(20.0, square(hz, 0.3, 0.45)).is_some(), "{hz} Hz, a seventh of full");
        }
    }

    #[test]
    fn what_is_no_flash_does_not_strike() {
        assert_eq!(strikes(5.0, square(473.5, 0.0, 1.0)), None, "every other frame dark: too fast for eyes");
        assert_eq!(strikes(5.0, square(10.0, 0.5, 0.58)), None, "less than a tenth");
        assert_eq!(strikes(5.0, square(10.0, 0.85, 1.0)), None, "the darker side is bright");
        assert_eq!(strikes(5.0, |t| (t * 0.4).fract()), None, "slow ramps that fall at 0.4 Hz");
        assert_eq!(strikes(60.0, |_| 1.0), None);
        assert_eq!(strikes(5.0, |t| 0.5 + 0.04 * (t * 50.0).sin()), None);
    }

    /// Whichever slot a limiter begins with, and whichever dark slots it does not see, it strikes in the same slot as another: a
    /// darkness of one average that begins amid two would not be seen in light that is this dim.
    #[test]
    fn averages_are_those_of_the_same_slots() {
        let rate = FrameRate::new(240, 1).unwrap();
        let light = |slot: u64| if slot < 120 || slot % 20 < 4 { 0 } else { FULL_LUMINANCE / 8 };
        let strikes = |observed: &dyn Fn(&u64) -> bool| {
            let mut limiter = FlashLimiter::new(rate, MAX_FLASHES_PER_S);
            (0..480).filter(observed).find(|slot| limiter.observe(*slot, light(*slot)))
        };
        let all = strikes(&|_| true);
        assert!(all.is_some_and(|slot| slot < 240), "{all:?}");
        for first in 1..9 {
            assert_eq!(strikes(&|slot| *slot >= first), all, "from slot {first}");
            assert_eq!(strikes(&|slot| !(50..50 + first).contains(slot)), all, "{first} slots left out");
        }
    }

    /// A flash of a tenth of full light counts, whatever more the planes can give; one of less light does not.
    #[test]
    fn planes_that_exceed_full_light_flash_by_the_same_light() {
        let (raster, rate) = (Raster::new(8, 8).unwrap(), rate());
        for schedule in [PlaneSchedule::rgb24(), PlaneSchedule::split_rgb24()] {
            for (sum, strikes) in [(20, false), (24, false), (28, true), (128, true)] {
                // Planes of these bits, each once, in all three channels.
                let mut left = [sum; 3];
                let planes: Vec<u8> = schedule
                    .planes()
                    .iter()
                    .flat_map(|p| {
                        let left = &mut left[p.channel as usize];
                        let is_on = *left >> p.bit & 1 == 1;
                        *left &= if is_on { !(1 << p.bit) } else { !0 };
                        [if is_on { 0xff } else { 0 }; 8]
                    })
                    .collect();
                let bright = mean_luminance(raster, &schedule, &planes);
                let light = (0..1894).map(|slot| if slot / 80 % 2 == 0 { bright } else { 0 });
                assert_eq!(breaks_limit((rate, 3), &schedule, light), strikes, "{sum}");
            }
        }
    }

    #[test]
    fn luminance_is_that_of_the_code_values() {
        let raster = Raster::new(72, 40).unwrap();
        let schedule = PlaneSchedule::rgb24();
        let n = raster.plane_bytes();
        let frame = |code: [u8; 3]| -> Vec<u8> {
            schedule
                .planes()
                .iter()
                .flat_map(|p| {
                    let bit = code[p.channel as usize] >> p.bit & 1;
                    std::iter::repeat_n(if bit == 1 { 0xff } else { 0 }, n)
                })
                .collect()
        };
        for (code, expected) in [
            ([255, 255, 255], 1.0),
            ([0, 0, 0], 0.0),
            ([128, 0, 0], 0.2126 * 128.0 / 255.0),
            ([0, 77, 200], (0.7152 * 77.0 + 0.0722 * 200.0) / 255.0),
        ] {
            let got = f64::from(mean_luminance(raster, &schedule, &frame(code))) / f64::from(FULL_LUMINANCE);
            assert!((got - expected).abs() < 2e-5, "{code:?}: {got}, {expected}");
        }
        // A picture that is bright in its left half only.
        let mut half = frame([255; 3]);
        for row in half.chunks_mut(9) {
            row[4] = 0xf0;
            row[5..].fill(0);
        }
        let got = mean_luminance(raster, &schedule, &half);
        assert!(got.abs_diff(FULL_LUMINANCE / 2) <= 1, "{got}");
    }
}
