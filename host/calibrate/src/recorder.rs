//! The light sensor while the projector shows something: its samples on the host's clock, and when frames were lit.

use super::shown::while_shown;
use dpm_calibration::sensor::SampleBlock;
use dpm_common::clock::{Clock, MonotonicClock};
use dpm_device::sensor::client::{SensorClient, SensorConfig};
use dpm_device::time::HostTime;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::pack::source::PatternSource;
use dpm_rig::pattern::run_pattern_stamped;
use dpm_rig::telemetry::monitor::{ProjectorHealth, RunMonitor};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Time between two polls of the sensor, nanoseconds.
const POLL_EVERY_NS: i64 = 1_000_000;
/// Samples in a block.
const BLOCK: u16 = 250;
/// Most samples that are kept: ten minutes at 100 kS/s.
const MOST_SAMPLES: usize = 60_000_000;
/// How long the projector and the sensor may take until both work.
const READY_WITHIN: Duration = Duration::from_secs(10);

/// Where the sensor is.
#[derive(Clone, Debug)]
pub struct Port {
    /// Its serial port.
    pub path: String,
    /// Bits per second of the port.
    pub baud: u32,
    /// Its gain setting, 0 for the first.
    pub gain: u8,
}

/// A sensor that is read by a thread of its own until this is dropped.
pub struct Recorder {
    shared: Arc<Mutex<SampleLog>>,
    is_over: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

/// A block and where its clock was.
#[derive(Clone, Debug, PartialEq)]
pub struct TimedBlock {
    /// The samples, on the sensor's clock.
    pub block: SampleBlock,
    /// The sensor's clock less the host's when it came, nanoseconds; `None` before the clock was mapped.
    pub sensor_minus_host_ns: Option<i64>,
}

#[derive(Default)]
struct SampleLog {
    blocks: Vec<TimedBlock>,
    samples: usize,
    /// The sensor's clock less the host's, nanoseconds, once it is known.
    sensor_minus_host_ns: Option<i64>,
    saturated: usize,
    status: String,
}

impl Recorder {
    /// Begins to read the sensor. `clock` stamps what it says.
    ///
    /// # Errors
    /// A setting that no sensor takes (exit code 2), or no thread can be started (3).
    pub fn start(port: &Port, clock: MonotonicClock) -> Result<Self, Failure> {
        let config = SensorConfig {
            port: port.path.clone(),
            baud: port.baud,
            gain: port.gain,
            block: BLOCK,
            samples_per_second: 0,
        };
        let sleeping = clock.sleeping();
        let mut client = SensorClient::open(config, Arc::new(move || sleeping.now()))
            .map_err(|e| Failure::new(FailureKind::BadInput, e))?;
        let shared = Arc::new(Mutex::new(SampleLog::default()));
        let (to, is_over) = (Arc::clone(&shared), Arc::new(AtomicBool::new(false)));
        let over = Arc::clone(&is_over);
        let work = move || {
            let mut fresh = Vec::new();
            while !over.load(Ordering::Relaxed) {
                let now = sleeping.now();
                client.poll(now, &mut |block| {
                    fresh.push((block.head, block.levels.iter().collect::<Vec<u16>>()))
                });
                let ticks_per_second = client.hello().map_or(0, |h| h.ticks_per_second);
                let mut shared = to.lock().unwrap_or_else(PoisonError::into_inner);
                for (head, levels) in fresh.drain(..) {
                    // The gain does not change while this runs.
                    let Some(block) = SampleBlock::from_wire(&head, &levels, ticks_per_second, 1.0) else {
                        continue;
                    };
                    if let Some(at) = client.sampled_at(&head, 0) {
                        shared.sensor_minus_host_ns = Some(block.start_ns - at.at.0);
                    }
                    shared.saturated += usize::from(head.cut_above);
                    if shared.samples < MOST_SAMPLES {
                        shared.samples += levels.len();
                        let sensor_minus_host_ns = shared.sensor_minus_host_ns;
                        shared.blocks.push(TimedBlock { block, sensor_minus_host_ns });
                    }
                }
                shared.status = client.status();
                drop(shared);
                sleeping.wait_until(now.plus_ns(POLL_EVERY_NS));
            }
        };
        let thread = std::thread::Builder::new()
            .name("dpm-sensor".into())
            .spawn(work)
            .map_err(|e| Failure::new(FailureKind::Device, format!("cannot start a thread: {e}")))?;
        Ok(Self { shared, is_over, thread: Some(thread) })
    }

    fn locked(&self) -> std::sync::MutexGuard<'_, SampleLog> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the blocks that have been sampled since the last call; the number says how many of them are saturated.
    pub fn take(&self) -> (Vec<TimedBlock>, usize) {
        let mut shared = self.locked();
        shared.samples = 0;
        let saturated = std::mem::take(&mut shared.saturated);
        (std::mem::take(&mut shared.blocks), saturated)
    }

    /// Samples, and blocks of them that are saturated, since the last [`Recorder::take`].
    pub fn counts(&self) -> (usize, usize) {
        let shared = self.locked();
        (shared.samples, shared.saturated)
    }

    /// The sensor's clock less the host's, nanoseconds.
    ///
    /// # Errors
    /// It was never mapped; the message has the sensor's own words.
    pub fn sensor_minus_host_ns(&self) -> Result<i64, Failure> {
        let shared = self.locked();
        let told = || format!("the sensor's clock was never mapped: {}", shared.status);
        shared.sensor_minus_host_ns.ok_or_else(|| Failure::new(FailureKind::Device, told()))
    }

    /// Waits until the sensor's clock is mapped.
    ///
    /// # Errors
    /// It is not within ten seconds, or `monitor` asks for a stop.
    pub fn wait_until_mapped(&self, monitor: &RunMonitor) -> Result<(), Failure> {
        let is_mapped = || self.locked().sensor_minus_host_ns.is_some();
        wait_for(monitor, is_mapped, || format!("the light sensor does not answer: {}", self.locked().status))
    }
}

/// Waits until the projector is up.
///
/// # Errors
/// It is not within ten seconds, or `monitor` asks for a stop.
pub fn wait_until_up(monitor: &RunMonitor) -> Result<(), Failure> {
    let is_up = || monitor.projector() == ProjectorHealth::Up;
    wait_for(monitor, is_up, || format!("the projector is not up: {}", monitor.projector()))
}

fn wait_for(
    monitor: &RunMonitor,
    is_there: impl Fn() -> bool,
    why: impl Fn() -> String,
) -> Result<(), Failure> {
    let begin = Instant::now();
    while !is_there() {
        if begin.elapsed() > READY_WITHIN || monitor.stop_requested() {
            return Err(Failure::new(FailureKind::Device, why()));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(())
}

/// Reports of light are kept for so much longer than a measurement takes: for the operator, and for parts that are repeated.
const SPARE_S: f64 = 150.0;

/// Slot and first photon of each lit frame.
pub type Lights = Vec<(u64, HostTime)>;

/// Shows `source` for `seconds` at most, and as long again as an operator may take, while `work` goes on. Gives what `work`
/// gives and what was lit, on `clock`.
///
/// # Errors
/// As [`while_shown`].
pub fn while_stamped<T>(
    config: &RigConfig,
    source: Arc<dyn PatternSource>,
    (clock, seconds): (MonotonicClock, f64),
    monitor: &Arc<RunMonitor>,
    work: impl FnOnce() -> Result<T, Failure>,
) -> Result<(T, Lights), Failure> {
    let frames = (config.projector.frame_rate.hz() * (seconds + SPARE_S)) as usize;
    while_shown(monitor, || run_pattern_stamped(config, source, (clock, frames), monitor), work)
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
