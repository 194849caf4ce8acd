//! How evenly the work of the pass `trace` lies on the lanes of a GPU.
//!
//! A thread of that pass takes one item of the work list, a pixel with its number of samples, and the threads of a
//! subgroup end together. Lanes whose pixels have fewer samples than the pixel with the most wait for it.

use dpm_shaders::structs::WorkItem;
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
    /// Of `work`, whose items are taken in order by subgroups of `width` lanes; `None` without work.
    pub fn of(work: &[WorkItem], width: usize) -> Option<Self> {
        let most = |items: &[WorkItem]| items.iter().map(|item| item.spp).max().unwrap_or(0);
        let samples: u64 = work.iter().map(|item| u64::from(item.spp)).sum();
        let room: u64 = work.chunks(width).map(|group| width as u64 * u64::from(most(group))).sum();
        (room > 0).then(|| Self { width, busy: samples as f64 / room as f64, longest: most(work) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(spp: impl IntoIterator<Item = u32>) -> Vec<WorkItem> {
        spp.into_iter().enumerate().map(|(pixel, spp)| WorkItem { pixel: pixel as u32, spp }).collect()
    }

    #[test]
    fn equal_work_keeps_all_lanes_busy_and_one_long_thread_none_but_itself() {
        let lanes = |spp: Vec<u32>| Lanes::of(&list(spp), 32).unwrap();
        assert_eq!(lanes(vec![4; 64]), Lanes { width: 32, busy: 1.0, longest: 4 });
        let mut one_long = vec![1; 32];
        one_long[7] = 32;
        assert!((lanes(one_long).busy - 63.0 / 1024.0).abs() < 1e-12);
        // Half of the last subgroup has no pixel.
        assert!((lanes(vec![2; 48]).busy - 0.75).abs() < 1e-12);
        assert_eq!(Lanes::of(&[], 32), None);
    }
}
