//! Contradictions between keys. Each is reported at a key that was written, with what would resolve it.

use super::check_projector::projector;
use super::world::EnvironmentConfig;
use super::{LiveSource, Pace, PictureSource, Purpose, ResponseConfig, RigConfig, Wearable, WearableConfig};
use crate::gaze::GazeAim;
use crate::trackers::PoseOrigin;
use dpm_common::keys::read::KeyReader;
pub(super) use dpm_common::keys::read::{contradict, refuse, shown};
use dpm_common::keys::rows::OfKind;
use dpm_device::regular_file;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// The maximum number of tracked bodies. It is the number of poses in a snapshot of the tracks, and the number of
/// bodies that the renderer can distinguish.
pub(crate) const MAX_TRACKED: usize = 256;

/// The maximum number of heads that are guarded: each costs every frame a look at all mirrors.
const MAX_HEADS: usize = 16;

pub(super) fn check(rig: &RigConfig, purpose: Purpose, reader: &mut KeyReader) {
    projector(rig, reader);
    bodies(rig, reader);
    render(rig, reader);
    time(rig, purpose, reader);
    rig.tracker.check(reader);
    transforms(rig, reader);
    super::safety::check(rig, reader);
    super::page::check(rig, reader);
    super::osc::check(rig, reader);
}

fn transforms(rig: &RigConfig, reader: &mut KeyReader) {
    let mut check = |key: String, is_good: bool, both: bool| {
        if !is_good {
            let problem = "is a quaternion of length zero".to_owned();
            refuse(reader, &[&format!("{key}.rotation")], problem, "no rotation is [0, 0, 0, 1]".into());
        } else if both && reader.is_written(&format!("{key}.rotation_deg")) {
            let problem = "is given twice: here and by `rotation`".to_owned();
            refuse(reader, &[&format!("{key}.rotation_deg")], problem, "remove one of the two".into());
        }
    };
    if let Some((transform, _)) = rig.tracker.frame() {
        check("tracker.transform".into(), transform.pose().is_some(), transform.rotation.is_some());
    }
    for (i, body) in rig.scene.bodies.iter().enumerate() {
        let pose = &body.mesh_to_body;
        check(format!("scene.bodies.{i}.mesh_to_body"), pose.to_affine().is_some(), pose.rotation.is_some());
    }
}

fn bodies(rig: &RigConfig, reader: &mut KeyReader) {
    let bodies = &rig.scene.bodies;
    let (mut names, mut nodes, mut ids) = (HashMap::new(), HashMap::new(), HashMap::new());
    for (i, body) in bodies.iter().enumerate() {
        let key = format!("scene.bodies.{i}");
        if body.name.is_empty() && !reader.is_written(&format!("{key}.name")) {
            refuse(reader, &[&key], "has no `name`".into(), "add the name that the tracker reports".into());
            continue;
        }
        if let Some(other) = names.get(body.name.as_str()) {
            let told = format!("two bodies are called {:?}, this one and `scene.bodies.{other}`", body.name);
            refuse(reader, &[&format!("{key}.name")], told, String::new());
        }
        if let Some(other) = nodes.get(body.node_name()) {
            let told = format!(
                "two bodies move the node {:?}, this one and `scene.bodies.{other}`",
                body.node_name()
            );
            refuse(reader, &[&format!("{key}.node"), &key], told, "give each its own node".into());
        }
        if let Some((id, other)) = body.id.and_then(|id| Some((id, ids.get(&id)?))) {
            refuse(
                reader,
                &[&format!("{key}.id")],
                format!("two bodies have the same id {id}, this one and `scene.bodies.{other}`"),
                "every body needs the id that the tracker gives it".into(),
            );
        }
        names.entry(body.name.as_str()).or_insert(i);
        nodes.entry(body.node_name()).or_insert(i);
        body.id.map(|id| ids.entry(id).or_insert(i));
        if body.motion.0.is_some() && !rig.tracker.is_mock() {
            refuse(
                reader,
                &[&format!("{key}.motion")],
                format!(
                    "is given, with `tracker.kind` = {:?}, which reports the poses itself",
                    rig.tracker.word()
                ),
                "remove it, set tracker.kind = \"mock\", or try the rig with --simulate".into(),
            );
        }
    }
    let room = MAX_TRACKED - rig.worn().len().min(MAX_HEADS);
    if let Some(first) = bodies.get(room) {
        let count = bodies.len();
        let problem = format!(
            "has {count} bodies, {} more than the {room} that are tracked: {:?} is the first of them",
            count - room,
            first.name
        );
        refuse(reader, &["scene.bodies"], problem, "bodies that move as one can be one body".into());
    }
    worn(rig, &ids, reader);
    observer(rig, reader);
}

/// What the observer and the scene's key name exists, and is given once.
fn observer(rig: &RigConfig, reader: &mut KeyReader) {
    let bodies = &rig.scene.bodies;
    let mut must_exist = |key: &str, name: &str, worn: &[&WearableConfig]| {
        let mut known = bodies.iter().map(|b| &b.name).chain(worn.iter().map(|w| &w.name));
        if !known.any(|known| known == name) {
            let known: Vec<String> = bodies.iter().map(|b| format!("{:?}", b.name)).collect();
            let known = if known.is_empty() { "none".into() } else { known.join(", ") };
            refuse(reader, &[key], format!("no body is called {name:?}"), format!("bodies: {known}"));
        }
    };
    if let Some(name) = &rig.observer.body {
        must_exist("observer.body", name, &[]);
    }
    if let GazeAim::Body(key, name) = rig.observer.gaze.aim() {
        must_exist(key, &name, &rig.worn());
    }
    if rig.scene.file.is_some() && reader.is_written("scene.builtin") {
        refuse(
            reader,
            &["scene.builtin"],
            "is given together with `scene.file`, which takes its place".into(),
            "remove one of the two".into(),
        );
    }
    let is_carried = rig.observer.body.is_some() || rig.observer.tracked.is_some();
    rig.observer.gaze.check(reader);
    if !is_carried && rig.observer.gaze.aim() == GazeAim::Measured {
        let problem = format!(
            "{:?} measures in the space of the glasses, and none are tracked",
            rig.observer.gaze.word()
        );
        refuse(
            reader,
            &["observer.gaze.kind"],
            problem,
            "set `observer.tracked` to the rigid body of the glasses".into(),
        );
    }
    if !is_carried && reader.is_written("observer.eye_offset") {
        refuse(
            reader,
            &["observer.eye_offset"],
            "is given without `observer.tracked`, the rigid body that it is measured from".into(),
            "set `observer.tracked`, or put the eye at `observer.position`".into(),
        );
    }
}

/// What people wear: the observer, and the heads of `[safety.eyes]`.
fn worn(rig: &RigConfig, ids: &HashMap<i64, usize>, reader: &mut KeyReader) {
    let bodies = &rig.scene.bodies;
    if let (Some(Wearable(tracked)), Some(body)) = (&rig.observer.tracked, &rig.observer.body) {
        let keys =
            [("observer.tracked", shown(tracked.name.clone())), ("observer.body", shown(body.clone()))];
        let remedy = "keep `observer.tracked`, which needs no mesh".to_owned();
        contradict(reader, &keys, "one eye is carried by one of them", remedy);
    }
    let heads = rig.safety.eyes.heads.iter().enumerate();
    let heads = heads.map(|(i, head)| (format!("safety.eyes.heads.{i}"), &head.0));
    let observer = rig.observer.tracked.iter().map(|tracked| ("observer.tracked".to_owned(), &tracked.0));
    let mut seen: HashMap<i64, &str> = HashMap::new();
    for (key, worn) in observer.chain(heads) {
        let is_body = bodies.iter().any(|b| b.name == worn.name);
        if is_body && key == "observer.tracked" {
            refuse(
                reader,
                &[&key],
                format!("{:?} is one of `scene.bodies`, on which light falls", worn.name),
                "remove that entry: who looks needs neither a node nor a mesh".into(),
            );
        }
        let other = worn.id.and_then(|id| {
            let body = ids.get(&id).map(|i| bodies[*i].name.as_str());
            body.or_else(|| seen.get(&id).copied()).filter(|other| *other != worn.name)
        });
        if let (Some(id), Some(other)) = (worn.id, other) {
            refuse(
                reader,
                &[&key],
                format!("{:?} and {other:?} have the same id {id}", worn.name),
                "each needs the id that the tracker gives it".into(),
            );
        }
        worn.id.map(|id| seen.insert(id, &worn.name));
        let moves = worn.motion.0.is_some() || worn.position.is_some();
        if moves && !rig.tracker.is_mock() {
            refuse(
                reader,
                &[&key],
                format!(
                    "has a motion or a position, with `tracker.kind` = {:?}, which reports the poses itself",
                    rig.tracker.word()
                ),
                "remove it, set tracker.kind = \"mock\", or try the rig with --simulate".into(),
            );
        }
    }
    if !rig.heads().is_empty() && rig.projector.backend.kind().is_loaded() {
        let keys = ["safety.eyes.heads", "observer.tracked", "observer.body"];
        let problem = format!(
            "names a head, and a {} cannot spare it: its patterns are loaded before anybody knows where the head will be",
            rig.projector.backend.kind().name
        );
        let remedy = "keep people out of the beam, and set safety.eyes.guard = false";
        refuse(reader, &keys, problem, remedy.into());
    }
    if rig.heads().len() > MAX_HEADS {
        let problem =
            format!("are {} heads with the observer's, and {MAX_HEADS} are guarded", rig.heads().len());
        refuse(reader, &["safety.eyes.heads"], problem, String::new());
    }
}

fn render(rig: &RigConfig, reader: &mut KeyReader) {
    let paper = &rig.render.paper;
    let mut ascending = |low: (&str, f64), high: (&str, f64)| {
        if low.1 > high.1 {
            let [a, b] = [low.0, high.0].map(|key| format!("render.paper.{key}"));
            contradict(
                reader,
                &[(&a, shown(low.1)), (&b, shown(high.1))],
                &format!("`{a}` is the larger of the two"),
                format!("it must be at most `{b}`"),
            );
        }
    };
    ascending(("phi_h_deg", paper.phi_h_deg), ("phi_q_deg", paper.phi_q_deg));
    ascending(("filter_from_deg", paper.filter_from_deg), ("filter_to_deg", paper.filter_to_deg));
}

fn time(rig: &RigConfig, purpose: Purpose, reader: &mut KeyReader) {
    if rig.real_time.pace == Pace::Virtual {
        if !rig.projector.backend.is_mock() {
            refuse(
                reader,
                &["projector.backend.kind", "real_time.pace"],
                format!("a projector of kind {:?} runs on its own clock", rig.projector.backend.word()),
                "use real_time.pace = \"real\"".into(),
            );
        }
        if rig.tracker.kind().origin == PoseOrigin::Measured {
            refuse(
                reader,
                &["tracker.kind", "real_time.pace"],
                format!("a tracker of kind {:?} runs on its own clock", rig.tracker.word()),
                "use real_time.pace = \"real\"".into(),
            );
        }
        if rig.observer.gaze.aim() == GazeAim::Measured {
            refuse(
                reader,
                &["observer.gaze.kind", "real_time.pace"],
                format!("a gaze of kind {:?} runs on its own clock", rig.observer.gaze.word()),
                "use real_time.pace = \"real\"".into(),
            );
        }
        if rig.run.frames == 0 && rig.run.seconds <= 0.0 && !purpose.at_rest {
            refuse(
                reader,
                &["real_time.pace", "run.frames"],
                "virtual pace runs as fast as it can and would never end".into(),
                "set `run.frames`, or give --frames or --seconds".into(),
            );
        }
    }
    let mut cores = rig.real_time.affinity.clone();
    cores.sort_unstable();
    if let Some(&last) = cores.last().filter(|&&c| c >= 1024) {
        let problem = format!("core {last} is outside 0 to 1023");
        refuse(reader, &["real_time.affinity"], problem, String::new());
    }
    horizon(rig, reader);
}

/// Checks the times in `[safety]` and `[output]` that were written against the frame's and the tracker's. Times that
/// were not written adapt to these by themselves, so each problem names first the key that was written.
fn horizon(rig: &RigConfig, reader: &mut KeyReader) {
    let (frame_ms, rate) = (rig.frame_ms(), rig.projector.frame_rate.hz());
    // What shows loaded frames has no watchdog.
    let has_watchdog = !rig.projector.backend.kind().is_loaded();
    if let Some(ms) = rig.safety.watchdog_ms.filter(|ms| has_watchdog && f64::from(*ms) < 2.0 * frame_ms) {
        refuse(
            reader,
            &["safety.watchdog_ms"],
            format!(
                "safety.watchdog_ms = {ms} is less than two frames of {frame_ms:.3} ms (projector.frame_rate = {rate:.3}): the projector \
                 would go dark in between"
            ),
            format!("leave it out, or write at least {:.0} ms", (2.0 * frame_ms).ceil()),
        );
    }
    if let Some(ms) = rig.output.light_window_ms.filter(|ms| *ms < frame_ms) {
        refuse(
            reader,
            &["output.light_window_ms"],
            format!(
                "output.light_window_ms = {ms} is shorter than one frame of {frame_ms:.3} ms (projector.frame_rate = {rate:.3})"
            ),
            format!("leave it out, or write at least {frame_ms:.3} ms"),
        );
    }
    let Some(predict_ms) = rig.safety.predict_ms else { return };
    if let Some(rate) = rig.tracker.rate_hz() {
        let period_ms = 1e3 / f64::from(rate);
        if f64::from(predict_ms) < 2.0 * period_ms {
            refuse(
                reader,
                &["safety.predict_ms"],
                format!(
                    "safety.predict_ms = {predict_ms} is less than two samples at tracker.rate_hz = {rate}: every lost sample would blank the \
                     picture"
                ),
                format!("leave it out, or write at least {:.0} ms", (2.0 * period_ms).ceil()),
            );
        }
    }
    // Light cannot fall before the middle of the slot after the one in which the newest sample arrived.
    if f64::from(predict_ms) < 1.5 * frame_ms {
        refuse(
            reader,
            &["safety.predict_ms"],
            format!(
                "safety.predict_ms = {predict_ms} is less than a frame and a half of {frame_ms:.3} ms (projector.frame_rate = {rate:.3}): \
                 every frame would be dark"
            ),
            format!("leave it out, or write at least {:.0} ms and what rendering takes", (1.5 * frame_ms).ceil()),
        );
    }
}

/// Makes the path of `key` relative to `base`, the rig file's folder. A path from a flag or a variable is relative to the
/// working directory.
fn place(path: &mut PathBuf, base: &Path, reader: &KeyReader, key: &str) {
    if path.is_relative() && matches!(reader.origin_of(key), super::Origin::File { .. }) {
        *path = base.join(&*path);
    }
}

/// Makes the paths of input files relative to `base`, the rig file's folder, and refuses missing files.
pub(super) fn resolve_files(rig: &mut RigConfig, base: &Path, purpose: Purpose, reader: &mut KeyReader) {
    for (i, body) in rig.scene.bodies.iter_mut().enumerate() {
        // The pipe may be made later: the rig says that there is none, and goes on.
        if let Some(PictureSource::Live(LiveSource::Pipe(pipe))) = &mut body.texture {
            place(pipe, base, reader, &format!("scene.bodies.{i}.texture"));
        }
    }
    let mut input = |path: &mut PathBuf, key: &str, is_made: bool| {
        place(path, base, reader, key);
        let problem = match regular_file::open(path) {
            Ok(_) => return,
            Err(e) if is_made && e.kind() == std::io::ErrorKind::NotFound => return,
            Err(e) => format!("{}: {e}", path.display()),
        };
        let in_file = matches!(reader.origin_of(key), super::Origin::File { .. });
        let remedy = if in_file { "paths in a rig file are relative to its folder" } else { "" };
        refuse(reader, &[key], problem, remedy.into());
    };
    if let Some(file) = &mut rig.scene.file {
        input(file, "scene.file", false);
    }
    if let Some(file) = &mut rig.projector.calibration {
        input(file, "projector.calibration", false);
    }
    if let Some(file) = &mut rig.calibration.file {
        input(file, "calibration.file", purpose.calibrates);
    }
    if let Some(file) = &mut rig.projector.flat_field {
        input(file, "projector.flat_field", false);
    }
    if let ResponseConfig::Table(table) = &mut rig.projector.response {
        input(&mut table.file, "projector.response.file", false);
    }
    for (i, body) in rig.scene.bodies.iter_mut().enumerate() {
        if let Some(PictureSource::File(file)) = &mut body.texture {
            input(file, &format!("scene.bodies.{i}.texture"), false);
        }
        if let Some(file) = &mut body.albedo_map {
            input(file, &format!("scene.bodies.{i}.albedo_map"), false);
        }
    }
    if let EnvironmentConfig::Image(image) = &mut rig.scene.environment {
        input(&mut image.file, "scene.environment.file", false);
    }
    if let Some(keys) = rig.tracker.placed(&mut |file, key| input(file, key, false)) {
        rig.tracker = OfKind::new(rig.tracker.kind(), keys);
    }
    let is_there = rig.calibration.file.as_ref().is_some_and(|file| file.exists());
    if reader.errors.is_empty() && (is_there || !purpose.calibrates) {
        super::calibration::check(rig, reader);
    }
}
