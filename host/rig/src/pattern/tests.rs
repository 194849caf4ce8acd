//! Laws of the patterns: what each pixel shows, what is decoded from it, and that the light of the mock is the
//! pattern, bit for bit.

use super::*;
use crate::config::{Overrides, RigConfig};
use crate::pack::source::{Canvas, PatternPainter, PatternSource};
use crate::pipeline::{run_pattern as run_pipeline, RunOptions};
use crate::rig::Rig;
use crate::telemetry::monitor::RunMonitor;
use dpm_device::time::FrameRate;
use dpm_render::pack::{BitPlaneFrame, Kernel};
use std::sync::Arc;

fn raster(width: u32, height: u32) -> Raster {
    Raster::new(width, height).expect("a raster")
}

/// The number that a Gray code stands for.
fn number_of_gray(code: u32) -> u32 {
    [1, 2, 4, 8, 16].into_iter().fold(code, |number, shift| number ^ number >> shift)
}

fn rate() -> FrameRate {
    FrameRate::new(947, 1).expect("a rate")
}

fn show(
    pattern: Pattern,
    raster: Raster,
    hold_ms: u64,
    only: Option<u32>,
) -> Result<PatternShow, PatternError> {
    PatternShow::new(pattern, Ink::WHITE, (raster, &PlaneSchedule::rgb24()), rate(), hold_ms, only)
}

fn lit(pattern: Pattern, raster: Raster, step: u32) -> Vec<(u32, u32)> {
    let all = (0..raster.height()).flat_map(|y| (0..raster.width()).map(move |x| (x, y)));
    all.filter(|&(x, y)| pattern.value(raster, step, x, y) > 0).collect()
}

#[test]
fn gray_codes_of_neighbours_differ_in_one_bit_and_decode_to_the_column() {
    for raster in [raster(1024, 768), raster(912, 1140), raster(37, 5), raster(1, 1)] {
        for axis in [Axis::Columns, Axis::Rows] {
            let pattern = Pattern::Gray { axis };
            let steps = pattern.steps(raster);
            let count = axis.of(raster, 0, 0).1;
            let at = |step: u32, i: u32| match axis {
                Axis::Columns => pattern.value(raster, step, i, raster.height() - 1),
                Axis::Rows => pattern.value(raster, step, raster.width() - 1, i),
            };
            let mut before = None;
            for i in 0..count {
                let mut code = 0;
                for bit in 0..steps / 2 {
                    let (on, inverse) = (at(2 * bit, i), at(2 * bit + 1, i));
                    // A pattern and its inverse: together they are full light.
                    assert_eq!(u32::from(on) + u32::from(inverse), 255);
                    code = code << 1 | u32::from(on > inverse);
                }
                assert_eq!(number_of_gray(code), i, "{axis:?} {i} of {count}");
                if let Some(before) = before.replace(code) {
                    assert_eq!((code ^ before).count_ones(), 1);
                }
            }
        }
    }
}

#[test]
fn fringes_decode_to_the_position_in_their_period() {
    let raster = raster(256, 64);
    for (period, shifts) in [(32, 4), (17, 3), (100, 12)] {
        let pattern = Pattern::Phase { axis: Axis::Columns, period, shifts };
        for x in 0..raster.width() {
            let (mut c, mut s) = (0.0, 0.0);
            for step in 0..pattern.steps(raster) {
                let angle = std::f64::consts::TAU * f64::from(step) / f64::from(shifts);
                let level = f64::from(pattern.value(raster, step, x, 9));
                c += level * angle.cos();
                s += level * angle.sin();
            }
            let found = s.atan2(c) / std::f64::consts::TAU * f64::from(period);
            let apart = (found - f64::from(x) - 0.5).rem_euclid(f64::from(period));
            let apart = apart.min(f64::from(period) - apart);
            // Levels are rounded to one of 127.5 steps of the amplitude.
            assert!(
                apart < f64::from(period) / 127.5 / std::f64::consts::PI,
                "{period} {shifts} {x}: {apart}"
            );
        }
    }
}

#[test]
fn shifted_stripes_decode_to_the_pixel_in_their_period() {
    let raster = raster(64, 48);
    let (axis, period) = (Axis::Rows, 8);
    let pattern = Pattern::Shifted { axis, period };
    for y in 0..raster.height() {
        let steps: Vec<bool> = (0..period).map(|step| pattern.value(raster, step, 3, y) > 0).collect();
        // The step at which the pixel turns on says where in the period it lies.
        let turns_on = (0..period as usize).filter(|&k| steps[k] && !steps[(k + 7) % 8]).collect::<Vec<_>>();
        assert_eq!(turns_on, [((y + 8 - 3) % 8) as usize], "row {y}");
        assert_eq!(steps.iter().filter(|on| **on).count(), 4);
    }
}

#[test]
fn a_cross_and_a_dot_light_exactly_their_pixels() {
    let raster = raster(20, 12);
    let cross = Pattern::Cross { at: [7, 4], arm: None };
    let mut expected: Vec<_> = (0..12).map(|y| (7, y)).chain((0..20).map(|x| (x, 4))).collect();
    expected.sort_by_key(|&(x, y)| (y, x));
    expected.dedup();
    assert_eq!(lit(cross, raster, 0), expected);
    let small = Pattern::Cross { at: [0, 11], arm: Some(2) };
    assert_eq!(lit(small, raster, 0), [(0, 9), (0, 10), (0, 11), (1, 11), (2, 11)]);
    assert_eq!(lit(Pattern::Dot { at: [19, 3], diameter: 1 }, raster, 0), [(19, 3)]);
    let disc = lit(Pattern::Dot { at: [9, 6], diameter: 6 }, raster, 0);
    assert!(disc.iter().all(|&(x, y)| x.abs_diff(9).pow(2) + y.abs_diff(6).pow(2) <= 9));
    assert_eq!(disc.len(), 29);
}

#[test]
fn squares_lines_ramps_and_stars_are_where_they_should_be() {
    let raster = raster(100, 80);
    let value = |pattern: Pattern, x, y| pattern.value(raster, 0, x, y);
    for (x, y) in [(0, 0), (63, 17), (99, 79), (30, 10), (20, 41)] {
        let squares = (x / 10 + y / 10) % 2 == 0;
        assert_eq!(value(Pattern::Chessboard { square: 10 }, x, y) > 0, squares);
        let lines = x % 30 == 0 || y % 30 == 0 || x == 99 || y == 79;
        assert_eq!(value(Pattern::Grid { pitch: 30 }, x, y) > 0, lines);
        let ramp = (f64::from(x) * 255.0 / 99.0).round() as u8;
        assert_eq!(value(Pattern::Ramp { axis: Axis::Columns }, x, y), ramp);
        assert_eq!(value(Pattern::Full, x, y), 255);
    }
    // Around the centre, every spoke is lit once and dark once.
    let star = Pattern::FocusStar { spokes: 12 };
    let around = |k: u32| {
        let angle = (f64::from(k) + 0.5) / 24.0 * std::f64::consts::TAU;
        value(star, (50.0 + 35.0 * angle.cos()) as u32, (40.0 + 35.0 * angle.sin()) as u32) > 0
    };
    assert!((0..24).all(|k| around(k) == (k % 2 == 0)));
}

#[test]
fn a_counter_is_read_from_its_blocks_and_never_changes_its_light() {
    for raster in [raster(1024, 768), raster(101, 83), raster(8, 8)] {
        let read = |number: u32| {
            let value = |block: u32, row: u32| {
                let size = |count: u32| (count / 8, count % 8 / 2);
                let ((w, left), (h, top)) = (size(raster.width()), size(raster.height()));
                Pattern::Counter.value(raster, number, left + block * w + w / 2, top + row * h + h / 2)
            };
            (0..32).fold(0u32, |n, i| {
                let (on, off) = (value(i % 4 * 2, i / 4), value(i % 4 * 2 + 1, i / 4));
                assert_eq!(u32::from(on) + u32::from(off), 255, "bit {i}");
                n << 1 | u32::from(on > off)
            })
        };
        let area = |number| lit(Pattern::Counter, raster, number).len();
        for number in [0, 1, 946, 0xdead_beef, u32::MAX] {
            assert_eq!(read(number), number);
            assert_eq!(area(number), area(0));
        }
    }
}

#[test]
fn fill_is_value_in_every_pixel() {
    let raster = raster(33, 21);
    let ink = Ink { level: 200, channel: Some(Channel::Blue) };
    for pattern in [
        Pattern::Gray { axis: Axis::Columns },
        Pattern::Gray { axis: Axis::Rows },
        Pattern::Phase { axis: Axis::Columns, period: 9, shifts: 3 },
        Pattern::Ramp { axis: Axis::Rows },
        Pattern::Counter,
        Pattern::Cross { at: [3, 4], arm: None },
    ] {
        let mut codes = vec![0xffff_ffff; raster.pixel_count()];
        pattern.fill(raster, 1, ink, &mut codes);
        for (i, code) in (0..).zip(&codes) {
            let value = pattern.value(raster, 1, i % 33, i / 33);
            assert_eq!(
                *code,
                (f64::from(value) * 200.0 / 255.0).round() as u32 * 0x1_0000,
                "{pattern:?} {i}"
            );
        }
    }
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let small = raster(64, 48);
    let told = |pattern, hold, only| show(pattern, small, hold, only).map(|_| ()).unwrap_err().to_string();
    let at = |x, y| Pattern::Cross { at: [x, y], arm: None };
    assert!(told(at(64, 0), 1000, None).starts_with("--at 64,0 lies outside the raster of 64 x 48 pixels"));
    assert!(told(Pattern::Dot { at: [0, 48], diameter: 3 }, 1, None).contains("rows from 0 to 47"));
    assert!(told(Pattern::Dot { at: [0, 4], diameter: 0 }, 1, None).contains("--size 0"));
    assert!(told(Pattern::Grid { pitch: 1 }, 1, None).contains("--size 1: must be 2 to 64"));
    assert!(told(Pattern::Chessboard { square: 65 }, 1, None).contains("--size 65"));
    assert!(told(Pattern::Shifted { axis: Axis::Rows, period: 7 }, 1, None).contains("an even number"));
    let phase = |period, shifts| Pattern::Phase { axis: Axis::Rows, period, shifts };
    assert!(told(phase(3, 4), 1, None).contains("--period 3"));
    assert!(told(phase(8, 2), 1, None).contains("--shifts 2: must be 3 to 64"));
    assert!(told(Pattern::FocusStar { spokes: 1 }, 1, None).contains("--size 1"));
    assert!(told(Pattern::Full, 0, None).contains("--hold-ms 0"));
    assert!(told(Pattern::Gray { axis: Axis::Columns }, 1, Some(12)).contains("--step 12: must be 0 to 11"));
    assert!(Pattern::Counter.check(raster(7, 100)).is_err());
    let red = Ink { level: 1, channel: Some(Channel::Red) };
    assert!(red.check(&PlaneSchedule::mono8()).unwrap_err().to_string().starts_with("--channel r"));
    assert!(red.check(&PlaneSchedule::rgb24()).is_ok());
}

#[test]
fn a_step_is_held_for_its_time_and_the_only_step_for_ever() {
    let gray = show(Pattern::Gray { axis: Axis::Rows }, raster(64, 4), 1000, None).unwrap();
    let seen: Vec<u64> = (0..5).map(|s| gray.picture(947 * s + 946, 0)).collect();
    assert_eq!(seen, [0, 1, 2, 3, 0]);
    let only = show(Pattern::Gray { axis: Axis::Rows }, raster(64, 4), 1000, Some(3)).unwrap();
    assert!((0..10_000).all(|frame| only.picture(frame, 0) == 3) && only.pictures() == (3..4));
    let counter = show(Pattern::Counter, raster(64, 48), 1000, None).unwrap();
    assert_eq!(counter.picture((1 << 32) + 5, 0), 5);
}

/// Gray code never puts full light against none, so it may be stepped as fast as frames go; stripes of a narrow
/// raster cover different shares of it.
#[test]
fn only_steps_of_different_brightness_are_refused_as_flashes() {
    let schedule = PlaneSchedule::rgb24();
    for hold_ms in [1, 20, 150] {
        let gray = show(Pattern::Gray { axis: Axis::Columns }, raster(1024, 64), hold_ms, None).unwrap();
        assert!(!flashes(&gray, &schedule, rate(), Some(3)), "{hold_ms}");
    }
    // Of 9 columns, the first bit lights 1 and its inverse 8.
    let uneven = |hold_ms| show(Pattern::Gray { axis: Axis::Columns }, raster(9, 64), hold_ms, None).unwrap();
    assert!(flashes(&uneven(50), &schedule, rate(), Some(3)));
    assert!(!flashes(&uneven(50), &schedule, rate(), None));
    let least = shortest_hold_ms(&uneven(50), &schedule, rate(), 3);
    assert!((100..=400).contains(&least), "{least}");
    assert!(!flashes(&uneven(least), &schedule, rate(), Some(3)));
}

/// Twenty-four planes of noise that no code value explains: each plane of each frame differs.
struct PlaneNoise(Option<PlaneSchedule>);

impl PatternSource for PlaneNoise {
    fn schedule(&self) -> Option<PlaneSchedule> {
        self.0
    }

    fn draw(&self, picture: u64, canvas: &mut Canvas<'_>) {
        let bytes = canvas.planes().bytes_mut();
        let mut state = picture.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        for byte in bytes {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            *byte = (state >> 56) as u8;
        }
    }
}

fn rig_of_projector(more: &[&str]) -> (RigConfig, Arc<Rig>) {
    let flags = more.iter().map(|s| (*s).to_owned()).collect();
    let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
    let rig = Rig::of_projector(&config).unwrap_or_else(|e| panic!("{e}"));
    (config, Arc::new(rig))
}

/// Runs `source` at virtual pace against the mock and compares every kept frame of light with the planes that the
/// source gives.
fn light_is_the_pattern(source: Arc<dyn PatternSource>, rig: &Arc<Rig>, frames: u64) {
    let options = RunOptions { frames, keep_frames: frames as usize, ..RunOptions::default() };
    let outcome = run_pipeline(rig.clone(), source.clone(), None, options, &Arc::new(RunMonitor::default()))
        .unwrap_or_else(|e| panic!("{e}"));
    assert_eq!((outcome.report.frames_lit, outcome.light_mismatches), (frames, 0), "{:?}", outcome.report);
    assert_eq!((outcome.report.method, outcome.light.len() as u64), ("pattern", frames));
    let (raster, schedule) = (rig.camera.raster, source.schedule().unwrap_or(rig.schedule));
    let mut painter = PatternPainter::new(source.clone(), raster);
    let mut planes = BitPlaneFrame::new(raster, schedule);
    let mut codes = vec![0; raster.pixel_count()];
    for light in &outcome.light {
        painter.draw(Kernel::Scalar, source.picture(u64::from(light.frame), 0), &mut planes);
        dpm_render::pack::unpack(&planes, &mut codes);
        let mut wanted: Vec<[u8; 3]> =
            codes.iter().map(|c| [*c as u8, (c >> 8) as u8, (c >> 16) as u8]).collect();
        if schedule.has_repeats() {
            // Each of the planes adds 8 of 255 of white where it is lit. Rows are whole bytes here.
            let lit = |plane: usize, i: usize| planes.plane(plane)[i / 8] >> (7 - i % 8) & 1;
            let sum = |i: usize| (0..24).map(|plane| 8 * lit(plane, i)).sum::<u8>();
            wanted = (0..raster.pixel_count()).map(|i| [sum(i); 3]).collect();
        }
        assert!(light.codes == wanted, "frame {}", light.frame);
    }
}

#[test]
fn the_light_of_the_mock_is_the_pattern_bit_for_bit() {
    let small = ["projector.width=64", "projector.height=48", "real_time.pace=\"virtual\"", "run.frames=1"];
    let (_, rig) = rig_of_projector(&small);
    let raster = rig.camera.raster;
    let of = |pattern, hold_ms| Arc::new(show(pattern, raster, hold_ms, None).unwrap());
    light_is_the_pattern(of(Pattern::Cross { at: [5, 7], arm: None }, 1), &rig, 6);
    // Every step for two frames.
    light_is_the_pattern(of(Pattern::Gray { axis: Axis::Columns }, 2), &rig, 40);
    light_is_the_pattern(of(Pattern::Counter, 1), &rig, 40);
    light_is_the_pattern(Arc::new(PlaneNoise(None)), &rig, 40);
    light_is_the_pattern(Arc::new(PlaneNoise(Some(PlaneSchedule::equal24()))), &rig, 40);
}

#[test]
fn neither_scene_nor_tracker_nor_calibration_has_to_exist() {
    let (mut config, _) =
        rig_of_projector(&["real_time.pace=\"virtual\"", "run.frames=3", "projector.width=32"]);
    config.scene.file = Some("/nonexistent/scene.glb".into());
    config.projector.calibration = Some("/nonexistent/calibration.yml".into());
    let text = "[tracker]\nkind = \"replay\"\nfile = \"/nonexistent/run.dpmt\"\n[scene]\nfile = \"no.glb\"\n\
                [projector]\ncalibration = \"no.yml\"\ncalibration_unit = \"metre\"\n";
    let purpose = crate::config::Purpose { projector_only: true, ..Default::default() };
    let read =
        RigConfig::parse_for("rig.toml", text, std::path::Path::new("/"), &Overrides::default(), purpose);
    assert!(read.is_ok(), "{:?}", read.err());
    let rig = Rig::of_projector(&config).unwrap_or_else(|e| panic!("{e}"));
    assert!(rig.bodies.is_empty() && rig.scene.bodies.is_empty());
    let ended = run_pattern(
        &config,
        Arc::new(show(Pattern::Full, rig.camera.raster, 1, None).unwrap()),
        &Arc::new(RunMonitor::default()),
    );
    assert_eq!(ended.unwrap_or_else(|e| panic!("{e}")).report.frames_lit, 3);
}

/// Shows full light for three seconds while a tracked head passes through the beam again and again. Holds every frame of the
/// light to the law: no mirror is lit whose ray meets the sphere about the true head, from the first photon of its slot to
/// the last. Returns the report, and for each frame when it was lit and the share of its mirrors that were.
fn light_about_a_head(more: &[&str]) -> (crate::telemetry::report::Report, Vec<(f64, f64)>) {
    let mut keys = vec![
        "projector.width=96",
        "projector.height=72",
        "projector.frame_rate=240",
        "real_time.pace=\"virtual\"",
        "run.frames=1",
        "observer.position=[0.05, 0.2, 0.5]",
        "observer.tracked={ name = \"glasses\", motion = { kind = \"sinusoid\", peak_speed_m_s = 1.2, \
         peak_acceleration_m_s2 = 3.0 } }",
        "safety.eyes.radius=0.08",
        "safety.flashes_per_second=0",
    ];
    keys.extend(more);
    let (_, rig) = rig_of_projector(&keys);
    let (raster, frames) = (rig.camera.raster, 720);
    let options = RunOptions { frames, keep_frames: frames as usize, ..RunOptions::default() };
    let source = Arc::new(show(Pattern::Full, raster, 1, None).unwrap());
    let outcome = run_pipeline(rig.clone(), source, None, options, &Arc::new(RunMonitor::default()))
        .unwrap_or_else(|e| panic!("{e}"));
    assert_eq!((outcome.light.len() as u64, outcome.light_mismatches), (frames, 0), "{:?}", outcome.report);
    let radius = rig.config.safety.eyes.radius;
    let ray = |i: usize| {
        let (x, y) = (i as u32 % raster.width(), i as u32 / raster.width());
        rig.camera.ray(glam::DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)).direction
    };
    let rays: Vec<_> = (0..raster.pixel_count()).map(ray).collect();
    let share = |light: &crate::light::recorder::LightFrame| {
        for end_ns in [0, rig.rate().slot_len_ns(0)] {
            let at = light.first_photon_at.plus_ns(end_ns);
            let to = rig.true_poses(at.0).unwrap()[0].translation - rig.camera.position();
            let meets = |ray: &glam::DVec3| (to - *ray * to.dot(*ray).max(0.0)).length() <= radius;
            for (i, ray) in rays.iter().enumerate() {
                assert!(light.codes[i] == [0; 3] || !meets(ray), "frame {}: light on a head", light.frame);
            }
        }
        let lit = light.codes.iter().filter(|code| **code != [0; 3]).count();
        (light.first_photon_at.0 as f64 * 1e-9, lit as f64 / light.codes.len() as f64)
    };
    (outcome.report, outcome.light.iter().map(share).collect())
}

#[test]
fn no_light_of_a_pattern_falls_on_a_head_that_passes() {
    let (report, lit) = light_about_a_head(&[]);
    let eyes = report.eyes.expect("a head is guarded");
    assert_eq!((eyes.heads, eyes.frames_dark, eyes.losses), (vec!["glasses".to_owned()], 0, vec![0]));
    // It passes: most of the field is lit always, and all of it at times.
    let [least, most] = lit.iter().fold([1.0f64, 0.0], |[a, b], (_, share)| [a.min(*share), b.max(*share)]);
    assert!(least > 0.2 && least < 0.8 && most == 1.0, "{least} {most}");
    let cut = lit.iter().filter(|(_, share)| *share < 1.0).count() as u64;
    assert_eq!(eyes.frames_cut, cut);
    assert!(eyes.most_mirrors > 0 && eyes.mirrors_cut > u64::from(eyes.most_mirrors));
    assert!(eyes.greatest_radius_m > 0.08 && eyes.greatest_radius_m < 0.25, "{}", eyes.greatest_radius_m);
}

/// The tracker loses the head for more than a second: the guard grows, then all is dark until the head is seen again.
#[test]
fn a_head_that_is_lost_makes_the_light_smaller_and_then_dark_until_it_is_seen() {
    let (report, lit) = light_about_a_head(&["tracker.faults=\"dropout@800ms+1400ms\""]);
    let eyes = report.eyes.expect("a head is guarded");
    assert_eq!(eyes.losses, [1], "{lit:?}");
    let dark: Vec<f64> = lit.iter().filter(|(_, share)| *share == 0.0).map(|(at, _)| *at).collect();
    // Before that the guard has grown over the whole beam.
    assert!(
        eyes.frames_dark > 180 && eyes.frames_dark < dark.len() as u64,
        "{} {}",
        eyes.frames_dark,
        dark.len()
    );
    let (first, last) = (dark[0], dark[dark.len() - 1]);
    // It is found when its filter has had a head's speed for a tenth of a second.
    assert!(first > 0.9 && first < 0.8 + 0.5 + 0.05 && last > 2.29 && last < 2.35, "{first} {last}");
    let is_one_stretch = dark.windows(2).all(|two| two[1] - two[0] < 0.01);
    assert!(is_one_stretch && report.frames_dark == eyes.frames_dark, "{}", report.frames_dark);
    let grows = lit.iter().filter(|(at, _)| (0.86..first).contains(at)).map(|(_, share)| *share);
    assert!(grows.clone().count() > 5 && grows.is_sorted_by(|a, b| a >= b), "{lit:?}");
}

/// Where the guard is off, light falls on heads as on everything else.
#[test]
fn without_the_guard_a_pattern_is_whole() {
    let small =
        ["projector.width=64", "real_time.pace=\"virtual\"", "run.frames=1", "safety.eyes.guard=false"];
    let keys: Vec<&str> = small.into_iter().chain(["observer.tracked=\"glasses\""]).collect();
    let (_, rig) = rig_of_projector(&keys);
    let raster = rig.camera.raster;
    light_is_the_pattern(Arc::new(show(Pattern::Full, raster, 1, None).unwrap()), &rig, 3);
}
