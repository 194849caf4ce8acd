//! The order of the levels as a law, and the way from samples of the mock's sensor to curves.

use super::*;
use dpm_calibration::sensor::Timing;
use dpm_device::light::{LightEvent, LightKind};
use dpm_device::link::FlashLimiter;
use dpm_device::pose::Pose;
use dpm_device::time::DeviceTicks;
use dpm_device::time::HostTime;
use dpm_rig::pack::source::PatternPainter;
use hil_mock::motion::Motion;
use hil_mock::projector::Shown;
use hil_mock::sensor_wand::{ProjectorOptics, SensorSample, SensorWand, SensorWandConfig};
use std::sync::Arc;

const CODES: u32 = 32;

fn rate() -> FrameRate {
    FrameRate::new(947, 1).unwrap()
}

fn rgb(codes: u32) -> Levels {
    Levels::new(&PlaneSchedule::rgb24(), rate(), LevelField::Full(Some(3)), codes).unwrap()
}

/// The code value of each pixel, from the planes.
fn light_of(raster: Raster, planes: &BitPlaneFrame) -> Vec<u32> {
    let pixel = |i: u32| {
        let (x, y) = (i % raster.width(), i / raster.width());
        let byte = y as usize * raster.row_bytes() + x as usize / 8;
        let specs = planes.schedule().planes().iter().enumerate();
        let lit = specs.filter(|(k, _)| planes.plane(*k)[byte] >> (7 - x % 8) & 1 == 1);
        lit.map(|(_, spec)| 1u32 << (8 * spec.channel as u32 + u32::from(spec.bit))).sum()
    };
    (0..raster.width() * raster.height()).map(pixel).collect()
}

#[test]
fn every_level_stands_between_two_of_full_white() {
    let levels = rgb(CODES);
    assert_eq!(levels.count(), 1 + 3 * 32);
    let raster = Raster::new(16, 4).unwrap();
    let source = Arc::new(levels.clone());
    let mut painter = PatternPainter::new(source.clone(), raster);
    let mut planes = BitPlaneFrame::new(raster, PlaneSchedule::rgb24());
    let mut codes = std::collections::BTreeSet::new();
    let first = 5 * 2 * levels.count() as u64 * levels.hold;
    for run in 0..2 * levels.count() as u64 {
        // The picture is that of the slot, whatever the frame.
        let slot = first + run * levels.hold;
        let picture = source.picture(slot, slot);
        assert!((0..levels.hold).all(|i| source.picture(7, slot + i) == picture));
        assert_ne!(source.picture(7, slot + levels.hold), picture);
        painter.draw(Kernel::Scalar, picture, &mut planes);
        let light = light_of(raster, &planes);
        assert!(light.iter().all(|code| *code == light[0]), "the whole field is lit alike");
        match run % 2 {
            0 => assert_eq!(light[0], 0xff_ffff),
            _ => assert!(codes.insert(light[0])),
        }
    }
    let one_channel = |c: &u32| [0xff_ff00, 0xff_00ff, 0x00_ffff].iter().any(|others| c & others == 0);
    assert!(codes.iter().all(one_channel) && codes.contains(&0));
    assert!((0..3).all(|c| codes.contains(&(255 << (8 * c)))));
}

fn source_step(levels: &Levels, slot: u64) -> usize {
    levels.picture(0, slot) as usize
}

#[test]
fn planes_without_channels_are_refused_by_name() {
    use dpm_device::planes::PlaneSpec;
    let spec = |channel| PlaneSpec { channel, bit: 7 };
    let mixed = PlaneSchedule::new(&[spec(Channel::Red), spec(Channel::White)]).unwrap();
    assert!(Levels::new(&mixed, rate(), LevelField::Full(None), 4).unwrap_err().contains("neither red"));
    assert_eq!(Levels::new(&PlaneSchedule::mono8(), rate(), LevelField::Full(None), 4).unwrap().channels, 1);
}

/// What the mock's sensor samples while the levels are shown once and a bit, from a slot that begins anywhere.
struct LevelsBench {
    levels: Levels,
    showing: Showing,
    lit: Vec<(u64, HostTime)>,
    samples: Vec<TimedBlock>,
    room: LampLight,
    config: SensorWandConfig,
}

/// One pass alone.
fn solve(
    levels: &Levels,
    showing: &Showing,
    samples: &[TimedBlock],
    room: LampLight,
) -> Result<Channels, String> {
    let mut readings = Readings::default();
    readings.add(levels, showing, samples, room)?;
    readings.solve(levels, room)
}

const SENSOR_MINUS_HOST_NS: i64 = 77_000_000_000;

fn block_of(sample: SensorSample, scale: f64) -> SampleBlock {
    // The light of the room, a twentieth of 4095, does not fade.
    let room = 0.05 * 4095.0;
    let level = (room + (f64::from(sample.level) - room) * scale) as f32;
    let start_ns = sample.ticks as i64 * 1000 + SENSOR_MINUS_HOST_NS;
    SampleBlock { start_ns, interval_ns: 1e4, levels: vec![level] }
}

fn bench_config() -> SensorWandConfig {
    let optics = ProjectorOptics::along_z([0.0, 0.0, 1.2], 100.0, 64, 48);
    SensorWandConfig {
        droop: 0.04,
        responsivity: 2.0,
        start_ticks: 0,
        clock_ppm: 0.0,
        leak: 0.002,
        ..SensorWandConfig::new(optics)
    }
}

/// `fades` is a share of the projector's light that is lost from the beginning to the end.
fn bench(codes: u32, fades: f64) -> LevelsBench {
    show(rgb(codes), &bench_config(), |share| 1.0 - fades * share)
}

/// Shows levels once. `scale` is the projector's light by the share of the time that has passed.
fn show(levels: Levels, config: &SensorWandConfig, scale: impl Fn(f64) -> f64) -> LevelsBench {
    let config = config.clone();
    let raster = Raster::new(64, 48).unwrap();
    let motion = Motion::still(Pose::IDENTITY).unwrap();
    let mut wand = SensorWand::new(config.clone(), motion, raster).unwrap();
    let mut source = PatternPainter::new(Arc::new(levels.clone()), raster);
    let first = 3 * levels.hold + 100;
    let frame_ns = 1e9 / rate().hz();
    let timing = Timing { frame_zero_ns: 2_000_000_000 - (first as f64 * frame_ns) as i64, frame_ns };
    let mut blocks = Vec::new();
    wand.dark(HostTime(1_000_000_000), &mut |s| blocks.push(block_of(s, 1.0)));
    let dark = blocks.len();
    let slots = (levels.seconds() * rate().hz()) as u64;
    let mut lit = Vec::new();
    let mut pictures: BTreeMap<u64, Arc<[u8]>> = BTreeMap::new();
    for slot in first..first + slots {
        let picture = levels.picture(0, slot);
        let planes = pictures.entry(picture).or_insert_with(|| {
            let mut planes = BitPlaneFrame::new(raster, PlaneSchedule::rgb24());
            source.draw(Kernel::Scalar, picture, &mut planes);
            planes.bytes().into()
        });
        let (from, end) = (timing.instant(slot, 0.0).0, timing.instant(slot + 1, 0.0).0);
        // A frame in fifty is lost: its slot stays dark.
        if slot % 50 == 17 {
            wand.dark(HostTime(end), &mut |s| blocks.push(block_of(s, 1.0)));
            continue;
        }
        let event = LightEvent {
            slot,
            frame: Some(0),
            kind: LightKind::Lit,
            lit_at: DeviceTicks(0),
            first_photon_at: HostTime(from),
            last_photon_at: HostTime(end),
        };
        let shown = Shown {
            event,
            planes_end_at: HostTime(end),
            schedule: PlaneSchedule::rgb24(),
            planes: Arc::clone(planes),
        };
        let scale = scale((slot - first) as f64 / slots as f64);
        wand.shine(&shown, &mut |s| blocks.push(block_of(s, scale)));
        lit.push((slot, HostTime(from)));
    }
    let ambient = steady(&blocks[..dark], 100.0).unwrap();
    let timed = |block| TimedBlock { block, sensor_minus_host_ns: Some(SENSOR_MINUS_HOST_NS) };
    let samples = blocks.drain(dark..).map(timed).collect();
    let showing = Showing::of(&lit, rate()).unwrap();
    LevelsBench { levels, showing, lit, samples, room: LampLight { flicker_hz: 100.0, ambient }, config }
}

/// Light of a code over that of 255, in closed form.
fn truth(config: &SensorWandConfig, code: u32) -> f64 {
    let of = |code: u32| -> f64 {
        let bits = (0..8).filter(|b| code >> b & 1 == 1).map(|b| f64::from(1u32 << b));
        bits.map(|c| c * (1.0 - config.droop * c / 128.0)).sum()
    };
    of(code) / of(255)
}

#[test]
fn curves_are_those_of_the_mock() {
    let bench = bench(8, 0.0);
    let LevelsBench { levels, showing, lit, samples, room, config } = &bench;
    let got = solve(levels, showing, samples, *room).unwrap();
    for (channel, colour) in config.colours.into_iter().enumerate() {
        assert!((got.intensity[channel] - colour).abs() < 3e-3, "{:?}", got.intensity);
        for i in 1..=8u32 {
            let code = (255 * i + 4) / 8;
            let level = got.level(channel, f64::from(code) / 255.0) / got.level(channel, 1.0);
            let off = level - truth(config, code);
            assert!(off.abs() < 5e-3, "channel {channel}, code {code}: off by {off}");
        }
    }
    // The response is not a straight line, and that is seen.
    assert!((truth(config, 128) - 128.0 / 255.0).abs() > 5e-3);
    assert!((got.black - config.leak).abs() < 1e-3, "{}", got.black);
    // Full white of the mean of the planes, at 1.2 m less the 0.12 m of the tip.
    let white = config.responsivity / 24.0 / (1.08 * 1.08) * truth_white(config);
    assert!((got.ambient * white / config.ambient - 1.0).abs() < 0.02, "{}", got.ambient);
    // Samples that were lost leave levels out, which is said.
    let half = &samples[..samples.len() / 2];
    assert!(solve(levels, showing, half, *room).unwrap_err().contains("were not seen whole"));
    let cut = Showing::of(&lit[..lit.len() / 2], rate()).unwrap();
    assert!(solve(levels, &cut, samples, *room).unwrap_err().contains("not seen"));
    // What the first half lacks is read in a second pass, in which the light is weaker.
    let mut readings = Readings::default();
    readings.add(levels, showing, half, *room).unwrap();
    let rest = levels.missing(&readings).unwrap().unwrap();
    assert_eq!(rest.count() + readings.count(), levels.count());
    let again = show(rest, config, |_| 0.8);
    readings.add(&again.levels, &again.showing, &again.samples, *room).unwrap();
    assert!(levels.missing(&readings).unwrap().is_none());
    let twice = readings.solve(levels, *room).unwrap();
    for (a, b) in twice.intensity.iter().zip(&got.intensity) {
        assert!((a - b).abs() < 2e-3, "{:?} {:?}", twice.intensity, got.intensity);
    }
    assert!(solve(levels, showing, &[], *room).is_err());
}

/// Light of code 255 over that of planes without droop.
fn truth_white(config: &SensorWandConfig) -> f64 {
    (0..8).map(|b| f64::from(1u32 << b)).map(|c| c * (1.0 - config.droop * c / 128.0)).sum::<f64>() / 255.0
}

#[test]
fn a_light_that_fades_slowly_is_divided_out_and_a_sudden_change_is_named() {
    let mut bench = bench(4, 0.2);
    let got = solve(&bench.levels, &bench.showing, &bench.samples, bench.room).unwrap();
    let (last, first) = (got.intensity[2], got.intensity[0]);
    // Blue came last, when a fifth of the light was gone.
    assert!((last - 0.25).abs() < 4e-3 && (first - 0.35).abs() < 4e-3, "{:?}", got.intensity);
    let half = bench.samples.len() / 2;
    for timed in &mut bench.samples[half..] {
        timed.block.levels.iter_mut().for_each(|l| *l *= 0.7);
    }
    let told = solve(&bench.levels, &bench.showing, &bench.samples, bench.room).unwrap_err();
    assert!(told.contains("changes by") || told.contains("changed by"), "{told}");
}

/// Simulated minutes.
mod breadth {
    use super::*;

    /// The light of the whole never changes among tiles, and each tile's level is that of the full field.
    #[test]
    fn levels_in_tiles_are_those_of_the_mock_wherever_the_sensor_lies() {
        let schedule = PlaneSchedule::rgb24();
        let at = |x: f64, y: f64| SensorWandConfig { tip_m: [x, y, 0.12], ..bench_config() };
        let probe = |config: &SensorWandConfig| {
            let bench = show(Levels::two(&schedule, rate()).unwrap(), config, |_| 1.0);
            bench.levels.is_on_complement(&bench.showing, &bench.samples, bench.room)
        };
        // A tile has 8 x 8 pixels of 10.8 mm; in the middle of the raster four of them meet.
        assert!(probe(&at(0.0, 0.0)).unwrap_err().contains("neighbouring tiles"));
        let (one, other) = (at(-0.043, 0.043), at(0.043, 0.043));
        assert_eq!([probe(&one), probe(&other)], [Ok(true), Ok(false)]);
        let levels = Levels::new(&schedule, rate(), LevelField::Tiles { is_exchanged: true }, 4).unwrap();
        let source = Arc::new(levels.clone());
        let raster = Raster::new(64, 48).unwrap();
        let mut painter = PatternPainter::new(source, raster);
        let mut planes = BitPlaneFrame::new(raster, schedule);
        for picture in 0..levels.steps.len() as u64 {
            painter.draw(Kernel::Scalar, picture, &mut planes);
            assert_eq!(mean_luminance(raster, &schedule, planes.bytes()), FULL_LUMINANCE / 2, "{picture}");
        }
        let LevelsBench { levels, showing, samples, room, config, .. } = &show(levels, &one, |_| 1.0);
        let got = solve(levels, showing, samples, *room).unwrap();
        for (channel, colour) in config.colours.into_iter().enumerate() {
            assert!((got.intensity[channel] - colour).abs() < 3e-3, "{:?}", got.intensity);
            let half = got.level(channel, 128.0 / 255.0) / got.level(channel, 1.0);
            assert!((half - truth(config, 128)).abs() < 5e-3, "channel {channel}: {half}");
        }
        assert_eq!(levels.full_white_s(), 0.0);
    }

    #[test]
    fn the_limit_of_flashes_is_kept_by_the_limiter_itself() {
        let schedule = PlaneSchedule::rgb24();
        let mut holds = Vec::new();
        for limit in [None, Some(3), Some(2), Some(1)] {
            let levels = Levels::new(&schedule, rate(), LevelField::Full(limit), CODES).unwrap();
            holds.push(levels.hold);
            let Some(limit) = limit else { continue };
            // The averages of the limiter begin at other slots than the levels.
            for first in 12_345..12_361 {
                let mut limiter = FlashLimiter::new(rate(), limit);
                let mut slots = first..first + 2 * levels.steps.len() as u64 * levels.hold;
                let light = |slot| luminance(&schedule, levels.steps[source_step(&levels, slot)].code);
                assert!(!slots.any(|s| limiter.observe(s, light(s))), "limit {limit} from slot {first}");
            }
        }
        assert!(holds.is_sorted() && holds[3] > holds[0], "{holds:?}");
    }
}
