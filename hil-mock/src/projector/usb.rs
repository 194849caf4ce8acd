//! The projector as a USB device: bulk endpoints for the two lanes and the replies, on top of the state machine.
//!
//! One vendor interface with three bulk endpoints, see docs/PROTOCOL.md section 1. The cable may be slower than the
//! bus: bytes of the data lane are accepted at a given rate, and the rest is refused for now (NAK), as by a device with
//! a slow memory.

use std::collections::VecDeque;

use dpm_device::time::HostTime;
use dpm_device::transport::{Lane, LinkDevice};

use super::MockProjector;
use crate::usb_model::{Progress, Setup, Speed, UsbDeviceModel};

/// Bulk OUT endpoint of the data lane.
pub const DATA_OUT: u8 = 0x01;
/// Bulk OUT endpoint of the control lane.
pub const CONTROL_OUT: u8 = 0x02;
/// Bulk IN endpoint of the replies.
pub const REPLIES_IN: u8 = 0x82;

/// Bytes of replies kept for a host that does not read; older ones are dropped, because STATUS is absolute.
const REPLIES_KEPT: usize = 64 * 1024;
/// Bytes that the data lane accepts at once at a limited rate.
const FIFO_BYTES: i64 = 64 * 1024;

/// A [`MockProjector`] on a USB cable.
#[derive(Debug)]
pub struct UsbProjector {
    projector: MockProjector,
    speed: Speed,
    device: [u8; 18],
    configuration: Vec<u8>,
    serial: String,
    replies: VecDeque<u8>,
    bytes_per_second: Option<u64>,
    /// Room in the FIFO, and when it was last computed.
    room: i64,
    room_at: HostTime,
}

impl UsbProjector {
    /// Connects `projector` to a cable of `speed` (high or super). `bytes_per_second` limits the data lane.
    pub fn new(projector: MockProjector, speed: Speed, bytes_per_second: Option<u64>) -> Self {
        let (usb, packet, packet0) = match speed {
            Speed::Super => (0x0300u16, 1024u16, 9),
            Speed::High => (0x0200, 512, 64),
            Speed::Full => (0x0110, 64, 64),
        };
        let (usb, packet) = (usb.to_le_bytes(), packet.to_le_bytes());
        let id = [0x09, 0x12, 0x0d, 0x00];
        let device =
            [18, 1, usb[0], usb[1], 0xff, 0, 0, packet0, id[0], id[1], id[2], id[3], 0x00, 0x01, 1, 2, 3, 1];
        let mut configuration = vec![9, 2, 0, 0, 1, 1, 0, 0x80, 50, 9, 4, 0, 0, 3, 0xff, 0x44, 1, 0];
        for endpoint in [DATA_OUT, CONTROL_OUT, REPLIES_IN] {
            configuration.extend([7, 5, endpoint, 2, packet[0], packet[1], 0]);
            if speed == Speed::Super {
                configuration.extend([6, 0x30, 0, 0, 0, 0]);
            }
        }
        configuration[2] = configuration.len() as u8;
        let serial = format!("{:016x}", projector.serial());
        Self {
            projector,
            speed,
            device,
            configuration,
            serial,
            replies: VecDeque::new(),
            bytes_per_second,
            room: FIFO_BYTES,
            room_at: HostTime(i64::MIN),
        }
    }

    /// The projector inside.
    pub fn projector(&mut self) -> &mut MockProjector {
        &mut self.projector
    }

    /// Limits the data lane from now on.
    pub fn set_bytes_per_second(&mut self, limit: Option<u64>) {
        self.bytes_per_second = limit;
    }

    /// Number of bytes that the data lane may accept now.
    fn take_room(&mut self, now: HostTime, wanted: usize) -> usize {
        let Some(rate) = self.bytes_per_second else { return wanted };
        let elapsed = if self.room_at.0 == i64::MIN { 0 } else { now.ns_since(self.room_at).max(0) };
        let gained = i128::from(elapsed) * i128::from(rate) / 1_000_000_000;
        if gained > 0 || self.room_at.0 == i64::MIN {
            self.room_at = now;
            self.room = (i128::from(self.room) + gained).min(i128::from(FIFO_BYTES)) as i64;
        }
        let n = wanted.min(self.room.max(0) as usize);
        self.room -= n as i64;
        n
    }

    fn lane(endpoint: u8) -> Option<Lane> {
        match endpoint {
            DATA_OUT => Some(Lane::Data),
            CONTROL_OUT => Some(Lane::Control),
            _ => None,
        }
    }
}

impl UsbDeviceModel for UsbProjector {
    fn speed(&self) -> Speed {
        self.speed
    }

    fn device_descriptor(&self) -> &[u8] {
        &self.device
    }

    fn configuration_descriptor(&self) -> &[u8] {
        &self.configuration
    }

    fn string(&self, index: u8) -> Option<&str> {
        match index {
            1 => Some("dpm"),
            2 => Some("Mock projector"),
            3 => Some(&self.serial),
            _ => None,
        }
    }

    fn control(&mut self, _now: HostTime, _setup: &Setup, _data: &mut [u8]) -> Progress {
        Progress::stall(0)
    }

    fn transfer_out(&mut self, now: HostTime, endpoint: u8, data: &[u8]) -> Progress {
        let Some(lane) = Self::lane(endpoint) else { return Progress::stall(0) };
        let n = if lane == Lane::Data { self.take_room(now, data.len()) } else { data.len() };
        self.projector.receive(now, lane, &data[..n]);
        if n < data.len() {
            Progress::nak(n)
        } else {
            Progress::complete(n)
        }
    }

    fn transfer_in(&mut self, now: HostTime, endpoint: u8, buffer: &mut [u8]) -> Progress {
        if endpoint != REPLIES_IN {
            return Progress::stall(0);
        }
        let Self { projector, replies, .. } = self;
        projector.replies(now, &mut |_, bytes| replies.extend(bytes));
        let excess = replies.len().saturating_sub(REPLIES_KEPT);
        replies.drain(..excess);
        if replies.is_empty() {
            return Progress::nak(0);
        }
        let n = buffer.len().min(replies.len());
        for (to, from) in buffer.iter_mut().zip(replies.drain(..n)) {
            *to = from;
        }
        Progress::complete(n)
    }

    fn halt_cleared(&mut self, endpoint: u8) {
        if let Some(lane) = Self::lane(endpoint) {
            // The device does not know the time of the request; it uses the time to which it has advanced.
            let now = self.projector.now();
            self.projector.end_of_transfer(now, lane);
        }
    }

    fn bus_reset(&mut self, now: HostTime) {
        self.projector.bus_reset(now);
        self.replies.clear();
    }
}
