//! Encodes byte strings as frames on a serial line, and decodes them: consistent overhead byte stuffing, with a zero
//! byte at the end of each frame.
//!
//! The zero byte occurs nowhere else, so a receiver that joined late, or lost bytes, is synchronised again at the next
//! frame \[Cheshire99\]. Overhead: one byte in 254, and the delimiter.

/// Most bytes that [`encode`] writes for `n` bytes of content, delimiter included.
pub const fn encoded_bytes(n: usize) -> usize {
    n + n / 254 + 2
}

/// Writes `parts`, one after the other, as one frame with its delimiter into `out`. Returns the length, or `None` if
/// the frame does not fit ([`encoded_bytes`] bytes always suffice).
pub fn encode(parts: &[&[u8]], out: &mut [u8]) -> Option<usize> {
    // `code_at` is the place of the distance to the next zero.
    let (mut code_at, mut at) = (0, 1);
    for &byte in parts.iter().copied().flatten() {
        if byte != 0 {
            *out.get_mut(at)? = byte;
            at += 1;
        }
        if byte == 0 || at - code_at == 255 {
            *out.get_mut(code_at)? = (at - code_at) as u8;
            code_at = at;
            at += 1;
        }
    }
    *out.get_mut(code_at)? = (at - code_at) as u8;
    *out.get_mut(at)? = 0;
    Some(at + 1)
}

/// Counters of a [`Deframer`]. All wrap at 2^32.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DeframerCounters {
    /// Frames passed on.
    pub frames: u32,
    /// Frames longer than the buffer.
    pub too_long: u32,
    /// Frames that a delimiter cut short.
    pub broken: u32,
}

/// Cuts a stream into frames, in a buffer that is given at creation.
#[derive(Clone, Debug)]
pub struct Deframer<B> {
    buffer: B,
    len: usize,
    /// Bytes until the next code byte.
    left: u8,
    /// The current block ends with a zero (unless the frame ends there).
    zero_due: bool,
    overflow: bool,
    started: bool,
    counters: DeframerCounters,
}

impl<B: AsRef<[u8]> + AsMut<[u8]>> Deframer<B> {
    /// `buffer` must hold the content of the longest frame.
    pub const fn new(buffer: B) -> Self {
        let counters = DeframerCounters { frames: 0, too_long: 0, broken: 0 };
        Self { buffer, len: 0, left: 0, zero_due: false, overflow: false, started: false, counters }
    }

    /// The counters so far.
    pub const fn counters(&self) -> DeframerCounters {
        self.counters
    }

    /// Forgets a half-received frame.
    pub fn reset(&mut self) {
        (self.len, self.left, self.zero_due, self.overflow, self.started) = (0, 0, false, false, false);
    }

    /// Feeds the next bytes of the line; every whole frame goes to `sink`. Empty frames (two delimiters in a row) are
    /// skipped.
    pub fn push(&mut self, bytes: &[u8], sink: &mut dyn FnMut(&[u8])) {
        for &byte in bytes {
            if byte == 0 {
                self.end(sink);
            } else if self.left == 0 {
                // A code byte. The frame continues, so the zero that the previous block implied was real.
                self.started = true;
                if self.zero_due {
                    self.put(0);
                }
                self.left = byte - 1;
                self.zero_due = byte != 255;
            } else {
                self.put(byte);
                self.left -= 1;
            }
        }
    }

    fn put(&mut self, byte: u8) {
        match self.buffer.as_mut().get_mut(self.len) {
            Some(to) => {
                *to = byte;
                self.len += 1;
            }
            None => self.overflow = true,
        }
    }

    fn end(&mut self, sink: &mut dyn FnMut(&[u8])) {
        if self.left > 0 {
            self.counters.broken = self.counters.broken.wrapping_add(1);
        } else if self.overflow {
            self.counters.too_long = self.counters.too_long.wrapping_add(1);
        } else if self.started {
            self.counters.frames = self.counters.frames.wrapping_add(1);
            sink(&self.buffer.as_ref()[..self.len]);
        }
        self.reset();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn encoded(content: &[u8]) -> Vec<u8> {
        let mut out = vec![0xee; encoded_bytes(content.len())];
        let n = encode(&[content], &mut out).expect("room");
        out.truncate(n);
        out
    }

    #[test]
    fn golden_frames() {
        // The examples of [Cheshire99] and of the usual tables.
        for (content, frame) in [
            (&[][..], &[1, 0][..]),
            (&[0], &[1, 1, 0]),
            (&[0, 0], &[1, 1, 1, 0]),
            (&[0x11, 0x22, 0, 0x33], &[3, 0x11, 0x22, 2, 0x33, 0]),
            (&[0x11, 0x22, 0x33, 0x44], &[5, 0x11, 0x22, 0x33, 0x44, 0]),
            (&[0x11, 0, 0, 0], &[2, 0x11, 1, 1, 1, 0]),
        ] {
            assert_eq!(encoded(content), frame);
        }
        let long: Vec<u8> = (1..=255).collect();
        let mut expected = vec![255];
        expected.extend(1..=254);
        expected.extend([2, 255, 0]);
        assert_eq!(encoded(&long), expected);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(96))]

        #[test]
        fn frames_survive_any_cut_and_any_neighbour(
            contents in prop::collection::vec(prop::collection::vec(prop_oneof![Just(0u8), any::<u8>()], 0..600), 1..6),
            noise in prop::collection::vec(1u8.., 0..40),
            cut in 1usize..50,
        ) {
            // A receiver that is switched on in the middle of a frame loses that frame only.
            let mut line = noise.clone();
            line.push(0);
            for c in &contents {
                let frame = encoded(c);
                prop_assert!(frame.len() <= encoded_bytes(c.len()));
                prop_assert!(frame[..frame.len() - 1].iter().all(|&b| b != 0));
                line.extend(frame);
            }
            let mut got = Vec::new();
            let mut deframer = Deframer::new([0u8; 600]);
            for piece in line.chunks(cut) {
                deframer.push(piece, &mut |f| got.push(f.to_vec()));
            }
            let from_noise = got.len() - contents.len();
            prop_assert!(from_noise <= 1);
            prop_assert_eq!(&got[from_noise..], &contents[..]);
        }

        #[test]
        fn any_bytes_are_survived(line in prop::collection::vec(any::<u8>(), 0..2000)) {
            let mut deframer = Deframer::new([0u8; 32]);
            let mut longest = 0;
            deframer.push(&line, &mut |f| longest = longest.max(f.len()));
            prop_assert!(longest <= 32);
        }

        #[test]
        fn too_little_room_is_told(content in prop::collection::vec(any::<u8>(), 0..300), short in 1usize..3) {
            let frame = encoded(&content);
            let mut out = vec![0; frame.len() - short];
            prop_assert_eq!(encode(&[&content], &mut out), None);
        }
    }

    #[test]
    fn long_and_broken_frames_are_counted_and_left_behind() {
        let mut deframer = Deframer::new([0u8; 4]);
        let mut got = Vec::new();
        let line = [&encoded(&[1, 2, 3, 4, 5])[..], &[9, 1, 2, 0], &[0, 0], &encoded(&[7])].concat();
        deframer.push(&line, &mut |f| got.push(f.to_vec()));
        assert_eq!(got, [vec![7]]);
        assert_eq!(deframer.counters(), DeframerCounters { frames: 1, too_long: 1, broken: 1 });
    }
}
