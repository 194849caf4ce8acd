//! The plug between a USB device model and its front ends: queues requests per endpoint, answers the standard requests, keeps halts, and
//! injects faults by endpoint and transfer number.
//!
//! One worker thread per endpoint runs that endpoint's transfers in order, so a busy bulk endpoint never delays
//! control. A transfer that the device refuses for now (NAK) waits until the model moves again, it is cancelled, or the
//! plug is pulled. Pulling is atomic: new requests are refused, queued ones fail, running ones finish, and only then is
//! the disconnect signalled.

use std::collections::{BTreeMap, VecDeque};
use std::ops::Range;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use dpm_device::time::HostTime;

use crate::usb_model::{string_descriptor, Progress, Setup, Then, UsbDeviceModel};

/// The host's clock as the front ends read it.
pub type Clock = Arc<dyn Fn() -> HostTime + Send + Sync>;

/// Nanoseconds since this call on the monotonic clock.
pub fn monotonic_clock() -> Clock {
    let start = Instant::now();
    Arc::new(move || HostTime(start.elapsed().as_nanos() as i64))
}

/// One transfer that a host requests.
pub struct Request {
    /// Identifies the transfer for [`UsbPlug::cancel`]; unique among the pending ones.
    pub id: u64,
    /// Address with the direction in bit 7; 0 for control.
    pub endpoint: u8,
    /// The setup packet of a control transfer.
    pub setup: Option<Setup>,
    /// OUT: the bytes to send. IN: its length is the requested number of bytes.
    pub buffer: Vec<u8>,
    /// Called exactly once, from a worker thread or from the call that ends the transfer.
    pub done: Box<dyn FnOnce(Completion) + Send>,
}

/// How a transfer ended.
pub struct Completion {
    /// The request's identifier.
    pub id: u64,
    /// Outcome.
    pub status: Status,
    /// Bytes moved, on every status.
    pub actual: usize,
    /// The request's buffer; for IN its first `actual` bytes are the device's.
    pub buffer: Vec<u8>,
}

/// Outcome of a transfer, with the kernel's error number for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Status {
    /// Ended by itself; `actual` may be short.
    Ok,
    /// The endpoint is halted (EPIPE).
    Stall,
    /// Damaged on the cable (EPROTO).
    BusError,
    /// The device sent too much (EOVERFLOW).
    Babble,
    /// The host cancelled it (ECONNRESET).
    Cancelled,
    /// The device is gone (ESHUTDOWN).
    Gone,
}

impl Status {
    /// 0 or the negative Linux error number that usbfs and USB/IP report.
    pub const fn errno(self) -> i32 {
        match self {
            Self::Ok => 0,
            Self::Stall => -32,
            Self::BusError => -71,
            Self::Babble => -75,
            Self::Cancelled => -104,
            Self::Gone => -108,
        }
    }
}

/// A fault of the cable or the device, for one transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Halt the endpoint (refuse the request on control) instead of serving the transfer.
    Stall,
    /// Damage the transfer.
    BusError,
    /// Answer an IN transfer with more bytes than requested.
    Babble,
    /// Refuse the transfer for this long before serving it (`i64::MAX`: until it is cancelled).
    NakNs(i64),
    /// End an IN transfer after at most this many bytes (the rest is lost); take only this many of an OUT transfer.
    Short(usize),
    /// Pull the plug after this many bytes of an OUT transfer, or before answering an IN one.
    Unplug(usize),
}

/// The plug of one device. Cloning makes another handle on the same plug; dropping the last one pulls it.
#[derive(Clone)]
pub struct UsbPlug {
    shared: Arc<PlugState>,
    _last_handle: Arc<LastHandle>,
}

/// Dropped with the last handle on a plug: pulls it, which ends the workers.
struct LastHandle(Arc<PlugState>);

impl Drop for LastHandle {
    fn drop(&mut self) {
        self.0.pull();
    }
}

struct PlugState {
    model: Arc<Mutex<dyn UsbDeviceModel>>,
    clock: Clock,
    state: Mutex<State>,
    /// Signalled on every change that a worker may wait for.
    changed: Condvar,
}

#[derive(Default)]
struct State {
    queues: BTreeMap<u8, Queue>,
    faults: Vec<(u8, u64, Fault)>,
    pulled: bool,
    signalled: bool,
    configuration: u8,
    /// Nothing moves before this instant.
    held_until: Option<HostTime>,
    /// Every transfer starts this much later.
    delay_ns: i64,
    listeners: Vec<Box<dyn FnOnce() + Send>>,
    /// Transfers that have ended but whose completion has not returned yet.
    finishing: usize,
    /// Counts steps in which bytes moved; a refused transfer is retried when it changes.
    moves: u64,
}

#[derive(Default)]
struct Queue {
    pending: VecDeque<Request>,
    running: Option<u64>,
    cancel_running: bool,
    halted: bool,
    started: u64,
}

/// How long a refused transfer waits before it tries the model again although nothing else moved (the model's own time
/// may have).
const RETRY: Duration = Duration::from_micros(500);

fn lock<T: ?Sized>(m: &Mutex<T>) -> MutexGuard<'_, T> {
    // A panicking model must not take the front ends down: its last state is still the best one.
    m.lock().unwrap_or_else(PoisonError::into_inner)
}

impl UsbPlug {
    /// Plugs `model` in. The caller may keep its own handle on the model for inspection.
    pub fn new(model: Arc<Mutex<dyn UsbDeviceModel>>, clock: Clock) -> Self {
        let shared = Arc::new(PlugState { model, clock, state: Mutex::default(), changed: Condvar::new() });
        Self { _last_handle: Arc::new(LastHandle(shared.clone())), shared }
    }

    /// Runs `f` on the model, between two steps of any transfer.
    pub fn with_model<R>(&self, f: impl FnOnce(&mut dyn UsbDeviceModel) -> R) -> R {
        f(&mut *lock(&self.shared.model))
    }

    /// Plans `fault` for the `nth` transfer (0 = the next one) on `endpoint` from now on.
    pub fn inject(&self, endpoint: u8, nth: u64, fault: Fault) {
        let mut s = lock(&self.shared.state);
        let base = s.queues.get(&endpoint).map_or(0, |q| q.started + q.pending.len() as u64);
        s.faults.push((endpoint, base + nth, fault));
    }

    /// Blocks all transfers before `until`: to the host, a busy device.
    pub fn hold_until(&self, until: HostTime) {
        lock(&self.shared.state).held_until = Some(until);
    }

    /// Delays every transfer by `ns` from now on.
    pub fn set_delay_ns(&self, ns: i64) {
        lock(&self.shared.state).delay_ns = ns;
    }

    /// Queues a transfer. Returns it if the plug is pulled, or if the system provides no thread for its endpoint.
    pub fn submit(&self, request: Request) -> Result<(), Request> {
        let mut s = lock(&self.shared.state);
        if s.pulled {
            return Err(request);
        }
        let endpoint = request.endpoint;
        if !s.queues.contains_key(&endpoint) {
            let (shared, name) = (self.shared.clone(), format!("usb-{endpoint:02x}"));
            // The thread waits for the lock that is held here.
            if std::thread::Builder::new().name(name).spawn(move || shared.work(endpoint)).is_err() {
                return Err(request);
            }
        }
        s.queues.entry(endpoint).or_default().pending.push_back(request);
        self.shared.changed.notify_all();
        Ok(())
    }

    /// Cancels a transfer. True if it had not ended: its completion, with [`Status::Cancelled`] or with its progress in
    /// the meantime, follows or has just been made.
    pub fn cancel(&self, id: u64) -> bool {
        let mut s = lock(&self.shared.state);
        let mut cancelled = None;
        for q in s.queues.values_mut() {
            if q.running == Some(id) {
                q.cancel_running = true;
                self.shared.changed.notify_all();
                return true;
            }
            if let Some(at) = q.pending.iter().position(|r| r.id == id) {
                cancelled = q.pending.remove(at);
                break;
            }
        }
        drop(s);
        match cancelled {
            Some(r) => {
                finish(r, Status::Cancelled, 0);
                true
            }
            None => false,
        }
    }

    /// Cancels every transfer of `endpoint`.
    pub fn cancel_endpoint(&self, endpoint: u8) {
        let mut s = lock(&self.shared.state);
        let Some(q) = s.queues.get_mut(&endpoint) else { return };
        q.cancel_running = q.running.is_some();
        let all: Vec<_> = q.pending.drain(..).collect();
        self.shared.changed.notify_all();
        drop(s);
        all.into_iter().for_each(|r| finish(r, Status::Cancelled, 0));
    }

    /// Ends the halt of `endpoint` as CLEAR_FEATURE does.
    pub fn clear_halt(&self, endpoint: u8) {
        if let Some(q) = lock(&self.shared.state).queues.get_mut(&endpoint) {
            q.halted = false;
        }
        lock(&self.shared.model).halt_cleared(endpoint);
    }

    /// Resets the bus: halts end, the device is unconfigured.
    pub fn reset(&self) {
        let mut s = lock(&self.shared.state);
        s.queues.values_mut().for_each(|q| q.halted = false);
        s.configuration = 0;
        drop(s);
        let mut model = lock(&self.shared.model);
        model.bus_reset((self.shared.clock)());
    }

    /// Selects a configuration as SET_CONFIGURATION does; halts end.
    pub fn set_configuration(&self, value: u8) {
        let mut s = lock(&self.shared.state);
        s.queues.values_mut().for_each(|q| q.halted = false);
        s.configuration = value;
    }

    /// The selected configuration, 0 for none.
    pub fn configuration(&self) -> u8 {
        lock(&self.shared.state).configuration
    }

    /// True until the plug is pulled.
    pub fn is_plugged(&self) -> bool {
        !lock(&self.shared.state).pulled
    }

    /// Transfers queued or running.
    pub fn in_flight(&self) -> usize {
        let s = lock(&self.shared.state);
        s.queues.values().map(|q| q.pending.len() + usize::from(q.running.is_some())).sum()
    }

    /// Calls `f` once the plug is pulled and every transfer has ended; immediately if that is already so.
    pub fn on_unplug(&self, f: Box<dyn FnOnce() + Send>) {
        let mut s = lock(&self.shared.state);
        if s.signalled {
            drop(s);
            f();
        } else {
            s.listeners.push(f);
        }
    }

    /// Pulls the plug: every transfer ends with [`Status::Gone`], then the listeners run. Plug the model in again with a new [`UsbPlug`].
    pub fn unplug(&self) {
        self.shared.pull();
    }
}

/// A device as a front end sees it: the local plug, or one at the far end of USB/IP.
pub trait UsbCable: Send + Sync {
    /// Device descriptor followed by the configuration descriptor, as sysfs shows them.
    fn descriptors(&self) -> Vec<u8>;
    /// Speed of the cable.
    fn speed(&self) -> crate::usb_model::Speed;
    /// Queues a transfer; returns it if the device is gone.
    fn submit(&self, request: Request) -> Result<(), Request>;
    /// Cancels a transfer; true if it had not ended.
    fn cancel(&self, id: u64) -> bool;
    /// Ends the halt of an endpoint.
    fn clear_halt(&self, endpoint: u8);
    /// Resets the bus and selects `configuration` again.
    fn reset(&self, configuration: u8);
    /// Selects a configuration.
    fn set_configuration(&self, value: u8);
    /// Calls `f` once when the device is gone and every transfer has ended.
    fn on_unplug(&self, f: Box<dyn FnOnce() + Send>);
    /// Pulls the plug.
    fn unplug(&self);
}

impl UsbCable for UsbPlug {
    fn descriptors(&self) -> Vec<u8> {
        self.with_model(|m| [m.device_descriptor(), m.configuration_descriptor()].concat())
    }
    fn speed(&self) -> crate::usb_model::Speed {
        self.with_model(|m| m.speed())
    }
    fn submit(&self, request: Request) -> Result<(), Request> {
        Self::submit(self, request)
    }
    fn cancel(&self, id: u64) -> bool {
        Self::cancel(self, id)
    }
    fn clear_halt(&self, endpoint: u8) {
        Self::clear_halt(self, endpoint);
    }
    fn reset(&self, configuration: u8) {
        Self::reset(self);
        Self::set_configuration(self, configuration);
    }
    fn set_configuration(&self, value: u8) {
        Self::set_configuration(self, value);
    }
    fn on_unplug(&self, f: Box<dyn FnOnce() + Send>) {
        Self::on_unplug(self, f);
    }
    fn unplug(&self) {
        Self::unplug(self);
    }
}

fn finish(request: Request, status: Status, actual: usize) {
    (request.done)(Completion { id: request.id, status, actual, buffer: request.buffer });
}

impl PlugState {
    fn pull(&self) {
        let mut s = lock(&self.state);
        s.pulled = true;
        let all: Vec<_> = s.queues.values_mut().flat_map(|q| q.pending.drain(..)).collect();
        s.finishing += all.len();
        self.changed.notify_all();
        drop(s);
        for r in all {
            finish(r, Status::Gone, 0);
            lock(&self.state).finishing -= 1;
        }
        self.signal_when_quiet();
    }

    fn signal_when_quiet(&self) {
        let mut s = lock(&self.state);
        if !s.pulled || s.signalled || s.finishing > 0 || s.queues.values().any(|q| q.running.is_some()) {
            return;
        }
        s.signalled = true;
        let listeners = std::mem::take(&mut s.listeners);
        drop(s);
        listeners.into_iter().for_each(|f| f());
    }

    /// The worker's loop: runs the transfers of one endpoint in order until the plug is pulled.
    fn work(self: Arc<Self>, endpoint: u8) {
        loop {
            let mut s = lock(&self.state);
            let (mut request, fault, halted) = loop {
                if s.pulled {
                    return;
                }
                let State { queues, faults, .. } = &mut *s;
                let q = queues.entry(endpoint).or_default();
                if let Some(r) = q.pending.pop_front() {
                    let n = q.started;
                    q.started += 1;
                    q.running = Some(r.id);
                    q.cancel_running = false;
                    let at = faults.iter().position(|f| f.0 == endpoint && f.1 == n);
                    break (r, at.map(|i| faults.swap_remove(i).2), q.halted);
                }
                s = self.changed.wait(s).unwrap_or_else(PoisonError::into_inner);
            };
            drop(s);
            let (status, actual) =
                if halted { (Status::Stall, 0) } else { self.run(endpoint, &mut request, fault) };
            let mut s = lock(&self.state);
            if let Some(q) = s.queues.get_mut(&endpoint) {
                q.running = None;
                q.halted |= status == Status::Stall && endpoint != 0;
            }
            s.moves += 1;
            s.finishing += 1;
            self.changed.notify_all();
            drop(s);
            finish(request, status, actual);
            lock(&self.state).finishing -= 1;
            self.signal_when_quiet();
        }
    }

    /// Runs one transfer to its end.
    fn run(&self, endpoint: u8, r: &mut Request, fault: Option<Fault>) -> (Status, usize) {
        let is_in = r.setup.map_or(endpoint & 0x80 != 0, |s| s.is_in());
        let mut limit = r.buffer.len();
        let mut refuse_until = None;
        match fault {
            Some(Fault::Stall) => return (Status::Stall, 0),
            Some(Fault::BusError) => return (Status::BusError, 0),
            Some(Fault::Babble) => return (Status::Babble, r.buffer.len()),
            Some(Fault::NakNs(ns)) => refuse_until = Some((self.clock)().plus_ns(ns)),
            Some(Fault::Short(n)) if !is_in => limit = limit.min(n),
            Some(Fault::Unplug(n)) => limit = if is_in { 0 } else { limit.min(n) },
            _ => {}
        }
        let delay_ns = lock(&self.state).delay_ns;
        if delay_ns > 0 {
            let start = (self.clock)().plus_ns(delay_ns);
            refuse_until = refuse_until.max(Some(start));
        }
        let mut moved = 0;
        loop {
            let now = (self.clock)();
            let skip = matches!(fault, Some(Fault::Unplug(_))) && limit == 0;
            let (seen, refused) = {
                let s = lock(&self.state);
                let cancelled = s.queues.get(&endpoint).is_some_and(|q| q.cancel_running);
                if cancelled || s.pulled {
                    return (if cancelled { Status::Cancelled } else { Status::Gone }, moved);
                }
                (s.moves, refuse_until.max(s.held_until).is_some_and(|t| now < t))
            };
            let step = match (skip, refused) {
                (true, _) => Progress { bytes: 0, then: Then::Complete },
                (_, true) => Progress { bytes: 0, then: Then::Nak },
                _ => self.transfer(endpoint, is_in, r, moved..limit),
            };
            // If a model claims more than it was given, the claim is limited: the host never sees unwritten bytes.
            moved = (moved + step.bytes).min(r.buffer.len());
            if step.bytes > 0 {
                lock(&self.state).moves += 1;
                self.changed.notify_all();
            }
            let status = match step.then {
                Then::Complete => Status::Ok,
                Then::Stall => Status::Stall,
                Then::BusError => Status::BusError,
                Then::Babble => Status::Babble,
                Then::Disconnect => {
                    self.pull();
                    Status::Gone
                }
                Then::Nak => {
                    let mut s = lock(&self.state);
                    if s.moves == seen + u64::from(step.bytes > 0) {
                        let waited = self.changed.wait_timeout(s, RETRY);
                        s = waited.unwrap_or_else(PoisonError::into_inner).0;
                    }
                    drop(s);
                    continue;
                }
            };
            return match fault {
                Some(Fault::Unplug(_)) => {
                    self.pull();
                    (Status::Gone, moved)
                }
                Some(Fault::Short(n)) if is_in => (status, moved.min(n)),
                _ => (status, moved),
            };
        }
    }

    /// Has the model take what is sent of `part` of a request's bytes, or fill them.
    fn transfer(&self, endpoint: u8, is_in: bool, r: &mut Request, part: Range<usize>) -> Progress {
        if let Some(setup) = r.setup {
            return self.control(&setup, &mut r.buffer);
        }
        let mut model = lock(&self.model);
        // The clock is read behind the lock: the model may have been busy with another endpoint's transfer, and its stamps
        // must not be older.
        let now = (self.clock)();
        if is_in {
            model.transfer_in(now, endpoint, &mut r.buffer[part.start..])
        } else {
            model.transfer_out(now, endpoint, &r.buffer[part])
        }
    }

    /// A control transfer: standard requests are handled here, the others by the model.
    fn control(&self, setup: &Setup, data: &mut [u8]) -> Progress {
        if !setup.is_standard() {
            let mut model = lock(&self.model);
            return model.control((self.clock)(), setup, data);
        }
        let mut give = |bytes: &[u8]| {
            let n = bytes.len().min(data.len());
            data[..n].copy_from_slice(&bytes[..n]);
            Progress::complete(n)
        };
        let recipient = setup.request_type & 0x1f;
        match (setup.request_type, setup.request) {
            // GET_DESCRIPTOR, of the device or of an interface (HID report).
            (0x80 | 0x81, 6) => {
                let model = lock(&self.model);
                let (kind, index) = ((setup.value >> 8) as u8, setup.value as u8);
                match kind {
                    1 => give(model.device_descriptor()),
                    2 if index == 0 => give(model.configuration_descriptor()),
                    3 if index == 0 => give(&[4, 3, 0x09, 0x04]),
                    3 => match model.string(index) {
                        Some(text) => give(&string_descriptor(text)),
                        None => Progress::stall(0),
                    },
                    _ => match model.other_descriptor(kind, index, setup.index) {
                        Some(bytes) => give(bytes),
                        None => Progress::stall(0),
                    },
                }
            }
            // GET_STATUS: bus powered, no remote wake-up; an endpoint says whether it is halted.
            (0x80..=0x82, 0) => {
                let endpoint = setup.index as u8;
                let halted =
                    recipient == 2 && lock(&self.state).queues.get(&endpoint).is_some_and(|q| q.halted);
                give(&[u8::from(halted), 0])
            }
            // CLEAR_FEATURE and SET_FEATURE(ENDPOINT_HALT).
            (0x02, 1 | 3) if setup.value == 0 => {
                let endpoint = setup.index as u8;
                let halt = setup.request == 3 && endpoint & 0x7f != 0;
                if let Some(q) = lock(&self.state).queues.get_mut(&endpoint) {
                    q.halted = halt;
                }
                if !halt {
                    lock(&self.model).halt_cleared(endpoint);
                }
                Progress::complete(0)
            }
            // Features of the device and interface (remote wake-up, U1/U2), SET_ADDRESS, SET_SEL, SET_ISOCH_DELAY, SET_INTERFACE 0.
            (0x00 | 0x01, 1 | 3) | (0x00, 5 | 0x31) => Progress::complete(0),
            (0x00, 0x30) => Progress::complete(data.len()),
            (0x01, 11) if setup.value == 0 => Progress::complete(0),
            (0x81, 10) => give(&[0]),
            (0x80, 8) => give(&[lock(&self.state).configuration]),
            (0x00, 9) => {
                let value = setup.value as u8;
                let known = lock(&self.model).configuration_descriptor().get(5) == Some(&value) || value == 0;
                if !known {
                    return Progress::stall(0);
                }
                let mut s = lock(&self.state);
                s.configuration = value;
                s.queues.values_mut().for_each(|q| q.halted = false);
                Progress::complete(0)
            }
            _ => Progress::stall(0),
        }
    }
}

#[cfg(test)]
#[path = "usb_plug_tests.rs"]
mod tests;
