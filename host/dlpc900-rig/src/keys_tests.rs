//! What a rig file says of a DLPC900: instants and planes of its light, and refusals.

use crate::behind::BehindConfig;
use dpm_device::planes::{Channel, PlaneSchedule};
use dpm_dlpc900::lut::led;
use dpm_rig::config::{ConfigErrors, Overrides, PlaneTiming, RigConfig};
use dpm_rig::projectors::display::DisplayConfig;
use dpm_rig::projectors::LitTime;
use dpm_rig::standing::Identity;
use std::path::Path;

/// A template of a rig file, with some keys changed.
fn template(name: &str, keys: &[&str]) -> Result<RigConfig, ConfigErrors> {
    crate::register();
    let path = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../rigs")).join(name);
    let flags = keys.iter().map(|k| (*k).to_owned()).collect();
    RigConfig::load(&path, &Overrides { variables: vec![], flags })
}

/// A controller behind a display shows a frame once it has all of it, and each of its planes for the same time; what does not
/// fit it is refused.
#[test]
fn a_controller_behind_a_display_shows_frames_that_have_arrived() {
    let parsed = |keys: &[&str]| template("dlpc900-live.toml", keys);
    let projector = parsed(&[]).unwrap_or_else(|e| panic!("{e}")).projector;
    assert_eq!(projector.light_delay_ns(), 8_000_000 + 2 * (16_666_667 / 2));
    assert_eq!(projector.plane_timing(), PlaneTiming::Equal);
    let lit = LitTime { whole_ns: 24 * 684_000, dark_ns: 64_000, frame_ns: 16_666_666 };
    assert_eq!(projector.lit_time(), lit);
    assert!(!projector.is_lit_without_gap());
    assert_eq!(projector.schedule(), PlaneSchedule::equal_rgb24().filled());
    // The encoding says everything of the planes: their number of bits, their LEDs, their instants, their weights.
    let rgb8 = "projector.backend.encoding=\"rgb8\"";
    for (encoding, patterns, white, exposure_us) in [
        ("rgb8", 3, false, 4960),
        ("rgb4x2", 6, false, 2480),
        ("rgb2x4", 12, false, 1240),
        ("planes24", 24, false, 620),
        ("binary24", 24, false, 620),
        ("mono8x3", 3, true, 4960),
        ("mono6x4", 4, true, 3720),
        ("mono4x6", 6, true, 2480),
        ("mono3x8", 8, true, 1860),
        ("mono2x12", 12, true, 1240),
        ("mono1x24", 24, true, 620),
    ] {
        let key = format!("projector.backend.encoding={encoding:?}");
        let p = parsed(&[&key]).unwrap_or_else(|e| panic!("{encoding}: {e}")).projector;
        let (timing, schedule) = (p.plane_timing(), p.schedule());
        match patterns {
            24 => assert_eq!(timing, PlaneTiming::Equal),
            _ => assert_eq!(timing, PlaneTiming::Together { planes: 24 / patterns as u8 }),
        }
        // What the patterns leave of the frame is a gap after each of them, and 250 us at its end.
        let LitTime { whole_ns, dark_ns, frame_ns } = p.lit_time();
        assert_eq!(whole_ns, patterns * (exposure_us * 1000 + dark_ns), "{encoding}");
        assert!(
            (250_000..250_000 + patterns * 1000).contains(&(frame_ns - whole_ns)),
            "{encoding}: {whole_ns}"
        );
        assert_eq!(schedule.planes().iter().all(|p| p.channel == Channel::White), white, "{encoding}");
        assert_eq!((schedule.len(), schedule.fills(), p.full_light()), (24, true, 255), "{encoding}");
        let display: &DisplayConfig = p.backend.keys().expect("a display");
        let behind: &BehindConfig = display.dlpc900.keys().expect("a controller");
        let video = behind.video_patterns(display.encoding.parts(), p.frame_rate, &schedule).unwrap();
        assert_eq!(video.entries.len() as i64, patterns, "{encoding}");
        let lit_us: u32 = video.entries.iter().map(|e| e.exposure_us).sum();
        let (last, others) = video.entries.split_last().unwrap();
        assert!(
            others.iter().all(|e| i64::from(e.dark_us) * 1000 == dark_ns) && last.dark_us == 0,
            "{encoding}"
        );
        assert!(video.entries.iter().all(|e| e.leds == led::WHITE) == white && lit_us < 16_417, "{encoding}");
    }
    for (keys, names) in [
        (&["projector.weights=\"binary\""][..], "lights all planes of a pixel equally long"),
        (&[rgb8, "projector.weights=\"equal\""], "weights the bits of a pattern itself"),
        (&["projector.width=1024"], "a DLP6500 has 1920 x 1080 mirrors"),
        (&["projector.backend.dlpc900.panel=\"dlp9000\""], "a DLP9000 has 2560 x 1600 mirrors"),
        (&["projector.backend.dlpc900.exposure_us=685"], "not within 105 to 684 us"),
        (&["projector.frame_rate=144"], "at most 120 video frames/s"),
        (&[rgb8, "projector.frame_rate=90"], "lower the frame rate"),
        (&[rgb8, "projector.planes=8"], "set projector.planes = 24"),
    ] {
        let told = parsed(keys).expect_err("refused").to_string();
        assert!(told.contains(names), "{keys:?}: {told}");
    }
}

/// A controller that is loaded shows at most 120 frames/s of its panel's size, and no head can be spared, because nobody knows
/// when a frame is loaded where it will be.
#[test]
fn what_does_not_fit_a_loaded_controller_is_refused_with_its_keys() {
    for (text, named) in [
        ("[projector]\nwidth = 1920\nheight = 1080", &["projector.backend.kind", "120 frames/s"][..]),
        (
            "[projector]\nframe_rate = 60",
            &[
                "DLP6500 has 1920 x 1080",
                "`projector.width` = 1024",
                "`projector.height` = 768",
                "`projector.backend.panel` = \"dlp6500\"",
            ],
        ),
        (
            "[projector]\nframe_rate = 60\nwidth = 1920\nheight = 1080\nweights = \"equal\"",
            &["`projector.backend.kind` = \"dlpc900\"", "weights the bits of loaded frames itself"],
        ),
        (
            "[observer]\ntracked = \"g\"\n[projector]\nwidth = 1920\nheight = 1080\nframe_rate = 60",
            &["observer.tracked", "a DLPC900 cannot spare it"],
        ),
    ] {
        crate::register();
        let text = format!("{text}\n[projector.backend]\nkind = \"dlpc900\"");
        let told = RigConfig::parse("rig.toml", &text, Path::new(""), &Overrides::default());
        let told = told.expect_err("refused").to_string();
        for part in named {
            assert!(told.contains(part), "{text}: {part} in {told}");
        }
    }
    for name in ["dlpc900.toml", "dlpc900-live.toml"] {
        let told = template(name, &["projector.weights=\"split\""]).expect_err(name).to_string();
        assert!(told.contains("does not dim its light from plane to plane"), "{name}: {told}");
    }
    let auto = template("dlpc900.toml", &["projector.weights=\"auto\""]).unwrap_or_else(|e| panic!("{e}"));
    assert!(!auto.projector.schedule().exceeds());
}

/// Its place on the bus changes with every plug.
#[test]
fn a_place_on_the_bus_has_a_lock_and_proves_nothing() {
    let [one, two] = ["1:4", "1:5"].map(|place| {
        let rig = template("dlpc900.toml", &[&format!("projector.backend.device={place:?}")]);
        Identity::of(&rig.unwrap_or_else(|e| panic!("{e}")).projector.backend)
    });
    assert_ne!(one.lock_name(), two.lock_name());
    assert!(!one.is_one_device() && !one.is_mock());
}
