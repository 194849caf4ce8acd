//! Unpacks the strips and tiles of a TIFF.

use std::borrow::Cow;
use std::convert::Infallible;
use std::io::Read;

use crate::jpeg_picture::JpegFrame;
use fax::decoder::{DecodeStatus, Group3Decoder};
use flate2::read::ZlibDecoder;
use ruzstd::decoding::StreamingDecoder;
use weezl::decode::Configuration;
use weezl::BitOrder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// A window of Zstandard that every reader has to grant.
const WINDOW_FOR_ALL: u64 = 8 << 20;

/// How the strips and tiles of a file are packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Packing {
    /// Not at all.
    Plain,
    /// Runs of bytes.
    PackBits,
    /// Lempel, Ziv and Welch.
    Lzw,
    /// ZLIB, by either of its numbers.
    Deflate,
    /// Zstandard.
    Zstandard,
    /// JPEG, the tables of all in one tag.
    Jpeg,
    /// WebP.
    WebP,
    /// A fax of group 3, each line by itself.
    Fax3,
    /// A fax of group 4.
    Fax4,
}

impl Packing {
    /// The packing of a number of the format.
    ///
    /// # Errors
    /// What is not read, by its name.
    pub(super) fn of(number: u64) -> Result<Self, String> {
        let name = match number {
            1 | 32_771 => return Ok(Self::Plain),
            32_773 => return Ok(Self::PackBits),
            5 => return Ok(Self::Lzw),
            8 | 32_946 => return Ok(Self::Deflate),
            50_000 => return Ok(Self::Zstandard),
            7 => return Ok(Self::Jpeg),
            50_001 => return Ok(Self::WebP),
            3 => return Ok(Self::Fax3),
            4 => return Ok(Self::Fax4),
            2 => "lines of a fax",
            6 => "JPEG of the kind before 1995",
            34_712 | 33_003 | 33_004 | 33_005 => "JPEG 2000",
            34_925 => "LZMA",
            34_887 => "LERC",
            50_002 | 52_546 => "JPEG XL",
            34_676 | 34_677 => "logarithms of light",
            32_809 => "ThunderScan",
            32_909 => "Pixar's logarithms",
            _ => "a way that no version of the format has",
        };
        Err(format!(
            "is a TIFF packed as {name} (compression {number}): save it with LZW or deflate, or as PNG"
        ))
    }

    /// Whether differences of neighbours may be packed instead of numbers.
    pub(super) fn has_predictor(self) -> bool {
        matches!(self, Self::Lzw | Self::Deflate | Self::Zstandard)
    }

    /// Whether a decoder of pictures gives bytes of eight bits, whatever the file says of bits, chroma and their order.
    pub(super) fn is_picture(self) -> bool {
        matches!(self, Self::Jpeg | Self::WebP)
    }
}

/// What unpacking needs beside the packed bytes.
pub(super) struct Unpacking<'a> {
    /// How they are packed.
    pub packing: Packing,
    /// Tables that all JPEG of the file share.
    pub tables: Option<&'a [u8]>,
    /// The picture is a whole JPEG file, whose marks say what its colours are.
    pub is_file: bool,
    /// Bytes of the largest piece of memory.
    pub allowed: u64,
    /// Bits are stored from the lowest to the highest of each byte.
    pub is_reversed: bool,
    /// Texels across and down of the largest strip or tile.
    pub greatest: [usize; 2],
}

impl Unpacking<'_> {
    /// The first `needed` bytes of a strip or tile of `width` x `height` texels with `samples` numbers each; fewer where it is
    /// damaged.
    pub(super) fn unpack<'b>(
        &self,
        packed: &'b [u8],
        needed: usize,
        [width, height]: [usize; 2],
        samples: usize,
    ) -> Cow<'b, [u8]> {
        let packed: Cow<'b, [u8]> = if self.is_reversed && !self.packing.is_picture() {
            packed.iter().map(|byte| byte.reverse_bits()).collect()
        } else {
            Cow::Borrowed(packed)
        };
        if self.packing == Packing::Plain {
            return match packed {
                Cow::Borrowed(all) => Cow::Borrowed(&all[..needed.min(all.len())]),
                Cow::Owned(mut all) => {
                    all.truncate(needed);
                    Cow::Owned(all)
                }
            };
        }
        // A decoder that panics leaves its strip out, and not the scene.
        let unpack = || self.decoded(&packed, needed, [width, height], samples);
        let mut out = std::panic::catch_unwind(std::panic::AssertUnwindSafe(unpack)).unwrap_or_default();
        out.truncate(needed);
        Cow::Owned(out)
    }

    fn decoded(&self, packed: &[u8], needed: usize, [width, height]: [usize; 2], samples: usize) -> Vec<u8> {
        match self.packing {
            Packing::Plain => vec![],
            Packing::PackBits => pack_bits(packed, needed),
            Packing::Lzw => lzw(packed, needed),
            Packing::Deflate => all_that_is_right(ZlibDecoder::new(packed), needed),
            Packing::Zstandard => {
                let most = (needed as u64).next_power_of_two().max(WINDOW_FOR_ALL);
                match StreamingDecoder::new_with_max_window_size(packed, most) {
                    Ok(decoder) => all_that_is_right(decoder, needed),
                    Err(_) => vec![],
                }
            }
            Packing::Jpeg => self.jpeg(packed, width, samples).unwrap_or_default(),
            Packing::WebP => webp(packed, [width, height], samples).unwrap_or_default(),
            Packing::Fax3 | Packing::Fax4 => self.fax(packed, [width, height]),
        }
    }

    /// The numbers of a JPEG as they are stored, or those of red, green and blue of a whole file; chroma spread over all texels.
    fn jpeg(&self, packed: &[u8], width: usize, samples: usize) -> Option<Vec<u8>> {
        // The tables stand between two marks, of which the picture has its own.
        let tables = self.tables.and_then(|tables| tables.get(..tables.len().checked_sub(2)?));
        let whole: Cow<[u8]> = match tables {
            Some(tables) => [tables, packed.get(2..)?].concat().into(),
            None => packed.into(),
        };
        let fits = |across: usize, down: usize| {
            // The last strip may be padded to the height of the others.
            across >= width && across < self.greatest[0] + 64 && down < self.greatest[1] + 64
        };
        if let Some(frame) = JpegFrame::of(&whole).filter(JpegFrame::is_odd) {
            let [across, down] = frame.sides.map(|side| side as usize);
            if !fits(across, down) {
                return None;
            }
            let picture = frame.decode(&whole, frame.sides, self.allowed, !self.is_file).ok()?;
            let is_whole = usize::from(picture.color().channel_count()) == samples;
            return is_whole.then(|| rows_of(picture.into_bytes(), across * samples, width * samples));
        }
        let mut decoder = zune_jpeg::JpegDecoder::new_with_options(
            ZCursor::new(&*whole),
            DecoderOptions::default().set_strict_mode(false),
        );
        decoder.decode_headers().ok()?;
        let (across, down) = decoder.dimensions()?;
        let stored = decoder.input_colorspace()?;
        if stored.num_components() != samples || !fits(across, down) {
            return None;
        }
        let out = if self.is_file && samples == 3 { ColorSpace::RGB } else { stored };
        decoder.set_options(decoder.options().jpeg_set_out_colorspace(out));
        let texels = decoder.decode().ok()?;
        Some(rows_of(texels, across * samples, width * samples))
    }

    /// A picture of two colours, a bit for each texel, black as 1.
    fn fax(&self, packed: &[u8], [width, height]: [usize; 2]) -> Vec<u8> {
        let (Ok(across), Ok(down)) = (u16::try_from(width), u16::try_from(height)) else { return vec![] };
        let stride = width.div_ceil(8);
        let mut out = Vec::with_capacity(stride * height);
        let mut line = |changes: &[u16]| {
            let begin = out.len();
            out.resize(begin + stride, 0u8);
            for (x, colour) in fax::decoder::pels(changes, across).enumerate() {
                out[begin + x / 8] |= u8::from(colour == fax::Color::Black) << (7 - x % 8);
            }
        };
        let bytes = packed.iter().copied();
        if self.packing == Packing::Fax4 {
            // What was decoded before an error is there.
            let _ = fax::decoder::decode_g4(bytes, across, Some(down), line);
            return out;
        }
        let Ok(mut decoder) = Group3Decoder::new(bytes.map(Ok::<u8, Infallible>)) else { return vec![] };
        for _ in 0..down {
            let is_last = !matches!(decoder.advance(), Ok(DecodeStatus::Incomplete));
            // The last line need not have an end.
            if !is_last || decoder.transitions().last() == Some(&across) {
                line(decoder.transitions());
            }
            if is_last {
                break;
            }
        }
        out
    }
}

/// Rows of `stride` bytes, of which the first `width` are kept.
fn rows_of(texels: Vec<u8>, stride: usize, width: usize) -> Vec<u8> {
    if stride == width {
        return texels;
    }
    texels.chunks_exact(stride).flat_map(|row| &row[..width]).copied().collect()
}

fn webp(packed: &[u8], [width, height]: [usize; 2], samples: usize) -> Option<Vec<u8>> {
    let reader = || image::ImageReader::with_format(std::io::Cursor::new(packed), image::ImageFormat::WebP);
    let (across, down) = reader().into_dimensions().ok()?;
    if (across as usize, down as usize) != (width, height) {
        return None;
    }
    let picture = reader().decode().ok()?;
    match samples {
        3 => Some(picture.into_rgb8().into_raw()),
        4 => Some(picture.into_rgba8().into_raw()),
        _ => None,
    }
}

/// Up to `needed` bytes of a stream, those before an error if there is one.
fn all_that_is_right(mut stream: impl Read, needed: usize) -> Vec<u8> {
    let (mut out, mut filled) = (vec![0; needed], 0);
    while filled < needed {
        match stream.read(&mut out[filled..]) {
            Ok(0) | Err(_) => break,
            Ok(length) => filled += length,
        }
    }
    out.truncate(filled);
    out
}

fn pack_bits(packed: &[u8], needed: usize) -> Vec<u8> {
    // A run may end behind what is needed.
    let (mut out, mut rest) = (Vec::with_capacity(needed + 128), packed);
    while let [head, after @ ..] = rest {
        if out.len() >= needed {
            break;
        }
        let length = usize::from(*head);
        rest = match (length, after) {
            (0..=127, _) => {
                let (bytes, left) = after.split_at((length + 1).min(after.len()));
                out.extend_from_slice(bytes);
                left
            }
            (128, _) => after,
            (_, [byte, left @ ..]) => {
                out.resize(out.len() + 257 - length, *byte);
                left
            }
            (_, []) => after,
        };
    }
    out
}

fn lzw(packed: &[u8], needed: usize) -> Vec<u8> {
    // Before 1988 the codes were stored from their lowest bit, and grew a step later.
    let is_old = matches!(packed, [0, second, ..] if second & 1 == 1);
    let form = match is_old {
        true => Configuration::new(BitOrder::Lsb, 8),
        false => Configuration::with_tiff_size_switch(BitOrder::Msb, 8),
    };
    let mut decoder = form.with_yield_on_full_buffer(true).build();
    let (mut out, mut rest, mut filled) = (vec![0; needed], packed, 0);
    while filled < needed {
        let step = decoder.decode_bytes(rest, &mut out[filled..]);
        rest = &rest[step.consumed_in..];
        filled += step.consumed_out;
        if step.consumed_in + step.consumed_out == 0 || !matches!(step.status, Ok(weezl::LzwStatus::Ok)) {
            break;
        }
    }
    out.truncate(filled);
    out
}
