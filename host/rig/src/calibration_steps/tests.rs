//! The steps of rigs that were measured in part, long ago, or with something else.

use super::*;
use crate::config::{Overrides, Purpose};
use crate::standing::utc;
use dpm_calibration_file::model::ProjectorModel;
use dpm_calibration_file::{
    BodySection, CheckSection, LatencySection, LightSection, Pose, ProjectorSection, Provenance, WandSection,
};
use dpm_device::planes::Raster;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DQuat, DVec3};
use std::time::{Duration, UNIX_EPOCH};

/// The projector of [`StepsFolder`], as it names itself.
const PROJECTOR: &str = "projector on /dev/ttyACM1";
/// Days from 1970 to the tests' now.
const TODAY: u64 = 21_000;

fn date(days_ago: u64) -> String {
    utc(UNIX_EPOCH + Duration::from_secs(86_400 * (TODAY - days_ago)))
}

fn from(device: &str, days_ago: u64) -> Provenance {
    Provenance { date: date(days_ago), device: device.into(), ..Provenance::default() }
}

/// A folder with a rig file whose bodies are "venus" and "the hare's", and perhaps its calibration file.
struct StepsFolder(PathBuf);

impl StepsFolder {
    fn new(name: &str, measured: Option<&CalibrationFile>) -> Self {
        let dir = std::env::temp_dir().join(format!("dpm-steps-{}-{name}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        std::fs::create_dir_all(&dir).unwrap();
        if let Some(measured) = measured {
            file::save(measured, &dir.join(USUAL_NAME)).unwrap();
        }
        Self(dir)
    }

    fn steps(&self, keys: &[&str], since: Option<SystemTime>) -> Steps {
        let text = "[projector]\nbackend = { kind = \"serial\", port = \"/dev/ttyACM1\" }\nframe_rate = 60\n\
                    [tracker]\nkind = \"natnet\"\nserver = \"10.1.2.3\"\n[real_time]\npace = \"real\"\n\
                    [[scene.bodies]]\nname = \"venus\"\n[[scene.bodies]]\nname = \"the hare's\"\n";
        let flags = keys.iter().map(|k| (*k).to_owned()).collect();
        let purpose = Purpose { at_rest: true, calibrates: true, ..Purpose::default() };
        let overrides = Overrides { variables: vec![], flags };
        let config = RigConfig::parse_for("rig.toml", text, &self.0, &overrides, purpose).unwrap();
        let now = UNIX_EPOCH + Duration::from_secs(86_400 * TODAY);
        Steps::of(&About {
            rig: &self.0.join("my rig.toml"),
            config: &config,
            file: None,
            now,
            running_since: since,
        })
    }
}

impl Drop for StepsFolder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Everything but a wand and checks, of an unknown date.
pub(crate) fn measured_file() -> CalibrationFile {
    let raster = Raster::new(1024, 768).unwrap();
    let camera =
        ProjectorCamera::look_at(raster, DVec3::new(0.1, 0.6, 1.5), DVec3::ZERO, DVec3::Y, 0.6).unwrap();
    let model = ProjectorModel::from_camera(&camera, [-0.1, 0.02, 0.0, 0.0, 0.0], DVec3::ZERO);
    let mut file = CalibrationFile::new();
    file.projector = Some(ProjectorSection::new(raster, &model, 0.2, 0.1, Provenance::default()));
    let motion =
        DAffine3::from_rotation_translation(DQuat::from_rotation_x(0.3), DVec3::new(0.01, 0.0, 0.02));
    let body = BodySection {
        mesh_to_body: Pose::new(&motion),
        residual_m: Some(1e-4),
        provenance: Provenance::default(),
    };
    file.bodies.insert("venus".into(), body);
    file.latency =
        Some(LatencySection { latency_us: 2500.0, sigma_us: 5.0, provenance: Provenance::default() });
    file.light = Some(LightSection {
        size: [1024, 768],
        weights: None,
        curves: vec![vec![0.0, 0.25, 1.0]; 3],
        intensity: vec![0.25, 0.5, 0.25],
        black: 0.01,
        ambient: 0.0,
        flat_field: [1.0, 0.0, 0.0, -0.2, 0.0, 0.0],
        uncertainty: 0.01,
        provenance: Provenance::default(),
    });
    file
}

/// Everything, measured so many days ago, with checks that found no error.
fn whole(days_ago: u64) -> CalibrationFile {
    let mut file = measured_file();
    file.wand =
        Some(WandSection { tip: [0.0, 0.0, 0.1], tip_sigma_m: 1e-4, provenance: from("pen", days_ago) });
    let venus = file.bodies["venus"].clone();
    file.bodies.insert("the hare's".into(), venus);
    for (name, body) in &mut file.bodies {
        body.provenance = from(name, days_ago);
        let provenance = from(PROJECTOR, days_ago);
        let check = CheckSection { points: 6, p50_px: 0.4, largest_px: 0.9, limit_px: 2.0, provenance };
        file.checks.insert(name.clone(), check);
    }
    file.projector.as_mut().unwrap().provenance = from(PROJECTOR, days_ago);
    file.latency.as_mut().unwrap().provenance = from(PROJECTOR, days_ago);
    file.light.as_mut().unwrap().provenance = from(PROJECTOR, days_ago);
    file
}

fn step<'a>(steps: &'a Steps, id: &str) -> &'a CalibrationStep {
    steps.steps.iter().find(|s| s.id == id).unwrap_or_else(|| panic!("no {id}: {steps:?}"))
}

fn next(steps: &Steps) -> Option<&str> {
    steps.next.map(|i| steps.steps[i].id.as_str())
}

#[test]
fn a_new_rig_begins_with_the_first_step_and_its_commands_name_it() {
    let bench = StepsFolder::new("new", None);
    let steps = bench.steps(&[], None);
    let ids: Vec<&str> = steps.steps.iter().map(|s| s.id.as_str()).collect();
    let order = "pattern wand projector body:venus body:the hare's light check:venus check:the hare's nudge export latency";
    assert_eq!(ids.join(" "), order);
    assert_eq!(next(&steps), Some("pattern"));
    assert_eq!((&steps.none, &steps.fault, &steps.unnamed), (&None, &None, &None));
    for (id, state) in [
        ("wand", StepStatus::Missing),
        ("projector", StepStatus::Waits),
        ("body:venus", StepStatus::Waits),
        ("light", StepStatus::Optional),
        ("check:venus", StepStatus::Waits),
        ("latency", StepStatus::Waits),
    ] {
        assert_eq!(step(&steps, id).state, state, "{id}");
    }
    let rig = bench.0.join("my rig.toml").display().to_string();
    let line = |id: &str, way: usize| step(&steps, id).ways[way].line.clone();
    assert_eq!(line("wand", 0), format!("dpm calibrate wand '{rig}'"));
    assert_eq!(line("projector", 0), format!("dpm calibrate projector '{rig}' --sensor SENSOR"));
    assert_eq!(line("body:the hare's", 0), format!("dpm calibrate body '{rig}' --body 'the hare'\\''s'"));
    assert_eq!(step(&steps, "body:the hare's").ways[0].words.last().unwrap(), "the hare's");
    assert!(step(&steps, "wand").needs[0].contains("NatNet at 10.1.2.3"), "{:?}", step(&steps, "wand"));
}

#[test]
fn a_measured_rig_has_no_next_step_and_tells_what_each_part_is_worth() {
    let bench = StepsFolder::new("whole", Some(&whole(3)));
    let steps = bench.steps(&[], None);
    assert_eq!(next(&steps), None, "{steps:?}");
    let projector = step(&steps, "projector").measured.as_ref().unwrap();
    assert_eq!((projector.date.as_str(), projector.age.as_str()), (date(3).as_str(), "3 days old"));
    assert!(projector.quality.contains("0.20 px") && projector.device == PROJECTOR, "{projector:?}");
    for (id, word) in
        [("wand", "0.10 mm"), ("body:venus", "0.10 mm"), ("latency", "2.500 ms"), ("light", "1.00 %")]
    {
        let step = step(&steps, id);
        assert!(
            step.state == StepStatus::Done && step.measured.as_ref().unwrap().quality.contains(word),
            "{step:?}"
        );
    }
    // The name of the wand is known from its measurement.
    assert!(step(&steps, "check:venus").ways[0].line.ends_with("--body venus --wand pen"));
    let lines = steps.unnamed.as_ref().unwrap();
    assert!(lines.contains("[calibration]") && lines.contains(USUAL_NAME), "{lines}");
    let named = format!("calibration.file={:?}", bench.0.join(USUAL_NAME).display().to_string());
    assert_eq!(bench.steps(&[&named], None).unnamed, None);
}

/// Found in use, O3: ten degrees by eye counted as measured today with a residual of 0.00 mm.
#[test]
fn what_was_moved_by_eye_is_never_shown_as_measured() {
    let mut file = whole(40);
    let by_eye = Provenance { method: Provenance::BY_EYE.into(), ..from("venus", 0) };
    // A file of an earlier program has a residual that nobody measured.
    for residual_m in [None, Some(0.0), Some(1e-4)] {
        let body = file.bodies.get_mut("venus").unwrap();
        (body.residual_m, body.provenance) = (residual_m, by_eye.clone());
        let steps = StepsFolder::new("by-eye", Some(&file)).steps(&[], None);
        let venus = step(&steps, "body:venus");
        assert_eq!((venus.state, venus.measured.as_ref()), (StepStatus::Given, None), "{venus:?}");
        assert!(venus.told.contains("by eye") && !venus.told.contains("0.00"), "{venus:?}");
        assert_eq!(step(&steps, "nudge").measured, None);
        // The check is older than the motion.
        assert_eq!(step(&steps, "check:venus").state, StepStatus::Missing);
    }
    let projector = file.projector.as_mut().unwrap();
    projector.provenance = Provenance { device: PROJECTOR.into(), ..by_eye };
    let steps = StepsFolder::new("by-eye", Some(&file)).steps(&[], None);
    let projector = step(&steps, "projector");
    assert_eq!((projector.state, projector.measured.as_ref()), (StepStatus::Given, None), "{projector:?}");
}

#[test]
fn what_is_old_is_checked_before_it_is_measured_again() {
    let mut file = whole(40);
    let steps = StepsFolder::new("old", Some(&file)).steps(&[], None);
    for id in ["projector", "body:venus", "check:venus", "latency"] {
        assert_eq!(step(&steps, id).state, StepStatus::Old, "{id}");
    }
    assert_eq!(next(&steps), Some("check:venus"));
    // A check of a body confirms the projector and that body.
    file.checks.get_mut("venus").unwrap().provenance.date = date(1);
    let steps = StepsFolder::new("checked", Some(&file)).steps(&[], None);
    for (id, state) in [
        ("projector", StepStatus::Done),
        ("body:venus", StepStatus::Done),
        ("body:the hare's", StepStatus::Old),
        ("light", StepStatus::Old),
    ] {
        assert_eq!(step(&steps, id).state, state, "{id}");
    }
    assert!(step(&steps, "projector").told.contains("confirmed"));
    assert_eq!(next(&steps), Some("check:the hare's"));
    file.checks.get_mut("the hare's").unwrap().provenance.date = date(1);
    let steps = StepsFolder::new("confirmed", Some(&file)).steps(&[], None);
    assert_eq!(step(&steps, "body:the hare's").state, StepStatus::Done);
}

#[test]
fn what_cannot_hold_is_measured_again() {
    let file = whole(3);
    let bench = StepsFolder::new("other", Some(&file));
    let steps = bench.steps(&["projector.height=640"], None);
    let projector = step(&steps, "projector");
    assert!(projector.state == StepStatus::Wrong && projector.told.contains("1024 x 640"), "{projector:?}");
    assert_eq!(next(&steps), Some("projector"));
    // The same shape with other pixels will do.
    let steps = bench.steps(&["projector.width=512", "projector.height=384"], None);
    assert_eq!(step(&steps, "projector").state, StepStatus::Done);
    let steps = bench.steps(&["projector.backend.port=\"/dev/ttyACM7\""], None);
    let projector = step(&steps, "projector");
    assert!(projector.state == StepStatus::Doubtful && projector.told.contains("ttyACM7"), "{projector:?}");
    assert_eq!(next(&steps), Some("projector"));
    // A check that found too much, and one that is older than what it checked.
    let mut failed = file.clone();
    failed.checks.get_mut("venus").unwrap().largest_px = 2.5;
    let steps = StepsFolder::new("failed", Some(&failed)).steps(&[], None);
    assert_eq!((step(&steps, "check:venus").state, next(&steps)), (StepStatus::Wrong, Some("check:venus")));
    let mut again = file;
    again.bodies.get_mut("venus").unwrap().provenance.date = date(1);
    let steps = StepsFolder::new("again", Some(&again)).steps(&[], None);
    assert_eq!((step(&steps, "check:venus").state, next(&steps)), (StepStatus::Missing, Some("check:venus")));
    assert_eq!(step(&steps, "check:the hare's").state, StepStatus::Done);
}

#[test]
fn the_rig_file_may_give_what_would_be_measured() {
    let bench = StepsFolder::new("given", None);
    let steps = bench.steps(
        &[
            "scene.bodies.0.mesh_to_body.position=[0, 0, 0.1]",
            "projector.response.kind=\"gamma\"",
            "tracker.latency_us=20",
        ],
        None,
    );
    for id in ["body:venus", "light", "latency"] {
        assert_eq!(step(&steps, id).state, StepStatus::Given, "{id}");
    }
    assert_eq!(step(&steps, "body:the hare's").state, StepStatus::Waits);
    assert_eq!(next(&steps), Some("wand"));
}

#[test]
fn what_a_run_does_not_know_and_bodies_without_a_use_are_told() {
    let mut file = whole(3);
    let body = file.bodies["venus"].clone();
    file.bodies.insert("gone".into(), body);
    let bench = StepsFolder::new("notes", Some(&file));
    let begin = |days_ago: u64| Some(UNIX_EPOCH + Duration::from_secs(86_400 * (TODAY - days_ago)));
    let notes = bench.steps(&[], begin(1)).notes;
    assert!(notes.len() == 1 && notes[0].contains("\"gone\""), "{notes:?}");
    let notes = bench.steps(&[], begin(4)).notes;
    assert!(notes.len() == 2 && notes[1].contains("Start the rig again"), "{notes:?}");
}

#[test]
fn a_rig_with_a_mock_has_no_steps_and_a_broken_file_is_named() {
    let bench = StepsFolder::new("none", None);
    let steps = bench.steps(&["projector.backend={kind=\"mock\"}"], None);
    assert!(steps.steps.is_empty() && steps.next.is_none() && steps.none.unwrap().contains("mock"));
    std::fs::write(bench.0.join(USUAL_NAME), "version = 9").unwrap();
    let steps = bench.steps(&[], None);
    assert!(steps.fault.as_ref().unwrap().contains("version"), "{steps:?}");
    assert_eq!(next(&steps), Some("pattern"));
}
