//! What each stage requests from the operating system: granted rights, and one warning per refusal.

use crate::config::RealTimeConfig;
use crate::telemetry::monitor::RunMonitor;
use dpm_common::realtime::awake::CoresAwake;
use dpm_common::realtime::{enter_frame_path, os, RightRefusal, ThreadRights};
use dpm_handoff::path::Lock;
use std::sync::Arc;

/// The mock projector's index in the list of cores, after the stages.
const PROJECTOR: usize = 4;

/// Rights of a run. At the end locked memory is unlocked, and idle cores may sleep again.
pub(super) struct Rights {
    priority: u32,
    cores: Vec<u32>,
    locked: bool,
    _awake: Option<CoresAwake>,
    refusals: Lock<Vec<RightRefusal>>,
    /// Tells the operator of a refusal at once: a service may run for weeks before its report is written.
    monitor: Arc<RunMonitor>,
}

impl Rights {
    /// Reads `[real_time]`, locks memory and keeps cores awake if it says so.
    pub(super) fn new(config: &RealTimeConfig, monitor: &Arc<RunMonitor>) -> Self {
        let mut refusals = Vec::new();
        let mut refused = |refusal: RightRefusal| {
            monitor.note(refusal.to_string());
            refusals.push(refusal);
        };
        let locked = config.lock_memory && os::lock_memory().map_err(&mut refused).is_ok();
        let awake = match config.keep_awake {
            true => CoresAwake::hold().map_err(&mut refused).ok().flatten(),
            false => None,
        };
        Self {
            priority: config.priority,
            cores: config.affinity.clone(),
            locked,
            _awake: awake,
            refusals: Lock::new(refusals),
            monitor: monitor.clone(),
        }
    }

    /// Requests the rights of the calling thread, which is stage number `stage` of the frame path. Call it before the
    /// first frame.
    pub(super) fn enter(&self, stage: usize) {
        let core = self.cores.get(stage).copied();
        let granted = enter_frame_path(ThreadRights { priority: self.priority, core });
        if let Ok(mut refusals) = self.refusals.lock() {
            for refusal in granted.refusals {
                if !refusals.contains(&refusal) {
                    self.monitor.note(refusal.to_string());
                    refusals.push(refusal);
                }
            }
        }
    }

    /// The same for the mock projector's thread. It represents a separate machine, so no stage may delay it.
    pub(super) fn enter_projector(&self) {
        let above = self.highest_priority();
        // The stages report a refusal, because they request nearly the same.
        let core = self.cores.get(PROJECTOR).copied();
        let _ = enter_frame_path(ThreadRights { priority: above, core });
    }

    /// The same for the supervisor, which no stage may delay, and which needs very little time.
    pub(super) fn enter_supervisor(&self) {
        let _ = enter_frame_path(ThreadRights { priority: self.highest_priority(), core: None });
    }

    /// The highest priority that any thread of the run requests; 0 under the normal scheduler.
    pub(super) fn highest_priority(&self) -> u32 {
        if self.priority > 0 {
            (self.priority + 1).min(99)
        } else {
            0
        }
    }

    /// The refusals as text.
    pub(super) fn warnings(&self) -> Vec<String> {
        self.refusals.lock().map(|r| r.iter().map(RightRefusal::to_string).collect()).unwrap_or_default()
    }
}

impl Drop for Rights {
    fn drop(&mut self) {
        if self.locked {
            os::unlock_memory();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Either cores are held awake, or the operator hears why not; only a system without the device is silent.
    #[test]
    fn cores_stay_awake_if_the_rig_file_says_so() {
        let new = |keep_awake| {
            let monitor = Arc::new(RunMonitor::default());
            Rights::new(&RealTimeConfig { keep_awake, ..RealTimeConfig::default() }, &monitor)
        };
        let (with, without) = (new(true), new(false));
        assert!(without._awake.is_none() && without.warnings().is_empty());
        match CoresAwake::hold() {
            Ok(held) => assert_eq!((with._awake.is_some(), with.warnings().len()), (held.is_some(), 0)),
            Err(refusal) => assert_eq!(with.warnings(), [refusal.to_string()]),
        }
    }

    #[test]
    fn a_right_refused_to_every_stage_is_one_warning() {
        let config = RealTimeConfig {
            priority: 0,
            affinity: vec![1023; 3],
            keep_awake: false,
            ..RealTimeConfig::default()
        };
        let monitor = Arc::new(RunMonitor::default());
        let rights = Rights::new(&config, &monitor);
        std::thread::scope(|scope| {
            for stage in 0..3 {
                let rights = &rights;
                scope.spawn(move || rights.enter(stage));
            }
        });
        let warnings = rights.warnings();
        assert_eq!(warnings.len(), 1, "{warnings:?}");
        assert!(warnings[0].contains("core 1023"));
        assert_eq!(monitor.take_notes(), warnings, "the operator hears of it at once");
    }
}
