//! Carries packets in queued USB bulk transfers: several frames in flight, one transfer per frame, and nothing ever
//! blocks.
//!
//! `send` and `receive` submit transfers and take completed ones. A separate thread lets libusb deliver completions, so
//! that replies are stamped when they arrive. An order to go dark overtakes everything else: the control lane has its
//! own endpoint, and one of its transfers is reserved for such an order. When an endpoint fails, its transfers are
//! cancelled, then its halt is cleared, then only the newest frame is sent again from its start. If an endpoint fails
//! three times within a second, the device is reset.

mod events;
mod open;
mod ring;

use std::sync::{Arc, OnceLock};

use dpm_handoff::path::{within, Place};
use rusb::{Context, DeviceHandle};

use super::{Lane, SendError, Transport, TransportError};
use crate::packet::Packet;
use crate::time::{HostClock, HostTime};
use events::Events;
pub use open::{memory_limit_mb, UsbSettings, UDEV_RULE};
use ring::{pump, Ring, SharedClock, Status};

/// Vendor number of the reference device: the test numbers of pid.codes, free for everybody, but not for products.
pub const VENDOR_ID: u16 = 0x1209;
/// Product number of the reference device.
pub const PRODUCT_ID: u16 = 0x000d;
/// Bulk OUT endpoint of the data lane.
pub const DATA_OUT: u8 = 0x01;
/// Bulk OUT endpoint of the control lane.
pub const CONTROL_OUT: u8 = 0x02;
/// Bulk IN endpoint of the replies.
pub const REPLIES_IN: u8 = 0x82;

/// Control messages that may be in flight.
const CONTROL_DEPTH: usize = 16;
/// Bytes of a control transfer.
const CONTROL_BYTES: usize = 512;
/// Transfers that wait for replies.
const REPLY_DEPTH: usize = 8;
/// Bytes of a reply transfer: a multiple of every packet size.
const REPLY_BYTES: usize = 4096;
/// Number of failures of an endpoint within [`STORM_NS`] that cause a reset of the device.
const STORM: usize = 3;
const STORM_NS: i64 = 1_000_000_000;

/// Counters of the cable.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct UsbCounters {
    /// Data transfers accepted from the link, frames and SYNCs: always the sum of those carried, lost and in flight.
    pub frames_taken: u64,
    /// Data transfers that arrived whole.
    pub frames_carried: u64,
    /// Data transfers that did not arrive whole and were not sent again, because a newer one was waiting or their
    /// medium was gone.
    pub frames_lost: u64,
    /// Data transfers that were sent again from their start.
    pub frames_resent: u64,
    /// Halted endpoints.
    pub stalls: u64,
    /// Transfers of which the device took only a part.
    pub short_writes: u64,
    /// Replies longer than requested.
    pub babbles: u64,
    /// Transfers damaged on the cable.
    pub bus_errors: u64,
    /// Endpoints that moved nothing for too long.
    pub stuck: u64,
    /// Resets of the device.
    pub resets: u64,
    /// Submissions refused for lack of usbfs memory.
    pub out_of_memory: u64,
    /// Times that the device was opened.
    pub opened: u64,
}

/// One outgoing endpoint and its error recovery.
struct Outgoing {
    ring: Ring,
    endpoint: u8,
    /// Number of transfers that are reserved for an order to go dark.
    kept_free: usize,
    /// Length of each slot's content, for sending it again.
    lengths: Vec<usize>,
    /// Slot submitted last.
    newest: Option<usize>,
    /// When the oldest transfer in flight became the oldest.
    progress_at: HostTime,
    recovering: bool,
    failures: [HostTime; STORM],
}

/// Earlier than any instant that a caller may pass.
const NEVER: HostTime = HostTime(i64::MIN);

impl Outgoing {
    fn new(
        handle: &Arc<DeviceHandle<Context>>,
        endpoint: u8,
        count: usize,
        bytes: usize,
        kept_free: usize,
        clock: &SharedClock,
    ) -> Result<Self, rusb::Error> {
        Ok(Self {
            ring: Ring::new(handle.clone(), endpoint, count, bytes, clock)?,
            kept_free,
            endpoint,
            lengths: vec![0; count],
            newest: None,
            progress_at: NEVER,
            recovering: false,
            failures: [NEVER; STORM],
        })
    }

    fn has_room(&self) -> bool {
        !self.recovering && self.ring.idle_slots() > self.kept_free
    }

    fn send(&mut self, now: HostTime, packets: &[Packet<'_>], urgent: bool) -> Result<(), rusb::Error> {
        let may = !self.recovering && (urgent || self.has_room());
        let slot = self.ring.idle_slot().filter(|_| may).ok_or(rusb::Error::Busy)?;
        let buffer = self.ring.buffer(slot);
        let bytes: usize = packets.iter().map(Packet::wire_bytes).sum();
        assert!(
            bytes <= buffer.len(),
            "{bytes} bytes for endpoint {:#04x}, transfers of {}",
            self.endpoint,
            buffer.len()
        );
        let at = packets.iter().fold(0, |at, packet| at + packet.write_to(&mut buffer[at..]));
        if self.ring.in_flight() == 0 {
            self.progress_at = now;
        }
        self.ring.submit(slot, at)?;
        self.lengths[slot] = at;
        self.newest = Some(slot);
        Ok(())
    }

    /// Notes a failure and begins recovery; `true` if there were too many recently.
    fn fail(&mut self, now: HostTime) -> bool {
        if self.recovering {
            return false;
        }
        self.recovering = true;
        self.ring.cancel_all();
        self.failures.rotate_left(1);
        self.failures[STORM - 1] = now;
        self.failures[0] != NEVER && now.ns_since(self.failures[0]) < STORM_NS
    }
}

/// An open device.
struct Open {
    // The order matters: rings return their transfers before the handle closes.
    data: Outgoing,
    control: Outgoing,
    replies: Ring,
    replies_recovering: bool,
    handle: Arc<DeviceHandle<Context>>,
}

/// The link over USB.
pub struct UsbTransport {
    settings: UsbSettings,
    context: Context,
    device: Option<Open>,
    name: String,
    counters: UsbCounters,
    reset_due: bool,
    /// The next control message is an order to go dark.
    urgent: bool,
    clock: SharedClock,
    /// Lets libusb deliver; without it polling the link does that.
    events: Option<Events>,
}

impl std::fmt::Debug for UsbTransport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("UsbTransport").field("name", &self.name).field("counters", &self.counters).finish()
    }
}

impl UsbTransport {
    /// Finds the device, claims its interface and allocates everything.
    ///
    /// # Errors
    /// Not found; no permission (with the udev rule to install); in use by another program; usbfs too small for one frame (with the
    /// setting to change).
    pub fn open(settings: UsbSettings) -> Result<Self, TransportError> {
        let name = settings.describe();
        let context = open::context(&name)?;
        let events = Events::start(&context);
        let mut transport = Self {
            settings,
            context,
            urgent: false,
            clock: Arc::new(OnceLock::new()),
            events,
            device: None,
            name,
            counters: UsbCounters::default(),
            reset_due: false,
        };
        transport.reopen()?;
        Ok(transport)
    }

    /// True while the device is open.
    pub fn is_open(&self) -> bool {
        self.device.is_some()
    }

    /// The counters so far.
    pub fn counters(&self) -> UsbCounters {
        self.counters
    }

    /// Transfers of any kind that the kernel holds.
    pub fn in_flight(&self) -> usize {
        self.device
            .as_ref()
            .map_or(0, |d| d.data.ring.in_flight() + d.control.ring.in_flight() + d.replies.in_flight())
    }

    /// Frames that may be in flight: fewer than requested if usbfs has too little memory.
    pub fn depth(&self) -> usize {
        self.device.as_ref().map_or(0, |d| d.data.lengths.len())
    }

    fn gone(&mut self) -> TransportError {
        if let Some(device) = self.device.take() {
            self.counters.frames_lost += device.data.ring.in_flight() as u64;
        }
        TransportError::Unplugged { device: self.name.clone() }
    }

    /// Lets libusb deliver, and repairs what has failed.
    fn service(&mut self, now: HostTime) -> Result<(), TransportError> {
        if self.device.is_none() {
            return Err(TransportError::Unplugged { device: self.name.clone() });
        }
        match &mut self.events {
            Some(events) => events.follow(now),
            None => {
                if let Err(rusb::Error::NoDevice) = pump(&self.context) {
                    return Err(self.gone());
                }
            }
        }
        let Some(device) = &mut self.device else { return Ok(()) };
        let stuck_after = self.settings.stuck_after_ns;
        let (counters, reset_due) = (&mut self.counters, &mut self.reset_due);
        let data =
            Self::repair(&mut device.data, true, &device.handle, now, stuck_after, counters, reset_due);
        let control =
            Self::repair(&mut device.control, false, &device.handle, now, stuck_after, counters, reset_due);
        if data.is_err() || control.is_err() {
            return Err(self.gone());
        }
        if self.reset_due {
            return self.reset();
        }
        Ok(())
    }

    /// Takes ended transfers of one endpoint and advances its recovery. An error means that the device is gone.
    fn repair(
        out: &mut Outgoing,
        is_data: bool,
        handle: &DeviceHandle<Context>,
        now: HostTime,
        stuck_after: i64,
        counters: &mut UsbCounters,
        reset_due: &mut bool,
    ) -> Result<(), rusb::Error> {
        while let Some(ended) = out.ring.take_ended() {
            out.progress_at = now;
            let whole = ended.status == Status::Completed && ended.actual == out.lengths[ended.slot];
            if whole {
                counters.frames_carried += u64::from(is_data);
                if out.newest == Some(ended.slot) {
                    out.newest = None;
                }
                continue;
            }
            counters.frames_lost += u64::from(is_data);
            match ended.status {
                Status::NoDevice => return Err(rusb::Error::NoDevice),
                Status::Cancelled => {}
                Status::Completed => counters.short_writes += 1,
                Status::Stall => counters.stalls += 1,
                Status::Overflow | Status::Error => counters.bus_errors += 1,
            }
            *reset_due |= ended.status != Status::Cancelled && out.fail(now);
        }
        let waiting = out.ring.in_flight() > 0 && out.progress_at != NEVER;
        if waiting && !out.recovering && now.ns_since(out.progress_at) > stuck_after {
            counters.stuck += 1;
            *reset_due |= out.fail(now);
        }
        if out.recovering && out.ring.in_flight() == 0 && !*reset_due {
            // An endpoint that cannot be cleared will fail again, which leads to a reset.
            if within(Place::Libusb, || handle.clear_halt(out.endpoint)) == Err(rusb::Error::NoDevice) {
                return Err(rusb::Error::NoDevice);
            }
            out.recovering = false;
            out.progress_at = now;
            if let Some(slot) = out.newest.filter(|_| is_data) {
                // The newest frame is sent again, from its start; its slot is known to hold unsent content.
                if out.ring.submit(slot, out.lengths[slot]).is_ok() {
                    counters.frames_resent += 1;
                    counters.frames_lost -= 1;
                }
            }
        }
        Ok(())
    }

    /// Resets the device: it loses its whole state of the link, and the link greets it again.
    fn reset(&mut self) -> Result<(), TransportError> {
        let Some(device) = &mut self.device else { return Ok(()) };
        device.data.ring.cancel_all();
        device.control.ring.cancel_all();
        device.replies.cancel_all();
        let busy =
            device.data.ring.in_flight() + device.control.ring.in_flight() + device.replies.in_flight();
        if busy > 0 {
            // Replies end here; the others were counted by `repair`.
            while device.replies.take_ended().is_some() {}
            return Ok(());
        }
        self.reset_due = false;
        self.counters.resets += 1;
        let reset = within(Place::Libusb, || device.handle.reset());
        match reset {
            Ok(()) => {
                for out in [&mut device.data, &mut device.control] {
                    out.recovering = false;
                    out.newest = None;
                    out.failures = [NEVER; STORM];
                }
                for slot in 0..REPLY_DEPTH {
                    if device.replies.submit(slot, REPLY_BYTES).is_err() {
                        return Err(self.gone());
                    }
                }
                Ok(())
            }
            // It came back as another device, or not at all: it must be opened anew.
            Err(_) => Err(self.gone()),
        }
    }

    /// Passes replies on, oldest first, and submits new reads.
    fn replies(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        let Some(device) = &mut self.device else { return Ok(()) };
        let mut gone = false;
        // At most one round: a device that sends without end cannot keep this call from returning.
        for _ in 0..REPLY_DEPTH {
            let Some(ended) = device.replies.take_ended() else { break };
            if ended.actual > 0 {
                let at = ended.at.unwrap_or(now);
                sink(Lane::Control, at, &device.replies.buffer(ended.slot)[..ended.actual]);
            }
            match ended.status {
                Status::NoDevice => gone = true,
                Status::Stall => {
                    self.counters.stalls += 1;
                    device.replies_recovering = true;
                }
                Status::Overflow => self.counters.babbles += 1,
                Status::Error => self.counters.bus_errors += 1,
                Status::Completed | Status::Cancelled => {}
            }
            if device.replies_recovering && !gone {
                device.replies.cancel_all();
            } else if !gone && !self.reset_due {
                gone = device.replies.submit(ended.slot, REPLY_BYTES).is_err();
            }
        }
        if device.replies_recovering && device.replies.in_flight() == 0 && !gone {
            device.replies_recovering = false;
            gone =
                within(Place::Libusb, || device.handle.clear_halt(REPLIES_IN)) == Err(rusb::Error::NoDevice);
            for slot in 0..REPLY_DEPTH {
                gone = gone || device.replies.submit(slot, REPLY_BYTES).is_err();
            }
        }
        if gone {
            Err(self.gone())
        } else {
            Ok(())
        }
    }
}

impl Transport for UsbTransport {
    fn send(&mut self, now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        self.service(now)?;
        let Some(device) = &mut self.device else { return Err(SendError::Busy) };
        let out = match lane {
            Lane::Data => &mut device.data,
            Lane::Control => &mut device.control,
        };
        if self.reset_due {
            return Err(SendError::Busy);
        }
        let urgent = lane == Lane::Control && std::mem::take(&mut self.urgent);
        match out.send(now, packets, urgent) {
            Ok(()) => {
                self.counters.frames_taken += u64::from(lane == Lane::Data);
                Ok(())
            }
            Err(rusb::Error::Busy) => Err(SendError::Busy),
            Err(rusb::Error::NoMem) => {
                self.counters.out_of_memory += 1;
                Err(SendError::Busy)
            }
            Err(rusb::Error::NoDevice) => Err(self.gone().into()),
            Err(e) => Err(TransportError::of_usb("send to", self.name.clone(), e).into()),
        }
    }

    fn has_room(&mut self, lane: Lane) -> bool {
        !self.reset_due
            && self.device.as_ref().is_some_and(|d| match lane {
                Lane::Data => d.data.has_room(),
                Lane::Control => d.control.has_room(),
            })
    }

    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        self.service(now)?;
        self.replies(now, sink)
    }

    fn set_clock(&mut self, clock: Arc<dyn HostClock>) {
        // A second clock would make earlier stamps worthless.
        let _ = self.clock.set(clock);
    }

    fn flush_output(&mut self) {
        // Frames in flight stay; no transfer of the control lane waits for them.
        self.urgent = true;
    }

    fn reopen(&mut self) -> Result<(), TransportError> {
        self.device = None;
        self.reset_due = false;
        let (handle, name) = self.settings.open_handle(&self.context)?;
        let handle = Arc::new(handle);
        self.name = name;
        let failed = |e| TransportError::of_usb("allocate transfers of", self.name.clone(), e);
        let depth = self.settings.depth_within_limit();
        let mut device = Open {
            data: Outgoing::new(&handle, DATA_OUT, depth, self.settings.frame_bytes, 0, &self.clock)
                .map_err(failed)?,
            control: Outgoing::new(&handle, CONTROL_OUT, CONTROL_DEPTH, CONTROL_BYTES, 1, &self.clock)
                .map_err(failed)?,
            replies: Ring::new(handle.clone(), REPLIES_IN, REPLY_DEPTH, REPLY_BYTES, &self.clock)
                .map_err(failed)?,
            replies_recovering: false,
            handle,
        };
        // A killed host may have left half a packet in the device.
        for endpoint in [DATA_OUT, CONTROL_OUT] {
            device
                .handle
                .clear_halt(endpoint)
                .map_err(|e| TransportError::of_usb("clear the endpoints of", self.name.clone(), e))?;
        }
        for slot in 0..REPLY_DEPTH {
            (device.replies.submit(slot, REPLY_BYTES))
                .map_err(|e| TransportError::of_usb("read from", self.name.clone(), e))?;
        }
        device.data.progress_at = NEVER;
        self.device = Some(device);
        self.counters.opened += 1;
        Ok(())
    }

    fn name(&self) -> &str {
        &self.name
    }
}
