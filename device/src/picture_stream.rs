//! Pictures of a camera over a stream of bytes: what `hil-mock serve camera` sends and `tracker.device = "tcp:..."` reads.
//!
//! Each picture is a header of [`HEADER_BYTES`] and its grey pixels, rows from above. Numbers are little-endian: the magic,
//! width u32, height u32, number u32, reserved u32, begin of the exposure of the first row i64 (ns of CLOCK_MONOTONIC of the
//! sender's machine, which must be the reader's), exposure i64 ns, delay from row to row i64 ns, CRC-32C of all before it.

use crate::link::crc32c;

/// Begins every header.
pub const MAGIC: [u8; 8] = *b"dpmpict1";
/// Bytes of a header.
pub const HEADER_BYTES: usize = 52;
/// Pixels a side that a picture has at least and at most.
pub const SIDES: core::ops::RangeInclusive<u32> = 16..=8192;
/// The longest exposure and the longest delay from row to row, nanoseconds.
const LONGEST_NS: i64 = 10_000_000_000;

/// What stands before the pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PictureHeader {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Of the picture; wraps.
    pub number: u32,
    /// Begin of the exposure of the first row, ns of CLOCK_MONOTONIC.
    pub begin_ns: i64,
    /// Exposure of a row, ns.
    pub exposure_ns: i64,
    /// By how much later each row is exposed than the one above it, ns.
    pub row_ns: i64,
}

impl PictureHeader {
    /// As bytes.
    pub fn encode(&self) -> [u8; HEADER_BYTES] {
        let mut out = [0; HEADER_BYTES];
        out[..8].copy_from_slice(&MAGIC);
        for (i, v) in [self.width, self.height, self.number, 0].into_iter().enumerate() {
            out[8 + 4 * i..12 + 4 * i].copy_from_slice(&v.to_le_bytes());
        }
        for (i, v) in [self.begin_ns, self.exposure_ns, self.row_ns].into_iter().enumerate() {
            out[24 + 8 * i..32 + 8 * i].copy_from_slice(&v.to_le_bytes());
        }
        let sum = crc32c(&out[..48]);
        out[48..].copy_from_slice(&sum.to_le_bytes());
        out
    }

    /// From bytes; `None` if they are damaged, or name a size or a time that no camera has.
    pub fn decode(bytes: &[u8; HEADER_BYTES]) -> Option<Self> {
        let word = |at: usize| u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
        let long = |at: usize| (u64::from(word(at)) | u64::from(word(at + 4)) << 32) as i64;
        if bytes[..8] != MAGIC || word(48) != crc32c(&bytes[..48]) {
            return None;
        }
        let header = Self {
            width: word(8),
            height: word(12),
            number: word(16),
            begin_ns: long(24),
            exposure_ns: long(32),
            row_ns: long(40),
        };
        let sizes = SIDES.contains(&header.width) && SIDES.contains(&header.height);
        let times = [header.exposure_ns, header.row_ns].iter().all(|t| (0..=LONGEST_NS).contains(t));
        (sizes && times).then_some(header)
    }

    /// Bytes of the pixels that follow.
    pub fn pixel_bytes(&self) -> usize {
        self.width as usize * self.height as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_header_survives_and_any_damage_is_seen() {
        let header = PictureHeader {
            width: 1280,
            height: 800,
            number: u32::MAX,
            begin_ns: -5,
            exposure_ns: 2_000_000,
            row_ns: 11,
        };
        let bytes = header.encode();
        assert_eq!(PictureHeader::decode(&bytes), Some(header));
        assert_eq!(header.pixel_bytes(), 1_024_000);
        for at in 0..HEADER_BYTES {
            let mut damaged = bytes;
            damaged[at] ^= 0x10;
            assert_eq!(PictureHeader::decode(&damaged), None, "byte {at}");
        }
        for wrong in [
            PictureHeader { width: 8193, ..header },
            PictureHeader { height: 0, ..header },
            PictureHeader { exposure_ns: -1, ..header },
        ] {
            assert_eq!(PictureHeader::decode(&wrong.encode()), None, "{wrong:?}");
        }
    }
}
