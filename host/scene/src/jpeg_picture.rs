//! JPEG that `zune-jpeg` misreads without a word or not at all: colours in scans of their own, a first colour of fewer texels
//! than another one, and grey without loss. `jpeg-decoder` reads them, and takes longer for all others.
//! It also reads fewer texels than there are, without memory for all.

use image::DynamicImage;
use jpeg_decoder::{ColorTransform, Decoder, PixelFormat};

/// Scans of a progressive picture that are decoded; each costs time for the whole picture.
const MOST_SCANS: usize = 100;

/// Whether a JPEG is of a kind that `zune-jpeg`, and with it `image`, misreads or panics at. The marks before its data are read.
pub fn is_odd_jpeg(bytes: &[u8]) -> bool {
    JpegFrame::read(bytes, 1).is_some_and(|frame| frame.is_odd())
}

/// What the header of a JPEG says.
pub(crate) struct JpegFrame {
    /// 0 and 1: sequential, 2: progressive, 3: without loss.
    kind: u8,
    /// Texels in a row and rows.
    pub(crate) sides: [u32; 2],
    /// Samples of each colour across and down for each step of the coarsest one.
    sampling: Vec<[u8; 2]>,
    /// Colours of each scan.
    scans: Vec<usize>,
}

impl JpegFrame {
    /// Reads the marks of a file; `None` where they make no picture.
    pub(crate) fn of(bytes: &[u8]) -> Option<Self> {
        Self::read(bytes, usize::MAX)
    }

    /// The same up to so many scans.
    fn read(bytes: &[u8], most_scans: usize) -> Option<Self> {
        let mut frame: Option<Self> = None;
        let mut rest = bytes.strip_prefix(&[0xff, 0xd8])?;
        while let Some(at) = rest.iter().position(|byte| *byte == 0xff) {
            rest = &rest[at + 1..];
            let Some((&mark, after)) = rest.split_first() else { break };
            // A byte of the picture, a fill byte, a step of a scan, or the beginning of a file.
            if matches!(mark, 0 | 1 | 0xd0..=0xd8) {
                rest = after;
            }
            if matches!(mark, 0 | 1 | 0xd0..=0xd8 | 0xff) {
                continue;
            }
            if mark == 0xd9 {
                break;
            }
            let length = after.first_chunk().map(|b| usize::from(u16::from_be_bytes(*b)))?;
            let Some(content) = after.get(2..length) else { break };
            match mark {
                // Tables of codes and of arithmetic coding stand between the frames.
                0xc4 | 0xc8 | 0xcc => {}
                0xc0..=0xcf if frame.is_none() => frame = Some(Self::of_header(mark - 0xc0, content)?),
                0xda => {
                    let scans = &mut frame.as_mut()?.scans;
                    scans.push(usize::from(*content.first()?));
                    if scans.len() == most_scans {
                        break;
                    }
                }
                _ => {}
            }
            rest = &after[length..];
        }
        frame
    }

    fn of_header(kind: u8, content: &[u8]) -> Option<Self> {
        let &[_, h1, h0, w1, w0, _, ref colours @ ..] = content else { return None };
        let sides = [[w1, w0], [h1, h0]].map(|side| u32::from(u16::from_be_bytes(side)));
        let sampling: Vec<_> = colours.chunks_exact(3).map(|c| [c[1] >> 4, c[1] & 15]).collect();
        (!sampling.is_empty()).then_some(Self { kind, sides, sampling, scans: vec![] })
    }

    /// Whether there is a picture behind the header.
    pub(crate) fn has_scan(&self) -> bool {
        !self.scans.is_empty()
    }

    /// Whether this module has to read it.
    pub(crate) fn is_odd(&self) -> bool {
        let count = self.sampling.len();
        let is_split = self.kind < 2 && self.scans.first().is_some_and(|colours| *colours < count);
        let most = |side: usize| self.sampling.iter().map(|s| s[side]).max();
        let is_coarse = self.kind <= 2 && (0..2).any(|side| Some(self.sampling[0][side]) < most(side));
        is_split || is_coarse || self.kind == 3 && count == 1
    }

    /// The sides, half, a quarter or an eighth of them, at which the texels take at most `allowed` bytes; `None` where none do, or
    /// where the decoder holds all numbers of the picture at once.
    pub(crate) fn sides_within(&self, allowed: u64) -> Option<[u32; 2]> {
        let all = |step: u32| self.sides.map(|side| side.div_ceil(step));
        let bytes = |[w, h]: [u32; 2]| 3 * u64::from(w) * u64::from(h);
        let is_streamed = self.kind < 2 && self.scans.len() == 1 && !self.is_odd();
        let steps = if is_streamed { &[1, 2, 4, 8][..] } else { &[1] };
        steps.iter().map(|step| all(*step)).find(|sides| bytes(*sides) <= allowed)
    }

    /// Decodes a picture at `sides` of at most `allowed` bytes. `as_stored`: the colours are not converted.
    ///
    /// # Errors
    /// What is damaged or is not read, with what to do.
    pub(crate) fn decode(
        &self,
        bytes: &[u8],
        sides: [u32; 2],
        allowed: u64,
        as_stored: bool,
    ) -> Result<DynamicImage, String> {
        let most = if self.kind == 2 { MOST_SCANS } else { self.sampling.len() };
        if self.scans.len() > most {
            return Err(format!("is a JPEG of {} scans: save it as PNG", self.scans.len()));
        }
        let mut decoder = Decoder::new(bytes);
        decoder.set_max_decoding_buffer_size(usize::try_from(allowed).unwrap_or(usize::MAX));
        if as_stored && self.sampling.len() == 3 {
            // As they are: without any conversion it gives rows of one colour after the other, and leaves the buffer.
            decoder.set_color_transform(ColorTransform::RGB);
        }
        // A decoder that panics leaves its picture out, and not the scene.
        let decode = std::panic::AssertUnwindSafe(|| {
            if sides != self.sides {
                let [width, height] = sides.map(|side| u16::try_from(side).unwrap_or(u16::MAX));
                decoder.scale(width, height)?;
            }
            decoder.decode()
        });
        let texels = std::panic::catch_unwind(decode)
            .map_err(|_| "cannot be decoded: its decoder failed; save it as PNG".to_owned())?
            .map_err(|e| format!("cannot be decoded: {e}"))?;
        let info = decoder.info();
        let [width, height] = info.map_or([0; 2], |info| [info.width, info.height].map(u32::from));
        let picture = match info.map(|info| info.pixel_format) {
            Some(PixelFormat::L8) => {
                image::GrayImage::from_raw(width, height, texels).map(DynamicImage::ImageLuma8)
            }
            Some(PixelFormat::RGB24) => {
                image::RgbImage::from_raw(width, height, texels).map(DynamicImage::ImageRgb8)
            }
            _ => None,
        };
        picture.ok_or_else(|| "is a JPEG of four inks or of more than 8 bits: save it as PNG".into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(kind: u8, colours: &[[u8; 2]], scans: &[&[u8]]) -> Vec<u8> {
        let mut out = vec![0xff, 0xd8, 0xff, 0xc0 + kind, 0, 8 + 3 * colours.len() as u8, 8, 0, 5, 0, 9];
        out.push(colours.len() as u8);
        colours.iter().zip(1..).for_each(|([h, v], id)| out.extend([id, h << 4 | v, 0]));
        for scan in scans {
            out.extend([0xff, 0xda, 0, 6 + 2 * scan.len() as u8, scan.len() as u8]);
            scan.iter().for_each(|id| out.extend([*id, 0]));
            // A byte of 255 in the picture, and a mark of a step.
            out.extend([0, 63, 0, 0x12, 0xff, 0, 0x34, 0xff, 0xd0, 0x56]);
        }
        [out, vec![0xff, 0xd9]].concat()
    }

    #[test]
    fn the_kinds_that_the_fast_decoder_misreads_are_found() {
        let usual: &[[u8; 2]] = &[[2, 2], [1, 1], [1, 1]];
        type Case<'a> = (u8, &'a [[u8; 2]], &'a [&'a [u8]], bool);
        let cases: [Case; 8] = [
            (0, usual, &[&[1, 2, 3]], false),
            (0, usual, &[&[1], &[2, 3]], true),
            (0, usual, &[&[1], &[2], &[3]], true),
            (2, usual, &[&[1, 2, 3], &[1], &[2]], false),
            (0, &[[1, 1], [2, 2], [2, 2]], &[&[1, 2, 3]], true),
            (0, &[[1, 1]], &[&[1]], false),
            (3, &[[1, 1]], &[&[1]], true),
            (3, &[[1, 1]; 3], &[&[1, 2, 3]], false),
        ];
        for (kind, colours, scans, odd) in cases {
            let bytes = file(kind, colours, scans);
            let frame = JpegFrame::of(&bytes).unwrap();
            assert_eq!(is_odd_jpeg(&bytes), odd);
            assert_eq!((frame.is_odd(), frame.sides), (odd, [9, 5]), "{kind} {colours:?} {scans:?}");
            assert!(frame.has_scan() && frame.scans.len() == scans.len());
            // No part of it makes the reader of marks fall.
            (0..bytes.len()).for_each(|end| drop(JpegFrame::of(&bytes[..end])));
        }
        assert!(!JpegFrame::of(&file(0, usual, &[])).unwrap().has_scan());
        let told = JpegFrame::of(&file(0, usual, &[&[1u8][..]; 9]))
            .unwrap()
            .decode(&[], [9, 5], 1 << 20, false)
            .unwrap_err();
        assert!(told.contains("9 scans"), "{told}");
    }
}
