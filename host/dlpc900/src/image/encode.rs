//! Encodes rows of pixels as the controller's RLE and ERLE streams.

use std::ops::Range;

use super::{pixel_row, Compression, ImageError, ImageHeader, Pixel, PlaneOrder, HEADER_BYTES};
use crate::lut::IMAGE_PLANES;
use dpm_device::planes::Raster;

/// Longest run or copy of an ERLE length.
const MOST_ERLE: usize = 0x7fff;
/// Longest run of an RLE length.
const MOST_RLE: usize = 0xff;

/// An image ready to be sent, header included.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EncodedImage {
    /// Header and stream, padded to 4 bytes.
    pub bytes: Vec<u8>,
    /// Its compression.
    pub compression: Compression,
}

impl EncodedImage {
    /// Raw size divided by coded size, headers left out.
    pub fn factor(&self, pixels: usize) -> f64 {
        (pixels * 3) as f64 / (self.bytes.len() - HEADER_BYTES) as f64
    }
}

/// Encodes rows of pixels with one compression.
struct RowEncoder {
    compression: Compression,
    out: Vec<u8>,
}

impl RowEncoder {
    fn new(compression: Compression) -> Self {
        Self { compression, out: vec![0; HEADER_BYTES] }
    }

    fn pixel(&mut self, p: Pixel) {
        let b = p.to_le_bytes();
        self.out.extend_from_slice(&b[..3]);
    }

    fn length(&mut self, n: usize) {
        if self.compression == Compression::Erle && n >= 128 {
            self.out.extend_from_slice(&[(n & 0x7f) as u8 | 0x80, (n >> 7) as u8]);
        } else {
            self.out.push(n as u8);
        }
    }

    fn repeat(&mut self, p: Pixel, n: usize) {
        let most = if self.compression == Compression::Erle { MOST_ERLE } else { MOST_RLE };
        let mut left = n;
        while left > 0 {
            let now = left.min(most);
            self.length(now);
            self.pixel(p);
            left -= now;
        }
    }

    fn literal(&mut self, pixels: &[Pixel]) {
        let most = if self.compression == Compression::Erle { MOST_ERLE } else { MOST_RLE };
        for chunk in pixels.chunks(most) {
            if let [p] = chunk {
                // `0 1` means something else: a single pixel is a run of one.
                self.repeat(*p, 1);
                continue;
            }
            self.out.push(0);
            self.length(chunk.len());
            for p in chunk {
                self.pixel(*p);
            }
        }
    }

    fn row(&mut self, row: &[Pixel], above: Option<&[Pixel]>) {
        if self.compression == Compression::Raw {
            row.iter().for_each(|p| self.pixel(*p));
            return;
        }
        let above = above.filter(|_| self.compression == Compression::Erle);
        let copy_at = |at: usize| above.map_or(0, |a| equal_ahead(&row[at..], &a[at..]));
        let (mut at, mut literal_from) = (0, 0);
        while at < row.len() {
            let run = run_ahead(&row[at..]);
            let copy = copy_at(at);
            // Ending a literal costs a new head (2 to 3 bytes), so only a larger saving is worthwhile. A copy costs 3
            // bytes and a run 4, a literal pixel 3.
            let open = literal_from < at;
            let (least_copy, least_run) = if open { (2, 3) } else { (1, 2) };
            if copy >= least_copy && copy + 1 >= run {
                self.literal(&row[literal_from..at]);
                let mut left = copy;
                while left > 0 {
                    let now = left.min(MOST_ERLE);
                    self.out.extend_from_slice(&[0, 1]);
                    self.length(now);
                    left -= now;
                }
                at += copy;
                literal_from = at;
            } else if run >= least_run {
                self.literal(&row[literal_from..at]);
                self.repeat(row[at], run);
                at += run;
                literal_from = at;
            } else {
                at += 1;
            }
        }
        self.literal(&row[literal_from..]);
        self.out.extend_from_slice(&[0, 0]);
        if self.compression == Compression::Rle {
            self.pad();
        }
    }

    fn pad(&mut self) {
        // The header is a multiple of 4, so the stream and the whole are padded alike.
        while !self.out.len().is_multiple_of(4) {
            self.out.push(0);
        }
    }

    fn finish(mut self, width: usize, height: usize) -> EncodedImage {
        match self.compression {
            Compression::Raw => {}
            Compression::Rle => self.out.extend_from_slice(&[0, 1]),
            Compression::Erle => self.out.extend_from_slice(&[0, 1, 0]),
        }
        self.pad();
        let header = ImageHeader {
            width: width as u16,
            height: height as u16,
            encoded_bytes: (self.out.len() - HEADER_BYTES) as u32,
            background: [0; 4],
            compression: self.compression,
        };
        self.out[..HEADER_BYTES].copy_from_slice(&header.encode());
        EncodedImage { bytes: self.out, compression: self.compression }
    }
}

/// Number of pixels from the start that equal the first.
fn run_ahead(row: &[Pixel]) -> usize {
    row.iter().take_while(|p| **p == row[0]).count()
}

/// Number of pixels from the start that equal those above.
fn equal_ahead(row: &[Pixel], above: &[Pixel]) -> usize {
    row.iter().zip(above).take_while(|(p, a)| p == a).count()
}

/// Encodes at most 24 planes of `raster` for the controller of `columns` (all columns, or one half of a DMD with two
/// controllers). With `compression` `None`, uses the smaller of RLE and ERLE (or raw, if neither saves anything).
pub fn encode(
    planes: &[&[u8]],
    raster: Raster,
    columns: Range<usize>,
    order: PlaneOrder,
    compression: Option<Compression>,
) -> Result<EncodedImage, ImageError> {
    if planes.len() > IMAGE_PLANES {
        return Err(ImageError::TooManyPlanes(planes.len()));
    }
    for (plane, p) in planes.iter().enumerate() {
        if p.len() != raster.plane_bytes() {
            return Err(ImageError::PlaneSize { plane, bytes: p.len(), wanted: raster.plane_bytes() });
        }
    }
    let columns = columns.start..columns.end.min(raster.width() as usize);
    let (width, height) = (columns.len(), raster.height() as usize);
    let candidates: &[Compression] = match &compression {
        Some(c) => std::slice::from_ref(c),
        None => &[Compression::Rle, Compression::Erle],
    };
    let mut encoders: Vec<_> = candidates.iter().map(|c| RowEncoder::new(*c)).collect();
    let (mut row, mut above) = (vec![0; width], vec![0; width]);
    for y in 0..height {
        pixel_row(planes, y, columns.clone(), raster, order, &mut row);
        let line_above = (y > 0).then_some(&above[..]);
        encoders.iter_mut().for_each(|e| e.row(&row, line_above));
        std::mem::swap(&mut row, &mut above);
    }
    let images = encoders.into_iter().map(|e| e.finish(width, height));
    // There is at least one candidate; of equals the simpler coding wins.
    let best = images.reduce(|a, b| if b.bytes.len() < a.bytes.len() { b } else { a });
    match best {
        Some(b) if compression.is_some() || b.bytes.len() < HEADER_BYTES + width * height * 3 => Ok(b),
        _ => encode(planes, raster, columns, order, Some(Compression::Raw)),
    }
}
