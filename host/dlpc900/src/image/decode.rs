//! Decodes the controller's image streams, byte by byte as they arrive.

use super::{Compression, ImageError, ImageHeader, HEADER_BYTES};

/// What the decoder expects next.
#[derive(Clone, Copy, Debug)]
enum Expect {
    Control,
    /// High part of a length: what it counts, and its low part.
    High(RunKind, u8),
    /// The byte after a leading 0.
    Escape,
    CopyLength,
    Run(usize),
    Literal(usize),
    /// Padding to a multiple of 4 after an RLE line.
    Padding,
    End,
}

#[derive(Clone, Copy, Debug)]
enum RunKind {
    Run,
    Literal,
    Copy,
}

/// Decodes a stream byte by byte, as it arrives. Its memory is that of one image, allocated once from the size given,
/// never from a size in the stream.
///
/// Some deviations are tolerated, because programs in the field differ: runs and literals that cross the end of a line,
/// lines that end early (the rest is black), a missing end-of-line mark, anything after the end of the image.
/// [`ImageDecoder::oddities`] counts them.
#[derive(Clone, Debug)]
pub struct ImageDecoder {
    compression: Compression,
    width: usize,
    pixels: Vec<u8>,
    filled: usize,
    at: usize,
    partial: [u8; 3],
    partial_bytes: usize,
    expect: Expect,
    oddities: u32,
}

impl ImageDecoder {
    /// For the stream behind `header`, whose size must be `width` x `height`.
    pub fn new(header: &ImageHeader, width: u32, height: u32) -> Result<Self, ImageError> {
        if u32::from(header.width) != width || u32::from(header.height) != height {
            let (w, h) = (header.width, header.height);
            return Err(ImageError::Size { width: w, height: h, dmd_width: width, dmd_height: height });
        }
        Ok(Self {
            compression: header.compression,
            width: width as usize,
            pixels: vec![0; width as usize * height as usize * 3],
            filled: 0,
            at: 0,
            partial: [0; 3],
            partial_bytes: 0,
            expect: if header.compression == Compression::Raw {
                Expect::Literal(usize::MAX)
            } else {
                Expect::Control
            },
            oddities: 0,
        })
    }

    /// Adds the next bytes of the stream. After an error the decoder is unusable.
    pub fn push(&mut self, bytes: &[u8]) -> Result<(), ImageError> {
        for (i, b) in bytes.iter().enumerate() {
            if matches!(self.expect, Expect::End) {
                self.at += bytes.len() - i;
                return Ok(());
            }
            self.byte(*b)?;
            self.at += 1;
        }
        Ok(())
    }

    /// True when the end of the image has been seen (raw: when every pixel has).
    pub fn is_complete(&self) -> bool {
        matches!(self.expect, Expect::End)
    }

    /// Bytes taken so far.
    pub fn bytes_taken(&self) -> usize {
        self.at
    }

    /// Number of tolerated deviations from the guide.
    pub fn oddities(&self) -> u32 {
        self.oddities
    }

    /// Call at the end of the stream: returns the pixels, 3 bytes each in the order written, rows from the top. A
    /// missing end mark is tolerated if no pixel is missing.
    pub fn finish(mut self) -> Result<Vec<u8>, ImageError> {
        if !self.is_complete() {
            if self.filled < self.pixels.len() {
                return Err(ImageError::TooFewPixels {
                    pixels: self.filled / 3,
                    wanted: self.pixels.len() / 3,
                });
            }
            self.oddities += 1;
        }
        Ok(self.pixels)
    }

    /// The pixels decoded so far; the rest is black.
    pub fn pixels(&self) -> &[u8] {
        &self.pixels
    }

    fn byte(&mut self, b: u8) -> Result<(), ImageError> {
        let erle = self.compression == Compression::Erle;
        self.expect = match self.expect {
            Expect::Control if b == 0 => Expect::Escape,
            Expect::Control if erle && b >= 128 => Expect::High(RunKind::Run, b),
            Expect::Control => Expect::Run(usize::from(b)),
            Expect::Escape => match (b, erle) {
                (0, _) => self.end_line(),
                (1, false) => self.end_image()?,
                (1, true) => Expect::CopyLength,
                (b, true) if b >= 128 => Expect::High(RunKind::Literal, b),
                (n, _) => Expect::Literal(usize::from(n)),
            },
            Expect::CopyLength if b == 0 => self.end_image()?,
            Expect::CopyLength if b >= 128 => Expect::High(RunKind::Copy, b),
            Expect::CopyLength => self.copy(usize::from(b))?,
            Expect::High(what, low) => {
                let n = usize::from(low & 0x7f) | usize::from(b) << 7;
                match (what, n) {
                    // A two-byte length may still be small; nothing to repeat means nothing to read.
                    (RunKind::Copy, n) => self.copy(n)?,
                    (RunKind::Literal, 0) => Expect::Control,
                    (RunKind::Literal, n) => Expect::Literal(n),
                    (RunKind::Run, n) => Expect::Run(n),
                }
            }
            Expect::Run(n) => match self.pixel(b) {
                Some(p) => {
                    self.put(p, n)?;
                    Expect::Control
                }
                None => Expect::Run(n),
            },
            Expect::Literal(n) => match self.pixel(b) {
                Some(p) => {
                    self.put(p, 1)?;
                    match (self.compression, n) {
                        (Compression::Raw, _) if self.filled == self.pixels.len() => Expect::End,
                        (_, 1) => Expect::Control,
                        _ => Expect::Literal(n - 1),
                    }
                }
                None => Expect::Literal(n),
            },
            Expect::Padding => self.padding(),
            Expect::End => Expect::End,
        };
        Ok(())
    }

    /// Collects a pixel's bytes.
    fn pixel(&mut self, b: u8) -> Option<[u8; 3]> {
        self.partial[self.partial_bytes] = b;
        self.partial_bytes = (self.partial_bytes + 1) % 3;
        (self.partial_bytes == 0).then_some(self.partial)
    }

    fn room(&mut self, n: usize) -> Result<std::ops::Range<usize>, ImageError> {
        let end = n.checked_mul(3).and_then(|b| self.filled.checked_add(b));
        let end = end.filter(|e| *e <= self.pixels.len()).ok_or(ImageError::TooManyPixels { at: self.at })?;
        let row = self.width * 3;
        if n > 0 && self.compression != Compression::Raw && self.filled / row != (end - 1) / row {
            self.oddities += 1;
        }
        let range = self.filled..end;
        self.filled = end;
        Ok(range)
    }

    fn put(&mut self, p: [u8; 3], n: usize) -> Result<(), ImageError> {
        let range = self.room(n)?;
        self.pixels[range].chunks_exact_mut(3).for_each(|c| c.copy_from_slice(&p));
        Ok(())
    }

    fn copy(&mut self, n: usize) -> Result<Expect, ImageError> {
        let row = self.width * 3;
        if self.filled < row && n > 0 {
            return Err(ImageError::CopyWithoutLine { at: self.at });
        }
        let range = self.room(n)?;
        // A copy that crosses the end of a line may read pixels that it has just written, so it proceeds row by row.
        let mut to = range.start;
        while to < range.end {
            let end = range.end.min(to + row);
            self.pixels.copy_within(to - row..end - row, to);
            to = end;
        }
        Ok(Expect::Control)
    }

    fn end_line(&mut self) -> Expect {
        let row = self.width * 3;
        // Right after a full line the mark belongs to that line, not to an empty one after it.
        let over = self.filled % row;
        if over != 0 {
            self.filled += row - over;
            self.oddities += 1;
        }
        if self.compression == Compression::Rle {
            self.padding()
        } else {
            Expect::Control
        }
    }

    /// Expected after the byte at `self.at`: more padding while the next byte is not at a multiple of 4.
    fn padding(&self) -> Expect {
        if (self.at + 1).is_multiple_of(4) {
            Expect::Control
        } else {
            Expect::Padding
        }
    }

    fn end_image(&mut self) -> Result<Expect, ImageError> {
        if self.filled < self.pixels.len() {
            return Err(ImageError::TooFewPixels { pixels: self.filled / 3, wanted: self.pixels.len() / 3 });
        }
        Ok(Expect::End)
    }
}

/// Decodes a whole image, header included, whose size must be `width` x `height`: its pixels, 3 bytes each in the order written.
pub fn decode(bytes: &[u8], width: u32, height: u32) -> Result<Vec<u8>, ImageError> {
    let too_few = ImageError::TooFewPixels { pixels: 0, wanted: width as usize * height as usize };
    let (head, stream) = bytes.split_first_chunk::<HEADER_BYTES>().ok_or(too_few)?;
    let mut decoder = ImageDecoder::new(&ImageHeader::decode(head)?, width, height)?;
    decoder.push(stream)?;
    decoder.finish()
}
