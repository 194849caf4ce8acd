//! The steps of `docs/CALIBRATION.md` for one rig: what was measured and when, what is missing or no longer fits, which
//! step is next, and the command of each.
//!
//! Nothing is measured here and no device is opened: the rig file and the calibration file say all of it.

pub mod age;
mod each;
mod judged;

use crate::config::RigConfig;
use crate::trackers::PoseOrigin;
use dpm_calibration_file::{self as file, CalibrationFile};
use judged::FileVerdict;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Name of the calibration file if neither a flag nor the rig file names one.
const USUAL_NAME: &str = "calibration.toml";
/// What stands in a command for the port of the light sensor, which no file names.
pub const SENSOR: &str = "SENSOR";

/// The calibration file of the rig file `rig`: the one that it names, or else `calibration.toml` beside it.
pub fn calibration_file(rig: &Path, config: &RigConfig) -> PathBuf {
    config.calibration.file.clone().unwrap_or_else(|| rig.with_file_name(USUAL_NAME))
}

/// True for a rig with a mock in it, which needs no calibration.
pub fn is_simulated(config: &RigConfig) -> bool {
    config.projector.backend.is_mock() || config.tracker.is_mock()
}

/// How it stands with a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum StepStatus {
    /// It was measured, and nothing speaks against it.
    Done,
    /// The rig file, or somebody's eye, gives what would be measured.
    Given,
    /// It was measured long ago, and no check has confirmed it since.
    Old,
    /// It was measured with another device than the rig file names.
    Doubtful,
    /// It cannot hold: it was made for another raster, or a check has found an error that is too large.
    Wrong,
    /// It is needed, and was not measured.
    Missing,
    /// It needs an earlier step first.
    Waits,
    /// Light is better with it, and it was not measured.
    Optional,
    /// No file says whether it was done.
    Unrecorded,
}

/// What was measured.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct StepQuantity {
    /// Date and time, UTC, RFC 3339.
    pub date: String,
    /// Its age in words.
    pub age: String,
    /// How good it is, by its own residuals.
    pub quality: String,
    /// What was measured: a device or a body.
    pub device: String,
    /// What it was computed from.
    pub data: String,
    /// How it was computed.
    pub method: String,
    /// Commit of the program that measured it.
    pub commit: String,
}

/// A way to do a step: a command.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Way {
    /// When to choose it.
    pub told: String,
    /// Its arguments, without the program's name.
    #[serde(skip)]
    pub words: Vec<String>,
    /// The same as a line for a shell.
    pub line: String,
    /// Words that the operator may answer with, besides an empty line: `(word, meaning)`.
    pub answers: Vec<(&'static str, &'static str)>,
}

/// A step.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct CalibrationStep {
    /// Its name: the command's, with the body's for a step of one body.
    pub id: String,
    /// Its heading.
    pub title: String,
    /// What is known after it.
    pub gives: &'static str,
    /// What must be at hand.
    pub needs: Vec<String>,
    /// How it stands with it.
    pub state: StepStatus,
    /// Why, one sentence; empty where the state says it all.
    pub told: String,
    /// What was measured, if it was.
    pub measured: Option<StepQuantity>,
    /// How to do it; the first way is the better one.
    pub ways: Vec<Way>,
}

/// The steps of a rig.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Steps {
    /// The rig file.
    pub rig: String,
    /// The calibration file.
    pub file: String,
    /// Why this rig has no steps; `None` if it has.
    pub none: Option<String>,
    /// Why the calibration file cannot be used.
    pub fault: Option<String>,
    /// Lines that are missing in the rig file, without which a run does not use what was measured.
    pub unnamed: Option<String>,
    /// What else to know.
    pub notes: Vec<String>,
    /// In their order.
    pub steps: Vec<CalibrationStep>,
    /// The index of the step that should be done next.
    pub next: Option<usize>,
}

/// A rig at a moment.
#[derive(Clone, Copy, Debug)]
pub struct About<'a> {
    /// The rig file, as an absolute path, so that the commands work in any folder.
    pub rig: &'a Path,
    /// What it says.
    pub config: &'a RigConfig,
    /// The calibration file to judge; `None`: that of the rig.
    pub file: Option<&'a Path>,
    /// Now.
    pub now: SystemTime,
    /// When the run began that would not see what was measured since; `None` where nothing runs.
    pub running_since: Option<SystemTime>,
}

impl Steps {
    /// The steps of a rig by the calibration file as it is on the disk now.
    pub fn of(about: &About) -> Self {
        let path = about.file.map_or_else(|| calibration_file(about.rig, about.config), Path::to_path_buf);
        let (measured, fault) = match path.exists().then(|| file::load(&path)).transpose() {
            Ok(measured) => (measured.unwrap_or_else(CalibrationFile::new), None),
            Err(e) => (CalibrationFile::new(), Some(e.to_string())),
        };
        let mut this = Self {
            rig: about.rig.display().to_string(),
            file: path.display().to_string(),
            none: none(about.config),
            fault,
            unnamed: None,
            notes: Vec::new(),
            steps: Vec::new(),
            next: None,
        };
        if this.none.is_some() {
            return this;
        }
        let judged = FileVerdict { about, file: &measured };
        if path.exists() && about.config.calibration.file.is_none() {
            this.unnamed = Some(format!("[calibration]\nfile = {:?}", path.display().to_string()));
        }
        this.notes = judged.notes();
        this.steps = each::steps(&judged);
        this.next = next(&this.steps);
        this
    }
}

/// Why a rig has nothing to measure.
fn none(config: &RigConfig) -> Option<String> {
    if is_simulated(config) {
        let told =
            "This rig has a mock in place of a projector or a tracker, and a mock needs no calibration. \
                    docs/CALIBRATION.md says how to try all steps without hardware.";
        return Some(told.into());
    }
    let kind = config.projector.backend.kind();
    if kind.is_loaded() {
        return Some(format!(
            "A {} cannot show the pictures of a calibration. Measure lens and pose with another program, and name its file in \
             projector.calibration.",
            kind.name
        ));
    }
    if config.tracker.kind().origin == PoseOrigin::Recorded {
        return Some("This rig plays a recording. Only a live tracker can be calibrated.".into());
    }
    None
}

/// The step that should be done next: the first that is missing or wrong, or else what is in doubt. Where parts are only
/// old, a check comes first, since it tells whether they still hold.
fn next(steps: &[CalibrationStep]) -> Option<usize> {
    let first = |is: &dyn Fn(&CalibrationStep) -> bool| steps.iter().position(is);
    if steps.iter().all(|s| s.measured.is_none() && s.state != StepStatus::Given) {
        return (!steps.is_empty()).then_some(0);
    }
    first(&|s| matches!(s.state, StepStatus::Missing | StepStatus::Wrong))
        .or_else(|| first(&|s| s.state == StepStatus::Doubtful))
        .or_else(|| first(&|s| s.state == StepStatus::Old && s.id.starts_with("check")))
        .or_else(|| first(&|s| s.state == StepStatus::Old))
}

#[cfg(test)]
pub(crate) mod tests;
