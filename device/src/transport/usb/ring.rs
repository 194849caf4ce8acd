//! Queued bulk transfers of one endpoint: the only place that calls libusb's asynchronous functions, which rusb does
//! not wrap.
//!
//! **Ownership.** A [`Ring`] owns its transfers, their buffers and their completion flags, and keeps the device handle
//! alive. From `libusb_submit_transfer` until the flag is raised, transfer and buffer belong to libusb and the kernel,
//! and nothing here touches them. The callback raises the flag. libusb runs it exactly once per submitted transfer, on
//! the thread that handles events ([`pump`], or the thread of `events`). Afterwards transfer and buffer belong to the
//! ring again. When a ring is dropped, it first cancels its transfers. If the kernel does not return one in time, its
//! memory is leaked, because the kernel may still write to it.
#![allow(unsafe_code)]

use std::collections::VecDeque;
use std::ffi::c_void;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use dpm_handoff::path::{within, Place};
use rusb::constants as c;
use rusb::ffi;
use rusb::{Context, DeviceHandle, UsbContext};

use crate::time::{HostClock, HostTime};

/// Longest wait for the kernel to return cancelled transfers when a ring is dropped.
const TAKE_BACK: Duration = Duration::from_secs(2);

/// How a transfer ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Status {
    /// By itself; perhaps short.
    Completed,
    /// Cancelled.
    Cancelled,
    /// The endpoint is halted.
    Stall,
    /// The device is gone.
    NoDevice,
    /// The device sent more than requested.
    Overflow,
    /// Anything else: damaged on the cable, timed out.
    Error,
}

/// A transfer that ended, in the order of submission.
#[derive(Clone, Copy, Debug)]
pub(super) struct TransferEnd {
    pub slot: usize,
    pub status: Status,
    /// Bytes moved, on every status.
    pub actual: usize,
    /// When it ended; `None` without a clock.
    pub at: Option<HostTime>,
}

/// The transport's clock, once it was set.
pub(super) type SharedClock = Arc<OnceLock<Arc<dyn HostClock>>>;

/// The callback's record of a transfer.
struct Mark {
    ended: AtomicBool,
    /// When; [`NO_TIME`] without a clock. Written before the flag is raised.
    at: AtomicI64,
    clock: SharedClock,
}

const NO_TIME: i64 = i64::MIN;

struct Slot {
    transfer: *mut ffi::libusb_transfer,
    buffer: Box<[u8]>,
    /// Written by the callback. Boxed, because its address must not move while a transfer is in flight.
    mark: Box<Mark>,
    in_flight: bool,
}

/// The transfers of one endpoint.
pub(super) struct Ring {
    handle: Arc<DeviceHandle<Context>>,
    endpoint: u8,
    slots: Vec<Slot>,
    /// Slots in flight, oldest first. Never grows beyond the number of slots.
    order: VecDeque<usize>,
}

// SAFETY: the raw pointers are owned by the ring and used only through `&mut self`; libusb allows its functions to be called from any
// thread, and the callback touches nothing but a `Mark`, whose parts may be shared between threads.
unsafe impl Send for Ring {}

extern "system" fn on_ended(transfer: *mut ffi::libusb_transfer) {
    // SAFETY: libusb passes the transfer that was submitted; its `user_data` points to the mark of its slot, which lives until
    // the slot is dropped, and a slot is dropped only after this call or is leaked.
    let mark = unsafe { &*((*transfer).user_data as *const Mark) };
    if let Some(clock) = mark.clock.get() {
        mark.at.store(clock.now().0, Ordering::Relaxed);
    }
    mark.ended.store(true, Ordering::Release);
}

/// Lets libusb deliver completed transfers. Does not block.
pub(super) fn pump(context: &Context) -> Result<(), rusb::Error> {
    let none = libc::timeval { tv_sec: 0, tv_usec: 0 };
    // SAFETY: the context is alive for the borrow; libusb reads `none` only during the call; a null `completed` is allowed.
    let rc = within(Place::Libusb, || unsafe {
        ffi::libusb_handle_events_timeout_completed(context.as_raw(), &none, std::ptr::null_mut())
    });
    result(rc)
}

/// Converts a return code of libusb to rusb's error; `Interrupted` is not an error here, because nothing was waited
/// for.
fn result(rc: i32) -> Result<(), rusb::Error> {
    Err(match rc {
        0 | c::LIBUSB_ERROR_INTERRUPTED => return Ok(()),
        c::LIBUSB_ERROR_IO => rusb::Error::Io,
        c::LIBUSB_ERROR_INVALID_PARAM => rusb::Error::InvalidParam,
        c::LIBUSB_ERROR_ACCESS => rusb::Error::Access,
        c::LIBUSB_ERROR_NO_DEVICE => rusb::Error::NoDevice,
        c::LIBUSB_ERROR_NOT_FOUND => rusb::Error::NotFound,
        c::LIBUSB_ERROR_BUSY => rusb::Error::Busy,
        c::LIBUSB_ERROR_TIMEOUT => rusb::Error::Timeout,
        c::LIBUSB_ERROR_OVERFLOW => rusb::Error::Overflow,
        c::LIBUSB_ERROR_PIPE => rusb::Error::Pipe,
        c::LIBUSB_ERROR_NO_MEM => rusb::Error::NoMem,
        c::LIBUSB_ERROR_NOT_SUPPORTED => rusb::Error::NotSupported,
        _ => rusb::Error::Other,
    })
}

impl Ring {
    /// `count` transfers of up to `bytes` on `endpoint` (bit 7 set: IN). All memory is allocated here.
    pub(super) fn new(
        handle: Arc<DeviceHandle<Context>>,
        endpoint: u8,
        count: usize,
        bytes: usize,
        clock: &SharedClock,
    ) -> Result<Self, rusb::Error> {
        let mut ring = Self {
            handle,
            endpoint,
            slots: Vec::with_capacity(count),
            order: VecDeque::with_capacity(count),
        };
        for _ in 0..count {
            // SAFETY: no isochronous packets; the pointer is checked, and freed exactly once, in `drop`.
            let transfer = unsafe { ffi::libusb_alloc_transfer(0) };
            if transfer.is_null() {
                return Err(rusb::Error::NoMem);
            }
            ring.slots.push(Slot {
                transfer,
                buffer: vec![0; bytes].into_boxed_slice(),
                mark: Box::new(Mark {
                    ended: AtomicBool::new(false),
                    at: AtomicI64::new(NO_TIME),
                    clock: clock.clone(),
                }),
                in_flight: false,
            });
        }
        Ok(ring)
    }

    /// Slots that are not in flight.
    pub(super) fn idle_slots(&self) -> usize {
        self.slots.len() - self.order.len()
    }

    /// A slot that is not in flight.
    pub(super) fn idle_slot(&self) -> Option<usize> {
        self.slots.iter().position(|s| !s.in_flight)
    }

    /// The buffer of a slot.
    ///
    /// # Panics
    /// When the slot is in flight: its buffer belongs to the kernel.
    pub(super) fn buffer(&mut self, slot: usize) -> &mut [u8] {
        assert!(!self.slots[slot].in_flight, "slot {slot} is in flight");
        &mut self.slots[slot].buffer
    }

    /// Hands the first `len` bytes of a slot's buffer to the kernel.
    ///
    /// # Panics
    /// When the slot is in flight or its buffer shorter.
    pub(super) fn submit(&mut self, slot: usize, len: usize) -> Result<(), rusb::Error> {
        let s = &mut self.slots[slot];
        assert!(!s.in_flight && len <= s.buffer.len(), "slot {slot}: in flight, or {len} bytes too many");
        s.mark.at.store(NO_TIME, Ordering::Relaxed);
        s.mark.ended.store(false, Ordering::Relaxed);
        // SAFETY: transfer and buffer belong to this ring (not in flight); the buffer holds `len` bytes; both and the mark stay where
        // they are until the callback has run, see the module's documentation. A timeout of 0 means none.
        let rc = within(Place::Libusb, || unsafe {
            ffi::libusb_fill_bulk_transfer(
                s.transfer,
                self.handle.as_raw(),
                self.endpoint,
                s.buffer.as_mut_ptr(),
                len as i32,
                on_ended,
                std::ptr::from_ref::<Mark>(&s.mark) as *mut c_void,
                0,
            );
            ffi::libusb_submit_transfer(s.transfer)
        });
        result(rc)?;
        s.in_flight = true;
        self.order.push_back(slot);
        Ok(())
    }

    /// The oldest transfer, if it has ended. Its slot is idle from here on.
    pub(super) fn take_ended(&mut self) -> Option<TransferEnd> {
        let slot = *self.order.front()?;
        let s = &mut self.slots[slot];
        if !s.mark.ended.load(Ordering::Acquire) {
            return None;
        }
        self.order.pop_front();
        s.in_flight = false;
        // SAFETY: the callback has run, so the transfer belongs to the ring again.
        let (status, actual) = unsafe { ((*s.transfer).status, (*s.transfer).actual_length) };
        let status = match status {
            c::LIBUSB_TRANSFER_COMPLETED => Status::Completed,
            c::LIBUSB_TRANSFER_CANCELLED => Status::Cancelled,
            c::LIBUSB_TRANSFER_STALL => Status::Stall,
            c::LIBUSB_TRANSFER_NO_DEVICE => Status::NoDevice,
            c::LIBUSB_TRANSFER_OVERFLOW => Status::Overflow,
            _ => Status::Error,
        };
        let at = match s.mark.at.load(Ordering::Relaxed) {
            NO_TIME => None,
            ns => Some(HostTime(ns)),
        };
        // Limited to the buffer, whatever a device or a driver claims.
        Some(TransferEnd { slot, status, actual: (actual.max(0) as usize).min(s.buffer.len()), at })
    }

    /// Cancels every transfer in flight. They end later, through [`Ring::take_ended`].
    pub(super) fn cancel_all(&mut self) {
        for &slot in &self.order {
            let s = &self.slots[slot];
            if !s.mark.ended.load(Ordering::Acquire) {
                // SAFETY: the transfer was submitted and its callback has not been seen to run. If it ends in the
                // meantime, libusb answers NOT_FOUND, which is harmless.
                within(Place::Libusb, || unsafe { ffi::libusb_cancel_transfer(s.transfer) });
            }
        }
    }

    /// Transfers in flight.
    pub(super) fn in_flight(&self) -> usize {
        self.order.len()
    }
}

impl Drop for Ring {
    fn drop(&mut self) {
        self.cancel_all();
        let deadline = Instant::now() + TAKE_BACK;
        while self.in_flight() > 0 && Instant::now() < deadline {
            while self.take_ended().is_some() {}
            if self.in_flight() > 0 {
                let _ = pump(self.handle.context());
                std::thread::sleep(Duration::from_micros(200));
            }
        }
        for mut s in self.slots.drain(..) {
            if s.in_flight {
                std::mem::forget(std::mem::take(&mut s.buffer));
                std::mem::forget(s.mark);
            } else {
                // SAFETY: allocated by `libusb_alloc_transfer`, not in flight, freed once.
                unsafe { ffi::libusb_free_transfer(s.transfer) };
            }
        }
    }
}
