//! The calibration file of a rig: where it lies, what is in it already, and how new parts get into it.

use crate::calibration_steps::calibration_file;
use crate::config::RigConfig;
use crate::failure::{Failure, FailureKind};
use crate::rig::Rig;
use crate::standing::{utc, Identity};
use dpm_calibration_file::{self as file, BodySection, CalibrationFile, Pose, Provenance};
use glam::DAffine3;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// The end of the name of a calibration file on which the operator decides later.
pub const TRIAL: &str = ".trial";

/// A calibration file that grows part by part.
pub struct Results {
    path: PathBuf,
    /// What it holds; empty if there is none yet.
    pub file: CalibrationFile,
}

impl Results {
    /// The file that `named` names, or else the rig file, or else `calibration.toml` beside the rig file.
    ///
    /// # Errors
    /// There is one that cannot be read.
    pub fn open(named: Option<&Path>, rig: &Path, config: &RigConfig) -> Result<Self, Failure> {
        let path = named.map_or_else(|| calibration_file(rig, config), Path::to_path_buf);
        let file = if path.exists() {
            file::load(&path).map_err(|e| Failure::new(FailureKind::BadInput, e))?
        } else {
            CalibrationFile::new()
        };
        Ok(Self { path, file })
    }

    /// Where it lies.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The rig as it runs with what this file holds, whether or not the rig file names it yet.
    ///
    /// # Errors
    /// The rig cannot be built.
    pub fn rig(&self, config: &RigConfig) -> Result<Rig, Failure> {
        let mut config = config.clone();
        config.calibration.file = self.path.exists().then(|| self.path.clone());
        Ok(Rig::build(&config, None)?)
    }

    /// A file beside it for what an interrupted command has measured so far.
    pub fn progress(&self, what: &str) -> PathBuf {
        let mut name = self.path.file_name().unwrap_or_default().to_os_string();
        name.push(format!(".{what}.part"));
        self.path.with_file_name(name)
    }

    /// A file beside it in which the last sweep of the light sensor has left its brightness, for the flat field.
    pub fn sweep(&self) -> PathBuf {
        let mut name = self.path.file_name().unwrap_or_default().to_os_string();
        name.push(".sweep");
        self.path.with_file_name(name)
    }

    /// Writes it; what was there before is kept. Returns what to tell the operator.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn save(&self, config: &RigConfig) -> Result<String, Failure> {
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        if name.ends_with(TRIAL) {
            // Nobody needs what a trial was before.
            let _ = std::fs::remove_file(&self.path);
            file::save(&self.file, &self.path).map_err(|e| Failure::new(FailureKind::BadInput, e))?;
            return Ok("measured; it is not in the calibration file yet".into());
        }
        let kept = file::save(&self.file, &self.path).map_err(|e| Failure::new(FailureKind::BadInput, e))?;
        let mut told = format!("written: {}", self.path.display());
        if let Some(old) = kept {
            told += &format!(" (the one before is kept as {})", old.display());
        }
        if config.calibration.file.is_none() {
            told += &format!(
                "\ncommands of `dpm calibrate` find it there; for `dpm run`, name it in the rig file:\n[calibration]\nfile = {:?}",
                self.path.display().to_string()
            );
        }
        Ok(told)
    }

    /// Where the numbers of a part come from.
    pub fn provenance(&self, config: &RigConfig, device: &str, data: String, method: &str) -> Provenance {
        let projector = Identity::of(&config.projector.backend);
        Provenance {
            date: utc(SystemTime::now()),
            device: if device.is_empty() { projector.to_string() } else { device.to_owned() },
            data,
            commit: dpm_common::commit::get().to_owned(),
            method: method.to_owned(),
        }
    }
}

/// What is moved.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NudgeTarget {
    /// The mesh in the tracked body of this name.
    Body(String),
    /// The projector in the world.
    Projector,
}

/// Refuses a projector that was not calibrated: its lens would be missing in the calibration file.
///
/// # Errors
/// It was not (exit code 2).
pub fn check_known(results: &Results, moved: &NudgeTarget) -> Result<(), Failure> {
    if *moved == NudgeTarget::Projector && results.file.projector.is_none() {
        let told = "the calibration file has no projector yet: run `dpm calibrate projector` first";
        return Err(Failure::new(FailureKind::BadInput, told));
    }
    Ok(())
}

/// Puts a motion into the results.
pub fn keep(results: &mut Results, config: &RigConfig, moved: &NudgeTarget, motion: &DAffine3) {
    let place = Pose::new(motion);
    match moved {
        NudgeTarget::Body(name) => {
            let old = results.file.bodies.get(name);
            let data = old.map_or(String::new(), |b| b.provenance.data.clone());
            let provenance = results.provenance(config, name, data, Provenance::BY_EYE);
            // That of the measurement before does not hold for another place, and an eye gives none.
            let section = BodySection { mesh_to_body: place, residual_m: None, provenance };
            results.file.bodies.insert(name.clone(), section);
        }
        NudgeTarget::Projector => {
            let data = results.file.projector.as_ref().map_or(String::new(), |p| p.provenance.data.clone());
            let provenance = results.provenance(config, "", data, Provenance::BY_EYE);
            if let Some(section) = &mut results.file.projector {
                (section.world_from_projector, section.provenance) = (place, provenance);
            }
        }
    }
}
