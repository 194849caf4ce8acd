//! What the projector truly showed, slot by slot, from the reports of its light.
//!
//! On a link or a machine that is too slow a frame falls into a later slot than it was made for, and a slot without a frame
//! of its own repeats the one before. The light begins at the border of some slot all the same, so the borders are found
//! from all reports, and each slot is told whose picture it showed.

use dpm_calibration::sensor::Timing;
use dpm_device::time::{FrameRate, HostTime};
use dpm_rig::failure::{Failure, FailureKind};

/// Light that begins further than this from the border of a slot, nanoseconds, is left out.
const STRAY_NS: f64 = 100_000.0;
/// The projector's clock differs from the host's by less than this share.
const MOST_CLOCK: f64 = 1e-3;
/// Fewest reports.
const FEWEST: usize = 60;

/// When the slots begin, and whose picture each of them showed.
#[derive(Clone, Debug, PartialEq)]
pub struct Showing {
    /// When the slots begin.
    pub timing: Timing,
    /// Each slot in which a new picture came, with the slot that it was made for; in order.
    begins: Vec<(u64, u64)>,
}

impl Showing {
    /// From the slot for which each lit frame was made, and its first photon. `rate` is that of the rig file; the
    /// projector's own clock may differ from it by some hundred parts per million.
    ///
    /// # Errors
    /// Too few frames were lit, or their light did not come at this rate (exit code 3).
    pub fn of(lights: &[(u64, HostTime)], rate: FrameRate) -> Result<Self, Failure> {
        let failed = |told: String| Failure::new(FailureKind::Device, told);
        let few = |n: usize| {
            failed(format!("only {n} frames were lit; is the link fast enough? `dpm link-test` measures it"))
        };
        let mut lights: Vec<(u64, HostTime)> = lights.to_vec();
        lights.sort_by_key(|(_, at)| *at);
        if lights.len() < FEWEST {
            return Err(few(lights.len()));
        }
        let numbers = numbers(&lights, 1e9 / rate.hz());
        let first = lights[0].1;
        let mut used: Vec<(f64, f64)> =
            numbers.iter().zip(&lights).map(|(k, (_, at))| (*k as f64, at.ns_since(first) as f64)).collect();
        let frame_ns = 1e9 / rate.hz();
        let mut line = line_through(&used);
        // What strays widest goes first: one bad report must not take good ones with it.
        for stray in [20.0 * STRAY_NS, 3.0 * STRAY_NS, STRAY_NS, STRAY_NS] {
            used.retain(|(x, y)| (y - line.0 - line.1 * x).abs() < stray);
            let is_other_rate = (line.1 / frame_ns - 1.0).abs() > MOST_CLOCK;
            if used.len() < FEWEST.max(lights.len() / 2) || is_other_rate {
                return Err(failed(format!(
                    "the light of {} frames does not begin at the borders of {:.3} slots a second: is \
                     projector.frame_rate the projector's own?",
                    lights.len(),
                    rate.hz()
                )));
            }
            line = line_through(&used);
        }
        // No frame comes before its slot, and some come in it.
        let ahead = lights.iter().zip(&numbers).map(|((slot, _), k)| *slot as i64 - k).max().unwrap_or(0);
        let frame_zero_ns = first.0 + (line.0 - line.1 * ahead as f64).round() as i64;
        let slot_of = |k: &i64| u64::try_from(k + ahead).ok();
        let begins =
            numbers.iter().zip(&lights).filter_map(|(k, (made_for, _))| Some((slot_of(k)?, *made_for)));
        Ok(Self { timing: Timing { frame_zero_ns, frame_ns: line.1 }, begins: begins.collect() })
    }

    /// The slot whose picture was shown in `slot`: its own, or that of an earlier one.
    pub fn made_for(&self, slot: u64) -> u64 {
        let after = self.begins.partition_point(|(s, _)| *s <= slot);
        after.checked_sub(1).and_then(|i| self.begins.get(i)).map_or(slot, |(_, made_for)| *made_for)
    }

    /// Slots in which a new picture came.
    pub fn fresh(&self) -> impl Iterator<Item = u64> + '_ {
        self.begins.iter().map(|(slot, _)| *slot)
    }
}

/// Counts the slots from report to report: from one to the next the two clocks hardly part.
fn numbers(lights: &[(u64, HostTime)], frame_ns: f64) -> Vec<i64> {
    let mut number = 0;
    let mut last = lights.first().map_or(HostTime(0), |(_, at)| *at);
    let mut count = |at: HostTime| {
        number += (at.ns_since(last) as f64 / frame_ns).round() as i64;
        last = at;
        number
    };
    lights.iter().map(|(_, at)| count(*at)).collect()
}

/// Offset and slope by least squares.
fn line_through(points: &[(f64, f64)]) -> (f64, f64) {
    let n = points.len() as f64;
    let (mx, my) = points.iter().fold((0.0, 0.0), |(a, b), (x, y)| (a + x / n, b + y / n));
    let (mut xx, mut xy) = (0.0, 0.0);
    for (x, y) in points {
        xx += (x - mx) * (x - mx);
        xy += (x - mx) * (y - my);
    }
    let slope = if xx > 0.0 { xy / xx } else { 0.0 };
    (my - slope * mx, slope)
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAME_NS: f64 = 1_055_966.2;

    fn rate() -> FrameRate {
        FrameRate::new(947, 1).unwrap()
    }

    fn at(slot: u64) -> HostTime {
        HostTime(5_000_000_000 + (slot as f64 * FRAME_NS) as i64)
    }

    #[test]
    fn slots_begin_where_the_light_did() {
        let mut lights: Vec<(u64, HostTime)> =
            (1000..9000).filter(|s| s % 7 != 0).map(|s| (s, at(s))).collect();
        lights[100].1 = lights[100].1.plus_ns(400_000);
        let showing = Showing::of(&lights, rate()).unwrap();
        assert!((showing.timing.frame_ns - FRAME_NS).abs() < 1e-3, "{}", showing.timing.frame_ns);
        assert!((showing.timing.instant(5000, 0.0).0 - at(5000).0).abs() < 300);
        assert_eq!(
            (showing.made_for(5001), showing.made_for(5005), showing.made_for(5006)),
            (5001, 5004, 5006)
        );
        assert!(Showing::of(&lights[..50], rate()).is_err());
    }

    /// Two of three frames come one to three slots late, as on a link that carries half of them.
    #[test]
    fn late_light_moves_no_border_and_is_told_from_light_in_time() {
        let lights: Vec<(u64, HostTime)> =
            (0..900u64).map(|i| (3 * i + 17, at(3 * i + 17 + [0, 1, 2][i as usize % 3]))).collect();
        let showing = Showing::of(&lights, rate()).unwrap();
        assert!((showing.timing.instant(700, 0.0).0 - at(700).0).abs() < 300);
        for (i, (made_for, _)) in lights.iter().enumerate() {
            let slot = made_for + [0, 1, 2][i % 3];
            assert_eq!(showing.made_for(slot), *made_for, "{i}");
        }
    }

    #[test]
    fn another_rate_is_refused_by_name() {
        let lights: Vec<(u64, HostTime)> = (0..900).map(|s| (s, HostTime(s as i64 * 1_300_000))).collect();
        let told = Showing::of(&lights, rate()).unwrap_err().message;
        assert!(told.contains("projector.frame_rate"), "{told}");
    }
}
