//! A TI DLPC900 whose frames are loaded before they are shown: its own run, patterns and pictures, and what puts it to rest.

pub(crate) mod pattern;
pub(crate) mod pictures;
pub(crate) mod rest;
pub(crate) mod run;

use crate::own_run::{OwnReport, OwnRun};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::projectors::dlpc900::Dlpc900Config;
use dpm_rig::projectors::ProjectorBackend;
use dpm_rig::telemetry::report::to_json;

/// The row of its kind.
pub(crate) static OWN_RUN: OwnRun = OwnRun {
    kind: "dlpc900",
    run: |config, monitor| Ok(Box::new(run::run_dlpc900(config, monitor)?)),
    pattern: |config, show, monitor| Ok(Box::new(pattern::run_pattern_dlpc900(config, show, monitor)?)),
};

impl OwnReport for run::Dlpc900Report {
    fn json(&self) -> String {
        to_json(self)
    }

    fn table(&self) -> String {
        self.to_table()
    }
}

/// Its keys in a rig file.
///
/// # Errors
/// The rig's projector is of another kind.
fn keys(backend: &ProjectorBackend) -> Result<&Dlpc900Config, Failure> {
    let refused = || Failure::new(FailureKind::BadInput, "projector.backend.kind is not \"dlpc900\"");
    backend.keys().ok_or_else(refused)
}
