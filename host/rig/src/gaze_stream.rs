//! The thread that hears where the observer looks, beside the frame path: from a device to the newest sample.

use crate::gaze::{GazeDoubt, GazeSource};
use crate::rig::Rig;
use crate::telemetry::monitor::RunMonitor;
use dpm_device::time::HostClock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

/// The longest wait in which nothing is looked at.
const STEP: Duration = Duration::from_millis(20);
/// Shortest time between two notes.
const NOTE_EVERY: Duration = Duration::from_secs(2);

/// The thread, until this is dropped; none for a gaze that needs none.
pub(crate) struct GazeStream {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl GazeStream {
    /// Begins to hear, if the rig's gaze is measured. `clock` is that of the frames. What an operator has to know goes to
    /// the notes of `monitor`.
    pub(crate) fn start(rig: &Rig, monitor: &Arc<RunMonitor>, clock: Arc<dyn HostClock>) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let gaze = &rig.config.observer.gaze;
        let Some(source) = gaze.open(clock.clone(), false) else { return Self { stop, thread: None } };
        monitor.gaze().begin(gaze.word());
        let mut listener = Listener { source, monitor: monitor.clone(), clock, note: None, told_at: None };
        let thread = {
            let stop = stop.clone();
            Builder::new().name("dpm-gaze".into()).spawn(move || listener.run(&stop))
        };
        let thread = thread.map_err(|e| monitor.note(format!("gaze is not measured: no thread: {e}"))).ok();
        Self { stop, thread }
    }
}

impl Drop for GazeStream {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has lost its gaze and nothing else.
            let _ = thread.join();
        }
    }
}

struct Listener {
    source: Box<dyn GazeSource>,
    monitor: Arc<RunMonitor>,
    clock: Arc<dyn HostClock>,
    /// The last doubt that the operator was told.
    note: Option<GazeDoubt>,
    told_at: Option<Instant>,
}

impl Listener {
    fn run(&mut self, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) {
            let Self { source, monitor, .. } = self;
            source.poll(STEP, &mut |sample| monitor.gaze().publish(sample));
            let doubt = self.source.doubt();
            let text = doubt.as_ref().map(|doubt| format!("{}; {}", doubt.found, doubt.remedy));
            self.monitor.gaze().tell(&self.source.counts(), text, self.clock.now());
            self.note(doubt);
        }
    }

    /// Tells the operator what has changed, not more often than is read.
    fn note(&mut self, doubt: Option<GazeDoubt>) {
        if doubt == self.note || self.told_at.is_some_and(|at| at.elapsed() < NOTE_EVERY) {
            return;
        }
        self.monitor.note(match &doubt {
            Some(doubt) => {
                format!(
                    "gaze: {}; until then it follows the axis of the glasses; {}",
                    doubt.found, doubt.remedy
                )
            }
            None => "gaze: it is measured again".into(),
        });
        (self.note, self.told_at) = (doubt, Some(Instant::now()));
    }
}
