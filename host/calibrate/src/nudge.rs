//! `dpm calibrate nudge`: outlines of bodies are shown while letters move a body or the projector.

use super::body::{carried, index_of, triangles_of};
use super::outline::{Outlines, MOST_POINTS};
use super::poses::Poses;
use dpm_calibration::nudge::{NudgeOrder, Nudges, TURN_DEG};
use dpm_calibration::outline::Outline;
use dpm_calibration::trajectory::TimedPose;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::results::NudgeTarget;
use dpm_rig::rig::Rig;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec3};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// Time between two pictures.
const EVERY: Duration = Duration::from_millis(33);

struct NudgeView {
    name: String,
    mesh_to_body: DAffine3,
    outline: Outline,
}

/// Bodies whose outlines are shown, and the projector that shows them.
pub struct OutlineStage {
    moved: NudgeTarget,
    camera: ProjectorCamera,
    bodies: Vec<NudgeView>,
}

impl OutlineStage {
    /// Shows the bodies `names`, or, if there are none, all of the rig.
    ///
    /// # Errors
    /// The rig has no such body, or none at all.
    pub fn of(rig: &Rig, moved: NudgeTarget, names: &[String]) -> Result<Self, Failure> {
        let all: Vec<String> = rig.config.scene.bodies.iter().map(|b| b.name.clone()).collect();
        let names = if names.is_empty() { &all[..] } else { names };
        let shown = |name: &String| {
            let index = index_of(&rig.config, name)?;
            let triangles = triangles_of(&carried(&rig.config, &rig.scene, name)?);
            let mesh_to_body = rig.bodies.get(index).map_or(DAffine3::IDENTITY, |b| b.mesh_to_body);
            Ok(NudgeView { name: name.clone(), mesh_to_body, outline: Outline::new(&triangles) })
        };
        let bodies = names.iter().map(shown).collect::<Result<Vec<_>, Failure>>()?;
        if bodies.is_empty() {
            let told = "the rig file has no body (scene.bodies) whose outline could be shown";
            return Err(Failure::new(FailureKind::BadInput, told));
        }
        Ok(Self { moved, camera: rig.camera, bodies })
    }

    /// The bodies that are shown, as the tracker names them.
    pub fn names(&self) -> Vec<String> {
        self.bodies.iter().map(|b| b.name.clone()).collect()
    }

    /// Motions of `step_m` metres each, from where the rig has what is moved. A body turns about its middle, the
    /// projector about its lens.
    pub fn nudges(&self, step_m: f64) -> Nudges {
        let body = match &self.moved {
            NudgeTarget::Body(name) => self.bodies.iter().find(|b| b.name == *name),
            NudgeTarget::Projector => None,
        };
        match body {
            Some(body) => Nudges::new(body.mesh_to_body, body.outline.middle(), step_m),
            None => Nudges::new(self.camera.world_from_projector, DVec3::ZERO, step_m),
        }
    }

    /// The pixels of all outlines, with what is moved at `now` and the bodies at `poses`; bodies that were not seen yet
    /// are left out.
    fn draw(&self, now: DAffine3, poses: &[Option<TimedPose>], pixels: &mut Vec<[u32; 2]>) {
        pixels.clear();
        let mut camera = self.camera;
        if self.moved == NudgeTarget::Projector {
            camera.world_from_projector = now;
        }
        for (body, pose) in self.bodies.iter().zip(poses) {
            let Some(pose) = pose else { continue };
            let is_moved = matches!(&self.moved, NudgeTarget::Body(name) if *name == body.name);
            let mesh_to_body = if is_moved { now } else { body.mesh_to_body };
            let world_from_body = DAffine3::from_rotation_translation(pose.rotation, pose.position);
            body.outline.draw(&camera, &(world_from_body * mesh_to_body), MOST_POINTS, pixels);
        }
    }

    /// Shows the outlines until `is_over`.
    fn run(&self, poses: &Poses, now: &Mutex<DAffine3>, outlines: &Outlines, is_over: &AtomicBool) {
        let mut last = vec![None; self.bodies.len()];
        let mut pixels = Vec::with_capacity(MOST_POINTS);
        while !is_over.load(Ordering::Relaxed) {
            for (last, fresh) in last.iter_mut().zip(poses.take()) {
                *last = fresh.last().copied().or(*last);
            }
            let now = *now.lock().unwrap_or_else(PoisonError::into_inner);
            self.draw(now, &last, &mut pixels);
            outlines.show(&pixels);
            std::thread::sleep(EVERY);
        }
    }
}

/// Shows the outlines while the operator moves things. `ask` asks for a line, `tell` tells something, and `save` keeps a
/// motion.
///
/// # Errors
/// The input ended, or the result cannot be written.
pub fn nudge(
    stage: &OutlineStage,
    (poses, outlines): (&Poses, &Outlines),
    nudges: &mut Nudges,
    ask: impl FnMut(&str) -> Result<String, Failure>,
    save: impl FnMut(&DAffine3) -> Result<String, Failure>,
) -> Result<String, Failure> {
    let (now, is_over) = (Mutex::new(nudges.now()), AtomicBool::new(false));
    std::thread::scope(|scope| {
        scope.spawn(|| stage.run(poses, &now, outlines, &is_over));
        let moved = |motion: &DAffine3| *now.lock().unwrap_or_else(PoisonError::into_inner) = *motion;
        let result = converse(nudges, ask, moved, save);
        is_over.store(true, Ordering::Relaxed);
        result
    })
}

/// What the letters do.
pub fn help(moved: &NudgeTarget, step_m: f64) -> String {
    let (what, axes) = match moved {
        NudgeTarget::Body(name) => (format!("the mesh of \"{name}\""), "the mesh's own axes"),
        NudgeTarget::Projector => ("the projector".into(), "its own axes (x right, y up, z backwards)"),
    };
    format!(
        "Letters move {what} along {axes}; type one or more and press Enter.\n\
         x y z: by {} mm; X Y Z: back; a b c: turn by {TURN_DEG} degrees about x, y, z; A B C: back;\n\
         u: take the last one back; w: write the calibration file; q: quit, what was not written is lost",
        1e3 * step_m
    )
}

/// Follows lines until the operator quits. Returns what to tell at the end.
///
/// # Errors
/// The input ended, or the result cannot be written.
fn converse(
    nudges: &mut Nudges,
    mut ask: impl FnMut(&str) -> Result<String, Failure>,
    moved: impl Fn(&DAffine3),
    mut save: impl FnMut(&DAffine3) -> Result<String, Failure>,
) -> Result<String, Failure> {
    let mut saved: Option<DAffine3> = None;
    let mut told = String::new();
    loop {
        let line = ask(&format!("{told}{}:", told_of(nudges)))?;
        told.clear();
        let orders = match NudgeOrder::of_line(&line) {
            Ok(orders) => orders,
            Err(letter) => {
                told = format!(
                    "{letter:?} says nothing; the letters are x y z a b c, in capitals back, u, w, q\n"
                );
                continue;
            }
        };
        for order in orders {
            match order {
                NudgeOrder::Move(along) => nudges.shift(along),
                NudgeOrder::Turn(about) => nudges.turn(about),
                NudgeOrder::Undo if nudges.undo() => {}
                NudgeOrder::Undo => told = "nothing to take back\n".into(),
                NudgeOrder::Save => {
                    told = save(&nudges.now())? + "\n";
                    saved = Some(nudges.now());
                }
                NudgeOrder::Quit => {
                    let end = match saved {
                        Some(s) if s == nudges.now() => "what is shown was written",
                        Some(_) => "what was moved after the last w is not written",
                        None => "nothing was written",
                    };
                    return Ok(format!("{told}{end}"));
                }
            }
            moved(&nudges.now());
        }
    }
}

fn told_of(nudges: &Nudges) -> String {
    let (moved, turned) = nudges.offset();
    let [x, y, z] = moved.to_array().map(|v| 1e3 * v);
    let [a, b, c] = turned.to_array().map(f64::to_degrees);
    format!("moved by ({x:.2}, {y:.2}, {z:.2}) mm, turned by ({a:.2}, {b:.2}, {c:.2}) degrees")
}

#[cfg(test)]
mod tests;
