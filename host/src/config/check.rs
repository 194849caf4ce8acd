//! Contradictions between keys: each named at the key that somebody wrote, with what would resolve it.

use super::read::Reader;
use super::world::{EnvironmentConfig, GazeConfig, TrackerConfig};
use super::{Pace, ProjectorBackend, RigConfig};
use hil_mock::faults::FaultPlan;
use hil_mock::tracker::TRACKER_FAULTS;
use std::path::{Path, PathBuf};

/// Refuses at the first of `keys` that somebody wrote.
fn refuse(reader: &mut Reader, keys: &[&str], problem: String, remedy: String) {
    let key = keys.iter().find(|k| reader.is_written(k)).unwrap_or(&keys[0]);
    let origin = reader.origin_of(key);
    reader.refuse(&origin, key, problem, remedy);
}

pub(super) fn check(rig: &RigConfig, reader: &mut Reader) {
    projector(rig, reader);
    bodies(rig, reader);
    render(rig, reader);
    time(rig, reader);
    faults(rig, reader);
    addresses(rig, reader);
    super::safety::check(rig, reader);
}

fn addresses(rig: &RigConfig, reader: &mut Reader) {
    let TrackerConfig::Natnet(natnet) = &rig.tracker else { return };
    let multicast = natnet.multicast.as_deref();
    let named =
        [("server", Some(&*natnet.server)), ("local", Some(&*natnet.local)), ("multicast", multicast)];
    for (key, text) in named {
        let Some(text) = text else { continue };
        let parsed = text.trim().parse::<std::net::Ipv4Addr>();
        let key = format!("tracker.{key}");
        match parsed {
            Err(_) => {
                let problem = format!("{text:?} is not an IPv4 address");
                refuse(reader, &[&key], problem, "write for example \"192.168.1.10\"".into());
            }
            Ok(group) if key == "tracker.multicast" && !group.is_multicast() => {
                let problem = format!("{text} is not a multicast group");
                refuse(
                    reader,
                    &[&key],
                    problem,
                    "groups are 224.0.0.0 to 239.255.255.255; Motive's is 239.255.42.99".into(),
                );
            }
            Ok(_) => {}
        }
    }
}

fn faults(rig: &RigConfig, reader: &mut Reader) {
    if let TrackerConfig::Mock(mock) = &rig.tracker {
        let plan = mock.faults.parse::<FaultPlan>();
        let known = plan.and_then(|plan| plan.check_supported(&TRACKER_FAULTS, "the mock tracker"));
        if let Err(e) = known {
            refuse(
                reader,
                &["tracker.faults"],
                e.to_string(),
                "for example \"loss=0.01,dropout@1.5s+20ms\"".into(),
            );
        }
    }
}

fn projector(rig: &RigConfig, reader: &mut Reader) {
    let p = &rig.projector;
    let (num, den) = (u64::from(p.frame_rate.num()), u64::from(p.frame_rate.den()));
    if num * u64::from(p.planes) > u64::from(p.max_planes_per_second) * den {
        let most = p.max_planes_per_second / p.planes.max(1);
        refuse(
            reader,
            &["projector.frame_rate", "projector.planes", "projector.max_planes_per_second"],
            format!(
                "{:.3} frames/s of {} planes are {:.0} planes/s, the projector shows {}",
                p.frame_rate.hz(),
                p.planes,
                p.frame_rate.hz() * f64::from(p.planes),
                p.max_planes_per_second
            ),
            format!("at most {most} frames/s of {} planes", p.planes),
        );
    }
    if p.calibration.is_some() && p.calibration_unit.is_none() {
        refuse(
            reader,
            &["projector.calibration"],
            "the unit of its lengths is not told by the file".into(),
            "set projector.calibration_unit to \"metre\" or \"millimetre\"".into(),
        );
    }
    if p.calibration.is_some() {
        for key in ["position", "look_at", "up", "horizontal_fov_deg"] {
            let key = format!("projector.{key}");
            if reader.is_written(&key) {
                refuse(
                    reader,
                    &[&key],
                    "is given twice: here and by `projector.calibration`".into(),
                    "remove one of the two".into(),
                );
            }
        }
    } else {
        let view = glam::DVec3::from(p.look_at) - glam::DVec3::from(p.position);
        let up = glam::DVec3::from(p.up);
        if view.length() < 1e-6 {
            refuse(
                reader,
                &["projector.look_at", "projector.position"],
                "the projector looks at the point where it stands".into(),
                "move `look_at` into the scene".into(),
            );
        } else if up.length() < 1e-9 || view.normalize().cross(up.normalize()).length() < 1e-6 {
            refuse(
                reader,
                &["projector.up", "projector.look_at", "projector.position"],
                "is zero or along the view, so the picture has no upper side".into(),
                "use a direction across the view, for example [0, 0, -1] when looking down".into(),
            );
        }
    }
    if let ProjectorBackend::Dlpc900(dlpc900) = &p.backend {
        let panel = dlpc900.panel.dmd().raster();
        if (p.width, p.height) != (panel.width(), panel.height()) {
            refuse(
                reader,
                &["projector.width", "projector.height", "projector.backend.panel", "projector.backend.kind"],
                format!(
                    "{} x {}: a {} has {} x {} mirrors",
                    p.width,
                    p.height,
                    dlpc900.panel.dmd().name(),
                    panel.width(),
                    panel.height()
                ),
                format!("set projector.width = {} and projector.height = {}", panel.width(), panel.height()),
            );
        }
    }
    if matches!(p.backend, ProjectorBackend::Dlpc900(_)) && num > 120 * den {
        refuse(
            reader,
            &["projector.frame_rate", "projector.backend.kind"],
            format!("{:.3} frames/s: a DLPC900 shows at most 120 frames/s of 24 planes", p.frame_rate.hz()),
            "lower `projector.frame_rate` to 120 or choose another backend".into(),
        );
    }
}

fn bodies(rig: &RigConfig, reader: &mut Reader) {
    let bodies = &rig.scene.bodies;
    for (i, body) in bodies.iter().enumerate() {
        let key = format!("scene.bodies.{i}");
        if body.name.is_empty() && !reader.is_written(&format!("{key}.name")) {
            refuse(reader, &[&key], "has no `name`".into(), "add the name that the tracker reports".into());
            continue;
        }
        let earlier = &bodies[..i];
        if earlier.iter().any(|b| b.name == body.name) {
            refuse(
                reader,
                &[&format!("{key}.name")],
                format!("two bodies are called {:?}", body.name),
                String::new(),
            );
        }
        if earlier.iter().any(|b| b.node_name() == body.node_name()) {
            refuse(
                reader,
                &[&format!("{key}.node"), &key],
                format!("two bodies move the node {:?}", body.node_name()),
                "give each its own node".into(),
            );
        }
        if body.id.is_some() && earlier.iter().any(|b| b.id == body.id) {
            refuse(
                reader,
                &[&format!("{key}.id")],
                "two bodies have the same id".into(),
                "every body needs the id that the tracker gives it".into(),
            );
        }
        if body.motion.0.is_some() && !matches!(rig.tracker, TrackerConfig::Mock(_)) {
            refuse(
                reader,
                &[&format!("{key}.motion")],
                format!("the poses come from the tracker of kind {:?}", rig.tracker.word()),
                "remove it, or set tracker.kind = \"mock\"".into(),
            );
        }
    }
    if bodies.len() > usize::from(u16::MAX) {
        refuse(reader, &["scene.bodies"], "more bodies than can be numbered".into(), String::new());
    }
    let mut must_exist = |key: &str, name: &str| {
        if !bodies.iter().any(|b| b.name == name) {
            let known: Vec<String> = bodies.iter().map(|b| format!("{:?}", b.name)).collect();
            let known = if known.is_empty() { "none".into() } else { known.join(", ") };
            refuse(reader, &[key], format!("no body is called {name:?}"), format!("bodies: {known}"));
        }
    };
    if let Some(name) = &rig.observer.body {
        must_exist("observer.body", name);
    }
    if let GazeConfig::Tracked(gaze) = &rig.observer.gaze {
        must_exist("observer.gaze.target", &gaze.target);
    }
    if rig.scene.file.is_some() && reader.is_written("scene.builtin") {
        refuse(
            reader,
            &["scene.builtin"],
            "is given together with `scene.file`".into(),
            "remove one of the two".into(),
        );
    }
    if rig.observer.body.is_none() && reader.is_written("observer.eye_offset") {
        refuse(
            reader,
            &["observer.eye_offset"],
            "needs a body to be measured from".into(),
            "set `observer.body`, or put the eye at `observer.position`".into(),
        );
    }
}

fn render(rig: &RigConfig, reader: &mut Reader) {
    let paper = &rig.render.paper;
    let mut ascending = |low: (&str, f64), high: (&str, f64)| {
        if low.1 > high.1 {
            refuse(
                reader,
                &[&format!("render.paper.{}", low.0), &format!("render.paper.{}", high.0)],
                format!("`{}` is {}, beyond `{}` = {}", low.0, low.1, high.0, high.1),
                "the first must not be larger".into(),
            );
        }
    };
    ascending(("phi_h_deg", paper.phi_h_deg), ("phi_q_deg", paper.phi_q_deg));
    ascending(("filter_from_deg", paper.filter_from_deg), ("filter_to_deg", paper.filter_to_deg));
}

fn time(rig: &RigConfig, reader: &mut Reader) {
    if rig.real_time.pace == Pace::Virtual {
        if !matches!(rig.projector.backend, ProjectorBackend::Mock(_)) {
            refuse(
                reader,
                &["projector.backend.kind", "real_time.pace"],
                format!("a projector of kind {:?} runs on its own clock", rig.projector.backend.word()),
                "use real_time.pace = \"real\"".into(),
            );
        }
        if !matches!(rig.tracker, TrackerConfig::Mock(_) | TrackerConfig::Replay(_)) {
            refuse(
                reader,
                &["tracker.kind", "real_time.pace"],
                format!("a tracker of kind {:?} runs on its own clock", rig.tracker.word()),
                "use real_time.pace = \"real\"".into(),
            );
        }
        if rig.run.frames == 0 {
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
        let problem = format!("core {last} is none of 0 to 1023");
        refuse(reader, &["real_time.affinity"], problem, String::new());
    }
    let frame_ms = 1e3 / rig.projector.frame_rate.hz();
    // A DLPC900 has no watchdog.
    let has_watchdog = !matches!(rig.projector.backend, ProjectorBackend::Dlpc900(_));
    if has_watchdog && f64::from(rig.safety.watchdog_ms) < 2.0 * frame_ms {
        refuse(
            reader,
            &["safety.watchdog_ms", "projector.frame_rate"],
            format!(
                "{} ms is less than two frames of {frame_ms:.3} ms: the projector would go dark in between",
                rig.safety.watchdog_ms
            ),
            format!("at least {:.0} ms", (2.0 * frame_ms).ceil()),
        );
    }
    if rig.output.light_window_ms < frame_ms {
        refuse(
            reader,
            &["output.light_window_ms", "projector.frame_rate"],
            format!("{} ms is shorter than one frame of {frame_ms:.3} ms", rig.output.light_window_ms),
            String::new(),
        );
    }
    if let Some(rate) = rig.tracker.rate_hz() {
        let period_ms = 1e3 / f64::from(rate);
        let predict_ms = f64::from(rig.safety.predict_ms);
        if predict_ms < 2.0 * period_ms {
            refuse(
                reader,
                &["safety.predict_ms", "tracker.rate_hz"],
                format!("{predict_ms} ms is less than two samples at {rate} Hz: every lost sample would blank the picture"),
                format!("at least {:.0} ms", (2.0 * period_ms).ceil()),
            );
        }
    }
}

/// Makes the paths of input files relative to `base`, the rig file's folder, and refuses those that are not there.
pub(super) fn resolve_files(rig: &mut RigConfig, base: &Path, reader: &mut Reader) {
    let mut input = |path: &mut PathBuf, key: &str| {
        // What a flag or a variable says is relative to the working directory.
        if path.is_relative() && matches!(reader.origin_of(key), super::Origin::File { .. }) {
            *path = base.join(&*path);
        }
        let problem = match std::fs::metadata(&*path) {
            Ok(meta) if meta.is_file() => return,
            Ok(_) => format!("{} is not a file", path.display()),
            Err(e) => format!("{}: {e}", path.display()),
        };
        let in_file = matches!(reader.origin_of(key), super::Origin::File { .. });
        let remedy = if in_file { "paths in a rig file are relative to its folder" } else { "" };
        refuse(reader, &[key], problem, remedy.into());
    };
    if let Some(file) = &mut rig.scene.file {
        input(file, "scene.file");
    }
    if let Some(file) = &mut rig.projector.calibration {
        input(file, "projector.calibration");
    }
    if let EnvironmentConfig::Image(image) = &mut rig.scene.environment {
        input(&mut image.file, "scene.environment.file");
    }
    if let TrackerConfig::Replay(replay) = &mut rig.tracker {
        input(&mut replay.file, "tracker.file");
    }
}
