//! Samples of many bodies to the filter of each.

use super::pose_filter::{PoseFilter, PoseFilterConfig, Verdict};
use super::state::{PosePrediction, TrackState};
use dpm_device::time::HostTime;
use dpm_device::tracker::{BodyIndex, TrackerSample};

/// One filter a tracked body, in the order of the rig file.
#[derive(Clone, Debug)]
pub struct PoseFilterBank {
    filters: Vec<PoseFilter>,
    unknown_bodies: u64,
    last_unknown: Option<BodyIndex>,
}

impl PoseFilterBank {
    /// One filter per entry; per-body settings.
    pub fn new(configs: &[PoseFilterConfig]) -> Self {
        Self {
            filters: configs.iter().map(|&c| PoseFilter::new(c)).collect(),
            unknown_bodies: 0,
            last_unknown: None,
        }
    }

    /// Hands a sample to its body's filter; `None` (and counted) when the rig file names no such body.
    pub fn update(&mut self, sample: &TrackerSample) -> Option<Verdict> {
        match self.filters.get_mut(usize::from(sample.body.0)) {
            Some(filter) => Some(filter.update(sample)),
            None => {
                self.unknown_bodies += 1;
                self.last_unknown = Some(sample.body);
                None
            }
        }
    }

    /// The filters, in the order of the bodies.
    pub fn filters(&self) -> &[PoseFilter] {
        &self.filters
    }

    /// A body at an instant; `None` for an unknown body and before its first track.
    pub fn predict(&self, body: BodyIndex, at: HostTime) -> Option<PosePrediction> {
        self.filters.get(usize::from(body.0))?.predict(at)
    }

    /// A body's track as plain data.
    pub fn state(&self, body: BodyIndex) -> Option<TrackState> {
        self.filters.get(usize::from(body.0))?.state()
    }

    /// Samples for bodies nobody named, and the last such index.
    pub fn unknown_bodies(&self) -> (u64, Option<BodyIndex>) {
        (self.unknown_bodies, self.last_unknown)
    }
}
