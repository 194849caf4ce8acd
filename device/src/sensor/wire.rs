//! Encodes and decodes the messages of a light sensor. Little-endian; each packet ends with the CRC-32C of the bytes
//! before it, and is one COBS frame on the line.

use crate::cobs::{self, encoded_bytes};
use crate::link::crc32c;

/// Version that a HELLO announces.
pub const VERSION: u8 = 1;
/// Most samples of a block.
pub const MAX_SAMPLES: usize = 256;
/// Bytes of a block before its levels.
const BLOCK_HEAD: usize = 28;
/// Longest packet, CRC included.
pub const MAX_PACKET: usize = BLOCK_HEAD + 2 * MAX_SAMPLES + 4;
/// Longest packet on the line, with stuffing and delimiter.
pub const MAX_FRAME: usize = encoded_bytes(MAX_PACKET);
/// Longest packet of the host, CRC included.
pub const MAX_HOST_PACKET: usize = 16;
/// Gain settings that a sensor may have.
pub const MAX_GAINS: usize = 8;
/// Bytes of a sensor's name.
pub const NAME_BYTES: usize = 16;
/// Fractions of a tick in [`BlockHead::period`].
pub const PERIOD_ONE: u32 = 1 << 16;

mod kind {
    pub(super) const SAMPLES: u8 = 0x01;
    pub(super) const HELLO: u8 = 0x02;
    pub(super) const REFUSED: u8 = 0x03;
    pub(super) const ECHO_REQUEST: u8 = 0x10;
    pub(super) const ECHO_RESPONSE: u8 = 0x11;
    pub(super) const HELLO_REQUEST: u8 = 0x12;
    pub(super) const START: u8 = 0x13;
    pub(super) const STOP: u8 = 0x14;
    pub(super) const CONFIGURE: u8 = 0x15;
}

/// Bits of a level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum LevelBits {
    /// 0 to 4095, two levels in three bytes.
    Twelve = 12,
    /// 0 to 65535, two bytes each.
    Sixteen = 16,
}

impl LevelBits {
    /// The highest level.
    pub const fn highest(self) -> u16 {
        match self {
            Self::Twelve => 0x0fff,
            Self::Sixteen => u16::MAX,
        }
    }

    /// Bytes of `count` levels.
    const fn bytes(self, count: usize) -> usize {
        match self {
            Self::Twelve => count + count.div_ceil(2),
            Self::Sixteen => 2 * count,
        }
    }

    const fn from_byte(byte: u8) -> Option<Self> {
        match byte {
            12 => Some(Self::Twelve),
            16 => Some(Self::Sixteen),
            _ => None,
        }
    }
}

/// What a sensor is, and what it does at the moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SensorHello {
    /// Format version, [`VERSION`].
    pub version: u8,
    /// Bits of its levels.
    pub bits: LevelBits,
    /// It streams.
    pub running: bool,
    /// Rate of its clock.
    pub ticks_per_second: u32,
    /// Rate of its samples, now.
    pub samples_per_second: u32,
    /// A level of this or less is cut off below.
    pub floor: u16,
    /// A level of this or more is cut off above.
    pub ceiling: u16,
    /// Tells sensors apart.
    pub serial: u64,
    /// Its name in ASCII, filled up with zeros.
    pub name: [u8; NAME_BYTES],
    /// Gain of each setting in thousandths of the first one's; 0 for settings that it does not have.
    pub gains_milli: [u32; MAX_GAINS],
    /// The setting in force, an index into `gains_milli`.
    pub gain: u8,
}

impl SensorHello {
    /// The name as text; what is not printable ASCII is left out.
    #[cfg(feature = "std")]
    pub fn name_text(&self) -> String {
        let printable = |b: &&u8| b.is_ascii_graphic() || **b == b' ';
        self.name.iter().take_while(|b| **b != 0).filter(printable).map(|b| char::from(*b)).collect()
    }
}

/// A block of samples without their levels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlockHead {
    /// Counts the blocks made since START, also those that were never sent; wraps.
    pub sequence: u32,
    /// The sensor's clock in the middle of the first sample.
    pub first: u64,
    /// From sample to sample, in units of 1 / [`PERIOD_ONE`] tick, at least 1.
    pub period: u32,
    /// Blocks since START that the sensor had no room for; wraps.
    pub lost: u32,
    /// The gain setting of all samples.
    pub gain: u8,
    /// A sample is at the floor or below.
    pub cut_below: bool,
    /// A sample is at the ceiling or above.
    pub cut_above: bool,
}

impl BlockHead {
    /// The sensor's clock in the middle of sample `index`, rounded down to ticks, and the rest in units of
    /// 1 / [`PERIOD_ONE`] tick. The clock wraps at 2^64.
    pub const fn ticks_of(&self, index: usize) -> (u64, u32) {
        let after = index as u64 * self.period as u64;
        (self.first.wrapping_add(after / PERIOD_ONE as u64), (after % PERIOD_ONE as u64) as u32)
    }
}

/// The levels of a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Levels<'a> {
    /// As numbers, to be sent with so many bits.
    Values(LevelBits, &'a [u16]),
    /// As they came: bits, count and bytes.
    Packed(LevelBits, u16, &'a [u8]),
}

impl<'a> Levels<'a> {
    /// Bits of each.
    pub const fn bits(&self) -> LevelBits {
        match self {
            Self::Values(bits, _) | Self::Packed(bits, ..) => *bits,
        }
    }

    /// Number of levels.
    pub const fn len(&self) -> usize {
        match self {
            Self::Values(_, values) => values.len(),
            Self::Packed(_, count, _) => *count as usize,
        }
    }

    /// True without levels. A block on the wire has at least one.
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The levels in order.
    pub fn iter(&self) -> impl Iterator<Item = u16> + 'a {
        let this = *self;
        (0..this.len()).map(move |i| this.get(i))
    }

    fn get(&self, i: usize) -> u16 {
        match *self {
            Self::Values(bits, values) => values[i].min(bits.highest()),
            Self::Packed(LevelBits::Sixteen, _, bytes) => {
                u16::from_le_bytes([bytes[2 * i], bytes[2 * i + 1]])
            }
            Self::Packed(LevelBits::Twelve, _, bytes) => {
                let at = i + i / 2;
                let both = u16::from(bytes[at]) | u16::from(bytes[at + 1]) << 8;
                if i.is_multiple_of(2) {
                    both & 0x0fff
                } else {
                    both >> 4
                }
            }
        }
    }

    /// Writes them packed.
    fn put(&self, put: &mut Put<'_>) -> Option<()> {
        match self.bits() {
            LevelBits::Sixteen => self.iter().try_for_each(|level| put.bytes(&level.to_le_bytes())),
            LevelBits::Twelve => (0..self.len()).step_by(2).try_for_each(|i| {
                let a = self.get(i);
                if i + 1 == self.len() {
                    return put.bytes(&a.to_le_bytes());
                }
                let b = self.get(i + 1);
                put.bytes(&[a as u8, (a >> 8 | b << 4) as u8, (b >> 4) as u8])
            }),
        }
    }
}

/// Why a sensor refuses what the host asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Refusal {
    /// It has no such gain setting.
    Gain = 1,
    /// It cannot sample at this rate.
    Rate = 2,
    /// A block has 1 to [`MAX_SAMPLES`] samples.
    Block = 3,
    /// Not while it streams: STOP comes first.
    Running = 4,
}

impl Refusal {
    const fn from_byte(byte: u8) -> Option<Self> {
        match byte {
            1 => Some(Self::Gain),
            2 => Some(Self::Rate),
            3 => Some(Self::Block),
            4 => Some(Self::Running),
            _ => None,
        }
    }
}

/// A message between host and sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SensorMessage<'a> {
    /// Sensor to host: consecutive samples.
    Samples(BlockHead, Levels<'a>),
    /// Sensor to host: at start-up, on request, once a second, and as the answer to START, STOP and CONFIGURE.
    Hello(SensorHello),
    /// Sensor to host: the answer to a CONFIGURE or START that it does not follow.
    Refused(Refusal),
    /// Host to sensor: asks for a HELLO.
    HelloRequest,
    /// Host to sensor.
    EchoRequest {
        /// Returned in the answer.
        token: u64,
    },
    /// Sensor to host, at once.
    EchoResponse {
        /// From the request.
        token: u64,
        /// The sensor's clock when the request had arrived.
        ticks: u64,
    },
    /// Host to sensor: stream.
    Start,
    /// Host to sensor: stop streaming.
    Stop,
    /// Host to sensor, while it does not stream.
    Configure {
        /// Gain setting.
        gain: u8,
        /// Samples of each block, 1 to [`MAX_SAMPLES`].
        block: u16,
        /// Samples a second; 0 keeps the rate.
        samples_per_second: u32,
    },
}

/// Why a packet does not belong to the stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "std", derive(thiserror::Error))]
pub enum SensorError {
    /// Too short for a CRC.
    #[cfg_attr(feature = "std", error("a packet of {0} bytes"))]
    Short(usize),
    /// Damaged in transit, or not of this format (wrong baud rate).
    #[cfg_attr(feature = "std", error("checksum mismatch: noise, or the wrong baud rate?"))]
    Crc,
    /// A kind or length of a later version, or a field that no sensor may send.
    #[cfg_attr(feature = "std", error("unknown packet of kind {kind:#04x} with {bytes} bytes"))]
    Unknown {
        /// First byte.
        kind: u8,
        /// Bytes without the CRC.
        bytes: usize,
    },
}

/// Writes into a packet.
struct Put<'a> {
    to: &'a mut [u8],
    at: usize,
}

impl Put<'_> {
    fn bytes(&mut self, bytes: &[u8]) -> Option<()> {
        self.to.get_mut(self.at..self.at + bytes.len())?.copy_from_slice(bytes);
        self.at += bytes.len();
        Some(())
    }
}

/// Reads a packet whose length is known.
struct Take<'a>(&'a [u8]);

impl Take<'_> {
    fn u16(&self, at: usize) -> u16 {
        u16::from_le_bytes([self.0[at], self.0[at + 1]])
    }

    fn u32(&self, at: usize) -> u32 {
        u32::from(self.u16(at)) | u32::from(self.u16(at + 2)) << 16
    }

    fn u64(&self, at: usize) -> u64 {
        u64::from(self.u32(at)) | u64::from(self.u32(at + 4)) << 32
    }
}

impl<'a> SensorMessage<'a> {
    /// Reads an unstuffed packet.
    ///
    /// # Errors
    /// It is damaged, or of another format.
    pub fn decode(packet: &'a [u8]) -> Result<Self, SensorError> {
        let Some((body, crc)) = packet.split_last_chunk::<4>().filter(|(b, _)| !b.is_empty()) else {
            return Err(SensorError::Short(packet.len()));
        };
        if crc32c(body) != u32::from_le_bytes(*crc) {
            return Err(SensorError::Crc);
        }
        Self::read(body).ok_or(SensorError::Unknown { kind: body[0], bytes: body.len() })
    }

    fn read(body: &'a [u8]) -> Option<Self> {
        let take = Take(body);
        match (body[0], body.len()) {
            (kind::SAMPLES, BLOCK_HEAD..) => Self::read_samples(body),
            (kind::HELLO, 76) => Self::read_hello(body),
            (kind::REFUSED, 4) => Refusal::from_byte(body[1]).map(Self::Refused),
            (kind::HELLO_REQUEST, 1) => Some(Self::HelloRequest),
            (kind::START, 1) => Some(Self::Start),
            (kind::STOP, 1) => Some(Self::Stop),
            (kind::ECHO_REQUEST, 9) => Some(Self::EchoRequest { token: take.u64(1) }),
            (kind::ECHO_RESPONSE, 17) => Some(Self::EchoResponse { token: take.u64(1), ticks: take.u64(9) }),
            (kind::CONFIGURE, 8) => {
                Some(Self::Configure { gain: body[1], block: take.u16(2), samples_per_second: take.u32(4) })
            }
            _ => None,
        }
    }

    fn read_samples(body: &'a [u8]) -> Option<Self> {
        let (head, levels) = body.split_at(BLOCK_HEAD);
        let take = Take(head);
        let (bits, count) = (LevelBits::from_byte(head[1])?, take.u16(2));
        let is_sized = levels.len() == bits.bytes(usize::from(count));
        let period = take.u32(16);
        if count == 0 || usize::from(count) > MAX_SAMPLES || !is_sized || period == 0 {
            return None;
        }
        let head = BlockHead {
            sequence: take.u32(4),
            first: take.u64(8),
            period,
            lost: take.u32(20),
            gain: head[24],
            cut_below: head[25] & 1 != 0,
            cut_above: head[25] & 2 != 0,
        };
        Some(Self::Samples(head, Levels::Packed(bits, count, levels)))
    }

    fn read_hello(body: &[u8]) -> Option<Self> {
        let take = Take(body);
        let mut name = [0; NAME_BYTES];
        name.copy_from_slice(&body[24..24 + NAME_BYTES]);
        Some(Self::Hello(SensorHello {
            version: body[1],
            bits: LevelBits::from_byte(body[2])?,
            running: body[3] & 1 != 0,
            ticks_per_second: take.u32(4),
            samples_per_second: take.u32(8),
            floor: take.u16(12),
            ceiling: take.u16(14),
            serial: take.u64(16),
            name,
            gains_milli: core::array::from_fn(|i| take.u32(40 + 4 * i)),
            gain: body[72],
        }))
    }

    /// Writes the packet, stuffed and with its delimiter, into `out`; returns its length. [`MAX_FRAME`] bytes always
    /// suffice. `None` if `out` is too short, or for a block without samples or with more than [`MAX_SAMPLES`].
    pub fn encode(&self, out: &mut [u8]) -> Option<usize> {
        let mut packet = [0u8; MAX_PACKET];
        let mut put = Put { to: &mut packet, at: 0 };
        self.put(&mut put)?;
        let n = put.at;
        let crc = crc32c(&packet[..n]);
        cobs::encode(&[&packet[..n], &crc.to_le_bytes()], out)
    }

    fn put(&self, put: &mut Put<'_>) -> Option<()> {
        match self {
            Self::Samples(head, levels) => {
                if levels.is_empty() || levels.len() > MAX_SAMPLES || head.period == 0 {
                    return None;
                }
                put.bytes(&[kind::SAMPLES, levels.bits() as u8])?;
                put.bytes(&(levels.len() as u16).to_le_bytes())?;
                put.bytes(&head.sequence.to_le_bytes())?;
                put.bytes(&head.first.to_le_bytes())?;
                put.bytes(&head.period.to_le_bytes())?;
                put.bytes(&head.lost.to_le_bytes())?;
                let cut = u8::from(head.cut_below) | u8::from(head.cut_above) << 1;
                put.bytes(&[head.gain, cut, 0, 0])?;
                levels.put(put)
            }
            Self::Hello(hello) => {
                put.bytes(&[kind::HELLO, hello.version, hello.bits as u8, u8::from(hello.running)])?;
                put.bytes(&hello.ticks_per_second.to_le_bytes())?;
                put.bytes(&hello.samples_per_second.to_le_bytes())?;
                put.bytes(&hello.floor.to_le_bytes())?;
                put.bytes(&hello.ceiling.to_le_bytes())?;
                put.bytes(&hello.serial.to_le_bytes())?;
                put.bytes(&hello.name)?;
                hello.gains_milli.iter().try_for_each(|gain| put.bytes(&gain.to_le_bytes()))?;
                put.bytes(&[hello.gain, 0, 0, 0])
            }
            Self::Refused(why) => put.bytes(&[kind::REFUSED, *why as u8, 0, 0]),
            Self::HelloRequest => put.bytes(&[kind::HELLO_REQUEST]),
            Self::Start => put.bytes(&[kind::START]),
            Self::Stop => put.bytes(&[kind::STOP]),
            Self::EchoRequest { token } => {
                put.bytes(&[kind::ECHO_REQUEST])?;
                put.bytes(&token.to_le_bytes())
            }
            Self::EchoResponse { token, ticks } => {
                put.bytes(&[kind::ECHO_RESPONSE])?;
                put.bytes(&token.to_le_bytes())?;
                put.bytes(&ticks.to_le_bytes())
            }
            Self::Configure { gain, block, samples_per_second } => {
                put.bytes(&[kind::CONFIGURE, *gain])?;
                put.bytes(&block.to_le_bytes())?;
                put.bytes(&samples_per_second.to_le_bytes())
            }
        }
    }
}

#[cfg(test)]
#[path = "wire_tests.rs"]
mod tests;
