//! Laws of the code. That the decoder and the solver find the truth is a matter of the rehearsal.

use super::*;
use dpm_device::planes::Raster;
use std::collections::HashSet;

fn code(w: u32, h: u32) -> Code {
    Code::new(Raster::new(w, h).unwrap()).unwrap()
}

#[test]
fn every_stripe_of_every_raster_has_a_code_of_its_own() {
    for (w, h) in [(1024, 768), (1920, 1080), (2716, 1600), (640, 480), (1, 1), (768, 1024), (2560, 1600)] {
        let code = code(w, h);
        let word = |x: u32, y: u32| (2..22).fold(0u32, |a, p| a << 1 | u32::from(code.lit(0, p, x, y)));
        let finest = (0..PLANES).filter_map(|p| match code.role(p) {
            Role::Column { width } | Role::Row { width } => Some(width),
            _ => None,
        });
        let finest = finest.min().unwrap_or(1);
        assert!(finest <= 4, "{w} x {h}: {finest}");
        let columns: HashSet<u32> = (0..w).map(|x| word(x, 0)).collect();
        let rows: HashSet<u32> = (0..h).map(|y| word(0, y)).collect();
        assert!(columns.len() as u32 >= w.div_ceil(4) && rows.len() as u32 >= h.div_ceil(4));
        if w <= 1024 && h <= 1024 {
            assert_eq!((columns.len() as u32, rows.len() as u32), (w, h));
        }
        // Gray: neighbours differ in one plane at most.
        assert!((1..w).all(|x| (word(x, 0) ^ word(x - 1, 0)).count_ones() <= 1));
        assert!((1..h).all(|y| (word(0, y) ^ word(0, y - 1)).count_ones() <= 1));
    }
}

#[test]
fn references_stand_at_both_ends_and_name_the_frame() {
    let code = code(1024, 768);
    let end = |frame| [PLANES - 2, PLANES - 1].map(|p| code.lit(frame, p, 5, 5));
    assert!((0..100).all(|f| !code.lit(f, 0, 9, 9) && code.lit(f, 1, 9, 9)));
    assert!((0..1000).all(|f| end(f) == [code.identity(f), !code.identity(f)]));
    // Fifteen bits in a row occur once in a period, and all but fifteen zeros do.
    let words: HashSet<u32> =
        (0..32_767u64).map(|f| (0..15).fold(0, |a, k| a << 1 | u32::from(code.identity(f + k)))).collect();
    assert_eq!(words.len(), 32_767);
    assert!(!words.contains(&0));
    assert!(!code.lit(0, 1, 1024, 0) && !code.lit(0, 1, 0, 768) && !code.lit(0, 99, 0, 0));
}

#[test]
fn a_raster_beyond_the_planes_is_refused_by_name() {
    let error = Code::new(Raster::new(8192, 8192).unwrap()).unwrap_err();
    assert!(
        error.to_string().contains("8192 x 8192") && error.to_string().contains("needs 22 planes"),
        "{error}"
    );
}

#[test]
fn samples_that_show_no_code_are_refused_by_name() {
    let code = code(1024, 768);
    let timing = Timing { frame_zero_ns: 0, frame_ns: 1_056_000.0 };
    let block = |level: &dyn Fn(usize) -> f32| {
        [SampleBlock { start_ns: 0, interval_ns: 1e4, levels: (0..300_000).map(level).collect() }]
    };
    let get = |blocks: &[SampleBlock]| decode(&code, &timing, blocks, 0, &|slot| slot).unwrap_err();
    assert_eq!(get(&[]), DecodeError::NoSamples);
    assert_eq!(get(&block(&|_| 0.7)), DecodeError::NoLight);
    assert_eq!(get(&block(&|i| if i == 9 { f32::NAN } else { 0.0 })), DecodeError::NotFinite(0));
    let noise = dpm_device::rng::Draws::new(1);
    let only_noise = get(&block(&|i| noise.unit(i as u64) as f32));
    assert!(matches!(only_noise, DecodeError::NoLock { .. }), "{only_noise}");
    // Light that goes on and off with the planes, but carries no code.
    let blink = get(&block(&|i| f32::from(u8::from(((i as f64 * 1e4 / 44_000.0) as u64).is_multiple_of(2)))));
    assert!(matches!(blink, DecodeError::NoFrames { .. }), "{blink}");
    let slow = [SampleBlock { start_ns: 0, interval_ns: 4e4, levels: vec![0.0; 1000] }];
    assert!(matches!(get(&slow), DecodeError::TooSlow { .. }));
    let bad = [
        SampleBlock { start_ns: i64::MIN, interval_ns: 1e4, levels: vec![0.0, 1.0] },
        SampleBlock { start_ns: i64::MAX, interval_ns: 1e4, levels: vec![0.0, 1.0, 0.0] },
    ];
    decode(&code, &timing, &bad, 0, &|slot| slot).unwrap_err();
}

#[test]
fn a_block_of_the_wire_keeps_its_instants_and_its_unit() {
    use dpm_device::sensor::wire::{BlockHead, PERIOD_ONE};
    let head = BlockHead {
        sequence: 0,
        first: 48_000_000 * 3600,
        period: 480 * PERIOD_ONE + PERIOD_ONE / 2,
        lost: 0,
        gain: 0,
        cut_below: false,
        cut_above: false,
    };
    let block = SampleBlock::from_wire(&head, &[0, 100, 4095], 48_000_000, 2.0).unwrap();
    assert_eq!((block.start_ns, block.levels.as_slice()), (3_600_000_000_000, &[0.0f32, 50.0, 2047.5][..]));
    let (ticks, rest) = head.ticks_of(2);
    let ns = (ticks as f64 + f64::from(rest) / f64::from(PERIOD_ONE)) / 48e6 * 1e9;
    assert!((block.at(2, 0) - ns).abs() < 1e-3);
    assert!(SampleBlock::from_wire(&head, &[1], 0, 1.0).is_none());
    assert!(SampleBlock::from_wire(&head, &[1], 48_000_000, 0.0).is_none());
    assert!(SampleBlock::from_wire(&BlockHead { first: u64::MAX, ..head }, &[1], 1, 1.0).is_none());
}
