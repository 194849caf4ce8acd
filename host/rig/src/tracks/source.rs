//! Opens the tracker of `[tracker]` in the rig file, ready to be polled.

use super::tracker_frame::TrackerFrame;
use crate::config::RigConfig;
use crate::rig::Rig;
use crate::trackers::{SourceError, TrackerPlace};
use dpm_device::time::{HostClock, HostTime};
use dpm_device::tracker::{BodyKey, SampleGate, Tracker, TrackerError, TrackerSample};
use std::sync::Arc;
use std::time::Duration;

/// The tracker of a run that tracks nothing.
pub(crate) struct NoTracker;

impl Tracker for NoTracker {
    fn poll(&mut self, _: HostTime, _: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        Ok(0)
    }

    fn name(&self) -> &str {
        "none"
    }
}

/// Opens the tracker of `rig`; its polls are stamped with `clock`. Time 0 of the mock's motions is instant 0 of the
/// host's clock; a recording starts at `start`.
///
/// # Errors
/// Its address, file or settings are wrong.
pub fn open_for(
    rig: &Rig,
    clock: Arc<dyn HostClock>,
    start: HostTime,
) -> Result<Box<dyn Tracker>, SourceError> {
    let bodies = rig.tracked().map(|b| BodyKey { name: b.name.clone(), id: b.id }).collect();
    let motions = rig.tracked().filter_map(|b| b.motion.clone()).collect();
    rig.config.tracker.open(TrackerPlace { bodies, motions, clock, start })
}

/// Opens the tracker of a rig file for `bodies` by their names alone, without a scene. The mock in this process, which
/// plays the scene's bodies, has none then. A recording starts at `start`.
///
/// # Errors
/// Its address, file or settings are wrong.
pub fn open_for_names(
    config: &RigConfig,
    bodies: Vec<BodyKey>,
    clock: Arc<dyn HostClock>,
    start: HostTime,
) -> Result<Box<dyn Tracker>, SourceError> {
    config.tracker.open(TrackerPlace { bodies, motions: Vec::new(), clock, start })
}

/// Opens the tracker of a rig file for bodies that need not be the rig's, such as a wand. Poses are in the rig's world.
/// Their times are the tracker's own: `tracker.latency_us` is not applied. The mock in this process has no such bodies.
///
/// # Errors
/// Its address, file or settings are wrong.
pub fn open_in_world(
    config: &RigConfig,
    bodies: Vec<BodyKey>,
    clock: Arc<dyn HostClock>,
) -> Result<Box<dyn Tracker>, SourceError> {
    let tracker = open_for_names(config, bodies, clock, HostTime(0))?;
    Ok(match TrackerFrame::of(&config.tracker, Some(0)) {
        None => tracker,
        Some(frame) => Box::new(InWorld { tracker, frame }),
    })
}

/// A tracker whose poses are in the world.
struct InWorld {
    tracker: Box<dyn Tracker>,
    frame: TrackerFrame,
}

impl Tracker for InWorld {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        let Self { tracker, frame } = self;
        tracker.poll(now, &mut |sample| sink(&frame.apply(sample)))
    }

    fn name(&self) -> &str {
        self.tracker.name()
    }

    fn status(&self) -> String {
        self.tracker.status()
    }

    fn wait(&self, timeout: Duration) -> bool {
        self.tracker.wait(timeout)
    }

    fn due_at(&self) -> Option<HostTime> {
        self.tracker.due_at()
    }

    fn gate(&self) -> Option<&SampleGate> {
        self.tracker.gate()
    }
}
