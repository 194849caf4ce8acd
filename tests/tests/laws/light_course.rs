//! The course of the light of every kind of projector.

use dpm_device::planes::Channel;
use dpm_rig::config::{Overrides, ProjectorConfig, RigConfig};
use dpm_rig::plan::light_course::{Flash, LightCourse};

fn projector(keys: &[&str]) -> ProjectorConfig {
    dpm::satellites::register();
    let flags = keys.iter().chain(&["real_time.pace=real"]).map(|key| (*key).to_owned()).collect();
    let overrides = Overrides { variables: vec![], flags };
    RigConfig::demo(&overrides).unwrap_or_else(|e| panic!("{keys:?}: {e}")).projector
}

/// Mean light of each channel over a period.
fn mean(course: &LightCourse) -> [f64; 3] {
    let of =
        |c: usize| course.flashes.iter().map(|f| f.light[c] * (f.span_ns[1] - f.span_ns[0])).sum::<f64>();
    [0, 1, 2].map(|c| of(c) / course.period_ns)
}

const CONTROLLER: [&str; 6] = [
    "projector.width=1920",
    "projector.height=1080",
    "projector.frame_rate=60",
    "projector.backend.kind=display",
    "projector.backend.dlpc900.panel=dlp6500",
    "projector.backend.encoding=rgb4x2",
];

/// Whatever a frame is made of, its mean light is that of the code value: as a share of full white, or of the light of
/// all planes where these do not reach it.
#[test]
fn the_mean_light_is_the_code_value() {
    let equal = ["projector.weights=equal"];
    let split = ["projector.weights=split"];
    let alp = [
        "projector.frame_rate=80",
        "projector.planes=8",
        "projector.backend.kind=alp",
        "projector.backend.plane_times=binary",
    ];
    let loaded =
        [&CONTROLLER[..3], &["projector.backend.kind=dlpc900", "projector.backend.panel=dlp6500"]].concat();
    let window = ["projector.frame_rate=60", "projector.backend.kind=window"];
    for keys in [&[][..], &equal, &split, &alp, &loaded, &window, &CONTROLLER] {
        let projector = projector(keys);
        let is_white = projector.schedule().planes().iter().all(|p| p.channel == Channel::White);
        let full = f64::from(projector.full_light()) / 255.0;
        for code in [[255, 255, 255], [200, 128, 33], [1, 77, 254]] {
            let course = LightCourse::of(&projector, code).unwrap();
            for (c, mean) in mean(&course).into_iter().enumerate() {
                let wanted = f64::from(code[if is_white { 1 } else { c }]) / 255.0 * full;
                assert!((mean - wanted).abs() < 2e-3, "{keys:?}, {code:?}, channel {c}: {mean} of {wanted}");
            }
            let within = |f: &Flash| f.span_ns[0] >= 0.0 && f.span_ns[1] <= course.period_ns + 1.0;
            assert!(course.flashes.iter().all(within), "{keys:?}");
        }
    }
}

/// The planes of a default frame share it equally, and the highest bit of white is half of its light.
#[test]
fn planes_share_the_frame_and_halve_their_light() {
    let course = LightCourse::of(&projector(&[]), [255; 3]).unwrap();
    let frame_ns = 1e9 / 947.0;
    assert_eq!(course.flashes.len(), 24);
    for (k, flash) in course.flashes.iter().enumerate() {
        assert!((flash.span_ns[0] - k as f64 * frame_ns / 24.0).abs() < 1.0, "{k}");
        assert!((flash.span_ns[1] - flash.span_ns[0] - frame_ns / 24.0).abs() < 1.0, "{k}");
        let bit = [4, 6, 7, 5, 3, 2, 1, 0][k / 3];
        let brightness = 24.0 * f64::from(1 << bit) / 255.0;
        assert!((flash.light[k % 3] - brightness).abs() < 1e-6 * brightness, "{k}: {:?}", flash.light);
    }
}

/// Behind a controller the gaps are where its table has them.
#[test]
fn patterns_are_lit_as_the_table_of_the_controller_says() {
    let projector = projector(&CONTROLLER);
    let course = LightCourse::of(&projector, [255; 3]).unwrap();
    // Six patterns of 2480 us; what is left but for 250 us is dark after each of them.
    let pitch_ns = ((16_666 - 250) / 6 * 1000) as f64;
    for flash in &course.flashes {
        let pattern = (flash.span_ns[0] / pitch_ns).round();
        let [begin, end] = flash.span_ns.map(|ns| ns - pattern * pitch_ns);
        let (begin, end) = match pattern >= 6.0 {
            true => (begin - 16_666_666.0 + 6.0 * pitch_ns, end - 16_666_666.0 + 6.0 * pitch_ns),
            false => (begin, end),
        };
        assert!(begin.abs() < 2.0 && (end - 2_480_000.0).abs() < 2.0, "{pattern}: {begin} to {end}");
    }
}
