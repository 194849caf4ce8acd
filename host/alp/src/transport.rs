//! The cable to an ALP whose firmware runs in this process: a thread that opens the device, serves the link, and frees the device.

use std::path::PathBuf;
use std::sync::atomic::{AtomicI32, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam::channel::{bounded, Receiver, RecvTimeoutError};
use dpm_handoff::wake::WaitPolicy;

use super::driver::{Alp, AlpFacts, ShowMode};
use super::error::AlpError;
use super::projector::{AlpProjector, MEMORY_SPARE};
use dpm_device::link::Packet;
use dpm_device::planes::Raster;
use dpm_device::projector::Served;
use dpm_device::time::{HostClock, HostTime};
use dpm_device::transport::inproc::{threaded, DeviceEnd, HostEnd};
use dpm_device::transport::{Lane, LinkDevice, SendError, Transport, TransportError};

/// Buffers of the cable: one is filled, one is read, one is spare.
const CABLE_BUFFERS: usize = 3;
/// The device loads its logic when it is opened, which takes seconds.
const OPEN_WITHIN: Duration = Duration::from_secs(20);
/// How long the end waits for the device to be dark and free.
const END_WITHIN: Duration = Duration::from_secs(1);
/// Share of the measured rate of the cable that frames may use.
const CABLE_SHARE: f64 = 0.97;
/// Longest sleep of the thread.
const REST_NS: i64 = 100_000_000;

/// What is opened, and how.
#[derive(Clone)]
pub struct AlpSettings {
    /// The vendor's library; `None` looks for it where the system keeps libraries.
    pub library: Option<PathBuf>,
    /// Serial number of the device; 0 is the first one.
    pub number: i32,
    /// The mirrors that the rig file names.
    pub raster: Raster,
    /// How frames are shown.
    pub showing: ShowMode,
    /// Temperature above which it goes dark; what the device recommends, if left out.
    pub max_celsius: Option<f64>,
    /// Bytes on the wire of the largest frame.
    pub frame_bytes: usize,
    /// The clock of the host.
    pub clock: Arc<dyn HostClock>,
    /// Called first in the thread, for its rights.
    pub enter: Arc<dyn Fn() + Send + Sync>,
    /// How the thread waits.
    pub wait: WaitPolicy,
}

/// What was measured when the device was opened.
#[derive(Clone, Debug, PartialEq)]
pub struct AlpWelcome {
    /// What it is.
    pub facts: AlpFacts,
    /// Bytes a second over its cable.
    pub bytes_per_s: f64,
    /// From the order that shows a frame to its light, nanoseconds.
    pub start_ns: i64,
    /// Half of the range in which that lies, nanoseconds.
    pub start_uncertainty_ns: i64,
    /// Frames in its memory.
    pub frames: usize,
}

impl std::fmt::Display for AlpWelcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (facts, ms) = (&self.facts, |ns: i64| ns as f64 * 1e-6);
        write!(
            f,
            "ALP {} ({}, {} x {}, by {}): {:.0} MB/s over its cable; light begins {:.3} ms after its slot, give or take {:.3} ms; {} frames \
             in its memory; a plane lasts {} us at least",
            facts.serial,
            facts.panel,
            facts.raster.width(),
            facts.raster.height(),
            facts.library.display(),
            self.bytes_per_s / 1e6,
            ms(self.start_ns),
            ms(self.start_uncertainty_ns),
            self.frames,
            facts.shortest_us
        )
    }
}

type Opened = Result<(HostEnd, AlpWelcome), AlpError>;

/// A thread with the device.
struct Service {
    thread: JoinHandle<()>,
    opened: Receiver<Opened>,
    /// Why it ended.
    ended: Arc<OnceLock<AlpError>>,
    /// The hottest sensor, thousandths of a degree Celsius; [`UNKNOWN`] before it was looked at.
    heat: Arc<AtomicI32>,
}

/// No sensor was looked at, or there is none.
const UNKNOWN: i32 = i32::MIN;

/// The link to an ALP. Dropping it makes the device dark and frees it.
pub struct AlpTransport {
    settings: AlpSettings,
    name: String,
    welcome: Option<AlpWelcome>,
    service: Option<Service>,
    end: Option<HostEnd>,
}

impl std::fmt::Debug for AlpTransport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("AlpTransport").field("name", &self.name).finish_non_exhaustive()
    }
}

impl AlpTransport {
    /// Opens the library and the device, and measures its cable with dark pictures. Takes some seconds.
    ///
    /// # Errors
    /// No library; no device, or another program uses it; a panel, memory, queue or cable that cannot do what the rig file asks for, with
    /// the figures.
    pub fn open(settings: AlpSettings) -> Result<Self, AlpError> {
        let name = if settings.number == 0 { "ALP".into() } else { format!("ALP {}", settings.number) };
        let mut transport = Self { settings, name, welcome: None, service: None, end: None };
        transport.start();
        transport.take_opened(OPEN_WITHIN)?;
        Ok(transport)
    }

    /// What was measured when it was opened.
    pub fn welcome(&self) -> Option<&AlpWelcome> {
        self.welcome.as_ref()
    }

    fn start(&mut self) {
        let (tell, opened) = bounded(1);
        let ended = Arc::new(OnceLock::new());
        let heat = Arc::new(AtomicI32::new(UNKNOWN));
        let (settings, why, seen) = (self.settings.clone(), ended.clone(), heat.clone());
        let serve = move || {
            (settings.enter)();
            match open_device(&settings) {
                Err(e) => {
                    let _ = tell.send(Err(e));
                }
                Ok((mut projector, welcome)) => {
                    let (host, device) = threaded(settings.frame_bytes, CABLE_BUFFERS, settings.wait);
                    if tell.send(Ok((host, welcome))).is_ok() {
                        serve_cable(&mut projector, device, settings.clock.as_ref(), &seen);
                    }
                    if let Some(error) = projector.error() {
                        let _ = why.set(error.clone());
                    }
                }
            }
        };
        let thread = std::thread::Builder::new().name("dpm-alp".into()).spawn(serve);
        self.service = thread.ok().map(|thread| Service { thread, opened, ended, heat });
    }

    /// Takes what the thread has opened, within `limit`.
    fn take_opened(&mut self, limit: Duration) -> Result<(), AlpError> {
        let silent = || AlpError::Call { device: self.name.clone(), call: "AlpDevAlloc", code: 1001 };
        let Some(service) = &self.service else { return Err(silent()) };
        let opened = match service.opened.recv_timeout(limit) {
            Ok(opened) => opened,
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => return Err(silent()),
        };
        let (end, welcome) = opened?;
        self.name = format!("ALP {}", welcome.facts.serial);
        (self.end, self.welcome) = (Some(end), Some(welcome));
        Ok(())
    }

    /// What became of the device.
    fn gone(&mut self) -> TransportError {
        self.end = None;
        let device = self.name.clone();
        let why = self.service.as_ref().and_then(|service| service.ended.get());
        match why {
            Some(error) if !error.is_gone() => TransportError::Unsuitable { device, why: error.to_string() },
            _ => TransportError::Unplugged { device },
        }
    }
}

/// Opens the device, measures it, and checks what it can do.
fn open_device(settings: &AlpSettings) -> Result<(AlpProjector, AlpWelcome), AlpError> {
    let clock = || settings.clock.now();
    let mut alp = Alp::open(settings.library.as_deref(), settings.number)?;
    alp.check_raster(settings.raster)?;
    let mut showing = settings.showing;
    // As many frames as its memory holds, down to one that waits.
    let planes = showing.schedule.len() + 1;
    let held = usize::try_from(alp.facts().free_memory).unwrap_or(0) / planes;
    showing.frames = (showing.frames + MEMORY_SPARE).min(held).max(MEMORY_SPARE + 1);
    alp.prepare(&showing)?;
    let bytes_per_s = alp.measure_cable(&clock)?;
    alp.check_cable(&showing, bytes_per_s * CABLE_SHARE)?;
    let (start_ns, start_uncertainty_ns) = alp.measure_start(&clock)?;
    let frames = showing.frames;
    let facts = alp.facts().clone();
    let projector = AlpProjector::new(alp, showing, settings.max_celsius, clock())?;
    Ok((projector, AlpWelcome { facts, bytes_per_s, start_ns, start_uncertainty_ns, frames }))
}

/// Serves the cable until the host's end is dropped, or the device fails. Writes the device's temperature to `heat`.
fn serve_cable(projector: &mut AlpProjector, mut cable: DeviceEnd, clock: &dyn HostClock, heat: &AtomicI32) {
    while cable.serve(|| clock.now(), projector) && projector.error().is_none() {
        projector.advance_to(clock.now());
        let highest = projector.temperatures().highest().map_or(UNKNOWN, |c| (c * 1e3) as i32);
        heat.store(highest, Ordering::Relaxed);
        let limit = clock.now().plus_ns(REST_NS);
        cable.rest(projector.next_due().map_or(limit, |due| due.min(limit)), || clock.now());
    }
}

impl Transport for AlpTransport {
    fn send(&mut self, now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        let sent = self.end.as_mut().map(|end| end.send(now, lane, packets));
        match sent {
            Some(Err(SendError::Failed(_))) | None => Err(self.gone().into()),
            Some(sent) => sent,
        }
    }

    fn has_room(&mut self, lane: Lane) -> bool {
        self.end.as_mut().is_some_and(|end| end.has_room(lane))
    }

    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        match self.end.as_mut().map(|end| end.receive(now, sink)) {
            Some(Ok(())) => Ok(()),
            _ => Err(self.gone()),
        }
    }

    /// The device is opened by its thread, which takes longer than a call may: until then every call fails.
    fn reopen(&mut self) -> Result<(), TransportError> {
        let is_serving = self.service.as_ref().is_some_and(|service| !service.thread.is_finished());
        if !is_serving {
            self.end = None;
            self.start();
        } else if self.end.is_some() {
            return Ok(());
        }
        match self.take_opened(Duration::ZERO) {
            Ok(()) => Ok(()),
            Err(_) => Err(TransportError::Unplugged { device: self.name.clone() }),
        }
    }

    fn name(&self) -> &str {
        &self.name
    }

    fn milli_celsius(&self) -> Option<i32> {
        let heat = self.service.as_ref()?.heat.load(Ordering::Relaxed);
        (heat != UNKNOWN).then_some(heat)
    }
}

impl Drop for AlpTransport {
    fn drop(&mut self) {
        self.end = None;
        let Some(service) = self.service.take() else { return };
        // A thread that was still opening the device ends when nobody takes it.
        drop(service.opened);
        let begin = Instant::now();
        while !service.thread.is_finished() && begin.elapsed() < END_WITHIN {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}
