//! Which projector has a run of its own.

use crate::own_run::OwnRun;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};

const ALL: &[&OwnRun] = &[
    #[cfg(feature = "dlpc900")]
    &crate::dlpc900::OWN_RUN,
];

/// The run of its own that the projector of `config` has; `None` for one that is fed frame by frame.
///
/// # Errors
/// This program was built without it.
pub(super) fn of(config: &RigConfig) -> Result<Option<&'static OwnRun>, Failure> {
    let backend = &config.projector.backend;
    if !backend.kind().is_loaded() {
        return Ok(None);
    }
    let known = ALL.iter().copied().find(|own| own.kind == backend.word());
    let absent = || {
        let told = format!("this program was built without runs on a {}", backend.kind().name);
        Failure::new(FailureKind::BadInput, told)
    };
    known.map(Some).ok_or_else(absent)
}
