//! Laws of the image format: golden streams, round trips of any planes, sizes, and survival of any bytes.

use super::*;
use proptest::prelude::*;
use test_meter::core_seconds;

const ORDER: PlaneOrder = PlaneOrder::Descending;

/// The stream of the guide's example 2-110. It says that `82 01` repeats 513 times; by its own length rule that is 130.
#[rustfmt::skip]
const GOLDEN_ERLE: [u8; 35] = [
    0x03, 0x04, 0x05, 0x06, 0x05, 0x77, 0x77, 0x77, 0x00, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0a, 0x0b, 0x0c,
    0x82, 0x01, 0x78, 0x9a, 0xbc, 0x00, 0x00, 0x01, 0x01, 0x02, 0x03, 0x00, 0x01, 0x09, 0x00, 0x01,
];

fn header(width: u16, height: u16, compression: Compression) -> ImageHeader {
    ImageHeader { width, height, encoded_bytes: 0, background: [0; 4], compression }
}

fn golden_lines() -> (Vec<[u8; 3]>, Vec<[u8; 3]>) {
    let (a, b, c) = ([4, 5, 6], [0x77; 3], [0x78, 0x9a, 0xbc]);
    let mut first = vec![a, a, a, b, b, b, b, b, a, [7, 8, 9], [10, 11, 12]];
    first.extend(std::iter::repeat_n(c, 130));
    let mut second = vec![[1, 2, 3], a, a, b, b, b, b, b, a, [7, 8, 9]];
    second.resize(first.len(), [0; 3]);
    (first, second)
}

#[test]
fn golden_erle_stream_of_the_guide_expands_as_it_should() {
    let (first, second) = golden_lines();
    let width = first.len();
    assert_eq!(width, 141);
    // The example's second line ends early, and the image with it; it is filled up here so that the image is complete.
    let mut stream = GOLDEN_ERLE[..33].to_vec();
    stream.extend_from_slice(&[0x83, 0x01, 0, 0, 0, 0x00, 0x01, 0x00]);
    for chunk in [1, 2, 3, 7, 100] {
        let mut d = ImageDecoder::new(&header(141, 2, Compression::Erle), 141, 2).unwrap();
        for part in stream.chunks(chunk) {
            assert!(!d.is_complete());
            d.push(part).unwrap();
        }
        assert!(d.is_complete());
        assert_eq!(d.oddities(), 0);
        assert_eq!(d.finish().unwrap(), [first.concat(), second.concat()].concat());
    }
    // When the stream is cut where the example ends, the pixels that it describes are there.
    let mut d = ImageDecoder::new(&header(141, 2, Compression::Erle), 141, 2).unwrap();
    d.push(&GOLDEN_ERLE[..33]).unwrap();
    assert_eq!(d.pixels()[..141 * 3], first.concat());
    assert_eq!(d.pixels()[141 * 3..151 * 3], second[..10].concat());
}

#[test]
fn golden_rle_stream_with_padding_and_two_byte_erle_lengths() {
    // 2 x 2: a run of two; end of line padded to 8; two literals; end of line; end of image.
    let stream = [2, 1, 2, 3, 0, 0, 0, 0, 0, 2, 4, 5, 6, 7, 8, 9, 0, 0, 0, 0, 0, 1, 0, 0];
    let mut d = ImageDecoder::new(&header(2, 2, Compression::Rle), 2, 2).unwrap();
    d.push(&stream).unwrap();
    assert_eq!(d.oddities(), 0);
    assert_eq!(d.finish().unwrap(), [1, 2, 3, 1, 2, 3, 4, 5, 6, 7, 8, 9]);
    // 0x1234 = 4660 is written B4 24.
    let raster = Raster::new(4660, 1).unwrap();
    let plane = vec![0xff; raster.plane_bytes()];
    let image = encode(&[&plane], raster, 0..4660, ORDER, Some(Compression::Erle)).unwrap();
    assert_eq!(image.bytes[48..], [0xb4, 0x24, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]);
}

#[test]
fn golden_header_bytes() {
    let h = ImageHeader {
        width: 1920,
        height: 1080,
        encoded_bytes: 0x0102_0304,
        background: [1, 2, 3, 0],
        compression: Compression::Erle,
    };
    #[rustfmt::skip]
    let golden = [
        0x53, 0x70, 0x6c, 0x64, 0x80, 0x07, 0x38, 0x04, 0x04, 0x03, 0x02, 0x01, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff,
        1, 2, 3, 0, 0, 2, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
    ];
    assert_eq!(h.encode(), golden);
    assert_eq!(ImageHeader::decode(&golden), Ok(h));
    let mut bad = golden;
    bad[25] = 3;
    assert_eq!(ImageHeader::decode(&bad), Err(ImageError::Compression(3)));
    bad[0] = 0;
    assert!(matches!(ImageHeader::decode(&bad), Err(ImageError::Signature(_))));
}

/// Every image with a single plane set: the three bytes of a pixel follow from the definition of the two orders.
#[test]
fn planes_stand_in_the_bytes_that_the_order_names() {
    let raster = Raster::new(9, 1).unwrap();
    for plane in 0..24 {
        let mut planes = vec![vec![0u8, 0]; 24];
        // Pixels 1 and 8.
        planes[plane] = vec![0x40, 0x80];
        let views: Vec<&[u8]> = planes.iter().map(|p| &p[..]).collect();
        for (order, byte) in
            [(PlaneOrder::Descending, [2, 1, 0][plane / 8]), (PlaneOrder::BlueGreenRed, [1, 2, 0][plane / 8])]
        {
            let raw = encode(&views, raster, 0..9, order, Some(Compression::Raw)).unwrap();
            let mut expected = [0u8; 27];
            expected[3 + byte] = 1 << (plane % 8);
            expected[24 + byte] = 1 << (plane % 8);
            assert_eq!(raw.bytes[48..75], expected, "{order:?} plane {plane}");
            let mut back = [0xffu8, 0x80];
            extract_plane(&expected, plane, order, raster, 0..9, &mut back);
            assert_eq!(back, [0x40, 0x80]);
        }
    }
}

/// Bytes of SplitMix64.
fn noise(seed: u64, bytes: usize) -> Vec<u8> {
    let mut s = seed.wrapping_mul(0xd134_2543_de82_ef95);
    (0..bytes)
        .map(|_| {
            s = s.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let z = (s ^ (s >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            ((z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb) >> 56) as u8
        })
        .collect()
}

fn round_trip(
    planes: &[Vec<u8>],
    raster: Raster,
    columns: std::ops::Range<usize>,
    compression: Option<Compression>,
) -> EncodedImage {
    let views: Vec<&[u8]> = planes.iter().map(|p| &p[..]).collect();
    let image = encode(&views, raster, columns.clone(), ORDER, compression).unwrap();
    let declared = ImageHeader::decode(image.bytes.first_chunk().unwrap()).unwrap();
    assert_eq!(declared.encoded_bytes as usize + HEADER_BYTES, image.bytes.len());
    let mut decoder = ImageDecoder::new(&declared, columns.len() as u32, raster.height()).unwrap();
    decoder.push(&image.bytes[HEADER_BYTES..]).unwrap();
    assert!(decoder.is_complete());
    assert_eq!(decoder.oddities(), 0, "our own streams keep every rule");
    let pixels = decoder.finish().unwrap();
    for (i, plane) in planes.iter().enumerate() {
        let mut back = plane.clone();
        extract_plane(&pixels, i, ORDER, raster, columns.clone(), &mut back);
        assert!(back == *plane, "plane {i} by {:?}", image.compression);
    }
    image
}

/// The smallest encoding is used, and noise costs no more than its raw size and the heads of its literals.
#[test]
fn noise_hardly_grows_and_full_hd_takes_well_under_a_second() {
    let raster = Raster::new(1920, 1080).unwrap();
    let planes: Vec<_> = (0..24).map(|i| noise(i, raster.plane_bytes())).collect();
    let views: Vec<&[u8]> = planes.iter().map(|p| &p[..]).collect();
    let start = core_seconds();
    let image = encode(&views, raster, 0..1920, ORDER, None).unwrap();
    let took = core_seconds() - start;
    assert!(took < 1.0, "encoding took {took:.3} core-seconds");
    let raw = raster.pixel_count() * 3;
    assert_eq!(image.compression, Compression::Raw, "nothing can be saved on noise");
    assert_eq!(image.bytes.len(), HEADER_BYTES + raw);
    for (c, per_line) in [(Compression::Rle, 2 * 1920 / 255 + 8), (Compression::Erle, 5 + 2)] {
        let start = core_seconds();
        let image = round_trip(&planes, raster, 0..1920, Some(c));
        println!("1920x1080x24 noise, {c:?} there and back: {:.3} core-seconds", core_seconds() - start);
        assert!(
            image.bytes.len() <= raw + 1080 * per_line + HEADER_BYTES + 4,
            "{c:?}: {}",
            image.bytes.len() - raw
        );
    }
}

/// TI's figures for RLE (DLPA086): a 1 x 1 checkerboard grows, to 0.97 of raw; content with runs shrinks.
#[test]
fn size_factors_lie_where_the_vendor_measured_them() {
    let raster = Raster::new(1920, 1080).unwrap();
    let checker: Vec<u8> = (0..raster.height())
        .flat_map(|y| vec![if y % 2 == 0 { 0xaa } else { 0x55 }; raster.row_bytes()])
        .collect();
    let f = |planes: &[Vec<u8>], c| round_trip(planes, raster, 0..1920, Some(c)).factor(raster.pixel_count());
    let one = f(std::slice::from_ref(&checker), Compression::Rle);
    assert!((0.95..1.0).contains(&one), "checkerboard by RLE: {one}");
    // Lines 0, 2, 4, ... are equal but never neighbours, so ERLE copies nothing either.
    let white = vec![0xff; raster.plane_bytes()];
    // A run of 1920 takes 8 runs of 4 bytes, a 4-byte line end; ERLE 4 bytes and the end, then copies of 4 bytes and the end.
    let rle = round_trip(std::slice::from_ref(&white), raster, 0..1920, Some(Compression::Rle));
    assert_eq!(rle.bytes.len(), HEADER_BYTES + 1080 * (8 * 4 + 4) + 4);
    let erle = round_trip(std::slice::from_ref(&white), raster, 0..1920, Some(Compression::Erle));
    assert_eq!(erle.bytes.len(), HEADER_BYTES + (5 + 2 + 1079 * (4 + 2) + 3usize).next_multiple_of(4));
    let best = round_trip(std::slice::from_ref(&white), raster, 0..1920, None);
    assert_eq!(best, erle);
}

#[test]
fn tolerated_streams_are_counted_and_impossible_ones_refused() {
    let decode_all = |w: u16, h: u16, c, stream: &[u8]| {
        let mut d = ImageDecoder::new(&header(w, h, c), w.into(), h.into()).unwrap();
        d.push(stream)?;
        let odd = d.oddities();
        d.finish().map(|p| (p, odd))
    };
    // A run across the end of a line, no line ends.
    let over = decode_all(2, 2, Compression::Erle, &[4, 1, 1, 1, 0, 1, 0]);
    assert_eq!(over, Ok((vec![1; 12], 1)));
    // The rest of a line that ends early is black.
    let short = decode_all(2, 1, Compression::Erle, &[1, 9, 9, 9, 0, 0, 0, 1, 0]);
    assert_eq!(short, Ok((vec![9, 9, 9, 0, 0, 0], 1)));
    // No end mark, but all pixels.
    assert_eq!(decode_all(2, 1, Compression::Erle, &[2, 7, 7, 7]), Ok((vec![7; 6], 0)));
    // Anything after the end.
    assert!(decode_all(1, 1, Compression::Rle, &[1, 7, 7, 7, 0, 1, 99, 98]).is_ok());
    let many = decode_all(2, 1, Compression::Erle, &[3, 1, 1, 1]);
    assert_eq!(many, Err(ImageError::TooManyPixels { at: 3 }));
    let first = decode_all(2, 2, Compression::Erle, &[0, 1, 2]);
    assert_eq!(first, Err(ImageError::CopyWithoutLine { at: 2 }));
    let few = decode_all(2, 2, Compression::Erle, &[2, 1, 1, 1, 0, 1, 0]);
    assert_eq!(few, Err(ImageError::TooFewPixels { pixels: 2, wanted: 4 }));
    assert!(matches!(
        ImageDecoder::new(&header(1024, 768, Compression::Raw), 1920, 1080),
        Err(ImageError::Size { width: 1024, .. })
    ));
    let raster = Raster::new(8, 1).unwrap();
    assert_eq!(encode(&[&[0][..]; 25], raster, 0..8, ORDER, None), Err(ImageError::TooManyPlanes(25)));
    let odd = encode(&[&[0, 0][..]], raster, 0..8, ORDER, None);
    assert_eq!(odd, Err(ImageError::PlaneSize { plane: 0, bytes: 2, wanted: 1 }));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    /// Widths up to three times the longest RLE run, planes made of runs, repeated lines and noise.
    #[test]
    fn any_planes_round_trip_by_every_compression(
        width in 1u32..800, height in 1u32..6, count in 1usize..=24, seed: u64, run in 1usize..600, repeat_lines: bool, split in 0u32..=100
    ) {
        let raster = Raster::new(width, height).unwrap();
        let planes: Vec<Vec<u8>> = (0..count).map(|p| {
            let values = noise(seed ^ p as u64, (width * height) as usize);
            let mut plane = vec![0u8; raster.plane_bytes()];
            for y in 0..height as usize {
                for x in 0..width as usize {
                    let at = if repeat_lines { x } else { y * width as usize + x };
                    if values[at / run] & 1 != 0 {
                        plane[y * raster.row_bytes() + x / 8] |= 0x80 >> (x % 8);
                    }
                }
            }
            plane
        }).collect();
        let raw = round_trip(&planes, raster, 0..width as usize, Some(Compression::Raw));
        let rle = round_trip(&planes, raster, 0..width as usize, Some(Compression::Rle));
        let erle = round_trip(&planes, raster, 0..width as usize, Some(Compression::Erle));
        let best = round_trip(&planes, raster, 0..width as usize, None);
        prop_assert_eq!(best.bytes.len(), raw.bytes.len().min(rle.bytes.len()).min(erle.bytes.len()));
        // Two halves, one for each controller.
        let middle = (width * split / 100) as usize;
        for half in [0..middle, middle..width as usize] {
            if !half.is_empty() { round_trip(&planes, raster, half, None); }
        }
    }

    #[test]
    fn any_stream_is_survived_within_the_memory_of_one_image(
        stream in prop::collection::vec(any::<u8>(), 0..400), compression in 0u8..3, width in 1u16..40, height in 1u16..40
    ) {
        let h = header(width, height, Compression::from_byte(compression).unwrap());
        let mut d = ImageDecoder::new(&h, width.into(), height.into()).unwrap();
        let _ = d.push(&stream);
        prop_assert_eq!(d.pixels().len(), usize::from(width) * usize::from(height) * 3);
        prop_assert!(d.bytes_taken() <= stream.len());
        let _ = d.finish();
        let mut whole = h.encode().to_vec();
        whole.extend_from_slice(&stream);
        let _ = decode(&whole, width.into(), height.into());
        let _ = decode(&stream, width.into(), height.into());
    }
}
