//! What speaks for and against a part of a calibration file.

use super::age::{aged, days_since, is_old, OLD_DAYS};
use super::{About, StepQuantity, StepStatus};
use crate::standing::{seconds_of_utc, Identity};
use dpm_calibration_file::{CalibrationFile, CheckSection, Provenance};
use std::time::UNIX_EPOCH;

/// A calibration file in the light of the rig file.
pub(super) struct FileVerdict<'a> {
    pub(super) about: &'a About<'a>,
    pub(super) file: &'a CalibrationFile,
}

/// A part of the file, and how it stands with it.
pub(super) type Part = (StepStatus, String, Option<StepQuantity>);

impl FileVerdict<'_> {
    /// What was measured, with its age; `None` for what was moved by eye since: nothing of it is measured.
    pub(super) fn measured(&self, quality: String, from: &Provenance) -> Option<StepQuantity> {
        (!from.is_by_eye()).then(|| StepQuantity {
            date: from.date.clone(),
            age: aged(days_since(&from.date, self.about.now)),
            quality,
            device: from.device.clone(),
            data: from.data.clone(),
            method: from.method.clone(),
            commit: from.commit.clone(),
        })
    }

    /// A part that was measured at `raster` (`None`: at any) with the rig's projector.
    pub(super) fn of_projector(
        &self,
        (quality, from): (String, &Provenance),
        raster: Option<[u32; 2]>,
        checks: &[&CheckSection],
    ) -> Part {
        let measured = self.measured(quality, from);
        let own = self.about.config.projector.raster();
        if let Some([width, height]) = raster {
            if u64::from(width) * u64::from(own.height()) != u64::from(height) * u64::from(own.width()) {
                let told = format!(
                    "It was measured with {width} x {height} pixels, and the rig file has {} x {}, which is another shape.",
                    own.width(),
                    own.height()
                );
                return (StepStatus::Wrong, told, measured);
            }
        }
        let rigs = Identity::of(&self.about.config.projector.backend).to_string();
        if from.device != rigs {
            let told = format!(
                "It was measured with \"{}\", and the rig file names \"{rigs}\". Measure again if that is another projector.",
                from.device
            );
            return (StepStatus::Doubtful, told, measured);
        }
        let (state, told) = self.by_age(from, checks);
        (state, told, measured)
    }

    /// Whether a part is old and none of `checks` has confirmed it since, or was moved by eye.
    pub(super) fn by_age(&self, from: &Provenance, checks: &[&CheckSection]) -> (StepStatus, String) {
        if from.is_by_eye() {
            let told = format!(
                "It was moved by eye on {} and not measured since, so nothing says how good it is. A check tells.",
                day(&from.date)
            );
            return (StepStatus::Given, told);
        }
        if !is_old(days_since(&from.date, self.about.now)) {
            return (StepStatus::Done, String::new());
        }
        let confirms = |check: &&&CheckSection| {
            let date = &check.provenance.date;
            check.is_within()
                && seconds_of_utc(date) >= seconds_of_utc(&from.date)
                && !is_old(days_since(date, self.about.now))
        };
        match checks.iter().find(confirms) {
            Some(check) => {
                (StepStatus::Done, format!("A check confirmed it on {}.", day(&check.provenance.date)))
            }
            None => (
                StepStatus::Old,
                format!("It is older than {OLD_DAYS} days. A check tells whether it still holds."),
            ),
        }
    }

    /// The dates of what decides where light falls on a body.
    pub(super) fn dates_of(&self, body: &str) -> impl Iterator<Item = &str> {
        let projector = self.file.projector.as_ref().map(|p| p.provenance.date.as_str());
        let place = self.file.bodies.get(body).map(|b| b.provenance.date.as_str());
        projector.into_iter().chain(place)
    }

    /// What does not belong to one step.
    pub(super) fn notes(&self) -> Vec<String> {
        let mut notes = Vec::new();
        let known = |name: &String| self.about.config.scene.bodies.iter().any(|body| body.name == *name);
        for name in self.file.bodies.keys().filter(|name| !known(name)) {
            notes.push(format!(
                "The calibration file has a body \"{name}\", which the rig file does not name."
            ));
        }
        let begin = self.about.running_since.and_then(|at| at.duration_since(UNIX_EPOCH).ok());
        let is_newer = |from: &&Provenance| {
            // What was nudged while the rig ran is in use already.
            !from.is_by_eye() && begin.is_some_and(|b| seconds_of_utc(&from.date) > Some(b.as_secs()))
        };
        let file = self.file;
        let parts = file.projector.iter().map(|p| &p.provenance);
        let parts = parts.chain(file.bodies.values().map(|b| &b.provenance));
        let parts = parts.chain(file.latency.iter().map(|l| &l.provenance));
        let mut parts = parts.chain(file.light.iter().map(|l| &l.provenance));
        if parts.any(|from| is_newer(&from)) {
            notes.push("Parts were measured after this run began. Start the rig again to use them.".into());
        }
        notes
    }
}

/// The day of a date.
pub(super) fn day(date: &str) -> &str {
    date.split('T').next().unwrap_or(date)
}
