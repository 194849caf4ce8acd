//! Motion JPEG: each picture is a file of its own, from which cameras leave out the tables that all of them share.

use image::codecs::jpeg::JpegDecoder;
use image::{ColorType, ImageDecoder};
use std::io::Cursor;
use std::panic::{catch_unwind, AssertUnwindSafe};

/// Fills `out` with the grey levels of a picture of `size`. False, and nothing of use in `out`, if it is damaged or has
/// another size; a decoder that panics is caught.
pub fn motion_jpeg_grey(bytes: &[u8], size: [usize; 2], out: &mut Vec<u8>) -> bool {
    out.clear();
    catch_unwind(AssertUnwindSafe(|| grey(bytes, size, out))).ok().flatten().is_some()
}

fn grey(bytes: &[u8], [width, height]: [usize; 2], out: &mut Vec<u8>) -> Option<()> {
    // No camera makes the kinds whose blocks the decoder mistakes.
    if dpm_scene::is_odd_jpeg(bytes) {
        return None;
    }
    let whole = with_tables(bytes)?;
    let decoder = JpegDecoder::new(Cursor::new(&whole)).ok()?;
    // What it takes is bounded by the size that was asked for, not by what the picture says.
    let said = [decoder.dimensions().0, decoder.dimensions().1].map(|side| side as usize);
    if said != [width, height] {
        return None;
    }
    let pixels = width * height;
    match decoder.color_type() {
        ColorType::L8 => {
            out.resize(pixels, 0);
            decoder.read_image(out).ok()
        }
        ColorType::Rgb8 => {
            let mut colours = vec![0; 3 * pixels];
            decoder.read_image(&mut colours).ok()?;
            // The luminance that the picture was coded with, to the rounding of its colours.
            out.extend(colours.chunks_exact(3).map(|c| {
                ((77 * u32::from(c[0]) + 150 * u32::from(c[1]) + 29 * u32::from(c[2]) + 128) >> 8) as u8
            }));
            Some(())
        }
        _ => None,
    }
}

/// The picture with the usual Huffman tables before its data, if it has none of its own; `None` if it is no JPEG.
fn with_tables(bytes: &[u8]) -> Option<std::borrow::Cow<'_, [u8]>> {
    if !bytes.starts_with(&[0xff, 0xd8]) {
        return None;
    }
    let mut at = 2;
    loop {
        let &[0xff, marker, high, low] = bytes.get(at..at + 4)? else { return None };
        match marker {
            // Huffman tables.
            0xc4 => return Some(bytes.into()),
            // The data begin.
            0xda => return Some([&bytes[..at], &tables(), &bytes[at..]].concat().into()),
            _ => at += 2 + usize::from(u16::from_be_bytes([high, low])),
        }
    }
}

/// The tables of ITU-T T.81, annex K.3.3, as a segment: how many codes there are of each length, and their values.
fn tables() -> Vec<u8> {
    const FEW: [u8; 12] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11];
    let all: [(u8, [u8; 16], &[u8]); 4] = [
        (0x00, [0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0], &FEW),
        (0x01, [0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0], &FEW),
        (0x10, [0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 0x7d], &LUMINANCE),
        (0x11, [0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 0x77], &CHROMINANCE),
    ];
    let mut out = Vec::with_capacity(420);
    for (class, counts, values) in all {
        out.push(class);
        out.extend(counts);
        out.extend(values);
    }
    let length = (out.len() + 2) as u16;
    [&[0xff, 0xc4], &length.to_be_bytes()[..], &out].concat()
}

#[rustfmt::skip]
const LUMINANCE: [u8; 162] = [
    0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51, 0x61, 0x07, 0x22, 0x71,
    0x14, 0x32, 0x81, 0x91, 0xa1, 0x08, 0x23, 0x42, 0xb1, 0xc1, 0x15, 0x52, 0xd1, 0xf0, 0x24, 0x33, 0x62, 0x72,
    0x82, 0x09, 0x0a, 0x16, 0x17, 0x18, 0x19, 0x1a, 0x25, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x34, 0x35, 0x36, 0x37,
    0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59,
    0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a, 0x83,
    0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a, 0xa2, 0xa3,
    0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba, 0xc2, 0xc3,
    0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda, 0xe1, 0xe2,
    0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf1, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
];
#[rustfmt::skip]
const CHROMINANCE: [u8; 162] = [
    0x00, 0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61, 0x71, 0x13, 0x22,
    0x32, 0x81, 0x08, 0x14, 0x42, 0x91, 0xa1, 0xb1, 0xc1, 0x09, 0x23, 0x33, 0x52, 0xf0, 0x15, 0x62, 0x72, 0xd1,
    0x0a, 0x16, 0x24, 0x34, 0xe1, 0x25, 0xf1, 0x17, 0x18, 0x19, 0x1a, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x35, 0x36,
    0x37, 0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58,
    0x59, 0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a,
    0x82, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a,
    0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba,
    0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda,
    0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
];

#[cfg(test)]
mod tests {
    use super::*;
    use image::codecs::jpeg::JpegEncoder;
    use image::ExtendedColorType;

    const SIZE: [usize; 2] = [40, 24];

    /// A smooth picture as a JPEG, grey or in colours, and its grey levels.
    fn coded(colours: bool) -> (Vec<u8>, Vec<u8>) {
        let grey: Vec<u8> = (0..SIZE[0] * SIZE[1])
            .map(|i| {
                (128.0 + 90.0 * (0.2 * (i % SIZE[0]) as f64).sin() * (0.3 * (i / SIZE[0]) as f64).cos()) as u8
            })
            .collect();
        let mut out = Vec::new();
        let mut encoder = JpegEncoder::new_with_quality(&mut out, 95);
        let (w, h) = (SIZE[0] as u32, SIZE[1] as u32);
        if colours {
            let pixels: Vec<u8> = grey.iter().flat_map(|g| [*g; 3]).collect();
            encoder.encode(&pixels, w, h, ExtendedColorType::Rgb8).unwrap();
        } else {
            encoder.encode(&grey, w, h, ExtendedColorType::L8).unwrap();
        }
        (out, grey)
    }

    /// The same file without its Huffman tables, as USB cameras send it.
    fn without_tables(bytes: &[u8]) -> Vec<u8> {
        let (mut out, mut at) = (bytes[..2].to_vec(), 2);
        while bytes[at + 1] != 0xda {
            let end = at + 2 + usize::from(u16::from_be_bytes([bytes[at + 2], bytes[at + 3]]));
            if bytes[at + 1] != 0xc4 {
                out.extend(&bytes[at..end]);
            }
            at = end;
        }
        out.extend(&bytes[at..]);
        out
    }

    #[test]
    fn pictures_with_and_without_tables_give_their_grey() {
        let mut out = Vec::new();
        for colours in [false, true] {
            let (whole, grey) = coded(colours);
            let bare = without_tables(&whole);
            assert!(bare.len() < whole.len());
            for bytes in [&whole, &bare] {
                assert!(motion_jpeg_grey(bytes, SIZE, &mut out), "colours: {colours}");
                let worst = out.iter().zip(&grey).map(|(a, b)| a.abs_diff(*b)).max();
                assert!(out.len() == grey.len() && worst < Some(8), "colours: {colours}, {worst:?}");
            }
        }
    }

    #[test]
    fn damage_and_another_size_give_nothing() {
        let (whole, _) = coded(true);
        let mut out = Vec::new();
        assert!(!motion_jpeg_grey(&whole, [SIZE[0] + 8, SIZE[1]], &mut out));
        assert!(!motion_jpeg_grey(&[], SIZE, &mut out));
        assert!(!motion_jpeg_grey(b"no JPEG at all", SIZE, &mut out));
        // Found by a fuzzer: a second colour of more texels than the first, at which the decoder panics.
        // Its first byte is the fuzzer's.
        let odd = &include_bytes!("../../../../tests/corpus/motion_jpeg/found-77eb398d")[1..];
        assert!(dpm_scene::is_odd_jpeg(odd) && !motion_jpeg_grey(odd, [40, 24], &mut out));
        for n in 0..whole.len() {
            let is_whole = motion_jpeg_grey(&whole[..n], SIZE, &mut out);
            assert!(!is_whole || out.len() == SIZE[0] * SIZE[1], "{n} bytes");
            let mut flipped = whole.clone();
            flipped[n] ^= 0x11;
            let is_read = motion_jpeg_grey(&flipped, SIZE, &mut out);
            assert!(!is_read || out.len() == SIZE[0] * SIZE[1], "byte {n}");
        }
    }
}
