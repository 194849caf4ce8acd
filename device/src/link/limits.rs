//! Decides from the level of each slot whether the light of the field exceeds the limits of an installation: a greatest
//! mean over a window of time, and a longest time of full white.
//!
//! The level of a frame is the greatest of the mean drives of its colour channels over all mirrors. However the powers
//! of the LEDs are divided, a field at level `l` emits at most `l` times what it emits in full white. So the limits
//! bound irradiance, and not only perceived brightness. Both ends of the link run the same limiter. The host's limiter
//! acts earlier, by the time that its order to go dark needs ([`LightLimiter::ahead`]), so that the device's never has
//! to. docs/SAFETY.md explains the limits to users.

use super::flash::{FULL_LUMINANCE, REST_US};
use crate::planes::{Channel, PlaneSchedule, Raster};
use crate::time::FrameRate;

/// Number of bins of a window: a window of at most that many slots is summed slot by slot.
const BINS: usize = 256;
/// A slot of at least this level is full white: 95 % of full drive in the strongest channel.
pub const FULL_WHITE_LEVEL: u32 = FULL_LUMINANCE / 20 * 19;
/// An interruption of full white that is shorter than this fraction of a second does not count.
const PAUSES_PER_S: u32 = 10;
/// Longest window and longest time of full white that CONFIG may request, milliseconds (an hour).
pub const MAX_LIMIT_MS: u32 = 3_600_000;
/// Shortest window and shortest time of full white that CONFIG may request, milliseconds.
pub const MIN_LIMIT_MS: u32 = 500;

/// Upper limits on the light of a projector. CONFIG carries them to the device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LightLimits {
    /// Greatest mean level of the field over [`LightLimits::window_ms`], in thousandths of full white, 1 to 1000; 0 is off.
    pub mean_permille: u16,
    /// Length of every window over which the mean is taken, milliseconds, [`MIN_LIMIT_MS`] to [`MAX_LIMIT_MS`]; 0 where the mean is off.
    pub window_ms: u32,
    /// Longest time of full white ([`FULL_WHITE_LEVEL`]) without a pause of a tenth of a second, milliseconds, [`MIN_LIMIT_MS`] to
    /// [`MAX_LIMIT_MS`]; 0 is off.
    pub full_white_ms: u32,
}

/// Which limit the light would have exceeded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum LimitReached {
    /// [`LightLimits::mean_permille`].
    Mean = 1,
    /// [`LightLimits::full_white_ms`].
    FullWhite = 2,
}

impl LightLimits {
    /// Everything off.
    pub const OFF: Self = Self { mean_permille: 0, window_ms: 0, full_white_ms: 0 };

    /// True when no limit is set.
    pub const fn is_off(&self) -> bool {
        self.mean_permille == 0 && self.full_white_ms == 0
    }

    /// True when every value is in its range.
    pub const fn is_valid(&self) -> bool {
        const fn in_range(ms: u32) -> bool {
            ms >= MIN_LIMIT_MS && ms <= MAX_LIMIT_MS
        }
        let mean = if self.mean_permille == 0 { self.window_ms == 0 } else { in_range(self.window_ms) };
        self.mean_permille <= 1000 && mean && (self.full_white_ms == 0 || in_range(self.full_white_ms))
    }

    /// Time for which light stays off after `limit` was reached, microseconds: the length of the window or of the
    /// permitted full white, and never less than [`REST_US`], so that the dark itself is not a flash. A window that
    /// begins afterwards contains nothing of what was counted.
    pub fn rest_us(&self, limit: LimitReached) -> u64 {
        let ms = match limit {
            LimitReached::Mean => self.window_ms,
            LimitReached::FullWhite => self.full_white_ms,
        };
        (u64::from(ms) * 1000).max(u64::from(REST_US))
    }
}

/// Level of a frame, 0 to [`FULL_LUMINANCE`]: the greatest of the mean drives of red, green and blue over all mirrors;
/// planes of [`Channel::White`] count for each. Every row is counted, so no pattern can hide between samples. Schedules
/// with both white and coloured planes, or whose planes exceed full light, can reach twice the full level.
///
/// # Panics
/// When `planes` does not have the size that raster and schedule demand.
pub fn light_level(raster: Raster, schedule: &PlaneSchedule, planes: &[u8]) -> u32 {
    let plane_bytes = raster.plane_bytes();
    assert!(planes.len() == plane_bytes * schedule.len(), "bytes of planes");
    let mut drive = [0u64; 4];
    for (spec, plane) in schedule.planes().iter().zip(planes.chunks_exact(plane_bytes)) {
        let (words, rest) = plane.as_chunks::<8>();
        let lit = words.iter().map(|w| u64::from(u64::from_le_bytes(*w).count_ones())).sum::<u64>()
            + rest.iter().map(|b| u64::from(b.count_ones())).sum::<u64>();
        drive[spec.channel as usize] += lit << spec.bit;
    }
    let white = drive[Channel::White as usize];
    let greatest = drive[..3].iter().map(|d| d + white).fold(0, u64::max);
    let full = raster.pixel_count() as u64 * u64::from(schedule.limit_weight());
    // Rounded up, so that rounding never hides an excess.
    (greatest * u64::from(FULL_LUMINANCE)).div_ceil(full) as u32
}

/// Slots of `rate` that begin within `ms` milliseconds, rounded up, at least 1.
fn slots_in(rate: FrameRate, ms: u64) -> u64 {
    (ms * u64::from(rate.num())).div_ceil(1000 * u64::from(rate.den())).max(1)
}

/// Whole slots of `rate` that fit into `ms` milliseconds, at least 1.
fn slots_within(rate: FrameRate, ms: u64) -> u64 {
    (ms * u64::from(rate.num()) / (1000 * u64::from(rate.den()))).max(1)
}

/// Levels of some slots.
#[derive(Clone, Copy, Debug, Default)]
struct Bin {
    sum: u64,
    greatest: u32,
}

/// The levels of the last slots, in bins.
#[derive(Clone, Debug)]
struct Mean {
    /// Slots that are summed: the window without `reserve`.
    slots: u64,
    /// Number of further slots that may be lit at the same level before an order to go dark takes effect.
    reserve: u64,
    /// Greatest sum of levels over the window and the reserve.
    budget: u64,
    slots_per_bin: u64,
    bins: [Bin; BINS + 1],
    newest: usize,
    /// Slots in the newest bin.
    filled: u64,
}

impl Mean {
    fn new(rate: FrameRate, limits: &LightLimits, reserve: u64) -> Self {
        let window = slots_within(rate, u64::from(limits.window_ms));
        let reserve = reserve.min(window / 2);
        Self {
            slots: window - reserve,
            reserve,
            budget: u64::from(limits.mean_permille) * u64::from(FULL_LUMINANCE) * window / 1000,
            slots_per_bin: (window - reserve).div_ceil(BINS as u64),
            bins: [Bin::default(); BINS + 1],
            newest: 0,
            filled: 0,
        }
    }

    /// An upper bound of the sum of the levels of the last `slots` slots. Only part of the oldest bin's slots lie in
    /// the window; they are assumed to have held as much of its light as they can.
    fn sum(&self) -> u64 {
        let mut sum = self.bins[self.newest].sum;
        let mut left = self.slots.saturating_sub(self.filled);
        for back in 1..=BINS {
            if left == 0 {
                break;
            }
            let bin = &self.bins[(self.newest + BINS + 1 - back) % (BINS + 1)];
            sum += if left >= self.slots_per_bin {
                bin.sum
            } else {
                bin.sum.min(left * u64::from(bin.greatest))
            };
            left = left.saturating_sub(self.slots_per_bin);
        }
        sum
    }

    fn add(&mut self, level: u32, mut slots: u64) {
        // More slots of one level than a window holds count like a window.
        slots = slots.min(self.slots + self.slots_per_bin);
        while slots > 0 {
            if self.filled == self.slots_per_bin {
                self.newest = (self.newest + 1) % (BINS + 1);
                self.bins[self.newest] = Bin::default();
                self.filled = 0;
            }
            let n = slots.min(self.slots_per_bin - self.filled);
            let bin = &mut self.bins[self.newest];
            bin.sum += n * u64::from(level);
            bin.greatest = bin.greatest.max(level);
            self.filled += n;
            slots -= n;
        }
    }

    /// Counts a slot of `level`. True if that slot, and as many more as the reserve, keep every window within the
    /// budget.
    fn takes(&mut self, level: u32) -> bool {
        self.add(level, 1);
        self.sum() + self.reserve * u64::from(level) <= self.budget
    }
}

/// How long the field has been full white.
#[derive(Clone, Debug)]
struct FullWhite {
    allowed: u64,
    pause: u64,
    /// Slots from the first to the last one of full white.
    run: u64,
    /// Slots since the last one of full white.
    since: u64,
}

impl FullWhite {
    fn new(rate: FrameRate, limits: &LightLimits, reserve: u64) -> Self {
        let allowed = slots_within(rate, u64::from(limits.full_white_ms));
        let pause = slots_in(rate, u64::from(1000 / PAUSES_PER_S));
        Self { allowed: allowed - reserve.min(allowed / 2), pause, run: 0, since: 0 }
    }

    fn add(&mut self, level: u32, slots: u64) {
        if level < FULL_WHITE_LEVEL {
            self.since = self.since.saturating_add(slots);
            if self.since >= self.pause {
                self.run = 0;
            }
        } else {
            self.run = if self.run == 0 { slots } else { (self.run + self.since).saturating_add(slots) };
            self.since = 0;
        }
    }

    fn takes(&mut self, level: u32) -> bool {
        self.add(level, 1);
        level < FULL_WHITE_LEVEL || self.run <= self.allowed
    }
}

/// Counts light against [`LightLimits`]. Must observe every slot once, in order, before the slot is lit.
#[derive(Clone, Debug)]
pub struct LightLimiter {
    mean: Option<Mean>,
    full: Option<FullWhite>,
}

impl LightLimiter {
    /// For a device, which goes dark without delay, and slots of `rate`. `None` if no limit is set, or a value is out
    /// of its range.
    pub fn new(rate: FrameRate, limits: &LightLimits) -> Option<Self> {
        Self::with_reserve(rate, limits, 0)
    }

    /// As [`LightLimiter::new`] for a host, whose order to go dark takes up to `ahead_ms` to be obeyed: it acts as soon
    /// as light at the present level for that much longer would exceed a limit. It never acts on light that stays at
    /// one level within the limit.
    pub fn ahead(rate: FrameRate, limits: &LightLimits, ahead_ms: u32) -> Option<Self> {
        // The device first shows what is in its buffers.
        Self::with_reserve(rate, limits, slots_in(rate, u64::from(ahead_ms)) + 3)
    }

    fn with_reserve(rate: FrameRate, limits: &LightLimits, reserve: u64) -> Option<Self> {
        if limits.is_off() || !limits.is_valid() {
            return None;
        }
        Some(Self {
            mean: (limits.mean_permille > 0).then(|| Mean::new(rate, limits, reserve)),
            full: (limits.full_white_ms > 0).then(|| FullWhite::new(rate, limits, reserve)),
        })
    }

    /// Observes the level (0 when dark) at which the next slot would be lit. Returns `Some` if that would exceed a
    /// limit: the slot must not be lit, and light stays off for [`LightLimits::rest_us`]. Then call
    /// [`LightLimiter::reset`].
    pub fn observe(&mut self, level: u32) -> Option<LimitReached> {
        // Both must count every slot, whichever acts.
        let mean = self.mean.as_mut().is_none_or(|m| m.takes(level));
        let full = self.full.as_mut().is_none_or(|f| f.takes(level));
        match (mean, full) {
            (false, _) => Some(LimitReached::Mean),
            (_, false) => Some(LimitReached::FullWhite),
            _ => None,
        }
    }

    /// Notes that `slots` slots were lit at `level` without a decision, because the device repeated a frame. The work
    /// does not grow with `slots`.
    pub fn repeated(&mut self, level: u32, slots: u64) {
        if slots == 0 {
            return;
        }
        if let Some(mean) = &mut self.mean {
            mean.add(level, slots);
        }
        if let Some(full) = &mut self.full {
            full.add(level, slots);
        }
    }

    /// Restarts after a rest, from the dark.
    pub fn reset(&mut self) {
        if let Some(mean) = &mut self.mean {
            (mean.bins, mean.newest, mean.filled) = ([Bin::default(); BINS + 1], 0, 0);
        }
        if let Some(full) = &mut self.full {
            (full.run, full.since) = (0, 0);
        }
    }
}

#[cfg(test)]
#[path = "limits_tests.rs"]
mod tests;
