//! The steps of a rig's calibration for its guided page.

use super::doctor::serial_ports;
use dpm_page::calibration::Guide;
use dpm_rig::calibration_steps::{About, Steps};
use dpm_rig::config::{ProjectorBackend, RigConfig, TrackerConfig};
use dpm_rig::control::rig_name;
use std::path::Path;
use std::time::SystemTime;

/// The steps of the rig of this process.
#[derive(Debug)]
pub(super) struct RigGuide {
    config: RigConfig,
    running_since: Option<SystemTime>,
}

impl RigGuide {
    /// For a rig that runs from now on.
    pub(super) fn of_run(config: &RigConfig) -> Self {
        Self { config: config.clone(), running_since: Some(SystemTime::now()) }
    }
}

impl Guide for RigGuide {
    fn steps(&self) -> Steps {
        Steps::of(&About {
            rig: Path::new(rig_name()),
            config: &self.config,
            now: SystemTime::now(),
            running_since: self.running_since,
        })
    }

    fn ports(&self) -> Vec<String> {
        let projector = match &self.config.projector.backend {
            ProjectorBackend::Serial(serial) => Some(&serial.port),
            _ => None,
        };
        let tracker = match &self.config.tracker {
            TrackerConfig::Serial(serial) => Some(&serial.port),
            _ => None,
        };
        serial_ports().into_iter().filter(|port| ![projector, tracker].contains(&Some(port))).collect()
    }
}
