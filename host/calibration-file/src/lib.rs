//! The calibration file and what its numbers mean. It has what the solvers found, with where it came from, as TOML that a rig file refers to.
//!
//! Every part is optional and carries its own provenance, since a wand is calibrated on another day than a body. A file
//! that is replaced is kept beside the new one, with a number. Lengths are in metres, pixels count from the raster's
//! upper left corner (the centre of the first pixel is 0.5, 0.5; OpenCV counts from that centre).

pub mod light;
pub mod model;
mod place;
mod sections;
mod store;

pub use place::{moved, LightError};
pub use sections::{
    BodySection, CheckSection, LatencySection, LightSection, Pose, ProjectorSection, Provenance, WandSection,
    Wrong,
};
pub use store::{load, parse, save, FileError, MAX_BYTES};

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Version of the format.
pub const VERSION: u32 = 1;

/// A calibration file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibrationFile {
    /// [`VERSION`].
    pub version: u32,
    /// Lens and pose of the projector.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub projector: Option<ProjectorSection>,
    /// The wand.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub wand: Option<WandSection>,
    /// Bodies by their name in the rig file.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub bodies: BTreeMap<String, BodySection>,
    /// What a check of the light found, by bodies.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub checks: BTreeMap<String, CheckSection>,
    /// Delays.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub latency: Option<LatencySection>,
    /// Response, brightness and flat field.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub light: Option<LightSection>,
}

impl CalibrationFile {
    /// An empty one.
    pub fn new() -> Self {
        Self { version: VERSION, ..Self::default() }
    }

    /// Checks all numbers.
    ///
    /// # Errors
    /// The first key whose number cannot be, with the reason.
    pub fn check(&self) -> Result<(), Wrong> {
        if self.version != VERSION {
            return Err(Wrong::new("version", format!("is {}, this program reads {VERSION}", self.version)));
        }
        self.projector.iter().try_for_each(|s| s.check())?;
        self.wand.iter().try_for_each(|s| s.check())?;
        self.bodies.iter().try_for_each(|(name, s)| s.check(name))?;
        self.checks.iter().try_for_each(|(name, s)| s.check(name))?;
        self.latency.iter().try_for_each(|s| s.check())?;
        self.light.iter().try_for_each(|s| s.check())
    }
}

#[cfg(test)]
mod tests;
