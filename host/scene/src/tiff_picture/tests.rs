//! TIFF files that are made here, each texel of which is known. `tests/peers/files/run.py` holds the reader to files that
//! Pillow, OpenCV and tifffile write.

use super::{is_tiff, Tiff};
use std::io::Write;

/// A way to store a picture of 5 x 3 texels.
#[derive(Clone)]
struct TiffForm {
    is_big_endian: bool,
    is_large: bool,
    bits: u32,
    samples: usize,
    photometric: u64,
    compression: u64,
    predictor: u64,
    planar: bool,
    /// Sides of tiles, or rows of a strip.
    tile: Option<[usize; 2]>,
    more: Vec<(u16, Vec<u64>)>,
}

const SIDES: [usize; 2] = [5, 3];

impl Default for TiffForm {
    fn default() -> Self {
        Self {
            is_big_endian: false,
            is_large: false,
            bits: 8,
            samples: 3,
            photometric: 2,
            compression: 1,
            predictor: 1,
            planar: false,
            tile: None,
            more: vec![],
        }
    }
}

/// The code that number `i` of the texel at x, y has, of `bits` bits.
fn code(x: usize, y: usize, i: usize, bits: u32) -> u64 {
    let mixed = (x * 7919 + y * 104_729 + i * 1_299_709 + 12_345) as u64;
    mixed.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> (64 - bits)
}

impl TiffForm {
    fn number(&self, value: u64, bytes: usize) -> Vec<u8> {
        let little = value.to_le_bytes()[..bytes].to_vec();
        if self.is_big_endian {
            little.into_iter().rev().collect()
        } else {
            little
        }
    }

    /// A row of numbers, as it is before it is packed.
    fn row(&self, codes: &[u64], step: usize) -> Vec<u8> {
        if self.bits < 8 || !self.bits.is_multiple_of(8) {
            let bits: Vec<u8> =
                codes.iter().flat_map(|c| (0..self.bits).rev().map(move |b| (c >> b & 1) as u8)).collect();
            return bits
                .chunks(8)
                .map(|eight| eight.iter().enumerate().fold(0, |sum, (i, b)| sum | b << (7 - i)))
                .collect();
        }
        let size = self.bits as usize / 8;
        let mask = u64::MAX >> (64 - self.bits);
        match self.predictor {
            2 => {
                let before = |i: usize| if i < step { 0 } else { codes[i - step] };
                codes
                    .iter()
                    .enumerate()
                    .flat_map(|(i, c)| self.number(c.wrapping_sub(before(i)) & mask, size))
                    .collect()
            }
            3 => {
                // The bytes of all numbers sorted by their place, the highest first; then differences.
                let sorted: Vec<u8> = (0..size)
                    .rev()
                    .flat_map(|byte| codes.iter().map(move |c| (c >> (8 * byte)) as u8))
                    .collect();
                let before = |i: usize| if i < step { 0 } else { sorted[i - step] };
                sorted.iter().enumerate().map(|(i, b)| b.wrapping_sub(before(i))).collect()
            }
            _ => codes.iter().flat_map(|c| self.number(*c, size)).collect(),
        }
    }

    fn pack(&self, plain: Vec<u8>) -> Vec<u8> {
        match self.compression {
            8 => {
                let mut out = flate2::write::ZlibEncoder::new(vec![], flate2::Compression::fast());
                out.write_all(&plain).unwrap();
                out.finish().unwrap()
            }
            5 => {
                let form = weezl::encode::Configuration::with_tiff_size_switch(weezl::BitOrder::Msb, 8);
                form.build().encode(&plain).unwrap()
            }
            32_773 => plain.chunks(100).flat_map(|some| [&[some.len() as u8 - 1], some].concat()).collect(),
            _ => plain,
        }
    }

    /// The strips or tiles, of codes that `code` gives.
    fn chunks(&self, code: &dyn Fn(usize, usize, usize) -> u64) -> Vec<Vec<u8>> {
        let [wide, high] = self.tile.unwrap_or([SIDES[0], 2]);
        let planes: Vec<Vec<usize>> = if self.planar {
            (0..self.samples).map(|i| vec![i]).collect()
        } else {
            vec![(0..self.samples).collect()]
        };
        let mut out = vec![];
        for plane in &planes {
            for top in (0..SIDES[1]).step_by(high) {
                for left in (0..SIDES[0]).step_by(wide) {
                    let rows = if self.tile.is_some() { high } else { high.min(SIDES[1] - top) };
                    let of_row = |y: usize| {
                        let codes: Vec<u64> = (left..left + wide)
                            .flat_map(|x| plane.iter().map(move |i| (x, *i)))
                            .map(|(x, i)| code(x, y, i))
                            .collect();
                        self.row(&codes, plane.len())
                    };
                    out.push(self.pack((top..top + rows).flat_map(of_row).collect()));
                }
            }
        }
        out
    }

    fn file(&self, code: &dyn Fn(usize, usize, usize) -> u64) -> Vec<u8> {
        self.with_chunks(&self.chunks(code))
    }

    fn with_chunks(&self, chunks: &[Vec<u8>]) -> Vec<u8> {
        let word = if self.is_large { 8 } else { 4 };
        let mut out = if self.is_big_endian { b"MM".to_vec() } else { b"II".to_vec() };
        if self.is_large {
            out.extend([self.number(43, 2), self.number(8, 2), self.number(0, 2)].concat());
        } else {
            out.extend(self.number(42, 2));
        }
        // The directory comes last.
        let begin = out.len() + word;
        let length: usize = chunks.iter().map(|c| c.len().next_multiple_of(2)).sum();
        out.extend(self.number((begin + length) as u64, word));
        let mut offsets = vec![];
        for chunk in chunks {
            offsets.push(out.len() as u64);
            out.extend(chunk);
            out.resize(out.len().next_multiple_of(2), 0);
        }
        let lengths = chunks.iter().map(|chunk| chunk.len() as u64).collect();
        let mut entries = vec![
            (256, vec![SIDES[0] as u64]),
            (257, vec![SIDES[1] as u64]),
            (258, vec![self.bits.into(); self.samples]),
            (259, vec![self.compression]),
            (262, vec![self.photometric]),
            (277, vec![self.samples as u64]),
            (284, vec![1 + u64::from(self.planar)]),
            (317, vec![self.predictor]),
        ];
        match self.tile {
            Some([wide, high]) => entries.extend([
                (322, vec![wide as u64]),
                (323, vec![high as u64]),
                (324, offsets),
                (325, lengths),
            ]),
            None => entries.extend([(273, offsets), (278, vec![2]), (279, lengths)]),
        }
        entries.retain(|(tag, _)| self.more.iter().all(|(other, _)| other != tag));
        entries.extend(self.more.iter().cloned());
        entries.sort();
        let of_count = if self.is_large { 8 } else { 2 };
        let mut behind = out.len() + of_count + entries.len() * (4 + 2 * word) + word;
        out.extend(self.number(entries.len() as u64, of_count));
        let mut values = vec![];
        for (tag, numbers) in &entries {
            let bytes: Vec<u8> = numbers.iter().flat_map(|number| self.number(*number, 4)).collect();
            out.extend(
                [self.number((*tag).into(), 2), self.number(4, 2), self.number(numbers.len() as u64, word)]
                    .concat(),
            );
            if bytes.len() <= word {
                out.extend(&bytes);
                out.resize(out.len() + word - bytes.len(), 0);
            } else {
                out.extend(self.number(behind as u64, word));
                behind += bytes.len();
                values.extend(bytes);
            }
        }
        out.extend(self.number(0, word));
        out.extend(values);
        out
    }
}

/// Sides, every texel row by row, and what is said of the picture.
type Shown = ([u32; 2], Vec<[f32; 4]>, Vec<String>);

fn read(bytes: &[u8]) -> Result<Shown, String> {
    assert!(is_tiff(bytes));
    let file = Tiff::open(bytes)?;
    let [width, height] = file.sides();
    let mut texels = vec![[0.0, 0.0, 0.0, -1.0]; (width * height) as usize];
    let told = file.read(64_000_000, |[x, y], texel| texels[(y * width + x) as usize] = texel)?;
    Ok(([width, height], texels, told))
}

fn places() -> impl Iterator<Item = (usize, usize)> {
    (0..SIDES[1]).flat_map(|y| (0..SIDES[0]).map(move |x| (x, y)))
}

fn check(form: &TiffForm, told: &str) {
    let bits = form.bits;
    let file = form.file(&|x, y, i| code(x, y, i, bits));
    let (_, texels, notes) = read(&file).unwrap_or_else(|e| panic!("{told}: {e}"));
    assert!(notes.is_empty(), "{told}: {notes:?}");
    let greatest = (u64::MAX >> (64 - bits)) as f64;
    for ((x, y), texel) in places().zip(&texels) {
        let of = |i: usize| (code(x, y, i, bits) as f64 / greatest) as f32;
        let rgb = if form.samples < 3 { [of(0); 3] } else { [of(0), of(1), of(2)] };
        let alpha = if matches!(form.samples, 2 | 4) { of(form.samples - 1) } else { 1.0 };
        assert_eq!(*texel, [rgb[0], rgb[1], rgb[2], alpha], "{told}, at {x}, {y}");
    }
}

#[test]
fn every_depth_order_packing_and_layout_gives_the_same_texels() {
    let mut tried = 0;
    for bits in [1, 2, 3, 4, 8, 10, 12, 16, 32, 64] {
        for (compression, predictor) in [(1, 1), (5, 1), (5, 2), (8, 1), (8, 2), (32_773, 1)] {
            for (samples, planar) in [(1, false), (2, false), (3, false), (3, true), (4, false), (4, true)] {
                for tile in [None, Some([16, 16]), Some([2, 2])] {
                    for (is_big_endian, is_large) in [(false, false), (true, false), (true, true)] {
                        if predictor == 2 && !matches!(bits, 8 | 16 | 32 | 64) {
                            continue;
                        }
                        let photometric = if samples < 3 { 1 } else { 2 };
                        let form = TiffForm {
                            is_big_endian,
                            is_large,
                            bits,
                            samples,
                            photometric,
                            compression,
                            predictor,
                            planar,
                            tile,
                            more: vec![],
                        };
                        check(&form, &format!("{bits} {compression} {predictor} {samples} {planar} {tile:?} {is_big_endian}"));
                        tried += 1;
                    }
                }
            }
        }
    }
    assert_eq!(tried, 54 * (4 * 6 + 6 * 4));
}

#[test]
fn floats_of_every_width_are_light_with_and_without_their_predictor() {
    let light = |x: usize, y: usize, i: usize| (x * 3 + y * 5 + i) as f32 * 0.375 - 1.0;
    for (bits, predictor) in [(16, 1), (16, 3), (24, 1), (32, 1), (32, 3), (32, 2), (64, 1), (64, 3)] {
        for is_big_endian in [false, true] {
            let compression = if predictor == 1 { 1 } else { 8 };
            let form = TiffForm {
                bits,
                predictor,
                compression,
                is_big_endian,
                more: vec![(339, vec![3; 3])],
                ..TiffForm::default()
            };
            let raw = |x, y, i| {
                let value = light(x, y, i);
                match bits {
                    16 => half::f16::from_f32(value).to_bits().into(),
                    24 => {
                        let whole = value.to_bits();
                        let exponent = (whole >> 23 & 0xff) as i32 - 127;
                        let small = if value == 0.0 {
                            0
                        } else {
                            ((exponent + 63) as u32) << 16 | whole >> 7 & 0xffff
                        };
                        (whole >> 31 << 23 | small).into()
                    }
                    32 => value.to_bits().into(),
                    _ => f64::from(value).to_bits(),
                }
            };
            let file = form.file(&raw);
            assert!(Tiff::open(&file).unwrap().is_light());
            let (_, texels, _) = read(&file).unwrap();
            for ((x, y), texel) in places().zip(&texels) {
                assert_eq!(texel[..3], [0, 1, 2].map(|i| light(x, y, i)), "{bits} {predictor} at {x}, {y}");
            }
        }
    }
    assert!(!Tiff::open(&TiffForm::default().file(&|_, _, _| 7)).unwrap().is_light());
}

#[test]
fn colours_by_a_list_by_inks_by_darkness_and_by_chroma() {
    let near = |a: [f32; 4], b: [f32; 4]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1.1 / 255.0);
    for bits in [1, 2, 4, 8] {
        let count = 1u64 << bits;
        let list = |shift: u64| {
            (0..3).flat_map(|c| (0..count).map(move |i| ((i * 53 + c * 91) % 256) << shift)).collect()
        };
        for shift in [8, 0] {
            let form = TiffForm {
                bits,
                samples: 1,
                photometric: 3,
                more: vec![(320, list(shift))],
                ..TiffForm::default()
            };
            let (_, texels, _) = read(&form.file(&|x, y, _| code(x, y, 0, bits))).unwrap();
            for ((x, y), texel) in places().zip(&texels) {
                let of = |c: u64| ((code(x, y, 0, bits) * 53 + c * 91) % 256) as f32 / 255.0;
                assert_eq!(*texel, [of(0), of(1), of(2), 1.0]);
            }
        }
    }
    let one = |form: &TiffForm, codes: &[u64]| read(&form.file(&|_, _, i| codes[i])).unwrap().1[0];
    let dark = TiffForm { samples: 1, photometric: 0, ..TiffForm::default() };
    assert!(near(one(&dark, &[55]), [200.0 / 255.0, 200.0 / 255.0, 200.0 / 255.0, 1.0]));
    let inks = TiffForm { samples: 4, photometric: 5, ..TiffForm::default() };
    assert!(near(one(&inks, &[0, 51, 255, 102]), [0.6, 0.48, 0.0, 1.0]));
    // The codes of JFIF for a red of 200, 30, 60, and of the same by Rec. 709 within 16 to 235.
    let chroma = TiffForm { photometric: 6, more: vec![(530, vec![1, 1])], ..TiffForm::default() };
    let red = [200.0 / 255.0, 30.0 / 255.0, 60.0 / 255.0, 1.0];
    assert!(near(one(&chroma, &[84, 114, 211]), red), "{:?}", one(&chroma, &[84, 114, 211]));
    let lab = TiffForm { photometric: 8, ..TiffForm::default() };
    // White, and a grey of 50: 118.9 of 255 in sRGB.
    assert!(near(one(&lab, &[255, 0, 0]), [1.0; 4]));
    let grey = 118.9 / 255.0;
    assert!(near(one(&lab, &[128, 0, 0]), [grey, grey, grey, 1.0]), "{:?}", one(&lab, &[128, 0, 0]));
    let icc = TiffForm { photometric: 9, ..TiffForm::default() };
    assert!(near(one(&icc, &[128, 128, 128]), [grey, grey, grey, 1.0]));
}

#[test]
fn chroma_of_fewer_texels_is_spread() {
    // Units of 2 x 2 luminances over 5 x 3 texels: three across, two down.
    let unit = |u: u8| vec![10 * u, 10 * u + 1, 10 * u + 2, 10 * u + 3, 128, 128];
    let chunk: Vec<u8> = (0..6).flat_map(unit).collect();
    let form =
        TiffForm { photometric: 6, more: vec![(530, vec![2, 2]), (278, vec![4])], ..TiffForm::default() };
    let (_, texels, told) = read(&form.with_chunks(&[chunk])).unwrap();
    assert!(told.is_empty());
    for ((x, y), texel) in places().zip(&texels) {
        let luminance = 10 * (y / 2 * 3 + x / 2) + (y % 2) * 2 + x % 2;
        assert!((texel[1] - luminance as f32 / 255.0).abs() < 1e-4, "{x}, {y}: {texel:?}");
    }
}

#[test]
fn alpha_counts_as_the_file_names_it() {
    let of = |extra: Option<u64>| {
        let more = extra.map(|kind| (338, vec![kind])).into_iter().collect();
        let form = TiffForm { samples: 4, more, ..TiffForm::default() };
        let [r, _, _, alpha] = read(&form.file(&|_, _, i| [100, 0, 0, 200][i])).unwrap().1[0];
        [r, alpha].map(|x| (x * 255.0).round())
    };
    assert_eq!(
        [of(None), of(Some(0)), of(Some(1)), of(Some(2))],
        [[100.0, 200.0], [100.0, 255.0], [128.0, 200.0], [100.0, 200.0]]
    );
}

#[test]
fn pictures_are_turned_as_they_are_shown() {
    for orientation in 1..=8u64 {
        let form = TiffForm {
            samples: 1,
            photometric: 1,
            more: vec![(274, vec![orientation])],
            ..TiffForm::default()
        };
        let ([width, height], texels, _) = read(&form.file(&|x, y, _| (10 * y + x) as u64)).unwrap();
        assert_eq!([width, height], if orientation < 5 { [5, 3] } else { [3, 5] });
        let code = |x: u32, y: u32| (texels[(y * width + x) as usize][0] * 255.0).round() as u32;
        // Where row 0 and column 0 of the file are shown, after the table of the format.
        let corner = match orientation {
            1 | 5 => code(0, 0),
            2 | 6 => code(width - 1, 0),
            3 | 7 => code(width - 1, height - 1),
            _ => code(0, height - 1),
        };
        assert_eq!(corner, 0, "{orientation}");
        // The end of the first row of the file.
        let end = match orientation {
            1 => code(4, 0),
            2 => code(0, 0),
            3 => code(0, 2),
            4 => code(4, 2),
            5 => code(0, 4),
            6 => code(2, 4),
            7 => code(2, 0),
            _ => code(0, 0),
        };
        assert_eq!(end, 4, "{orientation}");
    }
}

#[test]
fn what_is_missing_is_counted_and_what_is_not_read_is_named() {
    let form = TiffForm { compression: 8, ..TiffForm::default() };
    let mut chunks = form.chunks(&|x, y, i| code(x, y, i, 8));
    let half = chunks[0].len() / 2;
    chunks[0].truncate(half);
    let (_, texels, told) = read(&form.with_chunks(&chunks)).unwrap();
    let there = texels.iter().filter(|texel| texel[3] >= 0.0).count();
    assert!(
        (5..15).contains(&there) && told[0].contains(&format!("{} of its 15 texels are missing", 15 - there)),
        "{told:?}"
    );
    let whole = form.file(&|x, y, i| code(x, y, i, 8));
    for end in 4..whole.len() {
        if let Ok((_, texels, told)) = read(&whole[..end]) {
            assert!(!told.is_empty() || texels.iter().all(|texel| texel[3] == 1.0));
        }
    }
    let refused = |form: TiffForm| read(&form.file(&|_, _, _| 0)).unwrap_err();
    for (number, word) in [
        (34_925, "LZMA"),
        (33_003, "JPEG 2000"),
        (2, "lines of a fax"),
        (6, "before 1995"),
        (777, "no version"),
    ] {
        let told = refused(TiffForm { compression: number, ..TiffForm::default() });
        assert!(told.contains(word) && told.contains("save it"), "{told}");
    }
    for (number, word) in [(32_803, "sensor"), (32_845, "logarithms"), (99, "no colours")] {
        let told = refused(TiffForm { photometric: number, ..TiffForm::default() });
        assert!(told.contains(word) && told.contains("save it"), "{told}");
    }
    let pages = {
        let mut file = TiffForm::default().file(&|_, _, _| 9);
        // The directory points to itself as the next one: a circle ends.
        let begin = u32::from_le_bytes(file[4..8].try_into().unwrap()) as usize;
        let next = begin + 2 + 12 * usize::from(file[begin]);
        file.copy_within(4..8, next);
        read(&file).unwrap().2
    };
    assert!(pages[0].contains("the first of its 1000 pages is used"), "{pages:?}");
}
