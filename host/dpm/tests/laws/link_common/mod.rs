//! A rig with prepared frames on a projector outside the pipeline: behind a pseudo-terminal or a USB cable.
#![allow(dead_code)]

use dpm_device::link::Status;
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::HostTime;
use dpm_device::transport::LinkDevice;
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::pack::prepared::is_whole;
use dpm_rig::pipeline::{run_prepared, PipelineError, RunOptions, RunOutcome};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use hil_mock::projector::serial::SerialProjector;
use hil_mock::projector::{MockConfig, MockProjector};
use hil_mock::serial_server::{pseudo_terminal, PortName};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// The panel.
pub(crate) fn raster() -> Raster {
    Raster::new(64, 32).unwrap()
}

/// The rig with `backend` (a TOML table), 8 planes at 100 frames per second.
pub(crate) fn rig(backend: &str, more: &[&str]) -> Arc<Rig> {
    let mut flags = vec![
        "real_time.pace=\"real\"".to_owned(),
        "projector.frame_rate=100".into(),
        "projector.planes=8".into(),
        "safety.watchdog_ms=1000".into(),
        format!("projector.backend={backend}"),
    ];
    flags.extend(more.iter().map(|s| (*s).to_owned()));
    let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
    Arc::new(Rig::build(&config, Some(raster())).unwrap_or_else(|e| panic!("{e}")))
}

/// Waits until `done`, at most 20 s, and returns the time that counts against a deadline. If a sleep of a millisecond
/// took longer than two, the excess belongs to others on a shared machine and does not count.
pub(crate) fn served_time(what: &str, mut done: impl FnMut() -> bool) -> Duration {
    let (start, mut counted) = (Instant::now(), Duration::ZERO);
    while !done() {
        assert!(start.elapsed() < Duration::from_secs(20), "{what}");
        let step = Instant::now();
        std::thread::sleep(Duration::from_millis(1));
        counted += step.elapsed().min(Duration::from_millis(2));
    }
    counted
}

/// A projector that can be observed while it works.
pub(crate) trait Projector: Send + Sync {
    /// Advances it to now and observes it.
    fn look(&self, see: &mut dyn FnMut(&mut MockProjector));

    /// What it would report.
    fn status(&self) -> Status {
        let mut status = None;
        self.look(&mut |m| status = Some(m.status()));
        status.expect("looked at")
    }

    /// True when light is on.
    fn is_lit(&self) -> bool {
        let mut lit = false;
        self.look(&mut |m| lit = m.is_lit());
        lit
    }

    /// The planes on the mirrors are those of one frame.
    fn check_whole(&self) {
        self.look(&mut |m| {
            if let (Some(id), Some(planes)) = (m.lit_frame(), m.lit_planes()) {
                assert!(is_whole(m.raster(), &PlaneSchedule::mono8(), planes, id), "frame {id} is torn");
            }
            assert_eq!(m.credit_violations(), 0);
        });
    }

    /// Waits until `done`, at most `limit`; returns the time that it took.
    fn until(&self, limit: Duration, what: &str, done: &mut dyn FnMut(&Status) -> bool) -> Duration {
        let start = Instant::now();
        while !done(&self.status()) {
            assert!(start.elapsed() < limit, "{what}: not within {limit:?}: {:?}", self.status());
            std::thread::sleep(Duration::from_micros(500));
        }
        start.elapsed()
    }
}

/// A run on a thread of its own. It ends together with the test.
pub(crate) struct RunThread {
    pub monitor: Arc<RunMonitor>,
    thread: Option<JoinHandle<Result<RunOutcome, PipelineError>>>,
}

/// Starts `rig` for `frames` frames; 0 runs until stopped.
pub(crate) fn start(rig: &Arc<Rig>, frames: u64) -> RunThread {
    start_with(rig, frames, |_| {})
}

/// Like [`start`], with a monitor that `prepare` gets before the run.
pub(crate) fn start_with(rig: &Arc<Rig>, frames: u64, prepare: impl FnOnce(&RunMonitor)) -> RunThread {
    let monitor = Arc::new(RunMonitor::default());
    prepare(&monitor);
    let (rig, watched) = (rig.clone(), monitor.clone());
    let options = RunOptions { frames, ..RunOptions::default() };
    let thread = std::thread::spawn(move || run_prepared(rig, options, &watched));
    RunThread { monitor, thread: Some(thread) }
}

impl RunThread {
    /// Waits until `done`, at most 20 s, and no longer than the run goes on.
    pub(crate) fn until(&self, what: &str, mut done: impl FnMut(&RunMonitor) -> bool) {
        let begin = Instant::now();
        while !done(&self.monitor) {
            let is_over = self.thread.as_ref().is_none_or(JoinHandle::is_finished);
            let counts = self.monitor.counts();
            assert!(
                !is_over && begin.elapsed() < Duration::from_secs(20),
                "{what}: run over: {is_over}; {counts:?}"
            );
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Waits for the end.
    pub(crate) fn end(mut self) -> Result<RunOutcome, PipelineError> {
        self.thread.take().expect("taken once").join().expect("no panic")
    }

    /// Requests its end, as a signal does.
    pub(crate) fn stop(self) -> Result<RunOutcome, PipelineError> {
        self.monitor.request_stop();
        self.end()
    }
}

impl Drop for RunThread {
    fn drop(&mut self) {
        let was_over = self.thread.as_ref().is_some_and(JoinHandle::is_finished);
        self.monitor.request_stop();
        let Some(thread) = self.thread.take() else { return };
        let outcome = thread.join();
        // A test that waits in vain for what the run should do: this is why.
        if was_over && std::thread::panicking() {
            match outcome {
                Ok(Ok(outcome)) => eprintln!("the run had ended well: {:?}", outcome.report),
                Ok(Err(error)) => eprintln!("the run had ended: {error}"),
                Err(_) => eprintln!("the run had panicked"),
            }
        }
    }
}

/// A projector behind a pseudo-terminal whose path stays the same when it is replugged.
pub(crate) struct PtyProjector {
    pub path: PathBuf,
    device: Arc<Mutex<SerialProjector>>,
    start: Instant,
    served: Mutex<Option<PluggedProjector>>,
}

/// A projector that is plugged in.
struct PluggedProjector {
    name: PortName,
    stop: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl PtyProjector {
    /// Plugs in a projector of `setup`.
    pub(crate) fn new(name: &str, setup: MockConfig) -> Self {
        let path = std::env::temp_dir().join(format!("dpm-run-{name}-{}", std::process::id()));
        let device = Arc::new(Mutex::new(SerialProjector::new(MockProjector::new(setup))));
        let this = Self { path, device, start: Instant::now(), served: Mutex::new(None) };
        this.plug_in();
        this
    }

    /// The backend of a rig file on it.
    pub(crate) fn backend(&self, more: &str) -> String {
        format!(
            "{{ kind = \"serial\", port = {:?}, baud = 3000000 {more} }}",
            self.path.display().to_string()
        )
    }

    /// Pulls the plug. The projector keeps its power, and its light until the watchdog acts.
    pub(crate) fn unplug(&self) {
        if let Some(PluggedProjector { name, stop, thread }) = self.served.lock().unwrap().take() {
            drop(name);
            stop.store(true, Ordering::Relaxed);
            thread.join().unwrap();
        }
    }

    /// Puts another projector there while it is unplugged.
    pub(crate) fn exchange(&self, setup: MockConfig) {
        *self.device.lock().unwrap() = SerialProjector::new(MockProjector::new(setup));
    }

    /// Plugs it in again.
    pub(crate) fn plug_in(&self) {
        let (mut master, terminal, held) = pseudo_terminal().expect("a pseudo-terminal");
        let name = PortName::give(&self.path, &terminal).unwrap();
        let stop = Arc::new(AtomicBool::new(false));
        let (stopped, device, start) = (stop.clone(), self.device.clone(), self.start);
        let thread = std::thread::spawn(move || {
            let _held = held;
            while !stopped.load(Ordering::Relaxed) {
                let clock = || HostTime(start.elapsed().as_nanos() as i64);
                assert!(
                    device.lock().unwrap().serve(clock, &mut master).expect("the line works"),
                    "held open"
                );
                std::thread::sleep(Duration::from_micros(300));
            }
        });
        *self.served.lock().unwrap() = Some(PluggedProjector { name, stop, thread });
    }
}

impl Projector for PtyProjector {
    fn look(&self, see: &mut dyn FnMut(&mut MockProjector)) {
        let now = HostTime(self.start.elapsed().as_nanos() as i64);
        let mut device = self.device.lock().unwrap();
        device.projector().advance_to(now);
        see(device.projector());
    }
}

impl Drop for PtyProjector {
    fn drop(&mut self) {
        self.unplug();
    }
}
