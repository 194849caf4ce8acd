//! Carries packets to a device in the same process: by direct calls (deterministic, for virtual pace), or over bounded
//! rings to a device on its own thread (for real pace).

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;

use dpm_handoff::ring::{exchange, ring, Consumer, Drainer, Filler, Producer};
use dpm_handoff::wake::{WaitPolicy, Waiter, Waker};

use super::{Lane, LinkDevice, SendError, Transport, TransportError};
use crate::packet::{packet_bytes, Packet, MAX_CONTROL_BYTES};
use crate::time::HostTime;

/// Calls the device as part of `send` and `receive`: nothing is copied or queued, and a run is a function of its
/// inputs. The device's time advances exactly to the `now` that it is called with.
#[derive(Clone, Debug)]
pub struct Direct<D> {
    device: D,
}

impl<D: LinkDevice> Direct<D> {
    /// A cable of zero length to `device`.
    pub const fn new(device: D) -> Self {
        Self { device }
    }

    /// The device.
    pub const fn device(&self) -> &D {
        &self.device
    }

    /// The device, to advance it or to take its light.
    pub fn device_mut(&mut self) -> &mut D {
        &mut self.device
    }

    /// Unplugs and returns the device.
    pub fn into_device(self) -> D {
        self.device
    }
}

impl<D: LinkDevice> Transport for Direct<D> {
    fn send(&mut self, now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        for packet in packets {
            for part in [packet.header(), packet.payload(), &packet.trailer()] {
                if !part.is_empty() {
                    self.device.receive(now, lane, part);
                }
            }
        }
        Ok(())
    }

    fn receive(
        &mut self,
        now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        self.device.advance_to(now);
        self.device.replies(now, &mut |lane, bytes| sink(lane, now, bytes));
        Ok(())
    }

    fn name(&self) -> &str {
        "in-process, direct"
    }
}

/// Maximum number of bytes in one control message slot.
const SMALL_BYTES: usize = packet_bytes(MAX_CONTROL_BYTES);
/// Control messages and replies that may wait.
const SMALL_DEPTH: usize = 64;

#[derive(Clone, Copy)]
struct Small {
    lane: Lane,
    /// When the host put it in.
    at: HostTime,
    len: u16,
    bytes: [u8; SMALL_BYTES],
}

/// A frame on the wire.
struct Large {
    len: usize,
    bytes: Box<[u8]>,
}

/// The host's end of a threaded in-process cable.
pub struct HostEnd {
    frames: Filler<Large>,
    /// Returned buffers, the last one on top: it is the warmest in the caches.
    free: Vec<Large>,
    control: Producer<Small>,
    replies: Consumer<Small>,
    device: Waker,
    unplugged: Arc<AtomicBool>,
}

/// The device's end of a threaded in-process cable.
pub struct DeviceEnd {
    frames: Drainer<Large>,
    control: Consumer<Small>,
    replies: Producer<Small>,
    waiter: Waiter,
    unplugged: Arc<AtomicBool>,
}

/// A cable between two threads with `depth` recycled buffers of `frame_bytes` each. Neither end locks, blocks or
/// allocates. The device's thread waits in [`DeviceEnd::rest`] according to `policy`, and any arrival wakes it.
/// `frame_bytes` is the size of the largest frame on the wire, see [`crate::packet::packet_bytes`]. Two buffers keep both
/// ends busy; more only make the caches colder.
pub fn threaded(frame_bytes: usize, depth: usize, policy: WaitPolicy) -> (HostEnd, DeviceEnd) {
    // Written once, so that the pages are mapped before the first frame.
    let buffers =
        (0..depth.max(1)).map(|_| Large { len: 0, bytes: vec![0x5a; frame_bytes].into_boxed_slice() });
    let (filler, drainer) = exchange(buffers.collect());
    let (control_in, control_out) = ring(SMALL_DEPTH);
    let (replies_in, replies_out) = ring(SMALL_DEPTH);
    let waiter = Waiter::new(policy);
    let unplugged = Arc::new(AtomicBool::new(false));
    let device = waiter.waker();
    (
        HostEnd {
            frames: filler,
            free: Vec::with_capacity(depth.max(1)),
            control: control_in,
            replies: replies_out,
            device,
            unplugged: unplugged.clone(),
        },
        DeviceEnd { frames: drainer, control: control_out, replies: replies_in, waiter, unplugged },
    )
}

fn gather(out: &mut [u8], packets: &[Packet<'_>]) -> usize {
    packets.iter().fold(0, |at, packet| at + packet.write_to(&mut out[at..]))
}

impl HostEnd {
    fn fetch_free(&mut self) {
        while let Some(large) = self.frames.take_free() {
            self.free.push(large);
        }
    }

    fn gone(&self) -> Result<(), TransportError> {
        if self.unplugged.load(Ordering::Acquire) {
            Err(TransportError::Unplugged { device: self.name().into() })
        } else {
            Ok(())
        }
    }
}

impl Transport for HostEnd {
    fn send(&mut self, now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        self.gone()?;
        let bytes: usize = packets.iter().map(Packet::wire_bytes).sum();
        match lane {
            Lane::Control => {
                assert!(
                    bytes <= SMALL_BYTES,
                    "{bytes} bytes of control message, at most {SMALL_BYTES} travel"
                );
                let mut small = Small { lane, at: now, len: bytes as u16, bytes: [0; SMALL_BYTES] };
                gather(&mut small.bytes, packets);
                self.control.push(small).map_err(|_| SendError::Busy)?;
            }
            Lane::Data => {
                self.fetch_free();
                let mut large = self.free.pop().ok_or(SendError::Busy)?;
                assert!(
                    bytes <= large.bytes.len(),
                    "frame of {bytes} bytes, buffers of {}",
                    large.bytes.len()
                );
                large.len = gather(&mut large.bytes, packets);
                // Never full: there are as many places as buffers.
                self.frames.send(large).map_err(|_| SendError::Busy)?;
            }
        }
        self.device.wake();
        Ok(())
    }

    fn has_room(&mut self, lane: Lane) -> bool {
        match lane {
            Lane::Data => !self.free.is_empty() || self.frames.has_free(),
            Lane::Control => self.control.len() < SMALL_DEPTH,
        }
    }

    fn receive(
        &mut self,
        _now: HostTime,
        sink: &mut dyn FnMut(Lane, HostTime, &[u8]),
    ) -> Result<(), TransportError> {
        // At most as many as the ring holds: a device that sends without end cannot keep this call from returning.
        for _ in 0..SMALL_DEPTH {
            let Some(small) = self.replies.pop() else { break };
            sink(small.lane, small.at, &small.bytes[..small.len as usize]);
        }
        self.gone()
    }

    fn name(&self) -> &str {
        "in-process, threaded"
    }
}

impl Drop for HostEnd {
    fn drop(&mut self) {
        self.unplugged.store(true, Ordering::Release);
        self.device.wake();
    }
}

impl DeviceEnd {
    /// Delivers the input to `device`, control first, advances the device to now, and takes its replies. Returns
    /// `false` when the host's end is gone. Replies that find no room are lost, as on a cable nobody reads.
    ///
    /// `clock` is the host's clock. A control message arrives when the host puts it in, however late this function is
    /// called; the device gets that instant, as it would from hardware that stamps. A frame arrives when it is taken
    /// in. A reply carries its own stamp, taken when it is put out. An ECHO is answered before the frame beside it is
    /// taken in.
    pub fn serve(&mut self, clock: impl Fn() -> HostTime, device: &mut dyn LinkDevice) -> bool {
        for _ in 0..SMALL_DEPTH {
            let Some(small) = self.control.pop() else { break };
            device.receive(small.at, small.lane, &small.bytes[..small.len as usize]);
        }
        self.answer(&clock, device);
        if let Some(large) = self.frames.receive() {
            device.receive(clock(), Lane::Data, &large.bytes[..large.len]);
            let returned = self.frames.give_back(large);
            debug_assert!(returned.is_ok(), "as many places as buffers");
            self.answer(&clock, device);
        }
        !self.unplugged.load(Ordering::Acquire)
    }

    /// Takes the device's replies.
    fn answer(&mut self, clock: &impl Fn() -> HostTime, device: &mut dyn LinkDevice) {
        let replies = &mut self.replies;
        device.replies(clock(), &mut |lane, bytes| {
            if bytes.len() <= SMALL_BYTES {
                let mut small = Small { lane, at: clock(), len: bytes.len() as u16, bytes: [0; SMALL_BYTES] };
                small.bytes[..bytes.len()].copy_from_slice(bytes);
                let _ = replies.push(small);
            }
        });
    }

    /// Waits until something arrives, the host's end is dropped, or the clock `now` reaches `until` (the device's next
    /// own event). Returns at once if there is something to serve.
    pub fn rest(&mut self, until: HostTime, now: impl Fn() -> HostTime) {
        let Self { frames, control, unplugged, waiter, .. } = self;
        waiter.wait(
            until.0,
            || now().0,
            || !control.is_empty() || frames.has_filled() || unplugged.load(Ordering::Acquire),
        );
    }

    /// True when nothing waits to be served.
    pub fn is_idle(&self) -> bool {
        self.control.is_empty() && !self.frames.has_filled()
    }

    /// Wakes the waiting thread, for whoever wants to end it.
    pub fn waker(&self) -> Waker {
        self.waiter.waker()
    }
}

impl Drop for DeviceEnd {
    fn drop(&mut self) {
        self.unplugged.store(true, Ordering::Release);
    }
}
