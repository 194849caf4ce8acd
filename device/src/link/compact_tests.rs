//! Laws of compaction: the chosen form decodes to the plane, is worth its time, and stays within its cost limits.

use super::*;
use crate::link::codec::RleDecoder;

const FAST_NS: i64 = 1_055_966;

fn noise(seed: u64, n: usize) -> Vec<u8> {
    let byte = |i: u64| {
        // The finaliser of SplitMix64.
        let mut z = (seed << 32 ^ i).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z >> 56) as u8
    };
    (1..=n as u64).map(byte).collect()
}

/// A plane that repeats itself without runs: only LZ4 makes it short.
fn periodic(n: usize, seed: u64) -> Vec<u8> {
    noise(seed, 48).into_iter().cycle().take(n).collect()
}

fn decoded(c: &Compactor, k: usize, form: PlaneForm, plane: &[u8], base: &[u8]) -> Vec<u8> {
    let PlaneForm::Coded(codec, n) = form else {
        return if form == PlaneForm::Kept { base.to_vec() } else { plane.to_vec() };
    };
    let coded = c.coded(k, n);
    let (mut out, mut decoder) = match codec {
        Codec::Rle => (vec![0xee; plane.len()], RleDecoder::new()),
        Codec::XorRle => (base.to_vec(), RleDecoder::new_xor()),
        _ => return lz4_flex::block::decompress(coded, plane.len()).expect("a block"),
    };
    decoder.push(coded, &mut out).expect("tokens");
    decoder.finish(plane.len()).expect("a whole plane");
    out
}

/// Frames with all kinds of planes: still, dark with something moving, half new, noise, periodic.
fn frame(raster: Raster, n: u64) -> Vec<u8> {
    let bytes = raster.plane_bytes();
    let mut dark = vec![0; bytes];
    dark[(n as usize * 37) % (bytes - 200)..][..150].copy_from_slice(&noise(n, 150));
    let mut half = noise(77, bytes);
    half[..bytes / 8].copy_from_slice(&noise(n, bytes / 8));
    [noise(5, bytes), dark, half, noise(n, bytes), periodic(bytes, n)].concat()
}

#[test]
fn every_form_is_the_plane_and_the_right_one() {
    let raster = Raster::new(512, 64).unwrap();
    let bytes = raster.plane_bytes();
    for codecs in 0..16 {
        let mut c = Compactor::new(raster, 5, FAST_NS, codecs);
        let mut base = vec![0; 5 * bytes];
        for n in 0..60 {
            let planes = frame(raster, n);
            // A medium that is slow in the second half, and now and then a frame that does not get through.
            if n >= 30 {
                c.refused();
            }
            let has_base = n > 0 && n != 20;
            let forms = c.compact(&planes, has_base);
            for (k, plane) in planes.chunks_exact(bytes).enumerate() {
                let theirs = &base[k * bytes..][..bytes];
                assert_eq!(
                    decoded(&c, k, forms[k], plane, theirs),
                    plane,
                    "frame {n}, plane {k}, {:?}",
                    forms[k]
                );
                if let PlaneForm::Coded(codec, n) = forms[k] {
                    assert!(codecs & codec.mask() != 0 && n < bytes - bytes / 32, "{codec:?} {n}");
                }
            }
            assert_eq!(forms[0] == PlaneForm::Kept, has_base, "a still plane is not sent");
            assert_eq!(forms[3], PlaneForm::Raw, "noise stays as it is");
            let pressed = n >= 30 + u64::from(RETRIAL);
            if codecs == Codec::ALL && n > 21 {
                assert!(matches!(forms[1], PlaneForm::Coded(Codec::Rle, _)), "{:?}", forms[1]);
                assert!(matches!(forms[2], PlaneForm::Coded(Codec::XorRle, _)), "{:?}", forms[2]);
                if n < 30 {
                    assert_eq!(forms[4], PlaneForm::Raw, "LZ4 waits until the medium refuses");
                } else if pressed {
                    assert!(matches!(forms[4], PlaneForm::Coded(Codec::Lz4, _)), "{:?}", forms[4]);
                }
            }
            if n % 7 != 6 {
                c.sent(&planes);
                base = planes;
            }
        }
    }
}

#[test]
fn lz4_takes_at_most_half_a_frames_time_and_goes_where_it_saves_most() {
    let raster = Raster::new(1024, 768).unwrap();
    let bytes = raster.plane_bytes();
    // Half of 1.056 ms at the assumed speed is five planes of 98,304 bytes.
    let mut c = Compactor::new(raster, 8, FAST_NS, Codec::ALL);
    assert_eq!(c.lz4_planes, 5);
    let mut at_most = 0;
    for n in 0..40 {
        // Every plane is periodic up to a different length: the first ones least.
        let planes: Vec<u8> = (0..8)
            .flat_map(|k| {
                let long = bytes / 4 + k * bytes / 16;
                [periodic(long, n * 8 + k as u64), noise(n * 8 + k as u64, bytes - long)].concat()
            })
            .collect();
        c.refused();
        let forms = c.compact(&planes, n > 0);
        c.sent(&planes);
        let by_lz4: Vec<usize> =
            (0..8).filter(|&k| matches!(forms[k], PlaneForm::Coded(Codec::Lz4, _))).collect();
        if n > 2 * u64::from(RETRIAL) {
            let tried = (0..8).filter(|k| (n as u32 + 1 + k).is_multiple_of(RETRIAL)).count();
            assert!(by_lz4.len() <= 5 + tried, "frame {n}: {by_lz4:?}");
            assert!([3, 4, 5, 6, 7].iter().all(|k| by_lz4.contains(k)), "frame {n}: {by_lz4:?}");
            at_most = at_most.max(by_lz4.len());
        }
    }
    assert!(at_most >= 5);
    let slow = Compactor::new(raster, 8, 33_000_000, Codec::ALL);
    assert_eq!(slow.lz4_planes, MAX_PLANES, "thirty frames a second leave time for all");
}

/// What is touched is counted: a kept plane is compared and no more; noise is compared to its first difference and becomes the
/// next base; between trials nothing else is read.
#[test]
fn touched_bytes_are_those_that_were_read_and_written() {
    let raster = Raster::new(512, 64).unwrap();
    let bytes = raster.plane_bytes();
    let mut c = Compactor::new(raster, 2, FAST_NS, Codec::ALL);
    let still = noise(9, bytes);
    for n in 0..3 {
        let planes = [still.clone(), noise(100 + n, bytes)].concat();
        c.compact(&planes, n > 0);
        c.sent(&planes);
        let touched = c.take_touched();
        let (compared, base) = (2 * bytes as u64, 2 * bytes as u64);
        if n == 2 {
            assert_eq!(touched, compared + 2 * 1024 + base);
        }
    }
}
