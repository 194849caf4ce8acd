//! The wand's sensor on a serial port or pseudo-terminal: the samples of [`super::SensorWand`] through the firmware's
//! own part of the protocol ([`dpm_device::sensor::device`]).

use super::{SensorSample, SensorWand};
use dpm_device::sensor::device::{Adc, Clock, Sensor, SensorIdentity, Uart};
use dpm_device::sensor::wire::{MAX_GAINS, PERIOD_ONE};
use dpm_device::time::{HostClock, HostTime};
use serialport::SerialPort;
use std::collections::VecDeque;
use std::io;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

/// Gain of the settings, in thousandths.
const GAINS_MILLI: [u32; MAX_GAINS] = [1000, 2000, 4000, 8000, 16_000, 32_000, 300, 0];
/// Samples that may wait for the line's thread: 0.6 s at 100,000 a second. Later ones are dropped, as by a converter
/// whose memory is full.
const WAITING: usize = 1 << 16;
/// Output buffer of the sensor, bytes: a fifth of a second of 12-bit samples.
const OUT: usize = 1 << 15;
/// Time between two looks at the line.
const REST: Duration = Duration::from_micros(200);

/// What the thread of the light and the thread of the line share.
#[derive(Debug, Default)]
pub struct SampleQueue {
    samples: Mutex<VecDeque<SensorSample>>,
    running: AtomicBool,
    gain: AtomicU8,
}

impl SampleQueue {
    /// Lets `wand` take its samples by `take`, at the gain that the host has set. Samples are kept while the host wants
    /// them.
    pub fn fill(
        &self,
        wand: &mut SensorWand,
        take: impl FnOnce(&mut SensorWand, &mut dyn FnMut(SensorSample)),
    ) {
        let setting = usize::from(self.gain.load(Ordering::Relaxed)).min(MAX_GAINS - 1);
        wand.set_gain(f64::from(GAINS_MILLI[setting]) / 1000.0);
        let running = self.running.load(Ordering::Relaxed);
        let mut fresh = Vec::new();
        take(wand, &mut |sample| {
            if running && fresh.len() < WAITING {
                fresh.push(sample);
            }
        });
        let mut samples = self.samples.lock().unwrap_or_else(PoisonError::into_inner);
        let room = WAITING - samples.len().min(WAITING);
        samples.extend(fresh.into_iter().take(room));
    }
}

/// The converter that the sensor sees.
struct QueueAdc<'a> {
    queue: &'a SampleQueue,
    period_ticks: u32,
    samples_per_second: u32,
}

impl Adc for QueueAdc<'_> {
    fn start(&mut self, gain: u8, samples_per_second: u32) -> Option<u32> {
        if samples_per_second != self.samples_per_second {
            return None;
        }
        self.queue.samples.lock().unwrap_or_else(PoisonError::into_inner).clear();
        self.queue.gain.store(gain, Ordering::Relaxed);
        self.queue.running.store(true, Ordering::Relaxed);
        self.period_ticks.checked_mul(PERIOD_ONE)
    }

    fn stop(&mut self) {
        self.queue.running.store(false, Ordering::Relaxed);
        self.queue.samples.lock().unwrap_or_else(PoisonError::into_inner).clear();
    }

    fn take(&mut self, into: &mut [u16]) -> (usize, u64) {
        let mut samples = self.queue.samples.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(first) = samples.front().copied() else { return (0, 0) };
        let mut n = 0;
        while let Some(sample) =
            samples.front().filter(|s| n < into.len() && s.number == first.number + n as u64)
        {
            into[n] = sample.level;
            n += 1;
            samples.pop_front();
        }
        (n, first.ticks)
    }
}

/// A port that never waits.
struct PortUart<'a> {
    port: &'a mut dyn SerialPort,
    error: Option<io::Error>,
}

impl PortUart<'_> {
    fn count(&mut self, done: io::Result<usize>) -> usize {
        match done {
            Ok(n) => n,
            Err(e) if dpm_device::tty::would_wait(&e) => 0,
            Err(e) => {
                self.error.get_or_insert(e);
                0
            }
        }
    }
}

impl Uart for PortUart<'_> {
    fn read(&mut self, into: &mut [u8]) -> usize {
        let read = self.port.read(into);
        self.count(read)
    }

    fn write(&mut self, bytes: &[u8]) -> usize {
        if bytes.is_empty() {
            return 0;
        }
        let written = self.port.write(bytes);
        self.count(written)
    }
}

struct TickClock<'a>(&'a dyn Fn() -> u64);

impl Clock for TickClock<'_> {
    fn ticks(&mut self) -> u64 {
        (self.0)()
    }
}

/// A sensor on a port, until it is dropped.
#[derive(Debug)]
pub struct SensorLine {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<io::Result<()>>>,
}

impl SensorLine {
    /// Serves the samples of `queue`, which a wand like `wand` fills, on `port`, which must never block (see
    /// [`dpm_device::tty`]). `clock` is the clock of the light.
    ///
    /// # Errors
    /// The system cannot start a thread.
    pub fn start(
        wand: &SensorWand,
        queue: Arc<SampleQueue>,
        port: Box<dyn SerialPort>,
        clock: Arc<dyn HostClock>,
    ) -> io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let (wand, stopped) = (wand.clone(), stop.clone());
        let run = move || run(&wand, &queue, port, &*clock, &stopped);
        let thread = std::thread::Builder::new().name("sensor-wand".into()).spawn(run)?;
        Ok(Self { stop, thread: Some(thread) })
    }

    /// True until the thread ends, which happens when the port fails.
    pub fn is_running(&self) -> bool {
        self.thread.as_ref().is_some_and(|t| !t.is_finished())
    }
}

impl Drop for SensorLine {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // `is_running` shows an error or panic of the thread; nobody is left to inform here.
            let _ = thread.join();
        }
    }
}

/// What the sensor says of itself.
pub fn identity_of(wand: &SensorWand) -> SensorIdentity {
    let c = wand.config();
    SensorIdentity {
        serial: c.seed,
        name: *b"hil-mock wand\0\0\0",
        bits: c.bits,
        ticks_per_second: c.ticks_per_second,
        samples_per_second: c.samples_per_second,
        floor: 0,
        ceiling: c.bits.highest(),
        gains_milli: GAINS_MILLI,
    }
}

fn run(
    wand: &SensorWand,
    queue: &SampleQueue,
    mut port: Box<dyn SerialPort>,
    clock: &dyn HostClock,
    stop: &AtomicBool,
) -> io::Result<()> {
    let mut sensor: Box<Sensor<OUT>> = Box::new(Sensor::new(identity_of(wand)));
    let c = wand.config();
    let mut adc =
        QueueAdc { queue, period_ticks: wand.period_ticks(), samples_per_second: c.samples_per_second };
    let ticks = || wand.ticks_at(HostTime(clock.now().0));
    while !stop.load(Ordering::Relaxed) {
        let mut uart = PortUart { port: &mut *port, error: None };
        sensor.step(&mut adc, &mut uart, &mut TickClock(&ticks));
        if let Some(e) = uart.error {
            return Err(e);
        }
        std::thread::sleep(REST);
    }
    Ok(())
}
