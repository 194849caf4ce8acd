//! Projectors that show frames which were loaded before their time: each has a run of its own.

use dpm_rig::config::RigConfig;
use dpm_rig::failure::Failure;
use dpm_rig::pattern::PatternShow;
use dpm_rig::telemetry::monitor::RunMonitor;

/// What such a run reports.
pub(crate) trait OwnReport: Send {
    /// As one JSON object.
    fn json(&self) -> String;

    /// As text.
    fn table(&self) -> String;
}

/// What became of such a run.
pub(crate) type Outcome = Result<Box<dyn OwnReport>, Failure>;

/// The run of a kind.
pub(crate) struct OwnRun {
    /// The word of `projector.backend.kind`.
    pub(crate) kind: &'static str,
    /// Shows the rig until its frames are over or the monitor requests a stop.
    pub(crate) run: fn(&RigConfig, &RunMonitor) -> Outcome,
    /// Shows a pattern likewise.
    pub(crate) pattern: fn(&RigConfig, &PatternShow, &RunMonitor) -> Outcome,
}
