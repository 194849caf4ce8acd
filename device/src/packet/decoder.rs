//! Finds packets in a stream of bytes that may be cut anywhere and damaged in any way.
//!
//! The decoder keeps 40 bytes of state and no payload. Payload bytes go straight from the caller's slice to the
//! [`PacketSink`], so a plane is copied once. A header counts only if its own checksum is right, so a damaged length
//! never swallows the stream.

use super::crc::{crc32c_append, BLOCK_BYTES};
use super::header::{trailer_bytes, u32_at, Header, HeaderError, HEADER_BYTES, MAGIC};

/// Receives what a [`Decoder`] finds. Calls come as `begin`, then any number of `payload`, then `end`.
pub trait PacketSink {
    /// A header with a right checksum. Return `false` to skip the payload: neither `payload` nor `end` follow.
    fn begin(&mut self, header: &Header) -> bool;
    /// The next bytes of the payload, not yet verified.
    fn payload(&mut self, bytes: &[u8]);
    /// The packet is complete; `intact` says whether the payload's checksum is right.
    fn end(&mut self, intact: bool);
}

/// Counters of a [`Decoder`] since it was made. All wrap at 2^32.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DecoderCounters {
    /// Packets with a right header, wanted or not.
    pub packets: u32,
    /// Places that began like a packet but whose header checksum was wrong.
    pub header_errors: u32,
    /// Packets whose payload checksum was wrong.
    pub payload_errors: u32,
    /// Whole packets of another version, unknown type or unknown flags.
    pub foreign: u32,
    /// Packets that a [`Decoder::reset`] cut short.
    pub cut_short: u32,
    /// Bytes that belong to no packet.
    pub bytes_skipped: u32,
}

#[derive(Clone, Copy, Debug)]
enum State {
    /// Collecting a header in `buffer`.
    Hunting,
    /// `left` payload bytes to come.
    Payload { left: u32, wanted: bool },
    /// Collecting the trailer in `buffer`.
    Trailer { wanted: bool },
}

/// Finds packets in a stream. One per lane.
#[derive(Clone, Debug)]
pub struct Decoder {
    state: State,
    buffer: [u8; HEADER_BYTES],
    filled: usize,
    trailer_len: usize,
    crc: u32,
    counters: DecoderCounters,
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new()
    }
}

impl Decoder {
    /// A decoder that expects a header next.
    pub const fn new() -> Self {
        Self {
            state: State::Hunting,
            buffer: [0; HEADER_BYTES],
            filled: 0,
            trailer_len: 0,
            crc: 0,
            counters: DecoderCounters {
                packets: 0,
                header_errors: 0,
                payload_errors: 0,
                foreign: 0,
                cut_short: 0,
                bytes_skipped: 0,
            },
        }
    }

    /// The counters so far.
    pub const fn counters(&self) -> DecoderCounters {
        self.counters
    }

    /// Drops a half-received packet, because a new transfer begins here on the medium. A sink that received the
    /// packet's beginning receives its end as not intact.
    pub fn reset(&mut self, sink: &mut impl PacketSink) {
        match self.state {
            State::Hunting => {
                self.counters.bytes_skipped = self.counters.bytes_skipped.wrapping_add(self.filled as u32);
            }
            State::Payload { wanted, .. } | State::Trailer { wanted } => {
                self.counters.cut_short = self.counters.cut_short.wrapping_add(1);
                if wanted {
                    sink.end(false);
                }
            }
        }
        self.state = State::Hunting;
        self.filled = 0;
    }

    /// Feeds the next bytes of the stream. Work and stack are bounded by the length of `bytes`.
    pub fn push(&mut self, mut bytes: &[u8], sink: &mut impl PacketSink) {
        while !bytes.is_empty() {
            bytes = match self.state {
                State::Hunting => self.hunt(bytes, sink),
                State::Payload { left, wanted } => self.payload(bytes, left, wanted, sink),
                State::Trailer { wanted } => self.trailer(bytes, wanted, sink),
            };
        }
    }

    fn hunt<'b>(&mut self, mut bytes: &'b [u8], sink: &mut impl PacketSink) -> &'b [u8] {
        if self.filled == 0 {
            let skip = bytes.iter().position(|&b| b == MAGIC[0]).unwrap_or(bytes.len());
            self.skip(skip);
            bytes = &bytes[skip..];
        }
        let take = bytes.len().min(HEADER_BYTES - self.filled);
        self.buffer[self.filled..self.filled + take].copy_from_slice(&bytes[..take]);
        self.filled += take;
        if self.filled == HEADER_BYTES {
            self.header(sink);
        }
        &bytes[take..]
    }

    /// Turns a full buffer into a packet's beginning, or shortens it to the bytes that may still begin one.
    fn header(&mut self, sink: &mut impl PacketSink) {
        match Header::decode(&self.buffer) {
            Ok(header) => {
                self.counters.packets = self.counters.packets.wrapping_add(1);
                let wanted = sink.begin(&header);
                self.enter_payload(header.payload_bytes, wanted);
                if wanted && header.payload_bytes == 0 {
                    sink.end(true);
                }
            }
            Err(HeaderError::Version(_) | HeaderError::Type(_) | HeaderError::Flags(_)) => {
                self.counters.foreign = self.counters.foreign.wrapping_add(1);
                self.enter_payload(Header::payload_bytes_of(&self.buffer), false);
            }
            Err(error) => {
                if error == HeaderError::Checksum {
                    self.counters.header_errors = self.counters.header_errors.wrapping_add(1);
                }
                // Steps of one byte. On a medium that keeps words aligned, steps of four find the same packets.
                let next = (1..HEADER_BYTES)
                    .find(|&at| {
                        // Nearly every place fails at its first byte, which takes no call to see.
                        let n = (HEADER_BYTES - at).min(MAGIC.len());
                        self.buffer[at] == MAGIC[0] && self.buffer[at..at + n] == MAGIC[..n]
                    })
                    .unwrap_or(HEADER_BYTES);
                self.skip(next);
                self.buffer.copy_within(next.., 0);
                self.filled = HEADER_BYTES - next;
            }
        }
    }

    fn enter_payload(&mut self, payload_bytes: u32, wanted: bool) {
        self.filled = 0;
        self.crc = 0;
        self.trailer_len = trailer_bytes(payload_bytes as usize);
        self.state =
            if payload_bytes == 0 { State::Hunting } else { State::Payload { left: payload_bytes, wanted } };
    }

    fn payload<'b>(
        &mut self,
        bytes: &'b [u8],
        left: u32,
        wanted: bool,
        sink: &mut impl PacketSink,
    ) -> &'b [u8] {
        let (mine, rest) = bytes.split_at(bytes.len().min(left as usize));
        for block in mine.chunks(BLOCK_BYTES) {
            self.crc = crc32c_append(self.crc, block);
            if wanted {
                sink.payload(block);
            }
        }
        let left = left - mine.len() as u32;
        self.state = if left == 0 { State::Trailer { wanted } } else { State::Payload { left, wanted } };
        rest
    }

    fn trailer<'b>(&mut self, bytes: &'b [u8], wanted: bool, sink: &mut impl PacketSink) -> &'b [u8] {
        let take = bytes.len().min(self.trailer_len - self.filled);
        self.buffer[self.filled..self.filled + take].copy_from_slice(&bytes[..take]);
        self.filled += take;
        if self.filled == self.trailer_len {
            let intact = u32_at(&self.buffer, self.trailer_len - 4) == self.crc;
            if !intact {
                self.counters.payload_errors = self.counters.payload_errors.wrapping_add(1);
            }
            self.state = State::Hunting;
            self.filled = 0;
            if wanted {
                sink.end(intact);
            }
        }
        &bytes[take..]
    }

    fn skip(&mut self, bytes: usize) {
        self.counters.bytes_skipped = self.counters.bytes_skipped.wrapping_add(bytes as u32);
    }
}

#[cfg(test)]
mod tests {
    use super::super::header::{MessageType, Packet};
    use super::*;
    use crate::time::DeviceTicks;
    use proptest::prelude::*;

    #[derive(Default)]
    struct Collect {
        open: Option<(u32, Vec<u8>)>,
        done: Vec<(u32, Vec<u8>, bool)>,
    }

    impl PacketSink for Collect {
        fn begin(&mut self, header: &Header) -> bool {
            assert!(self.open.is_none(), "a packet began inside another");
            self.open = Some((header.frame, Vec::new()));
            true
        }
        fn payload(&mut self, bytes: &[u8]) {
            self.open.as_mut().expect("payload outside a packet").1.extend_from_slice(bytes);
        }
        fn end(&mut self, intact: bool) {
            let (frame, payload) = self.open.take().expect("end outside a packet");
            self.done.push((frame, payload, intact));
        }
    }

    fn wire(frame: u32, payload: &[u8]) -> Vec<u8> {
        let header = Header {
            frame,
            target_at: DeviceTicks(u64::from(frame) * 77),
            ..Header::control(MessageType::Plane, 9, 0)
        };
        Packet::new(header, payload).to_vec()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// However a clean stream is cut, every packet comes out once, in order and intact, between any garbage.
        #[test]
        fn cuts_and_garbage_lose_nothing(
            payloads in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..200), 1..8),
            garbage in prop::collection::vec(prop::collection::vec(0u8..0x44, 0..50), 8),
            cut in 1usize..97,
        ) {
            let mut stream = Vec::new();
            let mut noise = 0;
            for (i, p) in payloads.iter().enumerate() {
                stream.extend_from_slice(&garbage[i]);
                noise += garbage[i].len();
                stream.extend_from_slice(&wire(i as u32, p));
            }
            let mut decoder = Decoder::new();
            let mut sink = Collect::default();
            for piece in stream.chunks(cut) {
                decoder.push(piece, &mut sink);
            }
            prop_assert_eq!(sink.done.len(), payloads.len());
            for (i, (frame, payload, intact)) in sink.done.iter().enumerate() {
                prop_assert!(*intact && *frame == i as u32 && *payload == payloads[i]);
            }
            prop_assert_eq!(decoder.counters().bytes_skipped as usize, noise);
        }

        /// Any bytes: no panic, and every byte is in a packet, counted as skipped, or still held.
        #[test]
        fn any_bytes_are_survived(
            pieces in prop::collection::vec(
                prop_oneof![
                    prop::collection::vec(any::<u8>(), 0..80),
                    Just(b"DPML".to_vec()), Just(b"DDPDPM".to_vec()),
                    any::<u32>().prop_map(|f| wire(f, &[1, 2, 3])[..20].to_vec()),
                ], 0..40),
        ) {
            let mut decoder = Decoder::new();
            let mut sink = Collect::default();
            for p in &pieces {
                decoder.push(p, &mut sink);
            }
            let total: usize = pieces.iter().map(Vec::len).sum();
            let c = decoder.counters();
            prop_assert!(c.bytes_skipped as usize + sink.done.len() * HEADER_BYTES <= total);
            // After any garbage the decoder resynchronises within the longest payload that a header could claim.
            decoder.reset(&mut sink);
            sink.open = None;
            sink.done.clear();
            decoder.push(&wire(7, b"after the storm"), &mut sink);
            prop_assert_eq!(&sink.done, &vec![(7, b"after the storm".to_vec(), true)]);
        }

        /// One flipped bit: the packet it hits is lost or reported as not intact, the packet after it arrives.
        #[test]
        fn a_flipped_bit_costs_one_packet(payload in prop::collection::vec(any::<u8>(), 1..120), bit in any::<u32>()) {
            let mut stream = wire(1, &payload);
            let bits = stream.len() * 8;
            let pad = trailer_bytes(payload.len()) - 4;
            let at = bit as usize % bits;
            stream[at / 8] ^= 1 << (at % 8);
            stream.extend_from_slice(&wire(2, b"next"));
            let mut decoder = Decoder::new();
            let mut sink = Collect::default();
            decoder.push(&stream, &mut sink);
            let good: Vec<_> = sink.done.iter().filter(|d| d.2).map(|d| d.0).collect();
            let in_padding = (HEADER_BYTES + payload.len()..HEADER_BYTES + payload.len() + pad).contains(&(at / 8));
            prop_assert_eq!(good, if in_padding { vec![1, 2] } else { vec![2] });
        }
    }

    #[test]
    fn a_short_transfer_is_ended_by_reset() {
        let mut decoder = Decoder::new();
        let mut sink = Collect::default();
        decoder.push(&wire(1, &[7; 100])[..60], &mut sink);
        decoder.reset(&mut sink);
        decoder.push(&wire(2, &[8; 10]), &mut sink);
        assert_eq!(sink.done, vec![(1, vec![7; 28], false), (2, vec![8; 10], true)]);
        assert_eq!(decoder.counters().cut_short, 1);
    }
}
