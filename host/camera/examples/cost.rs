//! Milliseconds that a picture of the mock camera costs the detectors, by its content: `cargo run --release -p dpm-camera
//! --example cost [FOLDER]`. With a folder the pictures are written there, as PGM.

use dpm_camera::{GreyImage, SpotDetector, TagDetector};
use dpm_device::pose::Pose;
use dpm_mock::camera::{BrightMarker, MarkedBody, MockCamera, MockCameraConfig, PrintedTag};
use dpm_mock::motion::{Motion, MotionSpec};
use std::time::Instant;

const PICTURES: u64 = 30;

fn body(tags: bool, speed: f64) -> MarkedBody {
    let rest = Pose { position_m: [0.02, -0.03, -1.0], rotation_xyzw: [0.1, 0.24, 0.05, 0.964_157] };
    let norm = rest.rotation_xyzw.iter().map(|c| c * c).sum::<f64>().sqrt();
    let rest = Pose { rotation_xyzw: rest.rotation_xyzw.map(|c| c / norm), ..rest };
    let moving = MotionSpec::Sinusoid {
        direction: [1.0, 0.3, 0.0],
        peak_speed_m_s: speed,
        peak_acceleration_m_s2: 5.0,
    };
    let motion = if speed > 0.0 { Motion::new(&moving, rest) } else { Motion::still(rest) };
    let tag =
        |id, x| PrintedTag { id, side_m: 0.08, place: Pose { position_m: [x, 0.0, 0.0], ..Pose::IDENTITY } };
    let markers =
        [[0.0, 0.0, 0.0], [0.1, 0.0, 0.02], [0.0, 0.08, 0.0], [-0.07, -0.05, 0.03], [0.05, -0.06, -0.03]];
    MarkedBody {
        motion: motion.expect("a motion"),
        tags: if tags { vec![tag(17, 0.06), tag(401, -0.06)] } else { vec![] },
        markers: if tags {
            vec![]
        } else {
            markers.map(|middle_m| BrightMarker { middle_m, radius_m: 0.006 }).to_vec()
        },
    }
}

fn main() {
    let folder = std::env::args().nth(1);
    let plain = MockCameraConfig::default();
    let rows = [
        ("tags", MockCameraConfig { clutter: 40, ..plain.clone() }, true, 0.0),
        (
            "tags at 1 m/s, 5 ms of exposure",
            MockCameraConfig { exposure_ns: 5_000_000, ..plain.clone() },
            true,
            1.0,
        ),
        ("tags among 400 shapes", MockCameraConfig { clutter: 400, ..plain.clone() }, true, 0.0),
        ("noise of 12 grey levels", MockCameraConfig { read_noise: 12.0, ..plain.clone() }, true, 0.0),
        ("markers", MockCameraConfig { white: 40.0, ..plain }, false, 0.0),
    ];
    for (name, config, tags, speed) in rows {
        let mut mock = MockCamera::new(config, vec![body(tags, speed)]).expect("a camera");
        let (mut pixels, mut sightings, mut spots) = (Vec::new(), Vec::new(), Vec::new());
        let (mut tag_detector, mut spot_detector) = (TagDetector::new(), SpotDetector::default());
        let (mut painted, mut detected, mut found) = (0.0, Vec::new(), 0);
        for number in 0..PICTURES {
            let exposure = mock.exposure(number).expect("no fault");
            let begin = Instant::now();
            mock.paint(&exposure, &mut pixels);
            painted += begin.elapsed().as_secs_f64();
            let image = GreyImage::new(1280, 800, &pixels).expect("a picture");
            let begin = Instant::now();
            if tags {
                tag_detector.detect(&image, None, &mut sightings);
            } else {
                spot_detector.detect(&image, 100, &mut spots);
            }
            detected.push(1e3 * begin.elapsed().as_secs_f64());
            found += sightings.len() + spots.len();
        }
        detected.sort_by(f64::total_cmp);
        let (median, worst) = (detected[detected.len() / 2], detected[detected.len() - 1]);
        let painted = 1e3 * painted / PICTURES as f64;
        println!("{name}: {median:.2} ms, {worst:.2} at most ({found} found; painted in {painted:.1} ms)");
        if let Some(folder) = &folder {
            let path = format!("{folder}/{}.pgm", name.replace([' ', '/'], "-"));
            std::fs::write(path, [b"P5 1280 800 255\n", &pixels[..]].concat()).expect("written");
        }
    }
}
