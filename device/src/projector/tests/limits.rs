//! Limits on light, kept by the host, and by the device alone.

use super::*;
use crate::link::{light_level, FULL_LUMINANCE, FULL_WHITE_LEVEL};
use proptest::prelude::*;

/// A picture whose level is near `level`, 0 to 1: the planes of the highest weights are fully lit.
fn picture(level: f64) -> Vec<u8> {
    let code = (level * 255.0).round() as u32;
    let schedule = PlaneSchedule::rgb24();
    let n = raster().plane_bytes();
    let mut all = Vec::new();
    for plane in schedule.planes() {
        all.extend(std::iter::repeat_n(if code >> plane.bit & 1 == 1 { 0xff } else { 0 }, n));
    }
    for row in all.chunks_mut(3) {
        row[2] &= 0xf0;
    }
    all
}

/// Level of every slot so far, as the mock lit it.
fn watch(rig: &mut Rig<Direct<ProjectorFirmware>>, levels: &mut Vec<u32>) {
    let mock = rig.cable.device_mut();
    while let Some(event) = mock.next_light() {
        let level = match event.kind {
            LightKind::Blank => 0,
            _ => mock.lit_planes().map_or(0, |p| light_level(raster(), &PlaneSchedule::rgb24(), p)),
        };
        let slot = event.slot as usize;
        levels.resize(levels.len().max(slot + 1), 0);
        levels[slot] = level;
    }
}

/// Greatest mean level over `slots` successive slots.
fn greatest_mean(levels: &[u32], slots: usize) -> f64 {
    let mut sum: u64 = 0;
    let mut greatest = 0;
    for (i, level) in levels.iter().enumerate() {
        sum += u64::from(*level);
        sum -= if i >= slots { u64::from(levels[i - slots]) } else { 0 };
        greatest = greatest.max(sum);
    }
    greatest as f64 / (slots as f64 * f64::from(FULL_LUMINANCE))
}

const LIMITS: LightLimits = LightLimits { mean_permille: 400, window_ms: 1000, full_white_ms: 600 };

fn limited() -> LinkSettings {
    LinkSettings { limits: LIMITS, watchdog_us: 3_000_000, ..settings() }
}

/// Bright for a number of slots, then dimmer for a number.
fn content(seed: u64, id: u64) -> f64 {
    let draws = Draws::new(seed);
    let period = 20 + draws.bits(0) % 400;
    let [a, b] = [1, 2].map(|i| (draws.bits(i) % 256) as f64 / 255.0);
    if id % period < period / 2 {
        a
    } else {
        b
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn whatever_is_shown_the_host_keeps_every_window_and_the_device_never_has_to(seed in any::<u64>()) {
        let setup = FirmwareConfig { flash_limit: None, ..FirmwareConfig::new(raster()) };
        let mut rig = clean(limited(), setup);
        rig.stream();
        let mut levels = Vec::new();
        for id in 0..4000u64 {
            rig.step_with(id, &picture(content(seed, id)));
            watch(&mut rig, &mut levels);
        }
        prop_assert!(greatest_mean(&levels, 947) <= 0.4, "{}", greatest_mean(&levels, 947));
        let longest = levels.split(|l| *l < FULL_WHITE_LEVEL).map(<[u32]>::len).max().unwrap_or(0);
        prop_assert!(longest <= 568, "{longest} slots of full white");
        prop_assert_eq!(rig.cable.device().status().faults, 0, "the host strikes first");
    }
}

#[test]
fn a_device_keeps_the_limits_under_a_host_that_does_not() {
    // Limits of the device's owner, and of a CONFIG from a host that then ignores them.
    for owner in [true, false] {
        let setup = FirmwareConfig {
            limits: if owner { LIMITS } else { LightLimits::OFF },
            ..FirmwareConfig::new(raster())
        };
        let mut rig = clean(LinkSettings { watchdog_us: 10_000_000, ..settings() }, setup);
        rig.stream();
        if !owner {
            let session = rig.cable.device().core.session;
            let Some((config, _)) = rig.cable.device().core.config else { panic!("configured") };
            let config = crate::link::HostMessage::Config(crate::link::Config { limits: LIMITS, ..config });
            let mut payload = [0; MAX_CONTROL_BYTES];
            let (kind, n) = config.write(&mut payload);
            let packet = Packet::new(Header::control(kind, session, 0), &payload[..n]);
            rig.cable.send(rig.now, Lane::Control, &[packet]).unwrap();
            rig.until(LinkState::Ready);
            rig.link.arm(0);
            rig.until(LinkState::Streaming);
        }
        let mut levels = Vec::new();
        let mut struck = 0;
        for id in 0..6000u64 {
            rig.step_with(id, &picture(0.7));
            watch(&mut rig, &mut levels);
            let status = rig.cable.device().status();
            rig.cable.device().check_laws();
            if status.faults != 0 {
                assert_eq!(status.faults, faults::LIGHT_LIMIT);
                assert!(!rig.cable.device().is_lit());
                struck += 1;
                let at = rig.now;
                // ARM is refused during the rest, acknowledged or not.
                rig.until(LinkState::Faulted);
                rig.link.arm(faults::LIGHT_LIMIT);
                rig.poll().unwrap();
                assert!(matches!(rig.poll(), Err(LinkError::ArmRefused { .. })));
                rig.now = at.plus_ns(2_010_000_000);
                rig.link.arm(faults::LIGHT_LIMIT);
                rig.until(LinkState::Streaming);
                rig.slot = rig.link.settings().rate.slot_at_ns(rig.now.0) + 1;
            }
        }
        assert!(struck >= 2, "struck {struck} times");
        assert!(greatest_mean(&levels, 947) <= 0.4, "{}", greatest_mean(&levels, 947));
        assert!(greatest_mean(&levels, 947) > 0.39, "all that is allowed is used");
    }
}

#[test]
fn asking_anew_does_not_make_a_device_forget() {
    // Half a window of light, a new CONFIG with the same limits, and the other half.
    let mut rig = clean(
        LinkSettings { watchdog_us: 10_000_000, ..settings() },
        FirmwareConfig { limits: LIMITS, ..FirmwareConfig::new(raster()) },
    );
    let mut levels = Vec::new();
    for session in 0..20u64 {
        rig.stream();
        for id in 0..60u64 {
            rig.step_with(session * 100 + id, &picture(1.0));
            watch(&mut rig, &mut levels);
        }
        if rig.cable.device().status().faults != 0 {
            break;
        }
    }
    assert_eq!(rig.cable.device().status().faults, faults::LIGHT_LIMIT);
}

#[test]
fn light_within_the_limits_is_the_same_bit_for_bit() {
    let run = |limits: LightLimits| {
        let mut rig = clean(
            LinkSettings { limits, ..settings() },
            FirmwareConfig { limits, ..FirmwareConfig::new(raster()) },
        );
        rig.stream();
        let mut lit = Vec::new();
        for id in 0..3000u64 {
            // Noise is half lit; every third frame is brighter.
            let planes = if id % 3 == 0 { picture(0.55) } else { planes(id) };
            assert_eq!(rig.step_with(id, &planes), SendOutcome::Sent);
            let mock = rig.cable.device_mut();
            while let Some(event) = mock.next_light() {
                lit.push((event, mock.lit_planes().map(<[u8]>::to_vec)));
            }
        }
        lit
    };
    let off = run(LightLimits::OFF);
    assert!(off == run(LightLimits { mean_permille: 700, window_ms: 1000, full_white_ms: 500 }));
}

/// The limiters must not undo an order of the operator: once, flashing content that continued during BLACK triggered
/// the flash limiter, whose rest then ended with an ARM.
#[test]
fn a_rest_of_the_limiters_never_ends_an_operators_black() {
    for verb in [Verb::Black, Verb::Freeze] {
        let s = LinkSettings { flash_limit: Some(3), limits: LIMITS, watchdog_us: 10_000_000, ..settings() };
        let mut rig = clean(s, FirmwareConfig::new(raster()));
        rig.stream();
        for id in 0..20 {
            rig.step_with(id, &picture(0.3));
        }
        rig.link.command(rig.now, verb, &mut rig.cable).unwrap();
        // 10 Hz between dark and full white, for ten seconds.
        for id in 20..9500u64 {
            rig.step_with(id, &picture(if id / 47 % 2 == 0 { 1.0 } else { 0.0 }));
            let state = rig.cable.device().status().state;
            let expected = if verb == Verb::Black { DeviceState::Black } else { DeviceState::Frozen };
            assert_eq!(state, expected, "frame {id}");
            if verb == Verb::Black {
                assert!(!rig.cable.device().is_lit());
            }
        }
        rig.link.arm(0);
        rig.until(LinkState::Streaming);
    }
}

/// A frozen frame is light too.
#[test]
fn a_frozen_picture_is_counted_and_stays_dark_after_it_struck() {
    let mut rig = clean(limited(), FirmwareConfig::new(raster()));
    rig.stream();
    for id in 0..100 {
        rig.step_with(id, &picture(0.8));
    }
    rig.link.command(rig.now, Verb::Freeze, &mut rig.cable).unwrap();
    let mut levels = Vec::new();
    for id in 100..8000u64 {
        rig.step_with(id, &picture(0.0));
        watch(&mut rig, &mut levels);
    }
    assert!(greatest_mean(&levels, 947) <= 0.4);
    let status = rig.cable.device().status();
    assert_eq!((status.faults, status.state), (0, DeviceState::Black), "dark until the operator arms");
}
