//! The 32-byte header of a packet, and the three pieces of a packet on the wire.

use super::copy_block;
use super::crc::{crc32c, crc32c_append, BLOCK_BYTES};
use crate::time::DeviceTicks;

/// Longest payload of any message except PLANE: TRACKS of eight regions.
pub const MAX_CONTROL_BYTES: usize = 248;

/// First four bytes of every packet: `D P M L` in the order sent.
pub const MAGIC: [u8; 4] = *b"DPML";
/// Version of the protocol that this code speaks.
pub const VERSION: u8 = 2;
/// Bytes of a header.
pub const HEADER_BYTES: usize = 32;
/// Largest payload: the length field has 24 bits.
pub const MAX_PAYLOAD_BYTES: usize = (1 << 24) - 1;

/// What a packet carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum MessageType {
    /// Opens a session; the device answers with what it is.
    Hello = 1,
    /// One bit plane of a frame.
    Plane = 2,
    /// Ends a frame: from here it may be lit.
    FrameCommit = 3,
    /// The device's state, credits and counters.
    Status = 4,
    /// Clock exchange.
    Echo = 5,
    /// Raster, planes, frame rate, watchdog.
    Config = 6,
    /// The device refused something or latched a fault.
    Fault = 7,
    /// Dark, no longer armed.
    Stop = 8,
    /// Permission to make light.
    Arm = 9,
    /// Dark, still armed.
    Black = 10,
    /// Hold the frame that is lit.
    Freeze = 11,
    /// Dark and latched: light needs an ARM that acknowledges it.
    Safe = 12,
    /// Repairs the credit count after lost packets.
    Sync = 13,
    /// By how much regions of a frame are to be moved.
    Tracks = 14,
    /// Host to device: from which slot on slots begin earlier or later.
    Shift = 15,
}

impl MessageType {
    /// The type with this number, or `None`.
    pub const fn from_code(code: u8) -> Option<Self> {
        Some(match code {
            1 => Self::Hello,
            2 => Self::Plane,
            3 => Self::FrameCommit,
            4 => Self::Status,
            5 => Self::Echo,
            6 => Self::Config,
            7 => Self::Fault,
            8 => Self::Stop,
            9 => Self::Arm,
            10 => Self::Black,
            11 => Self::Freeze,
            12 => Self::Safe,
            13 => Self::Sync,
            14 => Self::Tracks,
            15 => Self::Shift,
            _ => return None,
        })
    }
}

/// The encoding of a PLANE payload.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Codec {
    /// The plane as it is.
    #[default]
    Raw = 0,
    /// Runs of equal bytes and literals.
    Rle = 1,
    /// RLE of the plane XOR the same plane of the base frame.
    XorRle = 2,
    /// One LZ4 block.
    Lz4 = 3,
}

impl Codec {
    /// The codec with this number, or `None`.
    pub const fn from_code(code: u8) -> Option<Self> {
        Some(match code {
            0 => Self::Raw,
            1 => Self::Rle,
            2 => Self::XorRle,
            3 => Self::Lz4,
            _ => return None,
        })
    }

    /// All codecs, as a mask.
    pub const ALL: u32 = 0b1111;

    /// This codec's bit in the masks that HELLO exchanges.
    pub const fn mask(self) -> u32 {
        1 << self as u8
    }
}

/// The fields of a header. Fields that a message does not use are 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// What the packet carries.
    pub kind: MessageType,
    /// Encoding of a PLANE payload.
    pub codec: Codec,
    /// Index of the plane in the configured order (PLANE only).
    pub plane: u8,
    /// Session the packet belongs to; 0 = none.
    pub session: u32,
    /// Frame the packet belongs to, modulo 2^32 (PLANE and FRAME_COMMIT).
    pub frame: u32,
    /// Instant at which the frame shall be lit (PLANE and FRAME_COMMIT), device's clock.
    pub target_at: DeviceTicks,
    /// Bytes of payload, at most [`MAX_PAYLOAD_BYTES`].
    pub payload_bytes: u32,
    /// Light of the plane as [`crate::planes::PlaneSpec::led_code`] (PLANE only).
    pub led_code: u8,
}

/// Why 32 bytes are not a header of this protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeaderError {
    /// The first four bytes are not [`MAGIC`].
    Magic,
    /// The checksum does not match.
    Checksum,
    /// A whole header of another protocol version.
    Version(u8),
    /// A whole header of a type that this version does not know.
    Type(u8),
    /// Reserved flag bits are set, a codec that this version does not know, or a codec on a message that has none.
    Flags(u8),
}

impl core::fmt::Display for HeaderError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Magic => f.write_str("no packet starts here"),
            Self::Checksum => f.write_str("header checksum does not match"),
            Self::Version(v) => write!(f, "protocol version {v}, this side speaks {VERSION}"),
            Self::Type(t) => write!(f, "unknown message type {t}"),
            Self::Flags(b) => write!(f, "unknown flags {b:#04x}"),
        }
    }
}

impl core::error::Error for HeaderError {}

impl Header {
    /// A header of a control message: everything that only frames use is 0.
    pub const fn control(kind: MessageType, session: u32, payload_bytes: u32) -> Self {
        Self {
            kind,
            codec: Codec::Raw,
            plane: 0,
            session,
            frame: 0,
            target_at: DeviceTicks(0),
            payload_bytes,
            led_code: 0,
        }
    }

    /// The 32 bytes on the wire.
    ///
    /// # Panics
    /// When the payload is longer than the length field can express: an error of the caller, never of the input.
    pub fn encode(&self) -> [u8; HEADER_BYTES] {
        assert!(self.payload_bytes as usize <= MAX_PAYLOAD_BYTES, "payload of {} bytes", self.payload_bytes);
        let mut b = [0u8; HEADER_BYTES];
        b[0..4].copy_from_slice(&MAGIC);
        b[4] = VERSION;
        b[5] = self.kind as u8;
        b[6] = self.codec as u8;
        b[7] = self.plane;
        b[8..12].copy_from_slice(&self.session.to_le_bytes());
        b[12..16].copy_from_slice(&self.frame.to_le_bytes());
        b[16..24].copy_from_slice(&self.target_at.0.to_le_bytes());
        b[24..27].copy_from_slice(&self.payload_bytes.to_le_bytes()[..3]);
        b[27] = self.led_code;
        let crc = crc32c(&b[..28]);
        b[28..32].copy_from_slice(&crc.to_le_bytes());
        b
    }

    /// Reads 32 bytes. [`HeaderError::Version`], [`HeaderError::Type`] and [`HeaderError::Flags`] are reported only when the
    /// checksum is right, so that [`Header::payload_bytes_of`] may be trusted to step over the packet.
    pub fn decode(b: &[u8; HEADER_BYTES]) -> Result<Self, HeaderError> {
        if b[0..4] != MAGIC {
            return Err(HeaderError::Magic);
        }
        if crc32c(&b[..28]) != u32_at(b, 28) {
            return Err(HeaderError::Checksum);
        }
        if b[4] != VERSION {
            return Err(HeaderError::Version(b[4]));
        }
        let kind = MessageType::from_code(b[5]).ok_or(HeaderError::Type(b[5]))?;
        let codec = Codec::from_code(b[6])
            .filter(|codec| kind == MessageType::Plane || *codec == Codec::Raw)
            .ok_or(HeaderError::Flags(b[6]))?;
        Ok(Self {
            kind,
            codec,
            plane: b[7],
            session: u32_at(b, 8),
            frame: u32_at(b, 12),
            target_at: DeviceTicks(u64_at(b, 16)),
            payload_bytes: Self::payload_bytes_of(b),
            led_code: b[27],
        })
    }

    /// The length field of a header, whatever its version or type: every version keeps it at bytes 24..27.
    pub fn payload_bytes_of(b: &[u8; HEADER_BYTES]) -> u32 {
        u32::from_le_bytes([b[24], b[25], b[26], 0])
    }
}

/// Bytes that follow a payload of `payload_bytes`: zeros up to a multiple of 4, then the payload's CRC-32C; nothing after
/// an empty payload.
pub const fn trailer_bytes(payload_bytes: usize) -> usize {
    if payload_bytes == 0 {
        0
    } else {
        (4 - payload_bytes % 4) % 4 + 4
    }
}

/// Bytes of a whole packet on the wire; always a multiple of 4.
pub const fn packet_bytes(payload_bytes: usize) -> usize {
    HEADER_BYTES + payload_bytes + trailer_bytes(payload_bytes)
}

/// A packet ready to send. The payload is borrowed, so a transport may gather instead of copying.
#[derive(Clone, Copy, Debug)]
pub struct Packet<'a> {
    header: [u8; HEADER_BYTES],
    payload: &'a [u8],
    /// None: padding and the checksum of the payload.
    trailer: Option<Trailer>,
}

impl<'a> Packet<'a> {
    /// Checksums the header; the payload is checksummed when the packet is written. The header's length field is set
    /// from `payload`.
    ///
    /// # Panics
    /// When `payload` is longer than [`MAX_PAYLOAD_BYTES`].
    pub fn new(header: Header, payload: &'a [u8]) -> Self {
        assert!(payload.len() <= MAX_PAYLOAD_BYTES, "payload of {} bytes", payload.len());
        let header = Header { payload_bytes: payload.len() as u32, ..header }.encode();
        Self { header, payload, trailer: None }
    }

    /// Exactly these bytes, unchecked, to test how a receiver treats a packet that is damaged, cut short or of another
    /// version. At most eight bytes of `trailer` are sent.
    pub fn from_raw(header: [u8; HEADER_BYTES], payload: &'a [u8], trailer: &[u8]) -> Self {
        let mut bytes = [0u8; 8];
        let n = trailer.len().min(bytes.len());
        bytes[..n].copy_from_slice(&trailer[..n]);
        Self { header, payload, trailer: Some(Trailer { bytes, len: n as u8 }) }
    }

    /// The first bytes of the packet.
    pub fn header(&self) -> &[u8; HEADER_BYTES] {
        &self.header
    }

    /// What follows the header; may be empty.
    pub fn payload(&self) -> &'a [u8] {
        self.payload
    }

    /// What follows the payload; empty where the payload is. Reads the whole payload:
    /// [`write_to`](Self::write_to) passes over it once for the copy and the checksum.
    pub fn trailer(&self) -> Trailer {
        self.trailer.unwrap_or_else(|| Trailer::new(self.payload.len(), crc32c(self.payload)))
    }

    /// Copies the whole packet to the beginning of `out` and returns [`wire_bytes`](Self::wire_bytes). The payload is
    /// read from memory once: each block is checksummed, and copied from the first-level cache.
    ///
    /// # Panics
    /// When `out` is shorter than the packet.
    pub fn write_to(&self, out: &mut [u8]) -> usize {
        let (to, rest) = out.split_at_mut(HEADER_BYTES);
        to.copy_from_slice(&self.header);
        let (to, rest) = rest.split_at_mut(self.payload.len());
        let trailer = match self.trailer {
            Some(trailer) => {
                to.copy_from_slice(self.payload);
                trailer
            }
            None => {
                let blocks = self.payload.chunks(BLOCK_BYTES).zip(to.chunks_mut(BLOCK_BYTES));
                let checksum = blocks.fold(0, |checksum, (block, to)| {
                    let checksum = crc32c_append(checksum, block);
                    copy_block(to, block);
                    checksum
                });
                Trailer::new(self.payload.len(), checksum)
            }
        };
        rest[..trailer.len()].copy_from_slice(&trailer);
        self.wire_bytes()
    }

    /// The whole packet, for tests and programs that may allocate.
    #[cfg(feature = "std")]
    pub fn to_vec(&self) -> Vec<u8> {
        let mut bytes = vec![0; self.wire_bytes()];
        self.write_to(&mut bytes);
        bytes
    }

    /// Bytes of the whole packet.
    pub fn wire_bytes(&self) -> usize {
        let trailer = self.trailer.map_or(trailer_bytes(self.payload.len()), |trailer| trailer.len());
        HEADER_BYTES + self.payload.len() + trailer
    }
}

/// The last bytes of a packet: padding and the payload's checksum.
#[derive(Clone, Copy, Debug)]
pub struct Trailer {
    bytes: [u8; 8],
    len: u8,
}

impl Trailer {
    /// For a payload of `payload_bytes`.
    fn new(payload_bytes: usize, checksum: u32) -> Self {
        let (mut bytes, len) = ([0u8; 8], trailer_bytes(payload_bytes));
        if len > 0 {
            bytes[len - 4..len].copy_from_slice(&checksum.to_le_bytes());
        }
        Self { bytes, len: len as u8 }
    }
}

impl core::ops::Deref for Trailer {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }
}

/// True when frame number `a` comes after `b`. Numbers wrap at 2^32: the one less than 2^31 steps ahead is the newer.
pub const fn frame_newer(a: u32, b: u32) -> bool {
    a.wrapping_sub(b) as i32 > 0
}

pub(crate) fn u16_at(b: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([b[at], b[at + 1]])
}

pub(crate) fn u32_at(b: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([b[at], b[at + 1], b[at + 2], b[at + 3]])
}

pub(crate) fn u64_at(b: &[u8], at: usize) -> u64 {
    u64::from(u32_at(b, at)) | u64::from(u32_at(b, at + 4)) << 32
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Plane 5 of frame 0x01020304 in session 0xA1B2C3D4, to be lit at tick 0x1122334455667788, blue bit 6, five bytes.
    /// Written by hand from docs/PROTOCOL.md; the checksums come from an independent bit-by-bit program.
    #[rustfmt::skip]
    const GOLDEN: [u8; 44] = [
        0x44, 0x50, 0x4d, 0x4c,  0x02, 0x02, 0x00, 0x05,
        0xd4, 0xc3, 0xb2, 0xa1,  0x04, 0x03, 0x02, 0x01,
        0x88, 0x77, 0x66, 0x55,  0x44, 0x33, 0x22, 0x11,
        0x05, 0x00, 0x00, 0x26,  0x1f, 0x11, 0xfb, 0xd1,
        0x80, 0x01, 0xff, 0x00,  0x3c, 0x00, 0x00, 0x00,
        0x18, 0xa4, 0x30, 0x1a,
    ];

    #[test]
    fn golden_plane_packet() {
        let header = Header {
            kind: MessageType::Plane,
            codec: Codec::Raw,
            plane: 5,
            session: 0xa1b2_c3d4,
            frame: 0x0102_0304,
            target_at: DeviceTicks(0x1122_3344_5566_7788),
            payload_bytes: 5,
            led_code: 0x26,
        };
        let packet = Packet::new(header, &[0x80, 0x01, 0xff, 0x00, 0x3c]);
        let mut wire = [0u8; 44];
        assert_eq!(packet.write_to(&mut wire), packet.wire_bytes());
        assert_eq!(wire, GOLDEN);
        assert_eq!([packet.header(), packet.payload(), &packet.trailer()].concat(), GOLDEN);
        assert_eq!(Header::decode(GOLDEN[..32].try_into().unwrap()), Ok(header));
    }

    /// The checksum of a payload that is copied block by block is that of the whole.
    #[test]
    fn a_long_packet_is_the_same_whether_written_or_put_together() {
        for len in [0, 1, BLOCK_BYTES - 1, BLOCK_BYTES, BLOCK_BYTES + 1, 3 * BLOCK_BYTES + 7] {
            let payload: Vec<u8> = (0..len).map(|i| (i * 31 / 8) as u8).collect();
            let packet = Packet::new(Header::control(MessageType::Plane, 9, 0), &payload);
            assert_eq!(
                packet.to_vec(),
                [&packet.header()[..], &payload, &packet.trailer()].concat(),
                "{len} bytes"
            );
        }
    }

    #[test]
    fn every_single_bit_flip_of_a_header_is_noticed() {
        for bit in 0..256 {
            let mut b: [u8; 32] = GOLDEN[..32].try_into().unwrap();
            b[bit / 8] ^= 1 << (bit % 8);
            assert!(
                matches!(Header::decode(&b), Err(HeaderError::Magic | HeaderError::Checksum)),
                "flip of bit {bit}"
            );
        }
    }

    #[test]
    fn foreign_headers_are_named_and_can_be_stepped_over() {
        for (at, value, expected) in [
            (4, 9, HeaderError::Version(9)),
            (5, 77, HeaderError::Type(77)),
            (6, 0x80, HeaderError::Flags(0x80)),
        ] {
            let mut b: [u8; 32] = GOLDEN[..32].try_into().unwrap();
            b[at] = value;
            let crc = crc32c(&b[..28]);
            b[28..].copy_from_slice(&crc.to_le_bytes());
            assert_eq!(Header::decode(&b), Err(expected));
            assert_eq!(Header::payload_bytes_of(&b), 5);
        }
        // Only planes have a codec.
        let mut b = Header::control(MessageType::Sync, 1, 4).encode();
        b[6] = Codec::Rle as u8;
        let crc = crc32c(&b[..28]);
        b[28..].copy_from_slice(&crc.to_le_bytes());
        assert_eq!(Header::decode(&b), Err(HeaderError::Flags(1)));
    }

    #[test]
    fn frame_numbers_wrap() {
        assert!(frame_newer(1, 0) && frame_newer(0, u32::MAX) && frame_newer(5, u32::MAX - 5));
        assert!(!frame_newer(0, 0) && !frame_newer(0, 1) && !frame_newer(u32::MAX, 0));
        assert!(frame_newer(0x7fff_ffff, 0) && !frame_newer(0x8000_0001, 0));
    }
}
