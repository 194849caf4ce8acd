//! Reads and writes little-endian values, never past the end, and never allocates according to an unchecked count.

use core::fmt;

/// A protocol version, `major.minor`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Version {
    /// Major number.
    pub major: u8,
    /// Minor number.
    pub minor: u8,
}

impl Version {
    /// Oldest supported version.
    pub const V3_0: Self = Self::new(3, 0);
    /// First version with marker names in the model definitions and a selectable bit stream.
    pub const V4_0: Self = Self::new(4, 0);
    /// First version that gives each section its size in bytes.
    pub const V4_1: Self = Self::new(4, 1);
    /// Newest supported version.
    pub const V4_2: Self = Self::new(4, 2);

    /// `major.minor`.
    pub const fn new(major: u8, minor: u8) -> Self {
        Self { major, minor }
    }

    /// True for versions with a known layout, and for later 4.x versions, whose sections can be skipped by size.
    pub const fn is_spoken(self) -> bool {
        self.major == 3 || self.major == 4
    }

    /// True when sections carry their size in bytes.
    pub fn has_section_sizes(self) -> bool {
        self >= Self::V4_1
    }
}

impl fmt::Display for Version {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}", self.major, self.minor)
    }
}

/// Errors of decoding. Offsets count from the start of the payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// The bytes end inside a value.
    #[error("{what} at byte {at}: {needed} bytes needed, {left} left")]
    Truncated {
        /// Which value.
        what: &'static str,
        /// Where it starts.
        at: usize,
        /// Its size.
        needed: usize,
        /// What remains.
        left: usize,
    },
    /// A count that is negative, or larger than the remaining bytes could hold.
    #[error(
        "{what} at byte {at}: count {count} is negative or more than the remaining {left} bytes can hold"
    )]
    Count {
        /// Of what.
        what: &'static str,
        /// Where the count stands.
        at: usize,
        /// The count as a signed number.
        count: i32,
        /// Bytes left after it.
        left: usize,
    },
    /// A text without its terminating zero within [`Reader::MAX_TEXT`] bytes.
    #[error("{what} at byte {at}: no terminating zero within 256 bytes")]
    Text {
        /// Which text.
        what: &'static str,
        /// Where it starts.
        at: usize,
    },
    /// A section whose size does not fit its items.
    #[error("{what} at byte {at}: {size} bytes do not hold {count} items")]
    SectionSize {
        /// Which section.
        what: &'static str,
        /// Where its items start.
        at: usize,
        /// The size given.
        size: usize,
        /// The count given.
        count: usize,
    },
    /// The length in the header is not the length of the datagram.
    #[error("the header announces {announced} bytes of payload, the datagram has {actual}")]
    Length {
        /// From the header.
        announced: usize,
        /// Bytes after the header.
        actual: usize,
    },
    /// The word that ends a frame is missing: the frame has another layout than that of its version.
    #[error("the frame does not end where version {version} says it does")]
    End {
        /// The version that the frame was decoded as.
        version: Version,
    },
    /// A version with an unknown layout.
    #[error("NatNet {0} is not spoken; 3.0 to 4.2 are")]
    Version(Version),
}

/// A cursor over a payload.
#[derive(Clone, Copy)]
pub struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    /// Longest text accepted, its zero included.
    pub const MAX_TEXT: usize = 256;

    /// A cursor at the start of `bytes`.
    pub const fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }

    /// Bytes not read yet.
    pub const fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    /// Offset of the next byte.
    pub const fn at(&self) -> usize {
        self.at
    }

    /// The next `n` bytes.
    pub fn take(&mut self, n: usize, what: &'static str) -> Result<&'a [u8], WireError> {
        if n > self.left() {
            return Err(WireError::Truncated { what, at: self.at, needed: n, left: self.left() });
        }
        let bytes = &self.bytes[self.at..self.at + n];
        self.at += n;
        Ok(bytes)
    }

    fn array<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N], WireError> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(N, what)?);
        Ok(out)
    }

    /// An unsigned 8-bit number.
    pub fn u8(&mut self, what: &'static str) -> Result<u8, WireError> {
        Ok(self.array::<1>(what)?[0])
    }
    /// An unsigned 16-bit number.
    pub fn u16(&mut self, what: &'static str) -> Result<u16, WireError> {
        self.array(what).map(u16::from_le_bytes)
    }
    /// A signed 32-bit number.
    pub fn i32(&mut self, what: &'static str) -> Result<i32, WireError> {
        self.array(what).map(i32::from_le_bytes)
    }
    /// An unsigned 32-bit number.
    pub fn u32(&mut self, what: &'static str) -> Result<u32, WireError> {
        self.array(what).map(u32::from_le_bytes)
    }
    /// An unsigned 64-bit number.
    pub fn u64(&mut self, what: &'static str) -> Result<u64, WireError> {
        self.array(what).map(u64::from_le_bytes)
    }
    /// A 32-bit float.
    pub fn f32(&mut self, what: &'static str) -> Result<f32, WireError> {
        self.array(what).map(f32::from_le_bytes)
    }
    /// A 64-bit float.
    pub fn f64(&mut self, what: &'static str) -> Result<f64, WireError> {
        self.array(what).map(f64::from_le_bytes)
    }
    /// `N` 32-bit floats.
    pub fn floats<const N: usize>(&mut self, what: &'static str) -> Result<[f32; N], WireError> {
        let bytes = self.take(4 * N, what)?;
        let mut out = [0.0; N];
        for (value, b) in out.iter_mut().zip(bytes.chunks_exact(4)) {
            *value = f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
        }
        Ok(out)
    }

    /// Reads a text and its zero; returns it without the zero.
    pub fn text(&mut self, what: &'static str) -> Result<&'a [u8], WireError> {
        let rest = &self.bytes[self.at..];
        let window = &rest[..rest.len().min(Self::MAX_TEXT)];
        let end = window.iter().position(|b| *b == 0).ok_or(WireError::Text { what, at: self.at })?;
        self.at += end + 1;
        Ok(&rest[..end])
    }

    /// A count of items of at least `least_bytes` each, checked against the remaining bytes.
    pub fn count(&mut self, what: &'static str, least_bytes: usize) -> Result<usize, WireError> {
        let at = self.at;
        let count = self.i32(what)?;
        match usize::try_from(count) {
            Ok(n) if n.saturating_mul(least_bytes.max(1)) <= self.left() => Ok(n),
            _ => Err(WireError::Count { what, at, count, left: self.left() }),
        }
    }

    /// A size in bytes, checked against the remaining bytes.
    pub fn size(&mut self, what: &'static str) -> Result<usize, WireError> {
        self.count(what, 1)
    }
}

/// Numbers of the messages.
#[allow(missing_docs)]
pub mod id {
    pub const CONNECT: u16 = 0;
    pub const SERVER_INFO: u16 = 1;
    pub const REQUEST: u16 = 2;
    pub const RESPONSE: u16 = 3;
    pub const REQUEST_MODEL_DEF: u16 = 4;
    pub const MODEL_DEF: u16 = 5;
    pub const REQUEST_FRAME: u16 = 6;
    pub const FRAME: u16 = 7;
    pub const MESSAGE_STRING: u16 = 8;
    pub const DISCONNECT: u16 = 9;
    pub const KEEP_ALIVE: u16 = 10;
    pub const DISCONNECT_BY_TIMEOUT: u16 = 11;
    pub const ECHO_REQUEST: u16 = 12;
    pub const ECHO_RESPONSE: u16 = 13;
    pub const DISCOVERY: u16 = 14;
    pub const UNRECOGNIZED: u16 = 100;
}

/// Bytes of the header: message number and payload length.
pub const HEADER_BYTES: usize = 4;
/// Largest datagram over IPv4.
pub const MAX_DATAGRAM: usize = 65_507;

/// Message number and payload of a datagram. Trailing bytes beyond the announced length are refused, and so is a
/// truncated datagram.
pub fn split(datagram: &[u8]) -> Result<(u16, &[u8]), WireError> {
    let mut r = Reader::new(datagram);
    let id = r.u16("message number")?;
    let announced = usize::from(r.u16("payload length")?);
    if announced != r.left() {
        return Err(WireError::Length { announced, actual: r.left() });
    }
    Ok((id, &datagram[HEADER_BYTES..]))
}

/// Starts message `id` in `out` (emptied first); [`finish`] sets its length.
pub fn begin(out: &mut Vec<u8>, id: u16) {
    out.clear();
    out.extend_from_slice(&id.to_le_bytes());
    out.extend_from_slice(&[0, 0]);
}

/// Sets the payload length of the message begun in `out`. `Err` when it is longer than a datagram can be.
pub fn finish(out: &mut [u8]) -> Result<(), WireError> {
    let length = out.len().saturating_sub(HEADER_BYTES);
    if out.len() > MAX_DATAGRAM {
        return Err(WireError::Length { announced: length, actual: MAX_DATAGRAM - HEADER_BYTES });
    }
    out[2..4].copy_from_slice(&(length as u16).to_le_bytes());
    Ok(())
}
