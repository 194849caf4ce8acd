//! Compresses one plane and decompresses it: runs of equal bytes, of the plane itself or of its difference from the
//! previous plane.
//!
//! The decoder takes its input in any pieces and needs three bytes of state, so firmware can decode while a packet
//! arrives. The output is always exactly as long as the plane. Section 8 of docs/PROTOCOL.md lists the tokens.

/// Longest literal or run that a one-byte token announces.
const SHORT: usize = 127;
/// Longest literal or run of a token.
const LONG: usize = 128 + u16::MAX as usize;

/// Why a payload is not a plane.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CodecError {
    /// The tokens describe more bytes than a plane has.
    TooLong,
    /// The payload ended before the plane was full.
    TooShort,
}

impl core::fmt::Display for CodecError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::TooLong => "payload describes more bytes than a plane has",
            Self::TooShort => "payload describes fewer bytes than a plane has",
        })
    }
}

impl core::error::Error for CodecError {}

/// Bytes that are compared at once. Shorter runs stay literal: one more token costs the decoder more time than its few
/// bytes cost the cable.
const WORD: usize = 8;
/// Bytes that are copied at once where there is room, even if fewer are needed.
const BLOCK: usize = 16;

/// Writes `plane` as RLE into `out`. Returns the number of bytes, or `None` if they do not fit. Give `out` the length
/// below which the result is worthwhile: the encoder stops as soon as it is exceeded. It finds every run of 11 bytes.
/// Of the shorter runs it finds those that fill a word of eight at a multiple of four from the end of the last one.
pub fn rle_encode(plane: &[u8], out: &mut [u8]) -> Option<usize> {
    let mut at = 0;
    let mut literal_from = 0;
    while let Some(run) = next_run(plane, literal_from) {
        at = put_literal(&plane[literal_from..], run.start - literal_from, out, at)?;
        let value = plane[run.start];
        literal_from = run.end;
        let mut left = run.len();
        while left > 0 {
            let now = left.min(LONG);
            at = put_token(now, 128, out, at)?;
            *out.get_mut(at)? = value;
            at += 1;
            left -= now;
        }
    }
    put_literal(&plane[literal_from..], plane.len() - literal_from, out, at)
}

/// The first run worth a token in `bytes` from `from` on.
fn next_run(bytes: &[u8], from: usize) -> Option<core::ops::Range<usize>> {
    let mut at = from;
    // Noise has no runs: four words, in pairs of overlapping words of eight bytes, are tested before a decision.
    while let Some(block) = bytes.get(at..at + 2 * WORD + 4) {
        if uniform(block, 0) | uniform(block, 4) | uniform(block, 8) | uniform(block, 12) {
            break;
        }
        at += 2 * WORD;
    }
    while at + WORD <= bytes.len() {
        if uniform(bytes, at) {
            let value = bytes[at];
            let before = bytes[from..at].iter().rev().take_while(|&&b| b == value).count();
            return Some(at - before..at + run_length(&bytes[at..]));
        }
        at += 4;
    }
    None
}

/// True when the eight bytes at `at` are equal.
#[inline]
fn uniform(bytes: &[u8], at: usize) -> bool {
    let Some(word) = bytes.get(at..).and_then(|b| b.first_chunk::<WORD>()) else { return false };
    let word = u64::from_ne_bytes(*word);
    word == word.rotate_left(8)
}

/// Number of bytes at the start of `bytes` that equal the first. `bytes` is not empty.
fn run_length(bytes: &[u8]) -> usize {
    let value = bytes[0];
    let mut n = 0;
    // Dark planes are one long run.
    for block in bytes.as_chunks::<64>().0 {
        if block.iter().fold(0, |differs, &b| differs | (b ^ value)) != 0 {
            break;
        }
        n += 64;
    }
    for word in bytes[n..].as_chunks::<WORD>().0 {
        let differs = u64::from_le_bytes(*word) ^ u64::from_ne_bytes([value; WORD]);
        if differs != 0 {
            return n + differs.trailing_zeros() as usize / 8;
        }
        n += WORD;
    }
    n + bytes[n..].iter().take_while(|&&b| b == value).count()
}

/// Writes the token of `n` (1 to [`LONG`]) with its kind bit (0 literal, 128 run).
fn put_token(n: usize, kind: u8, out: &mut [u8], at: usize) -> Option<usize> {
    if n <= SHORT {
        *out.get_mut(at)? = kind + (n - 1) as u8;
        Some(at + 1)
    } else {
        let m = ((n - 128) as u16).to_le_bytes();
        out.get_mut(at..at + 3)?.copy_from_slice(&[kind + 127, m[0], m[1]]);
        Some(at + 3)
    }
}

/// Writes the first `len` of `bytes` literally.
fn put_literal(bytes: &[u8], len: usize, out: &mut [u8], mut at: usize) -> Option<usize> {
    if let (1..=BLOCK, Some(block), Some(to)) =
        (len, bytes.first_chunk::<BLOCK>(), out.get_mut(at..at + 1 + BLOCK))
    {
        // Most literals are short: one block is copied, and the next token overwrites the excess.
        to[0] = (len - 1) as u8;
        to[1..].copy_from_slice(block);
        return Some(at + 1 + len);
    }
    let mut left = &bytes[..len];
    while !left.is_empty() {
        let (now, later) = left.split_at(left.len().min(LONG));
        at = put_token(now.len(), 0, out, at)?;
        out.get_mut(at..at + now.len())?.copy_from_slice(now);
        at += now.len();
        left = later;
    }
    Some(at)
}

/// What the next input byte is.
#[derive(Clone, Copy, Debug)]
enum Expect {
    Token,
    LengthLow { run: bool },
    LengthHigh { run: bool, low: u8 },
    Literal { left: usize },
    Value { run: usize },
}

/// Decodes RLE in pieces.
#[derive(Clone, Copy, Debug)]
pub struct RleDecoder {
    expect: Expect,
    at: usize,
    xor: bool,
}

impl RleDecoder {
    /// Writes the decoded bytes over the plane.
    pub const fn new() -> Self {
        Self { expect: Expect::Token, at: 0, xor: false }
    }

    /// Applies the decoded bytes by XOR to a plane that holds the base frame's bits.
    pub const fn new_xor() -> Self {
        Self { expect: Expect::Token, at: 0, xor: true }
    }

    /// Feeds the next bytes of the payload. `plane` is the whole plane, the same in every call. After an error nothing more may
    /// be fed.
    pub fn push(&mut self, mut bytes: &[u8], plane: &mut [u8]) -> Result<(), CodecError> {
        while let Some((&byte, rest)) = bytes.split_first() {
            if let Some(used) = self.short(byte, rest, plane) {
                bytes = &rest[used..];
                continue;
            }
            match self.expect {
                Expect::Token => {
                    let (run, n) = (byte >= 128, (byte & 127) as usize + 1);
                    self.expect = if n > SHORT { Expect::LengthLow { run } } else { Self::of(run, n) };
                    bytes = rest;
                }
                Expect::LengthLow { run } => {
                    self.expect = Expect::LengthHigh { run, low: byte };
                    bytes = rest;
                }
                Expect::LengthHigh { run, low } => {
                    self.expect = Self::of(run, 128 + u16::from_le_bytes([low, byte]) as usize);
                    bytes = rest;
                }
                Expect::Literal { left } => {
                    let (now, later) = bytes.split_at(left.min(bytes.len()));
                    let to = plane.get_mut(self.at..self.at + now.len()).ok_or(CodecError::TooLong)?;
                    if self.xor {
                        to.iter_mut().zip(now).for_each(|(p, b)| *p ^= b);
                    } else {
                        to.copy_from_slice(now);
                    }
                    self.at += now.len();
                    self.expect = if left == now.len() {
                        Expect::Token
                    } else {
                        Expect::Literal { left: left - now.len() }
                    };
                    bytes = later;
                }
                Expect::Value { run } => {
                    let to = plane.get_mut(self.at..self.at + run).ok_or(CodecError::TooLong)?;
                    if !self.xor {
                        to.fill(byte);
                    } else if byte != 0 {
                        to.iter_mut().for_each(|p| *p ^= byte);
                    }
                    self.at += run;
                    self.expect = Expect::Token;
                    bytes = rest;
                }
            }
        }
        Ok(())
    }

    /// Decodes a short token in one step if payload and plane continue for at least a block after it. Returns the
    /// number of bytes of `rest` that it used; `None` if it did nothing.
    #[inline]
    fn short(&mut self, token: u8, rest: &[u8], plane: &mut [u8]) -> Option<usize> {
        if !matches!(self.expect, Expect::Token) {
            return None;
        }
        let (run, n) = (token >= 128, (token & 127) as usize + 1);
        let from = rest.first_chunk::<BLOCK>()?;
        let to = plane.get_mut(self.at..)?.first_chunk_mut::<BLOCK>().filter(|_| n <= BLOCK)?;
        let block = if run { [from[0]; BLOCK] } else { *from };
        if self.xor {
            let mask = u128::MAX >> (8 * (BLOCK - n));
            *to = (u128::from_le_bytes(*to) ^ (u128::from_le_bytes(block) & mask)).to_le_bytes();
        } else {
            // The next token overwrites the excess; without one the plane is not full, and counts as damaged.
            *to = block;
        }
        self.at += n;
        Some(if run { 1 } else { n })
    }

    /// Call at the end of the payload: an error unless it described the whole plane of `plane_bytes`.
    pub const fn finish(&self, plane_bytes: usize) -> Result<(), CodecError> {
        if matches!(self.expect, Expect::Token) && self.at == plane_bytes {
            Ok(())
        } else {
            Err(CodecError::TooShort)
        }
    }

    const fn of(run: bool, n: usize) -> Expect {
        if run {
            Expect::Value { run: n }
        } else {
            Expect::Literal { left: n }
        }
    }
}

impl Default for RleDecoder {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn encode(plane: &[u8]) -> Vec<u8> {
        let mut out = vec![0; plane.len() + plane.len() / 64 + 8];
        let n = rle_encode(plane, &mut out).expect("room for the worst case");
        out.truncate(n);
        out
    }

    fn decode(payload: &[u8], cut: usize, plane_bytes: usize) -> Result<Vec<u8>, CodecError> {
        let mut plane = vec![0xee; plane_bytes];
        let mut decoder = RleDecoder::new();
        for piece in payload.chunks(cut) {
            decoder.push(piece, &mut plane)?;
        }
        decoder.finish(plane_bytes)?;
        Ok(plane)
    }

    #[test]
    fn golden_tokens() {
        // By the table of docs/PROTOCOL.md: three literals; five times 77; the long run of 300 = 128 + 0x00ac.
        let mut plane = vec![1, 2, 3];
        plane.extend([0x77; 5]);
        plane.extend([0; 300]);
        let golden = [0x02, 1, 2, 3, 0x84, 0x77, 0xff, 0xac, 0x00, 0x00];
        assert_eq!(decode(&golden, 1, plane.len()), Ok(plane.clone()));
        assert_eq!(decode(&golden, 10, plane.len()), Ok(plane.clone()));
        // A run of five is not worth a token of its own.
        assert_eq!(encode(&plane), [7, 1, 2, 3, 0x77, 0x77, 0x77, 0x77, 0x77, 0xff, 0xac, 0x00, 0x00]);
        // A run of eleven always gets one, wherever it lies, and the three tokens of any length around it.
        for before in 0..40 {
            let plane =
                [vec![9; before], (0..before as u8).collect(), vec![0x77; 11], vec![1, 2, 3]].concat();
            let coded = encode(&plane);
            assert!(coded.windows(2).any(|w| w == [0x8a, 0x77]), "{before}: {coded:02x?}");
        }
        // 130 literals are a long literal of 128 + 2.
        let plane: Vec<u8> = (0..130).map(|i| (i * 7) as u8).collect();
        let golden = [&[0x7f, 0x02, 0x00][..], &plane].concat();
        assert_eq!(encode(&plane), golden);
        assert_eq!(decode(&golden, 50, 130), Ok(plane));
        // A dark XGA plane is two tokens.
        assert_eq!(encode(&[0; 98_304]).len(), 8);
    }

    #[test]
    fn the_wrong_amount_is_an_error() {
        assert_eq!(decode(&[0x83, 9], 2, 3), Err(CodecError::TooLong));
        assert_eq!(decode(&[0x03, 1, 2, 3, 4], 5, 3), Err(CodecError::TooLong));
        assert_eq!(decode(&[0x81, 9], 2, 3), Err(CodecError::TooShort));
        assert_eq!(
            decode(&[0x82, 9, 0x00], 2, 3),
            Err(CodecError::TooShort),
            "a token that says nothing more"
        );
        assert_eq!(decode(&[0xff, 0xff, 0xff, 0], 2, 3), Err(CodecError::TooLong));
        assert_eq!(decode(&[], 1, 3), Err(CodecError::TooShort));
    }

    fn plane() -> impl Strategy<Value = Vec<u8>> {
        // Runs of every length around the limits, noise between them.
        prop::collection::vec(
            (any::<u8>(), prop_oneof![1usize..6, 120usize..135, 65_660usize..65_670]),
            1..12,
        )
        .prop_map(|runs| runs.into_iter().flat_map(|(v, n)| std::iter::repeat_n(v, n)).collect())
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn planes_survive_and_never_grow_by_much(
            plane in prop_oneof![plane(), prop::collection::vec(any::<u8>(), 1..600), prop::collection::vec(0u8..3, 1..600)],
            cut in 1usize..300,
        ) {
            let coded = encode(&plane);
            prop_assert!(coded.len() <= plane.len() + 3 * plane.len().div_ceil(65_000) + 1, "{} of {}", coded.len(), plane.len());
            prop_assert_eq!(decode(&coded, cut, plane.len()).unwrap(), plane.clone());
            // Exactly enough room is enough, one byte less is not.
            let mut room = vec![0; coded.len()];
            prop_assert_eq!(rle_encode(&plane, &mut room), Some(coded.len()));
            prop_assert_eq!(&room, &coded);
            prop_assert_eq!(rle_encode(&plane, &mut room[1..]), None);
        }

        #[test]
        fn xor_restores_the_plane_from_its_base(pair in prop::collection::vec((any::<u8>(), prop_oneof![3 => Just(0u8), 1 => any::<u8>()]), 1..500), cut in 1usize..50) {
            let base: Vec<u8> = pair.iter().map(|p| p.0).collect();
            let difference: Vec<u8> = pair.iter().map(|p| p.1).collect();
            let expected: Vec<u8> = pair.iter().map(|p| p.0 ^ p.1).collect();
            let mut plane = base;
            let mut decoder = RleDecoder::new_xor();
            for piece in encode(&difference).chunks(cut) {
                decoder.push(piece, &mut plane).unwrap();
            }
            decoder.finish(plane.len()).unwrap();
            prop_assert_eq!(plane, expected);
        }

        #[test]
        fn any_payload_is_survived(payload in prop::collection::vec(any::<u8>(), 0..300), plane_bytes in 0usize..400, cut in 1usize..40) {
            let _ = decode(&payload, cut, plane_bytes);
        }
    }
}
