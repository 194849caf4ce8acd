//! Laws of the wand: levels in closed form, the place that they tell, and what disturbs them.

use super::*;
use crate::motion::MotionSpec;
use crate::projector::{MockConfig, MockProjector};
use dpm_device::light::{LightEvent, LightKind};
use dpm_device::link::{Epoch, HostLink, LightLimits, LinkSettings, LinkState, SendOutcome, Underrun};
use dpm_device::planes::PlaneSchedule;
use dpm_device::pose::Pose;
use dpm_device::time::{DeviceTicks, FrameRate};
use dpm_device::transport::inproc::Direct;

const SLOT_NS: i64 = 1_056_000;

fn raster() -> Raster {
    Raster::new(1024, 768).unwrap()
}

fn optics() -> ProjectorOptics {
    let plain = ProjectorOptics::along_z([0.0, 0.0, 1.2], 1800.0, 1024, 768);
    ProjectorOptics { brown: [-0.05, 0.01, 0.001, -0.0005, 0.0], ..plain }
}

/// Nothing that disturbs.
fn clean() -> SensorWandConfig {
    SensorWandConfig {
        bandwidth_hz: 1e8,
        ambient: 0.0,
        noise: 0.0,
        leak: 0.0,
        droop: 0.0,
        vignetting: 0.0,
        clock_ppm: 0.0,
        start_ticks: 0,
        bits: LevelBits::Sixteen,
        ..SensorWandConfig::new(optics())
    }
}

fn still() -> Motion {
    Motion::still(Pose { position_m: [0.05, 0.02, 0.0], ..Pose::IDENTITY }).unwrap()
}

fn moving() -> Motion {
    let parts = vec![
        MotionSpec::Sinusoid { direction: [1.0, 0.3, 0.2], peak_speed_m_s: 0.5, peak_acceleration_m_s2: 3.0 },
        MotionSpec::Sway { axis: [0.2, 1.0, 0.1], peak_rate_rad_s: 1.0, peak_acceleration_rad_s2: 4.0 },
    ];
    Motion::new(&MotionSpec::Together { parts }, Pose { position_m: [0.02, -0.03, 0.0], ..Pose::IDENTITY })
        .unwrap()
}

/// A slot whose planes are `lit`, from `from` on.
fn shown(from: i64, lit: impl Fn(usize, u32, u32) -> bool) -> Shown {
    let (raster, schedule) = (raster(), PlaneSchedule::equal24());
    let mut planes = vec![0u8; raster.plane_bytes() * schedule.len()];
    for (k, plane) in planes.chunks_exact_mut(raster.plane_bytes()).enumerate() {
        for y in 0..raster.height() {
            for x in (0..raster.width()).filter(|&x| lit(k, x, y)) {
                plane[y as usize * raster.row_bytes() + x as usize / 8] |= 0x80 >> (x % 8);
            }
        }
    }
    let (first, last) = (HostTime(from), HostTime(from + SLOT_NS));
    let event = LightEvent {
        slot: 0,
        frame: Some(0),
        kind: LightKind::Lit,
        lit_at: DeviceTicks(0),
        first_photon_at: first,
        last_photon_at: last,
    };
    Shown { event, planes_end_at: last, schedule, planes: planes.into() }
}

/// The same slot at another time.
fn begun(slot: &Shown, from: i64) -> Shown {
    let (first, last) = (HostTime(from), HostTime(from + SLOT_NS));
    let event = LightEvent { first_photon_at: first, last_photon_at: last, ..slot.event };
    Shown { event, planes_end_at: last, ..slot.clone() }
}

fn samples(wand: &mut SensorWand, shown: &Shown) -> Vec<(f64, u16)> {
    let mut all = Vec::new();
    wand.shine(shown, &mut |s| all.push(s));
    all.into_iter().map(|s| (wand.sampled_at_ns(s.number), s.level)).collect()
}

#[test]
fn each_plane_has_its_level_in_its_time() {
    let mut wand = SensorWand::new(clean(), still(), raster()).unwrap();
    // Planes 0, 1, 4, 5, 8, 9, ... are on.
    let slot = shown(3 * SLOT_NS, |k, _, _| k / 2 % 2 == 0);
    let d = minus(optics().pose.position_m, wand.sensor_at(0));
    // Irradiance falls with the square of the distance and the cosine to the sensor's direction, which is +z here.
    let level = clean().responsivity * 8.0 / 255.0 * d[2] / length(d).powi(3) * 65_535.0;
    let mut seen = [0; 2];
    for (t, found) in samples(&mut wand, &slot) {
        let plane = (t - 3.0 * SLOT_NS as f64) / (SLOT_NS as f64 / 24.0);
        let into = plane.rem_euclid(1.0) * SLOT_NS as f64 / 24.0;
        let on = plane >= 0.0 && (plane as usize / 2).is_multiple_of(2);
        // After a few of the amplifier's 1.6 ns.
        if plane < 0.0 || into > 40.0 {
            let wanted = if on { level } else { 0.0 };
            assert!((f64::from(found) - wanted).abs() <= 1.0, "{t} {plane}: {found} {wanted}");
            seen[usize::from(on)] += 1;
        }
    }
    assert!(seen[0] > 350 && seen[1] > 45, "{seen:?}");
}

#[test]
fn an_led_droops_at_high_currents() {
    let light = |droop: f64, bit: u8| {
        let config = SensorWandConfig { droop, responsivity: 1.0, ..clean() };
        let mut wand = SensorWand::new(config, still(), raster()).unwrap();
        let plane = PlaneSpec { channel: Channel::White, bit };
        let slot = Shown {
            schedule: dpm_device::planes::PlaneSchedule::new(&[plane]).unwrap(),
            planes: vec![0xff; raster().plane_bytes()].into(),
            ..shown(3 * SLOT_NS, |_, _, _| true)
        };
        f64::from(samples(&mut wand, &slot).last().unwrap().1)
    };
    for (bit, lost) in [(7, 0.1), (6, 0.05), (5, 0.025), (0, 0.1 / 128.0)] {
        let (full, less) = (light(0.0, bit), light(0.1, bit));
        assert!((full * (1.0 - lost) - less).abs() <= 1.0, "bit {bit}: {full} {less}");
    }
    let config = SensorWandConfig { droop: 1.1, ..clean() };
    assert_eq!(SensorWand::new(config, still(), raster()).unwrap_err().field, "droop");
}

#[test]
fn the_amplifier_follows_with_its_time_constant() {
    let config = SensorWandConfig { bandwidth_hz: 10e3, samples_per_second: 1_000_000, ..clean() };
    let mut wand = SensorWand::new(config, still(), raster()).unwrap();
    let slot = shown(SLOT_NS, |_, _, _| true);
    let all = samples(&mut wand, &slot);
    let top = f64::from(all.last().unwrap().1);
    let constant_ns = 1e9 / (std::f64::consts::TAU * 10e3);
    for (t, level) in all.iter().filter(|(t, _)| *t > SLOT_NS as f64) {
        let wanted = top * (1.0 - (-(t - SLOT_NS as f64) / constant_ns).exp());
        assert!((f64::from(*level) - wanted).abs() < 2.0, "{t}: {level} {wanted}");
    }
}

/// Columns and rows in Gray code through the aperture of a point are those of the optics, frame after frame.
#[test]
fn a_code_tells_where_the_wand_is() {
    let config = SensorWandConfig { aperture_m: 1e-6, ..clean() };
    let mut wand = SensorWand::new(config, moving(), raster()).unwrap();
    let gray = |n: u32| n ^ n >> 1;
    let code = |k: usize, x: u32, y: u32| match k {
        0 | 22 | 23 => false,
        1 => true,
        2..=11 => gray(x) >> (11 - k) & 1 == 1,
        _ => gray(y) >> (21 - k) & 1 == 1,
    };
    let slot = shown(0, code);
    for frame in 1..40 {
        let slot = begun(&slot, frame * 9 * SLOT_NS);
        let (from, plane_ns) = (slot.event.first_photon_at.0 as f64, SLOT_NS as f64 / 24.0);
        let all = samples(&mut wand, &slot);
        for (t, level) in all.iter().filter(|(t, _)| (t - from) / plane_ns >= 2.0) {
            let k = ((t - from) / plane_ns) as usize;
            if (t - from).rem_euclid(plane_ns) < 100.0 {
                continue;
            }
            let [u, v] = wand.pixel_at(*t as i64).expect("in view");
            // Sampled in the middle of a step of 10 us at most, in which the tip moves by 0.02 px.
            let near = |a: f64| (a - a.round()).abs() < 0.05;
            if k < 22 && !near(u) && !near(v) {
                assert_eq!(*level > 1000, code(k, u as u32, v as u32), "frame {frame} plane {k}");
            }
        }
    }
}

#[test]
fn ambient_light_flicker_noise_and_saturation_are_what_was_asked_for() {
    let config = SensorWandConfig { ambient: 0.1, flicker: 0.2, noise: 0.004, ..clean() };
    let mut wand = SensorWand::new(config, still(), raster()).unwrap();
    let mut levels = Vec::new();
    wand.dark(HostTime(1_000_000_000), &mut |s| {
        levels.push((wand_phase(s.number), f64::from(s.level) / 65_535.0))
    });
    fn wand_phase(number: u64) -> f64 {
        std::f64::consts::TAU * 100.0 * number as f64 * 1e-5
    }
    let n = levels.len() as f64;
    let mean = levels.iter().map(|(_, l)| l).sum::<f64>() / n;
    let sine = levels.iter().map(|(p, l)| 2.0 * l * p.sin()).sum::<f64>() / n;
    let rest = levels.iter().map(|(p, l)| (l - 0.1 - 0.02 * p.sin()).powi(2)).sum::<f64>() / n;
    assert!((mean - 0.1).abs() < 1e-4 && (sine - 0.02).abs() < 2e-4, "{mean} {sine}");
    assert!((rest.sqrt() / 0.004 - 1.0).abs() < 0.02, "{}", rest.sqrt());
    wand.set_gain(100.0);
    let slot = shown(1_100_000_000, |_, _, _| true);
    let all = samples(&mut wand, &slot);
    assert!(all.iter().filter(|(t, _)| *t > 1.11e9).all(|(_, level)| *level == u16::MAX));
}

#[test]
fn a_drifting_clock_and_an_obstructed_beam_are_what_was_asked_for() {
    let config = SensorWandConfig {
        clock_ppm: 100.0,
        start_ticks: 5,
        obstructed: 0.3,
        obstruction_ns: 2 * SLOT_NS,
        ..clean()
    };
    let mut wand = SensorWand::new(config, still(), raster()).unwrap();
    // After ten seconds it is a millisecond ahead.
    assert_eq!(wand.ticks_at(HostTime(10_000_000_000)), 10_001_005);
    assert!((wand.sampled_at_ns(1_000_000) - 1e10 / 1.0001).abs() < 1e-3);
    let mut lit = 0;
    let frames = 400;
    let slot = shown(0, |k, _, _| k == 12);
    for frame in 1..=frames {
        let slot = begun(&slot, frame * 2 * SLOT_NS);
        lit += usize::from(samples(&mut wand, &slot).iter().any(|(_, level)| *level > 1000));
    }
    let share = 1.0 - lit as f64 / frames as f64;
    // Within three standard deviations of a binomial share.
    assert!((share - 0.3).abs() < 3.0 * (0.3f64 * 0.7 / frames as f64).sqrt(), "{share}");
}

#[test]
fn settings_that_make_no_sense_are_named() {
    let told = |change: fn(&mut SensorWandConfig)| {
        let mut config = clean();
        change(&mut config);
        SensorWand::new(config, still(), raster()).unwrap_err().to_string()
    };
    assert!(told(|c| c.aperture_m = 0.0).contains("`aperture_m` is 0"));
    assert!(told(|c| c.bandwidth_hz = f64::NAN).contains("`bandwidth_hz` is NaN"));
    assert!(told(|c| c.samples_per_second = 0).contains("`samples_per_second`"));
    assert!(told(|c| c.samples_per_second = 300_000).contains("a multiple of samples_per_second"));
    assert!(told(|c| c.looks = [0.0; 3]).contains("`looks`"));
    assert!(told(|c| c.noise = 2.0).contains("`noise`"));
}

/// The light that the sensor sees comes from the mock projector: what is shown is what a host sent, when it is shown.
#[test]
fn the_projector_hands_over_what_it_showed_and_when() {
    let raster = Raster::new(64, 48).unwrap();
    let schedule = PlaneSchedule::equal24();
    let setup = MockConfig { shown_kept: 8, flash_limit: None, ..MockConfig::new(raster) };
    let mut cable = Direct::new(MockProjector::new(setup));
    let mut link = HostLink::new(LinkSettings {
        raster,
        schedule,
        rate: FrameRate::new(500, 1).unwrap(),
        watchdog_us: 50_000,
        underrun: Underrun::Repeat,
        late_slots: 0,
        epoch: Epoch::At(DeviceTicks(0)),
        codecs: 0,
        flash_limit: None,
        limits: LightLimits::OFF,
    });
    link.connect();
    let planes = |n: u64| -> Vec<u8> {
        (0..raster.plane_bytes() * 24).map(|i| (i as u64 * 7 + n * 13) as u8).collect()
    };
    let (mut sent, mut seen, mut last_slot) = (0u64, Vec::new(), 0);
    for step in 0..4000 {
        let now = HostTime(step * 50_000);
        match link.poll(now, &mut cable).expect("in process") {
            LinkState::Ready => link.arm(0),
            LinkState::Streaming if sent < 20 => {
                let slots = link.slots().unwrap();
                let slot = slots.slot_at(DeviceTicks(now.0 as u64)).unwrap() + 1;
                if slot == last_slot {
                    continue;
                }
                let target = slots.start(slot);
                let dark = DeviceTicks(target.0 + 3_000_000);
                let outcome = link.send_frame(now, sent, target, dark, &planes(sent), &mut cable);
                if outcome == SendOutcome::Sent {
                    (sent, last_slot) = (sent + 1, slot);
                }
            }
            _ => {}
        }
        let projector = cable.device_mut();
        while let Some(shown) = projector.next_shown() {
            assert!(shown.event.last_photon_at <= now && shown.schedule == schedule);
            seen.push(shown);
        }
        assert!(projector.shown_until() <= now);
    }
    let lit: Vec<_> = seen.iter().filter(|s| s.event.kind == LightKind::Lit).collect();
    assert_eq!((lit.len(), cable.device_mut().shown_lost()), (20, 0));
    for shown in &seen {
        assert_eq!(*shown.planes, *planes(u64::from(shown.event.frame.unwrap())));
        assert_eq!(shown.planes_end_at.ns_since(shown.event.first_photon_at), 2_000_000);
    }
    assert!(seen.windows(2).all(|w| w[0].event.last_photon_at <= w[1].event.first_photon_at));
    // The last frame ended at its own instant, in the middle of a slot.
    let last = seen.last().unwrap();
    assert_eq!(last.planes_end_at.ns_since(last.event.last_photon_at), 1_000_000);
}
