//! The instant of the centre of a frame's light.
//!
//! The planes of a frame are lit one after the other for equal times, each with the intensity of its bit. If the high
//! bits come first, most of the light is over long before the middle of the exposure. An eye that follows a body sees
//! the picture where the centre of the light puts it.

use crate::config::ProjectorConfig;
use dpm_device::planes::PlaneSchedule;

/// Time from the first photon to the centre of the light of a frame whose planes share `exposure_ns` >= 0 equally, in
/// nanoseconds. It is the mean of the middles of the planes, each weighted with its intensity `2^bit`. Rounded down;
/// 0 for a negative exposure.
///
/// The function assumes white, with every bit of every channel set. The actual code value shifts the centre of each
/// pixel.
pub(crate) fn centre_ns(schedule: &PlaneSchedule, exposure_ns: i64) -> i64 {
    let (mut weights, mut moments) = (0i128, 0i128);
    for (i, plane) in schedule.planes().iter().enumerate() {
        let weight = 1i128 << plane.bit;
        weights += weight;
        moments += weight * halves_of(i);
    }
    let halves = 2 * schedule.len() as i128;
    // There is at least one plane of weight 1 or more, so the divisor is above 0 and the quotient lies inside the
    // exposure.
    (i128::from(exposure_ns.max(0)) * moments / (halves * weights)) as i64
}

/// The same for the projector of a rig file. A display that is given code values shows all bits at once, for the whole
/// frame.
pub(crate) fn centre_for(projector: &ProjectorConfig, schedule: &PlaneSchedule, exposure_ns: i64) -> i64 {
    if projector.holds_code_values() {
        exposure_ns.max(0) / 2
    } else {
        centre_ns(schedule, exposure_ns)
    }
}

/// The middle of plane `i` lies so many half planes after the first photon.
const fn halves_of(i: usize) -> i128 {
    2 * i as i128 + 1
}

/// The light of each plane: the time from the first photon to its middle in nanoseconds, rounded down, and its intensity
/// `2^bit`. The planes share `exposure_ns` equally.
pub(crate) fn lights_of_planes(
    schedule: &PlaneSchedule,
    exposure_ns: i64,
) -> impl Iterator<Item = (i64, f64)> + '_ {
    let halves = 2 * schedule.len() as i128;
    schedule.planes().iter().enumerate().map(move |(i, plane)| {
        let middle = i128::from(exposure_ns.max(0)) * halves_of(i) / halves;
        (middle as i64, f64::from(1u32 << plane.bit))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::planes::{Channel, PlaneSpec};

    const SLOT: i64 = 1_055_966;

    #[test]
    fn the_order_of_rgb24_has_its_centre_at_194_us() {
        assert_eq!((centre_ns(&PlaneSchedule::rgb24(), SLOT) + 500) / 1000, 194);
    }

    #[test]
    fn the_centre_is_the_mean_of_the_planes_lights() {
        for schedule in [PlaneSchedule::rgb24(), PlaneSchedule::mono8(), PlaneSchedule::equal24()] {
            let (mut sum, mut weights) = (0.0, 0.0);
            for (middle, weight) in lights_of_planes(&schedule, SLOT) {
                sum += middle as f64 * weight;
                weights += weight;
            }
            assert!((sum / weights - centre_ns(&schedule, SLOT) as f64).abs() <= 1.0);
        }
    }

    /// The centres of a schedule and of its mirror image lie at equal distances from the middle. With equal weights
    /// the centre is the middle. Every centre lies inside the exposure.
    #[test]
    fn centres_obey_the_symmetry_of_the_order() {
        for schedule in [PlaneSchedule::rgb24(), PlaneSchedule::mono8()] {
            let mut planes = schedule.planes().to_vec();
            planes.reverse();
            let mirrored = PlaneSchedule::new(&planes).unwrap();
            for exposure in [0, 1, 7, SLOT, 1_000_000_000_000] {
                let (a, b) = (centre_ns(&schedule, exposure), centre_ns(&mirrored, exposure));
                // Each value is rounded down by less than 1 ns.
                assert!((exposure - 1..=exposure).contains(&(a + b)), "{a} + {b} of {exposure}");
                assert!((0..=exposure).contains(&a));
            }
        }
        let equal =
            [Channel::Red, Channel::Green, Channel::Blue].map(|channel| PlaneSpec { channel, bit: 3 });
        assert_eq!(centre_ns(&PlaneSchedule::new(&equal).unwrap(), 600), 300);
        assert_eq!(centre_ns(&PlaneSchedule::mono8(), -5), 0);
    }
}
