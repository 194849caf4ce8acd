//! Laws of rehearsals. Each is runs of whole rigs.

use super::stage::RehearsalCase;
use super::*;
use dpm_device::rng::Draws;
use dpm_rig::config::{Overrides, Purpose};
use std::path::Path;

/// A rig file of the project with these keys.
fn rig(file: &str, keys: &[String]) -> RigConfig {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../rigs").join(file);
    let overrides = Overrides { flags: keys.to_vec(), ..Overrides::default() };
    let purpose = Purpose { at_rest: true, ..Purpose::default() };
    RigConfig::load_for(&path, &overrides, purpose).unwrap_or_else(|e| panic!("{e}"))
}

fn keys(keys: &[&str]) -> Vec<String> {
    keys.iter().map(|key| (*key).to_owned()).collect()
}

const SHORT: RehearsalExtent = RehearsalExtent { seeds: 2, seconds: 2.0, only_rig: true, pictures: false };

fn rehearsed(config: &RigConfig, extent: RehearsalExtent) -> RehearsalReport {
    rehearse(config, extent, &mut |_| ()).unwrap_or_else(|e| panic!("{e}"))
}

/// The parts list keeps below what people notice, at the speed and acceleration that it is judged by; and a rehearsal repeats
/// itself bit for bit.
#[test]
fn the_budget_rig_is_not_noticed_and_repeats_itself() {
    let config = rig("budget.toml", &[]);
    let [report, again] = [0, 1].map(|_| rehearsed(&config, SHORT));
    assert!((report.noticed_mm - 1.935).abs() < 1e-9);
    assert!(report.rig.mm.p99 < report.noticed_mm, "{}", report.to_table());
    assert_eq!(report.rig.dark_share, 0.0);
    assert_eq!(report, again);
    // Held where it was measured, light is off by what the body does until then: 0.5 m/s for more than 30 ms.
    assert!(report.rig.unpredicted_mm.p99 > 15.0);
    assert!(report.to_table().lines().all(|line| line.starts_with("99 of") || line.len() <= 112));
}

/// What spoils a rig spoils its rehearsal, and what is switched off cannot.
#[test]
fn every_error_shows_and_goes_where_it_is_switched_off() {
    let p99 = |set: &[&str]| rehearsed(&rig("budget.toml", &keys(set)), SHORT).rig.mm.p99;
    let quiet = [
        "rehearsal.corner_px=0.01",
        "rehearsal.late_us=0",
        "rehearsal.camera_px=0",
        "rehearsal.projector_px=0",
        "rehearsal.body_m=0",
    ];
    let with = |key: &str| p99(&[&quiet[..], &[key]].concat());
    let none = p99(&quiet);
    for key in [
        "rehearsal.corner_px=0.5",
        "rehearsal.late_us=5000",
        "rehearsal.camera_px=10",
        "rehearsal.projector_px=10",
        "rehearsal.body_m=0.003",
        "projector.latency_us=40000",
        "tracker.rate_hz=30",
        "rehearsal.delivery_us=60000",
    ] {
        let spoilt = with(key);
        assert!(spoilt > 1.5 * none, "{key}: {spoilt} mm, and {none} mm without");
    }
    // 10 px of the projector at the bodies are 3.4 mm somewhere on the raster, and so are 3 mm of a body.
    assert!(with("rehearsal.projector_px=10") < 10.0 && with("rehearsal.body_m=0.003") < 15.0);
}

/// Painted pictures and drawn corners say the same of the same run within the factor that the prediction is held to, by sharp
/// lenses and soft ones, and by exposures that blur and that do not.
#[test]
fn painted_pictures_agree_with_drawn_corners() {
    let extent = RehearsalExtent { seeds: 1, pictures: true, ..SHORT };
    for (exposure_us, softness_px) in [(2000, 0.5), (200, 0.5), (200, 0.0), (4000, 1.0)] {
        let set =
            [format!("tracker.exposure_us={exposure_us}"), format!("rehearsal.softness_px={softness_px:?}")];
        let report = rehearsed(&rig("budget.toml", &set), extent);
        let p = report.pictures.expect("a camera's rehearsal has pictures");
        let ratio = p.painted_mm.p99 / p.drawn_mm.p99;
        println!("{exposure_us} us, {softness_px} px: {ratio:.2}; {:?}, {:?}", p.painted_mm, p.drawn_mm);
        assert!((1.0 / 1.5..1.5).contains(&ratio), "{}", report.to_table());
        assert!(p.pictures > 300);
    }
}

/// Rigs with other trackers are rehearsed too: the mock by its own keys, NatNet by those of `[rehearsal]`.
#[test]
fn rigs_without_a_camera_are_rehearsed() {
    let demo = rehearsed(&rig("demo.toml", &keys(&["tracker.noise_m=0.0001"])), SHORT);
    let natnet = rehearsed(&rig("usb-natnet.toml", &keys(&["rehearsal.noise_m=0.0005"])), SHORT);
    assert!(demo.pictures.is_none() && demo.rig.mm.p99 > 0.1 && demo.rig.mm.p99 < 1.0, "{}", demo.to_table());
    assert!(natnet.rig.mm.p99 > demo.rig.mm.p99 && natnet.rig.motion_to_light_ms.p50 < 10.0);
}

/// What cannot be rehearsed says so.
#[test]
fn refusals_say_why() {
    let told = |file: &str, set: &[&str]| {
        rehearse(&rig(file, &keys(set)), SHORT, &mut |_| ()).expect_err("refused").to_string()
    };
    dpm_dlpc900_rig::register();
    assert!(told("dlpc900.toml", &[]).contains("loaded before their time"));
    assert!(told("budget.toml", &["tracker.tags=[]"]).contains("no body has tags"));
    let behind = told("budget.toml", &["tracker.transform.position=[0.0, 0.2, -3.0]"]);
    assert!(behind.contains("does not see the tags of \"hare\""), "{behind}");
}

/// A rig with parts as they are sold, drawn; `is_camera`: else a tracker that reports poses.
fn drawn(seed: u64, is_camera: bool) -> Vec<String> {
    let draws = Draws::new(seed).stream(77);
    let of = |i: u64, all: &[f64]| all[(draws.unit(i) * all.len() as f64) as usize];
    let between = |i: u64, low: f64, high: f64| low * (high / low).powf(draws.unit(i));
    let speed = between(0, 0.2, 1.0);
    // No body leaves the picture: a swing goes 0.12 m to each side at most.
    let least = (speed / 0.12).max(3.0);
    let mut set = vec![
        format!("rehearsal.motion={}", if draws.happens(1, 0.5) { "swing" } else { "hand" }),
        format!("rehearsal.speed_m_s={speed:?}"),
        // Swings of 0.5 to 2 times a second.
        format!("rehearsal.acceleration_m_s2={:?}", speed * between(2, least, 12.0)),
        format!("rehearsal.late_us={:?}", between(3, 50.0, 1500.0)),
        format!("rehearsal.projector_px={:?}", between(4, 0.1, 3.0)),
        format!("real_time.stage_costs_us.render={}", between(5, 500.0, 8000.0) as u32),
        format!("rehearsal.delivery_us={}", between(6, 2000.0, 12_000.0) as u32),
    ];
    if is_camera {
        set.push(format!("tracker.rate_hz={}", of(7, &[60.0, 90.0, 120.0])));
        set.push(format!("rehearsal.corner_px={:?}", between(8, 0.03, 0.3)));
        set.push(format!("tracker.exposure_us={}", between(9, 500.0, 4000.0) as u32));
        set.push(format!("rehearsal.camera_px={:?}", between(10, 0.1, 1.0)));
        set.push(format!("projector.latency_us={}", between(11, 1000.0, 12_000.0) as u32));
    } else {
        set.push(format!("rehearsal.noise_m={:?}", between(8, 5e-5, 5e-4)));
        set.push(format!("projector.frame_rate={}", of(9, &[240.0, 480.0, 947.0])));
    }
    set
}

/// The ratios of run and closed form, of drawn rigs.
fn ratios(seeds: std::ops::Range<u64>) -> Vec<f64> {
    let extent = RehearsalExtent { seeds: 5, seconds: 4.0, ..SHORT };
    let ratio = |seed: u64| {
        let is_camera = seed.is_multiple_of(2);
        let set = drawn(seed, is_camera);
        let config = rig(if is_camera { "budget.toml" } else { "usb-natnet.toml" }, &set);
        let row = rehearsed(&config, extent).rig;
        println!(
            "{seed}: run {:.2} mm, closed form {:.2} mm; {:?}, dark {:.3}; {}",
            row.mm.p99,
            row.predicted_p99_mm,
            row.mm,
            row.dark_share,
            set.join(" ")
        );
        row.mm.p99 / row.predicted_p99_mm
    };
    seeds.map(ratio).collect()
}

/// A part that is the same is no row.
#[test]
fn rows_that_change_nothing_are_left_out() {
    let camera = rig("budget.toml", &[]);
    let mock = rig("demo.toml", &[]);
    let idle = |config: &RigConfig| {
        let stage = RehearsalStage::new(config).unwrap_or_else(|e| panic!("{e}"));
        let own = RehearsalCase {
            config: config.clone(),
            rate_hz: 120,
            exposure_us: 2000,
            is_prompt: false,
            paints: false,
        };
        let rows = SUSPECTS.iter().chain(&PARTS);
        let idle = rows.filter(|(_, change)| is_idle(&stage, &own, *change)).map(|(name, _)| *name);
        idle.collect::<Vec<_>>()
    };
    assert_eq!(idle(&camera), [""; 0]);
    assert!(idle(&mock).contains(&"half the exposure") && idle(&mock).contains(&"noise of poses"));
}

/// The closed form agrees with the runs.
#[test]
fn the_closed_form_agrees_with_twenty_drawn_rigs() {
    let all = ratios(200..220);
    assert!(all.iter().all(|ratio| (1.0 / 1.5..1.5).contains(ratio)), "{all:?}");
}
