//! Packets to a device in the same process: called directly (deterministic, for virtual pace), or over bounded rings to a
//! device on a thread of its own (for real pace).

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;

use crossbeam::queue::ArrayQueue;

use super::{Lane, LinkDevice, SendError, Transport, TransportError};
use crate::link::Packet;
use crate::time::HostTime;

/// Calls the device as part of `send` and `receive`: nothing is copied, nothing is queued, and a run is a function of its
/// inputs. The device lives exactly as far as the `now` it is called with.
#[derive(Debug)]
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

    /// The device, to let it live or to take its light.
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
            for part in packet.parts() {
                if !part.is_empty() {
                    self.device.receive(now, lane, part);
                }
            }
        }
        Ok(())
    }

    fn receive(&mut self, now: HostTime, sink: &mut dyn FnMut(Lane, &[u8])) -> Result<(), TransportError> {
        self.device.advance_to(now);
        self.device.replies(now, sink);
        Ok(())
    }

    fn name(&self) -> &str {
        "in-process, direct"
    }
}

/// Longest run of packets in one control message slot.
const SMALL_BYTES: usize = 160;
/// Control messages and replies that may wait.
const SMALL_DEPTH: usize = 64;

#[derive(Clone, Copy)]
struct Small {
    lane: Lane,
    len: u8,
    bytes: [u8; SMALL_BYTES],
}

struct Large {
    len: usize,
    bytes: Box<[u8]>,
}

struct Shared {
    /// Filled buffers on their way to the device; one is one call of `send`.
    filled: ArrayQueue<Large>,
    /// Empty buffers on their way back.
    empty: ArrayQueue<Large>,
    control: ArrayQueue<Small>,
    replies: ArrayQueue<Small>,
    unplugged: AtomicBool,
}

/// The host's end of a threaded in-process cable.
pub struct HostEnd(Arc<Shared>);

/// The device's end of a threaded in-process cable.
pub struct DeviceEnd(Arc<Shared>);

/// A cable between two threads with `depth` recycled buffers of `frame_bytes` each: neither end locks, waits or allocates.
/// `frame_bytes` is the size of the largest frame on the wire, see [`crate::link::packet_bytes`].
///
/// The rings are lock-free but not wait-free: a thread suspended inside a push can make the other back off for that long.
pub fn threaded(frame_bytes: usize, depth: usize) -> (HostEnd, DeviceEnd) {
    let depth = depth.max(1);
    let shared = Arc::new(Shared {
        filled: ArrayQueue::new(depth),
        empty: ArrayQueue::new(depth),
        control: ArrayQueue::new(SMALL_DEPTH),
        replies: ArrayQueue::new(SMALL_DEPTH),
        unplugged: AtomicBool::new(false),
    });
    for _ in 0..depth {
        let fresh = Large { len: 0, bytes: vec![0; frame_bytes].into_boxed_slice() };
        assert!(shared.empty.push(fresh).is_ok(), "a ring of {depth} holds {depth} buffers");
    }
    (HostEnd(shared.clone()), DeviceEnd(shared))
}

fn gather(out: &mut [u8], packets: &[Packet<'_>]) -> usize {
    let mut at = 0;
    for packet in packets {
        for part in packet.parts() {
            out[at..at + part.len()].copy_from_slice(part);
            at += part.len();
        }
    }
    at
}

impl HostEnd {
    fn gone(&self) -> Result<(), TransportError> {
        if self.0.unplugged.load(Ordering::Acquire) {
            Err(TransportError::Unplugged { device: self.name().into() })
        } else {
            Ok(())
        }
    }
}

impl Transport for HostEnd {
    fn send(&mut self, _now: HostTime, lane: Lane, packets: &[Packet<'_>]) -> Result<(), SendError> {
        self.gone()?;
        let bytes: usize = packets.iter().map(Packet::wire_bytes).sum();
        match lane {
            Lane::Control => {
                assert!(
                    bytes <= SMALL_BYTES,
                    "{bytes} bytes of control message, at most {SMALL_BYTES} travel"
                );
                let mut small = Small { lane, len: bytes as u8, bytes: [0; SMALL_BYTES] };
                gather(&mut small.bytes, packets);
                self.0.control.push(small).map_err(|_| SendError::Busy)
            }
            Lane::Data => {
                let mut large = self.0.empty.pop().ok_or(SendError::Busy)?;
                assert!(
                    bytes <= large.bytes.len(),
                    "frame of {bytes} bytes, buffers of {}",
                    large.bytes.len()
                );
                large.len = gather(&mut large.bytes, packets);
                // Never full: there are as many places as buffers.
                self.0.filled.push(large).map_err(|_| SendError::Busy)
            }
        }
    }

    fn has_room(&mut self, lane: Lane) -> bool {
        match lane {
            Lane::Data => !self.0.empty.is_empty(),
            Lane::Control => !self.0.control.is_full(),
        }
    }

    fn receive(&mut self, _now: HostTime, sink: &mut dyn FnMut(Lane, &[u8])) -> Result<(), TransportError> {
        // As many as the ring holds: a device that talks without end cannot keep this call from returning.
        for _ in 0..SMALL_DEPTH {
            let Some(small) = self.0.replies.pop() else { break };
            sink(small.lane, &small.bytes[..small.len as usize]);
        }
        self.gone()
    }

    fn name(&self) -> &str {
        "in-process, threaded"
    }
}

impl Drop for HostEnd {
    fn drop(&mut self) {
        self.0.unplugged.store(true, Ordering::Release);
    }
}

impl DeviceEnd {
    /// Delivers what has arrived to `device`, control first, lets it live up to `now`, and takes its replies. Returns `false`
    /// when the host's end is gone. Replies that find no room are lost, as on a cable nobody reads.
    pub fn serve(&mut self, now: HostTime, device: &mut dyn LinkDevice) -> bool {
        for _ in 0..SMALL_DEPTH {
            let Some(small) = self.0.control.pop() else { break };
            device.receive(now, small.lane, &small.bytes[..small.len as usize]);
        }
        if let Some(large) = self.0.filled.pop() {
            device.receive(now, Lane::Data, &large.bytes[..large.len]);
            let returned = self.0.empty.push(large);
            debug_assert!(returned.is_ok(), "as many places as buffers");
        }
        device.advance_to(now);
        device.replies(now, &mut |lane, bytes| {
            if bytes.len() <= SMALL_BYTES {
                let mut small = Small { lane, len: bytes.len() as u8, bytes: [0; SMALL_BYTES] };
                small.bytes[..bytes.len()].copy_from_slice(bytes);
                let _ = self.0.replies.push(small);
            }
        });
        !self.0.unplugged.load(Ordering::Acquire)
    }

    /// True when nothing waits to be served.
    pub fn is_idle(&self) -> bool {
        self.0.control.is_empty() && self.0.filled.is_empty()
    }
}

impl Drop for DeviceEnd {
    fn drop(&mut self) {
        self.0.unplugged.store(true, Ordering::Release);
    }
}
