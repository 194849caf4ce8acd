//! How evenly the work of the pass `trace` lies on the lanes of a GPU.
//!
//! A workgroup of that pass takes the work items whose first sample lies in its range, and its lanes take their samples one
//! after the other (`shaders/glsl/trace_gpu.glsl`). The lanes of a subgroup end together, so those that have one sample
//! less than another wait for it.

use dpm_shaders::structs::{group_samples, WorkItem, TRACE_LANES, TRACE_SLOTS};
use serde::Serialize;

/// Widths of the subgroups of GPUs: NVIDIA's and AMD's narrow one, AMD's wide one.
pub const WIDTHS: [usize; 2] = [32, 64];

/// What lanes of a width do with a work list.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Lanes {
    /// Lanes of a subgroup.
    pub width: usize,
    /// Samples over those that fit into the time of the busiest lane of each subgroup, 0 to 1. Paths are counted as
    /// equally long, so this is what the list alone costs.
    pub busy: f64,
    /// Most samples of a thread.
    pub longest: u32,
}

impl Lanes {
    /// Of the list `work`, in the order of the samples, which are so many together, with subgroups of `width` lanes, at
    /// most those of a workgroup, on a GPU that wants `wanted` workgroups; `None` without work.
    pub fn of(work: &[WorkItem], samples: u32, width: usize, wanted: u32) -> Option<Self> {
        let (mut room, mut longest) = (0, 0);
        for group in groups(work, samples, wanted) {
            // The samples that each lane takes of a round: the first lanes may have one more than the last.
            let rounds = (0..group).step_by(TRACE_SLOTS as usize).map(|done| (group - done).min(TRACE_SLOTS));
            let taken = |n: u32, lane: u32| n.saturating_sub(lane).div_ceil(TRACE_LANES);
            let first_lanes = (0..TRACE_LANES).step_by(width);
            let of_round = |n| first_lanes.clone().map(|lane| u64::from(taken(n, lane))).sum::<u64>();
            room += width as u64 * rounds.clone().map(of_round).sum::<u64>();
            longest = longest.max(rounds.map(|n| taken(n, 0)).sum());
        }
        (room > 0).then(|| Self { width, busy: f64::from(samples) / room as f64, longest })
    }
}

/// The samples of each workgroup that has any.
fn groups(work: &[WorkItem], samples: u32, wanted: u32) -> Vec<u32> {
    let length = group_samples([work.len() as u32, samples], wanted);
    let group_of = |item: &WorkItem| item.first / length;
    let firsts: Vec<u32> =
        work.chunk_by(|a, b| group_of(a) == group_of(b)).map(|group| group[0].first).collect();
    let ends = firsts.iter().skip(1).chain(std::iter::once(&samples));
    firsts.iter().zip(ends).map(|(first, end)| end - first).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// On a GPU that is busy with two workgroups, or with `wanted`.
    fn lanes(spp: &[u32], width: usize) -> Option<Lanes> {
        lanes_where(spp, width, 2)
    }

    fn lanes_where(spp: &[u32], width: usize, wanted: u32) -> Option<Lanes> {
        let mut samples = 0;
        let list: Vec<_> = (0..)
            .zip(spp)
            .map(|(pixel, n)| {
                samples += n;
                WorkItem { pixel, first: samples - n }
            })
            .collect();
        Lanes::of(&list, samples, width, wanted)
    }

    #[test]
    fn samples_are_shared_out_whatever_pixels_they_belong_to() {
        // 180 of 192 places are taken: 52 lanes have three samples and twelve have two.
        for width in WIDTHS {
            assert_eq!(lanes(&[1; 360], width), Some(Lanes { width, busy: 0.9375, longest: 3 }));
        }
        assert_eq!(lanes(&[2; 180], 32), lanes(&[1; 360], 32));
        // A GPU with room for more gets six workgroups of 60 samples, so that no lane has more than one.
        for width in WIDTHS {
            let each = Lanes { width, busy: 0.9375, longest: 1 };
            assert_eq!(lanes_where(&[1; 360], width, 100), Some(each));
        }
        assert_eq!(lanes(&[], 32), None);
    }

    #[test]
    fn few_samples_leave_lanes_idle_and_the_subgroup_without_any_costs_nothing() {
        assert_eq!(lanes(&[1; 16], 32), Some(Lanes { width: 32, busy: 0.5, longest: 1 }));
        assert_eq!(lanes(&[1; 16], 64), Some(Lanes { width: 64, busy: 0.25, longest: 1 }));
    }

    #[test]
    fn a_pixel_with_many_samples_belongs_to_one_workgroup_and_takes_rounds() {
        // 179 + 512 samples: rounds of 320, 320 and 51 samples, of which the busiest lane of each half takes 5 and 5, 5 and
        // 5, 1 and 1.
        let mut spp = vec![1; 179];
        spp.push(512);
        let room = 32.0 * f64::from((5 + 5) * 2 + 1 + 1);
        assert_eq!(lanes(&spp, 32), Some(Lanes { width: 32, busy: 691.0 / room, longest: 11 }));
    }
}
