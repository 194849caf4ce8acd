//! The rig's process: it starts, runs, ends, is killed, and is started again by the service manager.

use crate::cable::{lock, Cable, HostEnd};
use crate::disk::{Disk, SimFolder};
use crate::machine::SimMachine;
use crate::port::SimPorts;
use dpm_common::clock::ManualClock;
use dpm_device::time::HostTime;
use dpm_device::transport::serial::{SerialSettings, SerialTransport};
use dpm_device::transport::{Transport, TransportError};
use dpm_rig::config::Restart;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::interlock::{Asking, Contact, Interlock, ASK_EVERY};
use dpm_rig::pipeline::projector::frame_bytes;
use dpm_rig::pipeline::stepped::{SteppedEnd, SteppedOrders, SteppedRun};
use dpm_rig::projectors::Cable as RigCable;
use dpm_rig::rig::Rig;
use dpm_rig::standing::Identity;
use dpm_rig::telemetry::monitor::{ProjectorHealth, RunMonitor};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex};

/// How often the thread that writes orders down looks for new ones, nanoseconds.
const ORDERS_NS: i64 = 20_000_000;
/// How long the disk takes to write an order, nanoseconds.
const DISK_NS: i64 = 2_000_000;

/// A program that was asked to stop ends after this time, whatever hangs, nanoseconds.
const STOPPED_NS: i64 = 2_000_000_000;

/// How often the interlock's contact is asked, nanoseconds.
const ASK_NS: i64 = ASK_EVERY.as_nanos() as i64;

/// The contact of the interlock: closed, open, or it does not answer.
#[derive(Clone, Debug, Default)]
pub struct SimContact(pub Arc<AtomicU8>);

impl SimContact {
    /// It is open.
    pub const OPEN: u8 = 1;
    /// It does not answer.
    pub const HANGS: u8 = 2;

    fn hangs(&self) -> bool {
        self.0.load(Ordering::Relaxed) == Self::HANGS
    }
}

impl Contact for SimContact {
    fn is_closed(&mut self) -> bool {
        self.0.load(Ordering::Relaxed) == 0
    }
}

/// How a process ended.
#[derive(Debug)]
pub enum Exit {
    /// In order, as it was asked to.
    InOrder,
    /// With an error of the projector, or a bug: the service manager starts it again.
    Again(String),
    /// With an error that a new start does not cure.
    ForGood(String),
}

/// Opens the way to the projector.
fn medium(rig: &Rig, cable: &Arc<Mutex<Cable>>) -> Result<Box<dyn Transport>, TransportError> {
    let backend = &rig.config.projector.backend;
    let (Some(port), RigCable::Serial { bytes_per_s }) = (backend.port(), backend.cable()) else {
        return Ok(Box::new(HostEnd::open(cable)?));
    };
    let frame_bytes = frame_bytes(rig.camera.raster, rig.config.projector.schedule().len());
    let settings = SerialSettings { path: port.to_owned(), baud: 10 * bytes_per_s, frame_bytes };
    Ok(Box::new(SerialTransport::open_from(settings, Box::new(SimPorts::new(cable.clone())))?))
}

/// A process that runs.
pub struct Process {
    /// The run.
    pub run: SteppedRun<SimMachine>,
    /// Its monitor.
    pub monitor: Arc<RunMonitor>,
    /// Its orders.
    pub orders: SteppedOrders,
    disk: Arc<Mutex<Disk>>,
    /// What the interlock's thread has besides its light.
    interlock: Option<(SimContact, Asking)>,
    clock: Arc<ManualClock>,
    asked_due: i64,
    orders_due: i64,
    run_due: i64,
    /// A stop was asked for.
    pub is_stopping: bool,
    /// It ends by then even if its threads hang, host's clock.
    end_by: i64,
}

impl Process {
    /// Starts the program at `now` (host's clock).
    ///
    /// # Errors
    /// It ends before there is a run.
    pub fn start(
        rig: &Arc<Rig>,
        cable: &Arc<Mutex<Cable>>,
        disk: &Arc<Mutex<Disk>>,
        machine: SimMachine,
        contact: Option<(&SimContact, Restart)>,
        now: i64,
    ) -> Result<Self, Exit> {
        let monitor = Arc::new(RunMonitor::default());
        let clock = Arc::new(ManualClock::new(HostTime(now)));
        let interlock = contact.map(|(contact, reset)| {
            let (interlock, mut asking) = Interlock::stepped("a contact", clock.clone(), contact.clone());
            asking.ask();
            monitor.set_interlock(interlock.reset_by(reset));
            (contact.clone(), asking)
        });
        let identity = Identity::of(&rig.config.projector.backend);
        let orders = SteppedOrders::begin(
            Box::new(SimFolder(disk.clone())),
            identity,
            monitor.clone(),
            rig.config.safety.start,
        )
        .map_err(Exit::ForGood)?;
        let medium = medium(rig, cable).map_err(|e| Exit::Again(e.to_string()))?;
        let run = SteppedRun::begin(rig.clone(), monitor.clone(), medium, machine, HostTime(now));
        let disk = disk.clone();
        Ok(Self {
            run,
            monitor,
            orders,
            disk,
            asked_due: if interlock.is_some() { now + ASK_NS } else { i64::MAX },
            clock,
            interlock,
            orders_due: now,
            run_due: now,
            is_stopping: false,
            end_by: i64::MAX,
        })
    }

    /// When it does something next, host's clock.
    pub fn due(&self) -> i64 {
        self.run_due.min(self.orders_due).min(self.end_by).min(self.asked_due)
    }

    /// Does what is due at `now`.
    pub fn step(&mut self, now: i64) {
        self.clock.advance_to(HostTime(now));
        if self.asked_due <= now {
            self.asked_due = now + ASK_NS;
            if let Some((_, asking)) = self.interlock.as_mut().filter(|(contact, _)| !contact.hangs()) {
                asking.ask();
            }
        }
        if self.orders_due <= now {
            let disk_ns = DISK_NS + lock(&self.disk).late_ns;
            let next = self.orders.step(HostTime(now), disk_ns);
            self.orders_due = next.map_or(now + ORDERS_NS, |at| at.0.max(now + 1));
        }
        if self.run_due <= now {
            self.run_due = self.run.step(HostTime(now)).0;
        }
    }

    /// An order waits: the thread that writes it down wakes at `now`.
    pub fn wake_orders(&mut self, now: i64) {
        self.orders_due = self.orders_due.min(now);
    }

    /// Asks it to stop.
    pub fn ask_to_stop(&mut self, now: i64) {
        self.end_by = self.end_by.min(now + STOPPED_NS);
        self.is_stopping = true;
        self.monitor.request_stop();
    }

    /// The projector, as the link knows it.
    pub fn health(&self) -> ProjectorHealth {
        self.monitor.projector()
    }

    /// True when the process ends: the run is over, or it was asked to stop and two seconds have passed.
    pub fn is_over(&self, now: i64) -> bool {
        self.run.is_over() || now >= self.end_by
    }

    /// The process ends after its run.
    pub fn exit(mut self) -> (Exit, Option<Box<SteppedEnd>>) {
        let mut end = self.run.end();
        let error = end.as_mut().and_then(|end| end.error.take());
        // A program whose threads hang is ended from outside: it forgets no order.
        if end.is_some() {
            self.orders.end(error.is_none());
        }
        let exit = match error {
            None if end.is_none() => Exit::Again("ended although threads hang".into()),
            None => Exit::InOrder,
            Some(error) => {
                let told = error.to_string();
                match Failure::from(error).kind {
                    FailureKind::BadInput | FailureKind::NoGpu => Exit::ForGood(told),
                    _ => Exit::Again(told),
                }
            }
        };
        (exit, end)
    }
}
