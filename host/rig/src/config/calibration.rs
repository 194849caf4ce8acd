//! `[calibration]`: what `dpm calibrate` measured.

use super::check::refuse;
use super::RigConfig;
use dpm_calibration_file::{self as file, CalibrationFile};
use dpm_common::keys::read::{KeyReader, NotEmpty};
use dpm_common::section;
use std::path::PathBuf;

section! {
    /// What `dpm calibrate` measured.
    pub struct CalibrationConfig {
        /// The file that `dpm calibrate` writes. Its parts take the place of `projector.position`, `look_at`, `up`,
        /// `horizontal_fov_deg` and `calibration`; of `scene.bodies[].mesh_to_body`; of `tracker.latency_us`; of
        /// `projector.response` and `projector.flat_field`, and of the channels' shares of `projector.max_intensity`.
        file: Option<PathBuf> = None, "", NotEmpty;
    }
}

/// Refuses a calibration file that cannot be read, and keys that are given twice.
pub(super) fn check(rig: &RigConfig, reader: &mut KeyReader) {
    let Some(path) = &rig.calibration.file else { return };
    let measured = match file::load(path) {
        Ok(measured) => measured,
        Err(e) => {
            let remedy = "measure again with `dpm calibrate`, or remove the key".to_owned();
            return refuse(reader, &["calibration.file"], e.to_string(), remedy);
        }
    };
    let weights = &rig.projector.weights;
    let told = measured.light.as_ref().map(|light| light.weights.as_deref());
    // A file that names no planes was measured with those of its rig, before there were planes that exceed full light.
    let of_file = |told: Option<&str>| told.unwrap_or(rig.projector.weights_measured(None).word()).to_owned();
    if let Some(of_file) = told.map(of_file).filter(|of_file| *of_file != weights.word()) {
        let problem = format!(
            "its light was measured with projector.weights = {of_file:?}, and the rig has {:?}, of which it is not known what a \
             code value gives",
            weights.word()
        );
        let remedy =
            format!("set projector.weights = {of_file:?}, or measure again with `dpm calibrate light`");
        refuse(reader, &["calibration.file", "projector.weights"], problem, remedy);
    }
    for key in taken(rig, &measured).into_iter().filter(|key| reader.is_written(key)).collect::<Vec<_>>() {
        let problem = "is given twice: here and by `calibration.file`".to_owned();
        refuse(reader, &[&key], problem, "remove it; the calibration file has the measured value".into());
    }
}

/// Keys whose place the parts of the file take.
fn taken(rig: &RigConfig, measured: &CalibrationFile) -> Vec<String> {
    let mut keys = Vec::new();
    if measured.projector.is_some() {
        let names = ["position", "look_at", "up", "horizontal_fov_deg", "calibration"];
        keys.extend(names.map(|name| format!("projector.{name}")));
    }
    for (i, body) in rig.scene.bodies.iter().enumerate() {
        if measured.bodies.contains_key(&body.name) {
            keys.push(format!("scene.bodies.{i}.mesh_to_body"));
        }
    }
    if measured.latency.is_some() && rig.tracker.frame().is_some() {
        keys.push("tracker.latency_us".into());
    }
    if measured.light.is_some() {
        keys.extend(["projector.response", "projector.flat_field"].map(str::to_owned));
    }
    keys
}
