//! What a rig file says of its projector: instants and planes of displays and of controllers behind them, and refusals.

use crate::config::*;
use crate::projectors::display::{DisplayConfig, DisplayEncoding, DisplayLease};
use dpm_device::planes::{Channel, PlaneSchedule};
use dpm_dlpc900::lut::led;
use std::path::Path;

/// A template of a rig file, with some keys changed.
fn template(name: &str, keys: &[&str]) -> Result<RigConfig, ConfigErrors> {
    let path = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../rigs")).join(name);
    let flags = keys.iter().map(|k| (*k).to_owned()).collect();
    RigConfig::load(&path, &Overrides { variables: vec![], flags })
}

/// The template of a display is a rig, and its light is later than its slots: by the time until the blank and until the
/// middle row, and by the projector's own latency.
#[test]
fn the_light_of_a_display_is_later_than_its_slots() {
    let parsed = |keys: &[&str]| template("display.toml", keys);
    let rig = parsed(&[]).unwrap_or_else(|e| panic!("{e}"));
    let display: &DisplayConfig = rig.projector.backend.keys().expect("a display");
    assert_eq!((display.encoding, display.commit_us), (DisplayEncoding::Rgb8, None));
    assert_eq!(display.lease, DisplayLease::Auto);
    for (word, lease) in
        [("off", DisplayLease::Off), ("x11", DisplayLease::X11), ("wayland", DisplayLease::Wayland)]
    {
        let rig = parsed(&[&format!("projector.backend.lease={word}")]).unwrap_or_else(|e| panic!("{e}"));
        let display: &DisplayConfig = rig.projector.backend.keys().expect("a display");
        assert_eq!(display.lease, lease);
    }
    let told = parsed(&["projector.backend.lease=mir"]).unwrap_err().to_string();
    assert!(told.contains("projector.backend.lease") && told.contains("wayland"), "{told}");
    // 16 ms, 8 ms, and half of a sixtieth of a second.
    assert_eq!(rig.projector.light_delay_ns(), 24_000_000 + 8_333_333);
    assert!(rig.projector.plane_timing() == PlaneTiming::Held);
    let alp = template("alp.toml", &[]).unwrap_or_else(|e| panic!("{e}"));
    // Eight planes and a dark picture.
    assert_eq!(alp.projector.plane_timing(), PlaneTiming::Equal);
    let LitTime { whole_ns, frame_ns, .. } = alp.projector.lit_time();
    assert_eq!(whole_ns, frame_ns - frame_ns / 9);
    let binary =
        ["projector.weights=binary", "projector.backend.plane_times=binary", "projector.frame_rate=80"];
    let alp = template("alp.toml", &binary).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(alp.projector.plane_timing(), PlaneTiming::ByWeight);
    let window = template("window.toml", &[]).unwrap_or_else(|e| panic!("{e}"));
    // Three quarters of a sixtieth of a second, and half of it.
    assert_eq!(window.projector.light_delay_ns(), 16_666_667 / 4 * 3 + 8_333_333);
    assert!(window.projector.plane_timing() == PlaneTiming::Held);
    let usb = parsed(&["projector.backend={kind=\"usb\"}"]).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(
        (usb.projector.light_delay_ns(), usb.projector.plane_timing()),
        (16_000_000, PlaneTiming::Equal)
    );
    for (key, names) in [
        ("projector.backend.mode=\"1920\"", "projector.backend.mode"),
        ("projector.backend={kind=\"display\",encoding=\"planes24\"}", "projector.planes = 24"),
        ("projector.weights=\"equal\"", "projector.weights"),
        ("projector={backend={kind=\"window\"},weights=\"equal\"}", "a window shows code values"),
        ("projector.backend.commit_us=1", "projector.backend.commit_us"),
        ("real_time.pace=\"virtual\"", "runs on its own clock"),
    ] {
        let told = parsed(&[key, "projector.planes=8"]).expect_err("refused").to_string();
        assert!(told.contains(names), "{told}");
    }
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
        let video = display.video_patterns(p.frame_rate, &schedule).unwrap().unwrap();
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

/// Planes whose highest bit is split are for projectors that dim their light from plane to plane, and nothing else asks a device
/// for planes that exceed full light.
#[test]
fn only_projectors_that_dim_their_planes_split_the_highest_bit() {
    let split = "projector.weights=\"split\"";
    let binary = "projector.weights=\"binary\"";
    for name in ["usb-natnet.toml", "demo.toml"] {
        let schedule = |keys: &[&str]| {
            template(name, keys).unwrap_or_else(|e| panic!("{name}, {keys:?}: {e}")).projector.schedule()
        };
        assert!(
            !schedule(&[binary]).exceeds() && !schedule(&["projector.weights=\"equal\""]).exceeds(),
            "{name}"
        );
        assert_eq!(schedule(&[split]), PlaneSchedule::split_rgb24(), "{name}");
        assert_eq!(schedule(&[split, "projector.planes=8"]), PlaneSchedule::split_mono8(), "{name}");
    }
    for name in ["display.toml", "window.toml", "alp.toml", "dlpc900-live.toml", "dlpc900.toml"] {
        let told = template(name, &[split]).expect_err(name).to_string();
        assert!(told.contains("does not dim its light from plane to plane"), "{name}: {told}");
    }
}

/// "auto" splits the highest bit only where nothing was measured or limited with other planes, and where the light is for a run.
#[test]
fn auto_splits_the_highest_bit_only_where_nothing_speaks_against_it() {
    let auto = "projector.weights=\"auto\"";
    let exceeds = |name: &str, keys: &[&str]| {
        let keys = [&[auto][..], keys].concat();
        template(name, &keys)
            .unwrap_or_else(|e| panic!("{name}, {keys:?}: {e}"))
            .projector
            .schedule()
            .exceeds()
    };
    assert!(
        exceeds("demo.toml", &[])
            && exceeds("usb-natnet.toml", &[])
            && exceeds("demo.toml", &["projector.planes=8"])
    );
    assert!(template("usb-natnet.toml", &[]).unwrap().projector.schedule().exceeds(), "the template has it");
    for key in [
        "safety.limits.mean_level=0.3",
        "safety.limits.full_white_s=2",
        "projector.response={kind=\"gamma\"}",
        concat!("projector.flat_field=\"", env!("CARGO_MANIFEST_DIR"), "/Cargo.toml\""),
        "projector.plane_order=\"7 6 5 4 3 2 1 0\"",
    ] {
        assert!(!exceeds("usb-natnet.toml", &[key]), "{key}");
    }
    for name in ["display.toml", "window.toml", "alp.toml", "dlpc900.toml"] {
        assert!(!exceeds(name, &[]), "{name}");
    }
    let overrides = Overrides { flags: vec![auto.into()], ..Overrides::default() };
    for purpose in [
        Purpose { projector_only: true, at_rest: true, ..Purpose::default() },
        Purpose { calibrates: true, at_rest: true, ..Purpose::default() },
    ] {
        let rig = RigConfig::demo_for(&overrides, purpose).unwrap();
        assert_eq!(rig.projector.weights, PlaneWeights::Binary, "{purpose:?}");
    }
}

/// Limits count the light of binary planes whatever planes are lit, so no schedule makes a limit wider: not the rig's own, and
/// not the one that a limit says it was measured with.
#[test]
fn no_schedule_widens_a_limit() {
    let permille = |keys: &[&str]| {
        let all = [&["safety.limits.mean_level=0.3"][..], keys].concat();
        let rig = template("usb-natnet.toml", &all).unwrap_or_else(|e| panic!("{keys:?}: {e}"));
        rig.safety.limits.limits(&rig.projector).mean_permille
    };
    let [split, equal] = ["split", "equal"].map(|w| format!("projector.weights={w:?}"));
    let named = |w: &str| format!("safety.limits.measured_with={w:?}");
    let [binary_named, equal_named, split_named] = ["binary", "equal", "split"].map(named);
    let plain: [&[&str]; 5] = [&[], &[&split], &[&equal], &[&binary_named], &[&split, &binary_named]];
    for keys in plain {
        assert_eq!(permille(keys), 300, "{keys:?}");
    }
    // White of equal planes is 128 of 255.
    assert_eq!(permille(&[&named("equal")]), 150);
    assert_eq!(permille(&[&split, &named("equal")]), 150);
    // An ALP lights all planes fully, so its white is the same.
    let alp = template("alp.toml", &["safety.limits.mean_level=0.3", &named("equal")]).unwrap();
    assert_eq!(alp.safety.limits.limits(&alp.projector).mean_permille, 300);
    let mean = "safety.limits.mean_level=0.3";
    let refused: [(&[&str], &str); 5] = [
        (&[mean, &split_named], "would be that much wider"),
        (&[mean, &split_named, &split], "would be that much wider"),
        (&["safety.limits.full_white_s=2", &equal_named], "counts levels of 0.95"),
        (&["safety.limits.mean_level=0.0015", &equal_named], "below a thousandth"),
        (&[&equal_named], "there are none"),
    ];
    for (keys, names) in refused {
        let told = template("usb-natnet.toml", keys).expect_err("refused").to_string();
        assert!(told.contains(names), "{keys:?}: {told}");
    }
}

/// What a code value gives is measured with some planes, and a rig with others is refused. What says nothing was not measured
/// with planes that exceed full light.
#[test]
fn measured_light_is_that_of_the_planes_it_was_measured_with() {
    let gamma = "projector.response={kind=\"gamma\"}";
    let flat = concat!("projector.flat_field=\"", env!("CARGO_MANIFEST_DIR"), "/Cargo.toml\"");
    let [split, equal] = ["split", "equal"].map(|w| format!("projector.weights={w:?}"));
    let named = |w: &str| format!("projector.measured_with={w:?}");
    let [of_binary, of_split] = ["binary", "split"].map(named);
    let good: [&[&str]; 5] =
        [&[gamma], &[gamma, &equal], &[flat, &of_binary], &[gamma, &split, &of_split], &[&split]];
    for keys in good {
        template("usb-natnet.toml", keys).unwrap_or_else(|e| panic!("{keys:?}: {e}"));
    }
    let bad: [&[&str]; 5] = [
        &[gamma, &split],
        &[flat, &split],
        &[gamma, &split, &of_binary],
        &[gamma, &of_split],
        &[flat, &equal, &of_binary],
    ];
    for keys in bad {
        let told = template("usb-natnet.toml", keys).expect_err("refused").to_string();
        assert!(told.contains("the light of other planes was measured"), "{keys:?}: {told}");
    }
    let told = template("usb-natnet.toml", &[&named("equal")]).expect_err("refused").to_string();
    assert!(told.contains("there are none"), "{told}");
}
