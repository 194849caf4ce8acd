//! The mock in place of a projector, with the delays and the light of the real one.

use dpm_common::keys::rows::KeyValues;
use dpm_device::planes::PlaneSchedule;
use dpm_rig::projectors::{
    self, DeviceName, FrameKeys, LitTime, MockProjectorConfig, PlaneTiming, ProjectorBackend, ProjectorKeys,
};
use std::any::Any;
use std::sync::Arc;

/// The keys of a projector, behind the row of the mock.
#[derive(Debug)]
struct MockKeys {
    of: ProjectorBackend,
    mock: MockProjectorConfig,
    /// Nothing delays its light.
    is_prompt: bool,
}

/// The mock with the light and the delays of the kind `of`; `is_prompt`: without its delays.
pub(super) fn played(of: &ProjectorBackend, is_prompt: bool) -> ProjectorBackend {
    let mock = MockProjectorConfig::default();
    let keys = MockKeys { of: of.clone(), mock, is_prompt };
    let row = projectors::kinds().into_iter().find(|kind| kind.road == projectors::FrameRoad::Mock);
    ProjectorBackend::new(row.unwrap_or_else(|| of.kind()), Arc::new(keys))
}

impl KeyValues for MockKeys {
    fn as_any(&self) -> &dyn Any {
        self
    }

    fn is_same(&self, other: &dyn Any) -> bool {
        other.downcast_ref::<Self>().is_some_and(|o| o.of == self.of && o.is_prompt == self.is_prompt)
    }
}

impl ProjectorKeys for MockKeys {
    fn device(&self) -> DeviceName {
        self.mock.device()
    }

    fn plane_timing(&self) -> PlaneTiming {
        self.of.plane_timing()
    }

    fn lit_time(&self, frames: &FrameKeys) -> LitTime {
        self.of.lit_time(frames)
    }

    fn schedule(&self) -> Option<PlaneSchedule> {
        self.of.schedule()
    }

    fn is_lit_fully(&self) -> bool {
        self.of.is_lit_fully()
    }

    fn light_delay_ns(&self, frame_ns: i64) -> i64 {
        if self.is_prompt {
            0
        } else {
            self.of.light_delay_ns(frame_ns)
        }
    }

    fn as_mock(&self) -> Option<&MockProjectorConfig> {
        Some(&self.mock)
    }
}
