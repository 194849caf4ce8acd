//! No tag is taken for another, and nothing for a tag.

use crate::stage::{body, camera, facing, optics, picture, two_tags};
use dpm_camera::{GreyImage, TagDetector};
use dpm_device::rng::Draws;
use dpm_mock::camera::MockCameraConfig;
use dpm_mock::motion::MotionSpec;

/// What was found in `pictures` drawn pictures of clutter, with two tags in every third of them: the tags that were there and were
/// found, those that were there, and those that were not there and were found.
fn identities(pictures: u64, seed: u64) -> [u64; 3] {
    let markings = two_tags();
    let cam = camera(&optics());
    let mut detector = TagDetector::new();
    let (mut found, mut there, mut wrong) = (0, 0, 0);
    let mut tags = Vec::new();
    for k in 0..pictures {
        let draws = Draws::new(seed).stream(k);
        let truth = facing(draws, 0.6 + 1.5 * draws.unit(60), 0.9);
        let moving = MotionSpec::Sinusoid {
            direction: [1.0, 0.5, 0.2],
            peak_speed_m_s: 0.1 + draws.unit(61),
            peak_acceleration_m_s2: 5.0,
        };
        let shown = k % 3 == 0;
        let bodies = if shown { vec![body(&markings, &truth, &moving)] } else { vec![] };
        let config = MockCameraConfig {
            optics: optics(),
            clutter: 20 + (draws.bits(62) % 200) as u32,
            read_noise: 30.0 * draws.unit(63).powi(3),
            white: 60.0 + 190.0 * draws.unit(64),
            exposure_ns: 500_000 + (8e6 * draws.unit(65)) as i64,
            row_ns: (15_000.0 * draws.unit(66)) as i64,
            samples: 3,
            seed: draws.bits(67),
            ..MockCameraConfig::default()
        };
        let (pixels, _) = picture(&config, bodies, draws.bits(68) % 100);
        detector.detect(&GreyImage::new(1280, 800, &pixels).unwrap(), Some(&cam), &mut tags);
        there += if shown { 2 } else { 0 };
        for tag in &tags {
            let own = shown && markings.tags.iter().any(|t| t.id == tag.id);
            found += u64::from(own);
            wrong += u64::from(!own);
            if !own {
                println!("picture {k}: {tag:?}");
            }
        }
    }
    [found, there, wrong]
}

#[test]
fn clutter_and_noise_are_no_tags() {
    let [found, there, wrong] = identities(12, 1);
    println!("{found} of {there} found, {wrong} wrong");
    assert!(wrong == 0 && found > 0, "{found} of {there}");
}

/// Pictures of nothing but noise, from faint to all there is.
#[test]
fn noise_is_no_tag() {
    let mut detector = TagDetector::new();
    let mut tags = Vec::new();
    for k in 0..30u64 {
        let draws = Draws::new(k);
        let reach = 4 + 8 * k;
        let pixels: Vec<u8> = (0..1280 * 800).map(|i| (draws.bits(i) % reach.min(256)) as u8).collect();
        detector.detect(&GreyImage::new(1280, 800, &pixels).unwrap(), None, &mut tags);
        assert!(tags.is_empty(), "{tags:?}");
    }
}

mod breadth {
    /// Half of the tags are found, under blur of up to 17 pixels, and none is another.
    #[test]
    fn no_wrong_identity_in_hundreds_of_pictures() {
        let [found, there, wrong] = super::identities(600, 77);
        println!("{found} of {there} found, {wrong} wrong");
        assert!(wrong == 0 && 2 * found >= there, "{found} of {there}, {wrong} wrong");
    }
}
