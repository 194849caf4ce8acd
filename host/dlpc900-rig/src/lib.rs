//! A TI DLPC900 as the projector of a rig. Its frames are loaded before they are shown ([`run`], kind "dlpc900"), or a display
//! feeds it with them ([`feed`], table `dlpc900` of kind "display"). [`keys`] and [`behind`] read what the rig file says of it,
//! [`command`] is `dpm dlpc900`, and [`rest`] puts the controller of a killed run to rest. The driver is `dpm-dlpc900`.
//!
//! A program calls [`register`] before it reads a rig file.

pub mod behind;
pub mod command;
pub mod feed;
pub mod keys;
#[cfg(test)]
mod keys_tests;
mod pattern;
mod pictures;
mod rest;
mod run;

use dpm_dlpc900::driver::Dlpc900Error;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::own_run::{OwnReport, OwnRun};
use dpm_rig::projectors::{self, controller, ProjectorBackend};
use dpm_rig::telemetry::report::to_json;
use keys::Dlpc900Config;

/// Adds the kind, its run, and the controller behind a display to the tables of the rig.
pub fn register() {
    projectors::add(&keys::KIND);
    controller::add(&behind::KIND);
}

static OWN_RUN: OwnRun = OwnRun {
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

/// What a caller can do about an error of the driver.
fn failure(e: Dlpc900Error) -> Failure {
    let kind = match e {
        Dlpc900Error::Sequence(_) => FailureKind::BadInput,
        _ => FailureKind::Device,
    };
    Failure::new(kind, e)
}

/// Its keys in a rig file.
///
/// # Errors
/// The rig's projector is of another kind.
fn keys_of(backend: &ProjectorBackend) -> Result<&Dlpc900Config, Failure> {
    let refused = || Failure::new(FailureKind::BadInput, "projector.backend.kind is not \"dlpc900\"");
    backend.keys().ok_or_else(refused)
}
