//! `dpm calibrate body`: where the mesh is in a tracked body, by touching known points of it with the tip of the wand, and then
//! by wandering over its surface.

use super::dialogue::Dialogue;
use super::lines::Lines;
use super::poses::Poses;
use dpm_calibration::body::{tip_in_body, wander, Touch, TouchSession, TriangleTree};
use dpm_calibration::file::{BodySection, Pose};
use dpm_calibration::trajectory::{TimedPose, Trajectory};
use dpm_common::clock::MonotonicClock;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::results::Results;
use dpm_scene::{Body, Scene};
use glam::{DAffine3, DVec3};
use std::time::Duration;

/// How the operator works.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ways {
    /// Seconds for which the tip wanders over the surface; 0 for touched points only.
    pub wander_s: f64,
    /// Radius of the wand's round tip, metres.
    pub tip_radius_m: f64,
}

/// The outermost points of a mesh along each axis, with words for them.
fn outermost(points: &[DVec3]) -> Vec<(&'static str, DVec3)> {
    let far = |axis: DVec3| points.iter().copied().max_by(|a, b| a.dot(axis).total_cmp(&b.dot(axis)));
    [
        ("the topmost point (+y)", DVec3::Y),
        ("the point farthest to the right (+x)", DVec3::X),
        ("the point farthest to the left (-x)", -DVec3::X),
        ("the foremost point (+z)", DVec3::Z),
        ("the hindmost point (-z)", -DVec3::Z),
        ("the lowest point (-y)", -DVec3::Y),
    ]
    .into_iter()
    .filter_map(|(words, axis)| Some((words, far(axis)?)))
    .collect()
}

/// The place of the tracked body `name` in the rig file.
pub(super) fn index_of(config: &RigConfig, name: &str) -> Result<usize, Failure> {
    config.scene.bodies.iter().position(|b| b.name == name).ok_or_else(|| {
        let names: Vec<&str> = config.scene.bodies.iter().map(|b| b.name.as_str()).collect();
        let told = format!("no body is named \"{name}\" in the rig file; bodies: {}", names.join(", "));
        Failure::new(FailureKind::BadInput, told)
    })
}

/// The bodies of a scene that the tracked body `name` carries, without the parts that move by themselves.
pub(super) fn carried<'a>(
    config: &RigConfig,
    scene: &'a Scene,
    name: &str,
) -> Result<Vec<&'a Body>, Failure> {
    let index = index_of(config, name)?;
    Ok(scene.bodies.iter().filter(|b| b.tracked == Some(index as u16) && b.motion.is_none()).collect())
}

/// The triangles of bodies.
pub(super) fn triangles_of(bodies: &[&Body]) -> Vec<[DVec3; 3]> {
    let of = |b: &Body| -> Vec<[DVec3; 3]> {
        b.mesh.triangles.iter().map(|t| t.map(|i| b.mesh.positions[i as usize].as_dvec3())).collect()
    };
    bodies.iter().flat_map(|b| of(b)).collect()
}

/// Touches points, wanders, and writes the place of the mesh.
///
/// # Errors
/// The tracker fails (exit code 3), or the touched points do not tell the place (2, with what to do).
pub fn calibrate(
    config: &RigConfig,
    scene: &Scene,
    (wand, tip): (&str, DVec3),
    name: &str,
    ways: Ways,
    results: &mut Results,
    dialogue: &Dialogue,
) -> Result<String, Failure> {
    let bodies = carried(config, scene, name)?;
    let points: Vec<DVec3> =
        bodies.iter().flat_map(|b| b.mesh.positions.iter().map(|p| p.as_dvec3())).collect();
    let poses = Poses::start(config, &[wand.to_owned(), name.to_owned()], MonotonicClock::new(0))?;
    poses.wait_until_seen()?;
    let progress = results.progress(&format!("body-{}", file_word(name)));
    let mut touches = Lines::resume(progress)?;
    let (touched, count) = touch(&poses, tip, &points, &mut touches, dialogue)?;
    let mut place = (touched, format!("{count} touched points"));
    let mut told = format!("touched points: residual {:.2} mm rms", 1e3 * place.0 .1);
    if ways.wander_s > 0.0 {
        dialogue.ask(&format!(
            "Now move the tip over the whole body for {:.0} s without lifting it. Press Enter to begin.",
            ways.wander_s
        ))?;
        poses.take();
        std::thread::sleep(Duration::from_secs_f64(ways.wander_s));
        let triangles = triangles_of(&bodies);
        let tips = tips_in_body(&poses.take(), tip);
        let found = wander(&TriangleTree::new(triangles), &tips, ways.tip_radius_m, &place.0 .0)
            .map_err(|e| Failure::new(FailureKind::BadInput, e))?;
        place = ((found.mesh_to_body, found.residual_m), format!("{} points of a wandering tip", found.used));
        told += &format!(
            "\nwandering: residual {:.2} mm rms of {} points; least certain direction known to {:.2} mm",
            1e3 * found.residual_m,
            found.used,
            1e3 * found.weakest_m
        );
    }
    let ((motion, residual_m), data) = place;
    let provenance = results.provenance(config, name, data, "rigid motion by least squares");
    let section = BodySection { mesh_to_body: Pose::new(&motion), residual_m: Some(residual_m), provenance };
    results.file.bodies.insert(name.to_owned(), section);
    told += &format!("\n{}", results.save(config)?);
    // Not before the result is written: until then the touches are all there is.
    touches.forget();
    Ok(told)
}

/// A body's name as a part of a file's.
fn file_word(name: &str) -> String {
    name.chars().map(|c| if c.is_alphanumeric() { c } else { '_' }).collect()
}

/// Touches points of the mesh until the operator is content. Returns the place with its residual, and the number of points.
fn touch(
    poses: &Poses,
    tip: DVec3,
    points: &[DVec3],
    touches: &mut Lines<6>,
    dialogue: &Dialogue,
) -> Result<((DAffine3, f64), usize), Failure> {
    let named = outermost(points);
    let mut session = TouchSession::new(named.iter().map(|(_, p)| *p).collect());
    for line in touches.lines() {
        let [mesh, body] = [0, 3].map(|i| DVec3::from_slice(&line[i..i + 3]));
        session.add(Touch { mesh, body });
    }
    let mut count = touches.lines().len();
    dialogue.tell(
        "Touch the points of the body that are asked for with the tip of the wand, hold it there and press Enter. The axes are\n\
         those of the mesh. At least 4 points are needed. s: another point; d: done; or type x y z in metres for a point of\n\
         your own.",
    );
    if count > 0 {
        let told = format!(
            "Going on with {count} points of {}; delete that file to begin anew.",
            touches.path().display()
        );
        dialogue.tell(&told);
    }
    let mut skipped = 0;
    loop {
        let suggested = named.get(count + skipped).copied();
        let answer = dialogue.ask(&question(count + 1, suggested.as_ref()))?;
        let numbers: Vec<f64> = answer.split_whitespace().filter_map(|w| w.parse().ok()).collect();
        let mesh = match (answer.as_str(), &numbers[..]) {
            ("s" | "S", _) => {
                skipped += 1;
                continue;
            }
            ("d" | "D", _) => match session.solve() {
                Ok(t) => return Ok(((t.mesh_to_body, t.residual_m), count)),
                Err(why) => {
                    dialogue.tell(&format!("not yet: {why}"));
                    continue;
                }
            },
            (_, &[x, y, z]) => DVec3::new(x, y, z),
            ("", _) if suggested.is_some() => suggested.map_or(DVec3::ZERO, |(_, at)| at),
            _ => {
                dialogue.tell("press Enter, s or d, or type three numbers");
                continue;
            }
        };
        match tip_in_body(tip, &together(&poses.hold())) {
            Ok(contact) => {
                session.add(Touch { mesh, body: contact.body });
                let (m, b) = (mesh, contact.body);
                touches.push([m.x, m.y, m.z, b.x, b.y, b.z])?;
                count += 1;
                match session.solve() {
                    Ok(t) => dialogue.tell(&format!("residual {:.2} mm rms", 1e3 * t.residual_m)),
                    Err(why) if count >= 4 => dialogue.tell(&why.to_string()),
                    Err(_) => dialogue.tell(&format!("noted; {} more at least", 4 - count)),
                }
            }
            Err(why) => dialogue.tell(&why.to_string()),
        }
    }
}

/// What is asked for point `number`: a named one, or one of the operator's own.
fn question(number: usize, suggested: Option<&(&str, DVec3)>) -> String {
    match suggested {
        Some((words, DVec3 { x, y, z })) => {
            format!("point {number}: {words}, at ({x:.4}, {y:.4}, {z:.4}) m:")
        }
        None => format!("point {number}: x y z of a point of your own, or d:"),
    }
}

/// Poses of the wand with the body's pose at the same instants.
fn together(poses: &[Vec<TimedPose>]) -> Vec<(TimedPose, TimedPose)> {
    let [wand, body] = poses else { return Vec::new() };
    let path = Trajectory::new(body);
    let at = |w: &TimedPose| {
        let moving = path.at(w.stamp_ns, 0.0)?;
        let body = TimedPose { stamp_ns: w.stamp_ns, position: moving.position, rotation: moving.rotation };
        Some((*w, body))
    };
    wand.iter().filter_map(at).collect()
}

/// Places of the tip in the body's frame.
fn tips_in_body(poses: &[Vec<TimedPose>], tip: DVec3) -> Vec<DVec3> {
    let in_body =
        |(wand, body): (TimedPose, TimedPose)| body.rotation.conjugate() * (wand.place(tip) - body.position);
    together(poses).into_iter().map(in_body).collect()
}
