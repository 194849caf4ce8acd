//! A USB device as its front ends see it: a state machine that turns setup packets and payload into payload, without
//! I/O.
//!
//! A model implements [`UsbDeviceModel`]. [`crate::usb_plug::UsbPlug`] adds the common part of all devices (standard
//! requests, halted endpoints, queues, faults), and thin front ends (USB/IP, the in-process usbfs) carry its transfers
//! to a host. Time is an argument, so a model behaves the same at virtual pace.

use dpm_device::time::HostTime;

/// Signalling rate of the cable, with its number in USB/IP and usbfs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Speed {
    /// 12 Mbit/s.
    Full = 2,
    /// 480 Mbit/s.
    High = 3,
    /// 5 Gbit/s.
    Super = 5,
}

impl Speed {
    /// Megabits per second as sysfs prints it.
    pub const fn megabits(self) -> u32 {
        match self {
            Self::Full => 12,
            Self::High => 480,
            Self::Super => 5000,
        }
    }
}

/// The eight bytes that start a control transfer \[USB2 section 9.3\].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Setup {
    /// Direction (bit 7), type (bits 6..5: 0 standard, 1 class, 2 vendor) and recipient (bits 4..0).
    pub request_type: u8,
    /// Which request.
    pub request: u8,
    /// wValue.
    pub value: u16,
    /// wIndex: an interface or endpoint number for those recipients.
    pub index: u16,
    /// Most bytes of the data stage.
    pub length: u16,
}

impl Setup {
    /// Reads the eight bytes of the wire format.
    pub const fn from_bytes(b: [u8; 8]) -> Self {
        Self {
            request_type: b[0],
            request: b[1],
            value: u16::from_le_bytes([b[2], b[3]]),
            index: u16::from_le_bytes([b[4], b[5]]),
            length: u16::from_le_bytes([b[6], b[7]]),
        }
    }

    /// The eight bytes of the wire format.
    pub const fn to_bytes(self) -> [u8; 8] {
        let (v, i, l) = (self.value.to_le_bytes(), self.index.to_le_bytes(), self.length.to_le_bytes());
        [self.request_type, self.request, v[0], v[1], i[0], i[1], l[0], l[1]]
    }

    /// Whether the data stage runs from the device to the host.
    pub const fn is_in(self) -> bool {
        self.request_type & 0x80 != 0
    }

    /// Whether this is a request of the USB standard itself, not of a class or vendor.
    pub const fn is_standard(self) -> bool {
        self.request_type & 0x60 == 0
    }
}

/// Progress of a transfer in one call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Bytes moved by this call.
    pub bytes: usize,
    /// The device's response after them.
    pub then: Then,
}

/// What ends, or interrupts, a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Then {
    /// The transfer is complete: everything was taken, or the device sent its last (perhaps short) packet.
    Complete,
    /// Not now. The front end calls again with the rest of the same transfer until it moves, is cancelled or the cable is pulled.
    Nak,
    /// The endpoint halts; a control transfer is merely refused.
    Stall,
    /// The packet was damaged on the cable (in all three attempts of the host).
    BusError,
    /// The device sent more than the host requested.
    Babble,
    /// The device left the bus.
    Disconnect,
}

impl Progress {
    /// The transfer is over after `bytes`.
    pub const fn complete(bytes: usize) -> Self {
        Self { bytes, then: Then::Complete }
    }

    /// `bytes` moved; the rest follows later.
    pub const fn nak(bytes: usize) -> Self {
        Self { bytes, then: Then::Nak }
    }

    /// `bytes` moved, then the endpoint halted.
    pub const fn stall(bytes: usize) -> Self {
        Self { bytes, then: Then::Stall }
    }
}

/// A USB device with one configuration, as a state machine.
///
/// Endpoint addresses carry the direction in bit 7 (`0x81` = IN 1). Implementations MUST return without blocking, must
/// not panic on any bytes, and must bound their allocation by their descriptors.
pub trait UsbDeviceModel: Send {
    /// Speed it enumerates at.
    fn speed(&self) -> Speed;

    /// The 18 bytes of the device descriptor.
    fn device_descriptor(&self) -> &[u8];

    /// The configuration descriptor with all that follows it (`wTotalLength` bytes).
    fn configuration_descriptor(&self) -> &[u8];

    /// The string behind a string index other than 0.
    fn string(&self, index: u8) -> Option<&str>;

    /// Any other descriptor: BOS (0x0f), HID report (0x22), ... `windex` is the request's wIndex (interface or language).
    fn other_descriptor(&self, kind: u8, index: u8, windex: u16) -> Option<&[u8]> {
        let _ = (kind, index, windex);
        None
    }

    /// A class or vendor request. `data` has `setup.length` bytes: the host's for OUT, to be filled for IN. Answer
    /// unknown requests with [`Then::Stall`].
    fn control(&mut self, now: HostTime, setup: &Setup, data: &mut [u8]) -> Progress;

    /// The host sends `data` to `endpoint`; empty data is a zero-length packet. After [`Then::Nak`] the next call carries the rest of
    /// the same transfer.
    fn transfer_out(&mut self, now: HostTime, endpoint: u8, data: &[u8]) -> Progress;

    /// The host reads at most `buffer.len()` bytes from `endpoint`. After [`Then::Nak`] the next call continues the same transfer.
    fn transfer_in(&mut self, now: HostTime, endpoint: u8, buffer: &mut [u8]) -> Progress;

    /// The host cleared the halt of `endpoint`.
    fn halt_cleared(&mut self, endpoint: u8) {
        let _ = endpoint;
    }

    /// Bus reset, SET_CONFIGURATION or re-plug: communication state is lost; the device keeps its own state as its kind
    /// does.
    fn bus_reset(&mut self, now: HostTime) {
        let _ = now;
    }
}

/// The UTF-16 string descriptor of `text`, truncated to 126 characters (the limit of the length byte).
pub fn string_descriptor(text: &str) -> Vec<u8> {
    let mut d = vec![0, 3];
    for unit in text.encode_utf16().take(126) {
        d.extend_from_slice(&unit.to_le_bytes());
    }
    d[0] = d.len() as u8;
    d
}

/// (address, attributes, wMaxPacketSize, bInterval) of each endpoint in a configuration descriptor, in order. Stops at the first malformed entry.
pub fn endpoints(configuration: &[u8]) -> Vec<(u8, u8, u16, u8)> {
    walk(configuration)
        .filter(|d| d[1] == 5 && d.len() >= 7)
        .map(|d| (d[2], d[3], u16::from_le_bytes([d[4], d[5]]), d[6]))
        .collect()
}

/// (class, subclass, protocol) of each interface's setting 0 in a configuration descriptor, in order.
pub fn interfaces(configuration: &[u8]) -> Vec<(u8, u8, u8)> {
    walk(configuration)
        .filter(|d| d[1] == 4 && d.len() >= 9 && d[3] == 0)
        .map(|d| (d[5], d[6], d[7]))
        .collect()
}

/// The descriptors of a configuration; ends at the first whose length is below 2 or beyond the end.
fn walk(configuration: &[u8]) -> impl Iterator<Item = &[u8]> {
    let mut rest = configuration;
    std::iter::from_fn(move || {
        let length = usize::from(*rest.first()?);
        if length < 2 || length > rest.len() {
            return None;
        }
        let (one, next) = rest.split_at(length);
        rest = next;
        Some(one)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn setup_round_trips_golden_bytes() {
        let bytes = [0x81, 0x06, 0x00, 0x22, 0x01, 0x00, 0x40, 0x02];
        let setup = Setup::from_bytes(bytes);
        assert_eq!(setup, Setup { request_type: 0x81, request: 6, value: 0x2200, index: 1, length: 0x0240 });
        assert!(setup.is_in() && setup.is_standard());
        assert_eq!(setup.to_bytes(), bytes);
    }

    #[test]
    fn descriptors_are_walked_and_malformed_ones_end_the_walk() {
        let mut c = vec![9, 2, 25, 0, 1, 1, 0, 0x80, 50, 9, 4, 0, 0, 1, 3, 0, 0, 0, 7, 5, 0x81, 3, 64, 0, 1];
        assert_eq!(endpoints(&c), [(0x81, 3, 64, 1)]);
        assert_eq!(interfaces(&c), [(3, 0, 0)]);
        c[18] = 0;
        assert!(endpoints(&c).is_empty());
        c[18] = 200;
        assert!(endpoints(&c).is_empty());
        assert_eq!(string_descriptor("A\u{e9}"), [6, 3, 0x41, 0, 0xe9, 0]);
        assert_eq!(string_descriptor(&"x".repeat(500)).len(), 254);
    }
}
