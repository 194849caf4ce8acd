use super::*;
use crate::config::{Overrides, RigConfig};
use crate::parameters::applied::{middles, ParameterVersion};
use crate::parameters::desk::Setting;
use crate::rig::Rig;
use dpm_device::planes::Raster;
use dpm_handoff::latest::Reader;
use glam::DVec3;
use std::sync::Mutex;
use std::time::Instant;

fn rig(flags: &[&str]) -> Arc<Rig> {
    let flags = flags.iter().map(|f| (*f).to_owned()).collect();
    let config = RigConfig::demo(&Overrides { flags, variables: vec![] }).unwrap();
    Arc::new(Rig::build(&config, Raster::new(8, 8)).unwrap())
}

/// A run that draws `rig`, with the reader of its planning.
fn run(rig: &Arc<Rig>) -> (Arc<RunMonitor>, Reader<ParameterVersion>) {
    let monitor = Arc::new(RunMonitor::default());
    let reader = monitor.parameters().follow(rig);
    (monitor, reader)
}

fn set(monitor: &Arc<RunMonitor>, text: &str) -> Result<ChangeResult, ChangeRefusal> {
    give(monitor, &ParameterCommand::parse_change(text)?, "test")
}

#[test]
fn a_change_reaches_planning_whole_and_is_taken_back_whole() {
    let rig = rig(&[]);
    let (monitor, mut reader) = run(&rig);
    let before = reader.latest().0.clone();
    set(&monitor, "exposure=2").unwrap();
    set(&monitor, "samples=4").unwrap();
    set(&monitor, "budget=2.5").unwrap();
    set(&monitor, "gaze=0,0.1,0.2").unwrap();
    set(&monitor, "projector=1,0,0,0,0,2").unwrap();
    set(&monitor, &format!("body.{}=0,3,0,0,90,0", rig.bodies[0].name)).unwrap_err();
    set(&monitor, &format!("body.{}=0,3,0,0,30,0", rig.bodies[0].name)).unwrap();
    let now = reader.latest().0.clone();
    assert_eq!((now.version, now.brighter, now.samples, now.most_milli), (6, 2.0, 4, 2500));
    assert_eq!(now.gaze, Some(DVec3::new(0.0, 0.1, 0.2)));
    // The projector turns about its lens, and the body about its middle.
    assert!((now.camera.position().distance(rig.camera.position()) - 1e-3).abs() < 1e-12);
    let middle = middles(&rig)[0];
    let moved = now.mesh_to_body[0].transform_point3(middle) - middle;
    assert!((moved - DVec3::new(0.0, 3e-3, 0.0)).length() < 1e-12, "{moved}");
    assert_eq!(now.mesh_to_body[1], before.mesh_to_body[1]);
    for left in (0..6).rev() {
        give(&monitor, &ParameterCommand::Undo, "test").unwrap();
        assert_eq!(monitor.parameters().shown().unwrap().can_undo, left > 0);
    }
    let after = reader.latest().0.clone();
    assert_eq!(ParameterVersion { version: before.version, ..after }, before);
    assert_eq!(give(&monitor, &ParameterCommand::Undo, "test").unwrap_err(), ChangeRefusal::NothingToUndo);
}

#[test]
fn a_drawn_slider_is_one_step_and_two_parameters_are_two() {
    let rig = rig(&[]);
    let (monitor, mut reader) = run(&rig);
    for k in 1..50 {
        set(&monitor, &format!("exposure={}", 1.0 + f64::from(k))).unwrap();
    }
    set(&monitor, "budget=1").unwrap();
    give(&monitor, &ParameterCommand::Undo, "test").unwrap();
    assert_eq!(reader.latest().0.brighter, 50.0);
    give(&monitor, &ParameterCommand::Undo, "test").unwrap();
    assert_eq!((reader.latest().0.brighter, reader.latest().0.version), (1.0, 52));
    assert!(!monitor.parameters().shown().unwrap().can_undo);
    // Each step was told once.
    assert_eq!(monitor.take_notes().len(), 4);
}

#[test]
fn what_is_out_of_range_or_unknown_is_refused_and_changes_nothing() {
    let rig = rig(&[]);
    let (monitor, mut reader) = run(&rig);
    for (text, word) in [
        ("exposure=0", "must be 0.000001 to 1000000"),
        ("exposure=NaN", "NaN is not allowed"),
        ("exposure=inf", "not allowed"),
        ("exposure=-1", "not allowed"),
        ("exposure=1,2", "takes one number, not 2"),
        ("exposure=", "takes one number, not 0"),
        ("samples=0", "must be 1 to"),
        ("samples=1.5", "not a whole number"),
        ("samples=1e9", "must be 1 to"),
        ("budget=0", "0.125"),
        ("gaze=1,2", "takes three numbers or none"),
        ("gaze=1,2,1e9", "gaze z"),
        ("projector=1,2,3", "takes six"),
        ("projector=0,0,501,0,0,0", "projector z: 501"),
        ("projector=0,0,0,0,0,nan", "about z"),
        ("body.nobody=0,0,0,0,0,0", "there are: exposure"),
        ("depth=3", "no parameter is named"),
        ("=1", "no parameter is named"),
    ] {
        let told = set(&monitor, text).unwrap_err().to_string();
        assert!(told.contains(word), "{text}: {told}");
    }
    assert_eq!((reader.latest().0.version, reader.latest().1), (0, false));
    let longest = "x".repeat(500);
    assert!(set(&monitor, &format!("{longest}=1")).unwrap_err().to_string().len() < 300);
}

#[test]
fn a_parameter_without_an_effect_is_refused_with_the_reason() {
    for (method, name, word) in [
        ("full", "budget=1", "only methods dpm"),
        ("paper", "samples=3", "zone_spp"),
        ("paper", "budget=1", "only methods dpm"),
    ] {
        let rig = rig(&[&format!("render.method={method}")]);
        let (monitor, _reader) = run(&rig);
        let told = set(&monitor, name).unwrap_err().to_string();
        assert!(told.contains(word), "{told}");
        let shown = monitor.parameters().shown().unwrap();
        assert!(!shown.all.iter().any(|p| name.starts_with(p.name.as_str())), "{shown:?}");
    }
    let monitor = Arc::new(RunMonitor::default());
    assert_eq!(set(&monitor, "exposure=1").unwrap_err(), ChangeRefusal::NoRun);
    monitor.parameters().close();
    let _reader = monitor.parameters().follow(&rig(&[]));
    assert_eq!(set(&monitor, "exposure=2").unwrap_err(), ChangeRefusal::NoRun, "a pattern");
}

#[test]
fn an_answer_waits_for_the_frame_that_uses_the_change() {
    let rig = rig(&[]);
    let (monitor, _reader) = run(&rig);
    let sent = set(&monitor, "exposure=2").unwrap();
    let answer = |ms| sent.answer(Duration::from_millis(ms), monitor.parameters());
    assert_eq!(answer(499), None);
    let late = answer(500).unwrap();
    assert!(!late.is_done && late.text.starts_with("not yet: exposure is 2"), "{late:?}");
    monitor.parameters().uses(1, 4711);
    let done = answer(3).unwrap();
    assert_eq!((done.is_done, done.text.as_str()), (true, "ok: exposure is 2, from frame 4711 on"));
}

#[test]
fn a_new_planning_stage_goes_on_with_what_was_changed() {
    let rig = rig(&[]);
    let (monitor, mut old) = run(&rig);
    set(&monitor, "exposure=3").unwrap();
    let mut new = monitor.parameters().follow(&rig);
    assert_eq!((new.latest().0.version, new.latest().0.brighter), (1, 3.0));
    set(&monitor, "exposure=4").unwrap();
    give(&monitor, &ParameterCommand::Undo, "test").unwrap();
    set(&monitor, "gaze=0,0,0").unwrap();
    assert_eq!(new.latest().0.gaze, Some(DVec3::ZERO));
    assert_eq!(old.latest().0.gaze, None, "an abandoned stage hears nothing more");
}

/// Waits for files to be written.
fn saved(monitor: &Arc<RunMonitor>) -> String {
    let begin = Instant::now();
    let sent = give(monitor, &ParameterCommand::Save, "test").unwrap();
    loop {
        if let Some(answer) = sent.answer(Duration::ZERO, monitor.parameters()) {
            return answer.text;
        }
        assert!(begin.elapsed() < Duration::from_secs(20));
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn only_what_the_files_do_not_say_is_saved_and_a_value_taken_back_is_saved_again() {
    let rig = rig(&["observer.gaze={kind=\"tracked\",target=\"venus\"}"]);
    let (monitor, _reader) = run(&rig);
    assert!(
        matches!(give(&monitor, &ParameterCommand::Save, "test"), Err(ChangeRefusal::NotSaved(_))),
        "no file"
    );
    let all: Arc<Mutex<Vec<ToKeep>>> = Arc::default();
    let written = all.clone();
    monitor.parameters().set_saver(Box::new(move |_, kept| {
        if kept.keys.iter().any(|(_, v)| *v == Setting::Number(13.0)) {
            return Err("disk full".into());
        }
        written.lock().unwrap().push(kept.clone());
        Ok("written".into())
    }));
    assert!(saved(&monitor).contains("nothing has changed"));
    set(&monitor, "exposure=13").unwrap();
    assert_eq!(saved(&monitor), "NOT saved: disk full");
    assert!(monitor.parameters().shown().unwrap().is_unsaved);
    set(&monitor, "exposure=2").unwrap();
    set(&monitor, "gaze=0,0,1").unwrap();
    set(&monitor, "projector=1,0,0,0,0,0").unwrap();
    assert_eq!(saved(&monitor), "ok: written");
    assert!(!monitor.parameters().shown().unwrap().is_unsaved);
    for _ in 0..2 {
        give(&monitor, &ParameterCommand::Undo, "test").unwrap();
    }
    assert_eq!(saved(&monitor), "ok: written");
    let all = all.lock().unwrap();
    let point = Setting::Table(vec![
        ("kind", Setting::Text("point".into())),
        ("point", Setting::Point([0.0, 0.0, 1.0])),
    ]);
    assert_eq!(all[0].keys, [(["render", "exposure"], Setting::Number(2.0)), (["observer", "gaze"], point)]);
    assert!(all[0].projector.is_some());
    // The gaze of the rig file comes back, and the projector to where it was.
    let tracked = Setting::Table(vec![
        ("kind", Setting::Text("tracked".into())),
        ("target", Setting::Text("venus".into())),
    ]);
    assert_eq!(all[1].keys, [(["observer", "gaze"], tracked)]);
    assert_eq!(all[1].projector, Some(rig.camera.world_from_projector));
}
