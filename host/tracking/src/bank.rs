//! Passes samples of many bodies to the filter of each.

use super::pose_filter::{PoseFilter, PoseFilterConfig, Verdict};
use super::state::TrackState;
use dpm_device::tracker::{BodyIndex, TrackerSample};

/// One filter per tracked body, in the order of the rig file.
#[derive(Clone, Debug)]
pub struct PoseFilterBank {
    filters: Vec<PoseFilter>,
}

impl PoseFilterBank {
    /// One filter per entry; per-body settings.
    pub fn new(configs: &[PoseFilterConfig]) -> Self {
        Self { filters: configs.iter().map(|&c| PoseFilter::new(c)).collect() }
    }

    /// Passes a sample to its body's filter; `None` if the rig file names no such body.
    pub fn update(&mut self, sample: &TrackerSample) -> Option<Verdict> {
        Some(self.filters.get_mut(usize::from(sample.body.0))?.update(sample))
    }

    /// A body's [`PoseFilter::levels`] and [`PoseFilter::excess`]; `None` if there is no such body.
    pub fn levels(&self, body: BodyIndex) -> Option<([i32; 2], [f64; 2])> {
        self.filters.get(usize::from(body.0)).map(|filter| (filter.levels(), filter.excess()))
    }

    /// A body's track as plain data.
    pub fn state(&self, body: BodyIndex) -> Option<TrackState> {
        self.filters.get(usize::from(body.0))?.state()
    }
}
