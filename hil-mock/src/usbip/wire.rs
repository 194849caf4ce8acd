//! Encodes and decodes USB/IP messages (version 1.1.1). All numbers are big-endian.
//!
//! A connection starts with one operation: a list of devices, or the import of one. After an import the same connection carries
//! URBs: 48-byte headers, followed by data for OUT submissions and IN returns. \[Linux Documentation/usb/usbip_protocol.rst\]

use std::io::{self, Read};

use crate::usb_model::Setup;

/// Protocol version in every operation.
pub const VERSION: u16 = 0x0111;
/// Bytes of every URB header.
pub const URB_HEADER: usize = 48;
/// Bytes of a device's record.
pub const DEVICE_RECORD: usize = 312;
/// Maximum number of bytes of one transfer.
pub const MOST_BYTES: u32 = 64 << 20;

const REQUEST_LIST: u16 = 0x8005;
const REPLY_LIST: u16 = 0x0005;
const REQUEST_IMPORT: u16 = 0x8003;
const REPLY_IMPORT: u16 = 0x0003;

/// Names and properties of a device, as in the list and the import reply.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeviceRecord {
    /// Path on the exporting machine.
    pub path: String,
    /// Bus identifier, by which it is imported.
    pub bus_id: String,
    /// Bus number.
    pub bus: u32,
    /// Device number.
    pub device: u32,
    /// Speed as the kernel numbers it.
    pub speed: u32,
    /// Bytes 8 to 13 of the device descriptor as numbers: vendor, product, release.
    pub ids: [u16; 3],
    /// Class, subclass, protocol, configuration value, number of configurations, number of interfaces.
    pub bytes: [u8; 6],
}

fn text(out: &mut Vec<u8>, s: &str, field: usize) {
    let n = s.len().min(field - 1);
    out.extend_from_slice(&s.as_bytes()[..n]);
    out.resize(out.len() + field - n, 0);
}

fn text_of(b: &[u8]) -> String {
    let end = b.iter().position(|c| *c == 0).unwrap_or(b.len());
    String::from_utf8_lossy(&b[..end]).into_owned()
}

fn u32_at(b: &[u8], at: usize) -> u32 {
    u32::from_be_bytes([b[at], b[at + 1], b[at + 2], b[at + 3]])
}

impl DeviceRecord {
    /// The 312 bytes.
    pub fn encode(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(DEVICE_RECORD);
        text(&mut out, &self.path, 256);
        text(&mut out, &self.bus_id, 32);
        for n in [self.bus, self.device, self.speed] {
            out.extend_from_slice(&n.to_be_bytes());
        }
        for n in self.ids {
            out.extend_from_slice(&n.to_be_bytes());
        }
        out.extend_from_slice(&self.bytes);
        out
    }

    /// Reads the 312 bytes.
    pub fn decode(b: &[u8; DEVICE_RECORD]) -> Self {
        let id = |at: usize| u16::from_be_bytes([b[at], b[at + 1]]);
        Self {
            path: text_of(&b[..256]),
            bus_id: text_of(&b[256..288]),
            bus: u32_at(b, 288),
            device: u32_at(b, 292),
            speed: u32_at(b, 296),
            ids: [id(300), id(302), id(304)],
            bytes: [b[306], b[307], b[308], b[309], b[310], b[311]],
        }
    }
}

/// The first request of a client.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Operation {
    /// A list of devices.
    List,
    /// The device with this bus identifier.
    Import(String),
}

fn operation(code: u16, status: u32) -> Vec<u8> {
    [&VERSION.to_be_bytes()[..], &code.to_be_bytes(), &status.to_be_bytes()].concat()
}

impl Operation {
    /// The bytes.
    pub fn encode(&self) -> Vec<u8> {
        match self {
            Self::List => operation(REQUEST_LIST, 0),
            Self::Import(bus_id) => {
                let mut out = operation(REQUEST_IMPORT, 0);
                text(&mut out, bus_id, 32);
                out
            }
        }
    }

    /// Reads one; anything but these two is an error.
    pub fn read(from: &mut impl Read) -> io::Result<Self> {
        let mut head = [0; 8];
        from.read_exact(&mut head)?;
        match (u16::from_be_bytes([head[0], head[1]]), u16::from_be_bytes([head[2], head[3]])) {
            (VERSION, REQUEST_LIST) => Ok(Self::List),
            (VERSION, REQUEST_IMPORT) => {
                let mut bus_id = [0; 32];
                from.read_exact(&mut bus_id)?;
                Ok(Self::Import(text_of(&bus_id)))
            }
            (version, code) => Err(bad(format!("operation {code:#06x} of version {version:#06x}"))),
        }
    }
}

fn bad(what: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, what)
}

/// Class, subclass and protocol of an interface.
pub type InterfaceClass = (u8, u8, u8);

/// The reply to [`Operation::List`]: every device with its interfaces' (class, subclass, protocol).
pub fn list_reply(devices: &[(DeviceRecord, Vec<InterfaceClass>)]) -> Vec<u8> {
    let mut out = operation(REPLY_LIST, 0);
    out.extend_from_slice(&(devices.len() as u32).to_be_bytes());
    for (record, interfaces) in devices {
        out.extend(record.encode());
        for (class, subclass, protocol) in interfaces {
            out.extend_from_slice(&[*class, *subclass, *protocol, 0]);
        }
    }
    out
}

/// Reads the reply to [`Operation::List`], at most 256 devices.
pub fn read_list_reply(from: &mut impl Read) -> io::Result<Vec<DeviceRecord>> {
    let mut head = [0; 12];
    from.read_exact(&mut head)?;
    if head[..4] != [0x01, 0x11, 0x00, 0x05] {
        return Err(bad("not a device list".into()));
    }
    let count = u32_at(&head, 8);
    if count > 256 {
        return Err(bad(format!("{count} devices")));
    }
    let mut devices = Vec::new();
    for _ in 0..count {
        let mut record = [0; DEVICE_RECORD];
        from.read_exact(&mut record)?;
        let record = DeviceRecord::decode(&record);
        let mut interfaces = [0; 4 * 255];
        from.read_exact(&mut interfaces[..4 * usize::from(record.bytes[5])])?;
        devices.push(record);
    }
    Ok(devices)
}

/// The reply to [`Operation::Import`]; `None` when the device is unknown or in use.
pub fn import_reply(device: Option<&DeviceRecord>) -> Vec<u8> {
    let mut out = operation(REPLY_IMPORT, u32::from(device.is_none()));
    out.extend(device.map(DeviceRecord::encode).unwrap_or_default());
    out
}

/// Reads the reply to [`Operation::Import`].
pub fn read_import_reply(from: &mut impl Read) -> io::Result<DeviceRecord> {
    let mut head = [0; 8];
    from.read_exact(&mut head)?;
    if head[..4] != [0x01, 0x11, 0x00, 0x03] {
        return Err(bad("not an import reply".into()));
    }
    if u32_at(&head, 4) != 0 {
        return Err(io::Error::new(io::ErrorKind::NotFound, "the device is unknown there or in use"));
    }
    let mut record = [0; DEVICE_RECORD];
    from.read_exact(&mut record)?;
    Ok(DeviceRecord::decode(&record))
}

/// An URB message's header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Urb {
    /// Host to device: a transfer. OUT data follow.
    Submit {
        /// Its number.
        seqnum: u32,
        /// Bus number in the high half, device number in the low.
        devid: u32,
        /// Endpoint address with the direction in bit 7; 0 for control whatever its direction.
        endpoint: u8,
        /// IN.
        is_in: bool,
        /// Kernel's transfer flags: 1 short is an error, 0x40 end with a zero-length packet.
        flags: u32,
        /// Bytes to send or to request.
        length: u32,
        /// Isochronous packets; 0 or -1 for everything else.
        packets: u32,
        /// Polling interval.
        interval: u32,
        /// Setup packet of a control transfer.
        setup: Setup,
    },
    /// Host to device: cancel a transfer.
    Unlink {
        /// Its own number.
        seqnum: u32,
        /// Device as in `Submit`.
        devid: u32,
        /// The number of the transfer.
        victim: u32,
    },
    /// Device to host: a transfer has ended. IN data follow.
    Submitted {
        /// The transfer's number.
        seqnum: u32,
        /// 0 or a negative error number.
        status: i32,
        /// Bytes moved.
        actual: u32,
    },
    /// Device to host: a transfer was cancelled (-104) or had ended before (0).
    Unlinked {
        /// The unlink's number.
        seqnum: u32,
        /// See above.
        status: i32,
    },
}

const FLAG_DIR_IN: u32 = 0x0200;

impl Urb {
    /// The 48 bytes.
    pub fn encode(&self) -> [u8; URB_HEADER] {
        let mut b = [0; URB_HEADER];
        let mut put = |at: usize, n: u32| b[at..at + 4].copy_from_slice(&n.to_be_bytes());
        match *self {
            Self::Submit { seqnum, devid, endpoint, is_in, flags, length, packets, interval, setup } => {
                let words = [
                    1,
                    seqnum,
                    devid,
                    u32::from(is_in),
                    u32::from(endpoint & 0x0f),
                    flags,
                    length,
                    0,
                    packets,
                    interval,
                ];
                words.iter().enumerate().for_each(|(i, w)| put(4 * i, *w));
                b[40..48].copy_from_slice(&setup.to_bytes());
            }
            Self::Unlink { seqnum, devid, victim } => {
                [2, seqnum, devid, 0, 0, victim].iter().enumerate().for_each(|(i, w)| put(4 * i, *w));
            }
            Self::Submitted { seqnum, status, actual } => {
                [3, seqnum, 0, 0, 0, status as u32, actual]
                    .iter()
                    .enumerate()
                    .for_each(|(i, w)| put(4 * i, *w));
            }
            Self::Unlinked { seqnum, status } => {
                [4, seqnum, 0, 0, 0, status as u32].iter().enumerate().for_each(|(i, w)| put(4 * i, *w));
            }
        }
        b
    }

    /// Reads the 48 bytes; refuses invalid values before anything is allocated for them.
    pub fn decode(b: &[u8; URB_HEADER]) -> io::Result<Self> {
        let at = |i: usize| u32_at(b, 4 * i);
        let seqnum = at(1);
        match at(0) {
            1 => {
                let (direction, number, length) = (at(3), at(4), at(6));
                if direction > 1 || number > 15 || length > MOST_BYTES {
                    return Err(bad(format!(
                        "transfer of {length} bytes, direction {direction}, endpoint {number}"
                    )));
                }
                let is_in = direction == 1;
                let endpoint = if number == 0 { 0 } else { number as u8 | u8::from(is_in) << 7 };
                let mut setup = [0; 8];
                setup.copy_from_slice(&b[40..]);
                let setup = Setup::from_bytes(setup);
                let (devid, flags, packets, interval) = (at(2), at(5) & !FLAG_DIR_IN, at(8), at(9));
                Ok(Self::Submit { seqnum, devid, endpoint, is_in, flags, length, packets, interval, setup })
            }
            2 => Ok(Self::Unlink { seqnum, devid: at(2), victim: at(5) }),
            3 if at(6) <= MOST_BYTES => Ok(Self::Submitted { seqnum, status: at(5) as i32, actual: at(6) }),
            4 => Ok(Self::Unlinked { seqnum, status: at(5) as i32 }),
            other => Err(bad(format!("URB message {other}"))),
        }
    }
}
