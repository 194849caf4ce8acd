//! Laws of the limits: no window and no run of white exceeds what is allowed, for any content; light within the limits
//! is never cut.

use super::*;
use proptest::prelude::*;

const FULL: u32 = FULL_LUMINANCE;

fn rate(num: u32, den: u32) -> FrameRate {
    FrameRate::new(num, den).unwrap()
}

/// The light that a device makes of `levels`: dark from the slot that would exceed a limit, for the rest. Also returns
/// the strikes.
fn lit(
    limiter: &mut LightLimiter,
    rest_slots: usize,
    levels: &[u32],
) -> (Vec<u32>, Vec<(usize, LimitReached)>) {
    let (mut out, mut strikes, mut resting) = (Vec::new(), Vec::new(), 0);
    for (slot, &level) in levels.iter().enumerate() {
        if resting > 0 {
            resting -= 1;
            if resting == 0 {
                limiter.reset();
            }
            out.push(0);
        } else if let Some(limit) = limiter.observe(level) {
            strikes.push((slot, limit));
            resting = rest_slots.max(1);
            out.push(0);
        } else {
            out.push(level);
        }
    }
    (out, strikes)
}

/// Greatest sum over `window` successive slots, counted naively.
fn greatest_window(levels: &[u32], window: usize) -> u64 {
    let mut sum = 0u64;
    let mut greatest = 0;
    for (i, &level) in levels.iter().enumerate() {
        sum += u64::from(level);
        if i >= window {
            sum -= u64::from(levels[i - window]);
        }
        greatest = greatest.max(sum);
    }
    greatest
}

/// Pieces of constant, alternating and noisy light of any lengths.
fn light() -> impl Strategy<Value = Vec<u32>> {
    let piece = (0u8..3, 0..=FULL, 0..=FULL, 1usize..900, any::<u32>()).prop_map(|(kind, a, b, n, seed)| {
        let mut state = seed | 1;
        (0..n)
            .map(|i| match kind {
                0 => a,
                1 if i % 3 == 0 => a,
                1 => b,
                _ => {
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    state >> 16
                }
            })
            .collect::<Vec<u32>>()
    });
    prop::collection::vec(piece, 1..8).prop_map(|p| p.concat())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    #[test]
    fn no_window_has_more_than_the_mean_and_calm_light_is_left_alone(
        levels in light(),
        permille in 1u16..1000,
        window_ms in 500u32..3000,
        hz in prop::sample::select(vec![24u32, 60, 240, 947]),
    ) {
        let limits = LightLimits { mean_permille: permille, window_ms, full_white_ms: 0 };
        let window = slots_within(rate(hz, 1), u64::from(window_ms)) as usize;
        let mut limiter = LightLimiter::new(rate(hz, 1), &limits).unwrap();
        let (shown, strikes) = lit(&mut limiter, window, &levels);
        let budget = u64::from(permille) * u64::from(FULL) * window as u64 / 1000;
        prop_assert!(greatest_window(&shown, window) <= budget);
        // Light that leaves a bin's worth of room in every window is shown bit for bit.
        let room = window.div_ceil(BINS) as u64 * u64::from(FULL);
        let exact = window <= BINS;
        if greatest_window(&levels, window) + if exact { 0 } else { room } <= budget {
            prop_assert!(strikes.is_empty(), "{strikes:?}");
            prop_assert_eq!(&shown, &levels);
        }
        // Light that was cut did exceed the limit, up to a bin.
        if let Some(&(slot, limit)) = strikes.first() {
            prop_assert_eq!(limit, LimitReached::Mean);
            prop_assert!(greatest_window(&levels[..=slot], window) + room > budget);
        }
    }

    #[test]
    fn full_white_never_lasts_longer_than_allowed(levels in light(), allowed_ms in 500u32..2000) {
        let limits = LightLimits { full_white_ms: allowed_ms, ..LightLimits::OFF };
        let r = rate(240, 1);
        let (allowed, pause) = (slots_within(r, u64::from(allowed_ms)), slots_in(r, 100));
        // Half of the light is full, so that there are runs of it.
        let levels: Vec<u32> = levels.iter().map(|l| if *l > FULL / 3 { FULL } else { *l }).collect();
        let mut limiter = LightLimiter::new(r, &limits).unwrap();
        let (shown, strikes) = lit(&mut limiter, 480, &levels);
        let stretch = |levels: &[u32]| {
            let (mut longest, mut first, mut last) = (0, None::<u64>, 0);
            for (slot, _) in levels.iter().enumerate().filter(|(_, l)| **l >= FULL_WHITE_LEVEL) {
                let slot = slot as u64;
                if first.is_none() || slot - last > pause {
                    first = Some(slot);
                }
                last = slot;
                longest = longest.max(slot - first.unwrap_or(slot) + 1);
            }
            longest
        };
        prop_assert!(stretch(&shown) <= allowed, "{} of {allowed}", stretch(&shown));
        if stretch(&levels) <= allowed {
            prop_assert!(strikes.is_empty());
            prop_assert_eq!(shown, levels);
        } else {
            prop_assert!(!strikes.is_empty());
        }
    }

    #[test]
    fn a_host_that_strikes_ahead_keeps_the_device_from_striking(
        levels in light(),
        permille in 50u16..1000,
        late in 0usize..10,
    ) {
        // The device obeys the host's order `late` slots after the slot of the frame that caused it.
        let limits = LightLimits { mean_permille: permille, window_ms: 1000, full_white_ms: 700 };
        let r = rate(240, 1);
        let mut host = LightLimiter::ahead(r, &limits, 50).unwrap();
        let mut device = LightLimiter::new(r, &limits).unwrap();
        // The frame on the mirrors until the order arrives.
        let mut held = 0;
        for (slot, &level) in levels.iter().enumerate() {
            if host.observe(level).is_none() {
                prop_assert_eq!(device.observe(level), None, "slot {}", slot);
                held = level;
                continue;
            }
            for _ in 0..late {
                prop_assert_eq!(device.observe(held), None, "held in slot {}", slot);
            }
            for _ in 0..480 {
                prop_assert_eq!(device.observe(0), None);
            }
            host.reset();
            held = 0;
        }
    }

    #[test]
    fn repeating_is_observing_many_times(levels in light(), cut in 1usize..400) {
        let limits = LightLimits { mean_permille: 1000, window_ms: 2000, full_white_ms: 600_000 };
        let r = rate(947, 1);
        let (mut one, mut other) = (LightLimiter::new(r, &limits).unwrap(), LightLimiter::new(r, &limits).unwrap());
        for piece in levels.chunks(cut) {
            let level = piece[0];
            for _ in piece {
                let _ = one.observe(level);
            }
            other.repeated(level, piece.len() as u64);
            let (a, b) = (one.mean.as_ref().unwrap(), other.mean.as_ref().unwrap());
            prop_assert_eq!(a.sum(), b.sum());
            let (a, b) = (one.full.as_ref().unwrap(), other.full.as_ref().unwrap());
            prop_assert_eq!((a.run, a.since), (b.run, b.since));
        }
    }
}

#[test]
fn steady_light_at_the_limit_is_never_struck_and_a_step_above_it_is_in_the_first_window() {
    for (num, den) in [(24, 1), (60_000, 1001), (240, 1), (947, 1), (2000, 1)] {
        for (permille, window_ms) in [(100u16, 500u32), (333, 10_000), (900, 60_000)] {
            let limits = LightLimits { mean_permille: permille, window_ms, full_white_ms: 0 };
            for ahead in [None, Some(50)] {
                let make = || match ahead {
                    None => LightLimiter::new(rate(num, den), &limits).unwrap(),
                    Some(ms) => LightLimiter::ahead(rate(num, den), &limits, ms).unwrap(),
                };
                let level = u32::from(permille) * FULL / 1000;
                let window = slots_within(rate(num, den), u64::from(window_ms)) as usize;
                let mut limiter = make();
                assert!(
                    (0..3 * window).all(|_| limiter.observe(level).is_none()),
                    "{num}/{den} {permille} {ahead:?}"
                );
                let mut limiter = make();
                let above = level + FULL / 200;
                let at = (0..2 * window).find(|_| limiter.observe(above).is_some());
                assert!(at.is_some_and(|at| at <= window), "{num}/{den} {permille} {ahead:?}: {at:?}");
            }
        }
    }
}

#[test]
fn the_level_is_the_strongest_channels_and_no_row_is_left_out() {
    let raster = Raster::new(72, 100).unwrap();
    let schedule = PlaneSchedule::rgb24();
    let n = raster.plane_bytes();
    let frame = |code: [u8; 3], rows: &dyn Fn(usize) -> bool| -> Vec<u8> {
        let mut planes = Vec::new();
        for p in schedule.planes() {
            let lit = code[p.channel as usize] >> p.bit & 1 == 1;
            for y in 0..100 {
                planes.extend(std::iter::repeat_n(if lit && rows(y) { 0xff } else { 0 }, n / 100));
            }
        }
        planes
    };
    let level = |code, rows: &dyn Fn(usize) -> bool| light_level(raster, &schedule, &frame(code, rows));
    assert_eq!(level([255; 3], &|_| true), FULL);
    // A field of blue alone is as strong as white: its LED is fully on.
    assert_eq!(level([0, 0, 255], &|_| true), FULL);
    assert_eq!(level([0; 3], &|_| true), 0);
    assert_eq!(level([51, 102, 0], &|_| true), FULL * 102 / 255);
    // One row of a hundred, whichever it is.
    for row in 0..100 {
        let got = level([255; 3], &|y| y == row);
        assert!(got.abs_diff(FULL / 100) <= 1, "row {row}: {got}");
    }
    // White planes count for every channel.
    let white = vec![0xff; n * 8];
    assert_eq!(light_level(raster, &PlaneSchedule::mono8(), &white), FULL);
}

#[test]
fn values_out_of_range_and_nothing_at_all_make_no_limiter() {
    let on = LightLimits { mean_permille: 500, window_ms: 1000, full_white_ms: 1000 };
    assert!(on.is_valid() && LightLimiter::new(rate(947, 1), &on).is_some());
    assert!(LightLimits::OFF.is_valid() && LightLimiter::new(rate(947, 1), &LightLimits::OFF).is_none());
    for bad in [
        LightLimits { mean_permille: 1001, ..on },
        LightLimits { window_ms: 0, ..on },
        LightLimits { window_ms: 499, ..on },
        LightLimits { window_ms: MAX_LIMIT_MS + 1, ..on },
        LightLimits { full_white_ms: 1, ..on },
        LightLimits { mean_permille: 0, ..on },
    ] {
        assert!(!bad.is_valid(), "{bad:?}");
        assert!(LightLimiter::new(rate(947, 1), &bad).is_none(), "{bad:?}");
    }
    // Long windows at high rates fit 64 bits, and one slot a second works.
    let long = LightLimits { mean_permille: 1000, window_ms: MAX_LIMIT_MS, full_white_ms: MAX_LIMIT_MS };
    let mut limiter = LightLimiter::new(rate(100_000, 1), &long).unwrap();
    limiter.repeated(2 * FULL, u64::MAX);
    assert_eq!(limiter.observe(FULL), Some(LimitReached::Mean));
    let mut slow = LightLimiter::ahead(rate(1, 1), &on, 50).unwrap();
    assert_eq!(slow.observe(FULL), Some(LimitReached::Mean));
    assert_eq!(on.rest_us(LimitReached::Mean), 2_000_000);
    assert_eq!(long.rest_us(LimitReached::FullWhite), 3_600_000_000);
}
