//! Says before anything is lit whether a stepping pattern would flash.
//!
//! The limiter judges, at both ends of the link, by 32 rows of a frame. Rows of fine stripes may all fall on lit
//! ones, so steps of equal light can count as flashes. The answer here is the limiter's own.

use super::{Pattern, PatternShow};
use dpm_device::link::{breaks_limit, mean_luminance};
use dpm_device::planes::PlaneSchedule;
use dpm_device::time::FrameRate;
use dpm_render::pack::{pack_codes, BitPlaneFrame, Kernel};

/// The limiter looks back for a second, so a step that is held for longer than two is as good as one held for two.
const LONGEST_S: u64 = 2;

/// The mean light of every picture of a pattern, as the limiter sees it.
fn means(show: &PatternShow, schedule: &PlaneSchedule) -> Vec<u32> {
    let raster = show.raster();
    let mut codes = vec![0; raster.pixel_count()];
    let mut planes = BitPlaneFrame::new(raster, *schedule);
    let mean = |picture| {
        show.fill(picture, &mut codes);
        pack_codes(Kernel::best(), &codes, &mut planes);
        mean_luminance(raster, schedule, planes.bytes())
    };
    show.pictures().map(mean).collect()
}

/// True if `means`, each for `hold` slots of `rate` and over and over, break a limit of `limit` flashes a second.
fn breaks(means: &[u32], schedule: &PlaneSchedule, hold: u64, (rate, limit): (FrameRate, u8)) -> bool {
    let second = u64::from(rate.num()).div_ceil(u64::from(rate.den()));
    let hold = hold.min(LONGEST_S * second) as usize;
    // Twice through, and long enough for a full second in any case.
    let slots = (2 * means.len() * hold).max(2 * second as usize);
    let light = means.iter().flat_map(|&mean| std::iter::repeat_n(mean, hold)).cycle();
    breaks_limit((rate, limit), schedule, light.take(slots))
}

/// True if the pattern's steps would break a limit of `limit` flashes a second (`None` for no limit).
pub fn flashes(show: &PatternShow, schedule: &PlaneSchedule, rate: FrameRate, limit: Option<u8>) -> bool {
    let Some(limit) = limit else { return false };
    // A counter's light is the same for every number.
    let is_still = show.pictures().len() < 2 || show.pattern() == Pattern::Counter;
    !is_still && breaks(&means(show, schedule), schedule, show.hold_frames(), (rate, limit))
}

/// A time for which each step can be held without breaking the limit, milliseconds, to within a tenth; at most two
/// seconds.
pub fn shortest_hold_ms(show: &PatternShow, schedule: &PlaneSchedule, rate: FrameRate, limit: u8) -> u64 {
    let means = means(show, schedule);
    let slots = |ms: u64| ((ms as f64 * 1e-3 * rate.hz()).round() as u64).max(1);
    let mut ms = show.hold_ms().max(10);
    while ms < LONGEST_S * 1000 && breaks(&means, schedule, slots(ms), (rate, limit)) {
        ms += (ms / 10).max(1);
    }
    ms.min(LONGEST_S * 1000)
}
