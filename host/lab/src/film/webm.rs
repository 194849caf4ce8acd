//! Pictures into a WebM: AV1 by `rav1e`, in the few elements of Matroska that a player asks for.
//!
//! GIF and PNG stand beside it because any page shows them. A WebM is for a film that would be too coarse in 255 colours.
//! Source of the container: \[RFC9559\]; of what a block holds: "Carriage of AV1 in Matroska and WebM" of the Alliance for Open Media.

use crate::paint::Canvas;
use rav1e::prelude::*;
use std::io;

/// Quantizers of `rav1e` (0 to 255), from the best film to the smallest.
const QUANTIZERS: [usize; 4] = [80, 110, 145, 180];
/// Speed preset of `rav1e`, 0 to 10: a film of eight seconds takes about as long to encode as to render.
const SPEED: u8 = 9;
/// A player can start at every so many pictures.
const KEY_EVERY: u64 = 60;
/// What begins each packet of `rav1e` and has no place in a block.
const TEMPORAL_DELIMITER: [u8; 2] = [0x12, 0x00];
/// Kind and number of the only track.
const TRACK: u8 = 1;

/// One encoded picture.
struct CodedPicture {
    bytes: Vec<u8>,
    /// Whether a player can start here.
    is_key: bool,
    /// Number of the picture from the start.
    number: u64,
}

/// The film in at most `largest` bytes, or as small as it gets.
///
/// # Errors
/// The encoder refuses the size of the pictures or fails.
pub(super) fn encoded(pictures: &[Canvas], per_second: u32, largest: usize) -> io::Result<Vec<u8>> {
    let mut film = Vec::new();
    for quantizer in QUANTIZERS {
        let (header, coded) = coded(pictures, per_second, quantizer)?;
        film = webm(&pictures[0], per_second, &header, &coded);
        if film.len() <= largest {
            break;
        }
    }
    Ok(film)
}

/// The codec's private data and the pictures in the order in which they are shown.
fn coded(pictures: &[Canvas], per_second: u32, quantizer: usize) -> io::Result<(Vec<u8>, Vec<CodedPicture>)> {
    let mut encoder = EncoderConfig::with_speed_preset(SPEED);
    (encoder.width, encoder.height) = (pictures[0].width, pictures[0].height);
    encoder.time_base = Rational::new(1, per_second.into());
    encoder.quantizer = quantizer;
    encoder.max_key_frame_interval = KEY_EVERY;
    encoder.color_description = Some(ColorDescription {
        color_primaries: ColorPrimaries::BT709,
        transfer_characteristics: TransferCharacteristics::SRGB,
        matrix_coefficients: MatrixCoefficients::BT709,
    });
    let config = Config::new().with_encoder_config(encoder).with_threads(2);
    let mut context: Context<u8> = config.new_context().map_err(io::Error::other)?;
    for picture in pictures {
        let mut frame = context.new_frame();
        for (plane, samples) in frame.planes.iter_mut().zip(planes(picture)) {
            plane.copy_from_raw_u8(&samples.values, samples.width, 1);
        }
        context.send_frame(frame).map_err(io::Error::other)?;
    }
    context.flush();
    let mut coded = Vec::new();
    loop {
        match context.receive_packet() {
            Ok(packet) => coded.push(CodedPicture {
                bytes: packet.data.strip_prefix(&TEMPORAL_DELIMITER).unwrap_or(&packet.data).to_vec(),
                is_key: packet.frame_type == FrameType::KEY,
                number: packet.input_frameno,
            }),
            Err(EncoderStatus::Encoded) => {}
            Err(EncoderStatus::LimitReached) => break,
            Err(failure) => return Err(io::Error::other(failure)),
        }
    }
    Ok((context.container_sequence_header(), coded))
}

/// One of the planes luma, blue-difference and red-difference.
struct SamplePlane {
    /// Samples in a row.
    width: usize,
    /// Row by row.
    values: Vec<u8>,
}

/// The planes of `picture` in limited range, the colour differences at half the width and height (BT.709).
fn planes(picture: &Canvas) -> [SamplePlane; 3] {
    let (width, height) = (picture.width, picture.height);
    let at = |x: usize, y: usize| {
        let pixel = &picture.rgb[3 * (y.min(height - 1) * width + x.min(width - 1))..][..3];
        [f32::from(pixel[0]), f32::from(pixel[1]), f32::from(pixel[2])]
    };
    let luma = |[r, g, b]: [f32; 3]| 0.2126 * r + 0.7152 * g + 0.0722 * b;
    let mut y_plane = SamplePlane { width, values: Vec::with_capacity(width * height) };
    for y in 0..height {
        y_plane.values.extend((0..width).map(|x| (16.0 + luma(at(x, y)) * 219.0 / 255.0).round() as u8));
    }
    let (half_width, half_height) = (width.div_ceil(2), height.div_ceil(2));
    let mut differences = [0, 1].map(|_| SamplePlane { width: half_width, values: Vec::new() });
    for y in 0..half_height {
        for x in 0..half_width {
            let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| at(2 * x + i, 2 * y + j));
            let mean = [0, 1, 2].map(|c| four.iter().map(|pixel| pixel[c]).sum::<f32>() / 4.0);
            let differ = [(mean[2] - luma(mean)) / 1.8556, (mean[0] - luma(mean)) / 1.5748];
            for (plane, difference) in differences.iter_mut().zip(differ) {
                plane.values.push((128.0 + difference * 224.0 / 255.0).round() as u8);
            }
        }
    }
    let [blue, red] = differences;
    [y_plane, blue, red]
}

/// An element of EBML: its identifier, its length in eight bytes, its body.
fn element(id: u32, body: &[u8]) -> Vec<u8> {
    let id = id.to_be_bytes();
    let begin = id.iter().position(|byte| *byte != 0).unwrap_or(3);
    let length = (1u64 << 56 | body.len() as u64).to_be_bytes();
    [&id[begin..], &length, body].concat()
}

fn number(id: u32, value: u64) -> Vec<u8> {
    element(id, &value.to_be_bytes())
}

/// The file: head, what is in it, the track, and a cluster from each key picture to the next.
fn webm(picture: &Canvas, per_second: u32, header: &[u8], coded: &[CodedPicture]) -> Vec<u8> {
    let head = [
        number(0x4286, 1),        // EBMLVersion
        number(0x42f7, 1),        // EBMLReadVersion
        number(0x42f2, 4),        // EBMLMaxIDLength
        number(0x42f3, 8),        // EBMLMaxSizeLength
        element(0x4282, b"webm"), // DocType
        number(0x4287, 4),        // DocTypeVersion
        number(0x4285, 2),        // DocTypeReadVersion
    ];
    let millisecond = |n: u64| n * 1000 / u64::from(per_second);
    let info = [
        number(0x2a_d7b1, 1_000_000), // TimestampScale: milliseconds
        element(0x4489, &(millisecond(coded.len() as u64) as f64).to_be_bytes()), // Duration
        element(0x4d80, b"dpm"),      // MuxingApp
        element(0x5741, b"dpm"),      // WritingApp
    ];
    let size = [number(0xb0, picture.width as u64), number(0xba, picture.height as u64)]; // PixelWidth, PixelHeight
    let track = [
        number(0xd7, TRACK.into()),                               // TrackNumber
        number(0x73c5, 1),                                        // TrackUID
        number(0x83, 1),                                          // TrackType: video
        number(0x9c, 0),                                          // FlagLacing
        number(0x23_e383, 1_000_000_000 / u64::from(per_second)), // DefaultDuration, nanoseconds
        element(0x86, b"V_AV1"),                                  // CodecID
        element(0x63a2, header),                                  // CodecPrivate
        element(0xe0, &size.concat()),                            // Video
    ];
    let mut segment = element(0x1549_a966, &info.concat());
    segment.extend(element(0x1654_ae6b, &element(0xae, &track.concat())));
    let (mut cues, mut rest) = (Vec::new(), coded);
    while let [first, ..] = rest {
        let length = 1 + rest[1..].iter().take_while(|picture| !picture.is_key).count();
        let start_ms = millisecond(first.number);
        let place = [number(0xf7, TRACK.into()), number(0xf1, segment.len() as u64)].concat();
        cues.extend(element(0xbb, &[number(0xb3, start_ms), element(0xb7, &place)].concat()));
        let mut cluster = number(0xe7, start_ms);
        for picture in &rest[..length] {
            let after_ms = (millisecond(picture.number) - start_ms) as i16;
            let block = [
                &[0x80 | TRACK],
                &after_ms.to_be_bytes()[..],
                &[u8::from(picture.is_key) << 7],
                &picture.bytes,
            ];
            cluster.extend(element(0xa3, &block.concat()));
        }
        segment.extend(element(0x1f43_b675, &cluster));
        rest = &rest[length..];
    }
    segment.extend(element(0x1c53_bb6b, &cues));
    [element(0x1a45_dfa3, &head.concat()), element(0x1853_8067, &segment)].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square that goes from left to right; the size is odd, so that half a colour difference stands at the edges.
    fn film(count: usize) -> Vec<Canvas> {
        let picture = |n: usize| {
            let inside = |i: usize| (i % 65).abs_diff(n) < 8 && (i / 65).abs_diff(20) < 8;
            let rgb =
                (0..65 * 49).flat_map(|i| if inside(i) { [250, 90, 10] } else { [20, 40, 60] }).collect();
            Canvas { width: 65, height: 49, rgb }
        };
        (0..count).map(picture).collect()
    }

    /// The elements that lie side by side in `bytes`, which they fill to the last byte.
    fn elements(mut bytes: &[u8]) -> Vec<(u32, &[u8])> {
        let mut found = Vec::new();
        while let [first, ..] = bytes {
            let (id, rest) = bytes.split_at(1 + first.leading_zeros() as usize);
            let id = id.iter().fold(0, |sum, byte| sum << 8 | u32::from(*byte));
            assert_eq!(rest[0], 1, "a length of eight bytes");
            let length = u64::from_be_bytes([&[0], &rest[1..8]].concat().try_into().unwrap());
            let (body, behind) = rest[8..].split_at(length as usize);
            found.push((id, body));
            bytes = behind;
        }
        found
    }

    fn all<'a>(among: &[(u32, &'a [u8])], wanted: u32) -> Vec<&'a [u8]> {
        among.iter().filter(|(id, _)| *id == wanted).map(|(_, body)| *body).collect()
    }

    #[test]
    fn every_picture_has_its_block_and_every_cue_its_cluster() {
        let count = KEY_EVERY as usize + 9;
        let bytes = encoded(&film(count), 15, usize::MAX).unwrap();
        let file = elements(&bytes);
        assert_eq!(file.iter().map(|(id, _)| *id).collect::<Vec<_>>(), [0x1a45_dfa3, 0x1853_8067]);
        let segment = file[1].1;
        let parts = elements(segment);
        let mut times_ms = Vec::new();
        for cluster in all(&parts, 0x1f43_b675) {
            let inner = elements(cluster);
            let start = i64::from_be_bytes(all(&inner, 0xe7)[0].try_into().unwrap());
            for (n, block) in all(&inner, 0xa3).into_iter().enumerate() {
                assert_eq!((block[0], block[3]), (0x80 | TRACK, if n == 0 { 0x80 } else { 0 }));
                assert_ne!(block[4..6], TEMPORAL_DELIMITER);
                times_ms.push(start + i64::from(i16::from_be_bytes([block[1], block[2]])));
            }
        }
        assert_eq!(times_ms, (0..count as i64).map(|n| n * 1000 / 15).collect::<Vec<_>>());
        let cues = elements(all(&parts, 0x1c53_bb6b)[0]);
        assert_eq!(cues.len(), all(&parts, 0x1f43_b675).len());
        for (_, cue) in cues {
            let place = all(&elements(all(&elements(cue), 0xb7)[0]), 0xf1)[0].to_vec();
            let at = u64::from_be_bytes(place.try_into().unwrap()) as usize;
            assert_eq!(segment[at..at + 4], [0x1f, 0x43, 0xb6, 0x75]);
        }
    }

    #[test]
    fn a_film_that_is_too_large_is_made_coarser() {
        let film = film(6);
        let [best, smallest] = [usize::MAX, 0].map(|largest| encoded(&film, 15, largest).unwrap().len());
        assert!(smallest < best, "{smallest} of {best} bytes");
    }

    #[test]
    fn greys_have_no_colour_difference_and_white_is_235() {
        let grey = |v: u8| Canvas { width: 3, height: 3, rgb: vec![v; 27] };
        for (given, luma) in [(0, 16), (255, 235), (128, 126)] {
            let [y, blue, red] = planes(&grey(given));
            assert_eq!((y.values[8], blue.values[3], red.values[3]), (luma, 128, 128));
        }
    }
}
