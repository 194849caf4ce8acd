//! An open device file: turns the usbfs ioctls into transfers of the device's cable and reaps what has ended.
//!
//! The descriptor that libusb holds is the write end of a one-page pipe. Full means "nothing to reap", empty means "ready"
//! (POLLOUT), a closed read end means "disconnected" (POLLERR): so `poll` needs no help.
#![allow(unsafe_code)]

use std::collections::{BTreeMap, VecDeque};
use std::ffi::{c_int, c_uint, c_void};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{mpsc, Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use hil_mock::usb_model::{endpoints, Setup};
use hil_mock::usb_plug::{Completion, Request, Status};

use crate::bus::{lock, release, reserve, Device, Holder};
use crate::hooks::raw;

/// `struct usbdevfs_urb` of the kernel's `usbdevice_fs.h`.
#[repr(C)]
struct Urb {
    kind: u8,
    endpoint: u8,
    status: c_int,
    flags: c_uint,
    buffer: *mut u8,
    buffer_length: c_int,
    actual_length: c_int,
    start_frame: c_int,
    packets_or_stream: c_int,
    error_count: c_int,
    signal: c_uint,
    user_context: *mut c_void,
}

/// `struct usbdevfs_ctrltransfer`.
#[repr(C)]
struct ControlTransfer {
    setup: [u8; 8],
    timeout_ms: u32,
    data: *mut u8,
}

/// `struct usbdevfs_getdriver`; `usbdevfs_disconnect_claim` differs by `flags` before the name.
const DRIVER_NAME: usize = 256;

const KIND_CONTROL: u8 = 2;
const KIND_ISO: u8 = 0;
const FLAG_SHORT_NOT_OK: c_uint = 0x01;
const FLAG_ZERO_PACKET: c_uint = 0x40;
/// ZERO_PACKET, NO_PACKET_SIZE_LIM, BULK_SCATTER_GATHER, REAP_AFTER_DISCONNECT.
const CAPABILITIES: u32 = 0x01 | 0x04 | 0x08 | 0x10;
const PIPE_BYTES: usize = 4096;
/// Most bytes of one transfer, as in the kernel (usbfs refuses more than INT_MAX / 2 outright).
const MOST_BYTES: usize = 0x3fff_ffff;

/// An open device file.
pub(crate) struct OpenFile {
    device: Arc<Device>,
    id: u64,
    write_end: c_int,
    inner: Mutex<Inner>,
    ended: Condvar,
}

struct Inner {
    /// Transfers in flight: address of the caller's URB to the transfer's name and reserved bytes.
    running: BTreeMap<usize, (u64, usize)>,
    done: VecDeque<usize>,
    read_end: c_int,
}

static NEXT_ID: AtomicU64 = AtomicU64::new(1);

impl OpenFile {
    pub(crate) fn open(device: Arc<Device>) -> Result<Arc<Self>, i32> {
        let mut ends = [0; 2];
        // SAFETY: `ends` has room for the two descriptors.
        if unsafe { libc::pipe2(ends.as_mut_ptr(), libc::O_CLOEXEC | libc::O_NONBLOCK) } != 0 {
            return Err(libc::EMFILE);
        }
        // SAFETY: a plain fcntl on a descriptor just made.
        unsafe { libc::fcntl(ends[1], libc::F_SETPIPE_SZ, PIPE_BYTES as c_int) };
        let inner = Inner { running: BTreeMap::new(), done: VecDeque::new(), read_end: ends[0] };
        let file = Self {
            device,
            id: NEXT_ID.fetch_add(1, Ordering::Relaxed),
            write_end: ends[1],
            inner: Mutex::new(inner),
            ended: Condvar::new(),
        };
        file.set_ready(&lock(&file.inner), false);
        Ok(Arc::new(file))
    }

    pub(crate) fn fd(&self) -> c_int {
        self.write_end
    }

    pub(crate) fn id(&self) -> u64 {
        self.id
    }

    /// Empties (ready) or fills (not ready) the pipe.
    fn set_ready(&self, inner: &Inner, ready: bool) {
        let mut page = [0u8; PIPE_BYTES];
        if inner.read_end < 0 {
            return;
        }
        // SAFETY: both ends are ours and non-blocking, the buffer is as long as said.
        unsafe {
            if ready {
                while libc::read(inner.read_end, page.as_mut_ptr().cast(), PIPE_BYTES) > 0 {}
            } else {
                while libc::write(self.write_end, page.as_ptr().cast(), PIPE_BYTES) > 0 {}
            }
        }
    }

    /// The device is gone: `poll` reports an error from now on.
    pub(crate) fn disconnect(&self) {
        let mut inner = lock(&self.inner);
        if inner.read_end >= 0 {
            raw::close(inner.read_end);
            inner.read_end = -1;
        }
    }

    /// Takes every transfer back and waits until none can touch the caller's memory any more.
    pub(crate) fn close(&self) {
        let mut inner = lock(&self.inner);
        let running: Vec<_> = inner.running.values().map(|v| v.0).collect();
        drop(inner);
        running.into_iter().for_each(|id| {
            self.device.cable.cancel(id);
        });
        inner = lock(&self.inner);
        while !inner.running.is_empty() {
            inner = self.ended.wait(inner).unwrap_or_else(PoisonError::into_inner);
        }
        drop(inner);
        self.disconnect();
        self.device.forget(self.id);
    }

    /// Serves one ioctl: the result, or the error number.
    ///
    /// # Safety
    /// `argument` is what the kernel's usbfs demands for `number`: libusb's side of the contract.
    pub(crate) unsafe fn ioctl(self: &Arc<Self>, number: u8, argument: *mut c_void) -> Result<c_int, c_int> {
        let gone = lock(&self.device.state).gone;
        if gone && number != 13 {
            return Err(libc::ENODEV);
        }
        // SAFETY: the caller vouches for `argument`; each arm reads only the structure of its ioctl.
        unsafe {
            match number {
                0 => self.control(&mut *argument.cast()),
                4 => Ok(0),
                5 => self.set_configuration(*argument.cast::<u32>()),
                8 => self.get_driver(argument.cast()),
                10 => self.submit(argument.cast()),
                11 => self.discard(argument as usize),
                13 => self.reap(argument.cast()),
                15 => self.claim(*argument.cast::<u32>()),
                16 => self.release(*argument.cast::<u32>()),
                17 => {
                    *argument.cast::<u32>() = u32::from(self.device.address);
                    Ok(0)
                }
                18 => {
                    let words = argument.cast::<c_int>();
                    self.driver_ioctl(*words as u32, *words.add(1) as u8)
                }
                20 => {
                    self.device.cable.reset(lock(&self.device.state).configuration);
                    Ok(0)
                }
                21 => {
                    self.device.cable.clear_halt(*argument.cast::<u32>() as u8);
                    Ok(0)
                }
                26 => {
                    *argument.cast::<u32>() = CAPABILITIES;
                    Ok(0)
                }
                27 => {
                    let words = argument.cast::<u32>();
                    self.disconnect_claim(*words, *words.add(1), words.add(2).cast())
                }
                31 => Ok(self.device.cable.speed() as c_int),
                _ => Err(libc::ENOTTY),
            }
        }
    }

    fn interface_exists(&self, interface: u32) -> bool {
        let d = &self.device.descriptors;
        (interface as usize) < hil_mock::usb_model::interfaces(&d[18.min(d.len())..]).len()
    }

    fn claim(&self, interface: u32) -> Result<c_int, c_int> {
        if !self.interface_exists(interface) {
            return Err(libc::ENOENT);
        }
        let mine = Holder::File(self.id);
        let mut state = lock(&self.device.state);
        if *state.holders.entry(interface).or_insert_with(|| mine.clone()) == mine {
            Ok(0)
        } else {
            Err(libc::EBUSY)
        }
    }

    fn release(&self, interface: u32) -> Result<c_int, c_int> {
        let mut state = lock(&self.device.state);
        if state.holders.get(&interface) != Some(&Holder::File(self.id)) {
            return Err(libc::EINVAL);
        }
        state.holders.remove(&interface);
        Ok(0)
    }

    unsafe fn get_driver(&self, argument: *mut u8) -> Result<c_int, c_int> {
        // SAFETY: `struct usbdevfs_getdriver` is an unsigned int followed by 256 characters.
        let interface = unsafe { *argument.cast::<u32>() };
        let name = match lock(&self.device.state).holders.get(&interface) {
            Some(Holder::Kernel(name)) => name.clone(),
            Some(Holder::File(_)) => "usbfs".to_owned(),
            None => return Err(libc::ENODATA),
        };
        let n = name.len().min(DRIVER_NAME - 1);
        // SAFETY: as above; the name and its terminator fit in 256 characters.
        unsafe {
            std::ptr::copy_nonoverlapping(name.as_ptr(), argument.add(4), n);
            *argument.add(4 + n) = 0;
        }
        Ok(0)
    }

    /// USBDEVFS_IOCTL with DISCONNECT (22) or CONNECT (23).
    fn driver_ioctl(&self, interface: u32, code: u8) -> Result<c_int, c_int> {
        let mut state = lock(&self.device.state);
        match (code, state.holders.get(&interface)) {
            (22, Some(Holder::Kernel(_))) => {
                state.holders.remove(&interface);
                Ok(0)
            }
            (22, _) => Err(libc::ENODATA),
            (23, None) => Ok(0),
            (23, Some(_)) => Err(libc::EBUSY),
            _ => Err(libc::ENOTTY),
        }
    }

    unsafe fn disconnect_claim(&self, interface: u32, flags: u32, name: *const u8) -> Result<c_int, c_int> {
        let mut state = lock(&self.device.state);
        if let Some(Holder::Kernel(driver)) = state.holders.get(&interface) {
            // SAFETY: the structure ends in 256 characters.
            let bytes = unsafe { std::slice::from_raw_parts(name, DRIVER_NAME) };
            let named = bytes.split(|b| *b == 0).next() == Some(driver.as_bytes());
            if (flags & 1 != 0 && !named) || (flags & 2 != 0 && named) {
                return Err(libc::EBUSY);
            }
            state.holders.remove(&interface);
        }
        drop(state);
        self.claim(interface)
    }

    fn set_configuration(&self, value: u32) -> Result<c_int, c_int> {
        // The kernel refuses while anything is bound, even to select the same configuration again.
        if !lock(&self.device.state).holders.is_empty() {
            return Err(libc::EBUSY);
        }
        let known = self.device.descriptors.get(18 + 5).is_some_and(|v| u32::from(*v) == value);
        let off = value == u32::MAX || value == 0;
        if !known && !off {
            return Err(libc::EINVAL);
        }
        let value = if off { 0 } else { value as u8 };
        self.device.cable.set_configuration(value);
        self.device.note_configuration(value);
        Ok(0)
    }

    /// USBDEVFS_CONTROL: waits for the transfer.
    unsafe fn control(&self, c: &mut ControlTransfer) -> Result<c_int, c_int> {
        let setup = Setup::from_bytes(c.setup);
        let length = usize::from(setup.length);
        let mut buffer = vec![0; length];
        if !setup.is_in() && length > 0 {
            // SAFETY: the caller's buffer has wLength bytes.
            unsafe { std::ptr::copy_nonoverlapping(c.data, buffer.as_mut_ptr(), length) };
        }
        let (tx, rx) = mpsc::channel();
        let id = NEXT_ID.fetch_add(1, Ordering::Relaxed);
        let done = Box::new(move |c: Completion| drop(tx.send(c)));
        let request = Request { id, endpoint: 0, setup: Some(setup), buffer, done };
        self.device.cable.submit(request).map_err(|_| libc::ENODEV)?;
        let wait = if c.timeout_ms == 0 { 3_600_000 } else { c.timeout_ms };
        let result = rx.recv_timeout(Duration::from_millis(u64::from(wait))).or_else(|_| {
            self.device.cable.cancel(id);
            rx.recv()
        });
        let ended = result.map_err(|_| libc::ENODEV)?;
        match ended.status {
            Status::Ok => {}
            Status::Cancelled => return Err(libc::ETIMEDOUT),
            other => return Err(-other.errno()),
        }
        if setup.is_in() {
            // SAFETY: the caller's buffer has wLength bytes and `actual` is no more.
            unsafe { std::ptr::copy_nonoverlapping(ended.buffer.as_ptr(), c.data, ended.actual.min(length)) };
        }
        Ok(ended.actual as c_int)
    }

    unsafe fn submit(self: &Arc<Self>, urb: *mut Urb) -> Result<c_int, c_int> {
        // SAFETY: the caller passes a `struct usbdevfs_urb` that stays valid until it is reaped or the file is closed.
        let u = unsafe { &mut *urb };
        let length = usize::try_from(u.buffer_length).map_err(|_| libc::EINVAL)?;
        if u.kind == KIND_ISO || length > MOST_BYTES || (u.buffer.is_null() && length > 0) {
            return Err(libc::EINVAL);
        }
        // SAFETY: the caller's buffer has `buffer_length` bytes.
        let given =
            if length == 0 { &[][..] } else { unsafe { std::slice::from_raw_parts(u.buffer, length) } };
        let (setup, endpoint, head) = if u.kind == KIND_CONTROL {
            let head = given.first_chunk::<8>().ok_or(libc::EINVAL)?;
            let setup = Setup::from_bytes(*head);
            if usize::from(setup.length) + 8 > length {
                return Err(libc::EINVAL);
            }
            (Some(setup), 0, 8)
        } else {
            (None, u.endpoint, 0)
        };
        let d = &self.device.descriptors;
        let known = endpoints(&d[18.min(d.len())..]).into_iter().find(|e| e.0 == endpoint);
        if setup.is_none() && known.is_none() {
            return Err(libc::ENOENT);
        }
        let payload = setup.map_or(length, |s| usize::from(s.length));
        if !reserve(payload) {
            return Err(libc::ENOMEM);
        }
        let is_in = setup.map_or(endpoint & 0x80 != 0, |s| s.is_in());
        let buffer = if is_in { vec![0; payload] } else { given[head..head + payload].to_vec() };
        let id = NEXT_ID.fetch_add(1, Ordering::Relaxed);
        let (file, address) = (self.clone(), urb as usize);
        let short_is_error = is_in && u.flags & FLAG_SHORT_NOT_OK != 0;
        let done =
            Box::new(move |c: Completion| file.completed(address, c, is_in.then_some(head), short_is_error));
        let mut inner = lock(&self.inner);
        inner.running.insert(address, (id, payload));
        drop(inner);
        if self.device.cable.submit(Request { id, endpoint, setup, buffer, done }).is_err() {
            lock(&self.inner).running.remove(&address);
            release(payload);
            return Err(libc::ENODEV);
        }
        let packet = known.map_or(0, |e| usize::from(e.2));
        if u.flags & FLAG_ZERO_PACKET != 0 && !is_in && payload > 0 && packet > 0 && payload % packet == 0 {
            let id = NEXT_ID.fetch_add(1, Ordering::Relaxed);
            let zero = Request { id, endpoint, setup: None, buffer: Vec::new(), done: Box::new(|_| ()) };
            // Refused only when the device has gone, which the transfer before it reports.
            let _ = self.device.cable.submit(zero);
        }
        Ok(0)
    }

    /// Writes a transfer's outcome into the caller's URB and makes it reapable.
    fn completed(&self, address: usize, c: Completion, copy_at: Option<usize>, short_is_error: bool) {
        let urb = address as *mut Urb;
        let mut inner = lock(&self.inner);
        // SAFETY: the URB and its buffer are the caller's until reaped or closed, and `close` waits until `running` is empty.
        unsafe {
            (*urb).actual_length = c.actual as c_int;
            (*urb).status = match c.status {
                Status::Ok if short_is_error && c.actual < c.buffer.len() => -libc::EREMOTEIO,
                Status::Cancelled => -libc::ENOENT,
                other => other.errno(),
            };
            if let Some(at) = copy_at {
                let n = c.actual.min(c.buffer.len());
                std::ptr::copy_nonoverlapping(c.buffer.as_ptr(), (*urb).buffer.add(at), n);
            }
        }
        if let Some((_, bytes)) = inner.running.remove(&address) {
            release(bytes);
        }
        inner.done.push_back(address);
        self.set_ready(&inner, true);
        self.ended.notify_all();
    }

    fn discard(&self, address: usize) -> Result<c_int, c_int> {
        let id = lock(&self.inner).running.get(&address).map(|v| v.0).ok_or(libc::EINVAL)?;
        if self.device.cable.cancel(id) {
            Ok(0)
        } else {
            Err(libc::EINVAL)
        }
    }

    unsafe fn reap(&self, out: *mut *mut c_void) -> Result<c_int, c_int> {
        let gone = lock(&self.device.state).gone;
        let mut inner = lock(&self.inner);
        let Some(address) = inner.done.pop_front() else {
            return Err(if gone { libc::ENODEV } else { libc::EAGAIN });
        };
        if inner.done.is_empty() {
            self.set_ready(&inner, false);
        }
        // SAFETY: REAPURBNDELAY takes a pointer to a pointer.
        unsafe { *out = address as *mut c_void };
        Ok(0)
    }
}
