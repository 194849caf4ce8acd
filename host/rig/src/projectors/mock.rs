//! `projector.backend.kind = "mock"`: a software projector in this process.

use super::compaction::Compaction;
use super::keys::{DeviceName, FrameKeys, ProjectorKeys};
use super::kind::{FrameRoad, ProjectorKind};
use crate::mock;
use dpm_common::keys::read::{refuse, Any, KeyReader, Within};
use dpm_common::section;

section! {
    /// The embedded mock projector.
    pub struct MockProjectorConfig {
        /// How much faster its clock runs than the host's. Change it to test the clock mapping.
        clock_ppm: f64 = 0.0, "ppm", Within(-1000.0, 1000.0);
        /// Frames that it can hold before one is shown.
        buffer_frames: u32 = 3, "frames", Within(2, 64);
        /// Faults to inject, in the mocks' notation, for example "loss=0.01,dropout@1.5s+20ms"; empty for none. Times
        /// count from the start of the run.
        faults: String = String::new(), "", Any;
        /// How planes are compacted. Raw is fastest for a projector in this process.
        compaction: Compaction = Compaction::RAW, "", Any;
    }
}

pub(super) static KIND: ProjectorKind = ProjectorKind::of::<MockProjectorConfig>(
    "mock",
    "mock projector",
    "a software projector in this process.",
    "docs/PROJECTORS.md",
)
.on(FrameRoad::Mock);

impl ProjectorKeys for MockProjectorConfig {
    fn device(&self) -> DeviceName {
        DeviceName { is_single: true, ..DeviceName::of(KIND.name) }
    }

    fn check(&self, _frames: &FrameKeys, reader: &mut KeyReader) {
        if let Err(e) = mock::check_projector_faults(&self.faults) {
            let remedy = mock::FAULTS_REMEDY.to_owned();
            refuse(reader, &["projector.backend.faults"], e.to_string(), remedy);
        }
    }

    fn compaction(&self) -> Option<Compaction> {
        Some(self.compaction)
    }

    fn carries_tracks(&self) -> bool {
        true
    }

    fn as_mock(&self) -> Option<&Self> {
        Some(self)
    }
}
