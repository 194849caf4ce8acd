//! One packet on a wire: header, payload, checksum; and how packets are found in a stream of bytes.
//!
//! What the payloads mean is [`crate::link`]'s. Everything here is `no_std` without allocation: docs/PROTOCOL.md is the specification.

mod crc;
mod decoder;
mod header;

pub use crc::{crc32c, crc32c_append, crc32c_append_table};
pub use decoder::{Decoder, DecoderCounters, PacketSink};
pub use header::{
    frame_newer, packet_bytes, trailer_bytes, Codec, Header, HeaderError, MessageType, Packet, Trailer,
    HEADER_BYTES, MAGIC, MAX_CONTROL_BYTES, MAX_PAYLOAD_BYTES, VERSION,
};
pub(crate) use header::{u16_at, u32_at, u64_at};
