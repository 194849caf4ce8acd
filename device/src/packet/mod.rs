//! One packet on a wire: header, payload, checksum; and how packets are found in a stream of bytes.
//!
//! What the payloads mean is [`crate::link`]'s. Everything here is `no_std` without allocation: docs/PROTOCOL.md is the specification.

mod crc;
mod decoder;
mod header;
#[cfg(all(feature = "std", target_arch = "x86_64"))]
mod stream;

pub use crc::{crc32c, crc32c_append, crc32c_append_table};
pub use decoder::{Decoder, DecoderCounters, PacketSink};
pub use header::{
    frame_newer, packet_bytes, trailer_bytes, Codec, Header, HeaderError, MessageType, Packet, Trailer,
    HEADER_BYTES, MAGIC, MAX_CONTROL_BYTES, MAX_PAYLOAD_BYTES, VERSION,
};
pub(crate) use header::{u16_at, u32_at, u64_at};

/// Copies a block of a payload to where this core does not read it again: past its caches where there is a way and the
/// block is a whole one, of a frame that is larger than they are.
pub(crate) fn copy_block(to: &mut [u8], from: &[u8]) {
    #[cfg(all(feature = "std", target_arch = "x86_64"))]
    if from.len() >= crc::BLOCK_BYTES {
        return stream::copy(to, from);
    }
    to.copy_from_slice(from);
}
