//! Encodes and decodes messages of the serial pose stream. Little-endian; each packet ends with the CRC-32C of the
//! bytes before it.

use crate::cobs::{self, encoded_bytes};
use crate::link::crc32c;

/// Longest packet, CRC included.
pub const MAX_PACKET: usize = 64;
/// Version that a HELLO announces.
pub const VERSION: u8 = 1;

/// A message of the stream.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SerialMessage {
    /// Device to host: at start-up, on request, and once a second.
    Hello {
        /// Format version, [`VERSION`].
        version: u8,
        /// Bodies that it tracks, numbered from 0.
        bodies: u8,
        /// Rate of its clock.
        ticks_per_second: u32,
    },
    /// Device to host: one pose of one body.
    Pose {
        /// Which body.
        body: u8,
        /// Whether the body is seen.
        tracked: bool,
        /// Counts the samples of this body, wraps.
        sequence: u32,
        /// Middle of the exposure, device ticks.
        captured: u64,
        /// Metres.
        position: [f32; 3],
        /// World-from-body, x y z w.
        rotation_xyzw: [f32; 4],
        /// Metres; 0 for unknown.
        mean_error: f32,
    },
    /// Host to device: requests a HELLO.
    HelloRequest,
    /// Host to device.
    EchoRequest {
        /// Returned in the answer.
        token: u64,
    },
    /// Device to host, at once.
    EchoResponse {
        /// From the request.
        token: u64,
        /// The device's clock when the request had arrived.
        ticks: u64,
    },
}

mod kind {
    pub(super) const POSE: u8 = 0x01;
    pub(super) const HELLO: u8 = 0x02;
    pub(super) const ECHO_REQUEST: u8 = 0x10;
    pub(super) const ECHO_RESPONSE: u8 = 0x11;
    pub(super) const HELLO_REQUEST: u8 = 0x12;
}

/// Why a packet does not belong to the stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SerialError {
    /// Too short for a CRC.
    #[error("a packet of {0} bytes")]
    Short(usize),
    /// Damaged in transit, or not of this format (wrong baud rate).
    #[error("checksum mismatch: noise, or the wrong baud rate?")]
    Crc,
    /// A kind or length of a later version.
    #[error("unknown packet of kind {kind:#04x} with {bytes} bytes")]
    Unknown {
        /// First byte.
        kind: u8,
        /// Bytes without the CRC.
        bytes: usize,
    },
}

impl SerialMessage {
    /// Reads an unstuffed packet.
    pub fn decode(packet: &[u8]) -> Result<Self, SerialError> {
        let Some((body, crc)) = packet.split_last_chunk::<4>().filter(|(b, _)| !b.is_empty()) else {
            return Err(SerialError::Short(packet.len()));
        };
        if crc32c(body) != u32::from_le_bytes(*crc) {
            return Err(SerialError::Crc);
        }
        let u32_at = |i: usize| u32::from_le_bytes([body[i], body[i + 1], body[i + 2], body[i + 3]]);
        let u64_at = |i: usize| u64::from(u32_at(i)) | u64::from(u32_at(i + 4)) << 32;
        let f32_at = |i: usize| f32::from_bits(u32_at(i));
        match (body[0], body.len()) {
            (kind::POSE, 52) => Ok(Self::Pose {
                body: body[1],
                tracked: body[2] & 1 != 0,
                sequence: u32_at(4),
                captured: u64_at(8),
                position: [f32_at(16), f32_at(20), f32_at(24)],
                rotation_xyzw: [f32_at(28), f32_at(32), f32_at(36), f32_at(40)],
                mean_error: f32_at(44),
            }),
            (kind::HELLO, 8) => {
                Ok(Self::Hello { version: body[1], bodies: body[2], ticks_per_second: u32_at(4) })
            }
            (kind::HELLO_REQUEST, 1) => Ok(Self::HelloRequest),
            (kind::ECHO_REQUEST, 9) => Ok(Self::EchoRequest { token: u64_at(1) }),
            (kind::ECHO_RESPONSE, 17) => Ok(Self::EchoResponse { token: u64_at(1), ticks: u64_at(9) }),
            (kind, bytes) => Err(SerialError::Unknown { kind, bytes }),
        }
    }

    /// Appends the packet, stuffed and with its delimiter, to `out`.
    pub fn encode(&self, out: &mut Vec<u8>) {
        let mut packet = [0u8; MAX_PACKET];
        let mut n = 0;
        let mut put = |bytes: &[u8]| {
            packet[n..n + bytes.len()].copy_from_slice(bytes);
            n += bytes.len();
        };
        match self {
            Self::Hello { version, bodies, ticks_per_second } => {
                put(&[kind::HELLO, *version, *bodies, 0]);
                put(&ticks_per_second.to_le_bytes());
            }
            Self::Pose { body, tracked, sequence, captured, position, rotation_xyzw, mean_error } => {
                put(&[kind::POSE, *body, u8::from(*tracked), 0]);
                put(&sequence.to_le_bytes());
                put(&captured.to_le_bytes());
                for value in position.iter().chain(rotation_xyzw).chain([mean_error]) {
                    put(&value.to_le_bytes());
                }
                // Reserved, zero.
                put(&[0; 4]);
            }
            Self::HelloRequest => put(&[kind::HELLO_REQUEST]),
            Self::EchoRequest { token } => {
                put(&[kind::ECHO_REQUEST]);
                put(&token.to_le_bytes());
            }
            Self::EchoResponse { token, ticks } => {
                put(&[kind::ECHO_RESPONSE]);
                put(&token.to_le_bytes());
                put(&ticks.to_le_bytes());
            }
        }
        let crc = crc32c(&packet[..n]);
        let start = out.len();
        out.resize(start + encoded_bytes(MAX_PACKET), 0);
        let stuffed = cobs::encode(&[&packet[..n], &crc.to_le_bytes()], &mut out[start..]);
        out.truncate(start + stuffed.expect("room for the longest packet"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cobs::Deframer;
    use proptest::prelude::*;

    const POSE: SerialMessage = SerialMessage::Pose {
        body: 1,
        tracked: true,
        sequence: 0x0403_0201,
        captured: 0x1817_1615_1413_1211,
        position: [1.0, 2.0, -1.0],
        rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
        mean_error: 0.5,
    };

    fn packet(message: &SerialMessage) -> Vec<u8> {
        let mut bytes = Vec::new();
        message.encode(&mut bytes);
        let mut packets = Vec::new();
        Deframer::new([0; MAX_PACKET]).push(&bytes, &mut |p| packets.push(p.to_vec()));
        assert_eq!(packets.len(), 1);
        packets.remove(0)
    }

    #[test]
    fn packets_byte_for_byte() {
        let mut expected = vec![1, 1, 1, 0, 1, 2, 3, 4, 0x11, 0x12, 0x13, 0x14, 0x15, 0x16, 0x17, 0x18];
        for word in [0x3f80_0000u32, 0x4000_0000, 0xbf80_0000, 0, 0, 0, 0x3f80_0000, 0x3f00_0000, 0] {
            expected.extend(word.to_le_bytes());
        }
        expected.extend(crc32c(&expected).to_le_bytes());
        assert_eq!(packet(&POSE), expected);
        let hello = SerialMessage::Hello { version: 1, bodies: 2, ticks_per_second: 1_000_000 };
        let mut expected = vec![2, 1, 2, 0, 0x40, 0x42, 0x0f, 0];
        expected.extend(crc32c(&expected).to_le_bytes());
        assert_eq!(packet(&hello), expected);
        let mut out = Vec::new();
        SerialMessage::EchoRequest { token: 1 }.encode(&mut out);
        // Kind and token stuffed around seven zeros, then the CRC of 10 01 00 00 00 00 00 00 00.
        assert_eq!(out[..9], [3, 0x10, 1, 1, 1, 1, 1, 1, 1]);
        assert_eq!(out.last(), Some(&0));
        let echo = SerialMessage::EchoResponse { token: 7, ticks: 9 };
        let request = SerialMessage::EchoRequest { token: u64::MAX };
        for message in [POSE, hello, echo, request, SerialMessage::HelloRequest] {
            assert_eq!(SerialMessage::decode(&packet(&message)), Ok(message));
        }
    }

    #[test]
    fn every_flipped_bit_is_noticed() {
        let good = packet(&POSE);
        for bit in 0..good.len() * 8 {
            let mut bad = good.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(SerialMessage::decode(&bad), Err(SerialError::Crc));
        }
        assert_eq!(SerialMessage::decode(&[1, 2, 3, 4]), Err(SerialError::Short(4)));
        let mut later = vec![0x33, 1];
        later.extend(crc32c(&later).to_le_bytes());
        assert_eq!(SerialMessage::decode(&later), Err(SerialError::Unknown { kind: 0x33, bytes: 2 }));
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 1000, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn any_packet_is_survived(mut bytes in proptest::collection::vec(any::<u8>(), 0..80), seal in any::<bool>()) {
            if seal {
                bytes.extend(crc32c(&bytes).to_le_bytes());
            }
            let _ = SerialMessage::decode(&bytes);
        }
    }
}
