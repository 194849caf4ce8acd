//! Planes that follow: each group of bit planes is shown where the bodies are at its own instant.
//!
//! A frame is drawn for one instant, the centre of its light. Its planes are lit before and after it, while the bodies
//! move on. The pass `motion` (`shaders/glsl/motion.comp`) tells for every pixel how far its surface moves on the raster
//! during the exposure. The pass `warp` (`shaders/glsl/warp.comp`) then takes the bits of each group of planes from the
//! pixel whose surface is at this mirror at the group's instant. [`gather`] is the CPU twin of that pass, bit for bit: it
//! is whole numbers only.
//!
//! A body that moves by less than [`LEAST_MOTION_PX`] while the planes last is left out, and so are the passes if no body
//! moves: what stands still is shown as it was drawn.

pub mod gather;
mod movers;

pub(crate) use movers::Movers;

use crate::pack::source_bits;
use dpm_device::planes::PlaneSchedule;
use dpm_shaders::structs::PlaneGroup;
use glam::DAffine3;

/// How far on the way from the frame's instant to its own each bit of a code value is shown, unless the configuration says
/// otherwise. An eye that follows a body sees a picture best with 1. Before an eye that rests the bits of a passing picture come
/// from places that lie apart, and their errors add up; 0.8 takes a tenth from these (`dpm error planes`, docs/lab/ERROR.md).
pub const FOLLOW_SHARE: f64 = 0.8;

/// Motion between the frame's instant and that of any plane below which a body is left as it was drawn, pixels.
pub const LEAST_MOTION_PX: f64 = 0.25;

/// Where the bodies are when the light of a frame begins and when it ends. In between they move evenly.
#[derive(Clone, Copy, Debug)]
pub struct Sweep<'a> {
    /// world-from-body of every body of the scene at the first photon.
    pub first: &'a [DAffine3],
    /// The same at the last photon.
    pub last: &'a [DAffine3],
}

/// The groups of planes that are warped together. `instants` gives for each plane of `schedule` the time from the
/// frame's instant to the one that it shows, as a share of the exposure, -1 to 1. Neighbours that are lit together are one
/// group, and so are neighbours that show the same bit of different channels, at their mean instant. Of code values that are
/// shown in parts, every part is a group of its own.
pub fn plane_groups(schedule: &PlaneSchedule, instants: &[f64]) -> Vec<PlaneGroup> {
    let planes = schedule.planes();
    let bits = source_bits(schedule);
    let mut groups = Vec::new();
    let mut from = 0;
    for i in 1..=planes.len() {
        // Of parts every plane of a colour has an instant of its own, but where their highest bit is split.
        let is_of_bits = schedule.parts().is_none_or(|parts| parts.low > 0);
        let is_same_bit = |i: usize| {
            is_of_bits && planes[i].bit == planes[i - 1].bit && planes[i].channel != planes[from].channel
        };
        let is_together = |i: usize| {
            planes[i].channel == planes[from].channel && (instants[i] - instants[from]).abs() < LEAST_SHARE
        };
        let is_one = |i: usize| is_same_bit(i) || is_together(i);
        if i < planes.len() && is_one(i) {
            continue;
        }
        let mask = bits[from..i].iter().fold(0, |mask, &bit| mask | 1u32 << bit);
        let mean = instants[from..i].iter().sum::<f64>() / (i - from) as f64;
        groups.push(PlaneGroup { mask, instant: share_of_exposure(mean) });
        from = i;
    }
    groups
}

/// Planes whose instants differ by less than this share of the exposure are lit together: half a unit of their groups' instants.
const LEAST_SHARE: f64 = 0.5 / 65536.0;

/// A share of the exposure in units of 2^-16, rounded, and smaller than one exposure.
fn share_of_exposure(share: f64) -> i32 {
    (share * 65536.0).round().clamp(-65535.0, 65535.0) as i32
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every bit that a plane shows belongs to one group, and the groups follow one another in time.
    #[test]
    fn groups_share_out_the_bits() {
        let whole = |schedule: &PlaneSchedule| {
            source_bits(schedule)[..schedule.len()].iter().fold(0, |mask, &bit| mask | 1u32 << bit)
        };
        for (schedule, count) in [
            (PlaneSchedule::rgb24(), 8),
            (PlaneSchedule::mono8(), 8),
            (PlaneSchedule::equal_rgb24(), 24),
            (PlaneSchedule::equal_mono8(), 8),
            (PlaneSchedule::split_rgb24(), 8),
            (PlaneSchedule::split_mono8(), 8),
        ] {
            let n = schedule.len();
            let instants: Vec<f64> = (0..n).map(|i| (i as f64 + 0.5) / n as f64 - 0.25).collect();
            let groups = plane_groups(&schedule, &instants);
            assert_eq!(groups.len(), count);
            assert_eq!(
                groups.iter().map(|g| g.mask.count_ones()).sum::<u32>(),
                whole(&schedule).count_ones()
            );
            assert_eq!(groups.iter().fold(0, |mask, g| mask | g.mask), whole(&schedule));
            assert!(groups.windows(2).all(|pair| pair[0].instant < pair[1].instant));
            // The mean over the groups is the mean over the planes.
            let mean = groups.iter().map(|g| f64::from(g.instant)).sum::<f64>() / count as f64 / 65536.0;
            assert!((mean - 0.25).abs() < 1e-4, "{mean}");
        }
    }
}
