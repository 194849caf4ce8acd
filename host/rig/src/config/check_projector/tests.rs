//! What a rig file says of its projector: instants and planes of displays, and refusals.

use crate::config::*;
use crate::projectors::display::{DisplayConfig, DisplayEncoding, DisplayLease};
use dpm_device::planes::PlaneSchedule;
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
    for name in ["display.toml", "window.toml", "alp.toml"] {
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
    for name in ["display.toml", "window.toml", "alp.toml"] {
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
