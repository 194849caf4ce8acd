//! Every packer against the definition, bit by bit, and against bytes written by hand.

use super::quantise::{quantise_scalar, ROUND};
use super::*;
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::rng::Sampler;

fn random_codes(raster: Raster, seed: u64) -> Vec<u32> {
    let mut bits = Sampler::new(seed, 0);
    // The top byte is garbage on purpose: it must not reach any plane.
    (0..raster.pixel_count()).map(|_| bits.next_u64() as u32).collect()
}

fn frame(width: u32, height: u32, schedule: PlaneSchedule) -> BitPlaneFrame {
    let mut frame = BitPlaneFrame::new(Raster::new(width, height).unwrap(), schedule);
    // A recycled frame holds the former one's bits.
    frame.bytes_mut().fill(0xa5);
    frame
}

/// Bit by bit, as [`dpm_device::planes`] has it.
fn pack_by_definition(codes: &[u32], frame: &mut BitPlaneFrame) {
    let raster = frame.raster();
    for (i, bit) in frame.source_bits().into_iter().enumerate().take(frame.schedule().len()) {
        let rows = frame.plane_mut(i).chunks_exact_mut(raster.row_bytes());
        for (row, pixels) in rows.zip(codes.chunks_exact(raster.width() as usize)) {
            for (byte, eight) in row.iter_mut().zip(pixels.chunks(8)) {
                *byte = 0;
                for (x, code) in eight.iter().enumerate() {
                    *byte |= ((code >> bit & 1) as u8) << (7 - x);
                }
            }
        }
    }
}

#[test]
fn bytes_written_by_hand() {
    // Ten pixels: two bytes a row, six padding bits. Red has bit 7 in pixels 0 and 9, green bit 0 in pixel 1, blue bit 3 in 8.
    let mut codes = [0xff00_0000u32; 10];
    codes[0] |= 0x80;
    codes[9] |= 0x80;
    codes[1] |= 0x0100;
    codes[8] |= 0x08_0000;
    let spec = |channel, bit| PlaneSpec { channel, bit };
    let schedule = PlaneSchedule::new(&[
        spec(Channel::Blue, 3),
        spec(Channel::Red, 7),
        spec(Channel::White, 0),
        spec(Channel::Green, 0),
        spec(Channel::Red, 0),
    ]);
    for &kernel in Kernel::available() {
        let mut frame = frame(10, 1, schedule.unwrap());
        pack(kernel, &codes, &mut frame);
        let want = [[0x00, 0x80], [0x80, 0x40], [0x40, 0x00], [0x40, 0x00], [0x00, 0x00]];
        for (i, want) in want.iter().enumerate() {
            assert_eq!(frame.plane(i), want, "{kernel:?} plane {i}");
        }
    }
}

#[test]
fn every_kernel_gives_the_same_bytes_on_every_size() {
    let sizes = [
        (1, 1),
        (1, 9),
        (7, 3),
        (8, 1),
        (8, 5),
        (9, 2),
        (31, 4),
        (32, 3),
        (33, 5),
        (63, 2),
        (64, 64),
        (65, 3),
        (72, 7),
        (100, 11),
        (504, 3),
        (511, 2),
        (512, 1),
        (513, 3),
        (520, 3),
        (1023, 2),
        (1024, 16),
        (1025, 2),
        (1920, 3),
        (8192, 1),
        (8191, 2),
        (3, 8192),
    ];
    // Miri takes a thousand times as long: the sizes around a block and a batch suffice for what it looks at.
    let is_affordable = |(width, height): &(u32, u32)| !cfg!(miri) || width * height <= 600;
    for (i, (width, height)) in sizes.into_iter().enumerate().filter(|(_, size)| is_affordable(size)) {
        let raster = Raster::new(width, height).unwrap();
        let codes = random_codes(raster, i as u64);
        // Bits shown twice, not at all, and out of order.
        let spec = |channel, bit| PlaneSpec { channel, bit };
        let odd = PlaneSchedule::new(&[
            spec(Channel::White, 7),
            spec(Channel::Blue, 2),
            spec(Channel::Green, 7),
            spec(Channel::Red, 0),
            spec(Channel::Green, 0),
            spec(Channel::White, 0),
        ]);
        for schedule in [PlaneSchedule::rgb24(), PlaneSchedule::mono8(), odd.unwrap()] {
            let mut want = frame(width, height, schedule);
            pack_by_definition(&codes, &mut want);
            for &kernel in Kernel::available() {
                let mut got = frame(width, height, schedule);
                pack(kernel, &codes, &mut got);
                assert!(got.bytes() == want.bytes(), "{kernel:?} {width} x {height} x {}", schedule.len());
            }
        }
    }
}

#[test]
fn unpacking_is_the_inverse() {
    for (width, height) in [(1, 1), (13, 5), (64, 3), (515, 2), (1024, if cfg!(miri) { 1 } else { 8 })] {
        let raster = Raster::new(width, height).unwrap();
        let codes = random_codes(raster, 7);
        let mut back = vec![u32::MAX; codes.len()];
        let mut frame = frame(width, height, PlaneSchedule::rgb24());
        pack(Kernel::best(), &codes, &mut frame);
        unpack(&frame, &mut back);
        assert!(codes.iter().zip(&back).all(|(c, b)| c & 0x00ff_ffff == *b), "{width} x {height}");
        let mut mono = super::tests::frame(width, height, PlaneSchedule::mono8());
        pack(Kernel::best(), &codes, &mut mono);
        unpack(&mono, &mut back);
        assert!(codes.iter().zip(&back).all(|(c, b)| c & 0xff00 == *b), "{width} x {height} mono");
    }
}

#[test]
fn light_of_the_planes_is_the_code_value() {
    // Plane weight 2^bit / 255, summed over the planes that a pixel is lit in, is code / 255.
    let codes: Vec<u32> = (0..256u32).map(|v| v | (255 - v) << 8 | (v ^ 0x5a) << 16).collect();
    let mut frame = frame(16, 16, PlaneSchedule::rgb24());
    pack(Kernel::best(), &codes, &mut frame);
    for (pixel, code) in codes.iter().enumerate() {
        let mut light = [0u32; 3];
        for (i, plane) in frame.schedule().planes().iter().enumerate() {
            let lit = frame.plane(i)[pixel / 8] >> (7 - pixel % 8) & 1;
            light[plane.channel as usize] += u32::from(lit) << plane.bit;
        }
        assert_eq!(light, [code & 255, code >> 8 & 255, code >> 16 & 255]);
    }
}

#[test]
#[cfg_attr(miri, ignore = "takes long, and its code has no `unsafe`")]
fn planes_start_on_a_cache_line_and_a_dark_frame_is_dark() {
    let mut frame = frame(1024, 768, PlaneSchedule::rgb24());
    assert_eq!(frame.len_bytes(), 24 * 98_304);
    for plane in 0..24 {
        assert_eq!(frame.plane(plane).as_ptr() as usize % 64, 0);
    }
    frame.clear();
    assert!(frame.bytes().iter().all(|&b| b == 0));
}

#[test]
#[should_panic(expected = "code values for a raster")]
fn a_wrong_count_of_pixels_is_a_programming_error() {
    pack(Kernel::best(), &[0; 3], &mut frame(2, 2, PlaneSchedule::mono8()));
}

fn quantise_one(v: f32, offset: Option<f32>) -> (u32, QuantiseCounts) {
    let mut code = [u32::MAX; 1];
    let counts = quantise(&[[v, v, v, f32::NAN]], offset.as_ref().map(std::slice::from_ref), &mut code);
    assert_eq!(code[0], (code[0] & 255) * 0x01_0101, "all channels alike, the top byte 0");
    (code[0] & 255, counts)
}

#[test]
fn the_ends_and_the_exact_levels() {
    assert_eq!(quantise_one(0.0, None).0, 0);
    assert_eq!(quantise_one(1.0, None).0, 255);
    for level in 0..=255u32 {
        let v = level as f32 / 255.0;
        assert_eq!(quantise_one(v, None).0, level);
        // Half a level up or down is the border.
        let border = (f64::from(level) + 0.5) / 255.0;
        assert_eq!(quantise_one((border * 0.999_99) as f32, None).0, level);
        assert_eq!(quantise_one((border * 1.000_01) as f32, None).0, (level + 1).min(255));
    }
}

#[test]
fn what_no_level_stands_for_is_clamped_and_counted() {
    let counts = |nan_pixels, clipped| QuantiseCounts { nan_pixels, clipped };
    assert_eq!(quantise_one(f32::NAN, None), (0, counts(1, 0)));
    assert_eq!(quantise_one(-f32::NAN, None), (0, counts(1, 0)));
    assert_eq!(quantise_one(f32::from_bits(0x7f80_0001), None), (0, counts(1, 0)));
    assert_eq!(quantise_one(f32::INFINITY, None), (255, counts(0, 3)));
    assert_eq!(quantise_one(f32::NEG_INFINITY, None), (0, counts(0, 0)));
    assert_eq!(quantise_one(1.000_000_1, None), (255, counts(0, 3)));
    assert_eq!(quantise_one(3e38, None), (255, counts(0, 3)));
    assert_eq!(quantise_one(-1e-30, None), (0, counts(0, 0)));
    assert_eq!(quantise_one(-0.0, None), (0, counts(0, 0)));
    assert_eq!(quantise_one(f32::MIN_POSITIVE / 4.0, None), (0, counts(0, 0)));
    let mut codes = [0; 2];
    let poisoned = quantise(&[[f32::NAN, 0.5, 2.0, 0.0], [0.25, 0.5, 1.0, 0.0]], None, &mut codes);
    assert_eq!(codes, [0xff_8000, 0xff_8040], "a NaN blackens its own channel only");
    assert_eq!(poisoned, counts(1, 1));
}

#[test]
fn the_vector_code_is_the_plain_code_bit_for_bit() {
    let mut bits = Sampler::new(3, 0);
    // All bit patterns are equally likely: NaNs, infinities and subnormals among them.
    let wild: Vec<[f32; 4]> =
        (0..4099).map(|_| std::array::from_fn(|_| f32::from_bits(bits.next_u64() as u32))).collect();
    let tame: Vec<[f32; 4]> =
        (0..4099).map(|_| std::array::from_fn(|_| (bits.next_u64() >> 40) as f32 / 16e6)).collect();
    let offsets: Vec<f32> = (0..4099).map(|_| (bits.next_u64() >> 40) as f32 / (1 << 24) as f32).collect();
    for drive in [&wild, &tame] {
        for offsets in [None, Some(&offsets[..])] {
            for len in [0, 1, 7, 8, 9, if cfg!(miri) { 99 } else { 4099 }] {
                let offsets = offsets.map(|o| &o[..len]);
                let (mut got, mut want) = (vec![1; len], vec![2; len]);
                let counts = quantise(&drive[..len], offsets, &mut got);
                assert_eq!(counts, quantise_scalar(&drive[..len], offsets, &mut want));
                assert_eq!(got, want);
            }
        }
    }
}

#[test]
fn dither_keeps_the_mean_and_the_ends() {
    let n = 4096;
    let offsets: Vec<f32> = (0..n).map(|i| i as f32 / n as f32).collect();
    for v in [0.0, 0.001, 0.3, 0.5, 0.777, 0.999, 1.0f32] {
        let mut codes = vec![0; n];
        quantise(&vec![[v; 4]; n], Some(&offsets), &mut codes);
        let mean = codes.iter().map(|c| f64::from(c & 255)).sum::<f64>() / n as f64;
        assert!((mean - 255.0 * f64::from(v)).abs() <= 1.0 / n as f64 + 1e-4, "{v}: {mean}");
    }
    let last_below_one = f32::from_bits(1.0f32.to_bits() - 1);
    assert_eq!(quantise_one(1.0, Some(last_below_one)).0, 255);
    assert_eq!(quantise_one(0.0, Some(last_below_one)).0, 0);
    assert_eq!(quantise_one(0.5, Some(ROUND)).0, 128);
}

/// Run by `cargo test --release -p dpm --lib -- --ignored packing_takes`.
#[test]
#[ignore = "timing: needs a quiet core and an optimised build"]
fn packing_takes_at_most_three_times_memcpy() {
    let raster = Raster::new(1024, 768).unwrap();
    let codes = random_codes(raster, 1);
    let mut frame = frame(1024, 768, PlaneSchedule::rgb24());
    let source = frame.bytes().to_vec();
    let mut copy = source.clone();
    for &kernel in Kernel::available().iter().filter(|k| **k != Kernel::Scalar) {
        let mut best = [f64::INFINITY; 2];
        for _ in 0..200 {
            let start = std::time::Instant::now();
            copy.copy_from_slice(std::hint::black_box(&source));
            std::hint::black_box(&mut copy);
            best[0] = best[0].min(start.elapsed().as_secs_f64());
            let start = std::time::Instant::now();
            pack(kernel, std::hint::black_box(&codes), &mut frame);
            std::hint::black_box(&mut frame);
            best[1] = best[1].min(start.elapsed().as_secs_f64());
        }
        let ratio = best[1] / best[0];
        assert!(
            ratio <= 3.0,
            "memcpy {:.3} ms, packing by {} {:.3} ms, ratio {ratio:.2}",
            best[0] * 1e3,
            kernel.name(),
            best[1] * 1e3
        );
    }
}
