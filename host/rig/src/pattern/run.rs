//! `dpm pattern` on a projector that takes frames over a link: from a rig file and pictures to a report.

use super::PatternError;
use crate::config::RigConfig;
use crate::failure::{Ended, Failure, FailureKind};
use crate::pack::source::PatternSource;
use crate::pipeline::{self, RunOptions};
use crate::rig::Rig;
use crate::telemetry::monitor::RunMonitor;
use crate::telemetry::report::Report;
use dpm_common::clock::MonotonicClock;
use dpm_device::time::HostTime;
use std::sync::Arc;

/// Shows the pictures of `source` on the projector of `config` until its run is over or `monitor` asks for a stop.
/// Orders, limits, interlock and watchdog hold as in [`crate::run_rig::run_rig`]. Needs neither GPU nor scene nor
/// tracker.
///
/// # Errors
/// A device that fails (exit code 3). After the run: light that differs from the pictures (1).
pub fn run_pattern(
    config: &RigConfig,
    source: Arc<dyn PatternSource>,
    monitor: &Arc<RunMonitor>,
) -> Result<Ended<Report>, Failure> {
    let rig = Arc::new(Rig::of_projector(config)?);
    let options =
        RunOptions { frames: config.run.frames, slots: config.slots_to_run(), ..RunOptions::default() };
    let mut outcome = pipeline::run_pattern(rig, source, None, options, monitor)?;
    let mut ended = Ended::from(std::mem::take(&mut outcome.report));
    if outcome.light_mismatches > 0 {
        let told = format!("{} frames of light differ from the pattern", outcome.light_mismatches);
        ended.fail(Failure::new(FailureKind::CheckFailed, told));
    }
    Ok(ended)
}

/// The same, with the slot and the first photon of each lit frame, the last `most` of them, on `clock`.
///
/// # Errors
/// As [`run_pattern`].
pub fn run_pattern_stamped(
    config: &RigConfig,
    source: Arc<dyn PatternSource>,
    (clock, most): (MonotonicClock, usize),
    monitor: &Arc<RunMonitor>,
) -> Result<Vec<(u64, HostTime)>, Failure> {
    let rig = Arc::new(Rig::of_projector(config)?);
    let options = RunOptions { keep_records: most, ..RunOptions::default() };
    let outcome = pipeline::run_pattern(rig, source, Some(clock), options, monitor)?;
    Ok(outcome.recent.iter().filter_map(|r| Some((r.slot, r.timeline.lit_at?))).collect())
}

impl From<PatternError> for Failure {
    fn from(error: PatternError) -> Self {
        Self::new(FailureKind::BadInput, error)
    }
}
