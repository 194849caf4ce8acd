//! Pixels of a camera into grey levels.

use super::jpeg::motion_jpeg_grey;

/// Where the grey level of a pixel lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Place {
    /// In one byte: from pixel to pixel `step` bytes, the first at `first`.
    Byte { step: usize, first: usize },
    /// In two bytes, the lower one first, of which the upper 8 of `bits` bits count.
    Word { bits: u32 },
    /// In a picture that is a JPEG.
    Jpeg,
}

/// A format that is read.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Layout {
    /// Its four characters.
    pub code: u32,
    /// Its name in C.
    pub c_name: &'static str,
    /// Where the grey levels lie. Planes of colour lie behind those of grey.
    pub place: Place,
}

impl Layout {
    const fn of(code: &[u8; 4], c_name: &'static str, place: Place) -> Self {
        Self { code: u32::from_le_bytes(*code), c_name, place }
    }

    /// Bytes of a row of grey levels of `width` pixels.
    pub(super) const fn row_bytes(&self, width: usize) -> usize {
        match self.place {
            Place::Byte { step, .. } => step * width,
            Place::Word { .. } => 2 * width,
            Place::Jpeg => 0,
        }
    }

    /// Bytes that a picture has at least, whose rows begin every `stride` bytes.
    pub(super) const fn least_bytes(&self, stride: usize, [width, height]: [usize; 2]) -> usize {
        match self.place {
            Place::Jpeg => 1,
            _ => stride * (height - 1) + self.row_bytes(width),
        }
    }

    /// Fills `out` with `size[0] * size[1]` grey levels of a picture whose rows begin every `stride` bytes. False, and
    /// nothing of use in `out`, if `bytes` are too few or damaged.
    pub(super) fn grey(&self, bytes: &[u8], stride: usize, size: [usize; 2], out: &mut Vec<u8>) -> bool {
        if self.place == Place::Jpeg {
            return motion_jpeg_grey(bytes, size, out);
        }
        let [width, height] = size;
        let row = self.row_bytes(width);
        out.clear();
        if stride < row || height == 0 || width == 0 {
            return false;
        }
        let needed = stride.checked_mul(height - 1).and_then(|b| b.checked_add(row));
        if needed.is_none_or(|needed| bytes.len() < needed) {
            return false;
        }
        out.reserve(width * height);
        for row in bytes.chunks(stride).take(height).map(|r| &r[..row]) {
            match self.place {
                Place::Byte { step: 1, .. } => out.extend_from_slice(row),
                Place::Byte { step, first } => out.extend(row.iter().skip(first).step_by(step)),
                Place::Word { bits } => {
                    let level = |two: &[u8]| {
                        (u32::from(u16::from_le_bytes([two[0], two[1]])) >> (bits - 8)).min(255) as u8
                    };
                    out.extend(row.chunks_exact(2).map(level));
                }
                Place::Jpeg => unreachable!("decoded above"),
            }
        }
        true
    }
}

/// The formats that are read; first those that carry nothing but grey in the fewest bytes, last the one that takes time and
/// loses edges.
pub(super) static LAYOUTS: [Layout; 12] = [
    Layout::of(b"GREY", "V4L2_PIX_FMT_GREY", Place::Byte { step: 1, first: 0 }),
    Layout::of(b"NV12", "V4L2_PIX_FMT_NV12", Place::Byte { step: 1, first: 0 }),
    Layout::of(b"NV21", "V4L2_PIX_FMT_NV21", Place::Byte { step: 1, first: 0 }),
    Layout::of(b"YU12", "V4L2_PIX_FMT_YUV420", Place::Byte { step: 1, first: 0 }),
    Layout::of(b"Y10 ", "V4L2_PIX_FMT_Y10", Place::Word { bits: 10 }),
    Layout::of(b"Y12 ", "V4L2_PIX_FMT_Y12", Place::Word { bits: 12 }),
    Layout::of(b"Y16 ", "V4L2_PIX_FMT_Y16", Place::Word { bits: 16 }),
    Layout::of(b"YUYV", "V4L2_PIX_FMT_YUYV", Place::Byte { step: 2, first: 0 }),
    Layout::of(b"YVYU", "V4L2_PIX_FMT_YVYU", Place::Byte { step: 2, first: 0 }),
    Layout::of(b"UYVY", "V4L2_PIX_FMT_UYVY", Place::Byte { step: 2, first: 1 }),
    Layout::of(b"VYUY", "V4L2_PIX_FMT_VYUY", Place::Byte { step: 2, first: 1 }),
    Layout::of(b"MJPG", "V4L2_PIX_FMT_MJPEG", Place::Jpeg),
];

/// The four characters of a format, for messages.
pub(super) fn name_of(code: u32) -> String {
    let text: String =
        code.to_le_bytes().iter().map(|b| if b.is_ascii_graphic() { *b as char } else { ' ' }).collect();
    text.trim_end().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn named(name: &str) -> &'static Layout {
        LAYOUTS.iter().find(|l| name_of(l.code) == name).unwrap()
    }

    #[test]
    fn each_format_gives_its_grey_levels_and_no_colour() {
        let mut out = Vec::new();
        // Two rows of two pixels: 10 20 / 30 40; rows are padded by 0xee, colours are 0xcc.
        let cases: [(&str, Vec<u8>, usize); 6] = [
            ("GREY", vec![10, 20, 0xee, 30, 40], 3),
            ("NV12", vec![10, 20, 30, 40, 0xcc, 0xcc], 2),
            ("YUYV", vec![10, 0xcc, 20, 0xcc, 0xee, 30, 0xcc, 40, 0xcc], 5),
            ("UYVY", vec![0xcc, 10, 0xcc, 20, 0xcc, 30, 0xcc, 40], 4),
            ("Y10", vec![40, 0, 80, 0, 120, 0, 160, 0], 4),
            ("Y16", vec![0xff, 10, 0, 20, 0, 30, 0xee, 40], 4),
        ];
        for (name, bytes, stride) in cases {
            assert!(named(name).grey(&bytes, stride, [2, 2], &mut out), "{name}");
            assert_eq!(out, [10, 20, 30, 40], "{name}");
            // One byte less than the last grey level needs.
            let colours = if name == "NV12" { 2 } else { 0 };
            let short = &bytes[..bytes.len() - colours - 1];
            assert!(!named(name).grey(short, stride, [2, 2], &mut out), "{name}");
        }
        // Levels beyond the ten bits that a pixel may have stay white.
        assert!(named("Y10").grey(&[0xff, 0xff], 2, [1, 1], &mut out));
        assert_eq!(out, [255]);
        assert!(!named("GREY").grey(&[1, 2, 3, 4], 1, [2, 2], &mut out), "rows overlap");
    }
}
