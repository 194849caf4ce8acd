//! Letters in, light and files out.

use super::*;
use dpm_calibration::file::{load, ProjectorSection, Provenance};
use dpm_calibration::model::ProjectorModel;
use dpm_device::planes::Raster;
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::results::{check_known, keep, Results};
use glam::{DQuat, DVec2};
use std::cell::RefCell;

fn camera() -> ProjectorCamera {
    let raster = Raster::new(1024, 768).unwrap();
    ProjectorCamera::look_at(raster, DVec3::Z, DVec3::ZERO, DVec3::Y, 0.6).unwrap()
}

/// A plate of 20 cm, in a body whose frame is turned.
fn stage(moved: NudgeTarget) -> (OutlineStage, TimedPose) {
    let [a, b] = [DVec3::new(-0.1, -0.1, 0.0), DVec3::new(0.1, -0.1, 0.0)];
    let [c, d] = [DVec3::new(0.1, 0.1, 0.0), DVec3::new(-0.1, 0.1, 0.0)];
    let rotation = DQuat::from_rotation_y(0.4);
    let pose = TimedPose { stamp_ns: 0, position: DVec3::new(0.01, 0.02, 0.0), rotation };
    let body = NudgeView {
        name: "plate".into(),
        mesh_to_body: DAffine3::from_quat(rotation.inverse()),
        outline: Outline::new(&[[a, b, c], [a, c, d]]),
    };
    (OutlineStage { moved, camera: camera(), bodies: vec![body] }, pose)
}

fn middle(stage: &OutlineStage, now: DAffine3, pose: TimedPose) -> DVec2 {
    let mut pixels = Vec::new();
    stage.draw(now, &[Some(pose)], &mut pixels);
    assert!(pixels.len() > 100);
    let (low, high) = pixels.iter().fold(([u32::MAX; 2], [0; 2]), |(low, high), p| {
        ([0, 1].map(|i| p[i].min(low[i])), [0, 1].map(|i| p[i].max(high[i])))
    });
    0.5 * (DVec2::new(f64::from(low[0]), f64::from(low[1]))
        + DVec2::new(f64::from(high[0]), f64::from(high[1])))
}

/// Types lines; returns what was saved, what was asked, and the end.
fn typed(nudges: &mut Nudges, lines: &[&str]) -> (Vec<DAffine3>, Vec<String>, Result<String, Failure>) {
    let (mut saved, asked) = (Vec::new(), RefCell::new(Vec::new()));
    let mut left = lines.iter();
    let ask = |text: &str| {
        asked.borrow_mut().push(text.to_owned());
        let over = || Failure::new(FailureKind::BadInput, "the input ended");
        left.next().map(|l| (*l).to_owned()).ok_or_else(over)
    };
    let end = converse(
        nudges,
        ask,
        |_| {},
        |m| {
            saved.push(*m);
            Ok("written".into())
        },
    );
    (saved, asked.into_inner(), end)
}

#[test]
fn letters_move_the_light_of_a_body_by_their_projection() {
    let (stage, pose) = stage(NudgeTarget::Body("plate".into()));
    let mut nudges = stage.nudges(2e-3);
    let before = middle(&stage, nudges.now(), pose);
    let (saved, asked, end) = typed(&mut nudges, &["xxxxx", "yyyyyw", "q"]);
    // 10 mm to the right and up at 1 m, up to the whole pixel.
    let expected = camera().fx * DVec2::new(0.01, -0.01);
    let after = middle(&stage, nudges.now(), pose);
    assert!((after - before - expected).length() < 1.5, "{before} {after} {expected}");
    assert!((saved[0].inverse() * nudges.now()).abs_diff_eq(DAffine3::IDENTITY, 1e-12) && saved.len() == 1);
    assert!(asked[1].contains("(10.00, 0.00, 0.00) mm"), "{asked:?}");
    assert!(asked[2].contains("written") && asked[2].contains("(10.00, 10.00, 0.00) mm"), "{asked:?}");
    assert_eq!(end.unwrap(), "what is shown was written");
}

#[test]
fn letters_move_the_projector_with_its_light() {
    let (stage, pose) = stage(NudgeTarget::Projector);
    let mut nudges = stage.nudges(2e-3);
    let before = middle(&stage, nudges.now(), pose);
    // A projector that is further to the right must light further to the left to hit the same body.
    typed(&mut nudges, &["xxxxx", "q"]).2.unwrap();
    let moved = middle(&stage, nudges.now(), pose) - before;
    assert!((moved - DVec2::new(-0.01 * camera().fx, 0.0)).length() < 1.5, "{moved}");
    // A turn to the left by 1 degree moves the same body to the right of the raster.
    let mut nudges = stage.nudges(2e-3);
    typed(&mut nudges, &["bbbbbbbbbb", "q"]).2.unwrap();
    let moved = middle(&stage, nudges.now(), pose) - before;
    assert!((moved.x - camera().fx * 1f64.to_radians().tan()).abs() < 2.0, "{moved}");
}

#[test]
fn what_is_not_written_is_said() {
    let (stage, _) = stage(NudgeTarget::Projector);
    let mut nudges = stage.nudges(1e-3);
    let (saved, asked, end) = typed(&mut nudges, &["x?", "xu", "u", "x", "q"]);
    assert!(saved.is_empty());
    assert!(asked[1].contains("'?'") && asked[1].contains("(0.00, 0.00, 0.00)"), "{asked:?}");
    assert!(asked[3].contains("nothing to take back"), "{asked:?}");
    assert_eq!(end.unwrap(), "nothing was written");
    let (_, _, end) = typed(&mut nudges, &["w", "z", "q"]);
    assert!(end.unwrap().contains("after the last w"));
    assert!(typed(&mut nudges, &[]).2.is_err());
}

#[test]
fn the_calibration_file_gets_the_place_and_the_old_one_is_kept() {
    let path = std::env::temp_dir().join(format!("dpm-nudge-{}.toml", std::process::id()));
    let config = RigConfig::demo(&Overrides { variables: vec![], flags: vec![] }).unwrap();
    let mut results = Results::open(Some(&path), std::path::Path::new("rig.toml"), &config).unwrap();
    assert!(check_known(&results, &NudgeTarget::Projector).is_err());
    let model = ProjectorModel::from_camera(&camera(), [-0.1, 0.0, 0.0, 0.0, 0.0], DVec3::ZERO);
    let section = ProjectorSection::new(camera().raster, &model, 0.2, 0.1, Provenance::default());
    results.file.projector = Some(section.clone());
    assert!(check_known(&results, &NudgeTarget::Projector).is_ok());
    results.save(&config).unwrap();
    let motion = DAffine3::from_rotation_translation(DQuat::from_rotation_x(0.3), DVec3::new(0.1, 0.2, 0.9));
    keep(&mut results, &config, &NudgeTarget::Projector, &motion);
    keep(&mut results, &config, &NudgeTarget::Body("plate".into()), &motion);
    let told = results.save(&config).unwrap();
    assert!(told.contains(".1.old"), "{told}");
    let file = load(&path).unwrap();
    let written = file.projector.unwrap();
    assert!(written.world_from_projector.to_affine().abs_diff_eq(motion, 1e-12));
    assert_eq!((written.lens, written.focal), (section.lens, section.focal));
    assert!(file.bodies["plate"].mesh_to_body.to_affine().abs_diff_eq(motion, 1e-12));
    let old = path.with_file_name(format!("{}.1.old", path.file_name().unwrap().to_string_lossy()));
    assert!(load(&old).unwrap().bodies.is_empty());
    std::fs::remove_file(path).unwrap();
    std::fs::remove_file(old).unwrap();
}
