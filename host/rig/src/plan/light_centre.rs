//! The instant of the centre of a frame's light.
//!
//! The planes of a frame are lit one after the other for equal times, each with the intensity of its bit. If the high
//! bits come first, most of the light is over long before the middle of the exposure. An eye that follows a body sees
//! the picture where the centre of the light puts it.

use crate::rig::Rig;
use dpm_device::planes::{PlaneSchedule, PlaneSpec};

/// Time from the first photon to the centre of the light of a frame of `rig` that is lit for `exposure_ns` >= 0, in
/// nanoseconds. Rounded down; 0 for a negative exposure.
///
/// The function assumes white, with every bit of every channel set. The actual code value shifts the centre of each
/// pixel.
pub(crate) fn light_centre_ns(rig: &Rig, exposure_ns: i64) -> i64 {
    centre_ns(&rig.schedule, rig.config.projector.lights_evenly(), exposure_ns)
}

/// The mean of the middles of the planes, which share `exposure_ns` equally, each weighted with its light.
fn centre_ns(schedule: &PlaneSchedule, is_even: bool, exposure_ns: i64) -> i64 {
    let (mut weights, mut moments) = (0i128, 0i128);
    for (i, plane) in schedule.planes().iter().enumerate() {
        let weight = i128::from(light_of(*plane, is_even));
        weights += weight;
        moments += halves_of(i) * weight;
    }
    // A schedule has at most 32 planes of at most 2^31, so neither sum nor their product with the exposure overflows.
    // A schedule has at least one plane, so the weights are positive.
    let halves = 2 * schedule.len() as i128;
    (i128::from(exposure_ns.max(0)) * moments / (halves * weights)) as i64
}

/// Light of a plane that lasts as long as every other one: 1 where the light of a frame `is_even`, else `2^bit`.
const fn light_of(plane: PlaneSpec, is_even: bool) -> u32 {
    if is_even {
        1
    } else {
        1 << plane.bit
    }
}

/// The middle of plane `i` lies so many half planes after the first photon.
const fn halves_of(i: usize) -> i128 {
    2 * i as i128 + 1
}

/// The light of a frame of `rig` over its exposure, in as many equal parts as it has planes: the time from the first
/// photon to the middle of each in nanoseconds, rounded down, and its light.
pub(crate) fn lights_of_frame(rig: &Rig, exposure_ns: i64) -> impl Iterator<Item = (i64, f64)> + '_ {
    lights(&rig.schedule, rig.config.projector.lights_evenly(), exposure_ns)
}

fn lights(
    schedule: &PlaneSchedule,
    is_even: bool,
    exposure_ns: i64,
) -> impl Iterator<Item = (i64, f64)> + '_ {
    let halves = 2 * schedule.len() as i128;
    schedule.planes().iter().enumerate().map(move |(i, plane)| {
        let middle = i128::from(exposure_ns.max(0)) * halves_of(i) / halves;
        (middle as i64, f64::from(light_of(*plane, is_even)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::planes::Channel;

    const SLOT: i64 = 1_055_966;

    #[test]
    fn the_order_of_rgb24_has_its_centre_at_194_us() {
        assert_eq!((centre_ns(&PlaneSchedule::rgb24(), false, SLOT) + 500) / 1000, 194);
    }

    #[test]
    fn the_centre_is_the_mean_of_the_planes_lights() {
        for schedule in [PlaneSchedule::rgb24(), PlaneSchedule::mono8(), PlaneSchedule::equal24()] {
            for is_even in [false, true] {
                let (mut sum, mut weights) = (0.0, 0.0);
                for (middle, weight) in lights(&schedule, is_even, SLOT) {
                    sum += middle as f64 * weight;
                    weights += weight;
                }
                assert!((sum / weights - centre_ns(&schedule, is_even, SLOT) as f64).abs() <= 1.0);
            }
        }
    }

    /// A display that holds code values, and an ALP that shows each bit for as long as it weighs.
    #[test]
    fn even_light_has_its_centre_in_the_middle_whatever_the_order() {
        for schedule in [PlaneSchedule::rgb24(), PlaneSchedule::mono8()] {
            assert_eq!(centre_ns(&schedule, true, SLOT), SLOT / 2);
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
                let (a, b) = (centre_ns(&schedule, false, exposure), centre_ns(&mirrored, false, exposure));
                // Each value is rounded down by less than 1 ns.
                assert!((exposure - 1..=exposure).contains(&(a + b)), "{a} + {b} of {exposure}");
                assert!((0..=exposure).contains(&a));
            }
        }
        let equal =
            [Channel::Red, Channel::Green, Channel::Blue].map(|channel| PlaneSpec { channel, bit: 3 });
        assert_eq!(centre_ns(&PlaneSchedule::new(&equal).unwrap(), false, 600), 300);
        assert_eq!(centre_ns(&PlaneSchedule::mono8(), false, -5), 0);
    }
}
