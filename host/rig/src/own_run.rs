//! Projectors that show frames which were loaded before their time: each has a run of its own.

use crate::config::RigConfig;
use crate::failure::{Failure, FailureKind};
use crate::pattern::PatternShow;
use crate::telemetry::monitor::RunMonitor;

/// What such a run reports.
pub trait OwnReport: Send {
    /// As one JSON object.
    fn json(&self) -> String;

    /// As text.
    fn table(&self) -> String;
}

/// What became of such a run.
pub type Outcome = Result<Box<dyn OwnReport>, Failure>;

/// The run of a kind, which the kind names ([`ProjectorKind::loaded`](crate::projectors::ProjectorKind::loaded)).
pub struct OwnRun {
    /// Shows the rig until its frames are over or the monitor requests a stop.
    pub run: fn(&RigConfig, &RunMonitor) -> Outcome,
    /// Shows a pattern likewise.
    pub pattern: fn(&RigConfig, &PatternShow, &RunMonitor) -> Outcome,
}

/// The run of its own that the projector of `config` has; `None` for one that is fed frame by frame.
///
/// # Errors
/// This program was built without it.
pub fn of(config: &RigConfig) -> Result<Option<&'static OwnRun>, Failure> {
    let backend = &config.projector.backend;
    if !backend.kind().is_loaded() {
        return Ok(None);
    }
    let absent = || {
        let told = format!("this program was built without runs on a {}", backend.kind().name);
        Failure::new(FailureKind::BadInput, told)
    };
    let own = backend.kind().own_run.and_then(|own| own.downcast_ref());
    own.map(Some).ok_or_else(absent)
}
